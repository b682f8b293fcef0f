"""The task: follow a tool velocity with the driven joints. Pure functions for any number of machines.

`transition` moves the machine without randomness; `observe`, `reward` and `terminated` look at it;
`step` composes them and draws noise and goals. With nets these functions are the simulation (`environments`
for Gymnasium), with a plant the evaluation; `observe` and `to_command` serve the hardware, too.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from itertools import chain
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brokk_min.actuator import ActuatorNet, push, push_command, rest_history
from brokk_min.kinematics import (
    damped_rates,
    lowest_point,
    tool_jacobian,
    tool_position,
    tool_state,
    tool_velocity,
)
from brokk_min.machine import (
    PWM_MAX,
    Array,
    Machine,
    as_floats,
    estimate_velocity,
    limit_command,
    read_encoder,
)
from brokk_min.plant import PlantState, plant_reset, plant_step

GROUND_MARGIN = 0.3  # m above the ground below which no goal asks the arm to sink, assumed
LAG_TIME, LAG_SPEED = 2.0, 0.07  # s and a share of tool_speed, tuned: see `push_lag`
AXES = np.vstack([np.eye(3), -np.eye(3)])  # x, y, z, and back
RAMP = 0.01  # of the command limit, assumed: actions this small take a command through the dead zone
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
    """Reward lost for each metre that the tool stays behind, see `push_lag` [1/m] (paper: 0)."""
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
    lag: Array  # see `push_lag` [m], (..., 3)
    motion: Array  # as `history`, but of true angles: what nets go on from
    plant: PlantState | None = None  # None: the nets move the machine


# --- what the policy sees and says: one copy for training, evaluation and hardware ------------------


class Measured(NamedTuple):
    """An observation in physical units and the base frame, for controllers that are no nets."""

    v_goal: Array  # wanted tool velocity [m/s], (..., 3)
    v_tool: Array  # measured tool velocity [m/s], (..., 3)
    q: Array  # measured angles of all joints [rad], (..., n)
    q_dot: Array  # estimated velocities of the driven joints [rad/s], (..., n_driven)


class _Layout(NamedTuple):
    """How a machine's observation is standardised, float32, (obs,) unless noted; see `observation_scale`."""

    mean: Array
    scale: Array
    paper: Array  # factors that make it the paper's: weights undone, wanted rates blanked
    sensed: Array  # standard deviations of what sensors say, in physical units: all after the goal, (sensed,)
    told: Array  # of a joint's angles and velocities [1, s], their sum tells where it is now, (2, H)


def _layout(machine: Machine) -> _Layout:
    """Worked out once a machine, kept with it."""
    if "layout" not in machine.__dict__:
        driven, rest, samples = machine.driven, machine.locked, machine.history
        middle = (machine.column("q_min") + machine.column("q_max")) / 2
        angle, rate = _spread(machine)
        speed, command = machine.tool_speed / 3**0.5, machine.pwm_limit / PWM_MAX / 3**0.5
        each, share = np.ones(samples), samples**-0.5
        moving = (((middle[j], angle[j] * each, share), (0, rate[j] * each, share)) for j in driven)
        # mean, standard deviation, weight
        blocks: list[tuple[Any, Array, float]] = [
            (0, np.full(3, speed), 1.4),  # goal
            (0, np.full(3, speed), 1.4),  # tool velocity: here begins what sensors say
            (middle[rest], angle[rest], 1.4),
            *chain.from_iterable(moving),  # here it ends
            (0, np.full(samples * len(driven), command), share),
            (0, rate[driven], 4.2),
            (0, 0.1 * rate[driven], 4.2),
        ]
        columns = zip(*((m + 0 * d, d / w, d, 1 / w + 0 * d) for m, d, w in blocks), strict=True)
        mean, scale, deviation, paper = (np.concatenate(a).astype(np.float32) for a in columns)
        paper[-2 * len(driven) :] = 0
        sensed = deviation[3 : 6 + len(rest) + 2 * samples * len(driven)]
        # velocity j is in j of H sums, and late by half its window: to it comes so often what it grew by
        late = machine.velocity_samples / 2 - 1
        turned = (np.arange(samples) - late + late * samples * (np.arange(samples) == samples - 1)) / samples
        told = np.stack([each / samples, machine.dt * turned]).astype(np.float32)
        machine.__dict__["layout"] = _Layout(mean, scale, paper, sensed, told)
    layout: _Layout = machine.__dict__["layout"]
    return layout


