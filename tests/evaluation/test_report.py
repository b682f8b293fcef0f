"""Figures show the curves that they are given, and the page says of which machine they are."""

import json
import re
from collections import defaultdict
from types import SimpleNamespace

import numpy as np
from helpers_machines import POSE

from brokk_min._files import SHIPPED
from brokk_min.evaluation import claims, metrics, report
from brokk_min.evaluation.preliminary import Gap
from brokk_min.evaluation.sequences import axis_sequences
from brokk_min.kinematics import forward_kinematics, tool_position
from brokk_min.machine import BROKK_170

ERRORS = {"rl": 0.0101, "rl_paper": 0.0303, "pid_by_hand": 0.0404, "jacobian_pid_k0.1": 0.0202}
ERRORS |= {"rl_critic": 0.0606, "pid_by_hand_raw": 0.0505, "jacobian_pid_ff_integral": 0.0105}
ERROR = "velocity_error_mean"
PAIR = {"x": {"mean": 5.0, "low": 4.0, "high": 6.0, "won": 2, "runs": 32}}
DRIFT = {"PPO as printed": {"drift": {"mean": 0.128, "low": 0.1, "high": 0.15}}}
CLAIM = claims.claim("still", DRIFT)


def render(hours=1.0, machine="digger"):
    """The page of made-up results, as `reproduce` has them but for claims."""
    numbers = {c: {"mean": e, "low": e - 0.001, "high": e + 0.001} for c, e in ERRORS.items()}
    table = {c: dict.fromkeys(metrics.COLUMNS, number) for c, number in numbers.items()}
    results = {
        "meta": {"machine": machine, "seed": 3, "effort": {"hours": hours, "short_s": 3.0}},
        "table": table,
        "task_space": {"means": {c: {"all": of} for c, of in table.items()}},
        "robustness": {"nominal": numbers},
        "pairs": [{"policy": "rl", "pid": "jacobian_pid_ff_integral", "figures": {ERROR: PAIR}}],
        "claims": [CLAIM],
    }
    return report.render(results, defaultdict(lambda: "QUJD"))


def first_screen(page):
    """Its numbers, and the cells of its table."""
    first = page.split("<h2>Fig. 2")[0]
    sentence, _, rest = first.partition("<table")
    numbers = re.findall(r"([\d.]+) m/s", sentence.split("<p>")[1])
    rows = [re.findall("<td.*?>(.*?)</td>", row) for row in re.findall("<tr>(.*?)</tr>", rest)]
    return numbers, rows[1:], rest


def test_render__begins_with_one_sentence_a_figure_and_a_table():
    """And ends with the leads within a class."""
    page = render()
    numbers, rows, rest = first_screen(page)
    assert numbers == ["0.0606", "0.0303", "0.0404", "0.0202", "0.0101", "0.0105"]
    names = ["PID by hand", "PID optimised", "PPO as printed"]
    names += ["PPO by groups, the paper&#39;s observation", "PPO, our agent", "strongest PID"]
    assert [row[0] for row in rows[:6]] == names  # no run of the critic on our nets
    assert rows[4][1:4] == ["closed", "0.0101 (0.0091 to 0.0111)", "0.0101"]
    figure, words, *verdict = rows[7]
    assert (figure, words) == ("Fig. 6b-d", "the y and z positions remain stationary")
    measured = "drift 0.1280 (0.1000 to 0.1500)"
    assert verdict == ["<b>does not hold here</b>", "PPO as printed", measured]
    assert "<td>+5.0 (+4.0 to +6.0), 2 of 32</td>" in page
    assert page.index("<img") < page.index("<table") and "trial" not in rest
    last = page.split("<h2>")[-1]
    heads = re.findall("<td>lead of (.*?) over (.*?)</td>", last)
    assert heads == [("PPO, our agent", "strongest PID")]
    assert re.findall(r"<td>(-?\d\.\d\d)</td>", last) == ["0.04"]  # 1 - 0.0101 / 0.0105


def test_render__sets_a_trial_beside_the_shipped_results():
    numbers, rows, rest = first_screen(render(0.1, "brokk170"))
    table = json.loads((SHIPPED / "brokk170" / "table.json").read_text())["table"]
    assert numbers[1] == f"{table['rl_paper'][ERROR]['mean']:.4f}"
    ours = next(row for row in rows if row[0] == "PPO, our agent")
    assert ours[6] == "0.0101 (0.0091 to 0.0111)" and "is of a trial" in rest
    numbers, *_ = first_screen(render(0.1))  # of a machine without shipped results
    assert numbers[1] == "0.0303"


RNG = np.random.default_rng(0)


def curves(ax):
    return {curve.get_label(): np.array(curve.get_data()) for curve in ax.get_lines()}


