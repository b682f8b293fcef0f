"""Preliminary tests and the sim-to-real gap, by hand, on the plant, and on any machine."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers_machines import coarse, small_net

from benchmarks.one_process import Recorder
from brokk_min.actuator import PLANT
from brokk_min.evaluation import preliminary
from brokk_min.kinematics import forward_kinematics, tool_position
from brokk_min.machine import BROKK_170
from examples.mini_excavator import MINI_EXCAVATOR

LOW, HIGH = BROKK_170.column("q_min"), BROKK_170.column("q_max")
COARSE = coarse(BROKK_170, 0.025)  # two Euler steps a tick: fast


def test_preliminary_tests__move_the_last_driven_joint_at_two_levels():
    plant = Recorder()
    sweeps, coupling, steps = preliminary.preliminary_tests(COARSE, plant).values()
    u, u_steps = np.array(plant.u[:800]), np.array(plant.u[800:])
    counts = [[0, 0, 0, 0, c] for c in (50, 80, -80, -50)] + [[-80, 0, -80, 80, 80]]
    assert (u == u[0]).all()
    np.testing.assert_allclose(u[0] * 127, counts)
    q = plant.q[0]  # no valve is open yet
    np.testing.assert_array_equal(q[:, 4], [LOW[4], LOW[4], HIGH[4], HIGH[4], LOW[4]])
    np.testing.assert_allclose(q[:, :4], np.tile(((LOW + HIGH) / 2)[:4], (5, 1)))
    assert list(sweeps) == ["u = 50", "u = 80", "u = 175", "u = 205"]
    assert coupling["alone"] is sweeps["u = 80"]
    np.testing.assert_allclose(steps["idle"][0], 0.05 * (np.arange(60) - 29.5))
    before_and_after = [[0, (80 / 127 + 0.07) / 2], [80 / 127] * 2]  # from half the opening, too
    np.testing.assert_allclose(u_steps[[0, 30], :, 4], before_and_after)


def test_preliminary_tests__of_the_plant_have_the_papers_response_times():
    """And the sweeps go from stop to stop at the paper's speeds."""
    sweeps, coupling, steps = preliminary.preliminary_tests(BROKK_170, PLANT).values()
    for command, end, peak in (("u = 80", HIGH, 0.24), ("u = 175", LOW, -0.45)):
        q, q_dot = sweeps[command]
        assert q[-1] == end[4] and q_dot[-1] != 0
        assert np.all(q_dot * peak >= 0)
        assert np.abs(q_dot).max() == pytest.approx(abs(peak), rel=0.04)
        np.testing.assert_allclose(np.diff(q) * 20, q_dot[1:], atol=1e-9)
    times = {n: preliminary.response_time(*of) for n, of in steps.items()}
    assert times["idle"] == pytest.approx(0.40, abs=0.01)
    assert times["moving"] == pytest.approx(0.105, abs=0.01)
    alone, together = (q_dot[:40] for _, q_dot in coupling.values())
    np.testing.assert_allclose(together, alone, atol=0.002)  # "marginal and neglectable"


@pytest.mark.parametrize("machine", [COARSE, replace(COARSE, q_start=())])
def test_sim_to_real__is_between_tools_where_the_arms_end(machine):
    """Nets that stand still: the gap is what the machine moved, from its own start pose."""
    plant = Recorder()
    still = SimpleNamespace(reset=lambda _, q: SimpleNamespace(q=q), step=lambda _, state, u: state)
    gap = preliminary.sim_to_real(machine, {"machine": plant, "nets": still}, 7)
    u = np.array(plant.u)
    assert u.shape == (600, 20, 5) and not u[..., 1].any()
    assert np.all((np.abs(u) > 0.07).sum(axis=-1).max(axis=0) > 1)  # several joints at once
    start = np.tile(machine.q_start or (LOW + HIGH) / 2, (20, 1))
    q = np.array([start, *plant.q])
    p = tool_position(forward_kinematics(BROKK_170, q))
    np.testing.assert_allclose(gap.q, q[0] - q[1:], atol=1e-12)
    np.testing.assert_allclose(gap.q_dot, -20 * np.diff(q, axis=0), atol=1e-12)
    np.testing.assert_allclose(gap.p_tool, p[0] - p[1:], atol=1e-12)
    np.testing.assert_allclose(gap.v_tool, -20 * np.diff(p, axis=0), atol=1e-12)


def test_tests_and_gap__of_another_machine():
    machine = coarse(MINI_EXCAVATOR, 0.02)  # two Euler steps a tick: fast
    net = small_net(machine, np.random.default_rng(0))
    tests = preliminary.preliminary_tests(machine, net)
    assert len(tests["range and direction"]) == 4
    gap = preliminary.sim_to_real(machine, {"machine": PLANT, "nets": net}, 0)
    assert gap.q.shape == (30 * machine.rate, 20, machine.n)
    assert not gap.q[..., machine.locked].any()
