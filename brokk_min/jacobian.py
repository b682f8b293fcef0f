"""The classical way: weighted damped least squares for joint velocities, one PID per joint.

Read in the order of the computation: `dls`, its weights and its damping give joint velocities
(paper eq3, eq4); `JacobianController` turns them into commands. `evaluation.baselines` tunes it.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brokk_min.kinematics import forward_kinematics, jacobian
from brokk_min.machine import PWM_MAX, Array, Machine, Measured, limit_command, valve_command

DERIVATIVE_TIME = 7 / 60  # s, assumed; of the derivative's filter, which keeps 0.7 at 20 Hz


def dls(J: ArrayLike, W: ArrayLike, damping: ArrayLike, as_printed: bool = False) -> Array:
    """Weighted damped least squares W^-1 J^T (J W^-1 J^T + lambda^2 I)^-1 [rad/m], (..., n, 3).

    q_dot = dls(J, W, damping) @ v minimises |J q_dot - v|^2 + lambda^2 q_dot^T W q_dot. The paper
    prints J W J^T in the bracket. That is the minimiser only for W = I. Paper: eq4

    Args:
        J: Jacobian [m/rad], (..., 3, n).
        W: diagonal of the weight matrix, (..., n), positive.
        damping: lambda^2 [m^2], (...); must be positive where J W^-1 J^T is singular.
        as_printed: use the paper's printed form.

    >>> J_inv = dls(np.eye(3), np.ones(3), 1.0)
    >>> J_inv.diagonal().tolist()  # 1 / (1 + lambda^2)
    [0.5, 0.5, 0.5]
    """
    J, W = np.asarray(J, float), np.asarray(W, float)
    W_inv = 1 / W[..., None, :]
    inner = W[..., None, :] if as_printed else W_inv
    A = (J * inner) @ J.swapaxes(-1, -2)  # J W^-1 J^T, or J W J^T as printed
    A = A + np.asarray(damping)[..., None, None] * np.eye(3)  # + lambda^2 I
    return (J * W_inv).swapaxes(-1, -2) @ np.linalg.inv(A)


def limit_gradient(machine: Machine, q: ArrayLike) -> Array:
    """Gradient [1/rad] of Chan and Dubey's (1995) joint-limit function at angles `q`, (..., n).

    h(q) = sum over joints of (q_max - q_min)^2 / (4 (q_max - q) (q - q_min)).

    >>> middle = (BROKK_170.column("q_min") + BROKK_170.column("q_max")) / 2
    >>> bool(np.allclose(limit_gradient(BROKK_170, middle), 0))
    True
    """
    low, high = machine.column("q_min"), machine.column("q_max")
    margin = 1e-3 * (high - low)  # finite at the limits and beyond
    q = np.clip(q, low + margin, high - margin)
    # dh/dq = (q_max - q_min)^2 (2 q - q_max - q_min) / (4 (q_max - q)^2 (q - q_min)^2)
    gradient: Array = (high - low) ** 2 * (2 * q - high - low) / (4 * ((high - q) * (q - low)) ** 2)
    return gradient


def limit_weights(machine: Machine, q: ArrayLike, q_dot: ArrayLike) -> Array:
    """Diagonal of W for all joints, (..., n): 1 + |dh/dq| towards a limit, otherwise 1.

    `q` are angles [rad], `q_dot` velocities whose sign gives the direction. Paper: Sec. 4.2 (W)

    >>> q = [0.0, 0.7, 1.5, 1.75, 1.0]  # q3 is near its upper limit
    >>> limit_weights(BROKK_170, q, [0, 0, 1, 0, 0]).round(1)
    array([ 1. ,  1. , 48.4,  1. ,  1. ])
    """
    gradient = limit_gradient(machine, q)
    return np.where(gradient * np.asarray(q_dot) > 0, 1 + np.abs(gradient), 1.0)


def manipulability(J: ArrayLike) -> Array:
    """w = sqrt(det(J J^T)) [m^3] of Jacobians (..., 3, n), (...); 0: singular. Yoshikawa (1985)

    >>> manipulability(np.diag([1.0, 2.0, 3.0])).round(6).tolist()
    6.0
    """
    J = np.asarray(J)
    return np.asarray(np.sqrt(np.maximum(np.linalg.det(J @ np.swapaxes(J, -1, -2)), 0.0)))


def nakamura_damping(w: ArrayLike, w0: float, k: float) -> Array:
    """lambda^2 = k (1 - w/w0)^2 [m^2] for w < w0, else 0 (Nakamura and Hanafusa, 1986).

    Paper: Sec. 4.2

    >>> nakamura_damping([0.0, 0.5, 1.0, 2.0], 1.0, 0.1)
    array([0.1  , 0.025, 0.   , 0.   ])
    """
    return k * np.maximum(0.0, 1 - np.asarray(w) / w0) ** 2


@lru_cache
def manipulability_threshold(machine: Machine) -> float:
    """w0: a quarter of the largest manipulability over 2,000 random poses (assumed).

    >>> round(manipulability_threshold(BROKK_170), 2)  # m^3
    3.9
    """
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


class PIDState(NamedTuple):
    """What the controller keeps between ticks, (..., n_driven)."""

    integral: Array  # valve opening
    error: Array  # velocity error of the last tick [rad/s]
    derivative: Array  # filtered derivative of the error [rad/s^2]
    q_dot_goal: Array  # desired joint velocities of the last tick [rad/s]


def pid(gains: Gains, error: Array, state: PIDState, dt: float) -> tuple[Array, PIDState]:
    """Valve openings (..., n_driven) for velocity errors [rad/s], and the state of the next tick.

    x = kp e + ki integral(e) + kd d, where the derivative is filtered: T d' + d = de/dt.

    >>> one = np.ones(1)
    >>> state = PIDState(0 * one, one, 0 * one, one)
    >>> pid(Gains(2 * one, one, 0 * one, one), one, state, 0.05)[0].tolist()
    [2.0]
    """
    T = DERIVATIVE_TIME
    keep, take = T / (T + dt), dt / (T + dt)
    derivative = keep * state.derivative + take * (error - state.error) / dt
    opening = gains.kp * error + state.integral + gains.kd * derivative
    integral = state.integral + gains.ki * error * dt
    return opening, state._replace(integral=integral, error=error, derivative=derivative)


@dataclass(frozen=True)
class JacobianController:
    """Resolved rates by damped least squares (eq3), then one PID per driven joint.

    The PID gives the valve opening. Ours are the cut at the joints' speeds, the filter, the
    anti-windup, and the dead zone that is added to the opening. Paper: eq3, Sec. 4.2
    """

    machine: Machine
    gains: Gains
    k: float  # of Nakamura's damping [m^2]; paper: 0.1 and 0.05
    w0: float  # manipulability below which damping sets in [m^3]

    def start(self, num: int) -> PIDState:
        """State of `num` controllers at rest."""
        zero = np.zeros((num, len(self.machine.driven)))
        return PIDState(zero, zero, zero, zero)

    def joint_velocities(self, v: Array, q: Array, last: Array) -> Array:
        """q_dot = J^+ v of the driven joints [rad/s], (..., n_driven). Paper: eq3

        `v` is a tool velocity [m/s] (..., 3), `q` the angles of all joints [rad] (..., n). The
        signs of `last`, the result of the tick before, choose the joint-limit weights.
        """
        m, driven = self.machine, self.machine.driven
        direction = np.zeros(q.shape)
        direction[..., driven] = last
        J = jacobian(forward_kinematics(m, q))[..., driven]
        W = limit_weights(m, q, direction)[..., driven]
        J_inv = dls(J, W, nakamura_damping(manipulability(J), self.w0, self.k) + 1e-9)  # above 0
        q_dot = (J_inv @ v[..., None])[..., 0]
        fastest = np.where(q_dot > 0, m.column("q_dot_up")[driven], m.column("q_dot_down")[driven])
        excess = np.max(np.abs(q_dot) / fastest, axis=-1, keepdims=True)
        return np.asarray(q_dot / np.maximum(1.0, excess))  # slower, in the same direction

    def __call__(self, measured: Measured, state: PIDState) -> tuple[Array, PIDState]:
        """Commands u [-1, 1] (..., n), and the state of the next tick."""
        e = measured.v_goal - measured.v_tool
        v = measured.v_goal + self.gains.feedback * e  # x_goal + K e
        q_dot_goal = self.joint_velocities(v, measured.q.astype(float), state.q_dot_goal)
        error = q_dot_goal - measured.q_dot
        opening, after = pid(self.gains, error, state, self.machine.dt)
        u = self.command(opening)
        frozen = self.saturated(u, opening, error)
        integral = np.where(frozen, state.integral, after.integral)  # anti-windup
        return u, after._replace(integral=integral, q_dot_goal=q_dot_goal)

    def saturated(self, u: Array, opening: Array, error: Array) -> NDArray[np.bool_]:
        """Where a command is at its limit and the error would raise it further, (..., n_driven)."""
        full = np.abs(u[..., self.machine.driven]) >= self.machine.pwm_limit / PWM_MAX
        return np.asarray(full & (np.sign(opening) == np.sign(error)))

    def command(self, opening: Array) -> Array:
        """Commands u (..., n) that open the valves of the driven joints so far (..., n_driven)."""
        m = self.machine
        u = np.zeros((*opening.shape[:-1], m.n))
        u[..., m.driven] = valve_command(opening, m.dead_zones[m.driven])
        return limit_command(m, u)
