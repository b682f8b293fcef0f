"""Recordings of ROS, written with rosbags: the values, the commands that hold, what is missing."""

import numpy as np
import pytest

pytest.importorskip("rosbags")

from helpers_ros import drive, joint_state, multi_array, record

from brokk_min.identification.logs import read_log
from brokk_min.identification.ros_logs import COMMAND_TIME, read_ros
from brokk_min.machine import BROKK_170


@pytest.mark.parametrize("plugin", ["SQLITE3", "MCAP"])
@pytest.mark.parametrize("kind", ["array", "state"])
def test_read_ros__has_angles_and_the_commands_that_hold(tmp_path, plugin, kind):
    def commands(k):
        if kind == "array":
            return multi_array([k / 20, 0.0, -k / 40])
        return joint_state(["arm", "boom"], velocity=(-k / 40, k / 20))

    path = record(tmp_path / "bag", drive(commands), plugin)
    path = path if plugin == "SQLITE3" else next(path.glob("*.mcap"))
    table, warnings = read_ros(path, "/joint_states", "/valves")
    k = np.arange(20)
    np.testing.assert_allclose(table["time"] - 100, k / 20, atol=1e-6)
    np.testing.assert_allclose(table["q_boom"], 0.01 * k)
    np.testing.assert_allclose(table["q_arm"], -0.02 * k)
    np.testing.assert_allclose(table[COMMAND_TIME] - 100, k[::2] / 20 - 0.001, atol=1e-6)
    np.testing.assert_allclose(table["u_boom"], k[::2] / 20)
    np.testing.assert_allclose(table["u_arm"], -k[::2] / 40)
    assert ("q_wheel" in table) == (kind == "array")  # a joint without commands is left out
    assert warnings == []


def test_read_log__has_the_same_delay_as_a_table_if_commands_follow_the_angles(tmp_path):
    """Each 3 ms after the angles that it answers: it holds from there, not from the row after."""
    messages = []
    for k in range(200):
        messages.append((100 + k / 20, "/joint_states", joint_state(["boom"], [0.001 * k**1.5])))
        messages.append((100.003 + k / 20, "/valves", joint_state(["boom"], [(k % 40) / 40])))
    path = record(tmp_path / "bag", messages)
    (recording,) = read_log(path, BROKK_170, topics=("/joint_states", "/valves")).recordings
    k = np.arange(1, 200)
    np.testing.assert_allclose(recording.q[:, 0], 0.001 * k**1.5, atol=0.004)
    np.testing.assert_allclose(recording.u[1:, 0], (k[1:] % 40) / 40, atol=0.1)


def test_read_ros__takes_stamps_of_headers_on_the_clock_of_the_recorder(tmp_path):
    """The robot's clock is an hour behind, and messages come late by up to 45 ms."""
    late = np.random.default_rng(0).uniform(0, 0.045, 60)
    late[7] = 0.0
    messages = [(99.9, "/valves", multi_array([0.5]))]
    for k, x in enumerate(late):
        q = joint_state(["boom"], [0.01 * k], stamp=7200 - 3600 + k / 20)
        messages.append((100 + k / 20 + x, "/joint_states", q))
    table, warnings = read_ros(record(tmp_path / "bag", messages), "/joint_states", "/valves")
    np.testing.assert_allclose(table["time"] - 100, np.arange(60) / 20, atol=1e-6)
    told = "/joint_states: expected stamps of the recorder as regular as the headers', got some"
    assert len(warnings) == 1 and warnings[0].startswith(told)


def test_read_ros__lets_one_node_be_farther_away_than_another(tmp_path):
    messages = [(99.9, "/valves", multi_array([0.5, 0.5]))]
    for k in range(60):
        for name, late in (("boom", 0.002), ("arm", 0.030)):  # each always as late
            q = joint_state([name], [0.01 * k], stamp=100 + k / 20)
            messages.append((100 + k / 20 + late, "/joint_states", q))
    table, warnings = read_ros(record(tmp_path / "bag", messages), "/joint_states", "/valves")
    np.testing.assert_allclose(table["time"] - 100.002, np.arange(60) / 20, atol=1e-6)
    np.testing.assert_allclose(table["q_arm"], table["q_boom"], atol=1e-9)
    assert len(warnings) == 1 and "one order of the joints" in warnings[0]


def test_read_ros__puts_together_what_several_nodes_send_and_says_so(tmp_path):
    """Angles of the arm come 20 ms after those of the boom; ten were not read."""
    messages = [(99.9, "/valves", multi_array([0.5, -0.5]))]
    for k in range(60):
        boom = np.nan if k < 10 else 0.01 * k
        messages.append((100 + k / 20, "/joint_states", joint_state(["boom"], [boom])))
        messages.append((100.02 + k / 20, "/joint_states", joint_state(["arm"], [-0.02 * k])))
        messages.append((100.021 + k / 20, "/valves", multi_array([0.5, -0.5])))
    path = record(tmp_path / "bag", messages)
    table, warnings = read_ros(path, "/joint_states", "/valves")
    assert warnings == ["/valves: expected one order of the joints, took ['boom', 'arm']"]
    np.testing.assert_allclose(table["q_arm"][1:], -0.02 * (np.arange(1, 60) - 0.4), atol=1e-6)
    np.testing.assert_array_equal(np.isnan(table["q_boom"]), np.arange(60) < 10)
    log = read_log(path, BROKK_170, topics=("/joint_states", "/valves"))
    assert [len(one.q) for one in log.recordings] == [50]
    assert "bag: row 2: expected motion of q_boom, got a jump to nan" in log.warnings[1]


