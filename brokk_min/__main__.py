"""The command line: `brokk-min COMMAND --help`. Exits 0 done, 1 failed, 2 wrong use."""

import os
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro

from brokk_min import experiments, hw
from brokk_min.actuator import FitConfig, collect, fit, load_net, save_net, score
from brokk_min.bus import open_line, read_frames
from brokk_min.env import Controller, TaskConfig, fitting_nets
from brokk_min.export import export_onnx
from brokk_min.logs import Log, read_log, write_log
from brokk_min.machine import BROKK_170
from brokk_min.metrics import summary
from brokk_min.mpc import PerfectModel
from brokk_min.policy import PolicyController, load_policy
from brokk_min.report import VERDICTS
from brokk_min.sequences import (
    draw_starts,
    read_commands,
    read_starts,
    scored_starts,
    task_sequences,
    write_starts,
)
from brokk_min.simulator import simulate

MACHINES = {machine.name: machine for machine in (BROKK_170,)}
Name = Annotated[str, tyro.conf.arg(metavar="{" + ",".join(MACHINES) + "}")]


class WrongUse(ValueError):
    """Options that cannot be meant; exit status 2."""


# What options of these names may be, both ends included.
ALLOWED: tuple[tuple[float, float, str], ...] = (
    (0, 2**31 - 1, "seed"),
    (0, 1, "zero_goals axis_goals gae_lambda"),
    (0, 0.9999, "gamma"),
    (0, 1000, "noise valve_cost entropy"),
    (0, 1e6, "hold_min_s hold_max_s"),
    (1, 1e6, "batch_size hidden num_envs horizon epochs threads num num_starts"),
    (1, 1e12, "steps total_steps checkpoint_every"),
    (2, 1e7, "velocity_samples history minibatch_size"),
    (-10, 3, "log_std"),
    (1e-9, 1, "learning_rate"),
    (1e-9, 1e9, "target_kl max_grad_norm clip"),
    (1e-4, 100, "hours"),
    (1, 127, "counts"),
    (0.05, 1e6, "episode_s"),
)


def check(command: Any, *outputs: Path | None) -> None:
    """Refuse options that cannot be meant and outputs that cannot be written, before any work."""
    given = {**vars(getattr(command, "settings", None) or command), **vars(command)}
    given |= vars(command.task) if hasattr(command, "task") else {}
    for low, high, names in ALLOWED:
        for name in names.split():
            if name in given and not low <= given[name] <= high:
                option = name.replace("_", "-")
                raise WrongUse(f"--{option}: expected {low} to {high}, got {given[name]}")
    if given.get("machine", BROKK_170.name) not in MACHINES:
        raise WrongUse(f"--machine: expected one of {list(MACHINES)}, got {given['machine']}")
    for path in outputs:
        if path and (path.is_dir() or not os.access(path.parent, os.W_OK)):
            raise WrongUse(f"{path}: expected a file in an existing, writable directory")


@dataclass(kw_only=True)
class Command:
    """What most commands share."""

    machine: Name = BROKK_170.name  # Which machine.
    seed: int = 0  # Of everything random.


@dataclass(kw_only=True)
class Collect(Command):
    """Record the machine (the analytic plant) under excitation."""

    out: Path  # Log to write, .csv or .npz.
    hours: float = 1.0  # Driving time for each actuator [h].
    excitation: Literal["sine", "rich"] = "rich"  # The paper's sines, or steps and holds too.

    def run(self) -> None:
        """Write the log."""
        check(self, self.out)
        if self.out.suffix not in (".csv", ".npz"):
            raise WrongUse(f"--out: expected a name ending in .csv or .npz, got {self.out}")
        rng = np.random.default_rng(self.seed)
        log = collect(MACHINES[self.machine], self.hours, self.excitation, rng)
        write_log(self.out, log)
        print(f"{self.out}: {len(log.recordings)} recordings of {', '.join(log.joints)}")


