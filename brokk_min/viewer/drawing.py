"""Pictures of arms: a pure function from machines and what they do to shapes.

`draw` knows kinematics and nothing of physics, control or buses; any `Machine` can be drawn. Coordinates of
shapes are pixels, y down; `window` paints them.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brokk_min.kinematics import forward_kinematics, jacobian, tool_position, tool_velocity
from brokk_min.machine import PWM_MAX, Array, Machine

Colour = tuple[int, int, int]
Box = tuple[float, float, float, float]  # left, top, width, height [px]
ABOVE = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])  # right and up as seen from above

# all assumed
NEAR_LIMIT = 0.05  # of a joint's range: nearer to its end is a warning
NEAR_SINGULAR = (
    0.1  # of the arm's length [1/rad]: the tool hardly moves some way below it, see `weakest`
)
MARGIN = 0.06  # of the reach: what is seen around the points that a scene holds
ARROW = 0.2  # of a view's smaller side: an arrow of the machine's tool speed

PAPER, INK, MUTED = (250, 250, 247), (33, 37, 43), (120, 128, 138)
GRID, TRACK = (228, 230, 232), (212, 216, 221)
SOIL, STEEL, WARNING = (214, 203, 186), (74, 80, 88), (208, 28, 28)
WANTED, MEASURED, PATH = INK, (0, 158, 115), (230, 159, 0)
COLOURS: dict[str, Colour] = {
    "rl": (0, 114, 178),
    "jacobian": (213, 94, 0),
    "levers": (124, 87, 148),
}
STATUS_COLOURS: dict[str, Colour] = {
    "driving": (0, 130, 90),
    "ready": (0, 100, 170),
    "waiting": WARNING,
    "": MUTED,
}
TITLES = {
    "rl": "RL policy",
    "jacobian": "Jacobian + PID",
    "levers": "levers, joint by joint",
    "jacobian_pid_k0.1": "Jacobian + PID",
    "jacobian_pid_ff": "Jacobian + PID with feed-forward",
    "jacobian_pid_ff_awake": "the same, valves kept open",
}


class Line(NamedTuple):
    """A line through points (k, 2)."""

    points: Array
    colour: Colour
    width: int = 1


class Polygon(NamedTuple):
    """A filled polygon with corners (k, 2)."""

    points: Array
    colour: Colour


class Circle(NamedTuple):
    """A filled circle."""

    centre: Array
    radius: float
    colour: Colour


class Text(NamedTuple):
    """Text; `anchor` 0 puts its left end at `at`, 1 its right end, both at half its height."""

    at: tuple[float, float]
    text: str
    size: int = 13
    colour: Colour = INK
    anchor: float = 0.0


class Clip(NamedTuple):
    """What follows is seen within this box only, but for text."""

    box: Box


Shape = Line | Polygon | Circle | Text | Clip


class Scene(NamedTuple):
    """What is to be seen of one arm, base frame."""

    q: Array  # angles [rad] (n,); nan where unknown
    q_dot: Array  # rates [rad/s] (n,)
    u: Array  # commands in force, in [-1, 1] (n,)
    v_goal: Array  # wanted tool velocity [m/s] (3,)
    trail: Array = np.zeros((0, 3))  # where the tool was [m] (T, 3)
    path: Array = np.zeros((0, 3))  # where it is to go [m] (K, 3)
    target: Array = np.zeros((0, 3))  # where on that to go next [m], (1, 3) or none
    title: str = ""
    status: str = ""
    mood: str = ""  # of `STATUS_COLOURS`, colour of the status
    colour: Colour = COLOURS["rl"]
    notes: Sequence[str] = ()
    hold: Array = np.zeros(
        (0, 3)
    )  # what the views must show [m] (K, 3); none: all that the arm reaches


def draw(machine: Machine, scenes: Sequence[Scene], size: tuple[int, int]) -> list[Shape]:
    """Shapes of one or several arms side by side on `size` pixels: views, arrows, valves, warnings."""
    width = size[0] / len(scenes)
    shapes: list[Shape] = []
    for i, scene in enumerate(scenes):
        shapes += _panel(machine, scene, (i * width, 0.0, width, float(size[1])))
        if i:
            shapes.append(Line(np.array([[i * width, 12], [i * width, size[1] - 12]]), TRACK, 2))
    return shapes


def _panel(machine: Machine, scene: Scene, box: Box) -> list[Shape]:
    """One arm: title and state above, both views, a row for each joint, notes."""
    left, _, width, height = box
    head, foot, wide = 40.0, 26.0 + 22 * machine.n, width > 1.3 * height
    if wide:
        foot = max(foot, 6.0 + 18 * len(scene.notes))
        upper, share, middle = height - foot, 0.6 * width, height - head - foot
        side, top = (left, head, share, middle), (left + share, head, width - share, middle)
        rows, notes = (
            (left + 16, upper + 6, 0.52 * width, foot),
            (left + 0.52 * width + 36, upper + 14),
        )
    else:
        foot = max(foot, 0.4 * height)
        upper, share = height - foot, 0.38 * width
        side, top = (left, head, width, upper - head), (left, upper, share, foot)
        rows, notes = (
            (left + share + 8, upper + 6, width - share - 16, foot),
            (left + 16, head + 34),
        )
    shapes = _heading(scene, box)
    if np.isfinite(scene.q).all():
        shapes += _views(machine, scene, side, top)
    else:
        shapes.append(
            Text((left + width / 2, (head + upper) / 2), "no positions", 20, WARNING, 0.5)
        )
    shapes += _rows(machine, scene, rows)
    return shapes + [
        Text((notes[0], notes[1] + 18 * i), note, 12) for i, note in enumerate(scene.notes)
    ]


def _heading(scene: Scene, box: Box) -> list[Shape]:
    left, _, width, _ = box
    room = (
        width - 60 - 9 * len(scene.status)
    )  # px that the status leaves; letters are 0.7 of their size wide
    size = int(np.clip(room / (0.7 * max(1, len(scene.title))), 8, 18))
    return [
        Circle(np.array([left + 22.0, 21.0]), 7, scene.colour),
        Text((left + 36, 21), scene.title, size, INK),
        Text((left + width - 16, 21), scene.status, 14, STATUS_COLOURS[scene.mood], 1.0),
    ]


def _views(machine: Machine, scene: Scene, side: Box, top: Box) -> list[Shape]:
    frames = forward_kinematics(machine, scene.q)
    p_tool, v_tool = tool_position(frames), tool_velocity(frames, scene.q_dot)
    low, weak = near_limit(machine, scene.q), near_singular(machine, scene.q)
    shapes: list[Shape] = []
    eyes = cameras(machine, p_tool, side, top, scene.hold)
    for camera, box, label in zip(eyes, (side, top), ("side", "top"), strict=True):
        shapes += [Clip(box), *_backdrop(machine, camera, box, label)]
        shapes += _arm(machine, camera, scene, low)
        for points, colour, width in ((scene.path, PATH, 3), (scene.trail, _pale(scene.colour), 2)):
            if len(points) > 1:
                shapes.append(Line(camera.project(points), colour, width))
        shapes += [Line(_ring(camera.project(p), 9.0), PATH, 3) for p in scene.target]
        tip = camera.project(p_tool)
        shapes.append(Circle(tip, 4.0, INK))
        if weak:
            shapes.append(Line(_ring(tip, 15.0), WARNING, 2))
        for v, colour in ((v_tool, MEASURED), (scene.v_goal, WANTED)):
            pixels = ARROW * min(box[2:]) / machine.tool_speed * (camera.axes @ v) * (1, -1)
            shapes += _arrow(tip, tip + pixels, colour)
    fast, asked = (float(np.linalg.norm(v)) for v in (v_tool, scene.v_goal))
    words = [(f"wanted {asked:.2f} m/s", WANTED), (f"measured {fast:.2f} m/s", MEASURED)]
    words += [(f"{machine.names[i]} near its limit", WARNING) for i in np.flatnonzero(low)]
    words += [("near a singularity", WARNING)] * weak
    x, y = side[0] + side[2] - 14, side[1] + 14
    shapes += [
        Text((x, y + 18 * i), word, 12, colour, 1.0) for i, (word, colour) in enumerate(words)
    ]
    return [*shapes, Clip((0.0, 0.0, 1e4, 1e4))]


def _backdrop(machine: Machine, camera: Camera, box: Box, label: str) -> list[Shape]:
    """Grid of 1 m (10 m for large machines), the ground, and what the view is."""
    left, upper, width, height = box
    right, lower, ox, oy = (
        left + width,
        upper + height,
        float(camera.origin[0]),
        float(camera.origin[1]),
    )
    step = camera.scale * next(m for m in 10.0 ** np.arange(-1, 20) if m * camera.scale > 12)
    shapes: list[Shape] = []
    for x in ox + step * np.arange(np.ceil((left - ox) / step), (right - ox) // step + 1):
        shapes.append(Line(np.array([[x, upper + 1], [x, lower]]), GRID))
    for y in oy + step * np.arange(np.ceil((upper - oy) / step), (lower - oy) // step + 1):
        shapes.append(Line(np.array([[left, y], [right, y]]), GRID))
    level = oy - camera.scale * machine.ground
    if label == "side" and level < lower:
        corners = np.array([[left, level], [right, level], [right, lower], [left, lower]])
        shapes += [Polygon(corners, SOIL), Line(corners[:2], STEEL, 2)]
    metres = f"{step / camera.scale:g} m"
    shapes.append(Text((left + 14, upper + 14), f"{label} view, grid {metres}", 11, MUTED))
    return shapes


def _arm(machine: Machine, camera: Camera, scene: Scene, low: NDArray[np.bool_]) -> list[Shape]:
    """Links that grow thinner towards the tool, joints at their frames; near a limit red and larger."""
    corners = camera.project(skeleton(machine, scene.q))
    thick = min(30.0, max(3.0, 0.032 * extent(machine).reach * camera.scale))
    sizes = np.linspace(thick, 0.45 * thick, 2 * machine.n + 1)
    sizes[-1] = 0.12 * thick
    base = camera.origin + thick * np.array([[-2.0, -0.9], [2.0, -0.9], [2.3, 0.0], [-2.3, 0.0]])
    if camera.axes[1, 2] == 0:  # from above
        base = camera.origin + thick * np.array(
            [[-1.8, -2.4], [1.8, -2.4], [1.8, 2.4], [-1.8, 2.4]]
        )
    shapes: list[Shape] = [Polygon(base, STEEL)]
    for i in range(2 * machine.n):
        along = corners[i + 1] - corners[i]
        length = float(np.hypot(*along))
        if length > 0.5:
            across = np.array([-along[1], along[0]]) / length
            ends = [corners[i] + sizes[i] * across, corners[i + 1] + sizes[i + 1] * across]
            ends += [corners[i + 1] - sizes[i + 1] * across, corners[i] - sizes[i] * across]
            shapes.append(Polygon(np.array(ends), scene.colour if i > 0 else STEEL))
    for i in range(machine.n):
        size = max(4.0, float(sizes[2 * i]))
        ring, colour = (1.5, WARNING) if low[i] else (1.1, _pale(scene.colour, 0.15))
        shapes.append(Circle(corners[2 * i], ring * size, colour))
        shapes.append(Circle(corners[2 * i], 0.5 * size, PAPER))
    return shapes


def _rows(machine: Machine, scene: Scene, box: Box) -> list[Shape]:
    """A row for each joint: name, angle on its range, command on the valve's."""
    left, upper, width, _ = box
    name = max(46.0, 9.0 * max(map(len, machine.names)))
    track = (width - name - 58 - 40) / 2  # 58 px for the angle in digits, 40 px for the command
    ends = left + name + np.array([0, track, track + 58, 2 * track + 58])
    low, high = machine.column("q_min"), machine.column("q_max")
    warned = near_limit(machine, scene.q)
    shapes: list[Shape] = [
        Text((ends[0], upper + 6), "angle [rad]", 11, MUTED),
        Text(
            (min(ends[2], left + width - 66), upper + 6), f"valve of {machine.pwm_limit}", 11, MUTED
        ),
    ]
    for i, joint in enumerate(machine.joints):
        y, ink = upper + 26 + 22 * i, WARNING if warned[i] else INK if joint.driven else MUTED
        shapes += [Text((left, y), joint.name, 13, ink), _bar(ends[0], ends[1], y, 2, TRACK)]
        if np.isfinite(scene.q[i]):
            at = ends[0] + (ends[1] - ends[0]) * float((scene.q[i] - low[i]) / (high[i] - low[i]))
            angle = round(float(scene.q[i]), 2) + 0  # no -0.00
            shapes += [
                _bar(at - 3, at + 3, y, 8, ink),
                Text((ends[1] + 8, y), f"{angle:+.2f}", 12, ink),
            ]
        if joint.driven:
            counts = float(scene.u[i]) * PWM_MAX
            reach = (ends[3] - ends[2]) / 2 * counts / machine.pwm_limit
            shapes += _valve(ends[2], ends[3], y, reach, scene.colour)
            shapes.append(Text((left + width, y), f"{round(counts):+d}", 12, INK, 1.0))
        else:
            shapes.append(Text((ends[2], y), "locked", 12, MUTED))
    return shapes


