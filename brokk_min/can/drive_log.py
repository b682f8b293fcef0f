"""The log of a drive: its frames, what they say of each tick, and recordings for `fit`.

Logs are those of candump, so those of other tools can be read, too.
"""

import re
from collections import deque
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from brokk_min._files import brief, expected
from brokk_min.actuator import estimate_velocity
from brokk_min.can import canopen
from brokk_min.can.canopen import OPERATOR_CHANNEL, Frame, Nodes, OperatorInput
from brokk_min.identification.logs import Log, machine_log
from brokk_min.machine import Array, Machine, require

# (time) bus identifier#data direction; T: the program sent it
LINE = re.compile(r"\((\d+\.\d+)\) (\S+) ([0-9A-Fa-f]+)#(\S*)(?: ([RT]))?\s*")
STANDARD = re.compile(r"[0-9A-Fa-f]{3}#([0-9A-Fa-f]{2}){0,8}")  # a data frame with 11 bits


def read_frames(path: Path) -> Iterator[Frame]:
    """The frames of a candump log, one by one, because a day of driving has millions.

    A last line without its newline is left out: the program that wrote it was killed.
    ValueError: no such log, a line that is no frame, or frames of two buses.
    """
    buses: set[str] = set()
    with expected(path, "a candump log"), open(path, encoding="ascii") as file:
        for row, line in enumerate(file, 1):
            if not line.endswith("\n"):
                return
            match = LINE.fullmatch(line)
            require(match is not None, f"row {row}", "(time) bus identifier#data", brief(line))
            time, bus, can_id, data, direction = match.groups()  # type: ignore[union-attr]
            buses |= {bus} - {OPERATOR_CHANNEL}
            require(len(buses) < 2, f"row {row}", "frames of one bus", sorted(buses))
            fits = STANDARD.fullmatch(f"{can_id}#{data}")
            number, content = (int(can_id, 16), bytes.fromhex(data)) if fits else (-1, b"")
            yield Frame(float(time), number, content, direction == "T", bus)


def operator_input_of(frame: Frame) -> OperatorInput | None:
    """The operator's input that a frame of a log holds; None: it is a frame of the bus."""
    if frame.id == canopen.OPERATOR_INPUT and frame.channel == OPERATOR_CHANNEL:
        return canopen.unpack_operator_input(frame.data)
    return None


class Telemetry(NamedTuple):
    """What a bus or a log shows of one tick."""

    time: float  # of its SYNC [s]
    q: Array  # rad (n,), nan: unknown
    q_dot: Array  # rad/s (n,)
    u: Array  # in [-1, 1] (n,)
    v_goal: Array  # m/s (3,)
    driving: bool


def read_telemetry(machine: Machine, frames: Iterable[Frame]) -> Iterator[Telemetry]:
    """Telemetry of the ticks of a log; each ends with the SYNC of the next."""
    nodes, valves, operator = Nodes(machine), canopen.ValveFrames(machine), OperatorInput()
    start = 0.0  # s, time of the last SYNC
    angles: deque[Array] = deque(maxlen=machine.velocity_samples)  # rad (n,)
    for frame in frames:
        nodes.update(frame)
        valves.update(frame)
        operator = operator_input_of(frame) or operator
        if frame.id != canopen.SYNC:
            continue
        q, q_dot = _motion(machine, nodes, angles)
        driving = bool(valves.enable.all())
        v_goal = np.array(operator.v_goal) * driving
        yield Telemetry(start, q, q_dot, valves.u.copy(), v_goal, driving)
        nodes.start_tick()
        valves.enable[:] = False  # no frame, no command
        start = frame.time


def _motion(machine: Machine, nodes: Nodes, angles: deque[Array]) -> tuple[Array, Array]:
    """Angles and velocities (n,) of this tick, nan if an angle is missing; `angles` grows."""
    if not (nodes.frames == 1).all():
        angles.clear()
        return np.full(machine.n, np.nan), np.full(machine.n, np.nan)
    q = nodes.counts() * machine.encoder_step
    angles.extend([q] * (1 if angles else machine.velocity_samples))
    window = np.stack(angles, axis=-1)
    return q, estimate_velocity(window, machine.velocity_samples, machine.dt)


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
