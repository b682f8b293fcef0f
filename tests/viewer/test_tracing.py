"""Lines to trace: their shapes by hand, what counts as passed, the figures, the table."""

import time
from itertools import pairwise

import numpy as np
import pytest
from helpers_bus import BASELINE, START
from helpers_viewer import PipedLoop, telemetry, tool

from brokk_min.evaluation.feasibility import feasible
from brokk_min.machine import BROKK_170
from brokk_min.viewer import tracing
from brokk_min.viewer.camera import extent
from brokk_min.viewer.play import Session
from brokk_min.viewer.tracing import Attempt, Tracing

LINES = tracing.task_lines(BROKK_170)
REACH = extent(BROKK_170)[2]
RECTANGLE = [[0, 0, 0], [0, 0.16, 0], [0.1, 0.16, 0], [0.1, 0, 0], [0, 0, 0]]


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
    for tick, y, passed in ((7, 0.0, 1), (8, 0.6, 1), (9, 0.3, 2), (16, 0.55, 3)):
        q = (np.arcsin(y / radius), *START[1:])
        assert work.update(telemetry(tick, q, u=opened)) == (passed == 3)
        assert work.passed == passed
    attempt = work.attempt("levers")
    assert attempt.seconds == pytest.approx(0.5)  # missed ticks count
    assert attempt.valve_travel == pytest.approx(2.5)
    written = time.mktime(time.strptime(attempt.when, "%Y-%m-%dT%H:%M:%S"))
    assert abs(written - time.time()) < 60


def test_attempt__agrees_with_a_driven_rectangle_worked_out_apart():
    """The operator steers to the next point of the line, through the gate and the plant."""
    loop = PipedLoop(BASELINE)
    loop.go(0.4, False)
    session = Session(BROKK_170, ["jacobian", "levers"], None)
    session.update(loop.ticks[-1], 0.0)
    session.next_task()
    work = session.tracing
    assert work is not None
    np.testing.assert_allclose(work.line[0], tool(loop.ticks[-1].q))
    loop.go(0.2, True)
    rows = []
    while not session.attempts and loop.world.t < 60:
        away = work.line[min(work.passed + 2, len(work.line) - 1)] - tool(loop.ticks[-1].q)
        loop.go(0.04, True, 0.2 * away / max(np.linalg.norm(away), 0.05))
        session.update(loop.ticks[-1], loop.world.t)
        rows.append(loop.ticks[-1])
    loop.close()
    (attempt,) = session.attempts
    rows = rows[next(i for i, row in enumerate(rows) if row.u.any()) :]
    assert attempt.seconds == pytest.approx(len(rows) / 20)
    corners = work.line[0] + REACH * np.array(RECTANGLE)
    fine = np.vstack([np.linspace(a, b, 500) for a, b in pairwise(corners)])
    p = tool([row.q for row in rows])
    error = np.linalg.norm(p[:, None] - fine, axis=-1).min(axis=1)
    assert attempt.mean == pytest.approx(error.mean(), abs=1e-3)
    assert attempt.max == pytest.approx(error.max(), abs=1e-3)
    assert 0.005 < attempt.mean < 0.06
    u = np.array([0 * rows[0].u, *(row.u for row in rows)])
    assert attempt.valve_travel == pytest.approx(np.abs(np.diff(u, axis=0)).sum())
    assert attempt.mode == "jacobian"
    assert session.tracing is None
    notes = session.notes("levers")[-2:]
    assert notes[0].startswith("rectangle by jacobian: ")
    assert notes[1].startswith("mean of 1 by jacobian: ")


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
