"""Robustness: other encoders and machines, the table over them, motion near singularities."""

import numpy as np
import pytest
from helpers_machines import POSE, Idle, obedient_net, small_net

from brokk_min.evaluation import robustness as module
from brokk_min.evaluation.baselines import PAPER_BASELINES, baselines
from brokk_min.evaluation.metrics import by_start, evaluate, mean_interval
from brokk_min.evaluation.robustness import near_singularities, robustness, variations
from brokk_min.evaluation.rollout import Trace
from brokk_min.evaluation.sequences import task_sequences
from brokk_min.kinematics import forward_kinematics, jacobian
from brokk_min.machine import BROKK_170, read_encoder

Q = np.cumsum(np.full((4000, 2, 5), 0.01), axis=0)  # ticks of two machines
PIDS = baselines(BROKK_170, obedient_net(BROKK_170))
STARTS = np.tile(BROKK_170.q_start, (2, 1))
ALONG_Z = task_sequences(BROKK_170)[2]
MOVES = np.flatnonzero(ALONG_Z.goals.any(axis=1))[0]
UPRIGHT = [0.0, 1.139, 0.97, 2.804, 1.948]  # tool 0.1 m from the slew axis


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
    result = variations(BROKK_170)
    assert len(result) == 12 and result["nominal"][0] is BROKK_170
    rng = np.random.default_rng(0)
    sensors = [name for name, (_, sensor) in result.items() if sensor(rng) is not read_encoder]
    assert sensors == ["encoder noise of a count", "one sample in 20 lost"]
    assert all(result[name][0] is BROKK_170 for name in sensors)
    zones = BROKK_170.dead_zones
    changed = {
        "supply flow -20 %": ("pump_flow", 0.00084),
        "supply flow -70 %": ("pump_flow", 0.000315),
        "valve gain -20 %": ("cylinder_speeds", 0.8 * BROKK_170.cylinder_speeds),
        "valve gain +20 %": ("cylinder_speeds", 1.2 * BROKK_170.cylinder_speeds),
        "up -15 %, down +15 %": ("cylinder_speeds", BROKK_170.cylinder_speeds * [0.85, 1.15]),
        "dead zone 5 %": ("dead_zones", 0 * zones + 0.05),
        "dead zone 10 %": ("dead_zones", 0 * zones + 0.1),
        "delay +25 ms": ("delay", 0.065),
        "delay +50 ms": ("delay", 0.09),
    }
    fields = ("pump_flow", "cylinder_speeds", "dead_zones", "delay", "tau_spool")
    for name, (field, value) in changed.items():
        machine = result[name][0]
        np.testing.assert_allclose(getattr(machine, field), value)
        for other in set(fields) - {field}:
            np.testing.assert_array_equal(getattr(machine, other), getattr(BROKK_170, other))


def test_robustness__has_a_row_for_each_variation_and_controller():
    short = [ALONG_Z._replace(goals=ALONG_Z.goals[MOVES - 2 : MOVES + 18])]
    controllers = {"idle": Idle(), "pid": PIDS["jacobian_pid_ff"]}
    table = robustness(BROKK_170, controllers, short, STARTS, 0)
    assert list(table) == list(variations(BROKK_170))
    machine, sensor = variations(BROKK_170)["delay +50 ms"]
    runs, _ = evaluate(machine, controllers, short, STARTS, 0, sensor=sensor)
    error = by_start(runs, "pid", "all", "velocity_error_mean")
    assert table["delay +50 ms"]["pid"] == mean_interval(error)
    errors = {name: row["pid"]["mean"] for name, row in table.items()}
    assert errors["nominal"] < min(errors["delay +50 ms"], errors["dead zone 10 %"])
    assert errors["supply flow -20 %"] == errors["nominal"]  # the pump has more than they need
    assert table["delay +50 ms"]["idle"] == table["nominal"]["idle"]


def test_singular_sequence__moves_where_the_joints_must_move_most():
    """By hand: close to the slew axis sideways motion is the hardest."""
    starts = np.array([UPRIGHT, [0.5, *UPRIGHT[1:]], POSE])
    goals = module.singular_sequence(BROKK_170, starts).goals
    assert goals.shape == (360, 3, 3)
    speeds = np.linalg.norm(goals, axis=-1)
    np.testing.assert_allclose(np.unique(speeds.round(9)), [0.0, 0.05, 0.1])
    direction = goals[30] / 0.1
    np.testing.assert_allclose(direction[0], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(direction[1], [-np.sin(0.5), np.cos(0.5), 0], atol=1e-12)
    J = jacobian(forward_kinematics(BROKK_170, starts))[..., BROKK_170.driven]
    J_inv = np.linalg.pinv(J)
    hardest = np.linalg.norm((J_inv @ direction[..., None])[..., 0], axis=-1)
    others = np.random.default_rng(0).normal(size=(500, 1, 3))
    others /= np.linalg.norm(others, axis=-1, keepdims=True)
    assert (np.linalg.norm((J_inv @ others[..., None])[..., 0], axis=-1) <= hardest + 1e-9).all()


def test_speed_fraction__is_of_goals_that_last_near_singularities():
    """Stretched and ordinary arms, and a goal that ends early; the first 0.6 s do not count."""
    stretched = np.array([0.3, 0.5, 0.1, np.pi, 3 * np.pi / 4])
    goals = np.zeros((30, 4, 3))
    goals[..., 0] = [0.2, 0.2, 0.4, 0.2]
    goals[5:, 3] = 0.0
    q = np.tile(np.stack([stretched, POSE, stretched, stretched]), (30, 1, 1))
    v_tool = np.tile([0.1, 0.3, 0.0], (30, 4, 1))
    v_tool[:12] = 9.0
    trace = Trace(q, 0 * q, q, 0 * q, v_tool, v_tool, v_tool[..., 0])
    fraction = module.speed_fraction(BROKK_170, trace, goals)
    assert fraction[[0, 2]] == pytest.approx([0.5, 0.25]) and np.isnan(fraction[[1, 3]]).all()


def test_near_singularities__drives_along_what_an_upright_arm_can_do_least():
    starts = np.array([UPRIGHT, [1.0, 1.2, 0.9, 2.8, 1.9]])
    pids = baselines(BROKK_170, small_net(BROKK_170, np.random.default_rng(0)))
    result = near_singularities(BROKK_170, {"rl": Idle()}, pids, starts, 2.0, 3)
    assert list(result["speed"]) == list(result["jerk"]) == ["rl", *PAPER_BASELINES]
    assert result["speed"]["rl"] == result["jerk"]["rl"] == [0.0, 0.0]  # it stands still
    assert result["starts"] == starts.tolist()
    assert min(result["jerk"][PAPER_BASELINES[1]]) > 0
    assert near_singularities(BROKK_170, {"rl": Idle()}, pids, starts[:0], 1.5, 3) == {}
