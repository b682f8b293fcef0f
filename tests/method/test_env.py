"""The task: rewards and observations by hand, episodes against replays, refusals."""

from __future__ import annotations

import platform
import resource
import warnings
from collections import deque
from dataclasses import fields, replace

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from helpers_machines import (
    POSE,
    RowRandom,
    closed_form,
    obedient_net,
    obedient_velocity,
    parts,
    random_machine,
    small_net,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import stats

from brokk_min import env as task
from brokk_min import kinematics
from brokk_min import observation as sight
from brokk_min.actuator import plant_reset, plant_step
from brokk_min.env import TaskConfig
from brokk_min.identification.net_file import save_net
from brokk_min.jacobian import GAINS, JacobianController, join_gains
from brokk_min.learning.gym_env import TaskEnv, TaskVectorEnv
from brokk_min.machine import BROKK_170, estimate_velocity, read_encoder

FINE = replace(BROKK_170, encoder_bits=32)  # so fine that float32 rounding cannot flip a count
LOW = replace(BROKK_170, ground=-100.0)  # no pose is in the ground
OLD, NEW = slice(7, 19), slice(8, 20)  # q1's angles in the observation, oldest to newest
QUIET = TaskConfig(noise=0.0)
MACHINES = [random_machine(np.random.default_rng(seed), 2 + seed % 5) for seed in range(10)]


def flat(state):
    """All arrays of a state, the plant's included."""
    found = [getattr(state, f.name) for f in fields(state) if f.name != "plant"]
    if state.plant is not None:
        found += [*state.plant[:-1], *state.plant.pending]
    return found


def same(a, b, rows=slice(None)):
    return all(np.array_equal(x[rows], y[rows]) for x, y in zip(flat(a), flat(b), strict=True))


# --- the reward -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("v_goal", "v_tool", "wanted"),
    [
        ((0.3, 0.4, 0.0), (0.0, 0.0, 0.0), 1 / 1.5),
        ((0.0, 0.0, 0.0), (0.0, 0.0, -0.25), 0.8),
        ((0.1, 0.2, 0.3), (1.1, -1.8, 2.3), 0.25),  # error (1, 2, 2) has length 3
        ((0.1, -0.2, 0.3), (0.1, -0.2, 0.3), 1.0),
    ],
)
def test_reward_by_hand(v_goal, v_tool, wanted):
    assert task.reward(np.array(v_goal), np.array(v_tool)) == pytest.approx(wanted, abs=1e-12)


vectors = arrays(float, (7, 3), elements=st.floats(-10, 10, width=32))


@settings(deadline=None, max_examples=50)
@given(vectors, vectors, st.floats(1.01, 5))
def test_reward_is_bounded_symmetric_and_falls_with_the_error(v_goal, v_tool, factor):
    reward = task.reward(v_goal, v_tool)
    assert ((reward > 0) & (reward <= 1)).all()
    assert np.array_equal(reward, task.reward(v_tool, v_goal))
    further = task.reward(v_goal, v_goal + factor * (v_tool - v_goal))
    apart = np.linalg.norm(v_goal - v_tool, axis=-1) > 1e-6
    assert (further[apart] < reward[apart]).all()
    np.testing.assert_allclose(1 / reward - 1, np.linalg.norm(v_goal - v_tool, axis=-1), atol=1e-9)


def test_ground_is_below_not_at():
    low = np.array([-1e-6, 0.0, 1e-6]) + BROKK_170.ground
    assert task.terminated(BROKK_170, low).tolist() == [True, False, False]
    raised = replace(BROKK_170, ground=0.5)
    assert task.terminated(raised, np.array([0.49, 0.51])).tolist() == [True, False]


# --- poses and goals ------------------------------------------------------------------------------


def test_redrawn_poses_are_off_the_ground_and_the_papers_are_not():
    low, high = BROKK_170.column("q_min"), BROKK_170.column("q_max")
    free = task.draw_pose(BROKK_170, TaskConfig(), np.random.default_rng(5), 2000)
    raw = task.draw_pose(BROKK_170, TaskConfig(redraw_ground=False), np.random.default_rng(5), 2000)
    assert (closed_form(free)[1] >= 0).all()
    buried = closed_form(raw)[1] < 0
    assert 0.02 < buried.mean() < 0.9
    for q in (free, raw):
        assert ((q >= low) & (q <= high)).all()
    assert np.array_equal(free[~buried], raw[~buried])  # only the bad ones are drawn again
    assert len(np.unique(free, axis=0)) == 2000  # each for itself
    assert stats.kstest((raw[:, 0] + 2.14) / 4.28, "uniform").pvalue > 1e-3


