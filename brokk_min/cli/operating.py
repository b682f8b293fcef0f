"""The commands at a machine, simulated or real, and for what was recorded there."""

import shutil
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from tyro.conf import Positional

from brokk_min import hw
from brokk_min.actuator import Valves
from brokk_min.can import diagnosis, drive_log
from brokk_min.can.canopen import used_ids
from brokk_min.can.connection import has_real_time_priority, lock_memory, open_bus
from brokk_min.can.dbc import dbc
from brokk_min.can.drive_log import read_frames
from brokk_min.can.operator_input import JointJog, Joystick, Script
from brokk_min.can.simulated_machine import simulate
from brokk_min.cli.options import Command, PlantName, WrongUse, default_policy, with_plant
from brokk_min.evaluation import baselines
from brokk_min.evaluation.rollout import Controller
from brokk_min.evaluation.sequences import read_commands
from brokk_min.identification.files import located, whole_file, write_json
from brokk_min.identification.logs import write_log
from brokk_min.kinematics import UNITS
from brokk_min.learning.onnx import export_onnx
from brokk_min.learning.policy import Policy, PolicyController, load_policy
from brokk_min.machine import PWM_MAX, Machine, number
from brokk_min.viewer import control_process, drawing, play, replay, rerun_log


@dataclass(kw_only=True)
class Simulate(Command):
    """Put a simulated machine on a CAN bus: encoders, valve controller, a plant behind them."""

    interface: str  # python-can's name of the bus, udp_multicast for a try without hardware.
    channel: str  # Channel of the interface, for udp_multicast 239.74.163.2.
    start: tuple[float, ...] = ()  # First angles [rad]; by default the paper's, or mid-range.
    record: Path | None = None  # Also log commands and true angles of each plant step, .csv.
    plant: PlantName = "analytic"  # What moves, every `plant_dt`: or an object of your file.

    def __call__(self) -> None:
        machine = with_plant(self.check(record="plant record"), self.plant, ["analytic"])
        print(f"{self.machine} on {self.interface} {self.channel}; Ctrl-C ends it", flush=True)
        simulate(machine, self.start, self.interface, self.channel, self.record)


