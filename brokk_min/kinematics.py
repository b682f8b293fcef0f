"""Hand-written Denavit-Hartenberg kinematics: frames, tool position, Jacobian, tool velocity.

One forward pass (`_chain`) serves everything. It keeps axes and origins of the frames as arrays with the 3
coordinates first and the joints next, and turns joints with parallel axes together: few operations on whole
arrays are several times faster than stacks of 4x4 products. All results are in the base frame, z up, origin
on the ground under the slew axis; angles `q` [rad] are (..., n) and keep their float type.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brokk_min.machine import Machine, as_floats

Array = NDArray[np.floating[Any]]


class Chain(NamedTuple):
    """Axes x and z of the frames along the arm, base first, and their origins p: arrays (3, n + 1, ...)."""

    x: Array
    z: Array
    p: Array


class _Run(NamedTuple):
    """Joints `start` to `end` - 1, whose axes are parallel; their offsets and links, (joints, 1, ...)."""

    start: int
    end: int
    theta: Array  # rad, summed from the run's first joint on
    a: Array  # m
    d: Array  # m
    cos: float  # of the last joint's alpha
    sin: float


def _runs(machine: Machine, dtype: Any, ndim: int) -> list[_Run]:
    """The arm as runs of joints with parallel axes; worked out once and kept with the machine."""
    kept = machine.__dict__.setdefault("runs", {})
    if (dtype, ndim) not in kept:
        ends = [i + 1 for i, joint in enumerate(machine.joints) if joint.alpha != 0.0 or i == machine.n - 1]
        runs = []
        for start, end in zip([0, *ends], ends, strict=False):
            rows = [machine.column(name)[start:end] for name in ("theta", "a", "d")]
            rows[0] = np.cumsum(rows[0])
            theta, a, d = (row.astype(dtype).reshape(-1, *[1] * (ndim - 1)) for row in rows)
            alpha = machine.joints[end - 1].alpha
            runs.append(_Run(start, end, theta, a, d, float(np.cos(alpha)), float(np.sin(alpha))))
        kept[dtype, ndim] = runs
    result: list[_Run] = kept[dtype, ndim]
    return result


def _joints_first(machine: Machine, q: ArrayLike, name: str = "q") -> Array:
    """Checked angles or rates as (n, ...), contiguous: each joint's arithmetic then runs at full speed."""
    angles = as_floats(q)
    if angles.ndim < 1 or angles.shape[-1] != machine.n:
        raise ValueError(f"{name}: expected (..., {machine.n}), got {angles.shape}")
    return np.ascontiguousarray(_coordinates_first(angles))


def _coordinates_first(array: Array, axes: int = 1) -> Array:
    """The last `axes` axes first; `np.moveaxis` takes ten times as long."""
    batch = array.ndim - axes
    return array.transpose(*range(batch, array.ndim), *range(batch))


def _coordinates_last(array: Array, axes: int = 1) -> Array:
    """The first `axes` axes last."""
    return array.transpose(*range(axes, array.ndim), *range(axes))


def _chain(machine: Machine, q: ArrayLike) -> Chain:
    """All frames of the arm by the DH rows, T_i = T_(i-1) Rz(q + theta) Tz(d) Tx(a) Rx(alpha)."""
    angles = _joints_first(machine, q)
    x, z, p = chain = Chain(*np.zeros((3, 3, machine.n + 1, *angles.shape[1:]), angles.dtype))
    x[0, 0] = z[2, 0] = 1
    y = np.zeros_like(x[:, :1])
    y[1] = 1
    for start, end, theta, a, d, cos, sin in _runs(machine, angles.dtype, angles.ndim):
        base, axis, run = x[:, start, None], z[:, start, None], slice(start + 1, end + 1)
        turned = np.add.accumulate(angles[start:end]) + theta
        c, s = np.cos(turned), np.sin(turned)
        x[:, run] = c * base + s * y
        z[:, run] = axis
        p[:, run] = p[:, start, None] + np.add.accumulate(a * x[:, run] + d * axis, axis=1)
        if end < machine.n or sin:  # the next run's axis is this one's, turned around x
            y = c[-1:] * y - s[-1:] * base
            y, z[:, end] = cos * y + sin * axis, (cos * axis - sin * y)[:, 0]
    return chain


