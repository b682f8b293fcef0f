"""CAN frames and their bytes: the bus and its log, CANopen's encoders, valve frame, operator input.

Encoders speak CANopen (CiA 301 and 406). python-can is imported when a bus or a log is opened.
"""

import select
import signal
import struct
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brokk_min.identification.files import require
from brokk_min.machine import PWM_MAX, Machine, encode_pwm

Array = NDArray[Any]  # counts and flags, too

# CAN identifiers of CANopen; from TPDO1 on the node's number is added
NMT = 0x000
SYNC = 0x080
TPDO1 = 0x180
SDO_ANSWER = 0x580
SDO_REQUEST = 0x600
HEARTBEAT = 0x700
# objects of an encoder: index, subindex
HEARTBEAT_OBJECT = (0x1017, 0)  # period [ms]
SYNC_OBJECT = (0x1800, 2)  # after how many SYNCs a position is sent
RESOLUTION_OBJECT = (0x6501, 0)  # counts per turn
OPERATIONAL = 5  # NMT state
START_ALL = bytes([1, 0])  # NMT command
POSITION_MASK = (1 << 26) - 1  # the bits of a position that count
HEARTBEAT_PERIOD = 0.050  # s, set in the encoders (assumed)
SDO_TIMEOUT = 0.5  # s (assumed)
# the operator's input is logged as frames that are never on the bus
OPERATOR_CHANNEL = "operator"
OPERATOR_INPUT = 0x7FF


class Frame(NamedTuple):
    """One frame; `id` is -1 for a remote, extended, FD or error frame, and for an echo."""

    time: float  # s
    id: int
    data: bytes
    sent: bool = False
    channel: str = ""


@dataclass
class Bus:
    """A CAN bus with a monotonic clock and a log of what is sent and read."""

    bus: Any  # of python-can, without filters
    writer: Any = None  # python-can's candump writer
    name: str = "can"  # of the bus in the log
    echo: bool = False  # does the bus give back what we send?
    clock: Callable[[], float] = time.monotonic  # s
    sleep: Callable[[float], object] = time.sleep

    def __post_init__(self) -> None:
        """Find the descriptor to wait on, if the bus has one."""
        self.start = time.time() - self.clock()  # the log has the time of day, but it may be set
        self.echoes: deque[tuple[int, bytes]] = deque(maxlen=64 if self.echo else 0)
        self.unwritten: deque[Any] = deque()  # messages for the log
        self.message = require("can", "hw").Message
        self.file = -1
        with suppress(NotImplementedError):
            self.file = self.bus.fileno()

    def now(self) -> float:
        """Time of day at the start plus monotonic time since [s], in whole microseconds."""
        return round(self.start + self.clock(), 6)

    def recv(self, timeout: float, busy_wait: float = 0.0) -> Frame | None:
        """The next frame within `timeout` [s], or None; it sleeps only after `busy_wait` [s]."""
        if self.file >= 0 and timeout > 0:  # python-can's own timeout follows the time of day
            start = self.clock()
            elapsed = 0.0
            while elapsed < timeout and not select.select([self.file], [], [], 0)[0]:
                if elapsed >= busy_wait:
                    select.select([self.file], [], [], timeout - elapsed)
                elapsed = self.clock() - start
            timeout = 0.0
        message = self.bus.recv(timeout)
        if message is None:
            return None
        now = self.now()
        data = bytes(message.data)
        if (message.arbitration_id, data) in self.echoes:
            self.echoes.remove((message.arbitration_id, data))
            return Frame(now, -1, data)
        self._log(message, now, self.name)
        return Frame(now, standard_id(message), data)

    def send(self, can_id: int, data: bytes) -> None:
        """Send one frame, once; never periodically: the kernel would go on after a hang."""
        message = self._message(can_id, data)
        self.bus.send(message, timeout=0.01)
        self.echoes.append((can_id, data))
        self._log(message, self.now(), self.name)

    def log_input(self, data: bytes) -> float:
        """Log the operator's input, which is not on the bus; the time of it [s]."""
        now = self.now()
        self._log(self._message(OPERATOR_INPUT, data), now, OPERATOR_CHANNEL)
        return now

    def flush(self) -> None:
        """Write the log on, so that it survives the program's sudden end."""
        while self.unwritten:
            self.writer.on_message_received(self.unwritten.popleft())
        if self.writer is not None:
            self.writer.file.flush()

    def _message(self, can_id: int, data: bytes) -> Any:
        return self.message(arbitration_id=can_id, data=data, is_extended_id=False, is_rx=False)

    def _log(self, message: Any, now: float, channel: str) -> None:
        """Keep for `flush`: writing waits until there is time."""
        if self.writer is not None:
            message.timestamp = now
            message.channel = channel
            self.unwritten.append(message)

    def close(self) -> None:
        """Close bus and log."""
        self.bus.shutdown()
        if self.writer is not None:
            self.flush()
            self.writer.stop()


