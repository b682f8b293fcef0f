"""A canvas that also keeps what is drawn on it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from brokk_min.viewer.window import Canvas, Colour


class Shape(NamedTuple):
    points: np.ndarray  # px (k, 2)
    colour: Colour
    width: float = 0.0  # of a line or ring; 0: filled


class Recorder(Canvas):
    """Lines, polygons (bars too), circles; text and box of each word."""

    def __init__(self, size):
        super().__init__(size)
        self.lines = []
        self.polygons = []
        self.circles = []
        self.words = []

    def line(self, points, colour, width=1):
        super().line(points, colour, width)
        self.lines.append(Shape(points, colour, width))

    def polygon(self, points, colour):
        super().polygon(points, colour)
        self.polygons.append(Shape(points, colour))

    def circle(self, centre, radius, colour, width=0):
        super().circle(centre, radius, colour, width)
        self.circles.append(Shape(centre, colour, width))

    def bar(self, x0, x1, y, half, colour):
        super().bar(x0, x1, y, half, colour)
        corners = [[x0, y - half], [x1, y - half], [x1, y + half], [x0, y + half]]
        self.polygons.append(Shape(np.array(corners), colour))

    def text(self, x, y, text, *more):
        super().text(x, y, text, *more)
        word, (left, upper) = self.texts[-1]
        box = np.array([left, upper, left + word.get_width(), upper + word.get_height()])
        self.words.append((text, box))

    @property
    def texts_drawn(self):
        return [text for text, _ in self.words]
