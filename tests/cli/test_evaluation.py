"""The commands that compare, on small files: what they write, print and refuse."""

import json
import sys
from contextlib import suppress
from pathlib import Path

import pytest
from helpers_cli import run
from helpers_machines import obedient_net, pids

from brokk_min._files import SHIPPED
from brokk_min.evaluation import adaptive, baselines
from brokk_min.evaluation.rollout import TITLES
from brokk_min.learning.policy import POLICIES
from brokk_min.machine import BROKK_170

NET = obedient_net(BROKK_170)


def evaluate(folder, options=""):
    files = f"--policy {folder}/policy.npz --commands {folder}/c.csv --starts {folder}/s.csv"
    return run(f"evaluate {files} {options}")


def test_evaluate__writes_what_it_used_and_prints_means(folder, capsys, monkeypatch):
    out, errors = folder / "e.json", []
    files = {"policy": "policy.npz", "gains": "gains.json", "commands": "c.csv", "starts": "s.csv"}
    used = {key: str(folder / file) for key, file in files.items()}
    for plant in ("analytic", "net", f"{folder}/plant.py:PLANT"):
        assert evaluate(folder, f"--plant {plant} --json {out} --force") == 0
        meta, runs = json.loads(out.read_text()).values()
        assert (used | {"plant": plant, "machine": "brokk170"}).items() <= meta.items()
        assert [row["controller"] for row in runs] == ["rl_paper", *pids(BROKK_170, NET)]
        labels = {(row["sequence"], row["start"], row["kind"]) for row in runs}
        assert labels == {("up", 0, "file")}
        errors.append(tuple(row["velocity_error_mean"] for row in runs))
        assert errors[-1][0] == pytest.approx(0.1, rel=1e-6)  # the policy stands still
        printed = capsys.readouterr().out
        assert "means over 1 sequences from 1 starts" in printed
        assert f"{'strongest PID':56}{'closed':>15}{errors[-1][-1]:15.4g}" in printed
    assert len({*errors}) == 3
    assert evaluate(folder, f"--json {out}") == 2  # it is there
    out.unlink()
    with suppress(OSError), open("/dev/full", "w", buffering=1) as lost:  # what is printed
        monkeypatch.setattr(sys, "stdout", lost)
        assert evaluate(folder, f"--json {out}") == 1
    assert json.loads(out.read_text())["meta"].items() >= used.items()


BAD = """
import numpy as np
class Nan:
    def __init__(self, machine, net): pass
    def start(self, num): pass
    def __call__(self, measured, state): return np.nan * np.ones((len(measured.q), 5)), None
class Short(Nan):
    def __call__(self, measured, state): return np.ones((len(measured.q), 2)), None
class Ends(Nan):
    def start(self, num): raise SystemExit(0)
class Moves(Nan):
    def __call__(self, measured, state):
        import os; os.chdir("/")
        return 0.5 * np.ones((len(measured.q), 5)) * [1, 0, 1, 1, 1], None
class Locked(Nan):
    def __call__(self, measured, state): return np.ones((len(measured.q), 5)), None
class Counts(Nan):
    def __call__(self, measured, state): return np.full((len(measured.q), 5), 80), None
class Alone(Nan):
    def __call__(self, measured, state): return np.ones((len(measured.q), 5))
"""


def test_evaluate__takes_a_controller_of_ones_own(folder, capsys):
    example = Path(__file__).parents[2] / "examples" / "own_controller.py"
    (folder / "c+t.py").write_text(example.read_text())
    name = f"{folder}/c+t.py:Proportional"
    assert evaluate(folder, f"--controller {name} --json {folder}/own.json") == 0
    runs = json.loads((folder / "own.json").read_text())["runs"]
    own = next(run for run in runs if run["controller"] == name)
    assert own["velocity_error_mean"] < 0.07 < runs[0]["velocity_error_mean"]  # it moves up
    assert f"{name:56}{'-':>15}" in capsys.readouterr().out
    (folder / "bad.py").write_text(BAD)
    told = "finite numbers, got", "an array (1, 5), got (1, 2)", "commands and its state, got"
    told = *told, "0 for joints that are not driven, got", "parts of full command, -1 to 1, got"
    for kind, words in zip(("Nan", "Short", "Alone", "Locked", "Counts"), told, strict=True):
        named = f"--controller {folder}/bad.py:{kind}"
        assert evaluate(folder, f"{named} --save-gains {folder}/g.json") == 1
        said = capsys.readouterr().err
        assert words in said and "tuned now" not in said  # it is tried before
    assert evaluate(folder, f"--controller {folder}/bad.py:Ends") == 1
    assert "expected a controller whose start(num) gives its state" in capsys.readouterr().err
    before = Path.cwd()
    assert evaluate(folder, f"--controller {folder}/bad.py:Moves") == 0
    assert Path.cwd() == before
    (folder / "none.py").write_text("NUMBER = 3\n")
    assert evaluate(folder, f"--controller {folder}/none.py:NUMBER") == 1
    assert "NUMBER: expected a function of machine and nets" in capsys.readouterr().err
    assert evaluate(folder, "--controller policy") == 2
    assert "--controller: expected a name of --help or FILE.py:NAME" in capsys.readouterr().err


