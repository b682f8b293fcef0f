"""Recorded runs: of logs, of results simulated again, and films of them."""

import json
import os

import numpy as np
import pygame
import pytest
from helpers_bus import BASELINE, START
from helpers_viewer import PipedLoop, post_key, run_of
from PIL import Image, ImageSequence

from benchmarks import POLICY
from brokk_min.__main__ import main
from brokk_min.evaluation import baselines
from brokk_min.evaluation.sequences import task_sequences
from brokk_min.kinematics import forward_kinematics, tool_position
from brokk_min.learning.policy import load_policy, save_policy
from brokk_min.machine import BROKK_170
from brokk_min.viewer import drawing, replay

COLOUR = (1, 2, 3)


def recorded_log(path, controller, seconds, v):
    """A loop that has stood for 0.5 s and driven for some more, with a log of it."""
    loop = PipedLoop(controller, log=path)
    loop.go(0.5, False)
    loop.go(0.2, True)
    loop.go(seconds, True, v)
    loop.close()
    return loop


def test_run_of_log__has_the_telemetry_of_the_loop_from_the_first_driven_tick(tmp_path):
    path = tmp_path / "run.log"
    loop = recorded_log(path, BASELINE, 2.0, (0.0, 0.2, 0.1))
    run = replay.run_of_log(BROKK_170, path, COLOUR)
    driven = [t for t in loop.ticks if t.driving][: len(run.q)]
    assert len(run.q) >= 40
    for name in ("q", "q_dot", "u", "v_goal"):
        expected = np.array([getattr(t, name) for t in driven])
        np.testing.assert_allclose(getattr(run, name), expected, atol=2e-5, err_msg=name)
    assert (run.title, run.colour, run.path.shape) == ("run.log", COLOUR, (0, 3))
    assert run.error[5] > 0.15  # it waits for the valves, then follows
    assert run.error[-5:].mean() < 0.08


def test_run_of_log__refuses_a_log_in_which_nothing_drives(tmp_path):
    idle = tmp_path / "idle.log"
    idle.write_text("(1.0) can0 080# R\n(1.05) can0 080# R\n")
    with pytest.raises(ValueError, match="expected a log in which the valves are driven, got none"):
        replay.run_of_log(BROKK_170, idle, COLOUR)


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """What `evaluate` writes, of a policy and gains that nobody tuned."""
    folder = tmp_path_factory.mktemp("results")
    policy = load_policy(POLICY, BROKK_170)
    save_policy(folder / "policy.npz", policy, BROKK_170)
    about = baselines.gains_metadata(BROKK_170, policy.net)
    baselines.write_gains(folder / "gains.json", baselines.baselines(BROKK_170, policy.net), about)
    rows = "side,0,0,0.2,0\nside,1.5,0,0,0\nside,2,0,0,0\n"
    (folder / "commands.csv").write_text(f"sequence,time,vx,vy,vz\n{rows}")
    starts = "0,0.5,0.58,1.71,1.24\n0.5,0.5,0.58,1.71,1.24\n"
    (folder / "starts.csv").write_text(f"q1,q2,q3,q4,q5\n{starts}")
    files = ("policy", "policy.npz"), ("commands", "commands.csv"), ("starts", "starts.csv")
    arguments = [f"--{option}={folder / name}" for option, name in files]
    assert main(["evaluate", *arguments, f"--json={folder / 'runs.json'}"]) == 0
    return folder / "runs.json"


def test_simulate_again__gives_the_runs_of_the_file_along_the_goals(results):
    names = ["rl", "jacobian_pid_k0.1"]
    read = replay.read_results(BROKK_170, results, names)
    runs = replay.simulate_again(BROKK_170, read, names, "side", 1)
    assert [run.title for run in runs] == names
    assert [run.colour for run in runs] == [drawing.COLOURS["rl"], drawing.COLOURS["jacobian"]]
    p_start = tool_position(forward_kinematics(BROKK_170, np.array([0.5, *START[1:]])))
    rows = {row["controller"]: row for row in json.loads(results.read_text())["runs"][1::2]}
    for run in runs:
        np.testing.assert_allclose(run.path[0], p_start)
        np.testing.assert_allclose(run.path[-1], p_start + np.array([0, 0.3, 0]), atol=1e-6)
        rmse = np.sqrt(np.mean(run.error**2))
        assert rmse == pytest.approx(rows[run.title]["velocity_rmse"], rel=1e-3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda f: f["runs"][1].update(velocity_rmse=9.0), r"the run {.*}, got \[{.*another prog"),
        (lambda f: f["runs"][1].update(controller="other"), r"the run {.*}, got none: another"),
        (lambda f: f["meta"].update(machine="mini"), "--machine mini, got brokk170"),
        (lambda f: f["meta"].update(policy="missing.npz"), "missing.npz"),
        (lambda f: f["meta"].update(plant="net"), "expected the run"),
        (lambda f: f["meta"].update(noise=0.0), "expected the run"),
        (lambda f: f["meta"].update(plant="own.py:PLANT"), "of nets, got own.py:PLANT"),
        (lambda f: f["meta"].update(gains="tuned now"), "gains: expected those of a file"),
    ],
)
def test_results__that_are_not_those_of_the_file_are_refused(change, message, results, tmp_path):
    file = json.loads(results.read_text())
    change(file)
    wrong = tmp_path / "wrong.json"
    wrong.write_text(json.dumps(file))
    with pytest.raises(ValueError, match=message):
        read = replay.read_results(BROKK_170, wrong, ["rl", "jacobian_pid_k0.1"])
        replay.simulate_again(BROKK_170, read, ["rl"], "side", 1)


