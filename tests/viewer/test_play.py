"""The window and what is behind it, without a display: hands, loop, lines to trace, recorded runs."""

from __future__ import annotations

import json
import os
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import can
import numpy as np
import pygame
import pytest
from helpers_bus import BASELINE, START, Push, Virtual, World
from PIL import Image
from test_drawing import boxes_of_words

from benchmarks.bus import random_policy
from brokk_min.__main__ import main
from brokk_min.can import drive_log
from brokk_min.can.canopen import (
    OPERATOR_CHANNEL,
    OPERATOR_INPUT,
    SYNC,
    TPDO1,
    Frame,
    OperatorInput,
    encoder_raw,
)
from brokk_min.can.drive_log import Telemetry
from brokk_min.cli.options import find_machine
from brokk_min.evaluation import baselines
from brokk_min.evaluation.sequences import feasible
from brokk_min.kinematics import forward_kinematics, tool_position
from brokk_min.learning.policy import save_policy
from brokk_min.machine import BROKK_170
from brokk_min.viewer import control_process, play, replay, tracing
from brokk_min.viewer import drawing as view
from brokk_min.viewer.control_process import Chosen, Levers, Loop, Mailbox, Remote
from brokk_min.viewer.play import InputHandler, Session
from brokk_min.viewer.tracing import Attempt, Tracing

MODES = ["rl", "jacobian", "levers"]
MINI_EXCAVATOR = find_machine(
    f"{Path(__file__).parents[2]}/examples/mini_excavator.py:MINI_EXCAVATOR"
)


