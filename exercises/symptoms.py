"""What can be seen of an error in the package: numbers and curves, each in a second or two.

python -m exercises.symptoms NAME      prints them as JSON; `exercises.hunt` compares them
"""

import json
import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from brokk_min import actuator, env, jacobian, kinematics, machine, ppo
from brokk_min.can import canopen, safety_gate
from brokk_min.env import TaskConfig
from brokk_min.evaluation.baselines import make_gains
from brokk_min.evaluation.rollout import Controller, rollout
from brokk_min.identification.files import SHIPPED
from brokk_min.identification.net_file import joint_nets
from brokk_min.learning import simulation_gradient
from brokk_min.learning.policy import PolicyController, load_policy
from brokk_min.machine import BROKK_170 as BROKK
from brokk_min.machine import PWM_MAX, Array
from examples.mini_excavator import MINI_EXCAVATOR
from exercises.e13_gate import case

START = np.array(BROKK.q_start)
DRIVEN = [BROKK.names[i] for i in BROKK.driven]
POLICY = SHIPPED / BROKK.name / "policy.npz"


class Symptom(NamedTuple):
    """Rows of a table, and curves of a figure if there is one."""

    rows: dict[str, Any]
    curves: dict[str, tuple[Any, Any]] = {}  # noqa: RUF012, x and y
    axes: tuple[str, str] = ("", "")


def pose() -> Symptom:
    """Where the arm is, from the side; radius and height [m]."""
    poses = {"the paper's start": START, "level": np.array([0, 0, 0, np.pi, 0.75 * np.pi])}
    poses["reaching down"] = np.array([0.5, 0.2, -0.2, 2.4, 0.3])
    rows, curves = {}, {}
    for name, q in poses.items():
        frames = kinematics.forward_kinematics(BROKK, q)
        p = kinematics.tool_position(frames)
        rows[f"{name}: tool x, y, z [m]"] = p
        rows[f"{name}: lowest point [m]"] = kinematics.lowest_point(frames)
        rows[f"{name}: x of the base in the heading frame"] = kinematics.to_heading(p, np.eye(3)[0])
        curves[name] = np.hypot(*frames.p[:, :2].T), frames.p[:, 2]
    return Symptom(rows, curves, ("radius [m]", "height [m]"))


def columns() -> Symptom:
    """The Jacobian [m/rad] of the paper's start pose, and differences of tool positions."""
    J = kinematics.jacobian(kinematics.forward_kinematics(BROKK, START))
    step = 1e-6 * np.eye(5)
    ends = [kinematics.forward_kinematics(BROKK, START + sign * step) for sign in (1, -1)]
    quotients = (kinematics.tool_position(ends[0]) - kinematics.tool_position(ends[1])) / 2e-6
    rows = {}
    for i, name in enumerate(BROKK.names):
        rows[f"{name}: column of the Jacobian"] = J[:, i]
        rows[f"{name}: difference quotient"] = quotients[i]
    return Symptom(rows)


def bus() -> Symptom:
    """Bytes out and counts in, on the CAN bus."""
    counts = np.array([80, -80, 50, -50, 0])
    frame = canopen.valve_frame(counts, 7, 1)
    raw = np.array([8192 - 100, 400, 16384 - 300, 300])
    decoded = machine.decode_pwm([80, 127, 128, 175, 255])
    rows = {
        "commands [counts]": counts,
        "their bytes in the valve frame": frame[:5],
        "commands of the bytes 80, 127, 128, 175, 255": decoded * PWM_MAX,
        "largest command that passes [counts]": machine.limit_command(BROKK, [1, -1]) * 127,
        "a command of 20.7 counts": machine.limit_command(BROKK, 20.7 / 127) * 127,
        "raw encoders of the excavator": raw,
        "their joint angles [counts]": canopen.encoder_counts(MINI_EXCAVATOR, raw),
    }
    return Symptom(rows)


