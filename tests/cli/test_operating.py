"""The commands at a machine: controllers, the window, films, ONNX."""

import json

import numpy as np
import onnxruntime
import pytest
from helpers_bus import BASELINE, HoldingOperator, Virtual, World, only, random_policy
from helpers_cli import run
from helpers_machines import pids

from brokk_min.can.operator_input import JointJog, Joystick
from brokk_min.cli.operating import Drive, Play, status
from brokk_min.cli.options import WrongUse
from brokk_min.evaluation import baselines
from brokk_min.learning.policy import PolicyController, load_policy, save_policy
from brokk_min.machine import BROKK_170


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A policy that nobody trained, and gains beside it that nobody tuned."""
    path = tmp_path_factory.mktemp("policy")
    policy = random_policy("paper")
    save_policy(path / "policy.npz", policy, BROKK_170)
    known = pids(BROKK_170, policy.net)
    known["jacobian_pid_k0.1"].gains.kp[:] = 7.0
    meta = baselines.gains_metadata(BROKK_170, policy.net)
    baselines.write_gains(path / "gains.json", known, meta)
    return path


def test_drive__has_the_controller_that_is_named(folder, capsys):
    where = {"interface": "virtual", "channel": "v", "policy": folder / "policy.npz"}
    controllers = {
        name: Drive(**where, controller=name, joint="q1").find_controller(BROKK_170)
        for name in ("rl", "jacobian", "jog")
    }
    assert isinstance(controllers["rl"], PolicyController)
    assert controllers["jog"] == JointJog(BROKK_170, "q1", 12)
    assert (controllers["jacobian"].gains.kp == 7.0).all() and controllers["jacobian"].k == 0.1
    assert capsys.readouterr().out.endswith("gains.json\n")


def test_drive__refuses_to_jog_what_is_not_driven():
    drive = Drive(interface="virtual", channel="v", controller="jog", joint="q2")
    with pytest.raises(WrongUse, match=r"--joint: expected one of .*'q1', 'q3'.*, got q2"):
        drive.find_controller(BROKK_170)


def test_status__says_what_stopped_it_and_what_is_in_the_way():
    world = World(BASELINE, HoldingOperator())
    world.drive.begin()
    world.run(1.0)
    text = status(world.drive)
    assert text.startswith("driving, v goal +0.10 +0.00 +0.00, measured ")
    assert text.endswith("late 0.0 ms, skipped 0") and " q +0.0" in text
    world.upward = only(0x185, lambda data: [])
    world.run(0.2)
    assert status(world.drive).startswith("waiting, fault: q5: silent, v goal ")
    world.upward = only(0x703, lambda data: [])
    world.run(0.5)
    assert "fault: q5: silent, now q3: heartbeat lost, v goal" in status(world.drive)


def test_status__names_the_axis_of_a_stick_that_is_not_centred():
    """Axis 4 of some gamepads is a trigger, which rests at its end: the gate never gets armed."""
    device = Virtual()
    world = World(BASELINE, Joystick(BROKK_170))
    world.drive.begin()
    device.axis(4, -1.0)
    world.run(0.5)
    device.button(5, True)
    world.run(0.2)
    assert status(world.drive).startswith("ready, the stick is not centred: axis 4, v goal +0.00")
    device.axis(1, 1.0)
    world.run(0.2)
    assert "the stick is not centred: axis 1 and 4, v goal -" in status(world.drive)
    for axis in (1, 4):
        device.axis(axis, 0.0)
    device.button(5, False)
    world.run(0.2)
    device.button(5, True)
    world.run(0.2)
    assert status(world.drive).startswith("driving, v goal +0.00 +0.00 +0.00, measured")
    device.unplug()


def test_play__opens_the_window_with_policy_and_tuned_pid(folder, monkeypatch):
    shown = []
    monkeypatch.setattr("brokk_min.viewer.play.play", lambda *given: shown.append(given))
    Play(policy=folder / "policy.npz")()
    machine, controllers, plant = shown[0]
    assert machine is BROKK_170 and hasattr(plant, "step")
    policy, pid = controllers.values()
    assert isinstance(policy, PolicyController) and (pid.gains.kp == 7.0).all()


def test_replay__makes_a_film_of_the_log_of_a_drive(tmp_path, capsys):
    log = tmp_path / "run.log"
    world = World(JointJog(BROKK_170, "q4", 30), HoldingOperator(), log=log)
    world.drive.begin()
    world.run(1.0)
    world.bus.close()
    assert run(f"replay '{log}' --fps 2 --out '{tmp_path}/a.gif'") == 0
    assert (tmp_path / "a.gif").read_bytes().startswith(b"GIF8")
    assert run(f"replay '{log}' --out '{tmp_path}/a.mp4'") == 2
    assert "--out: expected a name in .gif, got" in capsys.readouterr().err


def test_export__gives_the_policys_actions_and_what_it_must_agree_on(folder, tmp_path, capsys):
    pytest.importorskip("onnxscript")
    out = tmp_path / "p.onnx"
    assert run(f"export --policy '{folder}/policy.npz' --out", out) == 0
    printed = capsys.readouterr()
    assert printed.out.startswith(f"{out}: observation (batch, obs) in") and not printed.err
    session = onnxruntime.InferenceSession(out)
    policy = load_policy(folder / "policy.npz", BROKK_170)
    observation = np.random.default_rng(0).standard_normal((7, 163), np.float32)
    (action,) = session.run(["action"], {"observation": observation})
    np.testing.assert_allclose(action, policy.act(observation), atol=1e-5)
    told = {k: json.loads(v) for k, v in session.get_modelmeta().custom_metadata_map.items()}
    assert told["driven"] == ["q1", "q3", "q4", "q5"] and told["interface"] == "paper"
    assert len(told["mean"]) == len(told["scale"]) == 163 and told["rate"] == 20.0
