"""Learning from the simulation's derivatives: backpropagation through time instead of a critic.

The simulation consists of nets and kinematics, so its rewards can be differentiated by the actions.
With the state x_t (history, angles, error integral) and x_{t+1} = f(x_t, a_t), the costate

    lambda_t = dr_t/dx_t + gamma (df/dx_t)^T lambda_{t+1}

runs backwards through a rollout; it gives the derivative of the discounted rewards to come,

    dR_t/da_t = dr_t/da_t + gamma (df/da_t)^T lambda_{t+1}.

The policy's mean action moves along it, by STEP deviations at most, and the policy is fitted to the
actions so improved,

    target_t = mean_t + STEP std g_t / max(|g_t|, median |g|),   g_t = dR_t/da_t,  in [-1, 1],
    loss = KL(N(target, std) || N(mean, std)) = |target - mean|^2 / (2 std^2).

There is no likelihood ratio, no clip and no critic. With Adam, to the same error, it takes 45 s of
CPU where PPO's clip around the same gradient takes 312 s (docs/deviations.md, D10). Muon takes half
of the time of Adam (D17). It is open loop: later actions count as given. No value stands at the end
of the window, so its last actions get little credit. None of this is new:

- PODS (Mora et al., 2021) is this method, with a deterministic policy.
- SVG (Heess et al., 2015, arXiv 1510.09142): backpropagation through learned dynamics, policy too.
- Q-Prop (Gu et al., 2017, arXiv 1611.02247): the same Taylor expansion, of a learned critic.
- SHAC (Xu et al., 2022, arXiv 2204.07137): short windows, a critic's value at their end.
- GI-PPO (Son et al., 2023, arXiv 2312.08710): the same regression (its alpha policy), along the
  gradient of GAE's advantage, with a critic; then PPO.
- RPO (Zhong et al., 2025, arXiv 2508.06214): PPO's clip and its epochs for pathwise gradients.

Simplifications: angles and commands count as exact, not rounded, and actions not as clipped; the
error integral takes the true velocity of the tick; Jacobians count as constant, for in one second a
joint turns little; joints at rest count without the standstill rule; a tick into the ground counts
as any other; nothing counts after the end of an episode, not even where it only ran out of time.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray
from torch import Tensor

from brokk_min import ppo
from brokk_min.actuator import (
    INDICATOR_SCALE,
    MU,
    ActuatorNet,
    append_command,
    command_at_rest,
    folded_weights,
    open_indicator,
)
from brokk_min.env import (
    COMPENSATION,
    INTEGRAL_LIMIT,
    INTEGRAL_TIME,
    TaskConfig,
    action_to_pwm,
    integrate_error,
)
from brokk_min.identification.muon import Muon
from brokk_min.jacobian import limit_penalty
from brokk_min.kinematics import estimate_velocity, forward_kinematics, jacobian
from brokk_min.machine import PWM_MAX, Array, Machine, valve_opening

STEP = 4.0  # deviations of the actions by which targets differ from means, at most


class Ticks(NamedTuple):
    """What each tick of `env.step` began with, and its command: arrays (T, num, ...)."""

    q: Array  # true angle [rad], n
    true_history: Array  # of `env.State`, (n_driven, 3, H)
    v_goal: Array  # goal velocity [m/s], 3
    error_integral: Array  # of `env.integrate_error` [m], 3
    u: Array  # command, n
    follows: Array  # (T, num, 1): 0 at rest, where the action does not count, else 1
    done: NDArray[np.bool_]  # did the episode end with the tick?


class Derivatives(NamedTuple):
    """Of each tick, by the history h that the nets read and the latents z that they share."""

    dr_dq: Array  # by the angle after the tick, (T, num, n_driven): costs of limits
    dr_dq_dot: Array  # (T, num, n_driven)
    dq_dot_dh: Array  # by each joint's own history, (T, num, n_driven, 3, H)
    dq_dot_dz: Array  # (T, num, n_driven, L); L = 0: nets without latents
    dz_dh: Array  # (T, num, L, n_driven, 3, H)
    free: Array  # (T, num, n_driven): 0 at a limit of the joint, else 1


def make_learner(env: VectorEnv[Any, Any, Any], config: ppo.PPOConfig, seed: int) -> ppo.Learner:
    """That of `ppo.make_learner`, without a critic; its optimiser is Muon instead of Adam."""
    learner = ppo.make_learner(env, config, seed, critic=False)
    learner.optimizer = Muon(learner.agent.parameters(), config.learning_rate)
    return learner


def improved_actions(machine: Machine, net: ActuatorNet, task: TaskConfig) -> ppo.Estimate:
    """The estimate that `ppo.train` takes, for rollouts of `gym_env.TaskVectorEnv` on `net`."""
    if task.paper:  # as in `env.step`
        task = replace(task, valves="open", valve_cost=0.0, integral_cost=0.0, limit_cost=0.0)

    @torch.no_grad()
    def estimate(
        agent: ppo.Agent, rollout: ppo.Rollout, config: ppo.PPOConfig
    ) -> dict[str, Tensor]:
        """Means of the actions, and means moved along the gradient."""
        states = [info["state"] for info in rollout.infos]
        names = ("q", "true_history", "v_goal", "error_integral", "rest_ticks")
        before = (np.stack([getattr(state, name) for state in states]) for name in names)
        q, true_history, v_goal, integral, rest_ticks = before
        u = action_to_pwm(machine, rollout.actions.numpy(), task.paper)
        u, resting, _ = command_at_rest(machine, task.valves, u, v_goal, rest_ticks)
        follows = (~resting).astype(np.float32)
        ticks = Ticks(q, true_history, v_goal, integral, u, follows, rollout.dones.numpy())
        gradient = torch.from_numpy(action_gradients(machine, net, ticks, config.gamma, task))
        step = STEP * agent.log_std.exp() * saturate(gradient)
        targets = (rollout.means.clamp(-1, 1) + step).clamp(-1, 1)
        return {"means": rollout.means, "targets": targets}

    return estimate


def saturate(gradient: Tensor) -> Tensor:
    """Vectors (..., n) divided by their norms, or by the median norm where that is larger."""
    norm = torch.linalg.vector_norm(gradient, dim=-1, keepdim=True)
    return gradient / torch.maximum(norm, norm.median()).clamp(min=1e-12)


def regression_loss(
    agent: ppo.Agent, mb: dict[str, Tensor], config: ppo.PPOConfig
) -> tuple[Tensor, Tensor]:
    """KL divergence of the policy from its targets; the log gets what `ppo.ppo_loss` gives."""
    mean = agent.actor(mb["obs"])
    loss = normal_kl(mean, mb["targets"], agent.log_std)
    with torch.no_grad():
        change = normal_kl(mean, mb["means"], agent.log_std)
    zero = torch.zeros(())
    return loss, torch.stack([loss.detach(), zero, zero, change, zero])


def normal_kl(mean: Tensor, other: Tensor, log_std: Tensor) -> Tensor:
    """Mean KL divergence of normal distributions with means (B, n) and the same deviation."""
    z = (mean - other) * torch.exp(-log_std.detach())
    return 0.5 * (z * z).sum(-1).mean()


def action_gradients(
    machine: Machine, net: ActuatorNet, ticks: Ticks, gamma: float, task: TaskConfig
) -> Array:
    """dR_t/da_t: derivative of the discounted rewards to come by each action.

    `net` are the nets of the driven joints, which made the rollout. Rewards after the last tick do
    not count. `task` has the costs. Returns (T, num, n_driven), float32, by actions as
    `env.action_to_pwm` takes them.
    """
    by = local_derivatives(machine, net, ticks, gamma, task)
    dc_du = valve_cost_gradient(machine, ticks, task.valve_cost)
    window = machine.velocity_samples
    slope = estimate_velocity(np.eye(window), window, machine.dt).astype(np.float32)  # dq_dot/dq
    dR_du = np.empty_like(by.dr_dq_dot)
    # costates: derivatives of the rewards to come by the state after the tick
    dR_dh = np.zeros_like(by.dq_dot_dh[0])  # history, (num, n_driven, 3, H)
    dR_dq = np.zeros_like(dc_du[0])  # angle, (num, n_driven)
    dR_dlast = np.zeros_like(dc_du[0])  # command of the tick, by the next tick's valve travel
    for t in reversed(range(len(dR_du))):
        discount = np.float32(gamma) * ~ticks.done[t, :, None]
        dR_dh = discount[..., None, None] * dR_dh
        dR_dh[..., 0, -window:] += dR_dh[..., 1, -1:] * slope  # the newest q_dot is a slope of q
        dR_dq = discount * dR_dq + dR_dh[..., 0, -1] + by.dr_dq[t]
        dR_dq = by.free[t] * dR_dq  # none at a limit
        dR_dq_dot = np.float32(machine.dt) * dR_dq + by.dr_dq_dot[t]  # q_{t+1} = q_t + dt q_dot
        # by what the net read: the history before the tick, its command row with u_t already in it
        before = dR_dq_dot[..., None, None] * by.dq_dot_dh[t]
        dR_dz = np.einsum("bn,bnl->bl", dR_dq_dot, by.dq_dot_dz[t])
        before += np.einsum("bl,blnch->bnch", dR_dz, by.dz_dh[t])
        before[..., :2, 1:] += dR_dh[..., :2, :-1]  # the shift of the history, backwards
        before[..., 2, :] += dR_dh[..., 2, :]  # the net reads commands already shifted
        dR_du[t] = before[..., 2, -1] + discount * dR_dlast - dc_du[t]
        # take u_t out of the row again: what was sample j + 1 moved to j, and the oldest fell out
        before[..., 2, 1:] = before[..., 2, :-1]
        before[..., 2, 0] = 0
        dR_dh = before
        dR_dlast = dc_du[t]
    return dR_du * ticks.follows * compensation_derivative(machine, ticks.u, task.paper)


def valve_cost_gradient(machine: Machine, ticks: Ticks, valve_cost: float) -> Array:
    """dc_t/du_t = -dc_t/du_{t-1} of the cost c_t of valve travel, (T, num, n_driven)."""
    travel = ticks.u[..., machine.driven] - ticks.true_history[..., 2, -1]
    limit = len(machine.driven) * machine.pwm_limit / PWM_MAX
    return np.sign(travel).astype(np.float32) * np.float32(valve_cost / limit)


def local_derivatives(
    machine: Machine, net: ActuatorNet, ticks: Ticks, gamma: float, task: TaskConfig
) -> Derivatives:
    """Derivatives within each tick; the history h has the command of the tick in it."""
    driven = machine.driven
    low, high = machine.column("q_min")[driven], machine.column("q_max")[driven]
    history = append_command(ticks.true_history, ticks.u[..., driven])
    velocity, dq_dot_dh, dq_dot_dz, dz_dh = input_gradient(net, history)
    q_next = ticks.q[..., driven] + velocity * machine.dt
    free = (low <= q_next) & (q_next <= high)
    q = ticks.q.copy()
    q[..., driven] = np.clip(q_next, low, high)
    J = jacobian(forward_kinematics(machine, q.astype(np.float32)))[..., driven]
    error = ticks.v_goal - (J @ (velocity * free).astype(np.float32)[..., None])[..., 0]
    size = np.linalg.norm(error, axis=-1, keepdims=True)
    # d/dv_tool of 1 / (1 + |e|), e = v_goal - v_tool: e / (|e| (1 + |e|)^2) (eq2)
    dr_dv = error / (np.maximum(size, 1e-6) * (1 + size) ** 2)
    dr_dv += integral_gradient(machine, ticks, error, gamma, task.integral_cost)
    dr_dq_dot = (dr_dv[..., None, :] @ J)[..., 0, :] * free  # v_tool = J q_dot
    dr_dq = (-task.limit_cost * limit_penalty(machine, q)[1][..., driven]).astype(np.float32)
    by_h_and_z = dq_dot_dh, dq_dot_dz, dz_dh
    return Derivatives(dr_dq, dr_dq_dot, *by_h_and_z, free.astype(np.float32))


def integral_gradient(
    machine: Machine, ticks: Ticks, error: Array, gamma: float, cost: float
) -> Array:
    """Derivative of -cost |I_t|, now and later, by v_tool (T, num, 3); `error` e_t [m/s] the same.

    I_t = exp(-dt/T) (I_{t-1} + dt cut(e_t)), e_t = v_goal - v_tool. Where e_t is cut, only its
    direction counts.
    """
    limit = INTEGRAL_LIMIT * machine.tool_speed
    leak = np.exp(-machine.dt / INTEGRAL_TIME)
    I = integrate_error(machine, ticks.v_goal, ticks.v_goal - error, ticks.error_integral)  # noqa: E741
    dc_dI = np.float32(cost) * I / np.maximum(np.linalg.norm(I, axis=-1, keepdims=True), 1e-6)
    size = np.maximum(np.linalg.norm(error, axis=-1, keepdims=True), 1e-6)
    direction = error / size
    result = np.empty_like(dc_dI)
    costate = np.zeros_like(dc_dI[0])
    for t in reversed(range(len(result))):
        costate = dc_dI[t] + np.float32(gamma * leak) * ~ticks.done[t, :, None] * costate
        radial = np.sum(costate * direction[t], axis=-1, keepdims=True) * direction[t]
        cut = (costate - radial) * limit / size[t]
        result[t] = np.where(size[t] < limit, costate, cut) * np.float32(leak * machine.dt)
    return np.asarray(result)


def input_gradient(net: ActuatorNet, history: Array) -> tuple[Array, Array, Array, Array]:
    """Velocity of the nets (..., n) and its derivatives, by backpropagation.

    dq_dot/dh (..., n, 3, H) by each joint's own history, dq_dot/dz (..., n, L) by the latents, and
    their dz/dh (..., L, n, 3, H).
    """
    velocity, y, hidden2, hidden1 = net.forward(history)
    w1, _, w2, _, w3, _ = folded_weights(net)
    gradient = (net.output_high - net.output_low)[:, None, None] * y * (1 - y)  # sigmoid
    gradient = gradient @ w3.swapaxes(1, 2) * (hidden2 > 0)  # ReLU
    gradient = gradient @ w2.swapaxes(1, 2) * (hidden1 > 0)
    by_inputs = (gradient @ w1.swapaxes(1, 2)).swapaxes(0, 1)  # (batch, n, I)
    dq_dot_dh = by_history(net, history, by_inputs.reshape(*history.shape[:-2], -1))
    if len(net.weights) == 6:
        *batch, n, rows, samples = history.shape
        none = np.zeros((*batch, n, 0), np.float32)
        return velocity, dq_dot_dh, none, np.zeros((*batch, 0, n, rows, samples), np.float32)
    by_latents = (gradient @ net.weights[7].swapaxes(1, 2)).swapaxes(0, 1)  # (batch, n, L)
    dq_dot_dz = by_latents.reshape(*history.shape[:-2], -1)
    return velocity, dq_dot_dh, dq_dot_dz, latent_gradient(net, history)


def latent_gradient(net: ActuatorNet, history: Array) -> Array:
    """dz/dh (..., L, n, 3, H) of `ActuatorNet.latents`, z = tanh(sum_j (S_j^T [x_j, |x_j|] + c_j)).

    dz/dx = (1 - z^2) (S + sign(x) S'), with S' the rows that weigh |x|.
    """
    x = net.inputs(history)[..., None, :, :]  # (..., 1, n, I)
    z = net.latents(x.reshape(-1, *x.shape[-2:])).reshape(*history.shape[:-3], -1, 1, 1)
    S, S_abs = np.split(np.moveaxis(net.weights[6], -1, 0), 2, axis=-1)  # (L, n, I) each
    dz_dx = (1 - z**2) * (S + np.sign(x - net.input_mean) * S_abs) / net.input_scale
    return by_history(net, history[..., None, :, :, :], dz_dx)


def by_history(net: ActuatorNet, history: Array, by_inputs: Array) -> Array:
    """Derivatives by what the nets read (..., n, I) as such by the history (..., n, 3, H)."""
    rows = by_inputs.reshape(*by_inputs.shape[:-1], -1, net.history)  # by `input_rows`
    u = history[..., 2, :]
    by_u = rows[..., 2, :] * mu_law_derivative(u, net.dead_zone)  # the chain rule: both rows
    if net.indicator:
        by_u += rows[..., 3, :] * open_indicator_derivative(u, net.dead_zone)
    return np.concatenate([rows[..., :2, :], by_u[..., None, :]], axis=-2)


def mu_law_derivative(u: Array, dead_zone: float) -> Array:
    """Derivative of `actuator.mu_law` by `u`, same shape; 0 within the dead zone."""
    if not dead_zone:
        return np.ones_like(u)
    x = np.abs(valve_opening(u, dead_zone))
    slope: Array = MU / ((1 + MU * x) * np.log1p(MU) * (1 - dead_zone))
    return np.asarray((x > 0) * slope, u.dtype)


def open_indicator_derivative(u: Array, dead_zone: float) -> Array:
    """Derivative of `actuator.open_indicator` by `u`, same shape; 0 within the dead zone."""
    x = valve_opening(u, dead_zone)
    slope = (1 - open_indicator(u, dead_zone) ** 2) / (INDICATOR_SCALE * (1 - dead_zone))
    return np.asarray(np.sign(x) * slope, u.dtype)


def compensation_derivative(machine: Machine, u: Array, paper: bool = False) -> Array:
    """Derivative of `env.action_to_pwm` by the action at commands `u` (..., n): (..., n_driven).

    Of an action beyond [-1, 1], which is clipped, it should be 0; here the targets are clipped.
    """
    dead_zone = 0.0 if paper else machine.dead_zone
    beyond = machine.pwm_limit / PWM_MAX - dead_zone
    crossing = np.abs(u[..., machine.driven]) < dead_zone + COMPENSATION * beyond
    return np.asarray((beyond + crossing * (dead_zone / COMPENSATION)), np.float32)
