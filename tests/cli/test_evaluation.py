"""The commands that train and compare, on small files: what they write and what they print."""

import json

import pytest
from helpers_cli import run

from brokk_min.cli.evaluation import print_answer
from brokk_min.env import TaskConfig
from brokk_min.evaluation import baselines
from brokk_min.evaluation.metrics import summary
from brokk_min.evaluation.sequences import read_starts, start_kinds
from brokk_min.identification.files import SHIPPED
from brokk_min.identification.logs import read_log
from brokk_min.identification.net_file import save_net
from brokk_min.learning.episodes import PAPER_TASK
from brokk_min.learning.policy import POLICIES, load_policy
from brokk_min.machine import BROKK_170
from brokk_min.ppo import PPOConfig

SHIPPED_POLICY = SHIPPED / "brokk170" / "policy.npz"
SHIPPED_GAINS = SHIPPED / "brokk170" / "gains.json"
SMALL = "--total-steps 512 --num-envs 16 --horizon 16 --minibatch-size 128"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A log, nets and a policy of the Brokk, made by the commands."""
    folder = tmp_path_factory.mktemp("chain")
    net = folder / "net.npz"
    assert run(f"collect --hours 0.02 --excitation sine --out '{folder}/log.csv'") == 0
    assert run(f"fit '{folder}/log.csv' --steps 20 --batch-size 256 --out", net) == 0
    options = f"--resume --valve-cost 0.01 {SMALL}"
    assert run(f"train --actuator '{net}' {options} --out", folder / "policy.npz") == 0
    (folder / "c.csv").write_text("sequence,time,vx,vy,vz\nup,0,0,0,0.1\nup,1,0,0,0\n")
    (folder / "s.csv").write_text("q1,q2,q3,q4,q5\n0,0.5,0.58,1.71,1.24\n")
    return folder


def test_train__writes_policy_and_curve(folder):
    assert read_log([folder / "log.csv"], 4).joints == ("q1", "q2", "q3", "q4", "q5")
    assert (folder / "policy.npz.csv").read_text().startswith("global_step,charts/")
    training = load_policy(folder / "policy.npz", BROKK_170).training
    assert training["task"]["valve_cost"] == 0.01
    assert training["settings"]["total_steps"] == 512
    assert training["settings"]["critic"] is False


def test_train__does_not_go_on_from_a_finished_training(folder, capsys):
    policy = folder / "policy.npz"
    before = policy.read_bytes()
    assert run(f"train --actuator '{folder}/net.npz' --resume {SMALL} --out", policy) == 2
    assert "policy.npz.checkpoint, got none: " in capsys.readouterr().err
    assert policy.read_bytes() == before


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
    net = load_policy(folder / "policy.npz", BROKK_170).net
    known = baselines.baselines(BROKK_170, net)
    meta = baselines.gains_metadata(BROKK_170, net)
    baselines.write_gains(folder / "gains.json", known, meta)
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
        assert [run["controller"] for run in written["runs"]] == ["rl", "rl_dither", *known]
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
    monkeypatch.setattr(baselines, "TUNING_SECONDS", 1.0)
    monkeypatch.setattr(baselines, "GENERATIONS", 1)
    (tmp_path / "p.npz").write_bytes(SHIPPED_POLICY.read_bytes())
    out = tmp_path / "e.json"
    files = f"--policy '{tmp_path}/p.npz' --commands '{folder}/c.csv'"
    tuned = tmp_path / "pid.json"
    assert run(f"evaluate {files} --num-starts 1 --save-gains '{tuned}' --json", out) == 0
    assert "gains of the baselines: tuned now" in capsys.readouterr().err
    first = json.loads(out.read_text())
    assert (first["meta"]["gains"], first["meta"]["starts"]) == ("tuned now", "1")
    files += f" --gains '{tuned}' --num-starts 1"
    assert run(f"evaluate {files} --json", out) == 0
    again = json.loads(out.read_text())
    assert again["meta"]["gains"] == str(tuned) and again["runs"] == first["runs"]
    assert run(f"evaluate {files} --save-gains", tmp_path / "other.json") == 2
    assert "--save-gains: expected gains to tune, got tuned ones in" in capsys.readouterr().err


def test_print_answer__names_the_best_of_each_class(capsys):
    errors = {"rl": 0.03, "rl_dither": 0.01, "jacobian_pid_k0.1": 0.04, "jacobian_pid_ff": 0.02}
    errors |= {"other_jacobian_dither": 0.06, "jacobian_pid_ff_integral_dither": 0.05}
    common = {"sequence": "x", "kind": "workspace", "start": 0}
    print_answer([common | {"controller": k, "velocity_error_mean": v} for k, v in errors.items()])
    printed = capsys.readouterr().out.splitlines()
    assert printed[0].startswith("rl has 25% less error than jacobian_pid_k0.1")
    assert {line.partition(": ")[0] for line in printed[1:3]} == {
        "rl has 50% more error than jacobian_pid_ff",
        "rl_dither has 80% less error than jacobian_pid_ff_integral_dither",
    }


def test_shipped_policy__beats_the_papers_controllers(tmp_path):
    """Its file holds what made it and how good it was; on the plant it is so again."""
    training = load_policy(SHIPPED_POLICY, BROKK_170).training
    before = training["velocity_error_mean"]
    assert (training["command"], training["seed"]) == ("brokk-min reproduce --seed 1", 1)
    gains = json.loads(SHIPPED_GAINS.read_text())
    assert {*gains["gains"], *POLICIES, "rl_dither"} == set(before)
    assert gains["meta"]["seed"] == 0
    up = "z,0,0,0,0.1\nz,2,0,0,-0.1\nz,4,0,0,0\nz,6,0,0,0\n"
    side = "y,0,0,0.1,0\ny,2,0,-0.1,0\ny,4,0,0,0\ny,6,0,0,0\n"
    (tmp_path / "c.csv").write_text(f"sequence,time,vx,vy,vz\n{up}{side}")
    files = f"--commands '{tmp_path}/c.csv' --json '{tmp_path}/e.json'"
    assert run(f"evaluate --num-starts 4 {files}") == 0
    rows = summary(json.loads((tmp_path / "e.json").read_text())["runs"])
    now = {name: row["all"]["velocity_error_mean"] for name, row in rows.items()}
    assert set(before) == set(now)
    for errors in (before, now):
        assert 0 < errors["rl"] < min(errors["jacobian_pid_k0.1"], errors["jacobian_pid_k0.05"])


def test_starts__are_drawn_into_a_file_that_reads_back(tmp_path):
    imports = "from dataclasses import replace\nfrom brokk_min import BROKK_170\n"
    (tmp_path / "m.py").write_text(f"{imports}SLOW = replace(BROKK_170, rate=5.0)\n")  # fewer ticks
    assert run(f"starts --num 4 --machine '{tmp_path}/m.py:SLOW' --out", tmp_path / "s.csv") == 0
    starts = read_starts(tmp_path / "s.csv", BROKK_170)
    assert start_kinds(BROKK_170, starts) == ["workspace", "limits", "workspace", "extended"]


def test_preliminary__writes_figures_and_numbers(tmp_path):
    net = load_policy(SHIPPED / "brokk170" / "policy.npz", BROKK_170).net
    save_net(tmp_path / "net.npz", net)
    out = tmp_path / "a" / "b"
    assert run("preliminary --actuator", tmp_path / "net.npz", "--out", out) == 0
    found = json.loads((out / "preliminary.json").read_text())
    assert found["meta"]["actuator"] == str(tmp_path / "net.npz")
    assert found["sim_to_real"]["tool"]["position_error_mean"] == pytest.approx(0.013, abs=0.001)
    assert {path.name for path in out.glob("*.png")} == {"preliminary.png", "sim_to_real.png"}
