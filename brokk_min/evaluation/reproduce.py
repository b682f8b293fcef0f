"""The whole chain: logs, nets, policy, baselines, comparison, report."""

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from brokk_min.actuator import ActuatorNet, select_nets
from brokk_min.env import TaskConfig
from brokk_min.evaluation import baselines, claims, metrics, preliminary, report, sequences
from brokk_min.evaluation.metrics import Controllers, Run, Traces, evaluate, summary
from brokk_min.evaluation.perfect_model import perfect_models
from brokk_min.evaluation.robustness import robustness
from brokk_min.evaluation.rollout import Controller, Trace
from brokk_min.evaluation.seeds import read_seeds, seeds_of
from brokk_min.evaluation.sequences import Commands
from brokk_min.identification import fitting, logs, validation
from brokk_min.identification.excitation import collect, task_log
from brokk_min.identification.files import write_json
from brokk_min.identification.fitting import FitConfig
from brokk_min.identification.logs import Log
from brokk_min.identification.net_file import save_net
from brokk_min.jacobian import JacobianController, manipulability, manipulability_threshold
from brokk_min.kinematics import forward_kinematics, jacobian
from brokk_min.learning.checkpoint import train_policy
from brokk_min.learning.policy import Policy, PolicyController, save_policy
from brokk_min.machine import Array, Machine
from brokk_min.ppo import PPOConfig

Pids = Mapping[str, JacobianController]  # baselines by name


@dataclass(frozen=True)
class Budget:
    """How much each stage may spend."""

    hours: float = 1.0  # driving time of each actuator that is recorded
    fit_steps: int = FitConfig.steps
    train_steps: int = PPOConfig.total_steps
    generations: int = baselines.GENERATIONS  # of the tuning
    tuning_runs: int = baselines.TUNING_RUNS
    starts: int = 64
    bound_starts: int = 16  # of them, for the regret
    short_s: float = 18.0  # s of each sequence for regret, robustness and singularities


QUICK = Budget(0.1, 700, 200_000, 4, 4, 8, 2, 3.0)


def reproduce(
    machine: Machine, out: Path, budget: Budget, seed: int, sweep: Path | None = None
) -> dict[str, Any]:
    """Run the chain; logs, nets, policy, gains, `results.json` and `report.html` go to `out`.

    `results.json` has no times: the same seed gives the same file on the same computer. `sweep` is
    a file of `brokk-min sweep`, whose training seeds the report shows.
    """
    seeds = read_seeds(sweep) if sweep else {}
    clock: dict[str, float] = {}
    with tqdm(total=6, desc="stages done", unit="stage", position=1, disable=None) as bar:
        stage = partial(_stage, clock, bar)
        with stage("record"):
            log, test = record(machine, out, budget, seed)
        with stage("fit"):
            net, recipe = fit_nets(machine, out, log, test, budget, seed)
            driven = select_nets(machine, net)
            training_seeds = seeds_of(machine, driven, seeds) if seeds else {}
        with stage("train"):
            learner = PPOConfig(total_steps=budget.train_steps)
            file = out / "policy.npz"
            policy = train_policy(machine, driven, TaskConfig(), learner, seed, file, resume=True)
        with stage("tune"):
            runs, generations = budget.tuning_runs, budget.generations
            pids, tuning = baselines.tune_baselines(machine, driven, runs, generations, seed)
        with stage("evaluate"):
            results, shown = measure(machine, net, test, policy, pids, budget, seed)
        with stage("draw"):
            results |= {"paper_recipe": recipe, "tuning": tuning, "training_seeds": training_seeds}
            write(out, results, policy, pids)
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


def record(machine: Machine, out: Path, budget: Budget, seed: int) -> list[Log]:
    """Logs to fit nets to and to score them on, written and read back as a user's."""
    out.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng
    logs.write_log(out / "log.npz", collect(machine, budget.hours, "rich", rng(seed)))
    logs.write_log(out / "log_test.npz", task_log(machine, 20, 40.0, rng(seed + 1)))
    files = [out / "log.npz", out / "log_test.npz"]
    return [logs.read_log([file], machine.velocity_samples, rate=machine.rate) for file in files]


