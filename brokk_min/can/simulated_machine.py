"""A simulated machine on a bus; the program that drives it cannot tell it from a real one."""

import gc
import struct
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from brokk_min.actuator import PLANT, AnalyticPlant, Plant
from brokk_min.can import canopen
from brokk_min.can.canopen import OPERATIONAL, WATCHDOG, Frame, checksum
from brokk_min.can.connection import Bus, open_bus, stop_signals
from brokk_min.machine import Array, Machine, require

STEP = 0.005  # s, of watchdog, heartbeats and the analytic plant
PRE_OPERATIONAL = 127  # NMT state after each NMT command but the start
Outgoing = list[tuple[int, bytes]]  # identifiers and data


class SimulatedMachine:
    """CiA 406 encoders, a valve controller by the rules of docs/hardware.md, and a plant.

    It starts at angles `q` [rad] (n,) at the time `now` [s]. The analytic plant makes a
    step every `STEP`; another one makes it once a tick, with the SYNC, so that a command holds from
    one to the next. ValueError: see `canopen.check_bus`.
    """

    def __init__(self, machine: Machine, q: ArrayLike, now: float, plant: Plant = PLANT) -> None:
        canopen.check_bus(machine)
        self.machine, self.plant = machine, plant
        self.period = STEP if isinstance(plant, AnalyticPlant) else machine.dt  # s, of its steps
        self.stepped = replace(machine, rate=1 / self.period)  # of which a tick is one step
        self.state = plant.reset(self.stepped, np.array(q, float))
        self.start = now
        self.moves = now + self.period  # time of the plant's next step
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


KINDS = ("off", "stuck", "garbage", "wrong", "slow", "delayed", "intermittent", "ok")
DELAY = 0.025  # s, more than the program waits for positions at 20 Hz
PAUSE = 0.1  # s without frames, then as long with them: an intermittent fault


class Fault(NamedTuple):
    """What a node does from a time on, in the words of PX4's failure injection."""

    node: int
    kind: str  # one of `KINDS`; "ok" ends the fault before
    time: float  # s after the start


def parse_fault(machine: Machine, text: str) -> list[Fault]:
    """Faults of [NAME:]KIND@SECONDS; NAME is a joint, whose encoder fails, or `valves`.

    Without a name all encoders fail. ValueError: there is no such node, kind or time.
    """
    nodes = dict(zip([*machine.names, "valves"], canopen.node_numbers(machine)))
    what, _, seconds = text.partition("@")
    name, colon, kind = what.rpartition(":")
    of = [nodes.get(name, -1)] if colon else [joint.encoder_node for joint in machine.joints]
    known = kind in KINDS and -1 not in of and seconds.replace(".", "", 1).isdecimal()
    wanted = f"[NAME:]KIND@SECONDS, a name of {[*nodes]}, a kind of {[*KINDS]}"
    require(known, "--fault", wanted, text)
    return [Fault(node, kind, float(seconds)) for node in of]


class FaultyMachine(SimulatedMachine):
    """A simulated machine whose nodes fail: frames change on the way from an encoder or to a valve.

    A node that is off sends nothing at all. One that is stuck repeats its last sound frame; garbage
    is random bytes, a wrong frame has one wrong bit, a slow node loses every second frame, delayed
    frames come `DELAY` later, and intermittent ones are lost in every second `PAUSE`.
    """

    def __init__(
        self, machine: Machine, q: ArrayLike, now: float, plant: Plant, faults: list[Fault]
    ) -> None:
        super().__init__(machine, q, now, plant)
        self.faults = faults
        self.last: dict[int, bytes] = {}  # sound data of each node
        self.frames = dict.fromkeys(self.nmt, 0)  # of each node, so far
        self.late: list[tuple[float, int, bytes]] = []  # time to come, node, data
        self.rng = np.random.default_rng(0)

    def advance(self, now: float) -> Outgoing:
        """As of a sound machine; then come frames that were delayed."""
        out = self._without_off(super().advance(now), now)
        due = [frame for frame in self.late if frame[0] <= now]
        self.late = [frame for frame in self.late if frame[0] > now]
        for time, node, data in due:
            if node == self.controller:
                super().receive(Frame(time, self.machine.valve_frame_id, data))
            else:
                out.append((canopen.TPDO1 + node, data))
        return out

    def receive(self, frame: Frame) -> Outgoing:
        """As of a sound machine, but for the frames of nodes that fail."""
        if frame.id == self.machine.valve_frame_id:
            for data in self._through(self.controller, frame.data, frame.time):
                super().receive(frame._replace(data=data))
            return []
        out = super().receive(frame)
        if frame.id == canopen.SYNC:
            changed = [(i, self._through(i - canopen.TPDO1, x, frame.time)) for i, x in out]
            out = [(i, data) for i, frames in changed for data in frames]
        return self._without_off(out, frame.time)

    def _without_off(self, out: Outgoing, now: float) -> Outgoing:
        """Frames of nodes that are not off; the last seven bits of an identifier are the node's."""
        return [frame for frame in out if self._fault(frame[0] % 0x80, now)[0] != "off"]

    def _fault(self, node: int, now: float) -> tuple[str, float]:
        """Kind of the newest fault of a node that has begun, and the time since then [s]."""
        since = now - self.start
        begun = [fault for fault in self.faults if fault.node == node and fault.time <= since]
        newest = max(begun, key=lambda fault: fault.time, default=Fault(node, "ok", 0.0))
        return newest.kind, since - newest.time

    def _through(self, node: int, data: bytes, now: float) -> list[bytes]:
        """What comes of a frame of a node: nothing, or its data, perhaps changed."""
        kind, seconds = self._fault(node, now)
        self.frames[node] += 1
        if kind == "ok":
            self.last[node] = data
        if kind == "delayed":
            self.late.append((now + DELAY, node, data))
        return {
            "ok": [data],
            "off": [],
            "delayed": [],
            "stuck": [self.last.get(node, data)],
            "garbage": [self.rng.bytes(len(data))],
            "wrong": [bytes([data[0] ^ 0x40, *data[1:]])],
            "slow": [data] * (self.frames[node] % 2),
            "intermittent": [data] * int(seconds // PAUSE % 2),
        }[kind]


def start_pose(machine: Machine) -> Array:
    """Angles at the start [rad] (n,): `q_start` with the first joint forward, else mid-range."""
    if machine.q_start:
        return np.array([0.0, *machine.q_start[1:]])
    return (machine.column("q_min") + machine.column("q_max")) / 2


def run_machine(
    machine: Machine, interface: str, channel: str, plant: Plant, faults: list[Fault]
) -> None:
    """Run a simulated machine on a bus until a signal; it says why its valve controller stops."""
    gc.freeze()  # no long garbage collection while the encoders should answer
    with open_bus(interface, channel) as bus, stop_signals() as signals:
        simulated = FaultyMachine(machine, start_pose(machine), bus.now(), plant, faults)
        print(f"{machine.name} on {interface} {channel}; Ctrl-C ends it", flush=True)
        serve(simulated, bus, signals)


def serve(simulated: SimulatedMachine, bus: Bus, ended: Sequence[object]) -> None:
    """Answer on the bus in real time until something is in `ended`."""
    while not ended:
        frame = bus.recv(max(0.0, simulated.next_step - bus.now()))
        answers = simulated.advance(bus.now())
        answers += simulated.receive(frame) if frame else []
        for can_id, data in answers:
            bus.send(can_id, data)
        while simulated.reasons:
            time, reason = bus.now() - simulated.start, simulated.reasons.pop(0)
            print(f"{time:.3f} s, valve controller stops: {reason}", flush=True)
