"""The hydraulics that play the machine: an analytic plant, known to the evaluation and the tests alone.

The learner never sees these equations, only logs of what they do. One step is one tick of 1/rate seconds
under a held command, as it is for the nets that learn the machine (`actuator.ActuatorNet.step`).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from brokk_min.machine import PWM_MAX, Array, Machine, valve_opening


class PlantState(NamedTuple):
    """State of the analytic plant, arrays (..., n); `pending` are commands on their way."""

    q: Array  # rad
    speed: Array  # cylinder speed, m/s
    spool: Array  # -1..1
    ready: Array  # 0..1
    pending: tuple[Array, ...]  # the newest commands not yet through, newest first


def plant_reset(machine: Machine, q: ArrayLike) -> PlantState:
    """The plant at rest at angles `q` [rad] (..., n)."""
    q = np.array(q, float)
    zero = np.zeros_like(q)
    ticks = np.ceil(round(machine.delay / machine.plant_dt) / round(machine.dt / machine.plant_dt))
    return PlantState(q, zero, zero, zero, (zero,) * int(ticks))


def lever_arm(machine: Machine, q: ArrayLike) -> Array:
    """Distance from pivot to cylinder axis [m] at angles `q` [rad] (..., n). Paper: eq1 (r)

    Example:
        >>> from brokk_min.machine import BROKK_170
        >>> lever_arm(BROKK_170, [0.0, 0.5, 0.5, 1.7, 1.0]).round(3)
        array([0.15 , 0.337, 0.299, 0.247, 0.197])
    """
    base, rod = machine.column("cylinder_base"), machine.column("cylinder_rod")
    angle = np.asarray(q) + machine.column("cylinder_angle")
    length = np.sqrt(base**2 + rod**2 - 2 * base * rod * np.cos(angle))
    arm: Array = np.where(base > 0, base * rod * np.sin(angle) / length, rod)
    return arm


def plant_step(machine: Machine, state: PlantState, u: ArrayLike) -> PlantState:
    """One tick of the analytic plant under the held command `u` [-1, 1] (..., n), by explicit Euler steps.

    Spool with dead zone, readiness of an idle valve, shared pump flow, cylinder speed, lever arm. A
    command reaches the valve after `machine.delay`.

    Paper: eq1 and Sec. 3.2 (range, direction, coupling, past movement)
    """
    m, dt = machine, machine.plant_dt
    q, speed, spool, ready, _ = state
    commands = (np.array(u, float), *state.pending)  # a copy: it outlives the call
    openings = [valve_opening(command, m.dead_zone) for command in commands]
    up, down = m.column("speed_positive"), m.column("speed_negative")
    q_min, q_max, area = m.column("q_min"), m.column("q_max"), m.column("cylinder_area")
    steps, lag = round(m.dt / dt), round(m.delay / dt)
    for i in range(steps):
        opening = openings[-((i - lag) // steps)]
        gate = np.clip((ready - m.ready_threshold) / (1 - m.ready_threshold), 0.0, 1.0)
        gate = np.sqrt(gate * gate * (3 - 2 * gate))  # 0 up to the threshold: smoothstep(0) = 0
        demand = np.where(spool > 0, up, down) * spool * gate
        flow = np.sum(np.abs(area * demand), axis=-1, keepdims=True)
        supply = np.minimum(1.0, m.pump_flow / np.maximum(flow, 1e-12))
        target = np.abs(spool) > m.spool_idle
        rate = np.where(target > ready, m.ready_up_time, m.ready_down_time)
        q_next = q + dt * speed / lever_arm(m, q)
        speed = speed + dt * (demand * supply - speed) / m.cylinder_time
        spool, ready = (
            spool + dt * (opening - spool) / m.spool_time,
            ready + dt * (target - ready) / rate,
        )
        q = np.clip(q_next, q_min, q_max)
        outward = ((q >= q_max) & (speed > 0)) | ((q <= q_min) & (speed < 0))
        speed = np.where(outward, 0.0, speed)
    return PlantState(q, speed, spool, ready, commands[: len(state.pending)])


def speed_limits(machine: Machine, q: ArrayLike) -> tuple[Array, Array]:
    """Fastest negative and positive velocity [rad/s] (..., n) that a joint alone can hold at angles `q`.

    At the command limit. Paper: eq1
    """
    opening = valve_opening(machine.pwm_limit / PWM_MAX, machine.dead_zone)
    arm = lever_arm(machine, q)
    speeds = -machine.column("speed_negative"), machine.column("speed_positive")
    down, up = (opening * speed / arm for speed in speeds)
    return down, up
