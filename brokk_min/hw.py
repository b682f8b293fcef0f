"""The hardware path: the 20 Hz loop that drives a machine on a CAN bus, who asks for motion, and its logs.

Each tick of `Drive`: SYNC, the encoders' positions, the observation, the controller, the safety gate, the
valve frame. `gate` decides what may reach the valves, `bus` carries frames, `simulator` is a machine to try.
Nothing here is a safety function: a real machine keeps its hard-wired emergency stop (docs/hardware.md).
"""

from __future__ import annotations

import gc
import os
import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brokk_min import bus
from brokk_min.actuator import push_command, rest_history
from brokk_min.env import Controller, measured, observe, push_measured
from brokk_min.extras import need
from brokk_min.gate import OPERATIONAL, GateInputs, encoder_counts, fault_name, gate, gate_start
from brokk_min.kinematics import tool_state
from brokk_min.logs import Log, Recording, velocity_of
from brokk_min.machine import PWM_MAX, Machine, decode_pwm

Array = NDArray[Any]
AWAKE = 0.002  # s before SYNC and after it in which the loop does not sleep (tuned)
REHEARSALS = 4  # of a tick before it (tuned)
WINDOW = 0.020  # s after SYNC in which the encoders must answer (assumed)
MAX_FRAMES = 2000  # read in a row; more than a bus can carry in a tick


# --- who asks for motion ----------------------------------------------------------------------------


class Wish(NamedTuple):
    """What the operator asks for at one tick."""

    v_goal: tuple[float, float, float] = (0.0, 0.0, 0.0)  # tool velocity [m/s], base frame
    enable: bool = False  # dead-man switch
    alive: bool = True  # is the device there?
    stop: bool = False  # end the program
    error: bool = False  # set by the loop, so that the log tells it

    def pack(self) -> bytes:
        """As seven bytes of the log: three times 0.1 mm/s, flags."""
        flags = self.enable | self.alive << 1 | self.stop << 2 | self.error << 3
        return struct.pack("<hhhB", *(round(1e4 * v) for v in self.v_goal), flags)


def unpack_wish(data: bytes) -> Wish:
    """What `Wish.pack` packed.

    Example:
        >>> unpack_wish(Wish((0.1, 0.0, -0.25), enable=True).pack())
        Wish(v_goal=(0.1, 0.0, -0.25), enable=True, alive=True, stop=False, error=False)
    """
    x, y, z, flags = struct.unpack("<hhhB", data)
    return Wish((x / 1e4, y / 1e4, z / 1e4), *(bool(flags & 1 << i) for i in range(4)))


class Script:
    """Velocity goals (T, 3) [m/s] one after another, as soon as the gate is ready; then the end.

    Raises:
        ValueError: a goal faster than the machine's `tool_speed`.
    """

    def __init__(self, machine: Machine, goals: Array, patience_s: float = 5.0) -> None:
        fastest = np.linalg.norm(goals, axis=-1).max()
        if not fastest <= machine.tool_speed * (1 + 1e-9):
            raise ValueError(f"command: expected at most {machine.tool_speed} m/s, got {fastest:.3g} m/s")
        self.goals, self.tick, self.pressed = goals, 0, False
        self.patience = round(patience_s * machine.rate)

    def __call__(self, driving: bool, ready: bool) -> Wish:
        """The wish of this tick; stops at the end, after a fault, or if the machine never gets ready."""
        if driving and self.tick < len(self.goals):
            x, y, z = map(float, self.goals[self.tick])
            self.tick += 1
            return Wish((x, y, z), enable=True)
        if driving or self.tick or not self.patience:
            return Wish(stop=True)
        self.pressed, self.patience = ready and not self.pressed, self.patience - 1
        return Wish(enable=self.pressed)

    @property
    def done(self) -> bool:
        """Were all goals given?"""
        return self.tick == len(self.goals)


