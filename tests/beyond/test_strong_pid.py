"""The strongest PID: its static map, and each of its four additions by hand."""

from functools import partial

import numpy as np
from helpers_machines import DRIVEN, POSE, opened, steady

from brokk_min.beyond.strong_pid import StaticMap, StrongGains, StrongPID, static_map
from brokk_min.jacobian import Gains, JacobianController
from brokk_min.kinematics import forward_kinematics, jacobian
from brokk_min.machine import BROKK_170

GOAL = np.array([0.04, -0.03, 0.05])
J = jacobian(forward_kinematics(BROKK_170, POSE))[:, DRIVEN]
NO_HELP = StaticMap(
    np.tile([0.0, 1.0], (4, 1)), np.array([-1e-9, 1e-9]), np.tile([-9.0, 9.0], (4, 2, 1))
)  # within the dead zone, whatever the velocity
measured = partial(steady, POSE)


def controller(feedforward=NO_HELP, **gains):
    sizes = dict.fromkeys(StrongGains.__dataclass_fields__, 1) | {"kp": 4, "ki": 4, "kd": 4}
    arrays = {name: np.full(size, gains.get(name, 0.0)) for name, size in sizes.items()}
    return StrongPID(BROKK_170, StrongGains(**arrays), 0.1, 1e-6, feedforward)


def counts(c, now):
    """Commands of the driven joints in counts of 127."""
    u, _ = c(now, c.start(1))
    assert u[0, 1] == 0
    return np.rint(127 * u[0, DRIVEN])


def test_without_its_additions__it_is_the_papers_controller():
    """Its error integral is of the paper's velocity of the tool, too."""
    arrays = {"kp": np.full(4, 1.2), "ki": np.full(4, 2.0), "kd": np.full(4, 0.05)}
    paper = JacobianController(BROKK_170, Gains(**arrays, feedback=np.full(1, 0.3)), 0.1, 1e-6)
    strong = controller(kp=1.2, ki=2.0, kd=0.05, feedback=0.3)
    state, other = paper.start(1), strong.start(1)
    for v in (1.0, 0.5, -0.7, -1.0):
        now = measured(v * GOAL, 0.01)
        u, state = paper(now, state)
        same, other = strong(now, other)
        least = (u == same) | ((same == 0) & (np.abs(127 * u) < 10))  # below half a count: closed
        assert least.all() and same.any()
        np.testing.assert_allclose(other[0], state, atol=1e-12)
        np.testing.assert_array_equal(other[1].v_tool, now.v_tool)


def test_feedforward__adds_the_opening_of_the_nets_command():
    """The map of a line: 1.5 rad/s at full command at q = 0, 1 rad/s at q = 1."""
    u = np.linspace(-1, 1, 5)
    velocity = np.tile(np.stack([1.5 * u, u]), (4, 1, 1))
    line = StaticMap(np.tile([0.0, 1.0], (4, 1)), u, velocity)
    q_dot = np.array([[0.3, -0.3, 0.25, 9.0]])  # at q = 0.5 full command gives 1.25 rad/s
    found = line.command(np.array([[0.0, 1.0, 0.5, 0.5]]), q_dot)
    np.testing.assert_allclose(found, [[0.2, -0.3, 0.2, 1.0]], atol=1e-12)
    q_dot = np.linalg.pinv(J) @ GOAL
    steady = line.command(POSE[None, DRIVEN], q_dot[None])[0]
    beyond = np.sign(steady) * np.maximum(0, np.abs(steady) - 0.07) / 0.93
    found = counts(controller(line, kp=1.5), measured(GOAL))
    np.testing.assert_array_equal(found, opened(1.5 * q_dot + beyond))


def test_integral_feedback__adds_the_error_integral_to_the_goal():
    """After three ticks at rest the tool is behind by 3 x 50 ms of an error of at most 6 mm/s."""
    c = controller(integral_feedback=2.0)
    state = c.start(1)
    for _ in range(4):
        _, state = c(measured(0.1 * GOAL), (c.start(1)[0], state[1]))
    fades = np.exp(-0.0125 * np.arange(1, 4)).sum()
    lag = 0.006 * GOAL / np.linalg.norm(GOAL)  # |0.1 GOAL| = 7 mm/s
    v = 0.1 * GOAL + 2.0 * 0.05 * fades * lag
    np.testing.assert_allclose(state[0].q_dot_goal[0], np.linalg.pinv(J) @ v, rtol=1e-5)


