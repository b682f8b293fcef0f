"""Fitting one actuator net per joint to a log.

Training minimises errors of one step first, then the errors that add up over several steps of the
nets on their own outputs: there a bias adds up and the noise of encoders does not. The nets of all
joints are trained at once, each on the recordings in which its joint moves.

A net that reads past velocities may learn to go on as they say, whatever the command: it then runs
away in a free run (NARX: Leontaritis and Billings, 1985). One that reads commands and the newest
angle has to find all in the commands (NFIR but for the angle: Nelles, Nonlinear System
Identification, 2001). `FitConfig.output_lags` chooses.
"""

import math
from dataclasses import asdict, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Generator, Tensor

from brokk_min.actuator import ActuatorNet, input_rows
from brokk_min.identification.fit_config import PAPER_RECIPE, FitConfig
from brokk_min.identification.logs import Log, join_recordings
from brokk_min.identification.muon import Muon
from brokk_min.identification.net_file import STATISTICS
from brokk_min.identification.progress import progress
from brokk_min.kinematics import estimate_velocity
from brokk_min.machine import Array

__all__ = ["PAPER_RECIPE", "FitConfig", "fit"]


def fit(
    log: Log, config: FitConfig, seed: int, velocity_samples: int, machine: str = ""
) -> ActuatorNet:
    """Fit one net per joint to a log. Paper: Sec. 3.3 (MSE; Adam, ours with Muon)

    `seed` repeats the nets to the bit on one computer; `velocity_samples` is the window of the
    estimator that made the velocities of `log`; `machine` is a name, for the file.
    ValueError: a joint that never moves long enough, or weights that are not finite at the end.
    """
    lags = config.history if config.output_lags is None else config.output_lags
    config = replace(config, dead_zone=config.dead_zone or 0.0, output_lags=lags)
    data = training_set(log, config)
    weights = train(data, config, seed, None if log.velocity_logged else velocity_samples)
    return ActuatorNet(
        joints=log.joints,
        history=config.history,
        rate=log.rate,
        velocity_samples=velocity_samples,
        velocity_logged=log.velocity_logged,
        machine=machine,
        seed=seed,
        settings=asdict(config),
        weights=tuple(weight.detach().numpy() for weight in weights),
        dead_zone=config.dead_zone or 0.0,
        **{name: getattr(data, name).numpy() for name in STATISTICS},
    )


class TrainingSet(NamedTuple):
    """Windows of H samples of each joint and their statistics, float32."""

    signals: Tensor  # (3 or 4, n, N): `actuator.input_rows`, recordings joined
    target: Tensor  # (N, n) rad/s, see `join_recordings`
    windows: list[NDArray[np.intp]]  # newest samples of each joint's windows
    multi_step_windows: list[NDArray[np.intp]]  # those with `rollout` samples after them
    input_mean: Tensor  # (n, I)
    input_scale: Tensor  # (n, I)
    reads: Tensor  # (I,): `inputs_read`
    output_low: Tensor  # (n,) rad/s
    output_high: Tensor  # (n,) rad/s
    q_low: Tensor  # (n,) rad
    q_high: Tensor  # (n,) rad
    rate: float  # of the samples [Hz]


def training_set(log: Log, config: FitConfig) -> TrainingSet:
    """Windows in which a joint moves, and their statistics; ValueError: one that never moves."""
    samples = join_recordings(log)
    q, q_dot, u = samples.joined.q, samples.joined.q_dot, samples.joined.u
    windows = samples.windows(config.history, 1)
    targets = [samples.target[window, j] for j, window in enumerate(windows)]
    _check_targets(log, targets, config.history)
    rows = input_rows(q, q_dot, u, config.dead_zone or 0.0, config.indicator)
    signals = np.stack(rows).swapaxes(1, 2)
    mean = np.array([signals[:, j, window].mean(axis=1) for j, window in enumerate(windows)])
    std = np.array([signals[:, j, window].std(axis=1) for j, window in enumerate(windows)])
    std = np.where(std > 1e-9, std, 1.0)  # a signal that never changes
    low = np.array([target.min() for target in targets])
    high = np.array([target.max() for target in targets])
    margin = 0.05 * (high - low) + 1e-6  # rad/s
    multi_step_windows = samples.windows(config.history, config.rollout)
    if config.shared:  # for all joints the windows in which any joint moves
        windows = [np.unique(np.concatenate(windows))] * len(windows)
        multi_step_windows = [np.unique(np.concatenate(multi_step_windows))] * len(windows)
    return TrainingSet(
        signals=torch.tensor(signals).float(),
        target=torch.tensor(samples.target).float(),
        windows=windows,
        multi_step_windows=multi_step_windows,
        input_mean=torch.tensor(np.repeat(mean, config.history, axis=1)).float(),
        input_scale=torch.tensor(np.repeat(std, config.history, axis=1)).float(),
        reads=inputs_read(config),
        output_low=torch.tensor(low - margin).float(),
        output_high=torch.tensor(high + margin).float(),
        q_low=torch.tensor(q.min(axis=0)).float(),
        q_high=torch.tensor(q.max(axis=0)).float(),
        rate=log.rate,
    )