@dataclass(kw_only=True)
class Drive(Command):
    """Drive a machine on a CAN bus at its rate; not a safety function, see docs/hardware.md."""

    policy: Path | None = None  # Policy that `train` wrote.
    interface: str = ""  # python-can's name of the bus: socketcan, udp_multicast, ...
    channel: str = ""  # Channel of the interface: can0, 239.74.163.2, ...
    command: str = "joystick"  # Or velocity sequences, CSV: sequence,time,vx,vy,vz [s, m/s].
    controller: Literal["rl", "jacobian", "jog"] = "rl"  # Policy, baseline (k = 0.1), one joint.
    joint: str = ""  # Joint that jogs, forward and backward with x; by default the first driven.
    counts: int = number("counts", 0, 127, 0)  # Its command, of 127; 0: 3 beyond the dead zone.
    gains: Path | None = None  # Tuned gains; by default gains.json in the folder of POLICY.
    valves: Valves | None = None  # While the tool rests, instead of the controller's rule.
    axes: tuple[int, int, int] = (1, 0, 4)  # Axes of the joystick for x, y and z.
    button: int = 5  # Button of the joystick that must be held.
    log: Path | None = None  # Also log every frame here, candump format.
    replay: Path | None = None  # No bus: run on this log and compare its valve frames.

    def __call__(self) -> None:
        machine = self.check(log="drive log")
        if not self.replay and not (self.interface and self.channel):
            raise WrongUse("--interface, --channel: expected a CAN bus, or --replay, got none")
        controller = self._controller(machine)
        if self.replay:
            compare(machine, controller, self.replay)
            return
        operator = self._operator(machine)
        with open_bus(self.interface, self.channel, self.log, used_ids(machine)) as bus:
            drive = hw.Drive(machine, controller, bus, operator)
            drive.begin()
            if not (lock_memory() and has_real_time_priority()):
                warning = "other work may make ticks late and end the drive (docs/hardware.md)"
                print(f"drive: no real-time priority: {warning}", file=sys.stderr)
            try:
                drive.run(show_status)
            finally:
                print(end="\n" if sys.stdout.isatty() else "")
        if isinstance(operator, Script) and not operator.done:
            reason = drive.reason or "a stop"
            raise ValueError(f"drive: expected to play all sequences, got {reason}")

    def _controller(self, machine: Machine) -> Controller:
        if self.controller == "jog":
            if self.valves:
                raise WrongUse(f"--valves: expected none with --controller jog, got {self.valves}")
            driven = [machine.names[i] for i in machine.driven]
            joint = self.joint or driven[0]
            if joint not in driven:
                raise WrongUse(f"--joint: expected a driven one of {driven}, got {joint}")
            dead_zone = machine.dead_zones[machine.names.index(joint)].max()
            counts = self.counts or int(np.ceil(dead_zone * PWM_MAX)) + 3
            if counts > machine.pwm_limit:
                raise WrongUse(f"--counts: expected at most {machine.pwm_limit}, got {counts}")
            return JointJog(machine, joint, counts)
        if not self.policy:
            raise WrongUse("--policy: expected a policy that `train` wrote, got none")
        policy = load_policy(self.policy, machine)
        if self.controller == "rl":
            return PolicyController(machine, replace(policy, valves=self.valves or policy.valves))
        gains = self.gains or self.policy.with_name("gains.json")
        pid = baselines.read_gains(gains, machine, policy.net)["jacobian_pid_k0.1"]
        return replace(pid, valves=self.valves or pid.valves)

    def _operator(self, machine: Machine) -> Joystick | Script:
        if self.command == "joystick":
            return Joystick(machine, self.axes, self.button)
        goals = [sequence.goals for sequence in read_commands(Path(self.command), machine)]
        return Script(machine, np.concatenate(goals))


def compare(machine: Machine, controller: Controller, log: Path) -> None:
    """Run a controller on a log; ValueError: not all its valve frames are those of the log."""
    with located(log):
        same, sent = drive_log.replay(machine, controller, read_frames(log))
    print(f"{log}: {same} of {sent} valve frames are the same")
    if same < sent:
        raise ValueError(f"{log}: expected the frames of the log, got {sent - same} others")


def show_status(drive: hw.Drive) -> None:
    """Rewrite one line of a terminal, cut to its width; elsewhere print a line each time."""
    text = drive_log.status(drive)
    if sys.stdout.isatty():
        columns = shutil.get_terminal_size().columns
        print(f"\r{text[: columns - 1]}\033[K", end="", flush=True)
    else:
        print(text, flush=True)


@dataclass(kw_only=True)
class Convert(Command):
    """Turn a log of `drive` into one for `fit`: one recording per stretch without a gap."""

    log: Positional[Path]  # Log that `drive --log` or candump wrote.
    out: Path  # Log to write, .csv or .npz.

    def __call__(self) -> None:
        machine = self.check(out="recording")
        with located(self.log):
            log = drive_log.log_for_fit(machine, read_frames(self.log))
        write_log(self.out, log)
        print(f"{self.out}: {len(log.recordings)} recordings of {', '.join(log.joints)}")


