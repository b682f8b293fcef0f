"""Fitting: nets learn from logs, and from nothing that a log does not hold."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers_machines import line

from brokk_min.actuator import ActuatorNet
from brokk_min.beyond.free_runs import accumulated_loss
from brokk_min.beyond.valve_nets import ValveNet, mu_law, open_indicator
from brokk_min.fit import (
    FitConfig,
    Log,
    Recording,
    TrainingSet,
    fit,
    join_recordings,
    mean_squared_error,
    velocity_of,
)
from brokk_min.identification.fitting import PAPER_RECIPE, OurFitConfig, ValveTrainingSet, fit_nets
from brokk_min.identification.validation import free_run, score
from brokk_min.machine import BROKK_170


def simple_system(seed, recordings, ticks=300):
    """Two first-order joints, q_ddot = (gain u - q_dot) / tau, turned back at +-0.8 rad."""
    rng = np.random.default_rng(seed)
    gain, tau, shape = np.array([0.5, 1.0]), np.array([0.15, 0.3]), (recordings, 2)
    q, q_dot = rng.uniform(-0.5, 0.5, shape), np.zeros(shape)
    u_log, q_log = np.zeros((2, ticks, *shape))
    for tick in range(ticks):
        if tick % 8 == 0:
            u = np.where(np.abs(q) > 0.8, -np.sign(q) * 0.6, rng.uniform(-1, 1, shape))
        u_log[tick], q_log[tick] = u, q
        for _ in range(10):
            q, q_dot = q + 0.005 * q_dot, q_dot + 0.005 * (gain * u - q_dot) / tau
    parts = zip(u_log.swapaxes(0, 1), q_log.swapaxes(0, 1), strict=True)
    result = [Recording(f"r{i}", u, q, velocity_of(q, 4)) for i, (u, q) in enumerate(parts)]
    return Log(("boom", "stick"), tuple(result))


@pytest.mark.parametrize(("fitted", "kind"), [(fit, FitConfig), (fit_nets, OurFitConfig)])
def test_fit__learns_a_simple_system(fitted, kind):
    """By the paper's recipe, and by ours."""
    log = simple_system(0, 25)
    net = fitted(log, kind(steps=500, batch_size=256), 0, BROKK_170)
    assert not isinstance(net, ValveNet)  # no machine, no dead zones
    result = score(net, simple_system(1, 6))
    for name in net.joints:
        assert result[name]["one_step_rmse"] < 0.35 * result[name]["persistence_rmse"], result
        for horizon in ("1", "5", "10"):
            run = result[name]["free_run"][horizon]
            assert run["relative_error"] < 0.25, (name, horizon)
            assert run["position_error_median"] < 0.1, (name, horizon)


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
    paper = fit_nets(log, OurFitConfig(steps=0, **PAPER_RECIPE), 7, BROKK_170, "brokk170")
    np.testing.assert_allclose(paper.input_mean[:, 30], u[8:].mean(axis=0), atol=0.1)


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


def test_fit__uses_one_step_errors_where_recordings_are_too_short_for_more():
    log = Log(("a",), tuple(line(f"r{i}", 0.0, 0.1 * i, 15) for i in range(4)))
    config = OurFitConfig(steps=5, batch_size=8, rollout=8)
    one_step = fit_nets(log, replace(config, rollout=1), 0, BROKK_170)
    same = fit_nets(log, config, 0, BROKK_170)
    assert all(map(np.array_equal, one_step.weights, same.weights))


def test_fit__has_nets_that_read_the_newest_outputs_and_all_commands():
    """No older angle or velocity changes what they predict after the fit."""
    config = OurFitConfig(10, batch_size=16, newest_only=True, valve=False)
    net = fit_nets(simple_system(0, 3, 60), config, 0, BROKK_170)
    history = np.random.default_rng(0).uniform(-1, 1, (200, 2, 3, 13)).astype(np.float32)
    before = net.predict(history)
    for row, sample in np.ndindex(3, 13):
        other = history.copy()
        other[..., row, sample] += 0.5
        changed = (net.predict(other) != before).any()
        assert changed == (row == 2 or sample == 12), (row, sample)


