"""The bound: it simulates the plant exactly, plans with it, and leaves less error than the PIDs."""

import itertools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers_machines import obedient_net

from brokk_min.actuator import plant_reset, plant_step
from brokk_min.env import TaskConfig
from brokk_min.evaluation.baselines import baselines
from brokk_min.evaluation.perfect_model import (
    BLOCKS,
    ROUNDING,
    PerfectModel,
    perfect_models,
    steady_opening,
)
from brokk_min.evaluation.rollout import rollout
from brokk_min.identification.physics import Physics
from brokk_min.kinematics import forward_kinematics, tool_velocity
from brokk_min.machine import BROKK_170, limit_command

POSES = np.array([BROKK_170.q_start, [-0.8, 0.3, 0.9, 1.5, 1.0]])
BOUND = PerfectModel(BROKK_170, POSES)
HORIZON = sum(BLOCKS)


def plant_in_motion(rng):
    """Spools, valve activation and delayed commands matter."""
    plant = plant_reset(BROKK_170, POSES)
    for _ in range(12):
        u = limit_command(BROKK_170, rng.uniform(0.2, 0.6, (2, 5)))
        plant = plant_step(BROKK_170, plant, u)
    return plant


def test_start__takes_any_plant_whose_states_are_tuples():
    physics = replace(BROKK_170, plant=Physics(jitter=0.02))
    model = replace(BOUND, machine=physics)
    errors = model.errors(model.start(2).plant, np.zeros((2, 3, 2, 5)), np.zeros((2, 3)))
    np.testing.assert_allclose(errors, 0, atol=1e-9)
    own = SimpleNamespace(reset=lambda machine, q: SimpleNamespace(q=q), step=None)
    with pytest.raises(ValueError, match=r"^plant: expected states that are tuples, got Simple"):
        replace(BOUND, machine=replace(BROKK_170, plant=own)).start(2)


def test_errors__are_those_that_the_plant_then_has():
    rng = np.random.default_rng(1)
    plant = plant_in_motion(rng)
    u = np.repeat(rng.uniform(-0.6, 0.6, (2, 3, 2, 5)), 3, axis=2)
    goal = rng.uniform(-0.2, 0.2, (2, 3))
    result = BOUND.errors(plant, u, goal)
    assert result.shape == (2, 3, 6, 3)
    for plan in range(3):
        state = plant
        for tick in range(6):
            q_before = state.q
            state = plant_step(BROKK_170, state, u[:, plan, tick])
            v = tool_velocity(forward_kinematics(BROKK_170, state.q), (state.q - q_before) * 20)
            np.testing.assert_allclose(result[:, plan, tick], goal - v, atol=1e-5)


def test_improve__lowers_the_cost_of_a_plan_within_the_command_limit():
    rng = np.random.default_rng(2)
    plant = plant_reset(BROKK_170, POSES)
    goal = rng.uniform(-0.2, 0.2, (2, 3))

    def cost(opening):
        errors = BOUND.errors(plant, BOUND.commands(opening, 0)[:, None], goal)
        return np.linalg.norm(errors, axis=-1).mean(axis=(1, 2))

    steady = np.repeat(steady_opening(BROKK_170, POSES, goal)[:, None], HORIZON, axis=1)
    assert (cost(BOUND.improve(plant, steady, goal, 0)) < 0.925 * cost(steady)).all()
    plan = rng.uniform(-0.3, 0.3, (2, HORIZON, 4))
    costs = [cost(plan)]
    for _ in range(3):
        plan = BOUND.improve(plant, plan, goal, 0)
        costs.append(cost(plan))
    assert (np.diff(costs, axis=0) < 1e-4).all()
    assert (costs[-1] < 0.8 * costs[0]).all()
    limit = (80 / 127 - BROKK_170.dead_zone) / (1 - BROKK_170.dead_zone)
    assert np.abs(BOUND.improve(plant, plan, 9 * goal, 0)).max() == pytest.approx(limit)


def test_quantise__takes_the_best_of_all_roundings():
    rng = np.random.default_rng(3)
    plant = plant_in_motion(rng)
    goal = rng.uniform(-0.2, 0.2, (2, 3))
    opening = rng.uniform(-0.3, 0.3, (2, HORIZON, 4))
    u = np.repeat(BOUND.commands(opening[:, :ROUNDING], 5)[:, None], 16, axis=1)
    for plan, roundings in enumerate(itertools.product((np.floor, np.ceil), repeat=4)):
        for joint, rounding in zip(BROKK_170.driven, roundings, strict=True):
            u[:, plan, 0, joint] = rounding(u[:, plan, 0, joint] * 127) / 127
    cost = np.linalg.norm(BOUND.errors(plant, u, goal), axis=-1).mean(axis=2)
    assert (np.ptp(cost, axis=1) > 0).all()
    expected = [u[row, cost[row].argmin(), 0] for row in (0, 1)]
    np.testing.assert_allclose(BOUND.quantise(plant, opening, goal, 5), expected, atol=1e-9)


def test_commands__alternate_about_openings_near_zero():
    """By the dither of 0.04, less half the opening; from 0.08 on not at all."""
    u = BOUND.commands(np.tile([0.0, 0.04, 0.08, -0.3], (4, 1)), 3)
    assert not u[:, BROKK_170.locked].any()
    u = u[:, BROKK_170.driven]
    result = np.sign(u) * (np.abs(u) - BROKK_170.dead_zone) / (1 - BROKK_170.dead_zone)
    expected = [[-0.04, 0.02, 0.08, -0.3], [0.04, 0.06, 0.08, -0.3]]
    np.testing.assert_allclose(result, expected * 2, atol=1e-8)


def test_perfect_model__leaves_less_error_than_a_pid():
    goals = np.zeros((42, 2, 3))
    goals[12:32, :, 2] = 0.15
    goals[32:, :, 1] = -0.1
    pid = baselines(BROKK_170, obedient_net(BROKK_170))["jacobian_pid_k0.1"]
    controllers = {**perfect_models(BROKK_170, POSES), "pid": pid}
    with pytest.raises(ValueError, match=r"^poses: expected those .*, 0\.30 rad off"):
        elsewhere = POSES - [0, 0, 0.3, 0, 0]
        model = controllers["perfect_model"]
        rollout(BROKK_170, model, elsewhere, goals, TaskConfig(), np.random.default_rng(0))
    errors = {}
    for name, controller in controllers.items():
        rng = np.random.default_rng(0)
        trace = rollout(BROKK_170, controller, POSES, goals, TaskConfig(), rng)
        errors[name] = np.linalg.norm(goals - trace.v_tool, axis=-1)
        counts = trace.u * 127
        np.testing.assert_allclose(counts, np.rint(counts), atol=1e-9)
        assert np.abs(counts).max() <= 80 and not trace.u[..., BROKK_170.locked].any()
    assert errors["perfect_model"].mean() < 0.7 * errors["pid"].mean()
    assert errors["perfect_model"][24:32].mean() < 0.006
    assert errors["perfect_model"].mean() < errors["perfect_model_closed"].mean()
