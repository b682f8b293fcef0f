"""What a log tells: known joints are found again, and an operator's work is no excitation."""

import json
from dataclasses import replace
from functools import cache
from itertools import count

import numpy as np
import pytest
from helpers_cli import run

from brokk_min.identification.inspection import (
    CLOSED_LOOP,
    REACTS,
    feedback,
    fields,
    has_steps_alone,
    inspect,
    reaction,
    warnings,
    wrong_signs,
)
from brokk_min.identification.joint_model import is_ramp
from brokk_min.identification.logs import Log, Recording, velocity_of, write_log
from brokk_min.machine import BROKK_170

TRUE = {  # dead zones, gains [rad/s per full opening], delay [ticks of 0.05 s], tau [s]
    "boom": (0.12, 0.20, 0.5, 0.3, 2, 0.1),
    "arm": (0.05, 0.09, -0.4, -0.8, 5, 0.2),
}
NUMBERS = count()


def respond(name, u, stop=np.inf):
    """Angles [rad] of a joint of `TRUE` under the commands u (T,), in counts of 14 bits."""
    up, down, gain_up, gain_down, delay, tau = TRUE[name]
    late = np.concatenate([np.zeros(delay), u])[: len(u)]
    wanted = gain_up * np.maximum(late - up, 0) - gain_down * np.maximum(-late - down, 0)
    q = q_dot = 0.0
    angles = []
    for v in wanted:
        angles.append(q)
        q_dot += (1 - np.exp(-0.05 / tau)) * (v - q_dot)
        q = np.clip(q + 0.05 * q_dot, -stop, stop)
    step = 2 * np.pi / 2**14
    return np.rint(np.array(angles) / step) * step


def record(name, commands, stop=np.inf):
    """A recording in which one joint of `TRUE` is driven."""
    j = list(TRUE).index(name)
    u, q = np.zeros((2, len(commands), len(TRUE)))
    u[:, j], q[:, j] = commands, respond(name, commands, stop)
    return Recording(f"{name} {next(NUMBERS)}", u, q, velocity_of(q, 4))


