"""Derivatives of the rewards by every action: against finite differences of the simulation, and by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers_machines import GAIN, obedient_net, obedient_velocity, random_machine, small_net

from brokk_min import env as task
from brokk_min import observation as sight
from brokk_min.kinematics import forward_kinematics, jacobian, tool_velocity
from brokk_min.learning.simulation_gradient import Rollout, action_gradients
from brokk_min.machine import BROKK_170, PWM_MAX

NUM, TICKS = 3, 9


def exactly(machine, q):
    """Encoders without steps: differences show what a derivative is."""
    return q


def costs(valve=0.0, lag=0.0):
    return task.TaskConfig(valve_cost=valve, integral_cost=lag)


def simulate(machine, net, state, commands):
    """States (T + 1) of `env.transition` under `commands` (T, num, n), in double precision."""
    states = [state]
    for u in commands:
        states.append(task.transition(machine, net, states[-1], u, exactly))
    return states


def rollout_of(states, commands, ended=None):
    arrays = (
        np.stack([getattr(s, n) for s in states[:-1]]) for n in ("q", "motion", "v_goal", "lag")
    )
    ended = np.zeros(commands.shape[:2], bool) if ended is None else ended
    return Rollout(*arrays, commands, ended)


def case(seed, machine=None):
    """A machine, its nets in double precision, states in motion and commands, no joint near its stops."""
    rng = np.random.default_rng(seed)
    machine = machine or random_machine(rng, int(rng.integers(2, 6)))
    net = small_net(machine, rng)
    net = replace(net, weights=tuple(w.astype(float) for w in net.weights))
    net = replace(net, output_low=0.3 * net.output_low, output_high=0.3 * net.output_high)
    low, high = machine.column("q_min"), machine.column("q_max")
    q = rng.uniform(0.7 * low + 0.3 * high, 0.3 * low + 0.7 * high, (NUM, machine.n))
    state = task.initial_state(machine, q, rng.standard_normal((NUM, 3)), plant=False)
    state = replace(state, history=state.history.astype(float), motion=state.motion.astype(float))
    commands = np.zeros((15 + TICKS, NUM, machine.n))
    commands[..., machine.driven] = rng.uniform(
        -0.6, 0.6, (*commands.shape[:2], len(machine.driven))
    )
    states = simulate(machine, net, state, commands[:15])
    return machine, net, states[-1], commands[15:]


def by_action(machine, u):
    """Slope of the command by the action at `u`: of the line from 0 through the dead zone to the limit."""
    limit, dead = machine.pwm_limit / PWM_MAX, machine.dead_zone
    knee = dead + sight.COMPENSATION_RANGE * (limit - dead)
    u = np.abs(u[..., machine.driven])
    return np.where(
        u < knee, knee / sight.COMPENSATION_RANGE, (limit - knee) / (1 - sight.COMPENSATION_RANGE)
    )


def rewards_of(machine, states, along):
    """Rewards (T, num) with the Jacobians of the states `along`, which count as constant."""
    J = np.stack(
        [jacobian(forward_kinematics(machine, s.q))[..., machine.driven] for s in along[1:]]
    )
    rates = np.stack([s.q_dot[..., machine.driven] for s in states[1:]])
    return task.reward(states[0].v_goal, (J @ rates[..., None])[..., 0])


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("gamma", [0.0, 0.8, 1.0])
def test_gradients_are_finite_differences_of_the_simulation(seed, gamma):
    machine, net, start, commands = case(seed)
    states = simulate(machine, net, start, commands)
    found = action_gradients(machine, net, rollout_of(states, commands), gamma, costs())
    step, weights = 1e-5, gamma ** np.arange(TICKS)
    for t in range(TICKS):
        for k, joint in enumerate(machine.driven):
            ends = []
            for sign in (1, -1):
                other = commands.copy()
                other[t, :, joint] += sign * step
                rewards = rewards_of(machine, simulate(machine, net, start, other), states)
                ends.append((weights[: TICKS - t, None] * rewards[t:]).sum(axis=0))
            slope = (ends[0] - ends[1]) / (2 * step) * by_action(machine, commands[t])[:, k]
            np.testing.assert_allclose(found[t, :, k], slope, rtol=2e-3, atol=2e-5)


def test_a_constant_jacobian_costs_little():
    """What is left out, the turn of the arm within the horizon, on the machine of the paper."""
    machine, net, start, commands = case(1, BROKK_170)
    states = simulate(machine, net, start, commands)
    found = action_gradients(machine, net, rollout_of(states, commands), 0.9, costs())[0]
    whole = np.empty_like(found)
    for k, joint in enumerate(machine.driven):
        ends = []
        for sign in (1, -1):
            other = commands.copy()
            other[0, :, joint] += sign * 1e-5
            after = simulate(machine, net, start, other)
            ends.append(
                (0.9 ** np.arange(TICKS)[:, None] * rewards_of(machine, after, after)).sum(axis=0)
            )
        whole[:, k] = (ends[0] - ends[1]) / 2e-5
    whole *= by_action(machine, commands[0])
    assert np.linalg.norm(found - whole) < 0.05 * np.linalg.norm(whole)


def test_one_tick_by_hand():
    """Nets that obey the newest command: reward 1 / (1 + e), e = |goal - J q_dot|, one joint's command."""
    net, u = obedient_net(BROKK_170), np.zeros((1, 1, 5))
    u[..., BROKK_170.driven] = [0.3, -0.2, 0.1, 0.4]
    state = task.initial_state(
        BROKK_170, [[0.0, 0.5, 0.6, 1.7, 1.2]], [0.2, 0.1, -0.1], plant=False
    )
    states = simulate(BROKK_170, net, state, u)
    found = action_gradients(BROKK_170, net, rollout_of(states, u), 0.9, costs())[0, 0]
    rates = obedient_velocity(BROKK_170, u[0, 0, BROKK_170.driven])
    J = jacobian(forward_kinematics(BROKK_170, states[1].q[0]))[..., BROKK_170.driven]
    error = state.v_goal[0] - J @ rates
    size = np.linalg.norm(error)
    fastest = 1.2 * BROKK_170.q_dot_max[BROKK_170.driven]
    share = (rates / fastest + 1) / 2  # of the sigmoid
    by_command = 2 * fastest * GAIN * share * (1 - share)
    wanted = (error / size) @ J / (1 + size) ** 2 * by_command * (80 / 127 - 0.07)
    np.testing.assert_allclose(found, wanted, rtol=1e-4)


