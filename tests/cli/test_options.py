"""Machines and plants of files, outputs."""

import re
from dataclasses import replace

import numpy as np
import pytest

from brokk_min.actuator import PLANT
from brokk_min.cli.options import Command, WrongUse, default_policy, find_plant
from brokk_min.machine import BROKK_170

FILE = """
from dataclasses import replace
from beside_it import NAME
from brokk_min.machine import BROKK_170
from brokk_min.actuator import PLANT, AnalyticPlant
DIGGER = replace(BROKK_170, name=NAME)
NUMBER = 3

class Late(AnalyticPlant):
    def step(self, machine, state, u):
        import beside_it_late
        return super().step(machine, state, u)

class Reversed(AnalyticPlant):
    def step(self, machine, state, u):
        return super().step(machine, state, -u)

class Broken(AnalyticPlant):
    def step(self, machine, state, u):
        return state._replace(q=state.q * float("nan"))

LATE, REVERSED, BROKEN = Late(), Reversed(), Broken()
"""


@pytest.fixture
def file(tmp_path):
    """A file that imports others beside it, one of them late."""
    (tmp_path / "beside_it.py").write_text("NAME = 'digger'\n")
    (tmp_path / "beside_it_late.py").touch()
    (tmp_path / "own.py").write_text(FILE)
    return tmp_path / "own.py"


def test_find_machine__takes_a_name_or_an_object_of_a_file(file):
    assert Command().find_machine() is BROKK_170
    assert Command(machine=f"{file}:DIGGER").find_machine().name == "digger"
    with pytest.raises(WrongUse, match="--machine: expected a Machine, got 3"):
        Command(machine=f"{file}:NUMBER").find_machine()
    with pytest.raises(WrongUse, match=re.escape(f"expected an object NONE in {file}, got none")):
        Command(machine=f"{file}:NONE").find_machine()
    file.write_text("1 / 0")
    with pytest.raises(ValueError, match=r"--machine: expected .* to run, got division by zero"):
        Command(machine=f"{file}:DIGGER").find_machine()


def test_find_plant__tries_each_joint(file):
    assert find_plant("analytic", BROKK_170) is PLANT
    q = BROKK_170.q_start
    assert np.array_equal(find_plant(f"{file}:LATE", BROKK_170).reset(BROKK_170, q).q, q)
    for name, message in {
        "NUMBER": "expected states with angles q, got 'int' object has no attribute 'reset'",
        "REVERSED": "q1: expected motion up, then down, got -",
        "BROKEN": r"expected finite angles q \(10, 5\)",
    }.items():
        with pytest.raises(ValueError, match=message):
            find_plant(f"{file}:{name}", BROKK_170)


def test_default_policy__is_the_packages_if_it_has_one():
    assert all(path and path.exists() for path in default_policy(BROKK_170, None))
    with pytest.raises(WrongUse, match="--policy: expected one for digger, got none"):
        default_policy(replace(BROKK_170, name="digger"), None)


def test_writes__refuses_folders_that_are_missing_and_files_that_exist(tmp_path):
    path = tmp_path / "a.csv"
    Command().writes(path, None)
    path.touch()
    Command(force=True).writes(path)
    for bad, message in {
        path: r"a.csv: expected no file \(or --force\), got one",
        tmp_path: "expected a file in an existing, writable folder",
        tmp_path / "no" / "a.csv": "expected a file in an existing, writable folder",
    }.items():
        with pytest.raises(WrongUse, match=message):
            Command().writes(bad)
