"""From a machine to its actuator nets: record it, cut windows, fit. Paper: Sec. 3.3

One actuator at a time follows a sine until its joint reaches a limit; the return is not used. A
window of 13 samples is an input, and the velocity over the tick that follows is its target. For
each joint a net learns them by the mean squared error and Adam, the nets of all joints at once.

Only the functions that fit import torch, because one also records and reads logs without it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from itertools import chain
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from brokk_min.actuator import PLANT, ActuatorNet, Plant, estimate_velocity
from brokk_min.machine import PWM_MAX, Array, Machine, limit_command, read_encoder, require

if TYPE_CHECKING:
    from torch import Generator, Tensor
    from torch.optim import Optimizer

Rng = np.random.Generator
Rows = NDArray[np.intp]
Weights = tuple[Array, ...]  # of nets, see `ActuatorNet`
MAX_SEGMENT = 30.0  # s, assumed: longest motion that is recorded in one piece
SEGMENT = 300  # samples, about, of each of the pieces that are recorded at once
COMMANDED = 0.02  # of full command, assumed: more than a stick at rest gives
MOVED = 0.01  # rad or m, assumed: more than a parked joint creeps


# --- recordings -----------------------------------------------------------------------------------


class Recording(NamedTuple):
    """Arrays (T, n): command [-1, 1], angle [rad], velocity [rad/s].

    A command u[k] is held from the angle q[k] to q[k + 1].
    """

    name: str
    u: Array
    q: Array
    q_dot: Array


class Log(NamedTuple):
    """Recordings of the same joints."""

    joints: tuple[str, ...]
    recordings: tuple[Recording, ...]
    rate: float = 20.0  # Hz, paper: everything runs at 20 Hz; other machines have others
    warnings: tuple[str, ...] = ()  # of what was left out


def machine_log(machine: Machine, recordings: Iterable[tuple[str, Array, Array]]) -> Log:
    """A log from names, commands and encoder angles (T, n) [rad]; velocities are estimated.

    >>> log = machine_log(BROKK_170, [("a", np.zeros((40, 5)), np.zeros((40, 5)))])
    >>> log.recordings[0].q_dot.shape
    (40, 5)
    """
    samples, rate = machine.velocity_samples, machine.rate
    result = [Recording(name, u, q, velocity_of(q, samples, rate)) for name, u, q in recordings]
    return Log(machine.names, tuple(result), rate=rate)


def velocity_of(q: Array, samples: int, rate: float = 20.0) -> Array:
    """`estimate_velocity` [rad/s] of each row of angles [rad] (T, n), at rest before the first.

    >>> velocity_of(np.array([[0.0], [0.1], [0.2]]), 2).ravel().round(6).tolist()
    [0.0, 2.0, 2.0]
    """
    padded = np.concatenate([np.repeat(q[:1], samples - 1, axis=0), q])
    windows = np.lib.stride_tricks.sliding_window_view(padded, samples, axis=0)
    return estimate_velocity(windows, samples, 1 / rate)


def sine_command(rng: Rng, machine: Machine, ticks: int) -> Array:
    """One sine of random amplitude and frequency, (ticks,). Paper: Sec. 3.3

    A sine cannot always be "larger than the dead zone", so we take that for its amplitude. The
    paper prints no frequencies. These, 0.05 to 5 Hz, are as fast as a policy's commands: on nets
    from slower sines policies learn to shake the valves.

    >>> u = sine_command(np.random.default_rng(0), BROKK_170, 600)
    >>> u.shape, bool(abs(u).max() <= 80 / 127)
    ((600,), True)
    """
    amplitude = rng.uniform(machine.dead_zones.min(), machine.pwm_limit / PWM_MAX)
    frequency = np.exp(rng.uniform(np.log(0.05), np.log(5.0)))
    phase = rng.uniform(0, 2 * np.pi)
    time = machine.dt * np.arange(ticks)
    return np.asarray(amplitude * np.sin(2 * np.pi * frequency * time + phase))


def mid_range(rng: Rng, machine: Machine, joint: Rows) -> Array:
    """Angles [rad] (rows, n) at which recordings of these joints begin: amid all ranges.

    >>> mid_range(np.random.default_rng(0), BROKK_170, np.array([3])).round(3).tolist()
    [[0.0, 0.7, 0.65, 1.75, 1.0]]
    """
    low, high = machine.column("q_min"), machine.column("q_max")
    return np.tile((low + high) / 2, (len(joint), 1))


class Excitation(NamedTuple):
    """How a machine is excited: the paper's way."""

    name: str = "sine"
    command: Callable[[Rng, Machine, int], Array] = sine_command
    start: Callable[[Rng, Machine, Rows], Array] = mid_range
    push: float = 0.0  # s at a limit before a recording ends; in the paper it ends there at once


