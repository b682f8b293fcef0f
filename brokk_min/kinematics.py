"""Hand-written Denavit-Hartenberg kinematics: frames, tool position, Jacobian, tool velocity.

`frames` multiplies the DH matrices. All else is one pass (`_chain`) from the tool back to the base, over runs
of joints with parallel axes. A run turns in a plane: the ways from its joints to its end are sums of lengths
times cosines and sines. The tool's derivative by a joint is the way there, turned by 90 degrees. All that
comes after a run is turned into its frame, then added. Arrays have the 3 coordinates first and the joints
next: few operations do the work. Results are in the base frame, z up, origin on the ground under the slew
axis; angles `q` [rad] are (..., n) and keep their float type.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from brokk_min.machine import Array, Machine, as_floats


class Chain(NamedTuple):
    """Ways from all joints to the tool, and derivatives of the tool by their angles: (3, n, ...) both."""

    levers: Array  # m
    columns: Array  # m/rad


class _Plan(NamedTuple):
    """What of a machine enters the arithmetic, in one float type; columns of `Chain` have zeros in it."""

    inner: list[int]  # joints parallel to the one before
    theta: Array  # (n, 2, 1), offsets summed from a run's first joint on [rad]; a quarter turn makes cosines
    a: Array  # (n, 1, 1) [m]
    rises: Array  # (n, 2, 1), d summed from a joint to the end of its run [m]; 0 for columns
    bends: list[
        tuple[int, int, Array]
    ]  # first joint and end of each run but the last; turn by alpha (2, 2)
    damping: float  # of `damped_rates` [m^2]


def _plan(machine: Machine, dtype: Any) -> _Plan:
    """Worked out once a machine and float type; kept with the machine."""
    kept: dict[Any, _Plan] = machine.__dict__.setdefault("plans", {})
    if dtype not in kept:
        a, alpha, d, theta = (machine.column(name) for name in ("a", "alpha", "d", "theta"))
        ends = [i + 1 for i in range(machine.n - 1) if alpha[i]]  # alpha tilts the next axis
        run = np.searchsorted(ends, np.arange(machine.n), "right")
        before = np.tri(machine.n) * (run[:, None] == run)  # joints of the same run, up to each one
        offsets, rises = (
            np.add.outer(before @ theta, [np.pi / 2, 0]),
            np.outer(before.T @ d, [1, 0]),
        )
        tilts = np.array([[np.cos(alpha), -np.sin(alpha)], [np.sin(alpha), np.cos(alpha)]], dtype)
        bends = [
            (start, end, tilts[..., end - 1]) for start, end in zip([0, *ends], ends, strict=False)
        ]
        inner, length = [i for i in range(1, machine.n) if i not in ends], np.hypot(a, d).sum()
        theta, a, rises = (
            each.reshape(machine.n, -1, 1).astype(dtype) for each in (offsets, a, rises)
        )
        kept[dtype] = _Plan(inner, theta, a, rises, bends, 1e-6 + (0.06 * length) ** 2)
    return kept[dtype]


def _joints_first(machine: Machine, q: ArrayLike, name: str = "q") -> Array:
    """Checked angles or rates as (n, ...)."""
    angles = as_floats(q)
    if angles.ndim < 1 or angles.shape[-1] != machine.n:
        raise ValueError(f"{name}: expected (..., {machine.n}), got {angles.shape}")
    return angles.transpose(-1, *range(angles.ndim - 1))  # `np.moveaxis` takes ten times as long


def _coordinates_last(array: Array, axes: int = 1) -> Array:
    """The first `axes` axes last."""
    return array.transpose(*range(axes, array.ndim), *range(axes))


def _chain(machine: Machine, q: ArrayLike) -> Chain:
    """Levers and columns, in blocks of poses whose temporary arrays fit the processor's cache."""
    angles, n = _joints_first(machine, q), machine.n
    plan, poses = _plan(machine, angles.dtype), angles.reshape(n, -1)
    result = np.empty((3, n, 2, poses.shape[1]), poses.dtype)
    block = 8192 // poses.itemsize
    for i in range(0, poses.shape[1], block):
        _fill(plan, poses[:, i : i + block], result[..., i : i + block])
    result = result.reshape(3, n, 2, *angles.shape[1:])
    return Chain(result[:, :, 0], result[:, :, 1])


def _fill(plan: _Plan, angles: Array, result: Array) -> None:
    """Write levers and columns (3, n, 2, poses) for `angles` (n, poses): each run alone, then backwards."""
    summed = angles.copy()
    for i in plan.inner:
        summed[i] += summed[i - 1]
    turns = _turns(summed, plan.theta)
    links = plan.a * turns
    for i in reversed(plan.inner):
        links[i - 1] += links[i]
    levers, columns = result[:, :, 0], result[:, :, 1]
    levers[0], levers[1], result[2] = links[:, 0], links[:, 1], plan.rises
    columns[0], columns[1] = -links[:, 1], links[:, 0]
    for start, end, tilt in reversed(plan.bends):
        later, (c, s) = result[:, end:], turns[end - 1]
        x = later[0]
        y, later[2] = (tilt @ later[1:].reshape(2, -1)).reshape(2, *x.shape)  # Rx(alpha)
        later[1], later[0] = s * x + c * y, c * x - s * y  # Rz
        x, y, _ = way = later[:, :1, 0]
        levers[:, start:end] += way
        columns[0, start:end] -= y
        columns[1, start:end] += x


