"""What the paper says of task space control, each sentence as numbers and a verdict.

Limits by which a verdict is given are ours (assumed); the intervals are over starts. Paper: Sec. 4.2
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brokk_min.env import Controller, Measured, Trace
from brokk_min.jacobian import JacobianController, manipulability
from brokk_min.kinematics import jacobian
from brokk_min.machine import Machine
from brokk_min.metrics import TRANSIENT, Run, by_start, interval, mean_interval, since_change

Array = NDArray[np.floating[Any]]
Claim = dict[str, Any]  # paper, measured, numbers, holds (None: no such runs)
STILL = 0.05  # m, assumed: a tool that stays so near its line stays still across it
UNLIKE = 1.25  # assumed: errors of two directions whose ratio is larger differ


def _said(numbers: Mapping[str, Mapping[str, float | None]], unit: str) -> str:
    """Numbers as a sentence: means with their intervals."""
    cells = []
    for name, n in numbers.items():
        ends = "" if n["low"] is None else f" ({n['low']:.3g} to {n['high']:.3g})"
        cells.append(f"{name} none" if n["mean"] is None else f"{name} {n['mean']:.3g}{ends}")
    return "; ".join(cells) + f" [{unit}]"


def _claim(paper: str, what: str, unit: str, numbers: Mapping[str, Any], holds: bool | None) -> Claim:
    return {"paper": paper, "measured": f"{what}: {_said(numbers, unit)}", "numbers": numbers, "holds": holds}


def _below(number: Mapping[str, float | None], limit: float) -> bool | None:
    return None if number["high"] is None else number["high"] < limit


def _above(number: Mapping[str, float | None], limit: float) -> bool | None:
    return None if number["low"] is None else number["low"] > limit


def _all(*verdicts: bool | None) -> bool | None:
    return None if None in verdicts else all(verdicts)


def drift_claims(runs: Sequence[Run], baselines: Sequence[str]) -> list[Claim]:
    """Do y and z stay still while the tool moves along x? Paper: Fig. 6b"""
    drift = {c: by_start(runs, c, "x", "off_axis_drift_max") for c in ("rl", *baselines)}
    numbers = {name: mean_interval(values) for name, values in drift.items()}
    others = {name: numbers[name] for name in baselines}
    more = {f"{name} less rl": mean_interval(drift[name] - drift["rl"]) for name in baselines}
    return [
        _claim(
            "RL: y and z remain stationary during motion along x.",
            f"largest distance of the tool from its line, to be below {STILL} m",
            "m",
            {"rl": numbers["rl"]},
            _below(numbers["rl"], STILL),
        ),
        _claim(
            "The Jacobian-based method significantly fails to keep y and z still.",
            f"largest distance of the tool from its line, to be above {STILL} m, and more than RL's",
            "m",
            others | more,
            _all(*(_above(n, STILL) for n in others.values()), *(_above(n, 0.0) for n in more.values())),
        ),
    ]


def direction_claim(machine: Machine, controller: JacobianController, trace: Trace, goals: Array) -> Claim:
    """Does the PID track joint rates as well in one direction as in the other? Paper: Fig. 6d

    Args:
        machine: n joints.
        controller: whose runs are in `trace`; it says which rates it wanted.
        trace: runs of one sequence.
        goals: of this sequence [m/s], (T, 3).
    """
    q_dot = trace.q_dot[..., machine.driven]
    v_goal = np.broadcast_to(goals[:, None], trace.v_tool.shape)
    wanted = controller.rates(Measured(v_goal, trace.v_tool, trace.q, q_dot), q_dot)
    numbers: dict[str, dict[str, float | None]] = {}
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
    what = f"error of the PID's joint rates as a share of the wanted, to differ by {UNLIKE} at a joint"
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
    lasting = since_change(machine, goals) >= round(TRANSIENT * machine.rate)
    near = lasting & (manipulability(jacobian(machine, trace.q)) < w0) & np.any(goals, axis=-1)
    along = np.sum(trace.v_tool * goals, axis=-1)
    square = np.sum(goals * goals, axis=-1) * near
    return np.where(near.any(0), np.sum(along * near, 0) / np.maximum(square.sum(0), 1e-12), np.nan)


def singular_claims(runs: Sequence[Run], share: Mapping[str, Array]) -> list[Claim]:
    """Does damping slow the tool near singularities, and does little damping jerk? Paper: Fig. 6e, 6f

    Args:
        runs: of `singular_controllers` from extended starts.
        share: of `speed_share` by controller in the same runs, (starts,).
    """
    high, low = "jacobian_pid_k0.1", "jacobian_pid_k0.05"
    jerk = {name: by_start(runs, name, "all", "jerk_rms") for name in share}
    shares, jerks = ({name: mean_interval(v) for name, v in of.items()} for of in (share, jerk))
    pair = {
        "k 0.1": shares[high],
        "k 0.05": shares[low],
        "k 0.1 less k 0.05": mean_interval(share[high] - share[low]),
    }
    rough = {
        "k 0.1": jerks[high],
        "k 0.05": jerks[low],
        "k 0.05 less k 0.1": mean_interval(jerk[low] - jerk[high]),
    }
    faster, smoother = mean_interval(share["rl"] - share[low]), mean_interval(jerk["rl"] - jerk[high])
    neither = _all(_above(faster, 0.0), _below(smoother, 0.0))
    return [
        _claim(
            "Near a singularity the damping impedes accurate task space control: it slows the tool.",
            "speed along the goal as a share of it, k = 0.1 to be below k = 0.05 with the same gains",
            "1",
            pair,
            _below(pair["k 0.1 less k 0.05"], 0.0),
        ),
        _claim(
            "With less damping (k = 0.05 instead of 0.1) the system moves jerkily near the singularity.",
            "jerk, k = 0.05 to be above k = 0.1 with the same gains",
            "m/s^3",
            rough,
            _above(rough["k 0.05 less k 0.1"], 0.0),
        ),
        _claim(
            "RL is more robust there: neither slowed nor jerky.",
            "share of the wanted speed to be above that of k = 0.05, and jerk [m/s^3] below that of k = 0.1",
            "1",
            {"rl share": shares["rl"], "less k 0.05": faster, "rl jerk": jerks["rl"], "less k 0.1": smoother},
            neither,
        ),
    ]


def tracking_claims(runs: Sequence[Run], baselines: Sequence[str]) -> list[Claim]:
    """Does the policy track better than the Jacobian-based method?

    Paper: Fig. 6c, Fig. 6f, Fig. 6h, Sec. 5
    """
    said = {
        "RL tracks the velocity robustly, along x, y and z (Fig. 6c, 6f, 6h).": [(s, "error") for s in "xyz"],
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
                numbers[f"{what} {s}, less {c}"] = mean_interval(rl - by_start(runs, c, s, keys[what]))
        holds = _all(*(_below(n, 0.0) for n in numbers.values()))
        what = "RL's mean velocity error [m/s] (largest drift [m]) less a baseline's, to be below 0"
        found.append(_claim(paper, what, "m/s, m", numbers, holds))
    return found