@dataclass(kw_only=True)
class Fit:
    """Fit one net a joint to the log of any machine and score it on recordings it never saw."""

    logs: tyro.conf.Positional[tuple[Path, ...]]  # Logs of one machine, .csv or .npz.
    out: Path  # Nets to write, .npz.
    test: tuple[Path, ...] = ()  # Logs to score on; without them every tenth recording of LOGS is held out.
    json: Path | None = None  # Also write the scores here.
    velocity_samples: int = BROKK_170.velocity_samples  # Window of the velocity estimator at 20 Hz.
    settings: tyro.conf.OmitArgPrefixes[FitConfig] = field(default_factory=FitConfig)  # The fit.
    seed: int = 0  # Of everything random.

    def run(self) -> None:
        """Fit, score, write."""
        if not self.logs:
            raise WrongUse("LOGS: expected at least one log, got none")
        check(self, self.out, self.json)
        if self.velocity_samples > self.settings.history:
            raise WrongUse(f"--velocity-samples: expected at most --history, got {self.velocity_samples}")
        log = read_log(self.logs, self.velocity_samples)
        log, test = (log, read_log(self.test, self.velocity_samples, log.joints)) if self.test else split(log)
        known = [machine.name for machine in MACHINES.values() if machine.names == log.joints]
        net = fit(log, self.settings, self.seed, self.velocity_samples, "".join(known))
        save_net(self.out, net)
        joints = score(net, test)
        if self.json:
            meta: dict[str, Any] = {"seed": self.seed, "rate": net.rate, "history": net.history}
            meta |= {"logs": [str(p) for p in self.logs], "test": [str(p) for p in self.test]}
            experiments.write_json(self.json, {"meta": meta, "joints": joints})
        print(f"{'joint':12} one step  same as last  free run of 1, 5, 10, 30 s [rad/s]")
        for name, s in joints.items():
            free = ", ".join(f"{run['velocity_rmse']:.4f}" for run in s["free_run"].values())
            print(f"{name:12} {s['one_step_rmse']:8.4f}  {s['persistence_rmse']:12.4f}  {free}")


def split(log: Log) -> tuple[Log, Log]:
    """Recordings to fit to, and every tenth, whole, to score on; a single one cannot be split."""
    if len(log.recordings) < 2:
        raise ValueError("LOGS: expected two or more recordings, or --test, to score on; got one")
    kept = tuple(recording for i, recording in enumerate(log.recordings) if i % 10)
    return log._replace(recordings=kept), log._replace(recordings=log.recordings[::10])


def train_command() -> Any:
    """The command `train`; made on demand, because its settings live beside torch."""
    from brokk_min.ppo import PPOConfig, train

    @dataclass(kw_only=True)
    class Train(Command):
        """Train a policy on nets with PPO."""

        actuator: Path  # Nets that `fit` wrote.
        out: Path  # Policy to write, .npz.
        resume: bool = False  # Take up OUT.checkpoint; the end is the same as without the break.
        tensorboard: Path | None = None  # Folder for TensorBoard (extra `tensorboard`).
        settings: tyro.conf.OmitArgPrefixes[PPOConfig] = field(default_factory=PPOConfig)  # The learner.
        task: tyro.conf.OmitArgPrefixes[TaskConfig] = field(default_factory=TaskConfig)  # What an episode is.

        def run(self) -> None:
            """Train and write the policy."""
            check(self, self.out)
            if self.task.hold_min_s > self.task.hold_max_s:
                raise WrongUse(f"--hold-max-s: expected --hold-min-s or more, got {self.task.hold_max_s}")
            machine = MACHINES[self.machine]
            net = fitting_nets(machine, load_net(self.actuator))
            train(machine, net, self.task, self.settings, self.seed, self.out, self.resume, self.tensorboard)
            print(f"{self.out}: trained for {self.settings.total_steps} steps; curve in {self.out}.csv")

    return Train


