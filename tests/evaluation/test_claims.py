"""Verdicts follow from the numbers: made-up runs for which they are known."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from helpers_machines import obedient_net

from brokk_min.env import TaskConfig
from brokk_min.evaluation import baselines, claims
from brokk_min.evaluation.claims import Claim
from brokk_min.evaluation.rollout import Trace, rollout
from brokk_min.jacobian import JacobianController
from brokk_min.machine import BROKK_170

HIGH, LOW = baselines.PAPER_BASELINES  # damping
WITH_FEEDFORWARD = baselines.WITH_FEEDFORWARD
POSE = np.array(BROKK_170.q_start)


def verdicts(result):
    return [claim.holds for claim in result]


def runs_with(key, sequence="x", **values):
    """Six starts with a figure around a value by controller."""
    names = {"rl": ["rl"], "high": [HIGH], "low": [LOW], "stronger": WITH_FEEDFORWARD}
    rows = []
    for name, value in values.items():
        for controller, i in product(names[name], range(6)):
            row = {"controller": controller, "sequence": sequence, "start": i, "kind": "workspace"}
            rows.append(row | {key: value + 0.001 * (i % 3)})
    return rows


def trace_of(q, v, q_dot, ticks):
    zero = np.zeros((ticks, len(q), 5))
    v_tool = zero[..., :3] + v
    return Trace(zero + q, zero + q_dot, zero, zero, zero[..., :3], v_tool, zero[..., 0])


def preliminary_numbers(**change):
    """Numbers of a machine that behaves as the paper's and of nets that behave as the machine."""
    times = {"q5": {"idle": {"up": 0.4, "down": 0.4}, "moving": {"up": 0.1, "down": 0.1}}}
    peaks = {"u = 50": 0.1, "u = 80": 0.24, "u = 175": 0.45, "u = 205": 0.3}
    gap = {
        "tool": {"position_error_mean": 0.03},
        "tool_position_error_mean_of_runs": {"median": 0.02},
    }
    return {
        "joint": "q5",
        "sweep": {u: {"machine_peak": v, "nets_peak": v} for u, v in peaks.items()},
        "coupling_rms": {"machine": 0.0, "nets": 0.001},
        "response_time": {"machine": times, "nets": times},
        "sim_to_real": gap,
    } | change


GOOD = preliminary_numbers()
NETS_EVEN = GOOD["sweep"] | {"u = 175": {"machine_peak": 0.45, "nets_peak": 0.2}}
FAR_RUNS = GOOD["sim_to_real"] | {"tool_position_error_mean_of_runs": {"median": 0.06}}
FAR_FIGURE = GOOD["sim_to_real"] | {"tool": {"position_error_mean": 0.06}}


def nets_from_idle(seconds):
    times = {"q5": {"idle": {"up": seconds, "down": 0.4}, "moving": {"up": 0.1, "down": 0.1}}}
    return GOOD["response_time"] | {"nets": times}


@pytest.mark.parametrize(
    ("change", "holds"),
    [
        ({}, [True, True, True, True]),
        ({"sweep": NETS_EVEN}, [False, True, True, True]),
        ({"response_time": nets_from_idle(0.15)}, [True, False, True, True]),
        ({"response_time": nets_from_idle(None)}, [True, None, True, True]),
        ({"coupling_rms": {"machine": 0.0, "nets": 0.02}}, [True, True, False, True]),
        ({"sim_to_real": FAR_RUNS}, [True, True, True, False]),
        ({"sim_to_real": FAR_FIGURE}, [True, True, True, False]),
    ],
)
def test_net_claims__hold_where_machine_and_nets_behave_as_the_papers(change, holds):
    result = claims.net_claims(preliminary_numbers(**change))
    assert verdicts(result) == holds
    assert [claim.to_json()["figure"] for claim in result] == ["Fig. 2"] * 3 + ["Fig. 5"]
    if holds[1] is None:
        assert "nets, idle none; nets, moving 0.1" in result[1].to_json()["measured"]


@pytest.mark.parametrize(("hours", "holds"), [(0.1, False), (2.0, True), (4.0, True), (6.0, False)])
def test_training_claim__allows_a_factor_of_two(hours, holds):
    claim = claims.training_claim(hours * 3600, 8_000_000)
    assert claim.holds is holds
    assert f"8,000,000 steps here {hours:g} [h]" in claim.to_json()["measured"]