def _spread(machine: Machine) -> tuple[Array, Array]:
    """Nominal standard deviation of the angle [rad] and the velocity [rad/s] of each joint, (n,) both."""
    return (machine.column("q_max") - machine.column("q_min")) / 12**0.5, machine.q_dot_max / 3**0.5


def observation_scale(machine: Machine) -> tuple[Array, Array]:
    """Mean and scale by which observations are standardised, float32 (obs,) both.

    Nominal values from the machine (as if every quantity were uniform over its range), so that they are
    the same in training and on the machine. A quantity that is shown by H samples weighs H^-0.5 in each,
    as much as one number; tool velocities weigh more and wanted rates most, because a net learns first
    what is large at its input. Paper: Sec. 3.4 (normalisation)
    """
    return _layout(machine)[:2]


def paper_view(machine: Machine) -> Array:
    """Factors (obs,) that leave of an observation what the paper's agent sees. Paper: Sec. 3.4

    Weights of `observation_scale` are undone, wanted rates blanked: a policy trained on that runs on every
    observation of `observe` once the factors stand in its first layer.
    """
    return _layout(machine).paper


def observe(
    machine: Machine, history: Array, v_goal: ArrayLike, lag: Array, noise: Array | float = 0.0
) -> Array:
    """What the policy sees: goal and tool velocity, locked angles, driven joints' histories, wanted rates.

    Histories are angles and velocities joint by joint, then commands. Tool velocities are given along the
    tool's heading: outward from the z axis, sideways, up. What a slewing arm has to do then does not depend
    on where it points. Wanted rates are the joint rates that would give the goal velocity, and those that
    would make up for `lag` (both by `joint_rates`). The arm is taken to stand where all that is seen of its
    angles says, see `_angles`.

    Paper: Sec. 3.4 (present and target tool velocity, the actuator nets' inputs), Fig. 3; rates are ours

    Args:
        machine: n joints.
        history: measured samples, shape (..., n, 3, H).
        v_goal: wanted tool velocity [m/s], base frame, shape (..., 3).
        lag: of `push_lag` [m], base frame, shape (..., 3).
        noise: of what sensors say, in standard deviations: (..., 3 + locked + 2 H n_driven) or a number.

    Returns:
        Shape (..., 6 + locked + (3 H + 2) n_driven), float32.
    """
    mean, scale, _, sensed, _ = _layout(machine)
    batch, rest = history.shape[:-3], machine.locked
    seen = np.zeros((*batch, len(mean)), np.float32)
    seen[..., 6 : 6 + len(rest)] = history[..., rest, 0, -1]
    driven = history.take(machine.driven, axis=-3)
    _moving(machine, seen)[...] = driven[..., :2, :]
    seen[..., 3 : 3 + len(sensed)] += noise * sensed
    seen[..., 3 + len(sensed) : -2 * len(machine.driven)] = driven[..., 2, :].reshape(*batch, -1)
    p_tool, J = tool_jacobian(machine, _angles(machine, seen))
    given = np.empty((*batch, 3, 3), np.float32)
    given[..., 0, :], given[..., 2, :] = v_goal, lag
    given[..., 1, :] = np.einsum("...ij,...j", J, history[..., 1, -1])
    seen[..., :6] += _turn(p_tool[..., None, :], given[..., :2, :], 1).reshape(*batch, 6)
    rates = damped_rates(machine, J[..., None, :, machine.driven], given[..., ::2, :])
    seen[..., -2 * len(machine.driven) :] = rates.reshape(*batch, -1)
    seen -= mean
    seen /= scale
    return seen


def _moving(machine: Machine, values: Array) -> Array:
    """Angles and velocities (..., n_driven, 2, H) in an observation in physical units (..., obs)."""
    body, shape = 6 + len(machine.locked), (len(machine.driven), 2, machine.history)
    return values[..., body : body + math.prod(shape)].reshape(*values.shape[:-1], *shape)


