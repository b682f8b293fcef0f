"""Frames and Jacobian of another arm (60 minutes).

A Denavit-Hartenberg row (a, alpha, d, theta) leads from one joint's frame to the next:

    T_i = T_{i-1} Rz(q_i + theta_i) Tz(d_i) Tx(a_i) Rx(alpha_i)

T_0 is the base, z up. The tool is at the origin p_n of the last frame. Joint i turns about
z_{i-1}, the z axis of the frame before it. So it moves the tool along the column

    J_i = z_{i-1} x (p_n - p_{i-1})

of the Jacobian. Two errors are common. The first takes an axis or an origin of frame i
instead of i - 1, and the tool is still where it should be. The second counts an angle the
other way.

The arm is the small excavator of examples/mini_excavator.py. Its boom counts positive downward,
because alpha_1 is -90 degrees. Read brokk_min/kinematics.py only afterwards.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from hypothesis import strategies as st

from brokk_min import kinematics
from brokk_min.machine import Array
from examples.mini_excavator import MINI_EXCAVATOR
from exercises.verdict import agree, expect

SOLUTION = "brokk_min/kinematics.py: forward_kinematics, tool_position, jacobian"
Row = tuple[float, float, float, float]  # a [m], alpha [rad], d [m], theta [rad]


def tool_position(rows: Sequence[Row], q: Array) -> Array:
    """Position of the tool in the base frame [m] (3,) at the angles `q` [rad] (n,)."""
    raise NotImplementedError


def jacobian(rows: Sequence[Row], q: Array) -> Array:
    """Derivative of the tool position by the angles [m/rad] (3, n) at the angles `q` [rad] (n,)."""
    raise NotImplementedError


def difference_quotients(position: Callable[..., Array], rows: Sequence[Row], q: Array) -> Array:
    """Jacobian (3, n) from positions 1e-6 rad apart."""
    step = 1e-6 * np.eye(len(q))
    columns = [(position(rows, q + d) - position(rows, q - d)) / 2e-6 for d in step]
    return np.stack(columns, axis=-1)


def our_frames(rows: Sequence[Row], q: Array) -> kinematics.Frames:
    """Frames of an arm with these rows, by the package."""
    joints = [
        replace(MINI_EXCAVATOR.joints[0], name=str(i), a=a, alpha=alpha, d=d, theta=theta)
        for i, (a, alpha, d, theta) in enumerate(rows)
    ]
    joints = [replace(joint, encoder_node=i + 1) for i, joint in enumerate(joints)]
    return kinematics.forward_kinematics(replace(MINI_EXCAVATOR, joints=tuple(joints)), q)


def check(
    tool_position: Callable[[Sequence[Row], Array], Array],
    jacobian: Callable[[Sequence[Row], Array], Array],
) -> None:
    """The excavator by hand, difference quotients, then any arm."""
    rows = [(j.a, j.alpha, j.d, j.theta) for j in MINI_EXCAVATOR.joints]
    quarter = np.pi / 2
    position = tool_position(rows, np.zeros(4))
    expect("tool, arm straight and level", position, [3.8, 0, 0.75], "0.3 + 1.8 + 1.1 + 0.6 m out")
    position = tool_position(rows, np.array([quarter, 0, 0, 0]))
    expect("tool, swing at 90 degrees", position, [0, 3.8, 0.75], "Rz turns x towards y.")
    position = tool_position(rows, np.array([0, -quarter, 0, 0]))
    expect("tool, boom at -90 degrees", position, [0.3, 0, 4.25], "It counts positive downward.")
    J = np.asarray(jacobian(rows, np.zeros(4)))
    expect("column of the swing, arm straight", J[:, 0], [0, 3.8, 0], "z_0 x (p_4 - p_0)")
    expect("column of the boom, arm straight", J[:, 1], [0, 0, -3.5], "z_1 x (p_4 - p_1)")

    number = st.integers(-8, 8).map(lambda i: i / 4)
    row = st.tuples(number, number, number, number)
    arms = st.lists(st.tuples(row, number), min_size=1, max_size=4)
    cases = arms.map(lambda arm: ([r for r, _ in arm], np.array([angle for _, angle in arm])))

    def ours(rows: Sequence[Row], q: Array) -> Array:
        return kinematics.tool_position(our_frames(rows, q))

    def slopes(rows: Sequence[Row], q: Array) -> Array:
        return difference_quotients(ours, rows, q)

    agree("tool_position", tool_position, ours, cases, "Rows are (a, alpha, d, theta).")
    agree("jacobian", jacobian, slopes, cases, "Wanted: difference quotients.", 1e-5)
    q = np.array([0.3, -0.4, 1.2, 0.7])
    wanted = kinematics.jacobian(our_frames(rows, q))
    expect("jacobian of the excavator", jacobian(rows, q), wanted)
