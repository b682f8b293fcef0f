"""Figures of merit worked by hand; intervals against SciPy; the same starts compared."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from brokk_min.evaluation import metrics as m
from brokk_min.evaluation.rollout import Trace
from brokk_min.machine import BROKK_170


def line_distance(p: np.ndarray, goals: np.ndarray) -> np.ndarray:
    return m.line_distance(p[:, None], goals[:, None], np.zeros((1, 3)))[:, 0]


def test_line_distance_of_a_hand_worked_drift() -> None:
    # along x with 0.3 m to the side after the second tick; the stop and the way back keep the line
    goals = np.array([[0.2, 0, 0], [0.2, 0, 0], [0, 0, 0], [-0.1, 0, 0]])
    p = np.array([[1.0, 0, 0], [2.0, 0.3, 0.4], [2.0, 0.3, 0.0], [1.0, 0.0, 0.1]])
    assert line_distance(p, goals) == pytest.approx([0.0, 0.5, 0.3, 0.1])


def test_line_distance_starts_a_new_line_when_the_direction_turns() -> None:
    goals = np.array([[0.2, 0, 0], [0, 0.2, 0]])
    p = np.array([[1.0, 0.1, 0], [1.2, 5.0, 0]])  # second line through (1, 0.1) along y
    assert line_distance(p, goals) == pytest.approx([0.1, 0.2])


def test_line_distance_before_the_first_motion_is_from_the_start() -> None:
    goals = np.array([[0.0, 0, 0], [0, 0, 0.1]])
    p = np.array([[0.0, 0.3, 0.4], [0.1, 0.0, 7.0]])
    assert line_distance(p, goals) == pytest.approx([0.5, 0.1])


def test_line_distance_of_a_batch_is_that_of_its_runs() -> None:
    rng = np.random.default_rng(0)
    goals = np.repeat(rng.integers(-1, 2, (6, 4, 3)) * 0.1, 5, axis=0)
    goals[:10, 0] = 0.0  # one rests while the others move
    p, start = rng.normal(size=(30, 4, 3)), rng.normal(size=(4, 3))
    whole = m.line_distance(p, goals, start)
    for i in range(4):
        alone = m.line_distance(p[:, i : i + 1], goals[:, i : i + 1], start[i : i + 1])
        np.testing.assert_allclose(whole[:, i], alone[:, 0])


def trace_of(v: np.ndarray, q: np.ndarray | None = None, u: np.ndarray | None = None) -> Trace:
    """One run with tool velocities v (T, 3) from the origin."""
    middle = (BROKK_170.column("q_min") + BROKK_170.column("q_max")) / 2
    q = np.tile(middle, (len(v), 1)) if q is None else q
    u = np.zeros((len(v), 5)) if u is None else u
    rewards = 1 / (1 + np.arange(len(v)))
    return Trace(*(a[:, None] for a in (q, 0 * q, q, u, np.cumsum(v, axis=0) * 0.05, v, rewards)))


def figures(v: np.ndarray, goals: np.ndarray, **more: np.ndarray) -> dict[str, float]:
    found = m.metrics(BROKK_170, trace_of(v, **more), goals[:, None], np.zeros((1, 3)))
    return {name: float(value[0]) for name, value in found.items()}


def test_metrics_by_hand() -> None:
    v = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.3, 0, 0]])
    u = np.array([[0.0, 0.5], [0.2, 0.5], [0.2, -0.5]])
    row = figures(v, np.tile([0.1, 0.0, 0.0], (3, 1)), u=u)
    assert row["velocity_error_mean"] == pytest.approx((0.1 + 0.0 + 0.2) / 3)
    assert row["velocity_rmse"] == pytest.approx(np.sqrt((0.01 + 0.04) / 3))
    assert row["valve_travel"] == pytest.approx(0.5 + 0.2 + 1.0)  # from rest, then tick by tick
    assert row["jerk_rms"] == pytest.approx(0.1 * 400)  # second difference 0.1 m/s at 20 Hz
    assert row["reward_mean"] == pytest.approx((1 + 1 / 2 + 1 / 3) / 3)
    assert row["off_axis_drift_max"] == pytest.approx(0.0)
    assert row["position_error_mean"] == pytest.approx(
        (0.005 + 0.005 + 0.005) / 3
    )  # behind, behind, ahead


def test_figures_of_a_batch_are_those_of_its_runs() -> None:
    rng = np.random.default_rng(0)
    goals, start = (
        np.repeat(rng.integers(-1, 2, (3, 4, 3)) * 0.1, 10, axis=0),
        rng.normal(size=(4, 3)),
    )
    kinds = (rng.normal(0, 0.1, (30, 4, size)) for size in (5, 5, 5, 5, 3, 3))
    trace = Trace(*kinds, rng.random((30, 4)))
    whole = m.metrics(BROKK_170, trace, goals, start)
    for i in range(4):
        one = slice(i, i + 1)
        alone = m.metrics(BROKK_170, Trace(*(a[:, one] for a in trace)), goals[:, one], start[one])
        for name, value in whole.items():
            np.testing.assert_allclose(value[one], alone[name], err_msg=name)
    jerk = np.diff(trace.v_tool, n=2, axis=0) * 400
    np.testing.assert_allclose(whole["jerk_rms"] ** 2, (jerk**2).sum(axis=(0, 2)) / 28)


def test_errors_near_a_change_of_goal_are_transient() -> None:
    """Rest for 10 ticks, then 0.2 m/s for 30: 12 ticks of 0.1 m/s error, 18 of 0.01; 0.05 at rest."""
    goals = np.zeros((40, 3))
    goals[10:, 0] = 0.2
    v = goals.copy()
    v[:10, 1], v[10:22, 0], v[22:, 0] = 0.05, 0.1, 0.19
    row = figures(v, goals)
    assert row["velocity_error_transient"] == pytest.approx(0.1)
    assert row["velocity_error_steady"] == pytest.approx((10 * 0.05 + 18 * 0.01) / 28)
    assert row["settling_time"] == pytest.approx(12 * 0.05)  # below 0.03 m/s from then on


def test_a_run_that_does_not_settle_counts_to_the_next_change() -> None:
    goals = np.zeros((30, 3))
    goals[:20, 2] = 0.2  # the first goal is a change too: the machine comes from rest
    v = np.zeros((30, 3))
    v[5:10, 2] = 0.2  # near for a while, then away again
    assert figures(v, goals)["settling_time"] == pytest.approx((20 * 0.05 + 0) / 2)


def test_a_change_at_the_last_tick_counts_too() -> None:
    goals = np.zeros((10, 3))
    goals[9:, 1] = 0.2
    assert figures(np.zeros((10, 3)), goals)["settling_time"] == pytest.approx(0.05)
    goals[5:9, 1] = 0.1  # a change that is all but met at once, and that one
    v = np.where(goals == 0.2, 0.0, 0.9 * goals)
    assert figures(v, goals)["settling_time"] == pytest.approx((0 + 0.05) / 2)


def test_a_slow_goal_is_not_met_by_standing_still() -> None:
    """0.03 m/s, a tenth of the tool's speed: an error of 0.02 is no settling, one of 0.01 is."""
    goals = np.zeros((40, 3))
    goals[10:, 0] = 0.03
    assert figures(np.zeros((40, 3)), goals)["settling_time"] == pytest.approx(30 * 0.05)
    v = goals.copy()
    v[10:20, 0], v[20:, 0] = 0.01, 0.02
    assert figures(v, goals)["settling_time"] == pytest.approx(10 * 0.05)


