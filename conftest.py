"""The examples in the method's docstrings take the Brokk 170 for imported, and their own file."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy, for the whole run

import pytest

from brokk_min.machine import BROKK_170


@pytest.fixture(autouse=True)
def _brokk(doctest_namespace: dict[str, object]) -> None:
    doctest_namespace["BROKK_170"] = BROKK_170
