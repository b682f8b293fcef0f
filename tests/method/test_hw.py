"""The hardware path: on a virtual bus with an injected clock, against CANopen peers, and as two processes."""

from __future__ import annotations

import io
import os
import re
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from helpers_bus import START, Hand, Out, Push, World

from brokk_min import hw
from brokk_min.can import canopen as bus
from brokk_min.can import drive_log
from brokk_min.can import operator_input as wishes
from brokk_min.can.safety_gate import encoder_raw, fault_name, valve_frame
from brokk_min.env import TaskConfig, action_to_pwm, measured, observation_scale, reward
from brokk_min.evaluation.rollout import rollout
from brokk_min.evaluation.sequences import axis_sequences
from brokk_min.identification.logs import read_log, write_log
from brokk_min.jacobian import JacobianController, join_gains, manipulability_threshold
from brokk_min.kinematics import joint_rates, tool_state
from brokk_min.learning.policy import STAND, PolicyController, load_policy
from brokk_min.machine import BROKK_170

PUSH = (60, 0, 60, 60, 60)
BASELINE = JacobianController(
    BROKK_170,
    join_gains(BROKK_170, {"kp": 1.0, "ki": 3.0, "kd": 0.0, "feedback": 0.3, "ready": 0.0}),
    0.1,
    manipulability_threshold(BROKK_170),
)


# --- imports ------------------------------------------------------------------------------------------


