"""Logs of a machine: one table on disk, recordings at one rate in memory.

Columns `run,time,u_<joint>...,q_<joint>...[,q_dot_<joint>...]`, one row a sample; `.csv`, or `.npz`
with the same columns as arrays. `run` names the recording, time is in s, u in [-1, 1] of full
command (held until the next row), q in rad, q_dot in rad/s. Any joints, any rate not below the
machine's, jitter allowed. A recording whose name ends in `_return` is a way back to the start and is dropped.
"""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from brokk_min.identification.files import (
    Floats,
    Table,
    cells_of,
    load_arrays,
    numbers_of,
    read_csv,
    whole_file,
    write_csv,
)
from brokk_min.machine import Array, Machine, estimate_velocity

RATE = 20.0  # Hz, paper: everything runs at 20 Hz; other machines have others
MAX_GAP = 0.25  # s, assumed: a longer hole in the time stamps starts a new recording
RETURN = "_return"
UNITS = {  # largest value of a column and its unit; what is larger has been logged in another one
    "u": (1.0, "of full command, not percent or bytes"),
    "q": (62.8, "rad, not degrees"),  # ten turns, assumed
    "q_dot": (62.8, "rad/s, not degrees/s"),
}


class Recording(NamedTuple):
    """One recording of a log: arrays (T, n) of command [-1, 1], angle [rad], velocity [rad/s]."""

    name: str
    u: Array
    q: Array
    q_dot: Array


class Log(NamedTuple):
    """Recordings of the same joints; `velocity_logged` says where q_dot came from."""

    joints: tuple[str, ...]
    recordings: tuple[Recording, ...]
    velocity_logged: bool = False
    rate: float = RATE  # Hz


def machine_log(machine: Machine, tapes: Iterable[tuple[str, Array, Array]]) -> Log:
    """A log of a machine from names, commands and encoder angles; velocities are estimated."""
    how = machine.velocity_samples, machine.rate
    recordings = tuple(Recording(name, u, q, velocity_of(q, *how)) for name, u, q in tapes)
    return Log(machine.names, recordings, rate=machine.rate)


def write_log(path: Path, log: Log) -> None:
    """Write recordings as one table, `.csv` or `.npz` by the name; read it with `read_log`."""
    path = Path(path)
    if not log.recordings:
        raise ValueError(f"{path}: expected at least one recording to write, got none")
    names = [recording.name for recording in log.recordings]
    lengths = [len(recording.u) for recording in log.recordings]
    columns: dict[str, Any] = {
        "run": np.repeat(names, lengths),
        "time": np.concatenate([np.arange(length) / log.rate for length in lengths]),
    }
    kinds = ("u", "q", "q_dot") if log.velocity_logged else ("u", "q")
    for kind in kinds:
        values = np.concatenate([getattr(recording, kind) for recording in log.recordings])
        columns |= {f"{kind}_{name}": values[:, i] for i, name in enumerate(log.joints)}
    if path.suffix == ".npz":
        with whole_file(path) as file:
            np.savez_compressed(file, **columns)
    elif path.suffix == ".csv":
        numbers = [np.char.mod("%.7g", column) for column in list(columns.values())[1:]]
        write_csv(path, columns, zip(columns["run"], *numbers, strict=True))
    else:
        raise ValueError(f"{path}: expected a name ending in .csv or .npz, got {path.suffix!r}")


def read_log(
    paths: Sequence[Path],
    velocity_samples: int,
    joints: Sequence[str] | None = None,
    rate: float = RATE,
) -> Log:
    """Read tables of one machine, check them, and bring them to one `rate` [Hz].

    Command held, angle interpolated. A gap longer than `MAX_GAP` cuts a
    recording in two. Without q_dot columns the causal estimator supplies velocities: a recording is
    taken to start at rest; what follows a gap is not, and loses the rows that would need samples of it.

    Args:
        paths: tables of the same joints.
        velocity_samples: window of `estimate_velocity`.
        joints: names that must be there, in the wanted order; None: all, in the order of the first file.

    ValueError: with file, row (1 is the header) and column of the first thing that is wrong.
    """
    names, recordings, logged = tuple(joints or ()), list[Recording](), set[bool]()
    for path in map(Path, paths):
        table = read_csv(path) if path.suffix.lower() == ".csv" else _read_npz(path)
        found = _joints(path, table) if joints is None else names
        names = names or found
        if set(found) != set(names):
            raise ValueError(f"{path}: row 1: expected joints {list(names)}, got {list(found)}")
        has_velocity = any(f"q_dot_{joint}" in table for joint in names)
        logged.add(has_velocity)
        if len(logged) > 1:
            raise ValueError(f"{path}: expected q_dot columns in all files or none, got a mixture")
        recordings += _recordings(path, table, names, has_velocity, velocity_samples, rate)
    if not recordings:
        raise ValueError(f"{', '.join(map(str, paths))}: expected at least one recording, got none")
    return Log(names, tuple(recordings), True in logged, rate)


