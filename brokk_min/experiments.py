"""The paper's experiment as numbers, figures and a report; the only module that plots.

`task_space` runs every controller on the same starts and velocity sequences on the same machine.
Sequences and starts that score are never used for tuning; `tuning_goals` makes the others.
"""

from __future__ import annotations

import base64
import csv
import html
import io
import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from brokk_min.actuator import (
    ActuatorNet,
    FitConfig,
    collect,
    fit,
    free_run,
    save_net,
    score,
    speed_limits,
    task_log,
)
from brokk_min.env import Controller, TaskConfig, Trace, draw_goal, draw_pose, rollout
from brokk_min.jacobian import (
    Gains,
    JacobianController,
    dls,
    limit_weights,
    manipulability_threshold,
    steady_map,
    tune,
    unpack_gains,
)
from brokk_min.kinematics import jacobian, tool_state
from brokk_min.logs import Log, Recording, read_log, read_table, velocity_of, whole_file, write_log
from brokk_min.machine import Machine
from brokk_min.policy import PolicyController

matplotlib.use("Agg")
import matplotlib.pyplot as plt

Array = NDArray[np.floating[Any]]
AXES = "xyz"
# One axis of the paper's experiment: seconds and velocity [m/s] (assumed), with changes of direction.
PATTERN = ((1, 0.0), (4, 0.2), (1, 0.0), (4, -0.2), (1, 0.0), (3, 0.1), (3, -0.1), (1, 0.0))


class Commands(NamedTuple):
    """A named sequence of wanted tool velocities [m/s] at the control rate, (T, 3)."""

    name: str
    goals: Array


def axis_sequences(machine: Machine) -> list[Commands]:
    """One sequence along x, one along y, one along z. Paper: Fig. 6"""
    profile = np.concatenate([np.full(round(s * machine.rate), v) for s, v in PATTERN])
    return [Commands(name, np.outer(profile, np.eye(3)[i])) for i, name in enumerate(AXES)]


def read_commands(path: Path, machine: Machine) -> list[Commands]:
    """Sequences of a CSV `sequence,time,vx,vy,vz` [s, m/s], each value held until the next row.

    The last row of a sequence marks its end.
    """
    table = read_table(path, ["sequence", "time", "vx", "vy", "vz"], text=("sequence",))
    result = []
    for name in dict.fromkeys(table["sequence"]):
        rows = np.flatnonzero(table["sequence"] == name)
        time = table["time"][rows] - table["time"][rows[0]]
        if len(rows) < 2 or not (np.diff(time) > 0).all():
            raise ValueError(f"{path}: sequence {name}: expected two or more rows with rising time")
        if round(time[-1] * machine.rate) < 1 or name == "all":
            raise ValueError(f"{path}: sequence {name}: expected a tick or more and another name than all")
        at = np.searchsorted(time, np.arange(round(time[-1] * machine.rate)) / machine.rate + 1e-6, "right")
        goals = np.stack([table[c][rows][at - 1] for c in ("vx", "vy", "vz")], axis=1)
        result.append(Commands(str(name), goals))
    return result


def read_starts(path: Path, machine: Machine) -> Array:
    """Start poses of a CSV with one column a joint [rad], shape (starts, n).

    Raises:
        ValueError: an angle outside its joint's range, with file, row and column.
    """
    table = read_table(path, list(machine.names))
    starts = np.stack([table[name] for name in machine.names], axis=1)
    low, high = machine.column("q_min"), machine.column("q_max")
    bad = np.argwhere((starts < low) | (starts > high))
    if len(bad):
        row, joint = bad[0]
        raise ValueError(
            f"{path}: row {row + 2}, column {machine.names[joint]}: expected {low[joint]} to "
            f"{high[joint]} rad, got {starts[row, joint]}"
        )
    return starts


