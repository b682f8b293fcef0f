"""The family: the chain on a member, once; what it is judged by, by hand."""

import json
from dataclasses import replace

import numpy as np
import pytest

from brokk_min.evaluation import family, learn, sequences
from brokk_min.evaluation.family import run_family, show, summary
from brokk_min.evaluation.learn import Budget
from brokk_min.machine import BROKK_170

COARSE = replace(BROKK_170, rate=10.0, plant_dt=0.025)  # four Euler steps a tick: fast
TINY = Budget(0.01, 20, 2048, 20, 2048, 2048, 1, 1, 4, 2, 3.0)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("family")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(learn, "cpu_count", lambda: 1)  # one process: fast
        short = sequences.shorten(COARSE, sequences.task_sequences(COARSE), 4.0)
        patch.setattr(sequences, "task_sequences", lambda machine: short)
        return folder, run_family(COARSE, [2], folder, TINY)


def test_run_family__has_each_member_and_each_policy_on_each(made):
    folder, results = made
    assert json.loads((folder / "family.json").read_text()) == json.loads(json.dumps(results))
    assert [row["seed"] for row in results["members"]] == [2]
    for i, row in enumerate(results["members"]):
        for policy, ending in (("rl", ""), ("rl_dither", "_dither")):
            best = row["best"][policy]
            pids = [name for name in row["error"] if name.startswith("jacobian")]
            own = [name for name in pids if name.endswith("_dither") == bool(ending)]
            assert row["error"][best] == min(row["error"][name] for name in own)
        assert set(row["free_run"]) == {"q1", "q3", "q4", "q5"}
        assert row["dither"] in family.DITHERS
        assert results["transfers"][i][i] == pytest.approx(row["error"]["rl"])
        files = {path.name for path in (folder / f"member_{row['seed']}").iterdir()}
        assert {"log.npz", "net.npz", "policy.npz", "gains.json", "member.json"} <= files
    text = show(results)
    assert "rl_dither to_best: median" in text
    assert text.count("\n") == 1 + 2 + 8 + 1


def test_known_machine__has_the_plants_dead_zones_by_its_ramps_alone():
    """Hysteresis of 0.02, so zones come late by up to that."""
    machine = family.known_machine(BROKK_170, 5)
    late = machine.dead_zones - np.array(machine.plant.dead_zones)
    assert np.abs(late).max() < 0.02
    assert machine.largest_dead_zone == pytest.approx(machine.dead_zones.max() + 0.05)
    assert machine.dead_zone == machine.dead_zones.min()


def test_run_member__is_not_run_again_and_refuses_another_budget(made):
    folder, results = made
    file = folder / "member_2" / "member.json"
    before = file.stat().st_mtime_ns
    row = family.run_member(COARSE, 2, folder / "member_2", TINY)
    assert row == json.loads(json.dumps(results["members"][0]))
    assert file.stat().st_mtime_ns == before
    with pytest.raises(ValueError, match=r"member.json: budget.starts: expected 3, got 4"):
        family.run_member(COARSE, 2, folder / "member_2", replace(TINY, starts=3))


def test_summary__by_hand():
    row = {
        "error": {"rl": 0.03, "rl_dither": 0.02, "pid": 0.05, "awake": 0.04},
        "best": {"rl": "pid", "rl_dither": "awake"},
        "on_nets": {"rl": 0.02, "rl_dither": 0.02},
        "loaded": {"rl": 0.036, "rl_dither": 0.02},
        "free_run": {"a": 0.1, "b": 0.3},
    }
    other = row | {"on_nets": {"rl": 0.03, "rl_dither": 0.02}}
    found = summary([row, other])
    assert found["rl"]["to_nets"] == {"median": 1.25, "worst": 1.5}
    assert found["rl"]["to_best"]["worst"] == pytest.approx(0.6)
    assert found["rl"]["payload"]["median"] == pytest.approx(1.2)
    assert found["rl_dither"]["to_best"]["worst"] == pytest.approx(0.5)
    assert found["rl"]["free_run"]["worst"] == 0.3
