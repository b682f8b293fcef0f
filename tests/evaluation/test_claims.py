"""Verdicts follow from the numbers: made-up runs for which they are known."""

from itertools import product

import numpy as np
import pytest

from brokk_min.evaluation import claims
from brokk_min.evaluation.baselines import PAPER_BASELINES

HIGH, LOW = PAPER_BASELINES  # damping
NEAR_ZERO = 0.001 * np.array([0, 1, 2, 0, 1, 2])  # spread over the starts


def runs_with(error=None, drift=None):
    """Six starts with figures around values by sequence and controller."""
    rows = []
    for sequence, controller, i in product("xyz", ("rl", HIGH, LOW), range(6)):
        row = {"controller": controller, "sequence": sequence, "start": i, "kind": "workspace"}
        values = {"velocity_error_mean": error or {}, "off_axis_drift_max": drift or {}}
        for key, of in values.items():
            value = of.get((sequence, controller), of.get(controller, 0.0))
            row[key] = value + NEAR_ZERO[i]
        rows.append(row)
    return rows


def verdicts(result, judged="rl"):
    return {claim.name: claim.holds()[judged] for claim in result if judged in claim.holds()}


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
    ("change", "holds"),
    [
        ({}, [True, True, True]),
        ({"down": 0.2}, [False, True, True]),
        ({"idle": 0.15}, [True, False, True]),
        ({"idle": None}, [True, None, True]),
        ({"median": 0.06}, [True, True, False]),
        ({"figure": 0.06}, [True, True, False]),
    ],
)
def test_net_claims__hold_where_nets_behave_as_the_papers_machine(change, holds):
    result = claims.net_claims(preliminary_numbers(**change))
    assert list(verdicts(result, "nets").values()) == holds
    written = [claim.to_json() for claim in result]
    assert [row["figure"] for row in written] == ["Fig. 2", "Fig. 2", "Fig. 5"]
    assert written[0]["measured"].endswith(" [1]")
    texts = {True: "holds here", False: "does not hold here", None: "was not measured"}
    assert written[1]["verdict"] == f"{texts[holds[1]]} for nets"


@pytest.mark.parametrize(
    ("drift", "still", "fails"),
    [
        ({"rl": 0.02, HIGH: 0.20, LOW: 0.30}, True, True),  # as the paper says
        ({"rl": 0.02, HIGH: 0.20, LOW: 0.03}, True, False),  # one baseline stays still, too
        ({"rl": 0.09, HIGH: 0.20, LOW: 0.30}, False, True),
    ],
)
def test_task_claims__on_drift_along_x(drift, still, fails):
    result = claims.task_claims(runs_with(drift=drift))
    assert verdicts(result)["still"] is still
    assert verdicts(result, "the paper's PIDs") == {"drift": fails}
    assert result[0].numbers["rl"]["rl"]["mean"] == pytest.approx(drift["rl"] + 0.001)


@pytest.mark.parametrize(
    ("x", "z", "drift", "holds"),
    [
        (0.01, 0.01, 0.1, [True, True, True]),
        (0.01, 0.01, 0.3, [True, False, True]),  # drifts more along z
        (0.03, 0.01, 0.1, [False, True, True]),  # worse along x, better along y and z
        (0.01, 0.03, 0.1, [False, False, True]),
        (0.04, 0.03, 0.1, [False, False, False]),
    ],
)
def test_task_claims__on_error_are_of_each_sequence_and_figure(x, z, drift, holds):
    errors = {("x", "rl"): x, ("z", "rl"): z, "rl": 0.01, HIGH: 0.02, LOW: 0.025}
    runs = runs_with(errors, {"rl": drift, HIGH: 0.2, LOW: 0.2})
    result = claims.task_claims(runs)
    names = ["tracking", "along_z", "outperforms"]
    assert [verdicts(result)[name] for name in names] == holds
    number = result[3].numbers["rl"][f"off_axis_drift_max of rl along z less {HIGH}"]
    assert number["mean"] == pytest.approx(drift - 0.2)
    one_start = [run for run in runs if run["start"] == 0]
    assert set(verdicts(claims.task_claims(one_start)).values()) == {None}


def test_to_json__judges_each_policy():
    runs = runs_with({"rl": 0.01, HIGH: 0.02, LOW: 0.02})
    paper = [run | {"controller": "rl_paper"} for run in runs if run["controller"] == HIGH]
    claim = claims.task_claims(runs + paper)[-1].to_json()
    assert claim["holds"] == {"rl_paper": False, "rl": True}
    assert claim["verdict"] == (
        "does not hold here for the paper's learner and holds here for our learner"
    )
    assert (
        "less a PID's, to be below 0: velocity_error_mean of rl_paper along all less jac"
        in (claim["measured"])
    )
