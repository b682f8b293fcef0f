"""The 20 Hz loop in a process of its own, so that drawing a window never delays it.

A pipe carries the window's requests to the loop and telemetry back. The loop is `hw.Drive` with
its gate; a window that is silent counts as a lost input device.
"""

import multiprocessing
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from brokk_min.can.canopen import OperatorInput, used_ids
from brokk_min.can.connection import lock_memory, open_bus
from brokk_min.can.drive_log import Telemetry
from brokk_min.env import Measured, action_to_pwm
from brokk_min.evaluation.rollout import Controller
from brokk_min.hw import Drive
from brokk_min.machine import PWM_MAX, Array, Machine

SILENCE = 0.2  # s without a request, then the input device is lost (assumed)


@dataclass(frozen=True)
class BusOptions:
    """The bus to drive on; without an interface, a simulated machine, see `lockstep`."""

    interface: str = ""
    channel: str = ""
    log: Path | None = None
    start: tuple[float, ...] = ()  # of the simulated machine [rad], see `start_pose`


class Request(NamedTuple):
    """Input of the operator at the window."""

    time: float  # of the window's monotonic clock [s]
    mode: int  # index of the controller; the last one is the levers
    enable: bool  # dead-man switch
    alive: bool  # is the input device there?
    v_goal: Array  # m/s (3,)
    levers: Array  # actions of the driven joints, in [-1, 1]


@dataclass
class WindowInput:
    """What the window asks of the loop by its newest request: goals, and which controller."""

    machine: Machine
    controllers: Sequence[Controller]  # by mode; the last mode is the levers
    connection: Any  # to the window; once it is closed, the loop stops
    clock: Callable[[], float] = time.monotonic  # of the requests [s]

    def __post_init__(self) -> None:
        none = np.zeros(len(self.machine.driven))
        self.request = Request(-np.inf, 0, False, False, np.zeros(3), none)

    @property
    def silent(self) -> bool:
        """Has there been no request for `SILENCE`?"""
        return self.clock() - self.request.time > SILENCE

    def operator(self, driving: bool, ready: bool) -> OperatorInput:
        """The operator's input in this tick."""
        try:
            while self.connection.poll():
                self.request = self.connection.recv()
        except (EOFError, OSError):
            return OperatorInput(stop=True)
        if self.silent:
            return OperatorInput(alive=False)
        x, y, z = self.request.v_goal.tolist()
        return OperatorInput((x, y, z), self.request.enable, self.request.alive)

    def start(self, num: int) -> tuple[int, Any]:
        """Mode, and the state of its controller at rest."""
        mode = self.request.mode
        levers = mode == len(self.controllers)
        return mode, None if levers else self.controllers[mode].start(num)

    def __call__(self, measured: Measured, state: tuple[int, Any]) -> tuple[Array, tuple[int, Any]]:
        """Commands u (num, n) of the selected controller, and the state of the next tick."""
        num = len(measured.q)
        mode, inner = state if state[0] == self.request.mode else self.start(num)
        if mode == len(self.controllers):
            u = np.tile(action_to_pwm(self.machine, self.request.levers), (num, 1))
        else:
            u, inner = self.controllers[mode](measured, inner)
        return u, (mode, inner)


class WindowDrive(Drive):
    """The 20 Hz loop under a window, to which telemetry goes after each tick."""

    def __init__(self, window: WindowInput, bus: Any) -> None:
        super().__init__(window.machine, window, bus, window.operator)
        self.window = window

    def tick(self) -> bool:
        """One tick; a window that is silent gets nothing, because a full pipe would block."""
        more = super().tick()
        with self.catch_errors():
            if more and not self.window.silent:
                self.window.connection.send(self.telemetry())
        return more

    def telemetry(self) -> Telemetry:
        """State after a tick."""
        q, q_dot = self.measured
        gate = self.gate
        u = gate.sent[..., -1] / PWM_MAX
        v_goal = np.array(self.operator_input.v_goal)
        flags = (bool(gate.driving), int(gate.active_fault), int(gate.latched_fault))
        mode = self.window.request.mode
        return Telemetry(self.ticks, q, q_dot, u, v_goal, *flags, mode, self.lateness)


def control(
    machine: Machine, controllers: Sequence[Controller], options: BusOptions, connection: Any
) -> None:
    """Drive until the window closes the pipe; errors go through it as text."""
    lock_memory()
    where = (options.interface, options.channel, options.log, used_ids(machine))
    try:
        with open_bus(*where) as bus:
            drive = WindowDrive(WindowInput(machine, controllers, connection), bus)
            drive.begin()
            connection.send(drive.telemetry())  # from now on the window sends requests
            drive.run()
    except Exception as error:
        text = str(error) if isinstance(error, ValueError) else f"{type(error).__name__}: {error}"
        with suppress(OSError):
            connection.send(text)


@contextmanager
def start(
    machine: Machine, controllers: Sequence[Controller], options: BusOptions
) -> Iterator[Connection]:
    """`control` in a process of its own, at the other end of this pipe; ends with the block."""
    context = multiprocessing.get_context("spawn")
    window_end, loop_end = context.Pipe()
    process = context.Process(
        target=control, args=(machine, controllers, options, loop_end), daemon=True
    )
    process.start()
    loop_end.close()
    try:
        yield window_end
    finally:
        window_end.close()
        process.join(3)
        process.terminate()


def receive_telemetry(connection: Any) -> Iterator[Telemetry]:
    """Telemetry that has come through the pipe; ValueError: the loop ended, and why."""
    try:
        while connection.poll():
            message = connection.recv()
            if isinstance(message, str):
                raise ValueError(f"play: expected a loop that runs, got {message}")
            yield message
    except (EOFError, OSError) as error:
        raise ValueError("play: expected a loop that runs, got its sudden end") from error


def send_request(connection: Any, request: Request) -> None:
    """Send what the operator asks for; `receive_telemetry` reports a loop that has ended."""
    with suppress(OSError):
        connection.send(request)
