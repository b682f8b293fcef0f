"""A drive that only listens: what a controller would send, beside what somebody else sends.

It reads the valve frames of the machine's remote control, and the positions that the encoders send
by themselves or after somebody else's SYNC. Without an operator of its own, the goal is the
velocity that the tool has: a controller that fits the machine then asks for the same motion.
"""

from collections import Counter

import numpy as np

from brokk_min import hw
from brokk_min.can import canopen
from brokk_min.can.canopen import Counts, Operator, OperatorInput
from brokk_min.can.connection import Bus
from brokk_min.machine import Array, Controller, Machine

EARLY = 0.15  # of a tick, by which positions may come early (assumed)


class Shadow(hw.Drive):
    """A `Drive` that sends nothing, or with `sync` SYNC and the start of the nodes alone."""

    def __init__(
        self,
        machine: Machine,
        controller: Controller,
        bus: Bus,
        operator: Operator | None,
        sync: bool,
    ) -> None:
        super().__init__(machine, controller, bus, operator or self.follow)
        bus.allowed = (canopen.NMT, canopen.SYNC) if sync else ()
        self.sync = sync
        self.nodes.own_ids = ()  # frames of others are no fault
        self.nodes.nmt[:] = canopen.OPERATIONAL  # until they say otherwise
        self.pairs: list[tuple[Array, Array]] = []  # u that it would send, that was sent
        self.faults: Counter[str] = Counter()  # ticks with each
        self.quiet = 0  # ticks since the last position of any joint

    def begin(self) -> None:
        """Start the clock, and nodes if it may. ValueError: see `canopen.check_bus`."""
        canopen.check_bus(self.machine)
        self.bus.send(canopen.NMT, canopen.START_ALL)
        self.start_time = self.positions_time = self.bus.now()

    def follow(self, driving: bool, ready: bool) -> OperatorInput:
        """The operator without a device: it presses when the gate is ready, then wants `v_tool`."""
        if not driving or self.measured is None:
            return OperatorInput(enable=ready and not self.operator_input.enable)
        v, fastest = self.measured.v_tool[0], self.machine.tool_speed
        x, y, z = (v * fastest / max(fastest, float(np.linalg.norm(v)))).tolist()
        return OperatorInput((x, y, z), enable=True)

    def wait(self) -> None:
        """Wait until positions are due, a tick after the last; then the tick before is over."""
        if not self.sync:
            due = self.positions_time + (1 - EARLY) * self.machine.dt
            self.start_time = due - self.deadline_number * self.machine.dt
        super().wait()
        fault = "" if self.quiet else str(self.gate.active_fault)
        if fault and self.ticks > 2:  # the first tick is late
            self.faults[fault] += 1
        self.nodes.frames[:] = 0  # somebody else may ask more often
        self.nodes.heartbeat[:] = self.bus.now()  # nobody has set up heartbeats
        recent = self.nodes.enable and self.bus.now() - self.nodes.valve_time < canopen.WATCHDOG
        sent = self.nodes.u * recent
        if self.gate.driving:
            self.pairs.append((self.gate.sent[:, -1], sent))
        moved_by = self.gate.sent.copy()  # history and gate go on from what was sent
        moved_by[:, -1] = sent
        self.gate = self.gate._replace(sent=moved_by)

    def control(self, counts: Counts) -> Array:
        """The controller's command u (n,)."""
        answered = self.nodes.frames > 0
        self.quiet = 0 if answered.any() else self.quiet + 1
        if answered.any() and not answered.all():  # it has waited for the others
            self.positions_time += self.machine.dt
        else:
            self.positions_time = self.bus.now()
        return super().control(counts)

    def report(self) -> str:
        """Both commands compared joint by joint, and what the gate would have stopped."""
        m = self.machine
        would, sent = np.array(self.pairs, float).reshape(-1, 2, m.n).swapaxes(0, 1)
        lines = [f"compared in {len(would)} of {self.ticks} ticks, in per cent of full command:"]
        for i in m.driven if len(would) else ():
            a, b = would[:, i], sent[:, i]
            r = f"{np.corrcoef(a, b)[0, 1]:+.2f}" if np.ptp(a) and np.ptp(b) else "none"
            difference = 100 * np.mean(a - b)
            lines.append(f"  {m.names[i]}: correlation {r}, mean difference {difference:+.1f}")
        if np.isinf(self.nodes.valve_time):
            lines.append(f"no valve frame with identifier 0x{m.valve_frame_id:X} came")
        if self.quiet > 1:
            lines.append(f"no positions came in the last {self.quiet * m.dt:.1f} s")
        lines += [f"the gate would have stopped {k} ticks: {f}" for f, k in self.faults.items()]
        return "\n".join(lines)