def test_a_goal_that_turns_slowly_is_no_change() -> None:
    turn = np.linspace(0, 2 * np.pi, 320)
    goals = 0.15 * np.stack([np.cos(turn), 0 * turn, np.sin(turn)], axis=1)
    since = m.ticks_since_change(BROKK_170, goals[:, None])
    np.testing.assert_array_equal(since[:, 0], np.arange(320))  # the start is the only change
    assert (m.ticks_since_change(BROKK_170, np.zeros((4, 1, 3))) == -1).all()
    still = figures(np.zeros((4, 3)), np.zeros((4, 3)))
    assert np.isnan(still["settling_time"]) and np.isnan(still["velocity_error_transient"])


def test_time_at_limits_counts_driven_joints_alone() -> None:
    q = np.tile((BROKK_170.column("q_min") + BROKK_170.column("q_max")) / 2, (8, 1))
    q[:, 1] = BROKK_170.column("q_max")[1]  # locked
    q[2:5, 3] = BROKK_170.column("q_max")[3] - 0.005
    q[4:6, 0] = BROKK_170.column("q_min")[0] + 0.005
    assert figures(np.zeros((8, 3)), np.zeros((8, 3)), q=q)["time_at_limits"] == pytest.approx(
        4 * 0.05
    )


def test_intervals_are_students() -> None:
    values = np.random.default_rng(1).normal(2.0, 0.3, 12)
    expected = stats.ttest_1samp(values, 0).confidence_interval(0.95)
    np.testing.assert_allclose(m.interval(np.append(values, np.nan)), expected)
    assert m.interval(np.array([1.0, np.nan])) == [None, None]
    assert m.interval(np.array([1.0, 3.0])) == pytest.approx([2 - 12.7062, 2 + 12.7062], abs=1e-4)


