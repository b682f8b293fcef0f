"""The classical controller: least squares against solvers, slopes by differences, a PID by hand."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
import scipy.linalg
from helpers_machines import obedient_net, obedient_velocity, random_machine
from scipy.optimize import minimize

from benchmarks.rollout import random_net
from brokk_min import jacobian as classic
from brokk_min.actuator import ActuatorNet, initial_history
from brokk_min.env import TaskConfig, measured, observe
from brokk_min.evaluation import baselines
from brokk_min.evaluation.rollout import rollout
from brokk_min.jacobian import JacobianController, Memory
from brokk_min.kinematics import forward_kinematics, jacobian
from brokk_min.machine import BROKK_170, valve_opening

POSE = np.array([1.5, 0.5, 0.58, 1.71, 1.24])  # the paper's q_s
STRETCHED = np.array([0.3, 0.5, 0.1, np.pi, 3 * np.pi / 4])  # all links in one line
MACHINES = [random_machine(np.random.default_rng(50 + i), 2 + i % 5) for i in range(6)]


def case(seed, n=4):
    rng = np.random.default_rng(seed)
    J, W = rng.normal(size=(3, n)), np.exp(rng.normal(0, 1.5, n))
    return J, W, rng.uniform(0.01, 1.0), rng.normal(size=3), rng


# --- the pseudo-inverse ---------------------------------------------------------------------------


def test_dls_by_hand():
    """Three joints, each along one axis: every axis is W^-1 j / (j^2 W^-1 + lambda^2) by itself."""
    J, W = np.diag([1.0, 2.0, 0.0]), np.array([1.0, 4.0, 9.0])
    right = classic.dls(J, W, 0.5)
    np.testing.assert_allclose(right, np.diag([1 / 1.5, 0.5 / 1.5, 0.0]), atol=1e-12)
    printed = classic.dls(J, W, 0.5, as_printed=True)  # j W^-1 / (j^2 W + lambda^2)
    np.testing.assert_allclose(printed, np.diag([1 / 1.5, 0.5 / 16.5, 0.0]), atol=1e-12)


@pytest.mark.parametrize("n", [1, 2, 3, 4, 6])
@pytest.mark.parametrize("seed", range(4))
def test_dls_solves_the_augmented_least_squares(seed, n):
    """SciPy's least squares with the damping as further rows."""
    J, W, damping, v, _ = case(seed, n)
    tall = np.vstack([J, np.sqrt(damping) * np.diag(np.sqrt(W))])
    wanted = scipy.linalg.lstsq(tall, np.concatenate([v, np.zeros(n)]))[0]
    np.testing.assert_allclose(classic.dls(J, W, damping) @ v, wanted, atol=1e-10)


def slopes(seed, as_printed, W=None):
    """Central differences of |J q_dot - v|^2 + lambda^2 q_dot^T W q_dot at the answer of `dls`."""
    J, random_W, damping, v, _ = case(seed)
    W = random_W if W is None else W
    q_dot = classic.dls(J, W, damping, as_printed) @ v

    def cost(x):
        return np.sum((J @ x - v) ** 2) + damping * x @ (W * x)

    step = 1e-5 * np.eye(4)
    return np.array([(cost(q_dot + e) - cost(q_dot - e)) / 2e-5 for e in step])


@pytest.mark.parametrize("seed", range(8))
def test_dls_is_stationary_and_the_printed_form_is_not(seed):
    assert np.abs(slopes(seed, as_printed=False)).max() < 1e-7
    assert np.abs(slopes(seed, as_printed=True)).max() > 1e-2