def test_a_machine_that_is_always_buried_is_refused():
    with pytest.raises(ValueError, match="brokk170: expected a pose above the ground, got none"):
        machine = replace(BROKK_170, ground=50.0)
        task.draw_pose(machine, TaskConfig(), np.random.default_rng(0), 3)


def test_goals_have_the_configured_shares_speeds_and_directions():
    config = TaskConfig(zero_goals=0.2, axis_goals=0.5)
    goals = task.draw_goal(BROKK_170, config, np.random.default_rng(6), 20_000)
    speed, moves = np.linalg.norm(goals, axis=-1), np.count_nonzero(goals, axis=-1)
    assert np.mean(moves == 0) == pytest.approx(0.2, abs=0.02)
    assert np.mean(moves == 1) == pytest.approx(0.5, abs=0.02)
    assert np.mean(moves == 3) == pytest.approx(0.3, abs=0.02)
    assert speed.max() <= 0.3 + 1e-12
    assert stats.kstest(speed[moves > 0] / 0.3, "uniform").pvalue > 1e-3
    along = np.sign(goals[moves == 1])
    shares = [np.mean((along == axis).all(-1)) for axis in (*np.eye(3), *-np.eye(3))]
    np.testing.assert_allclose(shares, 1 / 6, atol=0.02)
    anywhere = goals[moves == 3] / speed[moves == 3, None]
    np.testing.assert_allclose(anywhere.mean(axis=0), 0, atol=0.03)
    np.testing.assert_allclose(anywhere.T @ anywhere / len(anywhere), np.eye(3) / 3, atol=0.03)


def test_the_locked_joint_differs_between_resets():
    env = TaskVectorEnv(64)
    env.reset(seed=0)
    first = env.state.q[:, 1].copy()
    env.reset()
    assert len(np.unique(first)) > 60
    assert len(np.unique(np.concatenate([first, env.state.q[:, 1]]))) > 120
    assert first.min() < 0.2 < 1.2 < first.max()


def test_a_reset_is_at_rest_and_tells_its_pose():
    env = TaskVectorEnv(5, config=QUIET)
    seen, _ = env.reset(seed=1)
    body, _, late = parts(BROKK_170, seen)[3:]
    assert (body[:, :, 0] == body[:, :, :1, 0]).all()
    assert not body[:, :, 1:].any() and not late.any() and not env.state.lag.any()
    found = sight.measured(BROKK_170, seen)
    np.testing.assert_allclose(found.q, env.state.q, atol=BROKK_170.encoder_step / 2 + 1e-6)
    np.testing.assert_allclose(found.v_goal, env.state.v_goal, atol=1e-6)


def test_no_goal_asks_an_arm_close_to_the_ground_to_sink():
    pose = np.array([[0.3, 0.2, 0.3, 1.4, 1.1]])
    config = replace(QUIET, hold_min_s=5.0, hold_max_s=5.0)
    lowest = kinematics.lowest_point(kinematics.forward_kinematics(BROKK_170, pose))[0]
    for near in (True, False):
        machine = replace(
            BROKK_170, ground=float(lowest - (0.9 if near else 1.1) * task.GROUND_MARGIN)
        )
        rng = np.random.default_rng(1)
        for _ in range(20):
            state = task.initial_state(machine, pose, [[0.1, 0.0, -0.2]], plant=True)
            state, _ = task.step(machine, config, None, state, np.zeros((1, 4)), rng)
            changed = (state.v_goal != np.float32([[0.1, 0.0, -0.2]])).any()
            assert changed == near and (state.v_goal[0, 2] >= 0) == near
            assert not near or state.goal_ticks[0] == 100
        for upward in (0.0, 0.2):  # to move level or up is no sinking
            state = task.initial_state(machine, pose, [[0.1, 0.0, upward]], plant=True)
            state, _ = task.step(machine, config, None, state, np.zeros((1, 4)), rng)
            np.testing.assert_array_equal(state.v_goal, np.float32([[0.1, 0.0, upward]]))


def test_a_goal_holds_for_whole_ticks_and_at_least_one():
    for seconds, ticks in ((0.0, 1), (0.06, 1), (0.12, 2), (0.13, 3), (0.5, 10)):
        config = TaskConfig(hold_min_s=seconds, hold_max_s=seconds)
        held = task.reset(BROKK_170, config, np.random.default_rng(0), 3, plant=False).goal_ticks
        assert held.dtype == np.int64 and held.tolist() == [ticks] * 3


