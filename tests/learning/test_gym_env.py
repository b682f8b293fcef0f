"""The Gymnasium environments: resets in the same step, final observations, registration."""

import warnings
from dataclasses import fields, replace

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from helpers_machines import closed_form, obedient_net, small_net

from brokk_min.env import TaskConfig
from brokk_min.identification.net_file import save_net
from brokk_min.learning.gym_env import TaskEnv, TaskVectorEnv
from brokk_min.machine import BROKK_170

LOW = replace(BROKK_170, ground=-100.0)  # no pose is in the ground
SHORT = TaskConfig(episode_s=1.0, noise=0.0)
NET = small_net(BROKK_170, np.random.default_rng(0))
ID = "brokk_min.learning.gym_env:brokk_min/Brokk170-v0"


def rows_of(state, rows):
    """Rows of all arrays of a state without a plant."""
    names = [field.name for field in fields(state) if field.name != "plant"]
    return np.concatenate([getattr(state, name)[rows].ravel() for name in names])


@pytest.mark.parametrize("net", ["analytic", obedient_net(LOW)], ids=["plant", "nets"])
def test_step__resets_only_the_rows_that_ended_and_gives_their_last_observation(net):
    """A twin with longer episodes goes on: its observation is the other one's `final_obs`."""
    short = TaskVectorEnv(4, net, LOW, TaskConfig(episode_s=1.0))
    long = TaskVectorEnv(4, net, LOW, TaskConfig(episode_s=9.0))
    obs, _ = short.reset(seed=5)
    twin_obs, _ = long.reset(seed=5)
    short.state = replace(short.state, ticks=np.array([3, 0, 3, 0]))
    rng = np.random.default_rng(18)
    for tick in range(1, 18):
        assert np.array_equal(obs, twin_obs)
        action = rng.uniform(-1, 1, (4, 4)).astype(np.float32)
        before = short.state
        obs, reward, terminated, truncated, info = short.step(action)
        twin_obs, twin_reward, *_, twin_info = long.step(action)
        assert np.array_equal(reward, twin_reward)  # the last tick is rewarded as any other
        assert np.array_equal(info["velocity_error"], twin_info["velocity_error"])
        assert info["state"] is before
        assert not terminated.any()
        assert truncated.tolist() == [tick == 17, False] * 2
        assert ("final_obs" in info) == (tick == 17)
    assert info["_final_obs"].tolist() == [True, False] * 2
    assert np.array_equal(info["final_obs"], twin_obs)
    assert np.array_equal(obs[[1, 3]], twin_obs[[1, 3]])
    assert np.abs(obs - twin_obs)[[0, 2]].max(axis=1).min() > 1e-3
    assert short.state.ticks.tolist() == [0, 17] * 2
    np.testing.assert_array_equal(short.state.q[[1, 3]], long.state.q[[1, 3]])


def test_step__leaks_nothing_between_rows():
    config = TaskConfig(episode_s=60.0, hold_min_s=60, hold_max_s=60)
    left = TaskVectorEnv(6, NET, LOW, config)
    right = TaskVectorEnv(6, NET, LOW, config)
    left.reset(seed=13)
    right.reset(seed=13)
    others = [0, 1, 3, 4, 5]
    rng = np.random.default_rng(15)
    for _ in range(30):
        action = rng.uniform(-1, 1, (6, 4)).astype(np.float32)
        changed = action.copy()
        changed[2] = -changed[2]
        obs, reward, *_ = left.step(action)
        obs_right, reward_right, *_ = right.step(changed)
        assert np.array_equal(rows_of(left.state, others), rows_of(right.state, others))
        assert np.array_equal(obs[others], obs_right[others])
        assert np.array_equal(reward[others], reward_right[others])
    assert not np.array_equal(rows_of(left.state, [2]), rows_of(right.state, [2]))


