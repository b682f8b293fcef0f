"""Proximal Policy Optimization in one file, to be read from top to bottom.

Paper: Sec. 3.4. Clipped objective, generalised advantage estimation, 256 environments at once. An
episode that runs out of time is not an episode that failed: at a truncation the return goes on with
the value of the episode's own last observation (`next_values`), at a termination it stops.

Advantages come from a critic, as in the paper, or, because the simulation is made of nets, from their
derivatives (`adjoint`): what an action's deviation from the mean was worth, to first order.
"""

from __future__ import annotations

import csv
import json
import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn
from tqdm import tqdm

from brokk_min.actuator import ActuatorNet, fingerprint
from brokk_min.env import State, TaskConfig
from brokk_min.identification.extras import need
from brokk_min.identification.files import expect_same, load_arrays, load_header, whole_file
from brokk_min.learning.gym_env import TaskVectorEnv
from brokk_min.learning.policy import Policy, contract, save_policy
from brokk_min.learning.simulation_gradient import Rollout, action_gradients
from brokk_min.machine import Machine
from brokk_min.observation import observation_scale, paper_view, to_command

Array = NDArray[Any]
Tensor = torch.Tensor
FORMAT = 2  # of checkpoints; 1: observations in another order
STATE = [f.name for f in fields(State) if f.name != "plant"]


@dataclass(frozen=True)
class PPOConfig:
    """Settings of the learner; those that the paper names are marked."""

    total_steps: int = 6_000_000
    """Environment steps in all."""
    num_envs: int = 256
    """Environments side by side (paper: 256)."""
    horizon: int = 32
    """Ticks of every environment between two updates."""
    epochs: int = 4
    """Passes over the collected steps in each update."""
    minibatch_size: int = 2048
    """Steps in one gradient."""
    learning_rate: float = 4e-3
    """Of Adam at the start and at most; follows `target_kl` and falls linearly to zero at the end."""
    target_kl: float = 0.3
    """Change of the policy in one update at which the learning rate stays as it is (rule of rl_games)."""
    critic: bool = False
    """Advantages by a critic and GAE, as in the paper and under `--paper`, not by the nets' derivatives."""
    gamma: float = 0.95
    """Discount a tick: 0.95 looks 20 ticks (1 s) ahead, beyond the answer of a valve that has gone idle."""
    gae_lambda: float = 0.95
    """Weight of longer returns in the advantage."""
    clip: float = 0.2
    """Largest change of a probability ratio that still earns."""
    entropy: float = 0.0
    """Bonus for the entropy of the action distribution."""
    max_grad_norm: float = 1.0
    """Gradients are scaled down to this norm."""
    log_std: float = -1.8
    """Logarithm of the actions' standard deviation at the start."""
    log_std_end: float = -4.5
    """The same at the end, with straight steps between; with a critic it is learned instead."""
    checkpoint_every: int = 50
    """Updates between two checkpoints."""
    threads: int = 2
    """Threads of torch; sums, and so the last bits, depend on it."""


# --- the algorithm, in functions that can be tested one by one --------------------------------------


def mlp(inputs: int, outputs: int, gain: float) -> nn.Sequential:
    """256-128-64 with ELU and a linear output, orthogonal start. Paper: Sec. 3.4"""
    sizes, layers = [inputs, 256, 128, 64], []
    for rows, columns in pairwise(sizes):
        layers += [_orthogonal(nn.Linear(rows, columns), 2**0.5), nn.ELU(inplace=True)]
    return nn.Sequential(*layers, _orthogonal(nn.Linear(sizes[-1], outputs), gain))


def _orthogonal(layer: nn.Linear, gain: float) -> nn.Linear:
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
    return layer


class Agent(nn.Module):
    """Actor and critic, two separate nets, and the logarithm of the actions' deviation."""

    def __init__(self, observations: int, actions: int, log_std: float) -> None:
        super().__init__()
        self.actor = mlp(observations, actions, 0.01)
        self.critic = mlp(observations, 1, 1.0)
        self.log_std = nn.Parameter(torch.full((actions,), log_std))

    def value(self, observation: Tensor) -> Tensor:
        """Value (...) of observations (..., obs), in units of the mean reward: return * (1 - gamma)."""
        value: Tensor = self.critic(observation)[..., 0]
        return value


