"""README and pages are true: examples run, commands exist, links resolve, tables count right.

`python tests/paper/test_docs.py` writes the line counts of the README. PAPER.md has test_paper.py.
"""

from __future__ import annotations

import ast
import contextlib
import doctest
import io
import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from gymnasium.spaces import Box

from brokk_min.__main__ import COMMANDS, main
from brokk_min.identification.files import SHIPPED
from brokk_min.learning.gym_env import TaskVectorEnv

ROOT = Path(__file__).parents[2]
README = ROOT / "README.md"
PAGES = [README, ROOT / "PAPER.md", *sorted((ROOT / "docs").glob("*.md"))]
NAMES = [str(page.relative_to(ROOT)) for page in PAGES]
METHOD = ["__init__", "machine", "kinematics", "actuator", "env", "ppo", "jacobian", "hw"]
ROW = re.compile(r"^\| \[`(\w+)\.py`\]\(brokk_min/\1\.py\) \| (\d+) \|", re.M)


def line_counts() -> list[tuple[str, str]]:
    """The files of the method in the order in which they are read, with their lines."""
    texts = [(ROOT / "brokk_min" / f"{name}.py").read_text() for name in METHOD]
    return [(name, str(text.count("\n"))) for name, text in zip(METHOD, texts, strict=True)]


def test_readme__lists_the_files_of_the_method_with_their_lines() -> None:
    assert ROW.findall(README.read_text()) == line_counts(), "run `python tests/paper/test_docs.py`"


def test_readme__lists_the_wings() -> None:
    wings = {path.parent.name for path in (ROOT / "brokk_min").glob("*/__init__.py")}
    assert set(re.findall(r"^- `(\w+)/`: ", README.read_text(), re.M)) == wings


SCORED = {  # rows of the README's table: controller of seeds.json
    "the paper's learner, on its nets | open": "paper",
    "ours | closed": "ours closed",
    "PID (the paper's), k = 0.1 and 0.05 | closed": "jacobian_pid_k0.1",
    "PID, feed-forward, integral, starts | closed": "jacobian_pid_ff_integral",
    "ours, the same policy | dither": "ours dither",
    "PID, feed-forward, integral, starts | dither": "jacobian_pid_ff_integral_dither",
}


@pytest.mark.parametrize("row", SCORED)
def test_readme__has_the_figures_of_ten_seeds(row: str) -> None:
    rows = json.loads((SHIPPED / "brokk170" / "seeds.json").read_text())
    found = [one for one in rows if one["controller"] == SCORED[row]]
    cells = []
    for key in ("error_xyz", "error"):
        values = np.array([one[key] for one in found])
        spread = f" ({np.ptp(values):.4f})" if len(values) > 1 else ""
        cells.append(f"{values.mean():.4f}{spread}")
    for key, digits in {"drift": 3, "jerk": 1, "valve_travel": 0}.items():
        cells.append(f"{np.mean([one[key] for one in found]):.{digits}f}")
    assert f"| {row} | {' | '.join(cells)} |\n" in README.read_text()


def test_readme__is_short() -> None:
    assert len(README.read_text().splitlines()) <= 130


@pytest.mark.parametrize("name", NAMES)
def test_pages__have_lines_of_at_most_100_columns(name: str) -> None:
    """Tables, commands and definitions of links may be wider."""
    lines = (ROOT / name).read_text().splitlines()
    wide = [
        line for line in lines if len(line) > 100 and not re.match(r"\||\[.*\]: |brokk-min ", line)
    ]
    assert not wide


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


def test_readme__examples_run() -> None:
    failed, run = doctest.testfile(str(README), module_relative=False)
    assert run >= 10
    assert failed == 0


def test_readme__has_the_sizes_of_observation_and_action() -> None:
    rows = re.findall(r"^\| ?(\w*) \| .* \| ([\dx ]+) \|$", README.read_text(), re.M)
    sizes = [(name, int(np.prod([int(n) for n in text.split("x")]))) for name, text in rows]
    env = TaskVectorEnv(1)
    observation, action = env.single_observation_space, env.single_action_space
    assert isinstance(observation, Box)
    assert isinstance(action, Box)
    assert sum(size for name, size in sizes if name in ("observation", "")) == observation.shape[0]
    assert [size for name, size in sizes if name == "action"] == [action.shape[0]]


