"""A window to drive by hand, and to trace lines: keyboard and gamepad, what is seen, 60 times a second.

The loop that drives is elsewhere (`remote`): the window only says what is asked for and shows what is known.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np

from brokk_min.can import operator_input as wishes
from brokk_min.can.canopen import open_bus
from brokk_min.can.drive_log import Telemetry, TelemetryReader, unpack_telemetry
from brokk_min.can.safety_gate import fault_name
from brokk_min.evaluation.rollout import Controller
from brokk_min.kinematics import forward_kinematics, tool_position
from brokk_min.machine import Array, Machine
from brokk_min.viewer import drawing as view
from brokk_min.viewer import tracing
from brokk_min.viewer.control_process import Ask, BusOptions, control_process
from brokk_min.viewer.drawing import TITLES
from brokk_min.viewer.window import Window, open_window

SIZE = (1120, 680)  # of the window [px]
RISE = 0.25  # s from a key's press to full deflection (assumed)

# --- the operator's hands ---------------------------------------------------------------------------

VELOCITY_KEYS = (
    ("up", "down"),
    ("left", "right"),
    ("w", "s"),
)  # +x -x, +y -y, +z -z: as the top view shows
LEVER_KEYS = (("q", "a"), ("w", "s"), ("e", "d"), ("r", "f"), ("t", "g"), ("y", "h"))
PAD_AXES = (
    1,
    0,
    4,
    3,
)  # as `wishes.Joystick` has them; 2 and 5 are triggers, which do not rest in the middle
PAD_BUTTON, PAD_MODE, PAD_NEXT, PAD_AGAIN = 5, 3, 0, 1


class InputHandler:
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
        self.focus, self.blocked, self.lost, self.closed, self.enable = (
            True,
            True,
            False,
            False,
            False,
        )
        self.task_wanted = ""  # "next" or "again"
        self.deflection = np.zeros(3)
        pygame.joystick.init()
        self.pad: Any = pygame.joystick.Joystick(0) if pygame.joystick.get_count() else None

    def hear(self, event: Any) -> None:
        """Take in one event."""
        pg = self.pygame
        if event.type == pg.QUIT or (event.type == pg.KEYDOWN and event.key == pg.K_ESCAPE):
            self.closed = True
        elif event.type == pg.KEYDOWN:
            self._press(event.key)
        elif event.type == pg.KEYUP:
            self.held.discard(event.key)
        elif event.type == pg.WINDOWFOCUSLOST:
            self.focus, self.blocked = False, True
            self.held.clear()
        elif event.type == pg.WINDOWFOCUSGAINED:
            self.focus = True
        else:
            self._hear_pad(event)

    def _press(self, key: int) -> None:
        pg = self.pygame
        self.lost = False  # the keyboard takes over
        self.held.add(key)
        if key == pg.K_TAB:
            self.switch()
        self.task_wanted = {pg.K_RETURN: "next", pg.K_BACKSPACE: "again"}.get(key, self.task_wanted)

    def _hear_pad(self, event: Any) -> None:
        pg = self.pygame
        if event.type == pg.JOYDEVICEADDED and self.pad is None:
            self.pad, self.lost, self.blocked = (
                pg.joystick.Joystick(event.device_index),
                False,
                True,
            )
        elif event.type == pg.JOYDEVICEREMOVED and self.pad:
            if event.instance_id == self.pad.get_instance_id():
                self.pad, self.lost, self.blocked = None, True, True
        elif event.type == pg.JOYBUTTONDOWN and event.button == PAD_MODE:
            self.switch()
        elif event.type == pg.JOYBUTTONDOWN:
            self.task_wanted = {PAD_NEXT: "next", PAD_AGAIN: "again"}.get(
                event.button, self.task_wanted
            )

    def switch(self) -> None:
        """The next one translates; the dead-man switch must be pressed afresh."""
        self.mode, self.blocked = (self.mode + 1) % len(self.modes), True

    def ask(self, now: float, seconds: float) -> Ask:
        """What is asked for now, `seconds` after the last time."""
        levers = self.modes[self.mode] == "levers"
        wanted = self._wanted(levers)
        if len(self.deflection) != len(wanted):
            self.deflection = np.zeros(len(wanted))
        step, from_ = seconds / RISE, np.where(wanted * self.deflection < 0, 0.0, self.deflection)
        moved = from_ + np.clip(wanted - from_, -step, step)
        self.deflection = np.where(wanted == 0, 0.0, moved)  # let go: neutral at once
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
            v = (
                self.machine.tool_speed
                * self.deflection
                / max(1.0, float(np.linalg.norm(self.deflection)))
            )
        return Ask(now, self.mode, self.enable, not self.lost, self.closed, v, u)

    def _wanted(self, levers: bool) -> Array:
        """Deflections of stick or levers in [-1, 1] that are held; a third of it with shift."""
        codes = self.codes[levers]
        keys = np.array(
            [(plus in self.held) - (minus in self.held) for plus, minus in codes], float
        )
        if not self.focus:
            return 0 * keys
        if self.held & {self.pygame.K_LSHIFT, self.pygame.K_RSHIFT}:
            keys /= 3
        if self.pad is not None:
            axes = [i for i in PAD_AXES[: len(keys)] if i < self.pad.get_numaxes()]
            keys[: len(axes)] -= wishes.shape_axis([self.pad.get_axis(i) for i in axes])
        return np.asarray(np.clip(keys, -1, 1))

    def _pad_button(self) -> bool:
        pad = self.pad
        return bool(
            pad is not None and pad.get_numbuttons() > PAD_BUTTON and pad.get_button(PAD_BUTTON)
        )


# --- the window -------------------------------------------------------------------------------------


class Session:
    """What the window shows: the newest ticks, the tool's trail, the line being traced, attempts."""

    def __init__(self, machine: Machine, modes: Sequence[str], file: Path | None) -> None:
        self.machine, self.modes, self.file = machine, modes, file
        self.attempts = tracing.read_attempts(file) if file else []
        self.lines, self.task = tracing.task_lines(machine), ""
        self.tracing: tracing.Tracing | None = None
        self.path = np.zeros((0, 3))  # of the last line, m
        self.done: tracing.Attempt | None = None
        self.before: Telemetry | None = None
        self.known: Telemetry | None = None
        self.arrived, self.trail = 0.0, list[Array]()

    def take(self, known: Telemetry, now: float) -> None:
        """A new tick."""
        self.before, self.known, self.arrived = self.known, known, now
        if not np.isfinite(known.q).all():
            return
        self.trail = [*self.trail, tool_position(forward_kinematics(self.machine, known.q))][-600:]
        if self.tracing and self.tracing.p and self.before and known.mode != self.before.mode:
            self.next_task(again=True)  # another one translates
        if self.tracing and self.tracing.follow(known):
            self.done = self.tracing.score(self.modes[known.mode])
            self.attempts.append(self.done)
            self.tracing = None
            if self.file:
                tracing.write_attempts(self.file, self.attempts)

    def next_task(self, again: bool = False) -> None:
        """The next line, or the same one again, from where the tool is."""
        names = list(self.lines)
        if self.trail:
            if not (again and self.task):
                self.task = (
                    names[(names.index(self.task) + 1) % len(names)] if self.task else names[0]
                )
            self.path = self.trail[-1] + self.lines[self.task]
            self.tracing = tracing.Tracing(self.machine, self.task, self.path)
            self.trail, self.done = [], None

    def scene(self, now: float, mode: str, hint: str) -> view.Scene:
        """What is to be seen now; angles between the last two ticks, so that motion looks smooth."""
        known, nan = self.known, np.full(self.machine.n, np.nan)
        if known is None or now - self.arrived > 0.5:
            known = Telemetry(0, nan, nan, 0 * nan, np.zeros(3), False, 0)
            status, mood = hint or "nothing to be heard", "waiting"
        else:
            status, mood = _status(self.machine, known, hint)
        q = known.q
        if self.before is not None:
            share = min(1.0, (now - self.arrived) / self.machine.dt)
            q = np.where(np.isfinite(self.before.q), self.before.q + share * (q - self.before.q), q)
        trail, title = np.array(self.trail).reshape(-1, 3), TITLES.get(mode, self.machine.name)
        u = np.nan_to_num(known.u)
        look = view.Scene(q, known.q_dot, u, known.v_goal, trail, self.path, title=title)
        if self.tracing:  # near, but never so near that the tool is not seen
            passed, hold = (
                self.tracing.passed,
                np.vstack([self.path, tool_position(forward_kinematics(self.machine, q))]),
            )
            look = look._replace(target=self.path[passed : passed + 1], hold=hold)
        colour = view.COLOURS.get(mode, view.STEEL)
        return look._replace(status=status, mood=mood, colour=colour, notes=self.notes(mode))

    def notes(self, mode: str) -> list[str]:
        """Keys, the task, and how it went."""
        if not mode:
            return ["only listening: nothing is sent; --drive drives", "ESC: end"]
        driven = [self.machine.names[i] for i in self.machine.driven]
        keys = "  ".join(
            f"{a}/{b}: {name}" for (a, b), name in zip(LEVER_KEYS, driven, strict=False)
        )
        lines = [
            f"hold SPACE to drive    {keys if mode == 'levers' else 'arrows: x, y    W/S: up, down'}",
            "SHIFT: slow  TAB: who translates  ENTER: next line  BACKSPACE: again  ESC: end",
        ]
        if self.tracing:
            passed = f"{self.tracing.passed} of {len(self.tracing.line)}"
            seconds = f"{self.tracing.seconds:.1f} s"
            lines.append(f"{self.task}: follow the orange line to its ring, {seconds}, {passed}")
        elif self.done:
            lines.append(f"{self.done.task} by {self.done.mode}: {tracing.figures(self.done[3:])}")
        return lines + tracing.attempts_table(self.attempts, self.task)


