"""Lines to trace with the tool, by hand: how well it was done, by whoever translated, kept in a table."""

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from brokk_min.can.drive_log import Telemetry
from brokk_min.identification import files
from brokk_min.kinematics import forward_kinematics, tool_position
from brokk_min.machine import Array, Machine
from brokk_min.viewer.drawing import extent

CAPTURE = 0.1  # m, assumed: a point of the line counts as passed nearer than this
SPACING = 0.05  # m, assumed: between the points that must be passed


def task_lines(machine: Machine) -> dict[str, Array]:
    """Lines to trace [m] (K, 3) from where the tool is, in sizes that suit the machine.

    A level rectangle, an upright circle and straight lines along the axes; none goes down from its start.
    """
    size = extent(machine).reach
    turn = np.linspace(0, 2 * np.pi, 60)
    square = np.array([[0, 0, 0], [0, 0.16, 0], [0.1, 0.16, 0], [0.1, 0, 0], [0, 0, 0]])
    circle = 0.06 * np.stack([np.sin(turn), 0 * turn, 1 - np.cos(turn)], axis=1)
    lines = {"rectangle": square, "circle": circle}
    lines |= {f"line {axis}": 0.14 * np.eye(3)[[i, i]] * [[0], [1]] for i, axis in enumerate("xyz")}
    return {name: _spaced(size * line) for name, line in lines.items()}


def _spaced(line: Array) -> Array:
    """Points of a line no more than `SPACING` apart; its corners stay."""
    parts = []
    for a, b in pairwise(line):
        steps = int(np.ceil(np.linalg.norm(b - a) / SPACING))
        parts.append(a + np.linspace(0, 1, steps, endpoint=False)[:, None] * (b - a))
    return np.vstack([*parts, line[-1:]])


def distance(line: Array, p: Array) -> Array:
    """Distance [m] (T,) of points (T, 3) from a line through points (K, 3)."""
    a, along = line[:-1], np.diff(line, axis=0)
    away = p[:, None] - a
    share = np.clip((away * along).sum(-1) / np.maximum((along * along).sum(-1), 1e-12), 0, 1)
    return np.asarray(np.linalg.norm(away - share[..., None] * along, axis=-1).min(axis=1))


class Attempt(NamedTuple):
    """One traced line, a row of the attempts' CSV."""

    when: str  # time of day
    task: str
    mode: str
    seconds: float
    mean: float  # distance from the line [m]
    max: float
    valve_travel: float  # full strokes


@dataclass
class Tracing:
    """A line being traced: it begins with the first opened valve and ends when all its points were passed."""

    machine: Machine
    task: str
    line: Array  # m, base frame (K, 3)
    p: list[Array] = field(default_factory=list)
    u: list[Array] = field(default_factory=list)
    passed: int = 0
    begun: float = 0.0  # tick
    seconds: float = 0.0  # since then; by ticks, because a busy window misses some

    def follow(self, known: Telemetry) -> bool:
        """One tick; True if it was the last."""
        if not self.p and not known.u.any():
            return False
        p = tool_position(forward_kinematics(self.machine, known.q))
        self.begun = self.begun if self.p else known.tick
        self.seconds = (known.tick - self.begun + 1) * self.machine.dt
        self.p.append(p)
        self.u.append(known.u)
        while self.passed < len(self.line) and np.linalg.norm(self.line[self.passed] - p) < CAPTURE:
            self.passed += 1
        return self.passed == len(self.line)

    def score(self, mode: str) -> Attempt:
        """The figures of the finished attempt."""
        away, u = distance(self.line, np.array(self.p)), np.array(self.u)
        travel = float(np.abs(np.diff(u, axis=0, prepend=0 * u[:1])).sum())
        when = time.strftime("%Y-%m-%dT%H:%M:%S")
        return Attempt(
            when, self.task, mode, self.seconds, float(away.mean()), float(away.max()), travel
        )


def read_attempts(path: Path) -> list[Attempt]:
    """Attempts so far; none if there is no file; ValueError: another kind of file."""
    if not path.exists():
        return []
    table = files.read_table(path, Attempt._fields, text=("when", "task", "mode"))
    return [
        Attempt(*row)
        for row in zip(*(table[name].tolist() for name in Attempt._fields), strict=True)
    ]


def write_attempts(path: Path, attempts: Sequence[Attempt]) -> None:
    """Write all attempts, the file whole."""
    rows = [[f"{x:.6g}" if isinstance(x, float) else x for x in row] for row in attempts]
    files.write_csv(path, Attempt._fields, rows)


def attempts_table(attempts: Iterable[Attempt], task: str) -> list[str]:
    """Means of one task by who translated, a line each."""
    lines, mine = [], [attempt for attempt in attempts if attempt.task == task]
    for mode in dict.fromkeys(attempt.mode for attempt in mine):
        rows = [attempt[3:] for attempt in mine if attempt.mode == mode]
        lines.append(f"mean of {len(rows)} by {mode}: {figures(np.mean(rows, axis=0))}")
    return lines


def figures(numbers: Iterable[float]) -> str:
    """The four figures of an attempt in words."""
    seconds, mean, largest, travel = numbers
    return f"{seconds:.1f} s, off by {mean:.3f} m, at most {largest:.3f} m, valves {travel:.0f}"