@pytest.fixture(autouse=True)
def no_display(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pygame.display.init()
    pygame.event.clear()
    yield
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pygame.display.init()
    pygame.event.clear()


# --- hands --------------------------------------------------------------------------------------------


class Operator:
    """Presses keys of `InputHandler` through pygame's queue; time goes on by half a second a look."""

    def __init__(self, modes: list[str] = MODES) -> None:
        pygame.display.set_mode((10, 10))
        pygame.event.clear()
        self.hands, self.now = InputHandler(BROKK_170, pygame, modes), 0.0
        self.look()

    def look(self, seconds: float = 0.5) -> control_process.Ask:
        for event in pygame.event.get():
            self.hands.hear(event)
        self.now += seconds
        return self.hands.ask(self.now, seconds)

    def key(self, name: str, down: bool = True, seconds: float = 0.5) -> control_process.Ask:
        kind = pygame.KEYDOWN if down else pygame.KEYUP
        pygame.event.post(pygame.event.Event(kind, key=pygame.key.key_code(name)))
        return self.look(seconds)

    def event(self, kind: int, **more: Any) -> control_process.Ask:
        pygame.event.post(pygame.event.Event(kind, **more))
        return self.look()


@pytest.mark.parametrize(
    ("keys", "way"),
    [
        ("up", (1, 0, 0)),
        ("down", (-1, 0, 0)),
        ("left", (0, 1, 0)),
        ("right", (0, -1, 0)),
        ("w", (0, 0, 1)),
        ("s", (0, 0, -1)),
        ("up left", (0.5**0.5, 0.5**0.5, 0)),
        ("w s", (0, 0, 0)),
    ],
)
def test_keys_ask_for_velocities_of_at_most_tool_speed(keys: str, way: tuple[float, ...]) -> None:
    operator = Operator()
    ask = [operator.key(key) for key in keys.split()][-1]
    np.testing.assert_allclose(ask.v_goal, 0.3 * np.array(way), atol=1e-12)
    assert not ask.enable and not ask.levers.any()
    ask = [operator.key(key, down=False) for key in keys.split()][-1]
    assert not ask.v_goal.any()  # let go: neutral at once


def test_a_key_deflects_little_by_little_and_shift_by_a_third() -> None:
    operator = Operator()
    assert operator.key("up", seconds=0.05).v_goal[0] == pytest.approx(
        0.3 * 0.2
    )  # full after 0.25 s
    assert operator.look(0.05).v_goal[0] == pytest.approx(0.3 * 0.4)
    assert operator.look(1.0).v_goal[0] == pytest.approx(0.3)
    assert operator.key("left shift").v_goal[0] == pytest.approx(0.1)


def test_the_other_way_begins_in_the_middle_and_let_go_is_neutral_at_once() -> None:
    operator = Operator()
    assert operator.key("down", seconds=0.05).v_goal[0] == pytest.approx(-0.3 * 0.2)
    assert operator.key("down", False, seconds=0.01).v_goal[0] == 0
    operator.key("up")
    pygame.event.post(pygame.event.Event(pygame.KEYUP, key=pygame.K_UP))
    assert operator.key("down", seconds=0.05).v_goal[0] == pytest.approx(
        -0.3 * 0.2
    )  # in one picture


def test_the_first_picture_asks_for_nothing() -> None:
    ask = InputHandler(BROKK_170, pygame, MODES).ask(7.0, 0.0)
    assert ask[:5] == (7.0, 0, False, True, False)
    assert ask.v_goal.tolist() == [0] * 3 and ask.levers.tolist() == [0] * 4


def test_keys_and_a_gamepad_of_few_axes_deflect_no_further_together() -> None:
    operator, axes = Operator(["levers"]), [-1.0, -1.0, 0.0, -1.0]  # of PAD_AXES 1, 0, 4, 3: not 4
    operator.hands.pad = SimpleNamespace(
        get_numaxes=lambda: 4, get_axis=axes.__getitem__, get_numbuttons=lambda: play.PAD_BUTTON,
        get_button=lambda i: 1,
    )  # fmt: skip
    assert operator.key("q").levers.tolist() == [1, 1, 1, 0]  # and it has no dead-man switch
    axes[:] = [1.0, 1.0, 0.0, 0.0]
    operator.key("q", False)
    ask = operator.key("a")
    assert ask.levers.tolist() == [-1, -1, 0, 0] and not ask.enable


def test_keys_want_the_next_line_or_the_same_again_until_it_is_there() -> None:
    operator = Operator()
    for key, task in (("return", "next"), ("up", "next"), ("backspace", "again"), ("up", "again")):
        operator.key(key)
        assert operator.hands.task_wanted == task
    operator.event(pygame.JOYBUTTONDOWN, button=9)
    assert operator.hands.task_wanted == "again"


def test_the_switch_counts_only_if_pressed_with_nothing_deflected() -> None:
    operator = Operator()
    assert operator.key("space").enable
    assert operator.key("up").enable  # deflecting later is driving
    operator.key("space", False)
    assert not operator.key("space").enable
    assert not operator.key("up", False).enable  # centring does not make up for it
    operator.key("space", False)
    assert operator.key("space").enable


@pytest.mark.parametrize("loss", ["focus", "mode"])
def test_focus_lost_and_another_translator_need_a_fresh_press(loss: str) -> None:
    operator = Operator()
    operator.key("space")
    assert operator.key("up").enable
    if loss == "focus":
        ask = operator.event(pygame.WINDOWFOCUSLOST)
        assert not ask.enable and not ask.v_goal.any() and ask.alive
        assert not operator.key("space").enable  # keys that come without focus do not count
        assert not operator.event(pygame.WINDOWFOCUSGAINED).enable
    else:
        ask = operator.key("tab")
        assert not ask.enable and ask.mode == 1
        operator.key("up", False)
        assert not operator.look().enable  # still held
    operator.key("space", False)
    assert operator.key("space").enable


def test_each_lever_is_one_joint_and_the_translators_go_round() -> None:
    operator = Operator()
    operator.key("tab")
    operator.key("tab")
    for i, (plus, minus) in enumerate(play.LEVER_KEYS[:4]):
        ask = operator.key(plus)
        np.testing.assert_array_equal(ask.levers, np.eye(4)[i])
        assert ask.mode == 2 and not ask.v_goal.any()
        operator.key(plus, False)
        np.testing.assert_array_equal(operator.key(minus).levers, -np.eye(4)[i])
        operator.key(minus, False)
    assert operator.key("tab").mode == 0


def test_closing_asks_to_stop() -> None:
    assert Operator().event(pygame.QUIT).stop and Operator().key("escape").stop


def test_a_gamepad_drives_and_its_removal_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(
        "SDL_JOYSTICK_ALLOW_BACKGROUND_EVENTS", "1"
    )  # a dummy window never has the focus
    pygame.joystick.quit()
    operator = Operator()
    device = Virtual()
    operator.look()
    device.button(play.PAD_BUTTON, True)
    assert operator.look().enable
    device.axis(1, -1.0)
    device.axis(4, 1.0)
    ask = operator.look()
    np.testing.assert_allclose(ask.v_goal, 0.3 * np.array([1, 0, -1]) / 2**0.5, atol=1e-6)
    device.button(play.PAD_MODE, True)
    ask = operator.look()
    assert ask.mode == 1 and not ask.enable
    device.button(play.PAD_BUTTON, False)
    device.axis(1, 0.0)
    device.axis(4, 0.0)
    operator.look()
    device.button(play.PAD_BUTTON, True)
    assert operator.look().enable
    device.unplug()
    ask = operator.look()
    assert not ask.alive and not ask.enable and not ask.v_goal.any()
    assert operator.key("space").alive  # the keyboard takes over, with a press of its own
    operator.key("space", False)
    assert operator.key("space").enable


def test_a_gamepad_that_comes_needs_a_fresh_press_and_its_triggers_are_no_levers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("SDL_JOYSTICK_ALLOW_BACKGROUND_EVENTS", "1")
    machine = replace(
        BROKK_170,
        joints=tuple(replace(joint, driven=True, q_dot_up=0.2) for joint in BROKK_170.joints),
    )
    device = Virtual()
    device.button(play.PAD_BUTTON, True)
    device.axis(2, -1.0)  # as a trigger rests
    device.axis(5, -1.0)
    pygame.display.set_mode((10, 10))
    operator = Operator(["levers"])
    operator.hands = InputHandler(machine, pygame, ["levers"])  # it was there before the window
    ask = operator.look()
    assert operator.hands.pad is not None and not ask.levers.any() and not ask.enable
    device.button(play.PAD_BUTTON, False)
    operator.look()
    device.unplug()
    assert not operator.look().alive
    device = Virtual()
    device.button(play.PAD_BUTTON, True)
    assert not operator.look().enable  # held while it came
    device.button(play.PAD_BUTTON, False)
    operator.look()
    device.button(play.PAD_BUTTON, True)
    assert operator.look().enable
    for button, task in ((play.PAD_NEXT, "next"), (play.PAD_AGAIN, "again")):
        device.button(button, True)
        operator.look()
        assert operator.hands.task_wanted == task
    device.unplug()
    operator.look()


# --- between window and loop --------------------------------------------------------------------------


def test_a_mailbox_gives_the_newest_values_or_none() -> None:
    box = Mailbox(3)
    assert box.read() is None
    box.write([1.0, 2.0, 3.0])
    box.write([4.0, 5.0, 6.0])
    np.testing.assert_array_equal(box.read(), [4.0, 5.0, 6.0])
    np.frombuffer(box.raw)[-1] += 1  # as it is while the next values are being written
    assert box.read() is None
    first = Mailbox(2)
    first.write([-1.0, 0.0])
    np.testing.assert_array_equal(first.read(), [-1.0, 0.0])


def test_what_is_known_survives_the_mailbox() -> None:
    rng = np.random.default_rng(0)
    known = Telemetry(7, *rng.normal(size=(3, 5)), rng.normal(size=3), True, 3, 4, 2, 0.001)
    back = drive_log.unpack_telemetry(BROKK_170, known.pack())
    assert back._replace(q=0, q_dot=0, u=0, v_goal=0) == known._replace(q=0, q_dot=0, u=0, v_goal=0)
    for name in ("q", "q_dot", "u", "v_goal"):
        np.testing.assert_array_equal(getattr(back, name), getattr(known, name))


def test_ticks_of_a_bus_by_hand() -> None:
    """Angles are known once every encoder spoke; goals count while driving; other frames say nothing."""
    heard = drive_log.TelemetryReader(BROKK_170)
    wish, nonsense = (
        OperatorInput((0.1, 0.0, -0.2), enable=True).pack(),
        bytes([80, 0, 0, 0, 0, 0, 0, 1]),
    )
    assert heard.update(Frame(0.0, OPERATOR_INPUT, wish, channel=OPERATOR_CHANNEL)) is None
    assert (
        heard.update(
            Frame(0.0, OPERATOR_INPUT, OperatorInput((0.3, 0.0, 0.0)).pack(), channel="can0")
        )
        is None
    )
    heard.update(Frame(0.0, BROKK_170.valve_frame_id + 1, nonsense))
    heard.update(Frame(0.0, BROKK_170.valve_frame_id, nonsense[:7]))
    first = heard.update(Frame(0.0, SYNC, b""))
    assert first is not None and (first.tick, first.driving) == (0, False)
    assert np.isnan(first.q).all() and np.isnan(first.q_dot).all()
    assert not first.u.any() and not first.v_goal.any()
    heard.update(Frame(0.05, BROKK_170.valve_frame_id, nonsense))
    for tick, q1 in ((1, 0.0), (2, 0.1)):
        angles = np.array([q1, *START[1:]])
        raw = encoder_raw(BROKK_170, np.rint(angles / BROKK_170.encoder_step).astype(int))
        for joint, count in zip(BROKK_170.joints, raw.tolist(), strict=True):
            heard.update(Frame(0.05, TPDO1 + joint.encoder_node, struct.pack("<I", count)))
        known = heard.update(Frame(0.05, SYNC, b""))
        assert known is not None and (known.tick, known.driving) == (tick, True)
        np.testing.assert_allclose(known.q, angles, atol=BROKK_170.encoder_step / 2)
        np.testing.assert_array_equal(known.v_goal, [0.1, 0.0, -0.2])
        np.testing.assert_allclose(known.u * 127, [80, 0, 0, 0, 0], atol=1e-9)
    # 0.1 rad in the last of four samples: the slope of a line through them is 0.3 of it a sample
    np.testing.assert_allclose(known.q_dot, [0.3 * 0.1 * 20, 0, 0, 0, 0], atol=0.3 * 20 * 1e-3)


def test_levers_are_repeated_for_each_observation_and_another_translator_starts_as_many() -> None:
    levers, begun = Levers(BROKK_170), []
    levers.levers = np.array([1.0, 0.0, -1.0, 0.0])
    u, _ = levers(np.zeros((3, 7)), None)
    np.testing.assert_allclose(u * 127, np.tile([80, 0, 0, -80, 0], (3, 1)), atol=1e-9)
    push = SimpleNamespace(start=begun.append)
    chosen = Chosen([levers, lambda seen, memory: (seen, memory)])
    memory = chosen.start(3)
    assert memory == (0, None) and chosen(np.zeros((3, 7)), memory)[1] == (0, None)
    chosen.controllers[1].start = push.start  # type: ignore[attr-defined]
    chosen.mode = 1
    assert chosen(np.ones((3, 7)), memory)[1] == (1, None) and begun == [3]


class Remoted:
    """The loop behind mailboxes on a bus with an injected clock."""

    def __init__(self, *controllers: Any, log: Any = None) -> None:
        levers = Levers(BROKK_170)
        self.asks, self.chosen = Mailbox(12), Chosen([*controllers, levers])
        self.world = World(
            self.chosen, Remote(self.asks, self.chosen, levers, lambda: self.world.t), log=log
        )
        self.world.drive.__class__ = Loop
        self.known: list[Telemetry] = []
        self.world.drive.tell = self.known.append  # type: ignore[attr-defined]
        self.ask(False)
        self.world.drive.begin()

    def ask(
        self, enable: bool, v: Any = (0, 0, 0), mode: int = 0, levers: Any = (0, 0, 0, 0)
    ) -> None:
        self.asks.write([self.world.t, mode, enable, 1, 0, *v, *levers])

    def go(self, seconds: float, enable: bool, v: Any = (0, 0, 0), **more: Any) -> None:
        end = self.world.t + seconds
        while self.world.t < end - 1e-9:
            self.ask(enable, v, **more)
            self.world.run(0.04)


def test_levers_pass_the_gate_one_joint_each() -> None:
    loop = Remoted(Push(60, 0, 0, 0, 0))
    loop.go(0.5, False, mode=1)
    loop.go(0.2, True, mode=1)
    assert loop.known[-1].driving and loop.known[-1].mode == 1
    loop.go(0.6, True, mode=1, levers=(0, 0, -1, 0))
    np.testing.assert_allclose(loop.known[-1].u * 127, [0, 0, 0, -80, 0], atol=1e-9)
    assert loop.known[-1].q_dot[3] < -0.1 and abs(loop.known[-1].q_dot[0]) < 1e-3
    loop.go(0.1, True, mode=0)
    np.testing.assert_allclose(
        loop.known[-1].u * 127, [60, 0, 0, 0, 0], atol=1e-9
    )  # another translates
    loop.go(0.1, False)
    assert not loop.known[-1].driving and not loop.known[-1].u.any()
    loop.world.close()


def test_a_window_that_hangs_is_a_lost_device() -> None:
    loop = Remoted(Push(60, 0, 0, 0, 0))
    loop.go(0.5, False)
    loop.go(0.4, True)
    assert loop.known[-1].driving
    last = loop.world.t
    loop.world.run(0.5)
    times, commands = loop.world.commands
    late = times[(commands != 0).any(axis=1)].max() - last
    assert 0.1 < late <= control_process.STALE + 0.06
    assert "operator's device lost" in play._status(BROKK_170, loop.known[-1], "")[0]
    loop.go(0.5, True)
    assert not loop.known[-1].driving  # back again, but the switch was never released
    loop.go(0.1, False)
    loop.go(0.1, True)
    assert loop.known[-1].driving
    loop.world.close()


def test_a_loop_whose_window_died_stops(monkeypatch: pytest.MonkeyPatch) -> None:
    asks, levers = Mailbox(12), Levers(BROKK_170)
    operator = Remote(asks, Chosen([levers]), levers, lambda: 10.0)
    assert operator(False, True) == OperatorInput(alive=False)  # it has not said anything yet
    monkeypatch.setattr(
        control_process.multiprocessing,
        "parent_process",
        lambda: SimpleNamespace(is_alive=lambda: False),
    )
    assert operator(True, True) == OperatorInput(alive=False, stop=True)
    asks.write([9.9, 0, 1, 1, 0, 0.1, 0, 0, 0, 0, 0, 0])
    assert operator(True, True) == OperatorInput((0.1, 0.0, 0.0), enable=True)
    asks.write([10.0, 0, 0, 1, 1, 0, 0, 0, 0, 0, 0, 0])
    assert operator(True, True) == OperatorInput(stop=True)


def test_the_loops_process_drives_a_machine_of_its_own_until_it_is_told_to_stop(
    tmp_path: Path,
) -> None:
    """In this process: the window asks to stop at once; what the loop knew of its tick and the log remain."""
    asks, tells, said = Mailbox(12), Mailbox(24), list[str]()
    asks.write([time.monotonic() + 100, 1, 0, 1, 1, 0.1, 0, 0, 0, 0, 0, 0])
    where = control_process.BusOptions(log=tmp_path / "run.log", start=tuple(START))
    modes: list[int] = []
    push = SimpleNamespace(start=modes.append)
    control_process.control(BROKK_170, [push], where, asks, tells)
    told = tells.read()
    assert told is not None and (tmp_path / "run.log").stat().st_size > 0
    known = drive_log.unpack_telemetry(BROKK_170, told)
    np.testing.assert_allclose(known.q, START, atol=BROKK_170.encoder_step)
    assert known.mode == 1 and not known.driving and known.v_goal.tolist() == [0.1, 0, 0]
    assert not [thread for thread in threading.enumerate() if "serve" in thread.name]
    pipe = SimpleNamespace(send=said.append)
    control_process._control_process(
        pipe, BROKK_170, [], control_process.BusOptions("nonsense", "bus"), asks, tells
    )
    control_process._control_process(pipe, None, [], where, asks, tells)
    assert said[0].startswith("nonsense bus: expected a CAN bus") and said[1].startswith(
        "AttributeError: "
    )


def test_a_whole_traced_rectangle_is_scored() -> None:
    """An operator who steers to the next point of the line; the figures against sums of their own."""
    loop = Remoted(BASELINE)
    loop.go(0.4, False)
    session = Session(BROKK_170, ["jacobian", "levers"], None)
    session.take(loop.known[-1], 0.0)
    session.next_task()
    tracing_, first = session.tracing, loop.known[-1].q
    assert tracing_ is not None and session.task == "rectangle"
    np.testing.assert_allclose(
        tracing_.line[0], tool_position(forward_kinematics(BROKK_170, first))
    )
    loop.go(0.2, True)
    rows: list[Telemetry] = []
    while not session.attempts and loop.world.t < 60:
        away = tracing_.line[min(tracing_.passed + 2, len(tracing_.line) - 1)] - tool_position(
            forward_kinematics(BROKK_170, loop.known[-1].q)
        )
        loop.go(0.04, True, 0.2 * away / max(np.linalg.norm(away), 0.05))
        session.take(loop.known[-1], loop.world.t)
        rows.append(loop.known[-1])
    loop.world.close()
    (attempt,) = session.attempts
    begun = next(i for i, k in enumerate(rows) if k.u.any())
    assert attempt.seconds == pytest.approx((len(rows) - begun) / 20)
    corners = (
        tracing_.line[0]
        + 5.0
        * np.array([[0, 0, 0], [0, 0.16, 0], [0.1, 0.16, 0], [0.1, 0, 0]])
        * view.extent(BROKK_170).reach
        / 5.0
    )
    fine = np.vstack(
        [
            a + np.linspace(0, 1, 500)[:, None] * (b - a)
            for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)
        ]
    )
    p = tool_position(forward_kinematics(BROKK_170, np.array([k.q for k in rows[begun:]])))
    away = np.linalg.norm(p[:, None] - fine, axis=-1).min(axis=1)
    assert attempt.mean == pytest.approx(away.mean(), abs=1e-3) and attempt.max == pytest.approx(
        away.max(), abs=1e-3
    )
    assert 0.005 < attempt.mean < 0.06 and 10 < attempt.seconds < 40
    u = np.array([0 * rows[0].u, *(k.u for k in rows[begun:])])
    assert attempt.valve_travel == pytest.approx(np.abs(np.diff(u, axis=0)).sum())
    assert attempt.mode == "jacobian" and session.tracing is None
    said = session.notes("levers")[-2:]
    assert (
        session.scene(0.0, "levers", "").path == tracing_.line
    ).all()  # to be seen beside the trail
    assert said[0].startswith("rectangle by jacobian: ") and said[1].startswith(
        "mean of 1 by jacobian: "
    )


