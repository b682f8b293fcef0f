"""The commands for logs and nets on small files: what they write, print and refuse."""

import json
import re

import numpy as np
import pytest
from helpers_cli import run

from benchmarks.one_process import ConstantCommand, HoldingOperator, World
from brokk_min.beyond.valve_nets import ValveNet
from brokk_min.fit import Log, Recording
from brokk_min.identification.logs import read_log, write_log
from brokk_min.identification.net_file import load_net
from brokk_min.machine import BROKK_170

TINY = "--steps 1 --batch-size 1"
MIXED = BROKK_170.names[::-1]  # in another order than the machine's


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


def steady_log(path, joints):
    """Angles that go up by 0.01 rad a tick."""
    q = np.cumsum(np.full((40, len(joints)), 0.01), axis=0)
    names = [f"run {i}" for i in range(3)]
    write_log(path, Log(joints, tuple(Recording(name, 0 * q, q, 0 * q) for name in names)))
    return path


def test_fit__takes_a_foreign_log_and_beats_persistence(tmp_path, capsys):
    """And `inspect --net` finds the same errors again, and the dead zones."""
    log, test = foreign_log(tmp_path / "log.csv", 0, 16), foreign_log(tmp_path / "test.csv", 1, 2)
    files = ["--out", tmp_path / "n.npz", "--json", tmp_path / "f.json"]
    assert run("fit --steps 400", log, "--test", test, *files) == 0
    written = json.loads((tmp_path / "f.json").read_text())
    meta = written["meta"]
    assert (meta["machine"], meta["logs"], meta["test"]) == ("", [str(log)], [str(test)])
    for joint in written["joints"].values():
        assert joint["one_step_rmse"] < joint["persistence_rmse"]
    scores = re.findall(r"^(?:boom|arm): .* 5 s .*$", capsys.readouterr().out, re.M)
    assert run("inspect", test, "--net", tmp_path / "n.npz") == 0
    printed = capsys.readouterr().out
    assert len(scores) == 2 and all(line in printed for line in scores)
    zones = re.findall(r"dead_zone=\((0\.\d+), (0\.\d+)\)", printed)
    assert np.array(zones, float) == pytest.approx(np.full((2, 2), 0.3), abs=0.03)
    assert "warning: boom: expected 10 minutes, got 0.8" in printed


def test_fit__refuses_reversed_commands_and_inspect_tells_them(tmp_path, capsys):
    log = foreign_log(tmp_path / "log.csv", 0, 2, sign=-1)
    assert run(f"fit {TINY}", log, "--out", tmp_path / "n.npz") == 1
    reversed_one = "u_arm: expected positive commands to raise q_arm"
    assert f"log.csv: {reversed_one}" in capsys.readouterr().err
    table = foreign_log(tmp_path / "sound.csv", 0, 2).read_text()
    head, _, rows = table.partition("\n")
    swapped = head.replace("u_boom", "u_x").replace("u_arm", "u_boom").replace("u_x", "u_arm")
    (tmp_path / "swapped.csv").write_text(f"{swapped}\n{rows}")
    assert run(f"fit {TINY}", tmp_path / "swapped.csv", "--out", tmp_path / "n.npz") == 1
    assert "expected motion by u_arm, got motion by u_boom" in capsys.readouterr().err
    slow = read_log(log, BROKK_170)
    turned = [
        one._replace(q=one.q * of, q_dot=one.q_dot * of)
        for one, of in zip(slow.recordings, (0.2, 0.2 * 57.3))
    ]
    write_log(tmp_path / "degrees.csv", slow._replace(recordings=tuple(turned)))
    assert run(f"fit {TINY}", tmp_path / "degrees.csv", "--out", tmp_path / "n.npz") == 1
    wanted = "degrees.csv: q_boom: expected one unit in all recordings, got larger angles in"
    assert wanted in capsys.readouterr().err
    short = tmp_path / "short.csv"
    short.write_text("".join(f"{line}\n" for line in table.splitlines()[:10]))
    files = [tmp_path / "sound.csv", "--test", short, "--out", tmp_path / "n.npz"]
    assert run(f"fit {TINY}", *files) == 1
    told = capsys.readouterr()
    wanted = "short.csv: log: expected a recording of more than 14 samples to score on, got [2]"
    assert wanted in told.err and "warning" not in told.out
    assert not (tmp_path / "n.npz").exists()
    assert run("inspect", log, log) == 2 and "each once" in capsys.readouterr().err
    assert run("inspect", log) == 0
    assert f"warning: {reversed_one}" in capsys.readouterr().out


