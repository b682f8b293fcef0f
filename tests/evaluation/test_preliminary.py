"""Preliminary tests and the gap by hand, on any machine; logs of another plant; what the judge says."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import Stand
from helpers_machines import obedient_net, obedient_velocity, random_machine, small_net

from benchmarks.rollout import random_net
from brokk_min.__main__ import main
from brokk_min.actuator import ActuatorNet
from brokk_min.evaluation import preliminary, trust
from brokk_min.identification import excitation, fitting
from brokk_min.identification import validation as scores
from brokk_min.identification.fitting import FitConfig
from brokk_min.identification.logs import Log, Recording, read_log, velocity_of
from brokk_min.identification.net_file import save_net
from brokk_min.machine import BROKK_170, Machine

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
    angles = preliminary.steps(
        constant_mover(0.2, 0.4, late), -np.ones(2), np.ones(2), level, 0 * level, 30
    )
    assert angles.shape == (61, 2, 2, 2, 2)
    times = preliminary.response_times(angles, 20.0)
    np.testing.assert_allclose(times, (late + 0.63 - 0.5) / 20, atol=1e-9)
    speeds = preliminary.step_velocity(angles, 20.0)
    np.testing.assert_allclose(speeds[-1], [[[0.2, 0.2], [0.4, 0.4]]] * 2)  # positive up and down


def test_only_the_stepping_joint_moves_away_from_the_end_behind_it():
    level = np.full(3, 0.5)
    low, high = np.array([0.0, -1.0, 2.0]), np.array([1.0, 1.0, 4.0])
    angles = preliminary.steps(constant_mover(0.1, 0.1, 0), low, high, level, level / 2, 30)
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
    angles = preliminary.steps(
        constant_mover(0.2, 0.0, 0), -np.ones(2), np.ones(2), level, level, 20
    )
    times = preliminary.response_times(angles, 20.0)
    assert np.isnan(times[0, 1]).all() and np.isfinite(times[0, 0]).all()
    assert np.isnan(times[1]).all()  # it moves before the step as after it
    named = preliminary.named_times(times, ("a", "b"))
    assert {kind for of in named.values() for kind in of} == {"idle", "moving"}
    assert named["b"]["idle"]["down"] is None and named["b"]["idle"]["up"] == pytest.approx(0.0065)


def test_the_plants_response_times_are_the_papers():
    level = np.full(5, 80 / 127)
    angles = preliminary.steps(preliminary.plant_mover(BROKK_170), LOW, HIGH, level, level / 2, 30)
    idle, moving = preliminary.response_times(angles, 20.0)
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
    before = preliminary.step_commands(move, -np.ones(3), np.ones(3), level, 20)
    # tenths of the level that move by a twentieth of the full speed: 0.12, 0.5 and 0.5
    np.testing.assert_allclose(before, [(0.12 + 0.6) / 2, (0.5 + 1.0) / 2, (0.5 + 1.0) / 2])


# --- sweeps -----------------------------------------------------------------------------------------


def test_a_sweep_goes_from_stop_to_stop_at_the_plants_speeds():
    move = preliminary.plant_mover(BROKK_170)
    u = np.zeros((2, 5))
    u[:, 4] = [80 / 127, -80 / 127]
    results = preliminary.sweeps(BROKK_170, move, 4, u)
    for counts, peak, (angle, velocity) in zip((80, -80), (0.24, 0.45), results, strict=True):
        assert angle[-1] == (HIGH if counts > 0 else LOW)[4]
        assert np.all(velocity * counts >= 0) and velocity[-1] != 0
        assert np.abs(velocity).max() == pytest.approx(peak, rel=0.04)
        np.testing.assert_allclose(np.diff(angle) * 20, velocity[1:], atol=1e-9)


def test_the_others_move_as_in_the_paper():
    u = preliminary.other_commands(BROKK_170, 4) * 127
    np.testing.assert_allclose(u, [-80, 0, -80, 80, 0])  # u1 and u3 175, u4 80


def test_sweeps_a_known_distance_apart():
    q = np.linspace(0, 2, 50)
    up, down = np.array([q, 0.2 + 0 * q]), np.array([q[::-1], 0.25 + 0 * q])
    assert preliminary._apart(up, down) == pytest.approx(0.05)


# --- movers and the gap -------------------------------------------------------------------------------


def test_a_mover_of_nets_is_their_step():
    machine = random_machine(np.random.default_rng(3), 3)
    net = obedient_net(machine)
    u = np.random.default_rng(0).uniform(-0.2, 0.2, (15, 2, len(machine.driven)))
    q = np.tile((net.q_low + net.q_high) / 2, (2, 1)).astype(float)
    angles = preliminary.net_mover(net)(q, u)
    np.testing.assert_allclose(
        np.diff(angles, axis=0) * net.rate, obedient_velocity(machine, u), atol=1e-4
    )


@pytest.mark.parametrize("seed", range(2))
def test_numbers_of_any_machine_are_json_and_its_locked_joints_rest(seed):
    rng = np.random.default_rng(seed)
    machine = random_machine(rng, int(rng.integers(1, 6)))
    net = small_net(machine, rng, machine.names)
    numbers = preliminary.run(machine, net, seed)
    json.dumps(numbers, allow_nan=False)
    driven = [machine.names[i] for i in machine.driven]
    assert numbers["joint"] == driven[-1]
    assert list(numbers["sim_to_real"]["joints"]) == driven
    assert set(numbers["response_time"]) == {"machine", "nets"}
    gap = preliminary.sim_to_real(machine, net, seed)
    assert gap.q.shape == (600, 20, machine.n) and gap.p_tool.shape == (600, 20, 3)
    assert not gap.q[..., machine.locked].any()


def test_the_gap_of_a_machine_to_itself_is_none(monkeypatch):
    plant = preliminary.plant_mover(BROKK_170)
    monkeypatch.setattr(preliminary, "movers", lambda *_: {"machine": plant, "nets": plant})
    net = random_net(np.random.default_rng(0))
    assert not any(array.any() for array in preliminary.sim_to_real(BROKK_170, net, 0))
    numbers = preliminary.run(BROKK_170, net, 0)
    assert numbers["sim_to_real"]["tool"] == {"position_error_mean": 0.0, "velocity_rmse": 0.0}
    assert all(row["difference_rms"] == 0 for row in numbers["sweep"].values())
    assert list(numbers["sweep"]) == ["u = 50", "u = 80", "u = 175", "u = 205"]
    assert numbers["coupling_rms"]["machine"] < 0.002  # "marginal and neglectable"


def test_the_gap_starts_where_the_papers_does_or_amid_the_ranges(stand: Stand, monkeypatch):
    u, seen = np.random.default_rng(0).uniform(-0.3, 0.3, (25, 2, 5)), []
    tape = Log(BROKK_170.names, tuple(Recording(str(i), row, row, row) for i, row in enumerate(u)))
    calls = stand(excitation, task_log=tape)

    def still(q: np.ndarray, u: np.ndarray) -> np.ndarray:
        seen.append((q, u))
        return np.repeat(q[None], len(u) + 1, axis=0)

    monkeypatch.setattr(preliminary, "movers", lambda *a: {"machine": still, "nets": still})
    net = random_net(np.random.default_rng(0))
    starts = {"brokk170": [1.5, 0.5, 0.58, 1.71, 1.24], "other": (LOW + HIGH) / 2}
    for name, start in starts.items():
        machine = replace(BROKK_170, name=name)
        preliminary.sim_to_real(machine, net, 7)
        of, num, seconds, rng, given = calls["task_log"]
        assert (of, num, seconds) == (machine, 25, 30.0)
        assert rng.bit_generator.state == np.random.default_rng(7).bit_generator.state
        np.testing.assert_array_equal(given, start)
        np.testing.assert_array_equal(seen[-1][0], np.tile(start, (20, 1)))
        driven = [i for i in range(25) if i % 5 < 4]  # the fifth has its locked joint move
        np.testing.assert_array_equal(seen[-1][1], np.stack(u[driven], axis=1))


def test_the_gap_is_between_tools_where_the_arms_end(monkeypatch):
    """Nets that stand still: the gap is what the machine moved."""
    plant = preliminary.plant_mover(BROKK_170)
    seen = {}

    def watched(q: np.ndarray, u: np.ndarray) -> np.ndarray:
        seen["q"] = plant(q, u)
        assert not u[..., 1].any() and np.all((np.abs(u) > 0.07).sum(axis=-1).max(axis=0) > 1)
        np.testing.assert_allclose(q, np.tile([1.5, 0.5, 0.58, 1.71, 1.24], (20, 1)))
        return seen["q"]

    still = lambda q, u: np.repeat(q[None], len(u) + 1, axis=0)  # noqa: E731
    net = random_net(np.random.default_rng(0))
    monkeypatch.setattr(
        preliminary,
        "movers",
        lambda *a: {"machine": watched, "nets": still} if a == (BROKK_170, net) else {},
    )
    gap = preliminary.sim_to_real(BROKK_170, net, 0)
    np.testing.assert_allclose(gap.q, seen["q"][0] - seen["q"][1:], atol=1e-12)
    from brokk_min.kinematics import forward_kinematics, tool_position

    p = tool_position(forward_kinematics(BROKK_170, seen["q"]))
    np.testing.assert_allclose(gap.p_tool, p[0] - p[1:], atol=1e-12)
    np.testing.assert_allclose(gap.q_dot, -20 * np.diff(seen["q"], axis=0), atol=1e-12)
    np.testing.assert_allclose(gap.v_tool, -20 * np.diff(p, axis=0), atol=1e-12)


def test_the_papers_recipe_is_sines_without_ways_back_and_errors_of_one_step(monkeypatch):
    seen = {}

    def recording_fit(log: Log, config: FitConfig, *rest: object) -> ActuatorNet:
        seen.update(log=log, config=config)
        return real_fit(log, config, *rest)

    real_fit, real_collect = fitting.fit, excitation.collect
    monkeypatch.setattr(fitting, "fit", recording_fit)
    monkeypatch.setattr(
        excitation, "collect", lambda *a: seen.update(excitation=a[2]) or real_collect(*a)
    )
    test = excitation.task_log(BROKK_170, 2, 12.0, np.random.default_rng(1))
    result = preliminary.paper_recipe(BROKK_170, test, 0.02, FitConfig(steps=3, batch_size=8), 0)
    assert seen["excitation"] == "sine" and seen["config"] == FitConfig(
        3, 8, noise=0.0, rollout=1, dead_zone=0.0
    )
    assert seen["log"].recordings and not any(
        r.name.endswith("_return") for r in seen["log"].recordings
    )
    assert set(result["test"]) == set(BROKK_170.names) and "10" in result["test"]["q5"]["free_run"]
    assert result["sim_to_real"]["tool_position_error_mean_of_runs"]["runs"] == 20


def test_the_command_writes_figures_and_numbers(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    net = replace(random_net(np.random.default_rng(0)), machine="brokk170")
    save_net(tmp_path / "net.npz", net)
    out = tmp_path / "a" / "b"
    assert main(["preliminary", "--actuator", str(tmp_path / "net.npz"), "--out", str(out)]) == 0
    assert sorted(p.name for p in out.iterdir()) == [
        "preliminary.json",
        "preliminary.png",
        "sim_to_real.png",
    ]
    assert all(p.read_bytes()[:4] == b"\x89PNG" for p in out.glob("*.png"))
    written = json.loads((out / "preliminary.json").read_text())
    assert written["meta"]["seed"] == 0 and len(written["sweep"]) == 4
    assert (
        main(["preliminary", "--actuator", str(tmp_path / "no.npz"), "--out", str(tmp_path / "c")])
        == 1
    )
    assert not (tmp_path / "c").exists()
    assert "no.npz" in capsys.readouterr().err


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
    q = preliminary.plant_mover(machine)(rng.uniform(low, high, (runs, 2)), valve)[:-1]
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
    return fitting.fit(log, config, seed=0, velocity_samples=2)


def test_the_linear_model_finds_a_linear_joint():
    log = linear_log(0)
    model = trust.fit_linear(blank_net(log), log, penalty=1e-9)
    found = scores.score(model, linear_log(1, scale=0.3))["a"]
    assert found["one_step_rmse"] < 1e-3 < 0.1 * found["persistence_rmse"]
    assert found["free_run"]["1"]["velocity_rmse"] < 2e-3


def test_the_linear_model_is_ridge_regression_on_the_nets_inputs():
    log, history = linear_log(0, 3), 4
    net = blank_net(log, history)
    model = trust.fit_linear(net, log, penalty=0.01)
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
            for k, v in trust.outside_training(known, taped(u, q + 0 * u), 13).items()
        }

    assert not any(shares(0.9 * np.sin(2 * np.pi * 0.2 * time + 1)).values())
    large = shares(np.where(np.arange(1000) < 500, 0.5, 1.2))
    assert large["command"] == pytest.approx(500 / 987)
    fast = shares(np.tile([0.5, 0.5, -0.5, -0.5], 250))
    assert fast["change of command"] == pytest.approx(0.5, abs=0.01) and fast["command"] == 0
    assert fast["mean command"] == 0
    short = taped(np.tile([0.9, -0.9], 500))  # trained on a tremble, tested on a hold
    slow = trust.outside_training(short, taped(0.5 + 0 * time), 13)
    assert slow["mean command"][0] == 0  # this joint rests in the test: nothing to judge
    moving = trust.outside_training(short, taped(0.5 + 0 * time, 0.1 * time), 13)
    assert moving["mean command"][0] == 1 and moving["command"][0] == 0
    assert shares(0 * time + np.sin(time), 0.6)["angle"] == 1


def test_creep_is_the_largest_drift_of_a_joint_without_a_command(monkeypatch):
    net = random_net(np.random.default_rng(0))

    def drifting(q: np.ndarray, u: np.ndarray) -> np.ndarray:
        assert not u.any() and u.shape == (200, 21, 5)  # 10 s
        np.testing.assert_allclose(q, np.linspace(net.q_low, net.q_high, 21))
        return q + np.arange(len(u) + 1)[:, None, None] / 20 * 0.003 * (q == q.max(axis=0))

    monkeypatch.setattr(trust, "net_mover", lambda _: drifting)
    np.testing.assert_allclose(trust.creep(net), 0.003)


def test_a_net_that_is_no_better_than_a_linear_model_is_told_so():
    log, test = linear_log(0), linear_log(1)
    verdict = trust.judge(blank_net(log), log, test)
    assert [
        w for w in verdict["warnings"] if w.startswith("a: a free run of 1 s") and "no better" in w
    ]
    jumps = Log(("a",), tuple(r._replace(u=-np.abs(r.u) - 0.2) for r in test.recordings))
    assert any(
        w.startswith("a: command outside")
        for w in trust.judge(blank_net(log), log, jumps)["warnings"]
    )


def test_tool_errors_by_hand(monkeypatch):
    """q1 off by 0.01 rad a second at 3.05 m from the slew axis, where the tool is at the end of each run."""
    q = np.tile([1.5, 0.5, 0.58, 1.71, 1.24], (150, 1))
    q[:20, 3] += 0.5  # nearer at first
    test, net = (
        Log(BROKK_170.names, (Recording("x", 0 * q, q, 0 * q),)),
        random_net(np.random.default_rng(0)),
    )

    def error(of: ActuatorNet, samples: fitting.Samples, starts: np.ndarray, ticks: int) -> tuple:
        assert of is net and samples.whole.q.tolist() == q.tolist()
        seconds = np.arange(1, ticks + 1)[:, None, None] / 20
        return seconds * np.array([0.01, 0, 0, 0, 0]) * np.ones((len(starts), 1)), None

    monkeypatch.setattr(scores, "run_errors", error)
    errors = trust.tool_errors(BROKK_170, net, test)
    assert errors == {"1": pytest.approx(0.0305, abs=2e-4), "5": pytest.approx(0.1525, abs=1e-3)}


# --- numbers and figures by hand ------------------------------------------------------------------------


def made_up_gap() -> preliminary.Gap:
    """Two ticks, three runs; only the first run counts for joints, run k is off by k + 1 as much."""
    size = np.arange(1, 4)[:, None]
    q = np.array([0.1, -0.3])[:, None, None] * size * np.array([1.0, 9, 2, 3, 4])
    p = np.array([0.3, 0.5])[:, None, None] * size * np.array([0.6, 0.8, 0.0])
    return preliminary.Gap(q, 2 * q, p, 2 * p)


def test_numbers_of_a_gap_by_hand():
    found = preliminary._gap_numbers(BROKK_170, made_up_gap())
    assert found["tool"] == {
        "position_error_mean": pytest.approx(0.4),
        "velocity_rmse": pytest.approx(2 * np.sqrt((0.09 + 0.25) / 2)),
    }
    spread = {"median": pytest.approx(0.8), "max": pytest.approx(1.2), "runs": 3}
    assert found["tool_position_error_mean_of_runs"] == spread
    assert list(found["joints"]) == ["q1", "q3", "q4", "q5"]
    assert found["joints"]["q4"] == {
        "velocity_rmse": pytest.approx(2 * 3 * np.sqrt((0.01 + 0.09) / 2)),
        "position_error_mean": pytest.approx(3 * 0.2),
        "position_error_max": pytest.approx(3 * 0.3),
    }


def test_sweeps_are_compared_by_their_peaks_and_between_their_outer_twentieths():
    q = np.linspace(0.0, 1.0, 201)
    bent = np.where((q < 0.03) | (q > 0.97), 7.0, 0.3)  # nothing of that counts
    numbers = preliminary._sweep_numbers(np.array([q, -0.5 + 0 * q]), np.array([q, bent]))
    assert numbers == {"machine_peak": 0.5, "nets_peak": 7.0, "difference_rms": pytest.approx(0.8)}
    steep = np.array([q, np.where(np.abs(q - 0.5) < 0.4251, 0.3, 7.0)])  # but from 0.06 to 0.94
    assert preliminary._sweep_numbers(np.array([q, 0.3 + 0 * q]), steep)["difference_rms"] > 0.1


def test_the_tests_are_those_of_the_last_driven_joint_at_five_eighths_and_all_of_the_limit():
    seen = []

    def move(q: np.ndarray, u: np.ndarray) -> np.ndarray:
        seen.append((q, u))
        return constant_mover(0.25, 0.5, 0)(q, u)

    tests = preliminary.preliminary_tests(BROKK_170, move)
    assert list(tests.sweeps) == ["u = 50", "u = 80", "u = 175", "u = 205"]
    q, u = seen[0]
    assert u.shape == (800, 5, 5) and (u == u[0]).all()
    np.testing.assert_allclose(
        u[0] * 127, [[0, 0, 0, 0, c] for c in (50, 80, -80, -50)] + [[-80, 0, -80, 80, 80]]
    )
    np.testing.assert_array_equal(q[:, 4], [LOW[4], LOW[4], HIGH[4], HIGH[4], LOW[4]])
    np.testing.assert_allclose(q[:, :4], np.tile(((LOW + HIGH) / 2)[:4], (5, 1)))
    for name, speed in zip(tests.sweeps, (0.25, 0.25, -0.5, -0.5), strict=True):
        angle, velocity = tests.sweeps[name]
        np.testing.assert_allclose(velocity, speed)
        assert angle[0] == pytest.approx((LOW[4] if speed > 0 else HIGH[4]) + speed / 20)
    assert list(tests.coupling) == ["alone", "with the others"]
    np.testing.assert_array_equal(tests.coupling["alone"], tests.sweeps["u = 80"])
    q, u = seen[1]
    assert tests.angles.shape == (61, 2, 2, 5, 5) and u.shape == (60, 2, 2, 5, 5)
    assert u[0, 1, 0, 4, 4] * 127 == pytest.approx((80 + 0.07 * 127) / 2) and not u[:30, 0].any()
    np.testing.assert_allclose(u[30:, :, 1, 2, 2] * 127, -80)


def test_figures_show_machine_above_nets_and_what_nets_are_off(monkeypatch):
    up, slow = constant_mover(0.25, 0.5, 2), constant_mover(0.2, 0.4, 4)

    def only_q5(move):
        return lambda q, u: np.where(np.arange(5) == 4, move(q, u), q)

    net = random_net(np.random.default_rng(0))
    both = {"machine": only_q5(up), "nets": only_q5(slow)}
    monkeypatch.setattr(preliminary, "movers", lambda *a: both if a == (BROKK_170, net) else {})
    monkeypatch.setattr(preliminary, "plot_panels", lambda rows: rows)
    monkeypatch.setattr(
        preliminary, "sim_to_real", lambda *a: made_up_gap() if a == (BROKK_170, net, 7) else None
    )
    figures = preliminary.plots(BROKK_170, net, 7)
    assert list(figures) == ["preliminary", "sim_to_real"]
    for of, row, late, speed in zip(
        ("machine", "nets"), figures["preliminary"], (2, 4), (0.25, 0.2), strict=True
    ):
        kinds = ("range and direction", "coupling", "past movement")
        assert [panel.title for panel in row] == [f"{of}: {kind}" for kind in kinds]
        assert [(p.xlabel, p.ylabel) for p in row] == [("q5 [rad]", "velocity q5 [rad/s]")] * 2 + [
            ("time after the step [s]", "velocity q5 [rad/s]")
        ]
        assert len(row[0].curves) == 4 and len(row[1].curves) == 2
        time, velocity = row[2].curves["from idle"]
        np.testing.assert_allclose(time, 0.05 * (np.arange(60) - 29.5))
        np.testing.assert_allclose(
            velocity, np.where(np.arange(60) < 30 + late, 0, speed), atol=1e-9
        )
        np.testing.assert_allclose(row[2].curves["while moving"][1][late:], speed)
    (tool_v, tool_p), (q_dot, q) = figures["sim_to_real"]
    gap = made_up_gap()
    for panel, values, label in (
        (tool_v, gap.v_tool, "tool velocity [m/s]"), (tool_p, gap.p_tool, "tool position [m]"),
        (q_dot, gap.q_dot[..., [0, 2, 3, 4]], "joint velocity [rad/s]"),
        (q, gap.q[..., [0, 2, 3, 4]], "joint angle [rad]"),
    ):  # fmt: skip
        assert (panel.title, panel.xlabel, panel.ylabel) == ("nets - machine", "time [s]", label)
        assert list(panel.curves) == (
            ["x", "y", "z"] if "tool" in label else ["q1", "q3", "q4", "q5"]
        )
        for (time, curve), column in zip(panel.curves.values(), values[:, 0].T, strict=True):
            np.testing.assert_allclose(time, [0.05, 0.1])
            np.testing.assert_array_equal(curve, column)


def test_a_mover_of_nets_leaves_the_locked_joints_where_they_are():
    net = random_net(np.random.default_rng(0))
    q, u = np.tile((LOW + HIGH) / 2, (2, 1)), np.full((3, 2, 5), 0.5)
    moved = preliminary.driven_mover(BROKK_170, net)(q, u)
    driven = preliminary.net_mover(net.select(["q1", "q3", "q4", "q5"]))(
        q[:, [0, 2, 3, 4]], u[..., [0, 2, 3, 4]]
    )
    assert moved.shape == (4, 2, 5) and (moved[..., 1] == q[0, 1]).all()
    np.testing.assert_array_equal(moved[..., [0, 2, 3, 4]], driven)
    both = preliminary.movers(BROKK_170, net)
    assert list(both) == ["machine", "nets"]
    np.testing.assert_array_equal(both["nets"](q, u), moved)
    np.testing.assert_array_equal(both["machine"](q, u), preliminary.plant_mover(BROKK_170)(q, u))


def test_what_is_held_against_the_training_by_hand():
    ramp = np.arange(8.0)
    found = trust._signals(taped(ramp**2, ramp / 10), 3)
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
        outside = trust.outside_training(known, taped(edge, 3 + 0 * edge), 12)
        assert outside["command"][0] == share, beyond
        high = np.array([*np.tile([0.5, 0.5], 6), *np.tile([1.018 + beyond, 0.5], 30)])
        assert trust.outside_training(known, taped(high, 3 + 0 * high), 12)["command"][0] == share
        far = np.tile([3.5, 3.998 + 0.02 * 1.996 + 20 * (beyond - 0.001)], 36)  # of 2.002 to 3.998
        assert trust.outside_training(known, taped(0.5 + 0 * far, far), 12)["angle"][0] == share


def test_the_judge_puts_its_parts_together(monkeypatch):
    net, log, test = SimpleNamespace(history=5), linear_log(0), linear_log(1)
    asked = {}

    def part(module, name, answer):
        monkeypatch.setattr(
            module, name, lambda *a: asked.setdefault(name, []).append(a) or answer(*a)
        )

    free = {"1": {"velocity_rmse": 0.2}, "5": {"velocity_rmse": 0.1}}
    of_net, of_floor = (
        {"a": {"free_run": free}},
        {"a": {"free_run": {k: {"velocity_rmse": 0.15} for k in free}}},
    )
    part(trust, "fit_linear", lambda *a: "floor")
    part(scores, "score", lambda model, log: of_floor if model == "floor" else of_net)
    part(trust, "creep", lambda *a: np.array([0.25]))
    part(
        trust,
        "outside_training",
        lambda *a: {"angle": np.array([0.02]), "command": np.array([0.031])},
    )
    part(trust, "_times", lambda *a: {"response_time": {"a": 1}, "machine_response_time": {"a": 2}})
    part(trust, "tool_errors", lambda *a: {"1": 0.5})
    verdict = trust.judge(net, log, test, BROKK_170)
    assert asked["_times"] == [(net, log, BROKK_170)] and asked["tool_errors"] == [
        (BROKK_170, net, test)
    ]
    assert asked["score"] == [(net, test), ("floor", test)] and asked["fit_linear"] == [(net, log)]
    assert asked["outside_training"] == [(log, test, 5)] and asked["creep"] == [(net,)]
    assert verdict["joints"]["a"] == {
        "free_run": free, "linear": of_floor["a"], "creep": 0.25,
        "response_time": 1, "machine_response_time": 2, "outside": {"angle": 0.02, "command": 0.031},
    }  # fmt: skip
    assert verdict["tool"] == {"1": 0.5} and verdict["warnings"] == [
        "a: a free run of 1 s is off by 0.2000 rad/s, a linear model only by 0.1500: the net is no better",
        "a: command outside the training's range in 3% of the test",
    ]
    assert trust.judge(net, log, test)["tool"] == {} and len(asked["tool_errors"]) == 1


def test_response_times_are_asked_for_at_the_largest_command_of_the_log(monkeypatch):
    net, asked = (
        SimpleNamespace(history=5, rate=20.0, q_low=object(), q_high=object(), joints=("a",)),
        [],
    )
    monkeypatch.setattr(trust, "net_mover", lambda n: "nets")
    monkeypatch.setattr(trust, "plant_mover", lambda m: "plant" if m is BROKK_170 else None)
    monkeypatch.setattr(trust, "step_commands", lambda *a: asked.append(a) or "before")
    monkeypatch.setattr(trust, "steps", lambda *a: asked.append(a) or a[0])
    monkeypatch.setattr(trust, "response_times", lambda angles, rate: (angles, rate))
    monkeypatch.setattr(trust, "named_times", lambda times, joints: (*times, joints))
    log = taped(np.array([0.1, -0.7, 0.3]))
    found = trust._times(
        net,
        log._replace(recordings=(*log.recordings, *taped(np.array([0.2, 0.6])).recordings)),
        BROKK_170,
    )
    assert found == {
        "response_time": ("nets", 20.0, ("a",)),
        "machine_response_time": ("plant", 20.0, ("a",)),
    }
    for call, mover in zip(asked, ("nets", "nets", "plant"), strict=True):
        assert call[0] == mover and (call[1] is net.q_low, call[2] is net.q_high) == (True, True)
        assert call[3].tolist() == [0.7] and call[-1] == 30  # 1.5 s
    assert asked[1][4] == asked[2][4] == "before"
    assert (
        list(trust._times(SimpleNamespace(**vars(net) | {"history": 20}), log, None))
        == ["response_time"]
        and asked[-1][-1] == 40
    )
