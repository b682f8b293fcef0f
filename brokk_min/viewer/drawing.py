"""Pictures of a machine: two views, angles and valves of its joints, goal and measured velocity.

Nothing but kinematics is used, so any `Machine` can be drawn, as links between its joints.
Everything is drawn twice as large and then scaled down, so that edges are smooth: lengths are half
pixels, and y points down.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from matplotlib import get_data_path
from numpy.typing import ArrayLike
from PIL import Image, ImageDraw, ImageFont

from brokk_min.kinematics import forward_kinematics, tool_position
from brokk_min.machine import PWM_MAX, Array, Machine

Pen = ImageDraw.ImageDraw
BACKGROUND, INK, MUTED = (250, 250, 247), (33, 37, 43), (120, 128, 138)
GRID, SLOT, SOIL = (228, 230, 232), (212, 216, 221), (214, 203, 186)
BLUE, MEASURED = (0, 114, 178), (0, 158, 115)
HEAD, ROW = 72, 40  # heights of the title and of a joint's row
ABOVE = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])  # right and up of the top view


class Scene(NamedTuple):
    """What a picture shows; vectors are in the base frame."""

    q: Array  # angles [rad], (n,)
    u: Array  # commands [-1, 1], (n,)
    v_goal: Array  # goal velocity of the tool [m/s], (3,)
    v_tool: Array  # measured velocity of the tool [m/s], (3,)
    trail: Array = np.zeros((0, 3))  # past tool positions [m], (T, 3)
    title: str = ""
    status: str = ""
    notes: str = ""  # lines in the side view


def draw(machine: Machine, scene: Scene, size: tuple[int, int]) -> Image.Image:
    """The scene as an image of this width and height."""
    image = Image.new("RGB", (2 * size[0], 2 * size[1]), BACKGROUND)
    for view in views(machine, scene.q, image.size):
        part = Image.new("RGB", view.size, BACKGROUND)
        pen = ImageDraw.Draw(part)
        _backdrop(pen, machine, view)
        _arm_and_tool(pen, machine, view, scene)
        image.paste(part, view.corner)
    pen = ImageDraw.Draw(image)
    pen.text((28, HEAD / 2), scene.title, INK, _font(30), "lm")
    pen.text((image.width - 28, HEAD / 2), scene.status, MUTED, _font(26), "rm")
    pen.text((28, HEAD + 50), scene.notes, INK, _font(26), spacing=14)
    for i in range(machine.n):
        _joint_row(pen, machine, scene, i, image.size)
    return image.reduce(2)


@lru_cache
def _font(size: int) -> ImageFont.FreeTypeFont:
    """The typeface that matplotlib brings, which is the same everywhere."""
    return ImageFont.truetype(f"{get_data_path()}/fonts/ttf/DejaVuSans.ttf", size)


class View(NamedTuple):
    """An orthographic view of the machine, a picture of its own."""

    label: str
    corner: tuple[int, int]  # upper left, in the whole picture
    size: tuple[int, int]
    origin: Array  # of the base frame, in this picture, (2,)
    scale: float  # half pixels a metre
    axes: Array  # directions right and up, (2, 3)

    def project(self, p: ArrayLike) -> Array:
        """Points (..., 3) [m] in the picture (..., 2)."""
        return np.asarray(self.origin + self.scale * (np.asarray(p) @ self.axes.T) * (1, -1))


def views(machine: Machine, q: Array, size: tuple[int, int]) -> list[View]:
    """From the side, in the vertical plane of the tool, and from above, with x up and y left."""
    reach, low, high = extent(machine)
    width, height = round(0.6 * size[0]), size[1] - HEAD - round(ROW * (machine.n + 0.5))
    x, y, _ = tool_position(forward_kinematics(machine, q))
    heading = np.arctan2(y, x)
    out_and_up = np.array([[np.cos(heading), np.sin(heading), 0.0], [0.0, 0.0, 1.0]])
    scale = min(0.7 * width / reach, 0.85 * height / (high - low))
    origin = np.array([0.25 * width, 0.92 * height + scale * low])
    side = View("side view", (0, HEAD), (width, height), origin, scale, out_and_up)
    rest = size[0] - width
    scale, middle = min(rest, height) / (2.1 * reach), np.array([rest / 2, height / 2])
    return [side, View("top view", (width, HEAD), (rest, height), middle, scale, ABOVE)]


@lru_cache
def extent(machine: Machine) -> tuple[float, float, float]:
    """Largest distance from the slew axis, and least (on the ground) and largest height [m]."""
    low, high = machine.column("q_min"), machine.column("q_max")
    q = np.random.default_rng(0).uniform(low, high, (2000, machine.n))
    x, y, z = np.moveaxis(forward_kinematics(machine, q).p, -1, 0)
    reach, lowest = float(np.hypot(x, y).max()) + 1e-3, max(float(z.min()), machine.ground)
    return reach, lowest, max(float(z.max()), lowest + 0.2 * reach)


def _backdrop(pen: Pen, machine: Machine, view: View) -> None:
    """A grid of 1 m, and the ground in the side view."""
    (width, height), (x0, y0) = view.size, view.origin
    for x in np.arange(x0 % view.scale, width, view.scale):
        pen.line((x, 0, x, height), GRID, 2)
    for y in np.arange(y0 % view.scale, height, view.scale):
        pen.line((0, y, width, y), GRID, 2)
    if view.axes is not ABOVE:
        ground = min(y0 - view.scale * machine.ground, height)
        pen.rectangle((0, ground, width, height), SOIL)
    pen.text((16, 20), f"{view.label}, grid of 1 m", MUTED, _font(22), "lm")


def _arm_and_tool(pen: Pen, machine: Machine, view: View, scene: Scene) -> None:
    """Links from the base frame's origin on, joints, the tool's trail, arrows of its velocities."""
    ends = view.project(forward_kinematics(machine, scene.q).p)
    radius = max(6.0, 0.02 * extent(machine)[0] * view.scale)
    pen.line(ends.ravel().tolist(), BLUE, round(2 * radius))
    for end in ends[:-1]:
        pen.regular_polygon((*end, radius), 24, fill=INK)
        pen.regular_polygon((*end, 0.5 * radius), 24, fill=BACKGROUND)
    pen.line(view.project(scene.trail).ravel().tolist(), BLUE, 5)
    pen.regular_polygon((*ends[-1], 8), 24, fill=INK)
    scale = 0.2 * min(view.size) / machine.tool_speed
    arrows = ((52, "measured", scene.v_tool, MEASURED), (20, "goal", scene.v_goal, INK))
    for y, name, v, colour in arrows:
        if view.axes is not ABOVE:
            text = f"{name} {np.linalg.norm(v):.2f} m/s"
            pen.text((view.size[0] - 20, y), text, colour, _font(24), "rm")
        along = scale * (view.axes @ v) * (1, -1)
        if (length := float(np.hypot(*along))) > 8:
            head = min(22.0, 0.7 * length) * along / length
            barb, neck = 0.45 * head[::-1] * (-1, 1), ends[-1] + along - head
            pen.line([*ends[-1], *neck], colour, 6)
            pen.polygon([*neck + head, *neck + barb, *neck - barb], colour)


def _joint_row(pen: Pen, machine: Machine, scene: Scene, i: int, size: tuple[int, int]) -> None:
    """The angle of joint i within its range, and its command within the limit."""
    joint, q, counts = machine.joints[i], float(scene.q[i]), float(scene.u[i]) * PWM_MAX
    y = size[1] - ROW * (machine.n - i - 0.25)
    left = 40 + 18 * max(map(len, machine.names))
    length = (size[0] - left - 340) / 2  # of a bar, beside the digits
    valve = left + length + 160
    colour = INK if joint.driven else MUTED
    at = left + length * (q - joint.q_min) / (joint.q_max - joint.q_min)
    pen.line((left, y, left + length, y), SLOT, 8)
    pen.line((at, y - 14, at, y + 14), colour, 12)
    middle, deflection = valve + length / 2, counts / machine.pwm_limit * length / 2
    pen.line((valve, y, valve + length, y), SLOT, 24)
    pen.line((middle, y, middle + deflection, y), BLUE, 24)
    pen.line((middle, y - 16, middle, y + 16), colour, 4)
    angle = f"{q:+z.2f} rad" if joint.kind == "revolute" else f"{q:+z.2f} m"
    command = f"{round(counts):+d} of {machine.pwm_limit}" if joint.driven else "locked"
    for x, text in ((28, joint.name), (left + length + 16, angle), (valve + length + 16, command)):
        pen.text((x, y), text, colour, _font(24), "lm")
