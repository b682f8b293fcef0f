"""Files of the project: whole or not at all, and never executed.

Arrays with a JSON header (`.npz`), JSON, CSV. A new file replaces the old one only once it is
complete. What a file should hold and does not is a ValueError of one line: file, wanted, got.
"""

import csv
import hashlib
import json
import os
import shutil
import subprocess
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from importlib import import_module, metadata
from pathlib import Path
from types import ModuleType
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from brokk_min.machine import require

LARGEST = 2**26  # bytes of the arrays of a policy or net, assumed; ours have a few MB
NEW: set[Path] = set()  # files of the running command that must not be there before it writes them
# a folder for each machine: policies, gains, starts and table of `make reproduce`
SHIPPED = Path(__file__).parent / "shipped"


def require_package(package: str, extra: str) -> Any:
    """Import a package of an extra of pyproject.toml; ValueError: how to install it."""
    try:
        return import_module(package)
    except ImportError as error:
        wanted = f"pip install -c constraints.txt -e '.[{extra}]'"
        raise ValueError(f"{package}: expected {wanted}, got {error}") from error


def digest(path: Path) -> str:
    """The first 16 digits of the SHA-256 of a file, by which tables name the files they scored."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def constants(*modules: ModuleType) -> dict[str, dict[str, float]]:
    """The numbers that modules name in capitals; what was made with others is refused by name."""
    return {
        module.__name__: {
            name: value
            for name, value in vars(module).items()
            if name.isupper() and isinstance(value, (int, float))
        }
        for module in modules
    }


def made_with() -> dict[str, str | None]:
    """Versions of the package, torch and NumPy, and the commit of a clone; None: there is none."""
    versions: dict[str, str | None] = {}
    for package in ("brokk_min", "torch", "numpy"):
        versions[package] = None
        with suppress(metadata.PackageNotFoundError):
            versions[package] = metadata.version(package)
    root = Path(__file__).parents[1]
    call = ["git", "-C", str(root), "describe", "--always", "--dirty", "--exclude=*"]
    with suppress(OSError):  # without git
        if (root / ".git").exists():
            told = subprocess.run(call, capture_output=True, text=True, check=False).stdout
            return versions | {"commit": told.strip() or None}
    return versions | {"commit": None}


@contextmanager
def named(path: Path) -> Iterator[None]:
    """Give the name of a file to the OSErrors of writing it, as of a full disk."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error


@contextmanager
def whole_file(path: Path, mode: str = "wb") -> Iterator[IO[Any]]:
    """A temporary file, text in UTF-8, that replaces `path` if the block ends without an error.

    It has the mode of the file that it replaces. ValueError: `path` is a folder or a device, or is
    in `NEW` and another program has written it meanwhile; then ours lies beside it.
    """
    path = Path(path)
    require(path.is_file() or not path.exists(), str(path), "a regular file", "another kind")
    target = path.resolve()  # of a link
    temporary = target.with_name(f".{target.name[:100]}.{os.getpid()}")
    try:
        with named(path):
            with open(temporary, mode, encoding=None if "b" in mode else "utf-8") as file:
                with suppress(OSError):  # no file is there yet, or a disk without modes
                    shutil.copymode(target, temporary)
                yield file
            if target in NEW and target.exists():
                ours = target.with_name(f"{target.stem}-{os.getpid()}{target.suffix}")
                os.replace(temporary, ours)
                require(False, str(path), "no file, as at the start", f"one; the new one is {ours}")
            os.replace(temporary, target)
            NEW.discard(target)
    finally:
        with suppress(OSError):
            temporary.unlink()


def write_json(path: Path, value: Any) -> None:
    """Write JSON with all digits; ValueError for nan and inf."""
    with expected(path, "finite numbers to write"), whole_file(path, "w") as file:
        json.dump(value, file, indent=1, allow_nan=False)
        file.write("\n")


def write_csv(path: Path, columns: Iterable[str], rows: Iterable[Iterable[Any]]) -> None:
    """Write a header and rows, as `read_csv` reads them."""
    with whole_file(path, "w") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(rows)


def brief(value: Any, longest: int = 110) -> str:
    """A value, or what an error says, as text of one line, without the middle of a long one."""
    if isinstance(value, OSError) and value.strerror:
        place = f"{value.filename}: " if value.filename else ""
        return f"{place}{value.strerror.lower()}"
    text = str(value) if isinstance(value, Exception) and str(value) else repr(value)
    text = " ".join(text.split())
    return text if len(text) <= longest else f"{text[:70]} ... {text[-30:]}"


