"""Rare ways through the package that no other test takes: refusals, other machines, missing extras."""

from __future__ import annotations

import json
import re
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers_machines import small_net

from brokk_min import ppo
from brokk_min.__main__ import COMMANDS, main
from brokk_min.env import TaskConfig
from brokk_min.evaluation import claims, experiments, report, sequences
from brokk_min.evaluation import reproduce as chain
from brokk_min.evaluation.sequences import read_starts, start_kinds, task_sequences
from brokk_min.identification.fitting import FitConfig, fit
from brokk_min.identification.logs import Log, Recording, read_log, velocity_of, write_log
from brokk_min.learning import sweep
from brokk_min.machine import BROKK_170, decode_pwm
from brokk_min.viewer import play, replay

ROOT = Path(__file__).parents[2]
MINI = f"{ROOT / 'examples' / 'mini_excavator.py'}:MINI_EXCAVATOR"


def run(*words: object) -> int:
    return main([str(word) for word in words])


# --- the command line ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("line", "status", "message"),
    [
        ("train --actuator n.npz --out p.npz --hold-min-s 2 --hold-max-s 1", 2, "--hold-max-s"),
        (
            "fit one.csv --out n.npz --velocity-samples 20",
            2,
            "--velocity-samples: expected at most --history",
        ),
        ("fit one.csv --out n.npz", 1, "expected two or more recordings"),
        ("drive --interface nonsense --channel 0 --controller jog --command c.csv", 1, "nonsense"),
        ("play --drive", 2, "--interface"),
    ],
)
def test_options_that_do_not_go_together(
    line: str,
    status: int,
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    rows = "".join(f"x,{i / 20},0.5,{i / 50}\n" for i in range(40))
    Path("one.csv").write_text(f"run,time,u_a,q_a\n{rows}")
    Path("c.csv").write_text("sequence,time,vx,vy,vz\nx,0,0.1,0,0\nx,1,0,0,0\n")
    assert run(*line.split()) == status
    assert message in capsys.readouterr().err


def test_starts_are_drawn_into_a_file_that_reads_back(tmp_path: Path) -> None:
    assert run("starts", "--out", tmp_path / "s.csv", "--num", 4) == 0
    starts = read_starts(tmp_path / "s.csv", BROKK_170)
    assert start_kinds(BROKK_170, starts) == ["workspace", "limits", "workspace", "extended"]


def test_reproduce_prints_means_and_verdicts(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = {}

    def instead(
        machine: Any, out: Path, effort: Any, seed: int, sweep: Path | None
    ) -> dict[str, Any]:
        given.update(machine=machine.name, out=out, effort=effort, seed=seed, sweep=sweep)
        means = {"rl": {s: {"velocity_error_mean": 0.0125} for s in "xy"}}
        return {"task_space": {"summary": means}, "claims": [{"holds": True, "paper": "It works."}]}

    monkeypatch.setattr(chain, "reproduce", instead)
    seeds = Path("sweep.json")
    for words, effort, file in (
        ((), experiments.Effort(), None),
        (("--quick",), experiments.QUICK, seeds),
    ):
        more = ("--sweep", file) if file else ()
        assert run("reproduce", "--out", tmp_path, "--seed", 3, *words, *more) == 0
        wanted = {
            "machine": "brokk170",
            "out": tmp_path,
            "effort": effort,
            "seed": 3,
            "sweep": file,
        }
        assert given == wanted
        assert capsys.readouterr().out.splitlines() == [
            "rl                     mean velocity error [m/s]: x 0.0125, y 0.0125",
            f"{report.VERDICTS[True]}: It works.",
            str(tmp_path / "report.html"),
            str(tmp_path / "results.json"),
        ]


def test_an_interrupted_command_says_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stop(self: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(COMMANDS["starts"](), "run", stop)
    assert run("starts", "--out", "s.csv") == 1
    assert capsys.readouterr().err == "brokk-min: stopped\n"


def test_play_watches_a_bus_or_has_levers_alone(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    calls: list[tuple[Any, ...]] = []
    monkeypatch.setattr(play, "watch", lambda *a: calls.append(a))
    monkeypatch.setattr(play, "play", lambda *a: calls.append(a))
    attempts = ["--attempts", tmp_path / "a.csv"]
    assert run("play", "--interface", "virtual", "--channel", "c", *attempts) == 0
    assert run("play", "--machine", MINI, *attempts) == 0
    (_, bus), (machine, controllers, where, _) = calls
    assert (bus.interface, bus.channel) == ("virtual", "c")
    assert machine.name == "mini_excavator" and controllers == {} and not where.interface


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Half a second of the package's policy and gains, from one of the machine's own starts."""
    folder = tmp_path_factory.mktemp("runs")
    (folder / "c.csv").write_text("sequence,time,vx,vy,vz\nup,0,0,0,0.1\nup,0.5,0,0,0\n")
    out = folder / "runs.json"
    assert run("evaluate", "--commands", folder / "c.csv", "--num-starts", 1, "--json", out) == 0
    return out


def test_results_are_shown_from_the_files_that_they_name(
    results: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shown: list[Any] = []
    monkeypatch.setattr(replay, "show_film", lambda machine, runs, size: shown.extend(runs))
    assert run("replay", results, "--controllers", "rl") == 0
    assert [len(one.known) for one in shown] == [10]
    assert run("replay", results, "--controllers", "rl", "--sequence", "down") == 2
    assert "expected some of ['up']" in capsys.readouterr().err
    starts = results.with_name("starts.json")
    table = json.loads(results.read_text())
    table["starts"] = [[1.0, 0.9, 1.2, 1.2, 0.3]]
    starts.write_text(json.dumps(table))
    assert run("replay", starts, "--controllers", "rl") == 1  # other starts, other runs
    assert "expected the run" in capsys.readouterr().err
    table["meta"]["machine"] = "mini"
    starts.write_text(json.dumps(table))
    assert run("replay", starts) == 1
    assert "expected --machine mini, got brokk170" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("status", "message"), [(0, ""), (3, "expected ffmpeg to write it, got its status 3")]
)
def test_a_film_goes_through_ffmpeg_picture_by_picture(
    status: int,
    message: str,
    results: Path,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """An ffmpeg that hands through what it gets: 5 raw pictures, 3 bytes a pixel."""
    (tmp_path / "ffmpeg").write_text(f"#!/bin/sh\ncat\nexit {status}\n")
    (tmp_path / "ffmpeg").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    film = ["--out", tmp_path / "f.mp4", "--size", 320, 320]
    assert run("replay", results, "--controllers", "rl", *film) == (1 if status else 0)
    assert message in capsys.readouterr().err
    written = list(tmp_path.glob("f.mp4"))
    assert [path.stat().st_size for path in written] == ([] if status else [5 * 320 * 320 * 3])


def test_films_have_two_kinds_of_names(results: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("replay", results, "--controllers", "rl", "--out", results.with_suffix(".avi")) == 1
    assert "expected a name ending in .gif or .mp4" in capsys.readouterr().err


# --- refusals -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("u_byte", [-1, 256])
def test_what_is_no_byte_is_no_command(u_byte: int) -> None:
    with pytest.raises(ValueError, match=f"u_byte: expected 0 to 255, got {u_byte}"):
        decode_pwm([3, u_byte])


def test_a_log_has_recordings_and_may_end_in_blank_lines(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"l\.csv: expected at least one recording to write"):
        write_log(tmp_path / "l.csv", Log(("a",), ()))
    (tmp_path / "l.csv").write_text("run,time,u_a,q_a\nx,0,0,0\nx,0.05,0,0\n\n\n")
    assert len(read_log([tmp_path / "l.csv"], 2).recordings[0].q) == 2


def test_a_fit_that_leaves_the_numbers_is_no_fit() -> None:
    t = np.arange(80) / 20
    q = np.sin(t)[:, None]
    log = Log(("a",), (Recording("x", np.cos(t)[:, None], q, velocity_of(q, 2)),))
    with pytest.raises(ValueError, match="weights: expected finite numbers at the end of the fit"):
        fit(log, FitConfig(steps=4, learning_rate=1e35, history=3, rollout=1), 0, 2)


def test_sequences_last_a_tick_and_none_is_all(tmp_path: Path) -> None:
    for rows in ("all,0,0,0,0.1\nall,1,0,0,0\n", "x,0,0,0,0.1\nx,0.01,0,0,0\n"):
        (tmp_path / "c.csv").write_text(f"sequence,time,vx,vy,vz\n{rows}")
        with pytest.raises(ValueError, match="expected a tick or more and another name than all"):
            sequences.read_commands(tmp_path / "c.csv", BROKK_170)


def test_a_machine_that_can_follow_nothing_has_no_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    poses = np.tile([0.0, 0.5, 0.58, 1.71, 1.24], (3, 1))
    monkeypatch.setattr(sequences, "draw_pose", lambda *a: poses)
    monkeypatch.setattr(sequences, "feasible", lambda machine, q, goals: np.zeros(len(q), bool))
    rng = np.random.default_rng(0)
    with pytest.raises(
        ValueError, match="expected 2 poses from which all sequences are feasible, got fewer"
    ):
        sequences.draw_starts(BROKK_170, task_sequences(BROKK_170)[:1], 2, rng)
    with pytest.raises(ValueError, match="brokk170: expected 2 feasible runs to tune on, got 0"):
        sequences.tuning_set(BROKK_170, 2, 0, 1.0)


def test_damping_is_compared_between_controllers_that_have_one() -> None:
    with pytest.raises(ValueError, match="expected a JacobianController"):
        claims.singular_controllers(
            {"rl": SimpleNamespace(), "jacobian_pid_k0.1": SimpleNamespace()}
        )


def test_a_mean_of_nothing_is_an_empty_cell() -> None:
    assert report._with_interval({"mean": None, "low": None, "high": None}) == ""


# --- extras that are not installed ----------------------------------------------------------------------


def test_a_cluster_needs_dask(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with (
        pytest.raises(ValueError, match=re.escape("brokk_min[sweep]")),
        sweep.workers("tcp://nowhere:1"),
    ):
        pass


def test_tensorboard_gets_the_curve_and_may_be_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    net = replace(small_net(BROKK_170, np.random.default_rng(0)), machine="brokk170")
    tiny = ppo.PPOConfig(
        total_steps=32, num_envs=8, horizon=2, minibatch_size=8, epochs=1, threads=1
    )
    files = (tmp_path / "p.npz", False, tmp_path / "board")
    ppo.train(BROKK_170, net, TaskConfig(), tiny, 0, *files)
    (events,) = (tmp_path / "board").iterdir()
    assert b"charts/reward" in events.read_bytes()
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(ValueError, match=re.escape("brokk_min[tensorboard]")):
        ppo.train(BROKK_170, net, TaskConfig(), tiny, 0, *files)