def test_starts__open_a_closed_valve_wider_for_a_while():
    """Three times as wide from the tick after the first command on, for 0.12 s."""
    c = controller(kp=1.0, start_boost=2.0, start_time=0.12)
    opening = np.linalg.pinv(J) @ GOAL
    plain = opened(opening)
    for ticks, factor in ((0, 1), (1, 3), (2, 3), (3, 1), (12, 1), (13, 1)):
        u = np.zeros((5, 13))
        u[DRIVEN, 13 - ticks :] = plain[:, None] / 127
        expected = opened(factor * opening)
        np.testing.assert_array_equal(counts(c, measured(GOAL, u=u)), expected)


def test_min_opening__holds_valves_open_while_the_tool_is_to_move():
    for kp in (1.5, 1e-3):
        c = controller(kp=kp, min_opening=0.03)
        opening = kp * np.linalg.pinv(J) @ GOAL
        opening = np.sign(opening) * np.maximum(np.abs(opening), 0.03)
        np.testing.assert_array_equal(counts(c, measured(GOAL)), opened(opening))
    assert not counts(c, measured(0 * GOAL, 0.01)).any()  # without a goal they close


def test_at_rest__it_closes_its_valves_after_a_tenth_of_a_second_and_integrates_no_more():
    """The arm still moves: the PID brakes for two ticks."""
    c = controller(kp=2.0, ki=5.0)
    state, moves, integrals = c.start(1), [], []
    for v_goal in (GOAL, *[0 * GOAL] * 6):
        u, state = c(measured(v_goal, 0.05), state)
        moves.append(u.any())
        integrals.append(state[0].integral[0])
    assert moves == [True] * 3 + [False] * 4
    np.testing.assert_array_equal(integrals[-1], integrals[-5])
    assert np.all(integrals[-6] != integrals[-5])


class SteadyNet:
    """Nets in whose steady motion a command of u gives a velocity of 0.4 u - 0.1 q [rad/s]."""

    history, rate = 13, 20.0
    output_low, output_high = np.full(4, -0.4), np.full(4, 0.4)

    def predict(self, history: np.ndarray) -> np.ndarray:
        moved = history[..., 0, -1] - history[..., 0, 0]
        np.testing.assert_allclose(moved, 0.6 * history[..., 1, -1], atol=1e-5)  # 12 ticks
        return 0.8 * history[..., 2, -1] - 0.2 * history[..., 0, -1] - history[..., 1, -1]


def test_static_map__is_the_steady_motion_of_the_nets():
    """v = 0.8 u - 0.2 q - v of a history that moves at v; inverted, u = (v + 0.1 q) / 0.4."""
    found = static_map(BROKK_170, SteadyNet())
    assert found.u[0] == -80 / 127 and found.u[-1] == 80 / 127
    expected = 0.4 * found.u - 0.1 * found.q[..., None]
    np.testing.assert_allclose(found.velocity, expected, atol=1e-6)
    q, q_dot = POSE[None, DRIVEN], np.array([[0.01, -0.05, 0.03, 0.0]])
    np.testing.assert_allclose(found.command(q, q_dot), (q_dot + 0.1 * q) / 0.4, atol=1e-5)


def test_widen__keeps_the_anti_windup_of_the_wider_valve():
    """An opening of kp e alone would leave room; three times as wide it is cut at 80 counts."""
    c = controller(kp=3.0, ki=10.0, start_boost=2.0, start_time=9.0)
    u = np.zeros((5, 13))
    u[:, -1] = 20 / 127
    now = measured(3 * GOAL, u=u)
    _, state = c(now, c.start(1))
    full = np.abs(counts(c, now)) == 80
    assert full.any() and not full.all()
    assert (state[0].integral[0] != 0).tolist() == (~full).tolist()
    assert (np.abs(counts(controller(kp=3.0), now)) < 80).all()