def estimator() -> Symptom:
    """A joint at 0.2 rad/s, then still, as the history has it; commands count the ticks."""
    angles = np.concatenate([0.2 * 0.05 * np.arange(1, 25), np.full(8, 1.2 * 0.2)])
    history = actuator.initial_history(np.zeros(1), 13)
    velocities = []
    for i, q in enumerate(angles):
        measured = machine.read_encoder(BROKK, np.full(5, q))[:1]
        history = actuator.append_sample(history, [i / 100], measured, 4, 0.05)
        velocities.append(history[0, 1, -1])
    names = "angles [rad]", "velocities [rad/s]", "commands"
    rows = {f"history, {name}": row for name, row in zip(names, history[0])}
    with_command = actuator.append_command(history, [0.5])
    rows["its commands, with the next one"] = with_command[0, 2]
    rows["angle from all its samples [rad]"] = actuator.smooth_angles(BROKK, history)
    slope = kinematics.estimate_velocity(0.05 * np.arange(13), 4, 0.05)
    rows["noise-free velocity of a ramp at 1 rad/s"] = slope
    curves = {"velocity in the history": (0.05 * np.arange(len(angles)), velocities)}
    return Symptom(rows, curves, ("time [s]", "velocity [rad/s]"))


def valves() -> Symptom:
    """The last joint of the plant after commands: 1 s of rest, 2 s up, 2 s down [rad/s]."""
    counts = np.repeat([0, 80, -80, 0], [20, 40, 40, 10])
    state = actuator.plant_reset(BROKK, np.tile(START, (3, 1)))
    velocities = []
    for m in counts:
        u = np.zeros((3, 5))
        u[0, 4] = u[1, 2:] = m / 127  # q5 alone; three joints at once
        u[2, 4] = 9 / 127  # just beyond the dead zone
        before, state = state.q, actuator.plant_step(BROKK, state, u)
        velocities.append((state.q - before)[:, 4] / BROKK.dt)
    alone, together, slow = np.array(velocities).T
    time = BROKK.dt * np.arange(1, len(counts) + 1)
    rows = {
        "fastest up, down [rad/s]": [alone.max(), alone.min()],
        "time from rest to half of it [s]": time[np.argmax(alone > alone.max() / 2)] - 1.0,
        "time from up to down [s]": time[np.argmax(alone < 0)] - 3.0,
        "fastest with two other joints [rad/s]": [together.max(), together.min()],
        "fastest under 9 counts [rad/s]": slow.max(),
        "after two seconds up and two down [rad]": state.q[:2, 4],
        "lever arms [m]": actuator.lever_arm(BROKK, START),
        "velocity 0.1 s to 0.6 s after the step": alone[21:32:2],
    }
    curves = {"q5 alone": (time, alone), "with two others": (time, together)}
    return Symptom(rows, curves, ("time [s]", "velocity of q5 [rad/s]"))


def nets() -> Symptom:
    """The shipped nets against the plant, under the same commands for 4 s."""
    net = load_policy(POLICY, BROKK).net
    rng = np.random.default_rng(0)
    commands = np.zeros((80, 1, 5))
    commands[:60, 0, BROKK.driven] = np.repeat(rng.uniform(-0.4, 0.4, (4, 4)), 15, axis=0)
    sides = []
    for plant in (True, False):
        state = env.initial_state(BROKK, START[None], np.zeros(3), plant=plant)
        states = []
        for u in commands:
            state = env.transition(BROKK, net, state, u)
            states.append(state)
        sides.append(np.array([s.q[0] for s in states])[:, BROKK.driven])
    still = env.initial_state(BROKK, START[None], np.zeros(3), plant=False)
    for _ in range(40):
        still = env.transition(BROKK, net, still, np.full((1, 5), 5 / 127))
    swapped = joint_nets(net, ["q5", "q1"])
    last = np.array([side[-1] for side in sides]).T
    distance = np.abs(sides[1] - sides[0]).max(axis=0)
    rows = {f"{name}: end on plant, nets [rad]": ends for name, ends in zip(DRIVEN, last)}
    rows |= {
        "largest distance of the nets from the plant [rad]": distance,
        "q5 on the plant, 0.2 s to 0.7 s [rad]": sides[0][3:14:2, 3],
        "q5 on the nets": sides[1][3:14:2, 3],
        "creep under 5 counts in 2 s [rad]": (still.q[0] - START)[BROKK.driven],
        "least velocity of the nets of q5, q1 [rad/s]": swapped.output_low,
        "joint velocities in the state [rad/s]": states[10].q_dot[0],
        "command of 12 counts as nets read it": actuator.mu_law(12 / 127, 0.07),
    }
    time = BROKK.dt * np.arange(1, 80)
    q_dot = np.diff(sides[1], axis=0) / BROKK.dt
    curves = {"q5 on the nets": (time, q_dot[:, 3]), "q4 on the nets": (time, q_dot[:, 2])}
    return Symptom(rows, curves, ("time [s]", "joint velocity [rad/s]"))


