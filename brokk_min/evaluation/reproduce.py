"""The whole chain: logs, nets, policy, baselines, comparison, report."""

import time
from collections import ChainMap
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from brokk_min.actuator import ActuatorNet
from brokk_min.evaluation import baselines, claims, metrics, preliminary, report, sequences
from brokk_min.evaluation.learn import Budget, Chain, learn, side_by_side, tuning_set
from brokk_min.evaluation.metrics import Controllers, Run, Traces, evaluate, summary
from brokk_min.evaluation.perfect_model import perfect_models, regret
from brokk_min.evaluation.robustness import ROBUST, near_singularities, robustness
from brokk_min.evaluation.rollout import Controller, Trace, log_of
from brokk_min.evaluation.seeds import read_seeds
from brokk_min.identification import logs, validation
from brokk_min.identification.excitation import collect, task_log
from brokk_min.identification.files import write_json
from brokk_min.identification.progress import progress
from brokk_min.jacobian import JacobianController
from brokk_min.learning.policy import POLICIES, Policy, policy_controllers, save_policy
from brokk_min.machine import Machine

Pids = Mapping[str, JacobianController]  # baselines by name


def reproduce(
    machine: Machine, out: Path, budget: Budget, seed: int, sweep: Path | None = None
) -> dict[str, Any]:
    """Run the chain; logs, nets, policies, gains, `results.json` and `report.html` go to `out`.

    `results.json` has no times: the same seed gives the same file on the same computer. `sweep` is
    a file of `brokk-min sweep`, whose training seeds the report shows.
    """
    seeds = read_seeds(sweep, {}) if sweep else {}  # before all work
    chain = Chain(machine, out, budget, seed)
    clock: dict[str, float] = {}
    with progress(total=4, desc="stages done", unit="stage", position=1) as bar:
        stage = partial(_stage, clock, bar)
        with stage("record"):
            log, paper_log, test = record(chain)
        with stage("learn and tune"):
            by_name = learn(chain, log, paper_log, clock)
            net, paper_net = by_name["fit net"], by_name["fit net_paper"]
            rl, paper = by_name["train rl"], by_name["train rl_paper"]
            tuned = [by_name[f"tune {group[0]}"] for group in baselines.GROUPS]
            pids, tuning = (dict(ChainMap(*both[::-1])) for both in zip(*tuned, strict=True))
            policies = {"rl": rl, "rl_paper": paper}
            if sweep:
                seeds = read_seeds(sweep, baselines.gains_metadata(machine, rl.net))
        with stage("evaluate"):
            results, shown = measure(chain, net, test, policies, pids, clock)
            results["paper_recipe"] = net_errors(machine, paper_net, test, seed)
        with stage("draw"):
            results |= {"tuning": tuning, "training_seeds": seeds}
            write(machine, out, results, policies, pids)
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


def record(chain: Chain) -> list[logs.Log]:
    """Logs to fit nets to, rich ones and the paper's sines, and to score them on.

    They are written and read back as a user's.
    """
    chain.out.mkdir(parents=True, exist_ok=True)
    machine, hours, seed = chain.machine, chain.budget.hours, chain.seed
    rng = np.random.default_rng
    recorded = {
        "log": collect(machine, hours, "rich", rng(seed)),
        "log_paper": collect(machine, hours, "sine", rng(seed)),
        "log_test": task_log(machine, 20, 40.0, rng(seed + 1)),
    }
    read = []
    for name, log in recorded.items():
        file = chain.out / f"{name}.npz"
        logs.write_log(file, log)
        read.append(logs.read_log([file], machine.velocity_samples, rate=machine.rate))
    return read


def net_errors(machine: Machine, net: ActuatorNet, test: logs.Log, seed: int) -> dict[str, Any]:
    """Scores of nets on a log, and their distance from the machine in the paper's experiment."""
    both = preliminary.simulators(machine, net)
    gap = preliminary.gap_numbers(machine, preliminary.sim_to_real(machine, both, seed))
    return {"test": validation.score(net, test), "sim_to_real": gap}


