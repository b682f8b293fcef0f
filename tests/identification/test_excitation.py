"""How the machine is driven, and the logs that come of it."""

from __future__ import annotations

from dataclasses import replace
from unittest import mock

import numpy as np
import pytest

from brokk_min.actuator import plant_reset, plant_step
from brokk_min.identification import excitation
from brokk_min.identification.excitation import EXCITATIONS, collect, task_log
from brokk_min.identification.logs import Log, Recording, read_log, velocity_of, write_log
from brokk_min.machine import BROKK_170, read_encoder

LIMIT = 80 / 127
Q5 = 4


@pytest.fixture(scope="module")
def collected() -> dict[str, Log]:
    return {
        kind: collect(BROKK_170, 0.05, kind, np.random.default_rng(7)) for kind in ("sine", "rich")
    }


def test_sines_have_amplitudes_between_dead_zone_and_limit_and_random_frequencies():
    rng = np.random.default_rng(0)
    amplitudes, frequencies = [], []
    for _ in range(200):
        u = EXCITATIONS["sine"](rng, BROKK_170, 1200)
        # any sine: u[t + 1] + u[t - 1] = 2 cos(w dt) u[t]
        doubled = (u[2:] + u[:-2]) @ u[1:-1] / (u[1:-1] @ u[1:-1])
        np.testing.assert_allclose(u[2:] + u[:-2], doubled * u[1:-1], atol=1e-9)
        amplitudes.append(np.abs(u).max())
        frequencies.append(np.arccos(doubled / 2) / (2 * np.pi * 0.05))
    assert 0.069 < min(amplitudes) < 0.15 and 0.55 < max(amplitudes) <= LIMIT
    assert 0.02 <= min(frequencies) < 0.03 and 0.47 < max(frequencies) <= 0.5


def test_rich_commands_hold_jump_and_pause_and_have_the_asked_length():
    rng = np.random.default_rng(0)
    tapes = [EXCITATIONS["rich"](rng, BROKK_170, 600) for _ in range(40)]
    assert all(tape.shape == (600,) for tape in tapes)
    u = np.concatenate(tapes)
    assert 0.05 < np.mean(u == 0) < 0.4  # pauses
    assert np.sum(np.abs(np.diff(u)) > 0.5) > 50  # jumps
    assert np.mean((np.diff(u) == 0) & (u[1:] != 0)) > 0.1  # holds


def test_valves_are_held_barely_open_and_moved_off_from_there():
    """Nothing but such parts: levels of 8 to 16 counts, also to and fro, then a level for 0.1 to 1 s."""
    rng = np.random.default_rng(1)
    with mock.patch.object(excitation, "MIX", {"hover": 1.0}):
        u = np.concatenate([EXCITATIONS["rich"](rng, BROKK_170, 600) for _ in range(40)])
    at = np.flatnonzero(
        np.abs(np.diff(u, prepend=np.nan)) > 1e-9
    )  # levels that hold for a while begin
    level, held = u[at[:-1]], np.diff(at)
    barely = (np.abs(level) > 0.9 * 0.07) & (np.abs(level) < 1.7 * 0.07)
    assert (
        0.063 < np.abs(level[barely]).min() < 0.066 and 0.116 < np.abs(level[barely]).max() < 0.119
    )
    turned = np.isclose(level[1:], -level[:-1]) & barely[1:]
    assert {1, 2, 3, 4, 6} <= set(held[1:][turned].tolist())  # ticks to one side
    off = ~barely & np.append(False, barely[:-1])
    assert off.sum() > 300 and np.abs(level[off]).max() > LIMIT
    assert held[off].max() <= 20 and held[off].min() >= 1  # the first or last of a part may be cut


@pytest.mark.parametrize(("dead_zone", "least", "most"), [(0.0, 0.0, 0.049), (0.2, 0.18, 0.249)])
def test_valves_with_another_dead_zone_or_none_are_held_barely_open_too(dead_zone, least, most):
    rng, machine = np.random.default_rng(2), replace(BROKK_170, dead_zone=dead_zone)
    held = np.array([np.abs(excitation._hover(rng, machine, 0.0)) for _ in range(400)], object)
    levels = np.array([level[0] for level in held])
    assert all(np.ptp(level) == 0 for level in held)
    assert least <= levels.min() < least + 0.002 and most - 0.002 < levels.max() <= most


