"""The policy: by hand, against torch, refusals of its file."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from helpers_bus import random_policy
from helpers_machines import POSE, pids

from brokk_min import env
from brokk_min._files import SHIPPED
from brokk_min.beyond import interface
from brokk_min.evaluation.baselines import gains_metadata, read_gains, write_gains
from brokk_min.identification.net_file import fingerprint
from brokk_min.learning.checkpoint import actor_weights
from brokk_min.learning.policy import POLICIES, load_policy, save_policy
from brokk_min.machine import BROKK_170
from brokk_min.ppo import Agent


def test_act__equals_the_actor_of_torch():
    """Its weights, biases included, are far from their start."""
    torch.manual_seed(0)
    agent = Agent(91, 4, -1.0)
    with torch.no_grad():
        for parameter in agent.parameters():
            parameter += 0.1 * torch.randn(parameter.shape)
    obs = np.random.default_rng(0).normal(0, 2, (3, 7, 91)).astype(np.float32)
    expected = agent.actor(torch.from_numpy(obs)).detach().numpy()
    assert expected.std() > 0.05
    found = replace(random_policy("beyond"), weights=actor_weights(agent)).act(obs)
    np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())


def test_act__refuses_observations_of_another_interface():
    with pytest.raises(ValueError, match=r"^observation: .* 91 numbers .*, got \(64, 163\)"):
        random_policy("beyond").act(np.zeros((64, 163)))


@pytest.mark.parametrize("kind", ["paper", "beyond"])
def test_controller__remembers_how_long_its_goal_is_zero(kind):
    """Valves of our agent close after 0.1 s of a zero goal; the paper's go on."""
    controller = random_policy(kind)
    memory = controller.start(2)
    goals = np.array([[0.1, 0.0, 0.0], [0.0, 0.0, 0.0]])
    state = env.initial_state(BROKK_170, np.tile(POSE, (2, 1)), goals)
    for tick in range(5):
        measured = env.measure(BROKK_170, state.history, state.v_goal)
        u, memory = controller(measured, memory)
        assert u[0].any()
        assert u[1].any() == (kind == "paper" or tick < 2)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rate": 40.0}, "rate: expected 40.0, got 20.0"),
        (
            {"tool_speed": 0.2},
            "expected the machine's tool_speed, q_dot_up and q_dot_down, got others",
        ),
    ],
)
def test_load_policy__refuses_one_for_another_machine(tmp_path, change, message):
    save_policy(tmp_path / "p.npz", random_policy("paper"))
    with pytest.raises(ValueError, match=message):
        load_policy(tmp_path / "p.npz", replace(BROKK_170, q_start=(), **change))


def test_files__made_with_another_constant_are_refused_by_its_name(tmp_path, monkeypatch):
    """A policy of the paper's interface has none of ours."""
    files = {kind: tmp_path / f"{kind}.npz" for kind in ("paper", "beyond")}
    for kind, file in files.items():
        save_policy(file, random_policy(kind))
    net, gains = load_policy(files["beyond"], BROKK_170).net, tmp_path / "gains.json"
    write_gains(gains, pids(BROKK_170, net), gains_metadata(BROKK_170, net))
    monkeypatch.setattr(interface, "ALONG", 0.07)
    for read in (load_policy, partial(read_gains, net=net)):
        file = files["beyond"] if read is load_policy else gains
        with pytest.raises(ValueError, match=r"interface: ALONG: expected 0\.07, got 0\.02$"):
            read(file, BROKK_170)
    assert load_policy(files["paper"], BROKK_170).interface == "paper"


@pytest.mark.parametrize("file", POLICIES.values())
def test_shipped_policies__name_the_nets_that_they_hold(file):
    policy = load_policy(SHIPPED / BROKK_170.name / file, BROKK_170)
    assert policy.training["actuator"] == fingerprint(policy.net)
