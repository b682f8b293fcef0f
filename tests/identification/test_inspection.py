"""What a log tells: known joints are found again, and a log that cannot be of a machine is told."""

import re
from dataclasses import replace

import numpy as np
import pytest

from brokk_min.actuator import PLANT
from brokk_min.beyond.rich_excitation import RICH
from brokk_min.fit import SINE, Log, Recording, collect, velocity_of
from brokk_min.identification.advice import mixed_units, resting, table, warnings, wrong_signs
from brokk_min.identification.inspection import JointReport, inspect, repeated
from brokk_min.identification.validation import task_log
from brokk_min.machine import BROKK_170
from examples.mini_excavator import MINI_EXCAVATOR

TRUE = {  # dead zones, gains [rad/s per full opening], delay [ticks of 0.05 s], tau [s]
    "boom": (0.12, 0.20, 0.5, 0.3, 2, 0.1),
    "arm": (0.05, 0.09, -0.4, -0.8, 5, 0.2),
}


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
    return Recording(name, u, q, velocity_of(q, 4))


def holds(seed=0, ticks=4000, hold=8, largest=0.6):
    levels = np.random.default_rng(seed).uniform(-largest, largest, ticks // hold)
    return np.repeat(levels, hold)


def log_of(*recordings):
    return Log(tuple(TRUE), recordings)


@pytest.mark.parametrize("name", TRUE)
def test_inspect__finds_what_is_true(name):
    """Also of a joint that is pushed against its stops, where samples do not count."""
    up, down, gain_up, _, delay, _ = TRUE[name]
    free = [record(name, holds(seed)) for seed in range(4)]
    pushed = [record(name, holds(hold=40, ticks=8000, largest=0.8), stop=0.3)]
    assert (np.abs(pushed[0].q).max(axis=1) > 0.299).mean() > 0.4
    for recordings, zone in ((pushed, 0.011), (free, 0.02)):
        report = inspect(log_of(*recordings))[name]
        assert report.dead_zone == pytest.approx((up, down), abs=zone)
        assert report.sign == np.sign(gain_up)
    assert report.explained > 0.9
    assert report.delay == pytest.approx(0.05 * delay, abs=0.051)
    assert report.minutes == pytest.approx(4 * 4000 / 20 / 60)
    angles = np.concatenate([respond(name, holds(seed)) for seed in range(4)])
    assert (report.low, report.high) == pytest.approx((angles.min(), angles.max()))


def test_inspect__counts_minutes_in_which_a_joint_is_driven():
    """One recording: a joint after the other, 200 s of each."""
    one = record("boom", np.concatenate([holds(), 0 * holds()]))
    other = record("arm", np.concatenate([0 * holds(), holds()]))
    both = one._replace(**{x: getattr(one, x) + getattr(other, x) for x in ("u", "q", "q_dot")})
    for report in inspect(log_of(both)).values():
        assert report.minutes == pytest.approx((200 + 10) / 60, abs=0.01)


def test_warnings__blame_neither_sign_nor_clock_where_little_is_explained():
    """Most of the motion is another one; a part follows reversed commands."""
    one = record("boom", holds())
    q_dot = -0.1 * one.u[:, 0] + np.random.default_rng(0).normal(0, 0.1, len(one.u))
    one.q[:, 0] = np.cumsum(q_dot) / 20
    log = log_of(one._replace(q_dot=velocity_of(one.q, 4)))
    report = inspect(log)["boom"]
    told = " ".join(warnings(log, {"boom": report}, None))
    assert 0.05 < report.explained < 0.3 and report.sign == 0
    assert "to raise" not in told and "before" not in told


def test_inspect__has_the_fastest_motions_of_the_log():
    """Gains of 0.5 and 0.3 from dead zones of 0.12 and 0.2 on; commands of 0.6 held for 3 s."""
    held = np.tile(np.repeat([0.6, 0.0, -0.6, 0.0], 60), 16)
    report = inspect(log_of(record("boom", held)))["boom"]
    assert report.fastest == pytest.approx((0.5 * (0.6 - 0.12), 0.3 * (0.6 - 0.2)), rel=0.03)


def test_inspect__leaves_out_joints_without_commands_and_directions_without_motion():
    still = record("boom", holds())._replace(q=np.zeros((4000, 2)), q_dot=np.zeros((4000, 2)))
    report = inspect(log_of(still))["boom"]
    assert (report.explained, report.sign) == (0, 0)
    log = log_of(record("boom", np.abs(holds())))
    upwards = inspect(log)
    assert list(upwards) == ["boom"]
    assert "arm: expected commands in the log, got none" in warnings(log, upwards, None)
    assert upwards["boom"].dead_zone[0] == pytest.approx(0.12, abs=0.011)
    short = Recording("", *(x[5:9] for x in record("boom", holds())[1:]))  # 0.2 s
    assert np.isfinite(inspect(log_of(short))["boom"].explained)


def test_inspect__names_recordings_in_which_angles_fall_under_positive_commands():
    """Of five that reach the stops; not fast sines, which fit as well reversed and later."""
    recordings = []
    for seed, sign in enumerate((1, -1, 1, 1, -1)):
        one = record("boom", holds(seed, 800), stop=0.3)
        recordings.append(Recording(f"{seed}", one.u, sign * one.q, sign * one.q_dot))
    sines = [0.5 * np.sin(2 * np.pi * 2.5 * np.arange(ticks) / 20) for ticks in (100, 600)]
    reports = inspect(log_of(*recordings, *(record("boom", sine, 0.3) for sine in sines)))
    assert reports["boom"].opposite == ["1", "4"]
    (told,) = wrong_signs(reports)
    assert "in all recordings or in none, got some in ['1', '4']" in told


def test_inspect__finds_no_wrong_sign_in_sound_logs():
    """Not even in short recordings, or where a joint creeps under commands that open no valve."""
    for seed, excitation in enumerate((SINE, RICH)):
        rng = np.random.default_rng(seed)
        assert not [*wrong_signs(inspect(collect(BROKK_170, 0.02, rng, PLANT, excitation)))]
    log = task_log(BROKK_170, 5, 8.0, np.random.default_rng(0))
    assert not [*wrong_signs(inspect(log))]
    few = collect(MINI_EXCAVATOR, 0.01, np.random.default_rng(0), PLANT, RICH)
    assert inspect(few)["bucket"].still == []  # two of four are at a stop, one rests for 0.48 s
    ticks = np.arange(600)
    creep = np.stack([-0.02 * ticks / 600, 0 * ticks], axis=1)
    u = np.stack([0.004 + 0 * ticks, 0 * ticks], axis=1)
    sinks = Recording("sinks", u, creep, velocity_of(creep, 4))
    assert inspect(log_of(record("boom", holds()), sinks))["boom"].opposite == []


@pytest.mark.parametrize("slope", [1.0, -1.0, 0.5])
def test_inspect__sees_an_angle_to_the_ground(slope):
    """The arm's angle to the ground has that of the boom in it; half of it is a coupling."""
    mix = [[1, slope], [0, 1]]
    recordings = (record(name, holds(hold=40)) for name in TRUE)
    mixed = (one._replace(q=one.q @ mix, q_dot=one.q_dot @ mix) for one in recordings)
    reports = inspect(log_of(*mixed))
    assert reports["boom"].follows == {}
    expected = {} if slope == 0.5 else {"boom": pytest.approx(slope, abs=1e-6)}
    assert reports["arm"].follows == expected
    told = [text for text in warnings(log_of(), reports, None) if "angle to the ground" in text]
    assert len(told) == len(expected)


GOOD = JointReport(
    minutes=20.0, low=-2.1, high=2.1, fastest=(0.2, 0.2), largest=(0.5, 0.5), sign=1,
    explained=0.9, coarse=0.95, delay=0.1, tau=0.1, dead_zone=(0.07, 0.07), step=0.01,
    by_zones=0.9, still=[], opposite=[], follows={},
)  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, []),
        ({"minutes": 9.96, "delay": 0.4, "coarse": 0.97}, []),  # nothing that its figures deny
        ({"minutes": 9.0}, ["q1: expected 10 minutes, got 9.0"]),
        ({"low": -0.5}, ["q1: expected 70% of its range or more, got -0.50 to 2.10"]),
        ({"high": 120.0}, ["q_q1: expected -2.14 to 2.14, got -2.10 to 120.00: in degrees"]),
        ({"low": 4.2, "high": 8.3}, ["q_q1: expected .* got 4.20 to 8.30: another zero or joint"]),
        ({"low": -0.036, "high": 0.036}, ["q1: .* got -0.04 to 0.04: already in radians"]),
        ({"low": 0.3, "high": 0.301}, ["q_q1: expected motion, got 0.3 to 0.301"]),
        ({"high": 120.0, "low": -200.0}, ["q_q1: expected .* got -200.00 to 120.00: another zero"]),
        ({"explained": 0.05, "coarse": 0.1}, ["q1: expected 60% of its motion .*, got 5%"]),
        ({"explained": 0.4}, ["q_q1: expected angles finer than .* steps of 0.01 rad"]),
        ({"explained": 0.4, "other": "q3"}, ["q1: expected motion by u_q1, got motion by u_q3"]),
        (
            {"explained": 0.4, "other": "q3", "sign": -1, "early": 0.2},
            ["q1: .* got motion by u_q3"],
        ),
        (
            {"explained": 0.1, "coarse": 0.1, "largest": (0.5, 0.0), "opposite": ["x"]}
            | {"idle": ("x",)},
            ["u_q1: expected commands of both signs, got one"],
        ),
        ({"idle": ("x",)}, ["u_q1: expected commands where it moves, got none in .'x'."]),
        ({"sign": -1, "low": -2.1, "high": 1.9}, ["u_q1: .* on a bus its encoder_sign"]),
        ({"delay": 0.6}, ["q1: expected motion within 0.6 s", "history: .*, got 0.65 s"]),
        ({"still": ["x"]}, ["q1: expected commands to move it, got .* .'x'."]),
        ({"rest": 0.1}, ["u_q1: expected 0 at rest, got 0.1"]),
        (
            {"rest": 0.5, "largest": (0.9, 0.0), "explained": 0.5, "dead_zone": (0.56, np.nan)},
            ["u_q1: expected 0 at rest, got 0.5"],
        ),
        (
            {"largest": (0.063, 0.063), "dead_zone": (0.01, 0.01), "by_zones": 0.2},
            ["u_q1: expected commands up to 0.63 at its fastest motion, got at most 0.063"],
        ),
        (
            {"fastest": (0.05, 0.05), "largest": (0.63, 0.63), "dead_zone": (0.0, 0.0)}
            | {"by_zones": 0.2},
            ["q1: expected the machine's .* fastest motion, got .0.05, 0.05."],
        ),
        (
            {"one_size": True},
            ["u_q1: expected commands of many sizes, because .*, got one in each"],
        ),
        (
            {"dead_zone": (0.27, 0.07), "by_zones": 0.8},
            ["q1: .* dead_zone .0.07, 0.07., got .0.27"],
        ),
        ({"dead_zone": (0.27, 0.07)}, []),  # it explains as much as that of the machine
        ({"fastest": (0.3, 0.2)}, ["q1: expected the machine's .* fastest motion, got .0.3, 0.2."]),
        ({"fastest": (0.2, 0.05)}, []),
        (
            {"fastest": (0.2, 0.05), "largest": (0.1, 80 / 127)},
            ["q1: expected the machine's .* fastest motion, got .0.2, 0.05."],
        ),
        ({"early": 0.2}, ["q1: expected motion after its commands, got it 0.20 s before: another"]),
        ({"explained": 0.73, "largest": (0.5, 0.0)}, ["u_q1: expected commands of both signs"]),
        ({"largest": (0.006, 0.0), "idle": ("x",)}, ["u_q1: expected commands in parts of full"]),
        ({"largest": (0.0, 0.0), "idle": ("x",), "coarse": 0.9}, ["u_q1: .* got none in .'x'."]),
        ({"largest": (0.006, 0.0)}, ["u_q1: expected commands in parts of full command, up to 1"]),
        ({"opposite": ["x"]}, ["u_q1: expected positive commands to raise q_q1 in all"]),
        ({"sign": -1}, ["u_q1: expected positive commands to raise q_q1, got falling"]),
    ],
)
def test_warnings__know_what_a_log_lacks_and_where_it_contradicts_its_machine(changes, expected):
    log = Log(("q1",), (), warnings=("left out",))
    first, *found = warnings(log, {"q1": GOOD._replace(**changes)}, BROKK_170)
    assert first == "left out" and len(found) == len(expected)
    assert all(re.match(start, text) for text, start in zip(found, expected, strict=True))


