"""The machine as a value, the PWM code, the command limit, the encoders, the velocity estimator."""

from __future__ import annotations

import dataclasses
import inspect
import re
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from strategies import machines, posed, reals

from brokk_min import machine as machine_module
from brokk_min.actuator import plant_reset, plant_step
from brokk_min.machine import (
    BROKK_170,
    Joint,
    Machine,
    decode_pwm,
    encode_pwm,
    limit_command,
    read_encoder,
    valve_command,
    valve_opening,
)

# --- validation -----------------------------------------------------------------------------------


def changed(joint: int | None = None, **fields: Any) -> Machine:
    """The Brokk with other fields, or with other fields of one joint."""
    if joint is not None:
        joints = list(BROKK_170.joints)
        joints[joint] = replace(joints[joint], **fields)
        fields = {"joints": tuple(joints)}
    return replace(BROKK_170, **fields)


NAN, INF = float("nan"), float("inf")
LOCKED = tuple(replace(joint, driven=False) for joint in BROKK_170.joints)
BAD = [
    ({"joints": ()}, ["joints", "at least one", "none"]),
    ({"joints": LOCKED}, ["joints", "driven", "none"]),
    ({"joint": 1, "name": "q1"}, ["joints", "different names", "['q1', 'q1', 'q3', 'q4', 'q5']"]),
    ({"joint": 1, "encoder_node": 1}, ["joints", "different CANopen nodes", "[1, 1, 3, 4, 5, 16]"]),
    ({"joint": 3, "q_max": 0.6}, ["q4.q_max", "above 0.6", "got 0.6"]),
    ({"joint": 4, "cylinder_angle": 0.0}, ["q5.cylinder_angle", "(0, pi)", "0.000 to 2.000"]),
    ({"joint": 4, "q_max": np.pi - 0.4}, ["q5.cylinder_angle", "(0, pi)", "0.400 to 3.142"]),
    (
        {"joint": 0, "kind": "prismatic", "cylinder_base": 0.1},
        ["q1.cylinder_angle", "revolute", "got"],
    ),
    ({"joint": 0, "kind": "linear"}, ["q1.kind", "('revolute', 'prismatic')", "'linear'"]),
    ({"joint": 4, "encoder_sign": 0}, ["q5.encoder_sign", "(-1, 1)", "got 0"]),
    ({"dead_zone": 80 / 127}, ["dead_zone", "below 80/127", "got 0.629"]),
    ({"dead_zone": 0.125, "pwm_limit": 10}, ["dead_zone", "below 10/127", "got 0.125"]),
    ({"largest_dead_zone": 0.63}, ["dead_zone", "below 80/127", "got 0.63"]),
    ({"largest_dead_zone": 0.06}, ["largest_dead_zone", "0.07 or more", "got 0.06"]),
    ({"plant_dt": 0.03}, ["plant_dt", "0.025, a part of dt", "got 0.03"]),
    ({"plant_dt": 0.02, "rate": 1e7}, ["plant_dt", "1e-07, a part of dt", "got 0.02"]),
    ({"rate": 30.0}, ["plant_dt", f"{1 / 30 / 7}, a part of dt", "got 0.005"]),
    ({"plant_dt": 0.05}, ["tau_spool", "expected 0.05 to inf", "got 0.03"]),
    ({"history": 3}, ["history", "expected 4 to 1000", "got 3"]),
    ({"q_start": (0.0, 1.0)}, ["q_start", "5 angles within ranges", "(0.0, 1.0)"]),
    ({"q_start": (1.5, 0.5, 0.58, 1.71, 2.24)}, ["q_start", "within ranges", "2.24)"]),
    ({"controller_node": 3}, ["joints", "different CANopen nodes", "[1, 2, 3, 4, 5, 3]"]),
]


@pytest.mark.parametrize(("changes", "words"), BAD, ids=[words[0] for _, words in BAD])
def test_a_bad_field_is_refused_by_name_with_wanted_and_got(changes, words):
    with pytest.raises(ValueError) as caught:
        changed(**changes)
    message = str(caught.value)
    assert message.startswith(words[0] + ":") and "expected" in message and "got" in message
    assert all(word in message for word in words), message


