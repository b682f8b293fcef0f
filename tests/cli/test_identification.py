"""The commands for logs and nets on small files: what they write, print and refuse."""

import json
import re

import numpy as np
import pytest
from helpers_cli import run

from brokk_min.beyond.valve_nets import ValveNet
from brokk_min.can.canopen import encoder_raw, valve_frame
from brokk_min.identification.logs import Log, Recording, read_log, write_log
from brokk_min.identification.net_file import load_net
from brokk_min.machine import BROKK_170

TINY = "--steps 1 --batch-size 8"


def foreign_log(path, seed, runs, sign=1):
    """Another machine at 100 Hz with jitter: first-order joints, a dead zone, angles only."""
    rng = np.random.default_rng(seed)
    lines = ["run,time,u_boom,u_arm,q_boom,q_arm"]
    for r in range(runs):
        t, q, v = 10.0 * r, np.array([0.3, -0.2]), np.zeros(2)
        for k in range(2500):
            if k % 60 == 0:
                u = rng.uniform(-1, 1, 2)
                opening = np.sign(u) * np.maximum(0, np.abs(u) - 0.3)
            step = 0.01 + rng.uniform(-0.003, 0.003)
            v += step * (np.array([0.6, sign]) * opening - v) / 0.15
            q = q + step * v
            lines.append(f"take {r},{t:.4f},{u[0]:.3f},{u[1]:.3f},{q[0]:.5f},{q[1]:.5f}")
            t += step
    path.write_text("\n".join(lines) + "\n")
    return path


def steady_log(path, joints, recordings=3):
    """Angles that go up by 0.01 rad a tick."""
    q = np.cumsum(np.full((40, len(joints)), 0.01), axis=0)
    names = [f"run {i}" for i in range(recordings)]
    write_log(path, Log(joints, tuple(Recording(name, 0 * q, q, 0 * q) for name in names)))
    return path


def test_fit__takes_a_foreign_log_and_beats_persistence(tmp_path, capsys):
    """And `inspect --net` finds the same errors again."""
    log, test = foreign_log(tmp_path / "log.csv", 0, 16), foreign_log(tmp_path / "test.csv", 1, 2)
    files = ["--out", tmp_path / "n.npz", "--json", tmp_path / "f.json"]
    assert run("fit --steps 400", log, "--test", test, *files) == 0
    written = json.loads((tmp_path / "f.json").read_text())
    assert set(written) == {"meta", "joints", "tool", "warnings"}
    meta = written["meta"]
    assert (meta["machine"], meta["rate"], meta["history"], meta["seed"]) == ("", 20.0, 13, 0)
    assert (meta["logs"], meta["test"]) == ([str(log)], [str(test)])
    assert meta["settings"]["steps"] == 400
    for joint in written["joints"].values():
        assert joint["one_step_rmse"] < joint["persistence_rmse"]
        assert set(joint["free_run"]) == {"1", "5", "10"}  # 25 s recordings hold no 30 s run
    assert not [warning for warning in written["warnings"] if "one step" in warning]
    capsys.readouterr()
    assert run("inspect", test, "--net", tmp_path / "n.npz", "--json", tmp_path / "i.json") == 0
    report = json.loads((tmp_path / "i.json").read_text())
    assert report["scores"] == written["joints"]
    printed = capsys.readouterr().out
    assert "2 recordings" in printed
    for name, joint in written["joints"].items():
        assert (
            f"{name}: {joint['one_step_rmse']:.4f}, {joint['persistence_rmse']:.4f}; 1" in printed
        )
        assert report["joints"][name]["dead_zone"] == pytest.approx([0.3, 0.3], abs=0.03)
    assert 'Joint("boom", q_min=' in printed
    assert "warning: boom: expected 10 minutes, got 0.8" in printed


def test_fit__refuses_reversed_commands_and_inspect_tells_them(tmp_path, capsys):
    log = foreign_log(tmp_path / "log.csv", 0, 2, sign=-1)
    assert run(f"fit {TINY}", log, "--out", tmp_path / "n.npz") == 1
    reversed_one = "u_arm: expected positive commands to raise q_arm"
    assert f"log.csv: {reversed_one}" in capsys.readouterr().err
    assert not (tmp_path / "n.npz").exists()
    assert run("inspect", log) == 0
    assert f"warning: {reversed_one}" in capsys.readouterr().out


