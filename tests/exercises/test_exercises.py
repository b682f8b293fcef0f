"""Each exercise passes with its solution, and says what is missing as handed out."""

from __future__ import annotations

import importlib
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import exercises
from brokk_min import actuator, env, jacobian, kinematics
from brokk_min.kinematics import estimate_velocity
from brokk_min.machine import decode_pwm, encode_pwm
from exercises.__main__ import FILES, main
from exercises.hunt import bugs
from exercises.verdict import judge

ROOT = Path(exercises.__file__).parents[1]
MODULES = {number: importlib.import_module(f"exercises.{FILES[number].stem}") for number in FILES}


def fit_net(inputs, targets):
    """A small net of the package's shape, trained for a second."""
    torch.manual_seed(0)
    mean, std = inputs.mean(axis=0), inputs.std(axis=0) + 1e-6
    nn = torch.nn
    layers = nn.Linear(39, 32), nn.ReLU(), nn.Linear(32, 32), nn.ReLU(), nn.Linear(32, 1)
    net = nn.Sequential(*layers)
    x, y = torch.tensor((inputs - mean) / std).float(), torch.tensor(targets).float()
    optimizer = torch.optim.Adam(net.parameters(), lr=3e-3)
    for _ in range(400):
        rows = torch.randint(len(x), (512,))
        loss = ((net(x[rows])[:, 0] - y[rows]) ** 2).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return lambda x: net(torch.tensor((x - mean) / std).float())[:, 0].detach().numpy()


def free_run(predict, history, q, commands):
    angles = []
    for u in commands:
        inputs = actuator.append_command(history, u)
        q = q + predict(inputs.reshape(len(q), -1)) / 20
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


def append(history, u, q, samples, dt):
    return actuator.append_sample(history[None], [u], np.array([q]), samples, dt)[0]


def tool_position(rows, q):
    return kinematics.tool_position(MODULES[2].our_frames(rows, q))


def lever_arm(a, b, gamma):
    """By the package, of joints with this triangle."""
    triangle = {"cylinder_base": a, "cylinder_rod": b, "cylinder_angle": 0.0}
    machine = SimpleNamespace(column=triangle.__getitem__)
    return float(actuator.lever_arm(machine, gamma))


def shifted_jacobian(rows, q):
    """With the axes of the frames behind the joints."""
    frames = MODULES[2].our_frames(rows, q)
    return kinematics.jacobian(frames._replace(z=np.roll(frames.z, -1, axis=0)))