# By the annotation, so that a number without a unit cannot hide.
EVERY = [*dataclasses.fields(Joint), *dataclasses.fields(Machine)]
NUMERIC = {f.name: f for f in EVERY if f.type in ("float", "int", "float | None")}
FREE = "a alpha d theta q_min q_max cylinder_angle encoder_zero ground"
NOT_NEGATIVE = "cylinder_base speed_positive speed_negative delay"
POSITIVE = "cylinder_rod cylinder_area q_dot_up q_dot_down rate tau_spool tau_cylinder "
POSITIVE += "tau_valve_up tau_valve_down pump_flow tool_speed"
OUTSIDE = {  # numbers beyond the ends of the range of each field
    **dict.fromkeys(FREE.split(), ()),
    **dict.fromkeys(NOT_NEGATIVE.split(), (-0.01,)),
    **dict.fromkeys(POSITIVE.split(), (0.0, -0.01)),
    **dict.fromkeys(("encoder_node", "controller_node", "pwm_limit"), (0, 128)),
    **dict.fromkeys(("dead_zone", "largest_dead_zone", "valve_threshold"), (-0.01, 1.0)),
    **dict.fromkeys(("dead_zone_up", "dead_zone_down"), (-0.01, 1.0)),
    "dither": (-0.01, 0.51),
    "spool_threshold": (-0.1, 1.1),
    "plant_dt": (0.0, 1.1),
    "encoder_step": (0.0, 1.1),
    "weight": (0.0, 1.1e9),
    "encoder_bits": (0, 33),
    "velocity_samples": (1, 101),
    "history": (1, 1001),
    "valve_frame_id": (-1, 0x800),
}


@pytest.mark.parametrize("name", NUMERIC)
def test_each_number__is_refused_outside_its_range_and_where_it_is_none(name):
    of_joint = NUMERIC[name] in dataclasses.fields(Joint)
    whole = NUMERIC[name].type == "int"
    kind = f"expected a {'whole' if whole else 'finite'} number"
    no_number = [NAN, INF, -INF, "1", True, np.zeros(2), *[0.5] * whole]
    no_number += [None] * ("None" not in NUMERIC[name].type)
    for value, words in (*product(OUTSIDE[name], [" to "]), *product(no_number, [kind])):
        with pytest.raises(ValueError) as caught:
            changed(4 if of_joint else None, **{name: value})
        message = str(caught.value)
        assert message.startswith(f"{'q5.' * of_joint}{name}: expected ")
        assert message.endswith(f"got {value!r}")
        assert words in message


@pytest.mark.parametrize(
    "fields",
    [
        {"pwm_limit": 10, "dead_zone": 0.078},
        {"pwm_limit": 1, "dead_zone": 0.0, "delay": 0.0, "velocity_samples": 2, "history": 2},
        {"pwm_limit": 127, "valve_frame_id": 0x7FF, "valve_threshold": 0.0, "encoder_bits": 32},
        {"plant_dt": 0.05, "tau_spool": 0.05, "tau_cylinder": 0.05},
    ],
)
def test_values_at_the_ends_of_the_allowed_ranges_are_machines(fields):
    machine = changed(**fields)
    assert {name: getattr(machine, name) for name in fields} == fields


def test_every_number__has_its_unit_in_the_class_and_its_source_beside_it():
    """Of the tables of joints the heading states units, the comment above the sources."""
    assert len(NUMERIC) > 30
    assert all(field.metadata.get("unit") for field in NUMERIC.values())
    source = inspect.getsource(machine_module)
    tables, numbers = source.split("# Joints of the Brokk 170.")[1].split("BROKK_170 = Machine(")
    assert {"[m]", "[rad]", "[m^2]", "[m/s]", "[rad/s]"} <= set(re.findall(r"\[\S+\]", tables))
    stated = re.findall(r"^    (\w+)=[^#\n]+# .+; (?:paper|assumed|tuned)", numbers, re.M)
    fields = dataclasses.fields(Machine)
    needed = {f.name for f in fields if f.default is dataclasses.MISSING}
    assert set(stated) == needed - {"name", "joints"} | {"pump_flow", "q_start"}
    assert "by default what is assumed of the Brokk" in source


def test_a_machine_without_hydraulics__moves_as_fast_as_its_joints_say():
    """All 17 numbers of the plant are optional; speeds come from q_dot_up and q_dot_down."""
    fields = {f.name for f in dataclasses.fields(Joint) if f.default is dataclasses.MISSING}
    joints = [Joint(**{name: getattr(j, name) for name in fields}) for j in BROKK_170.joints]
    given = {f.name for f in dataclasses.fields(Machine) if f.default is dataclasses.MISSING}
    machine = Machine(**{n: getattr(BROKK_170, n) for n in given} | {"joints": tuple(joints)})
    for sign, q_dot in ((1, machine.column("q_dot_up")), (-1, -machine.column("q_dot_down"))):
        start = machine.column("q_min" if sign > 0 else "q_max")
        state, u = plant_reset(machine, start), np.full(5, sign * 80 / 127)
        for _ in range(30):
            last, state = state, plant_step(machine, state, u)
        np.testing.assert_allclose((state.q - last.q) * machine.rate, q_dot, rtol=1e-3)


