"""Environment steps a second on the nets with 256 environments; ratio to the bare net products.

    python -m benchmarks.rollout [--actuator NET] [--json F]

The nets' speed does not depend on what they learned, so without NET random nets are used that
know the dead zone, as fitted ones do.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro

from brokk_min.actuator import ActuatorNet
from brokk_min.identification.net_file import load_net
from brokk_min.learning.gym_env import TaskVectorEnv
from brokk_min.machine import BROKK_170


@dataclass
class Options:
    actuator: Path | None = None
    """Nets that `brokk-min fit` wrote; without them random ones."""
    num_envs: int = 256
    """Environments side by side."""
    ticks: int = 400
    """Ticks in each of the five timed runs."""
    json: Path | None = None
    """Also write the figures here."""


def random_net(rng: np.random.Generator) -> ActuatorNet:
    m, h = BROKK_170, BROKK_170.history
    sizes = [(3 * h, 32), (32, 32), (32, 1)]
    weights = []
    for rows, columns in sizes:
        weights.append(rng.normal(0, rows**-0.5, (m.n, rows, columns)).astype(np.float32))
        weights.append(np.zeros((m.n, columns), np.float32))
    one = np.ones((m.n, 3 * h), np.float32)
    speed = m.q_dot_max.astype(np.float32)
    low, high = m.column("q_min").astype(np.float32), m.column("q_max").astype(np.float32)
    return ActuatorNet(
        m.names, h, m.rate, m.velocity_samples, False, m.name, 0, {}, 0 * one, one, -speed, speed,
        low, high, tuple(weights),
    )  # fmt: skip


def main(options: Options) -> None:
    rng = np.random.default_rng(0)
    random = replace(random_net(rng), dead_zone=BROKK_170.dead_zone)
    net = load_net(options.actuator) if options.actuator else random
    env = TaskVectorEnv(options.num_envs, net)
    env.reset(seed=0)
    actions = rng.uniform(-1, 1, (32, options.num_envs, len(env.machine.driven))).astype(np.float32)
    steps, products = [], []
    inputs = env.state.history[:, env.machine.driven]
    for _ in range(5):
        start = time.perf_counter()
        for k in range(options.ticks):
            env.step(actions[k % 32])
        steps.append(options.ticks * options.num_envs / (time.perf_counter() - start))
        start = time.perf_counter()
        for _ in range(options.ticks):
            env.net.predict(inputs)
        products.append(options.ticks * options.num_envs / (time.perf_counter() - start))
    result = {
        "num_envs": options.num_envs,
        "steps_per_second": {"median": float(np.median(steps)), "runs": steps},
        "net_products_per_second": float(np.median(products)),
        "step_over_products": float(np.median(products) / np.median(steps)),
    }
    print(json.dumps(result, indent=1))
    if options.json:
        options.json.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
