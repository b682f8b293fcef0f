"""The classical controllers: their gains as vectors and files, and their tuning."""

import re
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from helpers_machines import Idle, obedient_net, pids

from brokk_min.actuator import PLANT
from brokk_min.beyond.strong_pid import StrongPID
from brokk_min.evaluation import baselines
from brokk_min.evaluation.sequences import tuning_set
from brokk_min.jacobian import Gains, JacobianController
from brokk_min.machine import BROKK_170

NET = obedient_net(BROKK_170)
HAND = pids(BROKK_170, NET)
NAMES = [baselines.RAW, baselines.BY_HAND, baselines.OPTIMISED, baselines.STRONGEST]


def test_baselines__have_the_papers_structure_but_for_the_strongest():
    assert list(HAND) == NAMES
    assert [c.k for c in HAND.values()] == [0.1] * 4
    assert [type(c) for c in HAND.values()] == [*[JacobianController] * 3, StrongPID]
    opening = np.array([[0.1, -0.2, 0.0, 0.5]])
    raw, compensated = (127 * HAND[name].command(opening)[:, [0, 2, 3, 4]] for name in NAMES[:2])
    np.testing.assert_allclose(raw, [[13, -25, 0, 64]])
    np.testing.assert_allclose(compensated, [[21, -33, 0, 68]])  # 127 (0.07 + 0.93 opening)


def test_first_gains__by_hand_are_those_of_the_rule():
    """P overshoots by 20 % at twice the gain and 10 % more; so does the next larger I."""
    gains = baselines.first_gains(BROKK_170)
    hand = gains["pid_by_hand"]
    for i, (p, k) in enumerate(zip(hand.kp, hand.ki, strict=True)):
        for rows in ([[0, 2 * p, 2.22 * p], [0, 0, 0]], [[p, p, p], [0, k, 1.11 * k]]):
            trial = BROKK_170, BROKK_170, PLANT, i, *np.array(rows)
            assert baselines.last_before_overshoot(*trial) == 1
    assert not hand.kd.any() and (gains["pid_by_hand_raw"].kp > hand.kp).all()


def test_tune__finds_the_minimum_of_a_bowl_and_repeats_itself():
    start, goal = Gains(*np.full((4, 1), 0.1)), Gains(*np.array([[1.0], [7.0], [0.12], [0.4]]))

    def bowl(gains):
        off = [value / vars(goal)[name] - 1 for name, value in vars(gains).items()]
        return np.square(off).sum(axis=(0, -1))

    result, again = (baselines.tune(start, bowl, 0, 60) for _ in range(2))
    assert bowl(result) < 1e-3 < bowl(baselines.tune(start, bowl, 0, 1))
    assert result == again != baselines.tune(start, bowl, 1, 60)
    kept = baselines.tune(goal, bowl, 0, 1)  # the start itself is a candidate
    np.testing.assert_allclose([*vars(kept).values()], [*vars(goal).values()], atol=1e-9)


def test_tuning_cost__is_the_mean_error_of_each_row_of_gains():
    """Without gains nothing moves: the error is the goal's size. Nets obey at once."""
    controller = HAND["jacobian_pid_k0.1"]
    start = np.array([[0.0, 0.5, 0.58, 1.71, 1.24], [1.0, 0.5, 0.58, 1.71, 1.24]])
    goals = np.tile([0.0, 0.1, 0.0], (8, 2, 1))  # 0.4 s
    goals[:, 1] *= 2
    rows = Gains(*(np.outer([0, 1], array) for array in vars(controller.gains).values()))
    cost = partial(baselines.tuning_cost, controller, (start, goals), 0)
    of_plant, of_nets = cost(PLANT, rows), cost(NET, rows)
    assert of_plant[0] == pytest.approx(0.15) and 0.1 < of_plant[1] < 0.15
    assert of_nets[0] == pytest.approx(0.15) and abs(of_nets[1] - of_plant[1]) > 0.003


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"machine": "brokk170"', '"machine": "digger"', "machine: expected 'brokk170', got 'dig"),
        ('"actuator": "', '"actuator": "0', r"actuator: expected '\w+', got '0\w+'"),
        ('"kp"', '"kq"', "expected gains of"),
        (
            '"gains": {',
            '"gains": {}, "others": {',
            "expected gains of pid_by_hand_raw, pid_by_hand, j",
        ),
        (
            '"kp": [',
            '"kp": [1.0,',
            r"pid_by_hand_raw: kp: expected 4 numbers from 0 on, got \[1.0,",
        ),
    ],
)
def test_read_gains__reads_what_was_written_of_the_machine_alone(tmp_path, old, new, message):
    path, meta = tmp_path / "gains.json", baselines.gains_metadata(BROKK_170, NET)
    other = {k: replace(c, gains=replace(c.gains, kp=c.gains.kp / 3)) for k, c in HAND.items()}
    baselines.write_gains(path, other, meta)
    read = baselines.read_gains(path, BROKK_170, NET)
    assert list(read) == NAMES
    for name, pid in read.items():
        np.testing.assert_equal(vars(pid.gains), vars(other[name].gains))
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(ValueError, match=rf"^{path}: {message}"):
        baselines.read_gains(path, BROKK_170, NET)


def test_beside_pids__measures_on_motions_that_no_pid_was_tuned_on():
    """Who stands still errs by the goals themselves."""
    start, goals = tuning_set(BROKK_170, 16, 1, 10.0)
    standing = np.linalg.norm(goals, axis=-1).mean()
    three = (baselines.BY_HAND, baselines.OPTIMISED, baselines.STRONGEST)
    said = baselines.beside_pids(BROKK_170, {name: Idle() for name in three})(Idle())
    assert re.findall(r"\d\.\d+", said) == 4 * [f"{standing:.4f}"]
    assert re.findall("by hand|optimised|strongest", said) == ["by hand", "optimised", "strongest"]
    assert not {*map(tuple, start)} & {*map(tuple, tuning_set(BROKK_170, 16, 0, 10.0)[0])}