def log_probability(action: Tensor, mean: Tensor, log_std: Tensor) -> Tensor:
    """Log-density (...) of actions (..., a) under independent normals."""
    z = (action - mean) * torch.exp(-log_std)
    return -0.5 * (z * z).sum(-1) - log_std.sum() - 0.5 * action.shape[-1] * math.log(2 * math.pi)


def gae(
    rewards: Tensor,
    values: Tensor,
    next_values: Tensor,
    ended: Tensor,
    gamma: float,
    gae_lambda: float,
) -> Tensor:
    """Generalised advantage estimates, all arguments and the result of shape (T, N).

    Args:
        rewards: reward of tick t.
        values: value of the observation before tick t.
        next_values: value of the observation after tick t: 0 where the episode terminated, that of its
            own last observation where it was truncated.
        ended: 1 where the episode terminated or was truncated at tick t.
        gamma: discount.
        gae_lambda: weight of longer returns.

    Example:
        >>> one = torch.ones(2, 1)
        >>> gae(one, 0 * one, 0 * one, 0 * one, 0.5, 1.0).ravel().tolist()
        [1.5, 1.0]
    """
    delta = rewards + gamma * next_values - values
    advantages, later = torch.empty_like(delta), torch.zeros_like(delta[0])
    for t in range(len(delta) - 1, -1, -1):
        later = delta[t] + gamma * gae_lambda * (1 - ended[t]) * later
        advantages[t] = later
    return advantages


def policy_loss(new: Tensor, old: Tensor, advantages: Tensor, clip: float) -> Tensor:
    """Clipped surrogate loss from log-probabilities and advantages, all (B,); the mean over B."""
    ratio = torch.exp(new - old)
    clipped = torch.clamp(ratio, 1 - clip, 1 + clip)
    return -torch.min(ratio * advantages, clipped * advantages).mean()


def normalise(advantages: Tensor) -> Tensor:
    """Advantages (B,) with zero mean and unit deviation."""
    return (advantages - advantages.mean()) / (advantages.std() + 1e-8)


def losses(agent: Agent, part: dict[str, Tensor], clip: float) -> Tensor:
    """Policy loss, value loss, entropy, change of the policy and clipped share of a minibatch, (5,).

    The change is Schulman's estimate of the KL divergence; it and the share have no gradient. There is no
    value loss without returns.
    """
    new = log_probability(part["action"], agent.actor(part["observation"]), agent.log_std)
    old, advantages = part["log_probability"], normalise(part["advantage"])
    loss = policy_loss(new, old, advantages, clip)
    value_loss = torch.zeros(())
    if "return" in part:
        value_loss = ((agent.value(part["observation"]) - part["return"]) ** 2).mean()
    entropy = agent.log_std.sum() + 0.5 * len(agent.log_std) * (1 + np.log(2 * np.pi))
    with torch.no_grad():
        change = new - old
        kl = (torch.exp(change) - 1 - change).mean()
        clipped = (torch.abs(torch.exp(change) - 1) > clip).float().mean()
    return torch.stack([loss, value_loss, entropy, kl, clipped])


def finite(name: str, values: Tensor, step: int) -> Tensor:
    """`values` as they are; ValueError with the first place where one is no number."""
    if not bool(torch.isfinite(values).all()):
        place = torch.nonzero(~torch.isfinite(values))[0].tolist()
        got = values[tuple(place)].item()
        raise ValueError(f"{name}{place or ''}: expected a finite number at step {step}, got {got}")
    return values


# --- training ---------------------------------------------------------------------------------------


