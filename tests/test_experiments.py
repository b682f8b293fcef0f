"""The comparison: figures worked by hand, honest sequences and starts, the chain's repeatability."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from benchmarks.rollout import random_net
from brokk_min import experiments, jacobian
from brokk_min.actuator import ActuatorNet
from brokk_min.env import TaskConfig, Trace, rollout
from brokk_min.kinematics import tool_position
from brokk_min.machine import BROKK_170
from brokk_min.metrics import metrics
from brokk_min.sequences import task_sequences

TINY = experiments.Effort(0.02, 60, 8192, 1, 2, 4, 2, 1.0)


class _Idle:
    """A controller that does nothing, for machines that should stand still."""

    def start(self, num: int) -> None:
        return None

    def __call__(self, observation: np.ndarray, memory: None) -> tuple[np.ndarray, None]:
        return np.zeros((len(observation), BROKK_170.n)), None


def test_an_idle_controller_stands_still_and_errs_by_the_goal() -> None:
    start = np.array([[1.5, 0.5, 0.58, 1.71, 1.24]])
    goals = np.tile([0.0, 0.0, 0.2], (20, 1, 1))
    trace = rollout(BROKK_170, _Idle(), start, goals, TaskConfig(), np.random.default_rng(0))
    found = metrics(BROKK_170, trace, goals, tool_position(BROKK_170, start))
    row = {name: values[0] for name, values in found.items()}
    assert row["velocity_error_mean"] == pytest.approx(0.2, abs=1e-6)
    assert row["reward_mean"] == pytest.approx(1 / 1.2, abs=1e-6)
    assert row["valve_travel"] == 0


def net_of_driven_joints() -> ActuatorNet:
    return random_net(np.random.default_rng(0)).select(["q1", "q3", "q4", "q5"])


def test_gains_of_another_machine_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "gains.json"
    path.write_text(json.dumps({"meta": {"machine": "digger"}, "gains": {}}))
    with pytest.raises(ValueError, match=r"expected gains for brokk170.*digger"):
        experiments.read_gains(path, BROKK_170, net_of_driven_joints())


@pytest.mark.parametrize(
    ("change", "message"),
    [({"kp": [1, 2]}, "shape"), ({"ki": [1, 2, 3, float("nan")]}, "finite"), ({"kd": "fast"}, "fast")],
)
def test_damaged_gains_are_refused(tmp_path: Path, change: dict[str, object], message: str) -> None:
    net, path = net_of_driven_joints(), tmp_path / "gains.json"
    table = experiments.plain_gains(experiments.baselines(BROKK_170, net))
    path.write_text(json.dumps({"meta": {"machine": "brokk170"}, "gains": table}))
    assert experiments.plain_gains(experiments.read_gains(path, BROKK_170, net)) == table
    table["jacobian_pid_ff"] |= change
    path.write_text(json.dumps({"meta": {"machine": "brokk170"}, "gains": table}))
    with pytest.raises(ValueError, match=rf"gains.json: expected gains for brokk170.*{message}"):
        experiments.read_gains(path, BROKK_170, net)


@pytest.fixture(scope="module")
def twice(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folders = tmp_path_factory.mktemp("a b"), tmp_path_factory.mktemp("second")  # a space in the path
    for folder in folders:
        experiments.reproduce(BROKK_170, folder, TINY, 3)
    return folders


def test_the_chain_gives_the_same_bits_twice(twice: tuple[Path, Path]) -> None:
    for name in ("log.npz", "net.npz", "policy.npz", "gains.json", "results.json"):
        assert (twice[0] / name).read_bytes() == (twice[1] / name).read_bytes(), name


def test_results_hold_every_run_with_its_figures(twice: tuple[Path, Path]) -> None:
    results = json.loads((twice[0] / "results.json").read_text())
    runs = results["task_space"]["runs"]
    names = {"rl", "jacobian_pid_k0.1", "jacobian_pid_k0.05", "jacobian_pid_ff"}
    keys = {(r["controller"], r["sequence"], r["start"]) for r in runs}
    sequences = [s.name for s in task_sequences(BROKK_170)]
    assert keys == {(c, s, i) for c in names for s in sequences for i in range(4)}
    assert all(r["velocity_rmse"] >= r["velocity_error_mean"] > 0 for r in runs)
    assert all(0 < r["reward_mean"] < 1 for r in runs)
    assert results["start_kinds"] == ["workspace", "limits", "workspace", "extended"]
    assert all(r["kind"] == results["start_kinds"][r["start"]] for r in runs)
    scored = [r for r in runs if r["kind"] == "workspace"]
    rl = [r["velocity_error_mean"] for r in scored if r["controller"] == "rl"]
    assert results["task_space"]["summary"]["rl"]["all"]["velocity_error_mean"] == pytest.approx(np.mean(rl))


def test_results_tell_how_the_baselines_were_tuned(twice: tuple[Path, Path]) -> None:
    results = json.loads((twice[0] / "results.json").read_text())
    assert set(results["tuning"]) == set(results["gains"])
    for name, how in results["tuning"].items():
        assert how["seed"] == 3 and len(how["cost"]) == TINY.generations
        assert 0 < how["cost"][-1] <= how["cost"][0] < 0.3
        spans = jacobian.GAINS.items()
        ends = [k for k, (low, high) in spans for g in results["gains"][name][k] if g in (low, high)]
        assert len([g for g in how["at_bound"] if g.split()[0] in ends]) >= len(ends)


def test_the_report_is_one_file_with_its_figures(twice: tuple[Path, Path]) -> None:
    text = (twice[0] / "report.html").read_text()
    assert len(re.findall(r"src='data:image/png;base64,", text)) == 10
    assert not re.findall(r"(?:src|href)='(?!data:)", text) and "http" not in text
    assert "not a real Brokk 170" in text


def test_gains_read_back_give_the_same_controller(twice: tuple[Path, Path]) -> None:
    from brokk_min.policy import load_policy

    net = load_policy(twice[0] / "policy.npz", BROKK_170).net
    read = experiments.read_gains(twice[0] / "gains.json", BROKK_170, net)
    written = json.loads((twice[0] / "results.json").read_text())["gains"]
    assert experiments.plain_gains(read) == written


def test_the_whole_chain_spends_what_fit_and_train_do_by_default():
    from brokk_min.actuator import FitConfig
    from brokk_min.ppo import PPOConfig

    effort = experiments.Effort()
    assert (effort.fit_steps, effort.train_steps) == (FitConfig().steps, PPOConfig().total_steps)


def test_drift_is_the_largest_and_the_mean_distance_from_the_line() -> None:
    p = np.array([[0.1, 0.0, 0.0], [0.2, 0.03, 0.04], [0.3, 0.0, 0.01]])[:, None]
    zero = np.zeros((3, 1, 5))
    trace = Trace(zero, zero, zero, zero, p, 0 * p, np.ones((3, 1)))
    row = experiments.metrics(BROKK_170, trace, 0, np.tile([0.1, 0.0, 0.0], (3, 1)), np.zeros(3))
    assert row["off_axis_drift_max"] == pytest.approx(0.05)
    assert row["off_axis_drift_mean"] == pytest.approx((0.0 + 0.05 + 0.01) / 3)
