"""What is wrong with a log, and what it lacks, in words: by the reports of `inspection`."""

from collections.abc import Iterator, Mapping
from itertools import combinations
from typing import Any

import numpy as np

from brokk_min._files import brief
from brokk_min.fit import MOVED, Log
from brokk_min.identification.inspection import (
    COARSE,
    FASTEST,
    LEAST_EXPLAINED,
    JointReport,
    repeated,
)
from brokk_min.identification.joint_model import LATEST, OPENS
from brokk_min.machine import PWM_MAX, Joint, Machine

# What a log must have, all assumed.
LEAST_MINUTES = 10.0
TOLD = 0.3  # minutes; less tells no dead zone
LEAST_RANGE = 0.7  # of a joint's range
BEYOND = 0.05  # of a joint's range, outside of it
COARSER = 0.15  # more of the coarse motion is explained: angles have noise or steps
ZONE = 0.04  # of full command, between the dead zones of machine and log
WORSE = 1.25  # times as much is not explained with the machine's dead zones
ONE_SIDED = 0.8  # of a joint's motion; of sound logs 0.84 is explained
UNITS, SPEED = 10.0, 3.0  # times as fast as the next recording, and rad/s: no machine is that
SMALL = 0.05  # of full command: no machine is driven by less
FASTER, SLOWER = 1.2, 0.4  # of the machine's fastest motion, which are in the log
FAST, PART = 0.5, 0.3  # of it, by so small a part of the largest command
AT_LIMIT = 0.95  # of the command limit: such commands should give the fastest motion


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


def refusals(log: Log, reports: Mapping[str, JointReport]) -> Iterator[str]:
    """What nets must not learn: angles in two units, columns mixed up, wrong signs; in words."""
    yield from mixed_units(log).values()
    for name, r in reports.items():
        if r.other:
            yield "{1}: expected {2}, got {3}".format(*another(name, r))
    yield from wrong_signs(reports)


def causes(name: str, r: JointReport) -> Iterator[Check]:
    """Why commands do not explain a motion; the first that holds is the one to look at."""
    doubt = "is it an angle to the ground? Then take differences of both angles"
    got = f"motion at so many times the speed of others {r.follows}: {doubt}"
    yield r.follows, f"q_{name}", "rest without commands", got
    yield another(name, r)
    yield r.rest, f"u_{name}", "0 at rest", f"{r.rest:.3g}"
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
    why = (
        "engine or pump off, blocked, no oil left, an angle that was not read, another zero, clock"
    )
    got = f"rest or other motion in {brief(r.still)} ({why} or column?); figures and nets are of"
    got = f"{got} other recordings, if any"
    yield r.still and not r.other, name, "commands to move it", got
    got = f"none in {brief(list(r.idle))}: is the column of another joint, or was it not recorded?"
    got = f"{got} Nets are of other recordings, if any"
    largest = max(r.largest)
    tiny = 0 < largest < SMALL  # of another unit, so small that they look like none
    missing = r.idle and not (r.follows or r.other or one_sided(r) or tiny)
    yield missing, f"u_{name}", "commands where it moves", got
    got = f"another in {brief(list(r.scaled))}: another unit, or engine speed?"
    yield r.scaled, f"u_{name}", "one scale in all recordings", got
    got = f"another in {brief(list(r.later))}: another clock?"
    yield r.later, name, "one delay in all recordings", got
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
    off = min(beyond(r.low + turn, r.high + turn, joint) for turn in (-2 * np.pi, 2 * np.pi))
    turned &= off > BEYOND * width  # it would fit a turn on
    doubt = f"in degrees (--map {name}=COLUMN:deg, or -deg)" if turned else "another zero or joint"
    mirrored = r.sign < 0 and beyond(-r.high, -r.low, joint) <= BEYOND * width
    outside = not mirrored and beyond(r.low, r.high, joint) > BEYOND * width
    yield outside, f"q_{name}", f"{joint.q_min:g} to {joint.q_max:g}", f"{got}: {doubt}?"
    narrow = r.high - r.low < LEAST_RANGE * width
    already = narrow and LEAST_RANGE < np.rad2deg(r.high - r.low) / width < 1 + BEYOND
    got += ": already in radians (--map without :deg)?" if already else ""
    yield narrow, name, f"{LEAST_RANGE:.0%} of its range or more", got
    if r.explained <= LEAST_EXPLAINED:
        return
    limit = machine.pwm_limit / PWM_MAX
    speeds, largest = (joint.q_dot_up, joint.q_dot_down), max(r.largest)
    ratio = np.array(r.fastest) / speeds
    scaled = bool((ratio > FAST).any()) and SMALL <= largest < PART * limit
    wanted, got = f"commands up to {limit:.2f} at its fastest motion", f"at most {largest:.2g}"
    yield scaled, f"u_{name}", wanted, f"{got}: another unit?"
    slow = bool(((ratio < SLOWER) & (np.array(r.largest) > AT_LIMIT * limit)).any())
    wanted = f"the machine's q_dot_up and q_dot_down {speeds} as the fastest motion"
    got = "({:.3g}, {:.3g}) rad/s".format(*r.fastest)
    yield slow or (ratio > FASTER).any(), name, wanted, got
    apart = (np.abs(np.subtract(r.dead_zone, joint.dead_zone)) > ZONE).any()  # not nan
    worse = 1 - r.by_zones > WORSE * (1 - r.explained)
    got = "({:.2f}, {:.2f})".format(*r.dead_zone)
    alone = not (scaled or slow or r.rest)  # else it is one of what other commands do
    yield apart and worse and alone, name, f"the machine's dead_zone {joint.dead_zone}", got
    memory = machine.history * machine.dt
    wanted = f"more than delay and lag of {name}, {r.delay:.2f} and {r.tau:.2f} s"
    yield r.delay + r.tau > memory, "history", wanted, f"{memory:.2f} s"


