"""The log of a drive: its frames, what they say of each tick, and recordings for `fit`."""

import os
import re
import struct
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import numpy as np
from tqdm import tqdm

from brokk_min._files import brief, expected, require_package
from brokk_min.can import canopen
from brokk_min.can.canopen import Frame, Nodes
from brokk_min.can.connection import plain_frame
from brokk_min.fit import Log, machine_log
from brokk_min.identification.readings import FASTER, NOISE, rows_per_value
from brokk_min.machine import Array, Machine, require

# (time) bus identifier#data direction, of a data frame with 11 bits; T: the program sent it. On a
# terminal candump prints (time)  bus  identifier   [length]  data; with -x RX - - before the
# identifier, with -a the letters of the data after it, with -8 two digits of the length.
LINE = re.compile(
    r" ?\((\d+\.\d+)\) +(\S+) +(?:[RT]X \S+ \S+ +)?([0-9A-Fa-f]{3})(?:#| +\[0?(\d)\] *)"
    r"((?:[0-9A-Fa-f]{2} ?){0,8})(?: *'.*')?(?: ([RT]))?\n"
)
# Other frames: with 29 bits, of an error, remote, or of more than eight bytes.
OTHER = re.compile(
    r" ?\(\d+\.\d+\) +\S+ +(?:[RT]X \S+ \S+ +)?"
    r"(?:[0-9A-Fa-f]{8}[# ]|[0-9A-Fa-f]{3}(?:#R|##|#\w{16}_| +\[(?:\d{2}|9)\]| +\[0\] +remote)).*\n"
)
NOTES = ("operator", "timing", "valves", "shadow")  # no buses: what `drive` notes beside the frames
LOST = 1.0  # s, assumed: a shorter gap in a drive is no pause of the operator
OTHER_RATE = 0.03  # of the rate: no clock is so far off
FALLS = 0.01  # of the rows: time falls once if a clock was set, in differences each tick
OTHERS = (".asc", ".blf", ".trc", ".gz")  # that python-can reads


def read_frames(path: Path) -> Iterator[Frame]:
    """The data frames of a log with 11 bits, one by one, because a day of driving has millions.

    Other frames are left out, and a last line without its newline: the program that wrote it was
    killed. ValueError: no such log, frames of two buses, times that fall, or a line that is none of
    candump's.
    """
    buses: dict[Any, None] = {}
    if Path(path).suffix.lower() in OTHERS:
        reader = require_package("can", "hw").LogReader
        with expected(path, "a log that python-can reads"), reader(path) as messages:
            for message in messages:
                one_bus(buses, message.channel)
                if (frame := plain_frame(message)).id >= 0:
                    yield frame
        return
    strange, before, falls = "", 0.0, 0
    with expected(path, "a candump log"), open(path, encoding="utf-8-sig") as file:
        for row, line in enumerate(with_bar(file), 1):
            wanted = "(time) bus identifier#data, as candump -l writes"
            wanted += " (tables have names in .csv or .npz)" if row == 1 else ""
            if match := LINE.fullmatch(line):
                time, bus, can_id, length, digits, direction = match.groups()
                data = bytes.fromhex(digits)
                require(int(length or len(data)) == len(data), f"row {row}", wanted, brief(line))
                one_bus(buses, bus)
                falls, before = falls + (float(time) < before - 1e-3), float(time)
                wanted = "times that rise (candump -ta, or -l; with -td they are differences)"
                require(falls <= FALLS * max(row, 300), f"row {row}", wanted, brief(line))
                yield Frame(float(time), int(can_id, 16), data, direction == "T")
            elif line.endswith("\n"):
                require(bool(OTHER.fullmatch(line)), f"row {row}", wanted, brief(line))
                strange = strange or f"row {row}: {brief(line)}"
        require(bool(buses) or not strange, str(path), "data frames of 11 bits", strange)


def with_bar(file: TextIO) -> Iterator[str]:
    """The lines of a file; a bar shows how far it is read."""
    size, title = os.fstat(file.fileno()).st_size, f"read {Path(file.name).name}"
    with tqdm(total=size, desc=title, leave=False, disable=None, unit="B", unit_scale=True) as bar:
        for line in file:
            bar.update(len(line))
            yield line


def one_bus(buses: dict[Any, None], bus: Any) -> None:
    """Note the bus of a frame; ValueError: frames of another one came before."""
    if bus not in NOTES:
        buses[bus] = None
    wanted, got = "frames of one bus (grep those of one)", " and ".join(map(str, buses))
    require(len(buses) < 2, "log", wanted, got)


class Telemetry(NamedTuple):
    """What a bus or a log shows of one tick."""

    time: float  # of its SYNC [s]
    q: Array  # rad (n,)
    u: Array  # in [-1, 1] (n,)
    v_goal: Array  # m/s (3,)
    driving: bool


