"""Training of a policy with files: a checkpoint, a learning curve, and the policy at the end."""

import io
import json
import math
import os
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.vector import VectorEnv
from tqdm import tqdm

from brokk_min import ppo
from brokk_min._files import expect_same, expected, made_with, whole_file, write_csv
from brokk_min.actuator import ActuatorNet
from brokk_min.beyond.group_advantages import GroupVectorEnv, group_advantages
from brokk_min.beyond.muon import muon
from brokk_min.env import map_arrays
from brokk_min.identification.net_file import fingerprint
from brokk_min.learning.gym_env import TaskVectorEnv
from brokk_min.learning.policy import INTERFACES, Policy, contract, save_policy
from brokk_min.learning.recipes import Recipe
from brokk_min.machine import Machine, require
from brokk_min.ppo import Agent, Checkpoint, Rollout

EVERY = 50  # updates between two checkpoints
LOOKS = 10  # at the policy in a training
Curve = list[dict[str, float]]  # of a learning curve
Env = VectorEnv[Any, Any, Any]  # a `TaskVectorEnv`, or groups in one


@contextmanager
def quick_products() -> Iterator[None]:
    """Matrix products by oneDNN, on one thread, because several wait in vain on busy cores.

    MKL, torch's first choice, uses AVX-512 on Intel's processors alone, and oneDNN on AMD's, too.
    Only "medium" lets torch choose it. That would also allow bfloat16 on AMX, which is therefore
    hidden before the first product of the process: products stay in single precision.
    """
    torch.set_num_threads(1)
    os.environ.setdefault("ONEDNN_MAX_CPU_ISA", "AVX512_CORE_BF16")  # read at the first product
    before = torch.get_float32_matmul_precision()
    if torch.backends.cpu.get_cpu_capability() == "AVX512":
        torch.set_float32_matmul_precision("medium")
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


