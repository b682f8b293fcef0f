"""Another interface between agent and machine: what our agent reads, remembers, does and pays.

What it changes: our agent reads a shorter history than the paper's, and also which commands opened
valves and which joint velocities would give the goal and undo the velocity error so far (the second
table). Its actions begin beyond the dead zone, its valves open wider shortly before they answer and
close while the tool rests, and it pays for large commands, valve travel and error that lasts.

What it buys, in order, trained with `group_advantages` on our nets for one million steps (means of
three seeds along x, y and z, `benchmarks.ladder`):

| Parts | Velocity error | Drift | Valve travel |
|---|---|---|---|
| the paper's interface | 0.0327 m/s | 0.192 m | 28 |
| the observation, too | 0.0177 m/s | 0.054 m | 50 |
| actions beyond the dead zone, wider at starts, closed valves, too | 0.0148 m/s | 0.029 m | 82 |
| costs, too | 0.0144 m/s | 0.013 m | 26 |

Who was first: resolved rates (Whitney, 1969) as inputs are residual or "structured" observations of
many papers; the integral is that of a PI controller; legged_gym has costs of torques and of action
changes.

It plugs in as an `env.Interface`. A number x of the observation is weight (x - mean) / deviation;
means are those of `env`, 0.5 of the indicator, and 0 of the last two rows:

| Num     | Observation                                          | Deviation   | Weight |
|---------|------------------------------------------------------|-------------|--------|
| 0-6     | goal, velocity (`remember`), angle of the locked joint | as in `env` | 0.75 |
| 7-10    | angles of the driven joints, see `smooth_angles`     | as in `env` | 1      |
| 11-34   | velocities of each driven joint, the 6 newest        | as in `env` | 0.796 f |
| 35-58   | commands of each driven joint, the 6 newest          | as in `env` | 0.796 f |
| 59-82   | `valve_nets.open_indicator` of these commands        | 0.5         | 0.796 f |
| 83-86   | joint velocities that give the goal (`jacobian.dls`) | as in `env` | 1.5    |
| 87-90   | joint motions that undo the error integral [rad]     | 0.1 s times those | 1.5 |

f = exp(-k / 2) of a sample k ticks old. The 6 newest are the newer half of 13, rounded down.
"""

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from brokk_min import env
from brokk_min.beyond.valve_nets import open_indicator, opening
from brokk_min.jacobian import dls
from brokk_min.kinematics import forward_kinematics, jacobian, tool_velocity
from brokk_min.machine import (
    PWM_MAX,
    Array,
    Machine,
    Measured,
    by_direction,
    limit_command,
    valve_opening,
)

INTEGRAL_TIME = 4.0  # s, tuned: time constant of the error integral's leak
ALONG, ACROSS = 0.02, 0.07  # of tool_speed, tuned: velocity errors count up to here
COMPENSATION = 0.01  # of an action, assumed: up to here a command rises to the dead zone
REST_AFTER = 0.1  # s of a zero goal, after which the valves close (tuned)
DAMPED = 0.06  # of the length of the arm, assumed: lambda of resolved velocities
FADE = 2 / 13  # of the history, tuned: e-fold of the weights of older velocities and commands
WIDER, EARLY, LATE = 1.25, 0.25, 0.4  # tuned: times as wide, s after a valve was last closed
EFFORT_COST = 0.03  # tuned: if all commands are at the limit
TRAVEL_COST = 0.1  # tuned: if all commands change by the limit in a tick
INTEGRAL_COST = 3.0  # tuned: of a metre of the error integral in a tick


class Memory(NamedTuple):
    """What the agent keeps between two ticks."""

    v_goal: Array  # of this tick [m/s], (..., 3)
    v_tool: Array  # measured velocity of the tool, see `remember` [m/s], (..., 3)
    error_integral: Array  # leaky integral of the velocity error [m], (..., 3)
    rest_ticks: NDArray[np.int64]  # for which the goal has been zero, (...)
    open_ticks: NDArray[np.int64]  # since a valve was last closed; 0: now, or not in the history


