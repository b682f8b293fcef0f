"""Each exercise passes with its solution, and says what is missing and why an answer is wrong."""

import importlib
import re
from pathlib import Path

import numpy as np
import pytest

from brokk_min import actuator, env, jacobian, kinematics, machine
from exercises.__main__ import FILES, main
from exercises.hunt import bugs, judge
from exercises.symptoms import SYMPTOMS, measure
from exercises.verdict import judge as verdict

ROOT = Path(__file__).parents[2]
MODULES = {number: importlib.import_module(f"exercises.{FILES[number].stem}") for number in FILES}


def fit_net(inputs, targets):
    """Least squares on 500 random hidden units, instead of a training."""
    mean, std = inputs.mean(axis=0), inputs.std(axis=0) + 1e-6
    w = np.random.default_rng(0).normal(0, 0.3, (39, 500))
    units = lambda x: np.maximum((x - mean) / std @ w + w[0], 0)  # noqa: E731
    solution = np.linalg.lstsq(units(inputs), targets, rcond=1e-4)[0]
    return lambda x: units(x) @ solution


def free_run(predict, history, q, commands):
    angles = []
    for u in commands:
        q = q + predict(actuator.append_command(history, u).reshape(len(q), -1)) / 20
        history = actuator.append_sample(history, u, q, 4, 1 / 20)
        angles.append(q)
    return np.array(angles)


def reward_gradient(v_goal, v_tool):
    error = v_goal - v_tool
    size = np.linalg.norm(error)
    return error / (max(size, 1e-6) * (1 + size) ** 2)


def damping(J, w0, k):
    return jacobian.nakamura_damping(jacobian.manipulability(J), w0, k)


def damped_velocities(J, v, w0, k):
    return jacobian.dls(J, np.ones(J.shape[1]), damping(J, w0, k) + 1e-12) @ v


def lever_arm(a, b, gamma):
    return a * b * np.sin(gamma) / np.sqrt(a**2 + b**2 - 2 * a * b * np.cos(gamma))


def shifted_jacobian(rows, q):
    """With the axes of the frames behind the joints."""
    frames = MODULES[2].our_frames(rows, q)
    return kinematics.jacobian(frames._replace(z=np.roll(frames.z, -1, axis=0)))


SOLUTIONS = {
    1: {
        "encode": lambda counts: int(machine.encode_pwm(counts / 127)),
        "decode": lambda byte: round(machine.decode_pwm(byte) * 127),
    },
    2: {
        "tool_position": lambda *arm: kinematics.tool_position(MODULES[2].our_frames(*arm)),
        "jacobian": lambda *arm: kinematics.jacobian(MODULES[2].our_frames(*arm)),
    },
    3: {
        "lever_arm": lever_arm,
        "joint_velocity": lambda v, a, b, gamma: v / lever_arm(a, b, gamma),
    },
    4: {
        "half_gradient": lambda J, W, d, v, q_dot: J.T @ (J @ q_dot - v) + d * W * q_dot,
        "minimiser": lambda J, W, d, v: jacobian.dls(J, W, d) @ v,
    },
    5: {"damping": damping, "damped_velocities": damped_velocities},
    6: {
        "velocity": actuator.estimate_velocity,
        "append": lambda h, u, q, *by: actuator.append_sample(h[None], [u], np.array([q]), *by)[0],
    },
    7: {"fit": fit_net, "free_run": free_run},
    8: {"reward": env.reward, "gradient": reward_gradient},
    9: {
        "gae": MODULES[9].ours,
        "group": lambda r: (r - r.mean(1, keepdims=True)) * r.shape[1] / (r.shape[1] - 1),
    },
    10: {"loss": MODULES[10].our_loss, "counts": MODULES[10].our_counts},
    11: {"drives": MODULES[11].our_drives, "limit": MODULES[11].our_limit},
}
WRONG = {  # a function, a typical wrong answer, words of the verdict
    1: ("encode", lambda counts: counts % 256, "two's complement"),
    2: ("jacobian", shifted_jacobian, "z_0 x (p_4 - p_0)"),
    3: ("joint_velocity", lambda v, a, b, gamma: v * lever_arm(a, b, gamma), "v / r"),
    4: ("minimiser", lambda J, W, d, v: jacobian.dls(J, W, d, as_printed=True) @ v, "1/24"),
    5: ("damping", lambda J, w0, k: k, "w is 0.5"),
    6: ("velocity", lambda q, samples, dt: (q[-1] - q[-2]) / dt, "By hand"),
    7: ("fit", lambda x, y: lambda x: np.full(len(x), y.mean()), "one step"),
    8: ("gradient", lambda v_goal, v_tool: v_tool - v_goal, "towards the goal"),
    9: ("group", lambda r: r - r.mean(axis=1, keepdims=True), "The others of 1"),
    10: ("loss", lambda ratio, a, eps: -np.mean(np.clip(ratio, 1 - eps, 1 + eps) * a), "smaller"),
    11: ("drives", lambda driving, enable, *others: enable, "no edge"),
}


@pytest.mark.parametrize("number", sorted(FILES))
def test_exercise__passes_with_its_solution_and_says_what_else_is_wrong(number, capsys):
    name, wrong, words = WRONG[number]
    assert verdict(MODULES[number], SOLUTIONS[number]) == ""
    assert words in verdict(MODULES[number], SOLUTIONS[number] | {name: wrong})
    assert main([str(number)]) == 1  # as handed out
    assert f"(exercises/{FILES[number].name}, line " in capsys.readouterr().out
    for part in MODULES[number].SOLUTION.split(";"):
        path, _, names = part.strip().partition(": ")
        for name in re.findall(r"\w+", names):
            assert re.search(rf"(def|class) {name}\b", (ROOT / path).read_text()), name


@pytest.mark.parametrize("name", [*SYMPTOMS])
def test_measure__shows_numbers_of_the_sound_package(name):
    rows = measure(name)
    assert rows and "raised" not in rows, rows


@pytest.mark.parametrize("bug", bugs(), ids=lambda bug: f"{bug.file}:{bug.line}")
def test_bug__is_one_line_of_the_package_and_found_there_alone(bug):
    assert (ROOT / "brokk_min" / bug.file).read_text().count(bug.right) == 1
    assert judge(bug, f"hunts/07/brokk_min/{bug.file}:{bug.line}")[0]
    assert judge(bug, f"{bug.file}:{bug.line + 2}") == (False, "The right file, another line.")
    assert judge(bug, "__init__.py:1") == (False, "Not there: another file.")
