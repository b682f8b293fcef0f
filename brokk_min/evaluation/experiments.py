"""The paper's experiment as numbers: the comparison, the bound, robustness, the singular case.

`metrics.evaluate` runs every controller on the same starts and velocity sequences on the same machine.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from brokk_min import jacobian, kinematics
from brokk_min.evaluation import claims, metrics
from brokk_min.evaluation.baselines import GENERATIONS, PAPER_BASELINES, STRONGER, TUNING_RUNS
from brokk_min.evaluation.metrics import (
    Controllers,
    Rows,
    Traces,
    evaluate,
    intervals,
    paired_difference,
    paired_differences,
    row_mean,
    summary,
)
from brokk_min.evaluation.perfect_model import perfect_models
from brokk_min.evaluation.robustness import robustness
from brokk_min.evaluation.rollout import Trace
from brokk_min.evaluation.sequences import (
    Commands,
    axis_sequences,
    evaluation_starts,
    singular_sequences,
    start_kinds,
    task_sequences,
)
from brokk_min.identification import fitting, logs
from brokk_min.jacobian import JacobianController
from brokk_min.machine import Array, Machine


@dataclass(frozen=True)
class Effort:
    """How much is spent; the quick chain has the same parts, smaller."""

    hours: float = 1.0
    fit_steps: int = fitting.FitConfig.steps
    train_steps: int = 6_000_000  # `PPOConfig`'s, without importing torch
    generations: int = GENERATIONS
    tuning_runs: int = TUNING_RUNS
    starts: int = 64
    bound_starts: int = 16  # of them, for the regret
    short_s: float = 18.0  # of each axis sequence, for regret, robustness and the singular case [s]


QUICK = Effort(0.1, 700, 200_000, 4, 4, 8, 2, 3.0)


def shortened(machine: Machine, sequences: Sequence[Commands], seconds: float) -> list[Commands]:
    """The first seconds of each sequence."""
    return [s._replace(goals=s.goals[: round(seconds * machine.rate)]) for s in sequences]


def regret(
    machine: Machine, controllers: Controllers, short: Sequence[Commands], starts: Array, seed: int
) -> tuple[Rows, dict[str, Any], Traces]:
    """Runs of all controllers and bounds, each one's velocity error less the bound's, and the traces."""
    every = {**controllers, **perfect_models(machine, starts)}
    runs, traces = evaluate(machine, every, short, starts, seed)
    return (
        runs,
        {
            c: paired_difference(runs, c, "perfect_model", "velocity_error_mean")
            for c in controllers
        },
        traces,
    )


def comparison(
    machine: Machine, controllers: Controllers, effort: Effort, seed: int
) -> tuple[dict[str, Any], dict[str, Traces]]:
    """The paper's experiment and what we add to it: all of `results.json` on task space control.

    Means, intervals and verdicts are over the "workspace" starts, from which all sequences can be followed;
    the other kinds stand apart.

    Returns:
        For JSON; and traces of the main runs ("all"), with the bound ("bound") and near singularities
        ("singular").
    """
    sequences = task_sequences(machine)
    starts = evaluation_starts(machine, effort.starts, sequences, seed + 2)
    kinds = np.array(start_kinds(machine, starts))
    runs, traces = evaluate(machine, controllers, sequences, starts, seed)
    scored = [run for run in runs if run["kind"] == "workspace"]
    short = shortened(machine, axis_sequences(machine), effort.short_s)
    reachable = starts[kinds == "workspace"]
    bounded, less, bound = regret(
        machine, controllers, short, reachable[: effort.bound_starts], seed
    )
    singular, found = singular_case(
        machine, controllers, starts[kinds == "extended"], effort.short_s, seed
    )
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


def tables(runs: Sequence[metrics.Run], scored: Sequence[metrics.Run]) -> dict[str, Any]:
    """Runs, and figures of those that count: means, intervals, the policy's less the baselines'; for JSON."""
    kinds = dict.fromkeys(run["kind"] for run in runs)
    of_kind = {kind: [run for run in runs if run["kind"] == kind] for kind in kinds}
    return {
        "runs": runs,
        "summary": summary(scored),
        "intervals": intervals(scored),
        "by_kind": {
            k: {c: rows["all"] for c, rows in summary(of).items()} for k, of in of_kind.items()
        },
        "rl_less": paired_differences(scored, "rl"),
    }


def judged(
    machine: Machine,
    controllers: Controllers,
    runs: Sequence[metrics.Run],
    along_x: Mapping[str, Trace],
    goals: Array,
) -> list[dict[str, Any]]:
    """The paper's sentences on its baselines, each put to the stronger one, too: drift, direction, tracking.

    `runs` are those that count, `along_x` their traces along x with these `goals` [m/s] (T, 3).
    """
    pids = {name: pid for name, pid in controllers.items() if isinstance(pid, JacobianController)}
    of_paper, of_stronger = (
        [
            *claims.drift_claims(runs, names),
            claims.direction_claim(machine, pids[names[0]], along_x[names[0]], goals),
            *claims.tracking_claims(runs, names),
        ]
        for names in (PAPER_BASELINES, STRONGER)
    )
    return [claims.beside(*pair) for pair in zip(of_paper, of_stronger, strict=True)]


def singular_case(
    machine: Machine, controllers: Controllers, starts: Array, seconds: float, seed: int
) -> tuple[Traces, dict[str, Any]]:
    """k = 0.1 against 0.05 with the same gains, and RL, along the `singular_sequences` of extended starts.

    Paper: Fig. 6a, 6e, 6f

    Returns:
        Traces; and "summary", "claims", "w0" and of each start "manipulability" and "least" singular value
        of the Jacobian [m/rad]; empty where there are no such starts.
    """
    if not len(starts):
        return {}, {"summary": {}, "claims": []}
    some = claims.singular_controllers(controllers)
    sequences = shortened(machine, singular_sequences(machine, starts), seconds)
    runs, traces = evaluate(machine, some, sequences, starts, seed)
    w0, J, share = (
        jacobian.manipulability_threshold(machine),
        kinematics.jacobian(kinematics.forward_kinematics(machine, starts))[..., machine.driven],
        {},
    )
    for name in some:
        each = [(traces[name, s.name], s.for_starts(len(starts))) for s in sequences]
        share[name] = row_mean(
            np.array([claims.speed_share(machine, w0, *pair) for pair in each]).T
        )
    least = np.linalg.svd(J, compute_uv=False)[:, -1].tolist()
    near = {"w0": w0, "manipulability": jacobian.manipulability(J).tolist(), "least": least}
    return traces, {"summary": summary(runs), "claims": claims.singular_claims(runs, share)} | near


def driven_log(machine: Machine, traces: Traces, controller: str) -> logs.Log:
    """What encoders and valves said in one controller's first 16 runs of each sequence. Paper: Sec. 4.1"""
    tapes = []
    for sequence, trace in ((s, trace) for (c, s), trace in traces.items() if c == controller):
        for i in range(min(16, trace.q.shape[1])):
            u, q = trace.u[:, i].astype(float), trace.q_measured[:, i].astype(float)
            tapes.append((f"{controller}_{sequence}_{i:02d}", u, q))
    return logs.machine_log(machine, tapes)
