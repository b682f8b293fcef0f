"""Training with files: the same bits after an interruption, curves, refusals, a full disk."""

import csv
import json
import os
import signal
from dataclasses import replace
from shutil import copytree

import numpy as np
import pytest
import torch
from helpers_machines import obedient_net, small_net

from brokk_min.env import TaskConfig
from brokk_min.learning.checkpoint import (
    TrainingLog,
    export_policy,
    stagger_episodes,
    train_policy,
    use_fast_float32,
)
from brokk_min.learning.episodes import GRADIENT_LEARNER, PAPER_TASK, get_obs
from brokk_min.learning.gym_env import TaskVectorEnv
from brokk_min.learning.policy import load_policy, save_policy
from brokk_min.machine import BROKK_170
from brokk_min.ppo import PPOConfig, make_learner

TINY = replace(PPOConfig(**GRADIENT_LEARNER), num_envs=8, horizon=8, minibatch_size=32)
TINY = replace(TINY, total_steps=4 * 64, checkpoint_every=2)
TASK = TaskConfig(episode_s=0.6)  # 12 ticks: episodes end within the first updates
NET = small_net(BROKK_170, np.random.default_rng(0))


def run(path, machine=BROKK_170, net=NET, task=TASK, config=TINY, seed=5, **options):
    return train_policy(machine, net, task, config, seed, path, **options)


def read_curve(path):
    with open(f"{path}.csv", newline="") as file:
        return [
            {name: value for name, value in row.items() if name != "charts/SPS"}
            for row in csv.DictReader(file)
        ]


def fail_at_tick(patch, tick, change):
    """Change the result of the environment's step at one tick of a training."""
    step, ticks = TaskVectorEnv.step, [0]

    def changed(self, actions):
        ticks[0] += 1
        result = step(self, actions)
        return change(*result) if ticks[0] == tick else result

    patch.setattr(TaskVectorEnv, "step", changed)


def interrupt(*_):
    raise KeyboardInterrupt


@pytest.fixture(scope="module")
def straight(tmp_path_factory):
    path = tmp_path_factory.mktemp("straight") / "p.npz"
    run(path)
    return path


@pytest.fixture(scope="module")
def interrupted(tmp_path_factory):
    """A training that was interrupted in its fourth update, two after its checkpoint."""
    folder = tmp_path_factory.mktemp("interrupted")
    with pytest.MonkeyPatch.context() as patch:
        fail_at_tick(patch, 30, interrupt)
        with pytest.raises(KeyboardInterrupt):
            run(folder / "p.npz")
    assert sorted(os.listdir(folder)) == ["p.npz.checkpoint", "p.npz.csv"]
    return folder


@pytest.fixture
def broken(interrupted, tmp_path):
    copytree(interrupted, tmp_path, dirs_exist_ok=True)
    return tmp_path / "p.npz"


@pytest.mark.parametrize("critic", [False, True])
def test_train_policy__writes_a_policy_and_its_curve(tmp_path, critic):
    policy = run(tmp_path / "p.npz", critic=critic)
    again = load_policy(tmp_path / "p.npz", BROKK_170)
    assert all(map(np.array_equal, policy.weights, again.weights))
    assert again.training["seed"] == 5
    assert again.training["task"]["episode_s"] == 0.6
    settings = again.training["settings"]
    assert (settings["horizon"], settings["critic"]) == (8, critic)
    assert settings["log_std_end"] == (None if critic else -4.5)
    curve = read_curve(tmp_path / "p.npz")
    assert [row["global_step"] for row in curve] == ["64", "128", "192", "256"]
    names = {"policy_loss", "value_loss", "entropy", "approx_kl", "clipfrac"}
    names |= {"explained_variance"} if critic else set()
    charts = {"reward", "velocity_error", "learning_rate", "episodic_return", "episodic_length"}
    columns = {f"losses/{name}" for name in names} | {f"charts/{name}" for name in charts}
    assert set(curve[0]) == columns | {"global_step"}
    assert all(np.isfinite(float(value)) for row in curve for value in row.values())
    assert sorted(os.listdir(tmp_path)) == ["p.npz", "p.npz.csv"]


def test_train_policy__starts_from_a_policy(tmp_path, straight):
    begun = load_policy(straight, BROKK_170)
    still = replace(TINY, learning_rate=1e-9)
    policy = run(tmp_path / "p.npz", config=still, start=begun)
    for ours, theirs in zip(policy.weights, begun.weights, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-6)
    assert len(policy.training["start"]) == 16
    with pytest.raises(ValueError, match="start: expected a policy of the same kind"):
        run(tmp_path / "q.npz", task=replace(TASK, paper=True), start=begun)


