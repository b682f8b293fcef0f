"""Figures of merit worked by hand; controllers on the same starts."""

import numpy as np
import pytest
from helpers_machines import Idle, obedient_net, pids, short_axes

from brokk_min.evaluation import metrics as m
from brokk_min.evaluation.rollout import Trace
from brokk_min.kinematics import forward_kinematics, tool_position
from brokk_min.machine import BROKK_170


@pytest.mark.parametrize(
    ("goals", "p_tool", "expected"),
    [
        (
            [[0.2, 0, 0], [0.2, 0, 0], [0, 0, 0], [-0.1, 0, 0]],
            [[1.0, 0, 0], [2.0, 0.3, 0.4], [2.0, 0.3, 0.0], [1.0, 0.0, 0.1]],
            [0.0, 0.5, 0.3, 0.1],
        ),
        ([[0.2, 0, 0], [0, 0.2, 0]], [[1.0, 0.1, 0], [1.2, 5.0, 0]], [0.1, 0.2]),
        ([[0.0, 0, 0], [0, 0, 0.1]], [[0.0, 0.3, 0.4], [0.1, 0.0, 7.0]], [0.5, 0.1]),
        (  # round a curve
            [[0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0], [0, 0.1, 0]],
            [[1.0, 0, 0], [2.0, 1.0, 0.1], [2.0, 2.0, 0.2], [2.0, 3.0, 0.2]],
            [0.0, 0.1, np.nan, 0.1],
        ),
    ],
)
def test_line_distance__by_hand(goals, p_tool, expected):
    """A stop and the way back keep a line, a turn begins another; before, it is the start."""
    p, v = (np.stack([rows, np.zeros_like(rows)], axis=1, dtype=float) for rows in (p_tool, goals))
    result = m.line_distance(p, v, np.zeros((2, 3)))  # the second run rests meanwhile
    np.testing.assert_allclose(result[:, 0], expected, atol=1e-12)
    assert not result[:, 1].any()


def test_metrics__by_hand():
    """Of a run, and of another one beside it that stands still without a goal."""
    v = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.3, 0, 0], [0.3, 0, 0]])
    u = np.array([[0.0, 0.5], [0.2, 0.5], [0.2, -0.5], [0.2, -0.5]])
    p = np.outer([0.0, 0.1, 0.3, 0.0], [0, 1, 0])
    goals = np.tile([0.1, 0.0, 0.0], (4, 1))
    arrays = (np.zeros((4, 5)), np.zeros((4, 5)), u, p, v)
    trace = Trace(*(np.stack([array, 0 * array], axis=1) for array in arrays))
    goals = np.stack([goals, 0 * goals], axis=1)
    rows = m.metrics(BROKK_170, trace, goals, np.zeros((2, 3)))
    rewards = (1 / 1.1 + 1 + 2 / 1.2) / 4, 1
    np.testing.assert_allclose(rows.pop("reward_mean"), rewards)
    np.testing.assert_allclose(rows.pop("velocity_error_transient"), [0.125, np.nan])
    np.testing.assert_allclose(rows.pop("velocity_error_steady"), [np.nan, 0])
    expected = {
        "velocity_error_mean": (0.1 + 0.0 + 0.2 + 0.2) / 4,
        "velocity_rmse": np.sqrt((0.01 + 0.04 + 0.04) / 4),
        "valve_travel": 0.5 + 0.2 + 1.0,  # from rest, then tick by tick
        "jerk_rms": np.sqrt((0.1**2 + 0.2**2) / 2) * 400,  # second differences at 20 Hz
        "off_axis_drift_max": 0.3,
        "off_axis_drift_mean": 0.1,
    }
    assert rows.keys() == expected.keys()
    for name, value in expected.items():
        np.testing.assert_allclose(rows[name], [value, 0], atol=1e-12, err_msg=name)


