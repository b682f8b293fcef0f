"""What a policy sees and says: by hand, against closed forms and sampling, over random machines."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers_machines import POSE, closed_form, damped_rates, parts, random_machine, small_net
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from strategies import machines

from brokk_min import env as task
from brokk_min import observation as sight
from brokk_min.env import TaskConfig
from brokk_min.kinematics import forward_kinematics, joint_rates, tool_position, tool_velocity
from brokk_min.learning.gym_env import TaskVectorEnv
from brokk_min.machine import BROKK_170, estimate_velocity

LOW = replace(BROKK_170, ground=-100.0)  # no pose is in the ground
QUIET = TaskConfig(noise=0.0)
MACHINES = [random_machine(np.random.default_rng(seed), 2 + seed % 5) for seed in range(10)]


# --- commands -------------------------------------------------------------------------------------


def test_to_command_by_hand():
    """The dead zone has 8.89 counts, 71.11 are beyond: 8.89 + 35.56; clipped to -80; at 0.01 and 0.005."""
    action = [0.5, -3.0, -0.01, 0.005]  # the last two: 8.89 + 0.71 and half of that
    counts = sight.action_to_pwm(BROKK_170, action) * 127
    np.testing.assert_allclose(counts, [44, 0, -80, -10, 5], atol=1e-9)
    assert counts[1] == 0  # q2 is the operator's
    assert not sight.action_to_pwm(BROKK_170, np.zeros(4)).any()


@given(machines(), st.floats(0, 1), st.floats(0, 1))
def test_commands_rise_with_actions_by_their_slope(machine, one, other):
    """Odd, never falling; and the slopes below and above the end of the dead zone add up to the limit."""
    low, high = sorted([one, other])
    driven, limit = machine.driven, machine.pwm_limit / 127
    action = np.array([[low], [high], [-high], [1.0]]) * np.ones(len(driven))
    u = sight.action_to_pwm(machine, action)[..., driven]
    assert (u[0] <= u[1]).all() and np.array_equal(u[1], -u[2])
    np.testing.assert_allclose(u[3], limit, atol=1e-9)
    slope = sight.action_to_pwm_derivative(
        machine, np.array([[0.0], [limit], [-limit]]) * np.ones(machine.n)
    )
    assert slope.shape == (3, len(driven)) and slope.dtype == np.float32
    if machine.dead_zone < limit - 0.01:
        whole = slope[0] * sight.COMPENSATION_RANGE + slope[1] * (1 - sight.COMPENSATION_RANGE)
        np.testing.assert_allclose(whole, limit, rtol=1e-5)
        assert np.array_equal(slope[1], slope[2]) and (slope[0] >= slope[1]).all()


@pytest.mark.parametrize("machine", MACHINES, ids=lambda m: m.name)
def test_to_command_sends_whole_counts_in_the_order_of_the_joints(machine):
    rng = np.random.default_rng(1)
    action = rng.uniform(-2, 2, (50, len(machine.driven))).astype(np.float32)
    counts = sight.action_to_pwm(machine, action) * 127
    np.testing.assert_allclose(counts, np.rint(counts), atol=1e-4)
    assert np.abs(counts).max() <= machine.pwm_limit + 1e-4
    wanted = np.zeros_like(counts)
    for column, joint in enumerate(machine.driven):
        points = (
            np.array([0, sight.COMPENSATION_RANGE, 1]),
            np.array([0, 0, machine.pwm_limit], float),
        )
        dead = 127 * machine.dead_zone
        points[1][1] = dead + sight.COMPENSATION_RANGE * (machine.pwm_limit - dead)
        wanted[:, joint] = np.sign(action[:, column]) * np.interp(
            np.abs(action[:, column]), *points
        )
    assert np.abs(counts - wanted).max() <= 0.5 + 1e-4
    assert not counts[:, machine.locked].any()


def test_to_command_takes_whole_numbers_like_floats():
    assert np.array_equal(
        sight.action_to_pwm(BROKK_170, [1, 0, -1, 0]),
        sight.action_to_pwm(BROKK_170, [1.0, 0.0, -1.0, 0.0]),
    )


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_to_command_refuses_what_is_no_number(bad):
    with pytest.raises(ValueError, match=f"action: expected finite numbers, got {bad}"):
        sight.action_to_pwm(BROKK_170, [[0.0, bad, 0.0, 0.0]])


@pytest.mark.parametrize("shape", [(), (1,), (3,), (5,), (4, 1)])
def test_to_command_refuses_wrong_shapes(shape):
    with pytest.raises(ValueError, match=r"action: expected \(\.\.\., 4\), got \("):
        sight.action_to_pwm(BROKK_170, np.zeros(shape))


# --- observations ---------------------------------------------------------------------------------


def told_history():
    """A Brokk history (5, 3, 13) in which every number tells where it stands."""
    history = np.zeros((5, 3, 13))
    lags = np.arange(13)
    for joint in range(5):
        history[joint, 0] = POSE[joint] + 0.01 * (lags - 12)
        history[joint, 1] = 0.02 * joint + 0.001 * lags
        history[joint, 2] = -0.1 * joint + 0.002 * lags
    return history


STANDSTILL = np.zeros(3)  # no lag, no goal


def told_angles(machine, history):
    """The mean of all samples of a driven joint's angle, each moved on by all later velocities.

    A velocity is the slope of some angles: late by half of their span, and so moved on as well.
    """
    late, q = (machine.velocity_samples - 1) / 2 - 1 / 2, history[..., 0, -1].copy()
    for joint in machine.driven:
        angle, velocity = history[..., joint, 0, :], history[..., joint, 1, :]
        tick = (velocity[..., 1:] + late * np.diff(velocity)) * machine.dt
        q[..., joint] = np.mean(
            [angle[..., k] + tick[..., k:].sum(-1) for k in range(machine.history)], axis=0
        )
    return q


def headed(machine, q, v):
    """Velocities `v` (..., 3) outward from the z axis, sideways and up, the tool being where `q` says."""
    x, y, _ = np.moveaxis(tool_position(forward_kinematics(machine, q)), -1, 0)
    turn = np.exp(-1j * np.arctan2(y, x)) * (v[..., 0] + 1j * v[..., 1])
    return np.stack([turn.real, turn.imag, v[..., 2]], axis=-1)


def sensed(machine):
    """Numbers that sensors say in an observation: tool velocity, locked angles, angles and velocities."""
    return 3 + len(machine.locked) + 2 * machine.history * len(machine.driven)


def test_observation_by_hand():
    told = told_angles(BROKK_170, told_history())
    assert told[0] == pytest.approx(
        1.5 - 0.06 + 0.05 * 0.001 * sum(j * (j + 1) / 13 for j in range(13))
    )
    outward, sideways = (np.array([np.cos(a), np.sin(a)]) for a in (told[0], told[0] + np.pi / 2))
    v_goal, lag = (
        np.array([*(0.3 * outward - 0.1 * sideways), -0.15]),
        np.array([0.02, -0.01, 0.03]),
    )
    seen = sight.observe(BROKK_170, told_history(), v_goal, lag)
    assert seen.shape == (171,)  # 6 + q2 + 4 joints x 39 + 2 x 4 rates
    assert seen.dtype == np.float32
    np.testing.assert_allclose(seen[:3], 1.4 * 3**0.5 * np.array([1, -1 / 3, -0.5]), rtol=1e-5)
    assert seen[6] == pytest.approx(1.4 * (0.5 - 0.7) / (1.4 / 12**0.5), rel=1e-6)
    noisy = sight.observe(
        BROKK_170, told_history(), v_goal, lag, noise=0.1
    )  # of a standard deviation more
    np.testing.assert_allclose((noisy - seen)[6:111], [0.14, *([0.1 * 13**-0.5] * 104)], atol=1e-6)
    spread, lags = 12**0.5, np.arange(13)
    cuts = (
        (7, 111),
        (33, 124),
        (85, 150),
    )  # angles with velocities, and commands; each weighs 13^-0.5
    q1, q3, q5 = (
        13**0.5 * np.r_[seen[i : i + 26], seen[j : j + 13]].reshape(3, 13) for i, j in cuts
    )
    np.testing.assert_allclose(q1[0], (1.5 + 0.01 * (lags - 12)) / (4.28 / spread), rtol=1e-5)
    np.testing.assert_allclose(q1[1], 0.001 * lags / (0.20 / 3**0.5), rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(q1[2], 0.002 * lags / (80 / 127 / 3**0.5), rtol=1e-5, atol=1e-7)
    angle = (0.58 + 0.01 * (lags - 12) - 0.65) / (1.9 / spread)
    np.testing.assert_allclose(q3[0], angle, rtol=1e-4)
    np.testing.assert_allclose(q3[2], (-0.2 + 0.002 * lags) * 127 * 3**0.5 / 80, rtol=1e-5)
    np.testing.assert_allclose(q5[1], (0.08 + 0.001 * lags) * 3**0.5 / 0.47, rtol=1e-5)
    assert (np.diff(q1[0]) > 0).all()  # oldest first
    fastest = np.array([0.20, 0.28, 0.38, 0.47]) / 3**0.5
    for found, v, nominal in ((seen[163:167], v_goal, fastest), (seen[167:], lag, 0.1 * fastest)):
        wanted = damped_rates(BROKK_170, told, v) / nominal * 4.2
        np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-4)
        assert np.abs(wanted).min() > 0.02  # the four numbers are four


def test_observed_tool_velocity_is_the_derivative_of_the_closed_form():
    """Seen along the heading: the derivatives of radius, heading times radius, and height."""
    history, step = told_history(), 1e-6
    q, q_dot = told_angles(BROKK_170, history), history[:, 1, -1]
    after, before = (closed_form(q + sign * step * q_dot)[0] for sign in (1, -1))
    radius = np.hypot(*closed_form(q)[0][:2])
    outward = (np.hypot(*after[:2]) - np.hypot(*before[:2])) / (2 * step)
    sideways = (
        radius * (np.arctan2(after[1], after[0]) - np.arctan2(before[1], before[0])) / (2 * step)
    )
    upward = (after[2] - before[2]) / (2 * step)
    seen = sight.observe(BROKK_170, history, STANDSTILL, STANDSTILL)
    np.testing.assert_allclose(
        seen[3:6] / 1.4 * 0.3 / 3**0.5, [outward, sideways, upward], atol=1e-6
    )
    assert q_dot[1] != 0  # a moving q2 counts as well


def test_a_turned_arm_sees_the_same():
    """Turning arm, goal and lag about the slew axis changes q1's angles alone."""
    history, turned = told_history(), told_history()
    turned[0, 0] -= 2.5
    c, s = np.cos(-2.5), np.sin(-2.5)
    one = sight.observe(BROKK_170, history, [0.2, -0.1, 0.05], np.array([0.02, 0.01, -0.03]))
    late = np.array([0.02 * c - 0.01 * s, 0.02 * s + 0.01 * c, -0.03])
    other = sight.observe(BROKK_170, turned, [0.2 * c + 0.1 * s, 0.2 * s - 0.1 * c, 0.05], late)
    angles = np.zeros(171, bool)
    angles[7:20] = True
    np.testing.assert_allclose(other[~angles], one[~angles], atol=2e-5)
    np.testing.assert_allclose(
        other[angles] - one[angles], -2.5 * (12 / 13) ** 0.5 / 4.28, rtol=1e-5
    )


