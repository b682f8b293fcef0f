"""Kinematics by hand, against a closed form and matrix exponentials."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers_machines import POSE, closed_form
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from scipy.linalg import expm
from strategies import posed, poses, reals

from brokk_min.kinematics import (
    estimate_velocity,
    forward_kinematics,
    jacobian,
    lowest_point,
    to_heading,
    tool_position,
)
from brokk_min.machine import BROKK_170, Machine

STRAIGHT = np.array([0.0, 0.0, 0.0, np.pi, 3 * np.pi / 4])  # all links in one level line


def test_tool_position__of_the_papers_start_pose():
    x, y, z = tool_position(forward_kinematics(BROKK_170, POSE))
    assert np.hypot(x, y) == pytest.approx(3.05, abs=0.005)
    assert z == pytest.approx(1.01, abs=0.005)
    assert np.arctan2(y, x) == pytest.approx(1.5)


def test_jacobian__of_the_arm_stretched_out():
    """1 rad/s of slew moves the tool at 5 m/s sideways; q2 to q5 lift it by their lever arms."""
    J = jacobian(forward_kinematics(BROKK_170, STRAIGHT))
    expected = [[0, 0, 0, 0, 0], [5, 0, 0, 0, 0], [0, 4.75, 3.6, 2.35, 1.2]]
    np.testing.assert_allclose(J, expected, atol=1e-12)


@pytest.mark.parametrize(
    ("bend", "lowest"),
    [
        ([0, 0, 0, 0, 0], 0.95),  # all flat
        ([0, 0, 0, 0, -np.pi / 2], 0.95 - 1.2),  # tool down
        ([0, 0, 0, -np.pi / 2, np.pi], 0.95 - 1.15),  # a V: its corner is lowest, not the tool
        ([0, 0, -np.pi / 2, np.pi / 2, 0], 0.95 - 1.25),
        ([0, -np.pi / 2, np.pi, 0, 0], 0.95 - 1.15),
        ([0, np.pi / 2, 0, 0, 0], 0.95),  # upright: the pivot is lowest
    ],
)
def test_lowest_point__by_hand(bend, lowest):
    frames = forward_kinematics(BROKK_170, STRAIGHT + bend)
    assert lowest_point(frames) == pytest.approx(lowest, abs=1e-12)


def test_to_heading__by_hand():
    """The tool at 90 degrees: outward is y, sideways is -x. On the axis nothing turns."""
    v = np.array([1.0, 2.0, 3.0])
    np.testing.assert_allclose(to_heading(np.array([0.0, 2.0, 1.0]), v), [2, -1, 3], atol=1e-12)
    np.testing.assert_allclose(to_heading(np.array([-3.0, 0, 0]), v), [-1, -2, 3], atol=1e-12)
    assert np.isfinite(to_heading(np.zeros(3), v)).all()


@given(poses(BROKK_170, (20,)))
def test_forward_kinematics__is_the_closed_form_of_the_brokk(q):
    frames = forward_kinematics(BROKK_170, q)
    tool, lowest = closed_form(q)
    np.testing.assert_allclose(tool_position(frames), tool, atol=1e-12)
    np.testing.assert_allclose(lowest_point(frames), lowest, atol=1e-12)


def twist(angular: np.ndarray, linear: np.ndarray) -> np.ndarray:
    x, y, z = angular
    matrix = np.zeros((4, 4))
    matrix[:3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    matrix[:3, 3] = linear
    return matrix


def product_of_exponentials(machine: Machine, q: np.ndarray) -> np.ndarray:
    """Frames (n + 1, 4, 4) of one pose: spatial screws at the zero pose, exponentials, home."""
    x, _, z = np.eye(3)
    home = np.eye(4)
    moved = np.eye(4)
    result = [np.eye(4)]
    for joint, angle in zip(machine.joints, q, strict=True):
        axis = home[:3, :3] @ z
        screw = twist(axis, np.cross(home[:3, 3], axis))
        slide = twist(np.zeros(3), axis)
        moved = moved @ expm(angle * (screw if joint.kind == "revolute" else slide))
        home = home @ expm(twist(z * joint.theta, z * joint.d))
        home = home @ expm(twist(x * joint.alpha, x * joint.a))
        result.append(moved @ home)
    return np.array(result)


@given(posed(shapes=[()]))
def test_forward_kinematics__is_the_product_of_exponentials(case):
    machine, q = case
    expected = product_of_exponentials(machine, q)
    frames = forward_kinematics(machine, q)
    np.testing.assert_allclose(frames.p, expected[:, :3, 3], atol=1e-10)
    np.testing.assert_allclose(frames.z, expected[:, :3, 2], atol=1e-10)
    slides = [joint.kind == "prismatic" for joint in machine.joints]
    assert frames.prismatic == np.flatnonzero(slides).tolist()


def test_forward_kinematics__takes_lists_whole_numbers_and_empty_batches():
    whole = forward_kinematics(BROKK_170, [1, 0, 1, 2, 1])
    floats = forward_kinematics(BROKK_170, np.array([1.0, 0, 1, 2, 1]))
    np.testing.assert_array_equal(whole.p, floats.p)
    empty = forward_kinematics(BROKK_170, np.zeros((0, 5)))
    assert empty.p.shape == empty.z.shape == (0, 6, 3)
    assert jacobian(empty).shape == (0, 3, 5)


def test_forward_kinematics__stays_single_for_link_lengths_out_of_an_array():
    """A table of links is often an array, whose numbers are np.float64."""
    joints = tuple(replace(j, a=np.float64(j.a), d=np.float64(j.d)) for j in BROKK_170.joints)
    frames = forward_kinematics(replace(BROKK_170, joints=joints), POSE.astype(np.float32))
    assert frames.p.dtype == frames.z.dtype == np.float32


@pytest.mark.parametrize("shape", [(), (4,), (6,), (5, 4), (5, 1), (0,)])
def test_forward_kinematics__refuses_angles_of_another_machine(shape):
    with pytest.raises(ValueError) as caught:
        forward_kinematics(BROKK_170, np.zeros(shape))
    assert str(caught.value) == f"q: expected (..., 5), got {shape}"


# --- velocity of joints ---------------------------------------------------------------------------


@given(st.integers(2, 8), npst.arrays(np.float64, (3, 12), elements=reals(-3, 3)))
def test_velocity_is_the_least_squares_slope_and_forgets_what_is_older(samples, q):
    q.setflags(write=False)
    velocity = estimate_velocity(q, samples, 0.05)
    time = 0.05 * np.arange(samples)
    fitted = [np.polyfit(time, row[-samples:], 1)[0] for row in q]
    np.testing.assert_allclose(velocity, fitted, atol=1e-8)
    other = q.copy()
    other[:, :4] = 1e6
    np.testing.assert_array_equal(estimate_velocity(other, samples, 0.05), velocity)
    assert estimate_velocity(q.astype(np.float32), samples, 0.05).dtype == np.float32


def test_velocity_by_hand():
    # newest of four samples moved one count: 1.5 / 5 counts a tick; two samples: one count a tick
    step = BROKK_170.encoder_step[0]
    q = np.array([0.0, 0.0, 0.0, step])
    assert estimate_velocity(q, 4, 0.05) == pytest.approx(0.3 * step / 0.05)
    assert estimate_velocity(q, 2, 0.05) == pytest.approx(0.0307, abs=1e-4)
    assert estimate_velocity(q.astype(np.float32), 4, 0.05).dtype == np.float32
    slope = estimate_velocity([0, 3, 6, 9], samples=4, dt=0.07)  # whole numbers
    assert slope == pytest.approx(3 / 0.07)


@pytest.mark.parametrize(("samples", "length"), [(4, 3), (1, 5), (0, 5), (2, 1)])
def test_too_few_samples_are_refused(samples, length):
    with pytest.raises(ValueError) as caught:
        estimate_velocity(np.zeros((2, length)), samples, 0.05)
    expected = f"q: expected at least {max(2, samples)} samples, got (2, {length})"
    assert str(caught.value) == expected
