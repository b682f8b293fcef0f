"""PAPER.md is true, both ways: nothing of the paper is missing; code, docstrings and tests agree with it."""

from __future__ import annotations

import ast
import importlib
import inspect
import re
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest
from helpers_machines import small_net

import brokk_min
from brokk_min import jacobian, ppo
from brokk_min.actuator import plant_reset, plant_step
from brokk_min.env import TaskConfig, paper_view
from brokk_min.evaluation import (
    baselines,
    experiments,
    figures,
    metrics,
    preliminary,
    report,
    sequences,
)
from brokk_min.identification import excitation, fitting
from brokk_min.identification import validation as scores
from brokk_min.identification.logs import velocity_of
from brokk_min.kinematics import forward_kinematics, tool_position
from brokk_min.learning.gym_env import TaskVectorEnv
from brokk_min.machine import BROKK_170, valve_opening

ROOT = Path(__file__).parents[2]
PAPER = (ROOT / "PAPER.md").read_text()

# What the paper numbers: its labels and captions, worked from its source.
NUMBERED = [f"eq{i}" for i in range(1, 5)] + ["Table 1"]
PANELS = {1: "", 2: "abc", 3: "", 4: "", 5: "abcde", 6: "abcdefgh"}
NUMBERED += [
    f"Fig. {figure}{panel}" for figure, panels in PANELS.items() for panel in panels or [""]
]
SECTIONS = {
    "Sec. 2",
    "Sec. 3.2",
    "Sec. 3.3",
    "Sec. 3.4",
    "Sec. 4.1",
    "Sec. 4.2",
    "Sec. 5",
}  # those that say what to do
# Every number that the paper gives, as its row is called; a row may hold several.
CONSTANTS = [
    *("rate", "joints", "locked joint", "PWM code", "80/175", "50/205", "+0.24, -0.47 rad/s"),
    *(
        "400 ms, 100 ms",
        "coupling",
        "dead zone",
        "0.6 s, 0.05 s",
        "2 x 32",
        "errors of one step",
        "1 h",
        "0.75 h",
        "2.5 h",
        "5 %",
    ),
    *("no penalty", "256", "256-128-64", "q_s", "30 s", "K", "k"),
]


def table(heading: str) -> list[list[str]]:
    part = PAPER.split(f"\n## {heading}\n")[1].split("\n## ")[0]
    lines = [line for line in part.splitlines() if line.startswith("|")]
    cells = [[cell.strip() for cell in line.strip().strip("|").split("|")] for line in lines]
    assert all(len(row) == len(cells[0]) for row in cells), heading
    return cells[2:]


THINGS = table("Equations, tables, figures") + table("Sections")
ROWS = [row[-3:] for row in THINGS + table("Constants")]  # code, test, status


def quoted(cell: str) -> list[str]:
    return re.findall(r"`([^`]+)`", cell)


def look_up(symbol: str) -> Any:
    """The object of `module.name.name`; a dataclass field without a default gives the field."""
    module, *names = symbol.split(".")
    thing: Any = importlib.import_module(f"brokk_min.{module}")
    for name in names:
        known = getattr(thing, "__dataclass_fields__", {})
        thing = known[name] if name in known else getattr(thing, name)
    return thing


# --- rows ---------------------------------------------------------------------------------------------


def test_all_that_the_paper_numbers_has_one_row_in_its_order() -> None:
    assert [row[0] for row in table("Equations, tables, figures")] == NUMBERED
    assert {row[0] for row in table("Sections")} == SECTIONS
    assert [row[0] for row in table("Constants")] == CONSTANTS
    assert {row[1] for row in table("Constants")} <= SECTIONS | set(NUMBERED)


def test_every_row_has_a_status_and_code_and_test_unless_it_is_not_yet_there() -> None:
    for code, test, status in ROWS:
        kind = re.match(r"printed|corrected, [DS]\d|assumed.*, A\d|not yet", status)
        assert kind, status
        assert bool(quoted(code)) == bool(quoted(test)) == (kind[0] != "not yet"), (code, status)


