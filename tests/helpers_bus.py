"""A machine, a bus and a program in one process on one injected clock: nothing waits for real."""

import ctypes
import json
import os
import time
from collections import deque
from contextlib import suppress
from functools import partial
from itertools import pairwise
from pathlib import Path

import can
import numpy as np
import pytest
from helpers_machines import obedient_net

from brokk_min.actuator import AnalyticPlant
from brokk_min.can.canopen import Frame, OperatorInput
from brokk_min.can.connection import Bus, open_bus
from brokk_min.can.simulated_machine import FaultyMachine, start_pose
from brokk_min.hw import Drive
from brokk_min.jacobian import Gains, JacobianController, manipulability_threshold
from brokk_min.learning.policy import INTERFACES, Policy
from brokk_min.machine import BROKK_170

MULTICAST = "239.74.163.2"
START = (0.0, 0.5, 0.58, 1.71, 1.24)


def baseline(machine):
    """A PI controller that nobody tuned."""
    one = np.ones((1, len(machine.driven)))
    gains = Gains(one, 3 * one, 0 * one, np.full((1, 1), 0.3))
    return JacobianController(machine, gains, 0.1, manipulability_threshold(machine))


BASELINE = baseline(BROKK_170)


def random_policy(interface, machine=BROKK_170):
    """A policy that nobody trained: it sends all kinds of commands."""
    rng = np.random.default_rng(0)
    sizes = [len(INTERFACES[interface].scale(machine)[0]), 64, 64, 64, len(machine.driven)]
    weights = []
    for inputs, outputs in pairwise(sizes):
        weight = 1.5 * rng.standard_normal((inputs, outputs)) / inputs**0.5
        weights += [weight.astype("f4"), np.zeros(outputs, "f4")]
    return Policy(machine, {}, tuple(weights), obedient_net(machine), interface)


def unchanged(can_id, data):
    return [(can_id, data)]


def only(changed_id, act):
    """Change the frames of one identifier."""
    return lambda i, data: [(i, d) for d in (act(data) if i == changed_id else [data])]


def recording(out):
    """Append the frames that pass to `out`."""
    return lambda can_id, data: out.append((can_id, data)) or [(can_id, data)]


def raises(error):
    def act(*_, **__):
        raise error

    return act


class Recorder(AnalyticPlant):
    """The analytic plant; it keeps the command and the angles of each step."""

    def __init__(self):
        self.u, self.q = [], []

    def step(self, machine, state, u):
        state = super().step(machine, state, u)
        self.u.append(u)
        self.q.append(state.q)
        return state


class World:
    """A simulated machine and a `Drive`, in steps of a millisecond; it is python-can's bus, too.

    `upward` and `downward` may tamper with what machine and program send.
    """

    step = 0.001  # s

    def __init__(self, controller, operator, log=None, machine=BROKK_170):
        self.time = 0.0  # s
        self.recorder = Recorder()
        self.simulated = FaultyMachine(machine, start_pose(machine), 0.0, self.recorder, [])
        self.answers = deque()
        self.upward = self.downward = unchanged
        self.noise = list  # foreign frames of the next millisecond
        self.syncs = []
        self.bus = Bus(self, "virtual", log, clock=lambda: self.time, sleep=self.sleep)
        self.bus.start = 1.8e9  # s; a fixed time of day, so that roundings repeat themselves
        self.drive = Drive(machine, controller, self.bus, operator)
        self.controller, self.operator = controller, operator

    def send(self, message, timeout=None):
        frames = self.downward(message.arbitration_id, bytes(message.data))
        self.live()
        for can_id, data in frames:
            self.syncs += [self.time] * (can_id == 0x080)
            self.say(self.simulated.receive(Frame(self.time, can_id, data)))

    def recv(self, timeout):
        end = self.time + timeout
        while not self.answers:
            if self.time >= end:
                return None
            self.sleep(min(0.005, end - self.time))
        can_id, data = self.answers.popleft()
        return can.Message(arbitration_id=can_id, data=data, is_extended_id=False)

    def sleep(self, seconds):
        end = self.time + seconds
        while self.time < end:
            self.time = min(end, self.time + self.step)
            self.live()

    def live(self):
        """The machine's side up to now."""
        self.say(self.simulated.advance(self.time))
        for can_id, data in self.noise():
            self.answers.append((can_id, data))
            self.say(self.simulated.receive(Frame(self.time, can_id, data)))

    def say(self, frames):
        for frame in frames:
            self.answers += self.upward(*frame)

    def shutdown(self):
        pass

    def run(self, seconds):
        end = self.time + seconds
        while self.time < end and self.drive.tick():
            pass

    @property
    def commands(self):
        """Times [s] and commands in force in counts (T, n), by the plant's own record."""
        u = np.array(self.recorder.u)
        return 0.005 * np.arange(1, len(u) + 1), np.rint(u * 127).astype(int)


class ConstantCommand:
    """A controller that gives constant commands [counts of 127]."""

    def __init__(self, *m):
        self.m = np.array(m, float)
        self.act = lambda: None

    def start(self, num):
        return None

    def __call__(self, measured, state):
        self.act()
        return self.m[None] / 127, None


class HoldingOperator:
    """An operator who presses as soon as the gate is ready, then asks for motion."""

    def __init__(self):
        self.enable = None  # None: pressed when ready, and held from then on
        self.alive = True
        self.v = (0.1, 0.0, 0.0)
        self.pressed = False
        self.act = lambda: None

    def __call__(self, driving, ready):
        self.act()
        self.pressed = self.pressed or ready
        enable = self.pressed if self.enable is None else self.enable
        v = self.v if driving else (0.0, 0.0, 0.0)
        return OperatorInput(v, enable and self.alive, self.alive)


def eventually(condition, seconds=20.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "not within the time"
        time.sleep(0.01)


def own_multicast_port(monkeypatch):
    """Groups with one port are one bus: take a port of our own. Skips where nothing is routed."""
    monkeypatch.setenv("CAN_CONFIG", json.dumps({"port": 43200 + os.getpid() % 10_000}))
    bus = partial(open_bus, "udp_multicast", MULTICAST)
    with suppress(ValueError), bus() as a, bus() as b:
        a.send(0x123, b"")
        if b.recv(1.0) is not None:
            return
    pytest.skip("no multicast route on this machine")


class Virtual:
    """SDL's virtual joystick: a device without a device."""

    def __init__(self, buttons=8, kind=4):  # kind 1: a gamepad that SDL knows
        import pygame

        os.environ["SDL_VIDEODRIVER"] = "dummy"
        pygame.display.init()
        pygame.joystick.init()
        folder = Path(pygame.__file__).parent.parent / "pygame.libs"
        self.sdl = ctypes.CDLL(str(next(folder.glob("libSDL2-2*"))))
        self.sdl.SDL_JoystickOpen.restype = ctypes.c_void_p
        self.index = self.sdl.SDL_JoystickAttachVirtual(kind, 6, buttons, 0)  # six axes
        self.handle = ctypes.c_void_p(self.sdl.SDL_JoystickOpen(self.index))

    def axis(self, axis, value):
        assert self.sdl.SDL_JoystickSetVirtualAxis(self.handle, axis, round(32767 * value)) == 0

    def button(self, button, held):
        assert self.sdl.SDL_JoystickSetVirtualButton(self.handle, button, held) == 0

    def unplug(self):
        assert self.sdl.SDL_JoystickDetachVirtual(self.index) == 0
