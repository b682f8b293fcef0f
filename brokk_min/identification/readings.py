"""Readings that are no measurements: a sensor that was not read, or one slower than the rows.

A file with them looks sound, because 0 and the last value are angles, too. Only the joint's own
motion tells them: it cannot go far in a row, nor stand still between two rows of fast motion.
"""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from brokk_min._files import brief
from brokk_min.fit import Rows
from brokk_min.machine import Array, require

MAX_GAP = 0.25  # s, or 2.5 samples, assumed: longer gaps cut a recording
NOISE = 0.01  # rad or m, assumed: such steps are no motion
FASTER = 2.0  # times the fastest motion, as in the safety gate: no joint does it
USUAL = 4.0  # times the 90 % quantile of noise in steps, assumed: none is beyond it
LASTS = 5  # rows, assumed: motion that lasts for three of them is real
TOO_FAST = 10.0  # times the fastest motion of a machine, of one that is unknown 1 rad/s (assumed)
ANGLES = {"deg": np.pi / 180, "mrad": 1e-3}  # rad, other units of angles
TURN = 0.3  # rad, assumed: so near 2 pi a jump is a turn
LEAST = 10  # fast steps, assumed, that tell how often a sensor is read


def rows_per_value(q: Array) -> float:
    """How many rows a joint keeps an angle while it moves fast, for a recording (T,).

    Where most of the large steps stand alone, rows between the sensor's readings repeat the last.
    """
    step = np.abs(np.diff(q))
    moved = step[step > 0]
    if len(moved) < LEAST:
        return 1.0
    fast = step > max(0.5 * np.quantile(moved, 0.9), 4 * moved.min())  # not single counts
    around = np.pad(step, 1)
    alone = (around[:-2] == 0) & (around[2:] == 0)
    repeats = fast.sum() >= LEAST and alone[fast].mean() > 0.5
    return float(np.median(np.diff(np.flatnonzero(step)))) if repeats else 1.0


