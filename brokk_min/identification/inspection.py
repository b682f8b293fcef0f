"""What a log tells of its machine before any fit, joint by joint, and where it is not enough.

A small model explains the velocity of a joint: its command, later by a delay, less the dead zone,
times a gain, through a first-order lag:

    q_dot' = (g_up max(u(t - d) - z_up, 0) - g_down max(-u(t - d) - z_down, 0) - q_dot) / tau

A grid gives delay, lag and dead zones, and least squares give the gains. Samples at the ends of the
recorded range do not count, because a joint that is pushed against its stop stands still.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import compress, product
from typing import Any, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike, NDArray
from scipy.signal import lfilter
from tqdm import tqdm

from brokk_min._files import brief
from brokk_min.fit import COMMANDED, MOVED, Log, Recording, Samples, join_recordings, moving
from brokk_min.machine import PWM_MAX, Array, Joint, Machine

# What is searched, all assumed.
LATEST = 0.6  # s, longest delay
TAUS = (0.05, 0.1, 0.2, 0.4)  # s
ZONES = 0.01 * np.arange(61)  # dead zones, of full command
AT_STOP = 0.01  # of the recorded range: so near its end a joint may be at a stop
STAYS = 0.125  # of the time at an end, with commands away from there: it is no stop
MOVES_STOP = 0.1  # of it, by which a stop may be elsewhere in a recording, as after a new zero
AGAINST = 0.4  # least correlation with the other sign of what is expected
PAUSE = 2.0  # s, after so long a joint without commands is at rest
CLEAR_SIGN = 0.1  # least correlation that has a clear sign
OPPOSITE = 0.2  # the same of one recording; of sound ones of ours down to -0.11
FASTEST = 0.999  # quantile of the speeds, because the single ones have noise
COARSE = 0.5  # s
CLEAR = 0.2  # of the fastest expected motion: more is clear
OPENS = 0.3  # of full command: it opens any valve
RESTS = 0.1  # of the expected motion: less is rest
STILL = 1.5  # s of clear commands without motion; in sound logs of ours up to 1.15, and
USUALLY, SOUND = 4.0, 0.6  # so many times the quantile of the log's, of sound ones up to 3.1
SEVERAL = 5  # recordings tell what is usual
AT_LEAST = (0.9, 0.3)  # s, if less or more of the motion is explained than
WELL = 0.9  # as without noise, without coarse steps, and where valves open at once
SHORTEST = 5.0  # s, of a recording whose sign is looked at
STARTS = 1.0  # s at the beginning of one that begins in motion, which do not count
RESTING, LONG = 0.1, 10.0  # of the samples, and s, in which a joint must rest to tell its command
SAME, ROUNDED = 20, 1e-3  # samples of the same commands, and rad, up to which motion is the same
# What a log must have, all assumed.
LEAST_MINUTES = 10.0
TOLD = 0.3  # minutes; less tells no dead zone
LEAST_RANGE = 0.7  # of a joint's range
LEAST_EXPLAINED = 0.6  # of a joint's motion by its commands; of sound logs of ours 0.84
BEYOND = 0.05  # of a joint's range, outside of it
FOLLOWS = 0.8  # of a joint's motion without commands, that another joint explains
COARSER = 0.15  # more of the coarse motion is explained: angles have noise or steps
ZONE = 0.04  # of full command, between the dead zones of machine and log
EARLIER = 0.02  # more of a motion is explained if it begins before its commands
WORSE = 1.25  # times as much is not explained with the machine's dead zones
SMALL = 0.05  # of full command: no machine is driven by less
FASTER, SLOWER = 1.2, 0.4  # of the machine's fastest motion, which are in the log
AT_LIMIT = 0.95  # of the command limit: such commands should give the fastest motion


Pair = tuple[float, float]  # up and down, or low and high


class JointReport(NamedTuple):
    """One joint of a log; pairs are up and down."""

    minutes: float  # in recordings in which it has commands
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
    driven = sum(len(one.u) for one in recordings if np.ptp(one.u[:, j]) > COMMANDED)
    second = means(every := motion_of(recordings, j, rate, span), every.u, 1.0)
    coarse = (means(motion, x, COARSE) for x in (motion.velocity, expected_velocity(motion, model)))
    return JointReport(
        minutes=driven / rate / 60,
        low=q.min(),
        high=q.max(),
        fastest=(np.quantile(q_dot, FASTEST), np.quantile(-q_dot, FASTEST)),
        largest=(second.max(), -second.min()),
        sign=sign(np.concatenate([one.u[:, j] for one in kept]), q_dot, rate),
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
    )


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
    return ahead[best] / motion.rate if parts[best] > model.explained + EARLIER else 0.0


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
    ends = reach(motion) < RESTS * clear  # of a second at rest
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


def wrong_signs(reports: Mapping[str, JointReport]) -> Iterator[str]:
    """Joints whose angle falls under positive commands in all recordings or in some, in words.

    Where commands of joints are mixed up, their signs say nothing.
    """
    mixed = {name for name, r in reports.items() if r.other} | {r.other for r in reports.values()}
    for name, report in reports.items():
        if name in mixed or one_sided(report):
            continue
        wanted = f"u_{name}: expected positive commands to raise q_{name}"
        if report.sign < 0:
            got = f"falling angles (--map {name}=COLUMN:-1 or :-deg; if the angle is right"
            yield f"{wanted}, got {got}, u_{name}=COLUMN:-1; on a bus its encoder_sign)"
        if report.opposite:
            yield f"{wanted} in all recordings or in none, got some in {brief(report.opposite)}"


def resting(reports: Mapping[str, JointReport]) -> set[str]:
    """Recordings in which commands do not move a joint, or are missing: no net must learn them."""
    own = [r for r in reports.values() if not r.other]
    return {name for r in own for name in (*r.still, *(() if r.follows else r.idle))}


Check = tuple[Any, str, str, str]  # if it holds: the place, what was expected there, what it got


def another(name: str, r: JointReport) -> Check:
    """Does a joint move by the commands of another one?"""
    return r.other, name, f"motion by u_{name}", f"motion by u_{r.other}: are columns mixed up?"


def mixed_up(reports: Mapping[str, JointReport]) -> Iterator[str]:
    """Joints that move by the commands of another one, in words."""
    for name, r in reports.items():
        if r.other:
            yield "{1}: expected {2}, got {3}".format(*another(name, r))


def causes(name: str, r: JointReport) -> Iterator[Check]:
    """Why commands do not explain a motion; the first that holds is the one to look at."""
    doubt = "is it an angle to the ground? Then take differences of both angles"
    got = f"motion at so many times the speed of others {r.follows}: {doubt}"
    yield r.follows, f"q_{name}", "rest without commands", got
    yield another(name, r)
    yield one_sided(r), f"u_{name}", "commands of both signs", "one: is the sign in another column?"
    yield r.early, name, "motion after its commands", f"it {r.early:.2f} s before: another clock?"
    got = f"steps of {r.step:.3g} rad (of the encoder, or noise): {r.explained:.0%} of single"
    got = f"{got} ticks and {r.coarse:.0%} of {COARSE} s are explained"
    noise = r.coarse > max(r.explained + COARSER, LEAST_EXPLAINED)
    yield noise, f"q_{name}", "angles finer than the motion in a tick", got
    wanted = f"{LEAST_EXPLAINED:.0%} of its motion by its commands"
    yield r.explained < LEAST_EXPLAINED, name, wanted, f"{r.explained:.0%}"
    wanted = f"motion within {LATEST} s of its commands"
    yield r.delay > LATEST - 1e-9, name, wanted, "it later: another clock?"


def lacks(name: str, r: JointReport) -> Iterator[Check]:
    """What nets could not learn from a log."""
    got = f"rest or other motion in {brief(r.still)} (engine or pump off, blocked, another clock or"
    got = f"{got} column?); figures and nets are of other recordings, if any"
    yield r.still and not r.other, name, "commands to move it", got
    got = f"none in {brief(list(r.idle))}: is the column of another joint, or was it not recorded?"
    got = f"{got} Nets are of other recordings, if any"
    missing = r.idle and not (r.follows or r.other)
    yield missing, f"u_{name}", "commands where it moves", got
    yield r.rest, f"u_{name}", "0 at rest", f"{r.rest:.3g}"
    largest = max(r.largest)
    wanted = "commands in parts of full command, up to 1"
    small = largest < SMALL and not missing
    yield small, f"u_{name}", wanted, f"at most {largest:.2g}: another unit?"
    wanted = "commands of many sizes, because nets cannot guess what is between"
    yield r.one_size, f"u_{name}", wanted, "one in each direction"
    few = round(r.minutes, 1) < LEAST_MINUTES
    yield few, name, f"{LEAST_MINUTES:g} minutes", f"{r.minutes:.1f}"


def differences(name: str, r: JointReport, machine: Machine) -> Iterator[Check]:
    """Where a log contradicts the machine that it should be of."""
    joint = machine.joints[machine.names.index(name)]
    width, got = joint.q_max - joint.q_min, f"{r.low:.2f} to {r.high:.2f}"
    low, high = np.deg2rad([r.low, r.high])
    turned = min(beyond(low, high, joint), beyond(-high, -low, joint)) < BEYOND * width
    turned &= r.high - r.low > 2 * width or max(-r.low, r.high) > 2 * np.pi  # else it would fit
    doubt = f"in degrees (--map {name}=COLUMN:deg, or -deg)" if turned else "another zero or joint"
    mirrored = r.sign < 0 and beyond(-r.high, -r.low, joint) <= BEYOND * width
    outside = not mirrored and beyond(r.low, r.high, joint) > BEYOND * width
    yield outside, f"q_{name}", f"{joint.q_min:g} to {joint.q_max:g}", f"{got}: {doubt}?"
    narrow = r.high - r.low < LEAST_RANGE * width
    yield narrow, name, f"{LEAST_RANGE:.0%} of its range or more", got
    if r.explained <= LEAST_EXPLAINED:
        return
    apart = (np.abs(np.subtract(r.dead_zone, joint.dead_zone)) > ZONE).any()  # not nan
    worse = 1 - r.by_zones > WORSE * (1 - r.explained)
    got = "({:.2f}, {:.2f})".format(*r.dead_zone)
    yield apart and worse, name, f"the machine's dead_zone {joint.dead_zone}", got
    speeds = joint.q_dot_up, joint.q_dot_down
    ratio = np.array(r.fastest) / speeds
    slow = (ratio < SLOWER) & (np.array(r.largest) > AT_LIMIT * machine.pwm_limit / PWM_MAX)
    wanted = f"the machine's q_dot_up and q_dot_down {speeds} as the fastest motion"
    got = "({:.3g}, {:.3g}) rad/s".format(*r.fastest)
    yield (slow | (ratio > FASTER)).any(), name, wanted, got
    memory = machine.history * machine.dt
    wanted = f"more than delay and lag of {name}, {r.delay:.2f} and {r.tau:.2f} s"
    yield r.delay + r.tau > memory, "history", wanted, f"{memory:.2f} s"


def one_sided(r: JointReport) -> bool:
    """Does a joint move both ways, and not by its commands, which are all of one sign?"""
    both = min(r.fastest) > OPENS * max(r.fastest)
    return both and min(r.largest) <= 0 and r.explained < LEAST_EXPLAINED


def beyond(low: float, high: float, joint: Joint) -> float:
    """How far a range goes beyond that of the joint [rad]."""
    return max(joint.q_min - low, high - joint.q_max)


def warnings(
    log: Log, reports: Mapping[str, JointReport], machine: Machine | None
) -> Iterator[str]:
    """What a log lacks, and where it contradicts the machine that it should be of."""
    yield from log.warnings
    if twins := repeated(log.recordings, ()):
        yield f"recordings: expected each once, got again {brief(twins)}"
    yield from wrong_signs(reports)
    for name in log.joints:
        if name not in reports:
            yield f"{name}: expected commands in the log, got none"
    for name, r in reports.items():
        first = [check for check in causes(name, r) if check[0]][:1]
        known = differences(name, r, machine) if machine and not r.follows else ()
        for holds, place, wanted, got in (*first, *lacks(name, r), *known):
            if holds:
                yield f"{place}: expected {wanted}, got {got}"


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


def table(reports: Mapping[str, JointReport]) -> Iterator[str]:
    """What a log tells of each joint, and fields of `Joint` by it, to copy into a machine.

    A question mark stands where no command opens the valve that way.
    """
    for name, r in reports.items():
        told = f"{r.minutes:.1f} minutes, sign {r.sign:+d}, {r.explained:.0%} explained"
        yield f"{name}: {told}, delay {r.delay:.2f} s"
        limits = f"q_min={r.low:.3f}, q_max={r.high:.3f}"
        speeds = "q_dot_up={:.3f}, q_dot_down={:.3f}".format(*r.fastest)
        known = ~np.isnan(r.dead_zone) & (r.minutes > TOLD)
        zones = ", ".join(f"{x:.3f}" if told else "?" for x, told in zip(r.dead_zone, known))
        yield f'Joint("{name}", {limits}, {speeds}, dead_zone=({zones}), ...)'