def random_sight(machine, rng, shape):
    """History, goal and lag of machines that move anyhow, read-only."""
    low, high = machine.column("q_min")[:, None], machine.column("q_max")[:, None]
    history = rng.normal(0, 0.3, (*shape, machine.n, 3, machine.history))
    history[..., 0, :] = rng.uniform(low, high, (*shape, machine.n, machine.history))
    v_goal, lag = rng.normal(0, 0.3, (*shape, 3)), rng.normal(0, 0.03, (*shape, 3))
    for array in (history, v_goal, lag):
        array.setflags(write=False)
    return history, v_goal, lag


@pytest.mark.parametrize("machine", MACHINES, ids=lambda m: m.name)
def test_measured_undoes_observe(machine):
    history, v_goal, lag = random_sight(machine, np.random.default_rng(2), (2, 3))
    seen = sight.observe(machine, history, v_goal, lag)
    size = 6 + len(machine.locked) + (3 * machine.history + 2) * len(machine.driven)
    assert seen.shape == (2, 3, size)
    back, told = sight.measured(machine, seen), told_angles(machine, history)
    np.testing.assert_allclose(back.v_goal, v_goal, atol=1e-6)
    np.testing.assert_allclose(back.q, told, atol=1e-5)
    np.testing.assert_allclose(back.q_dot, history[..., machine.driven, 1, -1], atol=1e-5)
    still = np.zeros((2, 3, machine.n, 3, machine.history))
    still[..., 0, :], still[..., machine.driven, 1, :] = history[..., 0, :], 0.1
    v_tool = sight.measured(machine, sight.observe(machine, still, v_goal, lag)).v_tool
    step = 1e-6 * still[..., 1, -1]
    ahead, behind = (
        tool_position(forward_kinematics(machine, told_angles(machine, still) + s * step))
        for s in (1, -1)
    )
    np.testing.assert_allclose(v_tool, (ahead - behind) / 2e-6, atol=1e-5)
    alone = sight.measured(machine, sight.observe(machine, history[1, 2], v_goal[1, 2], lag[1, 2]))
    for whole, single in zip(back, alone, strict=True):
        np.testing.assert_allclose(whole[1, 2], single, atol=1e-5)


