"""Sentences of the paper, each with what was measured of it and a verdict, in the paper's order.

`claims.toml` has the sentences and the limits of the verdicts. Intervals are over starts.
Paper: Sec. 3.2, 3.4, 4.1, 4.2, 5
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from brokk_min.env import integrate_error
from brokk_min.evaluation.baselines import PAPER_BASELINES, WITH_FEEDFORWARD
from brokk_min.evaluation.metrics import (
    TRANSIENT,
    Mean,
    Run,
    by_start,
    interval,
    mean_interval,
    paired_difference,
    ticks_since_change,
)
from brokk_min.evaluation.rollout import Controller, Trace
from brokk_min.jacobian import JacobianController, manipulability
from brokk_min.kinematics import forward_kinematics, jacobian
from brokk_min.machine import Array, Machine

TEXTS: dict[str, dict[str, Any]] = tomllib.loads(
    Path(__file__).with_suffix(".toml").read_text("utf-8")
)
STRONG, WEAK = PAPER_BASELINES  # damping
VERDICTS = {True: "holds here", False: "does not hold here", None: "was not measured"}


class Claim(NamedTuple):
    """A sentence of the paper, and what was measured of it."""

    name: str  # in `claims.toml`
    numbers: Mapping[str, Mean]
    holds: bool | None  # None: it was not measured
    stronger: Claim | None = None  # the same of a baseline that the paper does not have

    def to_json(self) -> dict[str, Any]:
        """The claim as in `results.json`."""
        text = TEXTS[self.name]
        measure = text["measure"].format(limit=text.get("limit"))
        result = {
            "figure": text["figure"],
            "paper": text["paper"],
            "measured": f"{measure}: {format_numbers(self.numbers, text['unit'])}",
            "numbers": self.numbers,
            "unit": text["unit"],
            "holds": self.holds,
        }
        if self.stronger:
            result["stronger"] = self.stronger.to_json()
        return result


def format_numbers(numbers: Mapping[str, Mean], unit: str) -> str:
    """Means with their intervals as text.

    Example:
        >>> format_numbers({"rl": {"mean": 1.0, "low": 0.5, "high": 1.5}}, "m")
        'rl 1 (0.5 to 1.5) [m]'
    """
    texts = []
    for name, number in numbers.items():
        mean = "none" if number["mean"] is None else f"{number['mean']:.3g}"
        ends = "" if number["low"] is None else f" ({number['low']:.3g} to {number['high']:.3g})"
        texts.append(f"{name} {mean}{ends}")
    return f"{'; '.join(texts)} [{unit}]"


def _below(limit: float, *numbers: Mean) -> bool | None:
    """Are all intervals below a limit? None: a number has no interval."""
    highs = [number["high"] for number in numbers if number["high"] is not None]
    return max(highs) < limit if len(highs) == len(numbers) else None


def _above(limit: float, *numbers: Mean) -> bool | None:
    lows = [number["low"] for number in numbers if number["low"] is not None]
    return min(lows) > limit if len(lows) == len(numbers) else None


def _limit(name: str) -> float:
    return float(TEXTS[name]["limit"])


def _both(one: bool | None, other: bool | None) -> bool | None:
    return None if one is None or other is None else one and other


def net_claims(numbers: Mapping[str, Any]) -> list[Claim]:
    """Do machine and nets behave as the paper's? `numbers` is of `preliminary.numbers`.

    Single tests, so without intervals. Paper: Sec. 3.2 and 4.1, Fig. 2 and 5
    """
    kinds = ("machine", "nets")
    up, down = list(numbers["sweep"])[1:3]  # at the limit
    sweep = numbers["sweep"]
    peaks = {f"{kind}, {u}": sweep[u][f"{kind}_peak"] for kind in kinds for u in (up, down)}
    faster = all(peaks[f"{kind}, {down}"] > peaks[f"{kind}, {up}"] for kind in kinds)
    times = {}
    for kind in kinds:
        for start, of_start in numbers["response_time"][kind][numbers["joint"]].items():
            times[f"{kind}, {start}"] = of_start["up"]
    slower = None
    if all(time is not None for time in times.values()):
        limit = _limit("idle")
        slower = all(times[f"{k}, idle"] >= limit * times[f"{k}, moving"] for k in kinds)
    coupling = numbers["coupling_rms"]
    spread = numbers["sim_to_real"]["tool_position_error_mean_of_runs"]
    gap = {"in the figure": numbers["sim_to_real"]["tool"]["position_error_mean"]}
    gap["median of runs"] = spread["median"]
    return [
        Claim("gravity", _exact(peaks), faster),
        Claim("idle", _exact(times), slower),
        Claim("coupling", _exact(coupling), max(coupling.values()) < _limit("coupling")),
        Claim("gap", _exact(gap), max(gap.values()) < _limit("gap")),
    ]


def _exact(numbers: Mapping[str, float | None]) -> dict[str, Mean]:
    return {name: {"mean": number, "low": None, "high": None} for name, number in numbers.items()}


def training_claim(seconds: float, steps: int) -> Claim:
    """Does training take as long as the paper's? For the report alone. Paper: Sec. 3.4"""
    hours = seconds / 3600
    holds = 1 / _limit("training") < hours / 2.5 < _limit("training")
    return Claim("training", _exact({f"{steps:,} steps here": hours}), holds)


