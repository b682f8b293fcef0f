"""Kinematics against a closed form, matrix exponentials, Pinocchio and finite differences."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from helpers_machines import damped_rates
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from scipy.linalg import expm
from strategies import moving, posed, poses, reals

from brokk_min import kinematics
from brokk_min.kinematics import (
    _plan,
    forward_kinematics,
    frames,
    jacobian,
    joint_rates,
    lowest_point,
    tool_jacobian,
    tool_position,
    tool_state,
    tool_velocity,
)
from brokk_min.machine import BROKK_170, Machine

START = np.array([1.5, 0.5, 0.58, 1.71, 1.24])  # q_s of the paper
LINKS = (1.15, 1.25, 1.15, 1.20)


def closed_form(q: np.ndarray) -> np.ndarray:
    """DESIGN section 4, link by link: points (5, ..., 3) at the ends of all links."""
    q1, q2, q3, q4, q5 = np.moveaxis(q, -1, 0)
    e2 = q2
    e3 = e2 + q3
    e4 = e3 + q4 - np.pi
    e5 = e4 + q5 - 3 * np.pi / 4
    r, z = 0.25 + 0 * q1, 0.95 + 0 * q1
    points = [np.stack([r * np.cos(q1), r * np.sin(q1), z], axis=-1)]
    for length, elevation in zip(LINKS, (e2, e3, e4, e5), strict=True):
        r, z = r + length * np.cos(elevation), z + length * np.sin(elevation)
        points.append(np.stack([r * np.cos(q1), r * np.sin(q1), z], axis=-1))
    return np.array(points)


# --- by hand --------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_cosines_and_sines_also_of_half_turns(dtype):
    """Against the C library: where a half-angle's tangent is infinite, beyond a turn, and at random."""
    special = np.pi * np.array(
        [0, 1, -1, 3, 2, 0.5, -0.5, 1.5, np.nextafter(1, 2), np.nextafter(-1, 0)]
    )
    angles = np.concatenate([special, np.random.default_rng(0).uniform(-20, 20, 1000)]).astype(
        dtype
    )
    theta = np.array([[[np.pi / 2 + 0.3], [0.3]]], dtype)
    for offset in (theta, theta - dtype(0.3)):
        cosines, sines = kinematics._turns(angles[None], offset)[0]
        atol = 1e-15 if dtype is np.float64 else 3e-6
        wanted = [(math.cos(a), math.sin(a)) for a in (angles + offset[0, 1]).astype(float)]
        np.testing.assert_allclose(np.stack([cosines, sines], axis=-1), wanted, atol=atol, rtol=0)
        assert cosines.dtype == sines.dtype == dtype


def test_the_start_pose_of_the_paper():
    x, y, z = tool_position(forward_kinematics(BROKK_170, START))
    assert np.hypot(x, y) == pytest.approx(3.05, abs=0.005)
    assert z == pytest.approx(1.01, abs=0.005)
    assert np.arctan2(y, x) == pytest.approx(1.5)


def test_the_arm_stretched_out():
    straight = np.array([0.0, 0.0, 0.0, np.pi, 3 * np.pi / 4])
    np.testing.assert_allclose(
        tool_position(forward_kinematics(BROKK_170, straight)), [5.0, 0, 0.95], atol=1e-12
    )
    upright = np.add(straight, [np.pi / 2, np.pi / 2, 0, 0, 0])
    np.testing.assert_allclose(
        tool_position(forward_kinematics(BROKK_170, upright)), [0, 0.25, 5.7], atol=1e-12
    )
    # 1 rad/s of slew moves the tool at 5 m/s sideways; 1 rad/s of q5 lifts it at 1.2 m/s
    wanted = [[0, 0, 0, 0], [5, 0, 0, 0], [0, 3.6, 2.35, 1.2]]
    np.testing.assert_allclose(
        jacobian(forward_kinematics(BROKK_170, straight))[..., BROKK_170.driven], wanted, atol=1e-12
    )
    # the locked joint, moved by the operator, carries the tool too: 4.75 m
    velocity = tool_velocity(forward_kinematics(BROKK_170, straight), np.array([0, 1.0, 0, 0, 0]))
    np.testing.assert_allclose(velocity, [0, 0, 4.75], atol=1e-12)


