"""From the paper's learner to ours: what each step buys on the machine, alone and in order.

    python -m benchmarks.ladder [FOLDER] [STEPS] [SEEDS] [NAME...]

"Alone" is the paper's learner with one of `STEPS`; "in order" has the steps of all rows above it,
too. FOLDER is one of `brokk-min reproduce`, by default results; nets that are missing are fitted to
its logs. By default three seeds of one million environment steps each. NAME: only rows that begin
with it. Figures are means over x, y, z and the workspace starts; "closed" is the error with valves
that close while the tool rests.
"""

import sys
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brokk_min import actuator, env, ppo
from brokk_min.actuator import ActuatorNet
from brokk_min.env import Measured, TaskConfig, action_to_pwm, features
from brokk_min.evaluation import metrics, sequences
from brokk_min.evaluation.learn import Budget, Chain, fit_net, side_by_side
from brokk_min.identification import logs
from brokk_min.identification.fitting import PAPER_RECIPE
from brokk_min.identification.muon import Muon
from brokk_min.identification.net_file import load_net, select_nets
from brokk_min.learning.checkpoint import export_policy, stagger_episodes, use_fast_float32
from brokk_min.learning.episodes import GRADIENT_LEARNER, PAPER_TASK, get_obs, new_goals, reset
from brokk_min.learning.gym_env import Step, TaskVectorEnv
from brokk_min.learning.policy import Policy
from brokk_min.learning.simulation_gradient import improved_actions, regression_loss
from brokk_min.machine import BROKK_170 as M
from brokk_min.machine import PWM_MAX, Array

FIGURES = ("velocity_error_mean", "off_axis_drift_max", "valve_travel", "jerk_rms")
STEPS = {
    "fit": "rich excitation, multi-step fit",
    "mu_law": "nets read commands by the mu law",
    "observation": "error integral, resolved rates, heading frame",
    "actions": "actions from the dead zone on",
    "costs": "costs of valve travel and error integral",
    "episodes": "starts, ends, goals; valves closed at rest",
    "gradients": "gradients of the simulation, not a critic",
    "muon": "Muon, not Adam; twice the cost of valve travel",
}
RUNGS = {"the paper's learner": frozenset[str]()}
RUNGS |= {f"alone: {text}": frozenset([name]) for name, text in STEPS.items()}
RUNGS |= {
    f"in order: {text}": frozenset(list(STEPS)[: i + 1])
    for i, text in enumerate(STEPS.values())
    if i
}
NETS: dict[frozenset[str], tuple[str, str, dict[str, Any]]] = {  # steps -> file, log, recipe
    frozenset(): ("net_paper", "log_paper", PAPER_RECIPE),
    frozenset(["fit"]): ("net_plain", "log", {"dead_zone": 0.0, "muon": 0.0}),
    frozenset(["mu_law"]): ("net_mu_law", "log_paper", PAPER_RECIPE | {"dead_zone": M.dead_zone}),
    frozenset(["fit", "mu_law"]): ("net_adam", "log", {"muon": 0.0}),
    frozenset(["fit", "mu_law", "muon"]): ("net_muon", "log", {}),
}
PAPER = TaskConfig(paper=True, **PAPER_TASK)
GROUNDLESS = replace(M, ground=-1e9)


def task_of(steps: frozenset[str]) -> TaskConfig:
    """Costs and valves of our task, each only if the step is taken."""
    task = TaskConfig(valves="closed" if "episodes" in steps else "open")
    if "costs" not in steps:
        return replace(task, valve_cost=0.0, integral_cost=0.0)
    return task if "muon" in steps else replace(task, valve_cost=task.valve_cost / 2)


def our_action(action: Array) -> Array:
    """Actions (..., n_driven) that give, from the dead zone on, what linear ones give."""
    beyond = M.pwm_limit / PWM_MAX - M.dead_zone
    u = np.abs(action) * M.pwm_limit / PWM_MAX
    crossing = u / (M.dead_zone / env.COMPENSATION + beyond)
    size = np.where(crossing < env.COMPENSATION, crossing, (u - M.dead_zone) / beyond)
    return np.asarray(np.copysign(size, action), action.dtype)


class MixedEnv(TaskVectorEnv):
    """The task with some steps from the paper's to ours."""

    def __init__(self, net: ActuatorNet, steps: frozenset[str], num_envs: int = 256) -> None:
        super().__init__(num_envs, net, M, TaskConfig(paper="observation" not in steps))
        self.steps = steps
        self.episodes = TaskConfig() if "episodes" in steps else PAPER

    def step_without_reset(self, actions: Array) -> Step:
        """One tick; the paper's episodes end in the ground in their first tick only."""
        before = self.state
        assert before is not None
        ours = "episodes" in self.steps
        actions = actions if "actions" in self.steps else our_action(actions)
        state, reward, end, truncated, error = env.step(
            M if ours else GROUNDLESS, task_of(self.steps), self.net, before, actions
        )
        if not ours:
            end = env.terminated(M, state.lowest) & (state.ticks == 1)
        self.state = new_goals(M, self.episodes, state, self.np_random)
        obs = get_obs(M, self.config, self.state, self.np_random)
        info = {"state": before, "velocity_error": error}
        return obs, np.where(end, 0.0, reward), end, truncated & ~end, info

    def _new_episodes(self, num: int) -> env.State:
        return reset(M, self.episodes, self.np_random, num, plant=False)


