"""The command line: `brokk-min COMMAND --help`. Exits 0 done, 1 failed, 2 wrong use."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro

from brokk_min import experiments, hw
from brokk_min.actuator import FitConfig, collect, fit, load_net, save_net, score
from brokk_min.bus import open_line, read_frames
from brokk_min.env import Controller, TaskConfig, fitting_nets
from brokk_min.export import export_onnx
from brokk_min.logs import Log, read_log, write_log
from brokk_min.machine import BROKK_170
from brokk_min.policy import PolicyController, load_policy
from brokk_min.ppo import PPOConfig, train
from brokk_min.simulator import simulate

MACHINES = {BROKK_170.name: BROKK_170}
Name = Literal["brokk170"]


class WrongUse(ValueError):
    """Options that cannot be meant; exit status 2."""


# What each option may be; both ends included.
ALLOWED: dict[str, tuple[float, float]] = {
    "seed": (0, 2**31 - 1),
    "hours": (1e-4, 100),
    "velocity_samples": (2, 100),
    "history": (2, 1000),
    "steps": (1, 10**7),
    "batch_size": (1, 10**6),
    "hidden": (1, 4096),
    "learning_rate": (1e-9, 1),
    "noise": (0, 10),
    "total_steps": (1, 10**12),
    "num_envs": (1, 10**6),
    "horizon": (1, 10**5),
    "epochs": (1, 1000),
    "minibatch_size": (2, 10**7),
    "gamma": (0, 0.9999),
    "gae_lambda": (0, 1),
    "target_kl": (1e-9, 1e9),
    "clip": (1e-6, 1e3),
    "entropy": (0, 1e3),
    "max_grad_norm": (1e-9, 1e9),
    "log_std": (-10, 3),
    "checkpoint_every": (1, 10**9),
    "threads": (1, 1024),
    "episode_s": (0.05, 1e6),
    "hold_min_s": (0, 1e6),
    "hold_max_s": (0, 1e6),
    "zero_goals": (0, 1),
    "axis_goals": (0, 1),
    "valve_cost": (0, 10),
    "counts": (1, 127),
}


def check(command: Any, outputs: tuple[Path | None, ...] = ()) -> None:
    """Refuse options that cannot be meant and outputs that cannot be written, before any work."""
    for owner in (command, *(getattr(command, n) for n in ("settings", "task") if hasattr(command, n))):
        for name, value in vars(owner).items():
            low, high = ALLOWED.get(name, (None, None))
            if low is not None and high is not None and not low <= value <= high:
                option = name.replace("_", "-")
                raise WrongUse(f"--{option}: expected {low} to {high}, got {value}")
    for path in outputs:
        if path and (path.is_dir() or not os.access(path.parent, os.W_OK)):
            raise WrongUse(f"{path}: expected a file in an existing, writable directory")


@dataclass
class Collect:
    """Record the machine (the analytic plant) under excitation."""

    out: Path
    """Log to write, .csv or .npz."""
    hours: float = 1.0
    """Driving time for each actuator [h]."""
    excitation: Literal["sine", "rich"] = "rich"
    """The paper's sines, or sines, steps, holds and pauses over a wide band."""
    machine: Name = "brokk170"
    """Which machine."""
    seed: int = 0
    """Of everything random."""

    def run(self) -> None:
        """Write the log."""
        machine = MACHINES[self.machine]
        check(self, (self.out,))
        if self.out.suffix not in (".csv", ".npz"):
            raise WrongUse(f"--out: expected a name ending in .csv or .npz, got {self.out}")
        log = collect(machine, self.hours, self.excitation, np.random.default_rng(self.seed))
        write_log(self.out, log)
        print(f"{self.out}: {len(log.recordings)} recordings of {', '.join(log.joints)}")


