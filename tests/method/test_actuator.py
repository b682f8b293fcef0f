"""The plant: its calibration and its equations. The history. The nets against a plain loop."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from helpers_machines import (
    POSE,
    constant_net,
    obedient_net,
    obedient_velocity,
    random_net,
    shared_net,
)
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from scipy.special import expit
from strategies import machines, poses, reals

from brokk_min.actuator import (
    ActuatorNet,
    PlantState,
    append_command,
    append_sample,
    command_at_rest,
    initial_history,
    lever_arm,
    mu_law,
    net_step,
    open_indicator,
    plant_reset,
    plant_step,
    smooth_angles,
)
from brokk_min.identification.net_file import joint_nets
from brokk_min.machine import BROKK_170, Machine

FAST = replace(BROKK_170, rate=200.0)  # a tick is one step of 5 ms
LIMIT = 80 / 127
MIDDLE = np.array([0.0, 0.5, 0.5, 1.7, 1.0])
Q5 = 4


def record(
    machine: Machine, q: np.ndarray, u: np.ndarray
) -> tuple[PlantState, np.ndarray, np.ndarray]:
    """Last state, joint velocities and cylinder speeds (ticks, ..., n) under commands `u`."""
    state = plant_reset(machine, q)
    velocities, speeds = [], []
    for command in u:
        state = plant_step(machine, state, command)
        velocities.append(state.v / lever_arm(machine, state.q))
        speeds.append(state.v)
    return state, np.array(velocities), np.array(speeds)


def only(joint: int, u: np.ndarray | list[float]) -> np.ndarray:
    """Commands (ticks, 5) for one joint."""
    commands = np.zeros((len(u), 5))
    commands[:, joint] = u
    return commands


# --- the plant's calibration, measured as on a machine --------------------------------------------


def rise_time(before: float, ticks_before: int) -> float:
    """Time from the step to 80 counts until 63 % of the change in cylinder speed of q5 is done."""
    u = only(Q5, [before] * ticks_before + [LIMIT] * 250)
    _, _, speeds = record(FAST, np.array([0, 0.5, 0.5, 1.7, 0.0]), u)
    speed = np.concatenate([[0.0], speeds[:, Q5]])[ticks_before:]
    done = (speed - speed[0]) / (speed[-1] - speed[0])
    return int(np.argmax(done >= 0.63)) * FAST.dt


def test_plant_step__rises_to_63_percent_in_0_398_s_from_idle_and_0_102_s_moving():
    assert rise_time(0.0, 100) == pytest.approx(0.398, abs=0.02)
    assert rise_time(40 / 127, 200) == pytest.approx(0.102, abs=0.02)


def test_plant_step__has_the_peak_speeds_of_the_machine():
    """Ten sweeps at once: each joint alone from stop to stop, up and down."""
    goal = np.array([[0.20, 0.15, 0.17, 0.22, 0.240], [0.20, 0.22, 0.28, 0.38, 0.453]])
    tolerance = np.where(np.arange(5) == Q5, 0.001, 0.05 * goal)
    q_min, q_max = BROKK_170.column("q_min"), BROKK_170.column("q_max")
    own = np.eye(5, dtype=bool)
    start = np.stack([np.where(own, q_min, MIDDLE), np.where(own, q_max, MIDDLE)])
    u = LIMIT * np.stack([np.eye(5), -np.eye(5)])
    state, velocities, _ = record(FAST, start, np.broadcast_to(u, (4600, 2, 5, 5)))
    speeds = velocities[..., own] * np.array([[1], [-1]])  # (steps, 2, 5): of the swept joint
    np.testing.assert_array_equal(state.q[:, own], [q_max, q_min])  # all got through
    assert np.all(speeds >= 0)
    assert np.all(np.abs(speeds.max(axis=0) - goal) < tolerance), speeds.max(axis=0)


def test_plant_step__has_pump_enough_at_the_limit_and_too_little_at_full_command():
    q = np.array([0.0, 0.5, 1.4, 2.6, 1.8])
    falling = -(np.arange(5) != 1).astype(float)  # the driven joints where they need most oil

    def loss(level: float) -> float:
        _, _, alone = record(BROKK_170, q, only(Q5, np.full(25, -level)))
        _, _, together = record(BROKK_170, q, np.tile(level * falling, (25, 1)))
        return 1 - together[-1, Q5] / alone[-1, Q5]

    assert abs(loss(LIMIT)) < 0.02
    assert loss(1.0) > 0.05


def test_plant_step__delays_commands_by_the_delay():
    """Of the ten Euler steps of a tick the last two have the command: 1 - (1 - 1/6)^2 of it."""
    state = plant_step(BROKK_170, plant_reset(BROKK_170, MIDDLE), np.ones(5))
    np.testing.assert_allclose(state.s, 1 - (5 / 6) ** 2, atol=1e-12)


def test_plant_step__first_moves_at_eleven_counts():
    """8.9 counts of dead zone; the next 1.2 open the spool by less than 1 %."""
    for sign in (1, -1):
        _, velocities, _ = record(BROKK_170, MIDDLE, np.full((100, 5), sign * 10 / 127))
        assert not velocities.any()
        _, velocities, _ = record(BROKK_170, MIDDLE, np.full((100, 5), sign * 11 / 127))
        assert np.all(sign * velocities[-1] > 1e-4)


# --- the plant's equations ------------------------------------------------------------------------


def test_plant_step__holds_at_a_stop_and_lets_go():
    for sign, stop in ((1, BROKK_170.column("q_max")), (-1, BROKK_170.column("q_min"))):
        state, _, _ = record(BROKK_170, stop - sign * 0.02, np.full((60, 5), sign * 1.0))
        np.testing.assert_array_equal(state.q, stop)
        np.testing.assert_array_equal(state.v, 0.0)
        for _ in range(40):
            state = plant_step(BROKK_170, state, np.full(5, -sign * LIMIT))
        assert np.all(sign * (stop - state.q) > 0.02)


def slow_plant(machine: Machine, q: list[float], commands: np.ndarray) -> list[dict[str, float]]:
    """The equations read line by line: one joint, one 5 ms step, one number at a time."""
    m, dt = machine, machine.plant_dt
    joints = [{"q": float(a), "v": 0.0, "s": 0.0, "z": 0.0} for a in q]
    per_tick, late = round(1 / m.rate / dt), round(m.delay / dt)
    for step in range(len(commands) * per_tick):
        at = step - late
        a = [0.0] * m.n if at < 0 else commands[at // per_tick].tolist()
        goal = []
        for joint, x in zip(m.joints, joints, strict=True):
            g = 0.0
            if x["z"] > m.valve_threshold:
                part = min(1.0, (x["z"] - m.valve_threshold) / (1 - m.valve_threshold))
                g = math.sqrt(3 * part**2 - 2 * part**3)
            K = joint.speed_positive if x["s"] > 0 else joint.speed_negative
            goal.append(K * x["s"] * g)
        flow = sum(abs(j.cylinder_area * v) for j, v in zip(m.joints, goal, strict=True))
        pump = 1.0 if flow == 0 else min(1.0, m.pump_flow / flow)
        for i, (joint, x) in enumerate(zip(m.joints, joints, strict=True)):
            zone = joint.dead_zone_up if a[i] > 0 else joint.dead_zone_down
            zone = m.dead_zone if zone is None else zone
            us = math.copysign(max(0.0, (abs(a[i]) - zone) / (1 - zone)), a[i])
            zt = 1.0 if abs(x["s"]) > m.spool_threshold else 0.0
            tau = m.tau_valve_up if zt > x["z"] else m.tau_valve_down
            if joint.cylinder_base:
                b, c, gamma = joint.cylinder_base, joint.cylinder_rod, joint.cylinder_angle + x["q"]
                r = b * c * math.sin(gamma) / math.sqrt(b * b + c * c - 2 * b * c * math.cos(gamma))
            else:
                r = joint.cylinder_rod
            new = {
                "q": x["q"] + dt * x["v"] / r,
                "v": x["v"] + dt * (goal[i] * pump - x["v"]) / m.tau_cylinder,
                "s": x["s"] + dt * (us - x["s"]) / m.tau_spool,
                "z": x["z"] + dt * (zt - x["z"]) / tau,
            }
            if new["q"] >= joint.q_max:
                new |= {"q": joint.q_max, "v": min(new["v"], 0.0)}
            if new["q"] <= joint.q_min:
                new |= {"q": joint.q_min, "v": max(new["v"], 0.0)}
            joints[i] = new
    return joints


@st.composite
def driven_machines(draw: st.DrawFn) -> tuple[Machine, np.ndarray, np.ndarray]:
    machine = draw(machines())
    shape = (draw(st.integers(1, 15)), machine.n)
    u = draw(npst.arrays(np.float64, shape, elements=reals(-1, 1)))
    return machine, draw(poses(machine)), np.repeat(u, 2, axis=0)


@given(driven_machines())
def test_plant_step__is_its_equations(case):
    machine, q, u = case
    state, velocities, _ = record(machine, q, u)
    goal = slow_plant(machine, q, u)
    for name, values in (("q", state.q), ("v", state.v), ("s", state.s), ("z", state.z)):
        np.testing.assert_allclose(values, [x[name] for x in goal], atol=1e-12, err_msg=name)
    arms = lever_arm(machine, state.q)
    np.testing.assert_allclose(velocities[-1], [x["v"] for x in goal] / arms, atol=1e-12)
    assert np.all(state.q >= machine.column("q_min")) and np.all(state.q <= machine.column("q_max"))


@given(driven_machines())
def test_lever_arm__is_the_derivative_of_the_cylinder_length(case):
    machine, q, _ = case
    base, rod, angle = (machine.column(f"cylinder_{name}") for name in ("base", "rod", "angle"))
    arm = lever_arm(machine, q)
    length = lambda x: np.sqrt((base - rod * np.cos(x)) ** 2 + (rod * np.sin(x)) ** 2)  # noqa: E731
    slope = (length(angle + q + 1e-6) - length(angle + q - 1e-6)) / 2e-6
    np.testing.assert_allclose(arm, np.where(base > 0, slope, rod), atol=1e-8)
    assert np.all(arm > 0)


def test_lever_arm__of_q5_at_an_acute_angle():
    # sides 0.6 and 0.2 under 60 degrees: third side sqrt(0.28)
    arm = lever_arm(BROKK_170, np.full(5, np.pi / 3 - 0.4))
    assert arm[Q5] == pytest.approx(0.19640, abs=1e-5)


# --- histories ------------------------------------------------------------------------------------


def test_append_sample__and_append_command_by_hand():
    h = initial_history(np.array([0.5, -1.0]), 3)
    np.testing.assert_array_equal(h[1], [[-1, -1, -1], [0, 0, 0], [0, 0, 0]])
    h.setflags(write=False)
    sent = append_command(h, [0.1, 0.2])
    np.testing.assert_array_equal(sent[0], [[0.5, 0.5, 0.5], [0, 0, 0], [0, 0, 0.1]])
    np.testing.assert_array_equal(sent[1], [[-1, -1, -1], [0, 0, 0], [0, 0, 0.2]])
    seen = append_sample(h, [0.1, 0.2], np.array([0.6, -0.9]), 2, 0.05)
    np.testing.assert_allclose(seen[0], [[0.5, 0.5, 0.6], [0, 0, 2], [0, 0, 0.1]])
    np.testing.assert_allclose(seen[1], [[-1, -1, -0.9], [0, 0, 2], [0, 0, 0.2]])
    sent = append_command(seen, [0.3, 0.4])
    np.testing.assert_allclose(sent[0], [[0.5, 0.5, 0.6], [0, 0, 2], [0, 0.1, 0.3]])


def slow_forward(net: ActuatorNet, history: np.ndarray) -> np.ndarray:
    """Velocities (n,) of one history (n, 3, H): the equations, one joint at a time."""
    x = []
    for q, q_dot, u in history.astype(float):
        rows = [q, q_dot, mu_law(u, net.dead_zone)]
        if net.input_mean.shape[1] == 4 * net.history:
            opening = np.maximum(0, np.abs(u) - net.dead_zone) / (1 - net.dead_zone)
            rows.append(np.tanh(opening / 0.02))
        x.append(np.concatenate(rows))
    x = [(x[j] - net.input_mean[j]) / net.input_scale[j] for j in range(len(x))]
    weights = [w.astype(float) for w in net.weights]
    z, result = 0.0, []
    if len(weights) > 6:
        z = sum(np.concatenate([r, abs(r)]) @ S for r, S in zip(x, weights[6]))
        z = np.tanh(z + sum(weights[8]))
    for j in range(len(x)):
        w1, b1, w2, b2, w3, b3, *more = (w[j] for w in weights)
        hidden = np.maximum(x[j] @ w1 + b1 + (z @ more[1] if more else 0.0), 0)
        hidden = np.maximum(hidden @ w2 + b2, 0)
        y = expit(hidden @ w3 + b3)[0]
        result.append(net.output_low[j] + y * (net.output_high[j] - net.output_low[j]))
    return np.array(result)


@pytest.mark.parametrize("leading", [(), (1,), (7,), (2, 3)])
@pytest.mark.parametrize("kind", ["alone", "dead zone", "indicator", "shared"])
def test_forward__is_a_loop_in_double_precision(leading, kind):
    """Of the paper's nets, with companded commands, with indicators, of joints with latents."""
    rows = 3 if kind in ("alone", "dead zone") else 4
    net = random_net(len(leading), history=5, hidden=8, rows=rows)
    net = shared_net(rows=rows) if kind == "shared" else net
    net = replace(net, dead_zone=0.1 * (kind in ("dead zone", "indicator")))
    rng = np.random.default_rng(9)
    history = rng.uniform(-1, 1, (*leading, 3, 3, net.history)).astype(np.float32)
    history.setflags(write=False)
    got = net.forward(history)[0]
    assert got.shape == (*leading, 3)
    for index in np.ndindex(*leading):
        np.testing.assert_allclose(got[index], slow_forward(net, history[index]), atol=2e-5)
    assert np.all((net.output_low <= got) & (got <= net.output_high))
    np.testing.assert_array_equal(net.predict(history), got)  # none stands still