def test_export_policy__is_the_actor_of_the_papers_agent_through_a_file(tmp_path):
    task = replace(TASK, paper=True)
    env = TaskVectorEnv(8, NET, BROKK_170, task)
    agent = make_learner(env, TINY, 0, critic=True).agent
    agent.actor[-1].weight.data *= 100
    save_policy(tmp_path / "p.npz", export_policy(NET, agent, task, {}), BROKK_170)
    policy = load_policy(tmp_path / "p.npz", BROKK_170)
    obs = get_obs(BROKK_170, task, env.state, np.random.default_rng(7))
    expected = agent.actor(torch.from_numpy(obs)).detach().numpy()
    np.testing.assert_allclose(policy.act(obs), expected, atol=1e-5)
    assert np.abs(expected).max() > 0.1 and policy.paper


def test_train_policy__of_the_paper_learns_values_with_its_own_settings(tmp_path):
    """29,000 steps: 0.3 of the variance of returns explained, the velocity error 5 % less."""
    config = PPOConfig(num_envs=64, minibatch_size=512, total_steps=14 * 2048, threads=1)
    task = TaskConfig(paper=True, **PAPER_TASK)
    run(tmp_path / "p.npz", net=obedient_net(BROKK_170), task=task, config=config)
    rows = read_curve(tmp_path / "p.npz")
    explained = [float(row["losses/explained_variance"]) for row in rows]
    errors = [float(row["charts/velocity_error"]) for row in rows]
    assert np.mean(explained[-5:]) > 0.3 > explained[0], explained
    assert np.mean(errors[-5:]) < 0.95 * np.mean(errors[:5]), errors


def test_train_policy__learns_a_little(tmp_path):
    """On nets that obey at once, 12,000 steps already beat the start."""
    config = replace(TINY, num_envs=64, horizon=16, total_steps=12 * 1024, epochs=4)
    config = replace(config, minibatch_size=256, learning_rate=2e-3, gamma=0.5)
    net, task = obedient_net(BROKK_170), TaskConfig(episode_s=5.0)
    run(tmp_path / "p.npz", net=net, config=config, task=task)
    errors = [float(row["charts/velocity_error"]) for row in read_curve(tmp_path / "p.npz")]
    assert np.mean(errors[-4:]) < 0.85 * np.mean(errors[:2]), errors


