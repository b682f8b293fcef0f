"""Who asks for motion, tick by tick: a script of velocity goals, or a hand on a joystick.

An operator is called with what the gate says and gives a `OperatorInput`. A script plays the part of a hand, dead-man
switch and all, so that it passes the same gate.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from brokk_min.can.canopen import OperatorInput
from brokk_min.env import Measured
from brokk_min.identification.files import require
from brokk_min.machine import PWM_MAX, Array, Machine


class Script:
    """Velocity goals (T, 3) [m/s] one after another, as soon as the gate is ready; then the end.

    ValueError: a goal faster than the machine's `tool_speed`.
    """

    def __init__(self, machine: Machine, goals: Array, patience_s: float = 5.0) -> None:
        fastest = np.linalg.norm(goals, axis=-1).max()
        if not fastest <= machine.tool_speed * (1 + 1e-9):
            raise ValueError(
                f"command: expected at most {machine.tool_speed} m/s, got {fastest:.3g} m/s"
            )
        self.goals, self.tick, self.pressed = goals, 0, False
        self.patience = round(patience_s * machine.rate)

    def __call__(self, driving: bool, ready: bool) -> OperatorInput:
        """The wish of this tick; stops at the end, after a fault, or if the machine never gets ready."""
        if driving and self.tick < len(self.goals):
            x, y, z = map(float, self.goals[self.tick])
            self.tick += 1
            return OperatorInput((x, y, z), enable=True)
        if driving or self.tick or not self.patience:
            return OperatorInput(stop=True)
        self.pressed, self.patience = ready and not self.pressed, self.patience - 1
        return OperatorInput(enable=self.pressed)

    @property
    def done(self) -> bool:
        """Were all goals given?"""
        return self.tick == len(self.goals)


class Joystick:
    """A joystick through pygame: a button held is the dead-man switch, three axes are the tool velocity.

    Args:
        machine: whose `tool_speed` full deflection asks for.
        axes: of the stick, for x, y and z; each counts negative forward, left and up.
        button: dead-man switch.
    """

    def __init__(self, machine: Machine, axes: Sequence[int] = (1, 0, 4), button: int = 5) -> None:
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # events need a window, or this
        os.environ.setdefault("SDL_JOYSTICK_ALLOW_BACKGROUND_EVENTS", "1")
        pygame = require("pygame", "play")
        pygame.display.init()
        pygame.joystick.init()
        if not pygame.joystick.get_count():
            raise ValueError("joystick: expected one, got none")
        self.pygame, self.speed, self.axes, self.button = pygame, machine.tool_speed, axes, button
        self.stick: Any = pygame.joystick.Joystick(0)
        found = self.stick.get_numaxes(), self.stick.get_numbuttons()
        if max(axes) >= found[0] or button >= found[1]:
            raise ValueError(
                f"joystick: expected axes {list(axes)} and button {button}, got {found[0]} and {found[1]}"
            )

    def __call__(self, driving: bool, ready: bool) -> OperatorInput:
        """The wish of this tick. A device that is gone reads zero on all axes, so its removal is told."""
        for event in self.pygame.event.get():
            if event.type == self.pygame.JOYDEVICEADDED and not self.stick:
                self.stick = self.pygame.joystick.Joystick(event.device_index)
            elif event.type == self.pygame.JOYDEVICEREMOVED and self.stick:
                self.stick = (
                    None if event.instance_id == self.stick.get_instance_id() else self.stick
                )
        if not self.stick:
            return OperatorInput(alive=False)
        v = -shape_axis([self.stick.get_axis(i) for i in self.axes]) * self.speed
        x, y, z = map(float, v / max(1.0, float(np.linalg.norm(v)) / self.speed))
        return OperatorInput((x, y, z), enable=bool(self.stick.get_button(self.button)))


@dataclass(frozen=True)
class JointJog:
    """A controller for bringing up: a small command on one joint, its sign that of the wanted x velocity."""

    machine: Machine
    joint: str
    counts: int  # of 127

    def start(self, num: int) -> None:
        """Nothing to remember."""

    def __call__(self, measured: Measured, memory: None) -> tuple[Array, None]:
        """Commands u (..., n)."""
        v_goal = measured.v_goal[..., :1]
        asked = np.sign(v_goal) * (np.abs(v_goal) > 0.1 * self.machine.tool_speed)
        chosen = np.array([name == self.joint for name in self.machine.names])
        return asked * chosen * self.counts / PWM_MAX, None


def shape_axis(axis: ArrayLike) -> Array:
    """Deflection in [-1, 1] with a dead zone of 12 %, and flatter near the middle: (1 - expo) s + expo s^3.

    Example:
        >>> shape_axis([-1.0, 0.1, 0.56, 1.0])
        array([-1.   ,  0.   ,  0.275,  1.   ])
    """
    axis, dead, expo = np.asarray(axis, float), 0.12, 0.6  # assumed
    s = np.sign(axis) * np.maximum(0.0, np.abs(axis) - dead) / (1 - dead)
    return np.asarray((1 - expo) * s + expo * s**3)
