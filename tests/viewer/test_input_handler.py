"""Keys and gamepad become requests; the dead-man switch counts only when pressed afresh."""

from dataclasses import replace

import numpy as np
import pygame
import pytest
from helpers_bus import Virtual
from helpers_viewer import Operator

from brokk_min.machine import BROKK_170
from brokk_min.viewer import input_handler
from brokk_min.viewer.input_handler import InputHandler


@pytest.fixture(autouse=True)
def background_events(monkeypatch):
    monkeypatch.setenv("SDL_JOYSTICK_ALLOW_BACKGROUND_EVENTS", "1")  # unseen: never has the focus
    pygame.display.init()
    pygame.joystick.quit()


@pytest.mark.parametrize(
    ("keys", "direction"),
    [
        ("up", (1, 0, 0)),
        ("down", (-1, 0, 0)),
        ("left", (0, 1, 0)),
        ("right", (0, -1, 0)),
        ("w", (0, 0, 1)),
        ("s", (0, 0, -1)),
        ("up left", (0.5**0.5, 0.5**0.5, 0)),
        ("w s", (0, 0, 0)),
    ],
)
def test_request__asks_for_at_most_tool_speed_and_for_nothing_once_released(keys, direction):
    operator = Operator()
    request = [operator.key(key) for key in keys.split()][-1]
    np.testing.assert_allclose(request.v_goal, 0.3 * np.array(direction), atol=1e-12)
    assert not request.enable
    assert not request.levers.any()
    request = [operator.key(key, down=False) for key in keys.split()][-1]
    assert not request.v_goal.any()


def test_request__ramps_over_a_quarter_of_a_second_and_shift_gives_a_third():
    operator = Operator()
    speeds = [operator.key("up", seconds=0.05), operator.look(0.05), operator.look(1.0)]
    assert [r.v_goal[0] for r in speeds] == pytest.approx([0.3 * 0.2, 0.3 * 0.4, 0.3])
    assert operator.key("left shift").v_goal[0] == pytest.approx(0.1)
    operator.key("left shift", False)
    operator.key("up", False)
    assert operator.key("down", seconds=0.05).v_goal[0] == pytest.approx(-0.3 * 0.2)


def test_request__has_a_lever_for_each_driven_joint_and_modes_go_round():
    operator = Operator()
    operator.key("tab")
    operator.key("tab")
    for i, (plus, minus) in enumerate(input_handler.LEVER_KEYS[:4]):
        request = operator.key(plus)
        np.testing.assert_array_equal(request.levers, np.eye(4)[i])
        assert request.mode == 2
        assert not request.v_goal.any()
        operator.key(plus, False)
        np.testing.assert_array_equal(operator.key(minus).levers, -np.eye(4)[i])
        operator.key(minus, False)
    assert operator.key("tab").mode == 0
    six = tuple(replace(joint, driven=True) for joint in BROKK_170.joints)
    more = replace(six[4], name="q6", encoder_node=6), replace(six[4], name="q7", encoder_node=7)
    operator = Operator(machine=replace(BROKK_170, joints=six + more, q_start=()))
    operator.key("tab")
    operator.key("tab")
    assert operator.key("y").levers.tolist() == [0, 0, 0, 0, 0, 1, 0]  # the last has no key


def test_switch__counts_only_if_pressed_with_nothing_deflected():
    operator = Operator()
    assert operator.key("space").enable
    assert operator.key("up").enable  # deflected later
    operator.key("space", False)
    assert not operator.key("space").enable
    assert not operator.key("up", False).enable  # releasing the stick does not make up for it
    operator.key("space", False)
    assert operator.key("space").enable


@pytest.mark.parametrize("loss", ["focus", "mode"])
def test_switch__needs_a_fresh_press_after_loss_of_focus_and_change_of_mode(loss):
    operator = Operator()
    operator.key("space")
    assert operator.key("up").enable
    if loss == "focus":
        request = operator.event(pygame.WINDOWFOCUSLOST)
        assert not request.enable
        assert not request.v_goal.any()
        assert request.alive
        assert not operator.key("space").enable  # keys without focus do not count
        assert not operator.event(pygame.WINDOWFOCUSGAINED).enable
    else:
        request = operator.key("tab")
        assert not request.enable
        assert request.mode == 1
        operator.key("up", False)
        assert not operator.look().enable  # still held
    operator.key("space", False)
    assert operator.key("space").enable


def test_handle__keeps_the_requested_task_and_closes():
    operator = Operator()
    for key, task in (("return", "next"), ("up", "next"), ("backspace", "again"), ("c", "compare")):
        operator.key(key)
        assert operator.handler.task == task
    operator.event(pygame.JOYBUTTONDOWN, button=9)
    assert operator.handler.task == "compare"
    operator.key("escape")
    assert operator.handler.closed
    other = Operator()
    assert not other.handler.closed
    other.event(pygame.QUIT)
    assert other.handler.closed


def test_gamepad__drives_until_it_is_unplugged_then_the_keyboard_does():
    operator = Operator()
    device = Virtual()
    operator.look()
    device.button(input_handler.PAD_SWITCH, True)
    assert operator.look().enable
    device.axis(1, -1.0)
    device.axis(4, 1.0)
    expected = 0.3 * np.array([1, 0, -1]) / 2**0.5
    np.testing.assert_allclose(operator.look().v_goal, expected, atol=1e-6)
    device.button(3, True)
    request = operator.look()
    assert request.mode == 1
    assert not request.enable
    device.button(input_handler.PAD_SWITCH, False)
    device.axis(1, 0.0)
    device.axis(4, 0.0)
    operator.look()
    device.button(input_handler.PAD_SWITCH, True)
    assert operator.look().enable
    device.unplug()
    request = operator.look()
    assert not request.alive
    assert not request.enable
    assert not request.v_goal.any()
    assert operator.key("space").alive
    operator.key("space", False)
    assert operator.key("space").enable


def test_gamepad__that_comes_needs_a_fresh_press_and_its_triggers_are_no_levers():
    joints = [replace(joint, driven=True, q_dot_up=0.2) for joint in BROKK_170.joints]
    machine = replace(BROKK_170, joints=tuple(joints))
    device = Virtual()
    device.button(input_handler.PAD_SWITCH, True)
    device.axis(2, -1.0)  # as a trigger rests
    device.axis(5, -1.0)
    pygame.display.set_mode((10, 10))
    operator = Operator(["levers"])
    operator.handler = InputHandler(machine, pygame, ["levers"])  # the gamepad is there before it
    request = operator.look()
    assert operator.handler.pad is not None
    assert not request.levers.any()
    assert not request.enable
    device.button(input_handler.PAD_SWITCH, False)
    operator.look()
    device.button(input_handler.PAD_SWITCH, True)
    assert operator.look().enable
    device.unplug()
    assert not operator.look().alive