@pytest.mark.parametrize("seed", range(3))
def test_both_forms_agree_for_equal_weights(seed):
    J, _, damping, _, _ = case(seed)
    ones = np.ones(4)
    printed = classic.dls(J, ones, damping, as_printed=True)
    np.testing.assert_allclose(classic.dls(J, ones, damping), printed, atol=1e-14)
    assert np.abs(slopes(seed, True, ones)).max() < 1e-7
    plain = J.T @ np.linalg.inv(J @ J.T + damping * np.eye(3))
    np.testing.assert_allclose(printed, plain, atol=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_without_damping_dls_is_an_inverse(seed):
    J, W, _, _, _ = case(seed)
    errors = [np.abs(J @ classic.dls(J, W, d) - np.eye(3)).max() for d in (1e-1, 1e-4, 1e-8)]
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] < 1e-5
    exact = classic.dls(J, np.ones(4), 0.0)
    np.testing.assert_allclose(exact, np.linalg.pinv(J), atol=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_a_heavier_joint_moves_less_and_damping_shortens(seed):
    J, W, damping, v, _ = case(seed)
    before = classic.dls(J, W, damping) @ v
    for joint in range(4):
        heavy = W.copy()
        heavy[joint] *= 10
        assert abs((classic.dls(J, heavy, damping) @ v)[joint]) < abs(before[joint])
    lengths = [np.linalg.norm(classic.dls(J, np.ones(4), d) @ v) for d in (0.01, 0.1, 1, 10)]
    assert (np.diff(lengths) < 0).all()


def test_a_batch_is_its_members():
    rng = np.random.default_rng(0)
    J, W, damping = rng.normal(size=(2, 5, 3, 4)), rng.uniform(1, 9, (2, 5, 4)), rng.random((2, 5))
    together = classic.dls(J, W, damping)
    assert together.shape == (2, 5, 4, 3)
    for i in np.ndindex(2, 5):
        np.testing.assert_allclose(together[i], classic.dls(J[i], W[i], damping[i]), atol=1e-12)


# --- limits and singularities ---------------------------------------------------------------------


def chan_dubey(machine, q):
    low, high = machine.column("q_min"), machine.column("q_max")
    return np.sum((high - low) ** 2 / (4 * (high - q) * (q - low)), axis=-1)


@pytest.mark.parametrize("machine", [BROKK_170, *MACHINES], ids=lambda m: m.name)
def test_limit_gradient_is_the_slope_of_chan_and_dubeys_function(machine):
    low, high = machine.column("q_min"), machine.column("q_max")
    rng, step = np.random.default_rng(1), 1e-6
    q = low + rng.uniform(0.05, 0.95, (20, machine.n)) * (high - low)
    for joint, e in enumerate(step * np.eye(machine.n)):
        slope = (chan_dubey(machine, q + e) - chan_dubey(machine, q - e)) / (2 * step)
        found = classic.limit_gradient(machine, q)[:, joint]
        np.testing.assert_allclose(found, slope, rtol=1e-5, atol=1e-6)


def test_limit_gradient_by_hand():
    low, high = BROKK_170.column("q_min"), BROKK_170.column("q_max")
    middle, width = (low + high) / 2, high - low
    np.testing.assert_allclose(classic.limit_gradient(BROKK_170, middle), 0, atol=1e-12)
    # three quarters up: w^2 (w/2) / (4 (w/4 . 3w/4)^2) = 32 / (9 w)
    found = classic.limit_gradient(BROKK_170, low + 0.75 * width)
    np.testing.assert_allclose(found, 32 / (9 * width))
    np.testing.assert_allclose(classic.limit_gradient(BROKK_170, low + 0.25 * width), -found)


def test_limit_weights_stand_at_and_beyond_the_limits():
    low, high = BROKK_170.column("q_min"), BROKK_170.column("q_max")
    for q, direction in ((high, 1.0), (high + 0.01, 1.0), (low, -1.0), (low - 0.01, -1.0)):
        W = classic.limit_weights(BROKK_170, q, np.full(5, direction))
        assert np.isfinite(W).all()
        assert (W > 1e4).all()
        assert (classic.limit_weights(BROKK_170, q, np.full(5, -direction)) == 1).all()


@pytest.mark.parametrize("machine", [BROKK_170, *MACHINES], ids=lambda m: m.name)
def test_limit_weights_act_only_towards_the_limit(machine):
    low, high = machine.column("q_min"), machine.column("q_max")
    rng = np.random.default_rng(2)
    share = rng.uniform(0.01, 0.99, (200, machine.n))
    q_dot = rng.normal(size=(200, machine.n)) * (rng.random((200, machine.n)) < 0.8)
    q = low + share * (high - low)
    W = classic.limit_weights(machine, q, q_dot)
    towards = ((share > 0.5) & (q_dot > 0)) | ((share < 0.5) & (q_dot < 0))
    slope = np.abs(classic.limit_gradient(machine, q))
    np.testing.assert_allclose(W[towards], 1 + slope[towards])
    assert (W[~towards] == 1).all()
    assert towards.mean() > 0.2


def test_damping_by_hand_and_without_a_jump():
    found = classic.nakamura_damping([0.0, 0.25, 0.5, 1.0, 3.0], 0.5, 0.1)
    np.testing.assert_allclose(found, [0.1, 0.025, 0, 0, 0])
    w = np.linspace(0, 1, 2001)
    damping = classic.nakamura_damping(w, 0.5, 0.05)
    assert damping[0] == 0.05
    assert (np.diff(damping) <= 0).all()
    assert np.abs(np.diff(damping)).max() < 2e-4  # 2 k / w0 times the step
    np.testing.assert_allclose(2 * damping, classic.nakamura_damping(w, 0.5, 0.1))


def test_manipulability_is_the_product_of_singular_values():
    J = np.random.default_rng(3).normal(size=(4, 5, 3, 4))
    wanted = np.linalg.svd(J, compute_uv=False).prod(-1)
    np.testing.assert_allclose(classic.manipulability(J), wanted, rtol=1e-9)
    np.testing.assert_allclose(classic.manipulability(J[..., :2]), 0, atol=1e-6)  # rank 2


def test_manipulability_vanishes_where_the_arm_is_straight():
    good = classic.manipulability(
        jacobian(forward_kinematics(BROKK_170, POSE))[..., BROKK_170.driven]
    )
    assert (
        classic.manipulability(
            jacobian(forward_kinematics(BROKK_170, STRETCHED))[..., BROKK_170.driven]
        )
        < 1e-6 * good
    )
    threshold = classic.manipulability_threshold(BROKK_170)
    assert 0 < threshold < 10 * good
    assert threshold == classic.manipulability_threshold(BROKK_170)


# --- the controller -------------------------------------------------------------------------------


def at_rest(q, v_goal, machine=BROKK_170, q_dot=None):
    """Observation without noise of machines at angles `q`, moving at `q_dot`."""
    q = np.asarray(q, float)
    history = np.zeros((*q.shape, 3, machine.history))
    history[..., 0, :] = q[..., None]
    if q_dot is not None:
        history[..., 1, :] = np.asarray(q_dot)[..., None]
        history[..., 0, :] += history[..., 1, :] * machine.dt * np.arange(1 - machine.history, 1)
    return observe(machine, history, np.asarray(v_goal, float), np.zeros(3))


def controller(w0=1e-6, k=0.1, machine=BROKK_170, **values):
    gains = classic.join_gains(machine, dict.fromkeys(classic.GAINS, 0.0) | values)
    return JacobianController(machine, gains, k, w0)


def rates(c, seen, last):
    return c.rates(measured(c.machine, seen.astype(float)), last)


GOAL = np.array([0.04, -0.03, 0.05])


def test_rates_are_eq3():
    """x_goal + K e, least squares: an optimiser finds the same rates."""
    q_dot = np.array([0.02, 0.0, -0.03, 0.01, 0.04])
    seen = at_rest(POSE, GOAL, q_dot=q_dot)[None]
    J, w0 = jacobian(forward_kinematics(BROKK_170, POSE))[..., BROKK_170.driven], 100.0
    v_tool = J @ q_dot[BROKK_170.driven]
    wanted = GOAL + 0.3 * (GOAL - v_tool)
    damping = 0.1 * (1 - np.sqrt(np.linalg.det(J @ J.T)) / w0) ** 2
    towards = np.array([0.1, 0.0, 0.1, -0.1, 0.0])
    W = classic.limit_weights(BROKK_170, POSE, towards)[[0, 2, 3, 4]]

    def cost(x):
        return np.sum((J @ x - wanted) ** 2) + damping * x @ (W * x)

    best = minimize(cost, np.zeros(4), tol=1e-12).x
    towards_driven = towards[[0, 2, 3, 4]][None]
    rate = rates(controller(w0, feedback=0.3), seen, towards_driven)
    np.testing.assert_allclose(rate[0], best, atol=1e-5)
    other = rates(controller(w0, feedback=0.3), seen, -towards_driven)
    assert np.abs(other - rate).max() > 1e-3  # the last direction decides the weights


@pytest.mark.parametrize("pose", [POSE, STRETCHED], ids=["paper", "stretched"])
def test_the_rate_clip_slows_down_in_the_same_direction(pose):
    c, last = controller(w0=0.5, k=0.05), np.zeros((1, 4))
    small = rates(c, at_rest(pose, 0.01 * GOAL)[None], last)
    up, down = (BROKK_170.column(f"q_dot_{way}")[[0, 2, 3, 4]] for way in ("up", "down"))
    fastest = np.where(small > 0, up, down)
    assert (np.abs(small) < fastest).all()
    for scale in (0.02, 0.5, 5.0, 500.0):
        rate = rates(c, at_rest(pose, scale * GOAL)[None], last)
        assert (np.abs(rate) <= fastest * (1 + 1e-9)).all()
        unclipped = small * scale / 0.01
        share = np.max(np.abs(unclipped) / fastest)
        np.testing.assert_allclose(rate, unclipped / max(1, share), rtol=1e-3, atol=1e-6)


def test_the_first_tick_of_a_p_controller_by_hand():
    c = controller(kp=1.5)
    seen = at_rest(POSE, GOAL)[None]
    rate = (
        np.linalg.pinv(jacobian(forward_kinematics(BROKK_170, POSE))[..., BROKK_170.driven]) @ GOAL
    )  # at rest all weights are 1
    u, memory = c(seen, c.start(1))
    opening = 1.5 * rate
    wanted = np.rint(127 * np.sign(opening) * (0.07 + 0.93 * np.abs(opening)))
    counts = u[0] * 127
    np.testing.assert_allclose(counts[[0, 2, 3, 4]], wanted, atol=1e-6)
    assert counts[1] == 0
    assert (np.abs(wanted) >= 9).all()  # whatever it asks for is beyond the dead zone of 8.9 counts
    assert len(np.unique(np.abs(wanted))) > 1
    np.testing.assert_allclose(memory.rate[0], rate, atol=1e-6)
    np.testing.assert_allclose(memory.error[0], rate, atol=1e-6)
    assert not memory.integral.any()  # ki is 0


def test_a_resting_machine_without_a_goal_stays_idle():
    c = controller(kp=2.0, ki=5.0, kd=0.1, feedback=0.5)
    memory = c.start(3)
    for _ in range(5):
        u, memory = c(at_rest(np.stack([POSE] * 3), np.zeros((3, 3))), memory)
        assert not u.any()


def test_the_integral_and_the_derivative_by_hand():
    """Constant error e: the opening grows by ki e dt a tick; the derivative fades by 0.7 a tick."""
    seen = at_rest(POSE, 0.3 * GOAL)[None]
    e = np.linalg.pinv(jacobian(forward_kinematics(BROKK_170, POSE))[..., BROKK_170.driven]) @ (
        0.3 * GOAL
    )
    c = controller(ki=2.0)
    memory = c.start(1)
    for tick in range(6):
        u, memory = c(seen, memory)
        np.testing.assert_allclose(memory.integral[0], (tick + 1) * 2.0 * e * 0.05, rtol=2e-2)
        assert tick or not u.any()  # nothing has been integrated before the first tick
    assert u.any()
    c = controller(kd=0.1)
    memory, found = c.start(1), []
    for _ in range(3):
        u, memory = c(seen, memory)
        found.append(memory.slope[0])
        opening = 0.1 * memory.slope[0]
        wanted = np.sign(opening) * (0.07 + 0.93 * np.abs(opening))
        wanted[np.abs(opening) < 0.5 / 127] = 0  # idle
        np.testing.assert_allclose(u[0, [0, 2, 3, 4]], wanted, atol=0.51 / 127)
    np.testing.assert_allclose(found[0], 0.3 * e * 20, rtol=1e-2)
    np.testing.assert_allclose(found[2], 0.49 * found[0], rtol=5e-2, atol=1e-3)


def test_the_integral_stops_while_the_valve_is_fully_open():
    c = controller(kp=40.0, ki=10.0)
    seen, memory = at_rest(POSE, 5 * GOAL)[None], c.start(1)
    for _ in range(20):
        u, memory = c(seen, memory)
    np.testing.assert_allclose(np.abs(u[0, [0, 2, 3, 4]]).max(), 80 / 127)
    full = np.abs(u[0, [0, 2, 3, 4]]) > 79.5 / 127
    assert full.any()
    assert (memory.integral[0, full] == 0).all()
    stuck = controller(ki=10.0)  # without kp the integral fills the valve, then stops
    memory, sizes = stuck.start(1), []
    for _ in range(200):
        u, memory = stuck(seen, memory)
        sizes.append(np.abs(memory.integral).max())
    room = (80 / 127 - 0.07) / 0.93
    assert sizes[-1] == sizes[-50]
    assert room <= sizes[-1] <= room + 10 * 0.47 * 0.05
    back = memory
    for _ in range(10):  # and comes out of the stop at once when the goal turns round
        u, back = stuck(at_rest(POSE, -5 * GOAL)[None], back)
    assert (np.abs(back.integral) < np.abs(memory.integral)).all()


def test_no_valve_goes_idle_while_the_tool_is_to_move():
    """Moving along z, the slew valve is held at the opening `ready`; without a goal all valves close."""
    c = controller(kp=1e-3, ready=0.03)
    wanted = round(127 * (0.07 + 0.93 * 0.03))
    u, _ = c(at_rest(POSE, [0.0, 0.01, 0.1])[None], c.start(1))
    assert np.abs(np.rint(u[0] * 127)).tolist() == [wanted, 0, wanted, wanted, wanted]
    rate = rates(c, at_rest(POSE, [0.0, 0.01, 0.1])[None], np.zeros((1, 4)))
    assert (np.sign(u[0, BROKK_170.driven]) == np.sign(rate[0])).all()
    still, _ = c(at_rest(POSE, np.zeros(3))[None], c.start(1))
    assert not still.any()
    far, _ = controller(kp=1.5, ready=0.03)(at_rest(POSE, GOAL)[None], c.start(1))
    same, _ = controller(kp=1.5)(at_rest(POSE, GOAL)[None], c.start(1))
    beyond = np.abs(same) > wanted / 127
    assert beyond.any() and (far[beyond] == same[beyond]).all()  # a least opening, not one more


def test_valves_that_stay_awake_are_barely_open_when_the_tool_is_to_stand():
    """A tool that sinks a little is called back with the least opening; without `awake` by closed valves."""
    history = np.array(initial_history(POSE, 13))
    history[..., 1, :] = [[0.001], [0.0], [-0.001], [0.001], [0.001]]
    seen = observe(BROKK_170, history, np.zeros(3), np.zeros(3))[None]
    c = controller(kp=1e-3, ready=0.03)
    assert not c(seen, c.start(1))[0].any()
    u, _ = replace(c, awake=True)(seen, c.start(1))
    wanted = round(127 * (0.07 + 0.93 * 0.03))
    assert np.rint(u[0] * 127).tolist() == [-wanted, 0, wanted, -wanted, -wanted]


def test_controllers_of_a_batch_do_not_meet():
    rng = np.random.default_rng(4)
    c = controller(w0=0.5, kp=1.0, ki=3.0, kd=0.05, feedback=0.3)
    poses = POSE + rng.uniform(-0.1, 0.1, (4, 5))
    together, alone = c.start(4), [c.start(1) for _ in range(4)]
    for _ in range(6):
        seen = at_rest(poses, rng.uniform(-0.2, 0.2, (4, 3)))
        u, together = c(seen, together)
        for i in range(4):
            single, alone[i] = c(seen[i : i + 1], alone[i])
            np.testing.assert_allclose(single[0], u[i], atol=1e-9)
    assert isinstance(together, Memory)


def test_commands_stay_within_the_limit_anywhere():
    rng = np.random.default_rng(5)
    for machine in (BROKK_170, *MACHINES):
        c = controller(0.3, machine=machine, kp=3.0, ki=9.0, kd=0.2, feedback=1.0)
        low, high = machine.column("q_min"), machine.column("q_max")
        q = np.where(
            rng.random((50, machine.n)) < 0.3, high, rng.uniform(low, high, (50, machine.n))
        )
        memory = c.start(50)
        for _ in range(5):
            seen = at_rest(q, rng.normal(0, 1, (50, 3)), machine)
            u, memory = c(seen, memory)
            counts = u * 127
            assert np.isfinite(u).all()
            assert np.abs(counts).max() <= machine.pwm_limit + 1e-9
            np.testing.assert_allclose(counts, np.rint(counts), atol=1e-9)
            assert not u[:, machine.locked].any()


# --- feed-forward ---------------------------------------------------------------------------------


def test_feed_forward_alone_sends_the_steady_command():
    steady = classic.static_map(BROKK_170, obedient_net(BROKK_170))
    c = replace(controller(), feedforward=steady)
    u, _ = c(at_rest(POSE, 2 * GOAL)[None], c.start(1))
    rate = np.linalg.pinv(jacobian(forward_kinematics(BROKK_170, POSE))[..., BROKK_170.driven]) @ (
        2 * GOAL
    )
    fastest = 1.2 * BROKK_170.q_dot_max[[0, 2, 3, 4]]
    wanted = 2 / 3 * np.arctanh(rate / fastest)  # the obedient nets turned round
    far = np.abs(wanted) > 10 / 127
    assert far.any()
    np.testing.assert_allclose(u[0, [0, 2, 3, 4]][far], wanted[far], atol=1 / 127)


# --- as a whole -----------------------------------------------------------------------------------


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [1, -1])
def test_the_plant_is_driven_towards_the_goal(axis, sign):
    c = controller(classic.manipulability_threshold(BROKK_170), kp=0.9, ki=8.0, feedback=0.3)
    goals = np.zeros((80, 1, 3))
    goals[..., axis] = 0.1 * sign
    rng = np.random.default_rng(0)
    trace = rollout(BROKK_170, c, POSE[None], goals, TaskConfig(noise=0.0), rng)
    error = np.linalg.norm(trace.v_tool - goals, axis=-1)[:, 0]
    assert error[0] == pytest.approx(0.1, abs=1e-3)  # the valve has a delay
    assert error[40:].mean() < 0.05
    moved = (trace.p_tool[-1] - trace.p_tool[0])[0]
    assert sign * moved[axis] > 0.2
    assert np.abs(np.delete(moved, axis)).max() < 0.1


