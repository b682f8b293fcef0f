"""The page says in its first sentence what was measured, and has each sentence of the paper."""

import html
import re
from collections import defaultdict

import numpy as np
import pytest

from brokk_min.evaluation import metrics, report
from brokk_min.evaluation.claims import TEXTS, net_claims, task_claims

ERRORS = {"rl": 0.0101, "rl_paper": 0.0303, "pid_by_hand": 0.0404, "jacobian_pid_k0.1": 0.0202}
ERRORS |= {"pid_by_hand_raw": 0.0505, "jacobian_pid_ff_integral": 0.0105}
RNG = np.random.default_rng(0)


def run(controller, sequence, start):
    figures = {key: 10 * ERRORS[controller] + RNG.normal(0, 1e-5) for key in report.COLUMNS}
    figures["velocity_error_mean"] = ERRORS[controller] + (start - 0.5) * 2e-4
    labels = zip(metrics.LABELS, (controller, sequence, start, "workspace"), strict=True)
    return dict(labels) | figures


@pytest.fixture(scope="module")
def results():
    """As `reproduce` has them, of made-up runs from two starts."""
    runs = [run(c, s, start) for c in ERRORS for s in "xyz" for start in (0, 1)]
    one = {"one_step_rmse": 0.01, "free_run": {"10": {"velocity_rmse": 0.0234}}}
    recipe = {"q1": one, "q5": {"one_step_rmse": 0.02, "free_run": {}}}
    peaks = {name: {"nets_peak": peak} for name, peak in zip("abc", (0.1, 0.24, 0.45))}
    gap = {"tool": {"position_error_mean": 0.02}}
    gap["tool_position_error_mean_of_runs"] = {"median": 0.03}
    times = {"idle": 0.4, "moving": 0.1}
    numbers = {"sweep": peaks, "joint": "q5", "response_time": {"nets": times}}
    claims = [*net_claims(numbers | {"sim_to_real": gap}), *task_claims(runs)]
    return {
        "meta": {"machine": "digger <1>", "seed": 3, "effort": {"hours": 0.1}},
        "nets": {"net": recipe, "net_paper": recipe},
        "task_space": {"means": metrics.means(runs)},
        "robustness": {"nominal": {"rl": {"mean": 0.01, "low": 0.009, "high": 0.012}}},
        "leads": {"nominal": {"rl over another": 0.25}},
        "claims": [claim.to_json() for claim in claims],
        "start_kinds": ["workspace", "limits", "workspace"],
    }


@pytest.fixture(scope="module")
def page(results):
    return report.render(results, defaultdict(lambda: "QUJD"), 12.4)


def test_render__begins_with_one_sentence_and_a_table(page):
    first = page.split("<h2>")[0]
    sentence, _, rest = first.partition("<table")
    numbers = re.findall(r"[\d.]+ m/s", sentence.split("<p>")[1])
    assert numbers == [f"{n} m/s" for n in ("0.0303", "0.0404", "0.0202", "0.0101", "0.0105")]
    rows = re.findall(r"<tr><td>(.*?)</td><td>(.*?)</td><td>(.*?)</td>", rest)
    assert len(rows) == len(ERRORS) and first.count("<table>") == 1
    # two starts, 0.0100 and 0.0102: half an interval is 12.7062 x 0.0002 / sqrt(2) / sqrt(2)
    assert rows[0][1:] == ("closed", "0.0101 (0.0088 to 0.0114)")
    assert "over 2 start poses" in rest and "12 minutes on a small budget" in rest


def test_render__has_each_sentence_of_the_paper_below_its_figure(page):
    assert page.count("<blockquote>") == len(TEXTS)
    places = dict(re.findall(r"<h2>(.*?)</h2>(.*?)(?=<h2>|</body>)", page, re.S))
    for figure in ("Fig. 2", "Fig. 5", "Fig. 6b-d", "Fig. 6e, f", "Fig. 6g, h"):
        (section,) = (text for title, text in places.items() if title.startswith(f"{figure}:"))
        wanted = [t["paper"] for t in TEXTS.values() if t["figure"].startswith(figure)]
        found = re.findall("&ldquo;(.*?)&rdquo; We measured", section)
        assert [html.unescape(quote) for quote in found] == wanted
        assert "<img" in section


def test_render__escapes_names_and_loads_nothing(page):
    assert "digger &lt;1&gt;" in page
    text = re.sub('base64,[^"]*', "", page)
    assert not re.findall(r'(?:src|href)="(?!data:|#)', text) and "http" not in text
