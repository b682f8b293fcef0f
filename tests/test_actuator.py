"""The plant's calibration and equations, the logs it gives, and the nets that learn from them."""

from __future__ import annotations

import json
import math
import tracemalloc
from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from strategies import machines, poses, reals

from brokk_min import actuator
from brokk_min.actuator import (
    EXCITATIONS,
    ActuatorNet,
    FitConfig,
    PlantState,
    collect,
    fit,
    free_run,
    lever_arm,
    load_net,
    plant_reset,
    plant_step,
    plant_velocity,
    push_angle,
    push_command,
    rest_history,
    save_net,
    score,
    speed_limits,
    task_log,
)
from brokk_min.logs import Log, Recording, read_log, velocity_of, write_log
from brokk_min.machine import BROKK_170, Machine, estimate_velocity, read_encoder

FAST = replace(BROKK_170, rate=200.0)  # a tick is one step of 5 ms
LIMIT = 80 / 127
MIDDLE = np.array([0.0, 0.5, 0.5, 1.7, 1.0])
Q5 = 4


def record(machine: Machine, q: np.ndarray, u: np.ndarray) -> tuple[PlantState, np.ndarray, np.ndarray]:
    """Last state, joint velocities and cylinder speeds (ticks, ..., n) under commands `u`."""
    state = plant_reset(machine, q)
    velocities, speeds = [], []
    for command in u:
        state = plant_step(machine, state, command)
        velocities.append(plant_velocity(machine, state))
        speeds.append(state.speed)
    return state, np.array(velocities), np.array(speeds)


def only(joint: int, u: np.ndarray | list[float]) -> np.ndarray:
    """Commands (ticks, 5) for one joint."""
    commands = np.zeros((len(u), 5))
    commands[:, joint] = u
    return commands


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """Small nets are fitted fastest so, and beside other work much faster."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


# --- the plant's calibration, measured as on a machine --------------------------------------------


def rise_time(before: float, ticks_before: int) -> float:
    """Time from the step to 80 counts until 63 % of the change in cylinder speed of q5 is done."""
    u = only(Q5, [before] * ticks_before + [LIMIT] * 250)
    _, _, speeds = record(FAST, np.array([0, 0.5, 0.5, 1.7, 0.0]), u)
    speed = np.concatenate([[0.0], speeds[:, Q5]])[ticks_before:]
    done = (speed - speed[0]) / (speed[-1] - speed[0])
    return int(np.argmax(done >= 0.63)) * FAST.dt


def test_an_idle_joint_takes_four_times_as_long_as_a_moving_one():
    assert rise_time(0.0, 100) == pytest.approx(0.398, abs=0.02)
    assert rise_time(40 / 127, 200) == pytest.approx(0.102, abs=0.02)


def test_peak_speeds_at_80_counts_over_the_whole_range():
    """Ten sweeps at once: each joint alone from stop to stop, up and down."""
    wanted = np.array([[0.20, 0.15, 0.17, 0.22, 0.240], [0.20, 0.22, 0.28, 0.38, 0.453]])
    tolerance = np.where(np.arange(5) == Q5, 0.001, 0.05 * wanted)
    q_min, q_max = BROKK_170.column("q_min"), BROKK_170.column("q_max")
    own = np.eye(5, dtype=bool)
    start = np.stack([np.where(own, q_min, MIDDLE), np.where(own, q_max, MIDDLE)])
    u = LIMIT * np.stack([np.eye(5), -np.eye(5)])
    state, velocities, _ = record(FAST, start, np.broadcast_to(u, (4600, 2, 5, 5)))
    speeds = velocities[..., own] * np.array([[1], [-1]])  # (steps, 2, 5): of the swept joint
    np.testing.assert_array_equal(state.q[:, own], [q_max, q_min])  # all got through
    assert np.all(speeds >= 0)
    assert np.all(np.abs(speeds.max(axis=0) - wanted) < tolerance), speeds.max(axis=0)


def test_lever_arms_vary_by_one_and_a_half_to_two_and_a_half():
    q_min, q_max = BROKK_170.column("q_min"), BROKK_170.column("q_max")
    arms = lever_arm(BROKK_170, np.linspace(q_min, q_max, 500))
    ratio = arms.max(axis=0) / arms.min(axis=0)
    assert ratio[0] == 1.0
    assert np.all((ratio[1:] > 1.5) & (ratio[1:] < 2.5)), ratio


def test_nothing_moves_in_the_dead_zone():
    for sign in (1, -1):
        state, velocities, _ = record(BROKK_170, MIDDLE, np.full((200, 5), sign * 8 / 127))
        np.testing.assert_array_equal(state.q, MIDDLE)
        assert not velocities.any()
        state, velocities, _ = record(BROKK_170, MIDDLE, np.full((100, 5), sign * 20 / 127))
        assert np.all(sign * velocities[-1] > 1e-3)


def test_the_pump_is_enough_at_the_limit_and_too_small_at_full_command():
    q = np.array([0.0, 0.5, 1.4, 2.6, 1.8])
    falling = -(np.arange(5) != 1).astype(float)  # the driven joints where they need most oil

    def loss(level: float) -> float:
        _, _, alone = record(BROKK_170, q, only(Q5, np.full(25, -level)))
        _, _, together = record(BROKK_170, q, np.tile(level * falling, (25, 1)))
        return 1 - together[-1, Q5] / alone[-1, Q5]

    assert abs(loss(LIMIT)) < 0.02
    assert loss(1.0) > 0.05


def test_a_command_arrives_after_the_delay_and_not_a_step_earlier():
    state = plant_reset(FAST, MIDDLE)
    for tick in range(12):
        assert not state.spool.any() or tick > 8
        state = plant_step(FAST, state, only(Q5, [1.0 if tick == 0 else 0.0])[0])
        assert (state.spool[Q5] > 0) == (tick >= 8), tick  # 8 steps of 5 ms
    # at 20 Hz the spool has two steps of the tick left: 1 - (1 - 1/6)^2
    state = plant_step(BROKK_170, plant_reset(BROKK_170, MIDDLE), np.ones(5))
    np.testing.assert_allclose(state.spool, 1 - (5 / 6) ** 2, atol=1e-12)


def test_nets_have_the_rate_of_their_log_and_are_judged_at_no_other():
    machine, config = replace(BROKK_170, rate=50.0), FitConfig(steps=12, rollout=2, hidden=4)
    log = collect(machine, 0.002, "rich", np.random.default_rng(0))
    assert log.rate == 50
    q = log.recordings[0].q
    slope = [estimate_velocity(q[i - 3 : i + 1].T, 4, 0.02) for i in range(4, len(q))]
    np.testing.assert_allclose(log.recordings[0].q_dot[4:], slope, atol=1e-12)
    net = fit(log, config, 0, 4, machine.name)
    assert net.rate == 50
    with pytest.raises(ValueError, match="rate: expected 50 Hz, got 20 Hz"):
        score(net, log._replace(rate=20.0))


@pytest.mark.parametrize("rate", [10.0, 20.0, 25.0, 30.0, 40.0, 60.0])
def test_a_tick_lasts_one_over_the_rate(rate):
    """Or a machine whose tick is no multiple of the plant's step is refused."""
    try:
        machine = replace(BROKK_170, rate=rate)
    except ValueError:
        return
    state, _, _ = record(machine, MIDDLE, only(0, np.full(round(1.5 * rate), LIMIT)))
    following = plant_step(machine, state, only(0, [LIMIT])[0])
    speed = plant_velocity(machine, state)[0]  # of the slew drive: steady by now
    assert following.q[0] - state.q[0] == pytest.approx(speed / rate, rel=1e-3)


