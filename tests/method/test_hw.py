"""The 20 Hz loop against the plant, on a virtual bus with an injected clock."""

import os
import signal
import subprocess
import sys
from itertools import pairwise

import can
import numpy as np
import pytest
from helpers_bus import (
    BASELINE,
    START,
    ConstantCommand,
    HoldingOperator,
    Out,
    World,
    once,
    only,
    raises,
    recording,
    unchanged,
)
from helpers_faults import COMMAND, FAULTS, NOT_FOUND, delay, flood, freeze, measure

from brokk_min.can.canopen import valve_frame
from brokk_min.can.drive_log import status
from brokk_min.can.operator_input import Script
from brokk_min.can.safety_gate import fault_name
from brokk_min.env import TaskConfig, reward
from brokk_min.evaluation.rollout import rollout
from brokk_min.evaluation.sequences import axis_sequences
from brokk_min.identification.files import SHIPPED
from brokk_min.kinematics import forward_kinematics, tool_velocity
from brokk_min.learning.policy import PolicyController, load_policy
from brokk_min.machine import BROKK_170


@pytest.fixture
def world():
    """A constant command, an operator, and nodes that are started."""
    world = World(ConstantCommand(*COMMAND), HoldingOperator())
    world.drive.begin()
    return world


@pytest.mark.parametrize(
    ("modules", "heavy"),
    [
        (
            "brokk_min.hw, brokk_min.can.simulated_machine",
            "can pygame torch onnx matplotlib gymnasium scipy",
        ),
        ("brokk_min.learning.policy, brokk_min.learning.gym_env", "torch pygame matplotlib"),
    ],
)
def test_import__loads_no_library_that_is_not_needed(modules, heavy):
    code = f"import sys, {modules}; print({set(heavy.split())} & {{*sys.modules}})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


# --- driving -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("axis", "name"), [(1, "policy"), (2, "jacobian"), (0, "policy_paper")])
def test_run__earns_over_the_bus_the_reward_of_evaluate(axis, name):
    """Within 0.2 %, with 2 ms of bus and machine between SYNC and valve frame."""
    sequence = axis_sequences(BROKK_170)[axis]
    controller = BASELINE
    if name != "jacobian":
        policy = load_policy(SHIPPED / BROKK_170.name / f"{name}.npz", BROKK_170)
        controller = PolicyController(BROKK_170, policy)
    script = Script(BROKK_170, sequence.goals)
    world = World(controller, script)

    def operator(driving, ready):
        world.sleep(0.002)
        return script(driving, ready)

    world.drive.operator = operator
    world.drive.begin()
    world.drive.run()
    assert script.done
    begins = np.array(world.syncs[-len(sequence.goals) - 1 :])
    times, _ = world.commands
    q = np.array([row[2] for row in world.record])[np.searchsorted(times, begins + 1e-9) - 1]
    v = tool_velocity(forward_kinematics(BROKK_170, q[1:]), np.diff(q, axis=0) * 20)
    noiseless, rng = TaskConfig(noise=0.0), np.random.default_rng(0)
    trace = rollout(BROKK_170, controller, [START], sequence.goals[:, None], noiseless, rng)
    assert reward(sequence.goals, v).mean() == pytest.approx(trace.reward.mean(), abs=0.002)
    turned = np.diff(sequence.goals, axis=0, prepend=0).any(axis=1)
    half_second = np.convolve(turned, np.ones(10))[: len(turned)] > 0
    assert trace.reward[half_second].mean() < 0.99  # there was something to lose


class Listener(ConstantCommand):
    """Drives with constant commands and keeps what is measured at each tick after the warm-up."""

    def __init__(self):
        super().__init__(*COMMAND)
        self.measured = []

    def start(self, num):
        self.measured.clear()

    def __call__(self, measured, state):
        self.measured.append(measured)
        return super().__call__(measured, state)


def test_control__measures_histories_and_error_integral_of_its_own_ticks():
    """Every second call is the warm-up with the tick before."""
    listener = Listener()
    world = World(listener, HoldingOperator())
    world.drive.begin()
    world.run(3.0)
    ticks = listener.measured[2::2]
    integral = ticks[0].error_integral[0]
    for before, now in pairwise(ticks):
        np.testing.assert_array_equal(now.history[..., :2, :-1], before.history[..., :2, 1:])
        error = before.v_goal[0] - now.v_tool[0]
        error = error * min(1.0, 0.021 / max(np.linalg.norm(error), 1e-9))
        integral = (integral + error / 20) * np.exp(-1 / 40)
        np.testing.assert_allclose(now.error_integral[0], integral, atol=2e-4)
    assert np.linalg.norm(integral) > 0.01
    assert (np.rint(ticks[-1].history[0, :, 2] * 127) == 60).all()


