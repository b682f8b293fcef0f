"""The codec by hand and on all bytes, the gate against a plain rewriting of its promises, and its mutants."""

from __future__ import annotations

import ast
import copy
import inspect
import types
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from brokk_min.can import safety_gate as gate_module
from brokk_min.can.safety_gate import (
    FAULTS,
    GateInputs,
    GateState,
    checksum,
    encoder_counts,
    encoder_raw,
    fault_name,
    gate,
    gate_start,
    valve_frame,
)
from brokk_min.machine import BROKK_170, Machine, decode_pwm, encode_pwm

STEP, DT = BROKK_170.encoder_step, 0.05


# --- codec ------------------------------------------------------------------------------------------


def test_every_byte_of_the_pwm_code() -> None:
    """Written out for all 256 bytes: 0..127 positive, 255..128 negative, 0 and 255 idle."""
    for byte in range(256):
        m = byte if byte < 128 else byte - 255
        assert decode_pwm(byte) * 127 == pytest.approx(m)
        assert encode_pwm(m / 127) == (byte if byte != 255 else 0)
    for positive, negative in ((80, 175), (50, 205)):  # the paper's pairs
        assert positive + negative == 255
        assert encode_pwm([positive / 127, -positive / 127]).tolist() == [positive, negative]


def bitwise_crc(data: bytes) -> int:
    """CRC-8 SAE J1850 straight from its definition, bit by bit."""
    crc = 0xFF
    for byte in data:
        for i in range(7, -1, -1):
            top, crc = crc >> 7, crc << 1 & 0xFF
            if top ^ (byte >> i & 1):
                crc ^= 0x1D
    return crc ^ 0xFF


def test_checksum_is_crc8_j1850() -> None:
    assert bitwise_crc(b"123456789") == checksum(list(b"123456789")) == 0x4B
    rows = np.random.default_rng(0).integers(0, 256, (300, 7))
    assert checksum(rows).tolist() == [bitwise_crc(bytes(row.tolist())) for row in rows]
    assert [int(checksum([byte])) for byte in range(256)] == [
        bitwise_crc(bytes([b])) for b in range(256)
    ]


def test_checksum_finds_every_error_of_up_to_three_bits() -> None:
    frame = np.array([80, 0, 175, 12, 0, 7, 1], np.uint8)
    bits = np.unpackbits(frame)
    places = np.arange(len(bits))
    for flipped in (places[:, None], np.argwhere(np.triu(np.ones((56, 56)), 1))):
        wrong = np.tile(bits, (len(flipped), 1))
        wrong[np.arange(len(flipped))[:, None], flipped] ^= 1
        assert (checksum(np.packbits(wrong, axis=-1)) != checksum(frame)).all()


def test_valve_frame_by_hand() -> None:
    frame = valve_frame(np.array([80, 0, -80, 50, -50]), 9, True)
    assert frame.tolist() == [
        80,
        0,
        175,
        50,
        205,
        9,
        bitwise_crc(bytes([80, 0, 175, 50, 205, 9, 1])),
        1,
    ]
    assert valve_frame(np.array([[1, -1], [0, 2]]), [3, 4], [False, True])[:, :6].tolist() == [
        [1, 254, 0, 0, 0, 3],
        [0, 2, 0, 0, 0, 4],
    ]


def test_encoders_wrap_across_zero_and_are_masked() -> None:
    q1 = [
        encoder_counts(BROKK_170, [raw, 0, 0, 1000, 0])[0] for raw in (1, 0, 2**26 - 1, 2**26 - 2)
    ]
    assert encoder_counts(BROKK_170, [1, 0, 0, 1000, 0]).dtype == int
    assert q1 == [1, 0, -1, -2]  # multi-turn: below zero comes the largest value
    assert encoder_counts(BROKK_170, [4095, 4095, 4095, 4095, 4095])[0] == -1  # single-turn
    junk = encoder_counts(BROKK_170, np.array([5, 5, 5, 1000, 5]) | 0x3F << 26)
    assert junk.tolist() == [5, 5, 5, 1000, 5]
    q4 = encoder_counts(BROKK_170, np.full((3, 5), [[100], [3188], [3189]]))[:, 3]
    assert q4.tolist() == [100, 3188, 3189 - 4096]  # half a turn from the middle, 1141


