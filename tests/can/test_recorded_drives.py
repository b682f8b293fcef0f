"""Recorded drives replay bit for bit through `hw`, a PI controller and the gate.

    python -m tests.can.test_recorded_drives    records them anew, into tests/can/recorded

Each file has the frames of a drive's log, and after each tick what the program knew and decided.
"""

import zlib
from collections import deque
from dataclasses import replace
from functools import cache
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

from benchmarks.faults import FAULTS
from benchmarks.one_process import World, baseline, unchanged
from brokk_min.can.canopen import LATENESS, OPERATOR_INPUT, Frame, OperatorInput
from brokk_min.can.connection import Bus
from brokk_min.can.drive_log import read_frames
from brokk_min.hw import Drive
from brokk_min.machine import BROKK_170

FOLDER = Path(__file__).with_name("recorded")
SLEW, _, BOOM, STICK, _ = BROKK_170.joints
CRANE = replace(
    BROKK_170,
    name="crane",
    joints=(
        replace(SLEW, name="slew", encoder_node=7, encoder_zero=-300, encoder_sign=-1),
        replace(BOOM, name="boom", encoder_node=9, dead_zone=(0.12, 0.16)),
        replace(STICK, name="stick", encoder_node=8, encoder_zero=5000),
    ),
    rate=25.0,
    encoder_bits=13,
    pwm_limit=100,
    controller_node=33,
    valve_frame_id=0x322,
    q_start=(),
    hydraulics=None,
)
MACHINES = {"faults": BROKK_170, "sound": BROKK_170, "crane": CRANE}
CAUSES = [  # of what is in the log, one each second
    "q4: stuck",
    "q3: wrong",
    "q4: slow",
    "q5: off",
    "q2: garbage",
    "q3: delayed",
    "q4: doubled",
    "q1: malformed",
    "q2: says FFFFFFFF",
    "q5: rebooted",
    "q3: heartbeat lost",
    "valves: slow",
    "position of q5 before SYNC as well",
    "foreign SYNC",
    "foreign valve frame",
    "flood of 6,000 foreign frames a second",
    "joystick unplugged",
    "enable released",
]


class Operator:
    """It presses when the machine is ready, moves to and fro, and presses anew after a fault."""

    def __init__(self):
        self.ticks, self.held, self.enable, self.alive, self.stop = 0, False, None, True, False

    def __call__(self, driving, ready):
        self.told = [driving, ready]
        self.ticks += 1
        self.held = self.enable is None and (driving or (ready and not self.held))
        x, y, z = 0.2 * np.sin(0.08 * self.ticks + np.array([1.0, 3.0, 5.0]))
        moves = driving or self.ticks < 8  # at first the stick is not centred
        v = (round(x, 4), round(y, 4), round(z, 4)) if moves else (0.0, 0.0, 0.0)
        return OperatorInput(v, self.held, self.alive, self.stop)


class Again:
    """An operator whose inputs were recorded."""

    def __init__(self, frames):
        rows = (frame.data for frame in frames if frame.id == OPERATOR_INPUT and frame.sent)
        self.inputs = iter([unpack(data) for data in rows])

    def __call__(self, driving, ready):
        self.told = [driving, ready]
        return next(self.inputs)


def unpack(data):
    """The operator's input of seven bytes."""
    x, y, z = (np.frombuffer(data[:6], "<i2") / 1e4).tolist()
    return OperatorInput((x, y, z), *(bool(data[6] >> bit & 1) for bit in range(3)))


class Fallible:
    """A PI controller; at some of its calls something else comes of the command u (1, n)."""

    def __init__(self, machine, changes):
        self.inner, self.changes, self.calls = baseline(machine), changes, count(1)
        self.start = self.inner.start

    def __call__(self, measured, state):
        u, state = self.inner(measured, state)
        return self.changes.get(next(self.calls), lambda u: u)(u), state


def raises(u):
    raise RuntimeError("no command")


