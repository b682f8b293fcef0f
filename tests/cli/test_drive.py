"""The command `drive`: as a process on a real bus, and where it cannot go on."""

import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from helpers_bus import MULTICAST, START, eventually, own_multicast_port, recorded_rows
from helpers_cli import run

from brokk_min.can.drive_log import read_frames
from brokk_min.identification.files import SHIPPED
from brokk_min.identification.logs import read_log

POLICY = str(SHIPPED / "brokk170" / "policy.npz")


@pytest.fixture
def commands(tmp_path):
    rows = ["up,0,0,0,0.2", "up,1.0,0,0,0", "side,0,0,0.1,0", "side,0.4,0,0,0"]
    path = tmp_path / "c.csv"
    path.write_text("\n".join(["sequence,time,vx,vy,vz", *rows, ""]))
    return path


def process(*arguments):
    command = [sys.executable, "-m", "brokk_min", *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def test_drive__replays_converts_and_survives_a_kill_as_a_process_of_its_own(
    tmp_path, commands, capsys, monkeypatch
):
    """On a loaded machine a tick may be late; then the drive stops, which is right: once more."""
    own_multicast_port(monkeypatch)
    where = ["--interface", "udp_multicast", "--channel", MULTICAST]
    jacobian = ["drive", "--policy", POLICY, "--controller", "jacobian"]
    log, plant = tmp_path / "run.log", tmp_path / "plant.csv"
    drive = [*jacobian, *where, "--command", commands, "--log", log, "--force"]
    machine = process("machine", *where, "--start", *START, "--record", plant)
    try:
        eventually(lambda: len(recorded_rows(plant)) > 10, 60)
        end = time.monotonic() + 120
        while (code := run(*drive)) and time.monotonic() < end:
            pass
        assert code == 0, capsys.readouterr().err
        assert "driving v goal +0.00 +0.00 +0.20" in capsys.readouterr().out
        assert run(*jacobian, "--replay", log) == 0
        same = capsys.readouterr().out
        assert "valve frames are the same" in same and " 0 of" not in same
        assert run("drive", "--policy", POLICY, "--replay", log) == 1
        assert "others" in capsys.readouterr().err
        assert run("convert", log, "--out", tmp_path / "log.csv") == 0
        recordings = read_log([tmp_path / "log.csv"], 4).recordings
        assert sum(len(recording.u) for recording in recordings) >= 25
        driving, end = False, time.monotonic() + 120
        while not driving and time.monotonic() < end:
            first = len(recorded_rows(plant))
            driver = process(*drive)
            while not driving and driver.poll() is None:
                driving = bool(np.any(recorded_rows(plant)[first:, 1:6]))
            driver.send_signal(signal.SIGKILL)
            driver.communicate()
        assert driving
        # all by the plant's own record: the last valid frame, and no motion 155 ms after it
        killed = recorded_rows(plant)[-1, 0]
        eventually(lambda: recorded_rows(plant)[-1, 0] > killed + 0.8, 60)
        rows = recorded_rows(plant)
        time_, opened, valid = rows[:, 0], rows[:, 1:6].any(axis=1), rows[:, 6]
        last = valid[-1]
        assert 0 < last < killed + 0.5 and (valid[time_ > killed + 0.5] == last).all()
        assert opened[time_ <= last].any() and not opened[time_ > last + 0.155].any()
        machine.send_signal(signal.SIGTERM)
        assert machine.wait(30) == 0
    finally:
        machine.kill()
        machine.communicate()
    assert list(read_frames(log))  # what a killed program left can be read


def test_drive__refuses_in_one_line_to_drive_without_machine_joystick_or_slow_goals(
    tmp_path, commands, capsys
):
    drive = ["drive", "--policy", POLICY, "--interface", "virtual", "--channel", "empty"]
    fast = tmp_path / "fast.csv"
    fast.write_text("sequence,time,vx,vy,vz\nf,0,1,0,0\nf,1,0,0,0\n")
    for source, refusal in (
        (commands, "node 1: object 0x6501:00: expected an answer"),
        ("joystick", "joystick: expected one, or --command FILE.csv, got none"),
        (fast, "command: expected at most 0.3 m/s, got 1 m/s"),
    ):
        assert run(*drive, "--command", source) == 1
        error = capsys.readouterr().err
        assert refusal in error and error.count("\n") == 1
