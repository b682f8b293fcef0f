"""The learned actuators: one small net a joint, run in NumPy, that stands for the machine in the simulation.

What it reads is a history: angle, velocity and command of the last 13 samples, the same that the policy and
the hardware keep. `fitting` makes nets from logs, `scores` judges them, `env` puts an arm on them.
"""

import hashlib
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brokk_min.identification.files import expected, load_arrays, load_header, whole_file
from brokk_min.machine import Array, estimate_velocity, valve_opening

FORMAT = 1  # of net files
STILL = 0.002  # rad, assumed: little more than a step of a 12-bit encoder
FINE = 0.02  # of full opening, assumed: below it nets see openings on a scale that is about linear


def rest_history(q: ArrayLike, samples: int) -> Array:
    """History of a joint that stood still at `q` [rad] (..., n): shape (..., n, 3, samples).

    Rows: angle [rad], velocity [rad/s], command [-1, 1]; newest sample last. The newest command is
    the one sent a tick before the newest angle was measured. Paper: Table 1

    Example:
        >>> rest_history(np.array([0.5, 1.0]), 3)[1]
        array([[1., 1., 1.],
               [0., 0., 0.],
               [0., 0., 0.]])
    """
    q = np.asarray(q)
    history = np.zeros((*q.shape, 3, samples), q.dtype)
    history[..., 0, :] = q[..., None]
    return history


def push_command(history: Array, u: ArrayLike) -> Array:
    """History (..., n, 3, H) and the command `u` (..., n) of this tick: the nets' input. Paper: Table 1"""
    result = history.copy(order="K")  # a choice of joints has them outermost, as products want them
    result[..., 2, :-1] = history[..., 2, 1:]
    result[..., 2, -1] = u
    return result


def push(history: Array, u: ArrayLike, q: ArrayLike, velocity: Callable[[Array], Array]) -> Array:
    """History (..., n, 3, H) a tick on: the command `u` was sent, then the angle `q` measured, (..., n) both.

    `velocity` turns the angles in the history (..., n, H) into the newest velocity (..., n) [rad/s].
    """
    result = np.empty(history.shape, history.dtype)
    result.reshape(-1)[:-1] = history.reshape(-1)[
        1:
    ]  # all rows at once; their newest samples follow
    result[..., 0, -1] = q
    result[..., 1, -1] = velocity(result[..., 0, :])
    result[..., 2, -1] = u
    return result


def valve_scale(u: ArrayLike, dead_zone: float) -> Array:
    """Commands as nets see them: what lies beyond the dead zone, on a logarithmic scale; same shape, -1..1.

    A valve is kept awake, or goes idle, by what it is opened within a few counts of its dead zone, and these
    are a hundredth of all commands. `dead_zone` is a share of full command; 0: `u` as it is, as the paper
    has it. Paper: Table 1 (u), Sec. 3.2 (7 %)

    Example:
        >>> valve_scale([-1.0, 0.07, 0.08, 0.1, 0.3], 0.07).round(2)
        array([-1.  ,  0.  ,  0.11,  0.24,  0.66])
    """
    u = np.asarray(u)
    if not dead_zone:
        return u
    opening = valve_opening(u, dead_zone)
    scaled: Array = np.copysign(
        np.log(1 + np.abs(opening) / FINE) / math.log(1 + 1 / FINE), opening
    )
    return scaled


def valve_scale_slope(u: Array, dead_zone: float) -> Array:
    """Derivative of `valve_scale` by `u`, same shape; 0 within the dead zone."""
    if not dead_zone:
        return np.ones_like(u)
    opening = np.abs(valve_opening(u, dead_zone))
    slope = (1 - dead_zone) * (FINE + opening) * math.log(1 + 1 / FINE)
    return np.asarray((opening > 0) / slope)


