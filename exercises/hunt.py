"""The bug hunt: an error is planted in a copy of the package; find its file and line.

python -m exercises.hunt                       the list of bugs
python -m exercises.hunt 7                     plant bug 7 in hunts/07 and show its symptoms
python -m exercises.hunt 7 --hint              a hint
python -m exercises.hunt 7 actuator.py:123     the verdict on an answer

The errors are those that the project's tests must find (tests/paper/planted.txt).
"""

import argparse
import importlib.util
import json
import os
import shutil
import subprocess
import sys
import tomllib
from collections import Counter
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from exercises.symptoms import SYMPTOMS, measure

ROOT = Path(__file__).parents[1]
FOLDER = Path("hunts")  # of the copies, in the folder in which the hunt is called


class Bug(NamedTuple):
    """A planted error and how it is hunted."""

    number: int
    grade: int
    symptom: str  # name in `symptoms.SYMPTOMS`
    hint: str
    published: str  # who else had it; empty: not known
    test: str  # that must find it
    module: str  # dotted, without brokk_min
    right: str
    wrong: str

    @property
    def file(self) -> str:
        """Path within the package."""
        return self.module.replace(".", "/") + ".py"

    def line(self) -> int:
        """The line that is wrong."""
        text = (ROOT / "brokk_min" / self.file).read_text()
        return text[: text.index(self.right)].count("\n") + 1


@cache
def mutants() -> ModuleType:
    """The tests that plant errors: they read the list."""
    path = ROOT / "tests" / "paper" / "test_mutants.py"
    spec = importlib.util.spec_from_file_location("planted_errors", path)
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@cache
def bugs() -> list[Bug]:
    """All bugs, the easy ones first."""
    seen: Counter[str] = Counter()
    planted = {}
    for test, *change in mutants().planted_errors():
        seen[test] += 1
        planted[f"{test} {seen[test]}"] = test, *change
    table = tomllib.loads((ROOT / "exercises" / "hunts.toml").read_text())["hunt"]
    rows = sorted(table, key=lambda row: row["grade"])
    return [
        Bug(
            i, row["grade"], row["symptom"], row["hint"], row.get("published", ""),
            *planted[row["error"]],
        )
        for i, row in enumerate(rows, 1)
    ]  # fmt: skip


def plant(bug: Bug, folder: Path) -> None:
    """Copy the package into `folder`, and put the error in."""
    ignore = shutil.ignore_patterns("__pycache__")
    shutil.copytree(ROOT / "brokk_min", folder / "brokk_min", ignore=ignore)
    path = folder / "brokk_min" / bug.file
    path.write_text(path.read_text().replace(bug.right, bug.wrong))


def symptoms_of_copy(name: str, folder: Path) -> dict[str, Any]:
    """`symptoms.measure` by the package in `folder`."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(folder.resolve()), str(ROOT)])}
    command = [sys.executable, "-m", "exercises.symptoms", name]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    printed, _, last = done.stdout.rstrip().rpartition("\n")
    print(printed, end="\n" * bool(printed))  # what the hunter prints from the copy
    if done.returncode:
        return {"rows": {"raised": done.stderr.strip().rpartition("\n")[2]}, "curves": {}}
    result: dict[str, Any] = json.loads(last)
    return result


def comparison(expected: dict[str, str], got: dict[str, str]) -> list[str]:
    """Rows of two symptoms; those that differ twice, with an arrow."""
    lines = []
    for what in expected | got:
        values = expected.get(what, "nothing"), got.get(what, "nothing")
        if values[0] == values[1]:
            lines.append(f"  {what}: {values[0]}")
        else:
            lines += [f"  {what}  <-", f"      expected {values[0]}", f"      got      {values[1]}"]
    return lines


def draw(expected: dict[str, Any], got: dict[str, Any], path: Path) -> None:
    """A figure of the curves: expected ones grey, those of the copy in colour."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    for i, (label, curve) in enumerate(got["curves"].items()):
        axes.plot(*expected["curves"][label], color="0.6", lw=4, label=None if i else "expected")
        axes.plot(*curve, color=f"C{i}", label=f"{label}: got")
    axes.set_xlabel(got["axes"][0])
    axes.set_ylabel(got["axes"][1])
    axes.legend()
    figure.savefig(path, dpi=120)


def show(bug: Bug, folder: Path) -> int:
    """Plant the bug where that was not done, and print its symptoms."""
    if not folder.exists():
        plant(bug, folder)
    expected, got = measure(bug.symptom), symptoms_of_copy(bug.symptom, folder)
    print(f"Bug {bug.number}, grade {bug.grade}, somewhere in {folder}/brokk_min. The symptom:")
    print((SYMPTOMS[bug.symptom].__doc__ or "").strip(), end=" ")
    print(f"(`{bug.symptom}` in exercises/symptoms.py measures it.)", end="\n\n")
    print("\n".join(comparison(expected["rows"], got["rows"])))
    if got["curves"]:
        draw(expected, got, folder / "symptom.png")
        print(f"\nA figure is in {folder}/symptom.png.")
    if expected["rows"] == got["rows"]:
        print("\nNo symptom is left: the copy is healthy.")
    print(f"\nAnswer with: python -m exercises.hunt {bug.number} FILE:LINE")
    return 0


def judge(bug: Bug, answer: str) -> tuple[bool, str]:
    """Is FILE:LINE the wrong line, or one beside it? And what to say. ValueError: no answer."""
    file, _, line = answer.rpartition(":")
    file = file.replace("\\", "/").rpartition("brokk_min/")[2]
    if not line.isdigit() or not (ROOT / "brokk_min" / file).is_file():
        raise ValueError(f"answer: expected a file of the package and a line, got {answer!r}")
    if file != bug.file:
        return False, "Not there: another file."
    if abs(int(line) - bug.line()) > 1:
        return False, "The right file, another line."
    text = f"Right. {bug.file}, line {bug.line()}:\n  wrong  {bug.wrong}\n  right  {bug.right}"
    text += f"\nThe test that finds it is {bug.test}."
    return True, text + (f"\n{bug.published}" if bug.published else "")


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit status: 0 shown or right, 1 wrong answer, 2 wrong use."""
    parser = argparse.ArgumentParser(
        prog="python -m exercises.hunt",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("number", nargs="?", type=int, help="of the bug")
    parser.add_argument("answer", nargs="?", help="FILE:LINE, FILE within brokk_min")
    parser.add_argument("--hint", action="store_true", help="print a hint")
    options = parser.parse_args(arguments)
    if options.number is None:
        for bug in bugs():
            text = (SYMPTOMS[bug.symptom].__doc__ or "").partition("\n")[0]
            print(f"{bug.number:3}  {'*' * bug.grade:4} {text}")
        return 0
    if not 1 <= options.number <= len(bugs()):
        parser.error(f"number: expected 1 to {len(bugs())}, got {options.number}")
    bug = bugs()[options.number - 1]
    if options.hint:
        print(bug.hint)
        return 0
    if options.answer is None:
        return show(bug, FOLDER / f"{bug.number:02}")
    try:
        right, text = judge(bug, options.answer)
    except ValueError as error:
        parser.error(str(error))
    print(text)
    return int(not right)


if __name__ == "__main__":
    sys.exit(main())
