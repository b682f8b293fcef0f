"""The clipped loss, and which samples it silences (30 minutes).

PPO (Schulman et al., 2017) takes several steps on the same data. The new probability of an action,
divided by the old one, says how far the policy has moved. The loss of a batch of such ratios is

    L = -E[min(ratio A, clip(ratio, 1 - eps, 1 + eps) A)]

The minimum makes it pessimistic. A good action (A > 0) counts until its ratio is 1 + eps, a bad one
until it is 1 - eps. On the other side nothing is clipped: a mistake can always be taken back. This
asymmetry is lost in code that takes the clipped ratio alone, or the maximum.

Write the loss, and say for which samples it has a derivative by the ratio other than zero.
"""

from collections.abc import Callable

import numpy as np
import torch
from hypothesis import strategies as st

from brokk_min import ppo
from brokk_min.machine import Array
from exercises.verdict import agree, expect

SOLUTION = "brokk_min/ppo.py: policy_loss"


def loss(ratio: Array, advantages: Array, eps: float) -> float:
    """L of ratios and advantages (B,)."""
    raise NotImplementedError


def counts(ratio: Array, advantages: Array, eps: float) -> Array:
    """For each sample: has L a derivative by its ratio other than zero? bool (B,)."""
    raise NotImplementedError


def our_loss(ratio: Array, advantages: Array, eps: float) -> float:
    """The package's answer."""
    return float(ppo.policy_loss(torch.tensor(ratio), torch.tensor(advantages), eps))


def our_counts(ratio: Array, advantages: Array, eps: float) -> Array:
    """The same by automatic differentiation."""
    tensor = torch.tensor(ratio, requires_grad=True)
    ppo.policy_loss(tensor, torch.tensor(advantages), eps).backward()
    return (tensor.grad != 0).numpy()


def check(loss: Callable[..., float], counts: Callable[..., Array]) -> None:
    """The four corners by hand, then anything."""
    ratio = np.array([0.5, 1.5, 0.5, 1.5])
    advantages = np.array([1.0, 1.0, -1.0, -1.0])
    why = "The smaller of the two: 0.5, 1.2, -0.8, -1.5. Their mean, with the sign changed."
    expect("loss of the four corners", loss(ratio, advantages, 0.2), 0.15, why)
    why = "Only moves that go further the same way are cut off."
    wanted = [True, False, False, True]
    expect("counts of the four corners", counts(ratio, advantages, 0.2), wanted, why)
    number = st.integers(1, 19).map(lambda i: i / 10 + 0.05)  # not where the derivative jumps
    advantage = st.integers(-4, 4).filter(bool).map(float)
    batches = st.lists(st.tuples(number, advantage), min_size=1, max_size=4)
    cases = batches.map(lambda rows: (*np.array(rows).T, 0.2))
    agree("loss", loss, our_loss, cases)
    agree("counts", counts, our_counts, cases)
