"""The commands at a machine, simulated or real, and for what was recorded there."""

import logging
import os
import struct
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tyro.conf import Positional

from brokk_min import hw
from brokk_min._files import require_package
from brokk_min.actuator import ActuatorNet
from brokk_min.beyond.adaptation import Adaptive, valves
from brokk_min.can.connection import open_bus
from brokk_min.can.drive_log import OTHERS
from brokk_min.can.operator_input import JointJog, Joystick, Script, read_commands
from brokk_min.can.simulated_machine import parse_fault, run_machine
from brokk_min.cli.options import (
    Command,
    as_wrong_use,
    check,
    default_policy,
    find_plant,
    own_controller,
)
from brokk_min.evaluation.baselines import OPTIMISED, STRONGEST, baselines, load_pids
from brokk_min.evaluation.rollout import title
from brokk_min.identification.columns import TABLES
from brokk_min.identification.valve_report import describe, load_known, save_known
from brokk_min.learning.policy import load_policy
from brokk_min.machine import PWM_MAX, Controller, Machine, require
from brokk_min.shadow import Shadow

PIDS = {"jacobian": OPTIMISED, "strongest": STRONGEST}  # by their names in --controller


@dataclass(kw_only=True)
class Simulate(Command):
    """Put a simulated machine on a CAN bus: encoders, a valve controller, a plant behind them."""

    interface: str  # python-can's name of the bus, udp_multicast for a try without hardware.
    channel: str  # Channel of the interface, for udp_multicast 239.74.163.2.
    plant: str = "analytic"  # What moves, nets (.npz) or FILE.py:NAME, stepped once a tick.
    fault: tuple[str, ...] = ()  # [JOINT:]KIND@SECONDS, as q3:stuck@5 ok@8; see docs/hardware.md.

    def __call__(self, machine: Machine) -> None:
        with as_wrong_use():
            faults = [fault for text in self.fault for fault in parse_fault(machine, text)]
        plant = find_plant(self.plant, machine)
        run_machine(machine, self.interface, self.channel, plant, faults)


