"""The chain, small but whole: the same bits twice, every run with its numbers, one page."""

import json
import re
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from helpers_cli import run
from helpers_machines import POSE, Idle, coarse, obedient_net, one_by_one, pids, short_axes

from brokk_min._files import digest
from brokk_min.actuator import cylinder_speeds, hydraulics_of
from brokk_min.evaluation import adaptive, baselines, metrics, report, reproduce, sequences
from brokk_min.evaluation.baselines import STRONGEST
from brokk_min.evaluation.claims import TEXTS
from brokk_min.evaluation.reproduce import Budget, robustness, variations
from brokk_min.evaluation.rollout import TITLES
from brokk_min.evaluation.sequences import read_starts, task_sequences
from brokk_min.identification.fitting import OurFitConfig, fit_nets
from brokk_min.identification.logs import read_log
from brokk_min.identification.net_file import fingerprint, load_net
from brokk_min.learning.jobs import side_by_side
from brokk_min.learning.policy import load_policy
from brokk_min.machine import BROKK_170

COARSE = coarse(replace(BROKK_170, rate=10.0), 0.025)  # four Euler steps a tick: fast
TINY = Budget(0.004, 20, 8192, (1, 1, 2.5), 2, 2.5)
ERROR = "velocity_error_mean"
PNG = report.png


def coarse_png(figure):
    """Drawn once, without a layout that needs a second time: fast."""
    figure.set_layout_engine("none")
    figure.set_dpi(20)
    return PNG(figure)


@pytest.fixture(scope="module", autouse=True)
def short_robustness():
    """Few drives warm up, starts are of few poses, and the machine of robustness is the usual."""

    def nominal(*task):
        return {"nominal": robustness(*task)["nominal"]}

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(adaptive, "DRIVES", 2)
        patch.setattr(adaptive, "PARTS", 1)
        patch.setattr(sequences, "STARTS_OF", 400)
        patch.setattr(reproduce, "robustness", nominal)
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """What one run of the chain wrote, in one process."""
    out = tmp_path_factory.mktemp("a b") / "new"  # a space in the path
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reproduce, "side_by_side", one_by_one)
        patch.setattr(report, "png", coarse_png)
        reproduce.reproduce(COARSE, out, TINY, 3)
    return out


@pytest.fixture(scope="module")
def results(folder):
    return json.loads((folder / "results.json").read_text())


def test_reproduce__gives_the_same_results_twice(folder, tmp_path, monkeypatch, capsys):
    """The second time by its command, as `--quick`; it learns in several processes."""

    def learning_alone(calls, needs=None):
        return side_by_side(calls, needs) if needs else one_by_one(calls)

    monkeypatch.setattr(reproduce, "side_by_side", learning_alone)
    monkeypatch.setattr(reproduce, "QUICK", TINY)
    monkeypatch.setattr(report, "write_report", lambda *_: None)  # once is enough
    monkeypatch.delenv("COVERAGE_PROCESS_CONFIG", raising=False)  # the first time counts
    (tmp_path / "m.py").write_text(
        "from dataclasses import replace\nfrom brokk_min.actuator import hydraulics_of\n"
        "from brokk_min.machine import BROKK_170\n"
        "h = replace(hydraulics_of(BROKK_170), dt=0.025)\n"
        "COARSE = replace(BROKK_170, rate=10.0, hydraulics=h)\n"
    )
    out = tmp_path / "results"
    assert run(f"reproduce --quick --machine '{tmp_path}/m.py:COARSE' --seed 3 --out", out) == 0
    names = "log.npz net.npz policy.npz gains.json starts.csv results.json table.json"
    for name in names.split():
        assert (folder / name).read_bytes() == (out / name).read_bytes(), name
    assert capsys.readouterr().out.endswith(f"{out / 'results.json'}\n")


def test_reproduce__writes_files_that_the_other_commands_read(folder, results):
    log = read_log(folder / "log.npz", COARSE)
    assert log.joints == load_net(folder / "net.npz").joints == BROKK_170.names
    policies = {
        name: load_policy(folder / file, COARSE) for name, file in reproduce.POLICIES.items()
    }
    interfaces = {name: "beyond" if name == "rl" else "paper" for name in policies}
    assert {name: policy.interface for name, policy in policies.items()} == interfaces
    config = OurFitConfig(TINY.fit_steps)  # the members one after the other
    in_turn = fit_nets(log, config, 3, COARSE, COARSE.name)
    assert fingerprint(load_net(folder / "net.npz")) == fingerprint(in_turn)
    assert load_net(folder / "net.npz").training == in_turn.training
    learned_on = {name: fingerprint(policy.net) for name, policy in policies.items()}
    ours, printed = (load_net(folder / f"{name}.npz", COARSE) for name in ("net", "net_paper"))
    assert learned_on.pop("rl_critic") == fingerprint(printed) != fingerprint(ours)
    assert {*learned_on.values()} == {fingerprint(ours)}
    scored = {file: digest(folder / file) for file in (*reproduce.POLICIES.values(), "gains.json")}
    assert results["meta"]["files"] == scored
    np.testing.assert_array_equal(read_starts(folder / "starts.csv", COARSE), results["starts"])
    assert baselines.read_gains(folder / "gains.json", COARSE, policies["rl"].net)
    assert results["meta"]["seed"] == 3 and results["meta"]["machine"] == "brokk170"
    assert results["meta"]["effort"]["train_steps"] == TINY.train_steps


