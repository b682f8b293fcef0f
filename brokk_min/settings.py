"""Settings of the task and of PPO."""

from dataclasses import dataclass


@dataclass(frozen=True)
class TaskConfig:
    """What an episode is. Paper: Sec. 3.4; the numbers are assumed unless they name the paper."""

    episode_s: float = 20.0  # length of an episode [s]
    hold_min_s: float = 2.0  # shortest time of a velocity goal [s]
    hold_max_s: float = 6.0  # longest time [s]
    zero_goals: float = 0.15  # fraction of goals of zero velocity
    axis_goals: float = 0.4  # fraction along x, y or z; others anywhere
    noise: float = 0.05  # uniform, up to +- this many deviations (paper: 5 %)


@dataclass(frozen=True)
class PPOConfig:
    """Settings of PPO, tuned; the paper prints the number of environments only."""

    # Those of the paper's learner; `learning.recipes` has those of others.

    total_steps: int = 30_000_000  # environment steps in all
    num_envs: int = 256  # environments side by side (paper: 256)
    horizon: int = 32  # ticks of each environment between two updates
    epochs: int = 2  # passes over the collected steps in each update
    minibatch_size: int = 2048  # steps in one gradient
    learning_rate: float = 1.2e-3  # at most; falls linearly to zero
    target_kl: float = 0.03  # KL divergence an update, to which the learning rate is steered
    gamma: float = 0.9  # discount a tick: 0.9 looks 10 ticks ahead
    gae_lambda: float = 0.95  # weight of longer returns in the advantage
    clip: float = 0.2  # largest rewarded change of a probability ratio
    max_grad_norm: float = 1.0  # gradients are scaled down to this norm
    log_std: float = -1.2  # log of the actions' deviation at the start
    log_std_end: float | None = None  # at the end, linear in between; None: it is learned
