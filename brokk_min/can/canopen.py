"""CAN frames and their bytes: CANopen's encoders (CiA 301 and 406), valve frame, operator input."""

import struct
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brokk_min.machine import Array, Machine, decode_pwm, encode_pwm, require

Counts = NDArray[np.integer[Any]]  # whole numbers, such as bytes

# CAN identifiers of CANopen; from TPDO1 on the node's number is added
NMT = 0x000
SYNC = 0x080
EMERGENCY = 0x080  # with the node's number
TPDO1 = 0x180
SDO_ANSWER = 0x580
SDO_REQUEST = 0x600
HEARTBEAT = 0x700
TPDO1_OBJECT = (0x1800, 1)  # index, subindex of its identifier; bit 31: switched off,
REMOTE_REFUSED = 1 << 30  # and this bit: no remote requests, which we do not send
OPERATIONAL = 5  # NMT state
START_ALL = bytes([1, 0])  # NMT command
PRE_OPERATIONAL_ALL = bytes([128, 0])  # in this state every encoder takes settings
POSITION_BITS = 26  # of the encoders that we simulate
NO_POSITION = 0xFFFFFFFF  # what many encoders send when they fail
HEARTBEAT_PERIOD = 0.050  # s, set in the encoders (assumed)
SDO_TIMEOUT = 0.5  # s (assumed), then the request is sent once more,
SDO_TRIES = 10  # so often in all, since a node that was just switched on boots for seconds
MAX_FRAMES = 256  # read in a tick; with more the bus is flooded
WATCHDOG = 0.150  # s without valid valve frame, then the controller closes the valves (assumed)
MOST_JOINTS = 5  # in a valve frame
VALVES = 0x7F0  # and a joint's number: what is known of its valves, k and d up, k and d down
LATENESS = 0x7FD  # of a tick, eight bytes [us]
WOULD_SEND = 0x7FE  # of valve frames of `shadow`; these four are in the log, never on the bus
OPERATOR_INPUT = 0x7FF  # of the operator's input


class Frame(NamedTuple):
    """One frame; `id` is -1 for a remote, extended, FD or error frame, and for an echo."""

    time: float  # s
    id: int
    data: bytes
    sent: bool = False


class Nodes:
    """What encoders and valve controller (the last node) sent last, and the newest valve frame."""

    def __init__(self, machine: Machine) -> None:
        nodes = node_numbers(machine)
        self.machine = machine
        self.own_ids: tuple[int, ...] = (NMT, SYNC, machine.valve_frame_id)  # nobody else's
        self.received = self.others = 0  # frames of this tick, and those in `own_ids`
        self.position_index = {TPDO1 + node: i for i, node in enumerate(nodes[:-1])}
        self.heartbeat_index = {HEARTBEAT + node: i for i, node in enumerate(nodes)}
        self.raw = np.full(machine.n, -1)  # -1: none yet
        self.early = np.zeros(machine.n, bool)  # did a position come before this tick's SYNC?
        self.frames = np.zeros(machine.n, int)  # positions since then; a malformed one counts 2
        self.heartbeat = np.full(machine.n + 1, -np.inf)  # s, -inf: never
        self.nmt = np.zeros(machine.n + 1, int)
        self.u: Array = np.zeros(machine.n)  # commands of the newest valve frame
        self.enable = False  # of it
        self.valve_time = -np.inf  # s, of it

    def listen(self, bus: Any, end: float, until_complete: bool = False) -> None:
        """Read until `end` [s] and the bus is empty, or until every encoder has answered."""
        while self.received < MAX_FRAMES and not (until_complete and (self.frames > 0).all()):
            frame = bus.recv(max(0.0, end - bus.now()))
            if frame is None:
                return
            self.update(frame)

    def start_tick(self) -> None:
        """Forget how many frames came."""
        self.frames[:] = 0
        self.received = self.others = 0

    def update(self, frame: Frame) -> None:
        """Take in one frame; those of others change nothing."""
        self.received += 1
        self.others += frame.id in self.own_ids
        if frame.id in self.position_index:
            i = self.position_index[frame.id]
            raw = int.from_bytes(frame.data, "little")
            sound = len(frame.data) == 4 and raw != NO_POSITION
            self.frames[i] += 1 if sound else 2
            if sound:
                self.raw[i] = raw
        elif frame.id in self.heartbeat_index and len(frame.data) == 1:
            i = self.heartbeat_index[frame.id]
            self.heartbeat[i] = frame.time
            self.nmt[i] = frame.data[0] & 0x7F
        elif frame.id == self.machine.valve_frame_id and len(frame.data) == 8:
            self.u, self.enable = read_valve_frame(self.machine, frame.data)
            self.valve_time = frame.time


