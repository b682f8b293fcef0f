"""The safety gate that every command passes on its way to the valves.

A pure function of state, inputs and time, for one machine or many at once. It is no safety
function: a real machine keeps its hard-wired emergency stop (docs/hardware.md).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brokk_min.can.canopen import OPERATIONAL, Counts, valve_frame
from brokk_min.machine import PWM_MAX, Array, Machine, limit_command

Flag = NDArray[np.bool_]
Words = NDArray[np.str_]

# all assumed
HEARTBEAT_TIMEOUT = 0.110  # s
SLEW = 40 / PWM_MAX  # of full command per tick, by which a command may grow
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


class GateState(NamedTuple):
    """What the gate remembers, with the values of its start; arrays (...) unless noted."""

    counts: Counts  # newest angles [encoder counts], (..., n)
    sent: Array  # commands u of `OPENING_TIME` as on the bus, newest last, (..., n, ticks)
    place: Counts  # counts that the encoder has stayed at, (..., n)
    motion: Array  # of the joint since it came there, at least [rad], (..., n)
    driving: Flag = np.array(False)  # may the valves move?
    armed_once: Flag = np.array(False)  # before, nothing is sent
    active_fault: Words = np.array("switched on")  # words of this tick's; empty: ready
    latched_fault: Words = np.array("")  # words of what stopped it, until it is armed again
    enable: Flag = np.array(True)  # dead-man switch at the last tick with device, without error
    time: Array = np.array(-np.inf)  # s, of the last tick
    counter: Counts = np.array(0)  # of the last valve frame


class GateInputs(NamedTuple):
    """Inputs of one tick; the last node is the valve controller. Arrays (...) unless noted."""

    command: Array  # u of the controller in [-1, 1], (..., n)
    counts: Counts  # angles [encoder counts], (..., n)
    early: Flag  # did a position come before SYNC? (..., n)
    frames: Counts  # positions since SYNC, a malformed one counts 2, (..., n)
    heartbeat: Array  # time of each node's last heartbeat [s], -inf: never, (..., n + 1)
    nmt: Counts  # state of each node, (..., n + 1)
    enable: Flag  # is the dead-man switch held?
    centred: Flag  # is the goal zero?
    alive: Flag  # is the operator's device there?
    stop: Flag  # must the program end?
    error: Flag  # was an exception raised?
    flooded: Flag  # more frames in the tick than the loop reads?
    other_sender: Flag  # SYNC, NMT or valve frames that the loop did not send?


def gate_start(machine: Machine) -> GateState:
    """A gate that has just been switched on."""
    zero = np.zeros(machine.n, int)
    sent = np.zeros((machine.n, int(np.ceil(OPENING_TIME * machine.rate))))
    return GateState(counts=zero, sent=sent, place=zero, motion=np.zeros(machine.n))


def gate(
    machine: Machine, state: GateState, inputs: GateInputs, now: ArrayLike
) -> tuple[GateState, Counts]:
    """Next state, and the valve frame (..., 8) to send if it was `armed_once`. Paper: Sec. 2

    A rising edge of the dead-man switch at zero goal, without any fault, arms the gate. Any fault,
    or the switch released, closes the valves until the next such edge. `now` [s] (...) is on the
    clock of the heartbeats.
    """
    now = np.asarray(now)
    place, motion = expected_motion(machine, state, inputs.counts)
    fault = first_fault(machine, fault_table(machine, state, inputs, motion, now))
    edge = inputs.enable & ~state.enable & inputs.centred
    driving = inputs.enable & (state.driving | edge) & (fault == "")
    latched = np.where(driving, "", np.where(state.driving, fault, state.latched_fault))
    moving = state.driving & driving  # in the tick that arms, the valves stay closed
    command = np.where(moving[..., None], limit_slew(machine, state, inputs), 0.0)
    u = limit_command(machine, command)  # whole counts, as on the bus
    counter = (state.counter + 1) % 256
    trusted = inputs.alive & ~inputs.error  # a lost device is no release of the switch
    state = GateState(
        counts=inputs.counts,
        sent=np.concatenate([state.sent[..., 1:], u[..., None]], axis=-1),
        place=place,
        motion=motion,
        driving=driving,
        armed_once=state.armed_once | driving,
        active_fault=fault,
        latched_fault=latched,
        enable=inputs.enable | (state.enable & ~trusted),
        time=now,
        counter=counter,
    )
    return state, valve_frame(u, counter, driving)


def limit_slew(machine: Machine, state: GateState, inputs: GateInputs) -> Array:
    """Commands u (..., n) that grow by `SLEW` at most and do not go outward at an end stop."""
    last = state.sent[..., -1]
    q = inputs.counts * machine.encoder_step
    can_rise = q < machine.column("q_max") - END_STOP_MARGIN
    can_fall = q > machine.column("q_min") + END_STOP_MARGIN
    highest = np.where(can_rise, np.maximum(last, 0) + SLEW, 0)
    lowest = np.where(can_fall, np.minimum(last, 0) - SLEW, 0)
    return np.minimum(np.maximum(inputs.command, lowest), highest)


def expected_motion(machine: Machine, state: GateState, counts: Counts) -> tuple[Counts, Array]:
    """`place` and `motion` [rad] of the next state, (..., n).

    Once all commands of `OPENING_TIME` went to one side beyond the largest dead zone, the joint
    turns at least at `SLOWEST` of its fastest motion, in proportion to the smallest command. An
    encoder that flickers by one count stays where it is.
    """
    idle, limit = IDLE_ZONES * machine.dead_zones.max(), machine.pwm_limit / PWM_MAX
    direction = np.sign(state.sent[..., -1:])
    smallest = (direction * state.sent).min(axis=-1)
    opening = np.maximum(smallest - idle, 0.0) / max(limit - idle, 1 / PWM_MAX)
    slower = np.minimum(machine.column("q_dot_up"), machine.column("q_dot_down"))
    least = machine.dt * (SLOWEST * slower * opening)
    stays = np.abs(counts - state.place) <= still_counts(machine)
    stays &= least > 0
    return np.where(stays, state.place, counts), np.where(stays, state.motion + least, 0.0)


def still_counts(machine: Machine) -> Array:
    """Counts by which an encoder that stands still may flicker, (n,)."""
    return np.maximum(1, STILL_ANGLE // machine.encoder_step)


def fault_table(
    machine: Machine, state: GateState, inputs: GateInputs, motion: Array, now: Array
) -> dict[str, Flag]:
    """What can be wrong: of the program (...), of joints (..., n), of all nodes (..., n + 1)."""
    step = machine.encoder_step
    q = inputs.counts * step
    low = machine.column("q_min") - RANGE_MARGIN
    high = machine.column("q_max") + RANGE_MARGIN
    jump = JUMP_FACTOR * machine.q_dot_max * machine.dt + JUMP_ANGLE + step
    limit = np.zeros(machine.n)  # counts; what is rounded to it is no fault
    limit[machine.driven] = machine.pwm_limit
    period = now - state.time
    age = now[..., None] - inputs.heartbeat  # below 0: nan and what is to come count as lost
    return {
        "error": inputs.error,
        "bus flooded": inputs.flooded,
        "SYNC, NMT or valve frame of another sender": inputs.other_sender,
        "tick late, or the clock was set": ~(np.abs(period - machine.dt) <= machine.dt / 2),
        "operator's device lost": ~inputs.alive,
        "never seen": np.isneginf(inputs.heartbeat),
        "heartbeat lost": ~((age >= -machine.dt) & (age <= HEARTBEAT_TIMEOUT)),
        "not operational": inputs.nmt != OPERATIONAL,
        "silent": inputs.frames < 1,
        "position before SYNC": inputs.early,
        "position doubled, not of 4 bytes, or FFFFFFFF": inputs.frames > 1,
        "out of range": (q < low) | (q > high),
        "jumped": np.abs(q - state.counts * step) > jump,
        "frozen, or the joint does not move": motion > 3 * still_counts(machine) * step,
        "no valid command": ~(np.abs(inputs.command) < (limit + 0.5) / PWM_MAX),  # nan, too
        "stop asked for": inputs.stop,
    }


def first_fault(machine: Machine, faults: dict[str, Flag]) -> Words:
    """Words (...) of the first fault in the table, and its first node; empty for no fault."""
    nodes = np.array([*machine.names, "valve controller"])
    words: Words = np.array("")
    for text, found in reversed(faults.items()):
        if found.ndim == faults["error"].ndim:  # of the program, not of nodes
            words = np.where(found, text, words)
        else:
            named = np.char.add(nodes[found.argmax(axis=-1)], f": {text}")
            words = np.where(found.any(axis=-1), named, words)
    return words