def standard_id(message: Any) -> int:
    """Identifier of a data frame with 11 bits; -1 for any other frame."""
    flags = message.is_extended_id, message.is_remote_frame, message.is_error_frame, message.is_fd
    return -1 if any(flags) else int(message.arbitration_id)


@contextmanager
def open_bus(interface: str, channel: str, log: Path | None = None) -> Iterator[Bus]:
    """A bus by python-can's names, closed at the end of the block; `log` grows while it runs.

    ValueError: python-can is not installed, finds no such bus, or fails in the block.
    """
    can = require("can", "hw")
    where = f"{interface} {channel}: expected a CAN bus"
    try:
        raw = can.Bus(interface=interface, channel=channel)
    except Exception as error:  # each interface has its own
        raise ValueError(f"{where}, got {error!r}") from error
    name = channel if interface == "socketcan" else interface
    writer = can.CanutilsLogWriter(log) if log else None
    bus = Bus(raw, writer, name, echo=interface == "udp_multicast")
    try:
        yield bus
    except can.CanError as error:
        raise ValueError(f"{where} that works, got {error!r}") from error
    finally:
        bus.close()


@contextmanager
def stop_signals() -> Iterator[list[int]]:
    """A list to which SIGINT and SIGTERM are appended, instead of ending the program."""
    received: list[int] = []
    numbers = (signal.SIGINT, signal.SIGTERM)
    handlers = [signal.signal(n, lambda number, _: received.append(number)) for n in numbers]
    try:
        yield received
    finally:
        for number, handler in zip(numbers, handlers, strict=True):
            signal.signal(number, handler)


# --- encoders ------------------------------------------------------------------------------------


class Nodes:
    """Newest positions, heartbeats and states of encoders and valve controller (the last node)."""

    def __init__(self, machine: Machine) -> None:
        nodes = [*(joint.encoder_node for joint in machine.joints), machine.controller_node]
        self.machine = machine
        self.position_index = {TPDO1 + node: i for i, node in enumerate(nodes[:-1])}
        self.heartbeat_index = {HEARTBEAT + node: i for i, node in enumerate(nodes)}
        self.raw = np.zeros(machine.n, int)
        self.frames = np.zeros(machine.n, int)  # positions of this tick; a malformed one counts 2
        self.heartbeat = np.full(machine.n + 1, -np.inf)  # s, -inf: never
        self.nmt = np.zeros(machine.n + 1, int)

    def update(self, frame: Frame) -> None:
        """Take in one frame; those of others change nothing."""
        size = len(frame.data)
        if frame.id in self.position_index:
            i = self.position_index[frame.id]
            self.frames[i] += 1 if size == 4 else 2
            if size == 4:
                (self.raw[i],) = struct.unpack("<I", frame.data)
        elif frame.id in self.heartbeat_index and size == 1:
            i = self.heartbeat_index[frame.id]
            self.heartbeat[i] = frame.time
            self.nmt[i] = frame.data[0] & 0x7F

    def counts(self) -> Array:
        """Newest joint angles [counts], (n,)."""
        return encoder_counts(self.machine, self.raw)


def set_up_nodes(bus: Any, machine: Machine) -> None:
    """Check the encoders, set their heartbeats, let them answer each SYNC, and start all nodes.

    ValueError: an encoder that does not answer or has another resolution, or too many joints.
    """
    if machine.n > 5:
        raise ValueError(
            f"{machine.name}: expected at most 5 joints in a valve frame, got {machine.n}"
        )
    for joint in machine.joints:
        node = joint.encoder_node
        resolution = sdo(bus, node, RESOLUTION_OBJECT)
        if resolution != 2**machine.encoder_bits:
            raise ValueError(
                f"{joint.name}: expected {2**machine.encoder_bits} counts a turn of encoder node "
                f"{node} (object 0x6501), got {resolution}"
            )
        sdo(bus, node, HEARTBEAT_OBJECT, round(1e3 * HEARTBEAT_PERIOD), size=2)
        sdo(bus, node, SYNC_OBJECT, 1, size=1)
    bus.send(NMT, START_ALL)


