"""Settings of our agent and of the paper's. It imports no torch, so that `--help` is quick."""

from dataclasses import dataclass, replace

from brokk_min.settings import PPOConfig, TaskConfig


@dataclass(frozen=True)
class Recipe:
    """An agent, its task, and how it learns."""

    interface: str  # its name in `policy.INTERFACES`
    critic: bool  # advantages by a critic, as in the paper, or by `beyond.group_advantages`
    task: TaskConfig
    learner: PPOConfig
    muon: bool = False  # steps of the actor by `beyond.muon`, not by Adam


def find_recipe(paper: bool = False, critic: bool = False) -> Recipe:
    """The recipe of our agent or of the paper's, with advantages by groups or by a critic."""
    task = TaskConfig() if paper else TaskConfig(hold_min_s=0.5, hold_max_s=3.0)
    learner = PPOConfig(40_000_000, gamma=0.95, gae_lambda=1.0, log_std=-2.0, log_std_end=-4.5)
    learner = replace(learner, learning_rate=2e-3, target_kl=0.06)
    if critic:
        learner = PPOConfig()
    elif not paper:
        learner = replace(learner, total_steps=5_000_000, horizon=12, minibatch_size=1024)
        learner = replace(learner, gamma=0.94)
    return Recipe("paper" if paper else "beyond", critic, task, learner, muon=not critic)