def test_goals_are_redrawn_within_an_episode_and_rewards_are_for_the_old_goal():
    config = TaskConfig(
        hold_min_s=0.2,
        hold_max_s=0.5,
        zero_goals=0.0,
        episode_s=60.0,
        noise=0.0,
        valve_cost=0.02,
        integral_cost=3.0,
    )
    env = TaskVectorEnv(4, machine=LOW, config=config)
    seen, _ = env.reset(seed=2)
    goals, rng = [env.state.v_goal], np.random.default_rng(0)
    for _ in range(200):
        before = env.state.v_goal
        shown = sight.measured(LOW, seen).v_goal
        np.testing.assert_allclose(
            shown, before, atol=1e-6
        )  # the policy saw the goal it is paid for
        sent = env.state.history[:, LOW.driven, 2, -1]
        seen, reward, *_, info = env.step(rng.uniform(-1, 1, (4, 4)).astype(np.float32))
        travel = np.abs(env.state.history[:, LOW.driven, 2, -1] - sent).mean(-1) * 127 / 80
        state, step = env.state, 1e-6
        towards = step * state.q_dot
        v_tool = (closed_form(state.q + towards)[0] - closed_form(state.q - towards)[0]) / (
            2 * step
        )
        error = np.linalg.norm(before - v_tool, axis=-1)
        cost = 0.02 * travel + 3 * np.linalg.norm(state.lag, axis=-1)
        np.testing.assert_allclose(reward, 1 / (1 + error) - cost, atol=1e-5)
        np.testing.assert_allclose(info["velocity_error"], error, atol=1e-5)
        goals.append(state.v_goal)
    for row in range(4):
        changes = np.flatnonzero(np.any(np.diff([g[row] for g in goals], axis=0) != 0, axis=-1))
        held = np.diff(changes)
        assert len(held) > 15
        assert held.min() >= 4  # 0.2 s
        assert held.max() <= 10  # 0.5 s
        assert changes[0] + 1 <= 10


# --- one tick -------------------------------------------------------------------------------------


def test_transition_on_nets_by_hand():
    """With nets that obey the command, one tick moves each driven joint by velocity x 50 ms."""
    u = np.array([40, 0, -80, 13, 0]) / 127
    state = task.initial_state(BROKK_170, POSE, np.zeros(3), plant=False)
    after = task.transition(BROKK_170, obedient_net(BROKK_170), state, u)
    move = np.zeros(5)
    move[[0, 2, 3, 4]] = obedient_velocity(BROKK_170, u[[0, 2, 3, 4]])
    assert move[0] == pytest.approx(0.24 * np.tanh(1.5 * 40 / 127), rel=1e-9)
    np.testing.assert_allclose(after.q, POSE + 0.05 * move, atol=1e-8)
    np.testing.assert_allclose(after.q_dot, move, atol=2e-7)
    assert after.q.dtype == after.q_dot.dtype == np.float64
    assert np.array_equal(after.history[:, 2, -1], u.astype(np.float32))
    assert not after.history[:, 2, :-1].any()
    counts = np.rint((POSE + 0.05 * move) / BROKK_170.encoder_step)
    np.testing.assert_allclose(after.history[:, 0, -1] / BROKK_170.encoder_step, counts, atol=1e-3)
    before = np.rint(POSE / BROKK_170.encoder_step)
    slope = 0.3 * (counts - before) * BROKK_170.encoder_step / 0.05  # weights -3, -1, 1, 3 over 10
    np.testing.assert_allclose(after.history[:, 1, -1], slope, atol=1e-5)


def test_what_encoders_say_moves_no_simulated_arm():
    net, rng = small_net(BROKK_170, np.random.default_rng(5)), np.random.default_rng(6)
    right = wrong = task.initial_state(BROKK_170, POSE, np.zeros(3), plant=False)
    for _ in range(20):
        u = sight.action_to_pwm(BROKK_170, rng.uniform(-1, 1, 4))
        right = task.transition(BROKK_170, net, right, u)
        wrong = task.transition(
            BROKK_170, net, wrong, u, lambda _, q: q + rng.normal(0, 0.1, q.shape)
        )
        np.testing.assert_array_equal(wrong.q, right.q)
        np.testing.assert_array_equal(right.motion[:, 0, -1], right.q.astype(np.float32))
    assert np.abs(wrong.history - right.history).max() > 0.1 and np.abs(right.q - POSE).max() > 0.01


