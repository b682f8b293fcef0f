"""The report's parts from results that were made up by hand, and figures whose curves are known."""

from __future__ import annotations

import base64
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from brokk_min.evaluation import figures, preliminary, report
from brokk_min.evaluation.figures import Panel, Quote
from brokk_min.evaluation.sequences import axis_sequences, singular_sequences
from brokk_min.machine import BROKK_170

ERROR, DRIFT = "velocity_error_mean", "off_axis_drift_max"
POSE = [1.5, 0.5, 0.58, 1.71, 1.24]


def number(
    mean: float | None, low: float | None = None, high: float | None = None
) -> dict[str, Any]:
    return {"mean": mean, "low": low, "high": high}


def claim(paper: str, holds: bool | None, **more: Any) -> dict[str, Any]:
    return {"paper": paper, "measured": f"measured {paper}", "holds": holds, "unit": "m", **more}


def made_up() -> dict[str, Any]:
    """Results with two controllers, two sequences and a figure or two of each kind."""
    means = {"rl": (0.01, 0.02), "pid": (0.03, 0.05)}
    both = [(s, i) for i, s in enumerate(("x", "all"))]
    summary = {c: {s: {ERROR: m[i], DRIFT: 10 * m[i]} for s, i in both} for c, m in means.items()}
    spread = {
        c: {s: {ERROR: [m[i] - 0.001, m[i] + 0.002], DRIFT: [None, None]} for s, i in both}
        for c, m in means.items()
    }
    less = {
        k: {"pid": {s: number(-f * (1 + i), -0.5, -0.25) for s, i in both}}
        for k, f in ((ERROR, 0.02), (DRIFT, 2))
    }
    of_kind = {c: {ERROR: m[0], "time_at_limits": None} for c, m in means.items()}
    bound = {"x": {ERROR: 0.004}, "all": {ERROR: 0.005, "valve_travel": 7.0}}
    idle = {"x": {ERROR: 0.006}, "all": {ERROR: 0.008, "valve_travel": 5.0}}
    stronger = {"numbers": {"less": number(0.5)}, "unit": "s", "holds": None}
    tested = {"q1": {"one_step_rmse": 0.1, "persistence_rmse": 0.2, "free_run": {}}}
    tested |= {
        "q5": tested["q1"]
        | {"free_run": {"10": {"velocity_rmse": 0.3, "position_error_median": 0.4}}}
    }
    gap = {"tool_position_error_mean_of_runs": {"median": 0.01, "max": 0.02, "runs": 20}}
    singular = {
        c: {"all": {ERROR: m[0], "jerk_rms": 1.0, DRIFT: 0.1, "time_at_limits": 2.0}}
        for c, m in means.items()
    }
    return {
        "meta": {"effort": {"train_steps": 6_000_000}},
        "starts": [POSE, [0.5, *POSE[1:]], [-1.0, 0.5, 0.1, 2.3, 2.0], [-1.0, 0.5, 0.2, 2.4, 2.0]],
        "start_kinds": ["limits", "workspace", "extended", "extended"],
        "task_space": {
            "summary": summary, "intervals": spread, "rl_less": less,
            "by_kind": {"workspace": of_kind, "limits": of_kind, "extended": of_kind},
        },
        "regret": {
            "summary": {"perfect_model": bound, "perfect_model_no_dither": idle},
            "less_perfect_model": {"rl": {"x": number(0.007), "all": number(0.008)}},
        },
        "robustness": {
            "nominal": {
                "rl": number(0.02, 0.01, 0.03) | {"supply_demand": 0.5, "supply_limits": 0.0},
                "pid": number(0.05)
                | {"supply_demand": 1.25, "supply_limits": 0.125, "rl_less": number(-0.03)},
            }
        },
        "singular": {
            "summary": singular, "claims": [claim("near", True)],
            "w0": 0.8, "manipulability": [0.5, 0.25], "least": [0.125, 0.375],
        },
        "net_claims": [claim("past", True), claim("coupling", False), claim("gap", None)],
        "claims": [
            claim("still", True), claim("slow", False, stronger=stronger), claim("turn", True),
            claim("near", True), claim("track", None), claim("along z", True), claim("last", False),
        ],
        "actuator": {"test": tested},
        "preliminary": {"sim_to_real": gap},
        "paper_recipe": {"test": tested, "sim_to_real": gap},
        "tuning": {"pid": {"seed": 3, "cost": [0.5, 0.25], "cost_anew": 0.3, "at_bound": ["kp q1", "ki q3"]}},
        "tuning_runs": [{"start": POSE, "goals": [[1.0, 0.0, 0.0, 0.0], [2.0, 0.3, 0.0, 0.4]]}],
        "training_seeds": {},
    }  # fmt: skip


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures are what they were asked to show."""
    for name in (
        "plot_bars",
        "plot_sequence",
        "plot_joint_rates",
        "plot_starts",
        "plot_learning",
        "plot_free_run",
    ):
        monkeypatch.setattr(figures, name, lambda *a, name=name: (name, *a))
    plots = {"preliminary": "figure 2", "sim_to_real": "figure 5"}
    monkeypatch.setattr(
        preliminary, "plots", lambda *a: plots if (a[0], a[2]) == (BROKK_170, 4) and a[1] else {}
    )


def quote(paper: str, answer: str, *more: tuple[str, str]) -> Quote:
    return Quote(paper, ((f"measured {paper}", answer), *more))


HOLDS, NOT, UNKNOWN = "This holds here.", "This does not hold here.", "This was not measured."


def test_what_was_found_comes_first() -> None:
    results = made_up()
    results["task_space"]["summary"]["none"] = {"all": {ERROR: None}}
    title, text, rows = report.found(results)
    assert title == "What was found" and "all sequences [m/s]: rl 0.0200, pid 0.0500. A" in text
    assert "left with 0.0050 (" in text and "or with 0.0080 if it leaves" in text
    said, beside = "what the paper says", "for a baseline with feed-forward"
    assert list(rows) == [
        "past",
        "coupling",
        "gap",
        "still",
        "slow",
        "turn",
        "near",
        "track",
        "along z",
        "last",
    ]
    assert rows["slow"] == {said: "does not hold here", beside: "was not measured"}
    assert (
        rows["still"] == {said: "holds here", beside: ""}
        and rows["gap"][said] == "was not measured"
    )


def test_parts_on_the_nets_by_hand(drawn: None) -> None:
    net, test, curve = "nets", "log", Path("curve.csv")
    parts = report.net_parts(BROKK_170, net, test, made_up(), 4, curve, 3600.0)  # type: ignore[arg-type]
    papers, table, recipes, free, learned, gap = parts
    assert [part[0].split(" (")[0] for part in parts] == [
        "Preliminary tests", "Actuator nets", "Two recipes", "Nets run freely", "Learning curve",
        "Sim-to-real gap",
    ]  # fmt: skip
    assert papers[2:] == (quote("past", HOLDS), quote("coupling", NOT), "figure 2")
    one = {"one_step_rmse [rad/s]": 0.1, "persistence_rmse [rad/s]": 0.2}
    run = {"velocity_rmse [rad/s]": 0.3, "position_error_median [rad]": 0.4}
    assert table[2] == {"q1": one, "q5": one | run}
    row = {"q1": None, "q5": 0.3, "tool, median": 0.01, "tool, max": 0.02}
    assert recipes[2] == {"rich, free runs (ours)": row, "sines, one step (paper)": row}
    assert free[2:] == (("plot_free_run", net, test),) and learned[3] == ("plot_learning", curve)
    assert isinstance(learned[2], Quote) and gap[2:] == (quote("gap", UNKNOWN), "figure 5")


def test_parts_on_the_task_stand_with_their_sentences_and_figures(drawn: None) -> None:
    results, traces = (
        made_up(),
        {"all": {}, "singular": {("rl", "least_half"): SimpleNamespace(q=np.zeros((50, 2)))}},
    )
    parts = report.task_parts(BROKK_170, results, traces)  # type: ignore[arg-type]
    by_title = {part[0].split(" (")[0]: part for part in parts}
    assert list(by_title) == [
        "Start configurations", "Motion along x", "Motion along y", "Motion along z", "Near the singularity",
        "Figures of merit", "Velocity error and drift by sequence", "RL less each baseline",
        "Starts of other kinds",
        "Regret", "Robustness", "Scored sequences", "Scored starts", "Tuning of the baselines", "Tuning runs",
    ]  # fmt: skip
    first = by_title["Start configurations"]
    assert first[1].startswith("1 limits, 1 workspace, 2 extended. ")
    name, machine, starts, kinds = first[2]
    np.testing.assert_array_equal(starts, results["starts"])
    assert (name, machine, kinds) == ("plot_starts", BROKK_170, results["start_kinds"])
    stronger = (report.BESIDE + "less 0.5 [s]", UNKNOWN)
    *still, along_x, rates = by_title["Motion along x"][2:]
    assert still == [quote("still", HOLDS), quote("slow", NOT, stronger), quote("turn", HOLDS)]
    assert all(isinstance(part[1], str) for part in parts)
    for axis, (kind, machine, shown, sequence, start, run) in enumerate(
        (along_x, by_title["Motion along y"][-1], by_title["Motion along z"][-1])
    ):
        assert (kind, machine, shown, sequence.name, run) == (
            "plot_sequence",
            BROKK_170,
            {},
            "xyz"[axis],
            1,
        )
        np.testing.assert_array_equal(start, results["starts"][1])
    assert (*rates[:3], rates[3].name, rates[4]) == ("plot_joint_rates", BROKK_170, {}, "x", 1)
    assert by_title["Motion along y"][2] == quote("track", UNKNOWN)
    assert by_title["Motion along z"][2] == quote("along z", HOLDS)
    singular = by_title["Near the singularity"]
    assert "manipulability 0.25 to 0.50, damping sets in below 0.80; least" in singular[1]
    assert "0.12 to 0.38 m/rad" in singular[1] and singular[2] == quote("near", HOLDS)
    name, machine, shown, half, start, run = singular[3]
    assert (name, machine, shown) == ("plot_sequence", BROKK_170, traces["singular"])
    wanted = singular_sequences(BROKK_170, np.array(results["starts"][2:]))[0].goals[:50]
    np.testing.assert_array_equal(half.goals, wanted)
    assert start.tolist() == results["starts"][3] and run == 1  # nearest to a singularity
    units = {
        f"{ERROR} [m/s]": 0.03,
        "jerk_rms [m/s^3]": 1.0,
        f"{DRIFT} [m]": 0.1,
        "time_at_limits [s]": 2.0,
    }
    assert singular[4]["pid"] == units and by_title["Figures of merit"][2] == quote("last", NOT)
    assert len(report.task_parts(BROKK_170, results, traces | {"singular": {}})) == len(parts) - 1  # type: ignore[arg-type, operator]


def test_tables_of_the_comparison_by_hand(drawn: None) -> None:
    merit, by_sequence, pairs, kinds, regret, robust = report._tables(made_up(), quote("last", NOT))
    error, drift = f"{ERROR} [m/s]", f"{DRIFT} [m]"
    rl, pid = "0.0200 (0.0190 to 0.0220)", "0.0500 (0.0490 to 0.0520)"
    assert merit[2:] == (
        quote("last", NOT), {error: {"rl": rl, "pid": pid}, drift: {"rl": "0.2000", "pid": "0.5000"}},
    )  # fmt: skip
    along = {"rl": "0.0100 (0.0090 to 0.0120)", "pid": "0.0300 (0.0290 to 0.0320)"}
    assert by_sequence[3] == {"x": along, "all": {"rl": rl, "pid": pid}}
    assert by_sequence[5] == {
        "x": {"rl": "0.1000", "pid": "0.3000"},
        "all": {"rl": "0.2000", "pid": "0.5000"},
    }
    name, shown = by_sequence[6]
    assert name == "plot_bars" and list(shown) == ["mean velocity error [m/s]", "largest drift [m]"]
    assert shown["largest drift [m]"]["pid"] == {"x": number(0.3), "all": number(0.5)}
    ends = " (-0.5000 to -0.2500)"
    less = {"x": {"pid": f"-0.0200{ends}"}, "all": {"pid": f"-0.0400{ends}"}}
    assert pairs[3] == {error: less["all"], drift: {"pid": f"-4{ends}"}}
    assert pairs[4:6] == (f"{error} by sequence.", less) and pairs[6] == f"{drift} by sequence."
    assert pairs[7] == {"x": {"pid": f"-2{ends}"}, "all": {"pid": f"-4{ends}"}}
    of_kind = {error: {"rl": 0.01, "pid": 0.03}, "time_at_limits [s]": {"rl": None, "pid": None}}
    assert kinds[2:] == ("Limits starts.", of_kind, "Extended starts.", of_kind)
    bounds = {
        "perfect_model": {"x [m/s]": 0.004, "all [m/s]": 0.005, "valve travel [full strokes]": 7.0},
        "perfect_model_no_dither": {
            "x [m/s]": 0.006,
            "all [m/s]": 0.008,
            "valve travel [full strokes]": 5.0,
        },
    }
    numbers = {"rl": {"x": number(0.007), "all": number(0.008)}}
    assert regret[3] == bounds and regret[5:] == (
        {"rl": {"x": "0.0070", "all": "0.0080"}}, ("plot_bars", {"regret [m/s]": numbers}),
    )  # fmt: skip
    assert robust[2] == {"nominal": {"rl": "0.0200 (0.0100 to 0.0300)", "pid": "0.0500"}}
    assert robust[4] == {"nominal": {"pid": "-0.0300"}}
    assert robust[6] == {"nominal": {"pump's flow asked for": "125%", "ticks it limits": "12.5%"}}


def test_figures_of_training_seeds_join_the_tables(drawn: None) -> None:
    assert report._seeds({}) == []
    rl = {"velocity_error_to_go": number(0.5, 0.25, 0.75), "valve_travel": number(9.0)}
    less = {"velocity_error_to_go": number(-0.5), "valve_travel": number(1.0)}
    results = made_up() | {"training_seeds": {"rl": rl, "pid": rl, "rl less pid": less}}
    _, _, alone, _, paired, (name, bars) = report._tables(results, quote("last", NOT))[-1]
    cell = {"rl": "0.5000 (0.2500 to 0.7500)", "pid": "0.5000 (0.2500 to 0.7500)"}
    assert alone == {"velocity_error_to_go": cell, "valve_travel": {"rl": "9", "pid": "9"}}
    assert paired == {
        "velocity_error_to_go": {"rl less pid": "-0.5000"},
        "valve_travel": {"rl less pid": "1"},
    }
    shown = {c: {"to_go": rl["velocity_error_to_go"]} for c in ("rl", "pid")}
    assert (name, bars) == ("plot_bars", {"mean velocity error [m/s]": shown})


def test_what_was_scored_and_tuned_on_is_listed() -> None:
    sequences, scored, tuned, runs = (part[2] for part in report._lists(BROKK_170, made_up()))
    assert list(sequences)[:3] == ["x", "y", "z"] and sequences["x"]["seconds"] == pytest.approx(
        18.0
    )
    angles = dict(zip(BROKK_170.names, POSE, strict=True))
    assert (
        scored["start 0"] == angles | {"kind": "limits"} and scored["start 2"]["kind"] == "extended"
    )
    costs = {"seed": 3, "first": 0.5, "last": 0.25, "under other noise": 0.3}
    assert tuned == {"pid": costs | {"gains at a bound": "kp q1, ki q3"}}
    free = report._tuning({"a": {"seed": 3, "cost": [0.5, 0.25], "cost_anew": 0.3, "at_bound": []}})
    assert free == {"a": costs | {"gains at a bound": "none"}}
    goals = "1 s (0, 0, 0); 2 s (0.3, 0, 0.4)"
    said = {"seconds": 3.0, "changes": 1, "speed [m/s]": 0.5, "path [m]": 1.0}
    assert runs == {"tuning run 0": angles | said | {"held for, vx, vy, vz [m/s]": goals}}


# --- the page -------------------------------------------------------------------------------------------


def test_a_page_by_hand(tmp_path: Path) -> None:
    """Names from logs stay text; a table's first row names its columns; long cells may break."""
    contents = [
        "5 < 6",
        Quote("a & b", (("m<", "This."), ("n", "That."))),
        {"r_1": {"c": 0.123456, "d": None}},
    ]
    figures.write_report(
        tmp_path / "r.html", [("t<", "s>", *contents)], {"fit": 12.4, "train": 3.6}
    )
    page = (tmp_path / "r.html").read_text()
    assert page.startswith(
        "<!doctype html><meta charset=utf-8><title>brokk_min report</title><style>body{"
    )
    assert (
        "<p>Seconds spent: fit 12, train 4.</p>\n<h2>t&lt;</h2><p>s&gt;</p>\n<p>5 &lt; 6</p>\n"
        in page
    )
    lines = "<p><b>Measured:</b> m&lt;. <b>This.</b></p><p><b>Measured:</b> n. <b>That.</b></p>"
    assert f"<blockquote><p><b>Paper:</b> a &amp; b</p>{lines}</blockquote>\n" in page
    row = "<tr><td>r_<wbr>1</td><td>0.1235</td><td></td></tr>"
    assert page.endswith(f"<table><tr><th></th><th>c</th><th>d</th></tr>{row}</table>\n")
    assert figures._table({"r": {"c": "x" * 41, "d": "<" * 10, "e": 7}}) == (
        "<table><tr><th></th><th>c</th><th>d</th><th>e</th></tr><tr><td>r</td>"
        f"<td class=wide>{'x' * 41}</td><td>{'&lt;' * 10}</td><td>7</td></tr></table>"
    )
    assert " class" not in figures._table({"r": {"c": "x" * 40}})