def changes_of(name, stall=lambda u: u):
    """What goes wrong with the controller of a drive, by the number of its call."""
    wrong = {30: raises, 60: lambda u: np.nan * u, 90: lambda u: u + 0.7, 120: stall}
    return wrong if name == "faults" else {}


def state_of(drive):
    """What is compared after each tick: words and whole numbers, times in microseconds."""
    gate, nodes = drive.gate, drive.nodes
    return {
        "counts": gate.counts,
        "nodes' NMT states": nodes.nmt.copy(),
        "nodes' heartbeats": np.where(np.isinf(nodes.heartbeat), 0, np.rint(1e6 * nodes.heartbeat)),
        "fault of this tick": gate.active_fault,
        "fault that stopped it": gate.latched_fault,
        "reason": drive.reason,
        "is anything measured": drive.measured is not None,
        "does it drive": gate.driving,
        "was it armed": gate.armed_once,
        "switch": gate.enable,
        "driving and ready, as the operator was told": drive.operator.told,
        "operator's input": list(drive.operator_input.pack()),
        "command [counts]": np.rint(127 * gate.sent[..., -1]).astype(int),
        "place of a still encoder": gate.place,
        "time": np.rint(1e6 * gate.time),
    }


def digests(frames):
    """A number for all that was read until the end of each tick."""
    number, found = 0, []
    for frame in frames:
        if frame.id == LATENESS and frame.sent:
            found.append(number)
        elif not frame.sent:
            number = zlib.crc32(bytes([*divmod(frame.id, 256), *frame.data]), number)
    return np.array(found)


class Replay(Bus):
    """A bus that gives what was read, and compares what is sent and logged."""

    def __init__(self, frames, differences):
        self.frames, self.time, self.differences = deque(frames), frames[0].time, differences

    def now(self):
        return self.time

    def sleep(self, seconds):
        self.time = round(self.time + seconds, 6)

    def recv(self, timeout):
        end = round(self.time + timeout, 6)
        if self.frames and not self.frames[0].sent and self.frames[0].time <= end:
            frame = self.frames.popleft()
            self.time = frame.time
            return frame
        self.time = end
        return None

    def send(self, can_id, data):
        wanted = self.frames.popleft() if self.frames else Frame(self.time, -1, b"")
        if self.time > wanted.time + 1e-9:
            words = f"frame 0x{can_id:03X}, time: recorded {wanted.time}, sent {self.time}"
            self.differences.append(words)
        self.time = wanted.time
        if (wanted.id, wanted.data, wanted.sent) == (can_id, data, True):
            return
        same = wanted.sent and wanted.id == can_id and len(data) == len(wanted.data)
        at = [i for i, (a, b) in enumerate(zip(data, wanted.data)) if a != b] if same else []
        words = f"frame 0x{can_id:03X}, byte {at[0]}" if at else "frame"
        found = f"0x{wanted.id:03X} {wanted.data.hex(' ')}, sent 0x{can_id:03X} {data.hex(' ')}"
        self.differences.append(f"{words}: recorded {found}")

    def _message(self, can_id, data):
        return can_id, data

    def _log(self, message, channel):
        self.send(*message)

    def flush(self):
        pass


@cache
def load(name):
    """Frames of a drive, and what is compared after each tick."""
    with np.load(FOLDER / f"{name}.npz") as file:
        told = dict(file)
    parts = ("time", "id", "size", "data", "sent")
    rows = zip(*(told.pop(f"frame {part}").tolist() for part in parts))
    frames = [Frame(t, i, bytes(data[:size]), sent) for t, i, size, data, sent in rows]
    return frames, told