def accumulate(machine: Machine, memory: Memory | None, measured: Measured) -> Memory:
    """I_{t+1} = exp(-dt / T) (I_t + dt e), e = v_goal - v_tool, cut along the goal and across it.

    Along the goal e counts up to 2 % of the tool speed, so that nobody makes up for a late start by
    too much speed; across it, and while the goal is zero, up to 7 %. The goal is that of the tick
    that has ended. `open_ticks` are those since which each valve is open in the history.
    """
    v_goal, v_tool = measured.v_goal, measured.v_tool
    u, zones = measured.history[..., 2, :], machine.dead_zones[machine.driven, None]
    closed = valve_opening(u, zones) == 0
    open_ticks = np.argmax(closed[..., ::-1], axis=-1)
    at_rest = np.asarray(~v_goal.any(axis=-1))
    if memory is None:
        zero = np.zeros_like(v_goal, np.float32)
        return Memory(v_goal, v_tool, zero, np.asarray(at_rest, np.int64), open_ticks)
    error = memory.v_goal - v_tool
    speed = np.linalg.norm(memory.v_goal, axis=-1, keepdims=True)
    direction = memory.v_goal / np.maximum(speed, 1e-6)  # 0 for a zero goal
    along = (error * direction).sum(axis=-1, keepdims=True)
    across = error - along * direction
    limit, most = ALONG * machine.tool_speed, ACROSS * machine.tool_speed
    across = across * (most / np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), most))
    error = np.clip(along, -limit, limit) * direction + across
    integral = np.exp(-machine.dt / INTEGRAL_TIME) * (memory.error_integral + machine.dt * error)
    ticks = np.where(at_rest, memory.rest_ticks + 1, 0)
    return Memory(v_goal, v_tool, integral.astype(np.float32), ticks, open_ticks)


def smooth_angles(machine: Machine, history: Array) -> Array:
    """Present angles [rad] (..., n), from all samples of a history (..., n, 3, H).

    Each old sample is extrapolated to now with the velocities measured since, and the results are
    averaged. A slope over w angles lags the mean velocity of the last tick by w / 2 - 1 ticks. The
    average has 0.28 of the newest angle's noise in training.
    """
    q, q_dot = history[..., 0, :], history[..., 1, :]
    since = q_dot.sum(axis=-1, keepdims=True) - q_dot.cumsum(axis=-1)
    lag = (machine.velocity_samples / 2 - 1) * (q_dot[..., -1:] - q_dot)
    return np.asarray((q + machine.dt * (since + lag)).mean(axis=-1, dtype=history.dtype))


