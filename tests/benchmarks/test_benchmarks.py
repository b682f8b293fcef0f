"""The benchmarks run: learners train, figures are numbers. What they measure is not tested."""

import json
from shutil import copyfile

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from benchmarks import deviations, faults, ladder, limits, neighbours, peers, rests, seeds
from benchmarks.step_logs import DUTIES, make_logs
from brokk_min import kinematics
from brokk_min.env import action_to_pwm
from brokk_min.evaluation import learn, metrics, sequences
from brokk_min.identification.files import SHIPPED
from brokk_min.identification.fit_config import STEP_RECIPE
from brokk_min.identification.fitting import FitConfig, fit
from brokk_min.identification.logs import Recording, read_log
from brokk_min.identification.net_file import save_net
from brokk_min.identification.validation import score
from brokk_min.learning.gym_env import TaskVectorEnv
from brokk_min.learning.policy import load_policy
from brokk_min.machine import BROKK_170
from examples import gradients

POLICY = load_policy(SHIPPED / BROKK_170.name / "policy.npz", BROKK_170)


@pytest.mark.parametrize("learner", list(peers.LEARNERS))
def test_race__trains_each_learner_and_notes_the_levels_it_reached(learner):
    if learner == "rl_games":
        pytest.importorskip("rl_games")
    options = peers.Options(runs=1, num_envs=16)
    targets = {"any": 9.0, "none": 0.0}
    row = peers.race(learner, POLICY, (1e-3, 1024), 0, targets, options)
    assert (row["learner"], row["updates"], row["seed"]) == (learner, 2, 0)
    epochs = 2 if learner in ("ours", "critic") else peers.EPOCHS
    assert 0 < row["best"] < 1 and row["gradient_steps"] == 2 * epochs
    cpu, wall, steps, gradients = row["reached"].pop("any")
    assert row["reached"] == {}
    assert (steps, gradients) == (1024, row["gradient_steps"])
    assert (cpu, wall) == (row["cpu_s"], row["wall_s"]) and cpu > 0


def test_gradients__are_compared_with_ppo(capsys):
    errors = gradients.main(1024)
    assert errors.keys() == {"gradients", "PPO"} and all(0 < e < 1 for e in errors.values())
    assert capsys.readouterr().out.count(" m/s after ") == 2


def test_limits__are_measured(tmp_path):
    out = tmp_path / "l.json"
    result = limits.main(limits.Options(repeats=1, block_s=0.02, json=out))
    learners = ("ppo", "ours", "ours_with_adam")
    assert all(result[learner]["fraction_of_best"] > 0 for learner in learners)
    assert result["kinematics"]["us_per_configuration"] > 0
    assert json.loads(out.read_text())["ours"] == result["ours"]


def test_seeds__score_what_the_folder_has(tmp_path, capsys, monkeypatch):
    """The shipped policy as one seed, not trained again, and the baselines; in one process."""
    monkeypatch.setattr(learn, "cpu_count", lambda: 1)
    (tmp_path / "seed_0").mkdir()
    for name in ("net.npz", "policy.npz"):
        copyfile(SHIPPED / "brokk170/policy.npz", tmp_path / "seed_0" / name)
    seeds.main(seeds.Options(tmp_path, 1, ("rl",), quick=True))
    rows = json.loads((tmp_path / "seeds.json").read_text())
    assert [row["seed"] for row in rows] == [0, 0, None, None, 0, 0, 0]
    assert all(0.005 < row["error"] < 0.03 and row["jerk"] > 1 for row in rows)
    assert "jacobian_pid_ff_integral" in capsys.readouterr().out


def test_neighbours__are_slowed_by_numbers():
    ratios = neighbours.main(neighbours.Options(1, 1, 2048, 2))
    assert ratios.keys() == {"training", "fit"}
    assert min(min(wall_and_cpu) for wall_and_cpu in ratios.values()) > 0


def test_shapes__are_the_products_of_a_gradient():
    """223-256-128-64-4: forward and by weights everywhere, by inputs from the second layer on."""
    forward = 223 * 256 + 256 * 128 + 128 * 64 + 64 * 4
    work = sum(m * k * n for m, k, n in limits.shapes((223, 256, 128, 64, 4), 10))
    assert work == 10 * (3 * forward - 223 * 256)
    assert limits.muon_shapes((5, 2, 3))[::9] == [(2, 5, 2), (2, 3, 2)]
    gram = 2 * 2 * 5 + 2**3 + 2 * 2 * 5  # X X^T, its square, times X
    assert sum(m * k * n for m, k, n in limits.muon_shapes((5, 2))) == limits.ITERATIONS * gram


@pytest.mark.parametrize("entry", [deviations.a1, deviations.d3])
def test_deviations__are_fractions_or_small_numbers(entry):
    assert all(0 <= value < 1 for value in entry().values())


