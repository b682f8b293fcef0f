"""Recording under sines and under rich excitation; windows; the fit by the paper."""

from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from brokk_min.actuator import PLANT
from brokk_min.beyond.rich_excitation import RICH, rich_command
from brokk_min.fit import SINE, collect, sine_command, velocity_of
from brokk_min.identification.validation import task_log
from brokk_min.machine import BROKK_170, read_encoder

LIMIT = 80 / 127
LOW, HIGH = BROKK_170.column("q_min"), BROKK_170.column("q_max")


def test_sine_command__has_amplitudes_from_dead_zone_to_limit_and_random_frequencies():
    rng = np.random.default_rng(0)
    amplitudes, frequencies = [], []
    for _ in range(200):
        u = sine_command(rng, BROKK_170, 1200)
        # any sine: u[t + 1] + u[t - 1] = 2 cos(w dt) u[t]
        doubled = (u[2:] + u[:-2]) @ u[1:-1] / (u[1:-1] @ u[1:-1])
        np.testing.assert_allclose(u[2:] + u[:-2], doubled * u[1:-1], atol=1e-9)
        amplitudes.append(np.abs(u).max())
        frequencies.append(np.arccos(doubled / 2) / (2 * np.pi * 0.05))
    assert 0.069 < min(amplitudes) < 0.15 and 0.55 < max(amplitudes) <= LIMIT
    assert 0.05 <= min(frequencies) < 0.06 and 4.5 < max(frequencies) <= 5.0
    assert 0.35 < np.median(frequencies) < 0.75  # uniform in their logarithm: 0.5


def test_rich_command__has_pauses_jumps_and_holds_and_the_requested_length():
    rng = np.random.default_rng(0)
    parts = [rich_command(rng, BROKK_170, 600) for _ in range(40)]
    assert all(part.shape == (600,) for part in parts)
    u = np.concatenate(parts)
    assert 0.05 < np.mean(u == 0) < 0.4  # pauses
    assert np.sum(np.abs(np.diff(u)) > 0.5) > 50  # jumps
    assert np.mean((np.diff(u) == 0) & (u[1:] != 0)) > 0.1  # holds


def segments(log):
    """Joint and segment; the last segment of each joint is cut where the time is over."""
    return [(log.joints.index(recording.name[:2]), recording) for recording in log.recordings]


def is_replay(recording, plant, start):
    """Does a plant have the recorded angles under the recorded commands?"""
    state = plant.reset(BROKK_170, start)
    for u, q in zip(recording.u, recording.q, strict=True):
        np.testing.assert_allclose(q, read_encoder(BROKK_170, state.q), atol=1e-9)
        state = plant.step(BROKK_170, state, u)


SLOW = SimpleNamespace(reset=PLANT.reset, step=lambda m, state, u: PLANT.step(m, state, u / 2))


@pytest.mark.parametrize(("kind", "plant"), [(SINE, SLOW), (SINE, PLANT), (RICH, PLANT)])
def test_collect__drives_each_joint_alone_for_the_requested_time(kind, plant):
    """Also on a plant of one's own, which gets half of each command."""
    log = collect(BROKK_170, 0.05, np.random.default_rng(7), plant, kind)
    tick = 0.05 * BROKK_170.q_dot_max + 0.01
    assert log.joints == BROKK_170.names and log.rate == 20.0
    assert len({recording.name for recording in log.recordings}) == len(log.recordings)
    ticks = np.zeros(5, int)
    for joint, segment in segments(log):
        ticks[joint] += len(segment.u)
        assert len(segment.u) <= 613  # 13 samples at rest and 30 s
        assert not np.delete(segment.u, joint, 1).any()
        assert not np.ptp(np.delete(segment.q, joint, 1), axis=0).any()
        counts, angles = segment.u * 127, segment.q / BROKK_170.encoder_step
        np.testing.assert_allclose(counts, np.rint(counts), atol=1e-9)
        assert np.abs(np.rint(counts)).max() <= 80
        np.testing.assert_allclose(angles, np.rint(angles), atol=1e-6)
        np.testing.assert_array_equal(segment.q_dot, velocity_of(segment.q, 4))
        assert not segment.u[:13].any() and not np.ptp(segment.q[:14], axis=0).any()
        assert kind is RICH or abs(segment.q[0, joint] - (LOW + HIGH)[joint] / 2) < 0.12
    if kind is SINE:
        is_replay(log.recordings[-1], plant, (LOW + HIGH) / 2)
    assert ticks.tolist() == [3600] * 5  # 0.05 h at 20 Hz
    pairs = [pair for pair, after in pairwise(segments(log)) if pair[0] == after[0]]
    assert len(pairs) > 20
    for joint, segment in pairs:
        edge = segment.q[-2:, joint]
        at_limit = edge.min() < (LOW + tick)[joint] or edge.max() > (HIGH - tick)[joint]
        assert len(segment.q) == 613 or (at_limit and len(segment.q) > 33)  # a second at least


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