def test_nets_in_the_loop_agree_with_plain_loops():
    """An oracle with deques, `polyfit` and one matrix product a joint, over 60 ticks."""
    machine, rng = FINE, np.random.default_rng(7)
    net = small_net(machine, rng)
    state = task.initial_state(machine, POSE, np.zeros(3), plant=False)
    q = POSE.copy()
    tape = {j: [deque([v] * 13, 13) for v in (q[j], 0.0, 0.0)] for j in (0, 2, 3, 4)}
    for _ in range(60):
        u = sight.action_to_pwm(machine, rng.uniform(-1, 1, 4))
        state = task.transition(machine, net, state, u)
        for row, (j, (angles, rates, commands)) in enumerate(tape.items()):
            commands.append(u[j])
            x = (np.concatenate([angles, rates, commands]) - net.input_mean[row]) / net.input_scale[
                row
            ]
            w1, b1, w2, b2, w3, b3 = (weight[row].astype(float) for weight in net.weights)
            x = np.maximum(0, np.maximum(0, x @ w1 + b1) @ w2 + b2) @ w3 + b3
            low, high = float(net.output_low[row]), float(net.output_high[row])
            velocity = low + (high - low) / (1 + np.exp(-x[0]))
            joint = machine.joints[j]
            q[j] = min(max(q[j] + 0.05 * velocity, joint.q_min), joint.q_max)
            angles.append(q[j])
            rates.append(np.polyfit(np.arange(4) * 0.05, list(angles)[-4:], 1)[0])
    np.testing.assert_allclose(state.q, q, atol=1e-4)
    np.testing.assert_allclose(state.history[0, 1], tape[0][1], atol=1e-3)
    assert np.abs(q - POSE)[[0, 2, 3, 4]].min() > 1e-2  # they all moved


@pytest.mark.parametrize("machine", [BROKK_170, *MACHINES[:5]], ids=lambda m: m.name)
def test_the_plant_in_the_environment_is_the_plant(machine):
    rng = np.random.default_rng(8)
    env = TaskVectorEnv(6, machine=replace(machine, ground=-100.0), config=QUIET)
    env.reset(seed=3)
    plant = plant_reset(machine, env.state.q)
    angles = [read_encoder(machine, env.state.q)] * machine.history
    for _ in range(50):
        action = rng.uniform(-1, 1, (6, len(machine.driven)))
        before = plant.q
        plant = plant_step(machine, plant, sight.action_to_pwm(machine, action))
        env.step(action)
        angles.append(read_encoder(machine, plant.q))
        assert np.array_equal(env.state.q, plant.q)
        np.testing.assert_allclose(env.state.q_dot, (plant.q - before) * 20, atol=1e-12)
    seen = np.stack(angles[-machine.history :], axis=-1)
    assert np.array_equal(env.state.history[:, :, 0], seen.astype(np.float32))
    slope = estimate_velocity(seen, machine.velocity_samples, 0.05)
    np.testing.assert_allclose(env.state.history[:, :, 1, -1], slope, atol=1e-5)
    assert np.abs(plant.q - angles[0])[:, machine.driven].max() > 0.02


@pytest.mark.parametrize("plant", [True, False])
def test_transition_is_pure(plant):
    machine = BROKK_170
    rng = np.random.default_rng(9)
    net = None if plant else small_net(machine, rng)
    state = task.reset(machine, TaskConfig(), rng, 4, plant)
    for _ in range(5):
        state = task.transition(machine, net, state, sight.action_to_pwm(machine, np.ones((4, 4))))
    u = sight.action_to_pwm(machine, rng.uniform(-1, 1, (4, 4)))
    copies = [a.copy() for a in flat(state)]
    for array in (*flat(state), u):
        array.setflags(write=False)
    once, twice = (task.transition(machine, net, state, u) for _ in range(2))
    assert same(once, twice)
    assert all(np.array_equal(a, b) for a, b in zip(copies, flat(state), strict=True))
    assert not np.array_equal(once.q, state.q)
    assert np.array_equal(once.ticks, state.ticks + 1)
    assert np.array_equal(once.goal_ticks, state.goal_ticks - 1)


def test_transition_refuses_nets_that_are_missing():
    state = task.initial_state(BROKK_170, POSE, np.zeros(3), plant=False)
    with pytest.raises(
        ValueError, match="net: expected nets for a state without a plant, got None"
    ):
        task.transition(BROKK_170, None, state, np.zeros(5))


@pytest.mark.parametrize("plant", [True, False])
@pytest.mark.parametrize("machine", [BROKK_170, *MACHINES[1:3]], ids=lambda m: m.name)
def test_joint_limits_hold(machine, plant):
    net = None if plant else obedient_net(machine)
    low, high = machine.column("q_min"), machine.column("q_max")
    signs = np.where(np.arange(2)[:, None] == 0, 1.0, -1.0) * np.ones((2, len(machine.driven)))
    state = task.initial_state(machine, np.stack([(low + high) / 2] * 2), np.zeros(3), plant)
    u = sight.action_to_pwm(machine, signs)
    for _ in range(800):
        state = task.transition(machine, net, state, u)
        assert ((state.q >= low - 1e-6) & (state.q <= high + 1e-6)).all()
    driven = machine.driven
    np.testing.assert_allclose(state.q[0, driven], high[driven], atol=1e-6)
    np.testing.assert_allclose(state.q[1, driven], low[driven], atol=1e-6)
    assert not state.q_dot.any()