def _turns(angles: Array, theta: Array) -> Array:
    """Cosines and sines (n, 2, poses) of `angles` (n, poses) and the offsets of `_Plan`.

    In float32 NumPy works out many sines at once, in float64 one by one, but there many tangents at once.
    """
    if angles.dtype == np.float32:
        return np.asarray(np.sin(angles[:, None] + theta))
    tangent = np.tan((angles + theta[:, 1]) / 2)
    share = 2 / (1 + tangent * tangent)
    return np.stack([share - 1, tangent * share], axis=1)


def frames(machine: Machine, q: ArrayLike) -> Array:
    """Frames [1, m] of the base, each link's end and (last) the tool, (..., n + 1, 4, 4). Paper: Fig. 1"""
    angles = _joints_first(machine, q)
    result, turns = np.zeros((2, machine.n + 1, *angles.shape[1:], 4, 4), angles.dtype)
    result[0] = turns[:] = np.eye(4)
    for i, joint in enumerate(machine.joints):
        c, s = np.cos(angles[i] + joint.theta), np.sin(angles[i] + joint.theta)
        cos, sin = np.cos(joint.alpha), np.sin(joint.alpha)
        turns[i, ..., 0, 0], turns[i, ..., 0, 1], turns[i, ..., 1, 0], turns[i, ..., 1, 1] = (
            c,
            -s,
            s,
            c,
        )
        row = [[1, 0, 0, joint.a], [0, cos, -sin, 0], [0, sin, cos, joint.d], [0, 0, 0, 1]]
        result[i + 1] = result[i] @ turns[i] @ np.array(row, angles.dtype)
    return np.moveaxis(result, 0, -3)


def tool_position(machine: Machine, q: ArrayLike) -> Array:
    """Position of the tool tip [m], (..., 3). Paper: Fig. 1

    Example:
        >>> from brokk_min.machine import BROKK_170
        >>> x, y, z = tool_position(BROKK_170, [1.5, 0.5, 0.58, 1.71, 1.24])
        >>> round(float(np.hypot(x, y)), 2), round(float(z), 2)
        (3.05, 1.01)
    """
    return _coordinates_last(_chain(machine, q).levers[:, 0])


def jacobian(machine: Machine, q: ArrayLike) -> Array:
    """d(tool position)/d(driven angles) [m/rad], (..., 3, n_driven). Paper: eq3 (J)"""
    return tool_jacobian(machine, q)[1][..., machine.driven]


def tool_jacobian(machine: Machine, q: ArrayLike) -> tuple[Array, Array]:
    """Tool position [m] (..., 3) and its derivative by all joints' angles [m/rad] (..., 3, n)."""
    chain = _chain(machine, q)
    return _coordinates_last(chain.levers[:, 0]), _coordinates_last(chain.columns, 2)


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
    velocity = np.add.reduce(chain.columns * rates, axis=1)
    return _coordinates_last(chain.levers[:, 0]), _coordinates_last(velocity), _lowest(chain)


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
    columns, v = np.ascontiguousarray(J.T), np.ascontiguousarray(np.transpose(v), J.dtype)
    square = np.add.reduce(columns[:, None] * columns[:, :, None])  # J J^T, (3, 3, ...)
    square.reshape(9, -1)[::4] += _plan(machine, J.dtype).damping
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = square
    # eliminate x, then y, and put back in
    by_x, bz_x = xy / xx, xz / xx
    yy, yz, zz = yy - by_x * xy, yz - by_x * xz, zz - bz_x * xz
    bz_y = yz / yy
    y = v[1] - by_x * v[0]
    z = (v[2] - bz_x * v[0] - bz_y * y) / (zz - bz_y * yz)
    y = y / yy - bz_y * z
    x = v[0] / xx - by_x * y - bz_x * z
    return np.asarray(x * columns[:, 0] + y * columns[:, 1] + z * columns[:, 2]).T


def lowest_point(machine: Machine, q: ArrayLike) -> Array:
    """Height [m] of the lowest end of a link, (...); links are straight between their frames.

    Example:
        >>> from brokk_min.machine import BROKK_170
        >>> round(float(lowest_point(BROKK_170, [0.0, 0.0, 0.0, np.pi, 3 * np.pi / 4])), 2)
        0.95
    """
    return _lowest(_chain(machine, q))


def _lowest(chain: Chain) -> Array:
    rises = chain.levers[
        2
    ]  # the first from the ground; links end in the joints after it and in the tool
    return np.asarray(rises[0] - np.maximum.reduce(rises[1:], initial=0))