def test_plot_tests__shows_machine_above_nets():
    x, kinds, tests = np.arange(3.0), ("machine", "nets"), ("sweeps", "coupling", "past movement")
    rows = {kind: {key: {kind: (x, k * x)} for key in tests} for k, kind in enumerate(kinds)}
    axes = report.plot_tests(BROKK_170, rows).axes
    titles = [f"{kind}: {test}" for kind in kinds for test in tests]
    assert [ax.get_title() for ax in axes] == titles
    assert [axes[i].get_xlabel() for i in (3, 5)] == ["q5 [rad]", "time after the step [s]"]
    for i, ax in enumerate(axes):
        np.testing.assert_array_equal(curves(ax)[kinds[i // 3]], [x, i // 3 * x])


def test_plot_errors__has_a_row_with_an_interval_for_each_controller():
    one, other = ({"mean": mean, "low": mean - 1, "high": mean + 1} for mean in (2.0, 5.0))
    (ax,) = report.plot_errors({"rl": one, "pid_by_hand": other}).axes
    labels = [text.get_text() for text in ax.get_yticklabels()]
    assert labels == ["PPO, our agent", "PID by hand"]
    ((mean, _, (bars,)),) = ax.containers
    assert np.array(mean.get_data()).tolist() == [[2, 5], [0, 1]]
    assert np.array(bars.get_segments())[..., 0].tolist() == [[1, 3], [4, 6]]


def test_plot_gap__has_a_row_for_the_tool_and_for_each_driven_joint():
    gap = Gap(*(RNG.normal(size=(4, 2, n)) for n in (5, 5, 3, 3)))
    axes = report.plot_gap(BROKK_170, gap).axes
    joints = [[f"{name} [rad/s]", f"{name} [mrad]"] for name in ("q1", "q3", "q4", "q5")]
    labels = ["tool [m/s]", "tool [mm]", *np.ravel(joints)]
    assert [ax.get_ylabel() for ax in axes] == labels
    time = [0.05, 0.1, 0.15, 0.2]
    distance = 1000 * np.linalg.norm(gap.p_tool, axis=-1)
    np.testing.assert_allclose(curves(axes[1])["first run"], [time, distance[:, 0]])
    np.testing.assert_allclose(curves(axes[9])["first run"], [time, 1000 * gap.q[:, 0, 4]])


def test_plot_sequence__is_relative_to_where_the_tool_began():
    sequence = axis_sequences(BROKK_170)[0]
    sizes = {"p_tool": 3, "v_tool": 3, "q_dot": 5}
    trace = SimpleNamespace(**{name: RNG.normal(size=(520, 1, n)) for name, n in sizes.items()})
    traces = {(name, "x"): trace for name in report.SAMPLE} | {("pid", "y"): None}
    figure = report.plot_sequence(BROKK_170, traces, sequence, POSE[None])
    goals = sequence.for_starts(BROKK_170, POSE[None])[:, 0]
    time = 0.05 * np.arange(1, 521)
    (goal, policy, *_) = (text.get_text() for text in figure.legends[0].get_texts())
    p_start = tool_position(forward_kinematics(BROKK_170, POSE))
    for i in range(3):
        above, below = curves(figure.axes[i]), curves(figure.axes[3 + i])
        np.testing.assert_allclose(above[policy], [time, trace.p_tool[:, 0, i] - p_start[i]])
        np.testing.assert_allclose(above[goal], [time, 0.05 * np.cumsum(goals[:, i])])
        np.testing.assert_allclose(below[policy], [time, trace.v_tool[:, 0, i]])
    joints = report.plot_joint_velocities(BROKK_170, traces, "x").axes
    labels = [f"velocity q{i} [rad/s]" for i in (1, 3, 4, 5)]
    assert [ax.get_ylabel() for ax in joints] == labels
    np.testing.assert_array_equal(curves(joints[2])[policy], [time, trace.q_dot[:, 0, 3]])


def test_plot_starts__draws_arms_from_the_side_and_from_above():
    starts = np.array([[0.5 * np.pi, *POSE[1:]], [0.0, *POSE[1:]], POSE])
    figure = report.plot_starts(BROKK_170, starts)
    side, top = ([np.array(arm.get_data()) for arm in ax.get_lines()] for ax in figure.axes)
    for arm in side[:3]:
        np.testing.assert_allclose(arm, side[0], atol=1e-9)  # turned arms look the same
        np.testing.assert_allclose(arm[:, -1], [3.05, 1.01], atol=0.01)
    assert side[3][1].tolist() == [0, 0]  # the ground
    ends = [(0, 3.05), (3.05, 0), (3.05 * np.cos(1.5), 3.05 * np.sin(1.5))]
    for arm, end in zip(top, ends, strict=True):
        np.testing.assert_allclose(arm[:, -1], end, atol=0.01)
