"""Muon against the singular value decomposition, which its iteration approaches."""

from dataclasses import replace

import pytest
import torch

from brokk_min import ppo
from brokk_min.beyond.muon import muon
from brokk_min.settings import PPOConfig

CONFIG = PPOConfig(learning_rate=3e-3, log_std_end=-4.0)


def test_muon__steps_along_all_singular_directions_alike():
    """Of gradients whose singular values fall to a tenth; the iteration is off by a third at most.

    A step is lr 0.2 sqrt(longer side) U V^T.
    """
    torch.manual_seed(0)
    agent = ppo.Agent(50, 3, -1.0)
    layers = [layer for layer in agent.actor if isinstance(layer, torch.nn.Linear)]
    before = [layer.weight.detach().clone() for layer in layers]
    optimizer = muon(agent, CONFIG)
    parts = []
    for layer in layers:
        u, _, vt = torch.linalg.svd(torch.randn(layer.weight.shape), full_matrices=False)
        layer.weight.grad = u * torch.linspace(1.0, 0.1, len(vt)) @ vt
        parts.append((u, vt))
    optimizer.step()
    for layer, old, (u, vt) in zip(layers, before, parts, strict=True):
        step = (old - layer.weight.detach()) / (3e-3 * 0.2 * max(old.shape) ** 0.5)
        along = u.T @ step @ vt.T
        assert (along.diag() - 1).abs().max() < 0.35
        assert (step - u @ along.diag().diag() @ vt).abs().max() < 0.05


def test_muon__leaves_biases_critic_and_deviation():
    agent = ppo.Agent(5, 2, -1.0)
    optimizer = muon(agent, CONFIG)
    learns = {id(p) for group in optimizer.param_groups for p in group["params"]}
    assert learns == {id(p) for p in agent.actor.parameters() if p.ndim == 2}
    assert not any(p.requires_grad for p in agent.actor.parameters() if p.ndim == 1)
    with pytest.raises(ValueError, match="log_std_end: expected a number with Muon, got None"):
        muon(agent, replace(CONFIG, log_std_end=None))  # a deviation that is learned