def feasible(machine: Machine, start: Array, goals: Array) -> NDArray[np.bool_]:
    """Can ideal actuators follow `goals` (T, num, 3) from `start` (num, n)? Shape (num,).

    Integrates lightly damped resolved rates with joint-limit weights: the tool must stay within 20 mm
    of its path, joints 0.05 rad off their limits and below 0.9 of their steady speed at the command
    limit in that direction at that angle, the arm 0.1 m off the ground.
    """
    q, driven = np.array(start, float), machine.driven
    low, high = machine.column("q_min")[driven] + 0.05, machine.column("q_max")[driven] - 0.05
    wanted, lowest = tool_state(machine, q, 0 * q)[::2]
    good, rates = lowest > machine.ground + 0.1, np.zeros_like(q)
    for goal in goals:
        p, _, lowest = tool_state(machine, q, rates)
        J = jacobian(machine, q)
        inverse = dls(J, limit_weights(machine, q, rates)[:, driven], np.full(len(q), 1e-4))
        rates = np.zeros_like(q)
        rates[:, driven] = (inverse @ (goal + (wanted - p))[..., None])[..., 0]
        q, wanted = q + rates * machine.dt, wanted + goal * machine.dt
        inside = ((q[:, driven] > low) & (q[:, driven] < high)).all(-1)
        down, up = speed_limits(machine, q)
        slow = ((rates > 0.9 * down) & (rates < 0.9 * up))[:, driven].all(-1)
        near = np.linalg.norm(wanted - p, axis=-1) < 0.02
        good &= inside & slow & near & (lowest > machine.ground + 0.1)
    return good


def draw_starts(machine: Machine, sequences: Sequence[Commands], num: int, rng: np.random.Generator) -> Array:
    """Random poses from which ideal actuators could follow all sequences, (num, n) [rad].

    Raises:
        ValueError: too few such poses.
    """
    found: list[Array] = []
    for _ in range(60):
        q = draw_pose(machine, TaskConfig(), rng, 400)
        for sequence in sequences:
            if len(q):
                q = q[feasible(machine, q, np.repeat(sequence.goals[:, None], len(q), axis=1))]
        found += list(q)
        if len(found) >= num:
            return np.array(found[:num])
    raise ValueError(f"starts: expected {num} feasible poses for {machine.name}, got {len(found)}")


def tuning_goals(machine: Machine, runs: int, seconds: float, seed: int) -> tuple[Array, Array]:
    """Feasible starts (runs, n) and goals (T, runs, 3) drawn like the policy's: for tuning only."""
    rng, ticks = np.random.default_rng(seed), round(seconds * machine.rate)
    starts: list[Array] = []
    goals: list[Array] = []
    for _ in range(60):
        pose = draw_pose(machine, TaskConfig(), rng, 200)
        holds = rng.uniform(1, 4, (200, ticks))
        changes = np.cumsum(holds, axis=1) * machine.rate
        index = np.array([np.searchsorted(row, np.arange(ticks), "right") for row in changes])
        drawn = draw_goal(machine, TaskConfig(), rng, 200 * ticks).reshape(200, ticks, 3)
        goal = np.take_along_axis(drawn, index[..., None], axis=1).swapaxes(0, 1)
        good = feasible(machine, pose, goal)
        starts += list(pose[good])
        goals += list(goal[:, good].swapaxes(0, 1))
        if len(starts) >= runs:
            return np.array(starts[:runs]), np.array(goals[:runs]).swapaxes(0, 1)
    raise ValueError(f"tuning: expected {runs} feasible runs for {machine.name}, got {len(starts)}")


# --- controllers ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Effort:
    """How much is spent; the quick chain has the same parts, smaller."""

    hours: float = 1.0
    fit_steps: int = 4000
    train_steps: int = 5_000_000
    generations: int = 12
    tuning_runs: int = 12
    starts: int = 16


QUICK = Effort(0.1, 700, 200_000, 2, 4, 4)


