"""The commands of the method on small files: what they write and what they print."""

import json

import numpy as np
import pytest
from helpers_cli import run

from brokk_min.env import TaskConfig
from brokk_min.evaluation import baselines
from brokk_min.evaluation.metrics import summary
from brokk_min.evaluation.sequences import read_starts, start_kinds
from brokk_min.identification.files import SHIPPED
from brokk_min.identification.logs import Log, Recording, read_log, write_log
from brokk_min.identification.net_file import load_net, save_net
from brokk_min.learning.episodes import PAPER_TASK
from brokk_min.learning.policy import POLICIES, load_policy
from brokk_min.machine import BROKK_170
from brokk_min.ppo import PPOConfig

SHIPPED_POLICY = SHIPPED / "brokk170" / "policy.npz"
SHIPPED_GAINS = SHIPPED / "brokk170" / "gains.json"


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


def test_fit__has_the_papers_recipe_as_one_option(tmp_path):
    foreign_log(tmp_path / "log.csv", 0, 2)
    files = [tmp_path / "log.csv", "--out", tmp_path / "n.npz", "--json", tmp_path / "f.json"]
    assert run("fit --steps 3 --paper", *files) == 0
    settings = load_net(tmp_path / "n.npz").settings
    assert (settings["noise"], settings["rollout"], settings["steps"]) == (0, 1, 3)
    assert set(json.loads((tmp_path / "f.json").read_text())) == {
        "meta",
        "joints",
        "tool",
        "warnings",
    }


def test_fit__writes_nothing_for_a_bad_log(tmp_path, capsys):
    path = tmp_path / "log.csv"
    foreign_log(path, 0, 1)
    lines = path.read_text().splitlines()
    lines[16] = lines[16].replace("take 0,", "take 0,x", 1)
    path.write_text("\n".join([*lines, ""]))
    files = ["--out", tmp_path / "n.npz", "--json", tmp_path / "f.json"]
    assert run("fit", path, *files) == 1
    assert "row 17, column time: expected finite number" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["log.csv"]


