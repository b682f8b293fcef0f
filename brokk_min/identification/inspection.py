"""What a log tells of its machine before any fit, joint by joint, and where it is not enough.

A small model explains the velocity of a joint: its command, later by a delay, less the dead zone,
times a gain, through a first-order lag:

    q_dot' = (g_up max(u(t - d) - z_up, 0) - g_down max(-u(t - d) - z_down, 0) - q_dot) / tau

A grid gives delay, lag and dead zones, and least squares give the gains. Samples at the ends of the
recorded range do not count, because a joint that is pushed against its stop stands still.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.signal import lfilter

from brokk_min.identification.logs import COMMANDED, Log, Recording, driven
from brokk_min.machine import Array, Machine

# What the model searches, all assumed.
LATEST = 0.4  # s, longest delay
TAUS = (0.05, 0.1, 0.2, 0.4)  # s
ZONES = 0.01 * np.arange(61)  # dead zones, of full command
AT_STOP = 0.01  # of the recorded range: so near its end a joint may be at a stop
PAUSE = 2.0  # s, after so long a joint without commands is at rest
SAMPLES = 20_000  # of a joint that are used
CLEAR_SIGN = 0.2  # of the velocities' power: fast sines fit as well if reversed and later
# The fastest motion, all assumed.
NEAR_LIMIT = 0.15  # commands that are so much less or more than the limit are at it
HELD = 0.5  # s, after so long a joint has its speed
FASTEST = 0.95  # quantile of the speeds, because the single ones have noise
# What a log must have, all assumed.
LEAST_MINUTES = 10.0
LEAST_RANGE = 0.7  # of a joint's range
LEAST_EXPLAINED = 0.1  # of a joint's motion by its commands
BEYOND = 0.05  # of a joint's range, outside of it


@dataclass(frozen=True)
class JointReport:
    """One joint of a log; pairs are up and down, commands of full command."""

    minutes: float  # in recordings in which it has commands
    low: float  # rad, smallest angle
    high: float  # rad
    explained: float  # part of the velocities' power that the model explains
    sign: int  # of the velocity under a positive command; 0: not clear
    delay: float  # s
    tau: float  # s
    dead_zone: tuple[float, float]
    gain: tuple[float, float]  # rad/s per command beyond the dead zone; 0: it never moved so
    fastest: tuple[float, float]  # rad/s at the command limit; by the model if none was held there


def inspect(log: Log, limit: float = 1.0) -> dict[str, JointReport]:
    """A report of each joint that is driven in a log; `limit` is that of its commands, to 1."""
    reports = {}
    for j, name in enumerate(log.joints):
        recordings = [one for one in log.recordings if driven(one)[j]]
        if recordings:
            ticks = sum(len(one.u) for one in recordings if np.ptp(one.u[:, j]) > COMMANDED)
            q = np.concatenate([one.q[:, j] for one in recordings])
            model = fit_model(motion_of(recordings, j, log.rate))
            speeds = [fastest(recordings, j, sign * limit, log.rate) for sign in (1, -1)]
            up, down = np.multiply(model["gain"], np.maximum(limit - model["dead_zone"], 0))
            reports[name] = JointReport(
                minutes=ticks / log.rate / 60,
                low=float(q.min()),
                high=float(q.max()),
                fastest=(speeds[0] or float(up), speeds[1] or float(down)),
                **model | {"dead_zone": tuple(model["dead_zone"].tolist())},
            )
    return reports


def fastest(recordings: list[Recording], j: int, command: float, rate: float) -> float:
    """Fastest motion [rad/s] after `HELD` near a command, of the sign of it; 0: never held."""
    held = round(HELD * rate) + 1
    speeds = [
        one.q_dot[held - 1 :, j][(np.abs(u / command - 1) < NEAR_LIMIT).all(axis=-1)]
        for one in recordings
        if len(one.u) >= held
        for u in [sliding_window_view(one.u[:, j], held)]
    ]
    found = np.concatenate([np.zeros(0), *speeds])
    return float(np.quantile(np.sign(command) * found, FASTEST)) if len(found) else 0.0


class Motion(NamedTuple):
    """Samples of one joint, recordings one after the other, with a rest in between."""

    u: Array  # (T,)
    velocity: Array  # over the coming sample [rad/s], (T,)
    counts: NDArray[np.bool_]  # not in a rest, nor at an end of the range, (T,)
    rate: float  # Hz


def motion_of(recordings: list[Recording], j: int, rate: float) -> Motion:
    """Joint `j` of recordings that begin at rest; of a long log the first part of each."""
    share = min(1.0, SAMPLES / sum(len(one.u) for one in recordings))
    lengths = [int(np.ceil(share * len(one.u))) for one in recordings]
    rest, cut = (0, round(PAUSE * rate)), list(zip(recordings, lengths, strict=True))
    u = np.concatenate([np.pad(one.u[:num, j], rest) for one, num in cut])
    q = np.concatenate([np.pad(one.q[:num, j], rest, "edge") for one, num in cut])
    counts = np.concatenate([np.pad(np.ones(num, bool), rest) for num in lengths])
    q_next, margin = np.append(q[1:], q[-1]), AT_STOP * np.ptp(q)
    counts &= (q_next > q.min() + margin) & (q_next < q.max() - margin)
    return Motion(u, (q_next - q) * rate, counts, rate)


def fit_model(motion: Motion) -> dict[str, Any]:
    """The model's fields of `JointReport`, with gains of the sign that explains more.

    A log explains little if its joint hardly moves; then the sign is 0.
    """
    power = float(np.square(motion.velocity[motion.counts]).sum())
    models = {sign: best_model(motion, sign) for sign in (1, -1)}
    errors = {sign: model.pop("error") for sign, model in models.items()}
    better = (errors[-1] - errors[1]) / max(power, 1e-12)
    sign = 1 if better > -CLEAR_SIGN else -1
    explained = 1 - errors[sign] / power if power else 0.0
    clear = int(np.sign(better)) if abs(better) > CLEAR_SIGN else 0
    return {"explained": explained, "sign": clear, **models[sign]}


def best_model(motion: Motion, sign: int) -> dict[str, Any]:
    """The model with gains of one sign: a grid of delays and lags, and of dead zones, in turns."""
    lags = list(product(range(round(LATEST * motion.rate) + 1), TAUS))
    zones = np.array([0.05, 0.05])
    for _ in range(2):
        lag = min(lags, key=lambda lag: fit_gains(motion, sign, lag, zones)[0])
        for side in (0, 1):
            trials = [np.where(np.arange(2) == side, zone, zones) for zone in ZONES]
            zones = min(trials, key=lambda trial: fit_gains(motion, sign, lag, trial)[0])
    error, gains = fit_gains(motion, sign, lag, zones)
    pairs = {"dead_zone": zones.round(3), "gain": tuple(gains.tolist())}
    return {"error": error, "delay": lag[0] / motion.rate, "tau": lag[1], **pairs}


def fit_gains(
    motion: Motion, sign: int, lag: tuple[int, float], zones: Array
) -> tuple[float, Array]:
    """Sum of the squared errors of the model with the best gains (2,) of a sign; these gains."""
    (delay, tau), (up, down) = lag, zones
    late = np.concatenate([np.zeros(delay), motion.u])[: len(motion.u)]
    openings = np.stack([np.maximum(late - up, 0), -np.maximum(-late - down, 0)])
    a = np.exp(-1 / (motion.rate * tau))
    x = lfilter([1 - a], [1, -a], openings)[:, motion.counts]
    velocity = motion.velocity[motion.counts]
    gains = np.linalg.solve(x @ x.T + 1e-9 * np.eye(2), x @ velocity)
    gains = sign * np.maximum(sign * gains, 0)
    error = velocity - gains @ x
    return float(error @ error), gains


def wrong_signs(reports: Mapping[str, JointReport]) -> list[str]:
    """Joints whose angle falls under positive commands, in words."""
    wanted = "expected positive commands to raise"
    return [
        f"u_{name}: {wanted} q_{name}, got {report.gain[0]:.2f} rad/s per full opening"
        for name, report in reports.items()
        if report.sign < 0
    ]


def warnings(log: Log, reports: Mapping[str, JointReport], machine: Machine | None) -> list[str]:
    """What a log lacks, and where it contradicts the range of the machine that it should be of."""
    result = wrong_signs(reports)
    for name in log.joints:
        if name not in reports:
            result.append(f"{name}: expected commands in the log, got none")
            continue
        r = reports[name]
        if r.minutes < LEAST_MINUTES:
            result.append(f"{name}: expected {LEAST_MINUTES:g} minutes, got {r.minutes:.1f}")
        if r.explained < LEAST_EXPLAINED:
            got = f"{r.explained:.0%}: are they those of another joint?"
            result.append(f"{name}: expected commands that explain its motion, got {got}")
        if not machine:
            continue
        joint = machine.joints[machine.names.index(name)]
        whole, part = joint.q_max - joint.q_min, r.high - r.low
        if max(joint.q_min - r.low, r.high - joint.q_max) > BEYOND * whole:
            wanted = f"{name}: expected angles of {joint.q_min:g} to {joint.q_max:g}"
            got = f"{r.low:.2f} to {r.high:.2f}"
            result.append(f"{wanted}, got {got}: another unit, zero or joint?")
        elif part < LEAST_RANGE * whole:
            wanted = f"{LEAST_RANGE:.0%} of its range or more"
            result.append(f"{name}: expected {wanted}, got {part / whole:.0%}")
    return result


def table(reports: Mapping[str, JointReport]) -> list[str]:
    """Lines of what a log tells, and fields of `Joint` by it, to copy into a machine."""
    row = "{:12} {:>7} {:>4} {:>9} {:>9}  {:8} {}"
    lines = [row.format("joint", "minutes", "sign", "explained", "delay [s]", "gain up", "down")]
    for name, r in reports.items():
        numbers = (f"{r.minutes:.1f}", f"{r.sign:+d}", f"{r.explained:.0%}", f"{r.delay:.2f}")
        lines.append(row.format(name, *numbers, *(f"{gain:.3f}" for gain in r.gain)))
    for name, r in reports.items():
        limits = f"q_min={r.low:.3f}, q_max={r.high:.3f}"
        speeds = "q_dot_up={:.3f}, q_dot_down={:.3f}".format(*r.fastest)
        zones = "dead_zone=({:.3f}, {:.3f})".format(*r.dead_zone)
        lines.append(f'Joint("{name}", {limits}, {speeds}, {zones}, ...)')
    return lines