# --- many and one ---------------------------------------------------------------------------------

LIFE = TaskConfig(episode_s=1.5, hold_min_s=0.4, hold_max_s=0.4, redraw_ground=False)


@pytest.mark.skipif(
    platform.libc_ver()[0] != "glibc", reason="other C libraries manage memory otherwise"
)
def test_steps_use_the_memory_of_steps_before():
    env, actions = TaskVectorEnv(2048), np.zeros((2048, 4), np.float32)
    env.reset(seed=0)
    faults = []
    for _ in range(12):
        env.step(actions)
        faults.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt)
    assert faults[-1] - faults[5] < 600, np.diff(
        faults
    )  # pages; 1000 a step if handed back each time


@pytest.mark.parametrize("kind", ["plant", "nets"])
def test_many_environments_equal_single_ones(kind):
    """The same draws, three episodes long: goals, noise, resets and final observations included."""
    machine = LOW
    net = "analytic" if kind == "plant" else small_net(machine, np.random.default_rng(10))
    many = TaskVectorEnv(5, net, machine, LIFE)
    many.np_random = RowRandom([np.random.default_rng(100 + i) for i in range(5)])
    sync = SyncVectorEnv(
        [lambda: TaskEnv(net, machine, LIFE)] * 5, autoreset_mode=AutoresetMode.SAME_STEP
    )
    for i, single in enumerate(sync.envs):
        single.np_random = np.random.default_rng(100 + i)
    seen, others = many.reset()[0], sync.reset()[0]
    np.testing.assert_allclose(seen, others, atol=1e-6)
    actions, ends = np.random.default_rng(11), 0
    for _ in range(95):
        action = actions.uniform(-1.2, 1.2, (5, 4)).astype(np.float32)
        seen, reward, terminated, truncated, info = many.step(action)
        others, rewards, terminations, truncations, infos = sync.step(action)
        np.testing.assert_allclose(seen, others, atol=1e-6)
        np.testing.assert_allclose(reward, rewards, atol=3e-6)
        assert np.array_equal(terminated, terminations)
        assert np.array_equal(truncated, truncations)
        assert ("final_obs" in info) == ("final_obs" in infos)
        if "final_obs" in info:
            ends += 1
            assert np.array_equal(info["_final_obs"], infos["_final_obs"])
            np.testing.assert_allclose(info["final_obs"], np.stack(infos["final_obs"]), atol=1e-6)
        angles = np.concatenate([single.state.q for single in sync.envs])
        np.testing.assert_allclose(many.state.q, angles, atol=1e-7)
        lags = np.concatenate([single.state.lag for single in sync.envs])
        np.testing.assert_allclose(many.state.lag, lags, atol=1e-8)
    assert ends == 3


@pytest.mark.parametrize("kind", ["plant", "nets"])
def test_nothing_leaks_between_environments(kind):
    machine, config = LOW, TaskConfig(episode_s=1.0, hold_min_s=60, hold_max_s=60)
    net = None if kind == "plant" else small_net(machine, np.random.default_rng(12))
    left = right = task.reset(machine, config, np.random.default_rng(13), 6, net is None)
    other = task.reset(machine, config, np.random.default_rng(14), 1, net is None)
    right = task.merge(right, other, np.array([2]))
    assert not np.array_equal(left.q[2], right.q[2])
    rows, draws = [0, 1, 3, 4, 5], np.random.default_rng(15)
    rngs = [np.random.default_rng(16) for _ in range(2)]
    for _ in range(30):
        action = draws.uniform(-1, 1, (6, 4)).astype(np.float32)
        changed = action.copy()
        changed[2] = -changed[2]
        left, a = task.step(machine, config, net, left, action, rngs[0])
        right, b = task.step(machine, config, net, right, changed, rngs[1])
        assert same(left, right, rows)
        assert all(np.array_equal(x[rows], y[rows]) for x, y in zip(a, b, strict=True))
        assert not np.array_equal(a.observation[2], b.observation[2])
    assert not np.array_equal(left.lag[2], right.lag[2])
    assert np.abs(left.lag).max(axis=-1).min() > 0


def test_merge_replaces_whole_rows_and_nothing_else():
    rng, machine = np.random.default_rng(17), BROKK_170
    old, new = (task.reset(machine, TaskConfig(), rng, num, True) for num in (5, 2))
    for _ in range(8):
        old = task.transition(machine, None, old, sight.action_to_pwm(machine, np.ones((5, 4))))
    assert old.lag.any(axis=-1).all() and not new.lag.any()
    copies = [a.copy() for a in flat(old)]
    merged = task.merge(old, new, np.array([4, 1]))
    assert same(merged, old, [0, 2, 3])
    for found, wanted in zip(flat(merged), flat(new), strict=True):
        assert np.array_equal(found[[4, 1]], wanted)
    assert all(np.array_equal(a, b) for a, b in zip(copies, flat(old), strict=True))


