"""Proximal Policy Optimization (Schulman et al., 2017) in one file, to be read from top to bottom.

It trains on a Gymnasium vector environment with Box spaces that resets in the same step;
`learning.gym_env` makes one of `env.reset` and `env.step`. A truncated episode did not fail: its
return goes on with the value of its own last observation. At a termination it stops. Advantages
come from a critic, as in the paper; `train` also accepts another advantage function. `python -m
brokk_min.ppo` trains an agent on a task of Gymnasium. Names follow CleanRL's where they can;
target_kl steers the learning rate. Paper: Sec. 3.4
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import torch
import tyro
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from torch import Tensor, nn

from brokk_min.settings import PPOConfig


def layer_init(layer: nn.Linear, std: float) -> nn.Linear:
    """Orthogonal weights with gain `std`, biases 0."""
    nn.init.orthogonal_(layer.weight, std)
    nn.init.zeros_(layer.bias)
    return layer


def mlp(inputs: int, outputs: int, std: float) -> nn.Sequential:
    """256-128-64 with ELU and a linear output. Paper: Sec. 3.4

    >>> mlp(163, 4, 0.01)(torch.zeros(256, 163)).shape
    torch.Size([256, 4])
    """
    layers: list[nn.Module] = []
    for size_in, size_out in ((inputs, 256), (256, 128), (128, 64)):
        layers += [layer_init(nn.Linear(size_in, size_out), math.sqrt(2)), nn.ELU(inplace=True)]
    return nn.Sequential(*layers, layer_init(nn.Linear(64, outputs), std))


class Agent(nn.Module):
    """Actor, logarithm of the actions' standard deviation, and critic.

    The critic's output is scaled by running averages of the batch means and batch variances of the
    returns: value = mean + sqrt(var) critic(obs) (as PopArt, van Hasselt et al., 2016, but without
    its correction of the output layer).
    """

    return_mean: Tensor
    return_var: Tensor

    def __init__(self, obs: int, actions: int, log_std: float) -> None:
        super().__init__()
        self.actor = mlp(obs, actions, 0.01)
        self.log_std = nn.Parameter(torch.full((actions,), log_std))
        self.critic = mlp(obs, 1, 1.0)
        self.register_buffer("return_mean", torch.zeros(()))
        self.register_buffer("return_var", torch.ones(()))

    def value(self, obs: Tensor) -> Tensor:
        """Value (...) of observations (..., obs), in units of the reward: (1 - gamma) * return."""
        value: Tensor = self.return_mean + self.return_var.sqrt() * self.critic(obs)[..., 0]
        return value


class Rollout(NamedTuple):
    """What one collection saw: tensors (T, num_envs, ...)."""

    obs: Tensor
    actions: Tensor
    logprobs: Tensor
    rewards: Tensor
    terminated: Tensor
    dones: Tensor  # terminated or truncated
    next_obs: Tensor  # where an episode ended: its own last observation
    infos: Any  # of `env.step`, a dictionary a tick


class Checkpoint(NamedTuple):
    """What a training goes on from, beside its environment and torch's random numbers."""

    agent: Agent
    optimizer: torch.optim.Optimizer
    obs: Tensor  # of the next tick, (num_envs, obs)
    global_step: int
    update: int
    learning_rate: float  # of the next update, before it falls with the steps


Advantages = Callable[[Agent, Rollout, PPOConfig], tuple[Tensor, Tensor | None]]


def log_probability(actions: Tensor, mean: Tensor, log_std: Tensor) -> Tensor:
    """Log-density (...) of actions (..., a) under independent normal distributions.

    >>> zero = torch.zeros(1)
    >>> round(log_probability(zero, zero, zero).item(), 4)  # -log(2 pi) / 2
    -0.9189
    """
    z = (actions - mean) * torch.exp(-log_std)
    return -0.5 * (z * z).sum(-1) - log_std.sum() - 0.5 * actions.shape[-1] * math.log(2 * math.pi)


@torch.no_grad()
def collect_rollout(
    env: VectorEnv[Any, Any, Any], agent: Agent, obs: Tensor, horizon: int
) -> tuple[Rollout, Tensor]:
    """`horizon` ticks of all environments from observations (num_envs, obs); and the next ones."""
    space: Any = env.single_action_space
    ticks: list[Rollout] = []  # of one tick each
    for _ in range(horizon):
        mean = agent.actor(obs)
        action = mean + agent.log_std.exp() * torch.randn(mean.shape)
        logprob = log_probability(action, mean, agent.log_std)
        clipped = action.numpy().clip(space.low, space.high)
        next_obs, reward, terminated, truncated, info = env.step(clipped)
        done = terminated | truncated
        following = torch.as_tensor(next_obs, dtype=torch.float32)
        last_obs = following.clone()
        if done.any():
            last_obs[done] = torch.as_tensor(np.stack(info["final_obs"][done])).float()
        rewards = torch.as_tensor(reward).float()
        ended, dones = torch.as_tensor(terminated), torch.as_tensor(done)
        ticks.append(Rollout(obs, action, logprob, rewards, ended, dones, last_obs, info))
        obs = following
    *columns, infos = zip(*ticks, strict=True)
    return Rollout._make([*map(torch.stack, columns), infos]), obs


