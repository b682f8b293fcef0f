"""Texts and tables of the report; the page itself is drawn in test_reproduce.py."""

import json

import numpy as np
import pytest

from brokk_min.evaluation import report
from brokk_min.machine import BROKK_170


def number(mean, low=None, high=None):
    return {"mean": mean, "low": low, "high": high}


@pytest.mark.parametrize(
    ("value", "text"),
    [
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


def test_compare__has_the_sides_of_the_intervals():
    less = {"a": number(-1.0, -2.0, -0.1), "b": number(1.0, 0.1, 2.0), "c": number(0.0, -1.0, 1.0)}
    less["d"] = number(-1.0)
    rows = {"velocity_error_mean": {name: {"all": value} for name, value in less.items()}}
    sides = {"lower than": ["a"], "higher than": ["b"], "not told apart from": ["c", "d"]}
    assert report.compare({"task_space": {"rl_less": rows}}) == sides


def test_less_than__has_fractions_of_the_others_figures():
    keys = [key for _, key, _ in report.FIRST.values()]
    summary = {"rl": {"all": dict.fromkeys(keys, 3.0)}, "pid": {"all": dict.fromkeys(keys, 4.0)}}
    assert report.less_than(summary, "pid") == dict.fromkeys(report.FIRST, 0.25)


def test_first_panels__are_seeds_before_this_run(tmp_path, monkeypatch):
    folder = tmp_path / BROKK_170.name
    folder.mkdir()
    row = {"controller": "ours dither", "seed": 0, "error": 1, "drift": 0, "jerk": 1}
    row["valve_travel"] = 2
    rows = [row, row | {"seed": 1, "error": 3}, row | {"controller": "pid", "seed": None}]
    (folder / "seeds.json").write_text(json.dumps(rows))
    monkeypatch.setattr(report, "SHIPPED", tmp_path)
    keys = ("velocity_error_mean", "off_axis_drift_max", "jerk_rms", "valve_travel")
    summary = {"rl": {"all": dict.fromkeys(keys, 5.0)}}
    intervals = {"rl": {"all": {key: [4.0, 6.0] for key in keys}}}
    swept = {"rl": {"velocity_error_all": number(7.0, 6.0, 8.0)}}
    task = {"summary": summary, "intervals": intervals}
    panels = report.first_panels(BROKK_170, {"training_seeds": swept, "task_space": task})
    assert list(panels) == list(report.FIRST)
    error = panels["error [m/s]"]
    assert list(error) == ["RL policy (dither), 2 seeds", "rl, swept seeds", "rl"]
    assert error["RL policy (dither), 2 seeds"]["rl_dither"]["mean"] == 2.0
    assert error["rl, swept seeds"]["rl"] == number(7.0, 6.0, 8.0)
    assert error["rl"]["rl"] == number(5.0, 4.0, 6.0)
    assert panels["jerk [m/s^3]"]["rl, swept seeds"]["rl"] == number(None)  # of older sweeps
