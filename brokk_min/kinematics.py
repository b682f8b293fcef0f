"""Hand-written Denavit-Hartenberg kinematics: frames, tool position, Jacobian, tool velocity.

One forward kinematics gives the frames of a pose; all else is worked out from these frames. The
base frame has z up; its origin lies on the first axis, for the Brokk at ground level. Paper: Fig. 1
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from brokk_min.machine import Array, Machine


class Frames(NamedTuple):
    """Frame 0 is the base, frame i moves with joint i, frame n is at the tool tip."""

    p: Array  # origins p_0 .. p_n [m], (..., n + 1, 3)
    z: Array  # unit vectors z_0 .. z_n, (..., n + 1, 3); z_{i-1} is the axis of joint i
    prismatic: list[int]  # joints that slide along their axis, from 0


def forward_kinematics(machine: Machine, q: ArrayLike) -> Frames:
    """Frames at joint variables `q` [rad, m if prismatic] (..., n), which keep their float type.

    T_i = T_{i-1} Rz(theta_i) Tz(d_i) Tx(a_i) Rx(alpha_i) (standard Denavit-Hartenberg), with
    theta_i + q_i for theta_i of a revolute joint and d_i + q_i for d_i of a prismatic one.

    ValueError: `q` has another number of joints.

    >>> forward_kinematics(BROKK_170, np.zeros((256, 5))).p.shape
    (256, 6, 3)
    """
    q = 1.0 * np.asarray(q)  # whole numbers become floats
    if q.shape[-1:] != (machine.n,):
        raise ValueError(f"q: expected (..., {machine.n}), got {q.shape}")
    # x, y, z are the axes of the present frame. Arrays in here have their own axes reversed, so a
    # vector is (3, ...) and c * x scales that of each pose: half the time of (..., 3) at 256 poses.
    q = np.ascontiguousarray(q.T)
    p = np.zeros((3, machine.n + 1, *q.shape[1:]), q.dtype)
    axes = np.zeros_like(p)
    x, y, z = np.eye(3, dtype=q.dtype).reshape(3, 3, *[1] * (q.ndim - 1))
    axes[:, 0] = z
    slides = [joint.kind == "prismatic" for joint in machine.joints]
    for i, joint in enumerate(machine.joints):
        theta, d = (joint.theta, joint.d + q[i]) if slides[i] else (joint.theta + q[i], joint.d)
        x, y = rotate(x, y, np.cos(theta), np.sin(theta))  # Rz(theta)
        p[:, i + 1] = p[:, i] + d * z + joint.a * x  # Tz(d) Tx(a)
        if joint.alpha:
            y, z = rotate(y, z, math.cos(joint.alpha), math.sin(joint.alpha))  # Rx(alpha)
        axes[:, i + 1] = z
    return Frames(p.T, axes.T, [i for i in range(machine.n) if slides[i]])


def rotate(a: Array, b: Array, c: Array | float, s: Array | float) -> tuple[Array, Array]:
    """The vectors `a` and `b`, turned in their plane by an angle with cosine `c` and sine `s`.

    >>> rotate(np.array([1, 0]), np.array([0, 1]), 0, 1)  # a quarter turn
    (array([0, 1]), array([-1,  0]))
    """
    return c * a + s * b, c * b - s * a


def tool_position(frames: Frames) -> Array:
    """Position p_n of the tool tip in the base frame [m], (..., 3).

    >>> q = [0.0, 0.0, 0.0, np.pi, 3 * np.pi / 4]  # the arm straight and level
    >>> tool_position(forward_kinematics(BROKK_170, q)).round(2) + 0.0
    array([5.  , 0.  , 0.95])
    """
    return frames.p[..., -1, :]


def jacobian(frames: Frames) -> Array:
    """Derivative of the tool position by all joints [m/rad or 1], (..., 3, n). Paper: eq3 (J)

    J_i = z_{i-1} x (p_n - p_{i-1}), i = 1 .. n; J_i = z_{i-1} of a prismatic joint.

    >>> J = jacobian(forward_kinematics(BROKK_170, np.zeros((256, 5))))
    >>> J.shape, J[0, 1, 0].round(2).tolist()  # the slew moves the tool along y
    ((256, 3, 5), 2.35)
    """
    J = np.cross(frames.z[..., :-1, :], frames.p[..., -1:, :] - frames.p[..., :-1, :])
    for i in frames.prismatic:
        J[..., i, :] = frames.z[..., i, :]  # J_i = z_{i-1}; `i` counts from 0
    return np.swapaxes(J, -1, -2)


def tool_velocity(frames: Frames, q_dot: ArrayLike) -> Array:
    """Velocity J q_dot of the tool tip in the base frame [m/s], (..., 3).

    `q_dot` [rad/s or m/s] (..., n) is of all joints, locked ones included. Paper: Sec. 3.4

    >>> frames = forward_kinematics(BROKK_170, np.zeros(5))
    >>> tool_velocity(frames, [1.0, 0.0, 0.0, 0.0, 0.0]).round(2) + 0.0
    array([0.  , 2.35, 0.  ])
    """
    return np.asarray((jacobian(frames) @ np.asarray(q_dot)[..., None])[..., 0])  # v = J q_dot


def lowest_point(frames: Frames) -> Array:
    """Height of the lowest of the origins p_1 .. p_n, the ends of the links [m], (...).

    >>> frames = forward_kinematics(BROKK_170, [0.0, 0.0, 0.0, np.pi, 3 * np.pi / 4])
    >>> round(float(lowest_point(frames)), 2)
    0.95
    """
    return np.asarray(frames.p[..., 1:, 2].min(axis=-1))