def tuned_baselines(
    machine: Machine, net: ActuatorNet, effort: Effort, seed: int
) -> dict[str, JacobianController]:
    """The paper's two baselines and one with feed-forward, each tuned on the machine itself.

    The cost is the figure that is scored, mean |v_goal - v_tool|, on `tuning_goals`. Tuning on the
    machine favours the baselines: the policy never sees it. Paper: Sec. 4.2
    """
    start, goals = tuning_goals(machine, effort.tuning_runs, 12.0, seed + 1000)

    def cost(controller: JacobianController, candidates: int) -> Array:
        runs = len(start)
        gains = type(controller.gains)(*(np.repeat(g, runs, axis=0) for g in controller.gains))
        trace = rollout(
            machine,
            replace(controller, gains=gains),
            np.tile(start, (candidates, 1)),
            np.tile(goals, (1, candidates, 1)),
            TaskConfig(),
            np.random.default_rng(seed),
        )
        error = np.linalg.norm(np.tile(goals, (1, candidates, 1)) - trace.v_tool, axis=-1)
        return error.mean(0).reshape(candidates, runs).mean(1)

    plain = _untuned(machine, net)
    return {name: tune(c, cost, seed, effort.generations, name) for name, c in plain.items()}


def _untuned(machine: Machine, net: ActuatorNet) -> dict[str, JacobianController]:
    w0 = manipulability_threshold(machine)
    zero = unpack_gains(np.zeros(3 * len(machine.driven) + 1), len(machine.driven))
    return {
        "jacobian_pid_k0.1": JacobianController(machine, zero, 0.1, w0),
        "jacobian_pid_k0.05": JacobianController(machine, zero, 0.05, w0),
        "jacobian_pid_ff": JacobianController(machine, zero, 0.1, w0, steady_map(machine, net)),
    }


def plain_gains(baselines: Mapping[str, JacobianController]) -> dict[str, dict[str, Any]]:
    """Gains of each baseline as lists, for JSON."""
    return {
        name: {key: np.asarray(value).tolist() for key, value in c.gains._asdict().items()}
        for name, c in baselines.items()
    }


def read_gains(path: Path, machine: Machine, net: ActuatorNet) -> dict[str, JacobianController]:
    """The baselines with gains that `reproduce` wrote.

    Raises:
        ValueError: no such file, or gains of other controllers, joints or another machine.
    """
    plain = _untuned(machine, net)
    try:
        table = json.loads(path.read_text())
        if table["meta"]["machine"] != machine.name:
            raise ValueError(f"gains of {table['meta']['machine']}")
        gains = {
            name: Gains(*(np.array(table["gains"][name][key], float) for key in Gains._fields))
            for name in plain
        }
        shapes = {g.kp.shape for g in gains.values()}
        if shapes != {machine.driven.shape}:
            raise ValueError(f"gains of shape {shapes}")
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: expected gains for {machine.name}, got {error!r}") from error
    return {name: replace(controller, gains=gains[name]) for name, controller in plain.items()}


# --- the comparison -----------------------------------------------------------------------------------


def line_distance(p_tool: Array, goals: Array, start: Array) -> Array:
    """Distance of the tool from the commanded line [m], (T,).

    The line starts where the tool was when the commanded direction last changed (a stop or a way back
    along the same line is no change).

    Args:
        p_tool: tool position at the end of each tick [m], (T, 3).
        goals: commanded velocity during each tick [m/s], (T, 3).
        start: tool position before the first tick [m], (3,).
    """
    anchor, direction, distance = start, np.zeros(3), []
    for before, p, goal in zip(np.vstack([start, p_tool[:-1]]), p_tool, goals, strict=True):
        speed = np.linalg.norm(goal)
        if speed > 0 and np.linalg.norm(np.cross(direction, goal / speed)) + (not direction.any()) > 1e-6:
            anchor, direction = (anchor if not direction.any() else before), goal / speed
        away = p - anchor
        distance.append(np.linalg.norm(away - (away @ direction) * direction))
    return np.array(distance)


