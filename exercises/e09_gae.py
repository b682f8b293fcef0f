"""Advantages: a time limit is no failure, and a baseline is no bias (75 minutes).

Generalised advantage estimation (Schulman et al., 2016) sums the surprises of a critic V:

    delta_t = r_t + gamma V(s_{t+1}) - V(s_t)
    A_t = delta_t + gamma lambda A_{t+1}

An episode ends in one of two ways. If it terminated, there is no s_{t+1}, and its value is 0. If a
time limit truncated it, the machine could have gone on, so the value of its own last observation
counts. In both cases the next row belongs to a new episode, and its advantage must not leak in.

Who treats a time limit as a termination teaches the critic that the world ends after 20 s, at a
moment that the observation does not show (Pardo et al., 2018, arXiv 1712.00378). Widely used
learners had this error, or the leak; skrl has had both (its issue 449).

A critic is one baseline; the mean of other rollouts from the same state is another. It leaves the
mean of the policy gradient as it is only if it does not depend on the action that it judges. So a
rollout is compared with the mean of the *others* of its group (leave one out).
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from hypothesis import strategies as st

from brokk_min import ppo
from brokk_min.machine import Array
from exercises.verdict import agree, expect

SOLUTION = "brokk_min/ppo.py: gae, critic_advantages"


def gae(
    rewards: Array,
    values: Array,
    next_values: Array,
    terminated: Array,
    truncated: Array,
    gamma: float,
    lam: float,
) -> Array:
    """Advantages A_t (T,). All arrays are (T,), flags are 0 or 1.

    `values` are V(s_t). `next_values` are V of what came after each tick. At the end of an episode
    that is its own last observation, whether it terminated or not.
    """
    raise NotImplementedError


def group(returns: Array) -> Array:
    """Advantages (groups, members): each return less the mean of the others of its group."""
    raise NotImplementedError


def ours(*case: Any) -> Array:
    """The package's answer to the arguments of `gae`."""
    rewards, values, next_values, terminated, truncated, gamma, lam = case
    next_values = next_values * (1 - terminated)
    dones = np.maximum(terminated, truncated)
    arrays = (torch.tensor(x)[:, None] for x in (rewards, values, next_values, dones))
    return ppo.gae(*arrays, gamma, lam)[:, 0].numpy()


def check_group(group: Callable[[Array], Array]) -> None:
    """By hand; then the gradient by mu of E[100 + a], a from N(mu, 1), which is 1."""
    got = group(np.array([[1.0, 2.0, 6.0], [5.0, 5.0, 5.0]]))
    why = "The others of 1 are 2 and 6, of mean 4."
    expect("group([[1, 2, 6], [5, 5, 5]])", got, [[-3.0, -1.5, 4.5], [0, 0, 0]], why)
    noise = np.random.default_rng(0).standard_normal((20_000, 4))  # a - mu, the score
    for name, advantages in (("no baseline", 100 + noise), ("yours", group(100 + noise))):
        gradients = (advantages * noise).mean(axis=-1)
        print(f"{name:12} gradient {gradients.mean():5.2f}, deviation {gradients.std():6.2f}")
    why = "The mean of the gradients is 1, whatever the baseline."
    expect("mean gradient, by groups of four", round(float(gradients.mean()), 1), 1.0, why)


def check(gae: Callable[..., Array], group: Callable[[Array], Array]) -> None:
    """A reward of 1 a tick for ever, worth 10 at gamma 0.9; then anything."""
    one, no = np.ones(3), np.zeros(3)
    end = np.array([0.0, 1.0, 0.0])  # the second tick ends an episode
    exact = one, 10 * one, 10 * one
    got = gae(*exact, no, no, 0.9, 0.5)
    expect("no end, an exact critic", got, no, "1 + 0.9 * 10 - 10 = 0: no surprise.")
    why = "A time limit changes nothing about what would have come: no surprise."
    expect("truncated, an exact critic", gae(*exact, no, end, 0.9, 0.5), no, why)
    why = "delta_1 = 1 - 10. The tick before sees 0.9 * 0.5 of it, the tick after none."
    expect("terminated, an exact critic", gae(*exact, end, no, 0.9, 0.5), [-4.05, -9.0, 0.0], why)
    got = gae(one, no, no, no, end, 0.9, 0.5)
    why = "At a truncation the sum over later ticks stops: they are of another episode."
    expect("truncated, a critic of zero", got, [1.45, 1.0, 1.0], why)
    number = st.integers(-4, 4).map(float)
    ending = st.sampled_from([(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)])
    ticks = st.lists(st.tuples(number, number, number, ending), min_size=1, max_size=4)
    cases = ticks.map(
        lambda rows: (
            *np.array([row[:3] for row in rows]).T,
            *np.array([row[3] for row in rows]).T,
            0.5,
            0.5,
        )
    )
    agree("gae", gae, ours, cases)
    check_group(group)
