"""Figures: one style, units on every axis.

Controllers differ in brightness, dashes, markers and hatches: for grey prints and the colour-blind.
"""

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator
from numpy.linalg import norm

from brokk_min.actuator import ActuatorNet
from brokk_min.evaluation.metrics import AFTER_STOP, Mean, Traces
from brokk_min.evaluation.preliminary import Motion, SimulatorTests
from brokk_min.evaluation.rollout import TITLES
from brokk_min.evaluation.sequences import AXES, Commands, hold_table
from brokk_min.identification.files import whole_file
from brokk_min.identification.formats import NUMBERS, read_table
from brokk_min.identification.logs import Log, Recording
from brokk_min.identification.simulation import free_run
from brokk_min.identification.validation import recording_errors
from brokk_min.kinematics import UNITS, forward_kinematics, tool_position
from brokk_min.machine import Array, Machine

matplotlib.rcParams.update({"axes.grid": True, "grid.alpha": 0.3, "axes.axisbelow": True})
matplotlib.rcParams["hatch.linewidth"] = 0.4
WIDTH = 10.0  # inch, of every figure: letters have one size in the report
FREE_RUN_S = 30.0  # s, as in the paper

STYLES: dict[str, dict[str, Any]] = {
    "goal": {"color": "black", "linestyle": ":"},
    "rl": {"color": "#08306b"},
    "rl_dither": {"color": "#5b8fd0", "linestyle": (0, (6, 1))},
    "rl_paper": {"color": "#b2182b", "linestyle": (0, (1, 1))},
    "jacobian_pid_k0.1": {"color": "#d9661a", "linestyle": (0, (6, 1, 1, 1, 1, 1))},
    "jacobian_pid_k0.05": {"color": "#f0b84a", "linestyle": "--"},
    "jacobian_pid_ff": {"color": "#00886a", "linestyle": "-."},
    "jacobian_pid_ff_integral": {"color": "#7a4fa3", "linestyle": (0, (2, 1))},
    "jacobian_pid_ff_integral_dither": {"color": "#b39ad0", "linestyle": (0, (2, 2, 6, 2))},
    "perfect_model": {"color": "#c987b7"},
    "workspace": {"color": "#08306b"},
    "limits": {"color": "#d9661a"},
    "extended": {"color": "#f0b84a"},
}
MARKERS = dict(zip(STYLES, ".osD^v<>PX*", strict=False))
PATTERNS = ("", "", "///", "xxx", "\\\\\\", "---", "...", "|||", "+++", "ooo", "OO")
HATCHES = dict(zip(STYLES, PATTERNS, strict=False))
SAMPLE = ("rl", "rl_paper", "jacobian_pid_k0.1", "jacobian_pid_k0.05")  # of single paths
OTHER_STYLES: list[dict[str, Any]] = [
    {"color": "#08306b"},
    {"color": "#d9661a", "linestyle": "--"},
    {"color": "#00886a", "linestyle": "-."},
    {"color": "#f0b84a", "linestyle": (0, (4, 1, 1, 1, 1, 1))},
]


class Panel(NamedTuple):
    """One plot: title, labels of the axes with units, and curves (x, y) by label.

    Of y (T, runs) the median and a band from 10 to 90 % of the runs are drawn.
    """

    title: str
    xlabel: str
    ylabel: str
    curves: Mapping[str, tuple[Array, Array]]


def plot_panels(
    rows: Sequence[Sequence[Panel]], sharey: Literal["none", "row", "col"] = "none"
) -> Figure:
    """Rows of panels, under one legend where all have the same curves, else each under its own."""
    figure = Figure(figsize=(WIDTH, 2.6 * len(rows) + 0.3), layout="constrained")
    grid = figure.subplots(len(rows), len(rows[0]), squeeze=False, sharey=sharey)
    one_legend = len({tuple(panel.curves) for row in rows for panel in row}) == 1
    for axes, row in zip(grid, rows, strict=True):
        for ax, panel in zip(axes, row, strict=False):
            for i, (label, (x, y)) in enumerate(panel.curves.items()):
                style = STYLES.get(label, OTHER_STYLES[i % len(OTHER_STYLES)])
                if y.ndim == 2:
                    low, y, high = np.percentile(y, [10, 50, 90], axis=1)
                    ax.fill_between(x, low, high, color=style["color"], alpha=0.2, linewidth=0)
                ax.plot(x, y, label=TITLES.get(label, label), linewidth=1.1, **style)
            ax.set(xlabel=panel.xlabel, ylabel=panel.ylabel)
            if one_legend:
                ax.set_title(panel.title, fontsize="medium")
            else:
                place: dict[str, Any] = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0)}
                ax.legend(title=panel.title, frameon=False, ncol=2, **place)
        for ax in axes[len(row) :]:
            ax.remove()
    if one_legend:
        _add_legend(figure)
    return figure


