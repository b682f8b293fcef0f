"""Validation of actuator nets: free runs on unseen recordings, a linear reference, step responses.

The error of one step says little: over 50 ms the last velocity is nearly as good a prediction. A
policy trains on free runs of the nets, so their error after seconds is what counts.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brokk_min.actuator import ActuatorNet, input_rows
from brokk_min.identification.coupling import coupling, response_delays
from brokk_min.identification.logs import Log, Samples, driven, join_recordings
from brokk_min.identification.progress import progress
from brokk_min.identification.simulation import creep, free_run, log_response_times
from brokk_min.kinematics import forward_kinematics, tool_position
from brokk_min.machine import Array, Machine

ALLOWED_ERROR = 0.2  # of a joint's rms speed in free runs, assumed
COUPLED = 0.1  # of a joint's error, assumed: more that another joint explains is a warning
ALLOWED_OUTSIDE = 0.02  # of the samples, assumed: 0.2 % of the training are outside by definition
HORIZONS = (1, 5, 10, 30)  # s, of the free runs


def validate(
    net: ActuatorNet, log: Log, test: Log, machine: Machine | None = None
) -> dict[str, Any]:
    """Scores of nets fitted to `log` on unseen recordings `test`, as in the fit JSON.

    Each joint: `score` of the nets and, as `linear`, of a linear model; `creep` [rad/s];
    `response_time` of the nets and `machine_response_time` of a known machine [s]; `outside` as in
    `outside_training`; `coupling`: part of the errors of free runs of 1 s that each other joint
    explains, where known;
    `delay` [s] by `response_delays`. `tool`: `tool_errors` of a known machine [m].
    """
    joints = score(net, test)
    linear = score(fit_linear(net, log), test)
    speed = creep(net)
    outside = outside_training(log, test, net.history)
    times = log_response_times(net, log, machine)
    samples, second = join_recordings(test), round(net.rate)
    starts = samples.starts(net.history, second, second)
    explained = coupling(samples, starts, run_errors(net, samples, starts, second)[1])
    delays = response_delays(log)
    for j, name in enumerate(net.joints):
        joints[name]["linear"] = linear[name]
        pairs = zip(net.joints, explained[j], strict=True)
        joints[name]["coupling"] = {other: float(x) for other, x in pairs if np.isfinite(x)}
        joints[name]["delay"] = float(delays[j]) if np.isfinite(delays[j]) else None
        joints[name]["creep"] = float(speed[j])
        joints[name]["outside"] = {kind: float(fraction[j]) for kind, fraction in outside.items()}
        joints[name] |= {kind: of_joint[name] for kind, of_joint in times.items()}
    tool = tool_errors(machine, net, test) if machine else {}
    return {"joints": joints, "tool": tool, "warnings": _warnings(net, joints)}


def _warnings(net: ActuatorNet, joints: dict[str, Any]) -> list[str]:
    """Joints whose nets err much, are no better than the linear model, or lack inputs.

    Also joints that are tested outside their training.
    """
    warnings = large_errors(joints)
    shared = len(net.weights) > 6
    for name, scores in joints.items():
        others = [k for k, x in scores["coupling"].items() if x > COUPLED]
        if others:
            parts = ", ".join(f"{scores['coupling'][k]:.0%} by {k}" for k in others)
            remedy = "" if shared else ": record with --excitation joint, fit with --shared 4"
            warnings.append(f"{name}: its error is explained by other joints, {parts}{remedy}")
        if scores["delay"] and net.history / net.rate < scores["delay"]:
            span = f"{net.history} samples are {net.history / net.rate:.2f} s"
            late = f"it answers after {scores['delay']:.2f} s"
            warnings.append(f"{name}: {late}, {span}: fit with more --history or at a lower rate")
        for horizon, run in scores["free_run"].items():
            error = run["velocity_rmse"]
            reference = scores["linear"]["free_run"][horizon]["velocity_rmse"]
            if error >= reference:
                of_net = f"the error of a free run of {horizon} s is {error:.4f} rad/s"
                of_linear = f"that of a linear model {reference:.4f}"
                warnings.append(f"{name}: {of_net}, {of_linear}: the net is no better")
        for kind, fraction in scores["outside"].items():
            if fraction > ALLOWED_OUTSIDE:
                where = f"outside the training's range in {fraction:.0%} of the test"
                warnings.append(f"{name}: {kind} {where}")
    return warnings


def large_errors(joints: dict[str, Any]) -> list[str]:
    """Joints of `score` whose free runs of up to 10 s are off by a large part of their speed."""
    warnings = []
    for name, scores in joints.items():
        runs = {int(h): run for h, run in scores["free_run"].items() if int(h) <= 10}
        if runs and (part := runs[max(runs)]["relative_error"]) and part > ALLOWED_ERROR:
            of_speed = f"free runs of {max(runs)} s are off by {part:.0%} of its rms speed"
            warnings.append(f"{name}: {of_speed}: expected at most {ALLOWED_ERROR:.0%}")
    return warnings


def run_errors(
    net: ActuatorNet, samples: Samples, starts: NDArray[np.intp], ticks: int
) -> tuple[Array, Array]:
    """Errors of angle [rad] and velocity [rad/s] (ticks, s, n) in free runs from `starts` (s,)."""
    chunks = np.array_split(starts, max(1, math.ceil(len(starts) / 8192)))  # bounds the memory
    runs = [free_run(net, samples.joined, chunk, ticks) for chunk in chunks]
    q = np.concatenate([angles for angles, _ in runs], axis=1)
    q_dot = np.concatenate([velocities for _, velocities in runs], axis=1)
    after = starts + np.arange(1, ticks + 1)[:, None]
    return q - samples.joined.q[after], q_dot - samples.joined.q_dot[after]


def free_runs(
    net: ActuatorNet, samples: Samples
) -> Iterator[tuple[int, NDArray[np.intp], Array, Array]]:
    """Of each of `HORIZONS` [s]: first samples (s,) of free runs one after the other, `run_errors`.

    A horizon that is longer than all recordings, and longer ones, are left out.
    """
    for horizon in HORIZONS:
        ticks = round(horizon * net.rate)
        starts = samples.starts(net.history, ticks, ticks)
        if not len(starts):
            return
        yield horizon, starts, *run_errors(net, samples, starts, ticks)


def score(net: ActuatorNet, log: Log) -> dict[str, Any]:
    """One-step, persistence and free-run errors on recordings, as in the fit JSON.

    Each joint is scored where it moves. `one_step_rmse` is the error of the predicted target (see
    `join_recordings`), `persistence_rmse` that of the newest velocity in the history. Free runs
    start every `horizon` seconds: `velocity_rmse` is over all samples, `relative_error` this by the
    joint's rms speed, `position_error_median` over their ends.
    ValueError: other joints, rate or kind of velocity than the nets', or no recording long enough.
    """
    for name in ("joints", "rate", "velocity_logged"):
        if getattr(log, name) != getattr(net, name):
            raise ValueError(f"{name}: expected {getattr(net, name)}, got {getattr(log, name)}")
    samples = join_recordings(log)
    result = _one_step_scores(net, samples)
    runs = free_runs(net, samples)
    bar = progress(runs, desc="score nets", total=len(HORIZONS), unit="horizon")
    for horizon, starts, q_error, v_error in bar:
        after = starts + np.arange(1, len(q_error) + 1)[:, None]
        for j, name in enumerate(log.joints):
            scored = samples.moves[starts, j]
            if scored.any():
                speed = _rms(samples.joined.q_dot[after][:, scored, j])
                result[name]["free_run"][str(horizon)] = {
                    "velocity_rmse": _rms(v_error[:, scored, j]),
                    "relative_error": _rms(v_error[:, scored, j]) / speed if speed else None,
                    "position_error_median": float(np.median(np.abs(q_error[-1, scored, j]))),
                }
    return result


def _one_step_scores(net: ActuatorNet, samples: Samples) -> dict[str, Any]:
    starts = samples.starts(net.history, 1, 1)
    if not len(starts):
        got = samples.lengths[:9]
        raise ValueError(f"log: expected a recording above {net.history + 1} samples, got {got}")
    q_error, v_error = run_errors(net, samples, starts, 1)
    error = v_error[0] if net.velocity_logged else q_error[0] * net.rate
    persistence = samples.joined.q_dot[starts] - samples.target[starts]
    result: dict[str, Any] = {}
    for j, name in enumerate(net.joints):
        result[name] = {"free_run": {}}
        scored = samples.moves[starts, j]
        if scored.any():
            result[name]["one_step_rmse"] = _rms(error[scored, j])
            result[name]["persistence_rmse"] = _rms(persistence[scored, j])
    return result


def _rms(error: Array) -> float:
    return float(np.sqrt(np.mean(np.square(error))))


def recording_errors(net: ActuatorNet, log: Log, seconds: float) -> Array:
    """Velocity RMSE [rad/s] (recordings, n) of one free run of up to `seconds` from each start.

    nan: a joint that rests in this recording but not in all, or `history` + 1 samples or fewer.
    """
    moves = np.array([driven(recording) for recording in log.recordings])
    scored = moves | ~moves.any(axis=0)
    result = np.full(moves.shape, np.nan)
    for i, recording in enumerate(log.recordings):
        first = net.history + 1
        ticks = min(len(recording.q) - first, round(seconds * net.rate))
        if ticks > 0:
            _, velocities = free_run(net, recording, np.array([net.history]), ticks)
            error = velocities[:, 0] - recording.q_dot[first : first + ticks]
            result[i] = np.where(scored[i], np.sqrt(np.mean(error**2, axis=0)), np.nan)
    return result


def tool_errors(machine: Machine, net: ActuatorNet, test: Log) -> dict[str, float]:
    """Median distance [m] of the tool from the recorded one at the end of free runs, by horizon."""
    samples = join_recordings(test)
    result = {}
    for horizon, starts, q_error, _ in free_runs(net, samples):
        q = samples.joined.q[starts + len(q_error)]
        p_recorded = tool_position(forward_kinematics(machine, q))
        p_net = tool_position(forward_kinematics(machine, q + q_error[-1]))
        result[str(horizon)] = float(np.median(np.linalg.norm(p_net - p_recorded, axis=-1)))
    return result


@dataclass(frozen=True, eq=False, kw_only=True)
class LinearNet(ActuatorNet):
    """A linear model x w + b of the standardised inputs x; its output has the nets' range."""

    slopes: Array  # w, (n, I)
    offsets: Array  # b, (n,)

    def predict(self, history: Array) -> Array:
        """Velocity over the coming tick, as `ActuatorNet.predict`."""
        x = (self.inputs(history) - self.input_mean) / self.input_scale
        velocity = (x * self.slopes).sum(axis=-1) + self.offsets
        return np.asarray(np.clip(velocity, self.output_low, self.output_high))


