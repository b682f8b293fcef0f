"""The task: follow a tool velocity with the driven joints. Pure functions for any batch.

With nets as the plant these functions are the simulation; with another plant they are the machine.
`learning.episodes` draws starts and goals. The numbers below are of the Brokk 170, which has 4
driven joints and 1 locked joint; its history has H = 13 samples.

| Num     | Observation                                          | Deviation   | Noise |
|---------|------------------------------------------------------|-------------|-------|
| 0-2     | goal velocity of the tool                            | 0.093 m/s   | no    |
| 3-5     | measured velocity of the tool                        | 0.093 m/s   | yes   |
| 6       | angle of the locked joint                            | 0.404 rad   | yes   |
| 7-110   | 13 angles, 13 velocities of each driven joint        | of the task | yes   |
| 111-162 | 13 commands of each driven joint                     | 0.252       | no    |

Observation: Box, float32, (163,): each number less its mean, over its deviation in the task, see
`velocity_deviations`. The newest sample is last. Vectors are in the base frame.

Action: Box(-1, 1, (4,)), of the largest command of each driven joint.
Reward: 1 / (1 + |v_goal - v_tool|) (eq2).
Start: at rest in a random pose, with a random goal that changes now and then.
End: terminated, without reward, if the episode starts with a link in the ground; truncated after
20 s.

An `Interface` is what an agent reads, does and is paid for. The defaults are the paper's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brokk_min.actuator import PLANT, Plant, append_sample, initial_history
from brokk_min.kinematics import forward_kinematics, jacobian, lowest_point, tool_velocity
from brokk_min.machine import PWM_MAX, Array, Machine, Measured, limit_command, read_encoder
from brokk_min.settings import TaskConfig

DRAWS = 4096  # poses and goals on which deviations are measured
COMMAND_STD = 0.4  # of the largest command; runs of PIDs and policies had 0.30 to 0.43


def velocity_deviations(machine: Machine) -> tuple[Array, Array]:
    """Deviations in the task of tool [m/s] (3,) and joint velocities [rad/s] (n,), measured.

    Poses and speeds of goals are drawn as in training, in all directions. The joint velocities are
    the smallest that give the goal, pinv(J) v, cut at each joint's nominal speed, and at least 5 %
    of that speed.
    """
    rng = np.random.default_rng(0)
    q = rng.uniform(machine.column("q_min"), machine.column("q_max"), (DRAWS, machine.n))
    direction = rng.standard_normal((DRAWS, 3))
    speed = rng.uniform(0, machine.tool_speed, DRAWS) * (rng.random(DRAWS) >= TaskConfig.zero_goals)
    v = direction * (speed / np.linalg.norm(direction, axis=-1))[:, None]
    J = jacobian(forward_kinematics(machine, q))[..., machine.driven]
    q_dot = np.zeros_like(q)
    q_dot[:, machine.driven] = (np.linalg.pinv(J) @ v[..., None])[..., 0]
    q_dot = np.clip(q_dot, -machine.q_dot_max, machine.q_dot_max)
    return np.full(3, v.std()), np.maximum(q_dot.std(axis=0), 0.05 * machine.q_dot_max)


@lru_cache
def observation_table(machine: Machine) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Of each number observed its mean, deviation, and whether sensors measure it, (obs,) each.

    Angles are uniform over their range. Paper: Sec. 3.4 (normalisation)
    """
    H = machine.history
    q_mean = (machine.column("q_min") + machine.column("q_max")) / 2
    q_std = (machine.column("q_max") - machine.column("q_min")) / 12**0.5
    v_std, q_dot_std = velocity_deviations(machine)
    rows = [(0.0, std, 0.0) for std in v_std] + [(0.0, std, 1.0) for std in v_std]
    rows += [(q_mean[j], q_std[j], 1.0) for j in machine.locked]
    for j in machine.driven:
        rows += [(q_mean[j], q_std[j], 1.0)] * H + [(0.0, q_dot_std[j], 1.0)] * H
    rows += [(0.0, COMMAND_STD * machine.pwm_limit / PWM_MAX, 0.0)] * H * len(machine.driven)
    mean, std, noisy = np.array(rows, np.float32).T
    return mean, std, noisy == 1


