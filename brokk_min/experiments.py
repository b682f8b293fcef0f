"""The paper's experiment as numbers, figures and a report; the only module that plots.

`task_space` runs every controller on the same starts and velocity sequences on the same machine.
Sequences and starts that score are never used for tuning; `tuning_goals` makes the others.
"""

from __future__ import annotations

import base64
import html
import io
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import matplotlib
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from brokk_min import __version__, actuator, jacobian, kinematics, logs
from brokk_min.env import Controller, TaskConfig, Trace, draw_pose, reset, rollout, terminated
from brokk_min.jacobian import JacobianController
from brokk_min.machine import Machine
from brokk_min.policy import PolicyController

matplotlib.use("Agg")
import matplotlib.pyplot as plt

Array = NDArray[np.floating[Any]]
Net = actuator.ActuatorNet
Traces = Mapping[tuple[str, str], Trace]  # by controller and sequence, starts as one batch
AXES = "xyz"
# One axis of the paper's experiment: seconds and share of tool_speed (assumed), with changes of direction.
PATTERN = ((1, 0.0), (4, 2 / 3), (1, 0.0), (4, -2 / 3), (1, 0.0), (3, 1 / 3), (3, -1 / 3), (1, 0.0))


class Commands(NamedTuple):
    """A named sequence of wanted tool velocities [m/s] at the control rate, (T, 3)."""

    name: str
    goals: Array


def axis_sequences(machine: Machine) -> list[Commands]:
    """One sequence along x, one along y, one along z. Paper: Fig. 6"""
    seconds, shares = np.array(PATTERN).T
    profile = machine.tool_speed * np.repeat(shares, np.rint(seconds * machine.rate).astype(int))
    return [Commands(name, np.outer(profile, np.eye(3)[i])) for i, name in enumerate(AXES)]


