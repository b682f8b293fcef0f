"""The simulated machine frame by frame, by hand, on a clock of its own."""

from __future__ import annotations

import struct
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from brokk_min.actuator import plant_reset, plant_step
from brokk_min.can import canopen as bus
from brokk_min.can.canopen import Frame
from brokk_min.can.safety_gate import checksum, encoder_raw
from brokk_min.can.simulated_machine import START, WATCHDOG, SimulatedMachine, serve, start_pose
from brokk_min.machine import BROKK_170

NODES = [*(joint.encoder_node for joint in BROKK_170.joints), BROKK_170.controller_node]
CONTROLLER = BROKK_170.controller_node


class Machine(SimulatedMachine):
    """It begins at 100 s and keeps what it records."""

    def __init__(self) -> None:
        self.tape: list[tuple[Any, ...]] = []
        super().__init__(BROKK_170, START, 100.0, lambda *a: self.tape.append(a))

    def nmt_(self, command: int, node: int = 0) -> list[tuple[int, bytes]]:
        return self.receive(Frame(100.0, bus.NMT, bytes([command, node])))

    def valves(
        self, counter: int, *counts: int, enable: int = 1, now: float = 100.0, spoil: int = 0
    ) -> np.ndarray:
        """Send a valve frame; the commands in force [counts]."""
        coded = [c if c >= 0 else 255 + c for c in (*counts, *[0] * (5 - len(counts)))]
        data = np.array([*coded, counter, 0, enable], np.uint8)
        data[6] = (int(checksum(np.delete(data, 6))) + spoil) % 256
        assert self.receive(Frame(now, BROKK_170.valve_frame_id, data.tobytes())) == []
        return np.rint(127 * self.u).astype(int)


def driving() -> Machine:
    machine = Machine()
    machine.nmt_(1)
    assert not machine.valves(7).any()
    assert machine.valves(8, 80, 0, -40).tolist() == [80, 0, -40, 0, 0]
    return machine


def test_it_boots_beats_and_moves_by_its_own_clock() -> None:
    machine = Machine()
    assert machine.boot() == [(0x700 + node, b"\x00") for node in NODES]
    assert [machine.wait(100.0 + s) for s in (0.0, 0.004, 0.5)] == pytest.approx(
        [0.005, 0.001, 0.0]
    )
    assert machine.advance(100.0 + 0.9 * bus.BEAT) == [] and machine.boot()
    beat = [(0x700 + node, bytes([127])) for node in NODES]
    assert machine.advance(100.0 + bus.BEAT + 1e-6) == beat
    machine.nmt_(1, NODES[1])
    beats = machine.advance(100.0 + 3 * bus.BEAT + 1e-6)
    assert (
        len(beats) == 12 and beats[:6] == beats[6:] and beats[1] == (0x700 + NODES[1], bytes([5]))
    )
    assert beats[0] == beat[0] and len(machine.tape) == round(3 * bus.BEAT / 0.005)
    times, commands, angles, valid = zip(*machine.tape, strict=True)
    np.testing.assert_allclose(times, 100.0 + 0.005 * np.arange(1, len(times) + 1))
    assert not np.any(commands) and set(valid) == {100.0} and np.allclose(angles, START)


def test_valves_follow_frames_in_turn_after_a_neutral_one() -> None:
    machine = Machine()
    assert not machine.valves(3).any() and not machine.valves(4, 50).any()  # not started yet
    machine.nmt_(1)
    assert not machine.valves(255, 50).any() and not machine.enabled  # no neutral frame came
    assert not machine.valves(0).any() and machine.enabled  # 255, then 0
    assert machine.valves(1, 50, 0, 0, 0, -80).tolist() == [50, 0, 0, 0, -80]
    assert (
        not machine.valves(2, 50, enable=0).any() and not machine.valves(3, 50).any()
    )  # neutral again first
    assert not machine.valves(4).any() and machine.valves(5, 50).any()
    machine.nmt_(1)  # starting what runs changes nothing
    assert machine.u.any() and machine.valves(6, 30)[0] == 30


