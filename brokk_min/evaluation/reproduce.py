"""The whole chain: logs, nets, policies, tuned baselines, comparison, report."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from brokk_min._files import digest, write_csv, write_json
from brokk_min.actuator import PLANT, ActuatorNet, Plant, hydraulics_of
from brokk_min.beyond.net_ensemble import together
from brokk_min.beyond.rich_excitation import RICH
from brokk_min.evaluation import (
    adaptive,
    baselines,
    claims,
    metrics,
    preliminary,
    report,
    sequences,
)
from brokk_min.evaluation.rollout import title
from brokk_min.fit import SINE, Excitation, Log, collect
from brokk_min.identification import fitting, logs
from brokk_min.identification.net_file import save_net, select_nets
from brokk_min.learning.checkpoint import train_policy
from brokk_min.learning.jobs import side_by_side
from brokk_min.learning.policy import POLICIES, Policy
from brokk_min.learning.recipes import Recipe, find_recipe
from brokk_min.machine import Array, Machine
from brokk_min.settings import TaskConfig

# beyond the chain's: sixth in error of the seeds 0 to 9, of `rl_critic` third of 0 to 3
SEEDS = {"rl": 8, "rl_paper": 5, "rl_critic": 3}
PIDS = (baselines.RAW, baselines.BY_HAND, baselines.OPTIMISED, baselines.STRONGEST)
CONTROLLERS = (*POLICIES, *PIDS)
PAIRS = (  # of a policy and a PID, that the pages compare
    ("rl_critic", baselines.BY_HAND),
    ("rl_paper", baselines.BY_HAND),
    ("rl_paper", baselines.OPTIMISED),
    ("rl", baselines.STRONGEST),
)
COMPARED = ("velocity_error_mean", "off_axis_drift_max", "jerk_rms")  # figures of pairs


@dataclass(frozen=True)
class Budget:
    """How much each stage may spend."""

    hours: float = 1.0  # driving time of each actuator that is recorded (paper: 1 h)
    fit_steps: int = fitting.OurFitConfig.steps
    train_steps: int | None = None  # None: as many as the recipe has
    tuning: baselines.Effort = baselines.EFFORT
    starts: int = 32
    short_s: float = 26.0  # s, longest run for robustness


QUICK = Budget(0.3, 1300, 400_000, (4, 8, 10.0), 4, 3.0)


class Case(NamedTuple):
    """What controllers were not made for."""

    machine: Machine
    commands: Sequence[sequences.Commands]
    noise: float  # deviations
    warm_up: list[tuple[Array, Array]]  # motions before the runs of those that are warm


@dataclass(frozen=True)
class Chain:
    """What all stages of one chain share."""

    machine: Machine
    out: Path  # folder of its files
    budget: Budget
    seed: int


def reproduce(machine: Machine, out: Path, budget: Budget, seed: int) -> dict[str, Any]:
    """Run the chain; logs, nets, policies, gains, starts, results and `report.html` go to `out`.

    `table.json` is what pages quote: means along x, y and z, pairs motion by motion, and verdicts.
    The same seed gives the same files again.
    """
    chain = Chain(machine, out, budget, seed)
    out.mkdir(parents=True, exist_ok=True)
    commands = sequences.task_sequences(machine)
    starts = sequences.draw_starts(machine, budget.starts, commands, seed + 2)
    write_csv(out / "starts.csv", machine.names, starts.tolist())
    rich, sines = record_log(chain, RICH, "log"), record_log(chain, SINE, "log_paper")
    ticks = round(budget.short_s * machine.rate)
    short = [axis._replace(goals=axis.goals[:ticks]) for axis in sequences.axis_sequences(machine)]
    cases = unusual(machine, short)
    done = do_all(chain, rich, sines, starts, cases)
    results, shown = summarise(chain, starts, cases, done)
    write_json(out / "results.json", results)
    keys = ("meta", "table", "pairs", "claims")
    write_json(out / "table.json", {key: results[key] for key in keys})
    report.write_report(out, machine, results, shown)
    return results


def record_log(chain: Chain, excitation: Excitation, name: str) -> Log:
    """A log to fit nets to, written to `name`.npz and read back as a user's would be."""
    machine, file = chain.machine, chain.out / f"{name}.npz"
    rng = np.random.default_rng(chain.seed)
    logs.write_log(file, collect(machine, chain.budget.hours, rng, PLANT, excitation))
    return logs.read_log(file, machine)


def fit_net(chain: Chain, name: str, log: Log, recipe: Mapping[str, Any]) -> ActuatorNet:
    """Nets of all joints by our settings but for those of `recipe`, written to `name`.npz."""
    config = fitting.OurFitConfig(**{"steps": chain.budget.fit_steps, **recipe})
    net = fitting.fit_nets(log, config, chain.seed, chain.machine, chain.machine.name)
    save_net(chain.out / f"{name}.npz", net)
    return net


