"""What a log tells of its machine, and what it cannot tell: joint by joint, before any fit.

`identification.joint_model` has what it tells of delays, dead zones and speeds.
"""

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from brokk_min.identification.joint_model import LATEST, joint_model
from brokk_min.identification.logs import COMMANDED, Log, Recording, driven
from brokk_min.machine import PWM_MAX, Array, Machine

NEAR_LIMIT = 0.15  # of the command limit, assumed: commands of so much less or more are at it,
HELD = 0.5  # s, assumed: after so long a joint has its speed
FASTEST = 0.95  # quantile of the speeds at the command limit, assumed
LEAST_HELD = 20  # samples at the command limit, assumed: else the model gives the fastest motion
WIDER = 0.03  # of full command, assumed: the model's error of the least dead zone is smaller
FASTER = 5.0  # times as fast as the machine, assumed: more is another unit
LEVELS = 8  # of commands from 0 to the largest, by direction
# What a log must have for its score to hold in other driving, all assumed.
LEAST_MINUTES = 10.0
LEAST_RANGE = 0.7  # of a joint's range
LEAST_EXPLAINED = 0.1  # of a joint's motion by its commands
LEAST_LEVELS = 6  # with 1 % of the commands or more
STEPPED = 0.8  # `held` of step responses, at least; excitations have 0.7 or less
MANY_LEVELS = 7  # that step responses do not have
LEAST_CHANGES = 0.05  # of the ticks: commands that change by more than a tenth of the largest
CLOSED_LOOP = -0.42  # `feedback`: excitations give -0.4 to 0, going between places -0.6 to -0.5
SMALL = 0.02  # of full command: larger changes are of goals, or of an excitation
LEAST_SMALL = 400  # small changes of a command, else nothing is said of its `reaction`
REACTS = 0.01  # least `reaction` of all joints: excitations have 0 or less, a policy has 0.03


@dataclass(frozen=True)
class JointReport:
    """One joint of a log; velocities in rad/s, commands of full command."""

    minutes: float  # in recordings in which it has commands
    alone: float  # part of its commanded time without commands of other joints
    together: dict[str, float]  # part with commands of each other joint
    low: float  # rad, smallest angle
    high: float  # rad
    levels: tuple[int, int]  # of `LEVELS` commands up and down that the log has
    held: float  # part of the ticks with a command at which it stays as it was
    held_levels: int  # of `LEVELS`, at these ticks, in the direction that has more
    changes: float  # part of the ticks at which the command changes fast
    feedback: float  # correlation of commands with the angle a second before
    reaction: float  # part of the small changes of the command that measured motion explains
    explained: float  # part of the velocities' variance that the model explains
    sign: int  # of velocity under a positive command; 0: not clear
    delay: float  # s
    tau: float  # s
    dead_zone_up: float
    dead_zone_down: float
    gain_up: float  # rad/s per command beyond the dead zone
    gain_down: float


def inspect(log: Log) -> dict[str, JointReport]:
    """A report of each joint that is driven in a log, at the log's rate."""
    reports = {}
    for j, name in enumerate(log.joints):
        recordings = [one for one in log.recordings if driven(one)[j]]
        if recordings:
            reports[name] = inspect_joint(log, recordings, j)
    return reports