def read_commands(path: Path, machine: Machine) -> list[Commands]:
    """Sequences of a CSV `sequence,time,vx,vy,vz` [s, m/s], each value held until the next row.

    The last row of a sequence marks its end.
    """
    table = logs.read_table(path, ["sequence", "time", "vx", "vy", "vz"], text=("sequence",))
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
        ValueError: an angle outside its joint's range or a pose in the ground, with file and row.
    """
    table = logs.read_table(path, list(machine.names))
    starts = np.stack([table[name] for name in machine.names], axis=1)
    low, high = machine.column("q_min"), machine.column("q_max")
    for row, joint in np.argwhere((starts < low) | (starts > high)):
        wanted = f"column {machine.names[joint]}: expected {low[joint]} to {high[joint]} rad"
        raise ValueError(f"{path}: row {row + 2}, {wanted}, got {starts[row, joint]}")
    lowest = kinematics.lowest_point(machine, starts)
    for row in np.flatnonzero(terminated(machine, lowest)):
        wanted = f"expected the whole arm above {machine.ground} m"
        raise ValueError(f"{path}: row {row + 2}: {wanted}, got {lowest[row]:.3f} m")
    return starts


def feasible(machine: Machine, start: Array, goals: Array) -> NDArray[np.bool_]:
    """Can ideal actuators follow `goals` (T, num, 3) from `start` (num, n)? Shape (num,).

    Integrates lightly damped resolved rates with joint-limit weights. Margins, all assumed: the tool stays
    within 20 mm of its path (no singularity is crossed), joints 0.05 rad off their limits and below 0.9 of
    `speed_limits` (a tracking controller needs room to correct), the arm 0.1 m off the ground.
    """
    q, driven = np.array(start, float), machine.driven
    low, high = machine.column("q_min")[driven] + 0.05, machine.column("q_max")[driven] - 0.05
    wanted, lowest = kinematics.tool_state(machine, q, 0 * q)[::2]
    good, rates = lowest > machine.ground + 0.1, np.zeros_like(q)
    for goal in goals:
        p, _, lowest = kinematics.tool_state(machine, q, rates)
        J = kinematics.jacobian(machine, q)
        inverse = jacobian.dls(J, jacobian.limit_weights(machine, q, rates)[:, driven], np.full(len(q), 1e-4))
        rates = np.zeros_like(q)
        rates[:, driven] = (inverse @ (goal + (wanted - p))[..., None])[..., 0]
        q, wanted = q + rates * machine.dt, wanted + goal * machine.dt
        inside = ((q[:, driven] > low) & (q[:, driven] < high)).all(-1)
        down, up = actuator.speed_limits(machine, q)
        slow = ((rates > 0.9 * down) & (rates < 0.9 * up))[:, driven].all(-1)
        near = np.linalg.norm(wanted - p, axis=-1) < 0.02
        good &= inside & slow & near & (lowest > machine.ground + 0.1)
    return good


def _feasible_draws(
    machine: Machine, num: int, label: str, draw: Callable[[], tuple[Array, list[Array]]]
) -> tuple[Array, Array]:
    """First `num` poses (num, n), and goals (T, num, 3), of those drawn whose goals are all `feasible`."""
    poses: list[Array] = []
    first: list[Array] = []
    with tqdm(total=num, desc=label, unit="start", disable=None) as bar:
        for _ in range(60):
            pose, goals = draw()
            keep = np.arange(len(pose))
            for goal in goals:
                keep = keep[feasible(machine, pose[keep], goal[:, keep])]
            poses += list(pose[keep])
            first += list(goals[0].swapaxes(0, 1)[keep])
            bar.update(min(num, len(poses)) - bar.n)
            if len(poses) >= num:
                return np.array(poses[:num]), np.array(first[:num]).swapaxes(0, 1)
    raise ValueError(f"{label}: expected {num} feasible poses for {machine.name}, got {len(poses)}")


def draw_starts(machine: Machine, sequences: Sequence[Commands], num: int, rng: np.random.Generator) -> Array:
    """Random poses (num, n) [rad] from which all sequences are `feasible`; ValueError: too few such poses."""
    goals = [np.repeat(sequence.goals[:, None], 400, axis=1) for sequence in sequences]

    def draw() -> tuple[Array, list[Array]]:
        return draw_pose(machine, TaskConfig(), rng, 400), goals

    return _feasible_draws(machine, num, "draw starts", draw)[0]


def tuning_goals(machine: Machine, runs: int, seconds: float, seed: int) -> tuple[Array, Array]:
    """Feasible starts (runs, n) and goals (T, runs, 3), drawn as the policy's by `reset`: for tuning only."""
    rng, config, ticks = np.random.default_rng(seed), TaskConfig(), round(seconds * machine.rate)
    holds = int(np.ceil(seconds / config.hold_min_s))  # that many are always long enough

    def draw() -> tuple[Array, list[Array]]:
        drawn = reset(machine, config, rng, 200 * holds, plant=False)
        goals = [
            np.repeat(drawn.v_goal[i : i + holds], drawn.goal_ticks[i : i + holds], axis=0)[:ticks]
            for i in range(0, 200 * holds, holds)
        ]
        return drawn.q[::holds].astype(float), [np.stack(goals, axis=1)]

    return _feasible_draws(machine, runs, "draw tuning runs", draw)


# --- controllers ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Effort:
    """How much is spent; the quick chain has the same parts, smaller."""

    hours: float = 1.0
    fit_steps: int = actuator.FitConfig.steps
    train_steps: int = 6_000_000  # `PPOConfig`'s, without importing torch
    generations: int = 45
    tuning_runs: int = 12
    starts: int = 16


QUICK = Effort(0.1, 700, 200_000, 4, 4, 4)


def baselines(machine: Machine, net: Net) -> dict[str, JacobianController]:
    """The paper's two baselines and one with feed-forward, with gains set by hand. Paper: Sec. 4.2"""
    w0 = jacobian.manipulability_threshold(machine)
    pid = jacobian.join_gains(machine, {"kp": 1.0, "ki": 8.0, "kd": 0.05, "feedback": 0.4, "ready": 0.015})
    mild = jacobian.join_gains(machine, {"kp": 0.2, "ki": 0.5, "kd": 0.02, "feedback": 0.1, "ready": 0.015})
    steady = jacobian.steady_map(machine, net)
    return {
        "jacobian_pid_k0.1": JacobianController(machine, pid, 0.1, w0),
        "jacobian_pid_k0.05": JacobianController(machine, pid, 0.05, w0),
        "jacobian_pid_ff": JacobianController(machine, mild, 0.1, w0, steady),
    }


