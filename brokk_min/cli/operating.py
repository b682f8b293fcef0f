"""The commands at a machine, simulated or real, and for what was recorded there."""

import shutil
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from tyro.conf import Positional

from brokk_min import hw
from brokk_min.can.canopen import used_ids
from brokk_min.can.connection import open_bus
from brokk_min.can.operator_input import JointJog, Joystick, Script
from brokk_min.can.safety_gate import fault_name
from brokk_min.can.simulated_machine import simulate
from brokk_min.cli.options import Command, check, default_policy, find_plant
from brokk_min.evaluation import baselines
from brokk_min.evaluation.rollout import TITLES, Controller
from brokk_min.evaluation.sequences import read_commands
from brokk_min.learning.policy import Policy, PolicyController, load_policy
from brokk_min.machine import PWM_MAX, Machine, require

PID = "jacobian_pid_k0.1"  # the paper's, among the baselines


@dataclass(kw_only=True)
class Simulate(Command):
    """Put a simulated machine on a CAN bus: encoders, a valve controller, a plant behind them."""

    interface: str  # python-can's name of the bus, udp_multicast for a try without hardware.
    channel: str  # Channel of the interface, for udp_multicast 239.74.163.2.
    start: tuple[float, ...] = ()  # First angles [rad]; by default the paper's, or mid-range.
    plant: str = "analytic"  # What moves, or FILE.py:NAME, stepped every `plant_dt`.

    def __call__(self) -> None:
        machine = self.find_machine()
        print(f"{self.machine} on {self.interface} {self.channel}; Ctrl-C ends it", flush=True)
        plant = find_plant(self.plant, machine)
        simulate(machine, self.start, self.interface, self.channel, plant)


@dataclass(kw_only=True)
class Drive(Command):
    """Drive a machine on a CAN bus at its rate; not a safety function, see docs/hardware.md."""

    interface: str  # python-can's name of the bus: socketcan, udp_multicast, ...
    channel: str  # Channel of the interface: can0, 239.74.163.2, ...
    policy: Path | None = None  # Policy that `train` wrote; by default the package's.
    command: str = "joystick"  # Or velocity sequences, CSV: sequence,time,vx,vy,vz [s, m/s].
    controller: Literal["rl", "jacobian", "jog"] = "rl"  # Policy, the paper's PID, one joint.
    joint: str = ""  # Joint that jogs, forward and backward with x; by default the first driven.
    counts: int = 0  # Its command, of 127; 0: 3 beyond the dead zone.
    gains: Path | None = None  # Tuned gains; by default gains.json in the folder of POLICY.
    axes: tuple[int, int, int] = (1, 0, 4)  # Axes of the joystick for x, y and z.
    button: int = 5  # Button of the joystick that must be held.
    log: Path | None = None  # Also log every frame here, candump format.

    def __call__(self) -> None:
        machine = self.find_machine()
        self.writes(self.log)
        controller, operator = self.find_controller(machine), self.find_operator(machine)
        with open_bus(self.interface, self.channel, self.log, used_ids(machine)) as bus:
            drive = hw.Drive(machine, controller, bus, operator)
            drive.begin()
            try:
                drive.run(show_status)
            finally:
                print(end="\n" if sys.stdout.isatty() else "")
        played = not isinstance(operator, Script) or operator.done
        require(played, "drive", "to play all sequences", drive.reason or "a stop")

    def find_controller(self, machine: Machine) -> Controller:
        """The controller that is named."""
        if self.controller == "jog":
            return self.find_jog(machine)
        path, gains = default_policy(machine, self.policy, self.gains)
        policy = load_policy(path, machine)
        if self.controller == "rl":
            return PolicyController(machine, policy)
        return find_pid(machine, policy, gains)

    def find_jog(self, machine: Machine) -> JointJog:
        """The controller of one joint."""
        driven = [machine.names[i] for i in machine.driven]
        joint = self.joint or driven[0]
        check(joint in driven, "--joint", f"a driven one of {driven}", joint)
        dead_zone = max(machine.joints[machine.names.index(joint)].dead_zone)
        counts = self.counts or int(np.ceil(dead_zone * PWM_MAX)) + 3
        check(0 < counts <= machine.pwm_limit, "--counts", f"1 to {machine.pwm_limit}", counts)
        return JointJog(machine, joint, counts)

    def find_operator(self, machine: Machine) -> Joystick | Script:
        """The joystick, or the script of a file."""
        if self.command == "joystick":
            return Joystick(machine, self.axes, self.button)
        goals = [sequence.goals for sequence in read_commands(Path(self.command), machine)]
        return Script(machine, np.concatenate(goals))


