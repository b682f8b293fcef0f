"""README and PAPER.md are true: counts, symbols, test files and examples."""

from __future__ import annotations

import doctest
import importlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

import brokk_min

ROOT = Path(__file__).parent.parent
README, PAPER = (ROOT / "README.md").read_text(), (ROOT / "PAPER.md").read_text()


def test_the_module_table_counts_the_lines_of_every_module() -> None:
    table = dict(re.findall(r"^\| `(\w+)\.py` \| (\d+) \|", README, re.M))
    modules = {p.stem: str(len(p.read_text().splitlines())) for p in (ROOT / "brokk_min").glob("*.py")}
    assert table == modules


def test_readme_examples_run() -> None:
    failed, run = doctest.testfile(str(ROOT / "README.md"), module_relative=False)
    assert run >= 4 and failed == 0


def rows(heading: str) -> list[list[str]]:
    part = PAPER.split(f"## {heading}\n")[1].split("\n## ")[0]
    lines = [line for line in part.splitlines() if line.startswith("|")][2:]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def symbols() -> list[str]:
    cells = [row[2] for row in rows("Equations, tables, figures") + rows("Constants")]
    return [s for cell in cells for s in re.findall(r"`([\w.]+)`", cell)]


@pytest.mark.parametrize("symbol", [s for s in symbols() if s not in ("hw", "ppo") and "test_" not in s])
def test_symbols_of_the_paper_map_exist(symbol: str) -> None:
    head, *names = symbol.split(".")
    owner = getattr(brokk_min, head, None)
    if head in ("TaskConfig", "PPOConfig", "FitConfig"):
        module = {"TaskConfig": "env", "PPOConfig": "ppo", "FitConfig": "actuator"}[head]
        owner = getattr(importlib.import_module(f"brokk_min.{module}"), head)
    elif owner is None or head.islower():
        owner = importlib.import_module(f"brokk_min.{head}")
    for name in names:
        known = getattr(owner, "__dataclass_fields__", {})
        assert hasattr(owner, name) or name in known, symbol
        owner = getattr(owner, name, None)


def test_every_row_has_a_status_and_a_test_that_exists() -> None:
    for name, _, _, tests, status in rows("Equations, tables, figures"):
        assert re.match(r"printed|corrected|assumed|option|plant only|not yet|in part", status), name
        for test in re.findall(r"`(test_\w+\.py)`", tests):
            assert (ROOT / "tests" / test).exists(), test
        assert tests or status == "not yet", name


def test_deviations_that_rows_name_are_listed() -> None:
    named = set(
        re.findall(r"\b([DA]\d+)\b", " ".join(" ".join(r) for r in rows("Equations, tables, figures")))
    )
    listed = set(re.findall(r"^- \*\*([DA]\d+)", PAPER, re.M))
    assert named <= listed


def test_docstrings_name_the_equations_that_have_rows() -> None:
    text = "".join(p.read_text() for p in (ROOT / "brokk_min").glob("*.py"))
    tagged = set(re.findall(r"Paper: (eq\d|Table \d)", text))
    assert tagged == {row[0] for row in rows("Equations, tables, figures") if row[0][:2] in ("eq", "Ta")}


def test_the_benchmark_of_rollouts_runs() -> None:
    command = [sys.executable, "-m", "benchmarks.rollout", "--num-envs", "4", "--ticks", "2"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0 and "steps" in done.stdout, done.stderr
