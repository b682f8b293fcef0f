"""The actuators: an analytic plant that plays the hydraulics, and the nets that learn it from logs.

Both are integrated explicitly, one tick of 1/rate seconds at a time. The nets and the policy read
the same history: angle, velocity and command of the last 13 samples. The learner never sees the
plant's equations. `identification.fitting` makes nets from logs.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brokk_min.kinematics import estimate_velocity
from brokk_min.machine import Array, Machine, as_floats, limit_command, valve_command, valve_opening

REST_AFTER = {"closed": 0.5, "dither": 0.1, "open": math.inf}  # s of a zero goal, assumed, tuned
STANDSTILL = 0.002  # rad or m, assumed: little more than one step of a 12-bit encoder
Valves = Literal["closed", "dither", "open"]  # what they do while the tool rests
Encoder = Callable[[Machine, Array], Array]  # machine, true angles -> measured angles
MU = 50.0  # assumed: the mu law is about linear below 1/50 of full opening
INDICATOR_SCALE = 0.02  # of full opening, assumed: 2.4 counts of 127 at a dead zone of 7 %

# --- the analytic plant ---------------------------------------------------------------------------


class PlantState(NamedTuple):
    """State of the analytic plant, arrays (..., n) unless noted."""

    q: Array  # joint angle [rad or m]
    v: Array  # cylinder speed [m/s]
    s: Array  # spool position, -1..1
    z: Array  # valve activation, 0..1: below the threshold the valve is closed
    delayed: Array  # commands not yet at the valve, next first, (..., n, delay / plant_dt)


def plant_reset(machine: Machine, q: ArrayLike) -> PlantState:
    """The plant at rest at angles `q` [rad] (..., n): the analytic one, or `machine.plant`."""
    if machine.plant:  # has `reset`, `step`; its state `q`, and `encoder` if not q is measured
        return machine.plant.reset(machine, q)  # type: ignore[no-any-return]
    q = np.array(q, float)
    zero = np.zeros_like(q)
    delayed = np.zeros((*q.shape, round(machine.delay / machine.plant_dt)))
    return PlantState(q, zero, zero, zero, delayed)


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
    return np.where(a > 0, a * b * np.sin(gamma) / length, b)


def plant_step(machine: Machine, state: PlantState, u: ArrayLike) -> PlantState:
    """One tick of the analytic plant under the held command `u` [-1, 1] (..., n): explicit Euler.

    Paper: eq1 and Sec. 3.2 (dead zone, delay, direction, coupling by the pump, past movement)
    """
    if machine.plant:
        return machine.plant.step(machine, state, u)  # type: ignore[no-any-return]
    steps = round(machine.dt / machine.plant_dt)
    held = np.repeat(np.asarray(u, float)[..., None], steps, axis=-1)
    commands = np.concatenate([state.delayed, held], axis=-1)  # what the valve gets, step by step
    openings = valve_opening(commands, machine.dead_zones[:, None])
    for i in range(steps):
        state = _euler_step(machine, state, openings[..., i])
    return state._replace(delayed=commands[..., steps:])


def _euler_step(machine: Machine, state: PlantState, opening: Array) -> PlantState:
    """Spool, valve activation, cylinder speed and angle, `plant_dt` later."""
    m, dt = machine, machine.plant_dt
    q, v, s, z, _ = state
    s_next = s + dt * (opening - s) / m.tau_spool  # ds/dt = (opening - s) / tau_s
    open_valve = np.abs(s) > m.spool_threshold
    tau = np.where(open_valve > z, m.tau_valve_up, m.tau_valve_down)
    z_next = z + dt * (open_valve - z) / tau  # dz/dt = (open - z) / tau
    x = np.clip((z - m.valve_threshold) / (1 - m.valve_threshold), 0.0, 1.0)
    g = np.sqrt(x * x * (3 - 2 * x))  # g = sqrt(smoothstep(x))
    speed = np.where(s > 0, m.column("speed_positive"), m.column("speed_negative"))
    v_steady = speed * s * g  # of the cylinder, were it alone
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

    Example:
        >>> initial_history(np.array([0.5, 1.0]), 3)[1]
        array([[1., 1., 1.],
               [0., 0., 0.],
               [0., 0., 0.]])
    """
    q = as_floats(q)
    history = np.zeros((*q.shape, 3, samples), q.dtype)
    history[..., 0, :] = q[..., None]
    return history


def append_command(history: Array, u: ArrayLike) -> Array:
    """The nets' input: (..., n, 3, H) with the command `u` (..., n); angles, velocities stay."""
    result = history.copy()
    result[..., 2, :-1] = history[..., 2, 1:]
    result[..., 2, -1] = u
    return result