def metrics(machine: Machine, trace: Trace, run: int, goals: Array, start: Array) -> dict[str, float]:
    """The figures of one run, as in the evaluate JSON [m, m/s, m/s^3, full strokes, 1]."""
    p, v, u = trace.p_tool[:, run], trace.v_tool[:, run], trace.u[:, run]
    error = np.linalg.norm(goals - v, axis=-1)
    drift = line_distance(p, goals, start)
    jerk = np.diff(v, n=2, axis=0) * machine.rate**2
    return {
        "velocity_rmse": float(np.sqrt(np.mean(error**2))),
        "velocity_error_mean": float(error.mean()),
        "off_axis_drift_max": float(drift.max()),
        "off_axis_drift_mean": float(drift.mean()),
        "jerk_rms": float(np.sqrt(np.mean(np.sum(jerk**2, axis=-1)))) if len(jerk) else 0.0,
        "valve_travel": float(np.abs(np.diff(u, axis=0, prepend=0 * u[:1])).sum()),
        "reward_mean": float(trace.reward[:, run].mean()),
    }


def task_space(
    machine: Machine,
    controllers: Mapping[str, Controller],
    sequences: Sequence[Commands],
    starts: Array,
    seed: int,
    net: ActuatorNet | None = None,
) -> tuple[list[dict[str, Any]], dict[tuple[str, str], Trace]]:
    """Every controller on the same sequences, starts and noise. Paper: Sec. 4.2, Fig. 6

    Returns:
        One row of `metrics` a controller, sequence and start; and the traces, starts as one batch.
    """
    runs, traces = [], {}
    first = tool_state(machine, starts, 0 * starts)[0]
    for name, controller in controllers.items():
        for sequence in tqdm(sequences, desc=f"evaluate {name}", unit="sequence", disable=None):
            goals = np.repeat(sequence.goals[:, None], len(starts), axis=1)
            rng = np.random.default_rng(seed)
            trace = rollout(machine, controller, starts, goals, TaskConfig(), rng, net)
            traces[name, sequence.name] = trace
            for i in range(len(starts)):
                row = metrics(machine, trace, i, sequence.goals, first[i])
                runs.append({"controller": name, "sequence": sequence.name, "start": i} | row)
    return runs, traces


def summary(runs: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, dict[str, float]]]:
    """Mean of each figure by controller and sequence, and over all of them together ("all")."""
    result: dict[str, dict[str, dict[str, float]]] = {}
    for controller in dict.fromkeys(run["controller"] for run in runs):
        mine = [run for run in runs if run["controller"] == controller]
        names = [*dict.fromkeys(run["sequence"] for run in mine), "all"]
        result[controller] = {
            name: {
                key: float(np.mean([r[key] for r in mine if name in (r["sequence"], "all")]))
                for key in list(mine[0])[3:]
            }
            for name in names
        }
    return result


def driven_log(machine: Machine, traces: Mapping[Any, Trace]) -> Log:
    """What encoders and valves said during evaluated runs, as recordings for `score`."""
    recordings = []
    for (name, sequence), trace in traces.items():
        for i in range(trace.q.shape[1]):
            q = trace.q_measured[:, i].astype(float)
            velocity = velocity_of(q, machine.velocity_samples)
            u = trace.u[:, i].astype(float)
            recordings.append(Recording(f"{name}_{sequence}_{i:02d}", u, q, velocity))
    return Log(machine.names, tuple(recordings))


# --- figures: one style, units on every axis, colours that differ in brightness too ------------------

COLOURS = {
    "wanted": "black",
    "rl": "#0072b2",
    "jacobian_pid_k0.1": "#d55e00",
    "jacobian_pid_k0.05": "#e69f00",
    "jacobian_pid_ff": "#009e73",
}


def _figure(rows: int, columns: int, height: float = 2.4) -> tuple[Any, Any]:
    figure, axes = plt.subplots(
        rows, columns, figsize=(4.2 * columns, height * rows), squeeze=False, layout="constrained"
    )
    for ax in axes.flat:
        ax.grid(alpha=0.3)
    return figure, axes


def _png(figure: Any) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=110, metadata={"Software": None})
    plt.close(figure)
    return base64.b64encode(buffer.getvalue()).decode()


