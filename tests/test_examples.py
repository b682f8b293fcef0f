"""Each example has the geometry of its drawing, moves its tool, and runs the whole chain."""

import csv
import re
import shlex
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from brokk_min.__main__ import main
from brokk_min.actuator import PLANT
from brokk_min.cli.options import find_plant
from brokk_min.env import initial_state, measure, transition
from brokk_min.evaluation import baselines
from brokk_min.identification.logs import read_log
from brokk_min.jacobian import Gains, JacobianController, manipulability_threshold
from brokk_min.kinematics import forward_kinematics, jacobian, tool_position
from examples.mini_excavator import MINI_EXCAVATOR
from examples.seven_joints import SEVEN_JOINTS
from examples.telescopic_crane import TELESCOPIC_CRANE

ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / "examples"
PAGE = (ROOT / "docs" / "porting.md").read_text()
OWN = f"{EXAMPLES / 'own_plant.py'}:PLANT"
STARTS = {  # from where 0.15 m/s is feasible in all directions
    MINI_EXCAVATOR: (0.1, -0.5, 1.4, 0.8),
    TELESCOPIC_CRANE: (0.3, 0.5, 0.9),
    SEVEN_JOINTS: (0.2, 0.9, -1.0, -0.7, 0.1, 0.2, 0.0),
}
SHORT = {
    "collect": "--hours 0.01",
    "fit": "--steps 8 --batch-size 256",
    "train": "--total-steps 1024",
    "evaluate": "--commands commands.csv --starts starts.csv",
}


def poses(machine):
    return np.random.default_rng(0).uniform(
        machine.column("q_min"), machine.column("q_max"), (20, machine.n)
    )


def test_telescope__has_the_geometry_of_its_drawing():
    """Polar coordinates: the boom's length is 3 + q, in Pinocchio with a prismatic joint, too."""
    model = pin.Model()
    lift = pin.SE3(np.eye(3), np.array([0.0, 0.0, 1.2]))
    parent = model.addJoint(0, pin.JointModelRZ(), pin.SE3.Identity(), "slew")
    axis = np.array([0.0, -1.0, 0.0])
    parent = model.addJoint(parent, pin.JointModelRevoluteUnaligned(axis), lift, "lift")
    parent = model.addJoint(parent, pin.JointModelPX(), pin.SE3.Identity(), "telescope")
    tip = pin.SE3(np.eye(3), np.array([3.0, 0.0, 0.0]))
    tool = model.addFrame(pin.Frame("tool", parent, tip, pin.FrameType.OP_FRAME))
    data = model.createData()
    for q in poses(TELESCOPIC_CRANE):
        frames = forward_kinematics(TELESCOPIC_CRANE, q)
        r, z = (3 + q[2]) * np.cos(q[1]), 1.2 + (3 + q[2]) * np.sin(q[1])
        expected = [r * np.cos(q[0]), r * np.sin(q[0]), z]
        np.testing.assert_allclose(tool_position(frames), expected, atol=1e-12)
        pin.framesForwardKinematics(model, data, q)
        np.testing.assert_allclose(data.oMf[tool].translation, expected, atol=1e-12)
        J = pin.computeFrameJacobian(model, data, q, tool, pin.LOCAL_WORLD_ALIGNED)[:3]
        np.testing.assert_allclose(jacobian(frames), J, atol=1e-12)


