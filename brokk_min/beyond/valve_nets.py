"""Actuator nets that read what a command opens, not the command itself.

What it changes: the paper's nets read the commands as they are (Table 1), although within the dead
zone all commands do the same and a few counts beyond it decide whether a valve stays open. These
nets read the opening beyond the dead zone, companded by the mu law, and an indicator of whether the
valve opens at all. A joint that was idle and still for the whole history does not creep.

What it buys, with the richer log, free runs and five nets a joint: the optimised PID errs on the
nets by 0.0181 m/s and on the machine by 0.0177 m/s; on nets as printed it has 0.0483 m/s
(`benchmarks.deviations d7`).

Who was first: the mu law is ITU-T G.711 (1972); inverting a dead zone before identification is
common practice (Tao and Kokotovic, Adaptive Control of Systems with Actuator and Sensor
Nonlinearities, 1996).

It plugs into `actuator.ActuatorNet.inputs`; `identification.fitting` trains it.
"""

import math
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

from brokk_min.actuator import ActuatorNet
from brokk_min.machine import Array

MU = 50.0  # assumed: the mu law is about linear below 1/50 of full opening
INDICATOR_SCALE = 0.02  # of full opening, assumed: 2.4 counts of 127 at a dead zone of 7 %
STANDSTILL = 0.002  # rad, assumed: little more than one step of a 12-bit encoder


def valve_inputs(history: Any, dead_zones: Any, xp: ModuleType = np) -> Any:
    """What these nets read of histories (..., n, 3, H): (..., n, 4 H), by NumPy or torch (`xp`).

    Angles, velocities, mu law and indicator of the openings; `dead_zones` (n, 2) are up and down.
    """
    q, q_dot, u = history[..., 0, :], history[..., 1, :], history[..., 2, :]
    x = opening(u, dead_zones, xp)
    return xp.concatenate([q, q_dot, mu_law(x, xp), open_indicator(x, xp)], axis=-1)


def opening(u: Any, dead_zones: Any, xp: ModuleType = np) -> Any:
    """`machine.valve_opening` of commands (..., n, H) with dead zones (n, 2), by NumPy or torch."""
    up, down = dead_zones[:, :1], dead_zones[:, 1:]
    return (u - xp.clip(u, -down, up)) / (1 - xp.where(u > 0, up, down))


def mu_law(x: Any, xp: ModuleType = np) -> Any:
    """sign(x) ln(1 + mu |x|) / ln(1 + mu) of openings x (...)."""
    return xp.sign(x) * xp.log1p(MU * xp.abs(x)) / math.log1p(MU)


def open_indicator(x: Any, xp: ModuleType = np) -> Any:
    """tanh(|x| / 0.02) of openings x (...): 0 if the valve stays closed, about 1 if it opens.

    A closed valve answers late. When it answers depends on how long it has had commands, and hardly
    on how large they are.
    """
    return xp.tanh(xp.abs(x) / INDICATOR_SCALE)


@dataclass(frozen=True, eq=False)
class ValveNet(ActuatorNet):
    """An `ActuatorNet` that reads `valve_inputs`, I = 4 H."""

    dead_zones: Array  # of its joints up and down, of full command, (n, 2)

    def inputs(self, history: Array) -> Array:
        """`valve_inputs` of histories (..., n, 3, H)."""
        return np.asarray(valve_inputs(history, self.dead_zones.astype(history.dtype)))

    def predict(self, history: Array) -> Array:
        """As `ActuatorNet.predict`, but a joint that its valve has held stands still."""
        moved = np.abs(history[..., 0, -1] - history[..., 0, 0]) >= STANDSTILL
        opened = (opening(history[..., 2, :], self.dead_zones) != 0).any(axis=-1)
        return np.asarray(super().predict(history) * (moved | opened))
