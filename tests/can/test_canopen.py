"""Bytes by hand and on all values, nodes; the libraries canopen and cantools as peers."""

import struct
from dataclasses import replace

import canopen
import cantools
import numpy as np
import pytest
from canopen.objectdictionary import ObjectDictionary, ODRecord, ODVariable, datatypes
from helpers_bus import eventually

from benchmarks.one_process import BASELINE, START, HoldingOperator, World, only, recording
from brokk_min.can.canopen import (
    Frame,
    Nodes,
    checksum,
    encoder_counts,
    encoder_raw,
    node_numbers,
    read_valve_frame,
    set_up_nodes,
    valve_frame,
)
from brokk_min.can.connection import open_bus
from brokk_min.can.simulated_machine import SimulatedMachine
from brokk_min.machine import BROKK_170
from examples import dbc

STEP = BROKK_170.encoder_step[0]
SLOW = replace(BROKK_170, name="slow", rate=5.0)
SLEW, *OTHERS = BROKK_170.joints
SLIDE = replace(SLEW, kind="prismatic", encoder_step=2e-4)
WIDE = replace(SLEW, q_min=-3.1, q_max=3.1)
SIXTH = replace(SLEW, name="q6", encoder_node=6)


def brokk(*joints):
    return replace(BROKK_170, joints=joints, q_start=())


def test_checksum__is_crc8_j1850():
    """By its check value, and by examples of AUTOSAR's CRC library."""
    assert checksum(list(b"123456789")) == 0x4B
    examples = [[0, 0, 0, 0], [0x0F, 0xAA, 0, 0x55], [0, 0xFF, 0x55, 0x11], [0xFF] * 4]
    assert checksum(examples).tolist() == [0x59, 0x79, 0xB8, 0x74]


def test_valve_frame__by_hand():
    frame = valve_frame(np.array([80, 0, -80, 50, -50]) / 127, 9, True)
    assert frame.tolist() == [80, 0, 175, 50, 205, 9, 0x95, 1]
    u, enable = read_valve_frame(BROKK_170, frame.tobytes())
    np.testing.assert_allclose(u * 127, [80, 0, -80, 50, -50])
    assert enable
    two = valve_frame(np.array([[1, -1], [0, 2]]) / 127, [3, 4], [False, True])
    assert two.tolist() == [[1, 254, 0, 0, 0, 3, 0xCC, 0], [0, 2, 0, 0, 0, 4, 0xB6, 1]]


def test_encoder_counts__is_the_inverse_of_encoder_raw_however_mounted():
    mountings = zip(BROKK_170.joints, (100, 4000, -7, 2**26 - 1, 0), (1, -1, -1, 1, 1), strict=True)
    machine = brokk(*(replace(j, encoder_zero=z, encoder_sign=s) for j, z, s in mountings))
    assert encoder_counts(machine, [101, 3999, 2**26 - 9, 999, 3]).tolist() == [1, 1, 2, 1000, 3]
    q = np.linspace(machine.column("q_min"), machine.column("q_max"), 501)
    counts = np.rint(q / STEP).astype(int)
    raw = encoder_raw(machine, counts)
    assert ((raw >= 0) & (raw < 2**26)).all()
    np.testing.assert_array_equal(encoder_counts(machine, raw), counts)
    np.testing.assert_array_equal(encoder_counts(machine, raw % 4096), counts)


def test_set_up_nodes__sets_up_the_encoders_and_starts_the_nodes():
    world, out = World(BASELINE, HoldingOperator()), []
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
    assert told == [(0x000, b"\x80\x00"), (0x000, b"\x01\x00")]
    first_setting = [data[:1] for _, data in out].index(b"\x2b")
    assert out.index(told[0]) < first_setting < out.index(told[1])


def test_set_up_nodes__waits_for_a_node_that_boots():
    world, out = World(BASELINE, HoldingOperator()), []
    world.upward = lambda *frame: [frame] * (world.time > 1.2)  # s; silent before
    world.downward = recording(out)
    world.drive.begin()
    objects = [data.hex()[2:8] for can_id, data in out if can_id == 0x601]
    assert objects[:5] == ["016500"] * 4 + ["001801"]


