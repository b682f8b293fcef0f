"""The report: one HTML page with all figures and tables. The page is in `report.html.j2`."""

import base64
import os
import platform
from collections.abc import Mapping
from datetime import date
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from matplotlib.figure import Figure

from brokk_min.actuator import ActuatorNet
from brokk_min.evaluation import figures
from brokk_min.evaluation.claims import VERDICTS, training_claim
from brokk_min.evaluation.metrics import Mean, Traces, mean_interval
from brokk_min.evaluation.preliminary import Preliminary
from brokk_min.evaluation.rollout import TITLES, Trace
from brokk_min.evaluation.sequences import (
    axis_sequences,
    hold_table,
    singular_sequences,
    task_sequences,
)
from brokk_min.identification.files import SHIPPED, read_json, whole_file
from brokk_min.identification.logs import Log
from brokk_min.identification.progress import progress
from brokk_min.machine import Array, Machine

POSITION = ("rl", "rl_paper", "jacobian_pid_k0.1")  # in the figures of position errors
AT_REST = ("rl", "rl_dither", "jacobian_pid_ff_integral_dither")
STAGES = ("record", "learn and tune", "evaluate")  # of the clock; the others are within
Results = Mapping[str, Any]  # of `results.json`
Rows = Mapping[str, Mapping[str, Mean]]  # by name of the row and controller
UNITS = {
    "velocity": "m/s",
    "off": "m",
    "position": "m",
    "settling": "s",
    "time": "s",
    "creep": "m",
    "joint": "rad",
    "jerk": "m/s^3",
    "valve": "full strokes",
    "reward": "1",
}  # of the figures of merit, by their first word
FIRST = {  # figures of the first screen: names in seeds.json, in results, in a sweep
    "error [m/s]": ("error", "velocity_error_mean", "velocity_error_all"),
    "largest drift [m]": ("drift", "off_axis_drift_max", "off_axis_drift_max"),
    "jerk [m/s^3]": ("jerk", "jerk_rms", "jerk_rms"),
    "valve travel [strokes]": ("valve_travel", "valve_travel", "valve_travel"),
}
NONE: Mean = {"mean": None, "low": None, "high": None}
SEEDS = {"ours closed": "rl", "ours dither": "rl_dither", "paper": "rl_paper"}  # names there
SEEDS |= {"paper closed": "rl_paper"}
PID = "jacobian_pid_k0.1"  # what the first sentences compare with


class Shown(NamedTuple):
    """What the figures show besides the results."""

    net: ActuatorNet
    test: Log
    preliminary: Preliminary
    task: Traces
    singular: Traces  # empty without extended starts


def write_report(
    machine: Machine, out: Path, results: Results, shown: Shown, clock: Mapping[str, float]
) -> None:
    """Write `report.html` to the folder `out` of the learning curve; `clock` [s] by stage."""
    images = {}
    drawn = draw(machine, results, shown, out / "policy.npz.csv")
    for name, figure in progress(drawn.items(), desc="draw", unit="figure"):
        images[name] = base64.b64encode(figures.png(figure)).decode()
    with whole_file(out / "report.html", "w") as file:
        file.write(render(machine, results, images, clock))


def draw(machine: Machine, results: Results, shown: Shown, curve: Path) -> dict[str, Figure]:
    """All figures of the page by name; `curve` is the file of the learning curve."""
    starts, kinds = np.array(results["starts"]), results["start_kinds"]
    run = kinds.index("workspace")
    scored = np.array(kinds) == "workspace"
    task = {k: Trace(*(array[:, scored] for array in trace)) for k, trace in shown.task.items()}
    error = transpose(with_intervals(results, "velocity_error_mean"))
    drift = transpose(with_intervals(results, "off_axis_drift_max"))
    regret = transpose(results["regret"]["less_perfect_model"])
    axes = axis_sequences(machine)
    drawn = {
        "first": figures.plot_intervals(first_panels(machine, results)),
        "tests": figures.plot_tests(machine, shown.preliminary.tests),
        "free_run": figures.plot_free_run(shown.net, shown.test),
        "learning": figures.plot_learning(curve),
        "gap": figures.plot_gap(machine, shown.preliminary.gap),
        "starts": figures.plot_starts(machine, starts, kinds),
        "joint_velocities": figures.plot_joint_velocities(machine, shown.task, "x", run),
        "rest": figures.plot_rest(machine, task, axes[0], AT_REST),
        "by_sequence": figures.plot_intervals({"error [m/s]": error, "largest drift [m]": drift}),
        "regret": figures.plot_intervals({"regret [m/s]": regret}),
        "robustness": figures.plot_intervals({"mean velocity error [m/s]": results["robustness"]}),
    }
    for s in axes:
        drawn[s.name] = figures.plot_sequence(machine, shown.task, s, starts[run], run)
        errors = figures.plot_position_error(machine, task, s, starts[scored], POSITION)
        drawn[f"{s.name}_error"] = errors
    if shown.singular:
        drawn["singular"] = _draw_singular(machine, results, shown.singular)
    return drawn


def first_panels(machine: Machine, results: Results) -> dict[str, Rows]:
    """Rows of the first figure: seeds that the package has or that were swept, then this run."""
    seeds = [row for row in shipped(machine, "seeds.json") or () if row["seed"] is not None]
    panels: dict[str, Rows] = {}
    for label, (name, key, key_swept) in FIRST.items():
        rows: dict[str, dict[str, Mean]] = {}
        for of in dict.fromkeys(row["controller"] for row in seeds):
            values = np.array([row[name] for row in seeds if row["controller"] == of], float)
            code = SEEDS.get(of, of)
            title = TITLES.get(code, code) + " (closed)" * (of == "paper closed")
            rows[f"{title}, {len(values)} seeds"] = {code: mean_interval(values)}
        if results["training_seeds"]:
            rows["rl, swept seeds"] = {"rl": results["training_seeds"]["rl"].get(key_swept, NONE)}
        for controller, of_sequence in with_intervals(results, key).items():
            rows[controller] = {controller: of_sequence["all"]}
        panels[label] = rows
    return panels


