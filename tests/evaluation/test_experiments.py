"""The comparison: figures worked by hand, honest sequences and starts, the chain's repeatability."""

from __future__ import annotations

import html
import itertools
import json
import re
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_rgb

from benchmarks.rollout import random_net
from brokk_min import jacobian, kinematics
from brokk_min.actuator import ActuatorNet, plant_reset, plant_step, speed_limits
from brokk_min.env import Measured, TaskConfig, action_to_pwm, measured
from brokk_min.evaluation import baselines, experiments, figures, report
from brokk_min.evaluation import reproduce as chain
from brokk_min.evaluation import robustness as variations
from brokk_min.evaluation.metrics import metrics
from brokk_min.evaluation.rollout import Trace, rollout
from brokk_min.evaluation.sequences import task_sequences, tuning_goals
from brokk_min.identification.logs import velocity_of
from brokk_min.identification.net_file import fingerprint, load_net, save_net
from brokk_min.kinematics import forward_kinematics, joint_rates, tool_position
from brokk_min.machine import BROKK_170, Machine, read_encoder

TINY = experiments.Effort(0.02, 60, 8192, 1, 2, 4, 2, 1.0)


class _Idle:
    """A controller that does nothing, for machines that should stand still."""

    def start(self, num: int) -> None:
        return None

    def __call__(self, observation: np.ndarray, memory: None) -> tuple[np.ndarray, None]:
        return np.zeros((len(observation), BROKK_170.n)), None


@dataclass(frozen=True)
class FeedForward:
    """Another controller, as a student would add it: the plant's steady commands for damped joint rates."""

    machine: Machine

    def start(self, num: int) -> None:
        return None

    def __call__(self, observation: np.ndarray, memory: None) -> tuple[np.ndarray, None]:
        seen: Measured = measured(self.machine, observation)
        down, up = speed_limits(self.machine, seen.q)
        rates = joint_rates(self.machine, seen.q, seen.v_goal)
        share = rates / np.where(
            rates > 0, *(limit[:, self.machine.driven] for limit in (up, -down))
        )
        return action_to_pwm(self.machine, share), None


def test_another_controller_takes_twenty_lines() -> None:
    start = np.array([[1.5, 0.5, 0.58, 1.71, 1.24], [1.0, 0.5, 0.58, 1.71, 1.24]])
    short = experiments.shortened(BROKK_170, task_sequences(BROKK_170)[:3], 4.0)
    controllers = {"idle": _Idle(), "mine": FeedForward(BROKK_170)}
    runs, traces = experiments.task_space(BROKK_170, controllers, short, start, 0)
    error = {
        c: np.mean([r["velocity_error_mean"] for r in runs if r["controller"] == c])
        for c in controllers
    }
    assert error["mine"] < 0.5 * error["idle"]
    assert set(traces) == {(c, s) for c in controllers for s in "xyz"}
    assert [(r["controller"], r["sequence"], r["start"]) for r in runs[:3]] == [
        ("idle", "x", 0),
        ("idle", "x", 1),
        ("idle", "y", 0),
    ]


def test_curves_of_one_plot_differ_on_grey_paper() -> None:
    controllers = (
        "rl",
        "jacobian_pid_k0.1",
        "jacobian_pid_k0.05",
        "jacobian_pid_ff",
        "perfect_model",
    )
    for group in (controllers, ("workspace", "limits", "extended")):
        colours = np.array([to_rgb(figures.STYLES[name]["color"]) for name in group])
        grey = np.sort(colours @ [0.299, 0.587, 0.114])
        assert (np.diff(grey) > 0.1).all() and grey[-1] < 0.8, group


def test_names_below_bars_do_not_touch() -> None:
    names = [s.name for s in task_sequences(BROKK_170)]
    number = {"mean": 0.1, "low": 0.05, "high": 0.2}
    figure = figures.plot_bars({"error [m/s]": {"rl": dict.fromkeys([*names, "all"], number)}})
    figure.draw_without_rendering()
    boxes = [label.get_window_extent() for label in figure.axes[0].get_xticklabels()]
    assert all(one.x1 + 4 < two.x0 for one, two in itertools.pairwise(boxes))


def net_of_driven_joints() -> ActuatorNet:
    return random_net(np.random.default_rng(0)).select(["q1", "q3", "q4", "q5"])