def test_fit__refuses_what_cannot_be_learned():
    short = Log(("a",), tuple(line(f"r{i}", 0.0, 0.1 * i, 13) for i in range(20)))
    with pytest.raises(ValueError, match=r"joint a: expected a recording of 14 samples.*got none"):
        fit_nets(short, OurFitConfig(steps=1), 0, BROKK_170)
    _, *moving = simple_system(0, 1, 40).recordings[0]
    still = Recording("x", *(values * [1, 0] for values in moving))
    with pytest.raises(ValueError, match="joint stick"):
        fit_nets(Log(("boom", "stick"), (still,)), OurFitConfig(steps=1), 0, BROKK_170)


def test_fit__has_windows_and_ranges_without_the_jump_between_recordings():
    log = Log(("a",), (line("x", 0, 0.1, 30), line("y", 5, 0.2, 40)))
    data = TrainingSet(log, BROKK_170)
    np.testing.assert_array_equal(data.windows[0], [*range(12, 29), *range(42, 69)])
    np.testing.assert_array_equal(data.joined.windows(13, 8)[0], [*range(12, 22), *range(42, 62)])
    ranges = (data.output_low, data.output_high, data.q_low, data.q_high)
    np.testing.assert_allclose(np.stack(ranges), [[0.095], [0.205], [0.0], [5.39]], atol=1e-5)


@pytest.mark.parametrize("valve", [False, True])
def test_accumulated_loss__is_the_error_of_a_free_run(valve):
    """Three ticks on the nets' own outputs, stops included; the first is the one-step loss."""
    log = simple_system(0, 4)._replace(joints=("q1", "q3"))
    config = OurFitConfig(steps=1, batch_size=4, rollout=3, valve=valve, members=1)
    net = fit_nets(log, config, 0, BROKK_170, "brokk170")
    net.weights[5][:] = 1.0  # upwards, by what the nets read
    zones = np.full((2, 2), 0.07, np.float32)
    data = ValveTrainingSet(log, BROKK_170, zones) if valve else TrainingSet(log, BROKK_170)
    samples = join_recordings(log)
    span = (data.output_high - data.output_low).numpy()
    tops = samples.q.argmax(axis=0)
    at = np.array([[20, 40], [350, 700], tops])  # of each window and joint
    expected, at_stop = np.zeros(3), 0  # of each tick: the square of the error that added up
    for j, starts in enumerate(at.T):
        q_error = free_run(net, samples, starts, 3)[0][..., j]
        q = samples.q[starts + np.arange(1, 4)[:, None], j] + q_error
        at_stop += np.sum(np.abs(q - samples.q[:, j].max()) < 1e-6)
        expected += np.mean((q_error * 20 / span[j]) ** 2, axis=1)
    assert at_stop >= 2
    weights = [torch.tensor(weight) for weight in net.weights]
    for ticks in (1, 3):
        loss = accumulated_loss(data, weights, torch.tensor(at), ticks)
        assert float(loss) == pytest.approx(expected[:ticks].mean(), rel=1e-3)
    one_step = mean_squared_error(data, weights, torch.tensor(at))
    assert float(one_step) == pytest.approx(expected[0], rel=1e-3)


def test_fit__has_a_learning_rate_that_falls_to_zero_in_each_stage(monkeypatch):
    rates, step = [], torch.optim.AdamW.step

    def noted(optimizer):
        rates.append(optimizer.param_groups[0]["lr"])
        step(optimizer)

    monkeypatch.setattr(torch.optim.AdamW, "step", noted)
    fit_nets(simple_system(0, 2, 60), OurFitConfig(12, 8, learning_rate=1.0), 0, BROKK_170)
    assert [rates[step] for step in (0, 4, 8, 10)] == pytest.approx([1.0, 0.5, 0.25, 0.125])
