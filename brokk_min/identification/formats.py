"""What the fields of each file must be, and the one check that reading goes through.

Sizes are numbers or names; a name stands for the same number in all fields of a file.
"""

from collections.abc import Mapping, MutableMapping, Sequence
from dataclasses import dataclass, replace
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
NUMBERS = ("float", "number")


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
        words = "different " * self.unique + "finite " * (self.kind in NUMBERS) + self.kind
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
JOINTS = Field("text", 1, 100, ("n",), unique=True)
SAMPLES = Field("whole number", 2, 1000)
DEAD_ZONE = Field("float", 0, 0.99, required=False)  # of full command

NET_HEADER: Fields = {
    "joints": JOINTS,
    "history": SAMPLES,
    "rate": Field("float", 1e-3, 1e6, unit="Hz"),
    "velocity_samples": SAMPLES,
    "velocity_logged": Field("truth value"),
    "machine": Field("text", 0, 200),
    "seed": Field("whole number", 0, 2**63),
    "settings": {"*": Field("float", -1e15, 1e15)},
    "dead_zone": DEAD_ZONE,
}
LARGE = 1e6  # of a weight or a statistic: far beyond what a training gives
NET_ARRAYS: dict[str, Field] = {
    "input_mean": Field("float", -LARGE, LARGE, ("n", "3 history")),
    "input_scale": Field("float", 1e-9, LARGE, ("n", "3 history")),
    "output_low": Field("float", -LARGE, LARGE, ("n",), "rad/s"),
    "output_high": Field("float", -LARGE, LARGE, ("n",), "rad/s"),
    "q_low": Field("float", -LARGE, LARGE, ("n",), "rad"),
    "q_high": Field("float", -LARGE, LARGE, ("n",), "rad"),
    "weight_0": Field("float", -LARGE, LARGE, ("n", "3 history", "hidden")),
    "weight_1": Field("float", -LARGE, LARGE, ("n", "hidden")),
    "weight_2": Field("float", -LARGE, LARGE, ("n", "hidden", "hidden")),
    "weight_3": Field("float", -LARGE, LARGE, ("n", "hidden")),
    "weight_4": Field("float", -LARGE, LARGE, ("n", "hidden", 1)),
    "weight_5": Field("float", -LARGE, LARGE, ("n", 1)),
    "weight_6": Field("float", -LARGE, LARGE, ("n", "6 history", "latents"), required=False),
    "weight_7": Field("float", -LARGE, LARGE, ("n", "latents", "hidden"), required=False),
}
POLICY_HEADER: Fields = {
    "contract": {"paper": Field("truth value", required=False)},  # see `policy.contract`
    "training": Field("object"),
    "valves": Field("text", required=False, among=("closed", "dither", "open")),
}
POLICY_ARRAYS: dict[str, Field] = {
    "mean": Field("float", -LARGE, LARGE, ("obs",)),
    "scale": Field("float", 1e-9, LARGE, ("obs",)),
    "weight_0": Field("float", -LARGE, LARGE, ("obs", "hidden 1")),
    "weight_1": Field("float", -LARGE, LARGE, ("hidden 1",)),
    "weight_2": Field("float", -LARGE, LARGE, ("hidden 1", "hidden 2")),
    "weight_3": Field("float", -LARGE, LARGE, ("hidden 2",)),
    "weight_4": Field("float", -LARGE, LARGE, ("hidden 2", "hidden 3")),
    "weight_5": Field("float", -LARGE, LARGE, ("hidden 3",)),
    "weight_6": Field("float", -LARGE, LARGE, ("hidden 3", "driven")),
    "weight_7": Field("float", -LARGE, LARGE, ("driven",)),
}
LOG: dict[str, Field] = {  # columns, or what their names begin with; q: ten turns, assumed
    "run": Field("text", 1, 200, ("rows",)),
    "time": Field("number", -1e12, 1e12, ("rows",), "s"),
    "u_": Field("number", -1, 1, ("rows",), "of full command, not percent or bytes"),
    "q_": Field("number", -62.8, 62.8, ("rows",), "rad or m, not degrees"),
    "q_dot_": Field("number", -62.8, 62.8, ("rows",), "rad/s or m/s, not degrees/s"),
}
VELOCITY = Field("number", -100, 100, ("rows",), "m/s")
COMMANDS: dict[str, Field] = {
    "sequence": Field("text", 1, 200, ("rows",)),
    "time": Field("number", -1e12, 1e12, ("rows",), "s"),
    "vx": VELOCITY,
    "vy": VELOCITY,
    "vz": VELOCITY,
}
META: Fields = {"machine": Field("text", 1, 200), "actuator": Field("text", 1, 200)}
GAIN = Field("float", 0, 1e6, ("driven",))
GAINS: Fields = {  # of one controller
    "kp": GAIN,
    "ki": GAIN,
    "kd": GAIN,
    "feedback": Field("float", 0, 1e6, (1,)),
    "min_opening": Field("float", 0, 1, (1,)),
    "integral_feedback": Field("float", 0, 1e6, (1,), required=False),
}
MEAN: Fields = {
    "mean": Field("float"),
    "low": Field("float", none=True),
    "high": Field("float", none=True),
}
FIGURES: Fields = {"velocity_error_all": MEAN, "off_axis_drift_max": MEAN, "valve_travel": MEAN}
SWEEP: Fields = {"meta": META, "table": {"rl": {**FIGURES, "*": MEAN}, "*": {**FIGURES, "*": MEAN}}}

