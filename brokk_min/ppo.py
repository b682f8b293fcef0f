"""Proximal Policy Optimization (Schulman et al., 2017) in one file, to be read from top to bottom.

It trains on any Gymnasium vector environment that resets in the same step. A truncated episode did
not fail: its return goes on with the value of its own last observation. At a termination it stops.
Advantages come from a critic, as in the paper; `train` takes another estimate and loss as well.
Names are CleanRL's, but num_steps is horizon; target_kl steers the learning rate. Paper: Sec. 3.4
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from torch import Tensor, nn

from brokk_min.machine import check_numbers, number


@dataclass(frozen=True)
class PPOConfig:
    """Settings of PPO with a critic, the paper's marked (D7). Ours: `episodes.GRADIENT_LEARNER`."""

    total_steps: int = number("steps", 1, 10**12, 6_000_000)  # Environment steps in all.
    num_envs: int = number("1", 1, 10**6, 256)  # Environments side by side (paper: 256).
    horizon: int = number("ticks", 1, 10**6, 32)  # Ticks of each environment between two updates.
    epochs: int = number("1", 1, 10**6, 2)  # Passes over the collected steps in each update.
    minibatch_size: int = number("steps", 2, 10**7, 2048)  # Steps in one gradient.
    learning_rate: float = number("1", 1e-9, 1, 1.2e-3)  # Of Adam, at most; falls to zero.
    target_kl: float = number("1", 1e-9, 1e9, 0.03)  # KL divergence that keeps the learning rate.
    gamma: float = number("1", 0, 0.9999, 0.9)  # Discount a tick: 0.9 looks 10 ticks ahead.
    gae_lambda: float = number("1", 0, 1, 0.95)  # Weight of longer returns in the advantage.
    clip: float = number("1", 1e-9, 1e9, 0.2)  # Largest rewarded change of a probability ratio.
    entropy: float = number("1", 0, 1000, 0.0)  # Coefficient of the entropy bonus.
    max_grad_norm: float = number("1", 1e-9, 1e9, 1.0)  # Gradients are scaled down to this norm.
    log_std: float = number("1", -10, 3, -1.2)  # Log of the actions' deviation at the start.
    log_std_end: float | None = number("1", -10, 3, None)  # At the end, linear; None: learned.
    checkpoint_every: int = number("updates", 1, 10**12, 50)  # Updates between two checkpoints.
    threads: int = number("1", 1, 10**6, 1)  # Of torch; several wait in vain on busy cores.
    __post_init__ = check_numbers  # type: ignore[misc]


def layer_init(layer: nn.Linear, std: float) -> nn.Linear:
    """Orthogonal weights with gain `std`, biases 0."""
    nn.init.orthogonal_(layer.weight, std)
    nn.init.zeros_(layer.bias)
    return layer


def mlp(inputs: int, outputs: int, std: float) -> nn.Sequential:
    """256-128-64 with ELU and a linear output. Paper: Sec. 3.4"""
    sizes = [inputs, 256, 128, 64]
    layers: list[nn.Module] = []
    for size_in, size_out in pairwise(sizes):
        layers.append(layer_init(nn.Linear(size_in, size_out), math.sqrt(2)))
        layers.append(nn.ELU(inplace=True))
    return nn.Sequential(*layers, layer_init(nn.Linear(sizes[-1], outputs), std))


class Agent(nn.Module):
    """Actor, logarithm of the actions' standard deviation and, if advantages need one, critic.

    value = mean + sqrt(var) critic(obs), by the mean and variance of the returns in each batch so
    far; rl_games' `normalize_value` pools them (compare PopArt, van Hasselt et al., 2016).
    """

    def __init__(self, obs: int, actions: int, log_std: float, critic: bool) -> None:
        super().__init__()
        self.actor = mlp(obs, actions, 0.01)
        self.log_std = nn.Parameter(torch.full((actions,), log_std))
        self.critic = mlp(obs, 1, 1.0) if critic else None
        self.returns: Any = nn.BatchNorm1d(1, momentum=None, affine=False)  # means of all batches

    def value(self, obs: Tensor) -> Tensor:
        """Value (...) of observations (..., obs), in units of the reward: (1 - gamma) * return."""
        assert self.critic is not None
        mean, var = self.returns.running_mean, self.returns.running_var
        value: Tensor = mean + var.sqrt() * self.critic(obs)[..., 0]
        return value