# --- figures --------------------------------------------------------------------------------------------


def lines(ax: Any) -> dict[str, np.ndarray]:
    return {line.get_label(): np.array(line.get_data()) for line in ax.get_lines()}


@pytest.fixture
def closing() -> Any:
    yield
    figures.plt.close("all")


@pytest.mark.usefixtures("closing")
def test_panels_show_their_curves_and_share_what_they_are_to_share() -> None:
    x = np.arange(3.0)
    one, two, far = ({"rl": (x, k * x), "other": (x, k + x)} for k in (1, 2, 9))
    rows = [[Panel("a", "t", "v", one), Panel("b", "t", "w", far)], [Panel("c", "t", "v", two)]]
    figure = figures.plot_panels(rows)
    assert [ax.get_title() for ax in figure.axes] == ["a", "b", "c"] and len(figure.legends) == 1
    np.testing.assert_array_equal(lines(figure.axes[1])["rl"], [x, 9 * x])
    np.testing.assert_array_equal(lines(figure.axes[2])["other"], [x, 2 + x])
    assert [ax.get_ylabel() for ax in figure.axes] == ["v", "w", "v"] and figure.axes[
        0
    ].get_xlabel() == "t"
    assert figure.axes[0].get_lines()[0].get_color() == figures.STYLES["rl"]["color"]
    assert figure.axes[0].get_lines()[1].get_color() == figures.OTHERS[1]["color"]
    limits = [ax.get_ylim() for ax in figure.axes]
    assert limits[0] == limits[2] != limits[1]  # one quantity above the other
    assert tuple(figure.get_size_inches()) == (10.0, pytest.approx(5.5))
    same = figures.plot_panels(
        [[Panel("", "t", "v", one), Panel("", "t", "w", far)]], one_scale=True
    )
    assert same.axes[0].get_ylim() == same.axes[1].get_ylim()