def test_fit__leaves_out_recordings_in_which_nothing_moves(tmp_path, capsys):
    """In two of six the pump is off; without one joint's tests its scores are not printed."""
    moving = read_log(foreign_log(tmp_path / "log.csv", 0, 6), BROKK_170)
    stands = [one._replace(q=0 * one.q + one.q[0], q_dot=0 * one.q) for one in moving.recordings]
    logs = {"sound": moving.recordings[2:], "off": (*stands[:2], *moving.recordings[2:])}
    for name, recordings in logs.items():
        write_log(tmp_path / f"{name}.csv", moving._replace(recordings=recordings))
        assert run(f"fit {TINY}", tmp_path / f"{name}.csv", "--out", tmp_path / f"{name}.npz") == 0
    told = capsys.readouterr().out
    assert "got rest or other motion in ['take 0', 'take 1'] (engine or pump off" in told
    nets = [load_net(tmp_path / f"{name}.npz") for name in logs]
    assert all(map(np.array_equal, *(net.weights for net in nets)))
    write_log(tmp_path / "rests.csv", moving._replace(recordings=(stands[0],)))
    files = [tmp_path / "sound.csv", "--test", tmp_path / "rests.csv", "--out", tmp_path / "n.npz"]
    assert run(f"fit {TINY}", *files) == 1
    wanted = "rests.csv: recordings: expected some in which commands move the joints, got none"
    assert wanted in capsys.readouterr().err
    alone = moving.recordings[0]
    parked = alone._replace(u=alone.u * [1, 0], q=alone.q * [1, 0], q_dot=alone.q_dot * [1, 0])
    write_log(tmp_path / "boom.csv", moving._replace(recordings=(parked,)))
    files = [tmp_path / "sound.csv", "--test", tmp_path / "boom.csv", "--out", tmp_path / "n.npz"]
    assert run(f"fit {TINY}", *files) == 0
    told, _, scores = capsys.readouterr().out.partition("n.npz: nets")
    assert "warning: arm: expected a recording to score on in which it moves" in told
    assert "boom: " in scores and "arm: " not in scores
    still = alone._replace(u=0 * alone.u, q=0 * alone.q, q_dot=0 * alone.q)
    write_log(tmp_path / "still.csv", moving._replace(recordings=(still,)))
    files[2] = tmp_path / "still.csv"
    assert run(f"fit --force {TINY}", *files) == 1
    assert "still.csv: log: expected motion to score on, got none" in capsys.readouterr().err


def test_fit__knows_the_machine_of_a_log_and_the_papers_recipe(tmp_path, capsys):
    own = steady_log(tmp_path / "own.csv", MIXED)
    driven = steady_log(tmp_path / "driven.csv", ("q1", "q3", "q4", "q5"))  # without the locked q2
    other = steady_log(tmp_path / "other.csv", ("boom", "stick"))
    out = tmp_path / "n.npz"
    for log, options, machine, valve in (
        (own, "", "brokk170", True),
        (own, "--paper", "brokk170", False),
        (driven, "", "brokk170", True),
        (other, "--no-valve", "", False),
    ):
        assert run(f"fit --force {TINY} {options}", log, "--out", out) == 0
        named = f"nets of {machine or 'an unknown machine'}"  # before the fit, and after it
        assert capsys.readouterr().out.startswith(named)
        net = load_net(out)
        assert (net.machine, isinstance(net, ValveNet)) == (machine, valve)
        assert net.training["settings"]["rollout"] == (1 if "paper" in options else 8)
        assert log != own or net.joints == BROKK_170.names  # in the order of the machine
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
    assert "n.npz: expected velocity_samples 4 of --machine, got 3" in capsys.readouterr().err


def test_logs__some_of_which_have_no_locked_joint_are_one_log(tmp_path, capsys):
    """As tables of the driven joints beside logs of a bus, which has all."""
    every, driven = (
        steady_log(tmp_path / f"{len(names)}.csv", names)
        for names in (BROKK_170.names, ("q1", "q3", "q4", "q5"))
    )
    net = tmp_path / "n.npz"
    assert run(f"fit {TINY}", driven, every, "--out", net) == 0
    assert load_net(net).joints == ("q1", "q3", "q4", "q5")
    assert run("inspect --net", net, every) == 0
    two = steady_log(tmp_path / "two.csv", ("q1", "q3"))  # of driven ones all must have all
    assert run(f"fit --force {TINY}", two, every, "--out", net) == 1
    assert "joints: expected ['q1', 'q3'], got ['q1', 'q3', 'q4', 'q5']" in capsys.readouterr().err


