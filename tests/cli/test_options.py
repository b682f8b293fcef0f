"""Machines and plants of files, and policies of the package."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from helpers_machines import small_net

from brokk_min.actuator import PLANT
from brokk_min.can.canopen import Frame
from brokk_min.can.simulated_machine import SimulatedMachine
from brokk_min.cli.identification import Collect
from brokk_min.cli.options import Command, WrongUse, default_policy, find_plant
from brokk_min.identification.net_file import save_net
from brokk_min.machine import BROKK_170

FILE = """
from dataclasses import replace
from beside_it import NAME
from brokk_min.machine import BROKK_170
from brokk_min.actuator import AnalyticPlant
DIGGER = replace(BROKK_170, name=NAME)
LONG = replace(DIGGER, joints=tuple(replace(j, a=1000 * j.a) for j in DIGGER.joints))
TURNS = replace(DIGGER, joints=tuple(replace(j, q_max=57 * j.q_max) for j in DIGGER.joints))
PARKED = replace(DIGGER, joints=tuple(replace(j, driven=False) for j in DIGGER.joints))
NUMBER = 3

class Own(AnalyticPlant):
    def __init__(self, sign=1.0, scale=1.0, joints=5, ends=1e9):
        self.sign, self.scale, self.joints, self.ends = sign, scale, joints, ends

    def step(self, machine, state, u):
        import beside_it_late
        self.ends -= 1
        if self.ends < 0:
            raise SystemExit(0)
        state = super().step(machine, state, self.sign * u)
        return state._replace(q=self.scale * state.q[..., : self.joints])

class Overwrites(Own):
    def reset(self, machine, q):
        state = super().reset(machine, q)
        return state._make(array + 0 for array in state)._replace(q=q)

    def step(self, machine, state, u):
        u *= 0.5
        for array, new in zip(state, super().step(machine, state, 2 * u)):
            array[...] = new
        return state

class OnlyUp(Own):
    def step(self, machine, state, u):
        return super().step(machine, state, abs(u))

class Elsewhere(Own):
    def reset(self, machine, q):
        return super().reset(machine, q + 0.1)

ONLY_UP, ELSEWHERE = OnlyUp(), Elsewhere()
OVERWRITES, OBJECTS = Overwrites(), Own(scale=1 + 0j)
OWN, REVERSED, BROKEN, DEGREES = Own(), Own(-1.0), Own(scale=float("nan")), Own(scale=57.3)
FEWER, ENDS = Own(joints=4), Own(ends=60)

class Moves(Own):
    def reset(self, machine, q):
        import os; os.chdir("/")
        return super().reset(machine, q)

