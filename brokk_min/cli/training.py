"""The commands that train."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tyro.conf import OmitArgPrefixes

from brokk_min.beyond.gradient_config import GradientConfig
from brokk_min.cli.options import Command, check
from brokk_min.identification.net_file import load_net
from brokk_min.learning.recipes import Recipe, paper_recipe
from brokk_min.settings import PPOConfig, TaskConfig


@dataclass(kw_only=True)
class Training(Command):
    """Options of trainings."""

    actuator: Path  # Nets that `fit` wrote.
    out: Path  # Policy to write, .npz; its curve and checkpoint lie beside it.
    paper: bool = False  # The paper's agent, by PPO with a critic.
    seed: int = 0  # Of the weights, episodes and noise.

    @classmethod
    def variant(cls, arguments: list[str]) -> type[Command]:
        """The command with the settings of the learner that its arguments name."""
        return PAPER[cls] if "--paper" in arguments else cls

    def recipe(self) -> Recipe:
        """The agent and its learner."""
        options: Any = self
        learner, task = options.learner, options.task
        check(learner.total_steps > 0, "--total-steps", "1 or more", learner.total_steps)
        check(0 <= learner.gamma < 1, "--gamma", "0 to below 1", learner.gamma)
        fits = 0 < task.hold_min_s <= task.hold_max_s
        check(fits, "--hold-max-s", f"{task.hold_min_s} or more", task.hold_max_s)
        return Recipe("paper" if self.paper else "beyond", task, learner)


@dataclass(kw_only=True)
class Train(Training):
    """Train a policy on the nets, by derivatives of the simulation (beyond/simulation_gradient)."""

    resume: bool = False  # Go on from OUT.checkpoint; the end is the same as without the break.
    learner: OmitArgPrefixes[GradientConfig] = field(default_factory=GradientConfig)
    task: OmitArgPrefixes[TaskConfig] = field(default_factory=lambda: Recipe().task)

    def __call__(self) -> None:
        from brokk_min.learning.checkpoint import train_policy

        machine, recipe = self.find_machine(), self.recipe()
        self.writes(self.out)
        net = load_net(self.actuator, machine)
        train_policy(machine, net, recipe, self.seed, self.out, self.resume)
        print(
            f"{self.out}: trained for {recipe.learner.total_steps} steps; curve in {self.out}.csv"
        )


@dataclass(kw_only=True)
class TrainPaper(Train):
    """Train the paper's agent by PPO with a critic."""

    learner: OmitArgPrefixes[PPOConfig] = field(default_factory=PPOConfig)  # type: ignore[assignment]
    task: OmitArgPrefixes[TaskConfig] = field(default_factory=lambda: paper_recipe().task)


@dataclass(kw_only=True)
class Sweep(Training):
    """Train and evaluate many seeds, one process each; finished seeds are not run again."""

    seeds: int = 10  # How many, from --seed on.
    scheduler: str | None = None  # tcp://... of dask; its workers must see OUT. None: this machine.
    num_starts: int = 16  # Start poses for each scored sequence.
    learner: OmitArgPrefixes[GradientConfig] = field(default_factory=GradientConfig)
    task: OmitArgPrefixes[TaskConfig] = field(default_factory=lambda: Recipe().task)

    def __call__(self) -> None:
        from brokk_min.evaluation.sweep import show, sweep

        machine, recipe = self.find_machine(), self.recipe()
        check(self.seeds > 0, "--seeds", "1 or more", self.seeds)
        seeds = range(self.seed, self.seed + self.seeds)
        net = load_net(self.actuator, machine)
        print(show(sweep(machine, net, recipe, seeds, self.out, self.num_starts, self.scheduler)))


@dataclass(kw_only=True)
class SweepPaper(Sweep):
    """Train and evaluate many seeds of the paper's agent."""

    learner: OmitArgPrefixes[PPOConfig] = field(default_factory=PPOConfig)  # type: ignore[assignment]
    task: OmitArgPrefixes[TaskConfig] = field(default_factory=lambda: paper_recipe().task)


PAPER: dict[type[Training], type[Command]] = {Train: TrainPaper, Sweep: SweepPaper}
