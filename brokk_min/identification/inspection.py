"""What a log tells of its machine before any fit, joint by joint, by the model of `joint_model`."""

from collections import Counter
from collections.abc import Sequence
from itertools import compress
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import maximum_filter1d
from tqdm import tqdm

from brokk_min.fit import COMMANDED, MOVED, Log, Recording, Samples, join_recordings, moving
from brokk_min.identification.joint_model import (
    LATEST,
    OPENS,
    TELLING,
    ZONES,
    Model,
    Motion,
    Pair,
    best_lag,
    earlier,
    expected_velocity,
    explained_part,
    fit_model,
    means,
    motion_of,
    reach,
    responses,
    with_gains,
)
from brokk_min.machine import Array, Machine

# Bounds, all assumed.
AGAINST = 0.4  # least correlation with the other sign of what is expected
AROUND = 20.0  # s around a command, in which a joint is driven
CLEAR_SIGN = 0.1  # least correlation that has a clear sign
OPPOSITE = 0.2  # the same of one recording; of sound ones of ours down to -0.11
FASTEST = 0.999  # quantile of the speeds, because the single ones have noise
COARSE = 0.5  # s
CLEAR = 0.2  # of the fastest expected motion: more is clear
RESTS = 0.1  # of the expected motion: less is rest
STILL = 1.5  # s of clear commands without motion; in sound logs of ours up to 1.15, and
USUALLY, SOUND = 4.0, 0.6  # so many times the quantile of the log's, of sound ones up to 3.1
SEVERAL = 5  # recordings tell what is usual
AT_LEAST = (0.9, 0.45)  # s, if less or more of the motion is explained than
WELL = 0.9  # as without noise, without coarse steps, and where valves open at once
SHORTEST = 5.0  # s, of a recording whose sign is looked at
RESTING, LONG = 0.1, 10.0  # of the samples, and s, in which a joint must rest to tell its command
BETTER, NEARLY = 0.15, 0.92  # more by other gains, and all; of sound recordings never over 0.89
MUCH_BETTER = 0.27  # more by another delay; of sound sines up to 0.22
LEAST_MOTION = 0.1  # of the fastest, in a recording that tells its scale and delay
SAME, ROUNDED = 20, 1e-3  # samples of the same commands, and rad, up to which motion is the same
LEAST_EXPLAINED = 0.6  # of a joint's motion by its commands; of sound logs of ours 0.84
FOLLOWS = 0.8  # of a joint's motion without commands, that another joint explains


class JointReport(NamedTuple):
    """One joint of a log; pairs are up and down."""

    minutes: float  # in which it has commands, with pauses of some seconds
    low: float  # rad, smallest angle
    high: float  # rad
    fastest: Pair  # rad/s, of the velocities in the log
    largest: Pair  # commands, of full command
    sign: int  # of the velocity under a positive command; 0: not clear
    explained: float  # part of the velocities' power that the model explains
    coarse: float  # the same of means over half a second, in which noise and steps do not count
    delay: float  # s
    tau: float  # s
    dead_zone: Pair  # of full command; nan: no command opens the valve that way
    step: float  # rad, by which its angle usually changes in a tick, if it does
    by_zones: float  # part that it explains with the machine's dead zones; 1 if these are unknown
    still: list[str]  # recordings in which commands do not move it; all else is without them
    opposite: list[str]  # recordings in which the sign is not that of most of them
    follows: dict[str, float]  # rad/s per rad/s of joints with which it moves without commands
    other: str = ""  # the joint whose commands explain its motion
    idle: tuple[str, ...] = ()  # recordings in which it moves without commands
    rest: float = 0.0  # the command at which it rests, if that is clearly not 0
    one_size: bool = False  # are all commands in a direction of one size?
    scaled: tuple[str, ...] = ()  # recordings that another scale of commands explains better
    later: tuple[str, ...] = ()  # and another delay
    early: float = 0.0  # s, by which it moves before its commands, if that explains more


