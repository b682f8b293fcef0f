"""Common to the commands: the machine, plants, outputs, wrong use."""

import os
import runpy
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from brokk_min._files import SHIPPED, brief, expected
from brokk_min.actuator import PLANT, Plant
from brokk_min.machine import BROKK_170, PWM_MAX, Machine, require

MACHINES = {BROKK_170.name: BROKK_170}
MachineName = Annotated[str, tyro.conf.arg(metavar="{" + ",".join(MACHINES) + "}|FILE.py:NAME")]
TRIED = 2.0  # s of full command in which each joint of a plant must move


class WrongUse(ValueError):
    """Options that make no sense; exit status 2."""


def check(fact: bool, option: str, wanted: str, got: Any) -> None:
    """WrongUse "option: expected wanted, got got" unless `fact` holds."""
    if not fact:
        raise WrongUse(f"{option}: expected {wanted}, got {got}")


FRACTIONS = ("gamma", "gae_lambda", "zero_goals", "axis_goals", "noise", "weight_decay")


def check_settings(settings: Any) -> None:
    """WrongUse: a setting of a learner or a fit that is no fraction, or not positive."""
    for name, value in vars(settings).items():
        if isinstance(value, bool) or name.startswith("log_std"):
            continue
        fraction = name in FRACTIONS
        fits = 0 <= value <= 1 if fraction else 0 < value < np.inf
        wanted = "0 to 1" if fraction else "a positive number"
        check(fits, f"--{name.replace('_', '-')}", wanted, value)


@dataclass(kw_only=True)
class Command:
    """Options of every command."""

    machine: MachineName = BROKK_170.name  # Which machine; FILE.py:NAME runs a file that you trust.
    force: bool = False  # Write over files that exist.

    @classmethod
    def defaults(cls, arguments: list[str]) -> Any:
        """The defaults, if some arguments change them."""
        return tyro.MISSING_NONPROP

    def find_machine(self) -> Machine:
        """The machine by its name, or of a file."""
        if self.machine in MACHINES:
            return MACHINES[self.machine]
        machine = load_object("--machine", self.machine)
        check(isinstance(machine, Machine), "--machine", "a Machine", brief(machine))
        return machine  # type: ignore[no-any-return]

    def writes(self, *paths: Path | None) -> None:
        """WrongUse: a file that cannot be written, or that exists without --force."""
        for path in filter(None, paths):
            folder = path.parent
            fits = folder.is_dir() and os.access(folder, os.W_OK) and not path.is_dir()
            check(fits, str(path), "a file in an existing, writable folder", "none")
            check(self.force or not path.exists(), str(path), "no file (or --force)", "one")


def load_object(option: str, name: str) -> Any:
    """The object NAME of `FILE.py:NAME`; the file is run, as `python FILE.py` would."""
    path, _, symbol = name.rpartition(":")
    known = "analytic" if option == "--plant" else ", ".join(MACHINES)
    check(path.endswith(".py"), option, f"{known} or FILE.py:NAME", name)
    folder = str(Path(path).resolve().parent)
    sys.path.insert(0, folder)  # files beside it can be imported
    try:
        found = runpy.run_path(path)
    except (Exception, SystemExit) as error:  # whatever the file does
        raise ValueError(f"{option}: expected {path} to run, got {brief(error)}") from error
    finally:
        sys.path.remove(folder)
        sys.path.append(folder)  # also later, but in place of no package
    check(symbol in found, option, f"an object {symbol} in {path}", "none")
    return found[symbol]


def find_plant(name: str, machine: Machine) -> Plant:
    """The analytic plant, or one of a file, after a try of each joint.

    ValueError: no plant, angles that are not finite, or a joint that does not obey.
    """
    if name == "analytic":
        return PLANT
    plant: Plant = load_object("--plant", name)
    middle = np.tile((machine.column("q_min") + machine.column("q_max")) / 2, (2 * machine.n, 1))
    u = machine.pwm_limit / PWM_MAX * np.concatenate([np.eye(machine.n), -np.eye(machine.n)])
    with expected(Path(name), "states with angles q"):  # whatever the file does
        state = plant.reset(machine, middle.copy())
        for _ in range(round(TRIED * machine.rate)):
            state = plant.step(machine, state, u.copy())
        q = np.asarray(state.q, float)
    fits = q.shape == middle.shape and bool(np.isfinite(q).all())
    require(fits, name, f"finite angles q {middle.shape}", brief(q))
    up, down = (np.diag(moved) for moved in np.split(q - middle, 2))
    for i, joint in enumerate(machine.joints):
        fits = 0.01 < up[i] - down[i] < 3 * (joint.q_max - joint.q_min)
        got = f"{up[i]:+.3f} and {down[i]:+.3f} rad after {TRIED:g} s up and down"
        require(fits, f"{name}: {joint.name}", "motion up, then down", got)
    return plant


def default_policy(machine: Machine, policy: Path | None) -> tuple[Path, Path | None]:
    """A policy, by default the package's, and the gains.json beside it, or None.

    WrongUse: the package has no policy for the machine.
    """
    shipped = SHIPPED / machine.name / "policy.npz"
    check(bool(policy) or shipped.exists(), "--policy", f"one for {machine.name}", "none")
    policy = policy or shipped
    gains = policy.with_name("gains.json")
    return policy, gains if gains.exists() else None