SINE = Excitation()


def collect(
    machine: Machine, hours: float, rng: Rng, plant: Plant = PLANT, excitation: Excitation = SINE
) -> Log:
    """Record a plant, one actuator at a time, `hours` for each. Paper: Sec. 3.3 (1 h)

    >>> log = collect(BROKK_170, 0.001, np.random.default_rng(0))  # 72 samples of each joint
    >>> sum(len(recording.q) for recording in log.recordings)
    360
    """
    goal = max(machine.history + 2, round(hours * 3600 * machine.rate))  # samples per joint
    rows = int(np.clip(goal // SEGMENT, 1, 100))  # recordings of a joint, simulated at once
    count = np.zeros(machine.n, int)
    recordings: list[list[tuple[str, Array, Array]]] = [[] for _ in machine.joints]
    title = f"record ({excitation.name})"
    with tqdm(total=goal * machine.n, desc=title, unit="sample", disable=None) as bar:
        while count.min() < goal:
            joint = np.repeat(np.flatnonzero(count < goal), rows)
            u, q, ended = record(machine, plant, joint, excitation, rng)
            for row, j in enumerate(joint):
                if num := min(ended[row], goal - count[j]):
                    name = f"{machine.names[j]}_{len(recordings[j]):03d}"
                    recordings[j].append((name, u[:num, row], q[:num, row]))
                    count[j] += num
                    bar.update(num)
    return machine_log(machine, chain(*recordings))


def record(
    machine: Machine, plant: Plant, joint: Rows, excitation: Excitation, rng: Rng
) -> tuple[Array, Array, Rows]:
    """Commands and angles (T, rows, n) while joint `joint[k]` of row k moves.

    Also how many samples of each row count (rows,). A row begins with `history` samples of an idle
    valve. It ends after 30 s of commands, or where q comes within two counts of a limit, but not in
    the first second.
    """
    rows, ticks = np.arange(len(joint)), round(MAX_SEGMENT * machine.rate)
    q = excitation.start(rng, machine, joint)
    commands = np.zeros((machine.history + ticks, *q.shape))
    for row in rows:
        commands[machine.history :, row, joint[row]] = excitation.command(rng, machine, ticks)
    commands = limit_command(machine, commands)
    state, angles = plant.reset(machine, q), []
    for u in commands:
        angles.append(read_encoder(machine, state.q))
        state = plant.step(machine, state, u)
    q, near = np.array(angles), 2 * machine.encoder_step[joint]
    low, high = machine.column("q_min")[joint] + near, machine.column("q_max")[joint] - near
    at_limit = (q[:, rows, joint] < low) | (q[:, rows, joint] > high)
    second = machine.rate  # ticks
    late = np.arange(len(q)) > machine.history + second
    long_enough = np.cumsum(at_limit, axis=0) > excitation.push * machine.rate
    ends = at_limit & long_enough & late[:, None]
    return commands, q, np.where(ends.any(axis=0), ends.argmax(axis=0), len(q))


# --- windows --------------------------------------------------------------------------------------


class Samples(NamedTuple):
    """The recordings of a log joined, N samples (N, n); a window must not cross their seams."""

    u: Array  # [-1, 1]
    q: Array  # rad
    q_dot: Array  # rad/s
    target: Array  # rad/s, output of the nets; none for the last sample of a recording
    moves: NDArray[np.bool_]  # is the joint `moving` in this recording?
    lengths: list[int]  # of the recordings

    def starts(self, before: int, after: int, step: int) -> Rows:
        """Every `step`-th sample that has `before` samples before it and `after` samples after it.

        Both in its own recording: the one-step fit takes all with a history and one sample more.
        """
        seams = np.cumsum([0, *self.lengths])
        parts = [np.arange(before, length - after, step) for length in self.lengths]
        return np.concatenate([seam + part for seam, part in zip(seams, parts, strict=False)])

    def windows(self, history: int, ticks: int) -> list[Rows]:
        """Newest samples of each joint's windows, which have `ticks` samples after them."""
        ends = self.starts(history - 1, ticks, 1)
        return [ends[moves] for moves in self.moves[ends].T]


def moving(recording: Recording) -> NDArray[np.bool_]:
    """Which joints have a command or move in a recording (n,); a parked one may creep a little.

    >>> u, q = np.array([[0.0, 0.0], [0.5, 0.0]]), np.zeros((2, 2))
    >>> moving(Recording("a", u, q, q)).tolist()
    [True, False]
    """
    commanded = np.ptp(recording.u, axis=0) > COMMANDED
    return np.asarray(commanded | (np.ptp(recording.q, axis=0) > MOVED))


def join_recordings(log: Log) -> Samples:
    """Join recordings; the target is the velocity of the coming tick, (q(t+dt) - q(t)) / dt.

    >>> q = np.array([[0.0], [0.1], [0.3]])
    >>> log = Log(("q1",), (Recording("a", 0 * q, q, 0 * q),))
    >>> join_recordings(log).target[:2].ravel().round(6).tolist()
    [2.0, 4.0]
    """
    lengths = [len(recording.q) for recording in log.recordings]
    moves = np.repeat([moving(recording) for recording in log.recordings], lengths, axis=0)
    u, q, q_dot = map(np.concatenate, list(zip(*log.recordings, strict=True))[1:])
    return Samples(u, q, q_dot, np.diff(q, axis=0, append=0) * log.rate, moves, lengths)


# --- the fit --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FitConfig:
    """Settings of the fit; the paper prints the number of units only."""

    steps: int = 16_000  # 5,000 are enough for logs of a few minutes
    batch_size: int = 512  # windows of each joint in a step
    learning_rate: float = 4e-3  # of Adam; falls to zero by a cosine
    hidden: int = 32  # units in each of the two hidden layers (paper: 32)


class TrainingSet:
    """Windows of n joints as float32 tensors, and how inputs and outputs are scaled.

    Nets that read a history in another way have a subclass with `read`, of single samples, and
    `inputs`, of histories. ValueError: a joint that never moves.
    """

    def __init__(self, log: Log, machine: Machine) -> None:
        import torch

        self.log, self.machine, self.rate = log, machine, log.rate
        self.joined, H = join_recordings(log), machine.history
        self.windows = self.joined.windows(H, 1)  # newest samples of each joint's windows
        every = zip(self.joined.target.T, self.windows, strict=True)
        targets = [target[at] for target, at in every]
        for name, target in zip(log.joints, targets, strict=True):
            wanted = f"a recording of {H + 1} samples or more in which it moves"
            require(len(np.unique(target)) > 1, f"joint {name}", wanted, "none")
        low, high = (np.array([f(target) for target in targets]) for f in (np.min, np.max))
        margin = 0.05 * (high - low) + 1e-6  # rad/s, because a sigmoid never reaches its ends
        signals = np.stack([self.joined.q, self.joined.q_dot, self.joined.u], dtype=np.float32)
        read = self.read(signals)
        parts = [read[at, j] for j, at in enumerate(self.windows)]
        moments = (np.array([f(part, axis=0) for part in parts]) for f in (np.mean, np.std))
        mean, std = (np.repeat(x, H, axis=1) for x in moments)  # (n, I); alike for all 13 samples

        def tensor(array: Array) -> Tensor:
            return torch.from_numpy(np.array(array, np.float32, order="C"))

        self.samples = tensor(signals.transpose(2, 1, 0))  # angle, velocity, command, (n, N, 3)
        self.histories_from = self.samples.flatten(0, 1).unfold(0, H, 1)  # each sample, (nN, 3, H)
        self.target = tensor(self.joined.target.T)  # what nets should say there [rad/s], (n, N)
        self.q_low, self.q_high = (tensor(f(self.joined.q, axis=0)) for f in (np.min, np.max))
        self.input_mean, self.input_scale = tensor(mean), tensor(np.where(std > 1e-9, std, 1.0))
        self.output_low, self.output_high = tensor(low - margin), tensor(high + margin)  # (n,)
        self.joint = torch.arange(len(targets))

    def read(self, signals: Array) -> Array:
        """What nets read of each sample, (N, n, 3) of angles, velocities, commands (3, N, n)."""
        return signals.transpose(1, 2, 0)

    def inputs(self, history: Tensor) -> Tensor:
        """13 angles, 13 velocities, 13 commands, (..., n, 39) of histories (..., n, 3, 13)."""
        return history.flatten(-2)

    def histories(self, at: Tensor) -> Tensor:
        """Histories (batch, n, 3, H) whose newest samples are `at` (batch, n)."""
        oldest = at + 1 - self.machine.history
        return self.histories_from[self.joint * self.samples.shape[1] + oldest]

    def nets(self, weights: Weights, config: FitConfig, seed: int, name: str) -> ActuatorNet:
        """Nets with these weights; what is kept beside them says how they were made."""
        keys = ("input_mean", "input_scale", "output_low", "output_high")
        scales = {key: getattr(self, key).numpy() for key in keys}
        m, training = self.machine, {"seed": seed, "settings": asdict(config)}
        about = (self.log.joints, m.history, self.rate, m.velocity_samples, name)
        return ActuatorNet(*about, **scales, weights=weights, training=training)


def initial_weights(data: TrainingSet, hidden: int, generator: Generator) -> list[Tensor]:
    """Weights by He's uniform initialisation for ReLU, and zero biases, of all nets."""
    import torch

    (n, inputs), weights = data.input_mean.shape, []
    for rows, columns in ((inputs, hidden), (hidden, hidden), (hidden, 1)):
        w = (torch.rand(n, rows, columns, generator=generator) * 2 - 1) * math.sqrt(6 / rows)
        weights += [w, torch.zeros(n, columns)]
    return [weight.requires_grad_() for weight in weights]


def predict(data: TrainingSet, weights: list[Tensor], history: Tensor) -> Tensor:
    """Velocities [rad/s] (batch, n) for histories (batch, n, 3, H), as `ActuatorNet.predict`.

    Then, as in `ActuatorNet.step`, a joint goes no farther than to a stop: here to an end of the
    recorded range. Nets that had to learn the stops would brake before them.
    """
    w1, b1, w2, b2, w3, b3 = weights
    x = (data.inputs(history) - data.input_mean) / data.input_scale
    x = b1[:, None].baddbmm(x.transpose(0, 1), w1).relu()  # x w + b, one product per joint
    x = b2[:, None].baddbmm(x, w2).relu()
    y = b3[:, None].baddbmm(x, w3).sigmoid()[..., 0].T
    velocity = data.output_low + (data.output_high - data.output_low) * y
    q = history[..., 0, -1]
    return velocity.clamp((data.q_low - q) * data.rate, (data.q_high - q) * data.rate)


def mean_squared_error(data: TrainingSet, weights: list[Tensor], at: Tensor) -> Tensor:
    """MSE for windows that end `at` (batch, n), summed over joints.

    L = 1/B sum |(net(history) - (q(t + dt) - q(t)) / dt) / range|^2, where range is that of the
    sigmoid's output, output_high - output_low. Paper: Sec. 3.3
    """
    velocity = predict(data, weights, data.histories(at))
    error = (velocity - data.target[data.joint, at]) / (data.output_high - data.output_low)
    return error.square().mean(dim=0).sum()


def minimise(
    data: TrainingSet,
    optimizer: Optimizer,
    generator: Generator,
    config: FitConfig,
    loss_function: Callable[[TrainingSet, list[Tensor], Tensor], Tensor] = mean_squared_error,
    windows: list[Rows] | None = None,
) -> None:
    """Steps on random windows of each joint; the learning rate falls to zero by a cosine.

    Another loss may need other `windows` than those of `data`: `beyond.free_runs`.
    """
    import torch

    torch.set_num_threads(1)  # several wait in vain on busy cores
    (group,), windows = optimizer.param_groups, windows or data.windows
    for step in tqdm(range(config.steps), desc="fit nets", unit="step", disable=None):
        group["lr"] = 0.5 * config.learning_rate * (1 + math.cos(math.pi * step / config.steps))
        size = (config.batch_size,)
        rows = [torch.randint(len(at), size, generator=generator) for at in windows]
        drawn = [torch.from_numpy(at)[row] for at, row in zip(windows, rows, strict=True)]
        loss = loss_function(data, group["params"], torch.stack(drawn, dim=1))
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()


def fit_weights(data: TrainingSet, config: FitConfig, seed: int) -> Weights:
    """Weights of one net for each joint, as in `ActuatorNet.weights`. Paper: Sec. 3.3 (Adam)"""
    import torch

    generator = torch.Generator().manual_seed(seed)
    weights = initial_weights(data, config.hidden, generator)
    optimizer = torch.optim.Adam(weights, fused=True)
    minimise(data, optimizer, generator, config)
    return arrays(weights)


def arrays(weights: list[Tensor]) -> Weights:
    """Weights for `ActuatorNet`. ValueError: they are not finite."""
    finite = all(bool(weight.isfinite().all()) for weight in weights)
    require(finite, "weights", "finite numbers at the end of the fit", "nan or inf")
    return tuple(weight.detach().numpy() for weight in weights)


def fit(log: Log, config: FitConfig, seed: int, machine: Machine, name: str = "") -> ActuatorNet:
    """The nets of each joint of a log; the same `seed` gives the same bits on one computer.

    `name` is that of `machine`, or empty for a log with other joints. ValueError: a joint that
    never moves long enough, or weights that are not finite at the end. Paper: Sec. 3.3
    """
    data = TrainingSet(log, machine)
    return data.nets(fit_weights(data, config, seed), config, seed, name)