def replay(name, frames, told, changes=None):
    """Drive by the frames; AssertionError: the first difference, with its tick and field."""
    differences, machine = [], MACHINES[name]
    bus = Replay(frames, differences)
    controller = Fallible(machine, changes_of(name) | (changes or {}))
    drive = Drive(machine, controller, bus, Again(frames))
    read = digests(frames)
    try:
        drive.begin()
    except ValueError as error:
        differences.append(f"setting up the nodes: {error}")
    for tick in range(len(told["time"])):
        assert not differences, f"tick {tick}, {differences[0]}"
        drive.tick()
        assert not differences, f"tick {tick}, {differences[0]}"
        for field, value in (state_of(drive) | {"what was read": read[tick]}).items():
            wanted = told[field][tick]
            assert np.array_equal(value, wanted), f"tick {tick}, {field}: {wanted}, got {value}"
    assert not bus.frames, f"tick {tick}, frame: recorded {bus.frames[0]}, sent none"


@pytest.mark.parametrize("name", MACHINES)
def test_recorded_drive__replays_bit_for_bit(name):
    frames, told = load(name)
    assert told["does it drive"].sum() > 100 and (told["command [counts]"] != 0).sum() > 200
    replay(name, frames, told)


@pytest.mark.parametrize("name", MACHINES)
def test_recorded_drive__fails_on_any_other_byte_with_tick_and_field(name):
    frames, told = load(name)
    rng = np.random.default_rng(0)
    places = [(k, i) for k, frame in enumerate(frames) for i in range(len(frame.data))]
    for k, i in rng.permutation(places)[:12]:
        data = bytearray(frames[k].data)
        data[i] ^= 1 << rng.integers(8)
        other = [*frames[:k], frames[k]._replace(data=bytes(data)), *frames[k + 1 :]]
        with pytest.raises(AssertionError, match=r"^tick \d+, \S.*: "):
            replay(name, other, told)


@pytest.mark.parametrize("name", MACHINES)
def test_recorded_drive__fails_on_a_command_of_one_count_more(name):
    frames, told = load(name)
    for call in (20, 25, 45, 75):
        moved = {call: lambda u: np.where(np.abs(u) > 1 / 127, u - np.sign(u) / 127, u)}
        with pytest.raises(AssertionError, match=r"^tick \d+, frame 0x..., byte [0-4]: recorded"):
            replay(name, frames, told, moved)


def record(name, folder):
    """Drive a simulated machine, and write what it told."""
    world = World(None, Operator(), Path(folder) / "drive.log", MACHINES[name])
    controller = Fallible(MACHINES[name], changes_of(name, lambda u: world.sleep(0.13) or u))
    world.drive.controller = controller
    world.bus.start = 0.0  # s; times of day would be rounded by a quarter of a microsecond
    operator, rows = world.operator, []
    causes = iter(CAUSES if name == "faults" else [])
    world.drive.begin()
    while not rows or not operator.stop:
        operator.stop = len(rows) == (499 if name == "faults" else 160)
        if name == "faults" and len(rows) % 20 == 10:
            world.upward = world.downward = unchanged
            world.noise, operator.alive, operator.enable = list, True, None
            world.simulated.faults.clear()
        elif name == "faults" and len(rows) >= 140 and len(rows) % 20 == 0:
            FAULTS[next(causes)][0](world)
        world.drive.tick()
        rows.append(state_of(world.drive))
    world.bus.close()
    frames = list(read_frames(Path(folder) / "drive.log"))
    told = {field: np.array([row[field] for row in rows]) for field in rows[0]}
    np.savez_compressed(
        FOLDER / f"{name}.npz",
        **{
            "frame time": [frame.time for frame in frames],
            "frame id": np.array([frame.id for frame in frames], np.int16),
            "frame size": np.array([len(frame.data) for frame in frames], np.uint8),
            "frame data": np.array([[*frame.data.ljust(8, b"\0")] for frame in frames], np.uint8),
            "frame sent": [frame.sent for frame in frames],
            "what was read": digests(frames),
        },
        **told,
    )


if __name__ == "__main__":
    for name in MACHINES:
        with TemporaryDirectory() as folder:
            record(name, folder)
        print(f"{name}: {(FOLDER / f'{name}.npz').stat().st_size} bytes")
