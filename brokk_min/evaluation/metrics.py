"""Figures of merit: their definitions, runs of all controllers, means and intervals over starts."""

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import product
from typing import Any, TypeVar

import numpy as np
from numpy.linalg import norm
from numpy.typing import NDArray

from brokk_min import __version__
from brokk_min.actuator import ActuatorNet, Encoder
from brokk_min.env import TaskConfig
from brokk_min.evaluation.rollout import Controller, Trace, rollout
from brokk_min.evaluation.sequences import Commands, start_kinds
from brokk_min.identification.progress import progress
from brokk_min.kinematics import forward_kinematics, tool_position
from brokk_min.machine import Array, Machine, read_encoder

T = TypeVar("T")
Controllers = Mapping[str, Controller]  # by name
Traces = Mapping[tuple[str, str], Trace]  # by controller and sequence, starts as one batch
Run = Mapping[str, Any]  # controller, sequence, start, kind, then the figures of `metrics`
Rows = list[dict[str, Any]]  # of one `Run` each
Mean = Mapping[str, float | None]  # "mean", and its interval "low" to "high"
LABELS = ("controller", "sequence", "start", "kind")
CHANGE = 0.05  # of tool_speed, assumed: a goal that jumps by more has changed
TRANSIENT = 0.6  # s after a change, assumed: as long as the policy's history
BAND = 0.1  # of tool_speed, assumed: the tool has settled while its error stays below this,
BAND_OF_CHANGE = 0.5  # and this fraction of the change, assumed: or standstill meets slow goals
AFTER_STOP = 1.0  # s, assumed: what moves later in a rest moves by itself
AT_LIMIT = 0.01  # rad, assumed: a joint so near an end of its range is at its limit


def metrics(machine: Machine, trace: Trace, goals: Array, start: Array) -> dict[str, Array]:
    """Figures of each run as in the evaluate JSON, (num,) each; NaN where nothing can be averaged.

    m, m/s, m/s^3, s; valve travel in full strokes; reward 1. `goals` [m/s] (T, num, 3), `start`
    tool positions before the first tick [m] (num, 3).
    """
    error = norm(goals - trace.v_tool, axis=-1)
    drift = line_distance(trace.p_tool, goals, start)
    jerk = np.diff(trace.v_tool, n=2, axis=0) * machine.rate**2
    ticks = ticks_since_change(machine, goals)
    transient = (ticks >= 0) & (ticks < round(TRANSIENT * machine.rate))
    position_error = start + np.cumsum(goals, axis=0) * machine.dt - trace.p_tool
    moving = np.asarray(goals.any(axis=-1))
    creep_mean, creep_max = motion_at_rest(machine, goals, trace.p_tool, 2)
    joint_motion, _ = motion_at_rest(machine, goals, trace.q[..., machine.driven], np.inf)
    margin = np.minimum(trace.q - machine.column("q_min"), machine.column("q_max") - trace.q)
    at_limit = margin[..., machine.driven].min(axis=-1) < AT_LIMIT
    return {
        "velocity_rmse": np.sqrt(np.mean(error**2, axis=0)),
        "velocity_error_mean": error.mean(axis=0),
        "velocity_error_transient": mean_where(transient, error),
        "velocity_error_steady": mean_where(~transient, error),
        "velocity_error_moves": mean_where(moving, error),
        "velocity_error_rests": mean_where(~moving, error),
        "settling_time": settling_time(machine, error, goals),
        "off_axis_drift_max": drift.max(axis=0),
        "off_axis_drift_mean": drift.mean(axis=0),
        "position_error_mean": norm(position_error, axis=-1).mean(axis=0),
        "creep_mean": creep_mean,
        "creep_max": creep_max,
        "joint_motion_at_rest": joint_motion,
        "jerk_rms": np.sqrt(np.sum(jerk**2, axis=-1).sum(axis=0) / max(1, len(jerk))),
        "valve_travel": np.abs(np.diff(trace.u, axis=0, prepend=0 * trace.u[:1])).sum(axis=(0, 2)),
        "time_at_limits": at_limit.sum(axis=0) * machine.dt,
        "reward_mean": trace.reward.mean(axis=0),
    }


def motion_at_rest(machine: Machine, goals: Array, x: Array, order: float) -> tuple[Array, Array]:
    """How far x (T, num, k) goes in a rest from where it was `AFTER_STOP`: mean, largest (num,).

    Distances are norms of an `order`. Counted are rests after a motion of the goals [m/s]
    (T, num, 3), if they last longer than `AFTER_STOP`. NaN: there is none.
    """
    settle = round(AFTER_STOP * machine.rate)
    result = np.full((2, x.shape[1]), np.nan)
    for run in range(x.shape[1]):
        moving = goals[:, run].any(axis=-1)
        change = np.diff(moving.astype(int), prepend=0, append=1)
        stops, starts = np.flatnonzero(change == -1), np.flatnonzero(change == 1)
        ends = zip(stops, starts[1:], strict=True)  # of the rests
        rests = [x[stop + settle - 1 : end, run] for stop, end in ends]
        far = [norm(rest - rest[0], order, axis=-1).max() for rest in rests if len(rest) > 1]
        if far:
            result[:, run] = np.mean(far), np.max(far)
    return result[0], result[1]


