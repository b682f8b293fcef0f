"""A planner with the plant's equations and its exact state: the error that it leaves.

Model-predictive control on the analytic plant. Like every other controller it gets no goal ahead
of time: it plans as if the present goal lasted. It is one heuristic, which other controllers beat
from some starts, so its error bounds nothing.

    python -m benchmarks.perfect_model [STARTS]
"""

import sys
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from brokk_min.actuator import PLANT, PlantState, cylinder_speeds, lever_arm
from brokk_min.beyond.interface import REST_AFTER
from brokk_min.evaluation.metrics import evaluate, means
from brokk_min.evaluation.sequences import axis_sequences, evaluation_starts
from brokk_min.jacobian import dls
from brokk_min.kinematics import forward_kinematics, jacobian, tool_velocity
from brokk_min.machine import (
    BROKK_170,
    PWM_MAX,
    Array,
    Machine,
    Measured,
    by_direction,
    limit_command,
    valve_command,
    valve_opening,
)

BLOCKS = (1, 1, 2, 4, 6)  # ticks between changes of a plan; their sum is the horizon (assumed)
STEPS = (1.0, 0.5, 0.2)  # fractions of a Gauss-Newton step that are tried (assumed)
PROBE = 0.03  # valve opening of the finite differences (assumed)
SOFT = 0.01  # m/s: smaller errors weigh as squares, larger ones by their size (assumed)
ROUNDING = 5  # ticks over which roundings to whole counts are compared (assumed)
OPEN = 0.04  # valve opening by which openings near zero alternate, so that valves stay open (tuned)


class Plan(NamedTuple):
    """State of the controller: the plant as it is, and the plan."""

    plant: PlantState
    opening: Array  # valve openings beyond the dead zone, (num, horizon, n_driven)
    tick: int
    rest_ticks: NDArray[np.int64]  # for which the goal has been zero, (num,)


