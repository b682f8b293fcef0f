"""Many seeds: nothing is done twice; their table."""

import json
from dataclasses import replace

import numpy as np
import pytest
from helpers_cli import run
from helpers_machines import POSE, one_by_one, short_axes, small_net

from brokk_min.evaluation import metrics, sweep
from brokk_min.identification.net_file import save_net
from brokk_min.learning.checkpoint import train_policy
from brokk_min.learning.recipes import Recipe
from brokk_min.machine import BROKK_170
from brokk_min.settings import PPOConfig, TaskConfig

TINY = PPOConfig(num_envs=4, horizon=4, epochs=1, minibatch_size=16, total_steps=32)
RECIPE = Recipe("paper", True, TaskConfig(episode_s=0.6), TINY)
NET = small_net(BROKK_170, np.random.default_rng(0))
POSES = POSE + 0.1 * np.random.default_rng(0).random((2, 5))
SEQUENCES = short_axes(10)


@pytest.fixture(autouse=True)
def short(monkeypatch):
    """One process, and sequences of half a second from poses that need no search."""
    monkeypatch.setattr(sweep, "side_by_side", one_by_one)
    monkeypatch.setattr(sweep, "evaluation_starts", lambda machine, num, *_: POSES[:num])
    monkeypatch.setattr(sweep, "task_sequences", lambda machine: SEQUENCES)


def rows(error):
    """Two sequences from two starts."""
    of = [{"start": i} | dict.fromkeys(metrics.COLUMNS, error + i) for i in (0, 1)]
    return [{"controller": "rl", "sequence": s} | row for s in "xy" for row in of]


def test_sweep__counts_a_seed_once(tmp_path, monkeypatch, capsys):
    """By its command, of two seeds."""
    done = {"5": rows(1.0), "6": rows(3.0)}
    monkeypatch.setattr(sweep, "side_by_side", lambda jobs, *_: {seed: done[seed] for seed in jobs})
    save_net(tmp_path / "net.npz", NET)
    assert run(f"sweep --actuator {tmp_path}/net.npz --out {tmp_path}/s --seeds 2 --seed 5") == 0
    # two seeds, 1.5 and 3.5: half of 12.7062 x sqrt(2) / sqrt(2) x 2
    assert "velocity_error_mean      2.5 (-10.21 to 15.21)" in capsys.readouterr().out
    table = json.loads((tmp_path / "s" / "sweep.json").read_text())["table"]
    expected = {"mean": 2.5, "low": -10.2062, "high": 15.2062}
    assert list(table) == ["x", "y", "all"]
    assert all(of[key] == pytest.approx(expected, abs=1e-4) for of in table.values() for key in of)


def test_sweep__trains_and_scores_each_seed_once(tmp_path):
    """And refuses to go on from policies of another training."""
    arguments = (BROKK_170, NET, RECIPE, [3, 4], tmp_path / "new", 2)
    table = sweep.sweep(*arguments)
    names = [f"seed_{n}.{end}" for n in (3, 4) for end in ("npz", "npz.csv")]
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == [*names, "sweep.json"]
    times = [(tmp_path / "new" / name).stat().st_mtime_ns for name in names]
    assert sweep.sweep(*arguments) == table
    assert [(tmp_path / "new" / name).stat().st_mtime_ns for name in names] == times
    policy = train_policy(BROKK_170, NET, RECIPE, 4, tmp_path / "alone.npz")
    assert (tmp_path / "new/seed_4.npz").read_bytes() == (tmp_path / "alone.npz").read_bytes()
    alone, _ = metrics.evaluate(BROKK_170, {"rl": policy}, SEQUENCES, POSES, 0)
    written = json.loads((tmp_path / "new" / "sweep.json").read_text())["runs"]
    assert [row["seed"] for row in written] == [3] * 6 + [4] * 6
    assert written[6:] == [{"seed": 4} | row for row in alone]
    other = replace(RECIPE, task=TaskConfig(episode_s=0.8))
    with pytest.raises(ValueError, match=r"seed_4\.npz: recipe: expected .*0\.8.*, got .*0\.6"):
        sweep.run_seed(BROKK_170, NET, other, tmp_path / "new", 2, 4)
