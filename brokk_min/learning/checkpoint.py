"""Training of a policy with files: checkpoint, learning curve, TensorBoard, policy.

A checkpoint holds all that `ppo.train` and the environment change, as arrays; nothing is pickled.
"""

import csv
import json
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn
from tqdm import tqdm

from brokk_min import ppo
from brokk_min.actuator import ActuatorNet
from brokk_min.env import State, TaskConfig, observation_scale
from brokk_min.identification.files import (
    expect_same,
    load_arrays,
    load_header,
    require,
    whole_file,
)
from brokk_min.identification.net_file import fingerprint
from brokk_min.learning.episodes import paper_weights
from brokk_min.learning.gym_env import TaskVectorEnv
from brokk_min.learning.policy import Policy, contract, save_policy
from brokk_min.learning.simulation_gradient import gradient_advantages
from brokk_min.machine import Machine
from brokk_min.ppo import Agent, Learner, PPOConfig, Rollout

FORMAT = 3
STATE = [field.name for field in fields(State) if field.name != "plant"]


def describe_training(
    machine: Machine, net: ActuatorNet, task: TaskConfig, config: PPOConfig, critic: bool, seed: int
) -> dict[str, Any]:
    """All that decides the outcome of a training; kept in checkpoints and policies."""
    settings = asdict(config) | {"critic": critic or task.paper}
    if settings["critic"]:
        settings["log_std_end"] = None
    return {
        **contract(machine),
        "actuator": fingerprint(net),
        "seed": seed,
        "task": asdict(task),
        "settings": settings,
    }


def train_policy(
    machine: Machine,
    net: ActuatorNet,
    task: TaskConfig,
    config: PPOConfig,
    seed: int,
    out: Path,
    critic: bool = False,
    resume: bool = False,
    tensorboard: Path | None = None,
) -> Policy:
    """Train a policy on the nets and write it to `out`.

    Args:
        machine: what moves.
        net: nets of its driven joints; the only thing known of its hydraulics.
        task: episodes.
        config: settings of the learner.
        seed: of everything random; the same seed gives the same bits on the same machine.
        out: policy file; `<out>.checkpoint` and the curve `<out>.csv` stand beside it.
        critic: advantages by a critic (always with `task.paper`), not by the nets' derivatives.
        resume: go on from the checkpoint if there is one; the end is the same as without the break.
        tensorboard: folder for the scalars of the curve (needs the extra `tensorboard`).

    Raises:
        ValueError: settings that do not fit, a checkpoint of another training, or a number that is
            not finite, with its place (the last checkpoint stays).
        OSError: a file that cannot be written (the last checkpoint stays).
    """
    critic = critic or task.paper
    if critic:
        config = replace(config, log_std_end=None)
    about = describe_training(machine, net, task, config, critic, seed)
    env = TaskVectorEnv(config.num_envs, net, machine, task)
    learner = ppo.make_learner(env, config, seed, critic)
    stagger_episodes(env)
    checkpoint, curve = Path(f"{out}.checkpoint"), Path(f"{out}.csv")
    log = TrainingLog(env, config, checkpoint, curve, about)
    log.begin(learner, resume)
    estimate = None if critic else gradient_advantages(machine, net, task)
    with log.bar, tensorboard_writer(tensorboard) as log.write:
        agent = ppo.train(env, config, seed, log.on_update, estimate, learner)
    log.write_curve()
    policy = export_policy(machine, net, agent, task, about)
    save_policy(out, policy)
    checkpoint.unlink(missing_ok=True)
    return policy


def stagger_episodes(env: TaskVectorEnv) -> None:
    """Let the first episodes of a reset environment end one after the other.

    Otherwise all arms start anew in the same update; most batches have no starts, one nothing else.
    """
    assert env.state is not None
    ticks = np.arange(env.num_envs) * round(env.config.episode_s * env.machine.rate) // env.num_envs
    env.state = replace(env.state, ticks=ticks)


def export_policy(
    machine: Machine, net: ActuatorNet, agent: Agent, task: TaskConfig, about: dict[str, Any]
) -> Policy:
    """The actor as it stands; what the paper's agent does not observe has zero weights."""
    weights = []
    for layer in agent.actor:
        if isinstance(layer, nn.Linear):
            weights += [layer.weight.T.detach().numpy().copy(), layer.bias.detach().numpy().copy()]
    if task.paper:
        weights[0] = weights[0] * paper_weights(machine)[:, None]
    return Policy(contract(machine), about, *observation_scale(machine), tuple(weights), net)


