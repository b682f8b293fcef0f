"""A window to drive by hand and to trace lines, with keyboard or gamepad, 60 frames a second.

The window sends requests to the loop (`control_process`) and shows the telemetry that it returns.
"""

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from itertools import cycle
from pathlib import Path

import numpy as np

from brokk_min.can.connection import open_bus
from brokk_min.can.drive_log import Telemetry, TelemetryReader
from brokk_min.can.safety_gate import fault_name
from brokk_min.evaluation.rollout import Controller
from brokk_min.kinematics import forward_kinematics, tool_position
from brokk_min.machine import Array, Machine
from brokk_min.viewer import control_process, drawing, tracing
from brokk_min.viewer.control_process import BusOptions, Request
from brokk_min.viewer.input_handler import LEVER_KEYS, PAD_SWITCH, InputHandler
from brokk_min.viewer.window import Canvas, Colour, Window

SIZE = (1120, 680)  # of the window [px]
STALE = 0.5  # s without telemetry, then angles count as unknown (assumed)
TRAIL = 600  # tool positions


class Session:
    """What the window shows: telemetry, trail of the tool, the line being traced, attempts."""

    def __init__(self, machine: Machine, modes: Sequence[str], file: Path | None) -> None:
        self.machine = machine
        self.modes = modes
        self.file = file  # of the attempts
        self.attempts = tracing.read_attempts(file) if file else []
        self.lines = tracing.task_lines(machine)
        self.names = cycle(self.lines)
        self.task = ""
        self.path: Array = drawing.NO_POINTS  # of the last line [m]
        self.tracing: tracing.Tracing | None = None
        self.finished: tracing.Attempt | None = None
        self.previous: Telemetry | None = None
        self.telemetry: Telemetry | None = None
        self.arrived = 0.0  # s
        self.trail = list[Array]()

    def update(self, telemetry: Telemetry, now: float) -> None:
        """A new tick."""
        self.previous = self.telemetry
        self.telemetry = telemetry
        self.arrived = now
        if not np.isfinite(telemetry.q).all():
            return
        p_tool = tool_position(forward_kinematics(self.machine, telemetry.q))
        self.trail = [*self.trail, p_tool][-TRAIL:]
        mode_changed = self.previous is not None and self.previous.mode != telemetry.mode
        if mode_changed and self.tracing and self.tracing.p:
            self.next_task(again=True)
        if self.tracing and self.tracing.update(telemetry):
            self.finished = self.tracing.attempt(self.modes[telemetry.mode])
            self.tracing = None
            self.attempts.append(self.finished)
            if self.file:
                tracing.write_attempts(self.file, self.attempts)

    def next_task(self, again: bool = False) -> None:
        """The next line, or the same one again, from where the tool is."""
        if not self.trail:
            return
        if not (again and self.task):
            self.task = next(self.names)
        self.path = self.trail[-1] + self.lines[self.task]
        self.tracing = tracing.Tracing(self.machine, self.task, self.path)
        self.trail = []
        self.finished = None

    def scene(self, now: float, mode: str, hint: str) -> drawing.Scene:
        """What the window shows now; angles between the last two ticks, for smooth motion."""
        unknown = np.full(self.machine.n, np.nan)
        telemetry = Telemetry(0, unknown, unknown, np.zeros(self.machine.n), np.zeros(3), False)
        status = hint or "no telemetry"
        colour = drawing.WARNING
        if self.telemetry is not None and now - self.arrived <= STALE:
            telemetry = self.telemetry
            status, colour = gate_status(self.machine, telemetry, hint)
        scene = drawing.Scene(
            self._interpolate(telemetry.q, now),
            telemetry.q_dot,
            telemetry.u,
            telemetry.v_goal,
            trail=np.array(self.trail).reshape(-1, 3),
            path=self.path,
            title=drawing.TITLES.get(mode, self.machine.name),
            status=status,
            status_colour=colour,
            colour=drawing.COLOURS.get(mode, drawing.STEEL),
            notes=self.notes(mode),
        )
        if self.tracing is None:
            return scene
        p_tool = tool_position(forward_kinematics(self.machine, scene.q))
        target = self.path[self.tracing.passed : self.tracing.passed + 1]
        return scene._replace(target=target, in_view=np.vstack([self.path, p_tool]))

    def _interpolate(self, q: Array, now: float) -> Array:
        if self.previous is None or not np.isfinite(self.previous.q).all():
            return q
        fraction = min(1.0, (now - self.arrived) / self.machine.dt)
        return np.asarray(self.previous.q + fraction * (q - self.previous.q))

    def notes(self, mode: str) -> list[str]:
        """Keys, the task, and results."""
        if not mode:
            return ["only listening: nothing is sent; --drive drives", "ESC: end"]
        keys = "arrows: x, y    W/S: up, down"
        if mode == "levers":
            driven = [self.machine.names[i] for i in self.machine.driven]
            pairs = zip(LEVER_KEYS, driven, strict=False)
            keys = "  ".join(f"{plus}/{minus}: {name}" for (plus, minus), name in pairs)
        notes = [
            f"hold SPACE to drive    {keys}",
            "SHIFT: slow  TAB: next controller  ENTER: next line  BACKSPACE: again  ESC: end",
        ]
        done = self.finished
        if self.tracing:
            work = self.tracing
            passed = f"{work.seconds:.1f} s, {work.passed} of {len(work.line)}"
            notes.append(f"{self.task}: follow the orange line to its ring, {passed}")
        elif done:
            notes.append(f"{done.task} by {done.mode}: {tracing.summary(done[3:])}")
        return notes + tracing.attempts_table(self.attempts, self.task)


