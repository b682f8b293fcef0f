"""The command line: `brokk-min COMMAND --help`. Exits 0 done, 1 failed, 2 wrong use."""

import os
import runpy
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro

from brokk_min import experiments, figures, hw, play, preliminary, remote, replay, view
from brokk_min.actuator import load_net, save_net
from brokk_min.bus import open_line, read_frames
from brokk_min.env import Controller, TaskConfig, fitting_nets
from brokk_min.excitation import collect
from brokk_min.export import export_onnx
from brokk_min.fitting import PAPER_RECIPE, FitConfig, fit
from brokk_min.logs import Log, read_log, write_log
from brokk_min.machine import BROKK_170, Machine
from brokk_min.metrics import summary
from brokk_min.policy import PolicyController, load_policy
from brokk_min.report import VERDICTS
from brokk_min.sequences import draw_starts, goals_and_starts, read_commands, task_sequences, write_starts
from brokk_min.simulator import simulate

MACHINES = {machine.name: machine for machine in (BROKK_170,)}
SHIPPED = Path(__file__).with_name("shipped")  # a folder a machine: policy and gains of `make reproduce`
Name = Annotated[str, tyro.conf.arg(metavar="{" + ",".join(MACHINES) + "}|FILE.py:NAME")]


class WrongUse(ValueError):
    """Options that cannot be meant; exit status 2."""


# What options of these names may be, both ends included.
ALLOWED: tuple[tuple[float, float, str], ...] = (
    (0, 2**31 - 1, "seed"),
    (0, 1, "zero_goals axis_goals gae_lambda"),
    (0, 0.9999, "gamma"),
    (0, 1000, "noise valve_cost entropy"),
    (0, 1e6, "hold_min_s hold_max_s"),
    (1, 1e6, "batch_size hidden num_envs horizon epochs threads rollout num num_starts"),
    (1, 1e12, "steps total_steps checkpoint_every"),
    (2, 1e7, "velocity_samples history minibatch_size"),
    (-10, 3, "log_std"),
    (1e-9, 1, "learning_rate"),
    (1e-9, 1e9, "target_kl max_grad_norm clip"),
    (1e-4, 100, "hours"),
    (1, 127, "counts"),
    (1, 10000, "seeds"),
    (1, 1000, "poses"),
    (0.05, 1e6, "episode_s"),
    (0.1, 100, "fps"),
)


def check(command: Any, *outputs: Path | None) -> Machine:
    """Refuse options that cannot be meant and outputs that cannot be written; the machine."""
    given = {**vars(getattr(command, "settings", None) or command), **vars(command)}
    given |= vars(command.task) if hasattr(command, "task") else {}
    for low, high, names in ALLOWED:
        for name in names.split():
            if name in given and not low <= given[name] <= high:
                option = name.replace("_", "-")
                raise WrongUse(f"--{option}: expected {low} to {high}, got {given[name]}")
    if given.get("hold_min_s", 0) > given.get("hold_max_s", 0):
        raise WrongUse(f"--hold-max-s: expected --hold-min-s or more, got {given['hold_max_s']}")
    machine = MACHINES.get(command.machine or BROKK_170.name) or machine_from(command.machine)
    for path in outputs:
        if path and (path.is_dir() or not os.access(path.parent, os.W_OK)):
            raise WrongUse(f"{path}: expected a file in an existing, writable directory")
    return machine


def machine_from(name: str) -> Machine:
    """The machine `FILE.py:NAME`: it runs the file, as `python FILE.py` would."""
    path, _, symbol = name.rpartition(":")
    if not path.endswith(".py"):
        raise WrongUse(f"--machine: expected one of {list(MACHINES)} or FILE.py:NAME, got {name}")
    try:
        machine = runpy.run_path(path).get(symbol)
    except Exception as error:  # whatever the file does
        raise ValueError(f"--machine: expected {path} to run, got {error!r}") from error
    if not isinstance(machine, Machine):
        raise WrongUse(f"--machine: expected a Machine {symbol} in {path}, got {machine!r}")
    return machine


def chosen_policy(machine: Machine, policy: Path | None, gains: Path | None) -> tuple[Path, Path | None]:
    """The policy file, by default the package's; tuned gains, by default beside it (None: no file there)."""
    path = policy or SHIPPED / machine.name / "policy.npz"
    beside = path.with_name("gains.json")
    return path, gains or (beside if beside.exists() else None)


@dataclass(kw_only=True)
class Command:
    """What most commands share."""

    machine: Name = BROKK_170.name  # Which machine; FILE.py:NAME runs that file, so name only one you trust.
    seed: int = 0  # Of everything random.