def test_deviations_assumptions_and_slips_are_listed_and_named() -> None:
    listed = re.findall(r"^- \*\*([DAS])(\d+)[.,]", PAPER, re.M)
    for letter in "DAS":
        numbers = [int(number) for kind, number in listed if kind == letter]
        assert numbers == list(range(1, len(numbers) + 1)), letter
    every = {letter + number for letter, number in listed}
    assert set(re.findall(r"\b[DA]\d+\b", " ".join(status for *_, status in ROWS))) <= every
    named = set(re.findall(r"\b[DA]\d+\b", PAPER.replace("**D", "**").replace("**A", "**")))
    assert named >= {name for name in every if name[0] in "D"}, "a deviation that no row names"


def test_what_the_machine_has_from_the_paper_has_a_row() -> None:
    mapped = {symbol for code, _, _ in ROWS for symbol in quoted(code)}
    fields = {
        f"machine.Machine.{f}" for f, source in BROKK_170.sources.items() if source == "paper"
    }
    assert fields and fields <= mapped
    noted = set()
    for path in (ROOT / "brokk_min").glob("*.py"):
        for owner in (
            node for node in ast.parse(path.read_text()).body if isinstance(node, ast.ClassDef)
        ):
            for field, note in pairwise(owner.body):
                if isinstance(field, ast.AnnAssign) and "(paper: " in ast.unparse(note):
                    noted.add(f"{path.stem}.{owner.name}.{ast.unparse(field.target)}")
    assert len(noted) >= 5 and noted <= mapped, noted - mapped


# --- code -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("symbol", sorted({s for code, _, _ in ROWS for s in quoted(code)}))
def test_symbols_exist(symbol: str) -> None:
    look_up(symbol)


def tags(docstring: str | None) -> set[str]:
    """What a docstring names behind "Paper:", up to the end of the paragraph."""
    text = re.findall(r"Paper: (.*?)(?:\n\s*\n|$)", inspect.cleandoc(docstring or ""), re.S)
    return set(re.findall(r"eq\d|Table \d|Fig\. \d[a-h]?|Sec\. \d(?:\.\d)?", " ".join(text)))


def documented() -> Iterator[tuple[str, set[str]]]:
    """Symbol and tags of every docstring of the package that has any."""
    for path in sorted((ROOT / "brokk_min").glob("*.py")):
        tree = ast.parse(path.read_text())
        owned = [(path.stem, tree)]
        while owned:
            name, node = owned.pop()
            if found := tags(ast.get_docstring(node)):
                yield name, found
            parts = (n for n in node.body if isinstance(n, ast.FunctionDef | ast.ClassDef))
            owned += [(f"{name}.{part.name}", part) for part in parts]


def test_docstring_tags_and_rows_agree() -> None:
    """A tag `Fig. 6` stands for all its panels; rows of constants need no tag."""
    in_rows = {(row[0], symbol) for row in THINGS for symbol in quoted(row[-3])}
    in_docs = {(tag, symbol) for symbol, found in documented() for tag in found}
    constants = {(row[1], symbol) for row in table("Constants") for symbol in quoted(row[-3])}
    for tag, symbol in in_docs:
        assert any(s == symbol and i.startswith(tag) for i, s in in_rows | constants), (
            f"{symbol} says `Paper: {tag}`, but no row of PAPER.md for {tag} names it"
        )
    for row, symbol in in_rows:
        assert any(s == symbol and row.startswith(tag) for tag, s in in_docs), (
            f"PAPER.md has {symbol} for {row}, but its docstring has no tag `Paper: {row}`"
        )


# --- tests ----------------------------------------------------------------------------------------------


@cache
def parts(file: str) -> dict[str, ast.stmt]:
    """Top-level definitions and constants of a test file, and of the helpers that it imports, by name."""
    found: dict[str, ast.stmt] = {}
    for node in ast.parse((ROOT / "tests" / file).read_text()).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found[node.name] = node
        elif isinstance(node, ast.Assign):
            found |= {target.id: node for target in node.targets if isinstance(target, ast.Name)}
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("helpers_"):
            found |= parts(f"{node.module}.py")
    return found


