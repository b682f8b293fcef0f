"""What the commands hand to the library and what they say, with stand-ins for the library."""

from __future__ import annotations

import contextlib
import io
import json
import shlex
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from conftest import Stand

from brokk_min import hw, ppo
from brokk_min.__main__ import COMMANDS, main
from brokk_min.can import drive_log
from brokk_min.can import operator_input as wishes
from brokk_min.can.canopen import Frame
from brokk_min.cli import commands, operating
from brokk_min.cli.options import SHIPPED
from brokk_min.evaluation import baselines, figures, metrics, preliminary
from brokk_min.evaluation.sequences import task_sequences
from brokk_min.identification import validation
from brokk_min.identification.logs import Log, Recording, read_log, write_log
from brokk_min.jacobian import JacobianController
from brokk_min.evaluation import seeds as sweep
from brokk_min.learning.policy import PolicyController, load_policy
from brokk_min.machine import BROKK_170
from brokk_min.viewer import drawing as view
from brokk_min.viewer import play, replay
from brokk_min.viewer.control_process import BusOptions

POLICY = SHIPPED / "brokk170" / "policy.npz"
GAINS = SHIPPED / "brokk170" / "gains.json"
TUNED = baselines.read_gains(GAINS, BROKK_170, load_policy(POLICY, BROKK_170).net)[
    "jacobian_pid_k0.1"
]


def run(line: str, *more: object) -> int:
    return main([*shlex.split(line), *map(str, more)])


# --- the command line -----------------------------------------------------------------------------------