# --- ends of episodes -----------------------------------------------------------------------------


@pytest.mark.parametrize("actuator", ["plant", "nets"])
def test_final_obs_is_the_end_of_the_old_episode(actuator):
    """A twin whose episodes are longer goes on: its observation is the short one's `final_obs`."""
    net = "analytic" if actuator == "plant" else obedient_net(LOW)
    short, long = (
        TaskVectorEnv(4, net, LOW, TaskConfig(episode_s=seconds)) for seconds in (1.0, 9.0)
    )
    a, b = short.reset(seed=5)[0], long.reset(seed=5)[0]
    draws = np.random.default_rng(18)
    for tick in range(1, 21):
        assert np.array_equal(a, b)
        action = draws.uniform(-1, 1, (4, 4)).astype(np.float32)
        a, reward, terminated, truncated, info = short.step(action)
        b, wanted, *_, other = long.step(action)
        assert np.array_equal(reward, wanted)  # the last tick is paid like any other
        assert np.array_equal(info["velocity_error"], other["velocity_error"])
        assert not terminated.any()
        assert truncated.all() == (tick == 20)
        assert ("final_obs" in info) == (tick == 20)
        assert "final_obs" not in other
    assert info["_final_obs"].tolist() == [True] * 4
    assert np.array_equal(info["final_obs"], b)
    assert (np.abs(a - info["final_obs"])[:, OLD].max(axis=1) > 1e-3).all()
    fresh = sight.measured(LOW, a)
    np.testing.assert_allclose(fresh.q, short.state.q, atol=0.1)
    assert short.state.ticks.tolist() == [0] * 4


def test_only_the_ended_rows_start_anew():
    env = TaskVectorEnv(3, machine=LOW, config=replace(QUIET, episode_s=1.0))
    env.reset(seed=6)
    env.state = replace(env.state, ticks=np.array([0, 19, 5]))
    before = env.state
    seen, _, _, truncated, info = env.step(np.ones((3, 4), np.float32))
    assert truncated.tolist() == info["_final_obs"].tolist() == [False, True, False]
    assert env.state.ticks.tolist() == [1, 0, 6]
    np.testing.assert_allclose(env.state.q[[0, 2]], before.q[[0, 2]], atol=0.01)
    assert np.array_equal(seen[[0, 2]], info["final_obs"][[0, 2]])
    newest = sight.measured(LOW, info["final_obs"]).q[1]
    np.testing.assert_allclose(newest, before.q[1], atol=0.01)
    np.testing.assert_allclose(sight.measured(LOW, seen).q[1], env.state.q[1], atol=2e-3)


def test_poses_in_the_ground_end_at_once_without_reward():
    env = TaskVectorEnv(400, config=TaskConfig(redraw_ground=False))
    env.reset(seed=7)
    buried = closed_form(env.state.q)[1] < 0
    assert 8 < buried.sum() < 392
    _, reward, terminated, truncated, info = env.step(np.zeros((400, 4), np.float32))
    assert np.array_equal(terminated, buried)
    assert not truncated.any()
    assert not reward[buried].any()
    assert (reward[~buried] > 0).all()
    assert np.array_equal(info["_final_obs"], buried)
    assert (env.state.ticks == ~buried).all()


def test_redrawn_poses_never_end_at_once():
    env = TaskVectorEnv(1000, config=TaskConfig(redraw_ground=True))
    for seed in range(3):
        env.reset(seed=seed)
        _, reward, terminated, truncated, _ = env.step(np.zeros((1000, 4), np.float32))
        assert not (terminated | truncated).any()
        assert (reward > 0).all()


def test_ground_and_time_limit_are_never_both():
    """In the tick in which the time runs out, a buried arm counts as terminated alone."""
    env = TaskVectorEnv(400, config=TaskConfig(redraw_ground=False, episode_s=0.05))
    env.reset(seed=8)
    for _ in range(3):
        buried = closed_form(env.state.q)[1] < 0
        _, reward, terminated, truncated, _ = env.step(np.zeros((400, 4), np.float32))
        assert np.array_equal(terminated, buried)
        assert np.array_equal(truncated, ~buried)
        assert np.array_equal(reward == 0, buried)


