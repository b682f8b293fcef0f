"""A bound: the error that a controller leaves which has the plant's equations and its exact state.

Model-predictive control on the analytic plant. Like every other controller it gets no goal ahead
of time: it plans as if the present goal lasted. Its error is the price of delay and dead time.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from brokk_min.actuator import (
    PlantState,
    Valves,
    command_at_rest,
    lever_arm,
    plant_reset,
    plant_step,
)
from brokk_min.env import Measured
from brokk_min.evaluation.metrics import Run, paired_difference, summary
from brokk_min.jacobian import dls
from brokk_min.kinematics import forward_kinematics, jacobian, tool_velocity
from brokk_min.machine import PWM_MAX, Array, Machine, limit_command, valve_command, valve_opening

BLOCKS = (1, 1, 2, 4, 6)  # ticks between changes of a plan; their sum is the horizon (assumed)
STEPS = (1.0, 0.5, 0.2)  # fractions of a Gauss-Newton step that are tried (assumed)
PROBE = 0.03  # valve opening of the finite differences (assumed)
SOFT = 0.01  # m/s: smaller errors weigh as squares, larger ones by their size (assumed)
ROUNDING = 5  # ticks over which roundings to whole counts are compared (assumed)
ELSEWHERE = 0.2  # rad or m: more than noise of the measured angles


class Plan(NamedTuple):
    """State of the controller: the plant as it is, and the plan."""

    plant: PlantState
    opening: Array  # valve openings beyond the dead zone, (num, horizon, n_driven)
    tick: int
    rest_ticks: NDArray[np.int64]  # of `command_at_rest`, (num,)


@dataclass(frozen=True)
class PerfectModel:
    """The bound as a `Controller`: Gauss-Newton on a plan of valve openings at every tick.

    It simulates the plant under its own commands, so its state (spools, valve activation, delayed
    commands) is exact; of the measurements it reads the goal alone. Openings near zero alternate
    by `dither`, which keeps the valves open. At rest "closed" valves close, "open" ones do not. It
    drives the nominal machine only.
    """

    machine: Machine
    poses: Array  # start angles [rad] (k, n); a batch is these, repeated
    valves: Valves = "closed"  # or "open", while the tool rests
    dither: float = 0.04  # valve opening (tuned)

    def start(self, num: int) -> Plan:
        """The plant at rest at `poses`, valves closed.

        ValueError: no multiple of their number, or a plant whose states are no tuples of arrays.
        """
        if num % len(self.poses):
            raise ValueError(f"poses: expected {num} or a part of it, got {len(self.poses)}")
        q = np.tile(self.poses, (num // len(self.poses), 1))
        closed = np.zeros((num, sum(BLOCKS), len(self.machine.driven)))
        plant = plant_reset(self.machine, q)
        if not isinstance(plant, tuple):
            raise ValueError(f"plant: expected states that are tuples, got {type(plant).__name__}")
        return Plan(plant, closed, 0, np.zeros(num, np.int64))

    def __call__(self, measured: Measured, plan: Plan) -> tuple[Array, Plan]:
        """Commands u (num, n), and the plan; ValueError: the machine begins at another pose."""
        off = np.abs(measured.q - plan.plant.q)[..., self.machine.driven].max()
        if plan.tick == 0 and off > ELSEWHERE:
            raise ValueError(f"poses: expected those that the machines start at, {off:.2f} rad off")
        goal = measured.v_goal.astype(float)
        shifted = np.concatenate([plan.opening[:, 1:], plan.opening[:, -1:]], axis=1)
        opening = self.improve(plan.plant, shifted, goal, plan.tick)
        u = self.quantise(plan.plant, opening, goal, plan.tick)
        u, _, rest = command_at_rest(self.machine, self.valves, u, measured.v_goal, plan.rest_ticks)
        return u, Plan(plant_step(self.machine, plan.plant, u), opening, plan.tick + 1, rest)

    def commands(self, opening: Array, tick: int) -> Array:
        """Commands (..., T, n) of planned openings (..., T, n_driven) from a tick on."""
        m = self.machine
        sign = (-1.0) ** (tick + np.arange(opening.shape[-2]))[:, None]
        near_zero = np.maximum(0, 1 - np.abs(opening) / (2 * self.dither + 1e-9))
        opening = opening + self.dither * sign * near_zero
        u = np.zeros((*opening.shape[:-1], m.n))
        u[..., m.driven] = valve_command(opening, m.dead_zones[m.driven])
        return u

    def errors(self, plant: PlantState, u: Array, goal: Array) -> Array:
        """Velocity errors [m/s] (num, plans, T, 3) under commands (num, plans, T, n)."""
        m = self.machine
        num, plans, ticks, n = u.shape
        state = type(plant)(*(np.repeat(array, plans, axis=0) for array in plant))
        angles = [state.q]
        for t in range(ticks):
            state = plant_step(m, state, u[:, :, t].reshape(num * plans, n))
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
        low, high = opening_limits(m)
        plans = np.clip(np.stack(tried, axis=1), low, high)  # (num, plans, horizon, n_driven)
        error = np.linalg.norm(self.errors(plant, self.commands(plans, tick), goal), axis=-1)
        size = np.square(plans).mean(axis=(-1, -2))
        cost = error.mean(axis=-1) + 1e-4 * size  # of equal plans the smaller
        return np.asarray(plans[np.arange(len(plans)), cost.argmin(axis=1)])

    def gauss_newton_step(self, plant: PlantState, opening: Array, goal: Array, tick: int) -> Array:
        """Change of a plan (num, horizon, n_driven) that lessens its velocity errors most.

        A parameter is the opening of one joint from the start of one block to the horizon.
        """
        m = self.machine
        num, horizon, n = opening.shape
        blocks = len(BLOCKS)
        from_block = np.repeat(np.triu(np.ones((blocks, blocks))), BLOCKS, axis=1)
        basis = from_block[:, None, :, None] * np.eye(n)[:, None]  # (blocks, n, horizon, n)
        basis = basis.reshape(blocks * n, horizon, n)  # (parameters, horizon, n_driven)
        plans = opening[:, None] + PROBE * np.concatenate([np.zeros((1, horizon, n)), basis])
        u = self.commands(np.clip(plans, *opening_limits(m)), tick)
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
    J_inv = dls(J, machine.column("weight")[driven], np.full(len(q), 1e-3))
    q_dot = np.zeros_like(q)
    q_dot[:, driven] = (J_inv @ goal[..., None])[..., 0]
    v = q_dot * lever_arm(machine, q)  # of the cylinders [m/s]
    K = np.where(v > 0, machine.column("speed_positive"), machine.column("speed_negative"))
    return np.asarray((v / K)[:, driven])


def perfect_models(machine: Machine, starts: Array) -> dict[str, PerfectModel]:
    """The bounds: with valves open while the tool rests, and with closed ones."""
    return {
        "perfect_model": PerfectModel(machine, starts, "open"),
        "perfect_model_closed": PerfectModel(machine, starts, "closed"),
    }


def regret(runs: Sequence[Run]) -> dict[str, Any]:
    """Mean errors, and velocity errors less that of a controller that knows the plant."""
    error, means = "velocity_error_mean", summary(runs)
    others = [c for c in means if not c.startswith("perfect_model")]
    less = {c: paired_difference(runs, c, "perfect_model", error) for c in others}
    return {"summary": means, "less_perfect_model": less}
