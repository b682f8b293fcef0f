"""Figures and the report page; the only module that plots. One style, units on every axis.

Colours differ in brightness too, for paper and for the colour-blind.
"""

import base64
import html
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from tqdm import tqdm

from brokk_min import actuator, kinematics
from brokk_min.evaluation.metrics import Mean, Traces
from brokk_min.evaluation.rollout import Trace
from brokk_min.evaluation.sequences import AXES, Commands
from brokk_min.identification import files, logs
from brokk_min.identification import validation as scores
from brokk_min.machine import Array, Machine

matplotlib.use("Agg")
import matplotlib.pyplot as plt

plt.rcParams.update({"font.size": 10, "axes.grid": True, "grid.alpha": 0.3, "axes.axisbelow": True})
WIDTH = (
    10.0  # inch, of every figure: so letters are of one size in the report, on A4 paper 7 points
)
DPI = 150  # for paper
FREE_S = 30.0  # s of free runs that are drawn, as the paper's

# Brightness of its own for each of those that stand in one plot: they differ on grey paper too.
STYLES: dict[str, dict[str, Any]] = {
    "wanted": {"color": "black", "linestyle": ":"},
    "rl": {"color": "#08306b"},
    "jacobian_pid_k0.1": {"color": "#d9661a"},
    "jacobian_pid_k0.05": {"color": "#f0b84a", "linestyle": "--"},
    "jacobian_pid_ff": {"color": "#00886a", "linestyle": "-."},
    "jacobian_pid_ff_awake": {"color": "#6fbf9b", "linestyle": (0, (4, 1, 1, 1))},
    "perfect_model": {"color": "#c987b7"},
    "workspace": {"color": "#08306b"},
    "limits": {"color": "#d9661a"},
    "extended": {"color": "#f0b84a"},
}
# Curves without a style of their own; dashed where one may hide another.
OTHERS: list[dict[str, Any]] = [
    {"color": "#08306b"},
    {"color": "#d9661a", "linestyle": "--"},
    {"color": "#00886a", "linestyle": "-."},
    {"color": "#f0b84a", "linestyle": (0, (4, 1, 1, 1, 1, 1))},
]


TIGHT = {
    "frameon": False,
    "borderpad": 0.2,
    "columnspacing": 0.9,
    "handlelength": 1.6,
    "handletextpad": 0.4,
}


class Panel(NamedTuple):
    """One plot: title, axes' labels with units, and curves (x, y) by label."""

    title: str
    xlabel: str
    ylabel: str
    curves: Mapping[str, Array | tuple[Array, Array]]


def plot_panels(rows: Sequence[Sequence[Panel]], one_scale: bool = False) -> Any:
    """Rows of panels; under one legend where all show the same curves, otherwise each under its own.

    Panels of a column that show the same quantity have one y axis; with `one_scale` those of a row, too.
    """
    high, wide = len(rows), max(map(len, rows))
    figure = plt.figure(figsize=(WIDTH, 2.6 * high + 0.3), layout="constrained")
    grid = figure.subplots(high, wide, squeeze=False, sharey="row" if one_scale else "none")
    alike = len({tuple(panel.curves) for panels in rows for panel in panels}) == 1
    for k, (axes, panels) in enumerate(zip(grid, rows, strict=True)):
        for ax, above, panel in zip(axes, grid[0], panels, strict=False):
            for i, (label, (x, y)) in enumerate(panel.curves.items()):
                ax.plot(
                    x, y, label=label, linewidth=1.1, **STYLES.get(label, OTHERS[i % len(OTHERS)])
                )
            ax.set(xlabel=panel.xlabel, ylabel=panel.ylabel)
            lines = 0 if alike else _legend_above(ax, most=2 if wide > 2 else 4)
            ax.set_title(panel.title, fontsize="medium", pad=6 + 16 * lines)
            if k and above.get_ylabel() == panel.ylabel:
                ax.sharey(above)
                ax.autoscale()
        for ax in axes[len(panels) :]:
            ax.remove()
    return _with_legend(figure, grid[0, 0]) if alike else figure


