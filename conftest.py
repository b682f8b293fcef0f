"""The examples in the method's docstrings take the Brokk 170 for imported, and their own file."""

import pytest

from brokk_min.machine import BROKK_170


@pytest.fixture(autouse=True)
def _brokk(doctest_namespace: dict[str, object]) -> None:
    doctest_namespace["BROKK_170"] = BROKK_170