@dataclass
class Fit:
    """Fit one net a joint to the log of any machine and score it on recordings it never saw."""

    logs: tyro.conf.Positional[tuple[Path, ...]]
    """Logs of one machine, .csv or .npz."""
    out: Path
    """Nets to write, .npz."""
    test: tuple[Path, ...] = ()
    """Logs to score on; without them every tenth recording of LOGS is held out."""
    json: Path | None = None
    """Also write the scores here."""
    velocity_samples: int = BROKK_170.velocity_samples
    """Window of the velocity estimator [samples at 20 Hz]."""
    settings: tyro.conf.OmitArgPrefixes[FitConfig] = field(default_factory=FitConfig)
    """How the nets are fitted."""
    seed: int = 0
    """Of everything random."""

    def run(self) -> None:
        """Fit, score, write."""
        if not self.logs:
            raise WrongUse("LOGS: expected at least one log, got none")
        check(self, (self.out, self.json))
        if self.velocity_samples > self.settings.history:
            raise WrongUse(f"--velocity-samples: expected at most --history, got {self.velocity_samples}")
        log = read_log(self.logs, self.velocity_samples)
        if self.test:
            test = read_log(self.test, self.velocity_samples, log.joints)
        else:
            log, test = _hold_out(log)
        known = [machine.name for machine in MACHINES.values() if machine.names == log.joints]
        net = fit(log, self.settings, self.seed, self.velocity_samples, "".join(known))
        save_net(self.out, net)
        joints = score(net, test)
        meta: dict[str, Any] = {"logs": [str(p) for p in self.logs], "test": [str(p) for p in self.test]}
        meta |= {"seed": self.seed, "rate": net.rate, "history": net.history}
        if self.json:
            experiments.write_json(self.json, {"meta": meta, "joints": joints})
        print(f"{'joint':12} one step  same as last  free run of 1, 5, 10, 30 s [rad/s]")
        for name, s in joints.items():
            free = ", ".join(f"{run['velocity_rmse']:.4f}" for run in s["free_run"].values())
            print(f"{name:12} {s['one_step_rmse']:8.4f}  {s['persistence_rmse']:12.4f}  {free}")


def _hold_out(log: Log) -> tuple[Log, Log]:
    """Every tenth recording for the test, whole; a log with one recording cannot be split."""
    held = set(range(0, len(log.recordings), 10)) if len(log.recordings) > 1 else set()
    if not held:
        raise ValueError("LOGS: expected two or more recordings, or --test, to score on; got one")
    parts = [[r for i, r in enumerate(log.recordings) if (i in held) == side] for side in (False, True)]
    return log._replace(recordings=tuple(parts[0])), log._replace(recordings=tuple(parts[1]))


@dataclass
class Train:
    """Train a policy on nets with PPO."""

    actuator: Path
    """Nets that `fit` wrote."""
    out: Path
    """Policy to write, .npz."""
    resume: bool = False
    """Take up OUT.checkpoint; the end is the same as without the break."""
    tensorboard: Path | None = None
    """Folder for TensorBoard (extra `tensorboard`)."""
    machine: Name = "brokk170"
    """Which machine."""
    settings: tyro.conf.OmitArgPrefixes[PPOConfig] = field(default_factory=PPOConfig)
    """The learner."""
    task: tyro.conf.OmitArgPrefixes[TaskConfig] = field(default_factory=TaskConfig)
    """What an episode is."""
    seed: int = 0
    """Of everything random."""

    def run(self) -> None:
        """Train and write the policy."""
        check(self, (self.out,))
        if self.task.hold_min_s > self.task.hold_max_s:
            raise WrongUse(f"--hold-max-s: expected --hold-min-s or more, got {self.task.hold_max_s}")
        machine = MACHINES[self.machine]
        net = fitting_nets(machine, load_net(self.actuator))
        train(machine, net, self.task, self.settings, self.seed, self.out, self.resume, self.tensorboard)
        print(f"{self.out}: trained for {self.settings.total_steps} steps; curve in {self.out}.csv")


