"""The command line as a user meets it: help, version, refusals in one line, exit statuses."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from helpers_cli import MINI, run

import brokk_min
from brokk_min.__main__ import COMMANDS

ROOT = Path(__file__).parents[2]
OPTIONS = {
    "collect": "--out --hours --excitation --machine --plant",
    "fit": "--out --test --json --figure --velocity-samples --history --dead-zone --paper --curve",
    "score": "--machine --json --figure",
    "inspect": "--machine --json",
    "preliminary": "--actuator --out",
    "train": "--actuator --out --total-steps --num-envs --resume --paper --critic --lag-cost",
    "sweep": "--critic --actuator --out --seeds --poses --scheduler --gains --total-steps --paper",
    "starts": "--out --num",
    "evaluate": "--policy --commands --starts --num-starts --perfect-model --plant --json --gains",
    "reproduce": "--out --quick --sweep",
    "family": "--out --members --quick",
    "machine": "--interface --channel --start --record --plant",
    "drive": "--policy --interface --channel --command --controller --counts --log --replay",
    "convert": "--out",
    "diagnose": "--policy --json --figure",
    "dbc": "--out --machine",
    "export": "--policy --out",
    "play": "--policy --gains --interface --channel --drive --attempts --log --start",
    "replay": "--out --rerun --fps --size --controllers --sequence --start",
}


def test_help__names_all_commands(capsys):
    assert run("--help") == 0
    printed = capsys.readouterr().out
    assert "Exits 0 done, 1 failed, 2 wrong use." in printed
    assert all(f"• {command} " in printed for command in OPTIONS)
    assert list(COMMANDS) == list(OPTIONS)


@pytest.mark.parametrize("command", list(COMMANDS))
def test_help__names_all_options(command, capsys):
    assert run(f"{command} --help") == 0
    printed = capsys.readouterr().out
    assert printed.startswith(f"usage: brokk-min {command} ")
    assert set(f"--seed {OPTIONS[command]}".split()) <= set(re.findall(r"--[\w-]+", printed))
    assert "--no-resume" not in printed


HELP = """
import contextlib, io, sys
from brokk_min.__main__ import COMMANDS, main
for words in (["--version"], ["--help"], *([command, "--help"] for command in COMMANDS)):
    with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()) as printed:
        main(words)
    assert printed.getvalue(), words
