"""The task by hand and against plain loops; tests/properties has the reward and the end."""

import re
from types import SimpleNamespace

import numpy as np
import pytest
from helpers_machines import POSE, closed_form, numbered_history, pids, small_net
from hypothesis import given
from hypothesis import strategies as st
from numpy.random import default_rng
from scipy import stats
from strategies import machines

from brokk_min import env
from brokk_min.actuator import PLANT
from brokk_min.kinematics import forward_kinematics, lowest_point, tool_position, tool_velocity
from brokk_min.machine import BROKK_170
from brokk_min.settings import TaskConfig

ZERO = np.zeros(3, np.float32)


class Obedient:
    """A simulator of one's own, in which every joint moves at `u` rad/s."""

    def reset(self, machine, q):
        return SimpleNamespace(q=np.array(q, float))

    def step(self, machine, state, u):
        return SimpleNamespace(q=state.q + machine.dt * u)


# --- action ---------------------------------------------------------------------------------------


def test_action_to_pwm__by_hand():
    """80 a in whole counts of the driven joints; clipped to -80."""
    u = env.action_to_pwm(BROKK_170, [[0.5, -3.0, -0.01, 0.02], [1, 0, -1, 0]])
    np.testing.assert_allclose(u * 127, [[40, 0, -80, -1, 2], [80, 0, 0, -80, 0]], atol=1e-9)
    np.testing.assert_array_equal(env.action_to_pwm(BROKK_170, [1, 0, -1, 0]), u[1])
    for kind in (np.float32, np.float64):
        assert env.action_to_pwm(BROKK_170, np.ones(4, kind)).dtype == kind


@pytest.mark.parametrize("action", [0.0, np.zeros(3), np.zeros((4, 1)), [0, np.nan, 0, np.inf]])
def test_action_to_pwm__refuses_wrong_shapes_and_what_is_not_finite(action):
    with pytest.raises(ValueError, match=re.escape("action: expected finite (..., 4), got ")):
        env.action_to_pwm(BROKK_170, action)


# --- observation, one tick ------------------------------------------------------------------------


def test_features__by_hand():
    """Each block of the table: (x - mean) / deviation, in its place."""
    v_goal = np.array([0.3, -0.1, -0.15], np.float32)
    measured = env.measure(BROKK_170, numbered_history(), v_goal)
    obs = env.features(BROKK_170, measured)
    assert obs.shape == (163,) and obs.dtype == np.float32
    v_std, q_dot_std = env.velocity_deviations(BROKK_170)
    np.testing.assert_allclose(obs[:3], v_goal / v_std, rtol=1e-5)
    np.testing.assert_allclose(obs[3:6], measured.v_tool / v_std, rtol=1e-5)
    assert obs[6] == pytest.approx((0.5 - 0.7) * 12**0.5 / 1.4, rel=1e-6)  # q2: 0 .. 1.4
    lag = np.arange(13)
    q1 = (1.5 + 0.01 * (lag - 12)) * 12**0.5 / 4.28
    np.testing.assert_allclose(obs[7:20], q1, rtol=1e-5)
    np.testing.assert_allclose(obs[20:33], 0.001 * lag / q_dot_std[0], rtol=1e-5)
    q3 = (0.58 + 0.01 * (lag - 12) - 0.65) * 12**0.5 / 1.9
    np.testing.assert_allclose(obs[33:46], q3, rtol=1e-4, atol=1e-6)
    q5_dot = (0.08 + 0.001 * lag) / q_dot_std[4]
    np.testing.assert_allclose(obs[98:111], q5_dot, rtol=1e-5)
    for place, joint in ((111, 0), (124, 2), (137, 3), (150, 4)):
        u = (-0.1 * joint + 0.002 * lag) * 127 / 80 / 0.4
        np.testing.assert_allclose(obs[place : place + 13], u, rtol=1e-5, atol=1e-6)


@given(machines(), st.integers(0, 1000))
def test_measure__is_in_physical_units_of_the_base_frame(machine, seed):
    rng = np.random.default_rng(seed)
    low, high = machine.column("q_min")[:, None], machine.column("q_max")[:, None]
    history = rng.normal(0, 0.2, (4, machine.n, 3, machine.history))
    history[..., 0, :] = rng.uniform(low, high, (4, machine.n, 1))
    v_goal = rng.normal(size=(4, 3))
    measured = env.measure(machine, history, v_goal)
    np.testing.assert_array_equal(measured.v_goal, v_goal)
    np.testing.assert_array_equal(measured.history, history[:, machine.driven])
    np.testing.assert_array_equal(measured.q_dot, history[:, machine.driven, 1, -1])
    np.testing.assert_array_equal(measured.q, history[..., 0, -1])
    ahead, behind = (
        tool_position(forward_kinematics(machine, history[..., 0, -1] + s * history[..., 1, -1]))
        for s in (1e-6, -1e-6)  # the locked joints move as well
    )
    np.testing.assert_allclose(measured.v_tool, (ahead - behind) / 2e-6, atol=1e-7)
    size = 6 + len(machine.locked) + 3 * machine.history * len(machine.driven)
    assert env.features(machine, measured).shape == (4, size)
    mean, std, noisy = env.observation_table(machine)
    assert mean.shape == std.shape == noisy.shape == (size,) and (std > 0).all()


