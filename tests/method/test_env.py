"""The task by hand, against closed forms and plain loops, and over any machine."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from helpers_machines import POSE, closed_form, obedient_net, obedient_velocity, small_net
from hypothesis import given
from hypothesis import strategies as st
from strategies import machines

from brokk_min import env as task
from brokk_min.actuator import plant_reset, plant_step
from brokk_min.env import (
    TaskConfig,
    action_to_pwm,
    features,
    initial_state,
    integrate_error,
    measure,
    observation_blocks,
    observation_scale,
    sensor_std,
    step,
    terminated,
    transition,
    update_history,
)
from brokk_min.kinematics import (
    estimate_velocity,
    forward_kinematics,
    jacobian,
    lowest_point,
    tool_position,
    tool_velocity,
)
from brokk_min.machine import BROKK_170, read_encoder

ZERO = np.zeros(3, np.float32)
DRIVEN = [0, 2, 3, 4]


def tool_velocity_by_hand(q: np.ndarray, q_dot: np.ndarray) -> np.ndarray:
    """Differences of the closed form along the motion."""
    ahead, behind = (closed_form(q + sign * 1e-6 * q_dot)[0] for sign in (1, -1))
    return (ahead - behind) / 2e-6


# --- end ------------------------------------------------------------------------------------------


def test_terminated__below_the_ground_not_at_it():
    assert terminated(BROKK_170, np.array([-1e-6, 0.0, 1e-6])).tolist() == [True, False, False]
    higher = replace(BROKK_170, ground=0.5)
    assert terminated(higher, np.array([0.49, 0.51])).tolist() == [True, False]


# --- action ---------------------------------------------------------------------------------------


def test_action_to_pwm__by_hand():
    """The dead zone has 8.89 counts, 71.11 are beyond: 8.89 + 35.56; clipped to -80."""
    for paper, action, counts in (
        (False, [0.5, -3.0, -0.01, 0.005], [44, 0, -80, -10, 5]),
        (False, [0, 0, 0, 0], [0, 0, 0, 0, 0]),
        (False, [1, 0, -1, 0], [80, 0, 0, -80, 0]),
        (True, [0.5, -3.0, -0.01, 0.02], [40, 0, -80, -1, 2]),  # 80 a
    ):
        u = action_to_pwm(BROKK_170, action, paper)
        np.testing.assert_allclose(u * 127, counts, atol=1e-9)


@given(machines(), st.floats(-2, 2), st.floats(-2, 2))
def test_action_to_pwm__is_piecewise_linear_odd_and_in_whole_counts(machine, one, other):
    low, high = sorted([one, other])
    action = np.array([[low], [high], [-high]]) * np.ones(len(machine.driven))
    counts = action_to_pwm(machine, action) * 127
    assert not counts[:, machine.locked].any()
    counts = counts[:, machine.driven]
    np.testing.assert_allclose(counts, np.rint(counts), atol=1e-9)
    assert (counts[0] <= counts[1]).all()
    np.testing.assert_array_equal(counts[1], -counts[2])
    dead = 127 * machine.dead_zone
    at_knee = dead + 0.01 * (machine.pwm_limit - dead)
    exact = np.sign(high) * np.interp(abs(high), [0, 0.01, 1], [0, at_knee, machine.pwm_limit])
    assert np.abs(counts[1] - exact).max() <= 0.5 + 1e-6


def test_action_to_pwm__refuses_wrong_shapes_and_what_is_not_finite():
    for shape in ((), (1,), (3,), (5,), (4, 1)):
        with pytest.raises(ValueError, match=re.escape(f"action: expected (..., 4), got {shape}")):
            action_to_pwm(BROKK_170, np.zeros(shape))
    for bad in (np.nan, np.inf, -np.inf):
        with pytest.raises(ValueError, match=f"action: expected finite numbers, got {bad}"):
            action_to_pwm(BROKK_170, [[0.0, bad, 0.0, 0.0]])


# --- observation ----------------------------------------------------------------------------------


def numbered_history() -> np.ndarray:
    """A history (5, 3, 13) of the Brokk in which every number differs."""
    joint, lag = np.arange(5)[:, None], np.arange(13)
    q = POSE[:, None] + 0.01 * (lag - 12)
    q_dot = 0.02 * joint + 0.001 * lag
    u = -0.1 * joint + 0.002 * lag
    return np.stack([q, q_dot, u], axis=1).astype(np.float32)


def test_features__by_hand():
    """Each block of the table: (x - mean) / deviation * weight, in its place."""
    v_goal, integral = np.array([[0.3, -0.1, -0.15], [0.02, -0.01, 0.03]], np.float32)
    measured = measure(BROKK_170, numbered_history(), v_goal, integral)
    obs = features(BROKK_170, measured)
    assert obs.shape == (223,) and obs.dtype == np.float32
    x, y, _ = tool_position(forward_kinematics(BROKK_170, measured.q.astype(float)))
    heading = np.array([x, y]) / np.hypot(x, y)
    across = np.array([-heading[1], heading[0]])
    for place, v in ((0, v_goal), (3, measured.v_tool)):
        in_heading = np.array([heading @ v[:2], across @ v[:2], v[2]])
        np.testing.assert_allclose(
            obs[place : place + 3], 1.4 * in_heading * 3**0.5 / 0.3, atol=1e-5
        )
    assert obs[6] == pytest.approx(1.4 * (0.5 - 0.7) * 12**0.5 / 1.4, rel=1e-6)  # q2: 0 .. 1.4
    lag = np.arange(13)
    weight = 13**-0.5
    q1 = (1.5 + 0.01 * (lag - 12)) * 12**0.5 / 4.28
    np.testing.assert_allclose(obs[7:20], weight * q1, rtol=1e-5)
    np.testing.assert_allclose(obs[20:33], weight * 0.001 * lag * 3**0.5 / 0.20, rtol=1e-5)
    q3 = (0.58 + 0.01 * (lag - 12) - 0.65) * 12**0.5 / 1.9
    np.testing.assert_allclose(obs[33:46], weight * q3, rtol=1e-4, atol=1e-6)
    q5_dot = (0.08 + 0.001 * lag) * 3**0.5 / 0.47
    np.testing.assert_allclose(obs[98:111], weight * q5_dot, rtol=1e-5)
    for place, joint in ((111, 0), (124, 2), (137, 3), (150, 4)):
        u = (-0.1 * joint + 0.002 * lag) * 127 * 3**0.5 / 80
        np.testing.assert_allclose(obs[place : place + 13], weight * u, rtol=1e-5, atol=1e-6)
        beyond = np.maximum(0, np.abs(-0.1 * joint + 0.002 * lag) - 0.07) / 0.93
        opens = weight * (np.tanh(beyond / 0.02) - 0.5) / 0.5
        np.testing.assert_allclose(obs[place + 52 : place + 65], opens, rtol=1e-4, atol=1e-6)
    J = jacobian(forward_kinematics(BROKK_170, measured.q.astype(float)))[:, DRIVEN]
    damping = (0.06 * (np.hypot(0.25, 0.95) + 1.15 + 1.25 + 1.15 + 1.2)) ** 2
    solution = np.linalg.solve(J.T @ J + damping * np.eye(4), J.T)
    nominal = np.array([0.20, 0.28, 0.38, 0.47]) / 3**0.5 / 4.2
    np.testing.assert_allclose(obs[215:219], solution @ v_goal / nominal, rtol=1e-4)
    np.testing.assert_allclose(obs[219:], solution @ integral / (0.1 * nominal), rtol=1e-4)
    paper = features(BROKK_170, measured, paper=True)
    assert paper.shape == (163,) and paper.dtype == np.float32
    np.testing.assert_allclose(paper[:3], v_goal * 3**0.5 / 0.3, rtol=1e-5)  # base frame
    np.testing.assert_allclose(paper[3:6], measured.v_tool * 3**0.5 / 0.3, rtol=1e-5)
    np.testing.assert_allclose(paper[6], obs[6] / 1.4, rtol=1e-5)
    np.testing.assert_allclose(paper[7:], obs[7:163] / weight, rtol=1e-5)


@given(machines(), st.integers(0, 1000))
def test_measure__is_in_physical_units_of_the_base_frame(machine, seed):
    rng = np.random.default_rng(seed)
    low, high = machine.column("q_min")[:, None], machine.column("q_max")[:, None]
    history = rng.normal(0, 0.2, (4, machine.n, 3, machine.history))
    history[..., 0, :] = rng.uniform(low, high, (4, machine.n, 1))
    v_goal, integral = rng.normal(size=(2, 4, 3))
    measured = measure(machine, history, v_goal, integral)
    np.testing.assert_array_equal(measured.v_goal, v_goal)
    np.testing.assert_array_equal(measured.error_integral, integral)
    np.testing.assert_array_equal(measured.history, history[:, machine.driven])
    np.testing.assert_array_equal(measured.q_dot, history[:, machine.driven, 1, -1])
    np.testing.assert_array_equal(measured.q[:, machine.locked], history[:, machine.locked, 0, -1])
    frames = forward_kinematics(machine, measured.q)
    np.testing.assert_allclose(measured.p_tool, tool_position(frames), atol=1e-12)
    np.testing.assert_allclose(measured.J, jacobian(frames), atol=1e-12)
    velocity = tool_velocity(frames, history[..., 1, -1])  # the locked joints count as well
    np.testing.assert_allclose(measured.v_tool, velocity, atol=1e-12)
    size = 6 + len(machine.locked) + (4 * machine.history + 2) * len(machine.driven)
    assert features(machine, measured).shape == (4, size)
    assert sum(block.std.size for block in observation_blocks(machine)) == size
    assert (observation_scale(machine)[1] > 0).all()


def test_measure__adds_noise_to_what_sensors_measure_in_deviations():
    """0.1 deviations: 0.0173 m/s, 0.1 / sqrt(12) of each range, 0.1 / sqrt(3) of each velocity."""
    history = numbered_history()
    clean = measure(BROKK_170, history, ZERO, ZERO)
    kept = history.copy()
    noise = np.full(len(sensor_std(BROKK_170)), 0.1, np.float32)
    noisy = measure(BROKK_170, history, ZERO, ZERO, noise)
    np.testing.assert_array_equal(history, kept)
    error = noisy.history - clean.history
    np.testing.assert_allclose(error[0, 0], 0.1 * 4.28 / 12**0.5, rtol=1e-4)
    np.testing.assert_allclose(error[3, 1], 0.1 * 0.47 / 3**0.5, rtol=1e-4)
    assert not error[:, 2].any()  # commands are known
    assert noisy.q[1] - clean.q[1] == pytest.approx(0.1 * 1.4 / 12**0.5, rel=1e-5)
    frames = forward_kinematics(BROKK_170, noisy.q)
    exact = tool_velocity(frames, history[:, 1, -1])
    np.testing.assert_allclose(noisy.v_tool - exact, 0.1 * 0.3 / 3**0.5, atol=1e-6)
    assert np.abs(noisy.q[0] - clean.q[0]) > 0.05  # the arm is where the noisy angles say


def test_the_table_of_the_docstring__is_true():
    """Numbers, deviations, weights and noise of the table are those of the blocks."""
    rows = re.findall(
        r"^\| (\d+)(?:-(\d+))? +\| .+? +\| (.+?) +\| ([\d.]+) +\| (\w+) +\|", task.__doc__, re.M
    )
    blocks = observation_blocks(BROKK_170)
    cuts = [0, 1, 2, 3, 11, 12, 13, 14, 15]  # a row holds the blocks of all joints
    groups = [blocks[i:j] for i, j in pairwise(cuts)]
    assert len(rows) == len(groups)
    place = 0
    for (first, last, deviation, weight, noise), group in zip(rows, groups, strict=True):
        assert int(first) == place
        place += sum(block.std.size for block in group)
        assert int(last or first) == place - 1
        assert float(weight) == pytest.approx(group[0].weight, abs=5e-4)
        assert (noise == "yes") == group[0].noisy
        number = re.match(r"0\.\d{3}", deviation)
        assert not number or float(number[0]) == pytest.approx(group[0].std[0], abs=5e-4)
    assert place == 223 and "(223,)" in task.__doc__ and "Box(-1, 1, (4,))" in task.__doc__
    for word in ("Observation:", "Action:", "Reward:", "Start:", "End:", "truncated after 20 s"):
        assert word in task.__doc__
    assert TaskConfig().episode_s == 20


# --- the error integral ---------------------------------------------------------------------------


def test_integrate_error__by_hand():
    """Errors up to 0.021 m/s (7 % of 0.3) count in full, larger ones as that, 50 ms each."""
    leak = np.exp(-0.025)
    goals = np.array([[0.012, 0, 0], [0, -0.2, 0], [0.3, 0, 0.4], [0, 0, 0.021]], np.float32)
    counted = np.array([[0.012, 0, 0], [0, -0.021, 0], [0.0126, 0, 0.0168], [0, 0, 0.021]]) * 0.05
    zero = np.zeros((4, 3), np.float32)
    integral = integrate_error(BROKK_170, goals, zero, zero)
    np.testing.assert_allclose(integral, counted * leak, rtol=1e-5, atol=1e-10)
    assert integral.dtype == np.float32
    again = integrate_error(BROKK_170, zero, goals, integral)  # the error turned round
    np.testing.assert_allclose(again, (counted * leak - counted) * leak, rtol=1e-4, atol=1e-9)


def test_update_history__measures_the_tool_by_the_newest_samples():
    history = numbered_history()
    u, q = np.full(5, 0.2), POSE + 0.01
    v_goal, integral = np.array([0.01, -0.02, 0.005]), np.array([0.01, 0.02, -0.03])
    after, later = update_history(BROKK_170, history, u, q, v_goal, integral)
    np.testing.assert_array_equal(after[..., :-1], history[..., 1:])
    np.testing.assert_allclose(after[:, 0, -1], q, rtol=1e-6)
    np.testing.assert_allclose(after[:, 2, -1], 0.2, rtol=1e-6)
    slope = estimate_velocity(after[:, 0], 4, 0.05)
    np.testing.assert_allclose(after[:, 1, -1], slope, rtol=1e-6)
    v_tool = tool_velocity_by_hand(q, slope.astype(float))
    expected = integrate_error(BROKK_170, v_goal, v_tool, integral)
    np.testing.assert_allclose(later, expected, atol=1e-6)


# --- one tick -------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(), (2,), (2, 3)])
def test_initial_state__is_at_rest_at_the_measured_pose(shape):
    q = np.broadcast_to(POSE, (*shape, 5))
    state = initial_state(BROKK_170, q, [0.1, 0.0, 0.2], plant=True)
    assert state.q.dtype == np.float64 and state.history.dtype == np.float32
    counts = state.history[..., 0, :] / BROKK_170.encoder_step[:, None]
    np.testing.assert_allclose(counts, np.rint(counts), atol=1e-3)
    angles = state.true_history[..., 0, -1]
    np.testing.assert_allclose(angles, q[..., DRIVEN], rtol=1e-6)
    for still in (state.history[..., 1:, :], state.true_history[..., 1:, :], state.q_dot):
        assert not still.any()
    np.testing.assert_array_equal([state.error_integral, state.v_tool], np.zeros((2, *shape, 3)))
    np.testing.assert_allclose(state.lowest, closed_form(state.q)[1], atol=1e-12)
    np.testing.assert_allclose(state.v_goal, np.full((*shape, 3), [0.1, 0, 0.2]), rtol=1e-6)
    assert state.ticks.shape == state.goal_ticks.shape == state.lowest.shape == shape
    assert not state.ticks.any() and (state.goal_ticks > 1e9).all()
    whole = initial_state(BROKK_170, [1, 1, 1, 1, 1], ZERO, plant=True)
    assert whole.q.dtype == whole.plant.q.dtype == float


def test_transition__on_nets_by_hand():
    """With nets that obey the command, one tick moves each driven joint by velocity x 50 ms."""
    u = np.array([40, 0, -80, 13, 0]) / 127
    state = initial_state(BROKK_170, POSE, ZERO, plant=False)
    after = transition(BROKK_170, obedient_net(BROKK_170), state, u)
    move = np.zeros(5)
    move[DRIVEN] = obedient_velocity(BROKK_170, u[DRIVEN])
    assert move[0] == pytest.approx(0.24 * np.tanh(1.5 * 40 / 127), rel=1e-9)
    np.testing.assert_allclose(after.q, POSE + 0.05 * move, atol=1e-8)
    np.testing.assert_allclose(after.q_dot, move, atol=2e-7)
    np.testing.assert_allclose(after.true_history[:, 0, -1], after.q[DRIVEN], rtol=1e-6)
    np.testing.assert_array_equal(after.history[:, 2, -1], u.astype(np.float32))
    assert not after.history[:, 2, :-1].any()
    counts = np.rint((POSE + 0.05 * move) / BROKK_170.encoder_step)
    np.testing.assert_allclose(after.history[:, 0, -1] / BROKK_170.encoder_step, counts, atol=1e-3)
    before = np.rint(POSE / BROKK_170.encoder_step)
    slope = 0.3 * (counts - before) * BROKK_170.encoder_step / 0.05  # weights -3, -1, 1, 3 over 10
    np.testing.assert_allclose(after.history[:, 1, -1], slope, atol=1e-5)
    np.testing.assert_allclose(after.v_tool, tool_velocity_by_hand(after.q, move), atol=1e-5)
    assert after.lowest == pytest.approx(closed_form(after.q)[1], abs=1e-5)
    assert after.ticks == 1 and after.goal_ticks == state.goal_ticks - 1


def test_initial_state__reads_the_encoders_of_a_plant_that_has_its_own():
    """They stand 0.02 rad off: a joint at rest has no velocity."""

    class Offset:
        def reset(self, machine, q):
            return SimpleNamespace(q=q, encoder=q + 0.02)

        def step(self, machine, state, u):
            return state

    machine = replace(BROKK_170, plant=Offset())
    state = initial_state(machine, POSE, ZERO, plant=True)
    after = transition(machine, None, state, np.zeros(5))
    np.testing.assert_array_equal(after.history, state.history)
    np.testing.assert_allclose(after.history[:, 0, 0], POSE + 0.02, atol=1e-3)


def test_transition__moves_no_simulated_arm_by_what_encoders_say():
    net, rng = small_net(BROKK_170, np.random.default_rng(5)), np.random.default_rng(6)
    right = wrong = initial_state(BROKK_170, POSE, ZERO, plant=False)
    for _ in range(20):
        u = action_to_pwm(BROKK_170, rng.uniform(-1, 1, 4))
        right = transition(BROKK_170, net, right, u)
        wrong = transition(BROKK_170, net, wrong, u, lambda _, q: q + rng.normal(0, 0.1, q.shape))
        np.testing.assert_array_equal(wrong.q, right.q)
    assert np.abs(wrong.history - right.history).max() > 0.1
    assert np.abs(right.q - POSE).max() > 0.01


@given(machines(), st.integers(0, 1000))
def test_transition__on_the_plant_is_the_plant_measured_as_on_hardware(machine, seed):
    """`update_history` of the encoder angles; velocity and lowest point of the true pose."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(machine.column("q_min"), machine.column("q_max"), (2, machine.n))
    state = initial_state(machine, q, rng.normal(size=(2, 3)), plant=True)
    plant = plant_reset(machine, q)
    for _ in range(6):
        action = rng.uniform(-1, 1, (2, len(machine.driven))).astype(np.float32)
        u = action_to_pwm(machine, action)
        plant = plant_step(machine, plant, u)
        after = transition(machine, None, state, u)
        np.testing.assert_array_equal(after.q, plant.q)
        np.testing.assert_allclose(after.q_dot, (after.q - state.q) * machine.rate, atol=1e-12)
        seen = state.history, u, read_encoder(machine, after.q), state.v_goal, state.error_integral
        history, integral = update_history(machine, *seen)
        np.testing.assert_array_equal(after.history, history)
        np.testing.assert_allclose(after.error_integral, integral, atol=1e-8)
        frames = forward_kinematics(machine, after.q)
        np.testing.assert_allclose(after.v_tool, tool_velocity(frames, after.q_dot), atol=1e-5)
        np.testing.assert_allclose(after.lowest, lowest_point(frames), atol=1e-5)
        for name in ("history", "true_history", "v_goal", "v_tool", "error_integral", "lowest"):
            assert getattr(after, name).dtype == np.float32, name
        assert u.dtype == np.float32 and after.q.dtype == after.q_dot.dtype == np.float64
        state = after