@dataclass(kw_only=True)
class DriveMachine(Command):
    """Drive a machine on a CAN bus at its rate; not a safety function, see docs/hardware.md."""

    interface: str  # python-can's name of the bus: socketcan, udp_multicast, ...
    channel: str  # Channel of the interface: can0, 239.74.163.2, ...
    policy: Path | None = None  # Policy that `train` wrote; PIDs: gains.json beside it, or ours.
    command: str = ""  # joystick, the default, or a CSV: sequence,time,vx,vy,vz [s, m/s].
    shadow: bool = False  # Send nothing: show what would be sent beside what others send.
    sync: bool = False  # With --shadow, send SYNC and start the nodes all the same.
    controller: str = "rl"  # Policy; jacobian or strongest, PIDs; jog, one joint; FILE.py:NAME.
    joint: str = ""  # Joint that jogs, forward and backward with x.
    counts: int = 12  # Its command, of 127; a little beyond the dead zone.
    axes: tuple[int, int, int] = (1, 0, 4)  # Axes of the joystick for x, y and z.
    button: int = 5  # Button of the joystick that must be held.
    adapt: bool = False  # Learn how the valves differ from those of the logs, and allow for it.
    valves: Path | None = None  # Begin with what this JSON file knows of them, and keep it there.
    log: Path | None = None  # Also log every frame here, candump format.

    def __call__(self, machine: Machine) -> None:
        new = None if self.valves and self.valves.exists() else self.valves
        used = default_policy(machine, self.policy) if self.controller != "jog" else ()
        self.writes(self.log, new, reads=[Path(self.command), *used])
        kept = self.valves is None or os.access(self.valves.resolve().parent, os.W_OK)
        check(kept, str(self.valves), "a file in a writable folder", "another")
        learns = self.adapt or self.shadow
        check(learns or not self.valves, "--valves", "--adapt or --shadow with it", self.valves)
        nets = self.controller != "jog" or not (self.adapt or self.valves)
        check(nets, "--adapt, --valves", "a controller that has nets", "jog")
        check(self.shadow or not self.sync, "--sync", "--shadow with it", "a drive that sends SYNC")
        text = self.log is None or self.log.suffix.lower() not in (*TABLES, *OTHERS)
        check(text, "--log", "a name as run.log: it is candump's text", self.log)
        controller, operator = self.find_controller(machine), self.find_operator(machine)
        loaded = controller.known if isinstance(controller, Adaptive) else None
        with open_bus(self.interface, self.channel, self.log) as bus:
            print(f"{machine.name} (--machine) on {self.interface} {self.channel}", flush=True)
            if self.shadow:
                drive: hw.Drive = Shadow(machine, controller, bus, operator, self.sync)
            else:
                drive = hw.Drive(machine, controller, bus, operator)
            try:
                drive.begin()
                drive.run(show)
            finally:
                if isinstance(controller, Adaptive) and controller.known is not loaded:
                    self.keep_valves(machine, controller)  # of which it has learned
        if isinstance(drive, Shadow):
            print(drive.report())
        played = not isinstance(operator, Script) or operator.done
        busy = " (a busy computer? chrt -f 10 before the command)" if "late" in drive.reason else ""
        require(played, "drive", "to play all sequences", f"{drive.reason or 'a stop'}{busy}")

    def find_controller(self, machine: Machine) -> Controller:
        """The controller that is named."""
        if self.controller != "jog":
            found, net = find_controller(machine, self.policy, PIDS.get(self.controller))
            if self.controller not in ("rl", *PIDS):
                found = own_controller(self.controller, machine, net)
            if not (self.adapt or self.shadow):
                return found
            old = self.valves if self.valves and self.valves.exists() else None
            known = load_known(old, machine, net) if old else None
            return Adaptive(found, net, machine, known, self.adapt)
        driven = [machine.names[i] for i in machine.driven]
        check(self.joint in driven, "--joint", f"one of {driven}", self.joint)
        limit = machine.pwm_limit
        check(0 < self.counts <= limit, "--counts", f"1 to {limit}", self.counts)
        return JointJog(machine, self.joint, self.counts / PWM_MAX)

    def keep_valves(self, machine: Machine, controller: Adaptive) -> None:
        """Write what is known of the valves to `valves`, and print it, if somebody reads."""
        assert controller.known is not None  # it has learned
        if self.valves:
            save_known(self.valves, machine, controller.net, controller.known)
        print(*describe(machine, controller.known), sep="\n")

    def find_operator(self, machine: Machine) -> Any:
        """The joystick, or the script of a file; None: a shadow follows the tool."""
        if self.shadow and not self.command:
            return None
        if self.command in ("", "joystick"):
            return Joystick(machine, self.axes, self.button)
        goals = read_commands(Path(self.command), machine)
        return Script(machine, np.concatenate([*goals.values()]))


def find_controller(
    machine: Machine, policy: Path | None, pid: str | None
) -> tuple[Controller, ActuatorNet]:
    """The policy, or a PID with the gains that there are (or by hand without); and their nets."""
    path, gains = default_policy(machine, policy)
    found = load_policy(path, machine)
    if not pid:
        return found, found.net
    print(f"gains of the PID: {gains or 'set by hand'}")
    pids = load_pids(machine, gains, found.net) if gains else baselines(machine, found.net)
    return pids[pid], found.net


def show(drive: hw.Drive) -> None:
    """Print the status, and log what is known of the valves."""
    print(status(drive), flush=True)
    if isinstance(drive.controller, Adaptive) and drive.controller.known:
        pairs = np.stack(valves(drive.controller.known), axis=-1)[0]  # (n_driven, 2, 2)
        for i, of in zip(drive.machine.driven, pairs.reshape(len(pairs), 4)):
            packed = struct.pack("<hhhh", *np.rint(1e4 * of).astype(int))
            drive.attempt(drive.bus.log_valves, int(i), packed)