def fit_linear(net: ActuatorNet, log: Log, penalty: float = 1e-3) -> LinearNet:
    """The reference that nets must beat: min mean |x w + b - target|^2 + penalty |w|^2."""
    samples = join_recordings(log)
    q, q_dot, u = samples.joined.q, samples.joined.q_dot, samples.joined.u
    signals = np.stack(input_rows(q, q_dot, u, net.dead_zone, net.indicator))
    slopes, offsets = [], []
    for j, ends in enumerate(samples.windows(net.history, 1)):
        windows = signals[:, ends[:, None] + np.arange(1 - net.history, 1), j]
        x = windows.transpose(1, 0, 2).reshape(len(ends), -1)
        x = (x - net.input_mean[j]) / net.input_scale[j]
        x = np.column_stack([x, np.ones(len(ends))])
        ridge = np.sqrt(penalty * len(ends)) * np.eye(x.shape[1])[:-1]  # the offset is free
        y = np.concatenate([samples.target[ends, j], np.zeros(len(ridge))])
        solution, *_ = np.linalg.lstsq(np.vstack([x, ridge]), y, rcond=None)
        slopes.append(solution[:-1])
        offsets.append(solution[-1])
    return LinearNet(**vars(net), slopes=np.array(slopes), offsets=np.array(offsets))


