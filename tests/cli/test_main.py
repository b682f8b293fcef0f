"""The command line as a user meets it: help, version, refusals in one line, exit statuses."""

import os
import signal
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from helpers_cli import run

import brokk_min
from brokk_min.cli.training import FIRST_STEPS
from brokk_min.learning.recipes import find_recipe

ROOT = Path(__file__).parents[2]


def test_help__shows_the_defaults_of_the_agent_that_is_named(capsys):
    for words in ([], ["--paper"], ["--paper", "--critic"]):
        assert run(" ".join(["train", *words, "--help"])) == 0
        learner = find_recipe("--paper" in words, "--critic" in words).learner
        page = " ".join(capsys.readouterr().out.split())
        steps = learner.total_steps if words else FIRST_STEPS
        assert f"(default: {steps})" in page and f"(default: {learner.gamma})" in page


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


WITHOUT_TORCH = """
import sys
class Blocked:
    def find_spec(name, *_):
        if name in ("torch", "dask", "distributed", "jinja2", "onnxscript"):
            raise ModuleNotFoundError(f"No module named {name!r}")
sys.meta_path.insert(0, Blocked)
from brokk_min import shadow
from brokk_min.__main__ import main
from brokk_min.viewer import play, replay
for line in (
    "collect --out log.npz --hours 0.001",
    "inspect log.npz",
    "evaluate --num-starts 1 --commands c.csv",
    "fit log.npz --out net.npz",
    "train --actuator net.npz --out policy.npz",
    "sweep --actuator net.npz --out folder",
    "reproduce --out folder",
    "export --policy policy.npz --out policy.onnx",
):
    print(line.split()[0], main(line.split()), file=sys.stderr)
"""


def test_commands__need_no_torch_or_say_how_to_install_it(tmp_path):
    (tmp_path / "c.csv").write_text("sequence,time,vx,vy,vz\nup,0,0,0,0.1\nup,1,0,0,0\n")
    command, environment = [sys.executable, "-c", WITHOUT_TORCH], {"PYTHONPATH": str(ROOT)}
    options = {"cwd": tmp_path, "env": os.environ | environment}
    done = subprocess.run(command, **options, capture_output=True, text=True)
    said = done.stderr.splitlines()
    assert {"collect 0", "inspect 0", "evaluate 0"} <= set(said), said
    for name in ("fit", "train", "sweep", "reproduce"):
        line = said[said.index(f"{name} 1") - 1]
        assert line.startswith("brokk-min: torch: expected pip install -c constraints.txt -e '.[tr")
    assert "onnxscript: expected pip install -c constraints.txt -e '.[export]'" in said[-2]
    assert [path.name for path in tmp_path.iterdir() if path.suffix != ".csv"] == ["log.npz"]


@pytest.mark.parametrize("line", ["--help", "fit --help"])
def test_main__is_silent_if_nobody_reads(line):
    """As under `| true`, and ends on the narrowest terminal."""
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "brokk_min", *line.split()]
    environment = os.environ | {"COLUMNS": "1", "PYTHONPATH": str(ROOT)}
    pipes = {"stdout": writer, "stderr": subprocess.PIPE}
    done = subprocess.run(command, env=environment, timeout=60, **pipes)
    os.close(writer)
    assert (done.returncode, done.stderr) == (1, b"")


GERMAN = """
from dataclasses import replace
from brokk_min.machine import BROKK_170
*arm, bucket = BROKK_170.joints
GERMAN = replace(BROKK_170, name="bagger", joints=(*arm, replace(bucket, name="Löffel")))
"""


def test_files__are_utf_8_in_any_locale(tmp_path):
    """Written and read with names of joints that the locale cannot write."""
    (tmp_path / "names.py").write_text(GERMAN, encoding="utf-8")
    locale = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    for line in ("collect --out g.csv --hours 0.001", "inspect g.csv"):
        words = [*line.split(), "--machine", "names.py:GERMAN"]
        command = [sys.executable, "-c", f"from brokk_min.__main__ import main; main({words})"]
        environment = os.environ | locale | {"PYTHONPATH": str(ROOT)}
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True)
        assert (done.returncode, done.stderr) == (0, b"") and b"L?ffel" in done.stdout
    assert "q_Löffel" in (tmp_path / "g.csv").read_text(encoding="utf-8")


