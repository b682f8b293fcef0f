"""Robustness: other encoders and machines, the pump's flow, and the table over them."""

from dataclasses import replace

import numpy as np
import pytest
from helpers_machines import Idle, obedient_net, small_net

from brokk_min import kinematics
from brokk_min.actuator import plant_reset, plant_step
from brokk_min.evaluation import robustness as module
from brokk_min.evaluation.baselines import PAPER_BASELINES, baselines
from brokk_min.evaluation.metrics import by_start, evaluate, mean_interval
from brokk_min.evaluation.robustness import (
    near_singularities,
    pump_flow_ratio,
    robustness,
    variations,
)
from brokk_min.evaluation.sequences import task_sequences
from brokk_min.machine import BROKK_170, read_encoder

Q = np.cumsum(np.full((4000, 2, 5), 0.01), axis=0)  # ticks of two machines
PIDS = baselines(BROKK_170, obedient_net(BROKK_170))
STARTS = np.tile(BROKK_170.q_start, (2, 1))
ALONG_Z = task_sequences(BROKK_170)[2]
MOVES = np.flatnonzero(ALONG_Z.goals.any(axis=1))[0]


def test_noisy_encoder__has_independent_noise_of_a_count():
    read = module.noisy_encoder(np.random.default_rng(0))
    counts = (np.array([read(BROKK_170, q) for q in Q]) - Q) / BROKK_170.encoder_step
    assert counts.std() == pytest.approx(np.sqrt(1 + 1 / 12), rel=0.02)
    assert np.abs(np.corrcoef(counts.reshape(-1, 10).T) - np.eye(10)).max() < 0.1


def test_lossy_encoder__repeats_one_sample_in_20_of_all_joints_of_a_machine():
    read = module.lossy_encoder(np.random.default_rng(0))
    exact = read_encoder(BROKK_170, Q)
    result = np.array([read(BROKK_170, q) for q in Q])
    lost = (result[1:] == result[:-1]).all(axis=-1)
    assert lost.mean() == pytest.approx(0.05, abs=0.008)
    assert lost.all(axis=1).mean() < 0.01  # rarely of both machines
    np.testing.assert_array_equal(result[1:][~lost], exact[1:][~lost])
    np.testing.assert_array_equal(result[0], exact[0])


def test_variations__change_one_thing_each():
    assert len(variations(replace(BROKK_170, largest_dead_zone=0.09))) == 12  # 10 % is more
    result = variations(BROKK_170)
    assert len(result) == 12 and result["nominal"][0] is BROKK_170
    rng = np.random.default_rng(0)
    sensors = [name for name, (_, sensor) in result.items() if sensor(rng) is not read_encoder]
    assert sensors == ["encoder noise of a count", "one sample in 20 lost"]
    assert all(result[name][0] is BROKK_170 for name in sensors)
    changed = {
        "supply flow -20 %": {"pump_flow": 0.8 * BROKK_170.pump_flow},
        "supply flow -70 %": {"pump_flow": 0.3 * BROKK_170.pump_flow},
        "dead zone 5 %": {"dead_zone": 0.05},
        "dead zone 10 %": {"dead_zone": 0.10},
        "delay +25 ms": {"delay": BROKK_170.delay + 0.025},
        "delay +50 ms": {"delay": BROKK_170.delay + 0.05},
    }
    for name, fields in changed.items():
        assert result[name][0] == replace(BROKK_170, **fields)
    for name, up, down in (
        ("valve gain -20 %", 0.8, 0.8),
        ("valve gain +20 %", 1.2, 1.2),
        ("up -15 %, down +15 %", 0.85, 1.15),
    ):
        machine = result[name][0]
        for field, factor in (("speed_positive", up), ("speed_negative", down)):
            np.testing.assert_allclose(machine.column(field), factor * BROKK_170.column(field))


