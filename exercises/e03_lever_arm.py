"""The lever arm of equation (1) (30 minutes).

A cylinder is the third side of a triangle. Two sides of length a and b meet at the joint's pivot
under the angle gamma. The law of cosines gives the cylinder's length c(gamma). When it grows at v
[m/s], the joint turns at

    q_dot = v / r,    r = dc/dgamma

r is the distance from the pivot to the cylinder's axis. The same valve opening gives another joint
velocity at each angle: 0.13 to 0.24 rad/s for the last joint. So no table from command to velocity
can hold, and the net must know the angle.

Derive r. Then look at where it vanishes, and why a range of a joint never goes there.
"""

from collections.abc import Callable

import numpy as np
from hypothesis import strategies as st

from brokk_min import actuator
from brokk_min.machine import BROKK_170
from exercises.verdict import agree, expect

SOLUTION = "brokk_min/actuator.py: lever_arm"


def lever_arm(a: float, b: float, gamma: float) -> float:
    """Distance r [m] of the pivot from the cylinder; sides a, b [m], angle 0 < gamma < pi [rad]."""
    raise NotImplementedError


def joint_velocity(v: float, a: float, b: float, gamma: float) -> float:
    """Velocity of the joint [rad/s] where the cylinder grows at v [m/s]."""
    raise NotImplementedError


def check(lever_arm: Callable[..., float], joint_velocity: Callable[..., float]) -> None:
    """A right-angled triangle by hand, the slope of the law of cosines, then the Brokk."""
    expect("lever_arm(3, 4, pi / 2)", lever_arm(3, 4, np.pi / 2), 2.4, "The area is 6 = 5 r / 2.")

    def slope(a: float, b: float, gamma: float) -> float:
        step = np.array([1e-6, -1e-6])
        c = np.sqrt(a**2 + b**2 - 2 * a * b * np.cos(gamma + step))
        return float((c[0] - c[1]) / 2e-6)

    side = st.integers(1, 8).map(lambda i: i / 4)
    cases = st.tuples(side, side, st.integers(2, 30).map(lambda i: i / 10))
    agree("lever_arm", lever_arm, slope, cases, "Wanted: the slope of c(gamma).", 1e-4)
    velocity = joint_velocity(0.048, 3, 4, np.pi / 2)
    expect("joint_velocity(0.048, 3, 4, pi / 2)", velocity, 0.02, "q_dot = v / r")
    joint, cylinder = BROKK_170.joints[4], actuator.BROKK_CYLINDERS["q5"]
    for q in (joint.q_min, 1.0, joint.q_max):
        gamma = cylinder.angle + q
        wanted = actuator.lever_arm(BROKK_170, np.full(5, q))[4]
        got = lever_arm(cylinder.base, cylinder.rod, gamma)
        expect(f"lever arm of q5 at {q} rad", got, wanted)
        v = actuator.cylinder_speeds(BROKK_170)[4, 0] * (80 / 127 - 0.07) / 0.93  # at the command limit
        print(f"q5 at {q:.1f} rad: r = {got:.3f} m, at 80 counts {v / got:.2f} rad/s")
