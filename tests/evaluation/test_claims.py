"""Verdicts follow from the numbers: made-up runs for which they are known."""

from itertools import product

import numpy as np
import pytest

from brokk_min.evaluation import claims
from brokk_min.evaluation.preliminary import Gap
from brokk_min.evaluation.rollout import TITLES

HIGH, LOW, RAW = "jacobian_pid_k0.1", "pid_by_hand", "pid_by_hand_raw"
PPO = "rl_paper"
POLICIES = (PPO, "rl_critic")
TIME = 0.05 * (np.arange(60) - 29.5)
TRUE, FALSE, UNKNOWN = "holds here", "does not hold here", "was not measured"


def runs_with(error, drift):
    """Six starts with figures around values by controller, or by sequence and controller."""
    rows = []
    for sequence, controller, i in product("xyz", (*POLICIES, HIGH, LOW, RAW), range(6)):
        row = {"controller": controller, "sequence": sequence, "start": i}
        for key, of in (("velocity_error_mean", error), ("off_axis_drift_max", drift)):
            value = of.get((sequence, controller), of.get(controller, 0.0))
            row[key] = value + 0.001 * (i % 3)  # spread over the starts
        rows.append(row)
    return rows


def verdict(claim, *controllers):
    """On one controller, or on a policy against a PID."""
    return claim["verdicts"][" against ".join(TITLES[name] for name in controllers)]


def step(seconds):
    """A velocity that rises to 63 % in that time, if at all."""
    return TIME, np.clip(0.63 * TIME / seconds, 0, 1) if seconds else 0 * TIME


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({}, [TRUE, TRUE, TRUE]),
        ({"down": 0.2}, [FALSE, TRUE, TRUE]),
        ({"up": 0.0}, [UNKNOWN, TRUE, TRUE]),
        ({"idle": 0.15}, [TRUE, FALSE, TRUE]),
        ({"idle": None}, [TRUE, UNKNOWN, TRUE]),
        ({"median": 0.06}, [TRUE, TRUE, FALSE]),
        ({"figure": 0.06}, [TRUE, TRUE, FALSE]),
    ],
)
def test_net_claims__hold_where_nets_behave_as_the_papers_machine(change, expected):
    like = {"up": 0.24, "down": 0.45, "idle": 0.4, "figure": 0.03, "median": 0.02} | change
    peaks = 0.1, like["up"], -like["down"], -0.3
    sweeps = {i: (TIME, np.array([0.0, peak])) for i, peak in enumerate(peaks)}
    nets = {
        "range and direction": sweeps,
        "past movement": {"idle": step(like["idle"]), "moving": step(0.1)},
    }
    distances = np.array([like["figure"], like["median"], like["median"]])
    p = np.array([0.5, 1.5])[:, None, None] * distances[:, None] * [0.6, 0.8, 0.0]
    result = claims.net_claims(nets, Gap(p, p, p, p))
    assert [claim["verdicts"] for claim in result] == [{"nets": text} for text in expected]
    assert [claim["figure"] for claim in result] == ["Fig. 2", "Fig. 2", "Fig. 5"]
    means = [n["mean"] for claim in result for n in claim["numbers"]["nets"].values()]
    ratio = pytest.approx(like["down"] / like["up"]) if like["up"] else None
    times = like["idle"] and pytest.approx(like["idle"] / 0.1)
    assert means == [ratio, times, *map(pytest.approx, distances[:2])]


@pytest.mark.parametrize(
    ("x", "z", "drift", "expected"),
    [
        (0.01, 0.01, 0.1, [TRUE, TRUE, TRUE]),
        (0.01, 0.01, 0.3, [TRUE, FALSE, TRUE]),  # drifts more along z
        (0.03, 0.01, 0.1, [FALSE, TRUE, TRUE]),  # worse along x, better along y and z
        (0.01, 0.03, 0.1, [FALSE, FALSE, TRUE]),
        (0.04, 0.03, 0.1, [FALSE, FALSE, FALSE]),
    ],
)
def test_task_claims__on_error_are_of_each_sequence_and_figure(x, z, drift, expected):
    """And those on drift along x are of each controller."""
    errors = {("x", PPO): x, ("z", PPO): z, PPO: 0.01, HIGH: 0.02, LOW: 0.05, RAW: 0.06}
    drifts = {PPO: drift, ("x", HIGH): 0.03, HIGH: 0.2, LOW: 0.4, RAW: 0.4}
    still, fails, *result = claims.task_claims(runs_with(errors, drifts))
    assert [verdict(still, name) for name in POLICIES] == [FALSE, TRUE]
    assert [verdict(fails, pid) for pid in (RAW, LOW, HIGH)] == [TRUE, TRUE, FALSE]
    assert still["numbers"][TITLES[PPO]]["drift"]["mean"] == pytest.approx(drift + 0.001)
    # tracking, along z, all in all
    assert [verdict(claim, PPO, HIGH) for claim in result] == expected
    assert {verdict(claim, PPO, LOW) for claim in result} == {TRUE}
    numbers = result[1]["numbers"][f"{TITLES[PPO]} against {TITLES[HIGH]}"]
    assert numbers["drift along z"]["mean"] == pytest.approx(drift - 0.2)


@pytest.mark.parametrize(
    ("drift", "expected"), [(0.040, TRUE), (0.0489, "is undecided here"), (0.052, FALSE)]
)
def test_claim__is_undecided_where_the_limit_is_within_the_interval(drift, expected):
    """The means of six starts are 0.001 m more, with an interval of 0.0009 m to each side."""
    still, *_ = claims.task_claims(runs_with({}, {PPO: drift, HIGH: 0.0, LOW: 0.0, RAW: 0.0}))
    assert verdict(still, PPO) == expected


def test_verdict_rows__compare_with_the_optimised_pid_and_others_that_end_otherwise():
    """Of the policies that have runs; each of the paper's sentences on motion is there."""
    runs = runs_with({PPO: 0.01, HIGH: 0.02}, {})
    runs = [run for run in runs if not run["controller"].startswith("rl_critic")]
    rows = claims.verdict_rows(claims.task_claims(runs))
    against = f"{TITLES[PPO]} against {TITLES[HIGH]}"
    judged = [TITLES[PPO], *(TITLES[pid] for pid in claims.PIDS), against, against, against]
    others = [row for row in rows if row[2] not in judged]
    assert [row[2] for row in rows if row not in others] == judged
    assert {row[2] for row in others} == {f"{TITLES[PPO]} against {TITLES[p]}" for p in (RAW, LOW)}
    usual = {row[1]: row[4] for row in rows if row[2] == against}
    assert all(row[4] != usual[row[1]] for row in others)
    words = claims.TEXTS["outperforms"]["paper"]
    assert ["Sec. 5", words, against, "error along all -0.0100", TRUE] in rows