def tuned_baselines(
    machine: Machine, net: Net, effort: Effort, seed: int
) -> tuple[dict[str, JacobianController], dict[str, dict[str, Any]]]:
    """The baselines, each tuned on the machine itself, and how their tuning went, for JSON.

    The cost is the figure that is scored, mean |v_goal - v_tool|, on `tuning_goals`. Tuning on the
    machine favours the baselines: the policy never sees it.
    """
    start, goals = tuning_goals(machine, effort.tuning_runs, 12.0, seed + 1000)

    def cost(controller: JacobianController) -> Array:
        candidates, runs = len(controller.gains), len(start)
        batch = replace(controller, gains=np.repeat(controller.gains, runs, axis=0))
        wanted, rng = np.tile(goals, (1, candidates, 1)), np.random.default_rng(seed)
        trace = rollout(machine, batch, np.tile(start, (candidates, 1)), wanted, TaskConfig(), rng)
        error = np.linalg.norm(wanted - trace.v_tool, axis=-1)
        return error.mean(0).reshape(candidates, runs).mean(1)

    tuned, how = {}, {}
    for name, controller in baselines(machine, net).items():
        tuned[name], costs = jacobian.tune(controller, cost, seed, effort.generations, name)
        how[name] = {"seed": seed, "cost": costs, "at_bound": jacobian.gains_at_bound(tuned[name])}
    return tuned, how


def plain_gains(controllers: Mapping[str, JacobianController]) -> dict[str, dict[str, list[float]]]:
    """Gains of each baseline by name, for JSON."""
    named = {name: jacobian.split_gains(c.gains) for name, c in controllers.items()}
    return {name: {key: gain.tolist() for key, gain in gains.items()} for name, gains in named.items()}


def read_gains(path: Path, machine: Machine, net: Net) -> dict[str, JacobianController]:
    """The baselines with gains that `reproduce` wrote.

    Raises:
        ValueError: no such file, or gains of other controllers, joints or another machine.
    """
    result = baselines(machine, net)
    try:
        table = json.loads(path.read_text())
        if table["meta"]["machine"] != machine.name:
            raise ValueError(f"gains of {table['meta']['machine']}")
        for name, controller in result.items():
            result[name] = replace(controller, gains=jacobian.join_gains(machine, table["gains"][name]))
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: expected gains for {machine.name}, got {error!r}") from error
    return result


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
    net: Net | None = None,
) -> tuple[list[dict[str, Any]], Traces]:
    """Every controller on the same sequences, starts and noise. Paper: Sec. 4.2, Fig. 6

    Returns:
        One row of `metrics` a controller, sequence and start; and the traces.
    """
    runs, traces = [], {}
    first = kinematics.tool_position(machine, starts)
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

    def means(controller: str, sequence: str) -> dict[str, float]:
        mine = [r for r in runs if r["controller"] == controller and sequence in (r["sequence"], "all")]
        return {key: float(np.mean([run[key] for run in mine])) for key in list(mine[0])[3:]}

    controllers, sequences = (dict.fromkeys(run[key] for run in runs) for key in ("controller", "sequence"))
    return {c: {s: means(c, s) for s in (*sequences, "all")} for c in controllers}


def driven_log(machine: Machine, traces: Traces, controller: str) -> logs.Log:
    """What encoders and valves said during one controller's runs, as recordings for `score`."""
    recordings = []
    for (name, sequence), trace in traces.items():
        for i in range(trace.q.shape[1] * (name == controller)):
            u, q = trace.u[:, i].astype(float), trace.q_measured[:, i].astype(float)
            velocity = logs.velocity_of(q, machine.velocity_samples)
            recordings.append(logs.Recording(f"{name}_{sequence}_{i:02d}", u, q, velocity))
    return logs.Log(machine.names, tuple(recordings))


# --- figures: one style, units on every axis, colours that differ in brightness too ------------------

