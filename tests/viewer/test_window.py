"""The canvas paints what it is asked to; the window needs a display."""

from contextlib import closing

import numpy as np

from brokk_min.viewer.window import BACKGROUND, Canvas, Window

RED = (200, 0, 0)
BLUE = (0, 0, 200)
GREEN = (0, 150, 0)


def columns(image, row, colour):
    return np.flatnonzero((image[row] == colour).all(axis=-1)).tolist()


def is_span(found, first, end):
    """All pixels from the first to the end, but those at the smooth edges."""
    return found == list(range(found[0], found[-1] + 1)) and (
        abs(found[0] - first) <= 1 and abs(found[-1] + 1 - end) <= 1
    )


def test_canvas__paints_shapes_where_they_are_and_as_large():
    canvas = Canvas((60, 40))
    canvas.line(np.array([[5.0, 5], [5, 35], [35, 35]]), RED, 4)
    canvas.circle(np.array([25.0, 15]), 5, BLUE)
    canvas.bar(44.0, 52.0, 24.0, 4.0, GREEN)
    image = canvas.image()
    assert image.shape == (40, 60, 3)
    assert image.dtype == np.uint8
    assert is_span(columns(image, 20, RED), 3, 7)
    assert is_span(columns(image, 35, RED), 5, 35)  # open: no line back to the start
    assert is_span(columns(image, 15, BLUE), 20, 30)
    assert columns(image, 24, GREEN) == list(range(44, 52))
    assert (image[24, 8:43] == BACKGROUND).all()
    canvas.circle(np.array([25.0, 15]), 5, RED, 2)
    assert is_span(columns(canvas.image(), 15, BLUE), 22, 28)  # a ring around it


def test_canvas__cuts_shapes_but_not_text_at_the_clip():
    canvas = Canvas((60, 40))
    canvas.clip((0.0, 0.0, 30.0, 40.0))
    canvas.bar(10.0, 50.0, 20.0, 5.0, RED)
    assert columns(canvas.image(), 20, RED) == list(range(10, 30))
    canvas.text(35, 20, "HHH", 12, BLUE)
    image = canvas.image()
    assert columns(image, 20, RED) == list(range(10, 30))
    assert (image[:, 35:] != BACKGROUND).any()
    again = Canvas((60, 40))  # begins without clip and empty
    again.bar(10.0, 50.0, 20.0, 5.0, RED)
    assert columns(again.image(), 20, RED) == list(range(10, 50))


def test_window__shows_a_canvas_and_gives_its_size_after_it_was_resized():
    with closing(Window((700, 500), "a title")) as window:
        assert window.pygame.display.get_caption()[0] == "a title"
        assert window.size == (700, 500)
        for size, picture in (((900, 600), (900, 600)), ((300, 600), (640, 600))):
            window.pygame.display.set_mode(size, window.pygame.RESIZABLE)
            assert window.size == picture
            canvas = Canvas(picture)
            canvas.bar(10.0, 50.0, 20.0, 5.0, RED)
            window.show(canvas, 1000.0)
            shown = window.pygame.surfarray.array3d(window.surface).swapaxes(0, 1)
            np.testing.assert_array_equal(shown, canvas.image()[:, : size[0]])
    assert not window.pygame.display.get_init()
