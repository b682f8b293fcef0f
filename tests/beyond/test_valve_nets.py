"""Nets that read what commands open, joints that are held, and means of several nets."""

import numpy as np
import pytest
import torch
from helpers_machines import constant_net, random_net
from hypothesis import given
from hypothesis import strategies as st

from brokk_min.actuator import initial_history
from brokk_min.beyond.net_ensemble import NetEnsemble
from brokk_min.beyond.valve_nets import ValveNet, mu_law, opening, valve_inputs
from brokk_min.machine import valve_opening

ZONES = np.array([[0.07, 0.07], [0.2, 0.1], [0.0, 0.3]])


def test_mu_law__by_hand():
    """Openings 0.01 and 0.5: ln(1.5) and ln(26) of ln(51)."""
    expected = [-1, -np.log(1.5) / np.log(51), 0, np.log(26) / np.log(51), 1]
    np.testing.assert_allclose(mu_law(np.array([-1.0, -0.01, 0.0, 0.5, 1.0])), expected, atol=1e-12)


@given(st.integers(0, 1000))
def test_valve_inputs__are_the_same_by_numpy_torch_and_a_loop(seed):
    history = np.random.default_rng(seed).uniform(-1, 1, (2, 3, 3, 5)).astype(np.float32)
    found = valve_inputs(history, ZONES.astype(np.float32))
    assert found.shape == (2, 3, 20) and found.dtype == np.float32
    by_torch = valve_inputs(torch.from_numpy(history), torch.from_numpy(ZONES).float(), torch)
    np.testing.assert_allclose(by_torch, found, atol=1e-6)
    for i, j in np.ndindex(2, 3):
        q, q_dot, u = history[i, j]
        x = valve_opening(u, ZONES[j])
        np.testing.assert_allclose(opening(history[i, :, 2], ZONES)[j], x, atol=1e-7)
        expected = np.concatenate([q, q_dot, mu_law(x), np.tanh(np.abs(x) / 0.02)])
        np.testing.assert_allclose(found[i, j], expected, atol=1e-6)


@pytest.mark.parametrize("counts", [0, 8])
def test_predict__holds_a_joint_whose_valve_was_closed_and_that_stood_still(counts):
    """8 counts are within the dead zone of 8.9, 9 are not; 3 mrad are a motion, 1 mrad is none."""
    history = initial_history(np.full(4, 0.5, np.float32), 13)
    history[:, 2] = np.float32([[counts], [-counts], [counts], [-counts]]) / np.float32(127)
    history[1, 2, 3] = -9 / 127
    history[2, 0, -1] = 0.503
    history[3, 0, -1] = 0.501
    net = constant_net([0.2] * 4, tuple("abcd"), rows=4)
    found = ValveNet(**vars(net), dead_zones=np.full((4, 2), 0.07)).predict(history)
    np.testing.assert_allclose(found, [0, 0.2, 0.2, 0], atol=1e-6)


@pytest.mark.parametrize("shape", [(), (7,), (2, 3)])
def test_predict__is_the_mean_of_the_nets(shape):
    common = vars(random_net(rows=4)) | {"dead_zones": ZONES}
    drawn = [random_net(np.random.default_rng(seed), rows=4).weights for seed in range(3)]
    stacked = tuple(np.stack(of, axis=1) for of in zip(*drawn, strict=True))
    history = np.random.default_rng(3).uniform(-1, 1, (*shape, 3, 3, 13)).astype(np.float32)
    each = np.array([ValveNet(**common | {"weights": w}).predict(history) for w in drawn])
    assert each.std(axis=0).min() > 1e-4  # they do not agree
    found = NetEnsemble(**common | {"weights": stacked}).predict(history)
    assert found.shape == (*shape, 3) and found.dtype == np.float32
    np.testing.assert_allclose(found, each.mean(axis=0), atol=1e-6)
