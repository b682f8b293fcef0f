"""Physics that the paper's plant leaves out, effect by effect, and machines drawn with them.

A `Physics` is a plant of its own: as `Machine.plant` it replaces the plant of `actuator`, whose
equations it keeps where an effect is 0. Each effect is one function with its equation. Sources:

- load: orifice flow, v ~ sqrt(p_s - p_L) (Merritt, Hydraulic Control Systems, 1967, ch. 5)
- spool hysteresis, encoder backlash: the play operator (Krasnosel'skii and Pokrovskii, 1989)
- stick-slip: Karnopp, ASME J. Dyn. Sys. 107, 1985: no motion below a breakaway drive
- arm mode: oil as a spring under the mass, omega^2 and zeta (Merritt 1967, ch. 6)
- oil: viscosity falls while it warms (Jelali and Kroll, Hydraulic Servo-systems, 2003, ch. 3)
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from brokk_min.actuator import lever_arm
from brokk_min.kinematics import forward_kinematics
from brokk_min.machine import Array, Joint, Machine, check_numbers, number, valve_opening

G = 9.81  # m/s^2
STANDING = 1e-4  # m/s, assumed: a slower cylinder stands


class PhysicsState(NamedTuple):
    """State of the plant, arrays (..., n) unless noted; the first four as in `PlantState`."""

    q: Array  # joint angle [rad]
    v: Array  # cylinder speed [m/s]
    s: Array  # spool position, -1..1
    z: Array  # valve activation, 0..1
    delayed: Array  # commands not yet at the valve, next first, (..., n, steps)
    v_dot: Array  # cylinder acceleration [m/s^2], of joints with an arm mode
    play: Array  # command behind the spool's hysteresis, -1..1
    encoder: Array  # angle of the encoder's shaft behind its backlash [rad]
    warmth: Array  # of the oil, 0 cold to 1 hot, (..., 1)
    tick: Array  # ticks since the reset, (..., 1)


@dataclass(frozen=True)
class Physics:
    """Sizes of all effects, by default none; a plant with the two functions of `Machine.plant`."""

    link_mass: float = number("kg", 0, 1e5, 0.0)  # of each link, in its middle
    payload: float = number("kg", 0, 1e5, 0.0)  # at the tool
    tilt: float = number("rad", -1, 1, 0.0)  # of the base about y: positive lifts the rear
    pressure: float = number("Pa", 1e3, 1e9, 5e6)  # p_s: what drives the flow without a load
    dead_zones: tuple[tuple[float, float], ...] = ()  # up and down by joint; (): the machine's
    hysteresis: float = number("of full stroke", 0, 0.5, 0.0)  # half width of the spool's play
    breakaway: float = number("m/s", 0, 1, 0.0)  # steady speed below which a cylinder sticks
    mode: float = number("Hz", 0, 20, 0.0)  # frequency of the arm mode of all but the first joint
    damping: float = number("1", 0, 2, 0.15)  # zeta of the arm mode
    jitter: float = number("s", 0, 1, 0.0)  # the delay grows by 0 to this, anew each tick
    backlash: float = number("rad", 0, 0.1, 0.0)  # of the encoders, from end to end
    cold: float = number("1", 0, 3, 0.0)  # cold oil: speeds / (1 + cold), time constants * it
    warmth: float = number("1", 0, 1, 1.0)  # of the oil at a reset
    warm_up: float = number("s", 1, 1e5, 600.0)  # time constant of the oil's warming
    __post_init__ = check_numbers  # type: ignore[misc]

    def reset(self, machine: Machine, q: ArrayLike) -> PhysicsState:
        """The plant at rest at angles `q` [rad] (..., n)."""
        q = np.array(q, float)
        zero, one = np.zeros_like(q), np.ones_like(q[..., :1])
        steps = round(machine.delay / machine.plant_dt) + round(self.jitter / machine.plant_dt)
        delayed = np.zeros((*q.shape, steps))
        warmth = self.warmth * one
        return PhysicsState(q, zero, zero, zero, delayed, zero, zero, q, warmth, 0 * one)

    def step(self, machine: Machine, state: PhysicsState, u: ArrayLike) -> PhysicsState:
        """One tick under the held command `u` [-1, 1] (..., n): explicit Euler of `plant_dt`."""
        steps = round(machine.dt / machine.plant_dt)
        held = np.repeat(np.asarray(u, float)[..., None], steps, axis=-1)
        commands = np.concatenate([state.delayed, held], axis=-1)
        longest = round(self.jitter / machine.plant_dt)
        later = np.rint(longest * pseudo_random(state.tick))[..., None].astype(int)
        at = np.broadcast_to(longest - later + np.arange(steps), held.shape)
        commanded = np.take_along_axis(commands, at, -1)
        torque = gravity_torque(machine, state.q, self.link_mass, self.payload, self.tilt)
        p_load = torque / (lever_arm(machine, state.q) * machine.column("cylinder_area"))
        for i in range(steps):
            state = euler_step(self, machine, state, commanded[..., i], p_load / self.pressure)
        warmth = warm(state.warmth, np.abs(state.s), machine.dt, self.warm_up)
        encoder = play(state.encoder, state.q, self.backlash / 2)
        later_on = {"delayed": commands[..., steps:], "tick": state.tick + 1}
        return state._replace(encoder=encoder, warmth=warmth, **later_on)


def euler_step(
    physics: Physics, machine: Machine, state: PhysicsState, u: Array, load: Array
) -> PhysicsState:
    """All states `plant_dt` later; `load` p_L / p_s (..., n) holds for the tick.

    The play acts on the command: within the dead zone a spool that sticks leaks nothing.
    """
    m, dt, s, v = machine, machine.plant_dt, state.s, state.v
    viscous = 1 + physics.cold * (1 - state.warmth)
    play_next = play(state.play, u, physics.hysteresis)
    opening = valve_opening(play_next, physics.dead_zones or m.dead_zones)
    s_next = s + dt * (opening - s) / (m.tau_spool * viscous)  # ds/dt = (x - s) / tau_s
    open_valve = np.abs(s) > m.spool_threshold
    tau = np.where(open_valve > state.z, m.tau_valve_up, m.tau_valve_down)
    z_next = state.z + dt * (open_valve - state.z) / tau
    x = np.clip((state.z - m.valve_threshold) / (1 - m.valve_threshold), 0.0, 1.0)
    g = np.sqrt(x * x * (3 - 2 * x))  # g = sqrt(smoothstep(x))
    K = np.where(s > 0, m.column("speed_positive"), m.column("speed_negative"))
    v_steady = K * s * g * load_factor(load, s) / viscous
    flow = np.abs(m.column("cylinder_area") * v_steady).sum(axis=-1, keepdims=True)
    v_steady = v_steady * np.minimum(1.0, m.pump_flow / np.maximum(flow, 1e-12))
    v_steady = stick_slip(v, v_steady, physics.breakaway)
    q_next = state.q + dt * v / lever_arm(m, state.q)  # dq/dt = v / r(q)
    v_next = v + dt * (v_steady - v) / (m.tau_cylinder * viscous)
    omega = 2 * np.pi * physics.mode * (np.arange(m.n) > 0)
    v_dot = arm_mode(v, state.v_dot, v_steady, omega, physics.damping, dt)
    v_next = np.where(omega > 0, v + dt * v_dot, v_next)
    q_next = np.clip(q_next, m.column("q_min"), m.column("q_max"))
    at_top = (q_next >= m.column("q_max")) & (v_next > 0)
    at_bottom = (q_next <= m.column("q_min")) & (v_next < 0)
    stopped = at_top | at_bottom
    v_next, v_dot = np.where(stopped, 0.0, v_next), np.where(stopped, 0.0, v_dot)
    moved = {"q": q_next, "v": v_next, "v_dot": v_dot, "play": play_next}
    return state._replace(s=s_next, z=z_next, **moved)


def gravity_torque(
    machine: Machine, q: Array, link_mass: float, payload: float, tilt: float
) -> Array:
    """Torque [N m], force [N] of prismatic joints (..., n), that holds the arm: > 0 where +q lifts.

    tau_i = g sum_k m_k e . (z_{i-1} x (c_k - p_{i-1})), links k = i .. n with their middles c_k and
    the payload at the tool; e is up, seen from a base that is turned by `tilt` about its y axis.
    0 without masses.
    """
    if not link_mass and not payload:
        return np.zeros_like(q)
    frames = forward_kinematics(machine, q)
    up = np.array([-math.sin(tilt), 0.0, math.cos(tilt)])
    middle = (frames.p[..., :-1, :] + frames.p[..., 1:, :]) / 2
    # sum over the links behind joint i of m (c - p_{i-1})
    links = np.arange(machine.n, 0, -1)[:, None]
    moment = link_mass * (np.cumsum(middle[..., ::-1, :], -2)[..., ::-1, :])
    moment = moment - link_mass * links * frames.p[..., :-1, :]
    moment = moment + payload * (frames.p[..., -1:, :] - frames.p[..., :-1, :])
    torque = np.cross(frames.z[..., :-1, :], moment) @ up
    for i in frames.prismatic:  # the force along its axis
        torque[..., i] = (link_mass * (machine.n - i - 0.5) + payload) * (frames.z[..., i, :] @ up)
    return G * np.asarray(torque)


def load_factor(load: Array, s: Array) -> Array:
    """sqrt(1 - sign(s) p_L / p_s) of the speed (...), from 0.2 to 1.5 (bounds assumed).

    Example:
        >>> load_factor(np.array([0.0, 0.19, 0.19]), np.array([1.0, 1.0, -1.0])).round(3)
        array([1.   , 0.9  , 1.091])
    """
    return np.sqrt(np.clip(1 - np.sign(s) * load, 0.04, 2.25))


def play(behind: Array, ahead: Array, half: float) -> Array:
    """The play operator: `behind` follows `ahead` (...) where they are more than `half` apart.

    Example:
        >>> play(np.array([0.0, 0.0, 0.0]), np.array([0.05, 0.3, -0.3]), 0.1).round(2)
        array([ 0. ,  0.2, -0.2])
    """
    return np.clip(behind, ahead - half, ahead + half)


def stick_slip(v: Array, v_steady: Array, breakaway: float) -> Array:
    """The speed that drives a cylinder (...): 0 where it stands and the drive does not break it."""
    sticks = (np.abs(v) < STANDING) & (np.abs(v_steady) < breakaway)
    return np.where(sticks, 0.0, v_steady)


def arm_mode(
    v: Array, v_dot: Array, v_steady: Array, omega: Array, zeta: float, dt: float
) -> Array:
    """Acceleration [m/s^2] (..., n) after `dt`: v'' = omega^2 (v_steady - v) - 2 zeta omega v'."""
    return v_dot + dt * (omega**2 * (v_steady - v) - 2 * zeta * omega * v_dot)


