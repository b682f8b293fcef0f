"""Honest sequences and starts, and the user's own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from brokk_min.actuator import speed_limits
from brokk_min.env import TaskConfig
from brokk_min.evaluation import sequences
from brokk_min.kinematics import forward_kinematics, jacobian, lowest_point, tool_position
from brokk_min.machine import BROKK_170, Machine


def test_the_starts_of_the_package_are_of_all_kinds_and_not_the_tuning_starts() -> None:
    starts = sequences.evaluation_starts(BROKK_170, 64, [], 0)
    kinds = np.array(sequences.start_kinds(BROKK_170, starts))
    assert [np.sum(kinds == kind) for kind in sequences.KINDS] == [32, 16, 16]
    assert kinds[:4].tolist() == ["workspace", "limits", "workspace", "extended"]
    assert (lowest_point(forward_kinematics(BROKK_170, starts)) > 0).all()
    assert len(np.unique(starts, axis=0)) == 64
    workspace = starts[kinds == "workspace"]
    for sequence in sequences.task_sequences(BROKK_170)[:3]:
        goals = np.repeat(sequence.goals[:, None], len(workspace), axis=1)
        assert sequences.feasible(BROKK_170, workspace, goals).all(), sequence.name
    tuning, goals = sequences.tuning_set(BROKK_170, 4, 1000, 6.0)
    assert np.abs(tuning[:, None] - starts[None]).max(-1).min() > 1e-3
    goals_scored = {
        tuple(row) for s in sequences.task_sequences(BROKK_170) for row in s.goals if row.any()
    }
    moving = goals[np.linalg.norm(goals, axis=-1) > 0]
    assert not any(tuple(row) in goals_scored for row in moving)


def test_the_starts_of_the_package_are_those_of_their_seed() -> None:
    """`brokk-min starts` draws the file; its first ones in a tenth of the time."""
    every = sequences.task_sequences(BROKK_170)
    drawn = sequences.draw_starts(BROKK_170, every, 4, np.random.default_rng(2))
    np.testing.assert_array_equal(drawn, sequences.evaluation_starts(BROKK_170, 4, [], 0))


def test_held_rows_are_what_is_held() -> None:
    for sequence in sequences.task_sequences(BROKK_170):
        rows = sequences.hold_table(BROKK_170, sequence.goals)
        ticks = np.rint(rows[:, 0] * 20).astype(int)
        np.testing.assert_array_equal(np.repeat(rows[:, 1:], ticks, axis=0), sequence.goals)
        assert (np.diff(rows[:, 1:], axis=0) != 0).any(axis=1).all()
    first = sequences.hold_table(BROKK_170, sequences.task_sequences(BROKK_170)[0].goals)
    np.testing.assert_allclose(first[:3], [[1, 0, 0, 0], [4, 0.2, 0, 0], [1, 0, 0, 0]])


def test_more_starts_than_the_package_has_are_refused() -> None:
    with pytest.raises(ValueError, match=r"starts.csv: expected at most 64 starts, got 65"):
        sequences.evaluation_starts(BROKK_170, 65, [], 0)


def test_another_machine_draws_its_starts(tmp_path: Path) -> None:
    other = replace(BROKK_170, name="other")
    slow = sequences.task_sequences(other)[-1:]
    starts = sequences.evaluation_starts(other, 5, slow, 3)
    kinds = sequences.start_kinds(other, starts)
    assert kinds == ["workspace", "limits", "workspace", "extended", "workspace"]
    feasible = sequences.feasible(other, starts, np.repeat(slow[0].goals[:, None], 5, axis=1))
    assert feasible[[0, 1, 2, 4]].all()
    np.testing.assert_array_equal(starts, sequences.evaluation_starts(other, 5, slow, 3))
    sequences.write_starts(tmp_path / "s.csv", other, starts)
    np.testing.assert_array_equal(sequences.read_starts(tmp_path / "s.csv", other), starts)


def test_kinds_of_starts_by_hand() -> None:
    ordinary = [1.5, 0.5, 0.58, 1.71, 1.24]
    near_limit = [1.5, 0.5, 0.58, 2.80, 1.24]  # 0.1 rad below q4's 2.9
    locked_at_limit = [1.5, 0.05, 0.58, 1.71, 1.24]  # q2 is not driven
    upright = [0.0, 1.4, 0.5, 2.7, 1.9]  # 4.5 of 4.75 m, 0.8 m from the slew axis
    kinds = sequences.start_kinds(
        BROKK_170, np.array([ordinary, near_limit, locked_at_limit, upright])
    )
    assert kinds == ["workspace", "limits", "workspace", "extended"]


def test_all_sequences_last_18_seconds_end_at_rest_and_where_they_began() -> None:
    found = {s.name: s.goals for s in sequences.task_sequences(BROKK_170)}
    assert list(found)[:3] == ["x", "y", "z"] and len(found) == 9
    for name, goals in found.items():
        assert goals.shape == (360, 3), name
        assert not goals[:20].any() and not goals[-20:].any()
        np.testing.assert_allclose(goals.sum(axis=0), 0, atol=1e-9)
        assert np.linalg.norm(goals, axis=-1).max() <= BROKK_170.tool_speed
    path = np.cumsum(found["circle"], axis=0) * 0.05
    centre = (path[20:340].max(0) + path[20:340].min(0)) / 2
    np.testing.assert_allclose(
        np.linalg.norm(path[20:340] - centre, axis=-1), 0.15 * 16 / (2 * np.pi), rtol=0.02
    )
    assert not found["circle"][:, 1].any() and not found["rectangle"][:, 0].any()
    corners = np.cumsum(found["rectangle"], axis=0)[[20 + 99, 20 + 159, 20 + 259, 20 + 319]] * 0.05
    np.testing.assert_allclose(
        corners[:, 1:], [[0.75, 0], [0.75, 0.45], [0, 0.45], [0, 0]], atol=1e-9
    )
    assert np.linalg.norm(found["slow"], axis=-1).max() == pytest.approx(0.03)
    starts_and_stops = np.diff((np.linalg.norm(found["stop_and_go"], axis=-1) > 0).astype(int))
    assert (starts_and_stops == 1).sum() == (starts_and_stops == -1).sum() == 8


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
        assert {round(v, 3) for v in sequence.goals[:, i]} == {
            0.0,
            fast,
            -fast,
            fast / 2,
            -fast / 2,
        }
        assert sequence.goals.sum() == pytest.approx(0.0)


def test_commands_are_held_until_the_next_row(tmp_path: Path) -> None:
    path = tmp_path / "c.csv"
    path.write_text(
        "sequence,time,vx,vy,vz\na,0,0.1,0,0\na,0.5,0,0,0.2\na,1,0,0,0\nb,2,0,0,0\nb,2.1,0,0,0\n"
    )
    first, second = sequences.read_commands(path, BROKK_170)
    assert (first.name, len(first.goals), second.name, len(second.goals)) == ("a", 20, "b", 2)
    assert (first.goals[:10] == [0.1, 0, 0]).all() and (first.goals[10:] == [0, 0, 0.2]).all()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("sequence,time,vx,vy\na,0,0,0\n", "row 1: expected a column vz"),
        (
            "sequence,time,vx,vy,vz\na,0,0,0,fast\na,1,0,0,0\n",
            "row 2, column vz: expected a number",
        ),
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
    with pytest.raises(
        ValueError, match=r"s.csv: row 3: expected the whole arm above 0.0 m, got -"
    ):
        sequences.read_starts(path, BROKK_170)


def test_tuning_runs_are_drawn_like_the_policys_episodes() -> None:
    config = TaskConfig()
    starts, goals = sequences.tuning_set(BROKK_170, 8, 7, 12.0)
    assert starts.shape == (8, 5) and goals.shape == (240, 8, 3)
    assert np.linalg.norm(goals, axis=-1).max() <= BROKK_170.tool_speed + 1e-6
    holds = []
    for run in goals.swapaxes(0, 1):
        changes = np.flatnonzero(np.abs(np.diff(run, axis=0)).max(axis=1)) + 1
        holds += list(np.diff([0, *changes]))  # the last hold is cut short
    assert min(holds) >= config.hold_min_s * 20
    assert max(holds) > 40 and np.mean(holds) < config.hold_max_s * 20
    again = sequences.tuning_set(BROKK_170, 8, 7, 12.0)
    assert np.array_equal(starts, again[0]) and np.array_equal(goals, again[1])


def test_feasible_refuses_a_tool_that_stays_behind() -> None:
    """Stretched out straight no joint can move the tool outward: all stand, slow and inside their ranges."""
    wide = [replace(j, cylinder_base=0.0, q_min=-3.0, q_max=4.0) for j in BROKK_170.joints]
    machine = replace(BROKK_170, joints=tuple(wide))
    start = np.array([[0.0, 0.5, 0.1, np.pi, 3 * np.pi / 4]])
    outward = np.array([np.cos(0.6), 0.0, np.sin(0.6)]) / 5  # along the links behind q2
    assert sequences.feasible(machine, start, np.zeros((5, 1, 3)))[0]
    assert not sequences.feasible(machine, start, np.tile(outward, (5, 1, 1)))[0]


def test_the_least_motion_is_the_one_that_asks_most_of_the_joints() -> None:
    """By hand: beside the slew axis sideways motion is the hardest; and of all directions none needs more."""
    upright = [0.0, 1.139, 0.97, 2.804, 1.948]  # tool 0.1 m from the slew axis
    starts = np.array([upright, [0.5, *upright[1:]], [1.5, 0.5, 0.58, 1.71, 1.24]])
    half, quarter = sequences.singular_sequences(BROKK_170, starts)
    assert half.goals.shape == (360, 3, 3)
    np.testing.assert_allclose(half.goals, 2 * quarter.goals)
    speeds = np.linalg.norm(half.goals, axis=-1)
    np.testing.assert_allclose(np.unique(speeds.round(9)), [0.0, 0.05, 0.1])
    towards = half.goals[30] / 0.1
    np.testing.assert_allclose(towards[0], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(towards[1], [-np.sin(0.5), np.cos(0.5), 0], atol=1e-12)
    inverse = np.linalg.pinv(jacobian(forward_kinematics(BROKK_170, starts))[..., BROKK_170.driven])
    hardest = np.linalg.norm((inverse @ towards[..., None])[..., 0], axis=-1)
    others = np.random.default_rng(0).normal(size=(500, 1, 3))
    others /= np.linalg.norm(others, axis=-1, keepdims=True)
    assert (np.linalg.norm((inverse @ others[..., None])[..., 0], axis=-1) <= hardest + 1e-9).all()


def test_goals_for_all_starts_or_each() -> None:
    goals = np.arange(12.0).reshape(2, 2, 3)
    np.testing.assert_array_equal(sequences.Commands("each", goals).for_starts(2), goals)
    one = sequences.Commands("one", goals[:, 0]).for_starts(3)
    np.testing.assert_array_equal(one, np.stack([goals[:, 0]] * 3, axis=1))


def test_directions_and_names_of_the_sequences() -> None:
    found = {s.name: s.goals for s in sequences.task_sequences(BROKK_170)}
    assert list(found)[3:] == [
        "diagonal_flat",
        "diagonal_rise",
        "circle",
        "rectangle",
        "stop_and_go",
        "slow",
    ]
    np.testing.assert_allclose(found["diagonal_flat"][30], 0.2 * np.array([1, 1, 0]) / 2**0.5)
    np.testing.assert_allclose(found["diagonal_rise"][30], 0.2 * np.array([1, -1, 1]) / 3**0.5)
    np.testing.assert_allclose(found["circle"][[20, 100]], [[0.15, 0, 0], [0, 0, 0.15]], atol=1e-12)
    least = sequences.singular_sequences(BROKK_170, np.array([[0.0, 1.139, 0.97, 2.804, 1.948]]))
    assert [s.name for s in least] == ["least_half", "least_quarter"]


def test_margins_of_what_is_feasible_by_hand() -> None:
    """Joints 0.05 rad and the arm 0.1 m off their ends, driven joints below 0.9 of their speed."""
    ordinary, still = np.array([0.0, 0.5, 0.58, 1.71, 1.24]), np.zeros((2, 1, 3))
    low, high = BROKK_170.column("q_min"), BROKK_170.column("q_max")

    def can(start: np.ndarray, goals: np.ndarray = still, machine: Machine = BROKK_170) -> bool:
        return bool(sequences.feasible(machine, start[None], goals)[0])

    for joint in BROKK_170.driven:
        for end, inward in ((low, 1), (high, -1)):
            near, far = ordinary.copy(), ordinary.copy()
            near[joint], far[joint] = end[joint] + inward * 0.049, end[joint] + inward * 0.051
            clear = lowest_point(forward_kinematics(BROKK_170, far)) > 0.1
            assert not can(near) and can(far) == clear, joint
    lowest = float(lowest_point(forward_kinematics(BROKK_170, ordinary)))
    for ground, good in ((lowest - 0.101, True), (lowest - 0.099, False)):
        assert can(ordinary, machine=replace(BROKK_170, ground=ground)) == good
    radius = np.hypot(*tool_position(forward_kinematics(BROKK_170, ordinary))[:2])
    for way, limit in zip((-1, 1), speed_limits(BROKK_170, ordinary), strict=True):
        for share, good in ((0.89, True), (0.91, False)):
            slewing = np.array([0.0, share * abs(limit[0]) * radius * way, 0.0])
            assert (
                can(ordinary, np.tile(slewing, (2, 1, 1)), replace(BROKK_170, rate=100.0)) == good
            )


def test_a_path_is_feasible_only_if_all_of_it_is() -> None:
    """Too fast for a tick, then at rest where all is well; each start by itself."""
    start = np.tile([0.0, 0.5, 0.58, 1.71, 1.24], (3, 1))
    goals = np.zeros((4, 3, 3))
    goals[0, 0, 1], goals[0, 1, 1] = 0.7, 0.1
    machine = replace(BROKK_170, rate=100.0)
    assert sequences.feasible(machine, start, goals).tolist() == [False, True, True]


def test_a_machine_without_a_file_draws_starts_of_a_seed_of_its_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    other, asked = replace(BROKK_170, name="other"), []
    monkeypatch.setattr(sequences, "draw_starts", lambda *a: asked.append(a) or "drawn")
    found, starts = sequences.goals_and_starts(other, None, None, 3, 7)
    machine, goals, num, rng = asked[0]
    assert starts == "drawn" and (machine, num) == (other, 3)
    assert [s.name for s in goals] == [s.name for s in found] and len(found) == 9
    assert rng.integers(10**9) == np.random.default_rng(9).integers(10**9)


def test_commands_of_a_file_by_hand(tmp_path: Path) -> None:
    """Values count from their row on, to the tick; a sequence lasts a tick or more."""
    path = tmp_path / "c.csv"
    path.write_text(
        "sequence,time,vx,vy,vz\na,5,1,2,3\na,5.1,4,5,6\na,5.15,0,0,0\nb,0,7,8,9\nb,0.05,0,0,0\n"
    )
    first, second = sequences.read_commands(path, BROKK_170)
    assert first.goals.tolist() == [[1, 2, 3], [1, 2, 3], [4, 5, 6]] and second.goals.tolist() == [
        [7, 8, 9]
    ]
    for rows in ("b,0,1,0,0\nb,0,2,0,0\nb,1,0,0,0\n", "b,1,0,0,0\n"):
        path.write_text(f"sequence,time,vx,vy,vz\n{rows}")
        with pytest.raises(
            ValueError, match=r"c.csv: sequence b: expected two or more rows with rising time"
        ):
            sequences.read_commands(path, BROKK_170)


def test_kinds_of_starts_at_their_thresholds() -> None:
    ordinary = np.array([1.5, 0.5, 0.58, 1.71, 1.24])
    ends = np.tile(ordinary, (4, 1))
    ends[[0, 1], 3] = 2.9 - np.array([0.151, 0.149])
    ends[[2, 3], 4] = [0.151, 0.149]
    assert sequences.start_kinds(BROKK_170, ends) == ["workspace", "limits"] * 2


def test_drawn_starts_by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    """Poses are numbers; from number k goals up to k can be followed. Two sequences have goals 3 and 6."""
    draws: list[list[tuple[str, float]]] = []
    calls = []

    def pose(
        machine: Machine, config: TaskConfig, rng: np.random.Generator, num: int
    ) -> np.ndarray:
        calls.append(num)
        drawn = draws[min(len(calls), len(draws)) - 1]
        return np.array(
            [[value + 1e-5, sequences.KINDS.index(kind), 0, 0, 0] for kind, value in drawn]
        )

    def able(machine: Machine, start: np.ndarray, goals: np.ndarray) -> np.ndarray:
        assert goals.shape == (2, len(start), 3)
        return start[:, 0] >= goals[0, :, 0]

    monkeypatch.setattr(sequences, "draw_pose", pose)
    monkeypatch.setattr(
        sequences, "start_kinds", lambda m, q: [sequences.KINDS[int(k)] for k in q[:, 1]]
    )
    monkeypatch.setattr(sequences, "feasible", able)
    goals = [sequences.Commands(f"to {k}", np.tile([k, 0.0, 0.0], (2, 1))) for k in (3, 6)]

    def drawn(num: int, *kinds: list[tuple[str, float]]) -> list[float]:
        draws[:] = kinds
        calls.clear()
        return sequences.draw_starts(BROKK_170, goals, num, np.random.default_rng(0))[:, 0].tolist()

    works = [("workspace", 5), ("workspace", 7), ("limits", 2), ("limits", 4), ("extended", 1)]
    more = [("workspace", 8), ("limits", 9), ("extended", 0), ("workspace", 6)]
    assert drawn(4, works, more) == [7, 4, 8, 1] and calls == [4000, 4000]
    assert drawn(8, works, more) == [7, 4, 8, 1, 6, 9, 8, 0] and len(calls) == 3
    few = [("workspace", 6), ("workspace", 7), ("workspace", 8), ("workspace", 2)]
    with pytest.raises(
        ValueError, match=r"^brokk170: expected 9 poses from .* feasible, got fewer in 200 draws$"
    ):
        drawn(9, [("workspace", 2)])
    assert len(calls) == 200
    assert drawn(4, few) == [6, 7, 8, 6]  # the other kinds have none: workspace stands in


def test_tuning_runs_by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 200 drawn at a time those that are feasible, in turn; the goals of a run hold one after another."""
    seen, inner = [], sequences.reset

    def able(machine: Machine, start: np.ndarray, goals: np.ndarray) -> np.ndarray:
        assert start.shape == (200, 5) and goals.shape == (30, 200, 3)
        seen.append((start, goals))
        return np.arange(200) % 100 == 7

    monkeypatch.setattr(sequences, "feasible", able)
    starts, goals = sequences.tuning_set(BROKK_170, 3, 5, 1.5)
    assert len(seen) == 2 and goals.shape == (30, 3, 3)
    for k, (draw, row) in enumerate(((0, 7), (0, 107), (1, 7))):
        np.testing.assert_array_equal(starts[k], seen[draw][0][row])
        np.testing.assert_array_equal(goals[:, k], seen[draw][1][:, row])
    holds = int(np.ceil(1.5 / TaskConfig().hold_min_s))
    drawn = inner(BROKK_170, TaskConfig(), np.random.default_rng(5), 200 * holds, plant=False)
    np.testing.assert_array_equal(starts[0], drawn.q[7 * holds])
    first = np.repeat(
        drawn.v_goal[7 * holds : 8 * holds], drawn.goal_ticks[7 * holds : 8 * holds], axis=0
    )
    np.testing.assert_array_equal(goals[:, 0], first[:30])
    monkeypatch.setattr(
        sequences, "feasible", lambda machine, start, goals: np.arange(200) == len(seen)
    )
    with pytest.raises(
        ValueError, match=r"^brokk170: expected 61 feasible runs to tune on, got 60$"
    ):
        sequences.tuning_set(BROKK_170, 61, 5, 0.1)


def test_a_file_of_starts_by_hand(tmp_path: Path) -> None:
    path = tmp_path / "s.csv"
    sequences.write_starts(
        path, BROKK_170, np.array([[0.5, 0.5, 0.58, 1.71, 1.24], [-0.25, 0.5, 0.1, 2.0, 1.0]])
    )
    assert path.read_text() == "q1,q2,q3,q4,q5\n0.5,0.5,0.58,1.71,1.24\n-0.25,0.5,0.1,2.0,1.0\n"
    commands = tmp_path / "c.csv"
    commands.write_text("sequence,time,vx,vy,vz\na,0,0.1,0,0\na,1,0,0,0\n")
    found, starts = sequences.goals_and_starts(BROKK_170, commands, path, 9, 0)
    assert [s.name for s in found] == ["a"] and starts.tolist()[1] == [-0.25, 0.5, 0.1, 2.0, 1.0]
    found, starts = sequences.goals_and_starts(BROKK_170, None, None, 3, 0)
    assert len(found) == 9 and np.array_equal(
        starts, sequences.evaluation_starts(BROKK_170, 3, found, 2)
    )
