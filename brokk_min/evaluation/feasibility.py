"""Which paths of the tool ideal actuators can follow."""

import numpy as np
from numpy.typing import NDArray

from brokk_min.jacobian import dls, limit_weights
from brokk_min.kinematics import forward_kinematics, jacobian, lowest_point, tool_position
from brokk_min.machine import Array, Machine

MARGINS = (  # of `feasible`, all assumed
    "the tool within 20 mm of its path, the arm 0.1 m above the ground, driven joints 0.05 from "
    "their ends and below 0.9 of their speeds"
)


def feasible(machine: Machine, start: Array, goals: Array) -> NDArray[np.bool_]:
    """Can ideal actuators follow `goals` [m/s] (T, num, 3) from `start` [rad] (num, n)? (num,).

    Integrates resolved velocities with little damping, and asks for `MARGINS` at each tick.
    The tool stays on its path where no singularity is crossed.
    """
    q, q_dot = np.array(start, float), np.zeros((len(start), machine.n))
    p_goal = tool_position(forward_kinematics(machine, q))
    result = np.ones(len(q), bool)
    low, high = machine.column("q_min") + 0.05, machine.column("q_max") - 0.05
    up, down = machine.column("q_dot_up"), machine.column("q_dot_down")
    for v_goal in goals:
        frames = forward_kinematics(machine, q)
        off = p_goal - tool_position(frames)
        J = jacobian(frames)[..., machine.driven]
        J_inv = dls(J, limit_weights(machine, q, q_dot)[:, machine.driven], 1e-4)
        result &= np.linalg.norm(off, axis=-1) < 0.02
        result &= lowest_point(frames) > machine.ground + 0.1
        v = v_goal + off  # the second term brings the tool back to its path in 1 s
        q_dot = np.zeros_like(q)
        q_dot[:, machine.driven] = (J_inv @ v[..., None])[..., 0]
        q, p_goal = q + q_dot * machine.dt, p_goal + v_goal * machine.dt
        result &= ((q > low) & (q < high))[:, machine.driven].all(axis=-1)
        result &= ((q_dot > -0.9 * down) & (q_dot < 0.9 * up)).all(axis=-1)
    return result
