"""Honest sequences and starts, and the user's own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from brokk_min import sequences
from brokk_min.env import TaskConfig
from brokk_min.kinematics import lowest_point
from brokk_min.machine import BROKK_170


def test_starts_are_feasible_off_the_ground_and_not_the_tuning_starts() -> None:
    scored = sequences.axis_sequences(BROKK_170)
    starts = sequences.draw_starts(BROKK_170, scored, 6, np.random.default_rng(2))
    assert (lowest_point(BROKK_170, starts) > 0.1).all()
    tuning, goals = sequences.tuning_goals(BROKK_170, 4, 6.0, 1000)
    assert np.abs(tuning[:, None] - starts[None]).max(-1).min() > 1e-3
    goals_scored = {tuple(row) for s in scored for row in s.goals if row.any()}
    moving = goals[np.linalg.norm(goals, axis=-1) > 0]
    assert not any(tuple(row) in goals_scored for row in moving)


def test_feasible_refuses_a_path_out_of_reach() -> None:
    start = np.array([[0.0, 0.5, 0.58, 1.71, 1.24]])
    outward = np.tile([0.2, 0.0, 0.0], (400, 1, 1))  # 4 m further out than 3.05 m: beyond 5 m
    still = np.zeros((400, 1, 3))
    assert not sequences.feasible(BROKK_170, start, outward)[0]
    assert sequences.feasible(BROKK_170, start, still)[0]


@pytest.mark.parametrize("tool_speed", [0.3, 0.6])
def test_axis_sequences_move_along_one_axis_and_turn_round(tool_speed: float) -> None:
    """At two thirds and one third of the speed that an operator may ask for: 0.2 and 0.1 of 0.3 m/s."""
    machine, fast = replace(BROKK_170, tool_speed=tool_speed), round(tool_speed * 2 / 3, 3)
    for i, sequence in enumerate(sequences.axis_sequences(machine)):
        others = np.delete(sequence.goals, i, axis=1)
        assert not others.any()
        assert {round(v, 3) for v in sequence.goals[:, i]} == {0.0, fast, -fast, fast / 2, -fast / 2}
        assert sequence.goals.sum() == pytest.approx(0.0)


def test_commands_are_held_until_the_next_row(tmp_path: Path) -> None:
    path = tmp_path / "c.csv"
    path.write_text("sequence,time,vx,vy,vz\na,0,0.1,0,0\na,0.5,0,0,0.2\na,1,0,0,0\nb,2,0,0,0\nb,2.1,0,0,0\n")
    first, second = sequences.read_commands(path, BROKK_170)
    assert (first.name, len(first.goals), second.name, len(second.goals)) == ("a", 20, "b", 2)
    assert (first.goals[:10] == [0.1, 0, 0]).all() and (first.goals[10:] == [0, 0, 0.2]).all()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("sequence,time,vx,vy\na,0,0,0\n", "row 1: expected a column vz"),
        ("sequence,time,vx,vy,vz\na,0,0,0,fast\na,1,0,0,0\n", "row 2, column vz: expected a number"),
        ("sequence,time,vx,vy,vz\na,0,0,0,nan\na,1,0,0,0\n", "row 2, column vz: expected a finite"),
        ("sequence,time,vx,vy,vz\na,1,0,0,0\na,0,0,0,0\n", "sequence a: expected two or more rows"),
        ("sequence,time,vx,vy,vz\na,1,0,0,0\n", "sequence a: expected two or more rows"),
        ("", "expected a header"),
    ],
)
def test_bad_commands_are_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "c.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=message) as error:
        sequences.read_commands(path, BROKK_170)
    assert str(path) in str(error.value)


def test_starts_outside_the_joints_ranges_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "s.csv"
    path.write_text("q1,q2,q3,q4,q5\n0,0.5,0.5,1.7,1.2\n0,0.5,0.5,1.7,2.2\n")
    with pytest.raises(ValueError, match=r"row 3, column q5: expected 0.0 to 2.0 rad, got 2.2"):
        sequences.read_starts(path, BROKK_170)


def test_starts_in_the_ground_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "s.csv"
    path.write_text("q1,q2,q3,q4,q5\n0,0.5,0.5,1.7,1.2\n0,0,-0.3,2.5,1.2\n")
    with pytest.raises(ValueError, match=r"s.csv: row 3: expected the whole arm above 0.0 m, got -"):
        sequences.read_starts(path, BROKK_170)


def test_tuning_runs_are_drawn_like_the_policys_episodes() -> None:
    config = TaskConfig()
    starts, goals = sequences.tuning_goals(BROKK_170, 8, 12.0, 7)
    assert starts.shape == (8, 5) and goals.shape == (240, 8, 3)
    assert np.linalg.norm(goals, axis=-1).max() <= BROKK_170.tool_speed + 1e-6
    holds = []
    for run in goals.swapaxes(0, 1):
        changes = np.flatnonzero(np.abs(np.diff(run, axis=0)).max(axis=1)) + 1
        holds += list(np.diff([0, *changes]))  # the last hold is cut short
    assert min(holds) >= config.hold_min_s * 20
    assert max(holds) > 40 and np.mean(holds) < config.hold_max_s * 20
    again = sequences.tuning_goals(BROKK_170, 8, 12.0, 7)
    assert np.array_equal(starts, again[0]) and np.array_equal(goals, again[1])


def test_feasible_refuses_a_tool_that_stays_behind() -> None:
    """Stretched out straight no joint can move the tool outward: all stand, slow and inside their ranges."""
    wide = [replace(j, cylinder_base=0.0, q_min=-3.0, q_max=4.0) for j in BROKK_170.joints]
    machine = replace(BROKK_170, joints=tuple(wide))
    start = np.array([[0.0, 0.5, 0.1, np.pi, 3 * np.pi / 4]])
    outward = np.array([np.cos(0.6), 0.0, np.sin(0.6)]) / 5  # along the links behind q2
    assert sequences.feasible(machine, start, np.zeros((5, 1, 3)))[0]
    assert not sequences.feasible(machine, start, np.tile(outward, (5, 1, 1)))[0]
