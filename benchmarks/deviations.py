"""What the deviations and assumptions of PAPER.md change, measured.

    python -m benchmarks.deviations [d4 ...] [--train]

Each function returns the figures of one entry. D4, D5, D7, D10 to D14, D18, A4 and A5 fit nets and
train policies: `--train`, some 25 minutes. The name of an entry prints that entry alone.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from numpy.linalg import norm

from benchmarks import POLICY
from brokk_min import actuator, env, jacobian, kinematics, machine
from brokk_min.env import TaskConfig, terminated
from brokk_min.evaluation import baselines, metrics, sequences
from brokk_min.evaluation.baselines import make_gains
from brokk_min.evaluation.feasibility import feasible
from brokk_min.evaluation.rollout import rollout
from brokk_min.identification import excitation, fitting, logs, validation
from brokk_min.identification.net_file import joint_nets
from brokk_min.kinematics import forward_kinematics
from brokk_min.learning import policy, simulation_gradient
from brokk_min.learning.checkpoint import train_policy
from brokk_min.learning.episodes import GRADIENT_LEARNER, PAPER_TASK, draw_pose
from brokk_min.learning.gym_env import TaskVectorEnv
from brokk_min.machine import BROKK_170, PWM_MAX, Array
from brokk_min.ppo import PPOConfig
from brokk_min.viewer import tracing

DOCS = Path(__file__).parents[1] / "docs"
M = BROKK_170
LOW = M.column("q_min")
HIGH = M.column("q_max")
STEPS = 2_000_000  # of each training here
Figures = dict[str, float]


def a1() -> Figures:
    """Fraction of poses above the ground in which damping acts: all, and beyond 2.5 m."""
    q = np.random.default_rng(0).uniform(LOW, HIGH, (20_000, M.n))
    frames = forward_kinematics(M, q)
    J = kinematics.jacobian(frames)[..., M.driven]
    damped = jacobian.manipulability(J) < jacobian.manipulability_threshold(M)
    above = ~terminated(M, kinematics.lowest_point(frames))
    far = norm(kinematics.tool_position(frames)[:, :2], axis=-1) > 2.5
    return {"all": damped[above].mean(), "far": damped[above & far].mean()}


def d1() -> Figures:
    """Fraction of the goal velocity that both forms of eq4 miss, over random poses."""
    rng = np.random.default_rng(0)
    q = rng.uniform(LOW, HIGH, (4000, M.n))
    v = rng.standard_normal((4000, 3))
    J = kinematics.jacobian(forward_kinematics(M, q))[..., M.driven]
    W = jacobian.limit_weights(M, q, rng.standard_normal(q.shape))[:, M.driven]
    w0 = jacobian.manipulability_threshold(M)
    damping = jacobian.nakamura_damping(jacobian.manipulability(J), w0, 0.1)
    result = {}
    for name, as_printed in (("corrected", False), ("printed", True)):
        q_dot = jacobian.dls(J, W, damping, as_printed) @ v[..., None]
        missed = norm((J @ q_dot)[..., 0] - v, axis=-1) / norm(v, axis=-1)
        result[f"{name}, median"] = np.median(missed)
        result[f"{name}, mean"] = missed.mean()
    return result


def d3() -> Figures:
    """Deviation [rad/s] of two velocity estimates at a steady 0.1 rad/s and a 12-bit encoder."""
    ramp = 0.1 * M.dt * np.arange(4000) + 1e-4
    q = machine.read_encoder(M, np.tile(ramp, (M.n, 1)).T)[:, 0]
    ends = range(4, len(q) + 1)
    slopes = [kinematics.estimate_velocity(q[:end], M.velocity_samples, M.dt) for end in ends]
    return {"one tick": np.std(np.diff(q) * M.rate), "4 samples": np.std(slopes)}


def d6() -> Figures:
    """Fraction of episodes that reach the ground under random commands held for 1 s."""
    envs = TaskVectorEnv(128)
    rng = np.random.default_rng(0)
    ground = 0
    ended = 0
    envs.reset(seed=0)
    for tick in range(800):
        if tick % 20 == 0:
            action = rng.uniform(-1, 1, (128, 4)).astype(np.float32)
        _, _, terminations, truncations, _ = envs.step(action)
        ground += int(terminations.sum())
        ended += int((terminations | truncations).sum())
    return {"fraction": ground / ended}


def a7() -> Figures:
    """Fraction of uniform poses that reach into the ground."""
    q = np.random.default_rng(0).uniform(LOW, HIGH, (100_000, M.n))
    return {"fraction": terminated(M, kinematics.lowest_point(forward_kinematics(M, q))).mean()}


def a9() -> Figures:
    """Fraction of poses above the ground from which each sequence, and all three, are feasible."""
    q = draw_pose(M, TaskConfig(), np.random.default_rng(0), 3000)
    followed = {}
    for sequence in sequences.axis_sequences(M):
        goals = np.repeat(sequence.goals[:, None], len(q), axis=1)
        followed[sequence.name] = feasible(M, q, goals)
    followed["all"] = np.all(list(followed.values()), axis=0)
    return {name: rows.mean() for name, rows in followed.items()}


def baseline_error(min_opening: float, noise: float) -> float:
    """Mean velocity error [m/s] of the baseline k = 0.1 with gains set by hand, from 8 starts."""
    axes = sequences.axis_sequences(M)
    starts = sequences.draw_starts(M, axes, 8, np.random.default_rng(2))
    gains = make_gains(M, kp=1.0, ki=8.0, kd=0.05, feedback=0.4, min_opening=min_opening)
    w0 = jacobian.manipulability_threshold(M)
    controller = jacobian.JacobianController(M, gains, 0.1, w0)
    errors = []
    for sequence in axes:
        goals = np.repeat(sequence.goals[:, None], len(starts), axis=1)
        rng = np.random.default_rng(0)
        trace = rollout(M, controller, starts, goals, TaskConfig(noise=noise), rng)
        errors.append(norm(goals - trace.v_tool, axis=-1).mean())
    return float(np.mean(errors))


def a6() -> Figures:
    """Velocity error [m/s] of a baseline with and without the noise."""
    return {"5 %": baseline_error(0.015, 0.05), "none": baseline_error(0.015, 0.0)}


def a11() -> Figures:
    """Velocity error [m/s] of a baseline that keeps its valves open, and of one that does not."""
    return {"open": baseline_error(0.015, 0.05), "closed": baseline_error(0.0, 0.05)}


def levels() -> Figures:
    """Fractions of samples: in the dead zone, and about the threshold of the valves."""
    result = {}
    for kind in ("sine", "rich"):
        log = excitation.collect(M, 0.5, kind, np.random.default_rng(0))
        driven = [r for r in log.recordings if not r.name.endswith(logs.RETURN)]
        size = np.concatenate([np.abs(r.u).max(axis=1)[M.history :] for r in driven])
        counts = (size * PWM_MAX).round()
        result[f"{kind}, in the dead zone"] = np.mean(size <= M.dead_zone)
        result[f"{kind}, 8 to 15 counts"] = np.mean((counts >= 8) & (counts <= 15))
    return result


def stand() -> Figures:
    """Path [m] from 0.5 to 2 s after a stop with open valves; dead zone as known, and smaller."""
    starts = sequences.workspace_starts(M, 64)
    shipped = replace(policy.load_policy(POLICY, M), valves="open")
    controller = policy.PolicyController(M, shipped)
    result = {}
    for dead_zone in (M.dead_zone, M.dead_zone - 0.02):
        plant = replace(M, dead_zone=dead_zone)
        paths = []
        for direction in np.concatenate([np.eye(3), -np.eye(3)]):
            goals = np.zeros((80, len(starts), 3))
            goals[:40] = 2 / 3 * M.tool_speed * direction
            rng = np.random.default_rng(0)
            p = rollout(plant, controller, starts, goals, TaskConfig(), rng).p_tool
            paths.append(norm(p[79] - p[49], axis=-1))
        result[f"{dead_zone:.2f}, median"] = np.median(paths)
        result[f"{dead_zone:.2f}, most"] = np.max(paths)
    return result


def dither() -> Figures:
    """Policies and PIDs along x, y, z, each with all three kinds of valves at rest."""
    policies = {
        name: policy.load_policy(POLICY.with_name(file), M)
        for name, file in policy.POLICIES.items()
    }
    gains = baselines.read_gains(POLICY.with_name("gains.json"), M, policies["rl"].net)
    controllers: dict[str, Any] = {}
    for valves in ("closed", "dither", "open"):
        for name, shipped in policies.items():
            driver = policy.PolicyController(M, replace(shipped, valves=valves))
            controllers[f"{name}, {valves}"] = driver
        for name in ("jacobian_pid_k0.1", "jacobian_pid_ff_integral_dither"):
            controllers[f"{name}, {valves}"] = replace(gains[name], valves=valves)
    starts = sequences.workspace_starts(M, 64)
    runs, _ = metrics.evaluate(M, controllers, sequences.axis_sequences(M), starts, 0)
    keys = ("velocity_error_mean", "velocity_rmse", "velocity_error_moves", "velocity_error_rests")
    keys += ("off_axis_drift_max", "jerk_rms", "valve_travel", "joint_motion_at_rest")
    means = {name: rows["all"] for name, rows in metrics.summary(runs).items()}
    return {f"{name}, {key}": means[name][key] or 0.0 for name in means for key in keys}


def film() -> Figures:
    """Largest distance [mm] from the rectangle of README's film, least and most of eight runs."""
    shipped = policy.load_policy(POLICY, M)
    pids = baselines.read_gains(POLICY.with_name("gains.json"), M, shipped.net)
    names = ("jacobian_pid_k0.1", "jacobian_pid_ff_integral")
    controllers = {"rl": policy.PolicyController(M, shipped)} | {n: pids[n] for n in names}
    (commands,) = sequences.read_commands(DOCS / "rectangle.csv", M)
    starts = sequences.read_starts(DOCS / "rectangle_start.csv", M)
    start = kinematics.tool_position(forward_kinematics(M, starts))
    line = np.concatenate([start, start + np.cumsum(commands.goals, axis=0) * M.dt])
    result = {}
    for name, controller in controllers.items():
        distances = []
        for seed in range(8):
            _, traces = metrics.evaluate(M, {name: controller}, [commands], starts, seed)
            p_tool = traces[name, commands.name].p_tool[:, 0]
            distances.append(1e3 * tracing.distance(line, p_tool).max())
        result |= {f"{name}, least": min(distances), f"{name}, most": max(distances)}
    return result


