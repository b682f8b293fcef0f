"""Pictures of arms from the side and from above, with velocities, angles, valves and warnings.

`draw` uses nothing but kinematics; any `Machine` can be drawn. Lengths are in pixels, y down.
"""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import wrap
from typing import NamedTuple

import numpy as np

from brokk_min.kinematics import forward_kinematics, tool_position, tool_velocity
from brokk_min.machine import PWM_MAX, Array, Machine
from brokk_min.viewer import shapes
from brokk_min.viewer.camera import Camera, cameras, close_up, skeleton
from brokk_min.viewer.window import BACKGROUND, INK, Box, Canvas, Colour

# all assumed
ARROW = 0.2  # of a view's smaller side: an arrow of the machine's tool speed
HEAD = 48.0  # px above the views
FOOT = 44.0  # px below a close-up

NO_POINTS = np.zeros((0, 3))
MUTED = (120, 128, 138)
GRID = (228, 230, 232)
TRACK = (212, 216, 221)
SOIL = (214, 203, 186)
STEEL = (74, 80, 88)
WARNING = (208, 28, 28)
DRIVING = (0, 130, 90)
READY = (0, 100, 170)
GOAL = INK
MEASURED = (0, 158, 115)
PATH = (230, 159, 0)
COLOURS = {"rl": (0, 114, 178), "jacobian": (213, 94, 0), "levers": (124, 87, 148)}


class Trace(NamedTuple):
    """The run of another controller, laid over a scene."""

    q: Array  # angles [rad] (n,)
    trail: Array  # past tool positions [m] (T, 3)
    colour: Colour
    text: str


class Scene(NamedTuple):
    """What a picture shows of one arm, base frame."""

    q: Array  # angles [rad] (n,); nan: unknown
    q_dot: Array  # joint velocities [rad/s] (n,)
    u: Array  # commands in [-1, 1] (n,)
    v_goal: Array  # goal velocity of the tool [m/s] (3,)
    trail: Array = NO_POINTS  # past tool positions [m] (T, 3)
    path: Array = NO_POINTS  # line that the tool should follow [m] (K, 3)
    target: Array = NO_POINTS  # its next point [m], (1, 3) or none
    title: str = ""
    status: str = ""
    status_colour: Colour = MUTED
    colour: Colour = COLOURS["rl"]
    notes: Sequence[str] = ()
    in_view: Array = NO_POINTS  # points that the views show [m] (K, 3); none: the whole reach
    banner: str = ""  # what keeps the machine from moving, in words
    traces: Sequence[Trace] = ()  # other runs over this one
    close_up: Array = NO_POINTS  # these points [m] (K, 3) fill a view, instead of top view and rows
    headline: str = ""  # the one figure that decides


def draw(canvas: Canvas, machine: Machine, scenes: Sequence[Scene]) -> None:
    """Draw one or more arms side by side."""
    width = canvas.size[0] / len(scenes)
    height = float(canvas.size[1])
    for i, scene in enumerate(scenes):
        _panel(canvas, machine, scene, (i * width, 0.0, width, height))
        if i:
            canvas.line(np.array([[i * width, 12], [i * width, height - 12]]), TRACK, 2)


# --- layout ---------------------------------------------------------------------------------------


def _layout(box: Box, joints: int, notes: int) -> tuple[Box, Box, Box, tuple[float, float]]:
    """Boxes of side view, top view and joint rows, and the corner of the notes [px].

    Wide: both views above the rows. Tall: the side view above, top view and rows below.
    """
    left, _, width, height = box
    foot = 26.0 + 22 * joints
    if width > 1.3 * height:
        foot = max(foot, 6.0 + 18 * notes)
        upper = height - foot
        side = (left, HEAD, 0.6 * width, upper - HEAD)
        top = (left + 0.6 * width, HEAD, 0.4 * width, upper - HEAD)
        rows = (left + 16, upper + 6, 0.52 * width, foot)
        return side, top, rows, (left + 0.52 * width + 36, upper + 14)
    foot = max(foot, 0.4 * height)
    upper = height - foot
    side = (left, HEAD, width, upper - HEAD)
    top = (left, upper, 0.38 * width, foot)
    rows = (left + 0.38 * width + 8, upper + 6, 0.62 * width - 16, foot)
    return side, top, rows, (left + 16, HEAD + 34)