def _add_legend(figure: Figure) -> None:
    handles, labels = figure.axes[0].get_legend_handles_labels()
    by_label = dict(zip(labels, handles, strict=True))
    columns = 3 if len(by_label) > 4 else 4
    figure.legend(by_label.values(), by_label.keys(), loc="outside upper center", ncol=columns)


def _time_panels(dt: float, labels: Sequence[str], curves: Mapping[str, Array]) -> list[Panel]:
    """One panel for each label: columns of curves (T, labels) or (T, labels, runs) over time."""
    panels = []
    for i, label in enumerate(labels):
        columns = {name: (dt * np.arange(1, len(y) + 1), y[:, i]) for name, y in curves.items()}
        panels.append(Panel("", "time [s]", label, columns))
    return panels


def plot_tests(machine: Machine, tests: Mapping[str, SimulatorTests]) -> Figure:
    """Range and direction, coupling, and past movement; machine above nets. Paper: Fig. 2"""
    name = machine.names[machine.driven[-1]]
    angle = f"{name} [rad]"
    velocity = f"velocity {name} [rad/s]"
    rows = []
    for kind, of_kind in tests.items():
        movement = of_kind.past_movement
        row = [
            Panel(f"{kind}: range and direction", angle, velocity, of_kind.sweeps),
            Panel(f"{kind}: coupling", angle, velocity, of_kind.coupling),
            Panel(f"{kind}: past movement", "time after the step [s]", velocity, movement),
        ]
        rows.append(row)
    return plot_panels(rows, sharey="col")


def plot_gap(machine: Machine, gap: Motion) -> Figure:
    """Nets less machine under the same commands: tool, and a row for each joint. Paper: Fig. 5"""
    rows = {"tool": ("m", norm(gap.v_tool, axis=-1), norm(gap.p_tool, axis=-1))}
    rows |= {machine.names[i]: ("rad", gap.q_dot[..., i], gap.q[..., i]) for i in machine.driven}
    panels = []
    for name, (unit, velocity, position) in rows.items():
        labels = [f"{name} [{unit}/s]", f"{name} [m{unit}]"]
        values = np.stack([velocity, 1000 * position], axis=1)
        curves = {"median of all runs": values, "first run": values[..., 0]}
        panels.append(_time_panels(machine.dt, labels, curves))
    return plot_panels(panels)


def plot_free_run(net: ActuatorNet, log: Log) -> Figure:
    """Measured and free-running angle and velocity of the joints that move in one recording."""
    recording = log.recordings[0]
    rows = _free_run(net, recording)
    return plot_panels([rows[j] for j in np.flatnonzero(recording.u.any(axis=0))])


