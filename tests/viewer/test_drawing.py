"""Pictures: shapes where kinematics put them, pixels of what they must show, warnings on and off."""

from __future__ import annotations

import itertools
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import RecordVideo, RenderCollection
from helpers_machines import random_machine
from hypothesis import given
from hypothesis import strategies as st
from strategies import moving

from brokk_min.env import TaskConfig
from brokk_min.jacobian import manipulability
from brokk_min.kinematics import forward_kinematics, frames, jacobian, tool_position
from brokk_min.learning.gym_env import TaskEnv
from brokk_min.machine import BROKK_170, Machine
from brokk_min.viewer import drawing as view
from brokk_min.viewer import window
from brokk_min.viewer.drawing import Circle, Line, Polygon, Scene, Text, draw
from brokk_min.viewer.window import picture

Q = np.array([0.4, 0.5, 0.58, 1.71, 1.24])
SIZE = (960, 600)


def scene(q: np.ndarray = Q, **more: object) -> Scene:
    still = np.zeros(len(q))
    return Scene(q, still, still, np.zeros(3))._replace(**more)  # type: ignore[arg-type]


def words(shapes: list[view.Shape]) -> list[str]:
    return [shape.text for shape in shapes if isinstance(shape, Text)]


def eyes(machine: Machine, q: np.ndarray) -> tuple[view.Camera, view.Camera]:
    """The cameras of a picture of one arm, which `draw` alone lays out."""
    seen: list[tuple[view.Camera, view.Camera]] = []
    inner = view.cameras
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(view, "cameras", lambda *a: seen.append(inner(*a)) or seen[-1])
        draw(machine, [scene(q)], SIZE)
    return seen[0]


