"""Feed-forward for the PIDs: the static map of the nets from command to joint velocity, inverted."""

from dataclasses import dataclass

import numpy as np

from brokk_min.actuator import ActuatorNet
from brokk_min.machine import PWM_MAX, Array, Machine


@dataclass(frozen=True)
class StaticMap:
    """Steady joint velocity over angle and command as the nets know it; inverted for feed-forward."""

    q: Array  # (n_driven, a) angles [rad], evenly spaced
    u: Array  # (c,) commands
    velocity: Array  # (n_driven, a, c) [rad/s], rising along c

    def command(self, q: Array, q_dot: Array) -> Array:
        """Command that keeps driven joints at `q` moving at `q_dot` (..., n_driven)."""
        j = np.arange(len(self.q))
        place = (q - self.q[:, 0]) / (self.q[:, 1] - self.q[:, 0])
        row = np.clip(place.astype(int), 0, self.q.shape[1] - 2)
        part = np.clip(place - row, 0, 1)[..., None]
        curve = (1 - part) * self.velocity[j, row] + part * self.velocity[j, row + 1]
        last = np.clip((curve <= q_dot[..., None]).sum(-1), 1, len(self.u) - 1)[..., None]
        low, high = (np.take_along_axis(curve, last - i, -1) for i in (1, 0))
        share = np.clip((q_dot[..., None] - low) / np.maximum(high - low, 1e-6), 0, 1)
        command: Array = (self.u[last - 1] + share * (self.u[last] - self.u[last - 1]))[..., 0]
        return command


def static_map(machine: Machine, net: ActuatorNet) -> StaticMap:
    """Ask the nets how fast each driven joint moves steadily under each command at each angle."""
    angles, commands = 9, 41  # assumed
    low, high = machine.column("q_min")[machine.driven], machine.column("q_max")[machine.driven]
    inset = 0.05 * (
        high - low
    )  # assumed; at the very end a stop holds the joint, whatever the command
    q = np.linspace(low + inset, high - inset, angles)[:, None]  # (a, 1, n)
    u = np.linspace(-1, 1, commands) * machine.pwm_limit / PWM_MAX
    history = np.zeros((angles, commands, len(low), 3, net.history), np.float32)
    history[..., 2, :] = u[:, None, None]
    lags, share = np.arange(1 - net.history, 1) / net.rate, np.linspace(-1, 1, commands)[:, None]
    moving = np.where(share > 0, net.output_high * share, -net.output_low * share)
    velocity = np.tile(
        moving, (angles, 1, 1)
    )  # from rest they might see a joint that stands at its stop
    for _ in range(60):  # fixed point: a history that moves as fast as the nets say it does
        history[..., 0, :] = q[..., None] + velocity[..., None] * lags
        history[..., 1, :] = velocity[..., None]
        velocity = 0.5 * velocity + 0.5 * net.predict(history)
    rising = np.maximum.accumulate(velocity.transpose(2, 0, 1), axis=-1)
    return StaticMap(q[:, 0].T, u, rising)
