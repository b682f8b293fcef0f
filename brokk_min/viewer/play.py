"""A window to drive by hand and to trace lines, with keyboard or gamepad, 60 frames a second.

The window sends requests to the loop (`control_process`) and shows the telemetry that it returns.
"""

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import cycle
from pathlib import Path

import numpy as np

from brokk_min.can.connection import open_bus
from brokk_min.can.drive_log import Telemetry, TelemetryReader
from brokk_min.can.simulated_machine import start_pose
from brokk_min.evaluation.rollout import TITLES, Controller
from brokk_min.kinematics import forward_kinematics, tool_position
from brokk_min.machine import Array, Machine
from brokk_min.viewer import control_process, drawing, lockstep, tracing
from brokk_min.viewer.control_process import BusOptions, Request, receive_telemetry, send_request
from brokk_min.viewer.drawing import NO_POINTS
from brokk_min.viewer.faults import fault_in_words
from brokk_min.viewer.input_handler import LEVER_KEYS, PAD_SWITCH, InputHandler
from brokk_min.viewer.window import Canvas, Colour, Window

SIZE = (1120, 680)  # of the window at first [px]
FPS = 60.0  # pictures a second, at most
STALE = 0.5  # s without telemetry, then the pose is an old one (assumed)
SLOW = 0.95  # of real time: a slower motion is shown (assumed)
TRAIL = 600  # tool positions


@dataclass
class Session:
    """What the window shows: telemetry, trail of the tool, the line being traced, attempts."""

    machine: Machine
    controllers: Mapping[str, Controller] | None  # a mode each; None: the window only watches
    file: Path  # of the attempts
    simulated: bool = False  # may the controllers be compared on simulated machines?

    def __post_init__(self) -> None:
        self.modes = [] if self.controllers is None else [*self.controllers, "levers"]
        self.attempts = tracing.read_attempts(self.file) if self.modes else []
        self.lines = tracing.task_lines(self.machine)
        self.names = cycle(self.lines)
        self.task = ""
        self.path: Array = NO_POINTS  # of the last line [m]
        self.in_view: Array = NO_POINTS  # while and after a line is traced
        self.tracing: tracing.Tracing | None = None
        self.finished: tracing.Attempt | None = None
        self.comparison: Iterator[dict[str, Array]] | None = None
        self.compared_q: list[dict[str, Array]] = []  # of each tick, by controller [rad] (n,)
        self.previous: Telemetry | None = None
        self.telemetry: Telemetry | None = None
        self.pose: Array = np.full(self.machine.n, np.nan)  # the last known one [rad]
        self.arrivals = deque[float](maxlen=round(self.machine.rate) + 1)  # s, of a second's ticks
        self.trail: Array = NO_POINTS  # past tool positions [m] (T, 3)

    def update(self, telemetry: Telemetry, now: float) -> None:
        """A new tick."""
        self.previous = self.telemetry
        self.telemetry = telemetry
        self.arrivals.append(now)
        if not np.isfinite(telemetry.q).all():
            return
        self.pose = telemetry.q
        p_tool = tool_position(forward_kinematics(self.machine, telemetry.q))
        self.trail = np.vstack([self.trail, p_tool])[-TRAIL:]
        mode_changed = self.previous is not None and self.previous.mode != telemetry.mode
        if mode_changed and self.tracing and self.tracing.p:
            self.next_task("again")
        if self.tracing and self.tracing.update(telemetry):
            self.finished = self.tracing.attempt(self.modes[telemetry.mode])
            self.tracing = None
            self.attempts.append(self.finished)
            tracing.write_attempts(self.file, self.attempts)
        if telemetry.driving:
            self.comparison = None
        if self.comparison:
            self.compared_q.append(next(self.comparison))

    def next_task(self, which: str = "next") -> None:
        """The next line, the same one "again" from where the tool is, or by all: "compare"."""
        if not len(self.trail):
            return
        if which == "next" or not self.task:
            self.task = next(self.names)
        self.path = self.in_view = self.trail[-1] + self.lines[self.task]
        self.trail = self.trail[-1:]
        self.finished = self.comparison = self.tracing = None
        if which == "compare" and self.controllers and self.simulated:
            line = (self.machine, self.controllers, self.pose, self.path)
            self.comparison = lockstep.compare(*line)
            self.compared_q = [next(self.comparison)]
        else:
            self.tracing = tracing.Tracing(self.machine, self.task, self.path)

    def speed(self) -> float:
        """Speed of the ticks of the last second, as a fraction of real time."""
        if len(self.arrivals) < 2:
            return 1.0
        seconds = max(1e-9, self.arrivals[-1] - self.arrivals[0])
        return (len(self.arrivals) - 1) * self.machine.dt / seconds

    def scene(self, now: float, mode: str, hint: str) -> drawing.Scene:
        """What the window shows now; angles between the last two ticks, for smooth motion."""
        zero = np.zeros(self.machine.n)
        telemetry = self.telemetry
        if telemetry is None or now - self.arrivals[-1] > STALE:
            banner = hint if telemetry is None else "No telemetry: the pose is the last known one."
            telemetry = Telemetry(0, zero + np.nan, zero, zero, np.zeros(3), False)
            status, colour = "no telemetry", drawing.WARNING
        else:
            status, colour = gate_status(telemetry, hint)
            banner = fault_in_words(self.machine, telemetry)
            if self.speed() < SLOW:
                status += (
                    f", {100 * self.speed():.0f} % of real time, {telemetry.lateness:.1f} s late"
                )
        known = bool(np.isfinite(telemetry.q).all())
        scene = drawing.Scene(
            self._interpolate(telemetry.q, now) if known else self.pose,
            telemetry.q_dot if known else zero,
            telemetry.u,
            telemetry.v_goal,
            trail=self.trail,
            path=self.path,
            title=TITLES.get(mode, self.machine.name),
            status=status,
            status_colour=colour,
            colour=drawing.COLOURS.get(mode, drawing.STEEL) if known else drawing.TRACK,
            notes=self.notes(mode),
            banner=banner,
        )
        return self._with_line(scene) if len(self.path) and known else scene

    def _with_line(self, scene: drawing.Scene) -> drawing.Scene:
        """The scene near the line, which stays so until the next line."""
        runs = []
        for name in self.compared_q[0] if self.comparison else ():
            q = np.array([poses[name] for poses in self.compared_q])
            trail = tool_position(forward_kinematics(self.machine, q))
            text = f"{TITLES.get(name, name)}: {distances(self.path, trail)}"
            runs.append(drawing.Trace(q[-1], trail, drawing.COLOURS[name], text))
        if runs:
            scene = scene._replace(q=runs[0].q, q_dot=0 * scene.q, traces=runs, trail=NO_POINTS)
        else:
            scene = scene._replace(headline=distances(self.path, scene.trail, " from the line"))
        poses = np.array([scene.q, *(run.q for run in runs)])
        p_tool = tool_position(forward_kinematics(self.machine, poses))
        points = np.vstack([self.in_view, p_tool])
        self.in_view = np.vstack([self.path, points.min(axis=0), points.max(axis=0)])
        passed = self.tracing.passed if self.tracing else len(self.path)
        return scene._replace(target=self.path[passed : passed + 1], in_view=self.in_view)

    def _interpolate(self, q: Array, now: float) -> Array:
        if self.previous is None or not np.isfinite(self.previous.q).all():
            return q
        fraction = min(1.0, (now - self.arrivals[-1]) / self.machine.dt)
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
        if self.controllers and self.simulated:
            notes.append("C: the same line by all controllers, simulated, nobody steers")
        done = self.finished
        if self.tracing:
            work = self.tracing
            passed = f"{work.seconds:.1f} s, {work.passed} of {len(work.line)}"
            notes.append(f"{self.task}: follow the orange line to its ring, {passed}")
        elif done:
            notes.append(f"{done.task} by {done.mode}: {tracing.summary(done[3:])}")
        return notes + tracing.attempts_table(self.attempts, self.task)


