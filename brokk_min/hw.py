"""The loop that drives a machine on a CAN bus, at 20 Hz for the Brokk. Paper: Sec. 2

One tick: the operator's goal, SYNC, encoder positions, measurements, controller, gate, valve frame.
Each encoder answers the frame SYNC with its position; `canopen.Nodes` keeps the newest position,
heartbeat and state of each node. A trained agent is the `Controller` `learning.policy.Policy`: it
observes, takes the actor's mean, without noise, and makes u of it, as in `env`. The gate lets a
command grow by 40 counts a tick at most, and not outward at an end stop, which training has not; on
any fault it closes the valves until the operator presses the dead-man switch anew at zero goal
("arms"). What it lets pass becomes bytes by `machine.encode_pwm` in `canopen.valve_frame`.
Nothing here is a safety function: keep the hard-wired emergency stop (docs/hardware.md).
"""

import gc
from collections.abc import Callable
from typing import Any

import numpy as np

from brokk_min.actuator import append_sample, initial_history
from brokk_min.can import canopen
from brokk_min.can.canopen import Counts, Operator, OperatorInput
from brokk_min.can.connection import Bus, stop_signals
from brokk_min.can.safety_gate import GateInputs, gate, gate_start
from brokk_min.env import measure
from brokk_min.machine import Array, Controller, Machine, Measured

ANSWER_TIME = 0.4  # of a tick after SYNC, in which the encoders must answer (assumed)