def fit_nets(
    machine: Machine, out: Path, log: Log, test: Log, budget: Budget, seed: int
) -> tuple[ActuatorNet, dict[str, Any]]:
    """Nets of all joints, and the errors of nets by the paper's recipe, for JSON."""
    config = FitConfig(budget.fit_steps, history=machine.history, dead_zone=machine.dead_zone)
    net = fitting.fit(log, config, seed, machine.velocity_samples, machine.name)
    save_net(out / "net.npz", net)
    return net, paper_recipe(machine, test, budget.hours, config, seed)


def paper_recipe(
    machine: Machine, test: Log, hours: float, config: FitConfig, seed: int
) -> dict[str, Any]:
    """Scores and gap of nets by the paper's recipe: sines, errors of one step. Paper: Sec. 3.3"""
    log = collect(machine, hours, "sine", np.random.default_rng(seed))
    recordings = tuple(r for r in log.recordings if not r.name.endswith(logs.RETURN))
    log = log._replace(recordings=recordings)
    config = replace(config, **fitting.PAPER_RECIPE)
    net = fitting.fit(log, config, seed, machine.velocity_samples, machine.name)
    both = preliminary.simulators(machine, net)
    gap = preliminary.gap_numbers(machine, preliminary.sim_to_real(machine, both, seed))
    return {"test": validation.score(net, test), "sim_to_real": gap}


def driven_log(machine: Machine, traces: Traces, controller: str) -> Log:
    """Commands and encoder angles of a controller's first 16 runs of each sequence."""
    recordings = []
    for (name, sequence), trace in traces.items():
        for i in range(min(16, trace.q.shape[1]) if name == controller else 0):
            run = (trace.u[:, i].astype(float), trace.q_measured[:, i].astype(float))
            recordings.append((f"{controller}_{sequence}_{i:02d}", *run))
    return logs.machine_log(machine, recordings)


def measure(
    machine: Machine,
    net: ActuatorNet,
    test: Log,
    policy: Policy,
    pids: Pids,
    budget: Budget,
    seed: int,
) -> tuple[dict[str, Any], report.Shown]:
    """All measurements of nets, policy and baselines, for JSON and for the figures."""
    rl = PolicyController(machine, policy)
    compared, task, singular = compare(machine, rl, pids, budget, seed)
    starts = np.array(compared["starts"])[np.array(compared["start_kinds"]) == "workspace"]
    axes = sequences.axis_sequences(machine)
    on_nets, _ = evaluate(machine, {"rl": rl}, axes, starts, seed, policy.net)
    compared["task_space"]["rl_on_nets"] = summary(on_nets)["rl"]
    measured = preliminary.run(machine, net, seed)
    numbers = preliminary.numbers(machine, measured)
    meta = metrics.metadata(machine, seed) | baselines.gains_metadata(machine, policy.net)
    results = {
        "meta": meta | {"effort": asdict(budget)},
        "actuator": {
            "test": validation.score(net, test),
            "driven_by_policy": validation.score(net, driven_log(machine, task, "rl")),
        },
        "preliminary": numbers,
        "net_claims": [claim.to_json() for claim in claims.net_claims(numbers)],
        "gains": baselines.gains_table(pids),
        "tuning_runs": tuning_runs(machine, budget.tuning_runs, seed),
    }
    return results | compared, report.Shown(net, test, measured, task, singular)