def test_an_arm_that_is_driven_into_the_ground_terminates():
    machine, config = BROKK_170, TaskConfig(noise=0.0)
    down = np.array([0.0, -1.0, 0.0, 0.0])
    env = TaskEnv(obedient_net(machine), machine, config)
    env.reset(seed=9)
    env.state = task.initial_state(machine, POSE[None], np.zeros((1, 3)), plant=False)
    heights = []
    for _ in range(300):
        _, reward, terminated, truncated, info = env.step(down)
        heights.append(float(closed_form(env.state.q)[1][0]))
        assert terminated == (heights[-1] < 0)
        assert not truncated
        if terminated:
            break
    assert len(heights) > 5
    assert terminated
    assert reward == 0
    assert info["velocity_error"] > 0


# --- Gymnasium ------------------------------------------------------------------------------------


def test_gymnasium_and_stable_baselines_accept_the_environment():
    from gymnasium.utils.env_checker import check_env
    from stable_baselines3.common.env_checker import check_env as check_sb3

    env = gymnasium.make("brokk_min/Brokk170-v0")
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*Box observation space.*infinity.*")
        check_env(env.unwrapped, skip_render_check=True)
    check_sb3(env.unwrapped)
    assert env.observation_space.shape == (171,)
    assert env.action_space.low.tolist() == [-1] * 4 and env.action_space.high.tolist() == [1] * 4


def test_make_vec_gives_the_vector_class():
    env = gymnasium.make_vec("brokk_min/Brokk170-v0", num_envs=256)
    assert isinstance(env.unwrapped, TaskVectorEnv)
    assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    seen, _ = env.reset(seed=0)
    assert env.observation_space.contains(seen)
    seen, reward, terminated, truncated, info = env.step(env.action_space.sample())
    assert env.observation_space.contains(seen)
    assert (
        reward.shape
        == terminated.shape
        == truncated.shape
        == info["velocity_error"].shape
        == (256,)
    )
    assert len(np.unique(seen[:, 7])) > 250  # they start apart


def test_metadata_tell_the_rate_and_the_kind_of_pictures():
    fast = replace(BROKK_170, rate=50.0)
    one = TaskEnv(machine=fast, render_mode="rgb_array")
    many = TaskVectorEnv(2, machine=fast, render_mode="rgb_array")
    assert one.metadata == {"render_modes": ["human", "rgb_array"], "render_fps": 50}
    assert TaskEnv.metadata["render_fps"] == 20
    wanted = {
        "render_modes": ["rgb_array"],
        "render_fps": 50,
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }
    assert many.metadata == wanted and one.render_mode == many.render_mode == "rgb_array"
    with pytest.raises(
        ValueError, match=r"render_mode: expected one of \['rgb_array'\], got 'human'"
    ):
        TaskVectorEnv(2, render_mode="human")


@pytest.mark.parametrize("make", [lambda: TaskVectorEnv(3), TaskEnv], ids=["vector", "single"])
def test_seeds_reproduce_and_differ(make):
    def run(seed):
        env = make()
        tape, draws = [env.reset(seed=seed)[0]], np.random.default_rng(0)
        for _ in range(30):
            action = draws.uniform(-1, 1, env.action_space.shape).astype(np.float32)
            tape.append(env.step(action)[0])
        return np.array(tape)

    assert np.array_equal(run(3), run(3))
    assert not np.allclose(run(3)[0], run(4)[0], atol=0.2)


@pytest.mark.parametrize("make", [lambda: TaskVectorEnv(2), TaskEnv], ids=["vector", "single"])
def test_a_step_before_the_reset_is_refused(make):
    with pytest.raises(ValueError, match="step: expected a reset before the first step, got none"):
        make().step(np.zeros((2, 4), np.float32))


@pytest.mark.parametrize("shape", [(2, 5), (2,), (2, 3)])
def test_the_environment_refuses_wrong_actions(shape):
    env = TaskVectorEnv(2)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"action: expected \(\.\.\., 4\), got \(2"):
        env.step(np.zeros(shape, np.float32))


@pytest.mark.parametrize("machine", MACHINES, ids=lambda m: f"{m.name}-{len(m.driven)}")
def test_random_machines_run(machine):
    """Environment and Jacobian controller on two to six joints, on the plant and on nets."""
    for actuator in ("analytic", small_net(machine, np.random.default_rng(0))):
        env = TaskVectorEnv(4, actuator, machine, TaskConfig(episode_s=1.0))
        seen, _ = env.reset(seed=0)
        ends = 0
        for _ in range(45):
            seen, reward, terminated, truncated, _ = env.step(env.action_space.sample())
            assert env.observation_space.contains(seen)
            assert ((reward > 0) & (reward <= 1)).all()
            assert not terminated.any()
            ends += truncated.sum()
        assert ends == 8
    gains = join_gains(machine, dict.fromkeys(GAINS, 0.0) | {"kp": 1.0, "ki": 1.0, "feedback": 0.2})
    controller = JacobianController(machine, gains, 0.1, 0.1)
    start = (machine.column("q_min") + machine.column("q_max")) / 2 * np.ones((3, 1))
    goals = np.full((30, 3, 3), 0.05)
    trace = task.rollout(machine, controller, start, goals, TaskConfig(), np.random.default_rng(0))
    assert np.isfinite(trace.v_tool).all()
    assert np.abs(trace.u).max() <= machine.pwm_limit / 127 + 1e-9
    assert not trace.u[..., machine.locked].any()
    assert np.abs(trace.q - start).max() > 1e-3


