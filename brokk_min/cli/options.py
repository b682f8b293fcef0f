"""What the commands share: which machine, which values can be meant, which policy and gains by default."""

import os
import runpy
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from brokk_min.identification.files import SHIPPED
from brokk_min.machine import BROKK_170, Machine

MACHINES = {machine.name: machine for machine in (BROKK_170,)}
Name = Annotated[str, tyro.conf.arg(metavar="{" + ",".join(MACHINES) + "}|FILE.py:NAME")]


class WrongUse(ValueError):
    """Options that cannot be meant; exit status 2."""


# What options of these names may be, both ends included.
ALLOWED: tuple[tuple[float, float, str], ...] = (
    (0, 2**31 - 1, "seed"),
    (0, 1, "zero_goals axis_goals gae_lambda"),
    (0, 0.9999, "gamma"),
    (0, 1000, "noise valve_cost entropy"),
    (0, 0.99, "dead_zone"),
    (0, 1e6, "hold_min_s hold_max_s"),
    (1, 1e6, "batch_size hidden num_envs horizon epochs threads rollout num num_starts"),
    (1, 1e12, "steps total_steps checkpoint_every"),
    (2, 1e7, "velocity_samples history minibatch_size"),
    (-10, 3, "log_std log_std_end"),
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
            if given.get(name) is not None and not low <= given[name] <= high:
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


def chosen_policy(
    machine: Machine, policy: Path | None, gains: Path | None
) -> tuple[Path, Path | None]:
    """The policy file, by default the package's; tuned gains, by default beside it (None: no file there)."""
    path = policy or SHIPPED / machine.name / "policy.npz"
    beside = path.with_name("gains.json")
    return path, gains or (beside if beside.exists() else None)


@dataclass(kw_only=True)
class Command:
    """What most commands share."""

    machine: Name = (
        BROKK_170.name
    )  # Which machine; FILE.py:NAME runs that file, so name only one you trust.
    seed: int = 0  # Of everything random.