def inspect_joint(log: Log, recordings: list[Recording], j: int) -> JointReport:
    """The report of joint `j` from the recordings that drive it."""
    u = np.concatenate([recording.u for recording in recordings])
    q = np.concatenate([recording.q[:, j] for recording in recordings])
    moving = np.abs(u) > COMMANDED
    own = moving[moving[:, j]]
    others = [i for i in range(len(log.joints)) if i != j]
    largest = max(np.abs(u[:, j]).max(), 1e-9)
    level = np.floor(LEVELS * np.abs(u[:, j]) / largest).clip(0, LEVELS - 1)
    sides = [level[side * u[:, j] > COMMANDED] for side in (1, -1)]
    levels = [count_levels(side) for side in sides]
    changes = [np.abs(np.diff(one.u[:, j])) > 0.1 * largest for one in recordings]
    stays = np.abs(np.diff(u[:, j], prepend=np.inf)) < 0.01 * largest
    held = [level[stays & (side * u[:, j] > COMMANDED)] for side in (1, -1)]
    return JointReport(
        minutes=sum(len(r.u) for r in recordings if np.ptp(r.u[:, j]) > COMMANDED) / log.rate / 60,
        alone=float(1 - own[:, others].any(axis=1).mean()) if len(own) else 1.0,
        together={log.joints[i]: float(own[:, i].mean()) if len(own) else 0.0 for i in others},
        low=float(q.min()),
        high=float(q.max()),
        levels=(levels[0], levels[1]),
        held=float(stays[moving[:, j]].mean()) if moving[:, j].any() else 0.0,
        held_levels=max(map(count_levels, held)),
        changes=float(np.concatenate(changes).mean()),
        feedback=feedback(recordings, j, log.rate),
        reaction=reaction(recordings, j),
        **joint_model(recordings, j, log.rate),
    )


def count_levels(level: Array) -> int:
    """How many levels have more than 1 % of these commands (samples,)."""
    count = np.bincount(level.astype(int), minlength=LEVELS)
    return int((count > 0.01 * max(count.sum(), 1)).sum())


def feedback(recordings: list[Recording], j: int, rate: float) -> float:
    """Correlation of the command with the angle a second before it; 0: no command changes.

    A controller or an operator brings a joint back to where it is to be: below `CLOSED_LOOP`. An
    excitation does not look at the angle.
    """
    late = round(rate)
    u = np.concatenate([one.u[late:, j] for one in recordings])
    q = np.concatenate([one.q[: max(0, len(one.q) - late), j] for one in recordings])
    if len(u) < 2 or not np.ptp(u) or not np.ptp(q):
        return 0.0
    return float(np.corrcoef(q, u)[0, 1])


def reaction(recordings: list[Recording], j: int) -> float:
    """Part of the small changes of a command that the joint's motion explains; 0: too few of them.

    As Granger (1969) has it: beyond what the command's own past explains, by linear models that are
    fitted to one half of the changes and scored on the other. Commands of an excitation change
    whatever the joint does; those of a controller follow its velocity.
    """
    own, motion, changes = map(
        np.concatenate, zip(*(_small_changes(one, j) for one in recordings), strict=True)
    )
    if len(changes) < LEAST_SMALL:
        return 0.0
    halves = np.array_split(np.arange(len(changes)), 2)
    error = np.zeros(2)
    for fitted, scored in (halves, halves[::-1]):
        for k, x in enumerate((own, np.hstack([own, motion]))):
            w = np.linalg.lstsq(x[fitted], changes[fitted], rcond=None)[0]
            error[k] += np.square(changes[scored] - x[scored] @ w).sum()
    if error[0] < 1e-12 * len(changes):  # held commands: their past tells all
        return 0.0
    return float(1 - error[1] / error[0])


def _small_changes(recording: Recording, j: int) -> tuple[Array, Array, Array]:
    """Of each small change of a command: its past, the joint's motion until then, the change."""
    u, q, q_dot = recording.u[:, j], recording.q[:, j], recording.q_dot[:, j]
    t = np.arange(6, len(u))
    change = np.stack([u[t - k] - u[t - k - 1] for k in range(5)], axis=-1)  # newest first
    small = (np.abs(change[:, :3]) < SMALL).all(axis=-1) & (u[t] != 0) & (u[t - 1] != 0)
    own = np.column_stack([np.ones(len(t)), change[:, 1:], u[t - 1]])
    motion = np.column_stack([*(q_dot[t - k] for k in (0, 1, 2, 4)), q[t]])
    return own[small], motion[small], change[small, 0]


