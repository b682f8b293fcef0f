"""Many seeds: nothing is done twice; their table."""

import json
from dataclasses import replace

import numpy as np
import pytest
from helpers_bus import random_policy
from helpers_cli import run
from helpers_machines import POSE, one_by_one, pids, short_axes, small_net

from brokk_min._files import digest
from brokk_min.evaluation import adaptive, metrics, reproduce, sweep
from brokk_min.evaluation.baselines import gains_metadata, write_gains
from brokk_min.identification.net_file import save_net
from brokk_min.learning.policy import POLICIES, load_policy, save_policy
from brokk_min.learning.recipes import find_recipe
from brokk_min.machine import BROKK_170

NET = small_net(BROKK_170, np.random.default_rng(0))
POSES = POSE + 0.1 * np.random.default_rng(0).random((2, 5))
SEQUENCES = short_axes(10)
PAPER = find_recipe(paper=True, critic=True)
TINY = {"num_envs": 4, "horizon": 4, "epochs": 1, "minibatch_size": 16, "total_steps": 32}
RECIPE = replace(PAPER, learner=replace(PAPER.learner, **TINY))
OPTIONS = " ".join(f"--{name.replace('_', '-')} {value}" for name, value in TINY.items())
ERROR = "velocity_error_mean"


def test_sweep__trains_and_scores_each_seed_once(tmp_path, monkeypatch, capsys):
    """By its command, from poses that need no search; another training's policies are refused.

    Robustness is over seeds for them and over starts for the others.
    """
    monkeypatch.setattr(sweep, "side_by_side", one_by_one)
    monkeypatch.setattr(sweep, "evaluation_starts", lambda machine, num, *_: POSES[:num])
    for name in ("task_sequences", "axis_sequences"):
        monkeypatch.setattr(sweep, name, lambda machine: SEQUENCES)
    monkeypatch.setattr(reproduce, "variations", lambda machine: {"nominal": machine})
    monkeypatch.setattr(adaptive, "DRIVES", 2)
    net, out, beside = (tmp_path / name for name in ("net.npz", "out", "beside"))
    save_net(net, NET)
    command = f"sweep --actuator {net} --out {out} --seeds 2 --seed 3 --num-starts 2"
    command = f"{command} --paper --critic {OPTIONS}"
    assert run(command) == 0
    printed = capsys.readouterr().out
    names = [f"seed_{n}.{end}" for n in (3, 4) for end in ("npz", "npz.csv")]
    assert sorted(path.name for path in out.iterdir()) == [*names, "seeds.json", "sweep.json"]
    times = [(out / name).stat().st_mtime_ns for name in names]
    beside.mkdir()
    for name in ("rl_paper", "rl_critic"):
        save_policy(beside / POLICIES[name], random_policy("paper"))
    given = pids(BROKK_170, NET)
    write_gains(beside / "gains.json", given, gains_metadata(BROKK_170, NET))
    assert run(f"{command} --robustness {beside}") == 0
    assert capsys.readouterr().out == printed
    assert [(out / name).stat().st_mtime_ns for name in names] == times
    policy = load_policy(out / "seed_4.npz", BROKK_170)
    assert policy.training["seed"] == 4
    alone, _ = metrics.evaluate(BROKK_170, {"rl": policy}, SEQUENCES, POSES, 0)
    written = json.loads((out / "sweep.json").read_text())
    assert [row["seed"] for row in written["runs"]] == [3] * 6 + [4] * 6
    assert written["runs"][6:] == [{"seed": 4} | row for row in alone]
    assert list(written["table"]) == ["x", "y", "z", "all", "along"]
    assert json.loads((out / "seeds.json").read_text()) == {
        key: written[key] for key in ("meta", "table")
    }
    assert written["meta"]["seeds"] == [3, 4]
    seeds = np.reshape([row[ERROR] for row in written["runs"]], (2, 6)).mean(axis=1)
    mean = metrics.mean_interval(seeds)  # a seed counts once
    assert written["table"]["all"][ERROR] == pytest.approx(mean)
    assert written["table"]["along"] == written["table"]["all"]  # of x, y and z alone
    assert f"{ERROR:24} {metrics.interval_text(mean)}\n" in printed

    varied = json.loads((out / "robustness.json").read_text())
    cases, files = varied["robustness"], varied["meta"]["files"]
    used = ["seed_3.npz", "seed_4.npz", "policy_paper.npz", "policy_critic.npz", "gains.json"]
    assert list(files) == used and files["seed_4.npz"] == digest(out / "seed_4.npz")
    plain = ["rl", "rl_paper", "rl_critic", *given]
    every = sorted(f"{n}{s}" for n in plain for s in ("", "+cold", "+warm"))
    assert sorted(cases["nominal"]) == every
    assert cases["nominal"]["rl"] == pytest.approx(mean)
    pid = given["pid_by_hand"]
    runs, _ = metrics.evaluate(BROKK_170, {"pid": pid}, SEQUENCES, POSES, 0, noise=0.1)
    expected = metrics.mean_interval(metrics.by_start(runs, "pid", "all", ERROR))
    assert cases["twice the sensor noise"]["pid_by_hand"] == pytest.approx(expected)

    other = replace(RECIPE, task=replace(RECIPE.task, episode_s=0.8))
    told = r"seed_4\.npz: recipe: task: episode_s: expected 0\.8, got 20\.0"
    with pytest.raises(ValueError, match=told):
        sweep.run_seed(BROKK_170, NET, other, out, 2, 4)
    (out / "seed_3.npz").rename(out / "seed_7.npz")
    with pytest.raises(ValueError, match=r"seed_7\.npz: seed: expected 7, got 3"):
        sweep.run_seed(BROKK_170, NET, RECIPE, out, 2, 7)
    with pytest.raises(ValueError, match=r"of `reproduce`, with policy_paper\.npz, got none"):
        sweep.sweep(BROKK_170, NET, RECIPE, [8], tmp_path / "new", 2, beside=out)
    (out / "policy_paper.npz").write_bytes((beside / "policy_paper.npz").read_bytes())
    (out / "policy_critic.npz").write_bytes((beside / "policy_critic.npz").read_bytes())
    (out / "gains.json").write_text((beside / "gains.json").read_text())
    other_net = small_net(BROKK_170, np.random.default_rng(1))
    with pytest.raises(ValueError, match=r"gains\.json: actuator: expected"):
        sweep.sweep(BROKK_170, other_net, RECIPE, [8], tmp_path / "new", 2, beside=out)
    assert not (tmp_path / "new").exists()  # it was said before the trainings
    (beside / "sweep.json").write_text("of somebody else")
    assert run(f"{command} --out {beside}") == 2
    assert "got one that `sweep` did not write" in capsys.readouterr().err
