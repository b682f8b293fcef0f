"""The walkthrough is true: its blocks run in order, are short, print and draw what stands below.

`python tests/paper/test_walkthrough.py` writes what the blocks print, their figures, and the page
as a notebook.
"""

import io
import os
import re
import tempfile
from contextlib import chdir, redirect_stdout
from pathlib import Path
from unittest import mock

import jupytext
import matplotlib
import numpy as np

matplotlib.use("Agg")
PAGE = Path(__file__).parents[2] / "docs" / "walkthrough.md"
FIGURES = PAGE.parent / "figures"
BLOCK = re.compile(r"^```python\n(.*?)^```\n(?:^```\n(.*?)^```\n)?", re.M | re.S)
SVG = {"svg.hashsalt": "walkthrough", "svg.fonttype": "none"}  # the same bytes, letters as text
CURVE = re.compile(r'<path d="([^"]+)" clip-path="[^"]+" style="fill: none')


def render() -> tuple[str, dict[str, str]]:
    """The page, its blocks run one after the other in one interpreter; files that they write."""
    namespace: dict[str, object] = {}

    def with_output(block: re.Match[str]) -> str:
        with redirect_stdout(io.StringIO()) as output:
            exec(compile(block[1], str(PAGE), "exec"), namespace)
        printed = output.getvalue()
        return f"```python\n{block[1]}```\n" + (f"```\n{printed}```\n" if printed else "")

    no_date = mock.patch.dict(os.environ, SOURCE_DATE_EPOCH="0")
    with tempfile.TemporaryDirectory() as folder, chdir(folder), no_date:
        with matplotlib.rc_context(SVG):
            page = BLOCK.sub(with_output, PAGE.read_text())
        return page, {path.name: path.read_text() for path in Path(folder).iterdir()}


def corners(figure: str) -> list[list[float]]:
    """Extent and end of each curve of an SVG, in points."""
    result = []
    for path in CURVE.findall(figure):
        points = np.array(re.findall(r"-?[\d.]+", path), float).reshape(-1, 2)
        result.append([*points.min(axis=0), *points.max(axis=0), *points[-1]])
    return result


def test_page__has_what_its_blocks_print_and_draw() -> None:
    page, figures = render()
    assert PAGE.read_text() == page, "run `make docs`"
    assert sorted(figures) == sorted(re.findall(r"^!\[.{30,}\]\(figures/(.*?)\)$", page, re.M))
    for name, figure in figures.items():
        wanted, got = corners(figure), corners((FIGURES / name).read_text())
        assert len(wanted) >= 2
        np.testing.assert_allclose(got, wanted, atol=2, err_msg=f"{name}: run `make docs`")


def test_notebook__has_the_text_and_the_blocks_of_the_page() -> None:
    assert PAGE.with_suffix(".ipynb").read_text() == notebook(), "run `make docs`"


def notebook() -> str:
    """The page as a notebook, by jupytext."""
    page = jupytext.reads(PAGE.read_text(), "md")
    page.metadata = {"kernelspec": {"name": "python3", "display_name": "Python 3"}}
    for number, cell in enumerate(page.cells):
        cell["id"] = f"cell-{number}"  # not a random one
    text: str = jupytext.writes(page, "ipynb")
    return text


def write() -> None:
    """Put what the blocks print below them, and what they draw into figures/."""
    page, figures = render()
    PAGE.write_text(page)
    for name, figure in figures.items():
        (FIGURES / name).write_text(figure)
    PAGE.with_suffix(".ipynb").write_text(notebook())


if __name__ == "__main__":
    write()
