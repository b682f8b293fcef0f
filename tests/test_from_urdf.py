"""A machine from a URDF has its tool where the URDF has it, worked out here without Pinocchio."""

import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("pinocchio")
from brokk_min.kinematics import forward_kinematics, tool_position
from brokk_min.machine import Joint, Machine
from examples import from_urdf

PROGRAM = Path(from_urdf.__file__)
# The chassis frame lies behind the slew axis. Boom, arm and stick turn about parallel axes, the arm
# the other way round. The tilt's axis is skew to the stick's, and the bucket's to the tilt's. The
# gripper and the two mimics are no part of the chain.
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
<joint name="tilt" type="revolute"><parent link="stick"/><child link="tilt"/>
  <origin xyz="0.2 0.07 -0.1" rpy="0.1 0.2 0.3"/><axis xyz="1 0.3 -0.2"/>
  <limit lower="-0.7" upper="0.7" effort="1" velocity="0.4"/></joint>
<joint name="bucket" type="revolute"><parent link="tilt"/><child link="bucket"/>
  <origin xyz="0.15 0.02 0.1" rpy="0 -0.3 0.5"/><axis xyz="0.2 -0.9 0.4"/>
  <limit lower="-0.2" upper="2.0" effort="1" velocity="1.1"/></joint>
<joint name="edge" type="fixed"><parent link="bucket"/><child link="edge"/>
  <origin xyz="0.5 0.03 -0.2" rpy="0 1 0"/></joint>
<joint name="float" type="floating"><parent link="bucket"/><child link="load"/></joint>
<joint name="link" type="revolute"><parent link="bucket"/><child link="rod"/>
  <axis xyz="0 1 0"/><mimic joint="bucket" multiplier="-1"/>
  <limit lower="0" upper="1" effort="1" velocity="1"/></joint>
</robot>"""
LINKS = (
    "chassis",
    "turret",
    "cab",
    "boom",
    "arm",
    "stick",
    "tilt",
    "bucket",
    "edge",
    "load",
    "rod",
)
EXCAVATOR = EXCAVATOR.format(links="".join(f'<link name="{name}"/>' for name in LINKS))


def turn(axis, angle):
    """Rodrigues' formula."""
    x, y, z = np.asarray(axis) / np.linalg.norm(axis)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


def urdf_position(text, q):
    """The tool of a chain in document order; `q` by name of the joint."""
    R, p = np.eye(3), np.zeros(3)
    for joint in ET.fromstring(text).findall("joint"):
        if (name := joint.get("name")) in q or joint.get("type") == "fixed":
            origin = joint.find("origin").attrib
            p = p + R @ np.array(origin["xyz"].split(), float)
            roll, pitch, yaw = map(float, origin["rpy"].split())
            R = R @ turn([0, 0, 1], yaw) @ turn([0, 1, 0], pitch) @ turn([1, 0, 0], roll)
        if name in q:
            axis = np.array(joint.find("axis").get("xyz").split(), float)
            if joint.get("type") == "prismatic":
                p = p + R @ axis / np.linalg.norm(axis) * q[name]
            else:
                R = R @ turn(axis, q[name])
    return p


def printed(text, tmp_path, capsys, base="chassis", tool="edge"):
    path = tmp_path / "robot.urdf"
    path.write_text(text)
    from_urdf.main(str(path), base, tool)
    out, told = capsys.readouterr()
    names = {}
    exec(out, names)
    return names["MACHINE"], out, told


def refusal(text, tmp_path, base="chassis", tool="edge"):
    path = tmp_path / "robot.urdf"
    path.write_text(text)
    with pytest.raises(ValueError) as error:
        from_urdf.read_chain(path, base, tool)
    assert "\n" not in str(error.value)
    return str(error.value).removeprefix(f"{tmp_path}/")


