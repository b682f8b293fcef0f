"""A small model of a joint, which explains its velocity by its commands, without a net.

The command, later by a delay, less the dead zone, times a gain, through a first-order lag:

    q_dot' = (g_up max(u(t - d) - z_up, 0) - g_down max(-u(t - d) - z_down, 0) - q_dot) / tau

A grid gives delay, lag and dead zones, and least squares give the gains. Samples at the ends of the
recorded range do not count, because a joint that is pushed against its stop stands still.
"""

from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike, NDArray
from scipy.signal import lfilter

from brokk_min.fit import COMMANDED, MOVED, Recording
from brokk_min.machine import Array

# What is searched, all assumed.
LATEST = 0.6  # s, longest delay
TAUS = (0.05, 0.1, 0.2, 0.4)  # s
ZONES = 0.01 * np.arange(61)  # dead zones, of full command
AT_STOP = 0.01  # of the recorded range: so near its end a joint may be at a stop
STAYS = 0.125  # of the time at an end, with commands away from there: it is no stop
MOVES_STOP = 0.25  # of it, by which a stop may be elsewhere in a recording, as after a new zero
PAUSE = 2.0  # s, after so long a joint without commands is at rest
OPENS = 0.3  # of full command: it opens any valve
STARTS = 1.0  # s at the beginning of one that begins in motion, which do not count
TELLING = 0.3  # of a motion that is explained; less tells neither its sign nor its clock, assumed
EARLIER = 0.02  # more of a motion is explained if it begins before its commands

Pair = tuple[float, float]  # up and down, or low and high


class Motion(NamedTuple):
    """Samples of one joint, recordings one after the other, with a rest in between, (T,)."""

    u: Array
    velocity: Array  # over the coming sample [rad/s]
    counts: NDArray[np.bool_]  # not in a rest, nor at an end of the range
    rate: float  # Hz


def motion_of(
    recordings: list[Recording], j: int, rate: float, span: Pair, commands: int | None = None
) -> Motion:
    """Joint `j` of recordings in its range `span` [rad].

    Its commands may be those of another joint. Before a recording that begins in motion, as after
    a gap, nobody knows them.
    """
    rest, of = (0, round(PAUSE * rate)), j if commands is None else commands
    u = np.concatenate([np.pad(one.u[:, of], rest) for one in recordings])
    q = np.concatenate([np.pad(one.q[:, j], rest, "edge") for one in recordings])
    counts = np.concatenate([np.pad(after_start(one, j, of, rate), rest) for one in recordings])
    q_next, lengths = np.append(q[1:], q[-1]), [len(one.u) + rest[1] for one in recordings]
    each = [stops_of(one.q[:, j], one.u[:, of], span, rate) for one in recordings]
    stops = np.repeat(each, lengths, axis=0)
    counts &= (q_next > stops[:, 0]) & (q_next < stops[:, 1])
    return Motion(u, (q_next - q) * rate * counts, counts, rate)


def stops_of(q: Array, u: Array, span: Pair, rate: float) -> Pair:
    """Angles [rad] beyond which a joint may be at a stop in a recording (T,).

    The ends of its own angles may be stops, too, if commands away from there move it away.
    """
    width, ends = span[1] - span[0], [-span[0], span[1]]
    for i, way in enumerate((-1, 1)):
        end = (way * q).max()
        there = way * q > end - AT_STOP * width
        stays = (there & (way * u < -OPENS)).sum() > max(rate, STAYS * there.sum())
        if np.ptp(q) > MOVES_STOP * width and end > ends[i] - MOVES_STOP * width and not stays:
            ends[i] = end
    return AT_STOP * width - ends[0], ends[1] - AT_STOP * width


def after_start(one: Recording, j: int, of: int, rate: float) -> NDArray[np.bool_]:
    """Samples of a recording that count, (T,): all, or all but the first if it begins in motion."""
    moves = abs(one.u[0, of]) > COMMANDED or abs(one.q_dot[0, j]) > MOVED
    return np.asarray(np.arange(len(one.u)) >= (STARTS * rate if moves else 0))


