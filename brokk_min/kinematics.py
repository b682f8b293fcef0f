"""Hand-written Denavit-Hartenberg kinematics: frames, tool position, Jacobian, tool velocity.

One forward pass (`_chain`) serves everything. It keeps a frame as four arrays (axes x, y, z and origin
p, the 3 coordinates first): arithmetic on whole coordinates is several times faster than stacks of 4x4
products. All results are in the base frame, z up, origin on the ground under the slew axis; angles `q`
[rad] are (..., n) and keep their float type.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brokk_min.machine import Machine, as_floats

Array = NDArray[np.floating[Any]]


class Chain(NamedTuple):
    """Frames along the arm, base first: axes of each frame and its origin, arrays (3, ...)."""

    x: list[Array]
    y: list[Array]
    z: list[Array]
    p: list[Array]


def _joints_first(machine: Machine, q: ArrayLike, name: str = "q") -> Array:
    """Checked angles or rates as (n, ...), contiguous: each joint's arithmetic then runs at full speed."""
    angles = as_floats(q)
    if angles.ndim < 1 or angles.shape[-1] != machine.n:
        raise ValueError(f"{name}: expected (..., {machine.n}), got {angles.shape}")
    return np.ascontiguousarray(np.moveaxis(angles, -1, 0))


def _chain(machine: Machine, q: ArrayLike) -> Chain:
    """All frames of the arm by the DH rows, T_i = T_(i-1) Rz(q + theta) Tz(d) Tx(a) Rx(alpha)."""
    angles = _joints_first(machine, q)
    x, y, z = np.eye(3, dtype=angles.dtype).reshape(3, 3, *[1] * (angles.ndim - 1))
    p = np.zeros_like(x)  # the base: shape (3, 1, ...), spread over the batch by the arithmetic
    chain = Chain([x], [y], [z], [p])
    theta = np.array([joint.theta for joint in machine.joints], angles.dtype)
    turned = angles + theta.reshape(-1, *[1] * (angles.ndim - 1))
    for joint, c, s in zip(machine.joints, np.cos(turned), np.sin(turned), strict=True):
        x, y = c * x + s * y, c * y - s * x
        p = p + float(joint.a) * x + float(joint.d) * z
        if joint.alpha != 0.0:  # parallel axes, the common case, need no second rotation
            c_alpha, s_alpha = float(np.cos(joint.alpha)), float(np.sin(joint.alpha))
            y, z = c_alpha * y + s_alpha * z, c_alpha * z - s_alpha * y
        for column, value in zip(chain, (x, y, z, p), strict=True):
            column.append(value)
    return chain


def frames(machine: Machine, q: ArrayLike) -> Array:
    """Frames [1, m] of the base, each link's end and (last) the tool, (..., n + 1, 4, 4). Paper: Fig. 1"""
    chain = _chain(machine, q)
    shape = chain.p[-1].shape
    columns = np.stack([[np.broadcast_to(a, shape) for a in axis] for axis in chain])
    result = np.zeros((*columns.shape[3:], machine.n + 1, 4, 4), columns.dtype)
    result[..., :3, :] = np.moveaxis(columns, (0, 1, 2), (-1, -3, -2))  # from (4, n + 1, 3, ...)
    result[..., 3, 3] = 1.0
    return result


def tool_position(machine: Machine, q: ArrayLike) -> Array:
    """Position of the tool tip [m], (..., 3). Paper: Fig. 1

    Example:
        >>> from brokk_min.machine import BROKK_170
        >>> x, y, z = tool_position(BROKK_170, [1.5, 0.5, 0.58, 1.71, 1.24])
        >>> round(float(np.hypot(x, y)), 2), round(float(z), 2)
        (3.05, 1.01)
    """
    return np.moveaxis(_chain(machine, q).p[-1], 0, -1)


def _columns(chain: Chain) -> list[Array]:
    """Jacobian columns z_(i-1) x (p_tool - p_(i-1)) of all joints, each (3, ...)."""
    result: list[Array] = []
    for z, p in zip(chain.z[:-1], chain.p[:-1], strict=True):
        arm = chain.p[-1] - p
        column = np.empty_like(arm)
        column[0] = z[1] * arm[2] - z[2] * arm[1]
        column[1] = z[2] * arm[0] - z[0] * arm[2]
        column[2] = z[0] * arm[1] - z[1] * arm[0]
        result.append(column)
    return result