def jumps(time: Array, q: Array, fastest: float) -> NDArray[np.bool_]:
    """Which angles (T,) are farther from the one before than any motion of the joint.

    `fastest` [rad/s] is the machine's, 0 if unknown; motion that lasts may be faster, and a noisy
    sensor may have steps of several times its usual ones.
    """
    result = np.zeros(len(q), bool)
    rows = np.flatnonzero(np.append(True, (np.diff(q) != 0) | (rows_per_value(q) == 1)))
    if len(rows) > 1:
        step, dt = np.diff(q[rows]), np.diff(time[rows])
        dt = np.maximum(dt, np.median(dt))
        around = np.pad(step / dt, LASTS // 2, mode="symmetric")
        lasting = np.median(sliding_window_view(around, LASTS), axis=-1)
        noise = USUAL * np.quantile(np.abs(step - lasting * dt), 0.9)
        reach = NOISE + FASTER * max(fastest, np.abs(lasting).max()) * dt
        result[rows[1:]] = np.abs(step) > np.maximum(reach, noise)
    return result


def unread(time: Array, q: Array, fastest: float) -> NDArray[np.bool_]:
    """Which angles (T,) were not read: what stands between two jumps for less than `MAX_GAP`.

    Or does not move there, though the joint does elsewhere: without a value a sensor keeps one
    that no joint could reach, such as 65535 counts.
    """
    jump = jumps(time, q, fastest)
    if not jump.any():
        return jump
    between = np.cumsum(jump)  # number of jumps up to each row
    shortest = max(3 * rows_per_value(q), MAX_GAP / float(np.median(np.diff(time))))
    short = np.bincount(between)[between] < shortest
    others = np.flatnonzero(~short)
    if short.any() and len(others) > 1:  # without these, the others may be one motion
        short[others] = unread(time[others], q[others], fastest)
        return short
    begins = np.flatnonzero(np.diff(between, prepend=-1))
    still = np.maximum.reduceat(q, begins) == np.minimum.reduceat(q, begins)
    still &= not still.all()  # of a joint that moves
    return np.asarray(short | still[between])


def check_run(
    run: str, time: Array, q: Array, rate: float, joints: Sequence[str], fastest: Array
) -> None:
    """ValueError: `time` does not rise, or is in a unit in which joints move at `TOO_FAST`.

    Or new angles come more slowly than at `rate` [Hz].
    """
    step = np.diff(time)
    got = f"a step of {step.min():.6g} at {time[step.argmin()]:.6g}"
    require(step.min() > 0, f"run {run}, column time", "stamps that rise", got)
    rows = np.array([rows_per_value(angle) for angle in q.T])
    period = np.median(step) * rows  # s, of new angles
    slow = [name for name, dt in zip(joints, period, strict=True) if dt > 1.05 / rate]
    units = {"ms": 1e3, "us": 1e6, "ns": 1e9}
    fits = [unit for unit, of in units.items() if 1.05 / rate > period.max() / of > 1e-4]
    other = fits and np.median(step) > 1.05 / rate  # the rows are too slow, not the angles alone
    doubt = f" (if in {fits[0]}: --map time=COLUMN:{fits[0]})" if other else ""
    wanted = f"new angles at the machine's {rate:g} Hz or more{doubt}"
    sensors = f"q of {brief(slow)}, one every {rows.max():g} rows"
    where = sensors if rows.max() > 1 else "column time"
    require(not slow, f"run {run}, {where}", wanted, f"{1 / period.max():.3g} Hz")
    for name, angle in zip(joints, q.T, strict=True):
        steps = np.nan_to_num(np.abs(np.diff(angle)))
        turns = np.sum(np.abs(steps - 2 * np.pi) < TURN) * (np.quantile(steps, 0.9) < TURN)
        wanted, got = "an angle that goes on beyond a turn", f"{turns} jumps by a turn: unwrap it"
        require(turns < 2, f"run {run}, q_{name}", wanted, got)
    lag = len(q) // 20  # over so many rows neither noise nor single jumps count
    if lag > 1:
        speeds = np.nan_to_num(np.abs(q[lag:] - q[:-lag])) / (time[lag:] - time[:-lag])[:, None]
        usual, limit = np.quantile(speeds, 0.9, axis=0), TOO_FAST * np.where(fastest, fastest, 1.0)
        for name, speed, most in zip(joints, usual, limit, strict=True):
            plausible = FASTER * most / TOO_FAST
            unit = next((x for x, rad in ANGLES.items() if rad * speed <= plausible), "UNIT")
            got = f"{speed:.3g} in {time[-1] - time[0]:.3g} s altogether"
            doubt = f"another unit (--map time=COLUMN:UNIT, or {name}=COLUMN:{unit})?"
            wanted = f"speeds of q_{name} up to {most:.3g} rad/s"
            require(speed <= most, f"run {run}, column time", wanted, f"{got}: {doubt}")


def pieces_of(
    time: Array, q: Array, rate: float, fastest: Array
) -> tuple[list[Rows], NDArray[np.bool_]]:
    """Rows of each piece of a recording, and wrong angles (T, n): unread, or at another zero.

    Such an angle cuts a recording, and so does a gap, in time or of rows with an unread angle,
    that is longer than `MAX_GAP` and 2.5 samples.
    """
    each = list(zip(q.T, fastest, strict=True))
    bad = np.isnan(q)
    for j, (angle, speed) in enumerate(each):
        known = np.flatnonzero(~bad[:, j])
        bad[known, j] = unread(time[known], angle[known], speed)
    good = np.flatnonzero(~bad.any(axis=1))
    gap = np.diff(time[good]) > longest_gap(rate)
    cuts = np.zeros_like(bad)
    cuts[good] = np.stack([jumps(time[good], angle[good], speed) for angle, speed in each], axis=1)
    pieces = np.split(good, np.flatnonzero(gap | cuts[good[1:]].any(axis=1)) + 1)
    return [piece for piece in pieces if len(piece)], bad | cuts


def longest_gap(rate: float) -> float:
    """The longest time between two rows of one recording [s]."""
    return max(MAX_GAP, 2.5 / rate)


def left_out(wrong: NDArray[np.bool_], q: Array, joints: Sequence[str]) -> Iterator[str]:
    """A warning for joints with `wrong` angles `q` (rows, n) of a table, one for those alike."""
    alike: dict[tuple[int, str, int], list[str]] = {}
    for name, bad, angle in zip(joints, wrong.T, q.T, strict=True):
        if bad.any():
            row = int(bad.argmax())
            turn = abs(abs(angle[row] - angle[row - 1]) - 2 * np.pi) < TURN
            doubt = "by a turn: unwrap it" if turn else "was the sensor not read?"
            got = f"a jump to {angle[row]:.4g} ({doubt})"
            alike.setdefault((row, got, bad.sum()), []).append(f"q_{name}")
    for (row, got, rows), names in alike.items():
        got = f"{got} in {rows} rows"
        what = "which are left out or begin a new recording"
        yield f"row {row + 2}: expected motion of {', '.join(names)}, got {got}, {what}"