@pytest.fixture(scope="module")
def twice(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folders = (
        tmp_path_factory.mktemp("a b"),
        tmp_path_factory.mktemp("second"),
    )  # a space in the path
    for folder in folders:
        chain.reproduce(BROKK_170, folder, TINY, 3)
    return folders


def test_the_chain_gives_the_same_bits_twice(twice: tuple[Path, Path]) -> None:
    for name in ("log.npz", "net.npz", "policy.npz", "gains.json", "results.json"):
        assert (twice[0] / name).read_bytes() == (twice[1] / name).read_bytes(), name


def test_results_hold_every_run_with_its_figures(twice: tuple[Path, Path]) -> None:
    results = json.loads((twice[0] / "results.json").read_text())
    runs = results["task_space"]["runs"]
    names = {
        "rl",
        "jacobian_pid_k0.1",
        "jacobian_pid_k0.05",
        "jacobian_pid_ff",
        "jacobian_pid_ff_awake",
    }
    keys = {(r["controller"], r["sequence"], r["start"]) for r in runs}
    sequences = [s.name for s in task_sequences(BROKK_170)]
    assert keys == {(c, s, i) for c in names for s in sequences for i in range(4)}
    assert all(r["velocity_rmse"] >= r["velocity_error_mean"] > 0 for r in runs)
    assert all(0 < r["reward_mean"] < 1 for r in runs)
    assert set(results["paper_recipe"]["test"]) == set(results["actuator"]["test"])
    assert results["paper_recipe"]["sim_to_real"]["tool"]["position_error_mean"] > 0
    assert results["start_kinds"] == ["workspace", "limits", "workspace", "extended"]
    assert all(r["kind"] == results["start_kinds"][r["start"]] for r in runs)
    scored = [r for r in runs if r["kind"] == "workspace"]
    rl = [r["velocity_error_mean"] for r in scored if r["controller"] == "rl"]
    assert results["task_space"]["summary"]["rl"]["all"]["velocity_error_mean"] == pytest.approx(
        np.mean(rl)
    )


def test_results_answer_the_papers_question(twice: tuple[Path, Path]) -> None:
    results = json.loads((twice[0] / "results.json").read_text())
    assert len(results["claims"]) == 9
    for claim in results["claims"]:
        assert set(claim) - {"stronger"} == {"paper", "measured", "numbers", "unit", "holds"}
        assert claim["holds"] in (True, False, None)
    assert ["stronger" in c for c in results["claims"]] == [False, True, True] + [False] * 3 + [
        True
    ] * 3
    less = results["task_space"]["rl_less"]["velocity_error_mean"]["jacobian_pid_ff"]
    for claim, sequences in zip(results["claims"][-3:], ("xyz", "z", ["all"]), strict=True):
        stronger = claim["stronger"]
        assert [stronger["numbers"][f"error {s}, less jacobian_pid_ff"] for s in sequences] == [
            less[s] for s in sequences
        ]
        assert stronger["holds"] is all(n["high"] < 0 for n in stronger["numbers"].values())
    assert len(results["net_claims"]) == 4
    less = results["regret"]["less_perfect_model"]
    assert set(less) == set(results["gains"]) | {"rl"} and all(
        set(rows) == {*"xyz", "all"} for rows in less.values()
    )
    bound, rl = (
        results["regret"]["summary"][c]["all"]["velocity_error_mean"]
        for c in ("perfect_model", "rl")
    )
    assert less["rl"]["all"]["mean"] == pytest.approx(rl - bound)
    paired = results["task_space"]["rl_less"]["velocity_error_mean"]["jacobian_pid_ff"]["all"]
    means = results["task_space"]["summary"]
    difference = [means[c]["all"]["velocity_error_mean"] for c in ("rl", "jacobian_pid_ff")]
    assert paired["mean"] == pytest.approx(difference[0] - difference[1])
    assert paired["low"] < paired["mean"] < paired["high"]
    low, high = results["task_space"]["intervals"]["jacobian_pid_ff"]["x"]["velocity_error_mean"]
    assert low < means["jacobian_pid_ff"]["x"]["velocity_error_mean"] < high
    assert set(results["robustness"]) == set(variations.variations(BROKK_170))
    nominal = results["robustness"]["nominal"]
    less = nominal["jacobian_pid_ff"]["rl_less"]
    assert less["mean"] == pytest.approx(nominal["rl"]["mean"] - nominal["jacobian_pid_ff"]["mean"])
    assert less["low"] < less["mean"] < less["high"] and "rl_less" not in nominal["rl"]


def test_results_tell_how_the_baselines_were_tuned(twice: tuple[Path, Path]) -> None:
    results = json.loads((twice[0] / "results.json").read_text())
    assert set(results["tuning"]) == set(results["gains"])
    for name, how in results["tuning"].items():
        assert how["seed"] == 3 and len(how["cost"]) == TINY.generations
        assert 0 < how["cost"][-1] <= how["cost"][0] < 0.3
        assert how["cost_anew"] != how["cost"][-1]  # noise of its own
        assert how["cost_anew"] == pytest.approx(how["cost"][-1], rel=0.2)
        spans = jacobian.GAINS.items()
        ends = [
            k for k, (low, high) in spans for g in results["gains"][name][k] if g in (low, high)
        ]
        assert len([g for g in how["at_bound"] if g.split()[0] in ends]) >= len(ends)


def test_the_report_is_one_file_with_its_figures(twice: tuple[Path, Path]) -> None:
    text = (twice[0] / "report.html").read_text()
    assert len(re.findall(r"src='data:image/png;base64,", text)) == 12
    words = re.sub(r"base64,[^']*", "", text)  # four letters of a picture may spell anything
    assert not re.findall(r"(?:src|href)='(?!data:)", words) and "http" not in words
    assert "not a real Brokk 170" in text
    results = json.loads((twice[0] / "results.json").read_text())
    for claim in (*results["net_claims"], *results["claims"]):
        assert html.escape(claim["measured"]) in text
    titles = [html.unescape(title) for title in re.findall(r"<h2>(.*?)</h2>", text)]
    assert len(titles) == len(set(titles))
    for part in re.split("<h2>", text)[1:]:  # each of the paper's figures has its sentences beside
        wanted = re.match(r"[^<]*Fig\. (?!6a\))|Learning", part)
        assert ("<blockquote>" in part and "<img" in part) if wanted else True, part[:60]
    assert "<td>rich, free runs (ours)</td>" in text and "<td>sines, one step (paper)</td>" in text
    assert text.count("<td>start ") == 4 and text.count("<td>tuning run ") == 2


def test_the_report_is_in_the_papers_order(twice: tuple[Path, Path]) -> None:
    text = (twice[0] / "report.html").read_text()
    papers = re.findall(
        r"<h2>[^<]*\((Fig\. [^)]*)\)</h2>|<h2>(Actuator nets|Learning curve)</h2>", text
    )
    assert ["".join(found) for found in papers] == [
        "Fig. 2",
        "Actuator nets",
        "Learning curve",
        "Fig. 5",
        "Fig. 6a",
        "Fig. 6b-d",
        "Fig. 6e, f",
        "Fig. 6g, h",
        "Fig. 6a, e, f",
    ]


def test_every_figure_of_merit_stands_with_its_interval_and_against_each_baseline(
    twice: tuple[Path, Path],
) -> None:
    results = json.loads((twice[0] / "results.json").read_text())
    task, text = results["task_space"], (twice[0] / "report.html").read_text()
    keys = list(task["summary"]["rl"]["all"])
    assert len(keys) == 12 and list(task["rl_less"]) == keys
    for key in ("settling_time", "jerk_rms", "valve_travel", "time_at_limits", "reward_mean"):
        low, high = task["intervals"]["jacobian_pid_ff"]["all"][key]
        mean = task["summary"]["jacobian_pid_ff"]["all"][key]
        numbers = {"mean": mean, "low": low, "high": high}
        assert f"<td>{report._with_interval(numbers)}</td>" in text, key
        less = task["rl_less"][key]["jacobian_pid_ff"]["all"]
        assert less["mean"] == pytest.approx(task["summary"]["rl"]["all"][key] - mean, abs=1e-9)
        assert f"<td>{report._with_interval(less)}</td>" in text, key


def test_an_interval_is_written_with_digits_that_tell_it() -> None:
    assert (
        report._with_interval({"mean": 0.01234, "low": -0.5, "high": 0.03})
        == "0.0123 (-0.5000 to 0.0300)"
    )
    assert (
        report._with_interval({"mean": 41.267, "low": 40.0, "high": 42.5}) == "41.27 (40 to 42.5)"
    )
    assert report._with_interval({"mean": 0.5, "low": None, "high": None}) == "0.5000"
    assert report._with_interval({"mean": None, "low": None, "high": None}) == ""


def test_a_sequence_is_listed_with_the_goals_that_it_holds() -> None:
    found = report._path(np.array([[1.0, 0.0, 0.0, 0.0], [0.85, -0.0, -0.2, 0.0]]))
    assert list(found.values()) == [
        1.85,
        1,
        0.2,
        pytest.approx(0.17),
        "1 s (0, 0, 0); 0.85 s (0, -0.2, 0)",
    ]
    assert report._path(np.ones((60, 4)))["held for, vx, vy, vz [m/s]"] == "at every tick another"


def test_runs_of_the_tuning_are_those_of_its_seed(twice: tuple[Path, Path]) -> None:
    found = json.loads((twice[0] / "results.json").read_text())["tuning_runs"]
    starts, goals = tuning_goals(BROKK_170, TINY.tuning_runs, 12.0, 3 + 1000)
    np.testing.assert_allclose([run["start"] for run in found], starts)
    for run, wanted in zip(found, goals.swapaxes(0, 1), strict=True):
        rows = np.array(run["goals"])
        again = np.repeat(rows[:, 1:], np.rint(rows[:, 0] * 20).astype(int), axis=0)
        np.testing.assert_allclose(again, wanted)


def test_panels_have_their_legends_above_the_curves_and_units_on_every_axis() -> None:
    x = np.linspace(0, 1, 5)
    curves = [{f"{k}{i}": (x, x * i) for i in range(4)} for k in "ab"]
    row = [figures.Panel(f"panel {i}", "time [s]", "speed [m/s]", c) for i, c in enumerate(curves)]
    figure = figures.plot_panels([row])
    figure.draw_without_rendering()
    boxes = [ax.get_legend().get_window_extent() for ax in figure.axes]
    assert all(
        box.y0 >= ax.get_window_extent().y1 for box, ax in zip(boxes, figure.axes, strict=True)
    )
    assert boxes[0].x1 <= boxes[1].x0  # beside each other
    for ax, box in zip(figure.axes, boxes, strict=True):
        assert ax.title.get_window_extent().y0 >= box.y1 - 2
    assert (
        figure.axes[0].xaxis.label.get_fontsize() * 7 / figures.WIDTH >= 7
    )  # on a page 7 inches wide


def test_gains_read_back_give_the_same_controller(twice: tuple[Path, Path]) -> None:
    from brokk_min.learning.policy import load_policy

    net = load_policy(twice[0] / "policy.npz", BROKK_170).net
    read = baselines.read_gains(twice[0] / "gains.json", BROKK_170, net)
    written = json.loads((twice[0] / "results.json").read_text())["gains"]
    assert baselines.gains_table(read) == written


def test_the_whole_chain_spends_what_fit_and_train_do_by_default():
    from brokk_min.identification.fitting import FitConfig
    from brokk_min.ppo import PPOConfig

    effort = experiments.Effort()
    assert (effort.fit_steps, effort.train_steps) == (FitConfig().steps, PPOConfig().total_steps)


# --- the parts of the comparison, their inputs made up ----------------------------------------------------


def made_up_trace(ticks: int, runs: int, seed: int = 0) -> Trace:
    rng = np.random.default_rng(seed)
    return Trace(
        *(rng.normal(size=(ticks, runs, n)) for n in (5, 5, 5, 5, 3, 3)),
        rng.normal(size=(ticks, runs)),
    )


def test_the_comparison_asks_its_parts_for_what_they_are_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Seeds, starts by kind, lengths, and whose traces: each part returns what it was asked."""
    starts, kinds = np.arange(20.0).reshape(4, 5), ["limits", "workspace", "extended", "workspace"]
    runs = [{"start": i, "kind": kind} for i, kind in enumerate(kinds)]
    traces = {
        (c, s): made_up_trace(6, 4, k) for k, (c, s) in enumerate(itertools.product("ab", "xy"))
    }
    asked: dict[str, tuple[Any, ...]] = {}

    def part(name: str, answer: Any) -> None:
        monkeypatch.setattr(experiments, name, lambda *a: asked.setdefault(name, a) and answer)

    part("evaluation_starts", starts)
    part("start_kinds", kinds)
    part("task_space", (runs, traces))
    part("regret", (runs[:1], {"less": 1}, {"bound": 2}))
    part("singular_case", ({"trace": 3}, {"claims": ["near", "close"]}))
    part("robustness", {"nominal": 4})
    part("tables", {"tables": 5})
    part("summary", {"summary": 6})
    part("judged", ["still", "slow", "turn", "track", "along z", "last"])
    effort = replace(experiments.Effort(), starts=4, bound_starts=1, short_s=3.0)
    controllers: Any = {"a": _Idle(), "b": _Idle()}
    found, shown = experiments.comparison(BROKK_170, controllers, effort, 7)
    every = [s.name for s in task_sequences(BROKK_170)]
    assert asked["evaluation_starts"][:2] == (BROKK_170, 4) and asked["evaluation_starts"][3] == 9
    assert asked["start_kinds"] == (BROKK_170, starts)
    assert [s.name for s in asked["evaluation_starts"][2]] == every
    machine, who, sequences, where, seed = asked["task_space"]
    assert (machine, who, [s.name for s in sequences], where is starts, seed) == (
        BROKK_170,
        controllers,
        every,
        True,
        7,
    )
    machine, who, short, where, seed = asked["regret"]
    assert (machine, who, where.tolist(), seed) == (BROKK_170, controllers, starts[1:2].tolist(), 7)
    assert [(s.name, len(s.goals)) for s in short] == [("x", 60), ("y", 60), ("z", 60)]
    machine, who, where, seconds, seed = asked["singular_case"]
    assert (machine, who, where.tolist(), seconds, seed) == (
        BROKK_170,
        controllers,
        starts[2:3].tolist(),
        3.0,
        7,
    )
    machine, who, shorter, where, seed = asked["robustness"]
    assert (machine, who, where.tolist(), seed) == (
        BROKK_170,
        controllers,
        starts[[1, 3]].tolist(),
        7,
    )
    assert (
        shorter is short
        and asked["tables"] == (runs, [runs[1], runs[3]])
        and asked["summary"] == (runs[:1],)
    )
    machine, who, scored, along, goals = asked["judged"]
    assert (machine, who, scored, list(along)) == (
        BROKK_170,
        controllers,
        [runs[1], runs[3]],
        ["a", "b"],
    )
    np.testing.assert_array_equal(along["b"].q, traces["b", "x"].q[:, [1, 3]])
    np.testing.assert_array_equal(along["b"].reward, traces["b", "x"].reward[:, [1, 3]])
    np.testing.assert_array_equal(goals, task_sequences(BROKK_170)[0].goals)
    assert found == {
        "task_space": {"tables": 5}, "regret": {"summary": {"summary": 6}, "less_perfect_model": {"less": 1}},
        "robustness": {"nominal": 4}, "singular": {"claims": ["near", "close"]},
        "claims": ["still", "slow", "turn", "near", "close", "track", "along z", "last"],
        "starts": starts.tolist(), "start_kinds": kinds,
    }  # fmt: skip
    assert shown == {"all": traces, "bound": {"bound": 2}, "singular": {"trace": 3}}


def test_regret_is_against_the_bound_and_gains_dither_only_where_they_should(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    start = np.array([[1.5, 0.5, 0.58, 1.71, 1.24]])
    found = experiments.bounds(BROKK_170, start)
    assert list(found) == ["perfect_model", "perfect_model_no_dither"]
    one, still = found.values()
    assert one.poses is start and still.poses is start  # type: ignore[attr-defined]
    assert still.dither == 0.0 != one.dither and (one.machine, still.machine) == (
        BROKK_170,
        BROKK_170,
    )  # type: ignore[attr-defined]
    rows = [
        {
            "controller": c,
            "sequence": "x",
            "start": i,
            "kind": "workspace",
            "velocity_error_mean": e + i * i,
        }
        for c, e in (("mine", 3.0), ("perfect_model", 1.0))
        for i in range(2)
    ]
    asked: list[Any] = []
    monkeypatch.setattr(
        experiments, "task_space", lambda *a: asked.append(a) or (rows, {"trace": 1})
    )
    mine: Any = {"mine": _Idle()}
    short = task_sequences(BROKK_170)[:1]
    runs, less, traces = experiments.regret(BROKK_170, mine, short, start, 5)
    assert (runs, traces, asked[0][4]) == (rows, {"trace": 1}, 5) and asked[0][3] is start
    assert asked[0][0] is BROKK_170 and asked[0][2] is short
    bound = asked[0][1]["perfect_model"]
    assert bound.machine is BROKK_170 and bound.poses is start
    assert list(asked[0][1]) == ["mine", "perfect_model", "perfect_model_no_dither"]
    assert less == {"mine": {s: {"mean": 2.0, "low": 2.0, "high": 2.0} for s in ("x", "all")}}


def test_a_log_of_driven_runs_by_hand() -> None:
    trace = made_up_trace(30, 18)._replace(u=np.full((30, 18, 5), np.float32(0.1)))
    traces = {("rl", "x"): trace, ("pid", "x"): trace, ("rl", "y"): made_up_trace(30, 2)}
    slow = experiments.driven_log(replace(BROKK_170, rate=10.0), traces, "rl")
    log = experiments.driven_log(BROKK_170, traces, "rl")
    assert slow.rate == 10.0
    np.testing.assert_allclose(slow.recordings[3].q_dot, log.recordings[3].q_dot / 2)
    names = [r.name for r in log.recordings]
    assert names == [f"rl_x_{i:02d}" for i in range(16)] + ["rl_y_00", "rl_y_01"]
    assert (log.joints, log.rate, log.velocity_logged) == (BROKK_170.names, 20.0, False)
    third = log.recordings[3]
    np.testing.assert_array_equal(third.q, trace.q_measured[:, 3])
    assert third.u.dtype == float and np.allclose(third.u, 0.1)
    np.testing.assert_allclose(third.q_dot, velocity_of(trace.q_measured[:, 3], 4, 20.0))


def test_tables_keep_the_runs_that_count_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [
        {
            "controller": c,
            "sequence": s,
            "start": i,
            "kind": kind,
            "error": base + i + (kind == "limits") / 2,
        }
        for c, base in (("rl", 1.0), ("pid", 4.0))
        for s in "xy"
        for i, kind in enumerate(("workspace", "limits", "workspace"))
    ]
    scored = [row for row in rows if row["kind"] == "workspace"]
    found = experiments.tables(rows, scored)
    assert found["runs"] is rows and found["summary"]["pid"] == {
        s: {"error": 5.0} for s in ("x", "y", "all")
    }
    limits = {"rl": {"error": 2.5}, "pid": {"error": 5.5}}
    assert found["by_kind"] == {
        "workspace": {"rl": {"error": 2.0}, "pid": {"error": 5.0}},
        "limits": limits,
    }
    assert found["rl_less"] == {
        "error": {"pid": {s: {"mean": -3.0, "low": -3.0, "high": -3.0} for s in ("x", "y", "all")}}
    }
    low, high = found["intervals"]["rl"]["x"]["error"]
    assert low == pytest.approx(2 - 12.7062, abs=1e-3) and high == pytest.approx(
        2 + 12.7062, abs=1e-3
    )


def test_sentences_are_put_to_the_papers_baselines_and_to_the_stronger_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    net = net_of_driven_joints()
    pids = baselines.baselines(BROKK_170, net)
    asked: list[Any] = []

    def said(name: str, count: int) -> Any:
        def answer(*a: Any) -> Any:
            asked.append((name, *a))
            many = [
                {"paper": f"{name} {i}", "numbers": {"n": len(asked)}, "unit": "m", "holds": None}
                for i in range(count)
            ]
            return many if count > 1 else many[0]

        return answer

    for name, count in (("drift_claims", 2), ("direction_claim", 1), ("tracking_claims", 3)):
        monkeypatch.setattr(experiments.claims, name, said(name, count))
    along: Any = {name: f"trace of {name}" for name in pids}
    goals = np.zeros((2, 3))
    found = experiments.judged(BROKK_170, {"rl": _Idle(), **pids}, [{"run": 1}], along, goals)
    assert [claim["paper"] for claim in found] == [
        "drift_claims 0", "drift_claims 1", "direction_claim 0", *(f"tracking_claims {i}" for i in range(3)),
    ]  # fmt: skip
    assert [claim["numbers"]["n"] for claim in found] == [1, 1, 2, 3, 3, 3]
    assert [claim["stronger"]["numbers"]["n"] for claim in found] == [4, 4, 5, 6, 6, 6]
    assert asked[0] == ("drift_claims", [{"run": 1}], baselines.PAPER_BASELINES)
    assert asked[2] == ("tracking_claims", [{"run": 1}], baselines.PAPER_BASELINES)
    assert asked[3][2] == baselines.STRONGER == asked[5][2]
    for i, name in ((1, "jacobian_pid_k0.1"), (4, "jacobian_pid_ff")):
        assert (
            asked[i][:4] == ("direction_claim", BROKK_170, pids[name], f"trace of {name}")
            and asked[i][4] is goals
        )


def test_damping_alone_is_compared_near_a_singularity() -> None:
    """Half a second along what an upright arm can do least, of two baselines with the same gains."""
    empty = experiments.singular_case(BROKK_170, {}, np.zeros((0, 5)), 1.0, 0)
    assert empty == ({}, {"summary": {}, "claims": []})
    start = np.array([[0.0, 1.139, 0.97, 2.804, 1.948], [1.0, 1.2, 0.9, 2.8, 1.9]])
    pids = baselines.baselines(BROKK_170, net_of_driven_joints())
    traces, found = experiments.singular_case(BROKK_170, {"rl": _Idle(), **pids}, start, 1.5, 3)
    names = ("rl", "jacobian_pid_k0.1", "jacobian_pid_k0.05")
    assert list(traces) == [(c, s) for c in names for s in ("least_half", "least_quarter")]
    assert all(trace.q.shape == (30, 2, 5) for trace in traces.values())
    np.testing.assert_array_equal(traces["rl", "least_half"].q[-1], start)
    J = kinematics.jacobian(kinematics.forward_kinematics(BROKK_170, start))[..., BROKK_170.driven]
    assert found["w0"] == jacobian.manipulability_threshold(BROKK_170)
    np.testing.assert_allclose(
        found["manipulability"], np.sqrt(np.linalg.det(J @ J.swapaxes(-1, -2)))
    )
    np.testing.assert_allclose(
        found["least"], [np.sqrt(np.linalg.eigvalsh(j @ j.T)[0]) for j in J], rtol=1e-6
    )
    assert list(found["summary"]) == list(names) and len(found["claims"]) == 3
    assert found["summary"]["rl"]["all"]["velocity_error_mean"] == pytest.approx(0.075 * 10 / 30)


# --- the chain, its parts made up -------------------------------------------------------------------------


class Parts:
    """Functions of modules replaced by ones that keep what they were asked and say what they are told to."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.patch, self.asked = monkeypatch, dict[str, list[tuple[Any, ...]]]()

    def __call__(self, module: Any, name: str, answer: Any = None) -> None:
        def instead(*a: Any, **more: Any) -> Any:
            self.asked.setdefault(name, []).append((*a, more) if more else a)
            return answer(*a, **more) if callable(answer) else answer

        self.patch.setattr(module, name, instead)


def test_the_chain_hands_each_stage_what_the_one_before_made(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    from brokk_min import ppo
    from brokk_min.evaluation import seeds as sweep

    part, asked = (p := Parts(monkeypatch)), p.asked
    out, effort = tmp_path / "a" / "b", replace(TINY, train_steps=64)
    net, driven = random_net(np.random.default_rng(0)), net_of_driven_joints()
    policy = SimpleNamespace(net=driven)
    part(sweep, "read_seeds", {"meta": {}, "table": "seeds"})
    part(sweep, "seeds_of", {"rl": "over seeds"})
    part(chain, "record", ["log", "test"])
    part(chain, "fitted", (net, "by the paper"))
    part(ppo, "train", policy)
    part(chain, "tune_baselines", ("tuned", "how"))
    part(chain, "PolicyController", lambda machine, learned: ("controller of", learned))
    part(chain, "measure", ({"task_space": "compared"}, "traces"))
    part(chain, "gains_table", lambda tuned: f"plain {tuned}")
    for name in ("write_gains", "save_policy"):
        part(chain, name)
    part(chain, "told", lambda policy, results, seed: ("told", policy, seed))
    part(report, "net_parts", ["nets"])
    part(report, "found", "found")
    part(report, "task_parts", ["task", "lists"])
    part(figures, "write_report")
    results = chain.reproduce(BROKK_170, out, effort, 3, Path("sweep.json"))
    assert asked["read_seeds"] == [(Path("sweep.json"),)]
    assert asked["record"] == [(BROKK_170, out, effort, 3)]
    assert asked["fitted"] == [(BROKK_170, out, "log", "test", effort, 3)]
    machine, selected, seeds = asked["seeds_of"][0]
    assert (machine, selected.joints, seeds["table"]) == (
        BROKK_170,
        ("q1", "q3", "q4", "q5"),
        "seeds",
    )
    machine, nets, task, config, seed, path, more = asked["train"][0]
    assert (machine, task, config, seed, path) == (
        BROKK_170,
        TaskConfig(),
        ppo.PPOConfig(total_steps=64),
        3,
        out / "policy.npz",
    )
    assert more == {"resume": True} and nets.joints == ("q1", "q3", "q4", "q5")
    machine, nets, *spent = asked["tune_baselines"][0]
    assert (machine, nets.joints) == (BROKK_170, ("q1", "q3", "q4", "q5"))
    assert spent == [effort.tuning_runs, effort.generations, 3]
    assert asked["measure"] == [
        (BROKK_170, net, "test", ("controller of", policy), "tuned", effort, 3)
    ]
    about = experiments.meta(BROKK_170, 3) | baselines.gains_metadata(BROKK_170, driven)
    wanted = {
        "meta": about | {"effort": asdict(effort)},
        "paper_recipe": "by the paper", "task_space": "compared", "gains": "plain tuned", "tuning": "how",
        "training_seeds": {"rl": "over seeds"},
    }  # fmt: skip
    assert results == wanted == json.loads((out / "results.json").read_text())
    assert asked["write_gains"] == [(out / "gains.json", "tuned", wanted["meta"])]
    assert asked["save_policy"] == [(out / "policy.npz", ("told", policy, 3))]
    clock = json.loads((out / "timing.json").read_text())
    assert list(clock) == ["record", "fit", "train", "tune", "evaluate", "draw"]
    *first, trained = asked["net_parts"][0]
    assert (
        first == [BROKK_170, net, "test", wanted, 3, out / "policy.npz.csv"]
        and trained == clock["train"]
    )
    assert asked["task_parts"] == [(BROKK_170, wanted, "traces")]
    path, pages, seconds = asked["write_report"][0]
    assert (path, pages, seconds) == (
        out / "report.html",
        ["found", "nets", "task", "lists"],
        clock,
    )
    assert (
        chain.reproduce(BROKK_170, out, effort, 3)["training_seeds"] == {}
        and len(asked["read_seeds"]) == 1
    )


def test_nets_of_the_chain_are_ours_and_the_papers(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    part, asked = (p := Parts(monkeypatch)), p.asked
    net = random_net(np.random.default_rng(0))
    part(chain.fitting, "fit", net)
    part(chain.preliminary, "paper_recipe", "recipe")
    machine = replace(BROKK_170, dead_zone=0.09, history=11)
    log: Any = "log"
    assert chain.fitted(machine, tmp_path, log, "test", TINY, 4) == (net, "recipe")  # type: ignore[arg-type]
    config = chain.fitting.FitConfig(steps=60, history=11, dead_zone=0.09)
    assert asked["fit"] == [("log", config, 4, 4, "brokk170")]
    assert asked["paper_recipe"] == [(machine, "test", 0.02, replace(config, steps=30), 4)]
    assert fingerprint(load_net(tmp_path / "net.npz")) == fingerprint(net)


def test_logs_of_the_chain_are_written_and_read_back(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    part, asked = (p := Parts(monkeypatch)), p.asked
    part(
        chain.excitation,
        "collect",
        lambda machine, hours, kind, rng: f"{kind} {rng.integers(10**9)}",
    )
    part(
        chain.excitation,
        "task_log",
        lambda machine, runs, seconds, rng: f"{runs} {seconds} {rng.integers(10**9)}",
    )
    part(chain.logs, "write_log")
    part(chain.logs, "read_log", lambda files, samples, rate: (files, samples, rate))
    found = chain.record(BROKK_170, tmp_path, TINY, 4)
    assert found == [([tmp_path / name], 4, 20.0) for name in ("log.npz", "log_test.npz")]
    drawn = [np.random.default_rng(seed).integers(10**9) for seed in (4, 5)]
    wanted = [("log.npz", f"rich {drawn[0]}"), ("log_test.npz", f"20 40.0 {drawn[1]}")]
    assert asked["write_log"] == [(tmp_path / name, log) for name, log in wanted]
    assert asked["collect"][0][:2] == (BROKK_170, 0.02)


def test_what_is_measured_of_nets_policy_and_baselines(monkeypatch: pytest.MonkeyPatch) -> None:
    part, asked = (p := Parts(monkeypatch)), p.asked
    goals = np.tile([[0.1, 0.0, 0.0]], (20, 2, 1))
    kinds = ["workspace", "limits", "workspace"]
    compared = {"task_space": {}, "starts": [[1.0], [2.0], [3.0]], "start_kinds": kinds}
    part(chain, "comparison", (compared, {"all": "every"}))
    part(chain, "task_space", (["run"], {}))
    part(chain, "summary", {"rl": "on nets"})
    part(chain, "driven_log", "driven")
    part(chain.scores, "score", lambda net, log: f"score of {log}")
    part(chain.preliminary, "run", "before")
    part(chain.claims, "net_claims", lambda before: f"claims of {before}")
    part(chain, "tuning_set", (np.array([[0.5], [0.25]]), goals))
    rl: Any = SimpleNamespace(policy=SimpleNamespace(net="its nets"))
    found, traces = chain.measure(BROKK_170, "net", "test", rl, {"pid": "p"}, TINY, 6)  # type: ignore[arg-type, dict-item]
    assert traces == {"all": "every"} and asked["comparison"] == [
        (BROKK_170, {"rl": rl, "pid": "p"}, TINY, 6)
    ]
    assert found["actuator"] == {"test": "score of test", "driven_by_policy": "score of driven"}
    assert (found["preliminary"], found["net_claims"]) == ("before", "claims of before")
    assert asked["run"] == [(BROKK_170, "net", 6)] and asked["driven_log"] == [
        (BROKK_170, "every", "rl")
    ]
    assert asked["tuning_set"] == [(BROKK_170, 2, 6)]
    assert found["tuning_runs"] == [
        {"start": [s], "goals": [[1.0, 0.1, 0.0, 0.0]]} for s in (0.5, 0.25)
    ]
    machine, who, sequences, starts, seed, moves = asked["task_space"][0]
    assert (machine, who, starts.tolist(), seed, moves) == (
        BROKK_170,
        {"rl": rl},
        [[1.0], [3.0]],
        6,
        "its nets",
    )
    assert [(s.name, len(s.goals)) for s in sequences] == [("x", 360), ("y", 360), ("z", 360)]
    assert found["task_space"] == {"rl_on_nets": "on nets"} and asked["summary"] == [(["run"],)]


def test_a_policy_is_told_what_made_it_and_how_well_it_does() -> None:
    @dataclass(frozen=True)
    class Made:
        training: dict[str, Any]

    means = {c: {"all": {"velocity_error_mean": e}} for c, e in (("rl", 0.5), ("pid", 0.75))}
    policy: Any = chain.told(Made({"seed": 1}), {"task_space": {"summary": means}}, 9)  # type: ignore[arg-type]
    said = {
        "command": "brokk-min reproduce --seed 9",
        "velocity_error_mean": {"rl": 0.5, "pid": 0.75},
    }
    assert policy.training == {"seed": 1, **said}
