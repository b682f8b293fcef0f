"""The paper's numbers: its constants, and what its preliminary tests found of the machine."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from torch import nn

from brokk_min.actuator import plant_reset, plant_step
from brokk_min.env import TaskConfig
from brokk_min.evaluation import baselines, reproduce
from brokk_min.identification import excitation, fitting, validation
from brokk_min.machine import BROKK_170, Machine
from brokk_min.ppo import PPOConfig, mlp


def test_constants__are_the_papers() -> None:
    machine = BROKK_170
    assert machine.n == 5
    assert machine.q_start == (1.5, 0.5, 0.58, 1.71, 1.24)
    assert (machine.history, fitting.FitConfig().history) == (13, 13)
    assert (machine.history - 1) * machine.dt == pytest.approx(0.6)
    assert fitting.FitConfig().hidden == 32
    assert TaskConfig().noise == 0.05
    assert PPOConfig().num_envs == 256
    assert reproduce.Budget().hours == 1.0
    assert max(validation.HORIZONS) == 30
    layers = [layer.out_features for layer in mlp(7, 1, 1.0) if isinstance(layer, nn.Linear)]
    assert layers == [256, 128, 64, 1]
    assert excitation.EXCITATIONS["sine"] is excitation.sine_command
    assert baselines.RANGES["feedback"] == (0.01, 1.0)


def step_times(machine: Machine, before: int) -> float:
    """Seconds until q5 has 63 % of its gain in speed at 50 counts, after `before` counts."""
    fine = replace(machine, rate=1 / machine.plant_dt)
    state = plant_reset(fine, [1.5, 0.5, 0.58, 1.71, 0.3])
    speeds = []
    for count in [before] * 200 + [50] * 200:
        state = plant_step(fine, state, [0, 0, 0, 0, count / 127])
        speeds.append(state.v[4])
    gain = (np.array(speeds[200:]) - speeds[199]) / (speeds[-1] - speeds[199])
    return float(np.argmax(gain > 0.63) + 1) * machine.plant_dt


def test_response__takes_400_ms_from_idle_and_100_ms_when_moving() -> None:
    """A valve that opens at once has no such difference."""
    assert step_times(BROKK_170, 0) == pytest.approx(0.4, abs=0.02)
    assert step_times(BROKK_170, 20) == pytest.approx(0.1, abs=0.02)
    fast = replace(BROKK_170, tau_valve_up=0.005)
    assert step_times(fast, 0) == pytest.approx(0.1, abs=0.02)


def speed_of_q5(machine: Machine, counts: list[int]) -> float:
    """Cylinder speed of q5 after 1.5 s under a command [counts of 127]."""
    state = plant_reset(machine, [0.5, 0.5, 1.4, 1.2, 0.3])
    for _ in range(30):
        state = plant_step(machine, state, np.array(counts) / 127)
    return float(state.v[4])


def test_coupling__is_marginal_at_the_limit_and_not_with_a_small_pump() -> None:
    alone, together = [0, 0, 0, 0, 80], [-80, 0, -80, 80, 80]
    assert speed_of_q5(BROKK_170, together) == pytest.approx(
        speed_of_q5(BROKK_170, alone), rel=0.01
    )
    weak = replace(BROKK_170, pump_flow=0.3 * BROKK_170.pump_flow)
    assert speed_of_q5(weak, together) < 0.9 * speed_of_q5(weak, alone)