def test_stops_hold_and_let_go():
    for sign, stop in ((1, BROKK_170.column("q_max")), (-1, BROKK_170.column("q_min"))):
        state, _, _ = record(BROKK_170, stop - sign * 0.02, np.full((60, 5), sign * 1.0))
        np.testing.assert_array_equal(state.q, stop)
        np.testing.assert_array_equal(state.speed, 0.0)
        for _ in range(40):
            state = plant_step(BROKK_170, state, np.full(5, -sign * LIMIT))
        assert np.all(sign * (stop - state.q) > 0.02)


# --- the plant's equations ------------------------------------------------------------------------


def slow_plant(machine: Machine, q: list[float], commands: np.ndarray) -> list[dict[str, float]]:
    """DESIGN section 4 read line by line: one joint, one 5 ms step, one number at a time."""
    m, dt = machine, machine.plant_dt
    joints = [{"q": float(a), "v": 0.0, "s": 0.0, "z": 0.0} for a in q]
    per_tick, late = round(1 / m.rate / dt), round(m.delay / dt)
    for step in range(len(commands) * per_tick):
        at = step - late
        a = [0.0] * m.n if at < 0 else commands[at // per_tick].tolist()
        wanted = []
        for joint, x in zip(m.joints, joints, strict=True):
            g = 0.0
            if x["z"] > m.ready_threshold:
                part = min(1.0, (x["z"] - m.ready_threshold) / (1 - m.ready_threshold))
                g = math.sqrt(3 * part**2 - 2 * part**3)
            K = joint.speed_positive if x["s"] > 0 else joint.speed_negative
            wanted.append(K * x["s"] * g)
        flow = sum(abs(j.cylinder_area * v) for j, v in zip(m.joints, wanted, strict=True))
        share = 1.0 if flow == 0 else min(1.0, m.pump_flow / flow)
        for i, (joint, x) in enumerate(zip(m.joints, joints, strict=True)):
            us = math.copysign(max(0.0, (abs(a[i]) - m.dead_zone) / (1 - m.dead_zone)), a[i])
            zt = 1.0 if abs(x["s"]) > m.spool_idle else 0.0
            tau = m.ready_up_time if zt > x["z"] else m.ready_down_time
            if joint.cylinder_base:
                b, c, gamma = joint.cylinder_base, joint.cylinder_rod, joint.cylinder_angle + x["q"]
                r = b * c * math.sin(gamma) / math.sqrt(b * b + c * c - 2 * b * c * math.cos(gamma))
            else:
                r = joint.cylinder_rod
            new = {
                "q": x["q"] + dt * x["v"] / r,
                "v": x["v"] + dt * (wanted[i] * share - x["v"]) / m.cylinder_time,
                "s": x["s"] + dt * (us - x["s"]) / m.spool_time,
                "z": x["z"] + dt * (zt - x["z"]) / tau,
            }
            if new["q"] >= joint.q_max:
                new |= {"q": joint.q_max, "v": min(new["v"], 0.0)}
            if new["q"] <= joint.q_min:
                new |= {"q": joint.q_min, "v": max(new["v"], 0.0)}
            joints[i] = new
    return joints


@st.composite
def driven_machines(draw: st.DrawFn) -> tuple[Machine, np.ndarray, np.ndarray]:
    machine = draw(machines())
    shape = (draw(st.integers(1, 15)), machine.n)
    u = draw(npst.arrays(np.float64, shape, elements=reals(-1, 1)))
    return machine, draw(poses(machine)), np.repeat(u, 2, axis=0)


@given(driven_machines())
def test_the_plant_is_its_equations(case):
    machine, q, u = case
    state, velocities, _ = record(machine, q, u)
    wanted = slow_plant(machine, q, u)
    for name, values in (("q", state.q), ("v", state.speed), ("s", state.spool), ("z", state.ready)):
        np.testing.assert_allclose(values, [x[name] for x in wanted], atol=1e-12, err_msg=name)
    arms = lever_arm(machine, state.q)
    np.testing.assert_allclose(velocities[-1], [x["v"] for x in wanted] / arms, atol=1e-12)
    assert np.all(state.q >= machine.column("q_min")) and np.all(state.q <= machine.column("q_max"))


@given(driven_machines())
def test_a_lever_arm_is_a_distance_and_the_gear_ratio_of_the_cylinder(case):
    machine, q, _ = case
    base, rod, angle = (machine.column(f"cylinder_{name}") for name in ("base", "rod", "angle"))
    arm = lever_arm(machine, q)
    length = lambda x: np.sqrt((base - rod * np.cos(x)) ** 2 + (rod * np.sin(x)) ** 2)  # noqa: E731
    slope = (length(angle + q + 1e-6) - length(angle + q - 1e-6)) / 2e-6
    np.testing.assert_allclose(arm, np.where(base > 0, slope, rod), atol=1e-8)
    assert np.all(arm > 0)


def test_lever_arm_of_q5_by_hand():
    # a right angle: legs 0.6 and 0.2, hypotenuse 0.6325, height 0.12 / 0.6325
    q = MIDDLE.copy()
    q[Q5] = np.pi / 2 - 0.4
    assert lever_arm(BROKK_170, q)[Q5] == pytest.approx(0.18974, abs=1e-5)
    assert lever_arm(BROKK_170, q)[0] == 0.15


def frozen(state: PlantState) -> PlantState:
    for array in (*state[:4], *state.pending):
        array.setflags(write=False)
    return state


def test_a_step_changes_nothing_it_was_given():
    rng = np.random.default_rng(0)
    state = plant_reset(BROKK_170, np.tile(MIDDLE, (3, 1)))
    u = rng.uniform(-1, 1, (3, 5))
    for _ in range(20):
        before = [array.copy() for array in (*state[:4], *state.pending)]
        following = plant_step(BROKK_170, frozen(state), u)
        for array, copy in zip((*state[:4], *state.pending), before, strict=True):
            np.testing.assert_array_equal(array, copy)
        again = plant_step(BROKK_170, state, u)
        np.testing.assert_array_equal(again.q, following.q)
        state = following
    # a caller that reuses its arrays does not reach into the plant
    q, late = MIDDLE.copy(), np.ones(5)
    state = plant_reset(BROKK_170, q)
    q[:] = 0.0
    np.testing.assert_array_equal(state.q, MIDDLE)
    state = plant_step(BROKK_170, state, late)
    kept = plant_step(BROKK_170, state, np.zeros(5))
    late[:] = -1.0
    np.testing.assert_array_equal(plant_step(BROKK_170, state, np.zeros(5)).spool, kept.spool)


def test_rows_of_a_batch_do_not_know_of_each_other():
    rng = np.random.default_rng(1)
    q = rng.uniform(BROKK_170.column("q_min"), BROKK_170.column("q_max"), (2, 3, 5))
    u = np.repeat(rng.uniform(-1, 1, (10, 2, 3, 5)), 6, axis=0)
    batch, velocities, _ = record(BROKK_170, q, u)
    for index in np.ndindex(2, 3):
        alone, own, _ = record(BROKK_170, q[index], u[:, *index])
        np.testing.assert_allclose(batch.q[index], alone.q, atol=1e-13)
        np.testing.assert_allclose(velocities[:, *index], own, atol=1e-13)


# --- excitation and collection --------------------------------------------------------------------


@pytest.fixture(scope="module")
def collected() -> dict[str, Log]:
    return {kind: collect(BROKK_170, 0.05, kind, np.random.default_rng(7)) for kind in ("sine", "rich")}


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
    assert np.ptp(frequencies) > 0.3 and min(frequencies) > 0


def test_rich_commands_hold_jump_and_pause_and_have_the_asked_length():
    rng = np.random.default_rng(0)
    tapes = [EXCITATIONS["rich"](rng, BROKK_170, 600) for _ in range(40)]
    assert all(tape.shape == (600,) for tape in tapes)
    u = np.concatenate(tapes)
    assert 0.05 < np.mean(u == 0) < 0.4  # pauses
    assert np.sum(np.abs(np.diff(u)) > 0.5) > 50  # jumps
    assert np.mean((np.diff(u) == 0) & (u[1:] != 0)) > 0.1  # holds


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
        assert 3600 <= ticks <= 3605, name  # 0.05 h at 20 Hz


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
    monkeypatch.setattr(actuator, "MAX_RETURN", 1.0)
    log = collect(BROKK_170, 0.004, "sine", np.random.default_rng(0))
    assert max(len(r.q) for r in log.recordings if r.name.endswith("_return")) <= 600 + 20
    driven = sum(len(r.q) for r in log.recordings if not r.name.endswith("_return"))
    assert driven == 5 * 288


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
        # replayed from the first angle, half a count off at most, all tapes agree with the plant
        state = plant_reset(BROKK_170, r.q[0])
        for u in r.u:
            state = plant_step(BROKK_170, state, u)
        assert np.abs(state.q - r.q[-1]).max() < 0.02


# --- histories ------------------------------------------------------------------------------------


def test_a_history_by_hand():
    h = rest_history(np.array([0.5, -1.0]), 3)
    np.testing.assert_array_equal(h[1], [[-1, -1, -1], [0, 0, 0], [0, 0, 0]])
    h.setflags(write=False)
    sent = push_command(h, [0.1, 0.2])
    np.testing.assert_array_equal(sent[0], [[0.5, 0.5, 0.5], [0, 0, 0], [0, 0, 0.1]])
    np.testing.assert_array_equal(sent[1], [[-1, -1, -1], [0, 0, 0], [0, 0, 0.2]])
    sent.setflags(write=False)
    seen = push_angle(sent, [0.6, -0.9], lambda angles: angles[..., -1] - angles[..., 0])
    np.testing.assert_allclose(seen[0], [[0.5, 0.5, 0.6], [0, 0, 0.1], [0, 0, 0.1]])
    np.testing.assert_allclose(seen[1], [[-1, -1, -0.9], [0, 0, 0.1], [0, 0, 0.2]])
    sent = push_command(seen, [0.3, 0.4])
    np.testing.assert_allclose(sent[0], [[0.5, 0.5, 0.6], [0, 0, 0.1], [0, 0.1, 0.3]])


def test_histories_have_leading_axes_and_keep_the_float_type():
    q = np.arange(6, dtype=np.float32).reshape(3, 2)
    h = push_angle(push_command(rest_history(q, 5), q / 10), q + 1, lambda a: a[..., -1] - a[..., -2])
    assert h.shape == (3, 2, 3, 5) and h.dtype == np.float32
    np.testing.assert_array_equal(h[..., 0, -1], q + 1)
    np.testing.assert_array_equal(h[..., 0, -2], q)
    np.testing.assert_array_equal(h[..., 1, -1], 1)
    np.testing.assert_array_equal(h[..., 2, -1], q / 10)


# --- the nets -------------------------------------------------------------------------------------


def random_net(seed: int = 0, n: int = 3, history: int = 13, hidden: int = 32) -> ActuatorNet:
    rng = np.random.default_rng(seed)
    inputs = 3 * history

    def draw(*shape: int) -> np.ndarray:
        return (rng.standard_normal(shape) / shape[1] ** 0.5).astype(np.float32)

    return ActuatorNet(
        joints=tuple(f"j{i}" for i in range(n)),
        history=history,
        rate=20.0,
        velocity_samples=4,
        velocity_logged=False,
        machine="some",
        seed=seed,
        settings={"steps": 5},
        input_mean=rng.uniform(-1, 1, (n, inputs)).astype(np.float32),
        input_scale=rng.uniform(0.1, 2, (n, inputs)).astype(np.float32),
        output_low=rng.uniform(-0.6, -0.1, n).astype(np.float32),
        output_high=rng.uniform(0.1, 0.6, n).astype(np.float32),
        q_low=np.full(n, -2.0, np.float32),
        q_high=np.full(n, 2.0, np.float32),
        weights=(
            draw(n, inputs, hidden), draw(n, hidden), draw(n, hidden, hidden), draw(n, hidden),
            draw(n, hidden, 1), draw(n, 1),
        ),
    )  # fmt: skip


def constant_net(velocity: list[float], logged: bool, joints: tuple[str, ...]) -> ActuatorNet:
    """Nets that say `velocity` whatever they see: no weights, sigmoid(0) = 1/2, the middle."""
    middle = np.array(velocity, np.float32)
    net = random_net(n=len(velocity))
    return replace(
        net,
        joints=joints,
        velocity_logged=logged,
        weights=tuple(np.zeros_like(w) for w in net.weights),
        output_low=middle - 1,
        output_high=middle + 1,
        q_low=np.full(len(velocity), -1e3, np.float32),
        q_high=np.full(len(velocity), 1e3, np.float32),
    )


@pytest.mark.parametrize("leading", [(), (1,), (7,), (2, 3)])
def test_prediction_against_a_loop_in_double_precision(leading):
    net = random_net(seed=len(leading), history=5, hidden=8)
    rng = np.random.default_rng(9)
    history = rng.uniform(-1, 1, (*leading, 3, 3, 5)).astype(np.float32)
    history.setflags(write=False)
    got = net.predict(history)
    assert got.shape == (*leading, 3)
    for index in np.ndindex(*leading):
        for j in range(3):
            w1, b1, w2, b2, w3, b3 = (torch.tensor(w[j]).double() for w in net.weights)
            x = torch.tensor(np.concatenate(list(history[index][j]))).double()  # q, q_dot, u
            x = (x - torch.tensor(net.input_mean[j])) / torch.tensor(net.input_scale[j])
            x = torch.relu(x @ w1 + b1)
            x = torch.relu(x @ w2 + b2)
            y = torch.sigmoid(x @ w3 + b3).item()
            low, high = float(net.output_low[j]), float(net.output_high[j])
            assert got[index][j] == pytest.approx(low + y * (high - low), abs=2e-5)
            assert low <= got[index][j] <= high


def test_prediction_refuses_another_shape():
    with pytest.raises(ValueError) as caught:
        random_net().predict(np.zeros((4, 2, 3, 13), np.float32))
    assert str(caught.value) == "history: expected (..., 3, 3, 13), got (4, 2, 3, 13)"
    with pytest.raises(ValueError, match=r"got \(3, 3, 12\)"):
        random_net().predict(np.zeros((3, 3, 12), np.float32))


def test_a_step_of_the_simulation_by_hand():
    net = replace(constant_net([0.2, -0.4], False, ("a", "b")), velocity_samples=2)
    net = replace(net, q_low=np.float32([0.0, 0.985]), q_high=np.float32([1.0, 2.0]))
    history, q = net.step(rest_history(np.array([0.5, 1.0]), 13), np.array([0.5, 1.0]), [0.3, -0.1])
    np.testing.assert_allclose(q, [0.51, 0.985], atol=1e-6)  # the second meets its stop
    np.testing.assert_allclose(history[:, 1, -1], [0.2, -0.3], atol=1e-5)
    np.testing.assert_allclose(history[:, 2, -2:], [[0, 0.3], [0, -0.1]])
    # beyond what training saw it may stay or come back, but go no further
    _, outside = net.step(history, np.array([1.5, 0.5]), [0.0, 0.0])
    np.testing.assert_allclose(outside, [1.5, 0.5], atol=1e-6)
    logged = replace(net, velocity_logged=True)
    history, _ = logged.step(rest_history(np.array([0.5, 1.0]), 13), np.array([0.5, 1.0]), [0.1, 0.1])
    np.testing.assert_allclose(history[:, 1, -1], [0.2, -0.3], atol=1e-5)


def test_a_joint_without_a_command_that_stood_still_stays():
    net = constant_net([0.2, 0.2, 0.2, 0.2], False, ("a", "b", "c", "d"))
    history = rest_history(np.zeros(4, np.float32), 13)
    history[1, 2, 1] = 0.01  # b had a command within the history that remains
    history[2, 0, 1:] = 0.003  # c has moved
    _, q = net.step(history, np.array([0.0, 0.0, 0.003, 0.0]), [0.0, 0.0, 0.0, 0.01])
    np.testing.assert_allclose(q, [0.0, 0.01, 0.013, 0.01], atol=1e-6)
    history[1, 2, 1], history[1, 2, 0] = 0.0, 0.01  # a tick later it is past
    _, q = net.step(history, np.zeros(4), [0.0, 0.0, 0.0, 0.0])
    assert q[1] == 0.0


def test_selected_nets_are_the_same_nets_in_another_order():
    net = random_net()
    history = np.random.default_rng(2).uniform(-1, 1, (6, 3, 3, 13)).astype(np.float32)
    every = net.predict(history)  # before: a cache of the whole must not leak into the part
    part = net.select(["j2", "j0"])
    assert part.joints == ("j2", "j0")
    np.testing.assert_allclose(part.predict(history[:, [2, 0]]), every[:, [2, 0]], atol=1e-6)
    assert part.output_low.tolist() == net.output_low[[2, 0]].tolist()
    with pytest.raises(ValueError, match=r"joints: expected nets for \['j0', 'q9'\], got"):
        net.select(["j0", "q9"])


# --- files ----------------------------------------------------------------------------------------


def test_a_net_survives_its_file(tmp_path):
    net = random_net()
    history = np.random.default_rng(2).uniform(-1, 1, (6, 3, 3, 13)).astype(np.float32)
    wanted = net.predict(history)  # fills whatever is cached, which must not be written
    save_net(tmp_path / "net.npz", net)
    again = load_net(tmp_path / "net.npz")
    for field in fields(ActuatorNet):
        one, two = getattr(net, field.name), getattr(again, field.name)
        if field.name == "weights":
            assert all(np.array_equal(a, b) and a.dtype == b.dtype for a, b in zip(one, two, strict=True))
        else:
            assert np.array_equal(one, two), field.name
    np.testing.assert_array_equal(again.predict(history), wanted)


def saved(tmp_path, **changes):
    """A net file with some arrays changed (None: left out)."""
    path = tmp_path / "net.npz"
    save_net(path, random_net())
    with np.load(path) as file:
        arrays = dict(file)
    arrays |= changes
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})
    return path, arrays


