"""The safety gate that every command passes on its way to the valves.

A pure function of state, inputs and time, for one machine or many at once. It is no safety
function: a real machine keeps its hard-wired emergency stop (docs/hardware.md).
"""

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from brokk_min.can.canopen import OPERATIONAL, Array, valve_frame
from brokk_min.machine import PWM_MAX, Machine

# all assumed
HEARTBEAT_TIMEOUT = 0.110  # s
SLEW = 40  # counts of 127 per tick by which a command may grow
END_STOP_MARGIN = 0.02  # rad before a joint's limit, from where no command goes outward
RANGE_MARGIN = 0.05  # rad beyond a joint's limit, then the encoder is wrong
JUMP_FACTOR = 2.0  # times the fastest motion,
JUMP_COUNTS = 4  # plus so many counts: a larger step is a jump
# an encoder is frozen if its count stands still while more motion is expected than this
FROZEN_COUNTS = 1.0
PUSH_TICKS = 8  # of commands to the same side, after which a joint moves even from rest
IDLE_ZONES = 1.5  # dead zones: a command up to this may do nothing
SLOWEST = 0.3  # of the fastest motion: long lever arm, weak pump
CONTINUED = 0.5  # of the measured motion that goes on at least under the same command


class Fault(IntEnum):
    """What can be wrong; of several at once the first is reported."""

    text: str

    def __new__(cls, value: int, text: str) -> "Fault":
        """A number with its text."""
        fault = int.__new__(cls, value)
        fault._value_ = value
        fault.text = text
        return fault

    ERROR = 0, "error"
    LATE = 1, "tick late, or the clock was set"
    OPERATOR_LOST = 2, "operator's device lost"
    NEVER_SEEN = 3, "never seen"
    HEARTBEAT_LOST = 4, "heartbeat lost"
    NOT_OPERATIONAL = 5, "not operational"
    SILENT = 6, "silent"
    MALFORMED = 7, "doubled or malformed position"
    OUT_OF_RANGE = 8, "out of range"
    JUMPED = 9, "jumped"
    FROZEN = 10, "frozen, or the joint does not move"
    NO_COMMAND = 11, "no valid command"
    STOP = 12, "stop asked for"


class GateState(NamedTuple):
    """What the gate remembers: one or many gates, arrays (...) unless noted."""

    driving: Array  # may the valves move?
    armed_once: Array  # before, nothing is sent
    active_fault: Array  # of this tick, see `fault_name`; 0: ready
    latched_fault: Array  # what stopped it, until it is armed again; 0: nothing
    enable: Array  # dead-man switch at the last tick with device and without error
    time: Array  # s, of the last tick
    counter: Array  # of the last valve frame
    counts: Array  # newest two angles, newest last [encoder counts], (..., n, 2)
    sent: Array  # newest commands, newest last [counts of 127], (..., n, PUSH_TICKS)
    measured_motion: Array  # when the count last changed [encoder counts per tick], (..., n)
    expected_motion: Array  # since the count last changed [encoder counts], (..., n)


class GateInputs(NamedTuple):
    """Inputs of one tick; the last node is the valve controller. Arrays (...) unless noted."""

    command: Array  # of the controller [counts of 127], (..., n)
    counts: Array  # angles [encoder counts], (..., n)
    frames: Array  # positions received since the last tick, a malformed one counts 2, (..., n)
    heartbeat: Array  # time of each node's last heartbeat [s], -inf: never, (..., n + 1)
    nmt: Array  # state of each node, (..., n + 1)
    enable: Array  # is the dead-man switch held?
    centred: Array  # is the goal zero?
    alive: Array  # is the operator's device there?
    stop: Array  # must the program end?
    error: Array  # was an exception raised?


def gate_start(machine: Machine, shape: tuple[int, ...] = ()) -> GateState:
    """Gates that have just been switched on."""
    no = np.zeros(shape, bool)
    zero = np.zeros(shape, int)
    return GateState(
        driving=no,
        armed_once=no,
        active_fault=zero + 1,
        latched_fault=zero,
        enable=~no,
        time=np.full(shape, -np.inf),
        counter=zero,
        counts=np.zeros((*shape, machine.n, 2), int),
        sent=np.zeros((*shape, machine.n, PUSH_TICKS), int),
        measured_motion=np.zeros((*shape, machine.n)),
        expected_motion=np.zeros((*shape, machine.n)),
    )


def gate(
    machine: Machine, state: GateState, inputs: GateInputs, now: ArrayLike
) -> tuple[GateState, Array]:
    """Next state, and the valve frame (..., 8) to send if it was `armed_once`. Paper: Sec. 2

    A rising edge of the dead-man switch at zero goal, without any fault, arms the gate. Any fault,
    or the switch released, closes the valves until the next such edge. `now` [s] (...) is on the
    clock of the heartbeats.
    """
    now = np.asarray(now)
    measured, expected = motion(machine, state, inputs.counts)
    fault = active_fault(machine, state, inputs, expected, now)
    edge = inputs.enable & ~state.enable & inputs.centred
    driving = inputs.enable & (state.driving | edge) & (fault == 0)
    latched = np.where(driving, 0, np.where(state.driving, fault, state.latched_fault))
    moving = state.driving & driving  # in the tick that arms, the valves stay closed
    command = np.where(moving[..., None], limit_slew(machine, state, inputs), 0).astype(int)
    counter = (state.counter + 1) % 256
    trusted = inputs.alive & ~inputs.error  # a lost device is no release of the switch
    state = GateState(
        driving=driving,
        armed_once=state.armed_once | driving,
        active_fault=fault,
        latched_fault=latched,
        enable=inputs.enable | (state.enable & ~trusted),
        time=now,
        counter=counter,
        counts=np.concatenate([state.counts[..., 1:], inputs.counts[..., None]], axis=-1),
        sent=np.concatenate([state.sent[..., 1:], command[..., None]], axis=-1),
        measured_motion=measured,
        expected_motion=expected,
    )
    return state, valve_frame(command, counter, driving)


