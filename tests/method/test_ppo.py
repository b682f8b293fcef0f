"""PPO: each function against another way to compute it, training bit for bit, and its refusals."""

from __future__ import annotations

import copy
import csv
import errno
import inspect
import io
import json
import os
import subprocess
import sys
import types
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import torch
from helpers_machines import obedient_net, small_net
from torch import nn

from brokk_min import ppo
from brokk_min.__main__ import main
from brokk_min.env import TaskConfig, action_to_pwm, look
from brokk_min.identification import files
from brokk_min.identification.net_file import save_net
from brokk_min.learning.gym_env import TaskVectorEnv
from brokk_min.learning.policy import load_policy
from brokk_min.machine import BROKK_170
from brokk_min.ppo import Agent, PPOConfig, Training, gae, train

TINY = PPOConfig(
    num_envs=8,
    horizon=8,
    epochs=2,
    minibatch_size=32,
    total_steps=4 * 64,
    checkpoint_every=2,
    threads=1,
)
CRITIC = replace(TINY, critic=True)
TASK = TaskConfig(episode_s=0.6)  # 12 ticks: time runs out within the first updates
NET = small_net(BROKK_170, np.random.default_rng(0))

# --- advantages -----------------------------------------------------------------------------------


def episodes(seed, ticks=12, num=6):
    """Random rewards and values in which episodes end both ways, some at the very last tick."""
    rng = np.random.default_rng(seed)
    terminated = rng.random((ticks, num)) < 0.15
    truncated = (rng.random((ticks, num)) < 0.15) & ~terminated
    terminated[-1, 0], truncated[-1, 0] = True, False
    terminated[-1, 1], truncated[-1, 1] = False, True
    return SimpleNamespace(
        rewards=rng.normal(size=(ticks, num)),
        values=rng.normal(size=(ticks + 1, num)),  # of what the policy acts on; the last: after all
        final=rng.normal(size=(ticks, num)),  # of an episode's own last observation
        terminated=terminated,
        truncated=truncated,
    )


def lambda_return_advantages(e, gamma, lam):
    """Forward, quadratic: all n-step returns under the weights (1 - lambda) lambda^(n-1)."""
    ticks, num = e.rewards.shape
    advantages = np.zeros((ticks, num))
    for i in range(num):
        for t in range(ticks):
            total, collected, weight = 0.0, 0.0, 1.0
            for n, k in enumerate(range(t, ticks), 1):
                collected += gamma ** (n - 1) * e.rewards[k, i]
                if e.terminated[k, i]:
                    rest = 0.0
                elif e.truncated[k, i]:
                    rest = e.final[k, i]
                else:
                    rest = e.values[k + 1, i]
                n_step = collected + gamma**n * rest
                if e.terminated[k, i] or e.truncated[k, i] or k == ticks - 1:
                    total += weight * n_step
                    break
                total += (1 - lam) * weight * n_step
                weight *= lam
            advantages[t, i] = total - e.values[t, i]
    return advantages


def right_arguments(e):
    following = np.where(e.terminated, 0.0, np.where(e.truncated, e.final, e.values[1:]))
    return {
        "rewards": e.rewards,
        "values": e.values[:-1],
        "next_values": following,
        "ended": (e.terminated | e.truncated).astype(float),
    }


def advantages_of(arguments, gamma, lam):
    tensors = {name: torch.tensor(array) for name, array in arguments.items()}
    return gae(**tensors, gamma=gamma, gae_lambda=lam).numpy()


@pytest.mark.parametrize("gamma", [0.0, 0.9, 1.0])
@pytest.mark.parametrize("lam", [0.0, 0.7, 1.0])
@pytest.mark.parametrize("seed", range(4))
def test_gae_is_the_mean_of_n_step_returns(gamma, lam, seed):
    e = episodes(seed)
    found = advantages_of(right_arguments(e), gamma, lam)
    np.testing.assert_allclose(found, lambda_return_advantages(e, gamma, lam), atol=1e-10)


def test_gae_by_hand():
    """Three ticks, gamma 0.5, lambda 0.5: going on; truncated in the middle; terminated there."""
    rewards = torch.tensor([[1.0, 1.0, 1.0], [2.0, 2.0, 2.0], [4.0, 4.0, 4.0]])
    values = torch.tensor([[2.0, 2.0, 2.0], [1.0, 1.0, 1.0], [3.0, 3.0, 3.0]])
    following = torch.tensor([[1.0, 1.0, 1.0], [3.0, 6.0, 0.0], [2.0, 2.0, 2.0]])
    ended = torch.tensor([[0.0, 0.0, 0.0], [0.0, 1.0, 1.0], [0.0, 0.0, 0.0]])
    # deltas: -0.5; 2.5 / 4 / 1; 2.  Then A_t = delta_t + 0.25 (1 - ended) A_(t+1)
    wanted = [[-0.5 + 0.25 * 3.0, -0.5 + 0.25 * 4.0, -0.5 + 0.25 * 1.0], [3.0, 4.0, 1.0], [2.0] * 3]
    assert gae(rewards, values, following, ended, 0.5, 0.5).tolist() == wanted


def no_bootstrap_at_truncation(e):
    return right_arguments(e) | {
        "next_values": np.where(e.terminated | e.truncated, 0.0, e.values[1:])
    }


def value_of_the_reset_observation(e):
    return right_arguments(e) | {"next_values": np.where(e.terminated, 0.0, e.values[1:])}


def value_before_the_step(e):
    wrong = np.where(e.truncated, e.values[:-1], right_arguments(e)["next_values"])
    return right_arguments(e) | {"next_values": wrong}


def bootstrap_at_termination(e):
    return right_arguments(e) | {"next_values": np.where(e.truncated, e.final, e.values[1:])}


def truncation_runs_on(e):
    return right_arguments(e) | {"ended": e.terminated.astype(float)}


def termination_runs_on(e):
    return right_arguments(e) | {"ended": e.truncated.astype(float)}


def ends_a_tick_late(e):
    ended = right_arguments(e)["ended"]
    return right_arguments(e) | {"ended": np.concatenate([0 * ended[:1], ended[:-1]])}


