"""What the deviations and assumptions of PAPER.md change, measured.

Each function returns the figures of one entry; `python -m benchmarks.deviations` prints them. D4, D5, D7,
D10 to D14, A4 and A5 fit nets and train policies: `python -m benchmarks.deviations --train`, some 25 minutes.
An entry's name prints that entry alone: `python -m benchmarks.deviations d4`.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from brokk_min import actuator, env, jacobian, kinematics, machine, observation
from brokk_min.cli.options import SHIPPED
from brokk_min.env import TaskConfig, terminated
from brokk_min.evaluation import metrics, sequences
from brokk_min.evaluation.rollout import rollout
from brokk_min.identification import excitation, fitting, logs, validation
from brokk_min.jacobian import JacobianController
from brokk_min.learning.gym_env import TaskVectorEnv
from brokk_min.learning.policy import STAND, PolicyController, load_policy
from brokk_min.machine import BROKK_170, PWM_MAX, read_encoder

M = BROKK_170
LOW, HIGH = M.column("q_min"), M.column("q_max")
# By hand, as `baselines.baselines` starts from.
GAINS = {"kp": 1.0, "ki": 8.0, "kd": 0.05, "feedback": 0.4, "ready": 0.015}


def a1() -> dict[str, float]:
    """Share of poses off the ground in which Nakamura's damping acts; and of those beyond 2.5 m."""
    q = np.random.default_rng(0).uniform(LOW, HIGH, (20_000, M.n))
    frames = kinematics.forward_kinematics(M, q)
    p, lowest = kinematics.tool_position(frames), kinematics.lowest_point(frames)
    damped = jacobian.manipulability(
        kinematics.jacobian(kinematics.forward_kinematics(M, q))[..., M.driven]
    ) < jacobian.manipulability_threshold(M)
    off, far = ~terminated(M, lowest), np.hypot(p[:, 0], p[:, 1]) > 2.5
    return {"all": float(damped[off].mean()), "far": float(damped[off & far].mean())}


def d1() -> dict[str, float]:
    """Share of the wanted tool velocity that both forms of eq4 miss, over random poses and directions."""
    rng = np.random.default_rng(0)
    q, v = rng.uniform(LOW, HIGH, (4000, M.n)), rng.standard_normal((4000, 3))
    J = kinematics.jacobian(kinematics.forward_kinematics(M, q))[..., M.driven]
    W = jacobian.limit_weights(M, q, rng.standard_normal(q.shape))[:, M.driven]
    damping = jacobian.nakamura_damping(
        jacobian.manipulability(J), jacobian.manipulability_threshold(M), 0.1
    )
    result = {}
    for name, printed in (("corrected", False), ("printed", True)):
        rates = jacobian.dls(J, W, damping, printed) @ v[..., None]
        missed = np.linalg.norm((J @ rates)[..., 0] - v, axis=-1) / np.linalg.norm(v, axis=-1)
        result |= {
            f"{name}, median": float(np.median(missed)),
            f"{name}, mean": float(missed.mean()),
        }
    return result


def d3() -> dict[str, float]:
    """Deviation [rad/s] of two velocities of a joint at a steady 0.1 rad/s behind a 12-bit encoder."""
    q = machine.read_encoder(M, 0.1 * M.dt * np.arange(4000) + 1e-4)
    slope = [
        machine.estimate_velocity(q[: i + 1], M.velocity_samples, M.dt) for i in range(3, len(q))
    ]
    return {"one tick": float(np.std(np.diff(q) * M.rate)), "4 samples": float(np.std(slope))}


def d6() -> dict[str, float]:
    """Share of episodes that reach the ground under random commands held for 1 s."""
    env, rng, ends, over = TaskVectorEnv(128), np.random.default_rng(0), 0, 0
    env.reset(seed=0)
    for tick in range(800):
        if tick % 20 == 0:
            action = rng.uniform(-1, 1, (128, 4)).astype(np.float32)
        _, _, ground, time, _ = env.step(action)
        ends, over = ends + int(ground.sum()), over + int((ground | time).sum())
    return {"share": ends / over}


def a7() -> dict[str, float]:
    """Share of the poses that are uniform over the joints' ranges and reach into the ground."""
    q = np.random.default_rng(0).uniform(LOW, HIGH, (100_000, M.n))
    return {
        "share": float(
            terminated(M, kinematics.lowest_point(kinematics.forward_kinematics(M, q))).mean()
        )
    }


def a9() -> dict[str, float]:
    """Share of poses off the ground from which each sequence, and all three, are feasible."""
    good = []
    q = env.draw_pose(M, TaskConfig(), np.random.default_rng(0), 3000)
    for sequence in sequences.axis_sequences(M):
        goals = np.repeat(sequence.goals[:, None], len(q), axis=1)
        good.append(sequences.feasible(M, q, goals))
    return {
        name: float(g.mean())
        for name, g in zip(["x", "y", "z", "all"], [*good, np.all(good, axis=0)])
    }


