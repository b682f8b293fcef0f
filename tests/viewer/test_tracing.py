"""Lines to trace: their shapes by hand, what counts as passed, the figures, the table."""

import time

import numpy as np
import pytest
from helpers_bus import START
from helpers_viewer import telemetry, tool

from brokk_min.evaluation.feasibility import feasible
from brokk_min.machine import BROKK_170
from brokk_min.viewer import tracing
from brokk_min.viewer.tracing import Attempt, Tracing

LINES = tracing.task_lines(BROKK_170)


@pytest.mark.parametrize("task", LINES)
def test_task_lines__are_dense_and_feasible_from_the_start_pose(task):
    line = LINES[task]
    steps = np.diff(line, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    assert not line[0].any()
    assert 0 < lengths.min() <= lengths.max() < tracing.SPACING + 1e-9
    goals = np.repeat(steps, 20, axis=0)[:, None]  # 20 ticks of 0.05 s: a step a second
    assert feasible(BROKK_170, np.array([START]), goals).all()


def test_distance__is_that_of_the_nearest_segment_by_hand():
    line = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0]])
    p = np.array([[0.5, 0.0, 0.2], [-3.0, 4.0, 0.0], [1.2, 0.5, 0.0], [1.0, 1.0, 0.0]])
    np.testing.assert_allclose(tracing.distance(line, p), [0.2, 5.0, 0.2, 0.0], atol=1e-12)


def test_tracing__ends_when_all_points_were_passed_in_order():
    line = tool(START) + np.array([[0.0, 0, 0], [0, 0.3, 0], [0, 0.6, 0]])
    work = Tracing(BROKK_170, "line", line)
    assert not work.update(telemetry(2))  # the clock waits for the first opened valve
    radius = np.hypot(*tool(START)[:2])
    opened = np.full(5, 0.5)
    off = radius - np.sqrt(radius**2 - np.array([0.0, 0.6, 0.3, 0.55]) ** 2)
    for tick, y, passed in ((7, 0.0, 1), (8, 0.6, 1), (9, 0.3, 2), (16, 0.55, 3)):
        q = (np.arcsin(y / radius), *START[1:])
        assert work.update(telemetry(tick, q, u=opened)) == (passed == 3)
        assert work.passed == passed
    attempt = work.attempt("levers")
    assert attempt.seconds == pytest.approx(0.5)  # missed ticks count
    assert attempt.valve_travel == pytest.approx(2.5)
    assert (attempt.mean, attempt.max) == pytest.approx((off.mean(), off.max()))
    written = time.mktime(time.strptime(attempt.when, "%Y-%m-%dT%H:%M:%S"))
    assert abs(written - time.time()) < 60


def test_attempts__are_kept_in_a_table_and_averaged_by_mode(tmp_path):
    path = tmp_path / "attempts.csv"
    assert tracing.read_attempts(path) == []
    when = "2026-01-01T00:00:00"
    attempts = [Attempt(when, "circle", "rl", 10.0 + i, 0.01, 0.02, 5.0) for i in range(2)]
    attempts.append(Attempt(when, "circle", "levers", 40.0, 0.05, 0.1, 9.5))
    tracing.write_attempts(path, attempts)
    assert tracing.read_attempts(path) == attempts
    tracing.write_attempts(path, [attempts[0]._replace(mean=1 / 3, valve_travel=123456.789)])
    header = b"when,task,mode,seconds,mean,max,valve_travel\n"
    assert path.read_bytes() == header + b"2026-01-01T00:00:00,circle,rl,10,0.333333,0.02,123457\n"
    assert tracing.attempts_table(attempts, "circle") == [
        "mean of 2 by rl: 10.5 s, off by 0.010 m, at most 0.020 m, valves 5",
        "mean of 1 by levers: 40.0 s, off by 0.050 m, at most 0.100 m, valves 10",
    ]
    assert tracing.attempts_table(attempts, "rectangle") == []
    path.write_text("a,b\n1,2\n")
    with pytest.raises(ValueError, match=r"attempts.csv: row 1: expected a column when"):
        tracing.read_attempts(path)
