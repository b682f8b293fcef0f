"""The classical controller: least squares and a PID by hand.

tests/properties has least squares, weights and damping for any machine.
"""

from dataclasses import replace

import numpy as np
import pytest
from helpers_machines import DRIVEN, POSE, opened, steady

from brokk_min.jacobian import Gains, JacobianController, dls, manipulability_threshold
from brokk_min.kinematics import forward_kinematics, jacobian
from brokk_min.machine import BROKK_170

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


def test_manipulability_threshold__is_a_quarter_of_the_largest():
    poses = np.random.default_rng(0).uniform(LOW, HIGH, (2000, 5))
    driven = jacobian(forward_kinematics(BROKK_170, poses))[..., DRIVEN]
    w = np.linalg.svd(driven, compute_uv=False).prod(axis=-1)
    assert manipulability_threshold(BROKK_170) == pytest.approx(w.max() / 4, rel=1e-6)


# --- the controller -------------------------------------------------------------------------------


def controller(w0=1e-6, k=0.1, machine=BROKK_170, **gains):
    n = len(machine.driven)
    arrays = {name: np.full(n, gains.get(name, 0.0)) for name in ("kp", "ki", "kd")}
    feedback = np.full(1, gains.get("feedback", 0.0))
    return JacobianController(machine, Gains(**arrays, feedback=feedback), k, w0)


def drive(c, inputs, state=None):
    """Commands (ticks, n) of one controller, and its states, under one measurement a tick."""
    sent, states = [], [state or c.start(1)]
    for one in inputs:
        u, state = c(one, states[-1])
        sent.append(u[0])
        states.append(state)
    return np.array(sent), states[1:]


def test_controller__wants_the_joint_velocities_of_eq3():
    """v_goal + K (v_goal - v_tool), with the weights of the last direction."""
    q_dot, last = np.array([0.01, 0.0, -0.02, 0.03, 0.01]), np.array([[0.1, 0.1, -0.1, 0.0]])
    c = controller(100.0, feedback=0.3)
    now, v = steady(POSE, GOAL, q_dot), GOAL + 0.3 * (GOAL - J @ q_dot[DRIVEN])
    found = [c(now, c.start(1)._replace(q_dot_goal=x))[1].q_dot_goal for x in (last, -last)]
    for one, x in zip(found, (last, -last), strict=True):
        np.testing.assert_allclose(one, c.joint_velocities(v[None], POSE[None], x), atol=1e-6)
    assert np.abs(found[0] - found[1]).max() > 1e-3


def test_controller__first_tick_of_a_p_controller_by_hand():
    """Each valve opens beyond its own dead zone."""
    joints = [replace(joint, dead_zone=(0.1, 0.2)) for joint in BROKK_170.joints]
    machine = replace(BROKK_170, name="own zones", joints=tuple(joints))
    c = controller(machine=machine, kp=1.5)
    np.testing.assert_array_equal(c.start(2), np.zeros((4, 2, 4)))
    q_dot = np.linalg.pinv(J) @ GOAL  # at rest all weights are 1
    u, _ = c(steady(POSE, GOAL, machine=machine), c.start(1))
    np.testing.assert_allclose(127 * u[0, DRIVEN], opened(1.5 * q_dot, 0.1, 0.2), atol=1e-9)
    assert q_dot.min() < -0.01 < 0.01 < q_dot.max() and u[0, 1] == 0
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
