"""What the paper says of task space control, each sentence as numbers and a verdict.

Limits by which a verdict is given are ours (assumed); the intervals are over starts. Paper: Sec. 4.2
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from brokk_min.evaluation.metrics import (
    TRANSIENT,
    Mean,
    Run,
    by_start,
    interval,
    mean_interval,
    ticks_since_change,
)
from brokk_min.evaluation.rollout import Controller, Trace
from brokk_min.jacobian import JacobianController, manipulability
from brokk_min.kinematics import forward_kinematics, jacobian
from brokk_min.machine import Array, Machine

Claim = dict[str, Any]  # paper, measured, numbers, unit, holds (None: no such runs); see `beside`
STANDSTILL = 0.05  # m, assumed: a tool that stays so near its line stays still across it
SMALL = 0.05  # m, assumed: two tools so near to each other after the same commands differ little
MARGINAL = 0.01  # rad/s, assumed: joint rates that differ by less differ marginally
LATER = 2.0  # assumed: a response that takes so many times as long is another
UNLIKE = 1.25  # assumed: errors of two directions whose ratio is larger differ


def said(numbers: Mapping[str, Mean], unit: str) -> str:
    """Numbers as a sentence: means with their intervals."""
    cells = []
    for name, n in numbers.items():
        ends = "" if n["low"] is None else f" ({n['low']:.3g} to {n['high']:.3g})"
        cells.append(f"{name} none" if n["mean"] is None else f"{name} {n['mean']:.3g}{ends}")
    return "; ".join(cells) + f" [{unit}]"


def _claim(
    paper: str, what: str, unit: str, numbers: Mapping[str, Any], holds: bool | None
) -> Claim:
    measured = f"{what}: {said(numbers, unit)}"
    return {"paper": paper, "measured": measured, "numbers": numbers, "unit": unit, "holds": holds}


def beside(claim: Claim, stronger: Claim) -> Claim:
    """A claim, and as "stronger" how it fares against a baseline that the paper does not have.

    Example:
        >>> claim, other = ({"numbers": {c: 1}, "unit": "m", "holds": c} for c in (True, False))
        >>> beside(claim, other)["stronger"]["holds"], "stronger" in beside(claim, claim)
        (False, False)
    """
    same = claim["numbers"] == stronger["numbers"]  # of RL alone
    return (
        claim
        if same
        else claim | {"stronger": {k: stronger[k] for k in ("numbers", "unit", "holds")}}
    )


def _below(number: Mean, limit: float) -> bool | None:
    return None if number["high"] is None else number["high"] < limit


def _above(number: Mean, limit: float) -> bool | None:
    return None if number["low"] is None else number["low"] > limit


def _all(*verdicts: bool | None) -> bool | None:
    return None if None in verdicts else all(verdicts)


def net_claims(found: Mapping[str, Any]) -> list[Claim]:
    """Are machine and nets as the paper found its own (Fig. 2 and 5)? Paper: Sec. 3.2

    Single tests, so without intervals. `found`: of `preliminary.run`.
    """
    gap = found["sim_to_real"]
    apart = {"in the figure": gap["tool"]["position_error_mean"]}
    apart["median of runs"] = gap["tool_position_error_mean_of_runs"]["median"]
    return [
        _faster_down(found),
        _later_from_idle(found),
        _claim(
            "When other joints move as well, the difference is marginal and negligible.",
            f"velocity of {found['joint']} alone less that with the others (RMS), to be below {MARGINAL}",
            "rad/s",
            _single(found["coupling_rms"]),
            max(found["coupling_rms"].values()) < MARGINAL,
        ),
        _claim(
            "Over 30 s the discrepancy between simulation and machine remains reasonably small.",
            f"mean distance of the tools under the same commands, to be below {SMALL}",
            "m",
            _single(apart),
            max(apart.values()) < SMALL,
        ),
    ]


def _faster_down(found: Mapping[str, Any]) -> Claim:
    (up, rising), (down, falling) = list(found["sweep"].items())[1:3]  # at the limit, either way
    peaks = {
        kind: (rising[f"{kind}_peak"], falling[f"{kind}_peak"]) for kind in ("machine", "nets")
    }
    numbers = {
        f"{kind}, {u}": v for kind, of in peaks.items() for u, v in zip((up, down), of, strict=True)
    }
    paper = (
        "The velocity is larger when rotating towards gravity: 0.24 rad/s one way, 0.47 the other."
    )
    what = f"peak speed of {found['joint']}, under {down} to be above that under {up}"
    return _claim(
        paper, what, "rad/s", _single(numbers), all(slow < fast for slow, fast in peaks.values())
    )


def _later_from_idle(found: Mapping[str, Any]) -> Claim:
    times = {kind: of[found["joint"]] for kind, of in found["response_time"].items()}
    numbers = {
        f"{kind}, {when}": of[when]["up"]
        for kind, of in times.items()
        for when in ("idle", "moving")
    }
    answered = times.values() if all(numbers.values()) else ()
    later = [of["idle"]["up"] >= LATER * of["moving"]["up"] for of in answered]
    paper = (
        "The same command is answered after about 400 ms from idle and 100 ms when already moving."
    )
    what = f"response time of {found['joint']} (to 63 %), from idle to be {LATER:g} times as long or more"
    return _claim(paper, what, "s", _single(numbers), all(later) if later else None)


def _single(numbers: Mapping[str, float | None]) -> dict[str, Mean]:
    return {name: {"mean": number, "low": None, "high": None} for name, number in numbers.items()}


def training_claim(seconds: float, steps: int) -> Claim:
    """Does training take as long as the paper's? Its clock, so for the report alone. Paper: Sec. 3.4"""
    hours = seconds / 3600
    paper = "The training process takes around 2.5 hours to converge."
    what = f"time of {steps:,} environment steps, to be within a factor of {LATER:g} of that"
    return _claim(paper, what, "h", _single({"here": hours}), 1 / LATER < hours / 2.5 < LATER)


