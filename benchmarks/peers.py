"""Wall time to the mean reward of the tuned PID: ours, with a critic, Stable-Baselines3.

    python -m benchmarks.peers --actuator NET --gains GAINS [--seeds 0 1 2] [--learning-rates 1e-3]

All train on the same Gymnasium vector environment with the paper's network; each has an adapter
below. Now and then, off the clock, the mean actions of a policy run on other episodes, until they
earn what the PID earns there. With the first seed each learner tries all learning rates and planned
lengths (its schedules end with the plan), with the other seeds the best of them. Runs of different
learners take turns, because computers drift.
"""

from __future__ import annotations

import contextlib
import json
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro

from benchmarks.rollout import random_net, write
from brokk_min import ppo
from brokk_min.actuator import ActuatorNet
from brokk_min.env import COMPENSATION, measure
from brokk_min.evaluation import baselines
from brokk_min.identification.net_file import joint_nets, load_net
from brokk_min.learning.checkpoint import stagger_episodes
from brokk_min.learning.episodes import GRADIENT_LEARNER, draw_noise
from brokk_min.learning.gym_env import TaskVectorEnv
from brokk_min.learning.simulation_gradient import improved_actions, regression_loss
from brokk_min.machine import BROKK_170 as M
from brokk_min.machine import PWM_MAX

HORIZON = 32
Act = Callable[[TaskVectorEnv, np.ndarray], np.ndarray]  # observations (num, obs) -> actions
Report = Callable[[Act], None]  # a policy after an update; raises Finished


class Finished(Exception):
    """The end of a run."""


@dataclass
class Options:
    actuator: Path | None = None  # Nets that `brokk-min fit` wrote; by default random ones.
    gains: Path | None = None  # Tuned gains that `reproduce` wrote; by default those set by hand.
    learners: tuple[str, ...] = ("ours", "critic", "sb3")  # Who takes part.
    seeds: tuple[int, ...] = (0, 1, 2)  # One run each.
    learning_rates: tuple[float, ...] = (3e-4, 1e-3, 3e-3)  # All are tried.
    planned: tuple[int, ...] = (300_000, 1_000_000, 3_000_000)  # Steps of schedules; all are tried.
    limit_s: float = 300.0  # Longest run [s].
    threads: int = 2  # Threads of torch.
    target: float | None = None  # Mean reward to reach; by default that of the PID.
    num_envs: int = 256  # Environments side by side.
    json: Path | None = None  # Also write the figures here.


def pid(net: ActuatorNet, gains: Path | None) -> Act:
    """The paper's controller as a source of actions, with a state of its own."""
    known = baselines.read_gains(gains, M, net) if gains else baselines.baselines(M, net)
    controller = known["jacobian_pid_k0.1"]
    state: Any = None
    rng = np.random.default_rng(0)
    actions = np.array([-1, -COMPENSATION, COMPENSATION, 1])
    beyond = M.pwm_limit / PWM_MAX - M.dead_zone
    commands = M.dead_zone * np.array([-1, -1, 1, 1]) + beyond * actions  # of `action_to_pwm`

    def act(env: TaskVectorEnv, obs: np.ndarray) -> np.ndarray:
        nonlocal state
        state = controller.start(len(obs)) if state is None else state
        s = env.state
        assert s is not None
        noise = draw_noise(M, env.config.noise, len(obs), rng)
        u, state = controller(measure(M, s.history, s.v_goal, s.error_integral, noise), state)
        return np.interp(u[:, M.driven], commands, actions)

    return act


@torch.no_grad()
def mean_reward(net: ActuatorNet, act: Act) -> float:
    """Mean reward of mean actions on episodes that nobody trains on."""
    env = TaskVectorEnv(64, net)
    obs, _ = env.reset(seed=12345)
    rewards = []
    for _ in range(399):  # no episode ends: controllers keep their state
        obs, reward, *_ = env.step(np.asarray(act(env, obs), np.float32))
        rewards.append(reward.mean())
    return float(np.mean(rewards))


# --- learners: they report the policy after each update -------------------------------------------


def ours(
    env: TaskVectorEnv, rate: float, planned: int, seed: int, report: Report, critic: bool = False
) -> None:
    settings = {} if critic else GRADIENT_LEARNER
    options = {"learning_rate": rate, "total_steps": planned, "num_envs": env.num_envs}
    config = ppo.PPOConfig(**{**settings, **options, "threads": torch.get_num_threads()})
    assert env.net is not None
    learner = ppo.make_learner(env, config, seed, critic)
    stagger_episodes(env)
    estimate = None if critic else improved_actions(M, env.net, env.config)
    loss = ppo.ppo_loss if critic else regression_loss

    def on_update(learner: ppo.Learner, *_: object) -> None:
        report(lambda _, obs: learner.agent.actor(torch.from_numpy(obs)).numpy())

    ppo.train(env, config, seed, on_update, estimate, loss, learner)