@pytest.mark.parametrize("kind", ["sine", "rich"])
def test_every_actuator_is_driven_as_long_as_asked_within_the_limits(collected, kind):
    log = collected[kind]
    assert log.joints == BROKK_170.names
    driven = dict.fromkeys(log.joints, 0)
    for r in log.recordings:
        name = next(joint for joint in log.joints if r.name.startswith(joint))
        mine = log.joints.index(name)
        others = [i for i in range(5) if i != mine]
        assert not r.u[:, others].any(), r.name
        assert not np.ptp(r.q[:, others], axis=0).any(), r.name
        counts = r.u * 127
        np.testing.assert_allclose(counts, np.rint(counts), atol=1e-9)
        assert np.abs(np.rint(counts)).max() <= 80
        angles = r.q / BROKK_170.encoder_step
        np.testing.assert_allclose(angles, np.rint(angles), atol=1e-6)
        if not r.name.endswith("_return"):
            driven[name] += len(r.u)
            assert len(r.u) <= 613  # 13 samples at rest and 30 s
        np.testing.assert_array_equal(r.q_dot, velocity_of(r.q, 4))
    for name, ticks in driven.items():
        assert ticks == 3600, name  # 0.05 h at 20 Hz


def test_ways_back_are_marked_and_lead_home(collected):
    log = collected["sine"]
    home = (BROKK_170.column("q_min") + BROKK_170.column("q_max")) / 2
    names = [r.name for r in log.recordings]
    assert len(set(names)) == len(names)
    back = [r for r in log.recordings if r.name.endswith("_return")]
    assert len(back) >= 5
    for r in log.recordings:
        mine = next(i for i, joint in enumerate(log.joints) if r.name.startswith(joint))
        if r.name.endswith("_return"):
            assert abs(r.q[-1, mine] - home[mine]) < 0.12
        else:
            assert abs(r.q[0, mine] - home[mine]) < 0.12


def test_legs_end_at_a_limit_or_when_their_time_is_over(collected):
    log, tick = collected["rich"], 0.05 * BROKK_170.q_dot_max + 0.01
    low, high = BROKK_170.column("q_min") + tick, BROKK_170.column("q_max") - tick
    ended = [r for r in log.recordings if not r.name.endswith("_return")]
    last = {r.name[:2]: r.name for r in ended}  # of each joint: cut when the time is over
    for r in ended:
        if r.name in last.values():
            continue
        mine = next(i for i, joint in enumerate(log.joints) if r.name.startswith(joint))
        edge = r.q[-2:, mine]
        assert len(r.q) == 613 or edge.min() < low[mine] or edge.max() > high[mine], r.name
        assert 33 < len(r.q) <= 613, r.name  # a second of driving at least


def legs_of(log: Log) -> list[tuple[int, Recording, Recording]]:
    """Joint, leg and way back of each pair but the last of each joint, whose leg is cut."""
    named = {r.name: r for r in log.recordings}
    last = {r.name[:2]: r.name.removesuffix("_return") for r in log.recordings}
    pairs = [(r, named[r.name + "_return"]) for r in log.recordings if r.name + "_return" in named]
    return [(log.joints.index(r.name[:2]), r, b) for r, b in pairs if r.name not in last.values()]


@pytest.mark.parametrize("kind", ["sine", "rich"])
def test_a_leg_begins_at_true_idle_and_the_rest_before_it_belongs_to_it(collected, kind):
    """The first window of every leg is 13 samples at rest, then the first command."""
    for r in collected[kind].recordings:
        if not r.name.endswith("_return"):
            assert not r.u[:13].any() and not np.ptp(r.q[:14], axis=0).any(), r.name
            assert not np.abs(r.q_dot[:14]).max() > 1e-12, r.name
    legs = legs_of(collected[kind])
    assert len(legs) > 20
    starts = [np.abs(leg.u[13:16, joint]).max() > BROKK_170.dead_zone for joint, leg, _ in legs]
    assert np.mean(starts) > 0.5  # the others begin with a pause or near a sine's zero