class Rollout(NamedTuple):
    """What one collection saw: tensors (T, num_envs, ...)."""

    obs: Tensor
    actions: Tensor
    means: Tensor  # of the action distribution
    logprobs: Tensor
    rewards: Tensor
    terminated: Tensor
    dones: Tensor  # terminated or truncated
    next_obs: Tensor  # where an episode ended: its own last observation
    infos: list[dict[str, Any]]  # of `env.step`, tick by tick


Estimate = Callable[[Agent, Rollout, PPOConfig], dict[str, Tensor]]  # what a loss needs
Loss = Callable[[Agent, dict[str, Tensor], PPOConfig], tuple[Tensor, Tensor]]  # as ppo_loss


def log_probability(actions: Tensor, mean: Tensor, log_std: Tensor) -> Tensor:
    """Log-density (...) of actions (..., a) under independent normal distributions."""
    z = (actions - mean) * torch.exp(-log_std)
    return -0.5 * (z * z).sum(-1) - log_std.sum() - 0.5 * actions.shape[-1] * math.log(2 * math.pi)


def gae(
    rewards: Tensor, values: Tensor, next_values: Tensor, dones: Tensor, gamma: float, lam: float
) -> Tensor:
    """Generalised advantage estimates (Schulman et al., 2016), all tensors of shape (T, N).

    delta_t = r_t + gamma V(s_{t+1}) - V(s_t);  A_t = delta_t + gamma lambda (1 - done_t) A_{t+1}.
    `values` are V(s_t), `next_values` V(s_{t+1}): 0 where the episode terminated, that of its own
    last observation where it was truncated. `dones` is 1 where it terminated or was truncated.

    Example:
        >>> one = torch.ones(2, 1)
        >>> gae(one, 0 * one, 0 * one, 0 * one, 0.5, 1.0).ravel().tolist()
        [1.5, 1.0]
    """
    delta = rewards + gamma * next_values - values
    advantages = torch.empty_like(delta)
    lastgaelam = torch.zeros_like(delta[0])
    for t in reversed(range(len(delta))):
        lastgaelam = delta[t] + gamma * lam * (1 - dones[t]) * lastgaelam
        advantages[t] = lastgaelam
    return advantages


@torch.no_grad()
def critic_advantages(agent: Agent, rollout: Rollout, config: PPOConfig) -> dict[str, Tensor]:
    """Advantages and returns (T, N) by the critic, as in the paper."""
    values = agent.value(rollout.obs)
    next_values = agent.value(rollout.next_obs) * ~rollout.terminated
    rewards = rollout.rewards * (1 - config.gamma)
    discount = config.gamma, config.gae_lambda
    advantages = gae(rewards, values, next_values, rollout.dones.float(), *discount)
    agent.returns((advantages + values).reshape(-1, 1))  # updates its statistics
    return {"advantages": advantages, "returns": advantages + values}


def policy_loss(ratio: Tensor, advantages: Tensor, clip: float) -> Tensor:
    """-E[min(ratio A, clip(ratio, 1 - eps, 1 + eps) A)] of ratios and advantages (B,)."""
    clipped = torch.clamp(ratio, 1 - clip, 1 + clip)
    return -torch.min(ratio * advantages, clipped * advantages).mean()