def drive(controller: Controller) -> Symptom:
    """The plant under a controller: 2 s at 0.2 m/s, 1 s of rest; from three poses."""
    poses = np.array([START, [0.4, 0.6, 0.9, 1.4, 0.7], [-1.2, 0.5, 0.3, 2.5, 1.6]])
    goals = np.zeros((60, 3, 3))
    goals[:40, 0, 1] = goals[:40, 1, 2] = 0.2
    goals[:40, 2, 0] = -0.25
    trace = rollout(BROKK, controller, poses, goals, TaskConfig(), np.random.default_rng(0))
    error = np.linalg.norm(goals - trace.v_tool, axis=-1)
    rows = {
        "velocity error from each pose [m/s]": error.mean(axis=0),
        "velocity error while moving [m/s]": error[20:40].mean(axis=0),
        "largest command of each joint [counts]": np.abs(trace.u).max(axis=(0, 1)) * 127,
        "end of the tool, pose 1 [m]": trace.p_tool[-1, 0],
        "end of the tool, pose 3 [m]": trace.p_tool[-1, 2],
        "valve travel from each pose": np.abs(np.diff(trace.u, axis=0)).sum(axis=(0, 2)),
        "mean reward": trace.reward.mean(),
    }
    time = BROKK.dt * np.arange(1, 61)
    curves = {"pose 1, along y": (time, trace.v_tool[:, 0, 1])}
    curves["pose 2, along z"] = time, trace.v_tool[:, 1, 2]
    return Symptom(rows, curves, ("time [s]", "tool velocity [m/s]"))


def policy() -> Symptom:
    """The shipped policy drives the plant."""
    return drive(PolicyController(BROKK, load_policy(POLICY, BROKK)))


def pid() -> Symptom:
    """Jacobian and PIDs drive the plant."""
    gains = make_gains(BROKK, kp=1.0, ki=8.0, kd=0.05, feedback=0.4, min_opening=0.015)
    w0 = jacobian.manipulability_threshold(BROKK)
    return drive(jacobian.JacobianController(BROKK, gains, 0.1, w0))


def resolved() -> Symptom:
    """Joint velocities for 0.1 m/s outward while the arm gets straight; weights at limits."""
    bends = np.array([1.0, 0.5, 0.2, 0.1, 0.05, 0.02])
    q = np.tile([0.0, 0.5, 0.0, np.pi, 0.75 * np.pi], (6, 1))
    q[:, 3:] -= bends[:, None]
    J = kinematics.jacobian(kinematics.forward_kinematics(BROKK, q))[..., BROKK.driven]
    w = jacobian.manipulability(J)
    damping = jacobian.nakamura_damping(w, 3.5, 0.1)
    W = np.array([1.0, 4.0, 1.0, 1.0])
    q_dot = jacobian.dls(J, W, damping + 1e-4) @ [0.1, 0.0, 0.0]
    near = np.array([[2.1, 0.5, 0.6, 1.7, 1.0], [0.0, 0.5, 0.6, 2.85, 1.0]])
    excess = (J @ q_dot[..., None])[..., 0] - [0.1, 0.0, 0.0]
    cost = (excess**2).sum(-1) + (damping + 1e-4) * (W * q_dot**2).sum(-1)
    rows = {
        "bend of the arm [rad]": bends,
        "manipulability": w,
        "lambda^2": damping,
        "size of the joint velocities [rad/s]": np.linalg.norm(q_dot, axis=-1),
        "cost of equation (4)": cost,
        "weights, q1 goes to its limit": jacobian.limit_weights(BROKK, near[0], np.ones(5)),
        "weights, q4 leaves its limit": jacobian.limit_weights(BROKK, near[1], -np.ones(5)),
        "slope of the limit function at q1": jacobian.limit_gradient(BROKK, near[0])[0],
    }
    sizes = np.linalg.norm(q_dot, axis=-1)
    return Symptom(rows, {"joint velocities": (bends, sizes)}, ("bend [rad]", "|q_dot| [rad/s]"))


