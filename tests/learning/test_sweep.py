"""Sweeps: nothing is done twice, failures and dead workers cost one seed, a cluster."""

from __future__ import annotations

import json
import os
import signal
from functools import partial

import numpy as np
import pytest
from helpers_machines import small_net

from brokk_min.env import TaskConfig
from brokk_min.learning.checkpoint import train_policy
from brokk_min.learning.policy import load_policy
from brokk_min.learning.sweep import run_seed, run_seeds
from brokk_min.machine import BROKK_170
from brokk_min.ppo import PPOConfig

distributed = pytest.importorskip("distributed")
TINY = PPOConfig(num_envs=4, horizon=4, epochs=1, minibatch_size=16, total_steps=32, threads=1)
TASK = TaskConfig(episode_s=0.6)
NET = small_net(BROKK_170, np.random.default_rng(0))


def first_bias(policy):
    return [{"bias": float(policy.weights[-1][0])}]


def seed_job(out, evaluate=first_bias, config=TINY):
    return partial(run_seed, BROKK_170, NET, TASK, config, out, evaluate, {"starts": 2})


def square(seed):
    if seed == 3:
        raise ValueError("losses/policy_loss: nan")
    return [{"square": seed**2}]


def die_once(folder, seed):
    """Kill the process in the first call, as an out-of-memory killer would."""
    file = folder / f"{seed}"
    if not file.exists():
        file.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return [{"calls": 2}]


@pytest.fixture(scope="module")
def cluster():
    options = {"n_workers": 1, "processes": False, "dashboard_address": ":0", "protocol": "tcp"}
    with distributed.LocalCluster(threads_per_worker=1, **options) as cluster:
        yield cluster.scheduler_address


# --- one seed -------------------------------------------------------------------------------------


def test_run_seed__trains_as_train_policy_and_writes_its_rows(tmp_path):
    rows = seed_job(tmp_path)(4)
    train_policy(BROKK_170, NET, TASK, TINY, 4, tmp_path / "alone.npz")
    assert (tmp_path / "seed_4.npz").read_bytes() == (tmp_path / "alone.npz").read_bytes()
    assert rows == first_bias(load_policy(tmp_path / "alone.npz", BROKK_170))
    written = json.loads((tmp_path / "seed_4.json").read_text())
    assert written["runs"] == rows
    assert written["identity"]["seed"] == 4
    assert written["identity"]["starts"] == 2


def test_run_seed__does_nothing_twice(tmp_path):
    rows = seed_job(tmp_path)(4)

    def fail(policy):
        raise AssertionError("evaluated again")

    assert seed_job(tmp_path, fail)(4) == rows
    (tmp_path / "seed_4.json").unlink()
    changed = os.stat(tmp_path / "seed_4.npz").st_mtime_ns
    assert seed_job(tmp_path)(4) == rows
    assert os.stat(tmp_path / "seed_4.npz").st_mtime_ns == changed  # not trained again


def test_run_seed__trains_again_over_another_training_and_resumes_its_own(tmp_path):
    train_policy(BROKK_170, NET, TASK, TINY, 5, tmp_path / "seed_4.npz")
    rows = seed_job(tmp_path)(4)
    assert load_policy(tmp_path / "seed_4.npz", BROKK_170).training["seed"] == 4
    for name in ("seed_4.npz", "seed_4.json"):
        (tmp_path / name).unlink()
    (tmp_path / "seed_4.npz.checkpoint").write_bytes(b"damaged")
    with pytest.raises(ValueError, match="expected a readable checkpoint"):
        seed_job(tmp_path)(4)
    (tmp_path / "seed_4.npz.checkpoint").unlink()
    assert seed_job(tmp_path)(4) == rows


def test_run_seed__refuses_results_of_something_else(tmp_path):
    seed_job(tmp_path)(4)
    other = PPOConfig(num_envs=4, horizon=8, total_steps=32)
    with pytest.raises(ValueError, match=r"seed_4\.json: settings.horizon: expected 8, got 4"):
        seed_job(tmp_path, config=other)(4)
    (tmp_path / "seed_4.json").write_text("{")
    with pytest.raises(ValueError, match=r"seed_4\.json: expected the result of a seed, got JSOND"):
        seed_job(tmp_path)(4)


# --- many seeds -----------------------------------------------------------------------------------


def test_run_seeds__a_failed_seed_leaves_the_others_alone(cluster):
    results, failed = run_seeds(square, range(2, 5), cluster)
    assert results == {2: [{"square": 4}], 4: [{"square": 16}]}
    assert failed == {3: "losses/policy_loss: nan"}


def test_run_seeds__refuse_workers_of_several_threads():
    options = {"n_workers": 1, "processes": False, "dashboard_address": ":0", "protocol": "tcp"}
    with distributed.LocalCluster(threads_per_worker=2, **options) as cluster:
        message = r"tcp.*: expected workers with --nthreads 1, got \[2\]"
        with pytest.raises(ValueError, match=message):
            run_seeds(square, [1], cluster.scheduler_address)


@pytest.mark.slow
def test_run_seeds__name_a_scheduler_that_is_not_there():
    with pytest.raises(OSError, match=r"127\.0\.0\.1:9"):
        run_seeds(square, [1], "tcp://127.0.0.1:9")


@pytest.mark.slow
def test_run_seeds__run_a_seed_again_whose_worker_died(tmp_path):
    """In processes of this machine."""
    results, failed = run_seeds(partial(die_once, tmp_path), [0, 1])
    assert (results, failed) == ({0: [{"calls": 2}], 1: [{"calls": 2}]}, {})
