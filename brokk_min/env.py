"""The task: follow a tool velocity with the driven joints. Pure functions for any batch.

`reset` begins an episode and `step` is one tick (Fig. 3 and 4). With nets as the plant these are
the simulation; with another plant they are the machine. The numbers below are of the Brokk 170,
which has 4 driven joints and 1 locked joint; its history has H = 13 samples.

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

"""

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

Bools = NDArray[np.bool_]
Rng = np.random.Generator
DIRECTIONS = np.vstack([np.eye(3), -np.eye(3)])  # along the axes, both ways
DRAWS = 4096  # poses and goals on which deviations are measured
COMMAND_STD = 0.4  # of the largest command; runs of PIDs and policies had 0.30 to 0.43


def velocity_deviations(machine: Machine) -> tuple[Array, Array]:
    """Deviations in the task of tool [m/s] (3,) and joint velocities [rad/s] (n,), measured.

    Poses and speeds are drawn as in training, directions anywhere. The joint velocities are
    the smallest that give the goal, pinv(J) v, cut at each joint's nominal speed, and at least 5 %
    of that speed.

    >>> velocity_deviations(BROKK_170)[0].round(3).tolist()
    [0.093, 0.093, 0.093]
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


class Scale(NamedTuple):
    """Of each number observed its mean, its deviation, and do sensors measure it? (obs,) each."""

    mean: Array
    std: Array
    measured: Bools


@lru_cache
def observation_table(machine: Machine) -> Scale:
    """The table above in numbers; angles are uniform over their range. Paper: Sec. 3.4

    >>> observation_table(BROKK_170).mean.shape
    (163,)
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
    mean, std, measured = np.array(rows, np.float32).T
    return Scale(mean, std, measured == 1)


def measure(
    machine: Machine, history: Array, v_goal: Array, noise: Array | float = 0.0
) -> Measured:
    """Measurements for training, evaluation and the machine. Paper: Sec. 3.4, Fig. 3

    From the measured history (..., n, 3, H) and the goal velocity [m/s] (..., 3). `noise` (...,
    noisy) is in deviations and is added to what sensors measure. It is new at each tick for all
    samples of the history, old ones too. The tool's velocity has noise of its own beside that of
    the angles in J.

    >>> state = initial_state(BROKK_170, BROKK_170.q_start, np.zeros(3))
    >>> measure(BROKK_170, state.history, state.v_goal).history.shape  # of driven joints
    (4, 3, 13)
    """
    q = history[..., 0, -1].copy()
    driven = history.take(machine.driven, axis=-3)
    scale = observation_table(machine)
    error = np.asarray(noise * scale.std[scale.measured])
    # as the table has them: 3 of the tool, the locked angles, 13 angles and 13 velocities a joint
    v_error, q_error, history_error = np.split(error, [3, 3 + len(machine.locked)], axis=-1)
    q[..., machine.locked] += q_error
    driven[..., :2, :] += history_error.reshape(*error.shape[:-1], -1, 2, machine.history)
    q[..., machine.driven] = driven[..., 0, -1]
    v_tool = tool_velocity(forward_kinematics(machine, q), history[..., 1, -1]) + v_error
    return Measured(v_goal, v_tool, q, driven[..., 1, -1], driven)


def features(machine: Machine, measured: Measured) -> Array:
    """The observation of the table above. Paper: Sec. 3.4, Fig. 3

    >>> state = initial_state(BROKK_170, BROKK_170.q_start, np.zeros(3))
    >>> features(BROKK_170, measure(BROKK_170, state.history, state.v_goal)).shape
    (163,)
    """
    shape = (*measured.q.shape[:-1], -1)
    angles_and_velocities = measured.history[..., :2, :].reshape(shape)
    u = measured.history[..., 2, :].reshape(shape)
    q_locked = measured.q[..., machine.locked]
    numbers = [measured.v_goal, measured.v_tool, q_locked, angles_and_velocities, u]
    scale = observation_table(machine)
    return (np.concatenate(numbers, axis=-1, dtype=np.float32) - scale.mean) / scale.std


def action_to_pwm(machine: Machine, action: ArrayLike) -> Array:
    """Commands u (..., n) of full command from actions of the driven joints (..., n_driven).

    ValueError: a wrong shape, or a number that is not finite.

    >>> action_to_pwm(BROKK_170, [1.0, -0.5, 0.0, 2.0]) * 127
    array([ 80.,   0., -40.,   0.,  80.])
    """
    a = np.asarray(action)
    if a.shape[-1:] != machine.driven.shape or not np.isfinite(a).all():
        raise ValueError(f"action: expected finite (..., {len(machine.driven)}), got {a}")
    u = np.zeros((*a.shape[:-1], machine.n), np.result_type(a, np.float32))
    u[..., machine.driven] = machine.pwm_limit / PWM_MAX * a
    return limit_command(machine, u)


