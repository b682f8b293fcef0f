"""Fitting: nets learn from logs, and from nothing that a log does not hold."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers_machines import line

from brokk_min.actuator import initial_history, mu_law, open_indicator
from brokk_min.identification import fitting
from brokk_min.identification.fitting import FitConfig, fit, training_set
from brokk_min.identification.logs import Log, Recording, join_recordings, velocity_of
from brokk_min.identification.simulation import free_run_step
from brokk_min.identification.validation import score


def simple_system(seed, recordings, ticks=300, logged=False):
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
    result = []
    for i, (u, q, q_dot) in enumerate(np.array(rows).transpose(2, 1, 0, 3)):
        result.append(Recording(f"r{i}", u, q, q_dot if logged else velocity_of(q, 4)))
    return Log(("boom", "stick"), tuple(result), logged)


def same_weights(one, two):
    return all(np.array_equal(a, b) for a, b in zip(one.weights, two.weights, strict=True))


def test_fit__learns_a_simple_system():
    log = simple_system(0, 25, logged=True)
    net = fit(log, FitConfig(steps=500, batch_size=256), seed=0, velocity_samples=4)
    unseen = simple_system(1, 6, logged=True)
    result = score(net, unseen)
    for j, name in enumerate(net.joints):
        assert result[name]["one_step_rmse"] < 0.5 * result[name]["persistence_rmse"], result
        speed = np.sqrt(np.mean(np.concatenate([r.q_dot[:, j] for r in unseen.recordings]) ** 2))
        for horizon in ("1", "5", "10"):
            run = result[name]["free_run"][horizon]
            assert run["velocity_rmse"] < 0.2 * speed, (name, horizon)
            assert run["position_error_median"] < 0.1, (name, horizon)
        assert "30" not in result[name]["free_run"]  # the recordings have 15 s


def test_fit__repeats_itself_to_the_bit_in_full_precision():
    log, config = simple_system(0, 3), FitConfig(steps=40, batch_size=64)
    torch.set_float32_matmul_precision("medium")  # as a training of policies may leave it
    torch.manual_seed(1)
    one = fit(log, config, seed=5, velocity_samples=4)
    assert torch.get_float32_matmul_precision() == "highest"
    torch.manual_seed(2)
    assert same_weights(one, fit(log, config, seed=5, velocity_samples=4))
    assert not same_weights(one, fit(log, config, seed=6, velocity_samples=4))


def test_fit__has_smaller_weights_with_weight_decay():
    log, config = simple_system(0, 3), FitConfig(steps=40, batch_size=64)
    plain = fit(log, config, seed=5, velocity_samples=4)
    decayed = fit(log, replace(config, weight_decay=5.0), seed=5, velocity_samples=4)
    assert (decayed.weights[0] ** 2).mean() < 0.7 * (plain.weights[0] ** 2).mean()


def test_fit__states_how_the_nets_were_fitted():
    log, config = simple_system(0, 2, 40), FitConfig(steps=0, history=5, dead_zone=0.25)
    net = fit(log, config, 7, 3, "toy")
    assert (net.joints, net.history, net.rate) == (("boom", "stick"), 5, 20.0)
    assert (net.velocity_samples, net.velocity_logged, net.machine) == (3, False, "toy")
    settings = vars(config) | {"output_lags": 5}
    assert (net.seed, net.dead_zone, net.settings) == (7, 0.25, settings)
    u = np.concatenate([mu_law(r.u, 0.25)[4:-1] for r in log.recordings])
    mean = np.tile(u.mean(axis=0)[:, None], 5)
    np.testing.assert_allclose(net.input_mean[:, 10:15], mean, rtol=1e-6)
    np.testing.assert_allclose(net.input_scale[:, 14], u.std(axis=0), rtol=1e-6)
    opens = np.concatenate([open_indicator(r.u, 0.25)[4:-1] for r in log.recordings])
    np.testing.assert_allclose(net.input_mean[:, 15], opens.mean(axis=0), rtol=1e-6)
    assert net.input_mean.shape == (2, 20)
    plain = fit(log, FitConfig(steps=0), 7, 3)
    assert (plain.machine, plain.dead_zone, plain.settings["dead_zone"]) == ("", 0.0, 0.0)
    assert plain.input_mean.shape == (2, 39)  # as in the paper
    assert fit(log._replace(rate=50.0), FitConfig(steps=0), 7, 3).rate == 50.0


def test_fit__does_not_learn_to_brake_before_a_stop():
    """A joint that goes at 0.3 u until it hits a hard stop: the nets keep its speed up to there."""
    rng, recordings = np.random.default_rng(0), []
    for run in range(60):
        u = np.repeat(rng.uniform(-1, 1, 8), 20)[:, None]
        q = np.zeros((161, 1))
        for k in range(160):
            q[k + 1] = np.clip(q[k] + 0.3 * u[k] / 20, -0.2, 0.2)
        recordings.append(Recording(f"r{run}", u, q[:160], velocity_of(q, 4)[:160]))
    log = Log(("a",), tuple(recordings))
    net = fit(log, FitConfig(steps=500, batch_size=256), seed=0, velocity_samples=4)
    history, q, angles = initial_history(np.float32([-0.2]), 13), np.array([-0.2]), []
    for _ in range(60):
        history, q = free_run_step(net, history, q, np.array([0.9]))
        angles.append(q[0])
    moving = np.diff(angles)[:26] * 20
    np.testing.assert_allclose(moving, 0.27, atol=0.035)  # within 0.013 rad of the stop
    np.testing.assert_allclose(angles[31:], 0.2, atol=1e-6)  # and there it stays


def test_fit__uses_one_step_errors_where_recordings_are_too_short_for_more():
    log = Log(("a",), tuple(line(f"r{i}", 0.0, 0.1 * i, 15) for i in range(4)))
    config = FitConfig(steps=5, batch_size=8, rollout=8)
    one_step = fit(log, replace(config, rollout=1), seed=0, velocity_samples=4)
    assert same_weights(one_step, fit(log, config, seed=0, velocity_samples=4))


@pytest.mark.parametrize(("lags", "shared"), [(0, 0), (3, 0), (1, 2), (13, 0)])
def test_fit__has_nets_that_read_the_newest_outputs_and_all_commands(lags, shared):
    """No other sample changes what they predict, before the fit and after; each of these does."""
    for steps in (0, 10):
        config = FitConfig(steps, batch_size=16, shared=shared, output_lags=lags)
        net = fit(simple_system(0, 3, 60), config, seed=0, velocity_samples=4)
        history = np.random.default_rng(0).uniform(-1, 1, (200, 2, 3, 13)).astype(np.float32)
        before = net.forward(history)[0]
        for row, newest in enumerate((max(lags, 1), lags, 13)):
            for sample in range(13):
                other = history.copy()
                other[..., row, sample] += 0.5
                changed = (net.forward(other)[0] != before).any()
                assert changed == (sample >= 13 - newest), (row, sample)


@pytest.mark.filterwarnings("ignore")
def test_fit__refuses_what_cannot_be_learned():
    short = Log(("a",), tuple(line(f"r{i}", 0.0, 0.1 * i, 13) for i in range(20)))
    with pytest.raises(ValueError, match=r"joint a: expected a recording of 14 samples.*got none"):
        fit(short, FitConfig(steps=1), seed=0, velocity_samples=4)
    moving = simple_system(0, 1, 40).recordings[0]
    columns = [array[:, :1] for array in (moving.u, moving.q, moving.q_dot)]
    still = Recording("x", *(np.hstack([column, np.zeros((40, 1))]) for column in columns))
    with pytest.raises(ValueError, match="joint stick"):
        fit(Log(("boom", "stick"), (still,)), FitConfig(steps=1), 0, 4)
    with pytest.raises(ValueError, match="weights: expected finite numbers"):
        big = still._replace(q=1e39 * moving.q, u=moving.u)  # infinite as float32
        fit(Log(("boom", "stick"), (big,)), FitConfig(steps=4, rollout=1), 0, 4)


def test_training_set__has_windows_that_end_before_the_seams():
    """Between these recordings lies a jump of 5 rad: a window across it would have 100 rad/s."""
    log = Log(("a",), (line("x", 0, 0.1, 30), line("y", 5, 0.2, 40)))
    data = training_set(log, FitConfig(rollout=8))
    np.testing.assert_array_equal(data.windows[0], [*range(12, 29), *range(42, 69)])
    np.testing.assert_array_equal(data.multi_step_windows[0], [*range(12, 22), *range(42, 62)])
    # targets 0.1 and 0.2 rad/s, and a margin of a twentieth
    assert data.output_low[0] == pytest.approx(0.095, abs=1e-5)
    assert data.output_high[0] == pytest.approx(0.205, abs=1e-5)
    assert (data.q_low[0], data.q_high[0]) == (0.0, pytest.approx(5.39, abs=1e-5))


@pytest.mark.parametrize("logged", [False, True])
def test_multi_step_loss__is_the_accumulated_error_of_a_free_run(logged):
    """Three ticks on the nets' own outputs, stops included; the first is the one-step loss."""
    log, config = simple_system(0, 4, logged=logged), FitConfig(batch_size=4, noise=0, rollout=3)
    net = fit(log, replace(config, steps=1), seed=0, velocity_samples=4)
    net.weights[5][:] = 9.0  # fast upwards
    data, joined = training_set(log, config), join_recordings(log).joined
    span = (data.output_high - data.output_low).numpy()
    tops = joined.q.argmax(axis=0)
    at = np.array([[20, 350, tops[0]], [40, 700, tops[1]]])
    errors, at_stop = np.zeros((2, 3, 3)), 0  # joint, window, tick
    for j, w in np.ndindex(2, 3):
        end = at[j, w]
        rows = np.arange(end - 12, end + 1)
        history = np.stack([joined.q[rows], joined.q_dot[rows], joined.u[rows - 1]])
        history, q = history.transpose(2, 0, 1).astype(np.float32), joined.q[end]
        for k in range(3):
            before = q
            history, q = free_run_step(net, history, q, joined.u[end + k])
            at_stop += abs(q[j] - before[j]) < 1e-6
            velocity = (q - before)[j] * 20
            errors[j, w, k] = (velocity - float(data.target[end + k, j])) / span[j]
    assert at_stop >= 2
    weights, places = [torch.tensor(weight) for weight in net.weights], torch.tensor(at)
    estimator, rng = None if logged else 4, torch.Generator()
    loss = fitting.multi_step_loss(data, config, weights, places, estimator, rng)
    expected = (errors.cumsum(axis=2) ** 2).mean(axis=(1, 2)).sum()
    assert float(loss) == pytest.approx(expected, rel=1e-3)
    config = replace(config, rollout=1)
    loss = fitting.multi_step_loss(data, config, weights, places, estimator, rng)
    assert float(loss) == pytest.approx((errors[..., 0] ** 2).mean(axis=1).sum(), rel=1e-3)