def plot_sequence(
    machine: Machine, traces: Mapping[tuple[str, str], Trace], sequence: Commands, start: Array, run: int
) -> Any:
    """Tool position and velocity along x, y, z of all controllers in one run. Paper: Fig. 6"""
    figure, axes = _figure(2, 3)
    clock = np.arange(1, len(sequence.goals) + 1) * machine.dt
    first = tool_state(machine, start, 0 * start)[0]
    wanted = np.cumsum(sequence.goals, axis=0) * machine.dt
    names = [name for name, other in traces if other == sequence.name]
    for i, axis in enumerate(AXES):
        axes[0, i].plot(clock, wanted[:, i], "--", color="black", label="wanted")
        axes[1, i].plot(clock, sequence.goals[:, i], "--", color="black", label="wanted")
        for name in names:
            trace = traces[name, sequence.name]
            style = {"color": COLOURS.get(name, "grey"), "lw": 1.1, "label": name}
            axes[0, i].plot(clock, trace.p_tool[:, run, i] - first[i], **style)
            axes[1, i].plot(clock, trace.v_tool[:, run, i], **style)
        axes[0, i].set_ylabel(f"{axis} - {axis}(0) [m]")
        axes[1, i].set_ylabel(f"velocity {axis} [m/s]")
        axes[1, i].set_xlabel("time [s]")
    limits = [ax.get_ylim() for ax in axes[0]], [ax.get_ylim() for ax in axes[1]]
    for row, spans in zip(axes, limits, strict=True):  # the same scale side by side
        for ax in row:
            ax.set_ylim(min(a for a, _ in spans), max(b for _, b in spans))
    axes[0, 0].legend(fontsize=7)
    figure.suptitle(f"sequence {sequence.name}, start {run}")
    return figure


def plot_joint_rates(
    machine: Machine, traces: Mapping[tuple[str, str], Trace], sequence: Commands, run: int
) -> Any:
    """Velocity of the driven joints of all controllers in one run. Paper: Fig. 6d"""
    figure, axes = _figure(1, len(machine.driven))
    clock = np.arange(1, len(sequence.goals) + 1) * machine.dt
    for ax, joint in zip(axes[0], machine.driven, strict=True):
        for (name, other), trace in traces.items():
            if other == sequence.name:
                ax.plot(clock, trace.q_dot[:, run, joint], lw=1, color=COLOURS.get(name, "grey"), label=name)
        ax.set(xlabel="time [s]", ylabel=f"velocity {machine.names[joint]} [rad/s]")
    axes[0, 0].legend(fontsize=7)
    return figure


def plot_free_run(net: ActuatorNet, log: Log, seconds: float = 30.0) -> Any:
    """Recorded and free-running angle and velocity of every joint in one unseen recording."""
    recording = log.recordings[0]
    ticks = min(round(seconds * net.rate), len(recording.q) - net.history - 1)
    start = np.array([net.history])
    q, q_dot = (a[:, 0] for a in free_run(net, recording, start, ticks))
    later, clock = net.history + 1 + np.arange(ticks), np.arange(1, ticks + 1) / net.rate
    figure, axes = _figure(2, len(net.joints), 2.0)
    for j, name in enumerate(net.joints):
        for row, mine, truth in ((0, q, recording.q), (1, q_dot, recording.q_dot)):
            axes[row, j].plot(clock, truth[later, j], color="black", lw=1, label="machine")
            axes[row, j].plot(clock, mine[:, j], "--", color=COLOURS["rl"], lw=1, label="nets")
        axes[0, j].set_ylabel(f"{name} [rad]")
        axes[1, j].set(ylabel=f"velocity {name} [rad/s]", xlabel="time [s]")
    axes[0, 0].legend(fontsize=7)
    return figure