class TrainingLog:
    """Curve, progress bar and checkpoints of one training."""

    def __init__(
        self,
        env: TaskVectorEnv,
        config: PPOConfig,
        checkpoint: Path,
        curve: Path,
        about: dict[str, Any],
    ) -> None:
        self.env, self.config, self.about = env, config, about
        self.checkpoint, self.curve = checkpoint, curve
        self.rows: list[dict[str, Any]] = []
        self.returns = np.zeros(env.num_envs)  # of running episodes
        self.lengths = np.zeros(env.num_envs)
        self.episodes = (0.0, 0.0)  # mean return and length of those that ended last
        self.write: Callable[[dict[str, Any]], object] = lambda row: None

    def begin(self, learner: Learner, resume: bool) -> None:
        """Go on from the checkpoint where that is wanted; refuse to begin over one."""
        if resume and self.checkpoint.exists():
            self.load(learner)
            self.rows = read_curve(self.curve, learner.global_step)
        elif resume:
            text = "no checkpoint, training starts from the beginning"
            tqdm.write(f"{self.checkpoint}: {text}", file=sys.stderr)
        elif self.checkpoint.exists():
            raise ValueError(
                f"{self.checkpoint}: expected --resume or no checkpoint, got one of a broken training"
            )
        total = self.config.total_steps
        done = learner.global_step
        self.bar = tqdm(total=total, initial=done, desc="train", unit="step", disable=None)
        self.first, self.start = done, time.perf_counter()

    def on_update(self, learner: Learner, rollout: Rollout, metrics: dict[str, float]) -> None:
        """One more row of the curve; now and then a checkpoint."""
        self.count_episodes(rollout.rewards.numpy(), rollout.dones.numpy())
        error = float(np.mean([info["velocity_error"].mean() for info in rollout.infos]))
        speed = (learner.global_step - self.first) / (time.perf_counter() - self.start)
        episodes = dict(
            zip(("charts/episodic_return", "charts/episodic_length"), self.episodes, strict=True)
        )
        row = {"global_step": learner.global_step, **episodes, **metrics}
        row |= {"charts/velocity_error": error, "charts/SPS": round(speed)}
        self.rows.append(row)
        self.write(row)
        self.bar.update(learner.global_step - self.bar.n)
        self.bar.set_postfix_str(f"reward {metrics['charts/reward']:.3f}, error {error:.3f} m/s")
        if learner.updates % self.config.checkpoint_every == 0:
            self.write_curve()
            self.save(learner)

    def count_episodes(self, rewards: np.ndarray, dones: np.ndarray) -> None:
        """Mean return and length of the episodes that ended in these ticks (T, N), if any did."""
        ended = []
        for reward, done in zip(rewards, dones, strict=True):
            self.returns += reward
            self.lengths += 1
            ended += list(zip(self.returns[done], self.lengths[done], strict=True))
            self.returns[done] = 0
            self.lengths[done] = 0
        if ended:
            mean_return, mean_length = np.mean(ended, axis=0)
            self.episodes = float(mean_return), float(mean_length)

    def write_curve(self) -> None:
        """Write the curve whole."""
        with whole_file(self.curve, "w") as file:
            writer = csv.DictWriter(file, self.rows[0].keys(), lineterminator="\n")
            writer.writeheader()
            writer.writerows(self.rows)

    def save(self, learner: Learner) -> None:
        """Write a checkpoint from which `load` continues to the same bits."""
        header = {
            "format": FORMAT,
            "kind": "checkpoint",
            "identity": self.about,
            "updates": learner.updates,
            "global_step": learner.global_step,
            "learning_rate": learner.learning_rate,
            "episodes": self.episodes,
            "random": self.env.np_random.bit_generator.state,
        }
        arrays: dict[str, Any] = {f"env_{name}": getattr(self.env.state, name) for name in STATE}
        arrays |= {"obs": learner.obs.numpy(), "generator": learner.generator.get_state().numpy()}
        arrays |= {"returns": self.returns, "lengths": self.lengths}
        for i, parameter in enumerate(learner.agent.parameters()):
            arrays[f"parameter_{i}"] = parameter.detach().numpy()
            for name, value in learner.optimizer.state.get(parameter, {}).items():
                arrays[f"{name}_{i}"] = value.numpy()
        with whole_file(self.checkpoint) as file:
            np.savez(file, header=np.array(json.dumps(header)), **arrays)

    def load(self, learner: Learner) -> None:
        """Go on from the checkpoint of the same training.

        ValueError: a file that is no checkpoint, or one of another training, with the difference.
        """
        path = self.checkpoint
        arrays = load_arrays(path)
        header = load_header(path, arrays, "checkpoint", FORMAT)
        expect_same(path, header.get("identity", {}), self.about)
        try:
            self.restore(learner, header, arrays)
        except (KeyError, TypeError, ValueError, RuntimeError) as error:
            raise ValueError(f"{path}: expected a complete checkpoint, got {error!r}") from error

    def restore(self, learner: Learner, header: dict[str, Any], arrays: dict[str, Any]) -> None:
        """Put everything back in place."""
        tensors = {name: torch.from_numpy(a) for name, a in arrays.items() if name != "header"}
        learner.updates, learner.global_step = header["updates"], header["global_step"]
        learner.learning_rate, learner.obs = header["learning_rate"], tensors["obs"]
        learner.generator.set_state(tensors["generator"])
        self.episodes = tuple(header["episodes"])
        self.returns, self.lengths = arrays["returns"], arrays["lengths"]
        self.env.state = State(**{name: arrays[f"env_{name}"] for name in STATE})
        self.env.np_random.bit_generator.state = header["random"]
        with torch.no_grad():
            for i, parameter in enumerate(learner.agent.parameters()):
                parameter.copy_(tensors[f"parameter_{i}"])
                if f"step_{i}" in tensors:
                    moments = {
                        name: tensors[f"{name}_{i}"] for name in ("step", "exp_avg", "exp_avg_sq")
                    }
                    learner.optimizer.state[parameter] = moments


def read_curve(path: Path, steps: int) -> list[dict[str, Any]]:
    """Rows of a curve up to a step; ValueError: no such file, or another one."""
    try:
        with open(path, newline="") as file:
            return [row for row in csv.DictReader(file) if int(row["global_step"]) <= steps]
    except (OSError, KeyError, ValueError) as error:
        raise ValueError(
            f"{path}: expected the curve beside the checkpoint, got {error!r}"
        ) from error


@contextmanager
def tensorboard_writer(folder: Path | None) -> Iterator[Callable[[dict[str, Any]], object]]:
    """What writes rows of the curve to a folder for TensorBoard, or, without a folder, nowhere."""
    if folder is None:
        yield lambda row: None
        return
    with require("torch.utils.tensorboard", "tensorboard").SummaryWriter(str(folder)) as writer:

        def write(row: dict[str, Any]) -> None:
            for name, value in row.items():
                if name != "global_step":
                    writer.add_scalar(name, value, row["global_step"])

        yield write
