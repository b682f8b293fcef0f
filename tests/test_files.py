"""Files: written and read again; any bytes are read or refused in one line; whole or not at all."""

import errno
import io
import json
import zipfile

import numpy as np
import pytest
from helpers_bus import random_policy
from hypothesis import given
from hypothesis import strategies as st

from brokk_min import _files as files
from brokk_min.learning.policy import KIND, load_policy, save_policy
from brokk_min.machine import BROKK_170

READERS = {
    "x.npz": lambda path: files.load_arrays(path, "policy 8"),
    "x.csv": lambda path: files.numbers(path, "u", files.read_csv(path, "time", "u")["u"]),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A good file of each kind."""
    path = tmp_path_factory.mktemp("files")
    files.save_arrays(path / "x.npz", "policy 8", {"joints": ["q1"]}, w=np.arange(6.0))
    files.write_csv(path / "x.csv", ["run", "time", "u"], [["a", 0.0, 0.25], ["a", 0.05, -1.0]])
    return path


@given(st.sampled_from([*READERS]), st.data())
def test_damaged_bytes__are_refused_in_one_line_or_read(folder, name, data):
    """One cut, or up to three changed bytes, of a good file."""
    READERS[name](folder / name)
    damaged, path = bytearray((folder / name).read_bytes()), folder / f"damaged_{name}"
    if data.draw(st.booleans()):
        del damaged[data.draw(st.integers(0, len(damaged) - 1)) :]
    for _ in range(data.draw(st.integers(0, 3)) if damaged else 0):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(damaged)
    try:
        READERS[name](path)
    except ValueError as error:
        message = str(error)
        assert message.startswith(f"{path}: ") and "expected " in message and ", got " in message
        assert "\n" not in message and len(message) < 300 + len(str(path))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("time,u\n0,1\n1,\n", "row 3, column u: expected a number, got ''"),  # and not -1
        ("time,u\n0,x\n", "row 2, column u: expected a number, got 'x'"),
        ("time,u\n0,1\n1\n", "row 3: expected 2 cells, got 1"),
        ("time,u\n", "expected rows, got none"),
        ("time,v\n0,1\n", "expected columns ['u'], got ['time', 'v']"),
        ("time,u,u\n0,1,2\n", "expected each column once, got again ['u']"),
        ("", "expected a header and rows, got none"),
    ],
)
def test_read_csv__refuses_cells_that_are_missing_or_no_numbers(tmp_path, text, message):
    path = tmp_path / "x.csv"
    path.write_text(text)
    with pytest.raises(ValueError) as caught:
        files.numbers(path, "u", files.read_csv(path, "time", "u")["u"])
    assert str(caught.value) == f"{path}: {message}"


def test_read_csv__takes_tabs_decimal_commas_and_blank_lines_at_the_end(tmp_path):
    path = tmp_path / "x.csv"
    path.write_text("time\tu\n0\t0,5\n1\t-1\n\n")
    np.testing.assert_array_equal(files.numbers(path, "u", files.read_csv(path)["u"]), [0.5, -1])


def test_load_arrays__does_not_advise_to_trust_a_text(tmp_path):
    (tmp_path / "x.npz").write_text("{}")
    with pytest.raises(ValueError, match=r"x.npz: expected an .npz file \(arrays in a zip archive"):
        files.load_arrays(tmp_path / "x.npz", "policy 8")


def test_load_policy__refuses_a_file_without_any_one_of_its_fields(tmp_path):
    """Of its header, of the header of its nets inside, and of its arrays."""
    path = tmp_path / "p.npz"
    save_policy(path, random_policy("paper"))
    assert load_policy(path, BROKK_170).interface == "paper"
    header, arrays = files.load_arrays(path, KIND)
    for place in (header, header["net"], arrays):
        for name in [*place]:
            value = place.pop(name)
            files.save_arrays(path, KIND, header, **arrays)
            with pytest.raises(ValueError, match=r"^\S+p\.npz: expected [^\n]+, got .*" + name):
                load_policy(path, BROKK_170)
            place[name] = value
    for training in (None, {"recipe": None}):
        files.save_arrays(path, KIND, header | {"training": training}, **arrays)
        with pytest.raises(ValueError, match="training: expected its seed and recipe, got"):
            load_policy(path, BROKK_170)


@pytest.mark.parametrize(
    ("name", "array", "message"),
    [
        ("layer_6", np.full((64, 4), np.nan), "layer_6: expected finite numbers"),
        ("layer_6", np.full((64, 4), "0.1"), "layer_6: expected finite numbers"),
        (
            "layer_2",
            np.zeros((255, 128), "f4"),
            "layer_2: expected an array float32 .64, 64., got .*255",
        ),
        ("layer_7", np.zeros(4), "layer_7: expected an array float32 .4,., got float64 .4,."),
        ("output_low", np.zeros(1), "output_low: expected a row for each of 4 joints, got .1,."),
        ("other", np.zeros(2**24), "expected at most 67,108,864 bytes, got 13"),
    ],
)
def test_load_policy__names_the_array_that_is_wrong(tmp_path, name, array, message):
    path = tmp_path / "p.npz"
    save_policy(path, random_policy("paper"))
    header, arrays = files.load_arrays(path, KIND)
    files.save_arrays(path, KIND, header, **arrays | {name: array})
    with pytest.raises(ValueError, match=rf"^\S+p\.npz: {message}"):
        load_policy(path, BROKK_170)


def test_load_arrays__reads_the_header_first(tmp_path):
    """An array that claims 8 EB is not touched in a file of another kind."""
    head = io.BytesIO()
    shape = {"descr": "<f8", "fortran_order": False, "shape": (2**60,)}
    np.lib.format.write_array_header_1_0(head, shape)
    with zipfile.ZipFile(tmp_path / "x.npz", "w") as archive:
        archive.writestr("x.npy", head.getvalue())
    with pytest.raises(ValueError, match=r"expected policy 8 .*, got None"):
        files.load_arrays(tmp_path / "x.npz", "policy 8")
    np.savez(tmp_path / "list.npz", header="[1, 2]")
    with pytest.raises(ValueError, match=r"expected policy 8 .*, got \[1, 2\]"):
        files.load_arrays(tmp_path / "list.npz", "policy 8")


def test_whole_file__keeps_what_another_program_wrote_meanwhile_and_the_new_file_beside(tmp_path):
    path = tmp_path / "y.json"
    files.NEW.add(path)
    path.write_text("theirs")
    with pytest.raises(ValueError, match=r"y\.json: expected no file, as at the start, got one;"):
        files.write_json(path, {"x": 1})
    (ours,) = {*tmp_path.iterdir()} - {path}
    assert path.read_text() == "theirs" and json.loads(ours.read_text()) == {"x": 1}
    path.unlink()
    files.write_json(path, {"x": 2})
    files.write_json(path, {"x": 3})  # its own file


def test_whole_file__leaves_the_old_file_and_no_other_if_writing_fails(tmp_path):
    path = tmp_path / "y.json"
    path.write_text("old")
    with pytest.raises(ValueError, match="JSON"):
        files.write_json(path, {"x": float("nan")})
    with pytest.raises(OSError) as caught, files.whole_file(path):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert (caught.value.errno, caught.value.filename) == (errno.ENOSPC, str(path))
    assert path.read_text() == "old" and [*tmp_path.iterdir()] == [path]
    files.write_json(path, {"x": 0.1})
    assert json.loads(path.read_text()) == {"x": 0.1}
    with pytest.raises(ValueError, match="expected a regular file, got another kind"):
        files.write_json(tmp_path, {})
