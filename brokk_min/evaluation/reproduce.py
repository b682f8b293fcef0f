"""The whole chain: logs, nets, policy, baselines, comparison, report."""

import multiprocessing
import os
import sys
import time
from collections import ChainMap
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from dask.system import cpu_count
from tqdm import tqdm

from brokk_min.actuator import ActuatorNet
from brokk_min.env import TaskConfig
from brokk_min.evaluation import baselines, claims, metrics, preliminary, report, sequences
from brokk_min.evaluation.metrics import Controllers, Run, Traces, evaluate, summary
from brokk_min.evaluation.perfect_model import perfect_models, regret
from brokk_min.evaluation.robustness import ROBUST, near_singularities, robustness
from brokk_min.evaluation.rollout import Controller, Trace, log_of
from brokk_min.evaluation.seeds import read_seeds, seeds_of
from brokk_min.identification import fitting, logs, validation
from brokk_min.identification.excitation import collect, task_log
from brokk_min.identification.files import write_json
from brokk_min.identification.net_file import save_net, select_nets
from brokk_min.jacobian import JacobianController
from brokk_min.learning.checkpoint import train_policy
from brokk_min.learning.episodes import GRADIENT_LEARNER, PAPER_TASK
from brokk_min.learning.policy import POLICIES, Policy, policy_controllers, save_policy
from brokk_min.machine import Machine
from brokk_min.ppo import PPOConfig

Pids = Mapping[str, JacobianController]  # baselines by name


@dataclass(frozen=True)
class Budget:
    """How much each stage may spend."""

    hours: float = 1.0  # driving time of each actuator that is recorded
    fit_steps: int = fitting.FitConfig.steps
    train_steps: int = GRADIENT_LEARNER["total_steps"]
    paper_steps: int = PPOConfig.total_steps  # of the paper's learner
    generations: int = baselines.GENERATIONS  # of the tuning
    tuning_runs: int = baselines.TUNING_RUNS
    starts: int = 64
    bound_starts: int = 16  # of them, for the regret
    short_s: float = 26.0  # s of a run for regret, robustness, singularities, tuning, at most


QUICK = Budget(0.1, 700, 100_000, 200_000, 4, 4, 8, 2, 3.0)


def reproduce(
    machine: Machine, out: Path, budget: Budget, seed: int, sweep: Path | None = None
) -> dict[str, Any]:
    """Run the chain; logs, nets, policy, gains, `results.json` and `report.html` go to `out`.

    `results.json` has no times: the same seed gives the same file on the same computer. `sweep` is
    a file of `brokk-min sweep`, whose training seeds the report shows.
    """
    seeds = read_seeds(sweep) if sweep else {}
    clock: dict[str, float] = {}
    with tqdm(total=5, desc="stages done", unit="stage", position=1, disable=None) as bar:
        stage = partial(_stage, clock, bar)
        with stage("record"):
            log, paper_log, test = record(machine, out, budget, seed)
        with stage("fit"):
            fit = partial(fit_net, machine, budget=budget, seed=seed)
            ours = partial(fit, out / "net.npz", log, recipe={})
            theirs = partial(fit, out / "net_paper.npz", paper_log, recipe=fitting.PAPER_RECIPE)
            net, paper_net = side_by_side({"fit net": ours, "fit net_paper": theirs}, clock)
            driven = select_nets(machine, net)
            training_seeds = seeds_of(machine, driven, seeds) if seeds else {}
        with stage("train and tune"):
            nets = {"rl_paper": select_nets(machine, paper_net), "rl": driven}
            jobs: dict[str, Any] = {}
            for name, own in nets.items():
                jobs[f"train {name}"] = partial(train, machine, out, name, own, budget, seed)
            settings = budget.tuning_runs, budget.generations, seed, None, None, budget.short_s
            for name in baselines.TUNED:
                tune = partial(baselines.tune_baselines, machine, driven, *settings)
                jobs[f"tune {name}"] = partial(tune, name)
            paper, rl, *tuned = side_by_side(jobs, clock)
            policies = {"rl": rl, "rl_paper": paper}
            pids, tuning = (dict(ChainMap(*both[::-1])) for both in zip(*tuned, strict=True))
        with stage("evaluate"):
            results, shown = measure(machine, net, test, policies, pids, budget, seed, clock)
            results["paper_recipe"] = net_errors(machine, paper_net, test, seed)
        with stage("draw"):
            results |= {"tuning": tuning, "training_seeds": training_seeds}
            write(out, results, policies, pids)
            report.write_report(machine, out, results, shown, clock)
    write_json(out / "timing.json", clock)
    return results


