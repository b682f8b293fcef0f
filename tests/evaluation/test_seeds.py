"""Many seeds: nothing is done twice, a failure costs one seed; their table."""

import json

import numpy as np
import pytest
from helpers_cli import run
from helpers_machines import POSE, small_net

from brokk_min.env import TaskConfig
from brokk_min.evaluation import seeds
from brokk_min.evaluation.baselines import gains_metadata
from brokk_min.evaluation.seeds import run_seeds
from brokk_min.evaluation.sequences import axis_sequences
from brokk_min.identification.net_file import save_net
from brokk_min.learning.checkpoint import train_policy
from brokk_min.learning.policy import PolicyController
from brokk_min.machine import BROKK_170
from brokk_min.ppo import PPOConfig

distributed = pytest.importorskip("distributed")
TINY = PPOConfig(num_envs=4, horizon=4, epochs=1, minibatch_size=16, total_steps=32, threads=1)
TASK = TaskConfig(episode_s=0.6)
NET = small_net(BROKK_170, np.random.default_rng(0))


@pytest.fixture
def short(monkeypatch):
    """Sequences of half a second, from poses that need no search."""
    poses = POSE + 0.1 * np.random.default_rng(0).random((2, 5))
    sequences = [
        s._replace(goals=s.goals[s.goals.any(axis=1)][:10]) for s in axis_sequences(BROKK_170)
    ]
    monkeypatch.setattr(seeds, "evaluation_starts", lambda machine, num, *_: poses[:num])
    monkeypatch.setattr(seeds, "task_sequences", lambda machine: sequences)


def test_run_seed__trains_as_train_policy_and_writes_the_rows_of_its_policy(tmp_path, short):
    rows = seeds.run_seed(BROKK_170, NET, TASK, TINY, False, tmp_path, 2, 4)
    policy = train_policy(BROKK_170, NET, TASK, TINY, 4, tmp_path / "alone.npz")
    assert (tmp_path / "seed_4.npz").read_bytes() == (tmp_path / "alone.npz").read_bytes()
    controllers = {"rl": PolicyController(BROKK_170, policy)}
    assert rows == seeds.run_scored(BROKK_170, controllers, 2)
    written = json.loads((tmp_path / "seed_4.json").read_text())
    assert written["runs"] == rows
    assert written["identity"]["seed"] == 4
    assert written["identity"]["starts"] == 2


@pytest.fixture(scope="module")
def cluster():
    options = {"n_workers": 1, "processes": False, "dashboard_address": ":0", "protocol": "tcp"}
    with distributed.LocalCluster(threads_per_worker=1, **options) as cluster:
        yield cluster.scheduler_address


def test_run_seeds__refuse_workers_of_several_threads():
    options = {"n_workers": 1, "processes": False, "dashboard_address": ":0", "protocol": "tcp"}
    with distributed.LocalCluster(threads_per_worker=2, **options) as cluster:
        message = r"tcp.*: expected workers with --nthreads 1, got \[2\]"
        with pytest.raises(ValueError, match=message):
            run_seeds(list, [1], cluster.scheduler_address)


def rows(error, controller="rl"):
    """Three sequences from three starts, of which two count."""
    figures = {"off_axis_drift_max": 2.0 * error, "jerk_rms": 4.0, "valve_travel": 10.0}
    starts = (("workspace", error), ("limits", 99.0), ("workspace", error + 1))
    return [
        {"controller": controller, "sequence": s, "start": i, "kind": kind}
        | {"velocity_error_mean": e, **figures}
        for s in "xyz"
        for i, (kind, e) in enumerate(starts)
    ]


def test_table__counts_a_seed_once():
    figures = seeds.table([rows(1.0), rows(3.0)], rows(5.0, "pid"))
    assert list(figures) == ["rl", "pid", "rl less pid"]
    for name in ("velocity_error_x", "velocity_error_all"):
        # two seeds, 1.5 and 3.5: half of 12.7062 x sqrt(2) / sqrt(2) x 2
        expected = {"mean": 2.5, "low": -10.2062, "high": 15.2062}
        assert figures["rl"][name] == pytest.approx(expected, abs=1e-4)
        assert figures["pid"][name] == {"mean": 5.5, "low": None, "high": None}
        assert figures["rl less pid"][name]["mean"] == -3.0
        assert figures["rl less pid"][name]["high"] == pytest.approx(12.7062 - 3.0, abs=1e-4)
    assert figures["rl"]["off_axis_drift_max"]["mean"] == 4.0
    assert list(seeds.table([], rows(5.0, "pid"))) == ["pid"]


def test_read_seeds__reads_what_a_sweep_wrote(tmp_path):
    path = tmp_path / "sweep.json"
    figures = seeds.table([rows(1.0), rows(3.0)], [])
    meta = gains_metadata(BROKK_170, NET)
    path.write_text(json.dumps({"meta": meta, "table": figures}))
    assert seeds.read_seeds(path, meta) == seeds.read_seeds(path, {}) == figures
    with pytest.raises(ValueError, match=r"sweep.json: actuator: expected 'other', got '"):
        seeds.read_seeds(path, meta | {"actuator": "other"})


def test_sweep__writes_all_runs_and_does_nothing_twice(tmp_path, short, cluster, capsys):
    save_net(tmp_path / "net.npz", NET)
    folder = tmp_path / "a" / "b"
    names = [f"seed_{n}.{end}" for n in (3, 4) for end in ("json", "npz", "npz.csv")]
    line = f"sweep --actuator '{tmp_path}/net.npz' --seed 3 --seeds 2 --poses 2 --episode-s 0.6"
    line += " --total-steps 32 --num-envs 4 --horizon 4 --epochs 1 --minibatch-size 16 --scheduler"
    sweep = [f"{line} {cluster} --out", folder]
    assert run(*sweep) == 0
    assert capsys.readouterr().out.startswith("mean and 95 % interval")
    assert sorted(path.name for path in folder.iterdir()) == [*names, "sweep.json"]
    (folder / "seed_4.json").unlink()  # its policy is not trained again
    kept = [name for name in names if name != "seed_4.json"]
    times = [(folder / name).stat().st_mtime_ns for name in kept]
    assert run(*sweep) == 0
    assert [(folder / name).stat().st_mtime_ns for name in kept] == times
    (folder / "seed_3.json").write_text("{")
    assert run(*sweep) == 1
    assert "seed_3.json: expected the result of a seed, got " in capsys.readouterr().err
    written = json.loads((folder / "sweep.json").read_text())
    assert written["meta"]["seeds"] == 2
    assert list(written["meta"]["failed"]) == ["3"]
    assert {row["seed"] for row in written["runs"]} == {4}
    assert len(written["runs"]) == 3 * 2
    assert written["table"]["rl"]["valve_travel"]["mean"] > 0
    identity = json.loads((folder / "seed_4.json").read_text())["identity"]
    assert identity["settings"]["threads"] == 1
    assert (identity["starts"], identity["sequences"]) == (2, ["x", "y", "z"])
