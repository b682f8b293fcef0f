"""Figures of the paper show the curves that they are given, with units."""

from types import SimpleNamespace

import numpy as np

from brokk_min.evaluation import figures
from brokk_min.evaluation.preliminary import Motion, SimulatorTests
from brokk_min.evaluation.sequences import axis_sequences
from brokk_min.kinematics import forward_kinematics, tool_position
from brokk_min.machine import BROKK_170

POSE = np.array(BROKK_170.q_start)
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
        rows[kind] = SimulatorTests(sweeps, coupling, {"from idle": (x, k + x)})
    figure = figures.plot_tests(BROKK_170, rows)
    titles = [ax.get_title() for ax in figure.axes[2:4]]
    assert titles == ["machine: past movement", "nets: range and direction"]
    np.testing.assert_array_equal(curves(figure.axes[3])["u = 50"], [x, 2 * x])
    np.testing.assert_array_equal(curves(figure.axes[4])["alone"], [x, -2 * x])
    np.testing.assert_array_equal(curves(figure.axes[5])["from idle"], [x, 2 + x])


def test_plot_gap__has_a_row_for_the_tool_and_for_each_driven_joint():
    gap = Motion(*(RNG.normal(size=(4, 2, n)) for n in (5, 5, 3, 3)))
    figure = figures.plot_gap(BROKK_170, gap)
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
    traces = {(name, "x"): trace for name in figures.SAMPLE} | {("pid", "y"): None}
    figure = figures.plot_sequence(BROKK_170, traces, sequence, POSE[None])
    goals = sequence.for_starts(BROKK_170, POSE[None])[:, 0]
    time = 0.05 * np.arange(1, 521)
    (goal, policy, *_) = (text.get_text() for text in figure.axes[0].get_legend().get_texts())
    p_start = tool_position(forward_kinematics(BROKK_170, POSE))
    for i in range(3):
        above, below = curves(figure.axes[i]), curves(figure.axes[3 + i])
        np.testing.assert_allclose(above[policy], [time, trace.p_tool[:, 0, i] - p_start[i]])
        np.testing.assert_allclose(above[goal], [time, 0.05 * np.cumsum(goals[:, i])])
        np.testing.assert_allclose(below[policy], [time, trace.v_tool[:, 0, i]])
    joints = figures.plot_joint_velocities(BROKK_170, traces, "x")
    assert ylabels(joints) == [f"velocity q{i} [rad/s]" for i in (1, 3, 4, 5)]
    np.testing.assert_array_equal(curves(joints.axes[2])[policy], [time, trace.q_dot[:, 0, 3]])


def test_plot_starts__draws_arms_from_the_side_and_from_above():
    starts = np.array([[0.5 * np.pi, *POSE[1:]], [0.0, *POSE[1:]], POSE])
    figure = figures.plot_starts(BROKK_170, starts)
    side, top = ([np.array(arm.get_data()) for arm in ax.get_lines()] for ax in figure.axes)
    for arm in side[:3]:
        np.testing.assert_allclose(arm, side[0], atol=1e-9)  # turned arms look the same
        np.testing.assert_allclose(arm[:, -1], [3.05, 1.01], atol=0.01)
    assert side[3][1].tolist() == [0, 0]  # the ground
    ends = [(0, 3.05), (3.05, 0), (3.05 * np.cos(1.5), 3.05 * np.sin(1.5))]
    for arm, end in zip(top, ends, strict=True):
        np.testing.assert_allclose(arm[:, -1], end, atol=0.01)


def test_plot_errors__has_a_row_with_an_interval_for_each_controller():
    errors = {"rl": {"mean": 2.0, "low": 1.0, "high": 3.0}}
    errors["pid_by_hand"] = {"mean": 5.0, "low": 4.0, "high": 6.0}
    (ax,) = figures.plot_errors(errors).axes
    labels = [text.get_text() for text in ax.get_yticklabels()]
    assert labels == ["PPO, our interface", "PID by hand"]
    ((mean, _, (bars,)),) = ax.containers
    assert np.array(mean.get_data()).tolist() == [[2, 5], [0, 1]]
    ends = [segment[:, 0].tolist() for segment in bars.get_segments()]
    assert ends == [[1, 3], [4, 6]]