def line_distance(p_tool: Array, goals: Array, start: Array) -> Array:
    """Distance of the tool from the commanded line [m], (T, num).

    The line starts where the tool was when the goal's direction last changed (to stop or to go
    back along the line is no change). On a curve the direction changes at every tick.
    `p_tool` are positions at the end of each tick [m] (T, num, 3), `goals` as in `metrics`, `start`
    positions before the first tick [m] (num, 3).
    """
    origin = start  # of the line
    direction = np.zeros_like(start)  # of the line; 0 before the first motion
    distance = []
    for p_before, p, goal in zip([start, *p_tool[:-1]], p_tool, goals, strict=True):
        speed = norm(goal, axis=-1, keepdims=True)
        heading = goal / np.maximum(speed, 1e-12)
        first = ~direction.any(axis=-1, keepdims=True)
        turned = norm(np.cross(direction, heading), axis=-1, keepdims=True) > 1e-6
        origin = np.where((speed > 0) & turned, p_before, origin)
        direction = np.where((speed > 0) & (turned | first), heading, direction)
        from_origin = p - origin
        along = np.sum(from_origin * direction, axis=-1, keepdims=True) * direction
        distance.append(norm(from_origin - along, axis=-1))
    return np.array(distance)


def ticks_since_change(machine: Machine, goals: Array) -> NDArray[np.int64]:
    """Ticks since goals (T, num, 3) last changed by more than `CHANGE`, (T, num); -1: not yet."""
    tick = np.arange(len(goals))[:, None]
    changed = _jumps(goals) > CHANGE * machine.tool_speed
    last = np.maximum.accumulate(np.where(changed, tick, -1), axis=0)
    return np.where(last < 0, -1, tick - last)


def _jumps(goals: Array) -> Array:
    """Change of goals (T, num, 3) from tick to tick, at first from rest [m/s], (T, num)."""
    return np.asarray(norm(np.diff(goals, axis=0, prepend=0 * goals[:1]), axis=-1))


def settling_time(machine: Machine, error: Array, goals: Array) -> Array:
    """Mean time [s] from a change of goal until the error stays in its band, (num,).

    If it does not before the next change, all time between the changes counts. NaN: no change.
    `error` [m/s] is (T, num), `goals` [m/s] (T, num, 3).
    """
    ticks = ticks_since_change(machine, goals)
    last_change = np.arange(len(goals))[:, None] - np.maximum(ticks, 0)
    jump = np.take_along_axis(_jumps(goals), last_change, axis=0)
    band = np.minimum(BAND * machine.tool_speed, BAND_OF_CHANGE * jump)
    unsettled = np.where((error > band) & (ticks >= 0), ticks + 1, 0)
    change = np.cumsum(ticks == 0, axis=0)  # number of the change before each tick, 0: none yet
    settled_after = np.zeros((change.max() + 1, error.shape[1]))  # ticks, of each change and run
    np.maximum.at(settled_after, (change, np.arange(error.shape[1])), unsettled)
    changes = change[-1]
    mean = settled_after[1:].sum(axis=0) * machine.dt / np.maximum(changes, 1)
    return np.where(changes > 0, mean, np.nan)


def mean_where(where: NDArray[np.bool_], values: Array) -> Array:
    """Mean over the first axis of (T, num) where `where` holds, (num,); NaN: nowhere."""
    return np.asarray(np.ma.array(values, mask=~where).mean(axis=0).filled(np.nan))


