"""The commands of the method: from logs to nets, policies, comparisons and the report.

What trains or draws is imported by the command that runs it: help must not wait for it.
"""

import math
import sys
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from tyro.conf import OmitArgPrefixes, Positional

from brokk_min.actuator import ActuatorNet
from brokk_min.cli.options import (
    Command,
    Count,
    MachineName,
    PlantName,
    Range,
    Samples,
    Seed,
    WrongUse,
    default_policy,
    with_plant,
)
from brokk_min.cli.settings import (
    FitSettings,
    GradientDefaults,
    LearnerSettings,
    PaperDefaults,
    TaskSettings,
    make_config,
)
from brokk_min.env import TaskConfig
from brokk_min.evaluation import baselines, metrics, perfect_model, sequences
from brokk_min.evaluation.claims import VERDICTS
from brokk_min.evaluation.rollout import TITLES, Controller, own_drives
from brokk_min.identification import excitation, inspection, validation
from brokk_min.identification.coupling import history_of
from brokk_min.identification.files import SHIPPED, brief, located, write_json
from brokk_min.identification.fit_config import PAPER_RECIPE, FitConfig
from brokk_min.identification.logs import Log, part_of, read_log, split, write_log
from brokk_min.identification.net_file import load_net, save_net
from brokk_min.identification.recovery import recovery
from brokk_min.learning.policy import POLICIES, Policy, PolicyController, load_policy
from brokk_min.machine import Machine


@dataclass(kw_only=True)
class Collect(Command):
    """Record the machine (the analytic plant, or your own) under excitation, or under a policy."""

    out: Path  # Log to write, .csv or .npz.
    hours: Annotated[float, Range(1e-4, 100)] = 1.0  # Driving time for each actuator [h].
    excitation: Literal["sine", "rich", "joint"] = "rich"
    """The paper's sines; steps and holds too; or the same on all joints at once: HOURS in all."""
    policy: Path | None = None  # It drives instead: fit to its log, too, and train again.
    plant: PlantName = "analytic"  # What moves: the analytic plant, or an object of your file.

    def __call__(self) -> None:
        machine = self.check(out="log")
        if self.out.suffix not in (".csv", ".npz"):
            raise WrongUse(f"--out: expected a name ending in .csv or .npz, got {self.out}")
        rng = np.random.default_rng(self.seed)
        machine = with_plant(machine, self.plant, ["analytic"])
        if self.policy:
            driver = PolicyController(machine, load_policy(self.policy, machine))
            log = own_drives(machine, [driver], self.hours, self.seed)
        else:
            log = excitation.collect(machine, self.hours, self.excitation, rng)
        write_log(self.out, log)
        print(f"{self.out}: {len(log.recordings)} recordings of {', '.join(log.joints)}")