# --- by fitting and training ----------------------------------------------------------------------


def fit_nets(kind: str, seed: int, **settings: Any) -> tuple[actuator.ActuatorNet, logs.Log]:
    """Nets fitted to 1 h per joint with some settings, and the log."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.npz"
        logs.write_log(path, excitation.collect(M, 1.0, kind, np.random.default_rng(seed)))
        log = logs.read_log([path], M.velocity_samples)
    config = replace(fitting.FitConfig(dead_zone=M.dead_zone), **settings)
    return fitting.fit(log, config, seed, M.velocity_samples, M.name), log


def fit_scores(kind: str, seed: int, **settings: Any) -> Figures:
    """Nets of the driven joints, on motions like a policy's: the worst joint."""
    net, log = fit_nets(kind, seed, **settings)
    test = excitation.task_log(M, 20, 40.0, np.random.default_rng(seed + 1))
    scores = validation.validate(net, log, test, M)
    joints = [scores["joints"][M.names[i]] for i in M.driven]
    return {
        "10 s [rad/s]": max(joint["free_run"]["10"]["velocity_rmse"] for joint in joints),
        "creep [rad/s]": max(joint["creep"] for joint in joints),
        "warnings": len(scores["warnings"]),
    }


def train(task: TaskConfig, critic: bool = False, net: Any = None) -> Figures:
    """Error [m/s], drift [m], travel, time at stops [s] of a new policy along x, y, z."""
    net = net or policy.load_policy(POLICY, M).net
    settings = {} if critic else GRADIENT_LEARNER
    config = PPOConfig(**{**settings, "total_steps": STEPS, "threads": 1})
    with tempfile.TemporaryDirectory() as folder:
        trained = train_policy(M, net, task, config, 0, Path(folder) / "policy.npz", critic)
    controllers = {"rl": policy.PolicyController(M, trained)}
    starts = sequences.evaluation_starts(M, 32, sequences.task_sequences(M), 2)
    result = {}
    for name, moves in (("nets", net), ("plant", None)):
        axes = sequences.axis_sequences(M)
        runs, _ = metrics.evaluate(M, controllers, axes, starts, 0, moves)
        for key in ("velocity_error_mean", "off_axis_drift_max", "valve_travel", "time_at_limits"):
            result[f"{name}, {key}"] = float(np.mean([run[key] for run in runs]))
    return result


