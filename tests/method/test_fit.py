"""Recording under sines and under rich excitation; windows; the fit by the paper."""

from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from helpers_machines import is_replay, line, simple_system

from brokk_min import fit
from brokk_min.actuator import PLANT
from brokk_min.beyond.rich_excitation import RICH
from brokk_min.identification.validation import score
from brokk_min.machine import BROKK_170

LIMIT = 80 / 127
LOW, HIGH = BROKK_170.column("q_min"), BROKK_170.column("q_max")


def test_sine_command__has_amplitudes_from_dead_zone_to_limit_and_random_frequencies():
    rng = np.random.default_rng(0)
    amplitudes, frequencies, first = [], [], []
    for _ in range(200):
        u = fit.sine_command(rng, BROKK_170, 1200)
        # any sine: u[t + 1] + u[t - 1] = 2 cos(w dt) u[t]
        doubled = (u[2:] + u[:-2]) @ u[1:-1] / (u[1:-1] @ u[1:-1])
        np.testing.assert_allclose(u[2:] + u[:-2], doubled * u[1:-1], atol=1e-9)
        amplitudes.append(np.abs(u).max())
        first.append(u[0])
        frequencies.append(np.arccos(doubled / 2) / (2 * np.pi * 0.05))
    assert 0.069 < min(amplitudes) < 0.15 and 0.55 < max(amplitudes) <= LIMIT
    assert 0.05 <= min(frequencies) < 0.06 and 4.5 < max(frequencies) <= 5.0
    assert 0.35 < np.median(frequencies) < 0.75  # uniform in their logarithm: 0.5
    assert 0.4 < np.mean(np.array(first) < 0) < 0.6  # any phase


SLOW = SimpleNamespace(reset=PLANT.reset, step=lambda m, state, u: PLANT.step(m, state, u / 2))


@pytest.mark.parametrize(("kind", "plant"), [(fit.SINE, SLOW), (RICH, PLANT)])
def test_collect__drives_each_joint_alone_for_the_requested_time(kind, plant):
    """Also on a plant of one's own, which gets half of each command."""
    log = fit.collect(BROKK_170, 0.05, np.random.default_rng(7), plant, kind)
    tick = 0.05 * BROKK_170.q_dot_max + 0.01
    assert log.joints == BROKK_170.names and log.rate == 20.0
    assert len({recording.name for recording in log.recordings}) == len(log.recordings)
    ticks, segments = np.zeros(5, int), [(int(r.name[1]) - 1, r) for r in log.recordings]
    for joint, segment in segments:
        ticks[joint] += len(segment.u)
        assert len(segment.u) <= 613  # 13 samples at rest and 30 s
        assert not np.delete(segment.u, joint, 1).any()
        assert not np.ptp(np.delete(segment.q, joint, 1), axis=0).any()
        counts, angles = segment.u * 127, segment.q / BROKK_170.encoder_step
        np.testing.assert_allclose(counts, np.rint(counts), atol=1e-9)
        assert np.abs(np.rint(counts)).max() <= 80
        np.testing.assert_allclose(angles, np.rint(angles), atol=1e-6)
        np.testing.assert_array_equal(segment.q_dot, fit.velocity_of(segment.q, 4))
        assert not segment.u[:13].any() and not np.ptp(segment.q[:14], axis=0).any()
        assert kind is RICH or abs(segment.q[0, joint] - (LOW + HIGH)[joint] / 2) < 0.12
    if kind is fit.SINE:
        is_replay(log.recordings[-1], plant, (LOW + HIGH) / 2)
    assert ticks.tolist() == [3600] * 5  # 0.05 h at 20 Hz
    least = fit.collect(BROKK_170, 0.0, np.random.default_rng(7), plant, kind)
    assert [len(recording.u) for recording in least.recordings] == [15] * 5  # two windows
    pairs = [pair for pair, after in pairwise(segments) if pair[0] == after[0]]
    assert len(pairs) > 20  # the last segment of each joint is cut where the time is over
    for joint, segment in pairs:
        edge = segment.q[-2:, joint]
        at_limit = edge.min() < (LOW + tick)[joint] or edge.max() > (HIGH - tick)[joint]
        assert len(segment.q) == 613 or (at_limit and len(segment.q) > 33)  # a second at least
        edges = np.array([[LOW], [-HIGH]])[..., joint] + 2 * BROKK_170.encoder_step[joint]
        held = np.sum(np.array([[1], [-1]]) * segment.q[:, joint] < edges)
        assert len(segment.q) == 613 or held >= 20 * (kind is RICH)  # pushed for a second


