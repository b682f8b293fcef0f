"""The bug hunt: an error is planted in a copy of the package; find its file and line.

python -m exercises.hunt                       the list of bugs
python -m exercises.hunt 7                     plant bug 7 in hunts/07 and show its symptoms
python -m exercises.hunt 7 --hint              a hint
python -m exercises.hunt 7 actuator.py:123     the verdict on an answer
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from exercises.symptoms import SYMPTOMS, measure

ROOT = Path(__file__).parents[1]
FOLDER = Path("hunts")  # of the copies, in the folder in which the hunt is called


class Bug(NamedTuple):
    """A planted error and how it is hunted."""

    file: str  # within the package
    right: str
    wrong: str
    symptom: str  # name in `symptoms.SYMPTOMS`
    grade: int
    hint: str
    published: str = ""  # who else had it; empty: not known

    @property
    def line(self) -> int:
        """The line that is wrong."""
        text = (ROOT / "brokk_min" / self.file).read_text()
        return text[: text.index(self.right)].count("\n") + 1


def bugs() -> list[Bug]:
    """All bugs, the easy ones first."""
    table = tomllib.loads((ROOT / "exercises" / "hunts.toml").read_text())["hunt"]
    return sorted((Bug(**row) for row in table), key=lambda bug: bug.grade)


def plant(bug: Bug, folder: Path) -> None:
    """Copy the package into `folder`, and put the error in."""
    ignore = shutil.ignore_patterns("__pycache__")
    shutil.copytree(ROOT / "brokk_min", folder / "brokk_min", ignore=ignore)
    path = folder / "brokk_min" / bug.file
    path.write_text(path.read_text().replace(bug.right, bug.wrong))


def symptoms_of_copy(name: str, folder: Path) -> dict[str, str]:
    """`symptoms.measure` by the package in `folder`; what the copy prints is printed."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(folder.resolve()), str(ROOT)])}
    command = [sys.executable, "-m", "exercises.symptoms", name]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    if done.returncode:
        return {"raised": done.stderr.strip().rpartition("\n")[2]}
    *printed, last = done.stdout.splitlines()
    print(*printed, sep="\n", end="\n" * bool(printed))
    return dict(json.loads(last))


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


def show(number: int, bug: Bug) -> None:
    """Plant the bug where that was not done, and print its symptoms."""
    folder = FOLDER / f"{number:02}"
    if not folder.exists():
        plant(bug, folder)
    expected, got = measure(bug.symptom), symptoms_of_copy(bug.symptom, folder)
    print(f"Bug {number}, grade {bug.grade}, somewhere in {folder}/brokk_min. The symptom:")
    print((SYMPTOMS[bug.symptom].__doc__ or "").strip(), end=" ")
    print(f"(`{bug.symptom}` in exercises/symptoms.py measures it.)", end="\n\n")
    print("\n".join(comparison(expected, got)))
    if expected == got:
        print("\nNo symptom is left: the copy is healthy.")
    print(f"\nAnswer with: python -m exercises.hunt {number} FILE:LINE")


def judge(bug: Bug, answer: str) -> tuple[bool, str]:
    """Is FILE:LINE the wrong line, or one beside it? And what to say. ValueError: no answer."""
    file, _, line = answer.rpartition(":")
    file = file.replace("\\", "/").rpartition("brokk_min/")[2]
    if not line.isdigit() or not (ROOT / "brokk_min" / file).is_file():
        raise ValueError(f"answer: expected a file of the package and a line, got {answer!r}")
    if file != bug.file:
        return False, "Not there: another file."
    if abs(int(line) - bug.line) > 1:
        return False, "The right file, another line."
    text = f"Right. Read brokk_min/{bug.file}, line {bug.line}; {bug.hint}"
    return True, f"{text}\n  wrong  {bug.wrong}\n  right  {bug.right}\n{bug.published}".rstrip()


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
    every = dict(enumerate(bugs(), 1))
    if options.number is None:
        for number, bug in every.items():
            text = (SYMPTOMS[bug.symptom].__doc__ or "").partition("\n")[0]
            print(f"{number:3}  {'*' * bug.grade:4} {text}")
        return 0
    if options.number not in every:
        parser.error(f"number: expected 1 to {len(every)}, got {options.number}")
    bug = every[options.number]
    if options.hint or options.answer is None:
        print(bug.hint) if options.hint else show(options.number, bug)
        return 0
    try:
        right, text = judge(bug, options.answer)
    except ValueError as error:
        parser.error(str(error))
    print(text)
    return int(not right)


if __name__ == "__main__":
    sys.exit(main())
