"""The classical controllers: their gains as vectors and files, and their tuning."""

from dataclasses import replace

import numpy as np
import pytest
from helpers_machines import obedient_net
from hypothesis import given
from hypothesis import strategies as st

from brokk_min.beyond.strong_pid import StrongGains, StrongPID
from brokk_min.evaluation import baselines
from brokk_min.evaluation.sequences import tuning_set
from brokk_min.jacobian import Gains, JacobianController
from brokk_min.machine import BROKK_170

NET = obedient_net(BROKK_170)
HAND = baselines.baselines(BROKK_170, NET)
NAMES = ["jacobian_pid_k0.1", "jacobian_pid_k0.05", "jacobian_pid_ff", "jacobian_pid_ff_integral"]


def test_baselines__are_the_papers_two_and_two_stronger_ones():
    assert list(HAND) == NAMES
    assert [c.k for c in HAND.values()] == [0.1, 0.05, 0.1, 0.1]
    assert [type(c) for c in HAND.values()] == [*[JacobianController] * 2, *[StrongPID] * 2]
    assert HAND[NAMES[0]].gains is HAND[NAMES[1]].gains
    first, third = (baselines.gains_vector(HAND[NAMES[i]].gains) for i in (0, 2))
    np.testing.assert_array_equal(first, [*[1.0] * 4, *[8.0] * 4, *[0.05] * 4, 0.4])
    assert set(vars(HAND[NAMES[2]].gains)) == set(baselines.RANGES) and third[0] == 0.2


@given(st.integers(1, 6), st.integers(0, 3), st.booleans(), st.integers(0, 2**31))
def test_gains_of__is_the_inverse_of_gains_vector(n, rows, strong, seed):
    joints, one = np.zeros(n), np.zeros(1)
    like = StrongGains(*[joints] * 3, *[one] * 5) if strong else Gains(*[joints] * 3, one)
    vectors = np.random.default_rng(seed).normal(size=(rows, 3 * n + (5 if strong else 1)))
    gains = baselines.gains_of(like, vectors)
    assert type(gains) is type(like) and gains.ki.shape == (rows, n)
    np.testing.assert_array_equal(baselines.gains_vector(gains), vectors)
    low, high = baselines.gain_bounds(gains)
    assert low.shape == high.shape == vectors.shape[1:] and low[3 * n] > 0  # K is positive


def test_tune__finds_the_minimum_of_a_bowl_and_repeats_itself():
    """Gains that are 0 stay so."""
    one = np.ones(1)
    start = StrongGains(*[0.1 * one] * 3, 0.1 * one, 0.01 * one, *[0 * one] * 3)
    goal = np.array([1.0, 7.0, 0.12, 0.4, 0.03, 0.0, 0.0, 0.0])
    low, high = baselines.gain_bounds(start)

    def bowl(vectors):
        x = np.sqrt((vectors - low) / (high - low))
        return np.sum((x - np.sqrt((goal - low) / (high - low))) ** 2, axis=-1)

    result, costs = baselines.tune(start, bowl, 0, 60, "bowl")
    assert bowl(result) == pytest.approx(costs[-1]) and costs[-1] < 1e-3 < costs[0]
    np.testing.assert_allclose(result, goal, atol=0.3)
    assert not result[-3:].any() and ((low <= result) & (result <= high))[:5].all()
    assert len(costs) == 60 and (np.diff(costs) <= 0).all()
    again, _ = baselines.tune(start, bowl, 0, 60, "bowl")
    other, _ = baselines.tune(start, bowl, 1, 60, "bowl")
    np.testing.assert_array_equal(result, again)
    assert not np.array_equal(result, other)


