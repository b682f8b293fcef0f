"""The mean of several nets for each joint, against the nets one by one."""

from dataclasses import replace

import numpy as np
import pytest
from helpers_machines import random_net

from brokk_min.beyond.net_ensemble import NetEnsemble
from brokk_min.beyond.valve_nets import ValveNet

ZONES = np.array([[0.1, 0.2], [0.0, 0.05], [0.07, 0.07]])


def valve_nets(num):
    """Nets of three joints that differ in their weights alone."""
    first = random_net(rows=4)
    drawn = [random_net(np.random.default_rng(seed), rows=4).weights for seed in range(num)]
    return [ValveNet(**vars(replace(first, weights=w)), dead_zones=ZONES) for w in drawn]


def ensemble_of(nets):
    weights = tuple(np.stack(of, axis=1) for of in zip(*(net.weights for net in nets), strict=True))
    return NetEnsemble(**(vars(nets[0]) | {"weights": weights}))


@pytest.mark.parametrize("shape", [(), (7,), (2, 3)])
def test_predict__is_the_mean_of_the_nets(shape):
    nets = valve_nets(3)
    history = np.random.default_rng(3).uniform(-1, 1, (*shape, 3, 3, 13)).astype(np.float32)
    each = np.array([net.predict(history) for net in nets])
    assert each.std(axis=0).min() > 1e-4  # they do not agree
    found = ensemble_of(nets).predict(history)
    assert found.shape == (*shape, 3) and found.dtype == np.float32
    np.testing.assert_allclose(found, each.mean(axis=0), atol=1e-6)
