"""A small model of one joint by a log: delay, lag, dead zones and gains of both directions.

The command, later by a delay, less a dead zone, times a gain, through a first-order lag:

    q_dot' = (g_up max(u(t - d) - z_up, 0) - g_down max(-u(t - d) - z_down, 0) - q_dot) / tau

A grid gives delay, lag and dead zones, least squares the gains. Samples at which a joint is pushed
on at an end of its range do not count, if much more is explained so: it rests at its stop.
Recordings of slow ramps (`collect --excitation ramp`), if a log has any, give the dead zones: there
the delay hardly counts, and the curve beyond, such as a pump that starves, does not.
"""

import math
from collections.abc import Callable
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from brokk_min.identification.logs import COMMANDED, Recording
from brokk_min.machine import Array

AT_STOP = 0.01  # of the range of a log's angles, assumed: so near an end a joint may be at a stop
STOPS = 0.02  # of the motion, assumed: without stops the model explains 0.01 more at most
ZONE_STEP = 0.005  # of full command, assumed
ZONE_STEPS = 140  # assumed: dead zones of up to 0.7
TAUS = (0.05, 0.1, 0.2, 0.4)  # s, assumed
LATEST = 0.4  # s, assumed: longest delay
PAUSE = 2.0  # s, assumed: after so long a joint without commands is at rest
SETTLED = 0.7  # s after a gap, assumed: what was commanded in the gap is not known
SAMPLES = 20_000  # of a joint that are used
MOVED = 0.2  # of the usual gain, assumed: a ramp with less ended within the dead zone
SLOW = 0.12  # of full command in a second, assumed: ramps change by less
CLEAR_SIGN = 0.2  # of the velocities' variance: fast sines fit as well reversed and later


def is_ramp(u: Array, rate: float) -> bool:
    """Whether commands (T,) change slowly, from 0 on or to 0: no step, no constant one."""
    second = round(rate)
    if len(u) < second or np.ptp(u) < COMMANDED or np.abs(u).min() > COMMANDED:
        return False
    return bool(np.ptp(sliding_window_view(u, second), axis=-1).max() < SLOW)


def joint_model(recordings: list[Recording], j: int, rate: float) -> dict[str, Any]:
    """Fields of `JointReport` by the model above; dead zones by slow ramps that moved it."""
    ramps = [one for one in recordings if is_ramp(one.u[:, j], rate)]
    if not 0 < len(ramps) < len(recordings):
        return fit_model(recordings, j, rate)
    others = [one for one in recordings if not is_ramp(one.u[:, j], rate)]
    usual, by_ramps = fit_model(others, j, rate), fit_model(ramps, j, rate)
    zones = []
    for side in ("up", "down"):  # a ramp that ends within the dead zone has no gain
        moved = by_ramps[f"gain_{side}"] / (usual[f"gain_{side}"] or np.inf) > MOVED
        zones.append((by_ramps if moved else usual)[f"dead_zone_{side}"])
    return fit_model(others, j, rate, zones)


class Motion(NamedTuple):
    """What the model is fitted to: samples of one joint, recordings one after the other."""

    u: Array  # (T,)
    velocity: Array  # (T,), over the coming sample
    end: Array  # (T,), 1 where the joint comes to its greatest angle, -1 to its least, else 0
    counts: NDArray[np.bool_]  # (T,), not between recordings and just after a gap
    rate: float  # Hz


def motion_of(recordings: list[Recording], j: int, rate: float) -> Motion:
    """Joint `j` of recordings that begin at rest, or after a gap, and end at rest."""
    share = min(1.0, SAMPLES / sum(len(one.u) for one in recordings))  # of each, of a long log
    rest = round(PAUSE * rate)
    parts = []
    for one in recordings:
        u, q = (x[: math.ceil(share * len(x)), j] for x in (one.u, one.q))
        counts = np.arange(len(u)) >= (SETTLED * rate if "#" in one.name else 0)
        parts.append(
            (np.pad(u, (0, rest)), np.pad(q, (0, rest), "edge"), np.pad(counts, (0, rest)))
        )
    u, q, counts = map(np.concatenate, zip(*parts, strict=True))
    q_next = np.append(q[1:], q[-1])
    margin = AT_STOP * np.ptp(q)
    end = 1 * (q_next > q.max() - margin) - (q_next < q.min() + margin)
    return Motion(u, (q_next - q) * rate, end, counts, rate)


