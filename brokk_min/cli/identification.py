"""The commands for logs and nets: to record a machine, to look at logs, to fit nets.

What fits or searches is imported by the command that runs it, because help must not wait for it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from tyro.conf import OmitArgPrefixes, Positional

from brokk_min._files import brief, expected, require_package, write_json
from brokk_min.beyond.rich_excitation import RICH
from brokk_min.can.drive_log import log_for_fit, read_frames, timing
from brokk_min.cli.options import Command, as_wrong_use, check, check_settings, find_plant
from brokk_min.fit import SINE, Log, collect
from brokk_min.identification import columns, logs
from brokk_min.identification.fitting import PAPER_RECIPE, OurFitConfig
from brokk_min.identification.net_file import load_net, save_net, select_nets
from brokk_min.machine import BROKK_170, Machine, require


@dataclass(kw_only=True)
class Collect(Command):
    """Record a machine (the analytic plant, or your own), one actuator at a time."""

    out: Path  # Log to write, .csv or .npz.
    hours: float = 1.0  # Driving time of each actuator [h].
    excitation: Literal["sine", "rich"] = "rich"  # The paper's sines; or steps and holds, too.
    plant: str = "analytic"  # What moves: the analytic plant, nets (.npz), FILE.py:NAME.
    seed: int = 0  # Of the commands.

    def __call__(self, machine: Machine) -> None:
        check(self.out.suffix in (".csv", ".npz"), "--out", "a name in .csv or .npz", self.out)
        check(0 < self.hours <= 100, "--hours", "above 0, to 100", self.hours)
        self.writes(self.out)
        rng, plant = np.random.default_rng(self.seed), find_plant(self.plant, machine)
        excitation = {"sine": SINE, "rich": RICH}[self.excitation]
        log = collect(machine, self.hours, rng, plant, excitation)
        logs.write_log(self.out, log)
        print(f"{self.out}: {len(log.recordings)} recordings of {', '.join(log.joints)}")


@dataclass(kw_only=True)
class ReadsLogs(Command):
    """Options of commands that read logs."""

    logs: Positional[tuple[Path, ...]]  # Of one machine: .csv, .npz, of ROS, or of a CAN bus.
    map: str = ""  # Columns and units, as boom=Boom_ang:deg,u_boom=Lever:percent,time=Zeit:ms.
    topics: tuple[str, str] = columns.TOPICS  # Angles and commands, of ROS.

    def read_logs(self, paths: Sequence[Path], machine: Machine) -> tuple[Log, Machine | None]:
        """One log of several; and the machine, but not the default one if the joints are others.

        The joints are in the order of the machine, of which locked ones may be missing.
        """
        once = len({path.resolve() for path in paths}) == len(paths) > 0
        check(once, "LOGS", "one file or more, each once", " ".join(map(str, paths)) or "none")
        check(len({*self.topics}) == 2, "--topics", "two topics", " ".join(self.topics))
        tables = not self.map or any(map(is_table, paths))
        check(tables, "--map", "a table or a recording of ROS", paths[0])
        with as_wrong_use():
            mapped = columns.parse_map(self.map)
        each = {path: self.read_log(path, machine, mapped) for path in paths}
        common = set.intersection(*(set(log.joints) for log in each.values()))
        log = logs.join_logs(
            {path: logs.without_locked(log, machine, common) for path, log in each.items()}
        )
        known = [j.name for j in machine.joints if j.driven or j.name in log.joints]
        if machine == BROKK_170 and set(log.joints) != set(known):
            return log, None
        others = [name for name in log.joints if name not in machine.names]
        if others and {*known} <= {*log.joints}:
            told = f"{paths[0]}: joints: expected those of --machine, left out {brief(others)}"
            log = log._replace(warnings=(*log.warnings, told))
            return logs.only(log, known), machine
        with expected(paths[0], "a log"):
            return logs.in_order(log, known), machine

    def read_log(self, path: Path, machine: Machine, mapped: columns.Mapped) -> Log:
        """A table or a recording of ROS, else a log of a CAN bus, which needs no `map`."""
        if is_table(path):
            return logs.read_log(path, machine, mapped, self.topics)
        with expected(path, "a log"):
            log = log_for_fit(machine, read_frames(path))
            return log._replace(warnings=tuple(f"{path}: {one}" for one in log.warnings))


@dataclass(kw_only=True)
class Inspect(ReadsLogs):
    """What logs tell of their machine, and what they lack; with nets, the errors of these."""

    net: Path | None = None  # Also score these nets on the logs.

    def __call__(self, machine: Machine) -> None:
        from brokk_min.identification import advice, inspection, validation, valve_report

        log, known = self.read_logs(self.logs, machine)
        reports = inspection.inspect(log, known)
        warnings, scores = [*advice.warnings(log, reports, known)], {}
        if self.net:
            net, window = load_net(self.net), machine.velocity_samples
            wanted, got = f"velocity_samples {window} of --machine", net.velocity_samples
            require(got == window, str(self.net), wanted, got)
            its = logs.without_locked(log, machine, net.joints)
            scores = validation.score(net, logs.in_order(its, net.joints))
            if known and (net.machine, net.rate) == (known.name, known.rate):
                driven = select_nets(known, net)
                learned = valve_report.from_log(known, driven, log)
                print(*valve_report.describe(known, learned), sep="\n")
        drives = [read_frames(path) for path in self.logs if not is_table(path)]
        times = [line for frames in drives for line in timing(machine, frames)]
        print(*times, f"{len(log.recordings)} recordings", *advice.table(reports), sep="\n")
        print_scores(scores, warnings)


@dataclass(kw_only=True)
class Fit(ReadsLogs):
    """Fit nets of each joint to logs of any machine; score them on other recordings."""

    out: Path  # Nets to write, .npz.
    test: tuple[Path, ...] = ()  # Logs to score on; by default every tenth recording.
    json: Path | None = None  # Also write the scores here.
    paper: bool = False  # The paper's recipe: errors of one step, commands as they are.
    seed: int = 0  # Of the weights and the drawn windows.
    settings: OmitArgPrefixes[OurFitConfig]

    @classmethod
    def defaults(cls, options: list[str]) -> Any:
        """Ours, or the settings of the paper's recipe."""
        recipe, required = PAPER_RECIPE if "--paper" in options else {}, tyro.MISSING
        recipe = recipe | ({"members": 1} if "--no-valve" in options else {})
        return cls(logs=required, out=required, settings=OurFitConfig(**recipe))

    def __call__(self, machine: Machine) -> None:
        require_package("torch", "train")
        from brokk_min.identification import advice, fitting, inspection, validation

        settings = self.settings
        check_settings(settings)
        fits = settings.valve or settings.members == 1
        check(fits, "--members", "1 of nets that read the commands", settings.members)
        check(self.out.suffix == ".npz", "--out", "a name in .npz", self.out)
        self.writes(self.out, self.json)
        log, known = self.read_logs(self.logs, machine)
        name = known.name if known else ""
        of = name or "an unknown machine: one a joint, without a valve"
        print(f"nets of {of}", flush=True)  # now, not after the fit
        every = log
        if self.test:
            with expected(self.test[0], "a log of the same joints"):
                test = logs.in_order(self.read_logs(self.test, machine)[0], log.joints)
                twins = inspection.repeated(test.recordings, log.recordings)
                require(not twins, "--test", "recordings that LOGS has not", brief(twins))
                validation.scored_steps(test, machine.history)  # now, not after the search below
            every = logs.join_logs({Path("LOGS"): log, Path("--test"): test})
            fitted = len(log.recordings)  # now each name is there once
            log = every._replace(recordings=every.recordings[:fitted])
            test = every._replace(recordings=every.recordings[fitted:])
        reports = inspection.inspect(every, known)
        for wrong in advice.refusals(every, reports):
            raise ValueError(f"{self.logs[0] if len(self.logs) == 1 else 'LOGS'}: {wrong}")
        warnings, resting = [*advice.warnings(every, reports, known)], advice.resting(reports)
        print(*(f"warning: {one}\n" for one in warnings), sep="", end="", flush=True)
        with expected(self.logs[0], "a log to fit to"):
            log = logs.without(log, resting)
        with expected((self.test or self.logs)[0], "a log to score on"):
            log, test = (log, logs.without(test, resting)) if self.test else logs.split(log)
            unscored = [*validation.unscored(test, machine.history)]
        print(*(f"warning: {one}\n" for one in unscored), sep="", end="", flush=True)
        net = fitting.fit_nets(log, settings, self.seed, machine, name)
        save_net(self.out, net)
        scores = validation.score(net, test)
        of_scores = [*validation.warnings(scores)]
        if self.json:
            files = {"logs": list(map(str, self.logs)), "test": list(map(str, self.test))}
            meta = {"machine": name, **files, **net.training}
            told = {"joints": scores, "warnings": of_scores + warnings + unscored}
            write_json(self.json, {"meta": meta} | told)
        print(f"{self.out}: nets of {of}")
        print_scores(scores, of_scores)


def is_table(path: Path) -> bool:
    """Is it a table or a recording of ROS, no log of a bus?"""
    return path.is_dir() or path.suffix.lower() in columns.TABLES


def print_scores(scores: Mapping[str, Any], warnings: Sequence[str]) -> None:
    """The errors of nets; a line for each warning."""
    if scores:
        print("joint: error of one step, of the last velocity again; of free runs [rad/s]:")
    for name, net in scores.items():
        if not net["free_run"]:
            continue
        errors = [net.get(f"{kind}_rmse", np.nan) for kind in ("one_step", "persistence")]
        runs = [f"{k} s {run['velocity_rmse']:.4f}" for k, run in net["free_run"].items()]
        print("{}: {:.4f}, {:.4f};".format(name, *errors), ", ".join(runs))
    for warning in warnings:
        print(f"warning: {warning}")
