"""Recordings of ROS (rosbag2 folders, `.mcap`, `.db3`, and `.bag` of ROS 1) as tables.

Angles are in `sensor_msgs/JointState`, commands in another JointState (its first filled field) or
in a `std_msgs/Float64MultiArray` in the order of the angles. A row is a message with angles and has
the commands that hold then. All times are the recorder's, so both topics have one clock.
"""

from pathlib import Path
from typing import Any

from brokk_min._files import expected, require_package
from brokk_min.machine import require


def read_ros(path: Path, angles: str, commands: str) -> dict[str, Any]:
    """Columns `time,u_<joint>...,q_<joint>...` of the messages on two topics, in ROS's units.

    ValueError: no rosbags, no recording, no such topic, or a number of commands that does not fit.
    """
    reader_of = require_package("rosbags.highlevel", "ros").AnyReader
    types = require_package("rosbags.typesys", "ros")
    store = types.get_typestore(types.Stores.ROS2_HUMBLE)  # of bags without definitions
    rows: list[dict[str, float]] = []
    order: list[str] = []
    q: dict[str, float] = {}
    u: dict[str, float] = {}
    with expected(path, "a recording of ROS"), reader_of([path], default_typestore=store) as bag:
        for topic in (angles, commands):
            require(topic in bag.topics, f"{path}: --topics", f"two of {[*bag.topics]}", topic)
        chosen = [one for one in bag.connections if one.topic in (angles, commands)]
        for connection, stamp, data in bag.messages(chosen):
            message = bag.deserialize(data, connection.msgtype)
            if connection.topic == angles:
                order = order or list(message.name)
                q |= dict(zip(message.name, message.position, strict=True))
                if u and u.keys() <= q.keys():
                    row = {"time": stamp / 1e9} | {f"u_{name}": x for name, x in u.items()}
                    rows.append(row | {f"q_{name}": q[name] for name in u})
            elif order:
                u = commands_of(message, order)
    require(len(rows) > 0, str(path), f"{angles} after {commands}, of the same joints", "none")
    return {column: [row[column] for row in rows] for column in rows[0]}


def commands_of(message: Any, order: list[str]) -> dict[str, float]:
    """Commands by joint; ValueError: other numbers of them than of joints."""
    if hasattr(message, "data"):
        require(len(message.data) == len(order), "commands", f"one of each {order}", message.data)
        return dict(zip(order, message.data, strict=True))
    filled = (x for x in (message.position, message.velocity, message.effort) if len(x))
    return dict(zip(message.name, next(filled, []), strict=True))