@pytest.mark.usefixtures("closing")
def test_motion_along_a_sequence_is_drawn_from_where_it_began() -> None:
    sequence, start, rng = axis_sequences(BROKK_170)[0], np.array(POSE), np.random.default_rng(0)
    trace = SimpleNamespace(
        **{k: rng.normal(size=(360, 2, n)) for k, n in (("p_tool", 3), ("v_tool", 3), ("q_dot", 5))}
    )
    traces: Any = {("rl", "x"): trace, ("rl", "y"): None}
    figure = figures.plot_sequence(BROKK_170, traces, sequence, start, 1)
    time = 0.05 * np.arange(1, 361)
    labels = [
        "x - x(0) [m]",
        "y - y(0) [m]",
        "z - z(0) [m]",
        *(f"velocity {a} [m/s]" for a in "xyz"),
    ]
    assert [ax.get_ylabel() for ax in figure.axes] == labels
    assert {(ax.get_xlabel(), ax.get_title()) for ax in figure.axes} == {("time [s]", "")}
    assert figure.axes[0].get_ylim() == figure.axes[2].get_ylim() != figure.axes[3].get_ylim()
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["wanted", "rl"]
    first = figures.kinematics.tool_position(BROKK_170, start)
    for i in range(3):
        above, below = lines(figure.axes[i]), lines(figure.axes[3 + i])
        np.testing.assert_allclose(above["rl"], [time, trace.p_tool[:, 1, i] - first[i]])
        np.testing.assert_allclose(above["wanted"], [time, 0.05 * np.cumsum(sequence.goals[:, i])])
        np.testing.assert_allclose(below["rl"], [time, trace.v_tool[:, 1, i]])
        np.testing.assert_allclose(below["wanted"], [time, sequence.goals[:, i]])
    figure = figures.plot_joint_rates(BROKK_170, traces, sequence, 1)
    assert [ax.get_ylabel() for ax in figure.axes] == [
        f"velocity q{i} [rad/s]" for i in (1, 3, 4, 5)
    ]
    assert [ax.get_subplotspec().rowspan.start for ax in figure.axes] == [0, 0, 1, 1]
    np.testing.assert_array_equal(lines(figure.axes[2])["rl"], [time, trace.q_dot[:, 1, 3]])