def command_at_rest(
    machine: Machine, valves: Valves, u: Array, v_goal: Array, ticks: NDArray[np.int64]
) -> tuple[Array, NDArray[np.bool_], NDArray[np.int64]]:
    """Commands u (..., n), but those of the rule for `valves` after `REST_AFTER` of a zero goal.

    "closed": zero. The joints stand, but the next motion begins 0.3 s later. "dither": driven
    valves open by `dither`, each tick the other way; the joints stand, the valves stay open
    (Merritt 1967). "open": no rule (the paper). `ticks` (...): for how long `v_goal` [m/s] (..., 3)
    was zero before. Returns commands, does the rule hold (..., 1), and the ticks with this one.
    """
    ticks = np.where(v_goal.any(axis=-1), 0, ticks + 1)
    resting = (ticks > REST_AFTER[valves] * machine.rate)[..., None]
    rule = np.zeros_like(u)
    if valves == "dither":
        opening = (-1.0) ** ticks[..., None] * machine.dither
        rule[..., machine.driven] = valve_command(opening, machine.dead_zones[machine.driven])
    return np.where(resting, limit_command(machine, rule), u), resting, ticks


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


def smooth_angles(machine: Machine, history: Array) -> Array:
    """Present angles [rad] (..., n), from all samples of a history (..., n, 3, H).

    Mean over j = 1 .. H of q_j + dt (q_dot_{j+1} + ... + q_dot_H) + dt l (q_dot_H - q_dot_j): each
    sample, moved on by the velocities since. As slopes, they come l = window / 2 - 1 ticks later
    than the mean velocity of their tick. The mean has 0.28 of the newest angle's training noise.
    """
    H = machine.history
    late = machine.velocity_samples / 2 - 1
    count = np.arange(H) - late  # q_dot_{j+1}, with j from 0, stands in j of the H sums
    count[-1] += H * late
    weights = np.stack([np.ones(H), machine.dt * count], dtype=history.dtype) / H
    return np.asarray(np.einsum("...kh,kh->...", history[..., :2, :], weights))


# --- the nets -------------------------------------------------------------------------------------


def mu_law(u: ArrayLike, dead_zone: float) -> Array:
    """Commands as the nets read them: opening beyond the dead zone, companded by the mu law.

    sign(x) ln(1 + mu |x|) / ln(1 + mu) (ITU-T G.711). A few counts beyond the dead zone decide
    whether a valve stays open. `dead_zone` 0: `u` as it is, as in the paper. Paper: Table 1 (u)

    Example:
        >>> mu_law([-1.0, 0.07, 0.08, 0.1, 0.3], 0.07).round(2)
        array([-1.  ,  0.  ,  0.11,  0.24,  0.66])
    """
    u = np.asarray(u)
    if not dead_zone:
        return u
    x = valve_opening(u, dead_zone)
    return np.asarray(np.copysign(np.log1p(MU * np.abs(x)) / math.log1p(MU), x))


def open_indicator(u: ArrayLike, dead_zone: ArrayLike) -> Array:
    """Does a command open the valve? tanh(|x| / 0.02) of the opening x, as in `valve_opening`.

    0 within the dead zone, 0.76 at 2.4 counts beyond 7 %. A closed valve answers late; when it does
    depends on how long it has had commands, hardly on how large they are. Paper: Table 1 (u)

    Example:
        >>> open_indicator([-1.0, 0.07, 0.08, 0.1], 0.07).round(2)
        array([1.  , 0.  , 0.49, 0.92])
    """
    return np.asarray(np.tanh(np.abs(valve_opening(u, dead_zone)) / INDICATOR_SCALE))


def input_rows(q: Array, q_dot: Array, u: Array, dead_zone: float, indicator: bool) -> list[Array]:
    """What nets read of samples: q, q_dot, `mu_law` and, not in the paper, `open_indicator`."""
    rows = [q, q_dot, mu_law(u, dead_zone)]
    if indicator:
        rows.append(open_indicator(u, dead_zone))
    return rows


