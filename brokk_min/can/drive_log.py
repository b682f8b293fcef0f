"""The log of a drive: its frames, what they say of each tick, and recordings for `fit`.

Logs are those of candump, so those of other tools can be read, too.
"""

import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from brokk_min._files import brief, expected
from brokk_min.can import canopen
from brokk_min.can.canopen import Frame, Nodes, OperatorInput
from brokk_min.identification.logs import Log, machine_log
from brokk_min.machine import Array, Machine, require

# (time) bus identifier#data direction, of a data frame with 11 bits; T: the program sent it
LINE = re.compile(r"\((\d+\.\d+)\) \S+ ([0-9A-Fa-f]{3})#((?:[0-9A-Fa-f]{2}){0,8})(?: ([RT]))?\n")


def read_frames(path: Path) -> Iterator[Frame]:
    """The frames of a candump log, one by one, because a day of driving has millions.

    Extended and remote frames are left out, and a last line without its newline: the program that
    wrote it was killed. ValueError: no such log, or a line without a time.
    """
    with expected(path, "a candump log"), open(path, encoding="ascii") as file:
        for row, line in enumerate(file, 1):
            require(line.startswith("("), f"row {row}", "(time) bus identifier#data", brief(line))
            if match := LINE.fullmatch(line):
                time, can_id, data, direction = match.groups()
                content = bytes.fromhex(data)
                yield Frame(float(time), int(can_id, 16), content, direction == "T")


class Telemetry(NamedTuple):
    """What a bus or a log shows of one tick."""

    time: float  # of its SYNC [s]
    q: Array  # rad (n,), nan: unknown
    u: Array  # in [-1, 1] (n,)
    v_goal: Array  # m/s (3,)
    driving: bool


def read_telemetry(machine: Machine, frames: Iterable[Frame]) -> Iterator[Telemetry]:
    """Telemetry of the ticks of a log; each ends with the SYNC of the next."""
    nodes, operator = Nodes(machine), OperatorInput()
    u, driving = np.zeros(machine.n), False
    start = 0.0  # s, time of the last SYNC
    for frame in frames:
        nodes.update(frame)
        if frame.id == canopen.OPERATOR_INPUT and frame.sent:
            operator = canopen.unpack_operator_input(frame.data)
        elif frame.id == machine.valve_frame_id and len(frame.data) == 8:
            u, driving = canopen.read_valve_frame(machine, frame.data)
        elif frame.id == canopen.SYNC:
            q = np.where((nodes.frames == 1).all(), nodes.counts() * machine.encoder_step, np.nan)
            yield Telemetry(start, q, u, np.array(operator.v_goal) * driving, driving)
            nodes.start_tick()
            driving = False  # until the next valve frame
            start = frame.time


def log_for_fit(machine: Machine, frames: Iterable[Frame]) -> Log:
    """Commands and angles while driving, as recordings for `fit`; a gap starts a new one.

    ValueError: nothing was driven for long enough.
    """
    recordings: list[list[Telemetry]] = [[]]
    for tick in read_telemetry(machine, frames):
        if not (tick.driving and np.isfinite(tick.q).all()):
            continue
        last = recordings[-1][-1].time if recordings[-1] else tick.time - machine.dt
        if not 0.5 < (tick.time - last) * machine.rate < 1.5:
            recordings.append([])
        recordings[-1].append(tick)
    longest, least = max(map(len, recordings)), machine.history + 2
    wanted = f"{least} ticks of driving in a row at {machine.rate:g} Hz (--machine)"
    require(longest >= least, "log", wanted, f"{longest} at most")
    named = [
        (f"drive_{k:03d}", np.array([t.u for t in ticks]), np.array([t.q for t in ticks]))
        for k, ticks in enumerate(recordings)
        if len(ticks) >= least
    ]
    return machine_log(machine, named)