def inputs_read(config: FitConfig) -> Tensor:
    """1 for inputs that the nets read, 0 for older angles and velocities: (I,)."""
    H = config.history
    lags = H if config.output_lags is None else config.output_lags
    newest = torch.arange(H, 0, -1)  # 1: the newest sample
    commands = torch.ones((1 + config.indicator) * H)
    return torch.cat([newest <= max(lags, 1), newest <= lags, commands]).float()


def _check_targets(log: Log, targets: list[Array], history: int) -> None:
    for name, target in zip(log.joints, targets, strict=True):
        if not len(target) or np.ptp(target) == 0:
            expected = f"expected a recording of {history + 1} samples or more in which it moves"
            raise ValueError(f"joint {name}: {expected}, got none")


def train(data: TrainingSet, config: FitConfig, seed: int, estimator: int | None) -> list[Tensor]:
    """Weights of all nets, as in `ActuatorNet.weights`; `estimator` as in `multi_step_loss`."""
    torch.set_float32_matmul_precision("highest")  # a training of policies may have lowered it
    torch.set_num_threads(1)  # several wait in vain on busy cores
    generator = Generator().manual_seed(seed)
    weights = initial_weights(len(data.windows), config, generator)
    rate, decay = config.learning_rate, config.weight_decay
    groups: list[dict[str, Any]] = [{"params": weights[:6] + weights[7:8]}]
    if config.shared:  # a latent sums over all inputs: with steps as of the others it saturates
        slower = rate / math.sqrt(data.input_mean.numel())  # see Yang et al., arXiv 2310.17813
        groups.append({"params": [weights[6], weights[8]], "lr": slower})
    optimizer: torch.optim.Optimizer = torch.optim.AdamW(groups, rate, weight_decay=decay)
    if config.muon:
        optimizer = Muon(groups, rate, decay, config.muon, stacks=True)
    multi_step = config.rollout > 1 and all(map(len, data.multi_step_windows))
    switch_step = round(0.65 * config.steps) if multi_step else config.steps
    schedule = torch.optim.lr_scheduler.LambdaLR(
        optimizer, lambda step: cosine_decay(step, switch_step, config.steps)
    )
    for step in progress(range(config.steps), desc="fit nets", unit="step"):
        if step < switch_step:
            settings = replace(config, rollout=1)
            windows, batch = data.windows, config.batch_size
        else:
            settings = config
            windows, batch = data.multi_step_windows, math.ceil(config.batch_size / 4)
        at = draw_windows(windows, batch, generator, together=config.shared > 0)
        loss = multi_step_loss(data, settings, weights, at, estimator, generator)
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        schedule.step()
    if not all(torch.isfinite(weight).all() for weight in weights):
        raise ValueError("weights: expected finite numbers at the end of the fit, got nan or inf")
    return weights


def initial_weights(n: int, config: FitConfig, generator: Generator) -> list[Tensor]:
    """Weights, by He's uniform initialisation for ReLU, and zero biases of `n` nets.

    Those of latents, if any, begin small: the nets begin nearly alone. Those of inputs that nets
    do not read are zero, and stay so.
    """

    def uniform(rows: int, columns: int, bound: float) -> Tensor:
        return (torch.rand(n, rows, columns, generator=generator) * 2 - 1) * bound

    reads = inputs_read(config)
    inputs, hidden, latents = int(reads.sum()), config.hidden, config.shared
    weights = []
    shapes = [(len(reads), hidden, inputs), (hidden, hidden, hidden), (hidden, 1, hidden)]
    for rows, columns, fan_in in shapes:
        weights += [uniform(rows, columns, math.sqrt(6 / fan_in)), torch.zeros(n, columns)]
    weights[0] *= reads[:, None]
    if latents:
        shared = uniform(2 * len(reads), latents, math.sqrt(1 / (2 * n * inputs)))
        weights.append(shared * reads.tile(2)[:, None])
        weights.append(uniform(latents, hidden, math.sqrt(6 / inputs)))
        weights.append(torch.zeros(n, latents))
    return [weight.requires_grad_() for weight in weights]


def cosine_decay(step: int, switch_step: int, steps: int) -> float:
    """Factor of the learning rate: from 1 to 0 by `switch_step`, then from 1/4 to 0."""
    if step < switch_step:
        return 0.5 * (1 + math.cos(math.pi * step / switch_step))
    fraction = (step - switch_step) / max(steps - switch_step, 1)
    return 0.125 * (1 + math.cos(math.pi * fraction))