@pytest.mark.parametrize("entry", [deviations.a5, deviations.d7, deviations.d12, deviations.d14])
def test_deviations__train_and_compare(entry, monkeypatch):
    """One update of 64 ticks; what the policy does is not tested. All is as before afterwards."""

    def evaluate(*_):
        names = ("velocity_error_mean", "off_axis_drift_max", "valve_travel", "time_at_limits")
        return [dict(zip(names, (0.1, 0.02, 20.0, 0.5), strict=True))], None

    monkeypatch.setattr(deviations, "STEPS", 1)
    monkeypatch.setattr(metrics, "evaluate", evaluate)
    monkeypatch.setattr(deviations, "default_training", dict)
    to_heading = kinematics.to_heading
    table = entry()
    assert len(table) in (8, 16)
    assert set(table.values()) == {0.1, 0.02, 20.0, 0.5}
    assert kinematics.to_heading is to_heading


FIRST, *_, LAST = ladder.RUNGS


def test_climb__trains_and_scores_a_policy(tmp_path, monkeypatch):
    """One step of the paper's agent; scored on the first 6 s of each sequence."""
    axes = sequences.shorten(BROKK_170, sequences.axis_sequences(BROKK_170), 6.0)
    monkeypatch.setattr(sequences, "axis_sequences", lambda machine: axes)
    save_net(tmp_path / "net_paper.npz", POLICY.net)
    name = "alone: gradients of the simulation, not a critic"
    error, drift, travel, jerk, closed = ladder.climb(tmp_path, name, 1, 0)
    assert 0.05 < error < 0.3 and 0 <= drift < 2 and travel >= 0 and jerk >= 0
    assert 0.05 < closed < 0.3


@given(arrays(float, 4, elements=st.floats(-1, 1)))
def test_our_action__gives_the_command_of_a_linear_one(action):
    u = action_to_pwm(BROKK_170, ladder.our_action(action))
    assert u == pytest.approx(action_to_pwm(BROKK_170, action, paper=True), abs=1e-12)


@pytest.mark.parametrize(("name", "paper"), [(LAST, False), (FIRST, True)])
def test_mixed_env__is_the_task_of_the_package_at_both_ends(name, paper):
    """Same seed, same actions: observations, rewards and ends agree."""
    mixed = ladder.MixedEnv(POLICY.net, ladder.RUNGS[name], 8)
    whole = TaskVectorEnv(8, POLICY.net, BROKK_170, ladder.PAPER if paper else None)
    rng = np.random.default_rng(0)
    assert mixed.reset(seed=1)[0] == pytest.approx(whole.reset(seed=1)[0])
    for _ in range(100):
        actions = rng.uniform(-1, 1, (8, 4)).astype(np.float32)
        for one, other in zip(mixed.step(actions)[:4], whole.step(actions)[:4], strict=True):
            assert one == pytest.approx(other, abs=2e-3)


def test_step_logs__have_steps_of_one_joint_and_late_answers(tmp_path):
    logs = [read_log([path], 4, rate=100.0) for path in make_logs(tmp_path, 3)]
    duties = [{float(abs(one.u).max()) for one in log.recordings} for log in logs]
    assert [len(duty) for duty in duties] == [5, 2]
    assert set.union(*duties) == set(DUTIES)
    for one in logs[1].recordings:
        (j,) = np.flatnonzero(one.u.any(axis=0))
        first = np.flatnonzero(one.u[:, j])[0]
        assert np.ptp(one.q[: first + 20, j]) < 0.03  # rad of noise, 0.2 s after the command
        assert np.ptp(one.q[:, j]) > 0.1


def test_step_logs__are_followed_by_nets_of_their_recipe(tmp_path):
    """Others run away from the speed of duties that are not in the log."""
    train, test = (read_log([path], 4, rate=20.0) for path in make_logs(tmp_path, 1))
    parts = []
    for log in (train, test):
        steps = (one for one in log.recordings if one.u[:, 1].any())
        arms = (Recording(one.name, *(x[:, 1:2] for x in one[1:])) for one in steps)
        parts.append(log._replace(joints=("arm",), recordings=tuple(arms)))
    error = {}
    for name, recipe in (("ours", {}), ("steps", STEP_RECIPE)):
        config = FitConfig(**{**recipe, "history": 19, "steps": 600})
        net = fit(parts[0], config, seed=0, velocity_samples=4)
        error[name] = score(net, parts[1])["arm"]["free_run"]["5"]["velocity_rmse"]
    assert error["steps"] < 0.6 * error["ours"], error


def test_faults__find_a_frozen_encoder_of_a_moving_joint_in_the_log_of_a_drive():
    rows = faults.frozen_on_drive(*next(faults.recorded_drives()))
    seconds = rows[rows[:, 0] > 0.05, 1]
    assert len(seconds) > 50
    assert (seconds <= 0.175).mean() > 0.9


def test_with_rests__keeps_the_moves():
    (x, *_) = sequences.axis_sequences(BROKK_170)
    rows = sequences.hold_table(BROKK_170, rests.with_rests(BROKK_170, x, 2.5).goals)
    before = sequences.hold_table(BROKK_170, x.goals)
    moves = before[:, 1:].any(axis=1)
    np.testing.assert_allclose(rows[moves], before[moves])
    np.testing.assert_allclose(rows[~moves], [[2.5, 0, 0, 0]] * (~moves).sum())
