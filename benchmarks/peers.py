"""Wall time to the mean reward of the tuned PID: ours, with a critic, Stable-Baselines3, rl_games.

    python -m benchmarks.peers --actuator NET --gains GAINS [--seeds 0 1 2] [--learning-rates 1e-3]

All train on the same Gymnasium vector environment with the paper's network; each has an adapter
below. Now and then, off the clock, the mean actions of a policy run on other episodes, until they
earn what the PID earns there. With the first seed each learner tries all learning rates and planned
lengths (its schedules end with the plan), with the other seeds the best of them. Runs of different
learners take turns, because computers drift.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import json
import os
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product, zip_longest
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from gymnasium import spaces

from benchmarks.rollout import random_net, write
from brokk_min import ppo
from brokk_min.actuator import ActuatorNet
from brokk_min.env import COMPENSATION, measure
from brokk_min.evaluation import baselines
from brokk_min.identification.net_file import load_net
from brokk_min.learning.checkpoint import stagger_episodes
from brokk_min.learning.episodes import draw_noise
from brokk_min.learning.gym_env import TaskVectorEnv
from brokk_min.learning.simulation_gradient import gradient_advantages
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
    learners: tuple[str, ...] = ("ours", "critic", "sb3", "rl_games")  # Who takes part.
    seeds: tuple[int, ...] = (0, 1, 2)  # One run each.
    learning_rates: tuple[float, ...] = (3e-4, 1e-3, 3e-3)  # All are tried.
    planned: tuple[int, ...] = (300_000, 1_000_000, 3_000_000)  # Steps of schedules; all are tried.
    limit_s: float = 300.0  # Longest run [s].
    threads: int = 2  # Threads of torch.
    target: float | None = None  # Mean reward to reach; by default that of the PID.
    quick: bool = False  # Two updates of 16 environments each: to see that the adapters work.
    json: Path | None = None  # Also write the figures here.


def pid(net: ActuatorNet, gains: Path | None) -> Act:
    """The paper's controller as a source of actions, with a state of its own."""
    if gains:
        controller = baselines.read_gains(gains, M, net)["jacobian_pid_k0.1"]
    else:
        controller = baselines.baselines(M, net)["jacobian_pid_k0.1"]
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


def mean_reward(net: ActuatorNet, act: Act, quick: bool) -> float:
    """Mean reward of mean actions on episodes that nobody trains on."""
    env = TaskVectorEnv(8 if quick else 64, net)
    obs, _ = env.reset(seed=12345)
    rewards = []
    for _ in range(10 if quick else 399):  # no episode ends: controllers keep their state
        obs, reward, *_ = env.step(np.asarray(act(env, obs), np.float32))
        rewards.append(reward.mean())
    return float(np.mean(rewards))


