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
    ],
)
def test_line_distance__by_hand(goals, p_tool, expected):
    """A stop and the way back keep a line, a turn begins another; before, it is the start."""
    result = m.line_distance(np.array(p_tool)[:, None], np.array(goals)[:, None], np.zeros((1, 3)))
    assert result[:, 0] == pytest.approx(expected)


def test_metrics__by_hand():
    v = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.3, 0, 0]])
    u = np.array([[0.0, 0.5], [0.2, 0.5], [0.2, -0.5]])
    q, p_tool, rewards = np.zeros((3, 5)), np.cumsum(v, axis=0) * 0.05, 1 / np.arange(1, 4)
    trace = Trace(*(a[:, None] for a in (q, q, u, p_tool, v, rewards)))
    goals = np.tile([0.1, 0.0, 0.0], (3, 1, 1))
    row = m.metrics(BROKK_170, trace, goals, np.zeros((1, 3)))
    assert row["velocity_error_mean"] == pytest.approx((0.1 + 0.0 + 0.2) / 3)
    assert row["velocity_rmse"] == pytest.approx(np.sqrt((0.01 + 0.04) / 3))
    assert row["valve_travel"] == pytest.approx(0.5 + 0.2 + 1.0)  # from rest, then tick by tick
    assert row["jerk_rms"] == pytest.approx(0.1 * 400)  # second difference 0.1 m/s at 20 Hz
    assert row["reward_mean"] == pytest.approx((1 + 1 / 2 + 1 / 3) / 3)
    assert row["off_axis_drift_max"] == pytest.approx(0.0)


def test_metrics__of_a_batch_are_those_of_its_runs():
    rng = np.random.default_rng(0)
    goals = np.repeat(rng.integers(-1, 2, (3, 4, 3)) * 0.1, 10, axis=0)
    goals[:10, 0] = 0.0  # one rests while the others move
    start = rng.normal(size=(4, 3))
    arrays = [rng.normal(0, 0.1, (30, 4, size)) for size in (5, 5, 5, 3, 3)]
    trace = Trace(*arrays, rng.random((30, 4)))
    batch = m.metrics(BROKK_170, trace, goals, start)
    for i in range(4):
        run = slice(i, i + 1)
        of_run = Trace(*(array[:, run] for array in trace))
        for name, value in m.metrics(BROKK_170, of_run, goals[:, run], start[run]).items():
            np.testing.assert_allclose(batch[name][run], value, err_msg=name)
    jerk = np.diff(trace.v_tool, n=2, axis=0) * 400
    np.testing.assert_allclose(batch["jerk_rms"] ** 2, (jerk**2).sum(axis=(0, 2)) / 28)


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
    assert set(traces) == {(c, s) for c in controllers for s in "xyz"}
    np.testing.assert_array_equal(traces["pid", "z"].q, alike["pid", "z"].q)
    np.testing.assert_array_equal(traces["pid", "y"].u, alike["pid", "y"].u[:30])
    p_start = tool_position(forward_kinematics(BROKK_170, STARTS))
    goals = sequences[1].for_starts(BROKK_170, STARTS)
    expected = m.metrics(BROKK_170, traces["pid", "y"], goals, p_start)
    for row in rows[2:4]:
        for key, values in expected.items():
            assert row[key] == values[row["start"]], key
    pid, idle = (m.means(rows)[c]["all"]["velocity_error_mean"]["mean"] for c in controllers)
    assert pid < idle


def test_mean_interval__of_one_value_or_equal_ones():
    one = m.mean_interval(np.array([1.0]))
    assert one == {"mean": 1.0, "low": None, "high": None} and m.interval_text(one) == "1"
    assert m.interval_text({"mean": 0.5, "low": 0.5, "high": 0.5}) == "0.5000"


def test_means__are_over_starts_of_the_means_of_their_runs():
    rows = [("x", 0, 1.0), ("x", 1, 3.0), ("y", 0, 2.0), ("y", 1, 6.0)]
    runs = [{"controller": "a", "sequence": s, "start": i, "error": e} for s, i, e in rows]
    result = m.means(runs)["a"]
    assert {s: result[s]["error"]["mean"] for s in result} == {"x": 2.0, "y": 4.0, "all": 3.0}
    assert result["all"]["error"] == m.mean_interval(np.array([1.5, 4.5]))
