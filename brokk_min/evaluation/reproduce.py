"""The whole chain: logs, nets, policies, tuned baselines, comparison, report."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from brokk_min._files import digest, write_csv, write_json
from brokk_min.actuator import PLANT, ActuatorNet, Plant, hydraulics_of
from brokk_min.beyond.net_ensemble import together
from brokk_min.beyond.rich_excitation import RICH
from brokk_min.evaluation import adaptive, baselines, metrics, preliminary, report, sequences
from brokk_min.evaluation.claims import net_claims, task_claims
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

# beyond the chain's: sixth in error of the seeds 0 to 9 of `sweep`, of `rl_critic` third of 0 to 3
SEEDS = {"rl": 8, "rl_paper": 9, "rl_critic": 3}
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
    moves = task_starts(chain)  # before hours of work: there may be none
    _, runs, seconds = budget.tuning
    sequences.tuning_set(machine, runs, seed, seconds)
    done = learn(chain, record_log(chain, RICH, "log"), record_log(chain, SINE, "log_paper"))
    results, measured = measure_all(chain, done, *moves)
    write_json(out / "results.json", results)
    keys = ("meta", "table", "pairs", "claims")
    write_json(out / "table.json", {key: results[key] for key in keys})
    report.write_report(out, machine, results, measured)
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


def learn(chain: Chain, log: Log, paper_log: Log) -> dict[str, Any]:
    """All fits, trainings and tunings, side by side; nets, policies and PIDs by their names."""
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
        "pids": partial(tune, effort=chain.budget.tuning, seed=chain.seed),
        "rl": partial(train_one, chain, "rl"),
    }
    needs = {name: ["net"] for name in (*POLICIES, "pids")}
    needs |= {"net": [*members], "rl_critic": ["net_paper"]}
    return side_by_side(jobs, needs)


def task_starts(chain: Chain) -> tuple[list[sequences.Commands], Array]:
    """The scored motions, and the poses [rad] (starts, n) in which they start."""
    machine, commands = chain.machine, sequences.task_sequences(chain.machine)
    starts = sequences.draw_starts(machine, chain.budget.starts, commands, chain.seed + 2)
    write_csv(chain.out / "starts.csv", machine.names, starts.tolist())
    return commands, starts


def measure_all(
    chain: Chain, done: Mapping[str, Any], commands: list[sequences.Commands], starts: Array
) -> tuple[dict[str, Any], report.Shown]:
    """All measurements for `results.json`, and what the figures show. `done` is of `learn`."""
    machine, budget, seed = chain.machine, chain.budget, chain.seed
    net = select_nets(machine, done["net"])
    controllers = {name: done[name] for name in POLICIES} | done["pids"]
    ticks = round(budget.short_s * machine.rate)
    short = [axis._replace(goals=axis.goals[:ticks]) for axis in commands[:3]]
    plants: dict[str, Plant] = {"machine": PLANT, "nets": net}
    varied = robustness(machine, controllers, net, short, starts[:16], seed)
    drive = partial(metrics.evaluate, machine, controllers, commands, starts, seed)
    driven = side_by_side({"runs": drive, **varied})
    runs, traces = driven["runs"]
    tests = {kind: preliminary.preliminary_tests(machine, of) for kind, of in plants.items()}
    gap = preliminary.sim_to_real(machine, plants, seed)
    along = metrics.means([run for run in runs if run["sequence"] in sequences.AXES])
    meta = metrics.metadata(machine, seed) | baselines.gains_metadata(machine, net)
    meta |= {"effort": asdict(budget)}
    baselines.write_gains(chain.out / "gains.json", done["pids"], meta)
    files = [*POLICIES.values(), "gains.json"]
    results = {
        "meta": meta | {"files": {file: digest(chain.out / file) for file in files}},
        "table": {name: of["all"] for name, of in along.items()},
        "task_space": {"runs": runs, "means": metrics.means(runs)},
        "pairs": compare_pairs(runs),
        "claims": net_claims(tests["nets"], gap) + task_claims(runs),
        "trainings": trainings(budget, runs),
        "robustness": mean_errors({case: driven[case] for case in varied}),
        "starts": starts.tolist(),
    }
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


def robustness(
    machine: Machine,
    controllers: metrics.Controllers,
    net: ActuatorNet,
    commands: Sequence[sequences.Commands],
    starts: Array,
    seed: int,
) -> dict[str, Callable[[], metrics.Table]]:
    """Calls that drive each of the `variations`, faster goals, other noise. Paper: Sec. 4.2

    Each controller is also there cold and warm, as it learns its valves by `beyond.adaptation`.
    """
    usual = TaskConfig.noise
    cases = {name: (varied, commands, usual) for name, varied in variations(machine).items()}
    faster = [one._replace(goals=1.5 * one.goals) for one in commands]
    cases["goals +50 %"] = machine, faster, usual
    cases["no sensor noise"] = machine, commands, 0.0
    cases["twice the sensor noise"] = machine, commands, 2 * usual
    rows, longest = len(commands) * len(starts), max(len(one.goals) for one in commands)
    motions = adaptive.warm_up_motions(machine, min(adaptive.SECONDS, longest * machine.dt))

    def score(varied: Machine, moves: Sequence[sequences.Commands], noise: float) -> metrics.Table:
        learners = adaptive.cold_and_warm(
            controllers, net, machine, varied, rows, motions, noise=noise
        )
        every = {**controllers, **learners}
        return metrics.evaluate(varied, every, moves, starts, seed, noise=noise)[0]

    return {name: partial(score, *case) for name, case in cases.items()}


def mean_errors(cases: Mapping[str, metrics.Table]) -> dict[str, dict[str, metrics.Mean]]:
    """Mean velocity error [m/s] with its interval, by variation and controller."""
    return {
        name: {c: of["all"]["velocity_error_mean"] for c, of in metrics.means(runs).items()}
        for name, runs in cases.items()
    }
