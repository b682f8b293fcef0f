"""Views from the side and from above, worked out by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from brokk_min.kinematics import forward_kinematics, tool_position
from brokk_min.machine import BROKK_170
from brokk_min.viewer.camera import cameras, extent, skeleton
from brokk_min.viewer.drawing import NO_POINTS

STRETCHED = np.array([0.0, 0.0, 0.0, np.pi, 3 * np.pi / 4])  # all links horizontal
BOXES = ((10.0, 20.0, 400.0, 200.0), (0.0, 0.0, 100.0, 100.0))  # side, top [px]


def tool(q):
    return tool_position(forward_kinematics(BROKK_170, q))


def test_cameras__see_the_brokk_as_worked_out_by_hand():
    side, top = cameras(BROKK_170, tool(STRETCHED), *BOXES, NO_POINTS)
    flat = np.array([[0, 0], [0.25, 0.95], [1.4, 0.95], [2.65, 0.95], [3.8, 0.95], [5.0, 0.95]])
    p = forward_kinematics(BROKK_170, STRETCHED).p
    np.testing.assert_allclose(side.project(p), side.origin + side.scale * flat * (1, -1))
    along_y = STRETCHED + np.array([np.pi / 2, 0, 0, 0, 0])  # the tool points to the left
    np.testing.assert_allclose(
        top.project(tool(along_y)) - top.origin, [-5.0 * top.scale, 0.0], atol=1e-9
    )
    side, _ = cameras(BROKK_170, tool(along_y), *BOXES, NO_POINTS)
    np.testing.assert_allclose(
        side.project(tool(along_y)), side.origin + side.scale * np.array([5.0, -0.95])
    )


def test_cameras__fit_given_points_into_the_box_as_worked_out_by_hand():
    """400 x 200 px at (10, 20), 14 px of soil: the points fill 0.92 of 400 or of 172 px."""
    _, _, reach = extent(BROKK_170)
    assert 4.5 < reach < 5.0  # of 5 m; random poses come near it
    points = np.array([[0.0, 1.0, 0.5], [0.0, 2.0, 0.75]])
    side, top = cameras(BROKK_170, np.array([0.0, 3.0, 1.0]), *BOXES, points)
    border = 0.06 * reach
    assert side.scale == pytest.approx(
        0.92 * min(400 / (1 + 2 * border), 172 / (0.25 + 2 * border))
    )
    assert top.scale == pytest.approx(0.92 * min(100 / (1 + 2 * border), 86 / (2 * border)))
    middle = np.array([0.0, 1.5, 0.0])
    assert side.project(middle)[0] == pytest.approx(210)
    assert side.project([0.0, 1.0, 0.5 - border])[1] == pytest.approx(206)
    assert top.project(middle)[0] == pytest.approx(50)
    assert top.project([2.0, 0, 0])[1] < 50


def test_skeleton__has_the_ends_of_d_and_a_of_two_links_by_hand():
    """Two links that turn about z, each 0.2 m above the one before and 1 m long."""
    joints = [replace(j, a=1.0, d=0.2, alpha=0.0, theta=0.0) for j in BROKK_170.joints[:2]]
    arm = replace(BROKK_170, joints=tuple(joints))
    expected = [[0, 0, 0], [0, 0, 0.2], [1, 0, 0.2], [1, 0, 0.4], [1, 1, 0.4]]
    np.testing.assert_allclose(skeleton(arm, np.array([0.0, np.pi / 2])), expected, atol=1e-12)