def header(tmp_path, **changes) -> np.ndarray:
    _, arrays = saved(tmp_path)
    values = json.loads(str(arrays["header"])) | changes
    return np.array(json.dumps({k: v for k, v in values.items() if v is not None}))


def refusal(path) -> str:
    with pytest.raises(ValueError) as caught:
        load_net(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ") and "expected" in message and "got" in message
    return message


def test_files_that_are_no_net_are_refused_with_wanted_and_got(tmp_path):
    path = tmp_path / "net.npz"
    refusal(path)  # not there
    path.write_text("run,time\n")
    assert "readable .npz" in refusal(path)
    save_net(path, random_net())
    whole = path.read_bytes()
    for length in (0, 10, len(whole) // 2, len(whole) - 30):
        path.write_bytes(whole[:length])
        refusal(path)
    np.savez(path, time=np.arange(3))
    assert "header" in refusal(path)


@pytest.mark.parametrize("name", ["weight_0", "weight_5", "input_scale", "q_high", "header"])
def test_a_net_with_a_missing_array_is_refused_by_its_name(tmp_path, name):
    path, _ = saved(tmp_path, **{name: None})
    assert name in refusal(path)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"format": 99}, ["actuator net", "99"]),
        ({"format": None}, ["actuator net", "None"]),
        ({"kind": "policy"}, ["actuator net", "policy"]),
        ({"history": None}, ["history"]),
        ({"joints": None}, ["joints"]),
        ({"history": 7}, []),
        ({"joints": ["a", "b"]}, []),
        ({"colour": "red"}, ["colour"]),
    ],
)
def test_a_header_that_does_not_fit_is_refused(tmp_path, changes, words):
    path, _ = saved(tmp_path, header=header(tmp_path, **changes))
    message = refusal(path)
    assert all(word in message for word in words), message