def measure(
    chain: Chain,
    net: ActuatorNet,
    test: logs.Log,
    policies: Mapping[str, Policy],
    pids: Pids,
    clock: dict[str, float],
) -> tuple[dict[str, Any], report.Shown]:
    """All measurements of nets, policies and baselines, for JSON and for the figures."""
    machine, seed = chain.machine, chain.seed
    controllers = policy_controllers(machine, policies)
    compared, task, singular = compare(chain, controllers, pids, clock)
    starts = np.array(compared["starts"])[np.array(compared["start_kinds"]) == "workspace"]
    axes = sequences.axis_sequences(machine)
    rl = {"rl": controllers["rl"]}
    on_nets, _ = evaluate(machine, rl, axes, starts, seed, policies["rl"].net)
    compared["task_space"]["rl_on_nets"] = summary(on_nets)["rl"]
    own = log_of(machine, {s: trace for (c, s), trace in task.items() if c == "rl"}, 16)
    measured = preliminary.run(machine, net, seed)
    numbers = preliminary.numbers(machine, measured)
    tuned_on, goals = tuning_set(chain)
    meta = metrics.metadata(machine, seed) | baselines.gains_metadata(machine, policies["rl"].net)
    results = {
        "meta": meta | {"effort": asdict(chain.budget)},
        "actuator": {
            "test": validation.score(net, test),
            "driven_by_policy": validation.score(net, own),
        },
        "preliminary": numbers,
        "net_claims": [claim.to_json() for claim in claims.net_claims(numbers)],
        "gains": baselines.gains_table(pids),
        "tuning_runs": [
            {"start": q.tolist(), "goals": sequences.hold_table(machine, v_goal).tolist()}
            for q, v_goal in zip(tuned_on, goals.swapaxes(0, 1), strict=True)
        ],
    }
    return results | compared, report.Shown(net, test, measured, task, singular)


def compare(
    chain: Chain, policies: Mapping[str, Controller], pids: Pids, clock: dict[str, float]
) -> tuple[dict[str, Any], Traces, Traces]:
    """The paper's experiment, regret and robustness: JSON, all traces, those near singularities.

    Means, intervals and verdicts are over "workspace" starts: they can follow all sequences.
    """
    machine, budget, seed = chain.machine, chain.budget, chain.seed
    controllers: Controllers = {**policies, **pids}
    commands = sequences.task_sequences(machine)
    starts = sequences.evaluation_starts(machine, budget.starts, commands, seed + 2)
    kinds = np.array(sequences.start_kinds(machine, starts))
    workspace = kinds == "workspace"
    reachable = starts[workspace]
    short = sequences.shorten(machine, sequences.axis_sequences(machine), budget.short_s)
    bound_starts, extended = reachable[: budget.bound_starts], starts[kinds == "extended"]
    few = claims.singular_controllers(policies, pids)
    robust = {name: controllers[name] for name in ROBUST}
    score, near = partial(evaluate, machine), partial(near_singularities, machine)
    jobs: dict[str, Callable[[], Any]] = {}
    jobs["score changed machines"] = partial(
        robustness, machine, robust, short, reachable[:16], seed
    )
    for name, bound in perfect_models(machine, bound_starts).items():
        jobs[f"score {name}"] = partial(score, {name: bound}, short, bound_starts, seed)
    jobs["score"] = partial(score, controllers, commands, starts, seed)
    jobs["score for the regret"] = partial(score, controllers, short, bound_starts, seed)
    jobs["score near singularities"] = partial(near, few, extended, budget.short_s, seed)
    changed, *bounds, (runs, traces), (on_short, _), singularities = side_by_side(jobs, clock)
    singular, verdicts, near_traces = singularities
    scored = [run for run in runs if run["kind"] == "workspace"]
    along_x = {c: Trace(*(array[:, workspace] for array in traces[c, "x"])) for c in pids}
    goals = commands[0].for_starts(machine, reachable)
    theirs, ours = (
        claims.task_claims(machine, name, pids, scored, along_x, goals, verdicts.get(name, []))
        for name in ("rl_paper", "rl")
    )
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
    machine: Machine,
    out: Path,
    results: Mapping[str, Any],
    policies: Mapping[str, Policy],
    pids: Pids,
) -> None:
    """Write what other commands read: results, gains, policies with the errors as metadata."""
    write_json(out / "results.json", results)
    baselines.write_gains(out / "gains.json", pids, results["meta"])
    means = results["task_space"]["summary"]
    errors = {controller: rows["all"]["velocity_error_mean"] for controller, rows in means.items()}
    command = f"brokk-min reproduce --seed {results['meta']['seed']}"
    made = {"command": command, "velocity_error_mean": errors}
    for name, policy in policies.items():
        complete = replace(policy, training={**policy.training, **made})
        save_policy(out / POLICIES[name], complete, machine)
