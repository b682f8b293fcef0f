"""The report: the paper's figures, and one HTML page with them, `report.html.j2`."""

import base64
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import StrictUndefined, Template
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.linalg import norm
from tqdm import tqdm

from brokk_min._files import SHIPPED, whole_file
from brokk_min.evaluation.baselines import BY_HAND, OPTIMISED, STRONGEST
from brokk_min.evaluation.claims import verdict_rows
from brokk_min.evaluation.metrics import COLUMNS, Mean, Traces, interval_text
from brokk_min.evaluation.preliminary import Curves, Gap, Tests
from brokk_min.evaluation.rollout import TITLES, title, valves_at_rest
from brokk_min.evaluation.sequences import AXES, Commands, axis_sequences
from brokk_min.kinematics import forward_kinematics, tool_position
from brokk_min.machine import Array, Machine

Results = Mapping[str, Any]  # of `results.json`
Row = tuple[Sequence[str], Mapping[str, Array]]  # of plots: labels, and curves (T, labels) by name
Shown = tuple[Mapping[str, Tests], Gap, Traces]  # of machine and nets, nets less machine
ROWS = (BY_HAND, OPTIMISED, "rl_critic", "rl_paper", "rl", STRONGEST)
SAMPLE = ("rl_paper", "rl_critic", BY_HAND, OPTIMISED)  # drawn in Fig. 6
WIDTH = 10.0  # inch, of every figure, so that letters have one size in the report
LINES = ("-", "--", "-.", ":")  # beside colours, for the colour-blind


@style.context("default")  # not the settings of the owner for his own pictures
def write_report(out: Path, machine: Machine, results: Results, measured: Shown) -> None:
    """Write `report.html` to the folder `out`; `measured` is what the paper's figures show."""
    tests, gap, traces = measured
    starts, table = np.array(results["starts"]), headline(results)["table"]
    drawn = {
        "errors": plot_errors({c: table[c]["velocity_error_mean"] for c in ROWS if c in table}),
        "tests": plot_tests(machine, tests),
        "gap": plot_gap(machine, gap),
        "starts": plot_starts(machine, starts),
        "joints": plot_joint_velocities(machine, traces, "x"),
    }
    for axis in axis_sequences(machine):
        drawn[axis.name] = plot_sequence(machine, traces, axis, starts)
    images = {name: png(figure) for name, figure in tqdm(drawn.items(), "draw", disable=None)}
    with whole_file(out / "report.html", "w") as file:
        file.write(render(results, images))


def png(figure: Figure) -> str:
    """A figure as PNG in base64, the same text for the same figure."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=150, metadata={"Software": None})
    return base64.b64encode(buffer.getvalue()).decode()


def headline(results: Results) -> Any:
    """What the page begins with: for a trial what the package has, which is of the full chain."""
    shipped = SHIPPED / results["meta"]["machine"] / "table.json"
    trial = results["meta"]["effort"]["hours"] < 1 and shipped.exists()
    return json.loads(shipped.read_text("utf-8")) if trial else results


def render(results: Results, images: Mapping[str, str]) -> str:
    """The page, with PNG `images` in base64 by name."""
    text = Path(__file__).with_suffix(".html.j2").read_text("utf-8")
    page: Template = Template(text, autoescape=True, undefined=StrictUndefined)
    page.globals.update(columns=COLUMNS, title=title, rest=valves_at_rest)
    page.globals.update(interval=interval_text, verdict_rows=verdict_rows)
    first = headline(results)
    rows = [name for name in ROWS if name in first["table"]]
    return page.render(results=results, images=images, first=first, rows=rows)


# --- figures --------------------------------------------------------------------------------------


def draw_curves(ax: Axes, curves: Curves, xlabel: str, ylabel: str, title: str = "") -> None:
    """Curves with their labels, and titles of the axes with units."""
    for i, (label, (x, y)) in enumerate(curves.items()):
        line = LINES[i % len(LINES)]
        ax.plot(x, y, line, color=f"C{i}", label=TITLES.get(label, label), linewidth=1.1)
    ax.set(title=title, xlabel=xlabel, ylabel=ylabel)
    ax.grid(alpha=0.3)


def plot_over_time(dt: float, rows: Sequence[Row], share: bool = True) -> Figure:
    """Rows of plots over time, which `share` their scale, one for each of the row's labels."""
    figure = Figure((WIDTH, 2.6 * len(rows) + 0.3), layout="constrained")
    shape = len(rows), len(rows[0][0])
    axes = figure.subplots(*shape, squeeze=False, sharey="row" if share else "none")
    for row, (labels, curves) in zip(axes, rows, strict=True):
        for i, label in enumerate(labels):
            columns = {name: (dt * np.arange(1, len(y) + 1), y[:, i]) for name, y in curves.items()}
            draw_curves(row[i], columns, "time [s]", label)
    lines = axes[0, 0].get_legend_handles_labels()
    figure.legend(*lines, loc="outside upper center", ncols=3, fontsize="small")
    return figure


