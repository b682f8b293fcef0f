"""Peers that nobody here wrote: CANopen nodes and master, onnxruntime, real buses and processes."""

from __future__ import annotations

import io
import json
import os
import signal
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import can
import canopen
import numpy as np
import pytest
from canopen.objectdictionary import ObjectDictionary, ODArray, ODRecord, ODVariable, datatypes
from helpers_bus import START, Hand, Push, World
from helpers_machines import small_net

from brokk_min import hw
from brokk_min.__main__ import main
from brokk_min.can import canopen as bus
from brokk_min.can import operator_input as wishes
from brokk_min.can import simulated_machine as simulator
from brokk_min.can.canopen import encoder_raw
from brokk_min.env import COMPENSATION_RANGE, observation_scale
from brokk_min.evaluation import baselines
from brokk_min.identification.logs import read_log
from brokk_min.identification.net_file import load_net
from brokk_min.learning.gym_env import TaskVectorEnv
from brokk_min.learning.onnx import export_onnx
from brokk_min.learning.policy import STAND, Policy, contract, save_policy
from brokk_min.machine import BROKK_170

GROUP = "239.74.163.2"


@pytest.fixture(scope="module")
def policy() -> Policy:
    """The right shapes and random weights: it shakes, but it is a policy."""
    rng = np.random.default_rng(0)
    mean, scale = observation_scale(BROKK_170)
    sizes = [len(mean), 256, 128, 64, len(BROKK_170.driven)]
    weights: list[np.ndarray] = []
    for rows, columns in pairwise(sizes):
        weights.append(rng.normal(0, rows**-0.5, (rows, columns)).astype(np.float32))
        weights.append(rng.normal(0, 0.1, columns).astype(np.float32))
    net = small_net(BROKK_170, rng)
    return Policy(contract(BROKK_170), {"seed": 0}, mean, scale, tuple(weights), net)


@pytest.fixture
def folder(policy: Policy, tmp_path: Path) -> Path:
    save_policy(tmp_path / "policy.npz", policy)
    gains = {k: [1.0] * 4 for k in ("kp", "ki", "kd")} | {
        "kd": [0.0] * 4,
        "feedback": 0.1,
        "ready": 0.0,
    }
    names = ("jacobian_pid_k0.1", "jacobian_pid_k0.05", "jacobian_pid_ff", "jacobian_pid_ff_awake")
    table = {
        "meta": baselines.gains_metadata(BROKK_170, policy.net),
        "gains": dict.fromkeys(names, gains),
    }
    (tmp_path / "gains.json").write_text(json.dumps(table))
    (tmp_path / "c.csv").write_text(
        "sequence,time,vx,vy,vz\nup,0,0,0,0.2\nup,1.0,0,0,0\nside,0,0,0.1,0\nside,0.4,0,0,0\n"
    )
    return tmp_path


# --- CANopen --------------------------------------------------------------------------------------------


def dictionary() -> ObjectDictionary:
    """As much of CiA 406 as an encoder with one mapped position needs."""

    def variable(
        owner: Any, name: str, index: int, sub: int, kind: int, value: int, access: str = "rw"
    ) -> None:
        entry = ODVariable(name, index, sub)
        entry.data_type, entry.default, entry.access_type, entry.pdo_mappable = (
            kind,
            value,
            access,
            True,
        )
        if owner is objects:
            objects.add_object(entry)
        else:
            owner.add_member(entry)

    objects = ObjectDictionary()
    u8, u16, u32 = datatypes.UNSIGNED8, datatypes.UNSIGNED16, datatypes.UNSIGNED32
    variable(objects, "device type", 0x1000, 0, u32, 406, "ro")
    variable(objects, "heartbeat", 0x1017, 0, u16, 0)
    variable(objects, "position", 0x6004, 0, u32, 0, "ro")
    variable(objects, "units per revolution", 0x6501, 0, u32, 4096, "ro")
    communication, mapping = ODRecord("TPDO1", 0x1800), ODArray("TPDO1 mapping", 0x1A00)
    variable(communication, "highest", 0x1800, 0, u8, 2)
    variable(communication, "identifier", 0x1800, 1, u32, 0x180)
    variable(communication, "type", 0x1800, 2, u8, 254)
    variable(mapping, "number", 0x1A00, 0, u8, 1)
    variable(mapping, "first", 0x1A00, 1, u32, 0x60040020)
    objects.add_object(communication)
    objects.add_object(mapping)
    return objects


