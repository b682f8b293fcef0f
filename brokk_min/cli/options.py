"""Common to the commands: checks of options, the machine, default policy and gains."""

import os
import re
import runpy
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro

from brokk_min.identification.files import SHIPPED, brief, open_regular, read_json
from brokk_min.identification.plants import CheckedPlant, Plant, check_motion
from brokk_min.machine import BROKK_170, Machine, check_numbers, number

T = TypeVar("T")
MACHINES = {BROKK_170.name: BROKK_170}
MachineName = Annotated[str, tyro.conf.arg(metavar="{" + ",".join(MACHINES) + "}|FILE.py:NAME")]
PlantName = Annotated[str, tyro.conf.arg(metavar="{analytic,net}|FILE.py:NAME")]


class WrongUse(ValueError):
    """Options that make no sense; exit status 2."""


def checked(make: Callable[..., T], **options: Any) -> T:
    """What `make` gives for values of options; WrongUse: one that it refuses."""
    try:
        return make(**options)
    except ValueError as error:
        name, _, text = str(error).partition(": ")
        raise WrongUse(f"--{name.replace('_', '-')}: {text}") from error


# What a file of each kind that commands write holds: columns, arrays, keys, or see `names_in`.
CONTENTS = {
    "log": {"run", "time"},  # of `reproduce`, which records anew
    "nets": {"header", "input_mean"},
    "policy": {"header", "net_header"},
    "curve": {"global_step"},
    "scores": {"meta", "joints"},
    "inspection": {"meta", "recordings"},
    "diagnosis": {"meta", "terms"},
    "DBC": {'VERSION ""'},
    "runs": {"meta", "runs"},
    "gains": {"meta", "gains"},
    "sweep": {"meta", "table"},
    "family": {"meta", "members"},
    "results": {"meta", "task_space"},
    "preliminary": {"meta", "sim_to_real"},
    "attempts": {"when", "task", "mode"},
    "plant record": {"time", "valid"},
    "drive log": {"candump"},
    "picture": {"PNG"},
    "film": {"film"},
    "rerun": {"rerun"},
    "ONNX": {"ONNX"},
}
# What files of some kinds begin with, and what `names_in` calls them.
SIGNS = {b"\x89PNG": "PNG", b"GIF8": "film", b"(": "candump", b"\x08": "ONNX", b"RRF": "rerun"}


@dataclass(kw_only=True)
class Command:
    """Options of every command."""

    machine: MachineName = BROKK_170.name  # Which one; FILE.py:NAME runs a file that you trust.
    seed: int = number("1", 0, 2**31 - 1, 0)  # Of everything random.
    force: bool = False  # Write over files of another kind, too; never over an input.

    def check(self, others: Mapping[Path, str] | None = None, /, **outputs: str) -> Machine:
        """The machine; WrongUse: an option out of range or an output that must not be written.

        `outputs` are the kinds, as in `CONTENTS`, of options that name files to write; `others`
        those of files that are written without an option of their own.
        """
        checked(check_numbers, owner=self)
        if not getattr(self, "logs", True):
            raise WrongUse("LOGS: expected at least one log, got none")
        machine = find_machine(self.machine or BROKK_170.name)
        inputs = []
        for name in vars(self).keys() - outputs.keys():
            value = getattr(self, name)
            values = value if isinstance(value, tuple) else (value,)
            words = [str(word) for word in values if word and isinstance(word, Path | str)]
            inputs += [Path(re.sub(r"\.py:\w+$", ".py", word)) for word in words]  # FILE.py:NAME
        read = [path.resolve() for name in ("logs", "test") for path in vars(self).get(name, ())]
        if "test" in vars(self) and len(set(read)) < len(read):
            raise WrongUse("LOGS, --test: expected different files, got one twice")
        files = {getattr(self, name): kind for name, kind in outputs.items()}
        given = [path.resolve() for path in (getattr(self, name) for name in outputs) if path]
        if len(set(given)) < len(given):
            raise WrongUse(f"--{', --'.join(outputs)}: expected different files, got the same")
        existing = {path: kind for path, kind in (others or {}).items() if path.exists()}
        for path, kind in (files | existing).items():
            if path:
                check_output(path, CONTENTS.get(kind) or set(machine.names), kind, self.force)
                same = (path.exists() and one.exists() and path.samefile(one) for one in inputs)
                if any(same):
                    raise WrongUse(f"{path}: expected another file than an input to write")
        return machine


