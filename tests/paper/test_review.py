"""docs/review.md: two hours add up, and each command of it exists."""

from __future__ import annotations

import ast
import re
import shlex
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "review.md").read_text()
BLOCKS = re.findall(r"^```\n(.*?)^```$", PAGE, re.M | re.S)
COMMANDS = [line.split("  #")[0].strip() for block in BLOCKS for line in block.splitlines()]


def functions(path: Path) -> set[str]:
    """Names of the functions of a file."""
    body = ast.parse(path.read_text()).body
    return {node.name for node in body if isinstance(node, ast.FunctionDef)}


def commands(program: str) -> list[list[str]]:
    """Arguments of each call of a program."""
    split = [shlex.split(command) for command in COMMANDS]
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
