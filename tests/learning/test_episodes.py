"""Episodes: distributions of poses and goals, goals that change, rows that are replaced."""

from dataclasses import fields, replace

import numpy as np
import pytest
from helpers_machines import closed_form
from scipy import stats

from brokk_min import env
from brokk_min.actuator import PlantState
from brokk_min.env import TaskConfig
from brokk_min.kinematics import forward_kinematics, lowest_point
from brokk_min.learning import episodes
from brokk_min.machine import BROKK_170


def generator(seed=0):
    return np.random.default_rng(seed)


@pytest.mark.parametrize("config", [TaskConfig(redraw_ground=False), TaskConfig(paper=True)])
def test_draw_pose__is_uniform_or_above_the_ground(config):
    low, high = BROKK_170.column("q_min"), BROKK_170.column("q_max")
    anywhere = episodes.draw_pose(BROKK_170, config, generator(), 2000)
    for fraction in ((anywhere - low) / (high - low)).T:
        assert stats.kstest(fraction, "uniform").pvalue > 1e-3
    assert (closed_form(anywhere)[1] < 0).mean() > 0.02
    free = episodes.draw_pose(BROKK_170, TaskConfig(), generator(), 2000)
    assert (closed_form(free)[1] >= 0).all()
    assert ((low <= free) & (free <= high)).all()


def test_draw_pose__refuses_a_machine_that_is_always_in_the_ground():
    machine = replace(BROKK_170, ground=50.0)
    with pytest.raises(ValueError, match="brokk170: expected a pose above the ground, got none"):
        episodes.draw_pose(machine, TaskConfig(), generator(), 3)


def test_draw_goal__has_the_configured_fractions_speeds_and_directions():
    config = TaskConfig(zero_goals=0.2, axis_goals=0.5)
    goals = episodes.draw_goal(BROKK_170, config, generator(6), 20_000)
    speed = np.linalg.norm(goals, axis=-1)
    components = np.count_nonzero(goals, axis=-1)
    for number, fraction in ((0, 0.2), (1, 0.5), (3, 0.3)):
        assert np.mean(components == number) == pytest.approx(fraction, abs=0.02)
    assert speed.max() <= 0.3 + 1e-12
    assert stats.kstest(speed[components > 0] / 0.3, "uniform").pvalue > 1e-3
    along = np.sign(goals[components == 1])
    for axis in (*np.eye(3), *-np.eye(3)):
        assert np.mean((along == axis).all(-1)) == pytest.approx(1 / 6, abs=0.02)
    directions = goals[components == 3] / speed[components == 3, None]
    np.testing.assert_allclose(directions.mean(axis=0), 0, atol=0.03)
    np.testing.assert_allclose(
        directions.T @ directions / len(directions), np.eye(3) / 3, atol=0.03
    )


@pytest.mark.parametrize(
    ("seconds", "ticks"), [(0.0, 1), (0.06, 1), (0.12, 2), (0.13, 3), (0.5, 10)]
)
def test_draw_hold__is_whole_ticks_and_at_least_one(seconds, ticks):
    config = TaskConfig(hold_min_s=seconds, hold_max_s=seconds)
    assert episodes.draw_hold(BROKK_170, config, generator(), 3).tolist() == [ticks] * 3


@pytest.mark.parametrize(
    ("margin", "goal_z", "changes"), [(0.9, -0.2, True), (1.1, -0.2, False), (0.9, 0.0, False)]
)
def test_new_goals__none_points_down_close_to_the_ground(margin, goal_z, changes):
    pose = np.array([[0.3, 0.2, 0.3, 1.4, 1.1]])
    height = float(lowest_point(forward_kinematics(BROKK_170, pose))[0])
    machine = replace(BROKK_170, ground=height - margin * episodes.GROUND_MARGIN)
    config = TaskConfig(hold_min_s=5.0, hold_max_s=5.0)
    state = env.initial_state(machine, pose, [[0.1, 0.0, goal_z]], plant=True)
    for seed in range(20):
        after = episodes.new_goals(machine, config, state, generator(seed))
        assert (after.v_goal != state.v_goal).any() == changes
        assert (after.v_goal[0, 2] >= 0) == (margin < 1)
        assert not changes or after.goal_ticks[0] == 100
        paper = replace(config, paper=True)
        assert episodes.new_goals(machine, paper, state, generator(seed)) is state


def test_new_goals__change_where_their_time_is_over():
    state = episodes.reset(BROKK_170, TaskConfig(), generator(), 3, plant=False)
    upward = np.abs(state.v_goal) + 0.01
    state = replace(state, v_goal=upward, goal_ticks=np.array([1, 0, 2]))
    after = episodes.new_goals(BROKK_170, TaskConfig(), state, generator())
    assert (after.v_goal != state.v_goal).any(axis=1).tolist() == [False, True, False]
    assert after.goal_ticks[[0, 2]].tolist() == [1, 2]
    assert 10 <= after.goal_ticks[1] <= 60


@pytest.mark.parametrize("plant", [True, False])
def test_replace_rows__replaces_whole_rows_and_nothing_else(plant):
    old = episodes.reset(BROKK_170, TaskConfig(), generator(1), 5, plant)
    new = episodes.reset(BROKK_170, TaskConfig(), generator(2), 2, plant)
    state = episodes.replace_rows(old, np.array([4, 1]), new)
    for field in fields(env.State):
        before, fresh, after = (getattr(s, field.name) for s in (old, new, state))
        if isinstance(before, PlantState):
            before, fresh, after = before.q, fresh.q, after.q
        if before is not None:
            assert np.array_equal(after[[0, 2, 3]], before[[0, 2, 3]])
            assert np.array_equal(after[[4, 1]], fresh)
    assert not np.array_equal(old.q, state.q)
    if plant:
        own = replace(old, plant=object())
        with pytest.raises(ValueError, match=r"^plant: expected states that are tuples of"):
            episodes.replace_rows(own, np.array([4, 1]), new)


def test_get_obs__noise_is_uniform_and_only_on_what_sensors_measure():
    state = episodes.reset(BROKK_170, TaskConfig(), generator(), 400, plant=False)
    quiet = episodes.get_obs(BROKK_170, TaskConfig(noise=0.0), state, generator())
    noisy = episodes.get_obs(BROKK_170, TaskConfig(noise=0.05), state, generator())
    difference = noisy - quiet
    assert not difference[:, 111:163].any()  # commands
    assert not difference[:, 2].any()  # height of the goal; x and y turn with the slew angle
    history = difference[:, 7:111] / 0.05 * 13**0.5
    assert np.abs(history).max() <= 1 + 1e-3
    assert stats.kstest((history[:, 5] + 1) / 2, "uniform").pvalue > 1e-3
    paper = episodes.get_obs(BROKK_170, TaskConfig(paper=True), state, generator())
    np.testing.assert_allclose(paper[:, 7:111], noisy[:, 7:111] * 13**0.5, rtol=1e-5)