@pytest.mark.parametrize(
    ("rl", "high", "low", "holds"),
    [
        (0.02, 0.20, 0.30, [True, True]),  # as the paper says
        (0.02, 0.03, 0.03, [True, False]),  # baselines stay still too
        (0.09, 0.20, 0.30, [False, True]),
        (0.09, 0.06, 0.30, [False, False]),  # one baseline drifts less than RL
    ],
)
def test_drift_claim__is_of_all_baselines(rl, high, low, holds):
    runs = runs_with("off_axis_drift_max", rl=rl, high=high, low=low)
    result = [claims.still_claim(runs, "rl"), claims.drift_claim(runs, "rl", (HIGH, LOW))]
    assert verdicts(result) == holds
    assert result[0].numbers["rl"]["mean"] == pytest.approx(rl + 0.001)
    assert result[1].numbers[f"{HIGH} less rl"]["mean"] == pytest.approx(high - rl)


@pytest.mark.parametrize(
    ("x", "z", "drift", "holds"),
    [
        (0.01, 0.01, 0.1, [True, True, True]),
        (0.01, 0.01, 0.3, [True, False, True]),  # drifts more along z
        (0.03, 0.01, 0.1, [False, True, True]),  # worse along x, better along y and z
        (0.01, 0.03, 0.1, [False, False, True]),
        (0.04, 0.03, 0.1, [False, False, False]),
    ],
)
def test_less_claim__is_of_each_sequence_and_figure(x, z, drift, holds):
    runs = []
    for sequence, rl in {"x": x, "y": 0.01, "z": z}.items():
        low = 0.02 - 0.005 * (rl > 0.02)
        errors = runs_with("velocity_error_mean", sequence, rl=rl, high=0.02, low=low)
        drifts = runs_with("off_axis_drift_max", sequence, rl=drift, high=0.2, low=0.2)
        runs += [a | b for a, b in zip(errors, drifts, strict=True)]
    names = (HIGH, LOW)
    both = ("velocity_error_mean", "off_axis_drift_max")
    result = [
        claims.less_claim("tracking", runs, "rl", names, "xyz"),
        claims.less_claim("along z", runs, "rl", names, "z", both),
        claims.less_claim("outperforms", runs, "rl", names, ["all"]),
    ]
    assert verdicts(result) == holds
    less = result[1].numbers["drift z, less jacobian_pid_k0.1"]["mean"]
    assert less == pytest.approx(drift - 0.2)


@pytest.mark.parametrize(
    ("down", "holds"), [(0.9, False), (0.5, True), ((0.9, 0.9, 0.9, 0.1), False)]
)
def test_direction_claim__compares_both_directions(down, holds):
    """Joints follow 90 % of the desired velocity forwards, and `down` of it backwards.

    One run that goes back badly is not certain to be more than chance.
    """
    pid = baselines.baselines(BROKK_170, obedient_net(BROKK_170))[HIGH]
    goals = np.repeat([[0.2, 0.0, 0.0], [-0.2, 0.0, 0.0]], 20, axis=0)
    goals = np.repeat(goals[:, None], 4, axis=1)
    trace = trace_of(POSE + 0.02 * np.arange(4)[:, None], goals, np.zeros(5), 40)
    fraction = np.where(goals[..., :1] > 0, 0.9, np.reshape(down, (-1, 1)))
    driven = BROKK_170.driven
    trace.q_measured[:] = trace.q
    desired = np.zeros((4, 4))
    for tick, goal in enumerate(goals):  # weights depend on the direction of motion
        v_tool = trace.v_tool[tick - 1] if tick else np.zeros((4, 3))
        desired = pid.desired_velocities(goal, v_tool, trace.q[tick], desired)
        trace.q_dot[tick][:, driven] = fraction[tick] * desired
    claim = claims.direction_claim(BROKK_170, pid, trace, goals)
    assert claim.holds is holds
    means = {round(n["mean"], 2) for n in claim.numbers.values() if n["mean"] is not None}
    assert means == {0.1, round(1 - float(np.mean(down)), 2)}
    first = Trace(*(array[:, :1] for array in trace))
    assert claims.direction_claim(BROKK_170, pid, first, goals[:, :1]).holds is None


