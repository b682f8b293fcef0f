"""The whole chain: logs, nets, policies, tuned baselines, comparison, report."""

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from brokk_min._files import write_json
from brokk_min.actuator import ActuatorNet
from brokk_min.evaluation import baselines, claims, metrics, preliminary, report, sequences
from brokk_min.evaluation.metrics import Traces, evaluate
from brokk_min.evaluation.robustness import leads, robustness
from brokk_min.identification import fitting, logs, validation
from brokk_min.identification.excitation import collect, task_log
from brokk_min.identification.net_file import save_net, select_nets
from brokk_min.jacobian import Gains, JacobianController
from brokk_min.learning.checkpoint import train_policy
from brokk_min.learning.jobs import side_by_side
from brokk_min.learning.policy import POLICIES, Policy, PolicyController
from brokk_min.learning.recipes import find_recipe
from brokk_min.machine import Machine


@dataclass(frozen=True)
class Budget:
    """How much each stage may spend."""

    hours: float = 1.0  # driving time of each actuator that is recorded (paper: 1 h)
    fit_steps: int = fitting.FitConfig.steps
    train_steps: int | None = None  # None: as many as the recipe has
    generations: int = baselines.GENERATIONS  # of the tuning
    tuning_runs: int = baselines.TUNING_RUNS
    starts: int = 64
    short_s: float = 26.0  # s, longest run of tuning and robustness


QUICK = Budget(0.1, 700, 100_000, 4, 4, 8, 3.0)


@dataclass(frozen=True)
class Chain:
    """What all stages of one chain share."""

    machine: Machine
    out: Path  # folder of its files
    budget: Budget
    seed: int


def reproduce(machine: Machine, out: Path, budget: Budget, seed: int) -> dict[str, Any]:
    """Run the chain; logs, nets, policies, gains, `results.json` and `report.html` go to `out`.

    `results.json` has no times, so the same seed gives the same file on the same computer.
    """
    began = time.perf_counter()
    chain = Chain(machine, out, budget, seed)
    log, paper_log, test = record(chain)
    first = baselines.first_gains(machine)
    done = learn(chain, log, paper_log, first)
    gains = first | {name: done[name][0] for name in baselines.TUNED}
    pids = baselines.baselines(machine, select_nets(machine, done["net"]), gains)
    results, drawn = measure(chain, done, pids, test)
    write_json(out / "results.json", results)
    baselines.write_gains(out / "gains.json", pids, results["meta"])
    report.write_report(out, results, drawn, (time.perf_counter() - began) / 60)
    return results


def record(chain: Chain) -> list[logs.Log]:
    """Logs to fit nets to, our rich ones and the paper's sines, and one to score the nets on.

    They are written and read back as a user's would be.
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


def fit_net(chain: Chain, name: str, log: logs.Log, recipe: Mapping[str, Any]) -> ActuatorNet:
    """Nets of all joints by our settings but for those of `recipe`, written to `name`.npz."""
    m = chain.machine
    config = fitting.FitConfig(**{"steps": chain.budget.fit_steps, **recipe})
    net = fitting.fit(log, config, chain.seed, m, m.name)
    save_net(chain.out / f"{name}.npz", net)
    return net


def train(chain: Chain, name: str, net: ActuatorNet) -> Policy:
    """One of `POLICIES`, by its own recipe."""
    recipe = find_recipe(paper=name != "rl", critic=name == "rl_critic")
    if chain.budget.train_steps:
        learner = replace(recipe.learner, total_steps=chain.budget.train_steps)
        recipe = replace(recipe, learner=learner)
    driven = select_nets(chain.machine, net)
    file = chain.out / POLICIES[name]
    resume = Path(f"{file}.checkpoint").exists()
    return train_policy(chain.machine, driven, recipe, chain.seed, file, resume)


def tune(
    chain: Chain, first: Mapping[str, Gains], name: str, net: ActuatorNet
) -> tuple[Gains, list[float]]:
    """Gains of one of `baselines.TUNED`, from the `first` gains on, and costs by generation."""
    budget = chain.budget
    seconds = min(baselines.TUNING_SECONDS, budget.short_s)
    pids = baselines.baselines(chain.machine, select_nets(chain.machine, net), first)
    effort = budget.generations, budget.tuning_runs, seconds
    return baselines.tune_baseline(pids[name], effort, chain.seed)


def learn(
    chain: Chain, log: logs.Log, paper_log: logs.Log, first: Mapping[str, Gains]
) -> dict[str, Any]:
    """All fits, trainings and tunings, side by side; nets, policies and gains by their names."""
    jobs: dict[str, Callable[..., Any]] = {
        "net": partial(fit_net, chain, "net", log, {}),
        "net_paper": partial(fit_net, chain, "net_paper", paper_log, fitting.PAPER_RECIPE),
    }
    needs = {}
    for name in sorted(POLICIES, reverse=True):  # the longest first
        jobs[name] = partial(train, chain, name)
        needs[name] = ["net" if name == "rl" else "net_paper"]
    for name in baselines.TUNED:
        jobs[name] = partial(tune, chain, first, name)
        needs[name] = ["net"]
    return side_by_side(jobs, needs)


def measure(
    chain: Chain, done: Mapping[str, Any], pids: Mapping[str, JacobianController], test: logs.Log
) -> tuple[dict[str, Any], dict[str, Figure]]:
    """All measurements for `results.json`, and the figures. `done` is of `learn`."""
    machine, seed = chain.machine, chain.seed
    net = select_nets(machine, done["net"])
    policies = {name: PolicyController(machine, done[name]) for name in POLICIES}
    tests, gap = preliminary.run(machine, net, seed)
    numbers = preliminary.numbers(machine, tests, gap)
    compared, traces = compare(chain, {**policies, **pids})
    meta = metrics.metadata(machine, seed) | baselines.gains_metadata(machine, net)
    of_nets = [claim.to_json() for claim in claims.net_claims(numbers)]
    results = {
        "meta": meta | {"effort": asdict(chain.budget)},
        "nets": {name: validation.score(done[name], test) for name in ("net", "net_paper")},
        "preliminary": numbers,
        "tuning": {name: done[name][1] for name in baselines.TUNED},
        **compared,
        "claims": of_nets + compared["claims"],
    }
    return results, report.draw(machine, results, tests, gap, traces)


def compare(chain: Chain, controllers: metrics.Controllers) -> tuple[dict[str, Any], Traces]:
    """The paper's experiment and robustness: JSON, and all traces.

    Means, intervals and verdicts are over the "workspace" starts, which can follow all sequences.
    """
    machine, budget, seed = chain.machine, chain.budget, chain.seed
    commands = sequences.task_sequences(machine)
    starts = sequences.evaluation_starts(machine, budget.starts, commands, seed + 2)
    kinds = sequences.start_kinds(machine, starts)
    workspace = starts[np.array(kinds) == "workspace"]
    short = sequences.shorten(machine, commands[:3], budget.short_s)
    jobs: dict[str, Callable[[], Any]] = {
        "robustness": partial(robustness, machine, controllers, short, workspace[:16], seed),
        "runs": partial(evaluate, machine, controllers, commands, starts, seed),
    }
    done = side_by_side(jobs)
    runs, traces = done["runs"]
    scored = [run for run in runs if run["kind"] == "workspace"]
    results = {
        "task_space": {"runs": runs, "means": metrics.means(scored)},
        "robustness": done["robustness"],
        "leads": leads(done["robustness"]),
        "claims": [claim.to_json() for claim in claims.task_claims(scored)],
        "starts": starts.tolist(),
        "start_kinds": kinds,
    }
    return results, traces