def plot_tests(machine: Machine, both: Mapping[str, Tests]) -> Figure:
    """Range and direction, coupling, and past movement; machine above nets. Paper: Fig. 2"""
    joint = machine.names[machine.driven[-1]]
    figure = Figure((WIDTH, 5.5), layout="constrained")
    axes = figure.subplots(2, 3, sharey="col")
    for row, (kind, tests) in zip(axes, both.items(), strict=True):
        for ax, (test, curves) in zip(row, tests.items(), strict=True):
            xlabel = "time after the step [s]" if test == "past movement" else f"{joint} [rad]"
            draw_curves(ax, curves, xlabel, f"velocity {joint} [rad/s]", f"{kind}: {test}")
            ax.legend(fontsize="small")
    return figure


def plot_gap(machine: Machine, gap: Gap) -> Figure:
    """Nets less machine under the same commands: tool, and a row for each joint. Paper: Fig. 5"""
    moved = {"tool": ("m", norm(gap.v_tool, axis=-1), norm(gap.p_tool, axis=-1))}
    moved |= {machine.names[i]: ("rad", gap.q_dot[..., i], gap.q[..., i]) for i in machine.driven}
    rows = []
    for name, (unit, velocity, position) in moved.items():
        values = np.stack([velocity, 1000 * position], axis=1)  # (T, 2, runs)
        curves = {"median of all runs": np.median(values, axis=-1), "first run": values[..., 0]}
        rows.append(([f"{name} [{unit}/s]", f"{name} [m{unit}]"], curves))
    return plot_over_time(machine.dt, rows, share=False)


def plot_errors(errors: Mapping[str, Mean]) -> Figure:
    """Mean velocity errors [m/s] with their intervals, a row for each controller."""
    figure = Figure(figsize=(WIDTH, 0.5 + 0.4 * len(errors)), layout="constrained")
    ax = figure.subplots()
    ends = [[error[key] for key in ("low", "mean", "high")] for error in errors.values()]
    low, mean, high = np.array(ends, float).T
    ax.errorbar(mean, range(len(errors)), xerr=[mean - low, high - mean], fmt="o", capsize=4)
    ax.set_yticks(range(len(errors)), [TITLES[name] for name in errors])
    ax.set(xlabel="mean velocity error [m/s]", xlim=(0, None), ylim=(len(errors) - 0.5, -0.5))
    ax.grid(alpha=0.3)
    return figure


def plot_starts(machine: Machine, starts: Array) -> Figure:
    """Start configurations drawn as arms, from the side and from above. Paper: Fig. 6a"""
    figure = Figure(figsize=(WIDTH, 4.6), layout="constrained")
    side, top = figure.subplots(1, 2)
    points = forward_kinematics(machine, starts).p  # (starts, points, 3)
    tool = points[:, -1, :2]
    outward = tool / np.maximum(norm(tool, axis=-1, keepdims=True), 1e-9)
    r = np.einsum("pjk,pk->pj", points[..., :2], outward)
    side.plot(r.T, points[..., 2].T, alpha=0.6)
    top.plot(points[..., 0].T, points[..., 1].T, alpha=0.6)
    side.axhline(machine.ground, color="black", linewidth=0.8)
    side.set(xlabel="outward from the slew axis [m]", ylabel="z [m]", aspect="equal")
    top.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    return figure


def plot_sequence(machine: Machine, traces: Traces, sequence: Commands, starts: Array) -> Figure:
    """Tool position and velocity along x, y, z of `SAMPLE` from the first start. Paper: Fig. 6"""
    goals = sequence.for_starts(machine, starts)[:, 0]
    p_start = tool_position(forward_kinematics(machine, starts[0]))
    positions, velocities = {"goal": machine.dt * np.cumsum(goals, axis=0)}, {"goal": goals}
    for name in SAMPLE:
        trace = traces[name, sequence.name]
        positions[name], velocities[name] = trace.p_tool[:, 0] - p_start, trace.v_tool[:, 0]
    above = [f"{axis} - {axis}(0) [m]" for axis in AXES], positions
    below = [f"velocity {axis} [m/s]" for axis in AXES], velocities
    return plot_over_time(machine.dt, [above, below])


def plot_joint_velocities(machine: Machine, traces: Traces, sequence: str) -> Figure:
    """Velocity of the driven joints of `SAMPLE` from the first start. Paper: Fig. 6d"""
    labels = [f"velocity {machine.names[i]} [rad/s]" for i in machine.driven]
    curves = {name: traces[name, sequence].q_dot[:, 0, machine.driven] for name in SAMPLE}
    return plot_over_time(machine.dt, [(labels, curves)])
