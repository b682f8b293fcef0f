"""Weighted damped least squares, its weights and its damping, where the controller runs."""

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from strategies import machines, moving, posed, reals

from brokk_min.jacobian import (
    Gains,
    JacobianController,
    dls,
    limit_gradient,
    limit_weights,
    manipulability,
    nakamura_damping,
)
from brokk_min.kinematics import forward_kinematics, jacobian
from brokk_min.machine import Machine

velocities = npst.arrays(np.float64, 3, elements=reals(-1, 1))
dampings = reals(1e-3, 10)  # lambda^2
STEP = 1e-6  # rad, of central differences


@st.composite
def problems(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray, float, np.ndarray]:
    """J (3, n), diagonal W (n,), lambda^2 and v (3,), well conditioned."""
    n = draw(st.integers(1, 6))
    J = draw(npst.arrays(np.float64, (3, n), elements=reals(-3, 3)))
    W = draw(npst.arrays(np.float64, n, elements=reals(0.1, 100)))
    return J, W, draw(dampings), draw(velocities)


@st.composite
def hard_problems(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray, float, np.ndarray]:
    """The same as the controller meets it: weights up to 1e6, lambda^2 from 1e-9 on."""
    machine, q = draw(posed(shapes=[()]))
    J = jacobian(forward_kinematics(machine, q))
    W = 10.0 ** draw(npst.arrays(np.float64, machine.n, elements=reals(0, 6)))
    return J, W, 10.0 ** draw(reals(-9, -1)), draw(velocities)


def best_velocities(J, W, damping, v):
    """argmin |J x - v|^2 + lambda^2 x^T W x by a QR of the stacked rows, in y = W^1/2 x."""
    rows = np.vstack([J / np.sqrt(W), np.sqrt(damping) * np.eye(len(W))])
    Q, R = scipy.linalg.qr(rows, mode="economic")
    y = scipy.linalg.solve_triangular(R, Q.T @ np.concatenate([v, np.zeros(len(W))]))
    return y / np.sqrt(W)


def cost(J, W, damping, v, x):
    return np.sum((J @ x - v) ** 2) + damping * np.sum(W * x**2)


# --- least squares --------------------------------------------------------------------------------


@given(problems())
def test_dls__solves_the_normal_equations(problem):
    """J^T (J q_dot - v) + lambda^2 W q_dot = 0: the gradient of the cost of eq4 vanishes."""
    J, W, damping, v = problem
    q_dot = dls(J, W, damping) @ v
    np.testing.assert_allclose(J.T @ (J @ q_dot - v) + damping * W * q_dot, 0, atol=1e-8)
    np.testing.assert_allclose(q_dot, best_velocities(*problem), atol=1e-8)


@given(hard_problems())
def test_dls__costs_no_more_than_the_optimum_where_the_controller_runs(problem):
    """The cost of eq4, because joint velocities themselves are hardly determined there."""
    J, W, damping, v = problem
    least = cost(*problem, best_velocities(*problem))
    found = cost(*problem, dls(J, W, damping) @ v)
    assert least * (1 - 1e-6) - 1e-9 <= found <= least * (1 + 1e-6) + 1e-9


@given(problems())
def test_dls__the_printed_form_agrees_for_unit_weights_only(problem):
    """eq4 prints J W J^T in the bracket."""
    J, W, damping, _v = problem
    one = np.ones_like(W)
    printed = dls(J, one, damping, as_printed=True)
    np.testing.assert_allclose(printed, dls(J, one, damping), atol=1e-12)
    W_inv_Jt = (J / W).T
    printed = W_inv_Jt @ np.linalg.inv((J * W) @ J.T + damping * np.eye(3))
    np.testing.assert_allclose(dls(J, W, damping, as_printed=True), printed, atol=1e-7, rtol=1e-6)


# --- weights --------------------------------------------------------------------------------------


def limit_function(machine: Machine, q: np.ndarray) -> np.ndarray:
    """Each joint's part of Chan and Dubey's h, by partial fractions: w/4 (1/(q_max-q) + ...)."""
    low, high = machine.column("q_min"), machine.column("q_max")
    return (high - low) / 4 * (1 / (high - q) + 1 / (q - low))