@pytest.mark.usefixtures("closing")
def test_bars_stand_side_by_side_with_their_intervals() -> None:
    bars = {
        "rl": {"x": number(2.0, 1.5, 4.0), "a_b": number(1.0)},
        "jacobian_pid_ff": {"x": number(3.0, 2.0, 3.5), "a_b": number(None)},
    }
    figure = figures.plot_bars({"error [m]": bars, "more": bars})
    upper, lower = figure.axes
    assert (upper.get_ylabel(), lower.get_ylabel()) == ("error [m]", "more") and len(
        figure.legends
    ) == 1
    found = {c.get_label(): c for c in upper.containers if hasattr(c, "patches")}
    for (name, heights), middle in zip(
        {"rl": [2, 1], "jacobian_pid_ff": [3, 0]}.items(), (-0.2, 0.2), strict=True
    ):
        patches = found[name].patches
        assert [p.get_height() for p in patches] == heights
        assert [p.get_x() + p.get_width() / 2 for p in patches] == pytest.approx(
            [middle, 1 + middle]
        )
        assert {round(p.get_width(), 9) for p in patches} == {0.4}
        assert patches[0].get_facecolor() == figures.matplotlib.colors.to_rgba(
            figures.STYLES[name]["color"]
        )
    ends = found["rl"].errorbar.lines[2][0].get_segments()
    np.testing.assert_allclose([end[:, 1] for end in ends], [[1.5, 4.0], [1.0, 1.0]])
    assert [t.get_text() for t in upper.get_xticklabels()] == ["x", "a\nb"]