print({"torch", "scipy", "matplotlib", "gymnasium"} & set(sys.modules))
"""


def test_help__imports_nothing_slow():
    done = subprocess.run([sys.executable, "-c", HELP], capture_output=True, text=True)
    assert (done.stdout, done.stderr) == ("set()\n", "")


def test_version__is_that_of_the_project_and_of_its_citation(capsys):
    assert run("--version") == 0
    assert capsys.readouterr().out == f"brokk_min {brokk_min.__version__}\n"
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["version"] == brokk_min.__version__
    citation = (ROOT / "CITATION.cff").read_text()
    assert f"\nversion: {brokk_min.__version__}\n" in citation


DRIVE = "drive --interface virtual --channel 0"
TRAIN = "train --actuator missing.npz --out p.npz"
OUTPUTS = (  # refused before any work
    "collect --out",
    "fit l.csv --out n.npz --json",
    "train --actuator n.npz --out",
    "machine --interface virtual --channel c --record",
    "drive --interface virtual --channel c --controller jog --log",
    "play --attempts",
    "replay l.log --out",
)
UNWRITABLE = "brokk-min: no/x.csv: expected a file in an existing, writable directory"


@pytest.mark.parametrize(
    ("line", "status", "message"),
    [
        ("", 2, "COMMAND: expected one of collect, fit, score, inspect, preliminary, train, sweep"),
        ("nonsense", 2, "play, replay, got nonsense; see brokk-min --help"),
        ("collect", 2, "--out: expected a value, got none; see brokk-min collect --help"),
        ("collect --out x.csv --hours a", 2, "--hours: expected FLOAT, got 'a'"),
        ("collect --out x.csv --hurs 3", 2, "expected options such as --hours, got --hurs, 3"),
        ("collect --out x.csv more", 2, "expected no further words, got more"),
        ("collect --out x.csv --excitation noise", 2, "'ramp', 'joint', got noise"),
        (f"collect --out x.csv --o {'a' * 999}", 2, "got --o, aaa"),
        ("replay a.log --size 3", 2, "--size: expected 2 values, got fewer"),
        ("replay a.log --size 3 x", 2, "--size: expected INT INT, got ['3', 'x']"),
        (f"{TRAIN} --log-std-end a", 2, "--log-std-end: expected {None}|FLOAT, got ['a']"),
        ("collect --out x.csv --hours 0", 2, "--hours: expected 0.0001 to 100, got 0.0"),
        ("collect --out x.txt", 2, "--out: expected a name ending in .csv or .npz, got x.txt"),
        ("collect --out x.csv --machine digger", 2, "brokk170"),
        ("fit --out n.npz", 2, "LOGS: expected at least one log, got none"),
        ("fit missing.csv --out n.npz", 1, "missing.csv: expected a readable CSV table, got no su"),
        ("fit missing.csv --out n.npz --dead-zone 1.5", 2, "--dead-zone: expected 0 to 0.99"),
        ("fit a.csv --out n.npz --velocity-samples 20", 2, "--history of that or more, got 13"),
        ("fit a.csv --out n.csv", 2, "--out: expected a name ending in .npz, got n.csv"),
        ("fit a.csv --out n.npz --paper --noise 0.5", 2, "expected none with --paper, got 0.5"),
        ("fit log.mat --out n.npz", 1, "log.mat: expected a name ending in .csv or .npz"),
        (f"{TRAIN} --paper --valves dither", 2, "--valves: expected none with --paper, got dither"),
        (f"{TRAIN} --paper --limit-cost 1", 2, "--limit-cost: expected none with --paper, got 1.0"),
        (TRAIN, 1, "missing.npz"),
        (f"{TRAIN} --num-envs 0", 2, "--num-envs: expected 1 to 1000000, got 0"),
        (f"{TRAIN} --hold-min-s 9", 2, "--hold-max-s: expected 9.0 to 1000000.0, got 3.0"),
        ("sweep --actuator missing.npz --out s", 1, "missing.npz"),
        ("evaluate --policy missing.npz", 1, "missing.npz"),
        ("evaluate --starts s.csv --num-starts 2", 2, "expected none with --starts, got 2"),
        ("evaluate --policy missing.npz --plant net --perfect-model", 2, "--perfect-model"),
        (f"evaluate --machine '{MINI}'", 1, "policy.npz"),
        ("preliminary --actuator missing.npz", 1, "missing.npz"),
        ("machine --interface nonsense --channel 0", 1, "nonsense"),
        ("machine --interface virtual --channel 0 --start 9 9", 1, "start"),
        ("drive --policy missing.npz", 2, "--interface, --channel: expected a CAN bus"),
        ("drive --controller jog --channel can0", 2, "--interface, --channel: expected a CAN bus"),
        (f"{DRIVE} --policy missing.npz", 1, "missing.npz"),
        (DRIVE, 2, "--policy: expected a policy that `train` wrote, got none"),
        (f"{DRIVE} --controller jog --joint q9", 2, "['q1', 'q3', 'q4', 'q5'], got q9"),
        (f"{DRIVE} --controller jog --counts 81", 2, "--counts: expected at most 80, got 81"),
        (f"{DRIVE} --controller jog --valves dither", 2, "expected none with --controller jog"),
        (f"{DRIVE} --controller jog --command c.csv", 1, "c.csv"),
        ("convert missing.log --out log.csv", 1, "missing.log"),
        ("export --policy missing.npz --out p.onnx", 1, "missing.npz"),
        ("play --drive", 2, "--interface, --channel: expected both"),
        ("play --interface nonsense --channel 0", 1, "nonsense 0: expected a CAN bus"),
        ("play --drive --interface nonsense --channel 0 --log a.log", 1, "nonsense 0: expected a"),
        (f"play --machine '{MINI}' --start 9 9 9 9", 1, "start: expected 4 angles"),
        ("replay a.log b.log c.log", 2, "LOGS: expected one or two, got 3"),
        (
            "replay a.log b.log --size 639 540",
            2,
            "expected 640 320 to 4000 4000 for 2 arms, got 639 ",
        ),
        ("replay a.json --controllers rl --size 4001 540", 2, "for 1 arms, got 4001 540"),
        *((f"{line} no/x.csv", 2, UNWRITABLE) for line in OUTPUTS),
    ],
)
def test_wrong_use__is_refused_in_one_line(line, status, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    assert run(line) == status
    printed = capsys.readouterr()
    refusal = printed.err.splitlines()[-1]
    assert refusal.startswith("brokk-min: ") and message in refusal and len(refusal) <= 300
    assert not re.search("Traceback|Error|Errno", printed.err)
    assert status == 1 or (printed.out, printed.err) == ("", f"{refusal}\n")
    assert not list(tmp_path.iterdir())


def test_interrupt__is_one_line(monkeypatch, capsys):
    def interrupt(command):
        raise KeyboardInterrupt

    monkeypatch.setattr(COMMANDS["starts"], "__call__", interrupt)
    assert run("starts --out s.csv") == 1
    assert capsys.readouterr().err == "brokk-min: stopped\n"
