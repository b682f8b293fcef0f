"""Derivatives of the rewards by the actions: against finite differences, and by hand."""

from dataclasses import replace

import numpy as np
import pytest
import strategies
import torch
from helpers_machines import obedient_net, small_net, with_latents
from hypothesis import given, settings
from hypothesis import strategies as st

from brokk_min import env
from brokk_min.env import TaskConfig, integrate_error
from brokk_min.kinematics import forward_kinematics, jacobian
from brokk_min.learning.gym_env import TaskVectorEnv
from brokk_min.learning.simulation_gradient import (
    STEP,
    Ticks,
    action_gradients,
    compensation_derivative,
    improved_actions,
    regression_loss,
    saturate,
)
from brokk_min.machine import BROKK_170, PWM_MAX
from brokk_min.ppo import Agent, PPOConfig, collect, make_learner

NUM, TICKS = 3, 9


def exact(machine, q):
    """Encoders without steps: differences show what a derivative is."""
    return q


def costs(valve=0.0, integral=0.0, limit=0.0):
    return TaskConfig(valve_cost=valve, integral_cost=integral, limit_cost=limit)


def simulate(machine, net, state, commands):
    """States (T + 1) of `env.transition` under `commands` (T, num, n), in double precision."""
    states = [state]
    for u in commands:
        states.append(env.transition(machine, net, states[-1], u, exact))
    return states


def ticks_of(states, commands, done=None):
    names = ("q", "true_history", "v_goal", "error_integral")
    arrays = [np.stack([getattr(s, name) for s in states[:-1]]) for name in names]
    done = np.zeros(commands.shape[:2], bool) if done is None else done
    return Ticks(*arrays, commands, np.ones((*commands.shape[:-1], 1)), done)