def test_join_recordings__marks_recordings_in_which_a_joint_is_driven():
    """No joint that creeps a count under a stick at rest, but one that sags without a command."""
    late, ones = np.arange(6) > 2, np.ones(6)
    u = np.stack([0 * ones, 0.015 * late, 0.5 * late], 1)
    q = np.stack([0.02 * late, 2 * np.pi / 4096 * late, ones], 1)
    recordings = (fit.Recording("sags", u, q, q), fit.Recording("at a stop", u, 0 * q, q))
    samples = fit.join_recordings(fit.Log(("a", "b", "c"), recordings))
    assert samples.moves.tolist() == [[True, False, True]] * 6 + [[False, False, True]] * 6
    assert [w.tolist() for w in samples.windows(3, 2)] == [[2, 3], [], [2, 3, 8, 9]]


def test_fit__has_windows_and_ranges_without_the_jump_between_recordings():
    log = fit.Log(("a",), (line("x", 0, 0.1, 30), line("y", 5, 0.2, 40)))
    data = fit.TrainingSet(log, BROKK_170)
    np.testing.assert_array_equal(data.windows[0], [*range(12, 29), *range(42, 69)])
    np.testing.assert_array_equal(data.joined.windows(13, 8)[0], [*range(12, 22), *range(42, 62)])
    assert data.joined.starts(12, 8, 5).tolist() == [12, 17, 42, 47, 52, 57]
    ranges = (data.output_low, data.output_high, data.q_low, data.q_high)
    np.testing.assert_allclose(np.stack(ranges), [[0.094999], [0.205001], [0.0], [5.39]], rtol=1e-6)


def test_fit__begins_with_zero_biases_and_uniform_weights_up_to_he_for_relu():
    net = fit.fit(simple_system(0, 2, 40), fit.FitConfig(steps=0), 0, BROKK_170)
    for w, b, inputs in zip(net.weights[:4:2], net.weights[1:4:2], (39, 32), strict=True):
        limit = (6 / inputs) ** 0.5
        assert [w.min(), w.max()] == pytest.approx([-limit, limit], rel=0.01) and not b.any()


def test_fit__learns_a_simple_system():
    net = fit.fit(simple_system(0, 25), fit.FitConfig(steps=500, batch_size=256), 0, BROKK_170)
    assert [w.shape[1:] for w in net.weights] == [(39, 32), (32,), (32, 32), (32,), (32, 1), (1,)]
    result = score(net, simple_system(1, 6))
    for name in net.joints:
        assert result[name]["one_step_rmse"] < 0.35 * result[name]["persistence_rmse"], result
        for horizon in ("1", "5", "10"):
            run = result[name]["free_run"][horizon]
            assert run["relative_error"] < 0.25, (name, horizon)
            assert run["position_error_median"] < 0.1, (name, horizon)


def test_fit__refuses_what_cannot_be_learned():
    short = fit.Log(("a",), tuple(line(f"r{i}", 0.0, 0.1 * i, 13) for i in range(20)))
    with pytest.raises(ValueError, match=r"joint a: expected a recording of 14 samples.*got none"):
        fit.fit(short, fit.FitConfig(1), 0, BROKK_170)
    _, *moving = simple_system(0, 1, 40).recordings[0]
    still = fit.Recording("x", *(values * [1, 0] for values in moving))
    with pytest.raises(ValueError, match="joint stick"):
        fit.fit(fit.Log(("boom", "stick"), (still,)), fit.FitConfig(1), 0, BROKK_170)
    with pytest.raises(ValueError, match="weights: expected finite numbers at the end of the fit"):
        fit.fit(simple_system(0, 1, 40), fit.FitConfig(2, learning_rate=np.inf), 0, BROKK_170)