def test_excavator__has_its_tool_where_the_urdf_has_it(tmp_path, capsys):
    machine, out, told = printed(EXCAVATOR, tmp_path, capsys)
    assert machine.names == ("slew", "boom", "arm", "extension", "tilt", "bucket")
    assert [joint.kind for joint in machine.joints].index("prismatic") == 3
    assert machine.column("q_min").round(4).tolist() == [-3.1416, -1.1, -2.5, 0.0, -0.7, -0.2]
    assert machine.column("q_dot_down").tolist() == [0.3, 0.5, 0.6, 0.2, 0.4, 1.1]
    assert "moved by [0.4, 0.1, 0.0] m" in out
    assert float(told.split("at most ")[1].split()[0]) < 1e-9
    rng = np.random.default_rng(1)
    poses = rng.uniform(machine.column("q_min"), machine.column("q_max"), (100, machine.n))
    tools = tool_position(forward_kinematics(machine, poses)) + np.array([0.4, 0.1, 0.0])
    theirs = [urdf_position(EXCAVATOR, dict(zip(machine.names, q))) for q in poses]
    np.testing.assert_allclose(tools, theirs, atol=1e-9)


def test_excavator__has_rows_that_one_can_work_out_by_hand(tmp_path, capsys):
    """The boom's axis is 0.3 m out and 1.3 m high, and the arm is 0.05 m right of the slew axis."""
    joints = printed(EXCAVATOR, tmp_path, capsys)[0].joints
    assert joints[0].a == pytest.approx(0.3) and joints[0].d == pytest.approx(1.3)
    assert joints[0].alpha == pytest.approx(-np.pi / 2)
    assert joints[1].a == pytest.approx(np.hypot(1.8, 0.2)) and joints[1].d == pytest.approx(-0.05)
    assert joints[1].alpha == pytest.approx(np.pi)  # the arm's axis points the other way


AXES = ["1 0 0", "0 1 0", "0 0 1", "0 -1 0", "1 1 0", "0.2 -0.3 0.9"]
PLACES = ["0 0 0", "1 0 0", "0 0 0.5", "0.4 -0.3 0.2"]
TURNS = ["0 0 0", "1.5707963267948966 0 0", "0 -1.5707963267948966 0.4", "0.3 0.5 -0.7"]
JOINT = """<joint name="j{i}" type="{kind}"><parent link="l{i}"/><child link="l{next}"/>
  <origin xyz="{place}" rpy="{turn}"/><axis xyz="{axis}"/>
  <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>"""
CHAINS = st.lists(
    st.builds(
        dict,
        kind=st.sampled_from(["revolute", "revolute", "prismatic"]),
        axis=st.sampled_from(AXES),
        place=st.sampled_from(PLACES),
        turn=st.sampled_from(TURNS),
    ),
    min_size=1,
    max_size=5,
)


def chain_of(joints):
    joints = [{**joints[0], "axis": "0 0 1", "turn": "0 0 1"}, *joints[1:]]
    texts = [JOINT.format(i=i, next=i + 1, **joint) for i, joint in enumerate(joints)]
    links = "".join(f'<link name="l{i}"/>' for i in range(len(joints) + 1))
    return f'<robot name="any">{links}{"".join(texts)}</robot>'


@given(joints=CHAINS)
@settings(max_examples=60)
def test_any_chain__has_its_tool_where_the_urdf_has_it(tmp_path_factory, joints):
    """Axes that are parallel, coincident, opposed, that meet, and skew."""
    text = chain_of(joints)
    path = tmp_path_factory.mktemp("urdf") / "any.urdf"
    path.write_text(text)
    chain = from_urdf.read_chain(path, "l0", f"l{len(joints)}")
    machine = from_urdf.make_machine(chain)
    q = np.random.default_rng(0).uniform(-1, 1, (5, machine.n))
    tools = tool_position(forward_kinematics(machine, q)) + from_urdf.base_origin(chain)
    theirs = [urdf_position(text, dict(zip(machine.names, pose))) for pose in q]
    np.testing.assert_allclose(tools, theirs, atol=1e-9)
    assert from_urdf.largest_difference(chain, machine) < 1e-9


