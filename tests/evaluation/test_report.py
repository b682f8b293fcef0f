"""The page says in its first sentence and table what was measured, and of which machine."""

import re
from collections import defaultdict

from brokk_min._files import SHIPPED, read_json
from brokk_min.evaluation import metrics, report

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
