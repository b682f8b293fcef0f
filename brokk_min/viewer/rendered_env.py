"""Gymnasium environments that draw what happens, in a window or as frames."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from brokk_min.kinematics import forward_kinematics, tool_position
from brokk_min.learning.gym_env import Frame, TaskEnv, TaskVectorEnv
from brokk_min.machine import Array
from brokk_min.viewer.drawing import Scene, draw
from brokk_min.viewer.window import Canvas, Window

SIZE = (960, 600)  # of a frame [px]


class RenderedVectorEnv(TaskVectorEnv):
    """What `gymnasium.make_vec` makes: frames with trails of the tools since the last reset.

    ValueError: a `render_mode` that is none of `modes`.
    """

    modes: tuple[str, ...] = ("rgb_array",)

    def __init__(self, *arguments: Any, render_mode: str | None = None, **options: Any) -> None:
        if render_mode not in (None, *self.modes):
            raise ValueError(f"render_mode: expected one of {self.modes}, got {render_mode!r}")
        super().__init__(*arguments, **options)
        self.render_mode = render_mode
        self.window: Window | None = None
        self.trails: dict[int, list[Array]] = {}

    def follow(self, started: Iterable[int]) -> None:
        """Extend the trails; those of the rows `started` begin anew."""
        if self.render_mode is None or self.state is None:
            return
        self.trails |= {int(row): [] for row in started}
        for row, p_tool in enumerate(tool_position(forward_kinematics(self.machine, self.state.q))):
            self.trails[row].append(p_tool)
        if self.render_mode == "human":
            self.render()

    def render(self) -> tuple[Frame, ...]:
        """A frame (600, 960, 3) of each row; none for "human", which shows the first row."""
        if self.render_mode is None or self.state is None:
            raise ValueError("render: expected a render_mode and a reset before, got none")
        if self.render_mode == "rgb_array":
            return tuple(self.draw(row).image() for row in self.trails)
        self.window = self.window or Window(SIZE, self.machine.name)
        self.window.pygame.event.pump()
        self.window.show(self.draw(0), self.machine.rate)
        return ()

    def draw(self, row: int) -> Canvas:
        """The picture of a row."""
        s: Any = self.state
        trail, title = np.array(self.trails[row]), self.machine.name
        u = s.history[row, :, 2, -1]
        scene = Scene(s.q[row], s.q_dot[row], u, s.v_goal[row], trail, title=title)
        canvas = Canvas(SIZE)
        draw(canvas, self.machine, [scene])
        return canvas

    def close_extras(self, **kwargs: Any) -> None:
        """Close the window, if there is one."""
        if self.window is not None:
            self.window.close()
            self.window = None


class ShownVectorEnv(RenderedVectorEnv):
    """Also in a window."""

    modes = ("human", "rgb_array")


class RenderedEnv(TaskEnv):
    """What `gymnasium.make` makes: `render_mode` "human" is a window, "rgb_array" frames."""

    vector_class = ShownVectorEnv
