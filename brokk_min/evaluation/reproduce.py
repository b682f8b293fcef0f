"""The whole chain in one function: logs, nets, policy, baselines, comparison, report."""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from brokk_min.actuator import ActuatorNet
from brokk_min.env import TaskConfig
from brokk_min.evaluation import claims, figures, preliminary, report
from brokk_min.evaluation.baselines import gains_metadata, gains_table, tune_baselines, write_gains
from brokk_min.evaluation.experiments import Effort, comparison, driven_log
from brokk_min.evaluation.metrics import Traces, evaluate, metadata, summary
from brokk_min.evaluation.sequences import axis_sequences, hold_table, tuning_set
from brokk_min.identification import excitation, fitting, logs, net_file
from brokk_min.identification import validation as scores
from brokk_min.identification.files import write_json
from brokk_min.jacobian import JacobianController
from brokk_min.learning.policy import Policy, PolicyController, save_policy
from brokk_min.machine import Array, Machine


def reproduce(
    machine: Machine, out: Path, effort: Effort, seed: int, sweep: Path | None = None
) -> dict[str, Any]:
    """Logs, nets, policy, baselines, comparison, `results.json` and `report.html` in the folder `out`.

    `results.json` holds no clock: the same seed gives the same file on the same machine. The figures of
    training seeds in the file `sweep`, which `sweep.sweep` wrote, join the report.
    """
    from brokk_min.learning.checkpoint import train_policy
    from brokk_min.evaluation.seeds import read_seeds, seeds_of
    from brokk_min.ppo import PPOConfig  # torch, only where something is trained

    seeds = read_seeds(sweep) if sweep else {}
    out.mkdir(parents=True, exist_ok=True)
    clock, stage = stages(6)
    with stage("record"):
        log, test = record(machine, out, effort, seed)
    with stage("fit"):
        net, paper = fitted(machine, out, log, test, effort, seed)
        driven = net.select([machine.names[i] for i in machine.driven])
        over_seeds = seeds_of(machine, driven, seeds) if seeds else {}
    with stage("train"):
        learner = PPOConfig(total_steps=effort.train_steps)
        policy = train_policy(
            machine, driven, TaskConfig(), learner, seed, out / "policy.npz", resume=True
        )
    with stage("tune"):
        tuned, how = tune_baselines(machine, driven, effort.tuning_runs, effort.generations, seed)
    with stage("evaluate"):
        rl = PolicyController(machine, policy)
        measured, traces = measure(machine, net, test, rl, tuned, effort, seed)
    about = metadata(machine, seed) | gains_metadata(machine, driven) | {"effort": asdict(effort)}
    results = {"meta": about, "paper_recipe": paper, **measured, "gains": gains_table(tuned)}
    results |= {"tuning": how, "training_seeds": over_seeds}
    with stage("draw"):
        write(out, results, tuned, told(policy, results, seed))
        parts = report.net_parts(
            machine, net, test, results, seed, out / "policy.npz.csv", clock["train"]
        )
        parts = [report.found(results), *parts, *report.task_parts(machine, results, traces)]
        figures.write_report(out / "report.html", parts, clock)
    write_json(out / "timing.json", clock)
    return results


def stages(total: int) -> tuple[dict[str, float], Callable[[str], AbstractContextManager[None]]]:
    """Seconds by stage, filled in as `total` stages end, and what each stage is to run in."""
    clock: dict[str, float] = {}
    bar = tqdm(total=total, desc="stages done", unit="stage", position=1, disable=None)

    @contextmanager
    def stage(name: str) -> Iterator[None]:
        begun = time.perf_counter()
        yield
        clock[name] = time.perf_counter() - begun
        bar.set_postfix_str(name)
        bar.update()
        if len(clock) == total:
            bar.close()

    return clock, stage


def fitted(
    machine: Machine, out: Path, log: logs.Log, test: logs.Log, effort: Effort, seed: int
) -> tuple[ActuatorNet, dict[str, Any]]:
    """Nets of all joints, written to `net.npz`, and how those by the paper's recipe fare, for JSON."""
    config = fitting.FitConfig(
        steps=effort.fit_steps, history=machine.history, dead_zone=machine.dead_zone
    )
    net = fitting.fit(log, config, seed, machine.velocity_samples, machine.name)
    net_file.save_net(out / "net.npz", net)
    half = replace(config, steps=effort.fit_steps // 2)  # for time
    return net, preliminary.paper_recipe(machine, test, effort.hours, half, seed)


def measure(
    machine: Machine,
    net: ActuatorNet,
    test: logs.Log,
    rl: PolicyController,
    tuned: Mapping[str, JacobianController],
    effort: Effort,
    seed: int,
) -> tuple[dict[str, Any], dict[str, Traces]]:
    """All that is measured of nets, policy and baselines: `results.json`, and traces of `comparison`."""
    compared, traces = comparison(machine, {"rl": rl, **tuned}, effort, seed)
    compared["task_space"]["rl_on_nets"] = on_nets(machine, rl, compared, seed)
    driven = scores.score(net, driven_log(machine, traces["all"], "rl"))
    before, tuning = (
        preliminary.run(machine, net, seed),
        tuning_set(machine, effort.tuning_runs, seed),
    )
    return {
        "actuator": {"test": scores.score(net, test), "driven_by_policy": driven},
        "preliminary": before,
        "net_claims": claims.net_claims(before),
        **compared,
        "tuning_runs": tuning_runs(machine, *tuning),
    }, traces


def tuning_runs(machine: Machine, starts: Array, goals: Array) -> list[dict[str, Any]]:
    """Each run that the baselines were tuned on, for JSON: "start" [rad] and "goals", see `hold_table`."""
    runs = zip(starts, goals.swapaxes(0, 1), strict=True)
    return [{"start": s.tolist(), "goals": hold_table(machine, run).tolist()} for s, run in runs]


def record(machine: Machine, out: Path, effort: Effort, seed: int) -> list[logs.Log]:
    """Logs to fit nets to and to score them on, written and read back as anybody's."""
    files, rng = (out / "log.npz", out / "log_test.npz"), np.random.default_rng
    logs.write_log(files[0], excitation.collect(machine, effort.hours, "rich", rng(seed)))
    logs.write_log(files[1], excitation.task_log(machine, 20, 40.0, rng(seed + 1)))
    return [logs.read_log([file], machine.velocity_samples, rate=machine.rate) for file in files]


def on_nets(
    machine: Machine, rl: PolicyController, compared: Mapping[str, Any], seed: int
) -> dict[str, dict[str, float | None]]:
    """`summary` of the policy on its own nets, along x, y and z from the workspace starts."""
    starts = np.array(compared["starts"])[np.array(compared["start_kinds"]) == "workspace"]
    runs, _ = evaluate(machine, {"rl": rl}, axis_sequences(machine), starts, seed, rl.policy.net)
    return summary(runs)["rl"]


def write(
    out: Path, results: Mapping[str, Any], tuned: Mapping[str, JacobianController], policy: Policy
) -> None:
    """What the other commands read: figures, gains of the baselines, the policy."""
    write_json(out / "results.json", results)
    write_gains(out / "gains.json", tuned, results["meta"])
    save_policy(out / "policy.npz", policy)


def told(policy: Policy, results: Mapping[str, Any], seed: int) -> Policy:
    """The policy with the command that made it and its figures in its file's header."""
    errors = {
        c: of["all"]["velocity_error_mean"] for c, of in results["task_space"]["summary"].items()
    }
    said = {"command": f"brokk-min reproduce --seed {seed}", "velocity_error_mean": errors}
    return replace(policy, training={**policy.training, **said})
