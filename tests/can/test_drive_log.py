"""Logs of drives, read as frames, as recordings and as telemetry."""

import io
import struct
import sys
from dataclasses import replace
from itertools import chain

import can
import numpy as np
import pytest

from brokk_min.can.canopen import (
    LATENESS,
    OPERATOR_INPUT,
    Frame,
    OperatorInput,
    encoder_raw,
    valve_frame,
)
from brokk_min.can.drive_log import log_for_fit, read_frames, read_telemetry, timing
from brokk_min.machine import BROKK_170

STEP = BROKK_170.encoder_step[0]


def test_read_frames__reads_a_cut_log_up_to_its_last_whole_line(tmp_path):
    text = "(1.000000) can0 123#0102 R\n(2.000000) can0 080#AABB T\n"
    for size in range(len(text) + 1):
        (tmp_path / "cut.log").write_text(text[:size])
        times = [frame.time for frame in read_frames(tmp_path / "cut.log")]
        assert times == [1.0, 2.0][: text[:size].count("\n")]


def test_read_frames__reads_what_candump_logs_and_what_it_prints_on_a_terminal(tmp_path):
    """Without extended, FD and remote frames, and those of a length code above eight."""
    frames = ("12345678#", "123##F00", "123#R", "321#1122334455667788_B")
    others = "".join(f"(2.0) can0 {frame}\n" for frame in frames)
    (tmp_path / "can.log").write_text(f"(1.0) can0 123#0102\n{others}(3.0) can0 080# T\n")
    fd = " (2.000000)  can0  123  [12]  " + "00 " * 12 + "\n"
    printed = f" (1.000000)  can0  123   [2]  01 02\n{fd} (3.000000)  can0  080   [0]  \n"
    (tmp_path / "terminal.txt").write_text(printed)
    letters = printed.replace("02\n", "02                     '..'\n").replace("[0]", "[00]")
    flags = letters.replace("can0  ", "can0  RX - -  ").replace("[2]", "[02]")
    (tmp_path / "axes8.txt").write_text(flags)
    for name, sent in (("can.log", True), ("terminal.txt", False), ("axes8.txt", False)):
        expected = [Frame(1.0, 0x123, b"\x01\x02"), Frame(3.0, 0x80, b"", sent)]
        assert list(read_frames(tmp_path / name)) == expected


@pytest.mark.parametrize("name", ["drive.asc", "drive.blf", "drive.trc", "drive.log.gz"])
def test_read_frames__reads_the_logs_of_other_tools(tmp_path, name):
    frames = [Frame(10.0 + k / 20, 0x181, bytes([k, 1, 2, 3]), k % 2 == 1) for k in range(20)]
    with can.Logger(tmp_path / name) as logger:
        for time, can_id, data, sent in frames:
            message = {"arbitration_id": can_id, "data": data, "is_extended_id": False}
            logger(can.Message(timestamp=time, is_rx=not sent, **message))
        logger(can.Message(timestamp=11.0, arbitration_id=0x123, is_extended_id=True))
    times, ids, data, sent = zip(*read_frames(tmp_path / name), strict=True)
    assert set(ids) == {0x181} and list(data) == [frame.data for frame in frames]
    np.testing.assert_allclose(np.array(times) - times[0], np.arange(20) / 20, atol=1e-3)
    assert list(sent) == [frame.sent for frame in frames]


def test_read_frames__names_the_row_that_is_no_frame(tmp_path):
    (tmp_path / "log.csv").write_text("(1.0) can0 123#0102\nrun,time,u_a,q_a\n")
    with pytest.raises(ValueError, match=r"log.csv: row 2: expected .time. bus"):
        list(read_frames(tmp_path / "log.csv"))
    (tmp_path / "log.csv").write_text("(1.0) can0 12345678#01\n(2.0) can0 123#R\n")
    with pytest.raises(ValueError, match=r"expected data frames of 11 bits, got row 1: .*345678#"):
        list(read_frames(tmp_path / "log.csv"))
    for line in ("123#0102 and more", "123#01.02", "123   [2]  02`01", "123   [1]  00000001"):
        (tmp_path / "log.csv").write_text(f"(1.0) can0 123#0102\n(2.0) can0 {line}\n")
        with pytest.raises(ValueError, match=r"row 2: expected .*, got '\(2.0\) can0 123"):
            list(read_frames(tmp_path / "log.csv"))
    two = "(1.0) can0 123#01\n(2.0) operator 7FF#01\n(3.0) can1 123#02\n"
    (tmp_path / "log.csv").write_text(two)
    with pytest.raises(ValueError, match=r"frames of one bus .*, got can0 and can1"):
        list(read_frames(tmp_path / "log.csv"))
    (tmp_path / "log.csv").write_text("(0.045) can0 123#01\n(0.005) can0 124#01\n" * 9)
    with pytest.raises(ValueError, match=r"row 8: expected times that rise .*-td.*, got '.0.005"):
        list(read_frames(tmp_path / "log.csv"))
    (tmp_path / "log.csv").write_bytes(bytes(range(256)))
    with pytest.raises(ValueError, match=r"log\.csv: expected a candump log, got"):
        list(read_frames(tmp_path / "log.csv"))


def test_read_frames__shows_how_far_a_log_is_read(tmp_path, monkeypatch):
    path, terminal = tmp_path / "run.log", io.StringIO()
    path.write_text("(1.000000) can0 080#\n")
    monkeypatch.setattr(terminal, "isatty", lambda: True)
    monkeypatch.setattr(sys, "stderr", terminal)
    assert len(list(read_frames(path))) == 1
    assert "read run.log:" in terminal.getvalue() and "21.0" in terminal.getvalue()