def test_encoders_can_be_mounted_anyhow() -> None:
    joints = tuple(
        replace(joint, encoder_zero=zero, encoder_sign=sign)
        for joint, zero, sign in zip(
            BROKK_170.joints, (100, 4000, -7, 2**26 - 1, 0), (1, -1, -1, 1, 1), strict=True
        )
    )
    machine = replace(BROKK_170, joints=joints)
    assert encoder_counts(machine, [101, 3999, 2**26 - 9, 999, 3]).tolist() == [1, 1, 2, 1000, 3]
    for fraction in np.linspace(0, 1, 501):
        q = machine.column("q_min") + fraction * (machine.column("q_max") - machine.column("q_min"))
        counts = np.rint(q / STEP).astype(int)
        raw = encoder_raw(machine, counts)
        assert ((raw >= 0) & (raw < 2**26)).all()
        assert encoder_counts(machine, raw).tolist() == counts.tolist()
        assert encoder_counts(machine, raw % 4096).tolist() == counts.tolist()


def test_fault_names() -> None:
    names = [fault_name(BROKK_170, code) for code in range(len(FAULTS) * 6 + 1)]
    assert names[0] == "" and names[1] == "error" and names[1 + 2 * 6] == "operator's device lost"
    assert (
        names[1 + 3 * 6] == "q1: never seen"
        and names[1 + 3 * 6 + 5] == "valve controller: never seen"
    )
    assert names[1 + 10 * 6 + 2] == "q3: frozen, or the joint does not move"
    assert names[1 + 11 * 6 + 4] == "q5: no valid command" and names[1 + 12 * 6] == "stop asked for"


# --- a plain rewriting ------------------------------------------------------------------------------


def tight_machine() -> Machine:
    """The Brokk with ranges and speeds such that whole counts hit the gate's borders exactly."""

    def edge(near: float, margin: float) -> float:
        """A limit near `near` to which adding `margin` gives a whole number of counts, bit for bit."""
        whole = (np.arange(3000) - 1500) * STEP
        limits = whole - margin
        hits = limits[limits + margin == whole]
        return float(hits[np.argmin(np.abs(hits - near))])

    def speed() -> float:
        speeds = np.arange(4, 30) * STEP / (2 * DT)
        return float(speeds[(2.0 * speeds * DT / STEP + 4) % 1 == 0][0])

    margins = [(-0.05, 0.05), (-0.05, 0.05), (0.02, -0.02), (-0.05, -0.02), (0.02, 0.05)]
    joints = tuple(
        replace(
            joint, q_min=edge(joint.q_min, low), q_max=edge(joint.q_max, high),
            cylinder_base=0.0, q_dot_up=speed(), q_dot_down=speed() * (0.8 if joint.a < 1.2 else 1.0),
        )
        for joint, (low, high) in zip(BROKK_170.joints, margins, strict=True)
    )  # fmt: skip
    zones = 12 / (1.5 * 127) * (1 + np.finfo(float).eps * np.arange(-8, 8))
    whole = next(float(zone) for zone in zones if 1.5 * zone * 127 == 12.0)
    return replace(BROKK_170, joints=joints, dead_zone=whole)


def plain_due(machine: Machine, s: GateState, count: int, j: int) -> tuple[float, float]:
    """How fast joint `j` moved when its count last changed, and what motion it owes since then."""
    joint, sent, (before, last) = machine.joints[j], s.sent[j].tolist(), s.counts[j].tolist()
    sign = 1 if sent[7] > 0 else -1
    push = [sign * m - 1.5 * machine.dead_zone * 127 for m in sent]
    weakest, strongest = min(push), max(push)
    if sent[7] == 0 or weakest <= 0:  # some command of the last 0.4 s may have done nothing
        return 0.0, 0.0
    if count != last:
        return max(sign * (count - before) - 1, 0) / 2, 0.0
    pace, slower = float(s.pace[j]), min(joint.q_dot_up, joint.q_dot_down)
    at_least = 0.3 * slower * DT / STEP / (80 - 1.5 * machine.dead_zone * 127) * weakest
    return pace, float(s.due[j]) + max(at_least, 0.5 * pace * weakest / strongest)