# --- lines to trace -----------------------------------------------------------------------------------


def test_distance_by_hand() -> None:
    line = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0]])
    p = np.array([[0.5, 0.0, 0.2], [-3.0, 4.0, 0.0], [1.2, 0.5, 0.0], [1.0, 1.0, 0.0]])
    np.testing.assert_allclose(tracing.distance(line, p), [0.2, 5.0, 0.2, 0.0], atol=1e-12)


def test_lines_to_trace_by_hand() -> None:
    """In shares of the reach: a rectangle of 0.1 by 0.16, a circle of radius 0.06, axes of 0.14."""
    lines, reach = tracing.task_lines(BROKK_170), view.extent(BROKK_170).reach
    assert list(lines) == ["rectangle", "circle", "line x", "line y", "line z"]
    square = lines["rectangle"] / reach
    assert np.diff(square, axis=0).any(axis=1).all()
    corners = square[
        [0, *(np.flatnonzero(np.abs(np.diff(square, n=2, axis=0)).max(axis=1) > 1e-9) + 1), -1]
    ]
    np.testing.assert_allclose(
        corners, [[0, 0, 0], [0, 0.16, 0], [0.1, 0.16, 0], [0.1, 0, 0], [0, 0, 0]], atol=1e-9
    )
    circle = lines["circle"] / reach
    np.testing.assert_allclose(np.hypot(circle[:, 0], circle[:, 2] - 0.06), 0.06, atol=1e-9)
    assert not circle[:, 1].any() and len(circle) == 60 and abs(circle[-1]).max() < 1e-9
    assert circle[15, 0] > 0.059 and circle[30, 2] > 0.119  # outward, then up
    for i, axis in enumerate("xyz"):
        np.testing.assert_allclose(lines[f"line {axis}"][-1], 0.14 * reach * np.eye(3)[i])
        steps = np.diff(lines[f"line {axis}"], axis=0)[:, i]
        np.testing.assert_allclose(steps, 0.14 * reach / np.ceil(0.14 * reach / 0.05))


