"""The machine in MuJoCo has our geometry, obeys, and feels its load."""

import os
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
from PIL import Image

from brokk_min._files import SHIPPED
from brokk_min.actuator import lever_arm
from brokk_min.cli.options import find_plant
from brokk_min.evaluation.preliminary import simulate
from brokk_min.kinematics import forward_kinematics, tool_position
from brokk_min.machine import BROKK_170 as M
from brokk_min.machine import PWM_MAX
from examples.mini_excavator import MINI_EXCAVATOR as MINI
from examples.mujoco_brokk import PLANT, MujocoBrokk, build
from examples.own_mjcf import PLANT as OWN

EXAMPLE = Path(__file__).parents[1] / "examples" / "mujoco_brokk.py"
LOW, HIGH = M.column("q_min"), M.column("q_max")
POSES = [M.q_start, *np.random.default_rng(0).uniform(LOW, HIGH, (20, M.n))]


def length(model, data, q):
    """Lengths of the cylinders [m] at angles `q` [rad], of the slew that of a rope on its drum."""
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    return data.actuator_length.copy()


def speeds(plant):
    """Velocity [rad/s] (2, n) of each joint alone, up and down, in the last tick."""
    u = M.pwm_limit / PWM_MAX * np.concatenate([np.eye(M.n), -np.eye(M.n)])
    q = run(plant, np.tile(M.q_start, (2 * M.n, 1)), u, 30)
    return np.stack([np.diag(of) for of in np.split((q[-1] - q[-2]) / M.dt, 2)])


def run(plant, q, u, ticks):
    """Angles [rad] (ticks + 1, num, n) under held commands `u` (num, n)."""
    return simulate(M, plant, np.array(q), np.tile(u, (ticks, 1, 1)))


def test_geometry__is_that_of_the_machine():
    """At 21 poses: the tool, and lever arms as derivatives of lengths."""
    model, data = build(M, 0.0, 0.0)
    for q in POSES:
        step = 1e-5 * np.eye(M.n)
        arms = [length(model, data, q + d) - length(model, data, q - d) for d in step]
        np.testing.assert_allclose(np.array(arms) / 2e-5, np.diag(lever_arm(M, q)), atol=1e-6)
        length(model, data, q)
        tool = tool_position(forward_kinematics(M, np.array(q)))
        np.testing.assert_allclose(data.site("tool").xpos, tool, atol=1e-9)


def test_joints__obey_and_300_kg_slow_what_they_lift_by_a_few_percent():
    find_plant(f"{EXAMPLE}:PLANT", M)  # raises what it finds wrong
    up, down = speeds(PLANT)
    nominal = M.column("q_dot_up"), M.column("q_dot_down")
    assert (up > 0.4 * nominal[0]).all() and (down < -0.4 * nominal[1]).all()
    slowed = 1 - speeds(MujocoBrokk(load=300.0))[0] / up
    assert (slowed[1:] > 0.005).all() and (slowed[1:] < 0.08).all(), slowed


def test_closed_valves__hold_the_machine_with_its_load():
    q = run(MujocoBrokk(load=300.0), [M.q_start], np.zeros((1, M.n)), 100)
    np.testing.assert_allclose(q[-1], [M.q_start], atol=1e-4)


def test_one_pump__slows_joints_that_move_together():
    down, middle = np.full((1, M.n), -M.pwm_limit / PWM_MAX), (HIGH + LOW) / 2
    moved = [run(MujocoBrokk(pump=p), [middle], down, 30)[-1] - middle for p in (1.0, 0.5)]
    assert (moved[1] < 0).all() and (moved[1] > 0.8 * moved[0]).all()


def test_film__is_written_or_says_that_there_is_no_opengl(tmp_path):
    commands, out = tmp_path / "up.csv", tmp_path / "up.gif"
    commands.write_text("sequence,time,vx,vy,vz\nup,0,0,0,0.1\nup,1,0,0,0\n")
    policy = SHIPPED / M.name / "policy.npz"
    program = [sys.executable, "-m", "examples.mujoco_film", "--commands", commands]
    done = subprocess.run(
        [*program, "--policy", policy, "--out", out],
        cwd=EXAMPLE.parents[1],
        env=os.environ | {"MUJOCO_GL": "egl"},
        capture_output=True,
        text=True,
    )
    if done.returncode:
        assert "OpenGL" in done.stderr.splitlines()[-1]
    else:
        with Image.open(out) as pictures:
            assert pictures.size == (880, 400) and pictures.n_frames > 4


def test_own_mjcf__has_the_geometry_of_its_machine_and_obeys():
    """Machines do not depend on those beside them, and a tick is a tick."""
    find_plant(f"{EXAMPLE.with_name('own_mjcf.py')}:PLANT", MINI)
    low, high = MINI.column("q_min"), MINI.column("q_max")
    for q in np.random.default_rng(0).uniform(low, high, (20, MINI.n)):
        OWN.data.qpos[:] = q
        mujoco.mj_forward(OWN.model, OWN.data)
        tool = tool_position(forward_kinematics(MINI, q))
        np.testing.assert_allclose(OWN.data.site("tool").xpos, tool, atol=1e-9)
    u = 0.5 * np.eye(MINI.n)
    state = OWN.step(MINI, OWN.reset(MINI, np.tile((low + high) / 2, (MINI.n, 1))), u)
    for i in range(MINI.n):
        alone = OWN.step(MINI, OWN.reset(MINI, (low + high) / 2), u[i])
        np.testing.assert_array_equal(alone.q, state.q[i])
    for _ in range(25):
        before, state = state, OWN.step(MINI, state, u)
    speed = np.diag(state.q - before.q) * MINI.rate
    opening = (0.5 - 0.12) / (1 - 0.12)
    np.testing.assert_allclose(speed, opening * MINI.column("q_dot_up"), rtol=0.15)
