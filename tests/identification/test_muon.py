"""Muon against the singular value decomposition, and AdamW where it is AdamW."""

import pytest
import torch

from brokk_min.identification.muon import Muon, orthogonalise


@pytest.mark.parametrize("shape", [(6, 4), (4, 6), (5, 5), (3, 8, 4), (4, 1)])
def test_orthogonalise__brings_singular_values_near_1_and_keeps_their_vectors(shape):
    M = torch.randn(shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    U, S, Vh = torch.linalg.svd(M, full_matrices=False)
    core = U.mT @ orthogonalise(M) @ Vh.mT  # diagonal: the vectors are the same
    values = torch.diagonal(core, dim1=-2, dim2=-1)
    torch.testing.assert_close(core, torch.diag_embed(values), atol=1e-6, rtol=0)
    # p(p(p(s))), p(s) = 3.4445 s - 4.7750 s^3 + 2.0315 s^5, of s relative to the Frobenius norm
    s = S / torch.linalg.norm(S, dim=-1, keepdim=True)
    for _ in range(3):
        s = 3.4445 * s - 4.7750 * s**3 + 2.0315 * s**5
    torch.testing.assert_close(values, s, atol=1e-5, rtol=0)
    assert values.max() < 1.25
    assert values[0.05 * torch.linalg.norm(S, dim=-1, keepdim=True) < S].min() > 0.5


def test_step__moves_matrices_by_muon_and_vectors_as_adamw():
    generator = torch.Generator().manual_seed(1)
    start = [torch.randn(shape, generator=generator) for shape in [(4, 3), (2, 5, 3), (3,)]]
    grads = [torch.randn(weight.shape, generator=generator) for weight in start]
    ours = [weight.clone().requires_grad_() for weight in start]
    theirs = start[2].clone().requires_grad_()
    muon = Muon(ours, lr=0.01, weight_decay=0.1, muon=2.0)
    adamw = torch.optim.AdamW([theirs], lr=0.01, weight_decay=0.1)
    for scale in (1.0, -3.0):
        for weight, grad in zip([*ours, theirs], [*grads, grads[2]], strict=True):
            weight.grad = scale * grad
        muon.step()
        adamw.step()
    torch.testing.assert_close(ours[2], theirs)
    for weight, begin, grad in zip(ours[:2], start[:2], grads[:2], strict=True):
        # momenta 0.05 g and 0.95 (0.05 g) - 0.05 (3 g), and Nesterov's look ahead: + g, then - g
        decayed = 0.999 * (0.999 * begin - 0.02 * orthogonalise(grad))
        torch.testing.assert_close(weight.detach(), decayed + 0.02 * orthogonalise(grad))


def test_step__of_stacks_leaves_each_joint_alone():
    """Weights (n, rows, columns) and biases (n, columns), of joints that do not share."""

    def steps(scale):
        weights = [torch.ones(3, 4, 2).requires_grad_(), torch.ones(3, 2).requires_grad_()]
        optimizer = Muon(weights, lr=0.01, stacks=True)
        generator = torch.Generator().manual_seed(2)
        for _ in range(3):
            for weight in weights:
                weight.grad = torch.randn(weight.shape, generator=generator)
                weight.grad[1:] *= scale
            optimizer.step()
        return weights

    for one, other in zip(steps(1.0), steps(-5.0), strict=True):
        assert torch.equal(one[0], other[0])
        assert not torch.equal(one[1], other[1])
