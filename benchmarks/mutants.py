"""Mutants of a module: does a test fail where mutmut changes its code?

    pip install 'mutmut==3.8.*'
    python -m benchmarks.mutants can.canopen

A mutant may write anywhere: run this in a copy of the project. First each test runs once, which
gives its time and the functions that it calls. Then each mutant runs in a process against the
quickest tests of its function, `SECONDS` in all, up to the first failure. The tests are those
of `test_<module>.py`, of `tests/properties` and of the module's docstrings. Changes that no test
detects are printed.
"""

from __future__ import annotations

import difflib
import functools
import gc
import importlib
import inspect
import multiprocessing
import os
import resource
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from types import FrameType, FunctionType, ModuleType
from typing import Any

os.environ["HYPOTHESIS_PROFILE"] = "mutants"
os.environ["OMP_NUM_THREADS"] = "1"

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, Phase, settings
from tqdm import tqdm

try:
    from mutmut.mutation.file_mutation import mutate_file_contents
except ImportError:
    sys.exit("benchmarks.mutants: mutmut is missing: pip install 'mutmut==3.8.*'")

SECONDS = 2.0  # of the tests of one mutant
SLOWEST = 30.0  # s: slower tests are left out
UNKILLED = ("survived", "not reached")


def in_fork(work: Callable[[], Any], limit_s: float) -> Any:
    """What `work` returns in a forked, silent process; "time" if that ran out, else "died"."""
    context = multiprocessing.get_context("fork")
    get, put = context.Pipe(duplex=False)

    def run() -> None:
        os.setpgid(0, 0)
        resource.setrlimit(resource.RLIMIT_DATA, (8 << 30, 8 << 30))
        null = os.open(os.devnull, os.O_RDWR)
        for stream in (0, 1, 2):
            os.dup2(null, stream)
        put.send(work())

    process = context.Process(target=run)
    process.start()
    put.close()
    try:
        return get.recv() if get.poll(limit_s) else "time"
    except EOFError:
        return "died"
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid or 0, signal.SIGKILL)  # and processes that a test started
        process.join()
        get.close()


# --- functions of a module, right and wrong -------------------------------------------------------


def functions(names: dict[str, Any], module: str) -> Iterator[tuple[str, FunctionType]]:
    """Functions and methods that a module defines, as `f` and `Class.f`."""
    for name, thing in list(names.items()):
        if getattr(thing, "__module__", None) != module:
            continue
        if inspect.isfunction(thing):
            yield name, thing
        elif inspect.isclass(thing):
            for key, value in vars(thing).items():
                function = getattr(value, "__func__", value)  # of a class or static method
                if inspect.isfunction(function):
                    yield f"{thing.__name__}.{key}", function


def compiled(module: ModuleType, source: str) -> dict[str, FunctionType]:
    """The functions of another source of a module."""
    names = {name: vars(module)[name] for name in ("__name__", "__file__", "__package__")}
    exec(compile(source, str(module.__file__), "exec", dont_inherit=True), names)
    return dict(functions(names, module.__name__))


def change(module: ModuleType, key: str, right: FunctionType, wrong: FunctionType) -> None:
    """Put code and defaults of `wrong` into the function itself, wherever it was imported."""
    function = dict(functions(vars(module), module.__name__))[key]
    if function.__code__.co_freevars != wrong.__code__.co_freevars:  # without its `super()`
        owner, name = key.split(".")
        setattr(getattr(module, owner), name, wrong)
        return
    function.__code__ = wrong.__code__
    if repr(right.__defaults__) != repr(wrong.__defaults__):
        function.__defaults__ = wrong.__defaults__
    if repr(right.__kwdefaults__) != repr(wrong.__kwdefaults__):
        function.__kwdefaults__ = wrong.__kwdefaults__


def function_of(mutant: str) -> tuple[str, str]:
    """Function or method that a mutant changes, and the prefix of its mutants' names."""
    name = mutant.rpartition("__mutmut_")[0]
    if "ǁ" in name:
        _, owner, method = name.split("ǁ")
        return f"{owner}.{method}", f"{owner}."
    return name.removeprefix("x_"), ""


# --- tests ----------------------------------------------------------------------------------------


