"""What a step of training costs, in microseconds of CPU, on the shipped nets.

    python -m benchmarks.rollout

A step is one tick of one machine, collected and learned. The times do not depend on what nets and
agents have learned. ONEDNN_MAX_CPU_ISA=AVX2 shows a processor without bfloat16 units.
"""

import time
from collections.abc import Callable

import numpy as np
import torch

from benchmarks import POLICY
from brokk_min import ppo
from brokk_min.beyond.muon import Muon
from brokk_min.learning.checkpoint import prepare, quick_products
from brokk_min.learning.policy import load_policy
from brokk_min.learning.recipes import Recipe, find_recipe
from brokk_min.machine import BROKK_170 as M

RUNS = 15  # of which the median is printed


def seconds(call: Callable[[], object]) -> float:
    """CPU of a call, the median of `RUNS`."""
    times = []
    for _ in range(RUNS):
        start = time.process_time()
        call()
        times.append(time.process_time() - start)
    return float(np.median(times))


@quick_products()
def training(recipe: Recipe) -> list[float]:
    """Microseconds a step: environment, collection (which includes it), update."""
    net = load_policy(POLICY, M).net
    env, advantages, start = prepare(M, net, recipe, 0)
    config, agent = recipe.learner, start.agent
    if config.log_std_end is not None:
        agent.log_std.data.fill_(config.log_std)
    rollout, obs = ppo.collect_rollout(env, agent, start.obs, config.horizon)
    found, _ = advantages(agent, rollout, config)
    batch = {"obs": rollout.obs, "actions": rollout.actions, "logprobs": rollout.logprobs}
    batch["advantages"] = found
    actions = rollout.actions[0].numpy().clip(-1, 1)
    of_env = seconds(lambda: env.step(actions)) / env.num_envs
    collected = seconds(lambda: ppo.collect_rollout(env, agent, obs, config.horizon))
    learned = seconds(lambda: ppo.improve(agent, start.optimizer, batch, config))
    return [1e6 * of_env, *(1e6 * x / rollout.rewards.numel() for x in (collected, learned))]


def muon_step(ours: bool) -> float:
    """Milliseconds of one step of the actor's matrices, by our Muon or by torch's."""
    agent = ppo.Agent(91, 4, -1.0)
    matrices = [weight for weight in agent.actor.parameters() if weight.ndim == 2]
    for weight in matrices:
        weight.grad = torch.randn(weight.shape)
    optimizer = Muon(matrices, 1e-3) if ours else torch.optim.Muon(matrices, 1e-3)
    return 1e3 * seconds(optimizer.step)


def main() -> None:
    print(f"{'us a step':28} environment  collection  update")
    for name, paper in (("our agent", False), ("the paper's observation", True)):
        print(f"{name:28}" + "".join(f"{x:12.1f}" for x in training(find_recipe(paper))))
    single, half = muon_step(True), muon_step(False)
    print(f"a step of Muon: {single:.1f} ms, by torch.optim in bfloat16 {half:.1f} ms")


if __name__ == "__main__":
    main()