@pytest.mark.parametrize(
    ("bend", "lowest"),
    [
        ([0, 0, 0, 0, 0], 0.95),  # all flat
        ([0, 0, 0, 0, -np.pi / 2], 0.95 - 1.2),  # tool down
        ([0, 0, 0, -np.pi / 2, np.pi], 0.95 - 1.15),  # a V: its corner is lowest, not the tool
        ([0, 0, -np.pi / 2, np.pi / 2, 0], 0.95 - 1.25),
        ([0, -np.pi / 2, np.pi, 0, 0], 0.95 - 1.15),
        ([0, np.pi / 2, 0, 0, 0], 0.95),  # upright: the pivot is lowest
    ],
)
def test_lowest_point_by_hand(bend, lowest):
    q = np.array([0.0, 0.0, 0.0, np.pi, 3 * np.pi / 4]) + bend
    assert lowest_point(forward_kinematics(BROKK_170, q)) == pytest.approx(lowest, abs=1e-12)


# --- independent oracles --------------------------------------------------------------------------


@given(poses(BROKK_170, (20,)))
def test_closed_form_of_the_brokk(q):
    points = closed_form(q)
    np.testing.assert_allclose(
        tool_position(forward_kinematics(BROKK_170, q)), points[-1], atol=1e-12
    )
    origins = np.moveaxis(frames(BROKK_170, q)[..., 1:, :3, 3], -2, 0)
    np.testing.assert_allclose(origins, points, atol=1e-12)
    np.testing.assert_allclose(
        lowest_point(forward_kinematics(BROKK_170, q)), points[..., 2].min(axis=0), atol=1e-12
    )