def _valve(x0: float, x1: float, y: float, reach: float, colour: Colour) -> list[Shape]:
    """A command as a bar that reaches so far [px] from the middle of its track."""
    zero = (x0 + x1) / 2
    bar = [_bar(zero, zero + reach, y, 6, colour)] if reach else []
    return [_bar(x0, x1, y, 6, TRACK), *bar, _bar(zero - 1, zero + 1, y, 8, INK)]


def _bar(x0: float, x1: float, y: float, half: float, colour: Colour) -> Polygon:
    return Polygon(
        np.array([[x0, y - half], [x1, y - half], [x1, y + half], [x0, y + half]]), colour
    )


def _ring(centre: Array, radius: float) -> Array:
    turn = np.linspace(0, 2 * np.pi, 25)
    return centre + radius * np.stack([np.cos(turn), np.sin(turn)], axis=-1)


def _arrow(start: Array, end: Array, colour: Colour) -> list[Shape]:
    """An arrow; none if it is shorter than its head is wide."""
    along = end - start
    length = float(np.hypot(*along))
    if not length > 4:
        return []
    unit = along / length
    across, head = np.array([-unit[1], unit[0]]), min(11.0, 0.7 * length)
    neck = end - head * unit
    wings = np.array([end, neck + 0.45 * head * across, neck - 0.45 * head * across])
    return [Line(np.array([start, neck]), colour, 3), Polygon(wings, colour)]


