"""Readings that are no measurements: a sensor that was not read, or one slower than the rows.

A file with them looks sound, because 0 and the last value are angles, too. Only the joint's own
motion tells them: it cannot go far in a row, nor stand still between two rows of fast motion.
"""

from collections.abc import Sequence

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from brokk_min._files import brief
from brokk_min.machine import Array, require

MAX_GAP = 0.25  # s, or 2.5 samples, assumed: longer gaps cut a recording
NOISE = 0.01  # rad or m, assumed: such steps are no motion
FASTER = 2.0  # times the fastest motion, as in the safety gate: no joint does it
USUAL = 4.0  # times the 90 % quantile of noise in steps, assumed: none is beyond it
LASTS = 5  # rows, assumed: motion that lasts for three of them is real
LEAST = 10  # fast steps, assumed, that tell how often a sensor is read


def rows_per_value(q: Array) -> Array:
    """How many rows a joint keeps an angle while it moves fast, (n,), for a recording (T, n).

    Where most of the large steps stand alone, rows between the sensor's readings repeat the last.
    """
    result = np.ones(q.shape[1])
    for j, step in enumerate(np.abs(np.diff(q, axis=0)).T):
        moved = step[step > 0]
        if len(moved) < LEAST:
            continue
        fast = step > max(0.5 * np.quantile(moved, 0.9), 4 * moved.min())  # not single counts
        around = np.pad(step, 1)
        alone = (around[:-2] == 0) & (around[2:] == 0)
        if fast.sum() >= LEAST and alone[fast].mean() > 0.5:
            result[j] = np.median(np.diff(np.flatnonzero(step)))
    return result


def jumps(time: Array, q: Array, fastest: float) -> NDArray[np.bool_]:
    """Which steps (T - 1,) of an angle (T,) are faster than any motion of the joint.

    `fastest` [rad/s] is the machine's, 0 if unknown; motion that lasts may be faster, and a noisy
    sensor may have steps of several times its usual ones.
    """
    dt = np.maximum(np.diff(time), np.median(np.diff(time)))
    step = np.diff(q)
    around = np.pad(step / dt, LASTS // 2, mode="symmetric")
    lasting = np.median(sliding_window_view(around, LASTS), axis=-1)
    noise = USUAL * np.quantile(np.abs(step - lasting * dt), 0.9)
    reach = NOISE + FASTER * max(fastest, np.abs(lasting).max()) * dt
    return np.asarray(np.abs(step) > np.maximum(reach, noise))


def unread(
    time: Array, q: Array, fastest: Array, repeats: Array
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which angles (T, n) of a recording were not read, and at which another zero begins.

    What stands between two jumps for less than `MAX_GAP` was not read. `repeats` (n,) are its
    `rows_per_value`.
    """
    bad, cuts = np.zeros((2, *q.shape), bool)
    for j, angle in enumerate(q.T):
        fresh = np.append(True, np.diff(angle) != 0) | (repeats[j] == 1)
        rows = np.flatnonzero(fresh)
        if len(rows) > 1:
            jump = jumps(time[rows], angle[rows], fastest[j])
            between = np.append(0, np.cumsum(jump))  # number of jumps before each row
            shortest = max(3, MAX_GAP / np.median(np.diff(time[rows])))
            short = (np.bincount(between)[between] < shortest) & jump.any()
            bad[:, j] = short[np.cumsum(fresh) - 1]
            kept = rows[~short]
            if len(kept) > 1:
                cuts[kept[1:], j] = jumps(time[kept], angle[kept], fastest[j])
    return bad, cuts


def check_run(run: str, time: Array, q: Array, rate: float, joints: Sequence[str]) -> Array:
    """`rows_per_value` of a recording; ValueError: what makes it none at `rate` [Hz].

    This is time that does not rise or has too few samples, an angle that jumps a turn, or a sensor
    that is slower than `rate`.
    """
    if len(time) < 2:
        return np.ones(len(joints))
    step, jump = np.diff(time), np.abs(np.diff(q, axis=0)).max()
    got = f"a step of {step.min():.6g} at {time[step.argmin()]:.6g}"
    require(step.min() > 0, f"run {run}, column time", "stamps that rise", got)
    median = float(np.median(step))
    wanted = f"s, at {rate:g} Hz, the machine's rate (--machine), or more"
    got = f"{1 / median:.3g} Hz (if it is in ms: --map time=COLUMN:ms)"
    require(median <= 1.05 / rate, f"run {run}, column time", wanted, got)
    wanted = "one drive, and angles that do not start again after a turn (numpy.unwrap)"
    turned = 1.5 * np.pi < jump < 2.5 * np.pi
    require(not turned, f"run {run}", wanted, f"a jump of {jump:.2f} rad")
    repeats = rows_per_value(q)
    slow, wanted = repeats * median > 1.05 / rate, f"new angles at {rate:g} Hz or more (--machine)"
    names = [name for name, is_slow in zip(joints, slow, strict=True) if is_slow]
    got = (
        f"a new one every {repeats.max():g} rows: sensors of {1 / (repeats.max() * median):.3g} Hz"
    )
    require(not names, f"run {run}, q of {brief(names)}", wanted, got)
    return repeats


def left_out(bad: NDArray[np.bool_], speed: Array, joints: Sequence[str]) -> list[str]:
    """A warning for each joint with unread angles `bad` (rows, n); `speed` of its steps [rad/s]."""
    result = []
    doubtful = bad | np.roll(bad, 1, axis=0)  # the step back, too
    for j, name in enumerate(joints):
        rows = np.flatnonzero(bad[:, j])
        if len(rows):
            wanted = f"q_{name} at {speed[~doubtful[:, j], j].max(initial=0):.3g} rad/s at most"
            got = f"{speed[rows, j].max():.3g} rad/s"
            result.append(
                f"row {rows[0] + 2}: expected {wanted}, as elsewhere, got {got}: the sensor was "
                f"not read in {len(rows)} of the rows, which are left out or begin a new recording"
            )
    return result