def distances(line: Array, trail: Array, where: str = "") -> str:
    """Distance of the tool from a line now, and the largest one, as text."""
    millimetres = 1e3 * tracing.distance(line, trail)
    return f"{millimetres[-1]:.0f} mm{where}, at most {millimetres.max():.0f} mm"


def gate_status(telemetry: Telemetry, hint: str) -> tuple[str, Colour]:
    """Status of the gate as text, and its colour."""
    if telemetry.driving:
        return "driving", drawing.DRIVING
    if telemetry.active_fault or telemetry.latched_fault:
        return "waiting" if telemetry.active_fault else "stopped", drawing.WARNING
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
Receive = Callable[[], Iterable[Telemetry]]
Send = Callable[[Request], object]


def show(
    window: Window, session: Session, receive: Receive, send: Send, each_frame: FrameHook
) -> None:
    """The window until it is closed: input, telemetry, one picture, `FPS` times a second.

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
            session.next_task(handler.task)
        handler.task = ""
        canvas = Canvas(window.size)
        scene = session.scene(now, modes[handler.mode], next_step(session, handler))
        drawing.draw(canvas, session.machine, [scene])
        window.show(canvas, FPS)


def play(
    machine: Machine,
    controllers: Mapping[str, Controller] | None,
    options: BusOptions,
    attempts: Path,
    each_frame: FrameHook = lambda session, handler: True,
) -> None:
    """Drive with keyboard or gamepad: the simulated machine, or the one on a bus.

    Without controllers (None) it only shows the machine on a bus, and nothing is sent.
    The window opens first: nothing may reach a bus if nobody can see it.

    ValueError: no window, no bus, or a loop that ended by itself.
    """
    session = Session(machine, controllers, attempts, not options.interface)
    with (
        closing(Window(SIZE, f"brokk_min: {machine.name}")) as window,
        connect(machine, controllers, options) as (receive, send),
    ):
        show(window, session, receive, send, each_frame)


@contextmanager
def connect(
    machine: Machine, controllers: Mapping[str, Controller] | None, options: BusOptions
) -> Iterator[tuple[Receive, Send]]:
    """What gives telemetry and what takes requests: a bus, a loop on it, or one in lockstep."""
    if controllers is None:
        update = TelemetryReader(machine).update
        with open_bus(options.interface, options.channel, options.log) as bus:
            yield (
                lambda: filter(None, map(update, iter(lambda: bus.recv(0), None))),
                lambda request: None,
            )
        return
    known = list(controllers.values())
    if options.interface:
        with control_process.start(machine, known, options) as pipe:
            yield partial(receive_telemetry, pipe), partial(send_request, pipe)
        return
    start = start_pose(machine, options.start)
    with closing(lockstep.Lockstep(machine, known, start, options.log)) as loop:
        yield loop.receive, partial(send_request, loop.connection)