@dataclass(frozen=True, eq=False)
class ActuatorNet:
    """One small net per joint: history in, mean velocity over the coming tick out.

    Weights, joint by joint: (n, I, 32), (n, 32), (n, 32, 32), (n, 32), (n, 32, 1) and (n, 1).
    Paper: Table 1 and Sec. 3.3 (I = 3 H = 39, two hidden layers of 32, ReLU, sigmoid output)
    Not in the paper: I = 4 H, see `input_rows`; more weights, (n, 2 I, L), (n, L, 32) and (n, L),
    where joints are not alone, see `latents`.
    """

    joints: tuple[str, ...]
    history: int  # H, samples of q, q_dot and u
    rate: float  # Hz
    velocity_samples: int  # window of the velocity estimator that made the inputs
    velocity_logged: bool  # trained on q_dot columns of a log instead
    machine: str  # name of the machine, or of the log
    seed: int
    settings: dict[str, float]
    input_mean: Array  # (n, I)
    input_scale: Array  # (n, I)
    output_low: Array  # (n,) rad/s or m/s
    output_high: Array  # (n,) rad/s or m/s
    q_low: Array  # (n,) rad or m, smallest angle of the training log
    q_high: Array  # (n,) rad or m
    weights: tuple[Array, ...]
    dead_zone: float = 0.0  # of full command: commands pass `mu_law`

    @property
    def indicator(self) -> bool:
        """Do the nets read `open_indicator`, I = 4 H?"""
        return bool(self.input_mean.shape[-1] > 3 * self.history)

    def predict(self, history: Array) -> Array:
        """Velocity over the coming tick [rad/s] (..., n): q(t + dt) = q(t) + dt * velocity.

        `history` is of `append_command`, (..., n, 3, H). A joint without a command beyond the dead
        zone, within `STANDSTILL` of its oldest angle, stands still; the net alone would creep.
        """
        velocity = self.forward(history)[0]
        moved = np.abs(history[..., 0, -1] - history[..., 0, 0]) >= STANDSTILL
        opened = (np.abs(history[..., 2, :]) > self.dead_zone).any(axis=-1)
        return np.asarray(velocity * (moved | opened))

    def inputs(self, history: Array) -> Array:
        """Histories (..., n, 3, H) as the first layer reads them, (..., n, I).

        ValueError: a history of another shape.
        """
        n = len(self.joints)
        if history.shape[-3:] != (n, 3, self.history):
            expected = f"expected (..., {n}, 3, {self.history})"
            raise ValueError(f"history: {expected}, got {history.shape}")
        q, q_dot, u = np.ascontiguousarray(np.moveaxis(history, -2, 0))
        rows = input_rows(q, q_dot, u, self.dead_zone, self.indicator)
        return np.concatenate(rows, axis=-1)

    def latents(self, x: Array) -> Array:
        """Latents (batch, L) of all joints' inputs (batch, n, I), such as pump flow and load.

        z = tanh(sum_j (S_j^T [x_j, |x_j|] + c_j)) of standardised inputs x.
        """
        x = (x - self.input_mean) / self.input_scale
        x = np.concatenate([x, np.abs(x)], axis=-1)
        z = x.reshape(len(x), -1) @ np.concatenate(self.weights[6])
        return np.asarray(np.tanh(z + self.weights[8].sum(axis=0)))

    def forward(self, history: Array) -> tuple[Array, Array, Array, Array]:
        """Velocities [rad/s] (..., n); sigmoid output, hidden layers 2 and 1 (n, batch, units)."""
        x = self.inputs(history)
        x = x.reshape(-1, *x.shape[-2:])
        w1, b1, w2, b2, w3, b3 = folded_weights(self)
        if len(self.weights) > 6:
            b1 = b1 + self.latents(x) @ self.weights[7]  # (n, batch, units)
        hidden1 = np.maximum(x.swapaxes(0, 1) @ w1 + b1, 0)
        hidden2 = np.maximum(hidden1 @ w2 + b2, 0)
        y = 1 / (1 + np.exp(-(hidden2 @ w3 + b3)))
        low, high = self.output_low[:, None], self.output_high[:, None]
        velocity: Array = (low + (high - low) * y[..., 0]).T
        return velocity.reshape(history.shape[:-2]), y, hidden2, hidden1


@lru_cache(maxsize=8)
def folded_weights(net: ActuatorNet) -> tuple[Array, ...]:
    """Weights with the normalisation of the inputs folded into the first layer."""
    w1, b1, w2, b2, w3, b3 = net.weights[:6]
    scaled = w1 / net.input_scale[..., None]
    shift = b1 - np.einsum("ni,nih->nh", net.input_mean, scaled)
    return scaled, shift[:, None], w2, b2[:, None], w3, b3[:, None]


def net_step(
    machine: Machine, net: ActuatorNet | None, history: Array, q: Array, u: Array
) -> Array:
    """Angles [rad] (..., n) of a machine whose driven joints the nets move, one tick on.

    q_{t+1} = q_t + dt net(history, u), within the joints' ranges; `history` of the driven joints
    (..., n_driven, 3, H) is without the command `u` (..., n) of this tick. ValueError: no nets.
    """
    if net is None:
        raise ValueError("net: expected nets for a state without a plant, got None")
    driven = machine.driven
    moved = q[..., driven] + machine.dt * net.predict(append_command(history, u[..., driven]))
    low, high = machine.column("q_min")[driven], machine.column("q_max")[driven]
    q = q.copy()
    q[..., driven] = np.clip(moved, low, high)
    return q