def test_nothing_is_earned_beyond_the_end_of_an_episode_or_by_another_environment():
    machine, net, start, commands = case(2)
    states = simulate(machine, net, start, commands)
    ended = np.zeros((TICKS, NUM), bool)
    ended[4, 1] = True
    whole, cut = (
        action_gradients(machine, net, rollout_of(states, commands, e), 0.9, costs(0.01, 2.0))
        for e in (None, ended)
    )
    np.testing.assert_array_equal(cut[5:], whole[5:])
    np.testing.assert_array_equal(cut[:, [0, 2]], whole[:, [0, 2]])
    first = rollout_of(states[:6], commands[:5])
    np.testing.assert_array_equal(
        cut[:5, 1], action_gradients(machine, net, first, 0.9, costs(0.01, 2.0))[:, 1]
    )
    assert (cut[:4, 1] != whole[:4, 1]).any()


def test_the_cost_of_moving_a_valve_is_in_it():
    """A tick's command is moved to and away from: cost times sign, the second discounted, mean of joints."""
    machine, net, start, commands = case(3)
    states = simulate(machine, net, start, commands)
    free, dear = (
        action_gradients(machine, net, rollout_of(states, commands), 0.8, costs(cost))
        for cost in (0.0, 0.05)
    )
    before = np.concatenate([start.history[None, ..., 2, -1], commands[:-1]])
    sign = np.sign(commands - before)[..., machine.driven]
    later = np.concatenate([sign[1:], 0 * sign[:1]])
    by_command = -0.05 / len(machine.driven) * (sign - 0.8 * later) * PWM_MAX / machine.pwm_limit
    np.testing.assert_allclose(
        dear - free, by_command * by_action(machine, commands), rtol=1e-4, atol=1e-5
    )


