"""Ranges, machines, files that are written over."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import pytest
from helpers_cli import MINI

from brokk_min.cli.identification import Fit
from brokk_min.cli.options import Command, WrongUse, find_machine, names_in
from brokk_min.machine import BROKK_170, number


@dataclass(kw_only=True)
class Options(Command):
    """A command with a whole number, and with one that may be missing."""

    counts: int = number("counts", 1, 127, 1)
    dead_zone: float | None = number("1", 0, 0.99, None)
    logs: tuple[Path, ...] = (Path("a.csv"),)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (Options(counts=0), "--counts: expected 1 to 127, got 0"),
        (Options(counts=128), "--counts: expected 1 to 127, got 128"),
        (Options(seed=-1), "--seed: expected 0 to 2147483647, got -1"),
        (Options(dead_zone=float("nan")), "--dead-zone: expected a finite number, got nan"),
        (Options(logs=()), "LOGS: expected at least one log, got none"),
    ],
)
def test_check__names_option_range_and_value(options, message):
    assert Options(counts=127, dead_zone=0.99, seed=2**31 - 1).check() is BROKK_170
    with pytest.raises(WrongUse, match=f"^{message}$"):
        options.check()


@dataclass(kw_only=True)
class Convert(Command):
    """A command with an input, an output and a second one."""

    logs: tuple[Path, ...] = (Path("in.csv"),)
    out: Path
    json: Path | None = None
    figure: Path | None = None


def test_check__gives_the_machine_if_outputs_can_be_written(tmp_path):
    assert Convert(out=tmp_path / "new.csv").check(out="log", json="scores") is BROKK_170
    assert Command(machine="").check() is BROKK_170
    with pytest.raises(WrongUse, match=f"^{re.escape(str(tmp_path))}: expected a file in an exist"):
        Convert(out=tmp_path).check(out="log")


def test_check__writes_over_no_input_and_over_no_other_kind(tmp_path):
    """A log may replace a log; a table, a picture and a device only an empty or forced file."""
    log, table = tmp_path / "log.csv", tmp_path / "table.csv"
    log.write_text("run,time,u_a,q_a\n")
    table.write_text("year,income\n")
    (tmp_path / "empty").touch()
    (tmp_path / "link").symlink_to(log)
    (tmp_path / "null").symlink_to("/dev/null")
    for path in (log, tmp_path / "empty"):
        Convert(out=path).check(out="log")
    Convert(out=table, force=True).check(out="log")
    for path, message in ((table, "['income', 'year']"), (tmp_path / "null", "no regular file")):
        with pytest.raises(WrongUse, match=re.escape(f"{path}: expected no file, or one of kind")):
            Convert(out=path).check(out="log")
        with pytest.raises(WrongUse, match=re.escape(message)):
            Convert(out=path, force="null" in path.name).check(out="log")
    for path in (log, tmp_path / "link"):
        with pytest.raises(WrongUse, match="expected another file than an input to write"):
            Convert(logs=(table, log), out=path, force=True).check(out="log")
    with pytest.raises(WrongUse, match="--out, --json: expected different files"):
        Convert(out=log, json=log).check(out="log", json="scores")
    with pytest.raises(WrongUse, match="--out, --json, --figure: expected different files"):
        Convert(out=log, figure=log).check(out="log", json="scores", figure="picture")
    module = tmp_path / "mine.py"
    module.write_text("from brokk_min.machine import BROKK_170 as MINE\n")
    with pytest.raises(WrongUse, match=r"mine\.py: expected another file than an input to write"):
        Convert(machine=f"{module}:MINE", out=module, force=True).check(out="log")
    drive = tmp_path / "drive.log"
    drive.write_text("(1.5) can0 181#00\n")
    wanted = r": expected no file, for no drive or recording can be repeated"
    with pytest.raises(WrongUse, match=f"log.csv{wanted}"):
        Convert(out=log).check(out="recording")
    with pytest.raises(WrongUse, match=f"drive.log{wanted}"):
        Convert(out=drive).check(out="drive log")
    Convert(out=drive, force=True).check(out="drive log")


def test_check__takes_no_log_twice(tmp_path):
    log = tmp_path / "log.csv"
    log.write_text("run,time,u_a,q_a\n")
    for logs, test in (((log, log), ()), ((log,), (tmp_path / "." / "log.csv",))):
        with pytest.raises(WrongUse, match="LOGS, --test: expected different files"):
            Fit(logs=logs, test=test, out=tmp_path / "net.npz").check(out="nets")
    Fit(logs=(log,), out=tmp_path / "net.npz").check(out="nets")


def test_find_machine__runs_a_file(tmp_path):
    assert find_machine("brokk170") is BROKK_170
    assert find_machine(MINI).name == "mini_excavator"
    file = tmp_path / "a:b.py"
    file.write_text("from brokk_min.machine import BROKK_170 as MINE\nNONE = 3\n")
    assert find_machine(f"{file}:MINE") == BROKK_170
    with pytest.raises(WrongUse, match=r"^--machine: expected a Machine NONE in .*a:b.py, got 3$"):
        find_machine(f"{file}:NONE")
    with pytest.raises(WrongUse, match=r"one of \['brokk170'\] or FILE.py:NAME, got digger$"):
        find_machine("digger")
    file.write_text("raise KeyError('no')")
    with pytest.raises(ValueError, match=r"expected .*a:b.py to run, got no entry 'no'$"):
        find_machine(f"{file}:MINE")


def test_names_in__tells_kinds_of_files_apart(tmp_path):
    contents = {
        b"run,time\n": {"run", "time"},
        b'{"meta": 1, "runs": []}': {"meta", "runs"},
        b"\x89PNG\r\n": {"PNG"},
        b"(1.0) can0 080#\n": {"candump"},
        b"PK\x03\x04": set(),
        b"{": set(),
    }
    for content, names in contents.items():
        (tmp_path / "file").write_bytes(content)
        assert names_in(tmp_path / "file") == names
