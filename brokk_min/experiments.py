"""The paper's experiment as numbers, figures and a report; the only module that plots.

`task_space` runs every controller on the same starts and velocity sequences on the same machine.
Sequences and starts that score are never used for tuning; `tuning_goals` makes the others.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brokk_min.actuator import ActuatorNet
from brokk_min.env import Controller, TaskConfig, Trace, draw_goal, draw_pose, rollout
from brokk_min.jacobian import (
    JacobianController,
    dls,
    limit_weights,
    manipulability_threshold,
    steady_map,
    tune,
    unpack_gains,
)
from brokk_min.kinematics import jacobian, tool_state
from brokk_min.logs import read_table
from brokk_min.machine import Machine
from brokk_min.policy import Policy, PolicyController

Array = NDArray[np.floating[Any]]
AXES = "xyz"
# One axis of the paper's experiment: seconds and velocity [m/s] (assumed), with changes of direction.
PATTERN = ((1, 0.0), (4, 0.2), (1, 0.0), (4, -0.2), (1, 0.0), (3, 0.1), (3, -0.1), (1, 0.0))


class Sequence_(NamedTuple):
    """A named sequence of wanted tool velocities [m/s] at the control rate, (T, 3)."""

    name: str
    goals: Array


def axis_sequences(machine: Machine) -> list[Sequence_]:
    """One sequence along x, one along y, one along z. Paper: Fig. 7"""
    profile = np.concatenate([np.full(round(s * machine.rate), v) for s, v in PATTERN])
    return [Sequence_(name, np.outer(profile, np.eye(3)[i])) for i, name in enumerate(AXES)]


def read_commands(path: Path, machine: Machine) -> list[Sequence_]:
    """Sequences of a CSV `sequence,time,vx,vy,vz` [s, m/s], each value held until the next row.

    The last row of a sequence marks its end.
    """
    table = read_table(path, ["sequence", "time", "vx", "vy", "vz"], text=("sequence",))
    result = []
    for name in dict.fromkeys(table["sequence"]):
        rows = np.flatnonzero(table["sequence"] == name)
        time = table["time"][rows] - table["time"][rows[0]]
        if len(rows) < 2 or not (np.diff(time) > 0).all():
            raise ValueError(f"{path}: sequence {name}: expected two or more rows with rising time")
        at = np.searchsorted(time, np.arange(round(time[-1] * machine.rate)) / machine.rate + 1e-6, "right")
        goals = np.stack([table[c][rows][at - 1] for c in ("vx", "vy", "vz")], axis=1)
        result.append(Sequence_(str(name), goals))
    return result


def read_starts(path: Path, machine: Machine) -> Array:
    """Start poses of a CSV with one column a joint [rad], shape (starts, n).

    Raises:
        ValueError: an angle outside its joint's range, with file, row and column.
    """
    table = read_table(path, list(machine.names))
    starts = np.stack([table[name] for name in machine.names], axis=1)
    low, high = machine.column("q_min"), machine.column("q_max")
    bad = np.argwhere((starts < low) | (starts > high))
    if len(bad):
        row, joint = bad[0]
        raise ValueError(
            f"{path}: row {row + 2}, column {machine.names[joint]}: expected {low[joint]} to "
            f"{high[joint]} rad, got {starts[row, joint]}"
        )
    return starts


def feasible(machine: Machine, start: Array, goals: Array) -> NDArray[np.bool_]:
    """Can ideal actuators follow `goals` (T, num, 3) from `start` (num, n)? Shape (num,).

    Integrates lightly damped resolved rates with joint-limit weights: the tool must stay within 20 mm
    of its path, joints 0.05 rad off their limits and below their speed, the arm 0.1 m off the ground.
    """
    q, driven = np.array(start, float), machine.driven
    low, high = machine.column("q_min")[driven] + 0.05, machine.column("q_max")[driven] - 0.05
    wanted, lowest = tool_state(machine, q, 0 * q)[::2]
    good, rates = lowest > machine.ground + 0.1, np.zeros_like(q)
    for goal in goals:
        p, _, lowest = tool_state(machine, q, rates)
        J = jacobian(machine, q)
        inverse = dls(J, limit_weights(machine, q, rates)[:, driven], np.full(len(q), 1e-4))
        rates = np.zeros_like(q)
        rates[:, driven] = (inverse @ (goal + (wanted - p))[..., None])[..., 0]
        q, wanted = q + rates * machine.dt, wanted + goal * machine.dt
        inside = ((q[:, driven] > low) & (q[:, driven] < high)).all(-1)
        slow = (np.abs(rates) <= 0.9 * machine.column("q_dot_max")).all(-1)
        near = np.linalg.norm(wanted - p, axis=-1) < 0.02
        good &= inside & slow & near & (lowest > machine.ground + 0.1)
    return good


def draw_starts(machine: Machine, sequences: Sequence[Sequence_], num: int, rng: np.random.Generator) -> Array:
    """Random poses from which ideal actuators could follow all sequences, (num, n) [rad].

    Raises:
        ValueError: too few such poses.
    """
    found: list[Array] = []
    for _ in range(60):
        q = draw_pose(machine, TaskConfig(), rng, 400)
        for sequence in sequences:
            if len(q):
                q = q[feasible(machine, q, np.repeat(sequence.goals[:, None], len(q), axis=1))]
        found += list(q)
        if len(found) >= num:
            return np.array(found[:num])
    raise ValueError(f"starts: expected {num} feasible poses for {machine.name}, got {len(found)}")


def tuning_goals(machine: Machine, runs: int, seconds: float, seed: int) -> tuple[Array, Array]:
    """Feasible starts (runs, n) and goals (T, runs, 3) drawn like the policy's: for tuning only."""
    rng, ticks = np.random.default_rng(seed), round(seconds * machine.rate)
    starts: list[Array] = []
    goals: list[Array] = []
    while len(starts) < runs:
        pose = draw_pose(machine, TaskConfig(), rng, 200)
        holds = rng.uniform(1, 4, (200, ticks))
        changes = np.cumsum(holds, axis=1) * machine.rate
        index = np.array([np.searchsorted(row, np.arange(ticks), "right") for row in changes])
        drawn = draw_goal(machine, TaskConfig(), rng, 200 * ticks).reshape(200, ticks, 3)
        goal = np.take_along_axis(drawn, index[..., None], axis=1).swapaxes(0, 1)
        good = feasible(machine, pose, goal)
        starts += list(pose[good])
        goals += list(goal[:, good].swapaxes(0, 1))
    return np.array(starts[:runs]), np.array(goals[:runs]).swapaxes(0, 1)