def test_our_loop_drives_five_canopen_encoders() -> None:
    """SDO, heartbeat, NMT and TPDO of the canopen library; only the valve controller is ours."""
    networks, nodes = [], []
    positions = encoder_raw(
        BROKK_170, np.rint(np.array(START) / BROKK_170.encoder_step).astype(int)
    )
    network = canopen.Network()
    network.connect(interface="virtual", channel="peers")
    for joint, position in zip(BROKK_170.joints, positions.tolist(), strict=True):
        node = canopen.LocalNode(joint.encoder_node, dictionary())
        network.add_node(node)
        node.nmt.state = "INITIALISING"
        node.nmt.state = "PRE-OPERATIONAL"
        node.set_data(0x6004, 0, struct.pack("<I", position))
        nodes.append(node)

    def on_sync(can_id: int, data: bytes, timestamp: float) -> None:
        for node in nodes:
            if node.nmt.state == "OPERATIONAL":
                network.send_message(0x180 + node.id, node.get_data(0x6004, 0))

    network.subscribe(0x080, on_sync)
    networks.append(network)
    controller = can.Bus("peers", interface="virtual")
    beat = controller.send_periodic(
        can.Message(arbitration_id=0x710, data=[5], is_extended_id=False), 0.03
    )
    line = bus.Bus(can.Bus("peers", interface="virtual"))
    try:
        drive = hw.Drive(BROKK_170, Push(0, 0, 0, 0, 0), line, hand := Hand())
        drive.begin()
        assert [n.get_data(0x1017, 0) for n in nodes] == [b"\x32\x00"] * 5
        assert [n.get_data(0x1800, 2) for n in nodes] == [b"\x01"] * 5
        end = time.monotonic() + 20
        while not drive.gate.driving and time.monotonic() < end:  # a late answer wants another edge
            hand.enable = False if hand.enable is None and hand.pressed else None
            drive.tick()
            drive.tick()
        assert drive.gate.driving, drive.reason
        assert {n.nmt.state for n in nodes} == {"OPERATIONAL"}
        history = np.asarray(drive.history)
        np.testing.assert_allclose(history[0, :, 0, -1], START, atol=BROKK_170.encoder_step / 1.9)
        nodes[2].nmt.stop_heartbeat()
        hand.enable = False  # so that the reason of now is shown, not a late tick on a busy machine
        end = time.monotonic() + 20
        while "q3: heartbeat lost" not in drive.reason and time.monotonic() < end:
            drive.tick()
        assert drive.reason.endswith("q3: heartbeat lost") and not drive.gate.driving
    finally:
        beat.stop()
        network.disconnect()
        controller.shutdown()
        line.close()


@contextmanager
def served(channel: str) -> Iterator[simulator.SimulatedMachine]:
    """Our simulated machine in a thread on a virtual bus."""
    line = bus.Bus(can.Bus(channel, interface="virtual"))
    machine = simulator.SimulatedMachine(BROKK_170, START, line.now())
    running = [1]
    thread = threading.Thread(target=simulator.serve, args=(machine, line, lambda: bool(running)))
    thread.start()
    try:
        yield machine
    finally:
        running.clear()
        thread.join()
        line.close()


