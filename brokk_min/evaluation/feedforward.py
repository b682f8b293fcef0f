"""Feed-forward for the PIDs: the nets' static map from command to joint velocity, inverted."""

from dataclasses import dataclass

import numpy as np

from brokk_min.actuator import ActuatorNet
from brokk_min.machine import PWM_MAX, Array, Machine

ANGLES = 9  # of the map, assumed
COMMANDS = 41  # of the map, assumed


@dataclass(frozen=True)
class StaticMap:
    """Steady velocity of each driven joint over its angle and its command."""

    q: Array  # angles [rad], evenly spaced, (n_driven, angles)
    u: Array  # commands, (commands,)
    velocity: Array  # [rad/s], rising with the command, (n_driven, angles, commands)

    def command(self, q: Array, q_dot: Array) -> Array:
        """Commands that keep driven joints at `q` [rad] moving at `q_dot` [rad/s], (..., n)."""
        # velocity over command at the angle q, interpolated between the angles i and i + 1
        joint = np.arange(len(self.q))
        position = (q - self.q[:, 0]) / (self.q[:, 1] - self.q[:, 0])
        i = np.clip(position.astype(int), 0, self.q.shape[1] - 2)
        weight = np.clip(position - i, 0, 1)[..., None]
        curve = (1 - weight) * self.velocity[joint, i] + weight * self.velocity[joint, i + 1]
        # command at which this curve reaches q_dot, interpolated between the commands k - 1 and k
        goal = q_dot[..., None]
        k = np.sum(curve <= goal, axis=-1, keepdims=True)
        k = np.clip(k, 1, len(self.u) - 1)
        slower = np.take_along_axis(curve, k - 1, axis=-1)
        faster = np.take_along_axis(curve, k, axis=-1)
        weight = np.clip((goal - slower) / np.maximum(faster - slower, 1e-6), 0, 1)
        return np.asarray(self.u[k - 1] + weight * (self.u[k] - self.u[k - 1]))[..., 0]


def static_map(machine: Machine, net: ActuatorNet) -> StaticMap:
    """Velocity at which each driven joint moves steadily, by its net, at each angle and command.

    It moves alone, the others rest in the middle of their ranges: nets that share latents know
    the pump and the weight that joints share.
    It is the fixed point v = net(history that moves at v). A history at rest would not do: nets
    may take its joint for one that stands at its stop.
    """
    low = machine.column("q_min")[machine.driven]
    high = machine.column("q_max")[machine.driven]
    margin = 0.05 * (high - low)  # assumed; at its stop a joint stands, whatever the command
    q = np.linspace(low + margin, high - margin, ANGLES)[:, None]  # (angles, 1, n_driven)
    fraction = np.linspace(-1, 1, COMMANDS)[:, None]
    u = fraction * machine.pwm_limit / PWM_MAX  # (commands, 1)
    v = np.where(fraction > 0, net.output_high * fraction, -net.output_low * fraction)
    alone = np.eye(len(low))[:, None, None]  # the joint that moves, by joint
    v = alone * np.tile(v, (ANGLES, 1, 1))  # (moving, angles, commands, n_driven)
    time = np.arange(1 - net.history, 1) / net.rate
    history = np.zeros((*v.shape, 3, net.history), np.float32)
    history[..., 2, :] = (alone * u)[..., None]
    for _ in range(60):
        at = np.where(alone, q, (low + high) / 2)
        history[..., 0, :] = at[..., None] + v[..., None] * time
        history[..., 1, :] = v[..., None]
        v = alone * (0.5 * v + 0.5 * net.predict(history))
    rising = np.maximum.accumulate(v.sum(axis=-1), axis=-1)
    return StaticMap(q[:, 0].T, u[:, 0], rising)