def plot_bars(table: Mapping[str, Mapping[str, Mapping[str, float]]], sequences: Sequence[str]) -> Any:
    """Mean velocity error and largest drift of each controller on each sequence."""
    figure, axes = _figure(1, 2, 3.0)
    keys = (("velocity_error_mean", "mean velocity error [m/s]"), ("off_axis_drift_max", "largest drift [m]"))
    width = 0.8 / len(table)
    for ax, (key, label) in zip(axes[0], keys, strict=True):
        for i, (name, rows) in enumerate(table.items()):
            places = np.arange(len(sequences)) + i * width
            values = [rows[s][key] for s in sequences]
            ax.bar(places, values, width, color=COLOURS.get(name, "grey"), label=name)
        ax.set_xticks(np.arange(len(sequences)) + 0.4 - width / 2, sequences)
        ax.set_ylabel(label)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncol=5, fontsize=8)
    return figure


def plot_learning(curve: Path) -> Any:
    """Mean reward and velocity error of the exploring policy over environment steps."""
    with open(curve, newline="") as file:
        rows = list(csv.DictReader(file))
    steps = [int(row["global_step"]) / 1e6 for row in rows]
    figure, axes = _figure(1, 2)
    names = (("charts/reward", "reward a step [1]"), ("charts/velocity_error", "velocity error [m/s]"))
    for ax, (name, label) in zip(axes[0], names, strict=True):
        ax.plot(steps, [float(row[name]) for row in rows], color=COLOURS["rl"], lw=1)
        ax.set(xlabel="environment steps [million]", ylabel=label)
    return figure


# --- the whole chain --------------------------------------------------------------------------------


def write_json(path: Path, value: Any) -> None:
    """Write JSON whole, floats as they are."""
    with whole_file(path, "w") as file:
        json.dump(value, file, indent=1, allow_nan=False)
        file.write("\n")


def write_report(
    path: Path, results: Mapping[str, Any], figures: Mapping[str, str], clock: Mapping[str, float]
) -> None:
    """One self-contained page: tables and figures in the paper's order."""
    table = results["task_space"]["summary"]
    keys = list(next(iter(table.values()))["all"])
    parts = [
        "<!doctype html><meta charset=utf-8><title>brokk_min report</title><style>"
        "body{font:15px/1.45 sans-serif;max-width:1100px;margin:2em auto;padding:0 1em}"
        "table{border-collapse:collapse;margin:1em 0}td,th{border:1px solid #bbb;padding:.25em .6em;"
        "text-align:right}td:first-child,th:first-child{text-align:left}img{max-width:100%}</style>",
        "<h1>Task space control with reinforcement learning: what was measured</h1>",
        "<p>The machine here is an analytic plant, not a real Brokk 170. The policy was trained on nets "
        "fitted to its logs and never saw its equations.</p>",
        "<p>Seconds spent: " + ", ".join(f"{k} {v:.0f}" for k, v in clock.items()) + ".</p>",
        "<h2>Actuator nets on unseen recordings</h2>",
        _html_table(
            [
                "joint",
                "one step [rad/s]",
                "same as last [rad/s]",
                "free run 10 s [rad/s]",
                "angle after 10 s [rad]",
            ],
            [
                [joint, s["one_step_rmse"], s["persistence_rmse"], *s["free_run"].get("10", {"": 0}).values()]
                for joint, s in results["actuator"]["test"].items()
            ],
        ),
        "<h2>Task space control</h2>",
        "<p>Means over all sequences and starts.</p>",
        _html_table(["controller", *keys], [[n, *rows["all"].values()] for n, rows in table.items()]),
        "<p>Mean velocity error [m/s] by sequence.</p>",
        _html_table(
            ["controller", *next(iter(table.values()))],
            [[n, *(r["velocity_error_mean"] for r in rows.values())] for n, rows in table.items()],
        ),
    ]
    for title, image in figures.items():
        alt = html.escape(title)
        parts.append(f"<h3>{alt}</h3><img alt='{alt}' src='data:image/png;base64,{image}'>")
    with whole_file(path, "w") as file:
        file.write("\n".join(parts) + "\n")


