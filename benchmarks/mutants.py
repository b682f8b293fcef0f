"""Mutants of the package, each in a process forked for it, against the tests that call its function.

    pip install 'mutmut==3.8.*'
    python -m benchmarks.mutants plant metrics [--again] [--show] [--seconds 2] [--tests FILE ...]

A mutant may write anywhere: run it in a copy of the project. At first each test runs alone, to note how long
it takes and which functions it calls (`tests.json`; a file of tests that changed is run again). A mutant then
meets the quick ones of those tests up to the first that fails, its own file's before others, `--seconds` in
all; a line is added to `mutants.jsonl`. What stands there is not run again, but survivors with `--again`, 10
times as long. At the end: mutants, those that no test reached, killed and score of each module named.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import difflib
import gc
import hashlib
import importlib
import inspect
import json
import os
import resource
import signal
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from dataclasses import fields
from functools import partial
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any, TextIO

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1") | {
    "HYPOTHESIS_PROFILE": "mutants"
}
import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, Phase, settings

from brokk_min.machine import Machine

try:
    from mutmut.mutation.file_mutation import mutate_file_contents
except ImportError:
    sys.exit("benchmarks.mutants: mutmut is missing: pip install 'mutmut==3.8.*'")

LEFT_OUT = [
    "mutants",
    "walkthrough",
    "docs",
    "benchmarks",
]  # they plant errors, or start other processes
QUICK = 2.5  # s; slower tests run only for functions that no quicker one calls
reached: set[str] = set()  # functions called since it was emptied


def functions(names: dict[str, Any], module: str) -> Iterator[tuple[str, FunctionType]]:
    """Functions and methods of a module, as `f` and `Class.f`."""
    for name, thing in list(names.items()):
        if inspect.isclass(thing) and thing.__module__ == module:
            for key, value in vars(thing).items():
                if inspect.isfunction(function := getattr(value, "__func__", value)):
                    yield f"{thing.__name__}.{key}", function
        elif inspect.isfunction(thing) and thing.__module__ == module:
            yield name, thing


def made(module: ModuleType, source: str) -> dict[str, FunctionType]:
    """The functions of another source of a module."""
    names = {
        "__name__": module.__name__,
        "__file__": module.__file__,
        "__package__": "brokk_min",
        "_reached": reached,
    }
    exec(compile(source, str(module.__file__), "exec", dont_inherit=True), names)
    return dict(functions(names, module.__name__))


def note_calls(module: ModuleType) -> None:
    """From now on functions of the module that are called are put into `reached`."""
    tree = ast.parse(inspect.getsource(module))
    module.__dict__["_reached"] = reached
    for node in tree.body:
        for part in node.body if isinstance(node, ast.ClassDef) else [node]:
            if isinstance(part, ast.FunctionDef):
                name = f"{node.name}.{part.name}" if part is not node else part.name
                part.body[:0] = ast.parse(f"_reached.add({f'{module.__name__}.{name}'!r})").body
    noting = made(module, ast.unparse(tree))
    for name, function in functions(vars(module), module.__name__):
        if name in noting and "_reached" in noting[name].__code__.co_names:
            function.__code__ = noting[name].__code__


def plant(module: ModuleType, key: str, right: FunctionType, wrong: FunctionType) -> None:
    """The mutant's code and defaults in the function itself, so wherever that is known already."""
    function = dict(functions(vars(module), module.__name__))[key]
    if function.__code__.co_freevars != wrong.__code__.co_freevars:  # a `super()` is gone
        return setattr(getattr(module, key.split(".")[0]), key.split(".")[1], wrong)
    function.__code__ = wrong.__code__
    if repr(right.__defaults__) != repr(wrong.__defaults__):
        function.__defaults__ = wrong.__defaults__
    if repr(right.__kwdefaults__) != repr(wrong.__kwdefaults__):
        function.__kwdefaults__ = wrong.__kwdefaults__