def test_mu_law__by_hand():
    """Openings 0.01 and 0.5 beyond a dead zone of 0.2: ln(1.5) and ln(26) of ln(51)."""
    u = np.array([-1.0, -0.2, 0.0, 0.1, 0.208, 0.6, 1.0])
    u.setflags(write=False)
    expected = np.array([-1, 0, 0, 0, np.log(1.5) / np.log(51), np.log(26) / np.log(51), 1])
    np.testing.assert_allclose(mu_law(u, 0.2), expected, atol=1e-12)
    np.testing.assert_array_equal(mu_law(u, 0.0), u)
    assert mu_law(np.float32([0.3]), 0.2).dtype == np.float32


def test_open_indicator__by_hand():
    """tanh(0.5) = 0.462 at 1 % of opening: 0.07 + 0.0093; tanh(1) = 0.762 at 2 %."""
    u = [0.0, 0.05, 0.07, 0.0793, -0.0793, 0.0886, -1.0]
    expected = [0, 0, 0, 0.46212, 0.46212, 0.76159, 1]
    np.testing.assert_allclose(open_indicator(u, 0.07), expected, atol=1e-5)
    assert open_indicator(np.float32(u), 0.07).dtype == np.float32


@pytest.mark.parametrize("shape", [(4, 2, 3, 13), (3, 3, 12)])
def test_predict__refuses_another_shape(shape):
    with pytest.raises(ValueError) as caught:
        random_net().predict(np.zeros(shape, np.float32))
    assert str(caught.value) == f"history: expected (..., 3, 3, 13), got {shape}"


