"""A canvas that also keeps what is drawn on it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from brokk_min.viewer.window import Canvas, Colour


class Shape(NamedTuple):
    points: np.ndarray  # px (k, 2)
    colour: Colour
    width: float = 0.0  # of a line or ring; 0: filled
    radius: float = 0.0


class Recorder(Canvas):
    """Lines, polygons (bars too), circles, clips; text, colour and box of each word."""

    def __init__(self, size):
        super().__init__(size)
        self.lines = []
        self.polygons = []
        self.circles = []
        self.clips = []
        self.words = []

    def clip(self, box):
        super().clip(box)
        self.clips += [] if box is None else [box]

    def line(self, points, colour, width=1):
        super().line(points, colour, width)
        self.lines.append(Shape(points, colour, width))

    def polygon(self, points, colour):
        super().polygon(points, colour)
        self.polygons.append(Shape(points, colour))

    def circle(self, centre, radius, colour, width=0):
        super().circle(centre, radius, colour, width)
        self.circles.append(Shape(centre, colour, width, radius))

    def bar(self, x0, x1, y, half, colour):
        super().bar(x0, x1, y, half, colour)
        corners = [[x0, y - half], [x1, y - half], [x1, y + half], [x0, y + half]]
        self.polygons.append(Shape(np.array(corners), colour))

    def text(self, x, y, text, size, *more):
        super().text(x, y, text, size, *more)
        word, (left, upper) = self.texts[-1]
        box = np.array([left, upper, left + word.get_width(), upper + word.get_height()])
        self.words.append((text, more[0] if more else (33, 37, 43), box))

    @property
    def texts_drawn(self):
        return [text for text, _, _ in self.words]
