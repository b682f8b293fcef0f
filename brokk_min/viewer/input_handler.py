"""Keyboard and gamepad as one operator, for the window of `play`."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from brokk_min.can.operator_input import shape_axis
from brokk_min.machine import Array, Machine
from brokk_min.viewer.control_process import Request

RISE = 0.25  # s from a key's press to full deflection (assumed)
# plus and minus of x, y, z, as the top view shows them; of the driven joints
VELOCITY_KEYS = (("up", "down"), ("left", "right"), ("w", "s"))
LEVER_KEYS = (("q", "a"), ("w", "s"), ("e", "d"), ("r", "f"), ("t", "g"), ("y", "h"))
PAD_AXES = (1, 0, 4, 3)  # 2 and 5 are triggers, which do not rest in the middle
PAD_SWITCH = 5
PAD_BUTTONS = {3: "mode", 0: "next", 1: "again"}
KEYS = {"escape": "close", "tab": "mode", "return": "next", "backspace": "again", "c": "compare"}


@dataclass
class InputHandler:
    """Keyboard and gamepad as one operator.

    The dead-man switch (space, or the gamepad's button) counts only if it is pressed with nothing
    deflected. It must be released first after a loss of focus or gamepad and a change of mode.
    """

    machine: Machine  # its driven joints have a lever each
    pygame: Any  # the module, with a window
    modes: Sequence[str]  # names of the controllers, the last one "levers"

    def __post_init__(self) -> None:
        self.mode = 0
        self.time = time.monotonic()  # of the last request [s]
        self.held = set[str]()  # keys
        self.focus = True
        self.blocked = True  # must the switch be released first?
        self.enable = False
        self.lost = False  # gamepad unplugged?
        self.closed = False
        self.task = ""  # "next", "again" or "compare"
        self.deflection: Array = np.zeros(3)
        joystick = self.pygame.joystick
        joystick.init()
        self.pad: Any = joystick.Joystick(0) if joystick.get_count() else None

    @property
    def by_joint(self) -> bool:
        """Does the operator move the joints one by one?"""
        return self.modes[self.mode] == "levers"

    def handle(self, event: Any) -> None:
        """Take in one event of pygame."""
        pg = self.pygame
        match event.type:
            case pg.QUIT:
                self.closed = True
            case pg.KEYDOWN:
                key = pg.key.name(event.key)
                self.held.add(key)
                self.lost = False  # the keyboard takes over
                self._press(KEYS.get(key, ""))
            case pg.KEYUP:
                self.held.discard(pg.key.name(event.key))
            case pg.WINDOWFOCUSLOST:
                self.focus = False
                self.blocked = True
                self.held.clear()
            case pg.WINDOWFOCUSGAINED:
                self.focus = True
            case pg.JOYBUTTONDOWN:
                self._press(PAD_BUTTONS.get(event.button, ""))
            case pg.JOYDEVICEADDED if self.pad is None:
                self._change_pad(pg.joystick.Joystick(event.device_index))
            case pg.JOYDEVICEREMOVED if (
                self.pad and event.instance_id == self.pad.get_instance_id()
            ):
                self._change_pad(None)

    def _press(self, meaning: str) -> None:
        """A key or button that means something besides motion."""
        if meaning == "close":
            self.closed = True
        elif meaning == "mode":
            self.mode = (self.mode + 1) % len(self.modes)
            self.blocked = True
        elif meaning:
            self.task = meaning

    def _change_pad(self, pad: Any) -> None:
        self.pad = pad
        self.lost = pad is None
        self.blocked = True

    def request(self, now: float) -> Request:
        """The operator's input at a time [s]."""
        target = self._target()
        if self.deflection.shape != target.shape:
            self.deflection = np.zeros_like(target)
        last = np.where(target * self.deflection < 0, 0.0, self.deflection)
        step = (now - self.time) / RISE
        self.time = now
        ramp = last + np.clip(target - last, -step, step)
        self.deflection = np.where(target == 0, 0.0, ramp)  # released: neutral at once
        self._update_switch(bool(target.any()))
        no_levers = np.zeros(len(self.machine.driven))
        request = Request(now, self.mode, self.enable, not self.lost, np.zeros(3), no_levers)
        if self.by_joint:
            return request._replace(levers=self.deflection)
        length = float(np.linalg.norm(self.deflection))
        return request._replace(v_goal=self.machine.tool_speed * self.deflection / max(1.0, length))

    def _target(self) -> Array:
        """Deflections of stick or levers in [-1, 1]; keys give a third of it with shift."""
        pairs = LEVER_KEYS[: len(self.machine.driven)] if self.by_joint else VELOCITY_KEYS
        target = np.zeros(len(self.machine.driven) if self.by_joint else 3)
        target[: len(pairs)] = [float(p in self.held) - float(m in self.held) for p, m in pairs]
        if not self.focus:
            return np.zeros_like(target)
        if self.held & {"left shift", "right shift"}:
            target /= 3
        if self.pad is not None:
            axes = [i for i in PAD_AXES[: len(target)] if i < self.pad.get_numaxes()]
            target[: len(axes)] -= shape_axis([self.pad.get_axis(i) for i in axes])
        return np.asarray(np.clip(target, -1, 1))

    def _update_switch(self, deflected: bool) -> None:
        has_button = self.pad is not None and self.pad.get_numbuttons() > PAD_SWITCH
        button = has_button and self.pad.get_button(PAD_SWITCH)
        pressed = self.focus and ("space" in self.held or bool(button))
        if pressed and deflected and not self.enable:
            self.blocked = True
        elif self.focus and not pressed:
            self.blocked = False
        self.enable = pressed and not self.blocked
