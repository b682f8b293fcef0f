"""Many seeds of one training, on this machine's cores or on a cluster."""

from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path

from brokk_min._files import expect_same, write_json
from brokk_min.actuator import ActuatorNet
from brokk_min.evaluation.metrics import Mean, Table, evaluate, means, metadata
from brokk_min.evaluation.sequences import evaluation_starts, task_sequences
from brokk_min.identification.net_file import fingerprint
from brokk_min.learning.checkpoint import train_policy
from brokk_min.learning.jobs import side_by_side
from brokk_min.learning.policy import load_policy
from brokk_min.learning.recipes import Recipe
from brokk_min.machine import Machine


def sweep(
    machine: Machine,
    net: ActuatorNet,
    recipe: Recipe,
    seeds: Sequence[int],
    out: Path,
    starts: int,
    scheduler: str | None = None,
) -> dict[str, dict[str, Mean]]:
    """Train and evaluate `seeds`; means over seeds with intervals, by sequence and figure.

    They and all runs go to `sweep.json` in `out`, policies and their curves to `seed_<n>.npz`. A
    seed counts once, with its mean over `starts` poses. `scheduler` is the address of a dask
    scheduler, whose workers must have the folder (None: this machine).
    """
    out.mkdir(parents=True, exist_ok=True)
    job = partial(run_seed, machine, net, recipe, out.resolve(), starts)
    done = side_by_side({str(seed): partial(job, seed) for seed in seeds}, None, scheduler)
    rows = [{"seed": int(seed)} | row for seed, of in done.items() for row in of]
    table = means([row | {"start": row["seed"]} for row in rows])["rl"]
    meta = metadata(machine, min(seeds)) | {"actuator": fingerprint(net)}
    write_json(out / "sweep.json", {"meta": meta, "table": table, "runs": rows})
    return table


def run_seed(
    machine: Machine, net: ActuatorNet, recipe: Recipe, out: Path, starts: int, seed: int
) -> Table:
    """Train one seed, unless it is, and score it on the sequences and starts of `evaluate`.

    ValueError: the folder `out` has a policy of this seed from another training.
    """
    commands = task_sequences(machine)
    poses = evaluation_starts(machine, starts, commands, 2)  # they may be too few
    file = out / f"seed_{seed}.npz"
    if file.exists():
        policy = load_policy(file, machine)
        training = {"actuator": fingerprint(net), "recipe": asdict(recipe)}
        expect_same(file, policy.training, training)
    else:
        policy = train_policy(machine, net, recipe, seed, file)
    return evaluate(machine, {"rl": policy}, commands, poses, 0)[0]
