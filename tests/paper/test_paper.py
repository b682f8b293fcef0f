"""PAPER.md is true: nothing of the paper is missing; rows, code, docstrings and tests agree.

`python tests/paper/test_paper.py` writes the links to lines at the end of PAPER.md.
"""

import ast
import json
import re
import runpy
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from brokk_min._files import SHIPPED
from brokk_min.evaluation.baselines import OPTIMISED, STRONGEST
from brokk_min.evaluation.claims import verdict_rows
from brokk_min.evaluation.metrics import interval_text
from brokk_min.evaluation.rollout import title

ROOT = Path(__file__).parents[2]
MAKER = runpy.run_path(str(ROOT / "docs" / "paper.py"))
definition, name_of = MAKER["definition"], MAKER["name_of"]
TESTS = sorted((ROOT / "tests").rglob("test_*.py"))
PAGE = ROOT / "PAPER.md"
PAPER, LINKS = MAKER["TABLES"].split(
    "<!-- links: written by `python tests/paper/test_paper.py` -->\n"
)

# What the paper numbers: its labels and captions, from its source.
NUMBERED = ["eq1", "eq2", "eq3", "eq4", "Table 1", "Fig. 1", "Fig. 2a", "Fig. 2b", "Fig. 2c"]
NUMBERED += ["Fig. 3", "Fig. 4", *(f"Fig. 5{panel}" for panel in "abcde")]
NUMBERED += [f"Fig. 6{panel}" for panel in "abcdefgh"]
SECTIONS = {"Sec. 2", "Sec. 3.2", "Sec. 3.3", "Sec. 3.4", "Sec. 4.1", "Sec. 4.2", "Sec. 5"}
CONSTANTS = """rate; joints; locked joint; joystick; PWM code; 80/175; 50/205; +0.24, -0.47 rad/s;
400 ms, 100 ms; coupling; dead zone; 0.6 s, 0.05 s; 2 x 32; errors of one step; 1 h; 0.75 h;
2.5 h; 5 %; no penalty; 256; 256-128-64; q_s; 30 s; K; k"""


def table(heading: str) -> list[list[str]]:
    """Cells of the rows below a heading."""
    part = PAPER.split(f"\n## {heading}\n")[1].split("\n## ")[0]
    lines = [line for line in part.splitlines() if line.startswith("|")]
    rows = [[cell.strip() for cell in line.strip().strip("|").split("|")] for line in lines]
    assert all(len(row) == len(rows[0]) for row in rows), heading
    return rows[2:]


def labels(cell: str) -> list[str]:
    """What a cell links to, `module.name` or the name of a test."""
    return re.findall(r"\[`([^`]+)`\]", cell)


NAMED = table("Equations, tables, figures") + table("Sections")
CONSTANT = table("Constants")
ROWS = [row[-4:] for row in NAMED + CONSTANT]  # code, test, status, remark
LABELS = sorted(set(labels(PAPER)))


def test_rows__are_all_that_the_paper_numbers_in_its_order() -> None:
    ids = [row[0] for row in table("Equations, tables, figures")]
    assert list(dict.fromkeys(ids)) == NUMBERED
    assert {row[0] for row in table("Sections")} == SECTIONS
    assert [row[0] for row in CONSTANT] == re.split(r";\s", CONSTANTS)
    assert {row[1] for row in CONSTANT} <= SECTIONS | set(NUMBERED)


def test_rows__have_code_and_one_or_two_tests_unless_not_yet_there() -> None:
    needed = {"printed": "", "corrected": r"[DS]\d", "changed": r"D\d", "assumed": r"A\d"}
    for code, test, status, remark in ROWS:
        assert re.search((needed | {"not compared": "."})[status], remark), (status, remark)
        assert bool(labels(code)) == bool(labels(test)) == (status in needed), (code, status)
        assert len(labels(test)) <= 2, test


def test_deviations__are_named_by_rows_and_explained() -> None:
    stories = (ROOT / "docs" / "deviations.md").read_text()
    remarks = " ".join(remark for *_, remark in ROWS)
    for heading, letter in (("Deviations", "D"), ("Assumptions", "A"), ("Slips of the paper", "S")):
        listed = [row[0] for row in table(heading)]
        assert set(re.findall(rf"\b{letter}\d+\b", PAPER)) == set(listed)
        if letter != "S":
            assert re.findall(rf"^### ({letter}\d+)\.", stories, re.M) == listed
    assert {row[0] for row in table("Deviations")} == set(re.findall(r"\bD\d+\b", remarks))


# --- places ---------------------------------------------------------------------------------------


@cache
def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


def place_of(label: str) -> tuple[Path, int]:
    """File and line of a test, or of `module` or `module.name.name` of the package."""
    if not label.startswith("test_"):
        path, node = definition(label)
        return path, getattr(node, "lineno", 1)  # a module: its docstring
    start = f"\ndef {label}("
    places = [path for path in TESTS if start in path.read_text()]
    if len(places) != 1:
        raise ValueError(f"{label}: expected one test of this name, got {places}")
    return places[0], places[0].read_text().partition(start)[0].count("\n") + 2


def link(label: str) -> str:
    """The definition of a link of the page."""
    path, line = place_of(label)
    return f"[`{label}`]: {path.relative_to(ROOT).as_posix()}#L{line}"


def test_links__point_at_the_line() -> None:
    lines = [link(label) for label in LABELS]
    assert LINKS.split("\n")[1:-1] == lines, "run `python tests/paper/test_paper.py`"


# --- docstrings -----------------------------------------------------------------------------------


