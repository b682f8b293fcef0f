"""Adaptation: what it learns of known valves, what it leaves alone, and the files it keeps."""

import json
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brokk_min._files import SHIPPED
from brokk_min.actuator import PLANT
from brokk_min.beyond import adaptation
from brokk_min.beyond.adaptation import Adaptive, Known, adapt, unknown, valves
from brokk_min.evaluation import adaptive, sequences
from brokk_min.evaluation.reproduce import variations
from brokk_min.evaluation.rollout import Together, rollout
from brokk_min.identification.validation import task_log
from brokk_min.identification.valve_report import KEPT, describe, from_log, load_known, save_known
from brokk_min.learning.policy import load_policy
from brokk_min.machine import BROKK_170, valve_opening
from brokk_min.settings import TaskConfig
from tests.helpers_machines import Idle, coarse

POLICY = load_policy(SHIPPED / "brokk170" / "policy.npz", BROKK_170)
NET, DRIVEN = POLICY.net, BROKK_170.driven
VARIED = variations(coarse(BROKK_170, 0.0125))  # four Euler steps a tick: fast


DRIVES = sequences.tuning_set(BROKK_170, 8, 55, 20.0)  # starts [rad], goals [m/s] of 20 s


class Result(NamedTuple):
    error: float
    plain: float
    known: Known


def error_of(truth, controller):
    """Its mean error on the drives [m/s]."""
    trace = rollout(truth, controller, *DRIVES, 0.05, np.random.default_rng(0))
    return np.linalg.norm(DRIVES[1] - trace.v_tool, axis=-1).mean()


@cache
def driven(name):
    """What our agent learns in the drives, with its error as it learns and without."""
    learner = Adaptive(POLICY, NET, BROKK_170)
    both = Together([learner, POLICY])
    trace = rollout(VARIED[name], both, *DRIVES, 0.05, np.random.default_rng(0), copies=2)
    errors = np.linalg.norm(np.tile(DRIVES[1], (2, 1)) - trace.v_tool, axis=-1)
    return Result(*errors.reshape(len(errors), 2, -1).mean(axis=(0, 2)), learner.known)


@pytest.mark.parametrize(
    ("name", "k", "d"),
    [
        ("valve gain -20 %", (0.8, 0.8), 0.0),
        ("up -15 %, down +15 %", (0.85, 1.15), 0.0),
        ("dead zone 5 %", (0.93 / 0.95,) * 2, 0.02 / 0.93),
    ],
)
def test_adaptive__learns_speed_and_opening_of_each_valve_and_needs_less(name, k, d):
    error, plain, known = driven(name)
    seen = known.seconds > 2.0
    found_k, found_d = (np.where(seen, of, np.nan) for of in valves(known))
    assert seen.any(axis=0).all()  # each valve has moved in some run
    np.testing.assert_allclose(np.nanmean(found_k, axis=0), np.tile(k, (4, 1)), atol=0.1)
    np.testing.assert_allclose(np.nanmean(found_d, axis=0), d, atol=0.012)
    assert error < 0.9 * plain


@pytest.mark.parametrize("name", ["nominal", "delay +50 ms", "supply flow -70 %"])
def test_adaptive__changes_nothing_where_the_valves_are_those_of_the_logs(name):
    error, plain, known = driven(name)
    assert error == pytest.approx(plain, rel=0.012)
    assert abs(valves(known)[0] - 1).mean() < 0.03


def test_adaptive__only_listens_if_it_does_not_apply():
    learner = Adaptive(POLICY, NET, BROKK_170, applies=False)
    error = error_of(VARIED["valve gain -20 %"], learner)
    assert error == pytest.approx(driven("valve gain -20 %").plain, rel=1e-6)
    np.testing.assert_allclose(valves(learner.known)[0].mean(), 0.8, atol=0.05)


def test_adaptive__goes_on_with_what_it_knows_and_begins_anew_for_other_numbers():
    truth, (cold, _, known) = VARIED["valve gain -20 %"], driven("valve gain -20 %")
    learner, (start, goals) = Adaptive(POLICY, NET, BROKK_170, known), DRIVES
    assert error_of(truth, learner) < 0.97 * cold
    rollout(truth, learner, start[:2], goals[:20, :2], 0.0, np.random.default_rng(0))
    assert learner.known.seconds.shape == (2, 4, 2) and learner.known.seconds.max() < 1.01


