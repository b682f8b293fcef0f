"""Preliminary tests and the gap by hand, on any machine; logs of another plant; what the judge says."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import Stand
from helpers_machines import obedient_net, obedient_velocity, random_machine, small_net

from benchmarks.rollout import random_net
from brokk_min.__main__ import main
from brokk_min.actuator import ActuatorNet
from brokk_min.evaluation import preliminary
from brokk_min.identification import excitation, fitting
from brokk_min.identification.fitting import FitConfig
from brokk_min.identification.logs import Log, Recording
from brokk_min.identification.net_file import save_net
from brokk_min.identification.validation import net_simulator, plant_simulator
from brokk_min.machine import BROKK_170

LOW, HIGH = BROKK_170.column("q_min"), BROKK_170.column("q_max")


def constant_mover(speed_up: float, speed_down: float, late: int, rate: float = 20.0):
    """Joints that move at one speed `late` ticks after a command, whatever its size."""

    def move(q: np.ndarray, u: np.ndarray) -> np.ndarray:
        sent = np.concatenate([np.zeros((late, *u.shape[1:])), u])[: len(u)]
        speed = np.where(sent > 0, speed_up, np.where(sent < 0, -speed_down, 0.0))
        return np.concatenate([q[None], q + np.cumsum(speed, axis=0) / rate])

    return move


# --- sweeps -----------------------------------------------------------------------------------------


def test_a_sweep_goes_from_stop_to_stop_at_the_plants_speeds():
    move = plant_simulator(BROKK_170)
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
    angles = net_simulator(net)(q, u)
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
    plant = plant_simulator(BROKK_170)
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
    plant = plant_simulator(BROKK_170)
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
    driven = net_simulator(net.select(["q1", "q3", "q4", "q5"]))(
        q[:, [0, 2, 3, 4]], u[..., [0, 2, 3, 4]]
    )
    assert moved.shape == (4, 2, 5) and (moved[..., 1] == q[0, 1]).all()
    np.testing.assert_array_equal(moved[..., [0, 2, 3, 4]], driven)
    both = preliminary.movers(BROKK_170, net)
    assert list(both) == ["machine", "nets"]
    np.testing.assert_array_equal(both["nets"](q, u), moved)
    np.testing.assert_array_equal(both["machine"](q, u), plant_simulator(BROKK_170)(q, u))