def torch_act(actor: Callable[[torch.Tensor], torch.Tensor]) -> Act:
    def act(env: TaskVectorEnv, obs: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            return actor(torch.from_numpy(obs)).numpy()

    return act


# --- learners: they report the policy after each update -------------------------------------------


def ours(
    env: TaskVectorEnv, rate: float, planned: int, seed: int, report: Report, critic: bool = False
) -> None:
    std_end = None if critic else ppo.PPOConfig.log_std_end
    config = ppo.PPOConfig(planned, env.num_envs, learning_rate=rate, log_std_end=std_end)
    config = replace(config, threads=torch.get_num_threads())
    assert env.net is not None
    learner = ppo.make_learner(env, config, seed, critic)
    stagger_episodes(env)
    estimate = None if critic else gradient_advantages(M, env.net, env.config)

    def on_update(learner: ppo.Learner, *_: object) -> None:
        report(torch_act(learner.agent.actor))

    ppo.train(env, config, seed, on_update, estimate, learner)


def critic(env: TaskVectorEnv, rate: float, planned: int, seed: int, report: Report) -> None:
    """Ours with a critic, as the paper and CleanRL have it."""
    ours(env, rate, planned, seed, report, critic=True)


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

        def close(self) -> None: ...

        def get_attr(self, name: str, indices: Any = None) -> list[Any]:
            return [getattr(env, name, None)] * env.num_envs

        def set_attr(self, name: str, value: Any, indices: Any = None) -> None: ...

        def env_method(self, name: str, *args: Any, **options: Any) -> list[Any]:
            return [None] * env.num_envs

        def env_is_wrapped(self, wrapper: Any, indices: Any = None) -> list[bool]:
            return [False] * env.num_envs

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


def rl_games(env: TaskVectorEnv, rate: float, planned: int, seed: int, report: Report) -> None:
    """Its learning rate follows the change of the policy, not a plan."""
    from rl_games.common import env_configurations, vecenv
    from rl_games.torch_runner import Runner

    class Adapter(vecenv.IVecEnv):
        def __init__(self, name: str, actors: int, **options: Any) -> None: ...

        def step(self, actions: Any) -> tuple[Any, ...]:
            obs, reward, terminated, truncated, _ = env.step(np.asarray(actions, np.float32))
            return obs, reward.astype(np.float32), terminated | truncated, {"time_outs": truncated}

        def reset(self) -> np.ndarray:
            return env.reset(seed=seed)[0]

        def get_number_of_agents(self) -> int:
            return 1

        def get_env_info(self) -> dict[str, Any]:
            box = spaces.Box(-np.inf, np.inf, env.single_observation_space.shape, np.float32)
            return {"action_space": env.single_action_space, "observation_space": box}

    vecenv.register("BROKK", Adapter)
    env_configurations.register("brokk", {"vecenv_type": "BROKK", "env_creator": lambda **_: env})
    default = {"name": "default"}
    sigma = {"sigma_init": {"name": "const_initializer", "val": -1.2}, "fixed_sigma": True}
    network = {
        "name": "actor_critic",
        "separate": True,
        "space": {"continuous": {"mu_activation": "None", "mu_init": default, **sigma}},
        "mlp": {"units": [256, 128, 64], "activation": "elu", "initializer": default},
    }
    with tempfile.TemporaryDirectory() as folder:
        config = {
            "name": "brokk", "env_name": "brokk", "reward_shaper": {"scale_value": 1.0},
            "device": "cpu", "device_name": "cpu", "train_dir": folder, "ppo": True, "tau": 0.95,
            "num_actors": env.num_envs, "normalize_input": True, "normalize_value": True,
            "normalize_advantage": True, "gamma": 0.9, "learning_rate": rate, "e_clip": 0.2,
            "lr_schedule": "adaptive", "kl_threshold": 0.02, "clip_value": False,
            "horizon_length": HORIZON, "minibatch_size": min(2048, HORIZON * env.num_envs),
            "mini_epochs": 4, "critic_coef": 1.0, "entropy_coef": 0.0, "grad_norm": 1.0,
            "truncate_grads": True, "bounds_loss_coef": 0.0001, "value_bootstrap": True,
            "max_epochs": 10**9, "score_to_win": 1e9, "save_best_after": 10**9,
            "save_frequency": 0, "mixed_precision": False,
        }  # fmt: skip
        params = {"seed": seed, "network": network, "config": config}
        params |= {"algo": {"name": "a2c_continuous"}, "model": {"name": "continuous_a2c_logstd"}}
        runner = Runner()
        runner.load({"params": params})
        agent = runner.algo_factory.create("a2c_continuous", base_name="run", params=runner.params)
        agent.init_tensors()
        agent.obs = agent.env_reset()

        def act(env: TaskVectorEnv, obs: np.ndarray) -> np.ndarray:
            agent.set_eval()
            inputs = {"is_train": False, "prev_actions": None, "rnn_states": None}
            with torch.no_grad():
                return agent.model(inputs | {"obs": torch.from_numpy(obs)})["mus"].numpy()

        while True:
            agent.update_epoch()
            agent.train_epoch()
            report(act)


LEARNERS = {"ours": ours, "critic": critic, "sb3": sb3, "rl_games": rl_games}
Setting = tuple[float, int]  # learning rate, planned steps


def race(
    name: str, net: ActuatorNet, setting: Setting, seed: int, target: float, options: Options
) -> dict[str, Any]:
    """One run: seconds of training until mean actions earn `target`; None: limit or plan first."""
    torch.set_num_threads(options.threads)
    env = TaskVectorEnv(16 if options.quick else 256, net)
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
        over |= options.quick and row["updates"] == 2
        if over or options.quick or row["trained_s"] - tried > 2:
            tried = row["trained_s"]
            row["best"] = max(row["best"], mean_reward(net, act, options.quick))
        if row["best"] >= target:
            row["seconds"] = row["trained_s"]
        if over or row["seconds"] or row["trained_s"] > options.limit_s:
            raise Finished
        start = time.perf_counter()

    with contextlib.suppress(Finished), contextlib.redirect_stdout(io.StringIO()):
        LEARNERS[name](env, rate, planned, seed, report)
    return row


def settings_of(name: str, options: Options) -> list[Setting]:
    """What a learner tries."""
    planned = options.planned[-1:] if name == "rl_games" else options.planned
    return list(product(options.learning_rates, planned))


def best_setting(rows: list[dict[str, Any]]) -> Setting:
    """Of the runs of a learner with one seed: the fastest, or the one that came closest."""
    best = min(rows, key=lambda row: (row["seconds"] or np.inf, -row["best"]))
    return best["learning_rate"], best["planned"]


def main(options: Options) -> dict[str, Any]:
    if options.quick:
        options.seeds = options.seeds[:1]
        options.learning_rates = options.learning_rates[:1]
        options.planned = options.planned[-1:]
    net = load_net(options.actuator) if options.actuator else random_net(np.random.default_rng(0))
    net = net.select([M.names[i] for i in M.driven])
    target = options.target
    if target is None:
        target = mean_reward(net, pid(net, options.gains), options.quick)
    learners = list(options.learners)
    if not importlib.util.find_spec("rl_games"):
        learners = [name for name in learners if name != "rl_games"]
    rows: dict[str, list[dict[str, Any]]] = {name: [] for name in learners}

    def run(name: str, setting: Setting, seed: int) -> None:
        rows[name].append(race(name, net, setting, seed, target, options))
        print(json.dumps(rows[name][-1]), flush=True)

    for settings in zip_longest(*(settings_of(name, options) for name in learners)):
        for name, setting in zip(learners, settings, strict=True):
            if setting:
                run(name, setting, options.seeds[0])
    chosen = {name: best_setting(rows[name]) for name in learners}
    for seed, name in product(options.seeds[1:], learners):
        run(name, chosen[name], seed)
    median = {}
    for name in learners:
        times = [
            r["seconds"] for r in rows[name] if (r["learning_rate"], r["planned"]) == chosen[name]
        ]
        middle = float(np.median([np.inf if t is None else t for t in times]))
        median[name] = middle if np.isfinite(middle) else None
    result: dict[str, Any] = {"target": target, "load": os.getloadavg(), "threads": options.threads}
    result |= {"not_installed": sorted(set(options.learners) - set(learners))}
    result |= {"chosen": chosen, "median_s": median}
    result |= {"runs": [row for name in learners for row in rows[name]]}
    write(result, options.json)
    return result


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