def test_evaluate__tunes_pids_anew_and_again_by_what_the_file_says(folder, capsys, monkeypatch):
    monkeypatch.setattr(baselines, "EFFORT", (1, 1, 1.0))
    monkeypatch.setattr(baselines, "CANDIDATES", 6)
    untuned = {name: pid.gains for name, pid in pids(BROKK_170, NET).items()}
    monkeypatch.setattr(baselines, "first_gains", lambda *_: dict(untuned))
    first, again, gains = (folder / name for name in ("1.json", "2.json", "pid.json"))
    assert evaluate(folder, f"--json {first} --save-gains {gains} --seed 3") == 0
    assert "gains of the baselines: tuned now" in capsys.readouterr().err
    meta = json.loads(gains.read_text())["meta"]
    assert (meta["seed"], meta["plant"], meta["effort"]) == (3, "analytic", [1, 1, 1.0])
    options = f"--save-gains {gains} --json {again} --force --seed {meta['seed']}"
    assert evaluate(folder, options) == 0
    first, again = (json.loads(file.read_text()) for file in (first, again))
    assert first["meta"]["gains"] == again["meta"]["gains"] == "tuned now"
    assert again["runs"] == first["runs"]


def test_evaluate__takes_the_packages_pids_where_a_policy_has_none(folder, monkeypatch):
    """With the nets that they know, not the policy's; on another plant they are tuned."""
    (folder / "gains.json").unlink()
    shipped = SHIPPED / BROKK_170.name
    assert evaluate(folder, f"--json {folder}/own.json") == 0
    policy = f"--policy '{shipped}/policy.npz'"
    assert evaluate(folder, f"--json {folder}/package.json {policy}") == 0
    own, package = (json.loads((folder / f"{n}.json").read_text()) for n in ("own", "package"))
    assert own["meta"]["gains"] == package["meta"]["gains"] == str(shipped / "gains.json")
    assert own["runs"][1:] == package["runs"][1:] and own["runs"][0] != package["runs"][0]
    monkeypatch.setattr(baselines, "tuned_baselines", lambda *_: {})
    assert evaluate(folder, f"--plant {folder}/plant.py:PLANT --json {folder}/e.json") == 0
    assert json.loads((folder / "e.json").read_text())["meta"]["gains"] == "tuned now"


def test_evaluate__has_policies_and_poses_of_the_package(folder, capsys, monkeypatch):
    """Also by the names of its files in its folder; and says whether the arm can follow."""
    assert run(f"evaluate --commands {folder}/c.csv --num-starts 3") == 0
    printed, said = capsys.readouterr()
    assert "means over 1 sequences from 3 starts" in printed and "warning" not in said
    monkeypatch.chdir(SHIPPED)
    policy = f"{BROKK_170.name}/policy_critic.npz"
    lines = "".join(f"far,{t},0,0,0.3\n" for t in range(0, 40, 2))
    (folder / "far.csv").write_text(f"sequence,time,vx,vy,vz\n{lines}")
    assert run(f"evaluate --policy {policy} --commands {folder}/far.csv --num-starts 3") == 0
    wanted = "warning: --commands: expected starts from which the arm can follow far (--starts), "
    assert f"{wanted}got 3 of 3 that leave" in capsys.readouterr().err
    assert all(f"\n{TITLES[name]}" in printed for name in POLICIES)


def test_reproduce__does_not_write_over_results(tmp_path, capsys):
    (tmp_path / "results.json").write_text("{}")
    assert run(f"reproduce --quick --out {tmp_path}") == 2
    assert "results.json: expected no file (or --force), got one" in capsys.readouterr().err
    assert (tmp_path / "results.json").read_text() == "{}"
    (tmp_path / "results.json").rename(tmp_path / "log.npz")
    assert run(f"reproduce --quick --out {tmp_path}") == 2
    assert "log.npz: expected no file (or --force), got one that" in capsys.readouterr().err
    assert (tmp_path / "log.npz").read_text() == "{}"
    (tmp_path / "log.npz").rename(tmp_path / "gains.json")  # of one's own, beside other logs
    assert run(f"reproduce --quick --out {tmp_path}") == 2
    assert "gains.json: expected no file (or --force), got one that" in capsys.readouterr().err
    (tmp_path / "gains.json").rename(tmp_path / "policy.npz.checkpoint")  # of a training
    assert run(f"reproduce --quick --out {tmp_path}") == 2
    assert "checkpoint: expected no file (or --force), got one of" in capsys.readouterr().err


def test_reproduce__does_not_go_on_from_checkpoints_of_another_chain(tmp_path, capsys, monkeypatch):
    """Of which it would hear after the fits alone; with --force it begins anew."""

    def stopped(_, out, budget, seed):
        (out / "policy.npz.checkpoint").write_text("of some hours")
        raise KeyboardInterrupt

    monkeypatch.setattr("brokk_min.evaluation.reproduce.reproduce", stopped)
    checkpoint = tmp_path / "policy.npz.checkpoint"
    for _ in range(2):  # the same goes on
        assert run(f"reproduce --quick --out {tmp_path}") == 1
    capsys.readouterr()
    for other in ("", "--quick --seed 1"):
        assert run(f"reproduce {other} --out {tmp_path}") == 2
        wanted = f"{checkpoint}: expected no file (or --force), got one of a chain with another"
        assert wanted in capsys.readouterr().err and checkpoint.exists()
    monkeypatch.setattr("brokk_min.evaluation.reproduce.reproduce", lambda *_: {}["task_space"])
    with pytest.raises(KeyError):
        run(f"reproduce --force --out {tmp_path}")
    assert not checkpoint.exists()


def test_evaluate__adapts_each_controller_cold_and_warm(folder, capsys, monkeypatch):
    monkeypatch.setattr(adaptive, "DRIVES", 2)
    monkeypatch.setattr(adaptive, "PARTS", 1)
    assert evaluate(folder, "--adapt") == 0
    printed = capsys.readouterr().out
    for name in ("rl_paper", *pids(BROKK_170, NET)):
        assert f"\n{TITLES[name]}, adaptive " in printed
        assert f"\n{TITLES[name]}, adaptive, warm " in printed
