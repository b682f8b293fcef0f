"""Environment steps per second of CPU on the nets, and their ratio to the nets' bare products.

    python -m benchmarks.rollout [--actuator NET] [--num-envs 256] [--json F]

The speed of nets does not depend on what they learned: without NET they are the shipped ones.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from benchmarks import POLICY, write
from brokk_min.identification.net_file import load_net, select_nets
from brokk_min.learning.gym_env import TaskVectorEnv
from brokk_min.learning.policy import load_policy
from brokk_min.machine import BROKK_170


@dataclass
class Options:
    actuator: Path | None = None  # Nets that `brokk-min fit` wrote; by default the shipped ones.
    num_envs: int = 256  # Environments side by side.
    ticks: int = 400  # Ticks in each of the five timed runs.
    json: Path | None = None  # Also write the figures here.


def main(options: Options) -> None:
    if options.actuator:
        net = select_nets(BROKK_170, load_net(options.actuator, BROKK_170))
    else:
        net = load_policy(POLICY, BROKK_170).net
    env = TaskVectorEnv(options.num_envs, net)
    env.reset(seed=0)
    history = env.state.plant.history
    actions = np.random.default_rng(0).uniform(-1, 1, (options.num_envs, 4)).astype(np.float32)

    def rate(call: Callable[[], object]) -> float:
        start = time.process_time()
        for _ in range(options.ticks):
            call()
        return options.ticks * options.num_envs / (time.process_time() - start)

    runs = [(rate(lambda: env.step(actions)), rate(lambda: net.predict(history))) for _ in range(5)]
    steps, products = np.median(runs, axis=0)
    result = {
        "num_envs": options.num_envs,
        "steps_per_second": {"median": float(steps), "runs": [run[0] for run in runs]},
        "net_products_per_second": float(products),
        "step_over_products": float(products / steps),
    }
    write(result, options.json)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
