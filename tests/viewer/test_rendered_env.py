"""Gymnasium's environments draw what happens: frames, videos, a window."""

import sys

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import RecordVideo, RenderCollection

import brokk_min.learning.gym_env  # noqa: F401, registers the environments
from brokk_min.env import TaskConfig
from brokk_min.kinematics import forward_kinematics, tool_position
from brokk_min.machine import BROKK_170
from brokk_min.viewer.drawing import COLOURS, Scene, draw
from brokk_min.viewer.rendered_env import SIZE, RenderedEnv, RenderedVectorEnv
from brokk_min.viewer.window import Canvas

NAME = "brokk_min/Brokk170-v0"


def renderer_of(env):
    renderer = env.vector
    assert isinstance(renderer, RenderedVectorEnv)
    return renderer


def test_rendered_env__gives_frames_of_its_state_and_the_trail_since_the_reset():
    made = gymnasium.make(NAME, render_mode="rgb_array")
    check_env(made.unwrapped)
    env = RenderCollection(made, pop_frames=False)
    env.reset(seed=1)
    for k in range(12):
        env.step(np.array([1.0 if k < 11 else 0.5, 0.0, 0.0, 1.0], np.float32))
    frames = env.render()
    assert isinstance(frames, list)
    assert len(frames) == 13
    assert (frames[-1] != frames[0]).any()
    state = env.unwrapped.vector.state
    trail = np.array(renderer_of(env.unwrapped).trails[0])
    assert len(trail) == 13
    p_tool = tool_position(forward_kinematics(BROKK_170, state.q[0]))
    np.testing.assert_allclose(trail[-1], p_tool)
    u = state.history[0, :, 2, -1]
    scene = Scene(state.q[0], state.q_dot[0], u, state.v_goal[0], trail, title="brokk170")
    canvas = Canvas(SIZE)
    draw(canvas, BROKK_170, [scene])
    np.testing.assert_array_equal(frames[-1], canvas.image())
    env.reset(seed=2)
    assert len(renderer_of(env.unwrapped).trails[0]) == 1
    env.close()


def test_rendered_env__shows_a_window_for_people():
    env = gymnasium.make(NAME, render_mode="human")
    env.reset(seed=1)
    env.step(np.zeros(4, np.float32))
    window = renderer_of(env.unwrapped).window
    assert window is not None
    assert env.render() is None
    pixels = window.pygame.surfarray.array3d(window.surface)
    assert pixels.shape == (*SIZE, 3)
    assert (pixels == COLOURS["rl"]).all(axis=-1).sum() > 1000
    env.close()
    assert not window.pygame.display.get_init()


def test_rendered_vector_env__gives_a_frame_of_each_machine():
    config = TaskConfig(episode_s=0.2)
    envs = gymnasium.make_vec(NAME, num_envs=2, config=config, render_mode="rgb_array")
    envs.reset(seed=0)
    for _ in range(6):
        envs.step(np.zeros((2, 4), np.float32))
    frames = envs.render()
    assert isinstance(frames, tuple)
    assert [frame.shape for frame in frames] == [(600, 960, 3)] * 2
    assert (frames[0] != frames[1]).any()
    trails = envs.unwrapped.trails
    assert [len(trail) for trail in trails.values()] == [3, 3]  # of the reset in step 4, then two
    envs.close()


def test_rendered_env__serves_gymnasiums_video_recorder(tmp_path):
    pytest.importorskip("moviepy")
    made = gymnasium.make(NAME, render_mode="rgb_array")
    env = RecordVideo(made, str(tmp_path), video_length=5)
    env.reset(seed=1)
    for _ in range(6):
        env.step(np.zeros(4, np.float32))
    env.close()
    assert next(tmp_path.glob("*.mp4")).stat().st_size > 1000


def test_rendered_env__refuses_what_it_cannot_do(monkeypatch):
    with pytest.raises(ValueError, match=r"render_mode: expected one of .* got 'ansi'"):
        RenderedEnv(render_mode="ansi")
    for env in (RenderedEnv(render_mode="rgb_array"), RenderedEnv()):
        with pytest.raises(ValueError, match="render: expected a render_mode and a reset before"):
            env.render()
    env = RenderedEnv(render_mode="rgb_array")
    env.reset(seed=0)
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(ValueError, match=r"pygame: expected the extra brokk_min\[play\], got"):
        env.render()