def plain_wrong(machine: Machine, s: GateState, i: GateInputs, now: float) -> int:
    """The first thing that is wrong, of one gate, with the promised numbers written out."""
    found = []

    def note(kind: int, node: int, wrong: object) -> None:
        found.extend([(kind, node)] if wrong else [])

    note(0, 0, i.error)
    note(12, 0, i.stop)
    note(1, 0, not 0.5 * DT <= now - s.time <= 1.5 * DT)
    note(2, 0, not i.alive)
    for node in range(6):
        note(3, node, i.beat[node] == -np.inf)
        note(4, node, now - i.beat[node] > 0.110)
        note(5, node, i.nmt[node] != 5)
    for j, joint in enumerate(machine.joints):
        c, old = int(i.counts[j]), int(s.counts[j][1])
        note(6, j, i.frames[j] == 0)
        note(7, j, i.frames[j] >= 2)
        note(8, j, not joint.q_min - 0.05 <= c * STEP <= joint.q_max + 0.05)
        fastest = 2 * max(joint.q_dot_up, joint.q_dot_down) * DT / STEP + 4
        note(9, j, abs(c - old) > fastest)
        note(10, j, plain_due(machine, s, c, j)[1] > 1.0)
        limit = 80 if joint.driven else 0
        note(11, j, not -limit <= i.m[j] <= limit)
    return min((1 + kind * 6 + node for kind, node in found), default=0)


def plain_gate(
    machine: Machine, s: GateState, i: GateInputs, now: float
) -> tuple[GateState, bytes]:
    """One gate, written as its promises read."""
    wrong = plain_wrong(machine, s, i, now)
    fresh_edge = bool(i.enable and not s.enable and i.centred)
    driving = not wrong and bool(i.enable) and (bool(s.driving) or fresh_edge)
    m = [0] * 5
    for j, joint in enumerate(machine.joints):
        if driving and s.driving:
            wanted, last, q = int(i.m[j]), int(s.sent[j][7]), i.counts[j] * STEP
            up, down = max(last, 0) + 40, min(last, 0) - 40
            m[j] = up if wanted > up else down if wanted < down else wanted
            if (m[j] > 0 and q >= joint.q_max - 0.02) or (m[j] < 0 and q <= joint.q_min + 0.02):
                m[j] = 0
    fault = 0 if driving else wrong if s.driving else int(s.latched_fault)
    trusted = i.alive and not i.error
    enable = bool(i.enable) if trusted else bool(i.enable or s.enable)
    counter = 0 if s.counter == 255 else int(s.counter) + 1
    tapes = (
        [[*row[1:], x] for row, x in zip(t.tolist(), new)]
        for t, new in ((s.counts, i.counts), (s.sent, m))
    )
    owed = zip(*(plain_due(machine, s, int(c), j) for j, c in enumerate(i.counts)))
    state = GateState(
        driving, bool(s.armed_once) or driving, wrong, fault, enable, now, counter, *tapes, *owed
    )
    body = bytes([*((x if x >= 0 else 255 + x) for x in m), counter, int(driving)])
    return state, body[:6] + bytes([bitwise_crc(body)]) + body[6:]


# --- cases that lie on the borders ------------------------------------------------------------------


