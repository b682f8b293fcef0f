"""The paper's constants; what it found of the machine, the tests of the plant hold."""

from __future__ import annotations

import pytest
from torch import nn

from brokk_min.env import TaskConfig
from brokk_min.evaluation import baselines, learn
from brokk_min.identification import excitation, fitting, validation
from brokk_min.machine import BROKK_170
from brokk_min.ppo import PPOConfig, mlp


def test_constants__are_the_papers() -> None:
    machine = BROKK_170
    assert machine.n == 5
    assert machine.q_start == (1.5, 0.5, 0.58, 1.71, 1.24)
    fit = fitting.FitConfig()
    assert (machine.history, fit.history, fit.output_lags) == (13, 13, None)  # None: all
    assert (machine.history - 1) * machine.dt == pytest.approx(0.6)
    assert fitting.FitConfig().hidden == 32
    assert TaskConfig().noise == 0.05
    assert PPOConfig().num_envs == 256
    assert learn.Budget().hours == 1.0
    assert max(validation.HORIZONS) == 30
    layers = [layer.out_features for layer in mlp(7, 1, 1.0) if isinstance(layer, nn.Linear)]
    assert layers == [256, 128, 64, 1]
    assert excitation.EXCITATIONS["sine"] is excitation.sine_command
    assert baselines.RANGES["feedback"] == (0.01, 1.0)
