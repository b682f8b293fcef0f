"""Agents and how they learn: ours and the paper's, without torch."""

from dataclasses import dataclass, field

from brokk_min.beyond.gradient_config import GradientConfig
from brokk_min.settings import PPOConfig, TaskConfig


@dataclass(frozen=True)
class Recipe:
    """An agent and how it learns; the defaults are ours."""

    interface: str = "beyond"
    task: TaskConfig = field(default_factory=lambda: TaskConfig(hold_min_s=0.5, hold_max_s=3.0))
    learner: GradientConfig | PPOConfig = field(default_factory=GradientConfig)


def paper_recipe() -> Recipe:
    """The paper's agent, PPO with a critic; its goals hold longer (assumed)."""
    return Recipe("paper", TaskConfig(), PPOConfig())
