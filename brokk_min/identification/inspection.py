"""What a log tells of its machine before any fit, joint by joint, and where it is not enough.

A small model explains the velocity of a joint: its command, later by a delay, less the dead zone,
times a gain, through a first-order lag:

    q_dot' = (g_up max(u(t - d) - z_up, 0) - g_down max(-u(t - d) - z_down, 0) - q_dot) / tau

A grid gives delay, lag and dead zones, and least squares give the gains. Samples at the ends of the
recorded range do not count, because a joint that is pushed against its stop stands still.
"""

from collections.abc import Iterator, Mapping
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter
from tqdm import tqdm

from brokk_min._files import brief
from brokk_min.fit import COMMANDED, Log, Recording, Samples, join_recordings, moving
from brokk_min.machine import Array, Machine

# What is searched, all assumed.
LATEST = 0.4  # s, longest delay
TAUS = (0.05, 0.1, 0.2, 0.4)  # s
ZONES = 0.01 * np.arange(61)  # dead zones, of full command
AT_STOP = 0.01  # of the recorded range: so near its end a joint may be at a stop
PAUSE = 2.0  # s, after so long a joint without commands is at rest
CLEAR_SIGN = 0.1  # least correlation that has a clear sign
OPPOSITE = 0.4  # least correlation of a recording with the other sign
FASTEST = 0.999  # quantile of the speeds, because the single ones have noise
# What a log must have, all assumed.
LEAST_MINUTES = 10.0
LEAST_RANGE = 0.7  # of a joint's range
LEAST_EXPLAINED = 0.6  # of a joint's motion by its commands; of sound logs of ours 0.84
BEYOND = 0.05  # of a joint's range, outside of it
FOLLOWS = 0.8  # of a joint's motion without commands, that another joint explains


class JointReport(NamedTuple):
    """One joint of a log; pairs are up and down."""

    minutes: float  # in recordings in which it has commands
    low: float  # rad, smallest angle
    high: float  # rad
    fastest: tuple[float, float]  # rad/s, of the velocities in the log
    opposite: list[str]  # recordings in which it moves against the model of all of them
    follows: dict[str, float]  # rad/s per rad/s of joints with which it moves without commands
    sign: int  # of the velocity under a positive command; 0: not clear
    explained: float  # part of the velocities' power that the model explains
    delay: float  # s
    dead_zone: tuple[float, float]  # of full command


def inspect(log: Log) -> dict[str, JointReport]:
    """A report of each joint that is driven in a log."""
    reports, samples = {}, join_recordings(log)
    for j, name in enumerate(tqdm(log.joints, desc="inspect", unit="joint", disable=None)):
        recordings = [one for one in log.recordings if moving(one)[j]]
        if recordings:
            rows = samples.moves[:, j]
            u, q, q_dot = (x[rows, j] for x in (samples.u, samples.q, samples.q_dot))
            each = [(one.name, motion_of([one], j, log.rate)) for one in recordings]
            model = fit_model(motion_of(recordings, j, log.rate))
            ticks = sum(len(one.u) for one in recordings if np.ptp(one.u[:, j]) > COMMANDED)
            reports[name] = JointReport(
                minutes=ticks / log.rate / 60,
                low=q.min(),
                high=q.max(),
                fastest=(np.quantile(q_dot, FASTEST), np.quantile(-q_dot, FASTEST)),
                opposite=[run for run, motion in each if contradicts(motion, model)],
                follows=followed_joints(log, samples, j),
                sign=sign(u, q_dot, log.rate),
                explained=model.explained,
                delay=model.lag[0] / log.rate,
                dead_zone=(model.zones[0], model.zones[1]),
            )
    return reports


def sign(u: Array, q_dot: Array, rate: float) -> int:
    """That of velocities (T,) under positive commands; 0: not clear.

    Both are means over a second, because fast sines fit reversed as well.
    """
    second = np.ones(round(rate)) / round(rate)
    agreement = np.convolve(u, second, "same") @ np.convolve(q_dot, second, "same")
    clear = abs(agreement) > CLEAR_SIGN * np.linalg.norm(u) * np.linalg.norm(q_dot)
    return int(np.sign(agreement)) if clear else 0


def followed_joints(log: Log, samples: Samples, j: int) -> dict[str, float]:
    """Joints with which joint `j` moves at their speed while it has no commands, and the slopes."""
    second = np.ones(round(log.rate))
    recent = np.convolve(np.abs(samples.u[:, j]) > COMMANDED, second)[: len(samples.u)]
    q_dot = np.where(recent[:, None] == 0, samples.q_dot, 0.0)
    power = np.square(q_dot).sum(axis=0)
    slopes = q_dot.T @ q_dot[:, j] / np.maximum(power, 1e-12)
    errors = np.where(q_dot != 0, q_dot[:, [j]] - slopes * q_dot, 0.0)
    close = np.square(errors).sum(axis=0) < (1 - FOLLOWS) * slopes**2 * power
    follows = close & (np.abs(slopes) > FOLLOWS) & (np.arange(len(slopes)) != j)
    return {log.joints[i]: float(slopes[i]) for i in np.flatnonzero(follows)}


class Motion(NamedTuple):
    """Samples of one joint, recordings one after the other, with a rest in between, (T,)."""

    u: Array
    velocity: Array  # over the coming sample [rad/s]
    counts: NDArray[np.bool_]  # not in a rest, nor at an end of the range
    rate: float  # Hz


