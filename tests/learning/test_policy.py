"""The policy file and its function: against torch, bit for bit through a file, and its refusals."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers_machines import random_machine, small_net

from brokk_min.env import TaskConfig, action_to_pwm
from brokk_min.learning.gym_env import TaskVectorEnv
from brokk_min.learning.policy import Policy, PolicyController, load_policy, save_policy
from brokk_min.machine import BROKK_170
from brokk_min.ppo import PPOConfig, Training

SETTINGS = PPOConfig(num_envs=2, horizon=4, total_steps=64, threads=1)


def trained(machine=BROKK_170, seed=0):
    """A learner with weights, biases included, that are far from their start, and its policy."""
    net = small_net(machine, np.random.default_rng(seed))
    training = Training(TaskVectorEnv(2, net, machine, TaskConfig()), SETTINGS, seed)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in training.agent.parameters():
            parameter += 0.1 * torch.randn(parameter.shape, generator=generator)
    return training, training.policy({"seed": seed, "settings": {"gamma": 0.5}})


@pytest.fixture(scope="module")
def policy():
    return trained()[1]


@pytest.fixture
def saved(policy, tmp_path):
    save_policy(tmp_path / "policy.npz", policy)
    return tmp_path / "policy.npz"


def rewrite(path, header=None, drop=(), **arrays):
    """Change a policy file: entries of its header, its arrays."""
    with np.load(path) as file:
        found = {name: file[name] for name in file.files if name not in drop}
    text = json.loads(str(found["header"]))
    text |= header or {}
    np.savez(path, **(found | arrays | {"header": np.array(json.dumps(text))}))
    return text


def test_act_by_hand():
    """Two inputs, two ELU units, one output: x = (1, -1) at the units."""
    none = small_net(BROKK_170, np.random.default_rng(0))
    weights = (
        np.array([[1.0, 0.0], [0.0, 2.0]]),
        np.array([0.5, -2.0]),
        np.array([[3.0], [10.0]]),
        np.array([0.25]),
    )
    policy = Policy({}, {}, np.zeros(2), np.ones(2), weights, none)
    # units: 0.5 + 0.5 = 1 and 2 x 0.5 - 2 = -1, so ELU gives 1 and 1/e - 1
    wanted = 3 + 10 * (np.exp(-1) - 1) + 0.25
    np.testing.assert_allclose(policy.act(np.array([0.5, 0.5])), [wanted], rtol=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_act_is_the_actor_of_torch(seed):
    machine = BROKK_170 if seed == 0 else random_machine(np.random.default_rng(seed), 1 + seed)
    training, policy = trained(machine, seed)
    size = training.observation.shape[-1]
    observation = np.random.default_rng(seed).normal(0, 2, (3, 7, size)).astype(np.float32)
    with torch.no_grad():
        wanted = training.agent.actor(torch.from_numpy(observation)).numpy()
    assert wanted.std() > 0.05
    np.testing.assert_allclose(policy.act(observation), wanted, atol=1e-5 * max(1, wanted.max()))
    np.testing.assert_allclose(policy.act(observation[1, 2]), wanted[1, 2], atol=1e-4)


def test_a_policy_stays_as_it_was_while_training_goes_on():
    training, policy = trained()
    observation = np.ones(171, np.float32)
    before = policy.act(observation)
    training.update()
    assert np.array_equal(policy.act(observation), before)


def test_act_stands_large_observations(policy):
    action = policy.act(np.array([[1e4], [-1e4]]) * np.ones(171))
    assert np.isfinite(action).all()


def test_a_file_keeps_every_bit(policy, saved):
    again = load_policy(saved, BROKK_170)
    for name in ("mean", "scale"):
        assert np.array_equal(getattr(again, name), getattr(policy, name))
    assert len(again.weights) == 8
    for found, wanted in zip(again.weights, policy.weights, strict=True):
        assert found.tobytes() == np.ascontiguousarray(wanted).tobytes()
    assert dict(again.contract) == dict(policy.contract)
    assert dict(again.training) == {"seed": 0, "settings": {"gamma": 0.5}}
    observation = np.random.default_rng(0).normal(size=(64, 171)).astype(np.float32)
    assert np.array_equal(again.act(observation), policy.act(observation))
    history = np.random.default_rng(0).normal(size=(2, 4, 3, 13)).astype(np.float32)
    assert np.array_equal(again.net.predict(history), policy.net.predict(history))


def test_two_files_of_one_policy_are_the_same_bytes(policy, saved, tmp_path):
    save_policy(tmp_path / "other.npz", policy)
    assert saved.read_bytes() == (tmp_path / "other.npz").read_bytes()


def test_the_controller_sends_what_the_policy_says(policy):
    observation = np.random.default_rng(1).normal(size=(5, 171)).astype(np.float32)
    controller = PolicyController(BROKK_170, policy)
    u, memory = controller(observation, controller.start(5))
    assert np.array_equal(u, action_to_pwm(BROKK_170, policy.act(observation)))
    assert memory.tolist() == [0] * 5
    assert len(np.unique(u[:, 0])) > 1


def test_valves_close_when_the_tool_was_to_stand_for_two_seconds():
    """One tool is asked to move once, the other never: for 40 ticks their valves may be kept awake."""
    controller, seen = PolicyController(BROKK_170, trained()[1]), np.full((2, 171), 0.5, np.float32)
    memory, awake = controller.start(2), []
    for tick in range(100):
        seen[:, :3] = [[0.0, 0.0, 0.1 * (tick == 30)], [0.0, 0.0, 0.0]]
        u, memory = controller(seen, memory)
        awake.append(u.any(axis=1))
    first, second = np.array(awake).T
    assert first[:71].all() and not first[71:].any()
    assert second[:40].all() and not second[40:].any()


def test_a_policy_runs_without_torch_and_scipy(saved):
    code = (
        "import sys, numpy as np, brokk_min.learning.policy as p; from brokk_min.machine import BROKK_170;"
        f"p.load_policy({str(saved)!r}, BROKK_170).act(np.zeros(171));"
        "print([name for name in ('torch', 'scipy', 'matplotlib') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


# --- refusals


def change_joint(index, **changes):
    joints = list(BROKK_170.joints)
    joints[index] = replace(joints[index], **changes)
    return replace(BROKK_170, joints=tuple(joints))


def swapped():
    first, *rest = BROKK_170.joints
    return replace(BROKK_170, joints=(*rest, first))


@pytest.mark.parametrize(
    ("machine", "message"),
    [
        (replace(BROKK_170, name="brokk500"), r"machine: expected 'brokk500', got 'brokk170'"),
        (swapped(), r"joints: expected \['q2', 'q3', 'q4', 'q5', 'q1'\], got \['q1', 'q2'"),
        (change_joint(1, driven=True), r"driven: expected \['q1', 'q2'.*got \['q1', 'q3'"),
        (replace(BROKK_170, history=12), r"history: expected 12, got 13"),
        (replace(BROKK_170, rate=40.0), r"rate: expected 40.0, got 20.0"),
        (replace(BROKK_170, velocity_samples=3), r"velocity_samples: expected 3, got 4"),
        (replace(BROKK_170, pwm_limit=60), r"pwm_limit: expected 60, got 80"),
        (change_joint(2, q_max=1.5), r"geometry: expected .*1\.5.*got .*1\.6"),
        (change_joint(2, a=1.5), r"geometry: expected .*1\.5.*got .*1\.25"),
        (
            change_joint(2, q_dot_down=0.5),
            r"scale: expected the machine's normalisation, got another",
        ),
        (replace(BROKK_170, tool_speed=0.4), r"scale: expected the machine's normalisation"),
    ],
    ids=lambda value: value.split(":")[0] if isinstance(value, str) else "",
)
def test_a_policy_for_something_else_is_refused(saved, machine, message):
    with pytest.raises(ValueError, match=r"policy\.npz: " + message):
        load_policy(saved, machine)


@pytest.mark.parametrize("name", ["mean", "scale"])
def test_a_policy_with_another_normalisation_is_refused(saved, policy, name):
    other = getattr(policy, name).copy()
    other[100] += 1e-3
    rewrite(saved, **{name: other})
    with pytest.raises(ValueError, match=rf"policy\.npz: {name}: expected the machine's norm"):
        load_policy(saved, BROKK_170)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9, 0.999])
def test_a_truncated_file_is_refused(saved, share):
    data = saved.read_bytes()
    saved.write_bytes(data[: int(share * len(data))])
    with pytest.raises(ValueError, match=r"policy\.npz: expected a readable \.npz file, got"):
        load_policy(saved, BROKK_170)


def test_a_flipped_byte_is_refused(saved):
    data = bytearray(saved.read_bytes())
    data[len(data) // 2] ^= 0xFF
    saved.write_bytes(data)
    with pytest.raises(ValueError, match=r"policy\.npz: expected a readable \.npz file, got"):
        load_policy(saved, BROKK_170)


@pytest.mark.parametrize("name", ["weight_0", "weight_7", "mean", "scale"])
def test_a_missing_array_is_refused(saved, name):
    rewrite(saved, drop=(name,))
    with pytest.raises(ValueError, match=rf"policy\.npz: expected a complete policy, .*{name}"):
        load_policy(saved, BROKK_170)


def test_weights_that_do_not_fit_are_refused(saved, policy):
    rewrite(saved, weight_2=policy.weights[2][:, :-1])
    with pytest.raises(ValueError, match=r"policy\.npz: expected a complete policy, got"):
        load_policy(saved, BROKK_170)


def test_too_few_actions_are_refused(saved, policy):
    rewrite(saved, weight_6=policy.weights[6][:, :3], weight_7=policy.weights[7][:3])
    with pytest.raises(ValueError, match=r"policy\.npz: weights: expected 4 actions, got"):
        load_policy(saved, BROKK_170)


def test_weights_that_are_no_numbers_are_refused(saved, policy):
    rewrite(saved, weight_7=np.full(4, np.nan, np.float32))
    with pytest.raises(ValueError, match=r"policy\.npz: weights: expected 4 actions, got \[nan"):
        load_policy(saved, BROKK_170)


@pytest.mark.parametrize("header", [{"format": 99}, {"format": 0}, {"kind": "actuator net"}])
def test_another_format_or_kind_is_refused(saved, header):
    rewrite(saved, header)
    wanted = rf"expected \(policy, format \d+\), got .*{next(iter(header.values()))}"
    with pytest.raises(ValueError, match=wanted):
        load_policy(saved, BROKK_170)


@pytest.mark.parametrize("entry", ["contract", "training"])
def test_a_header_that_lacks_an_entry_is_refused(saved, entry):
    with np.load(saved) as file:
        arrays = dict(file)
    header = json.loads(str(arrays["header"]))
    del header[entry]
    np.savez(saved, **(arrays | {"header": np.array(json.dumps(header))}))
    with pytest.raises(ValueError, match=r"policy\.npz: .*expected .*, got"):
        load_policy(saved, BROKK_170)


def test_a_file_without_a_header_is_refused(saved):
    np.savez(saved, weight_0=np.zeros(3))
    with pytest.raises(ValueError, match=r"policy\.npz: expected a file with a JSON header, got"):
        load_policy(saved, BROKK_170)


def test_a_pickle_is_refused_and_not_run(tmp_path):
    path = tmp_path / "policy.npz"
    np.savez(path, header=np.array({"kind": "policy"}, dtype=object))
    with pytest.raises(
        ValueError, match=r"policy\.npz: expected a readable \.npz file, got .*pickle"
    ):
        load_policy(path, BROKK_170)


def test_no_file_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"none\.npz: expected a readable \.npz file, got"):
        load_policy(tmp_path / "none.npz", BROKK_170)


@pytest.mark.parametrize("shape", [(), (170,), (171, 1), (3, 172)])
def test_act_refuses_wrong_shapes(policy, shape):
    with pytest.raises(ValueError, match=r"observation: expected \(\.\.\., 171\), got \("):
        policy.act(np.zeros(shape))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_act_refuses_what_is_no_number(policy, bad):
    observation = np.zeros((2, 171))
    observation[1, 40] = bad
    with pytest.raises(ValueError, match="observation: expected finite numbers, got"):
        policy.act(observation)
