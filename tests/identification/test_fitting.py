"""Our fit: what is kept with the nets, and ensembles."""

from dataclasses import replace

import numpy as np
from helpers_machines import simple_system

from brokk_min.actuator import ActuatorNet
from brokk_min.beyond.valve_nets import ValveNet, mu_law, open_indicator
from brokk_min.fit import FitConfig, fit
from brokk_min.identification.fitting import PAPER_RECIPE, OurFitConfig, fit_nets
from brokk_min.machine import BROKK_170


def test_fit__states_how_the_nets_were_fitted():
    log = simple_system(0, 2, 40)._replace(joints=("q4", "q1"))
    zones = [replace(joint, dead_zone=(0.25, 0.1)) for joint in BROKK_170.joints]
    machine = replace(BROKK_170, name="toy", joints=tuple(zones), history=5, velocity_samples=3)
    net = fit_nets(log, OurFitConfig(steps=0), 7, machine, "toy")
    assert (net.joints, net.history, net.rate) == (("q4", "q1"), 5, 20.0)
    assert (net.velocity_samples, net.machine) == (3, "toy")
    assert net.training["seed"] == 7 and net.training["settings"]["steps"] == 0
    np.testing.assert_allclose(net.dead_zones, [[0.25, 0.1]] * 2)
    u = np.concatenate([r.u[4:-1] for r in log.recordings])
    x = np.where(u > 0.25, (u - 0.25) / 0.75, np.where(u < -0.1, (u + 0.1) / 0.9, 0.0))
    mean = np.tile(mu_law(x).mean(axis=0)[:, None], 5)
    np.testing.assert_allclose(net.input_mean[:, 10:15], mean, rtol=1e-5)
    np.testing.assert_allclose(net.input_scale[:, 14], mu_law(x).std(axis=0), rtol=1e-5)
    opens = open_indicator(x).mean(axis=0)
    np.testing.assert_allclose(net.input_mean[:, 15], opens, rtol=1e-5)


def test_fit__gives_each_member_of_an_ensemble_a_seed_of_its_own():
    """Three nets by seed 2 are those of seeds 6, 7 and 8 alone."""
    log = simple_system(0, 2, 60)._replace(joints=("q4", "q1"))
    config = OurFitConfig(steps=3, batch_size=64, members=3)
    ensemble = fit_nets(log, config, 2, BROKK_170, "brokk170")
    for k, seed in enumerate((6, 7, 8)):
        alone = fit_nets(log, replace(config, members=1), seed, BROKK_170, "brokk170")
        assert type(alone) is ValveNet
        for one, every in zip(alone.weights, ensemble.weights, strict=True):
            np.testing.assert_array_equal(one, every[:, k])
    paper = fit(log, FitConfig(3, 64), 2, BROKK_170, "brokk170")
    same = fit_nets(log, OurFitConfig(3, 64, **PAPER_RECIPE), 2, BROKK_170, "brokk170")
    assert type(same) is ActuatorNet and all(map(np.array_equal, same.weights, paper.weights))
    printed = fit_nets(log, replace(config, valve=False), 0, BROKK_170, "brokk170")
    assert type(printed) is ActuatorNet and printed.training["settings"]["members"] == 1