def status(drive: hw.Drive) -> str:
    """One line: state, faults, goal and measured tool velocity [m/s], angles [rad], lateness."""
    driving, v_goal = drive.gate.driving, drive.operator_input.v_goal
    active = str(drive.gate.active_fault)
    words = ["driving" if driving else "waiting" if active else "ready", drive.reason]
    if active not in drive.reason:
        words.append(f"now {active}")  # what is in the way
    if isinstance(drive.operator, Joystick) and any(v_goal) and not driving:
        axes = [str(axis) for axis, v in zip(drive.operator.axes, v_goal) if v]
        words.append("the stick is not centred: axis " + " and ".join(axes))
    vectors: dict[str, Any] = {"v goal": v_goal}
    if measured := drive.measured:
        vectors |= {"measured": measured.v_tool[0], "q": measured.q[0]}
    if isinstance(drive, Shadow) and drive.pairs:
        vectors |= dict(zip(("would send", "sent"), drive.pairs[-1]))
    words += [f"{name} {' '.join(f'{x:+z.2f}' for x in row)}" for name, row in vectors.items()]
    return ", ".join(filter(None, [*words, f"late {1e3 * drive.lateness:.1f} ms"]))


@dataclass(kw_only=True)
class Play(Command):
    """Drive a simulated machine with keyboard or gamepad in a window.

    Arrows move the tool along x (up in the top view) and y, W and S move it up and down, and left
    SHIFT slows it to a third. TAB hands over from the policy to the optimised PID and back; ESC
    ends. On a gamepad the left stick is x and y, the right one z. A black arrow is the goal
    velocity, a green one the measured velocity; below stand the angles within their ranges and
    the valve commands. On a busy computer the machine moves slower than life.
    """

    policy: Path | None = None  # Policy that `train` wrote; PIDs: gains.json beside it, or ours.
    plant: str = "analytic"  # What moves, nets (.npz) or FILE.py:NAME.
    adapt: bool = False  # The controllers learn how the valves differ from those of the logs.

    def __call__(self, machine: Machine) -> None:
        from brokk_min.viewer.play import play

        controllers: dict[str, Controller] = {}
        for name in ("rl", OPTIMISED):
            found, net = find_controller(machine, self.policy, None if name == "rl" else name)
            adaptive = Adaptive(found, net, machine) if self.adapt else found
            controllers[title(f"{name}+cold" if self.adapt else name)] = adaptive
        play(machine, controllers, find_plant(self.plant, machine))


@dataclass(kw_only=True)
class Replay(Command):
    """Make a film of a drive from its log."""

    log: Positional[Path]  # That `drive --log` wrote.
    out: Path  # File to write, .gif.

    def __call__(self, machine: Machine) -> None:
        from brokk_min.viewer.replay import film

        self.writes(self.out)
        check(self.out.suffix == ".gif", "--out", "a name in .gif", self.out)
        film(self.log, machine, self.out)


@dataclass(kw_only=True)
class Export(Command):
    """Write a policy as one ONNX file, to be run elsewhere."""

    policy: Path  # Policy that `train` wrote.
    out: Path  # File to write, .onnx.

    def __call__(self, machine: Machine) -> None:
        for package in ("onnxscript", "torch"):
            require_package(package, "export")
        from brokk_min.learning.onnx import export_onnx

        self.writes(self.out)
        logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # not on what is not needed here
        warnings.filterwarnings("ignore", category=FutureWarning, module="copyreg")  # torch's own
        policy = load_policy(self.policy, machine)
        export_onnx(self.out, policy)
        print(f"{self.out}: observation (batch, obs) in, action (batch, driven joints) out")
        if policy.interface != "paper":
            print("examples/run_onnx.py has the observation of train --paper, not this policy's")
