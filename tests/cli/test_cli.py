"""The command line as a user meets it: help, a foreign log, refusals in one line, exit statuses."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from benchmarks.rollout import random_net
from brokk_min.__main__ import COMMANDS, main
from brokk_min.cli.options import SHIPPED, WrongUse, check, chosen_policy, machine_from
from brokk_min.evaluation import baselines, experiments
from brokk_min.evaluation.metrics import summary
from brokk_min.identification.logs import Log, Recording, read_log, write_log
from brokk_min.identification.net_file import load_net
from brokk_min.learning.policy import load_policy
from brokk_min.machine import BROKK_170


def run(*arguments: object) -> int:
    """Exit status of one command; tyro leaves by SystemExit on wrong use and help."""
    try:
        return main([str(a) for a in arguments])
    except SystemExit as stop:
        return int(stop.code or 0)


@pytest.mark.parametrize("command", list(COMMANDS))
def test_each_command_has_help(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(command, "--help") == 0
    assert "--seed" in capsys.readouterr().out


def test_the_designs_options_exist(capsys: pytest.CaptureFixture[str]) -> None:
    wanted = {
        "collect": ["--out", "--hours", "--excitation", "--machine"],
        "fit": ["--out", "--test", "--json", "--figure", "--history", "--paper"],
        "preliminary": ["--actuator", "--out"],
        "train": ["--actuator", "--out", "--total-steps", "--num-envs", "--resume"],
        "sweep": ["--actuator", "--out", "--seeds", "--scheduler", "--gains", "--total-steps"],
        "evaluate": [
            "--policy",
            "--commands",
            "--starts",
            "--num-starts",
            "--perfect-model",
            "--plant",
            "--json",
        ],
        "starts": ["--out", "--num"],
        "reproduce": ["--out", "--quick"],
        "machine": ["--interface", "--channel", "--record"],
        "drive": [
            "--policy",
            "--interface",
            "--channel",
            "--command",
            "--controller",
            "--log",
            "--replay",
        ],
        "convert": ["--out"],
        "export": ["--policy", "--out"],
    }
    for command, options in wanted.items():
        run(command, "--help")
        text = capsys.readouterr().out
        assert not [o for o in options if o not in text], command


@pytest.mark.parametrize(
    ("arguments", "status", "message"),
    [
        (["collect", "--out", "x.csv", "--hours", "0"], 2, "--hours"),
        (["collect", "--out", "x.txt"], 2, "--out"),
        (["collect"], 2, "--out"),
        (["collect", "--out", "x.csv", "--machine", "digger"], 2, "brokk170"),
        (["nonsense"], 2, "nonsense"),
        (["fit", "--out", "n.npz"], 2, "brokk-min: LOGS: expected at least one log, got none"),
        (["fit", "missing.csv", "--out", "n.npz"], 1, "missing.csv"),
        (
            ["fit", "missing.csv", "--out", "n.npz", "--dead-zone", "1.5"],
            2,
            "--dead-zone: expected 0 to 0.99",
        ),
        (["train", "--actuator", "missing.npz", "--out", "p.npz"], 1, "missing.npz"),
        (
            ["train", "--actuator", "missing.npz", "--out", "p.npz", "--num-envs", "0"],
            2,
            "--num-envs",
        ),
        (["sweep", "--actuator", "missing.npz", "--out", "s"], 1, "missing.npz"),
        (["sweep", "--actuator", "missing.npz", "--out", "s", "--seeds", "0"], 2, "--seeds"),
        (["evaluate", "--policy", "missing.npz"], 1, "missing.npz"),
        (
            ["evaluate", "--policy", "missing.npz", "--plant", "net", "--perfect-model"],
            2,
            "--perfect-model",
        ),
        (["evaluate", "--policy", "missing.npz", "--num-starts", "0"], 2, "--num-starts"),
        (["starts", "--out", "missing/s.csv"], 2, "missing/s.csv"),
        (["machine", "--interface", "nonsense", "--channel", "0"], 1, "nonsense"),
        (["machine", "--interface", "virtual", "--channel", "0", "--start", "9", "9"], 1, "start"),
        (["drive", "--policy", "missing.npz"], 2, "--interface"),
        (
            ["drive", "--policy", "missing.npz", "--interface", "virtual", "--channel", "0"],
            1,
            "missing.npz",
        ),
        (["drive", "--interface", "virtual", "--channel", "0"], 2, "--policy"),
        (
            [
                "drive",
                "--interface",
                "virtual",
                "--channel",
                "0",
                "--controller",
                "jog",
                "--joint",
                "q9",
            ],
            2,
            "--joint",
        ),
        (["convert", "missing.log", "--out", "log.csv"], 1, "missing.log"),
        (["preliminary", "--actuator", "missing.npz"], 1, "missing.npz"),
        (["export", "--policy", "missing.npz", "--out", "p.onnx"], 1, "missing.npz"),
    ],
)
def test_refusals_are_short_and_have_their_status(
    arguments: list[str],
    status: int,
    message: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(*arguments) == status
    said = capsys.readouterr()
    assert message in said.err + said.out
    assert "Traceback" not in said.err
    assert not list(tmp_path.iterdir())


def foreign_log(path: Path, seed: int, runs: int) -> None:
    """Another machine at 100 Hz with jitter: first-order joints, other names, angles only."""
    rng = np.random.default_rng(seed)
    lines = ["run,time,u_boom,u_arm,q_boom,q_arm"]
    for r in range(runs):
        q, v, u, t = np.array([0.3, -0.2]), np.zeros(2), np.zeros(2), 10.0 * r
        for k in range(2500):
            if k % 60 == 0:
                u = rng.uniform(-1, 1, 2)
            step = 0.01 + rng.uniform(-0.003, 0.003)
            v += step * (np.array([0.4, 0.7]) * u - v) / 0.15
            q = q + step * v
            lines.append(f"take {r},{t:.4f},{u[0]:.3f},{u[1]:.3f},{q[0]:.5f},{q[1]:.5f}")
            t += step
    path.write_text("\n".join(lines) + "\n")


def test_fit_takes_a_foreign_log_and_beats_the_last_value(tmp_path: Path) -> None:
    foreign_log(tmp_path / "log.csv", 0, 24)
    foreign_log(tmp_path / "test.csv", 1, 2)
    assert (
        run(
            "fit", tmp_path / "log.csv", "--out", tmp_path / "n.npz", "--test", tmp_path / "test.csv",
            "--json", tmp_path / "f.json", "--steps", 1500,
        )
        == 0
    )  # fmt: skip
    scores = json.loads((tmp_path / "f.json").read_text())["joints"]
    assert list(scores) == ["boom", "arm"]
    for joint in scores.values():
        assert joint["one_step_rmse"] < 0.5 * joint["persistence_rmse"]
        assert set(joint["free_run"]) == {"1", "5", "10"}  # 25 s recordings hold no 30 s run
        assert joint["free_run"]["10"]["velocity_rmse"] < 0.05


def test_the_papers_recipe_is_one_switch(tmp_path: Path) -> None:
    foreign_log(tmp_path / "log.csv", 0, 2)
    files = [tmp_path / "log.csv", "--out", tmp_path / "n.npz", "--json", tmp_path / "f.json"]
    assert run("fit", *files, "--steps", 3, "--paper") == 0
    settings = load_net(tmp_path / "n.npz").settings
    assert (settings["noise"], settings["rollout"], settings["steps"]) == (0, 1, 3)
    verdict = json.loads((tmp_path / "f.json").read_text())
    assert set(verdict) == {"meta", "joints", "tool", "warnings"}
    keys = {
        "one_step_rmse",
        "persistence_rmse",
        "free_run",
        "linear",
        "creep",
        "response_time",
        "outside",
    }
    assert all(set(joint) == keys for joint in verdict["joints"].values())


def test_a_test_log_in_which_a_joint_rests_or_moves_too_shortly_is_judged(tmp_path: Path) -> None:
    foreign_log(tmp_path / "log.csv", 0, 2)
    rest = [f"still,{k / 20},0,0,0.1,0.2" for k in range(200)]
    header = "run,time,u_boom,u_arm,q_boom,q_arm"
    short = [f"short,{k / 20},0.5,0,{k / 100},0.2" for k in range(8)]
    for i, lines in enumerate((rest, rest + short)):
        (tmp_path / "test.csv").write_text("\n".join([header, *lines]) + "\n")
        files = [
            "--test",
            tmp_path / "test.csv",
            "--json",
            tmp_path / f"{i}.json",
            "--figure",
            tmp_path / "f.png",
        ]
        assert (
            run("fit", tmp_path / "log.csv", "--out", tmp_path / "n.npz", *files, "--steps", 3) == 0
        )
    assert json.loads((tmp_path / "0.json").read_text())["joints"]["boom"]["free_run"]["5"]
    assert not json.loads((tmp_path / "1.json").read_text())["joints"]["boom"]["free_run"]


def test_a_bad_log_writes_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "log.csv"
    foreign_log(path, 0, 1)
    lines = path.read_text().splitlines()
    lines[16] = lines[16].replace("take 0,", "take 0,x", 1)
    path.write_text("\n".join(lines))
    assert run("fit", path, "--out", tmp_path / "n.npz", "--json", tmp_path / "f.json") == 1
    assert "row 17, column time: expected a number" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["log.csv"]


def test_collect_fit_train_resume_evaluate(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, net, policy = (tmp_path / name for name in ("log.csv", "net.npz", "policy.npz"))
    assert run("collect", "--out", log, "--hours", 0.02, "--excitation", "sine") == 0
    assert read_log([log], 4).joints == ("q1", "q2", "q3", "q4", "q5")
    assert run("fit", log, "--out", net, "--steps", 50) == 0
    small = ["--total-steps", 2048, "--num-envs", 16, "--horizon", 16, "--minibatch-size", 128]
    assert run("train", "--actuator", net, "--out", policy, "--resume", *small) == 0
    assert (tmp_path / "policy.npz.csv").read_text().startswith("global_step,charts/")
    commands, starts = tmp_path / "c.csv", tmp_path / "s.csv"
    commands.write_text("sequence,time,vx,vy,vz\nup,0,0,0,0.1\nup,1,0,0,0\n")
    starts.write_text("q1,q2,q3,q4,q5\n0,0.5,0.58,1.71,1.24\n")
    gains = {k: [0.5] * 4 for k in ("kp", "ki", "kd")} | {"feedback": [0.1], "ready": [0.01]}
    names = ("jacobian_pid_k0.1", "jacobian_pid_k0.05", "jacobian_pid_ff", "jacobian_pid_ff_awake")
    about = baselines.gains_metadata(BROKK_170, load_policy(policy, BROKK_170).net)
    table = {"meta": about, "gains": dict.fromkeys(names, gains)}
    (tmp_path / "gains.json").write_text(json.dumps(table))
    for plant in ("analytic", "net"):
        where = tmp_path / f"{plant}.json"
        options = ["--commands", commands, "--starts", starts, "--plant", plant, "--json", where]
        assert run("evaluate", "--policy", policy, *options) == 0
        written = json.loads(where.read_text())
        runs, meta = written["runs"], written["meta"]
        files = {
            "policy": policy,
            "commands": commands,
            "starts": starts,
            "gains": tmp_path / "gains.json",
        }
        assert {name: meta[name] for name in files} == {
            name: str(file) for name, file in files.items()
        }
        assert (meta["plant"], meta["machine"], meta["seed"]) == (plant, "brokk170", 0)
        assert [r["controller"] for r in runs] == ["rl", *names]
        assert {(r["sequence"], r["start"]) for r in runs} == {("up", 0)}
    bound = ["--commands", commands, "--starts", starts, "--perfect-model", "--json", where]
    assert run("evaluate", "--policy", policy, *bound) == 0
    runs = json.loads(where.read_text())["runs"]
    best = sorted(runs, key=lambda r: r["velocity_error_mean"])[:2]  # awake valves answer sooner
    assert [run["controller"] for run in best] == ["perfect_model", "perfect_model_no_dither"]
    shipped = ["--starts", starts, "--gains", SHIPPED / "brokk170" / "gains.json"]  # of other nets
    capsys.readouterr()
    assert run("evaluate", "--policy", policy, *shipped) == 1
    assert re.search(rf"with nets {about['actuator']}, got .*gains for", capsys.readouterr().err)
    starts.write_text("q1,q2,q3,q4,q5\n0,0,-0.3,2.5,1.2\n")
    assert run("evaluate", "--policy", policy, "--starts", starts) == 1
    assert "s.csv: row 2: expected the whole arm above" in capsys.readouterr().err
    assert run("evaluate", "--policy", net) == 1
    assert "policy" in capsys.readouterr().err


def test_without_gains_the_baselines_are_tuned_and_that_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    net = random_net(np.random.default_rng(0)).select(["q1", "q3", "q4", "q5"])
    policy = SimpleNamespace(
        net=replace(net, machine="brokk170"), act=lambda seen: np.zeros((len(seen), 4))
    )
    monkeypatch.setattr("brokk_min.cli.commands.load_policy", lambda *_: policy)
    quick = experiments.Effort(generations=1, tuning_runs=1, starts=1)
    monkeypatch.setattr("brokk_min.evaluation.experiments.Effort", lambda: quick)
    where = tmp_path / "e.json"
    options = ["--num-starts", 1, "--json", where]
    assert run("evaluate", "--policy", tmp_path / "p.npz", *options) == 0
    names = "x, y, z, diagonal_flat, diagonal_rise, circle, rectangle, stop_and_go, slow"
    assert "gains of the baselines: tuned now" in capsys.readouterr().err
    meta = json.loads(where.read_text())["meta"]
    assert (meta["gains"], meta["commands"], meta["starts"]) == ("tuned now", names, "1")


@pytest.mark.parametrize(
    ("joints", "options", "dead_zone"),
    [
        (BROKK_170.names, [], 0.07),
        (BROKK_170.names, ["--dead-zone", "0"], 0.0),
        (BROKK_170.names, ["--paper"], 0.0),
        (("boom", "stick"), [], None),
        (("boom", "stick"), ["--dead-zone", "0.1"], 0.1),
    ],
)
def test_nets_get_the_dead_zone_of_a_known_machine_or_the_one_given(
    joints: tuple[str, ...],
    options: list[str],
    dead_zone: float | None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seen: list[Any] = []

    def stop(log: Any, settings: Any, *rest: Any) -> Any:
        seen.append((log.joints, settings.dead_zone))
        raise ValueError("enough")

    monkeypatch.setattr("brokk_min.cli.commands.fit", stop)
    q = np.cumsum(np.full((40, len(joints)), 0.01), axis=0)
    rows = [Recording(name, 0 * q, q, 0 * q) for name in "ab"]
    write_log(tmp_path / "log.csv", Log(joints, tuple(rows)))
    assert run("fit", tmp_path / "log.csv", "--out", tmp_path / "net.npz", *options) == 1
    assert seen == [(joints, dead_zone)]


@pytest.mark.parametrize("command", [name for name in COMMANDS if name not in ("train", "sweep")])
def test_only_training_imports_torch(command: str) -> None:
    code = "import sys; from brokk_min.__main__ import main\ntry: main(sys.argv[1:])\n"
    code += "finally: print('torch' in sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code, command, "--help"], capture_output=True, text=True
    )
    assert done.stdout.endswith("False\n"), done.stderr


def test_a_policy_comes_with_the_package_and_tracks(tmp_path: Path) -> None:
    """Its file says what made it and how good it was; driven again, it still beats the paper's way."""
    policy = load_policy(SHIPPED / "brokk170" / "policy.npz", BROKK_170)
    told = policy.training["velocity_error_mean"]
    assert (
        policy.training["command"] == "brokk-min reproduce --seed 0"
        and policy.training["seed"] == 0
    )
    assert told["rl"] < min(told["jacobian_pid_k0.1"], told["jacobian_pid_k0.05"])
    table = json.loads((SHIPPED / "brokk170" / "gains.json").read_text())
    assert set(table["gains"]) | {"rl"} == set(told) and table["meta"]["seed"] == 0
    assert run("evaluate", "--num-starts", 4, "--json", tmp_path / "e.json") == 0
    rows = summary(json.loads((tmp_path / "e.json").read_text())["runs"])
    errors = {name: row["all"]["velocity_error_mean"] for name, row in rows.items()}
    assert 0 < errors["rl"] < min(errors["jacobian_pid_k0.1"], errors["jacobian_pid_k0.05"])


