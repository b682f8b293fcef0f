"""The task as Gymnasium environments; tables of observation, action and reward are in `env`.

Importing this module registers them, and Gymnasium can import it by the name of the environment:

    gymnasium.make("brokk_min.learning.gym_env:brokk_min/Brokk170-v0", render_mode="rgb_array")
    gymnasium.make_vec("brokk_min.learning.gym_env:brokk_min/Brokk170-v0", num_envs=256)
"""

from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from brokk_min import env
from brokk_min.actuator import PLANT, Plant
from brokk_min.env import PAPER, Bools, Interface
from brokk_min.machine import BROKK_170, Array, Machine, require
from brokk_min.settings import TaskConfig

TASK = TaskConfig()


class TaskVectorEnv(VectorEnv[Array, Array, Any]):
    """`env.reset` and `env.step` as Gymnasium's vector environment. Paper: Fig. 4

    `info["velocity_error"]` is |v_goal - v_tool| [m/s], and `info["new_goal"]` says where the goal
    has changed since. Gymnasium explains `AutoresetMode.SAME_STEP` and `info["final_obs"]`.
    `max_episode_steps` counts ticks and stands for the seconds of `config`. "rgb_array" renders the
    first machine. ValueError: a number that is not positive.
    """

    episodes: env.Episodes  # from the first reset on
    one_tick = staticmethod(env.step)

    def __init__(
        self,
        num_envs: int,
        plant: Plant = PLANT,
        machine: Machine = BROKK_170,
        config: TaskConfig = TASK,
        interface: Interface = PAPER,
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
    ) -> None:
        require(num_envs > 0, "num_envs", "1 or more", num_envs)
        if max_episode_steps is not None:
            require(max_episode_steps > 0, "max_episode_steps", "1 or more", max_episode_steps)
            config = replace(config, episode_s=max_episode_steps / machine.rate)
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": round(machine.rate)}
        self.metadata |= {"autoreset_mode": AutoresetMode.SAME_STEP}
        self.num_envs, self.render_mode = num_envs, render_mode
        self.task = env.Task(machine, plant, config, interface)
        mean, _ = interface.scale(machine)
        self.single_observation_space = Box(-np.inf, np.inf, mean.shape, np.float32)
        self.single_action_space = Box(-1.0, 1.0, (len(machine.driven),), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Draw new episodes for all machines."""
        super().reset(seed=seed)
        self.episodes = env.reset(self.task, self.np_random, self.num_envs)
        return self.episodes.obs, {}

    def step(self, actions: Array) -> tuple[Array, Array, Bools, Bools, dict[str, Any]]:
        """One tick of all machines under actions (num_envs, n_driven)."""
        require(hasattr(self, "episodes"), "step", "a reset before the first step", "none")
        now = self.task, self.np_random, self.episodes, np.asarray(actions)
        self.episodes, reward, terminated, truncated, info = self.one_tick(*now)
        return self.episodes.obs, reward, terminated, truncated, info

    def render(self) -> tuple[NDArray[np.uint8], ...]:
        """A picture of the first machine (height, width, 3), with goal and tool velocity."""
        from brokk_min.viewer.drawing import Scene, draw

        machine, s = self.task.machine, self.episodes.state
        scene = Scene(s.q[0], s.history[0, :, 2, -1], s.v_goal[0], s.v_tool[0], title=machine.name)
        return (np.array(draw(machine, scene, (640, 360))),)


class TaskEnv(gymnasium.Env[Array, Array]):
    """One machine, which the caller resets: a `TaskVectorEnv` of one, by its options."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012

    def __init__(self, *arguments: Any, **options: Any) -> None:
        self.vector = TaskVectorEnv(1, *arguments, **options)
        self.vector.one_tick = env.tick
        self.metadata, self.render_mode = self.vector.metadata, self.vector.render_mode
        self.observation_space = self.vector.single_observation_space
        self.action_space = self.vector.single_action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Draw a new episode."""
        super().reset(seed=seed)
        self.vector.np_random = self.np_random
        obs, info = self.vector.reset()
        return obs[0], info

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """One tick under the action (n_driven,)."""
        obs, reward, terminated, truncated, info = self.vector.step(np.asarray(action)[None])
        info = {name: value[0] for name, value in info.items()}
        return obs[0], float(reward[0]), bool(terminated[0]), bool(truncated[0]), info

    def render(self) -> Any:
        """The present picture (height, width, 3)."""
        return self.vector.render()[0]


gymnasium.register(
    "brokk_min/Brokk170-v0",
    entry_point="brokk_min.learning.gym_env:TaskEnv",
    vector_entry_point="brokk_min.learning.gym_env:TaskVectorEnv",
)