NAMED = Field("text", 0, 4096, required=False)
RESULTS: Fields = {  # of `evaluate` and `reproduce`
    "meta": {
        "machine": Field("text", 1, 200),
        "seed": Field("whole number", 0, 2**63),
        **dict.fromkeys(("plant", "commands", "starts", "policy", "gains"), NAMED),
    },
    "starts": Field("number", -62.8, 62.8, ("starts", "n"), "rad", required=False),
}
RUN: Fields = {
    "controller": Field("text", 1, 200),
    "sequence": Field("text", 1, 200),
    "start": Field("whole number", 0, 1e6),
    "kind": Field("text", 1, 200),
    "velocity_rmse": Field("float", 0),
    "velocity_error_mean": Field("float", 0),
    **dict.fromkeys(("off_axis_drift_max", "jerk_rms", "valve_travel"), Field("float", none=True)),
}
RUNS: Fields = {"runs": [RUN]}

FAMILY_MEMBER: Fields = {
    "seed": Field("whole number", 0, 2**63),
    "budget": {"*": Field("number")},
    "free_run": {"*": Field("float", none=True)},
    "error": {"rl": Field("float", 0), "*": Field("float", 0)},
    "on_nets": {"*": Field("float", 0)},
    "loaded": {"*": Field("float", 0)},
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
    same_type = array.dtype.kind in codes
    if array.dtype == object:
        same_type = all(type(x) in types for x in array.flat)
    shape = [sizes.get(s, 0) if isinstance(s, str) else s for s in field.shape]
    if same_type and len(shape) == array.ndim:
        for i, size in enumerate(field.shape):
            shape[i] = sizes.setdefault(size, array.shape[i]) if isinstance(size, str) else size
    if not same_type or array.shape != tuple(shape):
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
    if not isinstance(content, Mapping):
        place = within.removesuffix(".") or "content"
        wanted = [name for name in fields if name != "*"]
        what = f"names {wanted}" if wanted else "an object"
        raise ValueError(f"{path}: {place}: expected {what}, got {brief(content)}")
    others = [name for name in content if name not in fields] if "*" in fields else []
    named = {name: field for name, field in fields.items() if name != "*"}
    for name, field in (named | dict.fromkeys(others, fields.get("*"))).items():
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
            check_fields(path, content.get(name), field or {}, sizes, f"{place}.")


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


def _column(text: bool) -> Field:
    return Field("text", 0, 200, ("rows",)) if text else Field("number", shape=("rows",))


def read_table(
    path: Path, columns: Sequence[str] | Mapping[str, Field], text: Sequence[str] = ()
) -> dict[str, NDArray[Any]]:
    """Columns of a CSV by their fields, or by name: those of `text`, else finite numbers."""
    if not isinstance(columns, Mapping):
        columns = {name: _column(name in text) for name in columns}
    text = [name for name, field in columns.items() if field.kind == "text"]
    table = read_csv(Path(path), text)
    check_columns(path, table, columns)
    return {name: np.array(table[name]) for name in columns}
