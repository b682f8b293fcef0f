"""The walkthrough is true: its blocks run in order, are short, and print what stands below them.

`python tests/paper/test_walkthrough.py` writes what the blocks print.
"""

from __future__ import annotations

import io
import re
import tempfile
from contextlib import chdir, redirect_stdout
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
PAGE = Path(__file__).parents[2] / "docs" / "walkthrough.md"
BLOCK = re.compile(r"^```python\n(.*?)^```\n(?:^```\n(.*?)^```\n)?", re.M | re.S)


def printed(codes: list[str]) -> list[str]:
    """What the blocks print, one after the other in one interpreter; figures go nowhere."""
    namespace: dict[str, object] = {}
    result = []
    with tempfile.TemporaryDirectory() as folder, chdir(folder):
        for code in codes:
            with redirect_stdout(io.StringIO()) as output:
                exec(compile(code, str(PAGE), "exec"), namespace)
            result.append(output.getvalue())
        figures = {path.name for path in Path(folder).iterdir()}
    assert figures == set(re.findall(r'savefig\("(.*?)"\)', PAGE.read_text()))
    return result


def test_blocks__are_short_and_the_page_takes_half_an_hour() -> None:
    text = PAGE.read_text()
    blocks = BLOCK.findall(text)
    assert len(blocks) == text.count("```python") >= 9
    assert all(len(re.findall(r"\S.*$", code, re.M)) <= 10 for code, _ in blocks)
    assert len(BLOCK.sub("", text).split()) < 30 * 180 / 2  # words, at half the speed of prose


def test_blocks__print_what_stands_below() -> None:
    blocks = BLOCK.findall(PAGE.read_text())
    assert printed([code for code, _ in blocks]) == [below for _, below in blocks]


def write() -> None:
    """Put what the blocks print below them."""
    outputs = iter(printed([code for code, _ in BLOCK.findall(PAGE.read_text())]))

    def with_output(match: re.Match[str]) -> str:
        output = next(outputs)
        return f"```python\n{match[1]}```\n" + (f"```\n{output}```\n" if output else "")

    PAGE.write_text(BLOCK.sub(with_output, PAGE.read_text()))


if __name__ == "__main__":
    write()
