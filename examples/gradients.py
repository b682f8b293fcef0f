"""Analytic gradients beat PPO: the same nets, network, environment and steps, scored on the plant.

    python -m examples.gradients [STEPS]

"gradients" moves the mean actions along the derivative of the discounted rewards, backwards through
the nets, and regresses the policy to them (`brokk_min.learning.simulation_gradient`). "PPO" has the
same 256 environments and windows of 32 ticks, a critic and GAE. Settings that are not printed are
defaults of `brokk_min.ppo.PPOConfig`, found by a search for PPO.
"""

import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from brokk_min.env import TaskConfig
from brokk_min.evaluation.rollout import rollout
from brokk_min.evaluation.sequences import tuning_set
from brokk_min.identification.files import SHIPPED
from brokk_min.learning.checkpoint import train_policy
from brokk_min.learning.episodes import GRADIENT_LEARNER
from brokk_min.learning.policy import PolicyController, load_policy
from brokk_min.machine import BROKK_170 as M
from brokk_min.ppo import PPOConfig

LEARNERS = {"gradients": GRADIENT_LEARNER, "PPO": {"learning_rate": 6e-4}}


def main(steps: int = 131_072) -> dict[str, float]:
    """Print seconds of CPU and the mean velocity error [m/s] of each learner; return the errors."""
    net = load_policy(SHIPPED / M.name / "policy.npz", M).net
    start, goals = tuning_set(M, 16, seed=1)
    errors = {}
    for name, settings in LEARNERS.items():
        config = PPOConfig(**settings | {"total_steps": steps})
        begin = time.process_time()
        with TemporaryDirectory() as folder:
            file = Path(folder) / "policy.npz"
            policy = train_policy(M, net, TaskConfig(), config, 0, file, critic=name == "PPO")
        seconds = time.process_time() - begin
        controller = PolicyController(M, policy)
        trace = rollout(M, controller, start, goals, TaskConfig(), np.random.default_rng(0))
        errors[name] = float(np.linalg.norm(goals - trace.v_tool, axis=-1).mean())
        print(f"{name}: {errors[name]:.4f} m/s after {seconds:.1f} s of CPU, {settings}")
    return errors


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