@pytest.mark.parametrize("task", list(tracing.task_lines(BROKK_170)))
def test_every_line_can_be_traced_from_the_start(task: str) -> None:
    line = tracing.task_lines(BROKK_170)[task]
    steps = np.diff(line, axis=0)
    assert not line[0].any() and np.linalg.norm(steps, axis=1).max() < tracing.SPACING + 1e-9
    goals = np.repeat(steps, 20, axis=0)[:, None]  # 20 ticks of 0.05 s a step: a step a second
    assert feasible(BROKK_170, np.array([START]), goals).all()


def test_attempts_are_kept_and_tabled(tmp_path: Path) -> None:
    path = tmp_path / "attempts.csv"
    assert tracing.read_attempts(path) == []
    rows = [
        Attempt("2026-01-01T00:00:00", "circle", "rl", 10.0 + i, 0.01, 0.02, 5.0) for i in range(2)
    ]
    rows.append(Attempt("2026-01-01T00:00:00", "circle", "levers", 40.0, 0.05, 0.1, 9.5))
    tracing.write_attempts(path, rows)
    assert path.read_text().splitlines()[0] == "when,task,mode,seconds,mean,max,valve_travel"
    assert tracing.read_attempts(path) == rows
    tracing.write_attempts(path, [rows[0]._replace(mean=1 / 3, valve_travel=123456.789)])
    last = b"2026-01-01T00:00:00,circle,rl,10,0.333333,0.02,123457\n"
    assert path.read_bytes().endswith(b"valve_travel\n" + last)
    tracing.write_attempts(path, rows)
    assert tracing.attempts_table(rows, "circle") == [
        "mean of 2 by rl: 10.5 s, off by 0.010 m, at most 0.020 m, valves 5",
        "mean of 1 by levers: 40.0 s, off by 0.050 m, at most 0.100 m, valves 10",
    ]
    assert tracing.attempts_table(rows, "rectangle") == []
    path.write_text("a,b\n1,2\n")
    with pytest.raises(ValueError, match=r"attempts.csv: row 1: expected a column when"):
        tracing.read_attempts(path)