def test_warnings__name_the_same_angle_in_two_columns():
    recordings = [record(name, holds()) for name in TRUE]
    twins = [one._replace(q=one.q[:, [0, 0]], q_dot=one.q_dot[:, [0, 0]]) for one in recordings]
    told = [*warnings(log_of(*twins), inspect(log_of(*twins)), None)]
    assert "q_arm: expected a column of its own, got that of q_boom" in told
    assert not any("60%" in text or "ground" in text for text in told)


SEVEN = [holds(seed, 800, 20) for seed in range(7)]


def test_warnings__name_recordings_in_degrees_among_others():
    each = [record("boom", u)._replace(name=str(i)) for i, u in enumerate(SEVEN[:4])]
    each[2:] = [one._replace(q=57.3 * one.q, q_dot=57.3 * one.q_dot) for one in each[2:]]
    log = log_of(*each)
    wanted = (
        "q_boom: expected one unit in all recordings, got larger angles in ['2', '3']: degrees?"
    )
    assert mixed_units(log) == {"boom": wanted} and mixed_units(log_of(*each[:2])) == {}
    told = [*warnings(log, inspect(log), None)]
    assert [text for text in told if "boom" in text] == [wanted]
    assert mixed_units(log_of(*each[2:])) == {}  # all of them


def boom(*commands, change=lambda one: one):
    """The report of the boom, driven by each of these commands; `change` alters every third."""
    each = [record("boom", u) for u in commands]
    each[::3] = [change(one) for one in each[::3]]
    each = [one._replace(name=str(i), q_dot=velocity_of(one.q, 4)) for i, one in enumerate(each)]
    return inspect(log_of(*each))["boom"]


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_inspect__names_recordings_in_which_commands_do_not_move_the_joint(share):
    """The pump is off, or the engine stalls; dead zones and delay are those of the others."""

    def stopped(one):
        last = int(share * len(one.q))
        return one._replace(q=np.where(np.arange(len(one.q))[:, None] < last, one.q, one.q[last]))

    report = boom(*SEVEN, change=stopped)
    assert report.still == ["0", "3", "6"] and report.explained > 0.95
    assert report.dead_zone == pytest.approx((0.12, 0.20), abs=0.025)
    assert boom(*SEVEN).still == []
    everywhere = boom(*(0.5 * (u > 0) for u in SEVEN[:1]), change=stopped)
    assert (everywhere.still == ["0"]) == (share == 0)


