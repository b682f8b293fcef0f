"""The task: follow a tool velocity with the driven joints. Pure functions for any number of machines.

`transition` moves the machine without randomness; `observation.observe`, `reward` and `terminated` look at
it; `step` composes them and draws noise and goals. With nets these functions are the simulation
(`environments` for Gymnasium), with a plant the evaluation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brokk_min.actuator import ActuatorNet, push_command, rest_history
from brokk_min.kinematics import lowest_point, tool_state
from brokk_min.machine import PWM_MAX, Array, Machine, lengths, read_encoder
from brokk_min.observation import (
    draw_noise,
    observe,
    paper_view,
    push_measured,
    push_motion,
    to_command,
)
from brokk_min.plant import PlantState, plant_reset, plant_step

GROUND_MARGIN = 0.3  # m above the ground below which no goal asks the arm to sink, assumed
AXES = np.vstack([np.eye(3), -np.eye(3)])  # x, y, z, and back
Bools = NDArray[np.bool_]
Encoder = Callable[[Machine, Array], Array]  # machine and true angles -> angles read


@dataclass(frozen=True)
class TaskConfig:
    """What an episode is. Paper: Sec. 3.4; the numbers are assumed unless they name the paper."""

    episode_s: float = 20.0
    """Length of an episode [s]; its end is a truncation, never a termination."""
    hold_min_s: float = 0.5
    """Shortest time for which a velocity goal holds [s]."""
    hold_max_s: float = 3.0
    """Longest time for which a velocity goal holds [s]."""
    zero_goals: float = 0.15
    """Share of goals that ask the tool to stand still."""
    axis_goals: float = 0.4
    """Share of goals along x, y or z; the others point anywhere."""
    noise: float = 0.05
    """Largest noise of the measured part of an observation, in standard deviations (paper: 5 %)."""
    valve_cost: float = 0.05
    """Reward lost for each change of a command by its limit, mean of the driven joints (paper: 0)."""
    lag_cost: float = 1.0
    """Reward lost for each metre that the tool stays behind, see `observation.push_lag` [1/m] (paper: 0)."""
    redraw_ground: bool = True
    """Redraw start poses in the ground; False is the paper's rule: end the episode without reward."""
    paper: bool = False
    """Observation (no wanted rates, no weights), reward (no costs) and critic as the paper has them."""


@dataclass(frozen=True)
class State:
    """One or many machines at work; arrays (..., n) unless noted. Changed with `replace` only."""

    q: Array  # true angle [rad]
    q_dot: Array  # true mean velocity over the last tick [rad/s]
    history: Array  # measured angle, estimated velocity, sent command: (..., n, 3, H), float32
    v_goal: Array  # wanted tool velocity [m/s], (..., 3)
    goal_ticks: NDArray[np.int64]  # ticks until a new goal, (...)
    ticks: NDArray[np.int64]  # ticks since the reset, (...)
    lag: Array  # see `observation.push_lag` [m], (..., 3)
    motion: Array  # as `history`, but of true angles: what nets go on from
    plant: PlantState | None = None  # None: the nets move the machine


def fitting_nets(machine: Machine, net: ActuatorNet) -> ActuatorNet:
    """The nets of the machine's driven joints.

    Raises:
        ValueError: nets that do not fit the machine, naming what was wanted and found.
    """
    wanted = {
        "machine": machine.name,
        "rate": machine.rate,
        "history": machine.history,
        "velocity_samples": machine.velocity_samples,
        "velocity_logged": False,  # a bus carries angles only
    }
    found = {name: getattr(net, name) for name in wanted}
    if found != wanted:
        raise ValueError(f"actuator: expected nets for {machine.name} with {wanted}, got {found}")
    return net.select([machine.names[i] for i in machine.driven])


def rest_state(machine: Machine, q: ArrayLike, v_goal: ArrayLike, plant: bool) -> State:
    """Machines at rest at angles `q` [rad] (..., n) with goals (..., 3) [m/s] that never change."""
    q = np.array(q, float)
    history, motion = (
        rest_history(a.astype(np.float32), machine.history) for a in (read_encoder(machine, q), q)
    )
    goals = np.broadcast_to(np.asarray(v_goal, np.float32), (*q.shape[:-1], 3))
    never = np.full(q.shape[:-1], np.iinfo(np.int64).max)
    ticks = np.zeros(q.shape[:-1], np.int64)
    plant_state = plant_reset(machine, q) if plant else None
    return State(
        q, np.zeros_like(q), history, goals, never, ticks, np.zeros_like(goals), motion, plant_state
    )