def changed(index, sub, value):
    """Node 4 answers with another value of one object."""
    address = struct.pack("<HB", index, sub)
    value = struct.pack("<I", value)
    return only(0x584, lambda data: [data[:4] + value if data[1:4] == address else data])


ABORT = only(0x584, lambda data: [b"\x80" + data[1:4] + struct.pack("<I", 0x06020000)])


@pytest.mark.parametrize(
    ("upward", "refusal"),
    [
        (changed(0x1800, 1, 0x80000184), "q4: .*1800:01: .* 0x184, switched on, .*x80000184"),
        (changed(0x1800, 1, 0x284), "q4: .*1800:01: .* 0x184, switched on, got 644 .0x284"),
        (changed(0x1A00, 0, 2), "q4: object 0x1A00:00: expected one object in TPDO1, got 2"),
        (changed(0x1A00, 1, 0x6030_01_10), "q4: .* 4 bytes of object 0x6004 .* .0x60300110"),
        (changed(0x6501, 0, 8192), "q4: object 0x6501:00: expected 4096 counts a turn, got 8192"),
        (ABORT, "node 4: object 0x6501:00: .*abort 0x06020000"),
        (lambda *frame: [], "node 1: object 0x6501:00: .* answer within 5.0 s, got none"),
    ],
)
def test_set_up_nodes__refuses_an_encoder_that_does_not_fit(upward, refusal):
    world = World(BASELINE, HoldingOperator())
    world.upward = upward
    with pytest.raises(ValueError, match=f"^{refusal}"):
        world.drive.begin()


@pytest.mark.parametrize(
    ("machine", "refusal"),
    [
        (brokk(SLEW, *OTHERS, SIXTH), "joints: expected at most 5 on a bus, got 6"),
        (replace(BROKK_170, valve_frame_id=0x583), "valve_frame_id: .* no other frame, got 0x583"),
        (SLOW, r"rate: expected 12 Hz or more \(watchdog\), got 5"),
        (
            brokk(SLIDE),
            "q1: expected revolute, with a range below 6.18 rad, on a bus, got prismatic",
        ),
        (brokk(WIDE), "q1: expected revolute, with a range below 6.18 rad, .* got revolute, 6.20"),
    ],
)
def test_machines_that_do_not_fit_the_bus__are_refused_on_both_its_sides(machine, refusal):
    with pytest.raises(ValueError, match=refusal):
        SimulatedMachine(machine, np.zeros(machine.n), 0.0)
    with pytest.raises(ValueError, match=refusal):
        set_up_nodes(None, machine)
    SimulatedMachine(replace(SLOW, rate=12.5), START, 0.0)


def test_nodes__take_in_frames_by_hand():
    """Cut frames, a fallen node with its toggle bit, and what is nobody's change nothing else."""
    nodes, neutral = Nodes(BROKK_170), valve_frame([0] * 5, 1, 1).tobytes()
    for can_id, data in (
        (0x181, b"\x01\x02\0\0"),
        (0x182, b"\xff\xff\xff\xff"),
        (0x183, b"\1\2\3"),
        (0x184, b"\3\0\0\0"),
        (0x184, b"\4\0\0\0"),
        (0x701, b"\x85"),
        (0x702, b""),
        (0x703, b"\5\5"),
        (0x710, b"\x7f"),
        (0x210, valve_frame(np.array([1.0, 0, -1.0, 0, 0]), 1, 1).tobytes()),
        (0x210, neutral[:7]),
        (0x211, neutral),
        (0x080, b""),
    ):
        nodes.update(Frame(7.0, can_id, data))
    assert nodes.raw.tolist() == [513, -1, -1, 4, -1] and nodes.frames.tolist() == [1, 2, 2, 2, 0]
    assert nodes.nmt.tolist() == [5, 0, 0, 0, 0, 127]
    assert np.isfinite(nodes.heartbeat).tolist() == [True, *[False] * 4, True]
    assert nodes.u.tolist() == [1, 0, -1, 0, 0] and nodes.enable and nodes.valve_time == 7.0
    assert (nodes.received, nodes.others) == (13, 3)
    nodes.start_tick()
    assert not nodes.frames.any() and (nodes.received, nodes.others) == (0, 0)