def test_reproduce__results_hold_every_run_and_a_verdict_on_each_sentence(folder, results):
    runs = results["task_space"]["runs"]
    names = [sequence.name for sequence in task_sequences(BROKK_170)]
    keys = [(run["controller"], run["sequence"], run["start"]) for run in runs]
    assert sorted(keys) == sorted(product([*TITLES.keys() - {"rl_critic_nets"}], names, range(2)))
    of_rl = {name: metrics.by_start(runs, "rl", name, ERROR) for name in ("x", "y", "z", "all")}
    mean = results["task_space"]["means"]["rl"]["all"][ERROR]["mean"]
    assert mean == pytest.approx(np.mean(of_rl.pop("all")))
    assert results["table"]["rl"][ERROR]["mean"] == pytest.approx(np.mean([*of_rl.values()]))
    pairs = {(pair["policy"], pair["pid"]): pair["figures"] for pair in results["pairs"]}
    assert list(pairs) == list(reproduce.PAIRS)
    assert list(pairs["rl", STRONGEST][ERROR]) == [*names, "all"]
    assert pairs["rl", STRONGEST][ERROR]["z"] == metrics.compare(runs, "rl", STRONGEST, ERROR)["z"]
    table = json.loads((folder / "table.json").read_text())
    assert table == {key: results[key] for key in ("meta", "table", "pairs", "claims")}
    sentences = [claim["paper"] for claim in results["claims"]]
    assert sentences == [text["paper"] for text in TEXTS.values()]
    page = (folder / "report.html").read_text()
    assert page.count("<blockquote>") == len(TEXTS)
    assert len(re.findall(r'src="data:image/png;base64,iVBOR', page)) == 8


@pytest.mark.parametrize("name", ["draw_starts", "tuning_set"])
def test_reproduce__says_that_the_arm_cannot_follow_before_the_work(name, tmp_path, monkeypatch):
    def few(*_):
        raise ValueError("expected 2 starts")

    monkeypatch.setattr(sequences, "draw_starts", lambda *_: np.zeros((2, 5)))
    monkeypatch.setattr(sequences, name, few)
    monkeypatch.setattr(reproduce, "record_log", pytest.fail)
    with pytest.raises(ValueError, match="expected 2 starts"):
        reproduce.reproduce(COARSE, tmp_path, TINY, 0)


def test_variations__change_what_they_say():
    result, speeds = variations(BROKK_170), cylinder_speeds(BROKK_170)
    assert len(result) == 8 and result["nominal"] is BROKK_170
    assert hydraulics_of(result["supply flow -70 %"]).pump_flow == pytest.approx(0.000315)
    assert hydraulics_of(result["delay +50 ms"]).delay == pytest.approx(0.09)
    gains = {"valve gain -20 %": 0.8, "valve gain +20 %": 1.2, "up -15 %, down +15 %": [0.85, 1.15]}
    for name, gain in gains.items():
        np.testing.assert_allclose(cylinder_speeds(result[name]), speeds * gain)
    for name, zone in {"dead zone 5 %": 0.05, "dead zone 10 %": 0.1}.items():
        np.testing.assert_allclose(result[name].dead_zones, np.full((5, 2), zone))


def test_robustness__has_a_row_for_each_variation_and_controller():
    net = obedient_net(BROKK_170)
    pid = pids(BROKK_170, net)["jacobian_pid_ff_integral"]
    task = {"idle": Idle(), "pid": pid}, short_axes(20, 2)[2:], np.tile(POSE, (2, 1)), 0
    drives = robustness(BROKK_170, task[0], net, *task[1:])
    table = reproduce.mean_errors({case: drive() for case, drive in drives.items()})
    kinds = [f"{name}{start}" for start in ("", "+cold", "+warm") for name in ("idle", "pid")]
    assert sorted(table["nominal"]) == sorted(kinds)
    further = ["goals +50 %", "no sensor noise", "twice the sensor noise"]
    assert list(table) == [*variations(BROKK_170), *further]
    for name, noise in zip(further[1:], (0.0, 0.1), strict=True):
        noisy, _ = metrics.evaluate(BROKK_170, *task, noise=noise)
        assert table[name]["pid"] == metrics.means(noisy)["pid"]["all"][ERROR]
    runs, _ = metrics.evaluate(variations(BROKK_170)["delay +50 ms"], *task)
    error = metrics.by_start(runs, "pid", "all", ERROR)
    assert table["delay +50 ms"]["pid"] == metrics.mean_interval(error)
    errors = {name: row["pid"]["mean"] for name, row in table.items()}
    assert errors["nominal"] < min(errors["delay +50 ms"], errors["dead zone 10 %"])
    assert table["delay +50 ms"]["idle"] == table["nominal"]["idle"]
    faster = 1.5 * table["nominal"]["idle"]["mean"]
    assert table["goals +50 %"]["idle"]["mean"] == pytest.approx(faster)
