"""The loop behind a pipe: requests reach the gate, telemetry comes back, silence stops it."""

import multiprocessing
import threading

import numpy as np
import pytest
from helpers_bus import ConstantCommand, served
from helpers_viewer import PipedLoop

from brokk_min.can.canopen import OperatorInput
from brokk_min.machine import BROKK_170
from brokk_min.viewer import control_process
from brokk_min.viewer.control_process import (
    BusOptions,
    Request,
    WindowInput,
    control,
    receive_telemetry,
    send_request,
)
from brokk_min.viewer.faults import fault_in_words

REQUEST = Request(10.0, 0, True, True, np.array([0.1, 0.0, 0.0]), np.zeros(4))


def test_operator__gives_the_newest_request_until_it_is_too_old():
    here, there = multiprocessing.Pipe()
    now = 10.0
    operator = WindowInput(BROKK_170, [], there, lambda: now).operator
    assert operator(False, True) == OperatorInput(alive=False)  # no request yet
    here.send(REQUEST._replace(v_goal=np.ones(3)))
    here.send(REQUEST)
    assert operator(False, True) == OperatorInput((0.1, 0.0, 0.0), enable=True)
    now = 10.19
    assert operator(True, True) == OperatorInput((0.1, 0.0, 0.0), enable=True)
    now = 10.21
    assert operator(True, True) == OperatorInput(alive=False)
    here.send(REQUEST._replace(time=10.2, alive=False, enable=False))
    assert operator(True, True) == OperatorInput((0.1, 0.0, 0.0), alive=False)
    here.close()
    assert operator(True, True) == OperatorInput(stop=True)


def test_loop__drives_levers_one_joint_each_and_changes_the_controller_while_driving():
    loop = PipedLoop(ConstantCommand(60, 0, 0, 0, 0))
    loop.go(0.5, False, mode=1)
    loop.go(0.2, True, mode=1)
    assert loop.ticks[-1].driving
    assert loop.ticks[-1].mode == 1
    loop.go(0.6, True, mode=1, levers=(0, 0, -1, 0))
    last = loop.ticks[-1]
    np.testing.assert_allclose(last.u * 127, [0, 0, 0, -80, 0], atol=1e-9)
    assert last.q_dot[3] < -0.1
    assert abs(last.q_dot[0]) < 1e-3
    loop.go(0.1, True, mode=0)
    np.testing.assert_allclose(loop.ticks[-1].u * 127, [60, 0, 0, 0, 0], atol=1e-9)
    loop.go(0.1, False)
    assert not loop.ticks[-1].driving
    assert not loop.ticks[-1].u.any()
    assert [t.tick for t in loop.ticks] == list(range(1, len(loop.ticks) + 1))
    loop.close()


def test_loop__closes_the_valves_and_sends_nothing_while_the_window_is_silent():
    loop = PipedLoop(ConstantCommand(60, 0, 0, 0, 0))
    loop.go(0.5, False)
    loop.go(0.4, True)
    assert loop.ticks[-1].driving
    last = loop.world.time
    loop.world.run(15.0)  # more than a pipe holds
    silent = list(receive_telemetry(loop.connection))
    assert 1 <= len(silent) <= 4
    times, commands = loop.world.commands
    late = times[(commands != 0).any(axis=1)].max() - last
    assert 0.1 < late <= control_process.SILENCE + 0.06
    loop.go(0.06, True)
    assert "device lost" in fault_in_words(BROKK_170, loop.ticks[-1])
    loop.go(0.5, True)
    assert not loop.ticks[-1].driving  # the switch was never released
    loop.go(0.1, False)
    loop.go(0.1, True)
    assert loop.ticks[-1].driving
    loop.close()


def test_control__drives_a_machine_on_a_bus_until_the_window_closes_the_pipe(tmp_path):
    here, there = multiprocessing.Pipe()
    options = BusOptions("virtual", "control", log=tmp_path / "run.log")
    thread = threading.Thread(target=here.close)  # as soon as the loop runs
    poll = there.poll

    def poll_once():
        thread.start()
        thread.join()
        return poll()

    there.poll = poll_once
    with served("control"):
        control(BROKK_170, [], options, there)
    assert (tmp_path / "run.log").stat().st_size > 0


def test_receive_telemetry__says_why_the_loop_ended():
    here, there = multiprocessing.Pipe()
    control(BROKK_170, [], BusOptions("nonsense", "bus"), there)
    there.close()
    send_request(here, REQUEST)  # no error: the next line reports it
    with pytest.raises(ValueError, match=r"^play: .* runs, got nonsense bus: expected a CAN bus"):
        list(receive_telemetry(here))
    with pytest.raises(ValueError, match=r"^play: .* runs, got its sudden end"):
        list(receive_telemetry(here))
