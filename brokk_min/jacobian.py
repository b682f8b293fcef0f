"""The classical way: weighted damped least squares for joint rates, a PID a joint for the valves.

Read in the order of the computation: `dls` and its weights and damping give joint rates (paper eq3,
eq4), `JacobianController` turns them into commands; `baselines` tunes it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from brokk_min.actuator import ActuatorNet
from brokk_min.kinematics import jacobian
from brokk_min.machine import PWM_MAX, Array, Machine, limit_command, valve_opening
from brokk_min.observation import Measured, measured


def dls(J: ArrayLike, W: ArrayLike, damping: ArrayLike, as_printed: bool = False) -> Array:
    """Weighted damped pseudo-inverse W^-1 J^T (J W^-1 J^T + lambda^2 I)^-1, (..., n, 3).

    It minimises |J q_dot - v|^2 + lambda^2 q_dot^T W q_dot. The paper prints J W J^T inside the
    bracket; that form is the minimiser only for W = I and is kept as `as_printed`. Paper: eq4

    Args:
        J: Jacobian [m/rad], (..., 3, n).
        W: diagonal of the weight matrix, (..., n), positive.
        damping: lambda^2, (...).
        as_printed: use the paper's printed form.
    """
    J, W = np.asarray(J), np.asarray(W)
    inner = (W if as_printed else 1 / W)[..., None, :]
    square = (J * inner) @ np.swapaxes(J, -1, -2) + np.asarray(damping)[..., None, None] * np.eye(3)
    return np.swapaxes(np.linalg.solve(square, J / W[..., None, :]), -1, -2)


def limit_gradient(machine: Machine, q: ArrayLike) -> Array:
    """Slope by each angle `q` [rad] of Chan and Dubey's joint-limit function, (..., n).

    The function is the sum over joints of (q_max - q_min)^2 / (4 (q_max - q) (q - q_min)).
    """
    low, high = machine.column("q_min"), machine.column("q_max")
    edge = 1e-3 * (high - low)  # finite at the limits and beyond
    q = np.clip(q, low + edge, high - edge)
    gradient: Array = (high - low) ** 2 * (2 * q - high - low) / (4 * ((high - q) * (q - low)) ** 2)
    return gradient


def limit_weights(machine: Machine, q: ArrayLike, q_dot: ArrayLike) -> Array:
    """Diagonal of W for all joints, (..., n): 1 + |gradient| while nearing a limit, otherwise 1.

    `q` are angles [rad], `q_dot` rates whose sign tells the direction. Paper: Sec. 4.2 (W)
    """
    gradient = limit_gradient(machine, q)
    return np.where(gradient * np.asarray(q_dot) > 0, 1 + np.abs(gradient), 1.0)


def manipulability(J: ArrayLike) -> Array:
    """sqrt(det(J J^T)) of Jacobians (..., 3, n); 0 at a singularity. Shape (...)."""
    J = np.asarray(J)
    return np.asarray(np.sqrt(np.maximum(np.linalg.det(J @ np.swapaxes(J, -1, -2)), 0.0)))


def nakamura_damping(w: ArrayLike, w0: float, k: float) -> Array:
    """lambda^2 = k (1 - w/w0)^2 below the manipulability `w0`, otherwise 0. Paper: Sec. 4.2 (lambda)

    Example:
        >>> nakamura_damping([0.0, 0.5, 1.0, 2.0], 1.0, 0.1)
        array([0.1  , 0.025, 0.   , 0.   ])
    """
    return k * np.maximum(0.0, 1 - np.asarray(w) / w0) ** 2


def manipulability_threshold(machine: Machine) -> float:
    """w0: a quarter of the largest manipulability over random poses (assumed)."""
    low, high = machine.column("q_min"), machine.column("q_max")
    poses = np.random.default_rng(0).uniform(low, high, (2000, machine.n))
    return 0.25 * float(manipulability(jacobian(machine, poses)).max()) + 1e-9


# --- from joint rates to valves ---------------------------------------------------------------------

# Ranges that `baselines.tune` searches (assumed); of the first three each driven joint has its own.
GAINS = {
    "kp": (0.0, 4.0),  # valve opening per rad/s
    "ki": (0.0, 12.0),  # valve opening per rad
    "kd": (0.0, 0.3),  # valve opening per rad/s^2
    "feedback": (0.0, 1.0),  # K = feedback * I of eq3
    "ready": (0.0, 0.04),  # least valve opening while the tool is to move, or always
}


def split_gains(gains: ArrayLike) -> dict[str, Array]:
    """Gains by name, (..., n_driven) or (..., 1) each, from vectors (..., 3 n_driven + 2).

    Example:
        >>> {name: gain.tolist() for name, gain in split_gains([1, 2, 3, 4, 5, 6, 7, 8]).items()}
        {'kp': [1, 2], 'ki': [3, 4], 'kd': [5, 6], 'feedback': [7], 'ready': [8]}
    """
    gains = np.asarray(gains)
    joints = (gains.shape[-1] - 2) // 3
    parts = np.split(gains, [joints, 2 * joints, 3 * joints, 3 * joints + 1], axis=-1)
    return dict(zip(GAINS, parts, strict=True))


def join_gains(machine: Machine, named: Mapping[str, ArrayLike]) -> Array:
    """`split_gains` turned round for a single vector; one number stands for all joints.

    ValueError: another number of gains, or not finite ones.
    """
    sizes = [len(machine.driven)] * 3 + [1, 1]
    pairs = zip(GAINS, sizes, strict=True)
    gains = np.concatenate(
        [np.broadcast_to(np.asarray(named[name], float), size) for name, size in pairs]
    )
    if not np.isfinite(gains).all():
        raise ValueError(f"gains: expected finite numbers, got {gains}")
    return gains


class Memory(NamedTuple):
    """What the controller remembers between ticks, (..., n_driven) each."""

    integral: Array  # valve opening
    error: Array  # last rate error [rad/s]
    slope: Array  # filtered derivative of the error [rad/s^2]
    rate: Array  # last wanted joint rates [rad/s]


@dataclass(frozen=True)
class SteadyMap:
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


def steady_map(machine: Machine, net: ActuatorNet) -> SteadyMap:
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
    return SteadyMap(q[:, 0].T, u, rising)


@dataclass(frozen=True)
class JacobianController:
    """Observation in, command out: resolved rates (eq3), then a PID a joint.

    Paper: eq3, Sec. 4.2

    The PID acts on the valve opening beyond the dead zone; the dead zone is added after it, and the
    integral stops where the command saturates. With `feedforward`, the steady command of the nets
    for the wanted rate is added. While the tool is to move, no valve goes below the opening `ready`:
    one that has gone idle answers late (paper Sec. 3.2). With `awake`, not even while it is to stand.
    """

    machine: Machine
    gains: Array  # see `GAINS`: (3 n_driven + 2,), or a row for each machine that is driven
    k: float  # of Nakamura's damping
    w0: float  # manipulability below which damping sets in
    feedforward: SteadyMap | None = None
    awake: bool = False

    def start(self, num: int) -> Memory:
        """Memory of `num` controllers at rest."""
        zero = np.zeros((num, len(self.machine.driven)))
        return Memory(zero, zero, zero, zero)

    def rates(self, seen: Measured, last: Array) -> Array:
        """Wanted rates of the driven joints [rad/s], (..., n_driven); `last`: a tick ago. Paper: eq3"""
        m, driven = self.machine, self.machine.driven
        J, towards = jacobian(m, seen.q), np.zeros_like(seen.q)
        towards[..., driven] = last
        W = limit_weights(m, seen.q, towards)[..., driven]
        inverse = dls(J, W, nakamura_damping(manipulability(J), self.w0, self.k))
        feedback = split_gains(self.gains)["feedback"] * (seen.v_goal - seen.v_tool)
        rate = (inverse @ (seen.v_goal + feedback)[..., None])[..., 0]
        fastest = np.where(rate > 0, m.column("q_dot_up")[driven], m.column("q_dot_down")[driven])
        excess = np.max(np.abs(rate) / fastest, axis=-1, keepdims=True)
        return np.asarray(rate / np.maximum(1.0, excess))  # slower, but in the same direction

    def __call__(self, observation: Array, memory: Memory) -> tuple[Array, Memory]:
        """Commands u (..., n) for observations (..., obs) of `observation.observe`, and the next memory."""
        m, g = self.machine, split_gains(self.gains)
        seen = measured(m, observation.astype(float))
        rate = self.rates(seen, memory.rate)
        error = rate - seen.q_dot
        slope = 0.7 * memory.slope + 0.3 * (error - memory.error) * m.rate
        opening = g["kp"] * error + memory.integral + g["kd"] * slope
        if self.feedforward is not None:
            opening += valve_opening(
                self.feedforward.command(seen.q[..., m.driven], rate), m.dead_zone
            )
        room = valve_opening(m.pwm_limit / PWM_MAX, m.dead_zone)
        winding = (np.abs(opening) >= room) & (np.sign(opening) == np.sign(error))
        integral = memory.integral + np.where(winding, 0.0, g["ki"] * error * m.dt)
        moving = np.linalg.norm(seen.v_goal, axis=-1, keepdims=True) > 1e-6
        size = np.maximum(np.abs(opening), (moving | self.awake) * g["ready"])
        size = (size >= 0.5 / PWM_MAX) * (
            m.dead_zone + (1 - m.dead_zone) * size
        )  # below half a count: idle
        u = np.zeros((*opening.shape[:-1], m.n))
        u[..., m.driven] = np.sign(opening) * size
        return limit_command(m, u), Memory(integral, error, slope, rate)
