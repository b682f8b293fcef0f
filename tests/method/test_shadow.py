"""A drive that only listens, beside a remote control: no frame leaves, and what it tells."""

from dataclasses import replace
from functools import partial

import can
import numpy as np
import pytest
from helpers_cli import run

from benchmarks.one_process import (
    START,
    ConstantCommand,
    HoldingOperator,
    World,
    only,
    recording,
    unchanged,
)
from brokk_min._files import SHIPPED
from brokk_min.can.canopen import Frame, valve_frame
from brokk_min.can.drive_log import log_for_fit, read_frames
from brokk_min.cli.operating import status
from brokk_min.learning.policy import POLICIES, load_policy
from brokk_min.machine import BROKK_170
from brokk_min.shadow import Shadow

POLICY = load_policy(SHIPPED / BROKK_170.name / POLICIES["rl"], BROKK_170)
Q4 = 3


class RemoteControl:
    """The machine's own, as `World.noise`: SYNC each `period` [s], valve frames after it."""

    delay = 0.004  # s, of the valve frames

    def __init__(self, world, command, period):
        self.world, self.command, self.period = world, command, period
        self.count = self.syncs = 0
        world.simulated.receive(Frame(0.0, 0x000, b"\x01\x00"))

    def __call__(self):
        if self.world.time >= (self.syncs + 1) * self.period:
            self.syncs += 1
            yield 0x080, b""
        if self.world.time >= (self.count + 1) * 0.05 + self.delay:
            self.count += 1
            yield 0x210, valve_frame(self.command(self.count), self.count % 256, 1).tobytes()


def to_and_fro(joint, tick):
    """Somebody moves a joint with the remote control."""
    return 40 / 127 * ((tick > 20) - 2 * (tick > 50) + (tick > 90)) * (np.arange(5) == joint)


def shadowed(machine=BROKK_170, controller=None, operator=None, log=None, sync=False, period=0.05):
    """A world with a remote control and a shadow, and the frames that leave the shadow."""
    controller = controller or ConstantCommand(0, 0, 0, 10, 0)
    world, left = World(controller, operator, log=log), []
    world.noise = RemoteControl(world, partial(to_and_fro, Q4), period)
    world.downward = recording(left)
    world.drive = Shadow(machine, controller, world.bus, operator, sync)
    world.drive.begin()
    return world, left


def correlation(drive, joint=Q4):
    would, sent = np.array(drive.pairs)[:, :, joint].T
    return np.corrcoef(would, sent)[0, 1]


def test_shadow__compares_and_logs_what_it_would_send_and_sends_nothing(tmp_path):
    world, left = shadowed(controller=POLICY, log=tmp_path / "run.log")
    world.run(6.0)
    world.bus.close()
    drive = world.drive
    assert left == [] and world.simulated.enabled
    assert len(drive.pairs) > 100 and drive.ticks == pytest.approx(120, abs=3)
    assert correlation(drive) > 0.6
    _, sent = np.array(drive.pairs).swapaxes(0, 1)
    assert {40 / 127, 0.0, -40 / 127} == set(sent[:, Q4]) and not np.delete(sent, Q4, axis=1).any()
    frames = list(read_frames(tmp_path / "run.log"))
    ids = [frame.id for frame in frames]
    assert ids.count(0x210) == world.noise.count  # those of the remote control alone
    logged = [frame.data for frame in frames if frame.id == 0x7FE and frame.data[7:] == b"\x01"]
    expected = [valve_frame(would, 0, 1).tobytes()[:5] for would, _ in drive.pairs]
    assert [data[:5] for data in logged][: len(expected)] == expected
    (recorded,) = log_for_fit(BROKK_170, frames).recordings  # the shadow as a record for `fit`
    assert set(np.rint(127 * recorded.u[:, Q4])) == {40, 0, -40}
    told = " ".join(f"{x:+.2f}" for x in drive.pairs[-1][0])
    assert f"would send {told}, sent +0.00 +0.00 " in status(drive)


def test_shadow__tells_an_encoder_of_the_wrong_sign():
    """The policy disagrees with what causes the motion: the reading falls where it should rise."""
    j = 2
    joints, zero = [*BROKK_170.joints], round(2 * START[j] * 4096 / 6.283)
    joints[j] = replace(joints[j], encoder_sign=-1, encoder_zero=zero)
    world, left = shadowed(replace(BROKK_170, joints=tuple(joints)), POLICY)
    world.noise.command = partial(to_and_fro, j)
    world.run(6.0)
    assert left == [] and correlation(world.drive, j) < -0.5


