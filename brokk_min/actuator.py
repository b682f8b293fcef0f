"""The actuators: an analytic plant that plays the hydraulics, and the nets that learn it from logs.

Both are plants: they have `reset` and `step`, and either can move the machine. No net and no policy
sees the equations of the analytic one. The nets read a history, which holds angle, velocity and
command of the last 13 samples. `identification.fitting` makes nets from logs.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from brokk_min.machine import Array, Machine, side, valve_opening


class Plant(Protocol):
    """What moves a machine: `AnalyticPlant`, `ActuatorNet`, or a simulator of your own."""

    def reset(self, machine: Machine, q: ArrayLike) -> Any:
        """State of machines at rest at angles q [rad] (..., n): a tuple of arrays, one named q."""

    def step(self, machine: Machine, state: Any, u: Array) -> Any:
        """The state one tick later, under held commands u [-1, 1] (..., n)."""


# --- the analytic plant ---------------------------------------------------------------------------


class PlantState(NamedTuple):
    """State of the analytic plant, arrays (..., n) unless noted."""

    q: Array  # joint angle [rad]
    v: Array  # cylinder speed [m/s]
    s: Array  # spool position, -1..1
    z: Array  # valve activation, 0..1: below the threshold the valve is closed
    delayed: Array  # commands not yet at the valve, next first, (..., n, delay / plant_dt)


class AnalyticPlant:
    """Equations that stand in for the hydraulics of the machine."""

    def reset(self, machine: Machine, q: ArrayLike) -> PlantState:
        """The plant at rest at angles `q` [rad] (..., n)."""
        q = np.array(q, float)
        zero = np.zeros_like(q)
        delayed = np.zeros((*q.shape, round(machine.delay / machine.plant_dt)))
        return PlantState(q, zero, zero, zero, delayed)

    def step(self, machine: Machine, state: PlantState, u: ArrayLike) -> PlantState:
        """One tick under the held command `u` [-1, 1] (..., n), by explicit Euler.

        Paper: eq1, Sec. 3.2 (delay, direction, coupling by a pump, past movement), 3.3 (dead zone)
        """
        steps = round(machine.dt / machine.plant_dt)
        held = np.repeat(np.asarray(u, float)[..., None], steps, axis=-1)
        commands = np.concatenate([state.delayed, held], axis=-1)  # what the valve gets in turn
        openings = valve_opening(commands, machine.dead_zones[:, None])
        for i in range(steps):
            state = euler_step(machine, state, openings[..., i])
        return state._replace(delayed=commands[..., steps:])


PLANT = AnalyticPlant()


def lever_arm(machine: Machine, q: ArrayLike) -> Array:
    """Distance from pivot to cylinder axis [m] at angles `q` [rad] (..., n). Paper: eq1 (r)

    r = a b sin(gamma) / sqrt(a^2 + b^2 - 2 a b cos(gamma)), gamma = gamma_0 + q.

    Example:
        >>> from brokk_min.machine import BROKK_170
        >>> lever_arm(BROKK_170, [0.0, 0.5, 0.5, 1.7, 1.0]).round(3)
        array([0.15 , 0.337, 0.299, 0.247, 0.197])
    """
    a, b = machine.column("cylinder_base"), machine.column("cylinder_rod")
    gamma = machine.column("cylinder_angle") + np.asarray(q)
    length = np.sqrt(a**2 + b**2 - 2 * a * b * np.cos(gamma))
    return np.where(a > 0, a * b * np.sin(gamma) / length, b)  # a = 0: a constant arm, as of q1


def euler_step(machine: Machine, state: PlantState, opening: Array) -> PlantState:
    """Spool, valve activation, cylinder speed and angle, `plant_dt` later."""
    m, dt = machine, machine.plant_dt
    q, v, s, z, _ = state
    s_next = s + dt * (opening - s) / m.tau_spool  # ds/dt = (opening - s) / tau_s
    open_valve = np.abs(s) > m.spool_threshold
    tau = np.where(open_valve > z, m.tau_valve_up, m.tau_valve_down)
    z_next = z + dt * (open_valve - z) / tau  # dz/dt = (open - z) / tau
    x = np.clip((z - m.valve_threshold) / (1 - m.valve_threshold), 0.0, 1.0)
    g = np.sqrt(x * x * (3 - 2 * x))  # g = sqrt(smoothstep(x))
    v_steady = side(s, m.cylinder_speeds) * s * g  # of the cylinder, were it alone
    flow = np.sum(np.abs(m.column("cylinder_area") * v_steady), axis=-1, keepdims=True)
    pump = np.minimum(1.0, m.pump_flow / np.maximum(flow, 1e-12))  # min(1, Q / sum |A v_steady|)
    q_next = q + dt * v / lever_arm(m, q)  # dq/dt = v / r(q)
    v_next = v + dt * (v_steady * pump - v) / m.tau_cylinder  # dv/dt = (v_steady pump - v) / tau_v
    q_next = np.clip(q_next, m.column("q_min"), m.column("q_max"))
    at_top = (q_next >= m.column("q_max")) & (v_next > 0)
    at_bottom = (q_next <= m.column("q_min")) & (v_next < 0)
    v_next = np.where(at_top | at_bottom, 0.0, v_next)
    return PlantState(q_next, v_next, s_next, z_next, state.delayed)


# --- the history ----------------------------------------------------------------------------------


def initial_history(q: ArrayLike, samples: int) -> Array:
    """History of joints that stood still at `q` [rad] (..., n): (..., n, 3, samples).

    Rows: angle [rad], velocity [rad/s], command [-1, 1]; newest sample last. The newest command was
    sent one tick before the newest angle was measured. Paper: Table 1
    """
    q = 1.0 * np.asarray(q)  # whole numbers become floats
    history = np.zeros((*q.shape, 3, samples), q.dtype)
    history[..., 0, :] = q[..., None]
    return history


def append_command(history: Array, u: ArrayLike) -> Array:
    """The nets' input (..., n, 3, H): a history and the command `u` (..., n) of the coming tick."""
    result = history.copy()
    result[..., 2, :-1] = history[..., 2, 1:]
    result[..., 2, -1] = u
    return result


