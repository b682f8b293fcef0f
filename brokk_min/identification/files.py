"""Files, whole or not at all: small tables, JSON, and arrays with a header that says what they are.

A file takes the place of another only once it is complete; one that is not what it should be is refused with
what was expected, where, and what was found.
"""

import csv
import json
import os
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
# a folder a machine: policy and gains of `make reproduce`, start poses
SHIPPED = Path(__file__).parents[1] / "shipped"
Table = dict[str, list[Any]]  # cells by column; row 2 of the file is cell 0


def require(package: str, extra: str) -> Any:
    """Import a package that comes with an extra of pyproject.toml.

    ValueError: it is not installed, with the extra that brings it.
    """
    try:
        return import_module(package)
    except ImportError as error:
        raise ValueError(
            f"{package}: expected the extra brokk_min[{extra}], got {error}"
        ) from error


@contextmanager
def whole_file(path: Path, mode: str = "wb") -> Iterator[IO[Any]]:
    """Open a temporary file beside `path` that replaces it when the block ends without error."""
    path = Path(path)
    if not path.parent.is_dir():
        raise ValueError(f"{path}: expected an existing directory, got {path.parent}")
    newline = None if "b" in mode else ""
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, mode, newline=newline) as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException as error:
        os.unlink(temporary)
        if isinstance(error, OSError) and error.filename is None:
            error.filename = str(path)  # a full disk does not say which file it was
        raise


@contextmanager
def expected(path: Path, what: str) -> Iterator[None]:
    """Whatever goes wrong while the content of `path` is taken apart says that it is not `what`."""
    try:
        yield
    except (AttributeError, IndexError, KeyError, OSError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: expected {what}, got {error!r}") from error


def write_json(path: Path, value: Any) -> None:
    """Write JSON whole, floats as they are."""
    with whole_file(path, "w") as file:
        json.dump(value, file, indent=1, allow_nan=False)
        file.write("\n")


def load_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """All arrays of an `.npz` file; nothing in it is executed.

    ValueError: not there, not an `.npz`, truncated, or holding pickled objects.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except Exception as error:  # zipfile, zlib and NumPy raise anything on damaged files
        raise ValueError(f"{path}: expected a readable .npz file, got {error!r}") from error


def load_header(path: Path, arrays: dict[str, Any], kind: str, version: int) -> dict[str, Any]:
    """The JSON header of a file of ours, checked for kind and format version, without those two."""
    with expected(path, "a file with a JSON header"):
        header = dict(json.loads(str(arrays["header"])))
    got = header.pop("kind", None), header.pop("format", None)
    if got != (kind, version):
        raise ValueError(f"{path}: expected ({kind}, format {version}), got {got}")
    return header


def expect_same(path: Path, found: Mapping[str, Any], wanted: Mapping[str, Any]) -> None:
    """Refuse a file that says other than `wanted` of itself: ValueError, with the first name that differs."""
    for name, value in wanted.items():
        if found.get(name) != value:
            raise ValueError(f"{path}: {name}: expected {value!r}, got {found.get(name)!r}")


# --- tables ----------------------------------------------------------------------------------------


def read_table(
    path: Path, columns: Sequence[str], text: Sequence[str] = ()
) -> dict[str, NDArray[Any]]:
    """Named columns of a small CSV: finite numbers, or text where so named.

    ValueError: with file, row and column of the first thing that is wrong.
    """
    table = read_csv(Path(path))
    return {
        name: np.array(cells_of(path, table, name))
        if name in text
        else numbers_of(path, table, name)
        for name in columns
    }


def write_csv(path: Path, columns: Iterable[str], rows: Iterable[Iterable[Any]]) -> None:
    """Write a header and rows, as `read_csv` reads them."""
    with whole_file(path, "w") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(rows)


def read_csv(path: Path) -> Table:
    """All cells of a CSV with a header, as text; ValueError, with the row, for what is no table."""
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            rows = list(csv.reader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path}: expected a readable CSV table, got {error}") from error
    while rows and not rows[-1]:  # blank lines at the end
        rows.pop()
    if len(rows) < 2:
        raise ValueError(f"{path}: expected a header and at least one row, got {len(rows)} rows")
    header = [name.strip() for name in rows[0]]
    if twice := sorted({name for name in header if header.count(name) > 1}):
        raise ValueError(f"{path}: row 1: expected each column once, got {twice} more than once")
    for number, row in enumerate(rows[1:], 2):
        if len(row) != len(header):
            raise ValueError(f"{path}: row {number}: expected {len(header)} cells, got {len(row)}")
    return dict(zip(header, map(list, zip(*rows[1:], strict=True)), strict=True))


def cells_of(path: Path, table: Table, name: str) -> list[Any]:
    """One column; ValueError where there is none of that name."""
    if name not in table:
        raise ValueError(f"{path}: row 1: expected a column {name}, got {list(table)}")
    return table[name]


def numbers_of(
    path: Path, table: Table, name: str, bound: float = np.inf, unit: str = ""
) -> Floats:
    """One column as finite numbers within +-bound; the first cell that is none is named."""
    cells = cells_of(path, table, name)
    largest = min(bound + 1e-6, np.finfo(float).max)

    def number(cell: Any) -> float:
        try:
            return float(cell)
        except ValueError:
            return np.nan

    try:
        numbers, wanted = np.array(cells, float), "a finite number"
    except ValueError:
        numbers, wanted = np.array([number(cell) for cell in cells]), "a number"
    if not (good := np.abs(numbers) <= largest).all():
        row = int(np.argmin(good))
        limits = "" if bound == np.inf else f" in [-{bound:g}, {bound:g}] ({unit})"
        raise ValueError(
            f"{path}: row {row + 2}, column {name}: expected {wanted}{limits}, got {cells[row]!r}"
        )
    return numbers
