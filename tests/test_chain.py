"""`examples/chain.sh`: five commands from nothing to a drive on a bus."""

import os
import subprocess
import sys
from pathlib import Path

from helpers_bus import own_multicast_port

from brokk_min.can.drive_log import read_frames
from brokk_min.learning.policy import load_policy
from brokk_min.machine import BROKK_170

SCRIPT = Path(__file__).parents[1] / "examples" / "chain.sh"
SMALL = {"HOURS": "0.01", "FIT_STEPS": "8", "TRAIN_STEPS": "3072", "STARTS": "1"}


def test_chain__goes_from_a_recording_to_a_drive(tmp_path, monkeypatch):
    """The tool is to stand still; on a loaded computer the drive may stop, because it is late."""
    own_multicast_port(monkeypatch)
    monkeypatch.delenv("COVERAGE_PROCESS_CONFIG", raising=False)  # other tests run all of it
    (tmp_path / "stand.csv").write_text("sequence,time,vx,vy,vz\nstand,0,0,0,0\nstand,1,0,0,0\n")
    command = tmp_path / "brokk-min"  # the package of this folder, whatever is installed
    command.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m brokk_min "$@"\n')
    command.chmod(0o755)
    here = {"PATH": f"{tmp_path}:{os.environ['PATH']}", "COMMANDS": str(tmp_path / "stand.csv")}
    here |= {"PYTHONPATH": str(SCRIPT.parents[1])}
    done = subprocess.run(
        ["sh", SCRIPT, tmp_path / "new"],
        env=os.environ | SMALL | here,
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0 or done.stderr.splitlines()[-1].startswith("brokk-min: drive: "), (
        done.stderr
    )
    policy = load_policy(tmp_path / "new" / "policy.npz", BROKK_170)
    assert policy.training["recipe"]["learner"]["total_steps"] == 3072
    assert "PPO, our agent" in done.stdout and "strongest PID" in done.stdout
    assert any(frame.id == 0x210 for frame in read_frames(tmp_path / "new" / "drive.log"))
