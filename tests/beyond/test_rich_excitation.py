"""Rich excitation: its parts."""

import numpy as np

from brokk_min.beyond.rich_excitation import rich_command
from brokk_min.machine import BROKK_170


def test_rich_command__has_pauses_jumps_and_holds_and_the_requested_length():
    rng = np.random.default_rng(0)
    parts = [rich_command(rng, BROKK_170, 600) for _ in range(40)]
    assert all(part.shape == (600,) for part in parts)
    u = np.concatenate(parts)
    assert 0.05 < np.mean(u == 0) < 0.4  # pauses
    assert np.sum(np.abs(np.diff(u)) > 0.5) > 50  # jumps
    assert np.mean((np.diff(u) == 0) & (u[1:] != 0)) > 0.1  # holds
