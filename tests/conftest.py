"""Hypothesis profiles: `ci` repeats itself bit for bit, `dev` explores, `deep` for long. Stand-ins."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

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

Stand = Callable[..., dict[str, tuple[Any, ...]]]


@pytest.fixture
def stand(monkeypatch):
    """Puts functions of a module aside for ones that give what is told; what they were called with."""
    calls = {}

    def instead(module, **results):
        def stands(name):
            return lambda *arguments: (calls.update({name: arguments}), results[name])[1]

        for name in results:
            monkeypatch.setattr(module, name, stands(name))
        return calls

    return instead
