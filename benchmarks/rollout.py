"""Environment steps per second of CPU on the shipped nets, and their ratio to bare products.

    python -m benchmarks.rollout

The speed of nets does not depend on what they learned.
"""

import time
from collections.abc import Callable

import numpy as np

from benchmarks import POLICY
from brokk_min.learning.gym_env import TaskVectorEnv
from brokk_min.learning.policy import load_policy
from brokk_min.machine import BROKK_170

NUM_ENVS, TICKS = 256, 400  # environments side by side, ticks in each of the five timed runs


def rate(call: Callable[[], object]) -> float:
    """Environment steps per second of CPU, of a call that does one of each environment."""
    start = time.process_time()
    for _ in range(TICKS):
        call()
    return TICKS * NUM_ENVS / (time.process_time() - start)


def main() -> None:
    net = load_policy(POLICY, BROKK_170).net
    env = TaskVectorEnv(NUM_ENVS, net)
    env.reset(seed=0)
    history = env.state.plant.history
    actions = np.random.default_rng(0).uniform(-1, 1, (NUM_ENVS, 4)).astype(np.float32)
    runs = [(rate(lambda: env.step(actions)), rate(lambda: net.predict(history))) for _ in range(5)]
    steps, products = np.median(runs, axis=0)
    print(f"environment steps per second: {steps:.0f}")
    print(f"of the nets' bare products: {products:.0f}, {products / steps:.2f} times as many")


if __name__ == "__main__":
    main()
