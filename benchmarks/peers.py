"""Learners side by side: seconds of CPU from nets to a policy as good as the optimised PID.

    python -m benchmarks.peers [--learners groups critic sb3 cleanrl] [--steps 800000] [--seed 0]
    python -m benchmarks.peers --search 6 --steps 400000

All train the paper's network on the same environments with our agent's interface, on one thread.
At times, off the clock, the policy runs on the machine, on goals like those of the tuning. A run
ends when its error there is `--share` of that of the optimised PID with the paper's structure.
`--search` trains each learner with the same random settings, of `CHOICES`, and prints the errors at
the end; races have the best of them. Stable-Baselines3 is no dependency:
`pip install stable-baselines3`.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
import tyro
from torch import nn
from torch.distributions import Normal

from benchmarks import POLICY
from brokk_min import ppo
from brokk_min.actuator import ActuatorNet
from brokk_min.beyond.group_advantages import GroupVectorEnv, group_advantages
from brokk_min.beyond.interface import INTERFACE
from brokk_min.evaluation.baselines import read_gains
from brokk_min.evaluation.rollout import rollout
from brokk_min.evaluation.sequences import tuning_set
from brokk_min.learning.checkpoint import Env, quick_products, stagger_episodes
from brokk_min.learning.gym_env import TaskVectorEnv
from brokk_min.learning.policy import Policy, load_policy
from brokk_min.learning.recipes import find_recipe
from brokk_min.machine import BROKK_170 as M
from brokk_min.machine import Controller
from brokk_min.settings import PPOConfig

CHOICES: dict[str, tuple[float, ...]] = {
    "learning_rate": (2e-4, 6e-4, 1.2e-3, 2.4e-3),
    "epochs": (2, 4, 8),
    "minibatch_size": (512, 1024, 2048),
    "gamma": (0.8, 0.9, 0.94, 0.97),
    "gae_lambda": (0.8, 0.9, 0.95, 1.0),
    "log_std": (-0.7, -1.2, -1.7),
}
SETTINGS = {  # of six random ones the best for each of the four learners
    "learning_rate": 2.4e-3,
    "epochs": 4,
    "minibatch_size": 1024,
    "gamma": 0.9,
    "gae_lambda": 0.9,
    "log_std": -0.7,
}
Report = Callable[[Iterable[nn.Module]], None]  # an actor's layers, after each update


class Finished(Exception):
    """The end of a run."""


@dataclass
class Options:
    learners: tuple[str, ...] = ("groups", "critic", "sb3", "cleanrl")  # Who takes part.
    steps: int = 800_000  # Environment steps of each.
    seed: int = 0  # Of each.
    runs: int = 16  # Runs of 20 s on the machine for each error.
    share: float = 1.0  # Of the PID's error, at which a run ends.
    search: int = 0  # So many settings of each, instead of a race.


def ours(env: Env, config: PPOConfig, seed: int, report: Report) -> None:
    """PPO with groups or with a critic: the kind of the environment decides."""
    groups = isinstance(env, GroupVectorEnv)
    advantages: ppo.Advantages = group_advantages if groups else ppo.critic_advantages
    start = ppo.begin(env, config, seed)
    stagger_episodes(env)
    ppo.train(env, config, seed, advantages, lambda now, *_: report(now.agent.actor), start)


def sb3(env: Env, config: PPOConfig, seed: int, report: Report) -> None:
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
            return obs, scaled(reward, config), terminated | truncated, infos

        def get_attr(self, name: str, indices: Any = None) -> list[Any]:
            return [None] * env.num_envs

        close = set_attr = env_method = env_is_wrapped = None  # never called

    net = {"net_arch": [256, 128, 64], "activation_fn": nn.ELU, "log_std_init": config.log_std}
    same = {"gamma": config.gamma, "gae_lambda": config.gae_lambda, "n_epochs": config.epochs}
    same |= {"n_steps": config.horizon, "batch_size": config.minibatch_size}
    same |= {"learning_rate": lambda _: config.learning_rate * (1 - done / config.total_steps)}
    done = 0
    model = PPO("MlpPolicy", Adapter(), policy_kwargs=net, seed=seed, device="cpu", **same)
    while done < config.total_steps:
        model.learn(config.horizon * env.num_envs, reset_num_timesteps=False)
        done += config.horizon * env.num_envs
        report([*model.policy.mlp_extractor.policy_net, model.policy.action_net])


def cleanrl(env: Env, config: PPOConfig, seed: int, report: Report) -> None:
    """The loop of CleanRL's ppo_continuous_action.py, with the paper's nets."""
    torch.manual_seed(seed)
    inputs, actions = len(INTERFACE.scale(M)[0]), len(M.driven)
    agent = ppo.Agent(inputs, actions, config.log_std)
    optimizer = torch.optim.Adam(agent.parameters(), lr=config.learning_rate, eps=1e-5)
    next_obs = torch.from_numpy(env.reset(seed=seed)[0])
    stagger_episodes(env)
    next_done = torch.zeros(env.num_envs)
    batch = config.horizon * env.num_envs
    for start in range(0, config.total_steps, batch):
        optimizer.param_groups[0]["lr"] = config.learning_rate * (1 - start / config.total_steps)
        ticks = []
        with torch.no_grad():
            for _ in range(config.horizon):
                probs = Normal(agent.actor(next_obs), agent.log_std.exp())
                action = probs.sample()
                kept = [next_obs, next_done, action, probs.log_prob(action).sum(1)]
                kept.append(agent.critic(next_obs).flatten())
                obs, reward, terminated, truncated, _ = env.step(action.clamp(-1, 1).numpy())
                ticks.append([*kept, torch.from_numpy(scaled(reward, config))])
                next_obs = torch.from_numpy(obs)
                next_done = torch.from_numpy((terminated | truncated).astype(np.float32))
            columns = [torch.stack(column) for column in zip(*ticks, strict=True)]
            b_obs, dones, b_actions, logprobs, values, rewards = columns
            next_values = torch.cat([values[1:], agent.critic(next_obs).T])
            dones = torch.cat([dones[1:], next_done[None]])  # CleanRL's: a truncation fails, too
            rest = next_values * (1 - dones), dones, config.gamma, config.gae_lambda
            advantages = ppo.gae(rewards, values, *rest)
        columns = [b_obs, b_actions, logprobs, advantages, advantages + values]
        columns = [x.flatten(0, 1) for x in columns]
        for _ in range(config.epochs):
            for inds in torch.randperm(batch).split(config.minibatch_size):
                mb_obs, mb_actions, mb_logprobs, mb_adv, mb_returns = (x[inds] for x in columns)
                probs = Normal(agent.actor(mb_obs), agent.log_std.exp())
                ratio = (probs.log_prob(mb_actions).sum(1) - mb_logprobs).exp()
                mb_adv = (mb_adv - mb_adv.mean()) / (mb_adv.std() + 1e-8)
                pg_loss = ppo.policy_loss(ratio, mb_adv, config.clip)
                v_loss = 0.5 * ((agent.critic(mb_obs).flatten() - mb_returns) ** 2).mean()
                optimizer.zero_grad()
                (pg_loss + 0.5 * v_loss).backward()
                nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
                optimizer.step()
        report(agent.actor)


def scaled(reward: np.ndarray, config: PPOConfig) -> np.ndarray:
    """Rewards whose returns are their means, as those of `ppo.critic_advantages`."""
    return ((1 - config.gamma) * reward).astype(np.float32)


def machine_error(controller: Controller, runs: int, seed: int = 1) -> float:
    """Mean |v_goal - v_tool| on the machine [m/s], on goals as those of the tuning."""
    start, goals = tuning_set(M, runs, seed)
    trace = rollout(M, controller, start, goals, 0.05, np.random.default_rng(0))
    return float(np.linalg.norm(goals - trace.v_tool, axis=-1).mean())


@dataclass
class Clock:
    """The seconds and the errors of one training."""

    net: ActuatorNet
    options: Options
    target: float  # m/s, error at which it ends
    seconds: float = 0.0
    updates: int = 0
    check: int = 4  # update of the next error
    best: float = np.inf  # m/s

    def start(self) -> None:
        self.started = time.process_time()

    def report(self, actor: Iterable[nn.Module]) -> None:
        """After an update: stop the clock, and see how good the policy is now."""
        self.seconds += time.process_time() - self.started
        self.updates += 1
        if self.updates >= self.check or self.steps >= self.options.steps:
            self.check = 1 + int(1.2 * self.updates)
            self.best = min(self.best, self.error(actor))
            if self.best <= self.target:
                raise Finished
        self.start()

    @property
    def steps(self) -> int:
        return self.updates * PPOConfig.horizon * PPOConfig.num_envs

    def error(self, actor: Iterable[nn.Module]) -> float:
        layers = [layer for layer in actor if isinstance(layer, nn.Linear)]
        pairs = [(layer.weight.T, layer.bias) for layer in layers]
        weights = tuple(x.detach().numpy().copy() for pair in pairs for x in pair)
        policy = Policy(M, {}, weights, self.net, "beyond")
        goals = 2 if self.options.search else 1  # seeds of goals
        return machine_error(policy, self.options.runs, goals)


LEARNERS = {"groups": ours, "critic": ours, "sb3": sb3, "cleanrl": cleanrl}


@quick_products()
def run(name: str, settings: dict[str, Any], clock: Clock) -> None:
    """Train one learner until it has reached the target, or to the end."""
    groups, options = name == "groups", clock.options
    recipe = find_recipe(critic=not groups)
    same = {"target_kl": PPOConfig.target_kl, "horizon": PPOConfig.horizon}
    rates = {**same, **settings}  # for all the same
    config = replace(recipe.learner, total_steps=options.steps, **rates)
    env: Env = TaskVectorEnv(config.num_envs, clock.net, M, recipe.task, INTERFACE)
    if groups:
        env = GroupVectorEnv(env, config.horizon)
    clock.start()
    with contextlib.suppress(Finished):
        LEARNERS[name](env, config, options.seed, clock.report)


def main(options: Options) -> None:
    net = load_policy(POLICY, M).net
    rng = np.random.default_rng(0)
    names, choices = list(CHOICES), list(CHOICES.values())
    for _ in range(options.search):
        settings = dict(zip(names, [rng.choice(of).item() for of in choices], strict=True))
        for name in options.learners:
            clock = Clock(net, options, 0.0)
            clock.check = options.steps  # at the end alone
            run(name, settings, clock)
            print(f"{name} {clock.best:.4f} {clock.seconds:.0f} {settings}", flush=True)
    if options.search:
        return
    pid = read_gains(POLICY.with_name("gains.json"), M, net)["jacobian_pid_k0.1"]
    target = options.share * machine_error(pid, options.runs)
    print(f"level: {target:.4f} m/s\n\n| learner | CPU [s] | thousand steps | least error |")
    for name in options.learners:
        clock = Clock(net, options, target)
        run(name, SETTINGS, clock)
        cells = [f"{clock.seconds:.1f}", f"{clock.steps / 1e3:.0f}"]
        cells = cells if clock.best <= target else ["not reached", ""]
        print(f"| {name} | {' | '.join(cells)} | {clock.best:.4f} |", flush=True)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
