"""Groups of rollouts: what a group shares, where windows end, and advantages by hand."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers_machines import LOW, obedient_net

from brokk_min import ppo
from brokk_min.beyond.group_advantages import COPIES, GroupVectorEnv, group_advantages
from brokk_min.beyond.interface import INTERFACE
from brokk_min.env import PAPER
from brokk_min.learning.gym_env import TaskVectorEnv
from brokk_min.settings import PPOConfig, TaskConfig

TASK = TaskConfig(episode_s=1.5, hold_min_s=0.1, hold_max_s=0.4)  # 30 ticks
WINDOW = 7


def make(interface=PAPER, machine=LOW, num=12):
    env = GroupVectorEnv(
        TaskVectorEnv(num, obedient_net(machine), machine, TASK, interface), WINDOW
    )
    env.reset(seed=3)
    return env


def groups(array):
    return np.asarray(array).reshape(-1, COPIES, *np.shape(array)[1:])


def same(array):
    """Is each group's row the same for all of it?"""
    return (groups(array) == groups(array)[:, :1]).all()


@pytest.mark.parametrize("interface", [PAPER, INTERFACE], ids=["paper", "beyond"])
def test_copies__share_all_but_what_their_own_actions_change(interface):
    """They start alike in each window, meet the same goals and noise, and end alike."""
    env, rng = make(interface), np.random.default_rng(0)
    obs, _ = env.reset(seed=4)
    ended = 0
    for tick in range(70):
        if tick % WINDOW == 0:
            assert (
                same(obs)
                and same(env.inner.episodes.state.q)
                and same(env.inner.episodes.state.plant.history)
            )
            alike = tick % 2 == 0  # windows in which the actions of a group are the same, or not
        actions = rng.uniform(-1, 1, (12, 4)).astype(np.float32)
        obs, reward, terminated, truncated, _ = env.step(
            groups(actions)[:, :1].repeat(COPIES, 1).reshape(12, 4) if alike else actions
        )
        assert (
            same(env.inner.episodes.state.v_goal)
            and same(env.inner.episodes.state.goal_ticks)
            and same(env.inner.episodes.state.ticks)
        )
        assert same(reward) and same(obs) if alike else not same(reward)
        last = tick % WINDOW == WINDOW - 1
        assert (terminated | truncated).all() if last else same(truncated)
        ended += not last and truncated.any()
        goals = groups(env.inner.episodes.state.v_goal)[:, 0]
        assert len(np.unique(goals, axis=0)) == len(goals)  # of groups, they differ
    assert ended


@pytest.mark.parametrize("ticks", [0, 30 - WINDOW])
def test_window__ends_in_the_state_of_one_of_the_group_and_keeps_own_last_observations(ticks):
    """Where the first group's episodes end with the window, their last one is not of the next."""
    env, twin = make(), make()
    twin.horizon = 1000
    for each in (env.inner, twin.inner):
        each.episodes.state.ticks[:COPIES] = ticks
    for actions in np.random.default_rng(0).uniform(-1, 1, (WINDOW, 12, 4)):
        own, *_, last = twin.step(actions)
        obs, _, terminated, truncated, info = env.step(actions)
    assert truncated.all() and not terminated.any() and info["_final_obs"].all()
    expected = own.copy()
    if ticks:
        assert last["_final_obs"].tolist() == [True] * COPIES + [False] * 2 * COPIES
        expected[:COPIES] = last["final_obs"][:COPIES]
    assert np.array_equal(info["final_obs"], expected)
    assert np.array_equal(expected, own) == (ticks == 0)
    chosen = [
        np.flatnonzero((twin.inner.episodes.state.q == q).all(axis=1))
        for q in groups(env.inner.episodes.state.q)[:, 0]
    ]
    assert [row[0] // COPIES for row in chosen] == [0, 1, 2]
    assert np.array_equal(obs, np.repeat(own[[row[0] for row in chosen]], COPIES, axis=0))


def test_starts_in_the_ground__end_the_whole_group_without_reward():
    """The ground is so high that in the first tick some of a group's copies enter it."""
    actions, free = np.random.default_rng(1).uniform(-1, 1, (2000, 4)), make(num=2000)
    free.step(actions)
    machine = replace(LOW, name="high", ground=float(np.median(free.inner.episodes.state.lowest)))
    _, reward, terminated, truncated, _ = make(machine=machine, num=2000).step(actions)
    below = groups(free.inner.episodes.state.lowest < machine.ground)
    some = below.any(axis=1)
    assert (some & ~below.all(axis=1)).any()
    assert np.array_equal(groups(terminated), some[:, None].repeat(COPIES, axis=1))
    assert not reward[terminated].any() and reward[~terminated].all() and not truncated.any()


def test_groups__are_whole():
    with pytest.raises(ValueError, match=r"^num_envs: expected a multiple of 4, got 6$"):
        make(num=6)


def rollout_of(rewards, goal_ticks, dones=None):
    """A rollout whose only contents are rewards (T, N), ticks until a new goal, and ends."""
    rewards = torch.tensor(rewards)
    nothing = torch.zeros_like(rewards)
    dones = nothing.bool() if dones is None else torch.tensor(dones)
    infos = [{"new_goal": np.array(row) <= 1} for row in goal_ticks]
    return ppo.Rollout(nothing, nothing, nothing, rewards, dones, dones, nothing, infos)


def test_group_advantages__by_hand():
    """gamma 0.5: returns of the first machine 1 + 0.5 * 2 = 2 and 2, of the others 0; the mean 0.5.

    In the second group the goal changes after the first tick, so nothing of the second counts.
    """
    rewards = [[1.0, 0, 0, 0, 1, 0, 0, 0], [2.0, 0, 0, 0, 2, 0, 0, 0]]
    ticks = [[9] * 4 + [1] * 4, [9] * 8]
    config = PPOConfig(gamma=0.5, gae_lambda=1.0)
    advantages, returns = group_advantages(None, rollout_of(rewards, ticks), config)
    assert returns is None
    assert advantages[:, :4].tolist() == [[1.5, -0.5, -0.5, -0.5]] * 2
    assert advantages[0, 4:].tolist() == [0.75, -0.25, -0.25, -0.25]
    assert advantages[1, 4:].tolist() == [1.5, -0.5, -0.5, -0.5]
    dones = [[True] * 8, [False] * 8]
    cut, _ = group_advantages(None, rollout_of(rewards, [[9] * 8] * 2, dones), config)
    assert cut[0].tolist() == [0.75, -0.25, -0.25, -0.25] * 2


def test_group_advantages__are_cut_at_four_deviations():
    rewards = np.zeros((1, 4000), np.float32)
    rewards[0, 0] = 100.0
    advantages, _ = group_advantages(None, rollout_of(rewards, [[9] * 4000]), PPOConfig(gamma=0.0))
    free = np.zeros(4000, np.float32)
    free[:4] = 75, -25, -25, -25  # 4 deviations are 5.5
    limit = 4 * free.std(ddof=1)
    assert advantages[0].numpy() == pytest.approx(free.clip(-limit, limit), rel=1e-5)
