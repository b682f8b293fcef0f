"""Common to the commands: ranges of options, the machine, default policy and gains."""

import os
import runpy
from dataclasses import dataclass, is_dataclass
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import tyro

from brokk_min.identification.files import SHIPPED
from brokk_min.machine import BROKK_170, Machine

MACHINES = {BROKK_170.name: BROKK_170}
MachineName = Annotated[str, tyro.conf.arg(metavar="{" + ",".join(MACHINES) + "}|FILE.py:NAME")]


class WrongUse(ValueError):
    """Options that make no sense; exit status 2."""


@dataclass(frozen=True)
class Range:
    """Least and largest value of an option, both allowed."""

    low: float
    high: float


Seed = Annotated[int, Range(0, 2**31 - 1)]
Count = Annotated[int, Range(1, 10**6)]
Samples = Annotated[int, Range(2, 100)]


def check_ranges(options: Any) -> None:
    """WrongUse: a field, or one of a dataclass within, is outside the `Range` of its annotation."""
    for name, hint in get_type_hints(type(options), include_extras=True).items():
        value = getattr(options, name)
        if is_dataclass(value):
            check_ranges(value)
        for limits in getattr(hint, "__metadata__", ()):
            if not isinstance(limits, Range) or value is None:
                continue
            if not limits.low <= value <= limits.high:
                expected = f"{limits.low:.10g} to {limits.high:.10g}"
                raise WrongUse(f"--{name.replace('_', '-')}: expected {expected}, got {value}")


@dataclass(kw_only=True)
class Command:
    """Options of every command."""

    machine: MachineName = BROKK_170.name  # Which one; FILE.py:NAME runs a file that you trust.
    seed: Seed = 0  # Of everything random.

    def check(self, *outputs: Path | None) -> Machine:
        """The machine; WrongUse: an option out of range or an output that cannot be written."""
        check_ranges(self)
        for path in outputs:
            if path and (path.is_dir() or not os.access(path.parent, os.W_OK)):
                raise WrongUse(f"{path}: expected a file in an existing, writable directory")
        return find_machine(self.machine or BROKK_170.name)


def find_machine(name: str) -> Machine:
    """A machine by its name, or `FILE.py:NAME`: that file is run, as `python FILE.py` would."""
    if name in MACHINES:
        return MACHINES[name]
    path, _, symbol = name.rpartition(":")
    if not path.endswith(".py"):
        raise WrongUse(f"--machine: expected one of {list(MACHINES)} or FILE.py:NAME, got {name}")
    try:
        machine = runpy.run_path(path).get(symbol)
    except Exception as error:  # whatever the file does
        raise ValueError(f"--machine: expected {path} to run, got {error!r}") from error
    if not isinstance(machine, Machine):
        raise WrongUse(f"--machine: expected a Machine {symbol} in {path}, got {machine!r}")
    return machine


def default_policy(
    machine: Machine, policy: Path | None, gains: Path | None
) -> tuple[Path, Path | None]:
    """Policy, by default the package's; gains, by default gains.json in its folder (or None)."""
    policy = policy or SHIPPED / machine.name / "policy.npz"
    tuned = policy.with_name("gains.json")
    return policy, gains or (tuned if tuned.exists() else None)
