"""Nets on their own outputs, and the plant, under given commands: free runs, step responses.

`recovery` is what nets recovered of a known plant, by the same experiments on both.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brokk_min.actuator import (
    ActuatorNet,
    append_command,
    append_sample,
    initial_history,
    plant_reset,
    plant_step,
)
from brokk_min.identification.logs import Log, Recording
from brokk_min.machine import PWM_MAX, Array, Machine

HELD = 2.0  # s, assumed: for which `recovery` holds a command
MOVES = 0.003  # rad or m, assumed: a joint that went so far in this time moves
BEGINS = 0.05  # of a change of velocity, assumed: then the response begins
RISE = 0.63  # paper's response times: 0.4 s and 0.1 s, read as the time to 63 % of the change
# angles (..., n) and commands (T, ..., n) -> angles (T+1, ..., n)
Simulator = Callable[[Array, Array], Array]


def free_run_step(net: ActuatorNet, history: Array, q: Array, u: Array) -> tuple[Array, Array]:
    """History and angles [rad] after a tick under `u`; no joint leaves the training's range."""
    velocity = net.predict(append_command(history, u))
    low, high = np.minimum(q, net.q_low), np.maximum(q, net.q_high)
    q_next = np.clip(q + velocity / net.rate, low, high)
    history = append_sample(history, u, q_next, net.velocity_samples, 1 / net.rate)
    if net.velocity_logged:
        history[..., 1, -1] = (q_next - q) * net.rate
    return history, q_next


def free_run(
    net: ActuatorNet, recording: Recording, starts: NDArray[np.intp], ticks: int
) -> tuple[Array, Array]:
    """Angles [rad] and velocities [rad/s] (ticks, s, n) of nets on their own outputs.

    Each run has the recorded commands and begins at one of the samples `starts` (s,).
    ValueError: one with less than a history before it.
    """
    if len(starts) and starts.min() < net.history:
        raise ValueError(f"starts: expected {net.history} or more, got {starts.min()}")
    rows = starts[:, None] + np.arange(1 - net.history, 1)
    history = np.stack([recording.q[rows], recording.q_dot[rows], recording.u[rows - 1]])
    history = history.transpose(1, 3, 0, 2).astype(np.float32)  # (s, n, 3, H)
    q: Array = recording.q[starts]
    angles, velocities = [], []
    for k in range(ticks):
        history, q = free_run_step(net, history, q, recording.u[starts + k])
        angles.append(q)
        velocities.append(history[..., 1, -1])
    return np.array(angles), np.array(velocities)


def plant_simulator(machine: Machine) -> Simulator:
    """The analytic plant, from rest."""

    def simulate(q: Array, u: Array) -> Array:
        state = plant_reset(machine, q)
        angles = [state.q]
        for command in u:
            state = plant_step(machine, state, command)
            angles.append(state.q)
        return np.array(angles)

    return simulate


def net_simulator(net: ActuatorNet) -> Simulator:
    """The nets, from rest."""

    def simulate(q: Array, u: Array) -> Array:
        history = initial_history(q, net.history).astype(np.float32)
        angles = [q]
        for command in u:
            history, q = free_run_step(net, history, q, command)
            angles.append(q)
        return np.array(angles)

    return simulate


def creep(net: ActuatorNet) -> Array:
    """Largest speed [rad/s] (n,) of joints without a command for 10 s, from 21 angles."""
    seconds = 10.0
    q = np.linspace(net.q_low, net.q_high, 21)
    angles = net_simulator(net)(q, np.zeros((round(seconds * net.rate), *q.shape)))
    return np.asarray(np.abs(angles[-1] - q).max(axis=0) / seconds)


def steps(
    simulate: Simulator, q_low: Array, q_high: Array, level: Array, before: Array, wait: int
) -> Array:
    """Angles (2 wait + 1, 2, 2, n, n) around a step of each joint alone to the command `level`.

    Axes: tick; from idle, or out of a motion under `before` (n,); up, down; stepping joint; joint.
    The step comes after `wait` ticks. The joint begins a tenth of its range from the end behind it.
    Paper: Sec. 3.2 (past movement)
    """
    n = len(level)
    sign = np.array([1, -1])[:, None, None]
    own = np.eye(n, dtype=bool)
    behind = np.where(sign > 0, 0.9 * q_low + 0.1 * q_high, 0.1 * q_low + 0.9 * q_high)
    q = np.broadcast_to(np.where(own, behind, (q_low + q_high) / 2), (2, 2, n, n))
    u = np.zeros((2 * wait, 2, 2, n, n))
    u[:wait, 1] = sign * own * before
    u[wait:] = sign * own * level
    return simulate(q, u)


def step_velocity(angles: Array, rate: float) -> Array:
    """Velocity of each stepping joint in its direction [rad/s] (2 wait, 2, 2, n)."""
    own = np.diagonal(angles, axis1=3, axis2=4)
    return np.asarray(np.diff(own, axis=0) * rate * np.array([[1], [-1]]))


