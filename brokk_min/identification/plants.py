"""Plants of your own, as `Machine.plant`: a simulator, or a machine that obeys commands.

What would spoil a log of hours is refused at once: angles in degrees, a wrong sign, no motion.
"""

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import numpy as np

from brokk_min.actuator import plant_reset, plant_step
from brokk_min.identification.files import brief
from brokk_min.identification.logs import MOVED
from brokk_min.machine import PWM_MAX, Array, Machine

AT_RESET = 0.05  # rad or m, assumed: so far from where it was set a plant may be
TRIED = 2.0  # s of full command in which a joint must move


@runtime_checkable
class Plant(Protocol):
    """Two functions, of any object. States are the object's own, with an attribute `q`."""

    def reset(self, machine: Machine, q: Array) -> Any:
        """A state of machines at rest at angles `q` [rad] (..., n)."""

    def step(self, machine: Machine, state: Any, u: Array) -> Any:
        """The state one tick of `machine.dt` later, under held commands `u` [-1, 1] (..., n)."""


class CheckedPlant:
    """A plant of the user's file; ValueError: it fails, or its angles `q` are not finite."""

    def __init__(self, name: str, plant: Plant) -> None:
        self.name = name
        self.plant = plant

    def reset(self, machine: Machine, q: Array) -> Any:
        """As `Plant.reset`. ValueError, too: it does not stand at the angles `q`."""
        state = self._call("reset", self.plant.reset, np.shape(q), machine, np.array(q, float))
        wrong = np.abs(np.asarray(state.q) - q) > AT_RESET
        if wrong.any():
            wanted = f"{self.name}.reset: expected angles {np.asarray(q)[wrong][0]:.3f} [rad or m]"
            raise ValueError(f"{wanted} as given, got {np.asarray(state.q)[wrong][0]:.3f}")
        return state

    def step(self, machine: Machine, state: Any, u: Array) -> Any:
        """As `Plant.step`. ValueError, too: it changes the array of angles that it was given."""
        old: Any = getattr(state, "q", None)
        before = np.array(old)
        u = np.array(u, float)
        result = self._call("step", self.plant.step, u.shape, machine, state, u)
        if not np.array_equal(old, before):
            raise ValueError(f"{self.name}.step: expected a new array q, got the old one, changed")
        return result

    def _call(
        self, name: str, function: Callable[..., Any], shape: tuple[int, ...], *arguments: Any
    ) -> Any:
        wanted = f"{self.name}.{name}: expected a state with finite angles q [rad] {shape}"
        try:
            state = function(*arguments)
            q = np.asarray(state.q, float)
        except Exception as error:  # whatever the file does
            raise ValueError(f"{wanted}, got {brief(error)}") from error
        if q.shape != shape or not np.isfinite(q).all():
            raise ValueError(f"{wanted}, got {brief(q)}")
        return state


def check_motion(machine: Machine) -> None:
    """ValueError: a joint of the machine's plant stands still, runs away or obeys the wrong way.

    Each joint moves alone from mid range, at the command limit, up and down.
    """
    low, high = machine.column("q_min"), machine.column("q_max")
    middle = np.tile((low + high) / 2, (2 * machine.n, 1))
    u = machine.pwm_limit / PWM_MAX * np.concatenate([np.eye(machine.n), -np.eye(machine.n)])
    state = plant_reset(machine, middle)
    for _ in range(round(TRIED * machine.rate)):
        state = plant_step(machine, state, u)
    up, down = (np.diag(moved) for moved in np.split(state.q - middle, 2))
    for i, name in enumerate(machine.names):
        got = f"got {up[i]:+.3f} and {down[i]:+.3f} rad or m after {TRIED:g} s up and down"
        if max(abs(up[i]), abs(down[i])) < MOVED:
            raise ValueError(f"plant: {name}: expected motion under the largest command, {got}")
        if up[i] < 0 < down[i]:
            raise ValueError(f"plant: {name}: expected positive commands to raise q_{name}, {got}")
        if max(up[i], -down[i]) > high[i] - low[i]:
            raise ValueError(f"plant: {name}: expected angles within its range, {got}: degrees?")
