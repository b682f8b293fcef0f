"""Fitting the nets to a log: windows of its recordings, errors of one step, then of short free runs.

A window never crosses the seam of two recordings, and teaches a joint only where that joint moves. The nets
of all joints are fitted at once.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from brokk_min.actuator import ActuatorNet, mu_law
from brokk_min.identification.logs import Log, Recording
from brokk_min.identification.net_file import NET_ARRAYS
from brokk_min.machine import Array, estimate_velocity


@dataclass(frozen=True)
class FitConfig:
    """How the nets are fitted."""

    steps: int = 16000
    """Adam steps."""
    batch_size: int = 512
    """Windows a joint in each step; 10,000 steps of 1024 take about as long and fit worse."""
    learning_rate: float = 4e-3
    """Of Adam at the start; falls to zero along a cosine, and again from a quarter for free runs."""
    noise: float = 0.1
    """Standard deviation of the noise on the velocity inputs, in units of the velocities' own."""
    hidden: int = 32
    """Units in each of the two hidden layers (paper: 32)."""
    history: int = 13
    """Samples of angle, velocity and command that the nets see (paper: 13)."""
    rollout: int = 8
    """Ticks that the nets run freely in the last third of the steps, which learn from that (paper: 1)."""
    dead_zone: float | None = None
    """Command, of full command, within which no valve opens: nets then see `mu_law` of commands.
    None: that of the machine where it is known, otherwise 0: commands as they are (paper)."""


PAPER_RECIPE: dict[str, Any] = {"noise": 0.0, "rollout": 1, "dead_zone": 0.0}  # Sec. 3.3


def fit(
    log: Log, config: FitConfig, seed: int, velocity_samples: int, machine: str = ""
) -> ActuatorNet:
    """Fit one net a joint to a log. Paper: Sec. 3.3 (MSE, Adam)

    One-step errors first, then short free runs, in which a bias adds up while the noise of encoders does
    not. What `ActuatorNet.step` cuts off at a stop is no error: nets need not brake before it. The same
    `seed` gives the same bits on the same machine. `velocity_samples` is the window of the estimator that
    supplied the velocities of `log`, `machine` a name for the file.

    ValueError: a joint that never moves long enough to be learned.
    """
    dead_zone = config.dead_zone or 0.0
    config = replace(config, dead_zone=dead_zone)  # as it is used, for the file
    training = training_set(log, config.history, config.rollout, dead_zone)
    estimator = None if log.velocity_logged else velocity_samples
    weights = _train(training, config, seed, estimator)
    return ActuatorNet(
        joints=log.joints,
        history=config.history,
        rate=log.rate,
        velocity_samples=velocity_samples,
        velocity_logged=log.velocity_logged,
        machine=machine,
        seed=seed,
        settings=asdict(config),
        weights=weights,
        dead_zone=dead_zone,
        **{name: getattr(training, name).astype(np.float32) for name in NET_ARRAYS},
    )


def _train(
    training: TrainingSet, config: FitConfig, seed: int, estimator: int | None
) -> tuple[Array, ...]:
    """Weights of all nets, one Adam step for all of them at a time; `estimator` as in `_rollout_loss`."""
    import torch

    torch.set_float32_matmul_precision("highest")  # a training of policies may have allowed less
    tensors, generator = _as_tensors(training), torch.Generator().manual_seed(seed)
    weights = _first_weights(training, config, generator)
    optimizer = torch.optim.Adam(weights, lr=config.learning_rate)
    runs_free = config.rollout > 1 and all(map(len, training.far_ends))
    turn = round(0.65 * config.steps) if runs_free else config.steps

    def fall(step: int) -> float:
        done = step / turn if step < turn else (step - turn) / max(config.steps - turn, 1)
        return (0.5 if step < turn else 0.125) * (1 + float(np.cos(np.pi * done)))

    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, fall)
    for step in tqdm(range(config.steps), desc="fit nets", unit="step", disable=None):
        far = step >= turn
        at = _draw_windows(training, config, far, generator)
        ticks = config.rollout if far else 1
        loss = _rollout_loss(tensors, config, weights, at, ticks, estimator, generator)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    if not all(torch.isfinite(weight).all() for weight in weights):
        raise ValueError("weights: expected finite numbers at the end of the fit, got nan or inf")
    return tuple(weight.detach().numpy() for weight in weights)


