"""Free runs: their loss, which windows have one, and nets that read the newest outputs alone."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers_machines import line, simple_system

from brokk_min.beyond.free_runs import accumulated_loss
from brokk_min.fit import Log, TrainingSet, as_they_are, join_recordings, mean_squared_error
from brokk_min.identification.fitting import OurFitConfig, fit_nets, valve_reader
from brokk_min.identification.validation import free_run
from brokk_min.machine import BROKK_170


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


@pytest.mark.parametrize("valve", [False, True])
def test_accumulated_loss__is_the_error_of_a_free_run(valve):
    """Three ticks on the nets' own outputs, stops included; the first is the one-step loss."""
    log = simple_system(0, 4)._replace(joints=("q1", "q3"))
    config = OurFitConfig(steps=1, batch_size=4, rollout=3, valve=valve, members=1)
    net = fit_nets(log, config, 0, BROKK_170, "brokk170")
    net.weights[5][:] = 1.0  # upwards, by what the nets read
    inputs = valve_reader(np.full((2, 2), 0.07, np.float32)) if valve else as_they_are
    data, samples = TrainingSet(log, BROKK_170, inputs), join_recordings(log)
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