@pytest.mark.parametrize("machine", [BROKK_170, *MACHINES], ids=lambda m: m.name)
def test_a_tick_is_measured_alike_in_simulation_and_on_hardware(machine):
    """What both call: the newest angle, its velocity, and the lag by the tool velocity of these two."""
    history, v_goal, lag = random_sight(machine, np.random.default_rng(21), (50,))
    q = history[..., 0, 0]
    u = history[..., 2, 0]
    after, late = sight.push_measured(machine, history, u, q, v_goal, lag)
    np.testing.assert_array_equal(after[..., :-1], history[..., 1:])
    np.testing.assert_array_equal(after[..., 2, -1], u)
    np.testing.assert_array_equal(after[..., 0, -1], q)
    slope = estimate_velocity(after[..., 0, :], machine.velocity_samples, machine.dt)
    np.testing.assert_array_equal(after[..., 1, -1], slope)
    np.testing.assert_array_equal(
        late,
        sight.integrate_error(
            machine, tool_velocity(forward_kinematics(machine, q), after[..., 1, -1]), v_goal, lag
        ),
    )


@pytest.mark.parametrize("machine", [BROKK_170, *MACHINES], ids=lambda m: m.name)
def test_angles_are_told_by_all_samples(machine):
    """Exact where joints turn evenly or speed up; of noise a thirteenth of its variance is left."""
    rng, H = np.random.default_rng(24), machine.history
    history, v_goal, lag = random_sight(machine, rng, (300,))
    even, time = history.copy(), machine.dt * np.arange(-H - machine.velocity_samples, 1)
    path = history[..., 0, -1:] + history[..., 1, -1:] * time + history[..., 2, -1:] * time**2
    windows = np.lib.stride_tricks.sliding_window_view(path, machine.velocity_samples, axis=-1)
    even[..., 1, :] = estimate_velocity(windows, machine.velocity_samples, machine.dt)[..., -H:]
    even[..., 0, :] = path[..., -H:]
    seen = sight.observe(machine, even, v_goal, lag)
    np.testing.assert_allclose(sight.measured(machine, seen).q, even[..., 0, -1], atol=2e-5)
    noise = rng.uniform(-0.5, 0.5, (300, sensed(machine))).astype(np.float32)
    error = (
        sight.measured(machine, sight.observe(machine, even, v_goal, lag, noise)).q
        - even[..., 0, -1]
    )
    spread = (
        machine.column("q_max") - machine.column("q_min")
    ) / 12  # of a uniform half of a deviation
    share = error.std(axis=0) / spread
    np.testing.assert_allclose(share[machine.locked], 1, atol=0.2)
    assert (share[machine.driven] < 1.5 * H**-0.5).all()


