"""What the fields of each file must be, and the one check that reading goes through.

Sizes are numbers or names; a name stands for the same number in all fields of a file.
"""

from collections.abc import Mapping, MutableMapping
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brokk_min.identification.files import Table, brief, read_csv
from brokk_min.machine import Machine

KINDS: dict[str, tuple[str, tuple[type, ...]]] = {  # type codes of arrays, types of JSON
    "float": ("f", (float, int)),
    "number": ("fiu", (float, int)),
    "whole number": ("iu", (int,)),
    "text": ("U", (str,)),
    "truth value": ("b", (bool,)),
    "object": ("", (dict,)),
}


@dataclass(frozen=True)
class Field:
    """One field of a file: kind, shape, range (of text: its length); numbers must be finite."""

    kind: str  # of `KINDS`
    low: float = -np.inf
    high: float = np.inf
    shape: tuple[int | str, ...] = ()  # of "rows": a column of a table
    unit: str = ""
    unique: bool = False  # no value twice
    required: bool = True
    none: bool = False  # JSON's null is allowed
    among: tuple[str, ...] = ()  # the texts that are allowed

    def wanted(self, sizes: Mapping[str, int]) -> str:
        """The field in words."""
        words = (
            "different " * self.unique + "finite " * (self.kind in ("float", "number")) + self.kind
        )
        if self.kind == "text" and not self.among:
            words += f" of {self.low:g} to {self.high:g} characters"
        elif self.low > -np.inf or self.high < np.inf:
            words += f" in [{self.low:g}, {self.high:g}]"
        words += f" of {self.among}" if self.among else ""
        words += f" ({self.unit})" if self.unit else ""
        shape = [sizes.get(size, size) if isinstance(size, str) else size for size in self.shape]
        return words + f", shape {tuple(shape)}" * (len(shape) > 0) + " or null" * self.none


# `Field`, the fields of an object within, or those of a list of objects; "*": of all other names
Fields = Mapping[str, Any]
NAME = Field("text", 1, 200)
SEED = Field("whole number", 0, 2**63)
SAMPLES = Field("whole number", 2, 1000)

NET_HEADER: Fields = {
    "joints": Field("text", 1, 100, ("n",), unique=True),
    "history": SAMPLES,
    "rate": Field("float", 1e-3, 1e6, unit="Hz"),
    "velocity_samples": SAMPLES,
    "velocity_logged": Field("truth value"),
    "machine": Field("text", 0, 200),
    "seed": SEED,
    "settings": {"*": Field("float", -1e15, 1e15)},
    "dead_zone": Field("float", 0, 0.99, required=False),  # of full command
}
LARGE = 1e6  # of a weight or a statistic: far beyond what a training gives


def _layers(first: tuple[str, ...], *units: int | str) -> dict[str, Field]:
    """Weights and biases from one layer to the next, with a first axis (n,) or none."""
    shapes = [first + ends for pair in pairwise(units) for ends in (pair, pair[1:])]
    return {f"weight_{i}": Field("float", -LARGE, LARGE, s) for i, s in enumerate(shapes)}


