"""Recorded runs: what results files tell, runs driven again, and the films of them, with stand-ins beside."""

from __future__ import annotations

import contextlib
import io
import json
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pygame
import pytest
from conftest import Stand
from PIL import Image

from brokk_min.can.drive_log import Telemetry
from brokk_min.evaluation import baselines, metrics
from brokk_min.evaluation.sequences import task_sequences
from brokk_min.kinematics import tool_state
from brokk_min.machine import BROKK_170
from brokk_min.viewer import drawing as view
from brokk_min.viewer import replay
from brokk_min.viewer.drawing import skeleton

START = np.array([0.0, 0.5, 0.58, 1.71, 1.24])


def known(ticks: int) -> list[Telemetry]:
    """The cabin turns at 0.1 rad/s; asked for is 0.1 m/s aside and 0.05 m/s upward."""
    row = np.array([0.1, 0, 0, 0, 0]), np.full(5, 0.3), np.array([0, 0.1, 0.05])
    return [
        Telemetry(k, START + 0.005 * k * np.eye(5)[0], *row, driving=True) for k in range(ticks)
    ]


def test_a_run_has_the_tools_way_its_error_and_all_that_must_be_in_the_picture() -> None:
    told, path = known(25), np.array([[9.0, 0, 0], [9, 1, 0]])
    run = replay.recorded(BROKK_170, "a", (1, 2, 3), told, path)
    q, q_dot = np.array([k.q for k in told]), np.array([k.q_dot for k in told])
    p_tool, v_tool, _ = tool_state(BROKK_170, q, q_dot)
    np.testing.assert_array_equal(run.p_tool, p_tool)
    np.testing.assert_allclose(run.error, np.sqrt(np.square(v_tool - [0, 0.1, 0.05]).sum(axis=1)))
    corners = skeleton(BROKK_170, q[[0, 10, 20]]).reshape(-1, 3)
    np.testing.assert_array_equal(run.hold, np.vstack([corners, path]))
    assert run[:3] == ("a", (1, 2, 3), told) and run.path is path


# --- results ----------------------------------------------------------------------------------------------


def test_results_name_what_it_takes_to_drive_them_again(stand: Stand, tmp_path: Path) -> None:
    path, sequence = tmp_path / "r.json", SimpleNamespace(name="up")
    drawn = np.ones((3, 5))
    calls = stand(
        replay, load_policy=SimpleNamespace(net="nets"), goals_and_starts=([sequence], drawn)
    )
    stand(baselines, read_gains={"pid": "tuned"})
    meta: dict[str, Any] = {"machine": "brokk170", "seed": 4}
    path.write_text(json.dumps({"meta": meta, "task_space": {"runs": [1]}, "starts": [[1, 2]]}))
    of_reproduce = replay.read_results(BROKK_170, path, ["pid", "rl"])
    assert of_reproduce[:3] == (path, [1], {"up": sequence}) and of_reproduce[5:] == (None, 4)
    assert of_reproduce.starts.tolist() == [[1, 2]] and of_reproduce.starts.dtype == float
    assert (
        list(of_reproduce.controllers) == ["rl", "pid"]
        and of_reproduce.controllers["pid"] == "tuned"
    )
    assert calls.pop("goals_and_starts") == (BROKK_170, None, None, 0, 4)
    assert calls.pop("load_policy") == (tmp_path / "policy.npz", BROKK_170)
    assert calls.pop("read_gains") == (tmp_path / "gains.json", BROKK_170, "nets")
    meta |= {
        "plant": "net",
        "commands": "c.csv",
        "starts": "s.csv",
        "policy": "p.npz",
        "gains": "g.json",
    }
    path.write_text(json.dumps({"meta": meta, "runs": [2]}))
    found = replay.read_results(BROKK_170, path, ["rl"])
    assert found.runs == [2] and found.starts is drawn and found.net == "nets"
    assert calls["goals_and_starts"] == (BROKK_170, Path("c.csv"), Path("s.csv"), 0, 4)
    assert calls["load_policy"][0] == Path("p.npz") and "read_gains" not in calls
    replay.read_results(BROKK_170, path, ["pid"])
    assert calls["read_gains"][0] == Path("g.json")
    own = ", ".join(s.name for s in task_sequences(BROKK_170))
    path.write_text(json.dumps({"meta": meta | {"commands": own, "starts": "3"}, "runs": [2]}))
    replay.read_results(BROKK_170, path, ["rl"])
    assert calls["goals_and_starts"][1:] == (None, None, 3, 4)
    path.write_text(json.dumps({"meta": meta | {"machine": "mini"}, "runs": []}))
    with pytest.raises(ValueError, match=r"r\.json: expected --machine mini, got brokk170$"):
        replay.read_results(BROKK_170, path, ["rl"])
    path.write_text("{}")
    with pytest.raises(
        ValueError, match=r"r\.json: expected results of `evaluate`, got KeyError\('meta'\)"
    ):
        replay.read_results(BROKK_170, path, ["rl"])