def error(gains: dict[str, float], noise: float) -> float:
    """Mean velocity error [m/s] of the baseline k = 0.1 with gains set by hand, x, y, z from 8 starts."""
    every = sequences.axis_sequences(M)
    starts = sequences.draw_starts(M, every, 8, np.random.default_rng(2))
    w0 = jacobian.manipulability_threshold(M)
    controller = JacobianController(M, jacobian.join_gains(M, gains), 0.1, w0)
    errors = []
    for sequence in every:
        goals, rng = (
            np.repeat(sequence.goals[:, None], len(starts), axis=1),
            np.random.default_rng(0),
        )
        trace = rollout(M, controller, starts, goals, replace(TaskConfig(), noise=noise), rng)
        errors.append(np.linalg.norm(goals - trace.v_tool, axis=-1).mean())
    return float(np.mean(errors))


def a6() -> dict[str, float]:
    """Velocity error [m/s] of a baseline with and without the noise."""
    return {"5 %": error(GAINS, 0.05), "none": error(GAINS, 0.0)}


def a11() -> dict[str, float]:
    """Velocity error [m/s] of a baseline that keeps its valves open, and of one that lets them go idle."""
    return {"open": error(GAINS, 0.05), "idle": error(GAINS | {"ready": 0.0}, 0.05)}


def stand() -> dict[str, float]:
    """Way [m] of the tool from 0.5 s after a stop until valves close; dead zone as told, and less."""
    starts = sequences.evaluation_starts(M, 64, sequences.task_sequences(M), 2)
    starts = starts[np.array(sequences.start_kinds(M, starts)) == "workspace"]
    policy = PolicyController(M, load_policy(SHIPPED / M.name / "policy.npz", M))
    result = {}
    for dead_zone in (M.dead_zone, M.dead_zone - 0.02):
        plant, ways = replace(M, dead_zone=dead_zone), []
        for direction in np.concatenate([np.eye(3), -np.eye(3)]):
            goals = np.zeros((110, len(starts), 3))
            goals[:40] = 2 / 3 * M.tool_speed * direction
            p = rollout(plant, policy, starts, goals, TaskConfig(), np.random.default_rng(0)).p_tool
            ways.append(np.linalg.norm(p[39 + round(STAND * M.rate)] - p[49], axis=-1))
        result |= {
            f"{dead_zone:.2f}, median": np.median(ways),
            f"{dead_zone:.2f}, most": np.max(ways),
        }
    return {name: float(way) for name, way in result.items()}


# --- by fitting and training --------------------------------------------------------------------------

NOISE = fitting.FitConfig().noise
STEPS = 2_000_000  # of each training here, a third of the default


def nets(kind: str, seed: int, **settings: float) -> tuple[actuator.ActuatorNet, logs.Log]:
    """Nets fitted to 1 h a joint with some settings, and the log."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.npz"
        logs.write_log(path, excitation.collect(M, 1.0, kind, np.random.default_rng(seed)))
        log = logs.read_log([path], M.velocity_samples)
    config = replace(fitting.FitConfig(dead_zone=M.dead_zone), **dict[str, Any](settings))
    return fitting.fit(log, config, seed, M.velocity_samples, M.name), log


@cache
def fitted(kind: str, noise: float, seed: int) -> dict[str, float]:
    """Nets of the driven joints, on drives like a policy's: the worst joint."""
    net, log = nets(kind, seed, noise=noise)
    test = excitation.task_log(M, 20, 40.0, np.random.default_rng(seed + 1))
    verdict = validation.validate(net, log, test, M)
    rows = [verdict["joints"][M.names[i]] for i in M.driven]
    return {
        "10 s [rad/s]": max(row["free_run"]["10"]["velocity_rmse"] for row in rows),
        "creep [rad/s]": max(row["creep"] for row in rows),
        "warnings": len(verdict["warnings"]),
    }


def trained(
    task: TaskConfig, critic: bool = False, net: actuator.ActuatorNet | None = None
) -> dict[str, float]:
    """Error [m/s], drift [m] and travel of a policy trained on given nets, on these and on the plant.

    Along x, y and z.
    """
    from brokk_min.ppo import PPOConfig, train

    net = net or load_policy(SHIPPED / M.name / "policy.npz", M).net
    with tempfile.TemporaryDirectory() as folder:
        config = PPOConfig(total_steps=STEPS, critic=critic, threads=1)
        policy = train(M, net, task, config, 0, Path(folder) / "policy.npz")
    axes, controller = sequences.axis_sequences(M), {"rl": PolicyController(M, policy)}
    starts = sequences.evaluation_starts(M, 32, sequences.task_sequences(M), 2)
    result = {}
    for name, moves in (("nets", net), ("plant", None)):
        runs, _ = metrics.evaluate(M, controller, axes, starts, 0, moves)
        for key in ("velocity_error_mean", "off_axis_drift_max", "valve_travel"):
            result[f"{name}, {key}"] = float(np.mean([run[key] for run in runs]))
    return result


