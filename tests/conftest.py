"""Hypothesis profiles: `ci` repeats itself bit for bit, `dev` explores, `deep` for long."""

import os

import pytest
from hypothesis import HealthCheck, settings

import brokk_min  # noqa: F401, before NumPy: it settles how many threads that takes

SLOW = [HealthCheck.too_slow, HealthCheck.data_too_large]

settings.register_profile("dev", max_examples=25, deadline=None, suppress_health_check=SLOW)
settings.register_profile(
    "ci", settings.get_profile("dev"), derandomize=True, database=None, print_blob=True
)
settings.register_profile("deep", settings.get_profile("dev"), max_examples=1000)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "ci"))


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """Small nets are fitted fastest on one thread."""
    import torch

    torch.set_num_threads(1)