def warm(warmth: Array, work: Array, dt: float, tau: float) -> Array:
    """Warmth (..., 1) after `dt` of mean opening `work` (..., n): w' = (1 - w) mean(work) / tau."""
    return np.asarray(warmth + dt * (1 - warmth) * work.mean(axis=-1, keepdims=True) / tau)


def pseudo_random(tick: Array) -> Array:
    """Numbers in [0, 1) (...) that look random, of whole numbers (...): frac(43758.5 sin(12.99 k)).

    The same tick has the same jitter: plants stay functions of their state.
    """
    x = 43758.5453 * np.sin(12.9898 * (tick + 1))
    return np.asarray(x - np.floor(x))


# Largest effects of a drawn machine, all assumed; each is there with probability `PRESENT`.
PRESENT = 0.6
LARGEST = {
    "load": 0.8,  # of the supply pressure, in the worst pose
    "pump": 0.8,  # part of the pump's flow that is missing
    "zone": 0.8,  # a dead zone's excess over the machine's
    "gain": 0.3,  # change of a speed, up or down
    "hysteresis": 0.02,
    "breakaway": 0.002,  # m/s
    "slow": 3.5,  # Hz, of the arm mode; the slowest has 2 Hz
    "jitter": 0.02,  # s
    "backlash": 0.004,  # rad
    "cold": 0.4,
}