@pytest.mark.usefixtures("closing")
def test_arms_at_their_starts_are_drawn_from_the_side_and_from_above() -> None:
    starts = np.array([[0.5 * np.pi, *POSE[1:]], [0.0, *POSE[1:]], POSE])
    figure = figures.plot_starts(BROKK_170, starts, ["limits", "workspace", "limits"])
    side, top = ([np.array(line.get_data()) for line in ax.get_lines()] for ax in figure.axes)
    for arm in side[:3]:
        np.testing.assert_allclose(
            arm, side[0], atol=1e-9
        )  # turned arms look the same from the side
        np.testing.assert_allclose(arm[:, -1], [3.05, 1.01], atol=0.01)
    assert side[3][1].tolist() == [0, 0]  # the ground
    for arm, (x, y) in zip(
        top, [(0, 3.05), (3.05, 0), (3.05 * np.cos(1.5), 3.05 * np.sin(1.5))], strict=True
    ):
        np.testing.assert_allclose(arm[:, -1], [x, y], atol=0.01)
    assert [t.get_text() for t in figure.legends[0].get_texts()] == ["limits", "workspace"]
    names = [(ax.get_xlabel(), ax.get_ylabel()) for ax in figure.axes]
    assert names == [("outward from the slew axis [m]", "z [m]"), ("x [m]", "y [m]")]
    assert all(ax.get_aspect() == 1.0 for ax in figure.axes)
    colours = [figures.STYLES[kind]["color"] for kind in ("limits", "workspace", "limits")]
    for ax in figure.axes:
        assert [line.get_color() for line in ax.get_lines()[:3]] == colours