@pytest.mark.parametrize("machine", [BROKK_170, *MACHINES], ids=lambda m: m.name)
def test_wanted_rates_are_damped_least_squares_at_the_angles_that_are_shown(machine):
    """Noise or not: who reads the angles in an observation finds the rates that belong to them."""
    rng = np.random.default_rng(20)
    history, v_goal, lag = random_sight(machine, rng, (50,))
    nominal = machine.q_dot_max[machine.driven] / 3**0.5 / 4.2
    clean = sight.observe(machine, history, v_goal, lag)
    for noise in (0.0, rng.uniform(-0.5, 0.5, (50, sensed(machine))).astype(np.float32)):
        seen = sight.observe(machine, history, v_goal, lag, noise)
        q = sight.measured(machine, seen.astype(float)).q
        off = np.abs(q - told_angles(machine, history)).max()
        assert off > 0.05 if np.any(noise) else off < 1e-5
        for found, v, scale in zip(
            parts(machine, seen)[-2:], (v_goal, lag), (nominal, 0.1 * nominal), strict=True
        ):
            size = np.linalg.norm(damped_rates(machine, q, v), axis=-1).max()
            np.testing.assert_allclose(found * scale, damped_rates(machine, q, v), atol=1e-3 * size)
            np.testing.assert_allclose(found * scale, joint_rates(machine, q, v), atol=1e-4 * size)
    assert (
        np.abs(seen - clean)[:, -2 * len(machine.driven) :].max() > 0.01
    )  # the noise did change them