STYLES: dict[str, dict[str, Any]] = {
    "wanted": {"color": "black", "linestyle": "--"},
    "machine": {"color": "black"},
    "nets": {"color": "#0072b2", "linestyle": "--"},
    "rl": {"color": "#0072b2"},
    "jacobian_pid_k0.1": {"color": "#d55e00"},
    "jacobian_pid_k0.05": {"color": "#e69f00"},
    "jacobian_pid_ff": {"color": "#009e73"},
}


Row = tuple[Sequence[str], Mapping[str, Array]]  # labels of k y axes, and curves (T, k) by name


def plot_lines(x: Array, xlabel: str, rows: Sequence[Row], one_scale: bool = False) -> Any:
    """Rows of line plots over the same x under one legend; `one_scale`: one y axis in each row."""
    share: Literal["row", "none"] = "row" if one_scale else "none"
    high, wide = len(rows), len(rows[0][0])
    figure = plt.figure(figsize=(4.0 * wide + 0.4, 2.3 * high + 0.4), layout="constrained")
    grid = figure.subplots(high, wide, squeeze=False, sharey=share)
    for axes, (labels, curves) in zip(grid, rows, strict=True):
        for i, (ax, label) in enumerate(zip(axes, labels, strict=True)):
            for name, y in curves.items():
                ax.plot(x, y[:, i], label=name, linewidth=1.1, **STYLES[name])
            ax.set_ylabel(label)
            ax.grid(alpha=0.3)
    for ax in grid[-1]:
        ax.set_xlabel(xlabel)
    return _with_legend(figure, grid[0, 0])


def _with_legend(figure: Any, ax: Any) -> Any:
    figure.legend(*ax.get_legend_handles_labels(), loc="outside upper center", ncol=5, fontsize=8)
    return figure


def _during(traces: Traces, sequence: Commands) -> dict[str, Trace]:
    return {name: trace for (name, other), trace in traces.items() if other == sequence.name}


def plot_sequence(machine: Machine, traces: Traces, sequence: Commands, start: Array, run: int) -> Any:
    """Tool position and velocity along x, y, z of all controllers in one run. Paper: Fig. 6"""
    first = kinematics.tool_position(machine, start)
    p, v = {"wanted": np.cumsum(sequence.goals, axis=0) * machine.dt}, {"wanted": sequence.goals}
    for name, trace in _during(traces, sequence).items():
        p[name], v[name] = trace.p_tool[:, run] - first, trace.v_tool[:, run]
    rows = [([f"{a} - {a}(0) [m]" for a in AXES], p), ([f"velocity {a} [m/s]" for a in AXES], v)]
    return plot_lines(machine.dt * np.arange(1, len(sequence.goals) + 1), "time [s]", rows, one_scale=True)


def plot_joint_rates(machine: Machine, traces: Traces, sequence: Commands, run: int) -> Any:
    """Velocity of the driven joints of all controllers in one run. Paper: Fig. 6d"""
    labels = [f"velocity {machine.names[i]} [rad/s]" for i in machine.driven]
    rates = {name: t.q_dot[:, run, machine.driven] for name, t in _during(traces, sequence).items()}
    return plot_lines(machine.dt * np.arange(1, len(sequence.goals) + 1), "time [s]", [(labels, rates)])


def plot_free_run(net: Net, log: logs.Log, seconds: float = 30.0) -> Any:
    """Recorded and free-running angle and velocity of every joint in one unseen recording."""
    recording = log.recordings[0]
    ticks = min(round(seconds * net.rate), len(recording.q) - net.history - 1)
    q, q_dot = actuator.free_run(net, recording, np.array([net.history]), ticks)
    later = slice(net.history + 1, net.history + 1 + ticks)
    rows = [
        ([f"{joint} [rad]" for joint in net.joints], {"machine": recording.q[later], "nets": q[:, 0]}),
        (
            [f"{joint} [rad/s]" for joint in net.joints],
            {"machine": recording.q_dot[later], "nets": q_dot[:, 0]},
        ),
    ]
    return plot_lines(np.arange(1, ticks + 1) / net.rate, "time [s]", rows)


