"""What goes over the bus as bytes, and the safety gate that every command passes on its way there.

The gate is a pure function of state, inputs and time, for one machine or for a million at once. It is no
safety function: a real machine keeps its hard-wired emergency stop (docs/hardware.md).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from brokk_min.can.canopen import OPERATIONAL, Array, valve_frame
from brokk_min.machine import PWM_MAX, Machine

# all assumed
BEAT_LOST = 0.110  # s without heartbeat, then a node is lost
SLEW = 40  # counts of 127 a tick by which a command may grow
LIMIT_MARGIN = 0.02  # rad before a joint's limit from which no command goes outward
RANGE_MARGIN = 0.05  # rad beyond a joint's limit, then the encoder is wrong
JUMP_FACTOR, JUMP_COUNTS = 2.0, 4  # times the fastest motion, plus counts: a larger step is a jump
# frozen: the count stands still while the joint should have moved by more than this
DUE = 1.0  # count; what moves further shows it
IDLE = 1.5  # dead zones: a command up to this may do nothing
SLOWEST = 0.3  # of the fastest motion: long lever arm, weak pump
KEPT = 0.5  # of the motion before: a joint that moved goes on at least so under the same push
PUSH = 8  # ticks of commands the same way after which a joint moves, from rest too


# --- the safety gate --------------------------------------------------------------------------------

FAULTS = (  # in the order in which they are named when several come at once
    "error",
    "tick late, or the clock was set",
    "operator's device lost",
    "never seen",
    "heartbeat lost",
    "not operational",
    "silent",
    "doubled or malformed position",
    "out of range",
    "jumped",
    "frozen, or the joint does not move",
    "no valid command",
    "stop asked for",
)


class GateState(NamedTuple):
    """What the gate remembers: one or many gates, arrays (...) unless noted."""

    driving: Array  # may the valves move?
    armed_once: Array  # was it ever armed? before that it sends nothing
    active_fault: Array  # what is wrong at this tick, see `fault_name`; 0: ready
    latched_fault: Array  # what stopped it, 0: nothing; kept until it is armed again
    enable: Array  # dead-man switch at the last tick at which it could be trusted
    time: Array  # s, of the last tick
    counter: Array  # of the last valve frame
    counts: Array  # newest two angles, newest last (..., n, 2) [encoder counts]
    sent: Array  # newest commands last (..., n, PUSH) [counts of 127]
    pace: Array  # at least, with the push, when the count last changed (..., n) [encoder counts a tick]
    due: (
        Array  # motion that should have come since then, see `motion_due` (..., n) [encoder counts]
    )


class GateInputs(NamedTuple):
    """What one tick knows; the last node is the valve controller. Arrays (...) unless noted."""

    m: Array  # wanted command [counts of 127], (..., n)
    counts: Array  # newest angles [encoder counts], (..., n)
    frames: Array  # positions received since the last tick, a malformed one counts twice, (..., n)
    beat: Array  # s, time of each node's last heartbeat, -inf: never, (..., n + 1)
    nmt: Array  # state that it told, (..., n + 1)
    enable: Array  # is the dead-man switch held?
    centred: Array  # is no motion asked for?
    alive: Array  # is the operator's device there?
    stop: Array  # must the program end?
    error: Array  # did anything raise an exception?


def gate_start(machine: Machine, shape: tuple[int, ...] = ()) -> GateState:
    """Gates that have just been switched on."""
    no, zero = np.zeros(shape, bool), np.zeros(shape, int)
    counts, sent = (np.zeros((*shape, machine.n, ticks), int) for ticks in (2, PUSH))
    rest = np.zeros((*shape, machine.n))
    return GateState(
        no, no, zero + 1, zero, ~no, np.full(shape, -np.inf), zero, counts, sent, rest, rest
    )


def gate(
    machine: Machine, state: GateState, inputs: GateInputs, now: ArrayLike
) -> tuple[GateState, Array]:
    """Every command passes here: next state and valve frame from state, inputs and time alone. Paper: Sec. 2

    It is silent until armed, by a fresh edge of the dead-man switch with centred stick while nothing is
    wrong. Driving, it lets no command out that grows faster than `SLEW`, goes outward at a joint limit or
    exceeds the machine's limit; zero is always reachable at once. Anything wrong, or the switch released,
    means neutral until a new edge.

    Args:
        machine: n <= 5 joints.
        state: of one gate, or of many with leading axes (...).
        inputs: of this tick.
        now: s, on the clock of the heartbeats, (...).

    Returns:
        The next state, and the valve frame (..., 8), to be sent only if the state has `armed_once`.
    """
    now = np.asarray(now)
    pace, due = motion_due(machine, state, inputs.counts)
    wrong = gate_wrong(machine, state, inputs, due, now)
    edge = inputs.enable & ~state.enable & inputs.centred
    driving = inputs.enable & (state.driving | edge) & np.logical_not(wrong)
    fault = np.where(driving, 0, np.where(state.driving, wrong, state.latched_fault))
    moving = state.driving & driving  # the tick that arms is still neutral
    m = np.where(moving[..., None], held_back(machine, state, inputs), 0).astype(int)
    counter = (state.counter + 1) % 256
    trusted = (
        inputs.alive & ~inputs.error
    )  # a lost device or an exception is no release of the switch
    following = GateState(
        driving=driving,
        armed_once=state.armed_once | driving,
        active_fault=wrong,
        latched_fault=fault,
        enable=inputs.enable | (state.enable & ~trusted),
        time=now,
        counter=counter,
        counts=np.concatenate([state.counts[..., 1:], inputs.counts[..., None]], axis=-1),
        sent=np.concatenate([state.sent[..., 1:], m[..., None]], axis=-1),
        pace=pace,
        due=due,
    )
    return following, valve_frame(m, counter, driving)


def held_back(machine: Machine, state: GateState, inputs: GateInputs) -> Array:
    """Wanted commands (..., n) [counts of 127], grown by `SLEW` at most and not outward at a joint limit."""
    last, q = state.sent[..., -1], inputs.counts * machine.encoder_step
    up = np.where(q < machine.column("q_max") - LIMIT_MARGIN, np.maximum(last, 0) + SLEW, 0)
    down = np.where(q > machine.column("q_min") + LIMIT_MARGIN, np.minimum(last, 0) - SLEW, 0)
    return np.minimum(np.maximum(inputs.m, down), up)


def motion_due(machine: Machine, state: GateState, counts: Array) -> tuple[Array, Array]:
    """How fast each joint moved, and by how much it should have moved since its count last changed.

    The lower bound of a motion that a joint owes: once commands went the same way beyond the dead zone for
    `PUSH` ticks, `SLOWEST` of the fastest motion in proportion to the weakest of them, or `KEPT` of the
    motion before in the proportion of the weakest to the strongest.

    Returns:
        `pace` and `due` of the next state, (..., n) [encoder counts a tick, encoder counts].
    """
    idle = IDLE * machine.dead_zone * PWM_MAX
    way = np.sign(state.sent.sum(axis=-1))
    push = state.sent * way[..., None] - idle
    weakest, strongest = push.min(axis=-1), push.max(axis=-1)
    pushed, moved = weakest > 0, counts != state.counts[..., 1]
    fastest = np.minimum(machine.column("q_dot_up"), machine.column("q_dot_down"))
    least = (
        SLOWEST * fastest * machine.dt / machine.encoder_step / (machine.pwm_limit - idle) * weakest
    )
    pace = np.where(moved, np.maximum(way * (counts - state.counts[..., 0]) - 1, 0) / 2, state.pace)
    kept = KEPT * pace * weakest / np.where(pushed, strongest, np.inf)
    due = state.due + np.maximum(least, kept)
    return np.where(pushed, pace, 0.0), np.where(pushed & ~moved, due, 0.0)


def gate_wrong(
    machine: Machine, state: GateState, inputs: GateInputs, due: Array, now: Array
) -> Array:
    """The first thing that is wrong (...): 0, or 1 + fault * (n + 1) + node, see `fault_name`."""
    n, step = machine.n, machine.encoder_step
    low, high = machine.column("q_min") - RANGE_MARGIN, machine.column("q_max") + RANGE_MARGIN
    limit = np.zeros(n)
    limit[machine.driven] = machine.pwm_limit
    fastest = JUMP_FACTOR * machine.q_dot_max * machine.dt / step + JUMP_COUNTS
    q = inputs.counts * step

    bad = np.zeros((*now.shape, len(FAULTS), n + 1), bool)
    bad[..., 0, 0] = inputs.error
    bad[..., 1, 0] = np.abs(now - state.time - machine.dt) > machine.dt / 2
    bad[..., 2, 0] = ~inputs.alive
    bad[..., 3, :] = np.isneginf(inputs.beat)
    bad[..., 4, :] = now[..., None] - inputs.beat > BEAT_LOST
    bad[..., 5, :] = inputs.nmt != OPERATIONAL
    bad[..., 6, :n] = inputs.frames < 1
    bad[..., 7, :n] = inputs.frames > 1
    bad[..., 8, :n] = (q < low) | (q > high)
    bad[..., 9, :n] = np.abs(inputs.counts - state.counts[..., 1]) > fastest
    bad[..., 10, :n] = due > DUE
    bad[..., 11, :n] = ~(np.abs(inputs.m) <= limit)  # also if it is no number
    bad[..., 12, 0] = inputs.stop
    bad = bad.reshape(*now.shape, len(FAULTS) * (n + 1))
    wrong: Array = bad.any(axis=-1) * (1 + bad.argmax(axis=-1))
    return wrong


def fault_name(machine: Machine, fault: int) -> str:
    """What a code of `gate_wrong` means.

    Example:
        >>> from brokk_min.machine import BROKK_170
        >>> fault_name(BROKK_170, 1 + 4 * 6 + 5), fault_name(BROKK_170, 1), fault_name(BROKK_170, 0)
        ('valve controller: heartbeat lost', 'error', '')
    """
    if not fault:
        return ""
    kind, node = divmod(fault - 1, machine.n + 1)
    names = [*machine.names, "valve controller"]
    return f"{names[node]}: {FAULTS[kind]}" if 3 <= kind <= 11 else FAULTS[kind]