# --- a panel for each arm -------------------------------------------------------------------------


def _panel(canvas: Canvas, machine: Machine, scene: Scene, box: Box) -> None:
    """One arm: title and status, both views, a row for each joint, notes."""
    left, upper, width, height = box
    room = 0.48 * width - 44 if width > 1.3 * height else width - 32
    notes = [line for note in scene.notes for line in wrap(note, int(room / 7))]
    side, top, rows, (x_notes, y_notes) = _layout(box, machine.n, len(notes))
    if len(scene.close_up):
        half = (height - HEAD) / 2
        side = (left, HEAD, width, half)
        top = (left, HEAD + half, width, half - FOOT)
        x_notes, y_notes = left + 16, HEAD + 34
    room = width - 60 - 9 * len(scene.status)  # px that the status leaves for the title
    title_size = int(np.clip(room / (0.7 * max(1, len(scene.title))), 8, 18))
    canvas.circle(np.array([left + 22.0, 21.0]), 7, scene.colour)
    canvas.text(left + 36, 21, scene.title, title_size)
    canvas.text(left + width - 16, 21, scene.status, 14, scene.status_colour, 1.0)
    if np.isfinite(scene.q).all():
        _views(canvas, machine, scene, side, top)
    if scene.banner:
        size = int(np.clip(width / (0.62 * len(scene.banner)), 8, 14))
        canvas.text(left + width / 2, HEAD - 6, scene.banner, size, WARNING, 0.5)
    if len(scene.close_up):
        canvas.text(left + width / 2, upper + height - FOOT / 2, scene.headline, 17, INK, 0.5)
    else:
        x, y = side[0] + side[2] / 2, side[1] + side[3] - 34
        canvas.text(x, y, scene.headline, 15, INK, 0.5)
        _joint_rows(canvas, machine, scene, rows)
    for i, note in enumerate(notes):
        canvas.text(x_notes, y_notes + 18 * i, note, 12)


def _views(canvas: Canvas, machine: Machine, scene: Scene, side: Box, top: Box) -> None:
    """The arm from both sides; goal and measured speed, warnings."""
    frames = forward_kinematics(machine, scene.q)
    p_tool = tool_position(frames)
    touching = shapes.contacts(machine, scene.q)
    views = cameras(machine, p_tool, side, top, scene.in_view)
    if len(scene.close_up):
        views = [views[0], close_up(scene.close_up, top)]
    for camera in views:
        canvas.clip(camera.box)
        _backdrop(canvas, machine, camera)
        _base(canvas, machine, camera, scene)
        for trace in scene.traces[1:]:
            other = scene._replace(q=trace.q, colour=_pale(trace.colour, 0.4))
            _arm(canvas, machine, camera, other, set())
        _arm(canvas, machine, camera, scene, set().union(*touching.values()))
        _tool(canvas, machine, camera, scene)
    canvas.clip(None)
    legend = [
        (f"goal {np.linalg.norm(scene.v_goal):.2f} m/s", GOAL),
        (f"measured {np.linalg.norm(tool_velocity(frames, scene.q_dot)):.2f} m/s", MEASURED),
    ]
    warned = np.flatnonzero(shapes.near_limit(machine, scene.q))
    legend += [(f"{machine.names[i]} near its limit", WARNING) for i in warned]
    if shapes.near_singular(machine, scene.q):
        legend.append(("near a singularity", WARNING))
    legend += [(text, WARNING) for text in touching]
    legend += [(trace.text, trace.colour) for trace in scene.traces]
    for i, (text, ink) in enumerate(legend):
        canvas.text(side[0] + side[2] - 14, HEAD + 14 + 18 * i, text, 12, ink, 1.0)


