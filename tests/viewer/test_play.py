"""The window without a display: keys and gamepad become goals, and a simulated machine follows."""

from collections import Counter

import numpy as np
import pygame
import pytest
from helpers_bus import Virtual
from helpers_cli import run
from pygame._sdl2 import controller

from benchmarks.one_process import BASELINE
from brokk_min.evaluation.rollout import TITLES
from brokk_min.kinematics import forward_kinematics, tool_position
from brokk_min.machine import BROKK_170
from brokk_min.viewer import play
from brokk_min.viewer.play import Keyboard


@pytest.fixture
def held(monkeypatch):
    """Names of the keys that are held."""
    names = set()
    monkeypatch.setattr(pygame.key, "get_pressed", lambda: Counter(map(pygame.key.key_code, names)))
    return names


@pytest.fixture(autouse=True)
def keyboard(monkeypatch):
    """At no display: SDL draws unseen."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setenv("SDL_JOYSTICK_ALLOW_BACKGROUND_EVENTS", "1")  # unseen: never has the focus
    pygame.display.set_mode((10, 10))
    controller.quit()
    pygame.joystick.quit()
    pygame.event.clear()
    return Keyboard(BROKK_170, pygame)


def velocity(keyboard):
    """The goal velocity after all events."""
    for event in pygame.event.get():
        keyboard.handle(event)
    return keyboard.velocity()


@pytest.mark.parametrize(
    ("keys", "goal"),
    [
        ("right", (0, -0.3, 0)),
        ("w", (0, 0, 0.3)),
        ("up,left", (0.3 * 0.5**0.5, 0.3 * 0.5**0.5, 0)),
        ("w,s", (0, 0, 0)),
        ("down,left shift", (-0.1, 0, 0)),
    ],
)
def test_velocity__is_that_of_the_keys_and_at_most_the_tool_speed(keyboard, held, keys, goal):
    held.update(keys.split(","))
    np.testing.assert_allclose(keyboard.velocity(), goal, atol=1e-12)


def test_gamepad__drives_until_it_is_unplugged(keyboard):
    """A trigger at its end moves nothing."""
    device = Virtual(buttons=15, kind=1)
    assert not velocity(keyboard).any()
    for axis, value in ((1, -1.0), (3, 1.0), (4, -1.0)):  # forward, down, a trigger
        device.axis(axis, value)
    expected = 0.3 * np.array([1, 0, -1]) / 2**0.5
    np.testing.assert_allclose(velocity(keyboard), expected, atol=1e-6)
    device.unplug()
    assert not velocity(keyboard).any()


def test_play__moves_the_machine_by_keys_until_the_window_is_closed(monkeypatch, held):
    """In real time: arrow key; through pygame's queue F1, the other controller, and closing."""
    scenes, draw = [], play.draw
    tab, f1 = (pygame.event.Event(pygame.KEYDOWN, key=k) for k in (pygame.K_TAB, pygame.K_F1))
    events = {12: f1, 20: tab, 22: pygame.event.Event(pygame.QUIT)}
    monkeypatch.setattr(play, "HELP_SECONDS", 0.4)

    def each_picture(machine, scene, size):
        scenes.append(scene)
        held.add("left")
        if len(scenes) in events:
            pygame.event.post(events[len(scenes)])
        return draw(machine, scene, size)

    monkeypatch.setattr(play, "draw", each_picture)
    assert run("play") == 0 and not pygame.display.get_init()
    titles = [TITLES["rl"]] * 20 + [TITLES["jacobian_pid_k0.1"]] * 2
    assert [scene.title for scene in scenes] == titles
    assert [bool(scene.notes) for scene in scenes] == [*[True] * 7, *[False] * 5, *[True] * 10]
    assert scenes[19].v_tool[1] > 0.1 and scenes[19].u.any() and scenes[19].status == "1.0 s"
    fk = forward_kinematics(BROKK_170, np.array([scene.q for scene in scenes]))
    np.testing.assert_allclose(scenes[-1].trail, tool_position(fk))
    np.testing.assert_allclose([scene.v_goal for scene in scenes[-2:]], 2 * [[0, 0.3, 0]])


def test_play__needs_a_display(monkeypatch):
    pygame.display.quit()
    monkeypatch.setenv("SDL_VIDEODRIVER", "nonsense")
    with pytest.raises(ValueError, match=r"window: expected a display .*, got nonsense"):
        play.play(BROKK_170, {"PID": BASELINE})
