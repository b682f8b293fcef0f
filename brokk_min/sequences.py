"""Velocity sequences and start poses: the ones that score, the user's own, and others for tuning.

Sequences and starts that score are never used for tuning; `tuning_goals` makes the others.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from brokk_min import actuator, jacobian, kinematics, logs
from brokk_min.env import TaskConfig, draw_pose, reset, terminated
from brokk_min.machine import Machine

Array = NDArray[np.floating[Any]]
AXES = "xyz"
# One axis of the paper's experiment: seconds and share of tool_speed (assumed), with changes of direction.
PATTERN = ((1, 0.0), (4, 2 / 3), (1, 0.0), (4, -2 / 3), (1, 0.0), (3, 1 / 3), (3, -1 / 3), (1, 0.0))


class Commands(NamedTuple):
    """A named sequence of wanted tool velocities [m/s] at the control rate, (T, 3)."""

    name: str
    goals: Array


def axis_sequences(machine: Machine) -> list[Commands]:
    """One sequence along x, one along y, one along z. Paper: Fig. 6"""
    seconds, shares = np.array(PATTERN).T
    profile = machine.tool_speed * np.repeat(shares, np.rint(seconds * machine.rate).astype(int))
    return [Commands(name, np.outer(profile, np.eye(3)[i])) for i, name in enumerate(AXES)]


def read_commands(path: Path, machine: Machine) -> list[Commands]:
    """Sequences of a CSV `sequence,time,vx,vy,vz` [s, m/s], each value held until the next row.

    The last row of a sequence marks its end.
    """
    table = logs.read_table(path, ["sequence", "time", "vx", "vy", "vz"], text=("sequence",))
    result = []
    for name in dict.fromkeys(table["sequence"]):
        rows = np.flatnonzero(table["sequence"] == name)
        time = table["time"][rows] - table["time"][rows[0]]
        if len(rows) < 2 or not (np.diff(time) > 0).all():
            raise ValueError(f"{path}: sequence {name}: expected two or more rows with rising time")
        if round(time[-1] * machine.rate) < 1 or name == "all":
            raise ValueError(f"{path}: sequence {name}: expected a tick or more and another name than all")
        at = np.searchsorted(time, np.arange(round(time[-1] * machine.rate)) / machine.rate + 1e-6, "right")
        goals = np.stack([table[c][rows][at - 1] for c in ("vx", "vy", "vz")], axis=1)
        result.append(Commands(str(name), goals))
    return result


def read_starts(path: Path, machine: Machine) -> Array:
    """Start poses of a CSV with one column a joint [rad], shape (starts, n).

    Raises:
        ValueError: an angle outside its joint's range or a pose in the ground, with file and row.
    """
    table = logs.read_table(path, list(machine.names))
    starts = np.stack([table[name] for name in machine.names], axis=1)
    low, high = machine.column("q_min"), machine.column("q_max")
    for row, joint in np.argwhere((starts < low) | (starts > high)):
        wanted = f"column {machine.names[joint]}: expected {low[joint]} to {high[joint]} rad"
        raise ValueError(f"{path}: row {row + 2}, {wanted}, got {starts[row, joint]}")
    lowest = kinematics.lowest_point(machine, starts)
    for row in np.flatnonzero(terminated(machine, lowest)):
        wanted = f"expected the whole arm above {machine.ground} m"
        raise ValueError(f"{path}: row {row + 2}: {wanted}, got {lowest[row]:.3f} m")
    return starts


def feasible(machine: Machine, start: Array, goals: Array) -> NDArray[np.bool_]:
    """Can ideal actuators follow `goals` (T, num, 3) from `start` (num, n)? Shape (num,).

    Integrates lightly damped resolved rates with joint-limit weights. Margins, all assumed: the tool stays
    within 20 mm of its path (no singularity is crossed), joints 0.05 rad off their limits and below 0.9 of
    `speed_limits` (a tracking controller needs room to correct), the arm 0.1 m off the ground.
    """
    q, driven = np.array(start, float), machine.driven
    low, high = machine.column("q_min")[driven] + 0.05, machine.column("q_max")[driven] - 0.05
    wanted, lowest = kinematics.tool_state(machine, q, 0 * q)[::2]
    good, rates = lowest > machine.ground + 0.1, np.zeros_like(q)
    for goal in goals:
        p, _, lowest = kinematics.tool_state(machine, q, rates)
        J = kinematics.jacobian(machine, q)
        inverse = jacobian.dls(J, jacobian.limit_weights(machine, q, rates)[:, driven], np.full(len(q), 1e-4))
        rates = np.zeros_like(q)
        rates[:, driven] = (inverse @ (goal + (wanted - p))[..., None])[..., 0]
        q, wanted = q + rates * machine.dt, wanted + goal * machine.dt
        inside = ((q[:, driven] > low) & (q[:, driven] < high)).all(-1)
        down, up = actuator.speed_limits(machine, q)
        slow = ((rates > 0.9 * down) & (rates < 0.9 * up))[:, driven].all(-1)
        near = np.linalg.norm(wanted - p, axis=-1) < 0.02
        good &= inside & slow & near & (lowest > machine.ground + 0.1)
    return good


def _feasible_draws(
    machine: Machine, num: int, label: str, draw: Callable[[], tuple[Array, list[Array]]]
) -> tuple[Array, Array]:
    """First `num` poses (num, n), and goals (T, num, 3), of those drawn whose goals are all `feasible`."""
    poses: list[Array] = []
    first: list[Array] = []
    with tqdm(total=num, desc=label, unit="start", disable=None) as bar:
        for _ in range(60):
            pose, goals = draw()
            keep = np.arange(len(pose))
            for goal in goals:
                keep = keep[feasible(machine, pose[keep], goal[:, keep])]
            poses += list(pose[keep])
            first += list(goals[0].swapaxes(0, 1)[keep])
            bar.update(min(num, len(poses)) - bar.n)
            if len(poses) >= num:
                return np.array(poses[:num]), np.array(first[:num]).swapaxes(0, 1)
    raise ValueError(f"{label}: expected {num} feasible poses for {machine.name}, got {len(poses)}")


def draw_starts(machine: Machine, sequences: Sequence[Commands], num: int, rng: np.random.Generator) -> Array:
    """Random poses (num, n) [rad] where all sequences are `feasible`; else ValueError. Paper: Fig. 6a"""
    goals = [np.repeat(sequence.goals[:, None], 400, axis=1) for sequence in sequences]

    def draw() -> tuple[Array, list[Array]]:
        return draw_pose(machine, TaskConfig(), rng, 400), goals

    return _feasible_draws(machine, num, "draw starts", draw)[0]


def tuning_goals(machine: Machine, runs: int, seconds: float, seed: int) -> tuple[Array, Array]:
    """Feasible starts (runs, n) and goals (T, runs, 3), drawn as the policy's by `reset`: for tuning only."""
    rng, config, ticks = np.random.default_rng(seed), TaskConfig(), round(seconds * machine.rate)
    holds = int(np.ceil(seconds / config.hold_min_s))  # that many are always long enough

    def draw() -> tuple[Array, list[Array]]:
        drawn = reset(machine, config, rng, 200 * holds, plant=False)
        goals = [
            np.repeat(drawn.v_goal[i : i + holds], drawn.goal_ticks[i : i + holds], axis=0)[:ticks]
            for i in range(0, 200 * holds, holds)
        ]
        return drawn.q[::holds].astype(float), [np.stack(goals, axis=1)]

    return _feasible_draws(machine, runs, "draw tuning runs", draw)
