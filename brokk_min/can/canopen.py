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
from numpy.typing import ArrayLike, NDArray

from brokk_min.identification.files import expected, require
from brokk_min.machine import PWM_MAX, Machine, encode_pwm

Array = NDArray[Any]  # counts and flags, too

# CANopen (CiA 301): identifiers are these plus the node's number
NMT, SYNC, TPDO1, SDO_ANSWER, SDO_REQUEST, HEARTBEAT = 0x000, 0x080, 0x180, 0x580, 0x600, 0x700
POSITION_MASK = (1 << 26) - 1  # bits of an encoder's position that count
OPERATIONAL = 5  # CANopen state of a node at work
# objects: index, subindex
BEAT_OBJECT, SYNC_OBJECT, RESOLUTION_OBJECT = (0x1017, 0), (0x1800, 2), (0x6501, 0)
OPERATOR_CHANNEL, OPERATOR_INPUT = (
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


class Bus:
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
        self.message = require("can", "hw").Message
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
        self._keep(self._message(OPERATOR_INPUT, data), now, OPERATOR_CHANNEL)
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
def open_bus(interface: str, channel: str, log: Path | None = None) -> Iterator[Bus]:
    """A bus by python-can's names, closed at the end of the block; `log` grows while it runs.

    ValueError: python-can is not there, finds no such bus, or fails in the block.
    """
    can = require("can", "hw")
    try:
        bus = can.Bus(interface=interface, channel=channel)
    except Exception as error:  # each interface has its own
        raise ValueError(f"{interface} {channel}: expected a CAN bus, got {error!r}") from error
    name = channel if interface == "socketcan" else interface
    line = Bus(
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
    reader = require("can", "hw").CanutilsLogReader
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

    def update(self, frame: Frame) -> None:
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


# --- codec ------------------------------------------------------------------------------------------


def encoder_counts(machine: Machine, raw: ArrayLike) -> Array:
    """Joint angles in counts from raw positions (..., n): masked, zeroed, unwrapped around mid range.

    Example:
        >>> from brokk_min.machine import BROKK_170
        >>> encoder_counts(BROKK_170, [2**26 - 1, 4095, 4096 + 7, 1000, 0])
        array([  -1,   -1,    7, 1000,    0])
    """
    turn = 2**machine.encoder_bits
    low, high, zero, sign = map(machine.column, ("q_min", "q_max", "encoder_zero", "encoder_sign"))
    counts = sign.astype(int) * ((np.asarray(raw) & POSITION_MASK) - zero.astype(int))
    start = np.rint((low + high) / 2 / machine.encoder_step).astype(int) - turn // 2
    return np.asarray((counts - start) % turn + start)


def encoder_raw(machine: Machine, counts: ArrayLike) -> Array:
    """What encoders with 26 bits say for joint angles in counts (..., n)."""
    zero, sign = (machine.column(name).astype(int) for name in ("encoder_zero", "encoder_sign"))
    return np.asarray((sign * np.asarray(counts) + zero) & POSITION_MASK)


def _crc_table() -> Array:
    table = np.arange(256)
    for _ in range(8):
        table = (table << 1 ^ np.where(table & 0x80, 0x1D, 0)) & 0xFF
    return table.astype(np.uint8)


_CRC = _crc_table()


def checksum(frame: ArrayLike) -> Array:
    """CRC-8 SAE J1850 of bytes (..., k): polynomial 0x1D, start and final XOR 0xFF.

    Example:
        >>> hex(checksum(list(b"123456789")))
        '0x4b'
    """
    frame = np.asarray(frame, np.uint8)
    crc: Array = np.array(0xFF, np.uint8)
    for byte in frame.T:
        crc = _CRC[crc ^ byte]
    return (crc ^ np.uint8(0xFF)).T


def valve_frame(m: ArrayLike, counter: ArrayLike, enable: ArrayLike) -> Array:
    """Bytes (..., 8): five PWM bytes, counter, checksum, enable; `m` [counts of 127] (..., n <= 5)."""
    m = np.asarray(m)
    frame = np.zeros((*m.shape[:-1], 8), np.uint8)
    frame[..., : m.shape[-1]] = encode_pwm(m / PWM_MAX)
    frame[..., 5], frame[..., 7] = counter, enable
    frame[..., 6] = checksum(frame[..., [0, 1, 2, 3, 4, 5, 7]])
    return frame


class OperatorInput(NamedTuple):
    """What the operator asks for at one tick."""

    v_goal: tuple[float, float, float] = (0.0, 0.0, 0.0)  # tool velocity [m/s], base frame
    enable: bool = False  # dead-man switch
    alive: bool = True  # is the device there?
    stop: bool = False  # end the program
    error: bool = False  # set by the loop, so that the log tells it

    def pack(self) -> bytes:
        """As seven bytes of the log: three times 0.1 mm/s, flags."""
        flags = self.enable | self.alive << 1 | self.stop << 2 | self.error << 3
        return struct.pack("<hhhB", *(round(1e4 * v) for v in self.v_goal), flags)


def unpack_operator_input(data: bytes) -> OperatorInput:
    """What `OperatorInput.pack` packed.

    Example:
        >>> unpack_operator_input(OperatorInput((0.1, 0.0, -0.25), enable=True).pack())
        OperatorInput(v_goal=(0.1, 0.0, -0.25), enable=True, alive=True, stop=False, error=False)
    """
    x, y, z, flags = struct.unpack("<hhhB", data)
    return OperatorInput((x / 1e4, y / 1e4, z / 1e4), *(bool(flags & 1 << i) for i in range(4)))
