"""The reward of eq2, the ground, the time limit and what agents remember, for any machine."""

import math
from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from strategies import machines, posed, reals

from brokk_min import env
from brokk_min.actuator import PLANT
from brokk_min.beyond.interface import INTERFACE, Memory
from brokk_min.env import PAPER, initial_state, reward, terminated
from brokk_min.kinematics import forward_kinematics, lowest_point
from brokk_min.machine import Machine, Measured, limit_command
from brokk_min.settings import TaskConfig

velocities = npst.arrays(
    np.float64, st.sampled_from([(3,), (4, 3), (2, 3, 3)]), elements=reals(-2, 2)
)
vectors = npst.arrays(np.float64, 3, elements=reals(-2, 2))


@given(velocities, vectors)
def test_reward__is_eq2(v, goal):
    r = reward(goal, v)
    assert r.shape == v.shape[:-1]
    for i in np.ndindex(r.shape):
        error = math.sqrt(sum((a - b) ** 2 for a, b in zip(goal, v[i], strict=True)))
        np.testing.assert_allclose(r[i], 1 / (1 + error), rtol=1e-12)
    np.testing.assert_array_equal(reward(v, v), np.ones(v.shape[:-1]))


class Direct(env.Interface):
    """An agent whose actions are the commands."""

    def command(self, machine, action, memory):
        return action


def one_tick(machine, config, state, u):
    """State, reward, terminated, truncated after a tick without noise."""
    task = env.Task(machine, PLANT, replace(config, noise=0.0), Direct())
    now = env.Episodes(state, None, np.zeros(0))
    after, r, end, truncated, _ = env.tick(task, np.random.default_rng(0), now, u)
    return after.state, r, end, truncated


# --- one tick -------------------------------------------------------------------------------------


@st.composite
def ticks(draw: st.DrawFn) -> tuple[Machine, np.ndarray, np.ndarray, np.ndarray]:
    """A machine, angles (3, n), goals (3, 3) and commands (3, n)."""
    machine, q = draw(posed(shapes=[(3,)]))
    goals = draw(npst.arrays(np.float32, (3, 3), elements=st.floats(-0.5, 0.5, width=32)))
    u = draw(npst.arrays(np.float64, (3, machine.n), elements=reals(-1.5, 1.5)))
    return machine, q, goals, limit_command(machine, u)


@given(ticks())
def test_step__pays_eq2_of_the_true_velocity_and_nothing_in_the_ground(case):
    """The velocity is that of differences of the pose over the tick, whatever the encoders say."""
    machine, q, goals, u = case
    state = initial_state(machine, q, goals)
    state = state._replace(plant=state.plant._replace(v=np.ones_like(q)))  # in full motion
    for given_array in (*state, *state.plant, u):
        if isinstance(given_array, np.ndarray):
            given_array.setflags(write=False)  # a write in place would raise
    after, r, end, truncated = one_tick(machine, TaskConfig(), state, u)
    q_dot = (after.q - q) * machine.rate
    tools = [forward_kinematics(machine, after.q + s * 1e-6 * q_dot).p[:, -1] for s in (1, -1)]
    error = np.linalg.norm(goals - (tools[0] - tools[1]) / 2e-6, axis=-1)
    np.testing.assert_allclose(r, np.where(end, 0.0, 1 / (1 + error)), atol=1e-4)
    assert not truncated.any()


@given(posed(shapes=[(5,)]), reals(-2, 2))
def test_terminated__where_any_link_end_is_below_the_ground(case, ground):
    machine, q = case
    machine = replace(machine, ground=ground)
    frames = forward_kinematics(machine, q)
    below = [any(p[2] < ground for p in arm[1:]) for arm in frames.p]
    assert terminated(machine, lowest_point(frames)).tolist() == below
    assert not terminated(machine, np.array(ground))