def test_importing_needs_neither_pygame_nor_physics() -> None:
    code = (
        "import sys, brokk_min.viewer.window; print([m for m in sys.modules if m in ('can', 'pygame', 'torch', "
        "'matplotlib', 'gymnasium') or m.startswith('brokk_min.')])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    pure = ("window", "view", "looks", "kinematics", "machine")
    assert set(eval(done.stdout)) == {f"brokk_min.{name}" for name in pure}


@given(moving([()]), st.sampled_from([(960, 600), (480, 560), (1500, 300)]))
def test_any_machine_draws_with_its_joints_where_kinematics_say(
    drawn: tuple[Machine, np.ndarray, np.ndarray], size: tuple[int, int]
) -> None:
    machine, q, q_dot = drawn
    shapes = draw(machine, [scene(q, q_dot=q_dot, v_goal=np.array([0.1, -0.2, 0.05]))], size)
    for shape in shapes:
        if isinstance(shape, Line | Polygon):
            assert np.isfinite(shape.points).all() and shape.points.shape[1] == 2
    p = frames(machine, q)[:, :3, 3]
    heading = np.arctan2(p[-1, 1], p[-1, 0]) if np.hypot(*p[-1, :2]) > 1e-6 else 0.0
    side = np.stack([p[:, 0] * np.cos(heading) + p[:, 1] * np.sin(heading), -p[:, 2]], axis=1)
    top = np.stack([-p[:, 1], -p[:, 0]], axis=1)
    centres = np.array(
        [shape.centre for shape in shapes if isinstance(shape, Circle)][1:]
    )  # title's dot
    arms = np.split(centres, 2)
    for arm, flat in zip(arms, (side, top), strict=True):
        found = np.vstack([arm[:-1:2], arm[-1]])  # two circles a joint, one for the tool
        np.testing.assert_array_equal(arm[:-1:2], arm[1::2])
        moved, wanted = found - found[0], flat - flat[0]
        scale = np.sum(moved * wanted) / max(np.sum(wanted * wanted), 1e-12)
        np.testing.assert_allclose(moved, scale * wanted, atol=1e-6)
        assert np.sum(wanted * wanted) < 1e-9 or scale > 1


@pytest.mark.parametrize("n", [2, 3, 4, 5, 6])
def test_everything_lies_within_the_picture_and_paints(n: int) -> None:
    rng = np.random.default_rng(n)
    machine = random_machine(rng, n)
    q = rng.uniform(machine.column("q_min"), machine.column("q_max"))
    shapes = draw(machine, [scene(q), scene(q)], SIZE)
    for shape in shapes:
        if isinstance(shape, Circle):
            assert (shape.centre >= 0).all() and (shape.centre <= SIZE).all()
    image = picture(shapes, SIZE)
    assert image.shape == (600, 960, 3) and image.dtype == np.uint8
    assert image.std() > 5


def test_views_of_the_brokk_by_hand() -> None:
    """At q1 = 0 and all others 0: elevations 0, 0, -pi, -3 pi/4 - pi; x and height add up by hand."""
    q = np.array([0.0, 0.0, 0.0, np.pi, 3 * np.pi / 4])  # all links horizontal
    side, top = eyes(BROKK_170, q)
    flat = np.array([[0, 0], [0.25, 0.95], [1.4, 0.95], [2.65, 0.95], [3.8, 0.95], [5.0, 0.95]])
    p = frames(BROKK_170, q)[:, :3, 3]
    np.testing.assert_allclose(side.project(p), side.origin + side.scale * flat * (1, -1))
    turned = np.array([np.pi / 2, 0.0, 0.0, np.pi, 3 * np.pi / 4])  # the tool points along y: left
    away = top.project(tool_position(forward_kinematics(BROKK_170, turned))) - top.origin
    np.testing.assert_allclose(away, [-5.0 * top.scale, 0.0], atol=1e-9)
    side, _ = eyes(BROKK_170, turned)
    np.testing.assert_allclose(
        side.project(frames(BROKK_170, turned)[-1, :3, 3])[1], side.origin[1] - 0.95 * side.scale
    )


def test_cameras_by_hand() -> None:
    """A view of 400 by 200 px at (10, 20), 14 px of soil: what is held fills 0.92 of 400 or of 172 px."""
    side, top = (10.0, 20.0, 400.0, 200.0), (0.0, 0.0, 100.0, 100.0)
    reach, p_tool = view.extent(BROKK_170).reach, np.array([0.0, 3.0, 1.0])
    assert 4.5 < reach < 5.0  # of 5 m; drawn poses come near it
    hold = np.array([[0.0, 1.0, 0.5], [0.0, 2.0, 0.75]])
    one, other = view.cameras(BROKK_170, p_tool, side, top, hold)
    margin = 0.06 * reach
    assert one.scale == pytest.approx(0.92 * min(400 / (1 + 2 * margin), 172 / (0.25 + 2 * margin)))
    middle, low = np.array([0.0, 1.5, 0.0]), np.array([0.0, 1.0, 0.5 - margin])
    assert one.project(middle)[0] == pytest.approx(210) and one.project(low)[1] == pytest.approx(
        206
    )
    assert other.scale == pytest.approx(0.92 * min(100 / (1 + 2 * margin), 86 / (2 * margin)))
    assert other.project(middle)[0] == pytest.approx(50) and other.project([2.0, 0, 0])[1] < 50
    right = view._side_axes(np.array([[3.0, 4.0, 1.0], [0.0, 0.0, 2.0], [0.0, -0.5, 0.0]]))
    np.testing.assert_allclose(right[:, 0], [[0.6, 0.8, 0], [1, 0, 0], [0, -1, 0]])
    np.testing.assert_allclose(right[:, 1], [[0, 0, 1]] * 3)


def test_corners_of_an_arm_by_hand() -> None:
    """Two links that turn about z, each 0.2 m above the one before and 1 m long."""
    joints = [replace(j, a=1.0, d=0.2, alpha=0.0, theta=0.0) for j in BROKK_170.joints[:2]]
    arm = replace(BROKK_170, joints=tuple(joints))
    found = view.skeleton(arm, np.array([0.0, np.pi / 2]))
    wanted = [[0, 0, 0], [0, 0, 0.2], [1, 0, 0.2], [1, 0, 0.4], [1, 1, 0.4]]
    np.testing.assert_allclose(found, wanted, atol=1e-12)


def test_the_trail_is_painted_where_the_tool_was() -> None:
    p = tool_position(forward_kinematics(BROKK_170, Q))
    trail = p + np.linspace(0, 1, 50)[:, None] * np.array([0.9, -0.5, 0.5])
    path = p + np.array([[0.0, 0.0, 0.0], [0.8, 0.8, -0.2]])
    shapes = draw(BROKK_170, [scene(trail=trail, path=path)], SIZE)
    image, bare = picture(shapes, SIZE), picture(draw(BROKK_170, [scene()], SIZE), SIZE)
    pale = next(s.colour for s in shapes if isinstance(s, Line) and len(s.points) == 50)
    for camera in eyes(BROKK_170, Q):
        for points, colour in ((trail[15:-1:5], pale), ((path[1:] + path[:1]) / 2, view.PATH)):
            for x, y in np.rint(camera.project(points)).astype(int):
                near = np.abs(image[y - 1 : y + 2, x - 1 : x + 2].astype(int) - colour).sum(axis=-1)
                assert near.min() < 40, (x, y)
    changed = np.abs(image.astype(int) - bare).sum(axis=-1) > 0
    assert 300 < changed.sum() < 6000  # and nowhere else


def test_views_show_what_they_are_to_hold() -> None:
    """A line near the tool, enlarged; what lies beyond a view's edge is painted over nothing else."""
    p = tool_position(forward_kinematics(BROKK_170, Q))
    line = p + np.array([[0.0, 0, 0], [0.5, 0, 0], [0.5, 0.8, 0]])
    whole, near = (
        draw(BROKK_170, [scene(path=line, hold=hold)], SIZE) for hold in (np.zeros((0, 3)), line)
    )
    spans = []
    for shapes in (whole, near):
        boxes = [s.box for s in shapes if isinstance(s, view.Clip)]
        paths = [s.points for s in shapes if isinstance(s, Line) and s.colour == view.PATH]
        for (left, upper, width, height), points in zip(boxes, paths, strict=False):
            assert (points > (left, upper)).all() and (
                points < (left + width, upper + height)
            ).all()
        spans.append([np.ptp(points, axis=0).max() for points in paths])
    assert (np.array(spans[1]) > 2 * np.array(spans[0])).all()
    image = picture(near, SIZE)
    assert (
        (image[42, :576] == view.COLOURS["rl"]).all(axis=-1).any()
    )  # a link leaves the view upwards
    np.testing.assert_array_equal(image[33:39, :576] - np.array(view.PAPER), 0)


def test_arrows_point_along_the_velocities() -> None:
    rates = np.array([0.1, 0.0, 0.05, -0.1, 0.2])
    J = jacobian(forward_kinematics(BROKK_170, Q))[..., BROKK_170.driven] @ rates[BROKK_170.driven]
    wanted = np.array([0.1, 0.05, 0.15])
    shapes = draw(BROKK_170, [scene(q_dot=rates, v_goal=wanted)], SIZE)
    for v, colour in ((J, view.MEASURED), (wanted, view.WANTED)):
        shafts = [
            s.points for s in shapes if isinstance(s, Line) and s.colour == colour and s.width == 3
        ]
        assert len(shafts) == 2  # one a view
        for camera, shaft in zip(eyes(BROKK_170, Q), shafts, strict=True):
            along, flat = shaft[1] - shaft[0], camera.axes @ v * (1, -1)
            np.testing.assert_allclose(along / np.hypot(*along), flat / np.hypot(*flat), atol=1e-6)
    still = draw(BROKK_170, [scene()], SIZE)
    assert not [s for s in still if isinstance(s, Line) and s.width == 3]


@pytest.mark.parametrize(("u", "share"), [(80, 1.0), (-40, -0.5), (0, 0.0)])
def test_valve_bars_are_as_long_as_the_command(u: int, share: float) -> None:
    command = np.zeros(5)
    command[3] = u / 127
    shapes = draw(BROKK_170, [scene(u=command)], SIZE)
    y = next(s.at[1] for s in shapes if isinstance(s, Text) and s.text == "q4")
    bars = [s for s in shapes if isinstance(s, Polygon) and s.points[:, 1].mean() == y]
    track = max(
        (b for b in bars if b.colour == view.TRACK and np.ptp(b.points[:, 1]) > 6),
        key=lambda b: np.ptp(b.points[:, 0]),
    )
    filled = [b for b in bars if b.colour == view.COLOURS["rl"]]
    half = np.ptp(track.points[:, 0]) / 2
    assert sum(b.points[1, 0] - b.points[0, 0] for b in filled) == pytest.approx(share * half)
    assert f"{u:+d}" in words(shapes) and "locked" in words(shapes)


def red(image: np.ndarray) -> int:
    return int((np.abs(image.astype(int) - view.WARNING).sum(axis=-1) < 30).sum())


def test_a_limit_and_a_singularity_warn_in_red() -> None:
    clean = draw(BROKK_170, [scene(mood="driving", status="driving")], SIZE)
    assert not [w for w in words(clean) if "near" in w] and red(picture(clean, SIZE)) == 0
    at_limit = Q.copy()
    at_limit[3] = 2.9 - 0.05 * 2.3 + 1e-3  # range 0.6 to 2.9, five percent of it
    shapes = draw(BROKK_170, [scene(at_limit)], SIZE)
    assert [w for w in words(shapes) if "near" in w] == ["q4 near its limit"]
    assert red(picture(shapes, SIZE)) > 50
    at_limit[3] -= 2e-3
    assert not [w for w in words(draw(BROKK_170, [scene(at_limit)], SIZE)) if "near" in w]
    locked = Q.copy()
    locked[1] = 0.0  # at its limit, but nobody drives it there
    assert not [w for w in words(draw(BROKK_170, [scene(locked)], SIZE)) if "limit" in w]
    wide = replace(
        BROKK_170,
        joints=tuple(
            replace(j, q_min=-3.0, q_max=3.2, cylinder_base=0.0) for j in BROKK_170.joints
        ),
    )
    stretched = np.array([0.3, 0.4, 0.0, np.pi, 3 * np.pi / 4])
    shapes = draw(wide, [scene(stretched)], SIZE)
    rings = [
        s
        for s in shapes
        if isinstance(s, Line) and s.colour == view.WARNING and len(s.points) == 25
    ]
    tips = [
        camera.project(tool_position(forward_kinematics(wide, stretched)))
        for camera in eyes(wide, stretched)
    ]
    np.testing.assert_allclose([ring.points[:-1].mean(axis=0) for ring in rings], tips)
    assert not [s for s in clean if isinstance(s, Line) and s.colour == view.WARNING]
    assert "near a singularity" in words(shapes)
    value, way = view.weakest(wide, stretched)
    outward = np.array([np.cos(0.3) * np.cos(0.4), np.sin(0.3) * np.cos(0.4), np.sin(0.4)])
    assert value == pytest.approx(0, abs=1e-9) and abs(way @ outward) == pytest.approx(1)


@given(st.integers(0, 1000))
def test_the_weakest_way_bounds_manipulability(seed: int) -> None:
    q = np.random.default_rng(seed).uniform(BROKK_170.column("q_min"), BROKK_170.column("q_max"))
    J, (value, way) = (
        jacobian(forward_kinematics(BROKK_170, q))[..., BROKK_170.driven],
        view.weakest(BROKK_170, q),
    )
    assert np.linalg.norm(way @ J) == pytest.approx(value, abs=1e-9)
    singular = np.sqrt(np.maximum(np.linalg.eigvalsh(J @ J.T), 0))
    assert np.prod(singular) == pytest.approx(manipulability(J), abs=1e-6)
    assert value == pytest.approx(singular[0], abs=1e-6)


def test_unknown_positions_and_states_are_said() -> None:
    shapes = draw(
        BROKK_170, [scene(np.full(5, np.nan), status="waiting: q1: silent", mood="waiting")], SIZE
    )
    assert {"no positions", "waiting: q1: silent"} <= set(words(shapes))
    assert {"side view, grid 1 m", "top view, grid 1 m"} <= set(
        words(draw(BROKK_170, [scene()], SIZE))
    )
    assert picture(shapes, SIZE).std() > 0


def boxes_of_words(shapes: list[view.Shape]) -> dict[str, np.ndarray]:
    """Left, upper, right and lower end of each text as painted [px]."""
    found = {}
    for at, text, size, colour, anchor in (s for s in shapes if isinstance(s, Text) and s.text):
        width, height = window._word(text, size, colour).get_size()
        left, upper = at[0] - anchor * width, at[1] - height / 2
        found[f"{text} at {at}"] = np.array([left, upper, left + width, upper + height])
    return found


@pytest.mark.parametrize(
    ("arms", "size"), [(1, (1120, 680)), (1, SIZE), (2, (900, 480)), (3, (960, 540))]
)
@pytest.mark.parametrize("n", [2, 3, 5])
def test_no_text_is_cut_off_or_lies_on_another(n: int, arms: int, size: tuple[int, int]) -> None:
    rng = np.random.default_rng(n)
    drawn = random_machine(rng, n)
    name = "bucke" if arms > 1 else "cylinder_"
    joints = tuple(replace(joint, name=f"{name}{i}") for i, joint in enumerate(drawn.joints))
    machine = replace(drawn, joints=joints)
    notes = [f"note {i}" for i in range(6 if arms == 1 else 2)]
    at_limits = scene(
        machine.column("q_max"), title="drive_of_the_long_name_2026-11-21.log", status="12.3 s"
    )
    shapes = draw(machine, [at_limits._replace(notes=notes)] * arms, size)
    assert sum("near its limit" in word for word in words(shapes)) == arms * len(machine.driven)
    found = boxes_of_words(shapes)
    for name, box in found.items():
        assert (box[:2] >= 0).all() and (box[2:] <= size).all(), name
    for (a, one), (b, other) in itertools.combinations(found.items(), 2):
        assert (one[:2] >= other[2:]).any() or (other[:2] >= one[2:]).any(), (a, b)
    tracks = [s.points for s in shapes if isinstance(s, Polygon) and s.colour == view.TRACK]
    assert min(track[1, 0] - track[0, 0] for track in tracks) > 10


def test_shapes_are_painted_where_they_are_and_as_large() -> None:
    red, blue, green, paper = (200, 0, 0), (0, 0, 200), (0, 150, 0), view.PAPER
    corner = np.array([[5.0, 5], [5, 35], [35, 35]])
    square = np.array([[44.0, 20], [52, 20], [52, 28], [44, 28]])
    shapes = [Line(corner, red, 4), Circle(np.array([25.0, 15]), 5, blue), Polygon(square, green)]
    image = picture(shapes, (60, 40))

    def across(row: int, colour: tuple[int, int, int]) -> list[int]:
        return np.flatnonzero((image[row] == colour).all(axis=-1)).tolist()

    assert across(20, red) == [4, 5, 6] and across(35, red) == list(
        range(5, 35)
    )  # open: no way back
    assert across(15, blue) == list(range(20, 30)) and across(24, green) == list(range(44, 52))
    assert (image[20, 8:44] == paper).all()
    for anchor, left in (
        (0.0, 21),
        (0.5, 7),
        (1.0, 0),
    ):  # where the word begins, its middle or its end
        image = picture([Text((20, 15), "HHH", 12, red, anchor)], (60, 40))
        rows, columns = (image != paper).any(axis=-1).nonzero()
        assert columns.min() == left and (rows.min(), rows.max()) == (11, 19)


def test_text_stays_legible_over_an_arm() -> None:
    under = view.Polygon(np.array([[0, 0], [200, 0], [200, 40], [0, 40]]), view.COLOURS["jacobian"])
    image = picture([under, Text((10, 20), "near", 13, view.WARNING)], (200, 40))
    assert (image[20, 10:30] == view.PAPER).all(axis=-1).any()


def test_the_next_point_of_a_line_is_ringed() -> None:
    p = tool_position(forward_kinematics(BROKK_170, Q)) + np.array([[0.0, 0.5, 0.3]])
    shapes = draw(BROKK_170, [scene(target=p)], SIZE)
    rings = [s.points for s in shapes if isinstance(s, Line) and s.colour == view.PATH]
    for ring, camera in zip(rings, eyes(BROKK_170, Q), strict=True):
        np.testing.assert_allclose(np.hypot(*(ring - camera.project(p)).T), 9.0)


def test_two_arms_share_no_column() -> None:
    left, right = scene(colour=(1, 2, 3)), scene(colour=(4, 5, 6))
    shapes = draw(BROKK_170, [left, right], SIZE)
    for colour, inside in (((1, 2, 3), slice(0, 480)), ((4, 5, 6), slice(480, 960))):
        links = np.vstack(
            [s.points for s in shapes if isinstance(s, Polygon) and s.colour == colour]
        )
        assert (links[:, 0] >= inside.start).all() and (links[:, 0] <= inside.stop).all()


def test_pygame_is_asked_for_in_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(ValueError, match=r"pygame: expected the extra brokk_min\[play\], got"):
        picture([], SIZE)


# --- Gymnasium ----------------------------------------------------------------------------------------


def test_gymnasium_renders_what_happens() -> None:
    env = gymnasium.make("brokk_min/Brokk170-v0", render_mode="rgb_array")
    check_env(env.unwrapped)
    env = RenderCollection(env, pop_frames=False)
    env.reset(seed=1)
    for k in range(12):
        env.step(
            np.array([1.0 if k < 11 else 0.5, 0.0, 0.0, 1.0], np.float32)
        )  # the newest command shows
    images = env.render()
    assert isinstance(images, list) and len(images) == 13
    inner = env.unwrapped
    assert isinstance(inner, TaskEnv) and inner.state is not None
    state, trail = inner.state, np.array(inner.pictures.trails[0])
    shown = scene(
        state.q[0], q_dot=state.q_dot[0], v_goal=state.v_goal[0], trail=trail, title="brokk170"
    )
    shown = shown._replace(u=state.history[0, :, 2, -1])
    np.testing.assert_array_equal(images[-1], picture(draw(BROKK_170, [shown], SIZE), SIZE))
    assert len(shown.trail) == 13 and (images[-1] != images[0]).any()
    np.testing.assert_allclose(
        shown.trail[-1], tool_position(forward_kinematics(BROKK_170, inner.state.q[0]))
    )
    env.reset(seed=2)
    assert len(inner.pictures.trails[0]) == 1  # a new episode leaves no trail of the old one
    env.close()


def test_gymnasium_shows_a_window(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    env = gymnasium.make("brokk_min/Brokk170-v0", render_mode="human")
    env.reset(seed=1)
    env.step(np.zeros(4, np.float32))
    window = env.unwrapped.pictures.window  # type: ignore[attr-defined]
    assert window.surface.get_size() == SIZE and env.render() is None
    blue = view.COLOURS["rl"]
    image = window.pygame.surfarray.array3d(window.surface)
    assert (image == blue).all(axis=-1).sum() > 1000
    env.close()
    assert not window.pygame.display.get_init()


def test_many_environments_render_one_frame_each() -> None:
    envs = gymnasium.make_vec(
        "brokk_min/Brokk170-v0",
        num_envs=2,
        config=TaskConfig(episode_s=0.2),
        render_mode="rgb_array",
    )
    envs.reset(seed=0)
    for _ in range(6):
        envs.step(np.zeros((2, 4), np.float32))
    images = envs.render()
    assert isinstance(images, tuple) and [image.shape for image in images] == [(600, 960, 3)] * 2
    assert (images[0] != images[1]).any()
    trails = envs.unwrapped.pictures.trails  # type: ignore[attr-defined]
    assert [len(trail) for trail in trails.values()] == [
        3,
        3,
    ]  # one of the reset in step 4, then two


def test_a_video_is_recorded(tmp_path: Path) -> None:
    pytest.importorskip("moviepy")
    env = RecordVideo(
        gymnasium.make("brokk_min/Brokk170-v0", render_mode="rgb_array"),
        str(tmp_path),
        video_length=5,
    )
    env.reset(seed=1)
    for _ in range(6):
        env.step(np.zeros(4, np.float32))
    env.close()
    assert next(tmp_path.glob("*.mp4")).stat().st_size > 1000


def test_rendering_refuses_what_it_cannot_do(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match=r"render_mode: expected one of .* got 'ansi'"):
        TaskEnv(render_mode="ansi")
    with pytest.raises(ValueError, match="render: expected a render_mode and a reset before"):
        TaskEnv(render_mode="rgb_array").render()
    env = TaskEnv(render_mode="rgb_array")
    env.reset(seed=0)
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(ValueError, match=r"pygame: expected the extra brokk_min\[play\], got"):
        env.render()


def test_a_window_needs_a_display(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "nonsense")
    with pytest.raises(ValueError, match="window: expected a display"):
        window.Window(SIZE, "none")


# --- shapes by hand ---------------------------------------------------------------------------------------


def listed(shapes: list[view.Shape]) -> list[tuple[object, ...]]:
    """Shapes as plain values, rounded to a thousandth of a pixel."""
    plain = lambda x: np.round(x, 3).tolist() if isinstance(x, np.ndarray | float | tuple) else x  # noqa: E731
    return [(type(s).__name__, *map(plain, s)) for s in shapes]


def test_the_backdrop_by_hand() -> None:
    """20 px a metre, the origin at (50, 80) of a box of 100 by 100 px: the ground lies 80 px down."""
    flat = np.array([[1.0, 0, 0], [0, 0, 1.0]])
    camera = view.Camera(np.array([50.0, 80.0]), 20.0, flat)
    box = (0.0, 0.0, 100.0, 100.0)
    grid = [("Line", [[x, 1], [x, 100]], list(view.GRID), 1) for x in (10, 30, 50, 70, 90)]
    grid += [("Line", [[0, y], [100, y]], list(view.GRID), 1) for y in (0, 20, 40, 60, 80, 100)]
    soil = [
        ("Polygon", [[0, 80], [100, 80], [100, 100], [0, 100]], list(view.SOIL)),
        ("Line", [[0, 80], [100, 80]], list(view.STEEL), 2),
    ]
    said = [("Text", [14, 14], "side view, grid 1 m", 11, list(view.MUTED), 0.0)]
    assert listed(view._backdrop(BROKK_170, camera, box, "side")) == grid + soil + said
    below = replace(BROKK_170, ground=-1.5)  # 110 px down: not seen
    assert listed(view._backdrop(below, camera, box, "side")) == grid + said
    top = listed(view._backdrop(BROKK_170, camera._replace(scale=2.0), box, "top"))
    assert top[-1][2] == "top view, grid 10 m" and [s[1][0][0] for s in top[:5]] == [
        10,
        30,
        50,
        70,
        90,
    ]
    assert (
        listed(view._backdrop(BROKK_170, camera._replace(scale=200.0), box, "top"))[-1][2]
        == "top view, grid 0.1 m"
    )


def test_an_arm_by_hand() -> None:
    """Two links of 1 m, 0.2 m apart, seen from the side at 100 px a metre; links grow thinner."""
    joints = [replace(j, a=1.0, d=0.2, alpha=0.0, theta=0.0) for j in BROKK_170.joints[:2]]
    arm = replace(BROKK_170, joints=tuple(joints))
    side = np.array([[1.0, 0, 0], [0, 0, 1.0]])
    camera = view.Camera(np.array([10.0, 90.0]), 100.0, side)
    thick = 0.032 * view.extent(arm).reach * 100
    assert 5 < thick < 7
    s = np.array([*np.linspace(thick, 0.45 * thick, 5)[:4], 0.12 * thick])
    seen = scene(np.zeros(2), colour=(10, 20, 30))
    base, *links = (shape for shape in view._arm(arm, camera, seen, np.array([False, True])))
    assert isinstance(base, Polygon) and base.colour == view.STEEL
    np.testing.assert_allclose(
        (base.points - [10, 90]) / thick, [[-2, -0.9], [2, -0.9], [2.3, 0], [-2.3, 0]]
    )
    corners = np.array([[10, 90], [10, 70], [110, 70], [110, 50], [210, 50]])
    across = np.array([[1, 0], [0, 1], [1, 0], [0, 1]])  # a quarter turn from along
    for i, link in enumerate(links[:4]):
        a, b, w = corners[i], corners[i + 1], across[i]
        wanted = [a + s[i] * w, b + s[i + 1] * w, b - s[i + 1] * w, a - s[i] * w]
        assert isinstance(link, Polygon) and link.colour == (view.STEEL if i == 0 else (10, 20, 30))
        np.testing.assert_allclose(link.points, wanted)
    pale = tuple(round(c + 0.15 * (p - c)) for c, p in zip((10, 20, 30), view.PAPER, strict=True))
    for i, (size, ring, colour) in enumerate(
        ((s[0], 1.1, pale), (max(4.0, s[2]), 1.5, view.WARNING))
    ):
        outer, inner = links[4 + 2 * i : 6 + 2 * i]
        assert isinstance(outer, Circle) and isinstance(inner, Circle)
        assert (outer.radius, outer.colour) == (pytest.approx(ring * size), colour)
        assert (inner.radius, inner.colour) == (pytest.approx(0.5 * size), view.PAPER)
        np.testing.assert_allclose([outer.centre, inner.centre], [corners[2 * i]] * 2)
    assert len(links) == 8
    above = view.Camera(np.array([10.0, 90.0]), 100.0, view.ABOVE)
    plinth, *flat = view._arm(arm, above, seen, np.zeros(2, bool))
    assert isinstance(plinth, Polygon) and len(flat) == 6  # links along the view are points
    np.testing.assert_allclose(
        (plinth.points - [10, 90]) / thick, [[-1.8, -2.4], [1.8, -2.4], [1.8, 2.4], [-1.8, 2.4]]
    )


def test_rows_of_joints_by_hand() -> None:
    """On 344 px: 46 for names, 58 and 40 for digits, 100 for each bar; q3 near its limit, q2 locked."""
    low, high = BROKK_170.column("q_min"), BROKK_170.column("q_max")
    q = 0.75 * low + 0.25 * high
    q[2], q[4] = high[2], np.nan
    u = np.array([0.0, 0.3, 40.0, -80.0, 0.0]) / 127
    shapes = listed(
        view._rows(BROKK_170, scene(q, u=u, colour=(1, 2, 3)), (10.0, 100.0, 344.0, 0.0))
    )
    track, ink, muted, warning = (list(c) for c in (view.TRACK, view.INK, view.MUTED, view.WARNING))

    def bar(x0: float, x1: float, y: float, half: float, colour: object) -> tuple[object, ...]:
        return ("Polygon", [[x0, y - half], [x1, y - half], [x1, y + half], [x0, y + half]], colour)

    wanted: list[tuple[object, ...]] = [
        ("Text", [56, 106], "angle [rad]", 11, muted, 0.0),
        ("Text", [214, 106], "valve of 80", 11, muted, 0.0),
    ]
    for i, name in enumerate(BROKK_170.names):
        y, colour = 126 + 22 * i, muted if i == 1 else warning if i == 2 else ink
        wanted += [("Text", [10, y], name, 13, colour, 0.0), bar(56, 156, y, 2, track)]
        if i < 4:
            at = 156 if i == 2 else 81
            wanted += [
                bar(at - 3, at + 3, y, 8, colour),
                ("Text", [164, y], f"{q[i]:+.2f}", 12, colour, 0.0),
            ]
        if i == 1:
            wanted += [("Text", [214, y], "locked", 12, muted, 0.0)]
            continue
        counts = round(127 * u[i])
        wanted += [bar(214, 314, y, 6, track)]
        wanted += [bar(264, 264 + 50 * counts / 80, y, 6, [1, 2, 3])] if counts else []
        wanted += [bar(263, 265, y, 8, ink), ("Text", [354, y], f"{counts:+d}", 12, ink, 1.0)]
    assert shapes == wanted


def test_arrows_rings_and_pale_colours_by_hand() -> None:
    shaft, head = listed(view._arrow(np.array([0.0, 0]), np.array([30.0, 40]), (1, 2, 3)))
    assert shaft == ("Line", [[0, 0], [23.4, 31.2]], [1, 2, 3], 3)  # a head of 11 px of 50
    assert head == ("Polygon", [[30, 40], [19.44, 34.17], [27.36, 28.23]], [1, 2, 3])
    short = listed(view._arrow(np.array([0.0, 0]), np.array([5.0, 0]), (1, 2, 3)))
    assert (
        short[0][1] == [[0, 0], [1.5, 0]]
        and view._arrow(np.zeros(2), np.array([4.0, 0]), (1, 2, 3)) == []
    )
    ring = view._ring(np.array([5.0, 7.0]), 2.0)
    np.testing.assert_allclose(ring[[0, 6, 12, 24]], [[7, 7], [5, 9], [3, 7], [7, 7]], atol=1e-12)
    assert (
        view._pale((50, 100, 247)) == (140, 168, 247) and view._pale((250, 0, 0), 1.0) == view.PAPER
    )


def test_where_things_are_on_a_wide_and_on_a_tall_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: dict[str, tuple[object, ...]] = {}
    monkeypatch.setattr(
        view, "_views", lambda machine, scene, *boxes: asked.update(views=boxes) or []
    )
    monkeypatch.setattr(view, "_rows", lambda machine, scene, box: asked.update(rows=box) or [])
    seen = scene(
        title="a title", status="going", mood="ready", colour=(1, 2, 3), notes=["one", "two"]
    )

    def heading(left: float, width: float) -> list[tuple[object, ...]]:
        title = ("Text", [left + 36, 21], "a title", 18, list(view.INK), 0.0)
        status = (
            "Text",
            [left + width - 16, 21],
            "going",
            14,
            list(view.STATUS_COLOURS["ready"]),
            1.0,
        )
        return [("Circle", [left + 22, 21], 7, [1, 2, 3]), title, status]

    def notes(x: float, y: float) -> list[tuple[object, ...]]:
        said = enumerate(("one", "two"))
        return [("Text", [x, y + 18 * i], text, 12, list(view.INK), 0.0) for i, text in said]

    wide = listed(
        view._panel(BROKK_170, seen, (100.0, 0.0, 1000.0, 600.0))
    )  # 136 px below for five joints
    assert asked["views"] == ((100, 40, 600, 424), (700, 40, 400, 424))
    assert asked["rows"] == (116, 470, 520, 136) and wide == heading(100, 1000) + notes(656, 478)
    tall = listed(view._panel(BROKK_170, seen, (0.0, 0.0, 500.0, 800.0)))
    assert asked["views"] == ((0, 40, 500, 440), (0, 480, 190, 320))
    assert asked["rows"] == (198, 486, 294, 320) and tall == heading(0, 500) + notes(16, 74)
    many = seen._replace(notes=["n"] * 10)
    view._panel(BROKK_170, many, (0.0, 0.0, 1000.0, 600.0))
    assert asked["rows"] == (16, 420, 520, 186)
    unknown = listed(
        view._panel(BROKK_170, seen._replace(q=np.full(5, np.nan)), (0.0, 0.0, 1000.0, 600.0))
    )
    assert unknown[3] == ("Text", [500, 252], "no positions", 20, list(view.WARNING), 0.5)
    long = listed(view._heading(seen._replace(title="x" * 40), (0.0, 0.0, 500.0, 0.0)))
    assert long[1][3] == int((500 - 60 - 45) / 28)
    two = listed(view.draw(BROKK_170, [seen, seen], (800, 300)))
    assert two.count(("Line", [[400, 12], [400, 288]], list(view.TRACK), 2)) == 1
