"""Settings of fits, trainings and tasks as options, each with its range.

They repeat the fields of `fitting.FitConfig`, `ppo.PPOConfig` and `env.TaskConfig`, which know no
command line: help must not wait for torch, which two of those modules import. A test compares them.
"""

from dataclasses import dataclass
from typing import Annotated, Literal

import tyro

from brokk_min.cli.options import Range, WrongUse
from brokk_min.env import TaskConfig

Count = Annotated[int, Range(1, 1e6)]
Steps = Annotated[int, Range(1, 1e12)]
Samples = Annotated[int, Range(2, 1e7)]
Rate = Annotated[float, Range(1e-9, 1)]
Bound = Annotated[float, Range(1e-9, 1e9)]
Fraction = Annotated[float, Range(0, 1)]
Cost = Annotated[float, Range(0, 1000)]
Duration = Annotated[float, Range(0, 1e6)]


@dataclass(frozen=True)
class FitSettings:
    """How the nets are fitted."""

    steps: Steps = 16000  # Adam steps.
    batch_size: Count = 512  # Windows per joint in each step.
    learning_rate: Rate = 4e-3  # Of Adam at the start; falls along a cosine.
    noise: Cost = 0.1  # Of the velocity inputs, in their standard deviations (paper: 0).
    hidden: Count = 32  # Units in each of the two hidden layers (paper: 32).
    history: Samples = 13  # Samples of angle, velocity and command at the inputs (paper: 13).
    rollout: Count = 8  # Ticks of free runs in the last third of the steps (paper: 1).
    dead_zone: Annotated[float | None, Range(0, 0.99)] = None
    """Command within which no valve opens; by default the known machine's, else 0 (paper: 0)."""


@dataclass(frozen=True)
class LearnerSettings:
    """The learner."""

    total_steps: Steps = 6_000_000  # Environment steps in all.
    num_envs: Count = 256  # Environments side by side (paper: 256).
    horizon: Count = 32  # Ticks of every environment between two updates.
    epochs: Count = 4  # Passes over the collected steps in each update.
    minibatch_size: Samples = 2048  # Steps in one gradient.
    learning_rate: Rate = 4e-3  # Of Adam, at most; falls to zero, less after a large KL.
    target_kl: Bound = 0.3  # KL divergence of an update that leaves the learning rate as it is.
    gamma: Annotated[float, Range(0, 0.9999)] = 0.95  # Discount per tick.
    gae_lambda: Fraction = 0.95  # Weight of longer returns in the advantage.
    clip: Bound = 0.2  # Largest rewarded change of a probability ratio.
    entropy: Cost = 0.0  # Coefficient of the entropy bonus.
    max_grad_norm: Bound = 1.0  # Gradients are scaled down to this norm.
    log_std: Annotated[float, Range(-10, 3)] = -1.8  # Log of the actions' std at the start.
    log_std_end: Annotated[float | None, Range(-10, 3)] = -4.5
    """The same at the end, linear between; None: learned."""
    checkpoint_every: Steps = 50  # Updates between two checkpoints.
    threads: Count = 2  # Threads of torch; the last bits depend on it.


@dataclass(frozen=True)
class TaskSettings:
    """What an episode is."""

    episode_s: Annotated[float, Range(0.05, 1e6)] = 20.0  # Length of an episode [s].
    hold_min_s: Duration = 0.5  # Shortest time for which a velocity goal holds [s].
    hold_max_s: Duration = 3.0  # Longest time for which a velocity goal holds [s].
    zero_goals: Fraction = 0.15  # Fraction of goals of zero velocity.
    axis_goals: Fraction = 0.4  # Fraction of goals along x, y or z; the others point anywhere.
    noise: Cost = 0.05  # Largest sensor noise, in deviations (paper: 5 %).
    valve_cost: Cost = 0.05  # Cost of a change of all commands by their limit (paper: 0).
    integral_cost: Annotated[Cost, tyro.conf.arg(aliases=["--lag-cost"])] = 1.0
    """Cost of the error integral [1/m] (paper: 0)."""
    valves: Literal["closed", "open"] = "closed"  # While the tool rests.
    redraw_ground: bool = True  # Redraw start poses in the ground; the paper ends the episode.
    paper: bool = False  # Observation, reward and critic as the paper has them.

    def config(self) -> TaskConfig:
        """The task; WrongUse: a shortest time above the longest."""
        if self.hold_min_s > self.hold_max_s:
            raise WrongUse(f"--hold-max-s: expected --hold-min-s or more, got {self.hold_max_s}")
        return TaskConfig(**vars(self))