def test_read_ros__leaves_out_empty_messages_and_stamps_that_nobody_has_set(tmp_path):
    """A driver publishes before its first read; velocities are no angles."""
    messages = [(99.9, "/valves", multi_array([0.5]))]
    for k in range(20):
        q = joint_state(["boom"], [0.01 * k] if k > 2 else [], velocity=[9.0], stamp=7.0)
        messages.append((100 + k / 20, "/joint_states", q))
    table, warnings = read_ros(record(tmp_path / "bag", messages), "/joint_states", "/valves")
    np.testing.assert_allclose(table["time"] - 100, np.arange(3, 20) / 20, atol=1e-6)
    np.testing.assert_allclose(table["q_boom"], 0.01 * np.arange(3, 20))
    assert warnings == []
    with pytest.raises(ValueError, match=r"expected a folder of ROS, with metadata.yaml"):
        read_ros(tmp_path, "/joint_states", "/valves")


def test_read_ros__does_not_take_a_distant_node_for_a_slow_valve(tmp_path):
    """Messages of one clock come 3, 80 and 120 ms late, and two of them in the wrong order."""
    messages = []
    for k in range(60):
        sent = 100 + k / 20
        stamps = {"stamp": sent}
        messages.append(
            (sent + 0.003, "/valves", joint_state(["boom", "arm"], [0.5, 0.5], **stamps))
        )
        for name, late in (("boom", 0.080), ("arm", 0.190 if k == 30 else 0.120)):
            q = joint_state([name], [0.01 * k], **stamps)
            messages.append((sent + late, "/joint_states", q))
    path = record(tmp_path / "bag", sorted(messages, key=lambda message: message[0]))
    table, warnings = read_ros(path, "/joint_states", "/valves")
    np.testing.assert_allclose(table["time"] - 100.003, np.arange(60) / 20, atol=1e-6)
    np.testing.assert_allclose(table[COMMAND_TIME], table["time"], atol=1e-6)
    np.testing.assert_allclose(table["q_arm"], 0.01 * np.arange(60), atol=1e-9)
    assert warnings == []
    messages[1] = (*messages[1][:2], joint_state(["boom"], [0.0], stamp=0.0))
    path = record(tmp_path / "one", sorted(messages, key=lambda message: message[0]))
    (told,) = read_ros(path, "/joint_states", "/valves")[1]
    assert told.startswith("/joint_states: expected a stamp in each header, got 1 without")


def test_read_ros__takes_the_field_with_commands_and_names_a_message_that_does_not_fit(tmp_path):
    def filled(k):
        return joint_state(["arm", "boom"], [0.0, 0.0], velocity=(-k / 40, k / 20))

    table, _ = read_ros(record(tmp_path / "bag", drive(filled)), "/joint_states", "/valves")
    np.testing.assert_allclose(table["u_boom"], np.arange(0, 20, 2) / 20)
    path = record(tmp_path / "short", drive(lambda k: joint_state(["arm"], [0.1, 0.2])))
    with pytest.raises(ValueError, match=r"names: expected one of each .*, got \['arm'\]"):
        read_ros(path, "/joint_states", "/valves")


def test_read_ros__warns_of_a_command_that_holds_for_long(tmp_path):
    messages = drive(lambda k: multi_array([0.5, 0.0, 0.5]))
    later = [(t + 3, topic, message) for t, topic, message in messages]
    path = record(tmp_path / "bag", [*messages, *later])
    (told,) = read_ros(path, "/joint_states", "/valves")[1]
    assert told.startswith("/valves: expected a command every 0.1 s, got none for 2.1 s, while")


def test_read_ros__names_what_is_missing(tmp_path):
    path = record(tmp_path / "bag", drive(lambda k: multi_array([0.0, 0.0])))
    with pytest.raises(ValueError, match=r"bag: --topics: expected topics of .*/valves.*got /u"):
        read_ros(path, "/joint_states", "/u")
    with pytest.raises(ValueError, match=r"commands: expected one of each \['boom', 'wheel', "):
        read_ros(path, "/joint_states", "/valves")
    refusal = r"bag: /valves: expected sensor_msgs/msg/JointState, got std_msgs/msg/Float64Multi"
    with pytest.raises(ValueError, match=refusal):
        read_ros(path, "/valves", "/joint_states")
    path = record(tmp_path / "other", drive(lambda k: joint_state(["stick"], [0.1])))
    with pytest.raises(ValueError, match=r"other: angles: expected those of \['stick'\]"):
        read_ros(path, "/joint_states", "/valves")
    (tmp_path / "x.mcap").write_bytes(b"no recording")
    with pytest.raises(ValueError, match=r"x\.mcap: expected a recording of ROS, got"):
        read_ros(tmp_path / "x.mcap", "/a", "/b")