def test_tick__is_silent_until_armed_and_opens_valves_a_tick_later(world):
    world.operator.enable, out = False, Out()
    world.downward = recording(out)
    world.run(1.0)
    assert world.drive.gate.active_fault == 0
    assert not [frame for frame in out if frame[0] == 0x210]
    world.operator.enable, world.operator.v = True, (0.0, 0.0, 0.0)
    world.drive.tick()
    world.drive.tick()
    frames = [data for can_id, data in out if can_id == 0x210]
    assert [list(f[:5]) for f in frames] == [[0] * 5, [40, 0, 40, 40, 40]]
    assert [f[7] for f in frames] == [1, 1] and frames[1][5] == frames[0][5] + 1
    world.drive.tick()
    assert world.drive.history is not None  # commands come with the angles that follow them
    newest = world.drive.history[0, :, 2, -2:].T * 127
    np.testing.assert_allclose(newest, [[0] * 5, [40, 0, 40, 40, 40]], atol=1e-5)


def test_tick__does_not_arm_while_the_stick_is_not_centred(world):
    operator = world.operator
    world.drive.operator = lambda driving, ready: operator(True, ready)
    world.run(1.0)
    assert not world.drive.gate.driving and not world.commands[1].any()


# --- faults --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", FAULTS)
def test_tick__ends_neutral_and_latched_within_175_ms_of_every_fault(name):
    """By the plant's own record, whenever in a tick it comes, though the operator holds on.

    `python -m benchmarks.faults` measures each fault 20 times.
    """
    phase = (0.0005, 0.0215, 0.0485)[list(FAULTS).index(name) % 3]
    cause, words = FAULTS[name]
    outcome = measure(cause, phase)
    assert outcome.latched, f"valves open {outcome.seconds:.3f} s later"
    assert outcome.seconds < 0.175
    assert words in outcome.words


@pytest.mark.parametrize("name", NOT_FOUND)
def test_tick__cannot_find_what_the_documents_say_it_cannot(name):
    """Should one be found some day, the documents change."""
    assert not measure(NOT_FOUND[name][0], 0.0215).latched


def test_tick__lets_no_command_of_a_second_sender_through_for_more_than_its_own_delay():
    """The valve controller refuses a second frame after a SYNC."""
    for name in ("second sender after each of our valve frames", "second sender after each SYNC"):
        _, m = measure(FAULTS[name][0], 0.0215).commands
        assert (m[:, 0] == 77).sum() <= ("SYNC" in name), name


def closes_within(world, begun, seconds):
    times, m = world.commands
    return not m[times > begun + seconds].any()


@pytest.mark.parametrize(
    ("node", "counts", "bound"),
    [(1, 80, 0.175), (3, 40, 0.175), (4, -40, 0.175), (5, 20, 0.45), (1, 16, 0.85), (3, 16, 0.85)],
)
def test_tick__finds_a_frozen_encoder_at_small_commands_too(node, counts, bound, world):
    """The table of docs/hardware.md: the smaller the command, the longer it takes."""
    world.controller.m = counts * (np.arange(1, 6) == node)
    world.run(1.6)
    world.sleep(0.0215)
    begun = world.time
    assert world.commands[1][-1].any()
    freeze(world, node)
    world.run(1.2)
    assert closes_within(world, begun, bound)
    assert world.drive.reason == f"fault: q{node}: frozen, or the joint does not move"


def test_tick__takes_nothing_for_frozen_that_is_not(world):
    """Reversals, stops and small commands at random are no fault."""
    rng = np.random.default_rng(3)
    controller = world.controller

    def change():
        if rng.random() < 0.15:
            controller.m = rng.choice([-80.0, -40, -20, 0, 0, 20, 40, 80], 5) * (np.arange(5) != 1)

    controller.act = change
    world.run(30.0)
    assert world.drive.reason == "" and world.drive.gate.driving
    assert np.abs(np.diff(world.commands[1], axis=0)).sum() > 1000


def test_watchdog__closes_the_valves_of_a_program_that_is_killed(world):
    """SIGKILL: no more ticks; a resumed frame does not open the valves again."""
    world.run(1.2)
    killed = world.time
    assert world.commands[1][-1].any()
    world.sleep(1.0)
    counter = int(world.drive.gate.counter) + 1
    data = valve_frame(COMMAND, counter, 1).tobytes()
    world.send(can.Message(arbitration_id=0x210, data=data))
    world.sleep(0.1)
    assert closes_within(world, killed, 0.155)


def test_tick__opens_no_valve_again_on_frames_of_any_identifier_and_length(world):
    world.run(1.2)
    begun = world.time
    assert world.commands[1][-1].any()
    seen, pairs = flood(world)
    world.run(9.3)
    assert len(seen) == pairs == 2048 * 9
    assert closes_within(world, begun, 0.175)


def test_tick__leaves_a_fault_by_a_new_edge_only(world):
    drive = world.drive
    world.run(0.6)
    world.upward = only(0x183, once(lambda d: []))
    world.run(0.5)
    assert drive.reason == "fault: q3: silent" and not drive.gate.driving
    assert status(drive).startswith("ready   fault: q3: silent v goal ")
    world.operator.enable = False
    world.run(0.2)
    assert drive.reason == "fault: q3: silent"
    world.operator.enable = True
    world.run(0.4)
    assert drive.gate.driving and drive.reason == ""
    assert status(drive).startswith("driving v goal +0.10 +0.00 +0.00 measured ")
    assert world.commands[1][-1].tolist() == list(COMMAND)