def measure(
    machine: Machine, history: Array, v_goal: Array, noise: Array | float = 0.0
) -> Measured:
    """Measurements for training, evaluation and the machine. Paper: Sec. 3.4, Fig. 3

    From the measured history (..., n, 3, H) and the goal velocity [m/s] (..., 3). `noise` (...,
    noisy) is in deviations and is added to what sensors measure. It is new at each tick for all
    samples of the history, old ones too. The tool's velocity has noise of its own beside that of
    the angles in J.
    """
    q = history[..., 0, -1].copy()
    driven = history.take(machine.driven, axis=-3)
    _, std, noisy = observation_table(machine)
    error = np.asarray(noise * std[noisy])
    v_error, q_error, history_error = np.split(error, [3, 3 + len(machine.locked)], axis=-1)
    q[..., machine.locked] += q_error
    driven[..., :2, :] += history_error.reshape(*error.shape[:-1], -1, 2, machine.history)
    q[..., machine.driven] = driven[..., 0, -1]
    v_tool = tool_velocity(forward_kinematics(machine, q), history[..., 1, -1]) + v_error
    return Measured(v_goal, v_tool, q, driven[..., 1, -1], driven)


def features(machine: Machine, measured: Measured) -> Array:
    """The observation of the table above. Paper: Sec. 3.4, Fig. 3"""
    shape = (*measured.q.shape[:-1], -1)
    angles_and_velocities = measured.history[..., :2, :].reshape(shape)
    u = measured.history[..., 2, :].reshape(shape)
    q_locked = measured.q[..., machine.locked]
    numbers = [measured.v_goal, measured.v_tool, q_locked, angles_and_velocities, u]
    mean, std, _ = observation_table(machine)
    return (np.concatenate(numbers, axis=-1, dtype=np.float32) - mean) / std


def action_to_pwm(machine: Machine, action: ArrayLike) -> Array:
    """Commands u (..., n) of full command from actions of the driven joints (..., n_driven).

    ValueError: a wrong shape, or a number that is not finite.

    Example:
        >>> from brokk_min.machine import BROKK_170
        >>> action_to_pwm(BROKK_170, [1.0, -0.5, 0.0, 2.0]) * 127
        array([ 80.,   0., -40.,   0.,  80.])
    """
    a = np.asarray(action)
    if a.shape[-1:] != machine.driven.shape or not np.isfinite(a).all():
        raise ValueError(f"action: expected finite (..., {len(machine.driven)}), got {a}")
    u = np.zeros((*a.shape[:-1], machine.n), np.result_type(a, np.float32))
    u[..., machine.driven] = machine.pwm_limit / PWM_MAX * a
    return limit_command(machine, u)


@dataclass(frozen=True)
class Interface:
    """What an agent reads, does and is paid for; the defaults are the paper's.

    `memory` is what the agent keeps from tick to tick. At the start of an episode it is None; the
    paper's agent keeps nothing. Each tick calls `remember`, `observe` and `command`; after the
    transition `cost` gets the memory of the next tick. `learning.gym_env` takes the cost off eq2.
    The fields are functions, not methods.
    """

    scale: Callable[[Machine], tuple[Array, Array]] = (  # mean, deviation
        lambda machine: observation_table(machine)[:2]
    )
    remember: Callable[[Machine, Any, Measured], Any] = lambda machine, memory, measured: None
    observe: Callable[[Machine, Measured, Any], Array] = lambda machine, measured, memory: features(
        machine, measured
    )
    command: Callable[[Machine, Array, Any], Array] = lambda machine, action, memory: action_to_pwm(
        machine, action
    )
    cost: Callable[[Machine, Array, Array, Any], Array | float] = (  # of u after u_before
        lambda machine, u, u_before, memory: 0.0
    )


