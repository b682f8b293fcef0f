"""The window without a display: what it shows, whom it hears, and the whole of it in real time."""

from contextlib import closing

import can
import numpy as np
import pygame
import pytest
from helpers_bus import BASELINE, START, ConstantCommand, World, recording
from helpers_viewer import post, post_key, telemetry, tool

from brokk_min.can.canopen import OperatorInput
from brokk_min.can.safety_gate import Fault
from brokk_min.machine import BROKK_170
from brokk_min.viewer import drawing, play, replay
from brokk_min.viewer.control_process import BusOptions
from brokk_min.viewer.play import Session
from brokk_min.viewer.window import Window

CONTROLLERS = {"rl": ConstantCommand(), "jacobian": ConstantCommand()}


@pytest.fixture
def session(tmp_path):
    return Session(BROKK_170, CONTROLLERS, tmp_path / "attempts.csv")


def test_scene__interpolates_between_two_ticks_and_keeps_the_last_pose(session):
    q = np.array(START)
    scene = session.scene(0.0, "rl", "starting")
    assert np.isnan(scene.q).all()
    assert not scene.q_dot.any()
    assert not scene.u.any()
    assert (scene.banner, scene.status_colour) == ("starting", drawing.WARNING)
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
        assert scene.colour == drawing.COLOURS["rl"]
    np.testing.assert_allclose(scene.trail, [tool(q), tool(q + 0.02)])
    late = session.scene(1.56, "rl", "")
    np.testing.assert_array_equal(late.q, q + 0.02)
    assert not late.q_dot.any()
    assert (late.colour, late.status) == (drawing.TRACK, "no telemetry")
    assert late.banner == "No telemetry: the pose is the last known one."


def test_scene__greys_the_last_pose_and_says_why_a_position_is_missing(session):
    session.update(telemetry(0), 1.0)
    malformed = 1 + Fault.MALFORMED * 6  # of q1, among five joints and the valve controller
    lost = telemetry(1, np.full(5, np.nan), active_fault=malformed, driving=False)
    session.update(lost, 1.05)
    scene = session.scene(1.06, "rl", "ready")
    np.testing.assert_array_equal(scene.q, START)
    assert (scene.colour, scene.status) == (drawing.TRACK, "waiting")
    assert scene.banner.startswith("q1: doubled or malformed position. It sent two positions")
    session.update(telemetry(2, latched_fault=malformed, driving=False), 1.1)
    scene = session.scene(1.11, "rl", "ready")
    assert (scene.colour, scene.status) == (drawing.COLOURS["rl"], "stopped")
    assert scene.banner.endswith("Over now: release SPACE, then press it again.")


def test_scene__keeps_its_zoom_and_the_distance_from_the_line_until_the_next_line(session):
    session.update(telemetry(), 0.0)
    assert not len(session.scene(0.0, "rl", "").in_view)
    session.lines["rectangle"] = np.array([[0.0, 0, 0], [0, 0.05, 0]])
    session.next_task()
    radius = np.hypot(*tool(START)[:2])
    for tick, y in enumerate((0.0, 0.05)):
        q = (np.arcsin(y / radius), *START[1:])
        session.update(telemetry(tick, q, u=np.full(5, 0.5)), 0.05 * tick)
    assert session.finished
    scene = session.scene(0.06, "rl", "")
    np.testing.assert_allclose(scene.in_view.min(axis=0)[1], 0.0, atol=1e-9)
    np.testing.assert_allclose(scene.in_view.max(axis=0)[1], 0.05)
    off = radius - np.sqrt(radius**2 - 0.05**2)  # the tool moves on a circle
    assert scene.headline == f"{1e3 * off:.0f} mm from the line, at most {1e3 * off:.0f} mm"
    session.update(telemetry(2, (0.5, *START[1:])), 0.1)
    wider = session.scene(0.16, "rl", "").in_view
    assert wider[:, 1].max() == pytest.approx(tool((0.5, *START[1:]))[1])
    session.update(telemetry(3), 0.15)
    np.testing.assert_allclose(session.scene(0.21, "rl", "").in_view, wider)  # it does not shrink