@pytest.mark.parametrize(
    "planted",
    [
        no_bootstrap_at_truncation,
        value_of_the_reset_observation,
        value_before_the_step,
        bootstrap_at_termination,
        truncation_runs_on,
        termination_runs_on,
        ends_a_tick_late,
    ],
    ids=lambda f: f.__name__,
)
def test_the_oracle_sees_planted_errors(planted):
    """The comparison above would fail for each of the usual mistakes."""
    e = episodes(0)
    wanted = lambda_return_advantages(e, 0.9, 0.7)
    assert np.abs(advantages_of(planted(e), 0.9, 0.7) - wanted).max() > 0.05


# --- probabilities and losses ---------------------------------------------------------------------


def test_log_probability_is_that_of_torch():
    generator = torch.Generator().manual_seed(0)
    action, mean = (2 * torch.randn(7, 5, 4, generator=generator) for _ in range(2))
    log_std = torch.randn(4, generator=generator)
    wanted = torch.distributions.Normal(mean, log_std.exp()).log_prob(action).sum(-1)
    torch.testing.assert_close(ppo.log_probability(action, mean, log_std), wanted)


def test_log_probability_by_hand():
    found = ppo.log_probability(torch.tensor([1.0, 3.0]), torch.ones(2), torch.zeros(2))
    assert float(found) == pytest.approx(-2.0 - np.log(2 * np.pi))
    half = ppo.log_probability(
        torch.tensor([2.0]), torch.tensor([1.0]), torch.log(torch.tensor([0.5]))
    )
    assert float(half) == pytest.approx(-2.0 + np.log(2) - 0.5 * np.log(2 * np.pi))


@pytest.mark.parametrize(
    ("ratio", "advantage", "loss", "slope"),
    [
        (1.5, 2.0, -2.4, 0.0),  # has gained enough: the clip at 1.2 holds, no push
        (1.5, -2.0, 3.0, 3.0),  # a bad action made likelier: full push back
        (0.5, 2.0, -1.0, -1.0),  # a good action made rarer: full push
        (0.5, -2.0, 1.6, 0.0),  # rare enough: the clip at 0.8 holds
        (1.1, 2.0, -2.2, -2.2),
        (0.9, -2.0, 1.8, 1.8),
    ],
)
def test_policy_loss_by_hand(ratio, advantage, loss, slope):
    new = torch.tensor([np.log(ratio) - 0.7], dtype=torch.float64, requires_grad=True)
    old = torch.tensor([-0.7], dtype=torch.float64)
    found = ppo.policy_loss(new, old, torch.tensor([advantage], dtype=torch.float64), 0.2)
    found.backward()
    assert found.item() == pytest.approx(loss)
    assert float(new.grad) == pytest.approx(slope, abs=1e-12)


def test_policy_loss_is_the_mean():
    new, old = torch.log(torch.tensor([1.5, 0.5, 1.0, 1.0])), torch.zeros(4)
    found = ppo.policy_loss(new, old, torch.tensor([1.0, 1.0, 4.0, -1.0]), 0.2)
    assert float(found) == pytest.approx(-(1.2 + 0.5 + 4.0 - 1.0) / 4)


def test_normalise():
    np.testing.assert_allclose(ppo.normalise(torch.tensor([1.0, 2.0, 3.0])), [-1, 0, 1], atol=1e-6)
    wild = 50 + 7 * torch.randn(999, generator=torch.Generator().manual_seed(1))
    flat = ppo.normalise(wild)
    assert abs(float(flat.mean())) < 1e-5
    assert float(flat.std()) == pytest.approx(1, abs=1e-5)
    assert torch.equal(torch.argsort(flat), torch.argsort(wild))
    assert torch.isfinite(ppo.normalise(torch.full((5,), 3.0))).all()


def test_the_nets_are_those_of_the_paper():
    agent = Agent(171, 4, -0.5)
    for part, outputs in ((agent.actor, 4), (agent.critic, 1)):
        kinds = [type(layer) for layer in part]
        assert kinds == [nn.Linear, nn.ELU] * 3 + [nn.Linear]
        sizes = [(layer.in_features, layer.out_features) for layer in part[::2]]
        assert sizes == [(171, 256), (256, 128), (128, 64), (64, outputs)]
        assert all(layer.alpha == 1.0 for layer in part[1::2])
        assert not any(layer.bias.any() for layer in part[::2])
    shared = set(map(id, agent.actor.parameters())) & set(map(id, agent.critic.parameters()))
    assert not shared
    w = agent.actor[0].weight.detach()  # orthogonal columns of length sqrt(2)
    torch.testing.assert_close(w.T @ w, 2 * torch.eye(171), atol=1e-4, rtol=0)
    assert agent.log_std.tolist() == [-0.5] * 4
    assert [name for name, _ in agent.named_parameters() if "." not in name] == [
        "log_std"
    ]  # is learned
    x = torch.randn(3, 171, generator=torch.Generator().manual_seed(0))
    assert agent.actor(x).abs().max() < 0.2  # hardly moves at first
    torch.testing.assert_close(agent.value(x), agent.critic(x).squeeze(-1))


# --- what is collected ----------------------------------------------------------------------------


class Script:
    """An environment that plays a tape: each observation is one number."""

    config, state = TaskConfig(), None

    def __init__(self, e):
        self.e, self.tick = e, 0
        self.single_observation_space = gymnasium.spaces.Box(-9, 9, (1,), np.float32)
        self.single_action_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)

    def reset(self, seed=None):
        return self.e.values[0][:, None].astype(np.float32), {}

    def step(self, actions):
        e, t = self.e, self.tick
        self.tick += 1
        ended = e.terminated[t] | e.truncated[t]
        seen = e.values[t + 1][:, None].astype(np.float32)
        info = {"velocity_error": np.zeros(len(seen))}
        if ended.any():
            final = np.where(ended, e.final[t], e.values[t + 1])[:, None]
            info |= {"final_obs": final.astype(np.float32), "_final_obs": ended}
        return seen, e.rewards[t], e.terminated[t], e.truncated[t], info


class Echo(nn.Module):
    """A critic whose value is the observation."""

    def forward(self, x):
        return x


