"""From the paper's learner to ours, step by step: what buys how much on the machine.

    python -m benchmarks.ladder [FOLDER] [STEPS] [SEEDS]

Each row has all the changes of the rows above it. FOLDER is one of `brokk-min reproduce`, with both
nets; by default results. By default three seeds of two million steps each.
"""

import sys
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks import new_policy
from brokk_min.env import TaskConfig
from brokk_min.evaluation import metrics, sequences
from brokk_min.evaluation.reproduce import side_by_side
from brokk_min.identification.net_file import load_net
from brokk_min.learning.episodes import PAPER_TASK
from brokk_min.learning.policy import PolicyController
from brokk_min.machine import BROKK_170

FIGURES = ("velocity_error_mean", "off_axis_drift_max", "valve_travel", "jerk_rms")
PAPER = TaskConfig(paper=True, **PAPER_TASK)
NO_COST = TaskConfig(valve_cost=0.0, integral_cost=0.0)
RUNGS = {  # nets, task, critic
    "the paper's learner and nets": ("net_paper", PAPER, True),
    "our nets": ("net", PAPER, True),
    "our observation, actions, starts": ("net", NO_COST, True),
    "costs of valves and error integral": ("net", TaskConfig(), True),
    "gradients of the simulation, our settings": ("net", TaskConfig(), False),
    "valves open at rest": ("net", TaskConfig(valves="open"), False),
}


def climb(folder: Path, name: str, steps: int, seed: int) -> list[float]:
    """`FIGURES` of one new policy on the machine, means over x, y, z and 32 workspace starts."""
    nets, task, critic = RUNGS[name]
    net = load_net(folder / f"{nets}.npz", BROKK_170)
    policy = new_policy(net, task, critic, steps, seed)
    axes = sequences.axis_sequences(BROKK_170)
    starts = sequences.evaluation_starts(BROKK_170, 64, sequences.task_sequences(BROKK_170), 2)
    starts = starts[np.array(sequences.start_kinds(BROKK_170, starts)) == "workspace"]
    rl = {"rl": PolicyController(BROKK_170, policy)}
    runs, _ = metrics.evaluate(BROKK_170, rl, axes, starts, 0)
    return [float(np.mean([run[key] for run in runs])) for key in FIGURES]


def main(folder: str = "results", steps: str = "2000000", seeds: str = "3") -> None:
    jobs = {
        (name, seed): partial(climb, Path(folder), name, int(steps), seed)
        for name in RUNGS
        for seed in range(int(seeds))
    }
    results = dict(
        zip(jobs, side_by_side({str(k): job for k, job in jobs.items()}, {}), strict=True)
    )
    print(f"{'means of seeds, largest less smallest':44}", *(f"{key:>26}" for key in FIGURES))
    for name in RUNGS:
        figures = np.array([results[name, seed] for seed in range(int(seeds))])
        spread = np.ptp(figures, axis=0)
        cells = [f"{m:.4f} ({s:.4f})" for m, s in zip(figures.mean(axis=0), spread, strict=True)]
        print(f"{name:44}", *(f"{cell:>26}" for cell in cells))


if __name__ == "__main__":
    main(*sys.argv[1:])