@dataclass(kw_only=True)
class Fit(Command):
    """Fit one net per joint to logs of any machine; score it on other recordings."""

    logs: Positional[tuple[Path, ...]]  # Logs of one machine, .csv or .npz.
    out: Path  # Nets to write, .npz.
    test: tuple[Path, ...] = ()  # Logs to score on; by default every tenth recording of LOGS.
    json: Path | None = None  # Also write the scores here.
    figure: Path | None = None  # Free runs of the worst and median recording; by default OUT.png.
    machine: MachineName = ""  # Of LOGS; by default the usual one, if LOGS has its joints.
    plant: PlantName = ""  # What LOGS recorded, if known: also print what the nets recovered of it.
    velocity_samples: Samples | None = None  # Window of velocities; by default the machine's.
    paper: bool = False  # The paper's recipe: errors of one step, no noise, plain commands.
    curve: bool = False  # Also score nets fitted to an eighth, a quarter, a half of the recordings.
    settings: OmitArgPrefixes[FitSettings] = field(default_factory=FitSettings)

    def __call__(self) -> None:
        from brokk_min.evaluation import figures
        from brokk_min.identification.fitting import fit

        if not self.logs:
            raise WrongUse("LOGS: expected at least one log, got none")
        self.figure = self.figure or self.out.with_suffix(".png")
        machine = self.check(out="nets", json="scores", figure="picture")
        make_config(FitConfig, self._settings(None, machine.history))  # before the logs are read
        samples = self.velocity_samples or machine.velocity_samples
        log, test = self._read(machine, samples)
        known = machine if machine.names == log.joints else None
        if self.machine and not known:
            expected = f"expected those of --machine {self.machine}"
            raise ValueError(f"{self.logs[0]}: joints: {expected}, got {brief(log.joints)}")
        if self.plant and not known:
            raise WrongUse("--plant: expected LOGS with the joints of --machine")
        recorded = with_plant(machine, self.plant, ["analytic", ""])
        history = machine.history if known else history_of(log, machine.history)
        config = make_config(FitConfig, self._settings(known, history))
        reports = inspection.inspect(log)
        with located(*self.logs):
            inspection.check_signs(reports)
            net = fit(log, config, self.seed, samples, known.name if known else "")
        with located(*self.test, *self.logs):
            scores = validation.validate(net, log, test, known)
        for name, scored in scores["joints"].items():
            if "one_step_rmse" not in scored:
                scores["warnings"].append(f"{name}: not driven in the test: no score")
        scores["warnings"] += inspection.warnings(log, reports, known)
        if self.plant:
            scores["recovery"] = recovery(net, recorded)
        save_net(self.out, net)
        if self.curve:
            parts = [part_of(log, part) for part in (1 / 8, 1 / 4, 1 / 2)]
            nets = [fit(part, config, self.seed, samples) for part in parts]
            curve = [validation.score(one, test) for one in [*nets, net]]
            scores["curve"] = learning_curve([*parts, log], curve)
        if self.json:
            write_json(self.json, {"meta": self._meta(net), **scores})
        if any("one_step_rmse" in joint for joint in scores["joints"].values()):
            figures.save(self.figure, figures.plot_worst_and_median(net, test, known))
        name = net.machine or "no known machine"
        print(f"nets of {name}, dead zone {net.dead_zone} of full command")
        seconds = net.history / net.rate
        print(f"history: {net.history} samples at {net.rate:g} Hz, {seconds:.2f} s")
        print_scores(scores)
        print_recovery(scores.get("recovery", {}))
        for point in scores.get("curve", []):
            errors_5_s = ", ".join(f"{k} {v:.4f}" for k, v in point["free_run_rmse"].items())
            print(
                f"fitted to {point['minutes']:.1f} minutes: free runs of 5 s [rad/s]: {errors_5_s}"
            )

    def _read(self, machine: Machine, samples: int) -> tuple[Log, Log]:
        """Recordings to fit to and to score on."""
        if samples > (self.settings.history or machine.history):
            raise WrongUse(f"--velocity-samples: expected at most --history, got {samples}")
        log = read_log(self.logs, samples, rate=machine.rate)
        if self.test:
            return log, read_log(self.test, samples, log.joints, log.rate)
        with located(*self.logs):
            return split(log)

    def _meta(self, net: ActuatorNet) -> dict[str, Any]:
        meta = {"seed": self.seed, "rate": net.rate, "history": net.history}
        files = {"logs": list(map(str, self.logs)), "test": list(map(str, self.test))}
        return {**meta, "machine": net.machine, "dead_zone": net.dead_zone, **files}

    def _settings(self, known: Machine | None, history: int) -> dict[str, Any]:
        """The settings, by default with the machine's history and dead zone; or the paper's."""
        settings = vars(self.settings) | {"history": self.settings.history or history}
        if self.paper:
            settings |= PAPER_RECIPE
        elif known and settings["dead_zone"] is None:
            settings["dead_zone"] = known.dead_zone
        return settings


