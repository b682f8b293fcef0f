"""A `Machine` from a URDF: the chain of joints from a base link to a tool link, as a Python file.

    python examples/from_urdf.py EXCAVATOR.urdf BASE_LINK TOOL_LINK > my_machine.py

Geometry, ranges, speeds and order of the joints are the URDF's. A URDF says nothing of valves,
encoders and a bus, so all other fields are assumed; most are the Brokk's. Warnings go to stderr, as
does the largest distance between the machine's tool and that of Pinocchio, which reads the URDF
(`pip install pin`).
"""

import pprint
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import pinocchio as pin  # type: ignore[import-untyped]

from brokk_min.kinematics import forward_kinematics, tool_position
from brokk_min.machine import BROKK_170, Array, Joint, Machine, require

PARALLEL = 1e-5  # rad: axes count as parallel up to here, because URDFs round pi/2 to 1.5708
COINCIDENT = 1e-10  # m
POSES = 100  # at which tool positions are compared
KINDS: tuple[Literal["revolute"], Literal["prismatic"]] = ("revolute", "prismatic")
LONGEST = 50.0  # m, assumed: no machine has a longer link
NEAR = 1e-3  # m: tools that are farther apart are not those of one machine
FASTEST, SPEED = 10.0, 0.3  # rad/s or m/s, assumed: above the first, the second stands in


class Chain(NamedTuple):
    """What Pinocchio reads from a URDF; vectors are in the frame of the base link, at q = 0."""

    model: Any
    base: int  # frame of the base link
    tool: int  # frame of the tool link
    joints: list[int]  # in the order from the base to the tool
    points: Array  # one on each axis [m], (n, 3): where the URDF has the joint
    axes: Array  # unit vectors, (n, 3)
    slides: list[bool]  # is the joint prismatic?


def read_chain(path: Path, base: str, tool: str) -> Chain:
    """The chain of a URDF file. ValueError: it is no chain of revolute and prismatic joints."""
    try:
        model = pin.buildModelFromXML(path.read_text(encoding="utf-8"), mimic=True)
    except ValueError as error:
        raise ValueError(f"{path}: expected a URDF, after xacro if need be, got {error}") from error
    links = {f.name: i for i, f in enumerate(model.frames) if f.type == pin.FrameType.BODY}
    for link in (base, tool):
        require(link in links, str(path), f"a link of {[*links]}", link)
    ends = (model.frames[links[link]].parentJoint for link in (base, tool))
    before, joints = (list(model.supports[joint]) for joint in ends)
    leads = before == joints[: len(before)] and len(before) < len(joints)
    require(leads, str(path), f"joints that lead from {base} to {tool}", "none")
    joints = joints[len(before) :]
    for j in joints:
        kind = model.joints[j].shortname().removeprefix("JointModel")
        one = model.joints[j].nv == 1  # not so of floating and planar joints, and of mimics
        require(one, model.names[j], "a revolute or prismatic joint that moves by itself", kind)
    points, axes, slides = read_axes(model, links[base], joints)
    wanted = f"an axis that points up from {base}, as the first of a machine does"
    require(axes[0, 2] > np.cos(PARALLEL), model.names[joints[0]], wanted, axes[0].round(3))
    return Chain(model, links[base], links[tool], joints, points, axes, slides)


def read_axes(model: Any, base: int, joints: list[int]) -> tuple[Array, Array, list[bool]]:
    """The last three fields of a `Chain`."""
    data = model.createData()
    pin.computeJointJacobians(model, data, pin.neutral(model))
    frame = pin.updateFramePlacement(model, data, base)
    points = np.array([frame.actInv(data.oMi[j].translation) for j in joints])
    J = data.J.reshape(6, -1)  # of one joint it has one axis only
    twists = [J[:, model.joints[j].idx_v] for j in joints]  # linear, then angular velocity
    slides = [not twist[3:].any() for twist in twists]
    axes = [twist[:3] if slide else twist[3:] for twist, slide in zip(twists, slides)]
    return points, np.array(axes) @ frame.rotation, slides  # R^T z of each axis


def library_position(chain: Chain, q: Array) -> Array:
    """The tool's position in the frame of the base link [m] (3,), by Pinocchio."""
    model, v = chain.model, np.zeros(chain.model.nv)
    v[[model.joints[j].idx_v for j in chain.joints]] = q
    data = model.createData()
    pin.framesForwardKinematics(model, data, pin.integrate(model, pin.neutral(model), v))
    return np.asarray(data.oMf[chain.base].actInv(data.oMf[chain.tool].translation))


def base_origin(chain: Chain) -> Array:
    """Where the machine's base frame lies in the base link's [m] (3,): on the first axis, level."""
    return np.array([*chain.points[0, :2], 0.0])


def common_normal(
    origin: Array, x: Array, z: Array, point: Array, z_next: Array
) -> tuple[Array, Array]:
    """Where the common normal of two axes meets the second, and its direction; (3,) both.

    The axes are `z` through `origin` and `z_next` through `point`. Parallel axes have many normals,
    of which this is the one through `point`. Of coincident axes it is the one along `x`.
    """
    normal, between = np.cross(z, z_next), point - origin
    sine = np.linalg.norm(normal)
    if sine < PARALLEL:
        across = between - (between @ z) * z
        distance = np.linalg.norm(across)
        return point, across / distance if distance > COINCIDENT else x
    normal = normal / sine
    foot = point + (between @ np.cross(z, normal)) / sine * z_next
    side = between @ normal
    side = side if abs(side) > COINCIDENT else normal @ x  # the axes meet: the smaller turn of x
    return foot, -normal if side < 0 else normal