def dictionary():
    """As much of CiA 406 as the program asks of an encoder."""
    u8, u16, u32 = datatypes.UNSIGNED8, datatypes.UNSIGNED16, datatypes.UNSIGNED32
    objects = ObjectDictionary()
    for index, sub, kind, value in (
        (0x1017, 0, u16, 0),  # heartbeat
        (0x1800, 1, u32, 0x181),  # identifier of TPDO1
        (0x1800, 2, u8, 254),  # transmission type
        (0x1A00, 0, u8, 1),  # entries
        (0x1A00, 1, u32, 0x60040020),
        (0x6004, 0, u32, 1234),  # position
        (0x6501, 0, u32, 4096),  # counts of a turn
    ):
        if index not in objects:
            objects.add_object(ODRecord(f"{index:X}", index))
        entry = ODVariable(f"{index:X}:{sub}", index, sub)
        entry.data_type, entry.default = kind, value
        objects[index].add_member(entry)
    return objects


def test_set_up_nodes__sets_up_an_encoder_of_the_canopen_library():
    """SDO, heartbeat, NMT and TPDO are the library's."""
    node = canopen.LocalNode(1, dictionary())
    with canopen.Network() as network:
        network.connect(interface="virtual", channel="peers")
        network.add_node(node)
        network.subscribe(0x080, lambda *_: network.send_message(0x181, node.get_data(0x6004, 0)))
        with open_bus("virtual", "peers") as bus:
            set_up_nodes(bus, brokk(SLEW))
            assert node.get_data(0x1017, 0) == b"\x32\x00" and node.get_data(0x1800, 2) == b"\x01"
            eventually(lambda: node.nmt.state == "OPERATIONAL")
            nodes = Nodes(brokk(SLEW))
            bus.send(0x080, b"")
            nodes.listen(bus, bus.now() + 0.3)
    assert nodes.raw.tolist() == [1234] and nodes.nmt.tolist() == [5, 0]
    assert np.isfinite(nodes.heartbeat).tolist() == [True, False]


def test_dbc__describes_the_frames_that_the_program_uses():
    database = cantools.database.load_string(dbc.dbc(BROKK_170), "dbc", strict=True)
    *encoders, controller = node_numbers(BROKK_170)
    beats = {0x700 + node for node in (*encoders, controller)}
    used = {0x000, 0x080, 0x210, *beats, *(0x180 + node for node in encoders)}
    assert {message.frame_id for message in database.messages} == used
    frame = valve_frame(np.array([80, 0, -80, 20, -60]) / 127, 7, 1)
    decoded = database.decode_message(0x210, frame.tobytes())
    assert decoded.pop("checksum") == frame[6]
    commands = {"u_q1": 80, "u_q2": 0, "u_q3": 175, "u_q4": 20, "u_q5": 195}
    assert decoded == commands | {"counter": 7, "enable": 1}
    raw = int(encoder_raw(BROKK_170, np.full(5, -5))[1])
    assert database.decode_message(0x182, raw.to_bytes(4, "little")) == {"position": raw}
    assert database.decode_message(0x700 + controller, b"\x05") == {"state": 5}


def test_main__refuses_names_that_dbc_files_cannot_tell_apart(tmp_path):
    (tmp_path / "alike.py").write_text(
        "from dataclasses import replace\nfrom brokk_min.machine import BROKK_170 as m\n"
        "a, b, *rest = m.joints\n"
        "ALIKE = replace(m, joints=(replace(a, name='a 1'), replace(b, name='a-1'), *rest))\n"
    )
    with pytest.raises(SystemExit, match=r"^joints: expected names that differ in DBC files"):
        dbc.main(str(tmp_path / "a.dbc"), f"{tmp_path}/alike.py:ALIKE")
    assert not (tmp_path / "a.dbc").exists()
