"""Mutants of a module: does a test fail where mutmut changes its code?

    pip install 'mutmut==3.8.*'
    python -m benchmarks.mutants kinematics can.canopen [--show] [--seconds 2] [--tests FILE ...]

A mutant may write anywhere: run this in a copy of the project. First each test runs once, which
gives its time and the functions that it calls. Then each mutant runs in a process against the
quickest tests of its function, `--seconds` in all, up to the first failure. The tests are those
of `test_<module>.py`, of `tests/properties` and of the module's docstrings. Outcomes are kept in
`mutants/<module>.json`: the next run repeats only tests of files that changed and mutants that no
test killed. A change of the module starts anew.
"""

from __future__ import annotations

import argparse
import contextlib
import difflib
import functools
import gc
import hashlib
import importlib
import inspect
import json
import multiprocessing
import os
import resource
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType, FunctionType, ModuleType
from typing import Any

os.environ["HYPOTHESIS_PROFILE"] = "mutants"
os.environ["OMP_NUM_THREADS"] = "1"

import pytest
import torch
from hypothesis import HealthCheck, Phase, settings
from tqdm import tqdm

try:
    from mutmut.mutation.file_mutation import mutate_file_contents
except ImportError:
    sys.exit("benchmarks.mutants: mutmut is missing: pip install 'mutmut==3.8.*'")

SLOWEST = 10.0  # s: slower tests are left out
UNKILLED = ("survived", "not reached")


def in_fork(work: Callable[[], Any], cpu_s: float, wall_s: float) -> Any:
    """What `work` returns in a forked, silent process; "time" if that ran out, else "died"."""
    get, put = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            os.setpgid(0, 0)
            resource.setrlimit(resource.RLIMIT_CPU, (int(cpu_s), int(cpu_s) + 1))
            resource.setrlimit(resource.RLIMIT_DATA, (8 << 30, 8 << 30))
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
            signal.alarm(int(wall_s))
            null = os.open(os.devnull, os.O_RDWR)
            for stream in (0, 1, 2):
                os.dup2(null, stream)
            os.write(put, json.dumps(work()).encode())
        finally:
            os._exit(0)
    os.close(put)
    with open(get, "rb") as pipe:
        text = pipe.read()
    status = os.waitpid(child, 0)[1]
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)  # processes that a test started
    if text:
        return json.loads(text)
    timeout = os.WIFSIGNALED(status) and os.WTERMSIG(status) in (signal.SIGXCPU, signal.SIGALRM)
    return "time" if timeout else "died"


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

    def __init__(self, module: str, seconds: float, out: Path) -> None:
        self.module = importlib.import_module(f"brokk_min.{module}")
        self.source = inspect.getsource(self.module)
        self.seconds = seconds
        self.out = out
        self.failed = False
        self.recent: list[str] = []  # tests that killed, the last one last
        digest = hashlib.sha256(self.source.encode()).hexdigest()
        self.kept: dict[str, Any] = {"source": digest, "files": {}, "outcomes": {}}
        if out.exists() and json.loads(out.read_text())["source"] == digest:
            self.kept = json.loads(out.read_text())

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
        self.note_tests(session.items)
        self.run_mutants(session.items)
        return True

    def note_tests(self, items: list[pytest.Item]) -> None:
        """Time [s] and called functions of each test, as noted where its file did not change."""
        for item in tqdm(items, "tests", disable=None):
            file = item.nodeid.split("::")[0]
            digest = hashlib.sha256(Path(file).read_bytes()).hexdigest()
            noted = self.kept["files"].get(file)
            if noted is None or noted["digest"] != digest:
                noted = {"digest": digest, "tests": {}}
                self.kept["files"][file] = noted
            if item.nodeid not in noted["tests"]:
                result = in_fork(functools.partial(self.trace, item), SLOWEST, 120)
                noted["tests"][item.nodeid] = result
                if not isinstance(result, list):
                    tqdm.write(f"{item.nodeid}: left out, {result or 'failed'}")

    def trace(self, item: pytest.Item) -> list[Any] | None:
        """Time [s] and called functions of a test; None: it failed."""
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
        return [time.process_time() - start, sorted(called)] if passed else None

    def chosen(self, items: list[pytest.Item], function: str) -> tuple[list[pytest.Item], float]:
        """The quickest tests of a function, recent killers first, and their time [s]."""
        times = {}
        for item in items:
            note = self.kept["files"][item.nodeid.split("::")[0]]["tests"][item.nodeid]
            if isinstance(note, list) and function in note[1]:
                times[item] = note[0]
        total = 0.0
        result = []
        for item in sorted(times, key=times.__getitem__):
            if result and total + times[item] > self.seconds:
                break
            result.append(item)
            total += times[item]
        rank = {test: place for place, test in enumerate(self.recent)}
        return sorted(result, key=lambda item: -rank.get(item.nodeid, -1)), total

    def run_mutants(self, items: list[pytest.Item]) -> None:
        """Outcome of each mutant that was not killed before."""
        mutated = mutate_file_contents(str(self.module.__file__), self.source)
        code = compiled(self.module, mutated.code)
        outcomes = {name: self.kept["outcomes"].get(name) for name in mutated.mutant_names}
        self.kept["outcomes"] = outcomes
        for mutant in tqdm(outcomes, "mutants", disable=None):
            if outcomes[mutant] not in (None, *UNKILLED):
                continue
            key, prefix = function_of(mutant)
            right = code[f"{prefix}{mutant.rpartition('_')[0]}_orig"]
            wrong = code[prefix + mutant]
            tests, seconds = self.chosen(items, key)
            outcome = "not reached"
            if tests:
                work = functools.partial(self.first_failure, tests, key, right, wrong)
                outcome = in_fork(work, 3 + 3 * seconds, 30 + 20 * seconds)
            outcomes[mutant] = outcome
            self.recent.append(outcome)
            self.out.write_text(json.dumps(self.kept))

    def first_failure(
        self, tests: list[pytest.Item], key: str, right: FunctionType, wrong: FunctionType
    ) -> str:
        """The first test that fails with the mutant."""
        change(self.module, key, right, wrong)
        for item, following in zip(tests, [*tests[1:], None], strict=True):
            if not self.passes(item, following):
                return item.nodeid
        return "survived"


