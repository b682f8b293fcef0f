"""The commands that train."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import tyro
from tyro.conf import OmitArgPrefixes

from brokk_min._files import require_package
from brokk_min.cli.options import Command, check, check_settings
from brokk_min.identification.net_file import load_net
from brokk_min.learning.recipes import Recipe, find_recipe
from brokk_min.machine import Machine
from brokk_min.settings import PPOConfig, TaskConfig


@dataclass(kw_only=True)
class Training(Command):
    """Options of trainings."""

    actuator: Path  # Nets that `fit` wrote.
    out: Path  # Policy to write, .npz; its curve and checkpoint lie beside it.
    paper: bool = False  # The paper's agent: its observation, actions and reward.
    critic: bool = False  # Advantages by a critic, as in the paper, not by groups of rollouts.
    seed: int = 0  # Of the weights, episodes and noise.
    learner: OmitArgPrefixes[PPOConfig]
    task: OmitArgPrefixes[TaskConfig]

    @classmethod
    def defaults(cls, options: list[str]) -> Any:
        """The settings of the agent that the options name."""
        recipe = find_recipe("--paper" in options, "--critic" in options)
        required: Any = tyro.MISSING
        return cls(actuator=required, out=required, learner=recipe.learner, task=recipe.task)

    def recipe(self) -> Recipe:
        """The agent, its learner and its task."""
        require_package("torch", "train")
        check(self.seed >= 0, "--seed", "0 or more", self.seed)
        learner, task = self.learner, self.task
        check_settings(learner)
        check_settings(task)
        check(learner.gamma < 1, "--gamma", "below 1", learner.gamma)
        shortest, longest = task.hold_min_s, task.hold_max_s
        check(shortest <= longest, "--hold-max-s", f"{shortest} or more", longest)
        return replace(find_recipe(self.paper, self.critic), task=task, learner=learner)


@dataclass(kw_only=True)
class Train(Training):
    """Train a policy on the nets by PPO."""

    resume: bool = False  # Go on from OUT.checkpoint; the end is the same as without the break.

    def __call__(self, machine: Machine) -> None:
        recipe = self.recipe()
        from brokk_min.learning.checkpoint import train_policy

        self.writes(self.out)
        checkpoint = Path(f"{self.out}.checkpoint")
        try:
            checkpoint.touch(exist_ok=self.resume)  # the name is taken, for other trainings
        except FileExistsError:
            check(False, str(checkpoint), "--resume or no checkpoint", "one")
        try:
            train_policy(machine, load_net(self.actuator, machine), recipe, self.seed, self.out)
        finally:
            if checkpoint.exists() and not checkpoint.stat().st_size:  # nothing is learned yet
                checkpoint.unlink()
        print(f"{self.out}: trained; curve in {self.out}.csv")


@dataclass(kw_only=True)
class Sweep(Training):
    """Train and evaluate many seeds, one process each; finished seeds are not run again."""

    out: Path  # Folder to write policies, their curves and sweep.json to.
    seeds: int = 10  # How many, from --seed on.
    scheduler: str | None = None  # tcp://... of dask; its workers must see OUT. None: this machine.
    num_starts: int = 16  # Start poses for each scored sequence.
    robustness: Path | None = None  # Also on changed machines, beside this folder's controllers.

    def __call__(self, machine: Machine) -> None:
        recipe = self.recipe()
        from brokk_min.evaluation.metrics import COLUMNS, interval_text
        from brokk_min.evaluation.sweep import sweep

        check(self.seeds > 0, "--seeds", "1 or more", self.seeds)
        check(self.num_starts > 0, "--num-starts", "1 or more", self.num_starts)
        seeds = range(self.seed, self.seed + self.seeds)
        net = load_net(self.actuator, machine)
        task = machine, net, recipe, seeds, self.out, self.num_starts
        table = sweep(*task, self.scheduler, self.robustness)
        print("mean over seeds (95 % interval)")
        print("\n".join(f"{key:24} {interval_text(table['all'][key])}" for key in COLUMNS))