def test_the_same_line_again_by_another_translator() -> None:
    """Changing who translates begins the line again; before the first opened valve it changes nothing."""
    session = Session(BROKK_170, MODES, None)
    rest = Telemetry(0, np.array(START), *np.zeros((2, 5)), np.zeros(3), True)
    session.take(rest, 0.0)
    session.next_task(again=True)
    first = session.tracing
    assert first is not None and session.task == "rectangle"  # nothing to repeat yet
    session.take(rest._replace(mode=1), 0.0)
    assert session.tracing is first
    open_ = np.full(5, 0.5)
    session.take(rest._replace(mode=1, u=open_), 0.0)
    session.take(rest._replace(mode=2, u=open_), 0.0)
    assert session.tracing is not first and session.task == "rectangle"
    assert session.tracing is not None and len(session.tracing.p) == 1
    session.take(rest._replace(mode=2), 0.0)
    session.next_task()
    assert session.task == "circle"


def test_the_tool_stays_in_view_however_far_off_the_line() -> None:
    session = Session(BROKK_170, MODES, None)
    rest = Telemetry(0, np.array(START), *np.zeros((2, 5)), np.zeros(3), True)
    session.take(rest, 0.0)
    session.next_task()
    far = np.array([-1.5, *START[1:]])
    session.take(rest._replace(q=far), 1.0)
    shapes = view.draw(BROKK_170, [session.scene(1.2, "levers", "")], play.SIZE)
    clips = [s.box for s in shapes if isinstance(s, view.Clip)][:2]
    dots = [s.centre for s in shapes if isinstance(s, view.Circle) and s.colour == view.INK]
    assert len(dots) == 2
    for (left, upper, width, height), dot in zip(clips, dots, strict=True):
        assert left < dot[0] < left + width and upper < dot[1] < upper + height


@pytest.mark.parametrize("mode", [*MODES, ""])
def test_what_the_window_says_fits_and_tells_how_it_went(mode: str) -> None:
    for machine in (BROKK_170, MINI_EXCAVATOR):
        session = Session(machine, MODES, None)
        q = (machine.column("q_min") + machine.column("q_max")) / 2
        session.take(Telemetry(0, q, *np.zeros((2, machine.n)), np.zeros(3), True), 0.0)
        session.next_task()
        session.attempts = [
            Attempt("", "rectangle", mode, 123.4, 0.123, 0.456, 123.0) for mode in MODES
        ]
        for tracing_ in (session.tracing, None):
            session.tracing, session.done = tracing_, None if tracing_ else session.attempts[1]
            look = session.scene(0.1, mode, "ready: hold SPACE or button 5")
            shapes = view.draw(machine, [look], play.SIZE)
            boxes = np.array(list(boxes_of_words(shapes).values()))
            assert boxes.min() >= 0 and (boxes[:, 2:] <= play.SIZE).all()
        assert look.title == (view.TITLES[mode] if mode else machine.name)
        assert any("rectangle by jacobian: 123.4 s" in note for note in look.notes) == bool(mode)


def test_what_is_seen_is_what_was_heard_between_two_ticks_and_not_for_long() -> None:
    session, q = Session(BROKK_170, MODES, None), np.array(START)
    u, v = np.full(5, 0.1), np.array([0.1, 0.0, 0.2])
    for hint, said in (("starting", "starting"), ("", "nothing to be heard")):
        look = session.scene(0.0, "rl", hint)
        assert np.isnan(look.q).all() and np.isnan(look.q_dot).all()
        assert not look.u.any() and look.v_goal.tolist() == [0, 0, 0]
        assert (look.status, look.mood) == (said, "waiting")
    assert look.path.shape == look.trail.shape == (0, 3)
    session.take(Telemetry(0, q, 0 * q, u, v, True), 1.0)
    np.testing.assert_array_equal(session.scene(1.02, "rl", "").q, q)
    session.take(Telemetry(1, q + 0.02, 0 * q + 0.4, u, v, True), 1.05)
    for now, share in ((1.05, 0.0), (1.075, 0.5), (1.1, 1.0), (1.54, 1.0)):
        look = session.scene(now, "rl", "")
        np.testing.assert_allclose(look.q, q + share * 0.02)
        assert (
            (look.q_dot == 0.4).all()
            and look.u is not u
            and (look.u == u).all()
            and look.v_goal is v
        )
        assert (look.status, look.mood) == ("driving", "driving")
    np.testing.assert_allclose(
        look.trail, [tool_position(forward_kinematics(BROKK_170, a)) for a in (q, q + 0.02)]
    )
    late = session.scene(1.56, "rl", "")
    assert np.isnan(late.q).all() and late.status == "nothing to be heard"
    session.next_task()
    look = session.scene(1.1, "rl", "")
    tool = tool_position(forward_kinematics(BROKK_170, q + 0.02))
    np.testing.assert_allclose(look.path, tool + tracing.task_lines(BROKK_170)["rectangle"])
    np.testing.assert_array_equal(look.target, look.path[:1])
    np.testing.assert_allclose(look.hold, np.vstack([look.path, tool]))
    assert (
        session.tracing is not None and session.tracing.task == "rectangle" and not len(look.trail)
    )
    session.tracing.passed = 2
    np.testing.assert_array_equal(session.scene(1.1, "rl", "").target, look.path[2:3])
    looks_of = {mode: session.scene(1.1, mode, "") for mode in (*MODES, "")}
    colours = [look.colour for look in looks_of.values()]
    assert colours == [*view.COLOURS.values(), view.STEEL]
    assert [look.title for look in looks_of.values()] == [
        *(view.TITLES[mode] for mode in MODES),
        "brokk170",
    ]


@pytest.mark.parametrize(
    ("state", "hint", "said", "mood"),
    [
        ({"driving": True, "wrong": 1}, "a hint", "driving", "driving"),
        (
            {"wrong": 30, "fault": 1},
            "a hint",
            "waiting: valve controller: heartbeat lost",
            "waiting",
        ),
        ({"fault": 30}, "a hint", "stopped: valve controller: heartbeat lost", "waiting"),
        ({}, "hold SPACE", "hold SPACE", "ready"),
        ({}, "", "ready", "ready"),
    ],
)
def test_the_gates_state_is_said(state: dict[str, Any], hint: str, said: str, mood: str) -> None:
    known = Telemetry(0, np.array(START), *np.zeros((2, 5)), np.zeros(3), False)._replace(**state)
    assert play._status(BROKK_170, known, hint) == (said, mood)


def test_the_operator_is_told_what_to_do_next() -> None:
    session, hands = Session(BROKK_170, MODES, None), Operator().hands
    assert play._hint(session, hands) == "starting"
    session.known = Telemetry(0, np.array(START), *np.zeros((2, 5)), np.zeros(3), False)
    hands.focus, hands.blocked, hands.pad = False, True, None
    assert play._hint(session, hands) == "neutral: the window has no focus"
    hands.focus = True
    assert play._hint(session, hands) == "release the switch, then press it with nothing deflected"
    hands.blocked = False
    assert play._hint(session, hands) == "ready: hold SPACE"
    hands.pad = object()
    assert play._hint(session, hands) == "ready: hold SPACE or button 5"
    watches = Session(BROKK_170, [], None)
    assert play._hint(watches, hands) == "nobody sends SYNC: start what drives, or use --drive"
    watches.known = session.known
    assert play._hint(watches, hands) == "watching"