@dataclass(kw_only=True)
class Collect(Command):
    """Record the machine (the analytic plant) under excitation."""

    out: Path  # Log to write, .csv or .npz.
    hours: float = 1.0  # Driving time for each actuator [h].
    excitation: Literal["sine", "rich"] = "rich"  # The paper's sines, or steps and holds too.

    def run(self) -> None:
        """Write the log."""
        machine = check(self, self.out)
        if self.out.suffix not in (".csv", ".npz"):
            raise WrongUse(f"--out: expected a name ending in .csv or .npz, got {self.out}")
        log = collect(machine, self.hours, self.excitation, np.random.default_rng(self.seed))
        write_log(self.out, log)
        print(f"{self.out}: {len(log.recordings)} recordings of {', '.join(log.joints)}")


@dataclass(kw_only=True)
class Fit:
    """Fit one net a joint to the log of any machine and score it on recordings it never saw."""

    logs: tyro.conf.Positional[tuple[Path, ...]]  # Logs of one machine, .csv or .npz.
    out: Path  # Nets to write, .npz.
    test: tuple[Path, ...] = ()  # Logs to score on; without them every tenth recording of LOGS is held out.
    json: Path | None = None  # Also write the scores here.
    figure: Path | None = None  # Also draw free runs of the worst and the median recording here, .png.
    machine: Name = ""  # Whose nets, at its rate; by default the Brokk's if its joints are those of LOGS.
    velocity_samples: int = BROKK_170.velocity_samples  # Window of the velocity estimator.
    paper: bool = False  # The paper's own recipe: errors of one step alone, no noise.
    settings: tyro.conf.OmitArgPrefixes[FitConfig] = field(default_factory=FitConfig)  # The fit.
    seed: int = 0  # Of everything random.

    def run(self) -> None:
        """Fit, judge, write."""
        if not self.logs:
            raise WrongUse("LOGS: expected at least one log, got none")
        machine = check(self, self.out, self.json, self.figure)
        if self.velocity_samples > self.settings.history:
            raise WrongUse(f"--velocity-samples: expected at most --history, got {self.velocity_samples}")
        log = read_log(self.logs, self.velocity_samples, rate=machine.rate)
        unseen = (self.test, self.velocity_samples, log.joints, log.rate)
        log, test = (log, read_log(*unseen)) if self.test else split(log)
        known = machine if machine.names == log.joints else None
        if self.machine and not known:
            raise ValueError(f"LOGS: expected joints of --machine {self.machine}, got {list(log.joints)}")
        settings = replace(self.settings, **PAPER_RECIPE) if self.paper else self.settings
        net = fit(log, settings, self.seed, self.velocity_samples, known.name if known else "")
        verdict = preliminary.judge(net, log, test, known)
        save_net(self.out, net)
        if self.json:
            meta: dict[str, Any] = {"seed": self.seed, "rate": net.rate, "history": net.history}
            meta |= {"logs": [str(p) for p in self.logs], "test": [str(p) for p in self.test]}
            experiments.write_json(self.json, {"meta": meta, **verdict})
        if self.figure:
            figures.save(self.figure, figures.plot_worst_and_median(net, test))
        _print_verdict(verdict)


def _print_verdict(verdict: dict[str, Any]) -> None:
    """Scores of the nets, of the linear model below them, and what speaks against the nets."""
    row = "{:12} {:>9} {:>13}  {:30} {}"
    print(row.format("joint", "one step", "same as last", "free run of 1, 5, 10, 30 s", "creep [rad/s]"))
    for name, s in verdict["joints"].items():
        for label, scores in ((name, s), ("  linear", s["linear"])):
            free = ", ".join(f"{run['velocity_rmse']:.4f}" for run in scores["free_run"].values())
            steps = (f"{scores.get(key, np.nan):.4f}" for key in ("one_step_rmse", "persistence_rmse"))
            print(row.format(label, *steps, free, f"{s['creep']:.5f}" if label == name else ""))
    for warning in verdict["warnings"]:
        print(f"warning: {warning}")


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
            machine = check(self, self.out)
            net = fitting_nets(machine, load_net(self.actuator))
            train(machine, net, self.task, self.settings, self.seed, self.out, self.resume, self.tensorboard)
            print(f"{self.out}: trained for {self.settings.total_steps} steps; curve in {self.out}.csv")

    return Train


