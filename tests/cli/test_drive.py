"""The commands `machine` and `drive` on a real bus, to the end and to a kill."""

import signal
import subprocess
import sys
import time

from helpers_bus import MULTICAST, eventually, own_multicast_port
from helpers_cli import run

from brokk_min.can.drive_log import log_for_fit, read_frames, read_telemetry
from brokk_min.machine import BROKK_170

JOG = "drive --controller jog --joint q4 --counts 30"


def process(*arguments):
    command = [sys.executable, "-m", "brokk_min", *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def drives(log):
    """Ticks of a log in which the valves were open."""
    ticks = read_telemetry(BROKK_170, read_frames(log)) if log.exists() else ()
    return sum(tick.driving and tick.u.any() for tick in ticks)


def test_drive__leaves_a_log_for_fit_and_closed_valves_if_it_is_killed(
    tmp_path, capsys, monkeypatch
):
    """On a loaded machine a tick may be late; then the drive stops, which is right: once more."""
    own_multicast_port(monkeypatch)
    where = ["--interface", "udp_multicast", "--channel", MULTICAST]
    log, commands = tmp_path / "run.log", tmp_path / "c.csv"
    commands.write_text("sequence,time,vx,vy,vz\nthere,0,0.2,0,0\nthere,1.5,0,0,0\n")
    drive = [*JOG.split(), *where, "--command", commands, "--log", log, "--force"]
    machine = process("machine", *where)
    try:
        end = time.monotonic() + 120
        while (code := run("", *drive)) and time.monotonic() < end:
            pass
        assert code == 0, capsys.readouterr().err
        told = capsys.readouterr().out
        assert "driving, v goal +0.20 +0.00 +0.00" in told and told.startswith("brokk170 (--mac")
        assert len(log_for_fit(BROKK_170, read_frames(log)).recordings[0].u) >= 25
        killed = False  # while it drove
        while not killed and time.monotonic() < end:
            log.unlink()
            driver = process(*drive)
            eventually(log.exists)
            while not drives(log) and driver.poll() is None:
                time.sleep(0.1)
            killed = driver.poll() is None
            driver.send_signal(signal.SIGKILL)
            driver.communicate()
        assert killed and drives(log)
        time.sleep(1.0)
        machine.send_signal(signal.SIGTERM)
        said, _ = machine.communicate(timeout=60)
        assert machine.returncode == 0
        assert said.splitlines()[-1].endswith("valve controller stops: no valve frame for 0.15 s")
    finally:
        machine.kill()
        machine.communicate()
