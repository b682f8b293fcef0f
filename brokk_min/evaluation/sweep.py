"""Many seeds of one training, on this machine's cores or on a cluster."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path

from brokk_min._files import digest, expect_same, write_json
from brokk_min.actuator import ActuatorNet
from brokk_min.evaluation.baselines import read_gains
from brokk_min.evaluation.metrics import Mean, Table, evaluate, means, metadata
from brokk_min.evaluation.reproduce import mean_errors, robustness
from brokk_min.evaluation.sequences import AXES, axis_sequences, evaluation_starts, task_sequences
from brokk_min.identification.net_file import fingerprint
from brokk_min.learning.checkpoint import train_policy
from brokk_min.learning.jobs import side_by_side
from brokk_min.learning.policy import POLICIES, load_policy
from brokk_min.learning.recipes import Recipe
from brokk_min.machine import Controller, Machine, require


def sweep(
    machine: Machine,
    net: ActuatorNet,
    recipe: Recipe,
    seeds: Sequence[int],
    out: Path,
    starts: int,
    scheduler: str | None = None,
    beside: Path | None = None,
) -> dict[str, dict[str, Mean]]:
    """Train and evaluate `seeds`; means over seeds with intervals, by sequence and figure.

    The sequence "along" is the mean of x, y and z. They go to `seeds.json` in `out`, with all runs
    to `sweep.json`, policies and their curves to `seed_<n>.npz`. A seed counts once, with its mean
    over `starts` poses. `scheduler` is the address of a dask scheduler, whose workers must have the
    folder (None: this machine). With a folder `beside` of `reproduce`, or of the package,
    `robustness.json` has the mean errors on changed machines, too.
    """
    others = {name: file for name, file in POLICIES.items() if name != "rl"}
    for file in (*others.values(), "gains.json") if beside else ():
        there = beside is None or (beside / file).exists()
        require(there, f"--robustness {beside}", f"a folder of `reproduce`, with {file}", "none")
    if beside:  # now, and not after the trainings
        read_gains(beside / "gains.json", machine, net)
        for file in others.values():
            load_policy(beside / file, machine)
    out.mkdir(parents=True, exist_ok=True)
    job = partial(run_seed, machine, net, recipe, out.resolve(), starts)
    done = side_by_side({str(seed): partial(job, seed) for seed in seeds}, None, scheduler)
    rows = [{"seed": int(seed)} | row for seed, of in done.items() for row in of]
    each = [row | {"start": row["seed"]} for row in rows]
    along = means([row for row in each if row["sequence"] in AXES])["rl"]["all"]
    table = {**means(each)["rl"], "along": along}
    meta = metadata(machine, min(seeds)) | {"actuator": fingerprint(net)}
    meta |= {"seeds": [int(seed) for seed in seeds], "recipe": asdict(recipe)}
    write_json(out / "seeds.json", {"meta": meta, "table": table})
    write_json(out / "sweep.json", {"meta": meta, "table": table, "runs": rows})
    if beside:
        policies = {f"seed {seed}": out / f"seed_{seed}.npz" for seed in seeds}
        score = partial(vary, machine, net, min(starts, 16))
        rivals = {name: beside / file for name, file in (others | {"pids": "gains.json"}).items()}
        every = policies | rivals
        jobs = {name: partial(score, name, file) for name, file in every.items()}
        cases = side_by_side(jobs, None, scheduler)
        meta |= {"starts": min(starts, 16)}
        meta["files"] = {file.name: digest(file) for file in every.values()}
        result = {"meta": meta, "robustness": pool(cases, [*policies])}
        write_json(out / "robustness.json", result)
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
        training = {"actuator": fingerprint(net), "recipe": asdict(recipe), "seed": seed}
        expect_same(file, policy.training, training)
    else:
        policy = train_policy(machine, net, recipe, seed, file)
    return evaluate(machine, {"rl": policy}, commands, poses, 0)[0]


def vary(
    machine: Machine, net: ActuatorNet, starts: int, name: str, file: Path
) -> dict[str, Table]:
    """`reproduce.robustness` of the policy of a file, by its `name`, or of the PIDs of its gains.

    Runs are those along x, y and z. A seed of a sweep is called "rl".
    """
    sequences = axis_sequences(machine)
    poses = evaluation_starts(machine, starts, task_sequences(machine), 2)
    if name == "pids":
        controllers: dict[str, Controller] = {**read_gains(file, machine, net)}
    else:
        controllers = {"rl" if name.startswith("seed") else name: load_policy(file, machine)}
    drives = robustness(machine, controllers, net, sequences, poses, 0)
    return {case: drive() for case, drive in drives.items()}


def pool(
    cases: Mapping[str, Mapping[str, Table]], seeds: Sequence[str]
) -> dict[str, dict[str, Mean]]:
    """Mean errors by variation and controller: of "rl" over `seeds`, of others over starts."""
    merged: dict[str, Table] = {}
    for name, by_case in cases.items():
        for case, runs in by_case.items():
            one = [run | {"start": seeds.index(name)} if name in seeds else run for run in runs]
            merged.setdefault(case, []).extend(one)
    return mean_errors(merged)
