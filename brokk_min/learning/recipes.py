"""Agents and how they learn: ours and the paper's, without torch."""

from dataclasses import dataclass

from brokk_min.settings import PPOConfig, TaskConfig


@dataclass(frozen=True)
class Recipe:
    """An agent, its task, and how it learns."""

    interface: str  # its name in `policy.INTERFACES`
    critic: bool  # advantages by a critic, as in the paper, or by `beyond.group_advantages`
    task: TaskConfig
    learner: PPOConfig


def find_recipe(paper: bool = False, critic: bool = False) -> Recipe:
    """The settings of an agent: ours or the paper's, which learns by groups or by a critic."""
    task = TaskConfig() if paper else TaskConfig(hold_min_s=0.5, hold_max_s=3.0)
    learner = PPOConfig()
    if not critic:
        learner = PPOConfig(
            total_steps=80_000_000 if paper else 12_000_000,
            minibatch_size=2048 if paper else 1024,
            gamma=0.95 if paper else 0.94,
            gae_lambda=1.0,
            log_std_end=-4.2 if paper else -4.0,
        )
    return Recipe("paper" if paper else "beyond", critic, task, learner)
