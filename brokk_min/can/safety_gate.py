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
END_STOP_MARGIN = 0.02  # rad or m before a joint's limit, from where no command goes outward
RANGE_MARGIN = 0.05  # rad or m beyond a joint's limit, then the encoder is wrong
JUMP_FACTOR = 2.0  # times the fastest motion,
JUMP_ANGLE = 0.0045  # rad or m, plus this and one count: a larger step is a jump
# An encoder is frozen if it stays within this, or one count, of a place while the joint must have
# turned by more than three times as much. In 12 hours of random driving the worst was 2.9 times.
STILL_ANGLE = 0.0015  # rad or m
OPENING_TIME = 0.45  # s of commands to one side, after which a joint moves even from rest
IDLE_ZONES = 1.5  # largest dead zones, beyond which a valve is sure to open
SLOWEST = 0.4  # of the fastest motion: long lever arm, weak pump


class Fault(IntEnum):
    """What can be wrong; of several at once the first is reported."""

    text: str

    def __new__(cls, value: int, text: str) -> "Fault":
        """A number with its text."""
        fault = int.__new__(cls, value)
        fault._value_ = value
        fault.text = text
        return fault

    NONE = 0, ""
    ERROR = 1, "error"
    FLOODED = 2, "bus flooded"
    OTHER_SENDER = 3, "SYNC, NMT or valve frame of another sender"
    LATE = 4, "tick late, or the clock was set"
    OPERATOR_LOST = 5, "operator's device lost"
    NEVER_SEEN = 6, "never seen"
    HEARTBEAT_LOST = 7, "heartbeat lost"
    NOT_OPERATIONAL = 8, "not operational"
    SILENT = 9, "silent"
    MALFORMED = 10, "doubled or malformed position"
    OUT_OF_RANGE = 11, "out of range"
    JUMPED = 12, "jumped"
    FROZEN = 13, "frozen, or the joint does not move"
    NO_COMMAND = 14, "no valid command"
    STOP = 15, "stop asked for"


class GateState(NamedTuple):
    """What the gate remembers: one or many gates, arrays (...) unless noted."""

    driving: Array  # may the valves move?
    armed_once: Array  # before, nothing is sent
    active_fault: Array  # of this tick, see `fault_name`; 0: ready
    latched_fault: Array  # what stopped it, until it is armed again; 0: nothing
    enable: Array  # dead-man switch at the last tick with device and without error
    time: Array  # s, of the last tick
    counter: Array  # of the last valve frame
    counts: Array  # newest angles [encoder counts], (..., n)
    sent: Array  # commands of `OPENING_TIME`, newest last [counts of 127], (..., n, ticks)
    place: Array  # counts that the encoder has stayed at, (..., n)
    motion: Array  # of the joint since it came there, at least [rad], (..., n)


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
    flooded: Array  # more frames in the tick than the loop reads?
    other_sender: Array  # SYNC, NMT or valve frames that the loop did not send?


