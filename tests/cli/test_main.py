"""The command line as a user meets it: help, version, refusals in one line, exit statuses."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from helpers_cli import run

import brokk_min
from brokk_min.__main__ import COMMANDS

ROOT = Path(__file__).parents[2]
OPTIONS = {  # those that the README and the pages name
    "collect": "--out --hours --excitation --machine --plant --seed",
    "inspect": "--net --machine --json",
    "fit": "--out --test --json --paper --seed",
    "train": "--actuator --out --total-steps --resume --paper --gamma --hold-min-s --seed",
    "evaluate": "--policy --commands --starts --plant --json --gains --seed",
    "reproduce": "--out --quick --seed",
    "sweep": "--actuator --out --seeds --scheduler --total-steps --paper",
    "machine": "--interface --channel --plant",
    "drive": "--policy --interface --channel --command --controller --log",
    "play": "--policy",
    "replay": "--out",
    "export": "--policy --out",
}


def test_help__names_all_commands_and_what_they_do(capsys):
    assert run("--help") == 0
    printed = capsys.readouterr().out
    assert list(COMMANDS) == list(OPTIONS)
    for name, (_, _, text) in COMMANDS.items():
        assert re.search(rf"^  {name} +{re.escape(text)}$", printed, re.M)


@pytest.mark.parametrize("command", list(COMMANDS))
def test_help__names_all_options(command, capsys):
    assert run(f"{command} --help") == 0
    printed = capsys.readouterr().out
    assert printed.startswith(f"usage: brokk-min {command} ")
    assert set(OPTIONS[command].split()) <= set(re.findall(r"--[\w-]+", printed))


def test_help__shows_the_defaults_of_the_agent_that_is_named(capsys):
    for words, steps in (
        ("", 12_000_000),
        ("--paper", 30_000_000),
        ("--paper --critic", 6_000_000),
    ):
        assert run(f"train {words} --help") == 0
        assert f"(default: {steps})" in " ".join(capsys.readouterr().out.split())


HELP = """
import contextlib, io, sys
from brokk_min.__main__ import COMMANDS, main
for words in (["--version"], ["--help"], *([command, "--help"] for command in COMMANDS)):
    with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()) as printed:
        main(words)
    assert printed.getvalue(), words
print({"torch", "scipy", "matplotlib", "distributed"} & set(sys.modules))
"""


def test_help__imports_nothing_slow():
    done = subprocess.run([sys.executable, "-c", HELP], capture_output=True, text=True)
    assert (done.stdout, done.stderr) == ("set()\n", "")


def test_version__is_that_of_the_project_and_of_its_citation(capsys):
    assert run("--version") == 0
    assert capsys.readouterr().out == f"brokk_min {brokk_min.__version__}\n"
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["version"] == brokk_min.__version__
    assert f"\nversion: {brokk_min.__version__}\n" in (ROOT / "CITATION.cff").read_text()


TRAIN = "train --actuator missing.npz --out p.npz"


@pytest.mark.parametrize(
    ("line", "status", "message"),
    [
        ("", 2, "expected one of collect, inspect, fit, train, evaluate, reproduce, sweep"),
        ("nonsense", 2, "replay, export, got 'nonsense'"),
        ("collect --out x.txt", 2, "x.txt"),
        ("collect --out no/x.csv", 2, "no/x.csv: expected a file in an existing, writable folder"),
        ("collect --out x.csv --machine digger", 2, "--machine: expected brokk170 or FILE.py:NAME"),
        ("collect --out x.csv --machine digger.py:X", 1, "--machine: expected digger.py to run"),
        ("fit missing.csv --out n.npz", 1, "missing.csv"),
        (TRAIN, 1, "missing.npz: no such file or directory"),
        (f"{TRAIN} --total-steps 0", 2, "--total-steps: expected 1 or more, got 0"),
        (f"{TRAIN} --gamma 1", 2, "--gamma: expected 0 to below 1, got 1.0"),
        (f"{TRAIN} --hold-min-s 9", 2, "--hold-max-s: expected 9.0 or more, got 3.0"),
        ("train --actuator n.npz --out no/p.npz", 2, "no/p.npz: expected a file in an existing"),
        ("sweep --actuator missing.npz --out s", 1, "missing.npz"),
        ("sweep --actuator missing.npz --out s --seeds 0", 2, "--seeds: expected 1 or more, got 0"),
        ("evaluate --policy missing.npz", 1, "missing.npz"),
        ("machine --interface nonsense --channel 0", 1, "nonsense"),
        ("drive --interface virtual --channel 0 --policy missing.npz", 1, "missing.npz"),
        ("export --policy missing.npz --out p.onnx", 1, "missing.npz"),
    ],
)
def test_wrong_use__is_refused_in_one_line(line, status, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run(line) == status
    printed = capsys.readouterr()
    refusal = printed.err.splitlines()[-1]
    assert refusal.startswith("brokk-min: ") and message in refusal and len(refusal) <= 330
    assert not re.search("Traceback|Errno", printed.err)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("line", ["collect", "collect --out x.csv --hours a", "train --hurs 3"])
def test_wrong_options__are_explained_and_leave_with_status_2(line, capsys):
    assert run(line) == 2
    assert "Traceback" not in capsys.readouterr().err


def test_an_existing_file__is_kept_without_force(tmp_path, capsys):
    path = tmp_path / "p.npz"
    path.write_text("mine")
    assert run("train --actuator n.npz --out", path) == 2
    assert "expected no file (or --force), got one" in capsys.readouterr().err
    assert path.read_text() == "mine"
