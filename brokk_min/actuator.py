"""The actuators: an analytic plant that plays the hydraulics, and the nets that learn it from logs.

Both are plants: they have `reset` and `step`, and either can move the machine. No net and no policy
sees the equations of the analytic one. The nets read a history, which holds angle, velocity and
command of the last 13 samples. `fit` makes nets from logs.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from brokk_min.machine import (
    PWM_MAX,
    Array,
    Machine,
    by_direction,
    is_row,
    python_numbers,
    require,
    valve_opening,
)


class Plant(Protocol):
    """What moves a machine: `AnalyticPlant`, `ActuatorNet`, or a simulator of your own."""

    def reset(self, machine: Machine, q: ArrayLike) -> Any:
        """State of machines at rest at angles q [rad] (..., n): a tuple of arrays, one named q."""

    def step(self, machine: Machine, state: Any, u: Array) -> Any:
        """The state one tick later, under held commands u [-1, 1] (..., n)."""


# --- the analytic plant ---------------------------------------------------------------------------


@dataclass(frozen=True)
class Cylinder:
    """What moves one joint: the third side of a triangle, opposite to the angle `angle` + q."""

    base: float = 0.0  # m, from the joint's pivot to the cylinder's; 0: the arm is always `rod`
    rod: float = 1.0  # m, from the joint's pivot to the rod's end
    angle: float = 0.0  # rad, between these two sides at q = 0
    area: float = 0.005  # m^2, of the piston
    speed: tuple[float, float] | None = None  # m/s up, down at full command; None: by `q_dot_up`

    def __post_init__(self) -> None:
        """ValueError: a field that is no number."""
        python_numbers(self, "Cylinder.")


@dataclass(frozen=True)
class Hydraulics:
    """What the analytic plant knows beyond the machine. Controllers, nets and logs never read it.

    A machine of your own needs none. The times are tuned to the paper's Fig. 2.
    """

    cylinders: Mapping[str, Cylinder] = field(default_factory=dict)  # by joint
    gain: tuple[float, float] = (1.0, 1.0)  # by which all cylinders are faster up, down
    pump_flow: float = 1.0  # m^3/s
    delay: float = 0.040  # s, from command to valve
    dt: float = 0.005  # s, step of explicit Euler
    tau_spool: float = 0.030  # s, time constant of the spool
    tau_cylinder: float = 0.030  # s, of the cylinder's speed
    tau_valve_up: float = 0.15  # s, of a valve's activation, rising
    tau_valve_down: float = 0.40  # s, falling
    valve_threshold: float = 0.80  # activation below which a valve is closed
    spool_threshold: float = 0.01  # of full stroke, above which a valve activates

    def __post_init__(self) -> None:
        """ValueError: a field that is no number."""
        python_numbers(self, "Hydraulics.")


BROKK_CYLINDERS = {  # all assumed
    # base, rod [m]  angle [rad]  area [m^2]  speed up, down [m/s]
    "q1": Cylinder(0.0, 0.15, 0.00, 0.004, (0.0498, 0.0498)),
    "q2": Cylinder(1.0, 0.35, 0.45, 0.010, (0.0588, 0.0802)),
    "q3": Cylinder(0.9, 0.30, 0.80, 0.009, (0.0453, 0.0825)),
    "q4": Cylinder(0.8, 0.25, -0.3, 0.006, (0.0370, 0.0662)),
    "q5": Cylinder(0.6, 0.20, 0.40, 0.004, (0.0425, 0.0833)),
}
HYDRAULICS = {"brokk170": Hydraulics(BROKK_CYLINDERS, pump_flow=0.00105)}  # m^3/s; assumed


def stands_in(machine: Machine) -> bool:
    """Whether the analytic plant moves this machine by default hydraulics, as it has none.

    >>> stands_in(BROKK_170)
    False
    """
    return machine.hydraulics is None


@lru_cache
def hydraulics_of(machine: Machine) -> Hydraulics:
    """The hydraulics of a machine, by default plain ones, with whole steps in a tick.

    ValueError: no such name, a cylinder of no joint, no pair of speeds, a triangle that does not
    close, or a step that Euler cannot take.

    >>> hydraulics_of(BROKK_170).pump_flow
    0.00105
    """
    whole = math.ceil(machine.dt / Hydraulics.dt - 1e-6)  # steps in a tick, of 5 ms at most
    plain = Hydraulics(dt=machine.dt / whole)
    h = plain if machine.hydraulics is None else machine.hydraulics
    if isinstance(h, str):
        require(h in HYDRAULICS, "hydraulics", f"one of {[*HYDRAULICS]}, or a value", h)
        h = HYDRAULICS[h]
    else:
        require(isinstance(h, Hydraulics), "hydraulics", "actuator.Hydraulics", h)
        require(isinstance(h.cylinders, Mapping), "cylinders", "those by joint", h.cylinders)
        known = set(h.cylinders) <= set(machine.names)
        require(known, "cylinders", f"those of joints {[*machine.names]}", [*h.cylinders])
    for joint in machine.joints:
        cylinder = h.cylinders.get(joint.name, Cylinder())
        require(cylinder.rod > 0, f"{joint.name}.rod", "a positive number", cylinder.rod)
        pair = cylinder.speed is None or is_row(cylinder.speed, 2)
        require(pair, f"{joint.name}.speed", "a pair, up and down", cylinder.speed)
        low, high = cylinder.angle + joint.q_min, cylinder.angle + joint.q_max
        closes = cylinder.base == 0 or 0 < low < high < np.pi
        require(closes, f"{joint.name}.angle", "angles in (0, pi)", f"{low:.3f} to {high:.3f}")
    fits = is_row(h.gain, 2) and min(h.delay, *h.gain) >= 0
    require(fits, "hydraulics", "a delay and a pair of gains of 0 or more", h)
    fastest = min(h.tau_spool, h.tau_cylinder, h.tau_valve_up, h.tau_valve_down)
    steps = machine.dt / h.dt
    fits = abs(steps - round(steps)) < 1e-6 and 0 < h.dt <= fastest  # explicit Euler
    require(fits, "hydraulics.dt", "a whole part of 1/rate, not above any tau", h.dt)
    return h


@lru_cache
def cylinder_column(machine: Machine, name: str) -> Array:
    """One number of the cylinders of all joints, (n,); read-only.

    >>> cylinder_column(BROKK_170, "rod").tolist()
    [0.15, 0.35, 0.3, 0.25, 0.2]
    """
    of = hydraulics_of(machine).cylinders
    column = np.array([getattr(of.get(j, Cylinder()), name) for j in machine.names], float)
    column.setflags(write=False)
    return column


@lru_cache
def cylinder_speeds(machine: Machine) -> Array:
    """Speeds of the cylinders up and down at full command [m/s], (n, 2).

    Where none is given, the joint has q_dot_up or q_dot_down with the longest lever arm, `rod`.

    >>> cylinder_speeds(BROKK_170)[4].tolist()
    [0.0425, 0.0833]
    """
    h = hydraulics_of(machine)
    rods = cylinder_column(machine, "rod")[:, None]
    nominal = np.stack([machine.column("q_dot_up"), machine.column("q_dot_down")], axis=-1) * rods
    limit = machine.pwm_limit / PWM_MAX * np.array([1.0, -1.0])  # up, down
    nominal /= np.abs(valve_opening(limit, machine.dead_zones[:, None]))
    given = [h.cylinders.get(name, Cylinder()).speed for name in machine.names]
    speeds = [own or row for own, row in zip(given, nominal.tolist(), strict=True)]
    result = np.array(speeds) * h.gain
    result.setflags(write=False)
    return result


class PlantState(NamedTuple):
    """State of the analytic plant, arrays (..., n) unless noted."""

    q: Array  # joint angle [rad]
    v: Array  # cylinder speed [m/s]
    s: Array  # spool position, -1..1
    z: Array  # valve activation, 0..1: below the threshold the valve is closed
    delayed: Array  # commands not yet at the valve, next first, (..., n, delay / dt)


class AnalyticPlant:
    """Equations that stand in for the hydraulics of the machine."""

    def reset(self, machine: Machine, q: ArrayLike) -> PlantState:
        """The plant at rest at angles `q` [rad] (..., n)."""
        q = np.array(q, float)
        zero = np.zeros_like(q)
        h = hydraulics_of(machine)
        delayed = np.zeros((*q.shape, round(h.delay / h.dt)))
        return PlantState(q, zero, zero, zero, delayed)

    def step(self, machine: Machine, state: PlantState, u: ArrayLike) -> PlantState:
        """One tick under the held command `u` [-1, 1] (..., n), by explicit Euler.

        Paper: eq1, Sec. 3.2 (delay, direction, coupling by a pump, past movement), 3.3 (dead zone)
        """
        steps = round(machine.dt / hydraulics_of(machine).dt)
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

    >>> lever_arm(BROKK_170, [0.0, 0.5, 0.5, 1.7, 1.0]).round(3)
    array([0.15 , 0.337, 0.299, 0.247, 0.197])
    """
    a, b = cylinder_column(machine, "base"), cylinder_column(machine, "rod")
    gamma = cylinder_column(machine, "angle") + np.asarray(q)
    length = np.sqrt(a**2 + b**2 - 2 * a * b * np.cos(gamma))
    return np.where(a > 0, a * b * np.sin(gamma) / length, b)  # a = 0: a constant arm, as of q1


