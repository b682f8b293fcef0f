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
from brokk_min.sequences import axis_sequences, least_motion, task_sequences

Array = NDArray[np.floating[Any]]
VERDICTS = {True: "holds here", False: "does not hold here", None: "was not measured"}
RECIPES = (
    "What the nets cost on the machine when they are fitted as in the paper: errors of free runs of 10 s on "
    "these recordings [rad/s]; mean distance of the tools in 30 s, median and worst run of Fig. 5 [m]."
)
Part = tuple[Any, ...]  # title, sentence, contents: see `figures.write_report`
UNITS = {"velocity": "m/s", "off": "m", "position": "m", "settling": "s", "time": "s", "jerk": "m/s^3"}
BOUNDS = ("perfect_model", "perfect_model_no_dither")  # of `experiments.bounds`
UNITS |= {"valve": "full strokes", "reward": "1"}  # of the figures of `metrics`, by their first word


def verdict(claim: Mapping[str, Any]) -> str:
    """The paper's sentence, what was measured, and whether it holds."""
    return f"Paper: {claim['paper']} Measured: {claim['measured']}. This {VERDICTS[claim['holds']]}."


def found(results: Mapping[str, Any]) -> Part:
    """The first part: the paper's question and its sentences answered."""
    error = "velocity_error_mean"
    means = {name: rows["all"][error] for name, rows in results["task_space"]["summary"].items()}
    said = ", ".join(f"{name} {mean:.4f}" for name, mean in means.items() if mean is not None)
    bound, idle = (results["regret"]["summary"][name]["all"][error] for name in BOUNDS)
    text = f"Mean velocity error of the tool over all sequences [m/s]: {said}. A controller that has the "
    text += f"plant's equations and state is left with {bound:.4f} (along x, y and z alone), or with "
    text += f"{idle:.4f} if it leaves valves idle while the tool is to stand still."
    rows = {claim["paper"]: {"what the paper says": VERDICTS[claim["holds"]]} for claim in results["claims"]}
    return "What was found", text, rows


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
    ahead = len(said) - 3 - len(results["singular"]["claims"])
    still, near, (track, along_z, last) = said[:ahead], said[ahead:-3], said[-3:]
    first = kinds.index("workspace")
    main, axes = traces["all"], axis_sequences(machine)
    plots = [figures.plot_sequence(machine, main, s, starts[first], first) for s in axes]
    rates = figures.plot_joint_rates(machine, main, axes[0], first)
    text = "From the first start; one scale a row."
    parts: list[Part] = [
        ("Start configurations (Fig. 6a)", _starts_text(kinds), figures.plot_starts(machine, starts, kinds)),
        ("Motion along x (Fig. 6b-d)", text, *still, plots[0], rates),
        ("Motion along y (Fig. 6e, f)", text, track, plots[1]),
        ("Motion along z (Fig. 6g, h)", text, along_z, plots[2]),
    ]
    if traces["singular"]:
        extended = starts[[kind == "extended" for kind in kinds]]
        parts.append(_singular(machine, results["singular"], traces["singular"], extended, near))
    return [*parts, *_tables(results, last), *_lists(machine, results, tuning)]


def _starts_text(kinds: Sequence[str]) -> str:
    counts = ", ".join(f"{kinds.count(kind)} {kind}" for kind in dict.fromkeys(kinds))
    return (
        f"{counts}. Workspace: all sequences can be followed from there; limits: a joint near an end of its "
        "range; extended: arm nearly stretched and below the manipulability at which damping sets in. Means, "
        "intervals and verdicts are over the workspace starts; the others stand apart."
    )


def _singular(
    machine: Machine, found: Mapping[str, Any], traces: Traces, extended: Array, said: Sequence[str]
) -> Part:
    run = int(np.argmin(found["manipulability"]))
    ticks = len(next(iter(traces.values())).q)
    half = least_motion(machine, extended)[0]
    plot = figures.plot_sequence(machine, traces, half._replace(goals=half.goals[:ticks]), extended[run], run)
    keys = ("velocity_error_mean", "jerk_rms", "off_axis_drift_max", "time_at_limits")
    rows = {c: {k: of["all"][k] for k in keys} for c, of in found["summary"].items()}
    ends = [f"{min(found[k]):.2f} to {max(found[k]):.2f}" for k in ("manipulability", "least")]
    text = (
        f"From the extended starts (manipulability {ends[0]}, damping sets in below {found['w0']:.2f}; "
        f"least singular value of the Jacobian {ends[1]} m/rad), to and fro in the direction in which the "
        "arm can move least, at a half and a quarter of the axis sequences' speed: at the whole, the joints' "
        "own limits slow the tool there, whatever the damping. k = 0.05 with the gains of k = 0.1. "
        "Figure: half the speed, from the start nearest to a singularity."
    )
    return ("Near the singularity (Fig. 6a, e, f)", text, *said, plot, _with_units(rows))