def task() -> Symptom:
    """Some ticks of the task on the plant; one arm begins in the ground, one runs out of time."""
    poses = np.array([START, [0.0, 0.0, -0.3, 2.2, 1.0], [0.4, 0.6, 0.9, 1.4, 0.7]])
    config = TaskConfig(episode_s=0.5)
    state = env.initial_state(BROKK, poses, [0.1, 0.0, 0.1], plant=True)
    rewards, ends = [], []
    for i in range(12):
        actions = np.full((3, 4), 0.5 if i < 6 else -0.2)
        state, reward, terminated, truncated, _ = env.step(BROKK, config, None, state, actions)
        rewards.append(reward)
        ends.append(terminated + 2 * truncated)
    inputs = BROKK, state.history, state.v_goal, state.error_integral
    measured = env.measure(*inputs, 0.1)
    noise = measured.v_tool - env.measure(*inputs).v_tool
    obs = env.features(BROKK, measured)
    ground = np.array([-0.01, 0.0, 0.01])
    errors = np.outer([0, 0.1, 1, 5], [0.6, 0, 0.8])
    u = env.action_to_pwm(BROKK, [1, 0.5, 0.005, 0])
    rows = {
        "rewards of arm 1": np.array(rewards)[:, 0],
        "rewards of arm 2, which began in the ground": np.array(rewards)[:6, 1],
        "ends of arm 1 (1 terminated, 2 truncated)": np.array(ends)[:, 0],
        "ends of arm 2": np.array(ends)[:, 1],
        "reward at an error of 0, 0.1, 1, 5 m/s": env.reward(errors, np.zeros(3)),
        "terminated at -1, 0, 1 cm": env.terminated(BROKK, ground),
        "error integral of arm 1 [m]": state.error_integral[0],
        "joint velocities of arm 1 [rad/s]": state.q_dot[0],
        "noise of 0.1 on the tool velocity [m/s]": noise[0],
        "observation of arm 1, numbers 0 to 6": obs[0, :7],
        "mean and deviation of its history": [obs[0, 7:163].mean(), obs[0, 7:163].std()],
        "observation of arm 1, last eight": obs[0, -8:],
        "commands of the actions 1, 0.5, 0.005, 0 [counts]": u * 127,
    }
    return Symptom(rows)


def advantages() -> Symptom:
    """Advantages of six ticks; the critic is exact, the third tick ends an episode."""
    one = torch.ones(6, 1)
    done = torch.tensor([0.0, 0, 1, 0, 0, 0])[:, None]
    exact, nothing = 10 * one, 0 * one
    ended = ppo.gae(one, exact, exact * (1 - done), done, 0.9, 0.5)
    ratio, advantage = torch.tensor([0.5, 1.5, 0.5, 1.5]), torch.tensor([1.0, 1, -1, -1])
    losses = [ppo.policy_loss(r[None], a[None], 0.2) for r, a in zip(ratio, advantage)]
    density = ppo.log_probability(torch.zeros(2), torch.zeros(2), torch.full((2,), -1.0))
    rows = {
        "no end, exact critic": ppo.gae(one, exact, exact, nothing, 0.9, 0.5)[:, 0],
        "terminated, exact critic": ended[:, 0],
        "truncated, critic of zero": ppo.gae(one, nothing, nothing, done, 0.9, 0.5)[:, 0],
        "losses at ratio 0.5, 1.5; advantage 1, -1": torch.stack(losses),
        "log-density of the mean, two actions, deviation 1/e": density,
    }
    return Symptom(rows)


