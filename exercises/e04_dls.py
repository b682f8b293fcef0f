"""Least squares; equation (4) is no minimiser (45 minutes).

Which joint velocities move the tool at v? The arm has one way too many, and near a singularity the
exact answer is too fast. So the controller minimises

    f(q_dot) = |J q_dot - v|^2 + lambda^2 q_dot^T W q_dot

W is diagonal and positive: a large weight keeps a joint slow, for instance close to its limit. The
minimum is where the gradient vanishes. Half of the gradient is

    J^T (J q_dot - v) + lambda^2 W q_dot

Solve it for q_dot. The solution can be written with an inverse of 3 x 3, whatever the number of
joints. The paper prints W^-1 J^T (J W J^T + lambda^2 I)^-1 v. One symbol differs from yours. The
check computes f of both. For W = I they agree, which is how such an error survives.
"""

from collections.abc import Callable

import numpy as np
from hypothesis import strategies as st

from brokk_min.jacobian import dls
from brokk_min.machine import Array
from exercises.verdict import WrongAnswer, agree, expect

SOLUTION = "brokk_min/jacobian.py: dls"


def half_gradient(J: Array, W: Array, damping: float, v: Array, q_dot: Array) -> Array:
    """Half of df/dq_dot (n,). J (3, n), diagonal of the weights W (n,), damping = lambda^2."""
    raise NotImplementedError


def minimiser(J: Array, W: Array, damping: float, v: Array) -> Array:
    """The q_dot [rad/s] (n,) with the least f."""
    raise NotImplementedError


def f(J: Array, W: Array, damping: float, v: Array, q_dot: Array) -> float:
    """The cost that both formulas are said to minimise."""
    return float(np.sum((J @ q_dot - v) ** 2) + damping * q_dot @ (W * q_dot))


def check(half_gradient: Callable[..., Array], minimiser: Callable[..., Array]) -> None:
    """One joint by hand, difference quotients, then any Jacobian; and the printed form."""
    J, one = np.array([[2.0], [0.0], [0.0]]), np.ones(1)
    v = np.array([1.0, 0.0, 0.0])
    why = "By hand: 2 (2 x - 1) + 4 * 3 x"
    expect("half_gradient, one joint", half_gradient(J, 3 * one, 4.0, v, one), [14.0], why)
    why = "By hand: 4 x - 2 + 12 x = 0. The printed form gives 1/24."
    expect("minimiser, one joint of weight 3", minimiser(J, 3 * one, 4.0, v), [1 / 8], why)
    number = st.integers(-8, 8).map(lambda i: i / 4)
    weight = st.integers(1, 40).map(lambda i: i / 4)
    row = st.tuples(number, number, number, weight)
    cases = st.tuples(
        st.lists(row, min_size=1, max_size=4), weight, st.tuples(number, number, number)
    ).map(
        lambda c: (
            np.array([r[:3] for r in c[0]]).T,
            np.array([r[3] for r in c[0]]),
            c[1],
            np.array(c[2]),
        )
    )

    def slope(J: Array, W: Array, damping: float, v: Array) -> Array:
        step = 1e-5 * np.eye(len(W))
        x = np.ones(len(W))
        return np.array([(f(J, W, damping, v, x + d) - f(J, W, damping, v, x - d)) for d in step])

    def yours(J: Array, W: Array, damping: float, v: Array) -> Array:
        return 4e-5 * np.asarray(half_gradient(J, W, damping, v, np.ones(len(W))))

    agree("4e-5 half_gradient at q_dot = 1", yours, slope, cases, "Wanted: differences of f.")
    agree("minimiser", minimiser, lambda J, W, d, v: dls(J, W, d) @ v, cases)

    J = np.array([[-1.9, 0.4, 0.3, 0.2], [0.4, 1.8, 1.0, 0.3], [0.0, 2.0, 0.5, -0.6]])
    W, v, damping = np.array([1.0, 9.0, 1.0, 1.0]), np.array([0.1, 0.0, 0.2]), 0.05
    best = np.asarray(minimiser(J, W, damping, v))
    printed = dls(J, W, damping, as_printed=True) @ v
    print(f"f of yours {f(J, W, damping, v, best):.5f}, as printed", end=" ")
    print(f"{f(J, W, damping, v, printed):.5f}; half gradient as printed", end=" ")
    slope_printed = half_gradient(J, W, damping, v, printed)
    print(np.round(slope_printed, 3))
    if np.linalg.norm(slope_printed) < 1e-4:
        raise WrongAnswer("half_gradient: expected it to differ from 0 at the printed solution")
