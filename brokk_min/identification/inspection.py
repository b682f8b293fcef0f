"""What a log tells of its machine before any fit, joint by joint, and where it is not enough.

A small model explains the velocity of a joint: its command, later by a delay, less the dead zone,
times a gain, through a first-order lag:

    q_dot' = (g_up max(u(t - d) - z_up, 0) - g_down max(-u(t - d) - z_down, 0) - q_dot) / tau

A grid gives delay, lag and dead zones, and least squares give the gains. Samples at the ends of the
recorded range do not count, because a joint that is pushed against its stop stands still.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.signal import lfilter

from brokk_min.identification.logs import COMMANDED, Log, Recording, driven
from brokk_min.machine import Array, Joint, Machine

# What the model searches, all assumed.
LATEST = 0.4  # s, longest delay
TAUS = (0.05, 0.1, 0.2, 0.4)  # s
COARSE = 0.02 * np.arange(36)  # dead zones, of full command
FINE = 0.005 * np.arange(-3, 4)  # around the best of these
AT_STOP = 0.01  # of the recorded range: so near its end a joint may be at a stop
PAUSE = 2.0  # s, after so long a joint without commands is at rest
SETTLED = 0.7  # s after a gap, because what was commanded in the gap is not known
SAMPLES = 20_000  # of a joint that are used
CLEAR_SIGN = 0.2  # of the velocities' power: fast sines fit as well if reversed and later
# The fastest motion, all assumed.
NEAR_LIMIT = 0.15  # commands that are so much less or more than the limit are at it
HELD = 0.5  # s, after so long a joint has its speed
FASTEST = 0.95  # quantile of the speeds, because the single ones have noise
LEAST_HELD = 20  # samples at the limit; with fewer, the model gives the fastest motion
# What a log must have, all assumed.
LEAST_MINUTES = 10.0
LEAST_RANGE = 0.7  # of a joint's range
LEAST_EXPLAINED = 0.1  # of a joint's motion by its commands
WIDER = 0.03  # of full command, above the error of the model's dead zones
BEYOND = 0.05  # of a joint's range, outside of it
FASTER = 5.0  # times as fast as the machine: probably in another unit


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
    fastest: tuple[float, float]  # rad/s at the command limit


def inspect(log: Log, limit: float = 1.0) -> dict[str, JointReport]:
    """A report of each joint that is driven in a log; `limit` is that of its commands, to 1."""
    reports = {}
    for j, name in enumerate(log.joints):
        recordings = [one for one in log.recordings if driven(one)[j]]
        if recordings:
            ticks = sum(len(one.u) for one in recordings if np.ptp(one.u[:, j]) > COMMANDED)
            q = np.concatenate([one.q[:, j] for one in recordings])
            motion = motion_of(recordings, j, log.rate)
            model = fit_model(motion)
            reports[name] = JointReport(
                minutes=ticks / log.rate / 60,
                low=float(q.min()),
                high=float(q.max()),
                fastest=fastest(motion, limit, model),
                **model,
            )
    return reports


def fastest(motion: "Motion", limit: float, model: Mapping[str, Any]) -> Any:
    """Fastest motion [rad/s] up and down, after commands held at the limit.

    Where too few commands are held there, it is what the model gives.
    """
    held = round(HELD * motion.rate) + 1
    commands = sliding_window_view(motion.u, held)
    result = []
    for sign, zone, gain in zip((1, -1), model["dead_zone"], model["gain"], strict=True):
        at_limit = (np.abs(sign * commands / limit - 1) < NEAR_LIMIT).all(axis=-1)
        speeds = sign * motion.q_dot[held - 1 :][at_limit]
        measured = len(speeds) >= LEAST_HELD
        result.append(np.quantile(speeds, FASTEST) if measured else gain * max(limit - zone, 0))
    return tuple(map(float, result))


# --- the model ------------------------------------------------------------------------------------


class Motion(NamedTuple):
    """Samples of one joint, recordings one after the other, with a rest in between."""

    u: Array  # (T,)
    q_dot: Array  # of the log [rad/s], (T,)
    velocity: Array  # over the coming sample [rad/s], (T,)
    counts: NDArray[np.bool_]  # not in a rest, nor after a gap, nor at an end of the range, (T,)
    rate: float  # Hz


def motion_of(recordings: list[Recording], j: int, rate: float) -> Motion:
    """Joint `j` of recordings that begin at rest or after a gap; of a long log the first part."""
    share = min(1.0, SAMPLES / sum(len(one.u) for one in recordings))
    rest = (0, round(PAUSE * rate))
    parts = []
    for one in recordings:
        num = int(np.ceil(share * len(one.u)))
        counts = np.arange(num) >= (SETTLED * rate if "#" in one.name else 0)
        u, q, q_dot = (x[:num, j] for x in one[1:])
        padded = (np.pad(x, rest) for x in (u, q_dot, counts))
        parts.append((np.pad(q, rest, "edge"), *padded))
    q, u, q_dot, counts = map(np.concatenate, zip(*parts, strict=True))
    q_next, margin = np.append(q[1:], q[-1]), AT_STOP * np.ptp(q)
    counts &= (q_next > q.min() + margin) & (q_next < q.max() - margin)
    return Motion(u, q_dot, (q_next - q) * rate, counts, rate)


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
    """The model with gains of one sign: a grid of delays and lags, and dead zones, in turns."""
    lags = list(product(range(round(LATEST * motion.rate) + 1), TAUS))
    zones = np.array([0.05, 0.05])
    for _ in range(2):
        delay, tau = min(lags, key=lambda lag: fit_gains(motion, sign, lag[0], lag[1], zones)[0])
        zones = best_zones(partial(fit_gains, motion, sign, delay, tau), zones)
    error, gains = fit_gains(motion, sign, delay, tau, zones)
    pairs = {"dead_zone": tuple(zones.round(3).tolist()), "gain": tuple(gains.tolist())}
    return {"error": error, "delay": delay / motion.rate, "tau": tau, **pairs}


def best_zones(fit: Callable[[Array], tuple[float, Array]], zones: Array) -> Array:
    """Dead zones (2,), in turns: each of a coarse grid, then of a fine one around its best."""
    for side in (0, 1, 0, 1):
        for around, steps in ((0, COARSE), (1, FINE)):
            values = np.maximum(around * zones[side] + steps, 0)
            trials = [np.where(np.arange(2) == side, value, zones) for value in values]
            zones = min(trials, key=lambda trial: fit(trial)[0])
    return zones


def fit_gains(
    motion: Motion, sign: int, delay: int, tau: float, zones: Array
) -> tuple[float, Array]:
    """Sum of the squared errors of the model with the best gains (2,) of a sign; these gains."""
    up, down = zones
    late = np.concatenate([np.zeros(delay), motion.u])[: len(motion.u)]
    openings = np.stack([np.maximum(late - up, 0), -np.maximum(-late - down, 0)])
    a = np.exp(-1 / (motion.rate * tau))
    x = lfilter([1 - a], [1, -a], openings)[:, motion.counts]
    velocity = motion.velocity[motion.counts]
    gains = np.linalg.solve(x @ x.T + 1e-9 * np.eye(2), x @ velocity)
    gains = sign * np.maximum(sign * gains, 0)
    error = velocity - gains @ x
    return float(error @ error), gains


# --- what to make of it ---------------------------------------------------------------------------


def wrong_signs(reports: Mapping[str, JointReport]) -> list[str]:
    """Joints whose angle falls under positive commands, in words."""
    wanted = "expected positive commands to raise"
    return [
        f"u_{name}: {wanted} q_{name}, got {report.gain[0]:.2f} rad/s per full opening"
        for name, report in reports.items()
        if report.sign < 0
    ]


def warnings(log: Log, reports: Mapping[str, JointReport], machine: Machine | None) -> list[str]:
    """What a log lacks, and where it contradicts the machine that it should be of."""
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
        if r.delay > LATEST - 1 / log.rate:
            wanted = f"below {LATEST:g} s, the longest that is searched"
            result.append(f"{name}: delay: expected {wanted}, got {r.delay:.2f} s or more")
        if machine:
            joint = machine.joints[machine.names.index(name)]
            result += [f"{name}: {text}" for text in contradictions(r, joint)]
    return result


def contradictions(report: JointReport, joint: Joint) -> Iterator[str]:
    """Fields of a joint that its log contradicts, in words."""
    whole = joint.q_max - joint.q_min
    beyond = max(joint.q_min - report.low, report.high - joint.q_max) / whole
    part = (report.high - report.low) / whole
    if beyond > BEYOND:
        wanted, got = (
            f"{joint.q_min:g} to {joint.q_max:g}",
            f"{report.low:.2f} to {report.high:.2f}",
        )
        yield f"expected angles of {wanted}, got {got}: another unit, zero or joint?"
    elif part < LEAST_RANGE:
        yield f"expected {LEAST_RANGE:.0%} of its range or more, got {part:.0%}"
    if report.explained < LEAST_EXPLAINED or report.sign < 0:
        return
    for i, (side, nominal) in enumerate((("up", joint.q_dot_up), ("down", joint.q_dot_down))):
        zone, now = report.dead_zone[i], joint.dead_zone[i]
        if report.gain[i] and now > zone + WIDER:
            yield f"dead_zone {side}: expected about {zone:.3f} by this log, got {now:g}"
        if report.gain[i] and not 1 / FASTER < report.fastest[i] / nominal < FASTER:
            wanted = f"expected about {report.fastest[i]:.3g} by this log"
            yield f"q_dot_{side}: {wanted}, got {nominal:g}: time in s, angles in rad?"


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