def _pale(colour: Colour, share: float = 0.45) -> Colour:
    """Nearer to the paper's colour; a negative share darkens."""
    r, g, b = (round(c + share * (p - c)) for c, p in zip(colour, PAPER, strict=True))
    return r, g, b


# --- cameras and warnings ---------------------------------------------------------------------------


class Camera(NamedTuple):
    """An orthographic view: pixel of the base frame's origin, pixels per metre, directions right and up."""

    origin: Array
    scale: float
    axes: Array  # (2, 3)

    def project(self, p: ArrayLike) -> Array:
        """Pixels (..., 2) of points (..., 3) [m]."""
        return self.origin + self.scale * (np.asarray(p) @ self.axes.T) * (1, -1)


class Extent(NamedTuple):
    """What both views must hold [m]: ends of right and up from the side and from above; the reach."""

    side: Array  # (2, 2)
    top: Array
    reach: float


@lru_cache(maxsize=32)
def extent(machine: Machine) -> Extent:
    """The extent of the arm over random poses, no lower than the ground if the arm reaches it."""
    low, high = machine.column("q_min"), machine.column("q_max")
    p = skeleton(machine, np.random.default_rng(0).uniform(low, high, (2000, machine.n)))
    side, top = p @ np.swapaxes(_side_axes(p[:, -1]), -1, -2), p @ ABOVE.T
    boxes = [np.stack([a.min((0, 1)), a.max((0, 1))]) for a in (side, top)]
    reach = float(np.hypot(p[..., 0], p[..., 1]).max()) + 1e-3
    for box in boxes:
        box[1] = np.maximum(box[1], box[0] + 0.2 * reach)  # an arm in one plane has no width
    if boxes[0][0, 1] - 0.2 * reach < machine.ground < boxes[0][1, 1]:
        boxes[0][0, 1] = machine.ground
    return Extent(boxes[0], boxes[1], reach)