def ppo_loss(agent: Agent, mb: dict[str, Tensor], config: PPOConfig) -> tuple[Tensor, Tensor]:
    """Loss of a minibatch, and (5,) for the log: policy, value, entropy, KL, clip fraction."""
    newlogprob = log_probability(mb["actions"], agent.actor(mb["obs"]), agent.log_std)
    logratio = newlogprob - mb["logprobs"]
    ratio = logratio.exp()
    advantages = mb["advantages"]
    advantages = (advantages - advantages.mean()) / (advantages.std(correction=0) + 1e-8)
    pg_loss = policy_loss(ratio, advantages, config.clip)
    v_loss = torch.zeros(())
    if "returns" in mb:
        v_loss = ((agent.value(mb["obs"]) - mb["returns"]) ** 2 / agent.returns.running_var).mean()
    entropy = (agent.log_std + 0.5 * math.log(2 * math.pi * math.e)).sum()
    loss = pg_loss + v_loss - config.entropy * entropy
    with torch.no_grad():
        approx_kl = ((ratio - 1) - logratio).mean()  # http://joschu.net/blog/kl-approx.html
        clipfrac = ((ratio - 1).abs() > config.clip).float().mean()
    return loss, torch.stack([pg_loss, v_loss, entropy, approx_kl, clipfrac]).detach()


def check_finite(name: str, values: Tensor, step: int) -> Tensor:
    """`values` as they are; ValueError with the first place where one is not finite."""
    finite = torch.isfinite(values)
    if not bool(finite.all()):
        place = torch.nonzero(~finite)[0].tolist()
        got = values[tuple(place)].item()
        raise ValueError(f"{name}{place or ''}: expected a finite number at step {step}, got {got}")
    return values


@dataclass
class Learner:
    """Everything that changes during a training, apart from the environment."""

    agent: Agent
    optimizer: torch.optim.Adam
    generator: torch.Generator  # of actions and minibatches
    obs: Tensor  # of the next tick, (num_envs, obs)
    learning_rate: float  # follows the KL divergence
    global_step: int = 0
    updates: int = 0


OnUpdate = Callable[[Learner, Rollout, dict[str, float]], None]


def make_learner(
    env: VectorEnv[Any, Any, Any], config: PPOConfig, seed: int, critic: bool
) -> Learner:
    """A new agent and an environment that was reset; ValueError: no reset in the same step."""
    mode = env.metadata.get("autoreset_mode")
    if mode != AutoresetMode.SAME_STEP:
        raise ValueError(f"env: expected autoreset mode {AutoresetMode.SAME_STEP}, got {mode}")
    torch.set_num_threads(config.threads)
    obs_size = math.prod(env.single_observation_space.shape or ())
    action_size = math.prod(env.single_action_space.shape or ())
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        agent = Agent(obs_size, action_size, config.log_std, critic)
    agent.log_std.requires_grad_(config.log_std_end is None)
    optimizer = torch.optim.Adam(agent.parameters(), lr=config.learning_rate, fused=True)
    generator = torch.Generator().manual_seed(seed)
    obs = torch.as_tensor(env.reset(seed=seed)[0], dtype=torch.float32)
    return Learner(agent, optimizer, generator, obs, config.learning_rate)


@torch.no_grad()
def collect(env: VectorEnv[Any, Any, Any], learner: Learner, config: PPOConfig) -> Rollout:
    """`horizon` ticks of all environments under the present policy."""
    agent = learner.agent
    std = agent.log_std.exp()
    space: Any = env.single_action_space
    ticks: list[tuple[Tensor, ...]] = []
    infos = []
    for _ in range(config.horizon):
        obs = check_finite("obs", learner.obs, learner.global_step)
        mean = agent.actor(obs)
        action = mean + std * torch.randn(mean.shape, generator=learner.generator)
        check_finite("action", action, learner.global_step)
        logprob = log_probability(action, mean, agent.log_std)
        next_obs, reward, terminated, truncated, info = env.step(
            action.numpy().clip(space.low, space.high)
        )
        done = terminated | truncated
        learner.obs = torch.as_tensor(next_obs, dtype=torch.float32)
        last_obs = learner.obs.clone()
        if done.any():
            last_obs[done] = torch.as_tensor(np.stack(info["final_obs"][done])).float()
        rewards = check_finite("reward", torch.as_tensor(reward), learner.global_step).float()
        flags = torch.as_tensor(terminated), torch.as_tensor(done)
        ticks.append((obs, action, mean, logprob, rewards, *flags, last_obs))
        infos.append(info)
        learner.global_step += env.num_envs
    tensors = [torch.stack(column) for column in zip(*ticks, strict=True)]
    return Rollout(*tensors, infos=infos)  # type: ignore[misc, arg-type]