def limit_slew(machine: Machine, state: GateState, inputs: GateInputs) -> Array:
    """Commands (..., n) that grow by `SLEW` at most and do not go outward at an end stop."""
    last = state.sent[..., -1]
    q = inputs.counts * machine.encoder_step
    can_rise = q < machine.column("q_max") - END_STOP_MARGIN
    can_fall = q > machine.column("q_min") + END_STOP_MARGIN
    highest = np.where(can_rise, np.maximum(last, 0) + SLEW, 0)
    lowest = np.where(can_fall, np.minimum(last, 0) - SLEW, 0)
    return np.minimum(np.maximum(inputs.command, lowest), highest)


def motion(machine: Machine, state: GateState, counts: Array) -> tuple[Array, Array]:
    """Motion of each joint, measured and expected at least, (..., n) both, for the next state.

    While all commands of `PUSH_TICKS` go to one side beyond the dead zone, a joint is expected to
    move at `SLOWEST` of its fastest motion, in proportion to the weakest command. It also keeps
    `CONTINUED` of its measured motion, in proportion of the weakest to the strongest command.
    """
    idle = IDLE_ZONES * machine.dead_zone * PWM_MAX
    side = np.sign(state.sent.sum(axis=-1))
    push = state.sent * side[..., None] - idle
    weakest = push.min(axis=-1)
    strongest = push.max(axis=-1)
    pushed = weakest > 0
    moved = counts != state.counts[..., 1]
    slower = np.minimum(machine.column("q_dot_up"), machine.column("q_dot_down"))
    slowest = SLOWEST * slower * machine.dt / machine.encoder_step
    slowest = slowest / (machine.pwm_limit - idle) * weakest
    last_motion = np.maximum(side * (counts - state.counts[..., 0]) - 1, 0) / 2  # in two ticks
    measured = np.where(moved, last_motion, state.measured_motion)
    continued = CONTINUED * measured * weakest / np.where(pushed, strongest, np.inf)
    expected = state.expected_motion + np.maximum(slowest, continued)
    return np.where(pushed, measured, 0.0), np.where(pushed & ~moved, expected, 0.0)


def active_fault(
    machine: Machine, state: GateState, inputs: GateInputs, expected: Array, now: Array
) -> Array:
    """Code (...) of the first fault, 1 + fault * (n + 1) + node, or 0 for none."""
    n = machine.n
    q = inputs.counts * machine.encoder_step
    low = machine.column("q_min") - RANGE_MARGIN
    high = machine.column("q_max") + RANGE_MARGIN
    fastest = JUMP_FACTOR * machine.q_dot_max * machine.dt / machine.encoder_step + JUMP_COUNTS
    limit = np.zeros(n)
    limit[machine.driven] = machine.pwm_limit
    faults = np.zeros((*now.shape, len(Fault), n + 1), bool)
    faults[..., Fault.ERROR, 0] = inputs.error
    faults[..., Fault.LATE, 0] = np.abs(now - state.time - machine.dt) > machine.dt / 2
    faults[..., Fault.OPERATOR_LOST, 0] = ~inputs.alive
    faults[..., Fault.NEVER_SEEN, :] = np.isneginf(inputs.heartbeat)
    faults[..., Fault.HEARTBEAT_LOST, :] = now[..., None] - inputs.heartbeat > HEARTBEAT_TIMEOUT
    faults[..., Fault.NOT_OPERATIONAL, :] = inputs.nmt != OPERATIONAL
    faults[..., Fault.SILENT, :n] = inputs.frames < 1
    faults[..., Fault.MALFORMED, :n] = inputs.frames > 1
    faults[..., Fault.OUT_OF_RANGE, :n] = (q < low) | (q > high)
    faults[..., Fault.JUMPED, :n] = np.abs(inputs.counts - state.counts[..., 1]) > fastest
    faults[..., Fault.FROZEN, :n] = expected > FROZEN_COUNTS
    faults[..., Fault.NO_COMMAND, :n] = ~(np.abs(inputs.command) <= limit)  # nan, too
    faults[..., Fault.STOP, 0] = inputs.stop
    faults = faults.reshape(*now.shape, -1)
    return np.asarray(faults.any(axis=-1) * (1 + faults.argmax(axis=-1)))


def fault_name(machine: Machine, code: int) -> str:
    """Node and text of a code of `active_fault`; empty for no fault."""
    if not code:
        return ""
    number, node = divmod(code - 1, machine.n + 1)
    fault = Fault(number)  # type: ignore[call-arg]
    if Fault.NEVER_SEEN <= fault <= Fault.NO_COMMAND:
        return f"{[*machine.names, 'valve controller'][node]}: {fault.text}"
    return fault.text
