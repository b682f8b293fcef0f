"""Pictures: shapes where kinematics put them, pixels of what they show, warnings on and off."""

import itertools
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from helpers_viewer import tool
from hypothesis import given
from hypothesis import strategies as st
from strategies import moving

from brokk_min.kinematics import forward_kinematics, jacobian
from brokk_min.machine import BROKK_170
from brokk_min.viewer import drawing
from brokk_min.viewer.camera import cameras
from brokk_min.viewer.drawing import NO_POINTS, Scene
from brokk_min.viewer.window import Canvas, Colour

Q = np.array([0.4, 0.5, 0.58, 1.71, 1.24])
SIZE = (960, 600)


class Shape(NamedTuple):
    points: np.ndarray  # px (k, 2)
    colour: Colour
    width: float = 0.0  # of a line or ring; 0: filled


class Recorder(Canvas):
    """Lines, polygons (bars too), circles; text and box of each word."""

    def __init__(self, size):
        super().__init__(size)
        self.lines = []
        self.polygons = []
        self.circles = []
        self.words = []

    def line(self, points, colour, width=1):
        super().line(points, colour, width)
        self.lines.append(Shape(points, colour, width))

    def polygon(self, points, colour):
        super().polygon(points, colour)
        self.polygons.append(Shape(points, colour))

    def circle(self, centre, radius, colour, width=0):
        super().circle(centre, radius, colour, width)
        self.circles.append(Shape(centre, colour, width))

    def bar(self, x0, x1, y, half, colour):
        super().bar(x0, x1, y, half, colour)
        corners = [[x0, y - half], [x1, y - half], [x1, y + half], [x0, y + half]]
        self.polygons.append(Shape(np.array(corners), colour))

    def text(self, x, y, text, *more):
        super().text(x, y, text, *more)
        word, (left, upper) = self.texts[-1]
        box = np.array([left, upper, left + word.get_width(), upper + word.get_height()])
        self.words.append((text, box))

    @property
    def texts_drawn(self):
        return [text for text, _ in self.words]


def scene(q=Q, **more):
    still = np.zeros(len(q))
    return Scene(q, still, still, np.zeros(3))._replace(**more)


def drawn(*scenes, machine=BROKK_170, size=SIZE):
    canvas = Recorder(size)
    drawing.draw(canvas, machine, scenes)
    return canvas


def test_cameras__see_the_brokk_as_worked_out_by_hand():
    boxes = ((10.0, 20.0, 400.0, 200.0), (0.0, 0.0, 100.0, 100.0))  # side, top [px]
    stretched = np.array([0.0, 0.0, 0.0, np.pi, 3 * np.pi / 4])  # all links horizontal
    side, _ = cameras(BROKK_170, tool(stretched), *boxes, NO_POINTS)
    flat = np.array([[0, 0], [0.25, 0.95], [1.4, 0.95], [2.65, 0.95], [3.8, 0.95], [5.0, 0.95]])
    p = forward_kinematics(BROKK_170, stretched).p
    np.testing.assert_allclose(side.project(p), side.origin + side.scale * flat * (1, -1))
    p_tool = tool(stretched + np.array([np.pi / 2, 0, 0, 0, 0]))  # it points to the left
    side, top = cameras(BROKK_170, p_tool, *boxes, NO_POINTS)
    moved = top.project(p_tool) - top.origin
    np.testing.assert_allclose(moved, [-5.0 * top.scale, 0.0], atol=1e-9)
    expected = side.origin + side.scale * np.array([5.0, -0.95])
    np.testing.assert_allclose(side.project(p_tool), expected)


@given(moving([()]), st.sampled_from([(960, 600), (480, 560), (1500, 300)]))
def test_draw__puts_the_joints_of_any_machine_where_kinematics_say(machine_moving, size):
    machine, q, q_dot = machine_moving
    goal = np.array([0.1, -0.2, 0.05])
    canvas = drawn(scene(q, q_dot=q_dot, v_goal=goal), machine=machine, size=size)
    for shape in canvas.lines + canvas.polygons:
        assert np.isfinite(shape.points).all()
        assert shape.points.shape[1] == 2
    p = forward_kinematics(machine, q).p[1:]
    heading = np.arctan2(p[-1, 1], p[-1, 0])
    outward = p[:, 0] * np.cos(heading) + p[:, 1] * np.sin(heading)
    side = np.stack([outward, -p[:, 2]], axis=1)
    top = np.stack([-p[:, 1], -p[:, 0]], axis=1)
    filled = [shape.points for shape in canvas.circles if not shape.width]
    for flat, dots in zip((side, top), np.split(np.array(filled[1:]), 2), strict=True):
        found = np.vstack([dots[:-1:2], dots[-1]])  # two circles a joint, one for the tool
        moved = found - found[0]
        expected = flat - flat[0]
        scale = np.sum(moved * expected) / max(np.sum(expected**2), 1e-12)
        if np.sum(expected**2) > 1e-9:  # else all joints are at one place
            np.testing.assert_allclose(moved, scale * expected, atol=1e-6)
            assert scale > 1