def test_velocity_deviations__are_those_of_the_task():
    """Goals by hand: directions have a third of the square, speeds a third, 85 % are not zero.

    Tool and joints as in training: driven by the paper's PID on the plant.
    """
    v_std, q_dot_std = env.velocity_deviations(BROKK_170)
    np.testing.assert_allclose(v_std, 0.3 * (0.85 / 9) ** 0.5, rtol=0.02)
    pid = pids(BROKK_170, small_net(BROKK_170, np.random.default_rng(0)))["jacobian_pid_k0.1"]
    rng, task = default_rng(0), env.Task(BROKK_170, PLANT, TaskConfig(), env.PAPER)
    state, memory = env.reset(task, rng, 64).state, pid.start(64)
    seen = []
    for _ in range(300):
        u, memory = pid(env.measure(BROKK_170, state.history, state.v_goal), memory)
        state = env.transition(BROKK_170, PLANT, state, u)
        state = env.new_goals(task, rng, state)
        seen.append(np.concatenate([state.v_tool, state.q_dot, u], axis=-1))
    found = np.std(seen, axis=(0, 1))
    np.testing.assert_allclose(found[:3], v_std, rtol=0.2)
    np.testing.assert_allclose(found[[3, 5, 6, 7]], q_dot_std[BROKK_170.driven], rtol=0.3)
    np.testing.assert_allclose(found[[8, 10, 11, 12]] * 127 / 80, 0.4, rtol=0.3)


def test_measure__adds_noise_to_what_sensors_measure_in_deviations():
    """Each number of each machine has its own; commands have none."""
    history, size = np.stack([numbered_history()] * 2), env.observation_table(BROKK_170)[2].sum()
    assert size == 3 + 1 + 4 * 2 * 13
    kept, goals = history.copy(), np.zeros((2, 3), np.float32)
    noise = np.random.default_rng(0).uniform(-0.1, 0.1, (2, size)).astype(np.float32)
    clean, noisy = (env.measure(BROKK_170, history, goals, error) for error in (0.0, noise))
    np.testing.assert_array_equal(history, kept)
    change = env.features(BROKK_170, noisy) - env.features(BROKK_170, clean)
    np.testing.assert_allclose(change[:, 6:111], noise[:, 3:], atol=1e-4)
    assert not change[:, :3].any() and not change[:, 111:].any()
    np.testing.assert_array_equal(noisy.q[:, BROKK_170.driven], noisy.history[..., 0, -1])
    exact = tool_velocity(forward_kinematics(BROKK_170, noisy.q), history[..., 1, -1])
    v_error = noise[:, :3] * env.velocity_deviations(BROKK_170)[0]
    np.testing.assert_allclose(noisy.v_tool - exact, v_error, atol=1e-6)


def test_the_table_of_the_docstring__is_true():
    """Numbers, deviations and noise of the table are those of `observation_table`."""
    row = r"^\| (\d+)(?:-(\d+))? +\| .+? +\| (.+?) +\| (\w+) +\|"
    rows = re.findall(row, env.__doc__, re.M)
    assert len(rows) == 5
    (_, std, noisy), place = env.observation_table(BROKK_170), 0
    for first, last, deviation, noise in rows:
        assert int(first) == place
        place = int(last or first) + 1
        assert set(noisy[int(first) : place]) == {noise == "yes"}
        number = re.match(r"0\.\d{3}", deviation)
        assert not number or std[int(first) : place] == pytest.approx(float(number[0]), abs=5e-4)
    assert place == len(std) == 163 and TaskConfig().episode_s == 20
    assert all(text in env.__doc__ for text in ("(163,)", "Box(-1, 1, (4,))", "20 s"))


def test_initial_state__is_at_rest():
    """Two machines with one goal."""
    state = env.initial_state(BROKK_170, [POSE, POSE], [0.1, 0.0, 0.0])
    for name, shape in (("q_dot", (2, 5)), ("v_tool", (2, 3)), ("ticks", (2,))):
        assert np.array_equal(getattr(state, name), np.zeros(shape))
    assert (state.q.shape, state.v_goal.shape, state.goal_ticks.shape) == ((2, 5), (2, 3), (2,))
    assert state.v_goal.dtype == np.float32 and state.ticks.dtype == int


