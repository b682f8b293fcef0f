"""The commands at a machine: logs that are compared and converted, the window, films."""

import numpy as np
import pygame
import pytest
from helpers_bus import HoldingOperator, World
from helpers_cli import run

from brokk_min.can.operator_input import JointJog
from brokk_min.cli.operating import Drive, Play
from brokk_min.evaluation import baselines
from brokk_min.identification.files import SHIPPED
from brokk_min.identification.logs import read_log
from brokk_min.jacobian import JacobianController
from brokk_min.learning.policy import PolicyController, load_policy
from brokk_min.machine import BROKK_170

POLICY = SHIPPED / "brokk170" / "policy.npz"
GAINS = SHIPPED / "brokk170" / "gains.json"


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """Joint q4 jogs for two seconds, on a simulated machine and an injected clock."""
    path = tmp_path_factory.mktemp("drive") / "run.log"
    world = World(JointJog(BROKK_170, "q4", 30), HoldingOperator(), log=path)
    world.drive.begin()
    world.run(2.0)
    world.bus.close()
    return path


@pytest.mark.parametrize(
    ("name", "kind"),
    [("rl", PolicyController), ("jacobian", JacobianController), ("jog", JointJog)],
)
def test_drive__has_the_controller_that_is_named(name, kind, tmp_path):
    copy = tmp_path / "p.npz"  # without gains beside it
    copy.write_bytes(POLICY.read_bytes())
    controller = Drive(policy=copy, controller=name, gains=GAINS)._controller(BROKK_170)
    assert isinstance(controller, kind) and getattr(controller, "k", 0.1) == 0.1


def test_drive__sends_the_frames_of_a_log_again(log, capsys):
    jog = "drive --controller jog --joint q4 --counts"
    assert run(f"{jog} 30 --replay", log) == 0
    printed = capsys.readouterr().out
    same, of, sent = printed.removeprefix(f"{log}: ").split()[:3]
    assert (same, of) == (sent, "of")
    assert int(sent) > 30
    assert run(f"{jog} 31 --replay", log) == 1
    assert "expected the frames of the log, got " in capsys.readouterr().err


def test_convert__makes_a_log_for_fit(log, tmp_path, capsys):
    out = tmp_path / "log.csv"
    assert run(f"convert '{log}' --out", out) == 0
    (recording,) = read_log([out], 4).recordings
    assert np.abs(recording.u[:, 3]).max() == pytest.approx(30 / 127)
    assert not recording.u[:, :3].any()
    assert capsys.readouterr().out == f"{out}: 1 recordings of q1, q2, q3, q4, q5\n"


def test_export__writes_an_onnx_file(tmp_path, capsys):
    out = tmp_path / "p.onnx"
    assert run(f"export --policy '{POLICY}' --out", out) == 0
    assert b"observation" in out.read_bytes()
    assert capsys.readouterr().out.startswith(f"{out}: observation (batch, obs) in")


def test_play__has_policy_and_tuned_baseline(tmp_path, capsys):
    net = load_policy(POLICY, BROKK_170).net
    tuned = baselines.read_gains(GAINS, BROKK_170, net)["jacobian_pid_k0.1"]
    copy = tmp_path / "p.npz"
    copy.write_bytes(POLICY.read_bytes())
    for command, gains in (
        (Play(), GAINS),
        (Play(policy=copy), None),
        (Play(policy=copy, gains=GAINS), GAINS),
    ):
        controllers = command.controllers(BROKK_170)
        jacobian = controllers["jacobian"]
        assert isinstance(controllers["rl"], PolicyController)
        assert isinstance(jacobian, JacobianController) and jacobian.k == 0.1
        assert np.array_equal(jacobian.gains.kp, tuned.gains.kp) == (gains is not None)
        expected = f"gains of the Jacobian controller: {gains or 'set by hand'}\n"
        assert capsys.readouterr().out == expected


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """Half a second of the package's policy and gains, from one of the machine's own starts."""
    folder = tmp_path_factory.mktemp("runs")
    (folder / "c.csv").write_text("sequence,time,vx,vy,vz\nup,0,0,0,0.1\nup,0.5,0,0,0\n")
    out = folder / "runs.json"
    assert run(f"evaluate --commands '{folder}/c.csv' --num-starts 1 --json", out) == 0
    return out


def test_replay__shows_results_and_logs(results, log, monkeypatch):
    """A window that is closed at once."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    for shown in (f"'{results}'", f"'{results}' '{log}' --size 800 600"):
        pygame.display.init()
        pygame.event.post(pygame.event.Event(pygame.QUIT))
        assert run(f"replay {shown} --controllers rl") == 0
    assert not pygame.display.get_init()


def test_replay__refuses_runs_that_the_results_do_not_have(results, capsys):
    for wrong in ("--sequence down", "--start 1", "--start -1"):
        assert run(f"replay '{results}' --controllers rl {wrong}") == 2
        assert "expected some of ['up'], of ['rl'] and below 1, got " in capsys.readouterr().err
