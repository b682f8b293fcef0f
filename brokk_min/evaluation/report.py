"""The report in the paper's order: nets and training, then task space control with its verdicts.

Paper: Sec. 4.2
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from brokk_min.actuator import ActuatorNet
from brokk_min.evaluation import claims, figures, preliminary
from brokk_min.evaluation.figures import Quote
from brokk_min.evaluation.metrics import Mean, Traces
from brokk_min.evaluation.sequences import (
    KINDS,
    axis_sequences,
    hold_table,
    singular_sequences,
    task_sequences,
)
from brokk_min.identification.logs import Log
from brokk_min.machine import Array, Machine

VERDICTS = {True: "holds here", False: "does not hold here", None: "was not measured"}
RECIPES = (
    "What the nets cost on the machine when they are fitted as in the paper: errors of free runs of 10 s on "
    "these recordings [rad/s]; mean distance of the tools in 30 s, median and worst run of Fig. 5 [m]."
)
CALIBRATED = "The analytic machine was calibrated to these figures of the paper; what is tested are the nets."
CHOSEN = (
    "The policy of the last step is compared, none chosen by its score. But what our deviations from the "
    "paper's learner change was measured on scored sequences while this was built (PAPER.md, D4 to D14); the "
    "baselines' gains never saw them."
)
BESIDE = "the same of a baseline with velocity feed-forward from the nets, which the paper does not have: "
ENDS = "95 % intervals over starts in brackets"
TUNED = (
    "Mean velocity error on the tuning runs below: least after the first and last generation [m/s], and "
    "that of the gains found, under other noise; gains, with this seed and the nets they belong to, in "
    "gains.json."
)
Part = tuple[Any, ...]  # title, sentence, contents: see `figures.write_report`
BOUNDS = ("perfect_model", "perfect_model_no_dither")  # of `perfect_models`
UNITS = {
    "velocity": "m/s",
    "off": "m",
    "position": "m",
    "settling": "s",
    "time": "s",
    "jerk": "m/s^3",
}
UNITS |= {
    "valve": "full strokes",
    "reward": "1",
}  # of the figures of `metrics`, by their first word


def verdict(claim: Mapping[str, Any]) -> Quote:
    """The paper's sentence, what was measured, and whether it holds; against a stronger baseline, too."""
    lines = [(claim["measured"], VERDICTS[claim["holds"]])]
    if "stronger" in claim:
        other = claim["stronger"]
        lines.append(
            (BESIDE + claims.said(other["numbers"], other["unit"]), VERDICTS[other["holds"]])
        )
    return Quote(claim["paper"], tuple((text, f"This {answer}.") for text, answer in lines))


def found(results: Mapping[str, Any]) -> Part:
    """The first part: the paper's question and its sentences answered."""
    error = "velocity_error_mean"
    means = {name: rows["all"][error] for name, rows in results["task_space"]["summary"].items()}
    said = ", ".join(f"{name} {mean:.4f}" for name, mean in means.items() if mean is not None)
    bound, idle = (results["regret"]["summary"][name]["all"][error] for name in BOUNDS)
    text = f"Mean velocity error of the tool over all sequences [m/s]: {said}. A controller that has the "
    text += (
        f"plant's equations and state is left with {bound:.4f} (along x, y and z alone), or with "
    )
    text += f"{idle:.4f} if it leaves valves idle while the tool is to stand still. The policy and "
    text += (
        "jacobian_pid_ff_awake hold them barely open then (D12); the other baselines close them."
    )
    rows = {}
    for claim in (*results["net_claims"], *results["claims"]):
        answer = {"what the paper says": VERDICTS[claim["holds"]]}
        stronger = VERDICTS[claim["stronger"]["holds"]] if "stronger" in claim else ""
        rows[claim["paper"]] = answer | {"for a baseline with feed-forward": stronger}
    return "What was found", text, rows


