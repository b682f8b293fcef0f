"""A machine to try the hardware path on: CANopen encoders and a valve controller, a plant behind.

It plays the part of a real Brokk on the bus; the program that drives it cannot tell.
"""

import gc
import struct
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from brokk_min.actuator import PLANT, Plant
from brokk_min.can import canopen
from brokk_min.can.canopen import OPERATIONAL, WATCHDOG, Array, Frame, checksum, encoder_raw
from brokk_min.can.connection import open_bus, stop_signals
from brokk_min.machine import Machine, require

# NMT states besides OPERATIONAL
BOOT = 0
STOPPED = 4
PRE_OPERATIONAL = 127
RESET = 129  # NMT command, which each node answers as after its start
Frames = list[tuple[int, bytes]]  # identifiers and data


class SimulatedMachine:
    """CiA 406 encoders and a valve controller on one bus, and a plant behind them.

    A valve frame is refused if its counter, checksum or length is wrong, or if it is not the first
    since a SYNC. With more than five joints the valves follow once all frames of the tick are
    there. They close on a refused frame, on two SYNCs without all frames between, and after
    `WATCHDOG` without them. They stay closed until an NMT start and neutral frames.
    It starts at angles `q` [rad] (n,) at the time `now` [s]. The plant moves in steps of
    `machine.plant_dt`, by the clock of this machine. `report` gets the reason when the valve
    controller stops. ValueError: the machine does not fit the bus, see `canopen.check_bus`.
    """

    def __init__(
        self,
        machine: Machine,
        q: ArrayLike,
        now: float,
        plant: Plant = PLANT,
        report: Callable[[str], object] = lambda reason: None,
    ) -> None:
        canopen.check_bus(machine)
        self.machine, self.plant, self.report = machine, plant, report
        self.fine = replace(machine, rate=1 / machine.plant_dt)  # of which a tick is one step
        self.state = plant.reset(self.fine, np.array(q, float))
        self.start = now
        self.steps = self.heartbeats = 0
        *self.encoders, self.controller = canopen.node_numbers(machine)
        self.nmt = dict.fromkeys([*self.encoders, self.controller], PRE_OPERATIONAL)
        self.objects: dict[tuple[int, int, int], int] = {}  # by node, index and subindex
        for node in self.encoders:
            self.objects |= {
                (node, *canopen.HEARTBEAT_OBJECT): round(1e3 * canopen.HEARTBEAT_PERIOD),
                (node, *canopen.SYNC_OBJECT): 1,
                (node, *canopen.RESOLUTION_OBJECT): 2**machine.encoder_bits,
            }
        self.received = canopen.ValveFrames(machine)
        self.valid = now  # time at which the last valid valve frames of a tick were there
        self.u: Array = np.zeros(machine.n)
        self.enabled = False  # by a neutral frame with the enable byte, until the byte is cleared
        self.counters: dict[int, int] = {}  # of the last valve frames; without one any may come
        self.missing: set[int] = set()  # valve frames that did not yet come since the last SYNC

    @property
    def next_step(self) -> float:
        """Time of the next plant step [s]."""
        return self.start + (self.steps + 1) * self.machine.plant_dt

    def advance(self, now: float) -> Frames:
        """Move plant, watchdog and heartbeats on to `now` [s]; frames to send."""
        out: Frames = []
        while (then := self.next_step) <= now:
            if self.enabled and then - self.valid >= WATCHDOG:
                self._trip(f"no valve frame for {WATCHDOG} s")
            self.state = self.plant.step(self.fine, self.state, self.u)
            self.steps += 1
            if then >= self.start + (self.heartbeats + 1) * canopen.HEARTBEAT_PERIOD:
                self.heartbeats += 1
                states = self.nmt.items()
                out += [(canopen.HEARTBEAT + node, bytes([state])) for node, state in states]
        return out

    def receive(self, frame: Frame) -> Frames:
        """Take in one frame; frames to answer with."""
        node = frame.id - canopen.SDO_REQUEST
        if frame.id == canopen.NMT and len(frame.data) == 2:
            return self._on_nmt(*frame.data)
        if frame.id == canopen.SYNC:
            if self.enabled and self.missing:
                self._trip("no valve frame between two SYNCs")
            self.missing = set(self.received.ids)
            return self._positions()
        if frame.id in self.received.ids:
            self._on_valve_frame(frame)
        elif node in self.encoders and len(frame.data) == 8:
            return [(canopen.SDO_ANSWER + node, self._on_sdo(node, frame.data))]
        return []

    def _positions(self) -> Frames:
        counts = np.rint(np.asarray(self.state.q) / self.machine.encoder_step).astype(int)
        raw = zip(self.encoders, encoder_raw(self.machine, counts).astype("<u4"))
        return [(canopen.TPDO1 + i, x.tobytes()) for i, x in raw if self.nmt[i] == OPERATIONAL]

    def _on_nmt(self, command: int, node: int) -> Frames:
        states = {1: OPERATIONAL, 2: STOPPED} | dict.fromkeys((128, 129, 130), PRE_OPERATIONAL)
        addressed = [n for n in self.nmt if node in (0, n)] if command in states else []
        self.nmt |= dict.fromkeys(addressed, states.get(command, BOOT))
        if self.nmt[self.controller] != OPERATIONAL or not self.enabled:
            self._close_valves()
        return [(canopen.HEARTBEAT + n, bytes([BOOT])) for n in addressed if command > 128]

    def _on_valve_frame(self, frame: Frame) -> None:
        data = np.frombuffer(frame.data, np.uint8)
        if len(data) != 8 or checksum(np.delete(data, 6)) != data[6]:
            self._trip("valve frame with a wrong length or checksum")
            return
        counter = int(data[5])
        before, self.counters[frame.id] = self.counters.get(frame.id), counter
        first = frame.id in self.missing
        self.missing.discard(frame.id)
        self.received.update(frame)
        if not self.missing:
            self.valid = frame.time
        if before not in (None, (counter - 1) % 256):
            self._trip(f"valve frame with counter {counter} after {before}")
        elif not first:
            self._trip(f"second valve frame after a SYNC, counter {counter}")
        elif not self.missing and self.nmt[self.controller] == OPERATIONAL:
            neutral = not self.received.u.any()
            self.enabled = bool(self.received.enable.all()) and (self.enabled or neutral)
            self.u = self.received.u * self.enabled

    def _close_valves(self) -> None:
        self.u = np.zeros(self.machine.n)
        self.enabled = False
        self.counters = {}

    def _trip(self, reason: str) -> None:
        if self.nmt[self.controller] == OPERATIONAL:
            self.report(reason)
        self._close_valves()
        self.nmt[self.controller] = PRE_OPERATIONAL

    def _on_sdo(self, node: int, data: bytes) -> bytes:
        command, *address, value = struct.unpack("<BHBI", data)
        key = (node, *address)
        answer = 0x80, 0x06020000  # no such object
        if key in self.objects and command == 0x40:
            answer = 0x43, self.objects[key]
        elif key in self.objects and command & 0xE3 == 0x23:
            self.objects[key] = value
            answer = 0x60, 0
        return struct.pack("<BHBI", answer[0], *address, answer[1])