def one_sided(r: JointReport) -> bool:
    """Does a joint move both ways, and not by its commands, which are all of one sign?"""
    both = min(r.fastest) > OPENS * max(r.fastest)
    return both and min(r.largest) <= 0 < max(r.largest) and r.explained < ONE_SIDED


def beyond(low: float, high: float, joint: Joint) -> float:
    """How far a range goes beyond that of the joint [rad]."""
    return max(joint.q_min - low, high - joint.q_max)


def copied(log: Log) -> list[tuple[str, str]]:
    """Pairs of joints that move and have the same angles in all recordings."""
    return [
        (log.joints[i], log.joints[j])
        for i, j in combinations(range(len(log.joints)), 2)
        if all(np.array_equal(one.q[:, i], one.q[:, j]) for one in log.recordings)
        and any(np.ptp(one.q[:, i]) > MOVED for one in log.recordings)
    ]


def mixed_units(log: Log) -> dict[str, str]:
    """Joints that are so much faster in some recordings that these are in degrees: in words."""
    told = {}
    for j, name in enumerate(log.joints):
        fast = {one.name: np.quantile(np.abs(one.q_dot[:, j]), FASTEST) for one in log.recordings}
        speeds = np.sort([MOVED, *(x for x in fast.values() if x > MOVED)])[1:]
        leap = np.flatnonzero(speeds[1:] > UNITS * speeds[:-1])[-1:]  # the last one, if any
        if leap.size and speeds[-1] > SPEED:
            names = brief([one for one, speed in fast.items() if speed > speeds[leap[0]]])
            got = f"larger angles in {names}: degrees?"
            told[name] = f"q_{name}: expected one unit in all recordings, got {got}"
    return told


def warnings(
    log: Log, reports: Mapping[str, JointReport], machine: Machine | None
) -> Iterator[str]:
    """What a log lacks, and where it contradicts the machine that it should be of."""
    yield from log.warnings
    if twins := repeated(log.recordings, ()):
        yield f"recordings: expected each once, got again {brief(twins)}"
    yield from wrong_signs(reports)
    mixed = mixed_units(log)
    yield from mixed.values()
    copies = {name for pair in copied(log) for name in pair}
    for one, other in copied(log):
        yield f"q_{other}: expected a column of its own, got that of q_{one}"
    for name in log.joints:
        if name not in reports:
            yield f"{name}: expected commands in the log, got none"
    for name, r in reports.items():
        if name in mixed:
            continue
        if r.high - r.low <= MOVED:
            yield f"q_{name}: expected motion, got {r.low:.3g} to {r.high:.3g}"
            continue
        first = [check for check in causes(name, r) if check[0] and name not in copies][:1]
        known = differences(name, r, machine) if machine and not r.follows else ()
        for holds, place, wanted, got in (*first, *lacks(name, r), *known):
            if holds:
                yield f"{place}: expected {wanted}, got {got}"


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
