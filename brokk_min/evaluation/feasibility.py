"""Which paths of the tool ideal actuators can follow."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from brokk_min.jacobian import dls, limit_weights
from brokk_min.kinematics import forward_kinematics, jacobian, lowest_point, tool_position
from brokk_min.machine import Array, Machine

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

    Integrates resolved velocities with little damping from `start` [rad] (num, n) under `goals`
    [m/s] (T, num, 3). The first criterion holds where no singularity is crossed.
    """
    q, q_dot = np.array(start, float), np.zeros((len(start), machine.n))
    p_goal = tool_position(forward_kinematics(machine, q))
    result = np.zeros(len(q), np.int64)
    low, high = machine.column("q_min") + 0.05, machine.column("q_max") - 0.05
    up, down = machine.column("q_dot_up"), machine.column("q_dot_down")
    for v_goal in goals:
        frames = forward_kinematics(machine, q)
        off = p_goal - tool_position(frames)
        J = jacobian(frames)[..., machine.driven]
        J_inv = dls(J, limit_weights(machine, q, q_dot)[:, machine.driven], 1e-4)
        holds = [np.linalg.norm(off, axis=-1) < 0.02, lowest_point(frames) > machine.ground + 0.1]
        v = v_goal + off  # the second term brings the tool back to its path in 1 s
        q_dot = np.zeros_like(q)
        q_dot[:, machine.driven] = (J_inv @ v[..., None])[..., 0]
        q, p_goal = q + q_dot * machine.dt, p_goal + v_goal * machine.dt
        holds.append(((q > low) & (q < high))[:, machine.driven].all(axis=-1))
        holds.append(((q_dot > -0.9 * down) & (q_dot < 0.9 * up)).all(axis=-1))
        failure = np.where(np.all(holds, axis=0), 0, 1 + np.argmin(holds, axis=0))
        result = np.where(result == 0, failure, result)
    return result


def most_frequent(failures: Sequence[NDArray[np.int64]]) -> str:
    """The criterion that failed most often, of results of `first_failure`."""
    counts = np.bincount(np.concatenate(failures), minlength=1 + len(CRITERIA))[1:]
    return f"{counts.max()} of {counts.sum()} others fail: {CRITERIA[counts.argmax()]}"