def inspect(log: Log, machine: Machine | None = None) -> dict[str, JointReport]:
    """A report of each joint that is driven in a log, perhaps of a machine that is known."""
    reports, samples = {}, join_recordings(log)
    for j, name in enumerate(tqdm(log.joints, desc="inspect", unit="joint", disable=None)):
        recordings = [one for one in log.recordings if moving(one)[j]]
        zones = machine.joints[machine.names.index(name)].dead_zone if machine else None
        if recordings:
            follows = followed_joints(log, samples, j)
            reports[name] = inspect_joint(log, recordings, j, zones)._replace(follows=follows)
    return reports


def inspect_joint(log: Log, recordings: list[Recording], j: int, zones: Pair | None) -> JointReport:
    """The report of joint `j`, by recordings in which it has commands or moves.

    `zones` are the dead zones of the machine. What the joint follows is not looked at.
    """
    rate = log.rate
    u, q = (np.concatenate([x[:, j] for x in of]) for of in list(zip(*recordings))[1:3])
    turned = opposite(recordings, j, rate)
    others = [one for one in recordings if one.name not in turned]
    angles = np.concatenate([one.q[:, j] for one in others])
    span = (angles.min(), angles.max())
    each = [motion_of([one], j, rate, span) for one in others]
    kept, motion, model, still = without_still(others, each, j, rate, span)
    q_dot = np.concatenate([one.q_dot[:, j] for one in kept])
    steps = np.abs(np.diff(q))
    switched = one_size(u)
    opens = (model.gains != 0) & (model.zones < ZONES[-1]) & (not switched)
    dead_zone = np.where(opens, model.zones, np.nan)
    by = {
        name: fit_model(motion_of(kept, j, rate, span, i)).explained
        for i, name in enumerate(log.joints)
        if i != j and model.explained < LEAST_EXPLAINED
    }
    other = max(by, key=lambda name: by[name], default="")
    driven = sum(
        (maximum_filter1d(np.abs(one.u[:, j]), round(AROUND * rate)) > COMMANDED).sum()
        for one in recordings
        if np.ptp(one.u[:, j]) > COMMANDED
    )
    strong = LEAST_MOTION * np.abs(motion.velocity).max()
    parts = ((one, motion_of([one], j, rate, span)) for one in kept)
    alone = [
        (one, part) for one, part in parts if part.counts.sum() > LONG * rate and rms(part) > strong
    ]
    second = means(every := motion_of(recordings, j, rate, span), every.u, 1.0)
    coarse = (means(motion, x, COARSE) for x in (motion.velocity, expected_velocity(motion, model)))
    return JointReport(
        minutes=driven / rate / 60,
        low=q.min(),
        high=q.max(),
        fastest=(np.quantile(q_dot, FASTEST), np.quantile(-q_dot, FASTEST)),
        largest=(second.max(), -second.min()),
        sign=sign(np.concatenate([one.u[:, j] for one in kept]), q_dot, rate)
        * (model.explained > TELLING),
        explained=model.explained,
        coarse=explained_part(*coarse),
        delay=model.lag[0] / rate,
        tau=model.lag[1],
        dead_zone=(dead_zone[0], dead_zone[1]),
        step=float(np.median(steps[steps > 0])) if steps.any() else 0.0,
        by_zones=best_lag(motion, np.array(zones)).explained if zones else 1.0,
        still=[] if switched and len(still) < len(recordings) else still,
        opposite=[
            one.name
            for one in recordings
            if one.name in turned or contradicts(motion_of([one], j, rate, span), model)
        ],
        follows={},
        other=other if by.get(other, 0) > LEAST_EXPLAINED else "",
        idle=idle(recordings, j, rate),
        rest=rest_of(motion_of(list(log.recordings), j, rate, span)),
        one_size=switched,
        early=earlier(motion, model),
        scaled=tuple(one.name for one, part in alone if another_scale(part, model)),
        later=tuple(one.name for one, part in alone if another_delay(part, model)),
    )


def rms(motion: Motion) -> float:
    """The root of the mean square of the velocities that count [rad/s]."""
    return float(np.sqrt(np.square(motion.velocity).sum() / motion.counts.sum()))


