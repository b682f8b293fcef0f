"""Wall time to the mean reward of the tuned PID: ours beside Stable-Baselines3, CleanRL's loop and rl_games.

    python -m benchmarks.peers --actuator NET --gains GAINS [--seeds 0 1 2] [--learning-rates 3e-4 1e-3 3e-3]

All train on the same Gymnasium vector environment with the paper's network; each has its own adapter below.
A policy's mean action is tried on other episodes now and then, off the clock, until it earns what the PID
earns there. With the first seed every learner tries all learning rates and planned lengths (its schedules end
with the plan), with the other seeds what was best then. Runs are interleaved, because machines drift.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import json
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product, zip_longest
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from gymnasium import spaces

from benchmarks.rollout import random_net
from brokk_min import ppo
from brokk_min.actuator import ActuatorNet
from brokk_min.evaluation import baselines
from brokk_min.identification.net_file import load_net
from brokk_min.learning.gym_env import TaskVectorEnv
from brokk_min.machine import BROKK_170, PWM_MAX

Act = Callable[[np.ndarray], np.ndarray]  # observations (num, obs) -> mean actions (num, 4)


@dataclass
class Options:
    actuator: Path | None = None
    """Nets that `brokk-min fit` wrote; without them random ones."""
    gains: Path | None = None
    """Tuned gains that `reproduce` wrote; without them those set by hand."""
    learners: tuple[str, ...] = ("ours", "sb3", "cleanrl", "rl_games")
    """Who takes part."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """One run each."""
    learning_rates: tuple[float, ...] = (3e-4, 1e-3, 3e-3)
    """All are tried; each learner is judged by its best."""
    planned: tuple[int, ...] = (300_000, 1_000_000, 3_000_000)
    """Steps after which schedules end; all are tried."""
    limit_s: float = 300.0
    """Longest run."""
    threads: int = 2
    """Threads of torch."""
    target: float | None = None
    """Mean reward to reach; by default that of the PID."""
    quick: bool = False
    """One seed, one rate, two updates each of 16 environments: to see that the adapters work."""
    json: Path | None = None
    """Also write the figures here."""


def pid(net: ActuatorNet, options: Options) -> Act:
    """The paper's controller as a source of actions, with a memory of its own."""
    known = baselines.read_gains(options.gains, BROKK_170, net) if options.gains else None
    controller = (known or baselines.baselines(BROKK_170, net))["jacobian_pid_k0.1"]
    memory: Any = None

    def act(observation: np.ndarray) -> np.ndarray:
        nonlocal memory
        memory = controller.start(len(observation)) if memory is None else memory
        u, memory = controller(observation, memory)
        return u[:, BROKK_170.driven] * PWM_MAX / BROKK_170.pwm_limit

    return act


def earned(net: ActuatorNet, act: Act, quick: bool) -> float:
    """Mean reward of mean actions on episodes that nobody trains on."""
    env, total = TaskVectorEnv(8 if quick else 64, net), []
    observation, _ = env.reset(seed=12345)
    for _ in range(10 if quick else 399):  # no episode ends: controllers keep their memory
        observation, reward, *_ = env.step(np.asarray(act(observation), np.float32))
        total.append(reward.mean())
    return float(np.mean(total))


# --- learners: after each update they yield the policy as it stands ---------------------------------


def ours(env: TaskVectorEnv, rate: float, planned: int, seed: int, threads: int) -> Iterator[Act]:
    config = ppo.PPOConfig(
        num_envs=env.num_envs, learning_rate=rate, total_steps=planned, threads=threads
    )
    training = ppo.Training(env, config, seed)
    while True:
        training.update()
        yield torch_act(training.agent.actor)