def _status(machine: Machine, known: Telemetry, hint: str) -> tuple[str, str]:
    """State of the gate in words, and its mood."""
    if known.driving:
        return "driving", "driving"
    if known.active_fault:
        return f"waiting: {fault_name(machine, known.active_fault)}", "waiting"
    if known.latched_fault:
        return f"stopped: {fault_name(machine, known.latched_fault)}", "waiting"
    return hint or "ready", "ready"


Watcher = Callable[[Session, InputHandler], bool]


def show(
    window: Window,
    session: Session,
    hear: Callable[[], Telemetry | None],
    tell: Callable[[Ask], object],
    ended: Callable[[], str | None],
    watcher: Watcher = lambda session, hands: True,
    fps: float = 60.0,
) -> None:
    """The window until it is closed: events, what the loop knows, a picture, `fps` times a second.

    Args:
        window: open.
        session: what is shown; without modes it only watches.
        hear: the newest tick, if any.
        tell: takes what is asked for.
        ended: why the loop ended; None: it runs.
        watcher: is called at each picture; False closes the window.
    """
    pygame, modes = window.pygame, session.modes or [""]
    hands, before = InputHandler(session.machine, pygame, modes), time.monotonic()
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
                session.next_task(hands.task_wanted == "again")
            hands.task_wanted = ""
            scene = session.scene(now, modes[hands.mode], _hint(session, hands))
            window.show(view.draw(session.machine, [scene], SIZE), fps)
    finally:
        tell(ask._replace(enable=False, stop=True))


