"""Our agent's observation, action and closed valves by hand.

tests/properties/test_reward.py has its memory and its costs.
"""

import re
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from helpers_machines import DRIVEN, numbered_history, steady
from hypothesis import given
from hypothesis import strategies as st
from strategies import machines, posed

from brokk_min import env
from brokk_min.beyond import interface
from brokk_min.beyond.interface import INTERFACE, Memory, observation_scale, smooth_angles
from brokk_min.kinematics import forward_kinematics, jacobian
from brokk_min.machine import BROKK_170

V_TOOL = (0.05, -0.02, 0.09)  # m/s


def memory(rest_ticks=0, integral=(0.0,) * 3, open_ticks=0) -> Memory:
    return Memory(*map(np.array, ([0.0] * 3, V_TOOL, integral, rest_ticks, open_ticks)))


def test_smooth_angles__by_hand():
    """Three samples of velocities 1, 2, 4 rad/s, which lag by half a tick of a window of three.

    The oldest sample moves on by (2 + 4) dt, and its velocity was (4 - 1) / 2 dt behind; the next
    by 4 dt, and (4 - 2) / 2 dt; the newest stays.
    """
    machine = replace(BROKK_170, history=3, velocity_samples=3)
    history = np.zeros((1, 3, 3))
    history[0, 0] = [0.3, 0.6, 0.9]
    history[0, 1] = [1.0, 2.0, 4.0]
    expected = np.mean([0.3 + 0.05 * (6 + 1.5), 0.6 + 0.05 * (4 + 1.0), 0.9])
    np.testing.assert_allclose(smooth_angles(machine, history), [expected], atol=1e-12)


@given(posed(shapes=[(5,)]), st.integers(0, 1000))
def test_remember__has_the_velocity_that_the_tool_had_when_the_joints_had_theirs(case, seed):
    """Of joints in steady motion, by differences of the pose; noise of its own stays as it is."""
    machine, q = case
    q_dot, noise = np.random.default_rng(seed).normal(0, 0.3, (2, 8))
    q_dot = np.where(np.isin(np.arange(machine.n), machine.driven), q_dot[: machine.n], 0)
    now = steady(q, np.zeros(3), q_dot, machine=machine)
    now = now._replace(v_tool=now.v_tool + noise[:3])
    past = now.q - machine.dt * (machine.velocity_samples - 1) / 2 * q_dot
    tools = [forward_kinematics(machine, past + s * 1e-6 * q_dot).p[:, -1] for s in (1, -1)]
    expected = (tools[0] - tools[1]) / 2e-6 + noise[:3]
    first = INTERFACE.remember(machine, None, now)
    np.testing.assert_allclose(first.v_tool, expected, atol=1e-6)
    first = first._replace(v_goal=expected + 1e-3)  # a small error, which no cut hides
    found, same = INTERFACE.remember(machine, first, now), now._replace(v_tool=expected)
    np.testing.assert_allclose(found.v_tool, expected, atol=1e-6)
    integral = interface.accumulate(machine, first, same).error_integral
    np.testing.assert_allclose(found.error_integral, integral, atol=1e-6 / machine.rate)