class Line(VectorEnv[Array, Array, Any]):
    """Stay at 0 of a line: |x| above 1.5 terminates, 12 ticks truncate; reward 1 / (1 + 5 |x|)."""

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(self, num_envs: int = 16) -> None:
        self.num_envs = num_envs
        self.single_observation_space = Box(-np.inf, np.inf, (1,), np.float32)
        self.single_action_space = Box(-1.0, 1.0, (1,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        """All at random places."""
        self.rng = np.random.default_rng(seed)
        self.x = self.rng.uniform(-1, 1, (self.num_envs, 1)).astype(np.float32)
        self.age = self.rng.integers(0, 12, self.num_envs)
        return self.x.copy(), {}

    def step(self, actions: Array) -> Any:
        """Move by 0.3 of the action."""
        self.x = self.x + np.float32(0.3) * actions
        self.age += 1
        distance = np.abs(self.x[:, 0])
        terminated = distance > 1.5
        truncated = (self.age >= 12) & ~terminated
        reward = np.where(terminated, 0.0, 1 / (1 + 5 * distance))
        done = terminated | truncated
        info: dict[str, Any] = {}
        if done.any():
            info = {"final_obs": self.x.copy(), "_final_obs": done}
            self.x[done] = self.rng.uniform(-1, 1, (int(done.sum()), 1))
            self.age[done] = 0
        return self.x.copy(), reward, terminated, truncated, info


def learning() -> Symptom:
    """PPO learns to stay at 0 of a line; nobody needs more than four ticks to get there."""
    config = ppo.PPOConfig(
        total_steps=8 * 16 * 24,
        num_envs=16,
        horizon=24,
        epochs=4,
        minibatch_size=128,
        learning_rate=4e-3,
        target_kl=0.05,
        gamma=0.9,
        log_std=-1.0,
    )
    curve: list[float] = []
    losses: list[float] = []

    def record(learner: ppo.Learner, rollout: ppo.Rollout, metrics: dict[str, float]) -> None:
        curve.append(metrics["charts/reward"])
        losses.append(metrics["losses/value_loss"])

    agent = ppo.train(Line(), config, seed=0, on_update=record)
    x = torch.tensor([[-1.0], [0.0], [1.0]])
    with torch.no_grad():
        value, action = agent.value(x), agent.actor(x)[:, 0]
    rows = {
        "mean reward of the first and last updates": [curve[0], curve[-1]],
        "value loss of the last update": losses[-1],
        "actions at x = -1, 0, 1": action,
        "values there (1: a reward of 1 for ever)": value,
        "deviation of the actions": agent.log_std.exp().detach(),
        "layers": [type(layer).__name__ for layer in agent.actor],
    }
    return Symptom(rows, {"reward": (range(1, len(curve) + 1), curve)}, ("update", "mean reward"))


def gradient() -> Symptom:
    """Derivatives of the rewards of 16 ticks by the first commands, and difference quotients."""
    net = load_policy(POLICY, BROKK).net
    net = replace(net, weights=tuple(weight.astype(float) for weight in net.weights))
    T, step, gamma = 16, 1e-4, 0.95
    shifts = np.zeros((2 * 4 * T, T, 5))  # machine, tick, joint: one command higher or lower
    for i in range(4 * T):
        shifts[i, i // 4, BROKK.driven[i % 4]] = step
        shifts[4 * T + i] = -shifts[i]
    shifts = np.concatenate([np.zeros((1, T, 5)), shifts])
    rng = np.random.default_rng(0)
    pose = np.tile([0.0, 0.5, 0.6, 1.7, 1.0], (len(shifts), 1))
    state = env.initial_state(BROKK, pose, [0.1, -0.1, 0.1], plant=False)
    state = replace(state, true_history=state.true_history.astype(float))
    states, commands, rewards = [], [], []
    for t in range(-12, T):
        u = np.zeros(5)
        u[BROKK.driven] = rng.uniform(0.15, 0.4, 4) * rng.choice([-1, 1], 4)
        batch = u + (shifts[:, t] if t >= 0 else 0 * pose)
        before, state = state, env.transition(BROKK, net, state, batch)
        if t >= 0:
            states.append(before)
            commands.append(batch)
            travel = np.abs(batch - before.history[..., 2, -1])[:, BROKK.driven].sum(axis=-1)
            limit = 4 * BROKK.pwm_limit / PWM_MAX
            rewards.append(env.reward(state.v_goal, state.v_tool) - 0.05 * travel / limit)
    names = ("q", "true_history", "v_goal", "error_integral")
    arrays = [np.stack([getattr(s, name)[:1] for s in states]) for name in names]
    u = np.array(commands)[:, :1]
    result = {}
    for what, end in (("", T), (", episode ends with tick 3", 3)):
        done = np.zeros((T, 1), bool)
        done[end - 1] = True
        ticks = simulation_gradient.Ticks(*arrays, u, np.ones_like(u[..., :1]), done)
        config = TaskConfig(valve_cost=0.05, integral_cost=0.0)
        gradients = simulation_gradient.action_gradients(BROKK, net, ticks, gamma, config)
        gradients = gradients / simulation_gradient.compensation_derivative(BROKK, u)
        for k in (1, 3):
            result[f"{DRIVEN[k]}{what}: gradient"] = gradients[: min(4, end), 0, k]
            quotients = []
            for t in range(min(4, end)):
                returns = sum(gamma ** (i - t) * rewards[i] for i in range(t, end))
                i = 1 + 4 * t + k
                quotients.append((returns[i] - returns[4 * T + i]) / (2 * step))
            result[f"{DRIVEN[k]}{what}: difference quotient"] = np.array(quotients)
    return Symptom(result)


SCENARIO: list[tuple[str, dict[str, Any]]] = [
    ("the switch is held from the start", {}),
    ("released", {"enable": False}),
    ("held, but the goal is not zero", {"centred": False}),
    ("released", {"enable": False}),
    ("held at zero goal", {}),
    ("command 80", {"command": 80}),
    ("command 80", {"command": 80}),
    ("command -80", {"command": -80}),
    ("command -80", {"command": -80}),
    ("command 50", {"command": 50}),
    ("an encoder jumps down", {"shift": -60}),
    ("it stays there", {"shift": -60, "command": 50}),
    ("released", {"shift": -60, "enable": False}),
    ("held at zero goal", {"shift": -60}),
    ("command 30", {"shift": -60, "command": 30}),
    ("the operator's device is lost", {"alive": False, "enable": False}),
    ("it is back, with the switch held", {"command": 30}),
    ("released", {"enable": False}),
    ("held at zero goal", {}),
    ("a command for the locked joint", {"locked": 20}),
    ("released", {"enable": False}),
    ("held at zero goal, an exception", {"error": True}),
    ("held on", {}),
    ("released", {"enable": False}),
    ("held at zero goal", {}),
    *[("command 80, nothing moves", {"command": 80})] * 12,
    ("released, a heartbeat is 0.1 s old", {"enable": False, "age": 0.1}),
    ("held, it is 0.15 s old", {"age": 0.15}),
    ("released, late by 30 ms", {"enable": False, "late": 0.03}),
]


def gate() -> Symptom:
    """Ticks of the safety gate: may it drive, fault, PWM bytes of q1 and q5, counter."""
    state = safety_gate.gate_start(BROKK)
    q = np.array([0.0, 0.7, 0.7, 1.7, 1.99])  # q5 is at its upper stop
    state = state._replace(counter=np.array(250), time=np.array(-BROKK.dt))
    now = 0.0
    rows = {}
    for i, (what, change) in enumerate(SCENARIO):
        inputs = case(change.get("enable", True), change.get("centred", True), False, q, 0)
        command = np.isin(np.arange(5), BROKK.driven) * change.get("command", 0)
        command[1] = change.get("locked", 0)
        counts = inputs.counts + np.array([0, 0, change.get("shift", 0), 0, 0])
        now += BROKK.dt + change.get("late", 0.0)
        inputs = inputs._replace(
            command=command,
            counts=counts,
            heartbeat=np.full(6, now - change.get("age", 0.0)),
            alive=np.array(change.get("alive", True)),
            error=np.array(change.get("error", False)),
        )
        state, frames = safety_gate.gate(BROKK, state, inputs, now)
        fault = safety_gate.fault_name(BROKK, int(state.active_fault)) or "no fault"
        latched = safety_gate.fault_name(BROKK, int(state.latched_fault)) or "none"
        text = f"{'drives' if state.driving else 'closed'}, {fault}; latched {latched}; bytes "
        rows[f"{i:2} {what}"] = text + f"{frames[0, 0]} {frames[0, 4]}, {frames[0, 5]}"
    return Symptom(rows)


SYMPTOMS: dict[str, Callable[[], Symptom]] = {
    function.__name__: function
    for function in (
        pose, columns, bus, estimator, valves, nets, policy, pid, resolved, task, advantages,
        learning, gradient, gate,
    )
}  # fmt: skip


def measure(name: str) -> dict[str, Any]:
    """A symptom as JSON has it; an exception is one, too."""
    try:
        symptom = SYMPTOMS[name]()
    except Exception as error:
        symptom = Symptom({"raised": f"{type(error).__name__}: {error}"})
    rows = {what: text_of(value) for what, value in symptom.rows.items()}
    curves = {
        label: [[float(number) for number in axis] for axis in curve]
        for label, curve in symptom.curves.items()
    }
    return {"rows": rows, "curves": curves, "axes": list(symptom.axes)}


def text_of(value: Any) -> str:
    """A value of a row with four significant digits; text as it is."""
    if isinstance(value, str):
        return value
    if isinstance(value, list) and isinstance(value[0], str):
        return " ".join(value)
    values = np.atleast_1d(np.asarray(value, float))
    return " ".join(f"{0.0 if abs(x) < 1e-6 else x:.4g}" for x in values)


if __name__ == "__main__":
    print(json.dumps(measure(sys.argv[1])))