def test_pump_flow_ratio__is_what_the_plant_divides_among_the_valves():
    """With valves open and spools settled, cylinders are as fast as the pump lets them be."""
    u = np.array([[0.4, 0.4, -0.4, 0.4, -0.4], [1.0, -1.0, 1.0, -1.0, 1.0]])
    state = plant_reset(BROKK_170, np.tile([0.0, 0.7, 0.6, 1.7, 1.0], (2, 1)))
    state = state._replace(z=np.ones_like(u))
    for _ in range(8):
        state = plant_step(BROKK_170, state, u)
    positive, negative = BROKK_170.column("speed_positive"), BROKK_170.column("speed_negative")
    opening = np.sign(u) * (np.abs(u) - 0.07) / 0.93
    ratio = pump_flow_ratio(BROKK_170, u)
    assert ratio[0] < 1 < ratio[1]
    expected = np.where(u > 0, positive, negative) * opening / np.maximum(1, ratio)[:, None]
    np.testing.assert_allclose(state.v, expected, rtol=0.01)


def test_robustness__has_a_row_for_each_variation_and_controller():
    short = [ALONG_Z._replace(goals=ALONG_Z.goals[MOVES - 2 : MOVES + 18])]
    controllers = {"rl": PIDS["jacobian_pid_ff_integral_dither"], "pid": PIDS["jacobian_pid_ff"]}
    table = robustness(BROKK_170, controllers, short, STARTS, 0)
    assert list(table) == list(variations(BROKK_170))
    machine, sensor = variations(BROKK_170)["delay +50 ms"]
    runs, traces = evaluate(machine, controllers, short, STARTS, 0, sensor=sensor)
    errors = {c: by_start(runs, c, "all", "velocity_error_mean") for c in controllers}
    ratio = pump_flow_ratio(machine, traces["pid", "z"].u)
    assert table["delay +50 ms"]["pid"] == {
        **mean_interval(errors["pid"]),
        "supply_demand": ratio.max(),
        "supply_limits": (ratio > 1).mean(),
        "rl_less": mean_interval(errors["rl"] - errors["pid"]),
    }
    assert "rl_less" not in table["nominal"]["rl"]
    error = {name: row["pid"]["mean"] for name, row in table.items()}
    assert error["nominal"] < min(error["delay +50 ms"], error["dead zone 10 %"])
    assert error["supply flow -20 %"] == error["nominal"]  # the pump has more than they need
    demand = {name: row["pid"]["supply_demand"] for name, row in table.items()}
    assert demand["supply flow -20 %"] == pytest.approx(demand["nominal"] / 0.8)


def test_near_singularities__drives_along_what_an_upright_arm_can_do_least():
    machine = BROKK_170
    starts = np.array([[0.0, 1.139, 0.97, 2.804, 1.948], [1.0, 1.2, 0.9, 2.8, 1.9]])
    net = small_net(machine, np.random.default_rng(0))
    pids = baselines(machine, net)
    controllers = {"rl": Idle(), **{name: pids[name] for name in PAPER_BASELINES}}
    result, claims, traces = near_singularities(machine, controllers, starts, 1.5, 3)
    halves = ("least_half", "least_quarter")
    assert list(traces) == [(c, s) for c in controllers for s in halves]
    assert all(trace.q.shape == (30, 2, 5) for trace in traces.values())
    np.testing.assert_array_equal(traces["rl", "least_half"].q[-1], starts)
    frames = kinematics.forward_kinematics(machine, starts)
    J = kinematics.jacobian(frames)[..., machine.driven]
    JJt = J @ J.swapaxes(-1, -2)
    np.testing.assert_allclose(result["manipulability"], np.sqrt(np.linalg.det(JJt)))
    np.testing.assert_allclose(result["least"], np.sqrt(np.linalg.eigvalsh(JJt)[:, 0]), rtol=1e-6)
    assert list(result["summary"]) == list(controllers)
    assert result["summary"]["rl"]["all"]["velocity_error_mean"] == pytest.approx(0.075 * 10 / 30)
    assert result["claims"] == {"rl": [claim.to_json() for claim in claims["rl"]]}
    assert len(claims["rl"]) == 3
    none = near_singularities(machine, controllers, starts[:0], 1.5, 3)
    assert none == ({"summary": {}, "claims": {}}, {}, {})
