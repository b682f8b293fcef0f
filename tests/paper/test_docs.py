"""README is true: counts and examples. PAPER.md has test_paper.py."""

from __future__ import annotations

import doctest
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from brokk_min.__main__ import COMMANDS, main

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()


def test_the_module_table_counts_the_lines_of_every_module() -> None:
    table = dict(re.findall(r"^\| `(\w+)\.py` \| (\d+) \|", README, re.M))
    modules = {
        p.stem: str(len(p.read_text().splitlines())) for p in (ROOT / "brokk_min").glob("*.py")
    }
    assert table == modules


def test_readme_examples_run() -> None:
    failed, run = doctest.testfile(str(ROOT / "README.md"), module_relative=False)
    assert run >= 4 and failed == 0


def test_the_benchmark_of_rollouts_runs() -> None:
    command = [sys.executable, "-m", "benchmarks.rollout", "--num-envs", "4", "--ticks", "2"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0 and "steps" in done.stdout, done.stderr


PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
LINE = re.compile(r"^ *brokk-min (.*?)(?: {2,}#.*)?$", re.M)
LINES = {line for page in PAGES for line in LINE.findall(page.read_text())}


@pytest.mark.parametrize("line", sorted(LINES))
def test_every_command_line_of_the_documents_is_one(
    line: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its options are read; what the commands do has tests of its own (`test_cli.py`, `test_porting.py`)."""
    words, ran = shlex.split(line), []
    command = COMMANDS[words[0]]()
    monkeypatch.setattr(command, "run", lambda self: ran.append(self))
    monkeypatch.setitem(COMMANDS, words[0], lambda: command)
    assert main(words) == 0 and len(ran) == 1


def test_make_knows_the_targets_of_the_readme() -> None:
    for target in sorted(set(re.findall(r"^make (\w+)", README, re.M))):
        done = subprocess.run(["make", "-n", target], cwd=ROOT, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