def test_compare__lays_the_traces_of_all_controllers_over_each_other(session):
    session.update(telemetry(driving=False), 0.0)
    session.next_task("compare")
    assert session.comparison is None  # on a bus the window shows the machine alone
    session.simulated = True
    session.controllers = {"jacobian": BASELINE, "rl": ConstantCommand(0, 0, 0, 0, 0)}
    session.lines["rectangle"] = np.array([[0.0, 0, 0], [0, 0.3, 0]])
    session.next_task("compare")
    for tick in range(120):
        session.update(telemetry(tick, driving=False), 0.05 * tick)
    moved, stood = session.scene(5.96, "rl", "ready").traces
    assert moved.trail[-1][1] == pytest.approx(0.3, abs=0.05)
    np.testing.assert_array_equal(moved.trail[-1], moved.trail[-10])  # it has arrived
    np.testing.assert_allclose(stood.trail, np.tile(tool(START), (len(stood.trail), 1)), atol=1e-9)
    assert moved.text.startswith("PID with DLS (the paper's): ")
    assert stood.text == "RL policy: 0 mm, at most 0 mm"
    session.update(telemetry(121), 6.0)
    assert session.comparison is None  # who drives sees the machine


def test_session__begins_a_line_again_when_the_mode_changes_on_the_way(session):
    session.update(telemetry(), 0.0)
    session.next_task("again")
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


def test_show__sends_requests_once_there_is_telemetry_and_takes_keys_frame_by_frame(session):
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
        play.show(window, session, lambda: frames.pop(0), sent.append, each_frame)
    assert [task for task, _ in tasks] == ["", "", "", "rectangle", "circle", "circle"]
    assert tasks[5][1] is not tasks[4][1]  # begun again
    assert [request.mode for request in sent] == [0, 0, 0, 1]  # not in the first frame
    assert session.previous is not None
    assert session.previous.tick == 3


def test_play__drives_a_simulated_machine_in_lockstep(tmp_path):
    """Keys, the loop, the plant behind its bus; then loss of focus, and closing."""
    seen = []
    steps = [
        (lambda t: t.active_fault == 0, pygame.KEYDOWN, {"key": pygame.K_SPACE}),
        (lambda t: t.driving, pygame.KEYDOWN, {"key": pygame.K_q}),
        (lambda t: bool(t.q_dot[0] > 0.1), pygame.WINDOWFOCUSLOST, {}),
        (lambda t: not t.driving and not t.u.any(), pygame.WINDOWFOCUSGAINED, {}),
        (lambda t: True, pygame.QUIT, {}),
    ]

    def each_frame(session, handler):
        if session.telemetry is not None and steps:
            seen.append(session.telemetry)
            condition, kind, event = steps[0]
            if condition(session.telemetry):
                post(kind, **event)
                steps.pop(0)
        return len(seen) < 3600

    options = BusOptions(log=tmp_path / "run.log")
    play.play(BROKK_170, {}, options, tmp_path / "attempts.csv", each_frame)
    assert not steps
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
        play.play(BROKK_170, None, options, tmp_path / "none")
    assert not list(tmp_path.iterdir())


def test_play__ends_with_the_reason_of_a_loop_that_cannot_begin(tmp_path):
    options = BusOptions("virtual", "empty")  # nobody answers
    with pytest.raises(ValueError, match="got node 1: object 0x6501"):
        play.play(BROKK_170, {}, options, tmp_path / "attempts.csv")


def test_watch__shows_another_programs_drive_and_sends_nothing(tmp_path):
    def operator(driving, ready):
        return OperatorInput((0.1, 0, 0) if driving else (0, 0, 0), ready)

    world = World(ConstantCommand(60, 0, 60, 60, 60), operator)
    frames = []
    world.upward = world.downward = recording(frames)
    world.drive.begin()
    world.run(1.5)
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

    play.play(BROKK_170, None, BusOptions("virtual", "watched"), tmp_path / "none", each_frame)
    assert peer.recv(0.1) is None
    peer.shutdown()
    assert seen[-1].driving
    assert seen[-1].q_dot[0] > 0.05
    np.testing.assert_allclose(seen[-1].u[0] * 127, 60)