@pytest.mark.parametrize("kind", ["sine", "rich"])
def test_a_way_back_goes_on_where_the_leg_ended_and_rests_at_its_start_until_idle(collected, kind):
    for joint, leg, back in legs_of(collected[kind]):
        assert np.abs(back.q[0] - leg.q[-1]).max() < 0.03, leg.name  # a tick at full speed
        assert abs(back.q[-1, joint] - leg.q[0, joint]) < 0.1, leg.name
        assert not back.u[-40:].any() and len(back.u) >= 40, leg.name  # 2 s, 5 times 0.4 s


def test_ways_back_are_driven_halfway_between_dead_zone_and_limit():
    for limit, counts in ((80, 44), (40, 24), (120, 64)):  # (0.07 + limit / 127) / 2
        machine = replace(BROKK_170, pwm_limit=limit)
        log = collect(machine, 0.004, "rich", np.random.default_rng(0))
        back = np.concatenate([r.u for r in log.recordings if r.name.endswith("_return")])
        assert set(np.rint(np.abs(back) * 127).ravel().tolist()) == {0, counts}


def test_a_joint_too_slow_to_come_back_does_not_keep_the_recording_waiting(monkeypatch):
    monkeypatch.setattr(excitation, "MAX_RETURN", 1.0)
    log = collect(BROKK_170, 0.004, "sine", np.random.default_rng(0))
    assert max(len(r.q) for r in log.recordings if r.name.endswith("_return")) <= 600 + 20
    driven = sum(len(r.q) for r in log.recordings if not r.name.endswith("_return"))
    assert driven == 5 * 288


def test_recordings_have_room_for_a_window_and_the_sample_after_it_however_short_their_time(
    monkeypatch,
):
    monkeypatch.setattr(excitation, "LEG", 2.0)
    log = collect(BROKK_170, 1e-6, "sine", np.random.default_rng(0))
    legs = {r.name: len(r.q) for r in log.recordings if not r.name.endswith("_return")}
    assert legs == {f"q{i}_000": 15 for i in range(1, 6)}
    assert log.rate == 20.0 and log.recordings[0].q_dot.shape == (15, 5)


def test_rich_recordings_hold_pauses_and_sine_recordings_none(collected):
    def longest_pause(log: Log) -> int:
        longest = 0
        for r in log.recordings:
            if r.name.endswith("_return"):
                continue
            moved = np.flatnonzero(np.concatenate([[1], r.u[13:].any(axis=1), [1]]))
            longest = max(longest, int(np.diff(moved).max()) - 1)
        return longest

    assert longest_pause(collected["rich"]) >= 40
    assert longest_pause(collected["sine"]) < 20


def test_recorded_angles_are_those_before_the_command_beside_them(collected):
    """A replay of the commands through the plant gives the recorded angles, tick by tick."""
    home = (BROKK_170.column("q_min") + BROKK_170.column("q_max")) / 2
    for kind, log in collected.items():
        first = next(r for r in log.recordings if r.name.startswith("q5"))
        start, tolerance = (home, 0.0) if kind == "sine" else (first.q[0], 2.0)  # known to a count
        state = plant_reset(BROKK_170, np.where(np.arange(5) == Q5, start, home))
        for u, q in zip(first.u, first.q, strict=True):
            counts = (read_encoder(BROKK_170, state.q) - q) / BROKK_170.encoder_step
            assert np.abs(counts).max() <= tolerance + 1e-6
            state = plant_step(BROKK_170, state, u)


def test_one_seed_gives_one_log_to_the_bit_and_another_seed_another():
    again = collect(BROKK_170, 0.003, "rich", np.random.default_rng(3))
    same = collect(BROKK_170, 0.003, "rich", np.random.default_rng(3))
    other = collect(BROKK_170, 0.003, "rich", np.random.default_rng(4))
    assert [r.name for r in again.recordings] == [r.name for r in same.recordings]
    for one, two in zip(again.recordings, same.recordings, strict=True):
        np.testing.assert_array_equal(one.u, two.u)
        np.testing.assert_array_equal(one.q, two.q)
    assert not np.array_equal(again.recordings[0].u, other.recordings[0].u)


