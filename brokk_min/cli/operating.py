"""The commands at a machine, simulated or real, and for what was recorded there."""

import shutil
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import tyro

from brokk_min import hw
from brokk_min.can import drive_log
from brokk_min.can import operator_input as wishes
from brokk_min.can.canopen import open_bus, read_frames
from brokk_min.can.simulated_machine import simulate
from brokk_min.cli.options import Command, WrongUse, check, chosen_policy
from brokk_min.evaluation import baselines
from brokk_min.evaluation.rollout import Controller
from brokk_min.evaluation.sequences import read_commands
from brokk_min.identification.logs import write_log
from brokk_min.learning.onnx import export_onnx
from brokk_min.learning.policy import PolicyController, load_policy
from brokk_min.machine import Machine
from brokk_min.viewer import control_process, play, replay
from brokk_min.viewer import drawing as view


@dataclass(kw_only=True)
class Simulate(Command):
    """Put a simulated machine on a CAN bus: encoders, valve controller, the analytic plant behind them."""

    interface: str  # python-can's name of the bus, udp_multicast for a try without hardware.
    channel: str  # Channel of the interface, for udp_multicast 239.74.163.2.
    start: tuple[float, ...] = ()
    """Angles at the start [rad]; by default the paper's, pointing forward, or amid the ranges."""
    record: Path | None = None
    """Also log command in force and true angles at every step of the plant here, .csv."""

    def run(self) -> None:
        """Run until SIGINT or SIGTERM."""
        machine = check(self, self.record)
        print(f"{self.machine} on {self.interface} {self.channel}; Ctrl-C ends it", flush=True)
        simulate(machine, self.start, self.interface, self.channel, self.record)


@dataclass(kw_only=True)
class Drive(Command):
    """Drive a machine on a CAN bus at 20 Hz; not a safety function, see docs/hardware.md."""

    policy: Path | None = None  # Policy that `train` wrote.
    interface: str = ""  # python-can's name of the bus: socketcan, udp_multicast, ...
    channel: str = ""  # Channel of the interface: can0, 239.74.163.2, ...
    command: str = "joystick"
    """joystick, or velocity sequences, CSV: sequence,time,vx,vy,vz [s, m/s]; all of them, one by one."""
    controller: Literal["rl", "jacobian", "jog"] = "rl"
    """The policy, the paper's baseline (k = 0.1), or one joint alone, for bringing up."""
    joint: str = "q1"  # Joint that jogs, forward and backward with x.
    counts: int = 12  # Its command, of 127.
    gains: Path | None = None
    """Tuned gains of the baseline that `reproduce` wrote; by default gains.json beside POLICY."""
    axes: tuple[int, int, int] = (1, 0, 4)  # Axes of the joystick for x, y and z.
    button: int = 5  # Button of the joystick that must be held.
    log: Path | None = None  # Also log every frame here, candump format.
    replay: Path | None = (
        None  # No bus: run on this log and compare the valve frames with those in it.
    )

    def run(self) -> None:
        """Drive until the sequences or the operator end it, or compare a log."""
        machine = check(self, self.log)
        if not self.replay and not (self.interface and self.channel):
            raise WrongUse("--interface, --channel: expected a CAN bus, or --replay, got none")
        controller = self._controller(machine)
        if self.replay:
            frames = list(read_frames(self.replay))
            same, sent = drive_log.compare(
                machine, frames, drive_log.replay(machine, controller, frames)
            )
            print(f"{self.replay}: {same} of {sent} valve frames are the same")
            if same < sent:
                raise ValueError(
                    f"{self.replay}: expected the frames of the log, got {sent - same} others"
                )
            return
        if self.command == "joystick":
            operator: wishes.Joystick | wishes.Script = wishes.Joystick(
                machine, self.axes, self.button
            )
        else:
            sequences = read_commands(Path(self.command), machine)
            operator = wishes.Script(machine, np.concatenate([s.goals for s in sequences]))
        with open_bus(self.interface, self.channel, self.log) as line:
            drive = hw.Drive(machine, controller, line, operator)
            drive.begin()
            try:
                drive.run(_show)
            finally:
                print(end="\n" if sys.stdout.isatty() else "")
        if isinstance(operator, wishes.Script) and not operator.done:
            raise ValueError(
                f"drive: expected to play all sequences, got {drive.reason or 'a stop'}"
            )

    def _controller(self, machine: Machine) -> Controller:
        if self.controller == "jog":
            driven = [machine.names[i] for i in machine.driven]
            if self.joint not in driven:
                raise WrongUse(
                    f"--joint: expected one that may be driven, {driven}, got {self.joint}"
                )
            return wishes.JointJog(machine, self.joint, self.counts)
        if not self.policy:
            raise WrongUse("--policy: expected a policy that `train` wrote, got none")
        policy = load_policy(self.policy, machine)
        if self.controller == "rl":
            return PolicyController(machine, policy)
        gains = self.gains or self.policy.with_name("gains.json")
        return baselines.read_gains(gains, machine, policy.net)["jacobian_pid_k0.1"]


def _show(text: str) -> None:
    """Keep one line of a terminal up to date, cut to its width; elsewhere write a line each time."""
    if sys.stdout.isatty():
        print(f"\r{text[: shutil.get_terminal_size().columns - 1]}\033[K", end="", flush=True)
    else:
        print(text, flush=True)


