"""Muon as the optimiser of the actor, instead of Adam.

What it changes: a step of a weight matrix W does not follow the mean gradient M, but the nearest
matrix whose singular values are all one, so small directions of M count as much as large ones:

    M = U S V^T,   W <- W - lr 0.2 sqrt(size) U V^T,

where `size` is the longer side of W, which makes steps as large as Adam's. Biases stay zero.

What it buys: together with our settings of task and learner it takes the velocity error of the tool
from 0.0144 to 0.0127 m/s after one million steps (the last step of `benchmarks.ladder`).

Who was first: Jordan et al. (2024, kellerjordan.github.io/posts/muon); the length of the steps is
by Liu et al. (2025, arXiv 2502.16982). `torch.optim.Muon` has both, but casts each matrix to
bfloat16 and has no switch for it: on a processor without bfloat16 units this took half of the time
of a training. So the step is written out here, in single precision.

It plugs into `ppo.train` as the optimiser of the checkpoint with which a training begins.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from brokk_min.machine import require
from brokk_min.ppo import Agent
from brokk_min.settings import PPOConfig

MOMENTUM = 0.95  # by Jordan et al.
A, B, C = 3.4445, -4.775, 2.0315  # by them, too


class Muon(torch.optim.Optimizer):
    """W <- W - lr 0.2 sqrt(size) orthogonal(mean gradient), with Nesterov's mean."""

    def __init__(self, matrices: Sequence[Tensor], lr: float) -> None:
        super().__init__(matrices, {"lr": lr})

    @torch.no_grad()
    def step(self) -> None:  # type: ignore[override]
        """One step of each matrix (rows, columns)."""
        for group in self.param_groups:
            for W in group["params"]:
                mean = self.state[W].setdefault("mean", torch.zeros_like(W))
                mean.lerp_(W.grad, 1 - MOMENTUM)
                ahead = W.grad.lerp(mean, MOMENTUM)
                W -= group["lr"] * 0.2 * max(W.shape) ** 0.5 * orthogonal(ahead)


def orthogonal(matrix: Tensor) -> Tensor:
    """About U V^T of a matrix U S V^T: five steps of Newton and Schulz bring S to 0.7 to 1.2.

    X <- A X + (B X X^T + C (X X^T)^2) X, from a matrix whose singular values are at most 1.
    """
    x = matrix / matrix.norm().clamp(min=1e-7)
    if tall := x.shape[0] > x.shape[1]:
        x = x.T  # the smaller X X^T
    for _ in range(5):
        gram = x @ x.T
        polynomial = torch.addmm(gram, gram, gram, beta=B, alpha=C)  # B X X^T + C (X X^T)^2
        x = torch.addmm(x, polynomial, x, beta=A)
    result: Tensor = x.T if tall else x
    return result


def muon(agent: Agent, config: PPOConfig) -> Muon:
    """The optimiser of the actor's matrices; its biases learn no more."""
    # a deviation of the actions that is learned would be no matrix
    require(config.log_std_end is not None, "log_std_end", "a number with Muon", None)
    for parameter in agent.actor.parameters():
        parameter.requires_grad_(parameter.ndim == 2)
    matrices = [parameter for parameter in agent.actor.parameters() if parameter.ndim == 2]
    return Muon(matrices, config.learning_rate)