@given(ticks())
def test_step__ends_a_start_in_the_ground_and_truncates_at_the_time_limit(case):
    """Only an episode that begins in the ground ends there; later the arm may dig."""
    machine, q, goals, u = case
    second = round(machine.rate)
    state = initial_state(machine, q, goals)
    for before, limit in ((0, 1), (0, second), (1, second), (second - 1, second), (second, second)):
        config = TaskConfig(episode_s=limit / machine.rate)
        now = state._replace(ticks=np.full(3, before))
        after, r, end, truncated = one_tick(machine, config, now, u)
        ground = forward_kinematics(machine, after.q).p[:, 1:, 2].min(axis=-1) - machine.ground
        sure = np.abs(ground) > 1e-5  # single precision
        assert np.array_equal(end[sure], (ground < 0)[sure] & (before == 0))
        assert np.array_equal(truncated, ~end & (before + 1 >= limit))
        assert np.all((r == 0) == end)


# --- what agents remember -------------------------------------------------------------------------


@st.composite
def heard(draw: st.DrawFn) -> tuple[Machine, np.ndarray, np.ndarray]:
    """A machine, goals and measured velocities (T, 2, 3); zero goals are frequent."""
    machine = draw(machines())
    shape = (draw(st.integers(1, 12)), 2, 3)
    speed = st.sampled_from([0.0, 0.005, 0.3]).flatmap(lambda most: reals(-most, most))
    goals = draw(npst.arrays(np.float64, shape, elements=speed))
    rests = draw(npst.arrays(np.bool_, shape[:2]))
    v_tool = draw(npst.arrays(np.float64, shape, elements=speed))
    return machine, goals * ~rests[..., None], v_tool


def measured(machine: Machine, v_goal: np.ndarray, v_tool: np.ndarray) -> Measured:
    """Measurements of two machines at rest at q = 0 that hear `v_goal` and see `v_tool`."""
    history = np.zeros((2, len(machine.driven), 3, machine.history))
    return Measured(v_goal, v_tool, np.zeros((2, machine.n)), history[:, :, 1, -1], history)


@given(heard())
def test_memory__of_our_agent_is_a_sum_of_cut_errors_that_fade_in_four_seconds(case):
    """I_t = sum_k exp(-(t - k) dt / 4 s) dt cut(v_goal of k - v_tool of k + 1), one by one.

    The cut leaves 2 % of the tool speed along the goal, and 7 % across it.
    """
    machine, goals, v_tool = case
    memory = None
    for t in range(len(goals)):
        memory = INTERFACE.remember(machine, memory, measured(machine, goals[t], v_tool[t]))
        for i in range(2):
            expected = np.zeros(3)
            for k in range(t):
                e = goals[k, i] - v_tool[k + 1, i]
                d = goals[k, i] / max(math.hypot(*goals[k, i]), 1e-6)
                along, across = float(e @ d), e - (e @ d) * d
                along = math.copysign(min(abs(along), 0.02 * machine.tool_speed), along)
                size, limit = math.hypot(*across), 0.07 * machine.tool_speed
                across = across * limit / size if size > limit else across
                fade = math.exp(-(t - k) / machine.rate / 4.0) / machine.rate
                expected += fade * (along * d + across)
            np.testing.assert_allclose(memory.error_integral[i], expected, atol=1e-8)
            moves = np.flatnonzero(goals[: t + 1, i].any(axis=1))
            assert memory.rest_ticks[i] == t - max(moves, default=-1)


@given(machines(), st.integers(0, 1000))
def test_cost__of_our_agent_is_of_commands_valve_travel_and_error_integral(machine, seed):
    rng = np.random.default_rng(seed)
    u, before = rng.uniform(-1, 1, (2, 2, machine.n))
    memory = Memory(None, None, rng.normal(0, 0.03, (2, 3)), None, None)
    found = INTERFACE.cost(machine, u, before, memory)
    for i in range(2):
        changes = [abs(u[i, j] - before[i, j]) * 127 / machine.pwm_limit for j in machine.driven]
        squares = [(u[i, j] * 127 / machine.pwm_limit) ** 2 for j in machine.driven]
        expected = (0.1 * sum(changes) + 0.03 * sum(squares)) / len(machine.driven)
        expected += 3.0 * math.hypot(*memory.error_integral[i])
        np.testing.assert_allclose(found[i], expected, atol=1e-7)
    assert PAPER.cost(machine, u, before, None) == 0
