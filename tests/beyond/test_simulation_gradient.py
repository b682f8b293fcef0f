"""Derivatives of the rewards by the actions: against finite differences of another simulation."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers_machines import obedient_net, small_net

from brokk_min import env
from brokk_min.beyond import simulation_gradient as sg
from brokk_min.beyond.gradient_config import GradientConfig
from brokk_min.beyond.interface import INTEGRAL_LIMIT, INTEGRAL_TIME, INTERFACE
from brokk_min.beyond.valve_nets import ValveNet
from brokk_min.env import TaskConfig
from brokk_min.learning.gym_env import TaskVectorEnv
from brokk_min.machine import BROKK_170
from brokk_min.ppo import begin, collect

MACHINE = replace(BROKK_170, name="free", ground=-100.0)
CONFIG = GradientConfig(num_envs=3, horizon=9, log_std=-1.0)


def valve_net():
    net = small_net(MACHINE, np.random.default_rng(3), rows=4)
    zones = MACHINE.dead_zones[MACHINE.driven].astype(np.float32)
    return ValveNet(**vars(net), dead_zones=zones)


def rollout_of(net, seed=0, task=None):
    task = task or TaskConfig(noise=0.0)
    env_ = TaskVectorEnv(3, net, MACHINE, task, INTERFACE)
    start = begin(env_, CONFIG, seed)
    return collect(env_, start.agent, start.obs, CONFIG.horizon)[0]


def test_net_velocities__are_those_of_the_nets():
    history = np.random.default_rng(1).uniform(-0.6, 0.6, (5, 4, 3, 13)).astype(np.float32)
    for net in (small_net(MACHINE, np.random.default_rng(3)), valve_net()):
        found = sg.net_velocities(net, torch.from_numpy(history)).numpy()
        np.testing.assert_allclose(found, net.predict(history), atol=1e-5)


def test_replay__computes_the_rewards_of_the_rollout_again():
    """Up to what it leaves out: encoders, the motion of the Jacobian within a tick."""
    rollout = rollout_of(obedient_net(MACHINE))
    rewards = torch.stack(
        sg.Replay(MACHINE, obedient_net(MACHINE), rollout).rewards(rollout.actions)
    )
    np.testing.assert_allclose(rewards.numpy(), rollout.rewards.numpy(), atol=0.01)
    assert rollout.rewards.std() > 0.02


def simulated_return(net, rollout, u, gamma):
    """Discounted rewards (num,) under commands u (T, num, n_driven), by plain NumPy."""
    before = [info["before"] for info in rollout.infos]
    state, memory, _ = before[0]
    plant = env.initial_state(MACHINE, state.q, state.v_goal, net).plant
    plant = plant._replace(history=state.plant.history.astype(float), q=state.plant.q)
    integral, total = memory.error_integral.astype(float), 0.0
    for t, (recorded, _, _) in enumerate(before):
        whole = np.zeros((len(u[t]), MACHINE.n))
        whole[:, MACHINE.driven] = u[t]
        change = np.abs(u[t] - plant.history[..., 2, -1]).mean(axis=-1) / (80 / 127)
        after = net.step(MACHINE, plant, whole)
        J = jacobian_at(recorded.q)
        q_dot = (after.q - plant.q)[:, MACHINE.driven] / MACHINE.dt
        error = recorded.v_goal - (J @ q_dot[..., None])[..., 0]
        limit = INTEGRAL_LIMIT * MACHINE.tool_speed
        size = np.linalg.norm(error, axis=-1, keepdims=True)
        cut = error * np.minimum(1, limit / size)
        integral = np.exp(-MACHINE.dt / INTEGRAL_TIME) * (integral + MACHINE.dt * cut)
        reward = 1 / (1 + size[:, 0]) - 0.1 * change - np.linalg.norm(integral, axis=-1)
        total = total + gamma**t * reward
        plant = after
    return total


def jacobian_at(q):
    from brokk_min.kinematics import forward_kinematics, jacobian

    return jacobian(forward_kinematics(MACHINE, q))[..., MACHINE.driven]


@pytest.mark.parametrize("kind", ["paper", "valve"])
def test_action_gradients__are_finite_differences(kind):
    net = valve_net() if kind == "valve" else small_net(MACHINE, np.random.default_rng(3))
    net = replace(net, weights=tuple(w.astype(float) for w in net.weights))
    rollout = rollout_of(replace(net, weights=tuple(w.astype(np.float32) for w in net.weights)))
    single = replace(net, weights=tuple(w.astype(np.float32) for w in net.weights))
    gradient = sg.action_gradients(MACHINE, single, rollout, 0.9).numpy()
    u = np.stack([info["before"][2] for info in rollout.infos])[..., MACHINE.driven]
    slope = sg.command_slope(MACHINE, rollout.actions.numpy())
    step = 1e-5
    checked = 0
    for t in range(0, CONFIG.horizon, 2):
        for k in range(4):
            ahead, behind = u.copy(), u.copy()
            ahead[t, :, k] += step
            behind[t, :, k] -= step
            difference = simulated_return(net, rollout, ahead, 0.9)
            difference -= simulated_return(net, rollout, behind, 0.9)
            expected = difference / (2 * step) * slope[t, :, k] / 0.9**t
            moving = np.abs(u[t, :, k]) < 79.5 / 127  # beyond the limit the command is clipped
            close = np.abs(gradient[t, :, k] - expected) <= 2e-3 + 0.02 * np.abs(expected)
            checked += close[moving].sum()
            assert close[moving].mean() >= 2 / 3, (t, k, gradient[t, :, k], expected)
    assert checked > 40


def test_action_gradients__stop_at_the_end_of_an_episode_and_at_rest():
    """Actions before a reset know nothing of rewards after it; at rest actions do nothing."""
    rollout = rollout_of(obedient_net(MACHINE), task=TaskConfig(episode_s=0.25, noise=0.0))
    assert rollout.dones[4].all()
    full = sg.action_gradients(MACHINE, obedient_net(MACHINE), rollout, 0.9)
    first = rollout._replace(
        **{name: getattr(rollout, name)[:5] for name in rollout._fields if name != "infos"},
        infos=rollout.infos[:5],
    )
    alone = sg.action_gradients(MACHINE, obedient_net(MACHINE), first, 0.9)
    np.testing.assert_allclose(full[:5], alone, atol=1e-5)
    rest = rollout_of(obedient_net(MACHINE), task=TaskConfig(zero_goals=1.0, axis_goals=0.0))
    for info in rest.infos:
        state, memory, u = info["before"]
        info["before"] = (state, memory._replace(rest_ticks=memory.rest_ticks + 99), 0 * u)
    assert not sg.action_gradients(MACHINE, obedient_net(MACHINE), rest, 0.9).any()


def test_saturate__keeps_directions_and_cuts_at_the_median_norm():
    vectors = torch.tensor([[3.0, 4.0], [0.3, 0.4], [0.0, 1.0]])  # norms 5, 0.5, 1
    expected = torch.tensor([[0.6, 0.8], [0.3, 0.4], [0.0, 1.0]])
    torch.testing.assert_close(sg.saturate(vectors), expected)


def test_normal_kl__by_hand():
    """(1/2) (0.2^2 + 0.4^2) / 0.5^2 = 0.4."""
    mean, other = torch.tensor([[0.2, 0.4]]), torch.zeros(1, 2)
    kl = sg.normal_kl(mean, other, torch.log(torch.tensor([0.5, 0.5])))
    torch.testing.assert_close(kl, torch.tensor(0.4))


def test_train__lessens_the_error_of_the_tool():
    errors = []
    config = replace(CONFIG, num_envs=64, horizon=16, total_steps=40 * 1024, log_std=-2.5)
    task = TaskVectorEnv(64, obedient_net(MACHINE), MACHINE, TaskConfig(noise=0.0), INTERFACE)

    def note(checkpoint, rollout, metrics):
        errors.append(np.mean([info["velocity_error"].mean() for info in rollout.infos]))

    sg.train(task, config, 0, on_update=note)
    assert np.mean(errors[-3:]) < 0.5 * np.mean(errors[:3])