def test_rounded_right_angles__count_as_parallel(tmp_path, capsys):
    """1.5708 is 3.7e-6 rad off; a common normal of such axes would be kilometres away."""
    text = EXCAVATOR.replace("3.141592653589793", "3.14159")
    machine, _, told = printed(text, tmp_path, capsys)
    assert (
        machine.joints[1].alpha == pytest.approx(np.pi, abs=1e-12) and abs(machine.joints[1].d) < 1
    )
    assert 1e-7 < float(told.split("at most ")[1].split()[0]) < 2e-5


@pytest.mark.parametrize(
    ("limit", "shown", "q_max"),
    [
        ('lower="0" upper="0"', "0 to 0", np.pi),
        ('lower="1" upper="-1"', "1 to -1", np.pi),
        ('lower="-1e6" upper="1e6"', "-1e+06 to 1e+06", np.pi),
        ('lower="-3.14" upper="3.14"', "-3.14 to 3.14", 3.14),
        ('lower="-1.5" upper="6.2832"', "-1.5 to 6.2832", 6.2832),
    ],
)
def test_placeholder_limits__bring_a_warning(tmp_path, capsys, limit, shown, q_max):
    text = EXCAVATOR.replace('lower="-1.1" upper="0.6"', limit)
    machine, _, told = printed(text.replace('velocity="0.5"', 'velocity="1e6"'), tmp_path, capsys)
    assert f"warning: boom: the limits {shown} look like placeholders" in told
    assert "warning: boom: the velocity limit 1e+06 looks like a placeholder: 0.3" in told
    assert machine.joints[1].q_max == q_max and machine.joints[1].q_dot_up == 0.3


def test_real_limits__bring_no_warning(tmp_path, capsys):
    told = printed(EXCAVATOR, tmp_path, capsys)[2]
    assert [line for line in told.splitlines() if "slew" not in line] == told.splitlines()[2:]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            '"boom" type="revolute"',
            '"boom" type="planar"',
            "boom: expected a revolute or prismatic",
        ),
        ('"boom" type="revolute"', '"boom" type="floating"', "boom: expected a revolute or"),
        (
            '<axis xyz="2 0 0.5"/>',
            '<axis xyz="1 0 0"/><mimic joint="arm"/>',
            "that moves by itself",
        ),
        ('"0 0 1"', '"0 0 -1"', "slew: expected an axis that points up from chassis"),
        ('"0 0 1"', '"0 1 0"', "got [-0.955 -0.296  0."),
        ("</robot>", "", "robot.urdf: expected a URDF, after xacro if need be, got"),
    ],
)
def test_another_chain__is_refused_in_one_line(tmp_path, old, new, message):
    assert message in refusal(EXCAVATOR.replace(old, new), tmp_path)


@pytest.mark.parametrize(
    ("base", "tool", "message"),
    [
        ("chassis", "claw", "robot.urdf: expected a link of ['chassis', "),
        ("edge", "chassis", "robot.urdf: expected joints that lead from edge to chassis, got none"),
        ("chassis", "turret", "robot.urdf: expected joints that lead from chassis to turret"),
        ("load", "rod", "robot.urdf: expected joints that lead from load to rod, got none"),
    ],
)
def test_other_links__are_refused_in_one_line(tmp_path, base, tool, message):
    assert refusal(EXCAVATOR, tmp_path, base, tool).startswith(message)


def test_program__prints_a_file_or_one_line(tmp_path):
    """What it prints on stdout is the file."""
    path = tmp_path / "robot.urdf"
    path.write_text(EXCAVATOR)
    command = [sys.executable, PROGRAM, path, "chassis"]
    good, bad = (
        subprocess.run([*command, tool], capture_output=True, text=True, cwd=PROGRAM.parents[1])
        for tool in ("edge", "load")
    )
    names = {}
    exec(good.stdout, names)
    assert isinstance(names["MACHINE"], Machine) and isinstance(names["MACHINE"].joints[0], Joint)
    assert bad.returncode == 1 and bad.stderr.startswith("float: expected a revolute or prismatic")
    assert bad.stderr.count("\n") == 1
