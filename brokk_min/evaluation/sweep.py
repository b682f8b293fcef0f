"""Many seeds of one training, on this machine's cores or on a cluster.

Each seed writes `seed_<n>.npz`, its learning curve and, last, `seed_<n>.json`; what exists is not
computed again. On a cluster all workers must have the folder.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from brokk_min._files import expect_same, read_json, write_json
from brokk_min.actuator import ActuatorNet
from brokk_min.evaluation import metrics
from brokk_min.evaluation.metrics import Mean, Rows, by_start, mean_interval
from brokk_min.evaluation.sequences import evaluation_starts, task_sequences
from brokk_min.identification.net_file import fingerprint
from brokk_min.learning.checkpoint import train_policy
from brokk_min.learning.jobs import side_by_side
from brokk_min.learning.policy import PolicyController
from brokk_min.learning.recipes import Recipe
from brokk_min.machine import Machine

KEYS = ("velocity_error_mean", "off_axis_drift_max", "jerk_rms", "valve_travel")


def sweep(
    machine: Machine,
    net: ActuatorNet,
    recipe: Recipe,
    seeds: Sequence[int],
    out: Path,
    starts: int,
    scheduler: str | None = None,
) -> dict[str, Mean]:
    """Train and evaluate `seeds`; all runs, and the means over seeds, go to `sweep.json`.

    `net` and `recipe` are those of `train_policy`, `out` is the folder of all files, `starts` the
    number of start poses, `scheduler` the address of a dask scheduler (None: this machine).
    ValueError: with the seeds that failed and why, after all others are written.
    """
    out.mkdir(parents=True, exist_ok=True)
    job = partial(run_seed, machine, net, recipe, out.resolve(), starts)
    jobs = {f"seed {seed}": partial(_attempt, job, seed) for seed in seeds}
    done = dict(zip(seeds, side_by_side(jobs, {}, scheduler=scheduler), strict=True))
    failed = {seed: text for seed, text in done.items() if isinstance(text, str)}
    results = {seed: rows for seed, rows in done.items() if seed not in failed}
    table = over_seeds(list(results.values())) if results else {}
    meta = metrics.metadata(machine, min(seeds)) | {"actuator": fingerprint(net)}
    rows = [{"seed": seed} | row for seed, of in results.items() for row in of]
    write_json(out / "sweep.json", {"meta": meta, "failed": failed, "table": table, "runs": rows})
    if failed:
        raise ValueError("; ".join(f"seed {seed}: {text}" for seed, text in failed.items()))
    return table


def _attempt(job: Any, seed: int) -> Rows | str:
    """Rows of a seed, or why it failed: the other seeds go on."""
    try:
        rows: Rows = job(seed)
        return rows
    except Exception as error:
        return str(error) or type(error).__name__


def run_seed(
    machine: Machine, net: ActuatorNet, recipe: Recipe, out: Path, starts: int, seed: int
) -> Rows:
    """Train one seed, and score it on the sequences and starts of `evaluate`.

    ValueError: the folder `out` has a result of this seed from another training or evaluation.
    """
    file = out / f"seed_{seed}.json"
    identity = {"actuator": fingerprint(net), "recipe": repr(recipe), "starts": starts}
    if file.exists():
        result: dict[str, Any] = read_json(file, "the result of a seed")
        expect_same(file, result, identity)
        recorded: Rows = result["runs"]
        return recorded
    resume = (out / f"seed_{seed}.npz.checkpoint").exists()
    policy = train_policy(machine, net, recipe, seed, out / f"seed_{seed}.npz", resume)
    commands = task_sequences(machine)
    poses = evaluation_starts(machine, starts, commands, 2)
    controllers = {"rl": PolicyController(machine, policy)}
    rows, _ = metrics.evaluate(machine, controllers, commands, poses, 0)
    write_json(file, identity | {"runs": rows})
    return rows


def over_seeds(seeds: Sequence[Rows]) -> dict[str, Mean]:
    """Means over seeds with their 95 % intervals, of each sequence's error and of all `KEYS`.

    A seed counts once, with its mean over the workspace starts.
    """
    names = list(dict.fromkeys(run["sequence"] for run in seeds[0]))
    columns = {f"velocity_error {name}": (name, KEYS[0]) for name in names}
    columns |= {key: ("all", key) for key in KEYS}
    scored = [[run for run in rows if run["kind"] == "workspace"] for rows in seeds]
    return {
        label: mean_interval(np.array([by_start(rows, "rl", *of).mean() for rows in scored]))
        for label, of in columns.items()
    }


def show(table: Mapping[str, Mean]) -> str:
    """The table of `over_seeds` as text, one line a figure."""
    lines = [f"{'':24} mean over seeds (95 % interval)"]
    for label, number in table.items():
        low, high = number["low"], number["high"]
        interval = "" if low is None else f" ({low:.4f} to {high:.4f})"
        lines.append(f"{label:24} {number['mean']:.4f}{interval}")
    return "\n".join(lines)