def test_words_come_from_the_shell_and_other_commands_are_not_made(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for words, first in (
        (["reproduce", "--help"], "usage: brokk-min reproduce "),
        (["--help"], "usage: brokk-min [-h]"),
    ):
        monkeypatch.setattr("sys.argv", ["/somewhere/__main__.py", *words])
        with pytest.raises(SystemExit, match=r"^0$"):
            main()
        said = capsys.readouterr().out
        assert said.startswith(first) and "--no-" not in said
    assert "Exits 0 done, 1 failed, 2 wrong use." in said and all(
        f"• {name} " in said for name in COMMANDS
    )
    monkeypatch.setitem(COMMANDS, "train", lambda: pytest.fail("it would import torch"))
    with pytest.raises(SystemExit, match=r"^0$"):
        main(["starts", "--help"])


@pytest.mark.parametrize(
    "line",
    [
        "collect --out",
        "fit l.csv --out",
        "fit l.csv --out n.npz --json",
        "fit l.csv --out n.npz --figure",
        "train --actuator n.npz --out",
        "starts --out",
        "evaluate --json",
        "machine --interface virtual --channel c --record",
        "drive --interface virtual --channel c --controller jog --log",
        "convert l.log --out",
        "export --policy p.npz --out",
        "play --log",
        "play --attempts",
        "replay l.log --out",
    ],
)
def test_what_cannot_be_written_is_refused_before_hours_of_work(
    line: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "missing" / "x.csv"
    assert run(line, path) == 2
    wanted = f"brokk-min: {path}: expected a file in an existing, writable directory\n"
    assert capsys.readouterr().err == wanted


class Screen(io.StringIO):
    """A terminal, or a pipe: what a reader of it has seen is what was flushed."""

    def __init__(self, terminal: bool) -> None:
        super().__init__()
        self.terminal, self.measured = terminal, ""

    def isatty(self) -> bool:
        return self.terminal

    def flush(self) -> None:
        self.measured = self.getvalue()


# --- a machine on a bus -----------------------------------------------------------------------------------


def test_a_simulated_machine_gets_its_bus_start_and_record(
    stand: Stand, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls, record = stand(operating, simulate=None), tmp_path / "plant.csv"
    monkeypatch.setattr("sys.stdout", pipe := Screen(terminal=False))
    assert (
        run(
            "machine --interface socketcan --channel can0 --start 0 0.5 0.6 1.7 1.2 --record",
            record,
        )
        == 0
    )
    (*given, told) = calls["simulate"]
    assert given == [BROKK_170, (0.0, 0.5, 0.6, 1.7, 1.2), "socketcan", "can0"] and told == record
    assert pipe.seen == "brokk170 on socketcan can0; Ctrl-C ends it\n"
    assert run("machine --interface socketcan --channel can0") == 0
    assert calls["simulate"][1:] == ((), "socketcan", "can0", None)


@pytest.mark.parametrize(
    ("options", "kind"),
    [
        ("--controller jog --joint q4 --counts 9", wishes.JointJog),
        (f"--policy '{POLICY}'", PolicyController),
        (f"--policy '{POLICY}' --controller jacobian", JacobianController),
        (f"--policy POLICY --controller jacobian --gains '{GAINS}'", JacobianController),
    ],
)
def test_a_log_is_compared_with_the_controller_that_is_named(
    options: str, kind: type, stand: Stand, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "policy.npz").write_bytes(POLICY.read_bytes())  # without gains beside
    options = options.replace("POLICY", str(tmp_path / "policy.npz"))
    frames, log = [Frame(0.0, 0x80, b"")], tmp_path / "run.log"
    calls = stand(operating, read_frames=iter(frames))
    stand(drive_log, replay="sent", compare=(7, 9))
    assert run(f"drive {options} --replay", log) == 1
    machine, controller, tape = calls["replay"]
    assert machine is BROKK_170 and type(controller) is kind and controller.machine is BROKK_170
    assert (
        tape == frames
        and calls["read_frames"] == (log,)
        and calls["compare"] == (BROKK_170, frames, "sent")
    )
    if isinstance(controller, wishes.JointJog):
        assert (controller.joint, controller.counts) == ("q4", 9)
    if isinstance(controller, PolicyController):
        assert controller.policy.net.machine == "brokk170"
    if isinstance(controller, JacobianController):
        assert controller.k == 0.1 and (controller.gains == TUNED.gains).all()
    said = capsys.readouterr()
    assert said.out == f"{log}: 7 of 9 valve frames are the same\n"
    assert said.err == f"brokk-min: {log}: expected the frames of the log, got 2 others\n"
    stand(operating, read_frames=iter(frames))
    stand(drive_log, compare=(9, 9))
    assert run(f"drive {options} --replay", log) == 0


class Drives:
    """Stands for `hw.Drive`: it says one line, and its operator's script gets as far as is told."""

    ticks, reason = 0, ""

    def __init__(self, *given: Any) -> None:
        Drives.given, self.begun = given, False

    def begin(self) -> None:
        self.begun = True

    def run(self, show: Callable[[str], object]) -> None:
        assert self.begun
        show("driving v wanted +0.10 +0.00 +0.00")
        Drives.given[3].tick = self.ticks


def test_a_drive_gets_bus_log_and_operator_and_says_how_it_ended(
    stand: Stand,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "c.csv").write_text(
        "sequence,time,vx,vy,vz\nup,0,0,0,0.1\nup,1,0,0,0\nto,0,0.2,0,0\nto,1,0,0,0\n"
    )
    calls = stand(operating, open_bus=contextlib.nullcontext("the bus"))
    monkeypatch.setattr(hw, "Drive", Drives)
    jog, log = "drive --controller jog --interface socketcan --channel can1", tmp_path / "run.log"
    script = f"{jog} --command {tmp_path / 'c.csv'} --log {log}"
    for ticks, reason, status, error in (
        (40, "", 0, ""),
        (39, "q3: silent", 1, "brokk-min: drive: expected to play all sequences, got q3: silent\n"),
        (0, "", 1, "brokk-min: drive: expected to play all sequences, got a stop\n"),
    ):
        Drives.ticks, Drives.reason = ticks, reason
        assert run(script) == status
        said = capsys.readouterr()
        assert said.out == "driving v wanted +0.10 +0.00 +0.00\n" and said.err == error
        assert calls["open_bus"] == ("socketcan", "can1", log)
        machine, controller, line, operator = Drives.given
        assert (
            machine is BROKK_170
            and controller == wishes.JointJog(BROKK_170, "q1", 12)
            and line == "the bus"
        )
        assert operator.goals[0].tolist() == [0, 0, 0.1] and operator.goals[20].tolist() == [
            0.2,
            0,
            0,
        ]
    stand(wishes, Joystick=SimpleNamespace(done=False))  # it never is, and that is no failure
    assert run(f"{jog} --axes 3 4 5 --button 2") == 0
    assert calls["Joystick"] == (BROKK_170, (3, 4, 5), 2) and calls["open_bus"][2] is None
    monkeypatch.setenv("COLUMNS", "20")
    told = {True: "\rdriving v wanted +0\033[K", False: "driving v wanted +0.10 +0.00 +0.00\n"}
    for terminal, seen in told.items():
        monkeypatch.setattr("sys.stdout", screen := Screen(terminal))
        assert run(jog) == 0 and calls["Joystick"] == (BROKK_170, (1, 0, 4), 5)
        assert screen.seen == seen and screen.getvalue() == seen + "\n" * terminal


@pytest.mark.parametrize("bus", ["--interface virtual", "--channel can0", ""])
def test_a_bus_has_an_interface_and_a_channel(bus: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(f"drive --controller jog {bus}") == 2
    assert capsys.readouterr().err.startswith(
        "brokk-min: --interface, --channel: expected a CAN bus"
    )
    if bus:
        assert run(f"play {bus}") == 2


def test_a_log_of_driving_becomes_one_to_fit_to(
    stand: Stand, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    q = np.cumsum(np.full((20, 2), 0.01), axis=0)
    log = Log(("a", "b"), (Recording("0", 0 * q, q, 0 * q), Recording("1", 0 * q, q, 0 * q)))
    calls = stand(operating, read_frames="frames")
    stand(drive_log, log_for_fit=log)
    assert run(f"convert {tmp_path / 'run.log'} --out", tmp_path / "log.csv") == 0
    assert calls == {"read_frames": (tmp_path / "run.log",), "log_for_fit": (BROKK_170, "frames")}
    assert len(read_log([tmp_path / "log.csv"], 2).recordings) == 2
    assert capsys.readouterr().out == f"{tmp_path / 'log.csv'}: 2 recordings of a, b\n"


def test_what_is_exported_is_the_policy_that_is_named(
    stand: Stand, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    calls = stand(operating, export_onnx=None, load_policy="policy")
    assert run(f"export --policy '{POLICY}' --out", tmp_path / "p.onnx") == 0
    assert calls == {
        "load_policy": (POLICY, BROKK_170),
        "export_onnx": (tmp_path / "p.onnx", "policy"),
    }
    assert capsys.readouterr().out.startswith(f"{tmp_path / 'p.onnx'}: observation (batch, obs) in")


# --- windows and films ------------------------------------------------------------------------------------


def test_the_game_gets_controllers_bus_and_files(
    stand: Stand, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    calls, log = stand(play, play=None, watch=None), tmp_path / "run.log"
    assert run("play") == 0
    machine, controllers, where, attempts = calls.pop("play")
    assert machine is BROKK_170 and where == BusOptions() and attempts == Path("attempts.csv")
    assert list(controllers) == ["rl", "jacobian"] and controllers["rl"].machine is BROKK_170
    assert controllers["rl"].policy.net.machine == "brokk170"
    assert controllers["jacobian"].k == 0.1 and (controllers["jacobian"].gains == TUNED.gains).all()
    assert capsys.readouterr().err == f"gains of the Jacobian controller: {GAINS}\n"
    (tmp_path / "p.npz").write_bytes(POLICY.read_bytes())
    bus = f"--interface socketcan --channel can0 --log {log}"
    assert (
        run(f"play --drive {bus} --policy {tmp_path / 'p.npz'} --attempts", tmp_path / "a.csv") == 0
    )
    _, by_hand, where, attempts = calls.pop("play")
    assert where == BusOptions("socketcan", "can0", log) and attempts == tmp_path / "a.csv"
    assert capsys.readouterr().err == "gains of the Jacobian controller: set by hand\n"
    assert by_hand["jacobian"].k == 0.1 and (by_hand["jacobian"].gains != TUNED.gains).any()
    assert run(f"play --policy {tmp_path / 'p.npz'} --gains '{GAINS}'") == 0
    assert (calls.pop("play")[1]["jacobian"].gains == TUNED.gains).all()
    assert run(f"play {bus}") == 0
    assert calls.pop("watch") == (BROKK_170, BusOptions("socketcan", "can0", log)) and not calls
    assert run("play --start 0 0.5 0.6 1.7 1.2") == 0
    assert calls["play"][2].start == (0.0, 0.5, 0.6, 1.7, 1.2)


def test_logs_and_results_are_replayed_as_is_told(
    stand: Stand, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = SimpleNamespace(
        sequences={"x": 0, "y": 0}, controllers={"rl": 0, "pid": 0}, starts=np.zeros((3, 5))
    )
    calls = stand(replay, run_of_log="log", read_results=found, driven_again=["rl", "pid"])
    stand(replay, show_film=None, write_film=None)
    log, results, out = tmp_path / "run.log", tmp_path / "r.json", tmp_path / "f.gif"
    assert run(f"replay {log} {log}") == 0
    first, second = list(view.COLOURS.values())[:2]
    assert first != second and calls.pop("run_of_log") == (BROKK_170, log, second)
    assert calls.pop("show_film") == (BROKK_170, ["log", "log"], (960, 540)) and not calls
    assert run(f"replay {log} {results} --controllers rl --size 640 4000 --out", out) == 0
    assert calls.pop("write_film") == (out, BROKK_170, ["log", "rl", "pid"], (640, 4000), 10.0)
    assert calls.pop("read_results") == (BROKK_170, results, ("rl",))
    assert calls.pop("driven_again") == (BROKK_170, found, ("rl",), "x", 0)
    options = "--sequence y --start 2 --fps 5 --size 4000 320 --controllers rl pid"
    assert run(f"replay {results} {options} --out", out) == 0
    assert calls["driven_again"][2:] == (("rl", "pid"), "y", 2) and calls["write_film"][3:] == (
        (4000, 320),
        5.0,
    )
    capsys.readouterr()
    for wrong in ("--sequence z", "--start 3", "--start -1", "--controllers rl ff"):
        assert run(f"replay {results} --controllers rl {wrong}") == 2
        wanted = "expected some of ['x', 'y'], of ['rl', 'pid'] and below 3, got "
        assert wanted in capsys.readouterr().err
    for size, arms in (("639 540", 2), ("960 319", 2), ("4001 540", 2), ("960 4001", 2)):
        assert run(f"replay {log} {results} --controllers rl --size {size}") == 2
        wanted = f"expected some and {320 * arms} 320 to 4000 4000, got {arms} and {size}\n"
        assert capsys.readouterr().err.endswith(wanted)


# --- the method -------------------------------------------------------------------------------------------

NUMBERS = {"velocity_error_mean": 0.0125, "valve_travel": 3.0}


def same_draws(rng: Any, seed: int) -> bool:
    return bool(rng.bit_generator.state == np.random.default_rng(seed).bit_generator.state)


def small_log(path: Path, joints: tuple[str, ...], recordings: int = 2) -> Log:
    """Angles that go up by 0.01 rad a tick; written to a file."""
    q = np.cumsum(np.full((40, len(joints)), 0.01), axis=0)
    log = Log(joints, tuple(Recording(str(i), 0 * q, q, 0 * q) for i in range(recordings)))
    write_log(path, log)
    return log


def test_what_is_collected_is_what_was_asked_for(
    stand: Stand, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "log.npz"
    calls = stand(commands, collect=small_log(out, ("a", "b")))
    assert run("collect --hours 0.5 --excitation sine --seed 3 --out", out) == 0
    machine, hours, excitation, rng = calls["collect"]
    assert (machine, hours, excitation) == (BROKK_170, 0.5, "sine") and same_draws(rng, 3)
    assert read_log([out], 2).joints == ("a", "b")
    assert capsys.readouterr().out == f"{out}: 2 recordings of a, b\n"
    assert run("collect --out", out) == 0 and calls["collect"][1:3] == (1.0, "rich")
    assert run("collect --out", tmp_path / "log.csv") == 0
    assert run("collect --out", tmp_path / "log.txt") == 2
    assert "--out: expected a name ending in .csv or .npz, got" in capsys.readouterr().err


def test_a_fit_is_judged_on_other_recordings_drawn_and_written(
    stand: Stand,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    log, test, out, verdict, picture = (
        tmp_path / n for n in ("l.csv", "t.csv", "n.npz", "f.json", "f.png")
    )
    small_log(log, BROKK_170.names, 21)
    small_log(test, BROKK_170.names, 1)
    net = SimpleNamespace(machine="brokk170", dead_zone=0.07, rate=20.0, history=13)
    one = {"one_step_rmse": 0.01, "persistence_rmse": 0.02}
    runs = {"free_run": {"1": {"velocity_rmse": 0.1}, "5": {"velocity_rmse": 0.2}}}
    joint = one | runs | {"linear": {"one_step_rmse": 0.03, "free_run": {}}, "creep": 1e-3}
    found = {"joints": {"q1": joint}, "tool": {}, "warnings": ["q1: creeps"]}
    calls = stand(commands, fit=net, save_net=None)
    stand(validation, validate=found)
    stand(figures, plot_worst_and_median="figure", save=None)
    files = f"--out {out} --json {verdict} --figure {picture}"
    assert run(f"fit {log} --steps 7 --seed 4 --velocity-samples 13 {files}") == 0
    fitted, settings, *rest = calls["fit"]
    assert rest == [4, 13, "brokk170"] and settings.steps == 7 and settings.dead_zone == 0.07
    assert calls["validate"][0] is net and calls["validate"][3] is BROKK_170
    held_out = ["0", "10", "20"]
    assert [r.name for r in calls["validate"][2].recordings] == held_out
    assert [r.name for r in fitted.recordings] == [
        str(i) for i in range(21) if str(i) not in held_out
    ]
    assert calls["validate"][1] is fitted and calls["save_net"] == (out, net)
    assert calls["plot_worst_and_median"] == (net, calls["validate"][2]) and calls["save"] == (
        picture,
        "figure",
    )
    about = {"machine": "brokk170", "dead_zone": 0.07, "logs": [str(log)], "test": []}
    written = json.loads(verdict.read_text())
    assert written == {"meta": {"seed": 4, "rate": 20.0, "history": 13} | about, **found}
    said = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert said[0] == ["nets", "of", "brokk170,", "dead", "zone", "0.07", "of", "full", "command"]
    assert said[1] == [
        "joint",
        "one",
        "step",
        "same",
        "as",
        "last",
        "free",
        "run",
        "of",
        "1,",
        "5,",
        "10,",
        "30",
        "s",
        "creep",
        "[rad/s]",
    ]
    assert said[2:] == [
        ["q1", "0.0100", "0.0200", "0.1000,", "0.2000", "0.00100"],
        ["linear", "0.0300", "nan"],
        ["warning:", "q1:", "creeps"],
    ]
    calls.clear()
    (tmp_path / "slow.py").write_text(
        "from dataclasses import replace\nfrom brokk_min.machine import BROKK_170\n"
        "SLOW = replace(BROKK_170, name='slow', rate=10.0)\n"
    )
    slow = f"{tmp_path / 'slow.py'}:SLOW"
    assert run(f"fit {log} --test {test} --machine {slow} --out {out} --json {verdict}") == 0
    assert (calls["fit"][0].rate, calls["validate"][2].rate, calls["fit"][4]) == (10.0, 10.0, "slow")
    assert json.loads(verdict.read_text())["meta"]["test"] == [str(test)]
    assert run(f"fit {log} --test {test} --machine brokk170 --out {out}") == 0
    assert len(calls["fit"][0].recordings) == 21 and len(calls["validate"][2].recordings) == 1
    assert calls["fit"][2:] == (0, BROKK_170.velocity_samples, "brokk170") and "save" not in calls
    small_log(log, ("a", "b"))
    net.machine = ""
    assert run(f"fit {log} --out {out}") == 0
    assert calls["fit"][4] == "" and calls["validate"][3] is None
    assert "nets of no known machine, dead zone" in capsys.readouterr().out
    assert run(f"fit {log} --machine brokk170 --out {out}") == 1
    assert "LOGS: expected joints of --machine brokk170, got ['a', 'b']" in capsys.readouterr().err


def test_training_gets_nets_settings_task_and_files(
    stand: Stand, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    calls = stand(commands, load_net="nets", select_nets="driven nets")
    stand(ppo, train=None)
    options = (
        f"--actuator n.npz --out {tmp_path / 'p.npz'} --seed 5 --total-steps 9 --zero-goals 0.5"
    )
    assert run(f"train {options}") == 0
    assert calls["load_net"] == (Path("n.npz"),) and calls["select_nets"] == (BROKK_170, "nets")
    machine, net, task, settings, *rest = calls["train"]
    assert (machine, net, task.zero_goals, settings.total_steps) == (
        BROKK_170,
        "driven nets",
        0.5,
        9,
    )
    assert rest == [5, tmp_path / "p.npz", False, None]
    said = f"{tmp_path / 'p.npz'}: trained for 9 steps; curve in {tmp_path / 'p.npz'}.csv\n"
    assert capsys.readouterr().out == said
    assert run(f"train {options} --resume --tensorboard", tmp_path / "board") == 0
    assert calls["train"][6:] == (True, tmp_path / "board")


def test_a_sweep_gets_its_seeds_from_the_first_on(
    stand: Stand, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    calls = stand(commands, load_net="nets", select_nets="driven nets")
    stand(sweep, sweep="table", show="a table")
    options = f"--actuator n.npz --out {tmp_path} --seed 5 --total-steps 9 --zero-goals 0.5"
    assert run(f"sweep {options}") == 0
    machine, net, task, settings, *rest = calls["sweep"]
    assert calls["load_net"] == (Path("n.npz"),) and calls["select_nets"] == (BROKK_170, "nets")
    assert (machine, net, task.zero_goals, settings.total_steps) == (
        BROKK_170,
        "driven nets",
        0.5,
        9,
    )
    assert rest == [range(5, 15), tmp_path, 16, None, None]
    assert calls["show"] == ("table",) and capsys.readouterr().out == "a table\n"
    assert run(f"sweep {options} --seeds 2 --poses 3 --scheduler tcp://a:1 --gains g.json") == 0
    assert calls["sweep"][4:] == (range(5, 7), tmp_path, 3, "tcp://a:1", Path("g.json"))


def test_starts_are_drawn_for_the_machines_own_sequences(
    stand: Stand, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    calls, out = stand(commands, draw_starts="poses", write_starts=None), tmp_path / "s.csv"
    assert run("starts --num 3 --out", out) == 0
    machine, sequences, num, rng = calls["draw_starts"]
    assert machine is BROKK_170 and num == 3 and same_draws(rng, 2)
    assert [s.name for s in sequences] == [s.name for s in task_sequences(BROKK_170)]
    assert calls["write_starts"] == (out, BROKK_170, "poses")
    assert capsys.readouterr().out == f"{out}: 3 start poses\n"
    assert run("starts --seed 7 --out", out) == 0
    assert calls["draw_starts"][2] == 64 and same_draws(calls["draw_starts"][3], 7)


def test_an_evaluation_gets_what_is_named_and_says_what_it_took(
    stand: Stand, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, net = tmp_path / "e.json", SimpleNamespace()
    sequences = [SimpleNamespace(name="up"), SimpleNamespace(name="to")]
    rows = [
        {"controller": name, "sequence": s, "start": start, "kind": kind} | NUMBERS
        for start, kind in enumerate(["workspace", "limits", "workspace"])
        for name in ("rl", "pid")
        for s in ("up", "to")
    ]
    rows[4]["valve_travel"] = rows[5]["valve_travel"] = None  # a figure that a run has not
    calls = stand(
        commands, load_policy=SimpleNamespace(net=net), goals_and_starts=(sequences, "poses")
    )
    stand(baselines, read_gains={"pid": "tuned"}, tune_baselines=({"pid": "tuned now"}, {}))
    stand(metrics, evaluate=(rows, {}))
    stand(commands, perfect_models={"bound": "b"})
    assert run(f"evaluate --seed 4 --plant net --commands c.csv --starts s.csv --json {out}") == 0
    assert calls["load_policy"] == (POLICY, BROKK_170)
    assert calls["goals_and_starts"] == (BROKK_170, Path("c.csv"), Path("s.csv"), 16, 4)
    assert calls["read_gains"] == (GAINS, BROKK_170, net) and "tune_baselines" not in calls
    machine, controllers, *rest = calls["evaluate"]
    assert (
        rest == [sequences, "poses", 4, net]
        and machine is BROKK_170
        and list(controllers) == ["rl", "pid"]
    )
    assert controllers["pid"] == "tuned" and controllers["rl"].policy.net is net
    written = json.loads(out.read_text())
    assert written["runs"] == rows
    about = {
        "policy": str(POLICY),
        "gains": str(GAINS),
        "plant": "net",
        "commands": "c.csv",
        "starts": "s.csv",
    }
    assert written["meta"] == metrics.metadata(BROKK_170, 4) | about
    said = capsys.readouterr()
    assert said.err == f"gains of the baselines: {GAINS}\n"
    assert said.out.splitlines() == [
        "workspace starts (2), means over 2 sequences",
        "  rl                     velocity_error_mean 0.0125, valve_travel 3.0000",
        "  pid                    velocity_error_mean 0.0125, valve_travel 3.0000",
        "limits starts (1), means over 2 sequences",
        "  rl                     velocity_error_mean 0.0125, valve_travel none",
        "  pid                    velocity_error_mean 0.0125, valve_travel 3.0000",
    ]
    alone = tmp_path / "p.npz"  # no gains beside
    assert (
        run(f"evaluate --policy {alone} --num-starts 3 --perfect-model --seed 4 --json {out}") == 0
    )
    tuning = (baselines.TUNING_RUNS, baselines.GENERATIONS, 4)
    assert calls["tune_baselines"] == (BROKK_170, net, *tuning) and calls["perfect_models"] == (
        BROKK_170,
        "poses",
    )
    assert calls["goals_and_starts"][1:] == (None, None, 3, 4) and calls["evaluate"][5] is None
    controllers = calls["evaluate"][1]
    assert list(controllers) == ["rl", "pid", "bound"] and controllers["pid"] == "tuned now"
    meta = json.loads(out.read_text())["meta"]
    about = {
        "policy": str(alone),
        "gains": "tuned now",
        "plant": "analytic",
        "commands": "up, to",
        "starts": "3",
    }
    assert meta == metrics.metadata(BROKK_170, 4) | about
    assert capsys.readouterr().err == "gains of the baselines: tuned now\n"
    assert run("evaluate --perfect-model --plant net") == 2
    wanted = (
        "brokk-min: --perfect-model: expected --plant analytic, the plant that it knows, got net\n"
    )
    assert capsys.readouterr().err == wanted
    assert run("evaluate --num-starts 3", "--gains", tmp_path / "mine.json") == 0
    assert calls["read_gains"][0] == tmp_path / "mine.json" and "bound" not in calls["evaluate"][1]


def test_preliminary_tests_are_drawn_and_written(
    stand: Stand, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    numbers = {"sim_to_real": {"tool": {"position_error_mean": 0.0123}}}
    calls, out = stand(commands, load_net="nets"), tmp_path / "new" / "folder"
    stand(preliminary, run=numbers, plots={"creep": "figure"})
    stand(figures, save=None)
    for _ in range(2):  # a folder that is there already will do
        assert run("preliminary --actuator n.npz --seed 3 --out", out) == 0
    assert calls["load_net"] == (Path("n.npz"),)
    assert calls["run"] == calls["plots"] == (BROKK_170, "nets", 3)
    assert calls["save"] == (out / "creep.png", "figure")
    meta = metrics.metadata(BROKK_170, 3) | {"actuator": "n.npz"}
    assert json.loads((out / "preliminary.json").read_text()) == {"meta": meta, **numbers}
    assert capsys.readouterr().out.splitlines()[-3:] == [
        str(out / "creep.png"),
        str(out / "preliminary.json"),
        "tool, nets beside machine over 30 s: 0.0123 m apart in the mean",
    ]