def test_notes_tell_keys_task_and_how_it_went(tmp_path: Path) -> None:
    session = Session(BROKK_170, MODES, tmp_path / "attempts.csv")
    assert session.notes("") == ["only listening: nothing is sent; --drive drives", "ESC: end"]
    keys = "SHIFT: slow  TAB: who translates  ENTER: next line  BACKSPACE: again  ESC: end"
    assert session.notes("rl") == ["hold SPACE to drive    arrows: x, y    W/S: up, down", keys]
    levers = "hold SPACE to drive    q/a: q1  w/s: q3  e/d: q4  r/f: q5"
    assert session.notes("levers") == [levers, keys]
    rest = Telemetry(0, np.array(START), *np.zeros((2, 5)), np.zeros(3), True)
    session.take(rest, 0.0)
    session.next_task()
    assert session.tracing is not None
    session.tracing.passed, session.tracing.seconds = 3, 1.25
    line = f"rectangle: follow the orange line to its ring, 1.2 s, 3 of {len(session.tracing.line)}"
    assert session.notes("rl")[2:] == [line]
    attempt = Attempt("now", "rectangle", "jacobian", 12.0, 0.01, 0.03, 7.0)
    session.tracing = SimpleNamespace(  # type: ignore[assignment]
        p=[], follow=lambda known: True, score=lambda mode: attempt._replace(mode=mode)
    )
    session.take(rest._replace(mode=1), 0.0)
    assert session.tracing is None and session.done == attempt and session.attempts == [attempt]
    figures = "12.0 s, off by 0.010 m, at most 0.030 m, valves 7"
    assert session.notes("rl")[2:] == [
        f"rectangle by jacobian: {figures}",
        f"mean of 1 by jacobian: {figures}",
    ]
    assert Session(BROKK_170, MODES, tmp_path / "attempts.csv").attempts == [
        attempt
    ]  # kept at once


def test_the_window_asks_hears_and_tells_picture_by_picture(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    told: list[control_process.Ask] = []
    shown: list[Any] = []
    taken: list[float] = []
    pygame.display.set_mode((10, 10))
    pygame.event.clear()
    window: Any = SimpleNamespace(pygame=pygame, show=lambda *a: shown.append(a))
    session = Session(BROKK_170, MODES, None)
    rest = Telemetry(0, np.array(START), *np.zeros((2, 5)), np.zeros(3), False)
    heard = [None, rest, rest, rest._replace(tick=1), rest._replace(tick=2)]
    inner = session.take
    monkeypatch.setattr(
        session, "take", lambda known, now: taken.append(known.tick) or inner(known, now)
    )
    monkeypatch.setattr(
        view, "draw", lambda machine, scenes, size: (machine, scenes[0].status, size)
    )
    presses = [[], [], ["return"], ["return"], ["backspace", "tab"], ["escape"]]
    tasks: list[tuple[str, Any]] = []

    def watcher(seen: Session, hands: InputHandler) -> bool:
        assert seen is session
        tasks.append((session.task, session.tracing))
        for name in presses.pop(0):
            pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=pygame.key.key_code(name)))
        return bool(presses)

    why: list[str | None] = [None] * 5
    play.show(window, session, lambda: heard.pop(0), told.append, lambda: why.pop(0), watcher)
    assert taken == [0, 1, 2] and [task for task, _ in tasks] == [
        "",
        "",
        "",
        "rectangle",
        "circle",
        "circle",
    ]
    assert tasks[5][1] is not tasks[4][1]  # begun again
    hint = "ready: hold SPACE"
    wanted = [((BROKK_170, said, play.SIZE), 60.0) for said in ("starting", hint, hint, hint, hint)]
    assert shown == wanted
    assert [ask.stop for ask in told] == [False] * 5 + [True]
    assert told[4].mode == 1 and [a.time for a in told] == sorted(a.time for a in told)
    presses[:] = [[]] * 2
    with pytest.raises(ValueError, match=r"^play: expected a loop that runs, got its end$"):
        play.show(window, session, lambda: None, told.append, lambda: "its end", lambda *a: True)
    assert told[-1].stop and not told[-1].enable


def test_a_line_is_done_when_all_its_points_were_passed_in_order() -> None:
    line = tool_position(forward_kinematics(BROKK_170, START)) + np.array(
        [[0.0, 0, 0], [0, 0.3, 0], [0, 0.6, 0]]
    )
    work = Tracing(BROKK_170, "line", line)
    rest, open_ = (
        Telemetry(0, np.array(START), *np.zeros((2, 5)), np.zeros(3), True),
        np.full(5, 0.5),
    )
    assert not work.follow(rest) and not work.p  # the clock waits for the first opened valve
    radius = np.hypot(*tool_position(forward_kinematics(BROKK_170, START))[:2])
    for tick, y, done in (
        (7, 0.0, 1),
        (8, 0.6, 1),
        (9, 0.3, 2),
        (16, 0.55, 3),
    ):  # six ticks were missed
        q = np.array([np.arcsin(y / radius), *START[1:]])
        finished = work.follow(rest._replace(tick=tick, q=q, u=open_))
        assert work.passed == done and finished == (done == 3)
    score = work.score("levers")
    assert score.seconds == pytest.approx(0.5)
    assert abs(time.mktime(time.strptime(score.when, "%Y-%m-%dT%H:%M:%S")) - time.time()) < 60


# --- the window ---------------------------------------------------------------------------------------


def test_the_window_drives_a_machine_in_another_process(tmp_path: Path) -> None:
    """In real time: keys, the loop's process, the plant behind the bus; then focus, closing, the end.

    On a busy computer the gate may refuse or stop for a late tick: then the switch is pressed anew.
    """
    seen: list[tuple[float, Telemetry]] = []
    steps: list[tuple[Callable[[Telemetry], bool], int, str]] = [
        (lambda k: k.wrong == 0, pygame.KEYDOWN, "space"),
        (lambda k: k.driving, pygame.KEYDOWN, "q"),
        (lambda k: k.q_dot[0] > 0.1, pygame.WINDOWFOCUSLOST, ""),
        (lambda k: not k.driving and not k.u.any(), pygame.WINDOWFOCUSGAINED, ""),
        (lambda k: True, pygame.QUIT, ""),
    ]
    at, pressed, start = 0, 0.0, time.monotonic()

    def post(kind: int, key: str) -> None:
        more = {"key": pygame.key.key_code(key)} if key else {}
        pygame.event.post(pygame.event.Event(kind, **more))

    def watcher(session: Session, hands: InputHandler) -> bool:
        nonlocal at, pressed
        now, known = time.monotonic(), session.known
        assert now - start < 60, (known, at)
        if known is None or at == len(steps):
            return True
        seen.append((now, known))
        condition, kind, key = steps[at]
        if condition(known):
            post(kind, key)
            at, pressed = at + 1, now
        elif at in (1, 2) and not known.driving and now - pressed > 1.0:
            post(pygame.KEYUP, "q")
            post(pygame.KEYUP, "space")
            at = 0
        return True

    inner = play.show
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(play, "show", lambda *a: inner(*a, watcher=watcher))
        play.play(
            BROKK_170,
            {},
            control_process.BusOptions(log=tmp_path / "run.log"),
            tmp_path / "attempts.csv",
        )
    assert at == len(steps)
    assert seen[-1][1].q[0] > 0.01 and not pygame.display.get_init()
    run = replay.run_of_log(BROKK_170, tmp_path / "run.log", (1, 2, 3))
    assert not run.known[-1].u.any() and not run.known[-1].driving  # the last frame was neutral
    assert max(k.u[0] for k in run.known) >= 40 / 127