SOLUTIONS = {
    1: {
        "encode": lambda counts: int(encode_pwm(counts / 127)),
        "decode": lambda byte: round(decode_pwm(byte) * 127),
    },
    2: {
        "tool_position": tool_position,
        "jacobian": lambda rows, q: kinematics.jacobian(MODULES[2].our_frames(rows, q)),
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
    6: {"velocity": estimate_velocity, "append": append},
    7: {"fit": fit_net, "free_run": free_run},
    8: {"reward": env.reward, "gradient": reward_gradient},
    9: {"gae": MODULES[9].ours},
    10: {"loss": MODULES[10].our_loss, "counts": MODULES[10].our_counts},
    11: {"command_gradients": MODULES[11].our_gradients},
    12: {"Mine": lambda machine: MODULES[12].opponents()["PID, k = 0.1"]},
    13: {"drives": MODULES[13].our_drives, "limit": MODULES[13].our_limit},
}


def clipped_alone(ratio, a, eps):
    return -np.mean(np.clip(ratio, 1 - eps, 1 + eps) * a)


WRONG = {  # a function, a typical wrong answer, words of the verdict
    1: ("encode", lambda counts: counts % 256, "two's complement"),
    2: ("jacobian", shifted_jacobian, "z_0 x (p_4 - p_0)"),
    3: ("joint_velocity", lambda v, a, b, gamma: v * lever_arm(a, b, gamma), "v / r"),
    4: ("minimiser", lambda J, W, d, v: jacobian.dls(J, W, d, as_printed=True) @ v, "1/24"),
    5: ("damping", lambda J, w0, k: k, "w is 0.5"),
    6: ("velocity", lambda q, samples, dt: (q[-1] - q[-2]) / dt, "By hand"),
    7: ("fit", lambda x, y: lambda x: np.full(len(x), y.mean()), "one step"),
    8: ("gradient", lambda v_goal, v_tool: v_tool - v_goal, "towards the goal"),
    9: (
        "gae",
        lambda r, v, v1, end, cut, *c: MODULES[9].ours(r, v, v1, end + cut, cut, *c),
        "time limit",
    ),
    10: ("loss", clipped_alone, "The smaller of the two"),
    11: ("command_gradients", lambda *case: 1.5 * MODULES[11].our_gradients(*case), "1 ticks"),
    13: ("drives", lambda driving, enable, *others: enable, "no edge"),
}


@pytest.mark.parametrize("number", sorted(FILES))
def test_exercise__passes_with_its_solution(number: int) -> None:
    assert judge(MODULES[number], SOLUTIONS[number]) == ""


@pytest.mark.parametrize("number", sorted(FILES))
def test_exercise__as_handed_out_says_what_to_fill_in(
    number: int, capsys: pytest.CaptureFixture[str]
) -> None:
    if FILES[number].read_text().count("raise NotImplementedError") < len(SOLUTIONS[number]):
        pytest.skip("somebody works on it")
    assert main([str(number)]) == 1
    name = next(iter(SOLUTIONS[number]))
    printed = capsys.readouterr().out
    assert "nothing there yet: fill in `" in printed
    assert f"exercises/{FILES[number].name}, line " in printed
    assert name in printed or number in (7, 12)


@pytest.mark.parametrize("number", sorted(WRONG))
def test_exercise__says_why_a_typical_answer_is_wrong(number: int) -> None:
    name, wrong, words = WRONG[number]
    assert words in judge(MODULES[number], SOLUTIONS[number] | {name: wrong})


@pytest.mark.parametrize("words", [["check"], ["format", "--check"]])
def test_exercises__as_handed_out_pass_the_linter(words: list[str]) -> None:
    """`make lint` leaves them out: readers fill them in."""
    files = [file for file in FILES.values() if "raise NotImplementedError" in file.read_text()]
    assert not subprocess.run([sys.executable, "-m", "ruff", *words, *files]).returncode


def test_judge__says_where_an_answer_raised() -> None:
    message = judge(MODULES[1], SOLUTIONS[1] | {"encode": lambda counts: [][counts]})
    assert "IndexError" in message


@pytest.mark.parametrize("number", sorted(FILES))
def test_solutions__stand_where_the_exercise_says(number: int) -> None:
    text = ""
    for part in MODULES[number].SOLUTION.split(";"):
        path, _, names = part.strip().partition(": ")
        folder = ROOT if "/" in path else ROOT / "brokk_min" / "identification"
        text = (folder / path).read_text()
        for name in re.findall(r"\w+", names):
            assert re.search(rf"(def|class) {name}\b|\b{name} = ", text), name


def test_main__lists_the_exercises_and_refuses_others(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    assert capsys.readouterr().out.count(" minutes)") == 13
    assert main(["14"]) == 2
    assert main(["one"]) == 2
    assert "expected a number from 1 to 13" in capsys.readouterr().out


def test_page__has_every_exercise_with_its_minutes_and_every_bug() -> None:
    page = (ROOT / "exercises" / "README.md").read_text()
    rows = re.findall(r"^\| (\d+) \| .* \| \[(\w+\.py)\]\(\2\) \| (\d+) \|$", page, re.M)
    assert {int(number): file for number, file, _ in rows} == {n: f.name for n, f in FILES.items()}
    assert [int(number) for number, *_ in rows] == list(range(1, 14)) == sorted(SOLUTIONS)
    for number, _, minutes in rows:
        text = MODULES[int(number)].__doc__ or ""
        assert f"({minutes} minutes)" in text
        assert 8 <= len(text.splitlines()) <= 40
    assert "Sixty errors" in page
    assert len(bugs()) == 60
    assert max(len(line) for line in page.splitlines() if line[:1] != "|") <= 100
