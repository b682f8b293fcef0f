"""Advantages: a time limit is no failure (60 minutes).

Generalised advantage estimation (Schulman et al., 2016) sums the surprises of a critic V:

    delta_t = r_t + gamma V(s_{t+1}) - V(s_t)
    A_t = delta_t + gamma lambda A_{t+1}

An episode ends in one of two ways. It terminated: there is no s_{t+1}, its value is 0. Or it was
truncated by a time limit: the machine could have gone on, so the value of its own last observation
counts. In both cases the next row belongs to a new episode, and its advantage must not leak in.

Who treats a time limit as a termination teaches the critic that the world ends after 20 s, at a
moment that the observation does not show (Pardo et al., 2018, arXiv 1712.00378). Widely used
learners had this error, and its reverse, the leak; skrl has had both (its issue 449).
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


def ours(*case: Any) -> Array:
    """The package's answer to the arguments of `gae`."""
    rewards, values, next_values, terminated, truncated, gamma, lam = case
    next_values = next_values * (1 - terminated)
    dones = np.maximum(terminated, truncated)
    arrays = (torch.tensor(x)[:, None] for x in (rewards, values, next_values, dones))
    return ppo.gae(*arrays, gamma, lam)[:, 0].numpy()


def check(gae: Callable[..., Array]) -> None:
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
