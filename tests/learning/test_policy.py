"""The policy's file and function: by hand, against torch, bit for bit through a file, refusals."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers_machines import POSE, small_net

from brokk_min.env import TaskConfig, action_to_pwm, features, initial_state, measure
from brokk_min.learning.checkpoint import export_policy
from brokk_min.learning.policy import Policy, PolicyController, load_policy, save_policy
from brokk_min.machine import BROKK_170
from brokk_min.ppo import Agent

NET = small_net(BROKK_170, np.random.default_rng(0))


@pytest.fixture(scope="module")
def agent():
    """An actor whose weights, biases included, are far from their start."""
    generator = torch.Generator().manual_seed(0)
    agent = Agent(223, 4, -1.0, critic=False)
    with torch.no_grad():
        for parameter in agent.parameters():
            parameter += 0.1 * torch.randn(parameter.shape, generator=generator)
    return agent


@pytest.fixture(scope="module")
def policy(agent):
    return export_policy(NET, agent, TaskConfig(), {"seed": 0, "gamma": 0.5})


@pytest.fixture
def saved(policy, tmp_path):
    save_policy(tmp_path / "policy.npz", policy, BROKK_170)
    return tmp_path / "policy.npz"


def test_act__by_hand():
    """Two inputs, two ELU units, one output: x = (1, -1) at the units."""
    weights = (
        np.array([[1.0, 0.0], [0.0, 2.0]]),
        np.array([0.5, -2.0]),
        np.array([[3.0], [10.0]]),
        np.array([0.25]),
    )
    policy = Policy({}, weights, NET)
    # units: 0.5 + 0.5 = 1 and 2 x 0.5 - 2 = -1; ELU gives 1 and 1/e - 1
    expected = 3 + 10 * (np.exp(-1) - 1) + 0.25
    np.testing.assert_allclose(policy.act(np.array([0.5, 0.5])), [expected], rtol=1e-6)


def test_act__equals_the_actor_of_torch(agent, policy):
    obs = np.random.default_rng(0).normal(0, 2, (3, 7, 223)).astype(np.float32)
    expected = agent.actor(torch.from_numpy(obs)).detach().numpy()
    assert expected.std() > 0.05
    np.testing.assert_allclose(policy.act(obs), expected, atol=1e-5 * np.abs(expected).max())
    assert np.isfinite(policy.act(np.array([[1e4], [-1e4]]) * np.ones(223))).all()


def test_act__refuses_wrong_shapes_and_what_is_not_finite(policy):
    for shape in ((), (222,), (223, 1), (3, 224)):
        with pytest.raises(ValueError, match=r"observation: expected \(\.\.\., 223\), got \("):
            policy.act(np.zeros(shape))
    for bad in (np.nan, np.inf, -np.inf):
        with pytest.raises(ValueError, match="observation: expected finite numbers, got"):
            policy.act(np.where(np.arange(223) == 40, bad, np.zeros((2, 223))))


def measured(v_goal):
    state = initial_state(BROKK_170, np.tile(POSE, (len(v_goal), 1)), v_goal, plant=True)
    return measure(BROKK_170, state.history, state.v_goal, state.error_integral)


@pytest.mark.parametrize(("valves", "after"), [("closed", 10), ("dither", 2), ("open", 100)])
def test_controller__sends_the_policys_actions_or_has_a_rule_for_valves_at_rest(
    policy, valves, after
):
    """The first machine rests but for one tick, the second moves."""
    controller = PolicyController(BROKK_170, replace(policy, valves=valves))
    ticks = controller.start(2)
    for tick in range(100):
        seen = measured([[0, 0, 0.1 * (tick == 30)], [0.1, 0, 0.2]])
        u, ticks = controller(seen, ticks)
        free = action_to_pwm(BROKK_170, policy.act(features(BROKK_170, seen)))
        assert np.array_equal(u[1], free[1]) and not np.array_equal(free[0], free[1])
        if (tick if tick < 30 else tick - 31) < after:
            assert np.array_equal(u[0], free[0])
        else:
            size = 12 / 127 if valves == "dither" else 0.0
            np.testing.assert_allclose(np.abs(u[0, BROKK_170.driven]), size, atol=1e-7)


def test_controller__of_the_papers_agent_takes_its_observation_and_sends_plain_actions():
    agent = Agent(163, 4, -1.0, critic=True)
    agent.actor[-1].weight.data *= 100
    paper = export_policy(NET, agent, TaskConfig(paper=True), {})
    controller = PolicyController(BROKK_170, paper)
    v_goal = np.random.default_rng(1).normal(0, 0.2, (5, 3))
    v_goal[0] = 0
    u, _ = controller(measured(v_goal), controller.start(5) + 1000)
    action = paper.act(features(BROKK_170, measured(v_goal), paper=True))
    assert np.array_equal(u, action_to_pwm(BROKK_170, action, paper=True))
    assert np.abs(u[0]).max() > 0.1  # valves stay as the policy has them


def test_load_policy__takes_files_that_do_not_tell_the_dead_zones_of_joints(policy, tmp_path):
    """As those written before 24 November 2026."""
    save_policy(tmp_path / "policy.npz", policy, BROKK_170)
    arrays = dict(np.load(tmp_path / "policy.npz"))
    header = json.loads(str(arrays["header"]))
    del header["contract"]["dead_zones"], header["contract"]["weights"]
    arrays["header"] = np.array(json.dumps(header))
    np.savez(tmp_path / "older.npz", **arrays)
    assert load_policy(tmp_path / "older.npz", BROKK_170).training == policy.training


def test_load_policy__keeps_every_bit(policy, saved, tmp_path):
    again = load_policy(saved, BROKK_170)
    assert dict(again.training) == {"seed": 0, "gamma": 0.5}
    assert len(again.weights) == 8
    for one, two in zip(again.weights, policy.weights, strict=True):
        assert one.tobytes() == np.ascontiguousarray(two).tobytes()
    history = np.random.default_rng(0).normal(size=(2, 4, 3, 13)).astype(np.float32)
    assert np.array_equal(again.net.predict(history), policy.net.predict(history))
    save_policy(tmp_path / "other.npz", again, BROKK_170)
    assert saved.read_bytes() == (tmp_path / "other.npz").read_bytes()


REORDERED = (*BROKK_170.joints[1:], BROKK_170.joints[0])


def change_joint(index, **changes):
    joints = list(BROKK_170.joints)
    joints[index] = replace(joints[index], **changes)
    return replace(BROKK_170, joints=tuple(joints))


@pytest.mark.parametrize(
    ("machine", "message"),
    [
        (replace(BROKK_170, name="brokk500"), r"machine: expected 'brokk500', got 'brokk170'"),
        (
            replace(BROKK_170, joints=REORDERED, q_start=()),
            r"joints: expected \['q2', 'q3', 'q4', 'q5', 'q1'\], got \['q1', 'q2'",
        ),
        (change_joint(1, driven=True), r"driven: expected \['q1', 'q2'.*got \['q1', 'q3'"),
        (replace(BROKK_170, pwm_limit=60), r"pwm_limit: expected 60, got 80"),
        (change_joint(2, a=1.5), r"geometry\[2\]\[0\]: expected 1\.5, got 1\.25"),
        (change_joint(2, dead_zone_up=0.1), r"dead_zones\[1\]: expected \[0.1, 0.07\], got \[0.07"),
        (change_joint(2, weight=2.0), r"weights: expected \[1.0, 2.0, 1.0, 1.0\], got \[1.0, 1.0"),
        (change_joint(2, q_dot_down=0.5), r"scale: expected the machine's normalisation, got"),
        (replace(BROKK_170, tool_speed=0.4), r"scale: expected the machine's normalisation, got"),
    ],
    ids=lambda value: value.split(":")[0] if isinstance(value, str) else "",
)
def test_load_policy__refuses_one_for_something_else(saved, machine, message):
    with pytest.raises(ValueError, match=r"policy\.npz: " + message):
        load_policy(saved, machine)