def _angles(machine: Machine, values: Array) -> Array:
    """Where the joints are [rad] (..., n), from an observation in physical units (..., obs).

    Each sample of a driven joint's angle says where the joint is now, once what it turned since is added. The
    mean of them all has a fraction of the newest one's noise.
    """
    q = np.empty((*values.shape[:-1], machine.n), values.dtype)
    q[..., machine.locked] = values[..., 6 : 6 + len(machine.locked)]
    q[..., machine.driven] = np.einsum("...ks,ks", _moving(machine, values), _layout(machine).told)
    return q


def _turn(p_tool: Array, vector: Array, sign: int) -> Array:
    """`vector` (..., 3) from the base frame into the tool's heading (sign 1), or back (-1)."""
    x, y = p_tool[..., 0], p_tool[..., 1]
    radius = np.maximum(np.hypot(x, y), 1e-6)
    c, s = x / radius, sign * y / radius
    turned = vector.copy()
    turned[..., 0] = c * vector[..., 0] + s * vector[..., 1]
    turned[..., 1] = c * vector[..., 1] - s * vector[..., 0]
    return turned


def measured(machine: Machine, observation: Array) -> Measured:
    """Undo `observe`: what is measured now, in physical units, from observations (..., obs)."""
    mean, scale = observation_scale(machine)
    values = observation * scale + mean
    q = _angles(machine, values)
    p_tool = tool_position(machine, q)
    v_goal, v_tool = (_turn(p_tool, values[..., i : i + 3], -1) for i in (0, 3))
    return Measured(v_goal, v_tool, q, _moving(machine, values)[..., 1, -1])


def _length(vector: Array) -> Array:
    """Of vectors (..., 3): (...)."""
    length: Array = np.sqrt(np.add.reduce(vector * vector, axis=-1))
    return length


def push_lag(machine: Machine, v_tool: Array, v_goal: Array, lag: Array) -> Array:
    """How far the tool stays behind [m] (..., 3): the leaky integral of the velocity error, a tick on.

    It tells a lasting error from a passing one. Errors count up to `LAG_SPEED` of the machine's tool
    speed, so that the wait for a valve to wake does not fill it, and are forgotten within `LAG_TIME`.

    Args:
        machine: n joints.
        v_tool: measured tool velocity after the tick [m/s], (..., 3).
        v_goal: what was wanted during the tick [m/s], (..., 3).
        lag: before the tick, (..., 3).
    """
    error = v_goal - v_tool
    limit = np.float32(LAG_SPEED * machine.tool_speed)
    share = limit / np.maximum(_length(error), limit)
    counted = lag + error * (share * np.float32(machine.dt))[..., None]
    return np.asarray(counted * np.float32(np.exp(-machine.dt / LAG_TIME)))


def push_motion(machine: Machine, history: Array, u: Array, q: Array) -> Array:
    """History (..., n, 3, H) after commands `u`, with angles `q` [rad], (..., n) both, and their slope."""
    return push(history, u, q, lambda a: estimate_velocity(a, machine.velocity_samples, machine.dt))


def push_measured(
    machine: Machine, history: Array, u: Array, q: Array, v_goal: Array, lag: Array
) -> tuple[Array, Array]:
    """History and lag a tick on: simulation and hardware.

    During the tick `u` (..., n) was sent and `v_goal` [m/s] (..., 3) wanted; `q` [rad] (..., n) is what the
    encoders said after it.
    """
    history = push_motion(machine, history, u, q)
    v_tool = tool_velocity(machine, history[..., 0, -1], history[..., 1, -1])
    return history, push_lag(machine, v_tool, v_goal, lag)


def to_command(machine: Machine, action: ArrayLike) -> Array:
    """Commands for all joints from the policy's actions: beyond the dead zone, limited, in whole PWM counts.

    As the baselines' PIDs, a policy need not find the dead zone: the command goes through it within the
    first `RAMP` of an action and rises evenly from there. A valve is then barely open near action 0.

    Paper: Sec. 3.4 (PWM out), Sec. 3.2 (7 %, 65 %), Fig. 3

    Args:
        machine: n joints.
        action: for the driven joints, 0: closed, 1: the command limit; clipped to [-1, 1]. (..., n_driven)

    Returns:
        u in [-1, 1] of full command, shape (..., n); locked joints get 0.

    Raises:
        ValueError: a wrong shape or a value that is no number.

    Example:
        >>> from brokk_min.machine import BROKK_170
        >>> to_command(BROKK_170, [1.0, -0.5, 0.0, 2.0]) * 127
        array([ 80.,   0., -44.,   0.,  80.])
    """
    action = as_floats(action)
    if action.shape[-1:] != machine.driven.shape:
        raise ValueError(f"action: expected (..., {len(machine.driven)}), got {action.shape}")
    if not np.isfinite(action).all():
        raise ValueError(f"action: expected finite numbers, got {action[~np.isfinite(action)][0]}")
    u = np.zeros((*action.shape[:-1], machine.n), action.dtype)
    dead, beyond = _command_range(machine)
    action = np.asarray(np.clip(action, -1.0, 1.0))
    u[..., machine.driven] = np.clip(action / RAMP, -1.0, 1.0) * dead + action * beyond
    return limit_command(machine, u)