def compare(
    machine: Machine, rl: Controller, pids: Pids, budget: Budget, seed: int
) -> tuple[dict[str, Any], Traces, Traces]:
    """The paper's experiment, regret and robustness: JSON, all traces, those near singularities.

    Means, intervals and verdicts are over the "workspace" starts, from which all sequences can be
    followed.
    """
    controllers: Controllers = {"rl": rl, **pids}
    commands = sequences.task_sequences(machine)
    starts = sequences.evaluation_starts(machine, budget.starts, commands, seed + 2)
    kinds = np.array(sequences.start_kinds(machine, starts))
    workspace = kinds == "workspace"
    reachable = starts[workspace]
    runs, traces = evaluate(machine, controllers, commands, starts, seed)
    scored = [run for run in runs if run["kind"] == "workspace"]
    extended = starts[kinds == "extended"]
    singular, near, near_traces = near_singularities(
        machine, claims.singular_controllers(rl, pids), extended, budget.short_s, seed
    )
    along_x = {c: Trace(*(array[:, workspace] for array in traces[c, "x"])) for c in pids}
    goals = commands[0].for_starts(machine, reachable)
    every = claims.task_claims(machine, pids, scored, along_x, goals, near)
    short = shorten(machine, sequences.axis_sequences(machine), budget.short_s)
    results = {
        "task_space": tables(runs, scored),
        "regret": regret(machine, controllers, short, reachable[: budget.bound_starts], seed),
        "robustness": robustness(machine, controllers, short, reachable[:16], seed),
        "singular": singular,
        "claims": [claim.to_json() for claim in every],
        "starts": starts.tolist(),
        "start_kinds": kinds.tolist(),
    }
    return results, traces, near_traces


def shorten(machine: Machine, commands: Sequence[Commands], seconds: float) -> list[Commands]:
    """The first seconds of each sequence."""
    ticks = round(seconds * machine.rate)
    return [sequence._replace(goals=sequence.goals[:ticks]) for sequence in commands]


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


def regret(
    machine: Machine,
    controllers: Controllers,
    commands: Sequence[Commands],
    starts: Array,
    seed: int,
) -> dict[str, Any]:
    """Mean errors, and velocity errors less that of a controller that knows the plant."""
    every = {**controllers, **perfect_models(machine, starts)}
    runs, _ = evaluate(machine, every, commands, starts, seed)
    error = "velocity_error_mean"
    less = {c: metrics.paired_difference(runs, c, "perfect_model", error) for c in controllers}
    return {"summary": summary(runs), "less_perfect_model": less}


def near_singularities(
    machine: Machine, controllers: Controllers, starts: Array, seconds: float, seed: int
) -> tuple[dict[str, Any], list[claims.Claim], Traces]:
    """Runs of `claims.singular_controllers` from extended starts: JSON, claims and traces.

    The JSON has the "manipulability" and the "least" singular value [m/rad] at each start. All are
    empty without starts. Paper: Fig. 6a, 6e, 6f
    """
    if not len(starts):
        return {"summary": {}, "claims": []}, [], {}
    commands = shorten(machine, sequences.singular_sequences(machine, starts), seconds)
    runs, traces = evaluate(machine, controllers, commands, starts, seed)
    w0 = manipulability_threshold(machine)
    J = jacobian(forward_kinematics(machine, starts))[..., machine.driven]
    speed = {}
    for name in controllers:
        fractions = [
            claims.speed_fraction(machine, w0, traces[name, s.name], s.for_starts(machine, starts))
            for s in commands
        ]
        speed[name] = metrics.row_mean(np.stack(fractions, axis=1))
    singular = claims.singular_claims(runs, speed)
    results = {
        "summary": summary(runs),
        "claims": [claim.to_json() for claim in singular],
        "w0": w0,
        "manipulability": manipulability(J).tolist(),
        "least": np.linalg.svd(J, compute_uv=False)[:, -1].tolist(),
    }
    return results, singular, traces


def tuning_runs(machine: Machine, num: int, seed: int) -> list[dict[str, Any]]:
    """Each run on which the baselines were tuned: "start" [rad] and "goals", see `hold_table`."""
    starts, goals = sequences.tuning_set(machine, num, seed)
    runs = []
    for i, start in enumerate(starts):
        table = sequences.hold_table(machine, goals[:, i])
        runs.append({"start": start.tolist(), "goals": table.tolist()})
    return runs


def write(out: Path, results: Mapping[str, Any], policy: Policy, pids: Pids) -> None:
    """Write what other commands read: results, gains, the policy with its errors as metadata."""
    write_json(out / "results.json", results)
    baselines.write_gains(out / "gains.json", pids, results["meta"])
    means = results["task_space"]["summary"]
    errors = {controller: rows["all"]["velocity_error_mean"] for controller, rows in means.items()}
    command = f"brokk-min reproduce --seed {results['meta']['seed']}"
    made = {"command": command, "velocity_error_mean": errors}
    save_policy(out / "policy.npz", replace(policy, training={**policy.training, **made}))
