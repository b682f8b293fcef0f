"""The paper's constants; what it found of the machine, the tests of the plant hold."""

import pytest
from torch import nn

from brokk_min import env, fit
from brokk_min.evaluation import baselines
from brokk_min.evaluation.reproduce import Budget
from brokk_min.identification import fitting, validation
from brokk_min.machine import BROKK_170
from brokk_min.ppo import mlp
from brokk_min.settings import PPOConfig, TaskConfig


def test_constants__are_the_papers() -> None:
    machine = BROKK_170
    assert machine.n == 5
    assert machine.q_start == (1.5, 0.5, 0.58, 1.71, 1.24)
    assert all(joint.dead_zone == (0.07, 0.07) for joint in machine.joints)
    assert machine.history == 13
    assert (machine.history - 1) * machine.dt == pytest.approx(0.6)
    assert fit.FitConfig().hidden == 32
    assert fitting.PAPER_RECIPE["rollout"] == fitting.PAPER_RECIPE["members"] == 1
    assert TaskConfig().noise == 0.05
    assert PPOConfig().num_envs == 256
    assert Budget().hours == 1.0
    assert max(validation.HORIZONS) == 30
    layers = [layer.out_features for layer in mlp(7, 1, 1.0) if isinstance(layer, nn.Linear)]
    assert layers == [256, 128, 64, 1]
    assert fit.SINE.command is fit.sine_command
    assert baselines.RANGES["feedback"] == (0.01, 1.0)
    assert baselines.OPTIMISED == "jacobian_pid_k0.1"
    u, memory = env.action_to_pwm(machine, [1.0, 1.0, 1.0, 1.0]), None
    assert env.Interface().cost(machine, u, -u, memory) == 0.0  # no penalty
