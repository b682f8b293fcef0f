"""What can be seen of an error in the package: rows of numbers, each in a second or two.

python -m exercises.symptoms NAME      prints them as JSON; `exercises.hunt` compares them
"""

import json
import sys
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AutoresetMode

from brokk_min import actuator, env, jacobian, kinematics, machine, ppo
from brokk_min.machine import BROKK_170 as BROKK
from brokk_min.machine import Array
from exercises.e11_gate import our_drives, our_limit

START = np.array(BROKK.q_start)
Rows = dict[str, Any]


def arm() -> Rows:
    """Where the arm is, and how its joints move the tool, at the paper's start pose."""
    frames = kinematics.forward_kinematics(BROKK, START)
    ends = [kinematics.forward_kinematics(BROKK, START + d) for d in 1e-6 * np.eye(5)]
    rows: Rows = {"tool x, y, z [m]": kinematics.tool_position(frames)}
    level = kinematics.forward_kinematics(BROKK, [0, 0, 0, np.pi, 0.75 * np.pi])
    rows["tool of the arm stretched out [m]"] = kinematics.tool_position(level)
    J = kinematics.jacobian(frames)
    for i, name in enumerate(BROKK.names):
        moved = kinematics.tool_position(ends[i]) - kinematics.tool_position(frames)
        rows[f"{name}: column of the Jacobian"] = J[:, i]
        rows[f"{name}: difference of positions"] = moved / 1e-6
    return rows


def bus() -> Rows:
    """Bytes of the valves, out and in."""
    counts = np.array([80, -80, 50, -50, 0])
    return {
        "commands [counts]": counts,
        "their bytes": machine.encode_pwm(counts / 127),
        "commands of the bytes 80, 128, 175, 255": machine.decode_pwm([80, 128, 175, 255]) * 127,
    }


def estimator() -> Rows:
    """A joint at 0.2 rad/s, then still, as the history has it; commands count the ticks."""
    history = actuator.initial_history(np.zeros(1), 13)
    for i, q in enumerate(np.minimum(0.01 * np.arange(1, 33), 0.24)):
        history = actuator.append_sample(history, [i / 100], np.array([q]), 4, 0.05)
    names = "angles [rad]", "velocities [rad/s]", "commands"
    return {f"history, {name}": row for name, row in zip(names, history[0])}


def valves() -> Rows:
    """The last joint of the plant: 1 s of rest, 2 s up, 2 s down [rad/s]."""
    state, velocities = actuator.PLANT.reset(BROKK, START), []
    for m in np.repeat([0, 80, -80], [20, 40, 40]):
        before, state = state.q, actuator.PLANT.step(BROKK, state, m / 127 * np.eye(5)[4])
        velocities.append((state.q - before)[4] / BROKK.dt)
    up = np.array(velocities[20:60])
    return {
        "fastest up, down [rad/s]": [max(velocities), min(velocities)],
        "time from rest to half of it [s]": BROKK.dt * np.argmax(up > up.max() / 2),
        "velocity 0.1 s to 0.6 s after the step [rad/s]": up[1:12:2],
        "lever arms [m]": actuator.lever_arm(BROKK, START),
    }


def nets() -> Rows:
    """Nets with random weights move the arm: q1 gets commands, then all joints do."""
    rng, n, size = np.random.default_rng(0), len(BROKK.driven), (39, 32)
    scales = np.repeat([0.5, 0.1, 0.3], 13) * np.ones((n, 1))  # of angles, velocities, commands
    weights = [rng.normal(0, 0.3, (n, *shape)) for shape in (size, (32,), (32, 32), (32,))]
    weights += [rng.normal(0, 0.3, (n, 32, 1)), np.zeros((n, 1))]
    ends = -0.3 * np.ones(n), 0.3 * np.ones(n)
    names = tuple(BROKK.names[i] for i in BROKK.driven)
    net = actuator.ActuatorNet(
        names, 13, 20.0, 4, "", 0 * scales, scales, *ends, tuple(weights), {}
    )
    state, rows = net.reset(BROKK, START), {}
    for tick, u in enumerate([0.5 * np.eye(5)[0]] * 2 + [0.4 * np.ones(5)] * 4):
        state = net.step(BROKK, state, u)
        rows[f"angles after tick {tick} [rad]"] = state.q
    return rows


