"""The error of our agent on the machine while it learns, beside those of the PIDs.

    python -m benchmarks.curves [SEED]

Two trainings on the package's nets: the short one of `brokk-min train`, and all of the recipe. Now
and then, off the clock, the policy without its exploration drives the machine on motions that are
neither scored nor tuned on. The picture is docs/figures/learning.svg. Of the paper's observation
it prints where a short training passes the optimised PID, and its end.
"""

import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from matplotlib import pyplot as plt

import benchmarks  # before NumPy computes: one thread
from benchmarks.peers import machine_error
from brokk_min import ppo
from brokk_min.actuator import ActuatorNet
from brokk_min.cli.training import FIRST_STEPS
from brokk_min.evaluation.baselines import BY_HAND, OPTIMISED, STRONGEST, read_gains
from brokk_min.evaluation.rollout import title
from brokk_min.learning.checkpoint import actor_weights, prepare, quick_products
from brokk_min.learning.policy import Policy, load_policy
from brokk_min.learning.recipes import Recipe, find_recipe
from brokk_min.machine import BROKK_170 as M

RUNS = 32  # of 20 s, for each point
PAPER_STEPS = 7_000_000  # of 40 million: enough to be better than the optimised PID
GROWTH = 1.2  # of the steps between two points
Curve = list[tuple[float, float, float]]  # steps, seconds of CPU, error [m/s]


@quick_products()
def learn(net: ActuatorNet, recipe: Recipe, total_steps: int, seed: int) -> Curve:
    """One training."""
    recipe = replace(recipe, learner=replace(recipe.learner, total_steps=total_steps))
    env, advantages, start = prepare(M, net, recipe, seed)
    curve: Curve = []
    began = time.process_time()
    due = 20_000.0  # steps of the next point

    def on_update(now: ppo.Checkpoint, *_: Any) -> None:
        nonlocal began, due
        if now.global_step >= min(due, total_steps):
            seconds, due = time.process_time() - began, GROWTH * now.global_step
            policy = Policy(M, {}, actor_weights(now.agent), net, recipe.interface)
            curve.append((now.global_step, seconds, machine_error(policy, RUNS)))
            began = time.process_time() - seconds

    ppo.train(env, recipe.learner, seed, advantages, on_update, start)
    return curve


def draw(curves: dict[str, Curve], pids: dict[str, float], path: Path) -> None:
    """Error against steps and against seconds, beside the PIDs' lines; all is logarithmic."""
    plt.rcParams.update({"svg.hashsalt": "learning", "svg.fonttype": "none"})
    figure, both = plt.subplots(1, 2, figsize=(8, 3.4), sharey=True, layout="constrained")
    labels = ("environment steps", "seconds of one core")
    for i, (axes, label) in enumerate(zip(both, labels, strict=True)):
        for name, curve in curves.items():
            axes.plot([row[i] for row in curve], [row[2] for row in curve], ".-", label=name)
        for (name, error), line in zip(pids.items(), (":", "--", "-."), strict=True):
            axes.axhline(error, color="0.4", linestyle=line, label=name)
        axes.set(xscale="log", yscale="log", xlabel=label)
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter("{x:g}")
    both[0].set(ylabel="velocity error on the machine [m/s]")
    figure.legend(*both[0].get_legend_handles_labels(), loc="outside upper center", ncols=3)
    figure.savefig(path, metadata={"Date": None})


def main(seed: str = "0") -> None:
    net = load_policy(benchmarks.POLICY, M).net
    baselines = read_gains(benchmarks.POLICY.with_name("gains.json"), M, net)
    names = (BY_HAND, OPTIMISED, STRONGEST)
    pids = {title(name): machine_error(baselines[name], RUNS) for name in names}
    curves = {
        f"our agent, {steps:,} steps": learn(net, find_recipe(), steps, int(seed))
        for steps in (FIRST_STEPS, find_recipe().learner.total_steps)
    }
    paper = learn(net, find_recipe(paper=True), PAPER_STEPS, int(seed))
    for name, curve in (curves | {"the paper's observation": paper}).items():
        print(f"{name}: {curve[-1][2]:.4f} m/s after {curve[-1][1]:.0f} s")
        better = next(row for row in curve if row[2] < pids[title(OPTIMISED)])
        print("below the optimised PID after {:,} steps and {:.0f} s".format(*better))
    print(*(f"{name}: {error:.4f} m/s" for name, error in pids.items()), sep="\n")
    draw(curves, pids, Path(__file__).parents[1] / "docs" / "figures" / "learning.svg")


if __name__ == "__main__":
    main(*sys.argv[1:])
