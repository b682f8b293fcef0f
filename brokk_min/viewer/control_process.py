"""The 20 Hz loop in a process of its own, for a window that must never make it wait.

The window writes what the operator asks for and reads what the loop knows, through `Mailbox`es on which
neither side ever waits. The loop is `hw.Drive` with its gate; a window that is silent is a lost device.
"""

import multiprocessing
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from threading import Thread
from typing import Any, NamedTuple

import numpy as np

from brokk_min import hw
from brokk_min.can.canopen import OperatorInput, open_bus
from brokk_min.can.drive_log import Telemetry
from brokk_min.can.simulated_machine import SimulatedMachine, serve, start_pose
from brokk_min.env import Measured, action_to_pwm
from brokk_min.evaluation.rollout import Controller
from brokk_min.machine import PWM_MAX, Array, Machine

STALE = 0.2  # s without a word from the window, then the operator's device is lost (assumed)


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


def unpack_ask(values: Array) -> Ask:
    """An `Ask` from its fields in a row."""
    now, mode, enable, alive, stop = values[:5]
    return Ask(
        float(now), int(mode), bool(enable), bool(alive), bool(stop), values[5:8], values[8:]
    )


# --- the loop ---------------------------------------------------------------------------------------


class Levers:
    """A controller that translates nothing: each lever is a driven joint's action of `action_to_pwm`."""

    def __init__(self, machine: Machine) -> None:
        self.machine = machine
        self.levers: Array = np.zeros(len(machine.driven))

    def start(self, num: int) -> None:
        """Nothing to remember."""

    def __call__(self, measured: Measured, memory: None) -> tuple[Array, None]:
        """Commands u (num, n), whatever is observed."""
        return np.repeat(
            action_to_pwm(self.machine, self.levers)[None], len(measured.q), axis=0
        ), None


class Chosen:
    """One of several controllers at a time; one that takes over starts from rest."""

    def __init__(self, controllers: Sequence[Controller]) -> None:
        self.controllers, self.mode = controllers, 0

    def start(self, num: int) -> tuple[int, Any]:
        """Whose memory it is, and the memory."""
        return self.mode, self.controllers[self.mode].start(num)

    def __call__(
        self, measured: Measured, memory: tuple[int, Any]
    ) -> tuple[Array, tuple[int, Any]]:
        """Commands and memory of the chosen one."""
        mode, inner = memory if memory[0] == self.mode else self.start(len(measured.q))
        u, inner = self.controllers[mode](measured, inner)
        return u, (mode, inner)


class Remote:
    """The operator of the loop: the window's newest word; a window that is silent is a lost device."""

    def __init__(
        self,
        asks: Mailbox,
        chosen: Chosen,
        levers: Levers,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.asks, self.chosen, self.levers, self.clock = asks, chosen, levers, clock
        self.ask: Ask | None = None

    def __call__(self, driving: bool, ready: bool) -> OperatorInput:
        """The wish of this tick."""
        if (values := self.asks.read()) is not None:
            self.ask = unpack_ask(values)
        ask = self.ask
        if ask is None or self.clock() - ask.time > STALE:
            parent = multiprocessing.parent_process()
            return OperatorInput(alive=False, stop=parent is not None and not parent.is_alive())
        self.chosen.mode, self.levers.levers = ask.mode, ask.levers
        x, y, z = map(float, ask.v_goal)
        return OperatorInput((x, y, z), ask.enable, ask.alive, ask.stop)


class Loop(hw.Drive):
    """The 20 Hz loop, which says after each tick what it knows."""

    tell: Callable[[Telemetry], object] = staticmethod(lambda known: None)

    def tick(self) -> bool:
        """One tick."""
        more = super().tick()
        with self.catch_errors():
            self.tell(self.known())
        return more

    def known(self) -> Telemetry:
        """What is known after a tick."""
        u, mode = self.gate.sent[..., -1] / PWM_MAX, getattr(self.controller, "mode", 0)
        gate, v_goal = self.gate, np.array(self.operator_input.v_goal)
        state = bool(gate.driving), int(gate.active_fault), int(gate.latched_fault)
        q, q_dot = self.measured
        return Telemetry(self.ticks, q, q_dot, u, v_goal, *state, mode, self.lateness)


@dataclass(frozen=True)
class BusOptions:
    """The bus; an empty interface is a simulated machine in the loop's own process."""

    interface: str = ""
    channel: str = ""
    log: Path | None = None
    start: tuple[float, ...] = ()  # of the simulated machine [rad], see `start_pose`


def control(
    machine: Machine,
    controllers: Sequence[Controller],
    where: BusOptions,
    asks: Mailbox,
    tells: Mailbox,
) -> None:
    """Drive until the window says stop; with a simulated machine of its own where there is no bus."""
    levers = Levers(machine)
    chosen = Chosen([*controllers, levers])
    interface, channel = where.interface or "virtual", where.channel or "brokk_min play"
    running = True
    with (
        open_bus(interface, channel, where.log) as line,
        _simulated(machine, where, lambda: running),
    ):
        try:
            loop = Loop(machine, chosen, line, Remote(asks, chosen, levers))
            loop.tell = lambda known: tells.write(known.pack())
            loop.begin()
            loop.run()
        finally:
            running = False


@contextmanager
def _simulated(machine: Machine, where: BusOptions, running: Callable[[], bool]) -> Iterator[None]:
    """A simulated machine in a thread, if no bus is named."""
    if where.interface:
        yield
        return
    q = start_pose(machine, where.start)
    with open_bus("virtual", "brokk_min play") as line:
        simulated = SimulatedMachine(machine, q, line.now())
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
        errors.send(
            f"{error}" if isinstance(error, ValueError) else f"{type(error).__name__}: {error}"
        )


@contextmanager
def control_process(
    machine: Machine, controllers: Sequence[Controller], where: BusOptions
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
