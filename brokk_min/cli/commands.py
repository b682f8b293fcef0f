"""The commands of the method: from logs to nets, policies, comparisons and the report."""

import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro

from brokk_min.actuator import ActuatorNet, select_nets
from brokk_min.cli.options import Command, Name, WrongUse, check, chosen_policy
from brokk_min.env import TaskConfig
from brokk_min.evaluation import baselines, experiments, figures, metrics, preliminary
from brokk_min.evaluation import reproduce as chain
from brokk_min.evaluation.metrics import summary
from brokk_min.evaluation.perfect_model import perfect_models
from brokk_min.evaluation.report import VERDICTS
from brokk_min.evaluation.rollout import Controller
from brokk_min.evaluation.sequences import (
    draw_starts,
    goals_and_starts,
    task_sequences,
    write_starts,
)
from brokk_min.identification import validation
from brokk_min.identification.excitation import collect
from brokk_min.identification.files import write_json
from brokk_min.identification.fitting import PAPER_RECIPE, FitConfig, fit
from brokk_min.identification.logs import Log, read_log, write_log
from brokk_min.identification.net_file import load_net, save_net
from brokk_min.learning.policy import PolicyController, load_policy
from brokk_min.machine import BROKK_170, Machine


@dataclass(kw_only=True)
class Collect(Command):
    """Record the machine (the analytic plant) under excitation."""

    out: Path  # Log to write, .csv or .npz.
    hours: float = 1.0  # Driving time for each actuator [h].
    excitation: Literal["sine", "rich"] = "rich"  # The paper's sines, or steps and holds too.

    def run(self) -> None:
        """Write the log."""
        machine = check(self, self.out)
        if self.out.suffix not in (".csv", ".npz"):
            raise WrongUse(f"--out: expected a name ending in .csv or .npz, got {self.out}")
        log = collect(machine, self.hours, self.excitation, np.random.default_rng(self.seed))
        write_log(self.out, log)
        print(f"{self.out}: {len(log.recordings)} recordings of {', '.join(log.joints)}")


@dataclass(kw_only=True)
class Fit:
    """Fit one net a joint to the log of any machine and score it on recordings it never saw."""

    logs: tyro.conf.Positional[tuple[Path, ...]]  # Logs of one machine, .csv or .npz.
    out: Path  # Nets to write, .npz.
    test: tuple[
        Path, ...
    ] = ()  # Logs to score on; without them every tenth recording of LOGS is held out.
    json: Path | None = None  # Also write the scores here.
    figure: Path | None = (
        None  # Also draw free runs of the worst and the median recording here, .png.
    )
    machine: Name = (
        ""  # Whose nets, at its rate; by default the Brokk's if its joints are those of LOGS.
    )
    velocity_samples: int = BROKK_170.velocity_samples  # Window of the velocity estimator.
    paper: bool = (
        False  # The paper's own recipe: errors of one step alone, no noise, commands as they are.
    )
    settings: tyro.conf.OmitArgPrefixes[FitConfig] = field(default_factory=FitConfig)  # The fit.
    seed: int = 0  # Of everything random.

    def run(self) -> None:
        """Fit, judge, write."""
        if not self.logs:
            raise WrongUse("LOGS: expected at least one log, got none")
        machine = check(self, self.out, self.json, self.figure)
        if self.velocity_samples > self.settings.history:
            raise WrongUse(
                f"--velocity-samples: expected at most --history, got {self.velocity_samples}"
            )
        log = read_log(self.logs, self.velocity_samples, rate=machine.rate)
        unseen = (self.test, self.velocity_samples, log.joints, log.rate)
        log, test = (log, read_log(*unseen)) if self.test else split(log)
        known = machine if machine.names == log.joints else None
        if self.machine and not known:
            raise ValueError(
                f"LOGS: expected joints of --machine {self.machine}, got {list(log.joints)}"
            )
        net = fit(
            log, self._recipe(known), self.seed, self.velocity_samples, known.name if known else ""
        )
        verdict = validation.validate(net, log, test, known)
        save_net(self.out, net)
        if self.json:
            meta: dict[str, Any] = {"seed": self.seed, "rate": net.rate, "history": net.history}
            meta |= {"machine": net.machine, "dead_zone": net.dead_zone}
            meta |= {"logs": [str(p) for p in self.logs], "test": [str(p) for p in self.test]}
            write_json(self.json, {"meta": meta, **verdict})
        if self.figure:
            figures.save(self.figure, figures.plot_worst_and_median(net, test))
        print(
            f"nets of {net.machine or 'no known machine'}, dead zone {net.dead_zone} of full command"
        )
        _print_verdict(verdict)

    def _recipe(self, known: Machine | None) -> FitConfig:
        """The settings, by default with the known machine's dead zone; or the paper's."""
        if self.paper:
            return replace(self.settings, **PAPER_RECIPE)
        if known and self.settings.dead_zone is None:
            return replace(self.settings, dead_zone=known.dead_zone)
        return self.settings


