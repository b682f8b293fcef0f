"""Bars are quiet where nobody looks, but not for longer than a minute."""

import io

import pytest

from brokk_min.identification import progress as module
from brokk_min.identification.progress import progress


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize(
    ("stream", "wait", "shown"),
    [(Terminal, 60.0, True), (io.StringIO, 60.0, False), (io.StringIO, 0.0, True)],
)
def test_progress__shows_at_once_on_a_terminal_else_after_a_minute(
    stream, wait, shown, monkeypatch
):
    monkeypatch.setattr(module, "MINUTE", wait)
    monkeypatch.setattr(module.sys, "stderr", stream())
    assert list(progress(range(3), desc="count")) == [0, 1, 2]
    with progress(total=2, desc="count") as bar:
        bar.update(2)
    assert ("count: 100%" in module.sys.stderr.getvalue()) == shown
