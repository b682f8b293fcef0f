"""A machine to try the hardware path on: CANopen encoders and a valve controller, the analytic plant behind.

It plays the part of a real Brokk on the bus; the program that drives it cannot tell.
"""

import gc
import os
import struct
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from brokk_min.actuator import plant_reset, plant_step
from brokk_min.can import canopen as bus
from brokk_min.can.canopen import OPERATIONAL, Array, checksum, encoder_raw
from brokk_min.machine import BROKK_170, Machine, decode_pwm

BOOT, STOPPED, PRE_OPERATIONAL = 0, 4, 127  # CANopen states beside OPERATIONAL
START = (0.0, 0.5, 0.58, 1.71, 1.24)  # rad, the paper's start pose, pointing forward
WATCHDOG = 0.150  # s without valid valve frame, then the valves go neutral (assumed)


class SimulatedMachine:
    """CiA 406 encoders and a valve controller on one bus, the analytic plant behind them.

    The plant moves by its own clock. The valves go neutral if no valid valve frame comes for `WATCHDOG`, or
    one with a wrong counter, checksum or length; they stay so until an NMT start and then a neutral frame.

    Args:
        machine: what moves.
        q: angles at the start [rad], (n,).
        now: s.
        record: called every plant step with time [s], command in force and true angles [rad] (n,), and the
            time of the last valid valve frame [s].
    """

    def __init__(
        self,
        machine: Machine,
        q: ArrayLike,
        now: float,
        record: Callable[[float, Array, Array, float], object] = lambda *_: None,
    ) -> None:
        self.machine, self.record = machine, record
        self.fine = replace(
            machine, rate=1 / machine.plant_dt
        )  # the same plant, a tick is one Euler step
        self.plant, self.u = plant_reset(self.fine, q), np.zeros(machine.n)
        self.start, self.steps, self.beats = now, 0, 0
        self.encoders = [joint.encoder_node for joint in machine.joints]
        self.nmt = dict.fromkeys([*self.encoders, machine.controller_node], PRE_OPERATIONAL)
        self.valid, self.counter = now, -1
        self.enabled = (
            False  # by a neutral frame with the enable byte set, until the byte is cleared
        )
        known = {bus.BEAT_OBJECT: round(1e3 * bus.BEAT), bus.SYNC_OBJECT: 1, (0x1000, 0): 406}
        known |= {bus.RESOLUTION_OBJECT: 2**machine.encoder_bits}
        self.objects = {
            (node, *where): value for node in self.encoders for where, value in known.items()
        }

    def boot(self) -> list[tuple[int, bytes]]:
        """What the nodes say when switched on."""
        return [(bus.HEARTBEAT + node, bytes([BOOT])) for node in self.nmt]

    def wait(self, now: float) -> float:
        """Seconds until something happens by itself."""
        return max(0.0, self.start + (self.steps + 1) * self.machine.plant_dt - now)

    def advance(self, now: float) -> list[tuple[int, bytes]]:
        """Move plant, watchdog and heartbeats on to `now` [s]; frames to send."""
        out = []
        while (then := self.start + (self.steps + 1) * self.machine.plant_dt) <= now:
            if self.enabled and then - self.valid >= WATCHDOG:
                self._trip()
            self.plant = plant_step(self.fine, self.plant, self.u)
            self.steps += 1
            self.record(then, self.u, self.plant.q, self.valid)
            if then >= self.start + (self.beats + 1) * bus.BEAT:
                self.beats += 1
                out += [(bus.HEARTBEAT + node, bytes([state])) for node, state in self.nmt.items()]
        return out

    def receive(self, frame: bus.Frame) -> list[tuple[int, bytes]]:
        """Take in one frame; frames to answer with."""
        node = frame.id - bus.SDO_REQUEST
        if frame.id == bus.NMT and len(frame.data) == 2:
            return self._on_nmt(*frame.data)
        if frame.id == bus.SYNC:
            raw = encoder_raw(
                self.machine, np.rint(self.plant.q / self.machine.encoder_step).astype(int)
            )
            pairs = zip(self.encoders, raw.tolist(), strict=True)
            return [
                (bus.TPDO1 + e, struct.pack("<I", r))
                for e, r in pairs
                if self.nmt[e] == OPERATIONAL
            ]
        if frame.id == self.machine.valve_frame_id:
            self._on_valve_frame(frame)
        elif node in self.encoders and len(frame.data) == 8:
            return [(bus.SDO_ANSWER + node, self._on_sdo(node, frame.data))]
        return []

    def _on_nmt(self, command: int, node: int) -> list[tuple[int, bytes]]:
        states = {1: OPERATIONAL, 2: STOPPED} | dict.fromkeys((128, 129, 130), PRE_OPERATIONAL)
        touched = [n for n in self.nmt if node in (0, n)] if command in states else []
        for n in touched:
            self.nmt[n] = states[command]
        if self.nmt[self.machine.controller_node] != OPERATIONAL or not self.enabled:
            self._neutral()
        return [(bus.HEARTBEAT + n, bytes([BOOT])) for n in touched if command > 128]

    def _on_valve_frame(self, frame: bus.Frame) -> None:
        data = np.frombuffer(frame.data, np.uint8)
        if len(data) != 8 or checksum(np.delete(data, 6)) != data[6]:
            self._trip()
            return
        in_turn = self.counter in (-1, (int(data[5]) - 1) % 256)
        self.counter, self.valid = int(data[5]), frame.time
        if not in_turn:
            self._trip()
        elif self.nmt[self.machine.controller_node] == OPERATIONAL:
            u = decode_pwm(data[: self.machine.n])
            self.enabled = data[7] == 1 and (self.enabled or not u.any())
            self.u = u * self.enabled

    def _neutral(self) -> None:
        self.u, self.enabled = np.zeros(self.machine.n), False
        self.counter = -1  # the next frame may start anywhere: a new program does

    def _trip(self) -> None:
        self._neutral()
        self.nmt[self.machine.controller_node] = PRE_OPERATIONAL

    def _on_sdo(self, node: int, data: bytes) -> bytes:
        command, index, sub, value = struct.unpack("<BHBI", data)
        if (node, index, sub) not in self.objects:
            return struct.pack("<BHBI", 0x80, index, sub, 0x06020000)  # no such object
        if command == 0x40:
            return struct.pack("<BHBI", 0x43, index, sub, self.objects[node, index, sub])
        if command & 0xE3 == 0x23 and (index, sub) in (bus.BEAT_OBJECT, bus.SYNC_OBJECT):
            self.objects[node, index, sub] = value
            return struct.pack("<BHBI", 0x60, index, sub, 0)
        return struct.pack("<BHBI", 0x80, index, sub, 0x06010000)  # no such access