def euler_step(machine: Machine, state: PlantState, opening: Array) -> PlantState:
    """Spool, valve activation, cylinder speed and angle, `Hydraulics.dt` later.

    >>> state = PLANT.reset(BROKK_170, BROKK_170.q_start)
    >>> euler_step(BROKK_170, state, np.ones(5)).s.round(3).tolist()  # dt / tau_s
    [0.167, 0.167, 0.167, 0.167, 0.167]
    """
    m, h = machine, hydraulics_of(machine)
    dt = h.dt
    q, v, s, z, _ = state
    s_next = s + dt * (opening - s) / h.tau_spool  # ds/dt = (opening - s) / tau_s
    target = np.where(np.abs(s) > h.spool_threshold, 1.0, 0.0)
    tau = np.where(target > z, h.tau_valve_up, h.tau_valve_down)
    z_next = z + dt * (target - z) / tau  # dz/dt = (target - z) / tau
    x = np.clip((z - h.valve_threshold) / (1 - h.valve_threshold), 0.0, 1.0)
    # g = sqrt(smoothstep(x)): from idle q5 has 63 % of its speed after 0.40 s (paper: about 0.4 s,
    # Past Movement); without the root it would be 0.44 s
    g = np.sqrt(x * x * (3 - 2 * x))
    v_steady = by_direction(s, cylinder_speeds(m)) * s * g  # of the cylinder, were it alone
    flow = np.sum(np.abs(cylinder_column(m, "area") * v_steady), axis=-1, keepdims=True)
    pump = np.minimum(1.0, h.pump_flow / np.maximum(flow, 1e-12))  # min(1, Q / sum |A v_steady|)
    q_next = q + dt * v / lever_arm(m, q)  # dq/dt = v / r(q)
    v_next = v + dt * (v_steady * pump - v) / h.tau_cylinder  # dv/dt = (v_steady pump - v) / tau_v
    q_next = np.clip(q_next, m.column("q_min"), m.column("q_max"))
    at_top = (q_next >= m.column("q_max")) & (v_next > 0)
    at_bottom = (q_next <= m.column("q_min")) & (v_next < 0)
    v_next = np.where(at_top | at_bottom, 0.0, v_next)
    return PlantState(q_next, v_next, s_next, z_next, state.delayed)