def sweep_command() -> Any:
    """The command `sweep`; made on demand as `train`."""
    from brokk_min.ppo import PPOConfig
    from brokk_min.sweep import show, sweep

    @dataclass(kw_only=True)
    class Sweep(Command):
        """Train and evaluate many seeds on all cores or a cluster; finished seeds are not run again."""

        actuator: Path  # Nets that `fit` wrote.
        out: Path  # Folder for a policy, a curve and figures of each seed, and sweep.json.
        seeds: int = 10  # How many, from --seed on.
        poses: int = 16  # Start poses for each scored sequence, half of them of the workspace.
        scheduler: str | None = None  # tcp://... of a dask scheduler (extra `sweep`); OUT must be shared.
        gains: Path | None = None  # Tuned gains that `reproduce` wrote: baselines beside.
        settings: tyro.conf.OmitArgPrefixes[PPOConfig] = field(default_factory=PPOConfig)
        """The learner; each seed runs on one thread, whatever --threads says."""
        task: tyro.conf.OmitArgPrefixes[TaskConfig] = field(default_factory=TaskConfig)  # What an episode is.

        def run(self) -> None:
            """Sweep and print the table."""
            machine = check(self)
            net = fitting_nets(machine, load_net(self.actuator))
            seeds = range(self.seed, self.seed + self.seeds)
            of, how = self.settings, (self.poses, self.scheduler, self.gains)
            print(show(sweep(machine, net, self.task, of, seeds, self.out, *how)))

    return Sweep


@dataclass(kw_only=True)
class Starts(Command):
    """Draw start poses for `evaluate`: across the workspace, near joint limits, near full extension."""

    out: Path  # Poses to write, .csv.
    num: int = 64  # How many.
    seed: int = 2  # Of the poses.

    def run(self) -> None:
        """Draw and write."""
        machine, rng = check(self, self.out), np.random.default_rng(self.seed)
        write_starts(self.out, machine, draw_starts(machine, task_sequences(machine), self.num, rng))
        print(f"{self.out}: {self.num} start poses")


@dataclass(kw_only=True)
class Evaluate(Command):
    """Policy and tuned baselines on the same sequences and starts."""

    policy: Path | None = None
    """Policy that `train` wrote; by default the one that comes with the package."""
    commands: Path | None = None  # Velocity sequences, CSV: sequence,time,vx,vy,vz [s, m/s].
    starts: Path | None = None  # Start poses, CSV: one column a joint [rad].
    plant: Literal["analytic", "net"] = "analytic"  # What moves: the analytic plant or the nets.
    json: Path | None = None  # Also write all runs here.
    gains: Path | None = None  # Tuned gains; by default gains.json beside POLICY.
    num_starts: int = 16  # Without --starts: so many of the machine's start poses.
    perfect_model: bool = False  # Also the bound: a controller that knows the plant (minutes).

    def run(self) -> None:
        """Evaluate and print the means."""
        machine = check(self, self.json)
        if self.perfect_model and self.plant == "net":
            raise WrongUse("--perfect-model: expected --plant analytic, the plant that it knows, got net")
        path, gains = chosen_policy(machine, self.policy, self.gains)
        policy = load_policy(path, machine)
        sequences, starts = goals_and_starts(machine, self.commands, self.starts, self.num_starts, self.seed)
        print(f"gains of the baselines: {gains or 'tuned now'}", file=sys.stderr)
        controllers: dict[str, Controller] = {"rl": PolicyController(machine, policy)}
        if gains:
            controllers |= experiments.read_gains(gains, machine, policy.net)
        else:
            tuned, _ = experiments.tuned_baselines(machine, policy.net, experiments.Effort(), self.seed)
            controllers |= tuned
        if self.perfect_model:
            controllers |= experiments.bounds(machine, starts)
        moves = policy.net if self.plant == "net" else None
        runs, _ = experiments.task_space(machine, controllers, sequences, starts, self.seed, moves)
        if self.json:
            meta = experiments.meta(machine, self.seed)
            meta |= {"policy": str(path), "gains": str(gains or "tuned now"), "plant": self.plant}
            names = ", ".join(sequence.name for sequence in sequences)
            meta |= {"commands": str(self.commands or names), "starts": str(self.starts or self.num_starts)}
            experiments.write_json(self.json, {"meta": meta, "runs": runs})
        for kind in dict.fromkeys(run["kind"] for run in runs):
            mine = [run for run in runs if run["kind"] == kind]
            num = len({run["start"] for run in mine})
            print(f"{kind} starts ({num}), means over {len(sequences)} sequences")
            for name, rows in summary(mine).items():
                cells = (f"{k} {'none' if v is None else format(v, '.4f')}" for k, v in rows["all"].items())
                print(f"  {name:20} " + ", ".join(cells))


