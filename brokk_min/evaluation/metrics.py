"""Figures of merit of runs, their means with intervals over starts, and comparisons on the same starts."""

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import product
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from tqdm import tqdm

from brokk_min import __version__
from brokk_min.actuator import ActuatorNet
from brokk_min.env import Encoder, TaskConfig
from brokk_min.evaluation.rollout import Controller, Trace, rollout
from brokk_min.evaluation.sequences import Commands, start_kinds
from brokk_min.kinematics import forward_kinematics, tool_position
from brokk_min.machine import Array, Machine, read_encoder

T = TypeVar("T")
Controllers = Mapping[str, Controller]  # by name
Traces = Mapping[tuple[str, str], Trace]  # by controller and sequence, starts as one batch
Rows = list[dict[str, Any]]  # one per run
Run = Mapping[str, Any]  # controller, sequence, start, kind, then the figures of `metrics`
Mean = Mapping[str, float | None]  # "mean", and the ends of its interval, "low" and "high", or None
LABELS = ("controller", "sequence", "start", "kind")
CHANGE = 0.05  # share of tool_speed, assumed: a goal that jumps by more has changed
TRANSIENT = 0.6  # s after a change, assumed: as long as the policy's memory
BAND = 0.1  # share of tool_speed, assumed: settled while the velocity error stays below it,
PART = 0.5  # and below this share of the change, assumed: or a slow goal would be met by standing still
AT_LIMIT = 0.01  # rad, assumed: so near an end of its range a joint is at it


def line_distance(p_tool: Array, goals: Array, start: Array) -> Array:
    """Distance of the tool from the commanded line [m], (T, num).

    The line starts where the tool was when the commanded direction last changed (a stop or a way back
    along the same line is no change). On a curve the direction changes at every tick.

    Args:
        p_tool: tool position at the end of each tick [m], (T, num, 3).
        goals: commanded velocity during each tick [m/s], (T, num, 3).
        start: tool position before the first tick [m], (num, 3).
    """
    anchor, before, direction, distance = start, start, np.zeros_like(start), []
    for p, goal in zip(p_tool, goals, strict=True):
        speed = np.linalg.norm(goal, axis=-1, keepdims=True)
        heading = goal / np.maximum(speed, 1e-12)
        first = ~direction.any(axis=-1, keepdims=True)
        turned = np.linalg.norm(np.cross(direction, heading), axis=-1, keepdims=True) > 1e-6
        anew = (speed > 0) & (turned | first)
        anchor = np.where(anew & ~first, before, anchor)
        direction, before = np.where(anew, heading, direction), p
        away = p - anchor
        along = np.sum(away * direction, -1, keepdims=True) * direction
        distance.append(np.linalg.norm(away - along, axis=-1))
    return np.array(distance)


def since_change(machine: Machine, goals: Array) -> NDArray[np.int64]:
    """Ticks since the goal (T, num, 3) last changed by more than `CHANGE`, (T, num); -1: not yet."""
    tick = np.arange(len(goals))[:, None]
    last = np.maximum.accumulate(
        np.where(_jumps(goals) > CHANGE * machine.tool_speed, tick, -1), axis=0
    )
    return np.where(last < 0, -1, tick - last)


def _jumps(goals: Array) -> Array:
    """How much goals (T, num, 3) change from tick to tick, at first from rest [m/s], (T, num)."""
    jumps: Array = np.linalg.norm(np.diff(goals, axis=0, prepend=0 * goals[:1]), axis=-1)
    return jumps


def settling_time(machine: Machine, error: Array, goals: Array) -> Array:
    """Mean time [s] from a change of goal until the error (T, num) stays in its band, (num,); NaN: no change.

    Where it does not before the next change, the whole time between the changes counts. `goals` (T, num, 3).
    """
    since = since_change(machine, goals)
    segment = np.cumsum(since == 0, axis=0)
    last_change = np.arange(len(goals))[:, None] - np.maximum(since, 0)
    jump = np.take_along_axis(_jumps(goals), last_change, axis=0)
    band = np.minimum(BAND * machine.tool_speed, PART * jump)
    late = np.where((error > band) & (since >= 0), since + 1, 0)
    last = np.zeros((segment.max() + 1, error.shape[1]))
    np.maximum.at(last, (segment, np.arange(error.shape[1])), late)
    changes = segment[-1]
    return np.where(changes > 0, last[1:].sum(0) * machine.dt / np.maximum(changes, 1), np.nan)


