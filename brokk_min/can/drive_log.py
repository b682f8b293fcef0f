"""What a drive left in its log: the loop run on it again, byte by byte, and recordings for `fit`."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from brokk_min.can import canopen as bus
from brokk_min.can.operator_input import Wish, unpack_wish
from brokk_min.can.safety_gate import encoder_counts
from brokk_min.evaluation.rollout import Controller
from brokk_min.hw import Drive
from brokk_min.identification.logs import Log, machine_log
from brokk_min.machine import Machine, decode_pwm


class Tape:
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
        self._step(bus.WISH)
        return now

    def wish(self, driving: bool, ready: bool) -> Wish:
        """What the operator wished then."""
        ahead = (self.frames[i] for i in range(self.at, len(self.frames)))
        return next(
            (unpack_wish(frame.data) for frame in ahead if frame.id == bus.WISH), Wish(stop=True)
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
    tape = Tape(list(frames))
    drive = Drive(machine, controller, tape, tape.wish)
    drive.begin()
    while tape.more:
        drive.tick()
    if tape.wrong:
        raise ValueError(tape.wrong)
    return tape.sent[: sum(f.sent and f.channel != bus.OPERATOR for f in frames)]


def compare(
    machine: Machine, frames: Sequence[bus.Frame], sent: Sequence[bus.Frame]
) -> tuple[int, int]:
    """How many valve frames of `sent` are those of the log, byte by byte, and how many the log has."""
    valves = machine.valve_frame_id
    old, new = ([f.data for f in side if f.sent and f.id == valves] for side in (frames, sent))
    return sum(a == b for a, b in zip(old, new)), max(len(old), len(new))


def driven_log(machine: Machine, frames: Iterable[bus.Frame]) -> Log:
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
            nodes.hear(frame)
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
