"""Kinematics by hand and against the closed form of the Brokk; tests/properties has any machine."""

import numpy as np
import pytest
from helpers_machines import closed_form
from hypothesis import given
from strategies import poses

from brokk_min.kinematics import forward_kinematics, jacobian, lowest_point, tool_position
from brokk_min.machine import BROKK_170

STRAIGHT = np.array([0.0, 0.0, 0.0, np.pi, 3 * np.pi / 4])  # all links in one level line


@given(poses(BROKK_170, (4, 5)))
def test_forward_kinematics__is_the_closed_form_of_the_brokk(q):
    frames = forward_kinematics(BROKK_170, q)
    tool, lowest = closed_form(q)
    np.testing.assert_allclose(tool_position(frames), tool, atol=1e-12)
    np.testing.assert_allclose(lowest_point(frames), lowest, atol=1e-12)


def test_jacobian__of_the_arm_stretched_out():
    """1 rad/s of slew moves the tool at 5 m/s sideways; q2 to q5 lift it by their lever arms."""
    J = jacobian(forward_kinematics(BROKK_170, STRAIGHT))
    expected = [[0, 0, 0, 0, 0], [5, 0, 0, 0, 0], [0, 4.75, 3.6, 2.35, 1.2]]
    np.testing.assert_allclose(J, expected, atol=1e-12)


@pytest.mark.parametrize("shape", [(), (4,), (5, 1)])
def test_forward_kinematics__refuses_angles_of_another_machine(shape):
    with pytest.raises(ValueError) as caught:
        forward_kinematics(BROKK_170, np.zeros(shape))
    assert str(caught.value) == f"q: expected (..., 5), got {shape}"
