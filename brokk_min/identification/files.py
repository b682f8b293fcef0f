"""Files and optional packages: tables, JSON, arrays with a header.

A new file replaces the old one only once it is complete. A file with other content than expected is
refused with its path, the place, what was expected and what was found.
"""

import csv
import json
import os
import tempfile
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Table = dict[str, Any]  # sequence of cells by column; row 2 of the file is cell 0
# a folder per machine: policy and gains of `make reproduce`, start poses
SHIPPED = Path(__file__).parents[1] / "shipped"
UNPACKED_MIN = 2**24  # bytes that any archive may unpack to
UNPACKED_RATIO = 300  # assumed: no log of ours is compressed further


def require(package: str, extra: str) -> Any:
    """Import a package of an extra of pyproject.toml; ValueError: it is not installed."""
    try:
        return import_module(package)
    except ImportError as error:
        expectation = f"expected the extra brokk_min[{extra}]"
        raise ValueError(f"{package}: {expectation}, got {error}") from error


@contextmanager
def whole_file(path: Path, mode: str = "wb") -> Iterator[IO[Any]]:
    """Open a temporary file that replaces `path` when the block ends without an error."""
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
            error.filename = str(path)  # the error of a full disk has no file name
        raise


@contextmanager
def expected(path: Path, what: str) -> Iterator[None]:
    """Turn any error of the block into a ValueError: the content of `path` is not `what`."""
    try:
        yield
    except (AttributeError, IndexError, KeyError, OSError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: expected {what}, got {error!r}") from error


def write_json(path: Path, value: Any) -> None:
    """Write JSON with all digits; ValueError for nan and inf."""
    with whole_file(path, "w") as file:
        json.dump(value, file, indent=1, allow_nan=False)
        file.write("\n")


def load_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """All arrays of an `.npz` file; nothing in it is executed.

    ValueError: not there, not an `.npz`, damaged, with pickled objects, or compressed so far that
    its size does not justify the memory.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            unpacked = sum(member.file_size for member in archive.infolist())
        allowed = max(UNPACKED_MIN, UNPACKED_RATIO * os.path.getsize(path))
        if unpacked > allowed:
            raise ValueError(f"{unpacked} bytes unpacked, more than {allowed}")
        with np.load(path, allow_pickle=False) as file:
            return {name: np.asarray(file[name]) for name in file.files}
    except Exception as error:  # zipfile, zlib and NumPy raise anything on damaged files
        raise ValueError(f"{path}: expected a readable .npz file, got {error!r}") from error


def load_header(path: Path, arrays: dict[str, Any], kind: str, version: int) -> dict[str, Any]:
    """The JSON header of a file, without `kind` and `format`; ValueError where these differ."""
    with expected(path, "a file with a JSON header"):
        header = dict(json.loads(str(arrays["header"])))
    got = header.pop("kind", None), header.pop("format", None)
    if got != (kind, version):
        raise ValueError(f"{path}: expected ({kind}, format {version}), got {got}")
    return header


def expect_same(path: Path, header: Mapping[str, Any], required: Mapping[str, Any]) -> None:
    """ValueError for the first entry of `header` that is not the required one."""
    for name, value in required.items():
        if header.get(name) != value:
            raise ValueError(f"{path}: {name}: expected {value!r}, got {header.get(name)!r}")


def read_table(
    path: Path, columns: Sequence[str], text: Sequence[str] = ()
) -> dict[str, NDArray[Any]]:
    """Columns of a CSV: those of `text`, else finite numbers; ValueError with the place."""
    table = read_csv(Path(path))
    result: dict[str, NDArray[Any]] = {}
    for name in columns:
        if name in text:
            result[name] = np.array(cells_of(path, table, name))
        else:
            result[name] = numbers_of(path, table, name)
    return result


def write_csv(path: Path, columns: Iterable[str], rows: Iterable[Iterable[Any]]) -> None:
    """Write a header and rows, as `read_csv` reads them."""
    with whole_file(path, "w") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(rows)


def read_csv(path: Path) -> Table:
    """All cells of a CSV with a header, as text; ValueError, with the row, for no such table."""
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
    repeated = sorted({name for name in header if header.count(name) > 1})
    if repeated:
        raise ValueError(f"{path}: row 1: expected each column once, got {repeated} repeatedly")
    for number, row in enumerate(rows[1:], 2):
        if len(row) != len(header):
            raise ValueError(f"{path}: row {number}: expected {len(header)} cells, got {len(row)}")
    return dict(zip(header, zip(*rows[1:], strict=True), strict=True))


def cells_of(path: Path, table: Table, name: str) -> Any:
    """One column; ValueError if it is missing."""
    if name not in table:
        raise ValueError(f"{path}: row 1: expected a column {name}, got {list(table)}")
    return table[name]


def numbers_of(
    path: Path, table: Table, name: str, bound: float = np.inf, unit: str = ""
) -> Floats:
    """One column as finite numbers within +-bound; ValueError with the first other cell."""
    cells = cells_of(path, table, name)
    numbers = np.array([_number(cell) for cell in cells])
    good = np.isfinite(numbers) & (np.abs(numbers) <= bound + 1e-6)
    if not good.all():
        row = int(np.argmin(good))
        limits = "" if bound == np.inf else f" in [-{bound:g}, {bound:g}] ({unit})"
        place = f"{path}: row {row + 2}, column {name}"
        raise ValueError(f"{place}: expected a number, finite{limits}, got {cells[row]!r}")
    return numbers


def _number(cell: Any) -> float:
    try:
        return float(cell)
    except ValueError:
        return np.nan
