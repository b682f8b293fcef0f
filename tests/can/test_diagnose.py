"""Ten faults planted in a drive of a policy on its nets: `examples/diagnose.py` names them."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers_bus import random_policy

from brokk_min._files import SHIPPED
from brokk_min.actuator import append_sample, initial_history
from brokk_min.can.drive_log import Telemetry
from brokk_min.env import measure
from brokk_min.evaluation.sequences import axis_sequences
from brokk_min.machine import BROKK_170 as M
from brokk_min.machine import read_encoder
from examples.diagnose import diagnose

PROGRAM = Path(__file__).parents[2] / "examples" / "diagnose.py"
START = np.array([[0.0, 0.5, 0.58, 1.71, 1.24]])
POLICIES = {name: random_policy(name) for name in ("paper", "beyond")}


def drive(observe=lambda h: h, send=lambda u: u, ticks_of_plant=1, name="paper"):
    """A drive with a fault: in what the policy gets, or the valves."""
    policy = POLICIES[name]
    goals = np.concatenate([sequence.goals[20:120] for sequence in axis_sequences(M)])
    state, memory, u, ticks = policy.net.reset(M, START), None, np.zeros((1, 5)), []
    history = initial_history(np.float32(read_encoder(M, START)), M.history)
    for t, goal in enumerate(goals):
        q = read_encoder(M, state.q)
        history = append_sample(history, u, q, M.velocity_samples, M.dt)
        v_goal = goal[None].astype(np.float32)
        u, memory = policy(measure(M, observe(history.copy()), v_goal), memory)
        time = t * ticks_of_plant / 20
        ticks.append(Telemetry(time, q[0], u[0].astype(float), goal, True))
        for _ in range(ticks_of_plant):
            state = policy.net.step(M, state, send(u))
    return ticks


def tick_late():
    """Gives what it got at the tick before."""
    kept = []
    return lambda x: kept.append(x) or kept[-2:][0]


def scaled(*factors):
    return lambda history: history * np.array(factors, np.float32)[:, None]


SIGN = np.array([1, 1, 1, -1, 1])
ZERO = np.zeros((5, 3, 1), np.float32)
ZERO[3, 0] = 0.2  # rad
FAULTS = {
    "sign of q4": {"send": lambda u: u * SIGN},
    "order of q3, q5": {"send": lambda u: u[:, [0, 1, 4, 3, 2]]},
    "scale of angles and velocities: 57.3": {"observe": scaled(180 / np.pi, 180 / np.pi, 1)},
    "one sample late": {"observe": tick_late()},
    "rate: 10 Hz instead of 20 Hz": {"ticks_of_plant": 2},
    "dead zone": {"send": lambda u: np.sign(u) * np.maximum(np.abs(u) - 0.06, 0)},
    "scale of commands: 0.5": {"send": lambda u: 0.5 * u},
    "order of the history": {"observe": lambda history: history[..., ::-1].copy()},
    "zero of q4": {"observe": lambda history: history + ZERO},
    "delay: 50 ms more": {"send": tick_late()},
}


@pytest.mark.parametrize("name", POLICIES)
def test_diagnose__finds_nothing_in_a_sound_drive(name):
    assert diagnose(M, POLICIES[name], drive(name=name)) == []


@pytest.mark.parametrize("name", FAULTS)
def test_diagnose__names_a_planted_fault(name):
    terms = diagnose(M, POLICIES["paper"], drive(**FAULTS[name]))
    assert any(name in term.name for term in terms[:3]), terms[:6]


def test_program__names_a_log_that_tells_nothing_in_one_line(tmp_path):
    policy = SHIPPED / M.name / "policy.npz"
    (tmp_path / "empty.log").write_text("")
    for log, words in (("none.log", "none.log"), ("empty.log", "some of which drive")):
        command = [sys.executable, PROGRAM, tmp_path / log, policy]
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode == 1 and done.stderr.count("\n") == 1, done.stderr
        assert done.stderr.startswith("diagnose.py: ") and words in done.stderr