def frames(machine: Machine, q: ArrayLike) -> Array:
    """Frames [1, m] of the base, each link's end and (last) the tool, (..., n + 1, 4, 4). Paper: Fig. 1"""
    x, z, p = _chain(machine, q)
    result = np.zeros((4, 4, *p.shape[1:]), p.dtype)
    result[:3] = np.stack([x, np.cross(z, x, axis=0), z, p], axis=1)
    result[3, 3] = 1.0
    return np.moveaxis(result, (0, 1, 2), (-2, -1, -3))  # from (4, 4, n + 1, ...)


def tool_position(machine: Machine, q: ArrayLike) -> Array:
    """Position of the tool tip [m], (..., 3). Paper: Fig. 1

    Example:
        >>> from brokk_min.machine import BROKK_170
        >>> x, y, z = tool_position(BROKK_170, [1.5, 0.5, 0.58, 1.71, 1.24])
        >>> round(float(np.hypot(x, y)), 2), round(float(z), 2)
        (3.05, 1.01)
    """
    return _coordinates_last(_chain(machine, q).p[:, -1])


def _columns(chain: Chain) -> Array:
    """Jacobian columns z_(i-1) x (p_tool - p_(i-1)) of all joints, (3, n, ...)."""
    z, arm = chain.z[:, :-1], chain.p[:, -1:] - chain.p[:, :-1]
    columns = np.empty_like(arm)
    columns[0] = z[1] * arm[2] - z[2] * arm[1]
    columns[1] = z[2] * arm[0] - z[0] * arm[2]
    columns[2] = z[0] * arm[1] - z[1] * arm[0]
    return columns


def jacobian(machine: Machine, q: ArrayLike) -> Array:
    """d(tool position)/d(driven angles) [m/rad], (..., 3, n_driven). Paper: eq3 (J)"""
    return tool_jacobian(machine, q)[1][..., machine.driven]


def tool_jacobian(machine: Machine, q: ArrayLike) -> tuple[Array, Array]:
    """Tool position [m] (..., 3) and its derivative by all joints' angles [m/rad] (..., 3, n)."""
    chain = _chain(machine, q)
    return _coordinates_last(chain.p[:, -1]), _coordinates_last(_columns(chain), 2)


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
    velocity = np.add.reduce(_columns(chain) * rates, axis=1)
    return _coordinates_last(chain.p[:, -1]), _coordinates_last(velocity), _lowest(chain)


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
    return damped_rates(machine, jacobian(machine, q), v)


def damped_rates(machine: Machine, J: Array, v: ArrayLike) -> Array:
    """`joint_rates` (..., n_driven) of a known Jacobian `J` [m/rad] (..., 3, n_driven)."""
    columns, v = _coordinates_first(J, 2), _coordinates_first(np.asarray(v, J.dtype))
    length = np.hypot(machine.column("a"), machine.column("d")).sum()
    damping = 1e-6 + float((0.06 * length) ** 2)
    square = np.add.reduce(columns[:, None] * columns, axis=2)  # J J^T, (3, 3, ...)
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = square
    xx, yy, zz = xx + damping, yy + damping, zz + damping
    # eliminate x, then y, and put back in
    by_x, bz_x = xy / xx, xz / xx
    yy, yz, zz = yy - by_x * xy, yz - by_x * xz, zz - bz_x * xz
    bz_y = yz / yy
    y = v[1] - by_x * v[0]
    z = (v[2] - bz_x * v[0] - bz_y * y) / (zz - bz_y * yz)
    y = y / yy - bz_y * z
    x = v[0] / xx - by_x * y - bz_x * z
    return _coordinates_last(x * columns[0] + y * columns[1] + z * columns[2])


def lowest_point(machine: Machine, q: ArrayLike) -> Array:
    """Height [m] of the lowest end of a link, (...); links are straight between their frames.

    Example:
        >>> from brokk_min.machine import BROKK_170
        >>> round(float(lowest_point(BROKK_170, [0.0, 0.0, 0.0, np.pi, 3 * np.pi / 4])), 2)
        0.95
    """
    return _lowest(_chain(machine, q))


def _lowest(chain: Chain) -> Array:
    return np.asarray(np.minimum.reduce(chain.p[2, 1:]))