def in_fork(work: Callable[[], Any], cpu: float, wall: float) -> Any:
    """What `work` returns in a process of its own, or "time" if that ran out, or "died"."""
    get, put = os.pipe()
    if (child := os.fork()) == 0:
        try:
            os.setpgid(0, 0)
            resource.setrlimit(resource.RLIMIT_CPU, (int(cpu), int(cpu) + 1))
            resource.setrlimit(resource.RLIMIT_DATA, (8 << 30, 8 << 30))
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
            signal.alarm(int(wall))
            null = os.open(os.devnull, os.O_RDWR)
            for out in 0, 1, 2:
                os.dup2(null, out)
            os.write(put, json.dumps(work()).encode())
        finally:
            os._exit(0)
    os.close(put)
    with open(get, "rb") as answer:
        text = answer.read()
    status = os.waitpid(child, 0)[1]
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)  # what a test had started
    out_of_time = os.WIFSIGNALED(status) and os.WTERMSIG(status) in (signal.SIGXCPU, signal.SIGALRM)
    return json.loads(text) if text else "time" if out_of_time else "died"


class Runs:
    """A plugin with a loop of its own: each test alone, then the mutants of the modules."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.options, self.failed = options, False
        self.notes: dict[str, Any] = {}

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.failed |= report.failed

    def passes(self, item: pytest.Item, after: pytest.Item | None = None) -> bool:
        self.failed = False
        item.config.hook.pytest_runtest_protocol(item=item, nextitem=after)
        return not self.failed

    def alone(self, item: pytest.Item) -> list[Any] | None:
        start, passed = time.process_time(), self.passes(item)
        return [time.process_time() - start, sorted(reached)] if passed else None

    def each_alone(self, items: list[pytest.Item]) -> dict[str, Any]:
        for module in [
            module for name, module in sys.modules.items() if name.startswith("brokk_min.")
        ]:
            note_calls(module)
        reached.clear()  # what importing the copies called
        return {item.nodeid: in_fork(lambda item=item: self.alone(item), 6, 120) for item in items}

    def note(self, session: pytest.Session) -> None:
        """Have the seconds and the functions of each test, of a file that changed anew."""
        kept, files = self.options.out / "tests.json", defaultdict(list)
        notes = json.loads(kept.read_text()) if kept.exists() else {}
        for item in session.items:
            files[item.nodeid.split("::")[0]].append(item)
        for file, items in files.items():
            stamp = hashlib.sha256(Path(file).read_bytes()).hexdigest()
            if notes.get(file, [None])[0] != stamp:
                notes[file] = [stamp, {}]
            if items := [item for item in items if item.nodeid not in notes[file][1]]:
                notes[file][1] |= in_fork(lambda items=items: self.each_alone(items), 1e5, 1e5)
                kept.write_text(json.dumps(notes))
                out = [test for test, note in notes[file][1].items() if not isinstance(note, list)]
                print(f"{file}: {len(items)} tests, left out: {out}", flush=True)
            self.notes |= {
                test: note for test, note in notes[file][1].items() if isinstance(note, list)
            }

    def chosen(self, callers: list[pytest.Item], module: str, seconds: float) -> list[pytest.Item]:
        """The quickest tests, those of the module's own first, up to so many seconds in all."""
        took = {item: self.notes[item.nodeid][0] for item in callers}
        own = (f"tests/test_{module}.py", f"brokk_min/{module}.py")
        quick = [item for item in took if took[item] < QUICK]
        quick.sort(key=lambda item: (not item.nodeid.startswith(own), took[item]))
        total = np.cumsum([took[item] for item in quick])
        return sorted(quick[: 1 + int(np.sum(total < seconds))], key=took.__getitem__)

    def first_failure(self, items: list[pytest.Item], change: Callable[[], None]) -> str:
        change()
        pairs = zip(items, [*items[1:], None], strict=True)  # the next one may share a fixture
        return next(
            (item.nodeid for item, after in pairs if not self.passes(item, after)), "survived"
        )

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        for machine in [thing for thing in gc.get_objects() if type(thing) is Machine]:
            for kept in machine.__dict__.keys() - {field.name for field in fields(Machine)}:
                del machine.__dict__[kept]  # or mutants hide behind it
        gc.freeze()
        self.note(session)
        callers = defaultdict(list)
        for item in session.items:
            for function in self.notes.get(item.nodeid, [0, []])[1]:
                callers[function].append(item)
        with (self.options.out / "mutants.jsonl").open("a+", buffering=1) as log:
            log.seek(0)
            done = {line["mutant"]: line["outcome"] for line in map(json.loads, log)}
            for name in self.options.modules:
                self.module(name, callers, done, log)
        return True

    def module(self, name: str, callers: Any, done: dict[str, str], log: TextIO) -> None:
        module = importlib.import_module(f"brokk_min.{name}")
        mutated = mutate_file_contents(f"brokk_min/{name}.py", inspect.getsource(module))
        code, recent = made(module, mutated.code), {}
        seconds = self.options.seconds * (10 if self.options.again else 1)
        for number, mutant in enumerate(mutated.mutant_names):
            was = done.get(f"{name}.{mutant}")
            if was is not None and not (self.options.again and was in ("survived", "not reached")):
                continue
            parts = mutant.rpartition("__mutmut_")[0].removeprefix("x_").split("ǁ")[-2:]
            key, prefix = ".".join(parts), parts[0] + "." if len(parts) > 1 else ""
            right, wrong = (code[prefix + n] for n in (mutant.rpartition("_")[0] + "_orig", mutant))
            items = self.chosen(callers[f"brokk_min.{name}.{key}"], name, seconds)
            items.sort(
                key=lambda item: -recent.get(item.nodeid, -1)
            )  # what killed the last ones first
            total = sum(self.notes[item.nodeid][0] for item in items)
            change = partial(plant, module, key, right, wrong)
            start, outcome = time.perf_counter(), "not reached"
            if items:
                outcome = in_fork(
                    lambda items=items, c=change: self.first_failure(items, c),
                    2 + 3 * total,
                    30 + 20 * total,
                )
            recent[outcome] = number
            line = {
                "mutant": f"{name}.{mutant}",
                "outcome": outcome,
                "tests": len(items),
                "seconds": time.perf_counter() - start,
            }
            log.write(json.dumps(line) + "\n")


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("modules", nargs="*", help="of brokk_min")
    parser.add_argument("--again", action="store_true", help="survivors too, 10 times as long")
    parser.add_argument("--show", action="store_true", help="what survivors change")
    parser.add_argument("--seconds", type=float, default=2.0, help="of the tests of a mutant")
    parser.add_argument(
        "--tests", nargs="*", default=["tests", "brokk_min"], help="files or folders"
    )
    parser.add_argument("--out", type=Path, default=Path("mutants"))
    options = parser.parse_args()
    options.out.mkdir(exist_ok=True)
    torch.set_num_threads(1)
    torch.optim.Adam(
        [torch.zeros(1, requires_grad=True)]
    )  # imports for seconds: once, not in each process
    profile = {"max_examples": 8, "deadline": None, "derandomize": True, "database": None}
    phases = [Phase.explicit, Phase.generate]
    settings.register_profile(
        "mutants", phases=phases, suppress_health_check=list(HealthCheck), **profile
    )
    for path in Path("brokk_min").glob("[!_]*.py"):
        importlib.import_module(f"brokk_min.{path.stem}")
    flags = ["-s", "-o", "tmp_path_retention_policy=none"]
    flags += [f"-pno:{plugin}" for plugin in ("cacheprovider", "xdist", "faulthandler")]
    flags += [f"--ignore=tests/test_{name}.py" for name in LEFT_OUT]
    code = int(pytest.main([*options.tests, *flags], plugins=[Runs(options)]))
    for module in options.modules:
        tell(module, options)
    return code


