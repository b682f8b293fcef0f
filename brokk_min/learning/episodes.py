"""Episodes of training: random starts and goals, noisy observations. Paper: Sec. 3.4"""

from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brokk_min.env import (
    State,
    TaskConfig,
    features,
    initial_state,
    measure,
    sensor_std,
    terminated,
)
from brokk_min.kinematics import forward_kinematics, lowest_point
from brokk_min.machine import Array, Machine

# Settings of `train --paper` that differ from `TaskConfig`, assumed: goals that hold longer leave
# less noise in a critic's advantages.
PAPER_TASK: dict[str, Any] = {"hold_min_s": 2.0, "hold_max_s": 6.0}
# Settings for gradients of the simulation that differ from `ppo.PPOConfig`; D10 has the search.
GRADIENT_LEARNER: dict[str, Any] = {
    "total_steps": 2_000_000,
    "minibatch_size": 512,
    "learning_rate": 4e-3,
    "target_kl": 1e9,  # keep the learning rate
    "gamma": 0.95,
    "log_std": -2.5,
    "log_std_end": -4.5,
}
AXES = np.vstack([np.eye(3), -np.eye(3)])
GROUND_MARGIN = 0.3  # m above the ground below which no goal points down, assumed


def draw_pose(machine: Machine, config: TaskConfig, rng: np.random.Generator, num: int) -> Array:
    """Random angles within the joints' ranges [rad] (num, n), above the ground if so configured.

    ValueError: a machine whose arm is in the ground in every pose drawn.
    """
    low, high = machine.column("q_min"), machine.column("q_max")
    q = rng.uniform(low, high, (num, machine.n))
    if config.paper or not config.redraw_ground:
        return q
    for _ in range(1000):
        below = terminated(machine, lowest_point(forward_kinematics(machine, q)))
        if not below.any():
            return q
        q[below] = rng.uniform(low, high, (int(below.sum()), machine.n))
    raise ValueError(f"{machine.name}: expected a pose above the ground, got none in 1000 draws")


def draw_goal(machine: Machine, config: TaskConfig, rng: np.random.Generator, num: int) -> Array:
    """Random tool velocities [m/s] (num, 3): zero, along an axis, or anywhere; up to tool_speed."""
    direction = rng.standard_normal((num, 3))
    kind = rng.random((num, 1))
    axis = AXES[rng.integers(0, 6, num)]
    direction = np.where(kind < config.zero_goals + config.axis_goals, axis, direction)
    speed = rng.uniform(0, machine.tool_speed, (num, 1)) * (kind >= config.zero_goals)
    return np.asarray(speed * direction / np.linalg.norm(direction, axis=-1, keepdims=True))


def draw_hold(
    machine: Machine, config: TaskConfig, rng: np.random.Generator, num: int
) -> NDArray[np.int64]:
    """Random numbers of ticks for which a goal holds, (num,)."""
    low = max(1, round(config.hold_min_s * machine.rate))
    high = max(1, round(config.hold_max_s * machine.rate))
    return rng.integers(low, high + 1, num)


def reset(
    machine: Machine, config: TaskConfig, rng: np.random.Generator, num: int, plant: bool
) -> State:
    """`num` machines at rest in random poses with random goals; leading shape (num,)."""
    pose = draw_pose(machine, config, rng, num)
    goal = draw_goal(machine, config, rng, num)
    state = initial_state(machine, pose, goal, plant)
    return replace(state, goal_ticks=draw_hold(machine, config, rng, num))


def new_goals(
    machine: Machine, config: TaskConfig, state: State, rng: np.random.Generator
) -> State:
    """New goals where the time of a goal is over, or (ours) it points down close to the ground."""
    low = (state.lowest < machine.ground + GROUND_MARGIN) & (not config.paper)
    rows = np.flatnonzero((state.goal_ticks <= 0) | (low & (state.v_goal[..., 2] < 0)))
    if not len(rows):
        return state
    v_goal = state.v_goal.copy()
    goal_ticks = state.goal_ticks.copy()
    v_goal[rows] = draw_goal(machine, config, rng, len(rows))
    v_goal[rows, 2] = np.where(low[rows], np.abs(v_goal[rows, 2]), v_goal[rows, 2])
    goal_ticks[rows] = draw_hold(machine, config, rng, len(rows))
    return replace(state, v_goal=v_goal, goal_ticks=goal_ticks)


def draw_noise(machine: Machine, largest: float, num: int, rng: np.random.Generator) -> Array:
    """Uniform noise of `env.measure`, in deviations, float32 (num, noisy)."""
    steps = rng.integers(-(2**15), 2**15, (num, len(sensor_std(machine))), np.int16)
    return steps * np.float32(largest / 2**15)


def get_obs(machine: Machine, config: TaskConfig, state: State, rng: np.random.Generator) -> Array:
    """The observation of a state, (..., obs), with fresh noise. Paper: Sec. 3.4 (5 %)"""
    noise = draw_noise(machine, config.noise, len(state.q), rng)
    measured = measure(machine, state.history, state.v_goal, state.error_integral, noise)
    return features(machine, measured, config.paper)


def replace_rows(state: State, rows: NDArray[np.intp], fresh: State) -> State:
    """`state` with its rows `rows` replaced by the states `fresh`, one each.

    ValueError: a plant of another kind than tuples of arrays.
    """

    def put(old: Any, new: Any) -> Any:
        if old is None:
            return None
        if isinstance(old, tuple):  # the state of a plant
            return type(old)(*map(put, old, new))
        if not isinstance(old, np.ndarray):
            expected = "expected states that are tuples of arrays"
            raise ValueError(f"plant: {expected}, got {type(old).__name__}")
        result = old.copy()
        result[rows] = new
        return result

    return State(*(put(getattr(state, f.name), getattr(fresh, f.name)) for f in fields(State)))