@cache
def default_training() -> Figures:
    """The training with which the others are compared."""
    return train(TaskConfig())


def compare(**variants: Figures) -> Figures:
    """Figures of several variants in one table."""
    table = {}
    for variant, figures in variants.items():
        table |= {f"{variant}, {name}": value for name, value in figures.items()}
    return table


def d4() -> Figures:
    """Nets fitted with noise on their velocity inputs and without, seeds 0 and 1."""
    variants = {}
    for seed in (0, 1):
        for noise in (0.1, 0.0):
            variants[f"noise {noise}, seed {seed}"] = fit_scores("rich", seed, noise=noise)
    return compare(**variants)


def a4() -> Figures:
    """Nets fitted to rich excitation and to sines."""
    return compare(rich=fit_scores("rich", 0), sine=fit_scores("sine", 0))


def d5() -> Figures:
    """Policies trained with a cost of valve travel and without."""
    return compare(ours=default_training(), no_cost=train(TaskConfig(valve_cost=0.0)))


def d7() -> Figures:
    """The paper's agent by its own settings, on our nets; and a policy with newest angles."""
    paper = train(TaskConfig(paper=True, **PAPER_TASK), critic=True)
    with mock.patch.object(actuator, "smooth_angles", lambda _, history: history[..., 0, -1]):
        newest_angles = train(TaskConfig())
    return compare(paper=paper, newest_angles=newest_angles, ours=default_training())