# --- controllers ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Effort:
    """How much is spent; the quick chain has the same parts, smaller."""

    hours: float = 1.0
    fit_steps: int = 4000
    train_steps: int = 3_000_000
    generations: int = 25
    tuning_runs: int = 12
    starts: int = 16


QUICK = Effort(0.1, 700, 200_000, 2, 4, 4)


def tuned_baselines(
    machine: Machine, net: ActuatorNet, effort: Effort, seed: int
) -> dict[str, JacobianController]:
    """The paper's two baselines and one with feed-forward, each tuned on the machine itself.

    The cost is the figure that is scored, mean |v_goal - v_tool|, on `tuning_goals`. Tuning on the
    machine favours the baselines: the policy never sees it. Paper: Sec. 4.2
    """
    start, goals = tuning_goals(machine, effort.tuning_runs, 12.0, seed + 1000)
    w0 = manipulability_threshold(machine)
    zero = unpack_gains(np.zeros(3 * len(machine.driven) + 1), len(machine.driven))
    feedforward = steady_map(machine, net)

    def cost(controller: JacobianController, candidates: int) -> Array:
        runs = len(start)
        gains = type(controller.gains)(*(np.repeat(g, runs, axis=0) for g in controller.gains))
        many = JacobianController(machine, gains, controller.k, w0, controller.feedforward)
        trace = rollout(
            machine,
            many,
            np.tile(start, (candidates, 1)),
            np.tile(goals, (1, candidates, 1)),
            TaskConfig(),
            np.random.default_rng(seed),
        )
        error = np.linalg.norm(np.tile(goals, (1, candidates, 1)) - trace.v_tool, axis=-1)
        return error.mean(0).reshape(candidates, runs).mean(1)

    plain = {
        "jacobian_pid_k0.1": JacobianController(machine, zero, 0.1, w0),
        "jacobian_pid_k0.05": JacobianController(machine, zero, 0.05, w0),
        "jacobian_pid_ff": JacobianController(machine, zero, 0.1, w0, feedforward),
    }
    return {name: tune(c, cost, seed, effort.generations, name) for name, c in plain.items()}
