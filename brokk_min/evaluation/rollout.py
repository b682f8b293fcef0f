"""Controllers follow given tool velocities, on the analytic plant or on any other one."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from brokk_min.actuator import PLANT, Plant
from brokk_min.env import draw_noise, initial_state, measure, transition
from brokk_min.kinematics import forward_kinematics, tool_position, tool_velocity
from brokk_min.machine import Array, Controller, Machine, Measured
from brokk_min.settings import TaskConfig

TITLES = {  # of controllers in tables, figures and windows, by their names in files
    "pid_by_hand_raw": "PID by hand, raw",
    "pid_by_hand": "PID by hand",
    "jacobian_pid_k0.1": "PID optimised",
    "rl_critic": "PPO as printed",
    "rl_critic_nets": "PPO with a critic, our nets",
    "rl_paper": "PPO by groups, the paper's observation",
    "rl": "PPO, our agent",
    "jacobian_pid_ff_integral": "strongest PID",
}


def title(name: str) -> str:
    """How tables name a controller; "+cold" and "+warm" are of `evaluation.adaptive`."""
    for start, learns in (("+cold", ", adaptive"), ("+warm", ", adaptive, warm")):
        if name.endswith(start):
            return title(name.removesuffix(start)) + learns
    return TITLES.get(name, name)


def valves_at_rest(name: str) -> str:
    """The class of a controller: valves "closed" while the tool rests, "open", or "-" (unknown)."""
    plain = name.partition("+")[0]
    if plain not in TITLES:
        return "-"
    return "closed" if plain in ("rl", "jacobian_pid_ff_integral") else "open"


class Trace(NamedTuple):
    """A recorded rollout: arrays (T, num, ...); entry t is at the end of tick t."""

    q: Array  # true angle [rad], n
    q_dot: Array  # true mean velocity over the tick [rad/s], n
    u: Array  # command during the tick, n
    p_tool: Array  # true tool position [m], 3
    v_tool: Array  # true tool velocity [m/s], 3


@dataclass(frozen=True)
class Together:
    """Controllers that drive equal parts of a batch, one after the other; itself a `Controller`."""

    controllers: Sequence[Controller]

    def start(self, num: int) -> list[Any]:
        """The states of all."""
        return [one.start(num // len(self.controllers)) for one in self.controllers]

    def __call__(self, measured: Measured, states: list[Any]) -> tuple[Array, list[Any]]:
        """The commands of all, below each other, and their states."""
        parts = zip(*(np.split(array, len(states)) for array in measured), strict=True)
        each = zip(self.controllers, parts, states, strict=True)
        done = [controller(Measured(*part), state) for controller, part, state in each]
        return np.concatenate([u for u, _ in done]), [state for _, state in done]


def rollout(
    machine: Machine,
    controller: Controller,
    start: ArrayLike,
    goals: Iterable[Array],
    noise: float,
    rng: np.random.Generator,
    plant: Plant = PLANT,
    copies: int = 1,
) -> Trace:
    """Let one controller follow given goals from rest. Paper: Fig. 3

    `start` are angles [rad] (num, n), `goals` tool velocities during each tick [m/s] (T, num, 3),
    `noise` the largest of the sensors [deviations]. No episode ends. The batch is so many `copies`
    of these runs below each other, with the same noise in each.
    """

    def copied(rows: ArrayLike) -> Array:
        return np.tile(rows, (copies, 1))

    state, num = initial_state(machine, copied(start), np.zeros(3), plant), len(np.asarray(start))
    controller_state, config = controller.start(copies * num), TaskConfig(noise=noise)
    ticks = []
    for goal in goals:
        v_goal = copied(np.broadcast_to(goal.astype(np.float32), (num, 3)))
        error = copied(draw_noise(machine, config, rng, num))
        measured = measure(machine, state.history, v_goal, error)
        u, controller_state = controller(measured, controller_state)
        state = transition(machine, plant, state._replace(v_goal=v_goal), u)
        frames = forward_kinematics(machine, state.q)
        v_tool, p_tool = tool_velocity(frames, state.q_dot), tool_position(frames)
        ticks.append(Trace(state.q, state.q_dot, u, p_tool, v_tool))
    return Trace(*(np.array(arrays) for arrays in zip(*ticks, strict=True)))
