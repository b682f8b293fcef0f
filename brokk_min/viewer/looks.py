"""What a machine looks like: corners, extent, two views of it; which poses deserve a warning."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brokk_min.kinematics import forward_kinematics, jacobian
from brokk_min.machine import Array, Machine

Box = tuple[float, float, float, float]  # left, top, width, height [px]
ABOVE = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])  # right and up as seen from above

# all assumed
NEAR_LIMIT = 0.05  # of a joint's range: nearer to its end is a warning
NEAR_SINGULAR = (
    0.1  # of the arm's length [1/rad]: the tool hardly moves some way below it, see `weakest`
)
MARGIN = 0.06  # of the reach: what is seen around the points that a scene holds


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
