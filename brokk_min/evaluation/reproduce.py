"""The whole chain: logs, nets, policies, tuned baselines, comparison, report."""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from brokk_min._files import write_json
from brokk_min.actuator import ActuatorNet
from brokk_min.evaluation import baselines, claims, metrics, preliminary, report, sequences
from brokk_min.evaluation.robustness import robustness
from brokk_min.evaluation.rollout import Controller
from brokk_min.identification import fitting, logs
from brokk_min.identification.excitation import collect
from brokk_min.identification.net_file import save_net, select_nets
from brokk_min.jacobian import JacobianController
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
    tuning: tuple[int, int, float] = baselines.EFFORT
    starts: int = 64
    short_s: float = 26.0  # s, longest run for robustness


QUICK = Budget(0.1, 700, 100_000, (4, 4, 3.0), 8, 3.0)


@dataclass(frozen=True)
class Chain:
    """What all stages of one chain share."""

    machine: Machine
    out: Path  # folder of its files
    budget: Budget
    seed: int


def reproduce(machine: Machine, out: Path, budget: Budget, seed: int) -> dict[str, Any]:
    """Run the chain; logs, nets, policies, gains, results and `report.html` go to `out`.

    `table.json` has the means along x, y and z alone. No file of results has times, so the same
    seed gives the same files on the same computer.
    """
    chain = Chain(machine, out, budget, seed)
    out.mkdir(parents=True, exist_ok=True)
    done = learn(chain, record(chain, "rich", "log"), record(chain, "sine", "log_paper"))
    results, measured = measure(chain, done)
    write_json(out / "results.json", results)
    write_json(out / "table.json", {key: results[key] for key in ("meta", "table")})
    baselines.write_gains(out / "gains.json", done["pids"], results["meta"])
    report.write_report(out, machine, results, measured)
    return results


def record(chain: Chain, excitation: str, name: str) -> logs.Log:
    """A log to fit nets to, written to `name`.npz and read back as a user's would be."""
    machine, file = chain.machine, chain.out / f"{name}.npz"
    rng = np.random.default_rng(chain.seed)
    logs.write_log(file, collect(machine, chain.budget.hours, excitation, rng))
    return logs.read_log([file], machine.velocity_samples, rate=machine.rate)


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


def tune(chain: Chain, net: ActuatorNet) -> dict[str, JacobianController]:
    """The baselines, tuned."""
    driven = select_nets(chain.machine, net)
    return baselines.tuned_baselines(chain.machine, driven, chain.budget.tuning, chain.seed)


def learn(chain: Chain, log: logs.Log, paper_log: logs.Log) -> dict[str, Any]:
    """All fits, trainings and tunings, side by side; nets, policies and PIDs by their names.

    The policy as printed learns on nets as printed, the others on ours.
    """
    jobs: dict[str, Callable[..., Any]] = {
        "net": partial(fit_net, chain, "net", log, {}),
        "net_paper": partial(fit_net, chain, "net_paper", paper_log, fitting.PAPER_RECIPE),
    }
    needs = {"pids": ["net"]}
    for name in sorted(POLICIES, reverse=True):  # the longest first
        jobs[name] = partial(train, chain, name)
        needs[name] = ["net_paper" if name == "rl_critic" else "net"]
    jobs["pids"] = partial(tune, chain)
    return side_by_side(jobs, needs)


def measure(
    chain: Chain, done: Mapping[str, Any]
) -> tuple[dict[str, Any], tuple[report.Tests, preliminary.Motion, metrics.Traces]]:
    """All measurements for `results.json`, and what the figures show. `done` is of `learn`.

    Means, intervals and verdicts are over the "workspace" starts, which can follow all sequences.
    """
    machine, budget, seed = chain.machine, chain.budget, chain.seed
    net = select_nets(machine, done["net"])
    policies = {name: PolicyController(machine, done[name]) for name in POLICIES}
    controllers: dict[str, Controller] = {**policies, **done["pids"]}
    commands = sequences.task_sequences(machine)
    starts = sequences.evaluation_starts(machine, budget.starts, commands, seed + 2)
    kinds = sequences.start_kinds(machine, starts)
    workspace = starts[np.array(kinds) == "workspace"]
    short = sequences.shorten(machine, commands[:3], budget.short_s)
    jobs: dict[str, Callable[[], Any]] = {
        "robustness": partial(robustness, machine, controllers, short, workspace[:16], seed),
        "runs": partial(metrics.evaluate, machine, controllers, commands, starts, seed),
    }
    tests, gap = preliminary.run(machine, net, seed)
    of_jobs = side_by_side(jobs)
    runs, traces = of_jobs["runs"]
    meta = metrics.metadata(machine, seed) | baselines.gains_metadata(machine, net)
    results = {
        "meta": meta | {"effort": asdict(budget)},
        **summary(runs, claims.net_claims(tests["nets"], gap)),
        "robustness": of_jobs["robustness"],
        "starts": starts.tolist(),
        "start_kinds": kinds,
    }
    return results, (tests, gap, traces)


def summary(runs: metrics.Rows, of_nets: list[dict[str, Any]]) -> dict[str, Any]:
    """Runs, their means, and all claims; `table` has the means along x, y and z alone."""
    scored = [run for run in runs if run["kind"] == "workspace"]
    along = metrics.means([run for run in scored if run["sequence"] in sequences.AXES])
    return {
        "table": {name: of["all"] for name, of in along.items()},
        "task_space": {"runs": runs, "means": metrics.means(scored)},
        "claims": of_nets + claims.task_claims(scored),
    }
