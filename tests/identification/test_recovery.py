"""What nets recovered of the plant."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import brokk_min
from brokk_min.identification.recovery import dead_zones, recovery
from brokk_min.identification.simulation import plant_simulator
from brokk_min.learning.policy import load_policy
from brokk_min.machine import BROKK_170

SHIPPED = Path(brokk_min.__file__).with_name("shipped") / BROKK_170.name / "policy.npz"
DRIVEN = tuple(joint for joint in BROKK_170.joints if joint.driven)
FOUR = replace(BROKK_170, joints=DRIVEN, q_start=())
NET = load_policy(SHIPPED, BROKK_170).net


def test_dead_zones__are_the_plants_own():
    """0.07 of 127 counts are 8.9; valves open from 1 % of the stroke on, 1.2 counts more."""
    for dead_zone, counts in ((0.07, 10), (0.15, 20)):
        machine = replace(FOUR, dead_zone=dead_zone)
        found = dead_zones(plant_simulator(machine), NET, 30, 40)
        np.testing.assert_allclose(found * 127, counts)


def test_recovery__is_close_for_the_shipped_nets():
    for name, sides in recovery(NET, FOUR).items():
        nets, plant = sides["nets"], sides["plant"]
        assert nets["dead_zone"] == pytest.approx(plant["dead_zone"], abs=0.02), name
        assert nets["delay"] == pytest.approx(plant["delay"], abs=0.02), name
        assert nets["idle"] == pytest.approx(plant["idle"], abs=0.06), name
        assert nets["speed"] == pytest.approx(plant["speed"], rel=0.1), name
    slow = recovery(NET, replace(FOUR, delay=0.2))["q5"]["plant"]
    assert slow["delay"] == pytest.approx(np.add(plant["delay"], 0.16), abs=0.01)
    assert slow["idle"] == pytest.approx(np.add(plant["idle"], 0.16), abs=0.02)
