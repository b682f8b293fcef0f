"""Bytes by hand and on all values, nodes, and the canopen library as peer."""

import struct
import time
from contextlib import contextmanager
from dataclasses import replace

import canopen
import numpy as np
import pytest
from helpers_bus import START, ConstantCommand, HoldingOperator, World, dictionary, only, recording

from brokk_min import hw
from brokk_min.can.canopen import (
    OperatorInput,
    checksum,
    encoder_counts,
    encoder_raw,
    read_valve_frame,
    set_up_nodes,
    unpack_operator_input,
    valve_frame,
)
from brokk_min.can.connection import open_bus
from brokk_min.can.safety_gate import fault_name
from brokk_min.can.simulated_machine import SimulatedMachine
from brokk_min.machine import BROKK_170

STEP = BROKK_170.encoder_step[0]
SLOW = replace(BROKK_170, name="slow", rate=5.0)
SLEW = replace(BROKK_170.joints[0], q_min=-3.1, q_max=3.1)
SLIDE = replace(BROKK_170.joints[3], kind="prismatic", cylinder_base=0.0, encoder_step=2e-4)
SLIDE = replace(BROKK_170, joints=(*BROKK_170.joints[:3], SLIDE, BROKK_170.joints[4]))
WIDE = replace(BROKK_170, name="wide", joints=(SLEW, *BROKK_170.joints[1:]))
SIXTH = replace(BROKK_170.joints[4], name="q6", encoder_node=6)
SIX = replace(BROKK_170, name="six joints", joints=(*BROKK_170.joints, SIXTH), q_start=())


def bitwise_crc(data):
    """CRC-8 SAE J1850 straight from its definition, bit by bit."""
    crc = 0xFF
    for byte in data:
        for i in range(7, -1, -1):
            top = crc >> 7
            crc = crc << 1 & 0xFF
            if top ^ (byte >> i & 1):
                crc ^= 0x1D
    return crc ^ 0xFF


def test_checksum__is_crc8_j1850():
    assert bitwise_crc(b"123456789") == checksum(list(b"123456789")) == 0x4B
    every = np.arange(256)[:, None]
    assert checksum(every).tolist() == [bitwise_crc(bytes([byte])) for byte in range(256)]


def test_valve_frame__by_hand():
    body = [80, 0, 175, 50, 205, 9]
    frame = valve_frame([80, 0, -80, 50, -50], 9, True)
    assert frame.tolist() == [*body, bitwise_crc(bytes([*body, 1])), 1]
    u, enable = read_valve_frame(BROKK_170, frame.tobytes())
    np.testing.assert_allclose(u * 127, [80, 0, -80, 50, -50])
    assert enable
    two = valve_frame([[1, -1], [0, 2]], [3, 4], [False, True])
    assert two[:, :6].tolist() == [[1, 254, 0, 0, 0, 3], [0, 2, 0, 0, 0, 4]]
    assert two[:, 7].tolist() == [0, 1]


def test_encoder_counts__is_the_inverse_of_encoder_raw_however_mounted():
    mountings = zip(BROKK_170.joints, (100, 4000, -7, 2**26 - 1, 0), (1, -1, -1, 1, 1), strict=True)
    joints = [replace(joint, encoder_zero=zero, encoder_sign=s) for joint, zero, s in mountings]
    machine = replace(BROKK_170, joints=tuple(joints))
    assert encoder_counts(machine, [101, 3999, 2**26 - 9, 999, 3]).tolist() == [1, 1, 2, 1000, 3]
    q = np.linspace(machine.column("q_min"), machine.column("q_max"), 501)
    counts = np.rint(q / STEP).astype(int)
    raw = encoder_raw(machine, counts)
    assert ((raw >= 0) & (raw < 2**26)).all()
    np.testing.assert_array_equal(encoder_counts(machine, raw), counts)
    np.testing.assert_array_equal(encoder_counts(machine, raw % 4096), counts)


@pytest.mark.parametrize("flags", range(8))
def test_operator_input__survives_the_log_to_a_tenth_of_a_millimetre(flags):
    given = OperatorInput((0.3, -0.12346, 3.2), *(bool(flags & 1 << i) for i in range(3)))
    data = given.pack()
    assert data == struct.pack("<hhhB", 3000, -1235, 32000, flags)
    assert unpack_operator_input(data) == given._replace(v_goal=(0.3, -0.1235, 3.2))


