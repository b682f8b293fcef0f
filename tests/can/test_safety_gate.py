"""The gate against a plain rewriting of its promises."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from brokk_min.can.canopen import checksum
from brokk_min.can.safety_gate import GateInputs, GateState, gate
from brokk_min.machine import BROKK_170

STEP = BROKK_170.encoder_step[0]
DT = 0.05
SHAPE = (3, 10, 100)  # of the gates
RARE = {"stop": 0.03, "error": 0.03, "flooded": 0.02, "other_sender": 0.02}
FLAGS = {"enable": 0.8, "centred": 0.7, "alive": 0.97} | RARE  # how often each input is set


NO_COMMANDS = (np.nan, np.inf, -np.inf, 1e30, 81, -81, 80.5)  # counts


def edge(near, margin):
    """A limit near `near` to which adding `margin` gives a whole number of counts."""
    whole = (np.arange(3000) - 1500) * STEP
    hits = [x - margin for x in whole.tolist() if x - margin + margin == x]
    return min(hits, key=lambda x: abs(x - near))


def tight_machine():
    """The Brokk with ranges such that whole counts hit the gate's borders, and a wide dead zone."""
    margins = [(-0.05, 0.05), (-0.05, 0.05), (0.02, -0.02), (-0.05, -0.02), (0.02, 0.05)]
    joints = [
        replace(j, q_min=edge(j.q_min, low), q_max=edge(j.q_max, high))
        for j, (low, high) in zip(BROKK_170.joints, margins, strict=True)
    ]
    joints[4] = replace(joints[4], dead_zone=(0.07, 0.16))
    return replace(BROKK_170, name="tight", joints=tuple(joints))


def plain_motion(machine, s, count, j):
    """The place that the encoder of joint `j` has stayed at, and the motion [rad] since then."""
    joint = machine.joints[j]
    sent = (s.sent[j] * 127).round().tolist()
    idle = 1.5 * max(max(each.dead_zone) for each in machine.joints)
    smallest = min(sent) / 127 if sent[-1] > 0 else -max(sent) / 127
    if smallest <= idle or abs(int(count) - int(s.place[j])) > 1:
        return int(count), 0.0  # a count of 12 bits is above 1.5 mrad
    opening = (smallest - idle) / (80 / 127 - idle)
    least = DT * (0.4 * min(joint.q_dot_up, joint.q_dot_down) * opening)
    return int(s.place[j]), float(s.motion[j]) + least


def plain_node(machine, s, i, now, node):
    """What is wrong with one node, with the promised numbers written out."""
    faults = {
        "never seen": i.heartbeat[node] == -np.inf,
        "heartbeat lost": not -DT <= now - i.heartbeat[node] <= 0.110,
        "not operational": i.nmt[node] != 5,
    }
    if node == 5:
        return faults
    joint, q, before = machine.joints[node], i.counts[node] * STEP, s.counts[node] * STEP
    jump = 2 * max(joint.q_dot_up, joint.q_dot_down) * DT + 0.0045 + STEP
    limit = 80 if joint.driven else 0
    _, motion = plain_motion(machine, s, i.counts[node], node)
    return faults | {
        "silent": i.frames[node] == 0,
        "position before SYNC": i.early[node],
        "position doubled, not of 4 bytes, or FFFFFFFF": i.frames[node] >= 2,
        "out of range": not joint.q_min - 0.05 <= q <= joint.q_max + 0.05,
        "jumped": abs(q - before) > jump,
        "frozen, or the joint does not move": motion > 3 * STEP,
        "no valid command": not abs(float(i.command[node])) < (limit + 0.5) / 127,
    }