def another_scale(motion: Motion, model: Model) -> bool:
    """Do other gains explain nearly all of a motion, and those of the model clearly less?"""
    own = with_gains(motion, model.lag, model.zones, responses(motion, model.lag[1], model.zones))
    given = explained_part(motion.velocity, expected_velocity(motion, model))
    return own.explained > max(given + BETTER, NEARLY)


def another_delay(motion: Motion, model: Model) -> bool:
    """Does another delay explain much more of a motion? Slow and single sines fit several."""
    delays = range(round(LATEST * motion.rate) + 1)
    lags = [model._replace(lag=(delay, model.lag[1])) for delay in delays]
    parts = [explained_part(motion.velocity, expected_velocity(motion, of)) for of in lags]
    return max(parts) > max(parts[model.lag[0]] + MUCH_BETTER, LEAST_EXPLAINED)


def sign(u: Array, q_dot: Array, rate: float, least: float = CLEAR_SIGN) -> int:
    """That of velocities (T,) under positive commands; 0: not clear.

    Both are means over a second, because fast sines fit reversed as well.
    """
    second = np.ones(round(rate)) / round(rate)
    agreement = np.convolve(u, second, "same") @ np.convolve(q_dot, second, "same")
    clear = abs(agreement) > least * np.linalg.norm(u) * np.linalg.norm(q_dot)
    return int(np.sign(agreement)) if clear else 0


def opposite(recordings: Sequence[Recording], j: int, rate: float) -> list[str]:
    """Names of the recordings in which joint `j` moves the other way than in most of them."""
    names, signs = [], []
    for one in recordings:
        u, q, q_dot = one.u[:, j], one.q[:, j], one.q_dot[:, j]
        if len(u) > SHORTEST * rate and np.ptp(u) > COMMANDED and np.ptp(q) > MOVED:
            names.append(one.name)  # less the means, because a joint may sag all the time
            signs.append(sign(u - u.mean(), q_dot - q_dot.mean(), rate, OPPOSITE))
    fewer = -np.sign(sum(signs)) or 1
    return [name for name, way in zip(names, signs) if way == fewer] if -fewer in signs else []


def idle(recordings: Sequence[Recording], j: int, rate: float) -> tuple[str, ...]:
    """Names of the recordings in which joint `j` moves clearly and has no commands."""
    half = round(COARSE * rate)
    each = [np.cumsum(one.q[:, j] - one.q[0, j]) / half for one in recordings]
    # from the mean of half a second to that of the next one, in which noise does not count
    moved = [
        np.abs(x[2 * half :] - 2 * x[half:-half] + x[: -2 * half]).max(initial=0) for x in each
    ]
    silent = [np.abs(one.u[:, j]).max() <= COMMANDED for one in recordings]
    pairs = zip(recordings, silent, np.array(moved) > OPENS * max(moved), strict=True)
    return tuple(one.name for one, no_command, moves in pairs if no_command and moves)


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


def without_still(
    recordings: list[Recording], each: list[Motion], j: int, rate: float, span: Pair
) -> tuple[list[Recording], Motion, Model, list[str]]:
    """Recordings in which joint `j` obeys, its motion in them, their model, and others' names.

    `each` has the motion of each recording alone.
    """
    still = np.array([np.ptp(one.q[:, j]) <= MOVED for one in recordings])
    held = [np.convolve(one.u[:, j], np.ones(round(rate)) / rate, "valid") for one in recordings]
    stuck = still & [min(x.max(), -x.min()) > OPENS for x in held]  # a stop it would leave one way
    for _ in range(4):  # again without those in which it stands still, until they are found
        before = still
        kept = [*compress(recordings, ~still | still.all())]
        motion = motion_of(kept, j, rate, span)
        model = fit_model(motion)
        seconds = np.array([still_seconds(one, model, motion) for one in each])
        least = AT_LEAST[model.explained > WELL and len(recordings) >= SEVERAL]
        usual = np.quantile(seconds, SOUND, method="lower")
        still = stuck | (seconds > np.clip(USUALLY * usual, least, STILL))
        if still.all() or (still == before).all():
            break
    if model.explained < LEAST_EXPLAINED and not still.all():
        still = stuck  # the model cannot tell where it should move
    return kept, motion, model, [one.name for one in compress(recordings, still)]