def evaluate(
    machine: Machine,
    controllers: Controllers,
    sequences: Sequence[Commands],
    starts: Array,
    seed: int,
    net: ActuatorNet | None = None,
    sensor: Callable[[np.random.Generator], Encoder] = lambda rng: read_encoder,
    config: TaskConfig | None = None,
) -> tuple[Rows, Traces]:
    """Run every controller on the same sequences, starts and noise. Paper: Sec. 4.2, Fig. 6

    `starts` are angles [rad] (starts, n); all starts and all sequences of one length are a batch.
    `net` has the nets of the driven joints (None: the analytic plant), `sensor` makes the encoders
    of each rollout, `config` has the noise. Returns one row per controller, sequence and start,
    see `metrics`; and traces. ValueError: two sequences of one name, a start out of range.
    """
    num = len(starts)
    names = [sequence.name for sequence in sequences]
    if len(set(names)) < len(names):
        raise ValueError(f"sequences: expected each name once, got {names}")
    if not ((starts >= machine.column("q_min")) & (starts <= machine.column("q_max"))).all():
        raise ValueError("starts: expected angles within the joints' ranges, got others")
    config = config or TaskConfig()
    kinds = start_kinds(machine, starts)
    traces: dict[tuple[str, str], Trace] = {}
    rows: dict[tuple[str, str], Rows] = {}
    lengths = dict.fromkeys(len(sequence.goals) for sequence in sequences)
    batches = [[s for s in sequences if len(s.goals) == length] for length in lengths]
    pairs = list(product(controllers, batches))
    for name, batch in progress(pairs, desc="evaluate", unit="batch"):
        goals = np.concatenate([sequence.for_starts(machine, starts) for sequence in batch], axis=1)
        q = np.tile(starts, (len(batch), 1))
        rng = np.random.default_rng(seed)
        read = sensor(np.random.default_rng(seed + 1))
        trace = rollout(machine, controllers[name], q, goals, config, rng, net, read)
        p_start = tool_position(forward_kinematics(machine, q))
        figures = metrics(machine, trace, goals, p_start)
        for i, sequence in enumerate(batch):
            pair = name, sequence.name
            part = slice(i * num, (i + 1) * num)
            traces[pair] = Trace(*(array[:, part] for array in trace))
            rows[pair] = _rows(pair, kinds, {key: v[part] for key, v in figures.items()})
    order = product(controllers, [sequence.name for sequence in sequences])
    return [row for pair in order for row in rows[pair]], traces


def _rows(pair: tuple[str, str], kinds: Sequence[str], figures: Mapping[str, Array]) -> Rows:
    """One row per start of the figures (starts,) of a controller and sequence."""
    rows = []
    for i, kind in enumerate(kinds):
        row: dict[str, Any] = dict(zip(LABELS, (*pair, i, kind), strict=True))
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


def by_start(runs: Sequence[Run], controller: str, sequence: str, key: str) -> Array:
    """One figure for each start (starts,), mean of its runs; `sequence` may be "all". NaN: none."""
    values: dict[int, list[float]] = {}
    for run in runs:
        if run["controller"] == controller and sequence in (run["sequence"], "all"):
            of_start = values.setdefault(run["start"], [])
            if run[key] is not None:
                of_start.append(run[key])
    return np.array([np.mean(v) if v else np.nan for _, v in sorted(values.items())])


def interval(values: Array) -> list[float | None]:
    """95 % confidence interval of the mean by Student's t, NaN left out; None: fewer than 2 values.

    Example:
        >>> [round(end, 3) for end in interval(np.array([1.0, 2.0, 3.0]))]
        [-0.484, 4.484]
    """
    from scipy.special import stdtrit  # Student's t quantile; slow to import

    values = values[np.isfinite(values)]
    if len(values) < 2:
        return [None, None]
    half = stdtrit(len(values) - 1, 0.975) * values.std(ddof=1) / math.sqrt(len(values))
    return [float(values.mean() - half), float(values.mean() + half)]


def _finite_mean(values: Array) -> float | None:
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else None


def mean_interval(values: Array) -> Mean:
    """Mean and ends of its `interval`: "mean", "low", "high"."""
    low, high = interval(values)
    return {"mean": _finite_mean(values), "low": low, "high": high}


def _names(runs: Sequence[Run], label: str) -> list[str]:
    """Controllers or sequences of runs, in their order."""
    return list(dict.fromkeys(run[label] for run in runs))


def _table(runs: Sequence[Run], statistic: Callable[[Array], T]) -> dict[str, Any]:
    """A statistic of the starts' values, by controller, sequence (also "all") and figure."""
    table: dict[str, dict[str, dict[str, T]]] = {c: {} for c in _names(runs, "controller")}
    figures = [key for key in runs[0] if key not in LABELS]
    for c, s in product(table, [*_names(runs, "sequence"), "all"]):
        table[c][s] = {key: statistic(by_start(runs, c, s, key)) for key in figures}
    return table


def summary(runs: Sequence[Run]) -> dict[str, dict[str, dict[str, float | None]]]:
    """Mean over starts by controller, sequence and figure; sequence "all" is over all of them."""
    return _table(runs, _finite_mean)


def intervals(runs: Sequence[Run]) -> dict[str, dict[str, dict[str, list[float | None]]]]:
    """95 % confidence intervals over starts of the means of `summary`."""
    return _table(runs, interval)


def paired_difference(runs: Sequence[Run], one: str, other: str, key: str) -> dict[str, Mean]:
    """A figure of one controller less another's on the same starts: mean, interval, by sequence."""
    return {
        s: mean_interval(by_start(runs, one, s, key) - by_start(runs, other, s, key))
        for s in [*_names(runs, "sequence"), "all"]
    }


def paired_differences(runs: Sequence[Run], one: str) -> dict[str, dict[str, dict[str, Mean]]]:
    """`paired_difference` of a controller to each other one, by figure and other controller."""
    others = [c for c in _names(runs, "controller") if c != one]
    figures = [key for key in runs[0] if key not in LABELS]
    return {key: {c: paired_difference(runs, one, c, key) for c in others} for key in figures}