def test_read_results__takes_files_of_reproduce_with_policy_and_gains_beside_them(results):
    file = json.loads(results.read_text())
    meta = {key: file["meta"][key] for key in ("machine", "seed")}
    whole = results.with_name("results.json")
    starts = [list(START), [0.1, *START[1:]]]
    content = {"meta": meta, "task_space": {"runs": file["runs"]}, "starts": starts}
    whole.write_text(json.dumps(content))
    read = replay.read_results(BROKK_170, whole, ["rl", "jacobian_pid_ff"])
    assert read.rows == file["runs"]
    assert read.starts.tolist() == starts
    assert list(read.sequences) == [sequence.name for sequence in task_sequences(BROKK_170)]
    assert {"rl", "jacobian_pid_ff"} <= set(read.controllers)
    assert set(replay.read_results(BROKK_170, whole, ["rl"]).controllers) == {"rl"}


@pytest.mark.parametrize(
    ("fps", "times"), [(10.0, [100, 100]), (7.0, [150, 150]), (100.0, [50] * 4)]
)
def test_write_film__has_as_many_frames_a_second_as_ticks_allow(fps, times, tmp_path):
    """The last tick is always there, and is held for three seconds."""
    replay.write_film(tmp_path / "f.gif", BROKK_170, [run_of(5), run_of(2)], (640, 360), fps)
    film = Image.open(tmp_path / "f.gif")
    assert [frame.info["duration"] for frame in ImageSequence.Iterator(film)] == [*times, 3000]
    assert film.info["loop"] == 0
    with pytest.raises(ValueError, match=r"expected a name ending in .gif or .mp4, got '.avi'"):
        replay.write_film(tmp_path / "f.avi", BROKK_170, [run_of(5)], (640, 360), fps)


@pytest.mark.parametrize(
    ("script", "message"),
    [
        ('echo "$@" > told; cat > raw; echo film', ""),
        ("exit 3", "film: expected ffmpeg to write it, got its status 3"),
        (None, "film: expected ffmpeg for .mp4, or a name in .gif, got none"),
    ],
)
def test_write_film__hands_raw_pictures_to_ffmpeg(script, message, monkeypatch, tmp_path):
    """Another ffmpeg: it keeps what it gets, ends early, fails, or is not there."""
    monkeypatch.chdir(tmp_path)
    if script is not None:
        (tmp_path / "ffmpeg").write_text(f"#!/bin/sh\n{script}\n")
        (tmp_path / "ffmpeg").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}" if script else str(tmp_path))
    out = tmp_path / "film.mp4"
    if message:
        with pytest.raises(ValueError, match=message):
            replay.write_film(out, BROKK_170, [run_of(5)], (641, 361), 20.0)
        assert not out.exists()
        return
    replay.write_film(out, BROKK_170, [run_of(5)], (641, 361), 20.0)
    assert out.read_text() == "film\n"
    assert (tmp_path / "raw").stat().st_size == 5 * 641 * 361 * 3
    options = (tmp_path / "told").read_text().split()
    pipe = options.index("-i")
    assert {"rawvideo", "rgb24", "641x361", "20.0"} <= set(options[:pipe])  # of what comes in
    assert {"yuv420p", "crop=trunc(iw/2)*2:trunc(ih/2)*2", "mp4"} <= set(options[pipe:])


def test_show_film__halts_and_moves_by_a_second(monkeypatch):
    keys = {3: "space", 5: "right", 6: "left", 7: "left", 8: "space"}
    keys |= {9: "right", 10: "right", 12: "escape"}
    ticks = []
    film = replay.film

    def pressing(runs, tick, size):
        ticks.append(tick)
        if len(ticks) in keys:
            post_key(keys[len(ticks)])
        return film(runs, tick, size)

    monkeypatch.setattr(replay, "film", pressing)
    replay.show_film(BROKK_170, [run_of(31), run_of(2)], (640, 360))
    assert ticks == [0, 1, 2, 3, 3, 23, 3, 0, 0, 21, 30, 30]
    assert not pygame.display.get_init()