MOVES = Moves()
"""


@pytest.fixture
def file(tmp_path):
    """A file that imports others beside it, one of them late."""
    (tmp_path / "beside_it.py").write_text("NAME = 'digger'\n")
    (tmp_path / "beside_it_late.py").touch()
    (tmp_path / "own.py").write_text(FILE)
    return tmp_path / "own.py"


def test_find_machine__takes_a_name_or_an_object_of_a_file(file):
    assert Command().find_machine() is BROKK_170
    assert Command(machine=f"{file}:DIGGER").find_machine().name == "digger"
    with pytest.raises(WrongUse, match="--machine: expected a Machine, got 3"):
        Command(machine=f"{file}:NUMBER").find_machine()
    with pytest.raises(WrongUse, match=r"--machine: expected links in metres, below 100, got 1250"):
        Command(machine=f"{file}:LONG").find_machine()
    with pytest.raises(WrongUse, match=r"a range of q1 in rad, .*, got -2.14 to 121.98: degrees\?"):
        Command(machine=f"{file}:TURNS").find_machine()
    with pytest.raises(WrongUse, match=r"--machine: expected a driven joint or more, got none"):
        Command(machine=f"{file}:PARKED").find_machine()
    with pytest.raises(WrongUse, match=r"--machine: expected an object NONE in .*, got none"):
        Command(machine=f"{file}:NONE").find_machine()
    file.write_text("1 / 0")
    with pytest.raises(ValueError, match=r"--machine: expected .* to run, got division by zero"):
        Command(machine=f"{file}:DIGGER").find_machine()
    file.write_text("raise SystemExit(0)")
    with pytest.raises(ValueError, match=r"--machine: expected .* to run, got SystemExit"):
        Command(machine=f"{file}:DIGGER").find_machine()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ("tool_speed=400.0", "tool_speed in m/s, up to 10, got 400.0"),
        ("rate=0.04", "a rate of 1 to 1000 Hz, got 0.04"),
        ("history=10**9", "a history of up to 1000 ticks, got 1000000000"),
        ("joints=(replace(TILT, alpha=90),)", "q2.alpha in rad .*, up to 6.3, got 90: degrees"),
        ("joints=(replace(TILT, q_dot_up=24.0),)", r"q2.q_dot_up in rad \(m\), up to 10, got 24"),
    ],
)
def test_find_machine__doubts_other_units(tmp_path, changes, message):
    text = "from dataclasses import replace\nfrom brokk_min.machine import BROKK_170\n"
    text += "TILT = replace(BROKK_170.joints[1], driven=True)\n"
    (tmp_path / "own.py").write_text(f"{text}OWN = replace(BROKK_170, q_start=(), {changes})\n")
    with pytest.raises(WrongUse, match=f"--machine: expected {message}"):
        Command(machine=f"{tmp_path / 'own.py'}:OWN").find_machine()


def test_find_machine__stays_in_its_folder(file, monkeypatch):
    monkeypatch.chdir(file.parent)
    (file.parent / "deeper").mkdir()
    file.write_text(FILE + "\nimport os; os.chdir('deeper')")
    assert Command(machine="own.py:DIGGER").find_machine().name == "digger"
    assert Path.cwd() == file.parent


@dataclass(kw_only=True)
class Reads(Command):
    """It reads two files, and more."""

    logs: tuple[Path, ...] = (Path("a"), Path("b"))
    out: Path = Path("c")
    json: Path | None = None


def test_writes__refuses_a_name_for_two_files_before_the_work(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "link").symlink_to(tmp_path / "b")
    for out, more in (("c", "c"), ("b", None), (f"{tmp_path}/a", None), ("link", None), ("d", "c")):
        command = Reads(out=Path(out), json=more and Path(more), force=True)
        with pytest.raises(WrongUse, match="expected a name of its own, got that of another file"):
            command.writes(command.out, command.json, reads=[Path("d")])
    command.writes(Path("e"), command.json)
    with pytest.raises(WrongUse, match=r"m.py: expected a name of its own"):
        Reads(machine="m.py:M", force=True).writes(Path("m.py"))
    with pytest.raises(WrongUse, match=r"net.npz: expected a name of its own"):
        out = Path("net.npz")
        Collect(plant="net.npz", out=out, force=True).writes(out)


def test_writes__refuses_what_is_no_file_before_the_work(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").mkdir()
    (tmp_path / "nowhere").symlink_to(tmp_path / "missing" / "file")
    for name in ("folder", "nowhere", "missing/file", "/dev/full"):
        with pytest.raises(WrongUse, match=f"{name}: expected a file in an existing, writable"):
            Command(force=True).writes(Path(name))


def test_find_plant__tries_each_joint(file):
    assert find_plant("analytic", BROKK_170) is PLANT
    q = np.array(BROKK_170.q_start)
    assert np.array_equal(find_plant(f"{file}:OWN", BROKK_170).reset(BROKK_170, q).q, q)
    plant, u = find_plant(f"{file}:OVERWRITES", BROKK_170), np.full(5, 0.5)
    plant.step(BROKK_170, plant.reset(BROKK_170, q), u)
    assert (u == 0.5).all()  # what is recorded is what was commanded
    state = plant.reset(BROKK_170, q)
    after = plant.step(BROKK_170, plant.step(BROKK_170, state, u), u)
    assert after.q is not state.q and (state.q == q).all() and (q == BROKK_170.q_start).all()
    for name, message in {
        "NUMBER": "expected a plant .* got 'int' object has no attribute 'reset'",
        "REVERSED": r"expected each joint to go up .* got \[-",
        "BROKEN": "angles q of a state: expected finite numbers, got .*nan",
        "FEWER": r"angles q of a state: expected an array \(10, 5\), got \(10, 4\)",
        "ONLY_UP": r"expected each joint to go up and down .* rad up and \[-",
        "ELSEWHERE": "expected a reset to the angles that are given, got array",
        "DEGREES": "expected each joint to go up",
        "OBJECTS": "angles q of a state: expected an array of numbers, got complex128",
    }.items():
        with pytest.raises(ValueError, match=message):
            find_plant(f"{file}:{name}", BROKK_170)
    before = Path.cwd()
    find_plant(f"{file}:MOVES", BROKK_170)
    assert Path.cwd() == before
    plant = find_plant(f"{file}:ENDS", BROKK_170)
    state = plant.reset(BROKK_170, q)
    with pytest.raises(ValueError, match=r":ENDS: expected a plant .* got SystemExit\(0\)"):
        for _ in range(21):
            state = plant.step(BROKK_170, state, 0 * q)


def test_find_plant__takes_nets_of_the_machine(tmp_path):
    path = tmp_path / "n.npz"
    save_net(path, small_net(BROKK_170, np.random.default_rng(0)))
    plant, u = find_plant(str(path), BROKK_170), np.full(5, 0.6)
    machine = SimulatedMachine(BROKK_170, BROKK_170.q_start, 0.0, plant)
    machine.u = u
    expected = plant.step(BROKK_170, machine.state, u).q
    assert (expected != BROKK_170.q_start).tolist() == [True, False, True, True, True]
    machine.receive(Frame(0.05, 0x080, b""))  # a tick
    assert np.array_equal(machine.state.q, expected)
    with pytest.raises(ValueError, match=r"n\.npz: actuator: expected nets with name, rate"):
        find_plant(str(path), replace(BROKK_170, name="digger"))


def test_default_policy__is_the_packages_if_it_has_one():
    assert all(path and path.exists() for path in default_policy(BROKK_170, None))
    with pytest.raises(WrongUse, match="--policy: expected one for digger, got none"):
        default_policy(replace(BROKK_170, name="digger"), None)
