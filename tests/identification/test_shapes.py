"""Other shapes run through the whole chain: a telescope at 10 Hz, seven joints at 100 Hz."""

import json
from functools import partial
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from helpers_bus import tool_moved
from helpers_cli import run

from brokk_min.cli.options import find_machine
from brokk_min.env import TaskConfig
from brokk_min.evaluation import baselines
from brokk_min.identification.net_file import load_net, select_nets
from brokk_min.kinematics import forward_kinematics, jacobian, tool_position

EXAMPLES = Path(__file__).parents[2] / "examples"
STARTS = {  # from where 0.15 m/s for a second is feasible in all directions
    "telescopic_crane": (0.3, 0.5, 0.9),
    "seven_joints": (0.2, 0.9, -1.0, -0.7, 0.1, 0.2, 0.0),
}
QUICK = {
    "collect": "--hours 0.004",
    "fit": "--steps 10 --batch-size 256",
    "train": "--total-steps 512 --num-envs 16 --horizon 8 --minibatch-size 64 --threads 1",
}


def example(name):
    return find_machine(f"{EXAMPLES / name}.py:{name.upper()}")


def test_telescope__has_the_geometry_of_its_drawing():
    """Polar coordinates: the boom's length is 3 + q, in Pinocchio with a prismatic joint, too."""
    crane = example("telescopic_crane")
    model = pin.Model()
    lift = pin.SE3(np.eye(3), np.array([0.0, 0.0, 1.2]))
    parent = model.addJoint(0, pin.JointModelRZ(), pin.SE3.Identity(), "slew")
    axis = np.array([0.0, -1.0, 0.0])
    parent = model.addJoint(parent, pin.JointModelRevoluteUnaligned(axis), lift, "lift")
    parent = model.addJoint(parent, pin.JointModelPX(), pin.SE3.Identity(), "telescope")
    tip = pin.SE3(np.eye(3), np.array([3.0, 0.0, 0.0]))
    tool = model.addFrame(pin.Frame("tool", parent, tip, pin.FrameType.OP_FRAME))
    data = model.createData()
    for q in np.random.default_rng(0).uniform(crane.column("q_min"), crane.column("q_max"), (9, 3)):
        frames = forward_kinematics(crane, q)
        r, z = (3 + q[2]) * np.cos(q[1]), 1.2 + (3 + q[2]) * np.sin(q[1])
        expected = [r * np.cos(q[0]), r * np.sin(q[0]), z]
        np.testing.assert_allclose(tool_position(frames), expected, atol=1e-12)
        pin.framesForwardKinematics(model, data, q)
        np.testing.assert_allclose(data.oMf[tool].translation, expected, atol=1e-12)
        J = pin.computeFrameJacobian(model, data, q, tool, pin.LOCAL_WORLD_ALIGNED)[:3]
        np.testing.assert_allclose(jacobian(frames), J, atol=1e-12)


@pytest.mark.parametrize("name", STARTS)
def test_example__runs_through_the_whole_chain(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    machine = example(name)
    option = f"--machine '{EXAMPLES / name}.py:{name.upper()}'"
    Path("starts.csv").write_text(
        ",".join(machine.names) + "\n" + ",".join(map(str, STARTS[name])) + "\n"
    )
    Path("commands.csv").write_text("sequence,time,vx,vy,vz\nup,0,0,0,0.15\nup,0.5,0,0,0\n")
    for line in (
        f"collect --out log.npz {QUICK['collect']}",
        "inspect log.npz",
        f"fit log.npz --out net.npz --json fit.json {QUICK['fit']}",
        f"train --actuator net.npz --out policy.npz {QUICK['train']}",
        "dbc --out bus.dbc",
    ):
        assert run(f"{line} {option}") == 0, line
    net = select_nets(machine, load_net(Path("net.npz")))
    every = baselines.baselines(machine, net)
    goals = np.tile(np.array([[0.0, 0.0, 0.15]], np.float32), (5, 1, 1))
    config = TaskConfig()
    cost = partial(baselines.tuning_cost, start=[STARTS[name]], goals=goals, seed=0, config=config)
    tuned, costs = baselines.tune(every["jacobian_pid_k0.1"], cost, 0, 1, "pid")
    assert np.isfinite(costs).all()
    meta = baselines.gains_metadata(machine, net)
    baselines.write_gains(Path("gains.json"), every | {"jacobian_pid_k0.1": tuned}, meta)
    scored = "--commands commands.csv --starts starts.csv --json runs.json"
    assert run(f"evaluate --policy policy.npz {scored} {option}") == 0
    runs = json.loads(Path("runs.json").read_text())["runs"]
    assert all(np.isfinite(run["velocity_rmse"]) for run in runs)
    seconds = 4.0 if name == "telescopic_crane" else 1.5
    goals = np.tile([[0.0, 0.0, 0.15]], (round(seconds * machine.rate), 1))
    up = tool_moved(machine, STARTS[name], goals, "run.log")
    assert up[2] > 0.06 * seconds and np.abs(up[:2]).max() < 0.08, up
    assert run(f"convert run.log --out drive.csv {option}") == 0
    if name == "telescopic_crane":  # the other drive is too short
        assert run(f"diagnose run.log --policy policy.npz {option}") == 0