def documented() -> Iterator[tuple[str, str]]:
    """Module and tag of each docstring of the package that names a place of the paper.

    A tag stands behind "Paper:", up to the end of the paragraph.
    """
    several = r"(Fig\.|Sec\.) ((?:\d[\d.a-h]*(?:, | and )?)+)"
    for path in sorted((ROOT / "brokk_min").rglob("*.py")):
        for tagged in re.findall(r'Paper: (.*?)(?:\n\s*\n|""")', path.read_text(), re.S):
            for tag in re.findall(r"eq\d|Table \d", tagged):
                yield path.stem, tag
            for kind, numbers in re.findall(several, tagged):
                for number in re.findall(r"\d[a-h]?(?:\.\d)?", numbers):
                    yield path.stem, f"{kind} {number}"


def test_docstrings_and_rows__name_each_other() -> None:
    """A tag `Fig. 6` stands for all its panels, and one of a module's tags for its definitions."""
    tags = set(documented())
    named = {(s.partition(".")[0], row[0]) for row in NAMED for s in labels(row[-4])}
    constants = {(s.partition(".")[0], row[1]) for row in CONSTANT for s in labels(row[-4])}
    for module, tag in tags:
        rows = {row for other, row in named | constants if other == module}
        assert any(row.startswith(tag) for row in rows), f"no row of {tag} has code of {module}"
    for module, row in named:
        of_module = {tag for other, tag in tags if other == module}
        assert any(row.startswith(tag) for tag in of_module), f"{module} does not name {row}"


# --- tests use the code of their row --------------------------------------------------------------


@cache
def parts(path: Path) -> dict[str, ast.stmt]:
    """Definitions of a test file, and of the modules of `tests/` that it imports, by name."""
    found: dict[str, ast.stmt] = {}
    for node in parsed(path).body:
        if name := name_of(node):
            found[name] = node
        helpers = ROOT / "tests" / f"{getattr(node, 'module', None)}.py"
        if isinstance(node, ast.ImportFrom) and helpers.exists():
            found |= parts(helpers)
    return found


def names_used(path: Path, test: str) -> set[str]:
    """Names in a test and in all that it calls of its file and of helpers; imported modules."""
    imports = re.findall(r"^(?:from|import) brokk_min(.*)", path.read_text(), re.M)
    names = set(re.findall(r"\w+", " ".join(imports))) & {s for s in LABELS if "." not in s}
    ahead = [test]
    while ahead:
        for node in ast.walk(parts(path)[ahead.pop()]):
            for field in ("id", "attr", "arg", "value"):
                name = getattr(node, field, None)
                if isinstance(name, str) and name not in names:
                    names.add(name)
                    ahead += [name] if name in parts(path) else []
    return names


@pytest.mark.parametrize(("code", "test"), [row[:2] for row in ROWS if labels(row[1])])
def test_tests__use_the_code_of_their_row(code: str, test: str) -> None:
    used = set().union(*(names_used(place_of(name)[0], name) for name in labels(test)))
    missing = {symbol for symbol in labels(code) if symbol.rpartition(".")[2] not in used}
    assert not missing, f"{test} do not use {missing}"


def shipped(name: str) -> Any:
    """What is in a shipped JSON file of results."""
    return json.loads((SHIPPED / "brokk170" / name).read_text())


def verdicts() -> list[list[str]]:
    """Rows of the paper's sentences."""
    heads = ["where", "the paper writes", "of", "measured", "the sentence"]
    return [heads, *verdict_rows(shipped("table.json")["claims"])]


def machines() -> list[list[str]]:
    """Errors on other machines, as each controller is, cold and warm."""
    cases, names = (
        shipped("robustness.json")["robustness"],
        ("rl", STRONGEST, "rl_paper", OPTIMISED),
    )
    rows = [["machine", *map(title, names)]]
    for case, of in cases.items():
        each = (
            [of[f"{name}{start}"]["mean"] for start in ("", "+cold", "+warm")] for name in names
        )
        rows.append([case, *(" → ".join(f"{error:.4f}" for error in errors) for errors in each)])
    return rows


def seeds() -> list[list[str]]:
    """Figures over training seeds."""
    rows = [["controller", "seeds", "velocity error [m/s]", "drift [m]"]]
    for name in ("rl", "rl_paper", "rl_critic_nets"):
        content = shipped(f"seeds_{name}.json")
        number = str(len(content["meta"]["seeds"]))
        of = content["table"]["along"]
        figures = (of[key] for key in ("velocity_error_mean", "off_axis_drift_max"))
        rows.append([title(name), number, *map(interval_text, figures)])
    return rows


WRITTEN = {"verdicts": verdicts, "seeds": seeds, "machines": machines}


def with_tables(text: str) -> str:
    """The page with the tables of the shipped files of results."""
    for name, rows in WRITTEN.items():
        heads, *others = rows()
        lines = [f"| {' | '.join(row)} |\n" for row in (heads, ["---"] * len(heads), *others)]
        begin = f"<!-- {name}: written by `python tests/paper/test_paper.py` -->\n"
        end = f"<!-- end of {name} -->"
        before, _, after = text.partition(begin)
        text = before + begin + "".join(lines) + end + after.partition(end)[2]
    return text


def test_tables__are_those_of_the_shipped_files() -> None:
    assert with_tables(PAPER) == PAPER, "run `python tests/paper/test_paper.py`"


def write() -> None:
    """Write links and verdicts of PAPER.md; ValueError: the first that is no longer there."""
    lines = [link(label) for label in LABELS]
    text = PAGE.read_text().removesuffix(LINKS) + "\n" + "\n".join(lines) + "\n"
    PAGE.write_text(with_tables(text))


if __name__ == "__main__":
    write()