def test_use_fast_float32__keeps_the_digits_of_float32():
    use_fast_float32()  # an Intel processor with AMX would otherwise have three digits
    a = torch.randn(256, 256, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close((a @ a).double(), a.double() @ a.double(), atol=1e-3, rtol=0)


def test_stagger_episodes__ends_them_one_after_the_other():
    env = TaskVectorEnv(8, NET, BROKK_170, TaskConfig(episode_s=2.0))
    env.reset(seed=0)
    stagger_episodes(env)
    ended = np.array([env.step(np.zeros((8, 4)))[3] for _ in range(80)])
    assert ended.sum(axis=0).tolist() == [2] * 8
    assert ended.sum(axis=1).max() == 1
    assert np.diff(np.flatnonzero(ended.any(axis=1))).tolist() == [5] * 15


def test_stagger_episodes__of_the_papers_agent_ends_starts_in_the_ground():
    env = TaskVectorEnv(256, NET, BROKK_170, TaskConfig(paper=True))
    env.reset(seed=0)
    ground = env.state.lowest < BROKK_170.ground
    stagger_episodes(env)
    ended = env.step(np.zeros((256, 4)))[2]
    assert 5 < ground.sum() < 30
    assert ended.sum() == ground.sum()


def test_count_episodes__means_return_and_length_of_those_that_ended(tmp_path):
    log = TrainingLog(TaskVectorEnv(2, NET), TINY, tmp_path / "p.npz", {}, None)
    rewards = np.array([[1.0, 10.0], [2.0, 20.0], [4.0, 40.0]])
    log.count_episodes(rewards, np.array([[False, False], [True, False], [False, True]]))
    assert log.episodes == {"charts/episodic_return": 36.5, "charts/episodic_length": 2.5}
    log.count_episodes(rewards[:1], np.zeros((1, 2), bool))
    assert log.episodes["charts/episodic_return"] == 36.5  # none ended
    log.count_episodes(rewards[:1], np.array([[True, False]]))
    assert log.episodes == {"charts/episodic_return": 6.0, "charts/episodic_length": 3.0}


def test_train_policy__writes_for_tensorboard_or_says_what_is_missing(tmp_path, monkeypatch):
    pytest.importorskip("tensorboard")
    run(tmp_path / "p.npz", tensorboard=tmp_path / "board")
    (events,) = (tmp_path / "board").iterdir()
    assert b"charts/reward" in events.read_bytes()
    monkeypatch.setitem(os.sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(ValueError, match=r"brokk_min\[tensorboard\]"):
        run(tmp_path / "p.npz", tensorboard=tmp_path / "board")


@pytest.mark.parametrize(("tick", "critic"), [(4, False), (17, False), (30, False), (30, True)])
def test_train_policy__resumes_to_the_same_bytes(
    tmp_path, monkeypatch, capsys, straight, tick, critic
):
    if critic:
        straight = tmp_path / "straight.npz"
        run(straight, critic=True)
    path = tmp_path / "p.npz"
    with monkeypatch.context() as patch:
        fail_at_tick(patch, tick, interrupt)
        with pytest.raises(KeyboardInterrupt):
            run(path, critic=critic)
    assert not path.exists()
    assert (tmp_path / "p.npz.checkpoint").exists() == (tick > 16)
    run(path, critic=critic, resume=True)
    assert path.read_bytes() == straight.read_bytes()
    assert read_curve(path) == read_curve(straight)
    assert not (tmp_path / "p.npz.checkpoint").exists()
    warned = "p.npz.checkpoint: no checkpoint, training starts from" in capsys.readouterr().err
    assert warned == (tick <= 16)


def test_train_policy__saves_all_updates_when_it_is_interrupted(tmp_path, monkeypatch, straight):
    """Ctrl-C is answered after the update, also where no checkpoint is due."""

    def press(*result):
        signal.raise_signal(signal.SIGINT)
        return result

    before = signal.getsignal(signal.SIGINT)
    with monkeypatch.context() as patch:
        fail_at_tick(patch, 20, press)
        with pytest.raises(KeyboardInterrupt, match=r"p\.npz\.checkpoint is saved, .* --resume$"):
            run(tmp_path / "p.npz")
    assert signal.getsignal(signal.SIGINT) == before
    assert len(read_curve(tmp_path / "p.npz")) == 3
    run(tmp_path / "p.npz", resume=True)
    assert (tmp_path / "p.npz").read_bytes() == straight.read_bytes()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": 6}, r"seed: expected 6, got 5"),
        ({"machine": replace(BROKK_170, dead_zone=0.05)}, r"dead_zone: expected 0\.05, got 0\.07"),
        ({"config": replace(TINY, gamma=0.5)}, r"settings\.gamma: expected 0\.5, got 0\.95"),
        ({"task": TaskConfig(episode_s=0.7)}, r"task\.episode_s: expected 0\.7, got 0\.6"),
        ({"critic": True}, r"settings\.log_std_end: expected None, got -4\.5"),
        ({"net": replace(NET, output_high=2 * NET.output_high)}, r"actuator: expected '\w+', got"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_train_policy__refuses_the_checkpoint_of_another_training(broken, change, message):
    checkpoint = broken.with_name("p.npz.checkpoint")
    data = checkpoint.read_bytes()
    with pytest.raises(ValueError, match=r"p\.npz\.checkpoint: " + message):
        run(broken, resume=True, **change)
    assert checkpoint.read_bytes() == data


def test_train_policy__resumes_a_checkpoint_from_before_an_option(broken, straight):
    checkpoint = broken.with_name("p.npz.checkpoint")
    content = torch.load(checkpoint, weights_only=True)
    header = json.loads(content["header"])
    del header["identity"]["task"]["limit_cost"]
    torch.save(content | {"header": json.dumps(header)}, checkpoint)
    run(broken, resume=True)
    assert read_curve(broken) == read_curve(straight)


def test_train_policy__wants_resume_and_checkpoint_and_curve_of_this_version(broken):
    """`tests/fuzz.py` makes the other bad checkpoints."""
    checkpoint = broken.with_name("p.npz.checkpoint")
    good = checkpoint.read_bytes()
    with pytest.raises(ValueError, match=r"checkpoint: expected --resume or no checkpoint, got"):
        run(broken)
    assert checkpoint.read_bytes() == good
    content = torch.load(checkpoint, weights_only=True)
    torch.save(content | {"header": '{"format": 0, "identity": {}}'}, checkpoint)
    with pytest.raises(ValueError, match=r"p\.npz\.checkpoint: format: expected 6, got 0"):
        run(broken, resume=True)
    weights = len(good) // 2
    checkpoint.write_bytes(good[:weights] + bytes([good[weights] ^ 1]) + good[weights + 1 :])
    with pytest.raises(ValueError, match=r"p\.npz\.checkpoint: expected a readable checkpoint"):
        run(broken, resume=True)
    checkpoint.write_bytes(good)
    broken.with_name("p.npz.csv").unlink()
    with pytest.raises(ValueError, match=r"p\.npz\.csv: expected the curve of the checkpoint, got"):
        run(broken, resume=True)
