"""Verdicts follow from the numbers: made-up runs for which they are known."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from helpers_machines import obedient_net

from brokk_min.env import Measured
from brokk_min.evaluation import baselines, claims, report
from brokk_min.evaluation.rollout import Trace
from brokk_min.machine import BROKK_170

PAPER_BASELINES = baselines.PAPER_BASELINES
POSE = np.array([1.5, 0.5, 0.58, 1.71, 1.24])


def judged(found: list[dict[str, Any]]) -> list[bool | None]:
    """The verdicts on claims, each on a sentence of the paper, with what was measured and its unit."""
    for claim in found:
        assert re.fullmatch(r"(RL:?|[A-Z][a-z]*) [^X]*[a-z][^X]*\.", claim["paper"]), claim["paper"]
        what, end = claim["measured"], ": " + claims.said(claim["numbers"], claim["unit"])
        assert what.endswith(end) and re.match("(RL's )?[a-z]", what) and "XX" not in what, what
        assert claim["unit"] in ("1", "s", "h", "m", "rad/s", "m/s, m", "m/s^3")
        assert all(name == name.lower() and len(n) == 3 for name, n in claim["numbers"].items())
    return [claim["holds"] for claim in found]


def test_numbers_are_said_with_their_intervals() -> None:
    numbers = {
        "a": {"mean": 1.0, "low": 0.5, "high": 1.5},
        "b": {"mean": 2.0, "low": None, "high": None},
    }
    none = {"mean": None, "low": None, "high": None}
    assert claims.said(numbers | {"c": none}, "m") == "a 1 (0.5 to 1.5); b 2; c none [m]"


def runs_with(key: str, **values: float) -> list[dict[str, Any]]:
    """Six starts along x with a figure about a value by controller; starts differ, controllers too."""
    names = {"rl": "rl", "high": PAPER_BASELINES[0], "low": PAPER_BASELINES[1]}
    return [
        {
            "controller": names[c],
            "sequence": "x",
            "start": i,
            "kind": "workspace",
            key: v + 0.001 * (i % 3),
        }
        for c, v in values.items()
        for i in range(6)
    ]


@pytest.mark.parametrize(
    ("rl", "high", "low", "holds"),
    [
        (0.02, 0.20, 0.30, [True, True]),  # as the paper says
        (0.02, 0.03, 0.03, [True, False]),  # baselines stay still too
        (0.09, 0.20, 0.30, [False, True]),
        (0.09, 0.06, 0.30, [False, False]),  # one baseline drifts less than RL
    ],
)
def test_drift(rl: float, high: float, low: float, holds: list[bool]) -> None:
    found = claims.drift_claims(runs_with("off_axis_drift_max", rl=rl, high=high, low=low), PAPER_BASELINES)
    assert judged(found) == holds
    assert f"{rl + 0.001:.3g}" in found[0]["measured"]


def test_one_start_gives_no_verdict() -> None:
    runs = [
        run
        for run in runs_with("off_axis_drift_max", rl=0.1, high=0.2, low=0.2)
        if run["start"] == 0
    ]
    found = claims.drift_claims(runs, PAPER_BASELINES)
    assert judged(found) == [None, None]
    assert report.verdict(found[0]).lines == ((found[0]["measured"], "This was not measured."),)


@pytest.mark.parametrize(
    ("x", "z", "drift", "holds"),
    [
        (0.01, 0.01, 0.1, [True, True, True]),
        (0.01, 0.01, 0.3, [True, False, True]),  # drifts more along z
        (
            0.03,
            0.01,
            0.1,
            [False, True, True],
        ),  # worse along x by 0.01 and better along y and z by 0.01
        (0.01, 0.03, 0.1, [False, False, True]),
        (0.04, 0.03, 0.1, [False, False, False]),
    ],
)
def test_tracking(x: float, z: float, drift: float, holds: list[bool]) -> None:
    runs = []
    for sequence, rl in {"x": x, "y": 0.01, "z": z}.items():
        errors = runs_with("velocity_error_mean", rl=rl, high=0.02, low=0.02 - 0.005 * (rl > 0.02))
        drifts = runs_with("off_axis_drift_max", rl=drift, high=0.2, low=0.2)
        runs += [a | b | {"sequence": sequence} for a, b in zip(errors, drifts, strict=True)]
    found = claims.tracking_claims(runs, PAPER_BASELINES)
    assert judged(found) == holds
    assert found[1]["numbers"]["drift z, less jacobian_pid_k0.1"]["mean"] == pytest.approx(
        drift - 0.2
    )


@pytest.mark.parametrize(
    ("share", "jerk", "holds"),
    [
        ((0.9, 0.5, 0.7), (3.5, 4.0, 4.5), [True, True, True]),
        ((0.9, 0.7, 0.5), (2.0, 9.0, 4.0), [False, False, True]),
        ((0.6, 0.5, 0.7), (2.0, 4.0, 9.0), [True, True, False]),  # RL is slowed
        ((0.9, 0.5, 0.7), (4.5, 4.0, 4.6), [True, True, False]),  # RL jerks
    ],
)
def test_singular(share: tuple[float, ...], jerk: tuple[float, ...], holds: list[bool]) -> None:
    names = ("rl", "jacobian_pid_k0.1", "jacobian_pid_k0.05")
    spread = 0.01 * np.array([0, 1, 2, 0, 1, 2])
    runs = runs_with("jerk_rms", **dict(zip(("rl", "high", "low"), jerk, strict=True)))
    found = claims.singular_claims(runs, {n: s + spread for n, s in zip(names, share, strict=True)})
    assert judged(found) == holds


def still_trace(ticks: int, q: np.ndarray, v: np.ndarray, q_dot: np.ndarray) -> Trace:
    zero = np.zeros((ticks, len(q), 5))
    return Trace(
        zero + q,
        zero + q_dot,
        zero,
        zero,
        zero[..., :3],
        np.zeros((ticks, len(q), 3)) + v,
        zero[..., 0],
    )


def test_speed_share_counts_lasting_goals_at_singular_poses() -> None:
    """Stretched and ordinary at half the wanted speed, stretched at another share and at rest but at first.

    The first 0.6 s do not count.
    """
    stretched = np.array([0.3, 0.5, 0.1, np.pi, 3 * np.pi / 4])
    q, goals = np.stack([stretched, POSE, stretched, stretched]), np.zeros((30, 4, 3))
    goals[..., 0] = [0.2, 0.2, 0.4, 0.2]
    goals[5:, 3] = 0.0
    trace = still_trace(30, q, np.array([0.1, 0.3, 0.0]), np.zeros(5))
    trace.v_tool[:12] = 9.0
    share = claims.speed_share(BROKK_170, 3.9, trace, goals)
    assert share[[0, 2]] == pytest.approx([0.5, 0.25]) and np.isnan(share[[1, 3]]).all()


@pytest.mark.parametrize(
    ("down", "holds"), [(0.9, False), (0.5, True), ((0.9, 0.9, 0.9, 0.1), False)]
)
def test_direction(down: float | tuple[float, ...], holds: bool) -> None:
    """Joints that follow 90 % of the wanted rates while the tool goes forward, and `down` on the way back.

    One run that goes back badly says nothing of the others.
    """
    pid = baselines.baselines(BROKK_170, obedient_net(BROKK_170))["jacobian_pid_k0.1"]
    goals = np.repeat([[0.2, 0.0, 0.0], [-0.2, 0.0, 0.0]], 20, axis=0)
    poses = POSE + 0.02 * np.arange(4)[:, None]
    trace = still_trace(40, poses, goals[:, None], np.zeros(5))
    q_dot, driven = trace.q_dot, BROKK_170.driven
    for _ in range(30):  # weights depend on the direction of motion: find the rates that it wants
        seen = Measured(trace.v_tool, trace.v_tool, trace.q, q_dot[..., driven])
        share = np.where(goals[:, None, :1] > 0, 0.9, np.reshape(down, (-1, 1)))
        q_dot[..., driven] = share * pid.rates(seen, q_dot[..., driven])
    found = claims.direction_claim(BROKK_170, pid, trace, goals)
    assert judged([found]) == [holds]
    errors = sorted(
        {round(n["mean"], 2) for n in found["numbers"].values() if n["mean"] is not None}
    )
    assert errors == sorted({0.1, round(1 - float(np.mean(down)), 2)})
    alone = claims.direction_claim(BROKK_170, pid, Trace(*(a[:, :1] for a in trace)), goals)
    assert alone["holds"] is None


def preliminary_numbers(**change: Any) -> dict[str, Any]:
    """What `preliminary.run` says of a machine as the paper's and of nets that are as it."""
    times = {"q5": {"idle": {"up": 0.4, "down": 0.4}, "moving": {"up": 0.1, "down": 0.1}}}
    peak = {"u = 50": 0.1, "u = 80": 0.24, "u = 175": 0.45, "u = 205": 0.3}
    gap = {
        "tool": {"position_error_mean": 0.03},
        "tool_position_error_mean_of_runs": {"median": 0.02},
    }
    return {
        "joint": "q5",
        "sweep": {u: {"machine_peak": v, "nets_peak": v} for u, v in peak.items()},
        "coupling_rms": {"machine": 0.0, "nets": 0.001},
        "response_time": {"machine": times, "nets": times},
        "sim_to_real": gap,
    } | change


