"""Each example has the geometry of its drawing, moves its tool, and runs the whole chain."""

import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from benchmarks.one_process import baseline
from brokk_min.__main__ import main
from brokk_min.cli.options import find_plant
from brokk_min.evaluation import baselines, sequences
from brokk_min.evaluation.rollout import rollout
from brokk_min.kinematics import forward_kinematics, tool_position
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


def test_crane__has_the_geometry_of_its_drawing():
    """Polar coordinates: the boom's length is 3 + q; docs/porting.md has two of the excavator."""
    low, high = TELESCOPIC_CRANE.column("q_min"), TELESCOPIC_CRANE.column("q_max")
    slew, raised, out = np.random.default_rng(0).uniform(low, high, (20, 3)).T
    r, z = (3 + out) * np.cos(raised), 1.2 + (3 + out) * np.sin(raised)
    expected = np.stack([r * np.cos(slew), r * np.sin(slew), z], axis=1)
    frames = forward_kinematics(TELESCOPIC_CRANE, np.stack([slew, raised, out], axis=1))
    np.testing.assert_allclose(tool_position(frames), expected, atol=1e-12)


@pytest.mark.parametrize(
    ("machine", "plant"),
    [*((m, "analytic") for m in STARTS), (MINI_EXCAVATOR, OWN)],
    ids=["excavator", "crane", "seven joints", "own plant"],
)
def test_example__moves_its_tool_along_each_axis(machine, plant):
    """By a PI controller that nobody tuned, for 2 s (the crane's slow valves: 4 s) at 0.15 m/s."""
    plant = find_plant(plant, machine)
    start = np.tile(STARTS[machine], (3, 1))
    seconds = 4.0 if machine is TELESCOPIC_CRANE else 2.0
    goals = np.tile(0.15 * np.eye(3), (round(seconds * machine.rate), 1, 1))
    rng = np.random.default_rng(0)
    trace = rollout(machine, baseline(machine), start, goals, 0.0, rng, plant)
    moved = trace.p_tool[-1] - tool_position(forward_kinematics(machine, start))  # (axes, 3)
    along = np.diag(moved)
    assert (along > 0.06 * seconds).all() and (np.abs(moved - np.diag(along)) < 0.08).all(), moved


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("port")
    for name in ("mini_excavator.py", "own_plant.py"):
        (path / name).write_text((EXAMPLES / name).read_text())
    (path / "commands.csv").write_text("sequence,time,vx,vy,vz\nup,0,0,0,0.15\nup,0.5,0,0,0\n")
    (path / "starts.csv").write_text("swing,boom,arm,bucket\n0.1,-0.5,1.4,0.8\n")
    rows = [f"{50 * k},a,{40 * np.sin(k / 20):.3f},{900 * np.cos(k / 20):.1f}" for k in range(200)]
    (path / "theirs.csv").write_text("\n".join(["Stamp,Drive,Boom_ang,Lever", *rows]) + "\n")
    return path


def test_porting_page__has_commands_that_run_one_after_the_other(folder, monkeypatch):
    """All but the last two, which need a bus and an operator."""
    monkeypatch.chdir(folder)
    monkeypatch.setattr(baselines, "EFFORT", (1, 1, 1.0))
    monkeypatch.setattr(sequences, "STARTS_OF", 400)
    commands = [shlex.split(line) for line in re.findall(r"^brokk-min (.*)$", PAGE, re.M)]
    names = " ".join(words[0] for words in commands)
    assert names == "collect inspect inspect fit train evaluate machine drive"
    for words in commands[:-2]:
        assert main([*words, *SHORT.get(words[0], "").split()]) == 0, words
    for words in commands[-2:]:
        words = ["nonsense" if word == "udp_multicast" else word for word in words]
        assert main(words) == 1


def test_porting_page__has_blocks_of_python_that_run(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(str(folder))
    for block in re.findall(r"^```python\n(.*?)^```", PAGE, re.M | re.S):
        exec(compile(block, "docs/porting.md", "exec"), {})
    printed = re.findall(r"\[ *([\d.]+) +0\. +([\d.]+) *\]", capsys.readouterr().out)
    stated = re.findall(r"([\d.]+) m out and ([\d.]+) m high", PAGE)
    assert np.array(printed, float).tolist() == np.array(stated, float).tolist()
    assert len(stated) == 2