def transition(
    machine: Machine, net: ActuatorNet | None, state: State, u: Array, read: Encoder = read_encoder
) -> State:
    """One tick under the command `u` (..., n), by the nets, or by the plant where the state has one.

    `read(machine, q)` are the angles that the encoders say; they may be disturbed for a test of robustness.
    Nets go on from the true angles, for the steps of an encoder do not move an arm.

    Paper: Sec. 3.4 (actuator nets in the simulation), Table 1
    """
    q, plant = state.q, None
    if state.plant is not None:
        plant = plant_step(machine, state.plant, u)
        q = plant.q
    elif net is not None:
        driven, low, high = machine.driven, machine.column("q_min"), machine.column("q_max")
        seen = push_command(state.motion[..., driven, :, :], u[..., driven])
        moved = q[..., driven] + net.predict(seen) * machine.dt
        q = q.copy()
        q[..., driven] = np.clip(moved, low[driven], high[driven])
    else:
        raise ValueError("net: expected nets for a state without a plant, got None")

    history, lag = push_measured(
        machine, state.history, u, read(machine, q), state.v_goal, state.lag
    )
    return replace(
        state,
        q=q,
        q_dot=(q - state.q) * machine.rate,
        history=history,
        goal_ticks=state.goal_ticks - 1,
        ticks=state.ticks + 1,
        lag=lag,
        motion=push_motion(machine, state.motion, u, q),
        plant=plant,
    )


def reward(v_goal: Array, v_tool: Array) -> Array:
    """1 / (1 + |v_goal - v_tool|), in (0, 1]. Paper: eq2

    Args:
        v_goal: wanted tool velocity [m/s], shape (..., 3).
        v_tool: true tool velocity [m/s], shape (..., 3).

    Example:
        >>> reward(np.array([0.3, 0.4, 0.0]), np.zeros(3))
        np.float64(0.6666666666666666)
    """
    result: Array = 1 / (1 + lengths(v_goal - v_tool))
    return result


def terminated(machine: Machine, lowest: Array) -> Bools:
    """Does the arm reach into the ground? `lowest` [m] (...) of `tool_state`. Paper: Sec. 3.4"""
    return np.asarray(lowest < machine.ground)


def draw_pose(machine: Machine, config: TaskConfig, rng: np.random.Generator, num: int) -> Array:
    """Random angles within the joints' ranges [rad] (num, n), off the ground if so configured.

    Raises:
        ValueError: a machine whose arm is in the ground in every pose drawn.
    """
    low, high = machine.column("q_min"), machine.column("q_max")
    q = rng.uniform(low, high, (num, machine.n))
    for _ in range(1000 * config.redraw_ground):
        bad = terminated(machine, lowest_point(machine, q))
        if not bad.any():
            return q
        q[bad] = rng.uniform(low, high, (int(bad.sum()), machine.n))
    if config.redraw_ground:
        raise ValueError(
            f"{machine.name}: expected a pose above the ground, got none in 1000 draws"
        )
    return q


def draw_goal(machine: Machine, config: TaskConfig, rng: np.random.Generator, num: int) -> Array:
    """Random tool velocities [m/s] (num, 3): zero, along an axis, or anywhere; up to tool_speed."""
    direction, kind = rng.standard_normal((num, 3)), rng.random((num, 1))
    axis = AXES[rng.integers(0, 6, num)]
    direction = np.where(kind < config.zero_goals + config.axis_goals, axis, direction)
    speed = rng.uniform(0, machine.tool_speed, (num, 1)) * (kind >= config.zero_goals)
    return np.asarray(direction * (speed / lengths(direction)[:, None]))


def _draw_hold(
    machine: Machine, config: TaskConfig, rng: np.random.Generator, num: int
) -> NDArray[np.int64]:
    low, high = (max(1, round(s * machine.rate)) for s in (config.hold_min_s, config.hold_max_s))
    return rng.integers(low, high + 1, num)


def reset(
    machine: Machine, config: TaskConfig, rng: np.random.Generator, num: int, plant: bool
) -> State:
    """`num` machines at rest in random poses with random goals; leading shape (num,)."""
    pose, goal = draw_pose(machine, config, rng, num), draw_goal(machine, config, rng, num)
    state = rest_state(machine, pose, goal, plant)
    return replace(state, goal_ticks=_draw_hold(machine, config, rng, num))


def look(machine: Machine, config: TaskConfig, state: State, rng: np.random.Generator) -> Array:
    """The observation of a state, (..., obs), with fresh uniform noise. Paper: Sec. 3.4 (5 %)"""
    noise = draw_noise(machine, config.noise, state.q.shape[:-1], rng)
    seen = observe(machine, state.history, state.v_goal, state.lag, noise)
    return seen * paper_view(machine) if config.paper else seen


class Outcome(NamedTuple):
    """What one `step` yields, beside the state; arrays (num,) except `observation` (num, obs)."""

    observation: Array
    reward: Array
    terminated: Bools
    truncated: Bools
    velocity_error: Array  # |v_goal - v_tool| [m/s]


