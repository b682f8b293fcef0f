"""A fit that ends with free runs of the nets.

What it changes: the paper minimises the error of one step. Here the last third of the steps
minimises the error that adds up over K ticks in which the nets read their own predictions,

    L = 1/K sum_k |sum_{i<=k} (velocity_i - target_i) / range|^2,

because there a bias adds up, and the noise of encoders does not. A net that reads past velocities
may also learn to go on as they say, whatever the command: with `newest_only` it reads the commands
and the newest sample alone.

What it buys: after 30 s under the same commands the tool of the nets is 0.016 m from the machine's,
with richer logs and five nets a joint, and 0.11 m with the paper's nets (medians of 20 runs,
`benchmarks.deviations d7`).

Who was first: NARX models and their free runs are Leontaritis and Billings' (1985), the fit of a
model on its own outputs is the output-error method (Ljung, System Identification, 1999).

It plugs in as another `fit.fit_weights`.
"""

import math
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from brokk_min import fit
from brokk_min.actuator import estimate_velocity
from brokk_min.fit import FitConfig, TrainingSet
from brokk_min.machine import Array


def fit_weights(
    data: TrainingSet, config: FitConfig, seed: int, ours: tuple[int, float, bool]
) -> tuple[Array, ...]:
    """Weights of one net for each joint; the second stage has a quarter of rate and batch.

    `ours` are K, the decay of the weights (AdamW), and whether nets read the newest sample alone.
    """
    ticks, weight_decay, newest_only = ours
    generator = torch.Generator().manual_seed(seed)
    weights = fit.initial_weights(data, config.hidden, generator)
    if newest_only:
        forget_older_outputs(data, weights[0])
    optimizer = torch.optim.AdamW(weights, weight_decay=weight_decay, fused=True)
    long_windows = data.joined.windows(data.machine.history, ticks)
    several = ticks > 1 and all(map(len, long_windows))
    first = replace(config, steps=round(0.65 * config.steps)) if several else config
    fit.minimise(data, optimizer, generator, first)
    if several:
        rate, fewer = config.learning_rate / 4, math.ceil(config.batch_size / 4)
        rest = replace(first, steps=config.steps - first.steps, learning_rate=rate)
        loss = partial(accumulated_loss, ticks=ticks)
        rest = replace(rest, batch_size=fewer)
        fit.minimise(data, optimizer, generator, rest, loss, long_windows)
    return fit.arrays(weights)


def forget_older_outputs(data: TrainingSet, w1: Tensor) -> None:
    """Let weights `w1` (n, I, hidden) of all angles and velocities but the newest be zero."""
    read = torch.ones(w1.shape[1])
    read.view(-1, data.machine.history)[:2, :-1] = 0
    w1.data *= read[:, None] * math.sqrt(len(read) / read.sum())  # of fewer inputs
    hook = w1.register_hook  # so they stay zero
    hook(lambda gradient: gradient * read[:, None])  # type: ignore[no-untyped-call]


def accumulated_loss(data: TrainingSet, weights: list[Tensor], at: Tensor, ticks: int) -> Tensor:
    """The loss above over K = `ticks` for windows that end `at` (batch, n), summed over joints."""
    history = data.histories(at)
    error, loss = torch.zeros(at.shape), torch.zeros(())
    for k in range(ticks):
        velocity = fit.predict(data, weights, history)
        target = data.target[data.joint, at + k]
        error = error + (velocity - target) / (data.output_high - data.output_low)
        loss = loss + error.square().mean(dim=0).sum() / ticks
        if k + 1 < ticks:
            history = advance(data, history, velocity, data.samples[data.joint, at + k + 1, 2])
    return loss


def advance(data: TrainingSet, history: Tensor, velocity: Tensor, u: Tensor) -> Tensor:
    """Histories (batch, n, 3, H) one tick on: q' = q + dt velocity; then the command `u`."""
    q = history[..., 0, -1] + velocity / data.rate
    angles = torch.cat([history[..., 0, 1:], q[..., None]], dim=-1)
    window = data.machine.velocity_samples
    weights = estimate_velocity(torch.eye(window).numpy(), window, 1 / data.rate)
    velocity = angles[..., -window:] @ torch.from_numpy(weights)
    newest = torch.stack([q, velocity, u], dim=-1)
    return torch.cat([history[..., 1:], newest[..., None]], dim=-1)
