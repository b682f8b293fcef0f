"""Many seeds of one training: what `brokk-min sweep` runs, writes and prints.

They run on this machine's cores, or on a cluster, through dask.distributed. Each seed writes
`seed_<n>.npz`, its learning curve and, last, `seed_<n>.json`; what exists is not computed again.
On a cluster all workers must have the folder, and run one seed at a time.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from brokk_min.actuator import ActuatorNet
from brokk_min.env import TaskConfig
from brokk_min.evaluation import metrics
from brokk_min.evaluation.baselines import gains_metadata, read_gains
from brokk_min.evaluation.learn import connect
from brokk_min.evaluation.metrics import Controllers, Rows, by_start, mean_interval
from brokk_min.evaluation.sequences import AXES, evaluation_starts, task_sequences
from brokk_min.identification.files import brief, expect_same, read_json, write_json
from brokk_min.identification.formats import RUNS, SWEEP, Field, check_fields
from brokk_min.identification.progress import progress
from brokk_min.learning.checkpoint import describe_training, train_policy
from brokk_min.learning.policy import PolicyController, load_policy
from brokk_min.machine import Array, Machine
from brokk_min.ppo import PPOConfig

Table = dict[str, dict[str, Any]]  # mean and interval of each figure, by controller


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
    critic: bool = False,
) -> Table:
    """Train and evaluate `seeds`, each on one thread; all runs and the table go to `sweep.json`.

    `net`, `task`, `config` and `critic` are those of `train_policy`. `out` is the folder of all
    files, `starts` the number of poses from which each scored sequence begins, `scheduler` the
    address of a dask scheduler (None: this machine), `gains` a file of tuned baselines, for
    further rows. Returns the `table` of the seeds that came to their end, and of the baselines.
    ValueError: with the seeds that failed and why, after all others are written.
    """
    out.mkdir(parents=True, exist_ok=True)
    config = replace(config, threads=1)
    job = partial(run_seed, machine, net, task, config, critic, out.resolve(), starts)
    results, failed = run_seeds(job, seeds, scheduler)
    baselines = read_gains(gains, machine, net) if gains else {}
    baseline_rows = run_scored(machine, baselines, starts)
    figures = table([results[seed] for seed in sorted(results)], baseline_rows)
    rows = [{"seed": seed} | row for seed in sorted(results) for row in results[seed]]
    meta = metrics.metadata(machine, min(seeds)) | gains_metadata(machine, net)
    meta |= {"seeds": len(seeds), "failed": failed}
    write_json(out / "sweep.json", {"meta": meta, "table": figures, "runs": rows + baseline_rows})
    if failed:
        raise ValueError("; ".join(f"seed {seed}: {failed[seed]}" for seed in sorted(failed)))
    return figures


def run_seed(
    machine: Machine,
    net: ActuatorNet,
    task: TaskConfig,
    config: PPOConfig,
    critic: bool,
    out: Path,
    starts: int,
    seed: int,
) -> Rows:
    """Train and score one seed, or go on from what the folder `out` holds of it; see `sweep`.

    ValueError: a result of another training or evaluation.
    """
    policy_file = out / f"seed_{seed}.npz"
    result_file = out / f"seed_{seed}.json"
    training = describe_training(machine, net, task, config, critic, seed)
    names = [sequence.name for sequence in task_sequences(machine)]
    identity = {**training, "starts": starts, "sequences": names}
    if result_file.exists():
        result: dict[str, Any] = read_json(result_file, "the result of a seed")
        check_fields(result_file, result, {"identity": Field("object"), **RUNS}, {})
        expect_same(result_file, result["identity"], identity)
        recorded: Rows = result["runs"]
        return recorded
    policy = load_policy(policy_file, machine) if policy_file.exists() else None
    if policy is None or dict(policy.training) != training:
        resume = Path(f"{policy_file}.checkpoint").exists()
        policy = train_policy(machine, net, task, config, seed, policy_file, critic, resume)
    rows = run_scored(machine, {"rl": PolicyController(machine, policy)}, starts)
    write_json(result_file, {"identity": identity, "runs": rows})
    return rows


def run_seeds(
    job: Callable[[int], Rows], seeds: Sequence[int], scheduler: str | None = None
) -> tuple[dict[int, Rows], dict[int, str]]:
    """Results of `job`, and messages of failures, by seed.

    Each job runs on one core here, or on one worker of the dask scheduler at the address
    `scheduler`; dask repeats it if the worker dies. ValueError: workers of several threads, which
    would share torch's settings.
    """
    from distributed import as_completed  # slow to import

    results: dict[int, Rows] = {}
    failed: dict[int, str] = {}
    with connect(scheduler) as client:
        workers = client.scheduler_info(n_workers=-1)["workers"].values()
        threads = {worker["nthreads"] for worker in workers}
        if threads - {1}:
            got = sorted(threads)
            raise ValueError(f"{scheduler}: expected workers with --nthreads 1, got {got}")
        futures = {client.submit(job, seed, pure=False): seed for seed in seeds}
        done = as_completed(futures)  # type: ignore[no-untyped-call]
        for future in progress(done, total=len(futures), desc="sweep", unit="seed"):
            seed = futures[future]
            if future.status == "finished":
                results[seed] = future.result()
            else:
                failed[seed] = str(future.exception())
    return results, failed


def run_scored(machine: Machine, controllers: Controllers, starts: int) -> Rows:
    """The scored sequences and starts of `evaluate --seed 0`: the same for every training seed."""
    sequences = task_sequences(machine)
    poses = evaluation_starts(machine, starts, sequences, 2)
    return metrics.evaluate(machine, controllers, sequences, poses, 0)[0]


def table(seeds: Sequence[Rows], baselines: Rows) -> Table:
    """Velocity error by sequence and of all [m/s], drift [m], travel [full strokes] by controller.

    A seed counts once, with the mean over its workspace starts; intervals are over seeds. Baselines
    have no seeds and so no interval, but the differences ("rl less ...") have one again.
    """
    runs = [*baselines, *(row for rows in seeds for row in rows)]
    sequences = list(dict.fromkeys(run["sequence"] for run in runs))
    columns = {f"velocity_error_{s}": (s, "velocity_error_mean") for s in (*sequences, "all")}
    columns |= {name: ("all", name) for name in ("off_axis_drift_max", "jerk_rms", "valve_travel")}

    def means(runs: Rows, controller: str) -> Array:
        scored = [run for run in runs if run["kind"] == "workspace"]
        return np.array([by_start(scored, controller, *what).mean() for what in columns.values()])

    rows = {}
    if seeds:
        rows["rl"] = np.array([means(runs, "rl") for runs in seeds])
    for name in dict.fromkeys(run["controller"] for run in baselines):
        rows[name] = means(baselines, name)[None]
        if seeds:
            rows[f"rl less {name}"] = rows["rl"] - rows[name]
    return {
        controller: dict(zip(columns, map(mean_interval, values.T), strict=True))
        for controller, values in rows.items()
    }


def read_seeds(path: Path, required: Mapping[str, str]) -> Table:
    """The table of a `sweep.json`; `required` of its metadata, as `gains_metadata` has it, or none.

    ValueError: another file, or one of another machine or of other nets.
    """
    content: dict[str, Any] = read_json(path, "the sweep.json of a sweep")
    check_fields(path, content, SWEEP, {})
    expect_same(path, content["meta"], required)
    for name, row in content["table"].items():
        if row.keys() != content["table"]["rl"].keys():
            wanted = brief(list(content["table"]["rl"]))
            raise ValueError(f"{path}: table.{name}: expected {wanted}, got {brief(list(row))}")
    return dict(content["table"])


def show(figures: Mapping[str, Mapping[str, Any]]) -> str:
    """The table as text: one line per controller."""
    columns = {f"velocity_error_{s}": f"{s} [m/s]" for s in (*AXES, "all")}
    columns |= {"off_axis_drift_max": "drift [m]", "valve_travel": "travel [1]"}
    header = "".join(f" {name:>18}" for name in columns.values())
    lines = [f"{'mean and 95 % interval':28}" + header]
    for controller, row in figures.items():
        line = f"{controller:28}"
        for name in columns:
            mean, high = row[name]["mean"], row[name]["high"]
            half = "" if high is None else f" +- {high - mean:.4f}"
            line += f" {f'{mean:.4f}{half}':>18}"
        lines.append(line)
    return "\n".join(lines)
