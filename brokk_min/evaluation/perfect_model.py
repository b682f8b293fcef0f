"""A bound: what a controller reaches that knows the plant's equations and its exact state.

Model-predictive control on the analytic plant. It is told no goal ahead of time: it plans as if the present
goal lasted, like every other controller. What error it leaves is the price of delay and dead time.
"""

from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np

from brokk_min.actuator import PlantState, lever_arm, plant_reset, plant_step
from brokk_min.env import Measured
from brokk_min.jacobian import dls
from brokk_min.kinematics import forward_kinematics, jacobian, tool_velocity
from brokk_min.machine import PWM_MAX, Array, Machine, limit_command, valve_opening

BLOCKS = (
    1,
    1,
    2,
    4,
    6,
)  # ticks at which a plan may turn lie between; their sum is the horizon (assumed)
STEPS = (1.0, 0.5, 0.2)  # shares of a Gauss-Newton step that are tried (assumed)
PROBE = 0.03  # valve opening by which a plan is disturbed to see what it does (assumed)
SOFT = 0.01  # m/s, errors below it weigh as squares, above it by their size (assumed)
ROUNDING = 5  # ticks over which the choice of whole counts is judged (assumed)


class Plan(NamedTuple):
    """Memory of the bound: the plant as it is, and what it means to do."""

    plant: PlantState
    opening: Array  # valve openings beyond the dead zone, (num, horizon, n_driven)
    tick: int


