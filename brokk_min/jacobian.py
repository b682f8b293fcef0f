"""The classical way: weighted damped least squares for joint rates, a PID a joint for the valves.

Read in the order of the computation: `dls` and its weights and damping give joint rates (paper eq3,
eq4), `JacobianController` turns them into commands, `tune` finds its gains on the machine.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import differential_evolution
from tqdm import tqdm

from brokk_min.actuator import ActuatorNet
from brokk_min.env import measured
from brokk_min.kinematics import jacobian
from brokk_min.machine import PWM_MAX, Machine, limit_command

Array = NDArray[np.floating[Any]]


def dls(J: ArrayLike, W: ArrayLike, damping: ArrayLike, as_printed: bool = False) -> Array:
    """Weighted damped pseudo-inverse W^-1 J^T (J W^-1 J^T + lambda^2 I)^-1.

    It minimises |J q_dot - v|^2 + lambda^2 q_dot^T W q_dot. The paper prints J W J^T inside the
    bracket; that form is the minimiser only for W = I and is kept as `as_printed`.

    Paper: eq4

    Args:
        J: Jacobian [m/rad], shape (..., 3, n).
        W: diagonal of the weight matrix, shape (..., n), positive.
        damping: lambda^2, shape (...).
        as_printed: use the paper's printed form.

    Returns:
        Shape (..., n, 3).
    """
    J, W = np.asarray(J), np.asarray(W)
    Jt = np.swapaxes(J, -1, -2)
    inner = W if as_printed else 1 / W
    square = (J * inner[..., None, :]) @ Jt + np.asarray(damping)[..., None, None] * np.eye(3)
    return np.swapaxes(np.linalg.solve(square, J / W[..., None, :]), -1, -2)


def limit_gradient(machine: Machine, q: ArrayLike) -> Array:
    """Gradient of Chan and Dubey's joint-limit function by each angle, shape (..., n) of `q` [rad].

    Sum over joints of (q_max - q_min)^2 / (4 (q_max - q) (q - q_min)). Paper: Sec. 4.2 (W)
    """
    low, high = machine.column("q_min"), machine.column("q_max")
    edge = 1e-3 * (high - low)
    q = np.clip(q, low + edge, high - edge)
    gradient: Array = (high - low) ** 2 * (2 * q - high - low) / (4 * ((high - q) * (q - low)) ** 2)
    return gradient


def limit_weights(machine: Machine, q: ArrayLike, q_dot: ArrayLike) -> Array:
    """Diagonal of W for all joints (..., n): 1 + |gradient| while nearing a limit, otherwise 1.

    Paper: Sec. 4.2 (W, Chan and Dubey)

    Args:
        machine: n joints.
        q: angles [rad], (..., n).
        q_dot: rates whose sign tells the direction, (..., n).
    """
    gradient = limit_gradient(machine, q)
    return np.where(gradient * np.asarray(q_dot) > 0, 1 + np.abs(gradient), 1.0)


def manipulability(J: ArrayLike) -> Array:
    """sqrt(det(J J^T)) of Jacobians (..., 3, n); 0 at a singularity. Shape (...)."""
    J = np.asarray(J)
    return np.sqrt(np.maximum(np.linalg.det(J @ np.swapaxes(J, -1, -2)), 0.0))


def nakamura_damping(w: ArrayLike, w0: float, k: float) -> Array:
    """lambda^2 = k (1 - w/w0)^2 below the manipulability `w0`, otherwise 0.

    Paper: Sec. 4.2 (k = 0.1 and 0.05)

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


class Gains(NamedTuple):
    """PID gains of the driven joints, (..., n_driven) each, and the feedback K = feedback * I (...)."""

    kp: Array  # valve opening per rad/s
    ki: Array  # valve opening per rad
    kd: Array  # valve opening per rad/s^2
    feedback: Array  # K of eq3, 1