def test_inspect__knows_that_after_a_gap_a_joint_is_in_motion():
    """Pieces of 3 s, of joints that are driven all the time."""
    slow = 0.6 * np.sin(2 * np.pi * 0.1 * np.arange(800) / 20)
    each = [record("boom", u) for u in (*SEVEN[:2], slow, -slow)]
    pieces = [
        Recording(f"{i}#{k}", *(x[k : k + 60] for x in one[1:]))
        for i, one in enumerate(each)
        for k in range(0, 720, 65)
    ]
    report = inspect(log_of(*pieces))["boom"]
    assert report.delay == inspect(log_of(*each))["boom"].delay == pytest.approx(0.1)
    assert report.still == report.opposite == [] and report.early == 0


def test_inspect__knows_that_zeros_and_signs_differ_between_recordings():
    """Then joints are at their stops at other angles, or in one recording at the other end."""
    commands = [holds(seed, hold=40, ticks=2000, largest=0.8) for seed in range(6)]
    pushed = [record("boom", u, stop=0.3)._replace(name=str(i)) for i, u in enumerate(commands)]
    zeros = 0.02 * np.array([-1, 1, 0.5, -0.5, 0, 1])
    moved = [one._replace(q=one.q + zero) for one, zero in zip(pushed, zeros, strict=True)]
    assert inspect(log_of(*pushed))["boom"].still == []
    assert inspect(log_of(*moved))["boom"].still == []
    moved[0] = pushed[0]._replace(q=pushed[0].q + 0.1)  # a sixth of the range
    assert inspect(log_of(*moved))["boom"].still == []
    raised = [one._replace(q=one.q + 0.5) for one in pushed]
    raised[2] = raised[2]._replace(q=-raised[2].q, q_dot=-raised[2].q_dot)
    report = inspect(log_of(*raised))["boom"]
    assert report.opposite == ["2"] and report.still == []
    assert resting({"boom": GOOD._replace(still=["x"], idle=("y",))}) == {"x", "y"}