@dataclass(kw_only=True)
class Starts(Command):
    """Draw start poses for `evaluate`: across the workspace, near joint limits, near full extension."""

    out: Path  # Poses to write, .csv.
    num: int = 64  # How many.
    seed: int = 2  # Of the poses.

    def run(self) -> None:
        """Draw and write."""
        check(self, self.out)
        machine = MACHINES[self.machine]
        rng = np.random.default_rng(self.seed)
        write_starts(self.out, machine, draw_starts(machine, task_sequences(machine), self.num, rng))
        print(f"{self.out}: {self.num} start poses")


@dataclass(kw_only=True)
class Evaluate(Command):
    """Policy and tuned baselines on the same sequences and starts."""

    policy: Path  # Policy that `train` wrote.
    commands: Path | None = None  # Velocity sequences, CSV: sequence,time,vx,vy,vz [s, m/s].
    starts: Path | None = None  # Start poses, CSV: one column a joint [rad].
    plant: Literal["analytic", "net"] = "analytic"  # What moves: the analytic plant or the nets.
    json: Path | None = None  # Also write all runs here.
    gains: Path | None = None  # Tuned gains; by default gains.json beside POLICY.
    num_starts: int = 16  # Without --starts: so many of the machine's start poses.
    perfect_model: bool = False  # Also the bound: a controller that knows the plant (minutes).

    def run(self) -> None:
        """Evaluate and print the means."""
        check(self, self.json)
        if self.perfect_model and self.plant == "net":
            raise WrongUse("--perfect-model: expected --plant analytic, the plant that it knows, got net")
        machine, effort = MACHINES[self.machine], experiments.Effort()
        policy = load_policy(self.policy, machine)
        sequences = read_commands(self.commands, machine) if self.commands else task_sequences(machine)
        if self.starts:
            starts = read_starts(self.starts, machine)
        else:
            starts = scored_starts(machine, self.num_starts, task_sequences(machine), self.seed + 2)
        controllers: dict[str, Controller] = {"rl": PolicyController(machine, policy)}
        beside = self.policy.with_name("gains.json")
        gains = self.gains or (beside if beside.exists() else "tuned now")
        print(f"gains of the baselines: {gains}", file=sys.stderr)
        if isinstance(gains, Path):
            controllers |= experiments.read_gains(gains, machine, policy.net)
        else:
            controllers |= experiments.tuned_baselines(machine, policy.net, effort, self.seed)[0]
        if self.perfect_model:
            controllers["perfect_model"] = PerfectModel(machine, starts)
        moves = policy.net if self.plant == "net" else None
        runs, _ = experiments.task_space(machine, controllers, sequences, starts, self.seed, moves)
        if self.json:
            meta = experiments.meta(machine, self.seed)
            meta |= {"policy": str(self.policy), "gains": str(gains), "plant": self.plant}
            names = ", ".join(sequence.name for sequence in sequences)
            meta |= {"commands": str(self.commands or names), "starts": str(self.starts or self.num_starts)}
            experiments.write_json(self.json, {"meta": meta, "runs": runs})
        for kind in dict.fromkeys(run["kind"] for run in runs):
            mine = [run for run in runs if run["kind"] == kind]
            count = len({run["start"] for run in mine})
            print(f"{kind} starts ({count}): means over {len(sequences)} sequences")
            for name, rows in summary(mine).items():
                cells = (f"{k} {'none' if v is None else format(v, '.4f')}" for k, v in rows["all"].items())
                print(f"  {name:20} " + ", ".join(cells))


@dataclass(kw_only=True)
class Reproduce(Command):
    """The whole chain: logs, nets, policy, baselines, comparison, report.html and results.json."""

    out: Path = Path("results")  # Folder for everything.
    quick: bool = False  # The same, smaller: to see that it runs, not to judge the policy.

    def run(self) -> None:
        """Run the chain and print the means."""
        check(self)
        effort = experiments.QUICK if self.quick else experiments.Effort()
        results = experiments.reproduce(MACHINES[self.machine], self.out, effort, self.seed)
        for name, rows in results["task_space"]["summary"].items():
            errors = ", ".join(f"{s} {row['velocity_error_mean']:.4f}" for s, row in rows.items())
            print(f"{name:20} mean velocity error [m/s]: {errors}")
        for claim in results["claims"]:
            print(f"{VERDICTS[claim['holds']]}: {claim['paper']}")
        print(f"{self.out / 'report.html'}\n{self.out / 'results.json'}")


