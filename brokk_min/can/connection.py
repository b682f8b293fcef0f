"""The CAN bus through python-can, and its log; python-can is imported when a bus is opened."""

import os
import signal
import time
from collections import deque
from collections.abc import Callable, Container, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from brokk_min._files import brief, require_package
from brokk_min.can.canopen import OPERATOR_INPUT, WOULD_SEND, Frame


@dataclass
class Bus:
    """A CAN bus with a monotonic clock and a log of what is sent and read."""

    bus: Any  # of python-can
    name: str = "can"  # of the bus in the log
    log: Any = None  # path of a log in candump's format, or a file
    echo: bool = False  # does the bus give back what we send?
    clock: Callable[[], float] = time.monotonic  # s
    sleep: Callable[[float], object] = time.sleep
    allowed: Container[int] = range(0x800)  # identifiers of frames that it sends

    def __post_init__(self) -> None:
        can = require_package("can", "hw")
        self.start = time.time() - self.clock()  # the log has the time of day, but it may be set
        self.echoes: deque[tuple[int, bytes]] = deque(maxlen=64 if self.echo else 0)
        self.writer = can.CanutilsLogWriter(self.log or os.devnull)
        self.message = can.Message

    def now(self) -> float:
        """Time of day at the start plus monotonic time since [s], in whole microseconds."""
        return round(self.start + self.clock(), 6)

    def recv(self, timeout: float) -> Frame | None:
        """The next frame within `timeout` [s], or None."""
        end = self.clock() + timeout
        message = self.bus.recv(timeout)
        while message is None and (left := end - self.clock()) > 0:
            message = self.bus.recv(left)  # its timeout follows the time of day, which may be set
        if message is None:
            return None
        now, data = self.now(), bytes(message.data)
        if (message.arbitration_id, data) in self.echoes:
            self.echoes.remove((message.arbitration_id, data))
            return Frame(now, -1, data)
        self._log(message, now, self.name)
        other = message.is_remote_frame or message.is_error_frame or message.is_fd
        return Frame(now, -1 if other or message.is_extended_id else message.arbitration_id, data)

    def send(self, can_id: int, data: bytes) -> None:
        """Send one frame, once; never periodically, because the kernel would go on after a hang.

        A frame that is not `allowed` is in the log alone, with the identifier `WOULD_SEND`.
        """
        if can_id not in self.allowed:
            self._log(self._message(WOULD_SEND, data), self.now(), "shadow")
            return
        message = self._message(can_id, data)
        self.bus.send(message, timeout=0.01)
        self.echoes.append((can_id, data))
        self._log(message, self.now(), self.name)

    def log_input(self, data: bytes) -> None:
        """Log the operator's input, which is not on the bus."""
        self._log(self._message(OPERATOR_INPUT, data), self.now(), "operator")

    def flush(self) -> None:
        """Write the log on, so that it survives the program's sudden end. OSError: a full disk."""
        self.writer.file.flush()

    def _message(self, can_id: int, data: bytes) -> Any:
        return self.message(arbitration_id=can_id, data=data, is_extended_id=False, is_rx=False)

    def _log(self, message: Any, now: float, channel: str) -> None:
        message.timestamp, message.channel = now, channel
        self.writer.on_message_received(message)

    def close(self) -> None:
        """Close bus and log, the log even if the bus fails."""
        try:
            self.bus.shutdown()
        finally:
            self.writer.stop()


@contextmanager
def open_bus(interface: str, channel: str, log: Path | None = None) -> Iterator[Bus]:
    """A bus by python-can's names, closed at the end of the block; `log` grows while it runs.

    ValueError: python-can is not installed, finds no such bus, or fails in the block.
    """
    can = require_package("can", "hw")
    can.log.setLevel("ERROR")  # it also warns of a bus that it could not open
    where = f"{interface} {channel}: expected a CAN bus"
    try:
        raw = can.Bus(interface=interface, channel=channel)
    except Exception as error:  # each interface has its own
        raise ValueError(f"{where}, got {brief(error)}") from error
    try:
        with closing(Bus(raw, channel, log, echo=interface == "udp_multicast")) as bus:
            yield bus
    except can.CanError as error:
        raise ValueError(f"{where} that works, got {brief(error)}") from error


@contextmanager
def stop_signals() -> Iterator[list[int]]:
    """A list to which SIGINT, SIGTERM and SIGHUP are appended, instead of ending the program."""
    received: list[int] = []
    names = ("SIGINT", "SIGTERM", "SIGHUP")  # the last: a terminal was closed; not on Windows
    numbers = [number for number in signal.Signals if number.name in names]
    handlers = [signal.signal(n, lambda number, _: received.append(number)) for n in numbers]
    try:
        yield received
    finally:
        for number, handler in zip(numbers, handlers):
            signal.signal(number, handler)
