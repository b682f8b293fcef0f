"""The commands that compare: policies, baselines, the paper's tests, the whole chain.

What trains or draws is imported by the command that runs it: help must not wait for it.
"""

import math
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from brokk_min.actuator import ActuatorNet
from brokk_min.cli.options import Command, PlantName, WrongUse, default_policy, with_plant
from brokk_min.env import TaskConfig
from brokk_min.evaluation import baselines, metrics, perfect_model, sequences
from brokk_min.evaluation.claims import VERDICTS
from brokk_min.evaluation.rollout import TITLES, Controller
from brokk_min.identification.files import SHIPPED, located, write_csv, write_json
from brokk_min.identification.net_file import load_net
from brokk_min.jacobian import JacobianController
from brokk_min.learning.policy import POLICIES, Policy, load_policy, policy_controllers
from brokk_min.machine import Machine, number


@dataclass(kw_only=True)
class Starts(Command):
    """Draw start poses: across the workspace, near joint limits, near full extension."""

    out: Path  # Poses to write, .csv.
    num: int = number("1", 1, 10**6, 64)  # How many.
    seed: int = number("1", 0, 2**31 - 1, 2)  # Of the poses.

    def __call__(self) -> None:
        machine = self.check(out="starts")
        rng = np.random.default_rng(self.seed)
        poses = sequences.draw_starts(machine, sequences.task_sequences(machine), self.num, rng)
        write_csv(self.out, machine.names, poses.tolist())
        print(f"{self.out}: {self.num} start poses")


@dataclass(kw_only=True)
class Evaluate(Command):
    """Policies and tuned baselines on the same sequences and starts."""

    policy: Path | None = None  # Policy that `train` wrote; by default those of the package.
    commands: Path | None = None  # Velocity sequences, CSV: sequence,time,vx,vy,vz [s, m/s].
    starts: Path | None = None  # Start poses, CSV: one column per joint [rad].
    plant: PlantName = "analytic"  # What moves: analytic, net, or an object of your file.
    json: Path | None = None  # Also write all runs here.
    gains: Path | None = None  # Tuned gains; by default gains.json in the folder of POLICY.
    save_gains: Path | None = None  # Write the gains that are tuned now, for --gains and `drive`.
    num_starts: int = number("1", 1, 10**6, 16)  # Without --starts: how many of the machine's.
    noise: float = number("1", 0, 1, 0.05)  # Sensor noise [deviations]; 0: encoders only.
    perfect_model: bool = False  # Also a bound: a controller with the plant as its model (minutes).
    all: bool = False  # Print all figures by kind of start, not the table alone.

    def __call__(self) -> None:
        machine = self.check(json="runs", save_gains="gains")
        if self.perfect_model and self.plant != "analytic":
            wanted = "expected --plant analytic, its model"
            raise WrongUse(f"--perfect-model: {wanted}, got {self.plant}")
        if self.starts and self.num_starts != Evaluate.num_starts:
            raise WrongUse(f"--num-starts: expected none with --starts, got {self.num_starts}")
        path, gains = default_policy(machine, self.policy, self.gains)
        if self.noise != TaskConfig.noise:
            gains = self.gains  # others were tuned with more noise
        if gains and self.save_gains:
            raise WrongUse(f"--save-gains: expected gains to tune, got tuned ones in {gains}")
        policy = load_policy(path, machine)
        machine = with_plant(machine, self.plant, ["analytic", "net"])
        net = policy.net if self.plant == "net" else None
        tuned = baselines.read_gains(gains, machine, policy.net) if gains else {}
        inputs = (self.commands, self.starts, self.num_starts, self.seed)
        commands, starts = sequences.goals_and_starts(machine, *inputs)
        config = TaskConfig(noise=self.noise)
        controllers = self._policies(machine, policy)
        controllers |= tuned or self._tune(machine, policy, config, net)
        print(f"gains of the baselines: {gains or 'tuned now'}", file=sys.stderr)
        if self.perfect_model:
            controllers |= perfect_model.perfect_models(machine, starts)
        task = (commands, starts, self.seed, net)
        runs, _ = metrics.evaluate(machine, controllers, *task, config=config)
        if self.json:
            meta = {
                **metrics.metadata(machine, self.seed),
                "policy": str(path),
                "gains": str(gains or "tuned now"),
                "plant": self.plant,
                "commands": str(self.commands or ", ".join(one.name for one in commands)),
                "starts": str(self.starts or self.num_starts),
                "noise": self.noise,
            }
            write_json(self.json, {"meta": meta, "runs": runs})
        runs.sort(key=lambda run: sequences.KINDS.index(run["kind"]))  # those that count first
        print_table(runs, len(commands), COLUMNS)
        print_answer(runs)
        for kind in sequences.KINDS if self.all else ():
            of_kind = [run for run in runs if run["kind"] == kind]
            if of_kind:
                print_table(of_kind, len(commands), [k for k in runs[0] if k not in metrics.LABELS])

    def _policies(self, machine: Machine, policy: Policy) -> dict[str, Controller]:
        policies = {"rl": policy}
        path = SHIPPED / machine.name / POLICIES["rl_paper"]
        if not self.policy and path.exists():
            policies["rl_paper"] = load_policy(path, machine)
        return {**policy_controllers(machine, policies)}

    def _tune(
        self, machine: Machine, policy: Policy, config: TaskConfig, net: ActuatorNet | None
    ) -> dict[str, JacobianController]:
        budget = (baselines.TUNING_RUNS, baselines.GENERATIONS, self.seed)
        tuned, _ = baselines.tune_baselines(machine, policy.net, *budget, config, net)
        if self.save_gains:
            meta = baselines.gains_metadata(machine, policy.net)
            baselines.write_gains(self.save_gains, tuned, meta)
        return tuned