@dataclass(kw_only=True)
class Diagnose(Command):
    """Why does it shake? A log of `drive` against its policy and nets; names what differs."""

    log: Positional[Path]  # Log that `drive --log` wrote.
    policy: Path  # Policy that drove.
    valves: Valves | None = None  # As in `drive`.
    json: Path | None = None  # Also write all terms here.
    figure: Path | None = None  # Also draw commands and velocities with the expected ones, .png.

    def __call__(self) -> None:
        machine = self.check(json="diagnosis", figure="picture")
        policy = load_policy(self.policy, machine)
        policy = replace(policy, valves=self.valves or policy.valves)
        with located(self.log):
            ticks = diagnosis.read_ticks(machine, read_frames(self.log))
        terms = diagnosis.diagnose(machine, policy, ticks)
        print(f"{self.log}: {len(ticks.time)} ticks; error that is left if a term was so:")
        for term in terms[:5]:
            print(f"  {term.side}: {term.name} ({term.error / term.before:.0%})")
        history = diagnosis.measured_history(machine, ticks)
        error = diagnosis.command_error(machine, policy, ticks, history)
        if error > diagnosis.COMMAND_ERROR and not any(t.side == "commands" for t in terms):
            cause = "no term explains it: another policy, controller or --valves?"
            print(f"  commands are off by {error:.1%} of full command, {cause}")
        elif not terms:
            print("  commands and motion are as the policy and its nets have them")
        if self.json:
            meta = {"log": str(self.log), "policy": str(self.policy), "valves": policy.valves}
            rows = [term._asdict() for term in terms]
            write_json(self.json, {"meta": meta, "command_error": error, "terms": rows})
        if self.figure:
            draw_drive(self.figure, machine, policy, ticks)


def draw_drive(path: Path, machine: Machine, policy: Policy, ticks: diagnosis.Ticks) -> None:
    """Of each driven joint: sent and expected command, measured and simulated velocity."""
    from brokk_min.evaluation import figures

    history = diagnosis.measured_history(machine, ticks)
    expected = diagnosis.expected_commands(machine, policy, ticks, history)
    simulated, measured = diagnosis.net_velocities(machine, policy, ticks.u, ticks.q)
    time = ticks.time - ticks.time[0]
    later = time[machine.history + 1 :][: simulated[..., 0].size]
    rows = []
    for k, j in enumerate(machine.driven):
        joint = machine.joints[j]
        u = {"measured": (time, ticks.u[:, j]), "expected": (time, expected[:, j])}
        values = {"measured": measured, "expected": simulated}
        q_dot = {label: (later, x[..., k].T.ravel()) for label, x in values.items()}
        command = figures.Panel("", "time [s]", f"command of {joint.name} [1]", u)
        label = f"{joint.name} [{UNITS[joint.kind]}/s]"
        rows.append([command, figures.Panel("", "time [s]", label, q_dot)])
    figures.save(path, figures.plot_panels(rows))


@dataclass(kw_only=True)
class Dbc(Command):
    """Write the frames of a machine's bus as a DBC file, for other tools."""

    out: Path  # File to write, .dbc.

    def __call__(self) -> None:
        text = dbc(self.check(out="DBC"))
        with whole_file(self.out, "w") as file:
            file.write(text)
        print(f"{self.out}: {text.count('BO_ ')} messages")


@dataclass(kw_only=True)
class Export(Command):
    """Write a policy as one ONNX file, to be run elsewhere."""

    policy: Path  # Policy that `train` wrote.
    out: Path  # File to write, .onnx.

    def __call__(self) -> None:
        machine = self.check(out="ONNX")
        export_onnx(self.out, load_policy(self.policy, machine), machine)
        print(f"{self.out}: observation (batch, obs) in, action (batch, driven joints) out")