def test_input_windows__have_noise_per_sample_and_per_window_in_units_of_the_velocities():
    data, at = training_set(simple_system(0, 2, 60), FitConfig()), torch.tensor([[20], [30]])
    at = at.expand(2, 20_000)
    rng = torch.Generator().manual_seed(0)
    q, exact, u = fitting.input_windows(data, FitConfig(noise=0.0), at, 8, rng)
    _, noisy, _ = fitting.input_windows(data, FitConfig(noise=0.1), at, 8, rng)
    np.testing.assert_array_equal(q[0, 0], data.signals[0, 0, 8:21])
    np.testing.assert_array_equal(exact[1, 0], data.signals[1, 1, 18:31])
    np.testing.assert_array_equal(u[0, 0, 0], data.signals[2, 0, 8:28])
    noise = ((noisy - exact) / data.input_scale[:, None, 13:14]).numpy()
    assert noise.std() == pytest.approx(0.1 * 2**0.5, rel=0.02)
    assert noise.mean(axis=-1).std() == pytest.approx(0.1 * (1 + 1 / 13) ** 0.5, rel=0.02)


def one_pump(seed, recordings, joints=2, ticks=300):
    """Each joint is slowed by the mean command of the others."""
    rng = np.random.default_rng(seed)
    result = []
    for i in range(recordings):
        u = np.repeat(rng.uniform(-1, 1, (ticks // 4, joints)), 4, axis=0)
        others = np.abs(u).sum(axis=1, keepdims=True) - np.abs(u)
        speed = 0.4 * u * (1 - 0.8 * others / (joints - 1))
        q = np.cumsum(np.concatenate([np.zeros((1, joints)), speed[:-1]]), axis=0) / 20
        result.append(Recording(f"r{i}", u, q, velocity_of(q, 4)))
    return Log(("boom", "stick", "bucket", "swing", "tilt")[:joints], tuple(result))


def test_fit__with_latents_learns_what_joints_share():
    log, unseen = one_pump(0, 20), one_pump(1, 5)
    error = {}
    for latents, steps in ((0, 200), (4, 1000)):  # more steps do not help nets that are alone
        config = FitConfig(steps, batch_size=128, rollout=1, noise=0.0, shared=latents)
        net = fit(log, config, seed=0, velocity_samples=4)
        assert len(net.weights) == (9 if latents else 6)
        scores = score(net, unseen)
        error[latents] = np.mean([scores[j]["free_run"]["1"]["velocity_rmse"] for j in log.joints])
    assert error[4] < 0.2 * error[0]


def test_fit__keeps_the_latents_of_many_joints_from_saturating():
    """With steps as for other weights most are +1 or -1 after a hundred, whatever the inputs."""
    log = one_pump(0, 20, joints=5, ticks=120)
    config = FitConfig(100, batch_size=128, rollout=1, noise=0.0, shared=4, dead_zone=0.07)
    net = fit(log, config, seed=0, velocity_samples=4)
    joined = join_recordings(log).joined
    signals = (joined.q, joined.q_dot, joined.u)
    rows = [np.lib.stride_tricks.sliding_window_view(x, net.history, axis=0) for x in signals]
    z = net.latents(net.inputs(np.stack(rows, axis=-2).astype(np.float32)))
    assert (np.abs(z) < 0.99).mean() > 0.9
