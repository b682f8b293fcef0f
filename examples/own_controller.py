"""A controller of one's own: damped least squares, and valves opened in proportion to the speed.

    brokk-min evaluate --controller examples/own_controller.py:Proportional
    brokk-min drive --controller examples/own_controller.py:Proportional --interface ...

It knows each joint's nominal speeds and dead zones, and nothing of its error.
"""

import numpy as np

from brokk_min.jacobian import dls
from brokk_min.kinematics import forward_kinematics, jacobian
from brokk_min.machine import by_direction, limit_command, valve_command

DAMPING = 0.01  # lambda^2 [m^2]


class Proportional:
    """Any number of machines at once; it has no state."""

    def __init__(self, machine, net):
        """`net` are the nets of the driven joints, for controllers that want to predict."""
        self.machine = machine

    def start(self, num):
        """The state of `num` controllers at rest."""

    def __call__(self, measured, state):
        """Commands u [-1, 1] (num, n), and the next state."""
        m, driven = self.machine, self.machine.driven
        J = jacobian(forward_kinematics(m, measured.q))[..., driven]
        q_dot = (dls(J, np.ones(len(driven)), DAMPING) @ measured.v_goal[..., None])[..., 0]
        fastest = np.stack([m.column("q_dot_up"), m.column("q_dot_down")], axis=-1)[driven]
        u = np.zeros_like(measured.q)
        u[..., driven] = valve_command(q_dot / by_direction(q_dot, fastest), m.dead_zones[driven])
        return limit_command(m, u), state
