"""The task as Gymnasium environments: `make` and `make_vec` know them as "brokk_min/Brokk170-v0".

They keep a state, a random generator and pictures; what happens in a tick is `env.step`.
"""

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from brokk_min import env
from brokk_min.actuator import ActuatorNet, load_net
from brokk_min.env import Bools, State, TaskConfig
from brokk_min.kinematics import tool_position
from brokk_min.machine import BROKK_170, Array, Machine


class TaskVectorEnv(VectorEnv[Array, Array, Any]):
    """Many machines following random tool velocities; an ended episode starts anew at once. Paper: Fig. 4

    Observation: Box, see `env.observe`. Action: Box [-1, 1] a driven joint, from closed (0) through the
    dead zone to the command limit (1), see `env.to_command`. Reward: see `env.step`. `info["final_obs"]`
    holds the last observation of an ended episode where `info["_final_obs"]` is set;
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
        self.pictures = _Pictures(machine, render_mode, self.metadata["render_modes"])
        self.render_mode = render_mode
        self.num_envs, self.machine, self.config = num_envs, machine, config or TaskConfig()
        self.net = _open(machine, actuator)
        self.single_observation_space, self.single_action_space = _spaces(machine)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.state: State | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Draw new episodes for all environments."""
        super().reset(seed=seed)
        self.state = env.reset(self.machine, self.config, self.np_random, self.num_envs, self.net is None)
        self.pictures.follow(self.state, range(self.num_envs))
        return env.look(self.machine, self.config, self.state, self.np_random), {}

    def step(self, actions: Array) -> tuple[Array, Array, Bools, Bools, dict[str, Any]]:
        """One tick of all environments: actions (num_envs, n_driven)."""
        if self.state is None:
            raise ValueError("step: expected a reset before the first step, got none")
        self.state, out = env.step(self.machine, self.config, self.net, self.state, actions, self.np_random)
        observation = out.observation
        info: dict[str, Any] = {"velocity_error": out.velocity_error}
        ended = out.terminated | out.truncated
        rows = np.flatnonzero(ended)
        if len(rows):
            fresh = env.reset(self.machine, self.config, self.np_random, len(rows), self.net is None)
            self.state = env.merge(self.state, fresh, rows)
            info |= {"final_obs": observation, "_final_obs": ended}
            observation = observation.copy()
            observation[rows] = env.look(self.machine, self.config, fresh, self.np_random)
        self.pictures.follow(self.state, rows)
        return observation, out.reward, out.terminated, out.truncated, info

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
        self.pictures = _Pictures(machine, render_mode, self.metadata["render_modes"])
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
        self.state = env.reset(self.machine, self.config, self.np_random, 1, self.net is None)
        self.pictures.follow(self.state, [0])
        return env.look(self.machine, self.config, self.state, self.np_random)[0], {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """One tick: action (n_driven,)."""
        if self.state is None:
            raise ValueError("step: expected a reset before the first step, got none")
        action = np.asarray(action)[None]
        self.state, out = env.step(self.machine, self.config, self.net, self.state, action, self.np_random)
        info = {"velocity_error": float(out.velocity_error[0])}
        flags = bool(out.terminated[0]), bool(out.truncated[0])
        self.pictures.follow(self.state, [])
        return out.observation[0], float(out.reward[0]), *flags, info

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
    return env.fitting_nets(machine, net)


def _spaces(machine: Machine) -> tuple[Any, Any]:
    """Spaces of one environment's observation and action."""
    size = len(env.observation_scale(machine)[0])
    action = gymnasium.spaces.Box(-1.0, 1.0, (len(machine.driven),), np.float32)
    return gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32), action


class _Pictures:
    """Frames for Gymnasium: trails of the tools since the last reset of each, and a window for `human`."""

    SIZE = (960, 600)

    def __init__(self, machine: Machine, mode: str | None, modes: list[str]) -> None:
        if mode is not None and mode not in modes:
            raise ValueError(f"render_mode: expected one of {modes}, got {mode!r}")
        self.machine, self.mode = machine, mode
        self.window: Any = None
        self.trails: dict[int, list[Array]] = {}

    def follow(self, state: State, fresh: ArrayLike) -> None:
        """After a reset or a step; `fresh` are the rows that begin anew."""
        if self.mode is not None:
            self.trails |= {row: [] for row in np.asarray(fresh).tolist()}
            for row, p_tool in enumerate(tool_position(self.machine, state.q)):
                self.trails[row].append(p_tool)
        if self.mode == "human":
            self.take(state)

    def take(self, state: State | None) -> list[NDArray[np.uint8]]:
        """A frame (600, 960, 3) of each row, or the first row on the screen. Needs the extra `play`."""
        from brokk_min import view, window  # pictures cost nothing where nobody looks

        if state is None or self.mode is None:
            raise ValueError(f"render: expected a render_mode and a reset before, got {self.mode}")
        drawn = []
        for row, trail in self.trails.items():
            u, goal = state.history[row, :, 2, -1], state.v_goal[row]
            scene = view.Scene(state.q[row], state.q_dot[row], u, goal, np.array(trail))
            drawn.append(view.draw(self.machine, [scene._replace(title=self.machine.name)], self.SIZE))
        if self.mode == "human":
            self.window = self.window or window.Window(self.SIZE, self.machine.name)
            self.window.pygame.event.pump()
            self.window.show(drawn[0], self.machine.rate)
            return []
        return [window.picture(shapes, self.SIZE) for shapes in drawn]

    def close(self) -> None:
        """Close the window, if there is one."""
        if self.window is not None:
            self.window.close()
            self.window = None


gymnasium.register(
    "brokk_min/Brokk170-v0",
    entry_point="brokk_min.environments:TaskEnv",
    vector_entry_point="brokk_min.environments:TaskVectorEnv",
)
