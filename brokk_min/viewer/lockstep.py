"""The 20 Hz loop and a simulated machine in lockstep, in the process of the window.

The clock of both stands still while anything computes: on a busy computer the machine moves slower
than life, and nothing depends on timing.
"""

import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from multiprocessing import Pipe
from pathlib import Path
from typing import Any

import numpy as np

from brokk_min.can.canopen import Frame
from brokk_min.can.connection import Bus
from brokk_min.can.drive_log import Telemetry
from brokk_min.can.operator_input import Script
from brokk_min.can.simulated_machine import SimulatedMachine
from brokk_min.evaluation.rollout import Controller
from brokk_min.hw import Drive
from brokk_min.identification.files import require
from brokk_min.machine import Array, Machine
from brokk_min.viewer.control_process import WindowDrive, WindowInput, receive_telemetry

MOST_TICKS = 2  # for one picture; a window with fewer pictures a second than 10 is in slow motion
START = 0.2  # s that the machine was on before: its nodes have been heard (assumed)
REST = 1.0  # s before and after a line that controllers trace (assumed)


class SimulatedBus:
    """A simulated machine in place of a bus of python-can; time passes while somebody waits."""

    def __init__(self, machine: Machine, q: Array) -> None:
        self.time = 0.0  # s
        self.step = machine.plant_dt
        self.message = require("can", "play").Message
        # no plant step when the loop ticks: rounded times would decide which of them is first
        self.simulated = SimulatedMachine(machine, q, self.time - 0.5 * self.step)
        self.answers = deque(self.simulated.boot())

    def open(self, log: Path | None = None) -> Bus:
        """The bus for `Drive`, with a log."""
        writer = require("can", "play").CanutilsLogWriter(log) if log else None
        return Bus(self, writer, "virtual", clock=lambda: self.time, sleep=self.sleep)

    def send(self, message: Any, timeout: float) -> None:
        """The machine takes in a frame at once."""
        frame = Frame(self.time, message.arbitration_id, bytes(message.data))
        self.answers += self.simulated.receive(frame)

    def recv(self, timeout: float) -> Any:
        """The next frame of the machine within `timeout` [s], or None."""
        end = self.time + timeout
        while not self.answers and self.time < end:
            self.sleep(min(self.step, end - self.time))
        if not self.answers:
            return None
        can_id, data = self.answers.popleft()
        return self.message(arbitration_id=can_id, data=data, is_extended_id=False)

    def sleep(self, seconds: float) -> None:
        """The machine moves on [s]."""
        self.time += seconds
        self.answers += self.simulated.advance(self.time)

    def shutdown(self) -> None:
        """Nothing to close."""


@dataclass
class Lockstep:
    """A window's loop and a simulated machine: `receive` makes the ticks that are due."""

    machine: Machine
    controllers: Sequence[Controller]  # see `WindowInput`
    start: Array  # first angles [rad] (n,)
    log: Path | None = None  # of all frames
    clock: Callable[[], float] = time.monotonic  # of the window [s]

    def __post_init__(self) -> None:
        self.connection, loop_end = Pipe()
        window = WindowInput(
            self.machine, self.controllers, loop_end, lambda: -np.inf
        )  # no silence
        self.drive = WindowDrive(window, SimulatedBus(self.machine, self.start).open(self.log))
        self.drive.begin()
        window.request = window.request._replace(alive=True)
        for _ in range(round(START * self.machine.rate)):
            self.drive.tick()
        self.due = self.clock()  # s, of the next tick
        self.late = 0.0  # s behind the window's clock

    def receive(self) -> Iterator[Telemetry]:
        """Telemetry of the ticks that were due, `MOST_TICKS` at most, with how late they are."""
        for _ in range(MOST_TICKS):
            if self.clock() >= self.due:
                self.due += self.machine.dt
                self.drive.tick()
        lost = max(0.0, self.clock() - self.due)
        self.late += lost
        self.due += lost
        for telemetry in receive_telemetry(self.connection):
            yield telemetry._replace(lateness=self.late)

    def close(self) -> None:
        """A last tick, with closed valves."""
        self.connection.close()
        self.drive.tick()
        self.drive.bus.close()


def line_goals(machine: Machine, line: Array) -> Array:
    """Goal velocities [m/s] (T, 3) along a line through points [m] (K, 3), at half the tool speed.

    There are rests before and after it.
    """
    rest = np.zeros((round(REST * machine.rate), 3))
    goals = [rest]
    for step in np.diff(line, axis=0):
        ticks = max(1, round(float(np.linalg.norm(step)) / (0.5 * machine.tool_speed * machine.dt)))
        goals.append(np.tile(step / (ticks * machine.dt), (ticks, 1)))
    return np.vstack([*goals, rest])


def follow(machine: Machine, controller: Controller, q: Array, goals: Array) -> Iterator[Array]:
    """True angles [rad] (n,) at each tick of a drive along goals [m/s] (T, 3), from `q` [rad]."""
    raw = SimulatedBus(machine, q)
    drive = Drive(machine, controller, raw.open(), Script(machine, goals))
    drive.begin()
    while drive.tick():
        yield raw.simulated.plant.q


def compare(
    machine: Machine, controllers: Mapping[str, Controller], q: Array, line: Array
) -> Iterator[dict[str, Array]]:
    """True angles [rad] (n,) by controller, from the start on and tick by tick without end.

    From the pose `q` [rad] all trace the line through points [m] (K, 3), and nobody steers; then
    they stand still.
    """
    goals = line_goals(machine, line)
    runs = {name: follow(machine, c, q, goals) for name, c in controllers.items()}
    poses = dict.fromkeys(controllers, q)
    while True:
        yield poses
        poses = {name: next(run, poses[name]) for name, run in runs.items()}
