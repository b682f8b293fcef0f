"""The bound: it knows the plant exactly, plans with it, and leaves less error than the classical way."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from helpers_machines import obedient_net

from brokk_min.actuator import plant_reset, plant_step
from brokk_min.env import TaskConfig, initial_state, observe
from brokk_min.evaluation import baselines
from brokk_min.evaluation import perfect_model as mpc
from brokk_min.evaluation.rollout import rollout
from brokk_min.kinematics import forward_kinematics, tool_velocity
from brokk_min.machine import BROKK_170, limit_command

POSES = np.array([[1.5, 0.5, 0.58, 1.71, 1.24], [-0.8, 0.3, 0.9, 1.5, 1.0]])


def test_predicted_errors_are_what_the_plant_then_does() -> None:
    rng = np.random.default_rng(1)
    bound = mpc.PerfectModel(BROKK_170, POSES)
    plant = plant_reset(BROKK_170, POSES)
    for _ in range(8):  # into motion, so that spools, readiness and delayed commands matter
        plant = plant_step(
            BROKK_170, plant, limit_command(BROKK_170, rng.uniform(-0.6, 0.6, (2, 5)))
        )
    u = np.repeat(rng.uniform(-0.6, 0.6, (2, 3, 2, 5)), 3, axis=2)
    goal = rng.uniform(-0.2, 0.2, (2, 3))
    found = bound.errors(plant, u, goal)
    assert found.shape == (2, 3, 6, 3)
    for candidate in range(3):
        state = plant
        for tick in range(6):
            before, state = state.q, plant_step(BROKK_170, state, u[:, candidate, tick])
            v = tool_velocity(forward_kinematics(BROKK_170, state.q), (state.q - before) * 20)
            np.testing.assert_allclose(found[:, candidate, tick], goal - v, atol=1e-5)


def test_a_steady_opening_moves_the_tool_at_the_goal() -> None:
    goal = np.array([[0.05, -0.1, 0.02], [0.0, 0.05, -0.08]])
    bound, plant = mpc.PerfectModel(BROKK_170, POSES, dither=0.0), plant_reset(BROKK_170, POSES)
    u = bound.commands(mpc.steady_opening(BROKK_170, POSES, goal)[:, None], 0)[:, 0]
    for _ in range(20):
        before, plant = plant.q, plant_step(BROKK_170, plant, u)
    v = tool_velocity(forward_kinematics(BROKK_170, plant.q), (plant.q - before) * 20)
    np.testing.assert_allclose(v, goal, atol=0.02)  # the arm has moved on meanwhile


def test_a_step_never_makes_the_plan_worse() -> None:
    rng = np.random.default_rng(2)
    bound, plant = mpc.PerfectModel(BROKK_170, POSES), plant_reset(BROKK_170, POSES)
    goal = rng.uniform(-0.2, 0.2, (2, 3))
    plan = rng.uniform(-0.3, 0.3, (2, sum(mpc.BLOCKS), 4))

    def cost(opening: np.ndarray) -> np.ndarray:
        errors = bound.errors(plant, bound.commands(opening, 0)[:, None], goal)
        return np.linalg.norm(errors, axis=-1).mean(axis=(1, 2))

    steady = np.repeat(mpc.steady_opening(BROKK_170, POSES, goal)[:, None], sum(mpc.BLOCKS), axis=1)
    assert (cost(bound.improve(plant, steady, goal, 0)) < 0.925 * cost(steady)).all()
    costs = [cost(plan)]
    for _ in range(3):
        plan = bound.improve(plant, plan, goal, 0)
        costs.append(cost(plan))
    assert (np.diff(costs, axis=0) < 1e-4).all()
    assert (costs[-1] < 0.8 * costs[0]).all()
    room = (80 / 127 - BROKK_170.dead_zone) / (1 - BROKK_170.dead_zone)
    assert np.abs(bound.improve(plant, plan, 9 * goal, 0)).max() == pytest.approx(
        room
    )  # no further


def test_commands_are_rounded_in_the_best_of_all_ways() -> None:
    rng = np.random.default_rng(3)
    bound, plant = mpc.PerfectModel(BROKK_170, POSES), plant_reset(BROKK_170, POSES)
    for _ in range(12):  # valves at rest do not answer
        plant = plant_step(BROKK_170, plant, limit_command(BROKK_170, np.full((2, 5), 0.3)))
    goal, opening = rng.uniform(-0.2, 0.2, (2, 3)), rng.uniform(-0.3, 0.3, (2, sum(mpc.BLOCKS), 4))
    u = np.repeat(bound.commands(opening[:, : mpc.ROUNDING], 5)[:, None], 16, axis=1)
    for k, ways in enumerate(itertools.product((np.floor, np.ceil), repeat=4)):
        for joint, way in zip(BROKK_170.driven, ways, strict=True):
            u[:, k, 0, joint] = way(u[:, k, 0, joint] * 127) / 127
    cost = np.linalg.norm(bound.errors(plant, u, goal), axis=-1).mean(axis=2)
    assert (np.ptp(cost, axis=1) > 0).all()
    found = bound.quantise(plant, opening, goal, 5)
    np.testing.assert_allclose(found, [u[row, cost[row].argmin(), 0] for row in (0, 1)], atol=1e-9)


def test_a_valve_that_is_hardly_open_goes_to_and_fro() -> None:
    bound, opening = mpc.PerfectModel(BROKK_170, POSES), np.tile([0.0, 0.04, 0.08, -0.3], (4, 1))
    u = bound.commands(opening, 3)[:, BROKK_170.driven]
    found = np.sign(u) * (np.abs(u) - BROKK_170.dead_zone) / (1 - BROKK_170.dead_zone)
    wanted = [[-0.04, 0.02, 0.08, -0.3], [0.04, 0.06, 0.08, -0.3]]  # by 0.04 less half the opening
    np.testing.assert_allclose(found, wanted * 2, atol=1e-8)


def test_a_plan_begins_at_rest_and_goes_on_tick_by_tick() -> None:
    bound, goals = mpc.PerfectModel(BROKK_170, POSES), np.full((4, 3), 0.1)
    memory = bound.start(4)
    np.testing.assert_array_equal(memory.plant.q, np.concatenate([POSES, POSES]))
    assert memory.tick == 0 and not memory.opening.any()
    state = initial_state(BROKK_170, memory.plant.q, goals, plant=True)
    _, after = bound(observe(BROKK_170, state.history, goals, state.lag), memory)
    assert after.tick == 1 and after.opening.shape == memory.opening.shape


def test_the_bound_leaves_less_error_than_the_baselines() -> None:
    goals = np.zeros((50, 2, 3))
    goals[10:30, :, 2], goals[30:, :, 1] = 0.15, -0.1
    errors = {}
    baseline = baselines.baselines(BROKK_170, obedient_net(BROKK_170))["jacobian_pid_k0.1"]
    for name, controller in {
        "bound": mpc.PerfectModel(BROKK_170, POSES),
        "baseline": baseline,
    }.items():
        trace = rollout(BROKK_170, controller, POSES, goals, TaskConfig(), np.random.default_rng(0))
        errors[name] = np.linalg.norm(goals - trace.v_tool, axis=-1)
        counts = trace.u * 127
        np.testing.assert_allclose(counts, np.rint(counts), atol=1e-9)
        assert np.abs(counts).max() <= 80 and not trace.u[..., BROKK_170.locked].any()
    assert errors["bound"].mean() < 0.7 * errors["baseline"].mean()
    assert errors["bound"][22:30].mean() < 0.006


def test_a_batch_that_is_no_multiple_of_the_poses_is_refused() -> None:
    with pytest.raises(ValueError, match="poses: expected 3 or a part of it, got 2"):
        mpc.PerfectModel(BROKK_170, POSES).start(3)
