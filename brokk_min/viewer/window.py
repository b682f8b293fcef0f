"""Shapes onto a surface, into a window or an image: all that needs pygame (extra `play`)."""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brokk_min.identification.files import require
from brokk_min.kinematics import forward_kinematics, tool_position
from brokk_min.machine import Array, Machine
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
            drawn.append(draw(self.machine, [scene._replace(title=self.machine.name)], self.SIZE))
        if self.mode == "human":
            self.window = self.window or Window(self.SIZE, self.machine.name)
            self.window.pygame.event.pump()
            self.window.show(drawn[0], self.machine.rate)
            return []
        return [picture(shapes, self.SIZE) for shapes in drawn]

    def close(self) -> None:
        """Close the window, if there is one."""
        if self.window is not None:
            self.window.close()
            self.window = None
