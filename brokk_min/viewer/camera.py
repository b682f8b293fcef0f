"""Orthographic views of an arm, from the side and from above, in pixels."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from brokk_min.kinematics import forward_kinematics
from brokk_min.machine import Array, Machine
from brokk_min.viewer.window import Box

MARGIN = 0.06  # of the reach, assumed: border around the points of a close-up
ABOVE = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])  # right and up, seen from above


class Camera(NamedTuple):
    """An orthographic view."""

    label: str
    box: Box  # its part of the picture
    origin: Array  # pixel of the base frame's origin (2,)
    scale: float  # px/m
    axes: Array  # directions right and up (2, 3)

    def project(self, p: ArrayLike) -> Array:
        """Pixels (..., 2) of points (..., 3) [m]."""
        return self.origin + self.scale * (np.asarray(p) @ self.axes.T) * (1, -1)


def skeleton(machine: Machine, q: ArrayLike) -> Array:
    """Corners of the arm [m], (..., 2 n + 1, 3): base, then the ends of each joint's d and a."""
    p, z, _ = forward_kinematics(machine, q)
    corners = np.empty((*p.shape[:-2], 2 * machine.n + 1, 3))
    corners[..., ::2, :] = p
    along = np.sum((p[..., 1:, :] - p[..., :-1, :]) * z[..., :-1, :], axis=-1, keepdims=True)
    corners[..., 1::2, :] = p[..., :-1, :] + along * z[..., :-1, :]
    return corners


@lru_cache(maxsize=32)
def extent(machine: Machine) -> tuple[Array, Array, float]:
    """Space that 2,000 random poses take, no lower than the ground if the arm reaches it.

    Low and high ends (2, 2) of right and up from the side and from above; the reach [m].
    """
    rng = np.random.default_rng(0)
    q = rng.uniform(machine.column("q_min"), machine.column("q_max"), (2000, machine.n))
    p = skeleton(machine, q)
    reach = float(np.hypot(p[..., 0], p[..., 1]).max()) + 1e-3
    side = _bounds(p @ np.swapaxes(_side_axes(p[:, -1]), -1, -2), 0.2 * reach)
    top = _bounds(p @ ABOVE.T, 0.2 * reach)
    if side[0, 1] - 0.2 * reach < machine.ground < side[1, 1]:
        side[0, 1] = machine.ground
    return side, top, reach


def _bounds(points: Array, smallest: float) -> Array:
    """Low and high ends (2, 2) of points (..., 2), at least `smallest` apart."""
    low = points.reshape(-1, 2).min(axis=0)
    return np.stack([low, np.maximum(points.reshape(-1, 2).max(axis=0), low + smallest)])


def _side_axes(p_tool: Array) -> Array:
    """Directions right (towards the tool) and up, (..., 2, 3), for tool positions (..., 3)."""
    heading = np.arctan2(p_tool[..., 1], p_tool[..., 0])
    axes = np.zeros((*heading.shape, 2, 3))
    axes[..., 0, 0] = np.cos(heading)
    axes[..., 0, 1] = np.sin(heading)
    axes[..., 1, 2] = 1.0
    return axes


def cameras(
    machine: Machine, p_tool: Array, side_box: Box, top_box: Box, in_view: Array
) -> list[Camera]:
    """From the side, in the vertical plane of the tool, and from above with x up and y left.

    They show the whole reach, or what lies around the points `in_view` [m] (K, 3), if any.
    """
    side, top, reach = extent(machine)
    axes = _side_axes(p_tool)
    if len(in_view):
        border = MARGIN * reach * np.array([[-1], [1]])
        side = _bounds(in_view @ axes.T, 0.0) + border
        top = _bounds(in_view @ ABOVE.T, 0.0) + border
    return [_fit("side", side_box, side, axes), _fit("top", top_box, top, ABOVE)]


def close_up(points: Array, box: Box) -> Camera:
    """From the side or from above, whichever shows more of the points [m] (K, 3), and only them."""
    side = _side_axes(points.mean(axis=0))
    spans = [np.prod(np.ptp(points @ axes.T, axis=0)) for axes in (side, ABOVE)]
    label, axes = ("side", side) if spans[0] >= spans[1] else ("top", ABOVE)
    low, high = _bounds(points @ axes.T, 0.0)
    border = max(0.15 * float((high - low).max()), 0.1)
    return _fit(label, box, np.stack([low - border, high + border]), axes)


def _fit(label: str, box: Box, bounds: Array, axes: Array) -> Camera:
    """The camera that shows the bounds [m] (2, 2) in a box, above a strip of soil."""
    left, upper, width, height = box
    low, high = bounds
    soil = 0.07 * height
    span = high - low
    scale = 0.92 * float(min(width / span[0], (height - 2 * soil) / span[1]))
    x = left + width / 2 - scale * (low[0] + high[0]) / 2
    y = upper + height - soil + scale * low[1]
    return Camera(label, box, np.array([x, y]), scale, axes)
