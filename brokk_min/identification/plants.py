"""Plants of your own, as `Machine.plant`: a simulator, or a machine that obeys commands."""

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import numpy as np

from brokk_min.identification.files import brief
from brokk_min.machine import Array, Machine


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
        """As `Plant.reset`."""
        return self._call("reset", self.plant.reset, np.shape(q), machine, np.array(q, float))

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
