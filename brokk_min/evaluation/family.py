"""The whole method on machines with physics of their own, drawn by seeds, and transfers among them.

A member's controllers are made from its own logs, as a user's would be: an hour of all joints at
once, nets that share latents, policies; an hour of the policies' own drives, nets fitted to both
logs, the policies trained on; this once more; baselines tuned on the member itself. `family.json`
has:

    members[]: seed, budget, effects, dither (of `Machine`), free_run {joint: error over rms speed
    in 10 s}, tool: errors of the tool in free runs, error {controller: m/s on the machine}; for
    each of our policies on_nets: its error on its nets [m/s], loaded: with an unknown load at the
    tool [m/s], best: the best baseline of its class of valves at rest
    table: what `show` prints, {"member, policy": {column: number}}
    transfers[i][j]: error [m/s] of the policy "rl" of member i on member j
    summary: {policy: median and largest of its `ratios` over the members}
"""

from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from brokk_min.env import TaskConfig
from brokk_min.evaluation import baselines, learn, metrics, sequences
from brokk_min.evaluation.learn import Budget, Chain
from brokk_min.evaluation.metrics import Controllers
from brokk_min.evaluation.rollout import Controller, rollout
from brokk_min.identification import logs, validation
from brokk_min.identification.excitation import collect, task_log
from brokk_min.identification.files import expect_same, read_json, write_json
from brokk_min.identification.formats import FAMILY_MEMBER, check_fields
from brokk_min.identification.inspection import with_dead_zones
from brokk_min.identification.net_file import select_nets
from brokk_min.identification.physics import draw_machine
from brokk_min.learning.policy import (
    POLICIES,
    Policy,
    PolicyController,
    load_policy,
    policy_controllers,
)
from brokk_min.machine import Machine

LATENTS = 4  # that the nets share
VALVES = {"rl": "closed", "rl_dither": "dither"}  # our policy, and its valves at rest
SECOND = 50  # added to the seed of the goals of the second policy's own drives
RAMPS = 0.02  # h of each joint, for its dead zones
DITHERS = (0.03, 0.04, 0.05, 0.06, 0.07)  # that each member tries
PAYLOAD = 50.0  # kg at the tool that no log has, assumed: half of a link
# Small enough for 15 minutes a member on two cores.
FAMILY = Budget(fit_steps=12_000, starts=16)
QUICK = replace(learn.QUICK, first_train_steps=10_000, train_steps=20_000, fit_steps=400)
QUICK = replace(QUICK, first_fit_steps=200, generations=2, tuning_runs=3)


def run_family(base: Machine, seeds: Sequence[int], out: Path, budget: Budget) -> dict[str, Any]:
    """Run the chain on each member, then transfers; results, also in `out`/family.json.

    A member whose results lie in `out` is not run again. ValueError: results of another budget.
    """
    rows = [run_member(base, seed, out / f"member_{seed}", budget) for seed in seeds]
    results = {
        "meta": {"machine": base.name, "budget": asdict(budget)},
        "members": rows,
        "table": table(rows),
        "transfers": transfers(base, seeds, out, budget),
        "summary": summary(rows),
    }
    write_json(out / "family.json", results)
    return results


def run_member(base: Machine, seed: int, out: Path, budget: Budget) -> dict[str, Any]:
    """Collect, fit, train, tune and evaluate on one member; files and `member.json` in `out`."""
    file, made_by = out / "member.json", asdict(budget)
    if file.exists():
        row: dict[str, Any] = read_json(file, "results of `family`")
        check_fields(file, row, FAMILY_MEMBER, {})
        expect_same(file, row, {"budget": made_by})
        return row
    machine = known_machine(base, seed)
    chain = Chain(machine, out, budget, seed)
    log = collect(machine, budget.hours, "joint", np.random.default_rng(seed))
    test = task_log(machine, 20, 40.0, np.random.default_rng(seed + 1))
    out.mkdir(parents=True, exist_ok=True)
    logs.write_log(out / "log.npz", log)
    shared = {"shared": LATENTS}
    both, begun = learn.first_round(chain, log, shared)
    machine = replace(machine, dither=best_dither(chain, begun))
    chain = replace(chain, machine=machine)
    second = replace(chain, out=out / "second")
    both, begun = learn.next_round(second, both, shared, begun, seed + SECOND)
    every = learn.fit_net(chain, "net", both, shared)
    net = select_nets(machine, every)
    jobs = {"train": partial(learn.train, chain, "rl", net, begun)}
    jobs["tune"] = partial(learn.tune, chain, net)
    trained, (pids, _) = learn.side_by_side(jobs, {})
    baselines.write_gains(out / "gains.json", pids, baselines.gains_metadata(machine, net))
    policies = policy_controllers(machine, {"rl": trained})
    errors = mean_errors(base, machine, {**policies, **pids}, budget)
    loaded = replace(machine, plant=replace(machine.plant, payload=PAYLOAD))
    scores = validation.score(every, test)
    driven = [base.names[i] for i in base.driven]
    row = {
        "seed": seed,
        "budget": made_by,
        "effects": {**asdict(machine.plant), "pump": machine.pump_flow / base.pump_flow},
        "dither": machine.dither,
        "free_run": {name: scores[name]["free_run"]["10"]["relative_error"] for name in driven},
        "tool": validation.tool_errors(machine, every, test),
        "error": errors,
        "on_nets": mean_errors(base, machine, {**policies}, budget, net),
        "loaded": mean_errors(base, loaded, {**policies}, budget),
        "best": {
            name: min((p for p in pids if pids[p].valves == valves), key=errors.__getitem__)
            for name, valves in VALVES.items()
        },
    }
    write_json(file, row)
    return row


