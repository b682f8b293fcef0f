"""The paper's experiment as numbers: baselines and their tuning, the comparison, the bound, robustness.

`task_space` runs every controller on the same starts and velocity sequences on the same machine.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from brokk_min import __version__, actuator, claims, fitting, jacobian, kinematics, logs
from brokk_min.env import Controller, TaskConfig, Trace, rollout
from brokk_min.figures import Traces
from brokk_min.jacobian import JacobianController
from brokk_min.machine import Machine
from brokk_min.metrics import (
    Run,
    by_start,
    intervals,
    mean_interval,
    metrics,
    paired,
    paired_with_others,
    row_mean,
    summary,
)
from brokk_min.mpc import PerfectModel
from brokk_min.sequences import (
    Commands,
    axis_sequences,
    least_motion,
    scored_starts,
    start_kinds,
    task_sequences,
    tuning_goals,
)
from brokk_min.variations import Sensor, exact, supply_demand, variations

Array = NDArray[np.floating[Any]]
Net = actuator.ActuatorNet
PAPERS = ("jacobian_pid_k0.1", "jacobian_pid_k0.05")  # the paper's two baselines
STRONGER = ("jacobian_pid_ff",)  # than the paper's: its sentences are put to it, too
AWAKE = "jacobian_pid_ff_awake"  # the same, its valves never closed: what the policy learns to do

# --- controllers ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Effort:
    """How much is spent; the quick chain has the same parts, smaller."""

    hours: float = 1.0
    fit_steps: int = fitting.FitConfig.steps
    train_steps: int = 6_000_000  # `PPOConfig`'s, without importing torch
    generations: int = 45
    tuning_runs: int = 12
    starts: int = 64
    bound_starts: int = 16  # of them, for the regret
    short_s: float = 18.0  # of each axis sequence, for regret, robustness and the singular case [s]


QUICK = Effort(0.1, 700, 200_000, 4, 4, 8, 2, 3.0)


def baselines(machine: Machine, net: Net) -> dict[str, JacobianController]:
    """The paper's two baselines and two with feed-forward, with gains set by hand. Paper: Sec. 4.2

    The last keeps its valves barely open even while the tool is to stand still.
    """
    w0 = jacobian.manipulability_threshold(machine)
    pid = jacobian.join_gains(machine, {"kp": 1.0, "ki": 8.0, "kd": 0.05, "feedback": 0.4, "ready": 0.015})
    mild = jacobian.join_gains(machine, {"kp": 0.2, "ki": 0.5, "kd": 0.02, "feedback": 0.1, "ready": 0.015})
    steady = jacobian.steady_map(machine, net)
    return {
        "jacobian_pid_k0.1": JacobianController(machine, pid, 0.1, w0),
        "jacobian_pid_k0.05": JacobianController(machine, pid, 0.05, w0),
        "jacobian_pid_ff": JacobianController(machine, mild, 0.1, w0, steady),
        AWAKE: JacobianController(machine, mild, 0.1, w0, steady, awake=True),
    }


def tuning_set(effort: Effort, seed: int) -> tuple[int, float, int]:
    """Number, length [s] and seed of the runs that the baselines are tuned on: apart from all that scores."""
    return effort.tuning_runs, 12.0, seed + 1000


def tuned_baselines(
    machine: Machine, net: Net, effort: Effort, seed: int
) -> tuple[dict[str, JacobianController], dict[str, dict[str, Any]]]:
    """The baselines, each tuned on the machine itself, and how their tuning went, for JSON.

    The cost is the figure that is scored, mean |v_goal - v_tool|, on `tuning_goals`. Tuning on the
    machine favours the baselines: the policy never sees it. The least of many noisy costs flatters, so
    "cost_anew" is the mean of 16 more of the gains that were found.
    """
    start, goals = tuning_goals(machine, *tuning_set(effort, seed))

    def cost(controller: JacobianController) -> Array:
        candidates, runs = len(controller.gains), len(start)
        batch = replace(controller, gains=np.repeat(controller.gains, runs, axis=0))
        wanted, rng = np.tile(goals, (1, candidates, 1)), np.random.default_rng(seed)
        trace = rollout(machine, batch, np.tile(start, (candidates, 1)), wanted, TaskConfig(), rng)
        error = np.linalg.norm(wanted - trace.v_tool, axis=-1)
        return np.asarray(error.mean(0).reshape(candidates, runs).mean(1))

    tuned, how = {}, {}
    for name, controller in baselines(machine, net).items():
        tuned[name], costs = jacobian.tune(controller, cost, seed, effort.generations, name)
        anew = float(cost(replace(tuned[name], gains=np.tile(tuned[name].gains, (16, 1)))).mean())
        at_bound = jacobian.gains_at_bound(tuned[name])
        how[name] = {"seed": seed, "cost": costs, "cost_anew": anew, "at_bound": at_bound}
    return tuned, how


def plain_gains(controllers: Mapping[str, JacobianController]) -> dict[str, dict[str, list[float]]]:
    """Gains of each baseline by name, for JSON."""
    named = {name: jacobian.split_gains(c.gains) for name, c in controllers.items()}
    return {name: {key: gain.tolist() for key, gain in gains.items()} for name, gains in named.items()}


def write_gains(path: Path, controllers: Mapping[str, JacobianController], about: Mapping[str, Any]) -> None:
    """Write the baselines' gains as `read_gains` reads them; `about` is the `meta` of their tuning."""
    write_json(path, {"meta": about, "gains": plain_gains(controllers)})