def used(file: str, test: str) -> set[str]:
    """Names, keywords and words that a test uses, itself or in what it calls of its file and helpers."""
    names, ahead, known = set(), [test], parts(file)
    while ahead:
        for node in ast.walk(known[ahead.pop()]):
            for field in ("id", "attr", "arg", "value"):
                name = getattr(node, field, None)
                if isinstance(name, str) and name not in names:
                    names.add(name)
                    ahead += [name] if name in known else []
    return names


@pytest.mark.parametrize(("code", "test"), [(code, test) for code, test, _ in ROWS if quoted(test)])
def test_tests_exist_and_use_the_symbols(code: str, test: str) -> None:
    names: set[str] = set()
    for entry in quoted(test):
        file, function = entry.split("::")
        assert function in parts(file) and function.startswith("test_"), entry
        names |= used(file, function)
    symbols = {symbol.rpartition(".")[2] for symbol in quoted(code)}
    assert symbols <= names, f"{test} do not use {symbols - names}"


# --- what had no test of its own ------------------------------------------------------------------------


def test_the_constants_are_the_papers() -> None:
    net, learner = fitting.FitConfig(), ppo.PPOConfig()
    assert (BROKK_170.n, BROKK_170.history, net.history) == (5, 13, 13)
    assert (BROKK_170.history - 1) * BROKK_170.dt == pytest.approx(0.6)
    assert (net.hidden, TaskConfig().noise, learner.num_envs) == (32, 0.05, 256)
    assert (experiments.Effort().hours, max(scores.HORIZONS)) == (1.0, 30)
    layers = [layer.out_features for layer in ppo.mlp(7, 1, 1.0) if hasattr(layer, "out_features")]
    assert layers == [256, 128, 64, 1]
    controllers = baselines.baselines(BROKK_170, small_net(BROKK_170, np.random.default_rng(0)))
    assert {name: c.k for name, c in controllers.items()} == {
        "jacobian_pid_k0.1": 0.1,
        "jacobian_pid_k0.05": 0.05,
        "jacobian_pid_ff": 0.1,
        "jacobian_pid_ff_awake": 0.1,
    }
    assert jacobian.GAINS["feedback"] == (0.0, 1.0)


def rise_time(machine: brokk_min.Machine, before: int) -> float:
    """Seconds until q5 has 63 % of its gain in speed at 50 counts, after `before` counts."""
    fine = replace(machine, rate=1 / machine.plant_dt)
    state = plant_reset(fine, [1.5, 0.5, 0.58, 1.71, 0.3])
    speeds = []
    for count in [before] * 200 + [50] * 200:
        state = plant_step(fine, state, count / 127 * np.eye(5)[4])
        speeds.append(state.speed[4])
    return (
        np.argmax(np.array(speeds[200:]) > speeds[199] + 0.63 * (speeds[-1] - speeds[199])) + 1
    ) * 0.005


def test_an_idle_valve_is_what_makes_the_response_slow() -> None:
    """About 400 ms from idle, 100 ms when moving; a valve that is ready at once knows no difference."""
    assert rise_time(BROKK_170, 0) == pytest.approx(0.4, abs=0.02)
    assert rise_time(BROKK_170, 20) == pytest.approx(0.1, abs=0.02)
    ready = replace(BROKK_170, tau_valve_up=0.005)
    assert rise_time(ready, 0) == pytest.approx(0.1, abs=0.02)