@dataclass(frozen=True)
class PerfectModel:
    """The planner as a `Controller`: Gauss-Newton on a plan of valve openings at every tick.

    It simulates the plant under its own commands, so its state is exact; of the measurements it
    reads the goal alone. While the tool rests, it closes the valves.
    """

    machine: Machine
    poses: Array  # start angles [rad] (k, n); a batch is these, repeated

    def start(self, num: int) -> Plan:
        """The plant at rest at `poses`, valves closed."""
        q = np.tile(self.poses, (num // len(self.poses), 1))
        closed = np.zeros((num, sum(BLOCKS), len(self.machine.driven)))
        return Plan(PLANT.reset(self.machine, q), closed, 0, np.zeros(num, np.int64))

    def __call__(self, measured: Measured, plan: Plan) -> tuple[Array, Plan]:
        """Commands u (num, n), and the plan."""
        goal = measured.v_goal.astype(float)
        shifted = np.concatenate([plan.opening[:, 1:], plan.opening[:, -1:]], axis=1)
        opening = self.improve(plan.plant, shifted, goal, plan.tick)
        u = self.quantise(plan.plant, opening, goal, plan.tick)
        rest_ticks = np.where(goal.any(axis=-1), 0, plan.rest_ticks + 1)
        u = np.where((rest_ticks > REST_AFTER * self.machine.rate)[:, None], 0.0, u)
        plant = PLANT.step(self.machine, plan.plant, u)
        return u, Plan(plant, opening, plan.tick + 1, rest_ticks)

    def commands(self, opening: Array, tick: int) -> Array:
        """Commands (..., T, n) of planned openings (..., T, n_driven) from a tick on."""
        m = self.machine
        sign = (-1.0) ** (tick + np.arange(opening.shape[-2]))[:, None]
        near_zero = np.maximum(0, 1 - np.abs(opening) / (2 * OPEN))
        u = np.zeros((*opening.shape[:-1], m.n))
        u[..., m.driven] = valve_command(opening + OPEN * sign * near_zero, m.dead_zones[m.driven])
        return u

    def errors(self, plant: PlantState, u: Array, goal: Array) -> Array:
        """Velocity errors [m/s] (num, plans, T, 3) under commands (num, plans, T, n)."""
        m = self.machine
        num, plans, ticks, n = u.shape
        state = PlantState(*(np.repeat(array, plans, axis=0) for array in plant))
        angles = [state.q]
        for t in range(ticks):
            state = PLANT.step(m, state, u[:, :, t].reshape(num * plans, n))
            angles.append(state.q)
        q = np.stack(angles, axis=1)  # (num * plans, T + 1, n)
        q_dot = np.diff(q, axis=1) * m.rate
        frames = forward_kinematics(m, q[:, 1:].astype(np.float32))
        v = tool_velocity(frames, q_dot.astype(np.float32)).reshape(num, plans, ticks, 3)
        return goal[:, None, None] - v

    def improve(self, plant: PlantState, opening: Array, goal: Array, tick: int) -> Array:
        """The best of a plan (num, horizon, n_driven), Gauss-Newton steps, and steady openings."""
        m = self.machine
        step = self.gauss_newton_step(plant, opening, goal, tick)
        steady = steady_opening(m, plant.q, goal)[:, None]
        tried = [opening, *(opening + fraction * step for fraction in STEPS)]
        tried.append(np.broadcast_to(steady, opening.shape))
        plans = np.clip(np.stack(tried, axis=1), *opening_limits(m))  # (num, plans, horizon, ...)
        error = np.linalg.norm(self.errors(plant, self.commands(plans, tick), goal), axis=-1)
        size = np.square(plans).mean(axis=(-1, -2))
        cost = error.mean(axis=-1) + 1e-4 * size  # of equal plans the smaller
        return np.asarray(plans[np.arange(len(plans)), cost.argmin(axis=1)])

    def gauss_newton_step(self, plant: PlantState, opening: Array, goal: Array, tick: int) -> Array:
        """Change of a plan (num, horizon, n_driven) that lessens its velocity errors most.

        A parameter is the opening of one joint from the start of one block to the horizon.
        """
        num, horizon, n = opening.shape
        blocks = len(BLOCKS)
        from_block = np.repeat(np.triu(np.ones((blocks, blocks))), BLOCKS, axis=1)
        basis = from_block[:, None, :, None] * np.eye(n)[:, None]  # (blocks, n, horizon, n)
        basis = basis.reshape(blocks * n, horizon, n)  # (parameters, horizon, n_driven)
        plans = opening[:, None] + PROBE * np.concatenate([np.zeros((1, horizon, n)), basis])
        u = self.commands(np.clip(plans, *opening_limits(self.machine)), tick)
        error = self.errors(plant, u, goal)  # (num, 1 + parameters, horizon, 3)
        size = np.linalg.norm(error[:, :1], axis=-1, keepdims=True)
        weight = 1 / np.sqrt(size + SOFT)
        r = (error[:, 0] * weight[:, 0]).reshape(num, -1)  # residuals
        J_t = ((error[:, 1:] - error[:, :1]) * weight).reshape(num, len(basis), -1) / PROBE
        A = J_t @ J_t.swapaxes(1, 2) + 1e-3 * np.eye(len(basis))  # J^T J + regularisation
        x = np.linalg.solve(A, -(J_t @ r[..., None]))[..., 0]  # A x = -J^T r
        return np.asarray(np.einsum("rp,ptj->rtj", x, basis))  # run, parameter, tick, joint

    def quantise(self, plant: PlantState, opening: Array, goal: Array, tick: int) -> Array:
        """First commands (num, n) of a plan in whole counts, by the best of all roundings."""
        m = self.machine
        up = np.array(list(product((False, True), repeat=len(m.driven))))  # (2^n_driven, n_driven)
        u = self.commands(opening[:, :ROUNDING], tick)
        u = np.repeat(u[:, None], len(up), axis=1)  # (num, 2^n_driven, ROUNDING, n)
        counts = u[:, :, 0, m.driven] * PWM_MAX
        u[:, :, 0, m.driven] = np.where(up, np.ceil(counts), np.floor(counts)) / PWM_MAX
        u[:, :, 0] = limit_command(m, u[:, :, 0])
        cost = np.linalg.norm(self.errors(plant, u, goal), axis=-1).mean(axis=-1)
        return np.asarray(u[np.arange(len(u)), cost.argmin(axis=1), 0])


def opening_limits(machine: Machine) -> tuple[Array, Array]:
    """Openings of the driven joints' valves at the command limit, down and up (n_driven,)."""
    limit = np.full(len(machine.driven), machine.pwm_limit / PWM_MAX)
    zones = machine.dead_zones[machine.driven]
    return valve_opening(-limit, zones), valve_opening(limit, zones)


def steady_opening(machine: Machine, q: Array, goal: Array) -> Array:
    """Openings (num, n_driven) that hold the tool velocity `goal` [m/s] at angles `q` [rad]."""
    driven = machine.driven
    J = jacobian(forward_kinematics(machine, q))[..., driven]
    q_dot = (dls(J, np.ones(len(driven)), 1e-3) @ goal[..., None])[..., 0]
    v = q_dot * lever_arm(machine, q)[:, driven]  # of the cylinders [m/s]
    return np.asarray(v / by_direction(v, cylinder_speeds(machine)[driven]))


def main() -> None:
    """Print the error of the planner along x, y and z, from the first starts, by default 16."""
    machine = BROKK_170
    starts = evaluation_starts(machine, int(sys.argv[1]) if len(sys.argv) > 1 else 16, [], 0)
    planner = {"perfect model": PerfectModel(machine, starts)}
    runs, _ = evaluate(machine, planner, axis_sequences(machine), starts, 0)
    for sequence, row in means(runs)["perfect model"].items():
        print(f"{sequence:4} velocity error {row['velocity_error_mean']['mean']:.4f} m/s")


if __name__ == "__main__":
    main()
