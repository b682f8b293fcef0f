"""Pictures of a machine: two views, angles and valves of its joints, goal and measured velocity.

Nothing but kinematics is used, so any `Machine` can be drawn. Joints and links are where the
machine has them; tracks, turret and the widths of links are generic. Lengths in pictures are
pixels, and y points down.
"""

import os
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from matplotlib import get_data_path
from numpy.typing import ArrayLike, NDArray

from brokk_min._files import require_package
from brokk_min.kinematics import forward_kinematics, tool_position
from brokk_min.machine import PWM_MAX, Array, Machine

Colour = tuple[int, int, int]
BACKGROUND, INK, MUTED = (250, 250, 247), (33, 37, 43), (120, 128, 138)
GRID, SLOT, SOIL, STEEL = (228, 230, 232), (212, 216, 221), (214, 203, 186), (74, 80, 88)
WARNING, MEASURED = (208, 28, 28), (0, 158, 115)
BLUE, ORANGE = (0, 114, 178), (213, 94, 0)  # of the machine under the policy, under the PID
HEAD, ROW = 36.0, 20.0  # heights of the title and of a joint's row
NEAR_LIMIT = 0.05  # of its range: a joint nearer to an end is red
NO_POINTS = np.zeros((0, 3))
ABOVE = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])  # right and up of the top view
# Outlines of links: how far along the link, and half the width there. The last is the breaker.
BOOM = np.array([[0, 1.0], [0.3, 1.2], [1, 0.7]])
BREAKER = np.array([[0, 0.6], [0.1, 1.3], [0.6, 1.3], [0.66, 0.5], [0.93, 0.35], [1, 0.05]])
CIRCLE = np.exp(2j * np.pi * np.arange(24)[:, None] / 24).view(float)  # corners (x, y)
# The outline (x, y, z) of a track, in reaches of the arm.
TRACK = np.insert(0.035 * CIRCLE, 1, 0.0, axis=1) + 0.035 * np.eye(3)[2]
TRACK[:, 0] += 0.115 * np.sign(CIRCLE[:, 0])


class Scene(NamedTuple):
    """What a picture shows; vectors are in the base frame."""

    q: Array  # angles [rad], (n,)
    u: Array  # commands [-1, 1], (n,)
    v_goal: Array  # goal velocity of the tool [m/s], (3,)
    v_tool: Array  # measured velocity of the tool [m/s], (3,)
    trail: Array = NO_POINTS  # past tool positions [m], (T, 3)
    title: str = ""
    status: str = ""
    colour: Colour = BLUE
    notes: Sequence[str] = ()


def picture(
    machine: Machine,
    q: Array,
    u: Array,
    v_goal: Array,
    v_tool: Array,
    size: tuple[int, int] = (640, 360),
) -> NDArray[np.uint8]:
    """A machine as an image (height, width, 3); the arguments are those of `Scene`."""
    return image(draw(machine, Scene(q, u, v_goal, v_tool, title=machine.name), size))


def image(surface: Any) -> NDArray[np.uint8]:
    """A pygame surface as an image (height, width, 3)."""
    pixels: NDArray[np.uint8] = load_pygame().surfarray.array3d(surface)
    return np.ascontiguousarray(pixels.swapaxes(0, 1))


def draw(machine: Machine, scene: Scene, size: tuple[int, int]) -> Any:
    """The scene as a pygame surface of this width and height, without a display."""
    canvas = Canvas(size)
    for view in views(machine, scene.q, size):
        canvas.large.set_clip([round(2 * edge) for edge in view.box])
        _backdrop(canvas, machine, view)
        _base(canvas, machine, view, scene)
        _arm(canvas, machine, view, scene)
        _tool(canvas, machine, view, scene)
    canvas.large.set_clip(None)
    _captions(canvas, machine, scene)
    for i in range(machine.n):
        _joint_row(canvas, machine, scene, i)
    return canvas.pygame.transform.smoothscale(canvas.large, size)


def load_pygame() -> Any:
    """The module pygame; ValueError: it is not installed."""
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    return require_package("pygame", "play")


class Canvas:
    """A surface of twice the size, which is scaled down in the end so that edges are smooth."""

    def __init__(self, size: tuple[int, int]) -> None:
        self.size = size
        self.pygame = load_pygame()
        self.large = self.pygame.Surface((2 * size[0], 2 * size[1]), depth=32)
        self.large.fill(BACKGROUND)

    def polygon(self, points: Array, colour: Colour) -> None:
        """A filled polygon with corners (K, 2)."""
        self.pygame.draw.polygon(self.large, colour, (2 * points).tolist())

    def line(self, points: Array, colour: Colour, width: float) -> None:
        """A line through points (K, 2)."""
        self.pygame.draw.lines(self.large, colour, False, (2 * points).tolist(), round(2 * width))

    def bar(self, left: float, top: float, width: float, height: float, colour: Colour) -> None:
        """A filled rectangle."""
        edges = np.rint([2 * left, 2 * top, 2 * (left + width), 2 * (top + height)])
        self.large.fill(colour, (*edges[:2], *(edges[2:] - edges[:2])))

    def text(
        self, x: float, y: float, text: str, size: int, colour: Colour = INK, anchor: float = 0.0
    ) -> None:
        """Text at half its height; `anchor` 0 puts its left end at x, 1 its right end."""
        word = _font(2 * size).render(text, True, colour)
        self.large.blit(word, (2 * x - anchor * word.get_width(), 2 * y - word.get_height() / 2))