def response_times(angles: Array, rate: float, rise: float = RISE) -> Array:
    """Time [s] (2, 2, n) from the step to `rise` of the change of velocity; nan: no change.

    Velocities are means over a tick, taken at its middle, with lines between them; none is < 0.
    """
    wait = (len(angles) - 1) // 2
    after = step_velocity(angles, rate)[wait - 1 :]
    change = after.max(axis=0) - after[0]
    part = (after - after[0]) / np.where(change > 1e-3, change, np.nan)
    at = np.maximum(np.argmax(part >= rise, axis=0), 1)  # row k: the tick k - 1 after the step
    high = np.take_along_axis(part, at[None], axis=0)[0]
    low = np.take_along_axis(part, at[None] - 1, axis=0)[0]
    return np.asarray(np.maximum(at - 0.5 - (high - rise) / (high - low), 0) / rate)


def step_commands(
    simulate: Simulator, q_low: Array, q_high: Array, level: Array, wait: int
) -> Array:
    """Commands (n,) half way to `level` from the least tenth of it that moves a joint."""
    fractions = np.arange(1, 11) / 10
    speeds = []
    for fraction in fractions:
        command = fraction * level
        velocity = step_velocity(steps(simulate, q_low, q_high, command, command, wait), 1.0)
        speeds.append(velocity[wait:, 0].max(axis=0).min(axis=0))  # (n,)
    moves = np.array(speeds) > 0.05 * speeds[-1]
    return np.asarray((fractions[np.argmax(moves, axis=0)] + 1) / 2 * level)


def step_tests(
    net: ActuatorNet, machine: Machine | None, level: Array, seconds: float
) -> list[tuple[Simulator, Array]]:
    """The nets, then a known machine, and their `steps` to `level` (n,), held for `seconds`."""
    simulators = [net_simulator(net)] + ([plant_simulator(machine)] if machine else [])
    low, high = net.q_low, net.q_high
    wait = max(round(seconds * net.rate), 2 * net.history)
    before = step_commands(simulators[0], low, high, level, wait)
    return [(simulate, steps(simulate, low, high, level, before, wait)) for simulate in simulators]


def named_times(times: Array, joints: Sequence[str]) -> dict[str, Any]:
    """Response times for JSON: {joint: {"idle": {"up", "down"}, "moving": {...}}} [s or None]."""
    result: dict[str, Any] = {}
    for j, name in enumerate(joints):
        result[name] = {}
        for kind, row in zip(("idle", "moving"), times[..., j], strict=True):
            up, down = (None if np.isnan(time) else float(time) for time in row)
            result[name][kind] = {"up": up, "down": down}
    return result


def log_response_times(
    net: ActuatorNet, log: Log, machine: Machine | None
) -> dict[str, dict[str, Any]]:
    """`named_times` to the largest command of a log, of the nets and of a known machine."""
    level = np.abs(np.concatenate([recording.u for recording in log.recordings])).max(axis=0)
    tests = step_tests(net, machine, level, 1.5)
    times = [named_times(response_times(angles, net.rate), net.joints) for _, angles in tests]
    return dict(zip(("response_time", "machine_response_time"), times, strict=False))


def recovery(net: ActuatorNet, machine: Machine) -> dict[str, dict[str, Any]]:
    """Of each joint numbers of the "nets" and of the "plant" of a machine with the same joints.

    Each is a pair, up and down: `dead_zone` of full command; `delay` [s] of a moving joint; `idle`,
    time from rest to 63 % of its velocity [s]; `speed` [rad/s or m/s] at the command limit.
    """
    level = np.full(machine.n, machine.pwm_limit / PWM_MAX)
    result: dict[str, dict[str, Any]] = {name: {} for name in net.joints}
    tests = step_tests(net, machine, level, HELD)
    for side, (simulate, angles) in zip(("nets", "plant"), tests, strict=True):
        wait = len(angles) // 2
        numbers = {
            "dead_zone": dead_zones(simulate, net, machine.pwm_limit, wait),
            "delay": response_times(angles, net.rate, BEGINS)[1],
            "idle": response_times(angles, net.rate)[0],
            "speed": step_velocity(angles, net.rate)[wait:, 0].max(axis=0),
        }
        for j, name in enumerate(net.joints):
            pairs = {key: values[:, j].tolist() for key, values in numbers.items()}
            finite = {k: [x if np.isfinite(x) else None for x in pair] for k, pair in pairs.items()}
            result[name][side] = finite
    return result


def dead_zones(simulate: Simulator, net: ActuatorNet, limit: int, wait: int) -> Array:
    """Largest command in whole counts of 127, up and down (2, n), that leaves a joint at rest."""
    counts = np.arange(1, limit + 1)
    u = np.stack([counts, -counts])[..., None] * np.ones(len(net.joints)) / PWM_MAX
    q = np.broadcast_to((net.q_low + net.q_high) / 2, u.shape)
    moves = np.abs(simulate(q, np.broadcast_to(u, (wait, *u.shape)))[-1] - q) > MOVES
    return np.where(moves.any(axis=1), moves.argmax(axis=1), limit) / PWM_MAX