@pytest.mark.parametrize("text", ["", "{", "3", "null", "[1, 2]", '"text"', "[]"])
def test_a_header_that_is_no_table_is_refused(tmp_path, text):
    path, _ = saved(tmp_path, header=np.array(text))
    refusal(path)


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("weight_0", (3, 39, 31)), ("weight_1", (3, 31)), ("weight_2", (2, 32, 32)),
        ("weight_4", (3, 32, 2)), ("weight_5", (1, 1)), ("input_mean", (3, 38)),
        ("input_scale", (39,)), ("output_low", (2,)), ("q_low", (2,)), ("q_high", ()),
    ],
)  # fmt: skip
def test_arrays_of_another_shape_are_refused(tmp_path, name, shape):
    path, _ = saved(tmp_path, **{name: np.ones(shape, np.float32)})
    refusal(path)


# --- fitting --------------------------------------------------------------------------------------


def simple_system(seed: int, recordings: int, ticks: int = 300, logged: bool = False) -> Log:
    """Two first-order joints, q_ddot = (gain u - q_dot) / tau, turned back at +-0.8 rad."""
    rng = np.random.default_rng(seed)
    gain, tau, shape = np.array([0.5, 1.0]), np.array([0.15, 0.3]), (recordings, 2)
    q, q_dot, u = rng.uniform(-0.5, 0.5, shape), np.zeros(shape), np.zeros(shape)
    rows = []
    for tick in range(ticks):
        if tick % 8 == 0:
            u = np.where(np.abs(q) > 0.8, -np.sign(q) * 0.6, rng.uniform(-1, 1, shape))
        rows.append((u, q, q_dot))
        for _ in range(10):
            q, q_dot = q + 0.005 * q_dot, q_dot + 0.005 * (gain * u - q_dot) / tau
    tapes = np.array(rows).transpose(2, 1, 0, 3)  # (recordings, 3, ticks, 2)
    made = [(u, q, q_dot if logged else velocity_of(q, 4)) for u, q, q_dot in tapes]
    result = tuple(Recording(f"r{i}", *arrays) for i, arrays in enumerate(made))
    return Log(("boom", "stick"), result, logged)


