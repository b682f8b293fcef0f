"""A machine, a bus and a program in one process on one injected clock: nothing waits for real."""

from collections import deque

import can
import numpy as np

from brokk_min.actuator import AnalyticPlant
from brokk_min.can.canopen import Frame, OperatorInput
from brokk_min.can.connection import Bus
from brokk_min.can.simulated_machine import FaultyMachine, start_pose
from brokk_min.hw import Drive
from brokk_min.jacobian import Gains, JacobianController, manipulability_threshold
from brokk_min.machine import BROKK_170

START = (0.0, 0.5, 0.58, 1.71, 1.24)


def baseline(machine):
    """A PI controller that nobody tuned."""
    one = np.ones((1, len(machine.driven)))
    gains = Gains(one, 3 * one, 0 * one, np.full((1, 1), 0.3))
    return JacobianController(machine, gains, 0.1, manipulability_threshold(machine))


BASELINE = baseline(BROKK_170)


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