@lru_cache
def draw_machine(base: Machine, seed: int) -> Machine:
    """A member of the family of `base`: the same arm with physics of its own, drawn by `seed`.

    The learner knows of it what a user would measure: the smallest and largest dead zone and the
    fastest motion of each joint.
    """
    rng = np.random.default_rng([2026, seed])
    size = {name: (rng.random() < PRESENT) * largest for name, largest in LARGEST.items()}
    drawn = {name: value * rng.uniform(0.5, 1.0) for name, value in size.items()}
    gains = 1 + size["gain"] * rng.uniform(-1, 1, (base.n, 2))
    zones = base.dead_zone * (1 + size["zone"] * rng.random((base.n, 2)))
    poses = rng.uniform(base.column("q_min"), base.column("q_max"), (1000, base.n))
    torque = gravity_torque(base, poses, 100.0, 0.0, 0.0)
    p_load = np.abs(torque / (lever_arm(base, poses) * base.column("cylinder_area")))
    physics = Physics(
        link_mass=100.0 * bool(drawn["load"]),
        pressure=float(np.quantile(p_load.max(axis=-1), 0.99) / (drawn["load"] or 0.5)),
        dead_zones=tuple((up, down) for up, down in zones.tolist()),
        mode=(drawn["slow"] and 2.0 + rng.uniform(0.0, drawn["slow"] - 1.0)),
        damping=rng.uniform(0.1, 0.3),
        warmth=rng.uniform(0.3, 0.9),
        **{name: drawn[name] for name in ("hysteresis", "breakaway", "backlash", "cold")},
        jitter=drawn["jitter"],
    )
    joints = map(_scale_joint, base.joints, gains.tolist())
    return replace(
        base,
        name=f"{base.name} family {seed}",
        joints=tuple(joints),
        dead_zone=float(zones.min()),
        largest_dead_zone=float(zones.max()),
        pump_flow=base.pump_flow * (1 - drawn["pump"]),
        plant=physics,
    )


def _scale_joint(joint: Joint, gains: list[float]) -> Joint:
    up, down = gains
    return replace(
        joint,
        speed_positive=up * joint.speed_positive,
        speed_negative=down * joint.speed_negative,
        q_dot_up=up * joint.q_dot_up,
        q_dot_down=down * joint.q_dot_down,
    )