def drift_claims(runs: Sequence[Run], baselines: Sequence[str]) -> list[Claim]:
    """Do y and z stay still while the tool moves along x? Paper: Fig. 6b"""
    drift = {c: by_start(runs, c, "x", "off_axis_drift_max") for c in ("rl", *baselines)}
    numbers = {name: mean_interval(values) for name, values in drift.items()}
    others = {name: numbers[name] for name in baselines}
    more = {f"{name} less rl": mean_interval(drift[name] - drift["rl"]) for name in baselines}
    return [
        _claim(
            "RL: y and z remain stationary during motion along x.",
            f"largest distance of the tool from its line, to be below {STANDSTILL} m",
            "m",
            {"rl": numbers["rl"]},
            _below(numbers["rl"], STANDSTILL),
        ),
        _claim(
            "The Jacobian-based method significantly fails to keep y and z still.",
            f"largest distance of the tool from its line, to be above {STANDSTILL} m, and more than RL's",
            "m",
            others | more,
            _all(
                *(_above(n, STANDSTILL) for n in others.values()),
                *(_above(n, 0.0) for n in more.values()),
            ),
        ),
    ]


def direction_claim(
    machine: Machine, controller: JacobianController, trace: Trace, goals: Array
) -> Claim:
    """Does the PID track joint rates as well in one direction as in the other? Paper: Fig. 6d

    `trace` has its runs of one sequence with these `goals` [m/s] (T, 3).
    """
    q_dot = trace.q_dot[..., machine.driven]
    v_goal = np.broadcast_to(goals[:, None], trace.v_tool.shape)
    wanted = controller.desired_velocities(v_goal, trace.v_tool, trace.q, q_dot)
    numbers: dict[str, Mean] = {}
    unlike: list[bool] = []
    for i, joint in enumerate(machine.driven):
        share = []
        for sign in (1, -1):
            moving = sign * wanted[..., i] > 0.02  # rad/s, assumed: well above the encoder's steps
            error = np.sum(np.abs(wanted - q_dot)[..., i] * moving, axis=0)
            share.append(error / np.maximum(np.sum(np.abs(wanted)[..., i] * moving, axis=0), 1e-9))
            share[-1] = np.where(moving.sum(axis=0) > 10, share[-1], np.nan)
        up, down = mean_interval(share[0]), mean_interval(share[1])
        numbers |= {f"{machine.names[joint]} up": up, f"{machine.names[joint]} down": down}
        low, high = interval(share[0] - share[1])
        if low is not None and high is not None and up["mean"] and down["mean"]:
            ratio = max(up["mean"], down["mean"]) / min(up["mean"], down["mean"])
            unlike.append(ratio > UNLIKE and not low < 0 < high)
    what = (
        f"error of the PID's joint rates as a share of the wanted, to differ by {UNLIKE} at a joint"
    )
    paper = "The fine-tuned PID yields varying results depending on the direction of movement."
    return _claim(paper, what, "1", numbers, any(unlike) if unlike else None)


def singular_controllers(controllers: Mapping[str, Controller]) -> dict[str, Controller]:
    """RL and the baseline with k = 0.1, and the same gains with k = 0.05: damping alone differs."""
    damped = controllers["jacobian_pid_k0.1"]
    if not isinstance(damped, JacobianController):
        raise ValueError(f"jacobian_pid_k0.1: expected a JacobianController, got {type(damped)}")
    return {
        "rl": controllers["rl"],
        "jacobian_pid_k0.1": damped,
        "jacobian_pid_k0.05": replace(damped, k=0.05),
    }