@pytest.mark.parametrize("seed", range(3))
def test_collected_advantages_use_the_right_last_observations(seed):
    """A critic that echoes a scripted environment: values, and so advantages, are known."""
    e = episodes(seed)
    config = replace(CRITIC, num_envs=6, horizon=12, gamma=0.9, gae_lambda=0.7)
    training = Training(Script(e), config, seed=0)
    training.agent.critic = Echo()
    batch, _ = training._collect()
    scaled = SimpleNamespace(**vars(e))
    scaled.rewards = (1 - 0.9) * e.rewards  # values are in units of the mean reward
    wanted = lambda_return_advantages(scaled, 0.9, 0.7)
    np.testing.assert_allclose(batch["advantage"].view(12, 6), wanted, atol=1e-5)
    np.testing.assert_allclose(batch["return"].view(12, 6), wanted + e.values[:-1], atol=1e-5)
    np.testing.assert_allclose(batch["observation"].view(12, 6), e.values[:-1], atol=1e-6)
    np.testing.assert_allclose(training.observation[:, 0], e.values[-1], atol=1e-6)


def test_the_critic_is_asked_about_final_observations_of_truncations():
    """In the real environment: a spy on the critic sees `final_obs` where time ran out."""
    training = Training(TaskVectorEnv(8, NET, BROKK_170, TASK), replace(CRITIC, horizon=13), seed=1)
    asked, given = [], []
    value, step = training.agent.value, training.env.step
    training.agent.value = lambda x: (asked.append(x.clone()), value(x))[1]

    def spy(actions):
        result = step(actions)
        if "final_obs" in result[-1]:
            given.append(torch.from_numpy(result[-1]["final_obs"][result[3]].copy()))
        return result

    training.env.step = spy
    training._collect()
    rows = torch.cat([x.reshape(-1, x.shape[-1]) for x in asked])
    assert sum(map(len, given)) >= 8
    for final in torch.cat(given):
        assert (rows == final).all(-1).any()


def test_without_a_critic_an_action_is_judged_by_its_slope(monkeypatch):
    """Slope times what noise added to the command the valves got; slopes are of the right rollout."""
    training = Training(
        TaskVectorEnv(8, NET, BROKK_170, TASK), replace(TINY, horizon=13, log_std=-0.5), 1
    )
    training.agent.actor[-1].bias.data += torch.tensor([1.1, -0.9, 0.3, 0.0])  # beyond the limit
    slopes = np.random.default_rng(0).standard_normal((13, 8, 4)).astype(np.float32)
    asked, begun, over, step = [], [], [], training.env.step

    def spy(actions):
        begun.append(training.env.state)
        result = step(actions)
        over.append(result[2] | result[3])
        return result

    training.env.step = spy
    given = vars(ppo)  # of the module under test, which may be a mutant
    monkeypatch.setitem(given, "action_gradients", lambda *a: (asked.append(a), slopes)[1])
    batch, scalars = training._collect()
    with torch.no_grad():
        mean = training.agent.actor(batch["observation"])
    deviation = batch["action"].clamp(-1, 1) - mean.clamp(-1, 1)
    wanted = (torch.from_numpy(slopes).flatten(0, 1) * deviation).sum(-1)
    torch.testing.assert_close(batch["advantage"], wanted, atol=1e-5, rtol=1e-5)
    assert (
        (mean.abs() > 1).any()
        and "return" not in batch
        and "losses/explained_variance" not in scalars
    )
    (machine, net, rollout, gamma, task), *none = asked
    assert (machine, net.joints, gamma, task) == (BROKK_170, NET.joints, TINY.gamma, TASK)
    assert not none and np.any(over)
    for name in ("q", "motion", "v_goal", "lag"):
        np.testing.assert_array_equal(getattr(rollout, name), [getattr(s, name) for s in begun])
    commands = action_to_pwm(BROKK_170, batch["action"].view(13, 8, 4).numpy())
    np.testing.assert_array_equal(rollout.u, commands)
    np.testing.assert_array_equal(rollout.ended, over)


def test_without_a_critic_the_deviation_falls_in_a_line():
    training = Training(
        TaskVectorEnv(8, NET, BROKK_170, TASK), replace(TINY, log_std=-1.2, log_std_end=-2.2), 1
    )
    found = []
    for _ in range(4):
        training.update()
        found.append(training.agent.log_std.tolist())
    np.testing.assert_allclose(found, np.tile([[-1.2], [-1.45], [-1.7], [-1.95]], 4), atol=1e-6)


def test_episodes_of_a_training_end_one_after_the_other(tmp_path, monkeypatch):
    env = TaskVectorEnv(8, NET, BROKK_170, TaskConfig(episode_s=2.0))
    env.reset(seed=0)
    ppo.out_of_step(env)
    over = np.array([env.step(np.zeros((8, 4)))[3] for _ in range(80)])
    assert over.sum() == 16 and over.sum(axis=1).max() == 1 and (over.sum(axis=0) == 2).all()
    assert np.diff(np.flatnonzero(over.any(axis=1))).tolist() == [5] * 15
    called = []
    monkeypatch.setattr(ppo, "out_of_step", lambda env: called.append(env.state.ticks.max()))
    train(BROKK_170, NET, TASK, TINY, 0, tmp_path / "policy.npz")
    assert called == [0]


def test_without_a_learning_rate_nothing_changes():
    """Old and new probabilities then agree: what is stored is what the policy did."""
    training = Training(
        TaskVectorEnv(8, NET, BROKK_170, TASK), replace(CRITIC, learning_rate=0.0), 2
    )
    before = [p.detach().clone() for p in training.agent.parameters()]
    scalars = training.update()
    assert all(map(torch.equal, before, training.agent.parameters()))
    assert scalars["losses/approx_kl"] == pytest.approx(0, abs=1e-5)
    assert scalars["losses/clipfrac"] == 0
    assert scalars["losses/policy_loss"] == pytest.approx(0, abs=1e-4)
    entropy = 4 * (TINY.log_std + 0.5 * np.log(2 * np.pi * np.e))
    assert scalars["losses/entropy"] == pytest.approx(entropy, rel=1e-5)


def learning_rates(target_kl):
    config = replace(TINY, target_kl=target_kl)
    training = Training(TaskVectorEnv(8, NET, BROKK_170, TASK), config, 2)
    rates = [training.update()["charts/learning_rate"] for _ in range(4)]
    assert training.steps == TINY.total_steps
    return np.array(rates) / TINY.learning_rate


