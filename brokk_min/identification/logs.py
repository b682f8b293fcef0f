"""Logs of a machine: one table on disk, recordings at one rate in memory.

Columns `run,time,u_<joint>...,q_<joint>...[,q_dot_<joint>...]`, one row per sample; `.csv`, or
`.npz` with the same columns as arrays. `run` is the name of the recording, time is in s, u in
[-1, 1] of full command (held until the next row), q in rad (m of prismatic joints), q_dot in q/s.
Any joints, any rate not below the machine's, jitter allowed. Recordings whose name ends in
`_return` are dropped.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from brokk_min.identification import files
from brokk_min.identification.files import Floats, brief
from brokk_min.identification.formats import LOG, check_columns
from brokk_min.kinematics import estimate_velocity
from brokk_min.machine import Array, Machine

RATE = 20.0  # Hz, paper: everything runs at 20 Hz; other machines have others
MAX_GAP = 0.25  # s, or 2.5 samples, assumed: a longer gap starts a new recording
COMMANDED = 0.02  # of full command, assumed: more than a stick at rest gives
MOVED = 0.01  # rad or m, assumed: more than a parked joint creeps
MEAN_OF = 10  # values in a tick, of logs that are faster
RETURN = "_return"
Columns = Mapping[str, Any]


class Recording(NamedTuple):
    """One recording of a log: arrays (T, n) of command [-1, 1], angle [rad], velocity [rad/s]."""

    name: str
    u: Array
    q: Array
    q_dot: Array


class Log(NamedTuple):
    """Recordings of the same joints; `velocity_logged`: q_dot is measured, not estimated."""

    joints: tuple[str, ...]
    recordings: tuple[Recording, ...]
    velocity_logged: bool = False
    rate: float = RATE  # Hz


def machine_log(machine: Machine, recordings: Iterable[tuple[str, Array, Array]]) -> Log:
    """A log from names, commands and encoder angles (T, n) [rad]; velocities are estimated."""
    samples, rate = machine.velocity_samples, machine.rate
    result = [Recording(name, u, q, velocity_of(q, samples, rate)) for name, u, q in recordings]
    return Log(machine.names, tuple(result), rate=rate)


def velocity_of(q: Array, samples: int, rate: float = RATE) -> Floats:
    """Causal velocity [rad/s] at each row of a recording `q` [rad] (T, n), at rest before it.

    `samples` is the window of `estimate_velocity`, `rate` [Hz] that of the rows.

    Example:
        >>> velocity_of(np.array([[0.0], [0.0], [0.25], [0.5]]), samples=2).round(6).ravel()
        array([0., 0., 5., 5.])
    """
    padded = np.concatenate([np.repeat(q[:1], samples - 1, axis=0), q])
    windows = np.lib.stride_tricks.sliding_window_view(padded, samples, axis=0)
    return np.asarray(estimate_velocity(windows, samples, 1 / rate), float)


class Samples(NamedTuple):
    """The recordings of a log joined, N samples in all; a window must not cross their seams."""

    joined: Recording
    target: Array  # (N, n) rad/s, output of the nets, see `join_recordings`
    moves: NDArray[np.bool_]  # (N, n): the joint is `driven` in this recording
    lengths: list[int]  # of the recordings

    def starts(self, before: int, after: int, step: int) -> NDArray[np.intp]:
        """Every `step`-th sample with `before` and `after` samples around it in its recording."""
        result = []
        seam = 0
        for length in self.lengths:
            result.append(seam + np.arange(before, length - after, step))
            seam += length
        return np.concatenate(result)

    def windows(self, history: int, ticks: int) -> list[NDArray[np.intp]]:
        """Newest samples of windows of `history` samples, `ticks` before an end, of each joint."""
        ends = self.starts(history - 1, ticks, 1)
        return [ends[moves] for moves in self.moves[ends].T]


def driven(recording: Recording) -> NDArray[np.bool_]:
    """Which joints have a command or move in a recording (n,); a parked one may creep a little."""
    commanded = np.ptp(recording.u, axis=0) > COMMANDED
    return np.asarray(commanded | (np.ptp(recording.q, axis=0) > MOVED))


def join_recordings(log: Log) -> Samples:
    """Join the recordings of a log and add the target velocity of each sample.

    The target is the mean velocity of the coming tick, (q(t+dt) - q(t)) / dt; for logged velocities
    it is q_dot(t+dt). The last sample of a recording has none.
    """
    u = np.concatenate([recording.u for recording in log.recordings])
    q = np.concatenate([recording.q for recording in log.recordings])
    q_dot = np.concatenate([recording.q_dot for recording in log.recordings])
    target = np.diff(q, axis=0, append=0) * log.rate
    if log.velocity_logged:
        target = np.roll(q_dot, -1, axis=0)
    lengths = [len(recording.q) for recording in log.recordings]
    moves = [driven(recording) for recording in log.recordings]
    return Samples(Recording("", u, q, q_dot), target, np.repeat(moves, lengths, axis=0), lengths)


def split(log: Log) -> tuple[Log, Log]:
    """Recordings to fit to, and to score on: every tenth of those that drive the same joints.

    ValueError: no two recordings drive the same joints.
    """
    held_out = {i for group in same_joints(log) if len(group) > 1 for i in group[::10]}
    if not held_out:
        expected = (
            "expected two or more (column run) that drive the same joints, or --test, to score"
        )
        raise ValueError(f"recordings: {expected}, got {len(log.recordings)}")
    kept = set(range(len(log.recordings))) - held_out
    return _some(log, kept), _some(log, held_out)


def same_joints(log: Log) -> list[list[int]]:
    """Indices of recordings that drive the same joints, group by group."""
    groups: dict[tuple[bool, ...], list[int]] = {}
    for i, recording in enumerate(log.recordings):
        groups.setdefault(tuple(driven(recording).tolist()), []).append(i)
    return list(groups.values())


def in_order(log: Log, joints: Sequence[str]) -> Log:
    """A log whose arrays have the joints in this order."""
    order = [log.joints.index(name) for name in joints]
    recordings = (Recording(one.name, *(x[:, order] for x in one[1:])) for one in log.recordings)
    return log._replace(joints=tuple(joints), recordings=tuple(recordings))


def part_of(log: Log, part: float) -> Log:
    """The first recordings of each joint, a `part` of them and at least one."""
    groups = same_joints(log)
    return _some(log, (i for group in groups for i in group[: math.ceil(part * len(group))]))


def _some(log: Log, indices: Iterable[int]) -> Log:
    return log._replace(recordings=tuple(log.recordings[i] for i in sorted(indices)))


def write_log(path: Path, log: Log) -> None:
    """Write recordings as one table, `.csv` or `.npz` by the name; read it with `read_log`."""
    path = Path(path)
    if not log.recordings:
        raise ValueError(f"{path}: expected at least one recording to write, got none")
    names = [recording.name for recording in log.recordings]
    lengths = [len(recording.u) for recording in log.recordings]
    time = np.concatenate([np.arange(length) / log.rate for length in lengths])
    columns: dict[str, Any] = {"run": np.repeat(names, lengths), "time": time}
    for kind in ("u", "q", "q_dot") if log.velocity_logged else ("u", "q"):
        values = np.concatenate([getattr(recording, kind) for recording in log.recordings])
        columns |= {f"{kind}_{name}": values[:, i] for i, name in enumerate(log.joints)}
    if path.suffix == ".npz":
        with files.whole_file(path) as file:
            np.savez_compressed(file, **columns)
    elif path.suffix == ".csv":
        numbers = [np.char.mod("%.7g", column) for column in list(columns.values())[1:]]
        files.write_csv(path, columns, zip(columns["run"], *numbers, strict=True))
    else:
        raise ValueError(f"{path}: expected a name ending in .csv or .npz, got {path.suffix!r}")


def read_log(
    paths: Sequence[Path],
    velocity_samples: int,
    joints: Sequence[str] | None = None,
    rate: float = RATE,
) -> Log:
    """Read and check tables of one machine and resample them at `rate` [Hz].

    The command is held, the angle interpolated; of faster logs they are means. A gap longer than
    `MAX_GAP` and 2.5 samples cuts a recording.
    Without q_dot columns velocities are estimated: a recording starts at rest; after a gap, the
    rows that would need samples of the gap are left out.

    `velocity_samples` is the window of `estimate_velocity`; `joints` are the names and order of the
    joints (None: all, in the order of the first file).
    ValueError: with file, row (1 is the header) and column of the first error.
    """
    names = tuple(joints or ())
    recordings: list[Recording] = []
    logged: set[bool] = set()
    for path in map(Path, paths):
        if path.suffix.lower() not in (".csv", ".npz"):
            raise ValueError(f"{path}: expected a name ending in .csv or .npz, got {path.suffix!r}")
        is_csv = path.suffix.lower() == ".csv"
        table = files.read_csv(path, ["run"]) if is_csv else files.load_arrays(path)
        got = names if joints else _joints(path, table)
        names = names or got
        if set(got) != set(names):
            wanted = f"expected joints {brief(list(names))}"
            raise ValueError(f"{path}: row 1: {wanted}, got {brief(list(got))}")
        logged.add(any(f"q_dot_{joint}" in table for joint in names))
        if len(logged) > 1:
            raise ValueError(f"{path}: expected q_dot columns in all files or none, got a mixture")
        recordings += _recordings(path, table, names, True in logged, velocity_samples, rate)
    if not recordings:
        raise ValueError(f"{', '.join(map(str, paths))}: expected at least one recording, got none")
    return Log(names, tuple(recordings), True in logged, rate)


def _joints(path: Path, table: Columns) -> tuple[str, ...]:
    """Joints of a table by its u columns; ValueError: an angle or a velocity without a command."""
    joints = tuple(name[2:] for name in table if name.startswith("u_"))
    if not joints:
        raise ValueError(f"{path}: row 1: expected columns u_<joint>, got {brief(list(table))}")
    known = {kind + joint for kind in ("q_", "q_dot_") for joint in joints}
    for name in table:
        if name.startswith("q_") and name not in known:
            missing = "u_" + name.removeprefix("q_").removeprefix("dot_")
            expected = f"expected a column {missing} for {name}"
            raise ValueError(f"{path}: row 1: {expected}, got {brief(list(table))}")
    return joints


def _recordings(
    path: Path, table: Columns, joints: Sequence[str], logged: bool, samples: int, rate: float
) -> Iterator[Recording]:
    """The checked recordings of one table at `rate`, in the order in which they begin."""
    kinds = ("u_", "q_", "q_dot_") if logged else ("u_", "q_")
    fields = {name: LOG[name] for name in ("run", "time")}
    fields |= {kind + joint: LOG[kind] for kind in kinds for joint in joints}
    check_columns(path, table, fields)
    time = np.asarray(table["time"], float)
    names = table["run"]
    for run, rows in _runs(
        path, names if isinstance(names, list) else names.tolist(), time
    ).items():
        gaps = _gaps(path, run, rows, time[rows], rate)
        pieces = [] if run.endswith(RETURN) else np.split(rows, gaps)
        for part, piece in enumerate(pieces):
            columns = {}
            for kind in kinds:
                numbers = [np.asarray(table[kind + joint])[piece] for joint in joints]
                columns[kind] = np.stack(numbers, axis=1, dtype=float)
            _check_turns(path, joints, piece, columns["q_"])
            u, q, q_dot = _resample(time[piece], columns, samples, rate)
            first = samples - 1 if part and not logged else 0  # rows before it need the gap
            if len(u) > first:
                name = f"{run}#{part + 1}" if part else run
                yield Recording(name, u[first:], q[first:], q_dot[first:])


def _runs(path: Path, names: Sequence[str], time: Floats) -> dict[str, NDArray[np.intp]]:
    """Rows of each recording; ValueError: time stamps that do not rise in one of them."""
    numbers: dict[str, int] = {}
    number = np.array([numbers.setdefault(name, len(numbers)) for name in names], np.intp)
    order = np.argsort(number, kind="stable")
    rows = np.split(order, np.flatnonzero(np.diff(number[order])) + 1)
    for one in rows:
        falls = np.flatnonzero(~(np.diff(time[one]) > 0))
        if len(falls):
            at, later = one[falls[0]], one[falls[0] + 1]
            expected = f"expected later than {time[at]} within run {brief(names[at])}"
            place = f"{path}: row {later + 2}, column time"
            raise ValueError(f"{place}: {expected}, got {time[later]}")
    return dict(zip(numbers, rows, strict=True))


def _gaps(
    path: Path, run: str, rows: NDArray[np.intp], time: Floats, rate: float
) -> NDArray[np.intp]:
    """Where to cut a recording; ValueError: time stamps that rise too slowly."""
    step = np.diff(time)
    if len(step) and np.median(step) > 1.05 / rate:
        wanted = f"expected s, at {rate:g} Hz, the machine's rate (--machine), or more"
        expected = f"{wanted}, in {brief(run)}"
        got = f"got {1 / np.median(step):.3g} Hz"
        raise ValueError(f"{path}: row {rows[0] + 2}, column time: {expected}, {got}")
    return np.flatnonzero(step > max(MAX_GAP, 2.5 / rate)) + 1


def _check_turns(path: Path, joints: Sequence[str], rows: NDArray[np.intp], q: Floats) -> None:
    """ValueError: an angle that starts again after a turn, as from pi to -pi."""
    jumps = np.argwhere(np.abs(np.diff(q, axis=0)) > 1.5 * np.pi)
    for at, joint in jumps[:1]:
        place = f"{path}: row {rows[at + 1] + 2}, column q_{joints[joint]}"
        expected = "expected an angle that does not start again after a turn (numpy.unwrap)"
        raise ValueError(f"{place}: {expected}, got {q[at + 1, joint]:g} after {q[at, joint]:g}")


def _resample(
    time: Floats, columns: dict[str, Floats], samples: int, rate: float
) -> tuple[Floats, Floats, Floats]:
    """u held, q and q_dot interpolated at `rate`; q_dot estimated where the log has none.

    Of two samples per tick or more means are taken: of u over the tick, of q and q_dot over half a
    tick on both sides. A step has its moment then, and noise is less.
    """
    grid = time[0] + np.arange(int((time[-1] - time[0]) * rate + 1e-6) + 1) / rate
    fast = len(time) > 1 and np.median(np.diff(time)) < 0.501 / rate
    parts = np.arange(MEAN_OF if fast else 1)[:, None]
    held = np.searchsorted(time, grid + parts / len(parts) / rate + 1e-6, side="right") - 1
    half = np.minimum(0.5 / rate, np.minimum(grid - time[0], time[-1] - grid)) * fast
    around = grid + half * ((2 * parts + 1) / len(parts) - 1)
    q = _interpolate(around, time, columns["q_"]).mean(axis=0)
    if "q_dot_" in columns:
        q_dot = _interpolate(around, time, columns["q_dot_"]).mean(axis=0)
    else:
        q_dot = velocity_of(q, samples, rate)
    return columns["u_"][held].mean(axis=0), q, q_dot


def _interpolate(at: Floats, time: Floats, values: Floats) -> Floats:
    return np.stack([np.interp(at, time, column) for column in values.T], axis=-1)
