"""The Gymnasium environments: resets in the same step, final observations, registration."""

import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from helpers_machines import LOW, obedient_net, small_net

from brokk_min.actuator import PLANT
from brokk_min.beyond.interface import INTERFACE
from brokk_min.env import PAPER, TaskConfig
from brokk_min.learning.gym_env import TaskEnv, TaskVectorEnv

SIX_TICKS = TaskConfig(episode_s=0.3)
NET = small_net(LOW, np.random.default_rng(0))
ID = "brokk_min.learning.gym_env:brokk_min/Brokk170-v0"


def set_ticks(env, ticks):
    """Ticks since the resets of its machines."""
    state = env.episodes.state._replace(ticks=ticks)
    env.episodes = env.episodes._replace(state=state)


@pytest.mark.parametrize("interface", [PAPER, INTERFACE], ids=["paper", "beyond"])
@pytest.mark.parametrize("plant", [PLANT, obedient_net(LOW)], ids=["plant", "nets"])
def test_step__resets_only_the_rows_that_ended_and_gives_their_last_observation(plant, interface):
    """A twin with longer episodes goes on: its observation is the other one's `final_obs`."""
    short = TaskVectorEnv(4, plant, LOW, TaskConfig(episode_s=1.0), interface)
    long = TaskVectorEnv(4, plant, LOW, TaskConfig(episode_s=9.0), interface)
    obs, _ = short.reset(seed=5)
    twin_obs, _ = long.reset(seed=5)
    set_ticks(short, np.array([3, 0, 3, 0]))
    rng = np.random.default_rng(18)
    for tick in range(1, 18):
        assert np.array_equal(obs, twin_obs)
        action = rng.uniform(-1, 1, (4, 4)).astype(np.float32)
        obs, rewards, terminated, truncated, info = short.step(action)
        twin_obs, twin_rewards, *_, twin_info = long.step(action)
        assert np.array_equal(rewards, twin_rewards)  # the last tick is rewarded as any other
        assert np.array_equal(info["velocity_error"], twin_info["velocity_error"])
        assert not terminated.any()
        assert truncated.tolist() == [tick == 17, False] * 2
        assert ("final_obs" in info) == (tick == 17)
    assert info["_final_obs"].tolist() == [True, False] * 2
    assert np.array_equal(info["final_obs"], twin_obs)
    assert np.array_equal(obs[[1, 3]], twin_obs[[1, 3]])
    assert np.abs(obs - twin_obs)[[0, 2]].max(axis=1).min() > 1e-3
    assert short.episodes.state.ticks.tolist() == [0, 17] * 2
    if interface is INTERFACE:  # a new episode forgets the error of the old one
        assert not short.episodes.memory.error_integral[[0, 2]].any()
        assert short.episodes.memory.error_integral[[1, 3]].any(axis=1).all()


def test_step__leaks_nothing_between_rows():
    config = TaskConfig(hold_min_s=60, hold_max_s=60)
    left, right = (TaskVectorEnv(6, NET, LOW, config, INTERFACE) for _ in range(2))
    left.reset(seed=13)
    right.reset(seed=13)
    others = [0, 1, 3, 4, 5]
    rng = np.random.default_rng(15)
    for _ in range(30):
        action = rng.uniform(-1, 1, (6, 4)).astype(np.float32)
        changed = action.copy()
        changed[2] = -changed[2]
        obs, rewards, *_ = left.step(action)
        obs_right, rewards_right, *_ = right.step(changed)
        assert np.array_equal(obs[others], obs_right[others])
        assert np.array_equal(rewards[others], rewards_right[others])
    assert not np.array_equal(left.episodes.state.q[2], right.episodes.state.q[2])


def test_step__subtracts_the_costs_of_the_interface_from_eq2():
    env = TaskVectorEnv(5, NET, LOW, TaskConfig(noise=0.0), INTERFACE)
    env.reset(seed=1)
    rng = np.random.default_rng(2)
    for _ in range(3):
        v_goal, before = env.episodes.state.v_goal, env.episodes.state.history[..., 2, -1]
        _, rewards, *_, info = env.step(rng.uniform(-1, 1, (5, 4)))
        u = env.episodes.state.history[..., 2, -1]
        error = np.linalg.norm(v_goal - env.episodes.state.v_tool, axis=-1)
        np.testing.assert_allclose(info["velocity_error"], error, rtol=1e-6)
        expected = 1 / (1 + error) - INTERFACE.cost(LOW, u, before, env.episodes.memory)
        np.testing.assert_allclose(rewards, expected, atol=1e-6)


def test_step__says_where_the_goal_is_a_new_one():
    env = TaskVectorEnv(50, NET, LOW, TaskConfig(hold_min_s=0.1, hold_max_s=0.4, zero_goals=0))
    env.reset(seed=0)
    changes = []
    for _ in range(10):
        before = env.episodes.state.v_goal
        info = env.step(np.zeros((50, 4)))[4]
        assert np.array_equal(info["new_goal"], (env.episodes.state.v_goal != before).any(axis=1))
        changes.append(info["new_goal"].mean())
    assert 0.1 < np.mean(changes) < 0.4


@pytest.mark.parametrize("wrapper", ["DictInfoToList", "RecordEpisodeStatistics"])
def test_wrappers__of_gymnasium_accept_the_vector(wrapper):
    env = gymnasium.make_vec(ID, num_envs=3, max_episode_steps=2)
    env = getattr(gymnasium.wrappers.vector, wrapper)(env)
    env.reset(seed=0)
    for _ in range(3):
        *_, infos = env.step(env.action_space.sample())
    info = infos[0] if wrapper == "DictInfoToList" else {n: v[0] for n, v in infos.items()}
    assert 0 <= info["velocity_error"] < 1


def test_step__before_the_reset_is_refused():
    with pytest.raises(ValueError, match="step: expected a reset before the first step, got none"):
        TaskVectorEnv(2).step(np.zeros((2, 4), np.float32))


def test_make__gives_an_environment_that_gymnasium_and_stable_baselines_accept():
    """Its picture changes with the machine."""
    from stable_baselines3.common.env_checker import check_env as check_sb3

    env = gymnasium.make(ID, render_mode="rgb_array")
    assert isinstance(env.unwrapped, TaskEnv)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*Box observation space.*infinity.*")
        check_env(env.unwrapped, skip_render_check=True)
    check_sb3(env.unwrapped)
    assert env.observation_space.shape == (163,)
    assert env.action_space == gymnasium.spaces.Box(-1, 1, (4,), np.float32)
    env.reset(seed=0)
    first = env.render()
    for _ in range(20):
        env.step(np.ones(4))
    assert (env.render() != first).any()


def test_make_vec__gives_the_vector_class():
    with pytest.raises(ValueError, match="max_episode_steps: expected 1 or more, got 0"):
        gymnasium.make_vec(ID, num_envs=2, max_episode_steps=0)
    with pytest.raises(ValueError, match="num_envs: expected 1 or more, got 0"):
        gymnasium.make_vec(ID, num_envs=0)
    env = gymnasium.make_vec(ID, num_envs=256, max_episode_steps=6)
    assert isinstance(env.unwrapped, TaskVectorEnv)
    assert env.unwrapped.task.config == SIX_TICKS
    assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    obs, _ = env.reset(seed=0)
    assert env.observation_space.contains(obs)
    assert len(np.unique(obs[:, 7])) > 200  # different poses
    obs, *vectors, info = env.step(env.action_space.sample())
    assert {vector.shape for vector in (*vectors, info["velocity_error"])} == {(256,)}
