"""How good nets are: on recordings that they never saw, running freely on their own predictions.

The error of one step says little: over 50 ms "the same velocity again" is nearly as good. What counts is how
far nets have gone astray after seconds, because a policy that learns on them lives there.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from brokk_min.actuator import ActuatorNet, append_sample
from brokk_min.identification.fitting import Samples, end_to_end
from brokk_min.identification.logs import Log, Recording
from brokk_min.machine import Array

HORIZONS = (1, 5, 10, 30)  # s, of the free-run scores


def net_step(net: ActuatorNet, history: Array, q: Array, u: Array) -> tuple[Array, Array]:
    """History (..., n, 3, H) and angles (..., n) after one tick under `u`; the net alone moves.

    No joint goes further than it went in training.
    """
    low, high = np.minimum(q, net.q_low), np.maximum(q, net.q_high)
    moved = net.next_angles(history, q, u, low, high)
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