def test_inspect__names_recordings_without_commands():
    """Not those in which a joint that is not driven has a noisy angle."""
    lost = boom(*SEVEN, change=lambda one: one._replace(u=0 * one.u))
    assert lost.idle == ("0", "3", "6") and boom(*SEVEN).idle == ()
    noise = np.random.default_rng(0).normal(0, 0.02, (800, 2))
    parked = record("arm", SEVEN[0])._replace(name="parked")
    parked = parked._replace(q=parked.q + noise, q_dot=parked.q_dot + 20 * noise)
    assert inspect(log_of(*(record("boom", u) for u in SEVEN), parked))["boom"].idle == ()


def test_inspect__names_recordings_of_another_scale_or_delay():
    """Half of the commands, or a clock that is 0.3 s off, in one of seven recordings."""

    def last(change):
        each = [record("boom", u)._replace(name=str(i)) for i, u in enumerate(SEVEN)]
        return inspect(log_of(*each[:6], change(each[6])))["boom"]

    sound = last(lambda one: one)
    half = last(lambda one: one._replace(u=0.5 * one.u))
    late = last(lambda one: one._replace(u=np.append(one.u[6:], 0 * one.u[:6], axis=0)))
    found = [(report.scaled, report.later) for report in (sound, half, late)]
    assert found == [((), ()), (("6",), ()), ((), ("6",))]
    told = [*warnings(log_of(), {"boom": half, "arm": late}, None)]
    assert any(text.startswith("u_boom: expected one scale in all recordings") for text in told)
    assert any(text.startswith("arm: expected one delay in all recordings") for text in told)


