"""Free runs by hand; step responses of simulators whose answer is known, and of the plant."""

from dataclasses import replace

import numpy as np
import pytest
from helpers_machines import constant_net, random_net

from brokk_min.identification import simulation
from brokk_min.identification.files import SHIPPED
from brokk_min.identification.logs import Recording, velocity_of
from brokk_min.identification.simulation import (
    creep,
    dead_zones,
    free_run,
    plant_simulator,
    recovery,
    response_times,
    step_velocity,
    steps,
)
from brokk_min.kinematics import estimate_velocity
from brokk_min.learning.policy import load_policy
from brokk_min.machine import BROKK_170

LOW, HIGH = BROKK_170.column("q_min"), BROKK_170.column("q_max")


def constant_simulator(speed_up, speed_down, late):
    """Joints that move at one speed `late` ticks after a command, whatever its size."""

    def simulate(q, u):
        sent = np.concatenate([np.zeros((late, *u.shape[1:])), u])[: len(u)]
        speed = np.where(sent > 0, speed_up, np.where(sent < 0, -speed_down, 0.0))
        return np.concatenate([q[None], q + np.cumsum(speed, axis=0) / 20])

    return simulate


def test_free_run__has_the_history_of_the_log_and_then_its_own():
    net = replace(random_net(n=2, history=5), velocity_samples=3)
    rng = np.random.default_rng(0)
    u, q = rng.uniform(-0.6, 0.6, (40, 2)), np.cumsum(rng.uniform(-0.02, 0.02, (40, 2)), axis=0)
    recording = Recording("x", u, q, velocity_of(q, 3))
    with pytest.raises(ValueError, match=r"^starts: expected 5 or more, got 4"):
        free_run(net, recording, np.array([7, 4]), 6)
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


def test_creep__is_the_largest_drift_without_a_command():
    net = constant_net([0.003, -0.002], False, ("a", "b"))
    one = np.ones(2)
    net = replace(net, q_low=-one, q_high=one, dead_zone=-1.0)  # no standstill
    np.testing.assert_allclose(creep(net), [0.003, 0.002], rtol=1e-2)
    assert not creep(replace(net, dead_zone=0.07)).any()


@pytest.mark.parametrize("late", [0, 3, 9])
def test_response_times__of_a_pure_delay_by_hand(late):
    """All speed from tick `late` on: between two ticks' middles the line passes 63 % at 0.63."""
    level, simulate = np.full(2, 0.6), constant_simulator(0.2, 0.4, late)
    angles = steps(simulate, -np.ones(2), np.ones(2), level, 0 * level, 30)
    assert angles.shape == (61, 2, 2, 2, 2)
    np.testing.assert_allclose(response_times(angles, 20.0), (late + 0.63 - 0.5) / 20, atol=1e-9)
    begins = response_times(angles, 20.0, 0.05)  # without a delay the line passes before the step
    np.testing.assert_allclose(begins, max(late + 0.05 - 0.5, 0) / 20, atol=1e-9)
    speeds = step_velocity(angles, 20.0)
    np.testing.assert_allclose(speeds[-1], [[[0.2, 0.2], [0.4, 0.4]]] * 2)  # positive up and down


def test_response_times__of_a_joint_that_does_not_answer_are_none():
    level, simulate = np.full(2, 0.5), constant_simulator(0.2, 0.0, 0)
    times = response_times(steps(simulate, -np.ones(2), np.ones(2), level, level, 20), 20.0)
    assert np.isnan(times[0, 1]).all() and np.isfinite(times[0, 0]).all()
    assert np.isnan(times[1]).all()  # it moves before the step as after it
    named = simulation.named_times(times, ("a", "b"))
    none = {"up": None, "down": None}
    assert named["b"] == {"idle": {"up": pytest.approx(0.0065), "down": None}, "moving": none}


def test_steps__move_only_the_stepping_joint_away_from_the_end_behind_it():
    level, simulate = np.full(3, 0.5), constant_simulator(0.1, 0.1, 0)
    low, high = np.array([0.0, -1.0, 2.0]), np.array([1.0, 1.0, 4.0])
    angles = steps(simulate, low, high, level, level / 2, 30)
    starts = angles[0, 0]  # (up and down, stepping, joint)
    np.testing.assert_allclose(starts[0, 1], [0.5, -0.8, 3.0])
    np.testing.assert_allclose(starts[1, 2], [0.5, 0.0, 3.8])
    moved, own = np.abs(angles[-1] - angles[0]), np.eye(3, dtype=bool)
    assert not moved[..., ~own].any()
    np.testing.assert_allclose(moved[0][:, own], 0.1 * 1.5)  # after the step alone
    np.testing.assert_allclose(moved[1][:, own], 0.1 * 3.0)  # before it too


DRIVEN = tuple(joint for joint in BROKK_170.joints if joint.driven)
FOUR = replace(BROKK_170, joints=DRIVEN, q_start=())
NET = load_policy(SHIPPED / BROKK_170.name / "policy.npz", BROKK_170).net


def test_dead_zones__are_the_plants_own():
    """0.07 of 127 counts are 8.9; valves open from 1 % of the stroke on, 1.2 counts more."""
    for dead_zone, counts in ((0.07, 10), (0.15, 20)):
        machine = replace(FOUR, dead_zone=dead_zone)
        found = dead_zones(plant_simulator(machine), NET, 30, 40)
        np.testing.assert_allclose(found * 127, counts)


def test_recovery__is_close_for_the_shipped_nets():
    for name, sides in recovery(NET, FOUR).items():
        nets, plant = sides["nets"], sides["plant"]
        assert nets["dead_zone"] == pytest.approx(plant["dead_zone"], abs=0.02), name
        assert nets["delay"] == pytest.approx(plant["delay"], abs=0.02), name
        assert nets["idle"] == pytest.approx(plant["idle"], abs=0.06), name
        assert nets["speed"] == pytest.approx(plant["speed"], rel=0.1), name
    slow = recovery(NET, replace(FOUR, delay=0.2))["q5"]["plant"]
    assert slow["delay"] == pytest.approx(np.add(plant["delay"], 0.16), abs=0.01)
    assert slow["idle"] == pytest.approx(np.add(plant["idle"], 0.16), abs=0.02)
