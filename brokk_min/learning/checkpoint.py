"""Training of a policy with files: checkpoint, learning curve, TensorBoard, policy."""

import hashlib
import io
import json
import signal
import sys
import threading
import time
import zipfile
from contextlib import closing
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn
from tqdm import tqdm

from brokk_min import ppo
from brokk_min.actuator import ActuatorNet
from brokk_min.env import State, TaskConfig, terminated
from brokk_min.identification import files
from brokk_min.identification.net_file import fingerprint
from brokk_min.identification.progress import progress
from brokk_min.learning.gym_env import TaskVectorEnv
from brokk_min.learning.policy import Policy, contract, save_policy
from brokk_min.learning.simulation_gradient import improved_actions, make_learner, regression_loss
from brokk_min.machine import Machine
from brokk_min.ppo import Agent, Learner, PPOConfig, Rollout

FORMAT = 6  # of checkpoints
LEARNER = ("obs", "learning_rate", "global_step", "updates")  # attributes in checkpoints
STATE = [field.name for field in fields(State) if field.name != "plant"]


def describe_training(
    machine: Machine, net: ActuatorNet, task: TaskConfig, config: PPOConfig, critic: bool, seed: int
) -> dict[str, Any]:
    """All that decides the outcome of a training; kept in checkpoints and policies."""
    settings = asdict(config) | {"critic": critic or task.paper}
    if settings["critic"]:
        settings["log_std_end"] = None
    return {
        **contract(machine, task.paper),
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
    start: Policy | None = None,
) -> Policy:
    """Train a policy on the nets and write it to `out`.

    `net` has the nets of the driven joints. The same `seed` gives the same bits on the same
    computer. Its checkpoint `<out>.checkpoint` and its curve `<out>.csv` lie next to the policy.
    `critic`: PPO with a critic (always with `task.paper`), not gradients of the simulation.
    `resume`: continue from the checkpoint; the result is the same as without interruption.
    `tensorboard`: folder for the scalars of the curve (needs the extra `tensorboard`).
    `start`: a policy that the training starts from, for nets that it was not trained on.
    ValueError: settings that do not fit, a checkpoint of another training, or a number that is not
    finite. OSError: a file that cannot be written. The last checkpoint stays.
    """
    about = describe_training(machine, net, task, config, critic, seed)
    use_fast_float32()
    env = TaskVectorEnv(config.num_envs, net, machine, task)
    if about["settings"]["critic"]:
        config = replace(config, log_std_end=None)
        learner = ppo.make_learner(env, config, seed, critic=True)
        estimate, loss = None, ppo.ppo_loss
    else:
        learner = make_learner(env, config, seed)
        estimate, loss = improved_actions(machine, net, task), regression_loss
    if start:
        about["start"] = load_actor(learner.agent, start)
    stagger_episodes(env)
    log = TrainingLog(env, config, out, about, tensorboard)
    log.begin(learner, resume)
    with log.bar, closing(log):
        agent = ppo.train(env, config, seed, log.on_update, estimate, loss, learner)
    files.write_csv(log.curve, log.rows[0], [row.values() for row in log.rows])
    policy = export_policy(net, agent, task, about)
    save_policy(out, policy, machine)
    log.checkpoint.unlink(missing_ok=True)
    return policy


def use_fast_float32() -> None:
    """OneDNN's products: on AMD twice as fast as MKL's. With AMX they would be bfloat16's."""
    amx = torch.cpu.get_capabilities().get("amx_bf16", False)
    torch.set_float32_matmul_precision("highest" if amx else "medium")


def stagger_episodes(env: TaskVectorEnv) -> None:
    """Let the first episodes end one after the other: every batch then has some starts.

    An arm that starts in the ground ends in its first tick, as in all later episodes.
    """
    assert env.state is not None
    episode_ticks = round(env.config.episode_s * env.machine.rate)
    ticks = np.arange(env.num_envs) * episode_ticks // env.num_envs
    ticks[terminated(env.machine, env.state.lowest)] = 0
    env.state = replace(env.state, ticks=ticks)


def linear_layers(agent: Agent) -> list[nn.Linear]:
    """Those of the actor."""
    return [layer for layer in agent.actor if isinstance(layer, nn.Linear)]


