"""The walkthrough is true: its cells run in order, and print and draw what stands below them.

`python tests/paper/test_walkthrough.py` writes what they give into the notebook.
"""

import base64
import io
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any
from unittest import mock

import matplotlib
import nbformat
import numpy as np
from matplotlib import pyplot as plt
from nbformat.v4 import new_output

PAGE = Path(__file__).parents[2] / "docs" / "walkthrough.ipynb"


def executed() -> Any:
    """The notebook, its cells run one after the other in one interpreter."""
    matplotlib.use("Agg")
    notebook, namespace = nbformat.read(PAGE, 4), {}  # type: ignore[no-untyped-call]
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    for number, cell in enumerate(code, 1):
        pictures: list[Any] = []

        def show(pictures: list[Any] = pictures) -> None:
            plt.savefig(file := io.BytesIO(), format="png", dpi=80)
            plt.close()
            picture = base64.b64encode(file.getvalue()).decode() + "\n"
            pictures.append(new_output("display_data", {"image/png": picture}))

        with redirect_stdout(io.StringIO()) as printed, mock.patch.object(plt, "show", show):
            exec(compile(cell.source, f"cell {number}", "exec"), namespace)
        text = printed.getvalue()
        cell.outputs = [new_output("stream", name="stdout", text=text)] * bool(text) + pictures
        cell.execution_count = number
    return notebook


def outputs(notebook: Any, kind: str) -> list[Any]:
    """Those of one kind, in their order."""
    return [one for cell in notebook.cells for one in cell.get("outputs", []) if kind in one]


def test_notebook__has_what_its_cells_print_and_draw() -> None:
    """Pictures may differ in some pixels: other fonts."""
    with matplotlib.rc_context():
        today = executed()
    shipped = nbformat.read(PAGE, 4)  # type: ignore[no-untyped-call]
    texts = [[one.text for one in outputs(of, "text")] for of in (shipped, today)]
    assert texts[0] == texts[1], "run `make docs`"
    every = [[one.data["image/png"] for one in outputs(of, "data")] for of in (shipped, today)]
    assert len(every[0]) == sum(cell.source.startswith("*") for cell in shipped.cells) == 9
    for one, other in zip(*every, strict=True):
        before, now = (plt.imread(io.BytesIO(base64.b64decode(data))) for data in (one, other))
        assert before.shape == now.shape and np.abs(before - now).mean() < 0.02, "run `make docs`"


if __name__ == "__main__":
    nbformat.write(executed(), PAGE)  # type: ignore[no-untyped-call]
