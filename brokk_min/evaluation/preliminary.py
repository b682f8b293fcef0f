"""The paper's preliminary tests and its sim-to-real gap, of a machine and of its nets.

Angles are exact and velocities are means over a tick: encoders and estimators play no part.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from brokk_min.actuator import PLANT, ActuatorNet, Plant
from brokk_min.identification.excitation import task_log
from brokk_min.identification.net_file import select_nets
from brokk_min.kinematics import forward_kinematics, tool_position
from brokk_min.machine import PWM_MAX, Array, Machine, encode_pwm

SLOW = 5 / 8  # of the command limit, paper: 50 of 80 counts
SWEEP_S = 40.0  # s, assumed: long enough for a slow joint at the slow command
RISE = 0.63  # paper's response times: 0.4 s and 0.1 s, read as the time to 63 % of the change
GAP_S = 30.0  # s, paper
GAP_RUNS = 20  # assumed


class Sweep(NamedTuple):
    """A joint from stop to stop, (T,) each."""

    q: Array  # rad
    q_dot: Array  # rad/s


class SimulatorTests(NamedTuple):
    """The preliminary tests of one simulator with its last driven joint."""

    sweeps: dict[str, Sweep]  # by PWM byte
    coupling: dict[str, Sweep]  # at the command limit, alone and with the other joints
    past_movement: dict[str, tuple[Array, Array]]  # time [s] and velocity [rad/s] around a step
    response_time: dict[str, Any]  # s, of all driven joints, see `named_times`


class Motion(NamedTuple):
    """Motion of a machine, or the difference of two, (T, runs, ...)."""

    q: Array  # rad, (..., n)
    q_dot: Array  # rad/s
    p_tool: Array  # m, (..., 3)
    v_tool: Array  # m/s


class Preliminary(NamedTuple):
    """All preliminary measurements."""

    tests: dict[str, SimulatorTests]  # of machine and nets
    gap: Motion  # nets less machine


def run(machine: Machine, net: ActuatorNet, seed: int) -> Preliminary:
    """Test the machine and its nets, and compare them. Paper: Sec. 3.2 and 4.1"""
    both: dict[str, Plant] = {"machine": PLANT, "nets": select_nets(machine, net)}
    tests = {name: preliminary_tests(machine, plant) for name, plant in both.items()}
    return Preliminary(tests, sim_to_real(machine, both, seed))


def simulate(machine: Machine, plant: Plant, q: Array, u: Array) -> Array:
    """True angles [rad] (T + 1, ..., n) from rest at `q` under commands `u` (T, ..., n)."""
    state = plant.reset(machine, q)
    angles = [state.q]
    for command in u:
        state = plant.step(machine, state, command)
        angles.append(state.q)
    return np.array(angles, float)


def preliminary_tests(machine: Machine, plant: Plant) -> SimulatorTests:
    """Range and direction, coupling, past movement. Paper: Sec. 3.2, Fig. 2"""
    joint = int(machine.driven[-1])
    limit = machine.pwm_limit / PWM_MAX
    slow = round(SLOW * machine.pwm_limit) / PWM_MAX
    u = np.zeros((5, machine.n))
    u[:, joint] = [slow, limit, -limit, -slow, limit]
    u[4] += other_commands(machine, joint)
    *alone, together = sweeps(machine, plant, joint, u)
    names = [f"u = {encode_pwm(level)}" for level in u[:4, joint]]
    velocity = step_velocities(machine, plant)
    wait = len(velocity) // 2
    from_idle, moving = velocity[:, :, 0, -1].T
    time = (np.arange(2 * wait) + 0.5 - wait) * machine.dt
    return SimulatorTests(
        dict(zip(names, alone, strict=True)),
        {"alone": alone[1], "with the others": together},
        {"from idle": (time, from_idle), "while moving": (time, moving)},
        named_times(machine, response_times(velocity, machine.rate)),
    )


def other_commands(machine: Machine, joint: int) -> Array:
    """The other driven joints at the limit (n,): the last up, all others down, as in the paper."""
    u = np.zeros(machine.n)
    others = machine.driven[machine.driven != joint]
    u[others[:-1]] = -machine.pwm_limit / PWM_MAX
    u[others[-1:]] = machine.pwm_limit / PWM_MAX
    return u


def sweeps(machine: Machine, plant: Plant, joint: int, u: Array) -> list[Sweep]:
    """A joint from stop to stop under each row of constant commands `u` (k, n).

    The others begin amid their ranges. A sweep ends when the joint stands. Paper: Sec. 3.2
    """
    low, high = machine.column("q_min"), machine.column("q_max")
    q = np.tile((low + high) / 2, (len(u), 1))
    q[:, joint] = np.where(u[:, joint] > 0, low[joint], high[joint])
    ticks = round(SWEEP_S * machine.rate)
    angles = simulate(machine, plant, q, np.tile(u, (ticks, 1, 1)))[..., joint]
    velocities = np.diff(angles, axis=0) * machine.rate
    result = []
    for q_joint, q_dot in zip(angles[1:].T, velocities.T, strict=True):
        end = 1 + np.max(np.flatnonzero(q_dot), initial=0)
        result.append(Sweep(q_joint[:end], q_dot[:end]))
    return result


def step_velocities(machine: Machine, plant: Plant) -> Array:
    """Velocities (T, 2, 2, n_driven) of each driven joint around a step to the command limit.

    Axes: tick; from idle, or out of a motion at half the limit's opening; up, down; joint, which
    steps alone from a tenth of its range. The step comes after T / 2 ticks; velocities are means
    over a tick in the direction of the step [rad/s]. Paper: Sec. 3.2 (past movement)
    """
    low, high = machine.column("q_min"), machine.column("q_max")
    wait = max(round(1.5 * machine.rate), 2 * machine.history)
    own = np.eye(machine.n, dtype=bool)[machine.driven]  # (n_driven, n): who steps
    sign = np.array([1, -1])[:, None, None]
    behind = np.where(sign > 0, 0.9 * low + 0.1 * high, 0.1 * low + 0.9 * high)
    q = np.tile(np.where(own, behind, (low + high) / 2), (2, 1, 1, 1))
    limit = machine.pwm_limit / PWM_MAX
    half = (limit + machine.dead_zones.T[:, None]) / 2  # (2, 1, n)
    u = np.zeros((2 * wait, *q.shape))
    u[:wait, 1] = sign * own * half
    u[wait:] = sign * own * limit
    angles = simulate(machine, plant, q, u)[..., np.arange(len(own)), machine.driven]
    return np.asarray(np.diff(angles, axis=0) * machine.rate * np.array([[1], [-1]]))


def response_times(velocity: Array, rate: float, rise: float = RISE) -> Array:
    """Time [s] (2, 2, n) from the step to `rise` of the change of velocity; nan: no change.

    `velocity` is of `step_velocities`: means over a tick, taken at its middle, with lines between
    them. No time is below 0.
    """
    after = velocity[len(velocity) // 2 - 1 :]
    change = after.max(axis=0) - after[0]
    part = (after - after[0]) / np.where(change > 1e-3, change, np.nan)
    at = np.maximum(np.argmax(part >= rise, axis=0), 1)  # row k: the tick k - 1 after the step
    high = np.take_along_axis(part, at[None], axis=0)[0]
    low = np.take_along_axis(part, at[None] - 1, axis=0)[0]
    return np.asarray(np.maximum(at - 0.5 - (high - rise) / (high - low), 0) / rate)


def named_times(machine: Machine, times: Array) -> dict[str, Any]:
    """Response times for JSON: {joint: {"idle": {"up", "down"}, "moving": {...}}} [s or None]."""
    result: dict[str, Any] = {}
    for i, joint in enumerate(machine.driven):
        up_down = [[None if np.isnan(t) else float(t) for t in row] for row in times[..., i]]
        pairs = [dict(zip(("up", "down"), row, strict=True)) for row in up_down]
        result[machine.names[joint]] = dict(zip(("idle", "moving"), pairs, strict=True))
    return result


def sim_to_real(machine: Machine, both: Mapping[str, Plant], seed: int) -> Motion:
    """Nets less machine under commands that move several joints. Paper: Sec. 4.1, Fig. 5"""
    middle = (machine.column("q_min") + machine.column("q_max")) / 2
    start = np.array(machine.q_start or middle)
    log = task_log(machine, GAP_RUNS * 5 // 4, GAP_S, np.random.default_rng(seed), start)
    driven = [r.u for r in log.recordings if r.u[:, machine.driven].any()]
    u = np.stack(driven[:GAP_RUNS], axis=1)
    q = np.tile(start, (GAP_RUNS, 1))
    real, simulated = (
        motion(machine, simulate(machine, both[name], q, u)) for name in ("machine", "nets")
    )
    return Motion(*(one - other for one, other in zip(simulated, real, strict=True)))


def motion(machine: Machine, q: Array) -> Motion:
    """Motion at the ends of all ticks, from angles (T + 1, runs, n)."""
    p = tool_position(forward_kinematics(machine, q))
    velocities = (np.diff(x, axis=0) * machine.rate for x in (q, p))
    return Motion(q[1:], next(velocities), p[1:], next(velocities))


def numbers(machine: Machine, measured: Preliminary) -> dict[str, Any]:
    """Numbers of both figures, for JSON [rad/s, s, rad, m, m/s]."""
    plant, nets = measured.tests["machine"], measured.tests["nets"]
    sweep = {
        u: {
            "machine_peak": float(np.abs(plant.sweeps[u].q_dot).max()),
            "nets_peak": float(np.abs(nets.sweeps[u].q_dot).max()),
            "difference_rms": sweep_rms(plant.sweeps[u], nets.sweeps[u]),
        }
        for u in plant.sweeps
    }
    tests = measured.tests.items()
    return {
        "joint": machine.names[machine.driven[-1]],
        "sweep": sweep,
        "coupling_rms": {name: sweep_rms(*of.coupling.values()) for name, of in tests},
        "response_time": {name: of.response_time for name, of in tests},
        "sim_to_real": gap_numbers(machine, measured.gap),
    }


def sweep_rms(one: Sweep, other: Sweep) -> float:
    """RMS difference of two velocities at the same angles, without the outer twentieths."""
    q = np.linspace(one.q.min(), one.q.max(), 102)[6:-6]
    velocities = []
    for sweep in (one, other):
        order = np.argsort(sweep.q, kind="stable")
        velocities.append(np.interp(q, sweep.q[order], sweep.q_dot[order]))
    return float(np.sqrt(np.mean(np.square(velocities[0] - velocities[1]))))


def gap_numbers(machine: Machine, gap: Motion) -> dict[str, Any]:
    """Errors of the first run, as in the figure, and of the tool over all runs."""
    p_error = np.linalg.norm(gap.p_tool, axis=-1).mean(axis=0)  # m, of each run
    v_error = np.sqrt(np.mean(np.sum(gap.v_tool**2, axis=-1), axis=0))
    joints = {}
    for j in machine.driven:
        q_error = np.abs(gap.q[:, 0, j])
        joints[machine.names[j]] = {
            "velocity_rmse": float(np.sqrt(np.mean(gap.q_dot[:, 0, j] ** 2))),
            "position_error_mean": float(q_error.mean()),
            "position_error_max": float(q_error.max()),
        }
    runs = {"median": float(np.median(p_error)), "max": float(p_error.max()), "runs": len(p_error)}
    return {
        "tool": {"position_error_mean": float(p_error[0]), "velocity_rmse": float(v_error[0])},
        "joints": joints,
        "tool_position_error_mean_of_runs": runs,
    }
