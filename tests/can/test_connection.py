"""The bus through python-can: waiting, echoes, refusals, and the log."""

import io
import os
import re
import select
import threading
import time
from functools import partial
from types import SimpleNamespace

import can
import pytest

from benchmarks.one_process import raises
from brokk_min.can.canopen import Frame, OperatorInput
from brokk_min.can.connection import Bus, open_bus


def test_bus__marks_foreign_frames_and_echoes_and_logs_all_but_echoes():
    text, virtual = io.StringIO(), partial(can.Bus, "echoes", interface="virtual")
    with virtual() as here, virtual() as there:
        bus = Bus(here, "can0", text, echo=True, clock=lambda: 1.0)
        bus.send(0x123, b"\x01\x02")
        for fields in (
            {"data": b"\x01\x02"},  # the echo
            {"data": b"\x01\x02"},  # somebody else
            {"data": b"\x01", "is_extended_id": True},
            {"is_remote_frame": True},
            {"is_error_frame": True},
            {"is_fd": True, "data": bytes(12)},
        ):
            plain = {"arbitration_id": 0x123, "is_extended_id": False}
            there.send(can.Message(**(plain | fields)))
        frames = [bus.recv(0.5) for _ in range(6)]
        assert [frame.id for frame in frames] == [-1, 0x123, -1, -1, -1, -1]
        assert frames[0] == Frame(bus.now(), -1, b"\x01\x02") and bus.recv(0.0) is None
    bus.log_tick(OperatorInput((0.1, -0.05, 0), enable=True), 0.0021)
    lines = text.getvalue().splitlines()
    assert len(lines) == 8
    assert re.fullmatch(r"\(\d+\.\d{6}\) can0 123#0102 T", lines[0])
    assert re.fullmatch(r"\(\d+\.\d{6}\) can0 123#0102 R", lines[1])
    assert re.fullmatch(r"\(\d+\.\d{6}\) operator 7FF#E8030CFE000003 T", lines[-2])
    assert re.fullmatch(r"\(\d+\.\d{6}\) timing 7FD#3408000000000000 T", lines[-1])


def test_open_bus__names_its_log_where_a_disk_is_full():
    with pytest.raises(OSError, match="/dev/full"), open_bus("virtual", "v", "/dev/full") as bus:
        bus.heard = True  # so the log stays
        bus.send(0x080, b"")
        with pytest.raises(OSError, match="/dev/full"):
            bus.flush()


def test_open_bus__keeps_its_log_where_the_adapter_fails(tmp_path):
    """An adapter that was pulled out fails at the shutdown, too."""
    refusal = r"virtual v: expected a CAN bus that works, got gone$"
    with pytest.raises(ValueError, match=refusal), open_bus("virtual", "v", tmp_path / "l") as bus:
        bus.send(0x080, b"")
        bus.bus.shutdown, shutdown = raises(can.CanOperationError("gone")), bus.bus.shutdown
    shutdown()
    assert (tmp_path / "l").read_text().endswith(" v 080# T\n")
    with (
        pytest.raises(ValueError, match="no answer"),
        open_bus("virtual", "v", tmp_path / "m") as bus,
    ):
        bus.send(0x080, b"")
        raise ValueError("no answer")
    assert not (tmp_path / "m").exists()  # nobody else sent, so it would only be in the way
    with pytest.raises(IsADirectoryError), open_bus("virtual", "v", tmp_path):
        raise AssertionError("a log in the place of a folder")


@pytest.mark.parametrize("heard", (True, False))
def test_open_bus__replaces_an_older_log_only_if_somebody_was_heard(tmp_path, heard):
    (log := tmp_path / "run.log").write_text("an hour of driving")
    with pytest.raises(ValueError, match="no"), open_bus("virtual", "v", log) as bus:
        bus.heard = heard
        raise can.CanOperationError("no answer")
    assert (log.read_text() == "an hour of driving") is not heard
    assert [*tmp_path.iterdir()] == [log]


def test_open_bus__keeps_an_older_log_if_a_new_one_cannot_be_written(tmp_path, monkeypatch):
    (log := tmp_path / "run.log").write_text("an hour of driving")
    monkeypatch.setattr(can, "CanutilsLogWriter", raises(OSError("too many open files")))
    with pytest.raises(OSError, match="too many"), open_bus("virtual", "v", log):
        raise AssertionError("a bus without its log")
    assert log.read_text() == "an hour of driving" and [*tmp_path.iterdir()] == [log]


def test_recv__waits_for_the_descriptor_by_its_own_clock():
    """A frame comes with the byte of a pipe."""
    reader, writer = os.pipe()

    def recv(timeout):
        assert timeout == 0.0  # else python-can would wait by the time of day
        if not select.select([reader], [], [], 0)[0]:
            return None
        os.read(reader, 1)
        return can.Message(arbitration_id=0x181, data=b"1234", is_extended_id=False)

    bus = Bus(SimpleNamespace(recv=recv), file=reader)
    start = time.monotonic()
    assert bus.recv(0.05) is None and 0.05 <= time.monotonic() - start < 1.0
    threading.Timer(0.02, os.write, (writer, b"x")).start()
    frame = bus.recv(5.0)
    assert (frame.id, frame.data) == (0x181, b"1234") and time.monotonic() - start < 2.0
    os.close(reader), os.close(writer)