def read_gains(path: Path, machine: Machine, net: Net) -> dict[str, JacobianController]:
    """The baselines with gains that `reproduce` wrote.

    Raises:
        ValueError: no such file, or gains of other controllers or joints, tuned for another machine or with
            other nets, whose feed-forward is another.
    """
    result, wanted = baselines(machine, net), tuned_for(machine, net)
    try:
        table = json.loads(path.read_text())
        found = {name: table["meta"].get(name) for name in wanted}
        if found != wanted:
            raise ValueError(f"gains for {found}")
        for name, controller in result.items():
            result[name] = replace(controller, gains=jacobian.join_gains(machine, table["gains"][name]))
    except (AttributeError, OSError, KeyError, TypeError, ValueError) as error:
        nets = f"{machine.name} with nets {wanted['actuator']}"
        raise ValueError(f"{path}: expected gains for {nets}, got {error!r}") from error
    return result


def tuned_for(machine: Machine, net: Net) -> dict[str, str]:
    """What gains and sweeps belong to: the machine's name and the fingerprint of its driven joints' nets."""
    return {"machine": machine.name, "actuator": actuator.fingerprint(net)}


def read_seeds(path: Path) -> dict[str, Any]:
    """The `sweep.json` of a sweep, its "table" that of `sweep.table`; ValueError: it is none."""
    try:
        found: dict[str, Any] = json.loads(path.read_text())
        if not {"mean", "low", "high"} <= set(found["table"]["rl"]["velocity_error_all"]):
            raise ValueError(f"{found['table']['rl']}")
        dict(found["meta"])
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: expected the sweep.json of a sweep, got {error!r}") from error
    return found