class Training:
    """Everything that changes while a policy is trained, so that it can be saved and taken up again."""

    def __init__(self, env: TaskVectorEnv, config: PPOConfig, seed: int) -> None:
        self.env, self.config, self.seed = env, config, seed
        torch.set_num_threads(config.threads)
        torch.set_float32_matmul_precision(
            "medium"
        )  # oneDNN's kernels where MKL's take twice as long
        self.generator = torch.Generator().manual_seed(seed)
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            spaces = env.single_observation_space, env.single_action_space
            seen, actions = (math.prod(space.shape or ()) for space in spaces)
            self.agent = Agent(seen, actions, config.log_std)
        self.critic = config.critic or env.config.paper
        self.agent.log_std.requires_grad_(self.critic)
        self.optimizer = torch.optim.Adam(
            self.agent.parameters(), lr=config.learning_rate, fused=True
        )
        self.updates, self.learning_rate = 0, config.learning_rate
        self.returns, self.lengths = (
            np.zeros(config.num_envs) for _ in range(2)
        )  # of running episodes
        self.episodes: tuple[float, ...] = (
            0.0,
            0.0,
        )  # mean return and length of the last that ended
        self.observation = torch.from_numpy(env.reset(seed=seed)[0])

    @property
    def steps(self) -> int:
        """Environment steps so far."""
        return self.updates * self.config.horizon * self.config.num_envs

    def update(self) -> dict[str, float]:
        """Collect `horizon` ticks, learn from them; scalars under the names of CleanRL."""
        c = self.config
        rate = self.learning_rate * max(0.0, 1 - self.steps / c.total_steps)
        self.optimizer.param_groups[0]["lr"] = rate
        if not self.critic:
            done = self.steps / c.total_steps
            self.agent.log_std.data.fill_(c.log_std + (c.log_std_end - c.log_std) * done)
        batch, scalars = self._collect()
        losses = self._learn(batch)
        self.updates += 1
        change = losses["losses/approx_kl"] / c.target_kl
        factor = 1 / 1.2 if change > 1.5 else 1.2 if change < 0.7 else 1.0
        self.learning_rate = min(self.learning_rate * factor, c.learning_rate)
        scalars |= {"charts/learning_rate": rate} | losses
        for name, value in scalars.items():
            finite(name, torch.tensor(value), self.steps)
        for (
            name,
            parameter,
        ) in self.agent.named_parameters():  # a last gradient may spoil them unseen
            finite(name, parameter, self.steps)
        return scalars

    @torch.no_grad()
    def _collect(self) -> tuple[dict[str, Tensor], dict[str, float]]:
        """`horizon` ticks of every environment, every action judged."""
        c, agent, env = self.config, self.agent, self.env
        shape, std = (c.horizon, c.num_envs), torch.exp(agent.log_std)
        observations = torch.empty(*shape, self.observation.shape[-1])
        actions, means = (torch.empty(*shape, len(std)) for _ in range(2))
        rewards, tails, ended = (
            torch.empty(shape),
            torch.zeros(shape),
            torch.empty(shape, dtype=torch.bool),
        )
        ticks: list[tuple[Any, ...]] = []
        errors = []
        for t in range(c.horizon):
            step, state = self.steps + t * c.num_envs, cast(State, env.state)
            observations[t] = finite("observation", self.observation, step)
            means[t] = agent.actor(self.observation)
            noise = torch.randn(means[t].shape, generator=self.generator)
            actions[t] = finite("action", means[t] + std * noise, step)
            following, reward, terminated, truncated, info = env.step(actions[t].numpy())
            rewards[t] = finite("reward", torch.from_numpy(reward), step)
            over = terminated | truncated
            ended[t] = torch.from_numpy(over)
            if not self.critic:
                u = to_command(env.machine, actions[t].numpy())
                ticks.append((state.q, state.motion, state.v_goal, state.lag, u, over))
            elif truncated.any():
                last = torch.from_numpy(info["final_obs"][truncated])
                tails[t, torch.from_numpy(truncated)] = agent.value(finite("final_obs", last, step))
            self.observation = torch.from_numpy(following)
            errors.append(info["velocity_error"].mean())
        self._count_episodes(rewards.numpy(), ended.numpy())
        scalars = {
            "charts/episodic_return": self.episodes[0],
            "charts/episodic_length": self.episodes[1],
            "charts/reward": float(rewards.mean()),
            "charts/velocity_error": float(np.mean(errors)),
        }
        batch = {"observation": observations, "action": actions}
        batch["log_probability"] = log_probability(actions, means, agent.log_std)
        if self.critic:
            batch |= self._by_critic(observations, rewards, tails, ended.float())
            unexplained = batch["advantage"].var() / (batch["return"].var() + 1e-12)
            scalars["losses/explained_variance"] = float(1 - unexplained)
        else:
            batch["advantage"] = self._by_adjoint(ticks, actions, means)
        return {name: tensor.flatten(0, 1) for name, tensor in batch.items()}, scalars

    def _count_episodes(self, rewards: Array, ended: Array) -> None:
        """Mean return and length of the episodes that ended in these ticks (T, N), if any did."""
        finished = []
        for reward, over in zip(rewards, ended, strict=True):
            self.returns, self.lengths = self.returns + reward, self.lengths + 1
            finished += list(zip(self.returns[over], self.lengths[over], strict=True))
            self.returns, self.lengths = (
                np.where(over, 0, x) for x in (self.returns, self.lengths)
            )
        if finished:
            self.episodes = tuple(map(float, np.mean(finished, axis=0)))

    def _by_critic(
        self, observations: Tensor, rewards: Tensor, tails: Tensor, ended: Tensor
    ) -> dict[str, Tensor]:
        """Advantages and returns (T, N); `tails`: values of the last observations of truncated episodes."""
        c, values = self.config, self.agent.value(observations)
        following = torch.cat([values[1:], self.agent.value(self.observation)[None]])
        following = torch.where(ended > 0, tails, following)
        advantages = gae(rewards * (1 - c.gamma), values, following, ended, c.gamma, c.gae_lambda)
        return {"advantage": advantages, "return": advantages + values}

    def _by_adjoint(self, ticks: list[tuple[Any, ...]], actions: Tensor, means: Tensor) -> Tensor:
        """Advantages (T, N): what the deviation from the mean action was worth, to first order."""
        env, net = self.env, self.env.net
        if net is None:
            raise ValueError(
                "actuator: expected nets, whose derivatives are known, got the analytic plant"
            )
        rollout = Rollout(*map(np.stack, zip(*ticks, strict=True)))
        slope = action_gradients(env.machine, net, rollout, self.config.gamma, env.config)
        deviation = actions.clamp(-1, 1) - means.clamp(-1, 1)  # of what the valves got
        return (torch.from_numpy(slope) * deviation).sum(-1)

    def _learn(self, batch: dict[str, Tensor]) -> dict[str, float]:
        c, agent = self.config, self.agent
        size, total = len(batch["action"]), torch.zeros(5)
        for _ in range(c.epochs):
            order = torch.randperm(size, generator=self.generator)
            for rows in torch.split(order, c.minibatch_size):
                part = {name: tensor.index_select(0, rows) for name, tensor in batch.items()}
                found = losses(agent, part, c.clip)
                self.optimizer.zero_grad()
                torch.autograd.backward(found[0] + found[1] - c.entropy * found[2])
                nn.utils.clip_grad_norm_(agent.parameters(), c.max_grad_norm)
                self.optimizer.step()
                total += found.detach() * len(rows)
        names = ("policy_loss", "value_loss", "entropy", "approx_kl", "clipfrac")
        means = (total / (size * c.epochs)).tolist()
        pairs = zip(names, means, strict=True)
        return {
            f"losses/{name}": mean for name, mean in pairs if self.critic or name != "value_loss"
        }

    def policy(self, training: dict[str, Any]) -> Policy:
        """The actor as it stands, for the machine it was trained for."""
        machine, net = self.env.machine, self.env.net
        if net is None:
            raise ValueError("actuator: expected a policy trained on nets, got the analytic plant")
        layers = [layer for layer in self.agent.actor if isinstance(layer, nn.Linear)]
        arrays = (
            array.detach().numpy() for layer in layers for array in (layer.weight.T, layer.bias)
        )
        first, *rest = (array.copy() for array in arrays)
        if self.env.config.paper:
            first = first * paper_view(machine)[:, None]
        return Policy(contract(machine), training, *observation_scale(machine), (first, *rest), net)

    # --- checkpoints: all of the above as arrays, nothing pickled

    def save(self, path: Path, identity: dict[str, Any]) -> None:
        """Write a checkpoint from which `load` continues to the same bits."""
        state = self.env.state
        if state is None:
            raise ValueError("state: expected a reset environment, got None")
        header = {
            "format": FORMAT,
            "kind": "checkpoint",
            "identity": identity,
            "updates": self.updates,
            "learning_rate": self.learning_rate,
            "episodes": self.episodes,
            "random": self.env.np_random.bit_generator.state,
        }
        arrays = {f"env_{name}": getattr(state, name) for name in STATE}
        arrays |= {
            "observation": self.observation.numpy(),
            "generator": self.generator.get_state().numpy(),
        }
        arrays |= {"returns": self.returns, "lengths": self.lengths}
        moments = self.optimizer.state
        for i, parameter in enumerate(self.agent.parameters()):
            arrays[f"parameter_{i}"] = parameter.detach().numpy()
            for name, value in moments.get(parameter, {}).items():  # none of what is not trained
                arrays[f"{name}_{i}"] = value.numpy()
        with whole_file(path) as file:
            np.savez(file, header=np.array(json.dumps(header)), **arrays)

    def load(self, path: Path, identity: dict[str, Any]) -> None:
        """Take up a checkpoint of the same training.

        Raises:
            ValueError: a file that is no checkpoint, or one of another training, with the difference.
        """
        arrays = load_arrays(path)
        header = load_header(path, arrays, "checkpoint", FORMAT)
        expect_same(path, header.get("identity", {}), identity)
        tensors = {name: torch.from_numpy(a) for name, a in arrays.items() if name != "header"}
        try:
            self._restore(header, arrays, tensors)
        except (KeyError, TypeError, ValueError, RuntimeError) as error:
            raise ValueError(f"{path}: expected a complete checkpoint, got {error!r}") from error

    def _restore(
        self, header: dict[str, Any], arrays: dict[str, Any], tensors: dict[str, Tensor]
    ) -> None:
        self.updates, self.observation = header["updates"], tensors["observation"]
        self.learning_rate, self.episodes = header["learning_rate"], tuple(header["episodes"])
        self.returns, self.lengths = arrays["returns"], arrays["lengths"]
        state: dict[str, Any] = {name: arrays[f"env_{name}"] for name in STATE}
        self.env.state = State(**state)
        self.env.np_random.bit_generator.state = header["random"]
        self.generator.set_state(tensors["generator"])
        moments = self.optimizer.state
        with torch.no_grad():
            for i, parameter in enumerate(self.agent.parameters()):
                parameter.copy_(tensors[f"parameter_{i}"])
                names = ("step", "exp_avg", "exp_avg_sq")
                if f"step_{i}" in tensors:
                    moments[parameter] = {name: tensors[f"{name}_{i}"] for name in names}


