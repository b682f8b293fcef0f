"""Hypothesis profiles: `ci` repeats itself bit for bit, `dev` explores, `deep` for long."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy, for the whole run

import pytest
from hypothesis import HealthCheck, settings

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
