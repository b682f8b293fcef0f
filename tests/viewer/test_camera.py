"""Views from the side and from above, worked out by hand."""

import numpy as np
from helpers_viewer import tool

from brokk_min.kinematics import forward_kinematics
from brokk_min.machine import BROKK_170
from brokk_min.viewer.camera import cameras
from brokk_min.viewer.drawing import NO_POINTS

STRETCHED = np.array([0.0, 0.0, 0.0, np.pi, 3 * np.pi / 4])  # all links horizontal
BOXES = ((10.0, 20.0, 400.0, 200.0), (0.0, 0.0, 100.0, 100.0))  # side, top [px]


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
