"""Operators: a script of velocity goals, or a joystick; and a controller that jogs one joint."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from brokk_min._files import brief, numbers, read_csv, require_package
from brokk_min.can.canopen import OperatorInput
from brokk_min.machine import Array, Machine, Measured, require

DAY = 86400.0  # s, assumed: nobody's script is longer
PATIENCE = 5.0  # s that a script waits until the machine is ready


def read_commands(path: Path, machine: Machine) -> dict[str, Array]:
    """Goals (T, 3) [m/s] of each sequence of a CSV `sequence,time,vx,vy,vz` [s, m/s], by its name.

    Values hold until the next row; the last row of a sequence is its end. ValueError: no such
    table, rows below a tick apart, goals faster than the machine's tool speed, or that lead farther
    than any arm.
    """
    names = ("time", "vx", "vy", "vz")
    table = read_csv(path, "sequence", *names)
    columns = np.stack([numbers(path, name, table[name]) for name in names], axis=1)
    sequence = np.char.strip(table["sequence"])
    reach = 2 * sum(abs(joint.a) + abs(joint.d) for joint in machine.joints)  # m
    goals = {}
    for name in dict.fromkeys(sequence.tolist()):
        rows = columns[sequence == name]
        time, velocity = rows[:, 0] - rows[0, 0], rows[:, 1:]
        fits = len(time) > 1 and (np.diff(time) > 0.99 * machine.dt).all() and np.isfinite(rows)
        wanted = "two or more rows of finite numbers, each a tick or more after the one before"
        got = brief(time.tolist() if np.isfinite(rows).all() else rows.tolist())
        require(bool(np.all(fits)), f"{path}: sequence {name}", wanted, got)
        require(time[-1] <= DAY, f"{path}: sequence {name}", f"at most {DAY:g} s", time[-1])
        fastest = float(np.linalg.norm(velocity[:-1], axis=-1).max())
        slow = fastest <= machine.tool_speed * (1 + 1e-9)
        wanted = f"at most tool_speed, {machine.tool_speed} m/s"
        require(slow, f"{path}: sequence {name}", wanted, f"{fastest:.3g} m/s")
        path_of_tool = np.cumsum(velocity[:-1] * np.diff(time)[:, None], axis=0)
        farthest = float(np.abs(path_of_tool).max())
        wanted, got = f"a motion within {reach:.3g} m", f"{farthest:.3g} m: is time in s?"
        require(farthest <= reach, f"{path}: sequence {name}", wanted, got)
        tick = np.arange(round(time[-1] * machine.rate))
        row = np.searchsorted(time, tick / machine.rate + 1e-6, "right") - 1
        goals[name] = velocity[row]
    return goals


class Script:
    """Velocity goals (T, 3) [m/s] one by one."""

    def __init__(self, machine: Machine, goals: Array) -> None:
        self.goals = goals
        self.tick = 0
        self.pressed = False
        self.patience = round(PATIENCE * machine.rate)  # ticks until it gives up

    def __call__(self, driving: bool, ready: bool) -> OperatorInput:
        """Presses the switch, too; stops at the end, after a fault, or if it never gets ready."""
        if driving and not self.done:
            x, y, z = self.goals[self.tick].tolist()
            self.tick += 1
            return OperatorInput((x, y, z), enable=True)
        if driving or self.tick or not self.patience:
            return OperatorInput(stop=True)
        self.pressed = ready and not self.pressed
        self.patience -= 1
        return OperatorInput(enable=self.pressed)

    @property
    def done(self) -> bool:
        """Were all goals given?"""
        return self.tick == len(self.goals)


class Joystick:
    """A joystick through pygame: a button is the dead-man switch, three axes the tool velocity.

    Full deflection is the machine's `tool_speed`; the axes, for x, y and z, count negative
    forward, left and up. ValueError: no pygame, no joystick, or one without axes and button.
    """

    def __init__(self, machine: Machine, axes: Sequence[int] = (1, 0, 4), button: int = 5) -> None:
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # events need a window, or this
        os.environ.setdefault("SDL_JOYSTICK_ALLOW_BACKGROUND_EVENTS", "1")
        self.pygame = require_package("pygame", "play")
        try:
            self.pygame.display.init()
            self.pygame.joystick.init()
        except self.pygame.error as error:
            raise ValueError(f"joystick: expected SDL to start, got {error}") from error
        found = self.pygame.joystick.get_count() > 0
        require(found, "joystick", "one, or --command FILE.csv", "none")
        self.speed, self.axes, self.button = machine.tool_speed, axes, button
        self.stick: Any = self.pygame.joystick.Joystick(0)
        self.alive = True
        num_axes, num_buttons = self.stick.get_numaxes(), self.stick.get_numbuttons()
        fits = 0 <= min(axes) <= max(axes) < num_axes and 0 <= button < num_buttons
        wanted = f"axes {list(axes)} and button {button}"
        require(fits, "joystick", wanted, f"{num_axes} axes and {num_buttons} buttons")

    def __call__(self, driving: bool, ready: bool) -> OperatorInput:
        """Velocity and switch; a device that is gone reads zero, so its removal is an event."""
        number = self.stick.get_instance_id()
        for event in self.pygame.event.get():  # all kinds, because a full queue takes no more
            if event.type == self.pygame.JOYDEVICEREMOVED and event.instance_id == number:
                self.alive = False
        if not self.alive:
            return OperatorInput(alive=False)
        deflection = -shape_axis([self.stick.get_axis(i) for i in self.axes])
        length = max(1.0, float(np.linalg.norm(deflection)))
        x, y, z = (self.speed * deflection / length).tolist()
        return OperatorInput((x, y, z), enable=bool(self.stick.get_button(self.button)))


def shape_axis(axis: ArrayLike) -> Array:
    """Deflection in [-1, 1]: dead zone of 12 %, beyond it (1 - 0.6) s + 0.6 s^3 (assumed)."""
    axis = np.asarray(axis, float)
    s = np.sign(axis) * np.maximum(0.0, np.abs(axis) - 0.12) / (1 - 0.12)
    return np.asarray((1 - 0.6) * s + 0.6 * s**3)


@dataclass(frozen=True)
class JointJog:
    """A controller that gives one joint a small command, with the sign of the goal's x velocity."""

    machine: Machine
    joint: str
    u: float  # command in [-1, 1]

    def start(self, num: int) -> None:
        """It has no state."""

    def __call__(self, measured: Measured, state: None) -> tuple[Array, None]:
        """Commands u (..., n)."""
        v_x = measured.v_goal[..., :1]
        side = np.sign(v_x) * (np.abs(v_x) > 0.1 * self.machine.tool_speed)
        chosen = np.array(self.machine.names) == self.joint
        return side * chosen * self.u, None
