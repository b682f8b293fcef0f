"""The paper's figures, with units on every axis.

Controllers differ in colour and in dashes, so that the colour-blind tell them apart, too.
"""

from collections.abc import Mapping, Sequence
from itertools import chain
from typing import Literal, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.linalg import norm

from brokk_min.evaluation.metrics import Mean, Traces
from brokk_min.evaluation.preliminary import Motion, SimulatorTests
from brokk_min.evaluation.rollout import TITLES, Trace
from brokk_min.evaluation.sequences import AXES, Commands
from brokk_min.kinematics import forward_kinematics, tool_position
from brokk_min.machine import Array, Machine

WIDTH = 10.0  # inch, of every figure, so that letters have one size in the report
LINES = ("-", "--", "-.", ":")
SAMPLE = ("rl_paper", "rl_critic", "pid_by_hand", "jacobian_pid_k0.1")  # drawn in Fig. 6


class Panel(NamedTuple):
    """One plot: title, labels of the axes with units, and curves (x, y) by label."""

    title: str
    xlabel: str
    ylabel: str
    curves: Mapping[str, tuple[Array, Array]]


def plot_panels(
    rows: Sequence[Sequence[Panel]], sharey: Literal["none", "row", "col"] = "none"
) -> Figure:
    """Rows of panels, each with a legend unless it has the same curves as the panel before."""
    figure = Figure(figsize=(WIDTH, 2.6 * len(rows) + 0.3), layout="constrained")
    grid = figure.subplots(len(rows), len(rows[0]), squeeze=False, sharey=sharey)
    known: list[str] = []
    for ax, panel in zip(grid.flat, chain(*rows), strict=True):
        for i, (label, (x, y)) in enumerate(panel.curves.items()):
            line = LINES[i % len(LINES)]
            ax.plot(x, y, line, color=f"C{i}", label=TITLES.get(label, label), linewidth=1.1)
        ax.set(title=panel.title, xlabel=panel.xlabel, ylabel=panel.ylabel)
        ax.grid(alpha=0.3)
        if list(panel.curves) != known:
            ax.legend(fontsize="small")
            known = list(panel.curves)
    return figure


def _over_time(dt: float, labels: Sequence[str], curves: Mapping[str, Array]) -> list[Panel]:
    """One panel for each label: columns of curves (T, labels) over time."""
    panels = []
    for i, label in enumerate(labels):
        columns = {name: (dt * np.arange(1, len(y) + 1), y[:, i]) for name, y in curves.items()}
        panels.append(Panel("", "time [s]", label, columns))
    return panels


def plot_tests(machine: Machine, tests: Mapping[str, SimulatorTests]) -> Figure:
    """Range and direction, coupling, and past movement; machine above nets. Paper: Fig. 2"""
    name = machine.names[machine.driven[-1]]
    angle, velocity = f"{name} [rad]", f"velocity {name} [rad/s]"
    rows = [
        [
            Panel(f"{kind}: range and direction", angle, velocity, of.sweeps),
            Panel(f"{kind}: coupling", angle, velocity, of.coupling),
            Panel(f"{kind}: past movement", "time after the step [s]", velocity, of.past_movement),
        ]
        for kind, of in tests.items()
    ]
    return plot_panels(rows, sharey="col")


def plot_gap(machine: Machine, gap: Motion) -> Figure:
    """Nets less machine under the same commands: tool, and a row for each joint. Paper: Fig. 5"""
    rows = {"tool": ("m", norm(gap.v_tool, axis=-1), norm(gap.p_tool, axis=-1))}
    rows |= {machine.names[i]: ("rad", gap.q_dot[..., i], gap.q[..., i]) for i in machine.driven}
    panels = []
    for name, (unit, velocity, position) in rows.items():
        labels = [f"{name} [{unit}/s]", f"{name} [m{unit}]"]
        values = np.stack([velocity, 1000 * position], axis=1)  # (T, 2, runs)
        curves = {"median of all runs": np.median(values, axis=-1), "first run": values[..., 0]}
        panels.append(_over_time(machine.dt, labels, curves))
    return plot_panels(panels)


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


def of_sample(traces: Traces, sequence: str) -> dict[str, Trace]:
    """Traces of the controllers of `SAMPLE` along one sequence."""
    return {c: trace for (c, name), trace in traces.items() if name == sequence and c in SAMPLE}


def plot_sequence(
    machine: Machine, traces: Traces, sequence: Commands, start: Array, run: int
) -> Figure:
    """Tool position and velocity along x, y, z of `SAMPLE` in one run. Paper: Fig. 6"""
    goals = sequence.for_starts(machine, start[None])[:, 0]
    p_start = tool_position(forward_kinematics(machine, start))
    positions, velocities = {"goal": machine.dt * np.cumsum(goals, axis=0)}, {"goal": goals}
    for controller, trace in of_sample(traces, sequence.name).items():
        positions[controller] = trace.p_tool[:, run] - p_start
        velocities[controller] = trace.v_tool[:, run]
    above = _over_time(machine.dt, [f"{axis} - {axis}(0) [m]" for axis in AXES], positions)
    below = _over_time(machine.dt, [f"velocity {axis} [m/s]" for axis in AXES], velocities)
    return plot_panels([above, below], sharey="row")


def plot_joint_velocities(machine: Machine, traces: Traces, sequence: str, run: int) -> Figure:
    """Velocity of the driven joints of `SAMPLE` in one run. Paper: Fig. 6d"""
    labels = [f"velocity {machine.names[i]} [rad/s]" for i in machine.driven]
    sample = of_sample(traces, sequence)
    curves = {name: trace.q_dot[:, run, machine.driven] for name, trace in sample.items()}
    return plot_panels([_over_time(machine.dt, labels, curves)], sharey="row")
