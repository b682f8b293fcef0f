"""What a drive left in its log: the loop run on it again, byte by byte, and recordings for `fit`."""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from brokk_min.can import canopen as bus
from brokk_min.can.canopen import (
    OPERATOR_CHANNEL,
    OPERATOR_INPUT,
    SYNC,
    Frame,
    Nodes,
    OperatorInput,
    encoder_counts,
    unpack_operator_input,
)
from brokk_min.evaluation.rollout import Controller
from brokk_min.hw import Drive
from brokk_min.identification.logs import Log, machine_log
from brokk_min.machine import Array, Machine, decode_pwm, estimate_velocity


class ReplayedBus:
    """A recorded log in place of a `Line`: gives back what was read and compares what is sent."""

    def __init__(self, frames: Sequence[bus.Frame]) -> None:
        self.frames, self.at, self.sent, self.wrong = frames, 0, list[bus.Frame](), ""

    @property
    def more(self) -> bool:
        """Is there anything left?"""
        return self.at < len(self.frames)

    def now(self) -> float:
        """When the next thing happened [s]."""
        return self.frames[min(self.at, len(self.frames) - 1)].time

    def rest(self, seconds: float) -> None:
        """A tape does not wait."""

    def flush(self) -> None:
        """Nor does it write."""

    def recv(self, timeout: float, awake: float = 0.0) -> bus.Frame | None:
        """The next frame that was read before anything was sent."""
        if not self.more or self.frames[self.at].sent:
            return None
        self.at += 1
        return self.frames[self.at - 1]

    def send(self, can_id: int, data: bytes) -> None:
        """Keep what is sent, and step over what was sent then."""
        self.sent.append(bus.Frame(self.now(), can_id, data, True))
        self._step(can_id)

    def note(self, data: bytes) -> float:
        """The time of the wish."""
        now = self.now()
        self._step(bus.OPERATOR_INPUT)
        return now

    def wish(self, driving: bool, ready: bool) -> OperatorInput:
        """What the operator wished then."""
        ahead = (self.frames[i] for i in range(self.at, len(self.frames)))
        return next(
            (
                unpack_operator_input(frame.data)
                for frame in ahead
                if frame.id == bus.OPERATOR_INPUT
            ),
            OperatorInput(stop=True),
        )

    def _step(self, can_id: int) -> None:
        if self.more and (not (at := self.frames[self.at]).sent or at.id != can_id):
            self.wrong = f"log: expected {can_id:03X} sent at {at.time:.6f}, got {at.id:03X}"
            self.at = len(self.frames)
        self.at += 1


def replay(
    machine: Machine, controller: Controller, frames: Sequence[bus.Frame]
) -> list[bus.Frame]:
    """Run the loop on a recorded log of it; what it sends now, to be compared with what it sent then.

    ValueError: another program made the log.
    """
    tape = ReplayedBus(list(frames))
    drive = Drive(machine, controller, tape, tape.wish)
    drive.begin()
    while tape.more:
        drive.tick()
    if tape.wrong:
        raise ValueError(tape.wrong)
    return tape.sent[: sum(f.sent and f.channel != bus.OPERATOR_CHANNEL for f in frames)]


def compare(
    machine: Machine, frames: Sequence[bus.Frame], sent: Sequence[bus.Frame]
) -> tuple[int, int]:
    """How many valve frames of `sent` are those of the log, byte by byte, and how many the log has."""
    valves = machine.valve_frame_id
    old, new = ([f.data for f in side if f.sent and f.id == valves] for side in (frames, sent))
    return sum(a == b for a, b in zip(old, new)), max(len(old), len(new))


