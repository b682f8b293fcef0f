"""docs/annotated.md is what its template, the code, PAPER.md and the shipped files give today."""

from __future__ import annotations

import json
import re
import runpy
from pathlib import Path
from typing import Any

import pytest
from matplotlib.mathtext import MathTextParser

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGE = (DOCS / "annotated.md").read_text()
PAPER = (ROOT / "PAPER.md").read_text()
FORMULA = re.compile(r"^\$\$(.*)\$\$$", re.M)
MAKER = runpy.run_path(str(DOCS / "annotated.py"))


@pytest.fixture(scope="module")
def numbers() -> dict[str, Any]:
    return runpy.run_path(str(DOCS / "annotated_numbers.py"))


def test_page__is_what_the_sources_give() -> None:
    assert MAKER["render"]() == PAGE, "run `make docs`"


def test_numbers__are_of_the_shipped_files(numbers: dict[str, Any]) -> None:
    measured = json.loads((DOCS / "annotated.json").read_text())
    message = "run `python docs/annotated_numbers.py`, then `make docs`"
    assert measured["files"] == numbers["fingerprints"](), message
    again = numbers["sample"](numbers["controllers"]()[0])
    assert measured["sample"] == pytest.approx(again, rel=0.02), message


def test_page__has_all_that_the_paper_numbers_and_each_deviation() -> None:
    rows = re.findall(r"^\| (eq\d|Table \d|Fig\. \d[a-h]?|Sec\. [\d.]+\d?) \|", PAPER, re.M)
    assert len(set(rows)) > 30
    named = set(re.findall(r"eq\d|Table \d|Fig\. \d|Sec\. \d(?:\.\d)?", PAGE))
    for figure, first, last in re.findall(r"\b(\d)([a-h])\b(?: to \d([a-h])\b)?", PAGE):
        panels = "abcdefgh"
        end = panels.index(last or first) + 1
        named |= {f"Fig. {figure}{panel}" for panel in panels[panels.index(first) : end]}
    assert set(rows) <= named, set(rows) - named
    deviations = re.findall(r"^\| (D\d+) \|", PAPER, re.M)
    assert re.findall(r"\*\*Deviation \[(D\d+)\]", PAGE)
    assert sorted(re.findall(r"\*\*Deviation \[(D\d+)\]", PAGE)) == sorted(deviations)


def test_formulas__survive_markdown() -> None:
    """Markdown takes a backslash before punctuation as an escape, and * as emphasis."""
    formulas = FORMULA.findall(PAGE)
    assert len(formulas) == PAGE.count("$$") / 2 >= 15
    for formula in formulas:
        assert not re.search(r"\\[^A-Za-z ]|\*", formula), formula
        MathTextParser("path").parse(f"${formula}$")  # ValueError: no formula
    assert not re.search(r"[^\n]\n\$\$|\$\$\n[^\n]", PAGE)  # a paragraph of its own