def test_runs_driven_again_are_those_of_the_file(stand: Stand) -> None:
    def row(
        rmse: float, controller: str = "rl", sequence: str = "up", start: int = 1
    ) -> dict[str, Any]:
        return {
            "controller": controller,
            "sequence": sequence,
            "start": start,
            "velocity_rmse": rmse,
        }

    goals = np.array([[0.1, 0, 0], [0.1, 0, 0.2]])
    sequences = {"up": SimpleNamespace(goals=goals), "to": SimpleNamespace(goals=2 * goals)}
    arrays = np.arange(2 * 2 * 5).reshape(2, 2, 5) / 100
    trace = SimpleNamespace(q=START + arrays, q_dot=arrays + 1, u=arrays + 2)
    other = [row(5.0, start=0), row(5.0, sequence="to"), row(5.0, start=0, sequence="to")]
    chosen = ["rl", "pid"]
    stored = [row(1.0), row(2.0, "pid"), *other]
    results = replay.Results(
        Path("r.json"), stored, sequences, np.stack([START + 1, START]), {}, "net", 3
    )  # type: ignore[arg-type]
    results.controllers.update(dict.fromkeys(["more", *chosen], "drives"))  # type: ignore[arg-type]
    traces = {(name, s): trace for name in chosen for s in sequences}
    found = [row(1.0005), row(2.001, "pid"), *(r | {"velocity_rmse": 7.0} for r in other)]
    calls = stand(metrics, evaluate=(found, traces))
    runs = replay.driven_again(BROKK_170, results, chosen, "up", 1)
    assert calls["evaluate"][:2] == (BROKK_170, dict.fromkeys(chosen, "drives"))
    assert calls["evaluate"][2:] == (list(sequences.values()), results.starts, 3, "net")
    assert [run.title for run in runs] == chosen
    assert [run.colour for run in runs] == [view.COLOURS["rl"], view.STEEL]
    for run in runs:
        assert [k.tick for k in run.known] == [0, 1] and all(k.driving for k in run.known)
        for k, one in enumerate(run.known):
            np.testing.assert_array_equal(
                np.stack(one[1:4]), [trace.q[k, 1], trace.q_dot[k, 1], trace.u[k, 1]]
            )
            np.testing.assert_array_equal(one.v_goal, goals[k])
        way = np.array([[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0.2]]) * 0.05
        np.testing.assert_allclose(run.path, tool_state(BROKK_170, START, 0 * START)[0] + way)
    for wrong, told in ((row(1.003), r"\[{.*1\.0}\]"), (row(1.0, "pd"), "none")):
        stand(metrics, evaluate=([wrong], traces))
        with pytest.raises(
            ValueError, match=rf"r\.json: expected the run {{.*}}, got {told}: another program"
        ):
            replay.driven_again(BROKK_170, results, chosen, "up", 1)


# --- films --------------------------------------------------------------------------------------------------


def test_a_film_goes_by_one_clock_and_what_is_over_stands_still(stand: Stand) -> None:
    calls, told = stand(view, draw="shapes"), known(5)
    long = replay.recorded(BROKK_170, "rl", (1, 2, 3), told, np.zeros((0, 3)))
    long = long._replace(error=np.arange(5) / 7)
    short = replay.recorded(BROKK_170, "my.log", (4, 5, 6), told[:3], np.ones((2, 3)))
    assert replay.film(BROKK_170, [long, short], 4, (640, 360)) == "shapes"
    machine, (first, second), size = calls["draw"]
    assert machine is BROKK_170 and size == (640, 360)
    assert (first.title, first.status, first.colour) == ("RL policy", "0.2 s", (1, 2, 3))
    assert (second.title, second.status, second.colour) == ("my.log", "0.1 s", (4, 5, 6))
    for scene, run, at in ((first, long, 4), (second, short, 2)):
        assert scene[:4] == run.known[at][1:5] and scene.path is run.path
        np.testing.assert_array_equal(scene.trail, run.p_tool)
        np.testing.assert_array_equal(scene.hold, np.vstack([long.hold, short.hold]))
        assert scene.notes == [
            f"velocity error {run.error[at]:.3f} m/s",
            f"mean so far {run.error.mean():.3f} m/s",
        ]
    replay.film(BROKK_170, [long], 1, (640, 360))
    (scene,) = calls["draw"][1]
    assert len(scene.trail) == 2 and scene.notes == [
        "velocity error 0.143 m/s",
        "mean so far 0.071 m/s",
    ]