def load_actor(agent: Agent, policy: Policy) -> str:
    """Give the actor the weights of a policy; their hash. ValueError: the other kind of agent."""
    layers = linear_layers(agent)
    if policy.weights[0].shape[0] != layers[0].in_features:
        raise ValueError("start: expected a policy of the same kind of agent (--paper or not)")
    with torch.no_grad():
        for layer, w, b in zip(layers, policy.weights[::2], policy.weights[1::2], strict=True):
            layer.weight.copy_(torch.tensor(w.T))
            layer.bias.copy_(torch.tensor(b))
    return hashlib.sha256(b"".join(w.tobytes() for w in policy.weights)).hexdigest()[:16]


def export_policy(
    net: ActuatorNet, agent: Agent, task: TaskConfig, about: dict[str, Any]
) -> Policy:
    """The actor as it stands."""
    weights = []
    for layer in linear_layers(agent):
        weights += [layer.weight.T.detach().numpy().copy(), layer.bias.detach().numpy().copy()]
    valves = "open" if task.paper else task.valves
    return Policy(about, tuple(weights), net, task.paper, valves)


class TrainingLog:
    """Curve, progress bar and checkpoints of one training."""

    def __init__(
        self,
        env: TaskVectorEnv,
        config: PPOConfig,
        out: Path,
        about: dict[str, Any],
        tensorboard: Path | None,
    ) -> None:
        self.env = env
        self.config = config
        self.about = about
        self.checkpoint = Path(f"{out}.checkpoint")
        self.curve = Path(f"{out}.csv")
        self.rows: list[dict[str, Any]] = []
        self.returns = np.zeros(env.num_envs)  # of running episodes
        self.lengths = np.zeros(env.num_envs)
        self.episodes = {"charts/episodic_return": 0.0, "charts/episodic_length": 0.0}  # last ended
        self.interrupted = False
        self.before = signal.getsignal(signal.SIGINT)
        self.writer = None
        if tensorboard is not None:
            module = files.require("torch.utils.tensorboard", "tensorboard")
            self.writer = module.SummaryWriter(str(tensorboard))

    def begin(self, learner: Learner, resume: bool) -> None:
        """Continue from the checkpoint; ValueError: it exists, but not to be resumed."""
        exists = self.checkpoint.exists()
        if exists and not resume:
            expectation = "expected --resume or no checkpoint"
            raise ValueError(f"{self.checkpoint}: {expectation}, got one of a broken training")
        if exists:
            self.load(learner)
            self.rows = read_curve(self.curve, learner.global_step)
        elif resume:
            text = "no checkpoint, training starts from the beginning"
            tqdm.write(f"{self.checkpoint}: {text}", file=sys.stderr)
        self.first_step = learner.global_step
        self.start = time.perf_counter()
        if threading.current_thread() is threading.main_thread():  # others get no signals
            signal.signal(signal.SIGINT, self.interrupt)
        total = self.config.total_steps
        self.bar = progress(total=total, initial=self.first_step, desc="train", unit="step")

    def on_update(self, learner: Learner, rollout: Rollout, metrics: dict[str, float]) -> None:
        """Add a row to the curve; every `checkpoint_every` updates write a checkpoint."""
        self.count_episodes(rollout.rewards.numpy(), rollout.dones.numpy())
        error = float(np.mean([info["velocity_error"].mean() for info in rollout.infos]))
        seconds = time.perf_counter() - self.start
        speed = round((learner.global_step - self.first_step) / seconds)
        scalars = {**self.episodes, **metrics, "charts/velocity_error": error, "charts/SPS": speed}
        self.rows.append({"global_step": learner.global_step, **scalars})
        if self.writer is not None:
            for name, value in scalars.items():
                self.writer.add_scalar(name, value, learner.global_step)
        self.bar.update(learner.global_step - self.bar.n)
        self.bar.set_postfix_str(f"reward {metrics['charts/reward']:.3f}, error {error:.3f} m/s")
        if self.interrupted or learner.updates % self.config.checkpoint_every == 0:
            files.write_csv(self.curve, self.rows[0], [row.values() for row in self.rows])
            self.save(learner)
        if self.interrupted:
            raise KeyboardInterrupt(f"; {self.checkpoint} is saved, go on with --resume")

    def interrupt(self, *_: object) -> None:
        """Ctrl-C: stop after this update; a second one stops at once."""
        self.interrupted = True
        signal.signal(signal.SIGINT, self.before)

    def count_episodes(self, rewards: np.ndarray, dones: np.ndarray) -> None:
        """Mean return and length of the episodes that ended in these ticks (T, N), if any did."""
        ended = []
        for reward, done in zip(rewards, dones, strict=True):
            self.returns += reward
            self.lengths += 1
            ended.append(np.stack([self.returns[done], self.lengths[done]]))
            self.returns[done] = 0
            self.lengths[done] = 0
        means = np.concatenate(ended, axis=1)
        if means.size:
            self.episodes = dict(zip(self.episodes, means.mean(axis=1).tolist(), strict=True))

    def close(self) -> None:
        """Close the files of TensorBoard; let Ctrl-C stop at once again."""
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, self.before)
        if self.writer is not None:
            self.writer.close()

    def content(self, learner: Learner) -> dict[str, Any]:
        """What a checkpoint holds."""
        return {
            "header": json.dumps({"format": FORMAT, "identity": self.about}),
            "agent": learner.agent.state_dict(),
            "optimizer": learner.optimizer.state_dict(),
            "generator": learner.generator.get_state(),
            **{name: getattr(learner, name) for name in LEARNER},
            "env": {name: torch.tensor(getattr(self.env.state, name)) for name in STATE},
            "random": self.env.np_random.bit_generator.state,
            "returns": torch.tensor(self.returns),
            "lengths": torch.tensor(self.lengths),
            "episodes": self.episodes,
        }

    def save(self, learner: Learner) -> None:
        """Write a checkpoint from which a training continues to the same bits."""
        buffer = io.BytesIO()
        torch.save(self.content(learner), buffer)
        with files.whole_file(self.checkpoint) as file:
            file.write(buffer.getvalue())

    def load(self, learner: Learner) -> None:
        """Restore learner and environment from a checkpoint of the same training.

        ValueError: not a checkpoint, or one of another training, with the difference.
        """
        with files.expected(self.checkpoint, "a readable checkpoint"):
            with files.open_regular(self.checkpoint) as file, zipfile.ZipFile(file) as archive:
                if any(member.compress_size != member.file_size for member in archive.infolist()):
                    raise ValueError("compressed members")
                if damaged := archive.testzip():  # torch checks no sums
                    raise ValueError(f"other bytes than were written in {damaged}")
                file.seek(0)
                content = torch.load(file, weights_only=True)  # executes nothing
            header = files.parse_json(content["header"])
            identity = dict(header["identity"])
            task = dict(identity.get("task", {}))
            identity["task"] = asdict(TaskConfig()) | task  # options since then have no effect
        files.expect_same(self.checkpoint, header, {"format": FORMAT})
        files.expect_same(self.checkpoint, identity, self.about)
        for parameter in learner.agent.parameters():
            parameter.grad = torch.zeros_like(parameter) if parameter.requires_grad else None
        learner.optimizer.step()  # changes no weight; then it has the state of a used one
        with files.expected(self.checkpoint, "a complete checkpoint"):
            wanted = {"content": kinds(self.content(learner))}
            files.expect_same(self.checkpoint, {"content": kinds(content)}, wanted)
            learner.agent.load_state_dict(content["agent"])
            learner.optimizer.load_state_dict(content["optimizer"])
            learner.generator.set_state(content["generator"])
            for name in LEARNER:
                setattr(learner, name, content[name])
            self.env.state = State(**{name: content["env"][name].numpy() for name in STATE})
            self.env.np_random.bit_generator.state = content["random"]
            self.returns = content["returns"].numpy()
            self.lengths = content["lengths"].numpy()
            self.episodes = content["episodes"]


