"""A policy that nobody trained, a bus of our own, and a joystick without a device."""

import ctypes
import json
import os
import time
from contextlib import suppress
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from helpers_machines import obedient_net

from brokk_min.can.connection import open_bus
from brokk_min.learning.policy import INTERFACES, Policy
from brokk_min.machine import BROKK_170

MULTICAST = "239.74.163.2"


def random_policy(interface, machine=BROKK_170):
    """A policy that nobody trained: it sends all kinds of commands."""
    rng = np.random.default_rng(0)
    sizes = [len(INTERFACES[interface].scale(machine)[0]), 64, 64, 64, len(machine.driven)]
    weights = []
    for inputs, outputs in pairwise(sizes):
        weight = 1.5 * rng.standard_normal((inputs, outputs)) / inputs**0.5
        weights += [weight.astype("f4"), np.zeros(outputs, "f4")]
    return Policy(machine, {}, tuple(weights), obedient_net(machine), interface)


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
