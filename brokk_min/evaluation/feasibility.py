"""What ideal actuators can follow: which paths of the tool, and which speeds of the joints."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brokk_min.actuator import lever_arm
from brokk_min.jacobian import dls, limit_weights
from brokk_min.kinematics import forward_kinematics, jacobian, lowest_point, tool_position
from brokk_min.machine import PWM_MAX, Array, Machine, valve_opening

CRITERIA = (  # of `first_failure`, all margins assumed
    "the tool must stay within 20 mm of its path",
    "the arm must stay 0.1 m above Machine.ground",
    "a driven joint must stay 0.05 from its q_min and q_max",
    "a driven joint must stay below 0.9 of its q_dot_up and q_dot_down",
)


def feasible(machine: Machine, start: Array, goals: Array) -> NDArray[np.bool_]:
    """Can ideal actuators follow `goals` (T, num, 3) from `start` (num, n)? Shape (num,)."""
    return np.asarray(first_failure(machine, start, goals) == 0)


def first_failure(machine: Machine, start: Array, goals: Array) -> NDArray[np.int64]:
    """1 + the index in `CRITERIA` of what fails first on the path of `goals`, 0: nothing, (num,).

    Integrates resolved velocities with little damping from `start` (num, n) under `goals`
    (T, num, 3). The first criterion holds where no singularity is crossed.
    """
    q = np.array(start, float)
    q_dot = np.zeros_like(q)
    p_goal = tool_position(forward_kinematics(machine, q))
    result = np.zeros(len(q), np.int64)
    low, high = machine.column("q_min") + 0.05, machine.column("q_max") - 0.05
    up, down = machine.column("q_dot_up"), machine.column("q_dot_down")
    for v_goal in goals:
        frames = forward_kinematics(machine, q)
        p = tool_position(frames)
        J = jacobian(frames)[..., machine.driven]
        W = limit_weights(machine, q, q_dot)[:, machine.driven]
        J_inv = dls(J, W, np.full(len(q), 1e-4))
        v = v_goal + (p_goal - p)  # the second term brings the tool back to its path in 1 s
        on_path = np.linalg.norm(p_goal - p, axis=-1) < 0.02
        above_ground = lowest_point(frames) > machine.ground + 0.1
        q_dot = np.zeros_like(q)
        q_dot[:, machine.driven] = (J_inv @ v[..., None])[..., 0]
        q = q + q_dot * machine.dt
        p_goal = p_goal + v_goal * machine.dt
        within = ((q > low) & (q < high))[:, machine.driven].all(axis=-1)
        slow = ((q_dot > -0.9 * down) & (q_dot < 0.9 * up)).all(axis=-1)
        holds = np.stack([on_path, above_ground, within, slow])
        result = np.where((result == 0) & ~holds.all(axis=0), 1 + holds.argmin(axis=0), result)
        if result.all():
            break
    return result


def speed_limits(machine: Machine, q: ArrayLike) -> tuple[Array, Array]:
    """Fastest negative and positive velocity [rad/s] (..., n) of each joint at angles `q` [rad].

    They hold at the command limit, if no other joint needs the pump. Paper: eq1
    """
    limit = np.full(machine.n, machine.pwm_limit / PWM_MAX)
    r = lever_arm(machine, q)
    down = valve_opening(-limit, machine.dead_zones) * machine.column("speed_negative") / r
    up = valve_opening(limit, machine.dead_zones) * machine.column("speed_positive") / r
    return down, up


def most_frequent(failures: Sequence[NDArray[np.int64]]) -> str:
    """The criterion that failed most often, of results of `first_failure`."""
    counts = np.bincount(np.concatenate(failures), minlength=len(CRITERIA) + 1)[1:]
    first = counts.argmax()
    return f"{counts[first]} of {counts.sum()} others fail: {CRITERIA[first]}"