def check_output(path: Path, names: set[str], kind: str, force: bool) -> None:
    """WrongUse: a file that cannot be written, or, without `force`, one of another kind."""
    if path.is_dir() or not os.access(path.parent, os.W_OK):
        raise WrongUse(f"{path}: expected a file in an existing, writable directory")
    if not path.exists() or (path.is_file() and (force or not path.stat().st_size)):
        return
    if kind in ("recording", "drive log"):
        again = "no drive or recording can be repeated (--force)"
        raise WrongUse(f"{path}: expected no file, for {again}, got one")
    if not path.is_file() or not names <= names_in(path):
        got = "it has " + brief(sorted(names_in(path))) if path.is_file() else "no regular file"
        expected = f"expected no file, or one of kind {kind} (--force writes over others)"
        raise WrongUse(f"{path}: {expected}, got another: {got}")


def names_in(path: Path) -> set[str]:
    """Columns of a CSV, keys of JSON, arrays of an archive; PNG, ONNX, film or candump; or none."""
    try:
        with open_regular(path) as file:
            begin = file.read(2**16)
        if begin.startswith(b"PK"):
            with zipfile.ZipFile(path) as archive:
                return {name.removesuffix(".npy") for name in archive.namelist()}
        if begin.startswith(b"{"):
            return set(read_json(path, "JSON"))
        found = {kind for sign, kind in SIGNS.items() if begin.startswith(sign)}
        found |= {"film"} if begin[4:8] == b"ftyp" else set()
        header = begin.decode("utf-8-sig").split("\n")[0] if not found else ""
        return found or {name.strip() for name in header.split(",")}
    except Exception:  # whatever it is
        return set()


def find_object(option: str, name: str, known: Mapping[str, Any], kind: type, what: str) -> Any:
    """A known object by its name, or `FILE.py:NAME`: that file is run, as `python FILE.py` would.

    WrongUse: `option` names no file, or one without a NAME that is `what`, an object of a `kind`.
    """
    if name in known:
        return known[name]
    path, _, symbol = name.rpartition(":")
    if not path.endswith(".py"):
        raise WrongUse(f"{option}: expected one of {list(known)} or FILE.py:NAME, got {name}")
    try:
        with open_regular(Path(path), 2**20):
            found = runpy.run_path(path).get(symbol)
    except (Exception, SystemExit) as error:  # whatever the file does
        raise ValueError(f"{option}: expected {path} to run, got {brief(error)}") from error
    if not isinstance(found, kind) or isinstance(found, type):
        raise WrongUse(f"{option}: expected {what} {symbol} in {path}, got {brief(found)}")
    return found


def find_machine(name: str) -> Machine:
    """A machine by its name, or of a file, see `find_object`."""
    machine: Machine = find_object("--machine", name, MACHINES, Machine, "a Machine")
    return machine


def with_plant(machine: Machine, name: str, known: Sequence[str]) -> Machine:
    """The machine with the plant of a file, see `find_object`, or as it is for a `known` name."""
    if name in known:
        return machine
    own = find_object("--plant", name, dict.fromkeys(known), Plant, "an object with reset and step")
    machine = replace(machine, plant=CheckedPlant(name.rpartition(":")[2], own))
    check_motion(machine)
    return machine


def default_policy(
    machine: Machine, policy: Path | None, gains: Path | None
) -> tuple[Path, Path | None]:
    """Policy, by default the package's; gains, by default gains.json in its folder (or None)."""
    policy = policy or SHIPPED / machine.name / "policy.npz"
    tuned = policy.with_name("gains.json")
    return policy, gains or (tuned if tuned.exists() else None)
