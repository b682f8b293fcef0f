"""Fits, trainings and tunings of a chain, side by side on the cores of the computer.

Nets and policy of ours take two rounds: a short fit and training, an hour of the policy's own
drives, then nets fitted to both logs and the policy trained on. The field calls it data aggregation
(DAgger for models: Ross and Bagnell, ICML 2012).
"""

import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from dask.system import cpu_count
from tqdm import tqdm

from brokk_min.actuator import ActuatorNet
from brokk_min.env import TaskConfig
from brokk_min.evaluation import baselines
from brokk_min.evaluation.rollout import own_drives
from brokk_min.identification import fitting, logs
from brokk_min.identification.net_file import save_net, select_nets
from brokk_min.learning.checkpoint import train_policy
from brokk_min.learning.episodes import GRADIENT_LEARNER, PAPER_TASK
from brokk_min.learning.policy import POLICIES, Policy, policy_controllers
from brokk_min.machine import Machine
from brokk_min.ppo import PPOConfig


@dataclass(frozen=True)
class Budget:
    """How much each stage may spend."""

    hours: float = 1.0  # driving time of each actuator that is recorded, and of own drives
    first_fit_steps: int = 4_000  # of the first round
    first_train_steps: int = 500_000
    fit_steps: int = fitting.FitConfig.steps
    train_steps: int = GRADIENT_LEARNER["total_steps"] - first_train_steps
    paper_steps: int = PPOConfig.total_steps  # of the paper's learner
    generations: int = baselines.GENERATIONS  # of the tuning
    tuning_runs: int = baselines.TUNING_RUNS
    starts: int = 64
    bound_starts: int = 16  # of them, for the regret
    short_s: float = 26.0  # s of a run for regret, robustness, singularities, tuning, at most


QUICK = Budget(0.1, 300, 40_000, 700, 60_000, 200_000, 4, 4, 8, 2, 3.0)


def fit_net(
    machine: Machine, file: Path, log: logs.Log, budget: Budget, recipe: dict[str, Any], seed: int
) -> ActuatorNet:
    """Nets of all joints by our settings but for those of `recipe`, written to `file`."""
    ours = {"history": machine.history, "dead_zone": machine.dead_zone}
    config = fitting.FitConfig(budget.fit_steps, **ours | recipe)
    net = fitting.fit(log, config, seed, machine.velocity_samples, machine.name)
    save_net(file, net)
    return net


def settings(name: str, budget: Budget) -> tuple[TaskConfig, PPOConfig]:
    """Task and learner of one of `POLICIES`: ours, or the paper's."""
    if name == "rl_paper":
        return TaskConfig(paper=True, **PAPER_TASK), PPOConfig(budget.paper_steps)
    return TaskConfig(), PPOConfig(**GRADIENT_LEARNER | {"total_steps": budget.train_steps})


def train(
    machine: Machine,
    out: Path,
    name: str,
    net: ActuatorNet,
    budget: Budget,
    seed: int,
    start: Policy | None = None,
) -> Policy:
    """One of `POLICIES`, by its own settings; `start` as in `train_policy`."""
    task, learner = settings(name, budget)
    driven = select_nets(machine, net)
    file = out / POLICIES[name]
    return train_policy(machine, driven, task, learner, seed, file, resume=True, start=start)


def first_round(
    machine: Machine, out: Path, log: logs.Log, budget: Budget, seed: int, recipe: dict[str, Any]
) -> tuple[logs.Log, Policy]:
    """The log with the own drives of a policy that was trained for short, and this policy.

    Files go to `out`: nets, policy, and the own drives.
    """
    out.mkdir(parents=True, exist_ok=True)
    short = {"fit_steps": budget.first_fit_steps, "train_steps": budget.first_train_steps}
    first = replace(budget, **short)
    net = fit_net(machine, out / "net.npz", log, first, recipe, seed)
    policy = train(machine, out, "rl", net, first, seed)
    controllers = policy_controllers(machine, {"rl": policy})
    own = own_drives(machine, [*controllers.values()], budget.hours, seed)
    logs.write_log(out / "log_own.npz", own)
    return log._replace(recordings=log.recordings + own.recordings), policy


