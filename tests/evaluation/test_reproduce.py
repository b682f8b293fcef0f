"""The chain, small but whole: the same bits twice, every run with its numbers, one page."""

import collections
import html
import io
import json
import re
from dataclasses import asdict, replace

import numpy as np
import pytest
from helpers_cli import run

from brokk_min.evaluation import baselines, figures, learn, report, reproduce
from brokk_min.evaluation.baselines import GROUPS
from brokk_min.evaluation.claims import VERDICTS
from brokk_min.evaluation.learn import Budget
from brokk_min.evaluation.robustness import ROBUST, variations
from brokk_min.evaluation.sequences import task_sequences
from brokk_min.identification.files import SHIPPED
from brokk_min.identification.logs import read_log
from brokk_min.identification.net_file import load_net
from brokk_min.learning.policy import POLICIES, load_policy
from brokk_min.machine import BROKK_170

COARSE = replace(BROKK_170, rate=10.0, plant_dt=0.025)  # four Euler steps a tick: fast
TINY = Budget(0.004, 20, 4096, 20, 4096, 4096, 1, 1, 4, 2, 0.5)
ERROR = "velocity_error_mean"
PIDS = ["jacobian_pid_k0.1", "jacobian_pid_k0.05", "jacobian_pid_ff"]
PIDS += ["jacobian_pid_ff_integral", "jacobian_pid_ff_integral_dither"]
CONTROLLERS = ["rl", "rl_dither", "rl_paper", *PIDS]


def coarse_png(figure):
    """Drawn once, without a layout that needs a second time: fast."""
    figure.set_layout_engine("none")
    figure.set_dpi(20)
    figure.savefig(buffer := io.BytesIO(), format="png")
    return buffer.getvalue()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """What one run of the chain wrote, in one process."""
    out = tmp_path_factory.mktemp("a b") / "new"  # a space in the path
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(learn, "cpu_count", lambda: 1)
        patch.setattr(figures, "png", coarse_png)
        reproduce.reproduce(COARSE, out, TINY, 3)
    return out


@pytest.fixture(scope="module")
def results(folder):
    return json.loads((folder / "results.json").read_text())


@pytest.mark.parametrize("name", POLICIES)
def test_settings__made_the_shipped_policies(name):
    recorded = load_policy(SHIPPED / "brokk170" / POLICIES[name], BROKK_170).training
    task, learner = learn.settings(name, Budget())
    assert recorded["task"] | {"limit_cost": 0.0} == asdict(task)  # an option since then
    assert recorded["settings"] == asdict(learner) | {"critic": name == "rl_paper"}


def test_reproduce__gives_the_same_bits_twice(folder, tmp_path, monkeypatch, capsys):
    """The second time by its command, as `--quick`, with trainings and tunings side by side."""
    cores = iter([2])  # of fits, trainings and tunings
    monkeypatch.setattr(learn, "cpu_count", lambda: next(cores, 1))
    monkeypatch.setattr(learn, "QUICK", TINY)
    monkeypatch.setattr(report, "write_report", lambda *_: None)  # once is enough
    (tmp_path / "m.py").write_text(
        "from dataclasses import replace\nfrom brokk_min import BROKK_170\n"
        "COARSE = replace(BROKK_170, rate=10.0, plant_dt=0.025)\n"
    )
    assert (
        run(f"reproduce --quick --machine '{tmp_path}/m.py:COARSE' --seed 3 --out", tmp_path) == 0
    )
    for name in ("log.npz", "net.npz", "policy.npz", "gains.json", "results.json"):
        assert (folder / name).read_bytes() == (tmp_path / name).read_bytes(), name
    clock = json.loads((folder / "timing.json").read_text())
    stages = ["record", "fit net_paper", "first round", "train rl_paper", "fit net", "train rl"]
    stages += [*(f"tune {group[0]}" for group in GROUPS), "learn and tune"]
    scores = ["changed machines", "perfect_model", "perfect_model_closed"]
    stages += [f"score {name}" for name in scores]
    stages += ["score", "score for the regret", "score near singularities", "evaluate", "draw"]
    assert list(clock) == stages
    printed = capsys.readouterr().out
    assert printed.startswith("rl ") and printed.endswith(f"{tmp_path / 'results.json'}\n")