def test_smooth_angles__by_hand():
    """Weights: angles 1/H; velocity j, dt (j - l) / H with l = 0.5, the newest dt l more."""
    machine = replace(BROKK_170, history=3, velocity_samples=3)
    history = np.zeros((1, 3, 3))
    history[0, 0] = [0.3, 0.6, 0.9]
    history[0, 1] = [1.0, 2.0, 4.0]
    expected = 0.6 + 0.05 * (-0.5 * 1.0 + 0.5 * 2.0 + (1.5 + 3 * 0.5) * 4.0) / 3
    np.testing.assert_allclose(smooth_angles(machine, history), [expected], atol=1e-12)


def test_net_step__moves_driven_joints_by_the_net_and_stops_at_the_ends():
    net = obedient_net(BROKK_170)
    u = np.array([40, 99, -80, 13, 80]) / 127
    history = initial_history(POSE[[0, 2, 3, 4]].astype(np.float32), 13)
    q = net_step(BROKK_170, net, history, POSE, u)
    move = np.zeros(5)
    move[[0, 2, 3, 4]] = obedient_velocity(BROKK_170, u[[0, 2, 3, 4]])
    np.testing.assert_allclose(q, POSE + 0.05 * move, atol=1e-8)
    top = BROKK_170.column("q_max")
    held = net_step(BROKK_170, net, history, top - 1e-4, np.full(5, 0.6))
    np.testing.assert_allclose(held, np.where([1, 0, 1, 1, 1], top, top - 1e-4), atol=1e-12)