def test_valves__by_hand_one_valve_that_is_sure_draws_the_mean_and_no_evidence_counts_nothing():
    k, d = valves(unknown((1, 4)))
    assert (k == 1).all() and (d == 0).all()
    known = unknown((1, 4))
    known.A[0, 0, 0, 0, 0, 0], known.b[0, 0, 0, 0, 0] = 1e6, -0.2e6  # of q1 up: k = 0.8, certainly
    k, _ = valves(known)
    own, shared = adaptation.OWN[0][0] ** 2, adaptation.SHARED[0][0] ** 2
    mean = -0.2 * shared / (own + shared)  # what it says of the mean of all
    ratio = 0.2 * 0.2e6  # of log-likelihoods: 2 b x - A x^2
    shrunk = 1 - adaptation.LIKELIER[0] / ratio
    assert k[0, 0, 0] == pytest.approx(1 - 0.2 * shrunk, abs=1e-5)
    np.testing.assert_allclose(k[0].ravel()[1:], 1 + mean * shrunk, atol=1e-5)
    known.A[0, 0, 0, 1, 0, 0], known.b[0, 0, 0, 1, 0] = 1e6, 0.1e6  # of late k = 1.1
    assert valves(known)[0][0, 0, 0] == pytest.approx(1.1, abs=1e-3)
    known.A[:], known.b[:] = 0, 0
    known.A[0, 0, 0, 0, 0, 0], known.b[0, 0, 0, 0, 0] = 10, -2  # little is known
    assert (valves(known)[0] == 1).all()


def test_valves__keeps_the_bounds():
    known = unknown((1, 4))
    known.A[..., 0, 0], known.b[..., 0] = 1e6, -0.9e6
    known.A[..., 1, 1], known.b[..., 1] = 1e9, 1e9
    k, d = valves(known)
    assert (k == 0.6).all() and (d == 0.06).all()


units = st.floats(-1, 1)


@given(units, st.floats(0.01, 0.2), st.floats(0.6, 1.5), st.floats(-0.06, 0.06))
def test_adapt__opens_the_other_valve_as_the_first_and_back(u, zone, k, d):
    zones, pairs = np.array([zone, zone]), (np.array([k, k]), np.array([d, d]))
    other = adapt(np.array(u), zones, *pairs)
    back = adapt(other, zones, *pairs, inverse=True)
    begins = zone - (1 - zone) * d
    if begins > 1e-3:
        assert back == pytest.approx(u, abs=1e-6)
        opening = float(valve_opening(u, zones))
        wanted = np.sign(u) * max(0.0, (abs(float(other)) - begins) / (1 - zone)) * k
        assert wanted == pytest.approx(opening, abs=1e-9)


def test_learn__counts_no_tick_at_the_end_of_a_range():
    m = BROKK_170
    q = np.array([(j.q_min + j.q_max) / 2 for j in m.joints])[None].repeat(2, axis=0)
    q[1, 4] = m.joints[4].q_max

    class Up(Idle):
        def __call__(self, measured, state):
            u = np.zeros((len(measured.q), m.n))
            u[:, 4] = 0.5
            return u, state

    learner = Adaptive(Up(), NET, m)
    rollout(m, learner, q, np.zeros((30, 1, 3)), 0.0, np.random.default_rng(0))
    seconds = learner.known.seconds
    assert seconds[0, 3, 0] > 0.5 and seconds[1].max() == 0
    assert seconds[0, :3].max() == 0  # nothing else has moved


def test_describe__says_how_each_valve_differs_and_when_to_fit_again():
    one = Known(*(of[:1].copy() for of in driven("valve gain -20 %").known))
    lines = [*describe(BROKK_170, one)]
    assert len(lines) == 8 and lines[0].startswith("q1 up: ")
    assert all("slower than in the logs, opens " in line for line in lines)
    assert not [*describe(BROKK_170, unknown((1, 4)))]
    one.A[:], one.b[:] = 1e6 * np.eye(4), [-0.9e6, 0, 0, 0]
    assert "log and fit the machine again" in [*describe(BROKK_170, one)][-1]