def test_reproduce__writes_files_that_the_other_commands_read(folder, results):
    log = read_log([folder / "log.npz"], BROKK_170.velocity_samples, rate=COARSE.rate)
    assert log.joints == load_net(folder / "net.npz").joints == BROKK_170.names
    policy = load_policy(folder / "policy.npz", COARSE)
    assert policy.training["command"] == "brokk-min reproduce --seed 3"
    means = results["task_space"]["summary"]
    errors = {controller: rows["all"][ERROR] for controller, rows in means.items()}
    assert policy.training["velocity_error_mean"] == errors
    pids = baselines.read_gains(folder / "gains.json", COARSE, policy.net)
    assert baselines.gains_table(pids) == results["gains"]
    assert results["meta"]["seed"] == 3 and results["meta"]["machine"] == "brokk170"
    assert results["meta"]["effort"]["train_steps"] == TINY.train_steps


def test_reproduce__results_hold_every_run_with_its_figures(results):
    runs = results["task_space"]["runs"]
    sequences = [sequence.name for sequence in task_sequences(BROKK_170)]
    keys = {(run["controller"], run["sequence"], run["start"]) for run in runs}
    assert keys == {(c, s, i) for c in CONTROLLERS for s in sequences for i in range(4)}
    assert all(
        run["velocity_rmse"] >= run[ERROR] > 0 and 0 < run["reward_mean"] < 1 for run in runs
    )
    assert results["start_kinds"] == ["workspace", "limits", "workspace", "extended"]
    assert all(run["kind"] == results["start_kinds"][run["start"]] for run in runs)
    scored = [run for run in runs if run["kind"] == "workspace" and run["controller"] == "rl"]
    mean = results["task_space"]["summary"]["rl"]["all"][ERROR]
    assert mean == pytest.approx(np.mean([run[ERROR] for run in scored]))
    assert set(results["paper_recipe"]["test"]) == set(results["actuator"]["test"])
    assert set(results["task_space"]["rl_on_nets"]) == {*"xyz", "all"}


def test_reproduce__results_answer_the_papers_sentences(results):
    assert len(results["net_claims"]) == 4
    assert [claim["figure"] for claim in results["claims"]] == [
        *["Fig. 6b-d"] * 3, *["Fig. 6a, e, f"] * 3, "Fig. 6e, f", "Fig. 6g, h", "Sec. 5"
    ]  # fmt: skip
    of_papers_learner = [dict(claim) for claim in results["claims"][3:6]]
    ours = [claim.pop("ours") for claim in of_papers_learner]
    assert results["singular"]["claims"] == {"rl": ours, "rl_paper": of_papers_learner}
    both = ["stronger" in claim for claim in results["claims"]]
    assert both == [False, True, True, False, False, False, True, True, True]
    less = results["task_space"]["rl_less"][ERROR]["jacobian_pid_ff"]
    for claim, sequences in zip(results["claims"][-3:], ("xyz", "z", ["all"]), strict=True):
        stronger = claim["ours"]["stronger"]
        numbers = stronger["numbers"]
        for s in sequences:
            assert numbers[f"error {s}, less jacobian_pid_ff"] == less[s]
        assert stronger["holds"] is all(n["high"] < 0 for n in numbers.values())


def test_reproduce__results_compare_with_the_bound_and_on_other_machines(results):
    less = results["regret"]["less_perfect_model"]
    assert set(less) == set(CONTROLLERS) and set(less["rl"]) == {*"xyz", "all"}
    means = results["regret"]["summary"]
    difference = means["rl"]["all"][ERROR] - means["perfect_model"]["all"][ERROR]
    assert less["rl"]["all"]["mean"] == pytest.approx(difference)
    assert "perfect_model_closed" in means
    assert set(results["robustness"]) == set(variations(BROKK_170))
    assert set(results["robustness"]["nominal"]) == set(ROBUST)