def test_fit__knows_the_machine_of_a_log_and_the_papers_recipe(tmp_path, capsys):
    own, other = (
        steady_log(tmp_path / f"{name}.csv", joints)
        for name, joints in (("own", BROKK_170.names[::-1]), ("other", ("boom", "stick")))
    )
    out = tmp_path / "n.npz"
    for log, options, machine, valve in (
        (own, "", "brokk170", True),
        (own, "--paper", "brokk170", False),
        (other, "--no-valve", "", False),
    ):
        assert run(f"fit --force {TINY} {options}", log, "--out", out) == 0
        net = load_net(out)
        assert (net.machine, isinstance(net, ValveNet)) == (machine, valve)
        assert net.training["settings"]["rollout"] == (1 if "paper" in options else 8)
        assert "scored on ['run 0']" in capsys.readouterr().out
        assert log == other or net.joints == BROKK_170.names  # in the order of the machine
    slow = tmp_path / "slow.py"
    slow.write_text(
        "from dataclasses import replace\nfrom brokk_min.machine import BROKK_170\n"
        "SLOW = replace(BROKK_170, name='slow', rate=10.0, velocity_samples=3, history=6)\n"
    )
    assert run(f"fit --force {TINY} --rollout 1 --machine {slow}:SLOW", own, "--out", out) == 0
    net = load_net(out)
    expected = ("slow", 10.0, 3, 6)
    assert (net.machine, net.rate, net.velocity_samples, net.history) == expected
    assert run("inspect --net", out, own) == 1  # as a log of the default machine
    assert "n.npz: velocity_samples: expected 4 of --machine, got 3" in capsys.readouterr().err
    assert run(f"inspect --machine {slow}:SLOW", other) == 1
    refusal = "other.csv: joints: expected ['q1', 'q2', 'q3', 'q4', 'q5'], got ['boom', 'stick']"
    assert refusal in capsys.readouterr().err


def test_collect__records_what_read_log_reads(tmp_path, capsys):
    out = tmp_path / "log.npz"
    assert run("collect --hours 0.0002 --excitation sine --out", out) == 0
    log = read_log([out], 4)  # without returns to the start
    num = len(log.recordings)
    assert log.joints == BROKK_170.names
    assert capsys.readouterr().out == f"{out}: {num} recordings of q1, q2, q3, q4, q5\n"
    assert run("collect --hours 0.0002 --excitation sine --seed 1 --force --out", out) == 0
    assert not np.array_equal(read_log([out], 4).recordings[0].u, log.recordings[0].u)


def test_inspect__reads_drives_and_tables_together(tmp_path, capsys):
    """Three seconds of the bus in which q5 goes up by ten counts a tick under a held command."""
    lines = []
    for tick in range(60):
        at = f"({0.05 * tick:.6f}) can0 "
        raw = encoder_raw(BROKK_170, [100, 100, 100, 1000, 10 * tick])
        lines.append(at + "080# T")
        lines += [
            f"{at}{0x181 + i:03X}#{int(x).to_bytes(4, 'little').hex()}" for i, x in enumerate(raw)
        ]
        lines.append(f"{at}210#{valve_frame([0, 0, 0, 0, 60], tick, 1).tobytes().hex()} T")
    (tmp_path / "drive.log").write_text("\n".join([*lines, "(3.000000) can0 080# T", ""]))
    table = steady_log(tmp_path / "log.csv", BROKK_170.names, 1)
    assert run("inspect", tmp_path / "drive.log", table) == 0
    printed = capsys.readouterr().out
    assert "2 recordings" in printed
    low, high = re.search(r'Joint\("q5", q_min=(.*), q_max=(.*), q_dot_up', printed).groups()
    assert float(low) == pytest.approx(0.0, abs=0.02)
    assert float(high) == pytest.approx(590 * 2 * np.pi / 4096, abs=0.02)


