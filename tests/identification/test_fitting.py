"""Nets learn from logs, and from nothing that a log does not hold."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers_machines import line

from brokk_min.actuator import initial_history, mu_law
from brokk_min.identification import fitting, validation
from brokk_min.identification.fitting import FitConfig, fit
from brokk_min.identification.logs import Log, Recording, velocity_of
from brokk_min.identification.validation import score


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """Small nets are fitted fastest so, and beside other work much faster."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


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
    net = fit(
        simple_system(0, 25, logged=logged), config, seed=0, velocity_samples=4, machine="toy"
    )
    assert net.joints == ("boom", "stick") and net.machine == "toy" and net.rate == 20.0
    assert net.velocity_logged == logged and net.settings["steps"] == 500
    assert net.settings["dead_zone"] == net.dead_zone == 0.0  # none given: 0, and the file says so
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


def test_a_fit_is_in_float32_whatever_a_training_before_it_allowed():
    torch.set_float32_matmul_precision("medium")
    fit(simple_system(0, 3), FitConfig(steps=1), seed=0, velocity_samples=4)
    assert torch.get_float32_matmul_precision() == "highest"


def test_the_first_weights_are_hes_uniform_ones():
    net = fit(simple_system(0, 3), FitConfig(steps=0), seed=0, velocity_samples=4)
    for inputs, weights, offsets in zip(
        (39, 32, 32), net.weights[::2], net.weights[1::2], strict=True
    ):
        bound = np.sqrt(6 / inputs)
        assert weights.shape[1] == inputs and not offsets.any()
        assert 0.9 * bound < weights.max() <= bound and -0.9 * bound > weights.min() >= -bound
        assert weights.std() == pytest.approx(bound / np.sqrt(3), rel=0.15)


def test_a_joint_moves_in_a_recording_in_which_its_angle_or_its_command_changes():
    still, ramp = np.zeros(6), np.arange(6) / 10
    u, q = np.stack([still, still, ramp], 1), np.stack([ramp, still, still], 1)
    log = Log(
        ("a", "b", "c"), (Recording("angle too", u, q, q), Recording("command alone", u, 0 * q, q))
    )
    found = [[True, False, True]] * 6 + [[False, False, True]] * 6
    assert fitting.end_to_end(log).moves.tolist() == found


@pytest.mark.parametrize("logged", [False, True])
def test_the_loss_of_a_free_run_is_what_the_nets_do_when_run(logged):
    """Three ticks on the nets' own outputs, stops included: squared errors so far, in units of the range."""
    log, config = (
        simple_system(0, 4, logged=logged),
        FitConfig(steps=1, batch_size=4, noise=0, rollout=3),
    )
    net = fit(log, config, seed=0, velocity_samples=4)
    net.weights[5][:] = 9.0  # fast upwards
    training = fitting.training_set(log, 13, 3)
    span = training.output_high - training.output_low
    whole, wanted, met = fitting.end_to_end(log).whole, 0.0, 0
    at = np.array([[20, 350, int(whole.q[:, 0].argmax())], [40, 700, int(whole.q[:, 1].argmax())]])
    weights = [torch.tensor(w) for w in net.weights]
    tensors, estimator = fitting._as_tensors(training), None if logged else 4
    places, rng = torch.tensor(at), torch.Generator()
    got = fitting._rollout_loss(tensors, config, weights, places, 3, estimator, rng)
    for j in range(2):
        for end in at[j]:
            rows = np.arange(end - 12, end + 1)
            u = whole.u[rows - 1]
            history = (
                np.stack([whole.q[rows], whole.q_dot[rows], u])
                .transpose(2, 0, 1)
                .astype(np.float32)
            )
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
    history, q, angles = initial_history(np.float32([-0.2]), 13), np.array([-0.2]), []
    for _ in range(60):
        history, q = net.step(history, q, [0.9])
        angles.append(q[0])
    moving = np.diff(angles)[:26] * 20
    np.testing.assert_allclose(moving, 0.27, atol=0.035)  # within 0.013 rad of the stop
    np.testing.assert_allclose(angles[31:], 0.2, atol=1e-6)  # and there it stays


def test_windows_of_free_runs_end_before_the_seams():
    training = fitting.training_set(
        Log(("a",), (line("x", 0, 0.1, 30), line("y", 5, 0.2, 40))), 13, 8
    )
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
    fitting.training_set(log, 80, 8)
    held = tracemalloc.get_traced_memory()[1]
    tracemalloc.reset_peak()
    validation.fit_linear(net, log)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert held < 15e6  # 250 bytes a sample
    assert peak < 15e6 + 6 * 8192 * 241 * 8  # and some chunks


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