def cases(machine: Machine, num: int, seed: int) -> tuple[GateState, GateInputs, np.ndarray]:
    """`num` states and inputs, mostly sound, each with about one value on or next to a border."""
    rng, n = np.random.default_rng(seed), machine.n
    low, high = machine.column("q_min"), machine.column("q_max")

    def some(p: float, *shape: int) -> np.ndarray:
        return rng.random((num, *shape)) < p

    def put(array: np.ndarray, p: float, *values: float) -> np.ndarray:
        return np.where(some(p, *array.shape[1:]), rng.choice(values, array.shape), array)

    # angles: in the middle, and at, inside and outside of the margins
    borders = [np.rint(x / STEP) for x in (low - 0.05, low + 0.02, high - 0.02, high + 0.05)]
    middle = np.rint((low + high) / 2 / STEP)
    near = np.stack(borders, -1)[np.arange(n), rng.integers(0, 4, (num, n))] + rng.integers(
        -2, 3, (num, n)
    )
    counts = np.where(some(0.3, n), near, middle + rng.integers(-9, 10, (num, n))).astype(int)
    # the two angles before: running, standing, after a jump
    speed, stand = rng.integers(-3, 4, (num, n)), some(0.5, n)
    fastest = np.floor(2 * machine.q_dot_max * DT / STEP + 4).astype(int)
    jump = rng.choice([-1, 1], (num, n)) * (fastest + rng.integers(-1, 2, (num, n)))
    last = counts - np.where(some(0.03, n), jump, np.where(stand, 0, speed))
    old = np.stack([last - np.where(some(0.3, n), 0, rng.integers(-7, 8, (num, n))), last], axis=-1)
    # commands before: pushed the same way for some ticks, or not; growing from anything to anything
    ago = np.arange(8, 0, -1)
    hard = rng.choice([-1, 1], (num, n, 1)) * rng.choice(
        [12, 13, 14, 40, 80], (num, n, 8), p=[0.01, 0.3, 0.19, 0.3, 0.2]
    )
    sent = np.where(
        ago <= rng.choice([0, 6, 7, 8], (num, n, 1)), hard, rng.integers(-80, 81, (num, n, 8))
    )
    sent = np.where(some(0.02, n, 8), -sent, sent)
    m = np.where(
        some(0.5, n), rng.integers(-80, 81, (num, n)), rng.choice([-80, 0, 80], (num, n))
    ).astype(float)
    m[:, machine.locked] = 0
    m = put(m, 0.01, np.nan, np.inf, -np.inf, 81, -81, 80.5, 1, -1)
    now = np.zeros(num)
    dt = put(
        np.full(num, DT),
        0.1,
        0.5 * DT,
        0.5 * DT - 1e-9,
        1.5 * DT + 1e-9,
        0.074,
        0.026,
        np.inf,
        -1.0,
    )
    beat = put(-rng.uniform(0, 0.1, (num, n + 1)), 0.01, -0.110, -0.110 - 1e-9, -0.2, -np.inf, 1.0)
    inputs = GateInputs(
        m=m,
        counts=counts,
        frames=put(np.ones((num, n), int), 0.01, 0, 2, 3),
        beat=beat,
        nmt=put(np.full((num, n + 1), 5), 0.01, 0, 4, 6, 127),
        enable=some(0.8),
        centred=some(0.7),
        alive=~some(0.03),
        stop=some(0.03),
        error=some(0.03),
    )
    state = GateState(
        driving=some(0.6),
        spoken=some(0.5),
        wrong=rng.integers(0, 79, num),
        fault=rng.integers(0, 79, num),
        enable=some(0.5),
        time=now - dt,
        counter=rng.choice([0, 1, 127, 254, 255], num),
        counts=old,
        sent=sent,
        pace=np.where(some(0.4, n), 0.0, rng.uniform(0, 3, (num, n))),
        due=rng.choice([0.0, 0.5, 0.9], (num, n), p=[0.7, 0.2, 0.1]),
    )
    # what is owed: as much as may be owed, to the bit, and a bit more
    owed = [
        [plain_due(machine, GateState(*row(state, k)), counts[k, j], j)[1] for j in range(n)]
        for k in range(num)
    ]
    rest = 1.0 - (np.array(owed) - state.due)
    bit = np.nextafter(rest, rng.choice([-9.0, 9.0], (num, n)))
    return (
        state._replace(due=np.where(some(0.8, n), state.due, np.where(some(0.5, n), rest, bit))),
        inputs,
        now,
    )


def row(value: tuple[np.ndarray, ...], k: int) -> list[np.ndarray]:
    return [np.asarray(field)[k] for field in value]


def expected(machine: Machine, num: int, seed: int) -> tuple[tuple, list[tuple[GateState, bytes]]]:
    given = cases(machine, num, seed)
    state, inputs, now = given
    return given, [
        plain_gate(machine, GateState(*row(state, k)), GateInputs(*row(inputs, k)), float(now[k]))
        for k in range(num)
    ]