@lru_cache
def _font(size: int) -> Any:
    """The typeface that matplotlib brings, which is the same everywhere."""
    load_pygame().font.init()
    return load_pygame().font.Font(f"{get_data_path()}/fonts/ttf/DejaVuSans.ttf", size)


class View(NamedTuple):
    """An orthographic view of the machine."""

    label: str
    box: tuple[float, float, float, float]  # its part of the picture: left, top, width, height
    origin: Array  # pixel of the base frame's origin, (2,)
    scale: float  # pixels a metre
    axes: Array  # directions right and up, (2, 3)

    def project(self, p: ArrayLike) -> Array:
        """Pixels (..., 2) of points (..., 3) [m]."""
        return np.asarray(self.origin + self.scale * (np.asarray(p) @ self.axes.T) * (1, -1))


def views(machine: Machine, q: Array, size: tuple[int, int]) -> list[View]:
    """From the side, in the vertical plane of the tool, and from above, with x up and y left."""
    reach, low, high = extent(machine)
    width, height = 0.6 * size[0], size[1] - HEAD - foot(machine)
    x, y, _ = tool_position(forward_kinematics(machine, q))
    heading = np.arctan2(y, x)
    out_and_up = np.array([[np.cos(heading), np.sin(heading), 0.0], [0.0, 0.0, 1.0]])
    scale = min(0.7 * width / reach, 0.85 * height / (high - low))
    origin = np.array([0.25 * width, HEAD + 0.92 * height + scale * low])
    side = View("side view", (0.0, HEAD, width, height), origin, scale, out_and_up)
    scale = min(size[0] - width, height) / (2.1 * reach)
    middle = np.array([(size[0] + width) / 2, HEAD + height / 2])
    return [side, View("top view", (width, HEAD, size[0] - width, height), middle, scale, ABOVE)]


def foot(machine: Machine) -> float:
    """Height of the rows of all joints, or of five notes, below the views."""
    return ROW * (max(machine.n, 5) + 0.7)


@lru_cache
def extent(machine: Machine) -> tuple[float, float, float]:
    """Largest distance from the slew axis, and least (on the ground) and largest height [m]."""
    low, high = machine.column("q_min"), machine.column("q_max")
    q = np.random.default_rng(0).uniform(low, high, (2000, machine.n))
    x, y, z = np.moveaxis(forward_kinematics(machine, q).p, -1, 0)
    reach, lowest = float(np.hypot(x, y).max()) + 1e-3, max(float(z.min()), machine.ground)
    return reach, lowest, max(float(z.max()), lowest + 0.2 * reach)


def _backdrop(canvas: Canvas, machine: Machine, view: View) -> None:
    """A grid of 1 m, and the ground in the side view."""
    left, top, width, height = view.box
    x0, y0 = view.origin
    for x in np.arange(left + (x0 - left) % view.scale, left + width, view.scale):
        canvas.bar(x, top, 1, height, GRID)
    for y in np.arange(top + (y0 - top) % view.scale, top + height, view.scale):
        canvas.bar(left, y, width, 1, GRID)
    if view.axes is not ABOVE:
        canvas.bar(left, y0 - view.scale * machine.ground, width, height, SOIL)
    canvas.text(left + 8, top + 10, f"{view.label}, grid of 1 m", 11, MUTED)


def _base(canvas: Canvas, machine: Machine, view: View, scene: Scene) -> None:
    """Tracks along x, and over them the turret, which turns with q_1."""
    first, reach = machine.joints[0], extent(machine)[0]
    ground = machine.ground / reach
    low, front, high = ground + 0.06, max(first.a / reach, 0.03), max(first.d / reach, 0.1)
    turret = np.array([[-0.12, 0, low], [front, 0, low], [front, 0, high], [-0.12, 0, high]])
    c, s = np.cos(scene.q[0] + first.theta), np.sin(scene.q[0] + first.theta)
    turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    tracks = [TRACK + np.array([0, y, ground]) for y in (-0.075, 0.075)]
    prisms = [(track, 0.02, np.eye(3), STEEL) for track in tracks]
    prisms += [(turret, 0.055, turn, INK)]
    for outline, half, matrix, colour in prisms:
        faces = outline + half * np.array([[[0, -1, 0]], [[0, 1, 0]]])
        near, far = view.project(reach * faces @ matrix)
        for k in range(len(near)):
            canvas.polygon(np.array([near[k - 1], near[k], far[k], far[k - 1]]), colour)
        canvas.polygon(near, colour)
        canvas.polygon(far, colour)


