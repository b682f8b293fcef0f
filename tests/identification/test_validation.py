"""Scores of nets by hand: one step, free runs, whole recordings."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers_machines import constant_net, line, random_net

from benchmarks.rollout import random_net as random_brokk
from brokk_min.__main__ import main
from brokk_min.actuator import ActuatorNet
from brokk_min.identification import validation as scores
from brokk_min.identification.excitation import collect
from brokk_min.identification.fitting import FitConfig, Samples, end_to_end, fit
from brokk_min.identification.logs import Log, Recording, read_log, velocity_of
from brokk_min.identification.validation import free_run, score
from brokk_min.machine import BROKK_170, Machine, estimate_velocity


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


LOW, HIGH = BROKK_170.column("q_min"), BROKK_170.column("q_max")


def constant_mover(speed_up: float, speed_down: float, late: int, rate: float = 20.0):
    """Joints that move at one speed `late` ticks after a command, whatever its size."""

    def move(q: np.ndarray, u: np.ndarray) -> np.ndarray:
        sent = np.concatenate([np.zeros((late, *u.shape[1:])), u])[: len(u)]
        speed = np.where(sent > 0, speed_up, np.where(sent < 0, -speed_down, 0.0))
        return np.concatenate([q[None], q + np.cumsum(speed, axis=0) / rate])

    return move


# --- steps and response times -----------------------------------------------------------------------


@pytest.mark.parametrize("late", [0, 3, 9])
def test_response_times_of_a_pure_delay_by_hand(late):
    """All speed from tick `late` on: between the middles of two ticks the line passes 63 % at 0.63."""
    level = np.full(2, 0.6)
    angles = scores.steps(
        constant_mover(0.2, 0.4, late), -np.ones(2), np.ones(2), level, 0 * level, 30
    )
    assert angles.shape == (61, 2, 2, 2, 2)
    times = scores.response_times(angles, 20.0)
    np.testing.assert_allclose(times, (late + 0.63 - 0.5) / 20, atol=1e-9)
    speeds = scores.step_velocity(angles, 20.0)
    np.testing.assert_allclose(speeds[-1], [[[0.2, 0.2], [0.4, 0.4]]] * 2)  # positive up and down


def test_only_the_stepping_joint_moves_away_from_the_end_behind_it():
    level = np.full(3, 0.5)
    low, high = np.array([0.0, -1.0, 2.0]), np.array([1.0, 1.0, 4.0])
    angles = scores.steps(constant_mover(0.1, 0.1, 0), low, high, level, level / 2, 30)
    starts = angles[0, 0]  # (up and down, stepping, joint)
    np.testing.assert_allclose(starts[0, 1], [0.5, -0.8, 3.0])
    np.testing.assert_allclose(starts[1, 2], [0.5, 0.0, 3.8])
    moved = np.abs(angles[-1] - angles[0])
    own = np.eye(3, dtype=bool)
    assert not moved[..., ~own].any()
    np.testing.assert_allclose(moved[0][:, own], 0.1 * 1.5)  # after the step alone
    np.testing.assert_allclose(moved[1][:, own], 0.1 * 3.0)  # before it too


def test_a_joint_that_does_not_answer_has_no_response_time():
    level = np.full(2, 0.5)
    angles = scores.steps(constant_mover(0.2, 0.0, 0), -np.ones(2), np.ones(2), level, level, 20)
    times = scores.response_times(angles, 20.0)
    assert np.isnan(times[0, 1]).all() and np.isfinite(times[0, 0]).all()
    assert np.isnan(times[1]).all()  # it moves before the step as after it
    named = scores.named_times(times, ("a", "b"))
    assert {kind for of in named.values() for kind in of} == {"idle", "moving"}
    assert named["b"]["idle"]["down"] is None and named["b"]["idle"]["up"] == pytest.approx(0.0065)


def test_the_plants_response_times_are_the_papers():
    level = np.full(5, 80 / 127)
    angles = scores.steps(scores.plant_simulator(BROKK_170), LOW, HIGH, level, level / 2, 30)
    idle, moving = scores.response_times(angles, 20.0)
    np.testing.assert_allclose(idle, 0.40, atol=0.01)
    np.testing.assert_allclose(moving, 0.105, atol=0.01)


def test_a_joint_is_brought_into_motion_beyond_its_dead_zone():
    """Three ticks late; two dead zones, and a valve that opens with the fourth power."""

    def move(q: np.ndarray, u: np.ndarray) -> np.ndarray:
        u = np.concatenate([np.zeros((3, *u.shape[1:])), u])[: len(u)]
        beyond = np.maximum(0, np.abs(u) - np.array([0.07, 0.45, 0.0]))
        speed = np.sign(u) * beyond ** np.array([1, 1, 4])
        return np.concatenate([q[None], q + np.cumsum(speed, axis=0) / 20])

    level = np.array([0.6, 1.0, 1.0])
    before = scores.step_commands(move, -np.ones(3), np.ones(3), level, 20)
    # tenths of the level that move by a twentieth of the full speed: 0.12, 0.5 and 0.5
    np.testing.assert_allclose(before, [(0.12 + 0.6) / 2, (0.5 + 1.0) / 2, (0.5 + 1.0) / 2])


# --- logs of another plant ----------------------------------------------------------------------------


def other_plant(delay: float, rate: float) -> Machine:
    """Two joints with 45 % dead zone and a long dead time."""
    joints = [replace(BROKK_170.joints[i], name=name) for i, name in ((3, "boom"), (4, "stick"))]
    return replace(
        BROKK_170, name="other", joints=tuple(joints), dead_zone=0.45, delay=delay, rate=rate,
        pwm_limit=127, tau_valve_down=0.8,
    )  # fmt: skip


def other_log(
    path: Path,
    delay: float,
    seed: int,
    runs: int,
    seconds: float = 25.0,
    rate: float = 100.0,
    alone: bool = False,
) -> None:
    """Angles of a 12-bit encoder at `rate` with jitter; every recording meets a stop.

    Speed grows with the power 2.5 of the command beyond the dead zone. `alone`: one joint a recording.
    """
    machine, rng = other_plant(delay, rate), np.random.default_rng(seed)
    low, high, ticks = machine.column("q_min"), machine.column("q_max"), round(seconds * rate)
    u = np.zeros((ticks, runs, 2))
    for run, joint in np.ndindex(runs, 2):
        at = 0
        while at < ticks and not (alone and run % 2 != joint):
            hold = round(rate * (7.0 if at == 0 else rng.uniform(0.5, 4.0)))  # first to a stop
            u[at : at + hold, run, joint] = rng.choice([-1, 1]) if at == 0 else rng.uniform(-1, 1)
            at += hold
    beyond = np.maximum(0, np.abs(u) - 0.45) / 0.55
    valve = np.sign(u) * (0.45 * (beyond > 0) + 0.55 * beyond**2.5)
    q = scores.plant_simulator(machine)(rng.uniform(low, high, (runs, 2)), valve)[:-1]
    q = np.rint(q / machine.encoder_step) * machine.encoder_step
    time = (np.arange(ticks)[:, None] + rng.uniform(-0.2, 0.2, (ticks, runs))) / rate
    lines = ["run,time,u_boom,u_stick,q_boom,q_stick"]
    for run in range(runs):
        rows = np.column_stack([time[:, run], u[:, run], q[:, run]])
        lines += [f"take {run}," + ",".join(f"{cell:.5f}" for cell in row) for row in rows]
    path.write_text("\n".join(lines) + "\n")


def fitted(tmp_path: Path, capsys: pytest.CaptureFixture[str], **log: float) -> tuple[dict, str]:
    """Verdict and printed report of `fit` on logs of the other plant, judged on eight unseen recordings."""
    other_log(tmp_path / "log.csv", seed=0, runs=24, **log)
    other_log(tmp_path / "test.csv", seed=1, runs=8, **log)
    files = [
        "--test",
        tmp_path / "test.csv",
        "--json",
        tmp_path / "f.json",
        "--figure",
        tmp_path / "f.png",
    ]
    options = ["--history", 30, "--steps", 1500]
    assert (
        main(
            [
                str(a)
                for a in (
                    "fit",
                    tmp_path / "log.csv",
                    "--out",
                    tmp_path / "n.npz",
                    *files,
                    *options,
                )
            ]
        )
        == 0
    )
    return json.loads((tmp_path / "f.json").read_text()), capsys.readouterr().out


@pytest.mark.parametrize("log", [{"delay": 0.3, "rate": 100.0}, {"delay": 1.0, "alone": True}])
def test_nets_of_another_plant_beat_last_value_and_linear_model(tmp_path, capsys, log):
    verdict, report = fitted(tmp_path, capsys, **log)
    assert list(verdict["joints"]) == ["boom", "stick"] and verdict["tool"] == {}
    for joint in verdict["joints"].values():
        assert joint["one_step_rmse"] < joint["persistence_rmse"]
        for horizon in ("5", "10"):
            mine, linear = (
                s["free_run"][horizon]["velocity_rmse"] for s in (joint, joint["linear"])
            )
            assert mine < 0.9 * linear, (horizon, mine, linear)
        assert joint["creep"] < 5e-4
    assert not [w for w in verdict["warnings"] if "linear" in w or "command" in w]
    assert "linear" in report and "creep" in report
    assert (tmp_path / "f.png").read_bytes()[:4] == b"\x89PNG"


@pytest.mark.parametrize("rate", [20.0, 200.0])
def test_short_recordings_at_any_rate_are_fitted(tmp_path, capsys, rate):
    other_log(tmp_path / "log.csv", 0.3, seed=0, runs=30, seconds=5.0, rate=rate)
    options = ["--out", tmp_path / "n.npz", "--json", tmp_path / "f.json", "--steps", 60]
    assert main([str(a) for a in ("fit", tmp_path / "log.csv", *options)]) == 0
    scores = json.loads((tmp_path / "f.json").read_text())["joints"]
    assert set(scores["boom"]["free_run"]) == {"1"} == set(scores["boom"]["linear"]["free_run"])
    recordings = read_log([tmp_path / "log.csv"], 4).recordings
    assert len(recordings) == 30 and {len(r.u) for r in recordings} <= {99, 100}


# --- the floor, the band, creep -------------------------------------------------------------------------


def linear_log(seed: int, runs: int = 12, scale: float = 1.0) -> Log:
    """A joint whose next velocity is 0.8 times the newest difference plus 0.1 u, exactly."""
    rng, recordings = np.random.default_rng(seed), []
    for run in range(runs):
        u = scale * np.repeat(rng.uniform(-1, 1, 20), 5)[:, None]
        q = np.zeros((100, 1))
        for k in range(1, 99):
            q[k + 1] = q[k] + (0.8 * (q[k] - q[k - 1]) * 20 + 0.1 * u[k]) / 20
        recordings.append(Recording(f"r{run}", u, q, velocity_of(q, 2)))
    return Log(("a",), tuple(recordings))


def blank_net(log: Log, history: int = 5) -> ActuatorNet:
    config = FitConfig(steps=1, batch_size=8, history=history)
    return fit(log, config, seed=0, velocity_samples=2)


def test_the_linear_model_finds_a_linear_joint():
    log = linear_log(0)
    model = scores.fit_linear(blank_net(log), log, penalty=1e-9)
    found = scores.score(model, linear_log(1, scale=0.3))["a"]
    assert found["one_step_rmse"] < 1e-3 < 0.1 * found["persistence_rmse"]
    assert found["free_run"]["1"]["velocity_rmse"] < 2e-3


def test_the_linear_model_is_ridge_regression_on_the_nets_inputs():
    log, history = linear_log(0, 3), 4
    net = blank_net(log, history)
    model = scores.fit_linear(net, log, penalty=0.01)
    rows, targets = [], []
    for r in log.recordings:
        for k in range(history - 1, len(r.q) - 1):
            window = slice(k - history + 1, k + 1)
            rows.append(np.concatenate([r.q[window, 0], r.q_dot[window, 0], r.u[window, 0]]))
            targets.append((r.q[k + 1, 0] - r.q[k, 0]) * 20)
    x = (np.array(rows) - net.input_mean) / net.input_scale
    x, y = np.column_stack([x, np.ones(len(x))]), np.array(targets)
    extra = np.diag(np.sqrt(0.01 * len(x)) * np.append(np.ones(3 * history), 0.0))
    wanted, *_ = np.linalg.lstsq(
        np.vstack([x, extra]), np.append(y, np.zeros(3 * history + 1)), rcond=None
    )
    np.testing.assert_allclose(np.append(model.weights[0], model.weights[1]), wanted, atol=1e-5)
    inputs = np.float32(rows[7]).reshape(1, 3, history)
    assert model.predict(inputs) == pytest.approx(x[7] @ wanted, abs=1e-5)
    far = model.predict(inputs * 1e4)  # no further than the nets can say
    assert far in (net.output_low, net.output_high)


def taped(u: np.ndarray, q: np.ndarray | None = None) -> Log:
    q = np.zeros((len(u), 1)) if q is None else q[:, None]
    return Log(("a",), (Recording("x", u[:, None], q, velocity_of(q, 2)),))


def test_commands_outside_the_training_by_hand():
    time = np.arange(1000) / 20
    known = taped(np.sin(2 * np.pi * 0.2 * time), 0.5 * np.cos(time))

    def shares(u: np.ndarray, q: float = 0.0) -> dict[str, float]:
        return {
            k: float(v[0])
            for k, v in scores.outside_training(known, taped(u, q + 0 * u), 13).items()
        }

    assert not any(shares(0.9 * np.sin(2 * np.pi * 0.2 * time + 1)).values())
    large = shares(np.where(np.arange(1000) < 500, 0.5, 1.2))
    assert large["command"] == pytest.approx(500 / 987)
    fast = shares(np.tile([0.5, 0.5, -0.5, -0.5], 250))
    assert fast["change of command"] == pytest.approx(0.5, abs=0.01) and fast["command"] == 0
    assert fast["mean command"] == 0
    short = taped(np.tile([0.9, -0.9], 500))  # trained on a tremble, tested on a hold
    slow = scores.outside_training(short, taped(0.5 + 0 * time), 13)
    assert slow["mean command"][0] == 0  # this joint rests in the test: nothing to judge
    moving = scores.outside_training(short, taped(0.5 + 0 * time, 0.1 * time), 13)
    assert moving["mean command"][0] == 1 and moving["command"][0] == 0
    assert shares(0 * time + np.sin(time), 0.6)["angle"] == 1


def test_creep_is_the_largest_drift_of_a_joint_without_a_command(monkeypatch):
    net = random_brokk(np.random.default_rng(0))

    def drifting(q: np.ndarray, u: np.ndarray) -> np.ndarray:
        assert not u.any() and u.shape == (200, 21, 5)  # 10 s
        np.testing.assert_allclose(q, np.linspace(net.q_low, net.q_high, 21))
        return q + np.arange(len(u) + 1)[:, None, None] / 20 * 0.003 * (q == q.max(axis=0))

    monkeypatch.setattr(scores, "net_simulator", lambda _: drifting)
    np.testing.assert_allclose(scores.creep(net), 0.003)


def test_a_net_that_is_no_better_than_a_linear_model_is_told_so():
    log, test = linear_log(0), linear_log(1)
    verdict = scores.judge(blank_net(log), log, test)
    assert [
        w for w in verdict["warnings"] if w.startswith("a: a free run of 1 s") and "no better" in w
    ]
    jumps = Log(("a",), tuple(r._replace(u=-np.abs(r.u) - 0.2) for r in test.recordings))
    assert any(
        w.startswith("a: command outside")
        for w in scores.judge(blank_net(log), log, jumps)["warnings"]
    )


def test_tool_errors_by_hand(monkeypatch):
    """q1 off by 0.01 rad a second at 3.05 m from the slew axis, where the tool is at the end of each run."""
    q = np.tile([1.5, 0.5, 0.58, 1.71, 1.24], (150, 1))
    q[:20, 3] += 0.5  # nearer at first
    test, net = (
        Log(BROKK_170.names, (Recording("x", 0 * q, q, 0 * q),)),
        random_brokk(np.random.default_rng(0)),
    )

    def error(of: ActuatorNet, samples: Samples, starts: np.ndarray, ticks: int) -> tuple:
        assert of is net and samples.whole.q.tolist() == q.tolist()
        seconds = np.arange(1, ticks + 1)[:, None, None] / 20
        return seconds * np.array([0.01, 0, 0, 0, 0]) * np.ones((len(starts), 1)), None

    monkeypatch.setattr(scores, "run_errors", error)
    errors = scores.tool_errors(BROKK_170, net, test)
    assert errors == {"1": pytest.approx(0.0305, abs=2e-4), "5": pytest.approx(0.1525, abs=1e-3)}


def test_what_is_held_against_the_training_by_hand():
    ramp = np.arange(8.0)
    found = scores._signals(taped(ramp**2, ramp / 10), 3)
    assert {kind: values[0].tolist() for kind, values in found.items()} == {
        "command": [9, 16, 25, 36, 49],
        "change of command": [5, 7, 9, 11, 13],
        "mean command": pytest.approx([14 / 3, 29 / 3, 50 / 3, 77 / 3, 110 / 3]),
        "angle": pytest.approx([0.3, 0.4, 0.5, 0.6, 0.7]),
    }
    ramp = np.concatenate([np.zeros(12), np.linspace(0, 1, 1001)])  # the first history is left out
    known = taped(ramp, 2 + 2 * ramp)
    for beyond, share in ((0.0005, 0.0), (0.0015, 0.5)):  # a fiftieth of 0.001 to 0.999 is let pass
        edge = np.array([*np.tile([-0.018, 1.018], 6), *np.tile([-0.018 - beyond, 0.5], 30)])
        outside = scores.outside_training(known, taped(edge, 3 + 0 * edge), 12)
        assert outside["command"][0] == share, beyond
        high = np.array([*np.tile([0.5, 0.5], 6), *np.tile([1.018 + beyond, 0.5], 30)])
        assert scores.outside_training(known, taped(high, 3 + 0 * high), 12)["command"][0] == share
        far = np.tile([3.5, 3.998 + 0.02 * 1.996 + 20 * (beyond - 0.001)], 36)  # of 2.002 to 3.998
        assert scores.outside_training(known, taped(0.5 + 0 * far, far), 12)["angle"][0] == share
