"""The task: follow a tool velocity with the driven joints. Pure functions for any batch.

On the nets these functions are the simulation, on the plant the machine. `learning.episodes` draws
starts and goals. The numbers below are of the Brokk 170: 4 driven joints, 1 locked joint, H = 13.
Observation: Box, float32, (223,), (x - mean) / deviation * weight of these blocks:

| Num     | Observation                                          | Deviation   | Weight | Noise |
|---------|------------------------------------------------------|-------------|--------|-------|
| 0-2     | goal velocity of the tool, heading frame             | 0.173 m/s   | 1.4    | no    |
| 3-5     | measured velocity of the tool, heading frame         | 0.173 m/s   | 1.4    | yes   |
| 6       | angle of the locked joint                            | 0.404 rad   | 1.4    | yes   |
| 7-110   | 13 angles, 13 velocities of each driven joint        | uniform     | 0.277  | yes   |
| 111-162 | 13 commands of each driven joint                     | 0.364       | 0.277  | no    |
| 163-214 | do these commands open valves (`open_indicator`)?    | 0.5         | 0.277  | no    |
| 215-218 | resolved velocities of the goal (`jacobian.dls`)     | uniform     | 4.2    | no    |
| 219-222 | joint motions that undo the error integral [rad]     | 0.1 uniform | 4.2    | no    |

"Uniform": over its range. The newest sample is last. Heading frame: x from slew axis to tool.

Action: Box(-1, 1, (4,)), of the largest command of each driven joint, see `action_to_pwm`.
Reward: 1 / (1 + |v_goal - v_tool|) (eq2), less costs of valve travel, error integral (and limits).
Start: at rest in a random pose above the ground, with a random goal that changes now and then.
End: terminated, without reward, with a link in the ground; truncated after 20 s.

The paper's agent (`TaskConfig.paper`) observes 0-162 in the base frame, with weights 1. Its actions
are linear, its reward is eq2 alone. Only a start in the ground terminates. No rule closes valves.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brokk_min import actuator, kinematics, machine
from brokk_min.actuator import ActuatorNet, Encoder, PlantState, append_sample, initial_history
from brokk_min.jacobian import dls, limit_penalty
from brokk_min.kinematics import forward_kinematics, jacobian, tool_velocity
from brokk_min.machine import PWM_MAX, Array, Machine, as_floats, limit_command, read_encoder

INTEGRAL_TIME = 2.0  # s, tuned: time constant of the error integral's leak
INTEGRAL_LIMIT = 0.07  # of tool_speed, tuned: velocity errors count up to here
COMPENSATION = 0.01  # of an action, assumed: up to here a command rises to the dead zone


@dataclass(frozen=True)
class TaskConfig:
    """What an episode is. Paper: Sec. 3.4; the numbers are assumed unless they name the paper."""

    episode_s: float = machine.number("s", 0.05, 1e6, 20.0)  # Length of an episode [s].
    hold_min_s: float = machine.number("s", 0, 1e6, 0.5)  # Shortest time of a velocity goal [s].
    hold_max_s: float = machine.number("s", "hold_min_s", 1e6, 3.0)  # Longest time of a goal [s].
    zero_goals: float = machine.number("1", 0, 1, 0.15)  # Fraction of goals of zero velocity.
    axis_goals: float = machine.number("1", 0, 1, 0.4)  # Fraction along x, y or z; others anywhere.
    noise: float = machine.number("1", 0, 1000, 0.05)  # Uniform, up to +- deviations (paper: 5 %).
    valve_cost: float = machine.number("1", 0, 1000, 0.1)  # If all change by the limit (paper: 0).
    integral_cost: float = machine.number("1/m", 0, 1000, 1.0)  # Of the error integral (paper: 0).
    limit_cost: float = machine.number("1", 0, 1000, 0.0)  # Of each joint at a limit; try 0.3.
    valves: actuator.Valves = "closed"  # While the tool rests: `actuator.command_at_rest`.
    redraw_ground: bool = True  # Redraw start poses in the ground; the paper ends the episode.
    paper: bool = False  # The paper's agent: observation, action, reward, start and end, see above.
    __post_init__ = machine.check_numbers  # type: ignore[misc]


class Measured(NamedTuple):
    """What controllers get, in physical units and the base frame."""

    v_goal: Array  # goal velocity of the tool [m/s], (..., 3)
    v_tool: Array  # measured velocity of the tool [m/s], (..., 3)
    q: Array  # angles [rad], (..., n); those of driven joints by `smooth_angles`
    q_dot: Array  # newest velocities of the driven joints [rad/s], (..., n_driven)
    history: Array  # angles, velocities, commands of the driven joints, (..., n_driven, 3, H)
    error_integral: Array  # of `integrate_error` [m], (..., 3)
    p_tool: Array  # position of the tool at `q` [m], (..., 3)
    J: Array  # Jacobian of the tool by all joints at `q` [m/rad], (..., 3, n)


class Block(NamedTuple):
    """Numbers of the observation that belong together."""

    name: str
    mean: ArrayLike  # in physical units, a number or (size,)
    std: Array  # (size,)
    weight: float
    noisy: bool  # do sensors measure it?


@lru_cache
def observation_blocks(machine: Machine, paper: bool = False) -> tuple[Block, ...]:
    """The observation, ours or the paper's, in its order. Paper: Sec. 3.4 (normalisation)

    Means and deviations: of uniform distributions over the ranges; of indicators 0.5. H samples
    (H^-0.5 each) weigh as one number, resolved velocities most: nets learn first what is large.
    """
    H = machine.history
    q_mean = (machine.column("q_min") + machine.column("q_max")) / 2
    q_std = (machine.column("q_max") - machine.column("q_min")) / 12**0.5
    q_dot_std = machine.q_dot_max / 3**0.5
    v_std = np.full(3, machine.tool_speed / 3**0.5)
    u_std = np.full(H * len(machine.driven), machine.pwm_limit / PWM_MAX / 3**0.5)
    blocks = [
        Block("v_goal", 0.0, v_std, 1.4, False),
        Block("v_tool", 0.0, v_std, 1.4, True),
        Block("q locked", q_mean[machine.locked], q_std[machine.locked], 1.4, True),
    ]
    for j in machine.driven:
        blocks.append(Block(f"q {j}", q_mean[j], np.full(H, q_std[j]), H**-0.5, True))
        blocks.append(Block(f"q_dot {j}", 0.0, np.full(H, q_dot_std[j]), H**-0.5, True))
    blocks.append(Block("u", 0.0, u_std, H**-0.5, False))
    if paper:
        return tuple(block._replace(weight=1.0) for block in blocks)
    blocks += [
        Block("open", 0.5, np.full_like(u_std, 0.5), H**-0.5, False),
        Block("resolved v_goal", 0.0, q_dot_std[machine.driven], 4.2, False),
        Block("resolved error_integral", 0.0, 0.1 * q_dot_std[machine.driven], 4.2, False),
    ]
    return tuple(blocks)


@lru_cache
def observation_scale(machine: Machine, paper: bool = False) -> tuple[Array, Array]:
    """Mean and scale = std / weight of the observation, float32 (obs,) both."""
    blocks = observation_blocks(machine, paper)
    mean = np.concatenate([np.broadcast_to(block.mean, block.std.shape) for block in blocks])
    scale = np.concatenate([block.std / block.weight for block in blocks])
    return mean.astype(np.float32), scale.astype(np.float32)


@lru_cache
def sensor_std(machine: Machine) -> Array:
    """Deviations of what sensors measure, the unit of its noise, float32 (noisy numbers,)."""
    return np.concatenate([b.std for b in observation_blocks(machine) if b.noisy], dtype=np.float32)


def measure(
    machine: Machine, history: Array, v_goal: Array, integral: Array, noise: Array | float = 0.0
) -> Measured:
    """Measurements for training, evaluation and the machine. Paper: Sec. 3.4, Fig. 3

    From the measured history (..., n, 3, H), the goal velocity [m/s] and the error integral [m]
    (..., 3), both in the base frame; `noise` of what sensors measure, in deviations (..., noisy).
    """
    q = history[..., 0, -1].copy()
    driven = history.take(machine.driven, axis=-3)
    error = np.asarray(noise * sensor_std(machine))
    v_error, q_error, history_error = np.split(error, [3, 3 + len(machine.locked)], axis=-1)
    q[..., machine.locked] += q_error
    driven[..., :2, :] += history_error.reshape(*error.shape[:-1], -1, 2, machine.history)
    q[..., machine.driven] = actuator.smooth_angles(machine, driven)
    frames = forward_kinematics(machine, q)
    p_tool = kinematics.tool_position(frames)
    J = jacobian(frames)
    v_tool = (J @ history[..., 1, -1, None])[..., 0] + v_error  # v = J q_dot, noise of its own
    return Measured(v_goal, v_tool, q, driven[..., 1, -1], driven, integral, p_tool, J)


def features(machine: Machine, measured: Measured, paper: bool = False) -> Array:
    """The observation of the table above, ours or the paper's. Paper: Sec. 3.4, Fig. 3"""
    shape = (*measured.q.shape[:-1], -1)
    u = measured.history[..., 2, :]
    numbers = [measured.v_goal, measured.v_tool, measured.q[..., machine.locked]]
    numbers += [measured.history[..., :2, :].reshape(shape), u.reshape(shape)]
    if not paper:
        numbers[:2] = [kinematics.to_heading(measured.p_tool, v) for v in numbers[:2]]
        opens = actuator.open_indicator(u, machine.dead_zones[machine.driven, None])
        numbers.append(opens.reshape(shape))
        J, integral = measured.J[..., machine.driven], measured.error_integral
        arm = np.hypot(machine.column("a"), machine.column("d")).sum()  # lambda: 6 % of it, assumed
        J_inv = dls(J, machine.column("weight")[machine.driven], (0.06 * arm) ** 2 + 1e-6)
        numbers += [(J_inv @ v[..., None])[..., 0] for v in (measured.v_goal, integral)]
    mean, scale = observation_scale(machine, paper)
    return (np.concatenate(numbers, axis=-1, dtype=np.float32) - mean) / scale