def eventually(condition: Callable[[], bool], seconds: float = 10.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "not within the time"
        time.sleep(0.01)


def test_our_encoders_are_canopen_nodes_to_a_canopen_master() -> None:
    with served("master") as machine:
        network = canopen.Network()
        network.connect(interface="virtual", channel="master")
        try:
            nodes = [canopen.RemoteNode(n, dictionary()) for n in (1, 2, 3, 4, 5)]
            for node in nodes:
                network.add_node(node)
            assert [n.sdo["units per revolution"].raw for n in nodes] == [4096] * 5
            assert nodes[0].sdo["device type"].raw == 406
            nodes[1].sdo["heartbeat"].raw = 100
            assert nodes[1].sdo["heartbeat"].raw == 100
            with pytest.raises(canopen.SdoAbortedError) as refused:
                nodes[0].sdo["position"].raw  # noqa: B018
            assert refused.value.code == 0x06020000
            with pytest.raises(canopen.SdoAbortedError) as refused:
                nodes[0].sdo.download(0x6501, 0, struct.pack("<I", 1))
            assert refused.value.code == 0x06010000
            assert nodes[3].nmt.wait_for_heartbeat(10) == "PRE-OPERATIONAL"
            got: dict[int, int] = {}
            for node in nodes:
                network.subscribe(
                    0x180 + node.id,
                    lambda i, data, t: got.update({i: struct.unpack("<I", data)[0]}),
                )
            network.sync.transmit()
            time.sleep(0.05)
            assert not got  # not yet operational
            network.nmt.state = "OPERATIONAL"
            eventually(lambda: machine.nmt[5] == 5)
            # one of before may still be on its way to the master
            eventually(lambda: nodes[4].nmt.wait_for_heartbeat(10) == "OPERATIONAL")
            network.sync.transmit()
            eventually(lambda: len(got) == 5)
            step = BROKK_170.encoder_step
            assert [got[0x180 + n] for n in (2, 3, 4, 5)] == [round(q / step) for q in START[1:]]
            nodes[0].nmt.state = "STOPPED"
            eventually(lambda: machine.nmt[1] == 4 and machine.nmt[2] == 5)
            nodes[0].nmt.state = "RESET"
            eventually(lambda: machine.nmt[1] == 127)
            network.send_message(0, [99, 0])  # no command that it knows
            network.send_message(0x601, [0x40])  # no request either
            time.sleep(0.05)
            assert machine.nmt[2] == 5
        finally:
            network.disconnect()


# --- ONNX -------------------------------------------------------------------------------------------------


def test_the_exported_policy_is_the_policy(policy: Policy, folder: Path) -> None:
    import onnx
    import onnxruntime

    assert (
        main(["export", "--policy", str(folder / "policy.npz"), "--out", str(folder / "p.onnx")])
        == 0
    )
    session = onnxruntime.InferenceSession(folder / "p.onnx", providers=["CPUExecutionProvider"])
    rng = np.random.default_rng(1)
    env = TaskVectorEnv(256)
    seen = [env.reset(seed=0)[0]]
    seen += [env.step(policy.act(seen[-1]).clip(-1, 1))[0] for _ in range(40)]
    drawn = [rng.normal(0, 1.5, (batch, len(policy.mean))).astype(np.float32) for batch in (1, 256)]
    for observation in (*seen, *drawn):
        (action,) = session.run(None, {"observation": observation})
        assert np.abs(action - policy.act(observation)).max() < 1e-6
        assert np.abs(action).max() > 0.3
    model = onnx.load(folder / "p.onnx")
    assert not [t for t in model.graph.initializer if t.external_data]  # one self-contained file
    assert [node.op_type for node in model.graph.node] == ["Gemm", "Elu"] * 3 + ["Gemm"]
    kept = {p.key: json.loads(p.value) for p in model.metadata_props}
    assert kept["driven"] == ["q1", "q3", "q4", "q5"] and kept["rate"] == 20.0
    for name in ("mean", "scale"):
        np.testing.assert_array_equal(np.float32(kept.pop(name)), getattr(policy, name))
    assert (kept.pop("ramp"), kept.pop("stand_s")) == (COMPENSATION_RANGE, STAND) and kept == dict(
        policy.contract
    )
    assert (model.ir_version, [(o.domain, o.version) for o in model.opset_import]) == (
        8,
        [("", 17)],
    )
    ends = [
        (end.name, end.shape, end.type) for end in (*session.get_inputs(), *session.get_outputs())
    ]
    sizes = {"observation": len(policy.mean), "action": 4}
    assert ends == [(name, ["batch", size], "tensor(float)") for name, size in sizes.items()]


def test_missing_extras_are_named(
    policy: Policy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("can", "pygame", "onnx"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ValueError, match=r"onnx: expected the extra brokk_min\[export\]"):
        export_onnx(tmp_path / "p.onnx", policy)
    with pytest.raises(ValueError, match=r"pygame: expected the extra brokk_min\[play\]"):
        wishes.Joystick(BROKK_170)
    with pytest.raises(ValueError, match=r"can: expected the extra brokk_min\[hw\]"):
        list(bus.read_frames(tmp_path / "run.log"))


# --- real buses and processes -------------------------------------------------------------------------------


@pytest.fixture(autouse=True)
def own_port(monkeypatch: pytest.MonkeyPatch) -> None:
    """Groups with one port are one bus on a machine; two test runs must not meet."""
    monkeypatch.setenv("CAN_CONFIG", json.dumps({"port": 43200 + os.getpid() % 10_000}))


def multicast() -> bool:
    """Does this machine route multicast at all?"""
    try:
        with bus.open_bus("udp_multicast", GROUP) as a, bus.open_bus("udp_multicast", GROUP) as b:
            a.send(0x123, b"")
            return b.recv(1.0) is not None
    except ValueError:
        return False


needs_multicast = pytest.mark.skipif(not multicast(), reason="no multicast route on this machine")


@needs_multicast
def test_a_udp_bus_gives_back_no_echo(tmp_path: Path) -> None:
    with (
        bus.open_bus("udp_multicast", GROUP, tmp_path / "a.log") as a,
        bus.open_bus("udp_multicast", GROUP) as b,
    ):
        a.send(0x5A5, b"\x01")
        first = [a.recv(1.0), b.recv(1.0)]
        assert [f and (f.id, f.data) for f in first] == [(-1, b"\x01"), (0x5A5, b"\x01")]
        b.send(0x5A5, b"\x01")
        assert (a.recv(1.0) or bus.Frame(0, 0, b"")).id == 0x5A5
    assert [line.split()[1:] for line in (tmp_path / "a.log").read_text().splitlines()] == [
        ["udp_multicast", "5A5#01", "T"],
        ["udp_multicast", "5A5#01", "R"],
    ]


def test_no_such_bus_is_one_line() -> None:
    with (
        pytest.raises(ValueError, match=r"socketcan nosuch0: expected a CAN bus, got"),
        bus.open_bus("socketcan", "nosuch0"),
    ):
        pass


def test_a_machine_serves_until_a_signal_and_records_every_step(tmp_path: Path) -> None:
    def end() -> None:
        eventually(lambda: len(rows(tmp_path / "plant.csv")) > 60, 60)
        os.kill(os.getpid(), signal.SIGTERM)

    thread = threading.Thread(target=end)
    thread.start()
    simulator.simulate(BROKK_170, START, "virtual", "recorded", tmp_path / "plant.csv")
    thread.join()
    log = read_log([tmp_path / "plant.csv"], 4)
    assert log.joints == BROKK_170.names and not log.recordings[0].u.any()
    np.testing.assert_allclose(log.recordings[0].q, np.tile(START, (len(log.recordings[0].q), 1)))
    times = rows(tmp_path / "plant.csv")[:, 0]
    np.testing.assert_allclose(times, 0.005 * np.arange(1, len(times) + 1), atol=0.0006)
    with pytest.raises(ValueError, match="start: expected 5 angles within the joints' ranges"):
        simulator.simulate(BROKK_170, [0, 0, 0, 0, 9], "virtual", "recorded")


class Process:
    """One command of ours as a process; killed at the end whatever happens."""

    def __init__(self, *arguments: object) -> None:
        command = [sys.executable, "-m", "brokk_min", *map(str, arguments)]
        self.process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )

    def __enter__(self) -> subprocess.Popen[str]:
        return self.process

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.communicate()


def rows(path: Path) -> np.ndarray:
    """Complete rows of a record that is being written: time, commands, time of the last valid valve frame."""
    lines = path.read_text().splitlines()[1:-1] if path.exists() else []
    cells = [line.split(",") for line in lines]
    return np.array([[float(x) for x in (*row[1:7], row[12])] for row in cells]).reshape(-1, 7)


@needs_multicast
def test_two_processes_drive_replay_convert_and_survive_a_kill(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """On a loaded machine a tick may be late; then the drive stops, which is right, and is tried again."""
    where = ["--interface", "udp_multicast", "--channel", GROUP]
    jacobian = ["--policy", folder / "policy.npz", "--controller", "jacobian"]
    command = [
        "drive",
        *jacobian,
        *where,
        "--command",
        folder / "c.csv",
        "--log",
        folder / "run.log",
    ]
    with Process("machine", *where, "--start", *START, "--record", folder / "plant.csv") as machine:
        eventually(lambda: len(rows(folder / "plant.csv")) > 10, 60)
        end = time.monotonic() + 120
        while (code := main([str(a) for a in command])) and time.monotonic() < end:
            pass
        assert code == 0, capsys.readouterr().err
        said = capsys.readouterr().out
        assert "driving v wanted +0.00 +0.00 +0.20" in said
        assert main(["drive", *map(str, jacobian), "--replay", str(folder / "run.log")]) == 0
        same = capsys.readouterr().out
        assert "valve frames are the same" in same and " 0 of" not in same
        assert (
            main(
                [
                    "drive",
                    "--policy",
                    str(folder / "policy.npz"),
                    "--replay",
                    str(folder / "run.log"),
                ]
            )
            == 1
        )
        assert "others" in capsys.readouterr().err
        assert main(["convert", str(folder / "run.log"), "--out", str(folder / "log.csv")]) == 0
        assert sum(len(r.u) for r in read_log([folder / "log.csv"], 4).recordings) >= 25
        driving, end = False, time.monotonic() + 120
        while not driving and time.monotonic() < end:
            moved = len(rows(folder / "plant.csv"))
            with Process(*command) as drive:
                while not driving and drive.poll() is None:
                    driving = bool(np.any(rows(folder / "plant.csv")[moved:, 1:6]))
                drive.send_signal(signal.SIGKILL)
                drive.wait()
        assert driving
        # all by the plant's own record: the last valid frame, and no motion 155 ms after it
        killed = rows(folder / "plant.csv")[-1, 0]
        eventually(lambda: rows(folder / "plant.csv")[-1, 0] > killed + 0.8, 60)
        table = rows(folder / "plant.csv")
        last = table[-1, 6]
        assert 0 < last < killed + 0.5 and (table[table[:, 0] > killed + 0.5, 6] == last).all()
        assert (
            table[table[:, 0] <= last, 1:6].any()
            and not table[table[:, 0] > last + 0.155, 1:6].any()
        )
        machine.send_signal(signal.SIGTERM)
        assert machine.wait(30) == 0
    assert list(bus.read_frames(folder / "run.log"))  # what a killed program left can be read


def test_a_day_of_driving_goes_into_the_nets_beside_the_earlier_log(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Convert, then fit; alone the log has no motion of the locked joint to learn from."""
    start = (1.8, *START[1:])
    log = can.CanutilsLogWriter(tmp_path / "run.log", channel="can0")
    world = World(Push(60, 0, 60, -60, 60), Hand(), log=log, start=start)
    world.drive.begin()
    world.run(4.0)
    world.close()
    log.stop()
    whole, drive, net = (str(tmp_path / name) for name in ("log.csv", "drive.csv", "net.npz"))
    assert main(["collect", "--hours", "0.01", "--out", whole]) == 0
    assert main(["convert", str(tmp_path / "run.log"), "--out", drive]) == 0
    small = ["--steps", "30", "--batch-size", "32", "--out", net, "--test", whole]
    assert main(["fit", drive, *small]) == 1
    assert (
        "joint q2: expected a recording of 14 samples or more in which it moves"
        in capsys.readouterr().err
    )
    assert main(["fit", whole, drive, *small]) == 0
    logs = [
        read_log([Path(path)], BROKK_170.velocity_samples).recordings for path in (whole, drive)
    ]
    q = np.concatenate([recording.q for recordings in logs for recording in recordings])
    found = load_net(Path(net))
    assert found.machine == "brokk170" and found.joints == BROKK_170.names
    np.testing.assert_allclose(found.q_low, q.min(axis=0), atol=1e-6)
    np.testing.assert_allclose(found.q_high, q.max(axis=0), atol=1e-6)
    assert (
        found.q_high[0] > max(r.q[:, 0].max() for r in logs[0]) + 0.05
    )  # where only the drive has been
    (driven,) = logs[1]
    np.testing.assert_allclose(driven.q[0], start, atol=0.002)
    assert (np.diff(driven.q[-20:], axis=0)[:, 3] <= 0).all() and driven.u[-1, 3] == pytest.approx(
        -60 / 127
    )


def test_a_bus_that_fails_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    """Before the loop, which takes it for a fault, nobody else catches it."""
    where = ["--interface", "virtual", "--channel", "broken"]
    with pytest.MonkeyPatch.context() as patch:

        def send(self: Any, message: can.Message, timeout: float | None = None) -> None:
            raise can.CanOperationError("no buffer space")

        patch.setattr("can.interfaces.virtual.VirtualBus.send", send)
        assert main(["machine", *where]) == 1
    error = capsys.readouterr().err
    assert error.startswith(
        "brokk-min: virtual broken: expected a CAN bus that works, got CanOperationError"
    )
    assert error.count("\n") == 1


def test_a_locked_joint_does_not_jog(capsys: pytest.CaptureFixture[str]) -> None:
    where = ["--interface", "virtual", "--channel", "empty"]
    assert main(["drive", *where, "--controller", "jog", "--joint", "q2"]) == 2
    wanted = "--joint: expected one that may be driven, ['q1', 'q3', 'q4', 'q5'], got q2"
    assert wanted in capsys.readouterr().err


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_the_status_stays_one_line_of_a_terminal(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It must not wrap, the reason comes before what may be cut, and the prompt begins a new line."""
    where = ["--interface", "virtual", "--channel", "status"]
    monkeypatch.setenv("COLUMNS", "60")
    with served("status") as machine:
        receive = machine.receive
        machine.receive = lambda frame: [] if frame.id == 0x80 else receive(frame)  # type: ignore[method-assign]
        command = [
            "drive",
            "--policy",
            str(folder / "policy.npz"),
            *where,
            "--command",
            str(folder / "c.csv"),
        ]
        with monkeypatch.context() as patch:
            patch.setattr("sys.stdout", screen := Terminal())
            assert main(command) == 1
    *shown, last = screen.getvalue().split("\r")[1:]
    assert len(shown) > 10 and last.endswith("\033[K\n")
    for line in shown:
        text = line.removesuffix("\033[K")
        assert len(text) == 59 and "\n" not in line
    assert "waiting q1: silent v wanted" in last


def test_a_drive_that_cannot_go_on_says_so(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """No machine on the bus; no joystick; a sequence that is too fast."""
    where = ["--interface", "virtual", "--channel", "empty"]
    command = ["drive", "--policy", str(folder / "policy.npz"), *where, "--command"]
    assert main([*command, str(folder / "c.csv")]) == 1
    assert "node 1: object 0x6501:00: expected an answer" in capsys.readouterr().err
    assert main([*command, "joystick"]) == 1
    assert "joystick: expected one, got none" in capsys.readouterr().err
    (folder / "fast.csv").write_text("sequence,time,vx,vy,vz\nf,0,1,0,0\nf,1,0,0,0\n")
    assert main([*command, str(folder / "fast.csv")]) == 1
    assert "command: expected at most 0.3 m/s, got 1 m/s" in capsys.readouterr().err
    with served("silent") as machine:
        receive = machine.receive
        machine.receive = lambda frame: [] if frame.id == 0x80 else receive(frame)  # type: ignore[method-assign]
        where[-1] = "silent"
        assert main([*command[:3], *where, "--command", str(folder / "c.csv")]) == 1
        assert "expected to play all sequences, got q1: silent" in capsys.readouterr().err
