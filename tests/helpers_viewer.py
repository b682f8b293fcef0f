"""What several tests of the window need: keys, and the loop behind a pipe on an injected clock."""

import multiprocessing

import numpy as np
import pygame
from helpers_bus import START, ConstantCommand, World

from brokk_min.can.drive_log import Telemetry
from brokk_min.kinematics import forward_kinematics, tool_position
from brokk_min.machine import BROKK_170
from brokk_min.viewer.control_process import Request, WindowDrive, WindowInput, receive_telemetry
from brokk_min.viewer.drawing import NO_POINTS
from brokk_min.viewer.input_handler import InputHandler
from brokk_min.viewer.replay import Run

MODES = ["rl", "jacobian", "levers"]


def post(kind, **more):
    pygame.event.post(pygame.event.Event(kind, **more))


def post_key(name, down=True):
    post(pygame.KEYDOWN if down else pygame.KEYUP, key=pygame.key.key_code(name))


def tool(q):
    return tool_position(forward_kinematics(BROKK_170, np.array(q)))


def telemetry(tick=0, q=START, **more):
    """A machine at rest that is driven with closed valves."""
    zero = np.zeros(len(q))
    return Telemetry(tick, np.array(q), zero, zero, np.zeros(3), True)._replace(**more)


def run_of(ticks, path=NO_POINTS):
    """The cabin turns; each array has other numbers in each tick."""
    q = np.array(START) + 0.01 * np.arange(ticks)[:, None] * np.eye(5)[0]
    u = np.linspace(-1, 1, 5 * ticks).reshape(ticks, 5)
    v_goal = np.linspace(0, 0.3, 3 * ticks).reshape(ticks, 3)
    return Run(BROKK_170, "rl", (1, 2, 3), q, 0.1 * u, u, v_goal, path)


class Operator:
    """Presses keys of an `InputHandler` through pygame's queue; its clock stands at `now`."""

    def __init__(self, modes=MODES, machine=BROKK_170):
        pygame.display.set_mode((10, 10))
        pygame.event.clear()
        self.handler = InputHandler(machine, pygame, modes)
        self.handler.time = self.now = 0.0
        self.look()

    def look(self, seconds=0.5):
        for event in pygame.event.get():
            self.handler.handle(event)
        self.now += seconds
        return self.handler.request(self.now)

    def key(self, name, down=True, seconds=0.5):
        post_key(name, down)
        return self.look(seconds)

    def event(self, kind, **more):
        post(kind, **more)
        return self.look()


class PipedLoop:
    """The loop of a window on an injected clock, and the window's end of its pipe."""

    def __init__(self, *controllers, log=None):
        self.connection, there = multiprocessing.Pipe()
        self.world = World(ConstantCommand(), lambda driving, ready: None, log=log)
        window = WindowInput(BROKK_170, controllers, there, lambda: self.world.time)
        self.world.drive = WindowDrive(window, self.world.bus)
        self.ticks = []
        self.request(False)
        self.world.drive.begin()

    def request(self, enable, v=(0, 0, 0), mode=0, levers=(0, 0, 0, 0)):
        request = Request(self.world.time, mode, enable, True, np.array(v), np.array(levers))
        self.connection.send(request)

    def go(self, seconds, enable, v=(0, 0, 0), **more):
        """Send requests and receive telemetry for some seconds."""
        end = self.world.time + seconds
        while self.world.time < end - 1e-9:
            self.request(enable, v, **more)
            self.world.run(0.04)
            self.ticks += receive_telemetry(self.connection)

    def close(self):
        self.world.bus.close()