def learn(
    machine: Machine,
    out: Path,
    log: logs.Log,
    paper_log: logs.Log,
    budget: Budget,
    seed: int,
    clock: dict[str, float],
) -> dict[str, Any]:
    """Results of all fits, trainings and tunings, by the names of the jobs."""

    def fit_again(first: tuple[logs.Log, Policy]) -> ActuatorNet:
        return fit_net(machine, out / "net.npz", first[0], budget, {}, seed)

    def train_again(net: ActuatorNet, first: tuple[logs.Log, Policy]) -> Policy:
        return train(machine, out, "rl", net, budget, seed, first[1])

    def tune(name: str, net: ActuatorNet) -> Any:
        return baselines.tune_baselines(machine, select_nets(machine, net), *tuning, only=name)

    tuning = budget.tuning_runs, budget.generations, seed, None, None, budget.short_s
    common: dict[str, Any] = {"budget": budget, "seed": seed}
    recipe: dict[str, Any] = {"recipe": fitting.PAPER_RECIPE, **common}
    jobs: dict[str, Callable[..., Any]] = {
        "fit net_paper": partial(fit_net, machine, out / "net_paper.npz", paper_log, **recipe),
        "first round": partial(first_round, machine, out / "first", log, recipe={}, **common),
        "train rl_paper": partial(train, machine, out, "rl_paper", **common),
        "fit net": fit_again,
        "train rl": train_again,
    }
    needs = {"train rl_paper": ["fit net_paper"], "fit net": ["first round"]}
    needs["train rl"] = ["fit net", "first round"]
    for name in baselines.TUNED:
        jobs[f"tune {name}"] = partial(tune, name)
        needs[f"tune {name}"] = ["fit net"]
    return dict(zip(jobs, side_by_side(jobs, clock, needs), strict=True))


def side_by_side(
    calls: Mapping[str, Callable[..., Any]],
    clock: dict[str, float],
    needs: Mapping[str, Sequence[str]] | None = None,
) -> list[Any]:
    """Results of calls, each in a process of one thread, as many at once as cores.

    A call gets the results of those that it `needs`, which stand before it. Else they begin in
    their order: the longest should be the first. One core runs them here, in turn. `clock` gets the
    seconds of each. The first exception is raised.
    """
    from distributed import as_completed  # slow to import

    needed = {name: (needs or {}).get(name, ()) for name in calls}
    done: dict[str, tuple[float, Any]] = {}
    cores = cpu_count()  # by affinity and cgroup, too
    if cores == 1:
        for name, call in calls.items():
            done[name] = _timed(call, *(done[other] for other in needed[name]))
    else:
        with connect(n_workers=min(cores, len(calls))) as client:
            jobs: dict[str, Any] = {}
            for name, call in calls.items():
                options = {"key": name, "priority": -len(jobs)}
                results = (jobs[other] for other in needed[name])
                jobs[name] = client.submit(_timed, call, *results, **options)
            ended = as_completed(jobs.values())  # type: ignore[no-untyped-call]
            bar = tqdm(ended, total=len(jobs), unit="job", disable=None)
            for job in bar:
                done[job.key] = job.result()
                bar.set_postfix_str(f"last: {job.key}")
    clock |= {name: done[name][0] for name in calls}
    return [done[name][1] for name in calls]


def _timed(call: Callable[..., Any], *needed: tuple[float, Any]) -> tuple[float, Any]:
    start = time.perf_counter()
    result = call(*(result for _, result in needed))
    return time.perf_counter() - start, result


@contextmanager
def connect(scheduler: str | None = None, **cluster: Any) -> Iterator[Any]:
    """A dask client of the scheduler at an address, or of one process per core of this machine.

    `cluster` are options of dask's LocalCluster.
    """
    import dask
    from distributed import Client  # slow to import

    options: dict[str, Any] = {"address": scheduler, "timeout": 10}
    if scheduler is None:
        options = {"threads_per_worker": 1, "memory_limit": None, "dashboard_address": ":0"}
        options |= {"silence_logs": logging.CRITICAL, **cluster}
    environ = "distributed.nanny.pre-spawn-environ"  # of the processes that run the jobs
    settings = {
        f"{environ}.TQDM_DISABLE": 1,  # bars of several processes would mix
        f"{environ}.MALLOC_TRIM_THRESHOLD_": 2**30,  # with dask's 64 kB a training takes 1.4 times
        "distributed.admin.large-graph-warning-threshold": "1TB",  # of logs
    }
    with dask.config.set(settings), Client(**options) as client:  # type: ignore[no-untyped-call]
        yield client