COLUMNS = {  # of the table: head, format
    "velocity_error_mean": ("error [m/s]", "{:.4f}"),
    "off_axis_drift_max": ("drift [m]", "{:.4f}"),
    "jerk_rms": ("jerk [m/s^3]", "{:.1f}"),
    "valve_travel": ("travel [1]", "{:.0f}"),
    "time_at_limits": ("at a stop [s]", "{:.1f}"),
}


def print_table(runs: list[dict[str, Any]], sequences: int, keys: Iterable[str]) -> None:
    """Means of some metrics by controller, over the starts of the first run's kind; worst error."""
    runs = [run for run in runs if run["kind"] == runs[0]["kind"]]
    num = len({run["start"] for run in runs})
    print(f"means over {sequences} sequences from {num} {runs[0]['kind']} starts")
    columns = {key: COLUMNS.get(key, (key, "{:.4f}")) for key in keys}
    print(f"{'controller':30}", *(head for head, _ in columns.values()), "worst run [m/s]")
    for name, rows in metrics.summary(runs).items():
        cells = []
        for key, (head, form) in columns.items():
            mean = rows["all"][key]
            cells.append(("none" if mean is None else form.format(mean)).rjust(len(head)))
        errors = [run["velocity_error_mean"] for run in runs if run["controller"] == name]
        print(f"{name:30}", *cells, f"{max(errors):.4f}".rjust(len("worst run [m/s]")))


def print_answer(runs: list[dict[str, Any]]) -> None:
    """By how much the policy is better than the paper's PID, and than the best of each class."""
    summary = metrics.summary([run for run in runs if run["kind"] == runs[0]["kind"]])
    error = {name: rows["all"]["velocity_error_mean"] or math.nan for name, rows in summary.items()}
    pids = sorted((name for name in error if "jacobian" in name), key=error.__getitem__)
    best = {name.endswith("_dither"): name for name in reversed(pids)}  # dither, or closed
    for name in dict.fromkeys(["jacobian_pid_k0.1", *best.values()]):
        policy = "rl_dither" if name.endswith("_dither") else "rl"
        less = 1 - error[policy] / error[name]
        side = "less" if less > 0 else "more"
        print(f"{policy} has {abs(less):.0%} {side} error than {name}: {TITLES[name]}")
    print("rl_paper: the paper's learner; _dither: valves stay open while the tool rests")