def fit_member(chain: Chain, log: Log, member: int) -> ActuatorNet:
    """One net of each joint, of the five whose mean counts."""
    config = fitting.OurFitConfig(chain.budget.fit_steps, members=1)
    seed = fitting.OurFitConfig.members * chain.seed + member
    return fitting.fit_nets(log, config, seed, chain.machine, chain.machine.name)


def join_members(chain: Chain, *nets: Any) -> ActuatorNet:
    """The nets that `fit_net` would have fitted one after the other, written to `net.npz`."""
    config = fitting.OurFitConfig(chain.budget.fit_steps)
    net = together(nets, {"seed": chain.seed, "settings": asdict(config)})
    save_net(chain.out / "net.npz", net)
    return net


def recipe_of(name: str) -> Recipe:
    """The recipe of one of `POLICIES`."""
    return find_recipe(paper=name != "rl", critic=name == "rl_critic")


def train_one(chain: Chain, name: str, net: ActuatorNet) -> Policy:
    """One of `POLICIES`, by its own recipe."""
    recipe = recipe_of(name)
    steps = chain.budget.train_steps or recipe.learner.total_steps
    recipe = replace(recipe, learner=replace(recipe.learner, total_steps=steps))
    driven, seed = select_nets(chain.machine, net), chain.seed + SEEDS[name]
    return train_policy(chain.machine, driven, recipe, seed, chain.out / POLICIES[name])


def do_all(
    chain: Chain, log: Log, paper_log: Log, starts: Array, cases: Mapping[str, Case]
) -> dict[str, Any]:
    """All fits, trainings, tunings and measurements, side by side; what they give, by name."""
    tune = partial(baselines.tuned_baselines, chain.machine)
    members = {
        f"net {member}": partial(fit_member, chain, log, member)
        for member in range(fitting.OurFitConfig.members)
    }
    jobs: dict[str, Callable[..., Any]] = {
        **members,
        "net": partial(join_members, chain),
        "net_paper": partial(fit_net, chain, "net_paper", paper_log, fitting.PAPER_RECIPE),
        "rl_paper": partial(train_one, chain, "rl_paper"),  # the longest first
        "rl_critic": partial(train_one, chain, "rl_critic"),
        "rl": partial(train_one, chain, "rl"),
        "pids": partial(tune, effort=chain.budget.tuning, seed=chain.seed),
        "tests": partial(try_plants, chain),
    }
    needs = {name: ["net"] for name in (*POLICIES, "pids", "tests")}
    needs |= {"net": [*members], "rl_critic": ["net_paper"]}
    for name in CONTROLLERS:
        jobs[f"runs of {name}"] = partial(measure, chain, starts, name)
        for case, drives in cases.items():
            jobs[f"{name}, {case}"] = partial(vary, chain, starts[:16], drives, name)
        needs |= {
            job: ["net", name if name in POLICIES else "pids"]
            for job in (f"runs of {name}", *(f"{name}, {case}" for case in cases))
        }
    return side_by_side(jobs, needs)


def only(name: str, found: Any) -> metrics.Controllers:
    """One controller by its name: a policy, `found`, or one of the PIDs that were found."""
    return {name: found if name in POLICIES else found[name]}


def measure(
    chain: Chain, starts: Array, name: str, _: ActuatorNet, found: Any
) -> tuple[metrics.Table, metrics.Traces]:
    """Runs of one controller on the machine."""
    commands = sequences.task_sequences(chain.machine)
    return metrics.evaluate(chain.machine, only(name, found), commands, starts, chain.seed)


def vary(
    chain: Chain, starts: Array, case: Case, name: str, net: ActuatorNet, found: Any
) -> metrics.Table:
    """Runs of one controller in a `Case`, also as it learns its valves."""
    machine = chain.machine
    net = select_nets(machine, net)
    return robustness(machine, only(name, found), net, case, starts, chain.seed)


def try_plants(chain: Chain, net: ActuatorNet) -> tuple[Any, preliminary.Gap, Any]:
    """The paper's tests of machine and nets, their difference in task space, and verdicts."""
    machine = chain.machine
    plants: dict[str, Plant] = {"machine": PLANT, "nets": select_nets(machine, net)}
    tests = {kind: preliminary.preliminary_tests(machine, of) for kind, of in plants.items()}
    gap = preliminary.sim_to_real(machine, plants, chain.seed)
    return tests, gap, claims.net_claims(tests["nets"], gap)