def resolved() -> Rows:
    """Joint velocities for 0.1 m/s outward while the arm gets straight; q2 of four is heavy."""
    q = np.tile([0.0, 0.5, 0.0, np.pi, 0.75 * np.pi], (4, 1))
    q[:, 3:] -= np.array([1.0, 0.2, 0.1, 0.05])[:, None]
    J = kinematics.jacobian(kinematics.forward_kinematics(BROKK, q))[..., BROKK.driven]
    W, v = np.array([1.0, 4.0, 1.0, 1.0]), [0.1, 0.0, 0.0]
    damping = jacobian.nakamura_damping(jacobian.manipulability(J), 3.5, 0.1) + 1e-4
    q_dot = jacobian.dls(J, W, damping) @ v
    missed = (((J @ q_dot[..., None])[..., 0] - v) ** 2).sum(-1)
    return {
        "lambda^2": damping,
        "joint velocities, arm most bent [rad/s]": q_dot[0],
        "size of the joint velocities [rad/s]": np.linalg.norm(q_dot, axis=-1),
        "cost that equation (4) should minimise": missed + damping * (W * q_dot**2).sum(-1),
    }


def pid() -> Rows:
    """Jacobian and PIDs drive the plant for 2 s at 0.2 m/s along y."""
    one = np.ones((1, 4))
    gains = jacobian.Gains(one, 8 * one, 0.05 * one, 0.4 * one[:, :1])
    controller = jacobian.JacobianController(BROKK, gains, 0.1, 1.0)
    state, memory = env.initial_state(BROKK, START[None], [0.0, 0.2, 0.0]), controller.start(1)
    velocities, commands = [], []
    for _ in range(40):
        measured = env.measure(BROKK, state.history, state.v_goal)
        u, memory = controller(measured, memory)
        state = env.transition(BROKK, actuator.PLANT, state, u)
        velocities.append(state.v_tool[0])
        commands.append(u[0])
    return {
        "tool velocity along y, each 0.2 s [m/s]": np.array(velocities)[3::4, 1],
        "mean tool velocity in the second second [m/s]": np.mean(velocities[20:], axis=0),
        "largest command of each joint [counts]": np.abs(commands).max(axis=0) * 127,
    }


def task() -> Rows:
    """Some ticks of the task on the plant; arm 2 begins in the ground, arm 3 near it."""
    poses = [START, [0.0, 0.0, -0.3, 2.2, 1.0], [0.4, 0.3, 0.0, 2.4, 0.9]]
    config, rows, rng = env.TaskConfig(episode_s=0.5, noise=0.0), {}, np.random.default_rng(0)
    task = env.Task(BROKK, actuator.PLANT, config, env.PAPER)
    now = env.look(task, rng, env.initial_state(BROKK, poses, [0.1, 0.0, 0.1]), None)
    actions = np.tile([0.0, -0.5, -1.0, 0.5], (3, 1))
    for tick in range(1, 13):
        now, reward, terminated, truncated, _ = env.tick(task, rng, now, actions)
        if tick in (1, 2, 9, 12):
            rows[f"tick {tick}, rewards"] = reward
            rows[f"tick {tick}, ends (1 terminated, 2 truncated)"] = terminated + 2 * truncated
    rows["commands of the actions 0, -0.5, -1, 0.5 [counts]"] = now.state.history[0, :, 2, -1] * 127
    rows["observation of arm 1, numbers 0 to 6"] = now.obs[0, :7]
    rows["mean and deviation of its history"] = [now.obs[0, 7:].mean(), now.obs[0, 7:].std()]
    return rows