def twist(angular: np.ndarray, linear: np.ndarray) -> np.ndarray:
    x, y, z = angular
    matrix = np.zeros((4, 4))
    matrix[:3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    matrix[:3, 3] = linear
    return matrix


def product_of_exponentials(machine: Machine, q: np.ndarray) -> np.ndarray:
    """Frames (n + 1, 4, 4) of one pose: spatial screws at the zero pose, exponentials, home."""
    x, _, z = np.eye(3)
    along_z = expm(np.array([twist(z * j.theta, z * j.d) for j in machine.joints]))
    along_x = expm(np.array([twist(x * j.alpha, x * j.a) for j in machine.joints]))
    homes = [np.eye(4)]
    for first, second in zip(along_z, along_x, strict=True):
        homes.append(homes[-1] @ first @ second)
    axes, points = [h[:3, :3] @ z for h in homes[:-1]], [h[:3, 3] for h in homes[:-1]]
    screws = [twist(w, np.cross(p, w)) for w, p in zip(axes, points, strict=True)]
    moved, result = np.eye(4), [np.eye(4)]
    for turn, home in zip(expm(np.array(screws) * q[:, None, None]), homes[1:], strict=True):
        moved = moved @ turn
        result.append(moved @ home)
    return np.array(result)


@given(posed(shapes=[()]))
def test_frames_are_the_product_of_exponentials(machine_and_pose):
    machine, q = machine_and_pose
    wanted = product_of_exponentials(machine, q)
    np.testing.assert_allclose(frames(machine, q), wanted, atol=1e-10)
    np.testing.assert_allclose(
        tool_position(forward_kinematics(machine, q)), wanted[-1, :3, 3], atol=1e-10
    )
    lowest = wanted[1:, 2, 3].min()
    np.testing.assert_allclose(lowest_point(forward_kinematics(machine, q)), lowest, atol=1e-10)


def pinocchio_brokk() -> pin.Model:
    """The arm from its description, not from the DH rows: axes to the right lift the links."""
    model = pin.Model()
    up, right = np.array([0.0, 0.0, 1.0]), np.array([0.0, -1.0, 0.0])
    rows = [
        ("q1", up, (0.0, 0.0, 0.0), 0.0),
        ("q2", right, (0.25, 0.0, 0.95), 0.0),
        ("q3", right, (1.15, 0.0, 0.0), 0.0),
        ("q4", right, (1.25, 0.0, 0.0), -np.pi),
        ("q5", right, (1.15, 0.0, 0.0), -3 * np.pi / 4),
    ]
    parent = 0
    for name, axis, place, offset in rows:
        turn = pin.AngleAxis(offset, right).toRotationMatrix()
        at = pin.SE3(turn, np.array(place))
        parent = model.addJoint(parent, pin.JointModelRevoluteUnaligned(axis), at, name)
    tip = pin.SE3(np.eye(3), np.array([1.2, 0.0, 0.0]))
    model.addFrame(pin.Frame("tool", parent, tip, pin.FrameType.OP_FRAME))
    return model


@given(poses(BROKK_170), poses(BROKK_170))
def test_the_brokk_in_pinocchio(q, other):
    model = pinocchio_brokk()
    data, tool = model.createData(), model.getFrameId("tool")
    q_dot = np.array(other - q)
    pin.framesForwardKinematics(model, data, q)
    np.testing.assert_allclose(
        tool_position(forward_kinematics(BROKK_170, q)), data.oMf[tool].translation, atol=1e-12
    )
    # DH frame i sits at the end of link i, Pinocchio's joint i + 1 at its start
    pivots = [data.oMi[i].translation for i in range(2, 6)]
    np.testing.assert_allclose(frames(BROKK_170, q)[1:5, :3, 3], pivots, atol=1e-12)
    full = pin.computeFrameJacobian(model, data, q, tool, pin.LOCAL_WORLD_ALIGNED)[:3]
    np.testing.assert_allclose(
        jacobian(forward_kinematics(BROKK_170, q))[..., BROKK_170.driven],
        full[:, [0, 2, 3, 4]],
        atol=1e-12,
    )
    pin.forwardKinematics(model, data, q, q_dot)
    velocity = pin.getFrameVelocity(model, data, tool, pin.LOCAL_WORLD_ALIGNED).linear
    np.testing.assert_allclose(
        tool_velocity(forward_kinematics(BROKK_170, q), q_dot), velocity, atol=1e-12
    )


@given(posed(shapes=[(), (3,)]))
def test_jacobian_is_the_derivative_of_the_tool_position(machine_and_pose):
    machine, q = machine_and_pose
    step = 1e-6
    J = jacobian(forward_kinematics(machine, q))[..., machine.driven]
    assert J.shape == (*q.shape[:-1], 3, len(machine.driven))
    for column, joint in enumerate(machine.driven):
        nudge = step * np.eye(machine.n)[joint]
        ahead, behind = (
            tool_position(forward_kinematics(machine, q + nudge)),
            tool_position(forward_kinematics(machine, q - nudge)),
        )
        slope = (ahead - behind) / (2 * step)
        np.testing.assert_allclose(J[..., column], slope, atol=1e-7)


# --- wanted joint rates ---------------------------------------------------------------------------

speeds = npst.arrays(np.float64, 3, elements=reals(-1.0, 1.0))


def arm_length(machine: Machine) -> float:
    return float(np.hypot(machine.column("a"), machine.column("d")).sum())


def test_joint_rates_of_the_stretched_arm_by_hand():
    """Along the arm nothing can be done; sideways the slew and upward the others share, by their lever."""
    straight = np.array([0.0, 0.0, 0.0, np.pi, 3 * np.pi / 4])
    square = (0.06 * (np.hypot(0.25, 0.95) + 1.15 + 1.25 + 1.15 + 1.2)) ** 2
    assert square == pytest.approx(0.11830, abs=1e-5)
    wanted = [0.5 * 5 / (25 + square), *(0.3 * np.array([3.6, 2.35, 1.2]) / (19.9225 + square))]
    found = joint_rates(BROKK_170, straight, np.array([0.1, 0.5, 0.3]))
    np.testing.assert_allclose(found, wanted, rtol=1e-6)
    np.testing.assert_allclose(joint_rates(BROKK_170, straight, [0.1, 0, 0]), 0, atol=1e-15)


@given(posed(), speeds)
def test_joint_rates_solve_the_normal_equations(machine_and_pose, v):
    machine, q = machine_and_pose
    assume(arm_length(machine) > 1)  # short arms: see below
    v = np.broadcast_to(v, (*q.shape[:-1], 3))
    wanted, damping = damped_rates(machine, q, v), 0.06 * arm_length(machine)
    found = joint_rates(machine, q, v)
    assert found.shape == (*q.shape[:-1], len(machine.driven)) and found.dtype == np.float64
    most = np.linalg.norm(v, axis=-1).max() / (2 * damping)  # no pose asks for more, see below
    np.testing.assert_allclose(found, wanted, atol=1e-6 / damping**2 * most + 1e-12)
    single = joint_rates(machine, q.astype(np.float32), v.astype(np.float32))
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, wanted, atol=1e-3 * most + 1e-12)


