"""The commands for logs and nets of another machine: what they tell, and how good they are.

What draws is imported by the function that draws: help must not wait for it.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tyro.conf import Positional

from brokk_min.can import diagnosis
from brokk_min.can.dbc import dbc
from brokk_min.can.drive_log import read_frames
from brokk_min.cli.options import Command, MachineName, WrongUse
from brokk_min.identification import inspection, validation
from brokk_min.identification.files import brief, located, whole_file, write_json
from brokk_min.identification.logs import Log, read_log
from brokk_min.identification.net_file import load_net
from brokk_min.kinematics import UNITS
from brokk_min.learning.policy import Policy, load_policy
from brokk_min.machine import Machine

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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
        if not self.logs:
            raise WrongUse("LOGS: expected at least one log, got none")
        net = load_net(self.net)
        log = read_log(self.logs, net.velocity_samples, net.joints, net.rate)
        with located(*self.logs):
            scores: dict[str, Any] = {"joints": validation.score(net, log)}
        if self.machine and machine.names == net.joints:
            scores["tool"] = validation.tool_errors(machine, net, log)
        if self.json:
            meta = {"net": str(self.net), "logs": list(map(str, self.logs))}
            write_json(self.json, {"meta": meta, **scores})
        if any("one_step_rmse" in joint for joint in scores["joints"].values()):
            from brokk_min.evaluation import figures

            drawn = machine if machine.names == net.joints else None
            figures.save(self.figure, figures.plot_worst_and_median(net, log, drawn))
        print("Errors [rad/s] of one step, of the last velocity again, of free runs of 1 to 30 s:")
        for name, joint in scores["joints"].items():
            print_score(name, joint)


def print_score(name: str, joint: dict[str, Any]) -> None:
    """One joint of `validation.score`."""
    if "one_step_rmse" not in joint:
        print(f"{name}: not driven in the log")
        return
    runs = [f"{run['velocity_rmse']:.4f} ({s} s)" for s, run in joint["free_run"].items()]
    errors = f"{joint['one_step_rmse']:.4f}, {joint['persistence_rmse']:.4f}"
    print(f"{name:12} {errors}, {', '.join(runs) or 'no recording of a second'}")


@dataclass(kw_only=True)
class Inspect(Command):
    """What a log tells of its machine before any fit, and what it cannot tell."""

    logs: Positional[tuple[Path, ...]]  # Logs of one machine, .csv or .npz.
    machine: MachineName = ""  # Of LOGS; by default the usual one, if LOGS has its joints.
    json: Path | None = None  # Also write the report here.

    def __call__(self) -> None:
        machine = self.check(json="inspection")
        if not self.logs:
            raise WrongUse("LOGS: expected at least one log, got none")
        log = read_log(self.logs, machine.velocity_samples, rate=machine.rate)
        known = machine if machine.names == log.joints else None
        if self.machine and not known:
            expected = f"expected those of --machine {self.machine}"
            raise ValueError(f"{self.logs[0]}: joints: {expected}, got {brief(log.joints)}")
        report = inspection.report_json(log, known)
        if self.json:
            write_json(self.json, {"meta": {"logs": list(map(str, self.logs))}, **report})
        print_report(log, report, known)


@dataclass(kw_only=True)
class Diagnose(Command):
    """Why does it shake? A log of `drive` against its policy and nets; names what differs."""

    log: Positional[Path]  # Log that `drive --log` wrote.
    policy: Path  # Policy that drove.
    json: Path | None = None  # Also write all terms here.
    figure: Path | None = None  # Also draw commands and velocities with the expected ones, .png.

    def __call__(self) -> None:
        machine = self.check(json="diagnosis", figure="picture")
        policy = load_policy(self.policy, machine)
        with located(self.log):
            ticks = diagnosis.read_ticks(machine, read_frames(self.log))
        terms = diagnosis.diagnose(machine, policy, ticks)
        print(f"{self.log}: {len(ticks.time)} ticks; error that is left if a term was so:")
        for term in terms[:5]:
            print(f"  {term.side}: {term.name} ({term.error / term.before:.0%})")
        if not terms:
            print("  commands and motion are as the policy and its nets have them")
        if self.json:
            meta = {"log": str(self.log), "policy": str(self.policy)}
            write_json(self.json, {"meta": meta, "terms": [term._asdict() for term in terms]})
        if self.figure:
            from brokk_min.evaluation import figures

            figures.save(self.figure, plot_drive(machine, policy, ticks))


def plot_drive(machine: Machine, policy: Policy, ticks: diagnosis.Ticks) -> "Figure":
    """Of each driven joint: sent and expected command, measured and simulated velocity."""
    from brokk_min.evaluation import figures

    history = diagnosis.measured_history(machine, ticks)
    expected = diagnosis.expected_commands(machine, policy, ticks, history)
    simulated, measured = diagnosis.net_velocities(machine, policy, ticks.u, ticks.q)
    time = ticks.time - ticks.time[0]
    ahead, runs, _ = simulated.shape
    later = time[machine.history + 1 : machine.history + 1 + ahead * runs]
    rows = []
    for k, j in enumerate(machine.driven):
        name = machine.names[j]
        u = {"measured": (time, ticks.u[:, j]), "expected": (time, expected[:, j])}
        values = {"measured": measured, "expected": simulated}
        q_dot = {label: (later, x[..., k].T.ravel()) for label, x in values.items()}
        left = figures.Panel("", "time [s]", f"command of {name} [1]", u)
        label = f"{name} [{UNITS[machine.joints[j].kind]}/s]"
        rows.append([left, figures.Panel("", "time [s]", label, q_dot)])
    return figures.plot_panels(rows)


@dataclass(kw_only=True)
class Dbc(Command):
    """Write the frames of a machine's bus as a DBC file, for other tools."""

    out: Path  # File to write, .dbc.

    def __call__(self) -> None:
        text = dbc(self.check(out="DBC"))
        with whole_file(self.out, "w") as file:
            file.write(text)
        print(f"{self.out}: {text.count('BO_ ')} messages")


def print_report(log: Log, report: dict[str, Any], machine: Machine | None) -> None:
    """A table of `inspection.report_json`, what a known machine says instead, and warnings."""
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
    if machine:
        zones = machine.dead_zone, machine.largest_dead_zone or machine.dead_zone
        print(f"{machine.name}: dead zones {zones[0]:g} to {zones[1]:g}, delay {machine.delay:g} s")
    for warning in report["warnings"]:
        print(f"warning: {warning}")
