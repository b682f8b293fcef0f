"""Verdicts follow from the numbers: made-up runs for which they are known."""

from itertools import product

import numpy as np
import pytest

from brokk_min.evaluation import claims
from brokk_min.evaluation.rollout import TITLES

HIGH, LOW, RAW = "jacobian_pid_k0.1", "pid_by_hand", "pid_by_hand_raw"
PPO = "rl_paper"
NEAR_ZERO = 0.001 * np.array([0, 1, 2, 0, 1, 2])  # spread over the starts


def runs_with(error=None, drift=None):
    """Six starts with figures around values by sequence and controller."""
    rows = []
    for sequence, controller, i in product("xyz", (PPO, HIGH, LOW, RAW), range(6)):
        row = {"controller": controller, "sequence": sequence, "start": i, "kind": "workspace"}
        values = {"velocity_error_mean": error or {}, "off_axis_drift_max": drift or {}}
        for key, of in values.items():
            value = of.get((sequence, controller), of.get(controller, 0.0))
            row[key] = value + NEAR_ZERO[i]
        rows.append(row)
    return rows


def holds(result, pid, judged=TITLES[PPO]):
    """Verdicts of the claims on what is judged, by their names."""
    every = {claim.name: claim.holds().get(judged, {}) for claim in result}
    return {name: of[pid] for name, of in every.items() if pid in of}


def preliminary_numbers(up=0.24, down=0.45, idle=0.4, figure=0.03, median=0.02):
    """Numbers of nets that behave as the paper's machine."""
    times = {"idle": idle, "moving": 0.1}
    peaks = {"u = 50": 0.1, "u = 80": up, "u = 175": down, "u = 205": 0.3}
    return {
        "joint": "q5",
        "sweep": {u: {"machine_peak": 9.0, "nets_peak": v} for u, v in peaks.items()},
        "response_time": {"nets": times},
        "sim_to_real": {
            "tool": {"position_error_mean": figure},
            "tool_position_error_mean_of_runs": {"median": median},
        },
    }


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({}, [True, True, True]),
        ({"down": 0.2}, [False, True, True]),
        ({"idle": 0.15}, [True, False, True]),
        ({"idle": None}, [True, None, True]),
        ({"median": 0.06}, [True, True, False]),
        ({"figure": 0.06}, [True, True, False]),
    ],
)
def test_net_claims__hold_where_nets_behave_as_the_papers_machine(change, expected):
    result = claims.net_claims(preliminary_numbers(**change))
    assert list(holds(result, "", "nets").values()) == expected
    written = [claim.to_json() for claim in result]
    assert [row["figure"] for row in written] == ["Fig. 2", "Fig. 2", "Fig. 5"]
    texts = {True: "holds here", False: "does not hold here", None: "was not measured"}
    assert written[1]["verdict"] == f"{texts[expected[1]]} for nets"


def test_task_claims__on_drift_along_x_are_of_each_controller():
    drift = {PPO: 0.02, HIGH: 0.03, LOW: 0.20, RAW: 0.3}
    still, fails, *_ = claims.task_claims(runs_with(drift=drift))
    assert still.holds() == {TITLES[PPO]: {"": True}}
    (of_pids,) = fails.holds().values()
    assert of_pids == {TITLES[RAW]: True, TITLES[LOW]: True, TITLES[HIGH]: False}
    assert still.numbers[TITLES[PPO]][""]["along x"]["mean"] == pytest.approx(0.021)
    drift[PPO] = 0.09
    assert claims.task_claims(runs_with(drift=drift))[0].holds() == {TITLES[PPO]: {"": False}}


@pytest.mark.parametrize(
    ("x", "z", "drift", "expected"),
    [
        (0.01, 0.01, 0.1, [True, True, True]),
        (0.01, 0.01, 0.3, [True, False, True]),  # drifts more along z
        (0.03, 0.01, 0.1, [False, True, True]),  # worse along x, better along y and z
        (0.01, 0.03, 0.1, [False, False, True]),
        (0.04, 0.03, 0.1, [False, False, False]),
    ],
)
def test_task_claims__on_error_are_of_each_sequence_and_figure(x, z, drift, expected):
    errors = {("x", PPO): x, ("z", PPO): z, PPO: 0.01, HIGH: 0.02, LOW: 0.05, RAW: 0.06}
    runs = runs_with(errors, {PPO: drift, HIGH: 0.2, LOW: 0.4, RAW: 0.4})
    result = claims.task_claims(runs)
    assert list(holds(result, TITLES[HIGH])) == ["tracking", "along_z", "outperforms"]
    assert list(holds(result, TITLES[HIGH]).values()) == expected
    assert set(holds(result, TITLES[LOW]).values()) == {True}
    number = result[3].numbers[TITLES[PPO]][TITLES[HIGH]]["off_axis_drift_max along z"]
    assert number["mean"] == pytest.approx(drift - 0.2)
    one_start = claims.task_claims([run for run in runs if run["start"] == 0])
    assert set(holds(one_start, TITLES[LOW]).values()) == {None}


def test_to_json__says_that_a_verdict_depends_on_the_tuning():
    claim = claims.task_claims(runs_with({PPO: 0.03, HIGH: 0.02, LOW: 0.04, RAW: 0.05}))[-1]
    written = claim.to_json()
    assert written["verdict"] == (
        "depends on the tuning for PPO, the paper's agent: it holds here with PID by hand, raw and "
        "PID by hand, does not hold here with PID optimised, k = 0.1"
    )
    measured = "to be below 0 m/s: velocity_error_mean along all of PPO, the paper's agent and PID"
    assert measured in written["measured"]
