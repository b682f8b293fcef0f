"""Which paths ideal actuators can follow, by hand."""

from dataclasses import replace

import numpy as np
import pytest

from brokk_min.evaluation import feasibility
from brokk_min.kinematics import forward_kinematics, lowest_point, tool_position
from brokk_min.machine import BROKK_170

START = np.array(BROKK_170.q_start)
STILL = np.zeros((2, 1, 3))


def feasible(start, goals=STILL, machine=BROKK_170):
    return bool(feasibility.feasible(machine, start[None], goals)[0])


def test_feasible__refuses_a_path_through_a_singularity():
    """Stretched out straight no joint can move the tool outward: it leaves its path."""
    wide = [replace(j, cylinder_base=0.0, q_min=-3.0, q_max=4.0) for j in BROKK_170.joints]
    machine = replace(BROKK_170, joints=tuple(wide))
    start = np.array([0.0, 0.5, 0.1, np.pi, 3 * np.pi / 4])
    outward = np.array([np.cos(0.6), 0.0, np.sin(0.6)]) / 5  # along the links after q2
    assert feasible(start, np.zeros((5, 1, 3)), machine)
    assert not feasible(start, np.tile(outward, (5, 1, 1)), machine)


@pytest.mark.parametrize("joint", BROKK_170.driven)
@pytest.mark.parametrize("end", ["q_min", "q_max"])
def test_feasible__keeps_a_margin_to_joint_limits(joint, end):
    inward = 1 if end == "q_min" else -1
    near = np.array([0.0, *START[1:]])
    far = near.copy()
    near[joint] = BROKK_170.column(end)[joint] + inward * 0.049
    far[joint] = BROKK_170.column(end)[joint] + inward * 0.051
    high_enough = lowest_point(forward_kinematics(BROKK_170, far)) > 0.1
    assert not feasible(near) and feasible(far) == high_enough


@pytest.mark.parametrize("direction", [-1, 1])
def test_feasible__keeps_a_margin_to_the_speed_limits(direction):
    start = np.array([0.0, *START[1:]])
    limit = -0.20 if direction < 0 else 0.20  # of q1 [rad/s]
    radius = np.hypot(*tool_position(forward_kinematics(BROKK_170, start))[:2])
    machine = replace(BROKK_170, rate=100.0)
    for fraction, expected in ((0.89, True), (0.91, False)):
        slewing = np.tile([0.0, fraction * limit * radius, 0.0], (2, 1, 1))
        assert feasible(start, slewing, machine) == expected


@pytest.mark.parametrize("rate", [5.0, 10.0, 20.0])
def test_feasible__compares_tool_and_path_at_the_same_tick(rate):
    """At 10 Hz and 0.3 m/s the path of the next tick is 30 mm ahead."""
    machine = replace(BROKK_170, rate=rate)
    sideways = np.tile([0.0, 0.3, 0.0], (3, 1, 1))
    assert feasible(np.array([0.0, *START[1:]]), sideways, machine)