def moving_case(machine, seed):
    """Nets in double precision, a state in motion and commands, no joint near its limits."""
    rng = np.random.default_rng(seed)
    net = small_net(machine, rng, rows=3 + seed // 2 % 2)
    low, high = machine.column("q_min"), machine.column("q_max")
    # 3/8 of the range lie before each joint, at least
    fastest = (high - low)[machine.driven] / 3 / ((15 + TICKS) * machine.dt)
    if seed % 3 == 2:  # joints that are not alone
        net = with_latents(net, rng, size=0.3)
    net = replace(
        net,
        weights=tuple(weight.astype(float) for weight in net.weights),
        output_low=np.maximum(0.3 * net.output_low, -fastest),
        output_high=np.minimum(0.3 * net.output_high, fastest),
        dead_zone=machine.dead_zone * (seed % 2),  # 0: commands as they are, as in the paper
    )
    q = (low + high) / 2 + (high - low) / 4 * rng.uniform(-0.5, 0.5, (NUM, machine.n))
    state = env.initial_state(machine, q, rng.standard_normal((NUM, 3)), plant=False)
    state = replace(
        state,
        history=state.history.astype(float),
        true_history=state.true_history.astype(float),
        error_integral=rng.normal(0, 0.1, (NUM, 3)),
    )
    commands = np.zeros((15 + TICKS, NUM, machine.n))
    shape = (*commands.shape[:2], len(machine.driven))
    commands[..., machine.driven] = rng.uniform(-0.6, 0.6, shape)
    state = simulate(machine, net, state, commands[:15])[-1]
    return net, state, commands[15:]


def tool_velocities(machine, states, jacobians_of):
    """v_tool (T, num, 3) with the Jacobians of the states `jacobians_of`."""
    q = np.stack([s.q for s in jacobians_of[1:]])
    J = jacobian(forward_kinematics(machine, q))[..., machine.driven]
    q_dot = np.stack([s.q_dot[..., machine.driven] for s in states[1:]])
    return (J @ q_dot[..., None])[..., 0]


def rewards_of(machine, states, jacobians_of):
    return env.reward(states[0].v_goal, tool_velocities(machine, states, jacobians_of))


def integrals(machine, states, jacobians_of):
    """Error integrals (T + 1, num, 3) that take each tick's own velocity."""
    result = [states[0].error_integral]
    for v_tool in tool_velocities(machine, states, jacobians_of):
        result.append(integrate_error(machine, states[0].v_goal, v_tool, result[-1]))
    return np.stack(result)


def integral_costs(machine, states, jacobians_of):
    """|I| (T, num)."""
    return np.linalg.norm(integrals(machine, states, jacobians_of)[1:], axis=-1)


def finite_differences(machine, net, start, commands, gamma, figure):
    """d/da (T, num, n_driven) of the discounted sum of a figure (T, num), by the actions."""
    states = simulate(machine, net, start, commands)
    discounts = gamma ** np.arange(TICKS)[:, None]
    result = np.zeros((*commands.shape[:2], len(machine.driven)))
    step = 1e-6  # smaller than the way to most kinks of the nets
    for t in range(TICKS):
        for k, joint in enumerate(machine.driven):
            sums = []
            for sign in (1, -1):
                other = commands.copy()
                other[t, :, joint] += sign * step
                values = figure(machine, simulate(machine, net, start, other), states)
                sums.append((discounts[: TICKS - t] * values[t:]).sum(axis=0))
            result[t, :, k] = (sums[0] - sums[1]) / (2 * step)
    return result * command_per_action(machine, commands)


def command_per_action(machine, u):
    """du/da of the two lines of `env.action_to_pwm`, by their end points."""
    beyond = machine.pwm_limit / PWM_MAX - machine.dead_zone
    corner = machine.dead_zone + env.COMPENSATION * beyond
    inner = np.abs(u[..., machine.driven]) < corner
    return np.where(inner, corner / env.COMPENSATION, beyond)


@settings(max_examples=5)
@given(strategies.machines(2, 5), st.integers(0, 999), st.sampled_from([0.0, 0.8, 1.0]))
def test_action_gradients__equal_finite_differences_of_rollouts(machine, seed, gamma):
    """Rollouts are longer than the history."""
    machine = replace(machine, history=5)
    net, start, commands = moving_case(machine, seed)
    ticks = ticks_of(simulate(machine, net, start, commands), commands)
    gradient = action_gradients(machine, net, ticks, gamma, costs())
    difference = finite_differences(machine, net, start, commands, gamma, rewards_of)
    size = np.abs(difference).max()
    np.testing.assert_allclose(gradient, difference, rtol=2e-3, atol=1e-4 * size + 1e-6)


@settings(max_examples=5)
@given(strategies.machines(2, 5), st.integers(0, 999), st.floats(0.2, 0.8))
def test_action_gradients__include_the_cost_of_the_error_integral(machine, seed, quantile):
    net, start, commands = moving_case(machine, seed)
    states = simulate(machine, net, start, commands)
    error = np.linalg.norm(start.v_goal - tool_velocities(machine, states, states), axis=-1)
    limit = float(np.quantile(error, quantile)) + 1e-4  # some errors are cut, some are not
    machine = replace(machine, tool_speed=limit / env.INTEGRAL_LIMIT)
    ticks = ticks_of(states, commands)
    free = action_gradients(machine, net, ticks, 0.8, costs())
    ticks = ticks._replace(error_integral=integrals(machine, states, states)[:-1])
    costly = action_gradients(machine, net, ticks, 0.8, costs(integral=3.0))
    difference = -3 * finite_differences(machine, net, start, commands, 0.8, integral_costs)
    size = np.abs(difference).max()
    np.testing.assert_allclose(costly - free, difference, rtol=5e-3, atol=1e-3 * size + 1e-5)


@settings(max_examples=5)
@given(strategies.machines(2, 5), st.integers(0, 999))
def test_action_gradients__include_the_cost_of_limits(machine, seed):
    """Ranges end close to where joints are; the cost is that of a twentieth of a range, by hand."""
    net, start, commands = moving_case(machine, seed)
    q = np.stack([state.q for state in simulate(machine, net, start, commands)])
    room = 0.02 * np.ptp(q, axis=(0, 1)) + 1e-6
    low, high = q.min(axis=(0, 1)) - room, q.max(axis=(0, 1)) + room
    ranges = zip(machine.joints, low, high, strict=True)
    joints = tuple(replace(joint, q_min=a, q_max=b) for joint, a, b in ranges)
    machine = replace(machine, joints=joints, q_start=())

    def penalties(machine, states, _):
        q = np.stack([state.q for state in states[1:]])[..., machine.driven]
        a, b = low[machine.driven], high[machine.driven]
        inside = np.minimum(q - a, b - q) / (b - a)  # 0 at a limit, 0.5 in the middle
        return (np.maximum(0, 1 - 20 * inside) ** 2).sum(axis=-1)

    ticks = ticks_of(simulate(machine, net, start, commands), commands)
    free = action_gradients(machine, net, ticks, 0.8, costs())
    costly = action_gradients(machine, net, ticks, 0.8, costs(limit=3.0))
    difference = -3 * finite_differences(machine, net, start, commands, 0.8, penalties)
    size = np.abs(difference).max()
    assert size > 0
    np.testing.assert_allclose(costly - free, difference, rtol=5e-3, atol=1e-3 * size + 1e-5)


@given(strategies.machines(), st.integers(0, 999))
def test_action_gradients__include_the_cost_of_valve_travel(machine, seed):
    """A command is moved to (now) and away from (one tick later, discounted)."""
    net, start, commands = moving_case(machine, seed)
    ticks = ticks_of(simulate(machine, net, start, commands), commands)
    free = action_gradients(machine, net, ticks, 0.8, costs())
    costly = action_gradients(machine, net, ticks, 0.8, costs(valve=0.05))
    last = np.concatenate([start.history[None, ..., 2, -1], commands[:-1]])
    sign = np.sign(commands - last)[..., machine.driven]
    sign_next = np.concatenate([sign[1:], 0 * sign[:1]])
    limit = len(machine.driven) * machine.pwm_limit / PWM_MAX
    by_command = -0.05 / limit * (sign - 0.8 * sign_next)
    expected = by_command * command_per_action(machine, commands)
    np.testing.assert_allclose(costly - free, expected, rtol=1e-3, atol=1e-5 * np.abs(free).max())


def test_action_gradients__lose_little_by_a_constant_jacobian():
    """What is left out, the turn of the arm within the horizon, on the machine of the paper."""
    net, start, commands = moving_case(BROKK_170, 1)
    ticks = ticks_of(simulate(BROKK_170, net, start, commands), commands)
    gradient = action_gradients(BROKK_170, net, ticks, 0.9, costs())

    def true_rewards(machine, states, _):
        return rewards_of(machine, states, states)

    difference = finite_differences(BROKK_170, net, start, commands, 0.9, true_rewards)
    assert np.linalg.norm(gradient - difference) < 0.05 * np.linalg.norm(difference)


def test_action_gradients__stop_at_the_end_of_an_episode():
    machine = BROKK_170
    net, start, commands = moving_case(machine, 2)
    states = simulate(machine, net, start, commands)
    done = np.zeros((TICKS, NUM), bool)
    done[4, 1] = True

    def gradients(ticks):
        return action_gradients(machine, net, ticks, 0.9, costs(0.01, 2.0, 0.3))

    whole = gradients(ticks_of(states, commands))
    cut = gradients(ticks_of(states, commands, done))
    first = gradients(ticks_of(states[:6], commands[:5]))
    np.testing.assert_array_equal(cut[5:], whole[5:])
    np.testing.assert_array_equal(cut[:, [0, 2]], whole[:, [0, 2]])
    np.testing.assert_array_equal(cut[:5, 1], first[:, 1])
    assert (cut[:4, 1] != whole[:4, 1]).any()


@pytest.mark.parametrize(("limit", "u_q5"), [("q_max", 0.4), ("q_min", -0.4)])
def test_action_gradients__are_zero_for_a_joint_pushed_into_its_limit(limit, u_q5):
    net = obedient_net(BROKK_170)
    u = np.zeros((3, 1, 5))
    u[..., 4] = u_q5
    u[..., 3] = 0.3
    q = (BROKK_170.column("q_min") + BROKK_170.column("q_max")) / 2
    q[4] = BROKK_170.column(limit)[4]
    state = env.initial_state(BROKK_170, q[None], [0.1, 0.1, 0.1], plant=False)
    ticks = ticks_of(simulate(BROKK_170, net, state, u), u)
    gradient = action_gradients(BROKK_170, net, ticks, 0.9, costs())[:, 0]
    assert not gradient[:, 3].any()
    assert gradient[:, 2].all()


@pytest.mark.parametrize("paper", [False, True])
def test_improved_actions__are_means_and_a_saturated_step_along_the_gradient(paper):
    """Means count within [-1, 1], as do targets; episodes end within the rollout.

    The paper's agent has no costs and no rule for valves at rest, whatever the task says.
    """
    net = small_net(BROKK_170, np.random.default_rng(0))
    task = TaskConfig(episode_s=0.6, valve_cost=0.02, paper=paper)
    config = PPOConfig(num_envs=8, horizon=13, log_std=-2.5, threads=1)
    vector = TaskVectorEnv(8, net, BROKK_170, task)
    learner = make_learner(vector, config, 1, critic=False)
    learner.agent.actor[-1].bias.data += torch.tensor([1.1, -0.9, 0.3, 0.0])  # beyond the limit
    rollout = collect(vector, learner, config)
    batch = improved_actions(BROKK_170, net, task)(learner.agent, rollout, config)
    means = rollout.means.numpy().clip(-1, 1)
    states = [info["state"] for info in rollout.infos]
    commands = env.action_to_pwm(BROKK_170, rollout.actions.numpy(), paper)
    ticks = ticks_of([*states, states[-1]], commands, rollout.dones.numpy())
    if paper:
        task = replace(task, valves="open", valve_cost=0.0, integral_cost=0.0, limit_cost=0.0)
    gradient = action_gradients(BROKK_170, net, ticks, config.gamma, task)
    norm = np.linalg.norm(gradient, axis=-1, keepdims=True)
    largest = np.maximum(norm, np.sort(norm, axis=None)[(norm.size - 1) // 2])
    targets = (means + STEP * np.exp(-2.5) * gradient / largest).clip(-1, 1)
    np.testing.assert_allclose(batch["targets"], targets, rtol=1e-4, atol=1e-6)
    assert rollout.dones.any()
    assert rollout.means.abs().max() > 1
    assert (norm > largest.min()).any() and (norm < largest.min()).any()


@pytest.mark.parametrize("paper", [False, True])
def test_compensation_derivative__by_hand(paper):
    """Limit 80 / 127, dead zone 0.07, compensated over 0.01 of an action; the paper's is linear."""
    u = np.array([0.04, 0.5, -0.2, -0.3, -0.03])  # the second joint is locked
    beyond, crossing = 80 / 127 - 0.07, 0.07 / 0.01
    expected = [beyond + crossing, beyond, beyond, beyond + crossing]
    found = compensation_derivative(BROKK_170, u, paper)
    np.testing.assert_allclose(found, [80 / 127] * 4 if paper else expected, rtol=1e-6)


def test_saturate__stands_still_without_a_gradient():
    assert not saturate(torch.zeros(3, 2)).any()


def test_regression_loss__is_the_divergence_of_normal_distributions():
    """PyTorch's own distributions are the oracle."""
    agent = Agent(5, 2, -0.7, critic=False)
    obs, targets, means = torch.randn(6, 5), torch.randn(6, 2), torch.randn(6, 2)
    batch = {"obs": obs, "targets": targets, "means": means}
    loss, parts = regression_loss(agent, batch, PPOConfig())

    def divergence(other):
        std = agent.log_std.exp()
        normals = [torch.distributions.Normal(m, std) for m in (other, agent.actor(obs))]
        return torch.distributions.kl_divergence(*normals).sum(-1).mean()

    torch.testing.assert_close(loss, divergence(targets))
    assert parts.tolist() == pytest.approx([loss.item(), 0, 0, divergence(means).item(), 0])