def shipped(machine: Machine, name: str) -> Any:
    """Content of a JSON file that the package has for the machine; None: it has none."""
    path = SHIPPED / machine.name / name
    return read_json(path, "JSON") if path.exists() else None


def _draw_singular(machine: Machine, results: Results, traces: Traces) -> Figure:
    """Half the speed, from the start nearest to a singularity."""
    starts = np.array(results["starts"])[np.array(results["start_kinds"]) == "extended"]
    run = int(np.argmin(results["singular"]["manipulability"]))
    half = singular_sequences(machine, starts)[0]
    ticks = len(traces["rl", half.name].q)
    half = half._replace(goals=half.goals[:ticks])
    return figures.plot_sequence(machine, traces, half, starts[run], run)


def render(
    machine: Machine, results: Results, images: Mapping[str, str], clock: Mapping[str, float]
) -> str:
    """The page, with PNG `images` in base64 by name and the seconds of each stage."""
    folder = Path(__file__).parent
    page = Environment(loader=FileSystemLoader(folder), autoescape=True, undefined=StrictUndefined)
    page.filters["interval"] = interval_text
    page.filters.update(label=label, transpose=transpose, with_intervals=with_intervals)
    training = training_claim(clock["train rl_paper"], results["meta"]["effort"]["paper_steps"])
    rows = next(iter(first_panels(machine, results).values()))
    paths = {s.name: path_row(hold_table(machine, s.goals)) for s in task_sequences(machine)}
    return page.get_template("report.html.j2").render(
        results=results,
        compared=compare(results),
        titles=TITLES,
        less=less_than(results["task_space"]["summary"], PID),
        seeds=[row for row in rows if "seeds" in row],
        family=(shipped(machine, "family.json") or {"table": {}})["table"],
        minutes=sum(clock.get(stage, 0) for stage in STAGES) / 60,
        date=date.today().isoformat(),
        computer=f"{platform.machine()}, {os.cpu_count()} cores",
        claims=[*results["net_claims"], *results["claims"], training.to_json()],
        images=images,
        clock=clock,
        verdicts=VERDICTS,
        intervals="95 % intervals over starts in brackets",
        joints=list(machine.names),
        sequences=paths,
        tuning_paths=[path_row(np.array(run["goals"])) for run in results["tuning_runs"]],
    )


def less_than(summary: Mapping[str, Any], other: str) -> dict[str, float]:
    """How much less our policy's figures of the first screen are than another's, as fractions."""
    ours, theirs = summary["rl"]["all"], summary[other]["all"]
    return {name: 1 - ours[key] / theirs[key] for name, (_, key, _) in FIRST.items()}


def compare(results: Results) -> dict[str, list[str]]:
    """Controllers by the interval of our policy's velocity error less theirs: below 0, above 0."""
    sides: dict[str, list[str]] = {"lower than": [], "higher than": [], "not told apart from": []}
    for name, less in results["task_space"]["rl_less"]["velocity_error_mean"].items():
        low, high = less["all"]["low"], less["all"]["high"]
        side = "lower than" if high is not None and high < 0 else "not told apart from"
        sides["higher than" if low is not None and low > 0 else side].append(name)
    return sides


def interval_text(number: Mean) -> str:
    """A mean with its interval.

    Example:
        >>> interval_text({"mean": 0.01234, "low": -0.5, "high": 41.267})
        '0.0123 (-0.5000 to 41.27)'
    """
    numbers = [number[key] for key in ("mean", "low", "high")]
    texts = [f"{x:.4f}" if abs(x) < 1 else f"{x:.4g}" for x in numbers if x is not None]
    return f"{texts[0]} ({texts[1]} to {texts[2]})" if len(texts) == 3 else "".join(texts)


def label(key: str) -> str:
    """A figure of merit with its unit.

    Example:
        >>> label("jerk_rms")
        'jerk_rms [m/s^3]'
    """
    return f"{key} [{UNITS[key.split('_')[0]]}]"


def transpose(rows: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Columns as rows."""
    columns = list(next(iter(rows.values())))
    return {column: {name: row[column] for name, row in rows.items()} for column in columns}


def with_intervals(results: Results, key: str) -> Rows:
    """A figure of merit with its interval, by controller and sequence."""
    task = results["task_space"]
    table: dict[str, dict[str, Mean]] = {}
    for controller, rows in task["summary"].items():
        table[controller] = {}
        for sequence, row in rows.items():
            low, high = task["intervals"][controller][sequence][key]
            table[controller][sequence] = {"mean": row[key], "low": low, "high": high}
    return table


def path_row(rows: Array) -> dict[str, Any]:
    """Length and goals of a sequence of `hold_table`; many goals are not listed."""
    seconds = rows[:, 0]
    speed = np.linalg.norm(rows[:, 1:], axis=-1)
    goals = [f"{s:g} s ({x:.3g}, {y:.3g}, {z:.3g})" for s, x, y, z in rows + 0.0]  # no -0
    return {
        "seconds": float(seconds.sum()),
        "changes": len(rows) - 1,
        "speed [m/s]": float(speed.max()),
        "path [m]": float(speed @ seconds),
        "held for, vx, vy, vz [m/s]": "; ".join(goals) if len(goals) < 50 else "new at every tick",
    }
