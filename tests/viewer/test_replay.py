"""Recorded runs: of logs, and of results that are simulated again; films of them."""

import json
from itertools import pairwise

import numpy as np
import pygame
import pytest
from helpers_bus import BASELINE, HoldingOperator, World
from helpers_machines import POSE, small_net
from PIL import Image, ImageSequence

from brokk_min.evaluation import baselines, metrics, sequences
from brokk_min.kinematics import forward_kinematics, tool_position
from brokk_min.learning.policy import Policy, PolicyController, save_policy
from brokk_min.machine import BROKK_170
from brokk_min.viewer import replay


def tool(q):
    return tool_position(forward_kinematics(BROKK_170, q))


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """A drive of two seconds along x, and the world that it was in."""
    path = tmp_path_factory.mktemp("log") / "run.log"
    world = World(BASELINE, HoldingOperator(), log=path)
    world.drive.begin()
    world.run(3.0)
    world.bus.close()
    return path, world


def test_run_of_log__has_the_drive_from_its_first_driven_tick(log):
    path, world = log
    run = replay.run_of_log(BROKK_170, path)
    assert 40 <= len(run) <= 60
    q = np.array(world.recorder.q)  # each 5 ms
    for scene in run[::10]:
        assert np.abs(q - scene.q).max(axis=1).min() < 2e-3  # an encoder's count is 1.5 mrad
    np.testing.assert_allclose([scene.v_goal for scene in run[2:]], len(run[2:]) * [[0.1, 0, 0]])
    np.testing.assert_allclose(run[-1].v_tool, [0.1, 0, 0], atol=0.05)
    np.testing.assert_allclose(run[-1].trail, tool(np.array([scene.q for scene in run])))
    assert (run[0].title, run[10].status) == ("run.log", "0.5 s")


def test_run_of_log__refuses_a_log_in_which_nothing_drives(tmp_path):
    idle = tmp_path / "idle.log"
    idle.write_text("(1.0) can0 080# R\n(1.05) can0 080# R\n")
    with pytest.raises(ValueError, match=r"idle.log: expected a log in which the machine is driv"):
        replay.run_of_log(BROKK_170, idle)


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """A file as `evaluate` writes it, of a policy and gains that nobody trained or tuned."""
    folder = tmp_path_factory.mktemp("results")
    rng = np.random.default_rng(0)
    sizes = (163, 256, 128, 64, 4)
    pairs = [(rng.normal(0, 0.1, size), np.zeros(size[1])) for size in pairwise(sizes)]
    weights = tuple(array.astype(np.float32) for pair in pairs for array in pair)
    policy = Policy({}, weights, small_net(BROKK_170, rng), "paper")
    save_policy(folder / "policy.npz", policy, BROKK_170)
    pids = baselines.baselines(BROKK_170, policy.net)
    about = baselines.gains_metadata(BROKK_170, policy.net)
    baselines.write_gains(folder / "gains.json", pids, about)
    rows = "side,0,0,0.2,0\nside,1.5,0,0,0\nside,2,0,0,0\n"
    (folder / "commands.csv").write_text(f"sequence,time,vx,vy,vz\n{rows}")
    starts = np.array([POSE, POSE - np.array([1.0, 0, 0, 0, 0])])
    lines = [",".join(map(str, row)) for row in starts.tolist()]
    (folder / "starts.csv").write_text("\n".join(["q1,q2,q3,q4,q5", *lines, ""]))
    files = {"policy": "policy.npz", "gains": "gains.json"}
    files |= {"commands": "commands.csv", "starts": "starts.csv"}
    meta = {"machine": "brokk170", "plant": "analytic", "noise": 0.05, "seed": 3}
    meta |= {key: str(folder / name) for key, name in files.items()}
    controllers = {"rl": PolicyController(BROKK_170, policy), replay.PID: pids[replay.PID]}
    commands = sequences.read_commands(folder / "commands.csv", BROKK_170)
    runs, _ = metrics.evaluate(BROKK_170, controllers, commands, starts, 3)
    (folder / "runs.json").write_text(json.dumps({"meta": meta, "runs": runs}))
    return folder / "runs.json"


