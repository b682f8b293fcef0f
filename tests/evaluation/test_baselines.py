"""The classical controllers: their gains as vectors and files, and their tuning."""

import json
from dataclasses import replace

import numpy as np
import pytest
from helpers_machines import obedient_net
from hypothesis import given
from hypothesis import strategies as st

from brokk_min.env import TaskConfig
from brokk_min.evaluation import baselines
from brokk_min.evaluation.sequences import tuning_set
from brokk_min.identification.files import SHIPPED
from brokk_min.jacobian import JacobianController
from brokk_min.learning.policy import load_policy
from brokk_min.machine import BROKK_170

NET = obedient_net(BROKK_170)
GAINS = {"kp": 1.0, "ki": 7.0, "kd": 0.12, "feedback": 0.4, "min_opening": 0.03}
NAMES = ["jacobian_pid_k0.1", "jacobian_pid_k0.05", "jacobian_pid_ff"]
NAMES += ["jacobian_pid_ff_integral", "jacobian_pid_ff_integral_dither"]


def controller(machine=BROKK_170, **gains):
    zero = dict.fromkeys(baselines.RANGES, 0.0)
    return JacobianController(machine, baselines.make_gains(machine, **zero | gains), 0.1, 0.5)


def machine_with_one_valve():
    joints = [replace(joint, driven=joint.name == "q3") for joint in BROKK_170.joints]
    return replace(BROKK_170, joints=tuple(joints))


def vector(controller):
    return baselines.gains_vector(controller.gains)


def test_baselines__are_the_papers_two_and_three_with_feedforward():
    result = baselines.baselines(BROKK_170, NET)
    assert list(result) == NAMES == [*baselines.PAPER_BASELINES, *NAMES[2:]]
    assert [c.k for c in result.values()] == [0.1, 0.05, 0.1, 0.1, 0.1]
    assert [name for name, c in result.items() if c.valves == "dither"] == NAMES[4:]
    assert [c.feedforward is not None for c in result.values()] == [False, False, *[True] * 3]
    table = baselines.gains_table(result)
    assert table["jacobian_pid_k0.1"] == table["jacobian_pid_k0.05"]
    assert table["jacobian_pid_k0.1"] == {
        "kp": [1.0] * 4,
        "ki": [8.0] * 4,
        "kd": [0.05] * 4,
        "feedback": [0.4],
        "min_opening": [0.015],
        "integral_feedback": [0.0],
        "start_boost": [0.0],
        "start_time": [0.0],
    }
    assert table["jacobian_pid_ff_integral"] == table["jacobian_pid_ff_integral_dither"]
    assert [table["jacobian_pid_ff"][name][0] for name in ("kp", "ki", "kd")] == [0.2, 0.5, 0.02]


@given(st.integers(1, 6), st.integers(0, 3), st.integers(0, 2**31))
def test_split_vector__is_the_inverse_of_gains_vector(n, rows, seed):
    vectors = np.random.default_rng(seed).normal(size=(rows, 3 * n + 5))
    np.testing.assert_array_equal(baselines.gains_vector(baselines.split_vector(vectors)), vectors)


@pytest.mark.parametrize("name", ["kp", "min_opening"])
@pytest.mark.parametrize("value", [[1.0, 2.0], np.nan, np.inf, "fast"])
def test_make_gains__refuses_other_numbers_of_gains_and_what_is_not_finite(name, value):
    with pytest.raises(ValueError):
        baselines.make_gains(BROKK_170, **GAINS | {name: value})


@given(st.lists(st.floats(0, 1), min_size=17, max_size=17))
def test_fractions_of__is_the_inverse_of_gains_of(x):
    gains = baselines.gains_of(BROKK_170, np.array(x))
    np.testing.assert_allclose(baselines.fractions_of(BROKK_170, gains), x, atol=1e-6)
    low, high = baselines.gain_bounds(BROKK_170)
    assert (baselines.gains_vector(gains) >= low).all()
    assert (baselines.gains_vector(gains) <= high + 1e-12).all()
    assert low[-5] > 0  # K of eq3 is positive definite


def test_gains_at_bound__names_gains_by_the_ends_of_their_range():
    start = controller(kp=2.0, ki=6.0, kd=0.1, feedback=0.5)
    changed = vector(start).copy()
    changed[[1, 4, 7, 13]] = [3.97, 0.0011, 11.6, 1e-7]  # of 4, 12, 12 and 0.06
    result = baselines.gains_at_bound(replace(start, gains=baselines.split_vector(changed)))
    assert result == ["kp q3", "ki q1", "min_opening"]


SMALL = dict.fromkeys(baselines.RANGES, 0.01)