def net_parts(
    machine: Machine,
    net: ActuatorNet,
    test: Log,
    results: Mapping[str, Any],
    seed: int,
    curve: Path,
    train_s: float,
) -> list[Part]:
    """Parts on the machine, the nets and the training, which took `train_s` seconds."""
    errors = {}
    for joint, s in results["actuator"]["test"].items():
        errors[joint] = {f"{key} [rad/s]": s[key] for key in ("one_step_rmse", "persistence_rmse")}
        free = s["free_run"].get("10", {}).items()
        errors[joint] |= {
            f"{key} [{'rad/s' if 'velocity' in key else 'rad'}]": value for key, value in free
        }
    tests, gap = preliminary.plots(machine, net, seed).values()
    *before, apart = (verdict(claim) for claim in results["net_claims"])
    trained = verdict(claims.training_claim(train_s, results["meta"]["effort"]["train_steps"]))
    curves = figures.plot_learning(curve)
    return [
        (
            "Preliminary tests (Fig. 2)",
            f"{CALIBRATED} The machine above, the nets below.",
            *before,
            tests,
        ),
        ("Actuator nets", "One step and free runs of 10 s on unseen recordings.", errors),
        ("Two recipes", RECIPES, _recipes(results)),
        ("Nets run freely", "One of these recordings.", figures.plot_free_run(net, test)),
        ("Learning curve", f"The exploring policy, on the nets. {CHOSEN}", trained, curves),
        ("Sim-to-real gap (Fig. 5)", "Nets less machine under the same commands.", apart, gap),
    ]


