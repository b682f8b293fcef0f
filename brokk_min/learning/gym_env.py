"""The task as Gymnasium environments: `make` and `make_vec` know them as "brokk_min/Brokk170-v0".

They keep a state, a random generator and pictures; what happens in a tick is `env.step`.
"""

import contextlib
import ctypes
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from brokk_min import env
from brokk_min.actuator import ActuatorNet, select_nets
from brokk_min.env import Bools, State, TaskConfig, observation_scale
from brokk_min.identification.net_file import load_net
from brokk_min.learning.episodes import get_obs, new_goals, replace_rows, reset
from brokk_min.machine import BROKK_170, Array, Machine
from brokk_min.viewer.window import Pictures


class TaskVectorEnv(VectorEnv[Array, Array, Any]):
    """Many machines following random tool velocities; an ended episode starts anew at once. Paper: Fig. 4

    Observation: Box, see `observation.observe`. Action: Box [-1, 1] a driven joint, from closed (0) through
    the dead zone to the command limit (1), see `observation.action_to_pwm`. Reward: see `env.step`.
    `info["final_obs"]` holds the last observation of an ended episode where `info["_final_obs"]` is set;
    `info["velocity_error"]` is |v_goal - v_tool| [m/s].

    Args:
        num_envs: how many.
        actuator: nets (object or file) or "analytic" for the plant.
        machine: what moves.
        config: what an episode is.
        render_mode: None or "rgb_array": `render` gives a frame of each environment.
    """

    def __init__(
        self,
        num_envs: int,
        actuator: ActuatorNet | Path | str = "analytic",
        machine: Machine = BROKK_170,
        config: TaskConfig | None = None,
        render_mode: str | None = None,
    ) -> None:
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": round(machine.rate)}
        self.metadata["autoreset_mode"] = AutoresetMode.SAME_STEP
        self.pictures = Pictures(machine, render_mode, self.metadata["render_modes"])
        self.render_mode = render_mode
        self.num_envs, self.machine, self.config = num_envs, machine, config or TaskConfig()
        self.net = _open(machine, actuator)
        self.single_observation_space, self.single_action_space = _spaces(machine)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.state: State | None = None
        _keep_freed_memory()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Draw new episodes for all environments."""
        super().reset(seed=seed)
        self.state = reset(
            self.machine, self.config, self.np_random, self.num_envs, self.net is None
        )
        self.pictures.follow(self.state, range(self.num_envs))
        return get_obs(self.machine, self.config, self.state, self.np_random), {}

    def step(self, actions: Array) -> tuple[Array, Array, Bools, Bools, dict[str, Any]]:
        """One tick of all environments: actions (num_envs, n_driven)."""
        if self.state is None:
            raise ValueError("step: expected a reset before the first step, got none")
        m, config, rng = self.machine, self.config, self.np_random
        info: dict[str, Any] = {"state": self.state}
        state, reward, terminated, truncated, error = env.step(
            m, config, self.net, self.state, actions
        )
        info["velocity_error"] = error
        state = new_goals(m, config, state, rng)
        obs = get_obs(m, config, state, rng)
        ended = terminated | truncated
        rows = np.flatnonzero(ended)
        if len(rows):
            fresh = reset(m, config, rng, len(rows), self.net is None)
            state = replace_rows(state, rows, fresh)
            info |= {"final_obs": obs, "_final_obs": ended}
            obs = obs.copy()
            obs[rows] = get_obs(m, config, fresh, rng)
        self.state = state
        self.pictures.follow(self.state, rows)
        return obs, reward, terminated, truncated, info

    def render(self) -> tuple[NDArray[np.uint8], ...]:
        """A frame (600, 960, 3) of each environment."""
        return tuple(self.pictures.take(self.state))


class TaskEnv(gymnasium.Env[Array, Array]):
    """One machine that follows random tool velocities: `TaskVectorEnv`'s functions, batch of one.

    With `render_mode` "human" each step shows itself in a window; with "rgb_array" `render` gives a frame.
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 20}  # noqa: RUF012, as Gymnasium has it

    def __init__(
        self,
        actuator: ActuatorNet | Path | str = "analytic",
        machine: Machine = BROKK_170,
        config: TaskConfig | None = None,
        render_mode: str | None = None,
    ) -> None:
        self.metadata = TaskEnv.metadata | {"render_fps": round(machine.rate)}
        self.pictures = Pictures(machine, render_mode, self.metadata["render_modes"])
        self.render_mode = render_mode
        self.machine, self.config = machine, config or TaskConfig()
        self.net = _open(machine, actuator)
        self.observation_space, self.action_space = _spaces(machine)
        self.state: State | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Draw a new episode."""
        super().reset(seed=seed)
        self.state = reset(self.machine, self.config, self.np_random, 1, self.net is None)
        self.pictures.follow(self.state, [0])
        return get_obs(self.machine, self.config, self.state, self.np_random)[0], {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """One tick: action (n_driven,)."""
        if self.state is None:
            raise ValueError("step: expected a reset before the first step, got none")
        action = np.asarray(action)[None]
        m, config = self.machine, self.config
        state, reward, terminated, truncated, error = env.step(
            m, config, self.net, self.state, action
        )
        self.state = new_goals(m, config, state, self.np_random)
        self.pictures.follow(self.state, [])
        obs = get_obs(m, config, self.state, self.np_random)[0]
        info = {"velocity_error": float(error[0])}
        return obs, float(reward[0]), bool(terminated[0]), bool(truncated[0]), info

    def render(self) -> NDArray[np.uint8] | None:
        """The present picture (600, 960, 3), or None: it is on the screen."""
        return next(iter(self.pictures.take(self.state)), None)

    def close(self) -> None:
        """Close the window, if there is one."""
        self.pictures.close()


# --- what both of them need ----------------------------------------------------------------------------


def _open(machine: Machine, actuator: ActuatorNet | Path | str) -> ActuatorNet | None:
    """Nets of the driven joints, or None for the plant."""
    if isinstance(actuator, str) and actuator == "analytic":
        return None
    net = actuator if isinstance(actuator, ActuatorNet) else load_net(Path(actuator))
    return select_nets(machine, net)


def _keep_freed_memory() -> None:
    """Let the process keep the memory of arrays that it drops, 32 MB each at most, for the next ones.

    glibc would hand it back and fetch it anew in each step, page by page, the more environments the more.
    Other C libraries do as they do.
    """
    with contextlib.suppress(AttributeError, OSError, TypeError):
        mallopt, trim_threshold, mmap_threshold = ctypes.CDLL(None).mallopt, -1, -3
        mallopt(trim_threshold, 2**30)
        mallopt(mmap_threshold, 2**25)


def _spaces(machine: Machine) -> tuple[Any, Any]:
    """Spaces of one environment's observation and action."""
    size = len(observation_scale(machine)[0])
    action = gymnasium.spaces.Box(-1.0, 1.0, (len(machine.driven),), np.float32)
    return gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32), action


gymnasium.register(
    "brokk_min/Brokk170-v0",
    entry_point="brokk_min.learning.gym_env:TaskEnv",
    vector_entry_point="brokk_min.learning.gym_env:TaskVectorEnv",
)
