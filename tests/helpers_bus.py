"""A machine, a bus and a program in one process on one injected clock: nothing waits for real."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import can
import numpy as np

from brokk_min import hw
from brokk_min.can.canopen import Frame, Line
from brokk_min.can.operator_input import OperatorInput
from brokk_min.can.simulated_machine import SimulatedMachine
from brokk_min.evaluation.rollout import Controller
from brokk_min.hw import Drive
from brokk_min.machine import BROKK_170, Machine

hw.REHEARSALS = 1  # nothing cools down on an injected clock
START = (0.0, 0.5, 0.58, 1.71, 1.24)
_channels = itertools.count()
Out = list[tuple[int, bytes]]


class World:
    """A simulated machine and a `Drive` on python-can's virtual bus; time passes while the program waits.

    The bus of the program is this object: it lets the machine live while `recv` waits, and `upward` and
    `downward` may tamper with what machine and program send.
    """

    def __init__(
        self,
        controller: Controller,
        operator: Callable[[bool, bool], OperatorInput],
        machine: Machine = BROKK_170,
        log: Any = None,
        start: tuple[float, ...] = START,
    ) -> None:
        channel = f"world {next(_channels)}"
        self.near, self.far = (can.Bus(channel, interface="virtual") for _ in range(2))
        self.t, self.step, self.offset = (
            0.0,
            0.001,
            0.0,
        )  # the world's clock [s]; how far the program's is off
        self.upward: Callable[[int, bytes], Out] = lambda can_id, data: [(can_id, data)]
        self.downward = self.upward
        self.noise: Callable[[], Out] = list  # foreign frames of the next millisecond
        self.record: list[tuple[float, np.ndarray, np.ndarray, float]] = []
        self.syncs: list[float] = []
        self.simulated = SimulatedMachine(machine, start, 0.0, lambda *row: self.record.append(row))
        self.line = Line(self, log, clock=lambda: self.t + self.offset, rest=self.rest)
        self.line.start = 1.8e9  # s; a fixed time of day, so that roundings repeat themselves
        self.drive = Drive(machine, controller, self.line, operator)
        self.say(self.simulated.boot())

    def fileno(self) -> int:
        raise NotImplementedError

    def send(self, message: can.Message, timeout: float | None = None) -> None:
        for can_id, data in self.downward(message.arbitration_id, bytes(message.data)):
            self.near.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))
        self.live()

    def recv(self, timeout: float) -> can.Message | None:
        end = self.t + timeout
        while (message := self.near.recv(0)) is None and self.t < end:
            self.t = min(end, self.t + self.step)
            self.live()
        return message

    def rest(self, seconds: float) -> None:
        end = self.t + seconds
        while self.t < end:
            self.t = min(end, self.t + self.step)
            self.live()

    def live(self) -> None:
        """The machine's side up to now."""
        self.say(self.simulated.advance(self.t))
        for can_id, data in self.noise():
            self.far.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))
            self.say(self.simulated.receive(Frame(self.t, can_id, data)))
        while (message := self.far.recv(0)) is not None:
            if message.arbitration_id == 0x080:
                self.syncs.append(self.t)
            self.say(
                self.simulated.receive(Frame(self.t, message.arbitration_id, bytes(message.data)))
            )

    def say(self, frames: Out) -> None:
        for frame in frames:
            for can_id, data in self.upward(*frame):
                self.far.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))

    def run(self, seconds: float) -> None:
        end = self.t + seconds
        while self.t < end and self.drive.tick():
            pass

    def close(self) -> None:
        self.near.shutdown()
        self.far.shutdown()

    def shutdown(self) -> None:
        self.near.shutdown()

    @property
    def commands(self) -> tuple[np.ndarray, np.ndarray]:
        """Times [s] and commands in force at the valves in counts (T, n), by the plant's own record."""
        times, u, *_ = zip(*self.record, strict=True)
        return np.array(times), np.rint(np.array(u) * 127).astype(int)


class Push:
    """A controller that gives constant commands [counts] and does as it is told."""

    def __init__(self, *m: float) -> None:
        self.m = np.array(m, float)
        self.act: Callable[[], object] = lambda: None

    def start(self, num: int) -> None:
        return None

    def __call__(self, observation: np.ndarray, memory: None) -> tuple[np.ndarray, None]:
        self.act()
        return self.m[None] / 127, None


class Hand:
    """An operator who presses as soon as he may, then asks for motion; what he does can be set."""

    def __init__(self) -> None:
        self.enable: bool | None = None  # None: pressed when ready, and held from then on
        self.alive, self.stop, self.v = True, False, (0.1, 0.0, 0.0)
        self.pressed = False
        self.act: Callable[[], object] = lambda: None

    def __call__(self, driving: bool, ready: bool) -> OperatorInput:
        self.act()
        self.pressed = self.pressed or ready
        enable = self.pressed if self.enable is None else self.enable
        v = self.v if driving else (0.0, 0.0, 0.0)
        return OperatorInput(v, enable=enable and self.alive, alive=self.alive, stop=self.stop)