def start_pose(machine: Machine, q: Sequence[float]) -> Array:
    """Angles at the start [rad] (n,): `q`, or by default `q_start` with the first joint forward.

    Without `q_start`, the default is the middle of the ranges. ValueError: no pose of the machine.
    """
    low, high = machine.column("q_min"), machine.column("q_max")
    default = (0.0, *machine.q_start[1:]) if machine.q_start else (low + high) / 2
    pose = np.array(q or default, float)
    fits = pose.shape == (machine.n,) and bool(((low <= pose) & (pose <= high)).all())
    require(fits, "start", f"{machine.n} angles within the joints' ranges", pose.tolist())
    return pose


def simulate(
    machine: Machine, q: Sequence[float], interface: str, channel: str, plant: Plant = PLANT
) -> None:
    """Run a simulated machine on a bus until SIGINT or SIGTERM.

    It starts at `start_pose(machine, q)` and prints why its valve controller stops.
    ValueError: no such bus, or no such pose.
    """
    pose = start_pose(machine, q)
    ids = [canopen.NMT, canopen.SYNC, *canopen.valve_frame_ids(machine)]
    ids += [canopen.SDO_REQUEST + joint.encoder_node for joint in machine.joints]
    gc.freeze()  # no long garbage collection while the encoders should answer
    with open_bus(interface, channel, ids=ids) as bus, stop_signals() as signals:
        start = bus.now()

        def report(reason: str) -> None:
            print(f"{bus.now() - start:.3f} s, valve controller stops: {reason}", flush=True)

        simulated = SimulatedMachine(machine, pose, start, plant, report)
        answers = simulated.receive(Frame(start, canopen.NMT, bytes([RESET, 0])))
        while not signals:
            for can_id, data in answers:
                bus.send(can_id, data)
            frame = bus.recv(max(0.0, simulated.next_step - bus.now()))
            answers = simulated.advance(bus.now())
            answers += simulated.receive(frame) if frame else []
