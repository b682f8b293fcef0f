"""Recordings of ROS (rosbag2 folders, `.mcap`, `.db3`, and `.bag` of ROS 1) as tables.

Angles are in `sensor_msgs/JointState`, commands in another JointState (its first field with other
numbers than 0) or in a `std_msgs/Float64MultiArray` in the order of the angles. Several nodes may
send each. A command holds from its own stamp on. Stamps are those of the headers, moved to the
recorder's clock by the message that was least late, or else the recorder's, which have the delays
of the network in them.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from brokk_min._files import brief, expected, require_package
from brokk_min.machine import Array, require

STATE = "sensor_msgs/msg/JointState"
ARRAYS = ("std_msgs/msg/Float64MultiArray", "std_msgs/msg/Float32MultiArray")
FIELDS = ("position", "velocity", "effort")  # of a JointState
COMMAND_TIME = "time of commands"  # the column with their stamps
LATE = 0.01  # s, assumed: differences between the delays of messages that are worth a word
ONE_CLOCK = 0.5  # s, assumed: clocks of one robot differ by less
OLD = 0.5  # s, and five usual periods, assumed: no machine waits so long for a command
Values = list[tuple[float, dict[str, float]]]  # of joints by their names, each with its stamp [s]


def read_ros(
    path: Path, angles: str, commands: str, renamed: bool = False
) -> tuple[dict[str, Any], list[str]]:
    """Columns `time,q_<joint>...` and `time of commands,u_<joint>...` of two topics; and warnings.

    Both in ROS's units. ValueError: no rosbags, no recording, no such topic or another type of
    message, or commands that do not fit the angles.
    """
    folder = not path.is_dir() or (path / "metadata.yaml").exists()
    require(
        folder, str(path), "a folder of ROS, with metadata.yaml (several: all their names)", "none"
    )
    reader_of = require_package("rosbags.highlevel", "ros").AnyReader
    types = require_package("rosbags.typesys", "ros")
    store = types.get_typestore(types.Stores.ROS2_HUMBLE)  # of bags without definitions
    found: dict[str, list[tuple[float, Any]]] = {angles: [], commands: []}
    with expected(path, "a recording of ROS"), reader_of([path], default_typestore=store) as bag:
        for topic in (angles, commands):
            require(topic in bag.topics, f"{path}: --topics", f"topics of {[*bag.topics]}", topic)
        chosen = [one for one in bag.connections if one.topic in found]
        for one in chosen:
            kinds = (STATE,) if one.topic == angles else (STATE, *ARRAYS)
            require(one.msgtype in kinds, f"{path}: {one.topic}", " or ".join(kinds), one.msgtype)
        for one, stamp, data in bag.messages(chosen):
            found[one.topic].append((stamp / 1e9, bag.deserialize(data, one.msgtype)))
        clocks = [clock(*item) for item in found.items()]
        (stamps, offset, q_warnings), (u_stamps, u_offset, u_warnings) = clocks
        if offset and u_offset and abs(offset - u_offset) < ONE_CLOCK:
            offset = u_offset = min(offset, u_offset)  # the later ones come from farther away
        rows, u_rows = np.argsort(stamps, kind="stable"), np.argsort(u_stamps, kind="stable")
        times, u_times = stamps[rows] + offset, u_stamps[u_rows] + u_offset
        states = [found[angles][row][1] for row in rows]
        orders = [found[commands][row][1] for row in u_rows]
        names = [*dict.fromkeys(name for state in states for name in state.name)]
        q = [(t, joints_of(state, names, FIELDS[:1])) for t, state in zip(times, states)]
        used = [x for x in FIELDS if any(np.any(getattr(order, x, 0)) for order in orders)]
        u = [(t, joints_of(order, names, used or FIELDS)) for t, order in zip(u_times, orders)]
        table = columns_of(q, u, renamed)
    several = hasattr(orders[0], "data") and any([*state.name] != names for state in states)
    order = [f"{commands}: expected one order of the joints, took {names}"] if several else []
    return table, [*q_warnings, *u_warnings, *order, *old_commands(commands, table)]


def clock(topic: str, messages: list[tuple[float, Any]]) -> tuple[Array, float, list[str]]:
    """The stamp of each message [s], what moves it to the recorder's clock [s], and warnings.

    Stamps are the recorder's where a header has none, or where they make no sense.
    """
    recorded = np.array([time for time, _ in messages])
    heads = [getattr(message, "header", None) for _, message in messages]
    stamps = np.array([h.stamp.sec + h.stamp.nanosec / 1e9 if h else 0.0 for h in heads])
    names = [" ".join(getattr(message, "name", ())) for _, message in messages]
    _, sender = np.unique(names, return_inverse=True)  # a node sends the same joints each time
    late = recorded - stamps
    least = np.array([late[sender == i].min() for i in range(sender.max() + 1)])
    usual = np.quantile(late - least[sender], 0.9)
    if not stamps.all() or usual > ONE_CLOCK or len({*stamps}) < len(stamps) / 2:
        some = f"{topic}: expected a stamp in each header, got {(stamps == 0).sum()} without"
        some += " (those of the recorder are taken)"
        return recorded, 0.0, [some] if stamps.any() and not stamps.all() else []
    got = f"some that are {usual:.3f} s later than others (the headers' are taken)"
    told = f"{topic}: expected stamps of the recorder as regular as the headers', got {got}"
    return stamps, least.min(), [told] if usual > LATE else []


def joints_of(message: Any, names: list[str], fields: Sequence[str]) -> dict[str, float]:
    """Angles or commands by joint, those of the first of `fields` that is filled, or none.

    ValueError: other numbers of them than of joints.
    """
    if hasattr(message, "data"):
        wanted = f"one of each {names} (a JointState says by itself which joints it has)"
        got = brief([*map(float, message.data)])
        require(len(message.data) == len(names), "commands", wanted, got)
        return dict(zip(names, message.data, strict=True))
    filled = [x for x in (getattr(message, field) for field in fields) if len(x)]
    named = not filled or len(filled[0]) == len(message.name)
    require(named, "names", f"one of each {brief([*filled[:1]])}", brief([*message.name]))
    return dict(zip(message.name, filled[0], strict=True)) if filled else {}


def columns_of(q: Values, u: Values, renamed: bool) -> dict[str, Any]:
    """The columns of `read_ros`: angles from the first complete command on, and all commands.

    A row has the stamp of the joint with the fewest angles; those of other nodes are interpolated.
    Joints without commands are left out, unless joints are `renamed` that have other commands.
    """
    joints = [*dict.fromkeys(name for _, row in u for name in row)]
    angles, commands = ({name: series(rows, name) for name in joints} for rows in (q, u))
    known = [name for name, (times, _) in angles.items() if len(times)]
    if known != joints or not joints:
        others = [*dict.fromkeys(name for _, row in q for name in row)]
        wanted = f"those of {joints} (--topics, or names by --map q_NAME=q_OTHER)"
        require(bool(joints) and renamed, "angles", wanted, brief(others))
        angles = {name: series(q, name) for name in others}
    start = max(times[0] for times, _ in commands.values())
    time = min((times for times, _ in angles.values()), key=len)
    u_time = np.array([t for t, _ in u])
    time, u_time = time[time >= start], u_time[u_time >= start]
    require(len(time) > 0, "angles", "some after the first command", "none")
    table: dict[str, Any] = {"time": time, COMMAND_TIME: u_time}
    for name, (times, values) in commands.items():
        table[f"u_{name}"] = values[np.searchsorted(times, u_time, side="right") - 1]
    table |= {f"q_{name}": np.interp(time, *values) for name, values in angles.items()}
    return table


def series(rows: Values, name: str) -> tuple[Array, Array]:
    """Stamps and values of one joint."""
    own = [(time, row[name]) for time, row in rows if name in row]
    times, values = np.reshape(own, (-1, 2)).T
    return times, values


def old_commands(topic: str, table: dict[str, Any]) -> list[str]:
    """A warning if a command holds for so long that a machine may have closed its valves."""
    ages = np.diff(table[COMMAND_TIME], append=table["time"][-1])
    usual, longest = np.median(ages), ages.max()
    doubt = "does the machine close its valves then? Record zeros at rest"
    got = f"none for {longest:.2g} s, while the last one holds here: {doubt}"
    told = f"{topic}: expected a command every {usual:.2g} s, got {got}"
    return [told] if longest > max(OLD, 5 * usual) else []