LINE = re.compile(r"^ *brokk-min (.*?)(?: {2,}#.*)?$", re.M)
LINES = sorted({line for page in PAGES for line in LINE.findall(page.read_text())})


@pytest.mark.parametrize("line", LINES)
def test_command_lines__are_understood(line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Their options are read; what the commands do has tests of its own."""
    words = shlex.split(line)
    ran: list[object] = []
    monkeypatch.setattr(COMMANDS[words[0]], "__call__", lambda self: ran.append(self))
    assert main(words) == 0
    assert len(ran) == 1


OPTION = re.compile(rf"`(?:brokk-min )?({'|'.join(COMMANDS)}) (--[\w-]+)")
OPTIONS = {option for page in PAGES for option in OPTION.findall(page.read_text())}


@pytest.mark.parametrize("command", sorted({command for command, _ in OPTIONS}))
def test_options_in_the_text__exist(command: str) -> None:
    with contextlib.redirect_stdout(io.StringIO()) as printed, pytest.raises(SystemExit):
        main([command, "--help"])
    known = set(re.findall(r"--[\w-]+", printed.getvalue()))
    assert {option for name, option in OPTIONS if name == command} <= known


def test_make__has_the_targets_of_the_readme() -> None:
    targets = set(re.findall(r"`make (\w+)", README.read_text()))
    assert len(targets) == 2
    for target in targets:
        done = subprocess.run(["make", "-n", target], cwd=ROOT, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr


# --- docs/review.md -------------------------------------------------------------------------------

BLOCKS = re.findall(r"^```\n(.*?)^```$", (ROOT / "docs" / "review.md").read_text(), re.M | re.S)
CALLS = [line.split("  #")[0].strip() for block in BLOCKS for line in block.splitlines()]


def functions(path: Path) -> set[str]:
    """Names of the functions of a file."""
    body = ast.parse(path.read_text()).body
    return {node.name for node in body if isinstance(node, ast.FunctionDef)}


def commands(program: str) -> list[list[str]]:
    """Arguments of each call of a program."""
    split = [shlex.split(command) for command in CALLS]
    assert {words[0] for words in split} == {"make", "pytest", "python", "grep", "brokk-min"}
    return [words[1:] for words in split if words[0] == program]


@pytest.mark.parametrize("words", commands("pytest"), ids=" ".join)
def test_pytest__has_files_and_tests_of_that_name(words: list[str]) -> None:
    paths, _, selected = " ".join(words).partition(" -k ")
    for path in paths.split():
        assert (ROOT / path).exists()
        text = (ROOT / "tests/paper/planted.txt").read_text() if "mutants" in path else ""
        names = " ".join(functions(ROOT / path)) if selected else ""
        assert selected in text + names


@pytest.mark.parametrize("words", commands("python"), ids=" ".join)
def test_benchmarks__have_what_is_asked_of_them(words: list[str]) -> None:
    """A benchmark has its name's function, or says the option in its docstring."""
    assert words[0] == "-m"
    path = ROOT / f"{words[1].replace('.', '/')}.py"
    known = functions(path) | set(re.findall(r"--\w+", path.read_text()))
    assert {word for word in words[2:] if not word.isdigit()} <= known


@pytest.mark.parametrize("words", commands("grep"), ids=" ".join)
def test_grep__finds_nothing(words: list[str]) -> None:
    done = subprocess.run(["grep", *words], cwd=ROOT, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (1, "", "")


# --- writing --------------------------------------------------------------------------------------


def write() -> None:
    """Put the line counts into the table of the README."""
    counts = dict(line_counts())
    text = ROW.sub(lambda m: m[0].replace(f"| {m[2]} |", f"| {counts[m[1]]} |"), README.read_text())
    README.write_text(text)


if __name__ == "__main__":
    sys.exit(write())