# --- nets -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ActuatorNet:
    """One small net a joint, run in NumPy: history in, mean velocity over the coming tick out.

    Paper: Table 1 and Sec. 3.3 (39 inputs, two hidden layers of 32, ReLU, sigmoid output)

    Weights are stacked over joints: (n, 3 H, 32), (n, 32), (n, 32, 32), (n, 32), (n, 32, 1), (n, 1).
    """

    joints: tuple[str, ...]
    history: int  # H, samples of q, q_dot and u
    rate: float  # Hz
    velocity_samples: int  # window of the velocity estimator that made the inputs
    velocity_logged: bool  # trained on q_dot columns of a log instead
    machine: str  # name of the machine, or of the log
    seed: int
    settings: dict[str, float]
    input_mean: Array  # (n, 3 H)
    input_scale: Array  # (n, 3 H)
    output_low: Array  # (n,) rad/s
    output_high: Array  # (n,) rad/s
    q_low: Array  # (n,) rad, smallest angle of the training log: the simulation stops there
    q_high: Array  # (n,) rad
    weights: tuple[Array, ...]
    dead_zone: float = 0.0  # of full command: they were trained on `valve_scale` of commands

    def select(self, joints: Sequence[str]) -> Self:
        """The same nets for some joints, in the order given; ValueError: a joint without a net."""
        if not set(joints) <= set(self.joints):
            raise ValueError(f"joints: expected nets for {list(joints)}, got {list(self.joints)}")
        index = [self.joints.index(name) for name in joints]
        arrays = {name: getattr(self, name)[index] for name in NET_ARRAYS}
        weights = tuple(weight[index] for weight in self.weights)
        return replace(self, joints=tuple(joints), weights=weights, **arrays)

    def predict(self, history: Array) -> Array:
        """Mean velocity over the coming tick [rad/s] (..., n), so that q(t+dt) = q(t) + dt * velocity.

        `history` is what `push_command` left, (..., n, 3, H). A joint that had no command beyond the dead
        zone and moved less than `STILL` during all of it stands, where a net alone would creep.
        """
        idle = (np.abs(history[..., 2, :]) <= self.dead_zone).all(axis=-1)
        velocity = self.velocity(history)
        velocity[idle & (np.abs(history[..., 0, -1] - history[..., 0, 0]) < STILL)] = 0.0
        return velocity

    def velocity(self, history: Array) -> Array:
        """What the nets alone say, as `predict`."""
        return self._layers(history)[0]

    def slope(self, history: Array) -> tuple[Array, Array]:
        """What the nets alone say, and its derivative by the history, (..., n, 3, H)."""
        velocity, fraction, second, first = self._layers(history)
        w1, _, w2, _, w3, _ = self._folded
        by = (self.output_high - self.output_low)[:, None, None] * fraction * (1 - fraction)
        by = by @ w3.swapaxes(1, 2) * (second > 0)
        by = by @ w2.swapaxes(1, 2) * (first > 0)
        by = (by @ w1.swapaxes(1, 2)).swapaxes(0, 1).reshape(history.shape)
        by[..., 2, :] *= valve_scale_slope(history[..., 2, :], self.dead_zone)
        return velocity, by

    def inputs(self, history: Array) -> Array:
        """What stands in a history (..., n, 3, H) as nets were shown it, in one row, (..., n, 3 H)."""
        n = len(self.joints)
        if history.shape[-3:] != (n, 3, self.history):
            raise ValueError(
                f"history: expected (..., {n}, 3, {self.history}), got {history.shape}"
            )
        if self.dead_zone:
            history = history.copy(order="K")
            history[..., 2, :] = valve_scale(history[..., 2, :].copy(order="K"), self.dead_zone)
        return history.reshape(*history.shape[:-2], 3 * self.history)

    def _layers(self, history: Array) -> tuple[Array, ...]:
        """Velocity as `velocity`, then what the layers say, (n, batch, units), the last first."""
        x = self.inputs(history)
        x = x.reshape(-1, *x.shape[-2:]).swapaxes(0, 1)  # (n, batch, 3 H)
        w1, b1, w2, b2, w3, b3 = self._folded
        first = np.maximum(x @ w1 + b1, 0)
        second = np.maximum(first @ w2 + b2, 0)
        fraction = 1 / (1 + np.exp(-(second @ w3 + b3)))
        low, high = self.output_low[:, None], self.output_high[:, None]
        velocity: Array = (low + (high - low) * fraction[..., 0]).T
        return velocity.reshape(history.shape[:-2]), fraction, second, first

    @cached_property
    def _folded(self) -> tuple[Array, ...]:
        """Weights with the normalisation of the inputs folded into the first layer."""
        w1, b1, w2, b2, w3, b3 = self.weights
        scaled = w1 / self.input_scale[..., None]
        shift = b1 - np.einsum("ni,nih->nh", self.input_mean, scaled)
        return scaled, shift[:, None], w2, b2[:, None], w3, b3[:, None]

    def step(self, history: Array, q: Array, u: ArrayLike) -> tuple[Array, Array]:
        """One tick of the simulation: history (..., n, 3, H), angle and command (..., n) -> the next.

        No joint goes further than it went in training.
        """
        predicted = self.predict(push_command(history, u))
        free, before = q + predicted / self.rate, q
        q = np.clip(free, np.minimum(q, self.q_low), np.maximum(q, self.q_high))

        def velocity(angles: Array) -> Array:
            if self.velocity_logged:
                return np.where(q == free, predicted, (q - before) * self.rate)
            return estimate_velocity(angles, self.velocity_samples, 1 / self.rate)

        return push(history, u, q, velocity), q


