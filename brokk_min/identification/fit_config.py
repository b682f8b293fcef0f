"""Settings of the fit, apart from it: help reads them without torch."""

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class FitConfig:
    """How the nets are fitted."""

    steps: int = 16_000  # 5,000 are enough for logs of a few minutes
    batch_size: int = 512  # windows of each joint in a step
    learning_rate: float = 4e-3  # of Adam; falls to zero twice, by a cosine
    weight_decay: float = 0.0  # 0.3 for logs of a few minutes
    hidden: int = 32  # units in each of the two hidden layers (paper: 32)
    rollout: int = 8  # ticks of the errors in the last third of the steps (paper: 1)
    valve: bool = True  # do the nets read what a command opens (beyond.valve_nets)? (paper: no)
    members: int = 5  # such nets a joint, 1 of others; their mean counts (beyond.net_ensemble)
    newest_only: bool = False  # do they read commands and the newest angle and velocity alone?


PAPER_RECIPE: dict[str, Any] = {"rollout": 1, "valve": False, "members": 1}
"""Sec. 3.3: errors of one step, commands as they are."""