class Memory(NamedTuple):
    """What the controller remembers between ticks, (..., n_driven) each."""

    integral: Array  # valve opening
    error: Array  # last rate error [rad/s]
    slope: Array  # filtered derivative of the error [rad/s^2]
    rate: Array  # last wanted joint rates [rad/s]


@dataclass(frozen=True)
class SteadyMap:
    """Steady joint velocity over angle and command as the nets know it; inverted for feed-forward."""

    q: Array  # (n_driven, a) angles [rad]
    u: Array  # (c,) commands
    velocity: Array  # (n_driven, a, c) [rad/s], rising along c

    def command(self, q: Array, q_dot: Array) -> Array:
        """Command that keeps driven joints at `q` moving at `q_dot` (..., n_driven)."""
        j = np.arange(len(self.q))
        place = (q - self.q[:, 0]) / (self.q[:, 1] - self.q[:, 0])
        row = np.clip(place.astype(int), 0, self.q.shape[1] - 2)
        part = np.clip(place - row, 0, 1)[..., None]
        curve = (1 - part) * self.velocity[j, row] + part * self.velocity[j, row + 1]
        last = np.clip((curve <= q_dot[..., None]).sum(-1), 1, len(self.u) - 1)
        low = np.take_along_axis(curve, last[..., None] - 1, -1)[..., 0]
        high = np.take_along_axis(curve, last[..., None], -1)[..., 0]
        fraction = np.clip((q_dot - low) / np.maximum(high - low, 1e-6), 0, 1)
        command: Array = self.u[last - 1] + fraction * (self.u[last] - self.u[last - 1])
        return command


def steady_map(machine: Machine, net: ActuatorNet, angles: int = 9, commands: int = 41) -> SteadyMap:
    """Ask the nets how fast each driven joint moves steadily under each command at each angle."""
    low, high = machine.column("q_min")[machine.driven], machine.column("q_max")[machine.driven]
    q = np.linspace(low, high, angles, axis=-1)  # (n, a)
    u = np.linspace(-1, 1, commands) * machine.pwm_limit / PWM_MAX
    at = np.broadcast_to(q[:, :, None], (len(low), angles, commands)).transpose(1, 2, 0)
    history = np.zeros((angles, commands, len(low), 3, net.history), np.float32)
    history[..., 2, :] = u[:, None, None]
    velocity, lags = np.zeros(at.shape), np.arange(1 - net.history, 1) / net.rate
    for _ in range(60):  # fixed point: a history that moves as fast as the nets say it does
        history[..., 0, :] = at[..., None] + velocity[..., None] * lags
        history[..., 1, :] = velocity[..., None]
        velocity = 0.5 * velocity + 0.5 * net.predict(history)
    rising = np.maximum.accumulate(velocity.transpose(2, 0, 1), axis=-1)
    return SteadyMap(q, u, rising)