@pytest.mark.parametrize(
    ("low", "high", "found"),
    [(5, 5, 0), (15, 15, 0), (25, 25, 1), (45, 45, 1), (0, 15, 0), (0, 60, 1)],
)
def test_tick__finds_positions_later_than_20_ms(low, high, found, world):
    """Constantly, or by chance between two bounds [ms]."""
    rng = np.random.default_rng(0)
    world.run(0.8)
    begun = world.time
    delay(world, 3, lambda: rng.uniform(low, high) / 1e3)
    world.run(1.0)
    assert world.drive.reason == found * "fault: q3: silent"
    assert closes_within(world, begun, 0.175) == bool(found)


def test_tick__finds_a_delay_of_a_whole_tick_only_when_it_begins(world):
    """A position has neither time nor number: the limit of what can be found, see docs."""
    held = []

    def hold(data):
        held.append(data)
        return held[-2:-1]

    world.run(0.8)
    begun = world.time
    world.upward = only(0x183, hold)
    world.run(0.3)
    assert world.drive.reason == "fault: q3: silent" and closes_within(world, begun, 0.175)
    world.operator.enable = False
    world.run(0.1)
    world.operator.enable = None
    world.run(0.2)
    assert world.drive.gate.driving


def test_tick__starts_nodes_that_fell_back_once_the_switch_is_released(world):
    out = Out()
    world.run(0.6)
    world.downward = recording(out)
    world.simulated.nmt[4] = 127
    world.run(0.4)
    assert world.drive.reason == "fault: q4: not operational" and world.drive.gate.active_fault
    assert 0x000 not in dict(out)
    world.operator.enable = False
    world.run(0.2)
    assert {data for can_id, data in out if can_id == 0x000} == {b"\x01\x00"}
    assert not world.drive.gate.active_fault
    out.clear()
    world.run(0.2)
    assert 0x000 not in dict(out) and status(world.drive).startswith("ready")


# --- the clock -----------------------------------------------------------------------------------


def busy(world, seconds):
    """Sending a valve frame takes some time."""

    def send(can_id, data):
        world.sleep(seconds * (can_id == 0x210))
        return [(can_id, data)]

    return send


def test_wait__keeps_an_absolute_grid_and_skips_missed_ticks(world):
    world.controller.m = np.zeros(5)
    world.step = 0.0007  # does not divide a tick
    begun = world.time
    for k in range(120):
        world.downward = busy(world, {40: 0.13, 80: 0.052, 90: 0.26}.get(k, 0.004))
        world.drive.tick()
    ticks = (np.array(world.syncs) - begun) / 0.05
    late = np.flatnonzero(ticks - np.floor(ticks + 0.03) > 0.03)
    assert late.tolist() == [41, 81, 91]  # one tick at once after each stall, then the grid again
    assert np.diff(ticks).min() > 0.3
    assert np.diff(ticks)[[40, 90]] == pytest.approx([2.6, 5.2], abs=0.25)
    assert world.drive.skipped == 5 and round(ticks[-1]) == 119 + 5  # none was made up for


# --- endings -------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_run__ends_on_a_signal_with_a_neutral_frame(number, world):
    out, shown = Out(), list[tuple[int, str]]()
    world.downward = recording(out)
    world.operator.act = lambda: os.kill(os.getpid(), number) if world.drive.ticks == 20 else None
    handler = signal.getsignal(number)
    world.drive.run(lambda drive: shown.append((drive.ticks, status(drive))))
    assert world.drive.ticks in (20, 21) and signal.getsignal(number) is handler
    assert [tick for tick, _ in shown[:3]] == [5, 10, 15] and shown[2][1].startswith("driving")
    before, last = [data for can_id, data in out if can_id == 0x210][-2:]
    assert any(before[:5]) and not any(last[:5]) and last[7] == 0


def test_run__ends_neutral_on_an_error_of_the_program_itself(world):
    world.run(1.0)
    out = Out()
    world.downward = recording(out)
    with pytest.raises(BrokenPipeError):
        world.drive.run(raises(BrokenPipeError("nobody reads")))
    neutral = valve_frame([0] * 5, int(world.drive.gate.counter), 0).tobytes()
    assert out[-1] == (0x210, neutral)
    assert fault_name(BROKK_170, int(world.drive.gate.latched_fault)) == "error"
    world.downward = unchanged
    world.sleep(0.01)
    assert not world.commands[1][-1].any()


def test_run__stays_silent_on_an_error_before_it_was_armed(world):
    out = Out()
    world.downward = recording(out)
    world.bus.log_input = raises(OSError("disk full"))
    with pytest.raises(OSError, match="disk full"):
        world.drive.run()
    assert 0x210 not in dict(out)