def test_tune__finds_the_minimum_of_a_bowl_and_repeats_itself():
    absent = {"integral_feedback": 0.0, "start_boost": 0.0, "start_time": 0.0}
    start = controller(machine_with_one_valve(), **SMALL | absent)
    goal = np.array([*GAINS.values(), *absent.values()])

    def bowl(candidates):
        x = baselines.fractions_of(start.machine, candidates.gains)
        return np.sum((x - baselines.fractions_of(start.machine, by_hand)) ** 2, axis=-1)

    by_hand = baselines.split_vector(goal)
    result, costs = baselines.tune(start, bowl, seed=0, generations=60, label="bowl")
    assert bowl(result) == costs[-1] < 1e-3 < costs[0]
    assert not vector(result)[-3:].any()  # of a controller without integral and start
    again, _ = baselines.tune(start, bowl, seed=0, generations=60, label="bowl")
    other, _ = baselines.tune(start, bowl, seed=1, generations=60, label="bowl")
    np.testing.assert_array_equal(vector(result), vector(again))
    assert not np.array_equal(vector(result), vector(other))
    assert result.k == start.k
    assert len(costs) == 60 and (np.diff(costs) <= 0).all()


def test_tune_baselines__lowers_each_cost_and_records_it():
    machine = replace(BROKK_170, rate=5.0, plant_dt=0.02)  # faster to simulate
    net = obedient_net(machine)
    noiseless = TaskConfig(noise=0.0)
    tuned, record = baselines.tune_baselines(machine, net, 2, 1, 4, noiseless, longest=2)
    assert list(tuned) == NAMES and tuple(record) == baselines.TUNED
    np.testing.assert_array_equal(vector(tuned[NAMES[0]]), vector(tuned[NAMES[1]]))

    def cost(controller, runs=2, seed=4):
        batch = replace(controller, gains=baselines.split_vector(vector(controller)[None]))
        start, goals = tuning_set(machine, runs, seed, 2.0)
        return baselines.tuning_cost(batch, start, goals, seed, noiseless)[0]

    by_hand = baselines.baselines(machine, net)
    for name, of in record.items():
        generations = 2 if name in baselines.WITH_INTEGRAL else 1
        assert of["seed"] == 4 and len(of["cost"]) == len(of["second_cost"]) == generations
        assert max(of["cost"][-1], of["second_cost"][-1]) <= cost(by_hand[name]) * (1 + 1e-6)
        assert of["fresh_cost"] == pytest.approx(cost(tuned[name], 8, 6), rel=1e-6)
        assert of["at_bound"] == baselines.gains_at_bound(tuned[name])
    for name, other in (baselines.WITH_INTEGRAL, baselines.WITH_INTEGRAL[::-1]):
        lent = replace(tuned[name], gains=tuned[other].gains)
        assert cost(tuned[name], 8, 6) <= cost(lent, 8, 6)


def test_tuning_cost__is_that_of_the_plant_that_is_named():
    """Nets that obey at once follow a goal that the plant's valves cannot."""
    net = obedient_net(BROKK_170)
    controller = baselines.baselines(BROKK_170, net)["jacobian_pid_k0.1"]
    batch = replace(controller, gains=baselines.split_vector(vector(controller)[None]))
    start = np.array([[0.0, 0.5, 0.58, 1.71, 1.24]])
    goals = np.tile([0.0, 0.1, 0.0], (8, 1, 1))  # 0.4 s
    noiseless = TaskConfig(noise=0.0)
    of_plant, of_nets = (
        baselines.tuning_cost(batch, start, goals, 0, noiseless, plant)[0] for plant in (None, net)
    )
    assert 0.08 < of_plant <= 0.1 and of_nets != pytest.approx(of_plant, abs=0.01)


def test_read_gains__reads_the_files_of_the_package_and_their_older_names(tmp_path):
    folder = SHIPPED / BROKK_170.name
    net = load_policy(folder / "policy.npz", BROKK_170).net
    expected = baselines.gains_table(baselines.read_gains(folder / "gains.json", BROKK_170, net))
    text = (folder / "gains.json").read_text()
    assert json.loads(text)["gains"] == expected
    old, new = ("ready", "min_opening") if '"ready"' in text else ("min_opening", "ready")
    path = tmp_path / "gains.json"
    path.write_text(text.replace(f'"{old}"', f'"{new}"'))
    assert baselines.gains_table(baselines.read_gains(path, BROKK_170, net)) == expected


@pytest.mark.parametrize(
    ("meta", "missing", "message"),
    [
        ({}, "jacobian_pid_ff", r"gains\.jacobian_pid_ff: .* tune again"),
        ({"machine": "digger"}, "", "machine: expected 'brokk170', got 'digger'"),
        ({"actuator": "0123456789abcdef"}, "", r"actuator: expected '\w+', got '0123456789abcdef'"),
        ({"actuator": None}, "", "meta.actuator: expected text of .*, got None"),
    ],
)
def test_read_gains__refuses_other_baselines_machines_and_nets(tmp_path, meta, missing, message):
    path = tmp_path / "gains.json"
    written = baselines.baselines(BROKK_170, NET)
    written.pop(missing, None)
    own = baselines.gains_metadata(BROKK_170, NET)
    baselines.write_gains(path, written, own | meta)
    with pytest.raises(ValueError, match=rf"gains\.json: {message}"):
        baselines.read_gains(path, BROKK_170, NET)
