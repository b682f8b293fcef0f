"""The commands that compare: policies and baselines, the whole chain."""

import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from brokk_min._files import require_package, whole_file, write_json
from brokk_min.actuator import ActuatorNet, Plant
from brokk_min.can.operator_input import read_commands
from brokk_min.cli.options import Command, check, default_policy, find_plant, own_controller
from brokk_min.evaluation import adaptive, baselines, metrics, sequences
from brokk_min.evaluation.rollout import title, valves_at_rest
from brokk_min.jacobian import JacobianController
from brokk_min.learning.policy import POLICIES, load_policy
from brokk_min.machine import Array, Controller, Machine


@dataclass(kw_only=True)
class Evaluate(Command):
    """Policies and tuned baselines on the same sequences and starts."""

    policy: Path | None = None  # Policy that `train` wrote; by default those of the package.
    commands: Path | None = None  # Velocity sequences, CSV: sequence,time,vx,vy,vz [s, m/s].
    starts: Path | None = None  # Start poses, CSV: one column per joint [rad].
    plant: str = "analytic"  # What moves: analytic, net (of the policy), FILE.npz, FILE.py:NAME.
    controller: str = ""  # Also one of your own: FILE.py:NAME, a function of machine and nets.
    json: Path | None = None  # Also write all runs here.
    save_gains: Path | None = None  # Tune the PIDs, even if there are gains; write them here.
    num_starts: int = 16  # Without --starts: how many of the machine's.
    adapt: bool = False  # Also each controller as it learns its valves: cold, and after a minute.
    seed: int = 0  # Of the noise, and of what is drawn and tuned.

    def __call__(self, machine: Machine) -> None:
        path, gains = default_policy(machine, self.policy)
        elsewhere = gains and gains.parent != path.parent and self.plant != "analytic"
        gains = None if self.save_gains or elsewhere else gains
        self.writes(self.json, self.save_gains, reads=[path, gains])
        files = [path] if self.policy else [path.with_name(file) for file in POLICIES.values()]
        loaded = [load_policy(file, machine) for file in files]
        names = [loaded[0].name] if self.policy else [*POLICIES]
        policies, net = dict(zip(names, loaded, strict=True)), loaded[0].net
        plant = net if self.plant == "net" else find_plant(self.plant, machine)
        commands, starts = self.task(machine)
        own: dict[str, Controller] = {}
        if self.controller:  # before PIDs are tuned
            own[self.controller] = own_controller(self.controller, machine, net)
            moment = commands[0]._replace(goals=commands[0].goals[:2])
            tried = {"": own_controller(self.controller, machine, net)}
            metrics.evaluate(machine, tried, [moment], starts[:1], self.seed, plant)
        pids = self.pids(machine, net, plant, gains)
        controllers: dict[str, Controller] = {**policies, **pids, **own}
        if self.adapt:
            rows, motions = len(commands) * len(starts), adaptive.warm_up_motions(machine)
            controllers |= adaptive.cold_and_warm(
                controllers, net, machine, machine, rows, motions, plant
            )
        runs, _ = metrics.evaluate(machine, controllers, commands, starts, self.seed, plant)
        runs = [run | {"kind": "file"} for run in runs] if self.starts else runs
        if self.json:
            meta = {"policy": str(path), "gains": str(gains or "tuned now"), "plant": self.plant}
            meta["commands"] = str(self.commands or "own")
            meta["starts"] = str(self.starts or self.num_starts)
            meta |= metrics.metadata(machine, self.seed)
            write_json(self.json, {"meta": meta, "runs": runs})
        print(table(runs))

    def task(self, machine: Machine) -> tuple[list[sequences.Commands], Array]:
        """Velocity sequences and start poses of files, or the machine's own."""
        own = sequences.task_sequences(machine)
        given = read_commands(self.commands, machine) if self.commands else {}
        commands = [sequences.Commands(name, goals) for name, goals in given.items()] or own
        if self.starts:
            return commands, sequences.read_starts(self.starts, machine)
        starts = sequences.evaluation_starts(machine, self.num_starts, own, self.seed + 2)
        for one in commands if given else ():
            follow = sequences.feasible(machine, starts, one.for_starts(machine, starts))
            if not follow.all():
                got = f"{sum(~follow)} of {len(starts)} that leave the arm's ranges or speeds"
                wanted = f"starts from which the arm can follow {one.name} (--starts)"
                print(f"warning: --commands: expected {wanted}, got {got}", file=sys.stderr)
        return commands, starts

    def pids(
        self, machine: Machine, net: ActuatorNet, plant: Plant, path: Path | None
    ) -> dict[str, JacobianController]:
        """The baselines with the gains of a file, or with gains that are tuned now."""
        print(f"gains of the baselines: {path or 'tuned now, for minutes'}", file=sys.stderr)
        if path:
            return baselines.load_pids(machine, path, net)
        tuned = baselines.tuned_baselines(machine, net, baselines.EFFORT, self.seed, plant)
        if self.save_gains:
            meta = metrics.metadata(machine, self.seed) | baselines.gains_metadata(machine, net)
            meta |= {"effort": baselines.EFFORT, "plant": self.plant}
            baselines.write_gains(self.save_gains, tuned, meta)
        return tuned


def table(runs: Sequence[metrics.Run]) -> str:
    """Means by controller."""
    num, motions = (len(metrics.column(runs, label)) for label in ("start", "sequence"))
    row = "{:56}{:>15}" + "{:>15}" * len(metrics.COLUMNS)
    lines = [f"means over {motions} sequences from {num} starts"]
    lines.append(row.format("", "valves at rest", *metrics.COLUMNS.values()))
    for name, rows in metrics.means(runs).items():
        numbers = (rows["all"][key]["mean"] for key in metrics.COLUMNS)
        cells = ("-" if x is None else f"{x:.4g}" for x in numbers)
        lines.append(row.format(title(name), valves_at_rest(name), *cells))
    return "\n".join(lines)


@dataclass(kw_only=True)
class Reproduce(Command):
    """The whole chain: logs, nets, policies, baselines, comparison, report.html, results.json."""

    out: Path = Path("results")  # Folder for everything.
    quick: bool = False  # The same, smaller: to see that it runs, not to assess the policy.
    seed: int = 0  # Of everything that is random.

    def __call__(self, machine: Machine) -> None:
        require_package("torch", "train")
        from brokk_min.evaluation.reproduce import QUICK, Budget, reproduce  # loads torch

        budget = QUICK if self.quick else Budget()
        file = self.out / "results.json"
        check(self.force or not file.exists(), str(file), "no file (or --force)", "one")
        kept = self.out / "chain.json"  # what a chain that was stopped leaves
        chain = {"machine": repr(machine), "seed": self.seed, "budget": asdict(budget)}
        text = json.dumps(chain, indent=1)
        for name in ("log.npz", "net.npz", *POLICIES.values(), "gains.json"):
            free = self.force or kept.exists() or not (self.out / name).exists()
            got = "one that `reproduce` did not write"
            check(free, str(self.out / name), "no file (or --force)", got)
        if not kept.exists() or kept.read_text("utf-8") != text:
            for path in self.out.glob("policy*.checkpoint"):
                got = "one of a chain with another machine, seed or length"
                check(self.force, str(path), "no file (or --force)", got)
                path.unlink()
        self.out.mkdir(parents=True, exist_ok=True)
        with whole_file(kept, "w") as opened:
            opened.write(text)
        results = reproduce(machine, self.out, budget, self.seed)
        print(table(results["task_space"]["runs"]), *results["trainings"], sep="\n")
        print(self.out / "report.html", file, sep="\n")