def task_claims(
    machine: Machine,
    policy: str,
    pids: Mapping[str, JacobianController],
    runs: Sequence[Run],
    along_x: Mapping[str, Trace],
    goals: Array,
    singular: Sequence[Claim],
) -> list[Claim]:
    """The claims on task-space control, of a policy; those on baselines also of a stronger one.

    `runs` are those that count, `along_x` their traces along x by controller with these `goals`
    [m/s] (T, num, 3), `singular` is of `singular_claims`. Paper: Sec. 4.2, Fig. 6
    """

    def of_baselines(names: Sequence[str]) -> list[Claim]:
        along_z = ["velocity_error_mean", "off_axis_drift_max"]
        return [
            drift_claim(runs, policy, names),
            direction_claim(machine, pids[names[0]], along_x[names[0]], goals),
            less_claim("tracking", runs, policy, names, "xyz"),
            less_claim("along z", runs, policy, names, "z", along_z),
            less_claim("outperforms", runs, policy, names, ["all"]),
        ]

    papers, stronger = of_baselines(PAPER_BASELINES), of_baselines(WITH_FEEDFORWARD)
    both = [a._replace(stronger=b) for a, b in zip(papers, stronger, strict=True)]
    return [still_claim(runs, policy), *both[:2], *singular, *both[2:]]


def still_claim(runs: Sequence[Run], policy: str) -> Claim:
    """Do y and z stay still while the policy moves the tool along x? Paper: Fig. 6b"""
    drift = mean_interval(by_start(runs, policy, "x", "off_axis_drift_max"))
    return Claim("still", {policy: drift}, _below(_limit("still"), drift))


def drift_claim(runs: Sequence[Run], policy: str, baselines: Sequence[str]) -> Claim:
    """Do y and z move while baselines move the tool along x? Paper: Fig. 6b"""
    key = "off_axis_drift_max"
    means = {c: mean_interval(by_start(runs, c, "x", key)) for c in baselines}
    more = {f"{c} less {policy}": paired_difference(runs, c, policy, key)["x"] for c in baselines}
    holds = _both(_above(_limit("drift"), *means.values()), _above(0.0, *more.values()))
    return Claim("drift", means | more, holds)


def direction_claim(
    machine: Machine, controller: JacobianController, trace: Trace, goals: Array
) -> Claim:
    """Does the PID track joint velocities as well in one direction as in the other? Paper: Fig. 6d

    `trace` has the runs of one sequence with these `goals` [m/s] (T, num, 3).
    """
    q_dot = trace.q_dot[..., machine.driven]
    desired = desired_velocities(machine, controller, trace, goals)
    numbers: dict[str, Mean] = {}
    verdicts = []
    for i, joint in enumerate(machine.driven):
        up = _relative_error(q_dot[..., i], desired[..., i])
        down = _relative_error(-q_dot[..., i], -desired[..., i])
        numbers[f"{machine.names[joint]} up"] = mean_interval(up)
        numbers[f"{machine.names[joint]} down"] = mean_interval(down)
        verdicts.append(_differ(up, down))
    measured = [verdict for verdict in verdicts if verdict is not None]
    return Claim("direction", numbers, any(measured) if measured else None)


def desired_velocities(
    machine: Machine, controller: JacobianController, trace: Trace, goals: Array
) -> Array:
    """What the PID wanted of the driven joints in each tick [rad/s], (T, num, n_driven).

    Tick by tick as `JacobianController` does, from the encoders' angles and the true velocity of
    the tool at the end of the tick before.
    """
    last = np.zeros_like(trace.q_dot[0][..., machine.driven])
    v_tool, integral = np.zeros_like(trace.v_tool[0]), np.zeros_like(trace.v_tool[0])
    result = []
    for t, goal in enumerate(goals):
        last = controller.desired_velocities(goal, v_tool, trace.q_measured[t], last, integral)
        result.append(last)
        v_tool = trace.v_tool[t]
        integral = integrate_error(machine, goal, v_tool, integral)
    return np.array(result)


