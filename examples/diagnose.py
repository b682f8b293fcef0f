"""Why does it shake? The log of a drive, compared with its policy and its nets, term by term.

    python examples/diagnose.py RUN.log POLICY.npz [MACHINE or FILE.py:NAME]

Are the commands those of the policy for what was measured? Do the joints move as the nets say? Both
are asked again with one term changed. Look first at the term after whose change the log fits best.
"""

import sys
from collections.abc import Callable, Iterator
from functools import partial
from itertools import combinations, pairwise, product
from pathlib import Path
from typing import NamedTuple

import numpy as np

from brokk_min.actuator import NetState, append_sample, initial_history
from brokk_min.can.drive_log import Telemetry, read_frames, read_telemetry
from brokk_min.cli.options import Command
from brokk_min.env import measure
from brokk_min.learning.policy import Policy, load_policy
from brokk_min.machine import PWM_MAX, Array, Machine, require

# Thresholds between sound drives and planted faults; all are assumed.
CLEARLY = 0.89  # of the error that is left: then a changed term explains something
COMMAND_ERROR = 0.003  # of full command: smaller ones are the gate's and of rounding
MOTION_ERROR = 0.05  # of the deviations of the velocities: smaller ones are of rounding
AHEAD = 1.0  # s of a free run of the nets
ZEROS = (0.05, -0.05, 0.1, -0.1, 0.2, -0.2)  # rad or m
SCALES = (0.5, 0.7, 1.4, 2.0)
Changes = Iterator[tuple[str, Callable[[Array], Array]]]


class Term(NamedTuple):
    """A term as it might be wrong, and the error that is left once it is taken so."""

    side: str  # "commands" or "motion"
    name: str
    error: float
    before: float  # error without the change


def read_ticks(machine: Machine, log: Path) -> list[Telemetry]:
    """The longest stretch of ticks with all positions."""
    ticks = list(read_telemetry(machine, read_frames(log)))
    steps = np.diff([tick.time for tick in ticks])
    usual = np.median(steps) if len(steps) else 0.0
    gaps = np.flatnonzero(steps > 1.5 * usual) + 1
    first, end = max(pairwise([0, *gaps, len(ticks)]), key=lambda ends: ends[1] - ends[0])
    driving = sum(tick.driving for tick in ticks[first:end])
    least = machine.history + round(2 * AHEAD * machine.rate)
    wanted = f"{least} ticks or more, some of which drive"
    got = f"{end - first} ticks, of which {driving} drive"
    require(end - first >= least and driving > 1, str(log), wanted, got)
    return ticks[first:end]


def diagnose(machine: Machine, policy: Policy, ticks: list[Telemetry]) -> list[Term]:
    """All terms that explain something, those first that explain most."""
    step = float(np.median(np.diff([tick.time for tick in ticks])))
    terms = []
    if abs(step * machine.rate - 1) > 0.05:
        name = f"rate: {1 / step:.3g} Hz instead of {machine.rate:g} Hz"
        terms.append(Term("commands", name, 0.0, abs(step * machine.rate - 1)))
    q, u = (np.array([getattr(tick, name) for tick in ticks]) for name in ("q", "u"))
    history = measured_history(machine, q, u)
    names, changes = zip(("", np.array), *observation_changes(machine), strict=True)
    expected = expected_commands(machine, policy, ticks, [change(history) for change in changes])
    before, *errors = (command_error(machine, ticks, commands) for commands in expected)
    if before > COMMAND_ERROR:
        terms += [Term("commands", *row, before) for row in zip(names[1:], errors)]
    before = motion_error(machine, policy, q, u)
    if before > MOTION_ERROR:
        for name, change in command_changes(machine):
            error = motion_error(machine, policy, q, change(u))
            terms.append(Term("motion", name, error, before))
    terms.sort(key=lambda term: term.error / term.before)
    return [term for term in terms if term.error < CLEARLY * term.before]


def measured_history(machine: Machine, q: Array, u: Array) -> Array:
    """History (T, n, 3, H) at each tick, as `hw.Drive` has it; at rest before the first."""
    rows = [initial_history(q[0].astype(np.float32), machine.history)]
    for sent, angle in zip(u, q[1:]):
        rows.append(append_sample(rows[-1], sent, angle, machine.velocity_samples, machine.dt))
    return np.array(rows)


def expected_commands(
    machine: Machine, policy: Policy, ticks: list[Telemetry], histories: list[Array]
) -> Array:
    """Commands (K, T, n) of the policy at each tick for each of K histories (T, n, 3, H)."""
    state, driving, commands = None, False, []
    for tick, history in zip(ticks, np.stack(histories, axis=1)):
        state = state if driving else policy.start(len(history))  # as `hw.Drive` restarts
        goal = np.tile(tick.v_goal.astype(np.float32), (len(history), 1))
        u, state = policy(measure(machine, history, goal), state)
        commands.append(u)
        driving = tick.driving
    return np.stack(commands, axis=1)