def promised(call: Callable[..., Any], *arguments: Any) -> Any:
    """What `call` gives; that it raises is a promise broken like any other."""
    try:
        return call(*arguments)
    except Exception as error:
        raise AssertionError(
            f"{getattr(call, '__name__', call)}: expected no exception, got {error!r}"
        ) from error


def agrees(
    module: types.ModuleType, machine: Machine, given: tuple, wanted: list, shape: tuple[int, ...]
) -> None:
    """The gate of `module` gives what the plain rewriting gave, in any leading shape."""
    folded = [
        type(part)(*(np.reshape(f, (*shape, *np.shape(f)[1:])) for f in part)) for part in given[:2]
    ]
    state, frame = promised(module.gate, machine, *folded, given[2].reshape(shape))
    assert frame.dtype == np.uint8 and frame.shape == (*shape, 8)
    frames = [list(f) for _, f in wanted]
    np.testing.assert_array_equal(
        frame.reshape(len(wanted), 8), frames
    )  # no diff of long lists by pytest
    for name, found in zip(GateState._fields, state):
        want = np.array([getattr(s, name) for s, _ in wanted])
        assert np.shape(found) == (*shape, *want.shape[1:]), name
        np.testing.assert_array_equal(np.reshape(found, want.shape), want, err_msg=name)