def sb3(env: TaskVectorEnv, rate: float, planned: int, seed: int, report: Report) -> None:
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecEnv

    class Adapter(VecEnv):
        def __init__(self) -> None:
            super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

        def reset(self) -> np.ndarray:
            return env.reset(seed=seed)[0]

        def step_async(self, actions: np.ndarray) -> None:
            self.actions = actions

        def step_wait(self) -> tuple[Any, ...]:
            obs, reward, terminated, truncated, info = env.step(self.actions)
            infos: list[dict[str, Any]] = [{} for _ in range(env.num_envs)]
            for i in np.flatnonzero(terminated | truncated):
                infos[i]["terminal_observation"] = info["final_obs"][i]
                infos[i]["TimeLimit.truncated"] = bool(truncated[i])
            return obs, reward.astype(np.float32), terminated | truncated, infos

        def get_attr(self, name: str, indices: Any = None) -> list[Any]:
            return [None] * env.num_envs

        close = set_attr = env_method = env_is_wrapped = None  # never called

    threads = torch.get_num_threads()
    steps = 0
    model = PPO(
        "MlpPolicy",
        Adapter(),
        learning_rate=lambda _: rate * max(0.0, 1 - steps / planned),  # over all calls of `learn`
        n_steps=HORIZON,
        batch_size=min(2048, HORIZON * env.num_envs),
        n_epochs=4,
        gamma=0.9,
        policy_kwargs={
            "net_arch": [256, 128, 64],
            "activation_fn": torch.nn.ELU,
            "log_std_init": -1.2,
        },
        seed=seed,
        device="cpu",
    )
    torch.set_num_threads(threads)
    while True:
        model.learn(HORIZON * env.num_envs, reset_num_timesteps=False)
        steps += HORIZON * env.num_envs
        report(lambda _, obs: model.predict(obs, deterministic=True)[0])


LEARNERS = {"ours": ours, "critic": partial(ours, critic=True), "sb3": sb3}
Setting = tuple[float, int]  # learning rate, planned steps


def race(
    name: str, net: ActuatorNet, setting: Setting, seed: int, target: float, options: Options
) -> dict[str, Any]:
    """One run: seconds of training until mean actions earn `target`; None: limit or plan first."""
    torch.set_num_threads(options.threads)
    env = TaskVectorEnv(options.num_envs, net)
    rate, planned = setting
    row: dict[str, Any] = {"learner": name, "learning_rate": rate, "planned": planned, "seed": seed}
    row |= {"best": -np.inf, "updates": 0, "trained_s": 0.0, "seconds": None}
    tried = 0.0  # s, last trial
    start = time.perf_counter()

    def report(act: Act) -> None:
        nonlocal tried, start
        row["trained_s"] += time.perf_counter() - start
        row["updates"] += 1
        over = row["updates"] * HORIZON * env.num_envs >= planned
        if over or row["trained_s"] - tried > 2:
            tried = row["trained_s"]
            row["best"] = max(row["best"], mean_reward(net, act))
        if row["best"] >= target:
            row["seconds"] = row["trained_s"]
        if over or row["seconds"] or row["trained_s"] > options.limit_s:
            raise Finished
        start = time.perf_counter()

    with contextlib.suppress(Finished):
        LEARNERS[name](env, rate, planned, seed, report)
    return row


def best_setting(rows: list[dict[str, Any]]) -> Setting:
    """Of the runs of a learner with one seed: the fastest, or the one that came closest."""
    best = min(rows, key=lambda row: (row["seconds"] or np.inf, -row["best"]))
    return best["learning_rate"], best["planned"]


def main(options: Options) -> dict[str, Any]:
    net = load_net(options.actuator) if options.actuator else random_net(np.random.default_rng(0))
    net = joint_nets(net, [M.names[i] for i in M.driven])
    target = options.target
    if target is None:
        target = mean_reward(net, pid(net, options.gains))
    rows: list[dict[str, Any]] = []

    def run(name: str, setting: Setting, seed: int) -> None:
        rows.append(race(name, net, setting, seed, target, options))
        print(json.dumps(rows[-1]), flush=True)

    settings = product(options.learning_rates, options.planned)
    for setting, name in product(settings, options.learners):
        run(name, setting, options.seeds[0])
    chosen = {}
    for name in options.learners:
        chosen[name] = best_setting([row for row in rows if row["learner"] == name])
    for seed, name in product(options.seeds[1:], options.learners):
        run(name, chosen[name], seed)
    median = {}
    for name, setting in chosen.items():
        own = [row for row in rows if row["learner"] == name]
        own = [row for row in own if (row["learning_rate"], row["planned"]) == setting]
        middle = float(np.median([row["seconds"] or np.inf for row in own]))
        median[name] = middle if np.isfinite(middle) else None
    result: dict[str, Any] = {"target": target, "load": os.getloadavg(), "threads": options.threads}
    result |= {"chosen": chosen, "median_s": median, "runs": rows}
    write(result, options.json)
    return result


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