def log_for_fit(machine: Machine, frames: Iterable[bus.Frame]) -> Log:
    """What encoders said and valves got while driving, as recordings for `fit`; a gap starts a new one.

    ValueError: nothing was driven for long enough.
    """
    nodes, parts, start, last = bus.Nodes(machine), list[list[Any]](), 0.0, -np.inf
    for frame in frames:
        if frame.id == bus.SYNC:
            nodes.frames[:], start = 0, frame.time
        elif frame.id == machine.valve_frame_id and len(frame.data) == 8:
            if frame.data[7] == 1 and (nodes.frames == 1).all():
                if not 0.5 < (start - last) * machine.rate < 1.5:
                    parts.append([])
                u = decode_pwm(list(frame.data[: machine.n]))
                parts[-1].append((u, encoder_counts(machine, nodes.raw) * machine.encoder_step))
                last = start
        else:
            nodes.update(frame)
    tapes = []
    for number, part in enumerate(parts):
        if len(part) > machine.history + 1:
            u, q = map(np.array, zip(*part, strict=True))
            tapes.append((f"drive_{number:03d}", u, q))
    if not tapes:
        raise ValueError(
            f"log: expected more than {machine.history + 1} ticks of driving in a row, got none"
        )
    return machine_log(machine, tapes)


class Telemetry(NamedTuple):
    """What the loop, a bus or a log tells of one tick."""

    tick: float
    q: Array  # rad (n,), nan: unknown
    q_dot: Array  # rad/s (n,)
    u: Array  # in [-1, 1] (n,)
    v_goal: Array  # m/s (3,)
    driving: bool
    active_fault: int = 0  # of `fault_name`
    latched_fault: int = 0
    mode: int = 0
    lateness: float = 0.0  # s

    def pack(self) -> Array:
        """As numbers in a row."""
        return np.hstack([np.ravel(value) for value in self]).astype(float)


def unpack_telemetry(machine: Machine, values: Array) -> Telemetry:
    """What `Telemetry.pack` packed."""
    n = machine.n
    tick, q, q_dot, u, v, rest = np.split(values, np.cumsum([1, n, n, n, 3]))
    driving, wrong, fault, mode = (int(x) for x in rest[:4])
    return Telemetry(
        float(tick[0]), q, q_dot, u, v, bool(driving), wrong, fault, mode, float(rest[4])
    )


class TelemetryReader:
    """Frames of a bus or a log, one after another, as what is known at each tick."""

    def __init__(self, machine: Machine) -> None:
        self.machine, self.nodes, self.operator_input = machine, Nodes(machine), OperatorInput()
        self.u, self.driving, self.tick = np.zeros(machine.n), False, 0
        self.angles: list[Array] = []  # rad, as many as the velocity needs

    def update(self, frame: Frame) -> Telemetry | None:
        """Take in one frame; at a SYNC, what is known of the tick that it ends."""
        if frame.id == SYNC:
            known, self.nodes.frames[:] = self._known(), 0
            self.tick += 1
            return known
        if frame.id == OPERATOR_INPUT and frame.channel == OPERATOR_CHANNEL:
            self.operator_input = unpack_operator_input(frame.data)
        elif frame.id == self.machine.valve_frame_id and len(frame.data) == 8:
            self.u, self.driving = (
                decode_pwm(list(frame.data[: self.machine.n])),
                frame.data[7] == 1,
            )
        else:
            self.nodes.update(frame)
        return None

    def _known(self) -> Telemetry:
        m, v_goal = self.machine, np.array(self.operator_input.v_goal) * self.driving
        if (self.nodes.frames != 1).any():
            self.angles, nan = [], np.full(m.n, np.nan)
            return Telemetry(self.tick, nan, nan, self.u, v_goal, self.driving)
        q = encoder_counts(m, self.nodes.raw) * m.encoder_step
        self.angles = [*(self.angles or [q] * m.velocity_samples), q][-m.velocity_samples :]
        q_dot = estimate_velocity(np.stack(self.angles, axis=-1), m.velocity_samples, m.dt)
        return Telemetry(self.tick, q, np.asarray(q_dot), self.u, v_goal, self.driving)