def motion_of(recordings: list[Recording], j: int, rate: float) -> Motion:
    """Joint `j` of recordings that begin at rest."""
    rest = (0, round(PAUSE * rate))
    u = np.concatenate([np.pad(one.u[:, j], rest) for one in recordings])
    q = np.concatenate([np.pad(one.q[:, j], rest, "edge") for one in recordings])
    counts = np.concatenate([np.pad(np.ones(len(one.u), bool), rest) for one in recordings])
    q_next, margin = np.append(q[1:], q[-1]), AT_STOP * np.ptp(q)
    counts &= (q_next > q.min() + margin) & (q_next < q.max() - margin)
    return Motion(u, (q_next - q) * rate * counts, counts, rate)


class Model(NamedTuple):
    """The model that explains a joint's motion best."""

    explained: float  # part of the velocities' power
    lag: tuple[int, float]  # delay [samples] and tau [s]
    zones: Array  # dead zones up and down, of full command, (2,)
    gains: Array  # rad/s per command beyond them, (2,)


def fit_model(motion: Motion) -> Model:
    """A grid of delays and lags, then one of dead zones, twice."""
    lags = list(product(range(round(LATEST * motion.rate) + 1), TAUS))
    zones = np.array([0.05, 0.05])
    for _ in range(2):
        best = max((with_gains(motion, lag, zones) for lag in lags), key=lambda one: one.explained)
        for side in (0, 1):
            trials = [np.where(np.arange(2) == side, zone, zones) for zone in ZONES]
            models = (with_gains(motion, best.lag, trial) for trial in trials)
            best = max(models, key=lambda one: one.explained)
            zones = best.zones
    return best


def with_gains(motion: Motion, lag: tuple[int, float], zones: Array) -> Model:
    """The model with the best gains; without motion it explains nothing."""
    x = responses(motion, lag, zones)[:, motion.counts]
    velocity = motion.velocity[motion.counts]
    gains = np.linalg.solve(x @ x.T + 1e-9 * np.eye(2), x @ velocity)
    error, power = velocity - gains @ x, float(velocity @ velocity)
    explained = 1 - float(error @ error) / power if power else 0.0
    return Model(explained, lag, zones, gains)


def responses(motion: Motion, lag: tuple[int, float], zones: Array) -> Array:
    """Velocities (2, T) upwards and downwards if the gains are 1."""
    (delay, tau), (up, down) = lag, zones
    late = np.concatenate([np.zeros(delay), motion.u])[: len(motion.u)]
    openings = np.stack([np.maximum(late - up, 0), -np.maximum(-late - down, 0)])
    a = np.exp(-1 / (motion.rate * tau))
    return np.asarray(lfilter([1 - a], [1, -a], openings))


def contradicts(motion: Motion, model: Model) -> bool:
    """Does a joint move against what the model expects of its commands?"""
    expected = model.gains @ responses(motion, model.lag, model.zones)
    size = np.linalg.norm(expected) * np.linalg.norm(motion.velocity)
    return bool(expected @ motion.velocity < -OPPOSITE * size)


def wrong_signs(reports: Mapping[str, JointReport]) -> Iterator[str]:
    """Joints whose angle falls under positive commands in all recordings or in some, in words."""
    for name, report in reports.items():
        wanted = f"u_{name}: expected positive commands to raise q_{name}"
        if report.sign < 0:
            yield f"{wanted}, got falling angles (--map {name}=COLUMN:-1)"
        if report.opposite:
            yield f"{wanted} in all recordings or in none, got some in {brief(report.opposite)}"


def warnings(
    log: Log, reports: Mapping[str, JointReport], machine: Machine | None
) -> Iterator[str]:
    """What a log lacks, and where it contradicts the range of the machine that it should be of."""
    yield from log.warnings
    yield from wrong_signs(reports)
    for name in log.joints:
        if name not in reports:
            yield f"{name}: expected commands in the log, got none"
    joints = {joint.name: joint for joint in machine.joints} if machine else {}
    for name, r in reports.items():
        if r.minutes < LEAST_MINUTES:
            yield f"{name}: expected {LEAST_MINUTES:g} minutes, got {r.minutes:.1f}"
        if r.follows:
            slopes = ", ".join(f"{slope:+.2f} times with {one}" for one, slope in r.follows.items())
            doubt = "is it an angle to the ground? Then take differences of both angles"
            yield f"q_{name}: expected rest without commands, got motion {slopes}: {doubt}"
        elif r.explained < LEAST_EXPLAINED or r.delay > LATEST - 0.51 / log.rate:
            got = f"{r.explained:.0%}, {r.delay:.2f} s later: of another joint, or another clock?"
            yield f"{name}: expected {LEAST_EXPLAINED:.0%} of its motion by its commands, got {got}"
        if joint := joints.get(name):
            low, high, got = joint.q_min, joint.q_max, f"{r.low:.2f} to {r.high:.2f}"
            if max(low - r.low, r.high - high) > BEYOND * (high - low):
                doubt = f"another unit (--map {name}=COLUMN:deg), zero or joint?"
                yield f"q_{name}: expected {low:g} to {high:g}, got {got}: {doubt}"
            elif r.high - r.low < LEAST_RANGE * (high - low):
                yield f"{name}: expected {LEAST_RANGE:.0%} of its range or more, got {got}"


def table(reports: Mapping[str, JointReport]) -> Iterator[str]:
    """What a log tells of each joint, and fields of `Joint` by it, to copy into a machine."""
    for name, r in reports.items():
        told = f"{r.minutes:.1f} minutes, sign {r.sign:+d}, {r.explained:.0%} explained"
        yield f"{name}: {told}, delay {r.delay:.2f} s"
        limits = f"q_min={r.low:.3f}, q_max={r.high:.3f}"
        speeds = "q_dot_up={:.3f}, q_dot_down={:.3f}".format(*r.fastest)
        zones = "dead_zone=({:.3f}, {:.3f})".format(*r.dead_zone)
        yield f'Joint("{name}", {limits}, {speeds}, {zones}, ...)'