def integrate_error(machine: Machine, v_goal: Array, v_tool: Array, integral: Array) -> Array:
    """Leaky integral of the velocity error [m] (..., 3), one tick on: the I of a PI controller.

    I_{t+1} = exp(-dt / T) (I_t + dt e), e = v_goal - v_tool, cut to 7 % of the tool speed.
    """
    error = v_goal - v_tool
    limit = np.float32(INTEGRAL_LIMIT * machine.tool_speed)
    error = error * (limit / np.maximum(np.linalg.norm(error, axis=-1, keepdims=True), limit))
    leak = np.float32(np.exp(-machine.dt / INTEGRAL_TIME))
    return np.asarray(leak * (integral + np.float32(machine.dt) * error))


def update_history(
    machine: Machine, history: Array, u: Array, q: Array, v_goal: Array, integral: Array
) -> tuple[Array, Array]:
    """Measured history (..., n, 3, H) and error integral [m] (..., 3), one tick on.

    `u` (..., n) was sent for `v_goal` [m/s] (..., 3), then the encoders gave `q` [rad] (..., n).
    """
    history = append_sample(history, u, q, machine.velocity_samples, machine.dt)
    v_tool = tool_velocity(forward_kinematics(machine, history[..., 0, -1]), history[..., 1, -1])
    return history, integrate_error(machine, v_goal, v_tool, integral)


