"""The paper's reward and its gradient (20 minutes).

The paper rewards a tick with

    r = 1 / (1 + |v_goal - v_tool|)    (equation 2)

and nothing else. Compare it with a quadratic penalty. At a small error its slope does not vanish:
the last centimetre per second still pays. At a large one it is flat: a hopeless tick costs little.

A simulation made of nets and kinematics has derivatives. To use them you need that of the reward by
the tool's velocity. Derive it. At an error of zero the reward has a tip and no derivative: return
zero there, not nan.
"""

from collections.abc import Callable

import numpy as np
from hypothesis import strategies as st

from brokk_min import env
from brokk_min.machine import Array
from exercises.verdict import agree, expect

SOLUTION = "brokk_min/env.py: reward"


def reward(v_goal: Array, v_tool: Array) -> float:
    """Equation 2 of two velocities [m/s] (3,)."""
    raise NotImplementedError


def gradient(v_goal: Array, v_tool: Array) -> Array:
    """Derivative (3,) of the reward by `v_tool` (3,) [s/m]."""
    raise NotImplementedError


def check(reward: Callable[..., float], gradient: Callable[..., Array]) -> None:
    """By hand, the package's reward, and its difference quotients."""
    zero, x = np.zeros(3), np.array([1.0, 0.0, 0.0])
    expect("reward at no error", reward(x, x), 1.0)
    expect("reward at an error of 5 m/s", reward(np.array([3.0, 4.0, 0.0]), zero), 1 / 6)
    expect("gradient at no error", gradient(x, x), zero, "Return zero there, not nan.")
    why = "1 / (1 + e)^2 = 1/4 towards the goal: more speed that way raises the reward."
    expect("gradient at an error of 1 m/s along x", gradient(x, zero), 0.25 * x, why)
    number = st.integers(-8, 8).map(lambda i: i / 8)
    vector = st.tuples(number, number, number).map(np.array)
    cases = st.tuples(vector, vector)
    agree("reward", reward, env.reward, cases)

    def slope(v_goal: Array, v_tool: Array) -> Array:
        if (v_goal == v_tool).all():
            return np.zeros(3)
        step = 1e-6 * np.eye(3)
        return (env.reward(v_goal, v_tool + step) - env.reward(v_goal, v_tool - step)) / 2e-6

    agree("gradient", gradient, slope, cases, "Wanted: difference quotients.", 1e-4)
