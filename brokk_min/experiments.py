"""The paper's experiment as numbers, and the whole chain.

`task_space` runs every controller on the same starts and velocity sequences on the same machine.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from brokk_min import __version__, actuator, figures, jacobian, kinematics, logs
from brokk_min.env import Controller, TaskConfig, Trace, rollout
from brokk_min.figures import Traces
from brokk_min.jacobian import JacobianController
from brokk_min.machine import Machine
from brokk_min.policy import PolicyController
from brokk_min.sequences import AXES, Commands, axis_sequences, draw_starts, tuning_goals

Array = NDArray[np.floating[Any]]
Net = actuator.ActuatorNet

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
    """What encoders and valves said in one controller's runs, as recordings for `score`. Paper: Sec. 4.1"""
    recordings = []
    for (name, sequence), trace in traces.items():
        for i in range(trace.q.shape[1] * (name == controller)):
            u, q = trace.u[:, i].astype(float), trace.q_measured[:, i].astype(float)
            velocity = logs.velocity_of(q, machine.velocity_samples)
            recordings.append(logs.Recording(f"{name}_{sequence}_{i:02d}", u, q, velocity))
    return logs.Log(machine.names, tuple(recordings))


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


def write_json(path: Path, value: Any) -> None:
    """Write JSON whole, floats as they are."""
    with logs.whole_file(path, "w") as file:
        json.dump(value, file, indent=1, allow_nan=False)
        file.write("\n")


# --- the whole chain --------------------------------------------------------------------------------


def reproduce(machine: Machine, out: Path, effort: Effort, seed: int) -> dict[str, Any]:
    """Logs, nets, policy, baselines, comparison, `results.json` and `report.html` in the folder `out`.

    `results.json` holds no clock: the same seed gives the same file on the same machine.
    """
    from brokk_min.ppo import TASK, PPOConfig, train  # torch, only where something is trained

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
    policy = train(machine, driven, TASK, learner, seed, out / "policy.npz", resume=True)
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
    motion = [figures.plot_sequence(machine, traces, sequence, starts[0], 0) for sequence in sequences]
    rates = figures.plot_joint_rates(machine, traces, sequences[0], 0)
    bars = figures.plot_bars(results["task_space"]["summary"], [*AXES, "all"])
    parts = (
        ("Actuator nets", "One step and free runs of 10 s on unseen recordings [rad/s, rad].", nets),
        ("Nets run freely", "One of these recordings.", figures.plot_free_run(net, test)),
        (
            "Learning curve",
            "The exploring policy, on the nets.",
            figures.plot_learning(out / "policy.npz.csv"),
        ),
        ("Tuning of the baselines", "Least velocity error after a generation, on the machine.", tuning),
        ("Task space control", "Motion along x, y and z from the first start, one scale a row.", *motion),
        ("Joint velocities", "Motion along x from the first start.", rates),
        ("Figures of merit", "Means over all sequences and starts [m/s, m, m/s^3, full strokes].", means),
        ("Velocity error and drift by sequence", "Means over all starts [m/s, m].", errors, bars),
    )
    figures.write_report(out / "report.html", parts, clock)
    lap("draw")
    stages.close()
    write_json(out / "timing.json", clock)
    return results


def meta(machine: Machine, seed: int) -> dict[str, Any]:
    """What every JSON of ours says of itself."""
    return {"brokk_min": __version__, "machine": machine.name, "seed": seed, "units": "m, m/s, s, rad"}