# --- report ---------------------------------------------------------------------------------------


def report(module: str, out: Path, show: bool) -> None:
    """Print the score of a module, and with `show` the changes that no test detects."""
    outcomes = json.loads(out.read_text())["outcomes"]
    count = Counter(outcome for outcome in outcomes.values() if outcome in UNKILLED)
    reached = len(outcomes) - count["not reached"]
    killed = reached - count["survived"]
    print(
        f"{module}: {len(outcomes)} mutants, {count['not reached']} not reached, {killed} killed, "
    )
    print(
        f"    {killed / max(1, reached):.1%} of those reached, {killed / len(outcomes):.1%} of all"
    )
    if not show:
        return
    path = Path("brokk_min", *module.split(".")).with_suffix(".py")
    mutated = mutate_file_contents(str(path), path.read_text())
    lines = mutated.code.splitlines()
    spans = mutated.line_span_by_function_name
    for name, outcome in outcomes.items():
        if outcome in UNKILLED:
            old = spans[f"{name.rpartition('_')[0]}_orig"]
            new = spans[name]
            changes = difflib.ndiff(lines[old.start + 1 : old.end], lines[new.start + 1 : new.end])
            print(name, outcome, *(line for line in changes if line[0] in "+-"), sep="\n  ")


def run(module: str, options: argparse.Namespace, out: Path) -> None:
    """Mutants of one module, in a process of its own."""
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
    tests = options.tests or [*Path("tests").rglob(f"test_{path.stem}.py"), path]
    tests += [] if options.tests else Path("tests").glob("properties/*.py")
    flags = ["-s", "-otmp_path_retention_policy=none", "-oconsole_output_style=classic"]
    flags += [f"-pno:{plugin}" for plugin in ("cacheprovider", "xdist", "faulthandler")]
    files = sorted({str(test) for test in tests})
    pytest.main([*files, *flags], plugins=[Mutation(module, options.seconds, out)])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("modules", nargs="+", help="of brokk_min")
    parser.add_argument("--tests", nargs="*", help="files or folders, instead of the module's own")
    parser.add_argument("--seconds", type=float, default=2.0, help="of the tests of one mutant")
    parser.add_argument("--show", action="store_true", help="print changes that no test detects")
    options = parser.parse_args()
    Path("mutants").mkdir(exist_ok=True)
    for module in options.modules:
        out = Path("mutants", f"{module}.json")
        process = multiprocessing.get_context("fork").Process(
            target=run, args=(module, options, out)
        )
        process.start()
        process.join()
        report(module, out, options.show)


if __name__ == "__main__":
    main()