CHAIN = {  # files of `reproduce`
    **dict.fromkeys(("log.npz", "log_test.npz", "log_paper.npz"), "log"),
    **dict.fromkeys(("net.npz", "net_paper.npz"), "nets"),
    **dict.fromkeys(POLICIES.values(), "policy"),
    **{f"{name}.csv": "curve" for name in POLICIES.values()},
    "gains.json": "gains",
    "results.json": "results",
}


@dataclass(kw_only=True)
class Reproduce(Command):
    """The whole chain: logs, nets, policy, baselines, comparison, report.html and results.json."""

    out: Path = Path("results")  # Folder for everything.
    quick: bool = False  # The same, smaller: to see that it runs, not to assess the policy.
    sweep: Path | None = None  # sweep.json on these nets: intervals over its seeds in the report.

    def __call__(self) -> None:
        from brokk_min.evaluation.learn import QUICK, Budget
        from brokk_min.evaluation.reproduce import reproduce

        budget = QUICK if self.quick else Budget()
        machine = self.check({self.out / name: kind for name, kind in CHAIN.items()})
        results = reproduce(machine, self.out, budget, self.seed, self.sweep)
        for name, rows in results["task_space"]["summary"].items():
            errors = ", ".join(f"{s} {row['velocity_error_mean']:.4f}" for s, row in rows.items())
            print(f"{name:22} mean velocity error [m/s]: {errors}")
        for claim in results["claims"]:
            ours = VERDICTS[claim["ours"]["holds"]]
            print(f"{VERDICTS[claim['holds']]} (of our policy: {ours}): {claim['paper']}")
        print(self.out / "report.html", self.out / "results.json", sep="\n")


@dataclass(kw_only=True)
class Preliminary(Command):
    """The paper's preliminary tests and its sim-to-real experiment, on the machine and the nets."""

    actuator: Path  # Nets that `fit` wrote.
    out: Path = Path("preliminary")  # Folder for figures and preliminary.json.

    def __call__(self) -> None:
        from brokk_min.evaluation import figures, preliminary

        machine = self.check({self.out / "preliminary.json": "preliminary"})
        with located(self.actuator):
            measured = preliminary.run(machine, load_net(self.actuator), self.seed)
        numbers = preliminary.numbers(machine, measured)
        self.out.mkdir(parents=True, exist_ok=True)
        tests, gap = self.out / "preliminary.png", self.out / "sim_to_real.png"
        figures.save(tests, figures.plot_tests(machine, measured.tests))
        figures.save(gap, figures.plot_gap(machine, measured.gap))
        meta = metrics.metadata(machine, self.seed) | {"actuator": str(self.actuator)}
        write_json(self.out / "preliminary.json", {"meta": meta, **numbers})
        print(tests, gap, self.out / "preliminary.json", sep="\n")
        distance = numbers["sim_to_real"]["tool"]["position_error_mean"]
        print(f"mean distance of the tools of nets and machine over 30 s: {distance:.4f} m")


@dataclass(kw_only=True)
class Family(Command):
    """Draw machines with physics of their own; run the chain on each, and each policy on all."""

    out: Path = Path("family")  # Folder for a folder of each member, and family.json.
    members: int = number("1", 1, 1000, 8)  # How many, from --seed on; finished ones stay.
    quick: bool = False  # The same, smaller: to see that it runs, not to assess the policies.

    def __call__(self) -> None:
        from brokk_min.evaluation.family import FAMILY, QUICK, run_family, show

        machine = self.check({self.out / "family.json": "family"})
        seeds = range(self.seed, self.seed + self.members)
        results = run_family(machine, seeds, self.out, QUICK if self.quick else FAMILY)
        print(show(results), self.out / "family.json", sep="\n")