def _legend_above(ax: Any, most: int) -> int:
    """A legend above the curves, where it hides none, with at most so many entries a line: its lines."""
    entries = len(ax.get_legend_handles_labels()[1])
    ax.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncol=min(entries, most), **TIGHT)
    return -(-entries // most)


def _over_time(dt: float, labels: Sequence[str], curves: Mapping[str, Array]) -> list[Panel]:
    """A panel for each label: columns of curves (T, labels) over time."""
    return [
        Panel(
            "",
            "time [s]",
            label,
            {n: (dt * np.arange(1, len(y) + 1), y[:, i]) for n, y in curves.items()},
        )
        for i, label in enumerate(labels)
    ]


def _with_legend(figure: Any, ax: Any) -> Any:
    figure.legend(*ax.get_legend_handles_labels(), loc="outside upper center", ncol=5)
    return figure


def _during(traces: Traces, sequence: Commands) -> dict[str, Trace]:
    return {name: trace for (name, other), trace in traces.items() if other == sequence.name}


def plot_sequence(
    machine: Machine, traces: Traces, sequence: Commands, start: Array, run: int
) -> Any:
    """Tool position and velocity along x, y, z of all controllers in one run. Paper: Fig. 6"""
    first, goals = (
        kinematics.tool_position(kinematics.forward_kinematics(machine, start)),
        sequence.for_starts(run + 1)[:, run],
    )
    p, v = {"wanted": np.cumsum(goals, axis=0) * machine.dt}, {"wanted": goals}
    for name, trace in _during(traces, sequence).items():
        p[name], v[name] = trace.p_tool[:, run] - first, trace.v_tool[:, run]
    rows = (([f"{a} - {a}(0) [m]" for a in AXES], p), ([f"velocity {a} [m/s]" for a in AXES], v))
    return plot_panels([_over_time(machine.dt, *row) for row in rows], one_scale=True)


def plot_joint_rates(machine: Machine, traces: Traces, sequence: Commands, run: int) -> Any:
    """Velocity of the driven joints of all controllers in one run. Paper: Fig. 6d"""
    labels = [f"velocity {machine.names[i]} [rad/s]" for i in machine.driven]
    rates = {name: t.q_dot[:, run, machine.driven] for name, t in _during(traces, sequence).items()}
    panels = _over_time(machine.dt, labels, rates)
    return plot_panels([panels[i : i + 2] for i in range(0, len(panels), 2)])


def plot_free_run(net: actuator.ActuatorNet, log: logs.Log) -> Any:
    """Recorded and free-running angle and velocity of the joints that move in one unseen recording."""
    recording = log.recordings[0]
    of_joints = [_over_time(1 / net.rate, *row) for row in _free_run(net, recording)]
    rows = zip(recording.u.T, *of_joints, strict=True)
    return plot_panels([panels for u, *panels in rows if u.any()])


def _free_run(net: actuator.ActuatorNet, recording: logs.Recording) -> Any:
    """Labels and curves (T, joints) of angles, then of velocities, recorded and run freely."""
    ticks = min(round(FREE_S * net.rate), len(recording.q) - net.history - 1)
    free = scores.free_run(net, recording, np.array([net.history]), ticks)
    later = slice(net.history + 1, net.history + 1 + ticks)
    for real, own, unit in zip((recording.q, recording.q_dot), free, ("rad", "rad/s"), strict=True):
        yield (
            [f"{joint} [{unit}]" for joint in net.joints],
            {"measured": real[later], "free run": own[:, 0]},
        )


def plot_learning(curve: Path) -> Any:
    """Mean reward and velocity error of the exploring policy over environment steps."""
    labels = {"charts/reward": "reward a step [1]", "charts/velocity_error": "velocity error [m/s]"}
    table = files.read_table(curve, ["global_step", *labels])
    steps, wide = table["global_step"] / 1e6, "environment steps [million]"
    return plot_panels(
        [[Panel("", wide, label, {"rl": (steps, table[k])}) for k, label in labels.items()]]
    )


Bars = Mapping[str, Mapping[str, Mean]]  # by controller and sequence


def plot_bars(panels: Mapping[str, Bars]) -> Any:
    """Means with their 95 % intervals of each controller on each sequence; panels by the label of their y."""
    figure = plt.figure(figsize=(WIDTH, 2.8 * len(panels)), layout="constrained")
    axes = figure.subplots(len(panels), 1, squeeze=False)[:, 0]
    for ax, (label, bars) in zip(axes, panels.items(), strict=True):
        names, width = list(next(iter(bars.values()))), 0.8 / len(bars)
        for i, (controller, rows) in enumerate(bars.items()):
            mean, low, high = (
                np.array([rows[s][k] or 0.0 for s in names]) for k in ("mean", "low", "high")
            )
            ends = np.array([mean - low, high - mean]) * [rows[s]["low"] is not None for s in names]
            places = np.arange(len(names)) + (i - (len(bars) - 1) / 2) * width
            color = STYLES[controller]["color"]
            ax.bar(
                places,
                mean,
                width,
                yerr=ends,
                label=controller,
                color=color,
                error_kw={"linewidth": 0.8},
            )
        ax.set_xticks(np.arange(len(names)), [name.replace("_", "\n") for name in names])
        ax.set_ylabel(label)
        ax.grid(False, axis="x")
    return _with_legend(figure, axes[0])


def plot_starts(machine: Machine, starts: Array, kinds: Sequence[str]) -> Any:
    """Start configurations drawn as arms, from the side and from above. Paper: Fig. 6a"""
    figure, axes = plt.subplots(1, 2, figsize=(WIDTH, 4.6), layout="compressed")
    points = kinematics.forward_kinematics(machine, starts).p
    heading = points[:, -1, :2] / np.maximum(
        np.linalg.norm(points[:, -1, :2], axis=-1, keepdims=True), 1e-9
    )
    outward = np.einsum("pjk,pk->pj", points[..., :2], heading)
    for i, kind in enumerate(kinds):
        label = None if kind in kinds[:i] else kind
        style = STYLES[kind] | {"linewidth": 1.0, "marker": "o", "markersize": 2, "alpha": 0.6}
        axes[0].plot(outward[i], points[i, :, 2], label=label, **style)
        axes[1].plot(points[i, :, 0], points[i, :, 1], **style)
    axes[0].axhline(machine.ground, color="black", linewidth=0.8)
    axes[0].set(xlabel="outward from the slew axis [m]", ylabel="z [m]", aspect="equal")
    axes[1].set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    return _with_legend(figure, axes[0])


def plot_worst_and_median(net: actuator.ActuatorNet, log: logs.Log) -> Any:
    """Measured and free-running curves of the recordings with the worst and the median velocity error.

    Of each the joint with the largest error.
    """
    errors = np.nan_to_num(scores.recording_errors(net, log, FREE_S), nan=-1.0)
    order = [i for i in np.argsort(errors.max(axis=1)) if errors[i].max() >= 0]
    rows = []
    for title, place in (("worst", -1), ("median", (len(order) - 1) // 2)):
        index, joint = order[place], int(errors[order[place]].argmax())
        of_joints = [
            _over_time(1 / net.rate, *row) for row in _free_run(net, log.recordings[index])
        ]
        name = f"{title}: {log.recordings[index].name}"
        rows.append([panels[joint]._replace(title=name) for panels in of_joints])
    return plot_panels(rows)


def save(path: Path, figure: Any) -> None:
    """Write a figure as PNG, the same bytes for the same figure."""
    with files.whole_file(path) as file:
        figure.savefig(file, format="png", dpi=DPI, metadata={"Software": None})
    plt.close(figure)


# --- the report -------------------------------------------------------------------------------------

STYLE = """body{font:15px/1.45 sans-serif;max-width:1100px;margin:2em auto;padding:0 1em}
table{border-collapse:collapse;margin:1em 0}td,th{border:1px solid #bbb;padding:.25em .6em;text-align:right}
td:first-child,th:first-child,.wide{text-align:left}td{white-space:nowrap}.wide{white-space:normal}
blockquote{margin:1em 0;padding:.1em 1em;border-left:4px solid #08306b;background:#f3f5f8}
blockquote p{margin:.5em 0}img{max-width:100%}
@media print{body{font-size:11px}h2{break-after:avoid}img,tr,blockquote{break-inside:avoid}}"""


class Quote(NamedTuple):
    """A sentence of the paper, and lines of what was measured and the verdict."""

    paper: str
    lines: Sequence[tuple[str, str]]


def write_report(path: Path, parts: Sequence[tuple[Any, ...]], clock: Mapping[str, float]) -> None:
    """One page by itself; a part is a title, a sentence, and more sentences, quotes, tables
    {row: {column: cell}} or figures."""
    page = [
        f"<!doctype html><meta charset=utf-8><title>brokk_min report</title><style>{STYLE}</style>",
        "<h1>Task space control with reinforcement learning: what was measured</h1>",
        "<p>The machine here is an analytic plant, not a real Brokk 170. The policy was trained on nets "
        "fitted to its logs and never saw its equations.</p>",
        "<p>Seconds spent: " + ", ".join(f"{k} {v:.0f}" for k, v in clock.items()) + ".</p>",
    ]
    for title, sentence, *contents in tqdm(parts, desc="draw", unit="part", disable=None):
        page.append(f"<h2>{html.escape(title)}</h2><p>{html.escape(sentence)}</p>")
        page += [_content(title, content) for content in contents]
    with files.whole_file(path, "w") as file:
        file.write("\n".join(page) + "\n")


def _content(title: str, content: Any) -> str:
    if isinstance(content, str):
        return f"<p>{html.escape(content)}</p>"
    if isinstance(content, Quote):
        pairs = ((html.escape(text), html.escape(verdict)) for text, verdict in content.lines)
        lines = (f"<p><b>Measured:</b> {text}. <b>{verdict}</b></p>" for text, verdict in pairs)
        return f"<blockquote><p><b>Paper:</b> {html.escape(content.paper)}</p>{''.join(lines)}</blockquote>"
    return _table(content) if isinstance(content, Mapping) else _image(title, content)


def _table(rows: Mapping[str, Mapping[str, Any]]) -> str:
    def line(tag: str, cells: Sequence[Any]) -> str:
        texts = (
            "" if c is None else f"{c:.4g}" if isinstance(c, float) else html.escape(str(c))
            for c in cells
        )
        wide = (
            (" class=wide" if len(text) > 40 else "", text.replace("_", "_<wbr>")) for text in texts
        )
        parts = (f"<{tag}{kind}>{text}</{tag}>" for kind, text in wide)
        return "<tr>" + "".join(parts) + "</tr>"

    head = line("th", ["", *next(iter(rows.values()))])
    return f"<table>{head}{''.join(line('td', [name, *row.values()]) for name, row in rows.items())}</table>"


def _image(title: str, figure: Any) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=DPI, metadata={"Software": None})
    plt.close(figure)
    image = base64.b64encode(buffer.getvalue()).decode()
    return f"<img alt='{html.escape(title)}' src='data:image/png;base64,{image}'>"
