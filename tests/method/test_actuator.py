"""The plant: its calibration and its equations. The history. The nets against a plain loop."""

import dataclasses
import math
from dataclasses import replace

import numpy as np
import pytest
from helpers_machines import DRIVEN, random_net
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from scipy.special import expit
from strategies import machines, poses, reals

from brokk_min import actuator
from brokk_min.actuator import PLANT, ActuatorNet, Cylinder, Hydraulics, PlantState, lever_arm
from brokk_min.machine import BROKK_170, Joint, Machine

BROKK = actuator.hydraulics_of(BROKK_170)
FAST = replace(BROKK_170, rate=200.0)  # a tick is one step of 5 ms
LIMIT = 80 / 127
MIDDLE = np.array([0.0, 0.5, 0.5, 1.7, 1.0])
Q5 = 4
ALONE = np.eye(5)[Q5]  # the command of q5


def record(machine: Machine, q: np.ndarray, u: np.ndarray) -> tuple[PlantState, np.ndarray]:
    """States and joint velocities, arrays (ticks, ..., n), under commands `u`."""
    states = [PLANT.reset(machine, q)]
    for command in u:
        states.append(PLANT.step(machine, states[-1], command))
    found = PlantState(*map(np.array, zip(*states[1:], strict=True)))
    return found, found.v / lever_arm(machine, found.q)


# --- the plant's calibration, measured as on a machine --------------------------------------------


def rise_time(before: float, ticks_before: int) -> float:
    """Time from the step to 80 counts until 63 % of the change in cylinder speed of q5 is done."""
    u = np.outer([before] * ticks_before + [LIMIT] * 250, ALONE)
    states, _ = record(FAST, np.array([0, 0.5, 0.5, 1.7, 0.0]), u)
    speed = states.v[ticks_before - 1 :, Q5]
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
    states, velocities = record(FAST, start, np.broadcast_to(u, (4600, 2, 5, 5)))
    speeds = velocities[..., own] * np.array([[1], [-1]])  # (steps, 2, 5): of the swept joint
    np.testing.assert_array_equal(states.q[-1][:, own], [q_max, q_min])  # all got through
    assert np.all(speeds >= 0)
    assert np.all(np.abs(speeds.max(axis=0) - goal) < tolerance), speeds.max(axis=0)


def test_plant_step__has_pump_enough_at_the_limit_and_too_little_at_full_command():
    q = np.array([0.0, 0.5, 1.4, 2.6, 1.8])
    falling = -(np.arange(5) != 1).astype(float)  # the driven joints where they need most oil

    def loss(level: float) -> float:
        _, alone = record(BROKK_170, q, np.tile(-level * ALONE, (25, 1)))
        _, together = record(BROKK_170, q, np.tile(level * falling, (25, 1)))
        return 1 - together[-1, Q5] / alone[-1, Q5]

    assert abs(loss(LIMIT)) < 0.02
    assert loss(1.0) > 0.05


@pytest.mark.parametrize("with_rod", [True, False])
def test_a_machine_without_hydraulics__moves_as_fast_as_its_joints_say(with_rod):
    """All numbers of the plant are optional; speeds come from q_dot_up and q_dot_down."""
    fields = {f.name for f in dataclasses.fields(Joint) if f.default is dataclasses.MISSING}
    joints = [Joint(**{name: getattr(j, name) for name in fields}) for j in BROKK_170.joints]
    joints[2] = replace(joints[2], dead_zone=(0.1, 0.02))
    given = {f.name for f in dataclasses.fields(Machine) if f.default is dataclasses.MISSING}
    fields = {n: getattr(BROKK_170, n) for n in given} | {"joints": tuple(joints)}
    rod = Hydraulics({"q3": Cylinder(rod=0.5)})
    machine = Machine(**fields, hydraulics=rod if with_rod else None)
    for sign, q_dot in ((1, machine.column("q_dot_up")), (-1, -machine.column("q_dot_down"))):
        start = machine.column("q_min" if sign > 0 else "q_max")
        state, u = PLANT.reset(machine, start), np.full(5, sign * 80 / 127)
        for _ in range(30):
            last, state = state, PLANT.step(machine, state, u)
        np.testing.assert_allclose((state.q - last.q) * machine.rate, q_dot, rtol=1e-3)


