"""The simulated machine frame by frame on a clock of its own, and as a process that serves."""

import re
import struct
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from helpers_bus import SIX, START, Recorder

from brokk_min.can.canopen import HEARTBEAT_PERIOD, WATCHDOG, Frame, valve_frame, valve_frames
from brokk_min.can.simulated_machine import SimulatedMachine, start_pose
from brokk_min.machine import BROKK_170

NODES = [1, 2, 3, 4, 5, 16]
CONTROLLER = 16


class Machine(SimulatedMachine):
    """It begins at 100 s and keeps the reasons why it stops."""

    def __init__(self):
        self.reasons = []
        super().__init__(BROKK_170, START, 100.0, Recorder(), self.reasons.append)

    def take(self, can_id, data=b"", now=100.0):
        return self.receive(Frame(now, can_id, data))

    def nmt_(self, command, node=0):
        return self.take(0x000, bytes([command, node]))

    def valves(self, counter, *counts, enable=1, now=100.0, sync=True):
        """Send SYNC and a valve frame; the commands in force [counts]."""
        if sync:
            self.take(0x080, now=now)
        data = valve_frame([*counts, *[0] * (5 - len(counts))], counter, enable).tobytes()
        assert self.receive(Frame(now, BROKK_170.valve_frame_id, data)) == []
        return np.rint(127 * self.u).astype(int).tolist()


def driving():
    machine = Machine()
    machine.nmt_(1)
    machine.valves(7)
    assert machine.valves(8, 80, 0, -40) == [80, 0, -40, 0, 0]
    return machine


def test_advance__moves_and_beats_by_its_own_clock():
    machine = Machine()
    assert machine.nmt_(129) == [(0x700 + node, b"\x00") for node in NODES]
    assert machine.next_step == pytest.approx(100.005)
    assert machine.advance(100.0 + 0.9 * HEARTBEAT_PERIOD) == []
    first = machine.advance(100.0 + HEARTBEAT_PERIOD + 1e-6)
    assert first == [(0x700 + node, bytes([127])) for node in NODES]
    machine.nmt_(1, NODES[1])
    beats = machine.advance(100.0 + 3 * HEARTBEAT_PERIOD + 1e-6)
    assert beats == 2 * [first[0], (0x702, bytes([5])), *first[2:]]
    assert machine.steps == len(machine.plant.u) == 30 and not np.any(machine.plant.u)
    np.testing.assert_allclose(machine.plant.q, [START] * 30)


class Linear(NamedTuple):
    """A plant of one's own: each joint turns at 0.1 rad/s at full command."""

    q: np.ndarray = np.zeros(5)

    def reset(self, machine, q):
        return Linear(q)

    def step(self, machine, state, u):
        return Linear(state.q + 0.1 * u * machine.dt)


def test_advance__moves_any_plant_in_its_own_steps():
    machine = SimulatedMachine(BROKK_170, START, 0.0, Linear())
    machine.u = np.array([1.0, 0.0, -1.0, 0.0, 0.0])
    machine.enabled, machine.valid = True, 9.9
    machine.advance(10.0 + 1e-9)
    np.testing.assert_allclose(machine.state.q - START, machine.u)


def test_receive__opens_valves_after_a_start_and_a_neutral_frame():
    machine = Machine()
    neutral = [0, 0, 0, 0, 0]
    assert machine.valves(3) == machine.valves(4, 50) == neutral  # not started yet
    machine.nmt_(1)
    assert machine.valves(255, 50) == neutral and not machine.enabled  # no neutral frame came
    assert machine.valves(0) == neutral and machine.enabled  # 255, then 0
    assert machine.valves(1, 50, 0, 0, 0, -80) == [50, 0, 0, 0, -80]
    assert machine.valves(2, 50, enable=0) == machine.valves(3, 50) == neutral  # neutral first
    assert machine.valves(4) == neutral and any(machine.valves(5, 50))
    machine.nmt_(1)  # to start what runs changes nothing
    assert machine.u.any() and machine.valves(6, 30)[0] == 30


def test_receive__opens_valves_when_all_frames_of_a_tick_are_there():
    """Six joints have two frames: one alone moves nothing, and a SYNC without it closes all."""
    reasons = []
    machine = SimulatedMachine(SIX, [*START, 1.0], 0.0, report=reasons.append)
    machine.receive(Frame(0.0, 0x000, bytes([1, 0])))

    def tick(counter, *counts, lost=None):
        machine.receive(Frame(0.0, 0x080, b""))
        for k, frame in enumerate(valve_frames(counts, counter, 1)):
            if k != lost:
                machine.receive(Frame(0.0, 0x210 + k, frame.tobytes()))
        return np.rint(127 * machine.u).astype(int).tolist()

    rest = [0] * 6
    assert tick(7, *rest) == rest and machine.enabled
    assert tick(8, 50, 0, 0, 0, -60, 70) == [50, 0, 0, 0, -60, 70]
    assert tick(9, 20, 0, 0, 0, 0, 0, lost=1) == [50, 0, 0, 0, -60, 70]
    assert tick(10, 20, 0, 0, 0, 0, 0) == rest
    assert reasons == ["no valve frame between two SYNCs"]