def test_inspect__reads_tables_of_other_loggers(tmp_path, capsys):
    """Degrees, per mille and milliseconds, of which one angle was not read."""
    lines = ["ms,Boom,Lever"]
    for k in range(400):
        degrees = 0.0 if k == 200 else 30 + 10 * np.sin(k / 20)
        lines.append(f"{50 * k},{degrees:.4f},{500 * np.cos(k / 20):.1f}")
    log = tmp_path / "theirs.csv"
    log.write_text("\n".join(lines) + "\n")
    assert run("inspect --map boom=Boom:deg,u_boom=Lever:permille,time=ms:ms", log) == 0
    printed = capsys.readouterr().out
    assert "1 recordings" in printed and 'Joint("boom", q_min=0.349, q_max=0.698' in printed
    assert "warning: " + str(log) + ": row 202: expected q_boom at 0.1" in printed
    assert run("inspect", log) == 1
    refusal = "theirs.csv: columns: expected u_<joint> (--map u_NAME=COLUMN:UNIT), got ["
    assert refusal in capsys.readouterr().err


def test_fit__keeps_the_range_of_the_nets_when_an_angle_was_not_read(tmp_path, capsys):
    """And refuses a log in which the sign changes between recordings, with their names."""
    log = foreign_log(tmp_path / "log.csv", 0, 4)
    rows = log.read_text().splitlines()
    cells = rows[5000].split(",")
    rows[5000] = ",".join([*cells[:-1], "0.0"])
    (tmp_path / "one.csv").write_text("\n".join(rows) + "\n")
    outputs = []
    for name in ("log", "one"):
        out = tmp_path / f"{name}.npz"
        assert run(f"fit {TINY}", tmp_path / f"{name}.csv", "--out", out) == 0
        outputs.append(load_net(out).output_high)
    np.testing.assert_allclose(outputs[1], outputs[0], rtol=0.02)
    assert "one.csv: row 5001: expected q_arm at" in capsys.readouterr().out
    rows = [
        ",".join([*cells[:-1], str(-float(cells[-1]))]) if cells[0] == "take 2" else ",".join(cells)
        for cells in (line.split(",") for line in log.read_text().splitlines())
    ]
    (tmp_path / "some.csv").write_text("\n".join(rows) + "\n")
    assert run(f"fit --force {TINY}", tmp_path / "some.csv", "--out", out) == 1
    refusal = "u_arm: expected one sign in all recordings, got the other sign in ['take 2']"
    assert refusal in capsys.readouterr().err


def test_inspect__reads_recordings_of_ros(tmp_path, capsys):
    pytest.importorskip("rosbags")
    from helpers_ros import drive, multi_array, record

    bag = record(tmp_path / "bag", drive(lambda k: multi_array([k / 20, 0.0, -k / 40])))
    topics = "--topics /joint_states /valves"
    assert run(f"inspect {topics}", bag) == 0
    printed = capsys.readouterr().out
    assert "1 recordings" in printed and 'Joint("arm", q_min=-0.380, q_max=-0.040' in printed
    assert run(f"inspect {topics} --map arm=q_arm:-1", bag) == 0
    assert 'Joint("arm", q_min=0.040, q_max=0.380' in capsys.readouterr().out


@pytest.mark.parametrize(
    ("line", "status", "message"),
    [
        ("inspect", 2, "LOGS: expected one file or more, got none"),
        ("collect --out l.csv --hours 0", 2, "--hours: expected above 0, to 100, got 0.0"),
        ("collect --out l.csv --excitation joint", 2, ""),
        ("fit l.csv --out n.txt", 2, "--out: expected a name in .npz, got n.txt"),
        ("fit l.csv --out n.npz --batch-size 0", 2, "--batch-size: expected 1 or more, got 0"),
        ("inspect drive.log", 1, "drive.log: expected a candump log, got row 1: expected"),
        ("inspect drive.log --map q1=boom:deg", 1, "--map: expected a table or a recording"),
    ],
)
def test_wrong_use__is_refused(line, status, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "drive.log").write_text("not a frame\n")
    assert run(line) == status
    assert message in capsys.readouterr().err
