"""Files and optional packages: tables, JSON, arrays with a header.

A new file replaces the old one only once it is complete. A file with other content than expected is
refused with its path, the place, what was expected and what was found. Sizes are checked before
anything is read. `formats` says what the fields of a file must be.
"""

import csv
import json
import os
import reprlib
import stat
import tempfile
import zipfile
from array import array
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

Floats = NDArray[np.float64]
# a folder per machine: policy and gains of `make reproduce`, start poses
SHIPPED = Path(__file__).parents[1] / "shipped"
LARGEST = 2**30  # bytes of a table, packed and unpacked: 16 h of each joint of a Brokk at 20 Hz
UNPACKED_MIN = 2**24  # bytes that any archive may unpack to
UNPACKED_RATIO = 150  # assumed: a log of sines is compressed to 1/60
LARGEST_JSON = 2**27  # bytes
LONGEST_LINE = 2**20  # bytes of a CSV
DEEPEST = 32  # levels of JSON
MEMBERS = 4096  # of an archive


def require(package: str, extra: str) -> Any:
    """Import a package of an extra of pyproject.toml; ValueError: it is not installed."""
    try:
        return import_module(package)
    except ImportError as error:
        expectation = f"expected the extra brokk_min[{extra}]"
        raise ValueError(f"{package}: {expectation}, got {error}") from error


# --- writing --------------------------------------------------------------------------------------


@contextmanager
def whole_file(path: Path, mode: str = "wb") -> Iterator[IO[Any]]:
    """Open a temporary file that replaces `path` when the block ends without an error."""
    path = Path(path)
    if not path.parent.is_dir():
        raise ValueError(f"{path}: expected an existing directory, got {path.parent}")
    if path.exists() and not path.is_file():
        raise ValueError(f"{path}: expected a regular file to replace, got another kind")
    newline = None if "b" in mode else ""
    target = path.resolve()  # of a link
    handle, temporary = tempfile.mkstemp(dir=target.parent, prefix=f".{path.name[:100]}.")
    try:
        with os.fdopen(handle, mode, newline=newline) as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, stat.S_IMODE(path.stat().st_mode) if path.exists() else 0o644)
        os.replace(temporary, target)
    except BaseException as error:
        os.unlink(temporary)
        if isinstance(error, OSError) and error.filename is None:
            error.filename = str(path)  # the error of a full disk has no file name
        raise


def write_json(path: Path, value: Any) -> None:
    """Write JSON with all digits; ValueError for nan and inf."""
    with whole_file(path, "w") as file:
        json.dump(value, file, indent=1, allow_nan=False)
        file.write("\n")


def write_csv(path: Path, columns: Iterable[str], rows: Iterable[Iterable[Any]]) -> None:
    """Write a header and rows, as `read_csv` reads them."""
    with whole_file(path, "w") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(rows)


# --- refusals -------------------------------------------------------------------------------------


def brief(value: Any) -> str:
    """A value as text of at most some eighty characters."""
    short = reprlib.Repr()
    short.maxlist = short.maxdict = short.maxtuple = 6
    short.maxstring = short.maxother = 60
    text = reason(value) if isinstance(value, Exception) else short.repr(value)
    text = " ".join(text.split())
    return text if len(text) <= 110 else f"{text[:70]} ... {text[-30:]}"