HELD = constant_net([0.2, 0.2, 0.2, 0.2], False, ("a", "b", "c", "d"))


def test_predict__holds_a_joint_without_a_command_that_stood_still():
    """No command at all, one command in the history, an angle that moved, a command now."""
    history = initial_history(np.full(4, 0.5, np.float32), 13)
    history[1, 2, 0] = 0.01
    history[2, 0, -1] = 0.503
    history[3, 2, -1] = 0.01
    np.testing.assert_allclose(HELD.predict(history), [0, 0.2, 0.2, 0.2], atol=1e-6)
    history[2, 0, -1] = 0.501  # less than the threshold of 2 mrad
    assert HELD.predict(history)[2] == 0


def test_predict__holds_joints_under_commands_within_the_dead_zone():
    """Of 8.9 counts: 8 for the whole history are none, one of 9 is one."""
    history = initial_history(np.full(4, 0.5, np.float32), 13)
    history[:, 2] = np.float32([[8], [-8], [8], [8]]) / np.float32(127)
    history[1, 2, 3] = -9 / 127
    history[2, 0, -1:] = 0.503
    found = replace(HELD, dead_zone=0.07).predict(history)
    np.testing.assert_allclose(found, [0, 0.2, 0.2, 0], atol=1e-6)
    np.testing.assert_allclose(HELD.predict(history), 0.2, atol=1e-6)  # these know none


