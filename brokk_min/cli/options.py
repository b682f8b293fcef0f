"""Common to the commands: the machine, plants, outputs, wrong use."""

import os
import runpy
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from brokk_min._files import NEW, SHIPPED, brief, expected
from brokk_min.actuator import PLANT, ActuatorNet, Plant, stands_in
from brokk_min.identification.net_file import load_net
from brokk_min.machine import BROKK_170, PWM_MAX, Array, Controller, Machine, Measured, require

LONGEST = 100  # m: no link is so long, but in millimetres most are
LARGEST = {"alpha": 6.3, "theta": 6.3, "q_dot_up": 10, "q_dot_down": 10}  # in rad, or m; assumed
MOST_U = 10  # of a controller, assumed: what goes beyond 1 is cut, but more are counts
MOST_TICKS = 1000  # of a history, assumed: a longer one would fill the memory
FRACTIONS = ("gamma", "gae_lambda", "zero_goals", "axis_goals", "noise", "weight_decay")


class WrongUse(ValueError):
    """Options that make no sense; exit status 2."""


def check(fact: bool, option: str, wanted: str, got: Any) -> None:
    """WrongUse "option: expected wanted, got got" unless `fact` holds."""
    if not fact:
        raise WrongUse(f"{option}: expected {wanted}, got {got}")


def check_settings(settings: Any) -> None:
    """WrongUse: a setting of a learner or a fit that is no fraction, or not positive."""
    for name, value in vars(settings).items():
        option = f"--{name.replace('_', '-')}"
        if name in FRACTIONS:
            check(0 <= value <= 1, option, "0 to 1", value)
        elif name.startswith("log_std"):
            check(value is None or bool(np.isfinite(value)), option, "a finite number", value)
        elif not isinstance(value, bool):
            check(0 < value < np.inf, option, "a positive number", value)


@dataclass(kw_only=True)
class Command:
    """Options of every command."""

    machine: str = BROKK_170.name  # Which machine; FILE.py:NAME runs a file that you trust.
    force: bool = False  # Write over files that exist.

    def check_numbers(self) -> None:
        """WrongUse: a seed or a number of starts that is none."""
        seed, num_starts = getattr(self, "seed", 0), getattr(self, "num_starts", 1)
        check(seed >= 0, "--seed", "0 or more", seed)
        check(seed < 2**63, "--seed", "less than 2^63", seed)
        check(num_starts > 0, "--num-starts", "1 or more", num_starts)

    @classmethod
    def defaults(cls, options: list[str]) -> Any:
        """The defaults, if some options change them."""
        return tyro.MISSING_NONPROP

    def find_machine(self) -> Machine:
        """The machine by its name, or of a file."""
        if self.machine == BROKK_170.name:
            return BROKK_170
        machine = load_object("--machine", self.machine)
        check(isinstance(machine, Machine), "--machine", "a Machine", brief(machine))
        longest = max(max(abs(j.a), abs(j.d)) for j in machine.joints)
        check(longest < LONGEST, "--machine", f"links in metres, below {LONGEST}", longest)
        check(len(machine.driven) > 0, "--machine", "a driven joint or more", "none")
        speed, ticks = machine.tool_speed, machine.history
        check(speed <= 10, "--machine", "tool_speed in m/s, up to 10", speed)
        check(1 <= machine.rate <= 1000, "--machine", "a rate of 1 to 1000 Hz", machine.rate)
        check(ticks <= MOST_TICKS, "--machine", f"a history of up to {MOST_TICKS} ticks", ticks)
        for j in machine.joints:
            for field, most in LARGEST.items():
                value = getattr(j, field)
                wanted = f"{j.name}.{field} in rad (m), up to {most}"
                check(abs(value) <= most, "--machine", wanted, f"{value:g}: degrees (mm)?")
            turns = j.kind == "revolute" and j.q_max - j.q_min > 4 * np.pi
            got = f"{j.q_min:g} to {j.q_max:g}: degrees?"
            check(not turns, "--machine", f"a range of {j.name} in rad, up to two turns", got)
        return machine  # type: ignore[no-any-return]

    def writes(self, *paths: Path | None, reads: Sequence[Path | None] = ()) -> None:
        """WrongUse: a file that cannot be written, or exists without --force, or has another use.

        What a command reads is in its options that are paths, and in `reads`. Files that are new
        now must be so when they are written.
        """
        outputs = [path for path in paths if path]
        options = (x if isinstance(x, tuple) else (x,) for x in vars(self).values())
        texts = [x for x in vars(self).values() if isinstance(x, str)]
        sources = [Path(x.rpartition(":")[0]) for x in texts if ".py:" in x]
        sources += [Path(x) for x in texts if x.endswith(".npz")]  # nets as a plant
        inputs = [x for x in (*chain(*options), *sources, *reads) if isinstance(x, Path)]
        inputs = [x.resolve() for x in inputs if not any(x is path for path in outputs)]
        for i, path in enumerate(outputs):
            target = path.resolve()
            usable = path.is_file() or not path.exists()  # no folder, and no device
            try:
                tempfile.TemporaryFile(dir=target.parent).close()
            except OSError:
                usable = False
            check(usable, str(path), "a file in an existing, writable folder", "none")
            once = target not in inputs + [one.resolve() for one in outputs[:i]]
            check(once, str(path), "a name of its own", "that of another file of this command")
            check(self.force or not path.exists(), str(path), "no file (or --force)", "one")
            (NEW.discard if self.force else NEW.add)(target)


