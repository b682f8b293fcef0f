"""What can go wrong on a bus: causes in a `World`, words that name each, and what came of it."""

import struct
from functools import partial, reduce
from itertools import cycle, islice, product

import can
import numpy as np
from helpers_bus import ConstantCommand, HoldingOperator, World, only, raises

from brokk_min.can.canopen import valve_frame
from brokk_min.can.simulated_machine import Fault
from brokk_min.machine import BROKK_170

COMMAND = (60, 0, 60, 60, 60)
VALVES = BROKK_170.controller_node
FOREIGN = range(0x300, 0x500)  # identifiers of no frame of ours


def put(name, value):
    """Set an attribute of the world, or of something in it."""
    *owners, attribute = name.split(".")
    return lambda world: setattr(reduce(getattr, owners, world), attribute, value)


def up(can_id, act):
    """Change frames of one identifier from the machine."""
    return put("upward", only(can_id, act))


def valves(act):
    """Change the next valve frame, and no other."""

    def cause(world):
        acts = iter([act])
        world.downward = only(0x210, lambda data: next(acts, lambda data: [data])(data))

    return cause


def moved(add):
    return lambda data: [struct.pack("<I", (struct.unpack("<I", data)[0] + add) % 2**26)]


def fail(world, node, kind, command=None):
    """A node of the machine fails as by `--fault`; before, the controller may change its mind."""
    if command:
        world.controller.m[:] = command
    world.simulated.faults.append(Fault(node, kind, world.time))


def flood(world, ids=range(2048), rate=2000):
    """Frames of each of the identifiers and each length; those that came."""
    rng = np.random.default_rng(0)
    pairs = cycle(rng.permutation(list(product(ids, range(9)))).tolist())
    begun, came = world.time, []

    def noise():
        num = int((world.time - begun) * rate) - len(came)
        frames = [(can_id, rng.bytes(length)) for can_id, length in islice(pairs, num)]
        came.extend(frames)
        return frames

    world.noise = noise
    return came


def foreign(world, can_id, data):
    """One frame of somebody else."""
    frames = [(can_id, data)]
    world.noise = lambda: [frames.pop()] if frames else []


def repeat_once(world, node):
    """The position of the tick before, from now on, without a gap."""
    held = []
    up(0x180 + node, lambda data: held.append(data) or held[-2:][:1])(world)


def drift(world, node, speed):
    """An encoder that gains `speed` counts a second."""
    begun = world.time
    up(0x180 + node, lambda data: moved(round(speed * (world.time - begun)))(data))(world)


def close_bus(world):
    world.recv = world.send = raises(can.CanOperationError("closed"))


def stall(world, seconds):
    stalls = [seconds]
    world.controller.act = lambda: world.sleep(stalls.pop()) if stalls else None


def command(joint, value):
    return lambda world: world.controller.m.__setitem__(joint, value)


# what goes wrong, and words of the reason that the program gives, or why it cannot find it
SEND_ERROR = raises(can.CanOperationError("no buffer space"))
THEIRS = valve_frame(np.array([77, 0, 0, 0, 0]) / 127, 0, 1).tobytes()
OTHER_SENDER = "SYNC, NMT or valve frame of another sender"
NOT_OPERATIONAL = "valve controller: not operational"
EARLY, DOUBLED = "position before SYNC", "position doubled, not of 4 bytes"
FAULTS = {
    "valves: off": (partial(fail, node=VALVES, kind="off"), "valve controller: heartbeat lost"),
    "valve controller stopped": (up(0x710, lambda d: [b"\x04"]), NOT_OPERATIONAL),
    "flood on all identifiers": (flood, ""),
    "flood of 6,000 foreign frames a second": (partial(flood, ids=FOREIGN, rate=6e3), "flooded"),
    "foreign SYNC": (partial(foreign, can_id=0x080, data=b""), OTHER_SENDER),
    "foreign NMT": (partial(foreign, can_id=0x000, data=b"\x80\x10"), OTHER_SENDER),
    "foreign valve frame": (partial(foreign, can_id=0x210, data=THEIRS), OTHER_SENDER),
    "bus closed": (close_bus, "error (CanOperationError: closed)"),
    "send error of all frames": (put("downward", SEND_ERROR), "(CanOperationError"),
    "valve frame doubled": (valves(lambda d: [d, d]), NOT_OPERATIONAL),
    "joystick unplugged": (put("operator.alive", False), "operator's device lost"),
    "joystick raises": (put("operator.act", raises(OSError("gone"))), "error (OSError: gone)"),
    "enable released": (put("operator.enable", False), ""),
    "SIGTERM": (lambda world: world.drive.signals.append(15), "stop asked for"),
    "clock stepped forward": (put("bus.start", 1.9e9), "tick late, or the"),
    "log cannot be written": (put("bus.flush", raises(OSError("full"))), "error (OSError: full)"),
    "late tick": (partial(stall, seconds=0.08), "tick late"),
    "policy returns NaN": (command(2, np.nan), "q3: no valid command"),
    "policy beyond the limit": (command(4, 81), "q5: no valid command"),
    "policy moves the locked joint": (command(1, 20), "q2: no valid command"),
    "policy raises": (put("controller.act", raises(RuntimeError("no"))), "error (RuntimeError"),
}
for kind in ("stuck", "garbage", "wrong", "slow", "intermittent"):
    FAULTS[f"valves: {kind}"] = partial(fail, node=VALVES, kind=kind), NOT_OPERATIONAL
