"""The whole chain: logs, nets, policies, tuned baselines, comparison, report."""

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from brokk_min._files import write_json
from brokk_min.actuator import ActuatorNet
from brokk_min.evaluation import baselines, claims, metrics, preliminary, report, sequences
from brokk_min.evaluation.metrics import Traces, evaluate
from brokk_min.evaluation.robustness import robustness
from brokk_min.identification import fitting, logs, validation
from brokk_min.identification.excitation import collect, task_log
from brokk_min.identification.net_file import save_net, select_nets
from brokk_min.jacobian import JacobianController
from brokk_min.learning.checkpoint import train_policy
from brokk_min.learning.jobs import side_by_side
from brokk_min.learning.policy import POLICIES, Policy, PolicyController
from brokk_min.learning.recipes import Recipe, paper_recipe
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


class Learned(NamedTuple):
    """Nets, policies and baselines of a chain."""

    nets: Mapping[str, ActuatorNet]  # "net" and "net_paper"
    policies: Mapping[str, Policy]  # by the names of `POLICIES`
    pids: Mapping[str, JacobianController]
    tuning: Mapping[str, Any]  # record of the tuning, for JSON


def reproduce(machine: Machine, out: Path, budget: Budget, seed: int) -> dict[str, Any]:
    """Run the chain; logs, nets, policies, gains, `results.json` and `report.html` go to `out`.

    `results.json` has no times, so the same seed gives the same file on the same computer.
    """
    began = time.perf_counter()
    chain = Chain(machine, out, budget, seed)
    clock: dict[str, float] = {}
    log, paper_log, test = record(chain)
    learned = learn(chain, log, paper_log, clock)
    results, drawn = measure(chain, learned, test, clock)
    write_json(out / "results.json", results)
    baselines.write_gains(out / "gains.json", learned.pids, results["meta"])
    report.write_report(out, results, drawn, (time.perf_counter() - began) / 60)
    write_json(out / "timing.json", clock)
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
    recipe = paper_recipe() if name == "rl_paper" else Recipe()
    if chain.budget.train_steps:
        learner = replace(recipe.learner, total_steps=chain.budget.train_steps)
        recipe = replace(recipe, learner=learner)
    driven = select_nets(chain.machine, net)
    file = chain.out / POLICIES[name]
    resume = Path(f"{file}.checkpoint").exists()
    return train_policy(chain.machine, driven, recipe, chain.seed, file, resume)


def tune(chain: Chain, net: ActuatorNet, name: str) -> Any:
    """One baseline with tuned gains, and the record of its tuning."""
    budget, nets = chain.budget, select_nets(chain.machine, net)
    effort = budget.tuning_runs, budget.generations, chain.seed
    longest = budget.short_s
    return baselines.tune_baselines(chain.machine, nets, *effort, longest=longest, only=[name])


def learn(chain: Chain, log: logs.Log, paper_log: logs.Log, clock: dict[str, float]) -> Learned:
    """All fits, trainings and tunings, side by side."""
    jobs: dict[str, Callable[..., Any]] = {
        "fit net": partial(fit_net, chain, "net", log, {}),
        "fit net_paper": partial(fit_net, chain, "net_paper", paper_log, fitting.PAPER_RECIPE),
        "train rl": partial(train, chain, "rl"),
        "train rl_paper": partial(train, chain, "rl_paper"),
    }
    needs = {"train rl": ["fit net"], "train rl_paper": ["fit net_paper"]}
    for name in baselines.TUNED:
        jobs[f"tune {name}"] = partial(tune, chain, name=name)
        needs[f"tune {name}"] = ["fit net"]
    net, paper_net, rl, rl_paper, *tuned = side_by_side(jobs, clock, needs)
    pids = {name: pid for found, _ in tuned for name, pid in found.items()}
    tuning = {name: row for _, rows in tuned for name, row in rows.items()}
    policies = {"rl": rl, "rl_paper": rl_paper}
    return Learned({"net": net, "net_paper": paper_net}, policies, pids, tuning)


def measure(
    chain: Chain, learned: Learned, test: logs.Log, clock: dict[str, float]
) -> tuple[dict[str, Any], dict[str, Figure]]:
    """All measurements for `results.json`, and the figures."""
    machine, seed = chain.machine, chain.seed
    ran = {name: preliminary.run(machine, net, seed) for name, net in learned.nets.items()}
    numbers = {name: preliminary.numbers(machine, of) for name, of in ran.items()}
    compared, traces = compare(chain, learned, clock)
    meta = metrics.metadata(machine, seed)
    meta |= baselines.gains_metadata(machine, learned.policies["rl"].net)
    results = {
        "meta": meta | {"effort": asdict(chain.budget)},
        "nets": {
            name: {"test": validation.score(net, test), "sim_to_real": numbers[name]["sim_to_real"]}
            for name, net in learned.nets.items()
        },
        "preliminary": numbers["net"],
        "tuning": learned.tuning,
    }
    of_nets = [claim.to_json() for claim in claims.net_claims(numbers["net"])]
    compared["claims"] = of_nets + compared["claims"]
    results |= compared
    return results, report.draw(machine, results, ran["net"], traces)


def compare(
    chain: Chain, learned: Learned, clock: dict[str, float]
) -> tuple[dict[str, Any], Traces]:
    """The paper's experiment and robustness: JSON, and all traces.

    Means, intervals and verdicts are over the "workspace" starts, which can follow all sequences.
    """
    machine, budget, seed = chain.machine, chain.budget, chain.seed
    policies = {n: PolicyController(machine, policy) for n, policy in learned.policies.items()}
    controllers: metrics.Controllers = {**policies, **learned.pids}
    commands = sequences.task_sequences(machine)
    starts = sequences.evaluation_starts(machine, budget.starts, commands, seed + 2)
    kinds = np.array(sequences.start_kinds(machine, starts))
    workspace = starts[kinds == "workspace"]
    short = sequences.shorten(machine, commands[:3], budget.short_s)
    jobs: dict[str, Callable[[], Any]] = {
        "score changed": partial(robustness, machine, controllers, short, workspace[:16], seed),
        "score": partial(evaluate, machine, controllers, commands, starts, seed),
    }
    changed, (runs, traces) = side_by_side(jobs, clock)
    scored = [run for run in runs if run["kind"] == "workspace"]
    results = {
        "task_space": {"runs": runs, "means": metrics.means(scored)},
        "robustness": changed,
        "claims": [claim.to_json() for claim in claims.task_claims(scored)],
        "starts": starts.tolist(),
        "start_kinds": kinds.tolist(),
    }
    return results, traces