DT = "hydraulics.dt: expected a whole part of 1/rate, not above any tau"
BAD = [
    ({"cylinder": {"rod": -0.1}}, "q5.rod: expected a positive number, got -0.1"),
    ({"cylinder": {"speed": 0.1}}, "q5.speed: expected a pair, up and down, got 0.1"),
    ({"cylinder": {"speed": (np.nan, 0.1)}}, "q5.speed: expected a pair, up and down, got (nan"),
    ({"gain": (np.nan, 1.0)}, "hydraulics: expected a delay and a pair of gains of 0 or more"),
    ({"cylinders": {"boom": Cylinder()}}, "cylinders: expected those of joints ['q1', 'q2', "),
    ({"cylinders": None}, "cylinders: expected those by joint, got None"),
    ({"cylinder": {"angle": 0.0}}, "q5.angle: expected angles in (0, pi), got 0.000 to 2.000"),
    ({"cylinder": {"angle": 1.2}}, "q5.angle: expected angles in (0, pi), got 1.200 to 3.200"),
    (
        {"delay": -0.1},
        "hydraulics: expected a delay and a pair of gains of 0 or more, got Hydraulics(",
    ),
    *[({"dt": 0.02}, f"{DT}, got 0.02"), ({"rate": 30.0}, DT), ({"dt": -0.005}, DT)],
    *(({f"tau_{x}": 0.004}, DT) for x in ("spool", "cylinder", "valve_up", "valve_down")),
]


@pytest.mark.parametrize(("changes", "message"), BAD)
def test_hydraulics__that_cannot_be_are_refused_by_name_before_anything_moves(changes, message):
    cylinders = dict(BROKK.cylinders)
    cylinders["q5"] = replace(cylinders["q5"], **changes.pop("cylinder", {}))
    machine = replace(BROKK_170, rate=changes.pop("rate", 20.0))
    changes = {"cylinders": cylinders, **changes}
    machine = replace(machine, hydraulics=replace(BROKK, **changes))
    with pytest.raises(ValueError) as caught:
        PLANT.reset(machine, MIDDLE)
    assert str(caught.value).startswith(message)
    with pytest.raises(ValueError, match=r"hydraulics: expected one of .*, got brok"):
        PLANT.reset(replace(machine, name="typo", hydraulics="brok"), MIDDLE)
    with pytest.raises(ValueError, match=r"hydraulics: expected actuator.Hydraulics, got \{\}"):
        PLANT.reset(replace(machine, hydraulics={}), MIDDLE)
    with pytest.raises(ValueError, match=r"Hydraulics.delay: expected a finite number, got nan"):
        replace(BROKK, delay=float("nan"))


@pytest.mark.parametrize("rate", [10.0, 15.0, 20.0, 24.0, 30.0, 60.0, 100.0, 1000.0])
def test_a_machine_without_hydraulics__has_whole_steps_in_a_tick_of_any_rate(rate):
    dt = actuator.hydraulics_of(replace(BROKK_170, hydraulics=None, rate=rate)).dt
    assert round(1 / (rate * dt), 6).is_integer() and dt <= 0.005
    assert dt == 0.005 or rate not in (10, 20, 100)


def test_the_brokk__has_the_hydraulics_of_the_design():
    h = actuator.hydraulics_of(BROKK_170)
    assert (h.delay, h.dt, h.tau_spool, h.tau_cylinder) == (0.04, 0.005, 0.03, 0.03)
    assert (h.tau_valve_up, h.tau_valve_down, h.valve_threshold) == (0.15, 0.4, 0.8)
    assert h.spool_threshold == 0.01
    fast = replace(BROKK, tau_spool=0.005)  # as short as a step
    assert actuator.hydraulics_of(replace(BROKK_170, hydraulics=fast)) == fast
    np.testing.assert_array_equal(actuator.cylinder_speeds(BROKK_170)[4], [0.0425, 0.0833])


# --- the plant's equations ------------------------------------------------------------------------


