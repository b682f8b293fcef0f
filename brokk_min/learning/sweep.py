"""Many seeds of one training: on this machine's cores, or on a cluster through dask.distributed.

Each seed leaves `seed_<n>.npz`, its learning curve and, last, `seed_<n>.json`; what is there is not run
again. On a cluster the folder must be one that all workers see, and a worker runs one seed at a time.
"""

import json
import multiprocessing
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from brokk_min.actuator import ActuatorNet
from brokk_min.env import TaskConfig
from brokk_min.evaluation import metrics
from brokk_min.evaluation.baselines import gains_metadata, read_gains
from brokk_min.evaluation.metrics import Rows, by_start, mean_interval
from brokk_min.evaluation.sequences import AXES, evaluation_starts, task_sequences
from brokk_min.identification.files import expect_same, expected, require, write_json
from brokk_min.learning.checkpoint import describe_training, train_policy
from brokk_min.learning.policy import PolicyController, load_policy
from brokk_min.machine import Array, Machine
from brokk_min.ppo import PPOConfig

Submit = Callable[..., "Future[Rows]"]


def one_seed(
    machine: Machine,
    net: ActuatorNet,
    task: TaskConfig,
    config: PPOConfig,
    seed: int,
    out: Path,
    starts: int,
) -> Rows:
    """Train a seed and drive the machine with it; takes up what an earlier call left in the folder `out`."""
    policy_file, result_file = out / f"seed_{seed}.npz", out / f"seed_{seed}.json"
    driven = {"starts": starts, "sequences": [s.name for s in task_sequences(machine)]}
    identity = describe_training(machine, net, task, config, False, seed) | driven
    if result_file.exists():
        return _finished(result_file, identity)
    trained = load_policy(policy_file, machine) if policy_file.exists() else None
    if not trained or dict(trained.training) | driven != identity:
        again = Path(f"{policy_file}.checkpoint").exists()
        trained = train_policy(machine, net, task, config, seed, policy_file, resume=again)
    rl = PolicyController(machine, trained)
    runs = _on_the_machine(machine, {"rl": rl}, starts)
    write_json(result_file, {"identity": identity, "runs": runs})
    return runs


def _finished(path: Path, identity: Mapping[str, Any]) -> Rows:
    with expected(path, "the result of a seed"):
        result: dict[str, Any] = json.loads(path.read_text())
        runs: Rows = result["runs"]
        found = result["identity"]
    expect_same(path, found, identity)
    return runs


def _on_the_machine(machine: Machine, controllers: Mapping[str, Any], starts: int) -> Rows:
    """The scored sequences and starts of `evaluate --seed 0`: the same whatever seed was trained."""
    sequences = task_sequences(machine)
    poses = evaluation_starts(machine, starts, sequences, 2)
    return metrics.evaluate(machine, controllers, sequences, poses, 0)[0]


def apart(function: Callable[..., Any], *arguments: Any) -> Any:
    """`function(*arguments)` in a process of its own, once more if that process dies.

    ValueError: it died both times.
    """
    for _ in range(2):
        try:
            with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
                return pool.submit(function, *arguments).result()
        except BrokenProcessPool:
            continue
    raise ValueError("worker: expected it to live, got one that died twice")


@contextmanager
def workers(scheduler: str | None) -> Iterator[Submit]:
    """`submit(function, *arguments)` -> Future: a core each here, or a worker each of a dask scheduler."""
    if scheduler is None:
        # Read by the processes when they start: one core each, and one bar for all of them.
        os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "TQDM_DISABLE": "1"}
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            yield lambda function, *arguments: pool.submit(apart, function, *arguments)
        return
    with require("distributed", "sweep").Client(
        scheduler, timeout=10
    ) as client:  # dask itself runs again what a dead worker had
        threads = {worker["nthreads"] for worker in client.scheduler_info(-1)["workers"].values()}
        if threads - {1}:  # torch's settings and seeds are those of a process
            raise ValueError(
                f"{scheduler}: expected workers with --nthreads 1, got {sorted(threads)}"
            )
        yield client.get_executor(retries=1, pure=False).submit


