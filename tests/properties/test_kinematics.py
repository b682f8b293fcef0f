"""Kinematics of any machine: an independent formula, derivatives, single precision."""

import numpy as np
from hypothesis import given
from scipy.linalg import expm
from strategies import moving, posed

from brokk_min import kinematics
from brokk_min.kinematics import forward_kinematics, jacobian, lowest_point, tool_position
from brokk_min.machine import Machine

STEP = 1e-6  # rad, of central differences


def twist(angular: np.ndarray, linear: np.ndarray) -> np.ndarray:
    """The 4x4 matrix of a twist; its exponential is a screw motion."""
    x, y, z = angular
    matrix = np.zeros((4, 4))
    matrix[:3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    matrix[:3, 3] = linear
    return matrix


def product_of_exponentials(machine: Machine, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Frames (n + 1, 4, 4) and Jacobian (3, n) of one pose (Lynch and Park, chapters 4 and 5).

    Every joint is a screw about its axis where the machine stands at q = 0, seen from the base;
    the screws of the joints before it carry that axis along.
    """
    x, _, z = np.eye(3)
    home, moved = np.eye(4), np.eye(4)
    frames, screws = [np.eye(4)], []
    for joint, angle in zip(machine.joints, q, strict=True):
        axis = home[:3, :3] @ z
        turns = joint.kind == "revolute"
        screw = twist(axis, np.cross(home[:3, 3], axis)) if turns else twist(0 * axis, axis)
        screws.append(moved @ screw @ np.linalg.inv(moved))
        moved = moved @ expm(angle * screw)
        home = home @ expm(twist(z * joint.theta, z * joint.d))
        home = home @ expm(twist(x * joint.alpha, x * joint.a))
        frames.append(moved @ home)
    J = np.stack([(screw @ frames[-1][:, 3])[:3] for screw in screws], axis=1)  # p' = [S] p
    return np.array(frames), J


@given(posed(shapes=[()]))
def test_forward_kinematics__is_the_product_of_exponentials(case):
    machine, q = case
    expected, J = product_of_exponentials(machine, q)
    frames = forward_kinematics(machine, q)
    np.testing.assert_allclose(frames.p, expected[:, :3, 3], atol=1e-10)
    np.testing.assert_allclose(frames.z, expected[:, :3, 2], atol=1e-10)
    np.testing.assert_allclose(tool_position(frames), expected[-1, :3, 3], atol=1e-10)
    np.testing.assert_allclose(lowest_point(frames), min(expected[1:, 2, 3]), atol=1e-10)
    np.testing.assert_allclose(jacobian(frames), J, atol=1e-10)
    assert frames.prismatic == [i for i, j in enumerate(machine.joints) if j.kind == "prismatic"]


@given(posed())
def test_jacobian__is_the_derivative_of_the_tool_position(case):
    machine, q = case
    J = jacobian(forward_kinematics(machine, q))
    assert J.shape == (*q.shape[:-1], 3, machine.n)
    for i, e in enumerate(STEP * np.eye(machine.n)):
        ahead = tool_position(forward_kinematics(machine, q + e))
        behind = tool_position(forward_kinematics(machine, q - e))
        np.testing.assert_allclose(J[..., i], (ahead - behind) / (2 * STEP), atol=1e-7)


@given(moving())
def test_tool_velocity__is_the_derivative_along_the_motion(case):
    machine, q, q_dot = case
    ahead = tool_position(forward_kinematics(machine, q + STEP * q_dot))
    behind = tool_position(forward_kinematics(machine, q - STEP * q_dot))
    velocity = kinematics.tool_velocity(forward_kinematics(machine, q), q_dot)
    np.testing.assert_allclose(velocity, (ahead - behind) / (2 * STEP), atol=1e-7)


@given(moving())
def test_single_precision__stays_single_and_close(case):
    machine, q, q_dot = case
    single = forward_kinematics(machine, q.astype(np.float32))
    double = forward_kinematics(machine, q)
    assert single.p.dtype == single.z.dtype == jacobian(single).dtype == np.float32
    np.testing.assert_allclose(single.p, double.p, atol=2e-5)
    np.testing.assert_allclose(jacobian(single), jacobian(double), atol=2e-5)
    velocity = kinematics.tool_velocity(single, q_dot.astype(np.float32))
    assert velocity.dtype == np.float32
    np.testing.assert_allclose(velocity, kinematics.tool_velocity(double, q_dot), atol=5e-5)