def _recipes(results: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Errors of nets by our recipe and by the paper's: free runs by joint, and the tool's after 30 s."""
    ours = {
        "test": results["actuator"]["test"],
        "sim_to_real": results["preliminary"]["sim_to_real"],
    }
    recipes = {"rich, free runs (ours)": ours, "sines, one step (paper)": results["paper_recipe"]}
    rows: dict[str, dict[str, Any]] = {}
    for name, recipe in recipes.items():
        row = {
            joint: s["free_run"].get("10", {}).get("velocity_rmse")
            for joint, s in recipe["test"].items()
        }
        gaps = recipe["sim_to_real"]["tool_position_error_mean_of_runs"]
        rows[name] = row | {f"tool, {kind}": gaps[kind] for kind in ("median", "max")}
    return rows


def task_parts(
    machine: Machine, results: Mapping[str, Any], traces: Mapping[str, Traces]
) -> list[Part]:
    """Parts on task space control: `results` of `chain.reproduce`, `traces` of `experiments.comparison`."""
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
        (
            "Start configurations (Fig. 6a)",
            _starts_text(kinds),
            figures.plot_starts(machine, starts, kinds),
        ),
        ("Motion along x (Fig. 6b-d)", text, *still, plots[0], rates),
        ("Motion along y (Fig. 6e, f)", text, track, plots[1]),
        ("Motion along z (Fig. 6g, h)", text, along_z, plots[2]),
    ]
    if traces["singular"]:
        extended = starts[[kind == "extended" for kind in kinds]]
        parts.append(_singular(machine, results["singular"], traces["singular"], extended, near))
    return [*parts, *_tables(results, last), *_lists(machine, results)]


def _starts_text(kinds: Sequence[str]) -> str:
    counts = ", ".join(f"{kinds.count(kind)} {kind}" for kind in dict.fromkeys(kinds))
    return (
        f"{counts}. Workspace: all sequences can be followed from there; limits: a joint near an end of its "
        "range; extended: arm nearly stretched and below the manipulability at which damping sets in. Means, "
        "intervals and verdicts are over the workspace starts; the others stand apart. What the paper "
        "says of the arm near full extension stands with its motion below."
    )


def _singular(
    machine: Machine,
    found: Mapping[str, Any],
    traces: Traces,
    extended: Array,
    said: Sequence[Quote],
) -> Part:
    run, ticks = int(np.argmin(found["manipulability"])), len(next(iter(traces.values())).q)
    half = singular_sequences(machine, extended)[0]
    plot = figures.plot_sequence(
        machine, traces, half._replace(goals=half.goals[:ticks]), extended[run], run
    )
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


def _named(key: str) -> str:
    """A figure of `metrics` with its unit."""
    return f"{key} [{UNITS[key.split('_')[0]]}]"


def _with_units(rows: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """The same rows, the unit of each figure beside its name."""
    return {name: {_named(key): value for key, value in row.items()} for name, row in rows.items()}


def _turned(rows: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Columns as rows."""
    return {
        key: {name: row[key] for name, row in rows.items()} for key in next(iter(rows.values()))
    }


def _with_interval(number: Mean) -> str:
    if number["mean"] is None:
        return ""
    numbers = (number[key] for key in ("mean", "low", "high"))
    mean, *ends = (f"{x:.4f}" if abs(x) < 1 else f"{x:.4g}" for x in numbers if x is not None)
    return f"{mean} ({ends[0]} to {ends[1]})" if ends else mean


def _cells(rows: Mapping[str, Mapping[str, Mean]]) -> dict[str, dict[str, str]]:
    return {name: {key: _with_interval(n) for key, n in row.items()} for name, row in rows.items()}


def _bars(task: Mapping[str, Any], key: str) -> figures.Bars:
    """A figure with its interval by controller and sequence."""
    return {c: {s: _number(task, c, s, key) for s in rows} for c, rows in task["summary"].items()}


def _number(task: Mapping[str, Any], controller: str, sequence: str, key: str) -> Mean:
    low, high = task["intervals"][controller][sequence][key]
    return {"mean": task["summary"][controller][sequence][key], "low": low, "high": high}


def _tables(results: Mapping[str, Any], last: Quote) -> list[Part]:
    task = results["task_space"]
    parts = [
        _merit(task, last),
        _by_sequence(task),
        _pairs(task["rl_less"]),
        _kinds(task["by_kind"]),
    ]
    parts += [_regret(results["regret"]), _robust(results["robustness"])]
    return parts + _seeds(results["training_seeds"])


def _merit(task: Mapping[str, Any], last: Quote) -> Part:
    rows = {c: of["all"] for c, of in task["summary"].items()}
    merit = {
        c: {_named(key): _number(task, c, "all", key) for key in row} for c, row in rows.items()
    }
    return "Figures of merit", f"Means over all sequences; {ENDS}.", last, _turned(_cells(merit))


def _by_sequence(task: Mapping[str, Any]) -> Part:
    error, drift = (_bars(task, key) for key in ("velocity_error_mean", "off_axis_drift_max"))
    plot = figures.plot_bars({"mean velocity error [m/s]": error, "largest drift [m]": drift})
    text = (
        f"{ENDS}. Drift is the distance from a straight line; where the goal turns at every tick, on the "
        "circle, it is that within a tick and says little."
    )
    errors, drifts = (_turned(_cells(bars)) for bars in (error, drift))
    tables = "Mean velocity error [m/s].", errors, "Largest drift [m].", drifts
    return "Velocity error and drift by sequence", text, *tables, plot


def _pairs(less: Mapping[str, Any]) -> Part:
    """RL less each baseline: every figure, then two of them by sequence."""
    every = {_named(key): {c: rows["all"] for c, rows in of.items()} for key, of in less.items()}
    contents: list[Any] = ["All sequences.", _cells(every)]
    for key in ("velocity_error_mean", "off_axis_drift_max"):
        contents += [f"{_named(key)} by sequence.", _turned(_cells(less[key]))]
    text = f"Differences on the same starts and noise, one value a start; {ENDS}."
    return "RL less each baseline", text, *contents


def _kinds(by_kind: Mapping[str, Any]) -> Part:
    """Figures from the starts that do not count."""
    text = "Means over all sequences; from limits and extended starts parts of the goals are out of reach."
    contents: list[Any] = []
    for kind, rows in by_kind.items():
        if kind != KINDS[0]:
            contents += [f"{kind.capitalize()} starts.", _turned(_with_units(rows))]
    return "Starts of other kinds", text, *contents


def _regret(regret: Mapping[str, Any]) -> Part:
    scale = {}
    for name in BOUNDS:
        of = regret["summary"][name]
        scale[name] = {f"{s} [m/s]": row["velocity_error_mean"] for s, row in of.items()}
        scale[name]["valve travel [full strokes]"] = of["all"]["valve_travel"]
    text = (
        "Mean velocity error less that of a controller that has the plant's equations and state but no "
        f"goal ahead of time: what delay and dead time leave possible; {ENDS}."
    )
    less = regret["less_perfect_model"]
    plot = figures.plot_bars({"regret [m/s]": less})
    return (
        "Regret",
        text,
        "What the bounds themselves leave.",
        scale,
        "Regret [m/s].",
        _cells(less),
        plot,
    )


def _robust(robustness: Mapping[str, Any]) -> Part:
    supply, less = {}, {}
    for name, of in robustness.items():
        most, share = (
            max(n[key] for n in of.values()) for key in ("supply_demand", "supply_limits")
        )
        supply[name] = {"pump's flow asked for": f"{most:.0%}", "ticks it limits": f"{share:.1%}"}
        less[name] = {c: n["rl_less"] for c, n in of.items() if "rl_less" in n}
    text = f"Mean velocity error along x, y and z on a machine unlike the known one [m/s]; {ENDS}."
    asked = "The most of the pump's flow that any controller asks for, and how often that is more than there is."
    paired = "RL less each baseline, on the same starts [m/s]."
    return "Robustness", text, _cells(robustness), paired, _cells(less), asked, supply


def _seeds(table: Mapping[str, Mapping[str, Any]]) -> list[Part]:
    """The figures of a sweep, if there is one."""
    if not table:
        return []
    cells, single = _cells(table), [c for c in table if "less" not in c]
    alone = {k: {c: cells[c][k] for c in single} for k in table["rl"]}
    less = {k: {c: cells[c][k] for c in table if c not in single} for k in table["rl"]}
    errors = [k for k in table["rl"] if k.startswith("velocity_error_")]
    bars = {c: {k.split("_", 2)[2]: table[c][k] for k in errors} for c in single}
    text = (
        "Means over training seeds on the machine, and 95 % intervals over them (Student's t; a seed counts "
        "once, with the mean over its workspace starts) [m/s, m, full strokes]. Baselines are not trained."
    )
    plot = figures.plot_bars({"mean velocity error [m/s]": bars})
    return [("Training seeds", text, alone, "What RL has less than each baseline.", less, plot)]


def _lists(machine: Machine, results: Mapping[str, Any]) -> list[Part]:
    """What was scored and what was tuned on."""
    scored = {f"start {i}": _pose(machine, pose) for i, pose in enumerate(results["starts"])}
    for row, kind in zip(scored.values(), results["start_kinds"], strict=True):
        row["kind"] = kind
    sequences = {s.name: _path(hold_table(machine, s.goals)) for s in task_sequences(machine)}
    tuned = {}
    for i, run in enumerate(results["tuning_runs"]):
        tuned[f"tuning run {i}"] = _pose(machine, run["start"]) | _path(np.array(run["goals"]))
    return [
        ("Scored sequences", "Seconds, and the goals held for them.", sequences),
        ("Scored starts", "Angles [rad].", scored),
        ("Tuning of the baselines", TUNED, _tuning(results["tuning"])),
        ("Tuning runs", "Starts [rad] and random goals, apart from those that score.", tuned),
    ]


def _tuning(tuning: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    return {
        name: {
            "seed": t["seed"],
            "first": t["cost"][0],
            "last": t["cost"][-1],
            "under other noise": t["cost_anew"],
            "gains at a bound": ", ".join(t["at_bound"]) or "none",
        }
        for name, t in tuning.items()
    }


def _pose(machine: Machine, pose: Array) -> dict[str, Any]:
    return dict(zip(machine.names, map(float, pose), strict=True))


def _path(rows: Array) -> dict[str, Any]:
    """Length and goals of a sequence of `hold_table`; of one that turns at every tick no goals."""
    seconds, speed = rows[:, 0], np.linalg.norm(rows[:, 1:], axis=-1)
    held = "; ".join(f"{s:g} s ({x:.3g}, {y:.3g}, {z:.3g})" for s, x, y, z in rows + 0.0)  # no -0
    figures = {
        "seconds": float(seconds.sum()),
        "changes": len(rows) - 1,
        "speed [m/s]": float(speed.max()),
    }
    goals = held if len(rows) < 50 else "at every tick another"
    return figures | {"path [m]": float(speed @ seconds), "held for, vx, vy, vz [m/s]": goals}