def test_machine_and_nets_are_as_the_paper_found_its_own() -> None:
    slow = {"q5": {"idle": {"up": 0.15, "down": 0.4}, "moving": {"up": 0.1, "down": 0.1}}}
    never = {"q5": {"idle": {"up": None, "down": 0.4}, "moving": {"up": 0.1, "down": 0.1}}}
    good = preliminary_numbers()
    even = good["sweep"] | {"u = 175": {"machine_peak": 0.45, "nets_peak": 0.2}}
    far = {
        "tool": {"position_error_mean": 0.03},
        "tool_position_error_mean_of_runs": {"median": 0.06},
    }
    for change, holds in (
        ({}, [True, True, True, True]),
        ({"sweep": even}, [False, True, True, True]),
        ({"response_time": good["response_time"] | {"nets": slow}}, [True, False, True, True]),
        ({"response_time": good["response_time"] | {"nets": never}}, [True, None, True, True]),
        ({"coupling_rms": {"machine": 0.0, "nets": 0.02}}, [True, True, False, True]),
        ({"sim_to_real": far}, [True, True, True, False]),
    ):
        found = claims.net_claims(preliminary_numbers(**change))
        assert judged(found) == holds, change
    assert (
        "nets, idle none"
        in claims.net_claims(preliminary_numbers(response_time={"nets": never}))[1]["measured"]
    )


@pytest.mark.parametrize(("hours", "holds"), [(0.1, False), (2.0, True), (4.0, True), (6.0, False)])
def test_training_lasts_as_long_as_the_papers_or_not(hours: float, holds: bool) -> None:
    claim = claims.training_claim(hours * 3600, 8_000_000)
    assert judged([claim]) == [holds] and "8,000,000" in claim["measured"]


def test_a_stronger_baseline_stands_beside_the_papers() -> None:
    runs = runs_with("off_axis_drift_max", rl=0.02, high=0.2, low=0.3)
    runs += [run | {"controller": "strong", "off_axis_drift_max": 0.03} for run in runs[:6]]
    of_paper, of_strong = (claims.drift_claims(runs, names) for names in (PAPER_BASELINES, ["strong"]))
    still, fails = (claims.beside(*pair) for pair in zip(of_paper, of_strong, strict=True))
    assert "stronger" not in still  # a sentence on RL alone
    assert fails["holds"] is True and fails["stronger"]["holds"] is False
    lines = report.verdict(fails).lines
    assert [verdict for _, verdict in lines] == ["This holds here.", "This does not hold here."]
    assert lines[1][0].startswith(report.BESIDE + "strong 0.03") and "high" not in lines[1][0]