class Joystick:
    """A joystick through pygame: a button held is the dead-man switch, three axes are the tool velocity.

    Args:
        machine: whose `tool_speed` full deflection asks for.
        axes: of the stick, for x, y and z; each counts negative forward, left and up.
        button: dead-man switch.
    """

    def __init__(self, machine: Machine, axes: Sequence[int] = (1, 0, 4), button: int = 5) -> None:
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # events need a window, or this
        os.environ.setdefault("SDL_JOYSTICK_ALLOW_BACKGROUND_EVENTS", "1")
        pygame = need("pygame", "play")
        pygame.display.init()
        pygame.joystick.init()
        if not pygame.joystick.get_count():
            raise ValueError("joystick: expected one, got none")
        self.pygame, self.speed, self.axes, self.button = pygame, machine.tool_speed, axes, button
        self.stick: Any = pygame.joystick.Joystick(0)
        found = self.stick.get_numaxes(), self.stick.get_numbuttons()
        if max(axes) >= found[0] or button >= found[1]:
            raise ValueError(
                f"joystick: expected axes {list(axes)} and button {button}, got {found[0]} and {found[1]}"
            )

    def __call__(self, driving: bool, ready: bool) -> Wish:
        """The wish of this tick. A device that is gone reads zero on all axes, so its removal is told."""
        for event in self.pygame.event.get():
            if event.type == self.pygame.JOYDEVICEADDED and not self.stick:
                self.stick = self.pygame.joystick.Joystick(event.device_index)
            elif event.type == self.pygame.JOYDEVICEREMOVED and self.stick:
                self.stick = None if event.instance_id == self.stick.get_instance_id() else self.stick
        if not self.stick:
            return Wish(alive=False)
        v = -shape_axis([self.stick.get_axis(i) for i in self.axes]) * self.speed
        x, y, z = map(float, v / max(1.0, float(np.linalg.norm(v)) / self.speed))
        return Wish((x, y, z), enable=bool(self.stick.get_button(self.button)))


@dataclass(frozen=True)
class Jog:
    """A controller for bringing up: a small command on one joint, its sign that of the wanted x velocity."""

    machine: Machine
    joint: str
    counts: int  # of 127

    def start(self, num: int) -> None:
        """Nothing to remember."""

    def __call__(self, observation: Array, memory: None) -> tuple[Array, None]:
        """Commands u (..., n) for observations (..., obs)."""
        v_goal = measured(self.machine, observation).v_goal[..., :1]
        asked = np.sign(v_goal) * (np.abs(v_goal) > 0.1 * self.machine.tool_speed)
        chosen = np.array([name == self.joint for name in self.machine.names])
        return asked * chosen * self.counts / PWM_MAX, None


def shape_axis(axis: ArrayLike) -> Array:
    """Deflection in [-1, 1] with a dead zone of 12 %, and flatter near the middle: (1 - expo) s + expo s^3.

    Example:
        >>> shape_axis([-1.0, 0.1, 0.56, 1.0])
        array([-1.   ,  0.   ,  0.275,  1.   ])
    """
    axis, dead, expo = np.asarray(axis, float), 0.12, 0.6  # assumed
    s = np.sign(axis) * np.maximum(0.0, np.abs(axis) - dead) / (1 - dead)
    return np.asarray((1 - expo) * s + expo * s**3)


# --- the loop ---------------------------------------------------------------------------------------