def serve(machine: SimulatedMachine, line: Any, running: Callable[[], bool]) -> None:
    """Keep a simulated machine on the bus while `running`."""
    for can_id, data in machine.boot():
        line.send(can_id, data)
    while running():
        frame = line.recv(machine.wait(line.now()))
        answers = machine.advance(line.now())
        answers += machine.receive(frame) if frame else []
        for can_id, data in answers:
            line.send(can_id, data)


def start_pose(machine: Machine, given: Sequence[float]) -> Array:
    """Angles at the start [rad] (n,): those given, or else the Brokk's `START`, or amid another's ranges.

    ValueError: a pose that the machine cannot take.
    """
    low, high = machine.column("q_min"), machine.column("q_max")
    q = np.array(given or (START if machine == BROKK_170 else (low + high) / 2), float)
    if q.shape != (machine.n,) or not ((low <= q) & (q <= high)).all():
        raise ValueError(
            f"start: expected {machine.n} angles within the joints' ranges, got {q.tolist()}"
        )
    return q


def simulate(
    machine: Machine, q: Sequence[float], interface: str, channel: str, record: Path | None = None
) -> None:
    """Run a simulated machine on a bus until SIGINT or SIGTERM; `record` gets a log of all its Euler steps.

    It starts at `start_pose(machine, q)`. ValueError: no such bus, or no such pose.
    """
    pose = start_pose(machine, q)
    gc.freeze()  # no long collection while the encoders should answer
    with ExitStack() as stack:
        line = stack.enter_context(bus.open_bus(interface, channel))
        file = stack.enter_context(open(record or os.devnull, "w", buffering=1))
        ended = stack.enter_context(bus.stop_signals())
        start = line.now()
        names = [f"{kind}_{name}" for kind in "uq" for name in machine.names]
        print("run", "time", *names, "valid", sep=",", file=file)

        def write(now: float, u: Array, q: Array, valid: float) -> None:
            numbers = [*(f"{x:.7g}" for x in (*u, *q)), f"{valid - start:.6f}"]
            print("plant", f"{now - start:.3f}", *numbers, sep=",", file=file)

        serve(SimulatedMachine(machine, pose, start, write), line, lambda: not ended)