def test_the_learning_rate_falls_in_a_line_while_the_policy_changes_little():
    np.testing.assert_allclose(learning_rates(1e6), [1, 0.75, 0.5, 0.25])


def test_the_learning_rate_is_lowered_while_the_policy_changes_too_much():
    np.testing.assert_allclose(learning_rates(1e-9) * 1.2 ** np.arange(4), [1, 0.75, 0.5, 0.25])


class Bandit:
    """One tick an episode: the reward falls with the distance of the action from a target."""

    config, state, target = TaskConfig(), None, np.array([0.6, -0.4], np.float32)

    def __init__(self, num):
        self.num = num
        self.single_observation_space = gymnasium.spaces.Box(-9, 9, (3,), np.float32)
        self.single_action_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)

    def reset(self, seed=None):
        return np.ones((self.num, 3), np.float32), {}

    def step(self, actions):
        error = np.linalg.norm(actions - self.target, axis=-1)
        ends, never = np.ones(self.num, bool), np.zeros(self.num, bool)
        seen = np.ones((self.num, 3), np.float32)
        info = {"velocity_error": error, "final_obs": seen, "_final_obs": ends}
        return seen, 1 / (1 + error), ends, never, info


def test_a_bandit_is_learned():
    config = PPOConfig(
        num_envs=64,
        horizon=8,
        epochs=4,
        minibatch_size=128,
        total_steps=30 * 512,
        learning_rate=1e-3,
        log_std=-0.7,
        critic=True,
        threads=1,
    )
    training = Training(Bandit(64), config, seed=0)
    scalars = [training.update() for _ in range(30)]
    with torch.no_grad():
        mean = training.agent.actor(torch.ones(3)).numpy()
        value = float(training.agent.value(torch.ones(3)))
    np.testing.assert_allclose(mean, Bandit.target, atol=0.1)
    late = np.mean([s["charts/reward"] for s in scalars[-5:]])
    assert late > scalars[0]["charts/reward"] + 0.1
    # every episode ends after one tick: the value is that tick's reward, scaled
    assert value == pytest.approx(late * (1 - config.gamma), abs=0.01)


def test_the_task_is_learned_a_little():
    """On nets that obey at once, some thousand steps already beat the start."""
    config = replace(
        TINY,
        num_envs=64,
        horizon=16,
        epochs=4,
        minibatch_size=256,
        total_steps=25 * 1024,
        gamma=0.5,
        learning_rate=2e-3,
        target_kl=1.0,
        log_std=-2.0,
    )
    env = TaskVectorEnv(64, obedient_net(BROKK_170), BROKK_170, TaskConfig(episode_s=5.0))
    training = Training(env, config, seed=0)
    errors = [training.update()["charts/velocity_error"] for _ in range(25)]
    assert np.mean(errors[-4:]) < 0.85 * np.mean(errors[:2]), errors


@pytest.mark.parametrize("entropy", [0.0, 0.3])
def test_learning_is_adam_on_the_losses_of_the_paper(entropy):
    """One pass, written once more with torch's own normal distribution, on the same minibatches."""
    config = replace(CRITIC, epochs=1, minibatch_size=16, entropy=entropy, max_grad_norm=0.5)
    config = replace(config, target_kl=1e9)
    training = Training(Bandit(8), config, seed=0)
    batch, _ = training._collect()
    batch["advantage"] = 3 + 5 * batch["advantage"]
    batch["log_probability"] = batch["log_probability"] + torch.linspace(-0.5, 0.5, 64)
    agent = copy.deepcopy(training.agent)
    optimizer = torch.optim.Adam(agent.parameters(), lr=config.learning_rate)
    generator = torch.Generator()
    generator.set_state(training.generator.get_state())
    training._learn(batch)
    for rows in torch.split(torch.randperm(64, generator=generator), 16):
        part = {name: tensor[rows] for name, tensor in batch.items()}
        normal = torch.distributions.Normal(agent.actor(part["observation"]), agent.log_std.exp())
        ratio = (normal.log_prob(part["action"]).sum(-1) - part["log_probability"]).exp()
        a = part["advantage"]
        a = (a - a.mean()) / a.std()
        earned = torch.where(a > 0, ratio.clamp(max=1.2), ratio.clamp(min=0.8)) * a
        missed = (agent.critic(part["observation"])[:, 0] - part["return"]) ** 2
        loss = missed.mean() - earned.mean() - entropy * normal.entropy().sum(-1).mean()
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
        optimizer.step()
    pairs = zip(training.agent.parameters(), agent.parameters(), strict=True)
    for found, wanted in pairs:
        torch.testing.assert_close(found, wanted, atol=2e-5, rtol=0)


def test_actions_vary_as_the_policy_says():
    training = Training(Bandit(512), replace(CRITIC, num_envs=512, log_std=-2.0), seed=0)
    with torch.no_grad():
        batch, _ = training._collect()
        z = (batch["action"] - training.agent.actor(batch["observation"])) / np.exp(-2.0)
    assert float(z.std()) == pytest.approx(1, abs=0.05)
    assert abs(float(z.mean())) < 0.05


# --- planted errors ---------------------------------------------------------------------------------


def gae_is_right():
    test_gae_is_the_mean_of_n_step_returns(0.9, 0.7, 0)


def advantages_are_right():
    test_collected_advantages_use_the_right_last_observations(0)


def actions_are_judged_by_their_slopes():
    with pytest.MonkeyPatch.context() as patch:
        test_without_a_critic_an_action_is_judged_by_its_slope(patch)


def loss_is_right():
    for case in (
        (1.5, 2.0, -2.4, 0.0),
        (1.5, -2.0, 3.0, 3.0),
        (0.5, 2.0, -1.0, -1.0),
        (0.5, -2.0, 1.6, 0.0),
    ):
        test_policy_loss_by_hand(*case)


def learning_is_right():
    test_learning_is_adam_on_the_losses_of_the_paper(0.3)


