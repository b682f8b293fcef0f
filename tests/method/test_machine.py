"""The machine as a value, the PWM code, the command limit, dead zones, encoders."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from strategies import machines, posed

from brokk_min.machine import (
    BROKK_170,
    decode_pwm,
    encode_pwm,
    limit_command,
    read_encoder,
    valve_command,
    valve_opening,
)

# --- validation -----------------------------------------------------------------------------------


def changed(joint=None, **fields):
    """The Brokk with other fields, or with other fields of one joint."""
    if joint is not None:
        joints = list(BROKK_170.joints)
        joints[joint] = replace(joints[joint], **fields)
        fields = {"joints": tuple(joints)}
    return replace(BROKK_170, **fields)


NAN, INF = float("nan"), float("inf")
BAD = [
    ({"joint": 1, "name": "q1"}, "joints: expected different names, got ['q1', 'q1', 'q3'"),
    ({"joint": 1, "encoder_node": 1}, "joints: expected different CANopen nodes, got [1, 1, 3"),
    ({"controller_node": 3}, "joints: expected different CANopen nodes, got [1, 2, 3, 4, 5, 3]"),
    ({"joint": 3, "q_max": 0.6}, "q4.q_max: expected above 0.6, got 0.6"),
    ({"joint": 3, "q_min": NAN}, "q4.q_min: expected a finite number, got nan"),
    ({"joint": 3, "a": "1.15"}, "q4.a: expected a finite number, got 1.15"),
    ({"rate": INF}, "rate: expected a finite number, got inf"),
    ({"rate": -25.0}, "rate, tool_speed: expected positive numbers, got -25.0"),
    ({"tool_speed": 0}, "rate, tool_speed: expected positive numbers, got 0"),
    ({"encoder_bits": 0}, "encoder_bits: expected 1 to 32, got 0"),
    ({"joint": 1, "encoder_node": 128}, "CANopen nodes: expected 1 to 127, got [1, 128, 3, 4, 5"),
    ({"controller_node": 0}, "CANopen nodes: expected 1 to 127, got [1, 2, 3, 4, 5, 0]"),
    ({"joint": 1, "driven": "yes"}, "q2.driven: expected True or False, got yes"),
    ({"joints": ()}, "joints: expected a tuple of one Joint or more, got ()"),
    ({"joints": ("a", "b")}, "joints: expected a tuple of one Joint or more, got ('a', 'b')"),
    ({"joint": 3, "dead_zone": (NAN, 0.1)}, "q4.dead_zone: expected a pair, up and down, got (nan"),
    ({"q_start": 0.0}, "q_start: expected 5 angles within their ranges, got 0.0"),
    ({"valve_frame_id": 0x800}, "valve_frame_id: expected an identifier of 11 bits, got 2048"),
    ({"history": 13.0}, "history: expected a whole number, got 13.0"),
    ({"joint": 3, "dead_zone": 0.1}, "q4.dead_zone: expected a pair, up and down, got 0.1"),
    ({"joint": 3, "kind": "screw"}, "q4.kind: expected revolute or prismatic, got screw"),
    ({"joint": 1, "encoder_sign": 0}, "q2.encoder_sign: expected -1 or 1, got 0"),
    ({"joint": 1, "encoder_step": 0.0}, "q2.encoder_step: expected a positive number, got 0"),
    ({"name": ""}, "name: expected one of machine and joints, got none"),
    ({"joint": 1, "name": ""}, "name: expected one of machine and joints, got none"),
    ({"name": Path("mini")}, "name: expected a text, got mini"),
    ({"joint": 2, "q_dot_up": 0.0}, "q3.q_dot_up, q_dot_down: expected positive numbers, got 0.0"),
    ({"joint": 4, "dead_zone": (0.07, 80 / 127)}, "dead_zone: expected 0 to 80/127, got [[0.07"),
    ({"joint": 4, "dead_zone": (-0.01, 0.07)}, "dead_zone: expected 0 to 80/127, got [[0.07"),
    ({"pwm_limit": 8}, "dead_zone: expected 0 to 8/127, got [[0.07"),
    ({"pwm_limit": 128}, "pwm_limit: expected 1 to 127, got 128"),
    ({"history": 3}, "velocity_samples: expected 2 to history, got 4"),
    ({"velocity_samples": 1}, "velocity_samples: expected 2 to history, got 1"),
    ({"q_start": (0.0, 1.0)}, "q_start: expected 5 angles within their ranges, got (0.0, 1.0)"),
    ({"q_start": (1.5, 0.5, 0.58, 1.71, 2.24)}, "q_start: expected 5 angles within their ranges"),
]


@pytest.mark.parametrize(("changes", "message"), BAD)
def test_a_bad_field__is_refused_by_name_with_wanted_and_got(changes, message):
    with pytest.raises(ValueError) as caught:
        changed(**changes)
    assert str(caught.value).startswith(message)


def test_numbers_of_numpy__become_pythons_so_that_files_can_hold_them():
    arrays = {"q_start": np.float32([1.5, 0.5, 0.5, 1.75, 1.25]), "rate": np.float32(20)}
    machine = changed(pwm_limit=np.int64(80), history=np.array(13), **arrays)
    machine = replace(machine, joints=changed(3, dead_zone=np.array([0.1, 0.2])).joints)
    assert machine.joints[3].dead_zone == (0.1, 0.2)
    plain = replace(machine, q_start=(1.5, 0.5, 0.5, 1.75, 1.25), rate=20.0, history=13)
    assert repr(machine) == repr(plain)  # NumPy's numbers are printed as such
    assert json.loads(json.dumps(asdict(machine)))["pwm_limit"] == 80


@pytest.mark.parametrize(
    ("limit", "samples", "q_start"),
    [(9, 2, (-2.14, 0.0, -0.3, 0.6, 0.0)), (127, 13, (2.14, 1.4, 1.6, 2.9, 2.0))],
)
def test_values__at_the_ends_of_the_allowed_ranges_are_machines(limit, samples, q_start):
    fields = {"pwm_limit": limit, "velocity_samples": samples, "q_start": q_start}
    machine = changed(**fields)
    assert {name: getattr(machine, name) for name in fields} == fields
    joints = tuple(replace(joint, dead_zone=(0.0, 0.0)) for joint in machine.joints)
    assert changed(joints=joints, pwm_limit=1).pwm_limit == 1


def test_the_brokk__has_the_numbers_of_the_paper_and_the_design():
    m = BROKK_170
    assert (m.rate, m.dt, m.pwm_limit, m.history) == (20.0, 0.05, 80, 13)
    assert m.names == ("q1", "q2", "q3", "q4", "q5")
    assert m.driven.tolist() == [0, 2, 3, 4] and m.locked.tolist() == [1]
    assert m.column("q_min").tolist() == [-2.14, 0.0, -0.3, 0.6, 0.0]
    assert m.column("q_max").tolist() == [2.14, 1.4, 1.6, 2.9, 2.0]
    assert m.encoder_step == pytest.approx(np.full(5, 1.534e-3), abs=5e-7)  # 12 bits


def test_a_replaced_machine__has_columns_and_joints_of_its_own():
    """Those of one name and one hash are told apart by their numbers."""
    assert replace(BROKK_170, rate=10.0).dt == 0.1 and BROKK_170.dt == 0.05
    machine = changed(1, a=9.0, driven=True, dead_zone=(0.1, 0.2))
    assert hash(machine) == hash(BROKK_170) and machine != BROKK_170
    assert BROKK_170.column("a")[1] == 1.15 and machine.column("a")[1] == 9.0
    assert not BROKK_170.column("a").flags.writeable
    assert machine.driven.tolist() == [0, 1, 2, 3, 4] and machine.locked.tolist() == []
    assert machine.dead_zones[1].tolist() == [0.1, 0.2]
    assert machine.q_dot_max.tolist() == [0.20, 0.22, 0.28, 0.38, 0.47]


# --- the PWM byte ---------------------------------------------------------------------------------


def test_decode_pwm__of_every_byte_is_the_rule_of_the_paper():
    """[0, 127] is positive and [255, 128] negative, as a dictionary written from that sentence.

    Of its pairs 80/175 and 50/205 each sums to 255.
    """
    meaning = {u_byte: u_byte for u_byte in range(128)}
    meaning |= {u_byte: -m for m, u_byte in enumerate(range(255, 127, -1))}
    assert (meaning[175], meaning[205]) == (-80, -50)
    decoded = decode_pwm(np.arange(256))
    np.testing.assert_allclose(decoded * 127, [meaning[b] for b in range(256)], atol=1e-12)
    for u in (decoded, decoded.astype(np.float32)):  # in single precision not whole counts
        again = encode_pwm(u)
        assert again.dtype == np.uint8
        assert again.tolist() == [0 if u_byte == 255 else u_byte for u_byte in range(256)]


@pytest.mark.parametrize("u", [1.01, -1.01, NAN, INF])
def test_encode_pwm__refuses_commands_that_no_byte_can_carry(u):
    with pytest.raises(ValueError, match=r"^u: expected within \[-1, 1\], got \[-1\.0, 1\.0, "):
        encode_pwm([-1.0, 1.0, u])


# --- the limit, the dead zone, encoders -----------------------------------------------------------


FLOATS = st.sampled_from([np.float32, np.float64])
COMMANDS = npst.arrays(FLOATS, npst.array_shapes(max_dims=3), elements=st.floats(-8, 8, width=32))


@given(machines(), COMMANDS)
def test_limit_command__sends_whole_counts_within_the_limit(machine, u):
    u.setflags(write=False)
    limited = limit_command(machine, u)
    assert limited.dtype == u.dtype and limited.shape == u.shape
    counts = np.rint(limited.astype(float) * 127)
    np.testing.assert_allclose(limited.astype(float) * 127, counts, atol=1e-4)
    nearest = np.clip(u * 127.0, -machine.pwm_limit, machine.pwm_limit)
    assert np.all(np.abs(counts - nearest) <= 0.5 + 1e-4)
    np.testing.assert_array_equal(limit_command(machine, -u), -limited)
    np.testing.assert_array_equal(limit_command(machine, limited), limited)
    assert limit_command(machine, [1])[0] > 0.1  # whole numbers are commands, too


def test_valve_opening__by_hand():
    opening = valve_opening([-1.0, -0.07, 0.0, 0.05, 0.07, 0.535, 1.0], (0.07, 0.07))
    np.testing.assert_allclose(opening, [-1, 0, 0, 0, 0, 0.5, 1], atol=1e-12)
    assert valve_opening(np.float32([0.5]), (0.0, 0.0)).dtype == np.float32
    assert valve_opening([1, -1, 0], (0.5, 0.5)).tolist() == [1, -1, 0]
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


@given(posed())
def test_encoders__report_the_nearest_count(machine_and_pose):
    machine, q = machine_and_pose
    turning = 2 * np.pi / 2**machine.encoder_bits
    step = np.array([turning if j.kind == "revolute" else j.encoder_step for j in machine.joints])
    measured = read_encoder(machine, q)
    counts = measured / step
    np.testing.assert_allclose(counts, np.rint(counts), atol=1e-7)
    assert np.all(np.abs(measured - q) <= step / 2 * (1 + 1e-9))
    np.testing.assert_array_equal(read_encoder(machine, measured), measured)
    assert read_encoder(machine, q.astype(np.float32)).dtype == np.float32
    assert read_encoder(machine, np.ones(machine.n, int)).dtype == float
