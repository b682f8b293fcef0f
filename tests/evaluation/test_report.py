"""The page says in its first sentence what was measured, and has each sentence of the paper."""

import html
import json
import re
from collections import defaultdict

import numpy as np
import pytest
from matplotlib import rc_context
from matplotlib.figure import Figure

from brokk_min.evaluation import metrics, report
from brokk_min.evaluation.claims import TEXTS, task_claims
from brokk_min.machine import BROKK_170

ERRORS = {"rl": 0.0101, "rl_paper": 0.0303, "pid_by_hand": 0.0404, "jacobian_pid_k0.1": 0.0202}
ERRORS |= {"pid_by_hand_raw": 0.0505, "jacobian_pid_ff_integral": 0.0105}
RNG = np.random.default_rng(0)


def run(controller, sequence, start):
    figures = {key: 10 * ERRORS[controller] + RNG.normal(0, 1e-5) for key in metrics.COLUMNS}
    figures["velocity_error_mean"] = ERRORS[controller] + (start - 0.5) * 2e-4
    labels = zip(metrics.LABELS, (controller, sequence, start, "workspace"), strict=True)
    return dict(labels) | figures


def results(hours=1.0, machine="digger <1>"):
    """As `reproduce` has them, of made-up runs from two starts."""
    runs = [run(c, s, start) for c in ERRORS for s in "xyz" for start in (0, 1)]
    means = metrics.means(runs)
    of_nets = [{"paper": text["paper"], "figure": text["figure"]} for text in TEXTS.values()][:3]
    numbers = {"nets": {"ratio": {"mean": 1.5, "low": 1.5, "high": 1.5}}}
    made_up = {"measured": "this", "verdict": "holds here for nets", "numbers": numbers}
    return {
        "meta": {"machine": machine, "seed": 3, "effort": {"hours": hours}},
        "table": {name: of["all"] for name, of in means.items()},
        "task_space": {"means": means},
        "robustness": {"nominal": {c: {"mean": e, "low": 0, "high": 1} for c, e in ERRORS.items()}},
        "claims": [claim | made_up for claim in of_nets] + task_claims(runs),
        "start_kinds": ["workspace", "limits", "workspace"],
    }


def render(*args):
    return report.render(results(*args), defaultdict(lambda: "QUJD"))


@pytest.fixture(scope="module")
def page():
    return render()


def first_screen(page):
    """Its numbers, and the cells of its table."""
    first = page.split("<h2>")[0]
    sentence, _, rest = first.partition("<table")
    numbers = re.findall(r"([\d.]+) m/s", sentence.split("<p>")[1])
    rows = [re.findall("<td.*?>(.*?)</td>", row) for row in re.findall("<tr>(.*?)</tr>", rest)]
    return numbers, rows[1:], rest


def test_render__begins_with_one_sentence_a_figure_and_a_table(page):
    numbers, rows, rest = first_screen(page)
    assert numbers == ["0.0303", "0.0404", "0.0202", "0.0101", "0.0105"]
    names = ["PID by hand", "PID optimised, k = 0.1", "PPO, the paper&#39;s agent"]
    assert [row[0] for row in rows] == [*names, "PPO, our interface", "strongest PID"]
    # two starts, 0.0100 and 0.0102: half an interval is 12.7062 x 0.0002 / sqrt(2) / sqrt(2)
    assert rows[3][1:3] == ["closed", "0.0101 (0.0088 to 0.0114)"]
    assert page.index("<img") < page.index("<table") and "trial" not in rest


def test_render__has_the_bound_of_the_machine_whose_plant_it_is_of():
    _, rows, _ = first_screen(render(0.1, "brokk170"))  # beside its shipped results
    assert len(rows) == 6 and rows[5][2] == "0.0098"


def test_render__sets_a_trial_beside_the_shipped_results(tmp_path, monkeypatch):
    monkeypatch.setattr(report, "SHIPPED", tmp_path)
    numbers, rows, rest = first_screen(render(0.1))  # of a machine without shipped results
    assert numbers[0] == "0.0303" and len(rows[0]) == 4 and "is of a trial" in rest
    (tmp_path / "digger <1>").mkdir()
    number = {"mean": 0.5, "low": 0.4, "high": 0.6}
    shipped = {c: dict.fromkeys(metrics.COLUMNS, number) for c in ERRORS}
    (tmp_path / "digger <1>" / "table.json").write_text(json.dumps({"table": shipped}))
    numbers, rows, rest = first_screen(render(0.1))
    assert numbers == 5 * ["0.5000"] and "is of a trial" in rest
    assert rows[3][2:] == [*2 * ["0.5000 (0.4000 to 0.6000)"], "0.0101 (0.0088 to 0.0114)"]
    assert first_screen(render(1.0))[0][0] == "0.0303"  # no trial: its own results


def test_render__has_each_sentence_of_the_paper_below_its_figure(page):
    assert page.count("<blockquote>") == len(TEXTS)
    places = dict(re.findall(r"<h2>(.*?)</h2>(.*?)(?=<h2>|</body>)", page, re.S))
    for figure in ("Fig. 2", "Fig. 5", "Fig. 6b-d", "Fig. 6e, f", "Fig. 6g, h"):
        (section,) = (text for title, text in places.items() if title.startswith(f"{figure}:"))
        wanted = [t["paper"] for t in TEXTS.values() if t["figure"].startswith(figure)]
        found = re.findall("&ldquo;(.*?)&rdquo; We measured", section)
        assert [html.unescape(quote) for quote in found] == wanted
        assert "<img" in section


def test_render__gives_leads_within_a_class(page):
    last = page.split("<h2>")[-1]
    heads = re.findall("<th>lead of (.*?) over (.*?)</th>", last)
    assert heads[2] == ("PPO, our interface", "strongest PID")
    leads = re.findall(r"<td>(-?\d\.\d\d)</td>", last)
    assert leads == ["0.25", "-0.50", "0.04"]  # 1 - 0.0303 / 0.0404, and so on


def test_render__escapes_names_and_loads_nothing(page):
    assert "digger &lt;1&gt;" in page
    text = re.sub('base64,[^"]*', "", page)
    assert not re.findall(r'(?:src|href)="(?!data:|#)', text) and "http" not in text


def test_write_report__draws_the_same_whatever_the_settings_of_the_owner(tmp_path, monkeypatch):
    def draw(*_):
        figure = Figure()
        figure.subplots().plot([0, 1])
        return figure

    for kind in ("errors", "tests", "gap", "starts", "joint_velocities", "sequence"):
        monkeypatch.setattr(f"brokk_min.evaluation.figures.plot_{kind}", draw)
    monkeypatch.setattr(report, "first_table", lambda _: defaultdict(lambda: defaultdict(float)))
    monkeypatch.setattr(report, "render", lambda _, images: images["gap"])
    start, pages = {"starts": [[0.0] * 5], "start_kinds": ["workspace"]}, []
    for settings in ({}, {"text.usetex": True, "axes.facecolor": "black", "savefig.dpi": 30}):
        with rc_context(settings):
            report.write_report(tmp_path, BROKK_170, start, ({}, None, {}))
        pages.append((tmp_path / "report.html").read_text())
    assert pages[0] == pages[1]
