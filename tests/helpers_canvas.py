"""A canvas that also keeps what is drawn on it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from brokk_min.viewer.window import Box, Canvas, Colour


class Shape(NamedTuple):
    points: np.ndarray  # px (k, 2)
    colour: Colour
    width: float = 0.0  # of a line or ring; 0: filled
    radius: float = 0.0


class Recorder(Canvas):
    """Lines, polygons (bars too), circles, clips; text, colour and box of each word."""

    def __init__(self, size: tuple[int, int]) -> None:
        super().__init__(size)
        self.lines: list[Shape] = []
        self.polygons: list[Shape] = []
        self.circles: list[Shape] = []
        self.clips: list[Box] = []
        self.words: list[tuple[str, Colour, np.ndarray]] = []

    def clip(self, box: Box | None) -> None:
        super().clip(box)
        self.clips += [] if box is None else [box]

    def line(self, points: Any, colour: Colour, width: int = 1) -> None:
        super().line(points, colour, width)
        self.lines.append(Shape(points, colour, width))

    def polygon(self, points: Any, colour: Colour) -> None:
        super().polygon(points, colour)
        self.polygons.append(Shape(points, colour))

    def circle(self, centre: Any, radius: float, colour: Colour, width: int = 0) -> None:
        super().circle(centre, radius, colour, width)
        self.circles.append(Shape(centre, colour, width, radius))

    def text(self, x: float, y: float, text: str, size: int, *more: Any) -> None:  # type: ignore[override]
        super().text(x, y, text, size, *more)
        word, (left, upper) = self.texts[-1]
        box = np.array([left, upper, left + word.get_width(), upper + word.get_height()])
        self.words.append((text, more[0] if more else (33, 37, 43), box))

    @property
    def texts_drawn(self) -> list[str]:
        return [text for text, _, _ in self.words]