def still_seconds(motion: Motion, model: Model, others: Motion) -> float:
    """How long a joint rests in one piece while the model of `others` expects clear motion [s].

    A valve that was closed needs up to a second to open. Infinite: it does not answer at all.
    """
    if not others.velocity.any():
        return np.inf if np.abs(motion.u).max() > OPENS else 0.0
    signed = expected_velocity(motion, model)
    expected = np.abs(signed)
    clear = max(CLEAR * np.abs(expected_velocity(others, model)).max(), MOVED)  # rad/s
    long = (expected > clear).sum() > AT_LEAST[1] * motion.rate
    if long and np.std(motion.velocity) < RESTS * np.std(signed):
        return np.inf  # it may sag, but does not answer
    # ends of a second at rest in which it should go somewhere: short pulses open no valve
    should = reach(motion._replace(velocity=signed * motion.counts)) > clear / 2
    ends = should & (reach(motion) < RESTS * clear)
    rests = np.convolve(ends, np.ones(round(motion.rate)))[-len(ends) :] > 0
    seconds = np.bincount(np.cumsum(~rests), rests & (expected > clear)) / motion.rate
    return float(seconds.max())


def rest_of(motion: Motion) -> float:
    """The command while a joint rests, if it is clearly one, and not 0."""
    calm = reach(motion) < RESTS * np.abs(motion.velocity).max()
    if calm.sum() <= max(RESTING * motion.counts.sum(), LONG * motion.rate):
        return 0.0
    low, usual, high = np.quantile(motion.u[calm], (0.25, 0.5, 0.75))
    return float(usual) if high - low < COMMANDED < abs(usual) else 0.0


def one_size(u: Array) -> bool:
    """Are the commands (T,) of a direction all as large as its largest, as those of a switch?"""
    sides = [side[side > COMMANDED] for side in (u, -u)]
    switched = [(side > 0.98 * side.max()).mean() > 0.9 for side in sides if len(side)]
    return bool(switched) and all(switched)


def contradicts(motion: Motion, model: Model) -> bool:
    """Does a joint move against what the model expects of its commands?

    Where it expects no more than `MOVED`, noise decides the sign.
    """
    expected = expected_velocity(motion, model)
    velocity = motion.velocity - motion.velocity.mean()
    size = np.linalg.norm(expected) * np.linalg.norm(velocity)
    path = np.append(0.0, np.cumsum(expected)) / motion.rate
    clear = np.ptp(path) > MOVED
    return bool(clear and expected @ velocity < -AGAINST * size)


def repeated(recordings: Sequence[Recording], others: Sequence[Recording]) -> list[str]:
    """Names of recordings with the commands and motion of one before them, or of one of others.

    Half of it is enough, and a table may have rounded it. What does not move does not count.
    """
    every, twins = [*others, *recordings], []
    places: dict[int, tuple[int, int]] = {}  # recording and row, by what is commanded from there on
    for i, one in enumerate(every):
        parts = sliding_window_view(one.u.round(4) + 0.0, min(SAME, len(one.u)), axis=0)
        keys = [
            hash(part.tobytes()) if np.ptp(part, axis=-1).max() > COMMANDED else 0 for part in parts
        ]
        found = [(places[key], row) for row, key in enumerate(keys) if key in places]
        shifts = Counter((k, first - row) for (k, first), row in found)
        (k, shift), rows = max(shifts.items(), key=lambda item: item[1], default=((0, 0), 0))
        if rows > sum(map(bool, keys)) / 2 and i >= len(others):
            ours, theirs = one.q[max(-shift, 0) :], every[k].q[max(shift, 0) :]
            n = min(len(ours), len(theirs))
            apart = np.ptp(ours[:n] - theirs[:n], axis=0).max()
            moved = np.ptp(one.q, axis=0).max() > MOVED
            twins += [one.name] if apart < ROUNDED and moved else []
        places |= {key: (i, row) for row, key in enumerate(keys) if key and key not in places}
    return twins
