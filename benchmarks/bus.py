"""Two processes on one CAN bus over UDP multicast: lateness, latency, lost frames, drift at 20 Hz.

    python -m benchmarks.bus [--seconds 600] [--busy] [--realtime] [--foreign 1000] [--json F]

`brokk-min machine` and `brokk-min drive` run as a user runs them; all figures come from the log of
the drive. Beside them a process of the same priority only sleeps, a millisecond each time: what
makes it late is not the loop. Memory is that of the drive.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from benchmarks import POLICY, memory, write
from brokk_min.can.canopen import Frame
from brokk_min.can.drive_log import read_frames

BUS = ["--interface", "udp_multicast", "--channel", "239.74.163.2"]
SENDER = """
import can, sys, time
bus = can.Bus(interface=sys.argv[2], channel=sys.argv[4])
rate, start, sent = float(sys.argv[5]), time.monotonic(), 0
while True:
    while sent < rate * (time.monotonic() - start):
        can_id = 0x300 + sent % 256
        bus.send(can.Message(arbitration_id=can_id, data=bytes(8), is_extended_id=False))
        sent += 1
        if sent % 500 == 0:
            print(sent / (time.monotonic() - start), flush=True)
    time.sleep(0.001)
"""
SLEEPER = """
import time
while True:
    begin = time.monotonic()
    time.sleep(0.001)
    late = time.monotonic() - begin - 0.001
    if late > 0.002:
        print(time.time(), 1e3 * late, flush=True)
"""
WARM_UP = 30.0  # s of a drive, before its memory counts
PERCENTILES = {"median": 50, "p99": 99, "p99.9": 99.9, "max": 100}


@dataclass
class Options:
    seconds: float = 600.0  # How long to drive [s].
    busy: bool = False  # Also keep every core busy.
    realtime: bool = False  # Both processes with real-time priority (chrt -f 10), as on a machine.
    foreign: int = 0  # Frames that another process sends each second, of foreign identifiers.
    json: Path | None = None  # Also write the figures here.


def figures(frames: list[Frame]) -> dict[str, Any]:
    """Times in ms. Lateness is that of SYNC on the grid of the first one, drift included."""
    begin = next((k for k, frame in enumerate(frames) if frame.id == 0x210), len(frames))
    frames = frames[begin:]
    if not frames:
        return {"ticks": 0}  # it never drove
    times = np.array([frame.time for frame in frames])
    ids = np.array([frame.id for frame in frames])
    syncs = times[ids == 0x080]
    positions = times[(ids >= 0x181) & (ids <= 0x185)]
    valves = times[(ids == 0x210) & (times > syncs[0])]
    last_position = positions[np.searchsorted(positions, valves, "right") - 1]
    last_sync = syncs[np.searchsorted(syncs, valves, "right") - 1]
    ticks = np.floor((syncs - syncs[0]) / 0.05 + 0.1)  # up to 45 ms late is not the next tick
    late = 1e3 * (syncs - syncs[0] - ticks * 0.05)
    counters = np.array([frame.data[5] for frame in frames if frame.id == 0x210])
    return {
        "ticks": len(syncs),
        "skipped": int(ticks[-1] + 1 - len(syncs)),
        "positions_lost": 5 * len(syncs) - len(positions),
        "valve_frames_lost": int((np.diff(counters) % 256 != 1).sum()),
        "ended_by_itself": frames[-1].data[-1:] == b"\x00",
        "lateness": percentiles(late - min(0.0, late.min())),
        "last_position_to_valve_frame": percentiles(1e3 * (valves - last_position)),
        "sync_to_valve_frame": percentiles(1e3 * (valves - last_sync)),
        "drift": round(float(np.median(late[-100:]) - np.median(late[:100])), 3),
    }


def percentiles(values: Any) -> dict[str, float]:
    return {name: round(float(np.percentile(values, p)), 3) for name, p in PERCENTILES.items()}


def memory_of(process: Any) -> dict[str, float]:
    """Memory [MB] of a process until its end, and by how much it grows in an hour."""
    begin, times, used = time.monotonic(), [], []
    while process.poll() is None:
        if time.monotonic() - begin > WARM_UP:
            with suppress(IndexError):  # it has just ended
                used.append(memory(process.pid))
                times.append((time.monotonic() - begin) / 3600)
        time.sleep(1)
    if len(used) < 240:  # s; of less the growth is noise
        return {}
    growth = float(np.polyfit(times, used, 1)[0])
    return {"begin": used[0], "end": used[-1], "growth_per_hour": round(growth, 2)}


def sleeper_figures(lines: str, frames: list[Frame]) -> dict[str, float]:
    """How often the sleeping process was late during the drive, and by how much [ms]."""
    rows = [line.split() for line in lines.splitlines()]
    during = [float(ms) for t, ms in rows if frames[0].time < float(t) < frames[-1].time + 0.1]
    counts = {f"over_{ms}_ms": sum(late > ms for late in during) for ms in (5, 10, 25)}
    return counts | {"max": round(max(during, default=0.0), 2)}


def main(options: Options) -> None:
    priority = ["chrt", "-f", "10"] if options.realtime else []
    run = [*priority, sys.executable, "-m", "brokk_min"]
    os.environ["CAN_CONFIG"] = json.dumps({"port": 43114})  # python-can's own is for users, tests
    with tempfile.TemporaryDirectory() as folder:
        commands = Path(folder) / "c.csv"
        log = Path(folder) / "run.log"
        goals = [f"g,{t},{0.1 * (-1) ** t},0,0" for t in range(round(options.seconds) + 1)]
        commands.write_text("\n".join(["sequence,time,vx,vy,vz", *goals]) + "\n")
        drive = [*run, "drive", "--policy", POLICY, *BUS, "--command", commands, "--log", log]
        processes = [subprocess.Popen([*run, "machine", *BUS], stdout=subprocess.DEVNULL)]
        if options.busy:
            for _ in range(os.cpu_count() or 1):
                processes.append(subprocess.Popen([sys.executable, "-c", "while True: pass"]))
        if options.foreign:
            sender = [sys.executable, "-c", SENDER, *BUS, str(options.foreign)]
            processes.append(subprocess.Popen(sender, stdout=(Path(folder) / "rate").open("w")))
        late = Path(folder) / "late"
        sleeper = [*priority, sys.executable, "-c", SLEEPER]
        processes.append(subprocess.Popen(sleeper, stdout=late.open("w")))
        try:
            time.sleep(10)
            ended = subprocess.Popen(
                drive, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
            )
            used = memory_of(ended)
            said = ended.stderr.read() if ended.stderr else ""
            frames = list(read_frames(log))
        finally:
            for process in processes:
                process.kill()
                process.wait()
        asleep = sleeper_figures(late.read_text(), frames)
        rates = (Path(folder) / "rate").read_text().split() if options.foreign else ["0"]
    result: dict[str, Any] = {"seconds": options.seconds, "busy": options.busy}
    result |= {"realtime": options.realtime, "foreign": float(rates[-1]), "exit": ended.returncode}
    result |= {"said": said.strip()[-300:], **figures(frames), "memory_mb": used, "sleeper": asleep}
    write(result, options.json)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