def test_a_machine_without_a_policy_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    other = Path(__file__).parents[2] / "examples" / "mini_excavator.py"
    assert run("evaluate", "--machine", f"{other}:MINI_EXCAVATOR") == 1
    assert "policy.npz" in capsys.readouterr().err


# --- what options may be --------------------------------------------------------------------------------


def test_options_are_looked_for_in_the_command_its_settings_and_its_task(tmp_path: Path) -> None:
    def given(**more: object) -> SimpleNamespace:
        return SimpleNamespace(machine="brokk170", **more)

    assert (
        check(given(seed=0, hours=100)) is BROKK_170 and check(given(seed=2**31 - 1)) is BROKK_170
    )
    assert check(SimpleNamespace(machine="")) is BROKK_170  # none named: the Brokk
    inner = SimpleNamespace(num_envs=0, total_steps=5)
    with pytest.raises(WrongUse, match=r"^--num-envs: expected 1 to 1000000.0, got 0$"):
        check(given(settings=inner))
    with pytest.raises(WrongUse, match=r"^--zero-goals: expected 0 to 1, got 1.5$"):
        check(given(task=SimpleNamespace(zero_goals=1.5)))
    with pytest.raises(WrongUse, match=r"^--counts: expected 1 to 127, got 128$"):
        check(
            given(settings=inner, counts=128, num_envs=1)
        )  # the command's own count before its settings
    assert check(given(dead_zone=None)) is BROKK_170  # not given
    assert check(given(task=SimpleNamespace(hold_min_s=2.0, hold_max_s=2.0))) is BROKK_170
    with pytest.raises(WrongUse, match=r"^--hold-max-s: expected --hold-min-s or more, got 0.5$"):
        check(given(task=SimpleNamespace(hold_min_s=0.75, hold_max_s=0.5)))
    assert check(given(), tmp_path / "new.csv", None) is BROKK_170
    for path in (tmp_path, tmp_path / "missing" / "new.csv"):
        with pytest.raises(
            WrongUse, match=r": expected a file in an existing, writable directory$"
        ) as error:
            check(given(), None, path)
        assert str(error.value).startswith(f"{path}: ")