def test_draw__points_arrows_along_goal_and_measured_velocity():
    q_dot = np.array([0.1, 0.0, 0.05, -0.1, 0.2])
    v_tool = jacobian(forward_kinematics(BROKK_170, Q)) @ q_dot
    goal = np.array([0.1, 0.05, 0.15])
    canvas = drawn(scene(q_dot=q_dot, v_goal=goal))
    side_box, top_box, *_ = drawing._layout((0.0, 0.0, 960.0, 600.0), 5, 0)
    views = cameras(BROKK_170, tool(Q), side_box, top_box, NO_POINTS)
    for v, colour in ((v_tool, drawing.MEASURED), (goal, drawing.GOAL)):
        shafts = [s.points for s in canvas.lines if s.colour == colour and s.width == 3]
        for camera, shaft in zip(views, shafts, strict=True):
            along = shaft[1] - shaft[0]
            flat = camera.axes @ v * (1, -1)
            np.testing.assert_allclose(along / np.hypot(*along), flat / np.hypot(*flat), atol=1e-6)
    assert not [line for line in drawn(scene()).lines if line.width == 3]


def red_pixels(canvas):
    return int((np.abs(canvas.image().astype(int) - drawing.WARNING).sum(axis=-1) < 30).sum())


@pytest.mark.parametrize(
    ("joint", "angle", "warned"),
    [
        (3, 2.9 - 0.05 * 2.3 + 1e-3, True),  # range 0.6 to 2.9, five percent of it
        (3, 2.9 - 0.05 * 2.3 - 1e-3, False),
        (3, 0.6, True),
        (1, 1.4, False),  # at its limit, but locked
    ],
)
def test_draw__warns_in_red_of_a_driven_joint_near_its_limit(joint, angle, warned):
    q = Q.copy()
    q[joint] = angle
    canvas = drawn(scene(q, status="driving", status_colour=drawing.DRIVING))
    expected = [f"{BROKK_170.names[joint]} near its limit"] * warned
    assert [text for text in canvas.texts_drawn if "limit" in text] == expected
    assert (red_pixels(canvas) > 50) == warned


@pytest.mark.parametrize(("counts", "fraction"), [(80, 1.0), (-40, -0.5), (0, 0.0)])
def test_joint_rows__have_valve_bars_as_long_as_the_command(counts, fraction):
    u = np.zeros(5)
    u[3] = counts / 127
    canvas = drawn(scene(u=u))
    box = next(box for text, box in canvas.words if text == "q4")
    row = [p for p in canvas.polygons if abs(p.points[:, 1].mean() - box[[1, 3]].mean()) < 1]
    track = max(
        (p.points for p in row if p.colour == drawing.TRACK and np.ptp(p.points[:, 1]) > 6),
        key=lambda points: float(np.ptp(points[:, 0])),
    )
    (bar,) = (p.points for p in row if p.colour == drawing.COLOURS["rl"])
    assert bar[1, 0] - bar[0, 0] == pytest.approx(fraction * np.ptp(track[:, 0]) / 2)
    assert f"{counts:+d}" in canvas.texts_drawn
    assert "locked" in canvas.texts_drawn


@pytest.mark.parametrize(
    ("arms", "size"), [(1, (1120, 680)), (1, SIZE), (2, (900, 480)), (3, (960, 540))]
)
@pytest.mark.parametrize("n", [2, 5])
def test_draw__cuts_off_no_text_and_puts_none_on_another(n, arms, size):
    name = "bucke" if arms > 1 else "cylinder_"
    joints = [replace(joint, name=f"{name}{i}") for i, joint in enumerate(BROKK_170.joints[:n])]
    machine = replace(BROKK_170, joints=tuple(joints), q_start=())
    at_limits = scene(
        machine.column("q_max"),
        title="drive_of_the_long_name_2026-11-21.log",
        status="12.3 s",
        notes=[f"note {i} " + 9 * "of some length " * (arms == 1) for i in range(3)],
        banner="q1: silent. It sent no position.",
        headline="3 mm",
    )
    canvas = drawn(*[at_limits] * arms, machine=machine, size=size)
    warnings = sum("near its limit" in text for text in canvas.texts_drawn)
    assert warnings == arms * len(machine.driven)
    boxes = [box for text, box in canvas.words if text]
    for box in boxes:
        assert (box >= 0).all()
        assert (box[2:] <= size).all()
    assert sum("length" in text for text in canvas.texts_drawn) >= 3 * (arms == 1)
    for one, other in itertools.combinations(boxes, 2):
        assert (one[:2] >= other[2:]).any() or (other[:2] >= one[2:]).any()
    tracks = [p.points for p in canvas.polygons if p.colour == drawing.TRACK]
    assert min(np.ptp(track[:, 0]) for track in tracks) > 10
