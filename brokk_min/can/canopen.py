"""Frames on a CAN bus: python-can with a clock of its own and a black box, and CANopen's encoders.

Importing this module opens nothing and does not import python-can.
"""

import select
import signal
import struct
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from brokk_min.identification.extras import need
from brokk_min.identification.files import expected
from brokk_min.machine import Machine

# CANopen (CiA 301): identifiers are these plus the node's number
NMT, SYNC, TPDO1, SDO_ANSWER, SDO_REQUEST, HEARTBEAT = 0x000, 0x080, 0x180, 0x580, 0x600, 0x700
# objects: index, subindex
BEAT_OBJECT, SYNC_OBJECT, RESOLUTION_OBJECT = (0x1017, 0), (0x1800, 2), (0x6501, 0)
OPERATOR, WISH = (
    "operator",
    0x7FF,
)  # channel and identifier of the operator's wishes in a log, not on the bus
BEAT = 0.050  # s, heartbeat period that encoders are asked for (assumed)
SDO_TIMEOUT = 0.5  # s (assumed)


class Frame(NamedTuple):
    """One frame; `id` is -1 for what cannot be ours: remote, extended, FD, error, or an echo."""

    time: float  # s
    id: int
    data: bytes
    sent: bool = False
    channel: str = ""


class Line:
    """A CAN bus with a monotonic clock and a black box that logs what is sent and read.

    Args:
        bus: of python-can, without filters.
        log: python-can's candump writer; None: no log.
        name: of the bus in the log.
        echo: does the bus give back what we send?
        clock: monotonic [s].
        rest: sleeps for some seconds.
    """

    def __init__(
        self,
        bus: Any,
        log: Any = None,
        name: str = "can",
        echo: bool = False,
        clock: Callable[[], float] = time.monotonic,
        rest: Callable[[float], object] = time.sleep,
    ) -> None:
        self.bus, self.log, self.name, self.clock, self.rest = bus, log, name, clock, rest
        self.message = need("can", "hw").Message
        self.kept: deque[Any] = deque()  # messages on their way into the log
        self.start = time.time() - clock()  # candump logs carry the time of day, but it may be set
        self.echo: deque[tuple[int, bytes]] | None = deque(maxlen=64) if echo else None
        try:
            self.file = bus.fileno()
        except NotImplementedError:
            self.file = -1

    def now(self) -> float:
        """Time of day at the start plus monotonic time since [s], in whole microseconds as the log has it."""
        return round(self.start + self.clock(), 6)

    def recv(self, timeout: float, awake: float = 0.0) -> Frame | None:
        """The next frame, or None if none comes within `timeout` [s]; sleeps only after `awake` of it."""
        if self.file >= 0 and timeout > 0:  # python-can's own timeout follows the time of day
            start = self.clock()
            while (
                not select.select([self.file], [], [], 0)[0]
                and (gone := self.clock() - start) < timeout
            ):
                if gone >= awake:
                    select.select([self.file], [], [], timeout - gone)
            timeout = 0.0
        message = self.bus.recv(timeout)
        if message is None:
            return None
        now, data = self.now(), bytes(message.data)
        if self.echo is not None and (message.arbitration_id, data) in self.echo:
            self.echo.remove((message.arbitration_id, data))
            return Frame(now, -1, data)
        self._keep(message, now, self.name)
        return Frame(now, _plain_id(message), data)

    def send(self, can_id: int, data: bytes) -> None:
        """Send one frame, once; never periodically: the kernel would go on after a hang."""
        message = self._message(can_id, data)
        self.bus.send(message, timeout=0.01)
        if self.echo is not None:
            self.echo.append((can_id, data))
        self._keep(message, self.now(), self.name)

    def note(self, data: bytes) -> float:
        """Log what is not on the bus, the operator's wish, on a channel of its own; when that was [s]."""
        now = self.now()
        self._keep(self._message(WISH, data), now, OPERATOR)
        return now

    def flush(self) -> None:
        """Write the log on, so that it survives the program's sudden end."""
        while self.kept:
            self.log.on_message_received(self.kept.popleft())
        if self.log is not None:
            self.log.file.flush()

    def _message(self, can_id: int, data: bytes) -> Any:
        return self.message(arbitration_id=can_id, data=data, is_extended_id=False, is_rx=False)

    def _keep(self, message: Any, now: float, channel: str) -> None:
        """For `flush`, which waits until there is time."""
        if self.log is not None:
            message.timestamp, message.channel = now, channel
            self.kept.append(message)

    def close(self) -> None:
        """Close bus and log."""
        self.bus.shutdown()
        if self.log is not None:
            self.flush()
            self.log.stop()