@given(poses(BROKK_170, (20,)), speeds)
def test_single_precision_is_enough_for_the_rates_of_the_brokk(q, v):
    v = np.broadcast_to(v, (20, 3))
    single = joint_rates(BROKK_170, q.astype(np.float32), v.astype(np.float32))
    np.testing.assert_allclose(single, joint_rates(BROKK_170, q, v), atol=1e-5)


@given(posed(shapes=[()]), speeds, st.randoms(use_true_random=False))
def test_joint_rates_are_the_least_cost(machine_and_pose, v, random):
    """|J x - v|^2 + lambda^2 |x|^2 grows by its own quadratic part however the rates are changed."""
    machine, q = machine_and_pose
    assume(arm_length(machine) > 1)
    J, square = (
        jacobian(forward_kinematics(machine, q))[..., machine.driven],
        (0.06 * arm_length(machine)) ** 2,
    )

    def cost(x: np.ndarray) -> float:
        return float(np.sum((J @ x - v) ** 2) + square * np.sum(x**2))

    best = joint_rates(machine, q, v)
    for _ in range(5):
        change = np.array([random.uniform(-1, 1) for _ in best])
        more = np.sum((J @ change) ** 2) + square * np.sum(change**2)
        slope = 2e-6 * np.abs(best @ change)  # what 1e-6 more of damping leaves
        assert cost(best + change) - cost(best) == pytest.approx(more, abs=slope + 1e-10)


@given(posed(), speeds)
def test_joint_rates_are_bounded_and_move_the_tool_no_faster_than_wanted(machine_and_pose, v):
    """At most |v| / (2 lambda), however near a singularity; and never against what is wanted."""
    machine, q = machine_and_pose
    assume(arm_length(machine) > 1)
    v = np.broadcast_to(v, (*q.shape[:-1], 3))
    rates, speed = joint_rates(machine, q, v), np.linalg.norm(v, axis=-1)
    assert (np.linalg.norm(rates, axis=-1) <= speed / (0.12 * arm_length(machine)) + 1e-12).all()
    moved = np.einsum(
        "...ij,...j->...i", jacobian(forward_kinematics(machine, q))[..., machine.driven], rates
    )
    assert (np.linalg.norm(moved, axis=-1) <= speed + 1e-12).all()
    assert (np.einsum("...i,...i->...", moved, v) >= -1e-12).all()


def test_joint_rates_near_a_singularity_stay_small_and_follow_elsewhere():
    """Bending the stretched arm by a milliradian: undamped, q3 to q5 would race; damped, they rest."""
    bent = np.array([0.0, 0.0, 0.001, np.pi, 3 * np.pi / 4 + 0.001])
    outward = np.array([0.1, 0.0, 0.0])
    assert (
        np.abs(
            np.linalg.pinv(jacobian(forward_kinematics(BROKK_170, bent))[..., BROKK_170.driven])
            @ outward
        ).max()
        > 10
    )
    assert np.abs(joint_rates(BROKK_170, bent, outward)).max() < 0.005
    J = jacobian(forward_kinematics(BROKK_170, START))[..., BROKK_170.driven]
    for v in 0.3 * np.eye(3):
        assert np.linalg.norm(J @ joint_rates(BROKK_170, START, v) - v) < 0.06 * 0.3


def test_an_arm_without_length_has_no_rates():
    joints = tuple(replace(joint, a=0.0, d=0.0) for joint in BROKK_170.joints)
    for q in (START, START.astype(np.float32)):
        rates = joint_rates(replace(BROKK_170, joints=joints), q, np.ones(3))
        assert rates.tolist() == [0.0] * 4