def draw_windows(
    windows: list[NDArray[np.intp]], batch: int, generator: Generator, together: bool = False
) -> Tensor:
    """Newest samples (n, batch) of random windows of each joint, or of all joints `together`."""
    if together:
        pick = torch.randint(len(windows[0]), (batch,), generator=generator)
        return torch.tensor(windows[0][pick]).expand(len(windows), batch)
    picks = [torch.randint(len(window), (batch,), generator=generator) for window in windows]
    drawn = [window[pick] for window, pick in zip(windows, picks, strict=True)]
    return torch.tensor(np.stack(drawn))


def multi_step_loss(
    data: TrainingSet,
    config: FitConfig,
    weights: list[Tensor],
    at: Tensor,
    estimator: int | None,
    generator: Generator,
) -> Tensor:
    """Mean square of the accumulated error over `rollout` ticks of the nets on their own outputs.

    L = 1/K sum_k |sum_{i<=k} (velocity_i - target_i) / range|^2, for windows that end `at`
    (n, batch); summed over joints. A `rollout` of 1 is the paper's error of one step. `estimator`:
    samples of the velocity estimator; None: velocities are the outputs.
    """
    ticks, history = config.rollout, config.history
    q, q_dot, u = input_windows(data, config, at, ticks, generator)
    samples = estimator or 2
    slope = torch.tensor(estimate_velocity(np.eye(samples), samples, 1 / data.rate)).float()
    accumulated_error, loss = torch.zeros(()), torch.zeros(())
    for k in range(ticks):
        velocity = predict(data, weights, q, q_dot, u[..., k : k + history])
        accumulated_error = accumulated_error + normalised_error(data, velocity, at + k)
        loss = loss + (accumulated_error**2).mean(dim=1).sum() / ticks
        q_next = q[..., -1] + velocity / data.rate  # q' = q + dt q_dot
        q = torch.cat([q[..., 1:], q_next[..., None]], dim=-1)
        if estimator:
            velocity = (q[..., -samples:] * slope).sum(dim=-1)
        q_dot = torch.cat([q_dot[..., 1:], velocity[..., None]], dim=-1)
    return loss


def normalised_error(data: TrainingSet, velocity: Tensor, at: Tensor) -> Tensor:
    """(velocity - target) / (output range) of the samples `at` (n, batch)."""
    target = data.target[at, torch.arange(len(at))[:, None]]
    return (velocity - target) / (data.output_high - data.output_low)[:, None]


def input_windows(
    data: TrainingSet, config: FitConfig, at: Tensor, ticks: int, generator: Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Angles and noisy velocities (n, batch, H) of windows that end `at`, and their commands.

    Commands are (n, batch, 1 or 2, H + ticks - 1). Noise has a part per sample and one per window.
    """
    (n, batch), history = at.shape, config.history
    signals = data.signals.unfold(-1, history + ticks - 1, 1)
    q, q_dot, *commands = signals[:, torch.arange(n)[:, None], at - (history - 1)]
    q, q_dot, u = q[..., :history], q_dot[..., :history], torch.stack(commands, dim=2)
    if config.noise:
        noise = torch.randn(n, batch, history, generator=generator)
        noise = noise + torch.randn(n, batch, 1, generator=generator)
        std = data.input_scale.reshape(n, 1, -1, history)[:, :, 1]
        q_dot = q_dot + config.noise * std * noise
    return q, q_dot, u


def predict(
    data: TrainingSet, weights: list[Tensor], q: Tensor, q_dot: Tensor, u: Tensor
) -> Tensor:
    """Velocities [rad/s] (n, batch) for windows (n, batch, H); none passes a stop in one tick.

    `u` are the rows of the commands, (n, batch, 1 or 2, H).
    """
    w1, b1, w2, b2, w3, b3 = weights[:6]
    x = torch.cat([q, q_dot, u.flatten(2)], dim=-1)
    x = data.reads * (x - data.input_mean[:, None]) / data.input_scale[:, None]
    bias = b1[:, None]
    if len(weights) > 6:  # as `ActuatorNet.latents`
        both = torch.cat([x, x.abs()], dim=-1)
        z = (both @ weights[6] + weights[8][:, None]).sum(dim=0)
        bias = bias + torch.tanh(z) @ weights[7]
    x = torch.relu(torch.baddbmm(bias, x, w1))
    x = torch.relu(torch.baddbmm(b2[:, None], x, w2))
    y = torch.sigmoid(torch.baddbmm(b3[:, None], x, w3))[..., 0]
    low, high = data.output_low[:, None], data.output_high[:, None]
    lowest = (data.q_low[:, None] - q[..., -1]) * data.rate
    highest = (data.q_high[:, None] - q[..., -1]) * data.rate
    return torch.clamp(low + (high - low) * y, lowest, highest)