# --- what a mutation tool had changed unseen -------------------------------------------------------


def test_damping_sets_in_at_a_quarter_of_the_largest_manipulability():
    low, high = BROKK_170.column("q_min"), BROKK_170.column("q_max")
    q = np.random.default_rng(9).uniform(low, high, (20_000, 5))
    largest = classic.manipulability(
        jacobian(forward_kinematics(BROKK_170, q))[..., BROKK_170.driven]
    ).max()
    assert 0.24 * largest < classic.manipulability_threshold(BROKK_170) < 0.251 * largest
    stiff = [
        replace(j, a=0.0, d=0.0) for j in BROKK_170.joints
    ]  # no reach: 0, but something to divide by
    assert 0 < classic.manipulability_threshold(replace(BROKK_170, joints=tuple(stiff))) < 1e-6


def test_the_weights_of_a_tick_follow_the_rates_of_the_tick_before():
    """The same observation, remembered rates towards a joint's limit or away from it: other commands."""
    c, near = controller(kp=1.5), POSE.copy()
    near[2] = BROKK_170.joints[2].q_max - 0.05
    seen, idle = at_rest(near, GOAL)[None], c.start(1)
    rate = np.array([[0.0, 0.1, 0.0, 0.0]])
    _, towards = c(seen, idle._replace(rate=rate))
    _, away = c(seen, idle._replace(rate=-rate))
    assert np.abs(towards.rate[0, 1]) < 0.5 * np.abs(away.rate[0, 1])


