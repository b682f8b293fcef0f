"""Figures show the curves that they are given, and the page says of which machine they are."""

import re
from collections import defaultdict
from types import SimpleNamespace

import numpy as np
from helpers_machines import POSE

from brokk_min._files import SHIPPED, read_json
from brokk_min.evaluation import metrics, report
from brokk_min.evaluation.preliminary import Motion
from brokk_min.evaluation.sequences import axis_sequences
from brokk_min.kinematics import forward_kinematics, tool_position
from brokk_min.machine import BROKK_170

ERRORS = {"rl": 0.0101, "rl_paper": 0.0303, "pid_by_hand": 0.0404, "jacobian_pid_k0.1": 0.0202}
ERRORS |= {"rl_critic": 0.0606, "pid_by_hand_raw": 0.0505, "jacobian_pid_ff_integral": 0.0105}


def run(controller, sequence, start):
    figures = dict.fromkeys(metrics.COLUMNS, ERRORS[controller] + (start - 0.5) * 2e-4)
    return {"controller": controller, "sequence": sequence, "start": start} | figures


def results(hours=1.0, machine="digger"):
    """As `reproduce` has them but for claims, of made-up runs from two starts."""
    runs = [run(c, s, start) for c in ERRORS for s in "xyz" for start in (0, 1)]
    means = metrics.means(runs)
    return {
        "meta": {"machine": machine, "seed": 3, "effort": {"hours": hours}},
        "table": {name: of["all"] for name, of in means.items()},
        "task_space": {"means": means},
        "robustness": {"nominal": {c: {"mean": e, "low": 0, "high": 1} for c, e in ERRORS.items()}},
        "claims": [],
    }


def render(*args):
    return report.render(results(*args), defaultdict(lambda: "QUJD"))


def first_screen(page):
    """Its numbers, and the cells of its table."""
    first = page.split("<h2>")[0]
    sentence, _, rest = first.partition("<table")
    numbers = re.findall(r"([\d.]+) m/s", sentence.split("<p>")[1])
    rows = [re.findall("<td.*?>(.*?)</td>", row) for row in re.findall("<tr>(.*?)</tr>", rest)]
    return numbers, rows[1:], rest


def test_render__begins_with_one_sentence_a_figure_and_a_table():
    """And ends with the leads within a class."""
    page = render()
    numbers, rows, rest = first_screen(page)
    assert numbers == ["0.0303", "0.0404", "0.0202", "0.0101", "0.0105"]
    names = ["PID by hand", "PID optimised, k = 0.1", "PPO, the paper&#39;s agent"]
    assert [row[0] for row in rows] == [*names, "PPO, our interface", "strongest PID"]
    # two starts, 0.0100 and 0.0102: half an interval is 12.7062 x 0.0002 / sqrt(2) / sqrt(2)
    assert rows[3][1:3] == ["closed", "0.0101 (0.0088 to 0.0114)"]
    assert page.index("<img") < page.index("<table") and "trial" not in rest
    last = page.split("<h2>")[-1]
    heads = re.findall("<th>lead of (.*?) over (.*?)</th>", last)
    assert heads[2] == ("PPO, our interface", "strongest PID")
    leads = re.findall(r"<td>(-?\d\.\d\d)</td>", last)
    assert leads == ["0.25", "-0.50", "0.04"]  # 1 - 0.0303 / 0.0404, and so on


def test_render__sets_a_trial_beside_the_shipped_results_and_their_bound():
    numbers, rows, rest = first_screen(render(0.1, "brokk170"))
    table = read_json(SHIPPED / "brokk170" / "table.json", "a table")["table"]
    assert numbers[0] == f"{table['rl_paper']['velocity_error_mean']['mean']:.4f}"
    assert rows[3][4] == "0.0101 (0.0088 to 0.0114)" and "is of a trial" in rest
    assert rows[5][2] == "0.0097"
    numbers, *_ = first_screen(render(0.1))  # of a machine without shipped results
    assert numbers[0] == "0.0303"


RNG = np.random.default_rng(0)


def curves(ax):
    return {curve.get_label(): np.array(curve.get_data()) for curve in ax.get_lines()}


def ylabels(figure):
    return [ax.get_ylabel() for ax in figure.axes]