def advantages() -> Rows:
    """Advantages of six ticks; the critic is exact, the third tick ends an episode."""
    one, done = torch.ones(6, 1), torch.tensor([0.0, 0, 1, 0, 0, 0])[:, None]
    ended = ppo.gae(one, 10 * one, 10 * one * (1 - done), done, 0.9, 0.5)
    losses = [
        ppo.policy_loss(torch.tensor([ratio]), torch.tensor([advantage]), 0.2)
        for ratio, advantage in ((0.5, 1.0), (1.5, 1.0), (0.5, -1.0), (1.5, -1.0))
    ]
    return {
        "no end": ppo.gae(one, 10 * one, 10 * one, 0 * one, 0.9, 0.5)[:, 0],
        "terminated in the third tick": ended[:, 0],
        "truncated there, a critic of zero": ppo.gae(one, 0 * one, 0 * one, done, 0.9, 0.5)[:, 0],
        "losses at ratio 0.5, 1.5; advantage 1, -1": torch.stack(losses),
    }


def learning() -> Rows:
    """PPO and a pendulum; episodes of 20 ticks, which no pose ends before."""
    vector = {"autoreset_mode": AutoresetMode.SAME_STEP}
    settings = {"vectorization_mode": "sync", "vector_kwargs": vector, "max_episode_steps": 20}
    task_env = gym.make_vec("Pendulum-v1", 16, **settings)  # type: ignore[arg-type]
    config = ppo.PPOConfig(total_steps=8 * 16 * 32, minibatch_size=128, epochs=4)
    rows: Rows = {}

    def record(checkpoint: ppo.Checkpoint, rollout: ppo.Rollout, metrics: dict[str, float]) -> None:
        if checkpoint.update in (1, 8):
            found, _ = ppo.critic_advantages(checkpoint.agent, rollout, config)
            rows[f"update {checkpoint.update}, mean reward"] = metrics["charts/reward"]
            for tick in (10, 19, 20):
                rows[f"update {checkpoint.update}, advantages of tick {tick}"] = found[tick, :4]

    agent = ppo.train(task_env, config, 0, on_update=record)
    with torch.no_grad():
        rows["values, upright and hanging"] = agent.value(torch.tensor([[1.0, 0, 0], [-1, 0, 0]]))
    return rows


def gate() -> Rows:
    """Which commands pass the gate, and when it drives."""
    cases = {
        "an edge at zero goal": (False, True, False, True, False),
        "held from the beginning": (False, True, True, True, False),
        "an edge, goal not zero": (False, True, False, False, False),
        "driving, a fault": (True, True, True, True, True),
    }
    rows: Rows = {what: str(our_drives(*case)) for what, case in cases.items()}
    for last, command in ((0, 0.6), (0.5, -0.6), (0.6, 0), (-0.6, 0)):
        rows[f"command {command} after {last}"] = our_limit(command, last, True, True)
    return rows


SYMPTOMS: dict[str, Callable[[], Rows]] = {
    function.__name__: function
    for function in (
        arm, bus, estimator, valves, nets, resolved, pid, task, advantages, learning, gate,
    )
}  # fmt: skip


def measure(name: str) -> dict[str, str]:
    """A symptom as text with four digits; an exception is one, too."""
    try:
        rows = SYMPTOMS[name]()
    except Exception as error:
        rows = {"raised": f"{type(error).__name__}: {error}"}
    return {what: text_of(value) for what, value in rows.items()}


def text_of(values: Array | str) -> str:
    """Numbers with four significant digits; text as it is."""
    if isinstance(values, str):
        return values
    numbers = np.atleast_1d(np.asarray(values, float))
    return " ".join(f"{0.0 if abs(x) < 1e-9 else x:.4g}" for x in numbers)


if __name__ == "__main__":
    print(json.dumps(measure(sys.argv[1])))
