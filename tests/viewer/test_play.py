"""The window without a display: what it shows, whom it hears, and the whole of it in real time."""

from __future__ import annotations

from contextlib import closing

import can
import numpy as np
import pygame
import pytest
from helpers_bus import START, ConstantCommand, World, recording
from helpers_viewer import MODES, post, post_key, telemetry

from brokk_min.can.canopen import OperatorInput
from brokk_min.kinematics import forward_kinematics, tool_position
from brokk_min.machine import BROKK_170
from brokk_min.viewer import drawing, play, replay
from brokk_min.viewer.control_process import BusOptions
from brokk_min.viewer.play import Session
from brokk_min.viewer.window import Window


def tool(q):
    return tool_position(forward_kinematics(BROKK_170, np.array(q)))


# --- what is shown --------------------------------------------------------------------------------


def test_scene__interpolates_between_two_ticks_and_forgets_them_after_half_a_second():
    session = Session(BROKK_170, MODES, None)
    q = np.array(START)
    for hint, status in (("starting", "starting"), ("", "no telemetry")):
        scene = session.scene(0.0, "rl", hint)
        assert np.isnan(scene.q).all()
        assert np.isnan(scene.q_dot).all()
        assert not scene.u.any()
        assert (scene.status, scene.status_colour) == (status, drawing.WARNING)
        assert scene.path.shape == scene.trail.shape == (0, 3)
    session.update(telemetry(0, q), 1.0)
    np.testing.assert_array_equal(session.scene(1.02, "rl", "").q, q)
    u = np.full(5, 0.1)
    v = np.array([0.1, 0.0, 0.2])
    session.update(telemetry(1, q + 0.02, q_dot=0 * q + 0.4, u=u, v_goal=v), 1.05)
    for now, fraction in ((1.05, 0.0), (1.075, 0.5), (1.1, 1.0), (1.54, 1.0)):
        scene = session.scene(now, "rl", "")
        np.testing.assert_allclose(scene.q, q + fraction * 0.02)
        assert (scene.q_dot == 0.4).all()
        assert scene.u is u
        assert scene.v_goal is v
        assert (scene.status, scene.status_colour) == ("driving", drawing.DRIVING)
    np.testing.assert_allclose(scene.trail, [tool(q), tool(q + 0.02)])
    late = session.scene(1.56, "rl", "")
    assert np.isnan(late.q).all()
    assert late.status == "no telemetry"


def test_session__begins_a_line_again_when_the_mode_changes_on_the_way():
    session = Session(BROKK_170, MODES, None)
    session.update(telemetry(), 0.0)
    session.next_task(again=True)
    first = session.tracing
    assert session.task == "rectangle"  # there was nothing to repeat
    session.update(telemetry(mode=1), 0.0)
    assert session.tracing is first  # before the first opened valve nothing changes
    opened = np.full(5, 0.5)
    session.update(telemetry(mode=1, u=opened), 0.0)
    session.update(telemetry(mode=2, u=opened), 0.0)
    assert session.tracing is not first
    assert session.task == "rectangle"
    assert session.tracing is not None
    assert len(session.tracing.p) == 1
    session.update(telemetry(mode=2), 0.0)
    session.next_task()
    assert session.task == "circle"


# --- the window -----------------------------------------------------------------------------------


def test_show__sends_requests_once_there_is_telemetry_and_takes_keys_frame_by_frame():
    session = Session(BROKK_170, MODES, None)
    frames = [[], [telemetry(0)], [telemetry(1)], [telemetry(2), telemetry(3)], [telemetry(4)]]
    presses = [[], [], ["return"], ["return"], ["backspace", "tab"], ["escape"]]
    sent = []
    tasks = []

    def each_frame(seen, handler):
        assert seen is session
        tasks.append((session.task, session.tracing))
        for name in presses.pop(0):
            post_key(name)
        return bool(presses)

    with closing(Window(play.SIZE, "test")) as window:
        play.show(window, session, lambda: frames.pop(0), sent.append, each_frame, fps=500.0)
    assert [task for task, _ in tasks] == ["", "", "", "rectangle", "circle", "circle"]
    assert tasks[5][1] is not tasks[4][1]  # begun again
    assert [request.mode for request in sent] == [0, 0, 0, 1]  # not in the first frame
    assert session.previous is not None
    assert session.previous.tick == 3