@dataclass(kw_only=True)
class Play(Command):
    """Drive with keyboard or gamepad in a window, and trace lines; see docs/play.md."""

    policy: Path | None = None  # By default the package's; a machine without one has levers only.
    gains: Path | None = None  # Tuned gains; by default gains.json in the folder of POLICY.
    interface: str = ""  # python-can's name of a bus; by default a simulated machine.
    channel: str = ""  # Channel of the interface.
    drive: bool = False  # Drive the machine on the bus; without it, nothing is sent there.
    attempts: Path = Path("attempts.csv")  # Table of the traced lines, kept.
    log: Path | None = None  # Also log every frame here, candump format.
    start: tuple[float, ...] = ()  # First angles [rad] of the simulated machine.

    def __call__(self) -> None:
        machine = self.check(attempts="attempts", log="drive log")
        if bool(self.interface) != bool(self.channel) or (self.drive and not self.interface):
            raise WrongUse("--interface, --channel: expected both or, without --drive, none")
        bus = control_process.BusOptions(self.interface, self.channel, self.log, self.start)
        watching = self.interface and not self.drive
        controllers = None if watching else self.controllers(machine)
        play.play(machine, controllers, bus, self.attempts)

    def controllers(self, machine: Machine) -> dict[str, Controller]:
        """The policy and the paper's PID; none if no policy is given and none is shipped."""
        path, gains = default_policy(machine, self.policy, self.gains)
        if not self.policy and not path.exists():
            return {}
        policy = load_policy(path, machine)
        known = baselines.baselines(machine, policy.net)
        if gains:
            known = baselines.read_gains(gains, machine, policy.net)
        print(f"gains of the Jacobian controller: {gains or 'set by hand'}")
        return {"rl": PolicyController(machine, policy), "jacobian": known["jacobian_pid_k0.1"]}


@dataclass(kw_only=True)
class Replay(Command):
    """Watch recorded runs at once: logs of `drive`, or runs of `evaluate`, simulated again."""

    logs: Positional[tuple[Path, ...]]  # One or two: candump logs, or JSON of results.
    out: Path | None = None  # Write a film, .gif or .mp4, instead of opening a window.
    rerun: Path | None = None  # Write all on the timeline of rerun instead, .rrd.
    fps: float = number("1/s", 0.1, 100, 10.0)  # Pictures per second of the film.
    size: tuple[int, int] = (960, 540)  # Width and height [px], 320 to 4000 for each arm.
    controllers: tuple[str, ...] = ("rl", "jacobian_pid_k0.1")  # Whose runs of the results.
    sequence: str = ""  # Which sequence of the results; by default the first.
    start: int = 0  # Which start of the results.

    def __call__(self) -> None:
        machine = self.check(out="film", rerun="rerun")
        if not 1 <= len(self.logs) <= 2:
            raise WrongUse(f"LOGS: expected one or two, got {len(self.logs)}")
        arms = sum(len(self.controllers) if log.suffix == ".json" else 1 for log in self.logs)
        width, height = self.size
        if not arms:
            raise WrongUse("--controllers: expected at least one, got none")
        if not 320 * arms <= width <= 4000 or not 320 <= height <= 4000:
            expected = f"expected {320 * arms} 320 to 4000 4000 for {arms} arms"
            raise WrongUse(f"--size: {expected}, got {width} {height}")
        runs: list[replay.Run] = []
        for log, colour in zip(self.logs, drawing.COLOURS.values(), strict=False):
            if log.suffix == ".json":
                runs += self._simulate_again(machine, log)
            else:
                runs.append(replay.run_of_log(machine, log, colour))
        if self.rerun:
            rerun_log.write_rerun(self.rerun, runs)
        if self.out:
            replay.write_film(self.out, machine, runs, self.size, self.fps)
        elif not self.rerun:
            replay.show_film(machine, runs, self.size)

    def _simulate_again(self, machine: Machine, path: Path) -> list[replay.Run]:
        results = replay.read_results(machine, path, self.controllers)
        sequences = list(results.sequences)
        known = list(results.controllers)
        sequence = self.sequence or sequences[0]
        unknown = sequence not in sequences or not set(self.controllers) <= set(known)
        if unknown or not 0 <= self.start < len(results.starts):
            expected = f"expected some of {sequences}, of {known} and below {len(results.starts)}"
            got = f"got {self.sequence}, {list(self.controllers)}, {self.start}"
            raise WrongUse(f"--sequence, --controllers, --start: {expected}, {got}")
        return replay.simulate_again(machine, results, self.controllers, sequence, self.start)