@dataclass
class Evaluate:
    """Policy and tuned baselines on the same sequences and starts."""

    policy: Path
    """Policy that `train` wrote."""
    commands: Path | None = None
    """Velocity sequences, CSV: sequence,time,vx,vy,vz [s, m/s]."""
    starts: Path | None = None
    """Start poses, CSV: one column a joint [rad]."""
    plant: Literal["analytic", "net"] = "analytic"
    """What moves: the analytic plant or the nets."""
    json: Path | None = None
    """Also write all runs here."""
    gains: Path | None = None
    """Tuned gains that `reproduce` wrote; by default gains.json beside POLICY, else they are tuned."""
    machine: Name = "brokk170"
    """Which machine."""
    seed: int = 0
    """Of noise, starts and tuning."""

    def run(self) -> None:
        """Evaluate and print the means."""
        check(self, (self.json,))
        machine = MACHINES[self.machine]
        policy = load_policy(self.policy, machine)
        sequences = experiments.axis_sequences(machine)
        if self.commands:
            sequences = experiments.read_commands(self.commands, machine)
        effort = experiments.Effort()
        if self.starts:
            starts = experiments.read_starts(self.starts, machine)
        else:
            rng = np.random.default_rng(self.seed + 2)
            starts = experiments.draw_starts(machine, sequences, effort.starts, rng)
        controllers: dict[str, Controller] = {"rl": PolicyController(machine, policy)}
        gains = self.gains or self.policy.with_name("gains.json")
        if self.gains or gains.exists():
            controllers |= experiments.read_gains(gains, machine, policy.net)
            print(f"gains of the baselines: {gains}", file=sys.stderr)
        else:
            controllers |= experiments.tuned_baselines(machine, policy.net, effort, self.seed)
        moves = policy.net if self.plant == "net" else None
        runs, _ = experiments.task_space(machine, controllers, sequences, starts, self.seed, moves)
        if self.json:
            meta: dict[str, Any] = experiments.meta(machine, self.seed) | {"plant": self.plant}
            experiments.write_json(self.json, {"meta": meta, "runs": runs})
        for name, rows in experiments.summary(runs).items():
            print(f"{name:20} " + ", ".join(f"{k} {v:.4f}" for k, v in rows["all"].items()))


@dataclass
class Reproduce:
    """The whole chain: logs, nets, policy, baselines, comparison, report.html and results.json."""

    out: Path = Path("results")
    """Folder for everything."""
    quick: bool = False
    """The same, smaller: to see that it runs, not to judge the policy."""
    machine: Name = "brokk170"
    """Which machine."""
    seed: int = 0
    """Of everything random."""

    def run(self) -> None:
        """Run the chain and print the means."""
        check(self)
        effort = experiments.QUICK if self.quick else experiments.Effort()
        results = experiments.reproduce(MACHINES[self.machine], self.out, effort, self.seed)
        for name, rows in results["task_space"]["summary"].items():
            errors = ", ".join(f"{s} {row['velocity_error_mean']:.4f}" for s, row in rows.items())
            print(f"{name:20} mean velocity error [m/s]: {errors}")
        print(f"{self.out / 'report.html'}\n{self.out / 'results.json'}")


@dataclass
class Simulate:
    """Put a simulated machine on a CAN bus: encoders, valve controller, the analytic plant behind them."""

    interface: str
    """python-can's name of the bus, udp_multicast for a try without hardware."""
    channel: str
    """Channel of the interface, for udp_multicast 239.74.163.2."""
    start: tuple[float, ...] = (1.5, 0.5, 0.58, 1.71, 1.24)
    """Angles at the start [rad]."""
    record: Path | None = None
    """Also log command in force and true angles at every step of the plant here, .csv."""
    machine: Name = "brokk170"
    """Which machine."""
    seed: int = 0
    """Nothing is random here."""

    def run(self) -> None:
        """Run until SIGINT or SIGTERM."""
        check(self, (self.record,))
        print(f"{self.machine} on {self.interface} {self.channel}; Ctrl-C ends it", flush=True)
        simulate(MACHINES[self.machine], self.start, self.interface, self.channel, self.record)