@pytest.mark.parametrize("logged", [False, True])
def test_nets_learn_a_simple_system(logged):
    config = FitConfig(steps=500, batch_size=256)
    net = fit(simple_system(0, 25, logged=logged), config, seed=0, velocity_samples=4, machine="toy")
    assert net.joints == ("boom", "stick") and net.machine == "toy" and net.rate == 20.0
    assert net.velocity_logged == logged and net.settings["steps"] == 500
    unseen = simple_system(1, 6, logged=logged)
    result = score(net, unseen)
    for name in ("boom", "stick"):
        assert result[name]["one_step_rmse"] < 0.5 * result[name]["persistence_rmse"], result
        moved = np.sqrt(np.mean(np.concatenate([r.q_dot for r in unseen.recordings]) ** 2, axis=0))
        for horizon in ("1", "5", "10"):
            run = result[name]["free_run"][horizon]
            assert run["velocity_rmse"] < 0.2 * moved[net.joints.index(name)], (name, horizon)
            assert run["position_error_median"] < 0.1, (name, horizon)
        assert "30" not in result[name]["free_run"]  # the recordings have 15 s


def test_a_fit_repeats_itself_to_the_bit():
    log, config = simple_system(0, 3), FitConfig(steps=40, batch_size=64)
    torch.manual_seed(1)
    one = fit(log, config, seed=5, velocity_samples=4)
    torch.manual_seed(2)
    np.random.seed(0)  # noqa: NPY002
    two = fit(log, config, seed=5, velocity_samples=4)
    other = fit(log, config, seed=6, velocity_samples=4)
    for a, b in zip(one.weights, two.weights, strict=True):
        np.testing.assert_array_equal(a, b)
    assert not np.array_equal(one.weights[0], other.weights[0])


