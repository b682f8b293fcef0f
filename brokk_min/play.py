"""Drive a machine by hand, trace lines with its tool, watch recorded runs.

The 20 Hz loop (`hw.Drive`, with its gate) runs in a process of its own, so that it never waits for drawing.
The window writes what the operator asks for and reads what the loop knows, through `Mailbox`es on which
neither side ever waits.
"""

from __future__ import annotations

import csv
import multiprocessing
import subprocess
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from threading import Thread
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from tqdm import tqdm

from brokk_min import hw, logs, view
from brokk_min.bus import SYNC, WISH, Frame, Nodes, open_line, read_frames
from brokk_min.env import Controller, Trace, to_command
from brokk_min.gate import encoder_counts, fault_name
from brokk_min.kinematics import tool_position, tool_state
from brokk_min.machine import PWM_MAX, Machine, decode_pwm, estimate_velocity
from brokk_min.simulator import SimulatedMachine, serve

Array = NDArray[Any]
START = (0.0, 0.5, 0.58, 1.71, 1.24)  # rad, the paper's start pose, pointing forward
SIZE = (1120, 680)  # of the window [px]
# all assumed
STALE = 0.2  # s without a word from the window, then the operator's device is lost
RISE = 0.25  # s from a key's press to full deflection
TITLES = {
    "rl": "RL policy",
    "jacobian": "Jacobian + PID",
    "levers": "levers, joint by joint",
    "jacobian_pid_k0.1": "Jacobian + PID",
    "jacobian_pid_ff": "Jacobian + PID with feed-forward",
}


# --- between window and loop ------------------------------------------------------------------------


class Mailbox:
    """The newest numbers of one process for another; neither ever waits."""

    def __init__(self, size: int) -> None:
        self.raw = multiprocessing.get_context("spawn").RawArray("d", size + 2)

    def write(self, values: Any) -> None:
        """Put `values` in place of what was there; the stamps around them say when they are whole."""
        box = np.frombuffer(self.raw)
        box[-1] = stamp = box[0] + 1
        box[1:-1] = values
        box[0] = stamp

    def read(self) -> Array | None:
        """The newest values; None: there are none, or they are being written."""
        box = np.frombuffer(self.raw)
        stamp, values = box[0], box[1:-1].copy()
        return values if stamp and stamp == box[-1] else None


class Ask(NamedTuple):
    """What the window asks of the loop."""

    time: float  # s, monotonic: when
    mode: int  # index of who translates
    enable: bool  # dead-man switch
    alive: bool
    stop: bool
    v_goal: Array  # m/s (3,)
    levers: Array  # of the driven joints, in [-1, 1]


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


def unpack_ask(values: Array) -> Ask:
    """An `Ask` from its fields in a row."""
    now, mode, enable, alive, stop = values[:5]
    return Ask(float(now), int(mode), bool(enable), bool(alive), bool(stop), values[5:8], values[8:])


# --- the loop ---------------------------------------------------------------------------------------


class Levers:
    """A controller that translates nothing: each lever is one driven joint's command."""

    def __init__(self, machine: Machine) -> None:
        self.machine, self.levers = machine, np.zeros(len(machine.driven))

    def start(self, num: int) -> None:
        """Nothing to remember."""

    def __call__(self, observation: Array, memory: None) -> tuple[Array, None]:
        """Commands u (num, n), whatever is observed."""
        return np.repeat(to_command(self.machine, self.levers)[None], len(observation), axis=0), None


class Chosen:
    """One of several controllers at a time; one that takes over starts from rest."""

    def __init__(self, controllers: Sequence[Controller]) -> None:
        self.controllers, self.mode = controllers, 0

    def start(self, num: int) -> tuple[int, Any]:
        """Whose memory it is, and the memory."""
        return self.mode, self.controllers[self.mode].start(num)

    def __call__(self, observation: Array, memory: tuple[int, Any]) -> tuple[Array, tuple[int, Any]]:
        """Commands and memory of the chosen one."""
        mode, inner = memory if memory[0] == self.mode else self.start(len(observation))
        u, inner = self.controllers[mode](observation, inner)
        return u, (mode, inner)