@lru_cache
def observation_scale(machine: Machine) -> tuple[Array, Array]:
    """Mean and deviation / weight of the observation, float32 (obs,) both.

    Nets learn first what is large, so the resolved velocities weigh most, and of velocities and
    commands the newest samples. The samples of a signal weigh as one number, sum w^2 = 1.
    """
    n, H, first = len(machine.driven), machine.history, 6 + len(machine.locked)
    mean, std, _ = env.observation_table(machine)
    angles = slice(first, first + 2 * n * H, 2 * H)  # one of each joint
    q_dot_std, u_std = env.velocity_deviations(machine)[1][machine.driven], std[-1]
    fading = np.exp(-np.arange(H // 2)[::-1] / (FADE * H))
    fading = np.tile(fading / np.linalg.norm(fading), n)
    blocks: list[tuple[Any, ...]] = [  # means, deviations, weights
        (mean[:first], std[:first], 0.75),
        (mean[angles], std[angles], 1.0),
        (0.0, np.repeat(q_dot_std, H // 2), fading),
        (0.0, u_std, fading),
        (0.5, 0.5, fading),
        (0.0, q_dot_std, 1.5),
        (0.0, 0.1 * q_dot_std, 1.5),
    ]
    table = np.concatenate([np.broadcast_arrays(*block) for block in blocks], axis=1)
    mean, std, weight = table.astype(np.float32)
    return mean, std / weight


class OurInterface(env.Interface):
    """What our agent reads, remembers, does and pays."""

    def scale(self, machine: Machine) -> tuple[Array, Array]:
        """`observation_scale`."""
        return observation_scale(machine)

    def remember(self, machine: Machine, memory: Memory | None, measured: Measured) -> Memory:
        """What the agent keeps, with the tool's velocity J q_dot at the time of q_dot.

        The velocity of a joint is the slope through w angles, so it is (w - 1) / 2 ticks old, and J
        is that of q - (w - 1) / 2 dt q_dot, where the driven joints were then. By the Jacobian of
        now the velocity would point to one side, to and fro, and the integral would drift by that.
        """
        q_dot = np.zeros_like(measured.q)
        q_dot[..., machine.driven] = measured.q_dot
        age = (machine.velocity_samples - 1) / 2 * machine.dt
        q = np.stack([measured.q, measured.q - age * q_dot])
        now, then = tool_velocity(forward_kinematics(machine, q), q_dot)
        return accumulate(machine, memory, measured._replace(v_tool=measured.v_tool + then - now))

    def observe(self, machine: Machine, measured: Measured, memory: Memory) -> Array:
        """The observation of the table above, float32 (..., obs)."""
        driven = machine.driven
        q = measured.q.copy()
        q[..., driven] = smooth_angles(machine, measured.history)
        J = jacobian(forward_kinematics(machine, q))[..., driven]
        arm = np.hypot(machine.column("a"), machine.column("d")).sum()
        J_inv = dls(J, np.ones(len(driven)), (DAMPED * arm) ** 2)
        newest = measured.history[..., -(machine.history // 2) :]
        q_dot, u = newest[..., 1, :], newest[..., 2, :]
        opens = open_indicator(opening(u, machine.dead_zones[driven].astype(u.dtype)))
        shape = (*q.shape[:-1], -1)
        numbers = [measured.v_goal, memory.v_tool, q[..., machine.locked], q[..., driven]]
        numbers += [samples.reshape(shape) for samples in (q_dot, u, opens)]
        wanted = measured.v_goal, memory.error_integral
        numbers += [(J_inv @ v[..., None])[..., 0] for v in wanted]
        mean, scale = observation_scale(machine)
        return (np.concatenate(numbers, axis=-1, dtype=np.float32) - mean) / scale

    def command(self, machine: Machine, action: Array, memory: Memory) -> Array:
        """u (..., n) = zone clip(a / 0.01, -1, 1) + (limit - zone) a of actions (..., n_driven).

        An action of 0.01 begins to open a valve. A closed valve answers late, so from 0.25 to 0.4 s
        after it was last closed its action is multiplied by 1.25. Once the goal has been 0 for
        0.1 s all valves close; until then the agent may brake. Paper: Sec. 3.3
        """
        a = np.asarray(action)
        early, late = (round(seconds * machine.rate) for seconds in (EARLY, LATE))
        starts = (memory.open_ticks >= early) & (memory.open_ticks < late)
        a = np.clip(a * np.where(starts, WIDER, 1).astype(a.dtype), -1, 1)
        zone = by_direction(a, machine.dead_zones[machine.driven])
        u = np.zeros((*a.shape[:-1], machine.n), a.dtype)
        u[..., machine.driven] = zone * np.clip(a / COMPENSATION, -1, 1)
        u[..., machine.driven] += (machine.pwm_limit / PWM_MAX - zone) * a
        resting = memory.rest_ticks > REST_AFTER * machine.rate
        return np.where(resting[..., None], 0, limit_command(machine, u))

    def cost(self, machine: Machine, u: Array, u_before: Array, memory: Memory) -> Array:
        """0.03 mean (u / limit)^2 + 0.1 mean |u - u_before| / limit + 3 |integral| [m], (...).

        Some motions of more than three joints cancel at the tool. The first term keeps the policy
        from them, because in the end they push a joint against its stop.
        """
        limit = machine.pwm_limit / PWM_MAX
        effort = np.square(u[..., machine.driven] / limit).mean(axis=-1)
        travel = np.abs((u - u_before)[..., machine.driven] / limit).mean(axis=-1)
        integral = np.linalg.norm(memory.error_integral, axis=-1)
        return np.asarray(EFFORT_COST * effort + TRAVEL_COST * travel + INTEGRAL_COST * integral)


INTERFACE = OurInterface()
