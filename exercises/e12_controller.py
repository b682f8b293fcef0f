"""A controller of your own, ranked (180 minutes).

Every 50 ms a controller gets `env.Measured`: goal and measured velocity of the tool, angles,
velocities, histories, Jacobian, error integral. It returns a command for each joint. The policies,
the PIDs and yours all have this one interface, `evaluation.rollout.Controller`.

Begin with the Jacobian: joint velocities for the goal by damped least squares, then a command in
proportion, beyond the dead zone. That is ten lines. `brokk_min/env.py` lists the fields of
`Measured`. J has a column for each joint: take `J[..., machine.driven]` and `jacobian.dls`. The
velocity `machine.q_dot_max` belongs to the limit of 80/127; joint q2 is locked, its command is 0.
Then think about what the plant does: valves that have closed answer 0.3 s later; the lever arm
changes with the angle; the error of the tool is measured.

The sequences are those on which the package's PIDs were tuned, so try as often as you like. What is
scored in the README stays shut. To pass, beat the paper's learner. To be proud, beat our policy.
"""

import inspect
from collections.abc import Callable
from typing import Any

import numpy as np

from brokk_min.env import Measured, TaskConfig
from brokk_min.evaluation.baselines import read_gains
from brokk_min.evaluation.rollout import Controller, rollout
from brokk_min.evaluation.sequences import tuning_set
from brokk_min.identification.files import SHIPPED
from brokk_min.learning.policy import POLICIES, PolicyController, load_policy
from brokk_min.machine import BROKK_170, Array, Machine
from exercises.verdict import WrongAnswer

SOLUTION = "brokk_min/jacobian.py: JacobianController"
FOLDER = SHIPPED / BROKK_170.name


class Mine:
    """Your controller."""

    def __init__(self, machine: Machine) -> None:
        self.machine = machine

    def start(self, num: int) -> Any:
        """What `num` controllers keep between ticks, at rest; None: nothing."""
        return None

    def __call__(self, measured: Measured, state: Any) -> tuple[Array, Any]:
        """Commands u [-1, 1] of full command (num, n), at most 80/127, and the next state."""
        raise NotImplementedError


def opponents() -> dict[str, Controller]:
    """The shipped policies and the tuned PIDs."""
    names = ("rl", "rl_paper")
    policies = {name: load_policy(FOLDER / POLICIES[name], BROKK_170) for name in names}
    gains = read_gains(FOLDER / "gains.json", BROKK_170, policies["rl"].net)
    return {
        "our policy": PolicyController(BROKK_170, policies["rl"]),
        "PID, feed-forward, integral": gains["jacobian_pid_ff_integral"],
        "PID, k = 0.1": gains["jacobian_pid_k0.1"],
        "the paper's learner": PolicyController(BROKK_170, policies["rl_paper"]),
    }


def check(Mine: Callable[[Machine], Controller]) -> None:
    """Rank everybody on eight tuning sequences of 8 s, on the plant."""
    start, goals = tuning_set(BROKK_170, 8, seed=0, seconds=8.0)
    ranking = []
    for name, controller in {"yours": Mine(BROKK_170), **opponents()}.items():
        rng = np.random.default_rng(0)
        trace = rollout(BROKK_170, controller, start, goals, TaskConfig(), rng)
        if not np.isfinite(trace.u).all() or np.abs(trace.u).max() > 80.01 / 127:
            got = np.abs(trace.u).max()
            raise WrongAnswer(f"{name}: expected commands of at most 80/127, got {got:.3f}")
        error = float(np.linalg.norm(goals - trace.v_tool, axis=-1).mean())
        travel = float(np.abs(np.diff(trace.u, axis=0)).sum(axis=(0, 2)).mean())
        ranking.append((error, travel, name))
    print("  controller                    error [m/s]   valve travel in 8 s")
    for place, (error, travel, name) in enumerate(sorted(ranking), 1):
        print(f"{place} {name:30} {error:10.4f} {travel:14.1f}")
    if inspect.isclass(Mine):
        print(f"yours has {len(inspect.getsource(Mine.__call__).splitlines()) - 2} lines")
    errors = {name: error for error, _, name in ranking}
    if not errors["yours"] < errors["the paper's learner"]:
        wanted, got = errors["the paper's learner"], errors["yours"]
        raise WrongAnswer(f"error: expected below {wanted:.4f} m/s of the paper, got {got:.4f}")
