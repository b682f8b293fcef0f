"""What nets recovered of a known plant: the same experiments on both, joint by joint."""

from typing import Any

import numpy as np

from brokk_min.actuator import ActuatorNet
from brokk_min.identification.simulation import Simulator, response_times, step_tests, step_velocity
from brokk_min.machine import PWM_MAX, Array, Machine

SECONDS = 2.0  # assumed: for which a command is held
MOVES = 0.003  # rad or m, assumed: a joint that went so far in this time moves
BEGINS = 0.05  # of a change of velocity, assumed: then the response begins


def recovery(net: ActuatorNet, machine: Machine) -> dict[str, dict[str, Any]]:
    """Of each joint numbers of the "nets" and of the "plant" of a machine with the same joints.

    Each is a pair, up and down: `dead_zone` of full command; `delay` [s] of a moving joint; `idle`,
    time from rest to 63 % of its velocity [s]; `speed` [rad/s or m/s] at the command limit.
    """
    level = np.full(machine.n, machine.pwm_limit / PWM_MAX)
    result: dict[str, dict[str, Any]] = {name: {} for name in net.joints}
    tests = step_tests(net, machine, level, SECONDS)
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