def test_report__by_hand():
    world, _ = shadowed()
    numbers = ((1, 4), (2, 2), (3, 3))
    pairs = [([0, 0, 0, m, 5], [0, 0, 9, n, 5]) for m, n in numbers]
    world.drive.pairs = [(np.array(a) / 100, np.array(b) / 100) for a, b in pairs]
    world.drive.faults["q3: jumped"], world.drive.ticks = 2, 9
    assert world.drive.report().splitlines() == [
        "compared in 3 of 9 ticks, in per cent of full command:",
        "  q1: correlation none, mean difference +0.0",
        "  q3: correlation none, mean difference -9.0",
        "  q4: correlation -0.50, mean difference -1.0",
        "  q5: correlation none, mean difference +0.0",
        "no valve frame with identifier 0x210 came",
        "the gate would have stopped 2 ticks: q3: jumped",
    ]


@pytest.mark.parametrize("period", [0.01, 0.025, 0.05])
def test_shadow__follows_the_positions_that_somebody_else_asks_for(period):
    """Heartbeats may end: nobody has set them up."""
    world, left = shadowed(period=period)
    world.noise.command = lambda tick: np.zeros(5)
    world.upward = lambda i, data: [(i, data)] * (i < 0x700 or (i < 0x710 and world.time < 1))
    world.run(4.0)
    assert left == [] and len(world.drive.pairs) == pytest.approx(80, abs=5)
    assert world.drive.faults.total() <= 2  # until it has found the first positions


def test_shadow__agrees_with_somebody_who_sends_what_it_would():
    """A command is compared with the one that is sent in the same tick, not in the next."""
    controller = ConstantCommand(0, 0, 0, 0, 0)
    controller.act = lambda: controller.m.__setitem__(Q4, 40 * np.sin(7 * world.time))
    world, left = shadowed(controller=controller)
    world.noise.delay = 0.02
    world.noise.command = lambda tick: world.drive.gate.sent[:, -1]
    world.run(3.0)
    assert left == [] and len(world.drive.pairs) > 50
    assert "q4: correlation +1.00, mean difference +0.0" in world.drive.report()
    would, sent = np.array(world.drive.pairs).swapaxes(0, 1)
    np.testing.assert_array_equal(would[2:], sent[2:])


def test_shadow__finds_the_faults_of_the_gate_and_goes_on():
    world, left = shadowed()
    world.run(1.5)
    assert world.drive.history[0, Q4, 2, -1] * 127 == pytest.approx(40)  # what was sent
    compared = len(world.drive.pairs)
    world.upward = only(0x183, lambda data: [])
    world.run(0.5)
    world.upward = unchanged
    world.run(1.0)
    assert left == [] and 5 <= world.drive.faults["q3: silent"] <= 12
    assert set(world.drive.faults) == {"q3: silent"}  # the others are heard all the time
    assert len(world.drive.pairs) > compared + 10


def test_shadow__sends_sync_and_starts_nodes_if_it_is_asked_to():
    world, left = shadowed(operator=HoldingOperator(), sync=True, period=np.inf)
    world.run(2.0)
    assert {can_id for can_id, _ in left} == {0x000, 0x080}
    assert left[0] == (0x000, b"\x01\x00") and len(left) == pytest.approx(41, abs=2)
    assert len(world.drive.pairs) > 30 and world.drive.operator_input.v_goal == (0.1, 0.0, 0.0)


def test_drive_shadow__sends_nothing_until_it_gives_up(tmp_path, capsys, monkeypatch):
    """Not even SYNC and the start of the nodes, for which it waits here in vain."""
    monkeypatch.setattr("brokk_min.can.operator_input.PATIENCE", 0.5)
    goals = tmp_path / "c.csv"
    goals.write_text("sequence,time,vx,vy,vz\na,0,0.1,0,0\na,0.5,0,0,0\n")
    with can.Bus("shadowed", interface="virtual") as others:
        where = "--interface virtual --channel shadowed"
        assert run(f"drive --shadow {where} --command '{goals}' --log '{tmp_path}/run.log'") == 1
        assert others.recv(0.0) is None
    assert {frame.id for frame in read_frames(tmp_path / "run.log")} == {0x7FD, 0x7FE, 0x7FF}
    assert "compared in 0 of " in capsys.readouterr().out