@dataclass(frozen=True)
class JacobianController:
    """Observation in, command out: resolved rates (eq3), then a PID a joint.

    Paper: eq3, Sec. 4.2

    The PID acts on the valve opening beyond the dead zone; the dead zone is added after it, and the
    integral stops where the command saturates. With `feedforward`, the steady command of the nets
    for the wanted rate is added.
    """

    machine: Machine
    gains: Gains
    k: float  # of Nakamura's damping
    w0: float  # manipulability below which damping sets in
    feedforward: SteadyMap | None = None

    def start(self, num: int) -> Memory:
        """Memory of `num` controllers at rest."""
        zero = np.zeros((num, len(self.machine.driven)))
        return Memory(zero, zero, zero, zero)

    def rates(self, observation: Array, last: Array) -> tuple[Array, Array]:
        """Wanted and measured rates of the driven joints [rad/s] (..., n_driven). Paper: eq3"""
        m, driven = self.machine, self.machine.driven
        seen = measured(m, observation.astype(float))
        J = jacobian(m, seen.q)
        towards = np.zeros_like(seen.q)
        towards[..., driven] = last
        W = limit_weights(m, seen.q, towards)[..., driven]
        inverse = dls(J, W, nakamura_damping(manipulability(J), self.w0, self.k))
        feedback = self.gains.feedback[..., None] * (seen.v_goal - seen.v_tool)
        rate = (inverse @ (seen.v_goal + feedback)[..., None])[..., 0]
        fastest = np.where(rate > 0, m.column("q_dot_up")[driven], m.column("q_dot_down")[driven])
        excess = np.max(np.abs(rate) / fastest, axis=-1, keepdims=True)
        return rate / np.maximum(1.0, excess), seen.q_dot  # slower, but in the same direction

    def __call__(self, observation: Array, memory: Memory) -> tuple[Array, Memory]:
        """Commands u (..., n) for observations (..., obs) of `env.observe`, and the next memory."""
        m, g = self.machine, self.gains
        rate, q_dot = self.rates(observation, memory.rate)
        error = rate - q_dot
        slope = 0.7 * memory.slope + 0.3 * (error - memory.error) * m.rate
        opening = g.kp * error + memory.integral + g.kd * slope
        if self.feedforward is not None:
            q = measured(m, observation).q[..., m.driven]
            steady = self.feedforward.command(q, rate)
            opening += np.sign(steady) * np.maximum(0, (np.abs(steady) - m.dead_zone) / (1 - m.dead_zone))
        room = (m.pwm_limit / PWM_MAX - m.dead_zone) / (1 - m.dead_zone)
        winding = (np.abs(opening) >= room) & (np.sign(opening) == np.sign(error))
        integral = memory.integral + np.where(winding, 0.0, g.ki * error * m.dt)
        small = np.abs(opening) < 0.5 / PWM_MAX  # less than half a count: idle, not dead zone plus noise
        u = np.zeros((*opening.shape[:-1], m.n))
        u[..., m.driven] = np.where(
            small, 0.0, np.sign(opening) * (m.dead_zone + (1 - m.dead_zone) * np.abs(opening))
        )
        return limit_command(m, u), Memory(integral, error, slope, rate)


# --- tuning -----------------------------------------------------------------------------------------

BOUNDS = {"kp": (0.0, 4.0), "ki": (0.0, 12.0), "kd": (0.0, 0.3), "feedback": (0.0, 1.0)}  # assumed


def unpack_gains(vector: ArrayLike, joints: int) -> Gains:
    """Gains from vectors (..., 3 joints + 1) of the optimiser."""
    vector = np.asarray(vector)
    kp, ki, kd = (vector[..., i * joints : (i + 1) * joints] for i in range(3))
    return Gains(kp, ki, kd, vector[..., -1])


def tune(
    controller: JacobianController,
    cost: Callable[[JacobianController, int], Array],
    seed: int,
    generations: int,
    label: str,
) -> JacobianController:
    """The controller with the gains of least cost, by SciPy's differential evolution.

    Args:
        controller: whose gains are to be found.
        cost: cost (candidates,) of a controller whose gains have a leading axis of candidates.
        seed: of the search.
        generations: of the search.
        label: shown at the progress bar.
    """
    joints = len(controller.machine.driven)
    bounds = [BOUNDS[name] for name in ("kp", "ki", "kd") for _ in range(joints)] + [BOUNDS["feedback"]]

    def objective(vectors: Array) -> Array:
        gains = unpack_gains(vectors.T, joints)
        return cost(replace(controller, gains=gains), vectors.shape[1])

    with tqdm(total=generations, desc=f"tune {label}", unit="generation", disable=None) as bar:
        result = differential_evolution(
            objective,
            bounds,
            maxiter=generations,
            popsize=4,
            seed=seed,
            tol=0,
            polish=False,
            vectorized=True,
            updating="deferred",
            callback=lambda intermediate_result: bool(bar.update()) and False,
        )
    return replace(controller, gains=unpack_gains(result.x, joints))
