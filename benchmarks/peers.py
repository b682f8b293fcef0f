"""Learners side by side: seconds of CPU from nets to a policy as good as the optimised PID.

    python -m benchmarks.peers [--learners groups critic sb3 cleanrl] [--steps 800000] [--seed 0]

All train the paper's network on the same environments with our agent's interface, on one thread.
At times, off the clock, the policy runs on the machine, on goals like those of the tuning. A run
ends when its error there is `--share` of that of the optimised PID with the paper's structure.
Discount, windows and exploration are those of our PPO with a critic for every PPO with a critic.
Stable-Baselines3 is no dependency: `pip install stable-baselines3`.
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
from brokk_min.evaluation.rollout import Controller, rollout
from brokk_min.evaluation.sequences import tuning_set
from brokk_min.learning.checkpoint import stagger_episodes
from brokk_min.learning.gym_env import TaskVectorEnv
from brokk_min.learning.policy import Policy, PolicyController, load_policy
from brokk_min.learning.recipes import find_recipe
from brokk_min.machine import BROKK_170 as M
from brokk_min.settings import PPOConfig

C = PPOConfig
EPOCHS = 4  # of Stable-Baselines3 and CleanRL
RATE = 6e-4  # their learning rate
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


def ours(env: TaskVectorEnv, steps: int, seed: int, report: Report) -> None:
    """PPO with groups or with a critic: the kind of the environment decides."""
    groups = isinstance(env, GroupVectorEnv)
    config = replace(find_recipe(critic=not groups).learner, total_steps=steps)
    advantages: ppo.Advantages = group_advantages if groups else ppo.critic_advantages
    start = ppo.begin(env, config, seed)
    stagger_episodes(env)
    ppo.train(env, config, seed, advantages, lambda now, *_: report(now.agent.actor), start)


def sb3(env: TaskVectorEnv, steps: int, seed: int, report: Report) -> None:
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

    net = {"net_arch": [256, 128, 64], "activation_fn": nn.ELU, "log_std_init": C.log_std}
    fixed = {"n_steps": C.horizon, "batch_size": C.minibatch_size, "n_epochs": EPOCHS}
    fixed |= {"gamma": C.gamma, "policy_kwargs": net, "seed": seed, "device": "cpu"}
    done = 0
    model = PPO("MlpPolicy", Adapter(), learning_rate=lambda _: RATE * (1 - done / steps), **fixed)
    while done < steps:
        model.learn(C.horizon * env.num_envs, reset_num_timesteps=False)
        done += C.horizon * env.num_envs
        report([*model.policy.mlp_extractor.policy_net, model.policy.action_net])


def cleanrl(env: TaskVectorEnv, steps: int, seed: int, report: Report) -> None:
    """The loop of CleanRL's ppo_continuous_action.py, with the paper's nets."""
    torch.manual_seed(seed)
    agent = ppo.Agent(env.single_observation_space.shape[0], len(M.driven), C.log_std)  # type: ignore[index]
    optimizer = torch.optim.Adam(agent.parameters(), lr=RATE, eps=1e-5)
    next_obs = torch.from_numpy(env.reset(seed=seed)[0])
    stagger_episodes(env)
    next_done = torch.zeros(env.num_envs)
    batch = C.horizon * env.num_envs
    for update in range(-(-steps // batch)):
        optimizer.param_groups[0]["lr"] = RATE * (1 - update * batch / steps)
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
            for inds in torch.randperm(batch).split(C.minibatch_size):
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
        report(agent.actor)


def scaled(reward: np.ndarray) -> np.ndarray:
    """Rewards whose returns are their means, as those of `ppo.critic_advantages`."""
    return ((1 - C.gamma) * reward).astype(np.float32)


def machine_error(controller: Controller, runs: int) -> float:
    """Mean |v_goal - v_tool| on the machine [m/s], on goals as those of the tuning."""
    start, goals = tuning_set(M, runs, seed=1)
    trace = rollout(M, controller, start, goals, 0.05, np.random.default_rng(0))
    return float(np.linalg.norm(goals - trace.v_tool, axis=-1).mean())


def race(name: str, net: ActuatorNet, target: float, options: Options) -> str:
    """One run, as a row of the table."""
    torch.set_num_threads(1)
    task = find_recipe().task
    env = TaskVectorEnv(C.num_envs, net, M, task, INTERFACE)
    if name == "groups":
        env = GroupVectorEnv(C.num_envs, net, M, task, INTERFACE, horizon=C.horizon)
    seconds, updates, check, best = 0.0, 0, 4, np.inf
    started = time.process_time()

    def report(actor: Iterable[nn.Module]) -> None:
        nonlocal seconds, updates, check, best, started
        seconds += time.process_time() - started
        updates += 1
        if updates >= check or updates * C.horizon * env.num_envs >= options.steps:
            check = 1 + int(1.2 * updates)
            layers = [layer for layer in actor if isinstance(layer, nn.Linear)]
            pairs = [(layer.weight.T, layer.bias) for layer in layers]
            weights = tuple(x.detach().numpy().copy() for pair in pairs for x in pair)
            controller = PolicyController(M, Policy({}, weights, net, "beyond"))
            best = min(best, machine_error(controller, options.runs))
            if best <= target:
                raise Finished
        started = time.process_time()

    with contextlib.suppress(Finished):
        LEARNERS[name](env, options.steps, options.seed, report)
    thousands = updates * C.horizon * env.num_envs / 1e3
    cells = [f"{seconds:.1f}", f"{thousands:.0f}"] if best <= target else ["not reached", ""]
    return f"| {name} | {' | '.join(cells)} | {best:.4f} |"


LEARNERS = {"groups": ours, "critic": ours, "sb3": sb3, "cleanrl": cleanrl}


def main(options: Options) -> None:
    net = load_policy(POLICY, M).net
    pid = read_gains(POLICY.with_name("gains.json"), M, net)["jacobian_pid_k0.1"]
    target = options.share * machine_error(pid, options.runs)
    print(f"level: {target:.4f} m/s\n\n| learner | CPU [s] | thousand steps | ")
    for name in options.learners:
        print(race(name, net, target, options), flush=True)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