@dataclass(kw_only=True)
class Reproduce(Command):
    """The whole chain: logs, nets, policy, baselines, comparison, report.html and results.json."""

    out: Path = Path("results")  # Folder for everything.
    quick: bool = False  # The same, smaller: to see that it runs, not to judge the policy.
    sweep: Path | None = None  # sweep.json of a sweep on these nets: intervals over its seeds in the report.

    def run(self) -> None:
        """Run the chain and print the means."""
        effort = experiments.QUICK if self.quick else experiments.Effort()
        results = experiments.reproduce(check(self), self.out, effort, self.seed, self.sweep)
        for name, rows in results["task_space"]["summary"].items():
            errors = ", ".join(f"{s} {row['velocity_error_mean']:.4f}" for s, row in rows.items())
            print(f"{name:20} mean velocity error [m/s]: {errors}")
        for claim in results["claims"]:
            print(f"{VERDICTS[claim['holds']]}: {claim['paper']}")
        print(f"{self.out / 'report.html'}\n{self.out / 'results.json'}")


@dataclass(kw_only=True)
class Preliminary(Command):
    """The paper's preliminary tests and its sim-to-real experiment, machine and nets side by side."""

    actuator: Path  # Nets that `fit` wrote.
    out: Path = Path("preliminary")  # Folder for figures and preliminary.json.

    def run(self) -> None:
        """Measure, draw, write."""
        machine, net = check(self), load_net(self.actuator)
        numbers = preliminary.run(machine, net, self.seed)
        self.out.mkdir(parents=True, exist_ok=True)
        for name, figure in preliminary.plots(machine, net, self.seed).items():
            figures.save(self.out / f"{name}.png", figure)
            print(self.out / f"{name}.png")
        meta = experiments.meta(machine, self.seed) | {"actuator": str(self.actuator)}
        experiments.write_json(self.out / "preliminary.json", {"meta": meta, **numbers})
        print(self.out / "preliminary.json")
        tool = numbers["sim_to_real"]["tool"]["position_error_mean"]
        print(f"tool, nets beside machine over 30 s: {tool:.4f} m apart in the mean")


@dataclass(kw_only=True)
class Simulate(Command):
    """Put a simulated machine on a CAN bus: encoders, valve controller, the analytic plant behind them."""

    interface: str  # python-can's name of the bus, udp_multicast for a try without hardware.
    channel: str  # Channel of the interface, for udp_multicast 239.74.163.2.
    start: tuple[float, ...] = remote.START  # Angles at the start [rad].
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
    replay: Path | None = None  # No bus: run on this log and compare the valve frames with those in it.

    def run(self) -> None:
        """Drive until the sequences or the operator end it, or compare a log."""
        machine = check(self, self.log)
        if not self.replay and not (self.interface and self.channel):
            raise WrongUse("--interface, --channel: expected a CAN bus, or --replay, got none")
        controller = self._controller(machine)
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

    def _controller(self, machine: Machine) -> Controller:
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
        log = hw.driven_log(check(self, self.out), read_frames(self.log))
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
    gains: Path | None = None  # Tuned gains of the Jacobian controller; by default gains.json beside POLICY.
    interface: str = ""  # python-can's name of a bus; without one a simulated machine stands behind.
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
        where = remote.Where(self.interface, self.channel, self.log, self.start)
        if self.interface and not self.drive:
            play.watch(machine, where)
            return
        controllers: dict[str, Controller] = {}
        path, gains = chosen_policy(machine, self.policy, self.gains)
        if self.policy or path.exists():
            policy = load_policy(path, machine)
            known = experiments.read_gains(gains, machine, policy.net) if gains else None
            known = known or experiments.baselines(machine, policy.net)
            controllers = {"rl": PolicyController(machine, policy), "jacobian": known["jacobian_pid_k0.1"]}
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
            runs += self._again(machine, log) if again else [replay.run_of_log(machine, log, colour)]
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
        return replay.driven_again(machine, results, self.controllers, sequence, self.start)


COMMANDS: dict[str, Callable[[], Any]] = {
    "collect": lambda: Collect,
    "fit": lambda: Fit,
    "preliminary": lambda: Preliminary,
    "train": train_command,
    "sweep": sweep_command,
    "starts": lambda: Starts,
    "evaluate": lambda: Evaluate,
    "reproduce": lambda: Reproduce,
    "machine": lambda: Simulate,
    "drive": lambda: Drive,
    "convert": lambda: Convert,
    "export": lambda: Export,
    "play": lambda: Play,
    "replay": lambda: Replay,
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