def plain_fault(machine, s, i, now):
    """The first fault of one gate."""
    program = {
        "error": i.error,
        "bus flooded": i.flooded,
        "SYNC, NMT or valve frame of another sender": i.other_sender,
        "tick late, or the clock was set": not 0.5 * DT <= now - s.time <= 1.5 * DT,
        "operator's device lost": not i.alive,
    }
    found = [words for words, fault in program.items() if fault]
    nodes = [plain_node(machine, s, i, now, node) for node in range(6)]
    for words in nodes[0]:
        names = zip((*machine.names, "valve controller"), nodes)
        found += [f"{name}: {words}" for name, faults in names if faults.get(words)]
    return [*found, "stop asked for" if i.stop else ""][0]


def plain_gate(machine, s, i, now):
    """One gate, written as its promises read; the frame without its checksum."""
    fault = plain_fault(machine, s, i, now)
    fresh_edge = bool(i.enable and not s.enable and i.centred)
    driving = not fault and bool(i.enable) and (bool(s.driving) or fresh_edge)
    m = [0] * 5
    for j, joint in enumerate(machine.joints):
        if driving and s.driving:
            last, q = round(s.sent[j][-1] * 127), i.counts[j] * STEP
            m[j] = min(max(round(float(i.command[j]) * 127), min(last, 0) - 40), max(last, 0) + 40)
            if (m[j] > 0 and q >= joint.q_max - 0.02) or (m[j] < 0 and q <= joint.q_min + 0.02):
                m[j] = 0
    trusted = i.alive and not i.error
    counter = 0 if s.counter == 255 else int(s.counter) + 1
    stays = [plain_motion(machine, s, c, j) for j, c in enumerate(i.counts)]
    state = GateState(
        driving=driving,
        armed_once=bool(s.armed_once) or driving,
        active_fault=fault,
        latched_fault="" if driving else fault if s.driving else str(s.latched_fault),
        enable=bool(i.enable) if trusted else bool(i.enable or s.enable),
        time=now,
        counter=counter,
        counts=i.counts,
        sent=[[*old[1:], new / 127] for old, new in zip(s.sent, m, strict=True)],
        place=[place for place, _ in stays],
        motion=[angle for _, angle in stays],
    )
    return state, [*(x if x >= 0 else 255 + x for x in m), counter, int(driving)]


def some(rng, p, *shape):
    return rng.random((*SHAPE, *shape)) < p


def put(rng, array, p, *values):
    chosen = rng.choice(values, array.shape)
    return np.where(rng.random(array.shape) < p, chosen, array)


def draw_inputs(machine, rng):
    """Random inputs, mostly sound, each with about one value on or next to a border."""
    n, low, high = machine.n, machine.column("q_min"), machine.column("q_max")
    borders = [np.rint(x / STEP) for x in (low - 0.05, low + 0.02, high - 0.02, high + 0.05)]
    near = np.stack(borders, -1)[np.arange(n), rng.integers(0, 4, (*SHAPE, n))]
    near = near + rng.integers(-2, 3, (*SHAPE, n))
    middle = np.rint((low + high) / 2 / STEP) + rng.integers(-9, 10, (*SHAPE, n))
    m = np.where(some(rng, 0.5, n), rng.integers(-80, 81, (*SHAPE, n)), 0).astype(float)
    m = put(rng, m, 0.3, -80, 80)
    m[..., machine.locked] = 0
    beats = -rng.uniform(0, 0.1, (*SHAPE, n + 1))
    return GateInputs(
        command=put(rng, m, 0.01, *NO_COMMANDS, 80.4, -80.4, 0.4, 1, -1) / 127,
        counts=np.where(some(rng, 0.3, n), near, middle).astype(int),
        early=some(rng, 0.005, n),
        frames=put(rng, np.ones((*SHAPE, n), int), 0.01, 0, 2, 3),
        heartbeat=put(rng, beats, 0.01, -0.110, -0.110 - 1e-9, -np.inf, 0.049, 1.0, np.nan),
        nmt=put(rng, np.full((*SHAPE, n + 1), 5), 0.01, 0, 4, 6, 127),
        **{name: some(rng, p) for name, p in FLAGS.items()},
    )