class Drive:
    """From the operator's velocity goals, through a controller and the gate, to the valves."""

    controller_state: Any  # from the first tick with all positions on
    start_time: float  # s, see `begin`
    lateness: float  # s, of the last tick

    def __init__(
        self, machine: Machine, controller: Controller, bus: Bus, operator: Operator
    ) -> None:
        self.machine, self.controller = machine, controller
        self.bus, self.operator = bus, operator
        self.operator_input = OperatorInput()
        self.nodes = canopen.Nodes(machine)
        self.gate = gate_start(machine)
        self.history: Array | None = None  # None after a gap
        self.measured: Measured | None = None  # newest, arrays (1, ...); None after a gap
        self.exception = ""  # of this tick
        self.last_exception = ""  # since it drove
        self.signals: list[int] = []
        self.deadline_number = 0  # ticks from the start to the next deadline
        self.ticks = 0

    def begin(self) -> None:
        """Set up and start the nodes, and start the clock. ValueError: an encoder does not fit."""
        canopen.set_up_nodes(self.bus, self.machine)
        self.start_time = self.bus.now()

    def run(self, show: Callable[["Drive"], object] = lambda drive: None) -> None:
        """Tick until the operator or a signal stops it; the last frame is neutral. Paper: Sec. 2"""
        gc.disable()  # no garbage collection in the middle of a tick
        try:
            with stop_signals() as self.signals:
                while self.tick():
                    if self.ticks % 5 == 0:
                        show(self)
        except BaseException:
            self.exception = "the loop ended"
            self.send_command(np.zeros(self.machine.n), self.gate.counts)
            raise
        finally:
            gc.enable()

    def tick(self) -> bool:
        """Wait, then operator, SYNC and positions, control, gate, frame; False: it was the last."""
        self.wait()
        self.attempt(self.ask_operator)
        self.attempt(self.ask_positions)
        counts = canopen.encoder_counts(self.machine, self.nodes.raw)
        command = self.attempt(self.control, counts, default=np.zeros(self.machine.n))
        stop = self.operator_input.stop or bool(self.signals)
        self.operator_input = self.operator_input._replace(stop=stop)
        self.attempt(self.bus.log_tick, self.operator_input, self.lateness)
        self.send_command(command, counts)
        self.nodes.start_tick()
        self.attempt(self.restart_nodes)
        self.attempt(self.bus.flush)
        return not stop

    def attempt(self, action: Callable[..., Any], *arguments: Any, default: Any = None) -> Any:
        """What the action returns; an exception becomes a fault of the gate, and `default`."""
        try:
            return action(*arguments)
        except Exception as error:
            self.exception = f"{type(error).__name__}: {error}"
            return default

    def ask_operator(self) -> None:
        """Take the operator's input, which stays what it was if this raises."""
        ready = not str(self.gate.active_fault)
        self.operator_input = self.operator(bool(self.gate.driving), ready)

    def ask_positions(self) -> None:
        """Send SYNC, and listen until each encoder has answered once or the time is over."""
        self.nodes.early = self.nodes.frames > 0  # no answers to this SYNC
        self.nodes.frames[:] = 0
        self.bus.send(canopen.SYNC, b"")
        answer_by = self.bus.now() + ANSWER_TIME * self.machine.dt
        self.nodes.listen(self.bus, answer_by, until_complete=True)

    def control(self, counts: Counts) -> Array:
        """The controller's command u (n,) at angles `counts` [encoder counts]."""
        m = self.machine
        if (self.nodes.early | (self.nodes.frames != 1)).any():
            # not one position of each encoder since SYNC: later samples do not join earlier ones
            self.history = self.measured = None
            return np.zeros(m.n)
        q = (counts[None] * m.encoder_step).astype(np.float32)  # as `machine.read_encoder`
        if self.history is None:
            self.history = initial_history(q, m.history)
        else:
            sent = self.gate.sent[..., -1]  # (n,), what the gate let pass in the last tick
            self.history = append_sample(self.history, sent, q, m.velocity_samples, m.dt)
        if not self.gate.driving:
            self.controller_state = self.controller.start(1)
        v_goal = np.array([self.operator_input.v_goal], np.float32)
        self.measured = measure(m, self.history, v_goal)
        u, self.controller_state = self.controller(self.measured, self.controller_state)
        return np.asarray(u[0], float)

    def send_command(self, command: Array, counts: Counts) -> None:
        """Pass the safety gate, and send its valve frame of PWM bytes once it was armed."""
        entered = self.operator_input
        inputs = GateInputs(
            command=command,
            counts=counts,
            early=self.nodes.early,
            frames=self.nodes.frames,
            heartbeat=self.nodes.heartbeat,
            nmt=self.nodes.nmt,
            enable=np.array(entered.enable),
            centred=np.array(not any(entered.v_goal)),
            alive=np.array(entered.alive),
            stop=np.array(entered.stop),
            error=np.array(bool(self.exception)),
            flooded=np.array(self.nodes.received >= canopen.MAX_FRAMES),
            other_sender=np.array(self.nodes.others > 0),
        )
        self.gate, frame = gate(self.machine, self.gate, inputs, self.bus.now())
        self.last_exception = "" if self.gate.driving else self.exception or self.last_exception
        self.exception = ""  # one while sending is a fault of the next tick
        if self.gate.armed_once:
            self.attempt(self.bus.send, self.machine.valve_frame_id, frame.tobytes())

    def restart_nodes(self) -> None:
        """Start the nodes that fell back, once the switch is released."""
        released = not (self.operator_input.enable or self.gate.driving)
        if released and (self.nodes.nmt != canopen.OPERATIONAL).any():
            self.bus.send(canopen.NMT, canopen.START_ALL)

    @property
    def reason(self) -> str:
        """Why it does not drive: the fault that stopped it, or what is in the way."""
        stopped = str(self.gate.latched_fault)
        error = f" ({self.last_exception})" if self.last_exception else ""
        return (f"fault: {stopped}" if stopped else str(self.gate.active_fault)) + error

    def wait(self) -> None:
        """Listen until the deadline, then set the next one, which is in the future."""
        deadline = self.start_time + self.deadline_number * self.machine.dt  # no sum: no drift
        self.attempt(self.nodes.listen, self.bus, deadline)
        self.bus.sleep(max(0.0, deadline - self.bus.now()))  # a broken bus does not wait
        self.lateness = self.bus.now() - deadline
        missed = max(0, int(self.lateness // self.machine.dt))
        if missed:
            self.history = self.measured = None  # its samples must be a tick apart
        self.deadline_number += 1 + missed
        self.ticks += 1