@pytest.mark.parametrize("machine", [BROKK_170, *MACHINES], ids=lambda m: m.name)
def test_scale_belongs_to_uniform_values_over_the_ranges(machine):
    """Observations of uniform histories have mean 0 and their weight as deviation: an oracle by sampling."""
    rng, num = np.random.default_rng(3), 4000
    history = np.zeros((num, machine.n, 3, machine.history))
    bounds = machine.column("q_min")[:, None], machine.column("q_max")[:, None]
    limit, fastest = machine.pwm_limit / 127, machine.q_dot_max[:, None]
    shape = (num, machine.n, machine.history)
    history[:, :, 0] = rng.uniform(*bounds, shape)
    history[:, :, 1] = rng.uniform(-fastest, fastest, shape)
    history[:, :, 2] = rng.uniform(-limit, limit, shape)
    v_goal = rng.uniform(-machine.tool_speed, machine.tool_speed, (num, 3))
    goal, _, angles, body, *_ = parts(machine, sight.observe(machine, history, v_goal, 0 * v_goal))
    for values, weight in ((goal, 1.4), (angles, 1.4), (body, machine.history**-0.5)):
        assert np.abs(values.mean(axis=0)).max(initial=0) < 0.1 * weight
        assert np.abs(values.std(axis=0) / weight - 1).max(initial=0) < 0.05
    mean, scale = sight.observation_scale(machine)
    assert mean.dtype == scale.dtype == np.float32
    assert not parts(machine, mean)[-1].any() and not parts(machine, mean)[-2].any()
    rates, late = parts(machine, scale)[-2:]
    np.testing.assert_allclose(4.2 * rates, machine.q_dot_max[machine.driven] / 3**0.5, rtol=1e-6)
    np.testing.assert_allclose(rates, 10 * late, rtol=1e-6)


