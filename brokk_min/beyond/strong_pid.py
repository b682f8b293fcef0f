"""The strongest PID that we could make: what a reviewer would give the paper's controller.

What it changes: it adds to each valve of `jacobian.JacobianController` the command that the nets
say would hold the wanted velocity (feed-forward), feeds back the integral of the tool's velocity
error, opens a valve wider that has just been closed, and closes all valves while the tool rests. So
it has the main inputs and tricks of our agent, but for the time of the Jacobian in the integral,
which does not help it, and it opens valves wider from their first command on (D11, D10 in
docs/deviations.md).

What it buys: with gains by the same optimiser its mean velocity error along x, y and z is 0.0113
m/s, where the paper's structure has 0.0195 m/s (`table.json` of `brokk-min reproduce`).

Who was first: feed-forward by an inverted static map is Merritt's (Hydraulic Control Systems,
1967); kicks against stiction are Hagglund's (2002).
"""

from dataclasses import dataclass

import numpy as np

from brokk_min.actuator import ActuatorNet
from brokk_min.beyond.interface import REST_AFTER, Memory, accumulate, smooth_angles
from brokk_min.jacobian import Gains, JacobianController, PIDState, pid
from brokk_min.machine import PWM_MAX, Array, Machine, Measured, valve_opening

ANGLES = 9  # of the static map, assumed
COMMANDS = 41  # of the static map, assumed
Kept = tuple[PIDState, Memory | None]  # what the controller keeps between ticks


@dataclass(frozen=True)
class StrongGains(Gains):
    """Gains of the controller; the last four are not the paper's."""

    min_opening: Array  # least valve opening while the tool is to move [1], (..., 1)
    integral_feedback: Array  # K_I of the error integral [1/s], (..., 1)
    start_boost: Array  # a valve closed lately opens 1 + start_boost times as wide [1], (..., 1)
    start_time: Array  # for so long after its first command [s], (..., 1)


@dataclass(frozen=True)
class StaticMap:
    """Steady velocity of each driven joint over its angle and its command."""

    q: Array  # angles [rad], evenly spaced, (n_driven, angles)
    u: Array  # commands, (commands,)
    velocity: Array  # [rad/s], rising with the command, (n_driven, angles, commands)

    def command(self, q: Array, q_dot: Array) -> Array:
        """Commands that keep joints at `q` [rad] moving at `q_dot` [rad/s], all (..., n_driven)."""
        # velocity over command at the angle q, interpolated between the angles i and i + 1
        joint = np.arange(len(self.q))
        position = (q - self.q[:, 0]) / (self.q[:, 1] - self.q[:, 0])
        i = np.clip(position.astype(int), 0, self.q.shape[1] - 2)
        weight = np.clip(position - i, 0, 1)[..., None]
        curve = (1 - weight) * self.velocity[joint, i] + weight * self.velocity[joint, i + 1]
        # command at which this curve reaches q_dot, interpolated between the commands k - 1 and k
        goal = q_dot[..., None]
        k = np.clip(np.sum(curve <= goal, axis=-1, keepdims=True), 1, len(self.u) - 1)
        slower = np.take_along_axis(curve, k - 1, axis=-1)
        faster = np.take_along_axis(curve, k, axis=-1)
        weight = np.clip((goal - slower) / np.maximum(faster - slower, 1e-6), 0, 1)
        return np.asarray(self.u[k - 1] + weight * (self.u[k] - self.u[k - 1]))[..., 0]


def static_map(machine: Machine, net: ActuatorNet) -> StaticMap:
    """Velocity at which each driven joint moves steadily, by its net, at each angle and command.

    It is the fixed point v = net(history that moves at v). A history at rest would not do, because
    nets may take its joint for one that stands at its stop.
    """
    low, high = (machine.column(end)[machine.driven] for end in ("q_min", "q_max"))
    margin = 0.05 * (high - low)  # assumed; at its stop a joint stands, whatever the command
    q = np.linspace(low + margin, high - margin, ANGLES)[:, None]  # (angles, 1, n_driven)
    fraction = np.linspace(-1, 1, COMMANDS)[:, None]
    u = fraction * machine.pwm_limit / PWM_MAX  # (commands, 1)
    v = np.where(fraction > 0, net.output_high * fraction, -net.output_low * fraction)
    v = np.tile(v, (ANGLES, 1, 1))  # (angles, commands, n_driven)
    time = np.arange(1 - net.history, 1) / net.rate
    history = np.zeros((*v.shape, 3, net.history), np.float32)
    history[..., 2, :] = u[..., None]
    for _ in range(60):  # damped, until it stands (assumed)
        history[..., 0, :] = q[..., None] + v[..., None] * time
        history[..., 1, :] = v[..., None]
        v = 0.5 * v + 0.5 * net.predict(history)
    rising = np.maximum.accumulate(v, axis=1)
    return StaticMap(q[:, 0].T, u[:, 0], rising.transpose(2, 0, 1))


@dataclass(frozen=True)
class StrongPID(JacobianController):
    """Resolved rates and one PID per joint, as in the paper, with all that we could add."""

    gains: StrongGains
    feedforward: StaticMap

    def start(self, num: int) -> Kept:  # type: ignore[override]
        """State of `num` controllers at rest."""
        return super().start(num), None

    def __call__(  # type: ignore[override]
        self, measured: Measured, state: Kept
    ) -> tuple[Array, Kept]:
        """Commands u [-1, 1] (..., n), and the state of the next tick."""
        (before, memory), m, gains = state, self.machine, self.gains
        memory = accumulate(m, memory, measured)
        q = measured.q.astype(float)
        q[..., m.driven] = smooth_angles(m, measured.history)
        v = measured.v_goal + gains.feedback * (measured.v_goal - measured.v_tool)
        v = v + gains.integral_feedback * memory.error_integral  # v_goal + K e + K_I integral(e)
        q_dot_goal = self.joint_velocities(v, q, before.q_dot_goal)
        error = q_dot_goal - measured.q_dot
        opening, after = pid(gains, error, before, m.dt)
        steady = self.feedforward.command(q[..., m.driven], q_dot_goal)
        opening = opening + valve_opening(steady, m.dead_zones[m.driven])
        u = self.command(self.widen(opening, measured, memory))
        closed = (memory.rest_ticks > REST_AFTER * m.rate)[..., None]
        frozen = self.saturated(u, opening, error) | closed
        integral = np.where(frozen, before.integral, after.integral)  # anti-windup
        after = after._replace(integral=integral, q_dot_goal=q_dot_goal)
        return np.where(closed, 0.0, u), (after, memory)

    def widen(self, opening: Array, measured: Measured, memory: Memory) -> Array:
        """Openings (..., n_driven), wider where a valve starts, at least `min_opening` in motion.

        A closed valve answers late (Sec. 3.2), so it opens wider in its first ticks.
        """
        m, gains = self.machine, self.gains
        ticks = memory.open_ticks
        starts = (ticks > 0) & (ticks * m.dt < gains.start_time)
        opening = opening * np.where(starts, 1 + gains.start_boost, 1.0)
        moving = np.linalg.norm(measured.v_goal, axis=-1, keepdims=True) > 1e-6
        size = np.maximum(np.abs(opening), moving * gains.min_opening)
        return np.where(size < 0.5 / PWM_MAX, 0.0, np.sign(opening) * size)  # below half a count
