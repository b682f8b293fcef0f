"""Gymnasium environments that draw what happens, in a window or as frames."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brokk_min.env import State
from brokk_min.kinematics import forward_kinematics, tool_position
from brokk_min.learning.gym_env import TaskEnv, TaskVectorEnv
from brokk_min.machine import BROKK_170, Array, Machine
from brokk_min.viewer.drawing import Scene, draw
from brokk_min.viewer.window import Canvas, Window

SIZE = (960, 600)  # of a frame [px]


class FrameRenderer:
    """Frames for Gymnasium, with trails of the tools since the last reset; a window for "human".

    ValueError: a `mode` that is none of `modes`.
    """

    def __init__(self, machine: Machine, mode: str, modes: list[str]) -> None:
        if mode not in modes:
            raise ValueError(f"render_mode: expected one of {modes}, got {mode!r}")
        self.machine = machine
        self.mode = mode
        self.window: Window | None = None
        self.trails: dict[int, list[Array]] = {}

    def update(self, state: State, started: Iterable[int]) -> None:
        """Extend the trails to a state; those of the rows `started` begin with it."""
        self.trails |= {int(row): [] for row in started}
        for row, p_tool in enumerate(tool_position(forward_kinematics(self.machine, state.q))):
            self.trails[row].append(p_tool)
        if self.mode == "human":
            self.render(state)

    def render(self, state: State) -> list[NDArray[np.uint8]]:
        """A frame (600, 960, 3) of each row; none for "human", which shows the first row."""
        if self.mode != "human":
            return [self._draw(state, row).image() for row in self.trails]
        self.window = self.window or Window(SIZE, self.machine.name)
        self.window.pygame.event.pump()
        self.window.show(self._draw(state, 0), self.machine.rate)
        return []

    def _draw(self, state: State, row: int) -> Canvas:
        u = state.history[row, :, 2, -1]
        trail = np.array(self.trails[row])
        scene = Scene(state.q[row], state.q_dot[row], u, state.v_goal[row], trail)
        canvas = Canvas(SIZE)
        draw(canvas, self.machine, [scene._replace(title=self.machine.name)])
        return canvas

    def close(self) -> None:
        """Close the window, if there is one."""
        if self.window is not None:
            self.window.close()
            self.window = None


class RenderedEnv(TaskEnv):
    """What `gymnasium.make` makes: `render_mode` "human" is a window, "rgb_array" frames."""

    def __init__(
        self, machine: Machine = BROKK_170, render_mode: str | None = None, **options: Any
    ) -> None:
        modes = TaskEnv.metadata["render_modes"]
        renderer = FrameRenderer(machine, render_mode, modes) if render_mode else None
        super().__init__(machine=machine, renderer=renderer, **options)


class RenderedVectorEnv(TaskVectorEnv):
    """What `gymnasium.make_vec` makes: `render_mode` "rgb_array" is a frame of each machine."""

    def __init__(
        self, machine: Machine = BROKK_170, render_mode: str | None = None, **options: Any
    ) -> None:
        renderer = FrameRenderer(machine, render_mode, ["rgb_array"]) if render_mode else None
        super().__init__(machine=machine, renderer=renderer, **options)