def watchdog(machine):
    machine.valves(9, 80, now=100.01)
    machine.advance(100.01 + WATCHDOG - 0.001)
    assert machine.u.any()
    machine.advance(100.01 + WATCHDOG + 0.005)


FRAME = valve_frame([80, 0, 0, 0, 0], 9, 1).tobytes()
MALFORMED = "valve frame with a wrong length or checksum"


@pytest.mark.parametrize(
    ("act", "state", "reason"),
    [
        (lambda m: m.valves(10, 80), 127, "valve frame with counter 10 after 8"),
        (lambda m: m.take(0x210, FRAME[:6] + b"\x00\x01"), 127, MALFORMED),
        (lambda m: m.take(0x210, FRAME[:7]), 127, MALFORMED),
        (lambda m: m.valves(9, 77, sync=False), 127, "second valve frame after a SYNC, counter 9"),
        (lambda m: m.take(0x080) + m.take(0x080), 127, "no valve frame between two SYNCs"),
        (lambda m: m.nmt_(2, CONTROLLER), 4, None),
        (watchdog, 127, "no valve frame for 0.15 s"),
    ],
    ids=["counter", "checksum", "short", "second", "missing", "stopped", "watchdog"],
)
def test_receive__closes_valves_until_a_start_and_a_neutral_frame(act, state, reason):
    machine = driving()
    act(machine)
    assert machine.reasons == [reason] * (reason is not None)
    assert not machine.u.any() and not machine.enabled
    assert machine.nmt[CONTROLLER] == state
    assert not any(machine.valves(77)) and not any(machine.valves(78, 80))  # nobody started it
    machine.nmt_(1, CONTROLLER)
    assert not any(machine.valves(200, 80)) and not any(machine.valves(201))  # any counter begins
    assert any(machine.valves(202, 80))


@pytest.mark.parametrize(
    ("command", "state", "boots"), [(2, 4, 0), (128, 127, 0), (129, 127, 1), (130, 127, 1)]
)
def test_receive__changes_states_of_nodes_alone_or_together(command, state, boots):
    machine = Machine()
    assert machine.nmt_(1) == [] and set(machine.nmt.values()) == {5}
    assert machine.nmt_(command, 3) == boots * [(0x703, b"\x00")]
    assert machine.nmt == dict.fromkeys(NODES, 5) | {3: state}
    assert machine.nmt_(7) == [] and machine.nmt[1] == 5  # no command
    assert machine.receive(Frame(100.0, 0x000, b"\x02")) == [] and machine.nmt[1] == 5
    assert machine.nmt_(command) == [(0x700 + node, b"\x00") for node in boots * NODES]


@pytest.mark.parametrize(
    ("command", "address", "value", "answer"),
    [
        (0x40, (0x1017, 0), 0, (0x43, 50)),
        (0x40, (0x6501, 0), 0, (0x43, 4096)),
        (0x40, (0x2000, 1), 0, (0x80, 0x06020000)),
        (0x23, (0x2000, 1), 3, (0x80, 0x06020000)),
        (0x23, (0x1017, 0), 1234, (0x60, 0)),  # four bytes
        (0x2B, (0x1017, 0), 77, (0x60, 0)),  # two
        (0x2F, (0x1800, 2), 9, (0x60, 0)),  # one
        (0x60, (0x1017, 0), 0, (0x80, 0x06020000)),
    ],
)
def test_receive__reads_and_writes_objects(command, address, value, answer):
    machine = Machine()
    before = dict(machine.objects)
    request = struct.pack("<BHBI", command, *address, value)
    data = struct.pack("<BHBI", answer[0], *address, answer[1])
    assert machine.receive(Frame(0.0, 0x602, request)) == [(0x582, data)]
    written = {(2, *address): value} if answer[0] == 0x60 else {}
    assert machine.objects == before | written  # of this node alone
    assert machine.receive(Frame(0.0, 0x602, bytes(7))) == []
    assert machine.receive(Frame(0.0, 0x600 + CONTROLLER, bytes(8))) == []


def test_start_pose__is_the_given_one_the_machines_or_the_middle():
    low, high = BROKK_170.column("q_min"), BROKK_170.column("q_max")
    np.testing.assert_array_equal(start_pose(BROKK_170, ()), START)
    for pose in ([0.1, 0.5, 0.5, 1.5, 1.0], low.tolist(), high.tolist()):
        np.testing.assert_array_equal(start_pose(BROKK_170, pose), pose)
    np.testing.assert_allclose(start_pose(replace(BROKK_170, q_start=()), ()), (low + high) / 2)
    for pose in ([9.0, 0.5, 0.5, 1.5, 1.0], [0.0, 0.5]):
        refusal = rf"start: expected 5 angles within .*, got {re.escape(str(pose))}"
        with pytest.raises(ValueError, match=refusal):
            start_pose(BROKK_170, pose)