def test_runs_of_results__are_the_runs_of_the_file_along_the_goals(results):
    runs = replay.runs_of_results(BROKK_170, results, "side", 1)
    assert [run[0].title for run in runs] == ["our learner", "the paper's PID, k = 0.1"]
    rows = [row for row in json.loads(results.read_text())["runs"] if row["start"] == 1]
    p_start = tool(POSE - np.array([1.0, 0, 0, 0, 0]))
    for run, row in zip(runs, rows, strict=True):
        assert len(run) == 40
        np.testing.assert_allclose(
            run[0].path[[0, -1]], [p_start, p_start + np.array([0, 0.3, 0])], atol=1e-6
        )
        errors = [np.linalg.norm(scene.v_goal - scene.v_tool) for scene in run]
        assert np.mean(errors) == pytest.approx(row["velocity_error_mean"], rel=1e-3)
        assert run[-1].notes[1] == f"its mean {np.mean(errors):.3f} m/s"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda f: f["runs"][1].update(velocity_error_mean=9.0), "velocity_error_mean: expected 9"),
        (lambda f: f["runs"][1].update(controller="other"), "results of `evaluate` .*got.*'rl'"),
        (lambda f: f["meta"].update(machine="mini"), "--machine: expected mini, got brokk170"),
        (lambda f: f["meta"].update(plant="own.py:PLANT"), "analytic or net, got own.py:PLANT"),
        (lambda f: f["meta"].update(noise=0.0), "velocity_error_mean: expected"),
        (lambda f: f["meta"].update(starts="2"), "velocity_error_mean: expected"),
        (lambda f: f.pop("meta"), "results of `evaluate` with start 1 of sequence any, got 'meta'"),
    ],
)
def test_runs_of_results__refuses_what_is_not_the_run_of_the_file(
    change, message, results, tmp_path
):
    file = json.loads(results.read_text())
    change(file)
    wrong = tmp_path / "wrong.json"
    wrong.write_text(json.dumps(file))
    with pytest.raises(ValueError, match=message):
        replay.runs_of_results(BROKK_170, wrong, "", 1)


@pytest.mark.parametrize(("sequence", "start", "got"), [("up", 0, "'up'"), ("side", 2, "index 2")])
def test_runs_of_results__refuses_unknown_sequences_and_starts(sequence, start, got, results):
    with pytest.raises(ValueError, match=f"with start {start} of sequence {sequence}, got {got}"):
        replay.runs_of_results(BROKK_170, results, sequence, start)


@pytest.mark.parametrize(("fps", "duration"), [(10.0, 100), (7.0, 150), (100.0, 50)])
def test_film__has_as_many_pictures_a_second_as_ticks_allow(fps, duration, log, tmp_path):
    path, _ = log
    out = tmp_path / "film.gif"
    replay.film([path, path], BROKK_170, out, fps)
    film = Image.open(out)
    frames = [np.array(frame.convert("RGB")) for frame in ImageSequence.Iterator(film)]
    ticks = len(replay.run_of_log(BROKK_170, path))
    assert film.info["duration"] == duration
    assert len(frames) == len(range(0, ticks + duration // 50 - 1, duration // 50))
    assert film.size == (1120, 400)
    np.testing.assert_array_equal(frames[-1][:, :560], frames[-1][:, 560:])
    assert (frames[0] != frames[-1]).any(axis=-1).sum() > 500


def test_film__as_mp4_and_in_no_other_format(results, tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    replay.film([results], BROKK_170, tmp_path / "film.mp4", 10.0)
    import imageio.v3

    assert imageio.v3.imread(tmp_path / "film.mp4").shape[1:] == (400, 1120, 3)
    with pytest.raises(ValueError, match=r"expected a name in .gif or .mp4, got .avi"):
        replay.film([results], BROKK_170, tmp_path / "film.avi", 10.0)


def test_film__in_a_window_goes_on_until_it_is_closed(log, monkeypatch):
    shown = []

    def show(pg, machine, scenes):
        shown.append(scenes[0].status)
        if len(shown) == 70:  # more than the log has, so it has begun again
            pg.event.post(pg.event.Event(pg.QUIT))

    monkeypatch.setattr(replay, "show", show)
    replay.film([log[0]], BROKK_170, None, 100.0)
    assert len(shown) == 70
    assert shown[1] == "0.1 s"
    assert shown.count("0.0 s") == 2
    assert not pygame.display.get_init()