def outside_training(log: Log, test: Log, history: int) -> dict[str, Array]:
    """Fraction of the test's samples (n,) outside the middle 99.8 % of the training's, by kind.

    Kinds: command, change of command over a tick, mean command over a history, angle. Only samples
    count in which the joint moves.
    """
    tested = _signals(test, history)
    return {
        kind: np.array(list(map(_fraction_outside, training, tested[kind])))
        for kind, training in _signals(log, history).items()
    }


def _fraction_outside(training: Array, test: Array) -> float:
    if not len(test):
        return 0.0
    low, high = np.quantile(training, [0.001, 0.999])
    margin = 0.02 * (high - low) + 1e-6
    return float(np.mean((test < low - margin) | (test > high + margin)))


def _signals(log: Log, history: int) -> dict[str, list[Array]]:
    """Samples of each kind and joint, where the joint moves."""
    samples = join_recordings(log)
    at = samples.starts(history, 0, 1)
    u = samples.joined.u
    total = np.cumsum(np.concatenate([np.zeros_like(u[:1]), u]), axis=0)
    kinds = {
        "command": u[at],
        "change of command": u[at] - u[at - 1],
        "mean command": (total[at + 1] - total[at + 1 - history]) / history,
        "angle": samples.joined.q[at],
    }
    moves = samples.moves[at].T
    return {
        kind: [column[moving] for column, moving in zip(values.T, moves, strict=True)]
        for kind, values in kinds.items()
    }