def command_slope(machine: Machine, u: Array) -> Array:
    """Derivative of `to_command` by the action at commands `u` (..., n): (..., n_driven), float32."""
    dead, beyond = _command_range(machine)
    through = np.abs(u[..., machine.driven]) < dead + RAMP * beyond
    return np.asarray((beyond + through * (dead / RAMP)).astype(np.float32))


def _command_range(machine: Machine) -> tuple[float, float]:
    """The dead zone, and what is left from there to the command limit, as shares of full command."""
    limit = machine.pwm_limit / PWM_MAX
    return machine.dead_zone, limit - machine.dead_zone


# --- the episode ------------------------------------------------------------------------------------


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
    return State(q, np.zeros_like(q), history, goals, never, ticks, np.zeros_like(goals), motion, plant_state)


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

    history, lag = push_measured(machine, state.history, u, read(machine, q), state.v_goal, state.lag)
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
    result: Array = 1 / (1 + _length(v_goal - v_tool))
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
        raise ValueError(f"{machine.name}: expected a pose above the ground, got none in 1000 draws")
    return q


def draw_goal(machine: Machine, config: TaskConfig, rng: np.random.Generator, num: int) -> Array:
    """Random tool velocities [m/s] (num, 3): zero, along an axis, or anywhere; up to tool_speed."""
    direction, kind = rng.standard_normal((num, 3)), rng.random((num, 1))
    axis = AXES[rng.integers(0, 6, num)]
    direction = np.where(kind < config.zero_goals + config.axis_goals, axis, direction)
    speed = rng.uniform(0, machine.tool_speed, (num, 1)) * (kind >= config.zero_goals)
    return np.asarray(direction * (speed / _length(direction)[:, None]))


def _draw_hold(machine: Machine, config: TaskConfig, rng: np.random.Generator, num: int) -> NDArray[np.int64]:
    low, high = (max(1, round(s * machine.rate)) for s in (config.hold_min_s, config.hold_max_s))
    return rng.integers(low, high + 1, num)


def reset(machine: Machine, config: TaskConfig, rng: np.random.Generator, num: int, plant: bool) -> State:
    """`num` machines at rest in random poses with random goals; leading shape (num,)."""
    pose, goal = draw_pose(machine, config, rng, num), draw_goal(machine, config, rng, num)
    state = rest_state(machine, pose, goal, plant)
    return replace(state, goal_ticks=_draw_hold(machine, config, rng, num))


def look(machine: Machine, config: TaskConfig, state: State, rng: np.random.Generator) -> Array:
    """The observation of a state, (..., obs), with fresh uniform noise. Paper: Sec. 3.4 (5 %)"""
    shape = (*state.q.shape[:-1], len(_layout(machine).sensed))
    steps = rng.integers(-(2**15), 2**15, shape, np.int16)  # 16 bits take half as long as a float32
    noise = steps * np.float32(2.0**-15 * config.noise)
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
    _, v_tool, lowest = tool_state(machine, state.q.astype(np.float32), state.q_dot.astype(np.float32))
    rewards = reward(state.v_goal, v_tool)
    end = terminated(machine, lowest)
    error = 1 / rewards - 1
    if not config.paper:
        turned = np.add.reduce(np.abs(u - before.history[..., 2, -1]), axis=-1)
        limits = len(machine.driven) * machine.pwm_limit / PWM_MAX
        rewards = rewards - np.float32(config.valve_cost / limits) * turned
        rewards = rewards - np.float32(config.lag_cost) * _length(state.lag)
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
