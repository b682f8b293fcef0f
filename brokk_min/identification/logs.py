"""Logs of a machine: one table on disk, recordings at one rate in memory.

Columns `run,time,u_<joint>...,q_<joint>...`, one row per sample; `.csv`, or `.npz` with the same
columns as arrays. `run` is the name of the recording, time is in s, u in [-1, 1] of full command
(held until the next row), q in rad (m of prismatic joints). Other columns are not read: velocities
are estimated, because a bus carries angles alone. Joints may have any names. The rate must not be
below the machine's, and it may jitter.
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from brokk_min._files import brief, expected, whole_file, write_csv
from brokk_min.actuator import estimate_velocity
from brokk_min.identification.columns import TOPICS, Mapped, load_table
from brokk_min.identification.readings import MAX_GAP, check_run, left_out, unread
from brokk_min.machine import Array, Machine, require

RATE = 20.0  # Hz, paper: everything runs at 20 Hz; other machines have others
COMMANDED = 0.02  # of full command, assumed: more than a stick at rest gives
MOVED = 0.01  # rad or m, assumed: more than a parked joint creeps
MEAN_OF = 10  # samples of the held command in a tick, of which the mean is taken
LARGEST = 1e12  # of numbers in a log, assumed: any time, angle or velocity
Rows = NDArray[np.intp]


class Recording(NamedTuple):
    """One recording of a log: arrays (T, n) of command [-1, 1], angle [rad], velocity [rad/s]."""

    name: str
    u: Array
    q: Array
    q_dot: Array


class Log(NamedTuple):
    """Recordings of the same joints."""

    joints: tuple[str, ...]
    recordings: tuple[Recording, ...]
    rate: float = RATE  # Hz
    warnings: tuple[str, ...] = ()  # of what was left out


def machine_log(machine: Machine, recordings: Iterable[tuple[str, Array, Array]]) -> Log:
    """A log from names, commands and encoder angles (T, n) [rad]; velocities are estimated."""
    samples, rate = machine.velocity_samples, machine.rate
    result = [Recording(name, u, q, velocity_of(q, samples, rate)) for name, u, q in recordings]
    return Log(machine.names, tuple(result), rate=rate)


def velocity_of(q: Array, samples: int, rate: float = RATE) -> Array:
    """Causal velocity [rad/s] at each row of a recording `q` [rad] (T, n), at rest before it.

    `samples` is the window of `estimate_velocity`, `rate` [Hz] that of the rows.
    """
    padded = np.concatenate([np.repeat(q[:1], samples - 1, axis=0), q])
    windows = np.lib.stride_tricks.sliding_window_view(padded, samples, axis=0)
    return estimate_velocity(windows, samples, 1 / rate)


class Samples(NamedTuple):
    """The recordings of a log joined, N samples in all; a window must not cross their seams."""

    joined: Recording
    target: Array  # (N, n) rad/s, output of the nets, see `join_recordings`
    moves: NDArray[np.bool_]  # (N, n): the joint is `driven` in this recording
    lengths: list[int]  # of the recordings

    def starts(self, before: int, after: int, step: int) -> Rows:
        """Every `step`-th sample with `before` and `after` samples around it in its recording."""
        result = []
        seam = 0
        for length in self.lengths:
            result.append(seam + np.arange(before, length - after, step))
            seam += length
        return np.concatenate(result)

    def windows(self, history: int, ticks: int) -> list[Rows]:
        """Newest samples of windows of `history` samples, `ticks` before an end, of each joint."""
        ends = self.starts(history - 1, ticks, 1)
        return [ends[moves] for moves in self.moves[ends].T]


def driven(recording: Recording) -> NDArray[np.bool_]:
    """Which joints have a command or move in a recording (n,); a parked one may creep a little."""
    commanded = np.ptp(recording.u, axis=0) > COMMANDED
    return np.asarray(commanded | (np.ptp(recording.q, axis=0) > MOVED))


def join_recordings(log: Log) -> Samples:
    """Join the recordings of a log and add the target velocity of each sample.

    The target is the mean velocity of the coming tick, (q(t+dt) - q(t)) / dt. The last sample of a
    recording has none.
    """
    u, q, q_dot = map(np.concatenate, list(zip(*log.recordings, strict=True))[1:])
    target = np.diff(q, axis=0, append=0) * log.rate
    lengths = [len(recording.q) for recording in log.recordings]
    moves = [driven(recording) for recording in log.recordings]
    return Samples(Recording("", u, q, q_dot), target, np.repeat(moves, lengths, axis=0), lengths)


def split(log: Log) -> tuple[Log, Log]:
    """Recordings to fit to, and to score on: every tenth of those that drive the same joints.

    ValueError: no two recordings drive the same joints.
    """
    groups: dict[tuple[bool, ...], list[int]] = {}
    for i, recording in enumerate(log.recordings):
        groups.setdefault(tuple(driven(recording).tolist()), []).append(i)
    held_out = {i for group in groups.values() if len(group) > 1 for i in group[::10]}
    wanted = "two or more (column run) that drive the same joints, or --test"
    require(len(held_out) > 0, "recordings", wanted, len(log.recordings))
    kept = (one for i, one in enumerate(log.recordings) if i not in held_out)
    scored = (log.recordings[i] for i in sorted(held_out))
    return log._replace(recordings=tuple(kept)), log._replace(recordings=tuple(scored))


def in_order(log: Log, joints: Sequence[str]) -> Log:
    """A log whose arrays have the joints in this order. ValueError: it has other joints."""
    require(set(log.joints) == set(joints), "joints", brief(list(joints)), brief(list(log.joints)))
    order = [log.joints.index(name) for name in joints]
    recordings = (Recording(one.name, *(x[:, order] for x in one[1:])) for one in log.recordings)
    return log._replace(joints=tuple(joints), recordings=tuple(recordings))


def join_logs(logs: Mapping[Path, Log]) -> Log:
    """One log of several, by their files, with the joints in the order of the first one.

    ValueError: they have other joints, or all are empty.
    """
    first = next(iter(logs.values()))
    joined: list[Log] = []
    for path, log in logs.items():
        with expected(path, "a log"):
            joined.append(in_order(log, first.joints))
    recordings = tuple(one for log in joined for one in log.recordings)
    require(len(recordings) > 0, ", ".join(map(str, logs)), "at least one recording", "none")
    warnings = tuple(one for log in joined for one in log.warnings)
    return first._replace(recordings=recordings, warnings=warnings)


def write_log(path: Path, log: Log) -> None:
    """Write recordings as one table, `.csv` or `.npz` by the name; read it with `read_log`."""
    names = [recording.name for recording in log.recordings]
    lengths = [len(recording.u) for recording in log.recordings]
    time = np.concatenate([np.arange(length) / log.rate for length in lengths])
    columns: dict[str, Any] = {"run": np.repeat(names, lengths), "time": time}
    for kind in ("u", "q"):
        values = np.concatenate([getattr(recording, kind) for recording in log.recordings])
        columns |= {f"{kind}_{name}": values[:, i] for i, name in enumerate(log.joints)}
    if Path(path).suffix == ".csv":
        numbers = [np.char.mod("%.7g", column) for column in list(columns.values())[1:]]
        write_csv(path, columns, zip(columns["run"], *numbers, strict=True))
        return
    with whole_file(path) as file:
        np.savez_compressed(file, **columns)


def read_log(
    path: Path, machine: Machine, mapped: Mapped | None = None, topics: tuple[str, str] = TOPICS
) -> Log:
    """Check the table of a file, see `load_table`, and resample it at the rate of `machine`.

    The command is held and averaged over each tick, the angle interpolated. A gap longer than
    `MAX_GAP` and 2.5 samples cuts a recording, and so does an angle that jumps; rows in which a
    joint was not read count as a gap. A recording starts at rest; after a gap the rows are left
    out whose velocity would need samples of the gap. The joints may be others than those of the
    machine.
    ValueError: the file, and the row (1 is the header), the column or the run of the first error.
    """
    table = load_table(path, mapped or {}, topics)
    with expected(path, "a log"):
        joints = tuple(name[2:] for name in table if name.startswith("u_"))
        wanted = "u_<joint> (--map u_NAME=COLUMN:UNIT)"
        require(len(joints) > 0, "columns", wanted, brief(list(table)))
        recordings, warnings = _recordings(joints, table, machine)
        told = tuple(f"{path}: {one}" for one in warnings)
        return Log(joints, tuple(recordings), machine.rate, told)


def _recordings(
    joints: Sequence[str], table: Mapping[str, Any], machine: Machine
) -> tuple[list[Recording], list[str]]:
    """The recordings of a table, in the order in which they begin, and what was left out."""
    time = _numbers(table, ["time"])[:, 0]
    commands = _numbers(table, [f"u_{name}" for name in joints])
    angles = _numbers(table, [f"q_{name}" for name in joints])
    runs = _runs(table["run"])
    speeds = dict(zip(machine.names, machine.q_dot_max, strict=True))
    fastest = np.array([speeds.get(name, 0.0) for name in joints])
    wrong, speed = np.zeros(angles.shape, bool), np.zeros(angles.shape)
    recordings = []
    for run, rows in runs.items():
        t, u, q = time[rows], commands[rows], angles[rows]
        repeats = check_run(run, t, q, machine.rate, joints)
        bad, cuts = unread(t, q, fastest, repeats)
        wrong[rows] = bad | cuts
        speed[rows[1:]] = np.abs(np.diff(q, axis=0) / np.diff(t)[:, None])
        good = np.flatnonzero(~bad.any(axis=1))
        cut = np.diff(t[good]) > max(MAX_GAP, 2.5 / machine.rate)
        cut |= np.diff(np.cumsum(cuts.any(axis=1))[good]) > 0
        pieces = np.split(good, np.flatnonzero(cut) + 1)
        for part, piece in enumerate(pieces if len(good) else []):
            skipped = machine.velocity_samples - 1 if part else 0
            sampled = [x[skipped:] for x in _resample(t, u, q, piece, machine)]
            if len(sampled[0]):
                recordings.append(Recording(f"{run}#{part + 1}" if part else run, *sampled))
    return recordings, left_out(wrong, speed, joints)


def _runs(names: Any) -> dict[str, Rows]:
    """Rows of each recording, in the order in which they begin."""
    unique, first, number = np.unique(names, return_index=True, return_inverse=True)
    return {str(unique[i]): np.flatnonzero(number == i) for i in np.argsort(first)}


def _numbers(table: Mapping[str, Any], names: Sequence[str]) -> Array:
    """Columns (rows, names); ValueError: one that is not there, or a value that cannot be."""
    missing = [name for name in names if name not in table]
    wanted = f"{brief(missing)} (--map {missing[0]}=COLUMN:UNIT)" if missing else ""
    require(not missing, "columns", wanted, brief(list(table)))
    for name in names:
        wanted, got = (np.shape(table[key]) for key in ("run", name))
        require(got == wanted, f"column {name}", f"{wanted} numbers", got)
    values = np.array([table[name] for name in names], float).T
    limit = 1.0 if names[0].startswith("u_") else LARGEST
    for row, column in np.argwhere(~(np.abs(values) <= limit)):  # also where it is nan
        place, got = f"row {row + 2}, column {names[column]}", values[row, column]
        unit = f" (per cent: --map {names[column]}=COLUMN:percent)" if limit == 1.0 else ""
        raise ValueError(f"{place}: expected -{limit:g} to {limit:g}{unit}, got {got}")
    return values


def _resample(
    time: Array, u: Array, q: Array, rows: Rows, machine: Machine
) -> tuple[Array, Array, Array]:
    """u held, q of `rows` interpolated at the machine's rate, and q_dot estimated."""
    t, rate = time[rows], machine.rate
    grid = t[0] + np.arange(int((t[-1] - t[0]) * rate + 1e-6) + 1) / rate
    parts = np.linspace(0, 1 / rate, MEAN_OF, endpoint=False)[:, None]
    held = np.searchsorted(time, grid + parts + 1e-6, side="right") - 1
    q = np.stack([np.interp(grid, t, angles) for angles in q[rows].T], axis=-1)
    return u[held].mean(axis=0), q, velocity_of(q, machine.velocity_samples, rate)