def sweep(
    machine: Machine,
    net: ActuatorNet,
    task: TaskConfig,
    config: PPOConfig,
    seeds: Sequence[int],
    out: Path,
    starts: int,
    scheduler: str | None = None,
    gains: Path | None = None,
) -> dict[str, dict[str, Any]]:
    """Train and evaluate `seeds`, each on one thread, and write `sweep.json` with all runs and the table.

    All goes into the folder `out`; `starts` is how many poses each scored sequence begins from, `scheduler`
    the address of a dask scheduler (None: this machine), `gains` a file of tuned baselines, for rows beside.
    It gives the `table` of the seeds that came to their end, and of the baselines.

    ValueError: with the seeds that failed and why, after all others are written.
    """
    out.mkdir(parents=True, exist_ok=True)
    config, results, failed = replace(config, threads=1), dict[int, Rows](), dict[int, str]()
    with workers(scheduler) as submit:
        jobs = {
            submit(one_seed, machine, net, task, config, seed, out.resolve(), starts): seed
            for seed in seeds
        }
        for job in tqdm(
            as_completed(jobs), total=len(jobs), desc="sweep", unit="seed", disable=None
        ):
            try:
                results[jobs[job]] = job.result()
            except Exception as error:  # one seed costs itself, not the others
                failed[jobs[job]] = str(error)
    others = read_gains(gains, machine, net) if gains else {}
    beside = _on_the_machine(machine, others, starts)
    figures = table([results[seed] for seed in sorted(results)], beside)
    runs = [{"seed": seed} | row for seed in sorted(results) for row in results[seed]]
    meta = metrics.metadata(machine, min(seeds)) | gains_metadata(machine, net)
    meta |= {"seeds": len(seeds), "failed": failed}
    write_json(out / "sweep.json", {"meta": meta, "table": figures, "runs": runs + beside})
    if failed:
        raise ValueError("; ".join(f"seed {seed}: {why}" for seed, why in sorted(failed.items())))
    return figures


def table(seeds: Sequence[Rows], beside: Rows) -> dict[str, dict[str, Any]]:
    """Velocity error by sequence and of all [m/s], drift [m], travel [full strokes] by controller.

    A seed counts once, with the mean over its workspace starts; intervals are over seeds. Baselines have no
    seeds and so no interval, but what RL has less than each ("rl less ...") has one again.
    """
    sequences = list(
        dict.fromkeys(run["sequence"] for run in [*beside, *(row for s in seeds for row in s)])
    )
    columns = {f"velocity_error_{s}": (s, "velocity_error_mean") for s in (*sequences, "all")}
    columns |= {name: ("all", name) for name in ("off_axis_drift_max", "valve_travel")}

    def means(runs: Rows, controller: str) -> Array:
        scored = [run for run in runs if run["kind"] == "workspace"]
        return np.array([by_start(scored, controller, *what).mean() for what in columns.values()])

    rows = {"rl": np.array([means(runs, "rl") for runs in seeds])} if seeds else {}
    for name in dict.fromkeys(run["controller"] for run in beside):
        rows[name] = means(beside, name)[None]
        rows |= {f"rl less {name}": rows["rl"] - rows[name]} if seeds else {}
    return {c: dict(zip(columns, map(mean_interval, of.T), strict=True)) for c, of in rows.items()}


def read_seeds(path: Path) -> dict[str, Any]:
    """The `sweep.json` of a sweep, its "table" that of `sweep.table`; ValueError: it is none."""
    with expected(path, "the sweep.json of a sweep"):
        found: dict[str, Any] = json.loads(path.read_text())
        if not {"mean", "low", "high"} <= set(found["table"]["rl"]["velocity_error_all"]):
            raise ValueError(f"{found['table']['rl']}")
        dict(found["meta"])
    return found


def seeds_of(
    machine: Machine, net: ActuatorNet, sweep: Mapping[str, Any]
) -> dict[str, dict[str, Any]]:
    """The table of a sweep that `read_seeds` read; ValueError: one of another machine or with other nets."""
    wanted = gains_metadata(machine, net)
    found = {name: sweep["meta"].get(name) for name in wanted}
    if found != wanted:
        raise ValueError(f"sweep: expected one with {wanted}, got {found}")
    return dict(sweep["table"])


def show(figures: Mapping[str, Mapping[str, Any]]) -> str:
    """The table as text: a line for each controller."""
    columns = {f"velocity_error_{s}": f"{s} [m/s]" for s in (*AXES, "all")}
    columns |= {"off_axis_drift_max": "drift [m]", "valve_travel": "travel [1]"}
    lines = [
        f"{'mean and 95 % interval':28}" + "".join(f" {name:>18}" for name in columns.values())
    ]
    for controller, row in figures.items():
        cells = [row[name] for name in columns]
        halves = ["" if n["high"] is None else f" +- {n['high'] - n['mean']:.4f}" for n in cells]
        texts = (f"{n['mean']:.4f}{half}" for n, half in zip(cells, halves, strict=True))
        lines.append(f"{controller:28}" + "".join(f" {text:>18}" for text in texts))
    return "\n".join(lines)
