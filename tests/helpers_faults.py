"""What can go wrong on a bus: causes in a `World`, words that name each, and what came of it."""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import partial
from itertools import cycle
from typing import Any, NamedTuple

import can
import numpy as np
from helpers_bus import ConstantCommand, HoldingOperator, World, once, only, raises

from brokk_min.can.canopen import Frame, encoder_raw, valve_frame
from brokk_min.machine import BROKK_170

COMMAND = (60, 0, 60, 60, 60)
SLOW = (15, 0, 15, 15, 15)
STEP = BROKK_170.encoder_step[0]


def put(name, value):
    """Set an attribute of the world, or of something in it."""

    def cause(world):
        *owners, attribute = name.split(".")
        for owner in owners:
            world = getattr(world, owner)
        setattr(world, attribute, value)

    return cause


def up(can_id, act):
    """Change frames of one identifier from the machine."""
    return put("upward", only(can_id, act))


def up_once(can_id, act):
    """Change the first of them."""
    return lambda world: up(can_id, once(act))(world)


def down_once(act):
    """Change the first valve frame."""
    return lambda world: put("downward", only(0x210, once(act)))(world)


def moved(add):
    return lambda data: [struct.pack("<I", (struct.unpack("<I", data)[0] + add) % 2**26)]


def freeze(world, node, command=None):
    world.controller.m[:] = world.controller.m if command is None else command
    counts = np.rint(world.simulated.plant.q / STEP).astype(int)
    data = struct.pack("<I", encoder_raw(BROKK_170, counts)[node - 1])
    up(0x180 + node, lambda _: [data])(world)


def flicker(world, node):
    """A loose encoder: one place, to and fro by one count."""
    counts = np.rint(world.simulated.plant.q / STEP).astype(int)
    places = cycle(encoder_raw(BROKK_170, counts + k)[node - 1] for k in (0, 1))
    up(0x180 + node, lambda _: [struct.pack("<I", next(places))])(world)


def due(world, held):
    """Remove and return the frames whose time has come."""
    frames = [frame for then, frame in held if then <= world.time]
    held[:] = [item for item in held if item[0] > world.time]
    return frames


def delay(world, node, draw):
    """Positions come `draw()` seconds late."""
    tpdo, held = 0x180 + node, []
    up(tpdo, lambda data: held.append((world.time + draw(), (tpdo, data))) or [])(world)
    world.noise = lambda: due(world, held)


def late(world, node):
    """Constantly late positions, and an operator who presses again and again."""
    operator = world.operator
    delay(world, node, lambda: 0.030)
    operator.act = lambda: setattr(
        operator, "enable", bool(world.drive.gate.driving or not operator.enable)
    )


def reorder(world, node):
    """Every second position comes after the next one."""
    held = []

    def act(data):
        if held:
            return [data, held.pop()]
        held.append(data)
        return []

    up(0x180 + node, act)(world)


def repeat(world, period, frame):
    """Somebody else sends `frame(1)`, `frame(2)`, ..., one each `period` [s]."""
    begun, count = world.time, 0

    def noise():
        nonlocal count
        out = []
        while begun + period * (count + 1) <= world.time:
            count += 1
            out.append(frame(count))
        return out

    world.noise = noise


def flood(world, foreign=False, rate=2000):
    """Frames of any identifier; pairs of identifier and length that came, and how many exist."""
    rng = np.random.default_rng(0)
    nodes = (1, 2, 3, 4, 5, 16)
    ours = {0, 0x80, 0x210, *(base + n for base in (0x180, 0x580, 0x600, 0x700) for n in nodes)}
    ids = rng.permutation([i for i in range(2048) if not foreign or i not in ours])
    assert len(ids) % 3  # no factor in common with the nine lengths: each pair has its turn
    seen = set()

    def frame(count):
        can_id, data = int(ids[count % len(ids)]), rng.bytes(count % 9)
        seen.add((can_id, len(data)))
        return can_id, data

    repeat(world, 1 / rate, frame)
    return seen, 9 * len(ids)


foreign_flood = partial(flood, foreign=True)


def request(world, rate):
    """Somebody else reads the encoders' resolution, by SDO."""
    data = struct.pack("<BHBI", 0x40, 0x6501, 0, 0)
    repeat(world, 1 / rate, lambda count: (0x601 + count % 5, data))


def foreign_valves(counts, counter):
    return 0x210, valve_frame([counts, 0, 0, 0, 0], counter % 256, 1).tobytes()


def second_master(world):
    """Somebody else sends valid valve frames of his own."""
    repeat(world, 0.05, lambda count: foreign_valves(20, count))


