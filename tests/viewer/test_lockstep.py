"""Loop and simulated machine on a clock that stands still while anything computes."""

from contextlib import closing

import numpy as np
import pytest
from helpers_bus import START, ConstantCommand

from brokk_min.actuator import plant_reset, plant_step
from brokk_min.machine import BROKK_170
from brokk_min.viewer.control_process import Request
from brokk_min.viewer.lockstep import Lockstep, follow

NEUTRAL = Request(0.0, 0, False, True, np.zeros(3), np.zeros(4))


def driven(seconds_a_picture, pictures):
    """Telemetry of a window that draws slowly, while the operator holds the switch."""
    now = 100.0
    slew = ConstantCommand(60, 0, 0, 0, 0)
    ticks = []
    with closing(Lockstep(BROKK_170, [slew], START, None, lambda: now)) as loop:
        for _ in range(pictures):
            ready = bool(ticks) and not ticks[-1].active_fault
            loop.connection.send(NEUTRAL._replace(enable=ready))
            ticks += loop.receive()
            now += seconds_a_picture
    assert not loop.drive.gate.sent[..., -1].any()  # the last tick, after the window was closed
    return ticks


@pytest.mark.parametrize(("period", "late"), [(1 / 60, 0.0), (0.1, 0.0), (0.5, 0.4)])
def test_receive__makes_due_ticks_and_loses_the_time_of_more_than_two_a_picture(period, late):
    ticks = driven(period, 30)
    assert [t.tick for t in ticks] == list(range(1, len(ticks) + 1))
    assert not ticks[3].active_fault  # the machine was on before the window opened
    expected = 4 + min(2, period / 0.05) * 29
    assert abs(len(ticks) - expected) <= 2
    assert ticks[-1].lateness == pytest.approx(29 * late, abs=0.11)
    assert not [t for t in ticks if t.driving and t.active_fault]


def test_receive__gives_the_same_motion_however_slow_the_window_is():
    quick = [t for t in driven(0.05, 60) if t.driving]
    slow = [t for t in driven(1.0, 30) if t.driving]
    assert len(slow) > 40
    for a, b in zip(quick, slow, strict=False):
        np.testing.assert_array_equal(a.u, b.u)
        np.testing.assert_array_equal(a.q, b.q)
    assert quick[-1].q[0] > START[0] + 0.2


def test_follow__moves_the_plant_as_the_commands_of_the_loop_do():
    """A constant command, through bus and gate: the plant's own steps give the same angles."""
    goals = np.tile([0.1, 0.0, 0.0], (40, 1))
    q = np.array(list(follow(BROKK_170, ConstantCommand(30, 0, 0, 0, 0), START, goals)))
    moving = np.flatnonzero(q[:, 0] > START[0])
    plant = plant_reset(BROKK_170, np.array(START))
    alone = []
    for _ in range(30):
        plant = plant_step(BROKK_170, plant, np.array([30, 0, 0, 0, 0]) / 127)
        alone.append(plant.q[0])
    first = np.flatnonzero(np.array(alone) > START[0])[0]
    np.testing.assert_allclose(
        q[moving[0] + 2 : moving[0] + 20, 0], alone[first + 2 : first + 20], atol=0.01
    )