def plot_learning(curve: Path) -> Any:
    """Mean reward and velocity error of the exploring policy over environment steps."""
    table = logs.read_table(curve, ["global_step", "charts/reward", "charts/velocity_error"])
    curves = {"rl": np.stack([table["charts/reward"], table["charts/velocity_error"]], axis=1)}
    row = (["reward a step [1]", "velocity error [m/s]"], curves)
    return plot_lines(table["global_step"] / 1e6, "environment steps [million]", [row])


def plot_bars(table: Mapping[str, Mapping[str, Mapping[str, float]]], sequences: Sequence[str]) -> Any:
    """Mean velocity error and largest drift of each controller on each sequence."""
    figure, axes = plt.subplots(1, 2, figsize=(8.4, 3.0), layout="constrained")
    keys = (("velocity_error_mean", "mean velocity error [m/s]"), ("off_axis_drift_max", "largest drift [m]"))
    width = 0.8 / len(table)
    for ax, (key, label) in zip(axes, keys, strict=True):
        for i, (name, rows) in enumerate(table.items()):
            places = np.arange(len(sequences)) + (i - (len(table) - 1) / 2) * width
            ax.bar(places, [rows[s][key] for s in sequences], width, label=name, color=STYLES[name]["color"])
        ax.set_xticks(np.arange(len(sequences)), sequences)
        ax.set_ylabel(label)
        ax.grid(alpha=0.3, axis="y")
        ax.set_axisbelow(True)
    return _with_legend(figure, axes[0])


# --- the report -------------------------------------------------------------------------------------

STYLE = """body{font:15px/1.45 sans-serif;max-width:1100px;margin:2em auto;padding:0 1em}
table{border-collapse:collapse;margin:1em 0}td,th{border:1px solid #bbb;padding:.25em .6em;text-align:right}
td:first-child,th:first-child{text-align:left}img{max-width:100%}"""


def write_json(path: Path, value: Any) -> None:
    """Write JSON whole, floats as they are."""
    with logs.whole_file(path, "w") as file:
        json.dump(value, file, indent=1, allow_nan=False)
        file.write("\n")


def write_report(path: Path, parts: Sequence[tuple[Any, ...]], clock: Mapping[str, float]) -> None:
    """One page by itself; a part is a title, a sentence, and tables {row: {column: cell}} or figures."""
    page = [
        f"<!doctype html><meta charset=utf-8><title>brokk_min report</title><style>{STYLE}</style>",
        "<h1>Task space control with reinforcement learning: what was measured</h1>",
        "<p>The machine here is an analytic plant, not a real Brokk 170. The policy was trained on nets "
        "fitted to its logs and never saw its equations.</p>",
        "<p>Seconds spent: " + ", ".join(f"{k} {v:.0f}" for k, v in clock.items()) + ".</p>",
    ]
    for title, sentence, *contents in tqdm(parts, desc="draw", unit="part", disable=None):
        page.append(f"<h2>{html.escape(title)}</h2><p>{html.escape(sentence)}</p>")
        page += [_table(c) if isinstance(c, Mapping) else _image(title, c) for c in contents]
    with logs.whole_file(path, "w") as file:
        file.write("\n".join(page) + "\n")


def _table(rows: Mapping[str, Mapping[str, Any]]) -> str:
    def line(tag: str, cells: Sequence[Any]) -> str:
        texts = (f"{c:.4g}" if isinstance(c, float) else html.escape(str(c)) for c in cells)
        return "<tr>" + "".join(f"<{tag}>{text}</{tag}>" for text in texts) + "</tr>"

    head = line("th", ["", *next(iter(rows.values()))])
    return f"<table>{head}{''.join(line('td', [name, *row.values()]) for name, row in rows.items())}</table>"


def _image(title: str, figure: Any) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=110, metadata={"Software": None})
    plt.close(figure)
    image = base64.b64encode(buffer.getvalue()).decode()
    return f"<img alt='{html.escape(title)}' src='data:image/png;base64,{image}'>"