def intruder(world, after):
    """Somebody else sends a well-formed frame of 77 counts after each of our frames of an id."""
    counter = 0

    def follow(can_id, data):
        nonlocal counter
        out = [(can_id, data)]
        if can_id == 0x210:
            counter = data[5]
        if can_id == after:
            counter += 1
            out.append(foreign_valves(77, counter))
            world.answers.append(out[-1])
        return out

    world.downward = follow


def foreign(can_id, data):
    """One frame of somebody else."""

    def cause(world):
        frames = [(can_id, data)]
        world.noise = lambda: [frames.pop()] if frames else []

    return cause


def delay_valve_frames(world, seconds):
    held = []

    def noise():
        for data in due(world, held):
            world.simulated.receive(Frame(world.time, 0x210, data))
        return []

    world.downward = only(0x210, lambda d: held.append((world.time + seconds, d)) or [])
    world.noise = noise


def repeat_once(world, node, command=COMMAND):
    """The position of the tick before, from now on, without a gap."""
    world.controller.m[:] = command
    held = []

    def act(data):
        held.append(data)
        return held[-2:][:1]

    up(0x180 + node, act)(world)


def drift(world, node, speed):
    """An encoder that gains `speed` counts a second."""
    begun = world.time
    up(0x180 + node, lambda data: moved(round(speed * (world.time - begun)))(data))(world)


def close_bus(world):
    world.recv = world.send = raises(can.CanOperationError("closed"))


SEND_ERROR = raises(can.CanOperationError("no buffer space"))


def stall(seconds):
    def cause(world):
        stalls = [seconds]
        world.controller.act = lambda: world.sleep(stalls.pop()) if stalls else None

    return cause


def command(joint, value):
    return lambda world: world.controller.m.__setitem__(joint, value)


# what goes wrong, and words of the reason that the program gives, or why it cannot find it
OTHER_SENDER = "SYNC, NMT or valve frame of another sender"
NOT_OPERATIONAL = "valve controller: not operational"
FAULTS = {
    "valve controller silent": (up(0x710, lambda d: []), "valve controller: heartbeat lost"),
    "valve controller stopped": (up(0x710, lambda d: [b"\x04"]), NOT_OPERATIONAL),
    "valve controller's heartbeat malformed": (up(0x710, lambda d: [d * 2]), "heartbeat lost"),
    "flood on all identifiers": (flood, ""),
    "flood of 6,000 foreign frames a second": (partial(foreign_flood, rate=6e3), "bus flooded"),
    "flood of 20,000 foreign frames a second": (partial(foreign_flood, rate=2e4), "bus flooded"),
    "second master": (second_master, OTHER_SENDER),
    "second sender after each of our valve frames": (partial(intruder, after=0x210), ""),
    "second sender after each SYNC": (partial(intruder, after=0x080), OTHER_SENDER),
    "foreign SYNC": (foreign(0x080, b""), OTHER_SENDER),
    "foreign NMT stop of all": (foreign(0x000, b"\x02\x00"), OTHER_SENDER),
    "foreign NMT reset of q4": (foreign(0x000, b"\x81\x04"), OTHER_SENDER),
    "foreign NMT stop of the valve controller": (foreign(0x000, b"\x02\x10"), OTHER_SENDER),
    "bus closed": (close_bus, "error (CanOperationError: closed)"),
    "send error of all frames": (put("downward", SEND_ERROR), "(CanOperationError"),
    "send error of valve frames": (put("downward", only(0x210, SEND_ERROR)), ""),
    "valve frame lost": (down_once(lambda d: []), NOT_OPERATIONAL),
    "valve frame doubled": (down_once(lambda d: [d, d]), NOT_OPERATIONAL),
    "valve frame's bit flipped": (
        down_once(lambda d: [bytes([d[0] ^ 4, *d[1:]])]),
        "valve controller",
    ),
    "valve frame cut": (down_once(lambda d: [d[:7]]), NOT_OPERATIONAL),
    "all valve frames lost": (put("downward", only(0x210, lambda d: [])), NOT_OPERATIONAL),
    "valve frames 60 ms late": (partial(delay_valve_frames, seconds=0.06), NOT_OPERATIONAL),
    "valve frames 100 ms late": (partial(delay_valve_frames, seconds=0.1), NOT_OPERATIONAL),
    "joystick unplugged": (put("operator.alive", False), "operator's device lost"),
    "joystick raises": (put("operator.act", raises(OSError("gone"))), "error (OSError: gone)"),
    "enable released": (put("operator.enable", False), ""),
    "SIGTERM": (lambda world: world.drive.signals.append(15), "stop asked for"),
    "operator stops": (put("operator.stop", True), "stop asked for"),
    "clock stepped forward": (put("offset", 3600.0), "tick late, or the"),
    "clock stepped back": (put("offset", -3600.0), "tick late, or the"),
    "log cannot be written": (
        put("bus.flush", raises(OSError("no space"))),
        "error (OSError: no space)",
    ),
    "late tick": (stall(0.08), "tick late"),
    "hang": (stall(0.8), "tick late"),
    "policy returns NaN": (command(2, np.nan), "q3: no valid command"),
    "policy returns infinity": (command(0, np.inf), "q1: no valid command"),
    "policy beyond the limit": (command(4, 81), "q5: no valid command"),
    "policy moves the locked joint": (command(1, 20), "q2: no valid command"),
    "policy raises": (
        put("controller.act", raises(RuntimeError("boom"))),
        "error (RuntimeError: boom)",
    ),
    "encoders all silent": (
        put("upward", lambda i, d: [] if 0x180 < i < 0x190 else [(i, d)]),
        "q1: silent",
    ),
}
for node in range(1, 6):
    tpdo, heartbeat, doubled = 0x180 + node, 0x700 + node, "doubled or malformed"
    of_joint = {
        "dropped": (up(tpdo, lambda d: []), "silent"),
        "dropped once": (up_once(tpdo, lambda d: []), "silent"),
        "jumps": (up(tpdo, moved(90)), "jumped"),
        "jumps by half a turn": (up(tpdo, moved(2048)), "out of range"),
        "jumps by a turn": (up(tpdo, moved(4096)), doubled),
        "says FFFFFFFF": (up(tpdo, lambda d: [b"\xff" * 4]), doubled),
        "doubled": (up(tpdo, lambda d: [d, d]), doubled),
        "reordered": (partial(reorder, node=node), "silent"),
        "malformed": (up(tpdo, lambda d: [d[:3]]), doubled),
        "heartbeat lost": (up(heartbeat, lambda d: []), "heartbeat lost"),
        "rebooted": (up(heartbeat, lambda d: [b"\x00"]), "not operational"),
    }
    if node != 2:  # the operator moves q2, no command of ours
        of_joint |= {
            "late by 30 ms, after re-arm too": (partial(late, node=node), "silent"),
            "frozen": (partial(freeze, node=node), "frozen"),
            "a tick late, without a gap": (partial(repeat_once, node=node), "frozen"),
        }
    for name, (cause, words) in of_joint.items():
        FAULTS[f"q{node} {name}"] = (cause, f"q{node}: {words}")
