"""How good a policy already is while it learns, beside the PIDs."""

from collections.abc import Callable

import numpy as np

from brokk_min.evaluation.baselines import BY_HAND, OPTIMISED, Baselines
from brokk_min.evaluation.rollout import rollout
from brokk_min.evaluation.sequences import tuning_set
from brokk_min.machine import Controller, Machine
from brokk_min.settings import TaskConfig

RUNS, SECONDS = 16, 10.0  # motions, and how long each is [s]
SEED = 1  # of the motions; the PIDs are tuned on those of seed 0, and scored ones are others


def beside_pids(machine: Machine, pids: Baselines) -> Callable[[Controller], str]:
    """A function that says a policy's mean |v_goal - v_tool| [m/s] beside those of two PIDs.

    All drive the analytic plant along the same motions, which are neither tuned on nor scored.
    """
    start, goals = tuning_set(machine, RUNS, SEED, SECONDS)

    def error(controller: Controller) -> str:
        rng = np.random.default_rng(SEED)
        trace = rollout(machine, controller, start, goals, TaskConfig.noise, rng)
        return f"{np.linalg.norm(goals - trace.v_tool, axis=-1).mean():.4f}"

    pid = f"the PID tuned by hand has {error(pids[BY_HAND])}, the optimised one"
    pid = f"{pid} {error(pids[OPTIMISED])}"
    return lambda policy: f"{error(policy)} m/s; {pid}"
