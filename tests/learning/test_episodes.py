"""Episodes: distributions of poses, goals and noise."""

import numpy as np
import pytest
from helpers_machines import closed_form
from numpy.random import default_rng
from scipy import stats

from brokk_min.env import TaskConfig, observation_table
from brokk_min.learning import episodes
from brokk_min.machine import BROKK_170


def test_draw_pose__is_uniform_and_sometimes_in_the_ground():
    low, high = BROKK_170.column("q_min"), BROKK_170.column("q_max")
    poses = episodes.draw_pose(BROKK_170, default_rng(0), 2000)
    for fraction in ((poses - low) / (high - low)).T:
        assert stats.kstest(fraction, "uniform").pvalue > 1e-3
    assert 0.02 < (closed_form(poses)[1] < 0).mean() < 0.98


def test_draw_goal__has_the_configured_fractions_speeds_and_directions():
    config = TaskConfig(zero_goals=0.2, axis_goals=0.5)
    goals = episodes.draw_goal(BROKK_170, config, default_rng(6), 20_000)
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
    moments = directions.T @ directions / len(directions)
    np.testing.assert_allclose(moments, np.eye(3) / 3, atol=0.03)


@pytest.mark.parametrize(
    ("seconds", "ticks"), [(0.0, 1), (0.06, 1), (0.12, 2), (0.13, 3), (0.5, 10)]
)
def test_draw_hold__is_whole_ticks_and_at_least_one(seconds, ticks):
    config = TaskConfig(hold_min_s=seconds, hold_max_s=seconds)
    assert episodes.draw_hold(BROKK_170, config, default_rng(0), 3).tolist() == [ticks] * 3


def test_draw_noise__is_uniform_up_to_the_largest():
    noise = episodes.draw_noise(BROKK_170, 0.05, 400, default_rng(0))
    assert noise.dtype == np.float32 and noise.shape == (400, observation_table(BROKK_170)[2].sum())
    assert np.abs(noise).max() <= 0.05
    assert stats.kstest(noise[:, 7] / 0.1 + 0.5, "uniform").pvalue > 1e-3
