"""Lines to trace with the tool by hand, and a table of how well it was done."""

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from brokk_min.can.drive_log import Telemetry
from brokk_min.identification import files
from brokk_min.identification.formats import NUMBERS, TEXTS, read_table
from brokk_min.kinematics import forward_kinematics, tool_position
from brokk_min.machine import Array, Machine
from brokk_min.viewer.camera import extent

CAPTURE = 0.1  # m, assumed: a point of the line counts as passed if the tool is nearer
SPACING = 0.05  # m, assumed: largest distance between the points


def task_lines(machine: Machine) -> dict[str, Array]:
    """Lines to trace [m] (K, 3), relative to the tool, in sizes that suit the machine.

    A level rectangle, an upright circle, lines along the axes; none goes below its start.
    """
    _, _, reach = extent(machine)
    angle = np.linspace(0, 2 * np.pi, 60)
    rectangle = np.array([[0, 0, 0], [0, 0.16, 0], [0.1, 0.16, 0], [0.1, 0, 0], [0, 0, 0]])
    circle = 0.06 * np.stack([np.sin(angle), 0 * angle, 1 - np.cos(angle)], axis=1)
    lines = {"rectangle": rectangle, "circle": circle}
    for axis, direction in zip("xyz", np.eye(3), strict=True):
        lines[f"line {axis}"] = np.stack([np.zeros(3), 0.14 * direction])
    return {name: _subdivide(reach * line) for name, line in lines.items()}


def _subdivide(line: Array) -> Array:
    """Points of a line at most `SPACING` apart, its corners among them."""
    parts = []
    for a, b in pairwise(line):
        steps = int(np.ceil(np.linalg.norm(b - a) / SPACING))
        parts.append(np.linspace(a, b, steps, endpoint=False))
    return np.vstack([*parts, line[-1:]])


def distance(line: Array, p: Array) -> Array:
    """Distance [m] (T,) of points (T, 3) from a line through points (K, 3)."""
    along = np.diff(line, axis=0)
    offset = p[:, None] - line[:-1]
    fraction = np.sum(offset * along, axis=-1) / np.maximum(np.sum(along**2, axis=-1), 1e-12)
    nearest = np.clip(fraction, 0, 1)[..., None] * along
    return np.asarray(np.linalg.norm(offset - nearest, axis=-1).min(axis=1))


class Attempt(NamedTuple):
    """One traced line, a row of the attempts' CSV."""

    when: str  # date and time
    task: str
    mode: str
    seconds: float
    mean: float  # distance from the line [m]
    max: float
    valve_travel: float  # full strokes


@dataclass
class Tracing:
    """A line being traced, from the first opened valve until its last point was passed."""

    machine: Machine
    task: str
    line: Array  # m, base frame (K, 3)
    p: list[Array] = field(default_factory=list)
    u: list[Array] = field(default_factory=list)
    passed: int = 0
    first_tick: float = 0.0
    seconds: float = 0.0  # since the first tick; a busy window may miss some in between

    def update(self, telemetry: Telemetry) -> bool:
        """One tick; True if it was the last."""
        if not self.p:
            self.first_tick = telemetry.tick
            if not telemetry.u.any():
                return False
        p = tool_position(forward_kinematics(self.machine, telemetry.q))
        self.seconds = (telemetry.tick - self.first_tick + 1) * self.machine.dt
        self.p.append(p)
        self.u.append(telemetry.u)
        while self.passed < len(self.line) and np.linalg.norm(self.line[self.passed] - p) < CAPTURE:
            self.passed += 1
        return self.passed == len(self.line)

    def attempt(self, mode: str) -> Attempt:
        """The finished attempt."""
        error = distance(self.line, np.array(self.p))
        travel = np.abs(np.diff(self.u, axis=0, prepend=np.zeros((1, self.machine.n)))).sum()
        when = time.strftime("%Y-%m-%dT%H:%M:%S")
        errors = (float(error.mean()), float(error.max()))
        return Attempt(when, self.task, mode, self.seconds, *errors, float(travel))


def read_attempts(path: Path) -> list[Attempt]:
    """Attempts in a file, none if there is no file; ValueError: another kind of file."""
    if not path.exists():
        return []
    texts = dict.fromkeys(("when", "task", "mode"), TEXTS)
    table = read_table(path, dict.fromkeys(Attempt._fields, NUMBERS) | texts)
    columns = [table[name].tolist() for name in Attempt._fields]
    return [Attempt(*row) for row in zip(*columns, strict=True)]


def write_attempts(path: Path, attempts: Sequence[Attempt]) -> None:
    """Write all attempts, the file whole."""
    rows = [[f"{x:.6g}" if isinstance(x, float) else x for x in row] for row in attempts]
    files.write_csv(path, Attempt._fields, rows)


def attempts_table(attempts: Iterable[Attempt], task: str) -> list[str]:
    """Means of the attempts at one task, a line per mode."""
    of_task = [attempt for attempt in attempts if attempt.task == task]
    lines = []
    for mode in dict.fromkeys(attempt.mode for attempt in of_task):
        numbers = [attempt[3:] for attempt in of_task if attempt.mode == mode]
        lines.append(f"mean of {len(numbers)} by {mode}: {summary(np.mean(numbers, axis=0))}")
    return lines


def summary(numbers: Iterable[float]) -> str:
    """Seconds, mean and largest distance, and valve travel of an attempt as text."""
    seconds, mean, largest, travel = numbers
    return f"{seconds:.1f} s, off by {mean:.3f} m, at most {largest:.3f} m, valves {travel:.0f}"
