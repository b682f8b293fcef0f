"""The page from made-up results: every section has its sentences, tables and images."""

from __future__ import annotations

import html
import re

import numpy as np
import pytest

from brokk_min.evaluation import claims, report
from brokk_min.evaluation.claims import Claim
from brokk_min.machine import BROKK_170

ERROR, DRIFT = "velocity_error_mean", "off_axis_drift_max"
POSE = list(BROKK_170.q_start)
CLOCK = {"fit": 12.4, "train": 3600.0}


def number(mean, low=None, high=None):
    return {"mean": mean, "low": low, "high": high}


def made_up():
    """Results with two controllers, two sequences, and one number of each kind."""
    means = {"rl": (0.01, 0.02), "p_d": (0.03, 0.05)}
    both = [(s, i) for i, s in enumerate(("x", "all"))]
    summary = {c: {s: {ERROR: m[i], DRIFT: 10 * m[i]} for s, i in both} for c, m in means.items()}
    ends = {
        c: {s: {ERROR: [m[i] - 0.001, m[i] + 0.002], DRIFT: [None, None]} for s, i in both}
        for c, m in means.items()
    }
    less = {
        key: {"p_d": {s: number(-f * (1 + i), -0.5, -0.25) for s, i in both}}
        for key, f in ((ERROR, 0.02), (DRIFT, 2))
    }
    of_kind = {c: {ERROR: m[0], "time_at_limits": None} for c, m in means.items()}
    bound = {"x": {ERROR: 0.004}, "all": {ERROR: 0.005, "valve_travel": 7.0}}
    closed = {"x": {ERROR: 0.006}, "all": {ERROR: 0.008, "valve_travel": 5.0}}
    nets = {"q1": {"one_step_rmse": 0.1, "persistence_rmse": 0.2, "free_run": {}}}
    free = {"10": {"velocity_rmse": 0.3, "position_error_median": 0.4}}
    nets["q5"] = nets["q1"] | {"free_run": free}
    gap = {"tool_position_error_mean_of_runs": {"median": 0.015, "max": 0.025, "runs": 20}}
    jerk = {"all": {ERROR: 0.3, "jerk_rms": 1.5, DRIFT: 0.1, "time_at_limits": 2.0}}
    robust = number(0.02, 0.01, 0.03) | {"supply_demand": 0.5, "supply_limits": 0.0}
    weak = number(0.05) | {"supply_demand": 1.25, "supply_limits": 0.125, "rl_less": number(-0.03)}
    tuning = {"seed": 3, "cost": [0.5, 0.25], "cost_anew": 0.3, "at_bound": ["kp q1"]}
    stronger = Claim("drift", {"less": number(0.5)}, None)
    result = [Claim("still", {"rl": number(0.1)}, True), Claim("drift", {}, False, stronger)]
    result += [Claim(name, {}, True) for name in ("slowed", "tracking", "along z", "outperforms")]
    net_claims = [Claim("coupling", {}, True), Claim("gap", {}, None)]
    return {
        "meta": {"machine": "digger <1>", "effort": {"train_steps": 6_000_000}},
        "starts": [POSE, [0.5, *POSE[1:]], [-1.0, 0.5, 0.1, 2.3, 2.0]],
        "start_kinds": ["limits", "workspace", "extended"],
        "task_space": {
            "summary": summary, "intervals": ends, "rl_less": less,
            "by_kind": {"workspace": of_kind, "limits": of_kind},
        },
        "regret": {
            "summary": {"perfect_model": bound, "perfect_model_no_dither": closed},
            "less_perfect_model": {"rl": {"x": number(0.007), "all": number(0.008)}},
        },
        "robustness": {"nominal": {"rl": robust, "p_d": weak}},
        "singular": {"summary": {"rl": jerk}, "w0": 0.8, "manipulability": [0.5, 0.25],
                     "least": [0.125, 0.375]},
        "net_claims": [claim.to_json() for claim in net_claims],
        "claims": [claim.to_json() for claim in result],
        "actuator": {"test": nets},
        "preliminary": {"sim_to_real": gap},
        "paper_recipe": {"test": nets, "sim_to_real": gap},
        "gains": {"p_d": {}},
        "tuning": {"p_d": tuning},
        "tuning_runs": [{"start": POSE, "goals": [[1.0, 0.0, 0.0, 0.0], [2.0, 0.3, 0.0, 0.4]]}],
        "training_seeds": {},
    }  # fmt: skip