def speed_share(machine: Machine, w0: float, trace: Trace, goals: Array) -> Array:
    """Speed along the goal as a share of it near singularities, (num,); NaN: never there.

    Of ticks below the manipulability `w0` in which the goal (T, num, 3) [m/s] has lasted for `TRANSIENT`.
    """
    lasting = ticks_since_change(machine, goals) >= round(TRANSIENT * machine.rate)
    near = (
        lasting
        & (manipulability(jacobian(forward_kinematics(machine, trace.q))[..., machine.driven]) < w0)
        & np.any(goals, axis=-1)
    )
    along = np.sum(trace.v_tool * goals, axis=-1)
    square = np.sum(goals * goals, axis=-1) * near
    return np.where(near.any(0), np.sum(along * near, 0) / np.maximum(square.sum(0), 1e-12), np.nan)


def singular_claims(runs: Sequence[Run], share: Mapping[str, Array]) -> list[Claim]:
    """Does damping slow the tool near singularities, and does little damping jerk? Paper: Fig. 6e, 6f

    `runs` are those of `singular_controllers` from extended starts, `share` their `speed_share` (starts,).
    """
    jerk = {name: by_start(runs, name, "all", "jerk_rms") for name in share}
    return [_slowed(share), _jerky(jerk), _neither(share, jerk)]


def _slowed(share: Mapping[str, Array]) -> Claim:
    high, low = share["jacobian_pid_k0.1"], share["jacobian_pid_k0.05"]
    less = mean_interval(high - low)
    numbers = {
        "k 0.1": mean_interval(high),
        "k 0.05": mean_interval(low),
        "k 0.1 less k 0.05": less,
    }
    paper = "Near a singularity the damping impedes accurate task space control: it slows the tool."
    what = "speed along the goal as a share of it, k = 0.1 to be below k = 0.05 with the same gains"
    return _claim(paper, what, "1", numbers, _below(less, 0.0))


def _jerky(jerk: Mapping[str, Array]) -> Claim:
    high, low = jerk["jacobian_pid_k0.1"], jerk["jacobian_pid_k0.05"]
    more = mean_interval(low - high)
    numbers = {
        "k 0.1": mean_interval(high),
        "k 0.05": mean_interval(low),
        "k 0.05 less k 0.1": more,
    }
    paper = (
        "With less damping (k = 0.05 instead of 0.1) the system moves jerkily near the singularity."
    )
    what = "jerk, k = 0.05 to be above k = 0.1 with the same gains"
    return _claim(paper, what, "m/s^3", numbers, _above(more, 0.0))


def _neither(share: Mapping[str, Array], jerk: Mapping[str, Array]) -> Claim:
    faster = mean_interval(share["rl"] - share["jacobian_pid_k0.05"])
    smoother = mean_interval(jerk["rl"] - jerk["jacobian_pid_k0.1"])
    numbers = {"rl share": mean_interval(share["rl"]), "less k 0.05": faster}
    numbers |= {"rl jerk": mean_interval(jerk["rl"]), "less k 0.1": smoother}
    paper = "RL is more robust there: neither slowed nor jerky."
    what = "share of the wanted speed to be above that of k = 0.05, and jerk [m/s^3] below that of k = 0.1"
    return _claim(paper, what, "1", numbers, _all(_above(faster, 0.0), _below(smoother, 0.0)))


def tracking_claims(runs: Sequence[Run], baselines: Sequence[str]) -> list[Claim]:
    """Does the policy track better than the Jacobian-based method?

    Paper: Fig. 6c, Fig. 6f, Fig. 6h, Sec. 5
    """
    said = {
        "RL tracks the velocity robustly, along x, y and z (Fig. 6c, 6f, 6h).": [
            (s, "error") for s in "xyz"
        ],
        "RL is more robust in motion along z, too (Fig. 6g, 6h).": [("z", "error"), ("z", "drift")],
        "The proposed method outperforms the Jacobian-based approach.": [("all", "error")],
    }
    keys = {"error": "velocity_error_mean", "drift": "off_axis_drift_max"}
    found = []
    for paper, figures in said.items():
        numbers = {}
        for s, what in figures:
            rl = by_start(runs, "rl", s, keys[what])
            for c in baselines:
                numbers[f"{what} {s}, less {c}"] = mean_interval(
                    rl - by_start(runs, c, s, keys[what])
                )
        holds = _all(*(_below(n, 0.0) for n in numbers.values()))
        what = "RL's mean velocity error [m/s] (largest drift [m]) less a baseline's, to be below 0"
        found.append(_claim(paper, what, "m/s, m", numbers, holds))
    return found