class Drive:
    """The 20 Hz loop: the operator's wish, through a controller and the gate, to the valves. Paper: Sec. 2

    Args:
        machine: its joints' encoders and its valve controller are on the bus.
        controller: a policy or a baseline.
        line: `Line`, or a `Tape` of one.
        operator: gives the wish of a tick; it is told whether the gate drives and is ready.
    """

    def __init__(
        self, machine: Machine, controller: Controller, line: Any, operator: Callable[[bool, bool], Wish]
    ) -> None:
        if machine.n > 5:
            raise ValueError(f"{machine.name}: expected at most 5 joints in a valve frame, got {machine.n}")
        self.machine, self.controller, self.line, self.operator = machine, controller, line, operator
        self.nodes, self.gate, self.wish = bus.Nodes(machine), gate_start(machine), Wish()
        self.memory = controller.start(1)
        self.history: Array | None = None
        self.lag: Array = np.zeros((1, 3), np.float32)  # of `push_lag`
        self.asked = self.lag  # tool velocity wanted in the last tick [m/s]
        self.problem = self.remark = self.reason = ""  # exception of this tick, the last one, what is wrong
        self.signals: list[int] = []
        self.ticks, self.skipped, self.lateness = 0, 0, 0.0
        self.begun, self.number = 0.0, 0  # the grid of deadlines, and where on it we are

    def begin(self) -> None:
        """Check and set up the encoders, start all nodes, and the clock.

        Raises:
            ValueError: an encoder that does not answer or has another resolution.
        """
        for joint in self.machine.joints:
            turn = bus.sdo(self.line, joint.encoder_node, bus.RESOLUTION_OBJECT)
            if turn != 2**self.machine.encoder_bits:
                raise ValueError(
                    f"{joint.name}: expected {2**self.machine.encoder_bits} counts a turn of encoder node "
                    f"{joint.encoder_node} (object 0x6501), got {turn}"
                )
            bus.sdo(self.line, joint.encoder_node, bus.BEAT_OBJECT, round(1e3 * bus.BEAT), size=2)
            bus.sdo(self.line, joint.encoder_node, bus.SYNC_OBJECT, 1, size=1)  # at every SYNC
        self.line.send(bus.NMT, bytes([1, 0]))
        self.begun = self.line.now()

    @property
    def deadline(self) -> float:
        """When the next tick is due [s]; not a sum of periods, which would drift by rounding."""
        return self.begun + self.number * self.machine.dt

    def tick(self) -> bool:
        """Wait for the deadline, then one tick; False if it was the last."""
        self._wait()
        line, wanted = self.line, np.zeros(self.machine.n)
        with self._caught():
            wish = self.operator(bool(self.gate.driving), bool(self.gate.wrong == 0))
            self.wish = unpack_wish(wish.pack())  # as the log has it, so that a replay gets the same
        self.nodes.frames *= 2  # a position from before its SYNC is as wrong as a doubled one
        with self._caught():
            line.send(bus.SYNC, b"")
            self._listen(line.now() + WINDOW, AWAKE, until_complete=True)
        counts = encoder_counts(self.machine, self.nodes.raw)
        with self._caught():
            wanted = self._control(counts)
        self.wish = self.wish._replace(
            stop=self.wish.stop or bool(self.signals), error=self.wish.error or bool(self.problem)
        )
        frame = self._gate(wanted, counts, line.note(self.wish.pack()))
        problem, self.problem = self.problem, ""
        self._speak(frame)
        self._remember(problem)
        with self._caught():
            if not (self.wish.enable or self.gate.driving) and (self.nodes.nmt != OPERATIONAL).any():
                line.send(bus.NMT, bytes([1, 0]))  # nodes fell back; not while the operator holds the switch
            line.flush()
        return not self.wish.stop

    def run(self, show: Callable[[str], object] = lambda text: None) -> None:
        """Tick until the operator, SIGINT or SIGTERM stops it; the last frame is neutral whatever happens."""
        gc.freeze()  # what is there now stays: no long collection in the middle of a tick
        try:
            with bus.stop_signals() as self.signals:
                while self.tick():
                    if self.ticks % 5 == 0:
                        show(self.status())
        except BaseException:
            self.problem = "the loop ended"
            counts = encoder_counts(self.machine, self.nodes.raw)
            self._speak(self._gate(np.zeros(self.machine.n), counts, self.line.now()))
            raise

    def status(self) -> str:
        """One line: state, faults, tool velocity wanted and measured [m/s], angles [rad], lateness."""
        state = "driving" if self.gate.driving else "waiting" if self.gate.wrong else "ready"
        q, v = np.full(self.machine.n, np.nan), np.full(3, np.nan)
        if self.history is not None:
            q, q_dot = self.history[0, :, 0, -1], self.history[0, :, 1, -1]
            v = tool_state(self.machine, q, q_dot)[1]
        want, have, pose = (" ".join(f"{x:+.2f}" for x in a) for a in (self.wish.v_goal, v, q))
        late = f"late {1e3 * self.lateness:.1f} ms, skipped {self.skipped}"
        reason = f" {self.reason}" if self.reason else ""
        return f"{state:7}{reason} v wanted {want} is {have} q {pose} {late}"

    @contextmanager
    def _caught(self) -> Iterator[None]:
        """Whatever is raised inside becomes the gate's business."""
        try:
            yield
        except Exception as error:
            self.problem = f"{type(error).__name__}: {error}"

    def _listen(self, end: float, awake: float = 0.0, until_complete: bool = False) -> None:
        """Read until `end` and until the bus is empty, or until every encoder was heard."""
        for _ in range(MAX_FRAMES):
            if until_complete and (self.nodes.frames > 0).all():
                return
            frame = self.line.recv(max(0.0, end - self.line.now()), awake)
            if frame is None:
                return
            self.nodes.hear(frame)
        raise OverflowError(f"bus: expected fewer than {MAX_FRAMES} frames in a row, got more")

    def _wait(self) -> None:
        """Listen and rehearse until the deadline."""
        line = self.line
        end = min(self.deadline, line.now() + self.machine.dt)  # the clock may have gone backwards
        with self._caught():
            self._listen(end - AWAKE)
            line.rest(max(0.0, end - AWAKE - line.now()))
            self._rehearse(end)
            self._listen(end, AWAKE)
        line.rest(max(0.0, end - line.now()))  # a broken bus does not wait
        self._next_deadline()

    def _next_deadline(self) -> None:
        """The next deadline in the future on the same grid; a new grid if the clock went backwards."""
        now = self.line.now()
        self.lateness = now - self.deadline
        if self.lateness < -0.5 * self.machine.dt:
            self.begun, self.number = now, 0
        missed = max(0, int(self.lateness // self.machine.dt))
        if missed:
            self.history = None  # its samples are a tick apart
        self.skipped += missed
        self.number += 1 + missed
        self.ticks += 1

    def _control(self, counts: Array) -> Array:
        """What the controller wants [counts of 127] (n,) at angles `counts` [encoder counts]."""
        m = self.machine
        if (self.nodes.frames != 1).any():
            self.history = None  # a gap: what came before it no longer joins what comes after
            return np.zeros(m.n)
        q = counts[None].astype(np.float32) * m.encoder_step  # as `read_encoder` gives in the simulation
        if self.history is None:
            self.history, arm = rest_history(q, m.history), None
        else:
            self.history, self.lag, arm = push_measured(m, self.history, q, self.asked, self.lag)
        if not self.gate.driving:
            self.memory, self.lag = self.controller.start(1), np.zeros((1, 3), np.float32)
        self.asked = np.array([self.wish.v_goal], np.float32)
        seen = observe(m, self.history, self.asked, self.lag, arm=arm)
        u, self.memory = self.controller(seen, self.memory)
        return np.asarray(np.rint(u[0] * PWM_MAX), float)

    def _rehearse(self, end: float) -> None:
        """Let twins compute the next tick for nothing while there is time; after sleep the first is slow."""
        nodes = copy(self.nodes)
        nodes.frames = np.ones_like(nodes.frames)
        for _ in range(REHEARSALS):
            if self.history is None or self.line.now() >= end:
                break
            twin = copy(self)
            twin.nodes, counts = nodes, encoder_counts(self.machine, nodes.raw)
            twin._gate(twin._control(counts), counts, self.line.now())

    def _gate(self, wanted: Array, counts: Array, now: float) -> bytes:
        """Pass the gate with what this tick knows; the valve frame."""
        nodes, wish = self.nodes, self.wish
        error = wish.error or bool(self.problem)
        flags = np.array([wish.enable, not any(wish.v_goal), wish.alive, wish.stop, error])
        inputs = GateInputs(wanted, counts, nodes.frames, nodes.beat, nodes.nmt, *flags)
        self.gate, frame = gate(self.machine, self.gate, inputs, now)
        return frame.tobytes()

    def _remember(self, problem: str) -> None:
        """What was sent and what is wrong; forget what this tick heard."""
        if self.history is not None:
            self.history = push_command(self.history, self.gate.sent[..., -1] / PWM_MAX)
        stopped, wrong = (fault_name(self.machine, int(f)) for f in (self.gate.fault, self.gate.wrong))
        self.reason = f"fault: {stopped}" if stopped else wrong
        self.remark = "" if self.gate.driving else problem or self.remark
        self.reason += f" ({self.remark})" if self.remark else ""
        self.nodes.frames[:] = 0

    def _speak(self, frame: bytes) -> None:
        """Send the valve frame, once the gate was armed."""
        with self._caught():
            if self.gate.spoken:
                self.line.send(self.machine.valve_frame_id, frame)


# --- logs of a drive --------------------------------------------------------------------------------


class Tape:
    """A recorded log in place of a `Line`: gives back what was read and compares what is sent."""

    def __init__(self, frames: Sequence[bus.Frame]) -> None:
        self.frames, self.at, self.sent, self.wrong = frames, 0, list[bus.Frame](), ""

    @property
    def more(self) -> bool:
        """Is there anything left?"""
        return self.at < len(self.frames)

    def now(self) -> float:
        """When the next thing happened [s]."""
        return self.frames[min(self.at, len(self.frames) - 1)].time

    def rest(self, seconds: float) -> None:
        """A tape does not wait."""

    def flush(self) -> None:
        """Nor does it write."""

    def recv(self, timeout: float, awake: float = 0.0) -> bus.Frame | None:
        """The next frame that was read before anything was sent."""
        if not self.more or self.frames[self.at].sent:
            return None
        self.at += 1
        return self.frames[self.at - 1]

    def send(self, can_id: int, data: bytes) -> None:
        """Keep what is sent, and step over what was sent then."""
        self.sent.append(bus.Frame(self.now(), can_id, data, True))
        self._step(can_id)

    def note(self, data: bytes) -> float:
        """The time of the wish."""
        now = self.now()
        self._step(bus.WISH)
        return now

    def wish(self, driving: bool, ready: bool) -> Wish:
        """What the operator wished then."""
        ahead = (self.frames[i] for i in range(self.at, len(self.frames)))
        return next((unpack_wish(frame.data) for frame in ahead if frame.id == bus.WISH), Wish(stop=True))

    def _step(self, can_id: int) -> None:
        if self.more and (not (at := self.frames[self.at]).sent or at.id != can_id):
            self.wrong = f"log: expected {can_id:03X} sent at {at.time:.6f}, got {at.id:03X}"
            self.at = len(self.frames)
        self.at += 1


def replay(machine: Machine, controller: Controller, frames: Sequence[bus.Frame]) -> list[bus.Frame]:
    """Run the loop on a recorded log of it; what it sends now, to be compared with what it sent then.

    Raises:
        ValueError: another program made the log.
    """
    tape = Tape(list(frames))
    drive = Drive(machine, controller, tape, tape.wish)
    drive.begin()
    while tape.more:
        drive.tick()
    if tape.wrong:
        raise ValueError(tape.wrong)
    return tape.sent[: sum(f.sent and f.channel != bus.OPERATOR for f in frames)]


def compare(machine: Machine, frames: Sequence[bus.Frame], sent: Sequence[bus.Frame]) -> tuple[int, int]:
    """How many valve frames of `sent` are those of the log, byte by byte, and how many the log has."""
    old, new = (
        [f.data for f in side if f.sent and f.id == machine.valve_frame_id] for side in (frames, sent)
    )
    return sum(a == b for a, b in zip(old, new)), max(len(old), len(new))


def driven_log(machine: Machine, frames: Iterable[bus.Frame]) -> Log:
    """What encoders said and valves got while driving, as recordings for `fit`; a gap starts a new one.

    Raises:
        ValueError: nothing was driven for long enough.
    """
    nodes, parts, start, last = bus.Nodes(machine), list[list[Any]](), 0.0, -np.inf
    for frame in frames:
        if frame.id == bus.SYNC:
            nodes.frames[:], start = 0, frame.time
        elif frame.id == machine.valve_frame_id and len(frame.data) == 8:
            if frame.data[7] == 1 and (nodes.frames == 1).all():
                if not 0.5 < (start - last) * machine.rate < 1.5:
                    parts.append([])
                u = decode_pwm(list(frame.data[: machine.n]))
                parts[-1].append((u, encoder_counts(machine, nodes.raw) * machine.encoder_step))
                last = start
        else:
            nodes.hear(frame)
    recordings = []
    for number, part in enumerate(parts):
        if len(part) > machine.history + 1:
            u, q = map(np.array, zip(*part, strict=True))
            recordings.append(
                Recording(f"drive_{number:03d}", u, q, velocity_of(q, machine.velocity_samples, machine.rate))
            )
    if not recordings:
        raise ValueError(f"log: expected more than {machine.history + 1} ticks of driving in a row, got none")
    return Log(machine.names, tuple(recordings), rate=machine.rate)