def command_error(machine: Machine, ticks: list[Telemetry], expected: Array) -> float:
    """Mean difference of the sent commands from expected ones (T, n), while driving."""
    limit = machine.pwm_limit / PWM_MAX
    driving, u = (np.array([getattr(tick, name) for tick in ticks]) for name in ("driving", "u"))
    error = np.abs(u - np.clip(expected, -limit, limit))
    return float(error[driving & np.roll(driving, 1)][:, machine.driven].mean())


def motion_error(machine: Machine, policy: Policy, q: Array, u: Array) -> float:
    """Mean error of velocities of free runs of the nets, in deviations of the measured ones."""
    ahead = round(AHEAD * machine.rate)
    measured = measured_history(machine, q, u)[:, machine.driven]
    starts = np.arange(machine.history, len(q) - ahead, ahead)
    state, errors = NetState(q[starts], measured[starts]), []
    for k in range(ahead):
        state = policy.net.step(machine, state, u[starts + k])
        errors.append(state.history[..., 1, -1] - measured[starts + k + 1, :, 1, -1])
    scale = np.maximum(measured[..., 1, -1].std(axis=0), 0.02)
    return float(np.sqrt(np.mean(np.square(np.array(errors) / scale))))


def delay(x: Array, ticks: int) -> Array:
    """The same some ticks later."""
    return np.concatenate([x[:1].repeat(ticks, axis=0), x[:-ticks]])


def joint_changes(machine: Machine, axes: int = 2) -> Changes:
    """Signs and orders of the driven joints: changes of arrays (T, n, ...) of some axes."""
    for i in machine.driven:
        sign = 1.0 - 2.0 * (np.arange(machine.n) == i)
        sign = sign.reshape(-1, *[1] * (axes - 2))
        yield f"sign of {machine.names[i]}", partial(np.multiply, sign)
    for i, j in combinations(machine.driven, 2):
        order = np.arange(machine.n)
        order[[i, j]] = j, i
        name = f"order of {machine.names[i]}, {machine.names[j]}"
        yield name, partial(np.take, indices=order, axis=1)


def command_changes(machine: Machine) -> Changes:
    """Changes of commands (T, n): on their way, or within a machine."""
    yield from joint_changes(machine)
    for factor in SCALES:
        yield f"scale of commands: {factor:g}", partial(np.multiply, factor)
    for ticks in (1, 2):
        yield f"delay: {1e3 * ticks * machine.dt:.0f} ms more", partial(delay, ticks=ticks)
    for more in (0.03, 0.06, -0.03):
        yield (
            f"dead zone: {more:+.2f}",
            lambda u, more=more: np.sign(u) * np.maximum(np.abs(u) - more * (u != 0), 0),
        )


def observation_changes(machine: Machine) -> Changes:
    """Changes of the history (T, n, 3, H) that a program gives its policy."""
    angle, velocity = np.array([[1.0], [0.0], [0.0]]), np.array([[0.0], [1.0], [0.0]])
    yield "one sample late", partial(delay, ticks=1)
    yield "order of the history", partial(np.flip, axis=-1)
    for factor in (*SCALES, 180 / np.pi):  # the last: degrees instead of radians
        both = np.float32(factor) ** (angle + velocity)
        yield f"scale of angles and velocities: {factor:.3g}", partial(np.multiply, both)
        yield f"scale of velocities (rate): {factor:.3g}", partial(np.multiply, factor**velocity)
    yield from joint_changes(machine, axes=4)
    for i, zero in product(machine.driven, ZEROS):
        change = np.multiply.outer(zero * (np.arange(machine.n) == i), angle)
        yield f"zero of {machine.names[i]}: {zero:+.2f}", partial(np.add, change)


def main(log: str, policy: str, name: str = "brokk170") -> None:
    """Print the terms that explain most."""
    machine = Command(machine=name).find_machine()
    ticks = read_ticks(machine, Path(log))
    terms = diagnose(machine, load_policy(Path(policy), machine), ticks)
    print(f"{log}: {len(ticks)} ticks, {len(terms)} terms explain something")
    for term in terms[:5]:
        print(f"  {term.side}: {term.name} ({term.error / term.before:.0%} of the error is left)")


if __name__ == "__main__":
    if not 3 <= len(sys.argv) <= 4:
        sys.exit(__doc__)
    try:
        main(*sys.argv[1:])
    except (OSError, ValueError) as error:
        sys.exit(f"diagnose.py: {error}")