def test_the_brokk_has_the_numbers_of_the_paper_and_the_design():
    m = BROKK_170
    assert (m.rate, m.dt, m.pwm_limit, m.dead_zone, m.history) == (20.0, 0.05, 80, 0.07, 13)
    assert m.names == ("q1", "q2", "q3", "q4", "q5")
    assert m.driven.tolist() == [0, 2, 3, 4] and m.locked.tolist() == [1]
    assert m.column("q_min").tolist() == [-2.14, 0.0, -0.3, 0.6, 0.0]
    assert m.column("q_max").tolist() == [2.14, 1.4, 1.6, 2.9, 2.0]
    assert m.encoder_step == pytest.approx(np.full(5, 1.534e-3), abs=5e-7)  # 12 bits
    assert m.encoder_step[0] * m.rate == pytest.approx(0.031, abs=5e-4)  # one count over one tick


@given(machines())
def test_columns_follow_the_joints_and_cannot_be_written(machine):
    for field in ("a", "q_min", "speed_negative", "encoder_node"):
        column = machine.column(field)
        assert column.tolist() == [getattr(joint, field) for joint in machine.joints]
        with pytest.raises(ValueError, match="read-only"):
            column[0] = 1.0
    both = np.concatenate([machine.driven, machine.locked])
    assert sorted(both.tolist()) == list(range(machine.n))
    assert all(machine.joints[i].driven for i in machine.driven)


def test_a_replaced_machine__has_columns_and_joints_of_its_own():
    """Machines are values: those of one name and one hash are told apart by their numbers."""
    with pytest.raises(dataclasses.FrozenInstanceError):
        BROKK_170.rate = 10.0
    assert replace(BROKK_170, rate=10.0).dt == 0.1 and BROKK_170.dt == 0.05
    machine = changed(1, a=9.0, driven=True)
    assert hash(machine) == hash(BROKK_170) and machine != BROKK_170
    assert BROKK_170.column("a")[1] == 1.15 and machine.column("a")[1] == 9.0
    assert BROKK_170.driven.tolist() == [0, 2, 3, 4] and machine.driven.tolist() == [0, 1, 2, 3, 4]
    assert BROKK_170.locked.tolist() == [1] and machine.locked.tolist() == []
    assert machine.q_dot_max.tolist() == [0.20, 0.22, 0.28, 0.38, 0.47]


# --- the PWM byte ---------------------------------------------------------------------------------


def test_bytes_of_the_paper():
    u_byte = [0, 80, 175, 50, 205, 127, 128, 254]
    counts = np.array([0, 80, -80, 50, -50, 127, -127, -1])
    np.testing.assert_allclose(decode_pwm(u_byte) * 127, counts, atol=1e-12)
    assert encode_pwm(counts / 127).tolist() == u_byte
    assert (decode_pwm(255), encode_pwm(0)) == (0, 0)


def test_decode_pwm__of_every_byte_is_the_rule_of_the_paper():
    """[0, 127] is positive and [255, 128] negative, as a dictionary written from that sentence."""
    meaning = {u_byte: u_byte for u_byte in range(128)}
    meaning |= {u_byte: -m for m, u_byte in enumerate(range(255, 127, -1))}
    every = np.arange(256)
    decoded = decode_pwm(every)
    np.testing.assert_allclose(decoded * 127, [meaning[b] for b in range(256)], atol=1e-12)
    again = encode_pwm(decoded)
    assert again.dtype == np.uint8
    assert again.tolist() == [0 if u_byte == 255 else u_byte for u_byte in range(256)]


@given(npst.arrays(np.float64, npst.array_shapes(max_dims=3), elements=reals(-1.0, 1.0)))
def test_the_code_is_off_by_half_a_count_at_most(u):
    assert np.all(np.abs(decode_pwm(encode_pwm(u)) - u) <= 0.5 / 127 + 1e-12)


@pytest.mark.parametrize("u", [1.01, -1.01, NAN, INF, -INF, 80.0])
def test_commands_that_no_byte_can_carry_are_refused(u):
    with pytest.raises(ValueError) as caught:
        encode_pwm([-1.0, 1.0, u])
    assert str(caught.value) == f"u: expected within [-1, 1], got {u}"


@pytest.mark.parametrize("u_byte", [-1, 256, 300])
def test_decode_pwm__refuses_what_is_no_byte(u_byte):
    with pytest.raises(ValueError) as caught:
        decode_pwm([0, u_byte])
    assert str(caught.value) == f"u_byte: expected 0 to 255, got {u_byte}"


# --- the limit ------------------------------------------------------------------------------------


def test_the_limit_is_80_counts_of_127():
    limited = limit_command(BROKK_170, np.array([-1.0, -0.63, 0.0, 0.004, 0.1, 0.62, 0.64, 5.0]))
    np.testing.assert_allclose(limited * 127, [-80, -80, 0, 1, 13, 79, 80, 80], atol=1e-12)
    assert pytest.approx(0.63, abs=1e-3) == 80 / 127


