"""The report in the paper's order: nets and training, then task space control with its verdicts.

Paper: Sec. 4.2
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brokk_min import figures, preliminary
from brokk_min.actuator import ActuatorNet
from brokk_min.figures import Traces
from brokk_min.logs import Log
from brokk_min.machine import Machine
from brokk_min.sequences import axis_sequences, task_sequences

Array = NDArray[np.floating[Any]]
VERDICTS = {True: "holds here", False: "does not hold here", None: "was not measured"}
RECIPES = (
    "What the nets cost on the machine when they are fitted as in the paper: errors of free runs of 10 s on "
    "these recordings [rad/s]; mean distance of the tools in 30 s, median and worst run of Fig. 5 [m]."
)
Part = tuple[Any, ...]  # title, sentence, contents: see `figures.write_report`


def verdict(claim: Mapping[str, Any]) -> str:
    """The paper's sentence, what was measured, and whether it holds."""
    return f"Paper: {claim['paper']} Measured: {claim['measured']}. This {VERDICTS[claim['holds']]}."


def net_parts(
    machine: Machine, net: ActuatorNet, test: Log, results: Mapping[str, Any], seed: int, curve: Path
) -> list[Part]:
    """Parts on the nets and the training: errors, the paper's preliminary and sim-to-real figures, curve."""
    errors = {}
    for joint, s in results["actuator"]["test"].items():
        errors[joint] = {key: s[key] for key in ("one_step_rmse", "persistence_rmse")}
        errors[joint] |= s["free_run"].get("10", {})
    tests, gap = preliminary.plots(machine, net, seed).values()
    tool = results["preliminary"]["sim_to_real"]["tool"]
    apart = f"Over 30 s: {tool['position_error_mean']:.3f} m, {tool['velocity_rmse']:.3f} m/s (RMS)."
    return [
        ("Actuator nets", "One step and free runs of 10 s on unseen recordings [rad/s, rad].", errors),
        ("Two recipes", RECIPES, _recipes(results)),
        ("Nets run freely", "One of these recordings.", figures.plot_free_run(net, test)),
        ("Preliminary tests (Fig. 2)", "The machine above, the nets below.", tests),
        ("Sim-to-real gap (Fig. 5)", f"Nets less machine under the same commands. {apart}", gap),
        ("Learning curve", "The exploring policy, on the nets.", figures.plot_learning(curve)),
    ]


