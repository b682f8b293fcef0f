"""A window for canvases, and frames for Gymnasium."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brokk_min.kinematics import forward_kinematics, tool_position
from brokk_min.machine import Array, Machine
from brokk_min.viewer.canvas import Canvas, require_pygame
from brokk_min.viewer.drawing import Scene, draw


class Window:
    """A window for canvases; ValueError: no pygame, or no display."""

    def __init__(self, size: tuple[int, int], title: str) -> None:
        self.pygame = require_pygame()
        try:
            self.pygame.display.init()
            self.surface = self.pygame.display.set_mode(size)
        except self.pygame.error as error:
            raise _no_display(str(error)) from error
        self.pygame.display.set_caption(title)
        self.clock = self.pygame.time.Clock()

    def show(self, canvas: Canvas, fps: float) -> None:
        """Show a canvas, not before 1 / `fps` after the last one."""
        self.surface.blit(canvas.surface(), (0, 0))
        self.pygame.display.flip()
        self.clock.tick(fps)

    def close(self) -> None:
        """Close the window; what else uses pygame goes on."""
        self.pygame.display.quit()


def _no_display(got: str) -> ValueError:
    return ValueError(f"window: expected a display (SDL_VIDEODRIVER=dummy draws unseen), got {got}")


@contextmanager
def open_window(size: tuple[int, int], title: str) -> Iterator[Window]:
    """A window that is closed at the end of the block.

    Without a display SDL would draw unseen; that is refused unless SDL_VIDEODRIVER asks for it.

    ValueError: no pygame, or no display.
    """
    window = Window(size, title)
    try:
        unseen = window.pygame.display.get_driver() in ("offscreen", "dummy")
        if unseen and not os.environ.get("SDL_VIDEODRIVER"):
            raise _no_display("none")
        yield window
    finally:
        window.close()


class Pictures:
    """Frames for Gymnasium: trails of the tools since the last reset of each, and a window for `human`."""

    SIZE = (960, 600)

    def __init__(self, machine: Machine, mode: str | None, modes: list[str]) -> None:
        if mode is not None and mode not in modes:
            raise ValueError(f"render_mode: expected one of {modes}, got {mode!r}")
        self.machine, self.mode = machine, mode
        self.window: Any = None
        self.trails: dict[int, list[Array]] = {}

    def follow(self, state: Any, fresh: ArrayLike) -> None:
        """After a reset or a step to an `env.State`; `fresh` are the rows that begin anew."""
        if self.mode is not None:
            self.trails |= {row: [] for row in np.asarray(fresh).tolist()}
            for row, p_tool in enumerate(tool_position(forward_kinematics(self.machine, state.q))):
                self.trails[row].append(p_tool)
        if self.mode == "human":
            self.take(state)

    def take(self, state: Any) -> list[NDArray[np.uint8]]:
        """A frame (600, 960, 3) of each row, or the first row on the screen. Needs the extra `play`."""
        if state is None or self.mode is None:
            raise ValueError(f"render: expected a render_mode and a reset before, got {self.mode}")
        drawn = []
        for row, trail in self.trails.items():
            u, goal = state.history[row, :, 2, -1], state.v_goal[row]
            scene = Scene(state.q[row], state.q_dot[row], u, goal, np.array(trail))
            canvas = Canvas(self.SIZE)
            draw(canvas, self.machine, [scene._replace(title=self.machine.name)])
            drawn.append(canvas)
        if self.mode == "human":
            self.window = self.window or Window(self.SIZE, self.machine.name)
            self.window.pygame.event.pump()
            self.window.show(drawn[0], self.machine.rate)
            return []
        return [canvas.image() for canvas in drawn]

    def close(self) -> None:
        """Close the window, if there is one."""
        if self.window is not None:
            self.window.close()
            self.window = None