def action_to_pwm(machine: Machine, action: ArrayLike, paper: bool = False) -> Array:
    """Commands u (..., n) of full command from actions of the driven joints (..., n_driven).

    u = dead_zone clip(a / 0.01, -1, 1) + (limit - dead_zone) a: the least dead zone is compensated;
    the PIDs compensate each joint's. The paper's agent: u = limit a. Paper: Sec. 3.3, Sec. 3.4
    ValueError: a wrong shape, a number that is not finite.

    Example:
        >>> from brokk_min.machine import BROKK_170
        >>> action_to_pwm(BROKK_170, [1.0, -0.5, 0.0, 2.0]) * 127
        array([ 80.,   0., -44.,   0.,  80.])
    """
    a = as_floats(action)
    if a.shape[-1:] != machine.driven.shape:
        raise ValueError(f"action: expected (..., {len(machine.driven)}), got {a.shape}")
    if not np.isfinite(a).all():
        raise ValueError(f"action: expected finite numbers, got {a[~np.isfinite(a)][0]}")
    limit = machine.pwm_limit / PWM_MAX
    dead_zone = 0.0 if paper else machine.dead_zone
    u = np.zeros((*a.shape[:-1], machine.n), a.dtype)
    u[..., machine.driven] = dead_zone * np.clip(a / COMPENSATION, -1, 1) + (limit - dead_zone) * a
    return limit_command(machine, u)


@dataclass(frozen=True)
class State:
    """One or many machines at work; arrays (..., n) unless noted. Changed with `replace` only."""

    q: Array  # true angle [rad]
    q_dot: Array  # true mean velocity over the last tick [rad/s]
    v_tool: Array  # true velocity J(q) q_dot of the tool [m/s], (..., 3)
    lowest: Array  # height of the lowest point of a link [m], (...)
    history: Array  # measured angle, estimated velocity, sent command: (..., n, 3, H), float32
    true_history: Array  # the same of the driven joints, of true angles: what the nets get
    v_goal: Array  # goal velocity of the tool [m/s], (..., 3)
    goal_ticks: NDArray[np.int64]  # ticks until a new goal, (...)
    ticks: NDArray[np.int64]  # ticks since the reset, (...)
    rest_ticks: NDArray[np.int64]  # ticks for which the goal has been zero, (...)
    error_integral: Array  # of `integrate_error` [m], (..., 3)
    plant: PlantState | None = None  # None: the nets move the machine