def test_the_slope_at_a_limit_is_that_a_thousandth_of_the_range_before_it():
    """There it is (1 - 2e) / (4 e^2 (1 - e)^2) over the range, e = 0.001."""
    width = BROKK_170.column("q_max") - BROKK_170.column("q_min")
    for q, sign in ((BROKK_170.column("q_max"), 1), (BROKK_170.column("q_min") - 1, -1)):
        slope = classic.limit_gradient(BROKK_170, q) * width
        np.testing.assert_allclose(slope, sign * 0.998 / (4e-6 * 0.999**2), rtol=1e-6)


def test_feed_forward_is_added_to_the_pid():
    steady = classic.static_map(BROKK_170, obedient_net(BROKK_170))
    seen = at_rest(POSE, GOAL)[None]
    plain, ahead, both = (
        c(seen, c.start(1))[0][0, BROKK_170.driven]
        for c in (
            controller(kp=1.5),
            replace(controller(), feedforward=steady),
            replace(controller(kp=1.5), feedforward=steady),
        )
    )
    opening = valve_opening(plain, 0.07) + valve_opening(ahead, 0.07)
    np.testing.assert_allclose(valve_opening(both, 0.07), opening, atol=1.1 / 127)
    assert (np.abs(opening) > 3 / 127).any()


def test_a_machine_at_rest_keeps_its_valves_closed_beside_one_that_moves():
    c = controller(kp=1e-3, ready=0.03)
    goals = np.array([[0.0, 0.0, 0.1], [0.0, 0.0, 0.0]])
    drifting = np.full((2, 5), 0.01)  # so that the PID asks for a little, less than half a count
    u, _ = c(at_rest(np.stack([POSE, POSE]), goals, q_dot=drifting), c.start(2))
    assert u[0].any() and not u[1].any()


def test_a_single_observation_gives_the_command_of_a_batch_of_one():
    c = controller(w0=0.5, kp=1.0, ki=3.0, kd=0.05, feedback=0.3, ready=0.02)
    seen, memory = at_rest(POSE, 9 * GOAL), c.start(1)
    alone = Memory(*(part[0] for part in memory))
    for _ in range(3):
        (u, memory), (one, alone) = c(seen[None], memory), c(seen, alone)
        np.testing.assert_allclose(one, u[0], atol=1e-12)