def tell(module: str, options: argparse.Namespace) -> None:
    """Print how a module fared, and with `--show` what its survivors change."""
    mutated = mutate_file_contents(module, Path(f"brokk_min/{module}.py").read_text())
    lines = map(json.loads, (options.out / "mutants.jsonl").read_text().splitlines())
    outcomes = {line["mutant"]: line["outcome"] for line in lines}  # the last of each counts
    mine = {name: outcomes.get(f"{module}.{name}", "not run") for name in mutated.mutant_names}
    count = Counter(
        outcome for outcome in mine.values() if outcome in ("survived", "not reached", "not run")
    )
    reached = len(mine) - count["not reached"] - count["not run"]
    killed = reached - count["survived"]
    print(
        f"{module}: {len(mine)} mutants, {dict(count)}, {killed} killed, {killed / max(1, reached):.1%}"
    )
    for name in (name for name in mine if mine[name] == "survived" and options.show):
        spans = (
            mutated.line_span_by_function_name[n] for n in (f"{name.rpartition('_')[0]}_orig", name)
        )
        old, new = (mutated.code.splitlines()[span.start : span.end] for span in spans)
        print(
            name, *(line for line in difflib.ndiff(old[1:], new[1:]) if line[0] in "+-"), sep="\n  "
        )


if __name__ == "__main__":
    sys.exit(main())
