"""Can nets that were fitted to a log be trusted? Scores on unseen recordings, and what speaks against them.

For any log: a linear model that nets must beat, creep, response times, and whether the log covers what they
are scored on.
"""

from dataclasses import fields
from typing import Any

import numpy as np

from brokk_min import kinematics
from brokk_min.actuator import ActuatorNet
from brokk_min.evaluation.preliminary import (
    named_times,
    net_mover,
    plant_mover,
    response_times,
    step_commands,
    steps,
)
from brokk_min.identification import fitting
from brokk_min.identification import validation as scores
from brokk_min.identification.logs import Log
from brokk_min.machine import Array, Machine

ALLOWED_OUTSIDE = 0.02  # of the samples, assumed: 0.2 % of the training are outside by definition


def judge(net: ActuatorNet, log: Log, test: Log, machine: Machine | None = None) -> dict[str, Any]:
    """Scores of nets fitted to `log` on unseen recordings `test`, as in the fit JSON, with warnings.

    Each joint: what `scores.score` says of the nets and, as `linear`, of the linear model; `creep` at
    zero command [rad/s]; `response_time` of the nets and `machine_response_time` of a known machine [s];
    `outside` as in `outside_training`. `tool`: median error at the end of free runs of a known machine [m].
    """
    joints, warnings = scores.score(net, test), []
    floor = scores.score(fit_linear(net, log), test)
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
    angles = net_mover(net)(q, np.zeros((round(seconds * net.rate), *q.shape)))
    return np.asarray(np.abs(angles[-1] - q).max(axis=0) / seconds)


def _times(net: ActuatorNet, log: Log, machine: Machine | None) -> dict[str, dict[str, Any]]:
    """Response times to the largest command of a log, of the nets and of a known machine, by joint."""
    level = np.abs(np.concatenate([r.u for r in log.recordings])).max(axis=0)
    move, ends = net_mover(net), (net.q_low, net.q_high)
    wait = max(round(1.5 * net.rate), 2 * net.history)
    before = step_commands(move, *ends, level, wait)
    both = {"response_time": move} | (
        {"machine_response_time": plant_mover(machine)} if machine else {}
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
    samples = fitting.end_to_end(log)
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
    samples, result = fitting.end_to_end(test), {}
    for horizon in scores.HORIZONS:
        ticks = round(horizon * net.rate)
        starts = samples.starts(net.history, ticks, ticks)
        if len(starts):
            q_error, _ = scores.run_errors(net, samples, starts, ticks)
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
    training, history = fitting.training_set(log, net.history, dead_zone=net.dead_zone), net.history
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