@given(moving(shapes=[(1,), (4,), (2, 3)]), speeds)
def test_joint_rates_of_a_batch_are_those_of_its_poses_one_by_one(case, v):
    machine, q, _ = case
    wishes = v * np.linspace(0.5, 1, q[..., 0].size).reshape(*q.shape[:-1], 1)
    batch, same = joint_rates(machine, q, wishes), joint_rates(machine, q, v)
    for index in np.ndindex(q.shape[:-1]):
        alone = joint_rates(machine, q[index], wishes[index])
        np.testing.assert_allclose(batch[index], alone, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(
            same[index], joint_rates(machine, q[index], v), rtol=1e-9, atol=1e-9
        )


# --- properties -----------------------------------------------------------------------------------


@given(moving())
def test_tool_velocity_is_the_derivative_along_the_motion(case):
    machine, q, q_dot = case
    step = 1e-6
    ahead, behind = (
        tool_position(forward_kinematics(machine, q + s * step * q_dot)) for s in (1, -1)
    )
    position, velocity, lowest = tool_state(machine, q, q_dot)
    np.testing.assert_allclose(velocity, (ahead - behind) / (2 * step), atol=1e-7)
    np.testing.assert_array_equal(velocity, tool_velocity(forward_kinematics(machine, q), q_dot))
    np.testing.assert_allclose(position, tool_position(forward_kinematics(machine, q)), atol=1e-14)
    np.testing.assert_allclose(lowest, lowest_point(forward_kinematics(machine, q)), atol=1e-14)


@given(moving())
def test_driven_joints_move_the_tool_through_the_jacobian_and_locked_ones_add_to_it(case):
    machine, q, q_dot = case
    still = q_dot.copy()
    still[..., machine.locked] = 0.0
    through = np.einsum(
        "...ij,...j->...i",
        jacobian(forward_kinematics(machine, q))[..., machine.driven],
        q_dot[..., machine.driven],
    )
    np.testing.assert_allclose(
        tool_velocity(forward_kinematics(machine, q), still), through, atol=1e-12
    )
    freed = tuple(replace(joint, driven=True) for joint in machine.joints)
    every = jacobian(forward_kinematics(replace(machine, joints=freed), q))[
        ..., replace(machine, joints=freed).driven
    ]
    whole = np.einsum("...ij,...j->...i", every, q_dot)
    np.testing.assert_allclose(
        tool_velocity(forward_kinematics(machine, q), q_dot), whole, atol=1e-12
    )


@given(moving(shapes=[(1,), (4,), (2, 3)]))
def test_a_batch_is_the_same_as_its_poses_one_by_one(case):
    machine, q, q_dot = case
    for function in (frames, tool_position, jacobian, lowest_point):
        batch = function(machine, q)
        for index in np.ndindex(q.shape[:-1]):
            np.testing.assert_allclose(batch[index], function(machine, q[index]), atol=1e-14)
    batch = tool_velocity(forward_kinematics(machine, q), q_dot)
    for index in np.ndindex(q.shape[:-1]):
        alone = tool_velocity(forward_kinematics(machine, q[index]), q_dot[index])
        np.testing.assert_allclose(batch[index], alone, atol=1e-14)


def test_an_empty_batch_has_empty_results():
    q = np.zeros((0, 5))
    assert frames(BROKK_170, q).shape == (0, 6, 4, 4)
    assert jacobian(forward_kinematics(BROKK_170, q))[..., BROKK_170.driven].shape == (0, 3, 4)
    assert lowest_point(forward_kinematics(BROKK_170, q)).shape == (0,)
    assert joint_rates(BROKK_170, q, np.zeros((0, 3))).shape == (0, 4)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_batch_of_several_blocks_is_its_halves(dtype):
    """Blocks of `_chain` hold 1024 or 2048 poses; rounding does not depend on how many come together."""
    q = np.random.default_rng(1).uniform(-1, 1, (3, 1500, 5)).astype(dtype)
    p, J = tool_jacobian(BROKK_170, q)
    assert J.shape == (3, 1500, 3, 5)
    for some in (np.s_[:2], np.s_[2:], np.s_[:, 1499], np.s_[1, 700]):
        np.testing.assert_array_equal(
            p[some], tool_position(forward_kinematics(BROKK_170, q[some]))
        )
        np.testing.assert_array_equal(J[some], tool_jacobian(BROKK_170, q[some])[1])


def test_constants_of_a_machine_are_worked_out_once_a_float_type():
    single, double = (_plan(BROKK_170, np.dtype(kind)) for kind in ("f4", "f8"))
    assert single is _plan(BROKK_170, np.dtype("f4")) and single is not double


@given(posed())
def test_every_frame_is_a_rotation_and_a_place_and_the_base_stays(machine_and_pose):
    machine, q = machine_and_pose
    result = frames(machine, q)
    R = result[..., :3, :3]
    unit = np.broadcast_to(np.eye(3), R.shape)
    np.testing.assert_allclose(np.swapaxes(R, -1, -2) @ R, unit, atol=1e-13)
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=1e-13)
    bottom = np.broadcast_to([0.0, 0, 0, 1], result[..., 3, :].shape)
    np.testing.assert_array_equal(result[..., 3, :], bottom)
    np.testing.assert_array_equal(
        result[..., 0, :, :], np.broadcast_to(np.eye(4), (*q.shape[:-1], 4, 4))
    )


