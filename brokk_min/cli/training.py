"""The commands that train."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from tyro.conf import OmitArgPrefixes

from brokk_min._files import SHIPPED, require_package
from brokk_min.actuator import ActuatorNet
from brokk_min.cli.evaluation import table
from brokk_min.cli.options import Command, check, check_settings
from brokk_min.evaluation import baselines, metrics, sequences
from brokk_min.identification.net_file import load_net
from brokk_min.learning.policy import load_policy
from brokk_min.learning.recipes import Recipe, find_recipe
from brokk_min.machine import BROKK_170, Controller, Machine
from brokk_min.settings import PPOConfig, TaskConfig

FIRST_STEPS = 400_000  # of our agent, of the five million of its recipe
STARTS = 4  # for the table at the end
LARGEST = 2**22  # steps between two updates, assumed: more would fill the memory


@dataclass(kw_only=True)
class Training(Command):
    """Options of trainings."""

    actuator: Path | None = None  # Nets that `fit` wrote; by default those of the package.
    paper: bool = False  # The paper's agent: its observation, actions and reward.
    critic: bool = False  # Advantages by a critic, as in the paper, not by groups of rollouts.
    seed: int = 0  # Of the weights, episodes and noise.
    learner: OmitArgPrefixes[PPOConfig]
    task: OmitArgPrefixes[TaskConfig]

    @classmethod
    def defaults(cls, options: list[str]) -> Any:
        """The settings of the agent that the options name."""
        recipe = find_recipe("--paper" in options, "--critic" in options)
        return cls(learner=recipe.learner, task=recipe.task)

    def find_net(self, machine: Machine) -> ActuatorNet:
        """The nets to learn on."""
        if self.actuator:
            return load_net(self.actuator, machine)
        shipped = SHIPPED / machine.name / "policy.npz"
        check(shipped.exists(), "--actuator", f"nets of {machine.name}", "none")
        return load_policy(shipped, machine).net

    def recipe(self, machine: Machine) -> Recipe:
        """The agent, its learner and its task."""
        require_package("torch", "train")
        learner, task = self.learner, self.task
        check_settings(learner)
        check_settings(task)
        check(learner.gamma < 1, "--gamma", "below 1", learner.gamma)
        shortest, longest = task.hold_min_s, task.hold_max_s
        check(shortest <= longest, "--hold-max-s", f"{shortest} or more", longest)
        steps = learner.num_envs * learner.horizon
        check(steps <= LARGEST, "--num-envs, --horizon", f"a product up to {LARGEST:,}", steps)
        tick = machine.dt
        check(task.episode_s >= tick, "--episode-s", f"a tick, {tick:g} s, or more", task.episode_s)
        return replace(find_recipe(self.paper, self.critic), task=task, learner=learner)


@dataclass(kw_only=True)
class Train(Training):
    """Train a policy by PPO, half a minute long; --total-steps 5000000 is our agent to its end."""

    out: Path = Path("policy.npz")  # Policy to write; its curve and checkpoint lie beside it.
    resume: bool = False  # Go on from OUT.checkpoint; the end is the same as without the break.

    @classmethod
    def defaults(cls, options: list[str]) -> Any:
        """A first training of our agent is short."""
        made = super().defaults(options)
        if not {"--paper", "--critic"} & {*options}:
            made.learner = replace(made.learner, total_steps=FIRST_STEPS)
        return made

    def __call__(self, machine: Machine) -> None:
        recipe = self.recipe(machine)
        from brokk_min.learning.checkpoint import train_policy

        checkpoint = Path(f"{self.out}.checkpoint")
        empty = checkpoint.exists() and not checkpoint.stat().st_size
        got = "an empty checkpoint: one runs, or was killed before its first (then remove the file)"
        check(not empty, str(checkpoint), "no training with this name", got)
        begun = checkpoint.exists() and not self.resume
        check(not begun, str(checkpoint), "--resume or no checkpoint", "one")
        lacks = self.resume and not checkpoint.exists()
        check(not lacks, str(checkpoint), "one to --resume from", "none: ended, or not begun")
        self.writes(self.out, None if self.resume else Path(f"{self.out}.csv"))
        commands = sequences.axis_sequences(machine)
        starts = sequences.evaluation_starts(machine, STARTS, commands, 0)  # can it follow any?
        try:
            checkpoint.touch(exist_ok=self.resume)  # the name is taken, for other trainings
        except FileExistsError:
            check(False, str(checkpoint), "--resume or no checkpoint", "one")
        try:
            net, look = self.find_net(machine), None
            if machine == BROKK_170:  # the package has PIDs of it
                pids = baselines.load_pids(machine, SHIPPED / machine.name / "gains.json", net)
                look = baselines.beside_pids(machine, pids)
            policy = train_policy(machine, net, recipe, self.seed, self.out, look)
        finally:
            if checkpoint.exists() and not checkpoint.stat().st_size:  # nothing is learned yet
                checkpoint.unlink()
        if machine == BROKK_170:
            rivals: dict[str, Controller] = {policy.name: policy, **pids}
            runs, _ = metrics.evaluate(machine, rivals, commands, starts, self.seed)
            print(table(runs))
        hint = f"--policy {self.out}"
        if machine != BROKK_170:
            hint += f" --machine {self.machine}"
        curve = f"curve, as it explores on the nets, in {self.out}.csv"
        print(f"{self.out}: trained; {curve}; `brokk-min play {hint}`")


@dataclass(kw_only=True)
class Sweep(Training):
    """Train and evaluate many seeds, one process each; finished seeds are not run again."""

    out: Path = Path("sweep")  # Folder to write policies, their curves and sweep.json to.
    seeds: int = 10  # How many, from --seed on.
    scheduler: str | None = None  # tcp://... of dask; its workers must see OUT. None: this machine.
    num_starts: int = 16  # Start poses for each scored sequence.
    robustness: Path | None = None  # Also on changed machines, beside this folder's controllers.

    def __call__(self, machine: Machine) -> None:
        recipe = self.recipe(machine)
        from brokk_min.evaluation.metrics import COLUMNS, interval_text
        from brokk_min.evaluation.sweep import sweep

        check(self.seeds > 0, "--seeds", "1 or more", self.seeds)
        file = self.out / "sweep.json"  # one that goes on has policies beside it
        free = self.force or not file.exists() or any(self.out.glob("seed_*.npz"))
        check(free, str(file), "no file (or --force)", "one that `sweep` did not write")
        seeds = range(self.seed, self.seed + self.seeds)
        task = machine, self.find_net(machine), recipe, seeds, self.out, self.num_starts
        table = sweep(*task, self.scheduler, self.robustness)
        print("mean over seeds (95 % interval)")
        print("\n".join(f"{key:24} {interval_text(table['all'][key])}" for key in COLUMNS))
