"""README is true: counts and examples. PAPER.md has test_paper.py."""

from __future__ import annotations

import doctest
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()


def test_the_module_table_counts_the_lines_of_every_module() -> None:
    table = dict(re.findall(r"^\| `(\w+)\.py` \| (\d+) \|", README, re.M))
    modules = {p.stem: str(len(p.read_text().splitlines())) for p in (ROOT / "brokk_min").glob("*.py")}
    assert table == modules


def test_readme_examples_run() -> None:
    failed, run = doctest.testfile(str(ROOT / "README.md"), module_relative=False)
    assert run >= 4 and failed == 0


def test_the_benchmark_of_rollouts_runs() -> None:
    command = [sys.executable, "-m", "benchmarks.rollout", "--num-envs", "4", "--ticks", "2"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0 and "steps" in done.stdout, done.stderr