def test_a_collected_log_reads_back_without_its_ways_back(collected, tmp_path):
    log = collected["sine"]
    write_log(tmp_path / "log.npz", log)
    again = read_log([tmp_path / "log.npz"], 4)
    kept = [r for r in log.recordings if not r.name.endswith("_return")]
    assert [r.name for r in again.recordings] == [r.name for r in kept]
    for got, wanted in zip(again.recordings, kept, strict=True):
        np.testing.assert_allclose(got.u, wanted.u, atol=1e-12)
        np.testing.assert_allclose(got.q, wanted.q, atol=1e-12)


def test_another_excitation_or_no_time_is_refused():
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match=r"excitation: expected .*sine.*rich.*, got 'square'"):
        collect(BROKK_170, 1.0, "square", rng)
    for hours in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match=f"hours: expected above 0, got {hours}"):
            collect(BROKK_170, hours, "sine", rng)


def test_task_recordings_move_driven_or_locked_joints_within_the_limits_and_replay():
    log = task_log(BROKK_170, 5, 20.0, np.random.default_rng(0))
    assert len(log.recordings) == 5
    for i, r in enumerate(log.recordings):
        moved = np.flatnonzero(np.ptp(r.q, axis=0) > 0.05).tolist()
        assert moved == ([1] if i == 4 else [0, 2, 3, 4])  # q2 moves only alone
        assert r.u.shape == r.q.shape == (400, 5)
        counts = r.u * 127
        np.testing.assert_allclose(counts, np.rint(counts), atol=1e-9)
        assert np.abs(counts).max() <= 80 + 1e-9
        assert np.mean(np.abs(counts[:, moved]) > 79) < 0.2  # small ones too, not from stop to stop
        # replayed from the first angle, half a count off at most, all tapes agree with the plant
        state = plant_reset(BROKK_170, r.q[0])
        for u in r.u:
            state = plant_step(BROKK_170, state, u)
        assert np.abs(state.q - r.q[-1]).max() < 0.02


class Picked(np.random.Generator):
    """Draws one kind of part alone; `hand`: restless at rest; `low`: `random` is 0, or else just below 1."""

    def __init__(self, kind: str, hand: int = 0, low: bool = False) -> None:
        super().__init__(np.random.PCG64(0))
        self.kind, self.hand, self.low = kind, hand, low

    def choice(self, a, *args, **options):
        drawn = super().choice(a, *args, **options)
        return self.kind if self.kind in a else self.hand if 0 in a else drawn

    def random(self, *args, **options):
        return super().random(*args, **options) * 0 + (0.0 if self.low else 0.999)


def lengths_where(same: np.ndarray) -> np.ndarray:
    """Lengths of the stretches between places at which `same` does not hold."""
    return np.diff(np.flatnonzero(~same))


def test_steps_last_half_a_second_to_ten_at_levels_from_the_dead_zone_to_a_third_above_the_limit():
    u = EXCITATIONS["rich"](Picked("step"), BROKK_170, 100_000)
    lengths = lengths_where(np.diff(u) == 0)
    assert lengths.min() in (10, 11) and 195 <= lengths.max() < 200
    for side in (u[u > 0], -u[u < 0]):
        assert 0.07 <= side.min() < 0.08 and 0.99 * 4 / 3 * LIMIT < side.max() <= 4 / 3 * LIMIT
    noisy = EXCITATIONS["rich"](Picked("step", low=True), BROKK_170, 50_000)
    assert 0.02 < np.median(np.abs(np.diff(noisy))) < 0.05  # its spread is drawn up to 0.08


def test_holds_last_one_to_seven_ticks_at_levels_up_to_a_third_above_the_limit():
    u = EXCITATIONS["rich"](Picked("holds"), BROKK_170, 50_000)
    lengths = lengths_where(np.diff(u) == 0)
    assert lengths.max() == 7 and np.bincount(lengths)[1:].min() > 500
    assert min(u.max(), -u.min()) > 0.99 * 4 / 3 * LIMIT and np.abs(u).max() <= 4 / 3 * LIMIT