@pytest.mark.parametrize(
    ("joints", "options", "machine", "dead_zone"),
    [
        (BROKK_170.names, "", "brokk170", 0.07),
        (BROKK_170.names, "--machine brokk170", "brokk170", 0.07),
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


def test_fit__refuses_the_log_of_another_machine(tmp_path, capsys):
    write_log(tmp_path / "log.csv", steady_log(("a", "b"), 2))
    assert run(f"fit '{tmp_path}/log.csv' --machine brokk170 --out '{tmp_path}/n.npz'") == 1
    assert (
        "log.csv: joints: expected those of --machine brokk170, got ('a', 'b')"
        in capsys.readouterr().err
    )


SMALL = "--total-steps 512 --num-envs 16 --horizon 16 --minibatch-size 128"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A log, nets and a policy of the Brokk, made by the commands."""
    folder = tmp_path_factory.mktemp("chain")
    net = folder / "net.npz"
    assert run(f"collect --hours 0.02 --excitation sine --out '{folder}/log.csv'") == 0
    assert run(f"fit '{folder}/log.csv' --steps 50 --out", net) == 0
    options = f"--resume --valve-cost 0.01 {SMALL}"
    assert run(f"train --actuator '{net}' {options} --out", folder / "policy.npz") == 0
    (folder / "c.csv").write_text("sequence,time,vx,vy,vz\nup,0,0,0,0.1\nup,1,0,0,0\n")
    (folder / "s.csv").write_text("q1,q2,q3,q4,q5\n0,0.5,0.58,1.71,1.24\n")
    return folder


def write_gains(folder):
    """Gains for the nets of the policy in `folder`; the names of the controllers."""
    row = {key: [0.5] * 4 for key in ("kp", "ki", "kd")} | {"feedback": [0.1], "ready": [0.01]}
    names = ["jacobian_pid_k0.1", "jacobian_pid_k0.05", "jacobian_pid_ff", "jacobian_pid_ff_awake"]
    names += ["jacobian_pid_ff_integral", "jacobian_pid_ff_integral_awake"]
    net = load_policy(folder / "policy.npz", BROKK_170).net
    meta = baselines.gains_metadata(BROKK_170, net)
    table = {"meta": meta, "gains": dict.fromkeys(names, row)}
    (folder / "gains.json").write_text(json.dumps(table))
    return names


def test_train__writes_policy_and_curve(folder):
    assert read_log([folder / "log.csv"], 4).joints == ("q1", "q2", "q3", "q4", "q5")
    assert (folder / "policy.npz.csv").read_text().startswith("global_step,charts/")
    training = load_policy(folder / "policy.npz", BROKK_170).training
    assert training["task"]["valve_cost"] == 0.01
    assert training["settings"]["total_steps"] == 512
    assert training["settings"]["critic"] is False


@pytest.mark.parametrize("option", ["--critic", "--paper"])
def test_train__can_use_a_critic(option, folder, tmp_path):
    out = tmp_path / "p.npz"
    assert run(f"train --actuator '{folder}/net.npz' {option} {SMALL} --seed 5 --out", out) == 0
    training = load_policy(out, BROKK_170).training
    assert training["settings"]["critic"] is True
    assert training["settings"]["log_std_end"] is None
    assert training["seed"] == 5
    assert training["settings"]["total_steps"] == 512  # options given count
    assert training["settings"]["gamma"] == PPOConfig().gamma
    hold = PAPER_TASK["hold_min_s"] if option == "--paper" else TaskConfig().hold_min_s
    assert training["task"]["hold_min_s"] == hold


def test_evaluate__writes_what_it_used(folder, capsys):
    names = write_gains(folder)
    files = {"policy": "policy.npz", "commands": "c.csv", "starts": "s.csv"}
    line = " ".join(f"--{option} '{folder}/{file}'" for option, file in files.items())
    out = folder / "e.json"
    for plant in ("analytic", "net"):
        assert run(f"evaluate {line} --plant {plant} --json", out) == 0
        written = json.loads(out.read_text())
        meta = written["meta"]
        for option, file in (files | {"gains": "gains.json"}).items():
            assert meta[option] == str(folder / file)
        assert (meta["plant"], meta["machine"], meta["seed"]) == (plant, "brokk170", 0)
        assert [run["controller"] for run in written["runs"]] == ["rl", *names]
        assert {(run["sequence"], run["start"]) for run in written["runs"]} == {("up", 0)}
    assert run(f"evaluate {line} --perfect-model --json", out) == 0
    runs = json.loads(out.read_text())["runs"]
    best = sorted(runs, key=lambda run: run["velocity_error_mean"])[:2]
    assert [run["controller"] for run in best] == ["perfect_model", "perfect_model_closed"]
    capsys.readouterr()
    assert run(f"evaluate {line} --gains", SHIPPED_GAINS) == 1  # gains for other nets
    assert "gains.json: actuator: expected" in capsys.readouterr().err
    (folder / "low.csv").write_text("q1,q2,q3,q4,q5\n0,0,-0.3,2.5,1.2\n")
    assert run(f"evaluate --starts '{folder}/low.csv'") == 1
    assert "low.csv: row 2: expected the whole arm above" in capsys.readouterr().err
    assert run("evaluate --policy", folder / "net.npz") == 1
    assert "policy" in capsys.readouterr().err


def test_evaluate__tunes_baselines_without_gains(folder, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(baselines, "TUNING_RUNS", 1)
    monkeypatch.setattr(baselines, "GENERATIONS", 1)
    (tmp_path / "p.npz").write_bytes(SHIPPED_POLICY.read_bytes())
    out = tmp_path / "e.json"
    files = f"--policy '{tmp_path}/p.npz' --commands '{folder}/c.csv'"
    assert run(f"evaluate {files} --num-starts 1 --json", out) == 0
    assert "gains of the baselines: tuned now" in capsys.readouterr().err
    meta = json.loads(out.read_text())["meta"]
    assert (meta["gains"], meta["starts"]) == ("tuned now", "1")


def test_shipped_policy__beats_the_papers_controllers(tmp_path):
    """Its file holds what made it and how good it was; on the plant it is so again."""
    training = load_policy(SHIPPED_POLICY, BROKK_170).training
    before = training["velocity_error_mean"]
    assert (training["command"], training["seed"]) == ("brokk-min reproduce --seed 0", 0)
    gains = json.loads(SHIPPED_GAINS.read_text())
    assert {*gains["gains"], *POLICIES} == set(before)
    assert gains["meta"]["seed"] == 0
    assert run("evaluate --num-starts 4 --json", tmp_path / "e.json") == 0
    rows = summary(json.loads((tmp_path / "e.json").read_text())["runs"])
    now = {name: row["all"]["velocity_error_mean"] for name, row in rows.items()}
    assert set(before) == set(now)
    for errors in (before, now):
        assert 0 < errors["rl"] < min(errors["jacobian_pid_k0.1"], errors["jacobian_pid_k0.05"])


def test_starts__are_drawn_into_a_file_that_reads_back(tmp_path):
    assert run("starts --num 4 --out", tmp_path / "s.csv") == 0
    starts = read_starts(tmp_path / "s.csv", BROKK_170)
    assert start_kinds(BROKK_170, starts) == ["workspace", "limits", "workspace", "extended"]


def test_preliminary__writes_figures_and_numbers(tmp_path):
    net = load_policy(SHIPPED / "brokk170" / "policy.npz", BROKK_170).net
    save_net(tmp_path / "net.npz", net)
    assert (
        run("preliminary", "--actuator", tmp_path / "net.npz", "--out", tmp_path / "a" / "b") == 0
    )
    found = json.loads((tmp_path / "a" / "b" / "preliminary.json").read_text())
    assert found["meta"]["actuator"] == str(tmp_path / "net.npz")
    assert found["sim_to_real"]["tool"]["position_error_mean"] == pytest.approx(0.018, abs=0.001)
    figures = {path.name for path in (tmp_path / "a" / "b").glob("*.png")}
    assert figures == {"preliminary.png", "sim_to_real.png"}