@contextmanager
def _stage(clock: dict[str, float], bar: Any, name: str) -> Iterator[None]:
    """Measure the seconds of a stage."""
    start = time.perf_counter()
    yield
    clock[name] = time.perf_counter() - start
    bar.set_postfix_str(name)
    bar.update()


def side_by_side(calls: Mapping[str, Callable[[], Any]], clock: dict[str, float]) -> list[Any]:
    """Results of independent calls, each in a process of one thread, as many at once as cores.

    They begin in their order: the longest should be the first. One core runs them here, in turn.
    `clock` gets the seconds of each. The first exception is raised.
    """
    cores = cpu_count()  # by affinity and cgroup, too
    if cores == 1:
        done = [_timed(call) for call in calls.values()]
    else:
        context = multiprocessing.get_context("spawn")
        bar = tqdm(total=len(calls), unit="job", disable=None)
        with ProcessPoolExecutor(min(cores, len(calls)), context, _one_thread) as pool, bar:
            futures = {pool.submit(_timed, call): name for name, call in calls.items()}
            bar.set_postfix_str(", ".join([*calls][:cores]))
            for _ in as_completed(futures):
                running = [name for future, name in futures.items() if not future.done()]
                bar.set_postfix_str(", ".join(running[:cores]))
                bar.update()
            done = [future.result() for future in futures]
    clock |= {name: seconds for name, (seconds, _) in zip(calls, done, strict=True)}
    return [result for _, result in done]


def _one_thread() -> None:
    torch.set_num_threads(1)
    sys.stderr = open(os.devnull, "w")  # noqa: SIM115  # bars of several processes would mix


def _timed(call: Callable[[], Any]) -> tuple[float, Any]:
    start = time.perf_counter()
    result = call()
    return time.perf_counter() - start, result


def record(machine: Machine, out: Path, budget: Budget, seed: int) -> list[logs.Log]:
    """Logs to fit nets to, rich ones and the paper's sines, and to score them on.

    They are written and read back as a user's.
    """
    out.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng
    recorded = {
        "log": collect(machine, budget.hours, "rich", rng(seed)),
        "log_paper": collect(machine, budget.hours, "sine", rng(seed)),
        "log_test": task_log(machine, 20, 40.0, rng(seed + 1)),
    }
    read = []
    for name, log in recorded.items():
        file = out / f"{name}.npz"
        logs.write_log(file, log)
        read.append(logs.read_log([file], machine.velocity_samples, rate=machine.rate))
    return read


def fit_net(
    machine: Machine, file: Path, log: logs.Log, budget: Budget, recipe: dict[str, Any], seed: int
) -> ActuatorNet:
    """Nets of all joints by our settings but for those of `recipe`, written to `file`."""
    ours = {"history": machine.history, "dead_zone": machine.dead_zone}
    config = fitting.FitConfig(budget.fit_steps, **ours | recipe)
    net = fitting.fit(log, config, seed, machine.velocity_samples, machine.name)
    save_net(file, net)
    return net


def net_errors(machine: Machine, net: ActuatorNet, test: logs.Log, seed: int) -> dict[str, Any]:
    """Scores of nets on a log, and their distance from the machine in the paper's experiment."""
    both = preliminary.simulators(machine, net)
    gap = preliminary.gap_numbers(machine, preliminary.sim_to_real(machine, both, seed))
    return {"test": validation.score(net, test), "sim_to_real": gap}


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
    file = out / POLICIES[name]
    return train_policy(machine, net, task, learner, seed, file, resume=True, start=start)


def measure(
    machine: Machine,
    net: ActuatorNet,
    test: logs.Log,
    policies: Mapping[str, Policy],
    pids: Pids,
    budget: Budget,
    seed: int,
    clock: dict[str, float],
) -> tuple[dict[str, Any], report.Shown]:
    """All measurements of nets, policies and baselines, for JSON and for the figures."""
    controllers = policy_controllers(machine, policies)
    compared, task, singular = compare(machine, controllers, pids, budget, seed, clock)
    starts = np.array(compared["starts"])[np.array(compared["start_kinds"]) == "workspace"]
    axes = sequences.axis_sequences(machine)
    rl = {"rl": controllers["rl"]}
    on_nets, _ = evaluate(machine, rl, axes, starts, seed, policies["rl"].net)
    compared["task_space"]["rl_on_nets"] = summary(on_nets)["rl"]
    own = log_of(machine, {s: trace for (c, s), trace in task.items() if c == "rl"}, 16)
    measured = preliminary.run(machine, net, seed)
    numbers = preliminary.numbers(machine, measured)
    seconds = min(baselines.TUNING_SECONDS, budget.short_s)
    tuned_on = sequences.tuning_set(machine, budget.tuning_runs, seed, seconds)
    meta = metrics.metadata(machine, seed) | baselines.gains_metadata(machine, policies["rl"].net)
    results = {
        "meta": meta | {"effort": asdict(budget)},
        "actuator": {
            "test": validation.score(net, test),
            "driven_by_policy": validation.score(net, own),
        },
        "preliminary": numbers,
        "net_claims": [claim.to_json() for claim in claims.net_claims(numbers)],
        "gains": baselines.gains_table(pids),
        "tuning_runs": [
            {"start": q.tolist(), "goals": sequences.hold_table(machine, v_goal).tolist()}
            for q, v_goal in zip(tuned_on[0], tuned_on[1].swapaxes(0, 1), strict=True)
        ],
    }
    return results | compared, report.Shown(net, test, measured, task, singular)