def gae(
    rewards: Tensor, values: Tensor, next_values: Tensor, dones: Tensor, gamma: float, lam: float
) -> Tensor:
    """Generalised advantage estimates (Schulman et al., 2016), all tensors of shape (T, N).

    `values` are V(s_t), `next_values` V(s_{t+1}): 0 where the episode terminated, that of its own
    last observation where it was truncated. `dones` is 1 where it terminated or was truncated.

    >>> one = torch.ones(2, 1)
    >>> gae(one, 0 * one, 0 * one, 0 * one, 0.5, 1.0).ravel().tolist()
    [1.5, 1.0]
    """
    delta = rewards + gamma * next_values - values  # r_t + gamma V(s_{t+1}) - V(s_t)
    advantages = torch.empty_like(delta)
    lastgaelam = torch.zeros_like(delta[0])
    for t in reversed(range(len(delta))):
        # A_t = delta_t + gamma lambda (1 - done_t) A_{t+1}
        lastgaelam = delta[t] + gamma * lam * (1 - dones[t]) * lastgaelam
        advantages[t] = lastgaelam
    return advantages


@torch.no_grad()
def critic_advantages(agent: Agent, rollout: Rollout, config: PPOConfig) -> tuple[Tensor, Tensor]:
    """Advantages by the critic, and the returns (T, N) that it learns from. Paper: Sec. 3.4"""
    values = agent.value(rollout.obs)
    next_values = agent.value(rollout.next_obs) * ~rollout.terminated
    rewards = rollout.rewards * (1 - config.gamma)  # so that a return is as large as a reward
    dones = rollout.dones.float()
    advantages = gae(rewards, values, next_values, dones, config.gamma, config.gae_lambda)
    return advantages, advantages + values


def policy_loss(ratio: Tensor, advantages: Tensor, clip: float) -> Tensor:
    """-E[min(ratio A, clip(ratio, 1 - eps, 1 + eps) A)] of ratios and advantages (B,).

    >>> policy_loss(torch.tensor([1.5]), torch.ones(1), 0.2).item()  # no more than 1.2
    -1.2000000476837158
    """
    clipped = torch.clamp(ratio, 1 - clip, 1 + clip)
    return -torch.min(ratio * advantages, clipped * advantages).mean()


def ppo_loss(agent: Agent, mb: dict[str, Tensor], config: PPOConfig) -> tuple[Tensor, Tensor]:
    """Loss of a minibatch, and (4,) for the log: policy, value, KL, clip fraction."""
    newlogprob = log_probability(mb["actions"], agent.actor(mb["obs"]), agent.log_std)
    logratio = newlogprob - mb["logprobs"]
    ratio = logratio.exp()
    advantages = mb["advantages"]
    advantages = (advantages - advantages.mean()) / (advantages.std(correction=0) + 1e-8)
    pg_loss = policy_loss(ratio, advantages, config.clip)
    v_loss = torch.zeros(())
    if "returns" in mb:
        v_loss = ((agent.value(mb["obs"]) - mb["returns"]) ** 2 / agent.return_var).mean()
    loss = pg_loss + v_loss
    with torch.no_grad():
        approx_kl = ((ratio - 1) - logratio).mean()  # http://joschu.net/blog/kl-approx.html
        clipfrac = ((ratio - 1).abs() > config.clip).float().mean()
    return loss, torch.stack([pg_loss, v_loss, approx_kl, clipfrac]).detach()


def begin(env: VectorEnv[Any, Any, Any], config: PPOConfig, seed: int) -> Checkpoint:
    """A new agent, Adam as its optimiser, and the first observations of the environment.

    ValueError: an environment that does not reset in the same step.
    """
    if (mode := env.metadata.get("autoreset_mode")) != AutoresetMode.SAME_STEP:
        raise ValueError(f"env: expected autoreset mode {AutoresetMode.SAME_STEP}, got {mode}")
    torch.manual_seed(seed)
    obs_size = math.prod(env.single_observation_space.shape or ())
    agent = Agent(obs_size, math.prod(env.single_action_space.shape or ()), config.log_std)
    agent.log_std.requires_grad_(config.log_std_end is None)
    optimizer = torch.optim.Adam(agent.parameters(), lr=config.learning_rate, fused=True)
    obs = torch.as_tensor(env.reset(seed=seed)[0], dtype=torch.float32)
    return Checkpoint(agent, optimizer, obs, 0, 0, config.learning_rate)


def rescale_critic(agent: Agent, returns: Tensor, update: int) -> None:
    """Move the scale of the critic's output to the means over all `update` batches of returns."""
    agent.return_mean += (returns.mean() - agent.return_mean) / update
    agent.return_var += (returns.var() - agent.return_var) / update


