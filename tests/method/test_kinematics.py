"""Kinematics by hand and against the closed form of the Brokk; tests/properties has any machine."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers_machines import POSE, closed_form
from hypothesis import given
from strategies import poses

from brokk_min.kinematics import (
    forward_kinematics,
    jacobian,
    lowest_point,
    tool_position,
    tool_velocity,
)
from brokk_min.machine import BROKK_170

STRAIGHT = np.array([0.0, 0.0, 0.0, np.pi, 3 * np.pi / 4])  # all links in one level line


@given(poses(BROKK_170, (20,)))
def test_forward_kinematics__is_the_closed_form_of_the_brokk(q):
    frames = forward_kinematics(BROKK_170, q)
    tool, lowest = closed_form(q)
    np.testing.assert_allclose(tool_position(frames), tool, atol=1e-12)
    np.testing.assert_allclose(lowest_point(frames), lowest, atol=1e-12)


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


def test_tool_velocity__of_the_arm_stretched_out():
    """Locked joints count: q2 at 0.1 rad/s lifts 0.475 m/s, q5 at -0.2 rad/s lowers 0.24 m/s."""
    frames = forward_kinematics(BROKK_170, [STRAIGHT, STRAIGHT])
    v = tool_velocity(frames, [[0.0, 0.1, 0.0, 0.0, -0.2], [-0.1, 0.0, 0.0, 0.0, 0.0]])
    np.testing.assert_allclose(v, [[0, 0, 0.235], [0, -0.5, 0]], atol=1e-12)


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


def test_a_prismatic_joint__adds_its_travel_along_its_axis():
    """q3 as a telescope: its axis is level and across the arm, so the tool moves sideways."""
    joints = [replace(j, kind="prismatic") if j.name == "q3" else j for j in BROKK_170.joints]
    machine = replace(BROKK_170, name="telescope", joints=tuple(joints))
    q = np.array([0.0, 0.0, 0.4, np.pi, 3 * np.pi / 4])
    frames = forward_kinematics(machine, q)
    np.testing.assert_allclose(tool_position(frames), [5, -0.4, 0.95], atol=1e-12)
    np.testing.assert_allclose(jacobian(frames)[:, 2], [0, -1, 0], atol=1e-12)
    assert frames.prismatic == [2]


def test_forward_kinematics__stays_single_for_link_lengths_out_of_an_array():
    """A table of links is often an array, whose numbers are np.float64."""
    joints = tuple(replace(j, a=np.float64(j.a), d=np.float64(j.d)) for j in BROKK_170.joints)
    frames = forward_kinematics(replace(BROKK_170, joints=joints), POSE.astype(np.float32))
    assert frames.p.dtype == frames.z.dtype == np.float32


@pytest.mark.parametrize("shape", [(), (4,), (5, 1)])
def test_forward_kinematics__refuses_angles_of_another_machine(shape):
    with pytest.raises(ValueError) as caught:
        forward_kinematics(BROKK_170, np.zeros(shape))
    assert str(caught.value) == f"q: expected (..., 5), got {shape}"