IMAGES = ["tests", "free_run", "learning", "gap", "starts", "x", "y", "z", "joint_velocities"]
IMAGES += ["by_sequence", "regret", "singular", "seeds"]


def sections(results, left_out=""):
    """Sections of the page by their titles, each image as its name."""
    images = {name: name for name in IMAGES if name != left_out}
    page = report.render(BROKK_170, results, images, CLOCK)
    first, *parts = page.split("<h2>")
    titles = [part.split("</h2>")[0] for part in parts]
    assert len(set(titles)) == len(titles)
    return {"": first} | dict(zip(titles, parts, strict=True))


def rows(section):
    """Cells of all tables of a section."""
    result = []
    for line in re.findall(r"<tr>(.*?)</tr>", section, re.DOTALL):
        cells = re.findall(r"<t[dh][^>]*>(.*?)</t[dh]>", line)
        result.append([html.unescape(cell.replace("<wbr>", "")) for cell in cells])
    return result


def test_render__has_the_papers_figures_in_order():
    result = sections(made_up())
    numbered = [title for title in result if "(Fig." in title or title == "Learning curve"]
    assert numbered == [
        "Preliminary tests (Fig. 2)", "Learning curve", "Sim-to-real gap (Fig. 5)",
        "Start configurations (Fig. 6a)", "Motion along x (Fig. 6b-d)",
        "Motion along y (Fig. 6e, f)", "Motion along z (Fig. 6g, h)",
        "Near the singularity (Fig. 6a, e, f)",
    ]  # fmt: skip
    for title in numbered:  # each figure stands with its sentences
        assert "<img" in result[title] and ("<blockquote>" in result[title] or "6a)" in title)
    assert "Training seeds" not in result
    assert not any("singularity" in title for title in sections(made_up(), left_out="singular"))


def test_render__is_one_file_and_escapes_names():
    page = report.render(BROKK_170, made_up(), dict.fromkeys(IMAGES, "QUJD"), CLOCK)
    assert page.startswith("<!doctype html>") and page.rstrip().endswith("</html>")
    assert page.count('src="data:image/png;base64,QUJD"') == 12
    assert not re.findall(r'(?:src|href)="(?!data:)', page) and "http" not in page
    assert "digger &lt;1&gt;) is an analytic plant, not a real machine" in page
    assert "Time of each stage [s]: fit 12, train 3600." in page


def test_render__answers_the_papers_sentences_first():
    text = sections(made_up())["Results"]
    assert "all sequences [m/s]: rl 0.0200, p_d 0.0500." in text
    assert "an error of 0.0050 m/s" in text and "It has 0.0080 m/s if" in text
    header, *answers = rows(text)
    assert len(answers) == 8 and header[0] == "the paper says"
    assert answers[1][1:] == ["was not measured", ""]
    assert answers[3] == [
        claims.TEXTS["drift"]["paper"], "does not hold here", "was not measured"
    ]  # fmt: skip


def test_render__quotes_each_claim_below_its_figure():
    result = sections(made_up())
    quotes = {title: text.count("<blockquote>") for title, text in result.items()}
    assert quotes["Motion along x (Fig. 6b-d)"] == 2 and quotes["Figures of merit"] == 1
    assert sum(quotes.values()) == 9  # with the training
    assert "6,000,000 steps here 1 [h]. <b>This does not hold" in result["Learning curve"]
    along_x = html.unescape(result["Motion along x (Fig. 6b-d)"])
    assert "to be below 0.05 m: rl 0.1 [m]. <b>This holds here.</b>" in along_x
    assert "does not have: largest distance" in along_x
    assert "RL's: less 0.5 [m]. <b>This was not measured.</b>" in along_x
    assert result["Motion along x (Fig. 6b-d)"].count("<img") == 2
    singular = result["Near the singularity (Fig. 6a, e, f)"]
    assert "manipulability 0.25 to 0.50, damping begins below 0.80" in singular
    assert "0.12 to 0.38 m/rad" in singular
    assert rows(singular)[1] == ["rl", "0.3", "1.5", "0.1", "2"]