def test_log_for_fit__by_hand():
    """Ticks are missing; a foreign frame and a cut one change nothing; 14 ticks are too few."""
    machine = replace(BROKK_170, rate=10.0)
    frames, parts = [], [range(15), range(16, 36), range(37, 51)]
    for k in chain(*parts):
        t, u = 100 + k / 10, np.array([80, 0, -80, 1, 0]) / 127
        frames.append(Frame(t, 0x080, b"", True))
        frames += [Frame(t, 0x180 + n, struct.pack("<I", 100 * n + k)) for n in range(1, 6)]
        frames.append(Frame(t, 0x555, b"\x01" * 8))
        frames.append(Frame(t, 0x210, valve_frame(u, k, 1).tobytes(), True))
        frames.append(Frame(t, 0x210, b"\x01" * 7, True))
    log = log_for_fit(machine, frames)
    assert log.rate == 10 and [len(recording.q) for recording in log.recordings] == [15, 20]
    for recording, ticks in zip(log.recordings, parts, strict=False):
        counts = 100 * np.arange(1, 6) + np.array(ticks)[:, None]
        np.testing.assert_allclose(recording.q, counts * STEP, atol=1e-12)
        np.testing.assert_allclose(recording.u * 127, len(ticks) * [[80, 0, -80, 1, 0]], atol=1e-9)
    first, unread = [k for k, frame in enumerate(frames) if frame.id == 0x181], frames.copy()
    for k in (first[0], first[18]):
        unread[k] = frames[k]._replace(data=struct.pack("<I", 3000))
    leaps = log_for_fit(machine, unread)
    (long,) = leaps.recordings  # 16 after the second one, 14 before it
    assert "too slow for, got 3 jumps, the first at 100.10 s" in leaps.warnings[1]
    np.testing.assert_allclose(long.q[:, 0], (np.arange(120, 136)) * STEP)
    assert "got 2 gaps, the first after 101.40 s: are frames lost?" in log.warnings[0]
    refusal = (
        r"15 ticks of driving in a row at 10 Hz \(--machine\), got 11 at most \(12 SYNCs; after "
    )
    refusal += "11 of them one position of each joint, in 11 of these an enabled valve frame"
    with pytest.raises(ValueError, match=refusal):
        log_for_fit(machine, frames[:100])
    slower = [frame._replace(time=1.25 * frame.time) for frame in frames]
    with pytest.raises(ValueError, match=r"log: expected 10 Hz \(--machine\), got SYNC at 8 Hz"):
        log_for_fit(machine, slower)
    held = [  # every second answer of q3 is the one before it
        frame._replace(data=struct.pack("<I", round(300 + 150 * np.sin((5 * frame.time) // 1 / 4))))
        if frame.id == 0x183
        else frame
        for frame in frames
    ]
    with pytest.raises(ValueError, match="a new angle in each tick, got one in so many of q_q3 2"):
        log_for_fit(machine, held)
    other = replace(machine, valve_frame_id=0x211)
    with pytest.raises(ValueError, match=r"frames, 080 181 .* 185 211 .*, got none with 211$"):
        log_for_fit(other, frames)


def test_read_telemetry__gives_at_each_sync_the_tick_before():
    goal = OperatorInput((0.1, 0.0, -0.12346), enable=True, stop=True).pack()
    assert goal == struct.pack("<hhhB", 1000, 0, -1235, 0b111)
    q, u = np.array([0.0, 0.5, 0.6, 1.7, 1.2]), np.array([50, 0, -80, 0, 0]) / 127
    frames = []
    for k in range(6):
        counts = np.rint((q + 0.01 * k) / STEP).astype(int)
        frames.append(Frame(0.05 * k, 0x080, b""))
        for node, raw in enumerate(encoder_raw(BROKK_170, counts).tolist(), 1):
            frames.append(Frame(0.0, 0x180 + node, struct.pack("<I", raw)))
        frames.append(Frame(0.0, OPERATOR_INPUT, goal, True))
        frames.append(Frame(0.0, OPERATOR_INPUT, bytes(7)))  # somebody else's
        frames.append(Frame(0.0, 0x210, valve_frame(u, k, k > 0).tobytes()))
    frames += [Frame(0.3, 0x080, b""), Frame(0.35, 0x181, struct.pack("<I", 3))]  # a gap
    first, *_, last = read_telemetry(BROKK_170, [*frames, Frame(0.4, 0x080, b"")])
    assert not first.driving and not first.v_goal.any()
    assert last.driving and last.time == 0.25
    np.testing.assert_array_equal(last.q, np.rint((q + 0.05) / STEP) * STEP)
    np.testing.assert_allclose(last.u * 127, [50, 0, -80, 0, 0])
    np.testing.assert_allclose(last.v_goal, [0.1, 0.0, -0.1235])


def test_timing__counts_late_and_missed_ticks_by_hand():
    """98 ticks at 0.1 ms, one early by 1 us, one that begins 2.6 ticks late: two are missed."""
    late = [100] * 98 + [-1, 130_000]  # us
    frames = [Frame(0.05 * k, LATENESS, struct.pack("<q", t), True) for k, t in enumerate(late)]
    foreign = [Frame(9.0, LATENESS, bytes(8))]
    words = "0.10 ms in the median, 1.40 ms in 99 %, 130.00 ms at most"
    assert timing(BROKK_170, frames + foreign) == [f"ticks late by {words}; 2 of 102 missed"]
    assert timing(BROKK_170, foreign) == []
