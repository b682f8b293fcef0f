"""Files: small tables are read with names for what is wrong, and nothing is ever half written."""

from __future__ import annotations

import pytest

from brokk_min.identification.files import read_table, whole_file, write_csv, write_json

# --- small tables ---------------------------------------------------------------------------------


def test_a_table_of_commands(tmp_path):
    path = tmp_path / "commands.csv"
    path.write_text("sequence,time,vx\nup,0,0.1\nup,2.5,-1e-1\n")
    columns = read_table(path, ["sequence", "time", "vx"], text=["sequence"])
    assert columns["sequence"].tolist() == ["up", "up"]
    assert columns["time"].tolist() == [0, 2.5] and columns["vx"].tolist() == [0.1, -0.1]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("sequence,time\nup,0\n", ["row 1", "a column vx", "['sequence', 'time']"]),
        ("sequence,time,vx\nup,0,fast\n", ["row 2", "column vx", "number", "'fast'"]),
        ("sequence,time,vx\nup,0,1\nup,nan,1\n", ["row 3", "column time", "finite", "nan"]),
        ("sequence,time,vx\nup,0\n", ["row 2", "3 cells", "got 2"]),
    ],
)
def test_a_bad_table_is_refused_by_file_row_and_column(tmp_path, text, words):
    path = tmp_path / "commands.csv"
    path.write_text(text)
    with pytest.raises(ValueError) as caught:
        read_table(path, ["sequence", "time", "vx"], text=["sequence"])
    message = str(caught.value)
    assert message.startswith(f"{path}: ") and all(word in message for word in words), message


# --- whole files ----------------------------------------------------------------------------------


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, SystemExit])
def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(tmp_path, error):
    path = tmp_path / "policy.npz"
    path.write_bytes(b"old")
    with pytest.raises(error), whole_file(path) as file:
        file.write(b"half of the new")
        file.flush()
        assert path.read_bytes() == b"old"
        raise error
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_write_that_ends_replaces_the_file(tmp_path):
    path = tmp_path / "table.csv"
    path.write_text("old and much longer than the new one")
    with whole_file(path, "w") as file:
        file.write("new\r\n")
        assert path.read_text().startswith("old")
    assert path.read_bytes() == b"new\r\n"
    assert list(tmp_path.iterdir()) == [path]
    assert path.stat().st_mode & 0o777 == 0o644


def test_a_folder_that_is_not_there_is_named(tmp_path):
    path = tmp_path / "nowhere" / "log.csv"
    with pytest.raises(ValueError) as caught, whole_file(path):
        pass
    wanted = f"{path}: expected an existing directory, got {path.parent}"
    assert str(caught.value) == wanted


def test_json_has_all_digits_and_no_nan(tmp_path):
    write_json(tmp_path / "a.json", {"b": [0.1]})
    assert (tmp_path / "a.json").read_text() == '{\n "b": [\n  0.1\n ]\n}\n'
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(tmp_path / "a.json", {"b": float("nan")})


def test_a_table_that_is_written_reads_back(tmp_path):
    rows = [["a", 0.1, 1e-17], ["b, c", -2.0, 1 / 3]]
    write_csv(tmp_path / "a.csv", ["name", "x", "y"], rows)
    assert (tmp_path / "a.csv").read_text() == f'name,x,y\na,0.1,1e-17\n"b, c",-2.0,{1 / 3}\n'
    back = read_table(tmp_path / "a.csv", ["name", "x", "y"], text=["name"])
    assert [list(row) for row in zip(*back.values(), strict=True)] == rows
