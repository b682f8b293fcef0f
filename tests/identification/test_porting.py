"""The page on porting is true: all of its blocks run, on a machine that is no Brokk."""

import csv
import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from helpers_bus import tool_moved

from brokk_min.__main__ import main
from brokk_min.cli.options import with_plant
from brokk_min.evaluation import baselines, sequences
from brokk_min.evaluation.feasibility import speed_limits
from brokk_min.identification.logs import read_log
from brokk_min.identification.net_file import load_net
from brokk_min.kinematics import forward_kinematics, tool_position

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "porting.md").read_text()
COMMANDS = [shlex.split(line) for line in re.findall(r"^brokk-min (.*)$", PAGE, re.M)]
PYTHON = re.findall(r"^```python\n(.*?)^```", PAGE, re.M | re.S)
MOTIONS = re.search(r"^```csv\n(.*?)^```", PAGE, re.M | re.S)[1]
QUICK = {
    "starts": "--num 1",
    "collect": "--hours 0.01",
    "fit": "--steps 8 --batch-size 256",
    "train": "--total-steps 1024 --num-envs 16 --horizon 16 --minibatch-size 128 --threads 1",
    "evaluate": "--commands commands.csv --starts starts.csv",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("port")
    for name in ("mini_excavator.py", "own_plant.py"):
        (path / name).write_text((ROOT / "examples" / name).read_text())
    return path


@pytest.fixture(scope="module")
def mini():
    namespace = {}
    exec(compile((ROOT / "examples" / "mini_excavator.py").read_text(), "mini", "exec"), namespace)
    return namespace["MINI_EXCAVATOR"]


@pytest.fixture
def here(folder, monkeypatch):
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(str(folder))
    return folder


def test_example__has_the_geometry_and_the_speeds_of_its_drawing(mini):
    """Closed form: elevations are minus the sums of the angles, as positive is downward."""
    q = np.random.default_rng(0).uniform(mini.column("q_min"), mini.column("q_max"), (50, 4))
    e = -np.cumsum(q[:, 1:], axis=1)
    lengths = np.array([1.80, 1.10, 0.60])
    r = 0.30 + (lengths * np.cos(e)).sum(axis=1)
    z = 0.75 + (lengths * np.sin(e)).sum(axis=1)
    p = np.stack([r * np.cos(q[:, 0]), r * np.sin(q[:, 0]), z], axis=1)
    np.testing.assert_allclose(tool_position(forward_kinematics(mini, q)), p, atol=1e-12)
    down, up = speed_limits(mini, np.linspace(mini.column("q_min"), mini.column("q_max"), 300))
    np.testing.assert_allclose(up.max(axis=0), mini.column("q_dot_up"), atol=0.01)
    np.testing.assert_allclose(-down.min(axis=0), mini.column("q_dot_down"), atol=0.01)


def test_page__has_blocks_of_python_that_run(here, capsys):
    rng, names = np.random.default_rng(0), ["swing", "boom", "arm", "bucket"]
    with open("theirs.csv", "w", newline="") as file:
        table = csv.writer(file)
        units = [f"{name}_{unit}" for name in names for unit in ("permille", "deg")]
        table.writerow(["drive", "ms", *units])
        table.writerows([["a", 10 * i, *rng.uniform(-90, 90, 8).round(1)] for i in range(100)])
    for block in PYTHON:
        exec(compile(block, "docs/porting.md", "exec"), {})
    printed = re.findall(r"\[ *([\d.]+) +0\. +([\d.]+) *\]", capsys.readouterr().out)
    stated = re.findall(r"([\d.]+) m out, ([\d.]+) m high", PAGE)
    assert np.array(printed, float).tolist() == np.array(stated, float).tolist()
    assert len(stated) == 2
    log = read_log([Path("ours.csv")], 5, rate=25.0)
    assert log.joints == tuple(names) and len(log.recordings[0].q) == 25
    with open("theirs.csv") as file:
        first, *others = csv.DictReader(file)
    assert log.recordings[0].q[0, 2] == pytest.approx(np.deg2rad(float(first["arm_deg"])), rel=1e-6)
    u = [float(row["bucket_permille"]) / 1000 for row in (first, *others[:3])]  # a tick of 40 ms
    assert log.recordings[0].u[0, 3] == pytest.approx(np.average(u, weights=(3, 2, 3, 2)))


def test_page__has_commands_that_run_one_after_the_other(here, mini, monkeypatch):
    for name, value in {"TUNING_RUNS": 1, "TUNING_SECONDS": 1.0, "GENERATIONS": 1}.items():
        monkeypatch.setattr(baselines, name, value)
    few = sequences.shorten(mini, sequences.task_sequences(mini), 3.0)
    monkeypatch.setattr(sequences, "task_sequences", lambda machine: few)  # for `starts`
    Path("commands.csv").write_text(MOTIONS)
    names = [words[0] for words in COMMANDS]
    first = ["starts", "collect", "inspect", "fit", "train", "evaluate", "collect", "score"]
    assert names == [*first, "fit", "train", "dbc", "machine", "drive", "diagnose"]
    for words in COMMANDS[:11]:
        short = [word for word in words if word not in ("--hours", "1")]
        assert main([*short, *QUICK.get(words[0], "").split()]) == 0, words
        if words[0] == "evaluate":  # on the plant that was recorded, too
            own = ["own_plant.py:PLANT" if word == "net" else word for word in words[:-4]]
            own += ["--gains", "pid.json", "--json", "own.json"]
            assert main([*own, *QUICK["evaluate"].split()]) == 0
    assert json.loads(Path("own.json").read_text())["meta"]["plant"] == "own_plant.py:PLANT"
    assert len(json.loads(Path("fit.json").read_text())["curve"]) == 4
    recovered = json.loads(Path("fit.json").read_text())["recovery"]["bucket"]
    assert recovered["plant"]["dead_zone"] == pytest.approx([0.14, 0.12], abs=0.015)
    assert Path("net.png").stat().st_size > 1000
    results = json.loads(Path("nets.json").read_text())
    net = load_net(Path("net.npz"))
    assert (net.rate, net.history, net.velocity_samples) == (25.0, 14, mini.velocity_samples)
    assert results["meta"]["machine"] == "mini_excavator" and results["meta"]["plant"] == "net"
    assert all(np.isfinite(run["velocity_rmse"]) for run in results["runs"])


def test_page__has_commands_of_the_bus(here, capsys):
    """They need two programs; here the options are read, and what they name is not there."""
    for words in COMMANDS[11:]:
        assert main(["nonsense" if word == "udp_multicast" else word for word in words]) == 1
        message = capsys.readouterr().err
        assert any(name in message for name in ("nonsense", "policy.npz", "joystick", "run.log"))


@pytest.mark.parametrize(("axis", "plant"), [(0, None), (1, None), (2, None), (0, "own")])
def test_example__is_driven_over_the_bus(mini, axis, plant):
    """Its own identifiers, zeros and signs: the tool moves at 0.15 m/s outward, sideways or up."""
    if plant:
        mini = with_plant(mini, f"{ROOT / 'examples' / 'own_plant.py'}:PLANT", [])
    moved = tool_moved(mini, (0.1, -0.5, 1.4, 0.8), np.tile(0.15 * np.eye(3)[axis], (50, 1)))  # 2 s
    assert moved[axis] > 0.15 and np.delete(np.abs(moved), axis).max() < 0.08, moved
