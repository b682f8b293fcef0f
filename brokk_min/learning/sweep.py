"""Many seeds of one training: on this machine's cores, or on a cluster, through dask.distributed.

Each seed writes `seed_<n>.npz`, its learning curve and, last, `seed_<n>.json`; what exists is not
computed again. On a cluster all workers must have the folder, and run one seed at a time.
"""

import logging
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from tqdm import tqdm

from brokk_min.actuator import ActuatorNet
from brokk_min.env import TaskConfig
from brokk_min.identification.files import expect_same, expected, read_json, require, write_json
from brokk_min.learning.checkpoint import describe_training, train_policy
from brokk_min.learning.policy import Policy, load_policy
from brokk_min.machine import Machine
from brokk_min.ppo import PPOConfig

Rows = list[dict[str, Any]]  # figures of a policy, a row for each run
Evaluate = Callable[[Policy], Rows]


def run_seed(
    machine: Machine,
    net: ActuatorNet,
    task: TaskConfig,
    config: PPOConfig,
    out: Path,
    evaluate: Evaluate,
    about: Mapping[str, Any],
    seed: int,
    critic: bool = False,
) -> Rows:
    """Train one seed and evaluate its policy, or continue from what the folder `out` holds of it.

    `evaluate` gives the figures of a policy; `about` is what decides them, for the header of the
    result. The other arguments are those of `train_policy`.
    ValueError: a result of another training or evaluation.
    """
    policy_file = out / f"seed_{seed}.npz"
    result_file = out / f"seed_{seed}.json"
    identity = describe_training(machine, net, task, config, critic, seed)
    if result_file.exists():
        with expected(result_file, "the result of a seed"):
            result: dict[str, Any] = read_json(result_file, "the result of a seed")
            rows: Rows = result["runs"]
            recorded = result["identity"]
        expect_same(result_file, recorded, {**identity, **about})
        return rows
    policy = load_policy(policy_file, machine) if policy_file.exists() else None
    if policy is None or dict(policy.training) != identity:
        resume = Path(f"{policy_file}.checkpoint").exists()
        policy = train_policy(machine, net, task, config, seed, policy_file, critic, resume)
    rows = evaluate(policy)
    write_json(result_file, {"identity": {**identity, **about}, "runs": rows})
    return rows


def run_seeds(
    job: Callable[[int], Rows], seeds: Sequence[int], scheduler: str | None = None
) -> tuple[dict[int, Rows], dict[int, str]]:
    """Results of `job`, and messages of failures, by seed.

    Each job runs on one core here, or on one worker of the dask scheduler at the address
    `scheduler`; dask repeats it if the worker dies. ValueError: workers of several threads, which
    would share torch's settings.
    """
    results: dict[int, Rows] = {}
    failed: dict[int, str] = {}
    with connect(scheduler) as client:
        workers = client.scheduler_info(n_workers=-1)["workers"].values()
        threads = {worker["nthreads"] for worker in workers}
        if threads - {1}:
            got = sorted(threads)
            raise ValueError(f"{scheduler}: expected workers with --nthreads 1, got {got}")
        futures = {client.submit(job, seed, pure=False): seed for seed in seeds}
        done = require("distributed", "sweep").as_completed(futures)
        for future in tqdm(done, total=len(futures), desc="sweep", unit="seed", disable=None):
            seed = futures[future]
            if future.status == "finished":
                results[seed] = future.result()
            else:
                failed[seed] = str(future.exception())
    return results, failed


def connect(scheduler: str | None) -> Any:
    """A dask client of the scheduler at an address, or of one process per core of this machine."""
    options: dict[str, Any] = {"address": scheduler, "timeout": 10}
    if scheduler is None:
        options = {"threads_per_worker": 1, "memory_limit": None, "dashboard_address": ":0"}
        options["silence_logs"] = logging.ERROR
    environ = "distributed.nanny.pre-spawn-environ"  # of the processes that run the jobs
    settings = {
        f"{environ}.TQDM_DISABLE": 1,
        f"{environ}.MALLOC_TRIM_THRESHOLD_": 2**30,  # with dask's 64 kB a training takes 1.4 times
    }
    client = require("distributed", "sweep").Client
    with require("dask", "sweep").config.set(settings):
        return client(**options)