@pytest.mark.parametrize("logged", [False, True])
def test_the_loss_of_a_free_run_is_what_the_nets_do_when_run(logged):
    """Three ticks on the nets' own outputs, stops included: squared errors so far, in units of the range."""
    log, config = simple_system(0, 4, logged=logged), FitConfig(steps=1, batch_size=4, noise=0, rollout=3)
    net = fit(log, config, seed=0, velocity_samples=4)
    net.weights[5][:] = 9.0  # fast upwards
    training = actuator.training_set(log, 13, 3)
    span = training.output_high - training.output_low
    tapes = [torch.tensor(a).float().flatten(-2) for a in (training.series, training.target.T)]
    whole, wanted, met = actuator.end_to_end(log).whole, 0.0, 0
    at = np.array([[20, 350, int(whole.q[:, 0].argmax())], [40, 700, int(whole.q[:, 1].argmax())]])
    weights = [torch.tensor(w) for w in net.weights]
    shifted = torch.tensor(at + np.array([[0], [len(training.target)]]))
    got = actuator._rollout_loss(
        training, config, weights, tapes, shifted, 3, None if logged else 4, torch.Generator()
    )
    for j in range(2):
        for end in at[j]:
            rows = np.arange(end - 12, end + 1)
            u = whole.u[rows - 1]
            history = np.stack([whole.q[rows], whole.q_dot[rows], u]).transpose(2, 0, 1).astype(np.float32)
            q, off = whole.q[end], 0.0
            for k in range(3):
                before = q
                history, q = net.step(history, q, whole.u[end + k])
                met += abs(q[j] - before[j]) < 1e-6
                off += ((q - before)[j] * 20 - training.target[end + k, j]) / span[j]
                wanted += off**2 / 3 / 3  # mean over ticks and windows
    assert met >= 2  # it pushes against a stop in places
    assert float(got) == pytest.approx(wanted, rel=1e-3)


@pytest.mark.parametrize("logged", [False, True])
def test_a_stop_in_the_log_does_not_slow_the_nets_down_before_it(logged):
    """A joint that goes at 0.3 u until it hits a hard stop: the nets say its speed up to there."""
    rng, recordings = np.random.default_rng(0), []
    for run in range(60):
        u = np.repeat(rng.uniform(-1, 1, 8), 20)[:, None]
        q = np.zeros((161, 1))
        for k in range(160):
            q[k + 1] = np.clip(q[k] + 0.3 * u[k] / 20, -0.2, 0.2)
        q_dot = np.diff(q, axis=0, prepend=0) * 20 if logged else velocity_of(q, 4)
        recordings.append(Recording(f"r{run}", u, q[:160], q_dot[:160]))
    log = Log(("a",), tuple(recordings), logged)
    net = fit(log, FitConfig(steps=800, batch_size=256), seed=0, velocity_samples=4)
    history, q, angles = rest_history(np.float32([-0.2]), 13), np.array([-0.2]), []
    for _ in range(60):
        history, q = net.step(history, q, [0.9])
        angles.append(q[0])
    moving = np.diff(angles)[:26] * 20
    np.testing.assert_allclose(moving, 0.27, atol=0.035)  # within 0.013 rad of the stop
    np.testing.assert_allclose(angles[31:], 0.2, atol=1e-6)  # and there it stays


def test_windows_of_free_runs_end_before_the_seams():
    training = actuator.training_set(Log(("a",), (line("x", 0, 0.1, 30), line("y", 5, 0.2, 40))), 13, 8)
    np.testing.assert_array_equal(training.ends[0], [*range(12, 29), *range(42, 69)])
    np.testing.assert_array_equal(training.far_ends[0], [*range(12, 22), *range(42, 62)])


def test_recordings_too_short_for_free_runs_are_fitted_to_one_step():
    recordings = tuple(line(f"r{i}", 0.0, 0.1 * i, 15) for i in range(4))
    config = FitConfig(steps=5, batch_size=8, rollout=8)
    one = fit(Log(("a",), recordings), config, seed=0, velocity_samples=4)
    two = fit(Log(("a",), recordings), replace(config, rollout=1), seed=0, velocity_samples=4)
    for a, b in zip(one.weights, two.weights, strict=True):
        np.testing.assert_array_equal(a, b)