def fit_model(
    recordings: list[Recording], j: int, rate: float, zones: list[float] | None = None
) -> dict[str, Any]:
    """Fields of the model: the best of a grid, then of the dead zones unless they are given."""
    motion = motion_of(recordings, j, rate)
    whole = signed_model(motion._replace(end=0 * motion.end), zones)
    model = signed_model(motion, zones)
    return model if model["explained"] - whole["explained"] > STOPS else whole


def signed_model(motion: Motion, zones: list[float] | None) -> dict[str, Any]:
    """Fields of the model with gains of the better sign."""
    power = float(np.square(motion.velocity[motion.counts]).sum())
    models = {sign: best_model(motion, sign, zones) for sign in (1, -1)}
    errors = {sign: model.pop("error") for sign, model in models.items()}
    better = (errors[-1] - errors[1]) / max(power, 1e-12)
    sign = 1 if better > -CLEAR_SIGN else -1
    return {
        "explained": 1 - errors[sign] / power if power else 0.0,
        "sign": int(np.sign(better)) * int(abs(better) > CLEAR_SIGN),
        **models[sign],
    }


def best_model(motion: Motion, sign: int, given: list[float] | None = None) -> dict[str, float]:
    """The model with gains of one sign, by turns of a grid of delays and lags, and dead zones."""
    fit = partial(fit_gains, motion, sign)
    zones = given or [0.05, 0.05]
    for _ in range(2):
        grid = product(range(round(LATEST * motion.rate) + 1), TAUS)
        delay, tau = min(grid, key=lambda lag: fit(lag[0], lag[1], zones)[0])
        for side in () if given else (0, 1, 0, 1):
            zones = best_zone(partial(fit, delay, tau), zones, side)
    error, gains = fit(delay, tau, zones)
    return {
        "error": error,
        "delay": delay / motion.rate,
        "tau": tau,
        **dict(zip(("dead_zone_up", "dead_zone_down"), map(float, zones), strict=True)),
        **dict(zip(("gain_up", "gain_down"), gains.tolist(), strict=True)),
    }


def best_zone(fit: Callable[[list[float]], Any], zones: list[float], side: int) -> list[float]:
    """The dead zones with the best one of a side: of a coarse grid, then of a fine one around."""
    best = 0
    for step, low, high in ((4, 0, ZONE_STEPS), (1, -3, 4)):
        steps = range(max(0, best + low), best + high, step)
        trials = {k: [*zones[:side], k * ZONE_STEP, *zones[side + 1 :]] for k in steps}
        best = min(trials, key=lambda k: fit(trials[k])[0])
    return trials[best]


def fit_gains(
    motion: Motion, sign: int, delay: int, tau: float, zones: list[float]
) -> tuple[float, Array]:
    """Sum of the squared errors of the model with the best gains of a sign; and these gains."""
    from scipy.signal import lfilter  # slow to import

    up, down = zones
    late = np.concatenate([np.zeros(delay), motion.u])[: len(motion.u)]
    openings = np.stack([np.maximum(late - up, 0), -np.maximum(-late - down, 0)])
    a = np.exp(-1 / (motion.rate * tau))
    counts = motion.counts & (sign * late * motion.end <= 0)  # not if pushed on at an end
    x = lfilter([1 - a], [1, -a], openings)[:, counts]
    velocity = motion.velocity[counts]
    gains = np.linalg.lstsq(x @ x.T + 1e-9 * np.eye(2), x @ velocity, rcond=None)[0]
    gains = sign * np.maximum(sign * gains, 0)
    error = velocity - gains @ x
    return float(error @ error), gains