NET_ARRAYS: dict[str, Field] = {
    "input_mean": Field("float", -LARGE, LARGE, ("n", "inputs")),
    "input_scale": Field("float", 1e-9, LARGE, ("n", "inputs")),
    "output_low": Field("float", -LARGE, LARGE, ("n",), "rad/s"),
    "output_high": Field("float", -LARGE, LARGE, ("n",), "rad/s"),
    "q_low": Field("float", -LARGE, LARGE, ("n",), "rad"),
    "q_high": Field("float", -LARGE, LARGE, ("n",), "rad"),
    **_layers(("n",), "inputs", "hidden", "hidden", 1),
    "weight_6": Field("float", -LARGE, LARGE, ("n", "2 inputs", "latents"), required=False),
    "weight_7": Field("float", -LARGE, LARGE, ("n", "latents", "hidden"), required=False),
    "weight_8": Field("float", -LARGE, LARGE, ("n", "latents"), required=False),
}
POLICY_HEADER: Fields = {
    "contract": {"paper": Field("truth value", required=False)},  # see `policy.contract`
    "training": Field("object"),
    "valves": Field("text", required=False, among=("closed", "dither", "open")),
}
POLICY_ARRAYS: dict[str, Field] = {
    "mean": Field("float", -LARGE, LARGE, ("obs",)),
    "scale": Field("float", 1e-9, LARGE, ("obs",)),
    **_layers((), "obs", "hidden 1", "hidden 2", "hidden 3", "driven"),
}
LOG: dict[str, Field] = {  # columns, or what their names begin with; q: ten turns, assumed
    "run": Field("text", 1, 200, ("rows",)),
    "time": Field("number", -1e12, 1e12, ("rows",), "s"),
    "u_": Field("number", -1, 1, ("rows",), "of full command, not percent or bytes"),
    "q_": Field("number", -62.8, 62.8, ("rows",), "rad or m, not degrees"),
    "q_dot_": Field("number", -62.8, 62.8, ("rows",), "rad/s or m/s, not degrees/s"),
}
NUMBERS = Field("number", shape=("rows",))  # a column
TEXTS = Field("text", 0, 200, ("rows",))
COMMANDS: dict[str, Field] = {
    "sequence": LOG["run"],
    "time": LOG["time"],
    **dict.fromkeys(("vx", "vy", "vz"), Field("number", -100, 100, ("rows",), "m/s")),
}
META: Fields = {"machine": NAME, "actuator": NAME}
GAINS: Fields = {  # of one controller
    **dict.fromkeys(("kp", "ki", "kd"), Field("float", 0, 1e6, ("driven",))),
    "feedback": Field("float", 0, 1e6, (1,)),
    "min_opening": Field("float", 0, 1, (1,)),
    "integral_feedback": Field("float", 0, 1e6, (1,), required=False),
    "start_boost": Field("float", 0, 1e6, (1,), required=False),
    "start_time": Field("float", 0, 1e6, (1,), required=False),
}
NOT_NEGATIVE = Field("float", 0)
ANY = Field("float", none=True)
MEAN: Fields = {"mean": Field("float"), "low": ANY, "high": ANY}
ROW = dict.fromkeys(("velocity_error_all", "off_axis_drift_max", "valve_travel", "*"), MEAN)
SWEEP: Fields = {"meta": META, "table": {"rl": ROW, "*": ROW}}

NAMED = Field("text", 0, 4096, required=False)
RESULTS: Fields = {  # of `evaluate` and `reproduce`
    "meta": {
        "machine": NAME,
        "seed": SEED,
        **dict.fromkeys(("plant", "commands", "starts", "policy", "gains"), NAMED),
        "noise": Field("number", 0, 1, required=False),
    },
    "starts": Field("number", -62.8, 62.8, ("starts", "n"), "rad", required=False),
}
RUN: Fields = {
    "controller": NAME,
    "sequence": NAME,
    "start": Field("whole number", 0, 1e6),
    "kind": NAME,
    **dict.fromkeys(("velocity_rmse", "velocity_error_mean"), NOT_NEGATIVE),
    **dict.fromkeys(("off_axis_drift_max", "jerk_rms", "valve_travel"), ANY),
}
RUNS: Fields = {"runs": [RUN]}

FAMILY_MEMBER: Fields = {
    "seed": SEED,
    "budget": {"*": Field("number")},
    "free_run": {"*": ANY},
    "error": {"rl": NOT_NEGATIVE, "*": NOT_NEGATIVE},
    "on_nets": {"*": NOT_NEGATIVE},
    "loaded": {"*": NOT_NEGATIVE},
    "best": {"*": Field("text", 1, 100)},
    "dither": Field("float", 0, 0.5),
}


def starts_of(machine: Machine) -> dict[str, Field]:
    """Columns of a file of start poses."""
    return {
        joint.name: Field("number", joint.q_min, joint.q_max, ("rows",), "rad")
        for joint in machine.joints
    }


