"""The paper's preliminary tests and its sim-to-real gap, of a machine and of its nets.

Angles are exact and velocities are means over a tick: encoders and estimators play no part.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from brokk_min.actuator import Plant
from brokk_min.identification.validation import task_log
from brokk_min.kinematics import forward_kinematics, tool_position
from brokk_min.machine import PWM_MAX, Array, Machine, encode_pwm

PART = 5 / 8  # of the command limit, paper: 50 of 80 counts
SWEEP_S = 40.0  # s, assumed: long enough for a slow joint at the slow command
RISE = 0.63  # paper's response times: 0.4 s and 0.1 s, read as the time to 63 % of the change
GAP_S = 30.0  # s, paper
GAP_RUNS = 20  # assumed

Curves = Mapping[str, tuple[Array, Array]]  # x and y, (T,) each
Tests = Mapping[str, Curves]  # the curves of each of the paper's tests


class Gap(NamedTuple):
    """The difference of two motions, (T, runs, ...)."""

    q: Array  # rad, (..., n)
    q_dot: Array  # rad/s
    p_tool: Array  # m, (..., 3)
    v_tool: Array  # m/s


def simulate(machine: Machine, plant: Plant, q: Array, u: Array) -> Array:
    """True angles [rad] (T + 1, ..., n) from rest at `q` under commands `u` (T, ..., n)."""
    state = plant.reset(machine, q)
    angles = [state.q]
    for command in u:
        state = plant.step(machine, state, command)
        angles.append(state.q)
    return np.array(angles, float)


def preliminary_tests(machine: Machine, plant: Plant) -> Tests:
    """Range and direction, coupling, past movement of the last driven joint.

    It goes from stop to stop, while the others begin amid their ranges. Velocities [rad/s] over
    angles [rad] are by PWM byte, and at the limit alone or with others. Paper: Sec. 3.2, Fig. 2
    """
    joint, others = machine.driven[-1], machine.driven[:-1]
    slow, limit = np.array([round(PART * machine.pwm_limit), machine.pwm_limit]) / PWM_MAX
    u = np.zeros((5, machine.n))
    u[:, joint] = [slow, limit, -limit, -slow, limit]
    u[4, others] = -limit
    u[4, others[-1:]] = limit  # the last of them up, all others down, as in the paper
    low, high = machine.column("q_min"), machine.column("q_max")
    q = np.tile((low + high) / 2, (5, 1))
    q[:, joint] = np.where(u[:, joint] > 0, low[joint], high[joint])
    ticks = round(SWEEP_S * machine.rate)
    angles = simulate(machine, plant, q, np.tile(u, (ticks, 1, 1)))[..., joint]
    velocities = np.diff(angles, axis=0) * machine.rate
    ends = [1 + np.max(np.flatnonzero(q_dot), initial=0) for q_dot in velocities.T]  # it stands
    *alone, together = [(angles[1 : end + 1, i], velocities[:end, i]) for i, end in enumerate(ends)]
    names = [f"u = {encode_pwm(level)}" for level in u[:4, joint]]
    return {
        "range and direction": dict(zip(names, alone, strict=True)),
        "coupling": {"alone": alone[1], "with the others": together},
        "past movement": steps(machine, plant),
    }


def steps(machine: Machine, plant: Plant) -> Curves:
    """Velocity [rad/s] over time [s] at a step, from idle and half its opening. Paper: Sec. 3.2"""
    joint = machine.driven[-1]
    low, high = machine.column("q_min"), machine.column("q_max")
    wait = max(round(1.5 * machine.rate), 2 * machine.history)  # ticks before and after the step
    q = np.tile((low + high) / 2, (2, 1))
    q[:, joint] = 0.9 * low[joint] + 0.1 * high[joint]
    limit = machine.pwm_limit / PWM_MAX
    u = np.zeros((2 * wait, *q.shape))
    u[:wait, 1, joint] = (limit + machine.dead_zones[joint, 0]) / 2
    u[wait:, :, joint] = limit
    velocities = np.diff(simulate(machine, plant, q, u)[..., joint], axis=0) * machine.rate
    time = (np.arange(2 * wait) + 0.5 - wait) * machine.dt  # the middles of the ticks
    return {"idle": (time, velocities[:, 0]), "moving": (time, velocities[:, 1])}


def response_time(time: Array, velocity: Array) -> float | None:
    """Time [s] from the step at 0 to `RISE` of the change of velocity; None: no change."""
    first = np.flatnonzero(time < 0)[-1]
    time, change = time[first:], velocity[first:] - velocity[first]
    if change.max() < 1e-3:
        return None
    at = int(np.argmax(change >= RISE * change.max()))
    pair = slice(at - 1, at + 1)
    return max(float(np.interp(RISE * change.max(), change[pair], time[pair])), 0.0)


def sim_to_real(machine: Machine, both: Mapping[str, Plant], seed: int) -> Gap:
    """Nets less machine under commands that move several joints. Paper: Sec. 4.1, Fig. 5"""
    middle = (machine.column("q_min") + machine.column("q_max")) / 2
    start = np.array(machine.q_start or middle)
    log = task_log(machine, GAP_RUNS * 5 // 4, GAP_S, np.random.default_rng(seed), start)
    driven = [r.u for r in log.recordings if r.u[:, machine.driven].any()]
    u = np.stack(driven[:GAP_RUNS], axis=1)
    q = np.tile(start, (GAP_RUNS, 1))
    angles = {name: simulate(machine, plant, q, u) for name, plant in both.items()}
    tools = {name: tool_position(forward_kinematics(machine, of)) for name, of in angles.items()}
    q, p = (of["nets"] - of["machine"] for of in (angles, tools))  # (T + 1, runs, ...)
    q_dot, v = (np.diff(x, axis=0) * machine.rate for x in (q, p))
    return Gap(q[1:], q_dot, p[1:], v)
