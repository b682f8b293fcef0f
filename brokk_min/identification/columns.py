"""Tables of other people's loggers: which column is what, in which unit.

A mapping says `boom=Boom_ang:deg,u_boom=Lever:percent,time=Zeit:ms`: column of a log = column of
the file : unit. A unit may also be a number, by which the column is multiplied. A minus changes the
sign, as in `-deg` and `-1`.
"""

import math
from collections.abc import Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from brokk_min._files import brief, expected, numbers, open_npz, read_csv
from brokk_min.identification.ros_logs import COMMAND_TIME, read_ros
from brokk_min.machine import Array, require

UNITS = {"deg": math.pi / 180, "mrad": 1e-3, "mm": 1e-3, "percent": 1e-2, "permille": 1e-3}
# of commands, by the largest number in them
COMMAND_UNITS = {
    10: "0.1 or percent",
    100: "percent or :0.00787",
    127: "0.00787",
    255: "UNIT",
    1000: "permille",
}
TIMES = {"ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0, "d": 86400.0}
TABLES = (".csv", ".npz", ".mcap", ".db3", ".bag")  # beside folders of ROS
TOPICS = ("/joint_states", "/commands")  # of ROS: angles and commands
LARGEST = 1e12  # of numbers in a log, assumed: any angle or velocity
LAST_TIME = 1e20  # of a log, in any unit, which may be nanoseconds since 1970
Mapped = dict[str, tuple[str, float]]  # column of the log: that of the file, and its factor


def parse_map(text: str) -> Mapped:
    """A mapping from the command line; ValueError: a part that is none, or a name given twice."""
    result: Mapped = {}
    for part in filter(None, text.split(",")):
        name, _, source = map(str.strip, part.partition("="))
        column, _, unit = source.rpartition(":") if ":" in source else (source, "", "1")
        of_log = name if name in ("run", "time") or name[:2] in ("u_", "q_") else f"q_{name}"
        units = TIMES if name == "time" else UNITS
        try:
            factor = units.get(unit) or -units.get(unit.removeprefix("-"), 0) or float(unit)
        except ValueError:
            factor = 0.0
        fits = bool(name and column and factor) and of_log not in result
        wanted = f"NAME=COLUMN or NAME=COLUMN:UNIT once, a unit of {', '.join(units)}, or a number"
        require(fits, "--map", wanted, repr(part))
        result[of_log] = (column, factor)
    return result


def load_table(
    path: Path, mapped: Mapped, topics: tuple[str, str] = TOPICS
) -> tuple[dict[str, Any], list[str]]:
    """Columns `run`, `time` [s], `u_` and `q_` of each joint, under their names or mapped ones.

    `topics` are those of a recording of ROS, whose commands have a column of time of their own; its
    warnings come second. A table without `run` is one recording, by the name of its file.
    ValueError: no such file or column, or the row of what cannot be a value; an angle may be nan.
    """
    if path.suffix.lower() == ".csv":
        return find_columns(path, read_csv(path), mapped), []
    if path.suffix.lower() == ".npz":
        wanted = "columns of numbers or text"  # of which only those are read that are needed
        with expected(path, wanted), open_npz(path) as archive:
            return find_columns(path, archive, mapped), []
    table, warnings = read_ros(path, *topics, renamed=bool(mapped))
    return find_columns(path, table, mapped), warnings


def find_columns(path: Path, table: Mapping[str, Any], mapped: Mapped) -> dict[str, Any]:
    """The columns of `load_table` in a table of any others."""
    renamed = {column for column, _ in mapped.values()} - {*mapped}
    names = [name for name in (*table, *mapped) if name not in renamed]
    joints = dict.fromkeys(name[2:] for name in names if name.startswith("u_"))
    joints |= dict.fromkeys(name[2:] for name in mapped if name.startswith("q_"))
    require(len(joints) > 0, "columns", "u_<joint> (--map u_NAME=COLUMN:UNIT)", brief(list(table)))
    times = [name for name in ("time", COMMAND_TIME) if name in ("time", *table)]
    names = [*times, *(f"{kind}_{joint}" for kind in "uq" for joint in joints)]
    sources = {name: (name, 1.0) for name in names} | mapped
    for name, (column, _) in sources.items():
        wanted = f"{column!r} (--map {name}=COLUMN:UNIT)"
        require(column in table, "columns", wanted, brief(list(table)))
    result = {}
    for name in names:
        column, factor = sources[name]
        result[name] = _numbers(path, name, np.ravel(table[column]), factor)
        rows, got = len(result[times[-1] if name[:2] == "u_" else "time"]), len(result[name])
        wanted = f"{rows} numbers, as many as of time"
        require(name in times or got == rows, f"column {name}", wanted, got)
    column, _ = sources.get("run", ("run", 1.0))
    run = np.asarray(table.get(column, path.stem)).astype(str)
    return {"run": np.broadcast_to(run, len(result["time"]))} | result


def _numbers(path: Path, name: str, values: Any, factor: float) -> Array:
    """A column in the units of the log; ValueError: the row of what cannot be a value."""
    if values.dtype.kind == "S":
        values = values.astype(str)
    if values.dtype.kind in "mM":
        values = (values - values[:1]) / np.timedelta64(1, "s")
    elif name == "time" and values.dtype.kind in "US" and ":" in values[0]:
        moments = numbers(path, name, values, _moment, "an ISO stamp")
        values = (moments - moments[0]) / timedelta(seconds=1)
    elif values.dtype.kind in "US":
        angle = name.startswith("q_")  # as pandas writes nan
        values = numbers(path, name, np.where(values == "", "nan", values) if angle else values)
    if name == "time" and factor != 1:
        values = values - values[:1]  # keeps its digits
    result: Array = np.asarray(values * factor, float)
    command = name.startswith("u_")
    limit = 1.0 if command else LAST_TIME if name == "time" else LARGEST
    unread = np.isnan(result) & name.startswith("q_")
    require(not unread.size or not unread.all(), f"column {name}", "numbers", "nan in all rows")
    for row in np.flatnonzero(~(np.abs(result) <= limit) & ~unread):  # also where it is nan
        largest = np.fmax.reduce(np.abs(result), initial=0.0)  # but nan
        unit = next((name for most, name in COMMAND_UNITS.items() if largest <= most), "UNIT")
        wanted = f"-{limit:g} to {limit:g}"
        if command and largest > limit:
            wanted += f" (another unit? --map {name}=COLUMN:{unit}; rest is 0)"
        raise ValueError(f"row {row + 2}, column {name}: expected {wanted}, got {result[row]}")
    return result


def _moment(stamp: str) -> datetime:
    """An ISO stamp, which is UTC if it names no zone."""
    time = datetime.fromisoformat(stamp.strip())
    return time if time.tzinfo else time.replace(tzinfo=UTC)
