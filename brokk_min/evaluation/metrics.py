"""Figures of merit: their definitions, runs of all controllers, means and intervals over starts."""

import math
from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np
from numpy.linalg import norm
from numpy.typing import NDArray
from tqdm import tqdm

from brokk_min._files import made_with
from brokk_min.actuator import PLANT, Plant
from brokk_min.env import reward
from brokk_min.evaluation.rollout import Together, Trace, rollout
from brokk_min.evaluation.sequences import Commands
from brokk_min.kinematics import forward_kinematics, tool_position
from brokk_min.machine import Array, Controller, Machine
from brokk_min.settings import TaskConfig

Controllers = Mapping[str, Controller]  # by name
Traces = Mapping[tuple[str, str], Trace]  # by controller and sequence, starts as one batch
Run = Mapping[str, Any]  # controller, sequence, start, kind, then the figures of `metrics`
Table = list[dict[str, Any]]  # of one `Run` each
Mean = Mapping[str, float | None]  # "mean", and its interval "low" to "high"
LABELS = ("controller", "sequence", "start", "kind", "seed")  # of a row; the seed is of a sweep
SETTLING = 1.0  # s after a change of goal, in which an error is transient
JUMP = 0.05  # of tool_speed, assumed: a change of goal in a tick; the circle turns by less
COLUMNS = {  # of tables, with their heads
    "velocity_error_mean": "error [m/s]",
    "velocity_error_transient": "transient",
    "velocity_error_steady": "steady",
    "off_axis_drift_max": "drift [m]",
    "jerk_rms": "jerk [m/s^3]",
    "valve_travel": "travel [1]",
}


def metrics(machine: Machine, trace: Trace, goals: Array, start: Array) -> dict[str, Array]:
    """Figures of each run as in the evaluate JSON, (num,) each.

    m, m/s, m/s^3; valve travel in full strokes; reward 1. `goals` [m/s] (T, num, 3), `start`
    tool positions before the first tick [m] (num, 3). Errors are transient in the first second
    after a change of goal, and steady in the rest (Kunapuli et al., RSS 2025, arXiv 2506.17832);
    nan where a run has none; a curve has no drift, see `line_distance`.
    """
    error = norm(goals - trace.v_tool, axis=-1)
    transient = after_a_change(machine, goals)
    drift = line_distance(trace.p_tool, goals, start)
    jerk = np.diff(trace.v_tool, n=2, axis=0) * machine.rate**2
    return {
        "velocity_rmse": np.sqrt(np.mean(error**2, axis=0)),
        "velocity_error_mean": error.mean(axis=0),
        "velocity_error_transient": mean_where(transient, error),
        "velocity_error_steady": mean_where(~transient, error),
        "off_axis_drift_max": drift.max(axis=0),
        "off_axis_drift_mean": drift.mean(axis=0),
        "jerk_rms": np.sqrt(np.sum(jerk**2, axis=-1).sum(axis=0) / max(1, len(jerk))),
        "valve_travel": np.abs(np.diff(trace.u, axis=0, prepend=0 * trace.u[:1])).sum(axis=(0, 2)),
        "reward_mean": reward(goals, trace.v_tool).mean(axis=0),
    }


def after_a_change(machine: Machine, goals: Array) -> NDArray[np.bool_]:
    """Has the goal jumped within the last second? (T, num) of goals [m/s] (T, num, 3)."""
    change = norm(np.diff(goals, axis=0, prepend=0 * goals[:1]), axis=-1)
    jumps = np.cumsum(change > JUMP * machine.tool_speed, axis=0)
    ticks = round(SETTLING * machine.rate)
    earlier = np.concatenate([np.zeros_like(jumps[:1]).repeat(ticks, axis=0), jumps])[: len(jumps)]
    return np.asarray(jumps > earlier)


def mean_where(chosen: NDArray[np.bool_], values: Array) -> Array:
    """Mean of each run's values (T, num) where they are chosen; nan where none is."""
    count = chosen.sum(axis=0)
    total = np.where(chosen, values, 0).sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def line_distance(p_tool: Array, goals: Array, start: Array) -> Array:
    """Distance of the tool from the commanded line [m], (T, num).

    The line starts where the tool was when the goal's direction last changed; to stop or to go back
    is no change. A goal that turns in two ticks running is on a curve, off which nothing drifts:
    nan. `p_tool` are positions at the end of each tick [m] (T, num, 3), others as above.
    """
    origin = start  # of the line
    direction = np.zeros_like(start)  # of the line; 0 before the first motion
    turned = np.zeros((len(start), 1), bool)
    distance = []
    for p_before, p, goal in zip([start, *p_tool[:-1]], p_tool, goals, strict=True):
        speed = norm(goal, axis=-1, keepdims=True)
        heading = goal / np.maximum(speed, 1e-12)
        first = ~direction.any(axis=-1, keepdims=True)
        turned_before = turned
        turned = norm(np.cross(direction, heading), axis=-1, keepdims=True) > 1e-6
        origin = np.where((speed > 0) & turned, p_before, origin)
        direction = np.where((speed > 0) & (turned | first), heading, direction)
        from_origin = p - origin
        along = np.sum(from_origin * direction, axis=-1, keepdims=True) * direction
        off_line = norm(from_origin - along, axis=-1)
        distance.append(np.where((turned & turned_before)[:, 0], np.nan, off_line))
    return np.array(distance)


