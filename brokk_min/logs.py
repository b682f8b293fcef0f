"""Logs of a machine: one table on disk, recordings at one rate in memory.

Columns `run,time,u_<joint>...,q_<joint>...[,q_dot_<joint>...]`, one row a sample; `.csv`, or `.npz`
with the same columns as arrays. `run` names the recording, time is in s, u in [-1, 1] of full
command (held until the next row), q in rad, q_dot in rad/s. Any joints, any rate of 20 Hz or more,
jitter allowed. A recording whose name ends in `_return` is a way back to the start and is dropped.
"""

from __future__ import annotations

import csv
import os
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from brokk_min.machine import estimate_velocity

Floats = NDArray[np.float64]
RATE = 20.0  # Hz, paper: everything runs at 20 Hz
MAX_GAP = 0.25  # s, assumed: a longer hole in the time stamps starts a new recording
RETURN = "_return"


class Recording(NamedTuple):
    """One recording at `RATE`: arrays (T, n) of command [-1, 1], angle [rad], velocity [rad/s]."""

    name: str
    u: Floats
    q: Floats
    q_dot: Floats


class Log(NamedTuple):
    """Recordings of the same joints; `velocity_logged` says where q_dot came from."""

    joints: tuple[str, ...]
    recordings: tuple[Recording, ...]
    velocity_logged: bool = False


@contextmanager
def whole_file(path: Path, mode: str = "wb") -> Iterator[IO[Any]]:
    """Open a temporary file beside `path` that replaces it when the block ends without error."""
    path = Path(path)
    if not path.parent.is_dir():
        raise ValueError(f"{path}: expected an existing directory, got {path.parent}")
    newline = None if "b" in mode else ""
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, mode, newline=newline) as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise


# what zipfile and NumPy raise on damaged files, besides OSError and ValueError
_DAMAGE = (
    OSError,
    ValueError,
    EOFError,
    KeyError,
    AttributeError,
    TypeError,
    RuntimeError,
    zlib.error,
    zipfile.BadZipFile,
)