def test_a_machine_of_a_file_is_a_machine(tmp_path: Path) -> None:
    file = tmp_path / "a:b.py"
    file.write_text("from brokk_min.machine import BROKK_170 as MINE\nNONE = 3\n")
    assert check(SimpleNamespace(machine=f"{file}:MINE")) == BROKK_170
    with pytest.raises(WrongUse, match=r"^--machine: expected a Machine NONE in .*a:b.py, got 3$"):
        machine_from(f"{file}:NONE")
    with pytest.raises(
        WrongUse, match=r"^--machine: expected one of \['brokk170'\] or FILE.py:NAME, got digger$"
    ):
        machine_from("digger")
    file.write_text("raise KeyError('no')")
    with pytest.raises(
        ValueError, match=r"^--machine: expected .*a:b.py to run, got KeyError\('no'\)$"
    ):
        machine_from(f"{file}:MINE")


def test_gains_lie_beside_their_policy(tmp_path: Path) -> None:
    assert chosen_policy(BROKK_170, None, None) == (
        SHIPPED / "brokk170" / "policy.npz",
        SHIPPED / "brokk170" / "gains.json",
    )
    mine, gains = tmp_path / "p.npz", tmp_path / "gains.json"
    assert chosen_policy(BROKK_170, mine, None) == (mine, None)
    gains.touch()
    assert chosen_policy(BROKK_170, mine, None) == (mine, gains)
    assert chosen_policy(BROKK_170, mine, tmp_path / "other.json") == (
        mine,
        tmp_path / "other.json",
    )