def test_the_papers_coupling_test_is_marginal() -> None:
    """q5 with 80 alone, and beside 175, 175 and 80 on q1, q3 and q4; a smaller pump would show it."""
    together = np.array([-80, 0, -80, 80, 80]) / 127

    def speed(machine: brokk_min.Machine, u: np.ndarray) -> float:
        state = plant_reset(machine, [0.5, 0.5, 1.4, 1.2, 0.3])
        for _ in range(30):
            state = plant_step(machine, state, u)
        return float(state.speed[4])

    assert speed(BROKK_170, together) == pytest.approx(
        speed(BROKK_170, together * np.eye(5)[4]), rel=0.01
    )
    weak = replace(BROKK_170, pump_flow=0.3 * BROKK_170.pump_flow)
    assert speed(weak, together) < 0.9 * speed(weak, together * np.eye(5)[4])


def test_the_preliminary_figure_holds_its_three_tests() -> None:
    """q5 by 50, 80, 175, 205 over its range; alone and with the others; a step from idle and moving."""
    tests = preliminary.preliminary_tests(BROKK_170, preliminary.plant_mover(BROKK_170))
    assert list(tests.sweeps) == ["u = 50", "u = 80", "u = 175", "u = 205"]
    peaks = {name: round(float(v[np.abs(v).argmax()]), 2) for name, (_, v) in tests.sweeps.items()}
    assert (peaks["u = 80"], peaks["u = 175"]) == (0.24, -0.44)  # means over a tick
    assert 0 < peaks["u = 50"] < 0.24 and -0.44 < peaks["u = 205"] < 0
    alone, together = (curve[:, :150] for curve in tests.coupling.values())
    np.testing.assert_allclose(alone, together, atol=0.01)
    idle, moving = preliminary.response_times(tests.angles, BROKK_170.rate)[..., 4].reshape(2, -1)
    assert np.all(idle > 2.5 * moving)


def test_the_papers_excitation_is_the_sine() -> None:
    assert excitation.EXCITATIONS["sine"] is excitation.sine_command


def test_valve_opening_by_hand() -> None:
    found = valve_opening([-1.0, -0.07, 0.0, 0.05, 0.07, 0.535, 1.0], 0.07)
    np.testing.assert_allclose(found, [-1, 0, 0, 0, 0, 0.5, 1], atol=1e-12)


def test_without_a_valve_cost_the_reward_is_eq2_alone() -> None:
    rewards = {}
    for cost in (0.0, 0.01):
        env = TaskVectorEnv(20, config=TaskConfig(valve_cost=cost, integral_cost=0.0))
        env.reset(seed=0)
        _, rewards[cost], ended, _, info = env.step(np.ones((20, 4), np.float32))
        assert not ended.any()
    np.testing.assert_allclose(rewards[0.0], 1 / (1 + info["velocity_error"]), rtol=1e-6)
    np.testing.assert_allclose(
        rewards[0.0] - rewards[0.01], 0.01, rtol=1e-4
    )  # from idle to the limit


class Steady:
    """A controller that holds one command for ever."""

    def __init__(self, u: float) -> None:
        self.u = np.array([u, 0, -u, u, u])

    def start(self, num: int) -> None:
        return None

    def __call__(self, observation: np.ndarray, memory: None) -> tuple[np.ndarray, None]:
        return np.tile(self.u, (len(observation), 1)), None


STARTS = np.array([[1.5, 0.5, 0.58, 1.71, 1.24], [0.0, 0.7, 0.8, 1.5, 1.0]])


def short_runs() -> tuple[list[sequences.Commands], list[dict[str, Any]], figures.Traces]:
    short = [s._replace(goals=s.goals[15:45]) for s in sequences.axis_sequences(BROKK_170)]
    controllers = {"rl": Steady(0.3), "jacobian_pid_k0.1": Steady(-0.2)}
    return short, *metrics.evaluate(BROKK_170, controllers, short, STARTS, 0)


