"""The log of a drive: its frames, the loop run on it again, recordings for `fit`, telemetry.

Telemetry is the state of one tick, from the frames of a bus or of a log.
"""

import struct
from collections import deque
from collections.abc import Iterable, Iterator
from io import StringIO
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

from brokk_min.can import canopen
from brokk_min.can.canopen import OPERATOR_CHANNEL, Frame, Nodes, OperatorInput
from brokk_min.can.connection import standard_id
from brokk_min.can.safety_gate import fault_name
from brokk_min.evaluation.rollout import Controller
from brokk_min.hw import Drive
from brokk_min.identification.files import brief, expected, open_regular, require
from brokk_min.identification.logs import Log, machine_log
from brokk_min.kinematics import estimate_velocity, forward_kinematics, tool_velocity
from brokk_min.machine import Array, Machine

LONGEST_LINE = 1000  # bytes
LARGEST_LOG = 2**40  # bytes: frames are read one by one


def read_frames(path: Path) -> Iterator[Frame]:
    """The frames of a candump log, one by one: a day of driving has millions.

    A last line without its newline is left out: the program that wrote it was killed.

    ValueError: no such log, a line that is no frame, or frames of two buses.
    """
    reader = require("can", "hw").CanutilsLogReader(StringIO())
    buses: dict[str, None] = {}
    row = [0]  # of the file, from 1
    with expected(path, "a candump log"), open_regular(path, LARGEST_LOG) as file:
        reader.file = _whole_lines(file, row)
        try:
            for m in reader:
                buses |= {str(m.channel): None} if m.channel != OPERATOR_CHANNEL else {}
                if len(buses) > 1:
                    raise ValueError(f"frames of {' and '.join(buses)}: keep those of one bus")
                yield _frame(m)
        except (ValueError, IndexError, struct.error) as error:
            raise ValueError(f"row {row[0]}: {error}") from error


def _whole_lines(file: IO[bytes], row: list[int]) -> Iterator[str]:
    for row[0], line in enumerate(iter(lambda: file.readline(LONGEST_LINE), b""), 1):
        if line.strip() and not line.startswith(b"("):
            raise ValueError(brief(line.decode(errors="replace").strip()))
        if line.endswith(b"\n"):
            yield line.decode()
        elif len(line) == LONGEST_LINE:
            raise ValueError(f"{LONGEST_LINE} bytes or more")


def _frame(m: Any) -> Frame:
    """The frame of a message of python-can."""
    frame = Frame(m.timestamp, standard_id(m), bytes(m.data), not m.is_rx, str(m.channel))
    if not 0 <= frame.time < 1e12:
        raise ValueError(f"a time of {frame.time}")
    operator_input_of(frame)  # refuses a damaged one
    return frame


def operator_input_of(frame: Frame) -> OperatorInput | None:
    """The operator's input that a frame of a log holds; None: it is a frame of the bus."""
    if frame.id == canopen.OPERATOR_INPUT and frame.channel == OPERATOR_CHANNEL:
        return canopen.unpack_operator_input(frame.data)
    return None


def with_operator(frames: Iterable[Frame]) -> Iterator[Frame]:
    """The frames of a log; ValueError, at its end: none of them is the operator's."""
    found = False
    for frame in frames:
        found |= operator_input_of(frame) is not None
        yield frame
    if not found:
        raise ValueError("log: expected the operator's frames, of `drive --log`, got none")


class ReplayedBus:
    """A recorded log in place of a `Bus`: gives what was read and notes what is sent."""

    def __init__(self, frames: Iterable[Frame]) -> None:
        self.frames = deque(frames)  # those that are to come
        self.sent: list[tuple[Frame, bytes]] = []  # frames of the log, with the data sent now
        self.mismatch = ""
        self.time = 0.0  # s

    def now(self) -> float:
        """Time of the next frame [s]."""
        if self.frames:
            self.time = self.frames[0].time
        return self.time

    def sleep(self, seconds: float) -> None:
        """A replay does not wait."""

    def flush(self) -> None:
        """Nothing is written."""

    def recv(self, timeout: float, busy_wait: float = 0.0) -> Frame | None:
        """The next frame that was read before anything was sent."""
        if not self.frames or self.frames[0].sent:
            return None
        return self.frames.popleft()

    def send(self, can_id: int, data: bytes) -> None:
        """Go past what was sent then."""
        if self.frames:
            frame = self.frames.popleft()
            self.sent.append((frame, data))
            if not frame.sent or frame.id != can_id:
                self.mismatch = f"{can_id:03X} sent at {frame.time:.6f}, got {frame.id:03X}"
                self.frames.clear()

    def log_input(self, data: bytes) -> float:
        """The time of the operator's input."""
        now = self.now()
        self.send(canopen.OPERATOR_INPUT, data)
        return now

    def operator(self, driving: bool, ready: bool) -> OperatorInput:
        """The operator's next input of the log."""
        inputs = (operator_input_of(frame) for frame in self.frames)
        return next(filter(None, inputs), OperatorInput(stop=True))


