"""Which way every action should have gone: rewards differentiated through nets and kinematics.

The simulation is made of nets, so what an action does need not be guessed from noisy returns. The adjoint
method walks a rollout backwards, tick by tick, with the derivative of the rewards to come by everything
that a tick leaves behind: the angles, and the history that the nets see next.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from brokk_min.actuator import ActuatorNet, push_command
from brokk_min.env import TaskConfig
from brokk_min.kinematics import tool_jacobian
from brokk_min.machine import PWM_MAX, Array, Machine, estimate_velocity
from brokk_min.observation import LAG_SPEED, LAG_TIME, command_slope, push_lag


class Rollout(NamedTuple):
    """What each tick of `env.step` began with, and the command it got: arrays (T, num, ...)."""

    q: Array  # true angle [rad], n
    motion: Array  # of `env.State`, (n, 3, H)
    v_goal: Array  # wanted tool velocity [m/s], 3
    lag: Array  # of `observation.push_lag` [m], 3
    u: Array  # command, n
    ended: NDArray[np.bool_]  # did the episode end with the tick?


def action_gradients(
    machine: Machine, net: ActuatorNet, rollout: Rollout, gamma: float, task: TaskConfig
) -> Array:
    """Derivative of the discounted rewards to come by each action, all other actions as they were.

    Rewards are those of `env.step`. Encoders and commands count as exact, not as whole steps, and the
    Jacobian and `observation.command_slope` as constant: in a second a joint turns little.
    Paper: Sec. 3.4 (nets in the simulation); ours

    Args:
        machine: n joints.
        net: nets of its driven joints, that made the rollout.
        rollout: T ticks of `num` environments; rewards after the last are not seen.
        gamma: discount.
        task: its costs of moving valves and of staying behind.

    Returns:
        Shape (T, num, n_driven), float32, by actions as `observation.to_command` takes them.
    """
    driven, by_action = machine.driven, command_slope(machine, rollout.u)
    by_velocity, by_history, free = _each_tick(machine, net, rollout, gamma, task.lag_cost)
    turned = (rollout.u - rollout.motion[..., 2, -1])[..., driven]
    cost = np.sign(turned).astype(np.float32)
    cost *= np.float32(task.valve_cost / len(driven) * PWM_MAX / machine.pwm_limit)
    samples = machine.velocity_samples
    window = estimate_velocity(np.eye(samples), samples, machine.dt).astype(np.float32)
    result = np.empty_like(by_velocity)
    # derivatives of the rewards to come by what a tick leaves: history (num, n_driven, 3, H), angle, command
    past, angle, turn = (np.zeros_like(a[0]) for a in (by_history, by_velocity, by_velocity))
    for t in range(len(result) - 1, -1, -1):
        discount = np.float32(gamma) * ~rollout.ended[t, :, None]  # (num, 1)
        past, angle, turn = past * discount[..., None, None], angle * discount, turn * discount
        past[..., 0, -samples:] += (
            past[..., 1, -1:] * window
        )  # the newest velocity is a slope of angles
        angle = (angle + past[..., 0, -1]) * free[t]
        before = (angle * np.float32(machine.dt) + by_velocity[t])[..., None, None] * by_history[t]
        before[..., :2, 1:] += past[
            ..., :2, :-1
        ]  # each measured sample moves back to where it was,
        before[..., 2, :] += past[..., 2, :]  # commands stand where the tick put them
        result[t] = (before[..., 2, -1] - cost[t] + turn) * by_action[t]
        before[..., 2, 1:] = before[..., 2, :-1]
        before[..., 2, 0] = 0
        past, turn = before, cost[t]
    return result


def _each_tick(
    machine: Machine, net: ActuatorNet, rollout: Rollout, gamma: float, lag_cost: float
) -> tuple[Array, Array, Array]:
    """What a tick does by itself, (T, num, n_driven, ...): rewards by its velocities, these by the history
    (3, H) with the new command in it, and 1 where the joint is not held by the end of its range."""
    driven = machine.driven
    velocity, by_history = net.slope(
        push_command(rollout.motion[..., driven, :, :], rollout.u[..., driven])
    )
    moved = rollout.q[..., driven] + velocity * machine.dt
    q = rollout.q.copy()
    q[..., driven] = np.clip(
        moved, machine.column("q_min")[driven], machine.column("q_max")[driven]
    )
    free = q[..., driven] == moved
    J = tool_jacobian(machine, q.astype(np.float32))[1][..., driven]
    error = rollout.v_goal - (J @ (velocity * free).astype(np.float32)[..., None])[..., 0]
    size = np.linalg.norm(error, axis=-1, keepdims=True)
    by_tool = error / (
        np.maximum(size, 1e-6) * (1 + size) ** 2
    )  # of 1 / (1 + |v_goal - v_tool|), eq2
    by_tool += _by_lag(machine, rollout, error, gamma, lag_cost)
    by_velocity = (by_tool[..., None, :] @ J)[..., 0, :] * free
    return by_velocity, by_history, free.astype(np.float32)


def _by_lag(machine: Machine, rollout: Rollout, error: Array, gamma: float, cost: float) -> Array:
    """What way left behind costs in all ticks to come, by the tool's velocity in each, (T, num, 3).

    `error` [m/s] (T, num, 3) is what `push_lag` adds up: beyond its limit only the direction counts.
    """
    limit, decay = LAG_SPEED * machine.tool_speed, np.exp(-machine.dt / LAG_TIME)
    lag = push_lag(machine, rollout.v_goal - error, rollout.v_goal, rollout.lag)
    by_lag: Array = (
        np.float32(cost) * lag / np.maximum(np.linalg.norm(lag, axis=-1, keepdims=True), 1e-6)
    )
    size = np.maximum(np.linalg.norm(error, axis=-1, keepdims=True), 1e-6)
    along = error / size
    result, later = np.empty_like(by_lag), 0 * by_lag[0]
    for t in range(len(by_lag) - 1, -1, -1):
        later = by_lag[t] + np.float32(gamma * decay) * ~rollout.ended[t, :, None] * later
        radial = np.sum(later * along[t], axis=-1, keepdims=True) * along[t]
        counted = np.where(size[t] < limit, later, (later - radial) * limit / size[t])
        result[t] = counted * np.float32(decay * machine.dt)
    return result