def test_tuning_cost__is_the_mean_error_of_each_row_of_gains():
    """Without gains nothing moves: the error is the goal's size. Nets obey at once."""
    controller = HAND[NAMES[0]]
    start = np.array([[0.0, 0.5, 0.58, 1.71, 1.24], [1.0, 0.5, 0.58, 1.71, 1.24]])
    goals = np.tile([0.0, 0.1, 0.0], (8, 2, 1))  # 0.4 s
    goals[:, 1] *= 2
    given_gains = baselines.gains_vector(controller.gains)
    vectors = np.array([0 * given_gains, given_gains])
    of_plant = baselines.tuning_cost(controller, vectors, (start, goals), 0, 0.0)
    of_nets = baselines.tuning_cost(controller, vectors, (start, goals), 0, 0.0, NET)
    assert of_plant[0] == pytest.approx(0.15) and 0.1 < of_plant[1] < 0.15
    assert of_nets[0] == pytest.approx(0.15) and abs(of_nets[1] - of_plant[1]) > 0.003


def test_tune_baselines__keeps_the_better_of_two_on_other_goals():
    machine = replace(BROKK_170, rate=5.0, plant_dt=0.02)  # faster to simulate
    net = obedient_net(machine)
    tuned, record = baselines.tune_baselines(machine, net, 2, 1, 4, noise=0.0, longest=2)
    assert list(tuned) == NAMES and tuple(record) == baselines.TUNED
    np.testing.assert_array_equal(
        *(baselines.gains_vector(tuned[name].gains) for name in baselines.PAPER_BASELINES)
    )
    by_hand = baselines.baselines(machine, net)

    def cost(controller, runs, seed):
        vector = baselines.gains_vector(controller.gains)[None]
        task = tuning_set(machine, runs, seed, 2.0)
        return baselines.tuning_cost(controller, vector, task, seed, 0.0)[0]

    for name, of in record.items():
        generations = 2 if name == baselines.STRONGEST else 1
        assert of["seeds"] == (4, 5) and [len(costs) for costs in of["costs"]] == [generations] * 2
        assert max(costs[-1] for costs in of["costs"]) <= cost(by_hand[name], 2, 4) * (1 + 1e-6)
        assert min(of["fresh_costs"]) == pytest.approx(cost(tuned[name], 8, 6), rel=1e-6)


def test_write_gains__reads_back(tmp_path):
    meta = baselines.gains_metadata(BROKK_170, NET)
    other = {
        name: replace(c, gains=replace(c.gains, kp=c.gains.kp / 3)) for name, c in HAND.items()
    }
    baselines.write_gains(tmp_path / "gains.json", other, meta)
    read = baselines.read_gains(tmp_path / "gains.json", BROKK_170, NET)
    for name, of in read.items():
        vectors = (baselines.gains_vector(c.gains) for c in (of, other[name]))
        np.testing.assert_array_equal(*vectors)
    assert [c.k for c in read.values()] == [c.k for c in HAND.values()]


@pytest.mark.parametrize(
    ("meta", "change", "message"),
    [
        ({"machine": "digger"}, None, "machine: expected 'brokk170', got 'digger'"),
        ({"actuator": "0123"}, None, r"actuator: expected '\w+', got '0123'"),
        ({}, {"kp": np.ones(3)}, r"jacobian_pid_ff: expected 17 finite gains, got"),
        ({}, {"ki": np.array([1.0, np.nan, 1.0, 1.0])}, None),
    ],
)
def test_read_gains__refuses_other_machines_nets_and_numbers(tmp_path, meta, change, message):
    path = tmp_path / "gains.json"
    written = dict(HAND)
    if change:
        gains = replace(written["jacobian_pid_ff"].gains, **change)
        written["jacobian_pid_ff"] = replace(written["jacobian_pid_ff"], gains=gains)
    about = baselines.gains_metadata(BROKK_170, NET) | meta
    if message is None:  # JSON has no NaN
        with pytest.raises(ValueError):
            baselines.write_gains(path, written, about)
        return
    baselines.write_gains(path, written, about)
    with pytest.raises(ValueError, match=rf"^{path}: {message}"):
        baselines.read_gains(path, BROKK_170, NET)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"meta": 3}'])
def test_read_gains__refuses_what_is_no_file_of_gains(tmp_path, text):
    path = tmp_path / "gains.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=rf"^{path}: expected gains|^{path}: expected JSON"):
        baselines.read_gains(path, BROKK_170, NET)