def torch_act(actor: Callable[[torch.Tensor], torch.Tensor]) -> Act:
    def act(observation: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            return actor(torch.from_numpy(observation)).numpy()

    return act


def cleanrl(
    env: TaskVectorEnv, rate: float, planned: int, seed: int, threads: int
) -> Iterator[Act]:
    """`ppo_continuous_action` in short, with the nets, batches and discount of ours.

    Better than the original in two ways, or it would not get there: a truncation goes on with the value of
    the final observation, and the value is not clipped.
    """
    torch.manual_seed(seed)
    agent = ppo.Agent(env.single_observation_space.shape[0], env.single_action_space.shape[0], -1.2)
    optimizer = torch.optim.Adam(agent.parameters(), lr=rate, eps=1e-5)
    seen = torch.from_numpy(env.reset(seed=seed)[0])
    horizon, gamma, steps = 32, 0.9, 0
    while True:
        optimizer.param_groups[0]["lr"] = rate * max(0.0, 1 - steps / planned)
        steps += horizon * env.num_envs
        kept: dict[str, list[torch.Tensor]] = {
            key: [] for key in ("x", "a", "logp", "value", "reward", "end")
        }
        with torch.no_grad():
            for _ in range(horizon):
                normal = torch.distributions.Normal(agent.actor(seen), agent.log_std.exp())
                action = normal.sample()
                following, reward, terminated, truncated, info = env.step(action.numpy())
                reward = torch.from_numpy(reward).float()
                if truncated.any():
                    reward[truncated] += gamma * agent.value(
                        torch.from_numpy(info["final_obs"][truncated])
                    )
                end = torch.from_numpy(terminated | truncated).float()
                row = (
                    seen,
                    action,
                    normal.log_prob(action).sum(-1),
                    agent.value(seen),
                    reward,
                    end,
                )
                for column, value in zip(kept.values(), row, strict=True):
                    column.append(value)
                seen = torch.from_numpy(following)
            b = {key: torch.stack(column) for key, column in kept.items()}
            coming = torch.cat([b["value"][1:], agent.value(seen)[None]]) * (1 - b["end"])
            b["advantage"] = ppo.gae(b["reward"], b["value"], coming, b["end"], gamma, 0.95)
            b["return"] = b["advantage"] + b["value"]
            b = {key: column.flatten(0, 1) for key, column in b.items()}
        for _ in range(4):
            for rows in torch.randperm(len(b["x"])).split(2048):
                x, a, logp, _, _, _, advantage, ret = (column[rows] for column in b.values())
                normal = torch.distributions.Normal(agent.actor(x), agent.log_std.exp())
                advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
                ratio = (normal.log_prob(a).sum(-1) - logp).exp()
                gain = torch.min(ratio * advantage, ratio.clamp(0.8, 1.2) * advantage).mean()
                loss = 0.25 * ((agent.value(x) - ret) ** 2).mean() - gain
                optimizer.zero_grad()
                loss.backward()
                torch.nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
                optimizer.step()
        yield torch_act(agent.actor)


def sb3(env: TaskVectorEnv, rate: float, planned: int, seed: int, threads: int) -> Iterator[Act]:
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
            seen, reward, terminated, truncated, info = env.step(self.actions)
            infos: list[dict[str, Any]] = [{} for _ in range(env.num_envs)]
            for i in np.flatnonzero(terminated | truncated):
                cut = bool(truncated[i] and not terminated[i])
                infos[i] = {
                    "terminal_observation": info["final_obs"][i],
                    "TimeLimit.truncated": cut,
                }
            return seen, reward.astype(np.float32), terminated | truncated, infos

        def close(self) -> None: ...

        def get_attr(self, name: str, indices: Any = None) -> list[Any]:
            return [getattr(env, name, None)] * env.num_envs

        def set_attr(self, name: str, value: Any, indices: Any = None) -> None: ...

        def env_method(
            self, name: str, *args: Any, indices: Any = None, **options: Any
        ) -> list[Any]:
            return [None] * env.num_envs

        def env_is_wrapped(self, wrapper: Any, indices: Any = None) -> list[bool]:
            return [False] * env.num_envs

    nets = {"net_arch": [256, 128, 64], "activation_fn": torch.nn.ELU, "log_std_init": -1.2}
    how = {"n_steps": 32, "batch_size": min(2048, 32 * env.num_envs), "n_epochs": 4, "gamma": 0.9}
    steps = 0

    def falling(_: float) -> float:  # each call of `learn` would begin the schedule anew
        return rate * max(0.0, 1 - steps / planned)

    model = PPO(
        "MlpPolicy",
        Adapter(),
        learning_rate=falling,
        policy_kwargs=nets,
        seed=seed,
        device="cpu",
        **how,
    )
    torch.set_num_threads(threads)
    while True:
        model.learn(32 * env.num_envs, reset_num_timesteps=False)
        steps += 32 * env.num_envs
        yield lambda x: model.predict(x, deterministic=True)[0]


def rl_games(
    env: TaskVectorEnv, rate: float, planned: int, seed: int, threads: int
) -> Iterator[Act]:
    from rl_games.common import env_configurations, vecenv
    from rl_games.torch_runner import Runner

    class Adapter(vecenv.IVecEnv):
        def __init__(self, name: str, actors: int, **options: Any) -> None: ...

        def step(self, actions: Any) -> tuple[Any, ...]:
            seen, reward, terminated, truncated, _ = env.step(np.asarray(actions, np.float32))
            return seen, reward.astype(np.float32), terminated | truncated, {"time_outs": truncated}

        def reset(self) -> np.ndarray:
            return env.reset(seed=seed)[0]

        def get_number_of_agents(self) -> int:
            return 1

        def get_env_info(self) -> dict[str, Any]:
            size = env.single_observation_space.shape
            box = spaces.Box(-np.inf, np.inf, size, np.float32)
            return {"action_space": env.single_action_space, "observation_space": box}

    vecenv.register("BROKK", lambda name, actors, **options: Adapter(name, actors, **options))
    env_configurations.register("brokk", {"vecenv_type": "BROKK", "env_creator": lambda **_: env})
    spread = {"name": "const_initializer", "val": -1.2}
    continuous = {
        "mu_activation": "None",
        "sigma_activation": "None",
        "mu_init": {"name": "default"},
    }
    mlp = {"units": [256, 128, 64], "activation": "elu", "initializer": {"name": "default"}}
    network = {
        "name": "actor_critic",
        "separate": True,
        "space": {"continuous": continuous | {"sigma_init": spread, "fixed_sigma": True}},
        "mlp": mlp,
    }
    with tempfile.TemporaryDirectory() as folder:
        config = {
            "name": "brokk", "env_name": "brokk", "reward_shaper": {"scale_value": 1.0}, "device": "cpu",
            "device_name": "cpu", "train_dir": folder, "num_actors": env.num_envs, "ppo": True, "tau": 0.95,
            "normalize_input": True, "normalize_value": True, "normalize_advantage": True, "gamma": 0.9,
            "learning_rate": rate, "lr_schedule": "adaptive", "kl_threshold": 0.02, "e_clip": 0.2,
            "clip_value": False, "horizon_length": 32, "minibatch_size": min(2048, 32 * env.num_envs),
            "mini_epochs": 4, "critic_coef": 1.0, "entropy_coef": 0.0, "grad_norm": 1.0,
            "truncate_grads": True, "bounds_loss_coef": 0.0001, "value_bootstrap": True,
            "max_epochs": 10**9, "score_to_win": 1e9,
            "save_best_after": 10**9, "save_frequency": 0, "mixed_precision": False,
        }  # fmt: skip
        params = {
            "seed": seed,
            "algo": {"name": "a2c_continuous"},
            "model": {"name": "continuous_a2c_logstd"},
        }
        runner = Runner()
        runner.load({"params": params | {"network": network, "config": config}})
        agent = runner.algo_factory.create("a2c_continuous", base_name="run", params=runner.params)
        torch.set_num_threads(threads)
        agent.init_tensors()
        agent.obs = agent.env_reset()

        def act(observation: np.ndarray) -> np.ndarray:
            agent.set_eval()
            with torch.no_grad():
                seen = {
                    "is_train": False,
                    "obs": torch.from_numpy(observation),
                    "prev_actions": None,
                }
                return agent.model(seen | {"rnn_states": None})["mus"].numpy()

        while True:
            agent.update_epoch()
            agent.train_epoch()
            yield act


LEARNERS = {"ours": ours, "sb3": sb3, "cleanrl": cleanrl, "rl_games": rl_games}
Setting = tuple[float, int]  # learning rate, planned steps


def race(
    name: str, net: ActuatorNet, setting: Setting, seed: int, target: float, options: Options
) -> dict[str, Any]:
    """One run: seconds of training until mean actions earn `target`, None past the limit or the plan."""
    torch.set_num_threads(options.threads)
    env, clock, updates, best = TaskVectorEnv(16 if options.quick else 256, net), 0.0, 0, -np.inf
    rate, planned = setting
    tried, start = 0.0, time.perf_counter()
    with contextlib.redirect_stdout(io.StringIO()):  # rl_games talks
        for act in LEARNERS[name](env, rate, planned, seed, options.threads):
            clock, updates = clock + time.perf_counter() - start, updates + 1
            over = updates * 32 * env.num_envs >= planned or (options.quick and updates == 2)
            if over or options.quick or clock - tried > 2:  # s of training between two trials
                tried, best = clock, max(best, earned(net, act, options.quick))
            if best >= target or over or clock > options.limit_s:
                break
            start = time.perf_counter()
    row = {"learner": name, "learning_rate": rate, "planned": planned, "seed": seed, "best": best}
    return row | {
        "updates": updates,
        "trained_s": clock,
        "seconds": clock if best >= target else None,
    }


def settings_of(name: str, options: Options) -> list[Setting]:
    """What a learner tries. rl_games follows the change of the policy and not a plan."""
    planned = options.planned[-1:] if name == "rl_games" else options.planned
    return [(rate, steps) for rate in options.learning_rates for steps in planned]


def best_setting(rows: list[dict[str, Any]]) -> Setting:
    """Of the runs of a learner with one seed: that of the fastest, or of the one that came closest."""
    best = min(rows, key=lambda row: (row["seconds"] or np.inf, -row["best"]))
    return best["learning_rate"], best["planned"]


def main(options: Options) -> dict[str, Any]:
    if options.quick:
        options.seeds, options.learning_rates = options.seeds[:1], options.learning_rates[:1]
        options.planned = options.planned[-1:]
    net = load_net(options.actuator) if options.actuator else random_net(np.random.default_rng(0))
    net = net.select([BROKK_170.names[i] for i in BROKK_170.driven])
    target = (
        options.target
        if options.target is not None
        else earned(net, pid(net, options), options.quick)
    )
    missing = [
        name
        for name in options.learners
        if name == "rl_games" and not importlib.util.find_spec(name)
    ]
    tried: dict[str, list[dict[str, Any]]] = {
        name: [] for name in options.learners if name not in missing
    }

    def run(name: str, setting: Setting, seed: int) -> None:
        tried[name].append(race(name, net, setting, seed, target, options))
        print(json.dumps(tried[name][-1]), flush=True)

    first, *others = options.seeds
    for settings in zip_longest(*(settings_of(name, options) for name in tried)):
        for name, setting in zip(tried, settings, strict=True):
            if setting:
                run(name, setting, first)
    chosen = {name: best_setting(rows) for name, rows in tried.items()}
    for seed, name in product(others, tried):
        run(name, chosen[name], seed)
    median = {}
    for name, rows in tried.items():
        seconds = [r["seconds"] for r in rows if (r["learning_rate"], r["planned"]) == chosen[name]]
        median[name] = float(np.median([np.inf if s is None else s for s in seconds]))
    result = {
        "target": target,
        "load": os.getloadavg(),
        "threads": options.threads,
        "not_installed": missing,
    }
    result |= {
        "chosen": chosen,
        "median_s": {name: s if np.isfinite(s) else None for name, s in median.items()},
    }
    result |= {"runs": [row for rows in tried.values() for row in rows]}
    print(json.dumps({key: result[key] for key in list(result)[:-1]}, indent=1))
    if options.json:
        options.json.write_text(json.dumps(result, indent=1) + "\n")
    return result


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
