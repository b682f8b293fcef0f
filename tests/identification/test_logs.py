"""Logs: what is written reads back, any rate becomes the machine's, and errors have a place."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brokk_min.fit import Log, Recording, velocity_of
from brokk_min.identification import logs
from brokk_min.identification.logs import read_log
from brokk_min.machine import BROKK_170


def read_columns(folder, columns, machine=BROKK_170):
    """A table `.npz` written without the package."""
    np.savez(folder / "log.npz", **columns)
    return read_log(folder / "log.npz", machine)


@pytest.mark.parametrize(("suffix", "rate", "atol"), [(".csv", 25.0, 2e-6), (".npz", 20.0, 1e-12)])
def test_write_log__reads_back(tmp_path, suffix, rate, atol):
    rng = np.random.default_rng(5)
    recordings = []
    for i, length in enumerate((30, 1, 7)):
        u, q = rng.uniform(-1, 1, (length, 3)), rng.uniform(0.05, 0.06, (length, 3)).cumsum(axis=0)
        recordings.append(Recording(f"run {i} wet", u, q, velocity_of(q, 4, rate)))
    log = Log(("boom", "stick", "q_dot_like"), tuple(recordings), rate)
    logs.write_log(tmp_path / f"log{suffix}", log)
    again = read_log(tmp_path / f"log{suffix}", replace(BROKK_170, rate=rate))
    assert (again.joints, again.rate) == (log.joints, rate)
    for (name, *got), (wanted, *written) in zip(again.recordings, recordings, strict=True):
        assert name == wanted
        for array, other, noise in zip(got, written, (1, 1, 40), strict=True):  # u, q, q_dot
            np.testing.assert_allclose(array, other, atol=noise * atol)


@given(
    st.lists(st.floats(0.51, 1.0), min_size=2, max_size=60),
    st.integers(0, 2**16),
    st.sampled_from([0.0, 7.0, 1.7e9]),
    st.sampled_from([20.0, 25.0]),
)
def test_read_log__resamples_as_a_loop_does(tmp_path_factory, steps, seed, start, rate):
    """From any start of the clock, with the mean of ten commands in a tick.

    Stamps close to a tenth of a tick may go either way: they are moved.
    """
    ticks = np.cumsum([0, *steps])
    close = np.abs(10 * ticks - np.rint(10 * ticks)) < 0.01
    ticks[1:] += 0.002 * close[1:]
    time = start + ticks / rate
    rng = np.random.default_rng(seed)
    columns = {"run": np.repeat("x", len(time)), "time": time, "u_a": rng.uniform(-1, 1, len(time))}
    columns["q_a"] = np.sin(rng.uniform(0.02, 0.1) * np.arange(len(time)) + rng.uniform(0, 6))
    machine, folder = replace(BROKK_170, rate=rate), tmp_path_factory.getbasetemp()
    (recording,) = read_columns(folder, columns, machine).recordings
    u, q = [], []
    for now in start + np.arange(int(ticks[-1]) + 1) / rate:
        held = [np.flatnonzero(time <= now + k / (10 * rate) + 1e-9)[-1] for k in range(10)]
        u.append(columns["u_a"][held].mean())
        last, following = held[0], min(held[0] + 1, len(time) - 1)
        fraction = (now - time[last]) / ((time[following] - time[last]) or 1.0)
        q.append(columns["q_a"][last] + fraction * np.diff(columns["q_a"][[last, following]])[0])
    np.testing.assert_allclose(recording.u[:, 0], u, atol=1e-12)
    np.testing.assert_allclose(recording.q[:, 0], q, atol=1e-5 if start > 1e9 else 1e-9)


def test_read_log__cuts_a_recording_at_gaps_and_assumes_no_rest_after_them(tmp_path):
    time = np.arange(90) / 20
    time[30:] += 0.15  # 0.2 s between samples: bridged
    time[60:] += 0.25  # 0.3 s: cut
    time[86:] += 0.25  # too few samples follow
    columns = {"run": np.repeat("x", 90), "time": time, "u_a": np.arange(90) / 90}
    columns |= {"q_a": 0.3 * time, "q_dot_a": np.full(90, 9.0)}  # nobody reads the last one
    machine = replace(BROKK_170, velocity_samples=7)
    first, second = read_columns(tmp_path, columns, machine).recordings
    assert first.name == "x" and second.name == "x#2"
    assert len(first.q) == len(first.q_dot) == 60 + 3
    np.testing.assert_allclose(first.u[29:33, 0], 29 / 90)  # held over the gap
    np.testing.assert_allclose(second.q[:, 0], 0.3 * time[66:86], atol=1e-9)
    np.testing.assert_allclose(second.q_dot, 0.3, atol=1e-9)
    np.testing.assert_allclose(second.u[:, 0], columns["u_a"][66:86])
    assert first.q_dot[0, 0] == 0.0  # at rest before a recording
    (told,) = read_columns(tmp_path, columns, machine).warnings
    assert "within 0.25 s of the one before, got 2 gaps, the first after 3.1 s of x" in told


def test_join_logs__joins_files_of_the_same_joints_only():
    x, z = (Recording(name, *np.random.default_rng(0).uniform(-1, 1, (3, 5, 2))) for name in "xz")
    files = {Path("1"): Log(("a", "b"), (x,)), Path("2"): Log(("b", "a"), (z,), warnings=("row",))}
    log = logs.join_logs(files)
    assert log.joints == ("a", "b") and [one.name for one in log.recordings] == ["x", "z"]
    np.testing.assert_array_equal(log.recordings[1][1:], np.flip(z[1:], axis=-1))
    assert log.warnings == ("row",)
    log = logs.join_logs(files | {Path("4"): Log(("a", "b"), (x,))})
    assert [one.name for one in log.recordings] == ["1: x", "z", "4: x"]
    with pytest.raises(ValueError, match=r"^3: joints: expected \['a', 'b'\], got \['a', 'c'\]"):
        logs.join_logs(files | {Path("3"): Log(("a", "c"), (x,))})


def swinging(rate=20.0, seconds=20.0):
    """Two joints of at most 0.5 and 0.2 rad/s, with counts of 14 bits; the second one is parked."""
    time = np.arange(round(seconds * rate)) / rate
    q = np.stack([0.9 + 0.5 * np.sin(time), np.full(len(time), -0.4)])
    step = 2 * np.pi / 2**14
    noise = np.random.default_rng(0).integers(-1, 2, q.shape)
    q = (np.rint(q / step) + noise) * step
    columns = {"run": np.repeat("x", len(time)), "time": time, "u_a": np.cos(time)}
    return columns | {"u_b": 0 * time, "q_a": q[0], "q_b": q[1]}


def of_speeds(a, b):
    """A machine with joints "a" and "b" of these nominal speeds [rad/s]."""
    one, two, *_ = BROKK_170.joints
    one = replace(one, name="a", q_dot_up=a, q_dot_down=a)
    two = replace(two, name="b", q_dot_up=b, q_dot_down=b)
    return replace(BROKK_170, joints=(one, two), q_start=())


def speed_of(log):
    return np.abs(np.concatenate([one.q_dot for one in log.recordings])).max(axis=0)


@pytest.mark.parametrize("wrong", [0.0, -1.0, 9999.0])
@pytest.mark.parametrize("machine", [BROKK_170, of_speeds(0.5, 0.2), of_speeds(0.05, 0.02)])
def test_read_log__leaves_out_readings_that_no_motion_explains(tmp_path, wrong, machine):
    """Single ones, two in a row, the first and the last one, of a moving and of a parked joint.

    With the machine's speeds, without, and with speeds that are guessed ten times too low.
    """
    columns = swinging()
    sound = read_columns(tmp_path, columns, machine)
    assert sound.warnings == () and len(sound.recordings) == 1
    columns["q_a"][[0, 40, 150, 151]] = columns["q_b"][[60, 399]] = wrong
    log = read_columns(tmp_path, columns, machine)
    assert len(log.recordings) == 1  # the gaps are short
    np.testing.assert_allclose(log.recordings[0].q, sound.recordings[0].q[1:-1], atol=5e-3)
    np.testing.assert_allclose(log.recordings[0].u, sound.recordings[0].u[1:-1], atol=1e-12)
    assert (speed_of(log) < speed_of(sound) + 0.05).all()
    assert len(log.warnings) == 2
    told = f"log.npz: row 2: expected motion of q_a, got a jump to {wrong:.4g} (was the "
    assert told in log.warnings[0] and " in 4 rows, which are left out" in log.warnings[0]
    assert "log.npz: row 62: expected motion of q_b" in log.warnings[1]
    columns["q_a"][:], columns["q_b"][:3] = columns["q_b"], np.nan
    columns["q_a"][:3] = np.nan
    told = (
        "log.npz: row 2: expected motion of q_a, q_b, got a jump to nan (was the sensor not read?)"
    )
    assert read_columns(tmp_path, columns, machine).warnings[0].startswith(str(tmp_path / told))


def test_read_log__keeps_the_readings_of_a_noisy_sensor(tmp_path):
    """A potentiometer, whose noise of 0.01 rad is several rad/s from row to row at 100 Hz."""
    columns = swinging(rate=100.0, seconds=100.0)
    noise = np.random.default_rng(1).normal(0, 0.01, (2, len(columns["time"])))
    columns |= {"q_a": columns["q_a"] + noise[0], "q_b": columns["q_b"] + noise[1]}
    assert read_columns(tmp_path, columns).warnings == ()


def test_read_log__knows_an_angle_that_a_parked_joint_keeps_between_two_unread_ones(tmp_path):
    columns = swinging()
    columns["q_b"][50::40] = 0.0
    columns["q_b"][91:130] = -0.4  # exactly, not with noise
    (told,) = read_columns(tmp_path, columns).warnings
    assert "row 52: expected motion of q_b, got a jump to 0 (" in told and " in 9 rows, " in told


@pytest.mark.parametrize(("scale", "unit"), [(180 / np.pi, "deg"), (1e3, "mrad"), (1e6, "UNIT")])
def test_read_log__guesses_the_unit_of_angles(tmp_path, scale, unit):
    columns = swinging()
    columns["q_a"] *= scale
    with pytest.raises(ValueError, match=rf"another unit \(--map .*, or a=COLUMN:{unit}\)\?"):
        read_columns(tmp_path, columns)


@pytest.mark.parametrize(("unit", "of"), [("ms", 1e3), ("ns", 1e9)])
def test_read_log__knows_the_unit_of_time_since_1970(tmp_path, unit, of):
    columns = swinging()
    columns["time"] = of * (1.7e9 + columns["time"])
    with pytest.raises(ValueError, match=rf"\(if in {unit}: --map time=COLUMN:{unit}\)"):
        read_columns(tmp_path, columns)


@pytest.mark.parametrize("change", [0.6, -2 * np.pi])
def test_read_log__cuts_where_the_zero_of_an_angle_changes(tmp_path, change):
    columns = swinging()
    columns["q_a"][200:] += change
    log = read_columns(tmp_path, columns)
    assert [len(one.q) for one in log.recordings] == [200, 200 - 3]
    assert "row 202: expected motion of q_a" in log.warnings[0]
    assert ("by a turn: unwrap it" in log.warnings[0]) == (change != 0.6)
    assert (speed_of(log) < 0.6).all()


@pytest.mark.parametrize("every", [2, 3, 4, 5])
def test_read_log__refuses_a_sensor_that_is_slower_than_the_rows(tmp_path, every):
    """Only the moving joint's values repeat; a parked joint repeats its value anyway."""
    columns = swinging()
    columns["q_a"] = columns["q_a"][np.arange(400) // every * every]
    wanted, got = "expected new angles at the machine's 20 Hz or more", f"got {20 / every:.3g} Hz"
    with pytest.raises(ValueError, match=rf"q of \['a'\], one every {every} rows: {wanted}, {got}"):
        read_columns(tmp_path, columns)
    fast = swinging(rate=20.0 * every)
    fast["q_a"] = fast["q_a"][np.arange(len(fast["time"])) // every * every]
    log = read_columns(tmp_path, fast)  # 20 Hz are enough
    assert log.warnings == () and (speed_of(log) < 0.6).all()


GOOD = """run,time,u_a,q_a
x,0.00,0.1,1.0
x,0.05,0.2,1.1
x,0.10,0.3,1.2
x,0.15,0.4,1.3
"""
SECOND_EARLIER = "run,time,u_a,q_a\nx,1.00,0,0\ny,7.00,0,0\nx,1.05,0,0\ny,7.05,0,0\nx,1.02,0,0\n"


def test_read_log__takes_semicolons_with_decimal_commas(tmp_path):
    (tmp_path / "a.csv").write_text(GOOD)
    (tmp_path / "b.csv").write_text(GOOD.replace(",", ";").replace(".", ","))
    one, other = (read_log(tmp_path / name, BROKK_170) for name in ("a.csv", "b.csv"))
    np.testing.assert_equal(one.recordings, other.recordings)
    (tmp_path / "c.csv").write_text(GOOD.replace("1.2", ""))  # as pandas writes nan
    (told,) = read_log(tmp_path / "c.csv", BROKK_170).warnings
    assert "row 4: expected motion of q_a, got a jump to nan" in told


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (GOOD.replace(",", "|"), "columns: expected u_<joint> (--map u_NAME=COLUMN:UNIT), got "),
        ("run,u_a,q_a\nx,0,0\n", "columns: expected 'time' (--map time=COLUMN:UNIT), got ['run'"),
        (
            GOOD.replace("0.3", "30"),
            "row 4, column u_a: expected -1 to 1 (another unit? --map u_a=COLUMN:percent or :0.0",
        ),
        (
            GOOD.replace("0.3", "3"),
            "row 4, column u_a: expected -1 to 1 (another unit? --map u_a=CO",
        ),
        (GOOD.replace("0.3", "nan"), "row 4, column u_a: expected -1 to 1, got nan"),
        (GOOD.replace("0.10", "0.05"), "run x, column time: expected stamps that rise, got a step"),
        (SECOND_EARLIER, "run x, column time: expected stamps that rise, got a step of -0.03 at 1"),
        (
            "run,time,u_a,q_a\nx,0,0,0\nx,50,0,0\n",
            "run x, column time: expected new angles at the machine's 20 Hz or more (if in ms: --",
        ),
        (
            "run,time,u_a,q_a\n" + "".join(f"x,{i / 20},0,{0.2 * i % 6.283}\n" for i in range(120)),
            "run x, q_a: expected an angle that goes on beyond a turn, got 3 jumps by a turn",
        ),
    ],
)
def test_read_log__names_file_and_place_of_what_is_wrong(tmp_path, text, message):
    (tmp_path / "bad.csv").write_text(text)
    with pytest.raises(ValueError) as caught:
        read_log(tmp_path / "bad.csv", BROKK_170)
    assert str(caught.value).startswith(f"{tmp_path / 'bad.csv'}: {message}")


def test_split__holds_out_every_tenth_recording_that_drives_the_same_joints():
    time = np.arange(40)[:, None]
    drives = {"a": np.sin(time * [1, 0]), "b": np.sin(time * [0, 1])}
    names = ["a"] * 21 + ["b"] * 2
    recordings = [Recording(f"{i}", drives[x], drives[x], 0 * time) for i, x in enumerate(names)]
    log = Log(("a", "b"), tuple(recordings))
    kept, held_out = logs.split(log)
    assert [recording.name for recording in held_out.recordings] == ["0", "10", "20", "21"]
    assert len(kept.recordings) == 19
    with pytest.raises(ValueError, match=r"^recordings: expected two or more .*, or --test, got 1"):
        logs.split(log._replace(recordings=log.recordings[:1]))
