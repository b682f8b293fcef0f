"""Faults on the bus: time until the valves are closed, in simulated time, as a Markdown table.

    python -m benchmarks.faults [--repeats 20]
    python -m benchmarks.faults --frozen

Machine, bus and `hw.Drive` run in one process on one clock. A fault of an encoder is repeated over
the joints. `--frozen` prints instead how long a frozen encoder takes at each command. Tests cause
the same faults.
"""

import re
import struct
from collections import defaultdict
from functools import partial, reduce
from itertools import cycle, islice, product
from typing import Any

import can
import numpy as np
import tyro

import benchmarks  # noqa: F401, before NumPy computes: one thread
from benchmarks.one_process import ConstantCommand, HoldingOperator, World, only, raises
from brokk_min.actuator import PLANT
from brokk_min.can.canopen import valve_frame
from brokk_min.can.safety_gate import SLEW, expected_motion, gate_start, still_counts
from brokk_min.can.simulated_machine import Fault
from brokk_min.machine import BROKK_170, PWM_MAX

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


def groups(faults: dict[str, Any]) -> dict[str, list[Any]]:
    """Faults of one kind at several joints under one name."""
    kinds = defaultdict(list)
    for name, fault in faults.items():
        joint = re.fullmatch(r"q[1-5](: .*)", name) if faults is FAULTS else None
        kinds[f"encoder{joint[1]}" if joint else name].append(fault)
    return kinds


def table(repeats: int) -> None:
    """One row a kind of fault, in words without the joint's name."""
    print("| fault | median, worst [ms] | latched | words, or why it is not found |")
    print("|---|---|---|---|")
    for faults in (FAULTS, NOT_FOUND):
        for name, kinds in groups(faults).items():
            phases = (np.arange(repeats) + 0.5) / repeats * 0.05
            outcomes = [measure(kinds[k % len(kinds)][0], phases[k]) for k in range(repeats)]
            times = [1e3 * seconds for seconds, _ in outcomes]
            latched = int(np.isfinite(times).sum())
            said = {re.sub(r"^(fault: )?(q\d: )?| \(.*", "", words) for _, words in outcomes}
            words = "; ".join(sorted(said - {""})) if faults is FAULTS else kinds[0][1]
            span = f"{np.median(times):.0f}, {max(times):.0f}" if latched else "not found"
            print(f"| {name} | {span} | {latched} of {repeats} | {words} |", flush=True)


def frozen_times(counts: int, moving: bool, rng: np.random.Generator) -> np.ndarray:
    """Time [s] from the freezing of an encoder to the gate's fault, many runs: inf, not found.

    One joint of 200 machines moves alone under `counts` [of 127], up or down; its encoder freezes
    at a random moment of a tick, in motion or before the command.
    """
    m, num, first = BROKK_170, 200, 40 if moving else 0
    joint, up = rng.choice(m.driven, num), rng.choice([-1, 1], num)
    low, high = m.column("q_min"), m.column("q_max")
    fraction = np.where(up > 0, rng.uniform(0.1, 0.4, num), rng.uniform(0.6, 0.9, num))
    plant = PLANT.reset(m, low + (high - low) * fraction[:, None])
    moment = rng.uniform(0, 1, num)  # of tick `first`
    frozen = np.rint(plant.q / m.encoder_step).astype(int)
    sent = gate_start(m).sent[None].repeat(num, axis=0)
    gate, found = gate_start(m)._replace(place=frozen, sent=sent), np.full(num, np.inf)
    for tick in range(first + 60):
        q = plant.q
        place, motion = expected_motion(m, gate, frozen)
        fault = (motion > 3 * still_counts(m) * m.encoder_step).any(axis=-1)
        found = np.where(fault & np.isinf(found), tick, found)
        sent = np.zeros((num, m.n))
        before = np.abs(gate.sent[range(num), joint, -1])
        sent[range(num), joint] = up * np.minimum(before + SLEW, counts / PWM_MAX)
        history = np.concatenate([gate.sent[..., 1:], sent[..., None]], axis=-1)
        gate = gate._replace(sent=history, place=place, motion=motion)
        plant = PLANT.step(m, plant, sent)
        if tick < first:
            frozen = np.rint(plant.q / m.encoder_step).astype(int)
        elif tick == first:
            q = q + moment[:, None] * (plant.q - q)
            frozen = np.rint(q / m.encoder_step).astype(int)
    return (found - first - moment) * m.dt


def frozen_table() -> None:
    """Median and worst times of frozen encoders by command."""
    rng = np.random.default_rng(0)
    print("| command, counts of 127 | joint was moving [s] | joint was at rest [s] |")
    print("|---|---|---|")
    for counts in (80, 60, 40, 30, 20, 16, 14):
        times = [frozen_times(counts, moving, rng) for moving in (True, False)]
        cells = [f"{np.median(t):.2f}, at most {t.max():.2f}" for t in times]
        print(f"| {counts} | {cells[0]} | {cells[1]} |".replace("inf", "never"))


def main(repeats: int = 20, frozen: bool = False) -> None:
    if frozen:
        frozen_table()
    else:
        table(repeats)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