NET_ARRAYS = ("input_mean", "input_scale", "output_low", "output_high", "q_low", "q_high")


def net_arrays(net: ActuatorNet) -> dict[str, Any]:
    """Nets as named arrays, a JSON header among them: what a file holds."""
    plain = {
        f.name: getattr(net, f.name) for f in fields(net) if f.name not in (*NET_ARRAYS, "weights")
    }
    text = json.dumps({"format": FORMAT, "kind": "actuator net", **plain})
    arrays = {name: getattr(net, name) for name in NET_ARRAYS}
    arrays |= {f"weight_{i}": weight for i, weight in enumerate(net.weights)}
    return {"header": np.array(text), **arrays}


def fingerprint(net: ActuatorNet) -> str:
    """Hash of the nets, header and all: what was trained or tuned with them says so by it."""
    digest = hashlib.sha256()
    for name, array in net_arrays(net).items():
        digest.update(name.encode() + np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:16]


def net_from_arrays(path: Path, arrays: dict[str, NDArray[Any]]) -> ActuatorNet:
    """Nets from `net_arrays`; ValueError, naming `path`, for another format or arrays that do not fit."""
    header = load_header(path, arrays, "actuator net", FORMAT)
    with expected(path, "a complete actuator net"):
        header["joints"] = tuple(header["joints"])
        weights = tuple(arrays[f"weight_{i}"] for i in range(6))
        header |= {name: arrays[name] for name in NET_ARRAYS}
        net = ActuatorNet(**header, weights=weights)
        n, inputs, hidden = len(net.joints), 3 * net.history, weights[0].shape[-1]
        wanted = [
            (n, inputs, hidden),
            (n, hidden),
            (n, hidden, hidden),
            (n, hidden),
            (n, hidden, 1),
            (n, 1),
        ]
        wanted += [(n, inputs), (n, inputs), (n,), (n,), (n,), (n,)]
        found = [array.shape for array in (*weights, *(arrays[name] for name in NET_ARRAYS))]
        if found != wanted:
            raise ValueError(f"shapes {found} instead of {wanted}")
    return net


def save_net(path: Path, net: ActuatorNet) -> None:
    """Write nets as one `.npz`: weights plus a JSON header."""
    with whole_file(path) as file:
        np.savez(file, **net_arrays(net))


def load_net(path: Path) -> ActuatorNet:
    """Read nets that `save_net` wrote; ValueError as in `net_from_arrays`."""
    return net_from_arrays(path, load_arrays(path))