def test_play__drives_a_machine_in_another_process(tmp_path):
    """In real time: keys, the loop's process, the plant behind the bus; then focus and closing.

    On a busy computer the gate may stop for a late tick: then the switch is pressed anew.
    """
    seen = []
    steps = [
        (lambda t: t.active_fault == 0, pygame.KEYDOWN, {"key": pygame.K_SPACE}),
        (lambda t: t.driving, pygame.KEYDOWN, {"key": pygame.K_q}),
        (lambda t: bool(t.q_dot[0] > 0.1), pygame.WINDOWFOCUSLOST, {}),
        (lambda t: not t.driving and not t.u.any(), pygame.WINDOWFOCUSGAINED, {}),
        (lambda t: True, pygame.QUIT, {}),
    ]
    at = frames = 0

    def each_frame(session, handler):
        nonlocal at, frames
        frames += 1
        assert frames < 3600, (session.telemetry, at)
        if session.telemetry is None or at == len(steps):
            return True
        seen.append(session.telemetry)
        condition, kind, event = steps[at]
        if condition(session.telemetry):
            post(kind, **event)
            at += 1
        elif at in (1, 2) and not session.telemetry.driving and frames % 60 == 0:
            post_key("q", False)
            post_key("space", False)
            at = 0
        return True

    options = BusOptions(log=tmp_path / "run.log")
    play.play(BROKK_170, {}, options, tmp_path / "attempts.csv", each_frame)
    assert at == len(steps)
    assert seen[-1].q[0] > 0.01
    assert not pygame.display.get_init()
    run = replay.run_of_log(BROKK_170, tmp_path / "run.log", (1, 2, 3))
    assert not run.u[-1].any()  # the last frame was neutral
    assert run.u[:, 0].max() >= 40 / 127


@pytest.mark.parametrize("interface", ["", "virtual"])
def test_play__reaches_no_bus_without_a_window(interface, monkeypatch, tmp_path):
    pygame.display.quit()
    monkeypatch.setenv("SDL_VIDEODRIVER", "nonsense")
    options = BusOptions(interface, "empty", log=tmp_path / "run.log")
    with pytest.raises(ValueError, match="window: expected a display"):
        play.play(BROKK_170, {}, options, tmp_path / "none")
    with pytest.raises(ValueError, match="window: expected a display"):
        play.watch(BROKK_170, options)
    assert not list(tmp_path.iterdir())


def test_play__ends_with_the_reason_of_a_loop_that_cannot_begin(tmp_path):
    options = BusOptions("virtual", "empty")  # nobody answers
    with pytest.raises(ValueError, match="got node 1: object 0x6501"):
        play.play(BROKK_170, {}, options, tmp_path / "attempts.csv")


def test_watch__shows_another_programs_drive_and_sends_nothing():
    def operator(driving, ready):
        return OperatorInput((0.1, 0, 0) if driving else (0, 0, 0), ready)

    world = World(ConstantCommand(60, 0, 60, 60, 60), operator)
    frames = []
    world.upward = world.downward = recording(frames)
    world.drive.begin()
    world.run(1.5)
    world.close()
    peer = can.Bus("watched", interface="virtual")
    seen = []

    def each_frame(session, handler):
        for can_id, data in frames[:40]:
            peer.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))
        if session.telemetry is not None:
            seen.append(session.telemetry)
        more = bool(frames)
        del frames[:40]
        post_key("space")
        return more

    play.watch(BROKK_170, BusOptions("virtual", "watched"), each_frame)
    assert peer.recv(0.1) is None
    peer.shutdown()
    assert seen[-1].driving
    assert seen[-1].q_dot[0] > 0.05
    np.testing.assert_allclose(seen[-1].u[0] * 127, 60)