def test_nets_say_how_they_were_fitted():
    log, config = simple_system(0, 2, 40), FitConfig(steps=0, history=5, dead_zone=0.25)
    net = fit(log, config, 7, 3, "toy")
    assert (net.joints, net.history, net.rate, net.velocity_samples) == (
        ("boom", "stick"),
        5,
        20.0,
        3,
    )
    assert (net.machine, net.seed, net.dead_zone, net.settings) == ("toy", 7, 0.25, vars(config))
    assert not net.velocity_logged and fit(log, FitConfig(steps=0), 7, 3).machine == ""
    assert fit(log, FitConfig(steps=0), 7, 3).dead_zone == 0.0
    commands = np.concatenate([mu_law(r.u, 0.25)[4:-1] for r in log.recordings])
    np.testing.assert_allclose(
        net.input_mean[:, 10:], np.tile(commands.mean(axis=0)[:, None], 5), rtol=1e-6
    )
    np.testing.assert_allclose(net.input_scale[:, 14], commands.std(axis=0), rtol=1e-6)


@pytest.mark.parametrize(("rollout", "logged"), [(8, False), (1, True)])
def test_rates_and_batches_of_a_fit_by_hand(rollout, logged, monkeypatch):
    """Of 20 steps 13 to errors of one tick, along half a cosine, 7 to free runs, from a quarter of it."""
    rates, asked, inner = [], [], torch.optim.Adam.step

    def step(self, *rest):
        rates.append(self.param_groups[0]["lr"])
        return inner(self, *rest)

    def loss(training, config, weights, at, ticks, estimator, generator):
        ends = training.far_ends if ticks > 1 else training.ends
        for j, chosen in enumerate(at.numpy()):
            assert set(chosen.tolist()) <= set(ends[j].tolist())
        assert [tuple(a.shape) for a in training[:2]] == [(3, 2, 240), (240, 2)]
        assert {a.dtype for a in training if isinstance(a, torch.Tensor)} == {torch.float32}
        assert [tuple(w.shape) for w in weights] == [
            (2, 39, 6),
            (2, 6),
            (2, 6, 6),
            (2, 6),
            (2, 6, 1),
            (2, 1),
        ]
        asked.append((ticks, at.shape[1], estimator))
        return sum((weight**2).sum() for weight in weights)

    monkeypatch.setattr(torch.optim.Adam, "step", step)
    monkeypatch.setattr(fitting, "_rollout_loss", loss)
    config = FitConfig(steps=20, batch_size=30, learning_rate=0.01, rollout=rollout, hidden=6)
    fit(simple_system(0, 4, 60, logged), config, 0, 4)
    turn, estimator = (13, 4) if rollout > 1 else (20, None)
    wanted = [0.005 * (1 + np.cos(np.pi * k / turn)) for k in range(turn)]
    wanted += [0.00125 * (1 + np.cos(np.pi * k / 7)) for k in range(20 - turn)]
    np.testing.assert_allclose(rates, wanted)
    assert asked == [(1, 30, estimator)] * turn + [(8, 8, estimator)] * (20 - turn)


def test_noise_is_on_velocities_of_each_sample_and_of_each_window_in_their_own_units(monkeypatch):
    """Every draw 1: as if all velocities were 2 * 0.1 of their deviations higher."""
    training, generator = fitting.training_set(simple_system(0, 2, 60), 13), torch.Generator()
    net = fit(simple_system(0, 2, 60), FitConfig(steps=0), 0, 4)
    weights, at = [torch.tensor(w) for w in net.weights], torch.tensor([[20, 30, 90], [20, 30, 80]])
    shapes = []

    def ones(*shape, generator):
        shapes.append(shape)
        return torch.ones(shape)

    def loss(shift, noise):
        series = training.series.copy()
        series[1] += shift * training.input_scale[:, 13:14]
        tensors, config = (
            fitting._as_tensors(training._replace(series=series)),
            FitConfig(noise=noise),
        )
        return float(fitting._rollout_loss(tensors, config, weights, at, 1, 4, generator))

    monkeypatch.setattr(torch, "randn", ones)
    assert (
        loss(0.0, 0.1)
        == pytest.approx(loss(0.2, 0.0), rel=1e-5)
        != pytest.approx(loss(0.0, 0.0), rel=1e-3)
    )
    assert shapes == [(2, 3, 13), (2, 3, 1)]
