"""Ten faults planted in a drive on the plant: the log names them."""

import json
from dataclasses import replace

import numpy as np
import pytest
from helpers_bus import HoldingOperator, World
from helpers_cli import run

from brokk_min.actuator import initial_history, plant_reset, plant_step
from brokk_min.can.diagnosis import COMMAND_ERROR, Ticks, diagnose
from brokk_min.env import measure, update_history
from brokk_min.evaluation.sequences import axis_sequences
from brokk_min.identification.files import SHIPPED
from brokk_min.learning.policy import PolicyController, load_policy
from brokk_min.machine import BROKK_170 as M
from brokk_min.machine import read_encoder

FILE = SHIPPED / "brokk170" / "policy.npz"
POLICY = load_policy(FILE, M)
DITHER = replace(POLICY, valves="dither")
PAPER = load_policy(FILE.with_name("policy_paper.npz"), M)
START = np.array([[0.0, 0.5, 0.58, 1.71, 1.24]])
SECONDS = 14


def drive(observe=lambda h: h, send=lambda u: u, read=lambda q: q, ticks_of_plant=1, policy=POLICY):
    """A drive with a fault: in what the policy gets, the valves get, or the encoders give."""
    controller = PolicyController(M, policy)
    goals = np.concatenate([0.7 * sequence.goals[20:120] for sequence in axis_sequences(M)])
    plant, state = plant_reset(M, START), controller.start(1)
    history, integral, goal = None, np.zeros((1, 3), np.float32), np.zeros((1, 3), np.float32)
    u, rows = np.zeros((1, 5)), []
    for t, next_goal in enumerate(goals[: SECONDS * 20]):
        q = read_encoder(M, read(plant.q)).astype(np.float32)
        if history is None:
            history = initial_history(q, M.history)
        else:
            history, integral = update_history(M, history, u, q, goal, integral)
        goal = next_goal[None].astype(np.float32)
        measured = measure(M, observe(history.copy()), goal, integral)
        u, state = controller(measured, state)
        rows.append((t * ticks_of_plant / 20, q[0], u[0], goal[0], True))
        for _ in range(ticks_of_plant):
            plant = plant_step(M, plant, send(u))
    return Ticks(*map(np.array, zip(*rows, strict=True)))


def tick_late():
    """Gives what it got at the tick before."""
    kept = []

    def act(x):
        kept.append(x)
        return kept[-2:][0]

    return act


def scaled(*factors):
    return lambda history: history * np.array(factors, np.float32)[:, None]


SIGN = np.array([1, 1, 1, -1, 1])
ZERO = np.zeros((5, 3, 1), np.float32)
ZERO[3, 0] = 0.15  # rad
FAULTS = {
    "sign of q4": {"send": lambda u: u * SIGN},
    "order of q3, q5": {"send": lambda u: u[:, [0, 1, 4, 3, 2]]},
    "degrees": {"observe": scaled(180 / np.pi, 180 / np.pi, 1)},
    "one sample late": {"observe": tick_late()},
    "rate: 10 Hz instead of 20 Hz": {"ticks_of_plant": 2},
    "dead zone": {"send": lambda u: np.sign(u) * np.maximum(np.abs(u) - 0.05, 0)},
    "scale of commands: 0.5": {"send": lambda u: 0.55 * u},
    "order of the history": {"observe": lambda history: history[..., ::-1].copy()},
    "zero of q4": {"observe": lambda history: history + ZERO},
    "delay: 50 ms more": {"send": tick_late()},
}


@pytest.mark.parametrize("policy", [POLICY, DITHER, PAPER], ids=["policy", "dither", "paper"])
def test_diagnose__finds_nothing_in_a_sound_drive(policy):
    assert diagnose(M, policy, drive(policy=policy)) == []


def test_diagnose__cannot_see_an_encoder_zero_that_the_log_has_too():
    """The nets hardly depend on the angle: only a measured pose tells."""
    assert diagnose(M, POLICY, drive(read=lambda q: q + 0.3 * (np.arange(5) == 3))) == []


@pytest.mark.parametrize("name", FAULTS)
def test_diagnose__names_a_planted_fault(name):
    terms = diagnose(M, POLICY, drive(**FAULTS[name]))
    names = [term.name for term in terms[:3]]
    assert any(name in one for one in names), terms[:6]


class Reversed(PolicyController):
    """A program that hands over its history the wrong way round."""

    def __call__(self, measured, ticks):
        return super().__call__(measured._replace(history=measured.history[..., ::-1]), ticks)


def write_drive(log, controller):
    """A log of 5 s on the simulated bus: a rest, up and forward, back."""
    world = World(controller, HoldingOperator(), log=log)
    world.drive.begin()
    for seconds, side in ((1.0, 0), (2.0, 1), (2.0, -1)):
        world.operator.v = (0.0, 0.15 * side, 0.1 * side)
        world.run(seconds)
    world.bus.close()


def test_command__compares_with_the_valves_that_drove(tmp_path, capsys):
    log = tmp_path / "run.log"
    write_drive(log, PolicyController(M, DITHER))
    command = f"diagnose '{log}' --policy '{FILE}'"
    assert run(f"{command} --valves dither --json '{tmp_path}/d.json'") == 0
    assert "commands and motion are as the policy" in capsys.readouterr().out
    assert json.loads((tmp_path / "d.json").read_text())["command_error"] < COMMAND_ERROR
    assert run(command) == 0
    assert "commands: valves at rest: dither (" in capsys.readouterr().out.splitlines()[1]
    write_drive(log, PolicyController(M, PAPER))
    assert run(f"{command}") == 0
    assert "another policy, controller or --valves?" in capsys.readouterr().out


def test_command__prints_terms_and_draws_them(tmp_path, capsys):
    log = tmp_path / "run.log"
    write_drive(log, Reversed(M, POLICY))
    files = f"--figure '{tmp_path}/d.png' --json '{tmp_path}/d.json'"
    assert run(f"diagnose '{log}' --policy '{FILE}' {files}") == 0
    printed = capsys.readouterr().out
    assert "commands: order of the history" in printed.splitlines()[1]
    found = json.loads((tmp_path / "d.json").read_text())
    assert found["terms"][0]["name"] == "order of the history"
    assert (tmp_path / "d.png").read_bytes().startswith(b"\x89PNG")
    lines = log.read_text().splitlines(keepends=True)
    log.write_text("".join(lines[: len(lines) // 9]))
    assert run(f"diagnose '{log}' --policy '{FILE}'") == 1
    assert "run.log: log: expected 73 ticks of driving in a row" in capsys.readouterr().err