@given(machines(), st.integers(0, 1000))
def test_limit_gradient__is_the_slope_of_chan_and_dubeys_function(machine, seed):
    low, high = machine.column("q_min"), machine.column("q_max")
    fraction = np.random.default_rng(seed).uniform(0.02, 0.98, (20, machine.n))
    q = low + (high - low) * fraction
    slope = (limit_function(machine, q + STEP) - limit_function(machine, q - STEP)) / (2 * STEP)
    np.testing.assert_allclose(limit_gradient(machine, q), slope, rtol=1e-4, atol=1e-5)


@given(machines(), reals(0, 1))
def test_limit_gradient__stays_that_of_a_thousandth_of_the_range_inside_its_limits(machine, beyond):
    """Its sign tells the nearer limit, at which it is finite: about 1e6 / (4 range) there."""
    low, high = machine.column("q_min"), machine.column("q_max")
    width = high - low
    for limit, side in ((high, 1), (low, -1)):
        outside = limit_gradient(machine, limit + side * beyond * width)
        inside = limit_gradient(machine, limit - side * 1e-3 * width)
        np.testing.assert_allclose(outside, inside, rtol=1e-6)
        np.testing.assert_allclose(outside, side * 1e6 / (4 * width), rtol=1e-2)
        nearer = limit_gradient(machine, limit - side * 2e-3 * width)
        assert np.all(np.abs(nearer) < 0.3 * np.abs(inside))


@given(moving())
def test_limit_weights__are_above_1_towards_the_nearer_limit_alone(case):
    machine, q, q_dot = case
    low, high = machine.column("q_min"), machine.column("q_max")
    W = limit_weights(machine, q, q_dot)
    towards = ((2 * q > low + high) & (q_dot > 0)) | ((2 * q < low + high) & (q_dot < 0))
    expected = np.where(towards, 1 + np.abs(limit_gradient(machine, q)), 1)
    np.testing.assert_allclose(W, expected, rtol=1e-12)


# --- damping, and all of it in the controller -----------------------------------------------------


@given(posed())
def test_manipulability__is_the_product_of_singular_values(case):
    machine, q = case
    J = jacobian(forward_kinematics(machine, q))
    values = np.linalg.svd(J, compute_uv=False)
    expected = values.prod(-1) if machine.n >= 3 else np.zeros(q.shape[:-1])
    np.testing.assert_allclose(manipulability(J), expected, rtol=1e-6, atol=1e-6)


@given(reals(0, 3), reals(1e-3, 10), reals(1e-3, 1))
def test_nakamura_damping__is_k_times_the_square_below_the_threshold(part, w0, k):
    """From k at a singularity it falls to 0 at w0 by (1 - w / w0)^2, and stays there."""
    damping = nakamura_damping(part * w0, w0, k)
    assert damping == pytest.approx(k * (1 - part) * (1 - part) if part < 1 else 0, abs=1e-12)
    assert nakamura_damping(0.5 * w0, w0, k) == pytest.approx(k / 4)


@given(moving(shapes=[(4,)]), npst.arrays(np.float64, (4, 3), elements=reals(-2, 2)), reals(0, 2))
def test_joint_velocities__are_eq4_no_faster_than_the_joints(case, v, w0):
    """Weights by the directions of the tick before; all joints slow down by the same factor."""
    machine, q, last = case
    driven = machine.driven
    gains = Gains(*np.zeros((3, len(driven))), np.zeros(1))
    c = JacobianController(machine, gains, 0.1, w0 + 0.01)
    found = c.joint_velocities(v, q, last[:, driven])
    alone = c.joint_velocities(v[0], q[0], last[0, driven])
    np.testing.assert_allclose(alone, found[0], rtol=1e-9, atol=1e-12)
    joints = [machine.joints[j] for j in driven]
    for i in range(4):
        J = jacobian(forward_kinematics(machine, q[i]))[:, driven]
        W = limit_weights(machine, q[i], last[i])[driven]
        damping = 0.1 * max(0, 1 - manipulability(J) / c.w0) ** 2 + 1e-9
        free = dls(J, W, damping) @ v[i]
        fastest = [j.q_dot_up if x > 0 else j.q_dot_down for x, j in zip(free, joints, strict=True)]
        factor = max(1.0, np.max(np.abs(free) / fastest))
        np.testing.assert_allclose(found[i], free / factor, rtol=1e-6, atol=1e-9)
        assert np.all(np.abs(found[i]) <= np.array(fastest) * (1 + 1e-9))
