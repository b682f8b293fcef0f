"""Agents and how they learn: ours and the paper's, without torch."""

from dataclasses import dataclass, replace

from brokk_min.settings import PPOConfig, TaskConfig


@dataclass(frozen=True)
class Recipe:
    """An agent, its task, and how it learns."""

    interface: str  # its name in `policy.INTERFACES`
    critic: bool  # advantages by a critic, as in the paper, or by `beyond.group_advantages`
    muon: bool  # steps of the actor by `beyond.muon`, or by Adam
    task: TaskConfig
    learner: PPOConfig


def find_recipe(paper: bool = False, critic: bool = False) -> Recipe:
    """The settings of an agent: ours or the paper's, which learns by groups or by a critic."""
    task = TaskConfig() if paper else TaskConfig(hold_min_s=0.5, hold_max_s=3.0)
    learner = PPOConfig()
    if not critic and paper:
        learner = PPOConfig(80_000_000, gamma=0.95, gae_lambda=1.0, log_std_end=-4.2)
    elif not critic:
        learner = PPOConfig(10_000_000, gamma=0.94, gae_lambda=1.0, log_std_end=-4.0)
        learner = replace(learner, learning_rate=2e-3, target_kl=0.06)
    muon = not (paper or critic)
    return Recipe("paper" if paper else "beyond", critic, muon, task, learner)