def slow_plant(machine: Machine, q: list[float], commands: np.ndarray) -> list[dict[str, float]]:
    """The equations read line by line: one joint, one 5 ms step, one number at a time."""
    m, h = machine, actuator.hydraulics_of(machine)
    dt = h.dt
    joints = [{"q": float(a), "v": 0.0, "s": 0.0, "z": 0.0} for a in q]
    per_tick, late = round(1 / m.rate / dt), round(h.delay / dt)
    for step in range(len(commands) * per_tick):
        at = step - late
        a = [0.0] * m.n if at < 0 else commands[at // per_tick].tolist()
        goal = []
        for joint, x in zip(m.joints, joints, strict=True):
            part = min(max(0.0, (x["z"] - h.valve_threshold) / (1 - h.valve_threshold)), 1.0)
            K = h.cylinders[joint.name].speed[0 if x["s"] > 0 else 1]
            goal.append(K * x["s"] * math.sqrt(3 * part**2 - 2 * part**3))
        areas = [h.cylinders[joint.name].area for joint in m.joints]
        flow = sum(abs(area * v) for area, v in zip(areas, goal, strict=True))
        pump = 1.0 if flow == 0 else min(1.0, h.pump_flow / flow)
        for i, (joint, x) in enumerate(zip(m.joints, joints, strict=True)):
            zone = joint.dead_zone[0 if a[i] > 0 else 1]
            us = math.copysign(max(0.0, (abs(a[i]) - zone) / (1 - zone)), a[i])
            zt = 1.0 if abs(x["s"]) > h.spool_threshold else 0.0
            tau = h.tau_valve_up if zt > x["z"] else h.tau_valve_down
            cylinder = h.cylinders[joint.name]
            b, r, gamma = cylinder.base, cylinder.rod, cylinder.angle + x["q"]
            if b:
                r *= b * math.sin(gamma) / math.sqrt(b * b + r * r - 2 * b * r * math.cos(gamma))
            new = {
                "q": x["q"] + dt * x["v"] / r,
                "v": x["v"] + dt * (goal[i] * pump - x["v"]) / h.tau_cylinder,
                "s": x["s"] + dt * (us - x["s"]) / h.tau_spool,
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


TO_THE_STOPS = np.full((30, 5), 0.6)  # commands; from 0.02 rad before the stops


@given(driven_machines())
@example((BROKK_170, BROKK_170.column("q_max") - 0.02, TO_THE_STOPS))
@example((BROKK_170, BROKK_170.column("q_min") + 0.02, -TO_THE_STOPS))
def test_plant_step__is_its_equations(case):
    machine, q, u = case
    states, _ = record(machine, q, u)
    goal = slow_plant(machine, q, u)
    for name in "qvsz":
        found = getattr(states, name)[-1]
        np.testing.assert_allclose(found, [x[name] for x in goal], atol=1e-12, err_msg=name)


@given(driven_machines())
def test_lever_arm__is_the_derivative_of_the_cylinder_length(case):
    machine, q, _ = case
    base, rod, angle = (actuator.cylinder_column(machine, x) for x in ("base", "rod", "angle"))
    length = lambda x: np.sqrt((base - rod * np.cos(x)) ** 2 + (rod * np.sin(x)) ** 2)  # noqa: E731
    slope = (length(angle + q + 1e-6) - length(angle + q - 1e-6)) / 2e-6
    np.testing.assert_allclose(lever_arm(machine, q), np.where(base > 0, slope, rod), atol=1e-8)


# --- histories ------------------------------------------------------------------------------------


def test_append_sample__and_append_command_by_hand():
    h = actuator.initial_history(np.array([0.5, -1.0]), 3)
    np.testing.assert_array_equal(h[1], [[-1, -1, -1], [0, 0, 0], [0, 0, 0]])
    h.setflags(write=False)
    sent = actuator.append_command(h, [0.1, 0.2])
    np.testing.assert_array_equal(sent[0], [[0.5, 0.5, 0.5], [0, 0, 0], [0, 0, 0.1]])
    np.testing.assert_array_equal(sent[1], [[-1, -1, -1], [0, 0, 0], [0, 0, 0.2]])
    seen = actuator.append_sample(h, [0.1, 0.2], np.array([0.6, -0.9]), 2, 0.05)
    np.testing.assert_allclose(seen[0], [[0.5, 0.5, 0.6], [0, 0, 2], [0, 0, 0.1]])
    np.testing.assert_allclose(seen[1], [[-1, -1, -0.9], [0, 0, 2], [0, 0, 0.2]])
    sent = actuator.append_command(seen, [0.3, 0.4])
    np.testing.assert_allclose(sent[0], [[0.5, 0.5, 0.6], [0, 0, 2], [0, 0.1, 0.3]])


@given(st.integers(2, 8), npst.arrays(np.float64, (3, 12), elements=reals(-3, 3)))
def test_estimate_velocity__is_the_least_squares_slope_and_forgets_what_is_older(samples, q):
    q.setflags(write=False)
    velocity = actuator.estimate_velocity(q, samples, 0.05)
    time = 0.05 * np.arange(samples)
    fitted = [np.polyfit(time, row[-samples:], 1)[0] for row in q]
    np.testing.assert_allclose(velocity, fitted, atol=1e-8)
    assert actuator.estimate_velocity(q.astype(np.float32), samples, 0.05).dtype == np.float32
    assert actuator.estimate_velocity([0, 3, 6, 9], 4, 0.07) == pytest.approx(3 / 0.07)  # integers


# --- nets -----------------------------------------------------------------------------------------


def slow_forward(net: ActuatorNet, history: np.ndarray) -> np.ndarray:
    """Velocities (n,) of one history (n, 3, H): the equations, one joint at a time."""
    result = []
    for j, (q, q_dot, u) in enumerate(history.astype(float)):
        w1, b1, w2, b2, w3, b3 = (w[j].astype(float) for w in net.weights)
        x = (np.concatenate([q, q_dot, u]) - net.input_mean[j]) / net.input_scale[j]
        hidden = np.maximum(np.maximum(x @ w1 + b1, 0) @ w2 + b2, 0)
        y = expit(hidden @ w3 + b3)[0]
        result.append(net.output_low[j] + y * (net.output_high[j] - net.output_low[j]))
    return np.array(result)


@pytest.mark.parametrize("leading", [(), (1,), (7,), (2, 3)])
def test_predict__is_a_loop_in_double_precision(leading):
    net = random_net(len(leading), history=5)
    rng = np.random.default_rng(9)
    history = rng.uniform(-1, 1, (*leading, 3, 3, net.history)).astype(np.float32)
    history.setflags(write=False)
    got = net.predict(history)
    assert got.shape == (*leading, 3) and got.dtype == np.float32
    for index in np.ndindex(*leading):
        np.testing.assert_allclose(got[index], slow_forward(net, history[index]), atol=2e-5)
    assert np.all((net.output_low <= got) & (got <= net.output_high))
    assert net != replace(net) and hash(net)  # caches know nets by identity


def test_nets_as_a_plant__move_driven_joints_by_velocity_times_dt():
    """A loop over joints and ticks: q + dt net(history with the command), then the new sample."""
    net = random_net(3, n=4, history=5)
    state, angles, commands = net.reset(BROKK_170, MIDDLE), [MIDDLE] * 5, [np.zeros(5)] * 5
    rng = np.random.default_rng(4)
    velocities = [np.zeros(5)] * 5
    for _ in range(8):
        u = rng.uniform(-1, 1, 5)
        commands = [*commands[1:], u]
        rows = np.stack([angles[-5:], velocities[-5:], commands[-5:]])[..., DRIVEN]
        q = angles[-1].copy()
        q[DRIVEN] += 0.05 * slow_forward(net, rows.transpose(2, 0, 1))
        angles.append(q)
        velocities.append(np.polyfit(0.05 * np.arange(4), angles[-4:], 1)[0])
        for array in state:
            array.setflags(write=False)
        state = net.step(BROKK_170, state, u)
        np.testing.assert_allclose(state.q, q, atol=1e-5)
    assert state.q[1] == 0.5 and np.abs(state.q - MIDDLE)[DRIVEN].max() > 0.01
    assert state.q.dtype == np.float64 and state.history.dtype == np.float32
    with pytest.raises(ValueError, match="nets: expected those of driven joints"):
        random_net(3, n=5).reset(BROKK_170, MIDDLE)


def test_nets_as_a_plant__stop_joints_at_the_ends_of_their_range():
    net = random_net(3, n=4, history=5)
    up = replace(net, output_low=net.output_high)  # the same velocity, whatever the inputs
    down = replace(net, output_high=net.output_low)
    for one, limit, sign in ((up, "q_max", -1), (down, "q_min", 1)):
        near = BROKK_170.column(limit) + sign * 1e-4
        after = one.step(BROKK_170, one.reset(BROKK_170, near), np.zeros(5))
        np.testing.assert_array_equal(after.q[DRIVEN], BROKK_170.column(limit)[DRIVEN])
        assert after.q[1] == near[1]
