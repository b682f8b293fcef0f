"""The task as Gymnasium environments; tables of observation, action and reward are in `env`.

Importing this module registers them, and Gymnasium can import it by the name of the environment:

    gymnasium.make("brokk_min.learning.gym_env:brokk_min/Brokk170-v0", render_mode="human")
    gymnasium.make_vec("brokk_min.learning.gym_env:brokk_min/Brokk170-v0", num_envs=256)
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from brokk_min import env
from brokk_min.actuator import ActuatorNet
from brokk_min.env import State, TaskConfig, observation_scale
from brokk_min.identification.net_file import load_net, select_nets
from brokk_min.learning.episodes import get_obs, new_goals, replace_rows, reset
from brokk_min.machine import BROKK_170, Array, Machine

Frame = NDArray[np.uint8]  # (height, width, 3)
Bools = NDArray[np.bool_]
Step = tuple[Array, Array, Bools, Bools, dict[str, Any]]  # of a vector: obs, reward, ends, info


class TaskVectorEnv(VectorEnv[Array, Array, Any]):
    """Many machines that follow random tool velocities; ended episodes reset in the same step.

    `info["final_obs"]` holds the last observation of an episode where `info["_final_obs"]` is set,
    `info["velocity_error"]` |v_goal - v_tool| [m/s], `info["state"]` the state before the step.
    `actuator` are nets (object or file) or "analytic" for the plant, `config` is what an episode
    is. `viewer.rendered_env` has one that draws. Paper: Fig. 4
    """

    def __init__(
        self,
        num_envs: int,
        actuator: ActuatorNet | Path | str = "analytic",
        machine: Machine = BROKK_170,
        config: TaskConfig | None = None,
    ) -> None:
        self.metadata = {
            "render_modes": ["rgb_array"],
            "render_fps": round(machine.rate),
            "autoreset_mode": AutoresetMode.SAME_STEP,
        }
        self.num_envs = num_envs
        self.machine = machine
        self.config = config or TaskConfig()
        self.net = load_actuator(machine, actuator)
        size = len(observation_scale(machine, self.config.paper)[0])
        self.single_observation_space = Box(-np.inf, np.inf, (size,), np.float32)
        self.single_action_space = Box(-1.0, 1.0, (len(machine.driven),), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.state: State | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Draw new episodes for all machines."""
        super().reset(seed=seed)
        self.state = self._new_episodes(self.num_envs)
        self.follow(range(self.num_envs))
        return get_obs(self.machine, self.config, self.state, self.np_random), {}

    def step(self, actions: Array) -> Step:
        """One tick of all machines under actions (num_envs, n_driven)."""
        obs, reward, terminated, truncated, info = self.step_without_reset(actions)
        done = terminated | truncated
        rows = np.flatnonzero(done)
        if len(rows) and self.state:
            fresh = self._new_episodes(len(rows))
            self.state = replace_rows(self.state, rows, fresh)
            info |= {"final_obs": obs, "_final_obs": done}
            obs = obs.copy()
            obs[rows] = get_obs(self.machine, self.config, fresh, self.np_random)
        self.follow(rows)
        return obs, reward, terminated, truncated, info

    def step_without_reset(self, actions: Array) -> Step:
        """`step` for those who reset ended episodes themselves; draws nothing."""
        if self.state is None:
            raise ValueError("step: expected a reset before the first step, got none")
        m, config, rng = self.machine, self.config, self.np_random
        state, reward, terminated, truncated, error = env.step(
            m, config, self.net, self.state, actions
        )
        info = {"state": self.state, "velocity_error": error}
        self.state = new_goals(m, config, state, rng)
        return get_obs(m, config, self.state, rng), reward, terminated, truncated, info

    def _new_episodes(self, num: int) -> State:
        return reset(self.machine, self.config, self.np_random, num, plant=self.net is None)

    def follow(self, started: Iterable[int]) -> None:
        """For those that draw: a new state; episodes of the rows `started` begin with it."""


class TaskEnv(gymnasium.Env[Array, Array]):
    """One machine: a `TaskVectorEnv` of one, by its options, whose episodes the caller resets."""

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 20}  # noqa: RUF012

    vector_class: type[TaskVectorEnv] = TaskVectorEnv

    def __init__(self, *arguments: Any, **options: Any) -> None:
        self.vector = self.vector_class(1, *arguments, **options)
        self.metadata = TaskEnv.metadata | {"render_fps": self.vector.metadata["render_fps"]}
        self.render_mode = self.vector.render_mode
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
        obs, reward, terminated, truncated, info = self.vector.step_without_reset(
            np.asarray(action)[None]
        )
        self.vector.follow([])
        info = {"velocity_error": float(info["velocity_error"][0])}
        return obs[0], float(reward[0]), bool(terminated[0]), bool(truncated[0]), info

    def render(self) -> Frame | None:
        """The present frame, or None: it is in the window."""
        frames: Any = self.vector.render()
        return next(iter(frames), None)

    def close(self) -> None:
        """Close the window, if there is one."""
        self.vector.close()


def load_actuator(machine: Machine, actuator: ActuatorNet | Path | str) -> ActuatorNet | None:
    """Nets of the driven joints, or None for the plant."""
    if isinstance(actuator, ActuatorNet):
        return select_nets(machine, actuator)
    return None if actuator == "analytic" else load_net(Path(actuator), machine)


gymnasium.register(
    "brokk_min/Brokk170-v0",
    entry_point="brokk_min.viewer.rendered_env:RenderedEnv",
    vector_entry_point="brokk_min.viewer.rendered_env:RenderedVectorEnv",
)
