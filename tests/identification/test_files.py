"""Files: errors have a place, nothing is half written, and nothing is executed."""

import os
import zipfile

import numpy as np
import pytest

from brokk_min.identification.files import (
    load_arrays,
    parse_json,
    require,
    whole_file,
    write_csv,
    write_json,
)
from brokk_min.identification.formats import NUMBERS, TEXTS, read_table


def test_write_csv__reads_back(tmp_path):
    rows = [["a", 0.1, 1e-17], ["b, c", -2.0, 1 / 3]]
    write_csv(tmp_path / "a.csv", ["name", "x", "y"], rows)
    assert (tmp_path / "a.csv").read_text() == f'name,x,y\na,0.1,1e-17\n"b, c",-2.0,{1 / 3}\n'
    back = read_table(tmp_path / "a.csv", {"name": TEXTS, "x": NUMBERS, "y": NUMBERS})
    assert [list(row) for row in zip(*back.values(), strict=True)] == rows


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, SystemExit])
def test_whole_file__leaves_the_old_file_when_writing_fails(tmp_path, error):
    path = tmp_path / "policy.npz"
    path.write_bytes(b"old")
    with pytest.raises(error), whole_file(path) as file:
        file.write(b"half of the new")
        file.flush()
        assert path.read_bytes() == b"old"
        raise error
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_whole_file__replaces_the_file_at_the_end(tmp_path):
    path = tmp_path / "table.csv"
    path.write_text("old and much longer than the new one")
    with whole_file(path, "w") as file:
        file.write("new\r\n")
        assert path.read_text().startswith("old")
    assert path.read_bytes() == b"new\r\n"
    assert list(tmp_path.iterdir()) == [path]
    assert path.stat().st_mode & 0o777 == 0o644


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("nowhere/log.csv", "nowhere/log.csv: expected an existing directory, got .*/nowhere"),
        ("null", "null: expected a regular file to replace"),
    ],
)
def test_whole_file__refuses_a_missing_folder_and_a_device(tmp_path, name, message):
    (tmp_path / "null").symlink_to("/dev/null")
    with pytest.raises(ValueError, match=f"{tmp_path}/{message}"):
        write_json(tmp_path / name, 1)


def test_whole_file__keeps_links_and_permissions(tmp_path):
    kept = tmp_path / "kept.json"
    kept.touch(0o600)
    (tmp_path / "link").symlink_to(kept)
    write_json(tmp_path / "link", 1)
    assert (tmp_path / "link").is_symlink() and kept.read_text() == "1\n"
    assert kept.stat().st_mode & 0o777 == 0o600


class Bomb:
    def __reduce__(self):
        return os.mkdir, (os.environ["BOMB"],)


def test_load_arrays__executes_nothing(tmp_path, monkeypatch):
    monkeypatch.setenv("BOMB", str(tmp_path / "went off"))
    array = np.empty(1, object)
    array[0] = Bomb()
    np.savez(tmp_path / "bomb.npz", run=array)
    with pytest.raises(ValueError, match=r"bomb\.npz: expected a readable \.npz file"):
        load_arrays(tmp_path / "bomb.npz")
    assert not (tmp_path / "went off").exists()


def test_load_arrays__takes_no_memory_that_the_file_size_does_not_justify(tmp_path):
    path = tmp_path / "bomb.npz"
    np.savez_compressed(path, zeros=np.zeros(2**22))  # 32 MiB in some 30 kB
    with pytest.raises(ValueError, match="33554560 bytes unpacked, more than 16777216"):
        load_arrays(path)
    with zipfile.ZipFile(path, "w") as archive, archive.open("a.npy", "w") as file:
        header = {"descr": "<f8", "fortran_order": False, "shape": (2**40,)}
        np.lib.format.write_array_header_1_0(file, header)  # 8 TiB announced, none there
    with pytest.raises(ValueError, match="expected a readable"):
        load_arrays(path)


@pytest.mark.parametrize("name", ["pipe", "zero", "folder"])
def test_load_arrays__reads_regular_files_only(tmp_path, name):
    os.mkfifo(tmp_path / "pipe.npz")
    (tmp_path / "zero.npz").symlink_to("/dev/zero")
    (tmp_path / "folder.npz").mkdir()
    with pytest.raises(ValueError, match=rf"{name}\.npz: expected a readable, regular file"):
        load_arrays(tmp_path / f"{name}.npz")


def test_parse_json__refuses_deep_and_repeated_content():
    assert parse_json('{"a": [1, 2.5, null]}') == {"a": [1, 2.5, None]}
    for text, message in (
        ("[" * 40 + "]" * 40, "at most 32"),
        ('{"a": 1, "a": 2}', "each key once"),
    ):
        with pytest.raises(ValueError, match=message):
            parse_json(text)


def test_require__names_the_extra_that_brings_a_missing_package():
    assert require("json", "hw").loads("[1]") == [1]
    with pytest.raises(ValueError, match=r"no_such_package: expected the extra brokk_min\[hw\]"):
        require("no_such_package", "hw")
