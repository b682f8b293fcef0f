"""The whole chain on a machine in MuJoCo: weight, inertia and loads that no net was told of.

    python -m benchmarks.mujoco [--folder results-mujoco] [--quick]

It records the machine of `examples/mujoco_brokk.py`, fits nets to the recordings, trains policies
on the nets, and tunes the PIDs on the machine itself. Then it scores all of them on the nets, on
the machine, and on the machine with a load, on a slope and with a weaker pump, of which neither
nets nor gains know, plain and adaptive (`beyond.adaptation`). What the folder holds already is not
made again. `mujoco.md` in the folder is the page, `mujoco.json` has all runs.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import tyro

import benchmarks  # noqa: F401, before NumPy computes: one thread
from brokk_min._files import write_json
from brokk_min.actuator import ActuatorNet
from brokk_min.beyond.rich_excitation import RICH
from brokk_min.evaluation import adaptive, baselines, metrics, sequences
from brokk_min.evaluation.reproduce import QUICK, Budget, Chain, fit_net, train_one
from brokk_min.evaluation.rollout import title
from brokk_min.fit import Log, collect
from brokk_min.identification import advice, inspection, logs, validation
from brokk_min.identification.net_file import load_net, select_nets
from brokk_min.learning.jobs import side_by_side
from brokk_min.learning.policy import POLICIES, load_policy
from brokk_min.machine import BROKK_170 as M
from examples.mujoco_brokk import PLANT, MujocoBrokk

PLANTS = {
    "machine": PLANT,
    "with 300 kg": MujocoBrokk(load=300.0),
    "on a slope of 5 degrees": MujocoBrokk(slope=5.0),
    "pump of two thirds": MujocoBrokk(pump=2 / 3),
}
PIDS = (baselines.BY_HAND, baselines.OPTIMISED, baselines.STRONGEST)
AFTER = 10  # s, of the free runs that are printed
PAGE = """\
Mean velocity error [m/s] and largest drift off the commanded line [m] on the machine of
`examples/mujoco_brokk.py`, over {sequences} sequences from {starts} starts. The policies
learned on nets of that machine, and the PIDs were tuned on the machine itself. In free runs of
{after} s the nets' velocities are off by {free_runs} of the joints' rms speed.