def _with_units(rows: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """The same rows, the unit of each figure beside its name."""
    return {
        name: {f"{key} [{UNITS[key.split('_')[0]]}]": value for key, value in row.items()}
        for name, row in rows.items()
    }


def _with_interval(number: Mapping[str, float | None]) -> str:
    if number["mean"] is None:
        return ""
    ends = "" if number["low"] is None else f" ({number['low']:.4f} to {number['high']:.4f})"
    return f"{number['mean']:.4f}{ends}"


def _bars(task: Mapping[str, Any], key: str) -> figures.Bars:
    def number(c: str, s: str) -> dict[str, float | None]:
        low, high = task["intervals"][c][s][key]
        return {"mean": task["summary"][c][s][key], "low": low, "high": high}

    return {c: {s: number(c, s) for s in rows} for c, rows in task["summary"].items()}


def _tables(results: Mapping[str, Any], last: str) -> list[Part]:
    task, less = results["task_space"], results["regret"]["less_perfect_model"]
    everything = _with_units({name: rows["all"] for name, rows in task["summary"].items()})
    error, drift = (_bars(task, key) for key in ("velocity_error_mean", "off_axis_drift_max"))
    cells = {s: {c: _with_interval(rows[s]) for c, rows in error.items()} for s in next(iter(error.values()))}
    pairs = {
        f"{key}: rl less {c}": {s: _with_interval(n) for s, n in rows.items()}
        for key, of in task["rl_less"].items()
        for c, rows in of.items()
    }
    kinds = {f"{c}, {kind}": row for kind, rows in task["by_kind"].items() for c, row in rows.items()}
    kinds = _with_units(kinds)
    every = {name: results["regret"]["summary"][name] for name in BOUNDS}
    scale = {
        f"{name} (its error)": {s: row["velocity_error_mean"] for s, row in rows.items()}
        | {"valve travel": rows["all"]["valve_travel"]}
        for name, rows in every.items()
    }
    regrets = scale | {c: {s: _with_interval(n) for s, n in rows.items()} for c, rows in less.items()}
    robust: dict[str, dict[str, str]] = {}
    for variation, of in results["robustness"].items():
        robust[variation] = {c: _with_interval(n) for c, n in of.items()}
        most, share = (max(n[key] for n in of.values()) for key in ("supply_demand", "supply_limits"))
        robust[variation] |= {"pump's flow asked for": f"{most:.0%}", "ticks it limits": f"{share:.1%}"}
    ends = "95 % intervals over starts in brackets"
    return [
        ("Figures of merit", "Means over all sequences.", everything, last),
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
            f"Mean velocity error along x, y and z on a machine unlike the known one; {ends} [m/s]. Last "
            "columns: the most of the pump's flow that any controller asks for, and how often that is more "
            "than there is.",
            robust,
        ),
        *_seeds(results["training_seeds"]),
    ]


def _seeds(table: Mapping[str, Mapping[str, Any]]) -> list[Part]:
    """The figures of a sweep, if there is one."""
    if not table:
        return []
    cells = {k: {c: _with_interval(of[k]) for c, of in table.items()} for k in table["rl"]}
    errors = [k for k in table["rl"] if k.startswith("velocity_error_")]
    alone = {c: of for c, of in table.items() if "less" not in c}
    bars = {c: {k.split("_", 2)[2]: of[k] for k in errors} for c, of in alone.items()}
    text = (
        "Means over training seeds on the machine, and 95 % intervals over them (Student's t; a seed counts "
        "once, with the mean over its workspace starts) [m/s, m, full strokes]. Baselines are not trained."
    )
    return [("Training seeds", text, cells, figures.plot_bars({"mean velocity error [m/s]": bars}))]


def _lists(machine: Machine, results: Mapping[str, Any], tuning: tuple[Array, Array]) -> list[Part]:
    """What was scored and what was tuned on."""
    scored = {f"start {i}": _pose(machine, pose) for i, pose in enumerate(results["starts"])}
    for row, kind in zip(scored.values(), results["start_kinds"], strict=True):
        row["kind"] = kind
    sequences = {s.name: _path(machine, s.goals) for s in task_sequences(machine)}
    runs = enumerate(zip(tuning[0], tuning[1].swapaxes(0, 1), strict=True))
    tuned = {f"tuning run {i}": _pose(machine, pose) | _path(machine, goals) for i, (pose, goals) in runs}
    how = {
        name: {
            "seed": t["seed"],
            "first": t["cost"][0],
            "last": t["cost"][-1],
            "under other noise": t["cost_anew"],
            "gains at a bound": ", ".join(t["at_bound"]) or "none",
        }
        for name, t in results["tuning"].items()
    }
    return [
        ("Scored sequences", "Seconds, changes of goal, largest speed [m/s], path [m].", sequences),
        ("Scored starts", "Angles [rad].", scored),
        (
            "Tuning of the baselines",
            "Least velocity error after the first and last generation [m/s], and that of the gains found, "
            "under other noise; gains in results.json.",
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