def test_other_machines_start_amid_their_ranges() -> None:
    with control_process._simulated(MINI_EXCAVATOR, control_process.BusOptions(), lambda: False):
        pass  # it was no ValueError
    with pytest.raises(ValueError, match="start: expected 4 angles"):
        control_process._simulated(
            MINI_EXCAVATOR, control_process.BusOptions(start=START), lambda: False
        ).__enter__()


def test_nothing_reaches_a_bus_if_there_is_no_window(monkeypatch: pytest.MonkeyPatch) -> None:
    begun: list[str] = []
    pygame.display.quit()
    monkeypatch.setenv("SDL_VIDEODRIVER", "nonsense")
    monkeypatch.setattr(play, "control_process", lambda *a: begun.append("loop"))
    monkeypatch.setattr(play, "open_bus", lambda *a: begun.append("bus"))
    for window in (
        lambda w: play.play(BROKK_170, {}, w, Path("none")),
        lambda w: play.watch(BROKK_170, w),
    ):
        with pytest.raises(ValueError, match="window: expected a display"):
            window(control_process.BusOptions("virtual", "empty"))
    assert not begun


def test_a_loop_that_cannot_begin_ends_the_window_in_one_line() -> None:
    """Nobody answers on this bus."""
    where = control_process.BusOptions("virtual", "empty")
    with pytest.raises(ValueError, match="got node 1: object 0x6501"):
        play.play(BROKK_170, {}, where, Path("attempts.csv"))


def test_watching_sends_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """The frames of another program's drive come in; the bus must carry no other."""
    peer = can.Bus("watched", interface="virtual")
    world = World(
        Push(60, 0, 60, 60, 60),
        lambda driving, ready: OperatorInput((0.1, 0, 0) if driving else (0, 0, 0), ready),
    )
    frames: list[tuple[int, bytes]] = []
    world.upward = world.downward = lambda can_id, data: (
        frames.append((can_id, data)) or [(can_id, data)]
    )
    world.drive.begin()
    world.run(1.5)
    world.close()
    shown: list[Telemetry] = []

    def watcher(session: Session, hands: InputHandler) -> bool:
        for can_id, data in frames[:40]:
            peer.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))
        del frames[:40]
        if session.known is not None:
            shown.append(session.known)
        if not frames:
            pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=pygame.K_SPACE))
        return bool(frames) or not pygame.event.peek(pygame.KEYDOWN) or len(shown) < 3

    inner = play.show
    monkeypatch.setattr(play, "show", lambda *a: inner(*a, watcher=watcher, fps=500.0))
    monkeypatch.setattr(
        play.InputHandler,
        "ask",
        lambda *a: control_process.Ask(0.0, 0, True, True, False, np.ones(3), np.ones(4)),
    )
    play.watch(BROKK_170, control_process.BusOptions("virtual", "watched"))
    assert peer.recv(0.1) is None
    peer.shutdown()
    assert shown[-1].driving and shown[-1].q_dot[0] > 0.05
    np.testing.assert_allclose(shown[-1].u[0] * 127, 60)


# --- recorded runs ------------------------------------------------------------------------------------