def check_bus(machine: Machine) -> None:
    """ValueError: too many joints, an identifier twice, slow ticks, or a joint beyond a turn."""
    require(machine.n <= MOST_JOINTS, "joints", f"at most {MOST_JOINTS} on a bus", machine.n)
    nodes, valves = node_numbers(machine), machine.valve_frame_id
    bases = (EMERGENCY, TPDO1, SDO_ANSWER, SDO_REQUEST, HEARTBEAT)
    others = {NMT, SYNC, *(base + node for base in bases for node in nodes)}
    free = valves < VALVES and valves not in others
    require(free, "valve_frame_id", "an identifier of no other frame", f"0x{valves:03X}")
    for joint in machine.joints:
        width = joint.q_max - joint.q_min
        fits = joint.kind == "revolute" and width < 6.18  # less than a turn
        got = f"{joint.kind}, {width:.2f}"
        require(fits, joint.name, "revolute, with a range below 6.18 rad, on a bus", got)
    slowest = 1.8 / WATCHDOG  # Hz, because a tick may be late by half, and frames need time, too
    require(machine.rate >= slowest, "rate", f"{slowest:g} Hz or more (watchdog)", machine.rate)


def node_numbers(machine: Machine) -> list[int]:
    """The encoders of the joints, and the valve controller at last."""
    return [*(joint.encoder_node for joint in machine.joints), machine.controller_node]


def set_up_nodes(bus: Any, machine: Machine) -> None:
    """Check and set up the encoders, and start all nodes; ValueError: an encoder does not fit."""
    check_bus(machine)
    for joint in machine.joints:
        for (index, sub), (value, meaning) in encoder_objects(machine, joint.encoder_node).items():
            found = sdo(bus, joint.encoder_node, (index, sub))
            if (index, sub) == TPDO1_OBJECT:
                found &= ~REMOTE_REFUSED
            what = f"{joint.name}: object 0x{index:04X}:{sub:02X}"
            require(found == value, what, meaning, f"{found} (0x{found:X})")
    bus.send(NMT, PRE_OPERATIONAL_ALL)
    period = struct.pack("<H", round(1e3 * HEARTBEAT_PERIOD))  # ms
    for joint in machine.joints:
        sdo(bus, joint.encoder_node, (0x1017, 0), period)  # of heartbeats
        sdo(bus, joint.encoder_node, (0x1800, 2), b"\x01")  # a position after every SYNC
    bus.send(NMT, START_ALL)


def encoder_objects(machine: Machine, node: int) -> dict[tuple[int, int], tuple[int, str]]:
    """Objects of an encoder by index and subindex: the value that fits, and what it means."""
    turn = 2**machine.encoder_bits
    return {
        (0x6501, 0): (turn, f"{turn} counts a turn"),
        TPDO1_OBJECT: (TPDO1 + node, f"TPDO1 with identifier 0x{TPDO1 + node:X}, switched on"),
        (0x1A00, 0): (1, "one object in TPDO1"),
        (0x1A00, 1): (0x6004_00_20, "the 4 bytes of object 0x6004 in TPDO1"),
    }


