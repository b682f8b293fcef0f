"""Environment steps per second on the nets, and their ratio to the bare products of the nets.

    python -m benchmarks.rollout [--actuator NET] [--num-envs 256] [--json F]

The speed of nets does not depend on what they learned: without NET they have random weights and the
machine's dead zone.
"""

from __future__ import annotations

import json
import re
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from brokk_min.actuator import ActuatorNet
from brokk_min.identification.net_file import load_net
from brokk_min.learning.gym_env import TaskVectorEnv
from brokk_min.machine import BROKK_170


@dataclass
class Options:
    actuator: Path | None = None  # Nets that `brokk-min fit` wrote; by default random ones.
    num_envs: int = 256  # Environments side by side.
    ticks: int = 400  # Ticks in each of the five timed runs.
    json: Path | None = None  # Also write the figures here.


def random_net(rng: np.random.Generator, dead_zone: float = 0.0) -> ActuatorNet:
    """One net per joint, with random weights."""
    m = BROKK_170
    inputs = 3 * m.history
    weights = []
    for rows, columns in ((inputs, 32), (32, 32), (32, 1)):
        weights.append(rng.normal(0, rows**-0.5, (m.n, rows, columns)).astype(np.float32))
        weights.append(np.zeros((m.n, columns), np.float32))
    q_dot_max = m.q_dot_max.astype(np.float32)
    return ActuatorNet(
        joints=m.names,
        history=m.history,
        rate=m.rate,
        velocity_samples=m.velocity_samples,
        velocity_logged=False,
        machine=m.name,
        seed=0,
        settings={},
        input_mean=np.zeros((m.n, inputs), np.float32),
        input_scale=np.ones((m.n, inputs), np.float32),
        output_low=-q_dot_max,
        output_high=q_dot_max,
        q_low=m.column("q_min").astype(np.float32),
        q_high=m.column("q_max").astype(np.float32),
        weights=tuple(weights),
        dead_zone=dead_zone,
    )


def main(options: Options) -> None:
    rng = np.random.default_rng(0)
    net = random_net(rng, BROKK_170.dead_zone)
    env = TaskVectorEnv(options.num_envs, load_net(options.actuator) if options.actuator else net)
    env.reset(seed=0)
    assert env.state is not None and env.net is not None
    actions = rng.uniform(-1, 1, (32, options.num_envs, 4)).astype(np.float32)
    history = env.state.history[:, env.machine.driven]
    steps = []
    products = []
    for _ in range(5):
        start = time.perf_counter()
        for k in range(options.ticks):
            env.step(actions[k % 32])
        steps.append(options.ticks * options.num_envs / (time.perf_counter() - start))
        start = time.perf_counter()
        for _ in range(options.ticks):
            env.net.predict(history)
        products.append(options.ticks * options.num_envs / (time.perf_counter() - start))
    result = {
        "num_envs": options.num_envs,
        "steps_per_second": {"median": float(np.median(steps)), "runs": steps},
        "net_products_per_second": float(np.median(products)),
        "step_over_products": float(np.median(products) / np.median(steps)),
    }
    write(result, options.json)


def memory(process: int | str = "self") -> float:
    """Resident memory of a process [MB] (Linux)."""
    status = Path(f"/proc/{process}/status").read_text()
    return int(re.findall(r"VmRSS:\s+(\d+)", status)[0]) / 1e3


def write(result: object, path: Path | None) -> None:
    """Print a result, and write it to a file."""
    text = json.dumps(result, indent=1)
    print(text)
    if path:
        path.write_text(text + "\n")


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
