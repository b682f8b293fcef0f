"""A window in which you drive a simulated machine, tick by tick, with keyboard or gamepad."""

import os
from collections import deque
from importlib import import_module
from itertools import cycle
from typing import Any

import numpy as np

from brokk_min._files import require_package
from brokk_min.actuator import PLANT, Plant
from brokk_min.can.operator_input import shape_axis
from brokk_min.can.simulated_machine import start_pose
from brokk_min.env import initial_state, measure, transition
from brokk_min.kinematics import forward_kinematics, tool_position
from brokk_min.machine import Array, Controller, Machine
from brokk_min.viewer.drawing import Scene, draw

WINDOW = (1120, 680)  # px, of the window
TRAIL = 600  # positions of the tool that are shown
# keys for and against x, y and z, as the top view shows them, and axes of a gamepad for them
KEYS = (("up", "down"), ("left", "right"), ("w", "s"))
PAD_AXES = (1, 0, 3)
UNSEEN = "SDL_VIDEODRIVER=dummy draws unseen"
HELP = """arrows: along x and y
W, S: up and down
left SHIFT: slowly
TAB: the other controller
F1: these keys
ESC: end"""
HELP_SECONDS = 10.0  # for which it stands there at first


class Keyboard:
    """The keyboard, and a gamepad that SDL knows, as one device."""

    def __init__(self, machine: Machine, pygame: Any) -> None:
        self.machine, self.pygame = machine, pygame
        self.pad: Any = None
        self.gamepads = import_module("pygame._sdl2.controller")
        self.gamepads.init()  # a gamepad that is there is an event, too

    def handle(self, event: Any) -> str:
        """Take in an event; the key that it presses, which is "escape" for a closed window, too."""
        if event.type == self.pygame.CONTROLLERDEVICEADDED:
            self.pad = self.gamepads.Controller(event.device_index)
        if event.type == self.pygame.QUIT:
            return "escape"
        return str(self.pygame.key.name(event.key)) if event.type == self.pygame.KEYDOWN else ""

    def velocity(self) -> Array:
        """Goal velocity of the tool [m/s] (3,) for the next tick."""
        pressed, code = self.pygame.key.get_pressed(), self.pygame.key.key_code
        keys = [float(pressed[code(p)]) - float(pressed[code(m)]) for p, m in KEYS]
        target = np.array(keys) / (3 if pressed[code("left shift")] else 1)
        if self.pad is not None:
            target -= shape_axis([self.pad.get_axis(i) / 32767 for i in PAD_AXES])
        length = max(1.0, float(np.linalg.norm(target)))
        return np.asarray(self.machine.tool_speed * target / length)


class Session:
    """A simulated machine, and the controller that drives it now."""

    def __init__(self, machine: Machine, controllers: dict[str, Controller], plant: Plant) -> None:
        self.machine, self.plant = machine, plant
        self.state = initial_state(machine, start_pose(machine)[None], np.zeros(3), plant)
        self.trail: deque[Array] = deque(maxlen=TRAIL)  # of the tool [m]
        self.turns = cycle(controllers.items())
        self.seconds, self.help_until = 0.0, HELP_SECONDS
        self.switch()

    def switch(self) -> None:
        """The next controller goes on from here."""
        self.name, self.controller = next(self.turns)
        self.memory = self.controller.start(1)

    def toggle_help(self) -> None:
        """Show the keys, or hide them."""
        self.help_until = 0.0 if self.seconds < self.help_until else np.inf

    def tick(self, v_goal: Array) -> Scene:
        """Controller and plant go on by a tick, with this goal velocity [m/s] (3,)."""
        self.state = self.state._replace(v_goal=v_goal.astype(np.float32)[None])
        measured = measure(self.machine, self.state.history, self.state.v_goal)
        u, self.memory = self.controller(measured, self.memory)
        self.state = s = transition(self.machine, self.plant, self.state, u)
        self.trail.append(tool_position(forward_kinematics(self.machine, s.q[0])))
        self.seconds = float(s.ticks[0] * self.machine.dt)
        trail, status = np.array(self.trail), f"{self.seconds:.1f} s"
        notes = HELP if self.seconds < self.help_until else ""
        return Scene(s.q[0], u[0], s.v_goal[0], s.v_tool[0], trail, self.name, status, notes)


def play(machine: Machine, controllers: dict[str, Controller], plant: Plant = PLANT) -> None:
    """Drive a simulated machine in a window, until it is closed; ValueError: no display."""
    pygame = require_package("pygame", "play")
    try:
        window, clock = open_window(pygame), pygame.time.Clock()
        session, keyboard = Session(machine, controllers, plant), Keyboard(machine, pygame)
        while True:
            for event in pygame.event.get():
                key = keyboard.handle(event)
                if key == "escape":
                    return
                if key == "tab":
                    session.switch()
                if key == "f1":
                    session.toggle_help()
            scene = session.tick(keyboard.velocity())
            pixels = draw(machine, scene, WINDOW).tobytes()
            window.blit(pygame.image.frombytes(pixels, WINDOW, "RGB"), (0, 0))
            pygame.display.flip()
            clock.tick(machine.rate)
    except pygame.error as error:
        raise ValueError(f"window: expected a display ({UNSEEN}), got {error}") from error
    finally:
        pygame.display.quit()


def open_window(pygame: Any) -> Any:
    """A new window. Without a display SDL draws unseen: refused unless SDL_VIDEODRIVER is set."""
    window = pygame.display.set_mode(WINDOW)
    unseen = pygame.display.get_driver() in ("offscreen", "dummy")
    if unseen and "SDL_VIDEODRIVER" not in os.environ:
        raise pygame.error("none")
    pygame.display.set_caption("brokk_min: F1 shows the keys")
    return window
