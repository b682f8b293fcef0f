"""Settings of fits, trainings and tasks as options.

The configurations check themselves when a command makes them: a value out of its range is then
one line. `PPOConfig` is repeated, since its module imports torch, for which help must not wait.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated, Any, TypeVar

import tyro

from brokk_min.cli.options import WrongUse
from brokk_min.env import TaskConfig
from brokk_min.identification.fit_config import FitConfig
from brokk_min.learning.episodes import GRADIENT_LEARNER, PAPER_TASK

T = TypeVar("T")


def make_config(kind: Callable[..., T], options: dict[str, Any]) -> T:
    """A configuration of the values of options; WrongUse: one that is out of its range."""
    try:
        return kind(**options)
    except ValueError as error:
        name, _, text = str(error).partition(": ")
        raise WrongUse(f"--{name.replace('_', '-')}: {text}") from error


@dataclass(frozen=True)
class FitSettings(FitConfig):
    """How the nets are fitted."""

    history: int | None = None  # type: ignore[assignment]
    """Samples of angle, velocity and command (paper: 13); by default the machine's."""

    def __post_init__(self) -> None:
        """Leave the check to `make_config`."""


@dataclass(frozen=True)
class TaskSettings(TaskConfig):
    """What an episode is."""

    integral_cost: Annotated[float, tyro.conf.arg(aliases=["--lag-cost"])] = (
        TaskConfig.integral_cost
    )
    """Cost of the error integral [1/m] (paper: 0)."""

    def __post_init__(self) -> None:
        """Leave the check to `make_config`."""


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
    gamma: float = 0.8  # Discount a tick: 0.8 looks 5 ticks ahead.
    gae_lambda: float = 0.95  # Weight of longer returns in the advantage.
    clip: float = 0.2  # Largest rewarded change of a probability ratio.
    entropy: float = 0.0  # Coefficient of the entropy bonus.
    max_grad_norm: float = 1.0  # Gradients are scaled down to this norm.
    log_std: float = -1.2  # Log of the actions' deviation at the start.
    log_std_end: float | None = None  # At the end, linear; None: learned.
    checkpoint_every: int = 50  # Updates between two checkpoints.
    threads: int = 1  # Of torch; several wait in vain on busy cores.


@dataclass(kw_only=True)
class GradientDefaults:
    """Options of trainings by gradients of the simulation: their own defaults."""

    settings: tyro.conf.OmitArgPrefixes[LearnerSettings] = field(
        default_factory=lambda: LearnerSettings(**GRADIENT_LEARNER)
    )


@dataclass(kw_only=True)
class PaperDefaults:
    """Options of trainings with --paper: its own defaults."""

    task: tyro.conf.OmitArgPrefixes[TaskSettings] = field(
        default_factory=lambda: TaskSettings(**PAPER_TASK)
    )
