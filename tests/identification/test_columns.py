"""Tables of other loggers: names, units and stamps by a mapping, and what is said of the rest."""

import numpy as np
import pytest

from brokk_min.identification.columns import load_table, parse_map
from brokk_min.identification.logs import read_log
from brokk_min.machine import BROKK_170


def theirs(tmp_path, *stamps):
    """With a byte order mark, spaces in the header, and the line ends of Windows."""
    path = tmp_path / "theirs.csv"
    rows = [f"{stamps[k]},7,{10 + k}.0,{(25, -50, 100)[k]},start" for k in range(3)]
    text = "\r\n".join(["\ufeffZeit, Drive, Boom [deg],Lever,Note", *rows, ""])
    path.write_bytes(text.encode())
    return path


@pytest.mark.parametrize(
    ("stamps", "unit"),
    [
        (("1000", "1050", "1100"), ":ms"),
        (("1.7e15", "1.70000000005e15", "1.7000000001e15"), ":us"),
        (("2026-01-02 23:59:59.95+01:00", "2026-01-02T23:00:00", "2026-01-02 23:00:00.05Z"), ""),
    ],
)
def test_load_table__takes_names_units_and_stamps_from_a_mapping(tmp_path, stamps, unit):
    mapped = parse_map(f"boom=Boom [deg]:deg, u_boom=Lever:percent,run=Drive,time=Zeit{unit}")
    table, _ = load_table(theirs(tmp_path, *stamps), mapped)
    assert table["run"].tolist() == ["7"] * 3
    np.testing.assert_allclose(table["time"] - table["time"][0], [0, 0.05, 0.1], atol=1e-9)
    np.testing.assert_allclose(table["q_boom"], np.deg2rad([10, 11, 12]))
    np.testing.assert_allclose(table["u_boom"], [0.25, -0.5, 1.0])


def test_parse_map__has_units_and_factors_of_any_sign():
    mapped = parse_map("arm=Arm:-0.5,u_arm=Spool:permille,q_dot_arm=Rate,q_x=Hub:-mm,time=t:h")
    expected = {"q_arm": ("Arm", -0.5), "u_arm": ("Spool", 0.001), "q_dot_arm": ("Rate", 1.0)}
    assert mapped == expected | {"q_x": ("Hub", -0.001), "time": ("t", 3600)}


@pytest.mark.parametrize(
    "part",
    ["boom", "boom=", "=Boom", "boom=Boom:inch", "boom=Boom:0", "time=Zeit:deg", "u_boom=Stick"],
)
def test_parse_map__refuses_what_is_no_mapping(part):
    """The last one maps a column that another has already."""
    with pytest.raises(ValueError, match=r"^--map: expected NAME=COLUMN or .*, got '" + part):
        parse_map(f"u_boom=Lever,{part}")


@pytest.mark.parametrize(
    ("mapping", "message"),
    [
        ("u_boom=Lever,boom=Stick", r"expected 'Stick' \(--map q_boom=COLUMN:UNIT\)"),
        ("boom=Zeit:deg", r"expected 'u_boom' \(--map u_boom=COLUMN:UNIT\)"),
        ("u_boom=Lever:percent,boom=Note", "row 2, column q_boom: expected a number, got 'start'"),
        ("u_boom=Lever:percent,boom=Zeit,run=Name", r"expected 'Name' \(--map run"),
    ],
)
def test_read_log__says_which_column_and_how_to_map_it(tmp_path, mapping, message):
    path = theirs(tmp_path, 0, 1, 2)
    with pytest.raises(ValueError, match=rf"theirs\.csv: .*{message}"):
        read_log(path, BROKK_170, parse_map("time=Zeit," + mapping))
    path = theirs(tmp_path, "03:04:05", "2026-01-02 03:04", "x")
    with pytest.raises(ValueError, match=r"row 2, column time: expected an ISO stamp, got '03:"):
        read_log(path, BROKK_170, parse_map("time=Zeit,u_boom=Lever,boom=Lever"))


def test_load_table__has_renamed_joints_under_their_new_names_alone(tmp_path):
    rows = {"time": 0.05 * np.arange(3), "u_left": np.zeros(3), "q_left": np.full(3, np.nan)}
    np.savez(tmp_path / "l.npz", **rows | {"q_a": np.ones(3)})
    table, _ = load_table(tmp_path / "l.npz", parse_map("a=q_a,u_a=u_left"))
    assert table.keys() == {"run", "time", "u_a", "q_a"}
    with pytest.raises(ValueError, match="column q_left: expected numbers, got nan in all rows"):
        load_table(tmp_path / "l.npz", {})
    rows |= {"q_left": np.ones(3), "run": np.array(["a"] * 3, object)}  # as pandas has it
    np.savez(tmp_path / "l.npz", **rows)
    with pytest.raises(ValueError, match=r"l.npz: expected columns of numbers or text, got Object"):
        load_table(tmp_path / "l.npz", {})


@pytest.mark.parametrize("run", [np.array([3, 3, 3]), np.array([b"3"] * 3), np.array(3), None])
def test_load_table__takes_numbers_as_names_and_datetimes_as_time(tmp_path, run):
    """A single one is for all rows; a table without `run` is one recording by its file's name."""
    start, tick = np.datetime64("2026-01-02T03:04:05"), np.timedelta64(50, "ms")
    columns = {"time": start + np.arange(3) * tick, "u_a": np.zeros(3), "q_a": [b"0", b"1", b"2"]}
    np.savez(tmp_path / "3.npz", **columns | ({} if run is None else {"run": run}))
    table, _ = load_table(tmp_path / "3.npz", {})
    assert table["run"].tolist() == ["3"] * 3
    np.testing.assert_allclose(table["time"], [0, 0.05, 0.1])
    np.testing.assert_array_equal(table["q_a"], [0, 1, 2])
    np.savez(tmp_path / "d.npz", **columns | {"time": np.arange(3) * tick})  # differences of times
    np.testing.assert_allclose(load_table(tmp_path / "d.npz", {})[0]["time"], [0, 0.05, 0.1])