def test_joint_nets__are_the_same_nets_in_another_order():
    net = random_net()
    history = np.random.default_rng(2).uniform(-1, 1, (6, 3, 3, 13)).astype(np.float32)
    every = net.predict(history)  # before: a cache of the whole must not leak into the part
    part = joint_nets(net, ["j2", "j0"])
    assert part.joints == ("j2", "j0")
    np.testing.assert_allclose(part.predict(history[:, [2, 0]]), every[:, [2, 0]], atol=1e-6)
    assert part.output_low.tolist() == net.output_low[[2, 0]].tolist()
    with pytest.raises(ValueError, match=r"joints: expected nets for \['j0', 'q9'\], got"):
        joint_nets(net, ["j0", "q9"])


@pytest.mark.parametrize(
    ("valves", "after", "rule"),
    [("closed", 10, [0, 0, 0]), ("dither", 2, [-12, 12, -12]), ("open", 15, [])],
)
def test_command_at_rest__has_a_rule_for_driven_joints_until_the_next_goal(valves, after, rule):
    """127 (0.07 + 0.93 x 0.03) are 12 counts. Only the first of two machines rests all the time."""
    ticks = np.zeros(2, np.int64)
    v_goal = np.zeros((2, 3))
    sent = []
    for tick in range(1, 16):
        v_goal[1, 2] = 0.1 * (tick == 12)
        u, resting, ticks = command_at_rest(BROKK_170, valves, np.full((2, 5), 0.2), v_goal, ticks)
        assert resting[0] == (tick > after)
        sent.append(u)
    assert ticks.tolist() == [15, 3]
    first, second = np.rint(127 * np.array(sent)).astype(int).swapaxes(0, 1)
    assert (first[:after] == 25).all() and (second[11] == 25).all()
    assert first[after : after + 3, 0].tolist() == rule
    assert not first[after:, 1].any()  # q2 is locked
    assert (first[:, 2:] == first[:, :1]).all()


def test_command_at_rest__opens_each_valve_beyond_its_own_dead_zone():
    """127 (0.12 + 0.88 x 0.05) are 21 counts up, 127 (0.07 + 0.93 x 0.05) are 15 down."""
    last = replace(BROKK_170.joints[-1], dead_zone_up=0.12)
    joints = (*BROKK_170.joints[:-1], last)
    machine = replace(BROKK_170, name="own zones", joints=joints, dither=0.05)
    for ticks, counts in ((2, [-15, 0, -15, -15, -15]), (3, [15, 0, 15, 15, 21])):
        before = np.array([ticks])
        u, *_ = command_at_rest(machine, "dither", np.zeros((1, 5)), np.zeros((1, 3)), before)
        assert np.rint(127 * u[0]).tolist() == counts