def test_inspect__does_not_name_a_recording_for_its_last_samples():
    """In 0.3 s a valve that was closed does not open."""
    last = record("boom", np.append(np.full(200, 0.05), np.full(6, -0.6)))
    last = last._replace(name="last", q=0.02 + 0 * last.q, q_dot=0 * last.q_dot)
    log = log_of(*(record("boom", u) for u in SEVEN), last._replace(q=last.q + 1e-4 * last.u))
    assert inspect(log)["boom"].still == []


def test_inspect__does_not_take_short_pulses_for_a_stall():
    """The valves of this machine open late: three pulses of 0.2 s, 3 s apart, do not move it."""
    log = collect(BROKK_170, 0.02, np.random.default_rng(4), PLANT, RICH)
    assert [report.still for report in inspect(log).values()] == 5 * [[]]


def test_inspect__names_short_stalls_and_a_joint_that_sags():
    """Neither is taken for a wrong sign, nor is a joint that rests, whose velocity is rounding."""

    def stalls(one):
        steps = np.diff(one.q, axis=0, prepend=one.q[:1])
        steps[400:500] = 0  # for 5 s
        return one._replace(q=one.q[0] + np.cumsum(steps, axis=0))

    def sags(one):
        return one._replace(q=one.q[0] - 0.0005 * np.arange(len(one.q))[:, None] * [1, 0])

    for change in (stalls, sags):
        report = boom(*SEVEN, change=change)
        assert report.still == ["0", "3", "6"] and report.opposite == []
        assert report.explained > 0.95
    rests = record("boom", 0.1 * np.sin(np.arange(4000)))
    rests = rests._replace(name="rests", q_dot=rests.q_dot - 1e-16 * np.sign(rests.u))
    assert inspect(log_of(*(record("boom", u) for u in SEVEN), rests))["boom"].opposite == []
    nearly = record("boom", np.repeat([0.0, 0.14, 0.0], [10, 10, 20]))  # it should rise by 5 mrad
    noisy = nearly._replace(name="noisy", q=-0.6 * nearly.q)
    reports = inspect(log_of(*(record("boom", u) for u in SEVEN), noisy))
    assert reports["boom"].opposite == []
    clear = record("boom", np.repeat([0.0, 0.18, 0.0], [10, 10, 20]))  # by 15 mrad
    fallen = clear._replace(name="fallen", q=-0.6 * clear.q)
    reports = inspect(log_of(*(record("boom", u) for u in SEVEN), fallen))
    assert reports["boom"].opposite == ["fallen"]


