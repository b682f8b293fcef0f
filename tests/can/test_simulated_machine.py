"""The simulated machine frame by frame on a clock of its own."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.one_process import START, Recorder
from brokk_min.can.canopen import HEARTBEAT_PERIOD, WATCHDOG, Frame, valve_frame
from brokk_min.can.simulated_machine import FaultyMachine, SimulatedMachine, parse_fault, start_pose
from brokk_min.machine import BROKK_170

CONTROLLER = 16


class Machine(SimulatedMachine):
    """It begins at 100 s."""

    def __init__(self, plant=None):
        super().__init__(BROKK_170, START, 100.0, plant or Recorder())

    def take(self, can_id, data=b"", now=100.0):
        return self.receive(Frame(now, can_id, data))

    def valves(self, counter, *counts, enable=1, now=100.0, sync=True):
        """Send SYNC and a valve frame; the commands in force [counts]."""
        if sync:
            self.take(0x080, now=now)
        u = np.array([*counts, *[0] * (5 - len(counts))]) / 127
        data = valve_frame(u, counter, enable).tobytes()
        assert self.receive(Frame(now, BROKK_170.valve_frame_id, data)) == []
        return np.rint(127 * self.u).astype(int).tolist()


def driving():
    machine = Machine()
    machine.take(0x000, b"\1\0")
    machine.valves(7)
    assert machine.valves(8, 80, 0, -40) == [80, 0, -40, 0, 0]
    return machine


def test_advance__moves_and_beats_by_its_own_clock():
    machine = Machine()
    assert machine.next_step == pytest.approx(100.005)
    assert machine.advance(100.0 + 0.9 * HEARTBEAT_PERIOD) == []
    first = machine.advance(100.0 + HEARTBEAT_PERIOD + 1e-6)
    assert first == [(0x700 + node, bytes([127])) for node in (1, 2, 3, 4, 5, CONTROLLER)]
    machine.take(0x000, b"\1\2")
    beats = machine.advance(100.0 + 3 * HEARTBEAT_PERIOD + 1e-6)
    assert beats == 2 * [first[0], (0x702, bytes([5])), *first[2:]]
    assert machine.steps == len(machine.plant.u) == 30 and not np.any(machine.plant.u)
    np.testing.assert_allclose(machine.plant.q, [START] * 30)


def test_advance__moves_a_plant_of_ones_own_once_a_tick_by_the_command_that_held():
    """With each SYNC, which may be 2 ms early or late; without, by its own clock."""
    recorder = Recorder()
    machine = Machine(SimpleNamespace(reset=recorder.reset, step=recorder.step))
    assert machine.stepped.dt == 0.05
    machine.take(0x000, b"\1\0")
    for k, late in enumerate((0.0, -0.002, 0.002, 0.0, 0.002)):
        now = 100.02 + 0.05 * k + late
        machine.advance(now)
        machine.valves(k, 10 * k, now=now)
    assert np.rint(127 * np.array(recorder.u))[:, 0].tolist() == [0, 10, 20, 30]
    machine.advance(100.4)
    assert len(recorder.u) == 4 + 3


def test_receive__opens_valves_after_a_start_and_a_neutral_frame():
    machine = Machine()
    neutral = [0, 0, 0, 0, 0]
    assert machine.valves(3) == machine.valves(4, 50) == neutral  # not started yet
    machine.take(0x000, b"\1\0")
    assert machine.valves(255, 50) == neutral and not machine.enabled  # no neutral frame came
    assert machine.valves(0) == neutral and machine.enabled  # 255, then 0
    assert machine.valves(1, 50, 0, 0, 0, -80) == [50, 0, 0, 0, -80]
    assert machine.valves(2, 50, enable=0) == machine.valves(3, 50) == neutral  # neutral first
    assert machine.valves(4) == neutral and any(machine.valves(5, 50))
    machine.take(0x000, b"\1\0")  # to start what runs changes nothing
    assert machine.u.any() and machine.valves(6, 30)[0] == 30


def watchdog(machine):
    machine.valves(9, 80, now=100.01)
    machine.advance(100.01 + WATCHDOG - 0.001)
    assert machine.u.any()
    machine.advance(100.01 + WATCHDOG + 0.005)


FRAME = valve_frame(np.array([80, 0, 0, 0, 0]) / 127, 9, 1).tobytes()
MALFORMED = "valve frame with a wrong length or checksum"


@pytest.mark.parametrize(
    ("act", "reason"),
    [
        (lambda m: m.valves(10, 80), "valve frame with counter 10 after 8"),
        (lambda m: m.take(0x210, FRAME[:6] + b"\x00\x01"), MALFORMED),
        (lambda m: m.take(0x210, FRAME[:7]), MALFORMED),
        (lambda m: m.valves(9, 77, sync=False), "second valve frame after a SYNC, counter 9"),
        (lambda m: m.take(0x080) + m.take(0x080), "no valve frame between two SYNCs"),
        (lambda m: m.take(0x000, b"\2\x10"), None),
        (watchdog, "no valve frame for 0.15 s"),
    ],
    ids=["counter", "checksum", "short", "second", "missing", "stopped", "watchdog"],
)
def test_receive__closes_valves_until_a_start_and_a_neutral_frame(act, reason):
    machine = driving()
    act(machine)
    assert machine.reasons == [reason] * (reason is not None)
    assert not (machine.u.any() or machine.enabled) and machine.nmt[CONTROLLER] == 127
    assert not any(machine.valves(77)) and not any(machine.valves(78, 80))  # nobody started it
    machine.take(0x000, b"\1\x10")
    assert not any(machine.valves(200, 80)) and not any(machine.valves(201))  # any counter begins
    assert any(machine.valves(202, 80))


def test_start_pose__is_the_machines_or_the_middle():
    low, high = BROKK_170.column("q_min"), BROKK_170.column("q_max")
    np.testing.assert_array_equal(start_pose(BROKK_170), START)
    np.testing.assert_allclose(start_pose(replace(BROKK_170, q_start=())), (low + high) / 2)


ENCODER = {  # counts of q3 from SYNC to SYNC; the joint turns by a count a tick
    "off": [[], [], [], []],
    "stuck": [[8], [8], [8], [8]],
    "wrong": [[9 + 64], [10 + 64], [11 + 64], [12 + 64]],
    "slow": [[], [10], [], [12]],
    "delayed": [[], [9], [10], [11]],
    "intermittent": [[], [], [11], [12]],
    "ok": [[9], [10], [11], [12]],
}


@pytest.mark.parametrize("kind", ENCODER)
def test_faults__of_encoders_by_hand(kind):
    """From the 20th tick on to the 23rd; without a name all encoders fail."""
    faults = parse_fault(BROKK_170, f"{kind}@1.0") + parse_fault(BROKK_170, "q3:ok@1.2")
    machine = FaultyMachine(BROKK_170, START, 0.0, Recorder(), faults)
    machine.receive(Frame(0.0, 0x000, b"\1\0"))
    came, beats = [], []
    for k in range(1, 24 + 1):
        now = 0.05 * k + 0.01
        sent = machine.advance(now)
        machine.state = machine.state._replace(q=BROKK_170.encoder_step * (k - 11))
        sent += machine.receive(Frame(now, 0x080, b""))
        came.append([int.from_bytes(data, "little") for can_id, data in sent if can_id == 0x183])
        beats.append({can_id - 0x700 for can_id, _ in sent if can_id > 0x700})
    assert came[17:] == [[7], [8], *ENCODER[kind], [12, 13] if kind == "delayed" else [13]]
    alive = {CONTROLLER} if kind == "off" else {1, 2, 3, 4, 5, CONTROLLER}
    assert beats[18:] == [{1, 2, 3, 4, 5, CONTROLLER}, *4 * [alive], alive | {3}]


@pytest.mark.parametrize(
    ("kind", "counts", "reasons"),
    [
        ("off", [42, 0, 0, 0], ["no valve frame between two SYNCs"]),
        ("stuck", [0, 0, 0, 0], ["valve frame with counter 2 after 2"]),
        ("garbage", [0, 0, 0, 0], [MALFORMED]),
        ("delayed", [42, 43, 44, 45], []),
        ("ok", [43, 44, 45, 46], []),
    ],
)
def test_faults__of_the_valve_controller_by_hand(kind, counts, reasons):
    """Commands in force after each tick, and why the valve controller stopped first."""
    faults = parse_fault(BROKK_170, f"valves:{kind}@0.15")
    machine = FaultyMachine(BROKK_170, START, 0.0, Recorder(), faults)
    machine.receive(Frame(0.0, 0x000, b"\1\0"))
    found = []
    for k in range(7):
        now = 0.05 * k + 0.01
        machine.advance(now)
        machine.receive(Frame(now, 0x080, b""))
        u = np.array([(40 + k) * (k > 0), 0, 0, 0, 0]) / 127
        machine.receive(Frame(now, 0x210, valve_frame(u, k, 1).tobytes()))
        found.append(round(127 * machine.u[0]))
    assert found == [0, 41, 42, *counts]
    assert machine.reasons[:1] == reasons


@pytest.mark.parametrize(
    "text", ["stuck", "stuck@", "stuck@-1", "broken@1", "q9:stuck@1", "@1", ":off@1"]
)
def test_parse_fault__refuses_what_it_does_not_know(text):
    refusal = r"--fault: expected \[NAME:\]KIND@SECONDS, a name of .* 'valves'\], a kind of .* got "
    with pytest.raises(ValueError, match=f"^{refusal}{text}$"):
        parse_fault(BROKK_170, text)
