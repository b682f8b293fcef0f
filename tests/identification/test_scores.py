"""Scores of nets by hand: one step, free runs, whole recordings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers_machines import constant_net, line, random_net

from brokk_min.identification import validation as scores
from brokk_min.identification.excitation import collect
from brokk_min.identification.fitting import FitConfig, end_to_end, fit
from brokk_min.identification.logs import Log, Recording, velocity_of
from brokk_min.identification.validation import free_run, score
from brokk_min.machine import BROKK_170, estimate_velocity


def test_nets_have_the_rate_of_their_log_and_are_judged_at_no_other():
    machine, config = replace(BROKK_170, rate=50.0), FitConfig(steps=12, rollout=2, hidden=4)
    log = collect(machine, 0.002, "rich", np.random.default_rng(0))
    assert log.rate == 50
    q = log.recordings[0].q
    slope = [estimate_velocity(q[i - 3 : i + 1].T, 4, 0.02) for i in range(4, len(q))]
    np.testing.assert_allclose(log.recordings[0].q_dot[4:], slope, atol=1e-12)
    net = fit(log, config, 0, 4, machine.name)
    assert net.rate == 50
    with pytest.raises(ValueError, match=r"rate: expected 50\.0, got 20\.0"):
        score(net, log._replace(rate=20.0))


def test_scores_of_a_net_that_says_one_velocity_by_hand():
    """The joints go at 0.1 and -0.3 rad/s, the nets say 0.2 and -0.3."""
    ticks = np.arange(120)[:, None]
    q = np.array([0.1, -0.3]) * ticks / 20
    recording = Recording("x", np.zeros((120, 2)), q, np.full((120, 2), [0.1, -0.3]))
    net = constant_net([0.2, -0.3], True, ("a", "b"))
    result = score(net, Log(("a", "b"), (recording,), True))
    assert set(result) == {"a", "b"} and set(result["a"]["free_run"]) == {"1", "5"}  # 6 s of log
    assert result["a"]["one_step_rmse"] == pytest.approx(0.1, abs=1e-6)
    assert result["a"]["persistence_rmse"] == pytest.approx(0.0, abs=1e-9)
    for horizon in (1, 5):
        run = result["a"]["free_run"][str(horizon)]
        assert run["velocity_rmse"] == pytest.approx(0.1, abs=1e-6)
        assert run["position_error_median"] == pytest.approx(0.1 * horizon, abs=1e-5)
        exact = result["b"]["free_run"][str(horizon)]
        assert exact["velocity_rmse"] == pytest.approx(0.0, abs=1e-6)
        assert exact["position_error_median"] == pytest.approx(0.0, abs=1e-5)


def test_one_step_is_against_what_the_nets_are_fitted_to_by_hand():
    """q = 0.1 t^2: in the tick from t it moves at 0.2 t + 0.005 rad/s, whatever an estimator says."""
    time = np.arange(60)[:, None] / 20
    q = 0.1 * time**2
    recording = Recording("x", np.zeros((60, 1)), q, velocity_of(q, 4))
    log = Log(("a",), (recording, recording._replace(name="y", q=q + 9.0)))
    result = score(constant_net([0.2], False, ("a",)), log)["a"]
    at = time[13:59]  # samples with 13 before and one after them
    wanted = np.sqrt(np.mean((0.2 - (0.2 * at + 0.005)) ** 2))
    assert result["one_step_rmse"] == pytest.approx(wanted, abs=1e-5)
    # the slope through four samples lags by 1.5 ticks, and the target leads by half a tick: 0.2 * 2 / 20
    assert result["persistence_rmse"] == pytest.approx(0.02, abs=1e-6)


def test_scores_compare_velocities_of_one_kind():
    with pytest.raises(ValueError, match="velocity_logged: expected True, got False"):
        score(constant_net([0.2], True, ("a",)), Log(("a",), (line("x", 0.0, 0.1, 40),)))


def test_scoring_shows_its_progress(monkeypatch):
    shown = []
    monkeypatch.setattr(scores, "tqdm", lambda work, **options: shown.append(options) or work)
    score(constant_net([0.2], False, ("a",)), Log(("a",), (line("x", 0.0, 0.1, 40),)))
    assert shown and all(options["disable"] is None for options in shown)  # None: on terminals only


def test_persistence_by_hand_and_segments_within_recordings():
    """Velocity grows by 0.2 rad/s each second: 0.01 a tick. The second recording is far away."""
    time = np.arange(60)[:, None] / 20
    pieces = tuple(
        Recording(name, 0 * time, start + 0.1 * time**2, 0.2 * time)
        for name, start in (("x", 0.0), ("y", 50.0), ("z", -80.0))
    )
    log = Log(("a",), pieces, True)
    result = score(constant_net([0.0], True, ("a",)), log)
    assert result["a"]["persistence_rmse"] == pytest.approx(0.01, abs=1e-9)
    # 2 segments of 1 s each a recording, from samples 13 and 33: 0.1 ((t + 1)^2 - t^2)
    ends = [
        0.1 * ((13 / 20 + 1) ** 2 - (13 / 20) ** 2),
        0.1 * ((33 / 20 + 1) ** 2 - (33 / 20) ** 2),
    ]
    error = result["a"]["free_run"]["1"]["position_error_median"]
    assert error == pytest.approx(sum(ends) / 2, abs=1e-4)
    speeds = 0.2 * np.array([np.arange(14, 34), np.arange(34, 54)]) / 20
    rmse = np.sqrt(np.mean(speeds**2))
    assert result["a"]["free_run"]["1"]["velocity_rmse"] == pytest.approx(rmse, abs=1e-5)


def test_a_free_run_sees_the_past_of_the_log_and_then_only_itself():
    net = replace(random_net(n=2, history=5), velocity_samples=3)
    rng = np.random.default_rng(0)
    u, q = rng.uniform(-0.6, 0.6, (40, 2)), np.cumsum(rng.uniform(-0.02, 0.02, (40, 2)), axis=0)
    recording = Recording("x", u, q, velocity_of(q, 3))
    angles, velocities = free_run(net, recording, np.array([7, 20]), 6)
    assert angles.shape == velocities.shape == (6, 2, 2)
    for s, start in enumerate((7, 20)):
        past, speeds = list(q[start - 4 : start + 1]), list(recording.q_dot[start - 4 : start + 1])
        for k in range(6):
            window = np.stack([past[-5:], speeds[-5:], u[start + k - 4 : start + k + 1]])
            velocity = net.predict(window.transpose(2, 0, 1).astype(np.float32))
            past.append(past[-1] + velocity / 20)
            speeds.append(estimate_velocity(np.array(past[-3:]).T, 3, 0.05))
            np.testing.assert_allclose(angles[k, s], past[-1], atol=1e-4)
            np.testing.assert_allclose(velocities[k, s], speeds[-1], atol=1e-4)


def test_errors_of_whole_recordings_by_hand():
    """A net that says 0.2 rad/s on recordings of 0.1, 0.3 (short), nothing and too few samples."""
    pieces = (
        line("a", 0.0, 0.1, 60),
        line("b", 9.0, 0.35, 20),
        line("c", 0.0, 0.0, 40, u=0.0),
        line("d", 0, 1, 13),
    )
    net = constant_net([0.2], True, ("a",))
    log = Log(
        ("a",),
        tuple(
            r._replace(q_dot=np.full_like(r.q, s))
            for r, s in zip(pieces, (0.1, 0.35, 0, 1), strict=True)
        ),
        True,
    )
    errors = scores.recording_errors(net, log, 30.0)
    np.testing.assert_allclose(errors[:2, 0], [0.1, 0.15], atol=1e-6)
    assert np.isnan(errors[2:]).all()
    assert np.isnan(
        scores.recording_errors(net, log._replace(recordings=log.recordings[3:]), 30.0)
    ).all()


def test_each_joint_is_scored_where_it_moves_and_everywhere_if_it_never_does():
    """Joint a moves in a recording of 15 samples, one tick to be judged; b never; c in one of 60."""
    still, ramp = np.zeros(60), 0.1 * np.arange(60) / 20
    short, long = (
        np.stack(columns, axis=1) for columns in ((ramp, still, still), (still, still, ramp))
    )
    tapes = (short[:15], long)
    log = Log(
        ("a", "b", "c"),
        tuple(Recording("", 0 * q, q, np.gradient(q, 0.05, axis=0)) for q in tapes),
        True,
    )
    net = replace(
        constant_net([0.2] * 3, True, log.joints), q_low=np.full(3, -9.0), q_high=np.full(3, 9.0)
    )
    with_one = {name: entry["free_run"].keys() for name, entry in score(net, log).items()}
    assert with_one == {"a": set(), "b": {"1"}, "c": {"1"}}
    errors = scores.recording_errors(net, log, 30.0)
    np.testing.assert_array_equal(np.isfinite(errors), [[True, True, False], [False, True, True]])


def test_many_free_runs_are_as_few():
    q = np.cumsum(np.random.default_rng(0).uniform(-0.02, 0.02, (9000, 2)), axis=0)
    net, log = (
        random_net(n=2, history=5),
        Log(("a", "b"), (Recording("", 0.1 + 0 * q, q, velocity_of(q, 4)),)),
    )
    samples, starts = end_to_end(log), np.arange(5, 8990)
    many = scores.run_errors(net, samples, starts, 2)
    for found, wanted in zip(many, scores.run_errors(net, samples, starts[8000:], 2), strict=True):
        assert found.shape == (2, 8985, 2)
        np.testing.assert_allclose(found[:, 8000:], wanted, atol=1e-6)


def test_a_whole_recording_is_scored_from_the_sample_after_the_first_history():
    net, q_dot = constant_net([0.2], True, ("a",)), 0.01 * np.arange(40.0)[:, None]
    log = Log(("a",), (line("a", 0.0, 0.1, 40)._replace(q_dot=q_dot),), True)
    wanted = np.sqrt(np.mean((0.2 - q_dot[net.history + 1 :]) ** 2))
    assert scores.recording_errors(net, log, 30.0) == pytest.approx(wanted, abs=1e-6)
    assert score(net, log)["a"]["one_step_rmse"] == pytest.approx(
        wanted, abs=1e-6
    )  # the log's velocities


def test_scores_need_the_same_joints_and_one_step_at_least():
    net = constant_net([0.2], False, ("a",))
    with pytest.raises(ValueError, match=r"joints: expected \('a',\), got \('b',\)"):
        score(net, Log(("b",), (line("x", 0.0, 0.1, 40),)))
    with pytest.raises(ValueError, match=r"above 14 samples, got \[14, 5\]"):
        score(net, Log(("a",), (line("x", 0.0, 0.1, 14), line("y", 0.0, 0.1, 5))))
    score(net, Log(("a",), (line("x", 0.0, 0.1, 15),)))
