"""What a policy sees and says: one copy for training, evaluation and hardware.

`observe` makes an observation of what sensors said, `push_measured` keeps what they say from tick to tick,
`to_command` makes commands of actions. Pure functions for any number of machines.
"""

from __future__ import annotations

import math
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from brokk_min.actuator import push
from brokk_min.kinematics import damped_rates, tool_jacobian, tool_position, tool_velocity
from brokk_min.machine import (
    PWM_MAX,
    Array,
    Machine,
    as_floats,
    estimate_velocity,
    lengths,
    limit_command,
)

LAG_TIME, LAG_SPEED = 2.0, 0.07  # s and a share of tool_speed, tuned: see `push_lag`
RAMP = (
    0.01  # of the command limit, assumed: actions this small take a command through the dead zone
)


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
    told: (
        Array  # of a joint's angles and velocities [1, s], their sum tells where it is now, (2, H)
    )


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
        turned = (
            np.arange(samples) - late + late * samples * (np.arange(samples) == samples - 1)
        ) / samples
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


def draw_noise(
    machine: Machine, largest: float, shape: tuple[int, ...], rng: np.random.Generator
) -> Array:
    """Fresh uniform noise for `observe` of `shape` machines, in standard deviations, at most `largest`."""
    steps = rng.integers(-(2**15), 2**15, (*shape, len(_layout(machine).sensed)), np.int16)
    return np.asarray(
        steps * np.float32(2.0**-15 * largest)
    )  # 16 bits take half as long as a float32


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
    share = limit / np.maximum(lengths(error), limit)
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