def test_transition__refuses_a_state_without_plant_and_nets():
    state = initial_state(BROKK_170, POSE, ZERO, plant=False)
    message = "net: expected nets for a state without a plant, got None"
    with pytest.raises(ValueError, match=message):
        transition(BROKK_170, None, state, np.zeros(5))


@pytest.mark.parametrize(
    ("config", "still"),
    [(TaskConfig(), True), (TaskConfig(valves="open"), False), (TaskConfig(paper=True), False)],
)
def test_step__closes_the_valves_of_an_arm_at_rest_but_for_the_paper(config, still):
    state = initial_state(BROKK_170, POSE[None], ZERO, plant=True)
    state = replace(state, rest_ticks=np.array([1000]))
    after, *_ = step(BROKK_170, config, None, state, np.full((1, 4), 0.5))
    assert after.history[..., 2, -1].any() != still


def arrays_of(state: task.State) -> list[np.ndarray]:
    """All arrays of a state, the plant's included."""
    found = [array for array in vars(state).values() if isinstance(array, np.ndarray)]
    return found + list(state.plant or [])


@pytest.mark.parametrize("plant", [True, False])
def test_step__writes_into_nothing_that_it_is_given(plant):
    """States and actions are read-only here: a write in place would raise."""
    rng = np.random.default_rng(31)
    net = None if plant else small_net(BROKK_170, rng)
    pose = rng.uniform(BROKK_170.column("q_min"), BROKK_170.column("q_max"), (6, 5))
    state = initial_state(BROKK_170, pose, rng.normal(size=(6, 3)), plant)
    for _ in range(4):
        action = rng.uniform(-1, 1, (6, 4)).astype(np.float32)
        for array in (*arrays_of(state), action):
            array.setflags(write=False)
        after, *results = step(BROKK_170, TaskConfig(), net, state, action)
        again, *same = step(BROKK_170, TaskConfig(), net, state, action)
        for a, b in zip((*results, *arrays_of(after)), (*same, *arrays_of(again)), strict=True):
            np.testing.assert_array_equal(a, b)
        measure(BROKK_170, state.history, state.v_goal, state.error_integral, 0.1)
        state = after
