"""Each bug of the hunt shows in its symptom, and right and wrong answers are told apart."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pytest

from exercises.hunt import ROOT, Bug, bugs, comparison, judge, main, mutants
from exercises.symptoms import SYMPTOMS, measure

BUGS = bugs()
NAMES = [f"{bug.number}-{bug.symptom}" for bug in BUGS]


@cache
def healthy(symptom: str) -> dict[str, str]:
    rows: dict[str, str] = measure(symptom)["rows"]
    return rows


def test_bugs__are_thirty_and_more_of_three_grades_in_many_files() -> None:
    assert len(BUGS) >= 30
    assert {bug.grade for bug in BUGS} == {1, 2, 3}
    assert {bug.symptom for bug in BUGS} == set(SYMPTOMS)
    assert len({bug.module for bug in BUGS}) >= 7
    assert sum(bool(bug.published) for bug in BUGS) >= 6
    assert len({(bug.module, bug.right, bug.wrong) for bug in BUGS}) == len(BUGS)


@pytest.mark.parametrize("symptom", SYMPTOMS)
def test_symptoms__of_the_package_are_the_same_each_time(symptom: str) -> None:
    rows = healthy(symptom)
    assert "raised" not in rows
    if symptom != "learning":  # a second each time
        assert measure(symptom)["rows"] == rows


@pytest.mark.parametrize("bug", BUGS, ids=NAMES)
def test_bug__shows_in_its_symptom(bug: Bug) -> None:
    expected = healthy(bug.symptom)
    with mutants().planted(bug.module, bug.right, bug.wrong):
        got = measure(bug.symptom)["rows"]
    assert any(line.endswith(" <-") for line in comparison(expected, got))


@pytest.mark.parametrize("bug", BUGS, ids=NAMES)
def test_judge__takes_the_line_of_the_error_alone(bug: Bug) -> None:
    text = (ROOT / "brokk_min" / bug.file).read_text().splitlines()
    (line,) = [i for i, content in enumerate(text, 1) if bug.right in content]
    assert judge(bug, f"{bug.file}:{line}")[0]
    assert judge(bug, f"hunts/07/brokk_min/{bug.file}:{line}")[0]
    for off in (-2, 2):
        assert judge(bug, f"{bug.file}:{line + off}") == (False, "The right file, another line.")
    other = "machine.py" if bug.file != "machine.py" else "env.py"
    assert judge(bug, f"{other}:{line}") == (False, "Not there: another file.")


def test_hunt__shows_symptoms_alone_until_the_copy_is_mended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (bug,) = [bug for bug in BUGS if bug.symptom == "pose" and "d * z" in bug.right]
    folder = tmp_path / "hunts" / f"{bug.number:02}"
    assert main([str(bug.number)]) == 0
    shown = capsys.readouterr().out
    assert "the paper's start: tool x, y, z [m]  <-\n" in shown
    assert bug.wrong not in shown
    assert bug.hint not in shown
    assert (folder / "symptom.png").stat().st_size > 5000
    path = folder / "brokk_min" / bug.file
    mended = path.read_text().replace(bug.wrong, bug.right)
    path.write_text(mended + "\nprint('from the copy')\n")
    assert main([str(bug.number)]) == 0
    shown = capsys.readouterr().out
    assert "from the copy\n" in shown
    assert "No symptom is left" in shown


def test_main__lists_hints_and_refuses(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    assert len(capsys.readouterr().out.splitlines()) == len(BUGS)
    assert main(["1", "--hint"]) == 0
    assert capsys.readouterr().out == BUGS[0].hint + "\n"
    assert main(["1", f"{BUGS[0].file}:1"]) == 1
    for words in (["0"], ["1000"], ["1", "nowhere.py:3"], ["1", "machine.py"]):
        with pytest.raises(SystemExit) as stop:
            main(words)
        assert stop.value.code == 2
        assert "expected" in capsys.readouterr().err