@dataclass
class Drive:
    """Drive a machine on a CAN bus at 20 Hz; not a safety function, see docs/hardware.md."""

    policy: Path | None = None
    """Policy that `train` wrote."""
    interface: str = ""
    """python-can's name of the bus: socketcan, udp_multicast, ..."""
    channel: str = ""
    """Channel of the interface: can0, 239.74.163.2, ..."""
    command: str = "joystick"
    """joystick, or velocity sequences, CSV: sequence,time,vx,vy,vz [s, m/s]; all of them, one by one."""
    controller: Literal["rl", "jacobian", "jog"] = "rl"
    """The policy, the paper's baseline (k = 0.1), or one joint alone, for bringing up."""
    joint: str = "q1"
    """Joint that jogs, forward and backward with x."""
    counts: int = 12
    """Its command, of 127."""
    gains: Path | None = None
    """Tuned gains of the baseline that `reproduce` wrote; by default gains.json beside POLICY."""
    axes: tuple[int, int, int] = (1, 0, 4)
    """Axes of the joystick for x, y and z."""
    button: int = 5
    """Button of the joystick that must be held."""
    log: Path | None = None
    """Also log every frame here, candump format."""
    replay: Path | None = None
    """No bus: run on this log and compare the valve frames with those in it."""
    machine: Name = "brokk170"
    """Which machine."""
    seed: int = 0
    """Nothing is random here."""

    def run(self) -> None:
        """Drive until the sequences or the operator end it, or compare a log."""
        check(self, (self.log,))
        if not self.replay and not (self.interface and self.channel):
            raise WrongUse("--interface, --channel: expected a CAN bus, or --replay, got none")
        machine, controller = MACHINES[self.machine], self._controller()
        if self.replay:
            frames = list(read_frames(self.replay))
            same, sent = hw.compare(machine, frames, hw.replay(machine, controller, frames))
            print(f"{self.replay}: {same} of {sent} valve frames are the same")
            if same < sent:
                raise ValueError(f"{self.replay}: expected the frames of the log, got {sent - same} others")
            return
        if self.command == "joystick":
            operator: hw.Joystick | hw.Script = hw.Joystick(machine, self.axes, self.button)
        else:
            sequences = experiments.read_commands(Path(self.command), machine)
            operator = hw.Script(machine, np.concatenate([s.goals for s in sequences]))
        with open_line(self.interface, self.channel, self.log) as line:
            drive = hw.Drive(machine, controller, line, operator)
            drive.begin()
            drive.run(_show)
        if isinstance(operator, hw.Script) and not operator.done:
            raise ValueError(f"drive: expected to play all sequences, got {drive.reason or 'a stop'}")

    def _controller(self) -> Controller:
        machine = MACHINES[self.machine]
        if self.controller == "jog":
            if self.joint not in machine.names:
                raise WrongUse(f"--joint: expected one of {', '.join(machine.names)}, got {self.joint}")
            return hw.Jog(machine, self.joint, self.counts)
        if not self.policy:
            raise WrongUse("--policy: expected a policy that `train` wrote, got none")
        policy = load_policy(self.policy, machine)
        if self.controller == "rl":
            return PolicyController(machine, policy)
        gains = self.gains or self.policy.with_name("gains.json")
        return experiments.read_gains(gains, machine, policy.net)["jacobian_pid_k0.1"]


def _show(text: str) -> None:
    """Keep one line of a terminal up to date; elsewhere write a line each time."""
    terminal = sys.stdout.isatty()
    print(f"\r{text}\033[K" if terminal else text, end="" if terminal else "\n", flush=True)


@dataclass
class Convert:
    """Turn a log of `drive` into one that `fit` reads: a recording for each stretch driven without a gap."""

    log: tyro.conf.Positional[Path]
    """Log that `drive --log` or candump wrote."""
    out: Path
    """Log to write, .csv or .npz."""
    machine: Name = "brokk170"
    """Which machine."""
    seed: int = 0
    """Nothing is random here."""

    def run(self) -> None:
        """Write the log."""
        check(self, (self.out,))
        log = hw.driven_log(MACHINES[self.machine], read_frames(self.log))
        write_log(self.out, log)
        print(f"{self.out}: {len(log.recordings)} recordings of {', '.join(log.joints)}")


@dataclass
class Export:
    """Write a policy as one ONNX file, to be run elsewhere."""

    policy: Path
    """Policy that `train` wrote."""
    out: Path
    """File to write, .onnx."""
    machine: Name = "brokk170"
    """Which machine."""
    seed: int = 0
    """Nothing is random here."""

    def run(self) -> None:
        """Write the file."""
        check(self, (self.out,))
        export_onnx(self.out, load_policy(self.policy, MACHINES[self.machine]))
        print(f"{self.out}: observation (batch, obs) in, action (batch, driven joints) out")


COMMANDS: dict[str, Any] = {
    "collect": Collect,
    "fit": Fit,
    "train": Train,
    "evaluate": Evaluate,
    "reproduce": Reproduce,
    "machine": Simulate,
    "drive": Drive,
    "convert": Convert,
    "export": Export,
}


def main(arguments: list[str] | None = None) -> int:
    """Run one command; errors are one line on stderr."""
    command = tyro.extras.subcommand_cli_from_dict(
        COMMANDS,
        prog="brokk-min",
        description=__doc__,
        args=arguments,
        config=(tyro.conf.FlagCreatePairsOff,),
    )
    try:
        command.run()
    except WrongUse as error:
        print(f"brokk-min: {error}", file=sys.stderr)
        return 2
    except (ValueError, OSError) as error:
        print(f"brokk-min: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("brokk-min: stopped", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
