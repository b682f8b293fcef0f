"""Shapes of a machine from its geometry alone, and what is wrong with a pose.

Any `Machine` gets tracks, outriggers and a turret. Only joints and links are where the machine has
them; all sizes here are assumed. A prism has two equal faces: corners [m] (2, K, 3).
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from brokk_min.kinematics import forward_kinematics, jacobian, lowest_point
from brokk_min.machine import Array, Machine
from brokk_min.viewer.camera import extent, skeleton

NEAR_LIMIT = 0.05  # of a joint's range: nearer to its end is a warning
NEAR_SINGULAR = 0.1  # of the arm's length [1/rad]: a smaller singular value is a warning
THICK = 0.032  # of the reach: half the width of the first link
BOOM = np.array([[0, 1.0], [0.3, 1.2], [1, 0.7]])  # along a link, half widths across
BREAKER = np.array([[0, 0.6], [0.1, 1.3], [0.6, 1.3], [0.66, 0.5]])  # of the last link
CHISEL = np.array([[0.6, 0.45], [0.93, 0.35], [1, 0.05]])  # its point is the tool


def _box(low: Array, high: Array) -> Array:
    """An upright box, as a prism."""
    x = [low[0], high[0], high[0], low[0]]
    y = [low[1], low[1], high[1], high[1]]
    return np.array([np.stack([x, y, np.full(4, z)], axis=1) for z in (low[2], high[2])])


def unit(machine: Machine) -> float:
    """Length [m] by which the parts below the arm grow: the reach, less for a low first joint."""
    height = machine.joints[0].d
    return min(extent(machine)[2], 6 * max(height, 0.1 * extent(machine)[2]))


@lru_cache(maxsize=8)
def undercarriage(machine: Machine) -> list[Array]:
    """Two tracks along x, and four outriggers: prisms."""
    around = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    along = 0.115 * np.sign(np.cos(around)) + 0.035 * np.cos(around)
    track = np.stack([along, 0 * around, 0.035 + 0.035 * np.sin(around)], axis=1)
    parts = [
        np.array([track + np.array([0, y + side, 0]) for side in (-0.02, 0.02)])
        for y in (-0.075, 0.075)
    ]
    for x, y in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
        leg = np.array([[0.08 * x, 0.05 * y, 0.06], [0.17 * x, 0.16 * y, 0.065]])
        foot = np.array([0.17 * x, 0.16 * y, 0.0])
        slope = np.vstack([leg, leg[::-1] + np.array([0, 0, 0.025])])
        parts.append(np.array([slope, slope + np.array([0, 0.015 * y, 0])]))
        for width, height in ((0.006, 0.085), (0.025, 0.01)):
            corner = np.array([width, width, height])
            parts.append(_box(foot - corner * (1, 1, 0), foot + corner))
    return [unit(machine) * part for part in parts]


def turret(machine: Machine, q: Array) -> Array:
    """The part that slews, from above the tracks to the second joint: a prism."""
    first = machine.joints[0]
    size = unit(machine)
    low = np.array([-0.12 * size, -0.055 * size, 0.06 * size])
    high = np.array([max(first.a, 0.03 * size), 0.055 * size, max(first.d, 0.1 * size)])
    c, s = np.cos(q[0] + first.theta), np.sin(q[0] + first.theta)
    turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    return np.asarray(_box(low, high) @ turn)


def half_widths(machine: Machine) -> Array:
    """Half the width [m] of each part of the `skeleton`, thinner towards the tool, (2 n,)."""
    return THICK * extent(machine)[2] * np.linspace(1.0, 0.45, 2 * machine.n)


def contacts(machine: Machine, q: Array) -> dict[str, set[int]]:
    """Text of each contact, and the parts of the `skeleton` that touch: what a drawing marks.

    Links are taken as round, at points along them. Neighbours are left to the joints' ranges.
    """
    corners = skeleton(machine, q)
    lengths = np.linalg.norm(np.diff(corners, axis=0), axis=-1)
    links = [i for i in range(2, 2 * machine.n) if lengths[i] > 1e-6]
    widths = half_widths(machine)
    points = {i: np.linspace(corners[i], corners[i + 1], 12) for i in links}
    found: dict[str, set[int]] = {}
    for k, i in enumerate(links):
        for j in links[k + 2 :]:
            gap = np.linalg.norm(points[i][:, None] - points[j], axis=-1).min()
            if gap < widths[i] + widths[j]:
                found.setdefault("the arm touches itself", set()).update((i, j))
    size = unit(machine)
    for i in links[1:]:
        x, y, z = points[i].T
        if ((np.hypot(x, y) < 0.14 * size) & (z < max(machine.joints[0].d, 0.1 * size))).any():
            found.setdefault("the arm touches the machine", set()).add(i)
    if lowest_point(forward_kinematics(machine, q)) < machine.ground:
        low = {i for i in links if points[i][-1, 2] < machine.ground}
        found["the arm touches the ground"] = low
    return found


def near_limit(machine: Machine, q: Array) -> NDArray[np.bool_]:
    """Is each driven joint within `NEAR_LIMIT` of an end of its range? (..., n)"""
    low = machine.column("q_min")
    high = machine.column("q_max")
    margin = NEAR_LIMIT * (high - low)
    driven = [joint.driven for joint in machine.joints]
    return np.asarray(((q < low + margin) | (q > high - margin)) & driven)


def near_singular(machine: Machine, q: Array) -> bool:
    """Is the least singular value of the Jacobian small: is there a direction of hardly any motion?

    Manipulability, the product of all singular values, grows with the radius of a slewing arm.
    """
    J = jacobian(forward_kinematics(machine, q))[..., machine.driven]
    least_singular_value = np.linalg.svd(J, compute_uv=False)[-1]
    length = np.hypot(machine.column("a"), machine.column("d")).sum()
    return bool(least_singular_value < NEAR_SINGULAR * length)