@dataclass(frozen=True)
class PerfectModel:
    """The bound as an `env.Controller`: Gauss-Newton on a plan of valve openings at every tick.

    It follows the plant by its own commands, so that its state (spools, readiness, delayed commands) is
    exact; observations tell it the goal alone. Valves that are hardly open go to and fro by `dither`, which
    keeps them ready. It drives the machine as it is known, no other.

    Paper: Sec. 4.2 (nothing: beyond it)
    """

    machine: Machine
    poses: Array  # start angles [rad] (k, n); a batch is these, repeated
    dither: float = 0.04  # valve opening (tuned)

    def start(self, num: int) -> Plan:
        """The plant at rest at `poses`, valves closed; ValueError: no multiple of their number."""
        if num % len(self.poses):
            raise ValueError(f"poses: expected {num} or a part of it, got {len(self.poses)}")
        q = np.tile(self.poses, (num // len(self.poses), 1))
        return Plan(
            plant_reset(self.machine, q), np.zeros((num, sum(BLOCKS), len(self.machine.driven))), 0
        )

    def __call__(self, measured: Measured, memory: Plan) -> tuple[Array, Plan]:
        """Commands u (num, n), and the next memory."""
        plant, tick = memory.plant, memory.tick
        goal = measured.v_goal.astype(float)
        before = np.concatenate([memory.opening[:, 1:], memory.opening[:, -1:]], axis=1)
        opening = self.improve(plant, before, goal, tick)
        u = self.quantise(plant, opening, goal, tick)
        return u, Plan(plant_step(self.machine, plant, u), opening, tick + 1)

    def commands(self, opening: Array, tick: int) -> Array:
        """Commands (..., ticks, n) for planned openings (..., ticks, n_driven) from a tick on."""
        m = self.machine
        wave = self.dither * (-1.0) ** (tick + np.arange(opening.shape[-2]))[:, None]
        opening = opening + wave * np.maximum(0, 1 - np.abs(opening) / (2 * self.dither + 1e-9))
        u = np.zeros((*opening.shape[:-1], m.n))
        u[..., m.driven] = np.sign(opening) * (m.dead_zone + (1 - m.dead_zone) * np.abs(opening))
        return u

    def errors(self, plant: PlantState, u: Array, goal: Array) -> Array:
        """Velocity errors [m/s] (num, c, ticks, 3) that commands (num, c, ticks, n) would leave."""
        m, (num, c, ticks, n) = self.machine, u.shape
        state = PlantState(*(np.repeat(array, c, axis=0) for array in plant))
        angles = [state.q]
        for t in range(ticks):
            state = plant_step(m, state, u[:, :, t].reshape(num * c, n))
            angles.append(state.q)
        q = np.array(angles)
        v = tool_velocity(
            forward_kinematics(m, q[1:].astype(np.float32)),
            (np.diff(q, axis=0) * m.rate).astype(np.float32),
        )
        return goal[:, None, None] - np.moveaxis(v, 0, 1).reshape(num, c, ticks, 3)

    def improve(self, plant: PlantState, opening: Array, goal: Array, tick: int) -> Array:
        """The best of a plan (num, horizon, n_driven), Gauss-Newton steps from it and steady openings."""
        m, (num, horizon, n) = self.machine, opening.shape
        room = valve_opening(m.pwm_limit / PWM_MAX, m.dead_zone)
        later = np.repeat(
            np.triu(np.ones((len(BLOCKS),) * 2)), BLOCKS, axis=1
        )  # from a tick to the end
        basis = np.einsum("bh,jn->bjhn", later, np.eye(n)).reshape(-1, horizon, n)
        plans = np.concatenate([opening[:, None], opening[:, None] + PROBE * basis], axis=1)
        probed = self.errors(plant, self.commands(np.clip(plans, -room, room), tick), goal)
        weight = 1 / np.sqrt(np.linalg.norm(probed[:, :1], axis=-1, keepdims=True) + SOFT)
        here = (probed[:, 0] * weight[:, 0]).reshape(num, -1)
        slope = ((probed[:, 1:] - probed[:, :1]) * weight).reshape(num, len(basis), -1) / PROBE
        square = slope @ slope.swapaxes(1, 2) + 1e-3 * np.eye(len(basis))
        change = np.linalg.solve(square, -(slope @ here[..., None]))[..., 0]
        steps = np.array(STEPS)[:, None, None] * np.einsum("rk,khn->rhn", change, basis)[:, None]
        steady = np.broadcast_to(
            steady_opening(m, plant.q, goal)[:, None, None], (num, 1, horizon, n)
        )
        tried = np.clip(np.concatenate([opening[:, None] + steps, steady], axis=1), -room, room)
        after = self.errors(plant, self.commands(tried, tick), goal)
        options = np.concatenate([opening[:, None], tried], axis=1)
        size = np.linalg.norm(np.concatenate([probed[:, :1], after], axis=1), axis=-1)
        cost = size.mean(axis=-1) + 1e-4 * np.square(options).mean(
            axis=(-1, -2)
        )  # of equals the smaller
        return np.asarray(options[np.arange(num), cost.argmin(axis=1)])

    def quantise(self, plant: PlantState, opening: Array, goal: Array, tick: int) -> Array:
        """The plan's first commands (num, n) in whole counts: the best of all ways to round them."""
        m, driven = self.machine, self.machine.driven
        planned = self.commands(opening[:, :ROUNDING], tick)
        up = np.array(list(product((False, True), repeat=len(driven))))
        u = np.repeat(planned[:, None], len(up), axis=1)
        counts = u[:, :, 0, driven] * PWM_MAX
        u[:, :, 0, driven] = np.where(up, np.ceil(counts), np.floor(counts)) / PWM_MAX
        u[:, :, 0] = limit_command(m, u[:, :, 0])
        cost = np.linalg.norm(self.errors(plant, u, goal), axis=-1).mean(axis=-1)
        best: Array = u[np.arange(len(u)), cost.argmin(axis=1), 0]
        return best


def steady_opening(machine: Machine, q: Array, goal: Array) -> Array:
    """Openings (num, n_driven) at which the plant at angles `q` settles to the tool velocity `goal` [m/s]."""
    J, driven = jacobian(forward_kinematics(machine, q))[..., machine.driven], machine.driven
    rate = (dls(J, np.ones(len(driven)), np.full(len(q), 1e-3)) @ goal[..., None])[..., 0]
    speed = rate * lever_arm(machine, q)[:, driven]
    fastest = (machine.column(name)[driven] for name in ("speed_positive", "speed_negative"))
    opening: Array = speed / np.where(speed > 0, *fastest)
    return opening


def perfect_models(machine: Machine, starts: Array) -> dict[str, PerfectModel]:
    """The bound, and the same without dither: its valves close while the tool is to stand still."""
    return {
        "perfect_model": PerfectModel(machine, starts),
        "perfect_model_no_dither": PerfectModel(machine, starts, dither=0.0),
    }