def initial_state(machine: Machine, q: ArrayLike, v_goal: ArrayLike, plant: bool) -> State:
    """Machines at rest at angles `q` [rad] (..., n) with goals (..., 3) [m/s] that never change."""
    q = np.array(q, float)
    plant_state = actuator.plant_reset(machine, q) if plant else None
    encoder = read_encoder(machine, getattr(plant_state, "encoder", q)).astype(np.float32)
    goal = np.broadcast_to(np.asarray(v_goal, np.float32), (*q.shape[:-1], 3))
    return State(
        q=q,
        q_dot=np.zeros_like(q),
        v_tool=np.zeros_like(goal),
        lowest=kinematics.lowest_point(forward_kinematics(machine, q.astype(np.float32))),
        history=initial_history(encoder, machine.history),
        true_history=initial_history(q[..., machine.driven].astype(np.float32), machine.history),
        v_goal=goal,
        goal_ticks=np.full(q.shape[:-1], np.iinfo(np.int64).max),
        ticks=np.zeros(q.shape[:-1], np.int64),
        rest_ticks=np.zeros(q.shape[:-1], np.int64),
        error_integral=np.zeros_like(goal),
        plant=plant_state,
    )


def transition(
    machine: Machine, net: ActuatorNet | None, state: State, u: Array, read: Encoder = read_encoder
) -> State:
    """One tick under the command `u` (..., n), by the plant if the state has one, else by the nets.

    `read` gives encoder angles, of q or a plant's own `encoder`; nets get true q. Paper: Sec. 3.4
    """
    plant = state.plant and actuator.plant_step(machine, state.plant, u)
    q = plant.q if plant else actuator.net_step(machine, net, state.true_history, state.q, u)
    driven = machine.driven
    window = machine.velocity_samples, machine.dt
    history = append_sample(state.history, u, read(machine, getattr(plant, "encoder", q)), *window)
    q_dot = (q - state.q) / machine.dt
    poses = np.stack([q, history[..., 0, -1]], dtype=np.float32)  # true and measured
    velocities = np.stack([q_dot, history[..., 1, -1]], dtype=np.float32)
    frames = forward_kinematics(machine, poses)
    v_tool, v_measured = tool_velocity(frames, velocities)
    return replace(
        state,
        q=q,
        q_dot=q_dot,
        v_tool=v_tool,
        lowest=kinematics.lowest_point(frames)[0],
        history=history,
        true_history=append_sample(state.true_history, u[..., driven], q[..., driven], *window),
        goal_ticks=state.goal_ticks - 1,
        ticks=state.ticks + 1,
        error_integral=integrate_error(machine, state.v_goal, v_measured, state.error_integral),
        plant=plant,
    )


def reward(v_goal: Array, v_tool: Array) -> Array:
    """1 / (1 + |v_goal - v_tool|) (...) of velocities [m/s] (..., 3), in (0, 1]. Paper: eq2"""
    return np.asarray(1 / (1 + np.linalg.norm(v_goal - v_tool, axis=-1)))


def terminated(machine: Machine, lowest: Array) -> NDArray[np.bool_]:
    """Is a link in the ground? `lowest` [m] (...) is `kinematics.lowest_point`. Paper: Sec. 3.4"""
    return np.asarray(lowest < machine.ground)


def step(
    machine: Machine, config: TaskConfig, net: ActuatorNet | None, state: State, action: ArrayLike
) -> tuple[State, Array, NDArray[np.bool_], NDArray[np.bool_], Array]:
    """One tick under actions (num, n_driven) of `num` machines, without new goals or resets.

    Next state; reward, terminated, truncated, |v_goal - v_tool| [m/s] (num,). ValueError: actions.
    """
    u = action_to_pwm(machine, action, config.paper)
    valves = "open" if config.paper else config.valves
    u, _, rest = actuator.command_at_rest(machine, valves, u, state.v_goal, state.rest_ticks)
    state = replace(transition(machine, net, state, u), rest_ticks=rest)
    rewards = reward(state.v_goal, state.v_tool)
    error = np.linalg.norm(state.v_goal - state.v_tool, axis=-1)
    if not config.paper:
        change = np.abs(u - state.history[..., 2, -2]) * PWM_MAX / machine.pwm_limit
        rewards = rewards - config.valve_cost * change[..., machine.driven].mean(axis=-1)
        rewards = rewards - config.integral_cost * np.linalg.norm(state.error_integral, axis=-1)
        penalty = limit_penalty(machine, state.q)[0][..., machine.driven]
        rewards = rewards - config.limit_cost * penalty.sum(axis=-1)
    end = terminated(machine, state.lowest) & ((state.ticks == 1) | (not config.paper))
    truncated = (state.ticks >= round(config.episode_s * machine.rate)) & ~end
    return state, np.where(end, 0.0, rewards), end, truncated, error
