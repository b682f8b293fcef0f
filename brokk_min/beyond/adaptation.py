"""A controller that learns its valves while it drives.

What it changes: the nets run beside the machine under the commands that were sent. A joint has the
velocity w in them and v on the machine. A second run, opened wider, gives dw/do. A valve that is k
times as fast as in the logs and opens by d more, on a machine that is later by tau and, while much
moves (S: sum of |w| / fastest of each joint), short of oil by c, has

    v = k (w + d dw/do) - c w max(0, S - 1/2) - tau dw/dt.

Least squares give these four for each joint and direction. What a valve has not shown yet it takes
from the mean of all, because cold oil slows them alike. All count only as far as they explain v
better than the logs do: by the factor 1 - 5 / R, where R is twice the logarithm of the ratio of
likelihoods. This is done twice: over the last minutes, and over the last seconds for what these
leave unexplained, as when oil warms up or a load is taken; for seconds 5 is 2. The opening o that
the controller asks for becomes o / k - d, and in its history it sees the commands that would have
done the same to the valves of its logs.

What it buys (`python -m benchmarks.adaptation`): with valves 20 % slower our agent's error is
0.0122 m/s and not 0.0210 m/s, and after a minute 0.0114 m/s, which is that of a controller that
knows its valves. Where nothing is wrong nothing changes.

Who was first: self-tuning regulators (Astrom and Wittenmark, 1973); Jensen et al. (2020) adapt two
states a valve on a loader crane; openpilot's torqued learns a car's steering within bounds; James
and Stein (1961) shrink many means at once.

It plugs in around any `Controller`. It needs the nets, and no training.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from brokk_min.actuator import ActuatorNet, append_command, append_sample, initial_history
from brokk_min.machine import (
    Array,
    Controller,
    Machine,
    Measured,
    by_direction,
    limit_command,
    valve_command,
    valve_opening,
)

# Of minutes, and of what seconds add to them:
# how far k - 1, k d, c and tau [s] of valves are from their mean, and this from 0 (assumed),
OWN = (0.15, 0.015, 0.05, 0.005), (0.1, 0.01, 0.02, 0.002)
SHARED = (0.1, 0.02, 0.3, 0.05), (0.2, 0.01, 0.05, 0.002)
LIKELIER = 5.0, 2.0  # twice a log of likelihoods' ratio, from which valves are other ones (tuned),
MEMORY, AT_REST = (20.0, 3.0), (100.0, 3.0)  # s of a valve's motion and of its rest (tuned)
NOISE = (0.0067, 0.0112, 0.0224)  # of v within 1 s: times the fastest, w, dw/dt (tuned)
LEAST = (0.01, 0.01, 0.03)  # of the fastest, of opening, of the range to its ends
ANSWER = (0.2, 0.03)  # of w and of the fastest: more than the noise of a joint that stands
SPEED, OPENING = (0.6, 1.5), 0.06  # bounds of k, and of |d|
WIDER, FOLLOWS = 0.02, 0.5  # of full opening; s, in which the nets follow measured angles


Prior = tuple[float, float, float, float]


class Known(NamedTuple):
    """What is known of each valve, up and down: sums over ticks, (..., n_driven, 2, ...).

    Of A and b each is there twice, over minutes and over seconds.
    """

    A: Array  # of f f^T / noise^2, (..., 2, 4, 4)
    b: Array  # of f (v - w) / noise^2, (..., 2, 4)
    seconds: Array  # of its motion that it remembers


def valves(known: Known) -> tuple[Array, Array]:
    """k and d of each valve, (..., n_driven, 2) both.

    What the last seconds tell comes on top of what minutes have told.
    """
    x = np.zeros(known.b[..., 0, :].shape)
    for i, prior in enumerate(zip(OWN, SHARED, LIKELIER, strict=True)):
        A, b = known.A[..., i, :, :], known.b[..., i, :]
        x = x + estimate(A, b - (A @ x[..., None])[..., 0], *prior)
    k = np.clip(1 + x[..., 0], *SPEED)
    return k, np.clip(x[..., 1] / k, -OPENING, OPENING)


def estimate(A: Array, b: Array, own: Prior, shared: Prior, likelier: float) -> Array:
    """The unknowns x of each valve, (..., n_driven, 2, 4), beyond those of the logs.

    They and their mean m minimise sum (v - w - f x)^2 / noise^2 + sum |(x - m) / own|^2
    + |m / shared|^2.
    """
    b, P = b[..., None], np.diag(np.power(own, -2.0))
    inverse = np.linalg.inv(A + P)
    of_m = np.diag(np.power(shared, -2.0)) + (P - P @ inverse @ P).sum(axis=(-4, -3))
    m = np.linalg.solve(of_m, (P @ inverse @ b).sum(axis=(-4, -3)))
    x = inverse @ (b + P @ m[..., None, None, :, :])
    ratio = (x * (2 * b - A @ x)).sum(axis=(-4, -3, -2, -1), keepdims=True)  # its log, twice
    return np.asarray((x * np.maximum(0, 1 - likelier / np.maximum(ratio, 1e-9)))[..., 0])


def unknown(shape: tuple[int, ...]) -> Known:
    """Nothing is known of the valves of joints (...)."""
    pairs = (*shape, 2)
    return Known(np.zeros((*pairs, 2, 4, 4)), np.zeros((*pairs, 2, 4)), np.zeros(pairs))


def begin(history: Array) -> Array:
    """Two runs of the nets (2, ..., 3, H), at rest at the mean angles: a history has noise."""
    return np.stack(2 * [initial_history(history[..., 0, :].mean(axis=-1), history.shape[-1])])


def learn(
    machine: Machine, net: ActuatorNet, known: Known, runs: Array, history: Array
) -> tuple[Known, Array]:
    """What is known, and the runs, after a tick that ends `history` (..., n_driven, 3, H)."""
    q_now, v, sent = np.moveaxis(history[..., -1], -1, 0)
    zones = machine.dead_zones[machine.driven]
    opening = valve_opening(sent, zones)
    u = np.stack([sent, valve_command(opening + WIDER * np.sign(opening), zones)])
    q = runs[..., 0, -1] + machine.dt * net.predict(append_command(runs, u))
    runs = append_sample(runs, u, q, machine.velocity_samples, machine.dt)
    runs[..., 0, :] += machine.dt / FOLLOWS * (q_now - q)[..., None]

    w, w_wider = runs[..., 1, -1]
    dw_do, dw_dt = (w_wider - w) / WIDER, (w - runs[0, ..., 1, -2]) / machine.dt
    fastest = np.maximum(net.output_high, -net.output_low)
    S = (np.abs(w) / fastest).sum(axis=-1, keepdims=True)
    f = np.stack([w, dw_do, -w * np.maximum(0, S - 0.5), -dw_dt], axis=-1)[..., None, :]
    noise = np.stack([fastest + 0 * w, w, dw_dt], axis=-1) * NOISE
    low, high = (machine.column(name)[machine.driven] for name in ("q_min", "q_max"))
    middle = np.abs(q_now - (low + high) / 2) / (high - low) < 0.5 - LEAST[2]
    moves = middle & (np.abs(w) > LEAST[0] * fastest) & (np.abs(w) > LEAST[1] * np.abs(dw_do))
    answers = moves & (v * np.sign(w) > np.maximum(ANSWER[0] * np.abs(w), ANSWER[1] * fastest))
    moves &= answers.any(axis=-1, keepdims=True)  # else the engine is off
    counts = np.stack([moves & (w > 0), moves & (w < 0)], axis=-1)
    weight = machine.dt * counts / np.square(noise).sum(axis=-1, keepdims=True)
    kept = np.exp(-machine.dt / np.where(counts[..., None], MEMORY, AT_REST))  # (..., 2, 2)
    A, b = f[..., None] * f[..., None, :], f * (v - w)[..., None, None]
    A = kept[..., None, None] * known.A + (weight[..., None, None] * A)[..., None, :, :]
    b = kept[..., None] * known.b + (weight[..., None] * b)[..., None, :]
    return Known(A, b, kept[..., 0] * known.seconds + machine.dt * counts), runs


def adapt(u: Array, zones: Array, k: Array, d: Array, inverse: bool = False) -> Array:
    """Commands (...) that do to these valves what `u` does to those of the logs, or inversely.

    Below the dead zone they are scaled, so that both dead zones end at the same `u`.
    """
    zone, k, d = (by_direction(u, pairs) for pairs in (zones, k, d))
    begins = np.maximum(zone - (1 - zone) * d, 0)  # to open
    before, after, gain = (begins, zone, k) if inverse else (zone, begins, 1 / k)
    size, first = np.abs(u), np.maximum(before, 1e-9)
    return np.sign(u) * (after * np.minimum(size / first, 1) + gain * np.maximum(size - before, 0))


@dataclass(eq=False)
class Adaptive:
    """A controller to which all valves seem to be those of its logs.

    What is known outlives `start`, because a drive starts anew whenever its switch is pressed.
    """

    inner: Controller
    net: ActuatorNet
    machine: Machine
    known: Known | None = None
    applies: bool = True  # False: it learns, and the controller's commands stay as they are

    def start(self, num: int) -> Any:
        """No run of the nets yet, and the controller's own state."""
        return None, self.inner.start(num)

    def __call__(self, measured: Measured, state: Any) -> tuple[Array, Any]:
        """Commands u (..., n), at which the valves open as the controller wants them to."""
        (runs, inner), m, history = state, self.machine, measured.history.copy()
        if self.known is None or self.known.seconds.shape[:-1] != history.shape[:-2]:
            self.known = unknown(history.shape[:-2])
        if runs is None:
            runs = begin(history)
        else:
            self.known, runs = learn(m, self.net, self.known, runs, history)
        (k, d), zones = valves(self.known), m.dead_zones[m.driven]
        if not self.applies:
            k, d = np.ones_like(k), np.zeros_like(d)
        pairs = zones[:, None], k[..., None, :], d[..., None, :]
        history[..., 2, :] = np.clip(adapt(history[..., 2, :], *pairs, inverse=True), -1, 1)
        u, inner = self.inner(measured._replace(history=history), inner)
        u = u.copy()
        u[..., m.driven] = adapt(u[..., m.driven], zones, k, d)
        return limit_command(m, u), (runs, inner)