def test_frames_that_are_no_good_trip_until_a_start_and_a_neutral_frame() -> None:
    for name in ("counter", "checksum", "short", "stop", "watchdog"):
        machine = driving()
        if name == "counter":
            assert not machine.valves(10, 80).any()
        elif name == "checksum":
            assert not machine.valves(9, 80, spoil=1).any()
        elif name == "short":
            machine.receive(Frame(100.0, BROKK_170.valve_frame_id, bytes(7)))
        elif name == "stop":
            assert machine.nmt_(2, CONTROLLER) == []
            assert machine.nmt[CONTROLLER] == 4
        else:
            machine.valves(9, 80, now=100.01)
            machine.advance(100.01 + WATCHDOG - 0.001)
            assert machine.u.any()
            machine.advance(100.01 + WATCHDOG + 0.005)
        assert not machine.u.any() and not machine.enabled, name
        assert machine.nmt[CONTROLLER] == (4 if name == "stop" else 127)
        assert (
            not machine.valves(77).any() and not machine.valves(78, 80).any()
        )  # nobody started it
        machine.nmt_(1, CONTROLLER)
        assert (
            not machine.valves(200, 80).any() and not machine.valves(201).any()
        )  # any counter may begin
        assert machine.valves(202, 80).any(), name


def test_nodes_change_their_state_alone_or_together() -> None:
    machine = Machine()
    assert machine.nmt_(1) == [] and set(machine.nmt.values()) == {5}
    for command, state, boots in (
        (2, 4, False),
        (128, 127, False),
        (129, 127, True),
        (130, 127, True),
    ):
        assert machine.nmt_(command, NODES[2]) == ([(0x700 + NODES[2], b"\x00")] if boots else [])
        assert machine.nmt[NODES[2]] == state and machine.nmt[NODES[1]] == 5
        machine.nmt_(1, NODES[2])
    assert machine.nmt_(7) == [] and set(machine.nmt.values()) == {5}
    assert machine.nmt_(129) == [(0x700 + node, b"\x00") for node in NODES]
    assert machine.receive(Frame(100.0, bus.NMT, b"\x01")) == [] and set(machine.nmt.values()) == {
        127
    }


def test_running_encoders_answer_a_sync_with_their_counts() -> None:
    machine = Machine()
    assert machine.receive(Frame(100.0, bus.SYNC, b"")) == []
    machine.nmt_(1, NODES[0])
    machine.nmt_(1, NODES[3])
    raw = encoder_raw(BROKK_170, np.rint(np.array(START) / BROKK_170.encoder_step).astype(int))
    wanted = [(0x180 + NODES[i], struct.pack("<I", raw[i])) for i in (0, 3)]
    assert machine.receive(Frame(100.0, bus.SYNC, b"")) == wanted