def anneal(learner: Learner, config: PPOConfig) -> None:
    """Learning rate and standard deviation of the actions for the present step."""
    done = learner.global_step / config.total_steps
    learner.optimizer.param_groups[0]["lr"] = learner.learning_rate * max(0.0, 1 - done)
    if config.log_std_end is not None:
        log_std = config.log_std + (config.log_std_end - config.log_std) * done
        learner.agent.log_std.data.fill_(log_std)


def adapt_learning_rate(learner: Learner, config: PPOConfig, approx_kl: float) -> None:
    """Less after a large change of the policy, more after a small one (rl_games, other factors)."""
    if approx_kl > 1.5 * config.target_kl:
        learner.learning_rate /= 1.2
    elif approx_kl < 0.7 * config.target_kl:
        learner.learning_rate = min(1.2 * learner.learning_rate, config.learning_rate)


def summarise(
    learner: Learner, rollout: Rollout, batch: dict[str, Tensor], parts: Tensor
) -> dict[str, float]:
    """Scalars of one update under CleanRL's names; ValueError: one, or a weight, is not finite."""
    metrics = {
        "charts/reward": float(rollout.rewards.mean()),
        "charts/learning_rate": learner.optimizer.param_groups[0]["lr"],
    }
    names = ("policy_loss", "value_loss", "entropy", "approx_kl", "clipfrac")
    metrics |= {f"losses/{name}": part for name, part in zip(names, parts.tolist(), strict=True)}
    if "returns" in batch:
        residual = batch["advantages"].var() / (batch["returns"].var() + 1e-12)
        metrics["losses/explained_variance"] = float(1 - residual)
    scalars = {name: torch.tensor(value) for name, value in metrics.items()}
    for name, values in (scalars | dict(learner.agent.named_parameters())).items():
        check_finite(name, values, learner.global_step)
    return metrics


def train(
    env: VectorEnv[Any, Any, Any],
    config: PPOConfig,
    seed: int,
    on_update: OnUpdate = lambda learner, rollout, metrics: None,
    estimate: Estimate | None = None,
    loss_function: Loss = ppo_loss,
    learner: Learner | None = None,
) -> Agent:
    """Train an agent; the same seed gives the same bits on the same machine.

    `env` has Box spaces and autoreset in the same step. `estimate` gives what `loss_function` needs
    of a rollout, tensors (T, N, ...); None: advantages by the critic. `on_update` is called after
    each update, with its rollout and scalars under CleanRL's names. `learner` is a training to go
    on with; None: a new one. ValueError: a number that is not finite, with its place and step.
    """
    learner = learner or make_learner(env, config, seed, critic=estimate is None)
    estimate = estimate or critic_advantages
    while learner.global_step < config.total_steps:
        anneal(learner, config)
        rollout = collect(env, learner, config)
        batch = {"obs": rollout.obs, "actions": rollout.actions, "logprobs": rollout.logprobs}
        batch |= estimate(learner.agent, rollout, config)
        batch = {name: tensor.flatten(0, 1) for name, tensor in batch.items()}
        parts = []
        for _ in range(config.epochs):
            b_inds = torch.randperm(len(batch["obs"]), generator=learner.generator)
            for mb_inds in torch.split(b_inds, config.minibatch_size):
                mb = {name: tensor[mb_inds] for name, tensor in batch.items()}
                loss, part = loss_function(learner.agent, mb, config)
                learner.optimizer.zero_grad()
                loss.backward()  # type: ignore[no-untyped-call]
                nn.utils.clip_grad_norm_(learner.agent.parameters(), config.max_grad_norm)
                learner.optimizer.step()
                parts.append(part)
        learner.updates += 1
        metrics = summarise(learner, rollout, batch, torch.stack(parts).mean(dim=0))
        adapt_learning_rate(learner, config, metrics["losses/approx_kl"])
        on_update(learner, rollout, metrics)
    return learner.agent