@quick_products()
def train_policy(
    machine: Machine,
    net: ActuatorNet,
    recipe: Recipe,
    seed: int,
    out: Path,
    look: Callable[[Policy], str] | None = None,
) -> Policy:
    """Train a policy on the nets of the driven joints and write it to `out`.

    The same `seed` gives the same bits on the same computer. `<out>.checkpoint` and the curve
    `<out>.csv` lie next to the policy. Where a checkpoint exists, the training goes on from it, and
    the result is the same as without the break. Ten times what `look` says of the policy without
    its exploration is printed. ValueError: a checkpoint of another training, one that another goes
    on with, or a loss that is not finite.
    """
    about: dict[str, Any] = {"contract": contract(machine, recipe.interface)}
    about |= {"actuator": fingerprint(net), "seed": seed, "recipe": asdict(recipe)}
    speeds = [[joint.q_dot_up, joint.q_dot_down] for joint in machine.joints]
    goals = {"tool_speed": machine.tool_speed, "ground": machine.ground, "speeds": speeds}
    config, checkpoint = recipe.learner, Path(f"{out}.checkpoint")
    env, advantages, start = prepare(machine, net, recipe, seed)
    updates = math.ceil(config.total_steps / (config.num_envs * config.horizon))
    rows: Curve = []
    ours = written(checkpoint)
    if checkpoint.exists() and checkpoint.stat().st_size:
        start, rows = load(checkpoint, about | goals, env, start)

    def policy_of(agent: Agent) -> Policy:
        training = about | {"made_with": made_with()}
        return Policy(machine, training, actor_weights(agent), net, recipe.interface)

    def on_update(now: Checkpoint, rollout: Rollout, metrics: dict[str, float]) -> None:
        nonlocal ours
        error = float(np.mean([info["velocity_error"].mean() for info in rollout.infos]))
        rows.append({"global_step": now.global_step, **metrics, "charts/velocity_error": error})
        bar.update(now.global_step - bar.n)
        bar.set_postfix_str(f"error {error:.3f} m/s")
        if look and now.update % max(1, updates // LOOKS) == 0:
            told = f"{now.global_step:,} steps: {look(policy_of(now.agent))}"
            with suppress(OSError):  # nobody reads on, as after `| head`
                bar.write(told)
        if now.update % EVERY == 0 or now.global_step >= config.total_steps:
            alone = written(checkpoint) in (0, ours)
            require(alone, str(checkpoint), "one training with this name", "another, which goes on")
            save(checkpoint, about | goals, env, now, rows)
            write_csv(Path(f"{out}.csv"), rows[0], [row.values() for row in rows])
            ours = written(checkpoint)

    size: dict[str, Any] = {"total": config.total_steps, "initial": start.global_step}
    with tqdm(desc="train", **size, unit="step", unit_scale=True, disable=None) as bar:
        agent = ppo.train(env, config, seed, advantages, on_update, start)
    policy = policy_of(agent)
    save_policy(out, policy)
    checkpoint.unlink(missing_ok=True)
    return policy


def written(path: Path) -> int:
    """When a file was written [ns]; 0: there is none."""
    return path.stat().st_mtime_ns if path.exists() else 0


def prepare(
    machine: Machine, net: ActuatorNet, recipe: Recipe, seed: int
) -> tuple[Env, ppo.Advantages, Checkpoint]:
    """The environments of a recipe, its advantages, and the beginning of its training."""
    config = recipe.learner
    interface = INTERFACES[recipe.interface]
    env: Env = TaskVectorEnv(config.num_envs, net, machine, recipe.task, interface)
    advantages: ppo.Advantages = ppo.critic_advantages
    if not recipe.critic:
        env, advantages = GroupVectorEnv(env, config.horizon), group_advantages
    start = ppo.begin(env, config, seed)
    if recipe.muon:
        start = start._replace(optimizer=muon(start.agent, config))
    stagger_episodes(env)
    return env, advantages, start


def actor_weights(agent: Agent) -> tuple[np.ndarray, ...]:
    """w (inputs, outputs) and b of each layer of the actor."""
    return tuple(weight.detach().numpy().T.copy() for weight in agent.actor.parameters())


def stagger_episodes(env: Env) -> None:
    """Let the first episodes end one after the other: every batch then has some starts."""
    inner: Any = env.unwrapped
    machine, state = inner.task.machine, inner.episodes.state
    episode_ticks = round(inner.task.config.episode_s * machine.rate)
    ticks = np.arange(env.num_envs) * episode_ticks // env.num_envs
    low = state.lowest < machine.ground  # these end in their first tick, as always
    state = state._replace(ticks=np.where(low, 0, ticks))
    inner.episodes = inner.episodes._replace(state=state)


def save(path: Path, about: dict[str, Any], env: Env, now: Checkpoint, rows: Curve) -> None:
    """Write a checkpoint from which a training continues to the same bits."""
    arrays: list[torch.Tensor] = []
    inner: Any = env.unwrapped
    map_arrays(lambda array: arrays.append(torch.tensor(array)), inner.episodes)
    content = {
        "about": json.dumps(about),
        "agent": now.agent.state_dict(),
        "optimizer": now.optimizer.state_dict(),
        "obs": now.obs,
        "progress": [now.global_step, now.update, now.learning_rate],
        "torch_random": torch.get_rng_state(),
        "numpy_random": inner.np_random.bit_generator.state,
        "arrays": arrays,
        "rows": rows,
    }
    buffer = io.BytesIO()  # torch would not say that a disk is full
    torch.save(content, buffer)
    with whole_file(path) as file:
        file.write(buffer.getvalue())


def load(
    path: Path, about: dict[str, Any], env: Env, fresh: Checkpoint
) -> tuple[Checkpoint, Curve]:
    """The training of a checkpoint and its curve, in place of a fresh one of the same settings."""
    with expected(path, "a readable checkpoint"):
        require(
            zipfile.is_zipfile(path), str(path), "a readable checkpoint", "a part of one, or none"
        )
        content = torch.load(path, weights_only=True)  # executes nothing
        expect_same(path, json.loads(content["about"]), about)
        fresh.agent.load_state_dict(content["agent"])
        fresh.optimizer.load_state_dict(content["optimizer"])
        arrays = iter(content["arrays"])
        inner: Any = env.unwrapped
        inner.episodes = map_arrays(lambda _: next(arrays).numpy(), inner.episodes)
        inner.np_random.bit_generator.state = content["numpy_random"]
        torch.set_rng_state(content["torch_random"])
        now = Checkpoint(fresh.agent, fresh.optimizer, content["obs"], *content["progress"])
        return now, content["rows"]