def _print_verdict(verdict: dict[str, Any]) -> None:
    """Scores of the nets, of the linear model below them, and what speaks against the nets."""
    row = "{:12} {:>9} {:>13}  {:30} {}"
    print(
        row.format(
            "joint", "one step", "same as last", "free run of 1, 5, 10, 30 s", "creep [rad/s]"
        )
    )
    for name, s in verdict["joints"].items():
        for label, scores in ((name, s), ("  linear", s["linear"])):
            free = ", ".join(f"{run['velocity_rmse']:.4f}" for run in scores["free_run"].values())
            steps = (
                f"{scores.get(key, np.nan):.4f}" for key in ("one_step_rmse", "persistence_rmse")
            )
            print(row.format(label, *steps, free, f"{s['creep']:.5f}" if label == name else ""))
    for warning in verdict["warnings"]:
        print(f"warning: {warning}")


def split(log: Log) -> tuple[Log, Log]:
    """Recordings to fit to, and every tenth, whole, to score on; a single one cannot be split."""
    if len(log.recordings) < 2:
        raise ValueError("LOGS: expected two or more recordings, or --test, to score on; got one")
    kept = tuple(recording for i, recording in enumerate(log.recordings) if i % 10)
    return log._replace(recordings=kept), log._replace(recordings=log.recordings[::10])


def train_command() -> Any:
    """The command `train`; made on demand, because its settings live beside torch."""
    from brokk_min.learning.checkpoint import train_policy
    from brokk_min.ppo import PPOConfig

    @dataclass(kw_only=True)
    class Train(Command):
        """Train a policy on nets with PPO."""

        actuator: Path  # Nets that `fit` wrote.
        out: Path  # Policy to write, .npz.
        resume: bool = False  # Take up OUT.checkpoint; the end is the same as without the break.
        critic: bool = (
            False  # Advantages by a critic, as under --paper, not by the nets' derivatives.
        )
        tensorboard: Path | None = None  # Folder for TensorBoard (extra `tensorboard`).
        settings: tyro.conf.OmitArgPrefixes[PPOConfig] = field(
            default_factory=PPOConfig
        )  # The learner.
        task: tyro.conf.OmitArgPrefixes[TaskConfig] = field(
            default_factory=TaskConfig
        )  # What an episode is.

        def run(self) -> None:
            """Train and write the policy."""
            machine = check(self, self.out)
            net = select_nets(machine, load_net(self.actuator))
            train_policy(
                machine,
                net,
                self.task,
                self.settings,
                self.seed,
                self.out,
                self.critic,
                self.resume,
                self.tensorboard,
            )
            print(
                f"{self.out}: trained for {self.settings.total_steps} steps; curve in {self.out}.csv"
            )

    return Train


def sweep_command() -> Any:
    """The command `sweep`; made on demand as `train`."""
    from brokk_min.evaluation.seeds import show, sweep
    from brokk_min.ppo import PPOConfig

    @dataclass(kw_only=True)
    class Sweep(Command):
        """Train and evaluate many seeds on all cores or a cluster; finished seeds are not run again."""

        actuator: Path  # Nets that `fit` wrote.
        out: Path  # Folder for a policy, a curve and figures of each seed, and sweep.json.
        seeds: int = 10  # How many, from --seed on.
        poses: int = 16  # Start poses for each scored sequence, half of them of the workspace.
        scheduler: str | None = (
            None  # tcp://... of a dask scheduler (extra `sweep`); OUT must be shared.
        )
        gains: Path | None = None  # Tuned gains that `reproduce` wrote: baselines beside.
        settings: tyro.conf.OmitArgPrefixes[PPOConfig] = field(default_factory=PPOConfig)
        """The learner; each seed runs on one thread, whatever --threads says."""
        task: tyro.conf.OmitArgPrefixes[TaskConfig] = field(
            default_factory=TaskConfig
        )  # What an episode is.

        def run(self) -> None:
            """Sweep and print the table."""
            machine = check(self)
            net = select_nets(machine, load_net(self.actuator))
            seeds = range(self.seed, self.seed + self.seeds)
            of, how = self.settings, (self.poses, self.scheduler, self.gains)
            print(show(sweep(machine, net, self.task, of, seeds, self.out, *how)))

    return Sweep


@dataclass(kw_only=True)
class Starts(Command):
    """Draw start poses for `evaluate`: across the workspace, near joint limits, near full extension."""

    out: Path  # Poses to write, .csv.
    num: int = 64  # How many.
    seed: int = 2  # Of the poses.

    def run(self) -> None:
        """Draw and write."""
        machine, rng = check(self, self.out), np.random.default_rng(self.seed)
        write_starts(
            self.out, machine, draw_starts(machine, task_sequences(machine), self.num, rng)
        )
        print(f"{self.out}: {self.num} start poses")