@given(
    machines(),
    st.sampled_from([np.float32, np.float64]).flatmap(
        lambda kind: npst.arrays(
            kind, npst.array_shapes(max_dims=3), elements=st.floats(-8, 8, width=32)
        )
    ),
)
def test_no_command_leaves_beyond_the_limit_or_between_counts(machine, u):
    u.setflags(write=False)
    limited = limit_command(machine, u)
    assert limited.dtype == u.dtype and limited.shape == u.shape
    counts = limited.astype(float) * 127
    np.testing.assert_allclose(counts, np.rint(counts), atol=1e-4)
    assert np.all(np.abs(np.rint(counts)) <= machine.pwm_limit)
    inside = np.abs(u) * 127 <= machine.pwm_limit
    assert np.all(np.abs(counts - u * 127.0)[inside] <= 0.5 + 1e-4)
    assert np.all(np.rint(counts)[~inside] == machine.pwm_limit * np.sign(u[~inside]))
    np.testing.assert_array_equal(limit_command(machine, -u), -limited)
    np.testing.assert_array_equal(limit_command(machine, limited), limited)


def test_whole_numbers_are_commands_and_angles_too():
    """[1, -1] is full command both ways; that it came as integers must not make it zero."""
    np.testing.assert_allclose(limit_command(BROKK_170, [1, -1, 0]) * 127, [80, -80, 0])
    np.testing.assert_array_equal(
        read_encoder(BROKK_170, [1, 2, 0, 1, 1]), read_encoder(BROKK_170, [1.0, 2.0, 0, 1, 1])
    )


def test_valve_opening__by_hand():
    opening = valve_opening([-1.0, -0.07, 0.0, 0.05, 0.07, 0.535, 1.0], 0.07)
    np.testing.assert_allclose(opening, [-1, 0, 0, 0, 0, 0.5, 1], atol=1e-12)
    assert valve_opening(np.float32([0.5]), 0.0).dtype == np.float32
    assert valve_opening([1, -1, 0], 0.5).tolist() == [1, -1, 0]
    pairs = [[0.1, 0.2], [0.0, 0.0]]  # up and down, of two joints
    opening = valve_opening([[0.15, 0.55], [-0.15, -0.6], [-0.6, 0.0]], pairs)
    np.testing.assert_allclose(opening, [[0.05 / 0.9, 0.55], [0, -0.6], [-0.5, 0]])


@given(machines(), st.floats(-1, 1))
def test_valve_command__is_the_inverse_of_valve_opening(machine, x):
    opening = np.full(machine.n, x)
    command = valve_command(opening, machine.dead_zones)
    np.testing.assert_allclose(valve_opening(command, machine.dead_zones), opening, atol=1e-12)
    beyond = np.abs(command) - machine.dead_zones[:, int(x < 0)]
    assert (beyond >= -1e-12).all() or x == 0
    assert not valve_command(0 * opening, machine.dead_zones).any()


def test_dead_zones__are_each_joints_own_or_the_machines():
    machine = changed(2, dead_zone_up=0.1, speed_positive=0.0, speed_negative=0.0)
    expected = np.full((5, 2), 0.07)
    expected[2, 0] = 0.1
    np.testing.assert_array_equal(machine.dead_zones, expected)
    r = machine.joints[2]  # its speed at full command, by that at the limit
    limit = 80 / 127
    assert r.speed_positive == pytest.approx(r.q_dot_up * 0.30 * 0.9 / (limit - 0.1))
    assert r.speed_negative == pytest.approx(r.q_dot_down * 0.30 * 0.93 / (limit - 0.07))
    expected = r"dead_zone: expected at most a joint's 0\.05, got 0\.07"
    with pytest.raises(ValueError, match=expected):
        changed(2, dead_zone_down=0.05)


# --- encoders -------------------------------------------------------------------------------------


@given(posed())
def test_encoders_report_the_nearest_count(machine_and_pose):
    machine, q = machine_and_pose
    turning = 2 * np.pi / 2**machine.encoder_bits
    steps = [turning if j.kind == "revolute" else j.encoder_step for j in machine.joints]
    step = np.array(steps)
    measured = read_encoder(machine, q)
    counts = measured / step
    np.testing.assert_allclose(counts, np.rint(counts), atol=1e-7)
    assert np.all(np.abs(measured - q) <= step / 2 * (1 + 1e-9))
    np.testing.assert_array_equal(read_encoder(machine, measured), measured)
    assert read_encoder(machine, q.astype(np.float32)).dtype == np.float32


def test_encoder_by_hand():
    # 1 rad = 651.9 counts of 1.53398 mrad
    q = read_encoder(BROKK_170, [1.0, -0.0007, -0.0008, 0.0, 0.0])
    np.testing.assert_allclose(q, [652 * 2 * np.pi / 4096, 0, -0.00153398, 0, 0], rtol=1e-5)
