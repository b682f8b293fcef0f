"""What is known of a machine at each tick, from the frames of a bus or of a log; it only listens."""

from typing import NamedTuple

import numpy as np

from brokk_min.can import operator_input as wishes
from brokk_min.can.canopen import OPERATOR, SYNC, WISH, Frame, Nodes
from brokk_min.can.safety_gate import encoder_counts
from brokk_min.machine import Array, Machine, decode_pwm, estimate_velocity


class Known(NamedTuple):
    """What the loop, a bus or a log tells of one tick."""

    tick: float
    q: Array  # rad (n,), nan: unknown
    q_dot: Array  # rad/s (n,)
    u: Array  # in [-1, 1] (n,)
    v_goal: Array  # m/s (3,)
    driving: bool
    wrong: int = 0  # of `fault_name`
    fault: int = 0
    mode: int = 0
    lateness: float = 0.0  # s

    def pack(self) -> Array:
        """As numbers in a row."""
        return np.hstack([np.ravel(value) for value in self]).astype(float)


def unpack_known(machine: Machine, values: Array) -> Known:
    """What `Known.pack` packed."""
    n = machine.n
    tick, q, q_dot, u, v, rest = np.split(values, np.cumsum([1, n, n, n, 3]))
    driving, wrong, fault, mode = (int(x) for x in rest[:4])
    return Known(float(tick[0]), q, q_dot, u, v, bool(driving), wrong, fault, mode, float(rest[4]))


class Ticks:
    """Frames of a bus or a log, one after another, as what is known at each tick."""

    def __init__(self, machine: Machine) -> None:
        self.machine, self.nodes, self.wish = machine, Nodes(machine), wishes.Wish()
        self.u, self.driving, self.tick = np.zeros(machine.n), False, 0
        self.angles: list[Array] = []  # rad, as many as the velocity needs

    def hear(self, frame: Frame) -> Known | None:
        """Take in one frame; at a SYNC, what is known of the tick that it ends."""
        if frame.id == SYNC:
            known, self.nodes.frames[:] = self._known(), 0
            self.tick += 1
            return known
        if frame.id == WISH and frame.channel == OPERATOR:
            self.wish = wishes.unpack_wish(frame.data)
        elif frame.id == self.machine.valve_frame_id and len(frame.data) == 8:
            self.u, self.driving = (
                decode_pwm(list(frame.data[: self.machine.n])),
                frame.data[7] == 1,
            )
        else:
            self.nodes.hear(frame)
        return None

    def _known(self) -> Known:
        m, v_goal = self.machine, np.array(self.wish.v_goal) * self.driving
        if (self.nodes.frames != 1).any():
            self.angles, nan = [], np.full(m.n, np.nan)
            return Known(self.tick, nan, nan, self.u, v_goal, self.driving)
        q = encoder_counts(m, self.nodes.raw) * m.encoder_step
        self.angles = [*(self.angles or [q] * m.velocity_samples), q][-m.velocity_samples :]
        q_dot = estimate_velocity(np.stack(self.angles, axis=-1), m.velocity_samples, m.dt)
        return Known(self.tick, q, np.asarray(q_dot), self.u, v_goal, self.driving)