OF_ENCODER = {
    "off": "silent",
    "stuck": "frozen",
    "garbage": "",
    "wrong": "jumped",
    "slow": "silent",
    "delayed": "silent",
    "intermittent": "silent",
}
for node in range(1, 6):
    tpdo, heartbeat = 0x180 + node, 0x700 + node
    of_joint = {
        "jumps by half a turn": (up(tpdo, moved(2048)), "out of range"),
        "says FFFFFFFF": (up(tpdo, lambda d: [b"\xff" * 4]), DOUBLED),
        # the last answer ends the wait: its double comes before the next SYNC
        "doubled": (up(tpdo, lambda d: [d, d]), EARLY if node == 5 else DOUBLED),
        "malformed": (up(tpdo, lambda d: [d[:3]]), DOUBLED),
        "heartbeat lost": (up(heartbeat, lambda d: []), "heartbeat lost"),
        "rebooted": (up(heartbeat, lambda d: [b"\x00"]), "not operational"),
    }
    for kind, words in OF_ENCODER.items():
        of_joint[kind] = partial(fail, node=node, kind=kind), words
    for name, (cause, words) in of_joint.items():
        FAULTS[f"q{node}: {name}"] = (cause, f"q{node}: {words}")
del FAULTS["q2: stuck"]  # a joint that is not driven
cause = partial(foreign, can_id=0x185, data=bytes(4))
FAULTS["position of q5 before SYNC as well"] = (cause, f"q5: {EARLY}")
NOT_FOUND = {
    "valves: delayed": (partial(fail, node=VALVES, kind="delayed"), "the machine follows later"),
    "q2: stuck, the locked joint": (partial(fail, node=2, kind="stuck"), "it may stand still"),
    "q3 a tick late, without a gap": (partial(repeat_once, node=3), "no time, no number"),
    "q3: stuck, at small commands": (
        partial(fail, node=3, kind="stuck", command=(15, 0, 15, 15, 15)),
        "it takes longer",
    ),
    "q3 drifts by 60 counts/s": (partial(drift, node=3, speed=60), "it looks like motion"),
    "4,500 foreign frames a second": (partial(flood, ids=FOREIGN, rate=4500), "harmless"),
}


def measure(cause, phase):
    """Drive for a second, let it go wrong `phase` [s] after a SYNC, and go on for 0.6 s.

    The time [s] until the valves were closed for good, by the plant's own record (inf: they were
    open again or still 0.4 s later, while the operator holds on), and the program's reason.
    """
    world = World(ConstantCommand(*COMMAND), HoldingOperator())
    world.drive.begin()
    world.run(1.0)
    world.sleep(max(0.0, world.syncs[-1] + phase - world.time))
    assert world.commands[1][-1].tolist() == list(COMMAND), "it drove"
    begun = world.time
    cause(world)
    world.run(0.6)
    words = world.drive.reason
    world.sleep(max(0.0, begun + 0.9 - world.time))
    times, m = world.commands
    seconds = max(0.0, times[m.any(axis=1)][-1] - begun)
    return seconds if seconds < 0.4 else np.inf, words
