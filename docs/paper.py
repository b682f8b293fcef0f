"""Write the text of PAPER.md, up to its tables: `python docs/paper.py`.

The text is in paper.md.j2. The code on the page comes from the package by name, and the deviations
come from the page's own tables.
"""

from __future__ import annotations

import ast
import re
import textwrap
from functools import cache
from pathlib import Path
from typing import Any

import jinja2

from brokk_min.env import observation_table
from brokk_min.machine import BROKK_170

DOCS = Path(__file__).parent
ROOT = DOCS.parent
PAGE = ROOT / "PAPER.md"
MARKS = (
    "<!-- text: written by `python docs/paper.py` from docs/paper.md.j2 -->\n",
    "<!-- tables -->\n",
)
HEAD, _, TABLES = re.split("|".join(MARKS), PAGE.read_text())
HEADINGS = re.findall(r"^### ((\w+)\. .*)$", (DOCS / "deviations.md").read_text(), re.M)


def name_of(node: ast.AST) -> str | None:
    """The name that a statement defines: a function, class, field or constant."""
    node = node.targets[0] if isinstance(node, ast.Assign) else getattr(node, "target", node)
    return getattr(node, "name", None) or getattr(node, "id", None)


@cache
def definition(symbol: str) -> tuple[Path, ast.stmt]:
    """File and node of `module.name` or `module.Class.name`; ValueError: there is none."""
    module, *names = symbol.split(".")
    paths = list((ROOT / "brokk_min").rglob(f"{module}.py"))
    if len(paths) != 1:
        raise ValueError(f"{symbol}: expected one module {module}, got {paths}")
    node: Any = ast.parse(paths[0].read_text())
    for name in names:
        found = [part for part in getattr(node, "body", ()) if name_of(part) == name]
        if len(found) != 1:
            raise ValueError(f"{symbol}: expected one {name} in {paths[0].name}, got {len(found)}")
        node = found[0]
    return paths[0], node


def code(symbol: str, *parts: list[str]) -> str:
    """A definition without its docstring, or parts of it, with a link to its lines.

    A part is [first] or [first, last]: texts that one line of the definition alone contains.
    ValueError: no such definition or line.
    """
    path, node = definition(symbol)
    lines = path.read_text().splitlines()
    last = node.end_lineno or node.lineno
    docstring = range(0)
    if isinstance(node, ast.FunctionDef | ast.ClassDef) and ast.get_docstring(node):
        docstring = range(node.body[0].lineno, (node.body[0].end_lineno or 0) + 1)
    shown = [i for i in range(node.lineno, last + 1) if i not in docstring]
    ranges = []
    for part in parts:
        ends = []
        for text in part:
            found = [i for i in shown if text in lines[i - 1]]
            if len(found) != 1:
                raise ValueError(f"{symbol}: expected one line with {text!r}, got {len(found)}")
            ends += found
        ranges.append([i for i in shown if ends[0] <= i <= ends[-1]])
    ranges = ranges or [shown]
    blocks = [textwrap.dedent("\n".join(lines[i - 1] for i in numbers)) for numbers in ranges]
    place = path.relative_to(ROOT).as_posix()
    end = "" if ranges[-1][-1] == ranges[0][0] else f"-L{ranges[-1][-1]}"
    link = f"[`{symbol}`]({place}#L{ranges[0][0]}{end})"
    return f"{link}:\n\n```python\n" + "\n...\n".join(blocks).strip("\n") + "\n```"


@cache
def row(name: str) -> list[str]:
    """Cells of a deviation D or assumption A in PAPER.md."""
    found = re.findall(rf"^\| ({name} \|.*)\|$", TABLES, re.M)
    if len(found) != 1:
        raise ValueError(f"{name}: expected one row of the tables, got {len(found)}")
    return [cell.strip() for cell in found[0].split("|")]


def link(name: str) -> str:
    """A link to the experiments behind a deviation or assumption."""
    heading = next(heading for heading, found in HEADINGS if found == name)
    anchor = re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")
    return f"[{name}](docs/deviations.md#{anchor})"


def deviation(*names: str) -> str:
    """One paragraph for each deviation: what is here instead, and why."""
    lines = []
    for name in names:
        _, _, here, why, undo, _ = row(name)
        here = here[0].upper() + here[1:]
        end = f" {undo} does without it." if undo else ""
        lines.append(f"> **Deviation {link(name)}.** {here}, because {why}.{end}")
    return "\n\n".join(lines)


def wrap(page: str) -> str:
    """The page with paragraphs of at most 100 columns; code, tables and formulas stay."""
    result = []
    for part in re.split(r"(^```.*?^```$)", page, flags=re.M | re.S):
        for block in [part] if part.startswith("```") else re.split(r"(\n{2,})", part):
            if re.match(r"[\w(\"]|> ", block):
                mark = "> " if block.startswith("> ") else ""
                text = " ".join(line.removeprefix(mark) for line in block.split("\n"))
                options = {"break_long_words": False, "break_on_hyphens": False}
                block = textwrap.fill(
                    text, 100, initial_indent=mark, subsequent_indent=mark, **options
                )
            result.append(block)
    return "".join(result).strip("\n") + "\n"


def render() -> str:
    """The page, with the text of today."""
    loader = jinja2.FileSystemLoader(DOCS)
    environment = jinja2.Environment(
        loader=loader, undefined=jinja2.StrictUndefined, trim_blocks=True, autoescape=False
    )
    observed = observation_table(BROKK_170).mean.size
    environment.globals |= {"code": code, "deviation": deviation, "A": link, "observed": observed}
    text = wrap(environment.get_template("paper.md.j2").render())
    return f"{HEAD}{MARKS[0]}\n{text}\n{MARKS[1]}{TABLES}"


if __name__ == "__main__":
    PAGE.write_text(render())