PLANTED = (
    (
        "ended[t] = torch.from_numpy(over)",
        "ended[t] = torch.from_numpy(terminated)",
        advantages_are_right,
    ),
    ("elif truncated.any():", "elif False:", advantages_are_right),
    ('info["final_obs"][truncated]', "following[truncated]", advantages_are_right),
    ('info["final_obs"][truncated]', "observations[t].numpy()[truncated]", advantages_are_right),
    ("torch.where(ended > 0, tails, following)", "following", advantages_are_right),
    ("self.agent.value(self.observation)[None]", "values[-1:]", advantages_are_right),
    ("values[1:], self.agent", "values[:-1], self.agent", advantages_are_right),
    ("rewards * (1 - c.gamma)", "rewards", advantages_are_right),
    (
        "actions.clamp(-1, 1) - means.clamp(-1, 1)",
        "actions - means",
        actions_are_judged_by_their_slopes,
    ),
    ("actions.clamp(-1, 1) - means", "means - actions", actions_are_judged_by_their_slopes),
    ("* deviation).sum(-1)", "* deviation).mean(-1)", actions_are_judged_by_their_slopes),
    ("state.lag, u, over", "state.lag, u, terminated", actions_are_judged_by_their_slopes),
    ('"return": advantages + values', '"return": advantages', advantages_are_right),
    (
        "delta = rewards + gamma * next_values - values",
        "delta = rewards + next_values - values",
        gae_is_right,
    ),
    ("gamma * gae_lambda * (1 - ended[t])", "gamma * gae_lambda", gae_is_right),
    ("gamma * gae_lambda * (1", "gamma * (1", gae_is_right),
    ("gamma * gae_lambda * (1", "gae_lambda * (1", gae_is_right),
    ("torch.exp(new - old)\n", "torch.exp(old - new)\n", loss_is_right),
    ("return -torch.min(", "return torch.min(", loss_is_right),
    ("-torch.min(", "-torch.max(", loss_is_right),
    (
        "-torch.min(ratio * advantages, clipped",
        "-torch.min(clipped * advantages, clipped",
        loss_is_right,
    ),
    (
        "-torch.min(ratio * advantages, clipped",
        "-torch.min(ratio * advantages, ratio",
        loss_is_right,
    ),
    ("1 - clip, 1 + clip", "1 - clip, 1 - clip", loss_is_right),
    (" - log_std.sum() - 0.5", " - 0.5", lambda: test_log_probability_is_that_of_torch()),
    (
        " - log_std.sum() - 0.5",
        " + log_std.sum() - 0.5",
        lambda: test_log_probability_is_that_of_torch(),
    ),
    (" * torch.exp(-log_std)", "", lambda: test_log_probability_is_that_of_torch()),
    (" * torch.exp(-log_std)", "", learning_is_right),
    (" - log_std.sum() - 0.5", " - 0.5", learning_is_right),
    ('normalise(part["advantage"])', 'part["advantage"]', learning_is_right),
    ("(advantages - advantages.mean()) /", "advantages /", lambda: test_normalise()),
    (" / (advantages.std() + 1e-8)", "", lambda: test_normalise()),
    ("found[0] + found[1]", "found[0] - found[1]", learning_is_right),
    ("- c.entropy * found[2]", "+ c.entropy * found[2]", learning_is_right),
    (
        "entropy = agent.log_std.sum() + 0.5",
        "entropy = -agent.log_std.sum() + 0.5",
        learning_is_right,
    ),
    ("self.optimizer.zero_grad()", "pass", learning_is_right),
    ("nn.utils.clip_grad_norm_(agent.parameters(), c.max_grad_norm)", "pass", learning_is_right),
    ('part["return"]) ** 2', 'part["advantage"]) ** 2', learning_is_right),
    (
        "nn.Parameter(torch.full((actions,), log_std))",
        "torch.full((actions,), log_std)",
        lambda: test_the_nets_are_those_of_the_paper(),
    ),
    ("means[t] + std * noise", "means[t] + noise", lambda: test_actions_vary_as_the_policy_says()),
    (
        "1 / 1.2 if change > 1.5 else 1.2",
        "1.2 if change > 1.5 else 1 / 1.2",
        lambda: test_the_learning_rate_is_lowered_while_the_policy_changes_too_much(),
    ),
    ("nn.ELU(inplace=True)", "nn.ReLU()", lambda: test_the_nets_are_those_of_the_paper()),
)


@pytest.mark.parametrize(
    ("right", "wrong", "check"), PLANTED, ids=[f"{a} -> {b}"[:60] for a, b, _ in PLANTED]
)
def test_planted_errors_are_caught_by_an_assertion(right, wrong, check, monkeypatch):
    source = inspect.getsource(ppo)
    assert source.count(right) == 1
    mutant = types.ModuleType(ppo.__name__)
    exec(source.replace(right, wrong), mutant.__dict__)
    check()  # right as it is
    for name, value in {"ppo": mutant, **vars(mutant)}.items():
        if name in ("ppo", "gae", "Agent", "Training"):
            monkeypatch.setitem(globals(), name, value)
    with pytest.raises(AssertionError):
        check()


# --- the same bits --------------------------------------------------------------------------------


def weights_of(training):
    return [p.detach().clone() for p in training.agent.parameters()]


def learner(seed=3, config=TINY):
    return Training(TaskVectorEnv(config.num_envs, NET, BROKK_170, TASK), config, seed)


def test_the_same_seed_gives_the_same_bits_whatever_torch_drew_before():
    runs = []
    for noise in (1, 2):
        torch.manual_seed(noise)
        np.random.seed(noise)  # noqa: NPY002
        training = learner()
        curve = [training.update() for _ in range(2)]
        runs.append((weights_of(training), curve, torch.rand(1)))
    assert all(map(torch.equal, runs[0][0], runs[1][0]))
    assert runs[0][1] == runs[1][1]
    assert runs[0][2] != runs[1][2]  # and leaves torch's own generator alone
    other = learner(seed=4)
    other.update()
    assert not torch.equal(runs[0][0][0], weights_of(other)[0])