def holds(rng, ticks=4000):
    return np.repeat(rng.uniform(-0.6, 0.6, ticks // 8), 8)


@cache
def excited(*names, recordings=4):
    rng = np.random.default_rng(0)
    repeated = [name for name in names or TRUE for _ in range(recordings)]
    return Log(tuple(TRUE), tuple(record(name, holds(rng)) for name in repeated))


@cache
def inspected(*names):
    return inspect(excited(*names))


def operator(rng, ticks=4000):
    """Commands of somebody who moves a joint slowly between two places that he looks at."""
    u, command, angle = [], 0.0, 0.0
    for tick in range(ticks):
        far = 0.3 * (-1) ** (tick // 160) - angle
        command += 0.1 * (np.clip(2.0 * far, -0.4, 0.4) - command)
        angle += 0.05 * (0.5 * max(command - 0.12, 0) - 0.3 * max(-command - 0.2, 0))
        u.append(command)
    return np.array(u) + 0.001 * rng.standard_normal(ticks)


def test_inspect__finds_what_is_true():
    reports = inspected()
    for name, (up, down, gain_up, gain_down, delay, tau) in TRUE.items():
        report = reports[name]
        assert report.sign == np.sign(gain_up) and report.explained > 0.9
        assert report.delay == pytest.approx(0.05 * delay, abs=0.051)
        assert (report.dead_zone_up, report.dead_zone_down) == pytest.approx((up, down), abs=0.02)
        assert (report.gain_up, report.gain_down) == pytest.approx((gain_up, gain_down), rel=0.1)
        assert report.tau == pytest.approx(tau, abs=0.1)
        assert report.minutes == pytest.approx(4 * 4000 / 20 / 60)
        assert report.alone == 1 and report.levels == (8, 8)


def test_inspect__does_not_count_joints_that_are_pushed_against_their_stops():
    commands = np.repeat(np.random.default_rng(0).uniform(-0.8, 0.8, 200), 40)  # 2 s each
    for name, (up, down, gain_up, gain_down, *_) in TRUE.items():
        recording = record(name, commands, stop=0.3)
        j = list(TRUE).index(name)
        assert (np.abs(recording.q[:, j]) > 0.299).mean() > 0.4
        report = inspect(Log(tuple(TRUE), (recording,)))[name]
        assert (report.dead_zone_up, report.dead_zone_down) == pytest.approx((up, down), abs=0.011)
        assert (report.gain_up, report.gain_down) == pytest.approx((gain_up, gain_down), rel=0.1)
        assert report.sign == np.sign(gain_up)


def test_inspect__finds_wide_dead_zones_and_takes_pieces_after_gaps_and_many_recordings():
    """A pilot valve opens from 0.5 on; a piece after a gap does not begin at rest."""
    u = holds(np.random.default_rng(0))
    wide = record("boom", u)._replace(u=np.repeat([[0.0, 0.0]], len(u), axis=0))
    wide.u[:, 0] = np.sign(u) * (0.5 + 0.5 * np.abs(u))  # 0.56 up, 0.60 down, gains doubled
    report = inspect(Log(tuple(TRUE), (wide,)))["boom"]
    assert (report.dead_zone_up, report.dead_zone_down) == pytest.approx((0.56, 0.60), abs=0.01)
    assert (report.gain_up, report.gain_down) == pytest.approx((1.0, 0.6), rel=0.1)
    whole = record("arm", u)
    edges = np.arange(0, len(u), 40)  # 2 s each
    parts = [Recording(f"a#{i}", *(x[i : i + 40] for x in whole[1:])) for i in edges]
    report = inspect(Log(tuple(TRUE), tuple(parts)))["arm"]
    assert (report.dead_zone_up, report.dead_zone_down) == pytest.approx(TRUE["arm"][:2], abs=0.01)
    assert (report.delay, report.tau) == pytest.approx((0.25, 0.2), abs=0.051)
    assert report.explained > 0.95


def test_inspect__says_nothing_of_a_joint_that_stands_still_or_has_one_direction():
    recordings = excited().recordings
    still = [one._replace(q=0 * one.q, q_dot=0 * one.q) for one in recordings]
    reports = inspect(Log(("q1", "q3"), tuple(still)))
    assert [(r.explained, r.sign) for r in reports.values()] == [(0.0, 0)] * 2
    assert fields(Log(("q1", "q3"), tuple(still)), reports, BROKK_170) == {}
    upwards = [record("boom", np.abs(one.u[:, 0])) for one in recordings[:4]]
    log = Log(("q1", "q3"), tuple(upwards))
    found = fields(log, inspect(log), BROKK_170)
    assert found["dead_zone_down"] == found["q_dot_down"] == {}
    assert found["dead_zone"] == found["dead_zone_up"]["q1"] == pytest.approx(0.12, abs=0.01)


def test_inspect__takes_a_part_of_each_recording_of_a_long_log():
    """The first 20,000 samples have commands within the dead zone alone."""
    within = tuple(record("boom", 0.1 * np.sin(np.arange(4000) / 9)) for _ in range(5))
    report = inspect(Log(tuple(TRUE), within + excited("boom").recordings))["boom"]
    assert (report.dead_zone_up, report.dead_zone_down) == pytest.approx((0.12, 0.20), abs=0.02)
    assert (report.gain_up, report.gain_down) == pytest.approx((0.5, 0.3), rel=0.1)


def starved(name, commands):
    """The same with a pump that gives no more flow beyond a command of 0.3."""
    u = np.zeros((len(commands), len(TRUE)))
    u[:, list(TRUE).index(name)] = commands
    return record(name, np.clip(commands, -0.3, 0.3))._replace(u=u)


def ramps(largest):
    """Two ramps up and two down, 7.5 s each, in counts of 127."""
    one = np.abs(np.abs(np.linspace(-1, 1, 300)) - 1) * largest
    return np.rint(127 * np.concatenate([one, -one, one, -one])) / 127


def test_inspect__takes_dead_zones_from_slow_ramps_where_the_pump_bends_the_curve():
    usual = starved("boom", holds(np.random.default_rng(0), 1200))

    def zones(*recordings):
        report = inspect(Log(tuple(TRUE), recordings))["boom"]
        return report.dead_zone_up, report.dead_zone_down

    assert max(np.abs(np.subtract(zones(usual), TRUE["boom"][:2]))) > 0.04
    slow = starved("boom", ramps(0.3))
    assert zones(usual, slow) == zones(slow) == pytest.approx(TRUE["boom"][:2], abs=0.01)
    still = starved("boom", 0 * ramps(0.3))  # another joint moved, and shook this one
    shaken = still._replace(q=still.q + 0.06 * np.sin(np.arange(len(still.q)) / 9)[:, None])
    assert zones(usual, slow, shaken) == zones(slow)
    within = starved("boom", ramps(0.1))  # nothing moved
    assert zones(usual, within) == zones(usual)
    upwards = starved("boom", np.maximum(ramps(0.3), -0.05))  # down within the dead zone
    assert zones(usual, upwards)[0] == pytest.approx(TRUE["boom"][0], abs=0.01)
    assert zones(usual, upwards)[1] == zones(usual)[1]


@pytest.mark.parametrize(
    ("commands", "ramp"),
    [
        (ramps(0.4), True),
        (ramps(0.4)[:200], True),  # in one direction
        (ramps(0.4)[:10], False),
        (np.full(200, 0.3), False),
        (4 * ramps(0.4), False),
        (0.4 * np.sin(2 * np.pi * np.arange(200) / 20), False),  # 1 Hz
    ],
)
def test_is_ramp__knows_slow_commands_that_begin_or_end_at_zero(commands, ramp):
    assert is_ramp(commands, 20.0) == ramp


def test_inspect__leaves_out_joints_that_are_never_driven():
    reports = inspected("boom")
    assert list(reports) == ["boom"]
    assert warnings(excited("boom"), reports) == ["arm: never driven in the log"]


def test_inspect__takes_recordings_that_are_shorter_than_a_delay():
    short = record("boom", holds(np.random.default_rng(0), 40))
    short = Recording("", *(x[5:9] for x in short[1:]))  # 0.2 s, a change of command
    report = inspect(Log(tuple(TRUE), (short,)))
    assert np.isfinite(report["boom"].gain_up)


def test_inspect__tells_which_joints_are_driven_together():
    rng = np.random.default_rng(1)
    boom, arm = (record(name, holds(rng, 400)) for name in TRUE)
    both = Recording("both", boom.u + arm.u, boom.q + arm.q, boom.q_dot + arm.q_dot)
    reports = inspect(Log(tuple(TRUE), (both, boom)))
    report = reports["boom"]
    assert (report.minutes, reports["arm"].minutes) == pytest.approx((2 / 3, 1 / 3))
    pushed = boom._replace(q=boom.q + arm.q, q_dot=boom.q_dot + arm.q_dot)  # without a command
    assert inspect(Log(tuple(TRUE), (both, pushed)))["arm"].minutes == pytest.approx(1 / 3)
    assert report.alone == pytest.approx(0.5, abs=0.05)
    assert report.together["arm"] == pytest.approx(0.5, abs=0.05)


def test_wrong_signs__names_a_reversed_command_and_warnings_too():
    (wrong,) = wrong_signs(inspected())
    assert wrong.startswith("u_arm: expected positive commands to raise q_arm, got -0.")
    assert wrong in warnings(excited(), inspected())


def test_wrong_signs__lets_a_fast_sine_pass_that_fits_as_well_reversed_and_later():
    sine = 0.5 * np.sin(2 * np.pi * 2.5 * np.arange(600) / 20)
    reports = inspect(Log(tuple(TRUE), (record("boom", sine), record("arm", sine))))
    assert not wrong_signs(reports) and reports["boom"].sign >= 0


def test_warnings__know_an_operators_work_from_an_excitation():
    rng = np.random.default_rng(2)
    work = Log(tuple(TRUE), tuple(record("boom", operator(rng)) for _ in range(4)))
    (about, _) = warnings(work, inspect(work))
    assert about.startswith("boom: ") and "fast changes of command in " in about
    assert about.endswith("scores hold for such driving alone")
    assert len(warnings(excited("boom"), inspected("boom"))) == 1  # the arm alone
    late = replace(inspected("boom")["boom"], delay=0.4)
    assert warnings(excited("boom"), {"boom": late})[0].endswith("got 0.40 s, perhaps more")


def duties(*levels, ticks=60):
    """Commands held for some ticks each, with pauses as long, up and down."""
    steps = np.stack([levels, np.zeros(len(levels)), -np.array(levels), np.zeros(len(levels))])
    return np.repeat(np.tile(steps.T.ravel(), 6), ticks)


def ramped(u):
    return np.convolve(u, np.full(4, 1 / 4))


NOISE = np.random.default_rng(0).uniform(-0.002, 0.002, 2400)  # of full command
TIME = np.arange(1200) / 20
BUMP = (np.abs(TIME - 30) < 0.25) * 0.5  # s; one short full command


@pytest.mark.parametrize(
    ("commands", "expected"),
    [
        ([duties(0.4, 0.5, 0.6, 0.8, 1.0)], True),
        ([ramped(duties(0.4, 0.7, 1.0, ticks=40))], True),  # each step in 0.2 s
        ([duties(0.4, 0.5, 0.6, 0.8, 1.0, ticks=20) + NOISE], True),
        ([duties(0.4, 1.0), 0 * TIME], True),  # the other one moves without commands
        ([np.full(200, x) for x in (0.4, 0.5, -0.5, 1.0)], True),  # a recording for each step
        ([duties(0.4, 1.0), 0.9 * np.sin(TIME)], False),
        ([duties(0.1, 0.2, 0.4, 0.5, 0.7, 0.8, 1.0)], False),
        ([duties(0.5, 1.0, ticks=3)], False),  # fast switching
        ([0.5 * np.sin(TIME) + BUMP], False),
        ([np.abs(np.sin(TIME))], False),  # one way
        ([0 * TIME], False),
    ],
)
def test_has_steps_alone__knows_step_responses_from_driving(commands, expected):
    """Of one joint, or of one after the other."""
    recordings = []
    for i, u in enumerate(commands):
        column = int(i > 0 and len(commands) == 2)
        both = np.zeros((len(u), 2))
        both[:, column] = u
        q = np.cumsum(0.01 + 0.3 * both, axis=0) / 20
        recordings.append(Recording(f"r{i}", both, q, velocity_of(q, 4)))
    log = Log(("boom", "arm"), tuple(recordings))
    reports = inspect(log)
    assert has_steps_alone(reports) == expected
    if expected:  # steps up and down seem to follow the angle
        assert not [text for text in warnings(log, reports) if "follow the angle" in text]


def test_feedback__tells_who_goes_between_places_from_an_excitation():
    rng = np.random.default_rng(2)
    goals, q, u = np.repeat([0.5, -0.5] * 50, 60), [0.0], []
    for goal in goals:
        u.append(2.0 * (goal - q[-1]))
        q.append(q[-1] + 0.05 * 0.5 * u[-1])
    closed = Recording("", np.array(u)[:, None], np.array(q[:-1])[:, None], np.zeros((6000, 1)))
    assert feedback([closed], 0, 20.0) < CLOSED_LOOP
    assert feedback([record("boom", holds(rng))], 0, 20.0) > CLOSED_LOOP


def test_reaction__tells_a_controller_with_random_goals_from_an_excitation():
    """A PI controller of the measured velocity of a joint; its goal changes every 3 s."""
    rng = np.random.default_rng(3)
    q, u, integral, q_dot = [0.0] * 4, [], 0.0, 0.0
    for goal in np.repeat(rng.uniform(-0.2, 0.2, 60), 60):
        error = goal - (q[-1] - q[-4]) / 0.15
        integral += 0.05 * error
        u.append(0.2 * np.sign(goal) + 0.5 * error + 2.0 * integral)
        q_dot += 0.3 * (0.5 * u[-1] - q_dot) + 0.002 * rng.standard_normal()
        q.append(q[-1] + 0.05 * q_dot)
    angles = np.array(q[3:-1])[:, None]
    closed = Recording("", np.array(u)[:, None], angles, velocity_of(angles, 4))
    assert reaction([closed], 0) > 0.1 > REACTS
    noisy = holds(rng) + 0.005 * rng.standard_normal(4000)
    assert reaction([record("boom", noisy)], 0) < REACTS
    held = closed._replace(u=np.repeat(np.resize([0.3, -0.3], (90, 1)), 40, axis=0))
    assert reaction([held], 0) == 0.0  # all small changes are none
    two = Recording("", *(np.tile(x, 2) for x in closed[1:]))
    log = Log(tuple(TRUE), (two,))
    assert "commands follow the measured motion (7" in warnings(log, inspect(log))[-1]


def test_warnings__know_the_range_of_a_machine():
    log = excited("boom")._replace(joints=("q1", "q3"))  # q1: 4.3 rad
    reports = inspect(log)
    reports["q1"] = replace(reports["q1"], low=-1.0, high=1.0)
    about, _ = warnings(log, reports, BROKK_170)
    assert about == "q1: 47% of the range: scores hold for such driving alone"
    reports["q1"] = replace(reports["q1"], low=-2.2, high=2.6, explained=0.05)
    beyond, unexplained, _ = warnings(log, reports, BROKK_170)
    wanted = "q1: expected angles of -2.14 to 2.14, got -2.20 to 2.60: another unit, zero or joint?"
    assert beyond == wanted
    assert unexplained.startswith("q1: its commands explain 5% of its motion")


def test_warnings__know_numbers_of_a_machine_that_the_log_contradicts():
    """The least dead zone is 0.12; at the limit the joint moves at 0.5 * (80 / 127 - 0.12)."""
    log = excited("boom")._replace(joints=("q1", "q3"))
    reports = inspect(log)

    def found(**changes):
        joints = tuple(replace(joint, q_dot_up=0.26) for joint in BROKK_170.joints)
        machine = replace(BROKK_170, joints=joints, **changes)
        return [text for text in warnings(log, reports, machine) if " by this log" in text]

    assert found() == []
    wide = "".join(found(dead_zone=0.2))
    assert wide.startswith("q1: dead_zone: expected at most 0.1") and "by this log, got 0.2" in wide
    minutes = [one._replace(q=60 * one.q, q_dot=60 * one.q_dot) for one in log.recordings]
    log = log._replace(recordings=tuple(minutes))
    reports = inspect(log)
    assert [text[:14] for text in found()] == ["q1: q_dot_up: ", "q1: q_dot_down"]
    assert found()[0].endswith(" by this log, 0.26 now: time in s, angles in rad?")


def test_fields__are_those_of_the_machine():
    """A gain of 0.5 from a dead zone of 0.12 on: 0.5 * (80 / 127 - 0.12) rad/s at the limit."""
    report = replace(inspected("boom")["boom"], dead_zone_up=0.12, dead_zone_down=0.2)
    report = replace(report, gain_up=0.5, gain_down=0.3)
    reports = {"q1": report, "q3": replace(report, dead_zone_up=0.05)}
    reports["q4"] = replace(report, dead_zone_up=0.01, sign=-1)  # left out
    reports["q5"] = replace(report, dead_zone_up=0.01, explained=0.05)  # left out
    names = ("q1", "q3", "q4", "q5")
    holds = [np.full(400, 80 / 127), np.full(400, 0.9)]  # at the limit, beyond it
    rest = np.zeros((400, 4))
    moving = np.tile(np.repeat([0.2, 0.3, 0.9], [185, 25, 190])[:, None], 4)
    log = Log(names, tuple(Recording("", rest + u[:, None], rest, moving) for u in holds))
    assert fields(log, {"q4": reports["q4"]}, BROKK_170) == {}
    found = fields(log._replace(recordings=log.recordings[1:]), reports, BROKK_170)
    assert (found["dead_zone"], found["largest_dead_zone"]) == (0.05, 0.25)
    assert (found["dead_zone_up"], found["dead_zone_down"]["q3"]) == ({"q1": 0.12, "q3": 0.05}, 0.2)
    assert found["q_dot_up"]["q1"] == pytest.approx(0.255, abs=1e-3)
    assert found["q_dot_down"]["q1"] == pytest.approx(0.129, abs=1e-3)
    short = Recording("", rest[:210] + 80 / 127, rest[:210], moving[:210])  # 210 of 400 ticks
    found = fields(log._replace(recordings=(short, log.recordings[1])), reports, BROKK_170)
    assert found["q_dot_up"] == {"q1": 0.3, "q3": 0.3}  # held for half a second: 25 of 200 ticks
    assert found["q_dot_down"]["q1"] == pytest.approx(0.129, abs=1e-3)


def test_commands__print_what_a_log_tells_and_refuse_reversed_commands(tmp_path, capsys):
    write_log(tmp_path / "log.npz", excited(recordings=2))
    assert run(f"inspect '{tmp_path}/log.npz' --json '{tmp_path}/i.json'") == 0
    printed = capsys.readouterr().out
    assert "4 recordings, 0 begin after a gap; q_dot estimated" in printed
    report = json.loads((tmp_path / "i.json").read_text())
    assert report["joints"]["arm"]["sign"] == -1
    assert run(f"fit '{tmp_path}/log.npz' --steps 1 --out '{tmp_path}/n.npz'") == 1
    assert "log.npz: u_arm: expected positive commands to raise q_arm" in capsys.readouterr().err
    assert run("inspect") == 2


def test_score__scores_nets_on_other_logs_and_fit_has_a_learning_curve(tmp_path, capsys):
    log = excited("boom", recordings=12)
    log = Log(
        ("boom",), tuple(Recording(r.name, *(x[:400, :1] for x in r[1:])) for r in log.recordings)
    )
    write_log(tmp_path / "log.npz", log._replace(recordings=log.recordings[:8]))
    write_log(tmp_path / "test.npz", log._replace(recordings=log.recordings[8:]))
    fit = f"fit '{tmp_path}/log.npz' --test '{tmp_path}/test.npz' --steps 2 --curve"
    assert run(f"{fit} --out '{tmp_path}/n.npz' --json '{tmp_path}/f.json'") == 0
    scores = json.loads((tmp_path / "f.json").read_text())
    minutes = [point["minutes"] for point in scores["curve"]]
    np.testing.assert_allclose(np.array(minutes) / minutes[-1], [1 / 8, 1 / 4, 1 / 2, 1], rtol=0.03)
    assert all("boom" in point["free_run_rmse"] for point in scores["curve"])
    printed = capsys.readouterr().out
    assert printed.count("fitted to ") == 4 and "minutes" in printed
    assert run(f"score '{tmp_path}/n.npz' '{tmp_path}/test.npz' --json '{tmp_path}/s.json'") == 0
    assert "warnings for boom:\n  free runs of 10 s are off by " in capsys.readouterr().out
    assert (tmp_path / "n.png").read_bytes().startswith(b"\x89PNG")
    again = json.loads((tmp_path / "s.json").read_text())
    for key in ("one_step_rmse", "persistence_rmse", "free_run"):
        assert again["joints"]["boom"][key] == scores["joints"]["boom"][key]
