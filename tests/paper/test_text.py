"""The text of PAPER.md is what its template, the code and the tables give today."""

import re
import runpy
from pathlib import Path

from matplotlib.mathtext import MathTextParser

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "PAPER.md").read_text()


def test_page__is_what_the_sources_give() -> None:
    assert runpy.run_path(str(ROOT / "docs/paper.py"))["render"]() == PAGE, "run `make docs`"


def test_formulas__survive_markdown() -> None:
    """Markdown takes a backslash before punctuation as an escape, and * as emphasis."""
    formulas = re.findall(r"^\$\$(.*)\$\$$", PAGE, re.M)
    assert len(formulas) == PAGE.count("$$") / 2 >= 15
    for formula in formulas:
        assert not re.search(r"\\[^A-Za-z ]|\*", formula), formula
        MathTextParser("path").parse(f"${formula}$")  # ValueError: no formula
    assert not re.search(r"[^\n]\n\$\$|\$\$\n[^\n]", PAGE)  # a paragraph of its own