def test_desired_velocities__are_what_the_pid_wanted_in_a_drive():
    wanted = []

    class Watched(JacobianController):
        def desired_velocities(self, *inputs):
            wanted.append(super().desired_velocities(*inputs))
            return wanted[-1]

    machine = replace(BROKK_170, encoder_bits=30, velocity_samples=2)  # sensors without error
    net = obedient_net(machine)
    pid = baselines.baselines(machine, net)["jacobian_pid_ff_integral"]
    pid = Watched(**vars(pid))
    goals = np.repeat([[[0.2, 0.0, 0.0]], [[0.0, 0.1, -0.1]]], 30, axis=0)
    rng, exact = np.random.default_rng(0), TaskConfig(noise=0.0)
    trace = rollout(machine, pid, POSE[None], goals, exact, rng, net)
    found = claims.desired_velocities(machine, pid, trace, goals)
    off = np.abs(found - wanted[: len(goals)])
    assert off.max() < 1e-5


def test_task_claims__are_in_the_papers_order_and_of_a_stronger_baseline_too():
    runs = []
    for sequence in "xyz":
        drift = runs_with("off_axis_drift_max", sequence, rl=0.02, high=0.2, low=0.3, stronger=0.03)
        error = runs_with("velocity_error_mean", sequence, rl=0.3, high=0.4, low=0.4, stronger=0.2)
        runs += [a | b for a, b in zip(drift, error, strict=True)]
    pids = baselines.baselines(BROKK_170, obedient_net(BROKK_170))
    trace = trace_of(np.tile(POSE, (2, 1)), np.zeros(3), np.zeros(5), 20)
    singular = [Claim("slowed", {}, None), Claim("jerky", {}, True)]
    along_x = dict.fromkeys(pids, trace)
    result = claims.task_claims(
        BROKK_170, "rl", pids, runs, along_x, np.zeros((20, 2, 3)), singular
    )
    expected = ["still", "drift", "direction", "slowed", "jerky", "tracking", "along z"]
    assert [claim.name for claim in result] == [*expected, "outperforms"]
    assert set(expected) < set(claims.TEXTS)
    assert verdicts(result) == [True, True, None, None, True, True, True, True]
    stronger = [claim.stronger for claim in result if claim.stronger]
    assert verdicts(stronger) == [False, None, False, False, False]
    assert list(stronger[-1].numbers) == [f"error all, less {name}" for name in WITH_FEEDFORWARD]


def test_speed_fraction__is_of_goals_that_last_near_singularities():
    """Stretched and ordinary arms, and a goal that ends early; the first 0.6 s do not count."""
    stretched = np.array([0.3, 0.5, 0.1, np.pi, 3 * np.pi / 4])
    goals = np.zeros((30, 4, 3))
    goals[..., 0] = [0.2, 0.2, 0.4, 0.2]
    goals[5:, 3] = 0.0
    q = np.stack([stretched, POSE, stretched, stretched])
    trace = trace_of(q, np.array([0.1, 0.3, 0.0]), np.zeros(5), 30)
    trace.v_tool[:12] = 9.0
    fraction = claims.speed_fraction(BROKK_170, 3.9, trace, goals)
    assert fraction[[0, 2]] == pytest.approx([0.5, 0.25]) and np.isnan(fraction[[1, 3]]).all()


@pytest.mark.parametrize(
    ("speed", "jerk", "holds"),
    [
        ((0.9, 0.5, 0.7), (3.5, 4.0, 4.5), [True, True, True]),
        ((0.9, 0.7, 0.5), (2.0, 9.0, 4.0), [False, False, True]),
        ((0.6, 0.5, 0.7), (2.0, 4.0, 9.0), [True, True, False]),  # RL is slowed
        ((0.9, 0.5, 0.7), (4.5, 4.0, 4.6), [True, True, False]),  # RL jerks
    ],
)
def test_singular_claims__compare_speed_and_jerk(speed, jerk, holds):
    spread = 0.01 * np.array([0, 1, 2, 0, 1, 2])
    speeds = {c: s + spread for c, s in zip(("rl", HIGH, LOW), speed, strict=True)}
    rl, high, low = jerk
    runs = runs_with("jerk_rms", rl=rl, high=high, low=low)
    assert verdicts(claims.singular_claims("rl", runs, speeds)) == holds
