"""Script, its file, joystick and joint jog; the joystick is SDL's virtual one."""

import re
from types import SimpleNamespace

import numpy as np
import pygame
import pytest
from helpers_bus import Virtual

from brokk_min.can.canopen import OperatorInput
from brokk_min.can.operator_input import JointJog, Joystick, Script, read_commands, shape_axis
from brokk_min.machine import BROKK_170

HEAD = "sequence,time,vx,vy,vz\n"
TWO_GOALS = np.array([[0.1, 0, 0], [0, 0.2, 0]])


def test_read_commands__holds_values_until_the_next_row(tmp_path):
    path = tmp_path / "c.csv"
    rows = "a,5,.1,.2,.1\na,5.1,0,.3,0\na,5.15,0,0,0\nb,0,0,.1,-.2\nb,0.05,9,9,9\n"
    path.write_text(HEAD + rows)
    goals = read_commands(path, BROKK_170)
    assert list(goals) == ["a", "b"]
    assert goals["a"].tolist() == [[0.1, 0.2, 0.1], [0.1, 0.2, 0.1], [0, 0.3, 0]]
    assert goals["b"].tolist() == [[0, 0.1, -0.2]]


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("a,1,0,0,0\na,0,0,0,0\n", "sequence a: expected two or more rows"),
        ("a,1,0,0,0\na,1.01,0,0,0\n", "a tick or more .*, got .0.0, 0.01"),
        ("a,1,0,0,inf\na,2,0,0,0\n", "two or more rows of finite"),
        ("a,1,0.3,0.4,0\na,2,0,0,0\n", "a: expected at most tool_speed, 0.3 m/s, got 0.5 m/s"),
        ("a,1,100,0,0\na,2,0,0,0\n", "a: expected at most tool_speed, 0.3 m/s, got 100 m/s"),
        ("a,1,0.1,0,0\na,9001,0,0,0\n", "a motion within 11.9 m, got 900 m: is time in s?"),
        ("a,1,0,0,0\na,1e12,0,0,0\n", "at most 86400 s"),
        ("", "expected rows, got none"),
    ],
)
def test_read_commands__refuses_what_is_no_sequence(tmp_path, rows, message):
    path = tmp_path / "c.csv"
    path.write_text(HEAD + rows)
    with pytest.raises(ValueError, match=f"^{path}: .*{message}"):
        read_commands(path, BROKK_170)


def test_script__waits_presses_plays_and_ends():
    script = Script(BROKK_170, TWO_GOALS)
    assert script(False, False) == OperatorInput()
    assert script(False, True) == OperatorInput(enable=True)
    assert script(False, True) == OperatorInput()  # it did not arm: let go, and press again
    assert script(False, True) == OperatorInput(enable=True)
    assert script(True, True) == OperatorInput((0.1, 0.0, 0.0), enable=True) and not script.done
    assert script(True, True) == OperatorInput((0.0, 0.2, 0.0), enable=True) and script.done
    assert script(True, True).stop


def test_script__stops_after_a_fault_and_if_the_machine_never_gets_ready():
    script = Script(BROKK_170, TWO_GOALS)
    assert script(False, True).enable and script(True, True).enable
    assert script(False, True) == OperatorInput(stop=True) and not script.done
    script = Script(BROKK_170, TWO_GOALS)
    assert [script(False, False).stop for _ in range(101)] == [False] * 100 + [True]


def test_joystick__gives_switch_and_velocity_of_a_virtual_device():
    device = Virtual()
    stick = Joystick(BROKK_170)
    assert stick(False, False) == OperatorInput()
    device.button(5, True)
    device.axis(1, -1.0)
    device.axis(0, 0.1)  # within the dead zone
    assert stick(True, True).enable
    assert stick(True, True).v_goal == pytest.approx((0.3, 0.0, 0.0), abs=1e-4)
    device.axis(0, 1.0)
    device.axis(4, -0.56)
    expected = 0.3 * np.array([1, -1, 0.275]) / np.linalg.norm([1, -1, 0.275])  # in a corner
    assert stick(True, True).v_goal == pytest.approx(expected, abs=1e-4)
    device.button(5, False)
    assert not stick(True, True).enable
    for _ in range(3):  # of 65,535 events that SDL keeps, in a long drive
        for _ in range(30_000):
            pygame.event.post(pygame.event.Event(pygame.JOYAXISMOTION))
        stick(True, True)
    device.unplug()
    assert stick(True, True) == stick(True, True) == OperatorInput(alive=False)


def test_joystick__refuses_a_device_without_its_axes_or_button(monkeypatch):
    with pytest.raises(ValueError, match="joystick: expected one, or --command"):
        Joystick(BROKK_170)
    device = Virtual()
    for axes, button in (([1, 0, 6], 5), ([1, 0, -1], 5), ([1, 0, 4], 8), ([1, 0, 4], -1)):
        refusal = f"joystick: expected axes {axes} and button {button}, got 6 axes and 8 buttons"
        with pytest.raises(ValueError, match=re.escape(refusal)):
            Joystick(BROKK_170, axes, button)
    device.unplug()
    pygame.display.quit()
    monkeypatch.setenv("SDL_VIDEODRIVER", "nonsense")
    with pytest.raises(ValueError, match="joystick: expected SDL to start, got nonsense"):
        Joystick(BROKK_170)


def test_joint_jog__moves_one_joint_with_the_sign_of_x():
    jog = JointJog(BROKK_170, "q4", 14 / 127)
    for v_x, counts in ((0.1, 14), (-0.2, -14), (0.02, 0)):
        measured = SimpleNamespace(v_goal=np.array([[v_x, 0.1, -0.1]]))
        u, _ = jog(measured, jog.start(1))
        np.testing.assert_allclose(u * 127, [[0, 0, 0, counts, 0]])


def test_shape_axis__is_odd_flat_near_the_middle_and_full_at_the_ends():
    """Beyond the dead zone of 12 % half a deflection is 0.4 x 0.5 + 0.6 x 0.125 = 0.275."""
    np.testing.assert_array_equal(shape_axis([0.0, 0.12, -0.12]), 0.0)
    np.testing.assert_allclose(shape_axis([1.0, -1.0, 0.56, -0.56]), [1.0, -1.0, 0.275, -0.275])