def wrong_signs(reports: dict[str, JointReport]) -> list[str]:
    """Joints whose angle falls under positive commands, in words."""
    expected = "expected positive commands to raise q_{}, got {:.2f} rad/s per full opening"
    return [
        f"u_{name}: {expected.format(name, report.gain_up)}: change the sign of one column"
        for name, report in reports.items()
        if report.sign < 0
    ]


def warnings(
    log: Log, reports: dict[str, JointReport], machine: Machine | None = None
) -> list[str]:
    """Where the log is an operator's work rather than an excitation: its score is of such work."""
    result = wrong_signs(reports)
    steps_alone = has_steps_alone(reports)
    for name in log.joints:
        if name not in reports:
            result.append(f"{name}: never driven in the log")
            continue
        r = reports[name]
        checks = {
            f"{r.minutes:.1f} of {LEAST_MINUTES:g} minutes": r.minutes < LEAST_MINUTES,
            f"commands of {r.levels[0]} of {LEVELS} levels up, {r.levels[1]} down": (
                min(r.levels) < LEAST_LEVELS
            ),
            f"fast changes of command in {r.changes:.1%} of the ticks": r.changes < LEAST_CHANGES,
            f"commands that follow the angle ({r.feedback:.2f})": (
                r.feedback < CLOSED_LOOP and not steps_alone  # steps up and down seem to
            ),
        }
        if machine:
            joint = machine.joints[machine.names.index(name)]
            part = (r.high - r.low) / (joint.q_max - joint.q_min)
            checks[f"{part:.0%} of the range"] = part < LEAST_RANGE
            beyond = 0.05 * (joint.q_max - joint.q_min)
            if r.low < joint.q_min - beyond or r.high > joint.q_max + beyond:
                wanted = f"expected angles of {joint.q_min:g} to {joint.q_max:g}"
                got = f"got {r.low:.2f} to {r.high:.2f}: another unit, zero or joint?"
                result.append(f"{name}: {wanted}, {got}")
            result += wrong_numbers(log, name, r, machine)
        if r.explained < LEAST_EXPLAINED:
            what = f"its commands explain {r.explained:.0%} of its motion"
            result.append(f"{name}: {what}: are they those of another joint?")
        if r.delay > LATEST - 1 / log.rate:
            wanted = f"expected below {LATEST:g} s, the longest that is searched"
            result.append(f"{name}: delay: {wanted}, got {r.delay:.2f} s, perhaps more")
        found = [text for text, bad in checks.items() if bad]
        if found:
            result.append(f"{name}: {', '.join(found)}: scores hold for such driving alone")
    reactions = [r.reaction for r in reports.values() if r.reaction]
    if len(reactions) > 1 and min(reactions) > REACTS:
        parts = ", ".join(f"{reaction:.0%}" for reaction in reactions)
        of_changes = f"commands follow the measured motion ({parts} of their small changes)"
        result.append(f"{of_changes}: a controller drove; scores hold for such driving alone")
    return result


def wrong_numbers(log: Log, name: str, report: JointReport, machine: Machine) -> list[str]:
    """Fields of a machine that the log of a joint contradicts, in words."""
    joint = machine.joints[machine.names.index(name)]
    found = fields(log, {name: report}, machine)
    if not found:
        return []
    result = []
    if machine.dead_zone > found["dead_zone"] + WIDER:
        wanted = f"expected at most {found['dead_zone']:.3f} by this log"
        result.append(f"{name}: dead_zone: {wanted}, got {machine.dead_zone:g}: nets read no less")
    for side in ("q_dot_up", "q_dot_down"):
        now, fastest = getattr(joint, side), found[side].get(name)
        if fastest and not 1 / FASTER < fastest / now < FASTER:
            units = "time in s, angles in rad?"
            result.append(f"{name}: {side}: {fastest:.3g} by this log, {now:g} now: {units}")
    return result


