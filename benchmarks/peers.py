"""A leaderboard of learners: seconds from nets to three velocity errors on the machine.

    python -m benchmarks.peers [--seeds 0 1 2] [--learners ours critic sb3 cleanrl rl_games]

All train the paper's network on the same Gymnasium vector environment, with one thread; each has an
adapter below. At times, off the clock, the policy runs on the machine, on goals as those of the
tuning. The levels are the error of the paper's PID there, half of it, and that of the shipped
policy. With the first seed each learner tries its four `SETTINGS`, a learning rate and a length
each (schedules end with the length), with the other seeds the one that was first at a level. What
searches of ours have found holds for all: discount, first deviation of the actions, window and
environments. rl_games is no extra of this package: `pip install rl_games`.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
import tyro
from torch import nn
from torch.distributions import Normal

from benchmarks import POLICY, write
from brokk_min import ppo
from brokk_min.env import TaskConfig
from brokk_min.evaluation.baselines import read_gains
from brokk_min.evaluation.rollout import Controller, rollout
from brokk_min.evaluation.sequences import tuning_set
from brokk_min.learning.checkpoint import export_policy, stagger_episodes, use_fast_float32
from brokk_min.learning.episodes import GRADIENT_LEARNER
from brokk_min.learning.gym_env import TaskVectorEnv
from brokk_min.learning.policy import Policy, PolicyController, load_policy
from brokk_min.learning.simulation_gradient import improved_actions, make_learner, regression_loss
from brokk_min.machine import BROKK_170 as M

C = ppo.PPOConfig  # its gamma, GAE lambda, clip, window and first deviation are the peers', too
EPOCHS = 4  # of peers
GAINS = POLICY.with_name("gains.json")
Setting = tuple[float, int]  # learning rate, environment steps
Report = Callable[[Iterable[nn.Module], int], None]  # an actor's layers, gradient steps in all


class Finished(Exception):
    """The end of a run."""


@dataclass
class Options:
    learners: tuple[str, ...] = ("ours", "critic", "sb3", "cleanrl", "rl_games")  # Who takes part.
    policy: Path = POLICY  # Whose nets all train on; its error, with dither at rest, is a level.
    gains: Path = GAINS  # Tuned gains of the PID.
    seeds: tuple[int, ...] = (0, 1, 2)  # One run each.
    longest: float = 1.0  # Fraction of the lengths of `SETTINGS`.
    runs: int = 16  # Runs of 20 s on the machine for each error.
    num_envs: int = 256  # Environments side by side.
    json: Path | None = None  # Write the runs here; what it holds already is not run again.


# --- learners: they report the actor after each update -------------------------------------------


def ours(
    env: TaskVectorEnv, rate: float, steps: int, seed: int, report: Report, critic: bool = False
) -> None:
    settings = {} if critic else GRADIENT_LEARNER
    options = {"learning_rate": rate, "total_steps": steps, "num_envs": env.num_envs}
    config = ppo.PPOConfig(**{**settings, **options})
    assert env.net is not None
    learner = (
        ppo.make_learner(env, config, seed, True) if critic else make_learner(env, config, seed)
    )
    stagger_episodes(env)
    estimate = None if critic else improved_actions(M, env.net, env.config)
    loss = ppo.ppo_loss if critic else regression_loss
    minibatches = -(-config.horizon * env.num_envs // config.minibatch_size)

    def on_update(learner: ppo.Learner, *_: object) -> None:
        report(learner.agent.actor, learner.updates * config.epochs * minibatches)

    ppo.train(env, config, seed, on_update, estimate, loss, learner)


def sb3(env: TaskVectorEnv, rate: float, steps: int, seed: int, report: Report) -> None:
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecEnv

    class Adapter(VecEnv):
        def __init__(self) -> None:
            super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

        def reset(self) -> np.ndarray:
            obs = env.reset(seed=seed)[0]
            stagger_episodes(env)
            return obs

        def step_async(self, actions: np.ndarray) -> None:
            self.actions = actions

        def step_wait(self) -> tuple[Any, ...]:
            obs, reward, terminated, truncated, info = env.step(self.actions)
            infos: list[dict[str, Any]] = [{} for _ in range(env.num_envs)]
            for i in np.flatnonzero(terminated | truncated):
                infos[i]["terminal_observation"] = info["final_obs"][i]
                infos[i]["TimeLimit.truncated"] = bool(truncated[i])
            return obs, scaled(reward), terminated | truncated, infos

        def get_attr(self, name: str, indices: Any = None) -> list[Any]:
            return [None] * env.num_envs

        close = set_attr = env_method = env_is_wrapped = None  # never called

    batch = C.horizon * env.num_envs
    size = min(C.minibatch_size, batch)
    net = {"net_arch": [256, 128, 64], "activation_fn": nn.ELU, "log_std_init": C.log_std}
    done = 0
    model = PPO(
        "MlpPolicy",
        Adapter(),
        learning_rate=lambda _: rate * max(0.0, 1 - done / steps),  # over all calls of `learn`
        n_steps=C.horizon,
        batch_size=size,
        n_epochs=EPOCHS,
        gamma=C.gamma,
        policy_kwargs=net,
        seed=seed,
        device="cpu",
    )
    while True:
        model.learn(batch, reset_num_timesteps=False)
        done += batch
        actor = [*model.policy.mlp_extractor.policy_net, model.policy.action_net]
        report(actor, done // batch * EPOCHS * (batch // size))


def cleanrl(env: TaskVectorEnv, rate: float, steps: int, seed: int, report: Report) -> None:
    """The loop of CleanRL's ppo_continuous_action.py, with the paper's nets."""
    torch.manual_seed(seed)
    agent = ppo.Agent(env.single_observation_space.shape[0], len(M.driven), C.log_std, critic=True)
    assert agent.critic is not None
    optimizer = torch.optim.Adam(agent.parameters(), lr=rate, eps=1e-5)
    next_obs = torch.from_numpy(env.reset(seed=seed)[0])
    stagger_episodes(env)
    next_done = torch.zeros(env.num_envs)
    batch = C.horizon * env.num_envs
    size = min(C.minibatch_size, batch)
    for update in range(steps // batch + 1):
        optimizer.param_groups[0]["lr"] = rate * max(0.0, 1 - update * batch / steps)
        ticks = []
        with torch.no_grad():
            for _ in range(C.horizon):
                probs = Normal(agent.actor(next_obs), agent.log_std.exp())
                action = probs.sample()
                kept = [next_obs, next_done, action, probs.log_prob(action).sum(1)]
                kept.append(agent.critic(next_obs).flatten())
                obs, reward, terminated, truncated, _ = env.step(action.clamp(-1, 1).numpy())
                ticks.append([*kept, torch.from_numpy(scaled(reward))])
                next_obs = torch.from_numpy(obs)
                next_done = torch.from_numpy((terminated | truncated).astype(np.float32))
            columns = [torch.stack(column) for column in zip(*ticks, strict=True)]
            b_obs, dones, actions, logprobs, values, rewards = columns
            next_values = torch.cat([values[1:], agent.critic(next_obs).T])
            dones = torch.cat([dones[1:], next_done[None]])  # CleanRL's: a truncation fails, too
            next_values = next_values * (1 - dones)
            advantages = ppo.gae(rewards, values, next_values, dones, C.gamma, C.gae_lambda)
        b = [x.flatten(0, 1) for x in (b_obs, actions, logprobs, advantages, advantages + values)]
        for _ in range(EPOCHS):
            for inds in torch.randperm(batch).split(size):
                mb_obs, mb_actions, mb_logprobs, mb_adv, mb_returns = (x[inds] for x in b)
                probs = Normal(agent.actor(mb_obs), agent.log_std.exp())
                ratio = (probs.log_prob(mb_actions).sum(1) - mb_logprobs).exp()
                mb_adv = (mb_adv - mb_adv.mean()) / (mb_adv.std() + 1e-8)
                pg_loss = ppo.policy_loss(ratio, mb_adv, C.clip)
                v_loss = 0.5 * ((agent.critic(mb_obs).flatten() - mb_returns) ** 2).mean()
                optimizer.zero_grad()
                (pg_loss + 0.5 * v_loss).backward()
                nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
                optimizer.step()
        report(agent.actor, (update + 1) * EPOCHS * (batch // size))


def rl_games(env: TaskVectorEnv, rate: float, steps: int, seed: int, report: Report) -> None:
    from rl_games.common.algo_observer import AlgoObserver
    from rl_games.torch_runner import Runner

    class Adapter:
        def reset(self) -> np.ndarray:
            obs = env.reset(seed=seed)[0]
            stagger_episodes(env)
            return obs

        def step(self, actions: np.ndarray) -> tuple[Any, ...]:
            obs, reward, terminated, truncated, _ = env.step(actions)
            return obs, reward, terminated | truncated, {"time_outs": truncated.astype(np.float32)}

        def set_train_info(self, *_: object) -> None:
            """Nothing here depends on the training."""

        get_env_state = set_train_info

    class Observer(AlgoObserver):
        def after_init(self, algo: Any) -> None:
            self.model = algo.model

        def after_print_stats(self, frame: int, epoch_num: int, total_time: float) -> None:
            net = self.model.a2c_network
            report([*net.actor_mlp, net.mu], epoch_num * EPOCHS * (batch // size))

    batch = C.horizon * env.num_envs
    size = min(C.minibatch_size, batch)
    spaces = {"observation_space": env.single_observation_space, "agents": 1, "value_size": 1}
    spaces["action_space"] = env.single_action_space
    sigma = {"name": "const_initializer", "val": C.log_std}
    default = {"name": "default"}
    continuous = {"mu_activation": "None", "sigma_activation": "None", "mu_init": default}
    continuous |= {"sigma_init": sigma, "fixed_sigma": True}
    mlp = {"units": [256, 128, 64], "activation": "elu", "initializer": default}
    network = {"name": "actor_critic", "separate": True, "space": {"continuous": continuous}}
    with TemporaryDirectory() as folder:
        config = {
            **{"name": "task", "env_name": "task", "env_info": spaces, "vec_env": Adapter()},
            **{"device": "cpu", "num_actors": env.num_envs, "horizon_length": C.horizon},
            **{"minibatch_size": size, "mini_epochs": EPOCHS, "max_epochs": steps // batch + 1},
            **{"learning_rate": rate, "lr_schedule": "linear", "gamma": C.gamma, "e_clip": C.clip},
            **{"tau": C.gae_lambda, "reward_shaper": {"scale_value": 1 - C.gamma}, "ppo": True},
            **{"normalize_advantage": True, "normalize_value": True, "normalize_input": False},
            **{"entropy_coef": 0.0, "critic_coef": 2.0, "clip_value": True, "grad_norm": 1.0},
            **{"truncate_grads": True, "bounds_loss_coef": 1e-4, "value_bootstrap": True},
            **{"torch_compile": False, "print_stats": False, "train_dir": folder},
            "save_best_after": 10**9,
        }
        params = {"seed": seed, "algo": {"name": "a2c_continuous"}, "torch_threads": 1}
        params |= {"model": {"name": "continuous_a2c_logstd"}, "network": network | {"mlp": mlp}}
        runner = Runner(Observer())
        with contextlib.redirect_stdout(io.StringIO()):
            runner.load({"params": params | {"config": config}})
            runner.run({"train": True})


def scaled(reward: np.ndarray) -> np.ndarray:
    """Rewards whose returns are their means, as those of `ppo.critic_advantages`."""
    return ((1 - C.gamma) * reward).astype(np.float32)


LEARNERS = {"ours": ours, "critic": partial(ours, critic=True)}
LEARNERS |= {"sb3": sb3, "cleanrl": cleanrl, "rl_games": rl_games}
NAMES = {"ours": "ours: gradients of the simulation", "critic": "ours, `train --critic`: GAE"}
NAMES |= {"sb3": "Stable-Baselines3 PPO", "cleanrl": "CleanRL's loop", "rl_games": "rl_games PPO"}
LENGTHS = (262_144, 458_752, 1_048_576, 2_000_000)  # ours; a policy is regressed in few steps
SETTINGS: dict[str, list[Setting]] = {
    name: [(rate, steps) for rate in (6e-4, 1.5e-3) for steps in (300_000, 800_000)]
    for name in LEARNERS
}
SETTINGS["ours"] = [(4e-3, steps) for steps in LENGTHS]


# --- the race -------------------------------------------------------------------------------------


@cache
def goals_of(runs: int) -> tuple[np.ndarray, np.ndarray]:
    return tuning_set(M, runs, seed=1)


def machine_error(controller: Controller, runs: int) -> float:
    """Mean |v_goal - v_tool| on the machine [m/s], on goals as those of the tuning."""
    start, goals = goals_of(runs)
    trace = rollout(M, controller, start, goals, TaskConfig(), np.random.default_rng(0))
    return float(np.linalg.norm(goals - trace.v_tool, axis=-1).mean())


def levels(shipped: Policy, options: Options) -> dict[str, float]:
    """Errors to reach [m/s]."""
    gains = read_gains(options.gains, M, shipped.net)
    pid = machine_error(gains["jacobian_pid_k0.1"], options.runs)
    error = machine_error(PolicyController(M, shipped), options.runs)
    return {"PID": pid, "half of the PID": pid / 2, "shipped policy": error}


def race(
    name: str,
    shipped: Policy,
    setting: Setting,
    seed: int,
    targets: dict[str, float],
    options: Options,
) -> dict[str, Any]:
    """One run: `reached` has CPU and wall seconds, environment and gradient steps of each level."""
    torch.set_num_threads(1)
    use_fast_float32()  # for all learners
    env = TaskVectorEnv(options.num_envs, shipped.net, M, TaskConfig(valves="dither"))
    rate, steps = setting[0], round(setting[1] * options.longest)
    row: dict[str, Any] = {"learner": name, "setting": setting, "seed": seed, "best": np.inf}
    row |= {"updates": 0, "gradient_steps": 0, "cpu_s": 0.0, "wall_s": 0.0, "reached": {}}
    started = time.process_time(), time.perf_counter()
    check = 4  # update

    def report(actor: Iterable[nn.Module], gradient_steps: int) -> None:
        nonlocal started, check
        row["cpu_s"] += time.process_time() - started[0]
        row["wall_s"] += time.perf_counter() - started[1]
        row["updates"] += 1
        row["gradient_steps"] = gradient_steps
        done = row["updates"] * C.horizon * env.num_envs
        if row["updates"] >= check or done >= steps:
            check = 1 + int(1.2 * row["updates"])
            policy = export_policy(shipped.net, SimpleNamespace(actor=actor), env.config, {})  # type: ignore[arg-type]
            row["best"] = min(row["best"], machine_error(PolicyController(M, policy), options.runs))
            now = [row["cpu_s"], row["wall_s"], done, gradient_steps]
            for level, target in targets.items():
                if row["best"] <= target:
                    row["reached"].setdefault(level, now)
        if done >= steps or len(row["reached"]) == len(targets):
            raise Finished
        started = time.process_time(), time.perf_counter()

    with contextlib.suppress(Finished):
        LEARNERS[name](env, rate, steps, seed, report)
    return row


def best_run(rows: list[dict[str, Any]], level: str) -> dict[str, Any]:
    """Of the runs of a learner with one seed: the first at a level, or the closest."""
    return min(rows, key=lambda row: (row["reached"].get(level, [np.inf])[0], row["best"]))


def main(options: Options) -> dict[str, Any]:
    shipped = replace(load_policy(options.policy, M), valves="dither")  # as all who train here
    targets = levels(shipped, options)
    rows: list[dict[str, Any]] = []
    if options.json and options.json.exists():  # go on
        rows = json.loads(options.json.read_text())["runs"]

    def runs(name: str, seed: int, level: str | None = None) -> list[dict[str, Any]]:
        every = [row for row in rows if (row["learner"], row["seed"]) == (name, seed)]
        return [row for row in every if row["level"] == level]

    def run(name: str, setting: Setting, seed: int, level: str | None = None) -> None:
        if any(tuple(row["setting"]) == setting for row in runs(name, seed, level)):
            return
        wanted = {level: targets[level]} if level else targets
        rows.append(race(name, shipped, setting, seed, wanted, options) | {"level": level})
        print(json.dumps(rows[-1]), flush=True)
        if options.json:
            options.json.write_text(json.dumps({"runs": rows}, indent=1) + "\n")

    table: dict[str, dict[str, Any]] = {name: {} for name in options.learners}
    for name in options.learners:
        for setting in SETTINGS[name]:
            run(name, setting, options.seeds[0])
    for name, level in product(options.learners, targets):
        best = best_run(runs(name, options.seeds[0]), level)
        found = [best]
        if level in best["reached"]:
            for seed in options.seeds[1:]:
                run(name, tuple(best["setting"]), seed, level)
                found += runs(name, seed, level)
        table[name][level] = median(found, level) | {"setting": best["setting"]}
    result = {"targets": targets, "load": os.getloadavg(), "table": table, "runs": rows}
    write(result, options.json)
    print(markdown(result))
    return result


def median(rows: list[dict[str, Any]], level: str) -> dict[str, Any]:
    """Medians over seeds of what `race` has of a level; None: half of the seeds have none."""
    missing = [np.inf] * 4
    middle = np.median([row["reached"].get(level, missing) for row in rows], axis=0)
    best = float(np.median([row["best"] for row in rows]))
    return {"reached": middle.tolist() if np.isfinite(middle).all() else None, "best": best}


def markdown(result: dict[str, Any]) -> str:
    """The leaderboard."""
    text = "| learner | differentiates the simulator | level | CPU [s] | wall [s] "
    lines = [text + "| thousand steps | gradient steps | least error |", "|---" * 8 + "|"]
    for name, of_level in result["table"].items():
        who = "yes, by hand" if name == "ours" else "no"
        for level, row in of_level.items():
            cells = ["not reached", "", "", ""]
            if row["reached"]:
                cpu, wall, steps, gradients = row["reached"]
                cells = [f"{cpu:.1f}", f"{wall:.0f}", f"{steps / 1e3:.0f}", f"{gradients:,.0f}"]
            target = f"{level}: {result['targets'][level]:.4f}"
            row_cells = [NAMES[name], who, target, *cells, f"{row['best']:.4f}"]
            lines.append(f"| {' | '.join(row_cells)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
