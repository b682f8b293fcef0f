"""A long drive at full speed in simulated time, or in real time on a virtual bus.

    python -m benchmarks.long_run [--hours 8]
    python -m benchmarks.long_run --hours 1 --real-time

A PI controller follows a goal that turns all the time. It prints each stop with its reason, how
often the operator had to press, and the memory of the process at the beginning and at the end.
"""

import threading
import time
from collections import Counter, deque

import numpy as np
import psutil
import tyro

import benchmarks  # noqa: F401, before NumPy computes: one thread
from benchmarks.one_process import BASELINE, World
from brokk_min.actuator import PLANT
from brokk_min.can.canopen import OperatorInput
from brokk_min.can.connection import open_bus
from brokk_min.can.simulated_machine import SimulatedMachine, serve, start_pose
from brokk_min.hw import Drive
from brokk_min.machine import BROKK_170

TURN = np.array([0.021, 0.034, 0.055])  # rad a tick, of the goal's x, y and z


class Restless:
    """An operator who presses when the machine is ready, again after each stop, and moves on."""

    def __init__(self):
        self.ticks, self.held = 0, False

    def __call__(self, driving, ready):
        self.ticks += 1
        self.held = driving or (ready and not self.held)
        x, y, z = (0.12 * np.sin(TURN * self.ticks) * driving).tolist()
        return OperatorInput((x, y, z), enable=self.held)


def memory():
    """Of this process [MB]."""
    return psutil.Process().memory_info().rss / 1e6


def drive_on(drive, ticks):
    """So many ticks; it prints stops with their time [h], reasons, and memory."""
    drive.begin()
    stops, open_valves, begin = Counter(), 0, 0.0
    for tick in range(ticks):
        drove = bool(drive.gate.driving)
        drive.tick()
        open_valves += bool(drive.gate.sent[:, -1].any())
        if tick == min(1000, ticks // 2):  # everything is imported and warm
            begin = memory()
        if drove and not drive.gate.driving:
            stops[drive.reason] += 1
            print(f"{drive.ticks / BROKK_170.rate / 3600:.4f} h: {drive.reason}", flush=True)
    print(f"{ticks} ticks, valves open in {open_valves / ticks:.0%}; {stops.total()} stops")
    print(f"memory: {begin:.1f} MB when warm, {memory():.1f} MB at the end")


def simulated(ticks):
    world = World(BASELINE, Restless())
    world.step = 0.005  # s, that of the plant
    world.simulated.plant, world.syncs = PLANT, deque(maxlen=1)  # nothing is recorded
    drive_on(world.drive, ticks)


def real(ticks):
    ended = []
    with open_bus("virtual", "long") as theirs, open_bus("virtual", "long") as ours:
        machine = SimulatedMachine(BROKK_170, start_pose(BROKK_170), theirs.now())
        thread = threading.Thread(target=serve, args=(machine, theirs, ended))
        thread.start()
        try:
            drive_on(Drive(BROKK_170, BASELINE, ours, Restless()), ticks)
        finally:
            ended.append(True)
            thread.join()


def main(hours: float = 8.0, real_time: bool = False) -> None:
    begun = time.monotonic()
    (real if real_time else simulated)(round(3600 * hours * BROKK_170.rate))
    print(f"{hours:g} h took {time.monotonic() - begun:.0f} s")


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