def _plain_id(message: Any) -> int:
    flags = message.is_extended_id, message.is_remote_frame, message.is_error_frame, message.is_fd
    return -1 if any(flags) else int(message.arbitration_id)


@contextmanager
def open_line(interface: str, channel: str, log: Path | None = None) -> Iterator[Line]:
    """A bus by python-can's names, closed at the end of the block; `log` grows while it runs.

    ValueError: python-can is not there, finds no such bus, or fails in the block.
    """
    can = need("can", "hw")
    try:
        bus = can.Bus(interface=interface, channel=channel)
    except Exception as error:  # each interface has its own
        raise ValueError(f"{interface} {channel}: expected a CAN bus, got {error!r}") from error
    name = channel if interface == "socketcan" else interface
    line = Line(
        bus, can.CanutilsLogWriter(log) if log else None, name, echo=interface == "udp_multicast"
    )
    try:
        yield line
    except can.CanError as error:
        raise ValueError(
            f"{interface} {channel}: expected a CAN bus that works, got {error!r}"
        ) from error
    finally:
        line.close()


@contextmanager
def stop_signals() -> Iterator[list[int]]:
    """A list to which SIGINT and SIGTERM add themselves instead of ending the program."""
    seen: list[int] = []
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, lambda number, _: seen.append(number)) for number in numbers]
    try:
        yield seen
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


def read_frames(path: Path) -> Iterator[Frame]:
    """The frames of a candump log, one by one: a day of driving has millions.

    A last line without its newline is left out: the program that wrote it was killed.

    ValueError: no such log, or a line that is no frame.
    """
    reader = need("can", "hw").CanutilsLogReader
    with (
        expected(path, "a candump log"),
        open(path, encoding="utf-8") as file,
        reader(file) as frames,
    ):
        frames.file = (line for line in file if line.endswith("\n"))
        for m in frames:
            yield Frame(m.timestamp, _plain_id(m), bytes(m.data), not m.is_rx, str(m.channel))


class Nodes:
    """What encoders and valve controller said last; the fields are those of `GateInputs`."""

    def __init__(self, machine: Machine) -> None:
        nodes = [*(joint.encoder_node for joint in machine.joints), machine.controller_node]
        self.encoders = {TPDO1 + node: i for i, node in enumerate(nodes[:-1])}
        self.hearts = {HEARTBEAT + node: i for i, node in enumerate(nodes)}
        self.raw, self.frames = np.zeros(machine.n, int), np.zeros(machine.n, int)
        self.beat, self.nmt = np.full(machine.n + 1, -np.inf), np.zeros(machine.n + 1, int)

    def hear(self, frame: Frame) -> None:
        """Take in one frame; foreign ones change nothing."""
        size = len(frame.data)
        if (i := self.encoders.get(frame.id)) is not None:
            self.frames[i] += 1 if size == 4 else 2
            if size == 4:
                (self.raw[i],) = struct.unpack("<I", frame.data)
        elif (i := self.hearts.get(frame.id)) is not None and size == 1:
            self.beat[i], self.nmt[i] = frame.time, frame.data[0] & 0x7F


def sdo(
    line: Any, node: int, address: tuple[int, int], value: int | None = None, size: int = 4
) -> int:
    """Read an object of a node by its index and subindex, or write `value` of `size` bytes to it.

    ValueError: the node refuses or does not answer.
    """
    index, sub = address
    request = struct.pack("<BHBI", 0x40, index, sub, 0)
    if value is not None:
        request = struct.pack("<BHBI", 0x23 | (4 - size) << 2, index, sub, value)
    where = f"node {node}: object 0x{index:04X}:{sub:02X}"
    line.send(SDO_REQUEST + node, request)
    end = line.now() + SDO_TIMEOUT
    while line.now() < end and (frame := line.recv(max(0.0, end - line.now()))):
        if (
            frame.id == SDO_ANSWER + node
            and len(frame.data) == 8
            and frame.data[1:4] == request[1:4]
        ):
            (answer,) = struct.unpack("<I", frame.data[4:])
            if frame.data[0] == 0x80:
                raise ValueError(f"{where}: expected an answer, got SDO abort 0x{answer:08X}")
            return int(answer & (1 << 8 * (4 - (frame.data[0] >> 2 & 3))) - 1)
    raise ValueError(f"{where}: expected an answer within {SDO_TIMEOUT} s, got none")
