"""The 20 Hz loop and a simulated machine in lockstep, in the process of the window.

The clock of both stands still while anything computes: on a busy computer the machine moves slower
than life, and nothing depends on timing.
"""

import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from brokk_min.can.canopen import Frame
from brokk_min.can.connection import Bus
from brokk_min.can.operator_input import Script
from brokk_min.can.simulated_machine import SimulatedMachine
from brokk_min.evaluation.rollout import Controller
from brokk_min.hw import Drive
from brokk_min.identification.files import require
from brokk_min.kinematics import forward_kinematics, tool_position
from brokk_min.machine import Array, Machine
from brokk_min.viewer.control_process import SelectedController, WindowDrive, WindowOperator

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


class Lockstep:
    """The loop of a window that drives a simulated machine; `advance` makes the ticks that are due.

    Args:
        machine: what moves.
        controllers: see `SelectedController`.
        start: first angles [rad] (n,).
        connection: to the window, as of `control_process.control`.
        log: of all frames, or None.
        clock: of the window [s].
    """

    def __init__(
        self,
        machine: Machine,
        controllers: Sequence[Controller],
        start: Array,
        connection: Any,
        log: Path | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.clock = clock
        self.bus = SimulatedBus(machine, start).open(log)
        operator = WindowOperator(machine, connection, clock=lambda: -np.inf)  # never silent
        selected = SelectedController(machine, controllers, operator)
        self.drive = WindowDrive(machine, selected, self.bus, operator)
        self.drive.begin()
        operator.request = operator.request._replace(alive=True)
        for _ in range(round(START * machine.rate)):
            self.drive.tick()
        self.due = clock()  # s, of the next tick
        self.late = 0.0  # s behind the window's clock

    def advance(self) -> float:
        """Ticks that are due, `MOST_TICKS` at most; how late the machine is in all [s]."""
        for _ in range(MOST_TICKS):
            if self.clock() >= self.due:
                self.due += self.drive.machine.dt
                self.drive.tick()
        lost = max(0.0, self.clock() - self.due)
        self.late += lost
        self.due += lost
        return self.late

    def close(self) -> None:
        """A last tick, with closed valves: the window has closed its end of the connection."""
        self.drive.tick()
        self.bus.close()


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


class Comparison:
    """Each controller traces the same line from the same pose, tick by tick; nobody steers.

    Args:
        machine: what moves, once for each controller.
        controllers: by name.
        q: first angles [rad] (n,).
        line: points of the line from the tool on [m] (K, 3).
    """

    def __init__(
        self, machine: Machine, controllers: Mapping[str, Controller], q: Array, line: Array
    ) -> None:
        self.machine = machine
        self.line = line
        goals = line_goals(machine, line)
        self.runs = {name: follow(machine, c, q, goals) for name, c in controllers.items()}
        self.q = dict.fromkeys(controllers, q)
        self.traces: dict[str, list[Array]] = {name: [] for name in controllers}

    def update(self) -> None:
        """One tick; at the end of the line nothing moves."""
        for name, run in self.runs.items():
            self.q[name] = next(run, self.q[name])
            p_tool = tool_position(forward_kinematics(self.machine, self.q[name]))
            self.traces[name].append(p_tool)