def _arm(canvas: Canvas, machine: Machine, view: View, scene: Scene) -> None:
    """Links, of which the last one is a breaker, and joints, red near a limit."""
    ends = view.project(forward_kinematics(machine, scene.q).p)
    sizes = 0.03 * extent(machine)[0] * view.scale * np.linspace(1.0, 0.5, machine.n)
    for i in range(1, machine.n):
        along = ends[i + 1] - ends[i]
        across = sizes[i] * along[::-1] * (-1, 1) / max(float(np.hypot(*along)), 1e-9)
        part = BREAKER if i == machine.n - 1 else BOOM
        middle, wide = ends[i] + part[:, :1] * along, part[:, 1:] * across
        outline = np.vstack([middle + wide, (middle - wide)[::-1]])
        canvas.polygon(outline, scene.colour)
        canvas.line(np.vstack([outline, outline[:1]]), INK, 0.5)
        radius, warned = max(3.0, 0.6 * float(sizes[i])), near_limit(machine, scene.q)[i]
        canvas.polygon(ends[i] + 1.2 * radius * CIRCLE, WARNING if warned else INK)
        canvas.polygon(ends[i] + 0.5 * radius * CIRCLE, BACKGROUND)


def _tool(canvas: Canvas, machine: Machine, view: View, scene: Scene) -> None:
    """The trail of the tool, and the arrows of its velocities."""
    tip = view.project(tool_position(forward_kinematics(machine, scene.q)))
    if len(scene.trail) > 1:
        canvas.line(view.project(scene.trail), scene.colour, 2.5)
    canvas.polygon(tip + 4 * CIRCLE, INK)
    scale = 0.2 * min(view.box[2:]) / machine.tool_speed
    for v, colour in ((scene.v_tool, MEASURED), (scene.v_goal, INK)):
        along = scale * (view.axes @ v) * (1, -1)
        if (length := float(np.hypot(*along))) > 4:
            head = min(11.0, 0.7 * length) * along / length
            barb = 0.45 * head[::-1] * (-1, 1)
            neck = tip + along - head
            canvas.line(np.array([tip, neck]), colour, 3)
            canvas.polygon(np.array([tip + along, neck + barb, neck - barb]), colour)


def near_limit(machine: Machine, q: Array) -> NDArray[np.bool_]:
    """Is each driven joint within `NEAR_LIMIT` of an end of its range? (n,)"""
    low, high = machine.column("q_min"), machine.column("q_max")
    driven = np.isin(np.arange(machine.n), machine.driven)
    fraction = (q - low) / (high - low)
    return np.asarray(((fraction < NEAR_LIMIT) | (fraction > 1 - NEAR_LIMIT)) & driven)


def _captions(canvas: Canvas, machine: Machine, scene: Scene) -> None:
    """Title, status, the meaning of the arrows, and notes beside the rows of the joints."""
    width, height = canvas.size
    canvas.polygon((18, HEAD / 2) + 6 * CIRCLE, scene.colour)
    canvas.text(30, HEAD / 2, scene.title, 15)
    canvas.text(width - 14, HEAD / 2, scene.status, 13, MUTED, 1.0)
    for y, name, v in ((10, "goal", scene.v_goal), (26, "measured", scene.v_tool)):
        text, colour = f"{name} {np.linalg.norm(v):.2f} m/s", MEASURED if y > 10 else INK
        canvas.text(0.6 * width - 10, HEAD + y, text, 12, colour, 1.0)
    for i, note in enumerate(scene.notes):
        canvas.text(0.58 * width, height - foot(machine) + ROW * (0.75 + i), note, 12)


def _joint_row(canvas: Canvas, machine: Machine, scene: Scene, i: int) -> None:
    """The angle of joint i within its range, and its command within the limit."""
    joint, q = machine.joints[i], float(scene.q[i])
    y = canvas.size[1] - foot(machine) + ROW * (i + 0.75)
    left = 20.0 + 9 * max(map(len, machine.names))
    length = (0.54 * canvas.size[0] - left - 160) / 2  # of a bar, beside the digits
    colour = WARNING if near_limit(machine, scene.q)[i] else INK if joint.driven else MUTED
    unit = "rad" if joint.kind == "revolute" else "m"
    canvas.text(14, y, joint.name, 12, colour)
    at = left + length * (q - joint.q_min) / (joint.q_max - joint.q_min)
    canvas.bar(left, y - 2, length, 4, SLOT)
    canvas.bar(at - 3, y - 7, 6, 14, colour)
    canvas.text(left + length + 8, y, f"{q:+z.2f} {unit}", 12, colour)
    valve, counts = left + length + 80, float(scene.u[i]) * PWM_MAX
    if not joint.driven:
        canvas.text(valve, y, "locked", 12, MUTED)
        return
    middle, end = valve + length / 2, counts / machine.pwm_limit * length / 2
    canvas.bar(valve, y - 6, length, 12, SLOT)
    canvas.bar(middle + min(0, end), y - 6, abs(end), 12, scene.colour)
    canvas.bar(middle - 1, y - 8, 2, 16, INK)
    canvas.text(valve + length + 8, y, f"{round(counts):+d} of {machine.pwm_limit}", 12)
