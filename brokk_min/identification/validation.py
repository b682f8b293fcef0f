"""Validation of actuator nets: one step and free runs on unseen recordings.

The error of one step says little, because over 50 ms the last velocity is nearly as good a
prediction. A policy trains on free runs of the nets, so their error after seconds is what counts.
"""

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from tqdm import tqdm

from brokk_min.actuator import PLANT, ActuatorNet, Plant, append_command, append_sample
from brokk_min.fit import Log, Samples, join_recordings, machine_log
from brokk_min.machine import PWM_MAX, Array, Machine, limit_command, read_encoder, require

HORIZONS = (1, 5, 10, 30)  # s, of the free runs


def free_run(
    net: ActuatorNet, samples: Samples, starts: NDArray[np.intp], ticks: int
) -> tuple[Array, Array]:
    """Errors of angle [rad] and velocity [rad/s] (ticks, s, n) of nets on their own outputs.

    Each run has the recorded commands and begins at one of the samples `starts` (s,), which have a
    history before them.
    """
    low, high = samples.q.min(axis=0), samples.q.max(axis=0)  # of the recordings
    q_error, v_error = np.empty((2, ticks, *samples.q[starts].shape))
    parts = max(1, math.ceil(len(starts) / 8192))  # bounds the memory
    for runs in np.array_split(np.arange(len(starts)), parts):
        at = starts[runs]
        rows = at[:, None] + np.arange(1 - net.history, 1)
        history = np.stack([samples.q[rows], samples.q_dot[rows], samples.u[rows - 1]])
        history = history.transpose(1, 3, 0, 2).astype(np.float32)  # (s, n, 3, H)
        q: Array = samples.q[at]
        for k in range(ticks):
            u = samples.u[at + k]
            velocity = net.predict(append_command(history, u))
            q = np.clip(q + velocity / net.rate, low, high)
            history = append_sample(history, u, q, net.velocity_samples, 1 / net.rate)
            q_error[k, runs] = q - samples.q[at + k + 1]
            v_error[k, runs] = history[..., 1, -1] - samples.q_dot[at + k + 1]
    return q_error, v_error


def scored_steps(log: Log, history: int) -> NDArray[np.intp]:
    """Samples from which one step can be scored; ValueError: there is none, or no motion."""
    samples = join_recordings(log)
    starts = samples.starts(history, 1, 1)
    wanted = f"a recording of more than {history + 1} samples to score on"
    require(len(starts) > 0, "log", wanted, samples.lengths[:9])
    require(bool(samples.moves[starts].any()), "log", "motion to score on", "none")
    return starts


def score(net: ActuatorNet, log: Log) -> dict[str, Any]:
    """One-step, persistence and free-run errors of each joint where it moves, as in the fit JSON.

    `one_step_rmse` is the error of the predicted target (see `join_recordings`), `persistence_rmse`
    that of the newest velocity in the history. Free runs start every `horizon` seconds:
    `velocity_rmse` is over all samples, `relative_error` this by the joint's rms speed,
    `position_error_median` over their ends.
    ValueError: another rate than the nets', or no recording long enough.
    """
    require(log.rate == net.rate, "rate", f"{net.rate}", log.rate)
    samples, starts = join_recordings(log), scored_steps(log, net.history)
    one_step = free_run(net, samples, starts, 1)[0][0] * net.rate
    persistence = samples.q_dot[starts] - samples.target[starts]
    result: dict[str, Any] = {name: {"free_run": {}} for name in net.joints}
    for j, scores in enumerate(result.values()):
        if (scored := samples.moves[starts, j]).any():
            scores["one_step_rmse"] = _rms(one_step[scored, j])
            scores["persistence_rmse"] = _rms(persistence[scored, j])
    for horizon in tqdm(HORIZONS, desc="score nets", unit="horizon", disable=None):
        ticks = round(horizon * net.rate)
        starts = samples.starts(net.history, ticks, ticks)
        if not len(starts):  # longer than all recordings
            break
        q_error, v_error = free_run(net, samples, starts, ticks)
        after = starts + np.arange(1, len(q_error) + 1)[:, None]
        for j, name in enumerate(log.joints):
            scored = samples.moves[starts, j]
            if scored.any():
                speed = _rms(samples.q_dot[after][:, scored, j])
                result[name]["free_run"][str(horizon)] = {
                    "velocity_rmse": _rms(v_error[:, scored, j]),
                    "relative_error": _rms(v_error[:, scored, j]) / speed if speed else None,
                    "position_error_median": float(np.median(np.abs(q_error[-1, scored, j]))),
                }
    return result


def _rms(error: Array) -> float:
    return float(np.sqrt(np.mean(np.square(error))))


def unscored(log: Log, history: int) -> Iterator[str]:
    """A warning for each joint that never moves where steps can be scored."""
    for name, moves in zip(log.joints, join_recordings(log).moves[scored_steps(log, history)].T):
        if not moves.any():
            yield f"{name}: expected a recording to score on in which it moves (--test), got none"


def warnings(scores: Mapping[str, Any]) -> Iterator[str]:
    """A warning for each net of `score` that is no better than the last velocity again."""
    for name, one in scores.items():
        if one.get("one_step_rmse", 0) > one.get("persistence_rmse", 0):
            yield f"{name}: expected a net that errs less than the last velocity again, got more"


def task_log(
    machine: Machine,
    recordings: int,
    seconds: float,
    rng: np.random.Generator,
    start: ArrayLike | None = None,
    plant: Plant = PLANT,
) -> Log:
    """Recordings under commands like a policy's: driven joints together, small corrections.

    In every fifth recording the locked joints move instead. Commands are smoothed random levels
    held for 0.5 to 5 s, less often towards the nearer end of the range. For validation only.
    `recordings` is their number, `seconds` the length of each [s]. All begin at the angles `start`
    (n,) [rad]; None: at random ones.
    """
    q_min, q_max = machine.column("q_min"), machine.column("q_max")
    shape, limit = (recordings, machine.n), machine.pwm_limit / PWM_MAX
    q = rng.uniform(0.8 * q_min + 0.2 * q_max, 0.2 * q_min + 0.8 * q_max, shape)
    if start is not None:
        q = np.tile(start, (recordings, 1))
    level, command, remaining = np.zeros((3, *shape))
    smoothing = rng.uniform(0.05, 0.6, shape)
    noise = rng.uniform(0, 0.06, shape)
    move_locked = (np.arange(recordings) % 5 == 4)[:, None]
    moving = np.isin(np.arange(machine.n), machine.locked) == move_locked
    state, u_log, q_log = plant.reset(machine, q), [], []
    for _ in range(round(seconds * machine.rate)):
        q_log.append(read_encoder(machine, state.q))
        fraction = (q_log[-1] - q_min) / (q_max - q_min)
        up = rng.random(shape) > np.clip(1.5 * fraction - 0.25, 0, 1)
        drawn = np.where(up, 1, -1) * rng.uniform(0, limit, shape) * (rng.random(shape) < 0.85)
        level = np.where(remaining <= 0, drawn, level)
        remaining = np.where(remaining <= 0, rng.uniform(0.5, 5.0, shape), remaining) - machine.dt
        command = command + smoothing * (level - command)
        jitter = noise * rng.standard_normal(shape) * (level != 0)
        u_log.append(limit_command(machine, moving * (command + jitter)))
        state = plant.step(machine, state, u_log[-1])
    u, q = np.stack(u_log, axis=1), np.stack(q_log, axis=1)
    return machine_log(machine, [(f"task_{i:02d}", u[i], q[i]) for i in range(recordings)])
