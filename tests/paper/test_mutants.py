"""Planted errors: the test that promises a property must find each, by an assertion.

`planted.txt` has below each test the errors that it must find, `module: right => wrong`. The
changed function's code takes the place of the right one in the same function object, so everybody
who imported it runs the wrong code.
"""

import importlib
import inspect
import itertools
import re
import runpy
import sys
import types
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from operator import attrgetter
from pathlib import Path
from typing import Any

import coverage
import pytest
from hypothesis import Phase, settings

TABLE = Path(__file__).with_name("planted.txt")
FILES = sorted(Path(__file__).parents[1].rglob("test_*.py"))


@pytest.fixture(scope="module", autouse=True)
def without_coverage() -> Iterator[None]:
    """Lines that only wrong code runs do not count as covered."""
    if measured := coverage.Coverage.current():
        measured.stop()
    yield
    if measured:
        with warnings.catch_warnings(action="ignore"):  # that the package is imported already
            measured.start()


def planted_errors() -> list[tuple[str, str, str, str]]:
    """Test, module, right and wrong source of each planted error."""
    errors = []
    test = ""
    for line in TABLE.read_text().splitlines():
        if line.startswith("test_"):
            test = line
        elif line:
            module, _, change = line.strip().partition(": ")
            right, _, wrong = change.partition(" => ")
            errors.append((test, module, right, wrong))
    return errors


def functions(code: types.CodeType) -> Iterator[types.CodeType]:
    """Functions, classes and their methods, of a compiled module."""
    for part in code.co_consts:
        if isinstance(part, types.CodeType) and "<locals>" not in part.co_qualname:
            yield part
            yield from functions(part)


def clear_caches() -> None:
    """Empty each `lru_cache` of the package."""
    for name, module in list(sys.modules.items()):
        if name.startswith("brokk_min."):
            for thing in vars(module).values():
                getattr(thing, "cache_clear", lambda: None)()


@contextmanager
def planted(name: str, right: str, wrong: str) -> Iterator[None]:
    """The package with one error in it."""
    module = importlib.import_module(f"brokk_min.{name}")
    source = inspect.getsource(module)
    if source.count(right) != 1:
        raise ValueError(f"{name}: expected {right!r} once, got {source.count(right)} times")
    before = functions(compile(source, str(module.__file__), "exec"))
    after = functions(compile(source.replace(right, wrong), str(module.__file__), "exec"))
    *_, changed = (new for old, new in zip(before, after) if old != new)  # a method after its class
    thing = attrgetter(changed.co_qualname)(module)
    function = inspect.unwrap(getattr(thing, "fget", None) or getattr(thing, "func", thing))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(function, "__code__", changed)
        clear_caches()
        yield
    clear_caches()


@cache
def copies(path: Path) -> dict[str, Any]:
    """What a test file defines, run once more; its properties stop at the first failure."""
    loaded = settings.get_current_profile_name()
    phases = [Phase.explicit, Phase.generate]
    settings.register_profile("planted", settings.default, phases=phases, max_examples=200)
    settings.load_profile("planted")
    names = runpy.run_path(str(path))
    settings.load_profile(loaded)
    return names


@cache
def copy_of(test: str) -> Any:
    """A test function of such a copy."""
    (path,) = [path for path in FILES if f"\ndef {test}(" in path.read_text()]
    return copies(path)[test]


def cases(test: Any) -> Iterator[dict[str, object]]:
    """Arguments of each case of a parametrised test."""
    axes = []
    for mark in getattr(test, "pytestmark", []):
        names, values = mark.args[:2]
        names = [n.strip() for n in names.split(",")] if isinstance(names, str) else names
        rows = [[value] if len(names) == 1 else value for value in values]
        axes.append([dict(zip(names, row, strict=True)) for row in rows])
    for combination in itertools.product(*axes):
        yield {name: value for case in combination for name, value in case.items()}


def finds_an_error(test: Any) -> bool:
    """Does the test fail by an assertion?"""
    with warnings.catch_warnings(action="ignore"):
        for arguments in cases(test):
            try:
                test(**arguments)
            except (AssertionError, pytest.fail.Exception):
                return True
    return False


@pytest.mark.parametrize(("test", "module", "right", "wrong"), planted_errors())
def test_planted_error__is_found(test: str, module: str, right: str, wrong: str) -> None:
    with planted(module, right, wrong):
        assert finds_an_error(copy_of(test)), f"{test} passes with {wrong!r} in {module}.py"


def test_planted_errors__are_in_each_method_file_that_computes():
    """Settings are numbers alone; the README lists the method files."""
    readme = (TABLE.parents[2] / "README.md").read_text()
    listed = set(re.findall(r"\| \[`(\w+)\.py`\]\(brokk_min/\w+\.py\) \|", readme))
    assert {"machine", "hw"} < listed
    assert listed - {"__init__", "settings"} <= {name for _, name, *_ in planted_errors()}