def sdo(bus: Any, node: int, address: tuple[int, int], data: bytes = b"") -> int:
    """Read an object by index and subindex, or write up to four bytes; ValueError: no answer."""
    command = 0x23 | (4 - len(data)) << 2 if data else 0x40
    request = struct.pack("<BHB4s", command, *address, data)
    what = "node {}: object 0x{:04X}:{:02X}".format(node, *address)
    for _ in range(SDO_TRIES):
        bus.send(SDO_REQUEST + node, request)
        end = bus.now() + SDO_TIMEOUT
        while (left := end - bus.now()) > 0 and (frame := bus.recv(left)):
            own = frame.id == SDO_ANSWER + node and frame.data[1:4] == request[1:4]
            if own and len(frame.data) == 8:
                command, answer = struct.unpack("<B3xI", frame.data)
                require(command != 0x80, what, "an answer", f"SDO abort 0x{answer:08X}")
                return int(answer)
    raise ValueError(f"{what}: expected an answer within {SDO_TRIES * SDO_TIMEOUT} s, got none")


def encoder_counts(machine: Machine, raw: ArrayLike) -> Counts:
    """Joint angles [counts] of raw positions (..., n): zeroed, unwrapped at mid range."""
    turn = 2**machine.encoder_bits
    zero, sign = (machine.column(name).astype(int) for name in ("encoder_zero", "encoder_sign"))
    middle = (machine.column("q_min") + machine.column("q_max")) / 2
    lowest = np.rint(middle / machine.encoder_step).astype(int) - turn // 2
    counts = sign * (np.asarray(raw) - zero)
    return np.asarray((counts - lowest) % turn + lowest)


def encoder_raw(machine: Machine, counts: ArrayLike) -> Counts:
    """Raw positions of encoders with 26 bits at joint angles [counts] (..., n)."""
    zero, sign = (machine.column(name).astype(int) for name in ("encoder_zero", "encoder_sign"))
    return np.asarray((sign * np.asarray(counts) + zero) % 2**POSITION_BITS)


CRC_OF = np.arange(256)  # the remainder of each byte, divided by the polynomial 0x1D
for _ in range(8):
    CRC_OF = (CRC_OF << 1 ^ np.where(CRC_OF & 0x80, 0x1D, 0)) & 0xFF


def checksum(frame: ArrayLike) -> Counts:
    """CRC-8 SAE J1850 of bytes (..., k), (...): polynomial 0x1D, start and final XOR 0xFF."""
    crc = np.array(0xFF)
    for byte in np.moveaxis(np.asarray(frame, int), -1, 0):
        crc = CRC_OF[crc ^ byte]
    return crc ^ 0xFF


def valve_frame(u: ArrayLike, counter: ArrayLike, enable: ArrayLike) -> Counts:
    """Bytes (..., 8): five PWM bytes, counter, checksum, enable.

    The commands `u` in [-1, 1] are (..., n) with n at most 5. Paper: Sec. 3.2 (PWM bytes)
    """
    pwm = encode_pwm(u)
    frame = np.zeros((*pwm.shape[:-1], 8), np.uint8)
    frame[..., : pwm.shape[-1]] = pwm
    frame[..., 5] = counter
    frame[..., 7] = enable
    frame[..., 6] = checksum(frame[..., [0, 1, 2, 3, 4, 5, 7]])
    return frame


def read_valve_frame(machine: Machine, data: bytes) -> tuple[Array, bool]:
    """Commands u (n,) in [-1, 1] and enable of the eight bytes of a valve frame."""
    return decode_pwm(list(data[: machine.n])), data[7] == 1


class OperatorInput(NamedTuple):
    """The operator's input of one tick."""

    v_goal: tuple[float, float, float] = (0.0, 0.0, 0.0)  # tool velocity [m/s], base frame
    enable: bool = False  # dead-man switch
    alive: bool = True  # is the device there?
    stop: bool = False  # end the program

    def pack(self) -> bytes:
        """Seven bytes for the log: three velocities in 0.1 mm/s, flags."""
        flags = self.enable | self.alive << 1 | self.stop << 2
        return struct.pack("<hhhB", *(round(1e4 * v) for v in self.v_goal), flags)


Operator = Callable[[bool, bool], OperatorInput]  # does the gate drive, is it ready -> the input
