"""Training of a policy with files: a checkpoint, a learning curve, and the policy at the end."""

import io
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from brokk_min import ppo
from brokk_min._files import expect_same, expected, whole_file, write_csv
from brokk_min.actuator import ActuatorNet
from brokk_min.beyond.group_advantages import GroupVectorEnv, group_advantages
from brokk_min.beyond.muon import muon
from brokk_min.identification.net_file import fingerprint
from brokk_min.learning.episodes import map_arrays
from brokk_min.learning.gym_env import TaskVectorEnv
from brokk_min.learning.policy import INTERFACES, Policy, contract, save_policy
from brokk_min.learning.recipes import Recipe
from brokk_min.machine import Machine
from brokk_min.ppo import Agent, Checkpoint, Rollout

EVERY = 50  # updates between two checkpoints


def train_policy(
    machine: Machine, net: ActuatorNet, recipe: Recipe, seed: int, out: Path
) -> Policy:
    """Train a policy on the nets of the driven joints and write it to `out`.

    The same `seed` gives the same bits on the same computer. The checkpoint `<out>.checkpoint` and
    the curve `<out>.csv` lie next to the policy. Where a checkpoint exists, the training goes on
    from it, and the result is the same as without the break. ValueError: a checkpoint of another
    training, or a number that is not finite. OSError: a file that cannot be written; the last
    checkpoint stays.
    """
    about = {
        "contract": contract(machine),
        "actuator": fingerprint(net),
        "seed": seed,
        "recipe": asdict(recipe),
    }
    torch.set_num_threads(1)  # several wait in vain on busy cores
    config = recipe.learner
    env, advantages, start = prepare(machine, net, recipe, seed)
    log = TrainingLog(env, out, about)
    if log.checkpoint.exists():
        start = log.load(start)
    options: dict[str, Any] = {"initial": start.global_step, "unit_scale": True, "disable": None}
    with tqdm(desc="train", total=config.total_steps, unit="step", **options) as log.bar:
        agent = ppo.train(env, config, seed, advantages, log.on_update, start)
    log.write_curve()
    policy = Policy(machine, about, actor_weights(agent), net, recipe.interface)
    save_policy(out, policy)
    log.checkpoint.unlink(missing_ok=True)
    return policy


def prepare(
    machine: Machine, net: ActuatorNet, recipe: Recipe, seed: int
) -> tuple[TaskVectorEnv, ppo.Advantages, Checkpoint]:
    """The environments of a recipe, its advantages, and the beginning of its training."""
    config = recipe.learner
    simulation = (config.num_envs, net, machine, recipe.task, INTERFACES[recipe.interface])
    advantages: ppo.Advantages = ppo.critic_advantages
    env = TaskVectorEnv(*simulation)
    if not recipe.critic:
        advantages = group_advantages
        env = GroupVectorEnv(*simulation, horizon=config.horizon)
    start = ppo.begin(env, config, seed)
    if recipe.muon:
        start = start._replace(optimizer=muon(start.agent, config))
    stagger_episodes(env)
    return env, advantages, start


def actor_weights(agent: Agent) -> tuple[np.ndarray, ...]:
    """w (inputs, outputs) and b of each layer of the actor."""
    return tuple(weight.detach().numpy().T.copy() for weight in agent.actor.parameters())


def stagger_episodes(env: TaskVectorEnv) -> None:
    """Let the first episodes end one after the other: every batch then has some starts."""
    episode_ticks = round(env.config.episode_s * env.machine.rate)
    ticks = np.arange(env.num_envs) * episode_ticks // env.num_envs
    low = env.state.lowest < env.machine.ground  # these end in their first tick, as always
    env.state = env.state._replace(ticks=np.where(low, 0, ticks))


class TrainingLog:
    """Curve, progress bar and checkpoints of one training."""

    bar: "tqdm[Any]"

    def __init__(self, env: TaskVectorEnv, out: Path, about: dict[str, Any]) -> None:
        self.env, self.about = env, about
        self.checkpoint = Path(f"{out}.checkpoint")
        self.curve = Path(f"{out}.csv")
        self.rows: list[dict[str, float]] = []

    def on_update(self, now: Checkpoint, rollout: Rollout, metrics: dict[str, float]) -> None:
        """Add a row to the curve; every `EVERY` updates write a checkpoint."""
        error = float(np.mean([info["velocity_error"].mean() for info in rollout.infos]))
        row = {"global_step": now.global_step, **metrics, "charts/velocity_error": error}
        self.rows.append(row)
        self.bar.update(now.global_step - self.bar.n)
        self.bar.set_postfix_str(f"error {error:.3f} m/s")
        if now.update % EVERY == 0:
            self.write_curve()
            self.save(now)

    def write_curve(self) -> None:
        """Write all rows so far."""
        write_csv(self.curve, self.rows[0], [row.values() for row in self.rows])

    def save(self, now: Checkpoint) -> None:
        """Write a checkpoint from which a training continues to the same bits."""
        arrays: list[torch.Tensor] = []
        simulation = self.env.state, self.env.memory
        map_arrays(lambda array: arrays.append(torch.tensor(array)), simulation)
        content = {
            "about": json.dumps(self.about),
            "agent": now.agent.state_dict(),
            "optimizer": now.optimizer.state_dict(),
            "obs": now.obs,
            "steps": [now.global_step, now.update],
            "torch_random": torch.get_rng_state(),
            "numpy_random": self.env.np_random.bit_generator.state,
            "arrays": arrays,
            "rows": self.rows,
        }
        buffer = io.BytesIO()
        torch.save(content, buffer)
        with whole_file(self.checkpoint) as file:
            file.write(buffer.getvalue())

    def load(self, fresh: Checkpoint) -> Checkpoint:
        """The training of the checkpoint, in place of a fresh one of the same settings.

        ValueError: no checkpoint, or one of another training, with the first difference.
        """
        with expected(self.checkpoint, "a readable checkpoint"):
            content = torch.load(self.checkpoint, weights_only=True)  # executes nothing
            expect_same(self.checkpoint, json.loads(content["about"]), self.about)
            fresh.agent.load_state_dict(content["agent"])
            fresh.optimizer.load_state_dict(content["optimizer"])
            arrays = iter(content["arrays"])
            simulation = self.env.state, self.env.memory
            self.env.state, self.env.memory = map_arrays(lambda _: next(arrays).numpy(), simulation)
            self.env.np_random.bit_generator.state = content["numpy_random"]
            torch.set_rng_state(content["torch_random"])
            self.rows = content["rows"]
            return Checkpoint(fresh.agent, fresh.optimizer, content["obs"], *content["steps"])