@pytest.mark.parametrize("config", [TINY, CRITIC], ids=["adjoint", "critic"])
def test_a_checkpoint_goes_on_to_the_same_bits(tmp_path, config):
    straight, first, second = (learner(config=config) for _ in range(3))
    straight_curve = [straight.update() for _ in range(4)]
    curve = [first.update() for _ in range(2)]
    first.save(tmp_path / "c", {"seed": 3})
    second.update()  # whatever state it is in, loading replaces it
    second.load(tmp_path / "c", {"seed": 3})
    assert second.steps == 128
    curve += [second.update() for _ in range(2)]
    assert all(map(torch.equal, weights_of(straight), weights_of(second)))
    assert curve == straight_curve
    assert torch.equal(straight.observation, second.observation)
    assert np.array_equal(straight.env.state.q, second.env.state.q)
    assert np.array_equal(straight.env.state.lag, second.env.state.lag)
    first.update(), first.update()  # saving disturbs nothing
    assert all(map(torch.equal, weights_of(straight), weights_of(first)))


def test_a_checkpoint_keeps_the_whole_state_of_the_environments(tmp_path):
    first, second = learner(), learner(seed=4)
    first.update()
    first.save(tmp_path / "c", {})
    second.load(tmp_path / "c", {})
    assert first.env.state.lag.any(axis=-1).all()  # no episode ended yet: every tool lags behind
    for name in ("q", "q_dot", "history", "v_goal", "goal_ticks", "ticks", "lag"):
        saved, loaded = (getattr(training.env.state, name) for training in (first, second))
        assert np.array_equal(saved, loaded), name
        assert saved.dtype == loaded.dtype, name


def stop_after(monkeypatch, updates, error=KeyboardInterrupt):
    original, count = Training.update, [0]

    def update(self):
        count[0] += 1
        if count[0] > updates:
            raise error
        return original(self)

    monkeypatch.setattr(Training, "update", update)


def run(path, resume=False, seed=5, config=TINY, net=NET, task=TASK, machine=BROKK_170):
    return train(machine, net, task, config, seed, path, resume)