@pytest.fixture
def world():
    return World(ConstantCommand(0, 0, 0, 0, 0), HoldingOperator())


def test_set_up_nodes__sets_up_the_encoders_and_starts_the_nodes(world):
    out = []
    world.downward = recording(out)
    world.drive.begin()
    assert [data.hex(" ") for can_id, data in out if can_id == 0x603] == [
        "40 01 65 00 00 00 00 00",  # read the resolution
        "40 00 18 01 00 00 00 00",  # the identifier of TPDO1,
        "40 00 1a 00 00 00 00 00",  # how many objects it has,
        "40 00 1a 01 00 00 00 00",  # and the first
        "2b 17 10 00 32 00 00 00",  # two bytes: a heartbeat every 50 ms
        "2f 00 18 02 01 00 00 00",  # one byte: a position at every SYNC
    ]
    told = [frame for frame in out if frame[0] < 0x600]
    assert told == [(0x000, b"\x80\x00"), (0x000, b"\x01\x00"), (0x080, b"")]
    first_setting = [data[:1] for _, data in out].index(b"\x2b")
    assert out.index(told[0]) < first_setting < out.index(told[1])
    assert set(world.simulated.nmt.values()) == {5}


def test_set_up_nodes__sets_up_encoders_that_run_and_refuse_settings_then(world):
    """Many take settings in the state "pre-operational" only."""
    answer = world.simulated._on_sdo

    def strict(node, data):
        if data[0] != 0x40 and world.simulated.nmt[node] == 5:
            return b"\x80" + data[1:4] + struct.pack("<I", 0x08000022)
        return answer(node, data)

    world.simulated._on_sdo = strict
    world.drive.begin()
    world.drive.begin()
    assert strict(3, b"\x2b" + bytes(7))[0] == 0x80


def changed(index, sub, value):
    """Node 4 answers with another value of one object."""
    address = struct.pack("<HB", index, sub)
    value = struct.pack("<I", value)
    return only(0x584, lambda data: [data[:4] + value if data[1:4] == address else data])


SPEED = 0x6030_01_10


@pytest.mark.parametrize(
    ("upward", "refusal"),
    [
        (changed(0x1800, 1, 0x80000184), r"got TPDO1 of node 4 is switched off \(0x1800:01 bit 31"),
        (changed(0x1800, 1, 0x284), r"TPDO1 of node 4 with identifier 0x184 .*, got 0x284"),
        (
            changed(0x1A00, 1, SPEED),
            r"node 4 with the 4 bytes of object 0x6004 .*has 2 bytes, of 0x6030",
        ),
        (changed(0x1A00, 0, 0), r"4 bytes of object 0x6004 .* one that has 0 bytes"),
        (only(0x184, lambda data: [data + b"12"]), "node 4 with 4 bytes .* one that has 6 bytes"),
        (only(0x184, lambda data: []), "TPDO1 of node 4 with 4 bytes after SYNC, got none"),
    ],
)
def test_set_up_nodes__refuses_an_encoder_that_would_not_send_its_position_alone(
    upward, refusal, world
):
    world.upward = upward
    with pytest.raises(ValueError, match=f"^q4: expected .*{refusal}"):
        world.drive.begin()


def test_set_up_nodes__names_all_that_an_encoder_sends(world):
    """Position and speed, as it reads them from the mapping."""
    mapping = {0: 2, 1: 0x6004_00_20, 2: SPEED}

    def both(data):
        entry = mapping.get(data[3]) if data[1:3] == b"\x00\x1a" else None
        return [data if entry is None else data[:4] + struct.pack("<I", entry)]

    world.upward = only(0x581, both)
    with pytest.raises(ValueError, match=r"^q1: .* one that has 6 bytes, of 0x6004, 0x6030$"):
        world.drive.begin()


def test_set_up_nodes__waits_for_an_encoder_that_starts_slowly(world):
    world.upward = lambda can_id, data: [(can_id, data)] * (can_id != 0x182 or world.time > 0.2)
    world.drive.begin()
    assert 0.2 < world.time < 0.3


