"""Advantages from groups of rollouts, instead of a critic.

What it changes: machines stand in groups of four. They begin each window of `horizon` ticks in the
same state, with the same goals and the same sensor noise to come. Only the noise of their actions
differs, so what a machine's return is above the mean of its group is due to its own actions of the
window:

    A_t = R_t - mean of R_t in the group,   R_t = r_t + gamma lambda R_{t+1},

clipped at four standard deviations of all advantages; lambda is 1 in `learning.recipes`. Copies
share a state in the first tick of a window alone: later A_t also credits an action for where the
earlier ones had brought its copy. The sum R stops where the goal changes and where the window ends:
of the weight of the discount, 1 / (1 - gamma), a window cuts on average 68 % (12 ticks, gamma =
0.94, ours) or 48 % (32 ticks, 0.95, with the paper's observation), and in its last ticks no valve
answers before it ends. `benchmarks.deviations d8` measures what part of the variance of A_t is
due to a_t. Then all four go on as one of them.

What it buys: after one million steps of the paper's agent on nets as printed the mean velocity
error of the tool along x, y and z is 0.0372 m/s by groups and 0.0507 m/s by a critic (means of
three seeds, `benchmarks.ladder`).

Who was first: the vine of TRPO (Schulman et al., 2015) branches rollouts from one state with common
random numbers; RLOO (Kool et al., 2019) takes the mean of a group's others as the baseline, and
GRPO (Shao et al., 2024) that of the group.

It plugs into `ppo.train` as its advantage function, and around its environment.
"""

from typing import Any

import numpy as np
import torch
from gymnasium.vector import VectorWrapper
from numpy.typing import NDArray
from torch import Tensor

from brokk_min import ppo
from brokk_min.env import Bools, Draw, State, Task, map_arrays
from brokk_min.machine import Array, require
from brokk_min.settings import PPOConfig

COPIES = 4  # machines in a group; neighbours in each array
CUT = 4.0  # deviations of all advantages, to which they are cut


class GroupTask(Task):
    """A task whose machines share starts, goals, noise and ends with the others of their group."""

    def draw(self, what: Draw, rng: np.random.Generator, num: int) -> NDArray[Any]:
        """One draw for each group."""
        return super().draw(what, rng, num // COPIES).repeat(COPIES, axis=0)

    def ends(self, state: State) -> tuple[Bools, Bools]:
        """Terminated and truncated (num,), where any of the group is."""
        ends = np.reshape(super().ends(state), (2, -1, COPIES)).any(axis=-1)
        terminated, truncated = ends.repeat(COPIES, axis=-1)
        return terminated, truncated & ~terminated


class GroupVectorEnv(VectorWrapper[Any, Any, Any]):
    """Groups in an environment of `learning.gym_env`; after a window they go on as one of them.

    Windows of `horizon` ticks end truncated; their own last observations are in
    `info["final_obs"]`. ValueError: the machines are no multiple of `COPIES`.
    """

    def __init__(self, env: Any, horizon: int) -> None:
        super().__init__(env)
        require(env.num_envs % COPIES == 0, "num_envs", f"a multiple of {COPIES}", env.num_envs)
        self.inner = env.unwrapped
        self.inner.task = GroupTask(**vars(self.inner.task))
        self.horizon, self.ticks = horizon, 0

    def step(self, actions: Array) -> tuple[Array, Array, Bools, Bools, dict[str, Any]]:
        """One tick; after the last of a window all of a group go on from one of them."""
        obs, reward, terminated, truncated, info = self.env.step(actions)
        self.ticks += 1
        if self.ticks % self.horizon == 0:
            groups = np.arange(0, self.num_envs, COPIES)
            rows = (groups + self.inner.np_random.integers(0, COPIES, len(groups))).repeat(COPIES)
            info = {"final_obs": obs} | info | {"_final_obs": np.ones_like(terminated)}
            truncated = ~terminated
            self.inner.episodes = map_arrays(lambda values: values[rows], self.inner.episodes)
        return self.inner.episodes.obs, reward, terminated, truncated, info


def group_advantages(
    agent: ppo.Agent, rollout: ppo.Rollout, config: PPOConfig
) -> tuple[Tensor, None]:
    """Advantages (T, num) of a rollout of `GroupVectorEnv`; nothing for a critic to learn."""
    changed = torch.from_numpy(np.stack([info["new_goal"] for info in rollout.infos]))
    zero = torch.zeros_like(rollout.rewards)
    ends = (rollout.dones | changed).float()  # a new goal is no result of earlier actions
    returns = ppo.gae(rollout.rewards, zero, zero, ends, config.gamma, config.gae_lambda)
    groups = returns.reshape(len(returns), -1, COPIES)
    advantages = (groups - groups.mean(dim=-1, keepdim=True)).flatten(1)
    limit = CUT * advantages.std()
    return advantages.clamp(-limit, limit), None