def learning_curve(logs: list[Log], scores: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Minutes of each log, and the errors of 5 s free runs [rad/s] of the nets fitted to it."""
    curve = []
    for log, joints in zip(logs, scores, strict=True):
        minutes = sum(len(recording.q) for recording in log.recordings) / log.rate / 60
        runs = {name: joint["free_run"].get("5") for name, joint in joints.items()}
        errors = {name: run["velocity_rmse"] for name, run in runs.items() if run}
        curve.append({"minutes": minutes, "free_run_rmse": errors})
    return curve


def print_recovery(joints: dict[str, dict[str, Any]]) -> None:
    """A table of `recovery`: of each number up and down."""
    if joints:
        print("What the nets recovered of the plant, up and down:")
        row = "{:12} {:6} {:>15} {:>15} {:>15} {:>15}"
        print(row.format("joint", "", "dead zone", "delay [s]", "from idle [s]", "speed"))
    for name, sides in joints.items():
        for side, numbers in sides.items():
            pairs = (", ".join(f"{x or np.nan:.3f}" for x in pair) for pair in numbers.values())
            print(row.format(name, side, *pairs))


def print_scores(scores: dict[str, Any]) -> None:
    """Scores of each net, of the linear model of its joint, and warnings."""
    row = "{:12} {:>9} {:>13}  {:30} {}"
    print("Errors [rad/s] of one step, of the last velocity again, of free runs of 1, 5, 10, 30 s:")
    print(row.format("joint", "one step", "same as last", "free runs", "creep [rad/s]"))
    for name, net in scores["joints"].items():
        for label, model in ((name, net), ("  linear", net["linear"])):
            one_step = f"{model.get('one_step_rmse', np.nan):.4f}"
            persistence = f"{model.get('persistence_rmse', np.nan):.4f}"
            free = ", ".join(f"{run['velocity_rmse']:.4f}" for run in model["free_run"].values())
            creep = f"{net['creep']:.5f}" if label == name else ""
            print(row.format(label, one_step, persistence, free, creep))
        relative = [run.get("relative_error") for run in net["free_run"].values()]
        parts = ", ".join("none" if part is None else f"{part:6.0%}" for part in relative)
        print(row.format("  of rms speed", "", "", parts, ""))
    if scores.get("tool"):
        metres = ", ".join(f"{error:.3f}" for error in scores["tool"].values())
        print(f"tool: off by {metres} m after {', '.join(scores['tool'])} s (median)")
    for name in scores["joints"]:
        own = [w.removeprefix(f"{name}: ") for w in scores["warnings"] if w.startswith(f"{name}: ")]
        if own:
            print("\n  ".join([f"warnings for {name}:", *own]))


@dataclass(kw_only=True)
class Training(Command):
    """Options of trainings."""

    actuator: Path  # Nets that `fit` wrote.
    critic: bool = False  # Advantages by a critic (as --paper), not by derivatives of the nets.
    settings: OmitArgPrefixes[LearnerSettings] = field(default_factory=LearnerSettings)
    task: OmitArgPrefixes[TaskSettings] = field(default_factory=TaskSettings)


@dataclass(kw_only=True)
class Train(Training):
    """Train a policy on the nets, with PPO and a critic."""

    out: Path  # Policy to write, .npz.
    resume: bool = False  # Go on from OUT.checkpoint; the end is the same as without the break.
    start: Path | None = None  # Policy to begin with, for nets that were fitted to its drives, too.
    tensorboard: Path | None = None  # Folder for TensorBoard (extra `tensorboard`).

    def __call__(self) -> None:
        from brokk_min.learning.checkpoint import train_policy
        from brokk_min.ppo import PPOConfig

        machine = self.check({Path(f"{self.out}.csv"): "curve"}, out="policy")
        task = make_config(TaskConfig, vars(self.task))
        config = make_config(PPOConfig, vars(self.settings))
        net = load_net(self.actuator, machine)
        start = load_policy(self.start, machine) if self.start else None
        files = (self.out, self.critic, self.resume, self.tensorboard, start)
        train_policy(machine, net, task, config, self.seed, *files)
        print(f"{self.out}: trained for {config.total_steps} steps; curve in {self.out}.csv")


@dataclass(kw_only=True)
class Sweep(Training):
    """Train and evaluate many seeds, one thread each; finished seeds are not run again."""

    out: Path  # Folder for a policy, a curve and figures of each seed, and sweep.json.
    seeds: Annotated[int, Range(1, 10_000)] = 10  # How many, from --seed on.
    poses: Annotated[int, Range(1, 1000)] = 16  # Start poses for each scored sequence.
    scheduler: str | None = None  # tcp://... of dask (extra `sweep`); its workers must see OUT.
    gains: Path | None = None  # Tuned gains that `reproduce` wrote, to compare with the baselines.

    def __call__(self) -> None:
        from brokk_min.evaluation.seeds import show, sweep
        from brokk_min.ppo import PPOConfig

        machine = self.check({self.out / "sweep.json": "sweep"})
        task = make_config(TaskConfig, vars(self.task))
        config = make_config(PPOConfig, vars(self.settings))
        net = load_net(self.actuator, machine)
        seeds = range(self.seed, self.seed + self.seeds)
        options = (self.poses, self.scheduler, self.gains, self.critic)
        print(show(sweep(machine, net, task, config, seeds, self.out, *options)))


@dataclass(kw_only=True)
class GradientTrain(GradientDefaults, Train):
    """Train a policy on the nets, by gradients of the simulation."""


@dataclass(kw_only=True)
class GradientSweep(GradientDefaults, Sweep):
    """Train and evaluate many seeds, one thread each; finished seeds are not run again."""


@dataclass(kw_only=True)
class PaperTrain(PaperDefaults, Train):
    """Train the paper's agent with PPO on the nets."""


@dataclass(kw_only=True)
class PaperSweep(PaperDefaults, Sweep):
    """Train and evaluate many seeds of the paper's agent; finished seeds are not run again."""


@dataclass(kw_only=True)
class Starts(Command):
    """Draw start poses: across the workspace, near joint limits, near full extension."""

    out: Path  # Poses to write, .csv.
    num: Count = 64  # How many.
    seed: Seed = 2  # Of the poses.

    def __call__(self) -> None:
        machine = self.check(out="starts")
        rng = np.random.default_rng(self.seed)
        poses = sequences.draw_starts(machine, sequences.task_sequences(machine), self.num, rng)
        sequences.write_starts(self.out, machine, poses)
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
    num_starts: Count = 16  # Without --starts: how many of the machine's start poses.
    noise: Annotated[float, Range(0, 1)] = 0.05  # Sensor noise [deviations]; 0: encoders only.
    perfect_model: bool = False  # Also a bound: a controller with the plant as its model (minutes).
    all: bool = False  # Print all figures by kind of start, not the table alone.

    def __call__(self) -> None:
        machine = self.check(json="runs")
        if self.perfect_model and self.plant != "analytic":
            raise WrongUse(
                f"--perfect-model: expected --plant analytic, its model, got {self.plant}"
            )
        path, gains = default_policy(machine, self.policy, self.gains)
        if self.noise != TaskConfig.noise:
            gains = self.gains  # others were tuned with more noise
        policy = load_policy(path, machine)
        machine = with_plant(machine, self.plant, ["analytic", "net"])
        net = policy.net if self.plant == "net" else None
        inputs = (self.commands, self.starts, self.num_starts, self.seed)
        commands, starts = sequences.goals_and_starts(machine, *inputs)
        controllers = self._controllers(machine, policy, gains, net)
        print(f"gains of the baselines: {gains or 'tuned now'}", file=sys.stderr)
        if self.perfect_model:
            controllers |= perfect_model.perfect_models(machine, starts)
        config = TaskConfig(noise=self.noise)
        runs, _ = metrics.evaluate(
            machine, controllers, commands, starts, self.seed, net, config=config
        )
        if self.json:
            meta = metrics.metadata(machine, self.seed)
            meta |= {"policy": str(path), "gains": str(gains or "tuned now"), "plant": self.plant}
            meta["commands"] = str(self.commands or ", ".join(one.name for one in commands))
            meta |= {"starts": str(self.starts or self.num_starts), "noise": self.noise}
            write_json(self.json, {"meta": meta, "runs": runs})
        runs.sort(key=lambda run: sequences.KINDS.index(run["kind"]))  # those that count first
        print_table(runs, len(commands), COLUMNS)
        print_answer(runs)
        for kind in sequences.KINDS if self.all else ():
            of_kind = [run for run in runs if run["kind"] == kind]
            if of_kind:
                print_table(of_kind, len(commands), [k for k in runs[0] if k not in metrics.LABELS])

    def _controllers(
        self, machine: Machine, policy: Policy, gains: Path | None, net: ActuatorNet | None
    ) -> dict[str, Controller]:
        controllers: dict[str, Controller] = {"rl": PolicyController(machine, policy)}
        for name, file in POLICIES.items():
            path = SHIPPED / machine.name / file
            if not self.policy and name != "rl" and path.exists():
                controllers[name] = PolicyController(machine, load_policy(path, machine))
        if gains:
            return controllers | baselines.read_gains(gains, machine, policy.net)
        budget = (baselines.TUNING_RUNS, baselines.GENERATIONS, self.seed)
        config = TaskConfig(noise=self.noise)
        tuned, _ = baselines.tune_baselines(machine, policy.net, *budget, config, net)
        return controllers | tuned


COLUMNS = {  # of the table: head, format
    "velocity_error_mean": ("error [m/s]", "{:.4f}"),
    "off_axis_drift_max": ("drift [m]", "{:.4f}"),
    "jerk_rms": ("jerk [m/s^3]", "{:.1f}"),
    "valve_travel": ("travel [1]", "{:.0f}"),
}


def print_table(runs: list[dict[str, Any]], sequences: int, keys: Iterable[str]) -> None:
    """Means of some metrics by controller, over the starts of the first run's kind."""
    runs = [run for run in runs if run["kind"] == runs[0]["kind"]]
    num = len({run["start"] for run in runs})
    print(f"means over {sequences} sequences from {num} {runs[0]['kind']} starts")
    columns = {key: COLUMNS.get(key, (key, "{:.4f}")) for key in keys}
    print(f"{'controller':30} " + " ".join(head for head, _ in columns.values()))
    for name, rows in metrics.summary(runs).items():
        cells = []
        for key, (head, form) in columns.items():
            mean = rows["all"][key]
            text = "none" if mean is None else form.format(mean)
            cells.append(text.rjust(len(head)))
        print(f"{name:30} " + " ".join(cells))


def print_answer(runs: list[dict[str, Any]]) -> None:
    """By how much the policy is better than the paper's PID and than the best one."""
    summary = metrics.summary([run for run in runs if run["kind"] == runs[0]["kind"]])
    error = {name: rows["all"]["velocity_error_mean"] or math.nan for name, rows in summary.items()}
    best = min((name for name in error if "jacobian" in name), key=error.__getitem__)
    for name in dict.fromkeys(["jacobian_pid_k0.1", best]):
        less = 1 - error["rl"] / error[name]
        side = "less" if less > 0 else "more"
        print(f"rl has {abs(less):.0%} {side} error than {name}: {TITLES[name]}")
    print("rl_paper: the paper's learner; _open, _awake: the valves stay open while the tool rests")


CHAIN = {  # files of `reproduce`
    "log.npz": "log",
    "log_test.npz": "log",
    "net.npz": "nets",
    "log_paper.npz": "log",
    "net_paper.npz": "nets",
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
        from brokk_min.evaluation.reproduce import QUICK, Budget, reproduce

        budget = QUICK if self.quick else Budget()
        machine = self.check({self.out / name: kind for name, kind in CHAIN.items()})
        results = reproduce(machine, self.out, budget, self.seed, self.sweep)
        for name, rows in results["task_space"]["summary"].items():
            errors = ", ".join(f"{s} {row['velocity_error_mean']:.4f}" for s, row in rows.items())
            print(f"{name:22} mean velocity error [m/s]: {errors}")
        for claim in results["claims"]:
            ours = VERDICTS[claim["ours"]["holds"]]
            print(f"{VERDICTS[claim['holds']]} (of our policy: {ours}): {claim['paper']}")
        print(self.out / "report.html")
        print(self.out / "results.json")


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
        plots = {"preliminary": figures.plot_tests(machine, measured.tests)}
        plots["sim_to_real"] = figures.plot_gap(machine, measured.gap)
        for name, figure in plots.items():
            figures.save(self.out / f"{name}.png", figure)
            print(self.out / f"{name}.png")
        meta = metrics.metadata(machine, self.seed) | {"actuator": str(self.actuator)}
        write_json(self.out / "preliminary.json", {"meta": meta, **numbers})
        print(self.out / "preliminary.json")
        distance = numbers["sim_to_real"]["tool"]["position_error_mean"]
        print(f"mean distance of the tools of nets and machine over 30 s: {distance:.4f} m")
