"""The classical controller: limits and damping by hand, eq3 against an optimiser, a PID by hand.

tests/properties has least squares, weights and damping for any machine.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers_machines import DRIVEN, POSE, opened, steady
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize
from strategies import machines

from brokk_min.env import Measured
from brokk_min.jacobian import (
    Gains,
    JacobianController,
    PIDState,
    dls,
    limit_gradient,
    limit_weights,
    manipulability,
    manipulability_threshold,
    nakamura_damping,
)
from brokk_min.kinematics import forward_kinematics, jacobian
from brokk_min.machine import BROKK_170, Machine

STRETCHED = np.array([0.3, 0.5, 0.1, np.pi, 3 * np.pi / 4])  # all links in one line
GOAL = np.array([0.04, -0.03, 0.05])
LOW, HIGH = BROKK_170.column("q_min"), BROKK_170.column("q_max")
J = jacobian(forward_kinematics(BROKK_170, POSE))[:, DRIVEN]


# --- least squares, limits, singularities ---------------------------------------------------------


def test_dls__by_hand():
    """Three joints, each along one axis: every axis is W^-1 j / (j^2 W^-1 + lambda^2) by itself."""
    diagonal, W = np.diag([1, 2, 0]).tolist(), [1, 4, 9]
    expected = np.diag([1 / 1.5, 0.5 / 1.5, 0.0])
    np.testing.assert_allclose(dls(diagonal, W, 0.5), expected, atol=1e-12)
    printed = dls(diagonal, W, 0.5, as_printed=True)  # j W^-1 / (j^2 W + lambda^2)
    np.testing.assert_allclose(printed, np.diag([1 / 1.5, 0.5 / 16.5, 0.0]), atol=1e-12)


def test_limit_gradient__by_hand():
    """At three quarters of the range w it is w^2 (w/2) / (4 (w/4 . 3w/4)^2) = 32 / (9 w).

    At and beyond a limit it is that of a thousandth of the range before it.
    """
    width = HIGH - LOW
    np.testing.assert_allclose(limit_gradient(BROKK_170, LOW + 0.75 * width), 32 / (9 * width))
    at = limit_gradient(BROKK_170, LOW + 0.999 * width)
    np.testing.assert_allclose(limit_gradient(BROKK_170, HIGH), at, rtol=1e-9)
    np.testing.assert_allclose(limit_gradient(BROKK_170, HIGH + 1), at, rtol=1e-9)


def test_limit_weights__stop_a_joint_at_its_limit():
    for q, direction in ((HIGH, 1.0), (HIGH + 0.01, 1.0), (LOW, -1.0), (LOW - 0.01, -1.0)):
        W = limit_weights(BROKK_170, q, np.full(5, direction))
        assert np.isfinite(W).all() and (W > 1e4).all()
        assert (limit_weights(BROKK_170, q, np.full(5, -direction)) == 1).all()


def test_nakamura_damping__by_hand_and_without_a_jump():
    found = nakamura_damping([0.0, 0.25, 0.5, 1.0, 3.0], 0.5, 0.1)
    np.testing.assert_allclose(found, [0.1, 0.025, 0, 0, 0])
    damping = nakamura_damping(np.linspace(0, 1, 2001), 0.5, 0.05)
    assert (np.diff(damping) <= 0).all()
    assert np.abs(np.diff(damping)).max() < 2e-4  # 2 k / w0 times the step


def test_manipulability_threshold__is_a_quarter_of_the_largest():
    poses = np.random.default_rng(0).uniform(LOW, HIGH, (2000, 5))
    w = manipulability(jacobian(forward_kinematics(BROKK_170, poses))[..., DRIVEN])
    assert manipulability_threshold(BROKK_170) == pytest.approx(w.max() / 4, rel=1e-6)


# --- the controller -------------------------------------------------------------------------------


def controller(w0=1e-6, k=0.1, machine: Machine = BROKK_170, **gains) -> JacobianController:
    n = len(machine.driven)
    arrays = {name: np.full(n, gains.get(name, 0.0)) for name in ("kp", "ki", "kd")}
    feedback = np.full(1, gains.get("feedback", 0.0))
    return JacobianController(machine, Gains(**arrays, feedback=feedback), k, w0)


def drive(
    c: JacobianController, inputs: list[Measured], state: PIDState | None = None
) -> tuple[np.ndarray, list[PIDState]]:
    """Commands (ticks, n) of one controller, and its states, under one measurement a tick."""
    sent, states = [], [state or c.start(1)]
    for one in inputs:
        u, state = c(one, states[-1])
        sent.append(u[0])
        states.append(state)
    return np.array(sent), states[1:]


@pytest.mark.parametrize("pose", [POSE, STRETCHED], ids=["paper", "stretched"])
def test_joint_velocities__beyond_the_fastest_motion_slow_down_in_the_same_direction(pose):
    c = controller(w0=0.5, k=0.05)
    small = c.joint_velocities(0.01 * GOAL, pose, np.zeros(4))
    up, down = BROKK_170.column("q_dot_up")[DRIVEN], BROKK_170.column("q_dot_down")[DRIVEN]
    fastest = np.where(small > 0, up, down)
    assert (np.abs(small) < fastest).all()
    for scale in (0.02, 0.5, 5.0, 500.0):
        free = small * scale / 0.01
        excess = np.max(np.abs(free) / fastest)
        found = c.joint_velocities(scale * GOAL, pose, np.zeros(4))
        np.testing.assert_allclose(found, free / max(1, excess), rtol=1e-6, atol=1e-9)


def test_controller__wants_the_joint_velocities_of_eq3():
    """v_goal + K (v_goal - v_tool) by weighted least squares: an optimiser finds the same."""
    q_dot, w0, last = np.array([0.01, 0.0, -0.02, 0.03, 0.01]), 100.0, [0.1, 0.1, -0.1, 0.0]
    now = steady(POSE, GOAL, q_dot)
    damping = 0.1 * (1 - np.sqrt(np.linalg.det(J @ J.T)) / w0) ** 2
    W = limit_weights(BROKK_170, POSE, np.array([0.1, 0.0, 0.1, -0.1, 0.0]))[DRIVEN]
    v = GOAL + 0.3 * (GOAL - J @ q_dot[DRIVEN])

    def cost(x: np.ndarray) -> float:
        return float(np.sum((J @ x - v) ** 2) + damping * x @ (W * x))

    best = minimize(cost, np.zeros(4), tol=1e-12).x
    c = controller(w0, feedback=0.3)
    state = c.start(1)._replace(q_dot_goal=np.array([last]))
    found = c(now, state)[1].q_dot_goal[0]
    np.testing.assert_allclose(found, best, atol=1e-5)
    other = c(now, state._replace(q_dot_goal=-state.q_dot_goal))[1].q_dot_goal[0]
    assert np.abs(other - found).max() > 1e-3  # the last direction decides the weights


def test_controller__first_tick_of_a_p_controller_by_hand():
    c = controller(kp=1.5)
    q_dot = np.linalg.pinv(J) @ GOAL  # at rest all weights are 1
    u, state = c(steady(POSE, GOAL), c.start(1))
    np.testing.assert_allclose(127 * u[0, DRIVEN], opened(1.5 * q_dot), atol=1e-9)
    assert u[0, 1] == 0
    assert (np.abs(u[0, DRIVEN]) * 127 >= 9).all()  # beyond the dead zone of 8.9 counts
    np.testing.assert_allclose(state.q_dot_goal[0], q_dot, atol=1e-6)
    np.testing.assert_allclose(state.error[0], q_dot, atol=1e-6)
    assert not state.integral.any()  # ki is 0
    moving = np.array([0.02, 0.0, -0.03, 0.01, 0.04])
    _, state = c(steady(POSE, GOAL, moving), c.start(1))
    np.testing.assert_allclose(state.error[0], q_dot - moving[DRIVEN], atol=1e-6)


def test_controller__integral_and_derivative_by_hand():
    """Constant error e: the opening grows by ki e dt a tick; the derivative fades by 0.7 a tick."""
    still = steady(POSE, 0.3 * GOAL)
    e = np.linalg.pinv(J) @ (0.3 * GOAL)
    u, states = drive(controller(ki=2.0), [still] * 6)
    assert not u[0].any()  # nothing has been integrated before the first tick
    for count, state in enumerate(states, 1):
        np.testing.assert_allclose(state.integral[0], count * 2.0 * e * 0.05, rtol=2e-2)
    u, states = drive(controller(kd=0.1), [still] * 3)
    derivatives = np.array([state.derivative[0] for state in states])
    np.testing.assert_allclose(127 * u[:, DRIVEN], opened(0.1 * derivatives), atol=1e-9)
    np.testing.assert_allclose(derivatives[0], 0.3 * e * 20, rtol=1e-2)
    np.testing.assert_allclose(derivatives[2], 0.49 * derivatives[0], rtol=5e-2, atol=1e-3)


def test_controller__integral_stops_while_the_valve_is_fully_open():
    """Anti-windup: with kp at once; without, once the integral fills the valve."""
    fast = steady(POSE, 5 * GOAL)
    u, states = drive(controller(kp=40.0, ki=10.0), [fast] * 20)
    full = np.abs(u[-1, DRIVEN]) > 79.5 / 127
    assert full.any() and (states[-1].integral[0, full] == 0).all()
    c = controller(ki=10.0)
    _, states = drive(c, [fast] * 200)
    sizes = [np.abs(state.integral).max() for state in states]
    limit = (80 / 127 - 0.07) / 0.93
    assert sizes[-1] == sizes[-50]
    assert limit <= sizes[-1] <= limit + 10 * 0.47 * 0.05
    _, back = drive(c, [steady(POSE, -5 * GOAL)] * 10, states[-1])
    assert (np.abs(back[-1].integral) < np.abs(states[-1].integral)).all()


def test_controller__opens_each_valve_beyond_its_own_dead_zone():
    joints = [replace(joint, dead_zone=(0.1, 0.2)) for joint in BROKK_170.joints]
    machine = replace(BROKK_170, name="own zones", joints=tuple(joints))
    c = controller(machine=machine, kp=1.5)
    u, _ = c(steady(POSE, GOAL, machine=machine), c.start(1))
    opening = 1.5 * np.linalg.pinv(J) @ GOAL
    assert opening.min() < -0.01 < 0.01 < opening.max()
    np.testing.assert_allclose(127 * u[0, DRIVEN], opened(opening, 0.1, 0.2), atol=1e-9)


def test_controller__of_a_batch_is_that_of_its_rows():
    """Gains as well: one row for each machine."""
    rng = np.random.default_rng(4)
    rows = [controller(w0=0.5, kp=1.0 + i, ki=3.0, kd=0.05, feedback=0.3 * i) for i in range(4)]
    names = ("kp", "ki", "kd", "feedback")
    gains = Gains(**{name: np.stack([getattr(c.gains, name) for c in rows]) for name in names})
    c = replace(rows[0], gains=gains)
    poses = POSE + rng.uniform(-0.1, 0.1, (4, 5))
    together, alone = c.start(4), [c.start(1) for c in rows]
    for _ in range(6):
        goals = rng.uniform(-0.2, 0.2, (4, 3))
        u, together = c(steady(poses, goals), together)
        for i in range(4):
            single, alone[i] = rows[i](steady(poses[i], goals[i]), alone[i])
            np.testing.assert_allclose(single[0], u[i], atol=1e-9)


@given(machines(), st.integers(0, 1000))
def test_controller__sends_whole_counts_within_the_limit(machine, seed):
    rng = np.random.default_rng(seed)
    c = controller(0.3, machine=machine, kp=3.0, ki=9.0, kd=0.2, feedback=1.0)
    low, high = machine.column("q_min"), machine.column("q_max")
    q = np.where(rng.random((5, machine.n)) < 0.3, high, rng.uniform(low, high, (5, machine.n)))
    state = c.start(5)
    for _ in range(3):
        u, state = c(steady(q, rng.normal(0, 1, (5, 3)), machine=machine), state)
        counts = u * 127
        assert np.isfinite(u).all()
        assert np.abs(counts).max() <= machine.pwm_limit + 1e-9
        np.testing.assert_allclose(counts, np.rint(counts), atol=1e-9)
        assert not u[:, machine.locked].any()
