"""The commands that train. Each learner has defaults of its own.

`PPOConfig` is repeated, since its module imports torch, for which help must not wait.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import OmitArgPrefixes, arg

from brokk_min.actuator import ActuatorNet
from brokk_min.cli.options import Command, WrongUse, checked
from brokk_min.env import TaskConfig
from brokk_min.identification.net_file import load_net
from brokk_min.learning.episodes import GRADIENT_LEARNER, PAPER_TASK
from brokk_min.learning.policy import load_policy
from brokk_min.machine import Machine, number


@dataclass(frozen=True)
class TaskSettings(TaskConfig):
    """What an episode is."""

    integral_cost: Annotated[float, arg(aliases=["--lag-cost"])] = TaskConfig.integral_cost
    """Cost of the error integral [1/m] (paper: 0)."""

    def __post_init__(self) -> None:
        """Leave the check to `Training.prepare`."""


@dataclass(frozen=True)
class LearnerSettings:
    """The learner."""

    total_steps: int = 6_000_000  # Environment steps in all.
    num_envs: int = 256  # Environments side by side (paper: 256).
    horizon: int = 32  # Ticks of each environment between two updates.
    epochs: int = 2  # Passes over the collected steps in each update.
    minibatch_size: int = 2048  # Steps in one gradient.
    learning_rate: float = 1.2e-3  # Of Adam, at most; falls to zero.
    target_kl: float = 0.03  # KL divergence that keeps the learning rate.
    gamma: float = 0.9  # Discount a tick: 0.9 looks 10 ticks ahead.
    gae_lambda: float = 0.95  # Weight of longer returns in the advantage.
    clip: float = 0.2  # Largest rewarded change of a probability ratio.
    entropy: float = 0.0  # Coefficient of the entropy bonus.
    max_grad_norm: float = 1.0  # Gradients are scaled down to this norm.
    log_std: float = -1.2  # Log of the actions' deviation at the start.
    log_std_end: float | None = None  # At the end, linear; None: learned.
    checkpoint_every: int = 50  # Updates between two checkpoints.
    threads: int = 1  # Of torch; several wait in vain on busy cores.


@dataclass(kw_only=True)
class Training(Command):
    """Options of trainings."""

    actuator: Path  # Nets that `fit` wrote.
    critic: bool = False  # Advantages by a critic (as --paper), not by derivatives of the nets.
    settings: OmitArgPrefixes[LearnerSettings] = field(default_factory=LearnerSettings)
    task: OmitArgPrefixes[TaskSettings] = field(default_factory=TaskSettings)

    def prepare(self, machine: Machine) -> tuple[ActuatorNet, TaskConfig, Any]:
        """Nets, task and `PPOConfig` of a training; WrongUse: a setting out of its range."""
        from brokk_min.ppo import PPOConfig

        task = checked(TaskConfig, **vars(self.task))
        for name in ("valves", "valve_cost", "integral_cost", "limit_cost") if task.paper else ():
            if getattr(task, name) != getattr(TaskConfig, name):
                option = f"--{name.replace('_', '-')}"
                raise WrongUse(f"{option}: expected none with --paper, got {getattr(task, name)}")
        config = checked(PPOConfig, **vars(self.settings))
        return load_net(self.actuator, machine), task, config


@dataclass(kw_only=True)
class Train(Training):
    """Train a policy on the nets: by gradients of the simulation, or with PPO and a critic."""

    out: Path  # Policy to write, .npz.
    resume: bool = False  # Go on from OUT.checkpoint; the end is the same as without the break.
    start: Path | None = None  # Policy to begin with, for nets that were fitted to its drives, too.
    tensorboard: Path | None = None  # Folder for TensorBoard (extra `tensorboard`).

    def __call__(self) -> None:
        from brokk_min.learning.checkpoint import train_policy

        machine = self.check({Path(f"{self.out}.csv"): "curve"}, out="policy")
        checkpoint = Path(f"{self.out}.checkpoint")
        if self.resume and self.out.exists() and not checkpoint.exists():
            raise WrongUse(f"--resume: expected {checkpoint}, got none: {self.out} is finished")
        net, task, config = self.prepare(machine)
        start = load_policy(self.start, machine) if self.start else None
        files = (self.out, self.critic, self.resume, self.tensorboard, start)
        train_policy(machine, net, task, config, self.seed, *files)
        print(f"{self.out}: trained for {config.total_steps} steps; curve in {self.out}.csv")


@dataclass(kw_only=True)
class Sweep(Training):
    """Train and evaluate many seeds, one thread each; finished seeds are not run again."""

    out: Path  # Folder for a policy, a curve and figures of each seed, and sweep.json.
    seeds: int = number("1", 1, 10_000, 10)  # How many, from --seed on.
    poses: int = number("1", 1, 1000, 16)  # Start poses for each scored sequence.
    scheduler: str | None = None  # tcp://... of dask (extra `sweep`); its workers must see OUT.
    gains: Path | None = None  # Tuned gains that `reproduce` wrote, to compare with the baselines.

    def __call__(self) -> None:
        from brokk_min.evaluation.seeds import show, sweep

        machine = self.check({self.out / "sweep.json": "sweep"})
        net, task, config = self.prepare(machine)
        seeds = range(self.seed, self.seed + self.seeds)
        options = (self.poses, self.scheduler, self.gains, self.critic)
        print(show(sweep(machine, net, task, config, seeds, self.out, *options)))


def with_defaults(command: type[Training], arguments: Sequence[str]) -> Callable[..., Training]:
    """A command with the defaults of the learner that its arguments name."""
    by_gradients = not {"--critic", "--paper"} & set(arguments)
    settings = LearnerSettings(**(GRADIENT_LEARNER if by_gradients else {}))
    task = TaskSettings(**(PAPER_TASK if "--paper" in arguments else {}))
    return partial(command, settings=settings, task=task)