@dataclass(kw_only=True)
class Evaluate(Command):
    """Policy and tuned baselines on the same sequences and starts."""

    policy: Path | None = None
    """Policy that `train` wrote; by default the one that comes with the package."""
    commands: Path | None = None  # Velocity sequences, CSV: sequence,time,vx,vy,vz [s, m/s].
    starts: Path | None = None  # Start poses, CSV: one column a joint [rad].
    plant: Literal["analytic", "net"] = "analytic"  # What moves: the analytic plant or the nets.
    json: Path | None = None  # Also write all runs here.
    gains: Path | None = None  # Tuned gains; by default gains.json beside POLICY.
    num_starts: int = 16  # Without --starts: so many of the machine's start poses.
    perfect_model: bool = False  # Also the bound: a controller that knows the plant (minutes).

    def run(self) -> None:
        """Evaluate and print the means."""
        machine = check(self, self.json)
        if self.perfect_model and self.plant == "net":
            raise WrongUse(
                "--perfect-model: expected --plant analytic, the plant that it knows, got net"
            )
        path, gains = chosen_policy(machine, self.policy, self.gains)
        policy = load_policy(path, machine)
        sequences, starts = goals_and_starts(
            machine, self.commands, self.starts, self.num_starts, self.seed
        )
        print(f"gains of the baselines: {gains or 'tuned now'}", file=sys.stderr)
        controllers: dict[str, Controller] = {"rl": PolicyController(machine, policy)}
        controllers |= self._baselines(machine, policy.net, gains)
        if self.perfect_model:
            controllers |= perfect_models(machine, starts)
        moves = policy.net if self.plant == "net" else None
        runs, _ = metrics.evaluate(machine, controllers, sequences, starts, self.seed, moves)
        if self.json:
            meta = metrics.metadata(machine, self.seed)
            meta |= {"policy": str(path), "gains": str(gains or "tuned now"), "plant": self.plant}
            names = ", ".join(sequence.name for sequence in sequences)
            meta |= {
                "commands": str(self.commands or names),
                "starts": str(self.starts or self.num_starts),
            }
            write_json(self.json, {"meta": meta, "runs": runs})
        _print_means(runs, len(sequences))

    def _baselines(
        self, machine: Machine, net: ActuatorNet, gains: Path | None
    ) -> Mapping[str, Controller]:
        if gains:
            return baselines.read_gains(gains, machine, net)
        runs, generations = baselines.TUNING_RUNS, baselines.GENERATIONS
        return baselines.tune_baselines(machine, net, runs, generations, self.seed)[0]


def _print_means(runs: list[dict[str, Any]], sequences: int) -> None:
    """Means of all figures by kind of start and controller."""
    for kind in dict.fromkeys(run["kind"] for run in runs):
        mine = [run for run in runs if run["kind"] == kind]
        num = len({run["start"] for run in mine})
        print(f"{kind} starts ({num}), means over {sequences} sequences")
        for name, rows in summary(mine).items():
            cells = (
                f"{k} {'none' if v is None else format(v, '.4f')}" for k, v in rows["all"].items()
            )
            print(f"  {name:22} " + ", ".join(cells))


@dataclass(kw_only=True)
class Reproduce(Command):
    """The whole chain: logs, nets, policy, baselines, comparison, report.html and results.json."""

    out: Path = Path("results")  # Folder for everything.
    quick: bool = False  # The same, smaller: to see that it runs, not to judge the policy.
    sweep: Path | None = (
        None  # sweep.json of a sweep on these nets: intervals over its seeds in the report.
    )

    def run(self) -> None:
        """Run the chain and print the means."""
        effort = experiments.QUICK if self.quick else experiments.Effort()
        results = chain.reproduce(check(self), self.out, effort, self.seed, self.sweep)
        for name, rows in results["task_space"]["summary"].items():
            errors = ", ".join(f"{s} {row['velocity_error_mean']:.4f}" for s, row in rows.items())
            print(f"{name:22} mean velocity error [m/s]: {errors}")
        for claim in results["claims"]:
            print(f"{VERDICTS[claim['holds']]}: {claim['paper']}")
        print(f"{self.out / 'report.html'}\n{self.out / 'results.json'}")


@dataclass(kw_only=True)
class Preliminary(Command):
    """The paper's preliminary tests and its sim-to-real experiment, machine and nets side by side."""

    actuator: Path  # Nets that `fit` wrote.
    out: Path = Path("preliminary")  # Folder for figures and preliminary.json.

    def run(self) -> None:
        """Measure, draw, write."""
        machine, net = check(self), load_net(self.actuator)
        numbers = preliminary.run(machine, net, self.seed)
        self.out.mkdir(parents=True, exist_ok=True)
        for name, figure in preliminary.plots(machine, net, self.seed).items():
            figures.save(self.out / f"{name}.png", figure)
            print(self.out / f"{name}.png")
        meta = metrics.metadata(machine, self.seed) | {"actuator": str(self.actuator)}
        write_json(self.out / "preliminary.json", {"meta": meta, **numbers})
        print(self.out / "preliminary.json")
        tool = numbers["sim_to_real"]["tool"]["position_error_mean"]
        print(f"tool, nets beside machine over 30 s: {tool:.4f} m apart in the mean")