def kinds(value: Any, place: str = "") -> dict[str, str]:
    """Types of the leaves of nested dictionaries and lists, by place; of tensors shapes, too."""
    if isinstance(value, dict | list | tuple):
        found: dict[str, str] = {}
        for name, inner in value.items() if isinstance(value, dict) else enumerate(value):
            found |= kinds(inner, f"{place}.{name}" if place else str(name))
        return found
    kind = type(value).__name__
    if isinstance(value, torch.Tensor):
        numbers = "floats" if value.is_floating_point() else "whole numbers"
        kind = f"{numbers} of shape {list(value.shape)}"
    finite = not isinstance(value, float | torch.Tensor) or np.isfinite(np.asarray(value)).all()
    return {place: kind if finite else f"{kind} with nan or inf"}


def read_curve(path: Path, last_step: int) -> list[dict[str, Any]]:
    """Rows of a curve up to a step; ValueError: no such file, or another one."""
    with files.expected(path, "the curve of the checkpoint"):
        with files.open_regular(path) as file:
            columns = file.readline(files.LONGEST_LINE).decode().strip().split(",")
        table = files.read_csv(path, columns)
        rows = [dict(zip(columns, row, strict=True)) for row in zip(*table.values(), strict=True)]
        return [row for row in rows if int(row["global_step"]) <= last_step]