def _hint(session: Session, hands: InputHandler) -> str:
    """What the operator has to do next."""
    if not session.modes:
        return (
            "watching" if session.known else "nobody sends SYNC: start what drives, or use --drive"
        )
    if session.known is None:
        return "starting"
    if not hands.focus:
        return "neutral: the window has no focus"
    if hands.blocked:
        return "release the switch, then press it with nothing deflected"
    return "ready: hold SPACE" + f" or button {PAD_BUTTON}" * (hands.pad is not None)


def _window(machine: Machine) -> AbstractContextManager[Window]:
    """Before a loop begins: nothing may reach a bus if nobody can see it."""
    return open_window(SIZE, f"brokk_min: {machine.name}")


def play(
    machine: Machine, controllers: Mapping[str, Controller], where: BusOptions, attempts: Path
) -> None:
    """Drive with keyboard or gamepad: the simulated machine, or the one on a bus.

    ValueError: no window, no bus, or a loop that ended by itself.
    """
    session, chosen = (
        Session(machine, [*controllers, "levers"], attempts),
        list(controllers.values()),
    )
    with (
        _window(machine) as window,
        control_process(machine, chosen, where) as (asks, tells, ended),
    ):

        def hear() -> Telemetry | None:
            values = tells.read()
            return None if values is None else unpack_telemetry(machine, values)

        show(window, session, hear, lambda ask: asks.write(np.hstack(ask)), ended)


def watch(machine: Machine, where: BusOptions) -> None:
    """Look at a machine on a bus; nothing is sent."""
    session, ticks = Session(machine, [], None), TelemetryReader(machine)
    with _window(machine) as window, open_bus(where.interface, where.channel, where.log) as line:

        def hear() -> Telemetry | None:
            known = None
            while (frame := line.recv(0)) is not None:
                known = ticks.update(frame) or known
            return known

        show(window, session, hear, lambda ask: None, lambda: None)