def test_set_up_nodes__refuses_what_does_not_fit(world):
    world.upward = only(0x584, lambda data: [data[:4] + struct.pack("<I", 8192)])
    with pytest.raises(ValueError, match=r"q4: expected 4096 counts a turn .* node 4 .*got 8192"):
        world.drive.begin()
    world.upward = only(0x584, lambda data: [b"\x80" + data[1:4] + struct.pack("<I", 0x06020000)])
    with pytest.raises(ValueError, match=r"node 4: object 0x6501:00: .*abort 0x06020000"):
        world.drive.begin()
    world.upward = lambda can_id, data: []
    begun = world.time
    refusal = r"node 1: object 0x6501:00: expected an answer within 0.5 s, got none"
    with pytest.raises(ValueError, match=refusal):
        world.drive.begin()
    assert world.time - begun == pytest.approx(0.5, abs=0.002)


@pytest.mark.parametrize(
    ("machine", "refusal"),
    [
        (SIX, "joints: expected at most 5 on a bus, got 6"),
        (replace(BROKK_170, valve_frame_id=0x583), "valve_frame_id: .* no other frame, got 0x583"),
        (replace(BROKK_170, valve_frame_id=0x081), "no other frame, got 0x081"),  # EMCY of node 1
        (replace(BROKK_170, valve_frame_id=0x7FE), "no other frame, got 0x7FE"),  # in the log
        (SLOW, r"rate: expected 10 Hz or more \(watchdog\), got 5"),
        (SLIDE, "q4.kind: expected revolute on a bus, got prismatic"),
        (WIDE, r"q1\.q_max: expected a range 0.1 rad below a turn, got 6.20 rad"),
    ],
)
def test_machines_that_do_not_fit_the_bus__are_refused_on_both_its_sides(machine, refusal):
    with pytest.raises(ValueError, match=refusal):
        set_up_nodes(None, machine)
    with pytest.raises(ValueError, match=refusal):
        SimulatedMachine(machine, np.zeros(machine.n), 0.0)
    SimulatedMachine(replace(SLOW, rate=10.0), START, 0.0)


@contextmanager
def canopen_encoders(channel):
    """Five encoders of the canopen library, and a heartbeat of the valve controller."""
    positions = encoder_raw(BROKK_170, np.rint(np.array(START) / STEP).astype(int)).tolist()
    network = canopen.Network()
    network.connect(interface="virtual", channel=channel)
    nodes = [canopen.LocalNode(joint.encoder_node, dictionary()) for joint in BROKK_170.joints]
    for node, position in zip(nodes, positions, strict=True):
        network.add_node(node)
        node.nmt.state = "INITIALISING"
        node.nmt.state = "PRE-OPERATIONAL"
        node.set_data(0x1800, 1, struct.pack("<I", 0x180 + node.id))
        node.set_data(0x6004, 0, struct.pack("<I", position))

    def on_sync(can_id, data, timestamp):
        for node in nodes:
            if node.nmt.state == "OPERATIONAL":
                network.send_message(0x180 + node.id, node.get_data(0x6004, 0))

    network.subscribe(0x080, on_sync)
    heartbeat = network.send_periodic(0x710, b"\x05", 0.03)
    try:
        yield nodes
    finally:
        heartbeat.stop()
        network.disconnect()


def test_drive__drives_five_encoders_of_the_canopen_library():
    """SDO, heartbeat, NMT and TPDO are the library's; only the valve controller is ours."""
    with canopen_encoders("peers") as nodes, open_bus("virtual", "peers") as bus:
        operator = HoldingOperator()
        drive = hw.Drive(BROKK_170, ConstantCommand(0, 0, 0, 0, 0), bus, operator)
        drive.begin()
        assert [node.get_data(0x1017, 0) for node in nodes] == [b"\x32\x00"] * 5
        assert [node.get_data(0x1800, 2) for node in nodes] == [b"\x01"] * 5
        end = time.monotonic() + 20
        while not drive.gate.driving and time.monotonic() < end:  # a late answer: another edge
            operator.enable = False if operator.enable is None and operator.pressed else None
            drive.tick()
            drive.tick()
        assert drive.gate.driving, drive.reason
        assert {node.nmt.state for node in nodes} == {"OPERATIONAL"}
        np.testing.assert_allclose(drive.measured.q[0], START, atol=STEP / 1.9)
        nodes[2].nmt.stop_heartbeat()
        operator.enable = False
        fault, end = "", time.monotonic() + 20
        while fault != "q3: heartbeat lost" and time.monotonic() < end:
            drive.tick()
            fault = fault_name(BROKK_170, int(drive.gate.active_fault))
        assert fault == "q3: heartbeat lost" and not drive.gate.driving