@pytest.mark.parametrize(
    ("machine", "seed"), [(BROKK_170, 0), (tight_machine(), 1), (tight_machine(), 2)]
)
def test_the_gate_is_what_its_promises_say(machine: Machine, seed: int) -> None:
    given, wanted = expected(machine, 3000, seed)
    agrees(gate_module, machine, given, wanted, (3000,))
    agrees(gate_module, machine, given, wanted, (4, 750))
    agrees(gate_module, machine, given, wanted, (3, 10, 100))
    seen = {(s.active_fault - 1) // 6 for s, _ in wanted if s.active_fault}
    assert seen == set(range(len(FAULTS))), "each fault comes up"
    moving = [f for s, f in wanted if s.driving and any(f[:5])]
    assert len(moving) > 300


def test_one_gate_alone_gives_what_many_give() -> None:
    (state, inputs, now), wanted = expected(BROKK_170, 50, 5)
    for k, (after, frame) in enumerate(wanted):
        found, bytes_ = gate(
            BROKK_170, GateState(*row(state, k)), GateInputs(*row(inputs, k)), now[k]
        )
        assert (
            bytes_.tobytes() == frame
            and found.driving == after.driving
            and found.active_fault == after.active_fault
        )
        assert found.sent.dtype == found.counts.dtype == int


def test_a_gate_starts_silent() -> None:
    for shape in ((), (3,), (2, 2)):
        s = gate_start(BROKK_170, shape)
        assert s.counts.shape == (*shape, 5, 2) and s.sent.shape == (*shape, 5, 8)
        assert (
            not np.any(s.driving)
            and not np.any(s.armed_once)
            and np.all(s.enable)
            and np.all(s.active_fault == 1)
        )
        assert np.all(s.time == -np.inf) and not np.any(s.latched_fault) and not np.any(s.counter)
        assert not np.any(s.counts) and not np.any(s.sent)
        assert all(f.shape == shape and f.dtype == bool for f in (s.driving, s.armed_once, s.enable))
        assert all(f.shape == shape and f.dtype == int for f in (s.active_fault, s.latched_fault, s.counter))
        assert s.counts.dtype == s.sent.dtype == int
        assert (
            s.pace.shape == s.due.shape == (*shape, 5) and not np.any(s.pace) and not np.any(s.due)
        )


def test_the_gate_never_raises_and_drives_on_no_nonsense() -> None:
    """Any number in any field of sound shape: no exception, whole frames, neutral unless all is sound."""
    rng = np.random.default_rng(4)
    machine, num, odd = BROKK_170, 2000, [np.nan, np.inf, -np.inf, 1e300, -1e300, 0.0, -1.0, 5e-324]
    (state, inputs, now), _ = expected(machine, num, 6)
    whole = [0, -1, 2**62, -(2**62), 2**31, 255, 128]

    def spoil(field: np.ndarray) -> np.ndarray:
        values = odd if field.dtype == float else whole if field.dtype == int else [True, False]
        chosen = rng.choice(np.array(values, field.dtype), field.shape)
        return np.where(rng.random(field.shape) < 0.05, chosen, field)

    state = state._replace(counter=rng.integers(0, 256, num))
    for _ in range(20):
        inputs = GateInputs(*map(spoil, inputs))
        spoiled = GateState(*map(spoil, state))._replace(counter=state.counter, sent=state.sent)
        with np.errstate(all="ignore"):
            after, frame = promised(gate, machine, spoiled, inputs, spoil(now))
        assert frame.dtype == np.uint8 and frame.shape == (num, 8)
        m = np.rint(decode_pwm(frame[:, :5]) * 127)
        assert (np.abs(m) <= 80 * np.array([j.driven for j in machine.joints])).all()
        assert not m[frame[:, 7] == 0].any() and set(np.unique(frame[:, 7])) <= {0, 1}
        sound = (
            np.isfinite(inputs.m).all(1) & (inputs.frames == 1).all(1) & (inputs.nmt == 5).all(1)
        )
        assert not (frame[:, 7] == 1)[~sound].any()
        assert after.due.dtype == float and after.driving.dtype == bool


# --- promises over sequences ------------------------------------------------------------------------


def sequences(num: int, ticks: int, seed: int) -> dict[str, int]:
    """Run `num` gates on random inputs and check every promise at every tick; what was seen how often."""
    machine, n = BROKK_170, BROKK_170.n
    rng = np.random.default_rng(seed)
    low, high = machine.column("q_min"), machine.column("q_max")
    state, driven = gate_start(machine, (num,)), np.array([j.driven for j in machine.joints])
    counts = np.rint(rng.uniform(low + 0.01, high - 0.01, (num, n)) / STEP).astype(int)
    seen = dict.fromkeys(["drove", "armed", "faulted", "released", "moved", "at_limit"], 0)
    now, pressed = np.zeros(num), np.zeros(num, bool)
    trusted_enable, latched, counter = np.ones(num, bool), np.ones(num, bool), np.zeros(num, int)
    for _ in range(ticks):

        def rare(p: float, *shape: int) -> np.ndarray:
            return rng.random((num, *shape)) < p

        now = now + np.where(
            rare(0.02), rng.choice([0.0, -1.0, 0.02, 0.08, 3.0], num), rng.uniform(0.03, 0.07, num)
        )
        pressed = np.where(rare(0.3), ~pressed, pressed)
        counts = counts + np.where(
            rare(0.01, n), rng.integers(-200, 200, (num, n)), rng.integers(-3, 4, (num, n))
        )
        m = np.where(driven, rng.integers(-80, 81, (num, n)), 0).astype(float)
        m = np.where(rare(0.01, n), rng.choice([np.nan, 81.0, -1e9, np.inf], (num, n)), m)
        inputs = GateInputs(
            m=m, counts=counts,
            frames=np.where(rare(0.01, n), rng.integers(0, 4, (num, n)), 1),
            beat=np.where(rare(0.01, n + 1), rng.choice([-np.inf, -9.0], (num, n + 1)), now[:, None] - 0.02),
            nmt=np.where(rare(0.01, n + 1), rng.integers(0, 128, (num, n + 1)), 5),
            enable=pressed, centred=rare(0.6), alive=~rare(0.01), stop=rare(0.01), error=rare(0.01),
        )  # fmt: skip
        before, last = state, state.sent[..., -1]
        state, frame = gate(machine, state, inputs, now)
        sent = np.rint(decode_pwm(frame[:, :5]) * 127).astype(int)
        q = counts * STEP
        sound = (
            inputs.alive & ~inputs.stop & ~inputs.error & (inputs.frames == 1).all(1)
            & (inputs.nmt == 5).all(1) & (now[:, None] - inputs.beat <= 0.11).all(1) & np.isfinite(m).all(1)
            & (np.abs(m) <= 80 * driven).all(1) & (q > low - 0.051).all(1) & (q < high + 0.051).all(1)
            & (np.abs(now - before.time - DT) < 0.0251)
        )  # fmt: skip
        enabled = frame[:, 7] == 1
        assert not (enabled & ~sound).any(), "anything wrong means neutral"
        assert not (sent[~enabled]).any(), "not enabled means neutral"
        assert (np.abs(sent) <= 80 * driven).all(), "limit, and locked joints stay"
        same = np.sign(sent) == np.sign(last)
        assert (np.abs(sent) <= np.where(same, np.abs(last), 0) + 40).all(), "slew"
        assert (
            not ((sent > 0) & (q >= high - 0.02)).any()
            and not ((sent < 0) & (q <= low + 0.02)).any()
        )
        assert (
            np.abs(sent) <= np.maximum(np.abs(last), np.nan_to_num(np.abs(m), posinf=1e9))
        ).all()
        assert not sent[(m == 0) & enabled[:, None]].any(), "zero at once"
        edge = pressed & ~trusted_enable & inputs.centred
        armed = enabled & ~before.driving
        assert not (armed & ~edge).any(), "armed by a fresh edge with centred stick only"
        assert not sent[armed].any(), "the tick that arms is neutral"
        assert not (enabled & ~pressed).any(), "dead-man switch"
        assert not (enabled & latched & ~edge).any(), "latched"
        latched = ~enabled
        assert (frame[:, 5] == (counter + 1) % 256).all(), "counter"
        assert not (state.armed_once & ~before.armed_once & ~armed).any(), "silent until armed"
        faulted = before.driving & ~enabled & ~sound
        assert (state.latched_fault[faulted] > 0).all() and (state.latched_fault[enabled] == 0).all()
        trusted_enable = np.where(inputs.alive & ~inputs.error, pressed, pressed | trusted_enable)
        counter = frame[:, 5].astype(int)
        found = (
            enabled,
            armed,
            faulted,
            before.driving & ~pressed & sound,
            sent.any(1),
            (q >= high - 0.02).any(1) & enabled,
        )
        for name, flags in zip(seen, found, strict=True):
            seen[name] += int(flags.sum())
    assert (checksum(frame[:200, [0, 1, 2, 3, 4, 5, 7]]) == frame[:200, 6]).all()
    return seen


def test_twenty_thousand_sequences_keep_every_promise() -> None:
    seen = sequences(20_000, 25, 0)
    assert min(seen.values()) > 500, seen  # the promises were put to the test


@pytest.mark.slow
def test_a_million_sequences_keep_every_promise() -> None:
    for seed in range(1, 51):
        sequences(20_000, 25, seed)


# --- mutants ----------------------------------------------------------------------------------------

SWAPS: dict[type, list[type]] = {
    ast.Add: [ast.Sub], ast.Sub: [ast.Add], ast.Mult: [ast.Add], ast.Div: [ast.Mult], ast.Mod: [ast.Add],
    ast.LShift: [ast.RShift], ast.RShift: [ast.LShift], ast.BitXor: [ast.BitOr], ast.BitAnd: [ast.BitOr],
    ast.BitOr: [ast.BitAnd], ast.FloorDiv: [ast.Mult], ast.Pow: [ast.Mult],
    ast.Lt: [ast.LtE, ast.Gt], ast.LtE: [ast.Lt, ast.Gt],
    ast.Gt: [ast.GtE, ast.Lt], ast.GtE: [ast.Gt, ast.Lt],
    ast.Eq: [ast.NotEq, ast.GtE, ast.LtE], ast.NotEq: [ast.Eq, ast.Gt, ast.Lt],
}  # fmt: skip
CALLS = {
    "minimum": "maximum",
    "maximum": "minimum",
    "all": "any",
    "any": "all",
    "ones": "zeros",
    "abs": "square",
}


def changes(node: ast.AST) -> Iterator[ast.AST]:
    """What a slip of the pen could make of one node."""
    if isinstance(node, ast.BinOp | ast.AugAssign):
        for other in SWAPS.get(type(node.op), []):
            yield replace_field(node, op=other())
    elif isinstance(node, ast.Compare):
        for k, op in enumerate(node.ops):
            for other in SWAPS.get(type(op), []):
                yield replace_field(node, ops=[*node.ops[:k], other(), *node.ops[k + 1 :]])
    elif isinstance(node, ast.UnaryOp):
        yield node.operand
    elif isinstance(node, ast.Constant) and isinstance(node.value, bool):
        yield ast.Constant(not node.value)
    elif isinstance(node, ast.Constant) and isinstance(node.value, int | float):
        yield ast.Constant(node.value + 1)
        if node.value:
            yield ast.Constant(node.value - 1 if isinstance(node.value, int) else 0.9 * node.value)
    elif isinstance(node, ast.Attribute) and node.attr in CALLS:
        yield replace_field(node, attr=CALLS[node.attr])
    elif isinstance(node, ast.IfExp):
        yield node.body
        yield node.orelse


def replace_field(node: ast.AST, **fields: object) -> ast.AST:
    changed = copy.copy(node)
    for name, value in fields.items():
        setattr(changed, name, value)
    return changed


def mutants() -> Iterator[tuple[str, types.CodeType]]:
    """The module of the gate with one slip each, in its functions and its numbers."""
    tree = ast.parse(inspect.getsource(gate_module))
    for part in tree.body:
        if not isinstance(part, ast.FunctionDef | ast.Assign):
            continue
        for node in ast.walk(part):
            for field, value in ast.iter_fields(node):
                if field in ("returns", "annotation", "args") and isinstance(node, ast.FunctionDef):
                    continue
                for place, child in (
                    enumerate(value) if isinstance(value, list) else [(None, value)]
                ):
                    if not isinstance(child, ast.AST):
                        continue
                    for changed in changes(child):
                        put(node, field, place, changed)
                        slip = f"{ast.unparse(child)} -> {ast.unparse(changed)}"
                        code = compile(ast.fix_missing_locations(tree), "mutant", "exec")
                        put(node, field, place, child)
                        yield f"line {getattr(child, 'lineno', 0)}: {slip}", code


def put(node: ast.AST, field: str, place: int | None, child: ast.AST) -> None:
    if place is None:
        setattr(node, field, child)
    else:
        getattr(node, field)[place] = child


def test_every_mutant_of_the_gate_is_killed() -> None:
    machine = tight_machine()
    suites = [(machine, *expected(machine, 1500, seed)) for seed in (11, 12)]
    joints = tuple(
        replace(j, encoder_zero=z, encoder_sign=s)
        for j, z, s in zip(
            BROKK_170.joints, (5, 4000, -7, 2**26 - 1, 0), (1, -1, -1, 1, -1), strict=True
        )
    )
    mounted = replace(BROKK_170, joints=joints)
    raws = np.random.default_rng(0).integers(0, 2**32, (200, 5))
    raws[:50] &= 0xFFF

    def examine(module: types.ModuleType) -> None:
        same = (
            np.testing.assert_array_equal
        )  # where CI is set, pytest spends hours on diffs of long lists
        same(promised(module.checksum, list(b"123456789")), 0x4B)
        same(len(module._CRC), 256)
        same([promised(module.checksum, [b]) for b in range(256)], crcs)
        same(promised(module.encoder_counts, mounted, raws), counts)
        same(promised(module.encoder_raw, mounted, counts), raw)
        same(promised(module.valve_frame, [80, -80], 7, 1), valve_frame([80, -80], 7, 1))
        same([promised(module.fault_name, mounted, code) for code in range(79)], names)
        for shape in ((), (2, 2)):
            started = promised(module.gate_start, machine, shape)
            for found, wanted in zip(started, gate_start(machine, shape), strict=True):
                same(found, wanted)
        for suite in suites:
            agrees(module, *suite, (3, 500))

    crcs = [bitwise_crc(bytes([b])) for b in range(256)]
    counts = encoder_counts(mounted, raws)
    raw = encoder_raw(mounted, counts)
    names = [fault_name(mounted, code) for code in range(79)]
    examine(gate_module)
    alive, total, raised = [], 0, 0
    for where, code in mutants():
        module, total = types.ModuleType("mutant"), total + 1
        try:
            with np.errstate(all="ignore"):
                promised(exec, code, module.__dict__)
                examine(module)
        except AssertionError as error:
            raised += "expected no exception" in str(error)
            continue
        alive.append(where)
    assert total > 300 and raised < 0.25 * total, (total, raised)
    assert not alive, f"{len(alive)} of {total}:\n" + "\n".join(alive)