@pytest.mark.parametrize("machine", [BROKK_170, MACHINES[0]], ids=lambda m: m.name)
def test_noise_is_uniform_within_five_percent_and_fresh_on_what_is_sensed(machine):
    """On tool velocity, angles and velocities in standard deviations; goal and commands are exact.

    The directions in which velocities are given are those of the arm that is told.
    """
    rng, num = np.random.default_rng(4), 400
    history, v_goal, lag = random_sight(machine, rng, (num,))
    state = replace(
        task.initial_state(machine, history[..., 0, -1], v_goal, plant=False),
        history=history,
        lag=lag,
    )
    clean = sight.observe(machine, history, v_goal, lag)
    seen = task.get_obs(machine, TaskConfig(), state, rng)
    assert seen.dtype == np.float32
    *_, angles, body, _, _ = parts(machine, seen - clean)
    assert not body[:, :, 2].any()
    back = sight.measured(machine, seen)
    np.testing.assert_allclose(back.v_goal, v_goal, atol=1e-5)
    exact = tool_velocity(forward_kinematics(machine, back.q), history[..., 1, -1])
    tool = headed(machine, back.q, back.v_tool - exact) * 1.4 * 3**0.5 / machine.tool_speed
    found = []
    for error, weight in ((tool, 1.4), (angles, 1.4), (body[:, :, :2], machine.history**-0.5)):
        draws = error.reshape(num, -1) / weight
        if draws.size:  # MACHINES[0] has no locked joint
            assert 0.0495 < np.abs(draws).max() < 0.05 + 1e-4
            assert stats.kstest(draws.ravel(), stats.uniform(-0.05, 0.1).cdf).pvalue > 1e-4
        found.append(draws)
    draws = np.concatenate(found, axis=1)
    assert draws.shape[1] == sensed(machine)
    assert np.abs(np.corrcoef(draws.T) - np.eye(draws.shape[1])).max() < 0.3
    assert not np.array_equal(seen, task.get_obs(machine, TaskConfig(), state, rng))
    assert np.array_equal(task.get_obs(machine, QUIET, state, rng), clean)


@pytest.mark.parametrize("shape", [(), (2, 3)])
def test_states_and_looks_take_any_leading_axes_and_whole_numbers(shape):
    state = task.initial_state(BROKK_170, np.full((*shape, 5), 1), STANDSTILL, plant=False)
    assert state.q.dtype == float and state.v_goal.shape == state.lag.shape == (*shape, 3)
    assert state.ticks.shape == state.goal_ticks.shape == shape
    assert state.ticks.dtype == state.goal_ticks.dtype == np.int64
    assert task.get_obs(BROKK_170, TaskConfig(), state, np.random.default_rng(0)).shape == (
        *shape,
        171,
    )


def test_the_observation_of_an_environment_is_noisy_within_five_percent():
    env = TaskVectorEnv(300)
    seen, _ = env.reset(seed=0)
    for _ in range(3):
        state = env.state
        error = seen - sight.observe(BROKK_170, state.history, state.v_goal, state.lag)
        *_, angles, body, _, _ = parts(BROKK_170, error)
        assert not body[:, :, 2].any()
        back = sight.measured(BROKK_170, seen)
        exact = tool_velocity(forward_kinematics(BROKK_170, back.q), state.history[..., 1, -1])
        tool = headed(BROKK_170, back.q, back.v_tool - exact) * 3**0.5 / 0.3
        for noise in (tool, angles / 1.4, body[:, :, :2] * 13**0.5):
            assert 0.049 < np.abs(noise).max() < 0.05 + 2e-5
        seen = env.step(env.action_space.sample())[0]


