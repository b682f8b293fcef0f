"""The safety gate: may a valve open, and how far? (45 minutes)

Every command passes one pure function on its way to the bus. It has to promise the following,
whatever the policy says, and no test of a policy can replace it:

- The operator arms it: the dead-man switch goes from released to held while the goal is zero and
  nothing is wrong. Held from the beginning is not enough; nor is an edge under a fault.
- It drives as long as the switch is held and nothing is wrong.
- A fault that goes away does not start it again. That takes the next edge.
- A command grows by at most 40/127 a tick away from zero. It may shrink at once: closing a valve
  is never delayed. So a reversal begins again at zero.
- At the end of its range a joint gets no command outward; inward it may go.

None of this is a safety function: a real machine keeps its hard-wired emergency stop.
"""

import itertools
from collections.abc import Callable

import numpy as np
from hypothesis import strategies as st

from brokk_min.can.canopen import OPERATIONAL
from brokk_min.can.safety_gate import SLEW, GateInputs, GateState, gate, gate_start, limit_slew
from brokk_min.machine import BROKK_170, PWM_MAX
from exercises.verdict import agree, expect

SOLUTION = "brokk_min/can/safety_gate.py: gate, limit_slew"
MIDDLE = np.array([0.0, 0.7, 0.7, 1.7, 1.0])  # rad


def drives(driving: bool, enable: bool, enable_before: bool, centred: bool, fault: bool) -> bool:
    """May the valves move from this tick on?

    Did they before? Is the switch held, was it a tick ago? Is the goal zero? Is anything wrong?
    """
    raise NotImplementedError


def limit(command: float, last: float, can_rise: bool, can_fall: bool) -> float:
    """The command in [-1, 1] that passes, after `last` a tick ago.

    `can_rise`: the joint is not at the upper end of its range; `can_fall`: not at the lower.
    """
    raise NotImplementedError


def case(enable: bool, centred: bool, stop: bool, q: np.ndarray, command: float) -> GateInputs:
    """Inputs of one tick at which nothing is wrong but `stop`."""
    n = BROKK_170.n
    no = np.array(False)
    return GateInputs(
        command=np.full(n, command) * np.isin(np.arange(n), BROKK_170.driven),
        counts=np.rint(q / BROKK_170.encoder_step).astype(int),
        early=np.zeros(n, bool),
        frames=np.ones(n, int),
        heartbeat=np.ones(n + 1),
        nmt=np.full(n + 1, OPERATIONAL),
        enable=np.array(enable),
        centred=np.array(centred),
        alive=np.array(True),
        stop=np.array(stop),
        error=no,
        flooded=no,
        other_sender=no,
    )


def before(driving: bool, enable: bool, q: np.ndarray, last: float) -> GateState:
    """The gate a tick ago."""
    state = gate_start(BROKK_170)
    sent = state.sent.copy()
    sent[..., -1] = last
    counts = np.rint(q / BROKK_170.encoder_step).astype(int)
    time = np.array(1.0 - BROKK_170.dt)
    return state._replace(
        driving=np.array(driving), enable=np.array(enable), time=time, counts=counts, sent=sent
    )


def our_drives(
    driving: bool, enable: bool, enable_before: bool, centred: bool, fault: bool
) -> bool:
    """The package's answer."""
    state = before(driving, enable_before, MIDDLE, 0)
    state, _ = gate(BROKK_170, state, case(enable, centred, fault, MIDDLE, 0), 1.0)
    return bool(state.driving)


def our_limit(command: float, last: float, can_rise: bool, can_fall: bool) -> float:
    """The package's answer, of joint q5; a joint at both ends of its range cannot move."""
    if not (can_rise or can_fall):
        return 0.0
    joint = BROKK_170.joints[4]
    angle = {(True, True): 1.0, (False, True): joint.q_max, (True, False): joint.q_min}
    q = np.where(np.arange(5) == 4, angle[can_rise, can_fall], MIDDLE)
    inputs = case(True, False, False, q, command)
    return float(limit_slew(BROKK_170, before(True, True, q, last), inputs)[4])


def check(drives: Callable[..., bool], limit: Callable[..., int]) -> None:
    """The promises one by one, then all cases."""
    promises = {
        (False, True, False, True, False): (True, "an edge at zero goal arms it"),
        (False, True, True, True, False): (False, "held from the beginning is no edge"),
        (False, True, False, False, False): (False, "an edge while the goal is not zero"),
        (False, True, False, True, True): (False, "an edge under a fault"),
        (True, True, True, False, False): (True, "it drives while the switch is held"),
        (True, False, True, False, False): (False, "the switch is released"),
        (True, True, True, False, True): (False, "a fault closes the valves"),
    }
    for inputs, (wanted, why) in promises.items():
        expect(f"drives{inputs}", bool(drives(*inputs)), wanted, f"That is: {why}.")
    for inputs in itertools.product([False, True], repeat=5):
        expect(f"drives{inputs}", bool(drives(*inputs)), our_drives(*inputs))
    promised = {
        (0.6, 0.0, True, True): (SLEW, f"{SLEW:.3f} a tick"),
        (0.0, 0.6, True, True): (0.0, "It may close at once."),
        (-0.6, 0.6, True, True): (-SLEW, "A reversal begins again at zero."),
        (0.2, 0.1, False, True): (0.0, "At the upper end"),
        (-0.2, -0.1, False, True): (-0.2, "Inward it may go."),
    }
    for inputs, (wanted, why) in promised.items():
        expect(f"limit{inputs}", limit(*inputs), wanted, why)
    u = st.integers(-80, 80).map(lambda counts: counts / PWM_MAX)
    agree("limit", limit, our_limit, st.tuples(u, u, st.booleans(), st.booleans()))
