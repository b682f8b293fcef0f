"""A machine from a URDF has its tool where Pinocchio, which reads the URDF, has it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("pinocchio")
from examples import from_urdf

ARM_AXIS = "-0.19866933079506122 0.9800665778412416 0"
JOINT = """<link name="{0}"/><joint name="{0}" type="{1}">
  <parent link="{parent}"/><child link="{0}"/><origin xyz="{2}" rpy="{3}"/>
  <axis xyz="{4}"/><limit lower="{5}" upper="{6}" effort="1" velocity="{7}"/>{more}</joint>"""
# The chassis frame lies behind the slew axis. Boom and arm turn about parallel axes, the arm the
# other way round. The bucket's axis is skew to the stick's. The rod is no part of the chain.
EXCAVATOR = (  # name of joint and link, kind, place, turn, axis, range, speed
    ("turret", "fixed", "0.4 0.1 0.6", "0 0 1.5707963267948966", "0 0 1", 0, 0, 0),
    ("slew", "continuous", "0 0 0.2", "0 0 0.3", "0 0 1", 0, 0, 99),
    ("boom", "revolute", "0.3 -0.1 0.5", "0 0 0", "0 1 0", -1.1, 0.6, 0.5),
    ("arm", "revolute", "1.8 0.05 0.2", "3.141592653589793 0 0.2", ARM_AXIS, -2.5, 0.4, 0.6),
    ("extension", "prismatic", "0.9 0 0", "0 0.4 0", "2 0 0.5", 0, 0.8, 0.2),
    ("bucket", "revolute", "0.15 0.02 0.1", "0 -0.3 0.5", "0.2 -0.9 0.4", -0.2, 2.0, 1.1),
    ("edge", "fixed", "0.5 0.03 -0.2", "0 1 0", "0 0 1", 0, 0, 0),
    ("rod", "revolute", "0 0 0", "0 0 0", "0 1 0", 0, 1, 1),
)


def urdf(joints):
    """The text of a chain that begins at the link "chassis"; a rod follows the bucket."""
    text, parent = '<robot name="test"><link name="chassis"/>', "chassis"
    for joint in joints:
        more = '<mimic joint="bucket" multiplier="-1"/>' if joint[0] == "rod" else ""
        text, parent = text + JOINT.format(*joint, parent=parent, more=more), joint[0]
    return text + "</robot>"


def printed(text, tmp_path, capsys):
    path = tmp_path / "robot.urdf"
    path.write_text(text)
    from_urdf.main(str(path), "chassis", "edge")
    out, told = capsys.readouterr()
    names = {}
    exec(out, names)
    return names["MACHINE"], told


def test_excavator__has_its_tool_where_the_urdf_has_it(tmp_path, capsys):
    """The boom's axis is 0.3 m out and 1.3 m high, and the arm is 0.05 m right of the slew axis."""
    machine, told = printed(urdf(EXCAVATOR), tmp_path, capsys)
    assert machine.names == ("slew", "boom", "arm", "extension", "bucket")
    assert [joint.kind for joint in machine.joints].index("prismatic") == 3
    assert machine.column("q_min").round(4).tolist() == [-3.1416, -1.1, -2.5, 0.0, -0.2]
    assert machine.column("q_dot_down").tolist() == [0.3, 0.5, 0.6, 0.2, 1.1]
    assert told.count("warning: ") == told.count("warning: slew: the ") == 2  # range and speed
    assert float(told.split("at most ")[1].split()[0]) < 1e-9
    slew, boom, *_ = machine.joints
    assert (slew.a, slew.d, slew.alpha) == pytest.approx((0.3, 1.3, -np.pi / 2))
    assert (boom.a, boom.d) == pytest.approx((np.hypot(1.8, 0.2), -0.05))
    assert boom.alpha == pytest.approx(np.pi)  # the arm's axis points the other way


KINDS = ["revolute", "revolute", "prismatic"]
PLACES = ["0 0 0", "1 0 0", "0 0 0.5", "0.4 -0.3 0.2"]
TURNS = ["0 0 0", "1.5707963267948966 0 0", "0 -1.5707963267948966 0.4", "0.3 0.5 -0.7"]
AXES = ["1 0 0", "0 1 0", "0 0 1", "0 -1 0", "1 1 0", "0.2 -0.3 0.9"]
JOINTS = st.tuples(*map(st.sampled_from, (KINDS, PLACES, TURNS, AXES)))


@given(st.sampled_from(KINDS), st.sampled_from(PLACES), st.lists(JOINTS, max_size=4))
@settings(max_examples=60)
def test_any_chain__has_its_tool_where_the_urdf_has_it(tmp_path_factory, kind, place, joints):
    """Axes that are parallel, coincident, opposed, that meet, and skew."""
    rows = [(kind, place, "0 0 1", "0 0 1"), *joints]
    path = tmp_path_factory.mktemp("urdf") / "any.urdf"
    path.write_text(urdf((f"j{i}", *row, -1, 1, 1) for i, row in enumerate(rows)))
    chain = from_urdf.read_chain(path, "chassis", f"j{len(joints)}")
    assert from_urdf.largest_difference(chain, from_urdf.make_machine(chain)) < 1e-9


def test_rounded_right_angles__count_as_parallel(tmp_path, capsys):
    """1.5708 is 3.7e-6 rad off; a common normal of such axes would be kilometres away."""
    machine, _ = printed(urdf(EXCAVATOR).replace("3.141592653589793", "3.14159"), tmp_path, capsys)
    assert machine.joints[1].alpha == pytest.approx(np.pi, abs=1e-12)
    assert abs(machine.joints[1].d) < 1


@pytest.mark.parametrize(
    ("joint", "index", "value", "told"),
    [
        (2, 6, 35, "boom: the limits -1.1 to 35 rad look like degrees"),
        (2, slice(5, 7), (-5, 5), "boom: the limits -5 to 5 rad look like degrees"),
        (2, slice(5, 7), (1.1, -0.5), "boom: the limits 1.1 to -0.5 are the wrong way round"),
        (4, 6, 1500, "placeholders or millimetres: measure its range (0 to 1 stand in)"),
        (3, 2, "1800 0 0", "boom: its link of 1800 m looks like centimetres or millimetres"),
        (6, 2, "0.1 -0.45 0.2", "bucket: cannot move the tool, which lies on its axis"),
    ],
)
def test_what_looks_like_an_error_of_an_exporter__is_told(
    tmp_path, capsys, joint, index, value, told
):
    rows = [list(row) for row in EXCAVATOR]
    rows[joint][index] = value
    machine, found = printed(urdf(rows), tmp_path, capsys)
    assert told in found and machine.joints[-1].driven == ("bucket" not in told)


@pytest.mark.parametrize(
    ("old", "new", "tool", "message"),
    [
        ('"0 0 1"', '"0 0 -1"', "edge", "slew: expected an axis that points up from chassis"),
        ("</robot>", "", "edge", "robot.urdf: expected a URDF, after xacro if need be, got"),
        ("", "", "rod", "rod: expected a revolute or prismatic joint that moves by itself"),
        ("", "", "turret", "robot.urdf: expected joints that lead from chassis to turret"),
    ],
)
def test_another_chain__is_refused(tmp_path, old, new, tool, message):
    path = tmp_path / "robot.urdf"
    path.write_text(urdf(EXCAVATOR).replace(old, new))
    with pytest.raises(ValueError) as error:
        from_urdf.read_chain(path, "chassis", tool)
    assert message in str(error.value)