def compare(
    machine: Machine,
    policies: Mapping[str, Controller],
    pids: Pids,
    budget: Budget,
    seed: int,
    clock: dict[str, float],
) -> tuple[dict[str, Any], Traces, Traces]:
    """The paper's experiment, regret and robustness: JSON, all traces, those near singularities.

    Means, intervals and verdicts are over "workspace" starts: they can follow all sequences.
    """
    controllers: Controllers = {**policies, **pids}
    commands = sequences.task_sequences(machine)
    starts = sequences.evaluation_starts(machine, budget.starts, commands, seed + 2)
    kinds = np.array(sequences.start_kinds(machine, starts))
    workspace = kinds == "workspace"
    reachable = starts[workspace]
    short = sequences.shorten(machine, sequences.axis_sequences(machine), budget.short_s)
    bound_starts, extended = reachable[: budget.bound_starts], starts[kinds == "extended"]
    few = claims.singular_controllers(policies, pids)
    near = partial(near_singularities, machine)
    every = machine, controllers
    robust = {name: controllers[name] for name in ROBUST}
    jobs: dict[str, Callable[[], Any]] = {}
    changed_machines = machine, robust, short, reachable[:16], seed
    jobs["score changed machines"] = partial(robustness, *changed_machines)
    for name, bound in perfect_models(machine, bound_starts).items():
        jobs[f"score {name}"] = partial(evaluate, machine, {name: bound}, short, bound_starts, seed)
    jobs["score"] = partial(evaluate, *every, commands, starts, seed)
    jobs["score for the regret"] = partial(evaluate, *every, short, bound_starts, seed)
    jobs["score near singularities"] = partial(near, few, extended, budget.short_s, seed)
    changed, *bounds, (runs, traces), (on_short, _), singularities = side_by_side(jobs, clock)
    singular, verdicts, near_traces = singularities
    scored = [run for run in runs if run["kind"] == "workspace"]
    along_x = {c: Trace(*(array[:, workspace] for array in traces[c, "x"])) for c in pids}
    goals = commands[0].for_starts(machine, reachable)
    claim = partial(claims.task_claims, machine)
    theirs = claim("rl_paper", pids, scored, along_x, goals, verdicts.get("rl_paper", []))
    ours = claim("rl", pids, scored, along_x, goals, verdicts.get("rl", []))
    results = {
        "task_space": tables(runs, scored),
        "regret": regret([*on_short, *(run for rows, _ in bounds for run in rows)]),
        "robustness": changed,
        "singular": singular,
        "claims": [a.to_json() | {"ours": b.to_json()} for a, b in zip(theirs, ours, strict=True)],
        "starts": starts.tolist(),
        "start_kinds": kinds.tolist(),
    }
    return results, traces, near_traces


def tables(runs: Sequence[Run], scored: Sequence[Run]) -> dict[str, Any]:
    """All runs, and means and intervals of those that count, RL less each baseline."""
    by_kind = {}
    for kind in dict.fromkeys(run["kind"] for run in runs):
        means = summary([run for run in runs if run["kind"] == kind])
        by_kind[kind] = {controller: rows["all"] for controller, rows in means.items()}
    return {
        "runs": runs,
        "summary": summary(scored),
        "intervals": metrics.intervals(scored),
        "by_kind": by_kind,
        "rl_less": metrics.paired_differences(scored, "rl"),
    }


def write(
    out: Path, results: Mapping[str, Any], policies: Mapping[str, Policy], pids: Pids
) -> None:
    """Write what other commands read: results, gains, policies with the errors as metadata."""
    write_json(out / "results.json", results)
    baselines.write_gains(out / "gains.json", pids, results["meta"])
    means = results["task_space"]["summary"]
    errors = {controller: rows["all"]["velocity_error_mean"] for controller, rows in means.items()}
    command = f"brokk-min reproduce --seed {results['meta']['seed']}"
    made = {"command": command, "velocity_error_mean": errors}
    for name, policy in policies.items():
        save_policy(out / POLICIES[name], replace(policy, training={**policy.training, **made}))
