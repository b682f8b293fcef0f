"""Sequences and starts: by hand, from files, feasible, and apart from those for tuning."""

from dataclasses import replace

import numpy as np
import pytest

from brokk_min.actuator import BROKK_CYLINDERS, Hydraulics
from brokk_min.evaluation import sequences as s
from brokk_min.kinematics import forward_kinematics, jacobian, lowest_point
from brokk_min.machine import BROKK_170

START = np.array(BROKK_170.q_start)
STILL = np.zeros((2, 1, 3))
ANGLES = 2 * np.pi / 320 * np.arange(320)  # of a circle of 16 s


def hold_table(goals):
    """Rows of seconds and the velocity [m/s] that goals (T, 3) hold for them."""
    changes = np.flatnonzero(np.any(np.diff(goals, axis=0) != 0, axis=-1)) + 1
    first = np.concatenate([[0], changes])
    seconds = np.diff([*first, len(goals)]) / 20
    return np.concatenate([seconds[:, None], goals[first]], axis=1)


def test_axis_sequences__move_along_one_axis_and_back():
    """At two thirds and one third of the largest tool speed."""
    for i, (_, goals, _) in enumerate(s.axis_sequences(replace(BROKK_170, tool_speed=0.6))):
        assert not np.delete(goals, i, axis=1).any()
        np.testing.assert_allclose(np.unique(goals[:, i].round(9)), [-0.4, -0.2, 0, 0.2, 0.4])


def test_task_sequences__last_26_seconds_and_end_at_rest_where_they_began():
    """Their rests are of all lengths."""
    every = []
    for name, goals, _ in s.task_sequences(BROKK_170):
        assert goals.shape == (520, 3), name
        np.testing.assert_allclose(goals.sum(axis=0), 0, atol=1e-9)
        assert np.linalg.norm(goals, axis=-1).max() <= BROKK_170.tool_speed
        table = hold_table(goals)
        rests = table[~table[:, 1:].any(axis=1), 0]
        assert min(rests) >= 0.5 and max(rests) <= 10 and not goals[:10].any()
        every.extend(rests)
    below = [np.sum(np.array(every) < seconds) for seconds in (1, 2, 4, 11)]
    assert below[-1] == 35 and np.diff([0, *below]).min() >= 5


def test_for_starts__reverses_inward_goals_by_the_quadrant_of_the_tool():
    goals = np.array([[0.1, 0.2, 0.3]])
    q1 = np.array([0.5, 2.0, -0.5, -2.0])  # of the four quadrants
    starts = np.column_stack([q1, np.tile(START[1:], (4, 1))])
    signs = np.array([[-1, -1, 1], [1, -1, 1], [-1, 1, 1], [1, 1, 1]])
    inward = s.Commands("a", goals, inward=True).for_starts(BROKK_170, starts)
    np.testing.assert_allclose(inward, goals * signs[None])
    of_a_file = s.Commands("a", goals).for_starts(BROKK_170, starts)
    np.testing.assert_array_equal(of_a_file, np.tile(goals, (1, 4, 1)))


def test_task_sequences__by_hand():
    """Seconds and velocities of the motions between the rests."""
    moves = {name: hold_table(goals) for name, goals, _ in s.task_sequences(BROKK_170)}
    moves = {name: rows[rows[:, 1:].any(axis=1)] for name, rows in moves.items()}
    names = ["diagonal_flat", "diagonal_rise", "circle", "rectangle", "stop_and_go", "slow"]
    assert list(moves) == ["x", "y", "z", *names]
    expected = {
        "diagonal_flat": [[4, *0.2 * np.array([1, 1, 0]) / 2**0.5]],
        "diagonal_rise": [[4, *0.2 * np.array([1, -1, 1]) / 3**0.5]],
        "rectangle": [[5, 0, 0.15, 0], [3, 0, 0, 0.15], [5, 0, -0.15, 0], [3, 0, 0, -0.15]],
        "stop_and_go": [[1, v, 0, 0] for v in [0.2] * 4 + [-0.2] * 4],
        "slow": [[4, 0.03, 0, 0], [4, -0.03, 0, 0], [4, 0, 0, 0.03], [4, 0, 0, -0.03]],
        "circle": [[0.05, *0.15 * np.array([np.cos(x), 0, np.sin(x)])] for x in ANGLES],
    }
    for name, rows in expected.items():
        np.testing.assert_allclose(moves[name][: len(rows)], rows, atol=1e-9, err_msg=name)


STARTS = "q1,q2,q3,q4,q5\n0,0.5,0.5,1.7,1.2\n"
OUT_OF_RANGE = r"row 3: expected angles within .*, got \[0.0, 0."


@pytest.mark.parametrize(
    "row",
    ["0,0.5,0.5,1.7,2.2\n", "0,0.5,0.5,nan,1.2\n", "0,0,-0.3,2.5,1.2\n"],  # last: in the ground
)
def test_read_starts__refuses_what_is_no_start(tmp_path, row):
    path = tmp_path / "c.csv"
    path.write_text(STARTS + row)
    with pytest.raises(ValueError, match=f"^{path}: .*{OUT_OF_RANGE}"):
        s.read_starts(path, BROKK_170)