def table(path):
    with open(f"{path}.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    return [{k: v for k, v in row.items() if k != "charts/SPS"} for row in rows]


@pytest.mark.parametrize("updates", [0, 1, 2, 3])
def test_a_killed_training_is_taken_up_to_the_same_bytes(tmp_path, monkeypatch, updates):
    run(tmp_path / "straight.npz")
    with monkeypatch.context() as patch:
        stop_after(patch, updates)
        with pytest.raises(KeyboardInterrupt):
            run(tmp_path / "killed.npz")
    assert not (tmp_path / "killed.npz").exists()
    assert (tmp_path / "killed.npz.checkpoint").exists() == (updates >= 2)
    run(tmp_path / "killed.npz", resume=True)
    straight, killed = tmp_path / "straight.npz", tmp_path / "killed.npz"
    assert straight.read_bytes() == killed.read_bytes()
    assert table(straight) == table(killed)
    assert not (tmp_path / "killed.npz.checkpoint").exists()
    assert sorted(p.name for p in tmp_path.iterdir() if "killed" in p.name) == [
        "killed.npz",
        "killed.npz.csv",
    ]


@pytest.mark.parametrize("config", [TINY, CRITIC], ids=["adjoint", "critic"])
def test_what_train_writes_can_be_driven_and_read(tmp_path, config):
    policy = run(tmp_path / "p.npz", config=config)
    again = load_policy(tmp_path / "p.npz", BROKK_170)
    assert all(map(np.array_equal, policy.weights, again.weights))
    assert again.training["seed"] == 5
    assert again.training["settings"]["horizon"] == 8
    assert again.training["task"]["episode_s"] == 0.6
    with open(tmp_path / "p.npz.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["global_step"]) for row in rows] == [64, 128, 192, 256]
    wanted = {"global_step", "charts/reward", "charts/velocity_error", "charts/learning_rate"}
    wanted |= {
        "charts/SPS",
        "losses/policy_loss",
        "losses/entropy",
        "losses/approx_kl",
        "losses/clipfrac",
    }
    wanted |= {"charts/episodic_return", "charts/episodic_length"}
    of_critic = {"losses/value_loss", "losses/explained_variance"}
    assert set(rows[0]) == wanted | (of_critic if config.critic else set())
    assert all(0 < float(row["charts/reward"]) <= 1 for row in rows)
    assert all(np.isfinite(float(value)) for row in rows for value in row.values())


@pytest.fixture
def killed(tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        stop_after(patch, 3)
        with pytest.raises(KeyboardInterrupt):
            run(tmp_path / "p.npz")
    return tmp_path / "p.npz"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": 6}, r"seed: expected 6, got 5"),
        ({"machine": replace(BROKK_170, dead_zone=0.05)}, r"dead_zone: expected 0\.05, got 0\.07"),
        ({"machine": replace(BROKK_170, pwm_limit=60)}, r"pwm_limit: expected 60, got 80"),
        ({"config": replace(TINY, gamma=0.5)}, r"settings: expected .*'gamma': 0\.5.*got .*gamma"),
        ({"task": TaskConfig(episode_s=0.7)}, r"task: expected .*0\.7.*, got .*0\.6"),
        (
            {"net": small_net(BROKK_170, np.random.default_rng(1))},
            r"actuator: expected '\w+', got '\w+'",
        ),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_a_checkpoint_of_another_training_is_refused(killed, change, message):
    kept = killed.with_name("p.npz.checkpoint").read_bytes()
    with pytest.raises(ValueError, match=r"p\.npz\.checkpoint: " + message):
        run(killed, resume=True, **change)
    assert killed.with_name("p.npz.checkpoint").read_bytes() == kept


def test_a_net_that_differs_in_its_scales_alone_is_another_training(killed):
    """Weights are not all of a net: other output bounds are another simulation."""
    with pytest.raises(ValueError, match="actuator: expected"):
        run(killed, resume=True, net=replace(NET, output_high=2 * NET.output_high))


def test_a_broken_checkpoint_is_refused(killed):
    checkpoint = killed.with_name("p.npz.checkpoint")
    data = checkpoint.read_bytes()
    checkpoint.write_bytes(data[: len(data) // 2])
    with pytest.raises(ValueError, match=r"checkpoint: expected a readable \.npz file, got"):
        run(killed, resume=True)


def test_a_policy_is_no_checkpoint(tmp_path):
    run(tmp_path / "p.npz")
    (tmp_path / "q.npz.checkpoint").write_bytes((tmp_path / "p.npz").read_bytes())
    message = r"q\.npz\.checkpoint: expected \(checkpoint, format \d+\), got \('policy'"
    with pytest.raises(ValueError, match=message):
        run(tmp_path / "q.npz", resume=True)


def test_a_lost_learning_curve_is_no_traceback(killed):
    """The curve beside the checkpoint is gone: go on without it, or say what is wanted."""
    killed.with_name("p.npz.csv").unlink()
    try:
        run(killed, resume=True)
    except ValueError as error:
        assert "p.npz.csv" in str(error)
    else:
        assert table(killed)[-1]["global_step"] == "256"


def test_without_resume_a_checkpoint_is_not_overwritten(killed):
    before = Path(f"{killed}.checkpoint").read_bytes()
    with pytest.raises(
        ValueError, match=r"checkpoint: expected --resume or no checkpoint, got one"
    ):
        run(killed, resume=False)
    assert Path(f"{killed}.checkpoint").read_bytes() == before and not killed.exists()


def test_a_loss_that_is_no_number_stops_and_keeps_the_checkpoint(tmp_path, monkeypatch):
    original, calls = ppo.policy_loss, [0]

    def poisoned(*arguments):
        calls[0] += 1
        return original(*arguments) * (np.nan if calls[0] == 3 * 4 + 1 else 1.0)  # the 4th update

    with monkeypatch.context() as patch:
        patch.setattr(ppo, "policy_loss", poisoned)
        message = r"losses/\w+: expected a finite number at step \d+, got nan"
        with pytest.raises(ValueError, match=message):
            run(tmp_path / "p.npz")
    assert not (tmp_path / "p.npz").exists()
    run(tmp_path / "p.npz", resume=True)  # from update 2, before the accident
    run(tmp_path / "straight.npz")
    assert (tmp_path / "p.npz").read_bytes() == (tmp_path / "straight.npz").read_bytes()


@pytest.mark.parametrize(
    ("where", "message"),
    [
        ("observation", r"observation\[5, 7\]: expected a finite number at step 152, got nan"),
        ("final_obs", r"final_obs\[0, 7\]: expected a finite number at step 88, got nan"),
        ("reward", r"reward\[5\]: expected a finite number at step 144, got -inf"),
        ("action", r"action\[0, 2\]: expected a finite number at step 128, got -?inf"),
        ("weight", r"actor\.6\.bias\[2\]: expected a finite number at step 192, got nan"),
    ],
)
def test_what_is_no_number_stops_with_its_place_and_keeps_the_checkpoint(
    tmp_path, monkeypatch, where, message
):
    """In the third of four updates (`final_obs`: the second, when time runs out)."""
    step, learn, ticks = TaskVectorEnv.step, Training._learn, [0]

    def poisoned_step(self, actions):
        ticks[0] += 1
        seen, reward, terminated, truncated, info = step(self, actions)
        if ticks[0] == 19 and where == "observation":
            seen[5, 7] = np.nan
        if ticks[0] == 19 and where == "reward":
            reward[5] = -np.inf
        if ticks[0] == 12 and where == "final_obs":
            info["final_obs"][np.argmax(truncated), 7] = np.nan
        return seen, reward, terminated, truncated, info

    def poisoned_learn(self, batch):
        result = learn(self, batch)
        with torch.no_grad():
            if where == "action" and self.updates == 1:
                self.agent.log_std[2] = 100.0  # a number still, but its exponential is none
            if where == "weight" and self.updates == 2:
                self.agent.actor[-1].bias[2] = np.nan
        return result

    config = replace(TINY, checkpoint_every=1, critic=where in ("final_obs", "action"))
    with monkeypatch.context() as patch:
        patch.setattr(TaskVectorEnv, "step", poisoned_step)
        patch.setattr(Training, "_learn", poisoned_learn)
        with pytest.raises(ValueError, match=message):
            run(tmp_path / "p.npz", config=config)
    assert not (tmp_path / "p.npz").exists()
    if where != "action":
        run(tmp_path / "p.npz", resume=True, config=config)
        run(tmp_path / "straight.npz", config=config)
        assert (tmp_path / "p.npz").read_bytes() == (tmp_path / "straight.npz").read_bytes()


def fill_the_disk(monkeypatch, kept):
    """Files after the first `kept` find room for 100,000 bytes and then none, as on a full disk."""

    class Full(io.FileIO):
        def write(self, data):
            if self.tell() + len(data) > 100_000:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            return super().write(data)

    opened, fdopen = [0], os.fdopen

    def open_file(handle, mode, **options):
        opened[0] += 1
        if opened[0] <= kept or "b" not in mode:
            return fdopen(handle, mode, **options)
        return io.BufferedWriter(Full(handle, "w"))

    monkeypatch.setattr(files.os, "fdopen", open_file)


@pytest.mark.parametrize(("kept", "file"), [(3, "p.npz.checkpoint"), (5, "p.npz")])
def test_a_full_disk_is_named_and_the_checkpoint_is_kept(tmp_path, monkeypatch, kept, file):
    """Curve and checkpoint after updates 2 and 4, curve and policy at the end: six files."""
    with monkeypatch.context() as patch:
        fill_the_disk(patch, kept)
        with pytest.raises(OSError, match=rf"No space left on device: '.*/{file}'"):
            run(tmp_path / "p.npz")
    found = sorted(path.name for path in tmp_path.iterdir())
    assert found == ["p.npz.checkpoint", "p.npz.csv"]  # and nothing half written
    run(tmp_path / "p.npz", resume=True)
    run(tmp_path / "straight.npz")
    assert (tmp_path / "p.npz").read_bytes() == (tmp_path / "straight.npz").read_bytes()


def command(folder, *options):
    """Arguments of a small training on the net in `folder`."""
    small = {"num_envs": 8, "horizon": 8, "epochs": 2, "minibatch_size": 32, "total_steps": 512}
    small |= {"checkpoint_every": 1, "threads": 1, "episode_s": 0.6}
    pairs = [
        text
        for name, value in small.items()
        for text in (f"--{name.replace('_', '-')}", str(value))
    ]
    return [
        "train",
        "--actuator",
        f"{folder}/net.npz",
        "--out",
        f"{folder}/p.npz",
        *pairs,
        *options,
    ]


def test_the_command_line_says_which_file_found_no_room(tmp_path, monkeypatch, capsys):
    save_net(tmp_path / "net.npz", NET)
    fill_the_disk(monkeypatch, 0)
    assert main(command(tmp_path)) == 1
    said = capsys.readouterr().err.splitlines()[-1]
    assert said == f"brokk-min: [Errno 28] No space left on device: '{tmp_path}/p.npz.checkpoint'"


def test_a_directory_that_may_only_be_read_is_refused_before_any_work(
    tmp_path, monkeypatch, capsys
):
    save_net(tmp_path / "net.npz", NET)
    os.chmod(tmp_path, 0o500)
    access = os.access  # root may write everywhere: the answer that others get
    monkeypatch.setattr(os, "access", lambda path, mode: mode != os.W_OK and access(path, mode))
    assert main(command(tmp_path)) == 2
    assert "p.npz: expected a file in an existing, writable directory" in capsys.readouterr().err
    os.chmod(tmp_path, 0o700)
    assert [path.name for path in tmp_path.iterdir()] == ["net.npz"]


def rewrite(path, header, drop=()):
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files if name not in drop}
    text = json.loads(str(arrays["header"])) | header
    with open(path, "wb") as file:
        np.savez(file, **(arrays | {"header": np.array(json.dumps(text))}))


@pytest.mark.parametrize(
    ("header", "drop", "message"),
    [
        ({"format": 0}, (), r"expected \(checkpoint, format 2\), got \('checkpoint', 0\)"),
        ({}, ("env_lag",), r"expected a complete checkpoint, got KeyError\('env_lag'\)"),
        ({}, ("exp_avg_3",), r"expected a complete checkpoint, got KeyError\('exp_avg_3'\)"),
        ({"random": {}}, (), r"expected a complete checkpoint, got "),
    ],
)
def test_a_checkpoint_of_an_older_format_or_with_holes_is_refused(killed, header, drop, message):
    rewrite(f"{killed}.checkpoint", header, drop)
    with pytest.raises(ValueError, match=r"p\.npz\.checkpoint: " + message):
        run(killed, resume=True)


KILLER = """
import json, os, signal, sys, time, torch
from brokk_min import ppo
from brokk_min.__main__ import main
curve = sys.argv[2] + ".csv"
torch.set_num_threads(1)
torch.optim.Adam([torch.nn.Parameter(torch.ones(1))], fused=True)  # all that is imported late, once
for seconds in json.loads(sys.argv[1]):  # a fresh process each, killed from outside
    child = os.fork()
    if not child:
        os._exit(main(sys.argv[3:]))
    time.sleep(seconds)
    os.kill(child, signal.SIGKILL)
    if os.WIFSIGNALED(os.waitpid(child, 0)[1]):
        print(len(open(curve).readlines()) if os.path.exists(curve) else 0)
    else:
        os.unlink(sys.argv[2])  # it came to its end before: once more from the beginning
"""


@pytest.mark.slow
def test_twenty_kills_at_random_moments_end_in_the_same_bytes(tmp_path):
    """SIGKILL of a real process, while it starts, collects, learns or writes; then one to the end."""
    straight, killed = tmp_path / "straight", tmp_path / "killed"
    for folder in (straight, killed):
        folder.mkdir()
        save_net(folder / "net.npz", NET)
    more = ["--total-steps", str(64 * 400)]
    moments = np.random.default_rng(0).uniform(0, 1.5, 30).tolist()
    arguments = [sys.executable, "-c", KILLER, json.dumps(moments), str(killed / "p.npz")]
    done = subprocess.run(
        [*arguments, *command(killed, *more, "--resume")], capture_output=True, text=True
    )
    taken_up = [int(line) for line in done.stdout.splitlines() if line.isdigit()]
    assert done.returncode == 0 and len(taken_up) >= 20, done.stderr
    assert len(set(taken_up)) >= 10  # kills while it went forward, not while it started
    assert main(command(killed, *more, "--resume")) == main(command(straight, *more)) == 0
    assert (straight / "p.npz").read_bytes() == (killed / "p.npz").read_bytes()
    assert table(straight / "p.npz") == table(killed / "p.npz")


def test_a_plant_is_not_what_policies_are_trained_on():
    """A checkpoint or policy of the analytic plant would say nothing of the simulation."""
    env = TaskVectorEnv(8, "analytic", BROKK_170, TASK)
    with pytest.raises(ValueError, match="actuator: expected a policy trained on nets, got"):
        Training(env, CRITIC, 0).policy({})
    with pytest.raises(
        ValueError, match="actuator: expected nets, whose derivatives are known, got the ana"
    ):
        Training(env, TINY, 0).update()


def test_a_policy_of_the_papers_observation_runs_on_every_observation(tmp_path):
    """Trained on a part of what `observe` gives, it acts the same on all of it, after a file too."""
    task = replace(TASK, paper=True)
    run(tmp_path / "p.npz", task=task)
    policy = load_policy(tmp_path / "p.npz", BROKK_170)
    assert policy.training["task"]["paper"] is True
    training = Training(TaskVectorEnv(8, NET, BROKK_170, task), TINY, 3)
    for _ in range(3):
        training.update()
    policy, seen = training.policy({}), training.observation
    full = look(BROKK_170, TASK, training.env.state, np.random.default_rng(7))
    part = look(BROKK_170, task, training.env.state, np.random.default_rng(7))
    with torch.no_grad():
        wanted = training.agent.actor(torch.from_numpy(part)).numpy()
    assert np.abs(wanted).max() > 1e-3 and part.shape == full.shape == seen.shape
    np.testing.assert_allclose(policy.act(full), wanted, atol=1e-6)
    rates = full.copy()
    rates[:, -8:] += 1.0
    assert np.array_equal(policy.act(rates), policy.act(full))  # blind to them


def test_a_net_for_another_machine_is_refused(tmp_path):
    other = small_net(replace(BROKK_170, history=9), np.random.default_rng(0))
    with pytest.raises(ValueError, match=r"actuator: expected nets for brokk170.*'history': 9"):
        run(tmp_path / "p.npz", net=other)