def summarise(
    chain: Chain, starts: Array, cases: Mapping[str, Case], done: Mapping[str, Any]
) -> tuple[dict[str, Any], report.Shown]:
    """What `results.json` has, and what the figures show. `done` is of `do_all`."""
    machine, budget, seed = chain.machine, chain.budget, chain.seed
    each = [done[f"runs of {name}"] for name in CONTROLLERS]
    runs = [run for table, _ in each for run in table]
    varied = {
        case: [run for name in CONTROLLERS for run in done[f"{name}, {case}"]] for case in cases
    }
    tests, gap, verdicts = done["tests"]
    along = metrics.means([run for run in runs if run["sequence"] in sequences.AXES])
    meta = metrics.metadata(machine, seed)
    meta |= baselines.gains_metadata(machine, select_nets(machine, done["net"]))
    meta |= {"effort": asdict(budget)}
    baselines.write_gains(chain.out / "gains.json", done["pids"], meta)
    files = [*POLICIES.values(), "gains.json"]
    results = {
        "meta": meta | {"files": {file: digest(chain.out / file) for file in files}},
        "table": {name: of["all"] for name, of in along.items()},
        "task_space": {"runs": runs, "means": metrics.means(runs)},
        "pairs": compare_pairs(runs),
        "claims": verdicts + claims.task_claims(runs),
        "trainings": trainings(budget, runs),
        "robustness": mean_errors(varied),
        "starts": starts.tolist(),
    }
    traces = {key: trace for _, of in each for key, trace in of.items()}
    return results, (tests, gap, traces)


def compare_pairs(runs: Sequence[metrics.Run]) -> list[dict[str, Any]]:
    """Of each of `PAIRS` that was scored the differences, motion by motion, see `compare`."""
    scored, rows = metrics.column(runs, "controller"), []
    for policy, pid in PAIRS:
        if policy in scored:
            figures = {key: metrics.compare(runs, policy, pid, key) for key in COMPARED}
            rows.append({"policy": policy, "pid": pid, "figures": figures})
    return rows


def trainings(budget: Budget, runs: Sequence[metrics.Run]) -> list[str]:
    """What a reader must know of learners that did not learn to the end: a line for each."""

    def error(name: str) -> float:
        return float(metrics.by_start(runs, name, "all", "velocity_error_mean").mean())

    lines = []
    for name in POLICIES:
        whole = recipe_of(name).learner.total_steps
        if steps := budget.train_steps:
            better = error(name) < error(baselines.BY_HAND)
            said = "better" if better else "needs more to be better"
            line = f"{title(name)}: after {steps:,} of {whole:,} steps {said} than the PID by hand"
            lines.append(line)
    return lines


def variations(machine: Machine) -> dict[str, Machine]:
    """Machines unknown to the controllers, by name; all numbers assumed."""
    own = hydraulics_of(machine)

    def plant_with(**changes: Any) -> Machine:
        return replace(machine, hydraulics=replace(own, **changes))

    return {
        "nominal": machine,
        "supply flow -70 %": plant_with(pump_flow=0.3 * own.pump_flow),
        "valve gain -20 %": plant_with(gain=(0.8, 0.8)),
        "valve gain +20 %": plant_with(gain=(1.2, 1.2)),
        "up -15 %, down +15 %": plant_with(gain=(0.85, 1.15)),
        "dead zone 5 %": baselines.with_dead_zones(machine, 0.05),
        "dead zone 10 %": baselines.with_dead_zones(machine, 0.10),
        "delay +50 ms": plant_with(delay=own.delay + 0.050),
    }


def unusual(machine: Machine, commands: Sequence[sequences.Commands]) -> dict[str, Case]:
    """All `variations`, faster goals and other noise. Paper: Sec. 4.2"""
    longest = max(len(one.goals) for one in commands) * machine.dt
    warm_up = adaptive.warm_up_motions(machine, min(adaptive.SECONDS, longest))
    usual = Case(machine, commands, TaskConfig.noise, warm_up)
    cases = {name: usual._replace(machine=one) for name, one in variations(machine).items()}
    faster = [one._replace(goals=1.5 * one.goals) for one in commands]
    cases["goals +50 %"] = usual._replace(commands=faster)
    cases["no sensor noise"] = usual._replace(noise=0.0)
    cases["twice the sensor noise"] = usual._replace(noise=2 * usual.noise)
    return cases


def robustness(
    machine: Machine,
    controllers: metrics.Controllers,
    net: ActuatorNet,
    case: Case,
    starts: Array,
    seed: int,
) -> metrics.Table:
    """Runs in a case, also cold and warm, where a controller learns by `beyond.adaptation`."""
    truth, commands, noise, warm_up = case
    rows = len(commands) * len(starts)
    learners = adaptive.cold_and_warm(controllers, net, machine, truth, rows, warm_up, noise=noise)
    every = {**controllers, **learners}
    return metrics.evaluate(truth, every, commands, starts, seed, noise=noise)[0]


def mean_errors(cases: Mapping[str, metrics.Table]) -> dict[str, dict[str, metrics.Mean]]:
    """Mean velocity error [m/s] with its interval, by variation and controller."""
    return {
        name: {c: of["all"]["velocity_error_mean"] for c, of in metrics.means(runs).items()}
        for name, runs in cases.items()
    }
