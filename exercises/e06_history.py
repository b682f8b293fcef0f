"""The history, and the velocity in it (45 minutes).

An encoder of 12 bits has steps of 1.5 mrad. Divided by 50 ms that is 0.03 rad/s, a sixth of the
slew's fastest motion. So the velocity is the slope of a straight line through the newest angles, by
least squares. It must be causal, so it may use no angle that is still to come. It pays with delay,
because the slope of `samples` angles belongs to the middle of them.

A history of one joint is an array (3, H) with rows angle, velocity, command; the newest sample is
last. After each tick the command u was sent first, then the angle q was measured. Both become the
newest sample. A history whose commands stand one sample off still trains, but it fits worse, and
nobody notices until the machine shakes. Some published environments push an
observation twice in a tick.
"""

from collections.abc import Callable

import numpy as np
from hypothesis import strategies as st

from brokk_min.actuator import append_sample, estimate_velocity
from brokk_min.machine import Array
from exercises.verdict import agree, expect

SOLUTION = "brokk_min/actuator.py: estimate_velocity, append_sample"


def velocity(q: Array, samples: int, dt: float) -> float:
    """Slope [rad/s] of the line through the newest `samples` of the angles `q` [rad] (T,)."""
    raise NotImplementedError


def append(history: Array, u: float, q: float, samples: int, dt: float) -> Array:
    """The history (3, H) one tick on, as a new array; the given one stays as it is."""
    raise NotImplementedError


def check(velocity: Callable[..., float], append: Callable[..., Array]) -> None:
    """By hand, then any angles."""
    ramp = np.array([5.0, 0.0, 0.1, 0.2, 0.3])
    expect("velocity(ramp, 4, 0.05)", velocity(ramp, 4, 0.05), 2.0, "Only the newest four count.")
    step = np.array([0.0, 0.0, 0.0, 0.1])
    why = "By hand: sum t_i q_i / sum t_i^2 with t = -0.075, -0.025, 0.025, 0.075 s"
    expect("velocity of a last step of 0.1", velocity(step, 4, 0.05), 0.6, why)
    angle = st.integers(-8, 8).map(lambda i: i / 8)
    lists = st.lists(angle, min_size=6, max_size=6).map(np.array)
    cases = st.tuples(lists, st.integers(2, 6), st.just(0.05))
    agree("velocity", velocity, lambda *case: float(estimate_velocity(*case)), cases)

    history = np.array([[0.1, 0.2, 0.3], [7.0, 8.0, 9.0], [0.4, 0.5, 0.6]])
    before = history.copy()
    after = np.asarray(append(history, 0.7, 0.5, 2, 0.1))
    expect("history that append was given", history, before, "It must stay as it is.")
    why = "The oldest sample leaves at the front."
    expect("angles after append", after[0], [0.2, 0.3, 0.5], why)
    expect("commands after append", after[2], [0.5, 0.6, 0.7], "u is the newest command.")
    why = "The newest velocity comes from the newest angles, q among them."
    expect("velocities after append", after[1], [8.0, 9.0, 2.0], why)

    def ours(q: Array, u: float, samples: int) -> Array:
        return append_sample(np.stack([q, 0 * q, q])[None], [u], np.array([0.5]), samples, 0.05)[0]

    def yours(q: Array, u: float, samples: int) -> Array:
        return append(np.stack([q, 0 * q, q]), u, 0.5, samples, 0.05)

    agree("append", yours, ours, st.tuples(lists, angle, st.integers(2, 6)))
    still = np.rint(np.linspace(0, 0.05, 40) / 0.00153) * 0.00153  # 0.026 rad/s by an encoder
    for samples in (2, 4, 8):
        slopes = [velocity(still[: i + 1], samples, 0.05) for i in range(10, 40)]
        late = (samples - 1) / 2 * 0.05
        print(f"{samples} samples: noise {np.std(slopes):.4f} rad/s, {late:.3f} s late")
