"""Feed-forward: the static map is what the nets say of steady motion, and its inverse undoes it."""

from dataclasses import replace

import numpy as np
import pytest
from helpers_machines import obedient_net, obedient_velocity
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import machines

from brokk_min.evaluation.feedforward import StaticMap, static_map
from brokk_min.machine import BROKK_170


@settings(max_examples=5)
@given(machines(), st.integers(0, 2**31))
def test_command__inverts_the_velocity_of_the_nets(machine, seed):
    steady = static_map(machine, obedient_net(machine))
    limit = machine.pwm_limit / 127
    assert (steady.u[0], steady.u[-1]) == pytest.approx((-limit, limit))
    velocity = obedient_velocity(machine, steady.u[:, None] * np.ones(len(machine.driven)))
    expected = np.repeat(velocity.T[:, None, :], steady.q.shape[1], axis=1)
    np.testing.assert_allclose(steady.velocity, expected, atol=1e-5)
    rng = np.random.default_rng(seed)
    u = rng.uniform(-limit, limit, (40, len(machine.driven)))
    low, high = machine.column("q_min")[machine.driven], machine.column("q_max")[machine.driven]
    q = rng.uniform(low, high, u.shape)
    np.testing.assert_allclose(steady.command(q, obedient_velocity(machine, u)), u, atol=0.02)
    np.testing.assert_allclose(steady.command(q, np.full(u.shape, 99.0)), limit)
    np.testing.assert_allclose(steady.command(q, np.full(u.shape, -99.0)), -limit)


@pytest.mark.parametrize(
    ("angle", "speed"), [(-3, 1), (-1, 1), (-0.25, 1.5), (0.5, 2), (1.25, 3), (2, 4), (9, 4)]
)
def test_command__interpolates_between_angles_and_holds_beyond_them(angle, speed):
    """Speeds at full command are 1, 2 and 4 rad/s at -1, 0.5 and 2 rad."""
    u = np.array([-1.0, 0.0, 1.0])
    scale = np.array([1.0, 2.0, 4.0])[None, :, None]
    steady = StaticMap(np.array([[-1.0, 0.5, 2.0]]), u, scale * u)
    for q_dot in (0.5, -0.25):
        result = steady.command(np.array([float(angle)]), np.array([q_dot]))
        np.testing.assert_allclose(result, [q_dot / speed], atol=1e-9)


def test_static_map__is_the_fixed_point_of_steady_motion():
    """Found here by a plain loop, one joint at one angle under one command."""
    net = obedient_net(BROKK_170)
    first = net.weights[0].copy()  # angles and velocities matter, too
    first[:, :26, 0] = 0.05 * np.random.default_rng(12).standard_normal((4, 26))
    net = replace(net, weights=(first, *net.weights[1:]))
    steady = static_map(BROKK_170, net)
    assert steady.velocity.shape == (4, 9, 41)
    time = np.arange(-12, 1) / 20
    for angle in (0, 8):
        q = steady.q[:, angle]
        speeds = np.zeros((41, 4))
        for c, u in enumerate(steady.u):
            for _ in range(200):
                v = speeds[c]
                rows = [[q[j] + v[j] * time, np.full(13, v[j]), np.full(13, u)] for j in range(4)]
                speeds[c] = 0.5 * v + 0.5 * net.predict(np.array(rows, np.float32)[None])[0]
        rising = np.maximum.accumulate(speeds, axis=0).T
        np.testing.assert_allclose(steady.velocity[:, angle], rising, atol=1e-5)
        assert (rising[:, -1] - rising[:, 0] > 0.1).all()


def test_static_map__has_the_other_joints_at_rest_in_the_middle():
    """A latent reads q1, and drives q5."""
    net = obedient_net(BROKK_170)
    n, inputs = net.input_mean.shape
    read = np.zeros((n, 2 * inputs, 1), np.float32)
    read[0, 12] = 0.5  # the newest angle of q1
    drive = np.zeros((n, 1, net.weights[1].shape[1]), np.float32)
    drive[3] = 0.3
    net = replace(net, weights=(*net.weights, read, drive, np.zeros((n, 1), np.float32)))
    steady = static_map(BROKK_170, net)
    low, high = BROKK_170.column("q_min"), BROKK_170.column("q_max")
    middle = ((low + high) / 2)[BROKK_170.driven]
    for c, u in enumerate(steady.u):
        v = 0.0
        history = np.zeros((1, 4, 3, 13), np.float32)
        history[0, :, 0] = middle[:, None]
        history[0, 3, 2] = u
        for _ in range(200):
            history[0, 3, 0] = steady.q[3, 8] + v * np.arange(-12, 1) / 20
            history[0, 3, 1] = v
            v = 0.5 * v + 0.5 * net.predict(history)[0, 3]
        assert steady.velocity[3, 8, c] == pytest.approx(v, abs=1e-5)
