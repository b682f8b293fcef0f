"""The commands for logs and nets: to record, to look at logs, to fit and to score.

What fits or draws is imported by the command that runs it: help must not wait for it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from tyro.conf import OmitArgPrefixes, Positional

from brokk_min.actuator import ActuatorNet
from brokk_min.cli.options import Command, MachineName, PlantName, WrongUse, checked, with_plant
from brokk_min.evaluation.rollout import own_drives
from brokk_min.identification import excitation, inspection, validation
from brokk_min.identification.coupling import history_of
from brokk_min.identification.files import brief, located, write_json
from brokk_min.identification.fit_config import PAPER_RECIPE, STEP_RECIPE, FitConfig
from brokk_min.identification.logs import RETURN, Log, in_order, part_of, read_log, split, write_log
from brokk_min.identification.net_file import load_net, save_net
from brokk_min.identification.simulation import recovery
from brokk_min.learning.policy import PolicyController, load_policy
from brokk_min.machine import Machine, number

COLUMNS = {  # of the table of `inspect`: head, format, field of `JointReport`
    "minutes": ("{:.1f}", "minutes"),
    "alone": ("{:.0%}", "alone"),
    "sign": ("{:+d}", "sign"),
    "delay [s]": ("{:.2f}", "delay"),
    "zone up": ("{:.3f}", "dead_zone_up"),
    "zone down": ("{:.3f}", "dead_zone_down"),
    "gain up": ("{:.2f}", "gain_up"),
    "gain down": ("{:.2f}", "gain_down"),
    "explained": ("{:.0%}", "explained"),
    "feedback": ("{:+.2f}", "feedback"),
    "reaction": ("{:+.2f}", "reaction"),
}


@dataclass(kw_only=True)
class Collect(Command):
    """Record the machine (the analytic plant, or your own) under excitation, or under a policy."""

    out: Path  # Log to write, .csv or .npz.
    hours: float = number("h", 1e-4, 100, 1.0)  # Driving time for each actuator [h].
    excitation: Literal["auto", "sine", "rich", "ramp", "joint"] = "auto"
    """Sines (the paper's); steps, holds, too (auto); slow ramps; all joints, HOURS in all."""
    policy: Path | None = None  # It drives instead: fit to its log, too, and train again.
    plant: PlantName = "analytic"  # What moves: the analytic plant, or an object of your file.

    def __call__(self) -> None:
        machine = self.check(out="recording")
        if self.out.suffix not in (".csv", ".npz"):
            raise WrongUse(f"--out: expected a name ending in .csv or .npz, got {self.out}")
        if self.policy and self.excitation != "auto":
            raise WrongUse(f"--excitation: expected none with --policy, got {self.excitation}")
        rng = np.random.default_rng(self.seed)
        machine = with_plant(machine, self.plant, ["analytic"])
        if self.policy:
            driver = PolicyController(machine, load_policy(self.policy, machine))
            log = own_drives(machine, [driver], self.hours, self.seed)
        else:
            kind = "rich" if self.excitation == "auto" else self.excitation
            log = excitation.collect(machine, self.hours, kind, rng)
        write_log(self.out, log)
        num = sum(not one.name.endswith(RETURN) for one in log.recordings)
        print(f"{self.out}: {num} recordings of {', '.join(log.joints)}")


@dataclass(frozen=True)
class FitSettings(FitConfig):
    """How the nets are fitted."""

    history: int | None = None  # type: ignore[assignment]
    """Samples of angle, velocity and command (paper: 13); by default the machine's."""
    steps: int | None = None  # type: ignore[assignment]
    """By default 16000, though 5000 do for a few minutes; 3000 for step responses."""
    weight_decay: float | None = None  # type: ignore[assignment]
    """By default 0, though 0.3 may help with a few minutes; 0.3 for step responses."""
    noise: float | None = None  # type: ignore[assignment]
    """Of velocity inputs, in their deviations; by default 0.1, 1 for step responses."""
    output_lags: int | None = None
    """Newest velocities and angles that nets read; by default all (--history or more), 1 for step
    responses."""

    def __post_init__(self) -> None:
        """Leave the check to `Fit`."""


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
    velocity_samples: int | None = number("samples", 2, 100, None)
    """Window of velocities; by default the machine's."""
    paper: bool = False  # The paper's recipe: errors of one step, no noise, plain commands.
    curve: bool = False  # Also score nets fitted to an eighth, a quarter, a half of the recordings.
    settings: OmitArgPrefixes[FitSettings] = field(default_factory=FitSettings)

    def __call__(self) -> None:
        from brokk_min.identification.fitting import fit

        if self.out.suffix != ".npz":
            raise WrongUse(f"--out: expected a name ending in .npz, got {self.out}")
        self.figure = self.figure or self.out.with_suffix(".png")
        machine = self.check(out="nets", json="scores", figure="picture")
        self.config(None, machine.history)  # before the logs are read
        samples = self.velocity_samples or machine.velocity_samples
        history = self.settings.history or machine.history
        if samples > history:
            wanted = f"expected --history of that or more, got {history}"
            raise WrongUse(f"--velocity-samples {samples}: {wanted}")
        log, known = read_known(self.logs, machine, samples, self.machine)
        if self.plant and not known:
            raise WrongUse("--plant: expected LOGS with the joints of --machine")
        recorded = with_plant(machine, self.plant, ["analytic", ""])
        if self.test:
            test = read_log(self.test, samples, log.joints, log.rate)
        else:
            with located(*self.logs):
                log, test = split(log)
        history = machine.history if known else history_of(log, machine.history)
        reports = inspection.inspect(log)
        steps_alone = inspection.has_steps_alone(reports)
        config = self.config(known, history, steps_alone)
        if steps_alone and not self.paper:
            values = ", ".join(f"{name} {getattr(config, name)}" for name in STEP_RECIPE)
            print(f"step responses, held commands of few levels: {values}")
        with located(*self.logs):
            for wrong in inspection.wrong_signs(reports):
                raise ValueError(wrong)
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
            logs = [part_of(log, part) for part in (1 / 8, 1 / 4, 1 / 2)]
            nets = [fit(part, config, self.seed, samples) for part in logs]
            pairs = zip([*logs, log], [*nets, net], strict=True)
            scores["curve"] = [curve_point(part, validation.score(n, test)) for part, n in pairs]
        if self.json:
            names = ("seed", "rate", "history", "machine", "dead_zone")
            meta: dict[str, Any] = {name: getattr(net, name) for name in names}
            meta |= {"logs": list(map(str, self.logs)), "test": list(map(str, self.test))}
            meta["settings"] = net.settings
            write_json(self.json, {"meta": meta, **scores})
        save_figure(self.figure, scores, net, test, known)
        name = net.machine or "no known machine"
        print(f"nets of {name}, dead zone {net.dead_zone} of full command")
        seconds = net.history / net.rate
        print(f"scored on: {brief([recording.name for recording in test.recordings])}")
        print(f"history: {net.history} samples at {net.rate:g} Hz, {seconds:.2f} s")
        print_scores(scores)

    def config(self, known: Machine | None, history: int, steps_alone: bool = False) -> FitConfig:
        """The settings, or the paper's; what is not given is by the machine and the log."""
        settings: dict[str, Any] = {"history": history}
        if known:
            settings["dead_zone"] = known.dead_zone
        if steps_alone and not self.paper:
            settings |= STEP_RECIPE
        settings |= {name: x for name, x in vars(self.settings).items() if x is not None}
        if self.paper:
            for name in PAPER_RECIPE:
                value = getattr(self.settings, name)
                if value not in (None, getattr(FitSettings, name), PAPER_RECIPE[name]):
                    raise WrongUse(
                        f"--{name.replace('_', '-')}: expected none with --paper, got {value}"
                    )
            settings |= PAPER_RECIPE
        return checked(FitConfig, **settings)


def read_known(
    logs: Sequence[Path], machine: Machine, samples: int, name: str
) -> tuple[Log, Machine | None]:
    """Logs at the machine's rate; and the machine if it has their joints, with these in its order.

    ValueError: it was given by its `name` and has others.
    """
    log = read_log(logs, samples, rate=machine.rate)
    known = None
    if set(machine.names) == set(log.joints):
        log = in_order(log, machine.names)
        known = machine
    if name and not known:
        expected = f"expected {brief(machine.names)} of --machine {name}"
        raise ValueError(f"{logs[0]}: joints: {expected}, got {brief(log.joints)}")
    return log, known


def save_figure(
    path: Path, scores: dict[str, Any], net: ActuatorNet, log: Log, machine: Machine | None
) -> None:
    """Free runs of the worst and the median recording, if any joint has a score."""
    if any("one_step_rmse" in joint for joint in scores["joints"].values()):
        from brokk_min.evaluation import figures

        figures.save(path, figures.plot_worst_and_median(net, log, machine))


def curve_point(log: Log, joints: dict[str, Any]) -> dict[str, Any]:
    """Minutes of a log, and the errors of 5 s free runs [rad/s] of the nets fitted to it."""
    minutes = sum(len(recording.q) for recording in log.recordings) / log.rate / 60
    runs = {name: joint["free_run"].get("5") for name, joint in joints.items()}
    errors = {name: run["velocity_rmse"] for name, run in runs.items() if run}
    return {"minutes": minutes, "free_run_rmse": errors}


def print_recovery(joints: dict[str, dict[str, Any]]) -> None:
    """A table of `recovery`: of each number up and down."""
    if joints:
        print("What the nets recovered of the plant, up and down:")
        row = "{:12} {:6} {:>15} {:>15} {:>15} {:>15}"
        print(row.format("joint", "", "dead zone", "delay [s]", "from idle [s]", "speed"))
    for name, sides in joints.items():
        for side, numbers in sides.items():
            cells = [["-" if x is None else f"{x:.3f}" for x in pair] for pair in numbers.values()]
            print(row.format(name, side, *map(", ".join, cells)))


def print_scores(scores: dict[str, Any]) -> None:
    """Scores of each net, of the linear model of its joint if it has one, and warnings."""
    row = "{:12} {:>9} {:>13}  {:30} {}"
    print("Errors [rad/s] of one step, of the last velocity again, of free runs of 1, 5, 10, 30 s:")
    print(row.format("joint", "one step", "same as last", "free runs", "creep [rad/s]"))
    for name, net in scores["joints"].items():
        models = {name: net, "  linear": net["linear"]} if "linear" in net else {name: net}
        for label, model in models.items():
            one_step = f"{model.get('one_step_rmse', np.nan):.4f}"
            persistence = f"{model.get('persistence_rmse', np.nan):.4f}"
            free = ", ".join(f"{run['velocity_rmse']:.4f}" for run in model["free_run"].values())
            creep = f"{model['creep']:.5f}" if "creep" in model else ""
            print(row.format(label, one_step, persistence, free, creep))
        relative = [run.get("relative_error") for run in net["free_run"].values()]
        parts = ", ".join("none" if part is None else f"{part:6.0%}" for part in relative)
        print(row.format("  of rms speed", "", "", parts, ""))
    if scores.get("tool"):
        metres = ", ".join(f"{error:.3f}" for error in scores["tool"].values())
        print(f"tool: off by {metres} m after {', '.join(scores['tool'])} s (median)")
    warnings = [warning.partition(": ") for warning in scores.get("warnings", [])]
    for name in scores["joints"]:
        own = [text for joint, _, text in warnings if joint == name]
        if own:
            print("\n  ".join([f"warnings for {name}:", *own]))
    print_recovery(scores.get("recovery", {}))
    for point in scores.get("curve", []):
        errors = ", ".join(f"{k} {v:.4f}" for k, v in point["free_run_rmse"].items())
        print(f"fitted to {point['minutes']:.1f} minutes: free runs of 5 s [rad/s]: {errors}")


@dataclass(kw_only=True)
class Score(Command):
    """Score existing nets on logs, as `fit` does on recordings that it held out."""

    net: Positional[Path]  # Nets that `fit` wrote.
    logs: Positional[tuple[Path, ...]]  # Logs of the same machine, .csv or .npz.
    machine: MachineName = ""  # Of NET; also scores the tool.
    json: Path | None = None  # Also write the scores here.
    figure: Path | None = None  # Free runs of the worst and median recording; by default NET.png.

    def __call__(self) -> None:
        self.figure = self.figure or self.net.with_suffix(".png")
        machine = self.check(json="scores", figure="picture")
        net = load_net(self.net)
        if self.machine and machine.names != net.joints:
            expected = f"expected those of --machine {self.machine}"
            raise ValueError(f"{self.net}: joints: {expected}, got {brief(net.joints)}")
        log = read_log(self.logs, net.velocity_samples, net.joints, net.rate)
        with located(*self.logs):
            joints = validation.score(net, log)
        scores: dict[str, Any] = {"joints": joints, "warnings": validation.large_errors(joints)}
        if self.machine:
            scores["tool"] = validation.tool_errors(machine, net, log)
        if self.json:
            meta = {"net": str(self.net), "logs": list(map(str, self.logs))}
            write_json(self.json, {"meta": meta, **scores})
        known = machine if machine.names == net.joints else None
        save_figure(self.figure, scores, net, log, known)
        print_scores(scores)


@dataclass(kw_only=True)
class Inspect(Command):
    """What a log tells of its machine before any fit, and what it cannot tell."""

    logs: Positional[tuple[Path, ...]]  # Logs of one machine, .csv or .npz.
    machine: MachineName = ""  # Of LOGS; by default the usual one, if LOGS has its joints.
    json: Path | None = None  # Also write the report here.

    def __call__(self) -> None:
        machine = self.check(json="inspection")
        log, known = read_known(self.logs, machine, machine.velocity_samples, self.machine)
        report = inspection.report_json(log, known)
        if self.json:
            write_json(self.json, {"meta": {"logs": list(map(str, self.logs))}, **report})
        print_report(log, report, machine)


def print_report(log: Log, report: dict[str, Any], machine: Machine) -> None:
    """A table of `inspection.report_json`, fields of a known machine, and warnings."""
    velocity = "logged" if log.velocity_logged else "estimated"
    print(f"{len(log.recordings)} recordings, {report['gaps']} begin after a gap; q_dot {velocity}")
    row = " ".join(["{:14}", *["{:>9}"] * len(COLUMNS)])
    print(row.format("joint", *COLUMNS))
    for name, joint in report["joints"].items():
        print(row.format(name, *(form.format(joint[key]) for form, key in COLUMNS.values())))
        together = {other: part for other, part in joint["together"].items() if part > 0.05}
        if together:
            parts = ", ".join(f"{other} {part:.0%}" for other, part in together.items())
            print(f"  with commands of {parts}")
    if "fields" in report:
        print_fields(report["fields"], machine)
    for warning in report["warnings"]:
        print(f"warning: {warning}")


def print_fields(fields: dict[str, Any], machine: Machine) -> None:
    """`inspection.fields`, and in brackets what the machine has."""
    print(f"fields of {machine.name} by this log (now):")
    zones = {name: getattr(machine, name) for name in ("dead_zone", "largest_dead_zone")}
    print(", ".join(f"{name} {fields[name]:.3f} ({now:g})" for name, now in zones.items()))
    for joint, (zone_up, zone_down) in zip(machine.joints, machine.dead_zones, strict=True):
        now = {"dead_zone_up": zone_up, "dead_zone_down": zone_down}
        now |= {"q_dot_up": joint.q_dot_up, "q_dot_down": joint.q_dot_down}
        found = {field: fields[field].get(joint.name) for field in now}
        parts = [
            f"{field} {found[field]:.3f} ({now[field]:g})"
            for field in now
            if found[field] is not None
        ]
        if parts:
            print(f"{joint.name}: {', '.join(parts)}")