def test_fast_sines_last_half_a_second_to_four_from_a_twentieth_of_a_hertz_to_four():
    u = EXCITATIONS["rich"](Picked("sine"), BROKK_170, 50_000)
    d = np.diff(u)
    doubled = (d[2:] + d[:-2]) / d[1:-1]  # of any sine 2 cos(w dt), about whatever mean
    same = np.abs(np.diff(doubled)) < 1e-5
    parts = lengths_where(same)
    assert parts.max() in (75, 76) and parts[parts > 1].min() in (
        6,
        7,
    )  # less the four ticks about a seam
    inside = np.clip(doubled[:-1][same] / 2, -1, 1)
    slow, middle, fast = np.quantile(np.arccos(inside) / (2 * np.pi * 0.05), [0.01, 0.5, 0.99])
    assert 0.045 < slow < 0.06 and 0.35 < middle < 0.6 and 3.6 < fast < 4.05
    assert (
        min(u.max(), -u.min()) > 1.5 * LIMIT and np.abs(u).max() <= (4 / 3 + 0.4) * LIMIT
    )  # 0.3 of 4/3


def moves_and_rests(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lengths of the stretches in which a tape that begins and ends at rest moves, and of those between."""
    edges = np.flatnonzero(np.diff(np.r_[0, np.abs(u) > 0.07, 0]))
    return edges[1::2] - edges[::2], edges[2::2] - edges[1:-1:2]


def test_stop_and_go_moves_for_a_second_at_most_out_of_rests_up_to_idle():
    """Rests of 0.05 to 3 s, short ones more often, or until the valve is idle, 2 s."""
    u = EXCITATIONS["rich"](Picked("go"), BROKK_170, 100_000)
    assert min(u.max(), -u.min()) > 0.99 * 4 / 3 * LIMIT and np.abs(u).max() <= 4 / 3 * LIMIT
    moves, rests = moves_and_rests(u)
    assert 17 <= np.quantile(moves, 0.95) <= moves.max() < 20 and np.quantile(moves, 0.1) in (
        2,
        3,
        4,
    )
    assert 5 < np.median(rests) < 10 and rests.min() == 1 and 50 < np.quantile(rests, 0.98) < 65
    rests = moves_and_rests(EXCITATIONS["rich"](Picked("go", low=True), BROKK_170, 100_000))[1]
    assert np.mean(rests == 40) > 0.4 and rests.min() == 40


def test_a_restless_hand_stays_within_the_dead_zone():
    u = EXCITATIONS["rich"](Picked("go", hand=1, low=True), BROKK_170, 100_000)
    rest = u[np.abs(u) < 0.07]
    assert len(rest) > 50_000 and (rest != 0).all() and min(rest.max(), -rest.min()) > 0.06


class Sudden(np.random.Generator):
    """Draws no noise, and commands that are at once at their levels."""

    def __init__(self) -> None:
        super().__init__(np.random.PCG64(0))

    def uniform(self, low=0.0, high=1.0, size=None):
        drawn = super().uniform(low, high, size)
        return drawn * 0 + 1 if np.isscalar(low) and (low, high) == (0.05, 0.6) else drawn

    def standard_normal(self, *args, **options):
        return super().standard_normal(*args, **options) * 0


def test_joints_of_a_task_hold_each_a_level_for_a_time_of_its_own_and_go_to_the_nearer_end_less_often():
    log = task_log(BROKK_170, 10, 80.0, Sudden())
    low, span = BROKK_170.column("q_min"), BROKK_170.column("q_max") - BROKK_170.column("q_min")
    held, levels, places, together = [], [], [], []
    for i, r in enumerate(log.recordings):
        changes = np.diff(r.u, axis=0) != 0
        for j in [1] if i % 5 == 4 else [0, 2, 3, 4]:
            at = np.flatnonzero(changes[:, j])
            held += np.diff(at).tolist()
            levels += r.u[at + 1, j].tolist()
            places += ((r.q[at + 1, j] - low[j]) / span[j]).tolist()
            together.append(changes[at][:, [k for k in range(5) if k not in (1, j)]].mean())
    short, middle, long = np.quantile(held, [0.05, 0.5, 0.97])
    assert 9 < short < 20 and 45 < middle < 65 and 93 < long < 150
    levels, places = np.array(levels), np.array(places)
    assert min(levels.max(), -levels.min()) > 0.98 * LIMIT and 0.08 < np.mean(levels == 0) < 0.22
    upward = [np.mean(levels[near & (levels != 0)] > 0) for near in (places < 0.3, places > 0.7)]
    assert upward[0] > 0.8 and upward[1] < 0.2 and max(together) < 0.1
    noisy = task_log(BROKK_170, 4, 20.0, np.random.default_rng(0))
    steps = (
        np.abs(np.concatenate([np.diff(r.u[:, [0, 2, 3, 4]], axis=0) for r in noisy.recordings]))
        * 127
    )
    assert steps.max() < 100 and 0.5 < np.median(steps) < 10


class Share(np.random.Generator):
    """Draws nothing: whatever is uniform lies at `share` of its interval, normal numbers are 1."""

    def __init__(self, share: float, kind: str = "", sign: int = 1) -> None:
        super().__init__(np.random.PCG64(0))
        self.share, self.kind, self.sign = share, kind, sign
        self.shares: list[list[float]] = []

    def uniform(self, low=0.0, high=1.0, size=None):
        return (
            (1 - self.share) * np.asarray(low)
            + self.share * np.asarray(high)
            + np.zeros(size or ())
        )

    def random(self, size=None):
        return self.uniform(size=size)

    def integers(self, low, high):
        return low + int(self.share * (high - low))

    def standard_normal(self, size):
        return np.ones(size)

    def choice(self, a, p=None):
        if "sine" not in a:
            return self.sign if -1 in a else a[int(self.share * len(a))]
        self.shares.append(p)
        return self.kind


def test_commands_by_hand_where_each_draw_is_a_quarter_of_what_it_may_be():
    time, top = 0.05 * np.arange(40), 4 / 3 * LIMIT
    slow = (0.07 + 0.25 * (LIMIT - 0.07)) * np.cos(
        2 * np.pi * 0.14 * time
    )  # 0.02 to 0.5 Hz, phase pi / 2
    np.testing.assert_allclose(EXCITATIONS["sine"](Share(0.25), BROKK_170, 40), slow, atol=1e-12)
    level, noise = 0.07 + 0.25 * (top - 0.07), 0.25 * 0.08
    fast = -0.15 * top + level * np.cos(
        2 * np.pi * 0.05 * 80**0.25 * time[:27]
    )  # 1.375 s of 0.5 to 4
    got = EXCITATIONS["rich"](rng := Share(0.25, "sine"), BROKK_170, 27)
    np.testing.assert_allclose(got, fast + noise, atol=1e-12)
    assert rng.shares == [
        list(excitation.MIX.values())
    ]  # one part is enough, of shares as they stand there
    half = EXCITATIONS["rich"](Share(0.5, "sine"), BROKK_170, 45)  # no noise; phase pi, mean 0
    level = (0.07 + top) / 2
    wave = -level * np.sin(2 * np.pi * 0.05 * 80**0.5 * 0.05 * np.arange(45))
    np.testing.assert_allclose(half, wave, atol=1e-12)
    for kind, ticks in (
        ("step", 57),
        ("holds", 27),
        ("go", 57),
        ("hover", 57),
    ):  # 2.875 s or 1.375 s
        EXCITATIONS["rich"](rng := Share(0.25, kind), BROKK_170, 2 * ticks + 1)
        assert len(rng.shares) == 3, kind
    got = EXCITATIONS["rich"](Share(0.25, "hover", sign=-1), BROKK_170, 26)
    barely = (
        (0.9 + 0.25 * 0.8) * 0.07 * np.array([-1, -1, 1, 1, -1, -1, 1, 1, -1, -1, 1, 1, -1])
    )  # 0.65 s
    np.testing.assert_allclose(got[:13], barely, atol=1e-12)
    np.testing.assert_allclose(got[13:19], -0.5 * top, atol=1e-12)  # 0.325 s, then the next wait
    np.testing.assert_allclose(got[19:], barely[:7], atol=1e-12)
    got = EXCITATIONS["rich"](Share(0.75, "go"), BROKK_170, 60)
    rest = int(np.exp(0.25 * np.log(0.05) + 0.75 * np.log(3.0)) / 0.05)
    assert (rest, got[:rest].tolist()) == (
        21,
        [0.75 * 0.07 * 0.5] * 21,
    )  # restless at 0.75 of the dead zone
    np.testing.assert_allclose(got[rest : rest + 15], 0.5 * top, atol=1e-12)


def test_recorded_commands_of_a_task_by_hand():
    """Draws of a quarter: from 0.35 of the range down at a quarter of the limit, for 1.625 s, and so on.

    The chance to go up there is 1 - (1.5 * 0.35 - 0.25) = 0.725, at a third of the range 0.75.
    """
    log = task_log(BROKK_170, 5, 4.0, Share(0.25))
    assert [r.name for r in log.recordings] == [
        "task_00",
        "task_01",
        "task_02",
        "task_03",
        "task_04",
    ]
    low, high = BROKK_170.column("q_min"), BROKK_170.column("q_max")
    for i, r in enumerate(log.recordings):
        np.testing.assert_array_equal(r.q[0], read_encoder(BROKK_170, 0.65 * low + 0.35 * high))
        moving = np.array([i == 4 if j == 1 else i < 4 for j in range(5)])
        command = np.zeros(5)
        for tick, (q, u) in enumerate(zip(r.q, r.u, strict=True)):
            if tick % 33 == 0:  # 1.625 s are over after 32.5 ticks
                level = 0.25 * LIMIT * np.where((q - low) / (high - low) < 1 / 3, 1, -1)
                assert tick or (level < 0).all()
            command = command + (0.05 + 0.25 * 0.55) * (level - command)
            counts = np.rint(127 * (command + 0.25 * 0.06)) * moving
            np.testing.assert_allclose(127 * u, counts, atol=1e-9)
        assert (level > 0)[moving].any()
    pose = [1.0, 0.5, 0.58, 1.71, 1.24]
    same = task_log(BROKK_170, 2, 0.1, Share(0.25), pose)
    assert all((r.q[0] == read_encoder(BROKK_170, np.array(pose))).all() for r in same.recordings)
    pausing = task_log(BROKK_170, 1, 0.5, Share(0.9)).recordings[0]  # 0.15 of the levels are none
    assert not pausing.u.any()


@pytest.mark.parametrize(("kind", "pushed"), [("sine", 0), ("rich", 20)])
def test_a_leg_and_its_way_back_by_hand(kind, pushed, monkeypatch):
    """Full command up: q5 from amid its range or its stop to the stop, perhaps pushing, and back to rest."""
    monkeypatch.setitem(EXCITATIONS, kind, lambda rng, machine, ticks: np.full(ticks, LIMIT))
    high, start = BROKK_170.column("q_max")[Q5], np.array([1.0, 2.0])[: 1 if kind == "sine" else 2]
    drawn = Share(np.array([0.5, 0.95]))  # of the range and an eighth more on either side
    monkeypatch.setattr(excitation, "LEG", 12.0)
    recorder, back, home = excitation._drive_legs(BROKK_170, np.full(len(start), Q5), kind, drawn)
    q, u = np.array(recorder.q), np.rint(127 * np.array(recorder.u))
    middle = read_encoder(BROKK_170, (BROKK_170.column("q_min") + BROKK_170.column("q_max")) / 2)
    assert (np.delete(q, Q5, -1) == np.delete(middle, Q5)).all()
    assert not np.delete(u, Q5, -1).any()
    for row, (angles, counts) in enumerate(zip(q[..., Q5].T, u[..., Q5].T, strict=True)):
        met = np.flatnonzero(angles > high - 2 * BROKK_170.encoder_step)
        turn = max(met[pushed], 34)  # after 13 samples at rest and more than a second
        assert angles[0] == read_encoder(BROKK_170, start[row]) and back[row] == turn
        come = turn + np.flatnonzero(np.abs(angles[turn:] - angles[0]) < 0.06)[0]
        wanted = np.concatenate(
            [np.zeros(13), np.full(turn - 13, 80), np.full(come - turn, -44), np.zeros(40)]
        )
        np.testing.assert_array_equal(counts[: len(wanted)], wanted)
        assert home[row] == len(wanted) and not counts[len(wanted) :].any()
    assert len(u) == home.max()
    monkeypatch.setattr(excitation, "LEG", 1.0)
    early = excitation._drive_legs(BROKK_170, np.array([Q5]), kind, Share(0.5))[1]
    assert early.tolist() == [33]  # its time is over before it meets a limit
