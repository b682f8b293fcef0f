"""README and pages are true: examples run, commands exist, links resolve, tables count right.

`python tests/paper/test_docs.py` writes the line counts of the README. PAPER.md has test_paper.py.
"""

import doctest
import json
import os
import re
import shlex
import subprocess
from pathlib import Path

import pytest

from brokk_min.__main__ import COMMANDS, main
from brokk_min._files import SHIPPED, digest
from brokk_min.machine import BROKK_170

ROOT = Path(__file__).parents[2]
README = ROOT / "README.md"
PAGES = [README, ROOT / "PAPER.md", *sorted(ROOT.glob("d*/*.md"))]
NAMES = [str(page.relative_to(ROOT)) for page in PAGES]
ROW = re.compile(r"^\| \[`(\w+)\.py`\]\(brokk_min/\1\.py\) \| (\d+) \|", re.M)


def test_readme__lists_the_files_of_the_method_with_their_lines() -> None:
    text = README.read_text()
    assert counted(text) == text, "run `python tests/paper/test_docs.py`"
    listed = ["__init__", "machine", "kinematics", "actuator", "fit", "jacobian"]
    listed += ["settings", "env", "ppo", "hw"]
    assert [name for name, _ in ROW.findall(text)] == listed


def counted(text: str) -> str:
    """The README with the line counts of today."""

    def row(match: re.Match[str]) -> str:
        lines = (ROOT / "brokk_min" / f"{match[1]}.py").read_text().count("\n")
        return match[0].replace(f"| {match[2]} |", f"| {lines} |")

    return ROW.sub(row, text)


RESULT = re.compile(r"^\| .*?(PID|PPO).*? \| ([\d.]+) \| ?([\d.]*) \| ?(.*) ?\|$", re.M)
SHOWN = ("pid_by_hand", "jacobian_pid_k0.1", "rl_paper", "rl", "jacobian_pid_ff_integral")


def test_readme__results_are_those_of_the_shipped_files() -> None:
    """`reproduce` writes table.json."""
    table = json.loads((SHIPPED / "brokk170" / "table.json").read_text())["table"]
    rows = RESULT.findall(README.read_text())
    assert len(rows) == len(SHOWN)
    for name, (_, error, drift, _) in zip(SHOWN, rows, strict=True):
        assert f"{table[name]['velocity_error_mean']['mean']:.4f}" == error
        assert f"{table[name]['off_axis_drift_max']['mean']:.3f}" == drift


@pytest.mark.parametrize("table", sorted(SHIPPED.rglob("*.json")), ids=lambda path: path.name)
def test_shipped_tables__name_the_files_beside_them(table: Path) -> None:
    """Seeds of a sweep are not shipped, but for the one that is the policy."""
    meta = json.loads(table.read_text())["meta"]
    beside = {name: digest(table.parent / name) for name in os.listdir(table.parent)}
    for name, fingerprint in meta.get("files", {}).items():
        assert name.startswith("seed_") or beside.get(name) == fingerprint, name


CHANGED = re.compile(r"^\| (.+?) \| (\d\.\d{4} →[^|]*) \| (\d\.\d{4} →[^|]*) \|$", re.M)


def test_readme__errors_on_changed_machines_are_those_of_the_sweep() -> None:
    """Columns: our agent, the strongest PID; each plain, cold and warm."""
    cases = json.loads((SHIPPED / "brokk170" / "robustness.json").read_text())["robustness"]
    rows = [row for row in CHANGED.findall(README.read_text()) if row[0] in cases]
    assert len(rows) == 3
    for name, *cells in rows:
        for controller, cell in zip(("rl", "jacobian_pid_ff_integral"), cells, strict=True):
            of = [cases[name][f"{controller}{start}"] for start in ("", "+cold", "+warm")]
            assert cell == " → ".join(f"{number['mean']:.4f}" for number in of), name


def test_readme__lists_the_wings() -> None:
    wings = {path.parent.name for path in (ROOT / "brokk_min").glob("*/__init__.py")}
    assert set(re.findall(r"`(\w+)/`", README.read_text())) == wings


@pytest.mark.parametrize("page", [README, ROOT / "docs" / "course.md"], ids=lambda page: page.stem)
def test_examples__run(page: Path) -> None:
    failed, run = doctest.testfile(str(page), module_relative=False)
    assert run >= 8
    assert failed == 0


@pytest.mark.parametrize("name", NAMES)
def test_links__resolve(name: str) -> None:
    """Anchors are as GitHub makes them: lower case, without punctuation, hyphens for spaces."""
    page = ROOT / name
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.M | re.S)
    targets = re.findall(r"\]\(([^)#\s]*)#?([^)\s]*)\)", text)
    targets += re.findall(r"^\[[^]]+\]: ([^#\s]+)()", text, re.M)
    for target, anchor in targets:
        if "://" in target:
            continue
        path = page.parent / target if target else page
        assert path.exists(), target
        if anchor and path.suffix == ".md":
            headings = re.findall(r"^#+ (.*)$", path.read_text(), re.M)
            slugs = [re.sub(r"[^\w\- ]", "", h.lower()).replace(" ", "-") for h in headings]
            assert slugs.count(anchor) == 1, (target, anchor)


LINE = re.compile(r"^ *brokk-min (.*?)(?: {2,}#.*)?$", re.M)
LINES = sorted({line for page in PAGES for line in LINE.findall(page.read_text())})


@pytest.mark.parametrize("line", LINES)
def test_command_lines__are_understood(line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Their options are read; what the commands do has tests of its own."""
    words = shlex.split(line)
    ran: list[object] = []
    command = COMMANDS[words[0]]
    monkeypatch.setattr(command, "find_machine", lambda self: BROKK_170)
    monkeypatch.setattr(command, "__call__", lambda self, machine: ran.append(self))
    assert main(words) == 0
    assert len(ran) == 1


REVIEW = (ROOT / "docs" / "review.md").read_text()


@pytest.mark.parametrize("call", re.findall("^grep .*$", REVIEW, re.M))
def test_review__its_searches_find_nothing(call: str) -> None:
    done = subprocess.run(shlex.split(call), cwd=ROOT, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (1, "", "")


if __name__ == "__main__":
    README.write_text(counted(README.read_text()))