def test_version__is_that_of_the_project_and_of_its_citation(capsys):
    assert run("--version") == 0
    assert capsys.readouterr().out == f"brokk_min {brokk_min.__version__}\n"
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["version"] == brokk_min.__version__
    assert f"\nversion: {brokk_min.__version__}\n" in (ROOT / "CITATION.cff").read_text()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signals__end_a_command_in_one_line(number, monkeypatch, capsys):
    collect = "brokk_min.cli.identification.Collect.__call__"
    monkeypatch.setattr(collect, lambda *_: signal.raise_signal(number))
    assert run("collect --out x.csv") == 1
    assert capsys.readouterr().err == "brokk-min: stopped\n"


TRAIN = "train --actuator missing.npz --out p.npz"
VIRTUAL = "drive --interface virtual --channel v"


@pytest.mark.parametrize(
    ("line", "status", "message"),
    [
        ("nonsense", 2, "replay, export, got 'nonsense'"),
        ("collect --out x.txt", 2, "--out: expected a name in .csv or .npz, got x.txt"),
        ("collect --out none/x.csv", 2, "none/x.csv: expected a file in an existing, writable"),
        ("collect --out x.csv --hours 0", 2, "--hours: expected above 0, to 100, got 0.0"),
        ("collect --out x.csv --seed -1", 2, "--seed: expected 0 or more, got -1"),
        ("collect --out x.csv --machine digger", 2, "--machine: expected brokk170 or FILE.py"),
        ("inspect", 2, "LOGS: expected one file or more, each once, got none"),
        ("inspect drive.log --map q1=boom:deg", 2, "--map: expected a table or a recording"),
        ("inspect l.csv --map boom=q_boom:rad", 2, "--map: expected NAME=COLUMN or NAME=COLUMN:U"),
        ("machine --interface virtual --channel 0 --fault bad", 2, "--fault: expected [NAME:]KIND"),
        ("fit missing.csv --out n.npz", 1, "missing.csv: no such file or directory"),
        ("fit l.csv --out n.npz --no-valve --members 3", 2, "--members: expected 1 of nets"),
        ("fit l.csv --out n.txt", 2, "--out: expected a name in .npz, got n.txt"),
        ("fit l.csv --out n.npz --batch-size 0", 2, "--batch-size: expected a positive number"),
        (f"{TRAIN} --zero-goals 2.5", 2, "--zero-goals: expected 0 to 1, got 2.5"),
        (f"{TRAIN} --episode-s nan", 2, "--episode-s: expected a positive number, got nan"),
        (f"{TRAIN} --gamma 1.0", 2, "--gamma: expected below 1, got 1.0"),
        (f"{TRAIN} --log-std nan", 2, "--log-std: expected a finite number, got nan"),
        (f"{TRAIN} --horizon 99999999", 2, "--horizon: expected a product up to 4,194,304, got"),
        (f"{TRAIN} --episode-s 0.01", 2, "--episode-s: expected a tick, 0.05 s, or more, got"),
        (f"{TRAIN} --hold-max-s 0.4", 2, "--hold-max-s: expected 0.5 or more, got 0.4"),
        ("sweep --actuator missing.npz --out s --seeds 0", 2, "--seeds: expected 1 or more, got 0"),
        ("evaluate --num-starts 0", 2, "--num-starts: expected 1 or more, got 0"),
        (f"{VIRTUAL} --valves v.json", 2, "--valves: expected --adapt or --shadow with it"),
        (f"{VIRTUAL} --adapt --controller jog --joint q1", 2, "--adapt, --valves: expected a con"),
        ("machine --interface nonsense --channel 0", 1, "nonsense 0: expected a CAN bus, got"),
        (f"{VIRTUAL} --controller jog --joint q2", 2, "--joint: expected one of ['q1', 'q3',"),
        (f"{VIRTUAL} --controller jog --joint q1 --counts 81", 2, "--counts: expected 1 to 80"),
        (f"{VIRTUAL} --controller jog --joint q1", 1, "joystick: expected one, or --command FILE"),
        (f"{VIRTUAL} --sync", 2, "--sync: expected --shadow with it, got a drive that sends SYNC"),
        ("replay run.log --out a.mp4", 2, "--out: expected a name in .gif, got a.mp4"),
    ],
)
def test_wrong_use__is_refused_in_one_line(line, status, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run(line) == status
    printed, refusal = capsys.readouterr()
    assert refusal.count("\n") == 1 and not printed
    assert refusal.startswith("brokk-min: ") and message in refusal
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("line", ["collect", "collect --out x.csv --hours a", "train --hurs 3"])
def test_wrong_options__are_explained_and_leave_with_status_2(line, capsys):
    assert run(line) == 2
    assert "Traceback" not in capsys.readouterr().err