def identity_of(
    machine: Machine, net: ActuatorNet, task: TaskConfig, config: PPOConfig, seed: int
) -> dict[str, Any]:
    """All that decides the outcome of a training; kept in checkpoints and policies."""
    return {
        **contract(machine),
        "actuator": fingerprint(net),
        "seed": seed,
        "task": asdict(task),
        "settings": asdict(config),
    }


def train(
    machine: Machine,
    net: ActuatorNet,
    task: TaskConfig,
    config: PPOConfig,
    seed: int,
    out: Path,
    resume: bool = False,
    tensorboard: Path | None = None,
) -> Policy:
    """Train a policy on the nets and write it to `out`, its learning curve beside it as `.csv`.

    Args:
        machine: what moves.
        net: nets of its driven joints; the only thing known of its hydraulics.
        task: episodes.
        config: settings of the learner.
        seed: of everything random; the same seed gives the same bits on the same machine.
        out: policy file; `<out>.checkpoint` and `<out>.csv` stand beside it.
        resume: take up the checkpoint if there is one; the end is the same as without the break.
        tensorboard: folder for the same scalars as in the CSV (needs the extra `tensorboard`).

    Raises:
        ValueError: settings that do not fit, a checkpoint of another training, or an observation, action,
            reward, loss or weight that is no number, with its place (the last checkpoint stays).
        OSError: a file that cannot be written (the last checkpoint stays).
    """
    env = TaskVectorEnv(config.num_envs, net, machine, task)
    training = Training(env, config, seed)
    out_of_step(env)
    identity = identity_of(machine, net, task, config, seed)
    checkpoint, curve = Path(f"{out}.checkpoint"), Path(f"{out}.csv")
    _take_up(training, checkpoint, identity, resume)
    rows = _read_curve(curve, training.steps) if training.updates else []
    first, start, total = training.steps, time.perf_counter(), config.total_steps
    bar = tqdm(total=total, initial=first, desc="train", unit="step", disable=None)
    with bar, _tensorboard(tensorboard) as note:
        while training.steps < total:
            scalars = training.update()
            speed = (training.steps - first) / (time.perf_counter() - start)
            rows.append({"global_step": training.steps} | scalars | {"charts/SPS": round(speed)})
            note(rows[-1])
            bar.update(training.steps - bar.n)
            reward, error = scalars["charts/reward"], scalars["charts/velocity_error"]
            bar.set_postfix_str(f"reward {reward:.3f}, error {error:.3f} m/s")
            if training.updates % config.checkpoint_every == 0:
                _write_curve(curve, rows)
                training.save(checkpoint, identity)
    _write_curve(curve, rows)
    policy = training.policy(identity)
    save_policy(out, policy)
    checkpoint.unlink(missing_ok=True)
    return policy


