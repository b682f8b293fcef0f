"""Other shapes run through the whole chain: a telescope at 10 Hz, seven joints at 100 Hz."""

import json
from pathlib import Path

import can
import numpy as np
import pytest
from helpers_bus import tool_moved
from helpers_cli import run

from brokk_min.cli.options import find_machine
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
    """Polar coordinates: the boom's length is 3 + q; the Jacobian by central differences."""
    crane = example("telescopic_crane")

    def polar(q):
        r, z = (3 + q[2]) * np.cos(q[1]), 1.2 + (3 + q[2]) * np.sin(q[1])
        return np.array([r * np.cos(q[0]), r * np.sin(q[0]), z])

    for q in np.random.default_rng(0).uniform(crane.column("q_min"), crane.column("q_max"), (9, 3)):
        frames = forward_kinematics(crane, q)
        np.testing.assert_allclose(tool_position(frames), polar(q), atol=1e-12)
        J = [(polar(q + h) - polar(q - h)) / 2e-5 for h in 1e-5 * np.eye(3)]
        np.testing.assert_allclose(jacobian(frames).T, J, atol=1e-8)


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
        f"fit log.npz --out net.npz --json fit.json {QUICK['fit']}",
        f"train --actuator net.npz --out policy.npz {QUICK['train']}",
        "dbc --out bus.dbc",
    ):
        assert run(f"{line} {option}") == 0, line
    net = select_nets(machine, load_net(Path("net.npz")))
    pids, meta = baselines.baselines(machine, net), baselines.gains_metadata(machine, net)
    baselines.write_gains(Path("gains.json"), pids, meta)  # not tuned: fast
    scored = "--commands commands.csv --starts starts.csv --json runs.json"
    assert run(f"evaluate --policy policy.npz {scored} {option}") == 0
    runs = json.loads(Path("runs.json").read_text())["runs"]
    assert all(np.isfinite(run["velocity_rmse"]) for run in runs)
    seconds = 4.0 if name == "telescopic_crane" else 1.5
    goals = np.tile([[0.0, 0.0, 0.15]], (round(seconds * machine.rate), 1))
    up = tool_moved(machine, STARTS[name], goals, can.CanutilsLogWriter("run.log"))
    assert up[2] > 0.06 * seconds and np.abs(up[:2]).max() < 0.08, up
    assert run(f"convert run.log --out drive.csv {option}") == 0
    if name == "telescopic_crane":  # the other drive is too short
        assert run(f"diagnose run.log --policy policy.npz {option}") == 0
