"""The report: one HTML page with all figures and tables. The page is in `report.html.j2`."""

import base64
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from matplotlib.figure import Figure
from tqdm import tqdm

from brokk_min.actuator import ActuatorNet
from brokk_min.evaluation import figures
from brokk_min.evaluation.claims import VERDICTS, training_claim
from brokk_min.evaluation.figures import Bars
from brokk_min.evaluation.metrics import Mean, Traces
from brokk_min.evaluation.preliminary import Preliminary
from brokk_min.evaluation.sequences import (
    axis_sequences,
    hold_table,
    singular_sequences,
    task_sequences,
)
from brokk_min.identification.files import whole_file
from brokk_min.identification.logs import Log
from brokk_min.machine import Array, Machine

Results = Mapping[str, Any]  # of `results.json`
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
    for name, figure in tqdm(drawn.items(), desc="draw", unit="figure", disable=None):
        images[name] = base64.b64encode(figures.png(figure)).decode()
    with whole_file(out / "report.html", "w") as file:
        file.write(render(machine, results, images, clock))


def draw(machine: Machine, results: Results, shown: Shown, curve: Path) -> dict[str, Figure]:
    """All figures of the page by name; `curve` is the file of the learning curve."""
    starts, kinds = np.array(results["starts"]), results["start_kinds"]
    run = kinds.index("workspace")
    bars = {
        "mean velocity error [m/s]": with_intervals(results, "velocity_error_mean"),
        "largest drift [m]": with_intervals(results, "off_axis_drift_max"),
    }
    drawn = {
        "tests": figures.plot_tests(machine, shown.preliminary.tests),
        "free_run": figures.plot_free_run(shown.net, shown.test),
        "learning": figures.plot_learning(curve),
        "gap": figures.plot_gap(machine, shown.preliminary.gap),
        "starts": figures.plot_starts(machine, starts, kinds),
        "joint_velocities": figures.plot_joint_velocities(machine, shown.task, "x", run),
        "by_sequence": figures.plot_bars(bars),
        "regret": figures.plot_bars({"regret [m/s]": results["regret"]["less_perfect_model"]}),
    }
    for sequence in axis_sequences(machine):
        plot = figures.plot_sequence(machine, shown.task, sequence, starts[run], run)
        drawn[sequence.name] = plot
    if shown.singular:
        drawn["singular"] = _draw_singular(machine, results, shown.singular)
    if results["training_seeds"]:
        seeds = {"mean velocity error [m/s]": seed_bars(results["training_seeds"])}
        drawn["seeds"] = figures.plot_bars(seeds)
    return drawn


def _draw_singular(machine: Machine, results: Results, traces: Traces) -> Figure:
    """Half the speed, from the start nearest to a singularity."""
    starts = np.array(results["starts"])[np.array(results["start_kinds"]) == "extended"]
    run = int(np.argmin(results["singular"]["manipulability"]))
    half = singular_sequences(machine, starts)[0]
    ticks = len(traces["rl", half.name].q)
    half = half._replace(goals=half.goals[:ticks])
    return figures.plot_sequence(machine, traces, half, starts[run], run)


def seed_bars(table: Mapping[str, Mapping[str, Mean]]) -> Bars:
    """Velocity error over training seeds by controller and sequence."""
    bars = {}
    for controller, row in table.items():
        if "less" not in controller:
            errors = {k: v for k, v in row.items() if k.startswith("velocity_error_")}
            bars[controller] = {k.removeprefix("velocity_error_"): v for k, v in errors.items()}
    return bars


def render(
    machine: Machine, results: Results, images: Mapping[str, str], clock: Mapping[str, float]
) -> str:
    """The page, with PNG `images` in base64 by name and the seconds of each stage."""
    folder = Path(__file__).parent
    page = Environment(loader=FileSystemLoader(folder), autoescape=True, undefined=StrictUndefined)
    page.filters["interval"] = interval_text
    page.filters.update(label=label, transpose=transpose, with_intervals=with_intervals)
    training = training_claim(clock["train rl_paper"], results["meta"]["effort"]["paper_steps"])
    sequences = {}
    for sequence in task_sequences(machine):
        sequences[sequence.name] = path_row(hold_table(machine, sequence.goals))
    return page.get_template("report.html.j2").render(
        results=results,
        claims=[*results["net_claims"], *results["claims"], training.to_json()],
        images=images,
        clock=clock,
        verdicts=VERDICTS,
        intervals="95 % intervals over starts in brackets",
        joints=machine.names,
        sequences=sequences,
        tuning_paths=[path_row(np.array(run["goals"])) for run in results["tuning_runs"]],
    )


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


def with_intervals(results: Results, key: str) -> Bars:
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
