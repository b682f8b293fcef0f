"""Pictures: shapes where kinematics put them, pixels of what they show, warnings on and off."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers_canvas import Recorder
from hypothesis import given
from hypothesis import strategies as st
from strategies import moving

from brokk_min.kinematics import forward_kinematics, jacobian, tool_position
from brokk_min.machine import BROKK_170, Machine
from brokk_min.viewer import drawing
from brokk_min.viewer.camera import Camera, cameras
from brokk_min.viewer.drawing import NO_POINTS, Scene

Q = np.array([0.4, 0.5, 0.58, 1.71, 1.24])
STRETCHED = np.array([0.0, 0.0, 0.0, np.pi, 3 * np.pi / 4])  # all links horizontal
SIZE = (960, 600)


def scene(q: np.ndarray = Q, **more: Any) -> Scene:
    still = np.zeros(len(q))
    return Scene(q, still, still, np.zeros(3))._replace(**more)


def drawn(*scenes: Scene, machine: Machine = BROKK_170, size: tuple[int, int] = SIZE) -> Recorder:
    canvas = Recorder(size)
    drawing.draw(canvas, machine, scenes)
    return canvas


def views(
    machine: Machine, q: np.ndarray, in_view: np.ndarray = NO_POINTS
) -> tuple[Camera, Camera]:
    """The cameras of a picture of one arm."""
    side_box, top_box, *_ = drawing._layout((0.0, 0.0, *map(float, SIZE)), machine.n, 0)
    p_tool = tool_position(forward_kinematics(machine, q))
    side, top = cameras(machine, p_tool, side_box, top_box, in_view)
    return side, top


def tool(q: np.ndarray = Q) -> np.ndarray:
    return tool_position(forward_kinematics(BROKK_170, q))


# --- views ----------------------------------------------------------------------------------------


@given(moving([()]), st.sampled_from([(960, 600), (480, 560), (1500, 300)]))
def test_draw__puts_the_joints_of_any_machine_where_kinematics_say(
    machine_moving: tuple[Machine, np.ndarray, np.ndarray], size: tuple[int, int]
) -> None:
    machine, q, q_dot = machine_moving
    goal = np.array([0.1, -0.2, 0.05])
    canvas = drawn(scene(q, q_dot=q_dot, v_goal=goal), machine=machine, size=size)
    for shape in canvas.lines + canvas.polygons:
        assert np.isfinite(shape.points).all()
        assert shape.points.shape[1] == 2
    p = forward_kinematics(machine, q).p
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
        np.testing.assert_allclose(moved, scale * expected, atol=1e-6)
        assert np.sum(expected**2) < 1e-9 or scale > 1


def test_backdrop__has_a_grid_and_the_ground_as_worked_out_by_hand() -> None:
    """20 px a metre, the origin at (50, 80) of a box of 100 x 100 px: the ground is 80 px down."""
    box = (0.0, 0.0, 100.0, 100.0)
    axes = np.array([[1.0, 0, 0], [0, 0, 1.0]])
    camera = Camera("side", box, np.array([50.0, 80.0]), 20.0, axes)
    canvas = Recorder((100, 100))
    drawing._backdrop(canvas, BROKK_170, camera)
    grid = [line.points.tolist() for line in canvas.lines if line.colour == drawing.GRID]
    assert grid[:5] == [[[x, 1], [x, 100]] for x in (10, 30, 50, 70, 90)]
    assert grid[5:] == [[[0, y], [100, y]] for y in (0, 20, 40, 60, 80, 100)]
    (soil,) = canvas.polygons
    assert soil.points.tolist() == [[0, 80], [100, 80], [100, 100], [0, 100]]
    assert canvas.texts_drawn == ["side view, grid 1 m"]
    below = Recorder((100, 100))
    drawing._backdrop(below, replace(BROKK_170, ground=-1.5), camera)
    drawing._backdrop(below, BROKK_170, camera._replace(label="top", scale=2.0))
    assert below.polygons == []
    assert below.texts_drawn == ["side view, grid 1 m", "top view, grid 10 m"]


def test_draw__paints_trail_and_path_and_nothing_else() -> None:
    trail = tool() + np.linspace(0, 1, 50)[:, None] * np.array([0.9, -0.5, 0.5])
    path = tool() + np.array([[0.0, 0.0, 0.0], [0.8, 0.8, -0.2]])
    canvas = drawn(scene(trail=trail, path=path))
    pale = next(line.colour for line in canvas.lines if len(line.points) == 50)
    image = canvas.image().astype(int)
    bare = drawn(scene()).image()
    for camera in views(BROKK_170, Q):
        for points, colour in ((trail[15:-1:5], pale), ((path[1:] + path[:1]) / 2, drawing.PATH)):
            for x, y in np.rint(camera.project(points)).astype(int):
                error = np.abs(image[y - 1 : y + 2, x - 1 : x + 2] - colour).sum(axis=-1)
                assert error.min() < 40, (x, y)
    changed = np.abs(image - bare).sum(axis=-1) > 0
    assert 300 < changed.sum() < 6000


def test_draw__enlarges_points_in_view_and_cuts_off_what_lies_beyond() -> None:
    line = tool() + np.array([[0.0, 0, 0], [0.5, 0, 0], [0.5, 0.8, 0]])
    spans = []
    for in_view in (NO_POINTS, line):
        canvas = drawn(scene(path=line, in_view=in_view))
        paths = [shape.points for shape in canvas.lines if shape.colour == drawing.PATH]
        for (left, upper, width, height), points in zip(canvas.clips, paths, strict=True):
            assert (points > (left, upper)).all()
            assert (points < (left + width, upper + height)).all()
        spans.append([np.ptp(points, axis=0).max() for points in paths])
    assert (np.array(spans[1]) > 2 * np.array(spans[0])).all()
    image = canvas.image()
    assert (image[42, :576] == drawing.COLOURS["rl"]).all(axis=-1).any()  # a link leaves the view
    assert (image[33:39, :576] == drawing.BACKGROUND).all()


def test_draw__points_arrows_along_goal_and_measured_velocity() -> None:
    q_dot = np.array([0.1, 0.0, 0.05, -0.1, 0.2])
    v_tool = jacobian(forward_kinematics(BROKK_170, Q)) @ q_dot
    goal = np.array([0.1, 0.05, 0.15])
    canvas = drawn(scene(q_dot=q_dot, v_goal=goal))
    for v, colour in ((v_tool, drawing.MEASURED), (goal, drawing.GOAL)):
        shafts = [s.points for s in canvas.lines if s.colour == colour and s.width == 3]
        for camera, shaft in zip(views(BROKK_170, Q), shafts, strict=True):
            along = shaft[1] - shaft[0]
            flat = camera.axes @ v * (1, -1)
            np.testing.assert_allclose(along / np.hypot(*along), flat / np.hypot(*flat), atol=1e-6)
    assert not [line for line in drawn(scene()).lines if line.width == 3]


@pytest.mark.parametrize(
    ("along", "shaft", "head"),
    [
        ([30.0, 40], [[0, 0], [23.4, 31.2]], [[30, 40], [19.44, 34.17], [27.36, 28.23]]),
        ([5.0, 0], [[0, 0], [1.5, 0]], [[5, 0], [1.5, 1.575], [1.5, -1.575]]),
    ],
)
def test_arrow__has_shaft_and_head_as_worked_out_by_hand(
    along: list[float], shaft: Any, head: Any
) -> None:
    canvas = Recorder((10, 10))
    drawing._arrow(canvas, np.zeros(2), np.array([4.0, 0]), (1, 2, 3))  # too short
    drawing._arrow(canvas, np.zeros(2), np.array(along), (1, 2, 3))
    (line,) = canvas.lines
    (polygon,) = canvas.polygons
    np.testing.assert_allclose(line.points, shaft)
    np.testing.assert_allclose(polygon.points, head)


def test_draw__rings_the_next_point_of_a_line() -> None:
    target = tool() + np.array([[0.0, 0.5, 0.3]])
    rings = [c for c in drawn(scene(target=target)).circles if c.colour == drawing.PATH]
    for ring, camera in zip(rings, views(BROKK_170, Q), strict=True):
        np.testing.assert_allclose(ring.points, camera.project(target[0]))
        assert ring.width == 3


# --- warnings, rows, layout -----------------------------------------------------------------------


def red_pixels(canvas: Recorder) -> int:
    return int((np.abs(canvas.image().astype(int) - drawing.WARNING).sum(axis=-1) < 30).sum())


@pytest.mark.parametrize(
    ("joint", "angle", "warned"),
    [
        (3, 2.9 - 0.05 * 2.3 + 1e-3, True),  # range 0.6 to 2.9, five percent of it
        (3, 2.9 - 0.05 * 2.3 - 1e-3, False),
        (3, 0.6, True),
        (1, 0.0, False),  # at its limit, but locked
    ],
)
def test_draw__warns_in_red_of_a_driven_joint_near_its_limit(
    joint: int, angle: float, warned: bool
) -> None:
    q = Q.copy()
    q[joint] = angle
    canvas = drawn(scene(q, status="driving", status_colour=drawing.DRIVING))
    expected = [f"{BROKK_170.names[joint]} near its limit"] * warned
    assert [text for text in canvas.texts_drawn if "limit" in text] == expected
    assert (red_pixels(canvas) > 50) == warned


def test_draw__rings_the_tool_in_red_near_a_singularity() -> None:
    wide = [replace(j, q_min=-3.0, q_max=3.2, cylinder_base=0.0) for j in BROKK_170.joints]
    machine = replace(BROKK_170, joints=tuple(wide))
    canvas = drawn(scene(STRETCHED), machine=machine)
    rings = [c for c in canvas.circles if c.colour == drawing.WARNING and c.width]
    for ring, camera in zip(rings, views(machine, STRETCHED), strict=True):
        np.testing.assert_allclose(ring.points, camera.project(tool(STRETCHED)))
    assert "near a singularity" in canvas.texts_drawn
    assert not [c for c in drawn(scene()).circles if c.colour == drawing.WARNING]


def test_near_singular__compares_the_least_singular_value_with_the_arms_length() -> None:
    length = 0.95 + 0.25 + 1.15 + 1.25 + 1.15 + 1.2
    length += np.hypot(0.25, 0.95) - 0.25 - 0.95
    for q3 in np.linspace(-0.3, 1.6, 20):
        q = np.array([0.0, 0.5, q3, 2.9, 1.9])
        J = jacobian(forward_kinematics(BROKK_170, q))[:, [0, 2, 3, 4]]
        least = np.sqrt(np.linalg.eigvalsh(J @ J.T)[0])
        assert drawing.near_singular(BROKK_170, q) == (least < 0.1 * length)


@pytest.mark.parametrize(("counts", "fraction"), [(80, 1.0), (-40, -0.5), (0, 0.0)])
def test_joint_rows__have_valve_bars_as_long_as_the_command(counts: int, fraction: float) -> None:
    u = np.zeros(5)
    u[3] = counts / 127
    canvas = drawn(scene(u=u))
    box = next(box for text, _, box in canvas.words if text == "q4")
    row = [p for p in canvas.polygons if abs(p.points[:, 1].mean() - box[[1, 3]].mean()) < 1]
    track = max(
        (p.points for p in row if p.colour == drawing.TRACK and np.ptp(p.points[:, 1]) > 6),
        key=lambda points: float(np.ptp(points[:, 0])),
    )
    (bar,) = (p.points for p in row if p.colour == drawing.COLOURS["rl"])
    assert bar[1, 0] - bar[0, 0] == pytest.approx(fraction * np.ptp(track[:, 0]) / 2)
    assert f"{counts:+d}" in canvas.texts_drawn
    assert "locked" in canvas.texts_drawn


@pytest.mark.parametrize(("angle", "text"), [(-0.004, "+0.00"), (0.586, "+0.59"), (-0.3, "-0.30")])
def test_joint_rows__mark_angles_and_write_them_without_minus_zero(angle: float, text: str) -> None:
    q = np.array([0.0, 0.5, angle, 1.71, 1.24])
    canvas = drawn(scene(q))
    assert text in canvas.texts_drawn
    row = 2
    marks = [p.points for p in canvas.polygons if np.ptp(p.points[:, 0]) == pytest.approx(6)]
    tracks = [p.points for p in canvas.polygons if np.ptp(p.points[:, 1]) == pytest.approx(4)]
    left, right = tracks[row][:2, 0]
    x = left + (right - left) * (angle + 0.3) / 1.9
    assert marks[row][:2, 0].mean() == pytest.approx(x)


def test_draw__says_that_positions_are_unknown() -> None:
    canvas = drawn(scene(np.full(5, np.nan), status="waiting: q1: silent"))
    assert {"no positions", "waiting: q1: silent"} <= set(canvas.texts_drawn)
    known = {"side view, grid 1 m", "top view, grid 1 m"}
    assert known <= set(drawn(scene()).texts_drawn)
    assert not known & set(canvas.texts_drawn)


@pytest.mark.parametrize(
    ("arms", "size"), [(1, (1120, 680)), (1, SIZE), (2, (900, 480)), (3, (960, 540))]
)
@pytest.mark.parametrize("n", [2, 3, 5])
def test_draw__cuts_off_no_text_and_puts_none_on_another(
    n: int, arms: int, size: tuple[int, int]
) -> None:
    name = "bucke" if arms > 1 else "cylinder_"
    joints = [replace(joint, name=f"{name}{i}") for i, joint in enumerate(BROKK_170.joints[:n])]
    machine = replace(BROKK_170, joints=tuple(joints), q_start=())
    at_limits = scene(
        machine.column("q_max"),
        title="drive_of_the_long_name_2026-11-21.log",
        status="12.3 s",
        notes=[f"note {i}" for i in range(6 if arms == 1 else 2)],
    )
    canvas = drawn(*[at_limits] * arms, machine=machine, size=size)
    warnings = sum("near its limit" in text for text in canvas.texts_drawn)
    assert warnings == arms * len(machine.driven)
    boxes = [box for text, _, box in canvas.words if text]
    for box in boxes:
        assert (box >= 0).all()
        assert (box[2:] <= size).all()
    for one, other in itertools.combinations(boxes, 2):
        assert (one[:2] >= other[2:]).any() or (other[:2] >= one[2:]).any()
    tracks = [p.points for p in canvas.polygons if p.colour == drawing.TRACK]
    assert min(np.ptp(track[:, 0]) for track in tracks) > 10


def test_draw__keeps_two_arms_apart() -> None:
    left = (1, 2, 3)
    right = (4, 5, 6)
    canvas = drawn(scene(colour=left), scene(colour=right))
    for colour, start in ((left, 0), (right, 480)):
        links = np.vstack([p.points for p in canvas.polygons if p.colour == colour])
        assert (links[:, 0] >= start).all()
        assert (links[:, 0] <= start + 480).all()
