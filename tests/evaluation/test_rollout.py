"""Rollouts: what a controller gets, what moves the machine, and what is recorded when."""

import numpy as np
import pytest
from helpers_machines import closed_form, small_net

from brokk_min.actuator import PLANT
from brokk_min.env import velocity_deviations
from brokk_min.evaluation.rollout import rollout
from brokk_min.machine import BROKK_170, limit_command, read_encoder

RNG = np.random.default_rng(20)
START = np.array([BROKK_170.q_start, np.add(BROKK_170.q_start, 0.1)])


class Playback:
    """Sends given commands (T, num, n) and keeps what it measured."""

    def __init__(self, commands):
        self.commands = commands
        self.measured = []

    def start(self, num):
        return None

    def __call__(self, measured, state):
        self.measured.append(measured)
        return self.commands[len(self.measured) - 1], None


@pytest.mark.parametrize(
    ("plant", "exact", "curved"), [(PLANT, 1e-12, 0.01), (small_net(BROKK_170, RNG), 1e-6, 0.02)]
)
def test_rollout__records_each_tick_of_the_plant(plant, exact, curved):
    rng = np.random.default_rng(19)
    controller = Playback(limit_command(BROKK_170, rng.uniform(-1, 1, (40, 2, 5))))
    goals = np.repeat(rng.uniform(-0.3, 0.3, (4, 2, 3)), 10, axis=0)
    trace = rollout(BROKK_170, controller, START, goals, 0.0, rng, plant)
    state = plant.reset(BROKK_170, START)
    for t in range(40):
        measured = controller.measured[t]
        np.testing.assert_allclose(measured.v_goal, goals[t], atol=1e-6)
        np.testing.assert_allclose(measured.q, read_encoder(BROKK_170, state.q), atol=1e-6)
        q_before = state.q
        state = plant.step(BROKK_170, state, controller.commands[t])
        np.testing.assert_allclose(trace.q[t], state.q, atol=exact)
        np.testing.assert_allclose(trace.q_dot[t], (state.q - q_before) * 20, atol=100 * exact)
        np.testing.assert_allclose(trace.p_tool[t], closed_form(state.q)[0], atol=exact)
    np.testing.assert_array_equal(trace.u, controller.commands)
    moved = np.diff(trace.p_tool, axis=0)[20:] * 20
    np.testing.assert_allclose(moved, trace.v_tool[21:], atol=curved)
    assert np.abs(trace.q[-1] - START).max() > 0.01


def test_rollout__has_noise_of_the_sensors_in_deviations():
    """5 % of a deviation of the task, in what is measured alone."""
    controller, goals = Playback(np.zeros((50, 2, 5))), np.zeros((50, 2, 3))
    trace = rollout(BROKK_170, controller, START, goals, 0.05, np.random.default_rng(0))
    np.testing.assert_array_equal(trace.q, np.tile(START, (50, 1, 1)))
    off = np.abs([measured.v_tool for measured in controller.measured]).max()
    largest = 0.05 * velocity_deviations(BROKK_170)[0].max()
    assert 0.9 * largest < off <= largest + 1e-7
