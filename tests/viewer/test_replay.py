"""The log of a drive as a film."""

import numpy as np
import pytest
from helpers_cli import run
from PIL import Image, ImageSequence

from benchmarks.one_process import BASELINE, HoldingOperator, World
from brokk_min.kinematics import forward_kinematics, tool_position
from brokk_min.machine import BROKK_170
from brokk_min.viewer import replay


def test_replay__shows_the_drive_from_its_first_driven_tick(tmp_path):
    """Two seconds along x: a picture of every second tick, and of the last."""
    path, out = tmp_path / "run.log", tmp_path / "film.gif"
    world = World(BASELINE, HoldingOperator(), log=path)
    world.drive.begin()
    world.run(3.0)
    world.bus.close()
    shown = replay.scenes(BROKK_170, path)
    assert 40 <= len(shown) <= 60
    q = np.array(world.recorder.q)  # each 5 ms
    for scene in shown[::10]:
        assert np.abs(q - scene.q).max(axis=1).min() < 2e-3  # an encoder's count is 1.5 mrad
    goals = [scene.v_goal for scene in shown[2:]]
    np.testing.assert_allclose(goals, len(goals) * [[0.1, 0, 0]])
    np.testing.assert_allclose(shown[-1].v_tool, [0.1, 0, 0], atol=0.05)
    fk = forward_kinematics(BROKK_170, np.array([scene.q for scene in shown]))
    np.testing.assert_allclose(shown[-1].trail, tool_position(fk))
    assert (shown[0].title, shown[10].status) == ("run.log", "0.5 s")
    assert run("replay", path, "--out", out) == 0
    film = Image.open(out)
    frames = [np.array(frame.convert("RGB")) for frame in ImageSequence.Iterator(film)]
    assert film.info["duration"] == 100 and len(frames) == len(shown) // 2 + 1
    assert (frames[0] != frames[-1]).any(axis=-1).sum() > 300


def test_scenes__refuses_a_log_in_which_nothing_drives(tmp_path):
    idle = tmp_path / "idle.log"
    idle.write_text("(1.0) can0 080# R\n(1.05) can0 080# R\n")
    with pytest.raises(ValueError, match=r"idle.log: expected a log in which the machine is driv"):
        replay.scenes(BROKK_170, idle)
