"""Fits, trainings and tunings of a chain, side by side on the cores of the computer.

Nets and policy of ours take two rounds: a short fit and training, an hour of the policy's own
drives, then nets fitted to both logs and the policy trained on. The field calls it data aggregation
(DAgger for models: Ross and Bagnell, ICML 2012).
"""

import logging
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from dask.system import cpu_count

from brokk_min.actuator import ActuatorNet
from brokk_min.env import TaskConfig
from brokk_min.evaluation import baselines, sequences
from brokk_min.evaluation.rollout import own_drives
from brokk_min.identification import fitting, logs
from brokk_min.identification.net_file import save_net, select_nets
from brokk_min.identification.progress import progress
from brokk_min.learning.checkpoint import train_policy
from brokk_min.learning.episodes import GRADIENT_LEARNER, PAPER_TASK
from brokk_min.learning.policy import POLICIES, Policy, policy_controllers
from brokk_min.machine import Array, Machine
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


@dataclass(frozen=True)
class Chain:
    """What all stages of one chain share."""

    machine: Machine
    out: Path  # folder of its files
    budget: Budget
    seed: int


def fit_net(chain: Chain, name: str, log: logs.Log, recipe: Mapping[str, Any]) -> ActuatorNet:
    """Nets of all joints by our settings but for those of `recipe`, written to `name`.npz."""
    m = chain.machine
    ours: dict[str, Any] = {"history": m.history, "dead_zone": m.dead_zone}
    config = fitting.FitConfig(chain.budget.fit_steps, **{**ours, **recipe})
    net = fitting.fit(log, config, chain.seed, m.velocity_samples, m.name)
    save_net(chain.out / f"{name}.npz", net)
    return net


def settings(name: str, budget: Budget) -> tuple[TaskConfig, PPOConfig]:
    """Task and learner of one of `POLICIES`: ours, or the paper's."""
    if name == "rl_paper":
        return TaskConfig(paper=True, **PAPER_TASK), PPOConfig(budget.paper_steps)
    return TaskConfig(), PPOConfig(**GRADIENT_LEARNER | {"total_steps": budget.train_steps})


def train(chain: Chain, name: str, net: ActuatorNet, start: Policy | None = None) -> Policy:
    """One of `POLICIES`, by its own settings; `start` as in `train_policy`."""
    task, learner = settings(name, chain.budget)
    m, file = chain.machine, chain.out / POLICIES[name]
    driven = select_nets(m, net)
    return train_policy(m, driven, task, learner, chain.seed, file, resume=True, start=start)


def first_round(chain: Chain, log: logs.Log, recipe: Mapping[str, Any]) -> tuple[logs.Log, Policy]:
    """`next_round` of a short fit and training, in the folder `first` of the chain."""
    budget = chain.budget
    short = {"fit_steps": budget.first_fit_steps, "train_steps": budget.first_train_steps}
    first = replace(chain, out=chain.out / "first", budget=replace(budget, **short))
    return next_round(first, log, recipe, None, chain.seed)


def next_round(
    chain: Chain, log: logs.Log, recipe: Mapping[str, Any], start: Policy | None, seed: int
) -> tuple[logs.Log, Policy]:
    """The log with the own drives of a policy that was trained for it, and this policy.

    `start` as in `train`, `seed` of the goals of the drives. Nets, policy and own drives go to the
    folder of the chain.
    """
    m = chain.machine
    chain.out.mkdir(parents=True, exist_ok=True)
    policy = train(chain, "rl", fit_net(chain, "net", log, recipe), start)
    controllers = policy_controllers(m, {"rl": policy})
    own = own_drives(m, [*controllers.values()], chain.budget.hours, seed)
    logs.write_log(chain.out / "log_own.npz", own)
    return log._replace(recordings=log.recordings + own.recordings), policy


def tuning_set(chain: Chain) -> tuple[Array, Array]:
    """Starts and goals of `sequences.tuning_set` on which the baselines of a chain are tuned."""
    seconds = min(baselines.TUNING_SECONDS, chain.budget.short_s)
    return sequences.tuning_set(chain.machine, chain.budget.tuning_runs, chain.seed, seconds)


def tune(chain: Chain, net: ActuatorNet, names: Sequence[str] = baselines.TUNED) -> Any:
    """Baselines, tuned as by `tune_baselines`."""
    budget = chain.budget
    effort = budget.tuning_runs, budget.generations, chain.seed
    limits: dict[str, Any] = {"longest": budget.short_s, "only": names}
    nets = select_nets(chain.machine, net)
    return baselines.tune_baselines(chain.machine, nets, *effort, **limits)


def learn(
    chain: Chain, log: logs.Log, paper_log: logs.Log, clock: dict[str, float]
) -> dict[str, Any]:
    """Results of all fits, trainings and tunings, by the names of the jobs."""
    jobs: dict[str, Callable[..., Any]] = {
        "fit net_paper": partial(fit_net, chain, "net_paper", paper_log, fitting.PAPER_RECIPE),
        "first round": partial(first_round, chain, log, {}),
        "train rl_paper": partial(train, chain, "rl_paper"),
        "fit net": lambda first: fit_net(chain, "net", first[0], {}),
        "train rl": lambda net, first: train(chain, "rl", net, first[1]),
    }
    needs = {"train rl_paper": ["fit net_paper"], "fit net": ["first round"]}
    needs["train rl"] = ["fit net", "first round"]
    for group in baselines.GROUPS:
        jobs[f"tune {group[0]}"] = partial(tune, chain, names=group)
        needs[f"tune {group[0]}"] = ["fit net"]
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
            bar = progress(ended, total=len(jobs), unit="job")
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
        f"{environ}.MALLOC_TRIM_THRESHOLD_": 2**30,  # with dask's 64 kB a training takes 1.4 times
        "distributed.admin.large-graph-warning-threshold": "1TB",  # of logs
    }
    with dask.config.set(settings), Client(**options) as client:  # type: ignore[no-untyped-call]
        if scheduler is None:
            client.run(_hide_bars)
        yield client


def _hide_bars() -> None:
    """No output to stderr: bars of several processes would mix."""
    sys.stderr = open(os.devnull, "w")  # noqa: SIM115
