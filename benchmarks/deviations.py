"""What the deviations and assumptions of PAPER.md change, as far as it can be measured without training.

Each function returns the figures of one entry; `python -m benchmarks.deviations` prints them all.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from brokk_min import jacobian, kinematics, machine, sequences
from brokk_min.env import TaskConfig, TaskVectorEnv, rollout, terminated
from brokk_min.jacobian import JacobianController
from brokk_min.machine import BROKK_170

M = BROKK_170
LOW, HIGH = M.column("q_min"), M.column("q_max")
# By hand, as `experiments.baselines` starts from.
GAINS = {"kp": 1.0, "ki": 8.0, "kd": 0.05, "feedback": 0.4, "ready": 0.015}


def a1() -> dict[str, float]:
    """Share of poses off the ground in which Nakamura's damping acts; and of those beyond 2.5 m."""
    q = np.random.default_rng(0).uniform(LOW, HIGH, (20_000, M.n))
    p, _, lowest = kinematics.tool_state(M, q, 0 * q)
    damped = jacobian.manipulability(kinematics.jacobian(M, q)) < jacobian.manipulability_threshold(M)
    off, far = ~terminated(M, lowest), np.hypot(p[:, 0], p[:, 1]) > 2.5
    return {"all": float(damped[off].mean()), "far": float(damped[off & far].mean())}


def d1() -> dict[str, float]:
    """Share of the wanted tool velocity that both forms of eq4 miss, over random poses and directions."""
    rng = np.random.default_rng(0)
    q, v = rng.uniform(LOW, HIGH, (4000, M.n)), rng.standard_normal((4000, 3))
    J = kinematics.jacobian(M, q)
    W = jacobian.limit_weights(M, q, rng.standard_normal(q.shape))[:, M.driven]
    damping = jacobian.nakamura_damping(jacobian.manipulability(J), jacobian.manipulability_threshold(M), 0.1)
    result = {}
    for name, printed in (("corrected", False), ("printed", True)):
        rates = jacobian.dls(J, W, damping, printed) @ v[..., None]
        missed = np.linalg.norm((J @ rates)[..., 0] - v, axis=-1) / np.linalg.norm(v, axis=-1)
        result |= {f"{name}, median": float(np.median(missed)), f"{name}, mean": float(missed.mean())}
    return result


def d3() -> dict[str, float]:
    """Deviation [rad/s] of two velocities of a joint at a steady 0.1 rad/s behind a 12-bit encoder."""
    q = machine.read_encoder(M, 0.1 * M.dt * np.arange(4000) + 1e-4)
    slope = [machine.estimate_velocity(q[: i + 1], M.velocity_samples, M.dt) for i in range(3, len(q))]
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
    return {"share": float(terminated(M, kinematics.lowest_point(M, q)).mean())}


def a9() -> dict[str, float]:
    """Share of poses off the ground from which each sequence, and all three, are feasible."""
    good = []
    q = sequences.draw_pose(M, TaskConfig(), np.random.default_rng(0), 3000)
    for sequence in sequences.axis_sequences(M):
        goals = np.repeat(sequence.goals[:, None], len(q), axis=1)
        good.append(sequences.feasible(M, q, goals))
    return {name: float(g.mean()) for name, g in zip(["x", "y", "z", "all"], [*good, np.all(good, axis=0)])}


def error(gains: dict[str, float], noise: float) -> float:
    """Mean velocity error [m/s] of the baseline k = 0.1 with gains set by hand, x, y, z from 8 starts."""
    every = sequences.axis_sequences(M)
    starts = sequences.draw_starts(M, every, 8, np.random.default_rng(2))
    w0 = jacobian.manipulability_threshold(M)
    controller = JacobianController(M, jacobian.join_gains(M, gains), 0.1, w0)
    errors = []
    for sequence in every:
        goals, rng = np.repeat(sequence.goals[:, None], len(starts), axis=1), np.random.default_rng(0)
        trace = rollout(M, controller, starts, goals, replace(TaskConfig(), noise=noise), rng)
        errors.append(np.linalg.norm(goals - trace.v_tool, axis=-1).mean())
    return float(np.mean(errors))


def a6() -> dict[str, float]:
    """Velocity error [m/s] of a baseline with and without the noise."""
    return {"5 %": error(GAINS, 0.05), "none": error(GAINS, 0.0)}


def a11() -> dict[str, float]:
    """Velocity error [m/s] of a baseline that keeps its valves open, and of one that lets them go idle."""
    return {"open": error(GAINS, 0.05), "idle": error(GAINS | {"ready": 0.0}, 0.05)}


ENTRIES: tuple[Callable[[], dict[str, float]], ...] = (a1, d1, d3, d6, a6, a7, a9, a11)


def main() -> None:
    """Print all figures."""
    for entry in ENTRIES:
        figures = ", ".join(f"{name} {value:.4g}" for name, value in entry().items())
        print(f"{entry.__name__.upper():4} {entry.__doc__}\n     {figures}")


if __name__ == "__main__":
    main()
