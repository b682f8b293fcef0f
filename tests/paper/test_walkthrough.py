"""The walkthrough is true: its blocks run in order, are short, print and draw what stands below.

`python tests/paper/test_walkthrough.py` writes what the blocks print, their figures, and the page
as an executed notebook.
"""

import base64
import io
import os
import re
import tempfile
from contextlib import chdir, redirect_stdout
from functools import cache
from pathlib import Path
from typing import Any
from unittest import mock

import jupytext
import matplotlib
import numpy as np
from matplotlib import pyplot as plt
from nbformat.v4 import new_output

matplotlib.use("Agg")
PAGE = Path(__file__).parents[2] / "docs" / "walkthrough.md"
FIGURES = PAGE.parent / "figures"
BLOCK = re.compile(r"^```python\n(.*?)^```\n(?:^```\n(.*?)^```\n)?", re.M | re.S)
SVG = {"svg.hashsalt": "walkthrough", "svg.fonttype": "none"}  # the same bytes, letters as text
CURVE = re.compile(r'<path d="([^"]+)" clip-path="[^"]+" style="fill: none')


@cache
def render() -> tuple[str, dict[str, str], list[list[Any]]]:
    """The page, its blocks run one after the other in one interpreter; files that they write.

    Last the outputs of each block as a notebook has them: what it printed, and its picture.
    """
    namespace: dict[str, object] = {}
    outputs: list[list[Any]] = []
    to_file = plt.savefig

    def savefig(name: str) -> None:
        to_file(name)
        plt.gcf().savefig(picture := io.BytesIO(), format="png", dpi=80)
        data = {"image/png": base64.b64encode(picture.getvalue()).decode()}
        outputs[-1].append(new_output("display_data", data))

    def with_output(block: re.Match[str]) -> str:
        outputs.append([])
        with redirect_stdout(io.StringIO()) as output:
            exec(compile(block[1], str(PAGE), "exec"), namespace)
        printed = output.getvalue()
        if printed:
            outputs[-1].insert(0, new_output("stream", name="stdout", text=printed))
        return f"```python\n{block[1]}```\n" + (f"```\n{printed}```\n" if printed else "")

    no_date = mock.patch.dict(os.environ, SOURCE_DATE_EPOCH="0")
    with tempfile.TemporaryDirectory() as folder, chdir(folder), no_date:
        with matplotlib.rc_context(SVG), mock.patch.object(plt, "savefig", savefig):
            page = BLOCK.sub(with_output, PAGE.read_text())
        return page, {path.name: path.read_text() for path in Path(folder).iterdir()}, outputs


def corners(figure: str) -> list[list[float]]:
    """Extent and end of each curve of an SVG, in points."""
    result = []
    for path in CURVE.findall(figure):
        points = np.array(re.findall(r"-?[\d.]+", path), float).reshape(-1, 2)
        result.append([*points.min(axis=0), *points.max(axis=0), *points[-1]])
    return result


def test_page__has_what_its_blocks_print_and_draw() -> None:
    page, figures, _ = render()
    assert PAGE.read_text() == page, "run `make docs`"
    assert sorted(figures) == sorted(re.findall(r"^!\[.{30,}\]\(figures/(.*?)\)$", page, re.M))
    for name, figure in figures.items():
        wanted, got = corners(figure), corners((FIGURES / name).read_text())
        assert len(wanted) >= 2
        np.testing.assert_allclose(got, wanted, atol=2, err_msg=f"{name}: run `make docs`")


def test_notebook__has_the_blocks_of_the_page_and_what_they_give() -> None:
    """Pictures may differ in some pixels: other fonts."""
    texts = PAGE.with_suffix(".ipynb").read_text(), notebook()
    shipped, today = (re.sub(r'"image/png": ".*"', "", text) for text in texts)
    assert shipped == today, "run `make docs`"
    pictures = [re.findall(r'"image/png": "(.*?)(?:\\n)?"', text) for text in texts]
    assert len(pictures[0]) == len(re.findall(r"^!\[", PAGE.read_text(), re.M))
    for one, other in zip(*pictures, strict=True):
        before, now = (plt.imread(io.BytesIO(base64.b64decode(data))) for data in (one, other))
        assert before.shape == now.shape and np.abs(before - now).mean() < 0.02, "run `make docs`"


def notebook() -> str:
    """The page as an executed notebook: its figures are shown, and stand below their blocks."""
    text = BLOCK.sub(lambda block: f"```python\n{block[1]}```\n", render()[0])
    text = re.sub(r"^!\[(.*)\]\(figures/.*\)$", r"*\1*", text, flags=re.M)
    page = jupytext.reads(text.replace("    plt.close()\n", "    plt.show()\n"), "md")
    page.metadata = {"kernelspec": {"name": "python3", "display_name": "Python 3"}}
    for number, cell in enumerate(page.cells):
        cell["id"] = f"cell-{number}"  # not a random one
    code = [cell for cell in page.cells if cell.cell_type == "code"]
    for number, (cell, outputs) in enumerate(zip(code, render()[2], strict=True), 1):
        cell.execution_count, cell.outputs = number, outputs
    text = jupytext.writes(page, "ipynb")
    return text


def write() -> None:
    """Put what the blocks print below them, and what they draw into figures/."""
    page, figures, _ = render()
    PAGE.write_text(page)
    for name, figure in figures.items():
        (FIGURES / name).write_text(figure)
    PAGE.with_suffix(".ipynb").write_text(notebook())


if __name__ == "__main__":
    write()