def plot_worst_and_median(net: ActuatorNet, log: Log, machine: Machine | None = None) -> Figure:
    """The free runs with the worst and the median velocity error; of each its worst joint.

    A `machine` with prismatic joints tells which angles are in m.
    """
    errors = np.nan_to_num(recording_errors(net, log, FREE_RUN_S), nan=-1.0)
    largest = errors.max(axis=1)
    order = [i for i in np.argsort(largest) if largest[i] >= 0]
    rows = []
    for title, index in {"worst": order[-1], "median": order[(len(order) - 1) // 2]}.items():
        recording = log.recordings[index]
        row = _free_run(net, recording, machine)[errors[index].argmax()]
        rows.append([panel._replace(title=f"{title}: {recording.name}") for panel in row])
    return plot_panels(rows)


def _free_run(
    net: ActuatorNet, recording: Recording, machine: Machine | None = None
) -> list[list[Panel]]:
    """Angle and velocity of each joint, measured and in a free run."""
    ticks = min(round(FREE_RUN_S * net.rate), len(recording.q) - net.history - 1)
    q, q_dot = free_run(net, recording, np.array([net.history]), ticks)
    run = slice(net.history + 1, net.history + 1 + ticks)
    angles = {"measured": recording.q[run], "free run": q[:, 0]}
    velocities = {"measured": recording.q_dot[run], "free run": q_dot[:, 0]}
    units = {joint.name: UNITS[joint.kind] for joint in (machine.joints if machine else ())}
    labels = [(name, units.get(name, "rad")) for name in net.joints]
    left = _time_panels(1 / net.rate, [f"{name} [{unit}]" for name, unit in labels], angles)
    right = _time_panels(1 / net.rate, [f"{name} [{unit}/s]" for name, unit in labels], velocities)
    return [list(row) for row in zip(left, right, strict=True)]


def plot_learning(curve: Path) -> Figure:
    """Mean reward and velocity error of the exploring policy over environment steps."""
    labels = {"charts/reward": "reward per step", "charts/velocity_error": "velocity error [m/s]"}
    table = read_table(curve, dict.fromkeys(["global_step", *labels], NUMBERS))
    steps = table["global_step"] / 1e6
    xlabel = "environment steps [million]"
    panels = [Panel("", xlabel, label, {"rl": (steps, table[k])}) for k, label in labels.items()]
    return plot_panels([panels])


def plot_starts(machine: Machine, starts: Array, kinds: Sequence[str]) -> Figure:
    """Start configurations drawn as arms, from the side and from above. Paper: Fig. 6a"""
    figure = Figure(figsize=(WIDTH, 4.6), layout="compressed")
    side, top = figure.subplots(1, 2)
    points = forward_kinematics(machine, starts).p
    tool = points[:, -1, :2]
    outward = tool / np.maximum(np.linalg.norm(tool, axis=-1, keepdims=True), 1e-9)
    r = np.einsum("pjk,pk->pj", points[..., :2], outward)
    for i, kind in enumerate(kinds):
        label = None if kind in kinds[:i] else kind
        style = STYLES[kind] | {"linewidth": 1.0, "marker": "o", "markersize": 2, "alpha": 0.6}
        side.plot(r[i], points[i, :, 2], label=label, **style)
        top.plot(points[i, :, 0], points[i, :, 1], **style)
    side.axhline(machine.ground, color="black", linewidth=0.8)
    side.set(xlabel="outward from the slew axis [m]", ylabel="z [m]", aspect="equal")
    top.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    _add_legend(figure)
    return figure


def plot_sequence(
    machine: Machine, traces: Traces, sequence: Commands, start: Array, run: int
) -> Figure:
    """Tool position and velocity along x, y, z of `SAMPLE` in one run. Paper: Fig. 6"""
    starts = np.tile(start, (run + 1, 1))
    goals = sequence.for_starts(machine, starts)[:, run]
    p_start = tool_position(forward_kinematics(machine, start))
    positions = {"goal": machine.dt * np.cumsum(goals, axis=0)}
    velocities = {"goal": goals}
    for (controller, name), trace in traces.items():
        if name == sequence.name and controller in SAMPLE:
            positions[controller] = trace.p_tool[:, run] - p_start
            velocities[controller] = trace.v_tool[:, run]
    above = _time_panels(machine.dt, [f"{axis} - {axis}(0) [m]" for axis in AXES], positions)
    below = _time_panels(machine.dt, [f"velocity {axis} [m/s]" for axis in AXES], velocities)
    return plot_panels([above, below], sharey="row")


def plot_joint_velocities(machine: Machine, traces: Traces, sequence: str, run: int) -> Figure:
    """Velocity of the driven joints of `SAMPLE` in one run. Paper: Fig. 6d"""
    labels = [f"velocity {machine.names[i]} [rad/s]" for i in machine.driven]
    curves = {}
    for (controller, name), trace in traces.items():
        if name == sequence and controller in SAMPLE:
            curves[controller] = trace.q_dot[:, run, machine.driven]
    panels = _time_panels(machine.dt, labels, curves)
    return plot_panels([panels[i : i + 2] for i in range(0, len(panels), 2)])


def plot_position_error(
    machine: Machine, traces: Traces, sequence: Commands, starts: Array, controllers: Sequence[str]
) -> Figure:
    """Motion along an axis, and the tool's distance from where the goals lead; from all starts."""
    axis = AXES.index(sequence.name)
    moved = machine.dt * np.cumsum(sequence.for_starts(machine, starts), axis=0)
    sign = np.sign(moved.sum(axis=0)[:, axis])  # inward goals are negative from some starts
    time = machine.dt * np.arange(1, len(moved) + 1)
    motion, error = {"goal": (time, sign * moved[..., axis])}, {}
    for name in controllers:
        p = traces[name, sequence.name].p_tool - tool_position(forward_kinematics(machine, starts))
        motion[name] = time, sign * p[..., axis]
        error[name] = time, 1000 * norm(moved - p, axis=-1)
    along = Panel("", "time [s]", f"motion along {sequence.name} [m]", motion)
    figure = plot_panels([[along, Panel("", "time [s]", "position error [mm]", error)]])
    figure.axes[1].set(yscale="log", ylim=(1, None))
    figure.axes[1].yaxis.set_major_formatter("{x:g}")
    return figure


def plot_rest(
    machine: Machine, traces: Traces, sequence: Commands, controllers: Sequence[str]
) -> Figure:
    """How far each driven joint goes in the longest rest from where it was 1 s after the stop."""
    rows = hold_table(machine, sequence.goals)  # of seconds and goal
    ends = np.rint(machine.rate * rows[:, 0].cumsum()).astype(int)
    longest = 1 + np.argmax(rows[1:, 0] * ~rows[1:, 1:].any(axis=1))  # the first follows no motion
    rest = slice(ends[longest - 1] + round(AFTER_STOP * machine.rate) - 1, ends[longest])
    panels = []
    for joint in machine.driven:
        curves = {}
        for name in controllers:
            q = traces[name, sequence.name].q[rest, :, joint]
            curves[name] = machine.dt * np.arange(len(q)), 1000 * np.abs(q - q[0])
        panels.append(Panel(machine.names[joint], "time at rest [s]", "motion [mrad]", curves))
    return plot_panels([panels], sharey="row")


def plot_intervals(panels: Mapping[str, Mapping[str, Mapping[str, Mean]]]) -> Figure:
    """Means and 95 % intervals by x label of the panel, row and controller.

    As rliable draws them: Agarwal et al. 2021, "Deep RL at the edge of the statistical precipice".
    """
    rows = next(iter(panels.values()))
    most = max(map(len, rows.values()))
    figure = Figure(figsize=(WIDTH, len(rows) * (0.15 + 0.09 * most) + 1.0), layout="constrained")
    grid = figure.subplots(1, len(panels), squeeze=False, sharey=True)[0]
    for ax, (xlabel, of_rows) in zip(grid, panels.items(), strict=True):
        ax.use_sticky_edges = False  # a margin left of the bars
        for i, row in enumerate(of_rows.values()):
            for k, (name, number) in enumerate(row.items()):
                y = i + 0.8 * ((k + 0.5) / len(row) - 0.5)
                mean, low, high = (np.array(number[key], float) for key in ("mean", "low", "high"))
                color, height = STYLES[name]["color"], 0.6 / len(row)
                bar = {"color": color, "hatch": 2 * HATCHES[name], "edgecolor": "white"}
                ax.barh(y, high - low, height, low, linewidth=0, **bar)
                mark = {"color": color, "marker": MARKERS[name], "markeredgecolor": "black"}
                ax.plot(mean, y, label=TITLES.get(name, name), linestyle="", markersize=5, **mark)
        ax.set_yticks(range(len(rows)), [TITLES.get(row, row) for row in rows])
        ax.set(xlabel=xlabel, ylim=(len(rows) - 0.5, -0.5))
        means = [number["mean"] or np.nan for row in of_rows.values() for number in row.values()]
        if np.nanmax(means) > 8 * np.nanmin(means) > 0:
            ax.set_xscale("log")
            ax.xaxis.set_major_locator(LogLocator(subs=(1, 3)))
            ax.xaxis.set_major_formatter("{x:g}")
            ax.xaxis.set_minor_formatter("")
        else:
            ax.set_xlim(left=min(0.0, ax.get_xlim()[0]))
    if most > 1:
        _add_legend(figure)
    return figure


def png(figure: Figure) -> bytes:
    """A figure as PNG, the same bytes for the same figure."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=150, metadata={"Software": None})
    return buffer.getvalue()


def save(path: Path, figure: Figure) -> None:
    """Write a figure as PNG."""
    with whole_file(path) as file:
        file.write(png(figure))
