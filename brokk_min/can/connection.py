"""The CAN bus through python-can, and its log; python-can is imported when a bus is opened."""

import os
import select
import signal
import struct
import time
from collections import deque
from collections.abc import Callable, Container, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from brokk_min._files import brief, named, require_package
from brokk_min.can.canopen import LATENESS, OPERATOR_INPUT, VALVES, WOULD_SEND, Frame, OperatorInput


@dataclass
class Bus:
    """A CAN bus with a monotonic clock and a log of what is sent and read."""

    bus: Any  # of python-can
    name: str = "can"  # of the bus in the log
    log: Any = None  # path of a log in candump's format, or a file
    echo: bool = False  # does the bus give back what we send?
    file: int = -1  # descriptor to wait on; -1: `bus` waits itself
    clock: Callable[[], float] = time.monotonic  # s
    sleep: Callable[[float], object] = time.sleep
    heard: bool = False  # has anybody else sent a frame?
    allowed: Container[int] = range(0x800)  # identifiers of frames that it sends

    def __post_init__(self) -> None:
        self.can = require_package("can", "hw")
        self.start = time.time() - self.clock()  # the log has the time of day, but it may be set
        self.echoes: deque[tuple[int, bytes]] = deque(maxlen=64 if self.echo else 0)
        self.writer = self.can.CanutilsLogWriter(self.log or os.devnull)

    def now(self) -> float:
        """Time of day at the start plus monotonic time since [s], in whole microseconds."""
        return round(self.start + self.clock(), 6)

    def recv(self, timeout: float) -> Frame | None:
        """The next frame within `timeout` [s], or None."""
        end = self.clock() + timeout
        message = self.bus.recv(timeout if self.file < 0 else 0.0)
        # python-can's own timeout follows the time of day, so we wait for the descriptor
        while message is None and self.file >= 0 and (left := end - self.clock()) > 0:
            if select.select([self.file], [], [], left)[0]:
                message = self.bus.recv(0.0)
        if message is None:
            return None
        message.timestamp = self.now()
        frame = plain_frame(message)
        if (frame.id, frame.data) in self.echoes:
            self.echoes.remove((frame.id, frame.data))
            return frame._replace(id=-1)
        self._log(message, self.name)
        self.heard = True
        return frame

    def send(self, can_id: int, data: bytes) -> None:
        """Send one frame, once; never periodically, because the kernel would go on after a hang.

        A frame that is not `allowed` is in the log alone, with the identifier `WOULD_SEND`.
        """
        if can_id not in self.allowed:
            self._log(self._message(WOULD_SEND, data), "shadow")
            return
        message = self._message(can_id, data)
        self.bus.send(message, timeout=0.01)
        self.echoes.append((can_id, data))
        self._log(message, self.name)

    def log_tick(self, entered: OperatorInput, lateness: float) -> None:
        """Log what a tick has beside the bus: the operator's input, and how late it was [s]."""
        self._log(self._message(OPERATOR_INPUT, entered.pack()), "operator")
        self._log(self._message(LATENESS, struct.pack("<q", round(1e6 * lateness))), "timing")

    def log_valves(self, joint: int, data: bytes) -> None:
        """Log what is known of the valves of a joint, which is not on the bus."""
        self._log(self._message(VALVES + joint, data), "valves")

    def flush(self) -> None:
        """Write the log on, so that it survives the program's sudden end. OSError: a full disk."""
        with named(self.log):
            self.writer.file.flush()

    def _message(self, can_id: int, data: bytes) -> Any:
        message = self.can.Message(arbitration_id=can_id, data=data, is_extended_id=False)
        message.is_rx, message.timestamp = False, self.now()
        return message

    def _log(self, message: Any, channel: str) -> None:
        message.channel = channel  # only now, because some interfaces have channels of their own
        self.writer(message)

    def close(self) -> None:
        """Close bus and log, the log even if the bus fails."""
        try:
            self.bus.shutdown()
        finally:
            with named(self.log):
                self.writer.stop()


def plain_frame(message: Any) -> Frame:
    """A message of python-can as a frame; -1 for what is no data frame of 11 bits."""
    other = message.is_remote_frame or message.is_error_frame or message.is_fd
    can_id = -1 if other or message.is_extended_id else message.arbitration_id
    return Frame(message.timestamp, can_id, bytes(message.data), not message.is_rx)


@contextmanager
def open_bus(interface: str, channel: str, log: Path | None = None) -> Iterator[Bus]:
    """A bus by python-can's names, until the end of the block; ValueError: no bus, or it fails.

    A new log replaces an older file if anybody else was heard; if not, the older one comes back.
    """
    can = require_package("can", "hw")
    can.log.setLevel("ERROR")  # it also warns of a bus that it could not open
    where = f"{interface} {channel}: expected a CAN bus"
    try:
        raw = can.Bus(interface=interface, channel=channel)
    except Exception as error:  # each interface has its own
        raise ValueError(f"{where}, got {brief(error)}") from error
    log = Path(log).resolve() if log else None  # not a link to it
    older = log.with_name(f".{log.name}.{os.getpid()}") if log and log.is_file() else None
    try:
        if log and older:
            os.replace(log, older)
        bus = Bus(raw, channel, log, echo=interface == "udp_multicast")
    except OSError:  # the log cannot be written
        raw.shutdown()
        if log and older and older.exists():
            os.replace(older, log)
        raise
    with suppress(NotImplementedError):  # python-can's word for a bus without a descriptor
        bus.file = raw.fileno()
    try:
        with closing(bus):
            yield bus
    except BaseException as error:
        if isinstance(error, can.CanError):
            raise ValueError(f"{where} that works, got {brief(error)}") from error
        if log and not bus.heard:  # a log of our own frames alone would only be in the way
            log.unlink(missing_ok=True)
        raise
    finally:
        if older and bus.heard:
            older.unlink()
        elif log and older:
            os.replace(older, log)


@contextmanager
def stop_signals() -> Iterator[list[int]]:
    """A list to which SIGINT, SIGTERM and SIGHUP are appended, instead of ending the program."""
    received: list[int] = []
    names = ("SIGINT", "SIGTERM", "SIGHUP")  # the last: a terminal was closed; not on Windows
    ends = [number for number in signal.Signals if number.name in names]
    handlers = {n: signal.signal(n, lambda number, _: received.append(number)) for n in ends}
    try:
        yield received
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