def check(
    path: Path,
    name: str,
    value: Any,
    field: Field,
    sizes: MutableMapping[str, int],
    cell: str | None = None,
) -> None:
    """ValueError: `value` is not what `field` says, with file, name, wanted and got.

    `sizes` holds the sizes that are known by name; new ones join it. `cell` is the text of the
    first cell of a column that is no finite number.
    """
    if value is None and field.none:
        return
    wanted = field.wanted(sizes)
    array = value if isinstance(value, np.ndarray) else np.array(value, dtype=object)
    codes, types = KINDS[field.kind]
    fits = array.dtype.kind in codes
    if array.dtype == object:
        fits = all(type(x) in types for x in array.flat)
    fits = fits and array.ndim == len(field.shape)
    if fits:
        pairs = zip(field.shape, array.shape, strict=True)
        shape = [sizes.setdefault(k, size) if isinstance(k, str) else k for k, size in pairs]
        fits = array.shape == tuple(shape)
    if not fits:
        got = brief(value) if array.dtype == object else f"{array.dtype}, shape {array.shape}"
        raise ValueError(f"{path}: {name}: expected {wanted}, got {got}")
    if field.kind == "object":
        return
    repeated = field.unique and len(set(array.flat)) < array.size
    if repeated or (field.among and not set(array.flat) <= set(field.among)):
        raise ValueError(f"{path}: {name}: expected {wanted}, got {brief(array.tolist())}")
    if field.kind == "text":
        numbers = np.array([len(x.strip()) for x in array.flat]).reshape(array.shape)
    else:
        numbers = array.astype(float)
    slack = 1e-6 if field.shape == ("rows",) else 0.0  # of rounded columns
    good = np.isfinite(numbers) & (numbers >= field.low - slack) & (numbers <= field.high + slack)
    if good.all():
        return
    at = tuple(int(i) for i in np.argwhere(~good)[0])
    got = brief(array[at]) if field.kind == "text" else f"{numbers[at]:g}"
    got = brief(cell) if cell is not None and not np.isfinite(numbers[at]) else got
    place = f"{name}{list(at) or ''}"
    if field.shape == ("rows",):
        place = f"row {at[0] + 2}, column {name}"
        wanted = replace(field, shape=()).wanted(sizes)
    raise ValueError(f"{path}: {place}: expected {wanted}, got {got}")


def check_fields(
    path: Path, content: Any, fields: Fields, sizes: MutableMapping[str, int], within: str = ""
) -> None:
    """`check` of all fields of an object, also of objects within; others are not looked at."""
    names = [name for name in fields if name != "*"]
    if not isinstance(content, Mapping):
        place = within.removesuffix(".") or "content"
        what = f"names {names}" if names else "an object"
        raise ValueError(f"{path}: {place}: expected {what}, got {brief(content)}")
    others = [name for name in content if name not in fields] if "*" in fields else []
    for name in [*names, *others]:
        field = fields.get(name, fields.get("*"))
        place = f"{within}{name}"
        if isinstance(field, Field):
            if name in content:
                check(path, place, content[name], field, sizes)
            elif field.required:
                raise ValueError(f"{path}: {place}: expected {field.wanted(sizes)}, got none")
        elif isinstance(field, list):
            check(path, place, content.get(name, "none"), Field("object", shape=("rows",)), {})
            for i, row in enumerate(content[name]):
                check_fields(path, row, field[0], sizes, f"{place}[{i}].")
        else:
            check_fields(path, content.get(name), field, sizes, f"{place}.")


def check_columns(path: Path, table: Mapping[str, Any], fields: Mapping[str, Field]) -> None:
    """`check` of columns of a table; ValueError: one is missing."""
    sizes: dict[str, int] = {}
    cells = table.not_finite if isinstance(table, Table) else {}
    for name, field in fields.items():
        if name not in table:
            names = brief(list(table))
            raise ValueError(f"{path}: row 1: expected a column {name}, got {names}")
        check(path, name, table[name], field, sizes, cells.get(name))
    if not sizes["rows"]:
        raise ValueError(f"{path}: expected at least one row, got none")


def read_table(path: Path, columns: Mapping[str, Field]) -> dict[str, NDArray[Any]]:
    """Columns of a CSV by their fields."""
    text = [name for name, field in columns.items() if field.kind == "text"]
    table = read_csv(Path(path), text)
    check_columns(path, table, columns)
    return {name: np.array(table[name]) for name in columns}
