"""A machine from a URDF has its tool where Pinocchio, which reads the URDF, has it."""

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("pinocchio")
from examples import from_urdf

# The chassis frame lies behind the slew axis. Boom and arm turn about parallel axes, the arm the
# other way round. The bucket's axis is skew to the stick's. The rod is no part of the chain.
EXCAVATOR = """<robot name="test excavator">
{links}
<joint name="turret" type="fixed"><parent link="chassis"/><child link="turret"/>
  <origin xyz="0.4 0.1 0.6" rpy="0 0 1.5707963267948966"/></joint>
<joint name="slew" type="continuous"><parent link="turret"/><child link="cab"/>
  <origin xyz="0 0 0.2" rpy="0 0 0.3"/><axis xyz="0 0 1"/></joint>
<joint name="boom" type="revolute"><parent link="cab"/><child link="boom"/>
  <origin xyz="0.3 -0.1 0.5" rpy="0 0 0"/><axis xyz="0 1 0"/>
  <limit lower="-1.1" upper="0.6" effort="1" velocity="0.5"/></joint>
<joint name="arm" type="revolute"><parent link="boom"/><child link="arm"/>
  <origin xyz="1.8 0.05 0.2" rpy="3.141592653589793 0 0.2"/>
  <axis xyz="-0.19866933079506122 0.9800665778412416 0"/>
  <limit lower="-2.5" upper="0.4" effort="1" velocity="0.6"/></joint>
<joint name="extension" type="prismatic"><parent link="arm"/><child link="stick"/>
  <origin xyz="0.9 0 0" rpy="0 0.4 0"/><axis xyz="2 0 0.5"/>
  <limit lower="0" upper="0.8" effort="1" velocity="0.2"/></joint>
<joint name="bucket" type="revolute"><parent link="stick"/><child link="bucket"/>
  <origin xyz="0.15 0.02 0.1" rpy="0 -0.3 0.5"/><axis xyz="0.2 -0.9 0.4"/>
  <limit lower="-0.2" upper="2.0" effort="1" velocity="1.1"/></joint>
<joint name="edge" type="fixed"><parent link="bucket"/><child link="edge"/>
  <origin xyz="0.5 0.03 -0.2" rpy="0 1 0"/></joint>
<joint name="link" type="revolute"><parent link="bucket"/><child link="rod"/>
  <axis xyz="0 1 0"/><mimic joint="bucket" multiplier="-1"/>
  <limit lower="0" upper="1" effort="1" velocity="1"/></joint>
</robot>"""
LINKS = sorted({*re.findall(r'link="(\w+)"', EXCAVATOR)})
EXCAVATOR = EXCAVATOR.format(links="".join(f'<link name="{name}"/>' for name in LINKS))


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
    machine, told = printed(EXCAVATOR, tmp_path, capsys)
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


CHOICES = {
    "kind": ["revolute", "revolute", "prismatic"],
    "axis": ["1 0 0", "0 1 0", "0 0 1", "0 -1 0", "1 1 0", "0.2 -0.3 0.9"],
    "place": ["0 0 0", "1 0 0", "0 0 0.5", "0.4 -0.3 0.2"],
    "turn": ["0 0 0", "1.5707963267948966 0 0", "0 -1.5707963267948966 0.4", "0.3 0.5 -0.7"],
}
JOINT = """<joint name="j{i}" type="{kind}"><parent link="l{i}"/><child link="l{next}"/>
  <origin xyz="{place}" rpy="{turn}"/><axis xyz="{axis}"/>
  <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>"""
JOINTS = st.fixed_dictionaries({key: st.sampled_from(values) for key, values in CHOICES.items()})
CHAINS = st.lists(JOINTS, min_size=1, max_size=5)


@given(joints=CHAINS)
@settings(max_examples=60)
def test_any_chain__has_its_tool_where_the_urdf_has_it(tmp_path_factory, joints):
    """Axes that are parallel, coincident, opposed, that meet, and skew."""
    joints = [{**joints[0], "axis": "0 0 1", "turn": "0 0 1"}, *joints[1:]]
    texts = [JOINT.format(i=i, next=i + 1, **joint) for i, joint in enumerate(joints)]
    links = "".join(f'<link name="l{i}"/>' for i in range(len(joints) + 1))
    path = tmp_path_factory.mktemp("urdf") / "any.urdf"
    path.write_text(f'<robot name="any">{links}{"".join(texts)}</robot>')
    chain = from_urdf.read_chain(path, "l0", f"l{len(joints)}")
    assert from_urdf.largest_difference(chain, from_urdf.make_machine(chain)) < 1e-9


def test_rounded_right_angles__count_as_parallel(tmp_path, capsys):
    """1.5708 is 3.7e-6 rad off; a common normal of such axes would be kilometres away."""
    machine, _ = printed(EXCAVATOR.replace("3.141592653589793", "3.14159"), tmp_path, capsys)
    assert machine.joints[1].alpha == pytest.approx(np.pi, abs=1e-12)
    assert abs(machine.joints[1].d) < 1


@pytest.mark.parametrize(
    ("old", "new", "tool", "message"),
    [
        ('"0 0 1"', '"0 0 -1"', "edge", "slew: expected an axis that points up from chassis"),
        ("</robot>", "", "edge", "robot.urdf: expected a URDF, after xacro if need be, got"),
        ("", "", "rod", "link: expected a revolute or prismatic joint that moves by itself"),
        ("", "", "turret", "robot.urdf: expected joints that lead from chassis to turret"),
    ],
)
def test_another_chain__is_refused(tmp_path, old, new, tool, message):
    path = tmp_path / "robot.urdf"
    path.write_text(EXCAVATOR.replace(old, new))
    with pytest.raises(ValueError) as error:
        from_urdf.read_chain(path, "chassis", tool)
    assert message in str(error.value)
