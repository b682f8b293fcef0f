"""A folder with a policy, gains, a plant, a sequence and a start."""

from dataclasses import replace

import numpy as np
import pytest
from helpers_bus import random_policy
from helpers_machines import pids

from brokk_min.evaluation import baselines
from brokk_min.learning.policy import save_policy
from brokk_min.machine import BROKK_170

SLOW = """
from brokk_min.actuator import AnalyticPlant
class Slow(AnalyticPlant):
    def step(self, machine, state, u):
        return super().step(machine, state, 0.8 * u)
PLANT = Slow()
"""


@pytest.fixture
def folder(tmp_path):
    """The policy does nothing, and the sequence lasts a second."""
    policy = random_policy("paper")
    policy = replace(policy, weights=tuple(np.zeros_like(w) for w in policy.weights))
    save_policy(tmp_path / "policy.npz", policy)
    meta = baselines.gains_metadata(BROKK_170, policy.net)
    baselines.write_gains(tmp_path / "gains.json", pids(BROKK_170, policy.net), meta)
    (tmp_path / "plant.py").write_text(SLOW)
    (tmp_path / "c.csv").write_text("sequence,time,vx,vy,vz\nup,0,0,0,0.1\nup,1,0,0,0\n")
    (tmp_path / "s.csv").write_text("q1,q2,q3,q4,q5\n0,0.5,0.58,1.71,1.24\n")
    return tmp_path