# --- the history ----------------------------------------------------------------------------------


def initial_history(q: ArrayLike, samples: int) -> Array:
    """History of joints that stood still at `q` [rad] (..., n): (..., n, 3, samples).

    Rows: angle [rad], velocity [rad/s], command [-1, 1]; newest sample last. A command is held from
    one angle to the next, so beside q(t-12) ... q(t) stand u(t-13) ... u(t-1). Paper: Table 1

    >>> initial_history(np.zeros((256, 4)), 13).shape
    (256, 4, 3, 13)
    """
    q = 1.0 * np.asarray(q)  # whole numbers become floats
    history = np.zeros((*q.shape, 3, samples), q.dtype)
    history[..., 0, :] = q[..., None]
    return history


def append_command(history: Array, u: ArrayLike) -> Array:
    """The nets' input (..., n, 3, H): q(t-12) ... q(t), and now u(t-12) ... u(t).

    `u` (..., n) is the command of the coming tick. Paper: Table 1

    >>> history = append_command(initial_history([0.5], 3), [1.0])
    >>> history[0, 2].tolist()
    [0.0, 0.0, 1.0]
    """
    result = history.copy()
    result[..., 2, :-1] = history[..., 2, 1:]
    result[..., 2, -1] = u
    return result


def append_sample(history: Array, u: ArrayLike, q: Array, window: int, dt: float) -> Array:
    """History (..., n, 3, H) one tick on: `u` was sent, then the angle `q` [rad] measured (..., n).

    The velocity is the slope of the newest `window` angles.

    >>> history = append_sample(initial_history([0.0], 3), [1.0], np.array([0.1]), 2, 0.05)
    >>> history[0, :, -1].round(6).tolist()  # angle, velocity, command
    [0.1, 2.0, 1.0]
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

    >>> estimate_velocity([0.0, 0.1, 0.2, 0.3], 4, 0.05).round(6).tolist()
    2.0
    """
    q = 1.0 * np.asarray(q)  # whole numbers become floats
    t = dt * (np.arange(samples) - (samples - 1) / 2)
    weights = (t / (t @ t)).astype(q.dtype)  # slope = sum t_i q_i / sum t_i^2
    return np.asarray(np.einsum("...t,t", q[..., -samples:], weights))


# --- the nets -------------------------------------------------------------------------------------


class NetState(NamedTuple):
    """State of a machine that nets move.

    Nets are fitted to encoder angles, but go on from true ones, because encoder steps move no arm.
    What agents read has encoder angles: `env.State.history`.
    """

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
    machine: str  # its name, or empty if the log is of another one
    input_mean: Array  # (n, I)
    input_scale: Array  # (n, I)
    output_low: Array  # (n,) rad/s
    output_high: Array  # (n,) rad/s
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
        """The nets as a `Plant`, at rest at angles `q` [rad] (..., n).

        ValueError: `fit` makes nets of all joints, but these must be of the driven ones.
        """
        fits = len(self.joints) == len(machine.driven)
        require(fits, "nets", "those of driven joints (net_file.select_nets)", self.joints)
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
