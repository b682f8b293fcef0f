"""Validation by hand: one step and free runs; the motion of tasks."""

import numpy as np
import pytest
from helpers_machines import constant_net, is_replay, line

from brokk_min.actuator import PLANT
from brokk_min.fit import Log, Recording
from brokk_min.identification.validation import score, task_log, warnings
from brokk_min.machine import BROKK_170


def test_score__is_that_of_the_last_velocity_and_of_free_runs_by_hand():
    """Velocity grows by 0.2 rad/s each second: 0.01 a tick. The recordings are far apart."""
    time = np.arange(60)[:, None] / 20
    one = Recording("", 0 * time, 0.1 * time**2, 0.2 * time)
    log = Log(("a",), tuple(one._replace(q=one.q + far) for far in (0.0, 50.0, -80.0)))
    result = score(constant_net([0.2], ("a",)), log)["a"]
    at = time[13:59]  # samples with 13 before and one after them: target 0.2 t + 0.005 rad/s
    expected = np.sqrt(np.mean((0.2 - (0.2 * at + 0.005)) ** 2))
    assert result["one_step_rmse"] == pytest.approx(expected, abs=1e-5)
    result = score(constant_net([0.0], ("a",)), log)["a"]
    assert result["persistence_rmse"] == pytest.approx(0.005, abs=1e-9)
    # 2 runs of 1 s in each recording, from samples 13 and 33: 0.1 ((t + 1)^2 - t^2)
    starts = np.array([13, 33]) / 20
    median = np.mean(0.1 * ((starts + 1) ** 2 - starts**2))
    assert result["free_run"]["1"]["position_error_median"] == pytest.approx(median, abs=1e-4)
    errors = []  # the slope through four angles, of which the last ones are equal
    for at in (13, 33):
        for k in range(at + 1, at + 21):
            path = 0.1 * (np.minimum(np.arange(k - 3, k + 1), at) / 20) ** 2
            errors.append(np.polyfit(np.arange(4) / 20, path, 1)[0] - 0.2 * k / 20)
    rmse = np.sqrt(np.mean(np.square(errors)))
    assert result["free_run"]["1"]["velocity_rmse"] == pytest.approx(rmse, abs=1e-5)


def test_score__counts_each_joint_where_it_moves():
    """Joint a moves in a recording of 15 samples, b never, c in a recording of 60."""
    still, ramp = np.zeros(60), 0.1 * np.arange(60) / 20
    short = np.stack([ramp, still, still], axis=1)[:15]
    long = np.stack([still, still, ramp], axis=1)
    recordings = [Recording("", 0 * q, q, np.gradient(q, 0.05, axis=0)) for q in (short, long)]
    log = Log(("a", "b", "c"), tuple(recordings))
    net = constant_net([0.2] * 3, log.joints)
    horizons = {name: set(entry["free_run"]) for name, entry in score(net, log).items()}
    assert horizons == {"a": set(), "b": set(), "c": {"1"}}


def test_score__refuses_a_log_of_another_rate_or_without_a_whole_history():
    net = constant_net([0.2], ("a",))
    with pytest.raises(ValueError, match=r"rate: expected 20\.0, got 10\.0"):
        score(net, Log(("a",), (line("x", 0.0, 0.1, 40),), 10.0))
    with pytest.raises(ValueError, match=r"of more than 14 samples to score on, got \[14\]"):
        score(net, Log(("a",), (line("x", 0.0, 0.1, 14),)))


def test_warnings__name_nets_no_better_than_the_last_velocity():
    """The velocity alternates between 0 and 0.2 rad/s: the last one again is off by 0.2."""
    q_dot = 0.1 + 0.1 * (-1.0) ** np.arange(40)[:, None]
    test = Log(("a",), (Recording("x", q_dot, np.cumsum(q_dot, axis=0) / 20, q_dot),))
    told = [[*warnings(score(constant_net([v], ("a",)), test))] for v in (0.1, 0.5)]
    assert told == [[], ["a: expected a net that errs less than the last velocity again, got more"]]


def test_task_log__moves_driven_or_locked_joints_within_the_limits():
    log = task_log(BROKK_170, 5, 20.0, np.random.default_rng(0), BROKK_170.q_start)
    for i, recording in enumerate(log.recordings):
        moved = np.flatnonzero(np.ptp(recording.q, axis=0) > 0.05).tolist()
        assert moved == ([1] if i == 4 else [0, 2, 3, 4])  # q2 moves only alone
        assert recording.u.shape == recording.q.shape == (400, 5)
        counts = recording.u * 127
        np.testing.assert_allclose(counts, np.rint(counts), atol=1e-9)
        assert np.abs(counts).max() <= 80 + 1e-9
        assert np.mean(np.abs(counts[:, moved]) > 79) < 0.2
        is_replay(recording, PLANT, BROKK_170.q_start)