@contextmanager
def expected(path: Path, what: str) -> Iterator[None]:
    """Turn any error of the block into a ValueError: `path` is not `what`.

    An OSError that names its file stays as it is. An error that says what was expected only gets
    `path` in front of it.
    """
    try:
        yield
    except (Exception, SystemExit) as error:  # zlib, NumPy, a user's file: they raise anything
        if isinstance(error, OSError) and error.filename:
            raise
        told = str(error) if ": expected " in str(error) else f"expected {what}, got {brief(error)}"
        raise ValueError(f"{path}: {told.removeprefix(f'{path}: ')}") from error


def expect_same(place: Path | str, found: Mapping[str, Any], wanted: Mapping[str, Any]) -> None:
    """ValueError for the first entry of `wanted`, also within an entry, that `found` has not."""
    for name, value in wanted.items():
        got = found.get(name)
        if isinstance(value, dict) and isinstance(got, dict):
            expect_same(f"{place}: {name}", got, value)
        if isinstance(value, list) and isinstance(got, list) and len(got) == len(value):
            expect_same(
                f"{place}: {name}", *({str(i): x for i, x in enumerate(of)} for of in (got, value))
            )
        require(got == value, f"{place}: {name}", brief(value), brief(got))


def read_csv(path: Path, *columns: str) -> dict[str, NDArray[np.str_]]:
    """The cells of a CSV by column, see `numbers`; ValueError: no such columns, or a short row.

    Where semicolons or tabs separate the cells, commas are those of decimals.
    """
    with expected(path, "a CSV table"):
        with open(path, newline="", encoding="utf-8-sig") as file:
            first = file.readline()
            require(bool(first.strip()), str(path), "a header and rows", "none")
            delimiter = next((mark for mark in ";\t" if mark in first), ",")
            file.seek(0)
            header, *rows = csv.reader(file, delimiter=delimiter, strict=True)
        while rows and not rows[-1]:  # blank lines at the end
            rows.pop()
        if delimiter != ",":
            rows = [[cell.replace(",", ".") for cell in row] for row in rows]
        names = [name.strip() for name in header]
        twice = [name for i, name in enumerate(names) if name and name in names[:i]]
        require(not twice, str(path), "each column once", f"again {brief(twice)}")
        missing = [name for name in columns if name not in names]
        require(not missing, str(path), f"columns {missing}", brief(names))
        require(len(rows) > 0, str(path), "rows", "none")
        for i, row in enumerate(rows, 2):
            require(len(row) == len(names), f"{path}: row {i}", f"{len(names)} cells", len(row))
        return {name: np.array(cells) for name, cells in zip(names, zip(*rows))}


def numbers(
    path: Path,
    name: str,
    cells: Iterable[str],
    number_of: Callable[[str], Any] = float,
    what: str = "a number",
) -> NDArray[Any]:
    """Cells of a column as numbers; ValueError: the row of one that is not `what` it should be."""
    result = []
    for row, cell in enumerate(cells, 2):
        try:
            result.append(number_of(str(cell)))
        except ValueError:
            place = f"{path}: row {row}, column {name}"
            raise ValueError(f"{place}: expected {what}, got {brief(str(cell))}") from None
    return np.array(result)


def save_arrays(path: Path, kind: str, header: Mapping[str, Any], **arrays: Any) -> None:
    """Write arrays and a JSON header as one `.npz`; `kind` says what it is, as "policy 8"."""
    text = np.array(json.dumps({"kind": kind, **header}))
    with whole_file(path) as file:
        np.savez_compressed(file, header=text, **arrays)


def open_npz(path: Path) -> Any:
    """An `.npz`, from which nothing is executed; ValueError: none, or a part of one."""
    zipped = zipfile.is_zipfile(path) or not Path(path).is_file()
    require(zipped, str(path), "an .npz file (arrays in a zip archive)", "none, or a part of one")
    return np.load(path, allow_pickle=False)


def load_arrays(path: Path, kind: str) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Header and arrays of an `.npz`; nothing in it is executed.

    The header is read first, and the arrays if they are those of this `kind`. ValueError: no
    readable `.npz`, another kind, unpacked too large, or an array of anything but finite numbers.
    """
    with expected(path, "a readable .npz file"), open_npz(path) as archive:
        size = sum(entry.file_size for entry in archive.zip.infolist())
        require(size <= LARGEST, str(path), f"at most {LARGEST:,} bytes", f"{size:,}")
        header = json.loads(str(archive["header"])) if "header" in archive else {}
        wanted = f"{kind} (if it is older: train or fit again)"
        got = header.pop("kind", None) if isinstance(header, dict) else header
        require(got == kind, str(path), wanted, brief(got))
        arrays = {name: archive[name] for name in archive if name != "header"}
        for name, array in arrays.items():
            numbers = array.dtype.kind in "fiu" and np.isfinite(array)
            require(bool(np.all(numbers)), f"{path}: {name}", "finite numbers", brief(array))
        return header, arrays