@dataclass(kw_only=True)
class Convert(Command):
    """Turn a log of `drive` into one that `fit` reads: a recording for each stretch driven without a gap."""

    log: tyro.conf.Positional[Path]  # Log that `drive --log` or candump wrote.
    out: Path  # Log to write, .csv or .npz.

    def run(self) -> None:
        """Write the log."""
        log = drive_log.log_for_fit(check(self, self.out), read_frames(self.log))
        write_log(self.out, log)
        print(f"{self.out}: {len(log.recordings)} recordings of {', '.join(log.joints)}")


@dataclass(kw_only=True)
class Export(Command):
    """Write a policy as one ONNX file, to be run elsewhere."""

    policy: Path  # Policy that `train` wrote.
    out: Path  # File to write, .onnx.

    def run(self) -> None:
        """Write the file."""
        export_onnx(self.out, load_policy(self.policy, check(self, self.out)))
        print(f"{self.out}: observation (batch, obs) in, action (batch, driven joints) out")


@dataclass(kw_only=True)
class Play(Command):
    """Drive with keyboard or gamepad in a window, and trace lines; see docs/play.md."""

    policy: Path | None = None
    """Policy that `train` wrote; by default the one that comes with the package; without any, levers only."""
    gains: Path | None = (
        None  # Tuned gains of the Jacobian controller; by default gains.json beside POLICY.
    )
    interface: str = (
        ""  # python-can's name of a bus; without one a simulated machine stands behind.
    )
    channel: str = ""  # Channel of the interface.
    drive: bool = False  # Drive the machine on the bus; without it, nothing is sent there.
    attempts: Path = Path("attempts.csv")  # Table of the traced lines, kept.
    log: Path | None = None  # Also log every frame here, candump format.
    start: tuple[float, ...] = ()
    """Angles of the simulated machine at the start [rad]; by default the paper's, or amid the ranges."""

    def run(self) -> None:
        """Open the window until it is closed."""
        machine = check(self, self.attempts, self.log)
        if bool(self.interface) != bool(self.channel) or (self.drive and not self.interface):
            raise WrongUse("--interface, --channel: expected both or, without --drive, none")
        where = control_process.BusOptions(self.interface, self.channel, self.log, self.start)
        if self.interface and not self.drive:
            play.watch(machine, where)
            return
        controllers: dict[str, Controller] = {}
        path, gains = chosen_policy(machine, self.policy, self.gains)
        if self.policy or path.exists():
            policy = load_policy(path, machine)
            known = baselines.read_gains(gains, machine, policy.net) if gains else None
            known = known or baselines.baselines(machine, policy.net)
            controllers = {
                "rl": PolicyController(machine, policy),
                "jacobian": known["jacobian_pid_k0.1"],
            }
            print(f"gains of the Jacobian controller: {gains or 'set by hand'}", file=sys.stderr)
        play.play(machine, controllers, where, self.attempts)


@dataclass(kw_only=True)
class Replay(Command):
    """Watch recorded runs side by side: logs of `drive`, or runs of `evaluate`, driven again."""

    logs: tyro.conf.Positional[tuple[Path, ...]]  # One or two: candump logs, or JSON of results.
    out: Path | None = None  # Write a film, .gif or .mp4, instead of opening a window.
    fps: float = 10.0  # Pictures a second of the film.
    size: tuple[int, int] = (960, 540)  # Of the picture [px], 320 to 4000 both ways for each arm.
    controllers: tuple[str, ...] = ("rl", "jacobian_pid_k0.1")  # Whose runs of the results.
    sequence: str = ""  # Which sequence of the results; by default the first.
    start: int = 0  # Which start of the results.

    def run(self) -> None:
        """Open the window until it is closed, or write the film."""
        machine, colours = check(self, self.out), view.COLOURS.values()
        if not 1 <= len(self.logs) <= 2:
            raise WrongUse(f"LOGS: expected one or two, got {len(self.logs)}")
        arms = sum(len(self.controllers) if log.suffix == ".json" else 1 for log in self.logs)
        if not arms or not 320 * arms <= self.size[0] <= 4000 or not 320 <= self.size[1] <= 4000:
            raise WrongUse(
                f"--controllers, --size: expected some and {320 * arms} 320 to 4000 4000, "
                f"got {arms} and {self.size[0]} {self.size[1]}"
            )
        runs = list[replay.Run]()
        for log, colour in zip(self.logs, colours, strict=False):
            again = log.suffix == ".json"
            runs += (
                self._again(machine, log) if again else [replay.run_of_log(machine, log, colour)]
            )
        if self.out:
            replay.write_film(self.out, machine, runs, self.size, self.fps)
        else:
            replay.show_film(machine, runs, self.size)

    def _again(self, machine: Machine, path: Path) -> list[replay.Run]:
        results = replay.read_results(machine, path, self.controllers)
        named, known, num = list(results.sequences), list(results.controllers), len(results.starts)
        sequence = self.sequence or named[0]
        if sequence not in named or set(self.controllers) - set(known) or not 0 <= self.start < num:
            raise WrongUse(
                f"--sequence, --controllers, --start: expected some of {named}, of {known} "
                f"and below {num}, got {self.sequence}, {list(self.controllers)}, {self.start}"
            )
        return replay.simulate_again(machine, results, self.controllers, sequence, self.start)