def metrics(machine: Machine, trace: Trace, goals: Array, start: Array) -> dict[str, Array]:
    """The figures of each run, (num,) each, as in the evaluate JSON; NaN where there is nothing to average.

    m, m/s, m/s^3, s; valve travel in full strokes; reward 1. `goals` [m/s] (T, num, 3), `start` tool
    positions before the first tick [m] (num, 3).
    """
    error = np.linalg.norm(goals - trace.v_tool, axis=-1)
    drift = line_distance(trace.p_tool, goals, start)
    jerk = np.sum((np.diff(trace.v_tool, n=2, axis=0) * machine.rate**2) ** 2, axis=-1)
    since, ticks = since_change(machine, goals), round(TRANSIENT * machine.rate)
    transient = (since >= 0) & (since < ticks)
    behind = start + np.cumsum(goals, axis=0) * machine.dt - trace.p_tool
    q, (low, high) = (
        trace.q[..., machine.driven],
        (machine.column(f"q_{end}") for end in ("min", "max")),
    )
    room = np.minimum(q - low[machine.driven], high[machine.driven] - q).min(axis=-1)
    return {
        "velocity_rmse": np.sqrt(np.mean(error**2, axis=0)),
        "velocity_error_mean": error.mean(axis=0),
        "velocity_error_transient": _mean(error, transient),
        "velocity_error_steady": _mean(error, ~transient),
        "settling_time": settling_time(machine, error, goals),
        "off_axis_drift_max": drift.max(axis=0),
        "off_axis_drift_mean": drift.mean(axis=0),
        "position_error_mean": np.linalg.norm(behind, axis=-1).mean(axis=0),
        "jerk_rms": np.sqrt(jerk.sum(axis=0) / max(1, len(jerk))),
        "valve_travel": np.abs(np.diff(trace.u, axis=0, prepend=0 * trace.u[:1])).sum(axis=(0, 2)),
        "time_at_limits": (room < AT_LIMIT).sum(axis=0) * machine.dt,
        "reward_mean": trace.reward.mean(axis=0),
    }


def _mean(values: Array, where: NDArray[np.bool_]) -> Array:
    """Mean over the ticks of (T, num) at which `where` holds, (num,); NaN: nowhere."""
    count = where.sum(axis=0)
    return np.where(count > 0, (values * where).sum(axis=0) / np.maximum(count, 1), np.nan)


def row_mean(values: Array) -> Array:
    """Mean of each row of (rows, n) without its NaN, (rows,); NaN: nothing left."""
    return _mean(np.nan_to_num(values).T, np.isfinite(values).T)


# --- runs of all controllers ------------------------------------------------------------------


def evaluate(
    machine: Machine,
    controllers: Controllers,
    sequences: Sequence[Commands],
    starts: Array,
    seed: int,
    net: ActuatorNet | None = None,
    sensor: Callable[[np.random.Generator], Encoder] = lambda rng: read_encoder,
) -> tuple[Rows, Traces]:
    """Run every controller on the same sequences, starts and noise. Paper: Sec. 4.2, Fig. 6

    Sequences of one length and all starts are one batch.

    Args:
        machine: n joints.
        controllers: by name.
        sequences: goals of the tool velocity.
        starts: angles [rad], (starts, n).
        seed: of the noise, the same for all.
        net: nets of the driven joints; None: the analytic plant.
        sensor: makes the encoder of each rollout.

    Returns:
        One row per controller, sequence and start, see `metrics`; and the traces.
    """
    rows: Rows = []
    traces: dict[tuple[str, str], Trace] = {}
    lengths = dict.fromkeys(len(sequence.goals) for sequence in sequences)
    batches = [[s for s in sequences if len(s.goals) == length] for length in lengths]
    pairs = list(product(controllers, batches))
    for name, batch in tqdm(pairs, desc="evaluate", unit="batch", disable=None):
        goals = np.concatenate([s.for_starts(len(starts)) for s in batch], axis=1)
        tiled = np.tile(starts, (len(batch), 1))
        rng = np.random.default_rng(seed)
        read = sensor(np.random.default_rng(seed + 1))
        trace = rollout(machine, controllers[name], tiled, goals, TaskConfig(), rng, net, read)
        p_start = tool_position(forward_kinematics(machine, tiled))
        figures = metrics(machine, trace, goals, p_start)
        for i, sequence in enumerate(batch):
            part = slice(i * len(starts), (i + 1) * len(starts))
            traces[name, sequence.name] = Trace(*(array[:, part] for array in trace))
            of_part = {key: values[part] for key, values in figures.items()}
            rows += _rows(machine, name, sequence.name, starts, of_part)
    names = list(controllers)
    order = [s.name for s in sequences]
    rows.sort(key=lambda row: (names.index(row["controller"]), order.index(row["sequence"])))
    return rows, traces