def report_tables(results: Mapping[str, Any]) -> tuple[dict[str, dict[str, Any]], ...]:
    """Errors of the nets, tuning of the baselines, means of all figures, velocity error by sequence."""
    nets, tuning, means = {}, {}, results["task_space"]["summary"]
    for joint, s in results["actuator"]["test"].items():
        nets[joint] = {key: s[key] for key in ("one_step_rmse", "persistence_rmse")}
        nets[joint] |= s["free_run"].get("10", {})
    for name, t in results["tuning"].items():
        bounds = ", ".join(t["at_bound"]) or "none"
        tuning[name] = {"first": t["cost"][0], "last": t["cost"][-1], "gains at a bound": bounds}
    everything = {name: rows["all"] for name, rows in means.items()}
    errors = {n: {s: row["velocity_error_mean"] for s, row in rows.items()} for n, rows in means.items()}
    return nets, tuning, everything, errors


# --- the whole chain --------------------------------------------------------------------------------


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

    files, rng = (out / "log.npz", out / "log_test.npz"), np.random.default_rng
    logs.write_log(files[0], actuator.collect(machine, effort.hours, "rich", rng(seed)))
    logs.write_log(files[1], actuator.task_log(machine, 20, 40.0, rng(seed + 1)))
    lap("record")
    log, test = (logs.read_log([file], machine.velocity_samples) for file in files)
    config = actuator.FitConfig(steps=effort.fit_steps, history=machine.history)
    net = actuator.fit(log, config, seed, machine.velocity_samples, machine.name)
    actuator.save_net(out / "net.npz", net)
    lap("fit")
    driven = net.select([machine.names[i] for i in machine.driven])
    learner = PPOConfig(total_steps=effort.train_steps)
    policy = train(machine, driven, TaskConfig(), learner, seed, out / "policy.npz", resume=True)
    lap("train")
    tuned, how = tuned_baselines(machine, driven, effort, seed)
    lap("tune")
    sequences = axis_sequences(machine)
    starts = draw_starts(machine, sequences, effort.starts, rng(seed + 2))
    rl = PolicyController(machine, policy)
    runs, traces = task_space(machine, {"rl": rl, **tuned}, sequences, starts, seed)
    simulated, _ = task_space(machine, {"rl": rl}, sequences, starts, seed, driven)
    driven_by_policy = actuator.score(net, driven_log(machine, traces, "rl"))
    lap("evaluate")
    results = {
        "meta": meta(machine, seed) | {"effort": asdict(effort)},
        "actuator": {"test": actuator.score(net, test), "driven_by_policy": driven_by_policy},
        "task_space": {"runs": runs, "summary": summary(runs), "rl_on_nets": summary(simulated)["rl"]},
        "gains": plain_gains(tuned),
        "tuning": how,
        "starts": starts.tolist(),
    }
    write_json(out / "results.json", results)
    write_json(out / "gains.json", {"meta": results["meta"], "gains": results["gains"]})
    nets, tuning, means, errors = report_tables(results)
    motion = [plot_sequence(machine, traces, sequence, starts[0], 0) for sequence in sequences]
    rates = plot_joint_rates(machine, traces, sequences[0], 0)
    bars = plot_bars(results["task_space"]["summary"], [*AXES, "all"])
    parts = (
        ("Actuator nets", "One step and free runs of 10 s on unseen recordings [rad/s, rad].", nets),
        ("Nets run freely", "One of these recordings.", plot_free_run(net, test)),
        ("Learning curve", "The exploring policy, on the nets.", plot_learning(out / "policy.npz.csv")),
        ("Tuning of the baselines", "Least velocity error after a generation, on the machine.", tuning),
        ("Task space control", "Motion along x, y and z from the first start, one scale a row.", *motion),
        ("Joint velocities", "Motion along x from the first start.", rates),
        ("Figures of merit", "Means over all sequences and starts [m/s, m, m/s^3, full strokes].", means),
        ("Velocity error and drift by sequence", "Means over all starts [m/s, m].", errors, bars),
    )
    write_report(out / "report.html", parts, clock)
    lap("draw")
    stages.close()
    write_json(out / "timing.json", clock)
    return results


def meta(machine: Machine, seed: int) -> dict[str, Any]:
    """What every JSON of ours says of itself."""
    return {"brokk_min": __version__, "machine": machine.name, "seed": seed, "units": "m, m/s, s, rad"}