def dh_rows(chain: Chain) -> list[list[float]]:
    """a, alpha, d, theta of each joint: T = Rz(theta) Tz(d) Tx(a) Rx(alpha).

    Frame i has its z along the axis of joint i + 1 and its x along the common normal of the axes of
    joints i and i + 1; the last frame has its origin at the tool.
    """
    origin, x, z = base_origin(chain), np.eye(3)[0], chain.axes[0]
    tool = library_position(chain, np.zeros(len(chain.joints)))
    rows = []
    for point, z_next in zip([*chain.points[1:], tool], [*chain.axes[1:], chain.axes[-1]]):
        foot, x_next = common_normal(origin, x, z, point, z_next)
        theta = np.arctan2(np.cross(x, x_next) @ z, x @ x_next)
        alpha = np.arctan2(np.cross(z, z_next) @ x_next, z @ z_next)
        if abs(np.sin(alpha)) < PARALLEL:
            alpha = 0.0 if z @ z_next > 0 else np.pi
        row = np.array([(foot - origin) @ x_next, alpha, (foot - origin) @ z, theta])
        rows.append((row.round(13) + 0.0).tolist())
        origin, x, z = foot, x_next, z_next
    return rows


def limits(chain: Chain, i: int) -> tuple[float, float, float]:
    """Limits of a joint [rad or m] and of its speed, with a warning if they look like placeholders.

    Limits between which nothing can move are replaced.
    """
    model, slides, name = chain.model, chain.slides[i], chain.model.names[chain.joints[i]]
    joint = model.joints[chain.joints[i]]
    low, high = model.lowerPositionLimit[joint.idx_q], model.upperPositionLimit[joint.idx_q]
    speed = model.velocityLimit[joint.idx_v]
    low, high = (low, high) if joint.nq == 1 else (-np.inf, np.inf)  # 2: it turns without an end
    usable = -100 < low < high < 100
    stand_in = (0.0, 1.0) if slides else (-np.pi, np.pi)
    turns = not slides and np.isin(np.abs([low, high]).round(2), [3.14, 6.28]).any()
    if turns or not usable:
        others = "millimetres" if slides else "degrees"
        doubt = "are the wrong way round" if low > high else f"look like placeholders or {others}"
        needs = "" if slides else "; a bus needs less than a turn"
        needs += "" if usable else f" ({stand_in[0]:.3g} to {stand_in[1]:.3g} stand in)"
        warn(f"{name}: the limits {low:g} to {high:g} {doubt}: measure its range{needs}")
    elif not slides and (max(-low, high) > 2 * np.pi or high - low > 3 * np.pi):
        warn(f"{name}: the limits {low:g} to {high:g} rad look like degrees")
    if not usable:
        low, high = stand_in
    if not 0 < speed < FASTEST:
        warn(f"{name}: the velocity limit {speed:g} looks like a placeholder: {SPEED} stands in")
        speed = SPEED
    return float(low), float(high), float(speed)


def make_machine(chain: Chain) -> Machine:
    """The machine of a chain; what a URDF does not say is the Brokk's."""
    joints = []
    for i, (a, alpha, d, theta) in enumerate(dh_rows(chain)):
        low, high, speed = limits(chain, i)
        name, kind = chain.model.names[chain.joints[i]], KINDS[chain.slides[i]]
        row = a, alpha, d, theta, low, high, speed, speed, i + 1
        if max(abs(a), abs(d)) > LONGEST:
            doubt = "m looks like centimetres or millimetres"
            warn(f"{name}: its link of {max(abs(a), abs(d)):g} {doubt}")
        joints.append(Joint(name, True, *row, kind=kind))
    last = joints[-1]
    if last.kind == "revolute" and abs(last.a) < COINCIDENT:
        warn(f"{last.name}: cannot move the tool, which lies on its axis: it is not driven")
        joints[-1] = replace(last, driven=False)
    own = {"name": chain.model.name, "q_start": (), "hydraulics": None}
    return replace(BROKK_170, joints=tuple(joints), **own)


def largest_difference(chain: Chain, machine: Machine) -> float:
    """The largest distance between the tool positions of both at random poses [m]."""
    low, high = machine.column("q_min"), machine.column("q_max")
    q = np.random.default_rng(0).uniform(low, high, (POSES, machine.n))
    positions = tool_position(forward_kinematics(machine, q)) + base_origin(chain)
    library = [library_position(chain, pose) for pose in q]
    return float(np.linalg.norm(positions - library, axis=1).max())


def warn(text: str) -> None:
    """One line on stderr."""
    print(f"warning: {text}", file=sys.stderr)


def main(path: str, base: str, tool: str) -> None:
    """Print the machine, and on stderr how well it agrees with the URDF."""
    chain = read_chain(Path(path), base, tool)
    machine = make_machine(chain)
    difference = largest_difference(chain, machine)
    wanted = f"a tool where Pinocchio has it (has each joint an axis?), at most {NEAR} m apart"
    require(difference < NEAR, path, wanted, f"{difference:.2g} m")
    print(f"tools are at most {difference:.1e} m apart at {POSES} random poses", file=sys.stderr)
    print("from brokk_min.machine import Joint, Machine\n")
    print(f"# The base frame is that of link {base!r}, moved by {base_origin(chain).tolist()} m.")
    print("# Of the URDF: kind, a, alpha, d, theta, q_min, q_max, q_dot_*. All else is assumed.")
    print("MACHINE =", pprint.pformat(machine, width=100))


if __name__ == "__main__":
    if len(sys.argv) != 4:
        sys.exit(__doc__)
    try:
        main(*sys.argv[1:])
    except (OSError, ValueError) as error:
        sys.exit(str(error))
