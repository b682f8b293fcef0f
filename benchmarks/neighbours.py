"""How much longer a fit and a training take beside busy processes: what a student's laptop does.

    python -m benchmarks.neighbours [--busy 1] [--repeats 3]

Quiet and busy runs take turns; the ratios are of medians: of wall time, and of CPU time, which
grows where threads spin while they wait. All use one thread. On a computer that is never quiet the
wall time says little.
"""

import multiprocessing
import platform
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import tyro

from benchmarks import POLICY
from brokk_min.env import TaskConfig
from brokk_min.identification import excitation, fitting
from brokk_min.learning.checkpoint import train_policy
from brokk_min.learning.episodes import GRADIENT_LEARNER
from brokk_min.learning.policy import load_policy
from brokk_min.machine import BROKK_170 as M
from brokk_min.ppo import PPOConfig


@dataclass
class Options:
    busy: int = 1  # Processes that only count.
    repeats: int = 3  # Runs of each kind.
    train_steps: int = 200_000  # Of a training.
    fit_steps: int = 300  # Of a fit.


def spin() -> None:
    """Keep a core busy."""
    while True:
        pass


@contextmanager
def neighbours(num: int) -> Iterator[None]:
    """`num` busy processes for as long as the block runs."""
    processes = [multiprocessing.Process(target=spin, daemon=True) for _ in range(num)]
    for process in processes:
        process.start()
    yield
    for process in processes:
        process.kill()
        process.join()


def seconds(work: Callable[[], object]) -> list[float]:
    """Wall and CPU time of a call [s]."""
    start, cpu = time.perf_counter(), time.process_time()
    work()
    return [time.perf_counter() - start, time.process_time() - cpu]


def main(options: Options) -> dict[str, list[float]]:
    """Ratios of busy to quiet wall and CPU time of a training and of a fit."""
    net = load_policy(POLICY, M).net
    config = PPOConfig(**GRADIENT_LEARNER | {"total_steps": options.train_steps})
    log = excitation.collect(M, 0.05, "rich", np.random.default_rng(0))
    fit_config = fitting.FitConfig(options.fit_steps)

    result = {}
    with TemporaryDirectory() as folder:
        file = Path(folder) / "policy.npz"
        works: dict[str, Callable[[], object]] = {
            "training": lambda: train_policy(M, net, TaskConfig(), config, 0, file),
            "fit": lambda: fitting.fit(log, fit_config, 0, M.velocity_samples),
        }
        for name, work in works.items():
            quiet, busy = [], []
            for _ in range(options.repeats):
                quiet.append(seconds(work))
                with neighbours(options.busy):
                    busy.append(seconds(work))
            before, after = np.median(quiet, axis=0), np.median(busy, axis=0)
            wall, cpu = result[name] = (after / before).tolist()
            times = f"quiet {before[0]:.1f} s ({before[1]:.1f} s of CPU)"
            print(f"{name}: {times}, busy {wall:.2f} times as long ({cpu:.2f} times the CPU)")
    print(platform.processor(), multiprocessing.cpu_count(), "cores")
    return result


if __name__ == "__main__":
    main(tyro.cli(Options))