PAPER = Interface()


class State(NamedTuple):
    """One or many machines at work; arrays (..., n) unless noted."""

    plant: Any  # state of what moves the machine
    q: Array  # true angle [rad]
    q_dot: Array  # true mean velocity over the last tick [rad/s]
    v_tool: Array  # true velocity J(q) q_dot of the tool [m/s], (..., 3)
    lowest: Array  # height of the lowest point of a link [m], (...)
    history: Array  # measured angle, estimated velocity, sent command: (..., n, 3, H), float32
    v_goal: Array  # goal velocity of the tool [m/s], (..., 3)
    goal_ticks: NDArray[np.int64]  # ticks until a new goal, (...)
    ticks: NDArray[np.int64]  # ticks since the reset, (...)


def initial_state(machine: Machine, q: ArrayLike, v_goal: ArrayLike, plant: Plant = PLANT) -> State:
    """Machines at rest at angles `q` [rad] (..., n) with goals (..., 3) [m/s] that never change."""
    q = np.array(q, float)
    goal = np.broadcast_to(np.asarray(v_goal, np.float32), (*q.shape[:-1], 3))
    measured = read_encoder(machine, q).astype(np.float32)
    return State(
        plant=plant.reset(machine, q),
        q=q,
        q_dot=np.zeros_like(q),
        v_tool=np.zeros_like(goal),
        lowest=lowest_point(forward_kinematics(machine, q.astype(np.float32))),
        history=initial_history(measured, machine.history),
        v_goal=goal,
        goal_ticks=np.full(q.shape[:-1], np.iinfo(np.int64).max),
        ticks=np.zeros(q.shape[:-1], np.int64),
    )


def transition(machine: Machine, plant: Plant, state: State, u: Array) -> State:
    """One tick of the plant under the command `u` (..., n). Paper: Sec. 3.4"""
    after = plant.step(machine, state.plant, u)
    q = np.asarray(after.q, float)
    q_dot = (q - state.q) / machine.dt
    frames = forward_kinematics(machine, q.astype(np.float32))
    window = machine.velocity_samples, machine.dt
    return state._replace(
        plant=after,
        q=q,
        q_dot=q_dot,
        v_tool=tool_velocity(frames, q_dot.astype(np.float32)),
        lowest=lowest_point(frames),
        history=append_sample(state.history, u, read_encoder(machine, q), *window),
        goal_ticks=state.goal_ticks - 1,
        ticks=state.ticks + 1,
    )


def reward(v_goal: Array, v_tool: Array) -> Array:
    """1 / (1 + |v_goal - v_tool|) (...) of velocities [m/s] (..., 3), in (0, 1]. Paper: eq2"""
    return np.asarray(1 / (1 + np.linalg.norm(v_goal - v_tool, axis=-1)))


def terminated(machine: Machine, lowest: Array) -> NDArray[np.bool_]:
    """Is a link in the ground? `lowest` [m] (...) is `kinematics.lowest_point`. Paper: Sec. 3.4"""
    return np.asarray(lowest < machine.ground)


def step(
    machine: Machine, config: TaskConfig, plant: Plant, state: State, u: Array
) -> tuple[State, Array, NDArray[np.bool_], NDArray[np.bool_]]:
    """One tick under commands `u` (num, n) of `num` machines, without new goals or resets.

    Next state; reward, terminated, truncated (num,).
    """
    state = transition(machine, plant, state, u)
    end = terminated(machine, state.lowest) & (state.ticks == 1)  # a start in the ground
    truncated = (state.ticks >= round(config.episode_s * machine.rate)) & ~end
    return state, np.where(end, 0.0, reward(state.v_goal, state.v_tool)), end, truncated
