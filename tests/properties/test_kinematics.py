"""Kinematics of any machine: derivatives, rotations, symmetries, batches."""

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from strategies import moving, posed, reals

from brokk_min.kinematics import (
    forward_kinematics,
    jacobian,
    lowest_point,
    to_heading,
    tool_position,
    tool_velocity,
)

STEP = 1e-6  # rad, of central differences


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
    p, z, prismatic = forward_kinematics(machine, q)
    link = p[..., 1:, :] - p[..., :-1, :]
    slides = np.array([joint.kind == "prismatic" for joint in machine.joints])
    assert prismatic == np.flatnonzero(slides).tolist()
    a, d = machine.column("a"), machine.column("d") + slides * q
    np.testing.assert_allclose(np.sum(link**2, -1), a**2 + d**2, atol=1e-11)
    np.testing.assert_allclose(np.sum(link * z[..., :-1, :], -1), d, atol=1e-12)
    cosine = np.sum(z[..., 1:, :] * z[..., :-1, :], -1)
    alpha = np.broadcast_to(machine.column("alpha"), q.shape)
    np.testing.assert_allclose(cosine, np.cos(alpha), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(z, axis=-1), 1, atol=1e-12)


@given(posed(), reals(-3, 3))
def test_forward_kinematics__turns_with_the_first_joint(case, angle):
    """Turning the base turns the tool about z and leaves heights and headings alone."""
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


@given(posed(), st.tuples(reals(-1, 1), reals(-1, 1), reals(-1, 1)))
def test_to_heading__turns_about_z_so_that_the_tool_lies_ahead(case, v):
    machine, q = case
    frames = forward_kinematics(machine, q)
    p = tool_position(frames)
    ahead = to_heading(p, p)
    radius = np.hypot(p[..., 0], p[..., 1])
    np.testing.assert_allclose(np.linalg.norm(ahead[..., :2], axis=-1), radius, atol=1e-12)
    off_axis = radius > 1e-6
    np.testing.assert_allclose(np.where(off_axis, ahead[..., 1], 0), 0, atol=1e-9)
    vector = np.broadcast_to(v, p.shape)
    np.testing.assert_array_equal(to_heading(p, vector)[..., 2], vector[..., 2])
