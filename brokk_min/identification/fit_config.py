"""Settings of the fit, apart from it: the command line reads them without torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from brokk_min.machine import check_numbers, number


@dataclass(frozen=True)
class FitConfig:
    """How the nets are fitted."""

    steps: int = number("steps", 0, 10**12, 16000)  # 5000 for logs of a few minutes.
    batch_size: int = number("1", 1, 10**6, 512)  # Windows per joint in each step.
    learning_rate: float = number("1", 1e-9, 1, 4e-3)  # Falls to zero twice, by a cosine.
    weight_decay: float = number("1", 0, 100, 0.0)  # 0.3 for logs of a few minutes.
    noise: float = number("1", 0, 1000, 0.1)  # Of velocity inputs, in their deviations.
    hidden: int = number("1", 1, 10**4, 32)  # Units in each of the two hidden layers (paper: 32).
    history: int = number("samples", 2, 1000, 13)  # Of angle, velocity and command (paper: 13).
    rollout: int = number("ticks", 1, 10**6, 8)  # Of the errors in the last third (paper: 1).
    muon: float = number("1", 0, 1000, 5.0)  # Muon's step, in learning rates; 0: Adam (paper).
    shared: int = number("1", 0, 1000, 0)  # Latents of all joints' inputs: 4 for a pump and weight.
    dead_zone: float | None = number("1", 0, 0.99, None)
    """Command within which no valve opens; by default the known machine's, else 0."""
    output_lags: int | None = number("samples", 0, 1000, None)
    """Newest velocities and angles that nets read (paper: all); 0: the newest angle alone."""
    __post_init__ = check_numbers  # type: ignore[misc]

    @property
    def indicator(self) -> bool:
        """Do the nets read `actuator.open_indicator`? The paper's, without a dead zone, do not."""
        return bool(self.dead_zone)


PAPER_RECIPE: dict[str, Any] = {"noise": 0.0, "rollout": 1, "dead_zone": 0.0, "muon": 0.0}
PAPER_RECIPE |= {"output_lags": None}
"""Sec. 3.3"""
STEP_RECIPE: dict[str, Any] = {"steps": 3000, "weight_decay": 0.3, "noise": 1.0, "output_lags": 1}
"""Tuned for logs of step responses, see `inspection.has_steps_alone`: docs/deviations.md, D19."""