@dataclass(frozen=True)
class MixedController:
    """A policy of `MixedEnv` on the machine."""

    policy: Policy
    steps: frozenset[str]
    valves: str

    def start(self, num: int) -> NDArray[np.int64]:
        """Ticks for which the goal has been zero, (num,)."""
        return np.zeros(num, np.int64)

    def __call__(
        self, measured: Measured, ticks: NDArray[np.int64]
    ) -> tuple[Array, NDArray[np.int64]]:
        """As `PolicyController`."""
        action = self.policy.act(features(M, measured, "observation" not in self.steps))
        u = action_to_pwm(M, action, "actions" not in self.steps)
        u, _, ticks = actuator.command_at_rest(M, self.valves, u, measured.v_goal, ticks)
        return u, ticks


def nets_of(folder: Path, steps: frozenset[str]) -> ActuatorNet:
    """Nets of the driven joints, from the folder or fitted to its log."""
    key = steps & {"fit", "mu_law", "muon"}
    name, log, recipe = NETS[key if key in NETS else key - {"muon"}]
    file = folder / f"{name}.npz"
    if not file.exists():
        recorded = logs.read_log([folder / f"{log}.npz"], M.velocity_samples, rate=M.rate)
        fit_net(Chain(M, folder, Budget(), 0), name, recorded, recipe)
    return select_nets(M, load_net(file, M))


def train(net: ActuatorNet, steps: frozenset[str], total_steps: int, seed: int) -> Policy:
    """A new policy."""
    gradients = "gradients" in steps
    settings = {**(GRADIENT_LEARNER if gradients else {}), "total_steps": total_steps}
    config = ppo.PPOConfig(**settings)
    use_fast_float32()
    task_env = MixedEnv(net, steps)
    learner = ppo.make_learner(task_env, config, seed, critic=not gradients)
    if "muon" in steps:
        learner.optimizer = Muon(learner.agent.parameters(), config.learning_rate)
    stagger_episodes(task_env)
    estimate, loss = None, ppo.ppo_loss
    if gradients:
        task = replace(task_of(steps), paper="actions" not in steps)
        estimate, loss = improved_actions(M, net, task), regression_loss
    agent = ppo.train(
        task_env, config, seed, estimate=estimate, loss_function=loss, learner=learner
    )
    return export_policy(net, agent, task_env.config, {})


def climb(folder: Path, name: str, total_steps: int, seed: int) -> list[float]:
    """`FIGURES` of one new policy on the machine, and its error with closed valves."""
    steps = RUNGS[name]
    policy = train(nets_of(folder, steps), steps, total_steps, seed)
    axes = sequences.axis_sequences(M)
    starts = sequences.workspace_starts(M, 64)
    both = {v: MixedController(policy, steps, v) for v in (task_of(steps).valves, "closed")}
    runs, _ = metrics.evaluate(M, both, axes, starts, 0)
    table = metrics.summary(runs)
    figures = [table[task_of(steps).valves]["all"][key] for key in FIGURES]
    return [float(x or 0.0) for x in [*figures, table["closed"]["all"][FIGURES[0]]]]


def main(folder: str = "results", steps: str = "1000000", seeds: str = "3", *names: str) -> None:
    rungs = [rung for rung in RUNGS if rung.startswith(names or "")]
    for rung in rungs:  # before the jobs, which would fit them at once
        nets_of(Path(folder), RUNGS[rung])
    jobs = {
        (rung, seed): partial(climb, Path(folder), rung, int(steps), seed)
        for rung in rungs
        for seed in range(int(seeds))
    }
    results = dict(
        zip(jobs, side_by_side({str(k): job for k, job in jobs.items()}, {}), strict=True)
    )
    columns = [*FIGURES, "closed"]
    print(f"{'means of seeds (largest less smallest)':56}", *(f"{key:>22}" for key in columns))
    for rung in rungs:
        figures = np.array([results[rung, seed] for seed in range(int(seeds))])
        spread = np.ptp(figures, axis=0)
        cells = [f"{m:.4f} ({s:.4f})" for m, s in zip(figures.mean(axis=0), spread, strict=True)]
        print(f"{rung:56}", *(f"{cell:>22}" for cell in cells))


if __name__ == "__main__":
    main(*sys.argv[1:])
