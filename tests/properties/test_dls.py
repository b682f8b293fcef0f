"""Weighted damped least squares for any Jacobian, weights, damping and velocity."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from strategies import posed, reals

from brokk_min.jacobian import dls, manipulability, nakamura_damping
from brokk_min.kinematics import forward_kinematics, jacobian

velocities = npst.arrays(np.float64, 3, elements=reals(-1, 1))
dampings = reals(1e-3, 10)  # lambda^2


@st.composite
def problems(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray, float, np.ndarray]:
    """J (3, n), diagonal W (n,), lambda^2 and v (3,)."""
    n = draw(st.integers(1, 6))
    J = draw(npst.arrays(np.float64, (3, n), elements=reals(-3, 3)))
    W = draw(npst.arrays(np.float64, n, elements=reals(0.1, 100)))
    return J, W, draw(dampings), draw(velocities)


@given(problems())
def test_dls__solves_the_normal_equations(problem):
    """J^T (J q_dot - v) + lambda^2 W q_dot = 0: the gradient of the cost of eq4 vanishes."""
    J, W, damping, v = problem
    q_dot = dls(J, W, damping) @ v
    np.testing.assert_allclose(J.T @ (J @ q_dot - v) + damping * W * q_dot, 0, atol=1e-8)


@given(problems())
def test_dls__is_the_least_squares_of_scipy(problem):
    """With the damping as further rows: [J; lambda W^1/2] q_dot = [v; 0]."""
    J, W, damping, v = problem
    rows = np.vstack([J, np.sqrt(damping) * np.diag(np.sqrt(W))])
    expected = scipy.linalg.lstsq(rows, np.concatenate([v, np.zeros(len(W))]))[0]
    np.testing.assert_allclose(dls(J, W, damping) @ v, expected, atol=1e-8)


@given(problems())
def test_dls__bounds_the_joint_velocities_for_unit_weights(problem):
    """|q_dot| <= |v| / (2 lambda), however near a singularity."""
    J, W, damping, v = problem
    q_dot = dls(J, np.ones_like(W), damping) @ v
    assert np.linalg.norm(q_dot) <= np.linalg.norm(v) / (2 * np.sqrt(damping)) + 1e-9


@given(problems())
def test_dls__never_moves_the_tool_against_the_goal_or_beyond_it(problem):
    J, W, damping, v = problem
    v_tool = J @ dls(J, W, damping) @ v
    assert v_tool @ v >= -1e-9
    assert np.linalg.norm(v_tool) <= np.linalg.norm(v) + 1e-9


@given(problems())
def test_dls__the_printed_form_agrees_for_unit_weights_only(problem):
    """eq4 prints J W J^T; its slope lambda^2 W q_dot + J^T (J q_dot - v) vanishes for W = I."""
    J, W, damping, _v = problem
    one = np.ones_like(W)
    printed = dls(J, one, damping, as_printed=True)
    np.testing.assert_allclose(printed, dls(J, one, damping), atol=1e-12)
    W_inv_Jt = (J / W).T
    printed = W_inv_Jt @ np.linalg.inv((J * W) @ J.T + damping * np.eye(3))
    np.testing.assert_allclose(dls(J, W, damping, as_printed=True), printed, atol=1e-7, rtol=1e-6)


@given(posed(shapes=[()]), dampings, velocities, reals(-3, 3))
def test_dls__turns_with_the_base(case, damping, v, angle):
    """Turning tool velocity and arm together about z leaves the joint velocities as they were."""
    machine, q = case
    c, s = np.cos(angle), np.sin(angle)
    Rz = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    W = np.ones(machine.n)
    still = dls(jacobian(forward_kinematics(machine, q)), W, damping) @ v
    first, *others = machine.joints
    base = replace(machine, joints=(replace(first, theta=first.theta + angle), *others))
    turned = jacobian(forward_kinematics(base, q))
    np.testing.assert_allclose(dls(turned, W, damping) @ (Rz @ v), still, atol=1e-8)


@given(st.integers(0, 10_000), st.integers(3, 6))
def test_dls__tends_to_the_least_norm_solution_as_damping_vanishes(seed, n):
    """scipy.linalg.lstsq has the solution of least norm where J has full rank."""
    rng = np.random.default_rng(seed)
    left, right = (scipy.linalg.qr(rng.normal(size=(size, size)))[0] for size in (3, n))
    J = left @ np.diag(rng.uniform(0.5, 2, 3)) @ right[:3]
    v = rng.normal(size=3)
    expected = scipy.linalg.lstsq(J, v)[0]
    errors = [np.abs(dls(J, np.ones(n), d) @ v - expected).max() for d in (1e-2, 1e-5, 1e-9)]
    assert errors[2] < 1e-6
    assert errors[2] <= errors[0]
    much = dls(J, np.ones(n), 1e6) @ v
    np.testing.assert_allclose(much, J.T @ v / 1e6, rtol=1e-4, atol=1e-12)  # lambda -> infinity


@given(posed(), reals(1e-3, 10), reals(1e-3, 1))
def test_nakamura_damping__acts_below_the_threshold_only(case, w0, k):
    machine, q = case
    w = manipulability(jacobian(forward_kinematics(machine, q)))
    damping = nakamura_damping(w, w0, k)
    assert np.array_equal(damping > 0, w < w0)
    assert np.all(damping <= k)
