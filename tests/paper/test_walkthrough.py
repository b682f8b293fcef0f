"""The walkthrough is true: its blocks run in order, are short, and print what stands below them."""

from __future__ import annotations

import io
import re
import tempfile
from contextlib import chdir, redirect_stdout
from pathlib import Path

import matplotlib
import pytest

matplotlib.use("Agg")
PAGE = Path(__file__).parents[2] / "docs" / "walkthrough.md"
BLOCK = re.compile(r"^```python\n(.*?)^```\n(?:^```\n(.*?)^```\n)?", re.M | re.S)


def blocks() -> list[tuple[str, str]]:
    return [(code, printed) for code, printed in BLOCK.findall(PAGE.read_text())]


def test_blocks_are_ten_lines_at_most_and_the_page_is_read_in_half_an_hour() -> None:
    text = PAGE.read_text()
    assert len(blocks()) == text.count("```python") >= 8
    assert all(len(re.findall(r"\S.*$", code, re.M)) <= 10 for code, _ in blocks())
    assert len(BLOCK.sub("", text).split()) < 30 * 180 / 2  # words, at half the pace of prose


def test_blocks_run_in_order_and_print_what_stands_below(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    namespace: dict[str, object] = {}
    found = []
    for code, _ in blocks():
        with redirect_stdout(io.StringIO()) as said:
            exec(compile(code, str(PAGE), "exec"), namespace)
        found.append(said.getvalue())
    assert found == [printed for _, printed in blocks()]
    assert {path.name for path in tmp_path.iterdir()} == set(
        re.findall(r'savefig\("(.*?)"\)', PAGE.read_text())
    )


def write() -> None:
    """Put what the blocks print below them: `python tests/test_walkthrough.py`."""
    namespace: dict[str, object] = {}

    def with_output(match: re.Match[str]) -> str:
        with redirect_stdout(io.StringIO()) as said:
            exec(compile(match[1], str(PAGE), "exec"), namespace)
        return f"```python\n{match[1]}```\n" + (
            f"```\n{said.getvalue()}```\n" if said.getvalue() else ""
        )

    with tempfile.TemporaryDirectory() as folder, chdir(folder):  # figures stay out of the project
        text = BLOCK.sub(with_output, PAGE.read_text())
    PAGE.write_text(text)


if __name__ == "__main__":
    write()