def step(
    machine: Machine,
    config: TaskConfig,
    net: ActuatorNet | None,
    state: State,
    action: ArrayLike,
    rng: np.random.Generator,
) -> tuple[State, Outcome]:
    """One tick of `num` environments, without resets: `action` (num, n_driven) in [-1, 1].

    The reward is `reward` for the goal that held during the tick less `valve_cost` and `lag_cost`; where the
    goal is over, or asks an arm close to the ground to sink, a new one is drawn after it. On a tick that ends
    in the ground the reward is zero.
    """
    u = to_command(machine, action)
    before, state = state, transition(machine, net, state, u)
    _, v_tool, lowest = tool_state(
        machine, state.q.astype(np.float32), state.q_dot.astype(np.float32)
    )
    rewards = reward(state.v_goal, v_tool)
    end = terminated(machine, lowest)
    error = 1 / rewards - 1
    if not config.paper:
        turned = np.add.reduce(np.abs(u - before.history[..., 2, -1]), axis=-1)
        limits = len(machine.driven) * machine.pwm_limit / PWM_MAX
        rewards = rewards - np.float32(config.valve_cost / limits) * turned
        rewards = rewards - np.float32(config.lag_cost) * lengths(state.lag)
    state = _next_goals(machine, config, state, lowest, rng)
    observation = look(machine, config, state, rng)
    truncated = (state.ticks >= round(config.episode_s * machine.rate)) & ~end
    return state, Outcome(observation, np.where(end, 0.0, rewards), end, truncated, error)


def _next_goals(
    machine: Machine, config: TaskConfig, state: State, lowest: Array, rng: np.random.Generator
) -> State:
    low = lowest < machine.ground + GROUND_MARGIN
    due = np.flatnonzero((state.goal_ticks <= 0) | (low & (state.v_goal[..., 2] < 0)))
    if not len(due):
        return state
    goals, holds = state.v_goal.copy(), state.goal_ticks.copy()
    goals[due] = draw_goal(machine, config, rng, len(due))
    goals[due, 2] = np.where(low[due], np.abs(goals[due, 2]), goals[due, 2])
    holds[due] = _draw_hold(machine, config, rng, len(due))
    return replace(state, v_goal=goals, goal_ticks=holds)


def merge(old: State, new: State, rows: NDArray[np.intp]) -> State:
    """`old` with its rows `rows` replaced by the states `new`, one each."""

    def put(a: Any, b: Any) -> Any:
        a = a.copy()
        a[rows] = b
        return a

    arrays = {f.name: put(getattr(old, f.name), getattr(new, f.name)) for f in fields(State)[:-1]}
    if old.plant is None or new.plant is None:
        return State(**arrays)
    (*one, one_pending), (*other, other_pending) = old.plant, new.plant
    plant = PlantState._make([*map(put, one, other), tuple(map(put, one_pending, other_pending))])
    return State(**arrays, plant=plant)


# --- a controller on given goals --------------------------------------------------------------------


class Controller(Protocol):
    """What can drive: a memory at rest for `num` machines, and commands from observations."""

    def start(self, num: int) -> Any:
        """Memory of `num` controllers that have just been switched on."""

    def __call__(self, observation: Array, memory: Any) -> tuple[Array, Any]:
        """Commands u (num, n) for observations (num, obs) of `observe`, and the next memory."""


class Trace(NamedTuple):
    """What happened, tick by tick: arrays (T, num, ...); entry t is the end of tick t."""

    q: Array  # true angle [rad], n
    q_dot: Array  # true mean velocity over the tick [rad/s], n
    q_measured: Array  # encoder angle when the command was computed [rad], n
    u: Array  # command during the tick, n
    p_tool: Array  # true tool position [m], 3
    v_tool: Array  # true tool velocity [m/s], 3
    reward: Array


def rollout(
    machine: Machine,
    controller: Controller,
    start: ArrayLike,
    goals: Array,
    config: TaskConfig,
    rng: np.random.Generator,
    net: ActuatorNet | None = None,
    read: Encoder = read_encoder,
) -> Trace:
    """Let one controller follow given goals from rest: on the plant, or on nets. Paper: Fig. 3

    Args:
        machine: n joints.
        controller: sees noisy observations, the same for every kind.
        start: angles [rad], (num, n).
        goals: wanted tool velocity during each tick [m/s], (T, num, 3).
        config: its `noise` holds; no episode ends.
        rng: of the noise.
        net: nets of the driven joints; None: the analytic plant.
        read: see `transition`.
    """
    state = rest_state(machine, start, goals[0], plant=net is None)
    memory = controller.start(len(state.q))
    trace = []
    for goal in goals:
        state = replace(state, v_goal=np.broadcast_to(goal.astype(np.float32), state.lag.shape))
        observation = look(machine, config, state, rng)
        u, memory = controller(observation, memory)
        q_measured = state.history[..., 0, -1]
        state = transition(machine, net, state, u, read)
        p_tool, v_tool, _ = tool_state(machine, state.q, state.q_dot)
        trace.append((state.q, state.q_dot, q_measured, u, p_tool, v_tool, reward(goal, v_tool)))
    return Trace(*map(np.array, zip(*trace, strict=True)))
