"""What damping costs near a singularity (30 minutes).

Stretch the arm: no joint can move the tool further out any more. The determinant of J J^T goes to
zero there, and the exact joint velocities of an outward goal to infinity. The manipulability

    w = sqrt(det(J J^T))    (Yoshikawa, 1985)

says how near it is. Nakamura and Hanafusa (1986) let the damping set in below a threshold w0:

    lambda^2 = k (1 - w / w0)^2    for w < w0, otherwise 0

The paper takes k = 0.1 and 0.05. All weights are 1 here. Whatever the pose, then

    |q_dot| <= |v| / (2 lambda)

because s / (s^2 + lambda^2) <= 1 / (2 lambda) for each singular value s of J. The price is a tool
that is slower than its goal. The check prints both, on the way to the stretched arm.
"""

from collections.abc import Callable

import numpy as np
from hypothesis import strategies as st

from brokk_min import jacobian as classic
from brokk_min.kinematics import forward_kinematics, jacobian
from brokk_min.machine import BROKK_170, Array
from exercises.verdict import agree, expect

SOLUTION = "brokk_min/jacobian.py: manipulability, nakamura_damping, dls"


def damping(J: Array, w0: float, k: float) -> float:
    """lambda^2 of a Jacobian (3, n)."""
    raise NotImplementedError


def damped_velocities(J: Array, v: Array, w0: float, k: float) -> Array:
    """Joint velocities [rad/s] (n,) for the tool velocity v [m/s] (3,), damped with weights 1."""
    raise NotImplementedError


def jacobian_at(bend: float) -> Array:
    """Jacobian (3, 4) of the Brokk's driven joints, two joints bent by so much [rad]; 0: straight.

    Its stops do not let it get quite straight.
    """
    q = np.array([0.0, 0.5, 0.0, np.pi - bend, 0.75 * np.pi - bend])
    return jacobian(forward_kinematics(BROKK_170, q))[:, BROKK_170.driven]


def check(damping: Callable[..., float], damped_velocities: Callable[..., Array]) -> None:
    """By hand, then poses of the Brokk."""
    J = np.diag([1.0, 1.0, 0.5])
    expect("damping(diag(1, 1, 0.5), 1, 0.1)", damping(J, 1.0, 0.1), 0.025, "w is 0.5 there.")
    expect("damping(diag(1, 1, 0.5), 0.4, 0.1)", damping(J, 0.4, 0.1), 0.0, "w is above w0.")
    z = np.array([0.0, 0.0, 1.0])
    q_dot = damped_velocities(np.diag([1.0, 1.0, 0.0]), z, 1.0, 0.1)
    expect("damped_velocities(diag(1, 1, 0), z)", q_dot, [0, 0, 0], "No joint can move it there.")
    q_dot = damped_velocities(J, z, 1.0, 0.1)
    expect("damped_velocities(diag(1, 1, 0.5), z)", q_dot, [0, 0, 0.5 / 0.275])
    w0 = classic.manipulability_threshold(BROKK_170)

    def ours(bend: float) -> Array:
        J = jacobian_at(bend)
        square = classic.nakamura_damping(classic.manipulability(J), w0, 0.1)
        return classic.dls(J, np.ones(4), square) @ np.array([0.1, 0.0, 0.0])

    def yours(bend: float) -> Array:
        return damped_velocities(jacobian_at(bend), np.array([0.1, 0.0, 0.0]), w0, 0.1)

    angles = st.integers(1, 150).map(lambda i: i / 100)
    agree("damped_velocities of the Brokk, bend ", yours, ours, st.tuples(angles))
    print(" bend      w  lambda  |q_dot|  exact    bound   tool along the goal of 0.1 m/s")
    v = np.array([0.1, 0.0, 0.0])
    for bend in (1.2, 0.6, 0.2, 0.1, 0.05, 0.02):
        J = jacobian_at(bend)
        exact = np.linalg.norm(np.linalg.lstsq(J, v, rcond=None)[0])
        q_dot = np.asarray(damped_velocities(J, v, w0, 0.1))
        size, root = np.linalg.norm(q_dot), np.sqrt(damping(J, w0, 0.1))
        bound = 0.1 / (2 * root) if root else np.inf
        w = classic.manipulability(J)
        numbers = f"{w:6.2f} {root:7.3f} {size:8.3f} {exact:6.3f} {bound:8.3f}"
        print(f"{bend:5.2f} {numbers} {(J @ q_dot)[0]:9.3f}")