def test_after_a_change__is_the_first_second_after_a_jump():
    """At 20 Hz; 14 mm/s in a tick is no jump, 16 mm/s is one."""
    goals = np.zeros((60, 2, 3))
    goals[5:, 0], goals[45:, 0] = [0.016, 0.0, 0.0], [0.016, 0.0, 0.014]
    goals[:, 1, 1] = 0.014 * np.arange(1, 61)
    np.testing.assert_array_equal(
        np.flatnonzero(m.after_a_change(BROKK_170, goals)[:, 0]), range(5, 25)
    )
    assert not m.after_a_change(BROKK_170, goals)[:, 1].any()


def test_compare__is_paired_by_hand():
    """Differences of -1, -2 and 3 from a mean of 10; along y there is no figure."""
    figures = {"a": [9.0, 7.0, 14.0], "b": [10.0, 9.0, 11.0]}
    runs = [
        {"controller": c, "sequence": s, "start": i, "error": x if s == "x" else None}
        for c, row in figures.items()
        for s in "xy"
        for i, x in enumerate(row)
    ]
    result = m.compare(runs, "a", "b", "error")
    half = 10 * 4.302653 * np.sqrt(7 / 3)  # Student's t of 2; the variance is 7
    expected = {"mean": 0, "low": -half, "high": half, "won": 2, "runs": 3}
    assert result["x"] == result["all"] == pytest.approx(expected, rel=1e-5, abs=1e-9)
    assert result["y"] == {"mean": None, "low": None, "high": None, "won": 0, "runs": 0}


STARTS = np.array([BROKK_170.q_start, [1.0, 0.5, 0.9, 1.5, 1.0]])
PID = pids(BROKK_170, obedient_net(BROKK_170))["jacobian_pid_k0.1"]


def test_evaluate__gives_rows_in_order_with_their_figures():
    """All sequences are one batch with the same noise, whatever the length of others."""
    controllers, sequences = {"pid": PID, "idle": Idle()}, short_axes(50, 10)
    every, alike = m.evaluate(BROKK_170, {"pid": PID}, sequences, STARTS, 0)
    sequences[1] = sequences[1]._replace(goals=sequences[1].goals[:30])
    rows, traces = m.evaluate(BROKK_170, controllers, sequences, STARTS, 0)
    labels = [(c, s, i, "workspace") for c in controllers for s in "xyz" for i in (0, 1)]
    assert [tuple(row[key] for key in m.LABELS[:4]) for row in rows] == labels
    assert rows[:2] + rows[4:6] == every[:2] + every[4:]
    np.testing.assert_array_equal(traces["pid", "y"].u, alike["pid", "y"].u[:30])
    p_start = tool_position(forward_kinematics(BROKK_170, STARTS))
    goals = sequences[1].for_starts(BROKK_170, STARTS)
    expected = m.metrics(BROKK_170, traces["pid", "y"], goals, p_start)
    for key, values in expected.items():
        assert [row[key] for row in rows[2:4]] == [None if x != x else x for x in values], key
    pid, idle = (m.means(rows)[c]["all"]["velocity_error_mean"]["mean"] for c in controllers)
    assert pid < idle


def test_mean_interval__of_one_value_or_equal_ones_or_none():
    one = m.mean_interval(np.array([1.0]))
    three = m.mean_interval(np.array([1.0, 2.0, 3.0]))
    assert [round(x, 3) for x in three.values()] == [2.0, -0.484, 4.484]
    assert one == {"mean": 1.0, "low": None, "high": None} and m.interval_text(one) == "1"
    assert m.interval_text({"mean": 0.5, "low": 0.5, "high": 0.5}) == "0.5000"
    assert m.interval_text(dict.fromkeys(one)) == "not measured"


def test_means__are_over_starts_of_the_means_of_their_runs():
    rows = [("x", 0, 1.0), ("x", 1, 3.0), ("y", 0, 2.0), ("y", 1, 6.0)]
    runs = [{"controller": "a", "sequence": s, "start": i, "error": e} for s, i, e in rows]
    result = m.means(runs)["a"]
    assert {s: result[s]["error"]["mean"] for s in result} == {"x": 2.0, "y": 4.0, "all": 3.0}
    assert result["all"]["error"] == m.mean_interval(np.array([1.5, 4.5]))