def gate_status(machine: Machine, telemetry: Telemetry, hint: str) -> tuple[str, Colour]:
    """Status of the gate as text, and its colour."""
    if telemetry.driving:
        return "driving", drawing.DRIVING
    if telemetry.active_fault:
        return f"waiting: {fault_name(machine, telemetry.active_fault)}", drawing.WARNING
    if telemetry.latched_fault:
        return f"stopped: {fault_name(machine, telemetry.latched_fault)}", drawing.WARNING
    return hint or "ready", drawing.READY


def next_step(session: Session, handler: InputHandler) -> str:
    """What the operator has to do next."""
    if not session.modes:
        return "watching" if session.telemetry else "no SYNC: start what drives, or use --drive"
    if session.telemetry is None:
        return "starting"
    if not handler.focus:
        return "neutral: the window has no focus"
    if handler.blocked:
        return "release the switch, then press it with nothing deflected"
    return "ready: hold SPACE" + f" or button {PAD_SWITCH}" * (handler.pad is not None)


FrameHook = Callable[[Session, InputHandler], bool]  # called each frame; False closes the window


def show(
    window: Window,
    session: Session,
    receive: Callable[[], Iterable[Telemetry]],
    send: Callable[[Request], object],
    each_frame: FrameHook = lambda session, handler: True,
    fps: float = 60.0,
) -> None:
    """The window until it is closed: input, telemetry, one picture, `fps` times a second.

    Without modes it only watches. Requests are sent once there is telemetry.
    """
    modes = session.modes or [""]
    handler = InputHandler(session.machine, window.pygame, modes)
    while not handler.closed and each_frame(session, handler):
        for event in window.pygame.event.get():
            handler.handle(event)
        now = time.monotonic()
        request = handler.request(now)
        for telemetry in receive():
            session.update(telemetry, now)
        if session.telemetry is not None:
            send(request)
        if handler.task and session.modes:
            session.next_task(again=handler.task == "again")
        handler.task = ""
        canvas = Canvas(SIZE)
        scene = session.scene(now, modes[handler.mode], next_step(session, handler))
        drawing.draw(canvas, session.machine, [scene])
        window.show(canvas, fps)


def play(
    machine: Machine,
    controllers: Mapping[str, Controller],
    options: BusOptions,
    attempts: Path,
    each_frame: FrameHook = lambda session, handler: True,
) -> None:
    """Drive with keyboard or gamepad: the simulated machine, or the one on a bus.

    The window opens first: nothing may reach a bus if nobody can see it.

    ValueError: no window, no bus, or a loop that ended by itself.
    """
    session = Session(machine, [*controllers, "levers"], attempts)
    with (
        closing(Window(SIZE, f"brokk_min: {machine.name}")) as window,
        control_process.start(machine, list(controllers.values()), options) as connection,
    ):
        show(
            window,
            session,
            lambda: control_process.receive_telemetry(connection),
            lambda request: control_process.send_request(connection, request),
            each_frame,
        )


def watch(
    machine: Machine, options: BusOptions, each_frame: FrameHook = lambda session, handler: True
) -> None:
    """Show a machine on a bus; nothing is sent."""
    session = Session(machine, [], None)
    reader = TelemetryReader(machine)
    with (
        closing(Window(SIZE, f"brokk_min: {machine.name}")) as window,
        open_bus(options.interface, options.channel, options.log) as bus,
    ):

        def receive() -> Iterable[Telemetry]:
            return filter(None, map(reader.update, iter(lambda: bus.recv(0), None)))

        show(window, session, receive, lambda request: None, each_frame)