@contextmanager
def as_wrong_use() -> Iterator[None]:
    """Turn a ValueError of reading an option into WrongUse."""
    try:
        yield
    except ValueError as error:
        raise WrongUse(str(error)) from error


def load_object(option: str, name: str) -> Any:
    """The object NAME of `FILE.py:NAME`; the file is run, as `python FILE.py` would."""
    path, _, symbol = name.rpartition(":")
    usual = {"--plant": "analytic, nets (.npz)", "--controller": "a name of --help"}
    known = usual.get(option, BROKK_170.name)
    check(path.endswith(".py"), option, f"{known} or FILE.py:NAME", name)
    folder, before = str(Path(path).resolve().parent), Path.cwd()
    sys.path.insert(0, folder)  # files beside it can be imported
    try:
        found = runpy.run_path(path)
    except (Exception, SystemExit) as error:  # whatever the file does
        moved = " (CHANGELOG.md has what moved)" if "unexpected keyword" in str(error) else ""
        got = f"{brief(error)}{moved}"
        raise ValueError(f"{option}: expected {path} to run, got {got}") from error
    finally:
        os.chdir(before)  # paths are those of the shell, wherever the file goes
        sys.path.remove(folder)
        sys.path.append(folder)  # also later, but in place of no package
    check(symbol in found, option, f"an object {symbol} in {path}", "none")
    return found[symbol]


def find_plant(name: str, machine: Machine) -> Plant:
    """The analytic plant, nets of a file, or a plant of one's own.

    Of this each joint has moved up and down for two seconds. ValueError: no plant or nets of the
    machine, or a plant that reports degrees, begins elsewhere, stands still or obeys the wrong way.
    """
    if name.endswith(".npz"):
        return load_net(Path(name), machine)
    if name == "analytic":
        if stands_in(machine):
            got = "a machine without hydraulics: those of the analytic plant are made up"
            warning = f"warning: --plant: expected nets (.npz) or FILE.py:NAME, got {got}"
            print(warning, file=sys.stderr)
        return PLANT
    plant = OwnPlant(name, load_object("--plant", name))
    low, high = machine.column("q_min"), machine.column("q_max")
    ways = np.vstack([np.eye(machine.n), -np.eye(machine.n)])
    q = np.tile(0.6 * low + 0.4 * high, (len(ways), 1))
    state = plant.reset(machine, q.copy())
    there = np.allclose(state.q, q, rtol=0, atol=0.01)
    require(there, name, "a reset to the angles that are given", brief(np.asarray(state.q)[0]))
    for _ in range(round(2 * machine.rate)):
        state = plant.step(machine, state, machine.pwm_limit / PWM_MAX * ways)
    moved = (ways * (state.q - q)).sum(axis=1).reshape(2, machine.n)  # up, down
    fits = np.all((moved > 0.005) & (moved < 1.5 * (high - low)))  # not in degrees
    wanted = "each joint to go up and down in 2 s of the largest commands"
    up, down = moved.round(3)
    require(bool(fits), name, wanted, f"{up} rad up and {down} rad down")
    return plant


