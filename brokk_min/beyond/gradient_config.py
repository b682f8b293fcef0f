"""Settings of `simulation_gradient`, apart from it: help reads them without torch."""

from dataclasses import dataclass


@dataclass(frozen=True)
class GradientConfig:
    """Settings of the learner, all tuned on goals that are not scored."""

    total_steps: int = 2_000_000  # environment steps in all
    num_envs: int = 256  # environments side by side (paper: 256)
    horizon: int = 32  # ticks of each environment between two updates
    epochs: int = 2  # passes over the collected steps in each update
    minibatch_size: int = 512  # steps in one gradient
    learning_rate: float = 4e-3  # of Adam, at the start; falls to zero
    gamma: float = 0.95  # discount a tick
    max_grad_norm: float = 1.0  # gradients are scaled down to this norm
    log_std: float = -2.5  # log of the actions' deviation at the start
    log_std_end: float = -4.5  # at the end; linear in between