def run(controller: str, sequence: str, start: int, error: float | None) -> dict[str, object]:
    labels = {"controller": controller, "sequence": sequence, "start": start, "kind": "workspace"}
    return labels | {"error": error}


def test_pairs_are_compared_on_the_same_start() -> None:
    """Starts differ far more than controllers: the paired interval sees the difference, means do not."""
    base = {0: 1.0, 1: 5.0, 2: 9.0}
    runs = [run("a", s, i, e + 0.1 * i) for s in "xy" for i, e in reversed(base.items())]
    runs += [run("b", s, i, e + (0.2 if s == "x" else 0.4)) for s in "xy" for i, e in base.items()]
    found = m.paired_difference(runs, "b", "a", "error")
    assert found["x"]["mean"] == pytest.approx(0.1) and found["y"]["mean"] == pytest.approx(0.3)
    assert found["all"]["mean"] == pytest.approx(0.2)
    np.testing.assert_allclose(
        [found["x"]["low"], found["x"]["high"]], m.interval(np.array([0.2, 0.1, 0.0]))
    )


def test_one_is_compared_with_all_others_in_every_figure() -> None:
    runs = [
        run(c, "x", i, e) | {"other": 2 * e}
        for c, e in {"a": 1.0, "b": 3.0, "c": 7.0}.items()
        for i in (0, 1)
    ]
    found = m.paired_differences(runs, "b")
    assert list(found) == ["error", "other"] and list(found["error"]) == ["a", "c"]
    assert [found["other"][c]["all"]["mean"] for c in "ac"] == [4.0, -8.0]
    assert found["error"]["a"] == m.paired_difference(runs, "b", "a", "error")


def test_a_summary_leaves_out_what_was_not_measured() -> None:
    runs = [
        run("a", "x", 0, 1.0),
        run("a", "y", 0, None),
        run("a", "x", 1, 3.0),
        run("a", "y", 1, None),
    ]
    found = m.summary(runs)["a"]
    assert (
        found["x"]["error"] == 2.0 and found["y"]["error"] is None and found["all"]["error"] == 2.0
    )
    assert m.intervals(runs)["a"]["y"]["error"] == [None, None]
    assert m.intervals(runs)["a"]["x"]["error"] == m.interval(np.array([1.0, 3.0]))


def test_drift_is_the_largest_and_the_mean_distance_from_the_line() -> None:
    """Off the line by 0, then 3 mm and 4 mm across, then 0 again."""
    v = 20 * np.array([[0.01, 0.0, 0.0], [0.01, 0.003, 0.004], [0.01, -0.003, -0.004]])
    row = figures(v, np.tile([0.1, 0.0, 0.0], (3, 1)))
    assert row["off_axis_drift_max"] == pytest.approx(0.005)
    assert row["off_axis_drift_mean"] == pytest.approx(0.005 / 3)


def test_the_mean_of_a_row_leaves_out_what_is_no_number() -> None:
    assert m.row_mean(np.array([[1.0, np.nan, 4.0], [2.0, 3.0, 7.0]])).tolist() == [2.5, 4.0]
    assert m.row_mean(np.array([[np.nan, 3.0]])) == 3.0 and np.isnan(
        m.row_mean(np.full((1, 2), np.nan))
    )
