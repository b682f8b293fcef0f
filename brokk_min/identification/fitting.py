"""Fitting actuator nets to a log, one for each joint or several.

The fit minimises the error of one step first, and then the errors that add up over several steps of
the nets on their own outputs, because there a bias adds up and the noise of encoders does not. The
nets of all joints are trained at once, each on the recordings in which its joint moves.

A net that reads past velocities (NARX: Leontaritis and Billings, 1985) may learn to go on as they
say, whatever the command. `FitConfig.newest_only` leaves it the commands and the newest sample.
"""

import math
from dataclasses import asdict, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Generator, Tensor
from tqdm import tqdm

from brokk_min.actuator import ActuatorNet, estimate_velocity
from brokk_min.beyond.net_ensemble import NetEnsemble
from brokk_min.beyond.valve_nets import ValveNet, valve_inputs
from brokk_min.identification.fit_config import PAPER_RECIPE, FitConfig
from brokk_min.identification.logs import Log, join_recordings
from brokk_min.identification.readings import Rows
from brokk_min.machine import Array, Machine, require

__all__ = ["PAPER_RECIPE", "FitConfig", "fit"]

tensor = partial(torch.tensor, dtype=torch.float32)
ARRAYS = ("input_mean", "input_scale", "output_low", "output_high", "q_low", "q_high")  # of nets


def fit(log: Log, config: FitConfig, seed: int, machine: Machine, name: str = "") -> ActuatorNet:
    """Fit the nets of each joint to a log. Paper: Sec. 3.3 (MSE, Adam)

    The same `seed` gives the same bits on one computer. `name` is that of `machine`; it is empty
    for a log with other joints, each of which gets one net that reads the commands as they are.
    ValueError: a joint that never moves long enough, or weights that are not finite at the end.
    """
    if not (name and config.valve):
        config = replace(config, valve=False, members=1)
    index = [machine.names.index(joint) for joint in log.joints] if name else []
    zones = machine.dead_zones[index].astype(np.float32)
    data = TrainingSet(log, config, machine, zones)
    seeds = range(seed * config.members, (seed + 1) * config.members)
    members = [train(data, config, one) for one in seeds]
    fields: dict[str, Any] = {
        "joints": log.joints,
        "history": machine.history,
        "rate": log.rate,
        "velocity_samples": machine.velocity_samples,
        "machine": name,
        "training": {"seed": seed, "settings": asdict(config)},
        "weights": members[0],
        **{key: getattr(data, key).numpy() for key in ARRAYS},
    }
    if not config.valve:
        return ActuatorNet(**fields)
    if config.members == 1:
        return ValveNet(**fields, dead_zones=zones)
    fields["weights"] = tuple(np.stack(of, axis=1) for of in zip(*members, strict=True))
    return NetEnsemble(**fields, dead_zones=zones)


class TrainingSet:
    """Samples of n joints, recordings joined, windows of them and their statistics, float32."""

    def __init__(self, log: Log, config: FitConfig, machine: Machine, zones: Array) -> None:
        """ValueError: a joint that never moves."""
        joined, H, window = join_recordings(log), machine.history, machine.velocity_samples
        self.history, self.rate = H, log.rate
        self.windows = joined.windows(H, 1)  # newest samples of each joint's windows
        self.long_windows = joined.windows(H, config.rollout)  # with `rollout` samples after them
        targets = [target[at] for target, at in zip(joined.target.T, self.windows, strict=True)]
        for name, target in zip(log.joints, targets, strict=True):
            wanted = f"a recording of {H + 1} samples or more in which it moves"
            require(len(np.unique(target)) > 1, f"joint {name}", wanted, "none")
        signals = np.stack([joined.q, joined.q_dot, joined.u], dtype=np.float32)
        self.samples = tensor(signals.transpose(2, 0, 1))  # angle, velocity, command, (n, 3, N)
        self.target = tensor(joined.target.T)  # what the nets should say there [rad/s], (n, N)
        self.q_low, self.q_high = tensor(joined.q.min(axis=0)), tensor(joined.q.max(axis=0))  # (n,)
        low, high = (np.array([f(target) for target in targets]) for f in (np.min, np.max))
        margin = 0.05 * (high - low) + 1e-6  # rad/s
        self.output_low, self.output_high = tensor(low - margin), tensor(high + margin)  # (n,)
        self.zones = tensor(zones) if config.valve else None  # (n, 2); none: commands as they are
        moments = input_moments(signals, self.windows, zones if config.valve else None)
        mean, std = (np.repeat(part, H, axis=1) for part in moments)
        self.input_mean, self.input_scale = tensor(mean), tensor(np.where(std > 1e-9, std, 1.0))
        self.reads = torch.ones(mean.shape[1])  # 1 for inputs that the nets read, (I,)
        if config.newest_only:
            self.reads.view(-1, H)[:2, :-1] = 0
        weights = estimate_velocity(np.eye(window), window, 1 / log.rate)
        self.estimator = tensor(weights)  # of the newest angles


def input_moments(signals: Array, windows: list[Rows], zones: Array | None) -> list[Array]:
    """Mean and deviation of what nets read of samples (3, N, n) in the windows, (n, rows)."""
    rows = signals[..., None].transpose(1, 2, 0, 3)  # each sample as a history of one: (N, n, 3, 1)
    read = rows[..., 0] if zones is None else valve_inputs(rows, zones)  # (N, n, rows)
    parts = [read[at, j] for j, at in enumerate(windows)]
    return [np.array([f(part, axis=0) for part in parts]) for f in (np.mean, np.std)]


