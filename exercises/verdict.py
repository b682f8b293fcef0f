"""What the checks of the exercises share: comparisons that say what was expected."""

import inspect
import traceback
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from hypothesis import HealthCheck, find, settings
from hypothesis.errors import NoSuchExample
from hypothesis.strategies import SearchStrategy

SETTINGS = settings(
    max_examples=60, database=None, derandomize=True, suppress_health_check=list(HealthCheck)
)


class WrongAnswer(Exception):
    """Says what was expected and what came."""


def differs(got: Any, wanted: Any, tolerance: float) -> bool:
    """Is an answer of another shape, not finite or too far off?"""
    got, wanted = np.asarray(got), np.asarray(wanted)
    return got.shape != wanted.shape or not np.allclose(got, wanted, tolerance, tolerance)


def expect(what: str, got: Any, wanted: Any, why: str = "", tolerance: float = 1e-6) -> None:
    """WrongAnswer: `got` is not `wanted`; `why` says what a reader may have missed."""
    if got is None or differs(got, wanted, tolerance):
        reason = f"\n{why}" if why else ""
        raise WrongAnswer(f"{what}: expected {brief(wanted)}, got {brief(got)}{reason}")


def agree(
    what: str,
    yours: Callable[..., Any],
    ours: Callable[..., Any],
    cases: SearchStrategy[tuple[Any, ...]],
    why: str = "",
    tolerance: float = 1e-6,
) -> None:
    """WrongAnswer: arguments, as simple as Hypothesis finds them, for which the answers differ."""

    def wrong(case: tuple[Any, ...]) -> bool:
        answer = yours(*case)
        return answer is None or differs(answer, ours(*case), tolerance)

    try:
        case = find(cases, wrong, settings=SETTINGS)
    except NoSuchExample:
        return
    arguments = ", ".join(map(brief, case))
    expect(f"{what}({arguments})", yours(*case), ours(*case), why, tolerance)


def brief(value: Any) -> str:
    """Numbers with four decimals."""
    if isinstance(value, np.ndarray | list | tuple | float | np.generic):
        return np.array2string(np.asarray(value), precision=4, suppress_small=True, threshold=40)
    return repr(value)


def judge(module: ModuleType, functions: dict[str, Callable[..., Any]] | None = None) -> str:
    """What is wrong with the functions of an exercise; empty: nothing.

    `functions` take the place of those in the exercise's file.
    """
    names = inspect.signature(module.check).parameters
    given = functions or {name: getattr(module, name) for name in names}
    try:
        module.check(**given)
    except WrongAnswer as error:
        return str(error)
    except Exception as error:
        path = Path(str(module.__file__))
        frames = traceback.extract_tb(error.__traceback__)
        own = [frame for frame in frames if frame.filename == str(path)][-1]
        place = f"{path.parent.name}/{path.name}, line {own.lineno}"
        if isinstance(error, NotImplementedError):
            return f"nothing there yet: fill in `{own.name}` ({place})"
        return f"`{own.name}` raised {type(error).__name__}: {error} ({place})"
    return ""
