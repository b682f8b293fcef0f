"""Muon, an optimiser of matrices: MomentUm, Orthogonalised by Newton-Schulz iterations.

Adam scales the step of each weight by itself. Muon takes the momentum M = U S V^T of a whole matrix
and steps along U V^T, so every direction of the matrix learns at the same rate, also those that
the gradient hardly shows. Here it needs about a third of Adam's steps and half of its time to the
same error, for nets and for policies (docs/deviations.md, D17). Jordan et al., 2024
(kellerjordan.github.io/posts/muon); Bernstein and Newhouse, 2024 (arXiv 2409.20325): steepest
descent under the spectral norm.
"""

import torch
from torch import Tensor
from torch.optim.optimizer import ParamsT

MOMENTUM = 0.95
ITERATIONS = 3  # of Newton-Schulz; Jordan has 5
A, B, C = 3.4445, -4.7750, 2.0315  # of Jordan's polynomial


class Muon(torch.optim.AdamW):
    """Muon for matrices, AdamW for vectors as biases; also for stacks of both, one for each joint.

    It takes AdamW's place, in the fit and in `ppo.Learner`. A matrix moves by `muon` learning
    rates. Weights decay as AdamW's do. `stacks`: each parameter is a stack, matrices (n, rows,
    columns) and vectors (n, columns).
    """

    def __init__(
        self,
        params: ParamsT,
        lr: float,
        weight_decay: float = 0.0,
        muon: float = 5.0,
        stacks: bool = False,
    ) -> None:
        super().__init__(params, lr=lr, weight_decay=weight_decay)
        self.muon = muon
        self.dimensions = 3 if stacks else 2  # of matrices

    @torch.no_grad()
    def step(self) -> None:  # type: ignore[override]
        """One step by the gradients `grad`; those of matrices are used up."""
        for group in self.param_groups:
            for weight in group["params"]:
                if weight.ndim < self.dimensions or weight.grad is None:
                    continue
                state = self.state[weight]  # under AdamW's names, which its loading wants
                if not state:
                    state |= {"step": torch.zeros(()), "exp_avg": torch.zeros_like(weight)}
                state["step"] += 1
                momentum = state["exp_avg"].lerp_(weight.grad, 1 - MOMENTUM)
                ahead = weight.grad.lerp(momentum, MOMENTUM)  # Nesterov's
                weight.mul_(1 - group["lr"] * group["weight_decay"])
                weight.sub_(self.muon * group["lr"] * orthogonalise(ahead))
                weight.grad = None  # nothing is left for AdamW
        super().step()


def orthogonalise(M: Tensor) -> Tensor:
    """Towards U V^T of M = U S V^T, (..., rows, columns).

    X <- a X + b (X X^T) X + c (X X^T)^2 X maps each singular value s to a s + b s^3 + c s^5. All
    come to 0.5 to 1.25, but for tiny ones.
    """
    X: Tensor = M / (torch.linalg.matrix_norm(M, keepdim=True) + 1e-7)
    if M.shape[-2] > M.shape[-1]:
        return orthogonalise(M.mT).mT
    for _ in range(ITERATIONS):
        gram = X @ X.mT
        X = A * X + (B * gram + C * gram @ gram) @ X
    return X