def sdo(
    bus: Any, node: int, address: tuple[int, int], value: int | None = None, size: int = 4
) -> int:
    """Read an object of a node by its index and subindex, or write `value` of `size` bytes to it.

    ValueError: the node refuses or does not answer.
    """
    command = 0x40 if value is None else 0x23 | (4 - size) << 2
    request = struct.pack("<BHBI", command, *address, value or 0)
    where = "node {}: object 0x{:04X}:{:02X}: expected an answer".format(node, *address)
    bus.send(SDO_REQUEST + node, request)
    end = bus.now() + SDO_TIMEOUT
    while bus.now() < end and (frame := bus.recv(max(0.0, end - bus.now()))):
        other = frame.id != SDO_ANSWER + node or frame.data[1:4] != request[1:4]
        if other or len(frame.data) != 8:
            continue
        command, answer = struct.unpack("<B3xI", frame.data)
        if command == 0x80:
            raise ValueError(f"{where}, got SDO abort 0x{answer:08X}")
        unused = command >> 2 & 3  # of four bytes
        return int(answer & (1 << 8 * (4 - unused)) - 1)
    raise ValueError(f"{where} within {SDO_TIMEOUT} s, got none")


def encoder_counts(machine: Machine, raw: ArrayLike) -> Array:
    """Joint angles [counts] of raw positions (..., n): masked, zeroed, unwrapped at mid range."""
    turn = 2**machine.encoder_bits
    zero, sign = (machine.column(name).astype(int) for name in ("encoder_zero", "encoder_sign"))
    middle = (machine.column("q_min") + machine.column("q_max")) / 2
    lowest = np.rint(middle / machine.encoder_step).astype(int) - turn // 2
    counts = sign * ((np.asarray(raw) & POSITION_MASK) - zero)
    return np.asarray((counts - lowest) % turn + lowest)


def encoder_raw(machine: Machine, counts: ArrayLike) -> Array:
    """Raw positions of encoders with 26 bits at joint angles [counts] (..., n)."""
    zero, sign = (machine.column(name).astype(int) for name in ("encoder_zero", "encoder_sign"))
    return np.asarray((sign * np.asarray(counts) + zero) & POSITION_MASK)


# --- valve frame and operator input --------------------------------------------------------------

CRC_TABLE = np.arange(256)  # CRC-8 of each byte, polynomial 0x1D
for _ in range(8):
    CRC_TABLE = (CRC_TABLE << 1 ^ np.where(CRC_TABLE & 0x80, 0x1D, 0)) & 0xFF


def checksum(frame: ArrayLike) -> Array:
    """CRC-8 SAE J1850 of bytes (..., k), (...): polynomial 0x1D, start and final XOR 0xFF."""
    crc: Array = np.array(0xFF)
    for byte in np.moveaxis(np.asarray(frame, np.uint8), -1, 0):
        crc = CRC_TABLE[crc ^ byte]
    return crc ^ 0xFF


def valve_frame(command: ArrayLike, counter: ArrayLike, enable: ArrayLike) -> Array:
    """Bytes (..., 8): five PWM bytes, counter, checksum, enable.

    `command` [counts of 127] is (..., n) of n <= 5 joints. Paper: Sec. 3.2 (PWM bytes)
    """
    command = np.asarray(command)
    frame = np.zeros((*command.shape[:-1], 8), np.uint8)
    frame[..., : command.shape[-1]] = encode_pwm(command / PWM_MAX)
    frame[..., 5] = counter
    frame[..., 7] = enable
    frame[..., 6] = checksum(frame[..., [0, 1, 2, 3, 4, 5, 7]])
    return frame


class OperatorInput(NamedTuple):
    """The operator's input of one tick."""

    v_goal: tuple[float, float, float] = (0.0, 0.0, 0.0)  # tool velocity [m/s], base frame
    enable: bool = False  # dead-man switch
    alive: bool = True  # is the device there?
    stop: bool = False  # end the program
    error: bool = False  # set by the loop, for a replay of the log

    def pack(self) -> bytes:
        """Seven bytes for the log: three velocities in 0.1 mm/s, flags."""
        flags = self.enable | self.alive << 1 | self.stop << 2 | self.error << 3
        return struct.pack("<hhhB", *(round(1e4 * v) for v in self.v_goal), flags)


Operator = Callable[[bool, bool], OperatorInput]  # does the gate drive, is it ready -> the input


def unpack_operator_input(data: bytes) -> OperatorInput:
    """The inverse of `OperatorInput.pack`."""
    x, y, z, flags = struct.unpack("<hhhB", data)
    return OperatorInput((x / 1e4, y / 1e4, z / 1e4), *(bool(flags & 1 << i) for i in range(4)))
