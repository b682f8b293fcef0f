"""The plant: its calibration, measured as on a machine, and its equations."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from strategies import machines, poses, reals

from brokk_min.actuator import PlantState, lever_arm, plant_reset, plant_step, speed_limits
from brokk_min.machine import BROKK_170, Machine

FAST = replace(BROKK_170, rate=200.0)  # a tick is one step of 5 ms
LIMIT = 80 / 127
MIDDLE = np.array([0.0, 0.5, 0.5, 1.7, 1.0])
Q5 = 4


def record(
    machine: Machine, q: np.ndarray, u: np.ndarray
) -> tuple[PlantState, np.ndarray, np.ndarray]:
    """Last state, joint velocities and cylinder speeds (ticks, ..., n) under commands `u`."""
    state = plant_reset(machine, q)
    velocities, speeds = [], []
    for command in u:
        state = plant_step(machine, state, command)
        velocities.append(state.speed / lever_arm(machine, state.q))
        speeds.append(state.speed)
    return state, np.array(velocities), np.array(speeds)


def only(joint: int, u: np.ndarray | list[float]) -> np.ndarray:
    """Commands (ticks, 5) for one joint."""
    commands = np.zeros((len(u), 5))
    commands[:, joint] = u
    return commands


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


def test_each_machine_of_a_batch_has_a_pump_of_its_own():
    starts = MIDDLE + 0.1 * np.arange(3)[:, None]
    batch, one = plant_reset(BROKK_170, starts), plant_reset(BROKK_170, starts[1])
    for _ in range(12):
        batch, one = (plant_step(BROKK_170, s, np.ones_like(s.q)) for s in (batch, one))
    np.testing.assert_allclose(batch.q[1], one.q, atol=1e-12)


def test_a_command_arrives_after_the_delay_and_not_a_step_earlier():
    state = plant_reset(FAST, MIDDLE)
    for tick in range(12):
        assert not state.spool.any() or tick > 8
        state = plant_step(FAST, state, only(Q5, [1.0 if tick == 0 else 0.0])[0])
        assert (state.spool[Q5] > 0) == (tick >= 8), tick  # 8 steps of 5 ms
    # at 20 Hz the spool has two steps of the tick left: 1 - (1 - 1/6)^2
    state = plant_step(BROKK_170, plant_reset(BROKK_170, MIDDLE), np.ones(5))
    np.testing.assert_allclose(state.spool, 1 - (5 / 6) ** 2, atol=1e-12)


@pytest.mark.parametrize("rate", [10.0, 20.0, 25.0, 30.0, 40.0, 60.0])
def test_a_tick_lasts_one_over_the_rate(rate):
    """Or a machine whose tick is no multiple of the plant's step is refused."""
    try:
        machine = replace(BROKK_170, rate=rate)
    except ValueError:
        return
    state, _, _ = record(machine, MIDDLE, only(0, np.full(round(1.5 * rate), LIMIT)))
    following = plant_step(machine, state, only(0, [LIMIT])[0])
    speed = (state.speed / lever_arm(machine, state.q))[0]  # of the slew drive: steady by now
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
            if x["z"] > m.valve_threshold:
                part = min(1.0, (x["z"] - m.valve_threshold) / (1 - m.valve_threshold))
                g = math.sqrt(3 * part**2 - 2 * part**3)
            K = joint.speed_positive if x["s"] > 0 else joint.speed_negative
            wanted.append(K * x["s"] * g)
        flow = sum(abs(j.cylinder_area * v) for j, v in zip(m.joints, wanted, strict=True))
        share = 1.0 if flow == 0 else min(1.0, m.pump_flow / flow)
        for i, (joint, x) in enumerate(zip(m.joints, joints, strict=True)):
            us = math.copysign(max(0.0, (abs(a[i]) - m.dead_zone) / (1 - m.dead_zone)), a[i])
            zt = 1.0 if abs(x["s"]) > m.spool_threshold else 0.0
            tau = m.tau_valve_up if zt > x["z"] else m.tau_valve_down
            if joint.cylinder_base:
                b, c, gamma = joint.cylinder_base, joint.cylinder_rod, joint.cylinder_angle + x["q"]
                r = b * c * math.sin(gamma) / math.sqrt(b * b + c * c - 2 * b * c * math.cos(gamma))
            else:
                r = joint.cylinder_rod
            new = {
                "q": x["q"] + dt * x["v"] / r,
                "v": x["v"] + dt * (wanted[i] * share - x["v"]) / m.tau_cylinder,
                "s": x["s"] + dt * (us - x["s"]) / m.tau_spool,
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
    for name, values in (
        ("q", state.q),
        ("v", state.speed),
        ("s", state.spool),
        ("z", state.ready),
    ):
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


def test_speed_limits_are_where_the_plant_settles_at_the_command_limit():
    q = np.array([[0.1, 0.4, 0.6, 1.5, 0.9], [-1.0, 1.0, 0.2, 2.2, 1.4]])
    for sign, limit in zip((-1, 1), speed_limits(BROKK_170, q), strict=True):
        for joint in range(5):
            state, u = plant_reset(BROKK_170, q), np.zeros((2, 5))
            u[:, joint] = sign * 80 / 127
            for _ in range(14):
                state = plant_step(BROKK_170, state, u)
            now = speed_limits(BROKK_170, state.q)[int(sign > 0)][:, joint]
            velocity = (state.speed / lever_arm(BROKK_170, state.q))[:, joint]
            np.testing.assert_allclose(velocity, now, rtol=0.03)
            assert (sign * limit[:, joint] > 0.05).all()


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