def test_plot_tests__shows_machine_above_nets():
    x = np.arange(3.0)
    rows = {}
    for k, kind in enumerate(("machine", "nets"), 1):
        sweeps, coupling = {"u = 50": (x, k * x)}, {"alone": (x, -k * x)}
        rows[kind] = {"sweeps": sweeps, "coupling": coupling, "past movement": {"idle": (x, k + x)}}
    figure = report.plot_tests(BROKK_170, rows)
    *_, past_movement, sweeps, coupling, steps = figure.axes
    assert past_movement.get_title() == "machine: past movement"
    assert [sweeps.get_xlabel(), steps.get_xlabel()] == ["q5 [rad]", "time after the step [s]"]
    np.testing.assert_array_equal(curves(sweeps)["u = 50"], [x, 2 * x])
    np.testing.assert_array_equal(curves(coupling)["alone"], [x, -2 * x])
    np.testing.assert_array_equal(curves(steps)["idle"], [x, 2 + x])


def test_plot_errors__has_a_row_with_an_interval_for_each_controller():
    errors = {"rl": {"mean": 2.0, "low": 1.0, "high": 3.0}}
    errors["pid_by_hand"] = {"mean": 5.0, "low": 4.0, "high": 6.0}
    (ax,) = report.plot_errors(errors).axes
    labels = [text.get_text() for text in ax.get_yticklabels()]
    assert labels == ["PPO, our interface", "PID by hand"]
    ((mean, _, (bars,)),) = ax.containers
    assert np.array(mean.get_data()).tolist() == [[2, 5], [0, 1]]
    ends = [segment[:, 0].tolist() for segment in bars.get_segments()]
    assert ends == [[1, 3], [4, 6]]


def test_plot_gap__has_a_row_for_the_tool_and_for_each_driven_joint():
    gap = Motion(*(RNG.normal(size=(4, 2, n)) for n in (5, 5, 3, 3)))
    figure = report.plot_gap(BROKK_170, gap)
    joints = [[f"{name} [rad/s]", f"{name} [mrad]"] for name in ("q1", "q3", "q4", "q5")]
    assert ylabels(figure) == ["tool [m/s]", "tool [mm]", *np.ravel(joints)]
    time = [0.05, 0.1, 0.15, 0.2]
    distance = 1000 * np.linalg.norm(gap.p_tool, axis=-1)
    np.testing.assert_allclose(curves(figure.axes[1])["first run"], [time, distance[:, 0]])
    np.testing.assert_allclose(curves(figure.axes[9])["first run"], [time, 1000 * gap.q[:, 0, 4]])


def test_plot_sequence__is_relative_to_where_the_tool_began():
    sequence = axis_sequences(BROKK_170)[0]
    sizes = {"p_tool": 3, "v_tool": 3, "q_dot": 5}
    trace = SimpleNamespace(**{name: RNG.normal(size=(520, 1, n)) for name, n in sizes.items()})
    traces = {(name, "x"): trace for name in report.SAMPLE} | {("pid", "y"): None}
    figure = report.plot_sequence(BROKK_170, traces, sequence, POSE[None])
    goals = sequence.for_starts(BROKK_170, POSE[None])[:, 0]
    time = 0.05 * np.arange(1, 521)
    (goal, policy, *_) = (text.get_text() for text in figure.axes[0].get_legend().get_texts())
    p_start = tool_position(forward_kinematics(BROKK_170, POSE))
    for i in range(3):
        above, below = curves(figure.axes[i]), curves(figure.axes[3 + i])
        np.testing.assert_allclose(above[policy], [time, trace.p_tool[:, 0, i] - p_start[i]])
        np.testing.assert_allclose(above[goal], [time, 0.05 * np.cumsum(goals[:, i])])
        np.testing.assert_allclose(below[policy], [time, trace.v_tool[:, 0, i]])
    joints = report.plot_joint_velocities(BROKK_170, traces, "x")
    assert ylabels(joints) == [f"velocity q{i} [rad/s]" for i in (1, 3, 4, 5)]
    np.testing.assert_array_equal(curves(joints.axes[2])[policy], [time, trace.q_dot[:, 0, 3]])


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