class Interface:
    """What an agent reads, does and is paid for: the paper's. A subclass may do it otherwise.

    In each tick an agent remembers, observes and commands; once the machine has moved, `cost` is
    taken off the reward. `memory` is what it keeps from tick to tick, None before the first. The
    paper's keeps nothing and pays nothing, but `beyond.interface` does.
    """

    def scale(self, machine: Machine) -> tuple[Array, Array]:
        """Mean and deviation of each number observed, float32 (obs,) both."""
        return observation_table(machine)[:2]

    def remember(self, machine: Machine, memory: Any, measured: Measured) -> Any:
        """The memory of this tick; the paper's agent keeps nothing."""
        return None

    def observe(self, machine: Machine, measured: Measured, memory: Any) -> Array:
        """The observation, float32 (..., obs)."""
        return features(machine, measured)

    def command(self, machine: Machine, action: Array, memory: Any) -> Array:
        """Commands u [-1, 1] (..., n) of actions (..., n_driven)."""
        return action_to_pwm(machine, action)

    def cost(self, machine: Machine, u: Array, u_before: Array, memory: Any) -> Array | float:
        """What is taken off the reward (...) for `u` after `u_before`; in the paper nothing."""
        return 0.0


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
    """Machines at rest at angles `q` [rad] (..., n) with goals (..., 3) [m/s] that never change.

    >>> initial_state(BROKK_170, np.zeros((256, 5)), [0.1, 0, 0]).v_goal.shape
    (256, 3)
    """
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
    """One tick of the plant under the command `u` (..., n). Paper: Sec. 3.4

    >>> state = initial_state(BROKK_170, BROKK_170.q_start, np.zeros(3))
    >>> float(transition(BROKK_170, PLANT, state, np.zeros(5)).v_tool.max())  # at rest
    0.0
    """
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
    """1 / (1 + |v_goal - v_tool|) (...) of velocities [m/s] (..., 3), in (0, 1]. Paper: eq2

    >>> reward(np.array([0.2, 0.0, 0.0]), np.array([0.2, 0.0, 0.25])).tolist()
    0.8
    """
    return np.asarray(1 / (1 + np.linalg.norm(v_goal - v_tool, axis=-1)))


def terminated(machine: Machine, lowest: Array) -> Bools:
    """Is a link in the ground? `lowest` [m] (...) is `kinematics.lowest_point`. Paper: Sec. 3.4

    >>> terminated(BROKK_170, np.array([0.1, -0.1])).tolist()
    [False, True]
    """
    return np.asarray(lowest < machine.ground)


# --- episodes of many machines --------------------------------------------------------------------


def draw_pose(machine: Machine, config: TaskConfig, rng: Rng, num: int) -> Array:
    """Random angles within the joints' ranges [rad] (num, n); some have a link in the ground.

    >>> draw_pose(BROKK_170, TaskConfig(), np.random.default_rng(0), 256).shape
    (256, 5)
    """
    return rng.uniform(machine.column("q_min"), machine.column("q_max"), (num, machine.n))


def draw_goal(machine: Machine, config: TaskConfig, rng: Rng, num: int) -> Array:
    """Random tool velocities [m/s] (num, 3): zero, along an axis, or anywhere; up to tool_speed.

    >>> goals = draw_goal(BROKK_170, TaskConfig(), np.random.default_rng(0), 256)
    >>> bool(np.linalg.norm(goals, axis=-1).max() <= 0.3)
    True
    """
    direction = rng.standard_normal((num, 3))
    kind = rng.random((num, 1))
    axis = DIRECTIONS[rng.integers(0, 6, num)]
    direction = np.where(kind < config.zero_goals + config.axis_goals, axis, direction)
    speed = rng.uniform(0, machine.tool_speed, (num, 1)) * (kind >= config.zero_goals)
    return np.asarray(speed * direction / np.linalg.norm(direction, axis=-1, keepdims=True))


def draw_hold(machine: Machine, config: TaskConfig, rng: Rng, num: int) -> NDArray[np.int64]:
    """Random numbers of ticks for which a goal holds, (num,).

    >>> hold = draw_hold(BROKK_170, TaskConfig(), np.random.default_rng(0), 256)
    >>> bool((hold >= 40).all() and (hold <= 120).all())  # 2 to 6 s
    True
    """
    low = max(1, round(config.hold_min_s * machine.rate))
    high = max(1, round(config.hold_max_s * machine.rate))
    return rng.integers(low, high + 1, num)


def draw_noise(machine: Machine, config: TaskConfig, rng: Rng, num: int) -> Array:
    """Uniform noise of `measure` [deviations], float32 (num, noisy). Paper: Sec. 3.4 (5 %)

    >>> draw_noise(BROKK_170, TaskConfig(), np.random.default_rng(0), 256).shape
    (256, 108)
    """
    size = observation_table(machine).measured.sum()
    return np.float32(config.noise) * (2 * rng.random((num, size), np.float32) - 1)


class Episodes(NamedTuple):
    """Machines and their agents in the middle of episodes, (num, ...)."""

    state: State
    memory: Any  # of the agents, see `Interface`
    obs: Array  # what they read next, float32 (num, obs)


Draw = Callable[[Machine, TaskConfig, Rng, int], NDArray[Any]]
Outcome = tuple[Episodes, Array, Bools, Bools, dict[str, Any]]  # of a `tick`