def draw_state(machine, rng, counts):
    """Random states a tick before encoders at `counts`, in the same way."""
    n = machine.n
    fastest = np.floor((2 * machine.q_dot_max * DT + 0.0045) / STEP + 1).astype(int)
    jump = rng.choice([-1, 1], (*SHAPE, n)) * (fastest + rng.integers(-1, 2, (*SHAPE, n)))
    step = np.where(some(rng, 0.5, n), 0, rng.integers(-3, 4, (*SHAPE, n)))
    last = counts - np.where(some(rng, 0.03, n), jump, step)
    # commands: to one side for some ticks, or not; now and then one to the other side
    odds = [0.01, 0.3, 0.19, 0.3, 0.2]
    sides = rng.choice([-1, 1], (*SHAPE, n, 1))
    push = sides * rng.choice([12, 13, 14, 40, 80], (*SHAPE, n, 9), p=odds)
    pushed = np.arange(9, 0, -1) <= rng.choice([0, 7, 8, 9], (*SHAPE, n, 1))
    sent = np.where(pushed, push, rng.integers(-80, 81, (*SHAPE, n, 9)))
    late = (0.5 * DT, 0.5 * DT - 1e-9, 1.5 * DT + 1e-9, 0.074, 0.026, np.inf, np.nan, -1.0)
    return GateState(
        driving=some(rng, 0.6),
        armed_once=some(rng, 0.5),
        active_fault=rng.choice(["", "error"], SHAPE),
        latched_fault=rng.choice(["", "q4: jumped"], SHAPE),
        enable=some(rng, 0.5),
        time=-put(rng, np.full(SHAPE, DT), 0.1, *late),
        counter=rng.choice([0, 1, 127, 254, 255], SHAPE),
        counts=last,
        sent=np.where(some(rng, 0.02, n, 9), -sent, sent) / 127,
        place=counts + rng.integers(-2, 3, (*SHAPE, n)),
        motion=STEP * rng.choice([0.0, 1.5, 2.7, 3.2], (*SHAPE, n), p=[0.6, 0.1, 0.1, 0.2]),
    )


@cache  # planted errors of this test are in the gate, which is not called here
def promised(machine, seed, dtype):
    """Random states and inputs, commands in double or single precision, and what is promised."""
    rng = np.random.default_rng(seed)
    inputs = draw_inputs(machine, rng)
    inputs = inputs._replace(command=inputs.command.astype(dtype))
    before = draw_state(machine, rng, inputs.counts)
    results = []
    for row in np.ndindex(SHAPE):
        given = [type(part)(*(x[row] for x in part)) for part in (before, inputs)]
        results.append(plain_gate(machine, *given, 0))
    return before, inputs, *zip(*results, strict=True)


@pytest.mark.parametrize(
    ("machine", "seed", "dtype"), [(BROKK_170, 0, "f8"), (tight_machine(), 2, "f4")]
)
def test_gate__is_what_its_promises_say_in_any_leading_shape(machine, seed, dtype):
    """Commands are those of a PID or of a policy."""
    before, inputs, expected, frames = promised(machine, seed, dtype)
    state, frame = gate(machine, before, inputs, np.zeros(SHAPE))
    assert frame.dtype == np.uint8
    np.testing.assert_array_equal(frame[..., 6], checksum(np.delete(frame, 6, axis=-1)))
    sent = np.reshape(frames, (*SHAPE, 7))
    np.testing.assert_array_equal(np.delete(frame, 6, axis=-1), sent)
    for name, found in zip(GateState._fields, state, strict=True):
        wanted = np.array([getattr(one, name) for one in expected])
        np.testing.assert_array_equal(found, wanted.reshape(*SHAPE, *wanted.shape[1:]), name)
    faults = {one.active_fault.split(": ")[-1] for one in expected}
    assert len(faults) == 17, "each fault comes up"
    assert (sent[..., :5].any(axis=-1) & state.driving).sum() > 300
