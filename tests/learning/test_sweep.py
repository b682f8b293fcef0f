"""Sweeps: the same policies as `train`, nothing done twice, dead workers, intervals, a cluster."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import Stand
from helpers_machines import small_net
from helpers_sweep import die_until, refuse

from brokk_min.__main__ import main
from brokk_min.env import TaskConfig
from brokk_min.evaluation import baselines, metrics
from brokk_min.evaluation.metrics import mean_interval
from brokk_min.evaluation.sequences import Commands, axis_sequences
from brokk_min.identification.net_file import save_net
from brokk_min.learning import sweep as module
from brokk_min.learning.policy import PolicyController
from brokk_min.learning.sweep import apart, one_seed, sweep, workers
from brokk_min.machine import BROKK_170, Machine
from brokk_min.ppo import PPOConfig, train

TINY = PPOConfig(num_envs=4, horizon=4, epochs=1, minibatch_size=16, total_steps=32, threads=1)
TASK = TaskConfig(episode_s=0.6)
NET = small_net(BROKK_170, np.random.default_rng(0))


@pytest.fixture(autouse=True)
def short(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Sequences of half a second from poses that need no search, and environment variables put back."""
    monkeypatch.setattr(module.os, "environ", dict(module.os.environ))
    if "slow" not in request.keywords:
        pose = np.array([1.5, 0.5, 0.58, 1.71, 1.24])
        monkeypatch.setattr(
            module,
            "evaluation_starts",
            lambda m, num, s, seed: pose + 0.1 * np.random.default_rng(seed).random((num, 5)),
        )
        monkeypatch.setattr(
            module, "task_sequences", lambda m: [s._replace(goals=s.goals[15:25]) for s in full(m)]
        )


def full(machine: Machine) -> list[Commands]:
    return axis_sequences(machine)


def here(function: Callable[..., object], *arguments: object) -> object:
    """`apart` without the process: what is patched stays so."""
    return function(*arguments)


def seed_rows(error: float) -> list[dict[str, object]]:
    """What `one_seed` returns, made up: three sequences, three starts of which two count."""
    figures = {"velocity_rmse": 1.0, "off_axis_drift_max": 2.0 * error, "valve_travel": 10.0}
    return [
        {"controller": "rl", "sequence": s, "start": i, "kind": kind, "velocity_error_mean": e}
        | figures
        for s in "xyz"
        for i, (kind, e) in enumerate(
            (("workspace", error), ("limits", 99.0), ("workspace", error + 1))
        )
    ]


def test_the_interval_holds_the_truth_in_95_of_100_sweeps() -> None:
    draws = np.random.default_rng(0).normal(2.0, 1.0, (2000, 5))
    held = [n["low"] < 2.0 < n["high"] for n in map(mean_interval, draws)]
    assert 0.93 < np.mean(held) < 0.97


def test_a_seed_counts_once_in_the_table() -> None:
    beside = [row | {"controller": "pid"} for row in seed_rows(5.0)]
    figures = module.table([seed_rows(1.0), seed_rows(3.0)], beside)
    assert list(figures) == ["rl", "pid", "rl less pid"]
    for name in ("velocity_error_x", "velocity_error_all"):
        # two seeds, 1.5 and 3.5: half of 12.7062 x sqrt(2) / sqrt(2) x 2
        assert figures["rl"][name] == pytest.approx(
            {"mean": 2.5, "low": -10.2062, "high": 15.2062}, abs=1e-4
        )
        assert figures["pid"][name] == {"mean": 5.5, "low": None, "high": None}
        assert figures["rl less pid"][name]["mean"] == -3.0
        assert figures["rl less pid"][name]["high"] == pytest.approx(12.7062 - 3.0, abs=1e-4)
    assert figures["rl"]["off_axis_drift_max"]["mean"] == 4.0
    lines = module.show(figures).splitlines()
    assert lines[1].startswith("rl ") and "2.5000 +- 12.7062" in lines[1]
    columns = "x [m/s]", "y [m/s]", "z [m/s]", "all [m/s]", "drift [m]", "travel [1]"
    assert lines[0] == f"{'mean and 95 % interval':28}" + "".join(
        f" {name:>18}" for name in columns
    )
    pid = (
        "5.5000",
        "5.5000",
        "5.5000",
        "5.5000",
        "10.0000",
        "10.0000",
    )  # alone, so without an interval
    assert lines[2] == f"{'pid':28}" + "".join(f" {text:>18}" for text in pid)
    assert "-3.0000 +- 12.7062" in lines[3]
    assert list(module.table([], beside)) == ["pid"]