def improve(
    agent: Agent, optimizer: torch.optim.Optimizer, batch: dict[str, Tensor], config: PPOConfig
) -> dict[str, float]:
    """`epochs` passes over a batch (T, N, ...) in minibatches; means of what `ppo_loss` says."""
    batch, parts = {name: tensor.flatten(0, 1) for name, tensor in batch.items()}, []
    for _ in range(config.epochs):
        b_inds = torch.randperm(len(batch["obs"]))
        for mb_inds in torch.split(b_inds, config.minibatch_size):
            mb = {name: tensor[mb_inds] for name, tensor in batch.items()}
            loss, part = ppo_loss(agent, mb, config)
            optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            nn.utils.clip_grad_norm_(agent.parameters(), config.max_grad_norm)
            optimizer.step()
            parts.append(part)
    names = ("policy_loss", "value_loss", "approx_kl", "clipfrac")
    means = torch.stack(parts).mean(dim=0).tolist()
    return {f"losses/{name}": mean for name, mean in zip(names, means, strict=True)}


def steered(learning_rate: float, approx_kl: float, config: PPOConfig) -> float:
    """Lower after a large change of the policy, higher after a small one, much as in rl_games.

    >>> config = PPOConfig(learning_rate=0.012, target_kl=0.03)
    >>> round(steered(0.006, 0.1, config), 6), round(steered(0.006, 0.01, config), 6)
    (0.005, 0.0072)
    """
    if approx_kl > 1.5 * config.target_kl:
        return learning_rate / 1.2
    if approx_kl < 0.7 * config.target_kl:
        return min(1.2 * learning_rate, config.learning_rate)
    return learning_rate


def train(
    env: VectorEnv[Any, Any, Any],
    config: PPOConfig,
    seed: int,
    advantage_function: Advantages = critic_advantages,
    on_update: Callable[[Checkpoint, Rollout, dict[str, float]], None] = lambda *_: None,
    start: Checkpoint | None = None,
) -> Agent:
    """Train an agent; the same seed gives the same bits on the same machine.

    `advantage_function` gives advantages (T, N) of a rollout, and the returns that the critic
    learns, or None. `on_update` is called after each update, with the rollout and scalars under
    CleanRL's names. `start` is a checkpoint to go on from, in place of a new agent by `seed`.
    ValueError: a loss that is not finite.
    """
    agent, optimizer, obs, global_step, update, rate = start or begin(env, config, seed)
    while global_step < config.total_steps:
        done = global_step / config.total_steps
        optimizer.param_groups[0]["lr"] = rate * (1 - done)  # steered, times what is left
        if config.log_std_end is not None:
            agent.log_std.data.fill_(config.log_std + (config.log_std_end - config.log_std) * done)
        rollout, obs = collect_rollout(env, agent, obs, config.horizon)
        global_step += config.horizon * env.num_envs
        update += 1
        advantages, returns = advantage_function(agent, rollout, config)
        batch = {"obs": rollout.obs, "actions": rollout.actions, "logprobs": rollout.logprobs}
        batch["advantages"] = advantages
        if returns is not None:
            batch["returns"] = returns
            rescale_critic(agent, returns, update)
        metrics = improve(agent, optimizer, batch, config)
        if not math.isfinite(sum(metrics.values())):
            raise ValueError(f"loss: expected finite numbers at step {global_step}, got {metrics}")
        metrics["charts/reward"] = float(rollout.rewards.mean())
        metrics["charts/learning_rate"] = optimizer.param_groups[0]["lr"]
        rate = steered(rate, metrics["losses/approx_kl"], config)
        now = Checkpoint(agent, optimizer, obs, global_step, update, rate)
        on_update(now, rollout, metrics)
    return agent


PENDULUM: dict[str, Any] = {"num_envs": 32, "epochs": 4, "minibatch_size": 256, "gamma": 0.95}
PENDULUM |= {"learning_rate": 4e-3, "target_kl": 0.3, "log_std": 0.0}


def main(
    task: tyro.conf.Positional[str] = "Pendulum-v1", total_steps: int = 60_000, seed: int = 0
) -> None:
    """Train an agent on a task of Gymnasium with continuous actions, and print its mean return."""
    config = PPOConfig(total_steps, **(PENDULUM if task == "Pendulum-v1" else {}))
    spec: Any = gymnasium.make(task).spec
    options = {} if spec.vector_entry_point else {"autoreset_mode": AutoresetMode.SAME_STEP}
    env = RecordEpisodeStatistics(gymnasium.make_vec(task, config.num_envs, vector_kwargs=options))

    def report(now: Checkpoint, rollout: Rollout, metrics: dict[str, float]) -> None:
        if env.return_queue:  # of the last hundred episodes
            print(f"step {now.global_step}: return {np.mean(env.return_queue):.1f}", flush=True)

    train(env, config, seed, on_update=report)


if __name__ == "__main__":
    tyro.cli(main)