def out_of_step(env: TaskVectorEnv) -> None:
    """Let the first episodes of a reset environment end one after the other.

    In step, all arms start anew in the same update, and most batches have no starts, one nothing else.
    """
    ticks = np.arange(env.num_envs) * round(env.config.episode_s * env.machine.rate) // env.num_envs
    env.state = replace(cast(State, env.state), ticks=ticks)


def _take_up(training: Training, checkpoint: Path, identity: dict[str, Any], resume: bool) -> None:
    """Go on from the checkpoint where that is wanted; refuse to begin over one where it is not."""
    if resume and checkpoint.exists():
        training.load(checkpoint, identity)
    elif resume:
        tqdm.write(
            f"{checkpoint}: no checkpoint, training starts from the beginning", file=sys.stderr
        )
    elif checkpoint.exists():
        raise ValueError(
            f"{checkpoint}: expected --resume or no checkpoint, got one of a broken training"
        )


def _read_curve(path: Path, steps: int) -> list[dict[str, Any]]:
    try:
        with open(path, newline="") as file:
            return [row for row in csv.DictReader(file) if int(row["global_step"]) <= steps]
    except (OSError, KeyError, ValueError) as error:
        raise ValueError(
            f"{path}: expected the curve beside the checkpoint, got {error!r}"
        ) from error


def _write_curve(path: Path, rows: list[dict[str, Any]]) -> None:
    with whole_file(path, "w") as file:
        writer = csv.DictWriter(file, rows[0].keys(), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


@contextmanager
def _tensorboard(folder: Path | None) -> Iterator[Callable[[dict[str, Any]], object]]:
    """What also writes rows of the curve to a folder for TensorBoard, or, without a folder, nowhere."""
    if folder is None:
        yield lambda row: None
        return
    with need("torch.utils.tensorboard", "tensorboard").SummaryWriter(str(folder)) as writer:
        yield lambda row: [
            writer.add_scalar(k, v, row["global_step"]) for k, v in list(row.items())[1:]
        ]
