"""No function writes into what it is given: every array goes in read-only, and an in-place write raises."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from helpers_machines import small_net

from brokk_min import env, jacobian, kinematics, machine, observation
from brokk_min.can import canopen
from brokk_min.can import safety_gate as gate
from brokk_min.evaluation import metrics, sequences
from brokk_min.machine import BROKK_170

M, RNG = BROKK_170, np.random.default_rng(0)


def fixed(array: Any) -> Any:
    """The array, never to be written to."""
    array = np.array(array)
    array.setflags(write=False)
    return array


Q = fixed(RNG.uniform(M.column("q_min"), M.column("q_max"), (4, 5)))
RATE, V = fixed(RNG.uniform(-0.2, 0.2, (4, 5))), fixed(RNG.uniform(-0.3, 0.3, (4, 3)))
J = fixed(kinematics.jacobian(kinematics.forward_kinematics(M, Q))[..., M.driven])
U = fixed(machine.limit_command(M, RNG.uniform(-1, 1, (4, 5))))
HISTORY = fixed(RNG.uniform(-0.1, 0.1, (4, 5, 3, 13)).astype(np.float32))
LAG, V32, Q32 = (
    fixed(np.zeros((4, 3), np.float32)),
    fixed(V.astype(np.float32)),
    fixed(Q.astype(np.float32)),
)
SEEN = fixed(observation.observe(M, HISTORY, V32, LAG))
GOALS = fixed(np.repeat(V[None], 30, axis=0))
BASELINE = jacobian.JacobianController(
    M, fixed(jacobian.join_gains(M, dict.fromkeys(jacobian.GAINS, 0.01))), 0.1, 0.5
)
NETS = small_net(M, RNG)
INPUTS = gate.GateInputs(
    m=fixed(np.zeros((4, 5))),
    counts=fixed(np.zeros((4, 5), int)),
    frames=fixed(np.ones((4, 5), int)),
    beat=fixed(np.zeros((4, 6))),
    nmt=fixed(np.full((4, 6), 5)),
    **{name: fixed(np.zeros(4, bool)) for name in ("enable", "centred", "alive", "stop", "error")},
)
GATE, NOW = gate.GateState(*map(fixed, gate.gate_start(M, (4,)))), fixed(np.zeros(4))

CALLS: dict[str, Callable[[], Any]] = {
    "limit_command": lambda: machine.limit_command(M, U),
    "encode_pwm": lambda: machine.encode_pwm(U),
    "decode_pwm": lambda: machine.decode_pwm(fixed([0, 80, 175])),
    "read_encoder": lambda: machine.read_encoder(M, Q),
    "estimate_velocity": lambda: machine.estimate_velocity(Q, 4, 0.05),
    "frames": lambda: kinematics.frames(M, Q),
    "tool_position": lambda: kinematics.tool_position(kinematics.forward_kinematics(M, Q)),
    "jacobian": lambda: kinematics.jacobian(kinematics.forward_kinematics(M, Q))[..., M.driven],
    "tool_jacobian": lambda: kinematics.tool_jacobian(M, Q),
    "tool_state": lambda: kinematics.tool_state(M, Q, RATE),
    "tool_velocity": lambda: kinematics.tool_velocity(kinematics.forward_kinematics(M, Q), RATE),
    "joint_rates": lambda: kinematics.joint_rates(M, Q, V),
    "damped_rates": lambda: kinematics.damped_rates(M, J, V),
    "lowest_point": lambda: kinematics.lowest_point(kinematics.forward_kinematics(M, Q)),
    "dls": lambda: jacobian.dls(J, fixed(np.ones((4, 4))), fixed(np.full(4, 0.1))),
    "limit_gradient": lambda: jacobian.limit_gradient(M, Q),
    "limit_weights": lambda: jacobian.limit_weights(M, Q, RATE),
    "manipulability": lambda: jacobian.manipulability(J),
    "nakamura_damping": lambda: jacobian.nakamura_damping(fixed([0.1, 0.9]), 0.5, 0.1),
    "lengths": lambda: machine.lengths(V),
    "valve_opening": lambda: machine.valve_opening(U, 0.07),
    "baseline": lambda: BASELINE(SEEN, jacobian.Memory(*map(fixed, BASELINE.start(4)))),
    "observe": lambda: observation.observe(
        M, HISTORY, V32, LAG, fixed(np.full((4, 108), 0.01, np.float32))
    ),
    "measured": lambda: observation.measured(M, SEEN),
    "integrate_error": lambda: observation.integrate_error(M, V32, V32, LAG),
    "push_measured": lambda: observation.push_measured(M, HISTORY, U, Q32, V32, LAG),
    "action_to_pwm": lambda: observation.action_to_pwm(M, fixed(np.ones((4, 4), np.float32))),
    "reward": lambda: env.reward(V, fixed(np.zeros((4, 3)))),
    "terminated": lambda: env.terminated(M, fixed([-0.1, 0.1])),
    "initial_state": lambda: env.initial_state(M, Q, V32, plant=True),
    "encoder_counts": lambda: canopen.encoder_counts(M, fixed(np.arange(20).reshape(4, 5))),
    "encoder_raw": lambda: canopen.encoder_raw(M, fixed(np.arange(20).reshape(4, 5))),
    "checksum": lambda: canopen.checksum(fixed(np.arange(7))),
    "valve_frame": lambda: canopen.valve_frame(fixed(np.arange(20).reshape(4, 5)), 1, 1),
    "line_distance": lambda: metrics.line_distance(GOALS, GOALS, V),
    "ticks_since_change": lambda: metrics.ticks_since_change(M, GOALS),
    "row_mean": lambda: metrics.row_mean(V),
    "interval": lambda: metrics.interval(fixed([1.0, np.nan, 3.0])),
    "feasible": lambda: sequences.feasible(M, Q, GOALS),
    "start_kinds": lambda: sequences.start_kinds(M, Q),
    "gate": lambda: gate.gate(M, GATE, INPUTS, NOW),
    "nets": lambda: NETS.predict(HISTORY[:, M.driven]),
}


@pytest.mark.parametrize("name", list(CALLS))
def test_what_goes_in_is_not_written_to(name: str) -> None:
    CALLS[name]()


def test_the_table_has_every_function_of_machine_and_kinematics() -> None:
    for module in (machine, kinematics):
        mine = [f for f in vars(module).values() if getattr(f, "__module__", "") == module.__name__]
        names = {
            f.__name__ for f in mine if inspect.isfunction(f) and not f.__name__.startswith("_")
        }
        assert len(names) >= 5 and names <= {*CALLS, "as_floats"}, names - set(CALLS)
