"""Recordings of ROS, written with rosbags: the values, the commands that hold, what is missing."""

import numpy as np
import pytest

pytest.importorskip("rosbags")

from helpers_ros import drive, joint_state, multi_array, record

from brokk_min.identification.ros_logs import read_ros


@pytest.mark.parametrize("plugin", ["SQLITE3", "MCAP"])
@pytest.mark.parametrize("kind", ["array", "state"])
def test_read_ros__has_angles_and_the_commands_that_hold(tmp_path, plugin, kind):
    def commands(k):
        if kind == "array":
            return multi_array([k / 20, 0.0, -k / 40])
        return joint_state(["arm", "boom"], velocity=(-k / 40, k / 20))

    path = record(tmp_path / "bag", drive(commands), plugin)
    path = path if plugin == "SQLITE3" else next(path.glob("*.mcap"))
    table = read_ros(path, "/joint_states", "/valves")
    k = np.arange(2, 20)  # the first command comes before the names of the joints
    np.testing.assert_allclose(np.array(table["time"]) - 100, k / 20, atol=1e-6)
    np.testing.assert_allclose(table["q_boom"], 0.01 * k)
    np.testing.assert_allclose(table["q_arm"], -0.02 * k)
    np.testing.assert_allclose(table["u_boom"], k // 2 * 2 / 20)
    np.testing.assert_allclose(table["u_arm"], -(k // 2 * 2) / 40)
    assert ("q_wheel" in table) == (kind == "array")  # a joint without commands is left out


def test_read_ros__names_what_is_missing(tmp_path):
    path = record(tmp_path / "bag", drive(lambda k: multi_array([0.0, 0.0])))
    with pytest.raises(ValueError, match=r"bag: --topics: expected two of .*/valves.*got /u"):
        read_ros(path, "/joint_states", "/u")
    with pytest.raises(ValueError, match=r"commands: expected one of each \['boom', 'wheel', "):
        read_ros(path, "/joint_states", "/valves")
    (tmp_path / "x.mcap").write_bytes(b"no recording")
    with pytest.raises(ValueError, match=r"x\.mcap: expected a recording of ROS, got"):
        read_ros(tmp_path / "x.mcap", "/a", "/b")
