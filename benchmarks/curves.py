"""Errors on the machine while agents learn: a critic, and groups of rollouts.

    python -m benchmarks.curves [FOLDER] [SEED]

FOLDER is one of `brokk-min reproduce`, by default results; all agents learn on its net.npz. Now and
then, off the clock, the policy without its exploration drives the machine on goals that are never
scored. The curves go to curves_SEED.json in FOLDER, and are drawn from there if it exists. The
picture is docs/figures/learning.svg; it has the 2.5 hours of the paper as a line.
"""

import json
import math
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import torch
from matplotlib import pyplot as plt

import benchmarks  # noqa: F401, before NumPy computes: one thread
from benchmarks.peers import machine_error
from brokk_min import ppo
from brokk_min._files import write_json
from brokk_min.identification.net_file import load_net
from brokk_min.learning.checkpoint import actor_weights, prepare
from brokk_min.learning.jobs import side_by_side
from brokk_min.learning.policy import Policy
from brokk_min.learning.recipes import find_recipe
from brokk_min.machine import BROKK_170 as M

AGENTS = {
    "critic, the paper's observation": find_recipe(paper=True, critic=True),
    "groups, the paper's observation": find_recipe(paper=True),
    "groups, our observation": find_recipe(),
}
POINTS = 50  # of a curve
RUNS = 32  # of 20 s, for each point
PAPER_HOURS = 2.5


def learn(name: str, folder: Path, seed: int) -> list[dict[str, float]]:
    """One training: steps, hours of CPU, and the error on the machine [m/s], point by point."""
    torch.set_num_threads(1)
    recipe, net = AGENTS[name], load_net(folder / "net.npz", M)
    env, advantages, start = prepare(M, net, recipe, seed)
    learner = recipe.learner
    updates = math.ceil(learner.total_steps / (learner.num_envs * learner.horizon))
    rows: list[dict[str, float]] = []
    began = time.process_time()

    def on_update(now: ppo.Checkpoint, *_: Any) -> None:
        nonlocal began
        if now.update % max(1, updates // POINTS) == 0 or now.update == updates:
            hours = (time.process_time() - began) / 3600
            policy = Policy(M, {}, actor_weights(now.agent), net, recipe.interface)
            error = machine_error(policy, RUNS)
            rows.append({"steps": now.global_step, "hours": hours, "error": error})
            began = time.process_time() - 3600 * hours

    ppo.train(env, recipe.learner, seed, advantages, on_update, start)
    return rows


def draw(curves: dict[str, list[dict[str, float]]], path: Path) -> None:
    """Error against steps and against hours of one core, all logarithmic."""
    plt.rcParams.update({"svg.hashsalt": "learning", "svg.fonttype": "none"})
    figure, both = plt.subplots(1, 2, figsize=(8, 3.4), sharey=True, layout="constrained")
    labels = {"steps": "environment steps", "hours": "hours of one core"}
    for axes, (x, label) in zip(both, labels.items(), strict=True):
        for name, rows in curves.items():
            axes.plot([row[x] for row in rows], [row["error"] for row in rows], ".-", label=name)
        axes.set(xscale="log", yscale="log", ylim=(0.01, None), xlabel=label)
    axes.axvline(PAPER_HOURS, color="gray", linestyle=":", label="the paper's training")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter("{x:g}")
    both[0].set(ylabel="velocity error on the machine [m/s]")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=2)
    figure.savefig(path, metadata={"Date": None})


def main(folder: str = "results", seed: str = "0") -> None:
    file = Path(folder) / f"curves_{seed}.json"
    if not file.exists():
        jobs = {name: partial(learn, name, Path(folder), int(seed)) for name in AGENTS}
        write_json(file, side_by_side(jobs))
    curves = json.loads(file.read_text())
    for name, rows in curves.items():
        print(f"{name}: {rows[-1]['error']:.4f} m/s after {rows[-1]['hours']:.2f} h")
    draw(curves, Path(__file__).parents[1] / "docs" / "figures" / "learning.svg")


if __name__ == "__main__":
    main(*sys.argv[1:])
