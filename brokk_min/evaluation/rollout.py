"""A controller follows given tool velocities, on the analytic plant or on the nets."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from brokk_min.actuator import ActuatorNet, Encoder
from brokk_min.env import Measured, TaskConfig, initial_state, measure, reward, transition
from brokk_min.evaluation.sequences import tuning_set
from brokk_min.identification.logs import Log, machine_log
from brokk_min.kinematics import forward_kinematics, tool_position, tool_velocity
from brokk_min.learning.episodes import draw_noise
from brokk_min.machine import Array, Machine, read_encoder

TITLES = {  # of controllers in tables, figures and windows, by their names in files
    "rl": "RL policy",
    "rl_dither": "RL policy (dither)",
    "rl_paper": "the paper's learner",
    "jacobian": "PID with DLS (the paper's)",
    "jacobian_pid_k0.1": "PID with DLS (the paper's)",
    "jacobian_pid_k0.05": "the paper's PID, k = 0.05",
    "jacobian_pid_ff": "PID + feed-forward",
    "jacobian_pid_ff_integral": "PID + feed-forward + integral",
    "jacobian_pid_ff_integral_dither": "PID + feed-forward + integral (dither)",
    "perfect_model": "perfect model (dither)",
    "perfect_model_closed": "perfect model",
    "levers": "levers, joint by joint",
}


class Controller(Protocol):
    """What can drive a machine: a policy, the PIDs, an operator."""

    def start(self, num: int) -> Any:
        """State of `num` controllers at rest."""

    def __call__(self, measured: Measured, state: Any, /) -> tuple[Array, Any]:
        """Commands u [-1, 1] (num, n), and the controllers' state of the next tick."""


class Trace(NamedTuple):
    """A recorded rollout: arrays (T, num, ...); entry t is at the end of tick t."""

    q: Array  # true angle [rad], n
    q_dot: Array  # true mean velocity over the tick [rad/s], n
    q_measured: Array  # encoder angle when the command was computed [rad], n
    u: Array  # command during the tick, n
    p_tool: Array  # true tool position [m], 3
    v_tool: Array  # true tool velocity [m/s], 3
    reward: Array


def rollout(
    machine: Machine,
    controller: Controller,
    start: ArrayLike,
    goals: Array,
    config: TaskConfig,
    rng: np.random.Generator,
    net: ActuatorNet | None = None,
    read: Encoder = read_encoder,
) -> Trace:
    """Let one controller follow given goals from rest: on the plant, or on nets. Paper: Fig. 3

    `start` are angles [rad] (num, n), `goals` tool velocities during each tick [m/s] (T, num, 3).
    Of `config` the noise holds; no episode ends. `net` has the nets of the driven joints (None:
    the analytic plant); `read`: see `transition`.
    """
    state = initial_state(machine, start, goals[0], plant=net is None)
    controller_state = controller.start(len(state.q))
    ticks = []
    for goal in goals:
        v_goal = np.broadcast_to(goal.astype(np.float32), state.v_goal.shape)
        noise = draw_noise(machine, config.noise, len(state.q), rng)
        measured = measure(machine, state.history, v_goal, state.error_integral, noise)
        u, controller_state = controller(measured, controller_state)
        q_measured = state.history[..., 0, -1]
        state = transition(machine, net, replace(state, v_goal=v_goal), u, read)
        frames = forward_kinematics(machine, state.q)
        v_tool = tool_velocity(frames, state.q_dot)
        p_tool = tool_position(frames)
        rewards = reward(goal, v_tool)
        ticks.append(Trace(state.q, state.q_dot, q_measured, u, p_tool, v_tool, rewards))
    return Trace(*(np.array(arrays) for arrays in zip(*ticks, strict=True)))


def own_drives(machine: Machine, controllers: Sequence[Controller], hours: float, seed: int) -> Log:
    """Recordings of controllers on the plant, `hours` in all: what their nets should know best.

    Nets that are fitted to these, too, err less where the policy drives: DAgger for models (Ross
    and Bagnell, ICML 2012; Nagabandi et al., ICRA 2018). Runs of 20 s with goals as in training, of
    seeds of their own. ValueError: too few feasible starts.
    """
    num = max(1, round(hours * 180 / len(controllers)))
    traces = {}
    for k, controller in enumerate(controllers):
        start, goals = tuning_set(machine, num, seed + 1000 * (k + 1))
        rng = np.random.default_rng(seed)
        traces[f"own_{k}"] = rollout(machine, controller, start, goals, TaskConfig(), rng)
    return log_of(machine, traces, num)


def log_of(machine: Machine, traces: Mapping[str, Trace], num: int) -> Log:
    """Commands and encoder angles of the first `num` runs of each trace, under its name."""
    recordings = []
    for name, trace in traces.items():
        for i in range(min(num, trace.q.shape[1])):
            u, q = trace.u[:, i].astype(float), trace.q_measured[:, i].astype(float)
            recordings.append((f"{name}_{i:03d}", u, q))
    return machine_log(machine, recordings)