def _recipes(results: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Errors of nets by our recipe and by the paper's: free runs by joint, and the tool's after 30 s."""
    ours = {"test": results["actuator"]["test"], "sim_to_real": results["preliminary"]["sim_to_real"]}
    recipes = {"rich, free runs (ours)": ours, "sines, one step (paper)": results["paper_recipe"]}
    rows: dict[str, dict[str, Any]] = {}
    for name, recipe in recipes.items():
        row = {joint: s["free_run"].get("10", {}).get("velocity_rmse") for joint, s in recipe["test"].items()}
        gaps = recipe["sim_to_real"]["tool_position_error_mean_of_runs"]
        rows[name] = row | {f"tool, {kind}": gaps[kind] for kind in ("median", "max")}
    return rows


def task_parts(
    machine: Machine, results: Mapping[str, Any], traces: Mapping[str, Traces], tuning: tuple[Array, Array]
) -> list[Part]:
    """Parts of the report.

    Args:
        machine: n joints.
        results: of `experiments.reproduce`.
        traces: of `experiments.comparison`.
        tuning: starts and goals of `tuning_goals`.
    """
    starts, kinds = np.array(results["starts"]), results["start_kinds"]
    said = [verdict(claim) for claim in results["claims"]]
    still, singular, last = said[:3], said[3:-1], said[-1:]
    first = kinds.index("workspace")
    main = traces["all"]
    plots = [figures.plot_sequence(machine, main, s, starts[first], first) for s in axis_sequences(machine)]
    rates = figures.plot_joint_rates(machine, main, axis_sequences(machine)[0], first)
    first_start = "From the first start; one scale a row."
    parts: list[Part] = [
        ("Start configurations (Fig. 6a)", _starts_text(kinds), figures.plot_starts(machine, starts, kinds)),
        ("Motion along x (Fig. 6b-d)", first_start, *still, plots[0], rates),
        ("Motion along y (Fig. 6e, f)", first_start, plots[1]),
        ("Motion along z (Fig. 6g, h)", first_start, plots[2]),
    ]
    if traces["singular"]:
        parts.append(_singular(machine, results, traces["singular"], starts, singular))
    return [*parts, *_tables(results, last), *_lists(machine, results, tuning)]


def _starts_text(kinds: Sequence[str]) -> str:
    counts = ", ".join(f"{kinds.count(kind)} {kind}" for kind in dict.fromkeys(kinds))
    return (
        f"{counts}. Workspace: all sequences can be followed from there; limits: a joint near an end of its "
        "range; extended: arm nearly stretched and below the manipulability at which damping sets in. Means, "
        "intervals and verdicts are over the workspace starts; the others stand apart."
    )


def _singular(
    machine: Machine, results: Mapping[str, Any], traces: Traces, starts: Array, said: Sequence[str]
) -> Part:
    extended = starts[[kind == "extended" for kind in results["start_kinds"]]]
    ticks = next(iter(traces.values())).q.shape[0]
    along_y = axis_sequences(machine)[1]
    cut = along_y._replace(goals=along_y.goals[:ticks])
    plot = figures.plot_sequence(machine, traces, cut, extended[0], 0)
    keys = ("velocity_error_mean", "jerk_rms", "off_axis_drift_max", "time_at_limits")
    rows = {c: {k: of["all"][k] for k in keys} for c, of in results["singular"]["summary"].items()}
    text = "From extended starts; k = 0.05 with the gains of k = 0.1. Figure: along y from the first."
    return ("Near the singularity (Fig. 6a, e, f)", text, *said, plot, rows)


def _with_interval(number: Mapping[str, float | None]) -> str:
    if number["mean"] is None:
        return ""
    ends = "" if number["low"] is None else f" ({number['low']:.4f} to {number['high']:.4f})"
    return f"{number['mean']:.4f}{ends}"


def _bars(task: Mapping[str, Any], key: str) -> figures.Bars:
    return {
        c: {
            s: {
                "mean": row[key],
                "low": task["intervals"][c][s][key][0],
                "high": task["intervals"][c][s][key][1],
            }
            for s, row in rows.items()
        }
        for c, rows in task["summary"].items()
    }


def _tables(results: Mapping[str, Any], last: Sequence[str]) -> list[Part]:
    task, less = results["task_space"], results["regret"]["less_perfect_model"]
    everything = {name: rows["all"] for name, rows in task["summary"].items()}
    error, drift = (_bars(task, key) for key in ("velocity_error_mean", "off_axis_drift_max"))
    cells = {s: {c: _with_interval(rows[s]) for c, rows in error.items()} for s in next(iter(error.values()))}
    pairs = {
        f"{key}: rl less {c}": {s: _with_interval(n) for s, n in rows.items()}
        for key, of in task["rl_less"].items()
        for c, rows in of.items()
    }
    kinds = {f"{c}, {kind}": row for kind, rows in task["by_kind"].items() for c, row in rows.items()}
    bound = results["regret"]["summary"]["perfect_model"]
    scale = {"perfect_model (its error)": {s: row["velocity_error_mean"] for s, row in bound.items()}}
    regrets = scale | {c: {s: _with_interval(n) for s, n in rows.items()} for c, rows in less.items()}
    robust = {v: {c: _with_interval(n) for c, n in rows.items()} for v, rows in results["robustness"].items()}
    ends = "95 % intervals over starts in brackets"
    return [
        ("Figures of merit", "Means over all sequences [m/s, s, m, m/s^3, full strokes].", everything, *last),
        (
            "Velocity error and drift by sequence",
            f"{ends} [m/s, m].",
            cells,
            figures.plot_bars({"mean velocity error [m/s]": error, "largest drift [m]": drift}),
        ),
        ("RL less each baseline", f"On the same starts; {ends} [m/s, m].", pairs),
        (
            "By kind of start",
            "Means over all sequences; limits and extended starts put parts of the goals out of reach.",
            kinds,
        ),
        (
            "Regret",
            "Mean velocity error less that of a controller that has the plant's equations and state but no "
            f"goal ahead of time: what delay and dead time leave possible; {ends} [m/s].",
            regrets,
            figures.plot_bars({"regret [m/s]": less}),
        ),
        (
            "Robustness",
            f"Mean velocity error along x, y and z on a machine unlike the known one; {ends} [m/s].",
            robust,
        ),
    ]


def _lists(machine: Machine, results: Mapping[str, Any], tuning: tuple[Array, Array]) -> list[Part]:
    """What was scored and what was tuned on."""
    scored = {f"start {i}": _pose(machine, pose) for i, pose in enumerate(results["starts"])}
    for row, kind in zip(scored.values(), results["start_kinds"], strict=True):
        row["kind"] = kind
    sequences = {s.name: _path(machine, s.goals) for s in task_sequences(machine)}
    runs = enumerate(zip(tuning[0], tuning[1].swapaxes(0, 1), strict=True))
    tuned = {f"tuning run {i}": _pose(machine, pose) | _path(machine, goals) for i, (pose, goals) in runs}
    how = {}
    for name, t in results["tuning"].items():
        bounds = ", ".join(t["at_bound"]) or "none"
        how[name] = {
            "seed": t["seed"],
            "first": t["cost"][0],
            "last": t["cost"][-1],
            "gains at a bound": bounds,
        }
    return [
        ("Scored sequences", "Seconds, changes of goal, largest speed [m/s], path [m].", sequences),
        ("Scored starts", "Angles [rad].", scored),
        (
            "Tuning of the baselines",
            "Least velocity error after the first and last generation [m/s]; gains in results.json.",
            how,
        ),
        ("Tuning runs", "Starts [rad] and random goals, apart from those that score.", tuned),
    ]


def _pose(machine: Machine, pose: Array) -> dict[str, Any]:
    return dict(zip(machine.names, map(float, pose), strict=True))


def _path(machine: Machine, goals: Array) -> dict[str, Any]:
    speed = np.linalg.norm(goals, axis=-1)
    changes = int(np.any(np.diff(goals, axis=0) != 0, axis=-1).sum())
    path = float(speed.sum() * machine.dt)
    return {"seconds": len(goals) * machine.dt, "changes": changes, "speed": float(speed.max()), "path": path}
