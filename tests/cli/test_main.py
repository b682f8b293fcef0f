"""The command line as a user meets it: help, version, refusals in one line, exit statuses."""

import json
import os
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
        ("--paper --critic", 30_000_000),
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


@pytest.mark.parametrize("encoding", ["cp850", "cp437", "cp932", "latin-1", "ascii"])
def test_help__is_printed_in_any_encoding(encoding):
    code = "import sys; from brokk_min.__main__ import main; sys.exit(main(['train', '--help']))"
    options = {"env": os.environ | {"PYTHONIOENCODING": encoding}, "encoding": encoding}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, **options)
    assert "--gamma" in done.stdout and (done.returncode, done.stderr) == (0, "")


GERMAN = """
from dataclasses import replace
from brokk_min import BROKK_170
*arm, bucket = BROKK_170.joints
GERMAN = replace(BROKK_170, name="bagger", joints=(*arm, replace(bucket, name="Löffel")))
"""


def test_files__are_utf_8_in_any_locale(tmp_path):
    """Written and read with names of joints that the locale cannot write."""
    (tmp_path / "names.py").write_text(GERMAN, encoding="utf-8")
    locale = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    for line in ("collect --out g.csv --hours 0.001", "inspect g.csv --json g.json"):
        words = [*line.split(), "--machine", "names.py:GERMAN"]
        command = [sys.executable, "-c", f"from brokk_min.__main__ import main; main({words})"]
        environment = os.environ | locale | {"PYTHONPATH": str(ROOT)}
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True)
        assert (done.returncode, done.stderr) == (0, b"") and b"L?ffel" in done.stdout
    assert "q_Löffel" in (tmp_path / "g.csv").read_text(encoding="utf-8")
    assert "Löffel" in json.loads((tmp_path / "g.json").read_text(encoding="utf-8"))["joints"]


def test_drawing__needs_no_backend_of_a_notebook():
    environment = os.environ | {"MPLBACKEND": "module://matplotlib_inline.backend_inline"}
    code = "import brokk_min.__main__, matplotlib; print(matplotlib.get_backend())"
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert (done.stdout, done.stderr) == ("agg\n", "")


def test_completion__for_a_shell_that_is_not_supported_is_one_line(capsys):
    assert run("train --tyro-print-completion tcsh") == 1
    assert capsys.readouterr().err.startswith("brokk-min: shtab is required for completion")


def test_version__is_that_of_the_project_and_of_its_citation(capsys):
    assert run("--version") == 0
    assert capsys.readouterr().out == f"brokk_min {brokk_min.__version__}\n"
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["version"] == brokk_min.__version__
    assert f"\nversion: {brokk_min.__version__}\n" in (ROOT / "CITATION.cff").read_text()


def test_ctrl_c__ends_a_command_in_one_line(monkeypatch, capsys):
    def interrupt(self):
        raise KeyboardInterrupt

    monkeypatch.setattr("brokk_min.cli.identification.Collect.__call__", interrupt)
    assert run("collect --out x.csv") == 1
    assert capsys.readouterr().err == "brokk-min: stopped\n"


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