@dataclass(frozen=True)
class Task:
    """What is simulated. A subclass may let machines share draws and ends."""

    machine: Machine
    plant: Plant
    config: TaskConfig
    interface: Interface

    def draw(self, what: Draw, rng: Rng, num: int) -> NDArray[Any]:
        """Random poses, goals, holds or noise of `num` machines, as one of the functions above."""
        return what(self.machine, self.config, rng, num)

    def ends(self, state: State) -> tuple[Bools, Bools]:
        """Terminated: it began in the ground; truncated: its time is over. (num,)

        A reset cannot end an episode in Gymnasium, so one in the ground ends after its first tick.
        """
        end = terminated(self.machine, state.lowest) & (state.ticks == 1)
        return end, (state.ticks >= round(self.config.episode_s * self.machine.rate)) & ~end


def reset(task: Task, rng: Rng, num: int) -> Episodes:
    """`num` machines at rest in random poses, with random goals. Paper: Sec. 3.4

    >>> task = Task(BROKK_170, PLANT, TaskConfig(), PAPER)
    >>> reset(task, np.random.default_rng(0), 256).obs.shape
    (256, 163)
    """
    pose, goal, hold = (task.draw(what, rng, num) for what in (draw_pose, draw_goal, draw_hold))
    state = initial_state(task.machine, pose, goal, task.plant)._replace(goal_ticks=hold)
    return look(task, rng, state, None)


def look(task: Task, rng: Rng, state: State, memory: Any) -> Episodes:
    """What the agents remember and observe of a state, with fresh noise. Paper: Fig. 3"""
    noise = task.draw(draw_noise, rng, len(state.q))
    measured = measure(task.machine, state.history, state.v_goal, noise)
    memory = task.interface.remember(task.machine, memory, measured)
    return Episodes(state, memory, task.interface.observe(task.machine, measured, memory))


def new_goals(task: Task, rng: Rng, state: State) -> State:
    """New goals where the time of a goal is over."""
    rows = np.flatnonzero(state.goal_ticks <= 0)
    if not len(rows):
        return state
    v_goal, goal_ticks = state.v_goal.copy(), state.goal_ticks.copy()
    v_goal[rows] = task.draw(draw_goal, rng, len(rows))
    goal_ticks[rows] = task.draw(draw_hold, rng, len(rows))
    return state._replace(v_goal=v_goal, goal_ticks=goal_ticks)


def tick(task: Task, rng: Rng, before: Episodes, actions: Array) -> Outcome:
    """One tick under actions (num, n_driven); episodes that end are not begun anew.

    Returns the next episodes; reward, terminated, truncated (num,); and the velocity error [m/s]
    and whether the goal has changed since.
    """
    m, interface, u_before = task.machine, task.interface, before.state.history[..., 2, -1]
    u = interface.command(m, actions, before.memory)
    state = transition(m, task.plant, before.state, u)
    after = look(task, rng, new_goals(task, rng, state), before.memory)
    end, truncated = task.ends(state)
    earned = reward(state.v_goal, state.v_tool) - interface.cost(m, u, u_before, after.memory)
    error = np.linalg.norm(state.v_goal - state.v_tool, axis=-1)
    info = {"velocity_error": error, "new_goal": state.goal_ticks <= 0}
    return after, np.where(end, 0.0, earned), end, truncated, info


def step(task: Task, rng: Rng, before: Episodes, actions: Array) -> Outcome:
    """A `tick`, then new episodes where some have ended: same-step resets. Paper: Fig. 4

    Their own last observations are in the dictionary as `final_obs`.

    >>> rng, task = np.random.default_rng(0), Task(BROKK_170, PLANT, TaskConfig(), PAPER)
    >>> _, earned, *_ = step(task, rng, reset(task, rng, 256), np.zeros((256, 4)))
    >>> earned.shape, bool(earned.max() <= 1)
    ((256,), True)
    """
    after, earned, end, truncated, info = tick(task, rng, before, actions)
    if (ended := end | truncated).any():
        info |= {"final_obs": after.obs, "_final_obs": ended}
        after = restart(task, rng, after, ended)
    return after, earned, end, truncated, info


def restart(task: Task, rng: Rng, episodes: Episodes, ended: Bools) -> Episodes:
    """New episodes where some have `ended` (num,); the others go on."""
    rows = np.flatnonzero(ended)

    def replaced(old: Array, new: Array) -> Array:
        result = np.array(old)
        result[rows] = new
        return result

    result: Episodes = map_arrays(replaced, episodes, reset(task, rng, len(rows)))
    return result


def map_arrays(function: Callable[..., Any], first: Any, *others: Any) -> Any:
    """`function` of all arrays in `Episodes`, their `State`, the plant's state, and the memory.

    >>> map_arrays(lambda x: x[0], (np.array([1, 2]), None))
    (np.int64(1), None)
    """
    if first is None:
        return None
    if isinstance(first, tuple):
        values = [map_arrays(function, *row) for row in zip(first, *others, strict=True)]
        return first._make(values) if hasattr(first, "_make") else tuple(values)
    return function(first, *others)