MOTION = "it looks like motion, which no other sensor confirms"
NOT_FOUND = {
    "q2 frozen, the locked joint": (partial(freeze, node=2), "it may stand still"),
    "slow q3 a tick late, without a gap": (
        partial(repeat_once, node=3, command=SLOW),
        "a position has neither time nor number",
    ),
    "slow q3 frozen": (partial(freeze, node=3, command=SLOW), "it takes longer, see below"),
    "q3 flickers by one count": (partial(flicker, node=3), "it takes longer, see below"),
    "q3 drifts by 60 counts/s": (partial(drift, node=3, speed=60), MOTION),
    "q5 drifts by 400 counts/s": (partial(drift, node=5, speed=-400), MOTION),
    "valve frames 30 ms late": (
        partial(delay_valve_frames, seconds=0.03),
        "within the tick; the machine follows later",
    ),
    "4,500 foreign frames a second": (partial(foreign_flood, rate=4500), "harmless"),
    "2,000 SDO requests a second": (partial(request, rate=2000), "harmless"),
}


class Outcome(NamedTuple):
    """What came of a fault, by the plant's own record."""

    seconds: float  # from the fault until the valves were closed for good
    latched: bool  # closed long before the end, though the operator held on
    words: str  # reason that the program gave
    commands: tuple[np.ndarray, np.ndarray]  # `World.commands` since the fault


def measure(cause: Callable[[World], Any], phase: float, seconds: float = 0.6) -> Outcome:
    """Drive for a second, let it go wrong `phase` [s] after a SYNC, and go on for `seconds`."""
    world = World(ConstantCommand(*COMMAND), HoldingOperator())
    world.drive.begin()
    world.run(1.0)
    world.sleep(max(0.0, world.syncs[-1] + phase - world.time))
    assert world.commands[1][-1].tolist() == list(COMMAND), "it drove"
    begun = world.time
    cause(world)
    world.run(seconds)
    words = world.drive.reason
    world.sleep(max(0.0, begun + seconds + 0.3 - world.time))
    times, m = world.commands
    times, m = times[times > begun], m[times > begun]
    is_open = m.any(axis=1)
    last = float(times[is_open][-1]) if is_open.any() else begun
    return Outcome(last - begun, last < begun + seconds - 0.2, words, (times, m))