def read_telemetry(machine: Machine, frames: Iterable[Frame]) -> Iterator[Telemetry]:
    """Telemetry of the ticks of a log with all angles; each ends with the SYNC of the next."""
    nodes, v_goal = Nodes(machine), np.zeros(3)
    start = 0.0  # s, time of the last SYNC
    for frame in frames:
        nodes.update(frame)
        if frame.id == canopen.OPERATOR_INPUT and frame.sent and len(frame.data) == 7:
            v_goal = np.array(struct.unpack_from("<hhh", frame.data)) / 1e4
        elif frame.id == canopen.SYNC:
            if (nodes.frames == 1).all():
                q = canopen.encoder_counts(machine, nodes.raw) * machine.encoder_step
                yield Telemetry(start, q, nodes.u, v_goal * nodes.enable, nodes.enable)
            nodes.start_tick()
            nodes.enable = False  # until the next valve frame
            start = frame.time


def timing(machine: Machine, frames: Iterable[Frame]) -> list[str]:
    """A line on how late the ticks of a drive were; none if the log does not say it."""
    own = (frame for frame in frames if frame.id == canopen.LATENESS and frame.sent)
    late = np.array([int.from_bytes(frame.data, "little", signed=True) for frame in own]) / 1e6
    if not len(late):
        return []
    median, nearly_all, most = 1e3 * np.quantile(late, (0.5, 0.99, 1.0))
    missed = int(np.maximum(late // machine.dt, 0).sum())  # as `Drive.wait` counts them
    words = f"{median:.2f} ms in the median, {nearly_all:.2f} ms in 99 %, {most:.2f} ms at most"
    return [f"ticks late by {words}; {missed} of {len(late) + missed} missed"]


def identifiers(of: Iterable[int]) -> str:
    """Identifiers as candump prints them."""
    return " ".join(f"{one:03X}" for one in sorted(of))


def log_for_fit(machine: Machine, frames: Iterable[Frame]) -> Log:
    """Commands and angles while driving, as recordings for `fit`; a gap or jump starts a new one.

    ValueError: some of the machine's frames never come, or too little was driven in a row.
    """
    missing = {canopen.SYNC, machine.valve_frame_id, *Nodes(machine).position_index}
    wanted = f"SYNC, positions and valve frames, {identifiers(missing)} (--machine)"
    syncs = 0

    def noted() -> Iterator[Frame]:
        nonlocal syncs
        for frame in frames:
            missing.discard(frame.id)
            syncs += frame.id == canopen.SYNC
            yield frame

    whole = [*read_telemetry(machine, noted())]
    ticks = [tick for tick in whole if tick.driving]
    require(not missing, "log", wanted, f"none with {identifiers(missing)}")
    time = np.array([tick.time for tick in ticks])
    u = np.reshape([tick.u for tick in ticks], (-1, machine.n))
    q = np.reshape([tick.q for tick in ticks], (-1, machine.n))
    reach = FASTER * machine.q_dot_max * machine.dt + NOISE  # of an angle in a tick
    late = np.diff(time) * machine.rate  # ticks
    gap = np.abs(late - 1) >= 0.5
    jump = (np.abs(np.diff(q, axis=0)) > reach).any(axis=1)
    pieces = np.split(np.arange(len(ticks)), np.flatnonzero(gap | jump) + 1)
    usual = machine.rate / float(np.median(late)) if len(late) else machine.rate
    fits = abs(usual / machine.rate - 1) < OTHER_RATE
    require(fits, "log", f"{machine.rate:g} Hz (--machine)", f"SYNC at {usual:.3g} Hz")
    rows = [rows_per_value(angle) for angle in q.T]
    slow = [f"q_{name} {n:g}" for name, n in zip(machine.names, rows, strict=True) if n > 1]
    require(not slow, "log", "a new angle in each tick", f"one in so many of {', '.join(slow)}")
    longest, least = max(map(len, pieces)), machine.history + 2
    wanted = f"{least} ticks of driving in a row at {machine.rate:g} Hz (--machine)"
    got = f"{longest} at most ({syncs} SYNCs; after {len(whole)} of them one position of each joint"
    got = f"{got}, in {len(ticks)} of these an enabled valve frame)"
    require(longest >= least, "log", wanted, got)
    long = [rows for rows in pieces if len(rows) >= least]
    log = machine_log(machine, [(f"drive_{k:03d}", u[i], q[i]) for k, i in enumerate(long)])
    lost = time[:-1][gap & (late < LOST * machine.rate)]
    told = []
    if len(lost):
        got = f"{len(lost)} gaps, the first after {min(lost):.2f} s: are frames lost?"
        told += [f"log: expected positions and a valve frame in each tick of a drive, got {got}"]
    leaps = time[1:][jump & ~gap]
    if len(leaps):
        got = f"{len(leaps)} jumps, the first at {leaps[0]:.2f} s"
        told += [f"log: expected angles that no joint is too slow for, got {got}"]
    return log._replace(warnings=tuple(told))