def test_known__is_kept_in_a_file_of_this_machine_and_these_nets(tmp_path):
    path, one = tmp_path / "valves.json", Known(*(of[:1] for of in driven("nominal").known))
    save_known(path, BROKK_170, NET, one)
    for kept, of in zip(load_known(path, BROKK_170, NET), one, strict=True):
        np.testing.assert_allclose(kept, KEPT * of)
    good = json.loads(path.read_text())
    bad = {
        "nets": "other",
        "machine": "other",
        "seconds": [[0.0, 1.0]],
        "b": np.full((4, 2, 4), np.nan).tolist(),
        "A": (-1e3 * np.tile(np.eye(4), (4, 2, 1, 1))).tolist(),
    }
    lopsided = np.tile(np.triu(np.full((4, 4), 9.0)), (4, 2, 1, 1)).tolist()
    for key, value in [*bad.items(), ("A", lopsided), ("b", np.full((4, 2, 4), 1e300).tolist())]:
        path.write_text(json.dumps(good | {key: value}))
        with pytest.raises(ValueError, match=r"valves\.json"):
            load_known(path, BROKK_170, NET)
    for text in ("", "[]", "{}"):
        path.write_text(text)
        with pytest.raises(ValueError, match=r"valves\.json"):
            load_known(path, BROKK_170, NET)


def test_from_log__finds_the_same_in_recordings():
    rng = np.random.default_rng(3)
    log = task_log(VARIED["valve gain -20 %"], 8, 20.0, rng)
    known = from_log(BROKK_170, NET, log)
    k, d = valves(known)
    np.testing.assert_allclose(k, 0.8, atol=0.08)
    assert abs(d).max() < 0.02
    short = log._replace(
        recordings=[one._replace(u=one.u[:50], q=one.q[:50]) for one in log.recordings]
    )
    mixed = log._replace(recordings=[log.recordings[0], *short.recordings[1:]])
    rest = from_log(BROKK_170, NET, short._replace(recordings=short.recordings[1:])).A
    alone = from_log(BROKK_170, NET, log._replace(recordings=log.recordings[:1])).A
    # float32 nets of one run or of eight round otherwise
    np.testing.assert_allclose(from_log(BROKK_170, NET, mixed).A, alone + rest, rtol=1e-3, atol=1)


def test_cold_and_warm__begin_with_nothing_and_with_a_minute():
    motions = [(DRIVES[0][:2], DRIVES[1][:200, :2])] * 2
    both = adaptive.cold_and_warm(
        {"idle": Idle(), "rl": POLICY}, NET, BROKK_170, BROKK_170, 5, motions
    )
    assert list(both) == ["idle+cold", "idle+warm", "rl+cold", "rl+warm"]
    assert both["rl+cold"].known is None and both["idle+warm"].known.seconds.sum() == 0
    seconds = both["rl+warm"].known.seconds
    assert seconds.shape == (5, 4, 2) and seconds.sum() > 0
    np.testing.assert_array_equal(seconds[:2], seconds[2:4])


class Off:
    """The plant of an engine that goes off after some ticks."""

    def __init__(self, ticks):
        self.ticks = ticks

    def reset(self, machine, q):
        return PLANT.reset(machine, q)

    def step(self, machine, state, u):
        self.ticks -= 1
        return PLANT.step(machine, state, u) if self.ticks >= 0 else state


@pytest.mark.parametrize("ticks", [0, 200])
def test_learn__counts_hardly_a_tick_once_the_engine_is_off(ticks):
    start, goals = DRIVES
    off, on = (Adaptive(POLICY, NET, BROKK_170, unknown((8, 4))) for _ in range(2))
    rng = np.random.default_rng
    trace = rollout(BROKK_170, off, *DRIVES, TaskConfig.noise, rng(0), Off(ticks))
    assert np.abs(trace.u[ticks:]).max() > 0.3
    if ticks:
        rollout(BROKK_170, on, start, goals[:ticks], TaskConfig.noise, rng(0))
    assert off.known.seconds.max() <= on.known.seconds.max() + 0.05
    assert valves(off.known)[0].min() > 0.85
