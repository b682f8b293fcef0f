"""Order of tests; profiles of Hypothesis.

Of these `ci` repeats itself bit for bit, `dev` explores, and `deep` does so for long.
"""

import os

import pytest
from hypothesis import HealthCheck, settings

SLOW = [HealthCheck.too_slow, HealthCheck.data_too_large]

settings.register_profile("dev", max_examples=25, deadline=None, suppress_health_check=SLOW)
settings.register_profile(
    "ci", settings.get_profile("dev"), derandomize=True, database=None, print_blob=True
)
settings.register_profile("deep", settings.get_profile("dev"), max_examples=1000)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "ci"))


LONGEST = ("test_mutants.py", "test_reproduce.py", "test_adaptation.py", "test_chain.py")


def pytest_collection_modifyitems(items):
    """The longest files first: else one of two processes waits for the other at the end."""
    items.sort(key=lambda item: item.path.name not in LONGEST)


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """Small nets are fitted fastest on one thread."""
    import torch

    torch.set_num_threads(1)
