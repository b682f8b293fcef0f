"""Two processes on one CAN bus over UDP multicast: lateness, latency, lost frames, drift at 20 Hz.

    python -m benchmarks.bus [--seconds 600] [--busy] [--realtime] [--json F]

`brokk-min machine` and `brokk-min drive` run as a user runs them; all figures come from the log of the drive.
The policy's weights are random, which costs the same time as trained ones.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from benchmarks.rollout import random_net
from brokk_min.can.canopen import Frame, read_frames
from brokk_min.env import observation_scale
from brokk_min.learning.policy import Policy, contract, save_policy
from brokk_min.machine import BROKK_170

BUS = ["--interface", "udp_multicast", "--channel", "239.74.163.2"]


@dataclass
class Options:
    seconds: float = 600.0
    """How long to drive [s]."""
    busy: bool = False
    """Also keep every core busy."""
    realtime: bool = False
    """Run both processes with real-time priority (chrt -f 10), as on a real machine."""
    json: Path | None = None
    """Also write the figures here."""


def random_policy(rng: np.random.Generator) -> Policy:
    mean, scale = observation_scale(BROKK_170)
    weights: list[Any] = []
    for rows, columns in pairwise([len(mean), 256, 128, 64, len(BROKK_170.driven)]):
        weights += [rng.normal(0, rows**-0.5, (rows, columns)), np.zeros(columns)]
    net = random_net(rng).select([BROKK_170.names[i] for i in BROKK_170.driven])
    arrays = tuple(weight.astype(np.float32) for weight in weights)
    return Policy(contract(BROKK_170), {}, mean, scale, arrays, net)


def figures(frames: list[Frame]) -> dict[str, Any]:
    """Times in ms. Lateness is that of SYNC on the grid of the first one, so it holds the drift too."""
    begin = next(k for k, f in enumerate(frames) if f.id == 0x210)
    frames = frames[begin:]
    syncs = np.array([f.time for f in frames if f.id == 0x080])
    ticks = np.floor((syncs - syncs[0]) / 0.05 + 0.1)  # up to 45 ms late is late, not the next tick
    late = 1e3 * (syncs - syncs[0] - ticks * 0.05)
    latency, answer, positions, newest, sync = [], [], 0, 0.0, 0.0
    for frame in frames:
        if frame.id == 0x080:
            sync = frame.time
        if 0x181 <= frame.id <= 0x185:
            positions, newest = positions + 1, frame.time
        elif frame.id == 0x210 and sync:
            latency.append(1e3 * (frame.time - newest))
            answer.append(1e3 * (frame.time - sync))
    counters = np.array([f.data[5] for f in frames if f.id == 0x210])

    def spread(values: Any) -> dict[str, float]:
        values = np.asarray(values) - min(0.0, float(np.min(values)))
        return {name: round(float(np.percentile(values, p)), 3) for name, p in PERCENTILES.items()}

    return {
        "ticks": len(syncs),
        "skipped": int(ticks[-1] + 1 - len(syncs)),
        "positions_lost": 5 * len(syncs) - positions,
        "valve_frames_lost": int((np.diff(counters) % 256 != 1).sum()),
        "ended_by_itself": frames[-1].data[-1:] == b"\x00",
        "lateness": spread(late),
        "last_position_to_valve_frame": spread(latency),
        "sync_to_valve_frame": spread(answer),
        "drift": round(float(np.median(late[-100:]) - np.median(late[:100])), 3),
    }


PERCENTILES = {"median": 50, "p99": 99, "p99.9": 99.9, "max": 100}


def main(options: Options) -> None:
    run = [*["chrt", "-f", "10"] * options.realtime, sys.executable, "-m", "brokk_min"]
    os.environ["CAN_CONFIG"] = json.dumps(
        {"port": 43114}
    )  # python-can's own is for users and tests
    with tempfile.TemporaryDirectory() as folder:
        policy, commands, log = (Path(folder) / name for name in ("policy.npz", "c.csv", "run.log"))
        save_policy(policy, random_policy(np.random.default_rng(0)))
        goals = [f"g,{t},{0.1 * (-1) ** t},0,0" for t in range(round(options.seconds) + 1)]
        commands.write_text("\n".join(["sequence,time,vx,vy,vz", *goals]) + "\n")
        cores = range((os.cpu_count() or 1) if options.busy else 0)
        burners = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in cores]
        machine = subprocess.Popen([*run, "machine", *BUS], stdout=subprocess.DEVNULL)
        try:
            time.sleep(10)
            command = [*run, "drive", "--policy", policy, *BUS, "--command", commands, "--log", log]
            code = subprocess.run(command, stdout=subprocess.DEVNULL).returncode
            frames = list(read_frames(log))
        finally:
            for process in (machine, *burners):
                process.kill()
                process.wait()
        result = {
            "seconds": options.seconds,
            "busy": options.busy,
            "realtime": options.realtime,
            "exit": code,
            **figures(frames),
        }
    print(json.dumps(result, indent=1))
    if options.json:
        options.json.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
