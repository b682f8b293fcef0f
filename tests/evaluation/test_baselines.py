"""The classical controllers: their gains as vectors and files, and their tuning."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers_machines import obedient_net
from hypothesis import given
from hypothesis import strategies as st

from brokk_min.evaluation import baselines
from brokk_min.evaluation.sequences import tuning_set
from brokk_min.identification.files import SHIPPED
from brokk_min.identification.net_file import fingerprint, load_net, save_net
from brokk_min.jacobian import Gains, JacobianController
from brokk_min.learning.policy import load_policy
from brokk_min.machine import BROKK_170, Array, Machine

NET = obedient_net(BROKK_170)
GAINS = {"kp": 1.0, "ki": 7.0, "kd": 0.12, "feedback": 0.4, "min_opening": 0.03}
NAMES = ["jacobian_pid_k0.1", "jacobian_pid_k0.05", "jacobian_pid_ff", "jacobian_pid_ff_awake"]


def controller(machine: Machine = BROKK_170, **gains: float) -> JacobianController:
    zero = dict.fromkeys(baselines.RANGES, 0.0)
    return JacobianController(machine, baselines.make_gains(machine, **zero | gains), 0.1, 0.5)


def machine_with_one_valve() -> Machine:
    joints = [replace(joint, driven=joint.name == "q3") for joint in BROKK_170.joints]
    return replace(BROKK_170, joints=tuple(joints))


def vector(controller: JacobianController) -> Array:
    return baselines.gains_vector(controller.gains)


def test_baselines__are_the_papers_two_and_two_with_feedforward() -> None:
    result = baselines.baselines(BROKK_170, NET)
    assert list(result) == NAMES == [*baselines.PAPER_BASELINES, *NAMES[2:]]
    assert [c.k for c in result.values()] == [0.1, 0.05, 0.1, 0.1]
    assert [c.always_open for c in result.values()] == [False, False, False, True]
    assert [c.feedforward is not None for c in result.values()] == [False, False, True, True]
    table = baselines.gains_table(result)
    assert table["jacobian_pid_k0.1"] == table["jacobian_pid_k0.05"]
    assert table["jacobian_pid_k0.1"] == {
        "kp": [1.0] * 4,
        "ki": [8.0] * 4,
        "kd": [0.05] * 4,
        "feedback": [0.4],
        "min_opening": [0.015],
    }
    assert table["jacobian_pid_ff"] == table["jacobian_pid_ff_awake"]
    assert [table["jacobian_pid_ff"][name][0] for name in ("kp", "ki", "kd")] == [0.2, 0.5, 0.02]


# --- gains ----------------------------------------------------------------------------------------


def test_split_vector__orders_gains_by_name_and_joint() -> None:
    gains = baselines.split_vector(np.arange(28).reshape(2, 14))
    assert gains.kp.tolist() == [[0, 1, 2, 3], [14, 15, 16, 17]]
    assert gains.ki[0].tolist() == [4, 5, 6, 7]
    assert gains.kd[1].tolist() == [22, 23, 24, 25]
    assert gains.feedback.tolist() == [[12], [26]]
    assert gains.min_opening.tolist() == [[13], [27]]


@given(st.integers(1, 6), st.integers(0, 3), st.integers(0, 2**31))
def test_split_vector__is_the_inverse_of_gains_vector(n: int, rows: int, seed: int) -> None:
    vectors = np.random.default_rng(seed).normal(size=(rows, 3 * n + 2))
    np.testing.assert_array_equal(baselines.gains_vector(baselines.split_vector(vectors)), vectors)


@pytest.mark.parametrize("name", ["kp", "min_opening"])
@pytest.mark.parametrize("value", [[1.0, 2.0], np.nan, np.inf, "fast"])
def test_make_gains__refuses_other_numbers_of_gains_and_what_is_not_finite(
    name: str, value: object
) -> None:
    with pytest.raises(ValueError):
        baselines.make_gains(BROKK_170, **GAINS | {name: value})


def test_gains_at_bound__names_gains_within_a_hundredth_of_their_range() -> None:
    start = controller(kp=2.0, ki=6.0, kd=0.1, feedback=0.5, min_opening=0.0)
    changed = vector(start).copy()
    changed[[1, 4, 7]] = [3.97, 0.11, 11.8]  # of 4 and 12: within 1 %, within 1 %, not
    result = baselines.gains_at_bound(replace(start, gains=baselines.split_vector(changed)))
    assert result == ["kp q3", "ki q1", "min_opening"]


# --- tuning ---------------------------------------------------------------------------------------


def test_tune__finds_the_minimum_of_a_bowl_and_repeats_itself() -> None:
    start = controller(machine_with_one_valve())
    low, high = baselines.gain_bounds(start.machine)
    goal = np.array(list(GAINS.values()))

    def bowl(candidates: JacobianController) -> Array:
        return np.sum(((vector(candidates) - goal) / (high - low)) ** 2, axis=-1)

    result, costs = baselines.tune(start, bowl, seed=0, generations=60, label="bowl")
    np.testing.assert_allclose(vector(result), goal, atol=0.02 * (high - low).max())
    assert (np.abs(vector(result) - goal) < 0.02 * (high - low)).all()
    again, _ = baselines.tune(start, bowl, seed=0, generations=60, label="bowl")
    other, _ = baselines.tune(start, bowl, seed=1, generations=60, label="bowl")
    np.testing.assert_array_equal(vector(result), vector(again))
    assert not np.array_equal(vector(result), vector(other))
    assert result.k == start.k and not vector(start).any()
    assert len(costs) == 60 and (np.diff(costs) <= 0).all()
    assert costs[-1] == bowl(result) < 0.01 * costs[0]


def test_tune__is_never_worse_than_the_gains_it_starts_with() -> None:
    start = controller(machine_with_one_valve(), **GAINS)

    def distance(candidates: JacobianController) -> Array:
        return np.abs(vector(candidates) - vector(start)).sum(axis=-1)

    result, costs = baselines.tune(start, distance, seed=0, generations=1, label="start")
    assert costs == [0.0]
    np.testing.assert_array_equal(vector(result), vector(start))


def test_tune__searches_near_its_start_within_the_ranges() -> None:
    low, high = baselines.gain_bounds(BROKK_170)
    start = replace(controller(), gains=baselines.split_vector((low + high) / 2))
    searched: list[Array] = []

    def cost(candidates: JacobianController) -> Array:
        searched.append(vector(candidates))
        return np.arange(float(len(searched[-1])))

    baselines.tune(start, cost, seed=0, generations=1, label="start")
    first = searched[0]
    assert first.shape == (32, 14)
    np.testing.assert_allclose(first[0], vector(start))
    assert 0.13 < ((first[1:] - vector(start)) / (high - low)).std() < 0.17
    assert all(((rows >= low) & (rows <= high)).all() for rows in searched)


def test_tuning_cost__of_many_candidates_is_that_of_each() -> None:
    """A controller without gains never moves: its cost is the mean goal. Rows are not mixed up."""
    start, goals = tuning_set(BROKK_170, 3, 7, seconds=2.0)
    gains = controller(kp=1.0, ki=8.0, feedback=0.4, min_opening=0.015).gains
    tuned = baselines.gains_vector(gains)
    none = np.zeros_like(tuned)
    many = replace(controller(), gains=baselines.split_vector(np.stack([none, tuned, none])))
    cost = baselines.tuning_cost(many, start, goals, 0)
    goal = np.linalg.norm(goals, axis=-1).mean()
    np.testing.assert_allclose(cost[[0, 2]], goal, rtol=1e-6)
    assert cost[1] < 0.8 * goal


def test_tune_baselines__lowers_each_cost_and_records_it() -> None:
    machine = replace(BROKK_170, rate=5.0, plant_dt=0.02)  # faster to simulate
    net = obedient_net(machine)
    tuned, record = baselines.tune_baselines(machine, net, runs=2, generations=1, seed=3)
    assert list(tuned) == list(record) == NAMES
    start, goals = tuning_set(machine, 2, 3)
    for name, by_hand in baselines.baselines(machine, net).items():
        gains = baselines.split_vector(vector(by_hand)[None])
        first = baselines.tuning_cost(replace(by_hand, gains=gains), start, goals, 3)
        assert record[name]["seed"] == 3 and len(record[name]["cost"]) == 1
        assert record[name]["cost_anew"] == pytest.approx(record[name]["cost"][-1], rel=0.1)
        assert record[name]["cost"][-1] < 1.05 * first[0]
        assert record[name]["at_bound"] == baselines.gains_at_bound(tuned[name])


# --- files ----------------------------------------------------------------------------------------


def test_read_gains__reads_what_write_gains_wrote(tmp_path: Path) -> None:
    path = tmp_path / "gains.json"
    written = baselines.baselines(BROKK_170, NET)
    gains = Gains(np.arange(4.0), np.arange(4.0), np.zeros(4), np.ones(1), np.zeros(1))
    written["jacobian_pid_ff"] = replace(written["jacobian_pid_ff"], gains=gains)
    baselines.write_gains(path, written, baselines.gains_metadata(BROKK_170, NET) | {"seed": 3})
    result = baselines.read_gains(path, BROKK_170, NET)
    assert baselines.gains_table(result) == baselines.gains_table(written)


def test_read_gains__reads_the_files_of_the_package_and_their_older_names(tmp_path: Path) -> None:
    folder = SHIPPED / BROKK_170.name
    net = load_policy(folder / "policy.npz", BROKK_170).net
    expected = baselines.gains_table(baselines.read_gains(folder / "gains.json", BROKK_170, net))
    text = (folder / "gains.json").read_text()
    old, new = ("ready", "min_opening") if '"ready"' in text else ("min_opening", "ready")
    path = tmp_path / "gains.json"
    path.write_text(text.replace(f'"{old}"', f'"{new}"'))
    assert baselines.gains_table(baselines.read_gains(path, BROKK_170, net)) == expected


@pytest.mark.parametrize(
    ("meta", "message"),
    [
        ({"machine": "digger"}, "digger"),
        ({"actuator": "0123456789abcdef"}, "0123456789abcdef"),
        ({"actuator": None}, "'actuator': None"),
    ],
)
def test_read_gains__refuses_gains_of_another_machine_or_other_nets(
    tmp_path: Path, meta: dict[str, str], message: str
) -> None:
    path = tmp_path / "gains.json"
    own = baselines.gains_metadata(BROKK_170, NET)
    baselines.write_gains(path, baselines.baselines(BROKK_170, NET), own | meta)
    expected = rf"gains.json: expected gains for brokk170 with nets {own['actuator']}.*{message}"
    with pytest.raises(ValueError, match=expected):
        baselines.read_gains(path, BROKK_170, NET)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kp": [1, 2]}, "shape"),
        ({"ki": [1, 2, 3, float("nan")]}, "finite"),
        ({"kd": "fast"}, "fast"),
    ],
)
def test_read_gains__refuses_damaged_gains(
    tmp_path: Path, change: dict[str, object], message: str
) -> None:
    path = tmp_path / "gains.json"
    table = baselines.gains_table(baselines.baselines(BROKK_170, NET))
    table["jacobian_pid_ff"] |= change
    meta = baselines.gains_metadata(BROKK_170, NET)
    path.write_text(json.dumps({"meta": meta, "gains": table}))
    with pytest.raises(ValueError, match=rf"gains.json: expected gains for brokk170.*{message}"):
        baselines.read_gains(path, BROKK_170, NET)


def test_gains_metadata__changes_with_the_nets_and_survives_a_file(tmp_path: Path) -> None:
    save_net(tmp_path / "net.npz", NET)
    assert fingerprint(load_net(tmp_path / "net.npz")) == fingerprint(NET)
    weights = (NET.weights[0] + 1e-6, *NET.weights[1:])
    others = (NET.select(["q1"]), replace(NET, rate=25.0), replace(NET, weights=weights))
    assert len({fingerprint(other) for other in (NET, *others)}) == 4
