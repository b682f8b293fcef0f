"""Pictures: joints where kinematics put them, arrows, bars and text of the right size and place."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from PIL import ImageDraw
from strategies import moving

from brokk_min.kinematics import forward_kinematics
from brokk_min.machine import BROKK_170
from brokk_min.viewer import drawing
from brokk_min.viewer.drawing import Scene

Q = np.array([0.4, 0.5, 0.58, 1.71, 1.24])
TOOL = forward_kinematics(BROKK_170, Q).p[-1]
SIZE = (960, 600)
STRETCHED_LEFT = np.array([np.pi / 2, 0.0, 0.0, np.pi, 3 * np.pi / 4])  # with level links


def scene(**more):
    return Scene(Q, np.zeros(5), np.zeros(3), np.zeros(3))._replace(**more)


def test_views__see_the_brokk_as_worked_out_by_hand():
    p = forward_kinematics(BROKK_170, STRETCHED_LEFT).p
    side, top = drawing.views(BROKK_170, STRETCHED_LEFT, SIZE)
    flat = np.array([[0, 0], [0.25, 0.95], [1.4, 0.95], [2.65, 0.95], [3.8, 0.95], [5.0, 0.95]])
    np.testing.assert_allclose(side.project(p), side.origin + side.scale * flat * (1, -1))
    np.testing.assert_allclose(top.project(p[-1]) - top.origin, [-5 * top.scale, 0], atol=1e-9)


@given(moving([()]), st.sampled_from([(960, 600), (640, 360), (1500, 500)]))
def test_views__show_all_of_any_machine(machine_moving, size):
    machine, q, _ = machine_moving
    p = forward_kinematics(machine, q).p
    _, low, high = drawing.extent(machine)
    for view in drawing.views(machine, q, size):
        width, height = view.size
        x, y = view.project(p).T
        shown = (p[:, 2] >= low) & (p[:, 2] <= high) if view.label == "side view" else ...
        assert ((y[shown] >= 0) & (y[shown] <= height)).all()
        assert 0 <= x[-1] <= width and view.scale > 1  # the side view has the tool to the right


def test_draw__points_arrows_along_goal_and_measured_velocity(monkeypatch):
    lines = []
    monkeypatch.setattr(ImageDraw.ImageDraw, "line", lambda pen, *line: lines.append(line))
    goal, v_tool = np.array([[0.1, 0.05, 0.15], [-0.1, 0.1, 0.2]])
    drawing.draw(BROKK_170, scene(v_goal=goal, v_tool=v_tool), SIZE)
    large = (2 * SIZE[0], 2 * SIZE[1])
    for v, colour in ((v_tool, drawing.MEASURED), (goal, drawing.INK)):
        shafts = [points for points, ink, width in lines if (ink, width) == (colour, 6)]
        for view, shaft in zip(drawing.views(BROKK_170, Q, large), shafts, strict=True):
            foot, neck = np.reshape(shaft, (2, 2))
            along, flat = neck - foot, view.axes @ v * (1, -1)
            expected = flat * np.hypot(*along) / np.hypot(*flat)
            np.testing.assert_allclose(along, expected, atol=1e-6)
            np.testing.assert_allclose(foot, view.project(TOOL))


def test_draw__is_an_image_of_the_wanted_size_that_shows_all_of_the_scene():
    first = scene(v_goal=np.array([0.2, 0.0, 0.1]))
    image = np.array(drawing.draw(BROKK_170, first, (640, 360)))
    assert (image.shape, image.dtype) == ((360, 640, 3), np.uint8)
    trail = TOOL + np.array([[0, 0, 0], [0.5, 0.5, 0.5]])
    others = {"q": Q + 0.1, "u": np.full(5, 0.3), "v_goal": -first.v_goal, "v_tool": first.v_goal}
    others |= {"trail": trail, "title": "policy", "status": "3.0 s"}
    for name, other in others.items():
        changed = np.array(drawing.draw(BROKK_170, first._replace(**{name: other}), (640, 360)))
        assert (image != changed).any(axis=-1).sum() > 20, name