def test_render__has_the_tables_of_nets_and_of_the_comparison():
    result = {title: rows(text)[1:] for title, text in sections(made_up()).items()}
    error, drift = f"{ERROR} [m/s]", f"{DRIFT} [m]"
    assert result["Actuator nets"] == [
        ["q1", "0.1", "0.2", "", ""],
        ["q5", "0.1", "0.2", "0.3", "0.4"],
    ]
    recipe = ["", "0.3", "0.015", "0.025"]
    assert [row[1:] for row in result["Two recipes"]] == [recipe, recipe]
    rl, pid = "0.0200 (0.0190 to 0.0220)", "0.0500 (0.0490 to 0.0520)"
    assert result["Figures of merit"] == [[error, rl, pid], [drift, "0.2000", "0.5000"]]
    along = ["x", "0.0100 (0.0090 to 0.0120)", "0.0300 (0.0290 to 0.0320)"]
    by_sequence = result["Velocity error and drift by sequence"]
    assert by_sequence[:2] == [along, ["all", rl, pid]] and by_sequence[3] == [
        "x",
        "0.1000",
        "0.3000",
    ]
    less = result["RL less each baseline"]
    assert less[:2] == [
        [error, "-0.0400 (-0.5000 to -0.2500)"], [drift, "-4 (-0.5000 to -0.2500)"]
    ]  # fmt: skip
    assert less[3] == ["x", "-0.0200 (-0.5000 to -0.2500)"] and len(less) == 8
    others = [[error, "0.01", "0.03"], ["time_at_limits [s]", "", ""]]
    assert result["Starts of other kinds"] == others
    regret = result["Regret"]
    assert regret[:2] == [
        ["perfect_model", "0.004", "0.005", "7"], ["perfect_model_no_dither", "0.006", "0.008", "5"]
    ]  # fmt: skip
    assert regret[3] == ["rl", "0.0070", "0.0080"]
    robust = result["Robustness"]
    assert robust[0] == ["nominal", "0.0200 (0.0100 to 0.0300)", "0.0500"]
    assert robust[2] == ["nominal", "-0.0300"] and robust[4] == ["nominal", "125 %", "12.5 %"]


def test_render__lists_what_was_scored_and_tuned_on():
    result = {title: rows(text) for title, text in sections(made_up()).items()}
    assert [row[0] for row in result["Scored sequences"][1:4]] == ["x", "y", "z"]
    assert result["Scored sequences"][1][1] == "18"
    starts = result["Scored starts"]
    assert starts[1] == ["start 0", "1.5", "0.5", "0.58", "1.71", "1.24", "limits"]
    assert result["Tuning of the baselines"][1] == ["p_d", "3", "0.5", "0.25", "0.3", "kp q1"]
    run = result["Tuning runs"][1]
    assert run[:2] == ["tuning run 0", "1.5"] and run[6:10] == ["3", "1", "0.5", "1"]
    assert run[10] == "1 s (0, 0, 0); 2 s (0.3, 0, 0.4)"


def test_render__shows_training_seeds():
    row = {"velocity_error_x": number(0.5, 0.25, 0.75), "valve_travel": number(9.0)}
    less = {"velocity_error_x": number(-0.5), "valve_travel": number(1.0)}
    text = sections(made_up() | {"training_seeds": {"rl": row, "rl less p_d": less}})
    assert rows(text["Training seeds"])[1] == [
        "velocity_error_x", "0.5000 (0.2500 to 0.7500)", "-0.5000"
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (number(0.01234, -0.5, 0.03), "0.0123 (-0.5000 to 0.0300)"),
        (number(41.267, 40.0, 42.5), "41.27 (40 to 42.5)"),
        (number(0.5), "0.5000"),
        (number(None), ""),
    ],
)
def test_interval_text__has_digits_that_tell_it(value, text):
    assert report.interval_text(value) == text


def test_path_row__lists_the_goals_that_hold():
    row = report.path_row(np.array([[1.0, 0.0, 0.0, 0.0], [0.85, -0.0, -0.2, 0.0]]))
    *numbers, goals = row.values()
    assert numbers == pytest.approx([1.85, 1, 0.2, 0.17])
    assert goals == "1 s (0, 0, 0); 0.85 s (0, -0.2, 0)"
    assert report.path_row(np.ones((60, 4)))["held for, vx, vy, vz [m/s]"] == "new at every tick"


def test_seed_bars__are_velocity_errors_of_controllers_by_sequence():
    row = {"velocity_error_to_go": number(0.5, 0.25, 0.75), "valve_travel": number(9.0)}
    bars = report.seed_bars({"rl": row, "pid": row, "rl less pid": row})
    errors = {"to_go": row["velocity_error_to_go"]}
    assert bars == {"rl": errors, "pid": errors}
