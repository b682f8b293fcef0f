"""The window without a display: keys and gamepad become goals, and a simulated machine follows."""

import numpy as np
import pygame
import pytest
from helpers_bus import BASELINE, START, Virtual
from helpers_cli import run
from pygame._sdl2 import controller

from brokk_min.can.operator_input import JointJog
from brokk_min.evaluation.rollout import TITLES
from brokk_min.kinematics import forward_kinematics, tool_position
from brokk_min.machine import BROKK_170
from brokk_min.viewer import drawing, play
from brokk_min.viewer.play import Operator, Session

JOG = JointJog(BROKK_170, "q1", 12)


@pytest.fixture
def operator(monkeypatch):
    monkeypatch.setenv("SDL_JOYSTICK_ALLOW_BACKGROUND_EVENTS", "1")  # unseen: never has the focus
    pygame.display.set_mode((10, 10))
    controller.quit()
    pygame.joystick.quit()
    pygame.event.clear()
    return Operator(BROKK_170, pygame)


def look(operator, ticks=5):
    """Take in the events, and return the goal velocity some ticks later."""
    actions = [operator.handle(event) for event in pygame.event.get()]
    operator.actions = [action for action in actions if action]
    return [operator.velocity() for _ in range(ticks)][-1]


def key(name, down=True):
    kind = pygame.KEYDOWN if down else pygame.KEYUP
    pygame.event.post(pygame.event.Event(kind, key=pygame.key.key_code(name)))


@pytest.mark.parametrize(
    ("keys", "direction"),
    [
        ("up", (1, 0, 0)),
        ("left", (0, 1, 0)),
        ("w", (0, 0, 1)),
        ("up left", (0.5**0.5, 0.5**0.5, 0)),
        ("w s", (0, 0, 0)),
    ],
)
def test_velocity__is_at_most_the_tool_speed_and_zero_once_released(operator, keys, direction):
    for name in keys.split():
        key(name)
    np.testing.assert_allclose(look(operator), 0.3 * np.array(direction), atol=1e-12)
    for name in keys.split():
        key(name, down=False)
    assert not look(operator, 1).any()


def test_velocity__ramps_over_a_quarter_of_a_second_and_shift_gives_a_third(operator):
    key("up")
    speeds = [look(operator, 1)[0] for _ in range(6)]
    np.testing.assert_allclose(speeds, 0.3 * np.array([0.2, 0.4, 0.6, 0.8, 1, 1]))
    key("left shift")
    assert look(operator)[0] == pytest.approx(0.1)
    key("left shift", False)
    key("up", False)
    key("down")
    assert look(operator, 1)[0] == pytest.approx(-0.3 * 0.2)  # from zero on, not from 0.1


@pytest.mark.parametrize(("kind", "up", "trigger"), [(1, 3, 4), (4, 4, 5)])
def test_gamepad__drives_until_it_is_unplugged(operator, kind, up, trigger):
    """One that SDL knows, and another one; a trigger at its end moves nothing."""
    device = Virtual(buttons=15, kind=kind)
    look(operator)
    device.axis(1, -1.0)  # forward
    device.axis(up, 1.0)  # down
    device.axis(trigger, -1.0)
    expected = 0.3 * np.array([1, 0, -1]) / 2**0.5
    np.testing.assert_allclose(look(operator), expected, atol=1e-6)
    device.button(3, True)
    look(operator)
    assert operator.actions == ["controller"]
    device.unplug()
    assert not look(operator, 1).any()
    assert operator.pad is None


def test_session__follows_the_goal_and_goes_back_to_its_start():
    goal, controllers = np.array([0.0, 0.2, 0.0]), {"PID": BASELINE, "jog": JOG}
    session, fresh = (Session(BROKK_170, controllers, np.array(START)) for _ in range(2))
    for _ in range(60):
        session.tick(goal)
    assert session.state.v_tool[0] == pytest.approx(goal, abs=0.05)
    first = tool_position(forward_kinematics(BROKK_170, START))
    np.testing.assert_allclose(session.trail[0], first)
    scene = session.scene()
    np.testing.assert_array_equal(scene.q, session.state.q[0])
    np.testing.assert_array_equal(scene.u, session.state.history[0, :, 2, -1])
    assert (scene.title, scene.status, scene.colour) == ("PID", "3.0 s", drawing.BLUE)
    session.controller()
    assert (session.scene().title, session.scene().colour) == ("jog", drawing.ORANGE)
    session.controller()
    session.restart()
    for one in (session, fresh):
        one.tick(goal)
    np.testing.assert_array_equal(session.scene().u, fresh.scene().u)
    np.testing.assert_array_equal(session.trail, fresh.trail)


def test_play__moves_the_machine_by_keys_until_the_window_is_closed(monkeypatch):
    """Through pygame's queue, in real time: arrow key, the other controller, and closing."""
    scenes, show = [], play.show

    def each_picture(pg, machine, shown):
        show(pg, machine, shown)
        scenes.append(shown)
        for at, name in ((1, "left"), (20, "tab"), (22, "escape")):
            if len(scenes) == at:
                key(name)

    monkeypatch.setattr(play, "show", each_picture)
    assert run("play") == 0
    titles = [TITLES["rl"]] * 20 + [TITLES["jacobian_pid_k0.1"]] * 2
    assert [scene.title for scene in scenes] == titles
    assert scenes[19].v_tool[1] > 0.1
    np.testing.assert_allclose([scene.v_goal for scene in scenes[-2:]], 2 * [[0, 0.3, 0]])
    assert not pygame.display.get_init()


def test_play__needs_a_display(monkeypatch):
    pygame.display.quit()
    monkeypatch.setenv("SDL_VIDEODRIVER", "nonsense")
    with pytest.raises(ValueError, match=r"window: expected a display .*, got nonsense"):
        play.play(BROKK_170, {"PID": BASELINE})