def test_a_log_tells_what_the_loop_knew(tmp_path: Path) -> None:
    path = tmp_path / "run.log"
    loop = Remoted(BASELINE, log=can.CanutilsLogWriter(path))
    loop.go(0.5, False)
    loop.go(0.2, True)
    loop.go(2.0, True, (0.0, 0.2, 0.1))
    loop.world.bus.close()
    loop.world.close()
    run = replay.run_of_log(BROKK_170, path, (1, 2, 3))
    told = [k for k in loop.known if k.driving][: len(run.known)]
    assert len(run.known) >= 40
    for a, b in zip(run.known, told, strict=True):
        for name in ("q", "q_dot", "u", "v_goal"):
            np.testing.assert_allclose(getattr(a, name), getattr(b, name), atol=2e-5, err_msg=name)
    assert (run.title, run.colour, run.path.shape) == ("run.log", (1, 2, 3), (0, 3))
    assert (
        run.error[5] > 0.15 and run.error[-5:].mean() < 0.08
    )  # it waits for the valves, then follows
    idle = tmp_path / "idle.log"
    idle.write_text("(1.0) can0 080# R\n(1.05) can0 080# R\n")
    with pytest.raises(ValueError, match="expected a log in which the valves are driven"):
        replay.run_of_log(BROKK_170, idle, (1, 2, 3))


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `evaluate` writes, of a policy and gains that nobody tuned."""
    folder = tmp_path_factory.mktemp("results")
    policy = random_policy(np.random.default_rng(0))
    save_policy(folder / "policy.npz", policy)
    about = baselines.gains_metadata(BROKK_170, policy.net)
    baselines.write_gains(folder / "gains.json", baselines.baselines(BROKK_170, policy.net), about)
    (folder / "commands.csv").write_text(
        "sequence,time,vx,vy,vz\nside,0,0,0.2,0\nside,1.5,0,0,0\nside,2,0,0,0\n"
    )
    (folder / "starts.csv").write_text(
        "q1,q2,q3,q4,q5\n0,0.5,0.58,1.71,1.24\n0.5,0.5,0.58,1.71,1.24\n"
    )
    options = {
        "policy": "policy.npz",
        "commands": "commands.csv",
        "starts": "starts.csv",
        "json": "runs.json",
    }
    assert (
        main(["evaluate", *(w for k, v in options.items() for w in (f"--{k}", str(folder / v)))])
        == 0
    )
    return folder / "runs.json"


def test_results_are_driven_again_into_a_film(
    results: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = results.with_name("film.gif")
    assert (
        main(["replay", str(results), "--out", str(out), "--start", "1", "--size", "640", "360"])
        == 0
    )
    film = Image.open(out)
    assert film.n_frames == 20 and film.size == (640, 360) and film.info["duration"] == 100
    first = np.array(film.convert("RGB")).astype(int)
    film.seek(19)
    last = np.array(film.convert("RGB")).astype(int)
    for half, colour in ((np.s_[:, :320], "rl"), (np.s_[:, 320:], "jacobian")):
        assert (np.abs(last[half] - view.COLOURS[colour]).sum(axis=-1) < 40).sum() > 300
        assert (first[half] != last[half]).any()
    file = json.loads(results.read_text())
    file["runs"][1]["velocity_rmse"] *= 1.1
    wrong = results.with_name("wrong.json")
    wrong.write_text(json.dumps(file))
    assert main(["replay", str(wrong), "--out", str(out), "--start", "1"]) == 1
    assert "expected the run" in capsys.readouterr().err


def test_a_film_is_shown_and_closed(results: Path) -> None:
    run = replay.Run(
        "a",
        (1, 2, 3),
        [Telemetry(0, np.array(START), *np.zeros((2, 5)), np.zeros(3), True)] * 3,
        np.zeros((3, 3)),
        np.zeros(3),
        np.zeros((0, 3)),
        np.zeros((0, 3)),
    )
    pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=pygame.K_RIGHT))
    pygame.event.post(pygame.event.Event(pygame.QUIT))
    replay.show_film(BROKK_170, [run, run], (320, 200))
    assert not pygame.display.get_init()


@pytest.mark.parametrize(
    ("script", "message"),
    [
        ("cat > raw; echo film", ""),
        ("head -c 9 > raw; exit 3", "expected ffmpeg to write it, got its status 3"),
        (None, "expected ffmpeg for .mp4"),
    ],
)
def test_mp4_goes_through_ffmpeg(
    script: str | None,
    message: str,
    results: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    """Another ffmpeg: it keeps the pictures that it gets, ends early, or is not there."""
    out = tmp_path / "film.mp4"
    monkeypatch.chdir(tmp_path)
    if script is not None:
        (tmp_path / "ffmpeg").write_text(f"#!/bin/sh\n{script}\n")
        (tmp_path / "ffmpeg").chmod(0o755)
    tools = os.environ["PATH"] if script else ""
    monkeypatch.setenv("PATH", f"{tmp_path}:{tools}")
    status = main(["replay", str(results), "--out", str(out), "--size", "641", "361"])
    assert status == bool(message) and message in capsys.readouterr().err
    assert out.exists() == (not message)
    if not message:
        assert out.read_text() == "film\n"
        assert (tmp_path / "raw").stat().st_size == 20 * 641 * 361 * 3


def test_a_log_and_results_beside_one_another(
    results: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    loop = Remoted(Push(60, 0, 0, 0, 0), log=can.CanutilsLogWriter(tmp_path / "run.log"))
    loop.go(0.5, False)
    loop.go(0.5, True)
    loop.world.bus.close()
    loop.world.close()
    shown: list[list[str]] = []
    monkeypatch.setattr(
        replay, "show_film", lambda machine, runs, size: shown.append([r.title for r in runs])
    )
    for others in ([str(tmp_path / "run.log"), str(results)], [str(results), str(results)]):
        assert main(["replay", *others, "--controllers", "rl"]) == 0
    assert shown == [["run.log", "rl"], ["rl", "rl"]]


@pytest.mark.parametrize(
    ("arguments", "status", "message"),
    [
        (["play", "--interface", "virtual"], 2, "--interface, --channel"),
        (["play", "--drive"], 2, "--interface, --channel"),
        (["play", "--policy", "missing.npz"], 1, "missing.npz"),
        (
            ["play", "--start", "0", "9"],
            1,
            "start: expected 5 angles within the joints' ranges, got [0.0, 9.0]",
        ),
        (["replay"], 2, "LOGS"),
        (["replay", "a", "b", "c"], 2, "LOGS"),
        (["replay", "missing.log"], 1, "missing.log"),
        (["replay", "missing.json"], 1, "missing.json"),
        (["replay", "missing.json", "--fps", "0"], 2, "--fps"),
        (["replay", "missing.log", "--size", "0", "0"], 2, "--size: expected some and 320 320"),
        (
            ["replay", "missing.json", "--size", "639", "360"],
            2,
            "--size: expected some and 640 320",
        ),
        (["replay", "missing.json", "--size", "640", "9999"], 2, "--size"),
        (["replay", "missing.json", "--controllers"], 2, "--controllers"),
    ],
)
def test_refusals(
    arguments: list[str], status: int, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    try:
        assert main(arguments) == status
    except SystemExit as stop:
        assert stop.code == status
    assert message in capsys.readouterr().err


def test_the_benchmark_of_the_window_runs() -> None:
    command = [sys.executable, "-m", "benchmarks.play", "--seconds", "0.3"]
    done = subprocess.run(command, cwd=Path(__file__).parents[2], capture_output=True, text=True)
    assert done.returncode == 0 and json.loads(done.stdout)["ticks"] >= 2, done.stderr


def test_without_a_display_play_says_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pygame.display.quit()
    monkeypatch.setenv("SDL_VIDEODRIVER", "nonsense")
    assert main(["play", "--interface", "virtual", "--channel", "none"]) == 1
    assert "window: expected a display" in capsys.readouterr().err


def test_where_there_is_no_display_sdl_does_not_draw_unseen(tmp_path: Path) -> None:
    """Without SDL_VIDEODRIVER; whoever sets it to offscreen gets what he asks for."""
    log = tmp_path / "run.log"
    loop = Remoted(Push(60, 0, 0, 0, 0), log=can.CanutilsLogWriter(log))
    loop.go(0.5, False)
    loop.go(0.5, True)
    loop.world.bus.close()
    loop.world.close()
    code = (
        "import os, sys, pygame; from brokk_min.viewer import replay; from brokk_min.__main__ import main; "
        "bus = ['--interface', 'virtual', '--channel', 'none']; "
        "print(main(['play']), main(['play', *bus]), main(['replay', sys.argv[1]])); "
        "os.environ['SDL_VIDEODRIVER'] = 'offscreen'; pygame.display.init(); "
        "pygame.event.post(pygame.event.Event(pygame.QUIT)); print(main(['replay', sys.argv[1]]))"
    )
    unset = ("DISPLAY", "WAYLAND_DISPLAY", "XDG_RUNTIME_DIR", "SDL_VIDEODRIVER")
    clean = {name: value for name, value in os.environ.items() if name not in unset}
    command = [sys.executable, "-c", code, str(log)]
    done = subprocess.run(command, env=clean, capture_output=True, text=True, timeout=300)
    assert done.stdout.split("\n")[-3:-1] == ["1 1 1", "0"], done.stderr
    said = [line for line in done.stderr.splitlines() if line.startswith("brokk-min: ")]
    assert len(said) == 3
    assert all(line.startswith("brokk-min: window: expected a display") for line in said)
