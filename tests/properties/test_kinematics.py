"""Kinematics of any machine: an independent formula, derivatives, symmetries, batches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given
from scipy.linalg import expm
from strategies import moving, posed, reals

from brokk_min.kinematics import (
    forward_kinematics,
    jacobian,
    lowest_point,
    tool_position,
    tool_velocity,
)
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
    velocity = tool_velocity(forward_kinematics(machine, q), q_dot)
    np.testing.assert_allclose(velocity, (ahead - behind) / (2 * STEP), atol=1e-7)


@given(posed())
def test_forward_kinematics__neighbouring_frames_are_one_dh_row_apart(case):
    """|p_i - p_{i-1}|^2 = a^2 + d^2; the axes enclose alpha; the offset along the old axis is d.

    q is added to d where a joint is prismatic.
    """
    machine, q = case
    p, z, _ = forward_kinematics(machine, q)
    link = p[..., 1:, :] - p[..., :-1, :]
    slides = np.array([joint.kind == "prismatic" for joint in machine.joints])
    a, d = machine.column("a"), machine.column("d") + slides * q
    np.testing.assert_allclose(np.sum(link**2, -1), a**2 + d**2, atol=1e-11)
    np.testing.assert_allclose(np.sum(link * z[..., :-1, :], -1), d, atol=1e-12)
    cosine = np.sum(z[..., 1:, :] * z[..., :-1, :], -1)
    alpha = np.broadcast_to(machine.column("alpha"), q.shape)
    np.testing.assert_allclose(cosine, np.cos(alpha), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(z, axis=-1), 1, atol=1e-12)


@given(posed(), reals(-3, 3))
def test_forward_kinematics__turns_with_the_first_joint(case, angle):
    """A turn of the base turns the tool about z and leaves all heights as they were."""
    machine, q = case
    first, *others = machine.joints
    base = replace(machine, joints=(replace(first, theta=first.theta + angle), *others))
    turned = forward_kinematics(base, q)
    still = forward_kinematics(machine, q)
    c, s = np.cos(angle), np.sin(angle)
    Rz = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    np.testing.assert_allclose(turned.p, still.p @ Rz.T, atol=1e-12)
    np.testing.assert_allclose(jacobian(turned), Rz @ jacobian(still), atol=1e-12)
    np.testing.assert_allclose(lowest_point(turned), lowest_point(still), atol=1e-12)


@given(moving(shapes=[(1,), (4,), (2, 3)]))
def test_a_batch__is_its_poses_one_by_one(case):
    machine, q, q_dot = case
    frames = forward_kinematics(machine, q)
    for index in np.ndindex(q.shape[:-1]):
        alone = forward_kinematics(machine, q[index])
        np.testing.assert_allclose(tool_position(frames)[index], tool_position(alone), atol=1e-13)
        np.testing.assert_allclose(lowest_point(frames)[index], lowest_point(alone), atol=1e-13)
        np.testing.assert_allclose(jacobian(frames)[index], jacobian(alone), atol=1e-13)
        velocity = tool_velocity(alone, q_dot[index])
        np.testing.assert_allclose(tool_velocity(frames, q_dot)[index], velocity, atol=1e-13)


@given(moving())
def test_single_precision__stays_single_and_close(case):
    machine, q, q_dot = case
    single = forward_kinematics(machine, q.astype(np.float32))
    double = forward_kinematics(machine, q)
    assert single.p.dtype == single.z.dtype == jacobian(single).dtype == np.float32
    np.testing.assert_allclose(single.p, double.p, atol=2e-5)
    np.testing.assert_allclose(jacobian(single), jacobian(double), atol=2e-5)
    velocity = tool_velocity(single, q_dot.astype(np.float32))
    assert velocity.dtype == np.float32
    np.testing.assert_allclose(velocity, tool_velocity(double, q_dot), atol=5e-5)
