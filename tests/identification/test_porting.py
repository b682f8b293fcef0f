"""The page on porting is true: all of its blocks run, on a machine that is no Brokk."""

from __future__ import annotations

import csv
import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from helpers_bus import World

from brokk_min.__main__ import main
from brokk_min.actuator import select_nets, speed_limits
from brokk_min.can import operator_input as wishes
from brokk_min.evaluation import baselines
from brokk_min.evaluation.sequences import axis_sequences, draw_starts
from brokk_min.identification.logs import read_log
from brokk_min.identification.net_file import load_net
from brokk_min.jacobian import JacobianController, join_gains, manipulability_threshold
from brokk_min.kinematics import forward_kinematics, frames, tool_position
from brokk_min.machine import Machine

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "porting.md").read_text()
COMMANDS = [shlex.split(line) for line in re.findall(r"^brokk-min (.*)$", PAGE, re.M)]
PYTHON = re.findall(r"^```python\n(.*?)^```", PAGE, re.M | re.S)
QUICK = {
    "collect": "--hours 0.01",
    "fit": "--steps 30",
    "train": "--total-steps 1024 --num-envs 16 --horizon 16 --minibatch-size 128 --threads 1",
    "evaluate": "--commands commands.csv --starts starts.csv",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("port")
    source = (ROOT / "examples" / "mini_excavator.py").read_text()
    (path / "mini_excavator.py").write_text(source)
    return path


@pytest.fixture(scope="module")
def mini() -> Machine:
    namespace: dict[str, Machine] = {}
    exec(compile((ROOT / "examples" / "mini_excavator.py").read_text(), "mini", "exec"), namespace)
    return namespace["MINI_EXCAVATOR"]


@pytest.fixture
def here(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(str(folder))
    return folder


def test_the_tool_is_where_a_tape_measure_finds_it(mini: Machine) -> None:
    """Closed form: elevations are minus the sums of the angles, as positive is downward."""
    rng = np.random.default_rng(0)
    q = rng.uniform(mini.column("q_min"), mini.column("q_max"), (50, 4))
    e = -np.cumsum(q[:, 1:], axis=1)
    lengths = np.array([1.80, 1.10, 0.60])
    r, z = 0.30 + (lengths * np.cos(e)).sum(1), 0.75 + (lengths * np.sin(e)).sum(1)
    wanted = np.stack([r * np.cos(q[:, 0]), r * np.sin(q[:, 0]), z], axis=1)
    np.testing.assert_allclose(tool_position(forward_kinematics(mini, q)), wanted, atol=1e-12)
    assert frames(mini, q).shape == (50, 5, 4, 4)


def test_the_fastest_motions_are_those_of_its_cylinders(mini: Machine) -> None:
    down, up = speed_limits(mini, np.linspace(mini.column("q_min"), mini.column("q_max"), 300))
    np.testing.assert_allclose(up.max(axis=0), mini.column("q_dot_up"), atol=0.01)
    np.testing.assert_allclose(-down.min(axis=0), mini.column("q_dot_down"), atol=0.01)


def test_the_example_differs_from_the_brokk_where_a_port_may_break(mini: Machine) -> None:
    from brokk_min.machine import BROKK_170

    names = (
        "n",
        "name",
        "names",
        "rate",
        "history",
        "velocity_samples",
        "encoder_bits",
        "pwm_limit",
        "tool_speed",
        "ground",
    )
    same = [
        n
        for n in (*names, "valve_frame_id", "controller_node")
        if getattr(mini, n) == getattr(BROKK_170, n)
    ]
    assert not same and not len(mini.locked)
    assert (mini.column("encoder_sign") < 0).any() and mini.column("encoder_zero").any()
    nodes = set(mini.column("encoder_node")) & set(BROKK_170.column("encoder_node"))
    assert not nodes


def test_the_blocks_of_python_run(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng, names = np.random.default_rng(0), ["swing", "boom", "arm", "bucket"]
    with open("theirs.csv", "w", newline="") as file:
        table = csv.writer(file)
        table.writerow(
            ["drive", "ms", *(f"{n}_{unit}" for n in names for unit in ("permille", "deg"))]
        )
        table.writerows([["a", 10 * i, *rng.uniform(-90, 90, 8).round(1)] for i in range(100)])
    for block in PYTHON:
        exec(compile(block, "docs/porting.md", "exec"), {})
    said = capsys.readouterr().out
    found = re.findall(r"\[ *([\d.]+) +0\. +([\d.]+) *\]", said)
    told = re.findall(r"([\d.]+) m out, ([\d.]+) m high", PAGE)
    assert np.array(found, float).tolist() == np.array(told, float).tolist() and len(told) == 2
    log = read_log([Path("ours.csv")], 5, rate=25.0)
    assert log.joints == tuple(names) and len(log.recordings[0].q) == 25
    with open("theirs.csv") as file:
        first = next(csv.DictReader(file))
    assert log.recordings[0].q[0, 2] == pytest.approx(np.deg2rad(float(first["arm_deg"])), rel=1e-6)
    assert log.recordings[0].u[0, 3] == pytest.approx(float(first["bucket_permille"]) / 1000)


def test_the_commands_run_one_after_the_other(here: Path, mini: Machine) -> None:
    sequences = axis_sequences(mini)
    start = draw_starts(mini, sequences, 1, np.random.default_rng(0))[0]
    Path("starts.csv").write_text(",".join(mini.names) + "\n" + ",".join(map(str, start)) + "\n")
    Path("commands.csv").write_text("sequence,time,vx,vy,vz\nout,0,0.2,0,0\nout,1,0,0,0\n")
    assert [words[0] for words in COMMANDS] == [
        "collect",
        "fit",
        "train",
        "evaluate",
        "machine",
        "drive",
    ]
    for words in COMMANDS[:4]:
        if words[0] == "evaluate":  # gains, so that nothing is tuned
            net = select_nets(mini, load_net(Path("net.npz")))
            about = baselines.gains_metadata(mini, net)
            baselines.write_gains(Path("gains.json"), baselines.baselines(mini, net), about)
        given = [word for word in words if word not in ("--hours", "1")]
        assert main([*given, *QUICK[words[0]].split()]) == 0, words
    runs = json.loads(Path("nets.json").read_text())
    net = load_net(Path("net.npz"))
    assert (net.rate, net.history, net.velocity_samples) == (
        25.0,
        mini.history,
        mini.velocity_samples,
    )
    assert runs["meta"]["machine"] == "mini_excavator" and runs["meta"]["plant"] == "net"
    assert all(np.isfinite(run["velocity_rmse"]) for run in runs["runs"])


def test_the_commands_of_the_bus_are_commands(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """They need two programs; here the options are read and what they name is not there."""
    for words in COMMANDS[4:]:
        offline = ["nonsense" if word == "udp_multicast" else word for word in words]
        assert main(offline) == 1
        said = capsys.readouterr().err
        assert "nonsense" in said or "policy.npz" in said or "joystick" in said


def test_it_is_driven_over_the_bus(mini: Machine) -> None:
    """Its own identifiers, zeros and signs: the tool moves as asked, 0.15 m/s outward, sideways and up."""
    gains = join_gains(mini, {"kp": 1.0, "ki": 3.0, "kd": 0.0, "feedback": 0.3, "ready": 0.0})
    controller = JacobianController(mini, gains, 0.1, manipulability_threshold(mini))
    start = (0.1, -0.5, 1.4, 0.8)
    for axis in range(3):
        goals = np.tile(0.15 * np.eye(3)[axis], (50, 1))  # 2 s
        script = wishes.Script(mini, goals)
        world = World(controller, script, mini, start=start)
        world.drive.begin()
        while world.drive.tick():
            pass
        world.close()
        assert script.done, world.drive.reason
        moved = tool_position(forward_kinematics(mini, world.simulated.plant.q)) - tool_position(
            forward_kinematics(mini, start)
        )
        assert moved[axis] > 0.15 and np.delete(np.abs(moved), axis).max() < 0.08, moved


@pytest.mark.parametrize(
    ("name", "status", "message"),
    [
        ("digger", 2, "expected one of ['brokk170'"),
        ("missing.py:MINI", 1, "missing.py"),
        ("broken.py:MINI", 1, "ZeroDivisionError"),
        ("mini_excavator.py:MAXI", 2, "expected a Machine MAXI in mini_excavator.py, got None"),
        ("mini_excavator.py:np", 2, "expected a Machine np"),
        ("mini_excavator.py", 2, "or FILE.py:NAME"),
    ],
)
def test_files_without_a_machine_are_refused(
    name: str, status: int, message: str, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("broken.py").write_text("1 / 0\n")
    assert main(["collect", "--machine", name, "--out", "x.csv"]) == status
    assert message in capsys.readouterr().err
    assert not Path("x.csv").exists()


def test_nets_for_a_machine_need_its_joints(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("foreign.csv").write_text(
        "run,time,u_a,q_a\n" + "".join(f"x,{i / 25},0.5,{i / 50}\n" for i in range(40))
    )
    name = "mini_excavator.py:MINI_EXCAVATOR"
    assert (
        main(["fit", "foreign.csv", "--test", "foreign.csv", "--machine", name, "--out", "n.npz"])
        == 1
    )
    assert "expected joints of --machine" in capsys.readouterr().err