class Mutation:
    """A pytest plugin: instead of a run of all tests, each test alone, then all mutants."""

    def __init__(self, module: str) -> None:
        self.module = importlib.import_module(f"brokk_min.{module}")
        self.mutated = mutate_file_contents(self.module.__file__, inspect.getsource(self.module))
        self.failed = False
        self.notes: dict[pytest.Item, tuple[float, set[str]]] = {}  # time [s], called functions
        self.outcomes: dict[str, str] = {}

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.failed |= report.failed

    def passes(self, item: pytest.Item, following: pytest.Item | None = None) -> bool:
        self.failed = False
        item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
        return not self.failed

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        if session.testsfailed:
            raise session.Interrupted(f"{session.testsfailed} files cannot be collected")
        for name, loaded in list(sys.modules.items()):
            if name.startswith("brokk_min"):
                for thing in vars(loaded).values():
                    getattr(thing, "cache_clear", int)()  # or mutants hide behind it
        gc.freeze()
        for item in tqdm(session.items, "tests", disable=None):
            note = in_fork(functools.partial(self.trace, item), SLOWEST)
            if isinstance(note, tuple):
                self.notes[item] = note
            else:
                tqdm.write(f"{item.nodeid}: left out, {note}")
        self.run_mutants()
        self.report()
        return True

    def trace(self, item: pytest.Item) -> tuple[float, set[str]] | str:
        """Time [s] and called functions of a test."""
        called: set[str] = set()
        own = self.module.__name__

        def profile(frame: FrameType, event: str, _: object) -> None:
            if event == "call" and frame.f_globals.get("__name__") == own:
                called.add(frame.f_code.co_qualname)

        threading.setprofile(profile)
        sys.setprofile(profile)
        start = time.process_time()
        passed = self.passes(item)
        sys.setprofile(None)
        return (time.process_time() - start, called) if passed else "failed"

    def chosen(self, function: str) -> list[pytest.Item]:
        """The quickest tests of a function, in `SECONDS` together."""
        of_function = [item for item, (_, called) in self.notes.items() if function in called]
        of_function.sort(key=lambda item: self.notes[item][0])
        total = np.cumsum([self.notes[item][0] for item in of_function])
        return of_function[: max(1, int((total <= SECONDS).sum()))]

    def run_mutants(self) -> None:
        """Outcome of each mutant."""
        code = compiled(self.module, self.mutated.code)
        for mutant in tqdm(self.mutated.mutant_names, "mutants", disable=None):
            key, prefix = function_of(mutant)
            right = code[f"{prefix}{mutant.rpartition('_')[0]}_orig"]
            wrong = code[prefix + mutant]
            tests = self.chosen(key)
            work = functools.partial(self.first_failure, tests, key, right, wrong)
            limit_s = 10 + 20 * sum(self.notes[item][0] for item in tests)
            self.outcomes[mutant] = in_fork(work, limit_s) if tests else "not reached"

    def first_failure(
        self, tests: list[pytest.Item], key: str, right: FunctionType, wrong: FunctionType
    ) -> str:
        """The first test that fails with the mutant."""
        change(self.module, key, right, wrong)
        for item, following in zip(tests, [*tests[1:], None], strict=True):
            if not self.passes(item, following):
                return item.nodeid
        return "survived"

    def report(self) -> None:
        """Print the changes that no test detects, and the score."""
        lines = self.mutated.code.splitlines()
        spans = self.mutated.line_span_by_function_name
        for name, outcome in self.outcomes.items():
            if outcome in UNKILLED:
                old = spans[f"{name.rpartition('_')[0]}_orig"]
                new = spans[name]
                diff = difflib.ndiff(lines[old.start + 1 : old.end], lines[new.start + 1 : new.end])
                print(name, outcome, *(line for line in diff if line[0] in "+-"), sep="\n  ")
        count = Counter(outcome for outcome in self.outcomes.values() if outcome in UNKILLED)
        number = len(self.outcomes)
        killed = number - count.total()
        missed = count["not reached"]
        print(f"{self.module.__name__}: {number} mutants, {missed} not reached, {killed} killed")


def main() -> None:
    (module,) = sys.argv[1:]
    torch.set_num_threads(1)
    torch.optim.Adam([torch.zeros(1, requires_grad=True)])  # slow imports: once, not in each fork
    settings.register_profile(
        "mutants",
        max_examples=10,
        deadline=None,
        derandomize=True,
        database=None,
        phases=[Phase.explicit, Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    path = Path("brokk_min", *module.split(".")).with_suffix(".py")
    tests = {*Path("tests").rglob(f"test_{path.stem}.py"), *Path("tests/properties").glob("*.py")}
    flags = ["-s", "-otmp_path_retention_policy=none", "-oconsole_output_style=classic"]
    flags += [f"-pno:{plugin}" for plugin in ("cacheprovider", "xdist", "faulthandler")]
    pytest.main([*sorted(map(str, {path, *tests})), *flags], plugins=[Mutation(module)])


if __name__ == "__main__":
    main()