def _rows(
    machine: Machine, controller: str, sequence: str, starts: Array, figures: Mapping[str, Array]
) -> Rows:
    """One row per start of figures (starts,); None where there is none."""
    rows: Rows = []
    for i, kind in enumerate(start_kinds(machine, starts)):
        row: dict[str, Any] = {"controller": controller, "sequence": sequence}
        row |= {"start": i, "kind": kind}
        for key, values in figures.items():
            row[key] = float(values[i]) if np.isfinite(values[i]) else None
        rows.append(row)
    return rows


def metadata(machine: Machine, seed: int) -> dict[str, Any]:
    """Metadata of every JSON file of results."""
    return {
        "brokk_min": __version__,
        "machine": machine.name,
        "seed": seed,
        "units": "m, m/s, s, rad",
    }


# --- over many runs -----------------------------------------------------------------------------------


def by_start(runs: Sequence[Run], controller: str, sequence: str, key: str) -> Array:
    """One figure for each start (starts,), mean of its runs; `sequence` may be "all". NaN: no figure."""
    values: dict[int, list[float]] = {}
    for run in runs:
        if run["controller"] == controller and sequence in (run["sequence"], "all"):
            mine = values.setdefault(run["start"], [])
            if run[key] is not None:
                mine.append(run[key])
    return np.array([np.mean(v) if v else np.nan for _, v in sorted(values.items())])


def interval(values: Array) -> list[float | None]:
    """95 % confidence interval of the mean by Student's t, NaN left out; None: fewer than two values.

    Example:
        >>> [round(end, 3) for end in interval(np.array([1.0, 2.0, 3.0]))]
        [-0.484, 4.484]
    """
    values = values[np.isfinite(values)]
    if len(values) < 2:
        return [None, None]
    half = stats.t.ppf(0.975, len(values) - 1) * values.std(ddof=1) / math.sqrt(len(values))
    return [float(values.mean() - half), float(values.mean() + half)]


def _named(runs: Sequence[Run]) -> tuple[list[str], list[str], list[str]]:
    """Controllers, sequences (with "all") and figures of runs, in their order."""
    controllers, sequences = (list(dict.fromkeys(run[key] for run in runs)) for key in LABELS[:2])
    return controllers, [*sequences, "all"], [key for key in runs[0] if key not in LABELS]


def _of_each(runs: Sequence[Run], what: Callable[[Array], T]) -> dict[str, dict[str, dict[str, T]]]:
    """`what` of the starts' values of each figure, by controller and sequence."""
    controllers, sequences, keys = _named(runs)
    return {
        c: {s: {key: what(by_start(runs, c, s, key)) for key in keys} for s in sequences}
        for c in controllers
    }


def _number(values: Array) -> float | None:
    kept = values[np.isfinite(values)]
    return float(kept.mean()) if len(kept) else None


def summary(runs: Sequence[Run]) -> dict[str, dict[str, dict[str, float | None]]]:
    """Mean of each figure over starts by controller and sequence, and over all sequences ("all")."""
    return _of_each(runs, _number)


def intervals(runs: Sequence[Run]) -> dict[str, dict[str, dict[str, list[float | None]]]]:
    """95 % confidence intervals over starts of the means of `summary`."""
    return _of_each(runs, interval)


def mean_interval(values: Array) -> Mean:
    """Mean and ends of its `interval`: "mean", "low", "high"."""
    low, high = interval(values)
    return {"mean": _number(values), "low": low, "high": high}


def paired_difference(runs: Sequence[Run], one: str, other: str, key: str) -> dict[str, Mean]:
    """A figure of one controller less another's on the same starts, by sequence: `mean_interval` each."""
    sequences = _named(runs)[1]
    return {
        s: mean_interval(by_start(runs, one, s, key) - by_start(runs, other, s, key))
        for s in sequences
    }


def paired_differences(runs: Sequence[Run], one: str) -> dict[str, dict[str, dict[str, Mean]]]:
    """Every figure of one controller less each other's: `paired`, by figure and other controller."""
    controllers, _, keys = _named(runs)
    return {
        k: {c: paired_difference(runs, one, c, k) for c in controllers if c != one} for k in keys
    }
