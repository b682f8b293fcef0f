"""Tables of other people's loggers: which column is what, in which unit.

A mapping says `boom=Boom_ang:deg,u_boom=Lever:percent,time=Zeit:ms`: column of a log = column of
the file : unit. A unit may also be a number, by which the column is multiplied; a negative one
changes its sign.
"""

import math
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from brokk_min._files import brief, load_arrays, numbers, read_csv
from brokk_min.identification.ros_logs import read_ros
from brokk_min.machine import Array, require

UNITS = {"deg": math.pi / 180, "mrad": 1e-3, "mm": 1e-3, "percent": 1e-2, "permille": 1e-3}
TIMES = {"ms": 1e-3, "us": 1e-6, "ns": 1e-9}
KINDS = ("u_", "q_")  # of columns that are read, beside run and time
TABLES = (".csv", ".npz", ".mcap", ".db3", ".bag")  # beside folders of ROS
TOPICS = ("/joint_states", "/commands")  # of ROS: angles and commands
Mapped = dict[str, tuple[str, float]]  # column of the log: that of the file, and its factor


def parse_map(text: str) -> Mapped:
    """A mapping from the command line; ValueError: a part that is none, or a name given twice."""
    result: Mapped = {}
    for part in filter(None, text.split(",")):
        name, _, source = map(str.strip, part.partition("="))
        column, _, unit = source.rpartition(":") if ":" in source else (source, "", "1")
        units = TIMES if name == "time" else UNITS
        try:
            factor = units.get(unit) or float(unit)
        except ValueError:
            factor = 0.0
        known = name in ("run", "time") or name.startswith(KINDS)
        of_log = name if known else f"q_{name}"
        fits = bool(name and column and factor) and of_log not in result
        wanted = f"NAME=COLUMN or NAME=COLUMN:UNIT once, a unit of {', '.join(units)}, or a number"
        require(fits, "--map", wanted, repr(part))
        result[of_log] = (column, factor)
    return result


def load_table(path: Path, mapped: Mapped, topics: tuple[str, str] = TOPICS) -> dict[str, Any]:
    """The columns of a log: those of the file that have their names already, and mapped ones.

    `topics` are those of a recording of ROS. Time is in seconds. A table without `run` is one
    recording, by the name of its file.
    ValueError: no such file or column, or no number where one must be.
    """
    table: Mapping[str, Any]
    if path.suffix.lower() == ".csv":
        table = read_csv(path)
    elif path.suffix.lower() == ".npz":
        table = load_arrays(path)[1]
    else:
        table = read_ros(path, *topics)
    joints = [name[2:] for name in (*table, *mapped) if name.startswith("u_")]
    read = ("run", "time", *(f"{kind}{joint}" for joint in joints for kind in KINDS))
    named = {name: (name, 1.0) for name in read if name in table}
    rows = max(map(np.size, table.values()), default=0)
    result: dict[str, Any] = {"run": np.repeat(path.stem, rows), **table}  # others, for messages
    for name, (column, factor) in (named | mapped).items():
        wanted = f"a column for {name} (--map {name}=COLUMN:UNIT)"
        require(column in table, f"{path}: column {column}", wanted, brief(list(table)))
        values = np.asarray(table[column])
        if name == "time":
            values = _seconds(path, column, values)
            values = values if factor == 1 else values - values[0]  # keeps its digits
        elif name != "run" and values.dtype.kind in "US":
            values = numbers(path, column, values)
        if name == "run":  # one for all rows, or one for each
            result[name] = np.broadcast_to(values.astype(str), rows)
        else:
            result[name] = values * factor
    for name in mapped:
        command = "u_" + name.removeprefix("q_")
        fits = not name.startswith("q_") or command in result
        require(fits, f"{path}: --map {name}", f"a column {command}, too", brief(list(result)))
    return result


def _seconds(path: Path, column: str, stamps: Any) -> Array:
    """Numbers as they are; datetime64 and ISO stamps as seconds since the first one."""
    if stamps.dtype.kind == "M":
        return np.asarray((stamps - stamps[0]) / np.timedelta64(1, "s"))
    if stamps.dtype.kind not in "US":
        return np.asarray(stamps)
    if ":" not in str(stamps[0]):
        return numbers(path, column, stamps)
    times = []
    for row, stamp in enumerate(stamps, 2):
        try:
            time = datetime.fromisoformat(str(stamp).strip())
        except ValueError:
            place = f"{path}: row {row}, column {column}"
            raise ValueError(f"{place}: expected an ISO stamp, got {brief(str(stamp))}") from None
        times.append(time if time.tzinfo else time.replace(tzinfo=UTC))
    return np.array([(time - times[0]).total_seconds() for time in times])