def jacobian(machine: Machine, q: ArrayLike) -> Array:
    """d(tool position)/d(driven angles) [m/rad], (..., 3, n_driven). Paper: eq3 (J)"""
    columns = _columns(_chain(machine, q))
    return np.moveaxis(np.stack([columns[i] for i in machine.driven]), (0, 1), (-1, -2))


def tool_state(machine: Machine, q: ArrayLike, q_dot: ArrayLike) -> tuple[Array, Array, Array]:
    """Tool position [m] (..., 3), its velocity [m/s] (..., 3) and the lowest point [m] (...) in one pass.

    `q_dot` [rad/s] (..., n) is of all joints, locked ones included. Paper: Sec. 3.4 ("through forward
    kinematics")

    Example:
        >>> from brokk_min.machine import BROKK_170
        >>> tool_state(BROKK_170, np.zeros(5), np.eye(5)[0])[1].round(2) + 0.0
        array([0.  , 2.35, 0.  ])
    """
    rates = _joints_first(machine, q_dot, "q_dot")
    chain = _chain(machine, q)
    velocity = np.zeros_like(chain.p[-1])
    for column, rate in zip(_columns(chain), rates, strict=True):
        velocity += column * rate
    return np.moveaxis(chain.p[-1], 0, -1), np.moveaxis(velocity, 0, -1), _lowest(chain)


def tool_velocity(machine: Machine, q: ArrayLike, q_dot: ArrayLike) -> Array:
    """Velocity of the tool tip [m/s] (..., 3): the second value of `tool_state`."""
    return tool_state(machine, q, q_dot)[1]


def joint_rates(machine: Machine, q: ArrayLike, v: ArrayLike) -> Array:
    """Rates of the driven joints [rad/s] (..., n_driven) that move the tool at `v` [m/s] (..., 3), damped.

    J^T (J J^T + lambda^2 I)^-1 v with lambda = 6 % of the arm's length: the tool would stay a few percent
    below `v` in the middle of the workspace and more near singularities, where the rates stay bounded.
    The least squares of `jacobian.dls` with W = 1, written out for whole batches without a matrix a pose.

    Example:
        >>> from brokk_min.machine import BROKK_170
        >>> joint_rates(BROKK_170, [0.0, 0.5, 0.58, 1.71, 1.24], [0.0, 0.3, 0.0]).round(3) + 0.0
        array([0.097, 0.   , 0.   , 0.   ])
    """
    every = _columns(_chain(machine, q))
    columns = [every[i] for i in machine.driven]
    length = np.hypot(machine.column("a"), machine.column("d")).sum()
    damping = np.asarray(1e-6 + (0.06 * length) ** 2, columns[0].dtype)
    x, y, z = np.moveaxis(np.asarray(v, columns[0].dtype), -1, 0)

    def product(i: int, j: int) -> Array:
        total = columns[0][i] * columns[0][j]
        for column in columns[1:]:
            total = total + column[i] * column[j]
        return total + damping if i == j else total

    xx, yy, zz, xy, xz, yz = (product(*ij) for ij in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)))
    a, b, c = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy  # cofactors of the first row
    d, e, f = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    determinant = xx * a + xy * b + xz * c
    solved = [(a * x + b * y + c * z), (b * x + d * y + e * z), (c * x + e * y + f * z)]
    rates = [solved[0] * column[0] + solved[1] * column[1] + solved[2] * column[2] for column in columns]
    return np.stack(rates, axis=-1) / determinant[..., None]


def lowest_point(machine: Machine, q: ArrayLike) -> Array:
    """Height [m] of the lowest end of a link, (...); links are straight between their frames.

    Example:
        >>> from brokk_min.machine import BROKK_170
        >>> round(float(lowest_point(BROKK_170, [0.0, 0.0, 0.0, np.pi, 3 * np.pi / 4])), 2)
        0.95
    """
    return _lowest(_chain(machine, q))


def _lowest(chain: Chain) -> Array:
    heights = np.broadcast_arrays(*(p[2] for p in chain.p[1:]))
    return np.minimum.reduce(heights)
