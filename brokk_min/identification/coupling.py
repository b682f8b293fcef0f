"""What a log tells of joints that are not alone: one pump, weight; and how late a joint answers."""

import math

import numpy as np
from numpy.typing import NDArray

from brokk_min.identification.logs import Log, Samples, join_recordings
from brokk_min.machine import Array

LONGEST_DELAY = 1.5  # s that is searched, assumed
SPAN = 0.25  # s of history beyond the delay, assumed: the rise is seen, too
FEWEST = 40  # runs to judge by, assumed


def coupling(samples: Samples, starts: NDArray[np.intp], errors: Array) -> Array:
    """Part of each joint's error that each other joint explains, (n, n) in [0, 1]; nan: unknown.

    `errors` [rad/s] (ticks, s, n) are of the velocities in free runs from the samples `starts`
    (s,). The part is the R^2 that the other joint's angle and mean |u| add to the joint's own mean
    velocity, as they are and times this velocity, in the mean error of a run. Least squares, fitted
    on every other run and judged on the rest.
    """
    rows = starts + np.arange(len(errors))[:, None]
    effort = np.abs(samples.joined.u[rows]).mean(axis=0)  # (s, n)
    q, speed = samples.joined.q[starts], samples.joined.q_dot[rows].mean(axis=0)
    n = q.shape[1]
    result = np.full((n, n), np.nan)
    for j in range(n):
        moves = samples.moves[starts, j]
        error = errors[:, moves, j].mean(axis=0)
        own = [speed[moves, j], np.ones(moves.sum())]
        for k in range(n):
            others = [q[moves, k], effort[moves, k]]
            if k != j and moves.sum() >= FEWEST and max(map(np.ptp, others)) > 0:
                both = [*own, *others, *(own[0] * x for x in others)]
                more = explained(np.stack(both, 1), error) - explained(np.stack(own, 1), error)
                result[j, k] = max(0.0, more)
    return result


def explained(x: Array, y: Array) -> float:
    """R^2 of the least squares from inputs `x` (s, inputs) to `y` (s,), judged on odd rows.

    Example:
        >>> x = np.arange(8.0)[:, None]
        >>> explained(x, 3 * x[:, 0])
        1.0
    """
    solution, *_ = np.linalg.lstsq(x[::2], y[::2], rcond=None)
    left = np.square(y[1::2] - x[1::2] @ solution).sum()
    return float(max(0.0, 1 - left / max(np.square(y[1::2] - y[::2].mean()).sum(), 1e-12)))


def response_delays(log: Log) -> Array:
    """Seconds (n,) from a command to the motion that follows it best, over both directions.

    The largest correlation of max(u, 0), and of max(-u, 0), with the velocity in that direction by
    the delay between them: about delay and rise time together. nan: a joint without commands.
    """
    samples = join_recordings(log)
    u, q_dot = samples.joined.u, samples.joined.q_dot
    steps = round(LONGEST_DELAY * log.rate)
    at = samples.starts(0, steps + 1, 1)
    result = np.full(u.shape[1], np.nan)
    for j in range(u.shape[1]):
        for sign in (1, -1):
            command, speed = np.maximum(sign * u[:, j], 0), np.maximum(sign * q_dot[:, j], 0)
            if len(at) and np.ptp(command[at]) and np.ptp(speed[at]):
                fits = [np.corrcoef(command[at], speed[at + k])[0, 1] for k in range(steps + 1)]
                result[j] = np.fmax(result[j], int(np.nanargmax(fits)) / log.rate)
    return result


def history_of(log: Log, least: int) -> int:
    """Samples of history that span the latest answer of a joint and `SPAN`, `least` or more."""
    delays = response_delays(log)
    latest = float(np.nanmax(delays)) if np.isfinite(delays).any() else 0.0
    return max(least, math.ceil((latest + SPAN) * log.rate - 1e-6))