def test_fit__keeps_its_nets_if_it_is_stopped_while_it_scores(tmp_path, monkeypatch):
    def stopped(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("brokk_min.identification.validation.score", stopped)
    log = steady_log(tmp_path / "log.csv", MIXED)
    assert run(f"fit {TINY}", log, "--out", tmp_path / "n.npz") == 1
    assert load_net(tmp_path / "n.npz").joints == BROKK_170.names


def test_collect__records_what_read_log_reads(tmp_path):
    logs = []
    for seed in (0, 1):
        out = tmp_path / f"{seed}.npz"
        assert run(f"collect --hours 0.0002 --excitation sine --seed {seed} --out", out) == 0
        logs.append(read_log(out, BROKK_170))  # without returns to the start
    assert logs[0].joints == BROKK_170.names
    assert not np.array_equal(logs[0].recordings[0].u, logs[1].recordings[0].u)


def test_logs__may_have_more_joints_than_the_machine(tmp_path, capsys):
    rail = tmp_path / "rail.py"
    rail.write_text(
        "from dataclasses import replace\nfrom brokk_min.machine import BROKK_170\n"
        "joints = {'joints': BROKK_170.joints[2:], 'q_start': (0.6, 1.7, 1.2)}\n"
        "TWO = replace(BROKK_170, name='two', **joints)\n"
    )
    log = steady_log(tmp_path / "log.csv", (*MIXED, "track"))
    assert run("inspect", log, "--machine", f"{rail}:TWO") == 0
    told = capsys.readouterr().out
    assert f"{log}: joints: expected those of --machine, left out ['q2', 'q1', 'track']" in told
    assert 'Joint("q4"' in told and 'Joint("q1"' not in told
    few = steady_log(tmp_path / "few.csv", ("q3", "track"))
    assert run("inspect", few, "--machine", f"{rail}:TWO") == 1
    wanted = "few.csv: joints: expected ['q3', 'q4', 'q5'], got ['q3', 'track']"
    assert wanted in capsys.readouterr().err


def test_inspect__reads_drives_and_tables_together(tmp_path, capsys):
    world = World(ConstantCommand(0, 0, 0, 0, 60), HoldingOperator(), log=tmp_path / "drive.log")
    world.drive.begin()
    world.run(3.0)
    world.bus.close()
    assert run("inspect", tmp_path / "drive.log", steady_log(tmp_path / "log.csv", MIXED)) == 0
    printed = capsys.readouterr().out
    assert "ticks late by 0.00 ms in the median, 0.00 ms in 99 %" in printed
    assert "0 of 62 missed\n4 recordings" in printed
    q5 = re.search(r'Joint\("q5", q_min=.*, q_max=(.*), q_dot_up', printed).group(1)
    assert float(q5) == pytest.approx(world.simulated.state.q[4], abs=0.02)


def test_inspect__reads_recordings_of_ros(tmp_path, capsys):
    pytest.importorskip("rosbags")
    from helpers_ros import drive, joint_state, multi_array, record

    bag = record(tmp_path / "bag", drive(lambda k: multi_array([k / 20, 0.0, -k / 40])))
    assert run("inspect --topics /valves /valves", bag) == 2
    assert run("inspect --topics /joint_states /valves --map arm=q_arm:-1", bag) == 0
    assert re.search(r'Joint\("arm", q_min=-?0.000, q_max=0.380', capsys.readouterr().out)
    bag = record(tmp_path / "lift", drive(lambda k: joint_state(["lift"], [k / 20])))
    assert run("inspect --topics /joint_states /valves", bag) == 1
    named = "those of ['lift'] (--topics, or names by --map q_NAME=q_OTHER), got ['boom', 'wheel'"
    assert named in capsys.readouterr().err
    assert run("inspect --topics /joint_states /valves --map q_lift=q_boom", bag) == 0
    assert re.search(r'Joint\("lift", q_min=-?0.000, q_max=0.190', capsys.readouterr().out)
