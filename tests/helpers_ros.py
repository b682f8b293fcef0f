"""Small recordings of ROS, written with rosbags."""

import numpy as np
from rosbags import rosbag2, typesys

STORE = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
JOINTS = ["boom", "wheel", "arm"]


def joint_state(names, position=(), velocity=(), stamp=0.0):
    types = STORE.types
    seconds, parts = divmod(round(stamp * 1e9), 10**9)
    stamp = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=parts)
    header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="")
    arrays = (np.array(x, float) for x in (position, velocity, ()))
    return types["sensor_msgs/msg/JointState"](header, list(names), *arrays)


def multi_array(values):
    types = STORE.types
    layout = types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    return types["std_msgs/msg/Float64MultiArray"](layout, np.array(values, float))


def record(path, messages, plugin="SQLITE3"):
    """A bag of (time [s], topic, message)."""
    storage = getattr(rosbag2.StoragePlugin, plugin)
    with rosbag2.Writer(path, version=8, storage_plugin=storage) as writer:
        topics = {}
        for time, topic, message in messages:
            kind = message.__msgtype__
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, kind, typestore=STORE)
            data = STORE.serialize_cdr(message, kind)
            writer.write(topics[topic], round(time * 1e9), data)
    return path


def drive(commands):
    """Angles at 20 Hz, a command every 0.1 s, a moment before the angles of the same time."""
    messages = []
    for k in range(20):
        if k % 2 == 0:
            messages.append((100 + k / 20 - 0.001, "/valves", commands(k)))
        q = joint_state(JOINTS, (0.01 * k, 9.0, -0.02 * k))
        messages.append((100 + k / 20, "/joint_states", q))
    return messages
