"""The hardware path: the 20 Hz loop that drives a machine on a CAN bus.

Each tick of `Drive`: SYNC, the encoders' positions, the observation, the controller, the safety gate, the
valve frame. `gate` decides what may reach the valves, `bus` carries frames, `drive_log` runs the loop again on
its logs, `simulator` is a machine to try. Nothing here is a safety function: a real machine keeps its
hard-wired emergency stop (docs/hardware.md).
"""

import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import copy
from typing import Any

import numpy as np

from brokk_min.actuator import initial_history
from brokk_min.can import canopen as bus
from brokk_min.can.canopen import (
    OPERATIONAL,
    Array,
    OperatorInput,
    encoder_counts,
    unpack_operator_input,
)
from brokk_min.can.safety_gate import GateInputs, fault_name, gate, gate_start
from brokk_min.env import measure, update_history
from brokk_min.evaluation.rollout import Controller
from brokk_min.kinematics import forward_kinematics, tool_velocity
from brokk_min.machine import PWM_MAX, Machine

AWAKE = 0.002  # s before SYNC and after it in which the loop does not sleep (tuned)
REHEARSALS = 4  # of a tick before it (tuned)
WINDOW = 0.020  # s after SYNC in which the encoders must answer (assumed)
MAX_FRAMES = 2000  # read in a row; more than a bus can carry in a tick