def test_observe__by_hand():
    """Smoothed angles, the newer half of the paper's samples by their weights, our own blocks."""
    integral = (0.02, -0.01, 0.03)
    v_goal = np.array([0.3, -0.1, -0.15], np.float32)
    measured = env.measure(BROKK_170, numbered_history(), v_goal)
    obs = INTERFACE.observe(BROKK_170, measured, memory(0, integral))
    assert obs.shape == (91,) and obs.dtype == np.float32
    mean, std, _ = env.observation_table(BROKK_170)
    paper = env.features(BROKK_170, measured)
    paper[3:6] = V_TOOL / std[3:6]
    np.testing.assert_allclose(obs[:7], 0.75 * paper[:7], rtol=1e-5)
    q = measured.q.astype(float)
    q[DRIVEN] = smooth_angles(BROKK_170, measured.history)
    np.testing.assert_allclose(obs[7:11], (q[DRIVEN] - mean[7:111:26]) / std[7:111:26], rtol=1e-4)
    fading = np.exp(-np.arange(5, -1, -1) / 2)  # of the 6 newest samples, newest last
    fading /= np.sum(fading**2) ** 0.5
    q_dot, u = paper[7:111].reshape(4, 2, 13)[:, 1, 7:], paper[111:].reshape(4, 13)[:, 7:]
    np.testing.assert_allclose(obs[11:35].reshape(4, 6), q_dot * fading, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(obs[35:59].reshape(4, 6), u * fading, rtol=1e-5, atol=1e-6)
    for place, joint in ((59, 0), (65, 2), (71, 3), (77, 4)):
        opening = np.maximum(0, np.abs(-0.1 * joint + 0.002 * np.arange(7, 13)) - 0.07) / 0.93
        expected = (np.tanh(opening / 0.02) - 0.5) / 0.5 * fading
        np.testing.assert_allclose(obs[place : place + 6], expected, rtol=1e-4, atol=1e-6)
    J = jacobian(forward_kinematics(BROKK_170, q))[:, DRIVEN]
    damping = (0.06 * (np.hypot(0.25, 0.95) + 1.15 + 1.25 + 1.15 + 1.2)) ** 2
    solution = np.linalg.solve(J.T @ J + damping * np.eye(4), J.T)
    nominal = env.velocity_deviations(BROKK_170)[1][DRIVEN] / 1.5
    np.testing.assert_allclose(obs[83:87], solution @ measured.v_goal / nominal, rtol=1e-4)
    np.testing.assert_allclose(obs[87:], solution @ integral / (0.1 * nominal), rtol=1e-4)


def test_the_table_of_the_docstring__is_true():
    """Numbers and weights of the table are those of the scale; of samples, of the newest."""
    rows = re.findall(r"^\| (\d+)-(\d+) +\| .+? +\| .+? +\| ([\d.]+)", interface.__doc__, re.M)
    _, scale = observation_scale(BROKK_170)
    std = env.observation_table(BROKK_170)[1]
    q_dot = env.velocity_deviations(BROKK_170)[1][DRIVEN]
    samples = [np.repeat(q_dot, 6), std[-24:], np.full(24, 0.5)]
    deviations = np.concatenate([std[:7], std[7:111:26], *samples, q_dot, 0.1 * q_dot])
    assert [int(last) + 1 for _, last, _ in rows] == [7, 11, 35, 59, 83, 87, len(scale)]
    assert all(int(one[1]) + 1 == int(next_[0]) for one, next_ in pairwise(rows))
    for first, last, weight in rows:
        step = 6 if int(last) - int(first) == 23 else 1
        place = slice(int(first) + step - 1, int(last) + 1, step)
        np.testing.assert_allclose(deviations[place] / scale[place], float(weight), atol=5e-4)


@given(machines(), st.integers(4, 40))
def test_scale__of_any_machine_lets_the_samples_of_a_signal_weigh_as_one_number(machine, history):
    """Velocities, commands, indicators: those of the newer half have sum w^2 = 1 and fade."""
    machine = replace(machine, name=f"{machine.name}, {history}", history=history)
    n, half, first = len(machine.driven), machine.history // 2, 6 + len(machine.locked)
    mean, scale = observation_scale(machine)
    assert mean.shape == scale.shape == (first + n + 3 * n * half + 2 * n,)
    q_dot = env.velocity_deviations(machine)[1][machine.driven]
    u = env.observation_table(machine)[1][-1]
    std = np.repeat([*q_dot, *np.full(n, u), *np.full(n, 0.5)], half)
    weights = (std / scale[first + n : -2 * n]).reshape(3 * n, half)
    np.testing.assert_allclose((weights**2).sum(axis=1), 1, rtol=1e-4)
    np.testing.assert_allclose(weights[:, -2] / weights[:, -1], np.exp(-6.5 / history), rtol=1e-4)


@given(machines(), st.floats(-0.02, 0.02) | st.floats(-2, 2))
def test_command__is_piecewise_linear_beyond_each_valves_own_dead_zone(machine, a):
    u = INTERFACE.command(machine, np.full(len(machine.driven), a), memory()) * 127
    for j, joint in enumerate(machine.joints):
        dead = 127 * joint.dead_zone[0 if a > 0 else 1]
        knee = dead + 0.01 * (machine.pwm_limit - dead)
        exact = np.sign(a) * np.interp(abs(a), [0, 0.01, 1], [0, knee, machine.pwm_limit])
        assert u[j] == pytest.approx(exact if joint.driven else 0, abs=0.5 + 1e-6)
        assert u[j] == round(u[j], 9)


def test_command__opens_a_valve_wider_shortly_before_it_answers():
    """1.25 times from 0.25 to 0.4 s after it was closed, each valve by itself; at most fully."""
    u = INTERFACE.command(BROKK_170, np.full(4, 0.5), memory(open_ticks=[4, 5, 7, 8]))
    plain, wide = (
        INTERFACE.command(BROKK_170, np.full(4, a), memory())[DRIVEN] for a in (0.5, 0.625)
    )
    assert u[DRIVEN].tolist() == [plain[0], wide[1], wide[2], plain[3]]
    assert np.abs(INTERFACE.command(BROKK_170, np.ones(4), memory(open_ticks=5))).max() * 127 == 80


def test_command__closes_the_valves_after_a_tenth_of_a_second_without_a_goal():
    """Of a batch of machines each by its own rest; 0.1 s are two ticks."""
    u = INTERFACE.command(BROKK_170, np.full((4, 4), 0.5), memory([0, 2, 3, 1000]))
    assert u[:, DRIVEN].all(axis=1).tolist() == [True, True, False, False]
    assert u.any(axis=1).tolist() == [True, True, False, False]
    slow = replace(BROKK_170, name="slow", rate=10.0)  # one tick
    assert INTERFACE.command(slow, np.full(4, 0.5), memory(1)).any()
    assert not INTERFACE.command(slow, np.full(4, 0.5), memory(2)).any()