def _html_table(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    def line(cells: Sequence[Any], tag: str) -> str:
        texts = (f"{c:.4g}" if isinstance(c, float) else html.escape(str(c)) for c in cells)
        return "<tr>" + "".join(f"<{tag}>{t}</{tag}>" for t in texts) + "</tr>"

    return f"<table>{line(head, 'th')}{''.join(line(row, 'td') for row in rows)}</table>"


def reproduce(machine: Machine, out: Path, effort: Effort, seed: int) -> dict[str, Any]:
    """Logs, nets, policy, baselines, comparison, `results.json` and `report.html` in the folder `out`.

    `results.json` holds no clock: the same seed gives the same file on the same machine.
    """
    from brokk_min.ppo import PPOConfig, train  # torch, only where something is trained

    out.mkdir(parents=True, exist_ok=True)
    clock, last = {}, time.perf_counter()

    stages = tqdm(total=6, desc="stages done", unit="stage", position=1, disable=None)

    def lap(name: str) -> None:
        nonlocal last
        clock[name], last = time.perf_counter() - last, time.perf_counter()
        stages.set_postfix_str(name)
        stages.update()

    write_log(out / "log.npz", collect(machine, effort.hours, "rich", np.random.default_rng(seed)))
    test = task_log(machine, 20, 40.0, np.random.default_rng(seed + 1))
    write_log(out / "log_test.npz", test)
    lap("record")
    log = read_log([out / "log.npz"], machine.velocity_samples)
    test = read_log([out / "log_test.npz"], machine.velocity_samples)
    net = fit(
        log,
        FitConfig(steps=effort.fit_steps, history=machine.history),
        seed,
        machine.velocity_samples,
        machine.name,
    )
    save_net(out / "net.npz", net)
    lap("fit")
    driven = net.select([machine.names[i] for i in machine.driven])
    config = PPOConfig(total_steps=effort.train_steps)
    policy = train(machine, driven, TaskConfig(), config, seed, out / "policy.npz", resume=True)
    lap("train")
    baselines = tuned_baselines(machine, driven, effort, seed)
    lap("tune")
    sequences = axis_sequences(machine)
    starts = draw_starts(machine, sequences, effort.starts, np.random.default_rng(seed + 2))
    controllers: dict[str, Controller] = {"rl": PolicyController(machine, policy), **baselines}
    runs, traces = task_space(machine, controllers, sequences, starts, seed)
    simulated, _ = task_space(machine, {"rl": controllers["rl"]}, sequences, starts, seed, driven)
    rl_log = driven_log(machine, {key: trace for key, trace in traces.items() if key[0] == "rl"})
    lap("evaluate")
    results = {
        "meta": meta(machine, seed) | {"effort": effort.__dict__},
        "actuator": {"test": score(net, test), "driven_by_policy": score(net, rl_log)},
        "task_space": {"runs": runs, "summary": summary(runs), "rl_on_nets": summary(simulated)["rl"]},
        "gains": plain_gains(baselines),
        "starts": starts.tolist(),
    }
    write_json(out / "results.json", results)
    write_json(out / "gains.json", {"meta": results["meta"], "gains": results["gains"]})
    figures = {"Nets run freely on an unseen recording": plot_free_run(net, test)}
    figures["Learning curve"] = plot_learning(out / "policy.npz.csv")
    figures["Velocity error and drift"] = plot_bars(results["task_space"]["summary"], [*AXES, "all"])
    for sequence in sequences:
        figures[f"Motion along {sequence.name}"] = plot_sequence(machine, traces, sequence, starts[0], 0)
    figures["Joint velocities during x motion"] = plot_joint_rates(machine, traces, sequences[0], 0)
    images = {title: _png(figure) for title, figure in figures.items()}
    lap("draw")
    stages.close()
    write_json(out / "timing.json", clock)
    write_report(out / "report.html", results, images, clock)
    return results


def meta(machine: Machine, seed: int) -> dict[str, Any]:
    """What every JSON of ours says of itself."""
    from brokk_min import __version__

    return {"brokk_min": __version__, "machine": machine.name, "seed": seed, "units": "m, m/s, s, rad"}
