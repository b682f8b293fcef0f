"""The task as Gymnasium environments; tables of observation, action and reward are in `env`.

Importing this module registers them, and Gymnasium can import it by the name of the environment:

    gymnasium.make("brokk_min.learning.gym_env:brokk_min/Brokk170-v0", render_mode="rgb_array")
    gymnasium.make_vec("brokk_min.learning.gym_env:brokk_min/Brokk170-v0", num_envs=256)
"""

from pathlib import Path
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
from brokk_min.identification.net_file import load_net
from brokk_min.learning.episodes import draw_noise, new_goals, replace_rows, reset
from brokk_min.machine import BROKK_170, Array, Machine
from brokk_min.settings import TaskConfig

Bools = NDArray[np.bool_]
Step = tuple[Array, Array, Bools, Bools, dict[str, Any]]  # of a vector: obs, reward, ends, info


class TaskVectorEnv(VectorEnv[Array, Array, Any]):
    """Many machines that follow random tool velocities; ended episodes reset in the same step.

    `info["final_obs"]` holds the last observation of an episode where `info["_final_obs"]` is set,
    `info["velocity_error"]` is |v_goal - v_tool| [m/s], `info["before"]` has the state and the
    agent's memory before the step, and the command. Paper: Fig. 4

    Args:
        num_envs: number of machines.
        plant: what moves them; the name of a file of nets, or a plant.
        machine: which one.
        config: what an episode is.
        interface: what the agent reads, does and is paid for.
        render_mode: None or "rgb_array" (the first machine).
    """

    def __init__(
        self,
        num_envs: int,
        plant: Plant | Path | str = PLANT,
        machine: Machine = BROKK_170,
        config: TaskConfig | None = None,
        interface: Interface = PAPER,
        render_mode: str | None = None,
    ) -> None:
        self.metadata = {
            "render_modes": ["rgb_array"],
            "render_fps": round(machine.rate),
            "autoreset_mode": AutoresetMode.SAME_STEP,
        }
        self.num_envs = num_envs
        self.machine = machine
        self.config = config or TaskConfig()
        self.plant = load_net(Path(plant), machine) if isinstance(plant, str | Path) else plant
        self.interface = interface
        self.render_mode = render_mode
        size = len(interface.scale(machine)[0])
        self.single_observation_space = Box(-np.inf, np.inf, (size,), np.float32)
        self.single_action_space = Box(-1.0, 1.0, (len(machine.driven),), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.state: State | None = None
        self.memory: Any = None  # of the agent

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Draw new episodes for all machines."""
        super().reset(seed=seed)
        self.state = self.draw_episodes(self.num_envs)
        obs, self.memory = self.observe(self.state, None)
        return obs, {}

    def draw_episodes(self, num: int) -> State:
        """`num` machines at the start of an episode."""
        return reset(self.machine, self.config, self.np_random, num, self.plant)

    def draw_noise(self, num: int) -> Array:
        """Noise of `env.measure` for `num` machines."""
        return draw_noise(self.machine, self.config.noise, num, self.np_random)

    def new_goals(self, state: State) -> State:
        """New goals where the time of a goal is over."""
        return new_goals(self.machine, self.config, state, self.np_random)

    def observe(self, state: State, memory: Any) -> tuple[Array, Any]:
        """Observation with fresh noise (5 % in the paper), and the agent's memory with it."""
        m = self.machine
        measured = measure(m, state.history, state.v_goal, self.draw_noise(len(state.q)))
        memory = self.interface.remember(m, memory, measured)
        return self.interface.observe(m, measured, memory), memory

    def step(self, actions: Array) -> Step:
        """One tick of all machines under actions (num_envs, n_driven)."""
        obs, reward, terminated, truncated, info = self.step_without_reset(actions)
        done = terminated | truncated
        rows = np.flatnonzero(done)
        if len(rows):
            fresh = self.draw_episodes(len(rows))
            first, memory = self.observe(fresh, None)
            self.state = replace_rows(self.state, rows, fresh)
            self.memory = replace_rows(self.memory, rows, memory)
            info |= {"final_obs": obs, "_final_obs": done}
            obs = replace_rows(obs, rows, first)
        return obs, reward, terminated, truncated, info

    def step_without_reset(self, actions: Array) -> Step:
        """`step` for those who reset ended episodes themselves."""
        if self.state is None:
            raise ValueError("step: expected a reset before the first step, got none")
        m, before, memory = self.machine, self.state, self.memory
        u = self.interface.command(m, np.asarray(actions), memory)
        state, reward, terminated, truncated = env.step(m, self.config, self.plant, before, u)
        error = np.linalg.norm(state.v_goal - state.v_tool, axis=-1)
        self.state = self.new_goals(state)
        obs, self.memory = self.observe(self.state, memory)
        cost = self.interface.cost(m, u, before.history[..., 2, -1], self.memory)
        reward = np.where(terminated, 0.0, reward - cost)
        info = {"velocity_error": error, "before": (before, memory, u)}
        return obs, reward, terminated, truncated, info

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """A picture of the first machine (height, width, 3), with goal and tool velocity."""
        from brokk_min.viewer.drawing import picture

        if self.render_mode is None or self.state is None:
            return None
        s, u = self.state, self.state.history[..., 2, -1]
        return (picture(self.machine, s.q[0], u[0], s.v_goal[0], s.v_tool[0]),)


class TaskEnv(gymnasium.Env[Array, Array]):
    """One machine: a `TaskVectorEnv` of one, by its options, whose episodes the caller resets."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012

    def __init__(self, *arguments: Any, **options: Any) -> None:
        self.vector = TaskVectorEnv(1, *arguments, **options)
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
        actions = np.asarray(action)[None]
        obs, reward, terminated, truncated, info = self.vector.step_without_reset(actions)
        info = {"velocity_error": float(info["velocity_error"][0])}
        return obs[0], float(reward[0]), bool(terminated[0]), bool(truncated[0]), info

    def render(self) -> Any:
        """The present picture (height, width, 3)."""
        return (self.vector.render() or (None,))[0]


gymnasium.register(
    "brokk_min/Brokk170-v0",
    entry_point="brokk_min.learning.gym_env:TaskEnv",
    vector_entry_point="brokk_min.learning.gym_env:TaskVectorEnv",
)