def _backdrop(canvas: Canvas, machine: Machine, camera: Camera) -> None:
    """The ground, a grid of 1 m (or a power of ten that fits) with its numbers, the axes' names."""
    left, upper, width, height = camera.box
    right = left + width
    lower = upper + height
    x0, y0 = camera.origin
    metres = next(m for m in 10.0 ** np.arange(-1, 20) if m * camera.scale > 12)
    step = camera.scale * metres
    ground = lower
    if camera.label == "side" and y0 - camera.scale * machine.ground < lower:
        ground = y0 - camera.scale * machine.ground
        canvas.bar(left, right, (ground + lower) / 2, (lower - ground) / 2, SOIL)
    columns = np.arange(np.ceil((left - x0) / step), (right - x0) // step + 1)
    rows = np.arange(np.ceil((y0 - lower) / step), (y0 - upper) // step + 1)
    every = np.ceil(34 / step)  # grid lines from one number to the next
    sign = -1 if camera.label == "top" else 1
    for k in columns:
        x = x0 + step * k
        canvas.bar(x, x + 1, (upper + ground) / 2, (ground - upper) / 2, GRID)
        if k % every == 0 and left + 40 < x < right - 60:
            canvas.text(x, lower - 9, f"{sign * k * metres + 0.0:g}", 10, MUTED, 0.5)
    for k in rows:
        y = y0 - step * k
        if y < ground:
            canvas.bar(left, right, y, 0.5, GRID)
        if k % every == 0 and upper + 0.3 * height < y < lower - 40:
            canvas.text(left + 6, y, f"{k * metres + 0.0:g}", 10, MUTED)
    if y0 < ground < lower:  # the machine stands at the height 0
        foot = 0.25 * shapes.unit(machine) * camera.scale
        canvas.bar(x0 - foot, x0 + foot, (y0 + ground) / 2, (ground - y0) / 2, SOIL)
    across, up = ("out", "z") if camera.label == "side" else ("y", "x")
    canvas.text(right - 8, lower - 9, f"{across} [m]", 10, MUTED, 1.0)
    canvas.text(left + 6, lower - 26, f"{up} [m]", 10, MUTED)
    canvas.text(left + 14, upper + 14, f"{camera.label} view", 11, MUTED)


def _base(canvas: Canvas, machine: Machine, camera: Camera, scene: Scene) -> None:
    """Tracks, outriggers, and the turret over them."""
    parts = [(part, STEEL) for part in shapes.undercarriage(machine)]
    for part, colour in [*parts, (shapes.turret(machine, scene.q), _pale(scene.colour, -0.3))]:
        near, far = camera.project(part)
        for k in range(len(near)):
            canvas.polygon(np.array([near[k - 1], near[k], far[k], far[k - 1]]), colour)
        canvas.polygon(near, colour)
        canvas.polygon(far, colour)


def _arm(canvas: Canvas, machine: Machine, camera: Camera, scene: Scene, red: set[int]) -> None:
    """Links, the last one a breaker, and joints; red near a limit and where the arm touches."""
    corners = camera.project(skeleton(machine, scene.q))
    warned = shapes.near_limit(machine, scene.q)
    sizes = np.maximum(shapes.half_widths(machine) * camera.scale, 1.5)
    lengths = np.linalg.norm(np.diff(corners, axis=0), axis=-1)
    links = [i for i in range(2, 2 * machine.n) if lengths[i] > 0.5]
    for i in links:
        colour = WARNING if i in red else _pale(scene.colour, 0.2 * (i // 2 % 2))
        along = (corners[i + 1] - corners[i]) / lengths[i]
        across = along[::-1] * (-1, 1)
        parts = [shapes.BREAKER, shapes.CHISEL] if i == 2 * machine.n - 1 else [shapes.BOOM]
        for part, ink in zip(parts, (colour, STEEL)):
            middle = corners[i] + lengths[i] * part[:, :1] * along
            wide = sizes[i] * part[:, 1:] * across
            outline = np.vstack([middle + wide, (middle - wide)[::-1]])
            canvas.polygon(outline, ink)
            canvas.line(np.vstack([outline, outline[:1]]), _pale(ink, -0.3))
    for i in range(1, machine.n):
        size = max(3.0, 0.6 * float(sizes[2 * i]))
        radius, colour = (1.8, WARNING) if warned[i] else (1.0, _pale(scene.colour, -0.3))
        canvas.circle(corners[2 * i], radius * size, colour)
        canvas.circle(corners[2 * i], 0.5 * size, BACKGROUND)


def _tool(canvas: Canvas, machine: Machine, camera: Camera, scene: Scene) -> None:
    """Path, trail, next target, tool tip, and its velocities."""
    lines = [(scene.path, PATH, 3), (scene.trail, scene.colour, 2)]
    lines += [(trace.trail, trace.colour, 2) for trace in scene.traces]
    for points, colour, width in lines:
        if len(points) > 1:
            canvas.line(camera.project(points), colour, width)
    for p in scene.target:
        canvas.circle(camera.project(p), 10.5, PATH, 3)
    frames = forward_kinematics(machine, scene.q)
    tip = camera.project(tool_position(frames))
    canvas.circle(tip, 4.0, INK)
    if shapes.near_singular(machine, scene.q):
        canvas.circle(tip, 16.0, WARNING, 2)
    scale = ARROW * min(camera.box[2:]) / machine.tool_speed
    for v, colour in ((tool_velocity(frames, scene.q_dot), MEASURED), (scene.v_goal, GOAL)):
        _arrow(canvas, tip, scale * (camera.axes @ v) * (1, -1), colour)


def _arrow(canvas: Canvas, start: Array, along: Array, colour: Colour) -> None:
    """An arrow; none if it is shorter than its head is wide."""
    length = float(np.hypot(*along))
    if length > 4:
        direction = along / length
        head = min(11.0, 0.7 * length)
        neck = start + (length - head) * direction
        barb = 0.45 * head * direction[::-1] * (-1, 1)
        canvas.line(np.array([start, neck]), colour, 3)
        canvas.polygon(np.array([start + along, neck + barb, neck - barb]), colour)


def _pale(colour: Colour, fraction: float) -> Colour:
    """A colour mixed with a fraction of the background, or of ink if it is negative."""
    other = BACKGROUND if fraction > 0 else INK
    r, g, b = (round(c + abs(fraction) * (w - c)) for c, w in zip(colour, other, strict=True))
    return r, g, b


def _joint_rows(canvas: Canvas, machine: Machine, scene: Scene, box: Box) -> None:
    """A row for each joint: name, angle within its range, command within the limit."""
    left, upper, width, _ = box
    angle = left + max(46.0, 9.0 * max(map(len, machine.names)))  # left end of the angle bars
    length = (left + width - angle - 58 - 40) / 2  # 58 px for digits of the angle, 40 of the valve
    valve = angle + length + 58
    canvas.text(angle, upper + 6, "angle [rad]", 11, MUTED)
    header = f"valve of {machine.pwm_limit}"
    canvas.text(min(valve, left + width - 66), upper + 6, header, 11, MUTED)
    warned = shapes.near_limit(machine, scene.q)
    for i, joint in enumerate(machine.joints):
        y = upper + 26 + 22 * i
        colour = WARNING if warned[i] else INK if joint.driven else MUTED
        canvas.text(left, y, joint.name, 13, colour)
        canvas.bar(angle, angle + length, y, 2, TRACK)
        if np.isfinite(scene.q[i]):
            x = angle + length * (scene.q[i] - joint.q_min) / (joint.q_max - joint.q_min)
            canvas.bar(x - 3, x + 3, y, 8, colour)
            unit = " m" if joint.kind == "prismatic" else ""
            canvas.text(angle + length + 8, y, f"{scene.q[i]:+z.2f}{unit}", 12, colour)
        if joint.driven:
            counts = float(scene.u[i]) * PWM_MAX
            zero = valve + length / 2
            end = zero + counts / machine.pwm_limit * length / 2
            canvas.bar(valve, valve + length, y, 6, TRACK)
            canvas.bar(zero, end, y, 6, scene.colour)
            canvas.bar(zero - 1, zero + 1, y, 8, INK)
            canvas.text(left + width, y, f"{round(counts):+d}", 12, INK, 1.0)
        else:
            canvas.text(valve, y, "locked", 12, MUTED)