def test_excavator__has_the_geometry_of_its_drawing():
    """Closed form: elevations are minus the sums of the angles, as positive is downward."""
    q = poses(MINI_EXCAVATOR)
    e = -np.cumsum(q[:, 1:], axis=1)
    lengths = np.array([1.80, 1.10, 0.60])
    r = 0.30 + (lengths * np.cos(e)).sum(axis=1)
    z = 0.75 + (lengths * np.sin(e)).sum(axis=1)
    p = np.stack([r * np.cos(q[:, 0]), r * np.sin(q[:, 0]), z], axis=1)
    np.testing.assert_allclose(tool_position(forward_kinematics(MINI_EXCAVATOR, q)), p, atol=1e-12)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize(
    ("machine", "plant"),
    [*((m, "analytic") for m in STARTS), (MINI_EXCAVATOR, OWN)],
    ids=["excavator", "crane", "seven joints", "own plant"],
)
def test_example__moves_its_tool_along_each_axis(machine, plant, axis):
    """By a PI controller that nobody tuned, for 2 s (the crane's slow valves: 4 s) at 0.15 m/s."""
    plant = PLANT if plant == "analytic" else find_plant(plant, machine)
    one = np.ones((1, len(machine.driven)))
    gains = Gains(one, 3 * one, 0 * one, 0.3 * one[:, :1])
    controller = JacobianController(machine, gains, 0.1, manipulability_threshold(machine))
    start = [STARTS[machine]]
    state, memory = (
        initial_state(machine, start, 0.15 * np.eye(3)[axis], plant),
        controller.start(1),
    )
    seconds = 4.0 if machine is TELESCOPIC_CRANE else 2.0
    for _ in range(round(seconds * machine.rate)):
        u, memory = controller(measure(machine, state.history, state.v_goal), memory)
        state = transition(machine, plant, state, u)
    moved = [tool_position(forward_kinematics(machine, q))[0] for q in (start, state.q)]
    moved = moved[1] - moved[0]
    assert moved[axis] > 0.06 * seconds and np.delete(np.abs(moved), axis).max() < 0.08, moved


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("port")
    for name in ("mini_excavator.py", "own_plant.py"):
        (path / name).write_text((EXAMPLES / name).read_text())
    (path / "commands.csv").write_text("sequence,time,vx,vy,vz\nup,0,0,0,0.15\nup,0.5,0,0,0\n")
    (path / "starts.csv").write_text("swing,boom,arm,bucket\n0.1,-0.5,1.4,0.8\n")
    return path


def test_porting_page__has_commands_that_run_one_after_the_other(folder, monkeypatch):
    """All but the last two, which need a bus and an operator."""
    monkeypatch.chdir(folder)
    for name, value in {"TUNING_RUNS": 1, "TUNING_SECONDS": 1.0, "GENERATIONS": 1}.items():
        monkeypatch.setattr(baselines, name, value)
    commands = [shlex.split(line) for line in re.findall(r"^brokk-min (.*)$", PAGE, re.M)]
    names = [words[0] for words in commands]
    assert names == ["collect", "inspect", "fit", "train", "evaluate", "machine", "drive"]
    for words in commands[:-2]:
        assert main([*words, *SHORT.get(words[0], "").split()]) == 0, words
    for words in commands[-2:]:
        words = ["nonsense" if word == "udp_multicast" else word for word in words]
        assert main(words) == 1


def test_porting_page__has_blocks_of_python_that_run(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(str(folder))
    rng, names = np.random.default_rng(0), ["swing", "boom", "arm", "bucket"]
    with open("theirs.csv", "w", newline="") as file:
        table = csv.writer(file)
        units = [f"{name}_{unit}" for name in names for unit in ("permille", "deg")]
        table.writerow(["drive", "ms", *units])
        table.writerows([["a", 10 * i, *rng.uniform(-90, 90, 8).round(1)] for i in range(100)])
    for block in re.findall(r"^```python\n(.*?)^```", PAGE, re.M | re.S):
        exec(compile(block, "docs/porting.md", "exec"), {})
    printed = re.findall(r"\[ *([\d.]+) +0\. +([\d.]+) *\]", capsys.readouterr().out)
    stated = re.findall(r"([\d.]+) m out and ([\d.]+) m high", PAGE)
    assert np.array(printed, float).tolist() == np.array(stated, float).tolist()
    assert len(stated) == 2
    log = read_log([Path("ours.csv")], 5, rate=25.0)
    assert log.joints == tuple(names) and len(log.recordings[0].q) == 25
    with open("theirs.csv") as file:
        first, *others = csv.DictReader(file)
    assert log.recordings[0].q[0, 2] == pytest.approx(np.deg2rad(float(first["arm_deg"])), rel=1e-6)
    u = [float(row["bucket_permille"]) / 1000 for row in (first, *others[:3])]  # a tick of 40 ms
    assert log.recordings[0].u[0, 3] == pytest.approx(np.average(u, weights=(3, 2, 3, 2)))