def has_steps_alone(reports: dict[str, JointReport]) -> bool:
    """Whether each joint with commands has held ones of few levels, as in step responses."""
    commanded = [report for report in reports.values() if max(report.levels)]
    steps = (r.held > STEPPED and r.held_levels < MANY_LEVELS for r in commanded)
    return bool(commanded) and all(steps)


def fastest(log: Log, name: str, report: JointReport, limit: float, side: str) -> float:
    """Fastest motion [rad/s] of a joint "up" or "down" at the command `limit`.

    It is a high quantile of the velocities after `HELD` at the limit, for single ones have noise;
    where there are too few of them, what the model gives.
    """
    j, sign = log.joints.index(name), 1 if side == "up" else -1
    held = round(HELD * log.rate) + 1
    speeds = [np.empty(0)]
    for recording in log.recordings:
        if len(recording.u) >= held:
            commands = sliding_window_view(sign * recording.u[:, j], held)
            at_limit = (np.abs(commands / limit - 1) < NEAR_LIMIT).all(axis=-1)
            speeds.append(sign * recording.q_dot[held - 1 :, j][at_limit])
    found = np.concatenate(speeds)
    if len(found) >= LEAST_HELD:
        return float(np.quantile(found, FASTEST))
    gain, zone = getattr(report, f"gain_{side}"), getattr(report, f"dead_zone_{side}")
    return float(gain * max(limit - zone, 0))


def fields(log: Log, reports: dict[str, JointReport], machine: Machine) -> dict[str, Any]:
    """Fields of a machine by a log of it: dead zones, and fastest motions at the command limit.

    The largest dead zone is 0.05 wider than found: one that is too small stops drives. Joints that
    do not obey their commands in the log are left out, and directions in which they did not move;
    an empty result: all of them.
    """
    obeys = [k for k, r in reports.items() if r.explained >= LEAST_EXPLAINED and r.sign >= 0]
    known = {name: reports[name] for name in machine.names if name in obeys}
    limit = machine.pwm_limit / PWM_MAX
    result: dict[str, Any] = {}
    for side in ("up", "down"):
        moved = {k: r for k, r in known.items() if getattr(r, f"gain_{side}")}
        result[f"dead_zone_{side}"] = {k: getattr(r, f"dead_zone_{side}") for k, r in moved.items()}
        result[f"q_dot_{side}"] = {k: fastest(log, k, r, limit, side) for k, r in moved.items()}
    zones = [*result["dead_zone_up"].values(), *result["dead_zone_down"].values()]
    if not zones:
        return {}
    result["dead_zone"] = min(zones)
    result["largest_dead_zone"] = min(max(zones) + 0.05, 0.99 * limit)
    return result


def with_dead_zones(machine: Machine, log: Log) -> Machine:
    """The machine with the dead zones by joint and direction that a log of it shows."""
    found = fields(log, inspect(log), machine)
    if not found:
        return machine
    sides = ("dead_zone_up", "dead_zone_down")
    joints = []
    for joint in machine.joints:
        zones = {side: found[side].get(joint.name, getattr(joint, side)) for side in sides}
        joints.append(replace(joint, **zones))
    common = {key: found[key] for key in ("dead_zone", "largest_dead_zone")}
    return replace(machine, joints=tuple(joints), **common)


def report_json(log: Log, machine: Machine | None = None) -> dict[str, Any]:
    """All reports of a log, its warnings and its gaps, for JSON."""
    reports = inspect(log)
    gaps = sum("#" in recording.name for recording in log.recordings)
    found = fields(log, reports, machine) if machine else {}
    return {
        "rate": log.rate,
        "recordings": len(log.recordings),
        "gaps": gaps,
        "velocity_logged": log.velocity_logged,
        "joints": {name: asdict(report) for name, report in reports.items()},
        "warnings": warnings(log, reports, machine),
        **({"fields": found} if found else {}),
    }
