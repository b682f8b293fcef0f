"""Physics beyond the paper's plant: each effect by hand, and none where it is switched off."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from scipy.spatial.transform import Rotation
from strategies import posed

from brokk_min.actuator import lever_arm, plant_reset, plant_step
from brokk_min.env import initial_state, transition
from brokk_min.identification import physics
from brokk_min.identification.physics import Physics, draw_machine
from brokk_min.kinematics import forward_kinematics
from brokk_min.machine import BROKK_170

START = np.array(BROKK_170.q_start)


def drive(machine, commands, q=START):
    """States of the plant after each of the commands (T, n)."""
    states = [plant_reset(machine, q)]
    for u in commands:
        states.append(plant_step(machine, states[-1], u))
    return states[1:]


def constant(level, joint, ticks=40):
    u = np.zeros((ticks, 5))
    u[:, joint] = level
    return u


def steady_speed(machine, level, joint):
    """Mean velocity [rad/s] in the second second of a constant command."""
    states = drive(machine, constant(level, joint))
    return float(states[-1].q[joint] - states[-21].q[joint])


def test_physics__without_effects_is_the_papers_plant_to_the_bit():
    rng = np.random.default_rng(0)
    commands = np.repeat(rng.uniform(-0.63, 0.63, (30, 4, 5)), 5, axis=0)
    q = rng.uniform(BROKK_170.column("q_min"), BROKK_170.column("q_max"), (4, 5))
    states = drive(replace(BROKK_170, plant=Physics()), commands, q)
    for ours, theirs in zip(states, drive(BROKK_170, commands, q), strict=True):
        for name in ("q", "v", "s", "z", "delayed"):
            np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))


@given(posed())
def test_gravity_torque__is_the_derivative_of_the_potential_energy(drawn):
    machine, q = drawn
    e = Rotation.from_euler("y", 0.1).inv().apply([0.0, 0.0, 1.0])  # the rear is lifted
    assert e[0] < 0  # what is at the front is lower

    def energy(q):
        p = forward_kinematics(machine, q).p
        middle = (p[..., 1:, :] + p[..., :-1, :]) / 2
        return physics.G * (20 * (middle @ e).sum(-1) + 7 * p[..., -1, :] @ e)

    h = 1e-5
    expected = [(energy(q + h * e) - energy(q - h * e)) / (2 * h) for e in np.eye(machine.n)]
    torque = physics.gravity_torque(machine, q, 20.0, 7.0, 0.1)
    np.testing.assert_allclose(torque, np.stack(expected, axis=-1), rtol=1e-5, atol=1e-4)


def test_load__slows_the_lift_and_speeds_the_fall():
    plant = Physics(link_mass=100.0, pressure=5e6)
    loaded = replace(BROKK_170, plant=plant)
    torque = physics.gravity_torque(BROKK_170, START, 100.0, 0.0, 0.0)[2]
    p_load = torque / (lever_arm(BROKK_170, START)[2] * BROKK_170.joints[2].cylinder_area)
    assert torque > 0  # q3 lifts the arm
    for level, sign in ((0.4, 1), (-0.4, -1)):
        fraction = steady_speed(loaded, level, 2) / steady_speed(BROKK_170, level, 2)
        assert fraction == pytest.approx(np.sqrt(1 - sign * p_load / 5e6), abs=0.03)
    heavier = replace(BROKK_170, plant=replace(plant, payload=100.0))
    assert steady_speed(heavier, 0.4, 2) < steady_speed(loaded, 0.4, 2)


def test_dead_zones__are_the_plants_own_whatever_the_machine_says():
    zones = ((0.1, 0.2),) * 5
    machine = replace(BROKK_170, plant=Physics(dead_zones=zones))
    for level, opening in ((0.15, 0.05 / 0.9), (-0.15, 0.0), (-0.6, -0.5)):
        assert drive(machine, constant(level, 2, 40))[-1].s[2] == pytest.approx(opening, abs=1e-4)
    known = replace(BROKK_170, plant=Physics())
    assert drive(known, constant(0.15, 2, 40))[-1].s[2] == pytest.approx(0.08 / 0.93, abs=1e-4)


def test_hysteresis__leaves_the_spool_open_behind_a_falling_command():
    machine = replace(BROKK_170, plant=Physics(hysteresis=0.02))
    rising, falling = constant(0.2, 2, 40), constant(0.4, 2, 80)
    falling[40:] = constant(0.2, 2, 40)
    assert drive(machine, rising)[-1].s[2] == pytest.approx(0.11 / 0.93, abs=1e-4)
    assert drive(machine, falling)[-1].s[2] == pytest.approx(0.15 / 0.93, abs=1e-4)
    at_rest = np.concatenate([falling, constant(0.0, 2, 40)])
    assert drive(machine, at_rest)[-1].s[2] == pytest.approx(0, abs=1e-6)


def test_stick_slip__holds_a_slow_cylinder_and_lets_a_moving_one_go_on():
    v_steady = np.array([0.001, 0.003, 0.001])
    v = np.array([0.0, 0.0, 0.001])
    np.testing.assert_array_equal(physics.stick_slip(v, v_steady, 0.002), [0, 0.003, 0.001])


def test_arm_mode__rings_at_its_frequency():
    fine = replace(BROKK_170, rate=200.0, plant=Physics(mode=2.0, damping=0.1))
    commands = np.concatenate([constant(0.5, 2, 200), constant(0.0, 2, 400)])
    v = np.array([state.v[2] for state in drive(fine, commands)])[300:]
    crossings = np.flatnonzero(np.diff(np.sign(v)) != 0)
    assert len(crossings) > 3
    assert np.diff(crossings).mean() / 200 == pytest.approx(0.25, abs=0.01)


def test_jitter__delays_by_no_more_than_it_says():
    late = replace(BROKK_170, plant=Physics(jitter=0.05))
    worst = replace(BROKK_170, delay=0.09)
    commands = constant(0.5, 2)
    q, soon, last = (
        np.array([state.q[2] for state in drive(machine, commands)])
        for machine in (late, BROKK_170, worst)
    )
    assert (last - 1e-12 <= q).all()
    assert (q <= soon + 1e-12).all()
    assert not np.array_equal(q, soon)


def test_backlash__is_what_the_encoder_lags_behind():
    machine = replace(BROKK_170, plant=Physics(backlash=0.01))
    for level, sign in ((0.4, 1), (-0.4, -1)):
        state = drive(machine, constant(level, 2))[-1]
        assert state.q[2] - state.encoder[2] == pytest.approx(sign * 0.005)
    state = initial_state(machine, START, [0, 0, 0], plant=True)
    for u in constant(0.4, 2):
        state = transition(machine, None, state, u)
    late = state.q[2] - state.history[2, 0, -1]
    assert late == pytest.approx(0.005, abs=machine.encoder_step[0])


def test_oil__is_slow_when_cold_and_warms_with_work():
    cold = replace(BROKK_170, plant=Physics(cold=0.5, warmth=0.0, warm_up=1e5))
    fraction = steady_speed(cold, 0.4, 2) / steady_speed(BROKK_170, 0.4, 2)
    assert fraction == pytest.approx(1 / 1.5, abs=0.01)
    plant = Physics(cold=0.5, warmth=0.0, warm_up=10.0)
    states = drive(replace(BROKK_170, plant=plant), constant(0.6, 0, 200))
    warmth = [float(state.warmth[0]) for state in states]
    assert (np.diff(warmth) >= 0).all()
    assert 0 < warmth[-1] < 1


def test_physics__refuses_sizes_out_of_range():
    with pytest.raises(ValueError, match=r"warmth: expected 0 to 1, got 2"):
        Physics(warmth=2.0)


def test_draw_machine__repeats_and_differs_by_seed():
    members = [draw_machine(BROKK_170, seed) for seed in range(8)]
    assert draw_machine(BROKK_170, 3) == members[3]
    assert len({member.plant for member in members}) == 8
    assert any(member.plant.link_mass for member in members)
    assert any(member.pump_flow < 0.7 * BROKK_170.pump_flow for member in members)
    for member in members:
        zones = np.array(member.plant.dead_zones)
        assert member.dead_zone == zones.min()
        assert member.largest_dead_zone == zones.max()