def append_sample(history: Array, u: ArrayLike, q: Array, window: int, dt: float) -> Array:
    """History (..., n, 3, H) one tick on: `u` was sent, then the angle `q` [rad] measured (..., n).

    The velocity is the slope of the newest `window` angles.
    """
    result = np.empty(history.shape, history.dtype)
    result[..., :-1] = history[..., 1:]
    result[..., 0, -1] = q
    result[..., 1, -1] = estimate_velocity(result[..., 0, :], window, dt)
    result[..., 2, -1] = u
    return result


def estimate_velocity(q: ArrayLike, samples: int, dt: float) -> Array:
    """Causal velocity [rad/s] (...): slope of the line through the newest angles of `q` (..., T).

    A difference over one tick of a 12-bit encoder comes in steps of 0.031 rad/s at 20 Hz; four
    samples have a third of its noise and are 1.5 ticks late.
    """
    q = 1.0 * np.asarray(q)  # whole numbers become floats
    t = dt * (np.arange(samples) - (samples - 1) / 2)
    weights = (t / (t @ t)).astype(q.dtype)  # slope = sum t_i q_i / sum t_i^2
    return np.asarray(np.einsum("...t,t", q[..., -samples:], weights))


# --- the nets -------------------------------------------------------------------------------------


class NetState(NamedTuple):
    """State of a machine that nets move."""

    q: Array  # joint angle [rad], (..., n)
    history: Array  # of the driven joints, from true angles, (..., n_driven, 3, H), float32


@dataclass(frozen=True, eq=False)
class ActuatorNet:
    """One small net per joint: history in, mean velocity over the coming tick out.

    Weights of the n `joints`: (n, I, 32), (n, 32), (n, 32, 32), (n, 32), (n, 32, 1) and (n, 1).
    Paper: Table 1 and Sec. 3.3 (I = 39, two hidden layers of 32, ReLU, sigmoid output).
    That the output is a mean is our reading.
    """

    joints: tuple[str, ...]
    history: int  # H, samples of q, q_dot and u
    rate: float  # Hz
    velocity_samples: int  # window of the velocity estimator that made the inputs
    machine: str  # name of the machine, or of the log
    input_mean: Array  # (n, I)
    input_scale: Array  # (n, I)
    output_low: Array  # (n,) rad/s
    output_high: Array  # (n,) rad/s
    q_low: Array  # (n,) rad, smallest angle of the training log
    q_high: Array  # (n,) rad
    weights: tuple[Array, ...]
    training: Mapping[str, Any]  # seed and settings that made it

    def inputs(self, history: Array) -> Array:
        """13 angles, 13 velocities and 13 commands of each joint, (..., n, 39). Paper: Table 1

        A subclass may read the same history in another way.
        """
        return history.reshape(*history.shape[:-2], -1)

    def predict(self, history: Array) -> Array:
        """Velocity over the coming tick [rad/s] (..., n): q(t + dt) = q(t) + dt * velocity.

        `history` is of `append_command`, (..., n, 3, H).
        """
        x = (self.inputs(history) - self.input_mean) / self.input_scale
        x = x.reshape(-1, *x.shape[-2:]).swapaxes(0, 1)  # (n, batch, I): one product per joint
        y = self.outputs(x).T
        velocity = self.output_low + (self.output_high - self.output_low) * y
        return np.asarray(velocity.reshape(history.shape[:-2]))

    def outputs(self, x: Array) -> Array:
        """Sigmoid outputs (n, batch) of standardised inputs (n, batch, I)."""
        w1, b1, w2, b2, w3, b3 = self.weights
        x = np.maximum(x @ w1 + b1[..., None, :], 0)
        x = np.maximum(x @ w2 + b2[..., None, :], 0)
        z = np.maximum(x @ w3 + b3[..., None, :], -80)  # exp(80) does not overflow
        return np.asarray(1 / (1 + np.exp(-z))[..., 0])

    def reset(self, machine: Machine, q: ArrayLike) -> NetState:
        """The nets as a `Plant`, at rest at angles `q` [rad] (..., n)."""
        q = np.array(q, float)
        at_rest = initial_history(q[..., machine.driven].astype(np.float32), self.history)
        return NetState(q, at_rest)

    def step(self, machine: Machine, state: NetState, u: Array) -> NetState:
        """One tick, q_{t+1} = q_t + dt net(history, u), within the joints' ranges.

        The nets are those of the driven joints; the others stand.
        """
        driven = machine.driven
        low, high = machine.column("q_min")[driven], machine.column("q_max")[driven]
        velocity = self.predict(append_command(state.history, u[..., driven]))
        q = state.q.copy()
        q[..., driven] = np.clip(q[..., driven] + machine.dt * velocity, low, high)
        sent, reached = u[..., driven], q[..., driven]
        window = self.velocity_samples
        return NetState(q, append_sample(state.history, sent, reached, window, machine.dt))