def beside(**ways: dict[str, float]) -> dict[str, float]:
    """Figures of several ways under one roof."""
    return {f"{way}, {name}": value for way, of in ways.items() for name, value in of.items()}


@cache
def as_it_is() -> dict[str, float]:
    """The training that the others are compared with."""
    return trained(TaskConfig())


def d4() -> dict[str, float]:
    """Nets fitted with noise on their velocity inputs and without, seeds 0 and 1."""
    ways = {f"noise {n}, seed {s}": fitted("rich", n, s) for s in (0, 1) for n in (NOISE, 0.0)}
    return beside(**ways)


def a4() -> dict[str, float]:
    """Nets fitted to rich excitation and to sines."""
    return beside(rich=fitted("rich", NOISE, 0), sine=fitted("sine", NOISE, 0))


def d5() -> dict[str, float]:
    """Policies trained with a cost of moving the valves and without."""
    return beside(ours=as_it_is(), **{"no cost": trained(TaskConfig(valve_cost=0.0))})


def d7() -> dict[str, float]:
    """Policies with the paper's observation, reward and critic, and with newest angles instead of all."""
    ours, paper = as_it_is(), trained(TaskConfig(paper=True))
    angles = observation._angles

    def newest(machine: machine.Machine, values: env.Array) -> env.Array:
        q = angles(machine, values)
        q[..., machine.driven] = observation._moving(machine, values)[..., 0, -1]
        return q

    with mock.patch.object(observation, "_angles", newest):
        return beside(paper=paper, **{"newest angles": trained(TaskConfig())}, ours=ours)


def d10() -> dict[str, float]:
    """A policy whose actions a critic judged."""
    return beside(critic=trained(TaskConfig(), critic=True), ours=as_it_is())


def d11() -> dict[str, float]:
    """Policies trained on nets that see plain commands; and on such from a log in which no valve hovers."""
    driven = [M.names[i] for i in M.driven]
    plain = nets("rich", 0, dead_zone=0.0)[0].select(driven)
    with mock.patch.object(
        excitation, "MIX", {"sine": 0.25, "step": 0.15, "holds": 0.25, "go": 0.35}
    ):
        both = nets("rich", 0, dead_zone=0.0)[0].select(driven)
    ways = {
        "plain": trained(TaskConfig(), net=plain),
        "no hovering": trained(TaskConfig(), net=both),
    }
    return beside(**ways, ours=as_it_is())


def d12() -> dict[str, float]:
    """A policy whose actions begin at 0 counts, dead zone and all."""
    ours = as_it_is()
    with mock.patch.object(
        observation, "_command_range", lambda machine: (0.0, machine.pwm_limit / PWM_MAX)
    ):
        return beside(**{"from 0": trained(TaskConfig())}, ours=ours)


def d13() -> dict[str, float]:
    """A policy that pays nothing for what the tool stays behind."""
    return beside(**{"no cost": trained(TaskConfig(integral_cost=0.0))}, ours=as_it_is())


def d14() -> dict[str, float]:
    """A policy trained on nets that go on from what encoders say."""
    ours, push = as_it_is(), env.push_motion

    def stepwise(
        machine: machine.Machine, history: env.Array, u: env.Array, q: env.Array
    ) -> env.Array:
        return push(machine, history, u, read_encoder(machine, q))

    with mock.patch.object(env, "push_motion", stepwise):
        return beside(**{"encoder steps": trained(TaskConfig())}, ours=ours)


def a5() -> dict[str, float]:
    """A policy that sees velocities in the base frame instead of along the tool's heading."""
    ours = as_it_is()
    with mock.patch.object(observation, "_turn", lambda p_tool, vector, sign: vector.copy()):
        return beside(**{"base frame": trained(TaskConfig()), "heading": ours})


ENTRIES: tuple[Callable[[], dict[str, float]], ...] = (a1, d1, d3, d6, a6, a7, a9, a11, stand)
TRAINED: tuple[Callable[[], dict[str, float]], ...] = (d4, a4, d5, d7, d10, d11, d12, d13, d14, a5)


def main() -> None:
    """Print the figures of the entries named; of none named, all, or with `--train` those that need it."""
    named = [entry for entry in (*ENTRIES, *TRAINED) if entry.__name__ in sys.argv[1:]]
    for entry in named or (TRAINED if "--train" in sys.argv[1:] else ENTRIES):
        figures = ", ".join(f"{name} {value:.4g}" for name, value in entry().items())
        print(f"{entry.__name__.upper():4} {entry.__doc__}\n     {figures}", flush=True)


if __name__ == "__main__":
    main()