@pytest.mark.parametrize("ticks", [20.0, 1.0])
def test_step__a_pose_in_the_ground_terminates_without_reward(ticks):
    """Termination and truncation are never both, also in the tick of the time limit."""
    config = TaskConfig(redraw_ground=False, episode_s=ticks / 20)
    env = TaskVectorEnv(400, config=config)
    env.reset(seed=7)
    buried = closed_form(env.state.q)[1] < 0
    assert 8 < buried.sum() < 392
    _, reward, terminated, truncated, info = env.step(np.zeros((400, 4), np.float32))
    assert np.array_equal(terminated, buried)
    assert np.array_equal(truncated, ~buried & (ticks == 1))
    assert not reward[buried].any()
    assert (reward[~buried] > 0).all()
    assert np.array_equal(info["_final_obs"], terminated | truncated)


def test_step__of_the_paper_terminates_for_a_start_in_the_ground_alone():
    """An arm that is moved into the ground goes on; one that starts there ends, unrewarded."""
    env = TaskVectorEnv(400, config=TaskConfig(paper=True))
    env.reset(seed=7)
    buried = closed_form(env.state.q)[1] < 0
    _, reward, terminated, *_ = env.step(np.zeros((400, 4), np.float32))
    assert np.array_equal(terminated, buried)
    assert not reward[buried].any()
    started = env.state.ticks == 0
    for _ in range(40):
        below = env.state.lowest < BROKK_170.ground
        _, reward, terminated, _, _ = env.step(np.full((400, 4), -1.0, np.float32))
        assert np.array_equal(terminated, started & below)
        started = terminated
    assert (below & ~terminated).any() and (reward[below & ~terminated] > 0).all()


def test_task_env__is_one_row_of_the_vector():
    one = TaskEnv(NET, LOW, SHORT)
    many = TaskVectorEnv(1, NET, LOW, SHORT)
    obs, _ = one.reset(seed=3)
    rows, _ = many.reset(seed=3)
    assert np.array_equal(obs, rows[0])
    for _ in range(19):
        obs, *results, info = one.step(np.full(4, 0.3))
        rows, *vectors, infos = many.step(np.full((1, 4), 0.3))
        assert np.array_equal(obs, rows[0])
        assert results == [vector[0] for vector in vectors]
        assert [type(result) for result in results] == [float, bool, bool]
        assert info == {"velocity_error": infos["velocity_error"][0]}
    for _ in range(2):  # the caller resets
        *_, truncated, _ = one.step(np.full(4, 0.3))
        assert truncated


@pytest.mark.parametrize("make", [lambda: TaskVectorEnv(2), TaskEnv], ids=["vector", "single"])
def test_step__refuses_to_begin_without_a_reset(make):
    with pytest.raises(ValueError, match="step: expected a reset before the first step, got none"):
        make().step(np.zeros((2, 4), np.float32))


def test_task_vector_env__takes_a_file_and_selects_driven_joints(tmp_path):
    net = small_net(BROKK_170, np.random.default_rng(0), joints=BROKK_170.names)
    save_net(tmp_path / "net.npz", net)
    for file in (tmp_path / "net.npz", str(tmp_path / "net.npz")):
        assert TaskVectorEnv(1, file).net.joints == ("q1", "q3", "q4", "q5")
    assert TaskVectorEnv(1).net is None


def test_make__gives_an_environment_that_gymnasium_and_stable_baselines_accept():
    from stable_baselines3.common.env_checker import check_env as check_sb3

    env = gymnasium.make(ID)
    assert isinstance(env.unwrapped, TaskEnv)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*Box observation space.*infinity.*")
        check_env(env.unwrapped, skip_render_check=True)
    check_sb3(env.unwrapped)
    assert env.observation_space.shape == (223,)
    assert env.action_space == gymnasium.spaces.Box(-1, 1, (4,), np.float32)


def test_make_vec__gives_the_vector_class():
    env = gymnasium.make_vec(ID, num_envs=256, config=SHORT)
    assert isinstance(env.unwrapped, TaskVectorEnv)
    assert env.unwrapped.config == SHORT
    assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    obs, _ = env.reset(seed=0)
    assert env.observation_space.contains(obs)
    assert len(np.unique(obs[:, 7])) > 200  # different poses
    obs, *vectors, info = env.step(env.action_space.sample())
    assert env.observation_space.contains(obs)
    assert {vector.shape for vector in (*vectors, info["velocity_error"])} == {(256,)}