class Model(NamedTuple):
    """The model that explains a joint's motion best."""

    explained: float  # part of the velocities' power
    lag: tuple[int, float]  # delay [samples] and tau [s]
    zones: Array  # dead zones up and down, of full command, (2,)
    gains: Array  # rad/s per command beyond them, (2,)


def fit_model(motion: Motion) -> Model:
    """A grid of delays and lags, then one of dead zones, twice."""
    zones = np.array([0.05, 0.05])
    for _ in range(2):
        best = best_lag(motion, zones)
        for side in (0, 1):
            trials = [np.where(np.arange(2) == side, zone, zones) for zone in ZONES]
            lag = best.lag
            models = (with_gains(motion, lag, of, responses(motion, lag[1], of)) for of in trials)
            best = max(models, key=lambda one: one.explained)
            zones = best.zones
    return best


def best_lag(motion: Motion, zones: Array) -> Model:
    """The delay and lag that explain a motion best with these dead zones (2,)."""
    x = {tau: responses(motion, tau, zones) for tau in TAUS}
    lags = product(range(round(LATEST * motion.rate) + 1), TAUS)
    models = (with_gains(motion, lag, zones, x[lag[1]]) for lag in lags)
    return max(models, key=lambda one: one.explained)


def earlier(motion: Motion, model: Model) -> float:
    """By how much a joint moves before its commands [s], where that explains it better."""
    if model.lag[0]:
        return 0.0
    ahead = range(1, round(LATEST * motion.rate) + 1)
    leads = [motion._replace(u=np.append(motion.u[i:], np.zeros(i))) for i in ahead]
    parts = [best_lag(lead, model.zones).explained for lead in leads]
    best = int(np.argmax(parts))
    better = parts[best] > max(model.explained + EARLIER, TELLING)
    return ahead[best] / motion.rate if better else 0.0


def with_gains(motion: Motion, lag: tuple[int, float], zones: Array, x: Array) -> Model:
    """The model with the best gains of the responses `x` (2, T), which are without the delay.

    Least squares of v = g x: with A = x x^T and b = x v, g = A^-1 b leaves v^2 - g (2 b - A g).
    """
    x = delayed(x, lag[0]) * motion.counts
    A, b = x @ x.T + 1e-9 * np.eye(2), x @ motion.velocity
    gains, power = np.linalg.solve(A, b), float(motion.velocity @ motion.velocity)
    return Model(float(gains @ (2 * b - A @ gains)) / power if power else 0.0, lag, zones, gains)


def explained_part(velocity: Array, expected: Array) -> float:
    """Part of the power of velocities (T,) that is as expected; without motion nothing is."""
    error, power = velocity - expected, float(velocity @ velocity)
    return 1 - float(error @ error) / power if power else 0.0


def responses(motion: Motion, tau: float, zones: Array) -> Array:
    """Velocities (2, T) upwards and downwards if the gains are 1 and nothing is late."""
    openings = [np.maximum(motion.u - zones[0], 0), -np.maximum(-motion.u - zones[1], 0)]
    a = np.exp(-1 / (motion.rate * tau))
    return np.asarray(lfilter([1 - a], [1, -a], openings))


def delayed(x: Array, delay: int) -> Array:
    """Responses (2, T), `delay` samples later."""
    return np.pad(x, ((0, 0), (delay, 0)))[:, : x.shape[1]]


def expected_velocity(motion: Motion, model: Model) -> Array:
    """What the model says of a motion [rad/s] (T,), 0 where samples do not count."""
    x = delayed(responses(motion, model.lag[1], model.zones), model.lag[0])
    return np.asarray(model.gains @ x * motion.counts)


def means(motion: Motion, values: ArrayLike, seconds: float) -> Array:
    """Means over so many seconds, (T,)."""
    window = np.ones(round(seconds * motion.rate))
    return np.convolve(np.asarray(values, float), window / len(window))[: len(motion.u)]


def reach(motion: Motion) -> Array:
    """How far the joint has moved within the last second, (T,) [rad]; nan at ends of the range."""
    second = round(motion.rate)
    path = np.pad(np.cumsum(motion.velocity) / motion.rate, (second, 0))
    widest = np.ptp(sliding_window_view(path, second + 1), axis=1)
    return np.where(means(motion, motion.counts, 1.0) > 1 - 1e-9, widest, np.nan)
