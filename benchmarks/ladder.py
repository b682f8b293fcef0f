"""From the paper's agent to ours: what each step buys on the machine, alone and in order.

    python -m benchmarks.ladder [FOLDER] [STEPS] [SEEDS]

"Alone" is the paper's agent with one of `STEPS`, and with a critic unless the step is groups; "in
order" has the steps of all rows above it, too. FOLDER is one of `brokk-min reproduce`, by default
results; its nets are those that the policies learn on. By default three seeds of one million
environment steps each. Figures are means over x, y, z and the starts; valve travel is the sum of
all changes of commands, in full commands.
"""

import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import benchmarks  # noqa: F401, before NumPy computes: one thread
from brokk_min import env
from brokk_min.actuator import PLANT, ActuatorNet, Plant
from brokk_min.beyond.interface import OurInterface
from brokk_min.evaluation import metrics, sequences
from brokk_min.identification.net_file import load_net
from brokk_min.learning import policy
from brokk_min.learning.checkpoint import train_policy
from brokk_min.learning.jobs import side_by_side
from brokk_min.learning.recipes import Recipe, find_recipe
from brokk_min.machine import BROKK_170 as M
from brokk_min.settings import PPOConfig

FIGURES = ("velocity_error_mean", "off_axis_drift_max", "valve_travel", "jerk_rms")
STEPS = {
    "groups": "groups of rollouts, not a critic",
    "nets": "rich excitation, multi-step fit, five nets a joint that read what a command opens",
    "observation": "half of the history, error integral, resolved rates, open valves",
    "command": "actions from the dead zone on, valves wider at starts, closed at rest",
    "cost": "costs of large commands, valve travel and error integral",
    "settings": "our settings of task and learner, and Muon",
}
BY_ADAM = PPOConfig(gamma=0.95, gae_lambda=1.0, log_std_end=-4.2)  # of groups without our settings
RUNGS = {"the paper's agent": frozenset[str]()}
RUNGS |= {f"alone: {text}": frozenset([k]) for k, text in STEPS.items() if k != "settings"}
RUNGS |= {
    f"in order: {text}": frozenset(list(STEPS)[: i + 1])
    for i, text in enumerate(STEPS.values())
    if i
}


def interface_of(steps: frozenset[str]) -> env.Interface:
    """The paper's interface with those parts of ours that the steps name."""
    if not steps & {"observation", "command", "cost"}:
        return env.PAPER
    observation = {"scale", "observe"} if "observation" in steps else set()
    ours = {"remember"} | observation | (steps & {"command", "cost"})
    return type("Mixed", (env.Interface,), {name: vars(OurInterface)[name] for name in ours})()


def climb(name: str, nets: dict[str, ActuatorNet], total_steps: int, seed: int) -> list[float]:
    """`FIGURES` of one new policy on the machine."""
    steps = RUNGS[name]
    policy.INTERFACES[name] = interface_of(steps)  # of this process
    ours, critic = "settings" in steps, "groups" not in steps
    recipe = find_recipe(paper=not ours, critic=critic)
    learner = recipe.learner if ours or critic else BY_ADAM
    learner = replace(learner, total_steps=total_steps)
    recipe = replace(recipe, interface=name, learner=learner, muon=ours)
    net = nets["net" if "nets" in steps else "net_paper"]
    return figures(train(net, recipe, seed), PLANT)


def train(net: ActuatorNet, recipe: Recipe, seed: int) -> policy.Policy:
    """A new policy that learned on the nets; its file and its curve are not kept."""
    with TemporaryDirectory() as folder:
        return train_policy(M, net, recipe, seed, Path(folder) / "policy.npz")


def figures(trained: policy.Policy, plant: Plant) -> list[float]:
    """`FIGURES` of a policy on a plant: means over x, y, z and 32 starts."""
    starts = sequences.evaluation_starts(M, 32, sequences.task_sequences(M), 2)
    axes = sequences.axis_sequences(M)
    runs, _ = metrics.evaluate(M, {"rl": trained}, axes, starts, 0, plant)
    return [float(np.mean([run[key] for run in runs if run[key] is not None])) for key in FIGURES]


def main(folder: str = "results", steps: str = "1000000", seeds: str = "3") -> None:
    files = {name: Path(folder) / f"{name}.npz" for name in ("net", "net_paper")}
    nets = {name: load_net(file, M) for name, file in files.items()}
    jobs = {
        f"{rung}, seed {seed}": partial(climb, rung, nets, int(steps), seed)
        for rung in RUNGS
        for seed in range(int(seeds))
    }
    results = np.array(list(side_by_side(jobs).values()))
    results = results.reshape(len(RUNGS), int(seeds), len(FIGURES))
    print(f"{'means of seeds (largest less smallest)':76}", *(f"{key:>22}" for key in FIGURES))
    for rung, of_seeds in zip(RUNGS, results, strict=True):
        pairs = zip(of_seeds.mean(axis=0), np.ptp(of_seeds, axis=0), strict=True)
        cells = [f"{mean:.4f} ({spread:.4f})" for mean, spread in pairs]
        print(f"{rung:76}", *(f"{cell:>22}" for cell in cells))


if __name__ == "__main__":
    main(*sys.argv[1:])