@dataclass(kw_only=True)
class Simulate(Command):
    """Put a simulated machine on a CAN bus: encoders, valve controller, the analytic plant behind them."""

    interface: str  # python-can's name of the bus, udp_multicast for a try without hardware.
    channel: str  # Channel of the interface, for udp_multicast 239.74.163.2.
    start: tuple[float, ...] = (1.5, 0.5, 0.58, 1.71, 1.24)  # Angles at the start [rad].
    record: Path | None = None
    """Also log command in force and true angles at every step of the plant here, .csv."""

    def run(self) -> None:
        """Run until SIGINT or SIGTERM."""
        check(self, self.record)
        print(f"{self.machine} on {self.interface} {self.channel}; Ctrl-C ends it", flush=True)
        simulate(MACHINES[self.machine], self.start, self.interface, self.channel, self.record)


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
    replay: Path | None = None  # No bus: run on this log and compare the valve frames with those in it.

    def run(self) -> None:
        """Drive until the sequences or the operator end it, or compare a log."""
        check(self, self.log)
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
            sequences = read_commands(Path(self.command), machine)
            operator = hw.Script(machine, np.concatenate([s.goals for s in sequences]))
        with open_line(self.interface, self.channel, self.log) as line:
            drive = hw.Drive(machine, controller, line, operator)
            drive.begin()
            try:
                drive.run(_show)
            finally:
                print(end="\n" if sys.stdout.isatty() else "")
        if isinstance(operator, hw.Script) and not operator.done:
            raise ValueError(f"drive: expected to play all sequences, got {drive.reason or 'a stop'}")

    def _controller(self) -> Controller:
        machine = MACHINES[self.machine]
        if self.controller == "jog":
            driven = [machine.names[i] for i in machine.driven]
            if self.joint not in driven:
                raise WrongUse(f"--joint: expected one that may be driven, {driven}, got {self.joint}")
            return hw.Jog(machine, self.joint, self.counts)
        if not self.policy:
            raise WrongUse("--policy: expected a policy that `train` wrote, got none")
        policy = load_policy(self.policy, machine)
        if self.controller == "rl":
            return PolicyController(machine, policy)
        gains = self.gains or self.policy.with_name("gains.json")
        return experiments.read_gains(gains, machine, policy.net)["jacobian_pid_k0.1"]


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
        check(self, self.out)
        log = hw.driven_log(MACHINES[self.machine], read_frames(self.log))
        write_log(self.out, log)
        print(f"{self.out}: {len(log.recordings)} recordings of {', '.join(log.joints)}")


@dataclass(kw_only=True)
class Export(Command):
    """Write a policy as one ONNX file, to be run elsewhere."""

    policy: Path  # Policy that `train` wrote.
    out: Path  # File to write, .onnx.

    def run(self) -> None:
        """Write the file."""
        check(self, self.out)
        export_onnx(self.out, load_policy(self.policy, MACHINES[self.machine]))
        print(f"{self.out}: observation (batch, obs) in, action (batch, driven joints) out")


COMMANDS: dict[str, Callable[[], Any]] = {
    "collect": lambda: Collect,
    "fit": lambda: Fit,
    "train": train_command,
    "starts": lambda: Starts,
    "evaluate": lambda: Evaluate,
    "reproduce": lambda: Reproduce,
    "machine": lambda: Simulate,
    "drive": lambda: Drive,
    "convert": lambda: Convert,
    "export": lambda: Export,
}


def main(arguments: list[str] | None = None) -> int:
    """Run one command; errors are one line on stderr."""
    arguments = sys.argv[1:] if arguments is None else arguments
    named = [name for name in COMMANDS if name in arguments[:1]] or list(COMMANDS)
    command = tyro.extras.subcommand_cli_from_dict(
        {name: COMMANDS[name]() for name in named},
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
