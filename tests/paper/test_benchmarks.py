"""The benchmarks run: every adapter trains, every figure is a number. What they measure is not judged."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks import deviations, limits, peers
from brokk_min import observation
from brokk_min.evaluation import metrics


@pytest.mark.parametrize("learner", list(peers.LEARNERS))
def test_each_learner_trains_on_the_environment(learner: str, tmp_path: Path) -> None:
    if learner == "rl_games" and not importlib.util.find_spec("rl_games"):
        pytest.skip("rl_games is not installed")
    options = peers.Options(
        quick=True, learners=(learner,), target=9.0, threads=1, json=tmp_path / "p.json"
    )
    (row,) = peers.main(options)["runs"]
    assert row["learner"] == learner and row["updates"] == 2
    assert 0.3 < row["best"] < 1 and row["trained_s"] > 0 and row["seconds"] is None
    assert json.loads((tmp_path / "p.json").read_text())["runs"] == [row]


def test_settings_are_chosen_with_the_first_seed_and_judged_by_the_median(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    times = {
        (1e-3, 0): 9.0,
        (1e-3, 1): 4.0,
        (1e-3, 2): 5.0,
        (1e-2, 0): 8.0,
        (1e-2, 1): 7.0,
        (1e-2, 2): 30.0,
    }
    run: list[tuple[str, float, int]] = []

    def race(
        name: str, net: object, setting: peers.Setting, seed: int, *_: object
    ) -> dict[str, object]:
        rate, planned = setting
        seconds = times[rate, seed] if name == "ours" else None
        run.append((name, rate, seed))
        row = {"learner": name, "learning_rate": rate, "planned": planned, "seed": seed}
        return row | {"seconds": seconds, "best": 0.8 - rate}

    monkeypatch.setattr(peers, "race", race)
    options = peers.Options(
        learners=("ours", "sb3"), learning_rates=(1e-3, 1e-2), planned=(100,), target=0.9
    )
    found = peers.main(options)
    assert found["chosen"] == {"ours": (1e-2, 100), "sb3": (1e-3, 100)}
    assert found["median_s"] == {"ours": 8.0, "sb3": None}
    assert run[:4] == [("ours", 1e-3, 0), ("sb3", 1e-3, 0), ("ours", 1e-2, 0), ("sb3", 1e-2, 0)]
    assert sorted(run[4:]) == [
        (n, r, seed) for n, r in (("ours", 1e-2), ("sb3", 1e-3)) for seed in (1, 2)
    ]


def test_limits_are_measured(tmp_path: Path) -> None:
    found = limits.main(
        limits.Options(quick=True, threads=1, num_envs=(4, 8), json=tmp_path / "l.json")
    )
    assert list(found["environment"]) == ["4", "8"]
    assert all(row["step_over_products"] > 0 for row in found["environment"].values())
    assert found["update"]["share_of_best"] > 0
    assert found["update"]["gflops"]["products_numpy"] > 0
    assert found["kinematics"]["us_per_configuration"] > 0
    assert json.loads((tmp_path / "l.json").read_text())["update"] == found["update"]


def test_the_products_of_a_gradient_by_hand() -> None:
    """171-256-128-64-4: forward and by weight everywhere, by input from the second layer on."""
    sizes = limits.shapes(171, (4, 1), 10)
    actor, critic = (171 * 256 + 256 * 128 + 128 * 64 + 64 * last for last in (4, 1))
    for outputs, both in (((4,), actor), ((4, 1), actor + critic)):
        work = sum(m * k * n for m, k, n in limits.shapes(171, outputs, 10))
        assert work == 10 * (3 * both - len(outputs) * 171 * 256)
    seen = limits.products("numpy", sizes)()
    for kind in ("torch", "onednn"):
        try:
            others = limits.products(kind, sizes)()
        except (AttributeError, RuntimeError):
            pytest.skip(f"no {kind}")
        for a, b in zip(seen, others, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-2)


def test_deviations_train_and_compare_what_they_name(monkeypatch: pytest.MonkeyPatch) -> None:
    """One update of the learner; what its policy does is not judged. The heading is back afterwards."""
    seen, turn = [], observation._turn

    def runs(
        machine: object,
        controllers: object,
        sequences: list[object],
        starts: np.ndarray,
        *_: object,
    ):
        seen.append((len(sequences), len(starts), observation._turn is turn))
        return [{"velocity_error_mean": 0.1, "off_axis_drift_max": 0.02, "valve_travel": 20.0}], {}

    monkeypatch.setattr(deviations, "STEPS", 256 * 32)
    monkeypatch.setattr(metrics, "evaluate", runs)
    monkeypatch.setattr(deviations, "as_it_is", dict)
    found = deviations.a5()
    assert found["base frame, plant, valve_travel"] == 20.0 and len(found) == 6
    assert seen == [(3, 32, False)] * 2 and observation._turn is turn
