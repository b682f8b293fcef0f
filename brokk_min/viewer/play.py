"""A window in which you drive a simulated machine by hand, with keyboard or gamepad.

One loop reads the operator, lets controller and plant go on by a tick, and draws a picture, 20
times a second. On a busy computer the machine therefore moves slower than life; nothing else
depends on timing.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any

import numpy as np

from brokk_min.actuator import PLANT, Plant
from brokk_min.can.operator_input import shape_axis
from brokk_min.can.simulated_machine import start_pose
from brokk_min.env import initial_state, measure, transition
from brokk_min.evaluation.rollout import Controller
from brokk_min.kinematics import forward_kinematics, tool_position
from brokk_min.machine import Array, Machine
from brokk_min.viewer.drawing import BLUE, ORANGE, Scene, draw, load_pygame

SIZE, SMALLEST = (1120, 680), (640, 360)  # px, of the window at first and of a picture
RISE = 0.25  # s from a key's press to full deflection (assumed)
TRAIL = 600  # positions of the tool that are shown
# Keys for and against x, y and z, as the top view shows them, and axes for them: of a gamepad that
# SDL knows, and of another one, whose axes 2 and 5 are mostly triggers.
KEYS = (("up", "down"), ("left", "right"), ("w", "s"))
AXES, OTHER_AXES = (1, 0, 3), (1, 0, 4)
ACTIONS = {"escape": "close", "tab": "controller", "r": "restart"}
BUTTONS = {3: "controller", 1: "restart"}  # Y and B of an Xbox pad
NOTES = (
    "arrows: x (up, down) and y (left, right)",
    "W, S: z (up, down)    SHIFT: slowly",
    "TAB: the other controller",
    "R: back to the start    ESC: end",
    "gamepad: both sticks; Y and B are TAB and R",
)


class Operator:
    """Keyboard and gamepad as one operator."""

    def __init__(self, machine: Machine, pygame: Any) -> None:
        self.machine, self.pygame = machine, pygame
        self.held: set[str] = set()  # keys
        self.deflection: Array = np.zeros(3)
        self.pad: Any = None
        self.known = False  # does SDL know the gamepad?
        pygame.joystick.init()  # a gamepad that is there is an event, too
        self.gamepads = import_module("pygame._sdl2.controller")
        self.gamepads.init()

    def handle(self, event: Any) -> str:
        """Take in an event of pygame, and say which of `ACTIONS` it asks for, if any."""
        pg = self.pygame
        if event.type == pg.QUIT:
            return "close"
        if event.type == pg.KEYDOWN:
            self.held.add(pg.key.name(event.key))
            return ACTIONS.get(pg.key.name(event.key), "")
        if event.type == pg.KEYUP:
            self.held.discard(pg.key.name(event.key))
        elif event.type == pg.WINDOWFOCUSLOST:
            self.held.clear()
        elif event.type == (pg.CONTROLLERBUTTONDOWN if self.known else pg.JOYBUTTONDOWN):
            return BUTTONS.get(event.button, "")
        elif event.type == pg.JOYDEVICEADDED:
            self.known = self.gamepads.is_controller(event.device_index)
            pads = self.gamepads.Controller if self.known else pg.joystick.Joystick
            self.pad = pads(event.device_index)
        elif event.type == pg.JOYDEVICEREMOVED:
            self.pad = None
        return ""

    def velocity(self) -> Array:
        """Goal velocity of the tool [m/s] (3,) for the next tick.

        Keys ramp up over `RISE`, and a released key is at rest at once.
        """
        target = np.array([float(p in self.held) - float(m in self.held) for p, m in KEYS])
        if self.held & {"left shift", "right shift"}:
            target /= 3
        if self.pad is not None:
            numbers, full = (AXES, 32767) if self.known else (OTHER_AXES, 1)
            axes = [self.pad.get_axis(i) / full for i in numbers]  # one that it lacks reads 0
            target = np.clip(target - shape_axis(axes), -1, 1)
        step = self.machine.dt / RISE
        last = np.where(target * self.deflection > 0, self.deflection, 0.0)
        self.deflection = last + np.clip(target - last, -step, step) * (target != 0)
        length = max(1.0, float(np.linalg.norm(self.deflection)))
        return np.asarray(self.machine.tool_speed * self.deflection / length)


@dataclass
class Session:
    """A simulated machine, and the controller that drives it now."""

    machine: Machine
    controllers: dict[str, Controller]
    q_start: Array  # rad, (n,)
    plant: Plant = PLANT

    def __post_init__(self) -> None:
        self.name = next(iter(self.controllers))
        self.restart()

    def restart(self) -> None:
        """Back to the start pose, at rest."""
        self.state = initial_state(self.machine, self.q_start[None], np.zeros(3), self.plant)
        self.memory = self.controllers[self.name].start(1)
        self.trail = self.tool[None]

    def controller(self) -> None:
        """The next controller goes on from here."""
        names = list(self.controllers)
        self.name = names[(names.index(self.name) + 1) % len(names)]
        self.memory = self.controllers[self.name].start(1)

    @property
    def tool(self) -> Array:
        """Position of the tool now [m], (3,)."""
        return tool_position(forward_kinematics(self.machine, self.state.q[0]))

    def tick(self, v_goal: Array) -> None:
        """Controller and plant go on by a tick, with this goal velocity [m/s] (3,)."""
        self.state = replace(self.state, v_goal=v_goal.astype(np.float32)[None])
        measured = measure(self.machine, self.state.history, self.state.v_goal)
        u, self.memory = self.controllers[self.name](measured, self.memory)
        self.state = transition(self.machine, self.plant, self.state, u)
        self.trail = np.vstack([self.trail, self.tool])[-TRAIL:]

    def scene(self) -> Scene:
        """What the window shows now."""
        s = self.state
        status = f"{s.ticks[0] * self.machine.dt:.1f} s"
        colour = ORANGE if list(self.controllers).index(self.name) % 2 else BLUE
        tool = s.v_goal[0], s.v_tool[0], self.trail
        return Scene(s.q[0], s.history[0, :, 2, -1], *tool, self.name, status, colour, NOTES)


def play(machine: Machine, controllers: dict[str, Controller], plant: Plant = PLANT) -> None:
    """Drive a simulated machine in a window, until it is closed.

    The window shows the names of the `controllers`. ValueError: no pygame, or no display.
    """
    q = start_pose(machine, ())
    with window(f"brokk_min: {machine.name}") as pygame:
        session, operator = Session(machine, controllers, q, plant), Operator(machine, pygame)
        clock = pygame.time.Clock()
        while True:
            for event in pygame.event.get():
                action = operator.handle(event)
                if action == "close":
                    return
                if action:
                    getattr(session, action)()
            session.tick(operator.velocity())
            show(pygame, machine, session.scene())
            clock.tick(machine.rate)


@contextmanager
def window(title: str) -> Iterator[Any]:
    """An open window, as the module pygame.

    Without a display SDL would draw unseen; that is refused unless SDL_VIDEODRIVER asks for it.
    """
    pygame = load_pygame()
    try:
        pygame.display.init()
        pygame.display.set_mode(SIZE, pygame.RESIZABLE)
        unseen = pygame.display.get_driver() in ("offscreen", "dummy")
        if unseen and not os.environ.get("SDL_VIDEODRIVER"):
            raise pygame.error("none")
        pygame.display.set_caption(title)
        yield pygame
    except pygame.error as error:
        hint = "SDL_VIDEODRIVER=dummy draws unseen"
        raise ValueError(f"window: expected a display ({hint}), got {error}") from error
    finally:
        pygame.display.quit()


def show(pygame: Any, machine: Machine, scene: Scene) -> None:
    """Fill the window with a scene."""
    width, height = np.maximum(pygame.display.get_window_size(), SMALLEST).tolist()
    pygame.display.get_surface().blit(draw(machine, scene, (width, height)), (0, 0))
    pygame.display.flip()