def replay(machine: Machine, controller: Controller, frames: Iterable[Frame]) -> tuple[int, int]:
    """Run the loop on a log of it: how many valve frames are the same bytes, and of how many.

    ValueError: another program made the log, or its bus failed.
    """
    bus = ReplayedBus(with_operator(frames))
    drive = Drive(machine, controller, bus, bus.operator)
    drive.begin()
    while bus.frames:
        drive.tick()
    if bus.mismatch:
        raise ValueError(f"log: expected {bus.mismatch}")
    valves = canopen.valve_frame_ids(machine)
    same = [frame.data == data for frame, data in bus.sent if frame.id in valves]
    return sum(same), len(same)


def log_for_fit(machine: Machine, frames: Iterable[Frame]) -> Log:
    """Commands and angles while driving, as recordings for `fit`; a gap starts a new one.

    ValueError: nothing was driven for long enough.
    """
    recordings: list[list[tuple[Array, Array]]] = []
    last = -np.inf
    ticks = 0
    for tick in read_telemetry(machine, frames):
        ticks += 1
        if tick.driving and np.isfinite(tick.q).all():
            if not 0.5 < (tick.time - last) * machine.rate < 1.5:
                recordings.append([])
            recordings[-1].append((tick.u, tick.q))
            last = tick.time
    named = []
    for number, recording in enumerate(recordings):
        commands, angles = map(np.array, zip(*recording))
        if len(commands) > machine.history + 1:
            named.append((f"drive_{number:03d}", commands, angles))
    if not named:
        wanted = f"expected more than {machine.history + 1} ticks of driving in a row"
        longest = max(map(len, recordings), default=0)
        got = f"{longest} at most, of {ticks} ticks at {machine.rate:g} Hz (--machine)"
        raise ValueError(f"log: {wanted}, got {got}")
    return machine_log(machine, named)


class Telemetry(NamedTuple):
    """State of the loop after one tick, or what a bus or a log shows of it."""

    tick: float
    q: Array  # rad (n,), nan: unknown
    q_dot: Array  # rad/s (n,)
    u: Array  # in [-1, 1] (n,)
    v_goal: Array  # m/s (3,)
    driving: bool
    active_fault: int = 0  # see `safety_gate.fault_name`
    latched_fault: int = 0
    mode: int = 0  # which controller
    lateness: float = 0.0  # s
    time: float = 0.0  # of its SYNC [s], from a bus or a log


class TelemetryReader:
    """Turns the frames of a bus or a log, one after another, into telemetry."""

    def __init__(self, machine: Machine) -> None:
        self.machine = machine
        self.nodes = Nodes(machine)
        self.operator_input = OperatorInput()
        self.valves = canopen.ValveFrames(machine)
        self.tick = 0
        self.start = 0.0  # s, time of the last SYNC
        self.angles: deque[Array] = deque(maxlen=machine.velocity_samples)  # rad (n,)

    def update(self, frame: Frame) -> Telemetry | None:
        """Take in one frame; at a SYNC, telemetry of the tick that it ends."""
        self.nodes.update(frame)
        self.valves.update(frame)
        self.operator_input = operator_input_of(frame) or self.operator_input
        if frame.id != canopen.SYNC:
            return None
        telemetry = self._telemetry()
        self.nodes.start_tick()
        self.valves.enable[:] = False  # no frame, no command
        self.tick += 1
        self.start = frame.time
        return telemetry

    def _telemetry(self) -> Telemetry:
        m = self.machine
        q = q_dot = np.full(m.n, np.nan)
        if (self.nodes.frames == 1).all():
            q = self.nodes.counts() * m.encoder_step
            if not self.angles:
                self.angles.extend([q] * m.velocity_samples)
            self.angles.append(q)
            q_dot = estimate_velocity(np.stack(self.angles, axis=-1), m.velocity_samples, m.dt)
        else:
            self.angles.clear()
        driving = bool(self.valves.enable.all())
        v_goal = np.array(self.operator_input.v_goal) * driving
        u = self.valves.u.copy()
        return Telemetry(self.tick, q, q_dot, u, v_goal, driving, time=self.start)


def read_telemetry(machine: Machine, frames: Iterable[Frame]) -> Iterator[Telemetry]:
    """Telemetry of the ticks of a log."""
    reader = TelemetryReader(machine)
    updates = (reader.update(frame) for frame in frames)
    return (telemetry for telemetry in updates if telemetry is not None)


def status(drive: Drive) -> str:
    """One line: state, faults, goal and measured tool velocity [m/s], angles [rad], lateness."""
    state = "waiting" if drive.gate.active_fault else "ready  "
    state = "driving" if drive.gate.driving else state
    reason = f" {drive.reason}" if drive.reason else ""
    active = fault_name(drive.machine, int(drive.gate.active_fault))
    reason += f", now {active}" if active not in drive.reason else ""  # what is in the way
    q, q_dot = drive.measured
    v = tool_velocity(forward_kinematics(drive.machine, q), q_dot)
    vectors = (drive.operator_input.v_goal, v, q)
    goal, measured, pose = (" ".join(f"{x:+.2f}" for x in vector) for vector in vectors)
    late = f"late {1e3 * drive.lateness:.1f} ms, skipped {drive.skipped}"
    return f"{state}{reason} v goal {goal} measured {measured} q {pose} {late}"
