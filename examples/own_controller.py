"""Controllers of one's own: a small one, and two of the package's with dither at rest.

    brokk-min evaluate --controller examples/own_controller.py:Proportional
    brokk-min drive --controller examples/own_controller.py:Proportional --interface ...

`Proportional` is damped least squares, and valves that open in proportion to the speed: it knows
each joint's nominal speeds and dead zones, and nothing of its error. `DitheredPID` is the strongest
PID and `DitheredAgent` our agent, whose valves do not close at rest but are moved to and fro, so
little and so quickly that the joint stands. Valves that were closed answer late, and these do not.
On hydraulic valves dither is old practice (Merritt, Hydraulic Control Systems, 1967). Here it is
tried on the analytic plant alone: the commands change ten times a second, which may wear a real
valve or shake the arm, and how small they must be depends on its dead zone.
"""

import numpy as np

from brokk_min._files import SHIPPED
from brokk_min.evaluation.baselines import STRONGEST, read_gains
from brokk_min.jacobian import dls
from brokk_min.kinematics import forward_kinematics, jacobian
from brokk_min.learning.policy import load_policy
from brokk_min.machine import by_direction, limit_command, valve_command

DAMPING = 0.01  # lambda^2 [m^2]
DITHER = 12 / 127  # of full command, a little beyond the dead zone


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


class Dithered:
    """A controller whose driven valves get +DITHER and -DITHER in turn while it closes them all."""

    def __init__(self, inner, machine):
        """`inner` is any controller."""
        self.inner, self.machine = inner, machine

    def start(self, num):
        """How many ticks each has dithered, and the controller's own state."""
        return np.zeros(num, int), self.inner.start(num)

    def __call__(self, measured, state):
        """Commands u [-1, 1] (num, n), and the next state."""
        ticks, inner = state
        u, inner = self.inner(measured, inner)
        driven = self.machine.driven
        rests = ~u[:, driven].any(axis=-1)
        u = u.copy()
        u[np.ix_(rests, driven)] = np.where(ticks[rests] % 2, -DITHER, DITHER)[:, None]
        return u, (np.where(rests, ticks + 1, 0), inner)


def DitheredPID(machine, net):
    """The strongest PID, with the package's gains."""
    pids = read_gains(SHIPPED / machine.name / "gains.json", machine, net)
    return Dithered(pids[STRONGEST], machine)


def DitheredAgent(machine, net):
    """The package's policy."""
    return Dithered(load_policy(SHIPPED / machine.name / "policy.npz", machine), machine)
