"""Settings of our fit, apart from it: help reads them without torch."""

from dataclasses import dataclass
from typing import Any

from brokk_min.fit import FitConfig


@dataclass(frozen=True)
class OurFitConfig(FitConfig):
    """How the nets are fitted: the settings of `fit`, and those of `beyond`."""

    weight_decay: float = 0.0  # 0.3 for logs of a few minutes
    rollout: int = 8  # ticks of the errors in the last third of the steps (paper: 1)
    valve: bool = True  # --no-valve: nets read commands as they are, not what these open (paper)
    members: int = 5  # such nets a joint, 1 of others; their mean counts (beyond.net_ensemble)
    newest_only: bool = False  # do they read commands and the newest angle and velocity alone?


PAPER_RECIPE: dict[str, Any] = {"rollout": 1, "valve": False, "members": 1}
"""Sec. 3.3: errors of one step, commands as they are."""
