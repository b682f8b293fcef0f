"""Why does it shake? The log of a drive, compared with its policy and its simulation, term by term.

Two questions: are the commands those of the policy for what was measured, and do the joints move as
the nets say? Each is asked again with one term changed, as a wrong program or machine would change
it: the term after whose change the log fits best is the one to look at first.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from itertools import combinations
from typing import NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from brokk_min.actuator import Valves, command_at_rest, initial_history
from brokk_min.can.canopen import Frame
from brokk_min.can.drive_log import Telemetry, read_telemetry, with_operator
from brokk_min.env import action_to_pwm, features, integrate_error, measure
from brokk_min.identification.logs import Recording, velocity_of
from brokk_min.identification.simulation import free_run
from brokk_min.kinematics import UNITS, forward_kinematics, tool_velocity
from brokk_min.learning.policy import Policy
from brokk_min.machine import PWM_MAX, Array, Machine

# Thresholds between sound drives of the shipped policies and ten planted faults.
CLEARLY = 0.89  # of the error that is left: then a changed term explains something
CLEARLY_ANGLES = 0.7  # the same for changed angles, which also hide errors of inexact nets
COMMAND_ERROR = 0.003  # of full command: smaller ones are the gate's and of rounding
RATE_ERROR = 0.05  # of a tick, assumed
AHEAD = 1.0  # s of a free run, assumed
ZEROS = (0.05, -0.05, 0.1, -0.1, 0.2, -0.2, 0.4, -0.4)  # rad or m
SCALES = (0.5, 0.7, 1.4, 2.0)
Change = Callable[[Array], Array]


class Ticks(NamedTuple):
    """A stretch of a drive, tick by tick."""

    time: Array  # of SYNC [s], (T,)
    q: Array  # measured angles [rad], (T, n)
    u: Array  # sent commands [-1, 1], (T, n)
    v_goal: Array  # m/s, (T, 3)
    driving: NDArray[np.bool_]  # (T,)


class Term(NamedTuple):
    """A term as it might be wrong, and the error that is left once it is taken so."""

    side: str  # "commands" or "motion"
    name: str
    error: float
    before: float  # error without the change


def read_ticks(machine: Machine, frames: Iterable[Frame]) -> Ticks:
    """The longest stretch of ticks with all positions.

    ValueError: it is too short, or the log does not say what the operator wanted.
    """
    stretches: list[list[Telemetry]] = [[]]
    for tick in read_telemetry(machine, with_operator(frames)):
        if np.isfinite(tick.q).all():
            stretches[-1].append(tick)
        else:
            stretches.append([])
    longest = max(stretches, key=len)
    driven = sum(tick.driving for tick in longest)
    least = machine.history + 3 * round(AHEAD * machine.rate)
    if driven < least:
        expected = f"expected {least} ticks of driving in a row or more"
        raise ValueError(f"log: {expected}, got {driven}")
    return Ticks(*(np.array([getattr(tick, k) for tick in longest]) for k in Ticks._fields))


def diagnose(machine: Machine, policy: Policy, ticks: Ticks) -> list[Term]:
    """All terms that explain something, those first that explain most."""
    terms = []
    step = float(np.median(np.diff(ticks.time)))
    if abs(step / machine.dt - 1) > RATE_ERROR:
        name = f"rate: {1 / step:.3g} Hz instead of {machine.rate:g} Hz"
        terms.append(Term("commands", name, 0.0, abs(step / machine.dt - 1)))
    history = measured_history(machine, ticks)
    error_of = partial(command_error, machine, policy, ticks)
    base = error_of(history)
    errors: list[tuple[str, float]] = []
    if base > COMMAND_ERROR:
        errors += [(name, error_of(f(history))) for name, f in observation_changes(machine)]
        errors += [(name, error_of(history, f)) for name, f in command_changes(machine)]
        for valves in get_args(Valves):
            error = command_error(machine, replace(policy, valves=valves), ticks, history)
            errors.append((f"valves at rest: {valves}", error))
    terms += [Term("commands", name, error, base) for name, error in errors]
    error_of = partial(motion_error, machine, policy)
    base = error_of(ticks.u, ticks.q)
    errors = [(name, error_of(f(ticks.u), ticks.q)) for name, f in command_changes(machine)]
    angles = [(name, error_of(ticks.u, f(ticks.q))) for name, f in angle_changes(machine)]
    errors += [(name, error) for name, error in angles if error < CLEARLY_ANGLES * base]
    terms += [Term("motion", name, error, base) for name, error in errors]
    found = [term for term in terms if term.error < CLEARLY * term.before]
    return sorted(found, key=lambda term: term.error / term.before)


def measured_history(machine: Machine, ticks: Ticks) -> Array:
    """History (T, n, 3, H) at each tick, as `hw.Drive` has it; at rest before the first."""
    H = machine.history
    first = initial_history(ticks.q[0], H)
    q_dot = velocity_of(ticks.q, machine.velocity_samples, machine.rate)
    rows = np.stack([ticks.q, q_dot, np.roll(ticks.u, 1, axis=0)], axis=-1)  # (T, n, 3)
    rows[0, :, 2] = 0.0
    padded = np.concatenate([np.moveaxis(first, -1, 0)[1:], rows])
    windows = np.lib.stride_tricks.sliding_window_view(padded, H, axis=0)
    return np.array(windows, np.float32)


def expected_commands(machine: Machine, policy: Policy, ticks: Ticks, history: Array) -> Array:
    """Commands (T, n) of the policy at each tick for a history (T, n, 3, H)."""
    frames = forward_kinematics(machine, history[..., 0, -1])
    v_tool = tool_velocity(frames, history[..., 1, -1])
    v_goal = ticks.v_goal.astype(np.float32)
    integral = np.zeros((len(v_goal), 3), np.float32)
    for t in range(1, len(v_goal)):
        if ticks.driving[t - 1]:
            integral[t] = integrate_error(machine, v_goal[t - 1], v_tool[t], integral[t - 1])
    measured = measure(machine, history, v_goal, integral)
    action = policy.act(np.clip(features(machine, measured, policy.paper), -1e4, 1e4))
    u = action_to_pwm(machine, np.clip(action, -2, 2), policy.paper)
    rest = np.zeros((), np.int64)
    for t in range(len(u)):
        rest = rest * (ticks.driving[t] and ticks.driving[max(t - 1, 0)])  # as `hw.Drive` restarts
        u[t], _, rest = command_at_rest(machine, policy.valves, u[t], v_goal[t], rest)
    return np.asarray(u)


def command_error(
    machine: Machine, policy: Policy, ticks: Ticks, history: Array, change: Change = np.array
) -> float:
    """Mean difference of the sent commands from the expected ones, while driving."""
    u = change(expected_commands(machine, policy, ticks, history))
    limit = machine.pwm_limit / PWM_MAX
    driving = ticks.driving & np.roll(ticks.driving, 1)
    error = np.abs(ticks.u - np.clip(u, -limit, limit))
    return float(error[driving][:, machine.driven].mean())


def motion_error(machine: Machine, policy: Policy, u: Array, q: Array) -> float:
    """Mean difference of the velocities of free runs of the nets, in deviations of the measured."""
    velocities, measured = net_velocities(machine, policy, u, q)
    scale = np.maximum(measured.std(axis=(0, 1)), 0.02)
    return float(np.sqrt(np.mean(np.square((velocities - measured) / scale))))


def net_velocities(machine: Machine, policy: Policy, u: Array, q: Array) -> tuple[Array, Array]:
    """Velocities [rad/s] (ticks, runs, n_driven) of free runs of the nets, and the measured ones.

    A run begins every `AHEAD` seconds with what was measured.
    """
    driven, ticks = machine.driven, round(AHEAD * machine.rate)
    q_dot = velocity_of(q, machine.velocity_samples, machine.rate)
    recording = Recording("", u[:, driven], q[:, driven], q_dot[:, driven])
    starts = np.arange(machine.history, len(q) - ticks, ticks)
    _, velocities = free_run(policy.net, recording, starts, ticks)
    return velocities, recording.q_dot[starts + np.arange(1, ticks + 1)[:, None]]


def delay(x: Array, ticks: int) -> Array:
    """The same some ticks later."""
    return np.concatenate([x[:1].repeat(ticks, axis=0), x[:-ticks]])


def widen_zone(u: Array, more: float) -> Array:
    """Commands as valves get them whose dead zone is wider by `more`."""
    return np.asarray(np.sign(u) * np.maximum(np.abs(u) - more * (u != 0), 0))


def about(q: Array, change: Change, middle: Array) -> Array:
    """A change of angles from the middle of their ranges."""
    return middle + change(q - middle)


def joint_changes(machine: Machine, axes: int = 2) -> Iterator[tuple[str, Change]]:
    """Signs and orders of the driven joints: changes of arrays (T, n, ...) of some axes."""
    for i in machine.driven:
        sign = 1.0 - 2.0 * (np.arange(machine.n) == i)
        sign = sign.reshape(-1, *[1] * (axes - 2))
        yield f"sign of {machine.names[i]}", partial(np.multiply, sign)
    for i, j in combinations(machine.driven, 2):
        order = np.arange(machine.n, dtype=np.intp)
        order[[i, j]] = j, i
        names = f"{machine.names[i]}, {machine.names[j]}"
        yield f"order of {names}", partial(np.take, indices=order, axis=1)


def zeros(machine: Machine) -> Iterator[tuple[str, Array]]:
    """Wrong zeros of each driven joint [rad or m], (n,)."""
    for i in machine.driven:
        for zero in ZEROS:
            name = f"zero of {machine.names[i]}: {zero:+.2f} {UNITS[machine.joints[i].kind]}"
            yield name, zero * (np.arange(machine.n) == i)


def command_changes(machine: Machine) -> Iterator[tuple[str, Change]]:
    """Changes of commands (T, n): on their way, or within a machine."""
    for name, change in joint_changes(machine):
        yield f"{name} (command)", change
    for factor in SCALES:
        yield f"scale of commands: {factor:g}", partial(np.multiply, factor)
    for ticks in (1, 2):
        yield f"delay: {1e3 * ticks * machine.dt:.0f} ms more", partial(delay, ticks=ticks)
    for more in (0.03, 0.06, -0.03, -machine.dead_zone):
        yield f"dead zone: {more:+.2f}", partial(widen_zone, more=more)


def angle_changes(machine: Machine) -> Iterator[tuple[str, Change]]:
    """Changes of measured angles (T, n) back to what the nets know."""
    middle = (machine.column("q_min") + machine.column("q_max")) / 2
    for name, change in joint_changes(machine):
        yield f"{name} (angle)", partial(about, change=change, middle=middle)
    yield "scale of angles: 57.3", partial(np.multiply, 1 / degrees(machine))
    for factor in SCALES:
        yield f"scale of angles: {factor:.3g}", partial(np.multiply, 1 / factor)
    for name, zero in zeros(machine):
        yield f"encoder {name}", partial(np.add, -zero)


def degrees(machine: Machine) -> Array:
    """Degrees in a radian for revolute joints, 1 for prismatic ones, (n,)."""
    return np.array([180 / np.pi if j.kind == "revolute" else 1.0 for j in machine.joints])


def observation_changes(machine: Machine) -> Iterator[tuple[str, Change]]:
    """Changes of the history (T, n, 3, H) that a program gives its policy."""
    angle, velocity = np.array([[1.0], [0.0], [0.0]]), np.array([[0.0], [1.0], [0.0]])
    both = angle + velocity
    yield "one sample late", partial(delay, ticks=1)
    yield "order of the history", partial(np.flip, axis=-1)
    in_degrees = degrees(machine)[:, None, None] ** both
    yield "degrees instead of radians", partial(np.multiply, in_degrees)
    for factor in SCALES:
        yield f"scale of angles and velocities: {factor:g}", partial(np.multiply, factor**both)
        yield f"scale of velocities (rate): {factor:g}", partial(np.multiply, factor**velocity)
    for name, change in joint_changes(machine, axes=4):
        yield f"{name} (observation)", change
    for name, zero in zeros(machine):
        yield name, partial(np.add, zero[:, None, None] * angle)