def gate_start(machine: Machine, shape: tuple[int, ...] = ()) -> GateState:
    """Gates that have just been switched on."""
    no = np.zeros(shape, bool)
    zero = np.zeros(shape, int)
    return GateState(
        driving=no,
        armed_once=no,
        active_fault=np.full(shape, (machine.n + 1) * Fault.ERROR),
        latched_fault=zero,
        enable=~no,
        time=np.full(shape, -np.inf),
        counter=zero,
        counts=np.zeros((*shape, machine.n), int),
        sent=np.zeros((*shape, machine.n, int(np.ceil(OPENING_TIME * machine.rate))), int),
        place=np.zeros((*shape, machine.n), int),
        motion=np.zeros((*shape, machine.n)),
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
    place, motion = expected_motion(machine, state, inputs.counts)
    fault = active_fault(machine, state, inputs, motion, now)
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
        counts=inputs.counts,
        sent=np.concatenate([state.sent[..., 1:], command[..., None]], axis=-1),
        place=place,
        motion=motion,
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


def expected_motion(machine: Machine, state: GateState, counts: Array) -> tuple[Array, Array]:
    """`place` and `motion` [rad] of the next state, (..., n).

    Once all commands of `OPENING_TIME` went to one side beyond the largest dead zone, the joint
    turns at least at `SLOWEST` of its fastest motion, in proportion to the smallest command. An
    encoder that flickers by one count stays where it is.
    """
    idle, limit = IDLE_ZONES * machine.dead_zones.max(), machine.pwm_limit / PWM_MAX
    direction = np.sign(state.sent[..., -1:])
    smallest = (direction * state.sent).min(axis=-1) / PWM_MAX
    opening = np.maximum(smallest - idle, 0.0) / max(limit - idle, 1 / PWM_MAX)
    slower = np.minimum(machine.column("q_dot_up"), machine.column("q_dot_down"))
    least = machine.dt * (SLOWEST * slower * opening)
    stays = np.abs(counts - state.place) <= still_counts(machine)
    stays &= least > 0
    return np.where(stays, state.place, counts), np.where(stays, state.motion + least, 0.0)


def still_counts(machine: Machine) -> Array:
    """Counts by which an encoder that stands still may flicker, (n,)."""
    return np.maximum(1, STILL_ANGLE // machine.encoder_step)


def active_fault(
    machine: Machine, state: GateState, inputs: GateInputs, motion: Array, now: Array
) -> Array:
    """Number (...) of the first entry that is true in the table of faults and nodes; 0: none."""
    n, step = machine.n, machine.encoder_step
    q = inputs.counts * step
    low = machine.column("q_min") - RANGE_MARGIN
    high = machine.column("q_max") + RANGE_MARGIN
    jump = JUMP_FACTOR * machine.q_dot_max * machine.dt + JUMP_ANGLE + step
    limit = np.zeros(n)
    limit[machine.driven] = machine.pwm_limit
    faults = np.zeros((*now.shape, len(Fault), n + 1), bool)
    faults[..., Fault.ERROR, 0] = inputs.error
    faults[..., Fault.FLOODED, 0] = inputs.flooded
    faults[..., Fault.OTHER_SENDER, 0] = inputs.other_sender
    faults[..., Fault.LATE, 0] = ~(np.abs(now - state.time - machine.dt) <= machine.dt / 2)
    faults[..., Fault.OPERATOR_LOST, 0] = ~inputs.alive
    faults[..., Fault.NEVER_SEEN, :] = np.isneginf(inputs.heartbeat)
    age = now[..., None] - inputs.heartbeat  # below 0: nan and what is to come count as lost
    faults[..., Fault.HEARTBEAT_LOST, :] = ~((age >= -machine.dt) & (age <= HEARTBEAT_TIMEOUT))
    faults[..., Fault.NOT_OPERATIONAL, :] = inputs.nmt != OPERATIONAL
    faults[..., Fault.SILENT, :n] = inputs.frames < 1
    faults[..., Fault.MALFORMED, :n] = inputs.frames > 1
    faults[..., Fault.OUT_OF_RANGE, :n] = (q < low) | (q > high)
    faults[..., Fault.JUMPED, :n] = np.abs(q - state.counts * step) > jump
    faults[..., Fault.FROZEN, :n] = motion > 3 * still_counts(machine) * step
    faults[..., Fault.NO_COMMAND, :n] = ~(np.abs(inputs.command) <= limit)  # nan, too
    faults[..., Fault.STOP, 0] = inputs.stop
    return np.asarray(faults.reshape(*now.shape, -1).argmax(axis=-1))  # of no fault: 0


def fault_name(machine: Machine, number: int) -> str:
    """Node and text of a number of `active_fault`; empty for no fault."""
    row, node = divmod(number, machine.n + 1)
    fault = Fault(row)  # type: ignore[call-arg]
    if Fault.NEVER_SEEN <= fault <= Fault.NO_COMMAND:
        return f"{[*machine.names, 'valve controller'][node]}: {fault.text}"
    return fault.text