# --- the lag --------------------------------------------------------------------------------------


def test_lag_by_hand():
    """Errors of 0.012 m/s count in full, larger ones than 0.021 m/s (7 % of 0.3) as that, 50 ms each."""
    forget = np.exp(-0.025)
    goals = np.array([[0.012, 0, 0], [0, -0.2, 0], [0.3, 0, 0.4], [0, 0, 0.021]], np.float32)
    wanted = (
        np.array([[0.012, 0, 0], [0, -0.021, 0], [0.0126, 0, 0.0168], [0, 0, 0.021]])
        * 0.05
        * forget
    )
    lag = sight.integrate_error(
        BROKK_170, np.zeros((4, 3), np.float32), goals, np.zeros((4, 3), np.float32)
    )
    np.testing.assert_allclose(lag, wanted, rtol=1e-5, atol=1e-10)
    assert lag.dtype == np.float32
    again = sight.integrate_error(BROKK_170, np.zeros((4, 3), np.float32), goals[::-1], lag)
    np.testing.assert_allclose(
        again, (wanted + wanted[::-1] / forget) * forget, rtol=1e-5, atol=1e-10
    )


def test_the_tool_velocity_counts_against_the_goal():
    history = told_history()
    q, q_dot = history[:, 0, -1], history[:, 1, -1]
    ahead, behind = (closed_form(q + sign * 1e-6 * q_dot)[0] for sign in (1, -1))
    v_tool = (ahead - behind) / 2e-6
    assert np.linalg.norm(v_tool) > 0.1
    measured = tool_velocity(forward_kinematics(BROKK_170, q), q_dot)
    lag = np.array([0.01, 0.02, -0.03])
    kept = sight.integrate_error(BROKK_170, measured, v_tool, lag)
    np.testing.assert_allclose(
        kept, lag * np.exp(-0.025), atol=1e-8
    )  # no error: forgotten, nothing more
    error = np.array([0.01, 0.0, -0.005])
    after = sight.integrate_error(BROKK_170, measured, v_tool + error, lag)
    np.testing.assert_allclose(after, (lag + 0.05 * error) * np.exp(-0.025), atol=1e-8)


def test_a_lasting_error_fills_the_lag_and_it_is_forgotten_within_two_seconds():
    small, still = np.array([[0.008, -0.004, 0.001]]), np.zeros((1, 3))
    lag, sums = np.zeros((1, 3)), []
    for tick in range(1, 1001):
        lag = sight.integrate_error(BROKK_170, still, small, lag)
        sums.append(small * 0.05 * np.exp(-0.025 * np.arange(1, tick + 1)).sum())
        np.testing.assert_allclose(lag, sums[-1], rtol=1e-6)
    np.testing.assert_allclose(
        lag, 1.975 * small, rtol=1e-3
    )  # error x dt / (e^0.025 - 1), about x 2 s
    for _ in range(40):
        lag = sight.integrate_error(BROKK_170, still, np.zeros((1, 3)), lag)
    np.testing.assert_allclose(lag, sums[-1] / np.e, rtol=1e-5)


@pytest.mark.parametrize("machine", MACHINES[:4], ids=lambda m: m.name)
def test_the_lag_is_bounded_and_points_along_the_error(machine):
    machine = replace(machine, rate=40.0)
    rng, limit = np.random.default_rng(21), 0.07 * machine.tool_speed
    error = rng.standard_normal((30, 3)) * 10.0 ** rng.uniform(-3, 2, (30, 1)) * limit
    size = np.linalg.norm(error, axis=-1, keepdims=True)
    lag = sight.integrate_error(machine, np.zeros((30, 3)), error, np.zeros((30, 3)))
    counted = error / size * np.minimum(size, limit) * 0.025 * np.exp(-0.0125)
    np.testing.assert_allclose(lag, counted, rtol=1e-5)
    assert (size < limit).sum() > 5 and (size > limit).sum() > 5