def load_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """All arrays of an `.npz` file; nothing in it is executed.

    Raises:
        ValueError: not there, not an `.npz`, truncated, or holding pickled objects.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except _DAMAGE as error:
        raise ValueError(f"{path}: expected a readable .npz file, got {error!r}") from error


def write_log(path: Path, log: Log) -> None:
    """Write recordings as one table, `.csv` or `.npz` by the name; read it with `read_log`."""
    path = Path(path)
    if not log.recordings:
        raise ValueError(f"{path}: expected at least one recording to write, got none")
    names = [recording.name for recording in log.recordings]
    lengths = [len(recording.u) for recording in log.recordings]
    columns: dict[str, NDArray[Any]] = {
        "run": np.repeat(names, lengths),
        "time": np.concatenate([np.arange(length) / RATE for length in lengths]),
    }
    kinds = ("u", "q", "q_dot") if log.velocity_logged else ("u", "q")
    for kind in kinds:
        values = np.concatenate([getattr(recording, kind) for recording in log.recordings])
        columns |= {f"{kind}_{name}": values[:, i] for i, name in enumerate(log.joints)}
    if path.suffix == ".npz":
        with whole_file(path) as file:
            np.savez_compressed(file, **columns)  # type: ignore[arg-type]
    elif path.suffix == ".csv":
        with whole_file(path, "w") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(columns)
            numbers = [np.char.mod("%.7g", column) for column in list(columns.values())[1:]]
            writer.writerows(zip(columns["run"], *numbers, strict=True))
    else:
        raise ValueError(f"{path}: expected a name ending in .csv or .npz, got {path.suffix!r}")


def read_log(paths: Sequence[Path], velocity_samples: int, joints: Sequence[str] | None = None) -> Log:
    """Read tables of one machine, check them, and bring them to `RATE`.

    Command held, angle interpolated (DESIGN: resampled to 20 Hz). Without q_dot columns the causal
    estimator supplies velocities. Recordings are cut at gaps longer than `MAX_GAP`.

    Args:
        paths: tables with the same columns.
        velocity_samples: window of `estimate_velocity`.
        joints: names that must be there, in the wanted order; None: those of the first file.

    Raises:
        ValueError: with file, row (1 is the header) and column of the first thing that is wrong.
    """
    recordings: list[Recording] = []
    logged: bool | None = None
    for path in map(Path, paths):
        columns = _read_csv(path, _is_number) if path.suffix.lower() == ".csv" else _read_npz(path)
        joints = tuple(joints) if joints is not None else _joints(path, columns)
        has_velocity = _check_columns(path, columns, joints)
        if logged not in (None, has_velocity):
            raise ValueError(f"{path}: expected q_dot columns in all files or none, got a mixture")
        logged = has_velocity
        recordings += _recordings(path, columns, joints, has_velocity, velocity_samples)
    if not recordings or joints is None:
        raise ValueError(f"{', '.join(map(str, paths))}: expected at least one recording, got none")
    return Log(tuple(joints), tuple(recordings), bool(logged))


def _is_number(column: str) -> bool:
    return column == "time" or column.startswith(("u_", "q_"))


def _read_csv(path: Path, is_number: Callable[[str], bool]) -> dict[str, NDArray[Any]]:
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            rows = list(csv.reader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path}: expected a readable CSV table, got {error}") from error
    while rows and not rows[-1]:  # blank lines at the end
        rows.pop()
    if len(rows) < 2:
        raise ValueError(f"{path}: expected a header and at least one row, got {len(rows)} rows")
    header = [name.strip() for name in rows[0]]
    if len(set(header)) != len(header):
        twice = sorted({name for name in header if header.count(name) > 1})
        raise ValueError(f"{path}: row 1: expected each column once, got {twice} more than once")
    for number, row in enumerate(rows[1:], 2):
        if len(row) != len(header):
            raise ValueError(f"{path}: row {number}: expected {len(header)} cells, got {len(row)}")
    cells = zip(*rows[1:], strict=True)
    return {
        name: np.array(column) if not is_number(name) else _numbers(path, name, column)
        for name, column in zip(header, cells, strict=True)
    }


def _numbers(path: Path, name: str, cells: Sequence[str]) -> Floats:
    try:
        return np.array(list(map(float, cells)))
    except ValueError:
        for number, cell in enumerate(cells, 2):
            try:
                float(cell)
            except ValueError:
                where = f"{path}: row {number}, column {name}"
                raise ValueError(f"{where}: expected a number, got {cell!r}") from None
        raise


def _read_npz(path: Path) -> dict[str, NDArray[Any]]:
    columns = load_arrays(path)
    shapes = {name: column.shape for name, column in columns.items()}
    if len(set(shapes.values())) != 1 or len(next(iter(shapes.values()))) != 1:
        raise ValueError(f"{path}: expected columns of one length, got {shapes}")
    for name, column in columns.items():
        wanted = "U" if name == "run" else "iuf"
        if column.dtype.kind not in wanted:
            kind = "text" if name == "run" else "numbers"
            raise ValueError(f"{path}: column {name}: expected {kind}, got {column.dtype}")
    return {name: c if name == "run" else c.astype(float) for name, c in columns.items()}


def _joints(path: Path, columns: dict[str, NDArray[Any]]) -> tuple[str, ...]:
    names = tuple(name[2:] for name in columns if name.startswith("u_"))
    if not names:
        raise ValueError(f"{path}: row 1: expected columns u_<joint>, got {list(columns)}")
    return names


def _check_columns(path: Path, columns: dict[str, NDArray[Any]], joints: Sequence[str]) -> bool:
    """Check names and values; True if the table has velocities."""
    velocities = [f"q_dot_{joint}" for joint in joints]
    has_velocity = any(name in columns for name in velocities)
    wanted = ["run", "time", *(f"u_{j}" for j in joints), *(f"q_{j}" for j in joints)]
    for name in wanted + velocities * has_velocity:
        if name not in columns:
            raise ValueError(f"{path}: row 1: expected a column {name}, got {list(columns)}")
        if name != "run":
            bound = 1.0 + 1e-6 if name.startswith("u_") else np.inf
            good = np.isfinite(columns[name]) & (np.abs(columns[name]) <= bound)
            if not good.all():
                row = int(np.argmin(good))
                what = "a command in [-1, 1]" if name.startswith("u_") else "a finite number"
                where = f"{path}: row {row + 2}, column {name}"
                raise ValueError(f"{where}: expected {what}, got {columns[name][row]}")
    return has_velocity


def _recordings(
    path: Path,
    columns: dict[str, NDArray[Any]],
    joints: Sequence[str],
    has_velocity: bool,
    velocity_samples: int,
) -> list[Recording]:
    result = []
    runs, first, inverse = np.unique(columns["run"], return_index=True, return_inverse=True)
    groups = np.split(np.argsort(inverse, kind="stable"), np.cumsum(np.bincount(inverse))[:-1])
    for index in np.argsort(first):
        run, rows = runs[index], groups[index]
        step = np.diff(columns["time"][rows])
        if not (step > 0).all():
            last = int(np.argmin(step > 0))
            before, after = columns["time"][rows[last : last + 2]]
            raise ValueError(
                f"{path}: row {rows[last + 1] + 2}, column time: expected later than {before} "
                f"within run {str(run)!r}, got {after}"
            )
        if len(step) and np.median(step) > 1.05 / RATE:
            raise ValueError(
                f"{path}: row {rows[0] + 2}, column time: expected {RATE:g} Hz or more in run "
                f"{str(run)!r}, got {1 / np.median(step):.3g} Hz"
            )
        if str(run).endswith(RETURN):
            continue
        for part, piece in enumerate(np.split(rows, np.flatnonzero(step > MAX_GAP) + 1)):
            table = {name: column[piece] for name, column in columns.items() if name != "run"}
            name = str(run) + (f"#{part + 1}" if part else "")
            result.append(_resample(name, table, joints, has_velocity, velocity_samples))
    return result


def _resample(
    name: str, table: dict[str, Floats], joints: Sequence[str], has_velocity: bool, velocity_samples: int
) -> Recording:
    time = table["time"]
    grid = time[0] + np.arange(int((time[-1] - time[0]) * RATE + 1e-6) + 1) / RATE
    held = np.searchsorted(time, grid + 1e-6, side="right") - 1

    def column(kind: str, sample: Callable[[Floats], Floats]) -> Floats:
        return np.stack([sample(table[f"{kind}_{joint}"]) for joint in joints], axis=1)

    def interpolate(values: Floats) -> Floats:
        return np.interp(grid, time, values)

    q = column("q", interpolate)
    q_dot = column("q_dot", interpolate) if has_velocity else velocity_of(q, velocity_samples)
    return Recording(name, column("u", lambda values: values[held]), q, q_dot)


def velocity_of(q: Floats, samples: int) -> Floats:
    """Causal velocity [rad/s] at each row of one recording `q` [rad] (T, n), at rest before it.

    Example:
        >>> velocity_of(np.array([[0.0], [0.0], [0.3], [0.6]]), samples=2).ravel().tolist()
        [0.0, 0.0, 6.0, 6.0]
    """
    padded = np.concatenate([np.repeat(q[:1], samples - 1, axis=0), q])
    windows = np.lib.stride_tricks.sliding_window_view(padded, samples, axis=0)
    return np.asarray(estimate_velocity(windows, samples, 1 / RATE), float)


def read_table(path: Path, columns: Sequence[str], text: Sequence[str] = ()) -> dict[str, NDArray[Any]]:
    """Named columns of a small CSV: finite numbers, or text where so named.

    Raises:
        ValueError: with file, row and column of the first thing that is wrong.
    """
    table = _read_csv(Path(path), lambda name: name in columns and name not in text)
    for name in columns:
        if name not in table:
            raise ValueError(f"{path}: row 1: expected a column {name}, got {list(table)}")
        if name not in text and not (good := np.isfinite(table[name])).all():
            row = int(np.argmin(good))
            where = f"{path}: row {row + 2}, column {name}"
            raise ValueError(f"{where}: expected a finite number, got {table[name][row]}")
    return table