def seeds_of(machine: Machine, net: Net, sweep: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """The table of a sweep that `read_seeds` read; ValueError: one of another machine or with other nets."""
    wanted = tuned_for(machine, net)
    found = {name: sweep["meta"].get(name) for name in wanted}
    if found != wanted:
        raise ValueError(f"sweep: expected one with {wanted}, got {found}")
    return dict(sweep["table"])


# --- the comparison -----------------------------------------------------------------------------------


def task_space(
    machine: Machine,
    controllers: Mapping[str, Controller],
    sequences: Sequence[Commands],
    starts: Array,
    seed: int,
    net: Net | None = None,
    sensor: Sensor = exact,
) -> tuple[list[dict[str, Any]], Traces]:
    """Every controller on the same sequences, starts and noise. Paper: Sec. 4.2, Fig. 6

    Sequences of one length and all starts are one batch.

    Returns:
        One row a controller, sequence and start, see `metrics`; and the traces.
    """
    rows: list[dict[str, Any]] = []
    traces: dict[tuple[str, str], Trace] = {}
    num = len(starts)
    kinds = start_kinds(machine, starts)
    lengths = dict.fromkeys(len(sequence.goals) for sequence in sequences)
    groups = [[s for s in sequences if len(s.goals) == length] for length in lengths]
    for name, group in tqdm(list(product(controllers, groups)), desc="evaluate", unit="batch", disable=None):
        goals = np.concatenate([s.of_each(num) for s in group], axis=1)
        start, rng = np.tile(starts, (len(group), 1)), np.random.default_rng(seed)
        read = sensor(np.random.default_rng(seed + 1))
        trace = rollout(machine, controllers[name], start, goals, TaskConfig(), rng, net, read)
        found = metrics(machine, trace, goals, kinematics.tool_position(machine, start))
        for i, s in enumerate(group):
            mine, label = slice(i * num, (i + 1) * num), {"controller": name, "sequence": s.name}
            traces[name, s.name] = Trace(*(a[:, mine] for a in trace))
            rows += _rows(label, kinds, {key: v[mine] for key, v in found.items()})
    names, order = list(controllers), [s.name for s in sequences]
    rows.sort(key=lambda row: (names.index(row["controller"]), order.index(row["sequence"])))
    return rows, traces


def _rows(label: Mapping[str, Any], kinds: Sequence[str], found: Mapping[str, Array]) -> list[dict[str, Any]]:
    """One row a start of figures (starts,); None where there is none."""
    plain = {key: [float(v) if np.isfinite(v) else None for v in values] for key, values in found.items()}
    rows = ({key: values[j] for key, values in plain.items()} for j in range(len(kinds)))
    return [{**label, "start": j, "kind": kinds[j]} | row for j, row in enumerate(rows)]


def robustness(
    machine: Machine,
    controllers: Mapping[str, Controller],
    sequences: Sequence[Commands],
    starts: Array,
    seed: int,
) -> dict[str, dict[str, dict[str, Any]]]:
    """Mean velocity error [m/s], 95 % interval over starts, by variation and controller. Paper: Sec. 4.2

    And "supply_demand", the largest share of the pump's flow that was asked for, "supply_limits", the share
    of ticks at which it was more than all, and of baselines "rl_less", the policy's error less theirs on the
    same starts.
    """
    result: dict[str, dict[str, dict[str, Any]]] = {}
    for name, (plant, sensor) in variations(machine).items():
        runs, traces = task_space(plant, controllers, sequences, starts, seed, sensor=sensor)
        result[name] = {}
        for c in controllers:
            asked = np.array([supply_demand(plant, traces[c, s.name].u) for s in sequences])
            errors = by_start(runs, c, "all", "velocity_error_mean")
            result[name][c] = {**mean_interval(errors), "supply_demand": float(asked.max())}
            result[name][c]["supply_limits"] = float((asked > 1).mean())
            if "rl" in controllers and c != "rl":
                result[name][c]["rl_less"] = paired(runs, "rl", c, "velocity_error_mean")["all"]
    return result


def shortened(machine: Machine, sequences: Sequence[Commands], seconds: float) -> list[Commands]:
    """The first seconds of each sequence."""
    return [s._replace(goals=s.goals[: round(seconds * machine.rate)]) for s in sequences]


def bounds(machine: Machine, starts: Array) -> dict[str, Controller]:
    """The bound, and the same without its trick: valves that it keeps awake by moving them at rest too."""
    still = PerfectModel(machine, starts, dither=0.0)
    return {"perfect_model": PerfectModel(machine, starts), "perfect_model_no_dither": still}


def regret(
    machine: Machine,
    controllers: Mapping[str, Controller],
    short: Sequence[Commands],
    starts: Array,
    seed: int,
) -> tuple[list[dict[str, Any]], dict[str, Any], Traces]:
    """Runs of all controllers and bounds, each one's velocity error less the bound's, and the traces."""
    every = {**controllers, **bounds(machine, starts)}
    runs, traces = task_space(machine, every, short, starts, seed)
    return runs, {c: paired(runs, c, "perfect_model", "velocity_error_mean") for c in controllers}, traces


def comparison(
    machine: Machine, controllers: Mapping[str, Controller], effort: Effort, seed: int
) -> tuple[dict[str, Any], dict[str, Traces]]:
    """The paper's experiment and what we add to it: all of `results.json` on task space control.

    Means, intervals and verdicts are over the "workspace" starts, from which all sequences can be followed;
    the other kinds stand apart.

    Returns:
        For JSON; and traces of the main runs ("all"), with the bound ("bound") and near singularities
        ("singular").
    """
    sequences = task_sequences(machine)
    starts = scored_starts(machine, effort.starts, sequences, seed + 2)
    kinds = np.array(start_kinds(machine, starts))
    runs, traces = task_space(machine, controllers, sequences, starts, seed)
    scored = [run for run in runs if run["kind"] == "workspace"]
    short = shortened(machine, axis_sequences(machine), effort.short_s)
    reachable = starts[kinds == "workspace"]
    bounded, less, bound = regret(machine, controllers, short, reachable[: effort.bound_starts], seed)
    singular, found = singular_case(machine, controllers, starts[kinds == "extended"], effort.short_s, seed)
    across = {c: Trace(*(a[:, kinds == "workspace"] for a in traces[c, "x"])) for c in controllers}
    verdicts = judged(machine, controllers, scored, across, sequences[0].goals)
    verdicts[3:3] = found["claims"]  # the paper's order
    return {
        "task_space": tables(runs, scored),
        "regret": {"summary": summary(bounded), "less_perfect_model": less},
        "robustness": robustness(machine, controllers, short, reachable[:16], seed),
        "singular": found,
        "claims": verdicts,
        "starts": starts.tolist(),
        "start_kinds": kinds.tolist(),
    }, {"all": traces, "bound": bound, "singular": singular}


def tables(runs: Sequence[Run], scored: Sequence[Run]) -> dict[str, Any]:
    """Runs, and figures of those that count: means, intervals, the policy's less the baselines'; for JSON."""
    of_kind = {
        kind: [run for run in runs if run["kind"] == kind] for kind in dict.fromkeys(r["kind"] for r in runs)
    }
    return {
        "runs": runs,
        "summary": summary(scored),
        "intervals": intervals(scored),
        "by_kind": {k: {c: rows["all"] for c, rows in summary(of).items()} for k, of in of_kind.items()},
        "rl_less": paired_with_others(scored, "rl"),
    }


def judged(
    machine: Machine,
    controllers: Mapping[str, Controller],
    runs: Sequence[Run],
    along_x: Mapping[str, Trace],
    goals: Array,
) -> list[dict[str, Any]]:
    """The paper's sentences on its baselines, each put to the stronger one, too: drift, direction, tracking.

    Args:
        machine: n joints.
        controllers: by name.
        runs: those that count.
        along_x: their traces along x by controller.
        goals: of these [m/s], (T, 3).
    """
    pids = {name: pid for name, pid in controllers.items() if isinstance(pid, JacobianController)}
    of_paper, of_stronger = (
        [
            *claims.drift_claims(runs, names),
            claims.direction_claim(machine, pids[names[0]], along_x[names[0]], goals),
            *claims.tracking_claims(runs, names),
        ]
        for names in (PAPERS, STRONGER)
    )
    return [claims.beside(*pair) for pair in zip(of_paper, of_stronger, strict=True)]


def singular_case(
    machine: Machine, controllers: Mapping[str, Controller], starts: Array, seconds: float, seed: int
) -> tuple[Traces, dict[str, Any]]:
    """k = 0.1 against 0.05 with the same gains, and RL, along the `least_motion` of extended starts.

    Paper: Fig. 6a, 6e, 6f

    Returns:
        Traces; and "summary", "claims", "w0" and of each start "manipulability" and "least" singular value
        of the Jacobian [m/rad]; empty where there are no such starts.
    """
    if not len(starts):
        return {}, {"summary": {}, "claims": []}
    some = claims.singular_controllers(controllers)
    sequences = shortened(machine, least_motion(machine, starts), seconds)
    runs, traces = task_space(machine, some, sequences, starts, seed)
    w0, J, share = jacobian.manipulability_threshold(machine), kinematics.jacobian(machine, starts), {}
    for name in some:
        each = [(traces[name, s.name], s.of_each(len(starts))) for s in sequences]
        share[name] = row_mean(np.array([claims.speed_share(machine, w0, *pair) for pair in each]).T)
    least = np.linalg.svd(J, compute_uv=False)[:, -1].tolist()
    near = {"w0": w0, "manipulability": jacobian.manipulability(J).tolist(), "least": least}
    return traces, {"summary": summary(runs), "claims": claims.singular_claims(runs, share)} | near


def driven_log(machine: Machine, traces: Traces, controller: str) -> logs.Log:
    """What encoders and valves said in one controller's first 16 runs of each sequence. Paper: Sec. 4.1"""
    recordings = []
    for (name, sequence), trace in traces.items():
        for i in range(min(16, trace.q.shape[1]) * (name == controller)):
            u, q = trace.u[:, i].astype(float), trace.q_measured[:, i].astype(float)
            velocity = logs.velocity_of(q, machine.velocity_samples, machine.rate)
            recordings.append(logs.Recording(f"{name}_{sequence}_{i:02d}", u, q, velocity))
    return logs.Log(machine.names, tuple(recordings), rate=machine.rate)


def write_json(path: Path, value: Any) -> None:
    """Write JSON whole, floats as they are."""
    with logs.whole_file(path, "w") as file:
        json.dump(value, file, indent=1, allow_nan=False)
        file.write("\n")


def meta(machine: Machine, seed: int) -> dict[str, Any]:
    """What every JSON of ours says of itself."""
    return {"brokk_min": __version__, "machine": machine.name, "seed": seed, "units": "m, m/s, s, rad"}