def test_inspect__tells_steps_of_an_encoder_and_noise_from_another_motion():
    step, rng = np.deg2rad(1.0), np.random.default_rng(0)
    for spoil in (lambda q: np.rint(q / step) * step, lambda q: q + rng.normal(0, 0.008, q.shape)):
        each = [record("boom", u) for u in SEVEN]
        each = [one._replace(q=spoil(one.q)) for one in each]
        report = inspect(log_of(*each))["boom"]
        assert report.explained < 0.75 and report.coarse > 0.9
        assert report.step == pytest.approx(step, rel=0.6)
    assert boom(*SEVEN).coarse - boom(*SEVEN).explained < 0.05


def test_inspect__knows_commands_at_rest_and_switches():
    pauses = [u * (np.arange(len(u)) % 200 < 100) for u in SEVEN]
    shifted = [record("boom", u) for u in pauses]
    shifted = [one._replace(u=one.u + 0.1) for one in shifted]
    assert inspect(log_of(*shifted))["boom"].rest == pytest.approx(0.1)
    parked = [one._replace(u=one.u + 0.15) for one in (record("boom", u) for u in SEVEN[:2])]
    arm = [
        one._replace(u=one.u + np.array([0.15, 0])) for one in (record("arm", u) for u in SEVEN[2:])
    ]
    assert inspect(log_of(*parked, *arm))["boom"].rest == pytest.approx(0.15)  # parked
    switched = boom(*(np.sign(u) for u in pauses))
    assert switched.one_size and switched.rest == 0.0
    assert np.isnan(switched.dead_zone).all() and switched.still == []
    sound = boom(*pauses)
    assert not sound.one_size and sound.rest == 0.0
    upwards = boom(*(np.abs(u) for u in SEVEN))  # it rests under commands within the dead zone
    assert upwards.rest == 0.0
    assert upwards.dead_zone == pytest.approx((0.12, np.nan), abs=0.02, nan_ok=True)
    _, told = table({"boom": upwards})
    assert "dead_zone=(0.1" in told and ", ?)" in told


def test_inspect__compares_dead_zones_with_those_of_the_machine():
    """The boom opens at 0.12 and 0.20."""
    log = log_of(*(record("boom", u) for u in SEVEN))
    for zone, differs in (((0.12, 0.20), False), ((0.07, 0.07), True), ((0.27, 0.27), True)):
        joints = [
            replace(BROKK_170.joints[i], name=name, dead_zone=zone) for i, name in enumerate(TRUE)
        ]
        machine = replace(BROKK_170, joints=tuple(joints), q_start=())
        told = warnings(log, inspect(log, machine), machine)
        assert any("boom: expected the machine's dead_zone" in text for text in told) == differs


def test_repeated__names_recordings_that_are_there_twice():
    """Also if a table has rounded them, and by another name; not two that stand still."""
    first, other = record("boom", holds(0)), record("boom", holds(1))
    again = first._replace(name="again", q=first.q.round(6))
    rest = Recording("rest", *(np.zeros((50, 2)) for _ in range(3)))
    assert repeated([first, other, again, rest, rest], ()) == ["again"]
    part = Recording("part", *(x[7:3000] for x in first[1:]))
    moved = first._replace(name="moved", q=first.q + 0.1)
    assert repeated([other, first, part, moved], ()) == ["part", "moved"]
    again_driven = first._replace(name="driven", q=first.q * 1.01)
    assert repeated([first, again_driven], ()) == []
    assert repeated([other, again], [first]) == ["again"]
    log = log_of(first, again)
    assert "recordings: expected each once, got again ['again']" in warnings(log, {}, None)
