"""A simulated machine on a bus; the program that drives it cannot tell it from a real one."""

import gc
import struct
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from brokk_min.actuator import PLANT, Plant
from brokk_min.can import canopen
from brokk_min.can.canopen import OPERATIONAL, WATCHDOG, Frame, checksum
from brokk_min.can.connection import open_bus, stop_signals
from brokk_min.machine import Array, Machine

STEP = 0.005  # s, of watchdog, heartbeats and the analytic plant
PRE_OPERATIONAL = 127  # NMT state after each NMT command but the start
Outgoing = list[tuple[int, bytes]]  # identifiers and data


class SimulatedMachine:
    """CiA 406 encoders, a valve controller by the rules of docs/hardware.md, and a plant.

    It starts at angles `q` [rad] (n,) at the time `now` [s]. A plant makes a step every `period`
    [s]; one whose step is a tick makes it with the SYNC, so that a command holds from one to the
    next. ValueError: see `canopen.check_bus`.
    """

    def __init__(
        self, machine: Machine, q: ArrayLike, now: float, plant: Plant = PLANT, period: float = STEP
    ) -> None:
        canopen.check_bus(machine)
        self.machine, self.plant, self.period = machine, plant, period
        self.stepped = replace(machine, rate=1 / period)  # of which a tick is one step
        self.state = plant.reset(self.stepped, np.array(q, float))
        self.start = now
        self.moves = now + period  # time of the plant's next step
        self.steps = self.heartbeats = 0
        *self.encoders, self.controller = canopen.node_numbers(machine)
        self.nmt = dict.fromkeys([*self.encoders, self.controller], PRE_OPERATIONAL)
        self.valid = now  # time of the last valid valve frame
        self.reasons: list[str] = []  # why the valve controller stopped
        self.waiting = False  # for a valve frame, since the last SYNC
        self._close_valves()

    def _close_valves(self) -> None:
        self.u: Array = np.zeros(self.machine.n)
        self.enabled = False  # by a neutral frame with the enable byte, until the byte is cleared
        self.counter: int | None = None  # of the last valve frame; after None any may come

    @property
    def next_step(self) -> float:
        """Time of the next look at watchdog, heartbeats and plant [s]."""
        return self.start + (self.steps + 1) * STEP

    def advance(self, now: float) -> Outgoing:
        """Move plant, watchdog and heartbeats on to `now` [s]; frames to send."""
        out: Outgoing = []
        while (then := self.next_step) <= now:
            if self.enabled and then - self.valid >= WATCHDOG:
                self._trip(f"no valve frame for {WATCHDOG} s")
            if then > self.moves - STEP / 2:
                self._move()
            self.steps += 1
            if then >= self.start + (self.heartbeats + 1) * canopen.HEARTBEAT_PERIOD:
                self.heartbeats += 1
                out += [(canopen.HEARTBEAT + node, bytes([x])) for node, x in self.nmt.items()]
        return out

    def _move(self) -> None:
        self.state = self.plant.step(self.stepped, self.state, self.u)
        self.moves += self.period

    def receive(self, frame: Frame) -> Outgoing:
        """Take in one frame; frames to answer with."""
        node = frame.id - canopen.SDO_REQUEST
        if frame.id == canopen.SYNC:
            if self.period > STEP:
                if frame.time > self.moves - self.period / 2:
                    self._move()
                self.moves = frame.time + self.period
            if self.enabled and self.waiting:
                self._trip("no valve frame between two SYNCs")
            self.waiting = True
            return self._positions()
        if frame.id == canopen.NMT and len(frame.data) == 2:
            self._on_nmt(*frame.data)
        elif frame.id == self.machine.valve_frame_id:
            self._on_valve_frame(frame)
        elif node in self.encoders and len(frame.data) == 8:
            return [(canopen.SDO_ANSWER + node, self._on_sdo(node, frame.data))]
        return []

    def _positions(self) -> Outgoing:
        counts = np.rint(np.asarray(self.state.q) / self.machine.encoder_step).astype(int)
        raw = zip(self.encoders, canopen.encoder_raw(self.machine, counts).astype("<u4"))
        return [(canopen.TPDO1 + i, x.tobytes()) for i, x in raw if self.nmt[i] == OPERATIONAL]

    def _on_nmt(self, command: int, node: int) -> None:
        for n in self.nmt:
            if node in (0, n):
                self.nmt[n] = OPERATIONAL if command == 1 else PRE_OPERATIONAL
        if self.nmt[self.controller] != OPERATIONAL or not self.enabled:
            self._close_valves()

    def _on_valve_frame(self, frame: Frame) -> None:
        data = np.frombuffer(frame.data, np.uint8)
        if len(data) != 8 or checksum(np.delete(data, 6)) != data[6]:
            self._trip("valve frame with a wrong length or checksum")
            return
        counter, before, first = int(data[5]), self.counter, self.waiting
        self.counter, self.waiting, self.valid = counter, False, frame.time
        if before not in (None, (counter - 1) % 256):
            self._trip(f"valve frame with counter {counter} after {before}")
        elif not first:
            self._trip(f"second valve frame after a SYNC, counter {counter}")
        elif self.nmt[self.controller] == OPERATIONAL:
            u, enable = canopen.read_valve_frame(self.machine, frame.data)
            self.enabled = enable and (self.enabled or not u.any())
            self.u = u * self.enabled

    def _trip(self, reason: str) -> None:
        if self.nmt[self.controller] == OPERATIONAL:
            self.reasons.append(reason)
        self._close_valves()
        self.nmt[self.controller] = PRE_OPERATIONAL

    def _on_sdo(self, node: int, data: bytes) -> bytes:
        """Objects are read; what is written has its fixed value already."""
        command, index, sub, _ = struct.unpack("<BHBI", data)
        value, _ = canopen.encoder_objects(self.machine, node).get((index, sub), (0, ""))
        return struct.pack("<BHBI", 0x43 if command == 0x40 else 0x60, index, sub, value)


def start_pose(machine: Machine) -> Array:
    """Angles at the start [rad] (n,): `q_start` with the first joint forward, else mid-range."""
    if machine.q_start:
        return np.array([0.0, *machine.q_start[1:]])
    return (machine.column("q_min") + machine.column("q_max")) / 2


def run_machine(machine: Machine, interface: str, channel: str, plant: Plant = PLANT) -> None:
    """Run a simulated machine on a bus until a signal; it prints why its valve controller stops."""
    gc.freeze()  # no long garbage collection while the encoders should answer
    with open_bus(interface, channel) as bus, stop_signals() as signals:
        period = STEP if plant is PLANT else machine.dt
        simulated = SimulatedMachine(machine, start_pose(machine), bus.now(), plant, period)
        while not signals:
            frame = bus.recv(max(0.0, simulated.next_step - bus.now()))
            answers = simulated.advance(bus.now())
            answers += simulated.receive(frame) if frame else []
            for can_id, data in answers:
                bus.send(can_id, data)
            while simulated.reasons:
                time, reason = bus.now() - simulated.start, simulated.reasons.pop(0)
                print(f"{time:.3f} s, valve controller stops: {reason}", flush=True)
