"""A plant of one's own in the place of the analytic one: `reset` and `step`, by SciPy's integrator.

It plays the machine of mini_excavator.py by other equations. The dead zones differ by joint and
direction, and the joints are of second order and slower towards the ends of their range. All
numbers are assumed.

    brokk-min collect --machine mini_excavator.py:MINI_EXCAVATOR --plant own_plant.py:PLANT --out log.npz
"""  # noqa: E501

from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

Q_MIN = np.array([-3.0, -1.1, 0.45, -0.2])  # rad
Q_MAX = np.array([3.0, 0.6, 2.5, 2.0])
Q_DOT_UP = np.array([0.50, 0.61, 0.72, 1.14])  # rad/s at u = 1
Q_DOT_DOWN = np.array([0.50, 0.41, 0.60, 1.26])
DEAD_UP = np.array([0.12, 0.13, 0.15, 0.14])  # of full command
DEAD_DOWN = np.array([0.14, 0.18, 0.13, 0.12])
TAU = 0.12  # s


class State(NamedTuple):
    """What the plant needs to go on; any attributes besides `q` are its own."""

    q: np.ndarray  # angle [rad], (..., 4)
    q_dot: np.ndarray  # rad/s
    spool: np.ndarray  # -1..1


class OwnPlant:
    """Any number of machines at once: arrays (..., 4)."""

    def reset(self, machine, q):
        """Machines at rest at the angles `q` [rad]; a real one would drive there."""
        return State(q, np.zeros_like(q), np.zeros_like(q))

    def step(self, machine, state, u):
        """The state after one tick of `machine.dt` seconds under the held commands `u` [-1, 1]."""
        up = np.maximum(u - DEAD_UP, 0) / (1 - DEAD_UP)
        down = np.maximum(-u - DEAD_DOWN, 0) / (1 - DEAD_DOWN)
        now = np.stack(state)

        def derivative(_, y):
            q, q_dot, spool = y.reshape(now.shape)
            fastest = np.where(spool > 0, Q_DOT_UP, Q_DOT_DOWN)
            middle = (2 * q - Q_MAX - Q_MIN) / (Q_MAX - Q_MIN)  # -1 and 1 at the ends
            wanted = fastest * spool * (1 - 0.3 * middle**2)
            return np.stack([q_dot, (wanted - q_dot) / TAU, (up - down - spool) / TAU]).ravel()

        y = solve_ivp(derivative, (0, machine.dt), now.ravel(), rtol=1e-3, atol=1e-6).y[:, -1]
        q, q_dot, spool = y.reshape(now.shape)
        at_stop = (q <= Q_MIN) | (q >= Q_MAX)
        return State(np.clip(q, Q_MIN, Q_MAX), np.where(at_stop, 0, q_dot), spool)


PLANT = OwnPlant()
