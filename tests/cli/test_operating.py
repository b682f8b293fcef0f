"""The commands at a machine: their controllers, and the line that they print."""

import os
import signal
import struct
import threading
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers_bus import Virtual
from helpers_cli import run

from benchmarks.one_process import BASELINE, HoldingOperator, World, only
from brokk_min.beyond.adaptation import valves
from brokk_min.beyond.strong_pid import StrongPID
from brokk_min.can.connection import open_bus
from brokk_min.can.drive_log import read_frames
from brokk_min.can.operator_input import Joystick
from brokk_min.cli.operating import DriveMachine, Simulate, find_controller, show, status
from brokk_min.evaluation.baselines import OPTIMISED, STRONGEST
from brokk_min.identification.valve_report import KEPT
from brokk_min.learning.policy import Policy
from brokk_min.machine import BROKK_170

RECTANGLE = Path(__file__).parents[2] / "docs" / "rectangle.csv"


def test_find_controller__is_the_policy_or_the_pid_with_the_gains_beside_it(folder):
    pid, net = find_controller(BROKK_170, folder / "policy.npz", pid=OPTIMISED)
    assert (pid.gains.ki == 8.0).all() and pid.k == 0.1
    strongest, _ = find_controller(BROKK_170, folder / "policy.npz", pid=STRONGEST)
    assert isinstance(strongest, StrongPID)
    (folder / "gains.json").write_text("of other nets")  # which the policy does not need
    policy, nets = find_controller(BROKK_170, folder / "policy.npz", pid=None)
    assert isinstance(policy, Policy) and nets.joints == net.joints == policy.net.joints


def test_machine__fails_on_request():
    """The encoder of q3 is off; the others answer SYNC."""
    came = set()

    def listen(bus):
        while bus.recv(20.0).id < 0x700:
            pass  # until the machine runs: its heartbeat
        bus.send(0x000, b"\1\0")
        bus.send(0x080, b"")
        came.update(frame.id for frame in (bus.recv(0.3) for _ in range(20)) if frame)
        os.kill(os.getpid(), signal.SIGTERM)

    with open_bus("virtual", "faults") as bus:
        thread = threading.Thread(target=listen, args=(bus,))
        thread.start()
        Simulate(interface="virtual", channel="faults", fault=("q3:off@0",))(BROKK_170)
        thread.join()
    nodes = (1, 2, 4, 5)
    assert came == {*(0x180 + n for n in nodes), *(0x700 + n for n in nodes), 0x710}


def test_status__says_what_stopped_it_and_what_is_in_the_way():
    world = World(BASELINE, HoldingOperator())
    world.drive.begin()
    world.run(1.0)
    assert status(world.drive).startswith("driving, v goal +0.10 +0.00 +0.00, measured ")
    world.upward = only(0x185, lambda data: [])
    world.run(0.2)
    assert status(world.drive).startswith("waiting, fault: q5: silent, v goal ")
    world.upward = only(0x703, lambda data: [])
    world.run(0.5)
    assert "fault: q5: silent, now q3: heartbeat lost, v goal" in status(world.drive)


def test_status__names_the_axis_of_a_stick_that_is_not_centred():
    """As that of a trigger, which rests at an end."""
    device = Virtual()
    device.axis(4, -1.0)
    world = World(BASELINE, Joystick(BROKK_170))
    world.drive.begin()
    world.run(0.2)
    assert "ready, the stick is not centred: axis 4, v goal +0.00 +0.00 +0.30" in status(
        world.drive
    )
    device.unplug()


def test_drive_adapt__learns_on_the_bus_logs_keeps_and_begins_with_what_it_knew(
    tmp_path, capsys, monkeypatch
):
    kept, log = tmp_path / "valves.json", tmp_path / "run.log"
    command = DriveMachine(interface="virtual", channel="v", adapt=True, valves=kept)
    controller = command.find_controller(BROKK_170)
    assert controller.known is None and controller.applies
    world = World(controller, HoldingOperator(), log=log)
    world.drive.begin()
    world.run(5.0)
    show(world.drive)
    command.keep_valves(BROKK_170, controller)
    printed = capsys.readouterr().out
    assert "driving" in printed and " s of motion" in printed
    world.drive.bus.flush()
    frames = {f.id: f.data for f in read_frames(log) if 0x7F0 <= f.id < 0x7FD}
    assert set(frames) == {0x7F0 + i for i in BROKK_170.driven}
    k, d = (of[0] for of in valves(controller.known))
    logged = np.array([struct.unpack("<hhhh", frames[key]) for key in sorted(frames)]) / 1e4
    np.testing.assert_allclose(logged, np.stack([k, d], axis=-1).reshape(-1, 4), atol=1e-4)
    again = command.find_controller(BROKK_170).known
    assert again.seconds.sum() == pytest.approx(KEPT * controller.known.seconds.sum())
    assert again.seconds.sum() > 1.0
    written = kept.read_bytes()
    drive = f"drive --interface virtual --channel nobody --command '{RECTANGLE}'"
    assert run(f"{drive} --adapt --valves {kept}") == 1  # it has learned nothing
    assert "expected an answer" in capsys.readouterr().err and kept.read_bytes() == written
    with suppress(OSError), open("/dev/full", "w", buffering=1) as lost:  # a closed terminal
        monkeypatch.setattr("sys.stdout", lost)
        with pytest.raises(OSError, match="No space left"):
            replace(command, valves=tmp_path / "new.json").keep_valves(BROKK_170, controller)
    monkeypatch.undo()
    assert (tmp_path / "new.json").read_bytes() == written
    assert run(f"{drive} --log {tmp_path}/run.csv") == 2
    assert "--log: expected a name as run.log: it is candump's text" in capsys.readouterr().err
    shadow = DriveMachine(interface="virtual", channel="v", shadow=True)
    assert not shadow.find_controller(BROKK_170).applies
    plain = DriveMachine(interface="virtual", channel="v").find_controller(BROKK_170)
    assert isinstance(plain, Policy)