def test_objects_are_read_and_some_written() -> None:
    machine = Machine()

    def ask(
        command: int, where: tuple[int, int], value: int = 0, node: int = NODES[1]
    ) -> tuple[Any, ...]:
        ((can_id, data),) = machine.receive(
            Frame(0.0, 0x600 + node, struct.pack("<BHBI", command, *where, value))
        )
        assert can_id == 0x580 + node
        found = struct.unpack("<BHBI", data)
        assert found[1:3] == where
        return found[0], found[3]

    for where, value in (
        ((0x1000, 0), 406), (bus.BEAT_OBJECT, round(1000 * bus.BEAT)), (bus.SYNC_OBJECT, 1),
        (bus.RESOLUTION_OBJECT, 4096),
    ):  # fmt: skip
        assert ask(0x40, where) == (0x43, value)
    assert ask(0x40, (0x2000, 1)) == (0x80, 0x06020000) == ask(0x23, (0x2000, 1), 3)
    for command, value in ((0x23, 1234), (0x2B, 77), (0x2F, 5)):  # four, two and one byte
        assert ask(command, bus.BEAT_OBJECT, value) == (0x60, 0) and ask(0x40, bus.BEAT_OBJECT) == (
            0x43,
            value,
        )
    assert ask(0x23, bus.SYNC_OBJECT, 9) == (0x60, 0)
    assert ask(0x40, bus.SYNC_OBJECT, node=NODES[0]) == (0x43, 1)  # that of another node
    assert ask(0x23, bus.RESOLUTION_OBJECT, 8) == (0x80, 0x06010000) == ask(0x60, bus.BEAT_OBJECT)
    assert ask(0x40, bus.RESOLUTION_OBJECT) == (0x43, 4096)
    assert machine.receive(Frame(0.0, 0x600 + NODES[1], bytes(7))) == []
    assert machine.receive(Frame(0.0, 0x600 + CONTROLLER, bytes(8))) == []


def test_the_plant_moves_under_the_command_in_force() -> None:
    machine = driving()
    machine.advance(100.1001)
    state = plant_reset(BROKK_170, np.array(START))
    for _ in range(2):
        state = plant_step(BROKK_170, state, np.array([80, 0, -40, 0, 0]) / 127)
    np.testing.assert_allclose(machine.plant.q, state.q, atol=1e-12)
    assert len(machine.tape) == 20 and machine.tape[-1][1][0] == pytest.approx(80 / 127)


def test_it_is_served_until_it_is_told_to_stop() -> None:
    sent: list[tuple[int, bytes]] = []
    frames = [Frame(100.0, bus.NMT, b"\x01\x00"), None, Frame(100.0, bus.SYNC, b"")]
    waits: list[float] = []
    line: Any = SimpleNamespace(
        now=lambda: 100.001,
        send=lambda *a: sent.append(a),
        recv=lambda wait: waits.append(wait) or frames.pop(0),
    )
    raw = encoder_raw(
        BROKK_170, np.rint(np.array(START) / BROKK_170.encoder_step).astype(int)
    ).tolist()
    serve(Machine(), line, lambda: bool(frames))
    assert sent == [(0x700 + node, b"\x00") for node in NODES] + [
        (0x180 + node, struct.pack("<I", r)) for node, r in zip(NODES[:-1], raw, strict=True)
    ]
    assert waits == pytest.approx([0.004] * 3)
    sent.clear()
    frames[:] = [Frame(100.0, bus.NMT, b"\x81\x02")]  # heartbeats that are due come with the answer
    late: Any = SimpleNamespace(now=lambda: 100.0 + bus.BEAT + 1e-6, send=line.send, recv=line.recv)
    serve(Machine(), late, lambda: bool(frames))
    assert [can_id for can_id, _ in sent[6:]] == [*(0x700 + node for node in NODES), 0x702]


def test_it_starts_where_it_is_told_to_if_it_can() -> None:
    np.testing.assert_array_equal(start_pose(BROKK_170, ()), START)
    np.testing.assert_array_equal(
        start_pose(BROKK_170, [0.1, 0.5, 0.5, 1.5, 1.0]), [0.1, 0.5, 0.5, 1.5, 1.0]
    )
    low, high = BROKK_170.column("q_min"), BROKK_170.column("q_max")
    for end in (low, high):
        np.testing.assert_array_equal(start_pose(BROKK_170, end.tolist()), end)
    np.testing.assert_allclose(start_pose(replace(BROKK_170, name="other"), ()), (low + high) / 2)
    for wrong in ([9.0, 0.5, 0.5, 1.5, 1.0], [0.0, 0.5]):
        with pytest.raises(
            ValueError, match=r"^start: expected 5 angles within the joints' ranges, got \["
        ) as error:
            start_pose(BROKK_170, wrong)
        assert str(wrong) in str(error.value)