class Drive:
    """The 20 Hz loop: the operator's wish, through a controller and the gate, to the valves. Paper: Sec. 2

    Args:
        machine: its joints' encoders and its valve controller are on the bus.
        controller: a policy or a baseline.
        line: `bus.Bus`, or a `drive_log.ReplayedBus` of one.
        operator: gives the wish of a tick; it is told whether the gate drives and is ready.
    """

    def __init__(
        self,
        machine: Machine,
        controller: Controller,
        line: Any,
        operator: Callable[[bool, bool], OperatorInput],
    ) -> None:
        if machine.n > 5:
            raise ValueError(
                f"{machine.name}: expected at most 5 joints in a valve frame, got {machine.n}"
            )
        self.machine, self.controller, self.line, self.operator = (
            machine,
            controller,
            line,
            operator,
        )
        self.nodes, self.gate, self.operator_input = (
            bus.Nodes(machine),
            gate_start(machine),
            OperatorInput(),
        )
        self.memory = controller.start(1)
        self.history: Array | None = None
        self.error_integral: Array = np.zeros((1, 3), np.float32)  # of `integrate_error`
        self.v_goal = self.error_integral  # tool velocity wanted in the last tick [m/s]
        self.problem = self.remark = self.reason = (
            ""  # exception of this tick, the last one, what is wrong
        )
        self.signals: list[int] = []
        self.ticks, self.skipped, self.lateness = 0, 0, 0.0
        self.begun, self.number = 0.0, 0  # the grid of deadlines, and where on it we are

    def begin(self) -> None:
        """Check and set up the encoders, start all nodes, and the clock.

        ValueError: an encoder that does not answer or has another resolution.
        """
        for joint in self.machine.joints:
            turn = bus.sdo(self.line, joint.encoder_node, bus.RESOLUTION_OBJECT)
            if turn != 2**self.machine.encoder_bits:
                raise ValueError(
                    f"{joint.name}: expected {2**self.machine.encoder_bits} counts a turn of encoder node "
                    f"{joint.encoder_node} (object 0x6501), got {turn}"
                )
            bus.sdo(self.line, joint.encoder_node, bus.BEAT_OBJECT, round(1e3 * bus.BEAT), size=2)
            bus.sdo(self.line, joint.encoder_node, bus.SYNC_OBJECT, 1, size=1)  # at every SYNC
        self.line.send(bus.NMT, bytes([1, 0]))
        self.begun = self.line.now()

    @property
    def deadline(self) -> float:
        """When the next tick is due [s]; not a sum of periods, which would drift by rounding."""
        return self.begun + self.number * self.machine.dt

    def tick(self) -> bool:
        """Wait for the deadline, then one tick; False if it was the last."""
        self._wait()
        line, wanted = self.line, np.zeros(self.machine.n)
        with self.catch_errors():
            wish = self.operator(bool(self.gate.driving), bool(self.gate.active_fault == 0))
            self.operator_input = unpack_operator_input(
                wish.pack()
            )  # as the log has it, so that a replay gets the same
        self.nodes.frames *= 2  # a position from before its SYNC is as wrong as a doubled one
        with self.catch_errors():
            line.send(bus.SYNC, b"")
            self._listen(line.now() + WINDOW, AWAKE, until_complete=True)
        counts = encoder_counts(self.machine, self.nodes.raw)
        with self.catch_errors():
            wanted = self._control(counts)
        stop, error = (
            self.operator_input.stop or bool(self.signals),
            self.operator_input.error or bool(self.problem),
        )
        self.operator_input = self.operator_input._replace(stop=stop, error=error)
        frame = self._gate(wanted, counts, line.note(self.operator_input.pack()))
        problem, self.problem = self.problem, ""
        self._speak(frame)
        self._remember(problem)
        with self.catch_errors():
            if (
                not (self.operator_input.enable or self.gate.driving)
                and (self.nodes.nmt != OPERATIONAL).any()
            ):
                line.send(
                    bus.NMT, bytes([1, 0])
                )  # nodes fell back; not while the operator holds the switch
            line.flush()
        return not self.operator_input.stop

    def run(self, show: Callable[[str], object] = lambda text: None) -> None:
        """Tick until the operator, SIGINT or SIGTERM stops it; the last frame is neutral whatever happens."""
        gc.freeze()  # what is there now stays: no long collection in the middle of a tick
        try:
            with bus.stop_signals() as self.signals:
                while self.tick():
                    if self.ticks % 5 == 0:
                        show(self.status())
        except BaseException:
            self.problem = "the loop ended"
            counts = encoder_counts(self.machine, self.nodes.raw)
            self._speak(self._gate(np.zeros(self.machine.n), counts, self.line.now()))
            raise

    @property
    def measured(self) -> Array:
        """Newest angles [rad] and rates [rad/s], (2, n); nan: unknown."""
        return (
            np.full((2, self.machine.n), np.nan)
            if self.history is None
            else self.history[0, :, :2, -1].T
        )

    def status(self) -> str:
        """One line: state, faults, tool velocity wanted and measured [m/s], angles [rad], lateness."""
        state = "driving" if self.gate.driving else "waiting" if self.gate.active_fault else "ready"
        q, q_dot = self.measured
        v = tool_velocity(forward_kinematics(self.machine, q), q_dot)
        want, have, pose = (
            " ".join(f"{x:+.2f}" for x in a) for a in (self.operator_input.v_goal, v, q)
        )
        late = f"late {1e3 * self.lateness:.1f} ms, skipped {self.skipped}"
        reason = f" {self.reason}" if self.reason else ""
        return f"{state:7}{reason} v wanted {want} is {have} q {pose} {late}"

    @contextmanager
    def catch_errors(self) -> Iterator[None]:
        """Whatever is raised inside becomes the gate's business."""
        try:
            yield
        except Exception as error:
            self.problem = f"{type(error).__name__}: {error}"

    def _listen(self, end: float, awake: float = 0.0, until_complete: bool = False) -> None:
        """Read until `end` and until the bus is empty, or until every encoder was heard."""
        for _ in range(MAX_FRAMES):
            if until_complete and (self.nodes.frames > 0).all():
                return
            frame = self.line.recv(max(0.0, end - self.line.now()), awake)
            if frame is None:
                return
            self.nodes.update(frame)
        raise OverflowError(f"bus: expected fewer than {MAX_FRAMES} frames in a row, got more")

    def _wait(self) -> None:
        """Listen and rehearse until the deadline."""
        line = self.line
        end = min(self.deadline, line.now() + self.machine.dt)  # the clock may have gone backwards
        with self.catch_errors():
            self._listen(end - AWAKE)
            line.rest(max(0.0, end - AWAKE - line.now()))
            self._rehearse(end)
            self._listen(end, AWAKE)
        line.rest(max(0.0, end - line.now()))  # a broken bus does not wait
        self._next_deadline()

    def _next_deadline(self) -> None:
        """The next deadline in the future on the same grid; a new grid if the clock went backwards."""
        now = self.line.now()
        self.lateness = now - self.deadline
        if self.lateness < -0.5 * self.machine.dt:
            self.begun, self.number = now, 0
        missed = max(0, int(self.lateness // self.machine.dt))
        if missed:
            self.history = None  # its samples are a tick apart
        self.skipped += missed
        self.number += 1 + missed
        self.ticks += 1

    def _control(self, counts: Array) -> Array:
        """What the controller wants [counts of 127] (n,) at angles `counts` [encoder counts]."""
        m = self.machine
        if (self.nodes.frames != 1).any():
            self.history = None  # a gap: what came before it no longer joins what comes after
            return np.zeros(m.n)
        q = (
            counts[None].astype(np.float32) * m.encoder_step
        )  # as `read_encoder` gives in the simulation
        if self.history is None:
            self.history = initial_history(q, m.history)
        else:
            sent = self.gate.sent[..., -1] / PWM_MAX
            self.history, self.error_integral = update_history(
                m, self.history, sent, q, self.v_goal, self.error_integral
            )
        if not self.gate.driving:
            self.memory, self.error_integral = (
                self.controller.start(1),
                np.zeros((1, 3), np.float32),
            )
        self.v_goal = np.array([self.operator_input.v_goal], np.float32)
        measured = measure(m, self.history, self.v_goal, self.error_integral)
        u, self.memory = self.controller(measured, self.memory)
        return np.asarray(np.rint(u[0] * PWM_MAX), float)

    def _rehearse(self, end: float) -> None:
        """Let twins compute the next tick for nothing while there is time; after sleep the first is slow."""
        nodes = copy(self.nodes)
        nodes.frames = np.ones_like(nodes.frames)
        for _ in range(REHEARSALS):
            if self.history is None or self.line.now() >= end:
                break
            twin = copy(self)
            twin.nodes, counts = nodes, encoder_counts(self.machine, nodes.raw)
            twin._gate(twin._control(counts), counts, self.line.now())

    def _gate(self, wanted: Array, counts: Array, now: float) -> bytes:
        """Pass the gate with what this tick knows; the valve frame."""
        nodes, wish = self.nodes, self.operator_input
        error = wish.error or bool(self.problem)
        flags = np.array([wish.enable, not any(wish.v_goal), wish.alive, wish.stop, error])
        inputs = GateInputs(wanted, counts, nodes.frames, nodes.beat, nodes.nmt, *flags)
        self.gate, frame = gate(self.machine, self.gate, inputs, now)
        return frame.tobytes()

    def _remember(self, problem: str) -> None:
        """What was sent and what is wrong; forget what this tick heard."""
        stopped, wrong = (
            fault_name(self.machine, int(f))
            for f in (self.gate.latched_fault, self.gate.active_fault)
        )
        self.reason = f"fault: {stopped}" if stopped else wrong
        self.remark = "" if self.gate.driving else problem or self.remark
        self.reason += f" ({self.remark})" if self.remark else ""
        self.nodes.frames[:] = 0

    def _speak(self, frame: bytes) -> None:
        """Send the valve frame, once the gate was armed."""
        with self.catch_errors():
            if self.gate.armed_once:
                self.line.send(self.machine.valve_frame_id, frame)
