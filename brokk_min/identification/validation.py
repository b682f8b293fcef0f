"""How good nets are: on recordings that they never saw, running freely on their own predictions.

The error of one step says little: over 50 ms "the same velocity again" is nearly as good. What counts is how
far nets have gone astray after seconds, because a policy that learns on them lives there.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from brokk_min import kinematics
from brokk_min.actuator import (
    ActuatorNet,
    append_command,
    append_sample,
    initial_history,
    plant_reset,
    plant_step,
)
from brokk_min.identification.fitting import Samples, end_to_end, training_set
from brokk_min.identification.logs import Log, Recording
from brokk_min.machine import Array, Machine

ALLOWED_OUTSIDE = 0.02  # of the samples, assumed: 0.2 % of the training are outside by definition
RISE = 0.63  # paper's response times: 0.4 s and 0.1 s, read as the time to 63 % of the change
# angles (..., n) and commands (T, ..., n) -> angles (T+1, ..., n)
Simulator = Callable[[Array, Array], Array]
HORIZONS = (1, 5, 10, 30)  # s, of the free-run scores


def net_step(net: ActuatorNet, history: Array, q: Array, u: Array) -> tuple[Array, Array]:
    """History (..., n, 3, H) and angles (..., n) after one tick under `u`; the net alone moves.

    No joint goes further than it went in training.
    """
    low, high = np.minimum(q, net.q_low), np.maximum(q, net.q_high)
    moved = np.clip(q + net.predict(append_command(history, u)) / net.rate, low, high)
    result = append_sample(history, u, moved, net.velocity_samples, 1 / net.rate)
    if net.velocity_logged:
        result[..., 1, -1] = (moved - q) * net.rate
    return result, moved


def free_run(
    net: ActuatorNet, recording: Recording, starts: NDArray[np.intp], ticks: int
) -> tuple[Array, Array]:
    """Run the nets on their own predictions under the recorded commands.

    Each segment of `ticks` begins at one of the samples `starts` (s,), with H samples or more before it.

    Returns:
        Angle [rad] and velocity [rad/s] after each tick, (ticks, s, n) both.
    """
    rows = starts[:, None] + np.arange(1 - net.history, 1)
    history = np.stack([recording.q[rows], recording.q_dot[rows], recording.u[rows - 1]])
    history = history.transpose(1, 3, 0, 2).astype(np.float32)  # (s, n, 3, H)
    q: Array = recording.q[starts]
    trace = []
    for k in range(ticks):
        history, q = net_step(net, history, q, recording.u[starts + k])
        trace.append((q, history[..., 1, -1]))
    angles, velocities = np.moveaxis(np.array(trace), 1, 0)
    return angles, velocities


def score(net: ActuatorNet, log: Log) -> dict[str, Any]:
    """One-step, persistence and free-run errors of nets on recordings, as in the fit JSON.

    Each joint is scored on the recordings in which it is commanded or moves. `one_step_rmse` is the error
    of the next tick's prediction from the recorded history against what the nets are fitted to: the mean
    velocity over that tick by the encoders, or the next velocity of a log that has velocities.
    `persistence_rmse` is the error of the newest velocity in that history against the same target.

    Free runs start every `horizon` seconds of each recording; `velocity_rmse` is over all their samples,
    between velocities as the history shows them (estimated or logged), `position_error_median` is the
    median over segments of |angle error| at their end.

    ValueError: joints or velocities of another kind than the nets', or no recording long enough.
    """
    for name in ("joints", "rate", "velocity_logged"):
        if (found := getattr(log, name)) != (wanted := getattr(net, name)):
            raise ValueError(f"{name}: expected {wanted}, got {found}")
    samples = end_to_end(log)
    if not len(samples.starts(net.history, 1, 1)):
        got = samples.lengths[:9]
        raise ValueError(f"log: expected a recording above {net.history + 1} samples, got {got}")
    result: dict[str, Any] = {name: {"free_run": {}} for name in log.joints}
    for horizon in tqdm((1 / net.rate, *HORIZONS), desc="score nets", unit="horizon", disable=None):
        ticks = round(horizon * net.rate)
        for name, figures in _after(net, samples, ticks):
            if ticks == 1:
                result[name] |= figures
            else:
                result[name]["free_run"][str(horizon)] = figures
    return result


def _after(
    net: ActuatorNet, samples: Samples, ticks: int
) -> Iterator[tuple[str, dict[str, float]]]:
    """Figures of free runs of `ticks`, or of one step, for each joint that has any."""
    starts = samples.starts(net.history, ticks, ticks)
    if not len(starts):
        return
    q_error, v_error = run_errors(net, samples, starts, ticks)
    for j, scored in enumerate(samples.scored[starts].T):
        if not scored.any():
            continue
        if ticks == 1:
            error = v_error if net.velocity_logged else q_error * net.rate
            same = samples.whole.q_dot[starts, j] - samples.target[starts, j]
            figures = {
                "one_step_rmse": _rms(error[0, scored, j]),
                "persistence_rmse": _rms(same[scored]),
            }
        else:
            end = float(np.median(np.abs(q_error[-1, scored, j])))
            figures = {"velocity_rmse": _rms(v_error[:, scored, j]), "position_error_median": end}
        yield net.joints[j], figures


def run_errors(
    net: ActuatorNet, samples: Samples, starts: NDArray[np.intp], ticks: int
) -> tuple[Array, Array]:
    """Errors of angle [rad] and velocity [rad/s] in free runs from `starts` (s,), (ticks, s, n) both."""
    chunks = np.array_split(starts, -(-len(starts) // 8192))  # bounds the memory
    runs = [free_run(net, samples.whole, chunk, ticks) for chunk in chunks]
    angles, velocities = (np.concatenate(run, axis=1) for run in zip(*runs, strict=True))
    later = starts + np.arange(1, ticks + 1)[:, None]
    return angles - samples.whole.q[later], velocities - samples.whole.q_dot[later]


def recording_errors(net: ActuatorNet, log: Log, seconds: float) -> Array:
    """Velocity RMSE [rad/s] (recordings, n) of one free run of up to `seconds` from the start of each.

    nan: a joint that rests in this recording but not in all, or `history` + 1 samples or fewer.
    """
    samples, lengths = end_to_end(log), np.array([len(r.q) for r in log.recordings])
    ticks = np.minimum(lengths - net.history - 1, round(seconds * net.rate))  # of each run
    result = np.full((len(lengths), len(net.joints)), np.nan)
    if not (long := np.flatnonzero(ticks > 0)).size:
        return result
    starts, most = (np.cumsum(lengths) - lengths)[long] + net.history, int(ticks.max())
    tail = ((0, most), (0, 0))  # shorter runs go on into what follows, unscored
    whole = Recording("", *(np.pad(array, tail, mode="edge") for array in samples.whole[1:]))
    _, velocities = free_run(net, whole, starts, most)
    error = velocities - whole.q_dot[starts + np.arange(1, most + 1)[:, None]]
    scored = (np.arange(most)[:, None] < ticks[long])[..., None]
    rms = np.sqrt(np.sum(np.where(scored, error, 0.0) ** 2, axis=0) / ticks[long, None])
    result[long] = np.where(samples.scored[starts], rms, np.nan)
    return result


def _rms(error: Array) -> float:
    return float(np.sqrt(np.mean(np.square(error))))


# --- step responses ---


def plant_simulator(machine: Machine) -> Simulator:
    """The analytic plant from rest."""

    def move(q: Array, u: Array) -> Array:
        state = plant_reset(machine, q)
        angles = [state.q]
        for command in u:
            state = plant_step(machine, state, command)
            angles.append(state.q)
        return np.array(angles)

    return move


def net_simulator(net: ActuatorNet) -> Simulator:
    """The nets from rest."""

    def move(q: Array, u: Array) -> Array:
        history = initial_history(q, net.history).astype(np.float32)
        angles = [q]
        for command in u:
            history, q = net_step(net, history, q, command)
            angles.append(q)
        return np.array(angles)

    return move


def steps(
    move: Simulator, q_low: Array, q_high: Array, level: Array, before: Array, wait: int
) -> Array:
    """Angles (2 wait + 1, 2, 2, n, n) around a step of each joint alone to the command `level` (n,).

    Axes: tick; from idle, or out of a motion under `before` (n,); up, down; stepping joint; joint. The
    step comes after `wait` ticks. A joint begins a tenth of its range off the end behind it.
    Paper: Sec. 3.2 (past movement)
    """
    n = len(level)
    sign, own = np.array([1, -1])[:, None, None], np.eye(n, dtype=bool)
    behind = np.where(sign > 0, 0.9 * q_low + 0.1 * q_high, 0.1 * q_low + 0.9 * q_high)
    q = np.broadcast_to(np.where(own, behind, (q_low + q_high) / 2), (2, 2, n, n))
    u = np.zeros((2 * wait, 2, 2, n, n))
    u[:wait, 1] = sign * own * before
    u[wait:] = sign * own * level
    return move(q, u)


def step_velocity(angles: Array, rate: float) -> Array:
    """Velocity of each stepping joint in its direction [rad/s] (2 wait, 2, 2, n): positive in both."""
    return np.asarray(
        np.diff(np.diagonal(angles, axis1=3, axis2=4), axis=0) * rate * np.array([[1], [-1]])
    )


def response_times(angles: Array, rate: float) -> Array:
    """Time [s] from the step to 63 % of the change of velocity, (2, 2, n) as in `steps`; nan: no change.

    Velocities are means over a tick and stand at its middle; between ticks the curve is a line.
    """
    wait = (len(angles) - 1) // 2
    after = step_velocity(angles, rate)[wait - 1 :]
    change = after.max(axis=0) - after[0]
    done = (after - after[0]) / np.where(change > 1e-3, change, np.nan)
    at = np.maximum(
        np.argmax(done >= RISE, axis=0), 1
    )  # row k is the tick that begins k - 1 after the step
    high, low = (np.take_along_axis(done, k[None], axis=0)[0] for k in (at, at - 1))
    times: Array = (at - 0.5 - (high - RISE) / (high - low)) / rate
    return times


def step_commands(move: Simulator, q_low: Array, q_high: Array, level: Array, wait: int) -> Array:
    """Commands (n,) half way to `level` from the least tenth of it at which a joint moves, up and down."""
    shares, speeds = np.arange(1, 11) / 10, []
    for share in shares:
        angles = steps(move, q_low, q_high, share * level, share * level, wait)
        speeds.append(step_velocity(angles, 1.0)[wait:, 0].max(axis=0).min(axis=0))  # (n,)
    moves = np.array(speeds) > 0.05 * speeds[-1]
    return np.asarray((shares[np.argmax(moves, axis=0)] + 1) / 2 * level)


def named_times(times: Array, joints: Sequence[str]) -> dict[str, Any]:
    """Response times by joint, for JSON: {joint: {"idle": {"up", "down"}, "moving": {...}}} [s or None]."""

    def plain(time: float) -> float | None:
        return None if np.isnan(time) else float(time)

    return {
        name: {
            kind: {"up": plain(up), "down": plain(down)}
            for kind, (up, down) in zip(("idle", "moving"), times[..., j], strict=True)
        }
        for j, name in enumerate(joints)
    }


def validate(
    net: ActuatorNet, log: Log, test: Log, machine: Machine | None = None
) -> dict[str, Any]:
    """Scores of nets fitted to `log` on unseen recordings `test`, as in the fit JSON, with warnings.

    Each joint: what `score` says of the nets and, as `linear`, of the linear model; `creep` at
    zero command [rad/s]; `response_time` of the nets and `machine_response_time` of a known machine [s];
    `outside` as in `outside_training`. `tool`: median error at the end of free runs of a known machine [m].
    """
    joints, warnings = score(net, test), []
    floor = score(fit_linear(net, log), test)
    still, outside, times = (
        creep(net),
        outside_training(log, test, net.history),
        _times(net, log, machine),
    )
    for j, (name, found) in enumerate(joints.items()):
        found |= {
            "linear": floor[name],
            "creep": float(still[j]),
            **{k: t[name] for k, t in times.items()},
        }
        found["outside"] = {kind: float(share[j]) for kind, share in outside.items()}
        for horizon, mine in found["free_run"].items():
            other = floor[name]["free_run"][horizon]["velocity_rmse"]
            if mine["velocity_rmse"] >= other:
                warnings.append(
                    f"{name}: a free run of {horizon} s is off by {mine['velocity_rmse']:.4f} rad/s, "
                    f"a linear model only by {other:.4f}: the net is no better"
                )
        for kind, share in found["outside"].items():
            if share > ALLOWED_OUTSIDE:
                warnings.append(
                    f"{name}: {kind} outside the training's range in {share:.0%} of the test"
                )
    tool = tool_errors(machine, net, test) if machine else {}
    return {"joints": joints, "tool": tool, "warnings": warnings}


def creep(net: ActuatorNet) -> Array:
    """Largest speed [rad/s] (n,) of joints left without a command for 10 s, from 21 angles over the range."""
    seconds, q = 10.0, np.linspace(net.q_low, net.q_high, 21)
    angles = net_simulator(net)(q, np.zeros((round(seconds * net.rate), *q.shape)))
    return np.asarray(np.abs(angles[-1] - q).max(axis=0) / seconds)


def _times(net: ActuatorNet, log: Log, machine: Machine | None) -> dict[str, dict[str, Any]]:
    """Response times to the largest command of a log, of the nets and of a known machine, by joint."""
    level = np.abs(np.concatenate([r.u for r in log.recordings])).max(axis=0)
    move, ends = net_simulator(net), (net.q_low, net.q_high)
    wait = max(round(1.5 * net.rate), 2 * net.history)
    before = step_commands(move, *ends, level, wait)
    both = {"response_time": move} | (
        {"machine_response_time": plant_simulator(machine)} if machine else {}
    )
    return {
        name: named_times(
            response_times(steps(m, *ends, level, before, wait), net.rate), net.joints
        )
        for name, m in both.items()
    }


def outside_training(log: Log, test: Log, history: int) -> dict[str, Array]:
    """Share of the test's samples (n,) outside the middle 99.8 % of the training's, by kind.

    Kinds: command, change of command over a tick (fast end of the band), mean command over a history
    (slow end), angle. A joint is judged where it moves.
    """
    known, seen = _signals(log, history), _signals(test, history)
    result = {}
    for kind in known:
        ends = [np.quantile(x, [0.001, 0.999]) for x in known[kind]]
        slack = [0.02 * (high - low) + 1e-6 for low, high in ends]
        pairs = zip(seen[kind], ends, slack, strict=True)
        result[kind] = np.array(
            [np.mean((x < e[0] - s) | (x > e[1] + s)) if len(x) else 0.0 for x, e, s in pairs]
        )
    return result


def _signals(log: Log, history: int) -> dict[str, list[Array]]:
    samples = end_to_end(log)
    at, u = samples.starts(history, 0, 1), samples.whole.u
    total = np.cumsum(np.concatenate([0 * u[:1], u]), axis=0)
    kinds = {
        "command": u[at],
        "change of command": u[at] - u[at - 1],
        "mean command": (total[at + 1] - total[at + 1 - history]) / history,
        "angle": samples.whole.q[at],
    }
    moves = samples.moves[at]
    return {
        kind: [x[m] for x, m in zip(values.T, moves.T, strict=True)]
        for kind, values in kinds.items()
    }


def tool_errors(machine: Machine, net: ActuatorNet, test: Log) -> dict[str, float]:
    """Median distance [m] of the tool from the recorded one at the end of free runs, by horizon."""
    samples, result = end_to_end(test), {}
    for horizon in HORIZONS:
        ticks = round(horizon * net.rate)
        starts = samples.starts(net.history, ticks, ticks)
        if len(starts):
            q_error, _ = run_errors(net, samples, starts, ticks)
            recorded = samples.whole.q[starts + ticks]
            ends = (
                kinematics.tool_position(kinematics.forward_kinematics(machine, q))
                for q in (recorded, recorded + q_error[-1])
            )
            apart = np.linalg.norm(next(ends) - next(ends), axis=-1)
            result[str(horizon)] = float(np.median(apart))
    return result


# --- what nets must beat ----------------------------------------------------------------------------


class LinearModel(ActuatorNet):
    """A linear model of the nets' inputs within the nets' range: what a net must beat.

    Weights (n, 3 H) and (n,), for standardised inputs.
    """

    def velocity(self, history: Array) -> Array:
        """What the model says, as `ActuatorNet.predict`."""
        slope, offset = self.weights
        inputs = (self.inputs(history) - self.input_mean) / self.input_scale
        velocity = (inputs * slope).sum(axis=-1) + offset
        return np.asarray(np.clip(velocity, self.output_low, self.output_high))


def fit_linear(net: ActuatorNet, log: Log, penalty: float = 1e-3) -> LinearModel:
    """Ridge regression on the inputs, targets and recordings that `net` was fitted to.

    Args:
        penalty: on squared weights, in units of the mean squared error of standardised inputs.
    """
    training, history = training_set(log, net.history, dead_zone=net.dead_zone), net.history
    slopes, offsets = [], []
    for j, ends in enumerate(training.ends):
        size = 3 * history + 1
        gram, moment = np.zeros((size, size)), np.zeros(size)
        for chunk in np.array_split(ends, -(-len(ends) // 8192)):  # bounds the memory
            x = training.series[:, j, chunk[:, None] + np.arange(1 - history, 1)].swapaxes(0, 1)
            x = (x.reshape(len(chunk), -1) - training.input_mean[j]) / training.input_scale[j]
            x = np.column_stack([x, np.ones(len(chunk))])
            gram, moment = gram + x.T @ x, moment + x.T @ training.target[chunk, j]
        ridge = penalty * len(ends) * np.eye(size)
        ridge[-1, -1] = 0.0  # the offset is free
        *slope, offset = np.linalg.solve(gram + ridge, moment)
        slopes.append(slope)
        offsets.append(offset)
    header = {f.name: getattr(net, f.name) for f in fields(net)} | {
        "settings": {"penalty": penalty}
    }
    return LinearModel(
        **header | {"weights": (np.array(slopes, np.float32), np.array(offsets, np.float32))}
    )
