"""Figures show the curves that they are given, with units, and legends that hide none."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from brokk_min.evaluation import figures
from brokk_min.evaluation.preliminary import Motion, SimulatorTests, Sweep
from brokk_min.evaluation.sequences import Commands, axis_sequences
from brokk_min.kinematics import forward_kinematics, tool_position
from brokk_min.machine import BROKK_170

POSE = list(BROKK_170.q_start)
RNG = np.random.default_rng(0)


def curves(ax):
    return {curve.get_label(): np.array(curve.get_data()) for curve in ax.get_lines()}


def ylabels(figure):
    return [ax.get_ylabel() for ax in figure.axes]


# --- preliminary tests ----------------------------------------------------------------------------


def test_plot_tests__shows_machine_above_nets():
    x = np.arange(3.0)
    rows = {}
    for k, kind in enumerate(("machine", "nets"), 1):
        sweeps, coupling = {"u = 50": Sweep(x, k * x)}, {"alone": Sweep(x, -k * x)}
        rows[kind] = SimulatorTests(sweeps, coupling, {"from idle": (x, k + x)}, {})
    figure = figures.plot_tests(BROKK_170, rows)
    assert ylabels(figure) == ["velocity q5 [rad/s]"] * 6
    assert [ax.get_xlabel() for ax in figure.axes[:3]] == [
        "q5 [rad]", "q5 [rad]", "time after the step [s]"
    ]  # fmt: skip
    titles = [ax.get_legend().get_title().get_text() for ax in figure.axes[2:4]]
    assert titles == ["machine: past movement", "nets: range and direction"]
    np.testing.assert_array_equal(curves(figure.axes[3])["u = 50"], [x, 2 * x])
    np.testing.assert_array_equal(curves(figure.axes[4])["alone"], [x, -2 * x])
    np.testing.assert_array_equal(curves(figure.axes[5])["from idle"], [x, 2 + x])


def test_plot_panels__draws_the_median_of_runs_in_a_band_of_four_fifths():
    x, y = np.arange(3.0), np.arange(33.0).reshape(3, 11)
    (ax,) = figures.plot_panels([[figures.Panel("", "x", "y", {"rl": (x, y)})]]).axes
    np.testing.assert_array_equal(curves(ax)["rl"], [x, y[:, 5]])
    (band,) = ax.collections
    ends = {tuple(point) for point in band.get_paths()[0].vertices}
    assert ends == {(i, value) for i in range(3) for value in (y[i, 1], y[i, 9])}


def test_plot_gap__has_a_row_for_the_tool_and_for_each_driven_joint():
    gap = Motion(*(RNG.normal(size=(4, 2, n)) for n in (5, 5, 3, 3)))
    figure = figures.plot_gap(BROKK_170, gap)
    joints = [[f"{name} [rad/s]", f"{name} [mrad]"] for name in ("q1", "q3", "q4", "q5")]
    assert ylabels(figure) == ["tool [m/s]", "tool [mm]", *np.ravel(joints)]
    time = [0.05, 0.1, 0.15, 0.2]
    distance = 1000 * np.linalg.norm(gap.p_tool, axis=-1)
    np.testing.assert_allclose(curves(figure.axes[1])["first run"], [time, distance[:, 0]])
    np.testing.assert_allclose(curves(figure.axes[1])["all runs"], [time, distance.mean(axis=1)])
    np.testing.assert_allclose(curves(figure.axes[4])["first run"], [time, gap.q_dot[:, 0, 2]])
    np.testing.assert_allclose(curves(figure.axes[9])["first run"], [time, 1000 * gap.q[:, 0, 4]])


# --- task-space control ---------------------------------------------------------------------------


def test_plot_sequence__is_relative_to_where_the_tool_began():
    sequence = axis_sequences(BROKK_170)[0]
    sizes = {"p_tool": 3, "v_tool": 3, "q_dot": 5}
    trace = SimpleNamespace(**{name: RNG.normal(size=(520, 2, n)) for name, n in sizes.items()})
    traces = {("rl", "x"): trace, ("pid", "y"): None}
    figure = figures.plot_sequence(BROKK_170, traces, sequence, np.array(POSE), 1)
    goals = sequence.for_starts(BROKK_170, np.tile(POSE, (2, 1)))[:, 1]
    time = 0.05 * np.arange(1, 521)
    positions = [f"{axis} - {axis}(0) [m]" for axis in "xyz"]
    assert ylabels(figure) == positions + [f"velocity {axis} [m/s]" for axis in "xyz"]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["goal", "rl"]
    p_start = tool_position(forward_kinematics(BROKK_170, POSE))
    for i in range(3):
        above, below = curves(figure.axes[i]), curves(figure.axes[3 + i])
        np.testing.assert_allclose(above["rl"], [time, trace.p_tool[:, 1, i] - p_start[i]])
        np.testing.assert_allclose(above["goal"], [time, 0.05 * np.cumsum(goals[:, i])])
        np.testing.assert_allclose(below["rl"], [time, trace.v_tool[:, 1, i]])
        np.testing.assert_allclose(below["goal"], [time, goals[:, i]])
    joints = figures.plot_joint_velocities(BROKK_170, traces, "x", 1)
    assert ylabels(joints) == [f"velocity q{i} [rad/s]" for i in (1, 3, 4, 5)]
    np.testing.assert_array_equal(curves(joints.axes[2])["rl"], [time, trace.q_dot[:, 1, 3]])


def test_plot_position_error__is_the_distance_from_where_the_goals_lead():
    """Of a tool that stands, from starts whose goals point along +x and along -x."""
    sequence = axis_sequences(BROKK_170)[0]
    starts = np.array([POSE, [-1.5 + np.pi / 2, *POSE[1:]], [2.0, *POSE[1:]]])
    tools = tool_position(forward_kinematics(BROKK_170, starts))
    trace = SimpleNamespace(p_tool=np.tile(tools, (520, 1, 1)))
    figure = figures.plot_position_error(BROKK_170, {("rl", "x"): trace}, sequence, starts, ["rl"])
    motion, error = (curves(ax) for ax in figure.axes)
    moved = 0.05 * np.cumsum(np.abs(sequence.goals[:, 0]) * np.sign(sequence.goals[:, 0]))
    np.testing.assert_allclose(motion["goal"][1], moved, atol=1e-9)
    np.testing.assert_allclose(motion["rl"][1], 0, atol=1e-9)
    np.testing.assert_allclose(error["rl"][1], 1000 * np.abs(moved), atol=1e-6)
    assert ylabels(figure) == ["motion along x [m]", "position error [mm]"]


def test_plot_rest__begins_a_second_after_the_stop_before_the_longest_rest():
    goals = np.zeros((400, 3))
    goals[100:120] = goals[180:200] = [0.1, 0, 0]  # rests of 5, 3 and 10 s
    q = np.zeros((400, 1, 5))
    q[:, 0, 2] = 0.001 * np.arange(400)
    traces = {("rl", "x"): SimpleNamespace(q=q)}
    figure = figures.plot_rest(BROKK_170, traces, Commands("x", goals), ["rl"])
    assert [ax.get_title() for ax in figure.axes] == ["q1", "q3", "q4", "q5"]
    ticks = np.arange(181)  # from the end of tick 219 to that of tick 399
    np.testing.assert_allclose(curves(figure.axes[1])["rl"], [0.05 * ticks, ticks])
    assert not curves(figure.axes[0])["rl"][1].any()


def test_plot_intervals__shows_means_and_intervals_in_rows():
    number = {"mean": 2.0, "low": -1.0, "high": 4.0}
    alone = {"mean": 3.0, "low": None, "high": None}
    rows = {"nominal": {"rl": number, "rl_paper": alone}, "slow": {"rl": alone}}
    (ax,) = figures.plot_intervals({"error [m/s]": rows}).axes
    assert [text.get_text() for text in ax.get_yticklabels()] == ["nominal", "slow"]
    marks = [container.lines[0].get_data() for container in ax.containers]
    assert np.ravel(marks).tolist() == pytest.approx([2, -0.2, 3, 0.2, 3, 1])
    bars = [container.lines[2][0].get_segments() for container in ax.containers]
    np.testing.assert_allclose(bars[0], [[[-1, -0.2], [4, -0.2]]])
    assert not np.size(bars[1])  # no interval
    assert ax.get_xlim()[0] < -1 and ax.get_ylim() == (1.5, -0.5)
    legend = ax.figure.legends[0].get_texts()
    assert [text.get_text() for text in legend] == ["rl", "rl_paper"]


def test_styles__tell_controllers_apart_without_colour():
    controllers = [name for name in figures.STYLES if name.startswith(("rl", "jacobian"))]
    assert len({figures.MARKERS[name] for name in controllers}) == len(controllers) == 9
    dashes = {str(figures.STYLES[name].get("linestyle")) for name in ("goal", *controllers)}
    assert len(dashes) == 10


def test_plot_starts__draws_arms_from_the_side_and_from_above():
    starts = np.array([[0.5 * np.pi, *POSE[1:]], [0.0, *POSE[1:]], POSE])
    kinds = ["limits", "workspace", "limits"]
    figure = figures.plot_starts(BROKK_170, starts, kinds)
    side, top = ([np.array(arm.get_data()) for arm in ax.get_lines()] for ax in figure.axes)
    for arm in side[:3]:
        np.testing.assert_allclose(arm, side[0], atol=1e-9)  # turned arms look the same
        np.testing.assert_allclose(arm[:, -1], [3.05, 1.01], atol=0.01)
    assert side[3][1].tolist() == [0, 0]  # the ground
    ends = [(0, 3.05), (3.05, 0), (3.05 * np.cos(1.5), 3.05 * np.sin(1.5))]
    for arm, end in zip(top, ends, strict=True):
        np.testing.assert_allclose(arm[:, -1], end, atol=0.01)
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["limits", "workspace"]
    assert [ax.get_aspect() for ax in figure.axes] == [1.0, 1.0]
    colors = [arm.get_color() for arm in figure.axes[1].get_lines()]
    assert colors == [figures.STYLES[kind]["color"] for kind in kinds]


def test_save__writes_the_same_bytes_for_the_same_figure(tmp_path):
    pages = []
    for name in ("a.png", "b.png"):
        figure = figures.Figure(figsize=(1.0, 0.5))
        figure.add_subplot().plot([0, 1])
        figures.save(tmp_path / name, figure)
        pages.append((tmp_path / name).read_bytes())
    assert pages[0] == pages[1] == figures.png(figure) and b"Software" not in pages[0]
    assert pages[0][:4] == b"\x89PNG" and pages[0][16:24] == bytes([0, 0, 0, 150, 0, 0, 0, 75])