def evaluate(
    machine: Machine,
    controllers: Controllers,
    sequences: Sequence[Commands],
    starts: Array,
    seed: int,
    plant: Plant = PLANT,
    noise: float = TaskConfig.noise,
) -> tuple[Table, Traces]:
    """Run every controller on the same sequences, starts and noise. Paper: Sec. 4.2, Fig. 6

    `starts` are angles [rad] (starts, n); `noise` of the sensors is that of training. The machines
    of all controllers are one batch, because a tick of many costs hardly more than one of few.
    Returns a row per controller, sequence and start, see `metrics`, with None for nan; and traces.
    """
    p_start = tool_position(forward_kinematics(machine, starts))
    goals = {s.name: s.for_starts(machine, starts) for s in sequences}  # all are one batch
    ticks = max(len(of) for of in goals.values())
    padded = [np.pad(of, ((0, ticks - len(of)), (0, 0), (0, 0))) for of in goals.values()]
    q, each_tick = np.tile(starts, (len(goals), 1)), np.concatenate(padded, axis=1)
    together, rng = Together([*controllers.values()]), np.random.default_rng(seed)
    batch = tqdm(each_tick, "evaluate", unit="tick", disable=None)
    every = rollout(machine, together, q, batch, noise, rng, plant, len(controllers))
    traces: dict[tuple[str, str], Trace] = {}
    for i, (name, (sequence, goal)) in enumerate(product(controllers, goals.items())):
        part = slice(i * len(starts), (i + 1) * len(starts))
        traces[name, sequence] = Trace(*(array[: len(goal), part] for array in every))
    figures = {}
    for sequence, goal in goals.items():  # of all controllers at once
        each = zip(*(traces[name, sequence] for name in controllers), strict=True)
        trace = Trace(*(np.concatenate(arrays, axis=1) for arrays in each))
        driven = np.tile(goal, (1, len(controllers), 1)), np.tile(p_start, (len(controllers), 1))
        columns = metrics(machine, trace, *driven)
        figures[sequence] = {key: of.reshape(-1, len(starts)) for key, of in columns.items()}
    rows: Table = []
    for (c, name), sequence, start in product(enumerate(controllers), goals, range(len(starts))):
        labels = {"controller": name, "sequence": sequence, "start": start, "kind": "workspace"}
        row = {key: float(of[c, start]) for key, of in figures[sequence].items()}
        rows.append(labels | {key: None if np.isnan(x) else x for key, x in row.items()})
    return rows, traces


def metadata(machine: Machine, seed: int) -> dict[str, Any]:
    """Metadata of every JSON file of results."""
    return made_with() | {"machine": machine.name, "seed": seed, "units": "m, m/s, s, rad"}


def by_start(runs: Sequence[Run], controller: str, sequence: str, key: str) -> Array:
    """One figure for each start (starts,), the mean of its runs that have one."""
    values: dict[int, list[float]] = {}
    for run in runs:
        mine = run["controller"] == controller and sequence in (run["sequence"], "all")
        if mine and run[key] is not None:
            values.setdefault(run["start"], []).append(run[key])
    return np.array([np.mean(of) for _, of in sorted(values.items())])


def mean_interval(values: Array) -> Mean:
    """Mean, and its 95 % confidence interval by Student's t; None for what too few values have."""
    from scipy.special import stdtrit  # Student's t quantile; slow to import

    mean = float(values.mean()) if len(values) else None
    if mean is None or len(values) == 1:
        return {"mean": mean, "low": None, "high": None}
    half = stdtrit(len(values) - 1, 0.975) * values.std(ddof=1) / math.sqrt(len(values))
    return {"mean": mean, "low": float(mean - half), "high": float(mean + half)}


def interval_text(number: Mean) -> str:
    """A mean with its interval, if it was measured and has one.

    >>> interval_text({"mean": 0.01234, "low": -0.5, "high": 41.267})
    '0.0123 (-0.5000 to 41.27)'
    """
    texts = [f"{x:.4f}" if abs(x) < 1 else f"{x:.4g}" for x in number.values() if x is not None]
    texts = texts or ["not measured"]
    return texts[0] if len(set(texts)) == 1 else "{} ({} to {})".format(*texts)


def column(runs: Sequence[Run], label: str) -> list[str]:
    """The controllers or the sequences of runs, in their order."""
    return list(dict.fromkeys(run[label] for run in runs))


def means(runs: Sequence[Run]) -> dict[str, dict[str, dict[str, Mean]]]:
    """Means over starts with intervals, by controller, sequence (also "all") and figure."""
    sequences = [*column(runs, "sequence"), "all"]
    keys = [key for key in runs[0] if key not in LABELS]
    return {
        c: {s: {k: mean_interval(by_start(runs, c, s, k)) for k in keys} for s in sequences}
        for c in column(runs, "controller")
    }


def compare(runs: Sequence[Run], one: str, other: str, key: str) -> dict[str, dict[str, Any]]:
    """How much less or more a figure is with `one` controller than with the `other`, by sequence.

    "mean" with its interval is the difference of runs from the same starts [% of the other's mean],
    and `one` has the smaller figure in "won" of so many "runs". The sequence "all" has all runs.
    """
    result = {}
    for sequence in [*column(runs, "sequence"), "all"]:
        mine, its = (by_start(runs, name, sequence, key) for name in (one, other))
        whole = its.mean() if len(its) else np.nan
        row: dict[str, Any] = dict(mean_interval(100 * (mine - its) / whole))
        parts = [sequence] if sequence != "all" else column(runs, "sequence")
        won = [by_start(runs, one, of, key) < by_start(runs, other, of, key) for of in parts]
        row |= {"won": sum(of.sum().item() for of in won), "runs": sum(map(len, won))}
        result[sequence] = row
    return result