def skeleton(machine: Machine, q: ArrayLike) -> Array:
    """Corners of the arm [m], (..., 2 n + 1, 3): the base, then the end of each joint's d and of its a."""
    p, z = forward_kinematics(machine, q)
    corners = np.empty((*p.shape[:-2], 2 * machine.n + 1, 3))
    corners[..., ::2, :] = p
    corners[..., 1::2, :] = p[..., :-1, :] + machine.column("d")[:, None] * z[..., :-1, :]
    return corners


def _side_axes(p_tool: Array) -> Array:
    """Right (towards the tool) and up, (..., 2, 3), for tool positions (..., 3)."""
    radius = np.hypot(p_tool[..., 0], p_tool[..., 1])
    far = radius > 1e-6
    axes = np.zeros((*radius.shape, 2, 3))
    axes[..., 0, 0] = np.where(far, p_tool[..., 0], 1.0) / np.where(far, radius, 1.0)
    axes[..., 0, 1] = np.where(far, p_tool[..., 1], 0.0) / np.where(far, radius, 1.0)
    axes[..., 1, 2] = 1.0
    return axes


def cameras(
    machine: Machine, p_tool: Array, side: Box, top: Box, hold: Array
) -> tuple[Camera, Camera]:
    """From the side, in the vertical plane of the tool, and from above with x up and y to the left.

    They show all that the arm can reach, or what lies around the points `hold` [m] (K, 3), if any.
    """
    e, found = extent(machine), []
    for box, (low, high), axes in ((side, e.side, _side_axes(p_tool)), (top, e.top, ABOVE)):
        if len(hold):
            flat = hold @ axes.T
            low, high = flat.min(0) - MARGIN * e.reach, flat.max(0) + MARGIN * e.reach
        left, upper, width, height = box
        soil = 0.07 * height
        scale = 0.92 * float(min(width / (high - low)[0], (height - 2 * soil) / (high - low)[1]))
        x = left + width / 2 - scale * (low + high)[0] / 2
        found.append(Camera(np.array([x, upper + height - soil + scale * low[1]]), scale, axes))
    return found[0], found[1]


def near_limit(machine: Machine, q: Array) -> NDArray[np.bool_]:
    """Is each driven joint within `NEAR_LIMIT` of an end of its range? (..., n)"""
    low, high = machine.column("q_min"), machine.column("q_max")
    margin = NEAR_LIMIT * (high - low)
    driven = np.array([joint.driven for joint in machine.joints])
    return np.asarray(((q < low + margin) | (q > high - margin)) & driven)


def weakest(machine: Machine, q: Array) -> tuple[float, Array]:
    """How far the tool moves for 1 rad of the joints the way it moves least [m], and that way (3,).

    The least singular value of the Jacobian; manipulability is the product of them all, and for a slewing
    arm says little more than how far out the tool is.
    """
    ways, values, _ = np.linalg.svd(
        jacobian(forward_kinematics(machine, q))[..., machine.driven], full_matrices=False
    )
    return float(values[-1]), ways[:, -1]


def near_singular(machine: Machine, q: Array) -> bool:
    """Is there a way along which the tool hardly moves?"""
    length = np.hypot(machine.column("a"), machine.column("d")).sum()
    return weakest(machine, q)[0] < NEAR_SINGULAR * float(length)
