"""Robustness: machines that differ in one thing each, and the table over them."""

import numpy as np
import pytest
from helpers_machines import Idle, obedient_net, pids

from brokk_min.evaluation.metrics import by_start, evaluate, mean_interval
from brokk_min.evaluation.reproduce import robustness, variations
from brokk_min.evaluation.sequences import task_sequences
from brokk_min.machine import BROKK_170

PIDS = pids(BROKK_170, obedient_net(BROKK_170))
STARTS = np.tile(BROKK_170.q_start, (2, 1))
ALONG_Z = task_sequences(BROKK_170)[2]
MOVES = np.flatnonzero(ALONG_Z.goals.any(axis=1))[0]


def test_variations__change_what_they_say():
    result = variations(BROKK_170)
    assert len(result) == 8 and result["nominal"] is BROKK_170
    zones = BROKK_170.dead_zones
    changed = {
        "supply flow -70 %": ("pump_flow", 0.000315),
        "valve gain -20 %": ("cylinder_speeds", 0.8 * BROKK_170.cylinder_speeds),
        "valve gain +20 %": ("cylinder_speeds", 1.2 * BROKK_170.cylinder_speeds),
        "up -15 %, down +15 %": ("cylinder_speeds", BROKK_170.cylinder_speeds * [0.85, 1.15]),
        "dead zone 5 %": ("dead_zones", 0 * zones + 0.05),
        "dead zone 10 %": ("dead_zones", 0 * zones + 0.1),
        "delay +50 ms": ("delay", 0.09),
    }
    for name, (field, value) in changed.items():
        np.testing.assert_allclose(getattr(result[name], field), value)


def test_robustness__has_a_row_for_each_variation_and_controller():
    short = [ALONG_Z._replace(goals=ALONG_Z.goals[MOVES - 2 : MOVES + 18])]
    controllers = {"idle": Idle(), "pid": PIDS["jacobian_pid_ff_integral"]}
    table = robustness(BROKK_170, controllers, short, STARTS, 0)
    assert list(table) == [*variations(BROKK_170), "goals +50 %"]
    machine = variations(BROKK_170)["delay +50 ms"]
    runs, _ = evaluate(machine, controllers, short, STARTS, 0)
    error = by_start(runs, "pid", "all", "velocity_error_mean")
    assert table["delay +50 ms"]["pid"] == mean_interval(error)
    errors = {name: row["pid"]["mean"] for name, row in table.items()}
    assert errors["nominal"] < min(errors["delay +50 ms"], errors["dead zone 10 %"])
    assert table["delay +50 ms"]["idle"] == table["nominal"]["idle"]
    faster = 1.5 * table["nominal"]["idle"]["mean"]
    assert table["goals +50 %"]["idle"]["mean"] == pytest.approx(faster)