def _joints(path: Path, table: Table) -> tuple[str, ...]:
    """Joints of a table by its u columns; an angle or a velocity without a command is refused."""
    joints = tuple(name[2:] for name in table if name.startswith("u_"))
    if not joints:
        raise ValueError(f"{path}: row 1: expected columns u_<joint>, got {list(table)}")
    known = {kind + joint for kind in ("q_", "q_dot_") for joint in joints}
    for name in table:
        if name.startswith("q_") and name not in known:
            missing = "u_" + name.removeprefix("q_").removeprefix("dot_")
            raise ValueError(
                f"{path}: row 1: expected a column {missing} beside {name}, got {list(table)}"
            )
    return joints


def _recordings(
    path: Path, table: Table, joints: Sequence[str], logged: bool, samples: int, rate: float
) -> Iterator[Recording]:
    """The checked recordings of one table at `rate`, in the order in which they begin."""
    time = numbers_of(path, table, "time")
    columns = {
        kind: np.stack(
            [numbers_of(path, table, f"{kind}_{joint}", *unit) for joint in joints], axis=1
        )
        for kind, unit in list(UNITS.items())[: 3 if logged else 2]
    }
    runs: dict[str, list[int]] = {}
    for row, run in enumerate(cells_of(path, table, "run")):
        if not run.strip():
            raise ValueError(f"{path}: row {row + 2}, column run: expected a name, got {run!r}")
        runs.setdefault(run, []).append(row)
    for run, rows in runs.items():
        gaps = _gaps(path, run, rows, time[rows], rate)
        for part, piece in enumerate(np.split(rows, gaps) if not run.endswith(RETURN) else ()):
            arrays = _resample(
                time[piece], {k: c[piece] for k, c in columns.items()}, samples, rate
            )
            unknown = samples - 1 if part and not logged else 0  # rows that need samples of the gap
            if len(arrays[0]) > unknown:
                name = f"{run}#{part + 1}" if part else run
                yield Recording(name, *(array[unknown:] for array in arrays))


def _gaps(path: Path, run: str, rows: Sequence[int], time: Floats, rate: float) -> NDArray[np.intp]:
    """Where a recording is to be cut; time stamps that do not rise fast enough are refused."""
    step = np.diff(time)
    if not (step > 0).all():
        late = int(np.argmin(step > 0)) + 1
        raise ValueError(
            f"{path}: row {rows[late] + 2}, column time: expected later than {time[late - 1]} "
            f"within run {run!r}, got {time[late]}"
        )
    if len(step) and np.median(step) > 1.05 / rate:
        raise ValueError(
            f"{path}: row {rows[0] + 2}, column time: expected {rate:g} Hz or more in run "
            f"{run!r}, got {1 / np.median(step):.3g} Hz"
        )
    return np.flatnonzero(step > MAX_GAP) + 1


def _resample(
    time: Floats, columns: dict[str, Floats], samples: int, rate: float
) -> tuple[Floats, ...]:
    """u held, q and q_dot interpolated at `rate`; q_dot estimated where the log has none."""
    grid = time[0] + np.arange(int((time[-1] - time[0]) * rate + 1e-6) + 1) / rate
    held = np.searchsorted(time, grid + 1e-6, side="right") - 1

    def between(values: Floats) -> Floats:
        return np.stack([np.interp(grid, time, column) for column in values.T], axis=1)

    q = between(columns["q"])
    q_dot = between(columns["q_dot"]) if "q_dot" in columns else velocity_of(q, samples, rate)
    return columns["u"][held], q, q_dot


def velocity_of(q: Array, samples: int, rate: float = RATE) -> Floats:
    """Causal velocity [rad/s] at each row of one recording `q` [rad] (T, n), at rest before it.

    `rate` [Hz] is that of the rows.

    Example:
        >>> velocity_of(np.array([[0.0], [0.0], [0.3], [0.6]]), samples=2).ravel().tolist()
        [0.0, 0.0, 6.0, 6.0]
    """
    padded = np.concatenate([np.repeat(q[:1], samples - 1, axis=0), q])
    windows = np.lib.stride_tricks.sliding_window_view(padded, samples, axis=0)
    return np.asarray(estimate_velocity(windows, samples, 1 / rate), float)


def _read_npz(path: Path) -> Table:
    columns = load_arrays(path)
    shapes = {name: column.shape for name, column in columns.items()}
    if len(set(shapes.values())) != 1 or len(next(iter(shapes.values()))) != 1:
        raise ValueError(f"{path}: expected columns of one length, got {shapes}")
    for name, column in columns.items():
        wanted, kind = ("text", "U") if name == "run" else ("numbers", "iuf")
        if column.dtype.kind not in kind:
            raise ValueError(f"{path}: column {name}: expected {wanted}, got {column.dtype}")
    return {name: column.tolist() for name, column in columns.items()}