def test_memory_of_a_fit_grows_with_the_data_and_not_with_data_times_history():
    """Peak beside the log of 60,000 samples; all windows of 80 samples at once would be 115 MB in float64."""
    log = Log(("a",), (line("x", 0.0, 0.01, 60_000),))
    net = fit(log, FitConfig(steps=1, batch_size=8, history=80), seed=0, velocity_samples=4)
    tracemalloc.start()
    actuator.training_set(log, 80, 8)
    held = tracemalloc.get_traced_memory()[1]
    tracemalloc.reset_peak()
    actuator.fit_linear(net, log)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert held < 15e6  # 250 bytes a sample
    assert peak < 15e6 + 6 * 8192 * 241 * 8  # and some chunks


def line(name: str, start: float, slope: float, ticks: int, u: float = 0.5) -> Recording:
    q = np.full((ticks, 1), start) + slope * np.arange(ticks)[:, None] / 20
    return Recording(name, np.full((ticks, 1), u), q, velocity_of(q, 4))


def test_windows_never_cross_recordings():
    """Between these recordings lies a jump of 5 rad: a window across it would want 100 rad/s."""
    recordings = (line("x", 0.0, 0.1, 14), line("y", 5.0, 0.3, 14), line("z", -5.0, 0.2, 14))
    config = FitConfig(steps=1, batch_size=8)
    net = fit(Log(("a",), recordings), config, seed=0, velocity_samples=4)
    # one window a recording, targets 0.1, 0.3 and 0.2 rad/s, and a margin of a twentieth
    assert net.output_low[0] == pytest.approx(0.09, abs=1e-5)
    assert net.output_high[0] == pytest.approx(0.31, abs=1e-5)
    assert net.q_low[0] == pytest.approx(-5.0, abs=1e-5)
    assert net.q_high[0] == pytest.approx(5.195, abs=1e-5)


def test_recordings_too_short_for_a_window_teach_nothing():
    many = tuple(line(f"r{i}", 0.0, 0.1 * i, 13) for i in range(20))
    with pytest.raises(ValueError, match="joint a: expected a recording of 14 samples") as caught:
        fit(Log(("a",), many), FitConfig(steps=1), seed=0, velocity_samples=4)
    assert "got none" in str(caught.value)


def test_a_joint_that_stands_still_is_refused_by_name():
    still = np.zeros((40, 1))
    moving = simple_system(0, 1, 40).recordings[0]
    both = (moving.u[:, :1], moving.q[:, :1], moving.q_dot[:, :1])
    pairs = (np.concatenate([column, still], axis=1) for column in both)
    with pytest.raises(ValueError, match="joint stick"):
        fit(Log(("boom", "stick"), (Recording("x", *pairs),)), FitConfig(steps=1), 0, 4)


# --- scores ---------------------------------------------------------------------------------------


def test_scores_of_a_net_that_says_one_velocity_by_hand():
    """The joints go at 0.1 and -0.3 rad/s, the nets say 0.2 and -0.3."""
    ticks = np.arange(120)[:, None]
    q = np.array([0.1, -0.3]) * ticks / 20
    recording = Recording("x", np.zeros((120, 2)), q, np.full((120, 2), [0.1, -0.3]))
    net = constant_net([0.2, -0.3], True, ("a", "b"))
    result = score(net, Log(("a", "b"), (recording,), True))
    assert set(result) == {"a", "b"} and set(result["a"]["free_run"]) == {"1", "5"}  # 6 s of log
    assert result["a"]["one_step_rmse"] == pytest.approx(0.1, abs=1e-6)
    assert result["a"]["persistence_rmse"] == pytest.approx(0.0, abs=1e-9)
    for horizon in (1, 5):
        run = result["a"]["free_run"][str(horizon)]
        assert run["velocity_rmse"] == pytest.approx(0.1, abs=1e-6)
        assert run["position_error_median"] == pytest.approx(0.1 * horizon, abs=1e-5)
        exact = result["b"]["free_run"][str(horizon)]
        assert exact["velocity_rmse"] == pytest.approx(0.0, abs=1e-6)
        assert exact["position_error_median"] == pytest.approx(0.0, abs=1e-5)


def test_one_step_is_against_what_the_nets_are_fitted_to_by_hand():
    """q = 0.1 t^2: in the tick from t it moves at 0.2 t + 0.005 rad/s, whatever an estimator says."""
    time = np.arange(60)[:, None] / 20
    q = 0.1 * time**2
    recording = Recording("x", np.zeros((60, 1)), q, velocity_of(q, 4))
    log = Log(("a",), (recording, recording._replace(name="y", q=q + 9.0)))
    result = score(constant_net([0.2], False, ("a",)), log)["a"]
    at = time[13:59]  # samples with 13 before and one after them
    wanted = np.sqrt(np.mean((0.2 - (0.2 * at + 0.005)) ** 2))
    assert result["one_step_rmse"] == pytest.approx(wanted, abs=1e-5)
    # the slope through four samples lags by 1.5 ticks, and the target leads by half a tick: 0.2 * 2 / 20
    assert result["persistence_rmse"] == pytest.approx(0.02, abs=1e-6)


def test_scores_compare_velocities_of_one_kind():
    with pytest.raises(ValueError, match="velocity_logged: expected True, got False"):
        score(constant_net([0.2], True, ("a",)), Log(("a",), (line("x", 0.0, 0.1, 40),)))


def test_scoring_shows_its_progress(monkeypatch):
    shown = []
    monkeypatch.setattr(actuator, "tqdm", lambda work, **options: shown.append(options) or work)
    score(constant_net([0.2], False, ("a",)), Log(("a",), (line("x", 0.0, 0.1, 40),)))
    assert shown and all(options["disable"] is None for options in shown)  # None: on terminals only