def _relative_error(q_dot: Array, desired: Array) -> Array:
    """Error over desired velocity, of (T, starts) while that is positive, (starts,); NaN: never."""
    moving = desired > 0.02  # rad/s, assumed: well above the encoder's steps
    error = np.sum(np.abs(desired - q_dot) * moving, axis=0)
    total = np.sum(desired * moving, axis=0)
    return np.where(moving.sum(axis=0) > 10, error / np.maximum(total, 1e-9), np.nan)


def _differ(up: Array, down: Array) -> bool | None:
    """Do two values per start (starts,) differ by a factor? None: too few values."""
    low, high = interval(up - down)
    means = [mean_interval(values)["mean"] for values in (up, down)]
    sizes = [mean for mean in means if mean]
    if low is None or high is None or len(sizes) < 2:
        return None
    return max(sizes) / min(sizes) > _limit("direction") and not low < 0 < high


def less_claim(
    name: str,
    runs: Sequence[Run],
    policy: str,
    baselines: Sequence[str],
    sequences: Sequence[str],
    keys: Sequence[str] = ("velocity_error_mean",),
) -> Claim:
    """Are figures of the policy less than those of all baselines? Paper: Fig. 6c, 6f, 6h, Sec. 5"""
    labels = {"velocity_error_mean": "error", "off_axis_drift_max": "drift"}
    numbers = {
        f"{labels[key]} {s}, less {c}": paired_difference(runs, policy, c, key)[s]
        for key, s, c in product(keys, sequences, baselines)
    }
    return Claim(name, numbers, _below(0.0, *numbers.values()))


def singular_controllers(
    policies: Mapping[str, Controller], pids: Mapping[str, JacobianController]
) -> dict[str, Controller]:
    """Policies, and one baseline with strong and with weak damping and the same gains."""
    return {**policies, STRONG: pids[STRONG], WEAK: replace(pids[STRONG], k=0.05)}


def speed_fraction(machine: Machine, w0: float, trace: Trace, goals: Array) -> Array:
    """Speed along the goal over the goal's near singularities, (num,); NaN: never there.

    Of ticks below the manipulability `w0` at which the goal [m/s] (T, num, 3) held for `TRANSIENT`.
    """
    steady = ticks_since_change(machine, goals) >= round(TRANSIENT * machine.rate)
    J = jacobian(forward_kinematics(machine, trace.q))[..., machine.driven]
    near = steady & (manipulability(J) < w0) & np.any(goals, axis=-1)
    along = np.sum(np.sum(trace.v_tool * goals, axis=-1) * near, axis=0)
    square = np.sum(np.sum(goals * goals, axis=-1) * near, axis=0)
    return np.where(near.any(axis=0), along / np.maximum(square, 1e-12), np.nan)


def singular_claims(policy: str, runs: Sequence[Run], speed: Mapping[str, Array]) -> list[Claim]:
    """Does damping slow the tool near singularities, and does little damping jerk?

    `runs` are of `singular_controllers`, `speed` is their `speed_fraction` (starts,).
    Paper: Fig. 6a, 6e, 6f
    """
    jerk = {name: by_start(runs, name, "all", "jerk_rms") for name in speed}
    slower = mean_interval(speed[STRONG] - speed[WEAK])
    jerkier = mean_interval(jerk[WEAK] - jerk[STRONG])
    faster = mean_interval(speed[policy] - speed[WEAK])
    smoother = mean_interval(jerk[policy] - jerk[STRONG])
    damping = {"k 0.1": STRONG, "k 0.05": WEAK}
    speeds = {k: mean_interval(speed[name]) for k, name in damping.items()}
    jerks = {k: mean_interval(jerk[name]) for k, name in damping.items()}
    own = {f"{policy} speed": mean_interval(speed[policy]), "speed less k 0.05": faster}
    own |= {f"{policy} jerk": mean_interval(jerk[policy]), "jerk less k 0.1": smoother}
    return [
        Claim("slowed", speeds | {"k 0.1 less k 0.05": slower}, _below(0.0, slower)),
        Claim("jerky", jerks | {"k 0.05 less k 0.1": jerkier}, _above(0.0, jerkier)),
        Claim("neither", own, _both(_above(0.0, faster), _below(0.0, smoother))),
    ]
