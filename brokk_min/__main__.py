"""The command line: `brokk-min COMMAND --help`. Exits 0 done, 1 failed, 2 wrong use."""

import os
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro

from brokk_min import experiments
from brokk_min.actuator import FitConfig, collect, fit, load_net, save_net, score
from brokk_min.env import Controller, TaskConfig, fitting_nets
from brokk_min.logs import Log, read_log, write_log
from brokk_min.machine import BROKK_170
from brokk_min.policy import PolicyController, load_policy

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
    (1, 1e6, "batch_size hidden num_envs horizon epochs threads"),
    (1, 1e12, "steps total_steps checkpoint_every"),
    (2, 1e7, "velocity_samples history minibatch_size"),
    (-10, 3, "log_std"),
    (1e-9, 1, "learning_rate"),
    (1e-9, 1e9, "target_kl max_grad_norm clip"),
    (1e-4, 100, "hours"),
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
class Evaluate(Command):
    """Policy and tuned baselines on the same sequences and starts."""

    policy: Path  # Policy that `train` wrote.
    commands: Path | None = None  # Velocity sequences, CSV: sequence,time,vx,vy,vz [s, m/s].
    starts: Path | None = None  # Start poses, CSV: one column a joint [rad].
    plant: Literal["analytic", "net"] = "analytic"  # What moves: the analytic plant or the nets.
    json: Path | None = None  # Also write all runs here.
    gains: Path | None = None  # Tuned gains; by default gains.json beside POLICY.

    def run(self) -> None:
        """Evaluate and print the means."""
        check(self, self.json)
        machine, effort = MACHINES[self.machine], experiments.Effort()
        policy = load_policy(self.policy, machine)
        sequences = experiments.axis_sequences(machine)
        if self.commands:
            sequences = experiments.read_commands(self.commands, machine)
        if self.starts:
            starts = experiments.read_starts(self.starts, machine)
        else:
            rng = np.random.default_rng(self.seed + 2)
            starts = experiments.draw_starts(machine, sequences, effort.starts, rng)
        controllers: dict[str, Controller] = {"rl": PolicyController(machine, policy)}
        beside = self.policy.with_name("gains.json")
        gains = self.gains or (beside if beside.exists() else "tuned now")
        print(f"gains of the baselines: {gains}", file=sys.stderr)
        if isinstance(gains, Path):
            controllers |= experiments.read_gains(gains, machine, policy.net)
        else:
            controllers |= experiments.tuned_baselines(machine, policy.net, effort, self.seed)[0]
        moves = policy.net if self.plant == "net" else None
        runs, _ = experiments.task_space(machine, controllers, sequences, starts, self.seed, moves)
        if self.json:
            meta = experiments.meta(machine, self.seed)
            meta |= {"policy": str(self.policy), "gains": str(gains), "plant": self.plant}
            meta |= {"commands": str(self.commands or "x, y, z"), "starts": str(self.starts or "drawn")}
            experiments.write_json(self.json, {"meta": meta, "runs": runs})
        for name, rows in experiments.summary(runs).items():
            print(f"{name:20} " + ", ".join(f"{k} {v:.4f}" for k, v in rows["all"].items()))


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
        print(f"{self.out / 'report.html'}\n{self.out / 'results.json'}")


COMMANDS: dict[str, Callable[[], Any]] = {
    "collect": lambda: Collect,
    "fit": lambda: Fit,
    "train": train_command,
    "evaluate": lambda: Evaluate,
    "reproduce": lambda: Reproduce,
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
