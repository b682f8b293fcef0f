"""Training with files: the same bits after an interruption, curves, refusals."""

import os
import sys
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers_machines import obedient_net, small_net

from brokk_min._files import read_csv
from brokk_min.beyond.group_advantages import GroupVectorEnv, group_advantages
from brokk_min.beyond.interface import INTERFACE
from brokk_min.beyond.muon import Muon
from brokk_min.env import PAPER, TaskConfig
from brokk_min.learning.checkpoint import prepare, quick_products, train_policy
from brokk_min.learning.gym_env import TaskVectorEnv
from brokk_min.learning.policy import load_policy
from brokk_min.learning.recipes import find_recipe
from brokk_min.machine import BROKK_170
from brokk_min.ppo import critic_advantages

SMALL = {"num_envs": 8, "horizon": 8, "minibatch_size": 32, "total_steps": 256}
TASK = TaskConfig(episode_s=0.6)  # 12 ticks: episodes end within the first updates
RECIPES = {
    kind: replace(recipe, task=TASK, learner=replace(recipe.learner, **SMALL))
    for kind, recipe in (("ours", find_recipe()), ("paper", find_recipe(paper=True, critic=True)))
}
NET = small_net(BROKK_170, np.random.default_rng(0))


@pytest.fixture(autouse=True)
def often(monkeypatch):
    """Checkpoints at every other update."""
    monkeypatch.setattr("brokk_min.learning.checkpoint.EVERY", 2)


def run(path, kind="ours", seed=5, net=NET, look=None, machine=BROKK_170):
    return train_policy(machine, net, RECIPES[kind], seed, path, look)


def run_until_interrupted(path, kind="ours"):
    """Up to tick 30: in the fourth update, two after a checkpoint."""
    step, ticks = TaskVectorEnv.step, iter(range(30))

    def interrupted(self, actions):
        if next(ticks) == 29:
            raise KeyboardInterrupt
        return step(self, actions)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TaskVectorEnv, "step", interrupted)
        with pytest.raises(KeyboardInterrupt):
            run(path, kind)


@pytest.mark.parametrize("critic", [False, True])
@pytest.mark.parametrize("paper", [False, True])
def test_prepare__begins_what_the_recipe_says(paper, critic):
    """Groups step by Muon, a critic by Adam; episodes end one after the other."""
    recipe = find_recipe(paper, critic)
    env, advantages, start = prepare(BROKK_170, NET, recipe, seed=3)
    task, state = env.unwrapped.task, env.unwrapped.episodes.state
    assert task.interface is (PAPER if paper else INTERFACE)
    assert isinstance(env, GroupVectorEnv) != critic
    assert advantages is (critic_advantages if critic else group_advantages)
    assert isinstance(start.optimizer, Muon) != critic
    assert len(np.unique(state.ticks)) > 100 and state.ticks.max() > 0.95 * 400
    assert not state.ticks[state.lowest < 0].any()
    assert start.obs.shape == (256, len(task.interface.scale(BROKK_170)[0]))


def test_quick_products__are_in_single_precision_and_end_with_the_training():
    a, b = torch.randn(2, 300, 300)
    with quick_products():
        product = a @ b
    assert (product - a.double() @ b.double()).abs().max() < 1e-3  # bfloat16 is off by 0.1
    assert torch.get_float32_matmul_precision() == "highest"


@pytest.mark.parametrize("kind", ["ours", "paper"])
def test_train_policy__goes_on_after_an_interruption_to_the_same_files(tmp_path, kind):
    """To look at the policy meanwhile changes nothing."""
    seen = []
    straight = run(tmp_path / "straight.npz", kind, look=seen.append)
    assert len(seen) == 4 and all(map(np.array_equal, seen[-1].weights, straight.weights))
    path = tmp_path / "p.npz"
    run_until_interrupted(path, kind)
    assert os.path.exists(f"{path}.checkpoint") and not path.exists()
    torch.manual_seed(99)
    run(path, kind)
    for end in ("npz", "npz.csv"):
        assert (tmp_path / f"p.{end}").read_bytes() == (tmp_path / f"straight.{end}").read_bytes()
    assert not os.path.exists(f"{path}.checkpoint")
    again = load_policy(path, BROKK_170)
    assert all(map(np.array_equal, straight.weights, again.weights))
    assert (again.interface, again.training["seed"]) == (RECIPES[kind].interface, 5)
    curve = read_csv(f"{path}.csv", "losses/policy_loss", "charts/reward", "charts/velocity_error")
    assert curve["global_step"].tolist() == ["64", "128", "192", "256"]
    assert all(np.isfinite(column.astype(float)).all() for column in curve.values())


def test_train_policy__stops_where_another_training_goes_on_with_its_checkpoint(tmp_path):
    path, checkpoint = tmp_path / "p.npz", tmp_path / "p.npz.checkpoint"

    def look(policy):
        if checkpoint.exists():
            os.utime(checkpoint, (1, 1))  # as if another had written it
        return ""

    with pytest.raises(ValueError, match=r"checkpoint: expected one training with this name, got "):
        run(path, look=look)
    assert not path.exists()


def test_checkpoint__is_refused_where_it_does_not_belong(tmp_path):
    path = tmp_path / "p.npz"
    run_until_interrupted(path)
    with pytest.raises(ValueError, match="seed: expected 6, got 5"):
        run(path, seed=6)
    with pytest.raises(ValueError, match="actuator: expected"):
        run(path, net=obedient_net(BROKK_170))
    faster = replace(BROKK_170, tool_speed=0.5)  # other goals, and another scale of what it sees
    with pytest.raises(ValueError, match=r"checkpoint: tool_speed: expected 0\.5, got"):
        run(path, machine=faster)
    checkpoint = tmp_path / "p.npz.checkpoint"
    checkpoint.write_bytes(checkpoint.read_bytes()[:5000])
    with pytest.raises(ValueError, match=rf"^{checkpoint}: expected a readable checkpoint, got "):
        run(path)


def test_train_policy__goes_on_if_nobody_reads_what_it_prints(tmp_path, monkeypatch):
    with suppress(OSError), open("/dev/full", "w", buffering=1) as lost:
        monkeypatch.setattr(sys, "stdout", lost)
        run(tmp_path / "p.npz", look=lambda policy: "well")
    monkeypatch.undo()
    assert load_policy(tmp_path / "p.npz", BROKK_170).training["seed"] == 5


def test_checkpoint__executes_nothing(tmp_path):
    """A pickle that would create a file is refused, and creates none."""
    path = tmp_path / "p.npz"

    class Evil:
        def __reduce__(self):
            return open, (str(tmp_path / "created"), "w")

    torch.save({"about": Evil()}, f"{path}.checkpoint")
    with pytest.raises(ValueError, match="expected a readable checkpoint"):
        run(path)
    assert not (tmp_path / "created").exists()