def test_evaluation_starts__of_the_package_are_those_of_reproduce(monkeypatch):
    monkeypatch.setattr(s, "STARTS_OF", 400)  # faster, with the same first ones
    starts, sequences = s.evaluation_starts(BROKK_170, 32, [], 0), s.task_sequences(BROKK_170)
    assert len(np.unique(starts, axis=0)) == 32
    assert np.histogram(starts[:, 0], [-2.14, -0.7, 0.7, 2.14])[0].min() >= 5
    np.testing.assert_array_equal(s.draw_starts(BROKK_170, 2, sequences, 2), starts[:2])
    for sequence in sequences:
        goals = sequence.for_starts(BROKK_170, starts)
        assert s.feasible(BROKK_170, starts, goals).all(), sequence.name
    with pytest.raises(
        ValueError, match=r"--num-starts: expected at most the 32 of starts.csv, got 33"
    ):
        s.evaluation_starts(BROKK_170, 33, [], 0)


def test_evaluation_starts__are_drawn_by_the_seed_for_another_machine():
    machine, short = replace(BROKK_170, ground=-0.1), s.axis_sequences(BROKK_170)[2]
    short = [short._replace(goals=short.goals[15:40])]
    starts = s.evaluation_starts(machine, 5, short, 3)
    np.testing.assert_array_equal(s.draw_starts(machine, 3, short, 3), starts[:3])
    assert (s.draw_starts(machine, 5, short, 4) != starts).any()


def test_draw_starts__refuses_a_machine_that_can_follow_nothing(monkeypatch):
    monkeypatch.setattr(s, "STARTS_OF", 30)  # faster
    with pytest.raises(ValueError, match=r"^brokk170: expected 2 starts .*, got 0: is tool_speed"):
        s.draw_starts(BROKK_170, 2, [s.Commands("fast", np.full((2, 3), 9.0))], 0)


def follows(start, goals=STILL, machine=BROKK_170):
    return bool(s.feasible(machine, start[None], goals)[0])


def test_feasible__refuses_a_path_through_a_singularity():
    """Stretched out straight no joint can move the tool outward: it leaves its path."""
    wide = [replace(j, q_min=-3.0, q_max=4.0) for j in BROKK_170.joints]
    rods = {name: replace(c, base=0.0) for name, c in BROKK_CYLINDERS.items()}
    machine = replace(BROKK_170, joints=tuple(wide), hydraulics=Hydraulics(rods))
    start = np.array([0.0, 0.5, 0.1, np.pi, 3 * np.pi / 4])
    outward = np.array([np.cos(0.6), 0.0, np.sin(0.6)]) / 5  # along the links after q2
    assert follows(start, np.zeros((5, 1, 3)), machine)
    assert not follows(start, np.tile(outward, (5, 1, 1)), machine)


@pytest.mark.parametrize("joint", BROKK_170.driven)
@pytest.mark.parametrize("end", ["q_min", "q_max"])
def test_feasible__keeps_a_margin_to_joint_limits(joint, end):
    near, far = np.tile([0.0, *START[1:]], (2, 1))
    inward = np.array([0.049, 0.051]) * (1 if end == "q_min" else -1)
    near[joint], far[joint] = BROKK_170.column(end)[joint] + inward
    high_enough = lowest_point(forward_kinematics(BROKK_170, far)) > 0.1
    assert not follows(near) and follows(far) == high_enough


@pytest.mark.parametrize("direction", [-1, 1])
@pytest.mark.parametrize("joint", [0, 2])
def test_feasible__keeps_a_margin_to_what_a_cylinder_can_do_there(joint, direction):
    """One joint alone. At 1.4 rad the arm of q3 is 0.198 m, not its longest, 0.3 m."""
    start = np.array([0.0, 0.5, 1.4, 1.71, 1.24])
    alone = (replace(one, driven=i == joint) for i, one in enumerate(BROKK_170.joints))
    machine = replace(BROKK_170, rate=100.0, joints=tuple(alone))
    cylinder = {-1: {0: 0.0498, 2: 0.0825}, 1: {0: 0.0498, 2: 0.0453}}[direction][joint]
    arm = {0: 0.15, 2: 0.198}[joint]  # q3: a triangle of 0.9 m, 0.3 m and 2.2 rad
    fastest = direction * 0.602 * cylinder / arm  # 63 % opens 0.602
    column = jacobian(forward_kinematics(machine, start))[:, joint]
    for fraction, expected in ((0.89, True), (0.91, False)):
        goals = np.tile(fraction * fastest * column, (2, 1, 1))
        assert follows(start, goals, machine) == expected


def test_feasible__compares_tool_and_path_at_the_same_tick():
    """At 10 Hz and 0.3 m/s the path of the next tick is 30 mm ahead."""
    sideways = np.tile([0.0, 0.3, 0.0], (3, 1, 1))
    assert follows(np.array([0.0, *START[1:]]), sideways, replace(BROKK_170, rate=10.0))


def test_tuning_set__is_feasible_and_rests_for_long():
    starts, goals = s.tuning_set(BROKK_170, 8, 7)
    assert starts.shape == (8, 5) and goals.shape == (400, 8, 3)
    assert s.feasible(BROKK_170, starts, goals).all()
    assert np.linalg.norm(goals, axis=-1).max() <= BROKK_170.tool_speed + 1e-6
    table = np.concatenate([hold_table(run)[:-1] for run in goals.swapaxes(0, 1)])  # but the last
    moves = table[:, 1:].any(axis=1)
    holds, rests = table[moves, 0], table[~moves, 0]
    assert min(holds) >= 0.5 and min(rests) >= 0.5
    assert 2 < max(holds) <= 3 and max(rests) > 5  # two rests may be one