@pytest.mark.parametrize("seed", range(4))
def test_the_cost_of_staying_behind_is_in_it(seed):
    """Differences of the whole simulation, where the newest velocity is that of the tick alone."""
    rng = np.random.default_rng(seed)
    machine = replace(random_machine(rng, int(rng.integers(2, 6))), velocity_samples=2)
    machine, net, start, commands = case(seed, machine)
    start = replace(start, lag=rng.normal(0, 0.1, (NUM, 3)))
    states = simulate(machine, net, start, commands)
    J = [jacobian(forward_kinematics(machine, s.q))[..., machine.driven] for s in states]
    v_tool = np.array(
        [tool_velocity(forward_kinematics(machine, s.q), s.q_dot) for s in states[1:]]
    )
    middle = np.quantile(np.linalg.norm(start.v_goal - v_tool, axis=-1), 0.52)
    machine = replace(
        machine, tool_speed=float(middle) / sight.INTEGRAL_SPEED
    )  # half of the errors are beyond the limit
    states = simulate(machine, net, start, commands)

    def cost(states):
        """Discounted lags (T, num), each tick's tool velocity by the Jacobian that counts as constant."""
        lag, found = start.lag, []
        for t, s in enumerate(states[1:]):
            v_tool = (J[t + 1] @ s.q_dot[..., machine.driven, None])[..., 0]
            lag = sight.integrate_error(machine, v_tool, start.v_goal, lag)
            found.append(3.0 * 0.8**t * np.linalg.norm(lag, axis=-1))
        return np.array(found)

    free, dear = (
        action_gradients(machine, net, rollout_of(states, commands), 0.8, costs(0, c))
        for c in (0.0, 3.0)
    )
    for t in range(TICKS):
        for k, joint in enumerate(machine.driven):
            ends = []
            for sign in (1, -1):
                other = commands.copy()
                other[t, :, joint] += sign * 1e-5
                ends.append(cost(simulate(machine, net, start, other))[t:].sum(axis=0) / 0.8**t)
            slope = -(ends[0] - ends[1]) / 2e-5 * by_action(machine, commands[t])[:, k]
            np.testing.assert_allclose((dear - free)[t, :, k], slope, rtol=2e-3, atol=1e-4)


@pytest.mark.parametrize(("end", "push"), [("q_max", 0.4), ("q_min", -0.4)])
def test_a_joint_at_its_stop_gains_nothing_by_pushing(end, push):
    machine = BROKK_170
    net, u = obedient_net(machine), np.zeros((3, 1, 5))
    q = (machine.column("q_min") + machine.column("q_max")) / 2
    q[4] = machine.column(end)[4]
    state = task.initial_state(machine, q[None], [0.1, 0.1, 0.1], plant=False)
    u[..., 4], u[..., 3] = push, 0.3
    found = action_gradients(
        machine, net, rollout_of(simulate(machine, net, state, u), u), 0.9, costs()
    )[:, 0]
    assert not found[:, 3].any() and found[:, 2].all()


def test_read_only_arrays_go_in_and_nothing_is_changed():
    machine, net, start, commands = case(4)
    rollout = rollout_of(simulate(machine, net, start, commands), commands)
    for array in rollout:
        array.setflags(write=False)
    first, second = (
        action_gradients(machine, net, rollout, 0.9, costs(0.01, 2.0)) for _ in range(2)
    )
    np.testing.assert_array_equal(first, second)
    assert first.dtype == np.float32 and np.isfinite(first).all()