def test_importing_opens_nothing_and_needs_no_extras() -> None:
    code = (
        "import sys; import brokk_min.hw, brokk_min.can.simulated_machine, brokk_min.learning.onnx, brokk_min.learning.policy; "
        "heavy = {'can', 'pygame', 'torch', 'onnx', 'matplotlib', 'canopen', 'gymnasium', 'scipy'}; "
        "print(heavy & {*sys.modules})"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


# --- the loop on the plant ----------------------------------------------------------------------------


SHIPPED = Path(hw.__file__).with_name("shipped") / BROKK_170.name / "policy.npz"


@pytest.mark.parametrize(("axis", "controller"), [(0, "rl"), (1, "rl"), (2, "rl"), (2, "jacobian")])
def test_reward_over_the_bus_is_that_of_evaluate(axis: int, controller: str) -> None:
    """Within 0.2 %, with 2 ms of bus and machine between SYNC and valve frame."""
    sequence = axis_sequences(BROKK_170)[axis]
    driver = (
        PolicyController(BROKK_170, load_policy(SHIPPED, BROKK_170))
        if controller == "rl"
        else BASELINE
    )
    script = wishes.Script(BROKK_170, sequence.goals)
    world = World(driver, script)
    world.drive.operator = lambda driving, ready: (world.rest(0.002), script(driving, ready))[1]
    world.drive.begin()
    while world.drive.tick():
        pass
    world.close()
    assert script.done
    ticks = len(sequence.goals)
    begins = np.array(world.syncs[-ticks - 1 :])
    times, _ = world.commands
    q = np.array([row[2] for row in world.record])[np.searchsorted(times, begins + 1e-9) - 1]
    v = tool_state(BROKK_170, q[1:], np.diff(q, axis=0) * 20)[1]
    over_bus = reward(sequence.goals, v).mean()
    trace = rollout(
        BROKK_170, driver, np.array([START]), sequence.goals[:, None], TaskConfig(noise=0.0),
        np.random.default_rng(0),
    )  # fmt: skip
    assert over_bus == pytest.approx(trace.reward.mean(), abs=0.002)
    turned = np.diff(sequence.goals, axis=0, prepend=0).any(axis=1)
    half_second = np.convolve(turned, np.ones(10))[:ticks] > 0
    assert trace.reward[half_second].mean() < 0.99  # there was something to lose


class Listener:
    """Drives by the wanted rates alone and keeps what it was told."""

    def __init__(self) -> None:
        self.told: list[np.ndarray] = []

    def start(self, num: int) -> None:
        assert num == 1
        self.told.clear()

    def __call__(self, observation: np.ndarray, memory: None) -> tuple[np.ndarray, None]:
        self.told.append(observation[0].astype(float))
        return action_to_pwm(BROKK_170, 0.2 * observation[..., -8:-4]), memory


def test_the_policy_is_told_how_far_the_tool_stays_behind() -> None:
    """The observation's last block against a sum over its own goals and velocities."""
    sequence = axis_sequences(BROKK_170)[0]
    listener, script = Listener(), wishes.Script(BROKK_170, sequence.goals[:200])
    world = World(listener, script)
    world.drive.begin()
    while world.drive.tick():
        pass
    world.close()
    scale = observation_scale(BROKK_170)[1].astype(float)
    lag, checked = np.zeros(3), 0
    seen = [
        measured(BROKK_170, told) for told in listener.told[::2]
    ]  # all ticks but the first are rehearsed
    for told, before, now in zip(listener.told[2::2], seen, seen[1:], strict=False):
        error = before.v_goal - now.v_tool
        error *= min(1.0, 0.021 / max(np.linalg.norm(error), 1e-9))
        lag = (lag + error / 20) * np.exp(-1 / 40)
        np.testing.assert_allclose(
            told[-4:] * scale[-4:], joint_rates(BROKK_170, now.q, lag), atol=1e-4
        )
        checked += np.linalg.norm(lag) > 0.005
    assert checked > 100


def test_valves_close_on_the_bus_when_the_tool_was_to_stand_for_two_seconds() -> None:
    hand = Hand()
    world = World(PolicyController(BROKK_170, load_policy(SHIPPED, BROKK_170)), hand)
    sent: list[list[int]] = []
    world.downward = lambda can_id, data: (
        can_id == 0x210 and sent.append([*data[:5]]),
        [(can_id, data)],
    )[1]
    world.drive.begin()
    world.run(1.5)
    hand.v, before = (0.0, 0.0, 0.0), len(sent)
    world.run(STAND + 1.0)
    hand.v, after = (0.0, 0.1, 0.0), len(sent)
    world.run(1.0)
    world.close()
    opened = np.array(sent).any(axis=1)
    assert opened[before - 20 : before].all() and opened[-15:].all()
    stood = before + round(STAND * BROKK_170.rate)
    assert opened[before + 1 : stood].mean() > 0.5 and not opened[stood + 1 : after].any()


def test_it_is_silent_until_armed_and_moves_a_tick_later() -> None:
    hand = Hand()
    hand.enable = False
    world = World(Push(*PUSH), hand)
    sent: Out = []
    world.downward = lambda can_id, data: (sent.append((can_id, data)), [(can_id, data)])[1]
    world.drive.begin()
    world.run(1.0)
    assert world.drive.gate.active_fault == 0 and not [f for f in sent if f[0] == 0x210]
    hand.enable, hand.v = True, (0.0, 0.0, 0.0)
    world.drive.tick()
    world.drive.tick()
    frames = [data for can_id, data in sent if can_id == 0x210]
    assert [list(f[:5]) for f in frames] == [[0] * 5, [40, 0, 40, 40, 40]]
    assert [f[7] for f in frames] == [1, 1] and frames[1][5] == frames[0][5] + 1
    world.drive.tick()
    told = world.drive.history  # of its commands the controller hears with the next angles
    assert told is not None
    np.testing.assert_allclose(
        told[0, :, 2, -2:].T * 127, [[0] * 5, [40, 0, 40, 40, 40]], atol=1e-5
    )
    world.close()


def test_a_stick_that_is_not_centred_does_not_arm() -> None:
    hand = Hand()
    world = World(Push(*PUSH), lambda driving, ready: hand(True, ready))
    world.drive.begin()
    world.run(1.0)
    assert not world.drive.gate.driving and not world.commands[1].any()
    world.close()


# --- faults -------------------------------------------------------------------------------------------


class Fault:
    """What goes wrong in a world, from now on."""

    def __init__(self, world: World, hand: Hand, push: Push) -> None:
        self.world, self.hand, self.push, self.held = world, hand, push, list[tuple[int, bytes]]()

    def up(self, change: Callable[[int, bytes], Out]) -> None:
        self.world.upward = change

    def down(self, change: Callable[[int, bytes], Out]) -> None:
        self.world.downward = change


def only(wanted: int, act: Callable[[bytes], list[bytes]]) -> Callable[[int, bytes], Out]:
    """Change the frames of one identifier."""
    return lambda can_id, data: (
        [(can_id, d) for d in act(data)] if can_id == wanted else [(can_id, data)]
    )


def position(data: bytes, add: int) -> bytes:
    return struct.pack("<I", (struct.unpack("<I", data)[0] + add) % 2**26)


def freeze(f: Fault, node: int) -> None:
    counts = np.rint(f.world.simulated.plant.q / BROKK_170.encoder_step).astype(int)
    data = struct.pack("<I", encoder_raw(BROKK_170, counts)[node - 1])
    f.up(only(0x180 + node, lambda _: [data]))


def reorder(f: Fault, node: int) -> None:
    """Every second position comes after the next one."""
    held: list[bytes] = []

    def act(data: bytes) -> list[bytes]:
        if held:
            return [data, held.pop()]
        held.append(data)
        return []

    f.up(only(0x180 + node, act))


def late(f: Fault, can_id: int, delay: float) -> None:
    """Constantly late positions, and an operator who presses again and again."""
    held: list[tuple[float, bytes]] = []

    def noise() -> Out:
        due = [data for then, data in held if then <= f.world.t]
        held[:] = [item for item in held if item[0] > f.world.t]
        return [(can_id, data) for data in due]

    def press() -> None:
        f.hand.enable = bool(f.world.drive.gate.driving or not f.hand.enable)

    f.up(only(can_id, lambda data: (held.append((f.world.t + delay, data)), list[bytes]())[1]))
    f.world.noise, f.hand.act = noise, press


def once(act: Callable[[bytes], list[bytes]]) -> Callable[[bytes], list[bytes]]:
    done: list[int] = []
    return lambda data: [data] if done else (done.append(1), act(data))[1]


def flip(data: bytes) -> bytes:
    return bytes([data[0] ^ 4, *data[1:]])


def raises(error: Exception) -> Callable[..., Any]:
    def act(*_: object, **__: object) -> None:
        raise error

    return act


def flood(f: Fault, foreign: bool = False) -> tuple[set[tuple[int, int]], int]:
    """2,000 frames a second; the pairs of identifier and length that came, and how many there are."""
    rng = np.random.default_rng(0)
    ours = {
        0,
        0x80,
        0x210,
        *(base + n for base in (0x180, 0x580, 0x600, 0x700) for n in (1, 2, 3, 4, 5, 16)),
    }
    ids = rng.permutation([i for i in range(2048) if not foreign or i not in ours])
    state, seen = {"k": 0, "t": f.world.t}, set[tuple[int, int]]()
    assert len(ids) % 3  # no factor in common with the nine lengths: each pair has its turn

    def noise() -> Out:
        out = []
        while state["t"] < f.world.t:
            state["t"] += 0.0005
            k = state["k"] = int(state["k"]) + 1
            out.append((int(ids[k % len(ids)]), rng.bytes(k % 9)))
            seen.add((out[-1][0], len(out[-1][1])))
        return out

    f.world.noise = noise
    return seen, 9 * len(ids)


def second_master(f: Fault) -> None:
    """Somebody else sends valid valve frames of his own."""
    counter = iter(range(1000))
    last = {"t": f.world.t}

    def noise() -> Out:
        if f.world.t - last["t"] < 0.05:
            return []
        last["t"] = f.world.t
        return [(0x210, valve_frame([20, 0, 0, 0, 0], next(counter) % 256, 1).tobytes())]

    f.world.noise = noise


def foreign_nmt(f: Fault, data: bytes) -> None:
    frames = [(0x000, data)]
    f.world.noise = lambda: [frames.pop()] if frames else []


def close_bus(f: Fault) -> None:
    f.world.near.shutdown()
    f.world.recv = raises(can.CanOperationError("closed"))  # type: ignore[method-assign]
    f.world.send = raises(can.CanOperationError("closed"))  # type: ignore[method-assign]


def send_error(f: Fault, only_valves: bool) -> None:
    def down(can_id: int, data: bytes) -> Out:
        if can_id == 0x210 or not only_valves:
            raise can.CanOperationError("no buffer space")
        return [(can_id, data)]

    f.down(down)


def stall(f: Fault, seconds: float) -> None:
    stalls = [seconds]
    f.push.act = lambda: f.world.rest(stalls.pop()) if stalls else None


FAULTS: dict[str, tuple[Callable[[Fault], object], str]] = {
    "controller silent": (
        lambda f: f.up(only(0x710, lambda d: [])),
        "valve controller: heartbeat lost",
    ),
    "controller says it stopped": (
        lambda f: f.up(only(0x710, lambda d: [b"\x04"])),
        "valve controller: not oper",
    ),
    "controller's heartbeat malformed": (
        lambda f: f.up(only(0x710, lambda d: d * 2 and [d * 2])),
        "heartbeat lost",
    ),
    "flood on all identifiers": (flood, ""),
    "second master": (second_master, "valve controller: not operational"),
    "foreign NMT stop of all": (lambda f: foreign_nmt(f, b"\x02\x00"), ""),
    "foreign NMT reset of q4": (lambda f: foreign_nmt(f, b"\x81\x04"), "q4"),
    "foreign NMT stop of the controller": (
        lambda f: foreign_nmt(f, b"\x02\x10"),
        "valve controller: not oper",
    ),
    "bus closed": (close_bus, "error (CanOperationError: closed)"),
    "send error of all frames": (lambda f: send_error(f, False), "error (CanOperationError"),
    "send error of valve frames": (lambda f: send_error(f, True), ""),
    "valve frame lost": (
        lambda f: f.down(only(0x210, once(lambda d: []))),
        "valve controller: not operational",
    ),
    "valve frame doubled": (
        lambda f: f.down(only(0x210, once(lambda d: [d, d]))),
        "valve controller: not oper",
    ),
    "valve frame's bit flipped": (
        lambda f: f.down(only(0x210, once(lambda d: [flip(d)]))),
        "valve controller",
    ),
    "valve frame cut": (
        lambda f: f.down(only(0x210, once(lambda d: [d[:7]]))),
        "valve controller: not oper",
    ),
    "all valve frames lost": (
        lambda f: f.down(only(0x210, lambda d: [])),
        "valve controller: not operational",
    ),
    "joystick unplugged": (lambda f: setattr(f.hand, "alive", False), "operator's device lost"),
    "joystick raises": (
        lambda f: setattr(f.hand, "act", raises(OSError("gone"))),
        "error (OSError: gone)",
    ),
    "enable released": (lambda f: setattr(f.hand, "enable", False), ""),
    "SIGTERM": (lambda f: f.world.drive.signals.append(15), "stop asked for"),
    "operator stops": (lambda f: setattr(f.hand, "stop", True), "stop asked for"),
    "clock stepped forward": (
        lambda f: setattr(f.world, "offset", 3600.0),
        "tick late, or the clock was set",
    ),
    "clock stepped back": (
        lambda f: setattr(f.world, "offset", -3600.0),
        "tick late, or the clock was set",
    ),
    "log cannot be written": (
        lambda f: setattr(f.world.line, "flush", raises(OSError("no space"))),
        "error (OSError: no space)",
    ),
    "late tick": (lambda f: stall(f, 0.08), "tick late"),
    "hang": (lambda f: stall(f, 0.8), "tick late"),
    "policy returns NaN": (lambda f: f.push.m.__setitem__(2, np.nan), "q3: no valid command"),
    "policy returns infinity": (lambda f: f.push.m.__setitem__(0, np.inf), "q1: no valid command"),
    "policy beyond the limit": (lambda f: f.push.m.__setitem__(4, 81), "q5: no valid command"),
    "policy moves the locked joint": (
        lambda f: f.push.m.__setitem__(1, 20),
        "q2: no valid command",
    ),
    "policy raises": (
        lambda f: setattr(f.push, "act", raises(RuntimeError("boom"))),
        "error (RuntimeError: boom)",
    ),
    "encoders all silent": (
        lambda f: f.up(lambda i, d: [] if 0x180 < i < 0x190 else [(i, d)]),
        "q1: silent",
    ),
}
for node in range(1, 6):
    tpdo, beat, name = 0x180 + node, 0x700 + node, f"q{node}"
    FAULTS |= {
        f"{name} dropped": (lambda f, i=tpdo: f.up(only(i, lambda d: [])), f"{name}: silent"),
        f"{name} dropped once": (
            lambda f, i=tpdo: f.up(only(i, once(lambda d: []))),
            f"{name}: silent",
        ),
        f"{name} jumps": (
            lambda f, i=tpdo: f.up(only(i, lambda d: [position(d, 90)])),
            f"{name}: jumped",
        ),
        f"{name} out of range": (
            lambda f, i=tpdo: f.up(only(i, lambda d: [position(d, 2048)])),
            f"{name}: out of range",
        ),
        f"{name} doubled": (lambda f, i=tpdo: f.up(only(i, lambda d: [d, d])), f"{name}: doubled"),
        f"{name} reordered": (lambda f, n=node: reorder(f, n), f"{name}: silent"),
        f"{name} malformed": (
            lambda f, i=tpdo: f.up(only(i, lambda d: [d[:3]])),
            f"{name}: doubled",
        ),
        f"{name} heartbeat lost": (
            lambda f, i=beat: f.up(only(i, lambda d: [])),
            f"{name}: heartbeat lost",
        ),
        f"{name} rebooted": (
            lambda f, i=beat: f.up(only(i, lambda d: [b"\x00"])),
            f"{name}: not operational",
        ),
    }
    if node != 2:  # the operator moves q2, no command of ours
        FAULTS[f"{name} late by 30 ms, after re-arm too"] = (
            lambda f, i=tpdo: late(f, i, 0.030),
            f"{name}: silent",
        )
        FAULTS[f"{name} frozen"] = (lambda f, n=node: freeze(f, n), f"{name}: frozen")


@pytest.mark.parametrize("phase", [0.0005, 0.0215, 0.0485])
@pytest.mark.parametrize("name", list(FAULTS))
def test_every_fault_ends_neutral_within_175_ms_and_latched(name: str, phase: float) -> None:
    """By the plant's own record, whenever in a tick it comes, though the operator holds on."""
    cause, reason = FAULTS[name]
    hand, push = Hand(), Push(*PUSH)
    world = World(push, hand)
    world.drive.begin()
    world.run(1.2)
    tick_began = world.syncs[-1]
    world.rest(max(0.0, tick_began + phase - world.t))
    assert world.commands[1][-1].tolist() == list(PUSH), "it drove"
    begun = world.t
    cause(Fault(world, hand, push))
    world.run(0.8)
    first = world.drive.reason
    world.rest(max(0.0, begun + 1.2 - world.t))
    times, m = world.commands
    after = times > begun + 0.175
    assert after.sum() > 200
    assert not m[after].any(), f"{name}: valves open {times[m.any(axis=1)][-1] - begun:.3f} s later"
    assert reason in first, first
    world.close()


@pytest.mark.parametrize("node", [1, 3, 4, 5])
@pytest.mark.parametrize(
    ("counts", "bound"), [(80, 0.175), (40, 0.175), (-40, 0.175), (20, 0.45), (16, 0.85)]
)
def test_a_frozen_encoder_of_a_moving_joint_is_found_at_small_commands_too(
    node: int, counts: int, bound: float
) -> None:
    """The table of docs/hardware.md: the smaller the command, the longer a count may stand still."""
    push = Push(*(counts * (np.arange(1, 6) == node)))
    world = World(push, hand := Hand())
    world.drive.begin()
    world.run(1.6)
    world.rest(0.0215)
    begun = world.t
    freeze(Fault(world, hand, push), node)
    world.run(1.2)
    times, m = world.commands
    assert m[times <= begun][-1].any() and not m[times > begun + bound].any()
    assert world.drive.reason == f"fault: q{node}: frozen, or the joint does not move"
    world.close()


@pytest.mark.parametrize(("counts", "bound"), [(80, 0.55), (-40, 0.55), (20, 0.8), (16, 1.25)])
def test_an_encoder_that_is_frozen_from_the_start_is_found(counts: int, bound: float) -> None:
    """A joint at rest may take 0.4 s to move, so that this takes longer than the 175 ms."""
    push = Push(0, 0, 0, 0, 0)
    world = World(push, hand := Hand())
    world.drive.begin()
    world.run(0.6)
    freeze(Fault(world, hand, push), 3)
    push.m[2], begun = counts, world.t
    world.run(1.6)
    times, m = world.commands
    assert m.any() and not m[times > begun + bound].any()
    assert world.drive.reason == "fault: q3: frozen, or the joint does not move"
    world.close()


def test_a_program_that_is_killed_leaves_the_valves_neutral_and_latched() -> None:
    """SIGKILL: no more ticks. The machine's own watchdog closes, and a resumed frame does not reopen."""
    world = World(Push(*PUSH), Hand())
    world.drive.begin()
    world.run(1.2)
    killed = world.t
    world.rest(1.0)
    times, m = world.commands
    assert m[np.searchsorted(times, killed)].any() and not m[times > killed + 0.155].any()
    counter = int(world.drive.gate.counter) + 1
    world.send(can.Message(arbitration_id=0x210, data=valve_frame(PUSH, counter, 1).tobytes()))
    world.rest(0.1)
    assert not world.commands[1][times.searchsorted(killed + 0.2) :].any()
    world.close()


def test_no_frame_of_any_identifier_and_length_opens_the_valves_again() -> None:
    world = World(Push(*PUSH), Hand())
    world.drive.begin()
    world.run(1.2)
    begun = world.t
    seen, pairs = flood(Fault(world, Hand(), Push()))
    world.run(9.3)
    assert len(seen) == pairs == 2048 * 9
    times, m = world.commands
    assert m[times <= begun].any() and not m[times > begun + 0.175].any()
    world.close()


def test_foreign_traffic_alone_does_no_harm_and_data_stay_fresh() -> None:
    """2,000 foreign frames a second, no filters: python-can's would let the data grow old."""
    world = World(Push(*PUSH), Hand())
    world.drive.begin()
    seen, pairs = flood(Fault(world, Hand(), Push()), foreign=True)
    ages: list[float] = []
    hear = world.drive.nodes.hear

    def listen(frame: bus.Frame) -> None:
        hear(frame)
        if frame.id == 0x183:
            shown = struct.unpack("<I", frame.data)[0] * BROKK_170.encoder_step
            ages.append(abs(shown - world.simulated.plant.q[2]))

    world.drive.nodes.hear = listen  # type: ignore[method-assign]
    world.run(9.3)
    assert world.drive.gate.driving and world.drive.reason == "" and world.drive.skipped == 0
    assert (
        len(seen) == pairs > 18_000
        and len(ages) > 175
        and max(ages) < 0.6 * BROKK_170.encoder_step + 1e-3
    )
    world.close()


def test_a_fault_is_left_by_a_new_edge_only() -> None:
    hand = Hand()
    world = World(Push(*PUSH), hand)
    world.drive.begin()
    world.run(0.6)
    world.upward = only(0x183, once(lambda d: []))
    world.run(0.5)
    assert world.drive.reason == "fault: q3: silent" and not world.drive.gate.driving
    assert "fault: q3: silent" in world.drive.status() and world.drive.status().startswith("ready")
    hand.enable = False
    world.run(0.2)
    assert world.drive.reason == "fault: q3: silent"
    hand.enable = True
    world.run(0.4)
    assert world.drive.gate.driving and world.drive.reason == ""
    assert world.drive.status().startswith("driving v wanted +0.10 +0.00 +0.00 is ")
    assert world.commands[1][-1].tolist() == list(PUSH)
    noted, note = list[OperatorInput](), world.line.note
    world.line.note = lambda data: (noted.append(unpack_operator_input(data)), note(data))[1]  # type: ignore
    hand.act, hand.enable = raises(OSError("gone")), False
    world.run(0.1)
    assert noted[-1].error  # so that a replay of the log gets the same
    hand.act = lambda: None
    world.run(0.1)
    assert not noted[-1].error
    assert world.drive.reason == "fault: error (OSError: gone)"
    hand.enable = True
    world.run(0.2)
    assert world.drive.gate.driving and world.drive.reason == ""
    world.close()


@pytest.mark.parametrize(
    ("delay", "found"),
    [
        ((5, 5), False),
        ((15, 15), False),
        ((25, 25), True),
        ((45, 45), True),
        ((0, 15), False),
        ((0, 60), True),
    ],
)
def test_positions_later_than_their_window_are_found(delay: tuple[int, int], found: bool) -> None:
    """Constantly, or by chance between two bounds [ms]; up to 20 ms are within the window."""
    rng, push, held = np.random.default_rng(0), Push(*PUSH), list[tuple[float, bytes]]()
    world = World(push, Hand())
    world.drive.begin()
    world.run(0.8)
    begun = world.t

    def hold(data: bytes) -> list[bytes]:
        held.append((world.t + rng.uniform(*delay) / 1e3, data))
        return []

    def noise() -> Out:
        due = [data for then, data in held if then <= world.t]
        held[:] = [item for item in held if item[0] > world.t]
        return [(0x183, data) for data in due]

    world.upward, world.noise = only(0x183, hold), noise
    world.run(1.0)
    times, m = world.commands
    assert world.drive.reason == ("fault: q3: silent" if found else "")
    assert m[times > begun + 0.175].any() != found
    world.close()


def test_a_delay_of_a_whole_tick_is_found_when_it_begins_and_looks_fresh_after_it() -> None:
    """A position has neither time nor number: what comes within its window is taken for this tick's."""
    hand, push, held = Hand(), Push(*PUSH), list[bytes]()
    world = World(push, hand)
    world.drive.begin()
    world.run(0.8)
    begun = world.t
    world.upward = only(0x183, lambda data: (held.append(data), held[-2:-1])[1])
    world.run(0.3)
    times, m = world.commands
    assert world.drive.reason == "fault: q3: silent" and not m[times > begun + 0.175].any()
    hand.enable = False
    world.run(0.1)
    hand.enable = None
    world.run(0.2)
    assert world.drive.gate.driving  # the limit of what can be known, told in docs/hardware.md
    world.close()


def test_nodes_that_fell_back_are_started_once_the_switch_is_released() -> None:
    hand, sent = Hand(), list[tuple[int, bytes]]()
    world = World(Push(*PUSH), hand)
    world.downward = lambda can_id, data: (sent.append((can_id, data)), [(can_id, data)])[1]
    world.drive.begin()
    world.run(0.6)
    sent.clear()
    world.simulated.nmt[4] = 127
    world.run(0.4)
    assert world.drive.reason == "fault: q4: not operational" and world.drive.gate.active_fault
    assert 0x000 not in dict(sent) and {data for can_id, data in sent if can_id == 0x080} == {b""}
    hand.enable = False
    world.run(0.2)
    assert {data for can_id, data in sent if can_id == 0x000} == {
        b"\x01\x00"
    } and not world.drive.gate.active_fault
    sent.clear()
    world.run(0.2)
    assert 0x000 not in dict(sent) and world.drive.status().startswith("ready")
    world.close()


def test_a_lost_joystick_is_no_release_of_the_switch() -> None:
    hand = Hand()
    world = World(Push(*PUSH), hand)
    world.drive.begin()
    world.run(0.6)
    hand.alive = False
    world.run(0.3)
    hand.alive = True
    world.run(0.3)
    assert not world.drive.gate.driving and "device lost" in world.drive.reason
    world.close()


def test_the_status_by_hand() -> None:
    """A straight level arm, 5 m from the slew axis, that slews at 0.1 rad/s."""
    world = World(Push(*PUSH), Hand())
    drive, no = world.drive, " ".join(["+nan"] * 3)
    assert (
        drive.status()
        == f"waiting v wanted +0.00 +0.00 +0.00 is {no} q {no} +nan +nan late 0.0 ms, skipped 0"
    )
    drive.history = np.full((1, 5, 3, 13), 9.0)
    drive.history[0, :, :2, -1] = np.transpose([[0, 0, 0, np.pi, 3 * np.pi / 4], [0.1, 0, 0, 0, 0]])
    drive.lateness, drive.skipped = 0.5, 7
    drive.operator_input = OperatorInput((0.1, -0.2, 0.25))
    said = "waiting v wanted +0.10 -0.20 +0.25 is +0.00 +0.50 +0.00 q +0.00 +0.00 +0.00 +3.14 +2.36"
    assert drive.status().replace("-0.00", "+0.00") == said + " late 500.0 ms, skipped 7"
    world.close()


def test_nodes_that_were_never_there_are_named() -> None:
    world = World(Push(*PUSH), Hand())
    assert np.isneginf(world.drive.nodes.beat).all()  # nothing was heard yet
    world.drive.begin()
    world.upward = only(0x704, lambda d: [])
    world.drive.nodes.beat[:] = -np.inf
    world.run(0.4)
    assert world.drive.reason == "q4: never seen" and world.drive.status().startswith("waiting")
    world.close()


def test_nothing_is_taken_for_frozen_that_is_not() -> None:
    """Reversals, stops and small commands on the plant, by the baseline and at random, are no fault."""
    rng = np.random.default_rng(3)

    class Erratic(Push):
        def __call__(self, observation: np.ndarray, memory: None) -> tuple[np.ndarray, None]:
            if rng.random() < 0.15:
                self.m = rng.choice([-80, -40, -20, 0, 0, 20, 40, 80], 5) * (np.arange(5) != 1)
            return self.m[None] / 127, None

    world = World(Erratic(0, 0, 0, 0, 0), Hand())
    world.drive.begin()
    world.run(60.0)
    assert world.drive.reason == "" and world.drive.gate.driving
    assert np.abs(np.diff(world.commands[1], axis=0)).sum() > 2000
    world.close()


# --- the clock ----------------------------------------------------------------------------------------


def test_ticks_keep_an_absolute_grid_and_missed_ones_are_skipped_never_made_up() -> None:
    world = World(Push(0, 0, 0, 0, 0), Hand())
    world.step = 0.0007  # does not divide a tick
    world.drive.begin()
    begun = world.t
    stalls = {40: 0.13, 80: 0.052, 90: 0.26}
    for k in range(120):
        busy = stalls.get(k, 0.004)
        world.downward = lambda i, data, busy=busy: (world.rest(busy * (i == 0x210)), [(i, data)])[
            1
        ]  # type: ignore
        world.drive.tick()
    ticks = (np.array(world.syncs) - begun) / 0.05
    late = np.flatnonzero(ticks - np.floor(ticks + 0.03) > 0.03)
    assert late.tolist() == [41, 81, 91]  # one tick at once after each stall, then the grid again
    assert np.diff(ticks).min() > 0.3 and np.diff(ticks)[[40, 90]] == pytest.approx(
        [2.6, 5.2], abs=0.25
    )
    assert world.drive.skipped == 5 and round(ticks[-1]) == 119 + 5  # no tick was made up for
    world.close()


def test_the_grid_does_not_drift_by_rounding() -> None:
    """A day of ticks on a clock that shows the time of day, whose last bit is 0.2 us."""
    world = World(Push(0, 0, 0, 0, 0), Hand())
    drive = world.drive
    drive.begun = 1.8e9
    drive.line.now = lambda: round(drive.deadline, 6) - 1e-6  # type: ignore[method-assign]
    for _ in range(20 * 86_400 // 10):
        drive._next_deadline()
    assert drive.deadline - 1.8e9 == pytest.approx(8640.0, abs=1e-6) and drive.skipped == 0
    world.close()


class ClockBus:
    """A bus that is silent and, meanwhile, sets the time of day back by an hour."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.read, self.write = os.pipe()
        real = time.time
        monkeypatch.setattr("can.bus.time", lambda: real() - 3600 * self.stepped)
        self.stepped = 0

    def fileno(self) -> int:
        return self.read

    def recv(self, timeout: float) -> None:
        assert timeout == 0.0
        self.stepped = 1


def test_a_wait_does_not_follow_the_time_of_day(monkeypatch: pytest.MonkeyPatch) -> None:
    line = bus.Bus(ClockBus(monkeypatch))
    begun = time.monotonic()
    assert line.recv(0.02) is None
    assert 0.015 < time.monotonic() - begun < 5.0


class SelectBus:
    """A bus that is silent; a wait on it takes as long as the wait says, or a millisecond."""

    def __init__(self) -> None:
        self.t, self.waits, self.ready = 7.0, list[float](), list[int]()

    def fileno(self) -> int:
        return 7

    def recv(self, timeout: float) -> None:
        assert timeout == 0.0

    def select(self, read: list[int], *rest: Any) -> tuple[list[int], list[int], list[int]]:
        assert read == [7]
        self.waits.append(rest[-1])
        self.t += rest[-1] or 0.001
        return self.ready, [], []


@pytest.mark.parametrize(("awake", "slept"), [((), [0.019]), ((0.004,), [0.016]), ((0.020,), [])])
def test_a_wait_sleeps_only_after_the_time_it_is_told_to_be_awake(
    awake: tuple[float, ...], slept: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    silent = SelectBus()
    line = bus.Bus(silent, clock=lambda: silent.t)
    monkeypatch.setattr("brokk_min.can.canopen.select.select", silent.select)
    assert line.recv(0.020, *awake) is None
    assert [wait for wait in silent.waits if wait] == pytest.approx(slept)
    assert 0.020 <= silent.t - 7.0 < 0.0225
    silent.t, silent.ready = 7.0, [7]
    line.recv(0.020, *awake)
    assert silent.t < 7.002  # what is there is read at once


def test_the_loop_sleeps_but_not_just_before_sync_nor_while_encoders_answer() -> None:
    """A wait may sleep from `awake` after its begin to its end."""
    world, waits = World(Push(*PUSH), Hand()), list[tuple[float, float]]()
    world.drive.begin()
    recv, rest = world.line.recv, world.line.rest

    def pause(seconds: float) -> None:
        waits.append((world.t, world.t + seconds))
        rest(seconds)

    def wait(timeout: float, awake: float = 0.0) -> bus.Frame | None:
        waits.append((world.t + awake, world.t + timeout))
        return recv(timeout, awake)

    world.line.recv, world.line.rest = wait, pause  # type: ignore[method-assign]
    world.run(1.0)
    assert world.drive.reason == "" and world.drive.gate.driving
    asleep = np.array([w for w in waits if w[1] > w[0] + 1e-5])
    for sync in world.syncs:
        assert ((asleep[:, 1] < sync - hw.AWAKE + 1e-5) | (asleep[:, 0] > sync - 1e-5)).all()
        for_encoders = asleep[np.abs(asleep[:, 1] - sync - hw.WINDOW) < 1e-3, 0]
        assert len(for_encoders) and (for_encoders > sync + hw.AWAKE - 1e-5).all()
    before = [max(asleep[asleep[:, 0] < sync, 1]) for sync in world.syncs[1:]]
    np.testing.assert_allclose(np.array(world.syncs[1:]) - before, hw.AWAKE, atol=1e-5)
    world.close()


def test_a_small_step_back_of_the_clock_begins_a_new_grid() -> None:
    world = World(Push(0, 0, 0, 0, 0), Hand())
    world.downward = lambda i, data: (world.rest(0.004 * (i == 0x210)), [(i, data)])[
        1
    ]  # the loop is busy
    world.drive.begin()
    world.run(0.5)
    world.offset = -1.0
    world.run(1.0)
    assert np.diff(world.syncs)[-15:] == pytest.approx([0.05] * 15, abs=5e-4)
    world.close()


def test_a_rehearsal_comes_before_sync_and_leaves_no_trace() -> None:
    push = Push(*PUSH)
    world = World(push, Hand())
    calls, told = list[float](), list[float]()
    push.act = lambda: calls.append(world.t)
    world.downward = lambda i, data: (told.append(world.t) if i == 0x80 else None, [(i, data)])[1]
    world.drive.begin()
    world.run(1.0)
    before = dict(vars(world.drive))
    nodes = [
        np.copy(a)
        for a in (world.drive.nodes.frames, world.drive.nodes.raw, world.drive.nodes.beat)
    ]
    calls.clear()
    world.drive._rehearse(world.line.now() + 0.001)
    assert len(calls) == hw.REHEARSALS
    assert vars(world.drive) == before and all(vars(world.drive)[k] is before[k] for k in before)
    for kept, now in zip(
        nodes, (world.drive.nodes.frames, world.drive.nodes.raw, world.drive.nodes.beat)
    ):
        np.testing.assert_array_equal(kept, now)
    calls.clear()
    world.drive.tick()
    assert calls[0] < told[-1] <= calls[-1] and len(calls) == hw.REHEARSALS + 1
    push.act = lambda: world.rest(0.010)  # a slow controller; no time for more than one rehearsal
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(hw, "REHEARSALS", 4)
        world.run(1.0)
    assert world.drive.gate.driving and world.drive.skipped == 0
    world.close()


# --- start --------------------------------------------------------------------------------------------


def test_begin_sets_up_the_encoders_and_starts_the_nodes() -> None:
    world = World(Push(*PUSH), Hand())
    world.simulated.objects[3, 0x1017, 0] = 0
    world.simulated.objects[3, 0x1800, 2] = 254
    asked: Out = []
    world.downward = lambda can_id, data: (asked.append((can_id, data)), [(can_id, data)])[1]
    world.drive.begin()
    assert [data.hex(" ") for can_id, data in asked if can_id == 0x603] == [
        "40 01 65 00 00 00 00 00",  # read the resolution
        "2b 17 10 00 32 00 00 00",  # two bytes: a heartbeat every 50 ms
        "2f 00 18 02 01 00 00 00",  # one byte: a position at every SYNC
    ]
    assert asked[-1] == (0x000, b"\x01\x00")
    world.rest(0.01)
    assert (
        world.simulated.objects[3, 0x1017, 0] == 50 and world.simulated.objects[3, 0x1800, 2] == 1
    )
    assert set(world.simulated.nmt.values()) == {5}
    world.close()


def test_begin_refuses_encoders_that_do_not_fit() -> None:
    world = World(Push(*PUSH), Hand())
    world.simulated.objects[4, 0x6501, 0] = 8192
    with pytest.raises(
        ValueError, match=r"q4: expected 4096 counts a turn of encoder node 4 .*got 8192"
    ):
        world.drive.begin()
    del world.simulated.objects[4, 0x6501, 0]
    with pytest.raises(ValueError, match=r"node 4: object 0x6501:00: .*abort 0x06020000"):
        world.drive.begin()
    world.upward, begun = lambda can_id, data: [], world.t
    with pytest.raises(
        ValueError, match=r"node 1: object 0x6501:00: expected an answer within 0.5 s, got none"
    ):
        world.drive.begin()
    assert world.t - begun == pytest.approx(0.5, abs=0.002)
    with pytest.raises(ValueError, match=r"6_joints: expected at most 5 joints"):
        six = (*BROKK_170.joints, replace(BROKK_170.joints[4], name="q6", encoder_node=6))
        hw.Drive(replace(BROKK_170, name="6_joints", joints=six), BASELINE, world.line, Hand())
    world.close()


def test_sdo_reads_small_objects_and_skips_foreign_answers() -> None:
    world = World(Push(*PUSH), Hand())
    answers = {
        0x1017: bytes([0x4B, 0x17, 0x10, 0, 0x34, 0x12, 0xFF, 0xFF]),
        0x1018: bytes([0x4F, 0x18, 0x10, 0, 7, 9, 9, 9]),
    }

    def up(can_id: int, data: bytes) -> Out:
        index = struct.unpack_from("<H", data, 1)[0] if can_id == 0x581 else 0
        foreign = [(0x582, data), (0x581, data[:7]), (0x581, bytes([0x43, 1, 2, 3, 4, 5, 6, 7]))]
        return [*foreign, (can_id, answers[index])] if index in answers else [(can_id, data)]

    world.upward = up
    assert (
        bus.sdo(world.line, 1, (0x1017, 0)) == 0x1234 and bus.sdo(world.line, 1, (0x1018, 0)) == 7
    )
    world.upward = lambda can_id, data: [(can_id, data)]
    assert bus.sdo(world.line, 1, (0x1000, 0)) == 406
    with pytest.raises(ValueError, match="0x06010000"):
        bus.sdo(world.line, 1, (0x1000, 0), 5)
    world.close()


# --- lines and logs -----------------------------------------------------------------------------------


def test_a_line_tells_our_frames_from_others_and_logs_all() -> None:
    here, there = (can.Bus("line", interface="virtual") for _ in range(2))
    text = io.StringIO()
    line = bus.Bus(here, can.CanutilsLogWriter(text), "can0", echo=True, clock=lambda: 1.0)
    line.send(0x123, b"\x01\x02")
    there.send(
        can.Message(arbitration_id=0x123, data=b"\x01\x02", is_extended_id=False)
    )  # the echo
    there.send(
        can.Message(arbitration_id=0x123, data=b"\x01\x02", is_extended_id=False)
    )  # somebody else
    there.send(can.Message(arbitration_id=0x123, data=b"\x01", is_extended_id=True))
    there.send(can.Message(arbitration_id=0x124, is_remote_frame=True, is_extended_id=False))
    there.send(can.Message(arbitration_id=0x125, is_error_frame=True, is_extended_id=False))
    there.send(can.Message(arbitration_id=0x126, is_fd=True, data=bytes(12), is_extended_id=False))
    frames = [line.recv(0.5) for _ in range(6)]
    assert [f and f.id for f in frames] == [-1, 0x123, -1, -1, -1, -1]
    assert frames[0] == bus.Frame(line.now(), -1, b"\x01\x02")
    assert line.recv(0.0) is None
    line.note(b"\x09")
    assert not text.getvalue()  # writing waits until there is time
    line.flush()
    lines = text.getvalue().splitlines()
    assert len(lines) == 7  # all but the echo
    assert re.fullmatch(r"\(\d+\.\d{6}\) can0 123#0102 T", lines[0])
    assert re.fullmatch(r"\(\d+\.\d{6}\) can0 123#0102 R", lines[1])
    assert re.fullmatch(r"\(\d+\.\d{6}\) operator 7FF#09 T", lines[-1])
    plain = bus.Bus(
        here
    )  # of a bus that gives back nothing: what looks like ours is somebody else's
    plain.send(0x123, b"\x01\x02")
    there.send(can.Message(arbitration_id=0x123, data=b"\x01\x02", is_extended_id=False))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "brokk_min.can.canopen.select.select", raises(OSError("no descriptor to wait on"))
        )
        frame = plain.recv(0.5)
    assert frame and frame.id == 0x123
    here.shutdown()
    there.shutdown()


def test_a_line_that_is_closed_has_written_all_and_one_without_log_closes(tmp_path: Path) -> None:
    class Quick(SelectBus):
        def send(self, message: can.Message, timeout: float) -> None:
            assert 0 < timeout <= 0.02  # a full buffer must not hold up the tick

        def shutdown(self) -> None:
            self.t = -1.0

    for log in (None, can.CanutilsLogWriter(tmp_path / "a.log")):
        line = bus.Bus(here := Quick(), log, "can0", clock=lambda: 1e6 + 0.12345678)
        assert abs(line.now() - time.time()) < 60
        line.start = 0.0
        line.send(0x123, b"\x01")
        assert line.now() == 1000000.123457
        line.close()
        assert here.t == -1.0
    assert (tmp_path / "a.log").read_text() == "(1000000.123457) can0 123#01 T\n"


def drive_logged(path: Path, seconds: float = 4.0) -> World:
    """A drive with a fault in its midst, logged."""
    hand = Hand()
    world = World(BASELINE, hand, log=can.CanutilsLogWriter(path, channel="can0"))
    world.drive.begin()
    world.run(seconds / 2)
    world.upward = only(0x185, once(lambda d: []))
    world.run(0.3)
    hand.enable = False
    world.run(0.1)
    hand.enable, hand.v = True, (0.0, 0.1, 0.05)
    world.run(seconds / 2)
    world.drive.signals.append(2)
    world.run(1.0)
    world.line.close()
    world.far.shutdown()
    return world


def test_a_recorded_log_replays_to_the_same_bytes(tmp_path: Path) -> None:
    drive_logged(tmp_path / "run.log")
    frames = list(bus.read_frames(tmp_path / "run.log"))
    again = drive_log.replay(BROKK_170, BASELINE, frames)
    sent = [f for f in frames if f.sent and f.channel != "operator"]
    assert [(f.id, f.data) for f in again] == [(f.id, f.data) for f in sent]
    valves = [f.data for f in sent if f.id == 0x210]
    assert len(valves) > 60 and len({v[:5] for v in valves}) > 30
    assert drive_log.compare(BROKK_170, frames, again) == (len(valves), len(valves))
    other = drive_log.compare(
        BROKK_170, frames, drive_log.replay(BROKK_170, Push(0, 0, 0, 0, 0), frames)
    )
    assert other[0] < 0.5 * other[1]
    cut = frames[: len(frames) * 2 // 3]  # as after a SIGKILL
    assert [f.data for f in drive_log.replay(BROKK_170, BASELINE, cut)] == [
        f.data for f in cut if f.sent and f.channel != "operator"
    ]
    with pytest.raises(ValueError, match=r"log: expected \w+ sent at .*, got"):
        drive_log.replay(BROKK_170, BASELINE, [f for f in frames if f.id != 0x210])


def test_a_tape_by_hand() -> None:
    read, wish = bus.Frame(1.1, 0x181, b"\x07"), OperatorInput((0.1, 0.0, 0.0), enable=True)
    sync, noted = (
        bus.Frame(1.0, 0x080, b"", True),
        bus.Frame(1.2, bus.OPERATOR_INPUT, wish.pack(), True, bus.OPERATOR_CHANNEL),
    )
    last = bus.Frame(1.3, 0x182, b"\x08")
    tape = drive_log.ReplayedBus([sync, read, noted, last])
    assert tape.recv(0.1) is None and tape.operator_input(True, True) == wish  # SYNC is to be sent first
    tape.send(0x080, b"")
    assert tape.sent == [sync] and tape.recv(0.1) is read and tape.recv(0.1) is None
    assert tape.note(b"") == 1.2 and tape.now() == 1.3 and tape.recv(0.1) is last
    assert not tape.more and not tape.wrong and tape.recv(0.1) is None and tape.now() == 1.3
    assert tape.operator_input(True, True) == OperatorInput(stop=True)
    for found in (sync._replace(id=0x210), sync._replace(sent=False)):  # another was sent, or none
        tape = drive_log.ReplayedBus([found, read])
        tape.send(0x080, b"")
        assert (
            tape.wrong == f"log: expected 080 sent at 1.000000, got {found.id:03X}"
            and not tape.more
        )


def test_a_log_of_a_drive_reads_back_as_a_log_of_the_machine(tmp_path: Path) -> None:
    world = drive_logged(tmp_path / "run.log")
    log = drive_log.log_for_fit(BROKK_170, bus.read_frames(tmp_path / "run.log"))
    assert log.joints == BROKK_170.names and [r.name for r in log.recordings] == [
        "drive_000",
        "drive_001",
    ]
    write_log(tmp_path / "log.csv", log)
    read = read_log([tmp_path / "log.csv"], BROKK_170.velocity_samples)
    times, m = world.commands
    q = np.array([row[2] for row in world.record])
    begins = np.array(world.syncs)
    for recording, copy in zip(log.recordings, read.recordings, strict=True):
        np.testing.assert_allclose(copy.q, recording.q, atol=1e-6)
        np.testing.assert_allclose(copy.u, recording.u, atol=1e-6)
        # where in the drive it is: at some SYNC, which may fall on the border of two of the plant's steps
        starts = range(len(begins) - len(recording.q) + 1)
        steps = np.searchsorted(times, [begins[k : k + len(recording.q)] for k in starts])
        off = np.min([np.abs(q[steps - k] - recording.q).max(2) for k in (1, 2)], axis=0).max(1)
        assert off.min() < 0.51 * BROKK_170.encoder_step
        moments = begins[off.argmin() :][: len(recording.q)]
        inside = np.searchsorted(times, moments + 0.03)
        np.testing.assert_allclose(
            m[inside], recording.u * 127, atol=1e-6
        )  # the command that came next
    with pytest.raises(
        ValueError, match="expected more than 14 ticks of driving in a row, got none"
    ):
        drive_log.log_for_fit(BROKK_170, list(bus.read_frames(tmp_path / "run.log"))[:200])


def test_a_log_by_hand_gives_commands_and_angles_tick_by_tick() -> None:
    """TelemetryReader are missing; a foreign frame and a cut one in each change nothing; 14 ticks are too few."""
    machine, frames = replace(BROKK_170, rate=10.0), list[bus.Frame]()
    parts = range(15), range(16, 36), range(37, 51)
    for k in (k for part in parts for k in part):
        t = 100 + k / 10
        frames.append(bus.Frame(t, 0x080, b"", True))
        frames += [
            bus.Frame(t, 0x180 + node, struct.pack("<I", 100 * node + k)) for node in range(1, 6)
        ]
        frames.append(bus.Frame(t, 0x555, b"\x01" * 8))
        frames.append(bus.Frame(t, 0x210, valve_frame([80, 0, -80, 1, 0], k, 1).tobytes(), True))
        frames.append(bus.Frame(t, 0x210, b"\x01" * 7, True))
    log = drive_log.log_for_fit(machine, frames)
    assert log.rate == 10 and [len(r.q) for r in log.recordings] == [15, 20]
    for recording, ticks in zip(log.recordings, parts):
        counts = 100 * np.arange(1, 6) + np.array(ticks)[:, None]
        np.testing.assert_allclose(recording.q, counts * machine.encoder_step, atol=1e-12)
        np.testing.assert_allclose(recording.q_dot[4:], 10 * machine.encoder_step, atol=1e-12)
        np.testing.assert_allclose(recording.u * 127, len(ticks) * [[80, 0, -80, 1, 0]], atol=1e-9)


def test_a_gap_in_a_log_starts_a_new_recording(tmp_path: Path) -> None:
    drive_logged(tmp_path / "run.log", seconds=6.0)
    frames = list(bus.read_frames(tmp_path / "run.log"))
    middle = frames[0].time + 1.6
    holed = [f for f in frames if not middle < f.time < middle + 0.12]
    lengths = [len(r.q) for r in drive_log.log_for_fit(BROKK_170, holed).recordings]
    whole = [len(r.q) for r in drive_log.log_for_fit(BROKK_170, frames).recordings]
    assert len(lengths) == len(whole) + 1 and sum(whole) - 4 <= sum(lengths) < sum(whole)


def test_python_can_is_asked_for_in_one_sentence(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "can", None)
    with pytest.raises(ValueError, match=r"^can: expected the extra brokk_min\[hw\], got"):
        list(bus.read_frames(tmp_path / "a.log"))


def test_logs_that_are_none_are_refused(tmp_path: Path) -> None:
    for text in ("nonsense\n", "(1.0) can0 12#zz\n", "(x) can0 123#00 R\n"):
        (tmp_path / "bad.log").write_text(text)
        with pytest.raises(ValueError, match=r"bad\.log: expected a candump log, got"):
            list(bus.read_frames(tmp_path / "bad.log"))


def test_a_log_that_was_cut_is_read_up_to_its_last_whole_line(tmp_path: Path) -> None:
    text = "(1.000000) can0 123#0102 R\n(2.000000) can0 080#AABB T\n"
    for size in range(len(text) + 1):
        (tmp_path / "cut.log").write_text(text[:size])
        times = [f.time for f in bus.read_frames(tmp_path / "cut.log")]
        assert times == [1.0, 2.0][: text[:size].count("\n")]


def test_a_plain_candump_log_is_read_too(tmp_path: Path) -> None:
    (tmp_path / "can.log").write_text(
        "(1.000000) can0 123#0102\n(2.000000) can0 12345678#\n(3.0) can0 080#\n"
    )
    found = list(bus.read_frames(tmp_path / "can.log"))
    assert [(f.id, f.data, f.sent, f.channel) for f in found] == [
        (0x123, b"\x01\x02", False, "can0"), (-1, b"", False, "can0"), (0x80, b"", False, "can0"),
    ]  # fmt: skip


# --- wishes ----------------------------------------------------------------------------------------


def test_wishes_survive_the_log_to_a_tenth_of_a_millimetre() -> None:
    for flags in range(16):
        wish = OperatorInput((0.3, -0.12345, 3.2), *(bool(flags & 1 << i) for i in range(4)))
        assert unpack_operator_input(wish.pack()) == wish._replace(v_goal=(0.3, -0.1234, 3.2))


def test_a_script_waits_presses_plays_and_ends() -> None:
    script = wishes.Script(BROKK_170, np.array([[0.1, 0, 0], [0, 0.2, 0]]))
    assert script(False, False) == OperatorInput() and script(False, True) == OperatorInput(enable=True)
    assert script(False, True) == OperatorInput()  # it did not work: let go, and press again
    assert script(False, True) == OperatorInput(enable=True)
    assert script(True, True) == OperatorInput((0.1, 0.0, 0.0), enable=True)
    assert not script.done
    assert script(True, True) == OperatorInput((0.0, 0.2, 0.0), enable=True)
    assert script.done and script(True, True).stop
    faulted = wishes.Script(BROKK_170, np.array([[0.1, 0, 0], [0, 0.2, 0]]))
    assert faulted(False, True).enable and faulted(True, True).enable  # it does not wait to press
    assert faulted(False, True) == OperatorInput(stop=True) and not faulted.done
    never = wishes.Script(BROKK_170, np.zeros((1, 3)), patience_s=0.2)
    assert [never(False, False).stop for _ in range(5)] == [False] * 4 + [True]
    assert not wishes.Script(BROKK_170, np.array([[0.0, 0.0, 0.3]])).done  # no faster than allowed
    with pytest.raises(ValueError, match=r"command: expected at most 0.3 m/s, got 0.5 m/s"):
        wishes.Script(BROKK_170, np.array([[0.3, 0.4, 0.0]]))
    with pytest.raises(ValueError, match="command"):
        wishes.Script(BROKK_170, np.array([[np.nan, 0.4, 0.0]]))


class Virtual:
    """SDL's virtual joystick: a device without a device."""

    def __init__(self, axes: int = 6, buttons: int = 8) -> None:
        import ctypes

        import pygame

        os.environ["SDL_VIDEODRIVER"] = "dummy"
        pygame.display.init()
        pygame.joystick.init()
        folder = Path(pygame.__file__).parent.parent / "pygame.libs"
        self.sdl = ctypes.CDLL(str(next(folder.glob("libSDL2-2*"))))
        self.sdl.SDL_JoystickOpen.restype = ctypes.c_void_p
        self.sdl.SDL_JoystickSetVirtualAxis.argtypes = [
            ctypes.c_void_p,
            ctypes.c_int,
            ctypes.c_int16,
        ]
        self.sdl.SDL_JoystickSetVirtualButton.argtypes = [
            ctypes.c_void_p,
            ctypes.c_int,
            ctypes.c_uint8,
        ]
        self.index = self.sdl.SDL_JoystickAttachVirtual(4, axes, buttons, 0)
        self.handle = self.sdl.SDL_JoystickOpen(self.index)

    def axis(self, axis: int, value: float) -> None:
        assert self.sdl.SDL_JoystickSetVirtualAxis(self.handle, axis, round(32767 * value)) == 0

    def button(self, button: int, held: bool) -> None:
        assert self.sdl.SDL_JoystickSetVirtualButton(self.handle, button, held) == 0

    def unplug(self) -> None:
        assert self.sdl.SDL_JoystickDetachVirtual(self.index) == 0


def test_joystick_through_a_virtual_device() -> None:
    with pytest.raises(ValueError, match="joystick: expected one, got none"):
        wishes.Joystick(BROKK_170)
    device = Virtual()
    stick = wishes.Joystick(BROKK_170)
    assert stick(False, False) == OperatorInput((0.0, 0.0, 0.0))
    device.button(5, True)
    device.axis(1, -1.0)
    device.axis(0, 0.1)  # within the dead zone
    wish = stick(True, True)
    assert wish.enable and wish.v_goal == pytest.approx((0.3, 0.0, 0.0), abs=1e-4)
    device.axis(1, -0.56)
    assert stick(True, True).v_goal == pytest.approx((0.275 * 0.3, 0.0, 0.0), abs=1e-4)
    device.axis(1, -1.0)
    device.axis(0, 1.0)
    device.axis(4, -0.56)
    x, y, z = stick(True, True).v_goal
    assert np.linalg.norm((x, y, z)) == pytest.approx(0.3)  # no faster in a corner
    assert x == pytest.approx(-y, rel=1e-3) and z / x == pytest.approx(0.275, abs=1e-3)
    device.button(5, False)
    assert not stick(True, True).enable
    device.button(5, True)
    device.unplug()
    assert stick(True, True) == OperatorInput(alive=False)
    assert stick(True, True) == OperatorInput(alive=False)
    again = Virtual()
    again.button(5, True)
    assert stick(False, True) == OperatorInput((0.0, 0.0, 0.0), enable=True)
    other = Virtual()
    again.axis(1, -1.0)
    assert stick(True, True).v_goal[0] > 0.299  # one more device changes nothing
    with pytest.raises(
        ValueError, match=r"joystick: expected axes \[1, 0, 6\] and button 5, got 6 and 8"
    ):
        wishes.Joystick(BROKK_170, axes=(1, 0, 6))
    with pytest.raises(ValueError, match="button 8"):
        wishes.Joystick(BROKK_170, button=8)
    other.unplug()
    assert stick(True, True).alive
    again.unplug()
    assert stick(True, True) == OperatorInput(alive=False)


def test_a_joystick_needs_pygame_but_no_window(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pygame")
    wanted = {"PYGAME_HIDE_SUPPORT_PROMPT": "1", "SDL_VIDEODRIVER": "dummy"}
    wanted["SDL_JOYSTICK_ALLOW_BACKGROUND_EVENTS"] = "1"
    for name in wanted:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("pygame.joystick.get_count", lambda: 0)
    with pytest.raises(ValueError, match=r"^joystick: expected one, got none$"):
        wishes.Joystick(BROKK_170)
    assert {name: os.environ[name] for name in wanted} == wanted
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(ValueError, match=r"pygame: expected the extra brokk_min\[play\], got"):
        wishes.Joystick(BROKK_170)


def test_jog_moves_one_joint_the_way_the_stick_points() -> None:
    hand = Hand()
    world = World(wishes.JointJog(BROKK_170, "q4", 14), hand)
    world.drive.begin()
    world.run(1.5)
    assert world.commands[1][-1].tolist() == [0, 0, 0, 14, 0]
    assert world.simulated.plant.q[3] > START[3] + 0.003
    hand.v = (-0.2, 0.1, 0.1)
    world.run(0.2)
    assert world.commands[1][-1].tolist() == [0, 0, 0, -14, 0]
    hand.v = (0.02, 0.2, -0.2)
    world.run(0.2)
    assert not world.commands[1][-1].any()
    world.close()


def test_axes_are_shaped_evenly_to_both_sides() -> None:
    axis = np.linspace(-1, 1, 201)
    shaped = wishes.shape_axis(axis)
    np.testing.assert_allclose(shaped, -shaped[::-1], atol=1e-12)
    assert (np.diff(shaped) >= 0).all() and not shaped[np.abs(axis) < 0.12].any()
    assert (
        np.abs(shaped).max() == 1.0 and shaped[101:].max() == 1.0 and shaped[150] < 0.5 * axis[150]
    )


# --- signals and endings --------------------------------------------------------------------------------


def test_signals_end_the_run_with_a_neutral_frame() -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        hand = Hand()
        world = World(Push(*PUSH), hand)
        sent: Out = []
        world.downward = lambda can_id, data, sent=sent: (
            sent.append((can_id, data)),
            [(can_id, data)],
        )[1]
        world.drive.begin()
        shown, at = list[str](), list[int]()
        hand.act = lambda w=world, n=number: (
            os.kill(os.getpid(), n) if w.drive.ticks == 20 else None
        )
        before = signal.getsignal(number)
        world.drive.run(lambda text: (shown.append(text), at.append(world.drive.ticks)))  # noqa: B023
        assert world.drive.ticks in (20, 21) and signal.getsignal(number) is before
        assert at[:3] == [5, 10, 15] and len(shown) in (3, 4) and shown[-1].startswith("driving")
        last = [data for can_id, data in sent if can_id == 0x210][-2:]
        assert any(last[0][:5]) and not any(last[1][:5]) and last[1][7] == 0
        world.close()


def test_an_error_of_the_program_itself_ends_it_neutral() -> None:
    world = World(Push(*PUSH), Hand())
    world.drive.begin()
    world.run(1.0)
    told: Out = []
    world.downward = lambda can_id, data: (told.append((can_id, data)), [(can_id, data)])[1]
    with pytest.raises(BrokenPipeError):
        world.drive.run(raises(BrokenPipeError("nobody reads")))
    counter = int(world.drive.gate.counter)
    assert told[-1] == (
        0x210,
        valve_frame([0] * 5, counter, 0).tobytes(),
    )  # a whole frame, that says so
    assert fault_name(BROKK_170, int(world.drive.gate.latched_fault)) == "error"
    world.rest(0.01)
    assert not world.commands[1][-1].any()
    silent = World(Push(*PUSH), Hand())
    silent.drive.begin()
    silent.line.note = raises(OSError("disk full"))  # type: ignore[method-assign]
    seen: Out = []
    silent.downward = lambda can_id, data: (seen.append((can_id, data)), [(can_id, data)])[1]
    with pytest.raises(OSError, match="disk full"):
        silent.drive.run()
    assert not [f for f in seen if f[0] == 0x210]  # it was never armed
    world.close()
    silent.close()


def test_more_frames_than_a_bus_can_carry_are_a_fault() -> None:
    world = World(Push(*PUSH), Hand())
    world.drive.begin()
    world.run(1.0)
    for _ in range(2100):
        world.far.send(can.Message(arbitration_id=0x555, is_extended_id=False))
    world.run(0.2)
    assert "expected fewer than 2000 frames" in world.drive.reason and not world.drive.gate.driving
    world.close()


def test_wishes_are_rounded_not_cut() -> None:
    wish = unpack_operator_input(OperatorInput((0.00019, -0.00019, 0.00011)).pack())
    assert wish.v_goal == (0.0002, -0.0002, 0.0001)