@given(moving())
def test_single_precision_stays_single_and_close(case):
    machine, q, q_dot = case
    small, small_dot = q.astype(np.float32), q_dot.astype(np.float32)
    for function in (frames, tool_position, jacobian, lowest_point):
        result = function(machine, small)
        assert result.dtype == np.float32, function.__name__
        np.testing.assert_allclose(result, function(machine, q), atol=2e-5)
    results = tool_state(machine, small, small_dot)
    assert [value.dtype for value in results] == [np.float32] * 3
    for result, exact in zip(results, tool_state(machine, q, q_dot), strict=True):
        np.testing.assert_allclose(result, exact, atol=5e-5)


def test_single_precision_stays_single_for_link_lengths_out_of_an_array():
    """A team's table of links is often an array, whose numbers are np.float64 and win over float32."""
    table = np.array([[joint.a, joint.d] for joint in BROKK_170.joints])
    joints = zip(BROKK_170.joints, table, strict=True)
    machine = replace(BROKK_170, joints=tuple(replace(j, a=a, d=d) for j, (a, d) in joints))
    assert tool_position(forward_kinematics(machine, START.astype(np.float32))).dtype == np.float32
    assert (
        jacobian(forward_kinematics(machine, START.astype(np.float32)))[..., machine.driven].dtype
        == np.float32
    )


def test_whole_angles_and_lists_are_angles():
    whole = tool_position(forward_kinematics(BROKK_170, [1, 0, 1, 2, 1]))
    np.testing.assert_array_equal(
        whole, tool_position(forward_kinematics(BROKK_170, np.array([1.0, 0, 1, 2, 1])))
    )


# --- refusals -------------------------------------------------------------------------------------


def test_position_and_jacobian_in_one_pass_are_those_alone():
    """Runs of parallel axes are turned together; a joint alone with its alpha is a run too."""
    alphas = [0.0, 0.0, np.pi / 2, 0.3, 0.0]
    joints = tuple(
        replace(joint, alpha=a, d=0.2) for joint, a in zip(BROKK_170.joints, alphas, strict=True)
    )
    for machine in (BROKK_170, replace(BROKK_170, joints=joints)):
        q = np.random.default_rng(0).uniform(-1, 1, (4, 2, 5))
        p, J = tool_jacobian(machine, q)
        np.testing.assert_array_equal(p, tool_position(forward_kinematics(machine, q)))
        np.testing.assert_array_equal(
            J[..., machine.driven], jacobian(forward_kinematics(machine, q))[..., machine.driven]
        )
        for i in range(5):
            ahead, behind = (
                tool_position(forward_kinematics(machine, q + h * np.eye(5)[i]))
                for h in (1e-6, -1e-6)
            )
            np.testing.assert_allclose(J[..., i], (ahead - behind) / 2e-6, atol=1e-8)


@pytest.mark.parametrize("shape", [(), (4,), (6,), (5, 4), (5, 1), (0,)])
@pytest.mark.parametrize("function", [frames, tool_position, jacobian, lowest_point])
def test_angles_of_another_machine_are_refused(function, shape):
    with pytest.raises(ValueError) as caught:
        function(BROKK_170, np.zeros(shape))
    assert str(caught.value) == f"q: expected (..., 5), got {shape}"


@pytest.mark.parametrize("function", [tool_state, tool_velocity])
def test_velocities_of_another_machine_are_refused_by_their_own_name(function):
    with pytest.raises(ValueError) as caught:
        function(BROKK_170, np.zeros((2, 5)), np.zeros((2, 4)))
    assert str(caught.value) == "q_dot: expected (..., 5), got (2, 4)"
    with pytest.raises(ValueError) as caught:
        function(BROKK_170, np.zeros((2, 4)), np.zeros((2, 5)))
    assert str(caught.value) == "q: expected (..., 5), got (2, 4)"


def test_rates_keep_the_float_type_of_the_angles():
    q = np.array([0.3, 0.5, 0.58, 1.71, 1.24], np.float32)
    assert joint_rates(BROKK_170, q, np.array([0.1, 0.0, 0.2])).dtype == np.float32
    assert joint_rates(BROKK_170, q.astype(float), np.zeros(3, np.float32)).dtype == np.float64
