"""Shapes onto a surface, into a window or an image: all that needs pygame (extra `play`)."""

import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brokk_min.env import State
from brokk_min.identification.files import require
from brokk_min.kinematics import forward_kinematics, tool_position
from brokk_min.learning.gym_env import TaskEnv, TaskVectorEnv
from brokk_min.machine import BROKK_170, Array, Machine
from brokk_min.viewer.drawing import (
    PAPER,
    Circle,
    Clip,
    Colour,
    Line,
    Polygon,
    Scene,
    Shape,
    Text,
    draw,
)


def need_pygame() -> Any:
    """pygame, which is imported only where something is painted; ValueError: it is not installed."""
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    return require("pygame", "play")


@lru_cache(maxsize=1024)
def _word(text: str, size: int, colour: Colour) -> Any:
    """Text as a surface, on the paper's colour so that it stays legible over an arm."""
    return _font(size).render(text, True, colour, PAPER)


@lru_cache(maxsize=16)
def _font(size: int) -> Any:
    """The typeface that matplotlib brings: the same everywhere."""
    import matplotlib

    pygame = need_pygame()
    pygame.font.init()
    return pygame.font.Font(Path(matplotlib.get_data_path()) / "fonts/ttf/DejaVuSans.ttf", size)


def paint(surface: Any, shapes: Sequence[Shape]) -> None:
    """Shapes on a pygame surface, edges smoothed: drawn twice as large and scaled down; text lies on top."""
    pygame, twice = need_pygame(), _canvas((2 * surface.get_width(), 2 * surface.get_height()))
    twice.set_clip(None)
    twice.fill(PAPER)
    for shape in shapes:
        match shape:
            case Line(points, colour, width):
                pygame.draw.lines(twice, colour, False, (2 * points).tolist(), 2 * width)
            case Polygon(points, colour):
                pygame.draw.polygon(twice, colour, (2 * points).tolist())
            case Circle(centre, radius, colour):
                pygame.draw.circle(twice, colour, (2 * centre).tolist(), 2 * radius)
            case Clip(box):
                twice.set_clip([round(2 * edge) for edge in box])
    pygame.transform.smoothscale(twice, surface.get_size(), surface)
    for at, text, size, colour, anchor in (shape for shape in shapes if isinstance(shape, Text)):
        word = _word(text, size, colour)
        surface.blit(word, (at[0] - anchor * word.get_width(), at[1] - word.get_height() / 2))


@lru_cache(maxsize=2)
def _canvas(size: tuple[int, int]) -> Any:
    return need_pygame().Surface(size, depth=32)


class Window:
    """A window for shapes; ValueError: no pygame, or no display."""

    def __init__(self, size: tuple[int, int], title: str) -> None:
        self.pygame = pygame = need_pygame()
        try:
            pygame.display.init()
            self.surface = pygame.display.set_mode(size)
        except pygame.error as error:
            raise ValueError(
                f"window: expected a display (SDL_VIDEODRIVER=dummy draws unseen), got {error}"
            ) from error
        pygame.display.set_caption(title)
        self.clock = pygame.time.Clock()

    def show(self, shapes: Sequence[Shape], fps: float) -> None:
        """Show shapes, not before 1 / `fps` after the last ones."""
        paint(self.surface, shapes)
        self.pygame.display.flip()
        self.clock.tick(fps)

    def close(self) -> None:
        """Close the window; what else uses pygame goes on."""
        self.pygame.display.quit()


@contextmanager
def open_window(size: tuple[int, int], title: str) -> Iterator[Window]:
    """A window for somebody to look at, closed at the end of the block.

    Without a display SDL draws unseen. That serves tests, and whoever asks for it with SDL_VIDEODRIVER.

    ValueError: no pygame, or no display.
    """
    window = Window(size, title)
    try:
        driver = window.pygame.display.get_driver()
        if driver in ("offscreen", "dummy") and not os.environ.get("SDL_VIDEODRIVER"):
            raise ValueError(
                "window: expected a display (SDL_VIDEODRIVER=dummy draws unseen), got none"
            )
        yield window
    finally:
        window.close()


def picture(shapes: Sequence[Shape], size: tuple[int, int]) -> NDArray[np.uint8]:
    """Shapes as an image (height, width, 3); needs no display."""
    surface = need_pygame().Surface(size, depth=32)
    paint(surface, shapes)
    pixels: NDArray[np.uint8] = need_pygame().surfarray.array3d(surface)
    return np.ascontiguousarray(pixels.swapaxes(0, 1))


class FrameRenderer:
    """Frames for Gymnasium, with trails of the tools since the last reset; a window for "human".

    ValueError: a `mode` that is none of `modes`.
    """

    SIZE = (960, 600)

    def __init__(self, machine: Machine, mode: str, modes: list[str]) -> None:
        if mode not in modes:
            raise ValueError(f"render_mode: expected one of {modes}, got {mode!r}")
        self.machine = machine
        self.mode = mode
        self.window: Window | None = None
        self.trails: dict[int, list[Array]] = {}

    def update(self, state: State, started: Iterable[int]) -> None:
        """Extend the trails to a state; those of the rows `started` begin with it."""
        for row in started:
            self.trails[int(row)] = []
        for row, p_tool in enumerate(tool_position(forward_kinematics(self.machine, state.q))):
            self.trails[row].append(p_tool)
        if self.mode == "human":
            self.render(state)

    def render(self, state: State) -> list[NDArray[np.uint8]]:
        """A frame (600, 960, 3) of each row; none for "human", which shows the first row."""
        scenes = [
            Scene(
                state.q[row],
                state.q_dot[row],
                state.history[row, :, 2, -1],
                state.v_goal[row],
                np.array(trail),
                title=self.machine.name,
            )
            for row, trail in self.trails.items()
        ]
        frames = [draw(self.machine, [scene], self.SIZE) for scene in scenes]
        if self.mode != "human":
            return [picture(shapes, self.SIZE) for shapes in frames]
        if self.window is None:
            self.window = Window(self.SIZE, self.machine.name)
        self.window.pygame.event.pump()
        self.window.show(frames[0], self.machine.rate)
        return []

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
