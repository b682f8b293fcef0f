"""Canvas and window of pygame (extra `play`), which is imported when the first one is made."""

import os
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brokk_min.identification.files import require
from brokk_min.machine import Array

Colour = tuple[int, int, int]
Box = tuple[float, float, float, float]  # left, top, width, height [px]
BACKGROUND = (250, 250, 247)
INK = (33, 37, 43)
ANGLES = np.linspace(0, 2 * np.pi, 33)
CIRCLE = np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1)
SMALLEST = (640, 480)  # px, of a window's picture (assumed)


def require_pygame() -> Any:
    """The module pygame; ValueError: it is not installed."""
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    return require("pygame", "play")


class Canvas:
    """A picture with smooth edges; text lies on top.

    Coordinates are pixels, y down; points are (k, 2).
    """

    def __init__(self, size: tuple[int, int]) -> None:
        self.size = size
        self.draw = require_pygame().draw
        self.picture = require_pygame().Surface(size, depth=32)
        self.picture.fill(BACKGROUND)
        self.texts: list[tuple[Any, tuple[float, float]]] = []

    def clip(self, box: Box | None) -> None:
        """Cut off what follows at this box; text is not cut."""
        self.picture.set_clip(None if box is None else [round(edge) for edge in box])

    def line(self, points: Array, colour: Colour, width: float = 1) -> None:
        """A line through points; pygame's wide lines have rough edges, thin ones smooth them."""
        points = points - 0.5  # the middle of a pixel
        if width > 1:
            self.draw.lines(self.picture, colour, False, points.tolist(), round(width) - 1)
        along = np.gradient(points, axis=0)
        across = along[:, ::-1] * (1, -1) / np.maximum(np.hypot(*along.T), 1e-9)[:, None]
        for side in {(width - 1) / 2, (1 - width) / 2}:
            self.draw.aalines(self.picture, colour, False, (points + side * across).tolist())

    def polygon(self, points: Array, colour: Colour) -> None:
        """A filled polygon."""
        corners = (points - 0.5).tolist()
        self.draw.polygon(self.picture, colour, corners)
        self.draw.aalines(self.picture, colour, True, corners)

    def circle(self, centre: Array, radius: float, colour: Colour, width: int = 0) -> None:
        """A filled circle, or a ring of some width inside it."""
        if width:
            self.line(centre + (radius - width / 2) * CIRCLE, colour, width)
        else:
            self.polygon(centre + (radius - 0.5) * CIRCLE, colour)

    def bar(self, x0: float, x1: float, y: float, half: float, colour: Colour) -> None:
        """A filled rectangle between x0 and x1, `half` of it above y."""
        left, right, upper, lower = round(min(x0, x1)), round(max(x0, x1)), y - half, y + half
        box = (left, round(upper), right - left, round(lower) - round(upper))
        self.picture.fill(colour, box)

    def text(
        self, x: float, y: float, text: str, size: int, colour: Colour = INK, anchor: float = 0.0
    ) -> None:
        """Text at half its height; `anchor` 0 puts its left end at x, 1 its right end."""
        word = _word(text, size, colour)
        self.texts.append((word, (x - anchor * word.get_width(), y - word.get_height() / 2)))

    def surface(self) -> Any:
        """The finished picture as a pygame surface."""
        self.clip(None)
        self.picture.blits(self.texts)
        return self.picture

    def image(self) -> NDArray[np.uint8]:
        """The finished picture as an image (height, width, 3); needs no display."""
        pixels: NDArray[np.uint8] = require_pygame().surfarray.array3d(self.surface())
        return np.ascontiguousarray(pixels.swapaxes(0, 1))


@lru_cache(maxsize=1024)
def _word(text: str, size: int, colour: Colour) -> Any:
    """Text as a surface, on the background's colour so that it is legible over an arm."""
    return _font(size).render(text, True, colour, BACKGROUND)


@lru_cache(maxsize=16)
def _font(size: int) -> Any:
    """The typeface that matplotlib brings: the same everywhere."""
    import matplotlib

    pygame = require_pygame()
    pygame.font.init()
    return pygame.font.Font(Path(matplotlib.get_data_path()) / "fonts/ttf/DejaVuSans.ttf", size)


class Window:
    """A window for canvases.

    Without a display SDL would draw unseen; that is refused unless SDL_VIDEODRIVER asks for it.

    ValueError: no pygame, or no display.
    """

    def __init__(self, size: tuple[int, int], title: str) -> None:
        self.pygame = require_pygame()
        try:
            self.pygame.display.init()
            self.surface = self.pygame.display.set_mode(size, self.pygame.RESIZABLE)
            unseen = self.pygame.display.get_driver() in ("offscreen", "dummy")
            problem = "none" if unseen and not os.environ.get("SDL_VIDEODRIVER") else ""
        except self.pygame.error as error:
            problem = str(error)
        if problem:
            self.close()
            hint = "SDL_VIDEODRIVER=dummy draws unseen"
            raise ValueError(f"window: expected a display ({hint}), got {problem}")
        self.pygame.display.set_caption(title)
        self.clock = self.pygame.time.Clock()

    @property
    def size(self) -> tuple[int, int]:
        """Of a picture that fills the window [px]; a window below `SMALLEST` cuts it."""
        width, height = self.pygame.display.get_window_size()
        return max(width, SMALLEST[0]), max(height, SMALLEST[1])

    def show(self, canvas: Canvas, fps: float) -> None:
        """Show a canvas, not before 1 / `fps` after the last one."""
        self.surface = self.pygame.display.get_surface()  # another one after a change of size
        self.surface.fill(BACKGROUND)
        self.surface.blit(canvas.surface(), (0, 0))
        self.pygame.display.flip()
        self.clock.tick(fps)

    def close(self) -> None:
        """Close the window; what else uses pygame goes on."""
        self.pygame.display.quit()