def test_a_table_is_read_for_the_report_and_other_files_are_not(tmp_path: Path) -> None:
    path = tmp_path / "sweep.json"
    figures = module.table([seed_rows(1.0), seed_rows(3.0)], [])
    about = baselines.gains_metadata(BROKK_170, NET)
    path.write_text(json.dumps({"meta": about, "table": figures}))
    assert module.seeds_of(BROKK_170, NET, module.read_seeds(path)) == figures
    other = replace(NET, output_high=2 * NET.output_high)
    with pytest.raises(ValueError, match=rf"sweep: expected one with .*got .*{about['actuator']}"):
        module.seeds_of(BROKK_170, other, module.read_seeds(path))
    without = json.dumps({"table": figures})
    for text in (
        "{",
        "[]",
        without,
        '{"meta": {}, "table": {"rl": {"velocity_error_all": {"mean": 1}}}}',
    ):
        path.write_text(text)
        with pytest.raises(
            ValueError, match=r"sweep\.json: expected the sweep\.json of a sweep, got "
        ):
            module.read_seeds(path)


def test_a_worker_that_dies_costs_one_retry(tmp_path: Path) -> None:
    assert apart(die_until, tmp_path / "once", 1) == 2
    with pytest.raises(ValueError, match="worker: expected it to live, got one that died twice"):
        apart(die_until, tmp_path / "always", 9)
    assert (tmp_path / "always").read_text() == "2"