@lru_cache
def known_machine(base: Machine, seed: int) -> Machine:
    """A drawn machine as its user knows it: dead zones by joint from slow ramps of each."""
    machine = draw_machine(base, seed)
    log = collect(machine, RAMPS, "ramp", np.random.default_rng(seed))
    ramps = tuple(one for one in log.recordings if not one.name.endswith(logs.RETURN))
    return with_dead_zones(machine, log._replace(recordings=ramps))


def best_dither(chain: Chain, policy: Policy) -> float:
    """Of `DITHERS` the one with least error, on goals that are never scored.

    It is the mean error of the policy and of the strongest PID with gains by hand.
    """
    machine = chain.machine
    start, goals = learn.tuning_set(chain)
    errors = []
    for dither in DITHERS:
        own = replace(machine, dither=dither)
        pid = baselines.baselines(own, policy.net)["jacobian_pid_ff_integral_dither"]
        for controller in (PolicyController(own, replace(policy, valves="dither")), pid):
            rng = np.random.default_rng(chain.seed)
            trace = rollout(machine, controller, start, goals, TaskConfig(), rng)
            errors.append(np.linalg.norm(goals - trace.v_tool, axis=-1).mean())
    return DITHERS[int(np.argmin(np.reshape(errors, (-1, 2)).mean(axis=1)))]


def mean_errors(
    base: Machine, machine: Machine, controllers: Controllers, budget: Budget, net: Any = None
) -> dict[str, float]:
    """Mean |v_goal - v_tool| [m/s] of controllers on a member (or nets) over the base's starts."""
    starts = sequences.workspace_starts(base, budget.starts)
    short = sequences.shorten(machine, sequences.task_sequences(base), budget.short_s)
    runs, _ = metrics.evaluate(machine, controllers, short, starts, 0, net)
    rows = {c: [run for run in runs if run["controller"] == c] for c in controllers}
    return {c: float(np.mean([row["velocity_error_mean"] for row in rows[c]])) for c in rows}


def transfers(base: Machine, seeds: Sequence[int], out: Path, budget: Budget) -> list[list[float]]:
    """Errors [m/s] of the policy of each member (rows) on each member (columns)."""
    controllers: dict[str, Controller] = {}
    for seed in seeds:
        own = known_machine(base, seed)
        policy = load_policy(out / f"member_{seed}" / POLICIES["rl"], own)
        controllers[str(seed)] = PolicyController(own, policy)
    columns = [mean_errors(base, known_machine(base, s), controllers, budget) for s in seeds]
    return [[column[str(seed)] for column in columns] for seed in seeds]


def ratios(row: dict[str, Any], policy: str) -> dict[str, float]:
    """What a member is judged by: a policy's error over others, and the nets' largest error."""
    error = row["error"][policy]
    return {
        "to_nets": error / row["on_nets"][policy],
        "to_best": error / row["error"][row["best"][policy]],
        "payload": row["loaded"][policy] / error,
        "free_run": max(row["free_run"].values()),
    }


def summary(rows: Sequence[dict[str, Any]]) -> dict[str, dict[str, dict[str, float]]]:
    """Median and largest of the `ratios` over the members, of each policy."""
    result: dict[str, dict[str, dict[str, float]]] = {}
    for policy in VALVES:
        result[policy] = {}
        for key in ratios(rows[0], policy):
            values = [ratios(row, policy)[key] for row in rows]
            result[policy][key] = {"median": float(np.median(values)), "worst": max(values)}
    return result


def table(rows: Sequence[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Errors and `ratios` of each member and policy."""
    result = {}
    for row in rows:
        for policy, best in row["best"].items():
            result[f"{row['seed']}, {policy}"] = {
                "error [m/s]": row["error"][policy],
                "on its nets": row["on_nets"][policy],
                "best PID": row["error"][best],
                **ratios(row, policy),
            }
    return result


def show(results: dict[str, Any]) -> str:
    """The table of the members, and the transfers."""
    line = "{:12}" + 7 * "{:>13}"
    rows = results["table"]
    lines = [line.format("member", *next(iter(rows.values())))]
    for name, row in rows.items():
        lines.append(line.format(name, *(f"{x:.4f}" for x in row.values())))
    for policy, of in results["summary"].items():
        for name, value in of.items():
            numbers = f"median {value['median']:.2f}, worst {value['worst']:.2f}"
            lines.append(f"{policy} {name}: {numbers}")
    lines.append("error [m/s] of the policy rl of a member (row) on a member (column):")
    lines += ["  ".join(f"{x:.4f}" for x in errors) for errors in results["transfers"]]
    return "\n".join(lines)
