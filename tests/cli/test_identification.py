"""The commands for logs and nets on small files: what they write."""

import json

import numpy as np
import pytest
from helpers_cli import run

from brokk_min.identification.logs import Log, Recording, read_log, write_log
from brokk_min.identification.net_file import load_net
from brokk_min.machine import BROKK_170


def foreign_log(path, seed, runs):
    """Another machine at 100 Hz with jitter: first-order joints, a dead zone, angles only."""
    rng = np.random.default_rng(seed)
    lines = ["run,time,u_boom,u_arm,q_boom,q_arm"]
    for r in range(runs):
        t = 10.0 * r
        q = np.array([0.3, -0.2])
        v = np.zeros(2)
        for k in range(2500):
            if k % 60 == 0:
                u = rng.uniform(-1, 1, 2)
                opening = np.sign(u) * np.maximum(0, np.abs(u) - 0.3)
            step = 0.01 + rng.uniform(-0.003, 0.003)
            v += step * (np.array([0.6, 1.0]) * opening - v) / 0.15
            q = q + step * v
            lines.append(f"take {r},{t:.4f},{u[0]:.3f},{u[1]:.3f},{q[0]:.5f},{q[1]:.5f}")
            t += step
    path.write_text("\n".join(lines) + "\n")


def steady_log(joints, recordings):
    """Angles that go up by 0.01 rad a tick."""
    q = np.cumsum(np.full((40, len(joints)), 0.01), axis=0)
    return Log(joints, tuple(Recording(str(i), 0 * q, q, 0 * q) for i in range(recordings)))


def test_fit__takes_a_foreign_log_and_beats_persistence_and_a_linear_model(tmp_path):
    foreign_log(tmp_path / "log.csv", 0, 16)
    foreign_log(tmp_path / "test.csv", 1, 2)
    files = ["--test", tmp_path / "test.csv", "--json", tmp_path / "f.json"]
    files += ["--figure", tmp_path / "f.png"]
    assert run(f"fit '{tmp_path}/log.csv' --steps 400 --out", tmp_path / "n.npz", *files) == 0
    written = json.loads((tmp_path / "f.json").read_text())
    assert set(written) == {"meta", "joints", "tool", "warnings"}
    assert written["meta"].pop("settings")["steps"] == 400
    assert written["meta"] == {
        "seed": 0,
        "rate": 20.0,
        "history": 13,
        "machine": "",
        "dead_zone": 0.0,
        "logs": [str(tmp_path / "log.csv")],
        "test": [str(tmp_path / "test.csv")],
    }
    assert list(written["joints"]) == ["boom", "arm"]
    for joint in written["joints"].values():
        assert joint["one_step_rmse"] < joint["persistence_rmse"]
        assert set(joint["free_run"]) == {"1", "5", "10"}  # 25 s recordings hold no 30 s run
        linear = joint["linear"]["free_run"]["5"]["velocity_rmse"]
        assert joint["free_run"]["5"]["velocity_rmse"] < 0.9 * linear
        assert joint["creep"] < 5e-4
    assert not [warning for warning in written["warnings"] if "linear" in warning]
    assert (tmp_path / "f.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("joints", "options", "machine", "dead_zone"),
    [
        (BROKK_170.names, "", "brokk170", 0.07),
        (BROKK_170.names, "--dead-zone 0", "brokk170", 0.0),
        (BROKK_170.names, "--paper", "brokk170", 0.0),
        (("boom", "stick"), "", "", 0.0),
        (("boom", "stick"), "--dead-zone 0.1", "", 0.1),
    ],
)
def test_fit__uses_the_dead_zone_of_a_known_machine_or_the_one_given(
    joints, options, machine, dead_zone, tmp_path, capsys
):
    write_log(tmp_path / "log.csv", steady_log(joints, 3))
    out = tmp_path / "n.npz"
    assert run(f"fit {options} --steps 1 --batch-size 8", tmp_path / "log.csv", "--out", out) == 0
    net = load_net(out)
    assert (net.machine, net.dead_zone) == (machine, dead_zone)
    assert ((net.settings["noise"], net.settings["rollout"]) == (0, 1)) == ("paper" in options)
    expected = f"nets of {machine or 'no known machine'}, dead zone {dead_zone} of full command\n"
    assert capsys.readouterr().out.startswith(expected)