def _as_tensors(training: TrainingSet) -> Any:
    """A training set with float32 tensors for arrays."""
    import torch

    return TrainingSet._make(
        torch.tensor(a).float() if isinstance(a, np.ndarray) else a for a in training
    )


def _draw_windows(training: TrainingSet, config: FitConfig, far: bool, generator: Any) -> Any:
    """Newest samples (n, batch) of random windows of each joint; fewer, with room behind them, if `far`."""
    import torch

    ends = training.far_ends if far else training.ends
    batch = -(-config.batch_size // 4) if far else config.batch_size
    picks = [torch.randint(len(end), (batch,), generator=generator) for end in ends]
    return torch.tensor(np.stack([end[pick] for end, pick in zip(ends, picks, strict=True)]))


def _first_weights(training: TrainingSet, config: FitConfig, generator: Any) -> list[Any]:
    """Weights and biases of all nets, layer by layer, as `ActuatorNet.weights` has them."""
    import torch

    (n, inputs), hidden = training.input_mean.shape, config.hidden
    weights: list[torch.Tensor] = []
    for rows, columns in [(inputs, hidden), (hidden, hidden), (hidden, 1)]:
        bound = (6 / rows) ** 0.5  # He's uniform bound for ReLU
        weights.append((torch.rand(n, rows, columns, generator=generator) * 2 - 1) * bound)
        weights.append(torch.zeros(n, columns))
    return [weight.requires_grad_() for weight in weights]


def _rollout_loss(
    training: Any,
    config: FitConfig,
    weights: list[Any],
    at: Any,
    ticks: int,
    estimator: int | None,
    generator: Any,
) -> Any:
    """Mean square of how far free runs from the windows that end `at` (n, batch) are off.

    After each tick, in units of the outputs' range and ticks: the error of the velocities so far, added up.
    A joint goes no further than its stops, as in `ActuatorNet.step`.

    Args:
        training: of `_as_tensors`.
        estimator: samples of the velocity estimator; None: velocities are the nets' own outputs.
    """
    import torch

    q, q_dot, u = _windows(training, config, at, ticks, generator)
    joint, history, rate = torch.arange(len(at))[:, None], config.history, training.rate
    low, span = training.output_low[:, None], (training.output_high - training.output_low)[:, None]
    mean, scale = training.input_mean[:, None], training.input_scale[:, None]
    if estimator:
        slope = torch.tensor(estimate_velocity(np.eye(estimator), estimator, 1 / rate)).float()
    off, loss = torch.zeros(()), torch.zeros(())
    for k in range(ticks):
        x = torch.stack([q, q_dot, u[..., k : k + history]], dim=2).flatten(2)
        room = [(stop[:, None] - q[..., -1]) * rate for stop in (training.q_low, training.q_high)]
        velocity = torch.clamp(low + span * _outputs(weights, (x - mean) / scale), *room)
        off = off + (velocity - training.target[at + k, joint]) / span
        loss = loss + (off**2).mean(dim=1).sum() / ticks
        if k + 1 < ticks:
            q = torch.cat([q[..., 1:], (q[..., -1] + velocity / rate)[..., None]], dim=-1)
            if estimator:
                velocity = (q[..., -estimator:] * slope).sum(dim=-1)
            q_dot = torch.cat([q_dot[..., 1:], velocity[..., None]], dim=-1)
    return loss


def _windows(
    training: Any, config: FitConfig, at: Any, ticks: int, generator: Any
) -> tuple[Any, Any, Any]:
    """Angles and noisy velocities (n, batch, H) of windows that end `at`, and commands `ticks` - 1 beyond."""
    import torch

    (n, batch), history = at.shape, config.history
    series = training.series.unfold(-1, history + ticks - 1, 1)
    q, q_dot, u = series[:, torch.arange(n)[:, None], at - (history - 1)]
    q, q_dot = q[..., :history], q_dot[..., :history]
    if config.noise:
        noise = torch.randn(n, batch, history, generator=generator)
        noise = noise + torch.randn(n, batch, 1, generator=generator)
        q_dot = (
            q_dot + config.noise * training.input_scale.reshape(n, 1, 3, history)[:, :, 1] * noise
        )
    return q, q_dot, u


def _outputs(weights: list[Any], x: Any) -> Any:
    """What all nets say in [0, 1] (n, batch) to standardised inputs (n, batch, 3 H)."""
    import torch

    for i in (0, 2):
        x = torch.relu(torch.baddbmm(weights[i + 1][:, None], x, weights[i]))
    return torch.sigmoid(torch.baddbmm(weights[5][:, None], x, weights[4]))[..., 0]


class TrainingSet(NamedTuple):
    """What models are fitted to: the windows of H samples of each joint, and their statistics."""

    series: Array  # (3, n, N): angle, velocity and `mu_law` of commands, recordings end to end
    target: Array  # (N, n) rad/s, see `end_to_end`
    ends: list[NDArray[np.intp]]  # newest samples of each joint's windows
    input_mean: Array  # (n, 3 H)
    input_scale: Array  # (n, 3 H)
    output_low: Array  # (n,) rad/s
    output_high: Array  # (n,) rad/s
    q_low: Array  # (n,) rad
    q_high: Array  # (n,) rad
    far_ends: list[NDArray[np.intp]]  # as `ends`, with `rollout` samples after them
    rate: float  # of the samples [Hz]


def training_set(log: Log, history: int, rollout: int = 1, dead_zone: float = 0.0) -> TrainingSet:
    """Windows of the recordings in which a joint moves; its statistics are of those alone.

    ValueError: a joint that never moves long enough to be learned.
    """
    samples = end_to_end(log)
    every, far = (samples.starts(history - 1, ahead, 1) for ahead in (1, rollout))
    ends, far_ends = ([at[moves] for moves in samples.moves[at].T] for at in (every, far))
    for name, end, target in zip(log.joints, ends, samples.target.T, strict=True):
        if not len(end) or np.ptp(target[end]) == 0:
            raise ValueError(
                f"joint {name}: expected a recording of {history + 1} samples or more in which it "
                "moves, got none"
            )
    commands = mu_law(samples.whole.u, dead_zone)
    series = np.stack([samples.whole.q.T, samples.whole.q_dot.T, commands.T])
    mean = np.array([series[:, j, end].mean(axis=1) for j, end in enumerate(ends)])
    scale = np.array([series[:, j, end].std(axis=1) for j, end in enumerate(ends)])
    scale = np.where(scale > 1e-9, scale, 1.0)  # a channel that never changes
    low = np.array([samples.target[end, j].min() for j, end in enumerate(ends)])
    high = np.array([samples.target[end, j].max() for j, end in enumerate(ends)])
    margin = 0.05 * (high - low) + 1e-6  # rad/s; never none, where a joint knows one speed
    low, high = low - margin, high + margin
    mean, scale = np.repeat(mean, history, axis=1), np.repeat(scale, history, axis=1)
    ranges = samples.whole.q.min(axis=0), samples.whole.q.max(axis=0)
    return TrainingSet(
        series, samples.target, ends, mean, scale, low, high, *ranges, far_ends, log.rate
    )


class Samples(NamedTuple):
    """The recordings of a log end to end, N samples in all; windows must not cross their seams."""

    whole: Recording
    target: Array  # (N, n), see `end_to_end`
    moves: NDArray[np.bool_]  # (N, n): in a recording in which the joint moves or is commanded
    lengths: list[int]  # of the recordings

    @property
    def scored(self) -> NDArray[np.bool_]:
        """Where a joint is scored (N, n): where it moves, or if it rests everywhere, at rest."""
        return self.moves | ~self.moves.any(axis=0)

    def starts(self, before: int, after: int, step: int) -> NDArray[np.intp]:
        """Every `step`-th sample of each recording with `before` samples before and `after` after it."""
        seams = np.cumsum([0, *self.lengths])
        pieces = zip(seams, self.lengths, strict=False)
        return np.concatenate(
            [seam + np.arange(before, length - after, step) for seam, length in pieces]
        )


def end_to_end(log: Log) -> Samples:
    """Join recordings, with what a net is to say at each sample.

    That is the mean velocity [rad/s] over the coming tick, (q(t+dt) - q(t)) / dt, from encoder angles;
    where the log has velocities of its own, q_dot(t+dt). The last sample of a recording has none.
    """
    kinds = ([getattr(r, kind) for r in log.recordings] for kind in Recording._fields[1:])
    whole = Recording("", *(np.concatenate(arrays) for arrays in kinds))
    if log.velocity_logged:
        target = np.roll(whole.q_dot, -1, axis=0)
    else:
        target = np.diff(whole.q, axis=0, append=0) * log.rate
    lengths = [len(r.q) for r in log.recordings]
    moves = [np.ptp(r.u, axis=0) + np.ptp(r.q, axis=0) > 0 for r in log.recordings]
    return Samples(whole, target, np.repeat(moves, lengths, axis=0), lengths)
