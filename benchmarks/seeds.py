"""Ten chains, each with its own logs, nets and policies: means over seeds and their spread.

    python -m benchmarks.seeds [--folder results-seeds] [--seeds 10] [--policies rl rl_paper]

Each seed records, fits and trains as `brokk-min reproduce` does, on one thread; as many seeds run
at once as there are cores. What the folder holds already is not made again. Policies and the
package's tuned baselines are then scored on the sequences and starts of `evaluate`; the paper's
also with valves that close while the tool rests, as the PIDs' do, ours also with dither then. PIDs
with feed-forward have it from the nets of each seed. All figures go to `seeds.json` in the folder,
the learning curve of ours to `seeds.svg`.
"""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from matplotlib.figure import Figure

from brokk_min.evaluation import learn, metrics, sequences
from brokk_min.evaluation.baselines import read_gains
from brokk_min.evaluation.feedforward import static_map
from brokk_min.identification import excitation, fitting, logs
from brokk_min.identification.files import SHIPPED, write_json
from brokk_min.identification.formats import NUMBERS, read_table
from brokk_min.identification.net_file import load_net, select_nets
from brokk_min.learning.policy import POLICIES, PolicyController, load_policy
from brokk_min.machine import BROKK_170 as M

FIGURES = {  # name in the file -> figure of `metrics`
    "error": "velocity_error_mean",
    "drift": "off_axis_drift_max",
    "jerk": "jerk_rms",
    "valve_travel": "valve_travel",
    "joint_motion_at_rest": "joint_motion_at_rest",
}
NAMES = {"rl": "ours closed", "rl_dither": "ours dither", "rl_paper": "paper"}
NAMES |= {"rl_paper_closed": "paper closed"}
OTHER = {"rl": ("rl_dither", "dither"), "rl_paper": ("rl_paper_closed", "closed")}
RECIPES: dict[str, tuple[str, str, dict[str, Any]]] = {  # policy -> nets, excitation, recipe
    "rl": ("net", "rich", {}),
    "rl_paper": ("net_paper", "sine", fitting.PAPER_RECIPE),
}


@dataclass
class Options:
    folder: Path = Path("results-seeds")  # A folder for each seed, and seeds.json.
    seeds: int = 10  # How many, from 0 on.
    policies: tuple[str, ...] = tuple(POLICIES)  # Which are trained.
    quick: bool = False  # Tiny fits and trainings, x, y, z alone: only to show that it runs.


def make(options: Options, name: str, seed: int) -> None:
    """The policy `name` of one seed, and before it the nets, unless the folder has them."""
    budget = learn.QUICK if options.quick else learn.Budget()
    out = options.folder / f"seed_{seed}"
    out.mkdir(parents=True, exist_ok=True)
    chain = learn.Chain(M, out, budget, seed)
    nets, kind, recipe = RECIPES[name]
    if not (out / f"{nets}.npz").exists():
        log_file = out / f"log_{nets}.npz"
        log = excitation.collect(M, budget.hours, kind, np.random.default_rng(seed))
        logs.write_log(log_file, log)
        log = logs.read_log([log_file], M.velocity_samples, rate=M.rate)
        if name == "rl":
            log, _ = learn.first_round(chain, log, recipe)
        learn.fit_net(chain, nets, log, recipe)
    if not (out / POLICIES[name]).exists():
        net = select_nets(M, load_net(out / f"{nets}.npz", M))
        start = load_policy(out / "first" / POLICIES[name], M) if name == "rl" else None
        learn.train(chain, name, net, start)


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
    policies |= {  # once more, with the other rule for valves at rest
        (OTHER[name][0], seed): replace(policy, valves=OTHER[name][1])
        for (name, seed), policy in policies.items()
    }
    controllers: dict[Any, Any] = {k: PolicyController(M, p) for k, p in policies.items()}
    shipped = SHIPPED / M.name
    gains = read_gains(shipped / "gains.json", M, load_policy(shipped / "policy.npz", M).net)
    controllers |= {(name, None): pid for name, pid in gains.items() if not pid.feedforward}
    for seed in (seed for name, seed in policies if name == "rl"):
        feedforward = static_map(M, policies["rl", seed].net).command
        for name, pid in gains.items():
            if pid.feedforward:
                controllers[name, seed] = replace(pid, feedforward=feedforward)
    rows = []
    for (name, seed), controller in controllers.items():
        runs, _ = metrics.evaluate(M, {name: controller}, commands, starts[workspace], 0)
        axes = [run for run in runs if run["sequence"] in sequences.AXES]
        row = {key: mean(runs, figure) for key, figure in FIGURES.items()}
        row["error_xyz"] = mean(axes, "velocity_error_mean")
        row["drift_xyz"] = mean(axes, "off_axis_drift_max")
        rows.append({"controller": NAMES.get(name, name), "seed": seed} | row)
    return rows


def mean(runs: list[dict[str, Any]], figure: str) -> float:
    """Mean of a figure over the runs that have it: some never rest."""
    return float(np.mean([run[figure] for run in runs if run[figure] is not None]))


def draw(options: Options) -> None:
    """Velocity error on the nets while ours learn, in both rounds: mean and range of the seeds."""
    folders = sorted(options.folder.glob("seed_*"))
    rounds = [
        [folder / part / f"{POLICIES['rl']}.csv" for folder in folders] for part in ("first", ".")
    ]
    if not rounds[1] or not all(file.exists() for file in rounds[1]):
        return
    figure = Figure(figsize=(7.0, 2.4), layout="compressed")
    axes = figure.subplots()
    begin, label = 0.0, f"ours, {len(folders)} seeds"
    for files in rounds:
        columns = dict.fromkeys(("global_step", "charts/velocity_error"), NUMBERS)
        tables = [read_table(file, columns) for file in files]
        million_steps = begin + tables[0]["global_step"] / 1e6
        errors = np.array([table["charts/velocity_error"] for table in tables])
        axes.plot(million_steps, errors.mean(axis=0), color="black", label=label)
        axes.fill_between(million_steps, errors.min(axis=0), errors.max(axis=0), alpha=0.3)
        begin, label = million_steps[-1], ""
        axes.axvline(begin, color="grey", linestyle=":")
    axes.set(xlabel="environment steps [million]", ylabel="velocity error [m/s]", yscale="log")
    axes.legend()
    figure.savefig(options.folder / "seeds.svg", metadata={"Date": None})


def main(options: Options) -> None:
    """Make what is missing, score all and print means, and the largest less the smallest."""
    for name in options.policies:
        jobs = {str(seed): partial(make, options, name, seed) for seed in range(options.seeds)}
        learn.side_by_side(jobs, {})
    rows = score(options)
    write_json(options.folder / "seeds.json", rows)
    draw(options)
    columns = [key for key in rows[0] if key not in ("controller", "seed")]
    print(f"{'mean (largest less smallest)':34}", *(f"{column:>22}" for column in columns))
    for name in dict.fromkeys(row["controller"] for row in rows):
        values = np.array([[r[c] for c in columns] for r in rows if r["controller"] == name])
        spread = np.ptp(values, axis=0)
        cells = [f"{m:.4f} ({s:.4f})" for m, s in zip(values.mean(axis=0), spread, strict=True)]
        print(f"{name:30} {len(values):3}", *(f"{cell:>22}" for cell in cells))


if __name__ == "__main__":
    main(tyro.cli(Options))