def d10() -> Figures:
    """A policy with advantages by a critic."""
    return compare(critic=train(TaskConfig(), critic=True), ours=default_training())


def d11() -> Figures:
    """Policies on nets whose inputs are plain commands; and on such from a log without dither."""
    driven = [M.names[i] for i in M.driven]
    plain = joint_nets(fit_nets("rich", 0, dead_zone=0.0)[0], driven)
    mix = {"sine": 0.25, "step": 0.15, "holds": 0.25, "start": 0.35}
    with mock.patch.object(excitation, "MIX", mix):
        no_dither = joint_nets(fit_nets("rich", 0, dead_zone=0.0)[0], driven)
    return compare(
        plain=train(TaskConfig(), net=plain),
        no_dither=train(TaskConfig(), net=no_dither),
        ours=default_training(),
    )


def d12() -> Figures:
    """A policy whose actions have no dead-zone compensation."""
    limit = M.pwm_limit / PWM_MAX

    def action_to_pwm(m: machine.Machine, action: Array, paper: bool = False) -> Array:
        u = np.zeros((*action.shape[:-1], m.n), action.dtype)
        u[..., m.driven] = limit * np.clip(action, -1, 1)
        return machine.limit_command(m, u)

    def derivative(m: machine.Machine, u: Array, paper: bool = False) -> Array:
        return np.full_like(u[..., m.driven], limit)

    with ExitStack() as patches:
        for module in (env, policy, simulation_gradient):
            patches.enter_context(mock.patch.object(module, "action_to_pwm", action_to_pwm))
        name = "compensation_derivative"
        patches.enter_context(mock.patch.object(simulation_gradient, name, derivative))
        no_compensation = train(TaskConfig())
    return compare(no_compensation=no_compensation, ours=default_training())