def test_fit__takes_rate_history_and_velocity_window_of_the_machine(tmp_path):
    write_log(tmp_path / "log.csv", steady_log(BROKK_170.names, 4))
    (tmp_path / "slow.py").write_text(
        "from dataclasses import replace\nfrom brokk_min.machine import BROKK_170\n"
        "SLOW = replace(BROKK_170, name='slow', rate=10.0, velocity_samples=3, history=6)\n"
    )
    line = f"fit '{tmp_path}/log.csv' --steps 1 --rollout 1 --out '{tmp_path}/n.npz' "
    slow = f"--machine '{tmp_path}/slow.py:SLOW'"
    for options, expected in (
        (slow, ("slow", 10.0, 3, 6)),
        ("--history 5 --velocity-samples 5", ("brokk170", 20.0, 5, 5)),
    ):
        assert run(line + options) == 0
        net = load_net(tmp_path / "n.npz")
        assert (net.machine, net.rate, net.velocity_samples, net.history) == expected


@pytest.mark.parametrize(
    ("levels", "options", "expected"),
    [
        (8, "--steps 1", (1, 0.0, 0.1, 13)),
        (5, "--steps 1", (1, 0.3, 1.0, 1)),
        (5, "--steps 1 --output-lags 20 --noise 0.5", (1, 0.3, 0.5, 20)),
        (5, "--steps 1 --paper", (1, 0.0, 0.0, 13)),
    ],
)
def test_fit__has_a_recipe_for_step_responses(levels, options, expected, tmp_path, capsys):
    """Held commands of so many levels, up and down, and angles that follow them."""
    held = np.tile(np.arange(1, levels + 1) / levels, 10)
    u = np.repeat(np.stack([held, -held], axis=1).ravel(), 20)[:, None]
    q = np.cumsum(0.3 * u, axis=0) / 20
    recordings = [Recording(name, u, q, u) for name in ("one", "two")]
    write_log(tmp_path / "log.npz", Log(("a",), tuple(recordings)))
    files = ["--out", tmp_path / "n.npz", "--json", tmp_path / "n.json"]
    assert run(f"fit {options} --batch-size 8", tmp_path / "log.npz", *files) == 0
    settings = load_net(tmp_path / "n.npz").settings
    names = ("steps", "weight_decay", "noise", "output_lags")
    assert tuple(settings[name] for name in names) == expected
    assert json.loads((tmp_path / "n.json").read_text())["meta"]["settings"] == settings
    printed = capsys.readouterr().out
    values = ", ".join(map("{} {}".format, names, expected))
    is_recipe = levels == 5 and "paper" not in options
    recipe = f"step responses, held commands of few levels: {values}\n"
    assert (recipe in printed, "step responses" in printed) == (is_recipe, is_recipe)
    assert "scored on: ['one']\n" in printed


def test_fit__refuses_the_log_of_another_machine(tmp_path, capsys):
    write_log(tmp_path / "log.csv", steady_log(("a", "b"), 2))
    assert run(f"fit '{tmp_path}/log.csv' --machine brokk170 --out '{tmp_path}/n.npz'") == 1
    refusal = "log.csv: joints: expected ('q1', 'q2', 'q3', 'q4', 'q5') of --machine brokk170, got"
    assert refusal in capsys.readouterr().err


def test_collect__has_a_policy_or_an_excitation(tmp_path, capsys):
    out = tmp_path / "log.npz"
    assert run(f"collect --policy p.npz --excitation rich --out '{out}'") == 2
    assert "--excitation: expected none with --policy, got rich" in capsys.readouterr().err
    assert run(f"collect --hours 0.0002 --out '{out}'") == 0
    recordings = len(read_log([out], 4).recordings)  # without returns to the start
    assert f"log.npz: {recordings} recordings of q1, q2, " in capsys.readouterr().out
