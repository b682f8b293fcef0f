"""Planted errors: the test that promises a property must find each, by an assertion.

A planted error replaces one piece of a module's source. The changed function's code takes the place
of the right one in the same function object, so everybody who imported it runs the wrong code. The
safety gate has planted errors of its own (`tests/can/`).
"""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import itertools
import sys
import types
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import Phase, settings

TESTS = Path(__file__).parents[1]
PLANTED: dict[str, list[tuple[str, str, str]]] = {  # test: module, right, wrong
}


def functions(code: types.CodeType) -> Iterator[tuple[str, types.CodeType]]:
    """Functions and methods of a compiled module by qualified name."""
    for part in code.co_consts:
        if isinstance(part, types.CodeType) and "<locals>" not in part.co_qualname:
            yield part.co_qualname, part
            yield from functions(part)


def function_of(module: types.ModuleType, name: str) -> types.FunctionType | None:
    """The function of a qualified name, without its decorator; None: a class."""
    thing: Any = module
    for part in name.split("."):
        thing = vars(thing).get(part)
    for wrapper in ("func", "fget"):
        thing = getattr(thing, wrapper, thing)
    thing = inspect.unwrap(thing)
    return thing if isinstance(thing, types.FunctionType) else None


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
    before = dict(functions(compile(source, str(module.__file__), "exec")))
    after = dict(functions(compile(source.replace(right, wrong), str(module.__file__), "exec")))
    changed = [function_of(module, key) for key in before if before[key] != after[key]]
    (function,) = [function for function in changed if function]
    kept = function.__code__
    function.__code__ = after[kept.co_qualname]
    clear_caches()
    try:
        yield
    finally:
        function.__code__ = kept
        clear_caches()


@cache
def copy_of(path: Path) -> types.ModuleType:
    """A test file imported once more; its properties stop at the first failure."""
    spec = importlib.util.spec_from_file_location(f"copy_of_{path.stem}", path)
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    loaded = settings.get_current_profile_name()
    settings.register_profile("planted", settings.default, phases=[Phase.generate], print_blob=False)
    settings.load_profile("planted")
    try:
        spec.loader.exec_module(module)
    finally:
        settings.load_profile(loaded)
    return module


@cache
def files() -> dict[str, Path]:
    """The file of each test function that the table names."""
    texts = {path: path.read_text() for path in TESTS.rglob("test_*.py")}
    found = {name: [p for p, text in texts.items() if f"\ndef {name}(" in text] for name in PLANTED}
    return {name: paths[0] for name, paths in found.items() if len(paths) == 1}


def cases(test: Any, tmp_path: Path) -> Iterator[dict[str, object]]:
    """Arguments of each case of a parametrised test."""
    axes = []
    for mark in getattr(test, "pytestmark", []):
        if mark.name == "parametrize":
            names = mark.args[0]
            names = [n.strip() for n in names.split(",")] if isinstance(names, str) else names
            values = [getattr(value, "values", value) for value in mark.args[1]]
            one = len(names) == 1
            axes.append([dict(zip(names, [v] if one else v, strict=True)) for v in values])
    for combination in itertools.product(*axes):
        arguments = {name: value for case in combination for name, value in case.items()}
        if "tmp_path" in inspect.signature(test).parameters:
            arguments["tmp_path"] = tmp_path
        yield arguments


def finds_an_error(test: Any, tmp_path: Path) -> bool:
    """Does the test fail by an assertion?"""
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        for arguments in cases(test, tmp_path):
            try:
                test(**arguments)
            except (AssertionError, pytest.fail.Exception):
                return True
    return False


def test_planted_errors__are_in_every_file_of_the_method() -> None:
    modules = {module for errors in PLANTED.values() for module, _, _ in errors}
    assert sum(len(errors) for errors in PLANTED.values()) >= 50
    assert {"machine", "kinematics", "actuator", "env", "ppo", "jacobian"} <= modules


@pytest.mark.parametrize(
    ("test", "module", "right", "wrong"),
    [(test, *error) for test, errors in PLANTED.items() for error in errors],
    ids=lambda text: text[:40],
)
def test_planted_error__is_found(
    test: str, module: str, right: str, wrong: str, tmp_path: Path
) -> None:
    check = getattr(copy_of(files()[test]), test)
    with planted(module, right, wrong):
        assert finds_an_error(check, tmp_path), f"{test} passes with {wrong!r} in {module}.py"