def find_pid(machine: Machine, policy: Policy, gains: Path | None) -> Controller:
    """The paper's PID with tuned gains, or without a file with those set by hand."""
    print(f"gains of the Jacobian controller: {gains or 'set by hand'}")
    net = policy.net
    known = (
        baselines.read_gains(gains, machine, net) if gains else baselines.baselines(machine, net)
    )
    return known[PID]


def status(drive: hw.Drive) -> str:
    """One line: state, faults, goal and measured tool velocity [m/s], angles [rad], lateness."""
    state = "waiting" if drive.gate.active_fault else "ready  "
    state = "driving" if drive.gate.driving else state
    reason = f" {drive.reason}" if drive.reason else ""
    active = fault_name(drive.machine, int(drive.gate.active_fault))
    reason += f", now {active}" if active not in drive.reason else ""  # what is in the way
    vectors = {"v goal": drive.operator_input.v_goal}
    if measured := drive.measured:
        vectors |= {"measured": measured.v_tool[0], "q": measured.q[0]}
    texts = (f"{name} {' '.join(f'{x:+.2f}' for x in row)}" for name, row in vectors.items())
    late = f"late {1e3 * drive.lateness:.1f} ms, skipped {drive.skipped}"
    return f"{state}{reason} {' '.join(texts)} {late}"


def show_status(drive: hw.Drive) -> None:
    """Rewrite one line of a terminal, cut to its width; elsewhere print a line each time."""
    terminal, text = sys.stdout.isatty(), status(drive)
    line = f"\r{text[: shutil.get_terminal_size().columns - 1]}\033[K"
    print(line if terminal else text, end="" if terminal else "\n", flush=True)


@dataclass(kw_only=True)
class Play(Command):
    """Drive a simulated machine with keyboard or gamepad in a window; see docs/play.md."""

    policy: Path | None = None  # Policy that `train` wrote; by default the package's.
    gains: Path | None = None  # Tuned gains; by default gains.json in the folder of POLICY.
    start: tuple[float, ...] = ()  # First angles [rad]; by default the paper's, or mid-range.
    plant: str = "analytic"  # What moves, or FILE.py:NAME.

    def __call__(self) -> None:
        from brokk_min.viewer.play import play

        machine = self.find_machine()
        controllers = self.find_controllers(machine)
        play(machine, controllers, self.start, find_plant(self.plant, machine))

    def find_controllers(self, machine: Machine) -> dict[str, Controller]:
        """The policy and the paper's PID, by the names that the window shows."""
        path, gains = default_policy(machine, self.policy, self.gains)
        policy = load_policy(path, machine)
        pid = find_pid(machine, policy, gains)
        return {TITLES["rl"]: PolicyController(machine, policy), TITLES[PID]: pid}


@dataclass(kw_only=True)
class Replay(Command):
    """Watch recorded runs at once: logs of `drive --log`, or results of `evaluate --json`."""

    logs: Positional[tuple[Path, ...]]  # One or two of them.
    out: Path | None = None  # Write a film, .gif or .mp4, instead of opening a window.
    fps: float = 10.0  # Pictures per second of the film.
    sequence: str = ""  # Which sequence of the results; by default the first.
    start: int = 0  # Which start of the results.

    def __call__(self) -> None:
        from brokk_min.viewer.replay import film

        machine = self.find_machine()
        self.writes(self.out)
        check(1 <= len(self.logs) <= 2, "LOGS", "one or two", len(self.logs))
        check(0.1 <= self.fps <= 100, "--fps", "0.1 to 100", self.fps)
        film(self.logs, machine, self.out, self.fps, self.sequence, self.start)


@dataclass(kw_only=True)
class Export(Command):
    """Write a policy as one ONNX file, to be run elsewhere."""

    policy: Path  # Policy that `train` wrote.
    out: Path  # File to write, .onnx.

    def __call__(self) -> None:
        from brokk_min.learning.onnx import export_onnx

        machine = self.find_machine()
        self.writes(self.out)
        export_onnx(self.out, load_policy(self.policy, machine), machine)
        print(f"{self.out}: observation (batch, obs) in, action (batch, driven joints) out")