def reason(error: BaseException) -> str:
    """What went wrong, in words, without the names that Python gives to errors."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror[:1].lower() + error.strerror[1:]
    return f"no entry {error}" if isinstance(error, KeyError) else str(error) or "no reason given"


@contextmanager
def expected(path: Path, what: str) -> Iterator[None]:
    """Turn any error of the block into a ValueError: the content of `path` is not `what`.

    Errors that name `path` already stay as they are.
    """
    try:
        yield
    except Exception as error:  # zipfile, zlib, json and NumPy raise anything on damaged files
        if isinstance(error, ValueError) and str(error).startswith(f"{path}: "):
            raise
        raise ValueError(f"{path}: expected {what}, got {brief(error)}") from error


@contextmanager
def located(*paths: Path) -> Iterator[None]:
    """Put the files in front of a ValueError of the block, unless one of them is there already."""
    try:
        yield
    except ValueError as error:
        if str(error).startswith(tuple(f"{path}: " for path in paths)):
            raise
        more = f" and {len(paths) - 1} more" * (len(paths) > 1)
        raise ValueError(f"{paths[0]}{more}: {error}") from error


def expect_same(path: Path, header: Mapping[str, Any], required: Mapping[str, Any]) -> None:
    """ValueError for the first entry of `header` that is not the required one."""
    for name in required:
        if header.get(name) != required[name]:
            place, wanted, got = _difference(name, required[name], header.get(name))
            raise ValueError(f"{path}: {place}: expected {brief(wanted)}, got {brief(got)}")


def _difference(name: str, wanted: Any, got: Any) -> tuple[str, Any, Any]:
    """Place of the first difference within objects and lists of lists, and both values there."""
    pairs = []
    if isinstance(wanted, Mapping) and isinstance(got, Mapping):
        pairs = [(f"{name}.{key}", wanted.get(key), got.get(key)) for key in {**wanted, **got}]
    elif isinstance(wanted, list) and isinstance(got, list) and len(wanted) == len(got):
        if any(isinstance(value, list) for value in wanted):
            numbered = enumerate(zip(wanted, got, strict=True))
            pairs = [(f"{name}[{i}]", *values) for i, values in numbered]
        elif len(wanted) > 5:
            i = next(i for i, value in enumerate(wanted) if value != got[i])
            return f"{name}[{i}]", wanted[i], got[i]
    for pair in pairs:
        if pair[1] != pair[2]:
            return _difference(*pair)
    return name, wanted, got


# --- reading --------------------------------------------------------------------------------------


@contextmanager
def open_regular(path: Path, largest: int = LARGEST) -> Iterator[IO[bytes]]:
    """A file to be read; ValueError: it is no regular file, or larger than `largest` bytes."""
    status = os.stat(path)
    if not stat.S_ISREG(status.st_mode):  # before it is opened: opening a pipe may wait
        raise ValueError(f"{path}: expected a readable, regular file, got another kind")
    if status.st_size > largest:
        raise ValueError(f"{path}: expected at most {largest} bytes, got {status.st_size}")
    with open(path, "rb") as file:
        yield file


def parse_json(text: str | bytes) -> Any:
    """JSON with each key once, at most 32 levels deep; ValueError: another text."""

    def whole(number: str) -> float:
        """A whole number, as a float if it has too many digits for 64 bits."""
        return int(number) if len(number) < 19 else float(number)

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        """An object; ValueError: a key twice."""
        keys = [key for key, _ in pairs]
        if len(set(keys)) < len(keys):
            raise ValueError(f"expected each key once, got {brief(keys)}")
        return dict(pairs)

    value = json.loads(text, object_pairs_hook=unique, parse_int=whole)
    level = [value]
    for _ in range(DEEPEST):
        members = (v.values() if isinstance(v, dict) else v for v in level)
        level = [x for values in members for x in values if isinstance(x, dict | list)]
        if not level:
            return value
    raise ValueError(f"expected at most {DEEPEST} levels, got more")


def read_json(path: Path, what: str) -> Any:
    """The content of a JSON file, see `parse_json`; ValueError: it is not `what`."""
    with expected(path, what), open_regular(path, LARGEST_JSON) as file:
        return parse_json(file.read(LARGEST_JSON))


def load_arrays(path: Path, largest: int = LARGEST) -> dict[str, NDArray[Any]]:
    """All arrays of an `.npz` file; nothing in it is executed.

    ValueError: not there, not an `.npz`, damaged, with pickled objects, or compressed so far that
    its size does not justify the memory; the sizes are checked before any array is read.
    """
    with (
        expected(path, "a readable .npz file"),
        open_regular(path, largest) as file,
        zipfile.ZipFile(file) as archive,
    ):
        members = archive.infolist()
        arrays = [member.filename.removesuffix(".npy") for member in members]
        if len(members) > MEMBERS or len(set(arrays)) < len(arrays):
            raise ValueError(f"{len(members)} members, some of the same name or too many")
        unpacked = sum(member.file_size for member in members)
        allowed = min(largest, max(UNPACKED_MIN, UNPACKED_RATIO * os.path.getsize(path)))
        if unpacked > allowed:
            raise ValueError(f"{unpacked} bytes unpacked, more than {allowed}")
        result = {}
        for name, member in zip(arrays, members, strict=True):
            what = f"a readable .npz file with an array of numbers or text in {brief(name)}"
            with expected(path, what), archive.open(member) as content:
                result[name] = npy.read_array(content, allow_pickle=False)
        return result


def load_header(path: Path, arrays: dict[str, Any], kind: str, version: int) -> dict[str, Any]:
    """The JSON header of a file, without `kind` and `format`; ValueError where these differ."""
    if "header" not in arrays:
        raise ValueError(f"{path}: header: expected that of a {kind}, got none")
    with expected(path, "a file with a JSON header"):
        header = dict(parse_json(str(arrays["header"])))
    got = header.pop("kind", None), header.pop("format", None)
    if got != (kind, version):
        raise ValueError(f"{path}: expected ({kind}, format {version}), got {brief(got)}")
    return header


class Table(dict[str, Any]):
    """Columns of a CSV by name: lists of text, arrays of numbers with nan for other cells."""

    def __init__(self) -> None:
        self.not_finite: dict[str, str] = {}  # first cell of a column that is no finite number


def read_csv(path: Path, text: Sequence[str] = ()) -> Table:
    """A CSV with a header; the columns `text` stay text; ValueError, with the row, for others."""
    with expected(path, "a readable CSV table"), open_regular(path) as file:
        reader = csv.reader(_lines(path, file), strict=True)
        header = [name.strip() for name in next(reader, [])]
        if len(header) == 1 and set(";\t#") & set(header[0]):
            wanted = "expected names of columns with commas between them, numbers with points"
            raise ValueError(f"{path}: row 1: {wanted}, got {brief(header[0])}")
        repeated = sorted({name for name in header if header.count(name) > 1})
        if repeated:
            raise ValueError(f"{path}: row 1: expected each column once, got {brief(repeated)}")
        known: dict[str, str] = {}  # the same text of many rows is kept once
        columns: list[Any] = [[] if name in text else array("d") for name in header]
        table = Table()
        blank = 0  # row of the first blank line: after it there must be others only
        for number, row in enumerate(reader, 2):
            blank = blank or number * (not row)
            if row and (blank or len(row) != len(header)):
                got = f"row {blank or number}: expected {len(header)} cells, got"
                raise ValueError(f"{path}: {got} {0 if blank else len(row)}")
            for name, column, cell in zip(header, columns, row):
                column.append(known.setdefault(cell, cell) if name in text else _number(cell))
                if name not in text and not abs(column[-1]) < np.inf:
                    table.not_finite.setdefault(name, cell)
        if not columns or not len(columns[0]):
            raise ValueError(f"{path}: expected a header and at least one row, got 0 rows")
    for name, column in zip(header, columns, strict=True):
        table[name] = column if name in text else np.frombuffer(column)
    return table


def _lines(path: Path, file: IO[bytes]) -> Iterator[str]:
    """Lines of a CSV; ValueError: an endless one, or a last one that does not end."""
    line = b"\n"
    for number, line in enumerate(iter(lambda: file.readline(LONGEST_LINE), b""), 1):
        if len(line) == LONGEST_LINE:
            raise ValueError(f"{path}: row {number}: expected shorter lines, got {len(line)} bytes")
        yield line.decode("utf-8-sig" if number == 1 else "utf-8")
    if not line.endswith(b"\n"):
        got = brief(line[-30:].decode(errors="replace"))
        raise ValueError(f"{path}: expected a newline at its end, got a cut row: {got}")


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return np.nan