def d13() -> Figures:
    """A policy that pays nothing for the error integral."""
    return compare(no_cost=train(TaskConfig(integral_cost=0.0)), ours=default_training())


def d14() -> Figures:
    """A policy trained on nets that go on from encoder angles."""

    def append(history: Array, u: Array, q: Array, samples: int, dt: float) -> Array:
        counts = np.rint(q / M.encoder_step[0])  # those of all joints are alike
        return actuator.append_sample(history, u, counts * M.encoder_step[0], samples, dt)

    with mock.patch.object(env, "append_sample", append):
        encoder_angles = train(TaskConfig())
    return compare(encoder_angles=encoder_angles, ours=default_training())


def d18() -> Figures:
    """A policy that pays for joints close to their limits."""
    return compare(ours=default_training(), cost=train(TaskConfig(limit_cost=0.3)))


def a5() -> Figures:
    """A policy that observes velocities in the base frame, not along the tool's heading."""
    with mock.patch.object(kinematics, "to_heading", lambda p_tool, v: v):
        base_frame = train(TaskConfig())
    return compare(base_frame=base_frame, heading=default_training())


def quiet() -> Figures:
    """Velocity errors [m/s] without noise: policies, shipped gains, gains tuned without noise."""
    config = TaskConfig(noise=0.0)
    shipped = POLICY.parent
    files = {name: policy.load_policy(shipped / file, M) for name, file in policy.POLICIES.items()}
    controllers: dict[str, Any] = {**policy.policy_controllers(M, files)}
    net = files["rl"].net
    effort = baselines.TUNING_RUNS, baselines.GENERATIONS, 0
    names = ("jacobian_pid_k0.1", *baselines.WITH_INTEGRAL)
    gains = baselines.read_gains(shipped / "gains.json", M, net)
    tuned, _ = baselines.tune_baselines(M, net, *effort, config, only=names)
    for name in names:
        controllers[name] = gains[name]
        controllers[f"{name}, tuned so"] = tuned[name]
    starts = sequences.workspace_starts(M, 64)
    axes = sequences.axis_sequences(M)
    runs, _ = metrics.evaluate(M, controllers, axes, starts, 0, config=config)
    return {
        name: float(rows["all"]["velocity_error_mean"] or 0.0)
        for name, rows in metrics.summary(runs).items()
    }


MEASURED: tuple[Callable[[], Figures], ...] = (a1, d1, d3, d6, a6, a7, a9, a11)
MEASURED += (levels, stand, dither, film)
TRAINED: tuple[Callable[[], Figures], ...] = (d4, a4, d5, d7, d10, d11, d12, d13, d14, d18, a5)
TRAINED += (quiet,)


def main(words: list[str]) -> None:
    """Print the entries that are named; without names all, or with `--train` those that train."""
    named = [entry for entry in MEASURED + TRAINED if entry.__name__ in words]
    for entry in named or (TRAINED if "--train" in words else MEASURED):
        figures = ", ".join(f"{name} {value:.4g}" for name, value in entry().items())
        print(f"{entry.__name__.upper():4} {entry.__doc__}\n     {figures}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