@pytest.mark.parametrize("kind", ["plant", "nets"])
def test_the_lag_of_an_environment_follows_what_the_policy_saw(kind):
    """Re-made from observations alone, over ends of episodes and new goals; and shown as joint rates."""
    config = TaskConfig(noise=0.0, episode_s=1.5, hold_min_s=0.3, hold_max_s=0.9)
    net = "analytic" if kind == "plant" else small_net(LOW, np.random.default_rng(22))
    env, draws = TaskVectorEnv(4, net, LOW, config), np.random.default_rng(23)
    before = sight.measured(LOW, env.reset(seed=11)[0])
    assert not env.state.lag.any()
    env.state = replace(env.state, ticks=np.array([0, 10, 0, 20]))  # they do not end together
    lag, ends, nominal = np.zeros((4, 3)), 0, 0.1 * LOW.q_dot_max[LOW.driven] / 3**0.5 / 4.2
    for _ in range(70):
        seen, *_, info = env.step(draws.uniform(-1, 1, (4, 4)).astype(np.float32))
        last, over = info.get("final_obs", seen), info.get("_final_obs", np.zeros(4, bool))
        error = before.v_goal - sight.measured(LOW, last).v_tool
        error *= np.minimum(
            1, 0.021 / np.maximum(np.linalg.norm(error, axis=-1, keepdims=True), 1e-12)
        )
        lag = (lag + 0.05 * error) * np.exp(-0.025)
        if over.any():  # the last observation still shows the lag of the old episode
            shown = parts(LOW, last)[-1][over] * nominal
            wanted = damped_rates(LOW, sight.measured(LOW, last).q[over], lag[over])
            np.testing.assert_allclose(shown, wanted, atol=1e-5)
            assert np.abs(shown).max() > 1e-4
        lag[over], ends = 0.0, ends + over.sum()
        np.testing.assert_allclose(
            env.state.lag, lag, atol=2e-5
        )  # they show the arm a little smoother
        lag = env.state.lag.astype(float)
        assert not env.state.lag[over].any() and not parts(LOW, seen)[-1][over].any()
        before = sight.measured(LOW, seen)
        np.testing.assert_allclose(
            parts(LOW, seen)[-1] * nominal, damped_rates(LOW, before.q, lag), atol=1e-5
        )
    assert ends == 9
    assert np.abs(lag).max() > 0.002


def test_the_papers_observation_has_plain_standard_deviations_and_no_wanted_rates() -> None:
    """By hand for one state: (value - middle) / nominal deviation of each quantity, all weights 1."""
    m, config = BROKK_170, TaskConfig(paper=True, noise=0.0)
    state = task.reset(m, config, np.random.default_rng(0), 3, plant=False)
    state = replace(
        state, history=state.history + np.float32(0.01), lag=state.lag + np.float32(0.02)
    )
    seen = task.get_obs(m, config, state, np.random.default_rng(0))
    np.testing.assert_array_equal(seen[:, -8:], 0)
    middle, width = (
        (m.column("q_min") + m.column("q_max")) / 2,
        m.column("q_max") - m.column("q_min"),
    )
    q = (state.history[:, :, 0] - middle[:, None]) / (width / 12**0.5)[:, None]
    q_dot = state.history[:, :, 1] / (m.q_dot_max / 3**0.5)[:, None]
    u = state.history[:, :, 2] / (80 / 127 / 3**0.5)
    np.testing.assert_allclose(seen[:, 6], q[:, 1, -1], atol=1e-5)
    wanted = np.stack([q, q_dot, u], axis=2)[:, [0, 2, 3, 4]]
    np.testing.assert_allclose(parts(m, seen)[3], wanted, atol=1e-5)
    speed = np.linalg.norm(state.v_goal, axis=-1) / (m.tool_speed / 3**0.5)
    np.testing.assert_allclose(np.linalg.norm(seen[:, :3], axis=-1), speed, atol=1e-5)