@pytest.mark.usefixtures("closing")
def test_a_learning_curve_is_drawn_over_millions_of_steps(tmp_path: Path) -> None:
    path = tmp_path / "c.csv"
    path.write_text(
        "global_step,charts/reward,charts/velocity_error\n1000000,0.5,0.1\n3000000,0.75,0.05\n"
    )
    reward, error = figures.plot_learning(path).axes
    np.testing.assert_array_equal(lines(reward)["rl"], [[1, 3], [0.5, 0.75]])
    np.testing.assert_array_equal(lines(error)["rl"], [[1, 3], [0.1, 0.05]])
    assert (
        error.get_ylabel() == "velocity error [m/s]"
        and reward.get_xlabel() == "environment steps [million]"
    )


@pytest.mark.parametrize(("samples", "ticks"), [(40, 34), (900, 600)])
def test_free_runs_begin_after_a_history_and_last_30_s_or_to_the_end(
    samples: int, ticks: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    net: Any = SimpleNamespace(history=5, rate=20.0, joints=("a", "b"))
    q = np.arange(2.0 * samples).reshape(samples, 2)
    recording = figures.logs.Recording("r", np.eye(2)[np.ones(samples, int)], q, -q)
    own = np.full((ticks, 1, 2), 7.0)

    def free(of: Any, one: Any, starts: np.ndarray, steps: int) -> tuple[np.ndarray, np.ndarray]:
        assert (of, one, starts.tolist(), steps) == (net, recording, [5], ticks)
        return own, -own

    monkeypatch.setattr(figures.scores, "free_run", free)
    monkeypatch.setattr(figures, "plot_panels", lambda rows: rows)
    ((angle, velocity),) = figures.plot_free_run(net, figures.logs.Log(("a", "b"), (recording,)))
    assert (angle.ylabel, velocity.ylabel) == ("b [rad]", "b [rad/s]")  # the other has no command
    for panel, sign in ((angle, 1), (velocity, -1)):
        time, real = panel.curves["measured"]
        np.testing.assert_allclose(time, 0.05 * np.arange(1, ticks + 1))
        np.testing.assert_array_equal(real, sign * q[6 : 6 + ticks, 1])
        np.testing.assert_array_equal(panel.curves["free run"][1], sign * own[:, 0, 1])


def test_the_worst_and_the_median_recording_are_shown_by_their_worst_joint(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    errors = np.array([[0.1, 0.3], [np.nan, np.nan], [0.9, 0.2], [0.4, np.nan]])
    names = ("r0", "r1", "r2", "r3")
    log = figures.logs.Log(
        ("a", "b"), tuple(figures.logs.Recording(n, *np.zeros((3, 1, 2))) for n in names)
    )
    monkeypatch.setattr(
        figures.scores,
        "recording_errors",
        lambda net, log, seconds: errors if seconds == 30.0 else 0,
    )
    curves = lambda net, r: [
        ([f"{r.name} {j} {k}" for j in "ab"], {"c": np.ones((2, 2))}) for k in "qv"
    ]
    monkeypatch.setattr(figures, "_free_run", curves)
    monkeypatch.setattr(figures, "plot_panels", lambda rows: rows)
    worst, median = figures.plot_worst_and_median(SimpleNamespace(rate=20.0), log)  # type: ignore[arg-type]
    assert [(p.title, p.ylabel) for p in worst] == [
        ("worst: r2", "r2 a q"),
        ("worst: r2", "r2 a v"),
    ]
    assert [(p.title, p.ylabel) for p in median] == [
        ("median: r3", "r3 a q"),
        ("median: r3", "r3 a v"),
    ]


@pytest.mark.usefixtures("closing")
def test_a_figure_is_saved_the_same_each_time_and_closed(tmp_path: Path) -> None:
    pages = []
    for name in ("a.png", "b.png"):
        figure = figures.plt.figure(figsize=(1.0, 0.5))
        figure.add_subplot().plot([0, 1])
        figures.save(tmp_path / name, figure)
        figure = figures.plt.figure(figsize=(1.0, 0.5))
        figure.add_subplot().plot([0, 1])
        pages.append(figures._content("a < b", figure))
        assert not figures.plt.get_fignums()
    one, two = ((tmp_path / name).read_bytes() for name in ("a.png", "b.png"))
    assert one == two and one[:4] == b"\x89PNG" and one[16:24] == bytes([0, 0, 0, 150, 0, 0, 0, 75])
    assert pages[0] == pages[1] and pages[0].startswith(
        "<img alt='a &lt; b' src='data:image/png;base64,"
    )
    assert base64.b64decode(pages[0].split(",")[1][:-2]) == one and b"Software" not in one