def test_reproduce__report_is_one_file_with_its_figures(folder, results):
    page = (folder / "report.html").read_text()
    assert len(re.findall(r'src="data:image/png;base64,iVBOR', page)) == 18
    text = re.sub(r'base64,[^"]*', "", page)  # letters of an image may spell anything
    assert not re.findall(r'(?:src|href)="(?!data:|#)', text) and "http" not in text
    places = re.findall(r'<h2 id="(.*?)"', text)
    assert set(re.findall(r'href="#(.*?)"', text)) == set(places) and len(set(places)) == len(
        places
    )
    for claim in (*results["net_claims"], *results["claims"]):
        assert html.escape(claim["measured"], quote=False) in text.replace("&#39;", "'")
    assert text.count("<table") == text.count("<thead>") and text.count("<details>") == 4
    assert text.count("<td>start ") == 4 and text.count("<td>tuning run ") == TINY.tuning_runs


def page_sections(page):
    """What stands before the first section, and sections of a page by their titles."""
    page = page.replace("<body>", "<h2>First</h2>", 1)
    return dict(re.findall(r"<h2[^>]*>(.*?)</h2>(.*?)(?=<h2|</body>)", page, re.S))


def test_render__answers_the_papers_sentences_first(folder, results):
    sections = page_sections((folder / "report.html").read_text())
    first = sections.pop("First")
    for title, text in sections.items():
        if "(Fig." in title:  # each figure of the paper stands with its sentences
            assert "<img" in text and ("<blockquote>" in text or "6a)" in title), title
    for key in ("rl", "rl_paper", "jacobian_pid_k0.1"):
        error = results["task_space"]["summary"][key]["all"][ERROR]
        assert f"{error:.4f}" in first.partition("</b>")[0]
    rows = re.findall(r"<tr>(.*?)</tr>", first, re.S)
    heads, *answers = [re.findall(r"<t[dh][^>]*>(.*?)</t[dh]>", row, re.S) for row in rows]
    claims = [*results["net_claims"], *results["claims"]]
    assert len(answers) == len(claims) + 1  # and the time of the training
    for claim, (figure, sentence, _, verdict, ours) in zip(claims, answers[:-1], strict=True):
        assert re.sub("<.*?>", "", figure) == claim["figure"]
        assert html.unescape(sentence) == claim["paper"]
        assert verdict.partition("<br>")[0] == VERDICTS[claim["holds"]]
        expected = VERDICTS[claim["ours"]["holds"]] if "ours" in claim else ""
        assert ours.partition("<br>")[0] == expected
    held = sum(claim["holds"] is True for claim in claims)
    assert re.search(rf"\(({held}|{held + 1}) of {len(answers)} hold\)", heads[3])
    held = sum(claim["ours"]["holds"] is True for claim in results["claims"])
    assert f"({held} of {len(results['claims'])} hold)" in heads[4]


def test_render__escapes_names_and_shows_training_seeds(results):
    row = {"velocity_error_x": {"mean": 0.5, "low": 0.25, "high": 0.75}}
    meta = results["meta"] | {"machine": "digger <1>"}
    changed = results | {"meta": meta, "training_seeds": {"rl": row}}
    images = collections.defaultdict(lambda: "QUJD")
    page = report.render(COARSE, changed, images, {"train rl_paper": 3600.0})
    assert "digger &lt;1&gt;) is an analytic plant, not a real machine" in page
    assert "0.5000 (0.2500 to 0.7500)" in page_sections(page)["Training seeds"]


def test_net_errors__of_the_papers_nets_are_in_the_results(folder, results):
    """They were fitted to the paper's sines, plain commands and errors of one step."""
    net = load_net(folder / "net_paper.npz")
    assert (net.dead_zone, net.settings["rollout"], net.settings["noise"]) == (0.0, 1, 0.0)
    test = read_log([folder / "log_test.npz"], BROKK_170.velocity_samples, rate=COARSE.rate)
    assert reproduce.net_errors(COARSE, net, test, 3) == results["paper_recipe"]