@pytest.mark.parametrize(
    ("fps", "ticks"), [(10.0, [0, 2, 4]), (7.0, [0, 3]), (100.0, [0, 1, 2, 3, 4])]
)
def test_a_film_has_as_many_pictures_a_second_as_ticks_allow(
    fps: float, ticks: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written: list[Any] = []
    run = replay.recorded(BROKK_170, "rl", (1, 2, 3), known(5), np.zeros((0, 3)))
    monkeypatch.setattr(replay, "film", lambda machine, runs, tick, size: (tick, size))
    monkeypatch.setattr(replay, "picture", lambda shapes, size: (*shapes, size))
    monkeypatch.setattr(
        replay, "_write_gif", lambda file, images, *how: written.extend([list(images), how])
    )
    replay.write_film(
        tmp_path / "f.gif", BROKK_170, [run, run._replace(known=known(2))], (64, 36), fps
    )
    assert written == [
        [(k, (64, 36), (64, 36)) for k in ticks],
        ((64, 36), 20.0 / (ticks[1] - ticks[0])),
    ]


def test_a_gif_runs_for_ever_and_keeps_the_colours_that_warn() -> None:
    """Most of a picture is machine and paper; a red word is a hundred pixels, and not in every picture."""
    rng, wanted = (
        np.random.default_rng(0),
        [*view.COLOURS.values(), *view.STATUS_COLOURS.values(), view.WARNING],
    )
    pictures = [rng.integers(0, 256, (60, 80, 3)).astype(np.uint8) for _ in range(3)]
    for k, colour in enumerate([*wanted, view.MEASURED, view.PATH]):
        pictures[1][2 * k : 2 * k + 2, :9] = colour
    file = io.BytesIO()
    replay._write_gif(file, pictures, (80, 60), 8.0)
    film = Image.open(file)
    assert (film.n_frames, film.size, film.info["duration"], film.info["loop"]) == (
        3,
        (80, 60),
        120,
        0,
    )
    replay._write_gif(one := io.BytesIO(), pictures[:1], (80, 60), 8.0)
    assert Image.open(one).size == (80, 60)
    film.seek(1)
    shown = np.array(film.convert("RGB")).astype(int)
    assert len(np.unique(shown.reshape(-1, 3), axis=0)) <= 96
    for k, colour in enumerate([*wanted, view.MEASURED, view.PATH]):
        assert np.abs(shown[2 * k : 2 * k + 2, :9] - colour).max() < 12


def test_ffmpeg_is_told_what_the_pictures_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "ffmpeg").write_text(f'#!/bin/sh\necho "$@" > {tmp_path}/told\ncat\n')
    (tmp_path / "ffmpeg").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    with (tmp_path / "film").open("wb") as file:
        replay._write_mp4(file, [np.full((3, 5, 3), 7, np.uint8)] * 2, (5, 3), 10.0)
    assert (tmp_path / "film").read_bytes() == bytes([7]) * 2 * 3 * 5 * 3
    told = (tmp_path / "told").read_text().split()
    options = {a: b for a, b in pairwise(told) if a.startswith("-")}
    assert told[-1] == "pipe:1" and options["-loglevel"] == "error" and options["-i"] == "-"
    before, after = told[: told.index("-i")], told[told.index("-i") :]
    assert {"rawvideo", "rgb24", "5x3", "10.0"} <= set(before)  # of what comes in
    assert {
        "yuv420p",
        "crop=trunc(iw/2)*2:trunc(ih/2)*2",
        "mp4",
        "frag_keyframe+empty_moov",
    } <= set(after)
    (tmp_path / "ffmpeg").write_text("#!/bin/sh\nexit 0\n")  # it ends well, but read nothing
    large = [np.zeros((600, 600, 3), np.uint8)] * 2
    with (tmp_path / "film").open("wb") as file:
        with pytest.raises(
            ValueError, match=r"^film: expected ffmpeg to write it, got its status 1$"
        ):
            replay._write_mp4(file, large, (600, 600), 10.0)
        (tmp_path / "ffmpeg").unlink()
        monkeypatch.setenv("PATH", str(tmp_path))
        with pytest.raises(
            ValueError, match=r"^film: expected ffmpeg for \.mp4, or a name ending in \.gif"
        ):
            replay._write_mp4(file, large, (600, 600), 10.0)


def test_a_film_in_a_window_halts_and_moves_by_a_second(
    stand: Stand, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[Any] = []
    events = {
        3: pygame.K_SPACE,
        5: pygame.K_RIGHT,
        6: pygame.K_LEFT,
        7: pygame.K_LEFT,
        8: pygame.K_SPACE,
    }
    events |= {9: pygame.K_RIGHT, 10: pygame.K_RIGHT, 12: pygame.K_ESCAPE}
    script = [
        [pygame.event.Event(pygame.KEYDOWN, key=events[k])] if k in events else []
        for k in range(13)
    ]
    monkeypatch.setattr(pygame.event, "get", lambda: script.pop(0))
    window = SimpleNamespace(pygame=pygame, show=lambda *a: shown.append(a))
    monkeypatch.setattr(replay, "film", lambda *a: a)
    calls = stand(replay, open_window=contextlib.nullcontext(window))
    runs = [SimpleNamespace(known=range(n)) for n in (31, 2)]
    replay.show_film(BROKK_170, runs, (640, 360))  # type: ignore[arg-type]
    ticks = 0, 1, 2, 3, 3, 23, 3, 0, 0, 21, 30, 30
    assert shown == [((BROKK_170, runs, tick, (640, 360)), 20.0) for tick in ticks]
    assert calls["open_window"] == ((640, 360), "brokk_min replay")
    script[:] = [[], [pygame.event.Event(pygame.QUIT)]]
    replay.show_film(BROKK_170, runs, (640, 360))  # type: ignore[arg-type]
    assert [picture[2] for picture, _ in shown[12:]] == [0]
