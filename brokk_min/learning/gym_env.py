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
from brokk_min.env import PAPER, Interface, State, measure
from brokk_min.learning.episodes import draw_noise, map_arrays, new_goals, replace_rows, reset
from brokk_min.machine import BROKK_170, Array, Machine, require
from brokk_min.settings import TaskConfig

Bools = NDArray[np.bool_]
Step = tuple[Array, Array, Bools, Bools, dict[str, Any]]  # of a vector: obs, reward, ends, info
TASK = TaskConfig()


class TaskVectorEnv(VectorEnv[Array, Array, Any]):
    """Many machines that follow random tool velocities. Paper: Fig. 4

    `info["velocity_error"]` is |v_goal - v_tool| [m/s], and `info["new_goal"]` says where the goal
    has changed since. Gymnasium explains `AutoresetMode` and `info["final_obs"]`; its vector
    wrappers of observations accept NEXT_STEP. `max_episode_steps` counts ticks and stands for the
    seconds of `config`. "rgb_array" renders the first machine. ValueError: a wrong argument.
    """

    copies = 1  # neighbours that share starts, goals, noise and ends: `beyond.group_advantages`
    state: State
    memory: Any  # of the agent
    obs: Array

    def __init__(
        self,
        num_envs: int,
        plant: Plant = PLANT,
        machine: Machine = BROKK_170,
        config: TaskConfig = TASK,
        interface: Interface = PAPER,
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        max_episode_steps: int | None = None,
    ) -> None:
        require(num_envs > 0, "num_envs", "1 or more", num_envs)
        require(isinstance(machine, Machine), "machine", "a Machine", machine)
        require(isinstance(config, TaskConfig), "config", "a TaskConfig", config)
        require(hasattr(plant, "step"), "plant", "reset and step", plant)
        if max_episode_steps is not None:
            require(max_episode_steps > 0, "max_episode_steps", "1 or more", max_episode_steps)
            config = replace(config, episode_s=max_episode_steps / machine.rate)
        self.mode = AutoresetMode(autoreset_mode)
        self.metadata = TaskEnv.metadata | {"autoreset_mode": self.mode}
        self.metadata["render_fps"] = round(machine.rate)
        self.num_envs, self.plant, self.machine, self.config = num_envs, plant, machine, config
        self.interface, self.render_mode = interface, render_mode
        mean, _ = interface.scale(machine)
        self.single_observation_space = Box(-np.inf, np.inf, mean.shape, np.float32)
        self.single_action_space = Box(-1.0, 1.0, (len(machine.driven),), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.waiting = np.zeros(num_envs, bool)  # episodes that begin in the next step

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Draw new episodes for all machines, or where the option `reset_mask` is true."""
        super().reset(seed=seed)
        mask = (options or {}).get("reset_mask")
        mask = np.ones(self.num_envs, bool) if mask is None else np.asarray(mask)
        fits = mask.shape == (self.num_envs,) and mask.dtype == bool
        fits = fits and bool(mask.any()) and (bool(mask.all()) or hasattr(self, "state"))
        require(fits, "reset_mask", f"{self.num_envs} booleans", f"{mask.dtype} {mask.shape}")
        self.begin_episodes(mask)
        return self.obs, {}

    def begin_episodes(self, mask: Bools) -> None:
        """Draw new episodes where `mask` is true; others go on."""
        rows = np.flatnonzero(mask)
        num = len(rows) // self.copies
        state = reset(self.machine, self.config, self.np_random, num, self.plant)
        state = map_arrays(lambda array: array.repeat(self.copies, axis=0), state)
        fresh = state, *self.observe(state, None)
        if len(rows) < self.num_envs:
            fresh = replace_rows((self.state, self.obs, self.memory), rows, fresh)
        self.state, self.obs, self.memory = fresh
        self.waiting = self.waiting & ~mask

    def observe(self, state: State, memory: Any) -> tuple[Array, Any]:
        """Observation with fresh noise (5 % in the paper), and the agent's memory with it."""
        m, num = self.machine, len(state.q) // self.copies
        noise = draw_noise(m, self.config.noise, num, self.np_random).repeat(self.copies, axis=0)
        measured = measure(m, state.history, state.v_goal, noise)
        memory = self.interface.remember(m, memory, measured)
        return self.interface.observe(m, measured, memory), memory

    def step(self, actions: Array) -> Step:
        """One tick of all machines under actions (num_envs, n_driven)."""
        require(hasattr(self, "state"), "step", "a reset before the first step", "none")
        m, begin, u_before = self.machine, self.waiting, self.state.history[..., 2, -1]
        u = self.interface.command(m, np.asarray(actions), self.memory)
        state, reward, *ends = env.step(m, self.config, self.plant, self.state, u)
        error = np.linalg.norm(state.v_goal - state.v_tool, axis=-1)
        info = {"velocity_error": error, "new_goal": state.goal_ticks <= 0}
        self.state = new_goals(m, self.config, state, self.np_random, self.copies)
        self.obs, self.memory = self.observe(self.state, self.memory)
        cost = self.interface.cost(m, u, u_before, self.memory)

        of_groups = np.reshape(ends, (2, -1, self.copies)).any(axis=-1)
        terminated, truncated = of_groups.repeat(self.copies, axis=-1) & ~begin
        truncated = truncated & ~terminated
        reward = np.where(terminated | begin, 0.0, reward - cost)
        ended = terminated | truncated
        if begin.any():
            self.begin_episodes(begin)
        if self.mode == AutoresetMode.SAME_STEP and ended.any():
            info |= {"final_obs": self.obs, "_final_obs": ended}
            self.begin_episodes(ended)
        self.waiting = ended & (self.mode == AutoresetMode.NEXT_STEP)
        return self.obs, reward, terminated, truncated, info

    def render(self) -> tuple[NDArray[np.uint8], ...]:
        """A picture of the first machine (height, width, 3), with goal and tool velocity."""
        from brokk_min.viewer.drawing import Scene, draw

        s, u = self.state, self.state.history[..., 2, -1]
        scene = Scene(s.q[0], u[0], s.v_goal[0], s.v_tool[0], title=self.machine.name)
        return (np.array(draw(self.machine, scene, (640, 360))),)


class TaskEnv(gymnasium.Env[Array, Array]):
    """One machine, which the caller resets: a `TaskVectorEnv` of one, by its options."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012

    def __init__(self, *arguments: Any, **options: Any) -> None:
        options |= {"autoreset_mode": AutoresetMode.DISABLED}
        self.vector = TaskVectorEnv(1, *arguments, **options)
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