class Remote:
    """The operator of the loop: the window's newest word; a window that is silent is a lost device."""

    def __init__(
        self, asks: Mailbox, chosen: Chosen, levers: Levers, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.asks, self.chosen, self.levers, self.clock = asks, chosen, levers, clock
        self.ask: Ask | None = None

    def __call__(self, driving: bool, ready: bool) -> hw.Wish:
        """The wish of this tick."""
        if (values := self.asks.read()) is not None:
            self.ask = unpack_ask(values)
        ask = self.ask
        if ask is None or self.clock() - ask.time > STALE:
            parent = multiprocessing.parent_process()
            return hw.Wish(alive=False, stop=parent is not None and not parent.is_alive())
        self.chosen.mode, self.levers.levers = ask.mode, ask.levers
        x, y, z = map(float, ask.v_goal)
        return hw.Wish((x, y, z), ask.enable, ask.alive, ask.stop)


class Loop(hw.Drive):
    """The 20 Hz loop, which says after each tick what it knows."""

    tell: Callable[[Known], object] = staticmethod(lambda known: None)

    def tick(self) -> bool:
        """One tick."""
        more = super().tick()
        with self._caught():
            self.tell(self.known())
        return more

    def known(self) -> Known:
        """What is known after a tick."""
        q, q_dot = np.full((2, self.machine.n), np.nan)
        if self.history is not None:
            q, q_dot = self.history[0, :, 0, -1], self.history[0, :, 1, -1]
        u, mode = self.gate.sent[..., -1] / PWM_MAX, getattr(self.controller, "mode", 0)
        gate, v_goal = self.gate, np.array(self.wish.v_goal)
        state = bool(gate.driving), int(gate.wrong), int(gate.fault)
        return Known(self.ticks, q, q_dot, u, v_goal, *state, mode, self.lateness)


@dataclass(frozen=True)
class Where:
    """The bus; an empty interface is a simulated machine in the loop's own process."""

    interface: str = ""
    channel: str = ""
    log: Path | None = None
    start: tuple[float, ...] = START  # of the simulated machine [rad]


def control(
    machine: Machine, controllers: Sequence[Controller], where: Where, asks: Mailbox, tells: Mailbox
) -> None:
    """Drive until the window says stop; with a simulated machine of its own where there is no bus."""
    levers = Levers(machine)
    chosen = Chosen([*controllers, levers])
    interface, channel = where.interface or "virtual", where.channel or "brokk_min play"
    running = True
    with open_line(interface, channel, where.log) as line, _simulated(machine, where, lambda: running):
        try:
            loop = Loop(machine, chosen, line, Remote(asks, chosen, levers))
            loop.tell = lambda known: tells.write(known.pack())
            loop.begin()
            loop.run()
        finally:
            running = False


@contextmanager
def _simulated(machine: Machine, where: Where, running: Callable[[], bool]) -> Iterator[None]:
    """A simulated machine in a thread, if no bus is named."""
    if where.interface:
        yield
        return
    with open_line("virtual", "brokk_min play") as line:
        simulated = SimulatedMachine(machine, where.start[: machine.n], line.now())
        thread = Thread(target=serve, args=(simulated, line, running))
        thread.start()
        try:
            yield
        finally:
            thread.join()


def _control_process(errors: Any, *arguments: Any) -> None:
    """`control` in a process of its own; what goes wrong is said through the pipe `errors`."""
    try:
        control(*arguments)
    except Exception as error:
        errors.send(f"{error}" if isinstance(error, ValueError) else f"{type(error).__name__}: {error}")


@contextmanager
def control_process(
    machine: Machine, controllers: Sequence[Controller], where: Where
) -> Iterator[tuple[Mailbox, Mailbox, Callable[[], str | None]]]:
    """The loop in a process of its own: where to ask, where it tells, and why it ended (None: it runs).

    At the end of the block it is asked to stop, whatever happens.
    """
    context = multiprocessing.get_context("spawn")
    asks, tells = Mailbox(8 + len(machine.driven)), Mailbox(3 * machine.n + 9)
    here, there = context.Pipe(duplex=False)
    arguments = (there, machine, controllers, where, asks, tells)
    process = context.Process(target=_control_process, args=arguments, daemon=True)
    process.start()

    def ended() -> str | None:
        if process.is_alive():
            return None
        return str(here.recv()) if here.poll() else f"exit status {process.exitcode}"

    try:
        yield asks, tells, ended
    finally:
        asks.write([time.monotonic(), 0, 0, 1, 1, *[0] * (3 + len(machine.driven))])  # stop
        process.join(3)
        if process.is_alive():
            process.terminate()


class Ticks:
    """Frames of a bus or a log, one after another, as what is known at each tick; it only listens."""

    def __init__(self, machine: Machine) -> None:
        self.machine, self.nodes, self.wish = machine, Nodes(machine), hw.Wish()
        self.u, self.driving, self.tick = np.zeros(machine.n), False, 0
        self.angles: list[Array] = []  # rad, as many as the velocity needs

    def hear(self, frame: Frame) -> Known | None:
        """Take in one frame; at a SYNC, what is known of the tick that it ends."""
        if frame.id == SYNC:
            known, self.nodes.frames[:] = self._known(), 0
            self.tick += 1
            return known
        if frame.id == WISH and frame.channel == "operator":
            self.wish = hw.unpack_wish(frame.data)
        elif frame.id == self.machine.valve_frame_id and len(frame.data) == 8:
            self.u, self.driving = decode_pwm(list(frame.data[: self.machine.n])), frame.data[7] == 1
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


# --- the operator's hands ---------------------------------------------------------------------------

VELOCITY_KEYS = (("up", "down"), ("left", "right"), ("w", "s"))  # +x -x, +y -y, +z -z: as the top view shows
LEVER_KEYS = (("q", "a"), ("w", "s"), ("e", "d"), ("r", "f"), ("t", "g"), ("y", "h"))
PAD_AXES, PAD_BUTTON, PAD_MODE = (1, 0, 4, 3, 2, 5), 5, 3  # as `hw.Joystick` has them


class Hands:
    """Keyboard and gamepad as one operator.

    The dead-man switch (space, or the gamepad's button) counts only after it was seen released since the
    window had no focus, the translator was changed or the gamepad went, and if it is pressed while nothing
    is deflected.

    Args:
        machine: its driven joints have a lever each.
        pygame: the module, with a window.
        modes: names of who translates, the last one "levers".
    """

    def __init__(self, machine: Machine, pygame: Any, modes: Sequence[str]) -> None:
        self.machine, self.pygame, self.modes, self.mode = machine, pygame, modes, 0
        pairs = (VELOCITY_KEYS, LEVER_KEYS[: len(machine.driven)])
        self.codes = [[[pygame.key.key_code(k) for k in pair] for pair in table] for table in pairs]
        self.held = set[int]()
        self.focus, self.blocked, self.lost, self.closed, self.enable = True, True, False, False, False
        self.task_wanted = False
        self.deflection = np.zeros(3)
        self.pad: Any = None
        pygame.joystick.init()

    def hear(self, event: Any) -> None:
        """Take in one event."""
        pg = self.pygame
        if event.type == pg.QUIT or (event.type == pg.KEYDOWN and event.key == pg.K_ESCAPE):
            self.closed = True
        elif event.type == pg.KEYDOWN:
            self.lost = False  # the keyboard takes over
            self.held.add(event.key)
            if event.key == pg.K_TAB:
                self.switch()
            self.task_wanted |= event.key == pg.K_RETURN
        elif event.type == pg.KEYUP:
            self.held.discard(event.key)
        elif event.type == pg.WINDOWFOCUSLOST:
            self.focus, self.blocked = False, True
            self.held.clear()
        elif event.type == pg.WINDOWFOCUSGAINED:
            self.focus = True
        elif event.type == pg.JOYDEVICEADDED and self.pad is None:
            self.pad, self.lost = pg.joystick.Joystick(event.device_index), False
        elif (
            event.type == pg.JOYDEVICEREMOVED and self.pad and event.instance_id == self.pad.get_instance_id()
        ):
            self.pad, self.lost, self.blocked = None, True, True
        elif event.type == pg.JOYBUTTONDOWN and event.button == PAD_MODE:
            self.switch()

    def switch(self) -> None:
        """The next one translates; the dead-man switch must be pressed afresh."""
        self.mode, self.blocked = (self.mode + 1) % len(self.modes), True

    def ask(self, now: float, seconds: float) -> Ask:
        """What is asked for now, `seconds` after the last time."""
        levers = self.modes[self.mode] == "levers"
        wanted = self._wanted(levers)
        if len(self.deflection) != len(wanted):
            self.deflection = np.zeros(len(wanted))
        rising = np.clip(self.deflection + np.clip(wanted - self.deflection, -1, 1) * seconds / RISE, -1, 1)
        near = np.abs(wanted - self.deflection) <= seconds / RISE
        self.deflection = np.where(wanted * self.deflection < 0, 0.0, np.where(near, wanted, rising))
        self.deflection = np.where(wanted == 0, 0.0, self.deflection)  # let go: neutral at once
        pressed = self.focus and (self.pygame.K_SPACE in self.held or self._pad_button())
        if pressed and not self.enable and wanted.any():
            self.blocked = True
        elif not pressed and self.focus:
            self.blocked = False
        self.enable = pressed and not self.blocked
        v, u = np.zeros(3), np.zeros(len(self.machine.driven))
        if levers:
            u = self.deflection
        else:
            v = self.machine.tool_speed * self.deflection / max(1.0, float(np.linalg.norm(self.deflection)))
        return Ask(now, self.mode, self.enable, not self.lost, self.closed, v, u)

    def _wanted(self, levers: bool) -> Array:
        """Deflections of stick or levers in [-1, 1] that are held; a third of it with shift."""
        codes = self.codes[levers]
        keys = np.array([(plus in self.held) - (minus in self.held) for plus, minus in codes], float)
        if not self.focus:
            return 0 * keys
        if self.held & {self.pygame.K_LSHIFT, self.pygame.K_RSHIFT}:
            keys /= 3
        if self.pad is not None:
            axes = [i for i in PAD_AXES[: len(keys)] if i < self.pad.get_numaxes()]
            keys[: len(axes)] -= hw.shape_axis([self.pad.get_axis(i) for i in axes])
        return np.clip(keys, -1, 1)

    def _pad_button(self) -> bool:
        pad = self.pad
        return bool(pad is not None and pad.get_numbuttons() > PAD_BUTTON and pad.get_button(PAD_BUTTON))


# --- lines to trace ---------------------------------------------------------------------------------

CAPTURE = 0.1  # m, assumed: a point of the line counts as passed nearer than this
SPACING = 0.05  # m, assumed: between the points that must be passed


def task_lines(machine: Machine) -> dict[str, Array]:
    """Lines to trace [m] (K, 3) from where the tool is, in sizes that suit the machine.

    A level rectangle, an upright circle and straight lines along the axes; none goes down from its start.
    """
    size = view.extent(machine).reach
    turn = np.linspace(0, 2 * np.pi, 60)
    square = np.array([[0, 0, 0], [0, 0.16, 0], [0.1, 0.16, 0], [0.1, 0, 0], [0, 0, 0]])
    circle = 0.06 * np.stack([np.sin(turn), 0 * turn, 1 - np.cos(turn)], axis=1)
    lines = {"rectangle": square, "circle": circle}
    lines |= {f"line {axis}": 0.14 * np.eye(3)[[i, i]] * [[0], [1]] for i, axis in enumerate("xyz")}
    return {name: _spaced(size * line) for name, line in lines.items()}


def _spaced(line: Array) -> Array:
    """Points of a line no more than `SPACING` apart; its corners stay."""
    parts = []
    for a, b in pairwise(line):
        steps = int(np.ceil(np.linalg.norm(b - a) / SPACING))
        parts.append(a + np.linspace(0, 1, steps, endpoint=False)[:, None] * (b - a))
    return np.vstack([*parts, line[-1:]])


def distance(line: Array, p: Array) -> Array:
    """Distance [m] (T,) of points (T, 3) from a line through points (K, 3)."""
    a, along = line[:-1], np.diff(line, axis=0)
    away = p[:, None] - a
    share = np.clip((away * along).sum(-1) / np.maximum((along * along).sum(-1), 1e-12), 0, 1)
    return np.linalg.norm(away - share[..., None] * along, axis=-1).min(axis=1)


class Attempt(NamedTuple):
    """One traced line, a row of the attempts' CSV."""

    when: str  # time of day
    task: str
    mode: str
    seconds: float
    mean: float  # distance from the line [m]
    max: float
    valve_travel: float  # full strokes


@dataclass
class Tracing:
    """A line being traced: it begins with the first opened valve and ends when all its points were passed."""

    machine: Machine
    task: str
    line: Array  # m, base frame (K, 3)
    p: list[Array] = field(default_factory=list)
    u: list[Array] = field(default_factory=list)
    passed: int = 0

    def follow(self, known: Known) -> bool:
        """One tick; True if it was the last."""
        if not self.p and not known.u.any():
            return False
        p = tool_position(self.machine, known.q)
        self.p.append(p)
        self.u.append(known.u)
        while self.passed < len(self.line) and np.linalg.norm(self.line[self.passed] - p) < CAPTURE:
            self.passed += 1
        return self.passed == len(self.line)

    def score(self, mode: str) -> Attempt:
        """The figures of the finished attempt."""
        away, u = distance(self.line, np.array(self.p)), np.array(self.u)
        travel = float(np.abs(np.diff(u, axis=0, prepend=0 * u[:1])).sum())
        seconds, when = len(self.p) * self.machine.dt, time.strftime("%Y-%m-%dT%H:%M:%S")
        return Attempt(when, self.task, mode, seconds, float(away.mean()), float(away.max()), travel)


def read_attempts(path: Path) -> list[Attempt]:
    """Attempts so far; none if there is no file.

    Raises:
        ValueError: another kind of file.
    """
    if not path.exists():
        return []
    table = logs.read_table(path, Attempt._fields, text=("when", "task", "mode"))
    return [Attempt(*row) for row in zip(*(table[name].tolist() for name in Attempt._fields), strict=True)]


def write_attempts(path: Path, attempts: Sequence[Attempt]) -> None:
    """Write all attempts, the file whole."""
    with logs.whole_file(path, "w") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(Attempt._fields)
        writer.writerows([[f"{x:.6g}" if isinstance(x, float) else x for x in row] for row in attempts])


def attempts_table(attempts: Iterable[Attempt], task: str) -> list[str]:
    """Means of one task by who translated, a line each."""
    by_mode: dict[str, list[Attempt]] = {}
    for attempt in attempts:
        if attempt.task == task:
            by_mode.setdefault(attempt.mode, []).append(attempt)
    lines = []
    for mode, rows in by_mode.items():
        s, mean, largest, travel = np.array([row[3:] for row in rows], float).mean(axis=0)
        figures = f"{s:.1f} s, off by {mean:.3f} m, at most {largest:.3f} m, valves {travel:.0f}"
        lines.append(f"{mode} ({len(rows)}): {figures}")
    return lines


# --- the window -------------------------------------------------------------------------------------


class Session:
    """What the window shows: the newest ticks, the tool's trail, the line being traced, attempts."""

    def __init__(self, machine: Machine, modes: Sequence[str], path: Path | None) -> None:
        self.machine, self.modes, self.path = machine, modes, path
        self.attempts = read_attempts(path) if path else []
        self.lines, self.task = task_lines(machine), ""
        self.tracing: Tracing | None = None
        self.before: Known | None = None
        self.known: Known | None = None
        self.arrived, self.trail = 0.0, list[Array]()

    def take(self, known: Known, now: float) -> None:
        """A new tick."""
        self.before, self.known, self.arrived = self.known, known, now
        if not np.isfinite(known.q).all():
            return
        self.trail = [*self.trail, tool_position(self.machine, known.q)][-600:]
        if self.tracing and self.before and known.mode != self.before.mode:
            self.tracing = None  # another one translates: begin again
        if self.tracing and self.tracing.follow(known):
            self.attempts.append(self.tracing.score(self.modes[known.mode]))
            self.tracing = None
            if self.path:
                write_attempts(self.path, self.attempts)

    def next_task(self) -> None:
        """The next line, from where the tool is."""
        names = list(self.lines)
        if self.trail:
            self.task = names[(names.index(self.task) + 1) % len(names)] if self.task else names[0]
            self.tracing = Tracing(self.machine, self.task, self.trail[-1] + self.lines[self.task])
            self.trail = []

    def scene(self, now: float, mode: str, hint: str) -> view.Scene:
        """What is to be seen now; angles between the last two ticks, so that motion looks smooth."""
        known, nan = self.known, np.full(self.machine.n, np.nan)
        if known is None or now - self.arrived > 0.5:
            known = Known(0, nan, nan, 0 * nan, np.zeros(3), False, 0)
            status, mood = hint or "nothing to be heard", "waiting"
        else:
            status, mood = _status(self.machine, known, hint)
        q = known.q
        if self.before is not None:
            share = min(1.0, (now - self.arrived) / self.machine.dt)
            q = np.where(np.isfinite(self.before.q), self.before.q + share * (q - self.before.q), q)
        path = self.tracing.line if self.tracing else np.zeros((0, 3))
        trail, title = np.array(self.trail).reshape(-1, 3), TITLES.get(mode, mode)
        look = view.Scene(
            q, known.q_dot, np.nan_to_num(known.u), known.v_goal, trail, path, title, status, mood
        )
        colour = view.COLOURS.get(mode, view.STEEL)
        return look._replace(colour=colour, notes=self.notes(mode), zoom=True)

    def notes(self, mode: str) -> list[str]:
        """Keys, the task, and how it went."""
        if not mode:
            return ["only listening: nothing is sent", "ESC: end"]
        keys = " ".join("/".join(pair) for pair in LEVER_KEYS[: len(self.machine.driven)])
        stick = f"{keys}: joints" if mode == "levers" else "arrows: x, y    W/S: up, down"
        lines = [
            f"hold SPACE to drive    {stick}    SHIFT: slow",
            "TAB: who translates    ENTER: next line    ESC: end",
        ]
        if self.tracing:
            done = f"{self.tracing.passed} of {len(self.tracing.line)}"
            lines.append(
                f"{self.task}: follow the orange line, {len(self.tracing.p) * self.machine.dt:.1f} s, {done}"
            )
        return lines + attempts_table(self.attempts, self.task)


def _status(machine: Machine, known: Known, hint: str) -> tuple[str, str]:
    """State of the gate in words, and its mood."""
    if known.driving:
        return "driving", "driving"
    if known.wrong:
        return f"waiting: {fault_name(machine, known.wrong)}", "waiting"
    if known.fault:
        return f"stopped: {fault_name(machine, known.fault)}", "waiting"
    return hint or "ready", "ready"


Watcher = Callable[[Session, Hands], bool]


def show(
    session: Session,
    hear: Callable[[], Known | None],
    tell: Callable[[Ask], object],
    ended: Callable[[], str | None],
    watcher: Watcher = lambda session, hands: True,
    fps: float = 60.0,
) -> None:
    """The window until it is closed: events, what the loop knows, a picture, `fps` times a second.

    Args:
        session: what is shown; without modes it only watches.
        hear: the newest tick, if any.
        tell: takes what is asked for.
        ended: why the loop ended; None: it runs.
        watcher: is called at each picture; False closes the window.
    """
    window = view.Window(SIZE, f"brokk_min: {session.machine.name}")
    pygame, modes = window.pygame, session.modes or [""]
    hands, before = Hands(session.machine, pygame, modes), time.monotonic()
    ask = hands.ask(before, 0.0)
    try:
        while not hands.closed and watcher(session, hands):
            for event in pygame.event.get():
                hands.hear(event)
            now = time.monotonic()
            ask, before = hands.ask(now, now - before), now
            tell(ask)
            if (why := ended()) is not None:
                raise ValueError(f"play: expected a loop that runs, got {why}")
            known = hear()
            if known is not None and (session.known is None or known.tick != session.known.tick):
                session.take(known, now)
            if hands.task_wanted and session.modes:
                session.next_task()
            hands.task_wanted = False
            scene = session.scene(now, modes[hands.mode], _hint(session, hands))
            window.show(view.draw(session.machine, [scene], SIZE), fps)
    finally:
        tell(ask._replace(enable=False, stop=True))
        window.close()


def _hint(session: Session, hands: Hands) -> str:
    """What the operator has to do next."""
    if not session.modes:
        return "watching" if session.known else "nobody sends SYNC"
    if session.known is None:
        return "starting"
    if not hands.focus:
        return "neutral: the window has no focus"
    return (
        "release the switch, then press it with nothing deflected" if hands.blocked else "ready: hold SPACE"
    )


def play(machine: Machine, controllers: Mapping[str, Controller], where: Where, attempts: Path) -> None:
    """Drive with keyboard or gamepad: the simulated machine, or the one on a bus.

    Raises:
        ValueError: no window, no bus, or a loop that ended by itself.
    """
    session = Session(machine, [*controllers, "levers"], attempts)
    with control_process(machine, list(controllers.values()), where) as (asks, tells, ended):

        def hear() -> Known | None:
            values = tells.read()
            return None if values is None else unpack_known(machine, values)

        show(session, hear, lambda ask: asks.write(np.hstack(ask)), ended)


def watch(machine: Machine, where: Where) -> None:
    """Look at a machine on a bus; nothing is sent."""
    session, ticks = Session(machine, [], None), Ticks(machine)
    with open_line(where.interface, where.channel, where.log) as line:

        def hear() -> Known | None:
            known = None
            while (frame := line.recv(0)) is not None:
                known = ticks.hear(frame) or known
            return known

        show(session, hear, lambda ask: None, lambda: None)


# --- recorded runs ----------------------------------------------------------------------------------


class Run(NamedTuple):
    """A recorded run: what was known tick by tick, and the tool's."""

    title: str
    colour: view.Colour
    known: Sequence[Known]
    p_tool: Array  # m (T, 3)
    error: Array  # |v_goal - v_tool| [m/s] (T,)
    path: Array  # where the tool was to go [m] (K, 3), or none


def recorded(machine: Machine, title: str, colour: view.Colour, known: Sequence[Known], path: Array) -> Run:
    """A run from its ticks; the velocity error is that of the velocities that it holds."""
    q, q_dot, v_goal = (np.array([getattr(k, name) for k in known]) for name in ("q", "q_dot", "v_goal"))
    p_tool, v_tool, _ = tool_state(machine, q, q_dot)
    return Run(title, colour, known, p_tool, np.linalg.norm(v_goal - v_tool, axis=-1), path)


def run_of_log(machine: Machine, path: Path, colour: view.Colour) -> Run:
    """The ticks of a candump log from the first that drives; ticks without all positions are left out.

    Raises:
        ValueError: no log, or one in which nothing drives.
    """
    ticks = Ticks(machine)
    known = [k for frame in read_frames(path) if (k := ticks.hear(frame)) and np.isfinite(k.q).all()]
    first = next((i for i, k in enumerate(known) if k.driving), None)
    if first is None:
        raise ValueError(f"{path}: expected a log in which the valves are driven, got none")
    return recorded(machine, path.name, colour, known[first:], np.zeros((0, 3)))


def run_of_trace(machine: Machine, title: str, trace: Trace, run: int, goals: Array, start: Array) -> Run:
    """One run of a rollout: true motion, and where the goals (T, 3) would have led from the start [m] (3,)."""
    rows = zip(trace.q[:, run], trace.q_dot[:, run], trace.u[:, run], goals, strict=True)
    known = [Known(i, *row, driving=True) for i, row in enumerate(rows)]
    path = start + np.vstack([np.zeros(3), np.cumsum(goals, axis=0)]) * machine.dt
    colour = next((c for name, c in view.COLOURS.items() if title.startswith(name)), view.STEEL)
    return recorded(machine, title, colour, known, path)


def film(machine: Machine, runs: Sequence[Run], tick: int, size: tuple[int, int]) -> list[view.Shape]:
    """The picture of one tick of all runs, by the same clock; what is over stands still."""
    scenes = []
    for run in runs:
        at = min(tick, len(run.known) - 1)
        known, mean = run.known[at], run.error[: at + 1].mean()
        title, status = TITLES.get(run.title, run.title), f"{at * machine.dt:.1f} s"
        scene = view.Scene(known.q, known.q_dot, known.u, known.v_goal, run.p_tool[: at + 1], run.path)
        notes = [f"velocity error {run.error[at]:.3f} m/s", f"mean so far {mean:.3f} m/s"]
        scenes.append(scene._replace(title=title, status=status, colour=run.colour, notes=notes))
    return view.draw(machine, scenes, size)


def write_film(path: Path, machine: Machine, runs: Sequence[Run], size: tuple[int, int], fps: float) -> None:
    """All runs as a GIF, or as MP4 where ffmpeg is installed.

    Raises:
        ValueError: another kind of file, or no ffmpeg.
    """
    ticks = range(0, max(len(run.known) for run in runs), max(1, round(machine.rate / fps)))
    bar = tqdm(ticks, desc="draw", unit="picture", disable=None)
    images = (view.picture(film(machine, runs, tick, size), size) for tick in bar)
    if path.suffix == ".gif":
        first, *others = [Image.fromarray(image) for image in images]
        colours = others[-1].quantize(64) if others else first.quantize(64)
        flat = [i.quantize(palette=colours, dither=Image.Dither.NONE) for i in (first, *others)]
        with logs.whole_file(path) as file:
            duration, more = round(1000 * ticks.step / machine.rate), flat[1:]
            flat[0].save(file, "GIF", save_all=True, append_images=more, duration=duration, loop=0)
    elif path.suffix == ".mp4":
        form = f"-f rawvideo -pix_fmt rgb24 -s {size[0]}x{size[1]} -r {machine.rate / ticks.step} -i -"
        form += " -pix_fmt yuv420p -f mp4 -movflags frag_keyframe+empty_moov pipe:1"
        try:
            with logs.whole_file(path) as file:
                command = ["ffmpeg", "-loglevel", "error", *form.split()]
                with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=file) as process:
                    for image in images:
                        process.stdin.write(image.tobytes())  # type: ignore[union-attr]
                    process.stdin.close()  # type: ignore[union-attr]
                if process.returncode:
                    raise ValueError(f"{path}: expected ffmpeg to write it, got status {process.returncode}")
        except FileNotFoundError as error:
            raise ValueError(
                f"{path}: expected ffmpeg for .mp4, or a name ending in .gif, got none"
            ) from error
    else:
        raise ValueError(f"{path}: expected a name ending in .gif or .mp4, got {path.suffix!r}")


def show_film(machine: Machine, runs: Sequence[Run], size: tuple[int, int]) -> None:
    """All runs in a window, in real time; space halts, left and right move by a second."""
    window, at, going = view.Window(size, "brokk_min replay"), 0, True
    pg, last = window.pygame, max(len(run.known) for run in runs) - 1
    try:
        while True:
            for event in pg.event.get():
                if event.type == pg.QUIT or (event.type == pg.KEYDOWN and event.key == pg.K_ESCAPE):
                    return
                if event.type == pg.KEYDOWN:
                    going ^= event.key == pg.K_SPACE
                    at += round(machine.rate) * ((event.key == pg.K_RIGHT) - (event.key == pg.K_LEFT))
            at = min(max(at, 0), last)
            window.show(film(machine, runs, at, size), machine.rate)
            at += going
    finally:
        window.close()