@contextmanager
def of_user(name: str, what: str) -> Iterator[None]:
    """Run code of a user's file: any error is a ValueError, and paths stay those of the shell."""
    before = os.getcwd()
    with expected(Path(name), what):
        try:
            yield
        finally:
            os.chdir(before)


@dataclass(frozen=True)
class OwnPlant:
    """A plant of the user's file, whose every state is looked at. Errors are ValueErrors."""

    name: str
    plant: Plant

    def reset(self, machine: Machine, q: Any) -> Any:
        """The plant at rest at angles `q` [rad] (..., n)."""
        return self.checked("reset", np.shape(q), machine, q)

    def step(self, machine: Machine, state: Any, u: Any) -> Any:
        """One tick under the held command `u` [-1, 1] (..., n)."""
        return self.checked("step", np.shape(state.q), machine, state, u)

    def checked(self, method: str, shape: tuple[int, ...], machine: Machine, *given: Any) -> Any:
        """What a method makes of copies of what is given, because it may write to them.

        ValueError: whatever the file does, or a state without finite angles of this shape.
        """
        with of_user(self.name, "a plant whose states have angles q"):
            state = getattr(self.plant, method)(machine, *deepcopy(given))
            kind = np.asarray(state.q).dtype
            require(kind.kind in "fiu", "angles q of a state", "an array of numbers", kind)
            q = np.asarray(state.q, float)
            require(q.shape == shape, "angles q of a state", f"an array {shape}", q.shape)
            require(bool(np.isfinite(q).all()), "angles q of a state", "finite numbers", brief(q))
        return state


def own_controller(name: str, machine: Machine, net: ActuatorNet) -> Controller:
    """What NAME(machine, nets of its driven joints) of `FILE.py:NAME` gives, see `Controller`."""
    make = load_object("--controller", name)
    with of_user(name, "a function of machine and nets that gives a Controller"):
        controller: Controller = make(machine, net)
        require(callable(controller.start), "start", "a method", controller.start)
    return OwnController(name, machine, controller)


@dataclass(frozen=True)
class OwnController:
    """A controller of the user's file, whose every command is looked at. Errors are ValueErrors."""

    name: str
    machine: Machine
    inner: Controller

    def start(self, num: int) -> Any:
        """Its state, for `num` machines. ValueError: whatever the file does."""
        with of_user(self.name, "a controller whose start(num) gives its state"):
            return self.inner.start(num)

    def __call__(self, measured: Measured, state: Any) -> tuple[Array, Any]:
        """ValueError: whatever the file does, or what are no finite commands (num, n)."""
        with of_user(self.name, "a controller that returns commands and its state"):
            u, state = self.inner(measured, state)
            shape, kind = (len(measured.q), self.machine.n), np.asarray(u).dtype.kind
            require(np.shape(u) == shape, "commands", f"an array {shape}", np.shape(u))
            numbers = kind in "fiu" and bool(np.isfinite(u).all())
            require(numbers, "commands", "finite numbers", brief(u))
            counts = np.abs(u).max() > MOST_U
            require(not counts, "commands", "parts of full command, -1 to 1", brief(u))
            others = np.any(u[:, self.machine.locked])
            require(not others, "commands", "0 for joints that are not driven", brief(u))
        return u, state


def default_policy(machine: Machine, policy: Path | None) -> tuple[Path, Path | None]:
    """A policy, by default the package's, and the gains.json beside it, or the package's, or None.

    WrongUse: the package has no policy for the machine.
    """
    shipped = SHIPPED / machine.name
    path = policy or shipped / "policy.npz"
    check(bool(policy) or path.exists(), "--policy", f"one for {machine.name}", "none")
    folders = [path.parent, shipped] if machine == BROKK_170 else [path.parent]
    found = [folder / "gains.json" for folder in folders if (folder / "gains.json").exists()]
    return path, found[0] if found else None
