"""Many seeds of one training, on this machine's cores or on a cluster.

Each seed writes `seed_<n>.npz`, its learning curve and, last, `seed_<n>.json`; what exists is not
computed again. On a cluster all workers must have the folder.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from brokk_min._files import expect_same, read_json, write_json
from brokk_min.actuator import ActuatorNet
from brokk_min.evaluation import metrics
from brokk_min.evaluation.metrics import Mean, Rows, interval_text
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
) -> dict[str, dict[str, Mean]]:
    """Train and evaluate `seeds`; all runs, and the means over seeds, go to `sweep.json`.

    `net` and `recipe` are those of `train_policy`, `out` is the folder of all files, `starts` the
    number of start poses, `scheduler` the address of a dask scheduler (None: this machine).
    """
    out.mkdir(parents=True, exist_ok=True)
    job = partial(run_seed, machine, net, recipe, out.resolve(), starts)
    done = side_by_side({str(seed): partial(job, seed) for seed in seeds}, None, scheduler)
    results = {seed: done[str(seed)] for seed in seeds}
    table = over_seeds(results)
    meta = metrics.metadata(machine, min(seeds)) | {"actuator": fingerprint(net)}
    rows = [{"seed": seed} | row for seed, of in results.items() for row in of]
    write_json(out / "sweep.json", {"meta": meta, "table": table, "runs": rows})
    return table


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


def over_seeds(seeds: Mapping[int, Rows]) -> dict[str, dict[str, Mean]]:
    """Means over seeds with intervals, by sequence (also "all") and figure.

    A seed counts once, with its mean over the workspace starts.
    """
    rows = [run | {"start": seed} for seed, of in seeds.items() for run in of]
    return metrics.means([run for run in rows if run["kind"] == "workspace"])["rl"]


def show(table: Mapping[str, Mapping[str, Mean]]) -> str:
    """The figures of all sequences as text, one a line."""
    lines = [f"{key:24} {interval_text(table['all'][key])}" for key in KEYS]
    return "\n".join([f"{'':24} mean over seeds (95 % interval)", *lines])