def test_persistence_by_hand_and_segments_within_recordings():
    """Velocity grows by 0.2 rad/s each second: 0.01 a tick. The second recording is far away."""
    time = np.arange(60)[:, None] / 20
    pieces = tuple(
        Recording(name, 0 * time, start + 0.1 * time**2, 0.2 * time)
        for name, start in (("x", 0.0), ("y", 50.0), ("z", -80.0))
    )
    log = Log(("a",), pieces, True)
    result = score(constant_net([0.0], True, ("a",)), log)
    assert result["a"]["persistence_rmse"] == pytest.approx(0.01, abs=1e-9)
    # 2 segments of 1 s each a recording, from samples 13 and 33: 0.1 ((t + 1)^2 - t^2)
    ends = [0.1 * ((13 / 20 + 1) ** 2 - (13 / 20) ** 2), 0.1 * ((33 / 20 + 1) ** 2 - (33 / 20) ** 2)]
    error = result["a"]["free_run"]["1"]["position_error_median"]
    assert error == pytest.approx(sum(ends) / 2, abs=1e-4)
    speeds = 0.2 * np.array([np.arange(14, 34), np.arange(34, 54)]) / 20
    rmse = np.sqrt(np.mean(speeds**2))
    assert result["a"]["free_run"]["1"]["velocity_rmse"] == pytest.approx(rmse, abs=1e-5)


def test_a_free_run_sees_the_past_of_the_log_and_then_only_itself():
    net = replace(random_net(n=2, history=5), velocity_samples=3)
    rng = np.random.default_rng(0)
    u, q = rng.uniform(-0.6, 0.6, (40, 2)), np.cumsum(rng.uniform(-0.02, 0.02, (40, 2)), axis=0)
    recording = Recording("x", u, q, velocity_of(q, 3))
    angles, velocities = free_run(net, recording, np.array([7, 20]), 6)
    assert angles.shape == velocities.shape == (6, 2, 2)
    for s, start in enumerate((7, 20)):
        past, speeds = list(q[start - 4 : start + 1]), list(recording.q_dot[start - 4 : start + 1])
        for k in range(6):
            window = np.stack([past[-5:], speeds[-5:], u[start + k - 4 : start + k + 1]])
            velocity = net.predict(window.transpose(2, 0, 1).astype(np.float32))
            past.append(past[-1] + velocity / 20)
            speeds.append(estimate_velocity(np.array(past[-3:]).T, 3, 0.05))
            np.testing.assert_allclose(angles[k, s], past[-1], atol=1e-4)
            np.testing.assert_allclose(velocities[k, s], speeds[-1], atol=1e-4)


def test_errors_of_whole_recordings_by_hand():
    """A net that says 0.2 rad/s on recordings of 0.1, 0.3 (short), nothing and too few samples."""
    pieces = (
        line("a", 0.0, 0.1, 60),
        line("b", 9.0, 0.35, 20),
        line("c", 0.0, 0.0, 40, u=0.0),
        line("d", 0, 1, 13),
    )
    net = constant_net([0.2], True, ("a",))
    log = Log(
        ("a",),
        tuple(r._replace(q_dot=np.full_like(r.q, s)) for r, s in zip(pieces, (0.1, 0.35, 0, 1), strict=True)),
        True,
    )
    errors = actuator.recording_errors(net, log, 30.0)
    np.testing.assert_allclose(errors[:2, 0], [0.1, 0.15], atol=1e-6)
    assert np.isnan(errors[2:]).all()
    assert np.isnan(actuator.recording_errors(net, log._replace(recordings=log.recordings[3:]), 30.0)).all()


def test_scores_need_the_same_joints_and_one_step_at_least():
    net = constant_net([0.2], False, ("a",))
    with pytest.raises(ValueError, match=r"joints: expected \['a'\], got \['b'\]"):
        score(net, Log(("b",), (line("x", 0.0, 0.1, 40),)))
    with pytest.raises(ValueError, match=r"above 14 samples, got \[14, 5\]"):
        score(net, Log(("a",), (line("x", 0.0, 0.1, 14), line("y", 0.0, 0.1, 5))))
    score(net, Log(("a",), (line("x", 0.0, 0.1, 15),)))


def test_speed_limits_are_where_the_plant_settles_at_the_command_limit():
    q = np.array([[0.1, 0.4, 0.6, 1.5, 0.9], [-1.0, 1.0, 0.2, 2.2, 1.4]])
    for sign, limit in zip((-1, 1), speed_limits(BROKK_170, q), strict=True):
        for joint in range(5):
            state, u = plant_reset(BROKK_170, q), np.zeros((2, 5))
            u[:, joint] = sign * 80 / 127
            for _ in range(14):
                state = plant_step(BROKK_170, state, u)
            now = speed_limits(BROKK_170, state.q)[int(sign > 0)][:, joint]
            velocity = plant_velocity(BROKK_170, state)[:, joint]
            np.testing.assert_allclose(velocity, now, rtol=0.03)
            assert (sign * limit[:, joint] > 0.05).all()


# --- what planted errors had passed ---------------------------------------------------------------


def test_lever_arm_of_q5_at_an_acute_angle_by_hand():
    # sides 0.6 and 0.2 under 60 degrees: third side sqrt(0.28), height 0.6 * 0.2 * sin 60 degrees / it
    arm = lever_arm(BROKK_170, np.full(5, np.pi / 3 - 0.4))
    assert arm[Q5] == pytest.approx(0.19640, abs=1e-5)


def test_the_first_count_that_moves_anything_is_eleven():
    """8.9 counts of dead zone, and the next 1.2 open the spool too little (1 %) to wake an idle valve."""
    for sign in (1, -1):
        _, velocities, _ = record(BROKK_170, MIDDLE, np.full((100, 5), sign * 10 / 127))
        assert not velocities.any()
        _, velocities, _ = record(BROKK_170, MIDDLE, np.full((100, 5), sign * 11 / 127))
        assert np.all(sign * velocities[-1] > 1e-4)