def train(data: TrainingSet, config: FitConfig, seed: int) -> tuple[Array, ...]:
    """Weights of one net for each joint, as in `ActuatorNet.weights`.

    In each stage the learning rate falls to zero by a cosine.
    """
    torch.set_num_threads(1)  # several wait in vain on busy cores
    generator = Generator().manual_seed(seed)
    weights = initial_weights(data, config, generator)
    optimizer = torch.optim.AdamW(weights, weight_decay=config.weight_decay, fused=True)
    rate, batch = config.learning_rate, config.batch_size
    several = config.rollout > 1 and all(map(len, data.long_windows))
    first = round(0.65 * config.steps) if several else config.steps
    stages = [(first, rate, data.windows, batch, 1)]
    if several:
        rest, fewer = config.steps - first, math.ceil(batch / 4)
        stages.append((rest, rate / 4, data.long_windows, fewer, config.rollout))
    for steps, peak, windows, size, ticks in stages:
        for step in tqdm(range(steps), desc=f"fit nets, {ticks} ticks", unit="step", disable=None):
            optimizer.param_groups[0]["lr"] = 0.5 * peak * (1 + math.cos(math.pi * step / steps))
            rows = [torch.randint(len(at), (size,), generator=generator) for at in windows]
            drawn = [torch.from_numpy(at)[row] for at, row in zip(windows, rows, strict=True)]
            loss = accumulated_loss(data, weights, torch.stack(drawn, dim=1), ticks)
            optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimizer.step()
    finite = all(bool(torch.isfinite(weight).all()) for weight in weights)
    require(finite, "weights", "finite numbers at the end of the fit", "nan or inf")
    return tuple(weight.detach().numpy() for weight in weights)


def initial_weights(data: TrainingSet, config: FitConfig, generator: Generator) -> list[Tensor]:
    """Weights, by He's uniform initialisation for ReLU, and zero biases of all nets.

    Those of inputs that the nets do not read are zero, and stay so.
    """
    n, inputs = data.input_mean.shape
    hidden, read = config.hidden, int(data.reads.sum())
    weights = []
    for rows, columns, fan_in in (
        (inputs, hidden, read),
        (hidden, hidden, hidden),
        (hidden, 1, hidden),
    ):
        w = (torch.rand(n, rows, columns, generator=generator) * 2 - 1) * math.sqrt(6 / fan_in)
        weights += [w, torch.zeros(n, columns)]
    weights[0] *= data.reads[:, None]
    return [weight.requires_grad_() for weight in weights]


def accumulated_loss(data: TrainingSet, weights: list[Tensor], at: Tensor, ticks: int) -> Tensor:
    """Mean square of the accumulated error over `ticks` of the nets on their own outputs.

    L = 1/K sum_k |sum_{i<=k} (velocity_i - target_i) / range|^2, for windows that end `at`
    (batch, n); summed over joints. With one tick it is the paper's error of one step.
    """
    joint = torch.arange(at.shape[1])
    time = at[..., None] + torch.arange(1 - data.history, 1)  # of the windows, (batch, n, H)
    history = data.samples[joint[:, None], :, time].movedim(-1, -2)  # (batch, n, 3, H)
    error, loss = torch.zeros(at.shape), torch.zeros(())
    for k in range(ticks):
        velocity = predict(data, weights, history)
        target = data.target[joint, at + k]
        error = error + (velocity - target) / (data.output_high - data.output_low)
        loss = loss + error.square().mean(dim=0).sum() / ticks
        if k + 1 < ticks:
            u = data.samples[joint, 2, at + k + 1]
            history = advance(data, history, velocity, u)
    return loss


def predict(data: TrainingSet, weights: list[Tensor], history: Tensor) -> Tensor:
    """Velocities [rad/s] (batch, n) for histories (batch, n, 3, H); none passes a stop."""
    w1, b1, w2, b2, w3, b3 = weights
    read = history.flatten(-2) if data.zones is None else valve_inputs(history, data.zones, torch)
    x = data.reads * (read - data.input_mean) / data.input_scale
    x = torch.relu(torch.baddbmm(b1[:, None], x.transpose(0, 1), w1))
    x = torch.relu(torch.baddbmm(b2[:, None], x, w2))
    y = torch.sigmoid(torch.baddbmm(b3[:, None], x, w3))[..., 0].T
    velocity = data.output_low + (data.output_high - data.output_low) * y
    q = history[..., 0, -1]
    return torch.clamp(velocity, (data.q_low - q) * data.rate, (data.q_high - q) * data.rate)


def advance(data: TrainingSet, history: Tensor, velocity: Tensor, u: Tensor) -> Tensor:
    """Histories (batch, n, 3, H) one tick on: q' = q + dt velocity; then the command `u`."""
    q = history[..., 0, -1] + velocity / data.rate
    angles = torch.cat([history[..., 0, 1:], q[..., None]], dim=-1)
    velocity = angles[..., -len(data.estimator) :] @ data.estimator
    newest = torch.stack([q, velocity, u], dim=-1)
    return torch.cat([history[..., 1:], newest[..., None]], dim=-1)