def test_figure_6_runs_every_controller_and_shows_its_panels() -> None:
    short, runs, traces = short_runs()
    wanted = [(c, s, i) for c in ("rl", "jacobian_pid_k0.1") for s in "xyz" for i in (0, 1)]
    assert [(r["controller"], r["sequence"], r["start"]) for r in runs] == wanted
    first = traces["rl", "x"].p_tool[0] - BROKK_170.dt * traces["rl", "x"].v_tool[0]
    figure = figures.plot_sequence(BROKK_170, traces, short[0], STARTS[1], 1)
    assert [ax.get_ylabel() for ax in figure.axes] == [
        *(f"{a} - {a}(0) [m]" for a in "xyz"),
        *(f"velocity {a} [m/s]" for a in "xyz"),
    ]
    for panel, ax in enumerate(figure.axes):
        lines = {line.get_label(): np.array(line.get_ydata()) for line in ax.lines}
        assert set(lines) == {"wanted", "rl", "jacobian_pid_k0.1"}
        trace, axis = traces["rl", "x"], panel % 3
        if panel < 3:
            np.testing.assert_allclose(
                lines["rl"], trace.p_tool[:, 1, axis] - first[1, axis], atol=1e-4
            )
            np.testing.assert_allclose(lines["wanted"], np.cumsum(short[0].goals[:, axis]) * 0.05)
        else:
            np.testing.assert_array_equal(lines["rl"], trace.v_tool[:, 1, axis])
            np.testing.assert_array_equal(lines["wanted"], short[0].goals[:, axis])
    rates = figures.plot_joint_rates(BROKK_170, traces, short[2], 0)
    assert [ax.get_ylabel() for ax in rates.axes] == [
        f"velocity q{i} [rad/s]" for i in (1, 3, 4, 5)
    ]
    for ax, joint in zip(rates.axes, (0, 2, 3, 4), strict=True):
        line = next(line for line in ax.lines if line.get_label() == "rl")
        np.testing.assert_array_equal(line.get_ydata(), traces["rl", "z"].q_dot[:, 0, joint])
    plt.close("all")


def test_figure_6_draws_its_starts_and_judges_singular_ones() -> None:
    figure = figures.plot_starts(BROKK_170, STARTS, ["extended", "extended"])
    reach = np.hypot(*tool_position(forward_kinematics(BROKK_170, STARTS[1]))[:2])
    assert np.max(figure.axes[0].lines[1].get_xdata()) == pytest.approx(reach)
    plt.close("all")
    net = small_net(BROKK_170, np.random.default_rng(0))
    controllers = {"rl": Steady(0.3), **baselines.baselines(BROKK_170, net)}
    traces, found = experiments.singular_case(BROKK_170, controllers, STARTS, 2.0, 0)
    assert {s for _, s in traces} == {"least_half", "least_quarter"} and len(found["claims"]) == 3
    assert [len(found[key]) for key in ("manipulability", "least")] == [2, 2]
    assert experiments.singular_case(BROKK_170, controllers, STARTS[:0], 2.0, 0)[0] == {}


def test_the_papers_view_leaves_out_the_wanted_rates() -> None:
    factors = paper_view(BROKK_170)
    assert factors.shape == (171,)
    assert not factors[-8:].any() and (factors[:-8] > 0).all()


def test_the_report_says_how_a_sentence_fares() -> None:
    said = [
        report.verdict({"paper": "a", "measured": "b", "holds": h}) for h in (True, False, None)
    ]
    assert len(set(said)) == 3
    assert [quote.lines[0][1] for quote in said] == [f"This {v}." for v in report.VERDICTS.values()]


def test_a_driven_log_is_what_encoders_and_valves_said() -> None:
    _, _, traces = short_runs()
    log = experiments.driven_log(BROKK_170, traces, "jacobian_pid_k0.1")
    assert [r.name[-4:] for r in log.recordings] == [f"{s}_{i:02d}" for s in "xyz" for i in (0, 1)]
    trace, recording = traces["jacobian_pid_k0.1", "y"], log.recordings[3]
    np.testing.assert_array_equal(recording.q, trace.q_measured[:, 1])
    np.testing.assert_array_equal(recording.u, trace.u[:, 1])
    np.testing.assert_array_equal(recording.q_dot, velocity_of(recording.q, 4))
    assert log.joints == BROKK_170.names and not log.velocity_logged