def test_a_seed_that_fails_costs_itself_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Seed 1 cannot be trained; 0 and 2 are written, and what is said names 1."""
    original = module.one_seed

    def sometimes(*arguments: object) -> object:
        return refuse("losses/policy_loss: nan") if arguments[4] == 1 else original(*arguments)

    monkeypatch.setattr(module, "one_seed", sometimes)
    monkeypatch.setattr(module, "apart", here)
    monkeypatch.setattr(module.os, "cpu_count", lambda: 1)
    with pytest.raises(ValueError, match=r"^seed 1: losses/policy_loss: nan$"):
        sweep(BROKK_170, NET, TASK, TINY, range(3), tmp_path, 1)
    written = json.loads((tmp_path / "sweep.json").read_text())
    assert written["meta"]["failed"] == {"1": "losses/policy_loss: nan"}
    assert {row["seed"] for row in written["runs"]} == {0, 2}


def test_a_sweep_from_the_command_line_and_once_more(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "apart", here)
    monkeypatch.setattr(module.os, "cpu_count", lambda: 1)  # torch's seed is one for all threads
    save_net(tmp_path / "net.npz", NET)
    settings = {"num-envs": 4, "horizon": 4, "epochs": 1, "minibatch-size": 16, "total-steps": 32}
    pairs = [text for name, value in settings.items() for text in (f"--{name}", str(value))]
    command = [
        "sweep",
        "--actuator",
        f"{tmp_path}/net.npz",
        "--out",
        f"{tmp_path}/sweep",
        "--seed",
        "3",
    ]
    command += ["--seeds", "2", "--poses", "2", "--episode-s", "0.6", *pairs]
    assert main(command) == 0
    first = capsys.readouterr().out
    assert first.splitlines()[1].startswith("rl ") and first.count("+-") == 6
    files = sorted(p.name for p in (tmp_path / "sweep").iterdir())
    seeds = [f"seed_{n}.{end}" for n in (3, 4) for end in ("json", "npz", "npz.csv")]
    assert files == [*seeds, "sweep.json"]
    train(BROKK_170, NET, TASK, TINY, 4, tmp_path / "alone.npz")
    assert (tmp_path / "sweep/seed_4.npz").read_bytes() == (tmp_path / "alone.npz").read_bytes()
    written = json.loads((tmp_path / "sweep/sweep.json").read_text())
    assert len(written["runs"]) == 2 * 3 * 2 and written["table"]["rl"]["valve_travel"]["mean"] > 0

    def never(*_: object) -> None:
        raise AssertionError("trained or driven again")

    monkeypatch.setattr(module, "train", never)
    with monkeypatch.context() as patch:
        patch.setattr(
            module,
            "_on_the_machine",
            lambda machine, controllers, _: never() if controllers else [],
        )
        assert main(command) == 0
    assert capsys.readouterr().out == first
    assert main([*command, "--horizon", "8"]) == 1
    assert "seed_3.json: settings: expected {" in capsys.readouterr().err


def test_a_policy_without_its_figures_is_driven_and_not_trained_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    arguments = (BROKK_170, NET, TASK, TINY, 0, tmp_path, 1)
    runs = one_seed(*arguments)
    (tmp_path / "seed_0.json").unlink()
    monkeypatch.setattr(module, "train", None)
    assert one_seed(*arguments) == runs
    (tmp_path / "seed_0.json").write_text("{")
    with pytest.raises(
        ValueError, match=r"seed_0\.json: expected the result of a seed, got JSONDec"
    ):
        one_seed(*arguments)


def test_a_seed_goes_on_where_it_was_left_and_its_file_says_what_it_is(
    stand: Stand, tmp_path: Path
) -> None:
    trained, sequences = SimpleNamespace(), [SimpleNamespace(name="x")]
    calls = stand(module, train=trained, identity_of={"nets": "n"}, task_sequences=sequences)
    stand(module, evaluation_starts="poses")
    stand(metrics, evaluate=(["run"], {}))
    arguments = (BROKK_170, NET, TASK, TINY, 3, tmp_path, 5)
    assert one_seed(*arguments) == ["run"]
    assert calls["train"] == (BROKK_170, NET, TASK, TINY, 3, tmp_path / "seed_3.npz", False)
    assert calls["evaluation_starts"] == (
        BROKK_170,
        5,
        sequences,
        2,
    )  # those of `evaluate`, whatever the seed
    rl = {"rl": PolicyController(BROKK_170, trained)}  # type: ignore[arg-type]
    assert calls["evaluate"] == (BROKK_170, rl, sequences, "poses", 0)
    identity = {"nets": "n", "starts": 5, "sequences": ["x"]}
    result = tmp_path / "seed_3.json"
    assert json.loads(result.read_text()) == {"identity": identity, "runs": ["run"]}
    result.unlink()
    (tmp_path / "seed_3.npz.checkpoint").touch()
    one_seed(*arguments)
    assert calls["train"][6] is True


def test_a_sweep_has_baselines_beside_and_says_what_it_is_of(
    stand: Stand, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[object] = []
    rows: dict[int, list[dict[str, object]]] = {3: seed_rows(1.0), 4: seed_rows(3.0)}

    @contextmanager
    def at_once(scheduler: str | None) -> Iterator[Callable[..., Future[object]]]:
        def submit(function: Callable[..., object], *arguments: object) -> Future[object]:
            asked.append(arguments)
            future = Future[object]()
            try:
                future.set_result(function(*arguments))
            except KeyError:
                future.set_exception(ValueError("why"))
            return future

        asked.append(scheduler)
        yield submit

    beside = [row | {"controller": "pid"} for row in seed_rows(5.0)]
    calls = stand(module, read_gains={"pid": "tuned"}, _on_the_machine=beside)
    monkeypatch.setattr(module, "workers", at_once)
    monkeypatch.setattr(module, "one_seed", lambda *a: rows[a[4]])
    out, how = tmp_path / "a" / "b", (2, "tcp://a:1", Path("g.json"))
    figures = sweep(BROKK_170, NET, TASK, replace(TINY, threads=4), [4, 3], out, *how)
    one = (BROKK_170, NET, TASK, TINY, 4, out.resolve(), 2)
    assert asked == ["tcp://a:1", one, (*one[:4], 3, *one[5:])]
    assert calls["read_gains"] == (Path("g.json"), BROKK_170, NET)
    assert calls["_on_the_machine"] == (BROKK_170, {"pid": "tuned"}, 2)
    written = json.loads((out / "sweep.json").read_text())
    about = (
        metrics.metadata(BROKK_170, 3)
        | baselines.gains_metadata(BROKK_170, NET)
        | {"seeds": 2, "failed": {}}
    )
    assert written["meta"] == about and written["table"] == figures == module.table(
        [*rows.values()], beside
    )
    assert written["runs"] == [{"seed": n} | row for n in rows for row in rows[n]] + beside
    rows.clear()
    with pytest.raises(ValueError, match=r"^seed 3: why; seed 4: why$"):
        sweep(BROKK_170, NET, TASK, TINY, [4, 3], out, *how)
    assert json.loads((out / "sweep.json").read_text())["meta"]["failed"] == {
        "3": "why",
        "4": "why",
    }


def test_a_cluster_gives_the_same_files(tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    local, far = tmp_path / "local", tmp_path / "far"
    local.mkdir()
    options = {"n_workers": 1, "processes": False, "dashboard_address": None, "protocol": "tcp"}
    with distributed.LocalCluster(threads_per_worker=1, **options) as cluster:
        address = cluster.scheduler_address
        figures = sweep(BROKK_170, NET, TASK, TINY, [0], far, 1, address)
        assert figures["rl"]["velocity_error_all"]["mean"] > 0
    one_seed(BROKK_170, NET, TASK, TINY, 0, local, 1)
    for name in ("seed_0.npz", "seed_0.json"):
        assert (local / name).read_bytes() == (far / name).read_bytes()


def test_workers_of_many_threads_are_refused() -> None:
    distributed = pytest.importorskip("distributed")
    options = {"n_workers": 1, "processes": False, "dashboard_address": None, "protocol": "tcp"}
    with (
        distributed.LocalCluster(threads_per_worker=2, **options) as cluster,
        pytest.raises(ValueError, match=r"expected workers with --nthreads 1, got \[2\]"),
        workers(cluster.scheduler_address),
    ):
        pass


@pytest.mark.slow
def test_a_worker_of_a_cluster_that_dies_costs_one_retry(tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=1, dashboard_address=None
        ) as cluster,
        workers(cluster.scheduler_address) as submit,
    ):
        assert submit(die_until, tmp_path / "once", 1).result(120) == 2


@pytest.mark.slow
def test_a_sweep_in_processes_of_their_own(tmp_path: Path) -> None:
    figures = sweep(BROKK_170, NET, TASK, TINY, [0, 1], tmp_path, 1)
    assert figures["rl"]["velocity_error_all"]["high"] >= figures["rl"]["velocity_error_all"]["low"]
    assert (tmp_path / "seed_0.npz").read_bytes() != (tmp_path / "seed_1.npz").read_bytes()
    assert len(list(tmp_path.iterdir())) == 7


@pytest.mark.slow
def test_a_scheduler_that_is_not_there_is_named() -> None:
    pytest.importorskip("distributed")
    with pytest.raises(OSError, match=r"127\.0\.0\.1:9"), workers("tcp://127.0.0.1:9"):
        pass
