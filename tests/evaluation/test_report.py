"""Texts and tables of the report; the page itself is drawn in test_reproduce.py."""

from __future__ import annotations

import numpy as np
import pytest

from brokk_min.evaluation import report


def number(mean, low=None, high=None):
    return {"mean": mean, "low": low, "high": high}


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (number(0.01234, -0.5, 0.03), "0.0123 (-0.5000 to 0.0300)"),
        (number(41.267, 40.0, 42.5), "41.27 (40 to 42.5)"),
        (number(0.5), "0.5000"),
        (number(None), ""),
    ],
)
def test_interval_text__has_digits_that_tell_it(value, text):
    assert report.interval_text(value) == text


def test_path_row__lists_the_goals_that_hold():
    row = report.path_row(np.array([[1.0, 0.0, 0.0, 0.0], [0.85, -0.0, -0.2, 0.0]]))
    *numbers, goals = row.values()
    assert numbers == pytest.approx([1.85, 1, 0.2, 0.17])
    assert goals == "1 s (0, 0, 0); 0.85 s (0, -0.2, 0)"
    assert report.path_row(np.ones((60, 4)))["held for, vx, vy, vz [m/s]"] == "new at every tick"


def test_seed_bars__are_velocity_errors_of_controllers_by_sequence():
    row = {"velocity_error_to_go": number(0.5, 0.25, 0.75), "valve_travel": number(9.0)}
    bars = report.seed_bars({"rl": row, "pid": row, "rl less pid": row})
    errors = {"to_go": row["velocity_error_to_go"]}
    assert bars == {"rl": errors, "pid": errors}