# --- nets that do not fit -------------------------------------------------------------------------


def nets_of(actuator):
    return TaskVectorEnv(1, actuator, BROKK_170).net


def test_nets_that_do_not_fit_are_refused():
    net = small_net(BROKK_170, np.random.default_rng(0))
    for change in ({"rate": 10.0}, {"velocity_samples": 3}, {"velocity_logged": True}):
        ((name, value),) = change.items()
        message = (
            f"actuator: expected nets for brokk170 with .*'{name}': .*, got .*'{name}': {value}"
        )
        with pytest.raises(ValueError, match=message):
            nets_of(replace(net, **change))
    with pytest.raises(ValueError, match=r"actuator: expected .*'history': 13.*'history': 7"):
        nets_of(small_net(replace(BROKK_170, history=7), np.random.default_rng(0)))
    names = ("q1", "q3", "q4")
    with pytest.raises(ValueError, match=r"joints: expected nets for \['q1', .*'q5'\], got \['q1'"):
        nets_of(net.select(names))


def test_nets_of_another_machine_with_the_same_joints_are_refused():
    net = replace(small_net(BROKK_170, np.random.default_rng(0)), machine="brokk500")
    with pytest.raises(ValueError, match=r"brokk170.*brokk500"):
        nets_of(net)


def test_nets_are_found_by_name_and_read_from_files(tmp_path):
    rng = np.random.default_rng(1)
    ordered = small_net(BROKK_170, rng)
    mixed = ordered.select(("q5", "q1", "q4", "q3"))
    save_net(tmp_path / "net.npz", mixed)
    for actuator in (mixed, tmp_path / "net.npz", str(tmp_path / "net.npz")):
        found = nets_of(actuator)
        assert found.joints == ("q1", "q3", "q4", "q5")
        history = rng.normal(size=(3, 4, 3, 13)).astype(np.float32)
        assert np.array_equal(found.predict(history), ordered.predict(history))
    with pytest.raises(ValueError, match=r"none\.npz: expected a readable \.npz file"):
        nets_of(tmp_path / "none.npz")


# --- nothing is written to ------------------------------------------------------------------------


def sealed(values):
    """The same arrays, read-only."""
    for array in values:
        array.setflags(write=False)
    return values


@pytest.mark.parametrize("plant", [True, False])
@pytest.mark.parametrize("machine", [BROKK_170, *MACHINES[:4]], ids=lambda m: m.name)
def test_arrays_that_go_in_are_never_written_to(machine, plant):
    """States, observations and actions are read-only here: a write in place would raise."""
    rng = np.random.default_rng(31)
    net = None if plant else small_net(machine, rng)
    state = task.reset(machine, TaskConfig(hold_min_s=0.05, hold_max_s=0.1), rng, 6, plant)
    controller = JacobianController(
        machine, join_gains(machine, dict.fromkeys(GAINS, 0.1)), 0.1, 1.0
    )
    memory = controller.start(6)
    for _ in range(4):
        sealed(flat(state))
        (action,) = sealed([rng.uniform(-1, 1, (6, len(machine.driven))).astype(np.float32)])
        fresh = task.reset(machine, TaskConfig(), rng, 2, plant)
        sealed(flat(fresh))
        after, outcome = task.step(machine, TaskConfig(), net, state, action, rng)
        sealed(outcome)
        task.merge(state, fresh, np.array([1, 4]))
        sealed(sight.measured(machine, outcome.observation))
        _, memory = controller(outcome.observation, type(memory)(*sealed(list(memory))))
        state = after


def test_the_papers_reward_has_no_costs() -> None:
    m, net = BROKK_170, small_net(BROKK_170, np.random.default_rng(0))
    outcomes = []
    for config in (
        TaskConfig(paper=True),
        TaskConfig(valve_cost=0.0, integral_cost=0.0),
        TaskConfig(integral_cost=0.0),
    ):
        state = task.reset(m, config, np.random.default_rng(0), 4, plant=False)
        outcomes.append(
            task.step(m, config, net, state, np.ones((4, 4)), np.random.default_rng(1))[1].reward
        )
    np.testing.assert_array_equal(outcomes[0], outcomes[1])
    np.testing.assert_allclose(
        outcomes[0] - outcomes[2], 0.05, atol=1e-6
    )  # idle to full on every valve
