"""The classical way: weighted damped least squares for joint velocities, one PID per joint.

Read in the order of the computation: `dls`, its weights and its damping give joint velocities
(paper eq3, eq4); `JacobianController` turns them into commands. `evaluation.baselines` tunes it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brokk_min.actuator import Valves, command_at_rest
from brokk_min.kinematics import forward_kinematics, jacobian
from brokk_min.machine import PWM_MAX, Array, Machine, limit_command, valve_command, valve_opening

if TYPE_CHECKING:
    from brokk_min.env import Measured


def dls(J: ArrayLike, W: ArrayLike, damping: ArrayLike, as_printed: bool = False) -> Array:
    """Weighted damped least squares W^-1 J^T (J W^-1 J^T + lambda^2 I)^-1 [rad/m], (..., n, 3).

    q_dot = dls(J, W, damping) @ v minimises |J q_dot - v|^2 + lambda^2 q_dot^T W q_dot. The paper
    prints J W J^T in the bracket. That is the minimiser only for W = I. Paper: eq4

    Args:
        J: Jacobian [m/rad], (..., 3, n).
        W: diagonal of the weight matrix, (..., n), positive.
        damping: lambda^2 [m^2], (...); above 0 where J W^-1 J^T is singular.
        as_printed: use the paper's printed form.
    """
    J = 1.0 * np.asarray(J)  # floats, even of whole numbers
    W = np.asarray(W, J.dtype)
    inner = W if as_printed else 1 / W
    A = np.einsum("...ik,...jk->...ij", J * inner[..., None, :], J)  # J W^-1 J^T
    A = A + np.asarray(damping)[..., None, None] * np.eye(3)  # + lambda^2 I, in float64
    transposed = np.linalg.solve(A, J / W[..., None, :])  # A = A^T: (A^-1 J W^-1)^T = W^-1 J^T A^-1
    return np.swapaxes(transposed, -1, -2).astype(J.dtype)


def limit_gradient(machine: Machine, q: ArrayLike) -> Array:
    """Gradient [1/rad] of Chan and Dubey's (1995) joint-limit function at angles `q`, (..., n).

    h(q) = sum over joints of (q_max - q_min)^2 / (4 (q_max - q) (q - q_min)).
    """
    low, high = machine.column("q_min"), machine.column("q_max")
    margin = 1e-3 * (high - low)  # finite at the limits and beyond
    q = np.clip(q, low + margin, high - margin)
    # dh/dq = (q_max - q_min)^2 (2 q - q_max - q_min) / (4 (q_max - q)^2 (q - q_min)^2)
    gradient: Array = (high - low) ** 2 * (2 * q - high - low) / (4 * ((high - q) * (q - low)) ** 2)
    return gradient


def limit_weights(machine: Machine, q: ArrayLike, q_dot: ArrayLike) -> Array:
    """Diagonal of W for all joints, (..., n): 1 + |dh/dq| towards a limit, otherwise 1.

    All times `Joint.weight`: metres and radians are not alike. `q` are angles [rad], `q_dot`
    velocities whose sign gives the direction. Paper: Sec. 4.2 (W)
    """
    gradient = limit_gradient(machine, q)
    W = np.where(gradient * np.asarray(q_dot) > 0, 1 + np.abs(gradient), 1.0)
    return np.asarray(W * machine.column("weight"))


def manipulability(J: ArrayLike) -> Array:
    """w = sqrt(det(J J^T)) [m^3] of Jacobians (..., 3, n), (...); 0: singular. Yoshikawa (1985)"""
    J = np.asarray(J)
    return np.asarray(np.sqrt(np.maximum(np.linalg.det(J @ np.swapaxes(J, -1, -2)), 0.0)))


def nakamura_damping(w: ArrayLike, w0: float, k: float) -> Array:
    """lambda^2 = k (1 - w/w0)^2 [m^2] for w < w0, else 0 (Nakamura, 1986). Paper: Sec. 4.2

    Example:
        >>> nakamura_damping([0.0, 0.5, 1.0, 2.0], 1.0, 0.1)
        array([0.1  , 0.025, 0.   , 0.   ])
    """
    return k * np.maximum(0.0, 1 - np.asarray(w) / w0) ** 2


@lru_cache
def manipulability_threshold(machine: Machine) -> float:
    """w0: a quarter of the largest manipulability over 2,000 random poses (assumed)."""
    low, high = machine.column("q_min"), machine.column("q_max")
    poses = np.random.default_rng(0).uniform(low, high, (2000, machine.n))
    J = jacobian(forward_kinematics(machine, poses))[..., machine.driven]
    return 0.25 * float(manipulability(J).max()) + 1e-9


@dataclass(frozen=True)
class Gains:
    """Gains of the controller. Leading axes of the arrays: one row for each machine controlled."""

    kp: Array  # valve opening per rad/s, (..., n_driven)
    ki: Array  # valve opening per rad, (..., n_driven)
    kd: Array  # valve opening per rad/s^2, (..., n_driven)
    feedback: Array  # K = feedback * I of eq3 [1], (..., 1)
    min_opening: Array  # least valve opening while the tool is to move [1], (..., 1)
    integral_feedback: Array  # K_I of the error integral, which eq3 does not have [1/s], (..., 1)
    start_boost: Array  # a valve closed lately opens 1 + start_boost times as wide [1], (..., 1)
    start_time: Array  # from the tick after its first command until then [s], (..., 1)


class PIDState(NamedTuple):
    """What the controller keeps between ticks, (..., n_driven) unless noted."""

    integral: Array  # valve opening
    error: Array  # velocity error of the last tick [rad/s]
    derivative: Array  # filtered derivative of the error [rad/s^2]
    q_dot_goal: Array  # desired joint velocities of the last tick [rad/s]
    rest_ticks: NDArray[np.int64]  # of `command_at_rest`, (...)


@dataclass(frozen=True)
class JacobianController:
    """Resolved rates by damped least squares (eq3), then one PID per driven joint.

    The PID gives the valve opening; the dead zone is added afterwards. While the tool is to move, a
    valve that opens at all opens by `min_opening` or more: one that has closed answers late (paper
    Sec. 3.2), so it opens wider at first (`start_boost`; near: Hagglund 2002). At rest
    `command_at_rest` has a rule, unless `valves` are "open". Paper: eq3, Sec. 4.2
    """

    machine: Machine
    gains: Gains
    k: float  # of Nakamura's damping [m^2]
    w0: float  # manipulability below which damping sets in [m^3]
    feedforward: Callable[[Array, Array], Array] | None = None  # q, q_dot (..., n_driven) -> u
    valves: Valves = "closed"  # or, at rest, "dither", or "open": no rule, and `min_opening` holds

    def start(self, num: int) -> PIDState:
        """State of `num` controllers at rest."""
        zero = np.zeros((num, len(self.machine.driven)))
        return PIDState(zero, zero, zero, zero, np.zeros(num, np.int64))

    def desired_velocities(
        self, v_goal: Array, v_tool: Array, q: Array, last: Array, integral: Array | float = 0.0
    ) -> Array:
        """Desired velocities of the driven joints [rad/s], (..., n_driven). Paper: eq3

        Goal and measured tool velocity [m/s] (..., 3), angles of all joints [rad] (..., n), the
        desired velocities of the tick before, whose signs select the joint-limit weights, and the
        policy's integral of the velocity error [m] (..., 3), which eq3 does not have.
        """
        m, driven = self.machine, self.machine.driven
        direction = np.zeros(q.shape)
        direction[..., driven] = last
        J = jacobian(forward_kinematics(m, q))[..., driven]
        W = limit_weights(m, q, direction)[..., driven]
        J_inv = dls(J, W, nakamura_damping(manipulability(J), self.w0, self.k) + 1e-9)  # above 0
        v = v_goal + self.gains.feedback * (v_goal - v_tool)
        v = v + self.gains.integral_feedback * integral  # v_d + K (v_d - v_ee) + K_I integral
        q_dot = (J_inv @ v[..., None])[..., 0]
        fastest = np.where(q_dot > 0, m.column("q_dot_up")[driven], m.column("q_dot_down")[driven])
        excess = np.max(np.abs(q_dot) / fastest, axis=-1, keepdims=True)
        return np.asarray(q_dot / np.maximum(1.0, excess))  # slower, in the same direction

    def __call__(self, measured: Measured, state: PIDState) -> tuple[Array, PIDState]:
        """Commands u [-1, 1] (..., n), and the state of the next tick."""
        m, gains = self.machine, self.gains
        q = measured.q.astype(float)
        q_dot_goal = self.desired_velocities(
            measured.v_goal, measured.v_tool, q, state.q_dot_goal, measured.error_integral
        )
        error = q_dot_goal - measured.q_dot
        derivative = 0.7 * state.derivative + 0.3 * (error - state.error) / m.dt  # over 2.8 ticks
        opening = gains.kp * error + state.integral + gains.kd * derivative  # PID
        if self.feedforward is not None:
            u = self.feedforward(q[..., m.driven], q_dot_goal)
            opening = opening + valve_opening(u, m.dead_zones[m.driven])
        u = self._open_valves(opening, measured)
        full = np.abs(np.rint(u[..., m.driven] * PWM_MAX)) >= m.pwm_limit
        saturated = full & (np.sign(opening) == np.sign(error))
        u, resting, ticks = command_at_rest(m, self.valves, u, measured.v_goal, state.rest_ticks)
        increase = np.where(saturated | resting, 0.0, gains.ki * error * m.dt)  # anti-windup
        return u, PIDState(state.integral + increase, error, derivative, q_dot_goal, ticks)

    def _open_valves(self, opening: Array, measured: Measured) -> Array:
        """Commands u (..., n) of valve openings beyond the dead zone (..., n_driven)."""
        m, gains = self.machine, self.gains
        idle = valve_opening(measured.history[..., 2, :], m.dead_zones[m.driven, None]) == 0
        ticks = np.argmax(idle[..., ::-1], axis=-1)  # since a valve was closed; 0: now or long ago
        start = (ticks > 0) & (ticks * m.dt < gains.start_time)
        opening = opening * np.where(start, 1 + gains.start_boost, 1.0)
        moving = np.linalg.norm(measured.v_goal, axis=-1, keepdims=True) > 1e-6
        least = (moving | (self.valves != "closed")) * gains.min_opening
        size = np.maximum(np.abs(opening), least)
        closed = size < 0.5 / PWM_MAX  # below half a count
        opening = np.where(closed, 0.0, np.sign(opening) * size)
        u = np.zeros((*opening.shape[:-1], m.n))
        u[..., m.driven] = valve_command(opening, m.dead_zones[m.driven])
        return limit_command(m, u)


def limit_penalty(machine: Machine, q: Array) -> tuple[Array, Array]:
    """x^2 (..., n), a cost of `env.step`, and its derivative by `q` [rad]: x = +-1 at a limit.

    0 but in the outer 5 % (tuned) of a range. Near legged_gym's `dof_pos_limits`, a linear one.
    """
    low, high = machine.column("q_min"), machine.column("q_max")
    margin = 0.05 * (high - low)
    x = (q - np.clip(q, low + margin, high - margin)) / margin
    return x**2, 2 * x / margin