def test_transition__on_a_plant_of_ones_own_by_hand():
    """A plant that obeys the command moves each joint by u x 50 ms; encoders count in steps."""
    u = np.float32([40, 0, -80, 13, 0]) / 127
    pose = POSE - [0, 0, 0.5, 0, 0]  # the tool is the lowest point, 0.2 m above the ground
    state = env.initial_state(BROKK_170, pose, ZERO, Obedient())
    lowest = lowest_point(forward_kinematics(BROKK_170, pose))
    assert state.lowest == pytest.approx(lowest, abs=1e-5)
    assert env.initial_state(BROKK_170, [1] * 5, ZERO).q.dtype == float and state.goal_ticks > 1e9
    after = env.transition(BROKK_170, Obedient(), state, u)
    np.testing.assert_allclose(after.q, pose + 0.05 * u, atol=1e-12)
    np.testing.assert_allclose(after.q_dot, u, atol=1e-12)
    ahead, behind = (
        tool_position(forward_kinematics(BROKK_170, after.q + s * u)) for s in (1e-6, -1e-6)
    )
    np.testing.assert_allclose(after.v_tool, (ahead - behind) / 2e-6, atol=1e-5)
    lowest = lowest_point(forward_kinematics(BROKK_170, after.q))
    np.testing.assert_allclose(after.lowest, lowest, atol=1e-5)
    np.testing.assert_array_equal(after.history[:, 2, -1], u)
    assert not after.history[:, 2, :-1].any()
    step_ = BROKK_170.encoder_step
    before, counts = np.rint(pose / step_), np.rint((pose + 0.05 * u) / step_)
    np.testing.assert_allclose(after.history[:, 0, -1] / step_, counts, atol=1e-3)
    slope = 0.3 * (counts - before) * step_ / 0.05  # weights -3, -1, 1, 3 over 10
    np.testing.assert_allclose(after.history[:, 1, -1], slope, atol=1e-5)
    assert after.ticks == 1 and after.goal_ticks == state.goal_ticks - 1
    for name in ("history", "v_goal", "v_tool", "lowest"):
        assert getattr(after, name).dtype == np.float32, name
    assert after.q.dtype == after.q_dot.dtype == np.float64


# --- episodes -------------------------------------------------------------------------------------


def test_draw_pose__is_uniform_and_sometimes_in_the_ground():
    low, high = BROKK_170.column("q_min"), BROKK_170.column("q_max")
    poses = env.draw_pose(BROKK_170, TaskConfig(), default_rng(0), 2000)
    for fraction in ((poses - low) / (high - low)).T:
        assert stats.kstest(fraction, "uniform").pvalue > 1e-3
    assert 0.02 < (closed_form(poses)[1] < 0).mean() < 0.98


def test_draw_goal__has_the_configured_fractions_speeds_and_directions():
    config = TaskConfig(zero_goals=0.2, axis_goals=0.5)
    goals = env.draw_goal(BROKK_170, config, default_rng(6), 20_000)
    speed = np.linalg.norm(goals, axis=-1)
    components = np.count_nonzero(goals, axis=-1)
    for number, fraction in ((0, 0.2), (1, 0.5), (3, 0.3)):
        assert np.mean(components == number) == pytest.approx(fraction, abs=0.02)
    assert speed.max() <= 0.3 + 1e-12
    assert stats.kstest(speed[components > 0] / 0.3, "uniform").pvalue > 1e-3
    along = np.sign(goals[components == 1])
    for axis in (*np.eye(3), *-np.eye(3)):
        assert np.mean((along == axis).all(-1)) == pytest.approx(1 / 6, abs=0.02)
    directions = goals[components == 3] / speed[components == 3, None]
    moments = directions.T @ directions / len(directions)
    np.testing.assert_allclose(moments, np.eye(3) / 3, atol=0.03)


@pytest.mark.parametrize(
    ("seconds", "ticks"), [(0.0, 1), (0.06, 1), (0.12, 2), (0.13, 3), (0.5, 10)]
)
def test_draw_hold__is_whole_ticks_and_at_least_one(seconds, ticks):
    config = TaskConfig(hold_min_s=seconds, hold_max_s=seconds)
    assert env.draw_hold(BROKK_170, config, default_rng(0), 3).tolist() == [ticks] * 3


def test_draw_noise__is_uniform_up_to_the_largest():
    noise = env.draw_noise(BROKK_170, TaskConfig(), default_rng(0), 400)
    size = env.observation_table(BROKK_170).measured.sum()
    assert noise.dtype == np.float32 and noise.shape == (400, size)
    assert np.abs(noise).max() <= 0.05
    assert stats.kstest(noise[:, 7] / 0.1 + 0.5, "uniform").pvalue > 1e-3
