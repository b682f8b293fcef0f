"""Ten chains, each with its own logs, nets and policies: means over seeds and their spread.

    python -m benchmarks.seeds [--folder results-seeds] [--seeds 10] [--policies rl ...]

Each seed records, fits and trains as `brokk-min reproduce` does, on one thread, and as many seeds
run at once as there are cores. What the folder holds already is not made again. Policies and the
package's tuned baselines are then scored on the sequences and starts of `evaluate`. PIDs with
feed-forward have it from the nets of each seed. All figures go to `seeds.json` in the folder.
"""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from brokk_min._files import SHIPPED, write_json
from brokk_min.beyond.strong_pid import StrongPID, static_map
from brokk_min.evaluation import metrics, sequences
from brokk_min.evaluation.baselines import read_gains
from brokk_min.evaluation.reproduce import QUICK, Budget, Chain, fit_net, train
from brokk_min.identification import excitation, fitting, logs
from brokk_min.identification.net_file import load_net
from brokk_min.learning.jobs import side_by_side
from brokk_min.learning.policy import POLICIES, PolicyController, load_policy
from brokk_min.machine import BROKK_170 as M

FIGURES = {  # name in the file -> figure of `metrics`
    "error": "velocity_error_mean",
    "drift": "off_axis_drift_max",
    "jerk": "jerk_rms",
    "valve_travel": "valve_travel",
}
RECIPES: dict[str, tuple[str, str, dict[str, Any]]] = {  # policy -> nets, excitation, recipe
    "rl": ("net", "rich", {}),
    "rl_paper": ("net_paper", "sine", fitting.PAPER_RECIPE),
    "rl_critic": ("net_paper", "sine", fitting.PAPER_RECIPE),
}


@dataclass
class Options:
    folder: Path = Path("results-seeds")  # A folder for each seed, and seeds.json.
    seeds: int = 10  # How many, from 0 on.
    policies: tuple[str, ...] = tuple(POLICIES)  # Which are trained.
    quick: bool = False  # Tiny fits and trainings, x, y, z alone: only to show that it runs.


def make(options: Options, name: str, seed: int) -> None:
    """The policy `name` of one seed, and before it the nets, unless the folder has them."""
    budget = QUICK if options.quick else Budget()
    out = options.folder / f"seed_{seed}"
    out.mkdir(parents=True, exist_ok=True)
    chain = Chain(M, out, budget, seed)
    nets, kind, recipe = RECIPES[name]
    if not (out / f"{nets}.npz").exists():
        log_file = out / f"log_{nets}.npz"
        log = excitation.collect(M, budget.hours, kind, np.random.default_rng(seed))
        logs.write_log(log_file, log)
        fit_net(chain, nets, logs.read_log([log_file], M.velocity_samples, rate=M.rate), recipe)
    if not (out / POLICIES[name]).exists():
        train(chain, name, load_net(out / f"{nets}.npz", M))


def score(options: Options) -> list[dict[str, Any]]:
    """A row for each policy that the folder has, and for each baseline: means over starts."""
    commands = sequences.task_sequences(M)
    if options.quick:
        commands = sequences.shorten(M, commands[:3], 8.0)
    starts = sequences.evaluation_starts(M, 8 if options.quick else 64, commands, 2)
    workspace = np.array(sequences.start_kinds(M, starts)) == "workspace"
    policies = {
        (name, seed): load_policy(file, M)
        for seed in range(options.seeds)
        for name in options.policies
        if (file := options.folder / f"seed_{seed}" / POLICIES[name]).exists()
    }
    controllers: dict[Any, Any] = {k: PolicyController(M, p) for k, p in policies.items()}
    shipped = SHIPPED / M.name
    gains = read_gains(shipped / "gains.json", M, load_policy(shipped / "policy.npz", M).net)
    for name, pid in gains.items():
        if not isinstance(pid, StrongPID):
            controllers[name, None] = pid
            continue
        for seed in (seed for policy, seed in policies if policy == "rl"):
            feedforward = static_map(M, policies["rl", seed].net)
            controllers[name, seed] = replace(pid, feedforward=feedforward)
    rows = []
    for (name, seed), controller in controllers.items():
        runs, _ = metrics.evaluate(M, {name: controller}, commands, starts[workspace], 0)
        axes = [run for run in runs if run["sequence"] in sequences.AXES]
        row = {key: mean(runs, figure) for key, figure in FIGURES.items()}
        row["error_xyz"] = mean(axes, "velocity_error_mean")
        rows.append({"controller": name, "seed": seed} | row)
    return rows


def mean(runs: list[dict[str, Any]], figure: str) -> float:
    """Mean of a figure over all runs."""
    return float(np.mean([run[figure] for run in runs]))


def main(options: Options) -> None:
    """Make what is missing, score all and print means, and the largest less the smallest."""
    for name in options.policies:
        jobs = {str(seed): partial(make, options, name, seed) for seed in range(options.seeds)}
        side_by_side(jobs)
    rows = score(options)
    write_json(options.folder / "seeds.json", rows)
    columns = [key for key in rows[0] if key not in ("controller", "seed")]
    print(f"{'mean (largest less smallest)':34}", *(f"{column:>22}" for column in columns))
    for name in dict.fromkeys(row["controller"] for row in rows):
        values = np.array([[r[c] for c in columns] for r in rows if r["controller"] == name])
        spread = np.ptp(values, axis=0)
        cells = [f"{m:.4f} ({s:.4f})" for m, s in zip(values.mean(axis=0), spread, strict=True)]
        print(f"{name:30} {len(values):3}", *(f"{cell:>22}" for cell in cells))


if __name__ == "__main__":
    main(tyro.cli(Options))