{table}
"""


@dataclass
class Options:
    folder: Path = Path("results-mujoco")  # Logs, nets, policies, gains, figures, table.
    policies: tuple[str, ...] = ("rl", "rl_paper")  # Which are trained, all on the same nets.
    steps: int | None = None  # Of each training; by default as many as its recipe has.
    starts: int = 16  # Start poses.
    seed: int = 0  # Of everything that is random.
    quick: bool = False  # Tiny fits, trainings and tunings: only to show that it runs.


def record(chain: Chain) -> tuple[Log, Log]:
    """The log that nets are fitted to, one joint at a time, and that of a task to score them."""
    rng, read = np.random.default_rng, []
    recorders: dict[str, Callable[[], Log]] = {
        "log": lambda: collect(M, chain.budget.hours, rng(chain.seed), PLANT, RICH),
        "log_test": lambda: validation.task_log(M, 20, 40.0, rng(chain.seed + 1), plant=PLANT),
    }
    for name, recorder in recorders.items():
        file = chain.out / f"{name}.npz"
        if not file.exists():
            logs.write_log(file, recorder())
        read.append(logs.read_log(file, M))
    return read[0], read[1]


def nets(chain: Chain, log: Log) -> ActuatorNet:
    """The nets of all joints."""
    file = chain.out / "net.npz"
    return load_net(file) if file.exists() else fit_net(chain, "net", log, {})


def make(options: Options, chain: Chain, net: ActuatorNet) -> None:
    """The policies and the gains that the folder lacks, side by side."""
    gains, driven = chain.out / "gains.json", select_nets(M, net)
    lacking = [name for name in options.policies if not (chain.out / POLICIES[name]).exists()]
    jobs: dict[str, Callable[..., Any]] = {n: partial(train_one, chain, n, net) for n in lacking}
    if not gains.exists():
        arguments = (M, driven, chain.budget.tuning, chain.seed, PLANT)
        jobs["gains"] = partial(baselines.tuned_baselines, *arguments)
    done = side_by_side(jobs) if jobs else {}
    if "gains" in done:
        baselines.write_gains(gains, done["gains"], baselines.gains_metadata(M, driven))


def controllers(options: Options, chain: Chain, net: ActuatorNet) -> dict[str, Any]:
    """The policies and the PIDs of the folder by name."""
    files = {name: chain.out / POLICIES[name] for name in options.policies}
    policies = {name: load_policy(file, M) for name, file in files.items()}
    pids = baselines.read_gains(chain.out / "gains.json", M, select_nets(M, net))
    return policies | {name: pids[name] for name in PIDS}


def score(options: Options, net: ActuatorNet, rivals: Mapping[str, Any]) -> dict[str, Any]:
    """Runs of all controllers, by what moves: the nets, and each of `PLANTS`."""
    commands = sequences.task_sequences(M)
    starts = sequences.evaluation_starts(M, options.starts, commands, options.seed + 2)
    if options.quick:
        commands = [s._replace(goals=s.goals[: round(8.0 * M.rate)]) for s in commands[:3]]
        starts = starts[:4]
    driven, motions = (
        select_nets(M, net),
        adaptive.warm_up_motions(M, 2.0 if options.quick else 20.0),
    )
    learning = {
        name: one for name, one in rivals.items() if name in (*POLICIES, baselines.STRONGEST)
    }

    def of_each(plant: Any) -> list[dict[str, Any]]:
        rows = len(commands) * len(starts)
        both = adaptive.cold_and_warm(learning, driven, M, M, rows, motions, plant)
        runs, _ = metrics.evaluate(M, {**rivals, **both}, commands, starts, options.seed, plant)
        return runs

    plants = {"nets": driven, **PLANTS}
    return side_by_side({name: partial(of_each, plant) for name, plant in plants.items()})


def table(runs: Mapping[str, Any]) -> str:
    """Error and drift by controller and plant, and the error on the machine by that on the nets."""
    lines = ["| | " + " | ".join([*runs, "machine by nets"]) + " |"]
    lines.append("|---" * (len(runs) + 2) + "|")
    means = {plant: metrics.means(rows) for plant, rows in runs.items()}
    for name in means["nets"]:
        figures = [of[name]["all"] for of in means.values()]
        errors = [figure["velocity_error_mean"]["mean"] for figure in figures]
        drifts = [figure["off_axis_drift_max"]["mean"] for figure in figures]
        cells = [f"{error:.4f}, {drift:.3f}" for error, drift in zip(errors, drifts, strict=True)]
        cells.append(f"{errors[1] / errors[0]:.2f}")
        lines.append(f"| {title(name)} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def free_runs(net: ActuatorNet, test: Log) -> dict[str, float]:
    """Error of each driven joint's velocity in free runs of `AFTER` s, by its rms speed."""
    scores = validation.score(net, logs.in_order(test, net.joints))
    runs = {M.names[i]: scores[M.names[i]]["free_run"][str(AFTER)] for i in M.driven}
    return {name: run["relative_error"] for name, run in runs.items()}


def main(options: Options) -> None:
    """Make what is missing, score all, and write and print the page."""
    budget = QUICK if options.quick else Budget(train_steps=options.steps)
    chain = Chain(M, options.folder, budget, options.seed)
    chain.out.mkdir(parents=True, exist_ok=True)
    log, test = record(chain)
    print("\n".join(advice.table(inspection.inspect(log))))
    net = nets(chain, log)
    make(options, chain, net)
    runs = score(options, net, controllers(options, chain, net))
    errors = free_runs(net, test)
    rows = runs["nets"]
    page = PAGE.format(
        sequences=len(metrics.column(rows, "sequence")),
        starts=len(metrics.column(rows, "start")),
        after=AFTER,
        free_runs=", ".join(f"{error:.0%} ({name})" for name, error in errors.items()),
        table=table(runs),
    )
    write_json(chain.out / "mujoco.json", {"free_runs": errors, "runs": runs})
    (chain.out / "mujoco.md").write_text(page)
    print(page)


if __name__ == "__main__":
    main(tyro.cli(Options))
