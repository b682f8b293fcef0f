"""The reward of eq2 and the costs that `step` subtracts, for any machine and velocity."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from scipy.spatial.transform import Rotation
from strategies import machines, reals

from brokk_min.env import TaskConfig, initial_state, reward, step, terminated
from brokk_min.machine import Machine

velocities = npst.arrays(
    np.float64, st.sampled_from([(3,), (4, 3), (2, 3, 3)]), elements=reals(-2, 2)
)
vectors = npst.arrays(np.float64, 3, elements=reals(-2, 2))


@given(velocities, vectors)
def test_reward__is_one_at_the_goal_and_within_0_and_1(v, goal):
    r = reward(goal, v)
    assert r.shape == v.shape[:-1]
    assert np.all((r > 0) & (r <= 1))
    np.testing.assert_array_equal(reward(v, v), np.ones(v.shape[:-1]))


@given(vectors, vectors)
def test_reward__is_eq2(goal, v):
    error = float(np.sqrt(sum((a - b) ** 2 for a, b in zip(goal, v, strict=True))))
    np.testing.assert_allclose(reward(goal, v), 1 / (1 + error), rtol=1e-12)


@given(vectors, vectors, vectors, st.integers(0, 1000))
def test_reward__depends_on_the_length_of_the_error_alone(goal, v, shift, seed):
    """Shifting both velocities, turning both, or exchanging them changes nothing."""
    R = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    for a, b in ((goal + shift, v + shift), (R @ goal, R @ v), (v, goal)):
        np.testing.assert_allclose(reward(a, b), reward(goal, v), atol=1e-12)


@st.composite
def plants_and_actions(draw: st.DrawFn) -> tuple[Machine, np.ndarray, np.ndarray, np.ndarray]:
    """A machine, angles (3, n), goals (3, 3) and actions (3, n_driven)."""
    machine = draw(machines())
    low, high = machine.column("q_min"), machine.column("q_max")
    fraction = draw(npst.arrays(np.float64, (3, machine.n), elements=reals(0, 1)))
    goals = draw(npst.arrays(np.float32, (3, 3), elements=st.floats(-0.5, 0.5, width=32)))
    action = draw(npst.arrays(np.float64, (3, len(machine.driven)), elements=reals(-1.5, 1.5)))
    return machine, low + fraction * (high - low), goals, action


@given(plants_and_actions(), reals(0, 1), reals(0, 5), reals(0, 2))
def test_step__subtracts_its_costs_from_eq2(case, valve_cost, integral_cost, limit_cost):
    """r = 1 / (1 + |e|) - c_v mean |du| / limit - c_i |integral| - c_l sum x^2; 0 in the ground.

    x goes from 0 to 1 in the outer twentieths of a joint's range.
    """
    machine, q, goals, action = case
    config = TaskConfig(valve_cost=valve_cost, integral_cost=integral_cost, limit_cost=limit_cost)
    state = initial_state(machine, q, goals, plant=True)
    after, r, terminated_, truncated, error = step(machine, config, None, state, action)
    change = np.abs(after.history[..., 2, -1] - state.history[..., 2, -1])[:, machine.driven]
    cost = valve_cost * change.mean(-1) / (machine.pwm_limit / 127)
    cost = cost + integral_cost * np.linalg.norm(after.error_integral, axis=-1)
    low, high = machine.column("q_min"), machine.column("q_max")
    inside = (np.minimum(after.q - low, high - after.q) / (high - low))[:, machine.driven]
    cost = cost + limit_cost * np.sum(np.maximum(0, 1 - 20 * inside) ** 2, axis=-1)
    np.testing.assert_allclose(error, np.linalg.norm(goals - after.v_tool, axis=-1), atol=1e-6)
    expected = np.where(terminated_, 0.0, reward(goals, after.v_tool) - cost)
    np.testing.assert_allclose(r, expected, atol=1e-5)
    np.testing.assert_array_equal(terminated_, terminated(machine, after.lowest))
    assert not truncated.any()


@given(plants_and_actions())
def test_step__of_the_paper_has_eq2_alone(case):
    machine, q, goals, action = case
    state = initial_state(machine, q, goals, plant=True)
    after, r, end, _, _ = step(machine, TaskConfig(paper=True), None, state, action)
    np.testing.assert_array_equal(r, np.where(end, 0.0, reward(goals, after.v_tool)))


@given(plants_and_actions())
def test_step__ends_where_a_link_is_in_the_ground_and_truncates_at_the_time_limit(case):
    machine, q, goals, action = case
    config = TaskConfig(episode_s=1.0)
    state = initial_state(machine, q, goals, plant=True)
    state = replace(state, ticks=np.array([0, round(machine.rate) - 1, round(machine.rate)]))
    _, r, end, truncated, _ = step(machine, config, None, state, action)
    assert not np.any(end & truncated)
    np.testing.assert_array_equal(truncated, ~end & np.array([False, True, True]))
    assert np.all(r[end] == 0)
