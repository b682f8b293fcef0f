"""Episodes of training: random starts and goals, noisy observations. Paper: Sec. 3.4"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brokk_min.actuator import PLANT, Plant
from brokk_min.env import State, initial_state, observation_table
from brokk_min.machine import Array, Machine
from brokk_min.settings import TaskConfig

AXES = np.vstack([np.eye(3), -np.eye(3)])


def draw_pose(machine: Machine, rng: np.random.Generator, num: int) -> Array:
    """Random angles within the joints' ranges [rad] (num, n); some have a link in the ground."""
    return rng.uniform(machine.column("q_min"), machine.column("q_max"), (num, machine.n))


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
    machine: Machine, config: TaskConfig, rng: np.random.Generator, num: int, plant: Plant = PLANT
) -> State:
    """`num` machines at rest in random poses with random goals; leading shape (num,)."""
    pose = draw_pose(machine, rng, num)
    goal = draw_goal(machine, config, rng, num)
    hold = draw_hold(machine, config, rng, num)
    return initial_state(machine, pose, goal, plant)._replace(goal_ticks=hold)


def new_goals(
    machine: Machine, config: TaskConfig, state: State, rng: np.random.Generator, copies: int = 1
) -> State:
    """New goals where the time of a goal is over, each for `copies` neighbours."""
    rows = np.flatnonzero(state.goal_ticks <= 0)
    if not len(rows):
        return state
    num = len(rows) // copies
    v_goal, goal_ticks = state.v_goal.copy(), state.goal_ticks.copy()
    v_goal[rows] = draw_goal(machine, config, rng, num).repeat(copies, axis=0)
    goal_ticks[rows] = draw_hold(machine, config, rng, num).repeat(copies)
    return state._replace(v_goal=v_goal, goal_ticks=goal_ticks)


def draw_noise(machine: Machine, largest: float, num: int, rng: np.random.Generator) -> Array:
    """Uniform noise of `env.measure`, up to +- `largest` deviations, float32 (num, noisy)."""
    size = observation_table(machine)[2].sum()  # what sensors measure
    noise = 2 * rng.random((num, size), np.float32) - 1
    return np.float32(largest) * noise


def map_arrays(function: Callable[..., Any], first: Any, *others: Any) -> Any:
    """`function` of all arrays in a `State`, a memory or a plant's state: tuples of arrays."""
    if first is None:
        return None
    if isinstance(first, tuple):
        values = [map_arrays(function, *row) for row in zip(first, *others, strict=True)]
        return first._make(values) if hasattr(first, "_make") else tuple(values)
    return function(first, *others)


def replace_rows(values: Any, rows: NDArray[np.intp], fresh: Any) -> Any:
    """`values` with its rows `rows` replaced by `fresh`, one each; values as for `map_arrays`."""

    def replaced(old: Array, new: Array) -> Array:
        result = np.array(old)
        result[rows] = new
        return result

    return map_arrays(replaced, values, fresh)
